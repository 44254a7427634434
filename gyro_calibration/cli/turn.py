# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""
Compute the error of a full turn, with a static bias only and with a model.

example: gyro_calibration turn table.csv --picture turn.png
"""

import argparse
from collections.abc import Iterator
import math
from typing import Any

from gyro_calibration.calibration.dwells import Dwells, extract_dwells, format_list, select_dwells
from gyro_calibration.calibration.rate_table import (
    compute_turn_errors, equal_bins, MIN_TURN_RATE, TurnErrors)
from gyro_calibration.calibration.scatter import cross_validation_parts, find_inliers, rms
from gyro_calibration.calibration.selection import select_effects, TECHNOLOGY_EFFECTS
from gyro_calibration.cli import verb
from gyro_calibration.cli.plots import draw_turn_errors
from gyro_calibration.cli.verb import Answer, show_progress
from gyro_calibration.diagnosis.words import as_sentence
from gyro_calibration.files import InputError, sha256_digest
from gyro_calibration.heading.log_compensation import compensate_log
from gyro_calibration.logs.log import Array, DEGREE, Log, Mask
from gyro_calibration.logs.ros_bag import list_recording_files
from gyro_calibration.model.compensation import compensate
from gyro_calibration.model.gyro_model import GyroModel
from gyro_calibration.model.model_file import read_model
import numpy as np


def add(parser: argparse.ArgumentParser) -> None:
    verb.add_log_options(parser)
    parser.add_argument('--model', metavar='MODEL.yaml',
                        help='model to evaluate; default: the effects that the data support, '
                        'fitted for each sweep to the other sweeps')
    parser.add_argument('--technology', choices=list(TECHNOLOGY_EFFECTS), help='of the gyro; '
                        'without --model, selects between effects that the data do not '
                        'distinguish')
    parser.add_argument('--slowest', type=verb.positive_number, default=MIN_TURN_RATE / DEGREE,
                        metavar='DPS',
                        help='slower turns are left out, deg/s; default: %(default)g')
    verb.add_picture_option(parser, 'the errors over the rate')


def run(given: argparse.Namespace) -> Answer:
    if given.model and given.technology:
        raise InputError('--technology selects effects, and --model has its own; give one of '
                         'the two')
    log = verb.read(given)
    found = extract_dwells(log)
    with show_progress('fit of effects, and errors of turns'):
        if given.model is not None:
            rate, is_inlier, remarks, data = _predict_by_model(
                given, read_model(given.model), log, found)
        else:  # by models that are not fitted to the sweep
            calibration = select_effects(found, given.technology).calibration
            names, used = [effect.name for effect in calibration.effects], calibration.used
            parts = int(cross_validation_parts(used).max()) + 1
            left_out = ('sweep' if parts == len(np.unique(used.sweep)) else
                        'turn' if parts == len(used) else f'of {parts} parts of the log')
            remarks = [f'the model is {", ".join(names)}, which the data support; its values are '
                       f'fitted for each {left_out} to the others, so no turn is in the data of '
                       'its model']
            rate, is_inlier = calibration.left_out_rate, calibration.scatter.inliers
            data = {'effects': names, 'left_out': True}
        errors = compute_turn_errors(select_dwells(found, is_inlier), rate[is_inlier],
                                     given.slowest * DEGREE)
    if given.picture:
        draw_turn_errors(given.picture, errors, given.slowest * DEGREE)
    remarks = [*found.remarks, *errors.remarks, *remarks]
    if places := [place for place, good in zip(found.location, is_inlier) if not good]:
        remarks.append(f'{len(places)} outlying dwells are left out: {format_list(places)}')

    turns, slowest = errors.turns, given.slowest * DEGREE
    # of equal width in the logarithm of the speed, in each sense
    speeds = [(math.exp(low), math.exp(high), mask)
              for low, high, mask in equal_bins(np.log(np.abs(turns.rate)), 4)]
    rates = [*((-high, -low, mask & (turns.rate < 0.0)) for low, high, mask in speeds[::-1]),
             *((low, high, mask & (turns.rate > 0.0)) for low, high, mask in speeds)]
    temperatures = [] if turns.temperature is None else [*equal_bins(turns.temperature, 8)]
    sizes = _error_sizes(errors, np.ones(len(turns), dtype=bool))
    pairs = list(zip(*(each.values() for each in sizes.values())))
    ratios = [before / after if after > 0.0 else None for before, after in pairs]
    by_rate, by_temperature = (
        [{f'from_{unit}': low, f'to_{unit}': high, 'turns': int(np.count_nonzero(mask)),
          **_error_sizes(errors, mask)} for low, high, mask in bins if mask.any()]
        for unit, bins in (('rad_s', rates), ('degc', temperatures)))
    rms_phrase, largest_phrase = (
        (f'{before / DEGREE:.3g} deg ({100.0 * before / math.tau:.2g} %)',
         f'{after / DEGREE:.3g} deg ({100.0 * after / math.tau:.2g} %)',
         f'a factor of {f"{before / after:.2g}" if after > 0.0 else "infinity"}')
        for before, after in pairs)
    lines = ['Error of a turn of 360 deg: largest {} with the static bias only, {} with the '
             'model, {}; '.format(*largest_phrase) + 'rms {} and {}, {}.'.format(*rms_phrase),
             f'{len(turns)} turns, {given.slowest:g} deg/s and faster, '
             f'of {len(np.unique(turns.sweep))} sweeps in {given.log}.',
             *map(as_sentence, remarks), *_table('rate [deg/s]', DEGREE, by_rate),
             *_table('temperature [degC]', 1.0, by_temperature)]
    return Answer(lines, {
        'turns': len(turns), 'slowest_rad_s': slowest, **sizes,
        'ratio_rms': ratios[0], 'ratio_largest': ratios[1],
        'by_rate': by_rate, 'by_temperature': by_temperature,
        'rate_rad_s': turns.rate.tolist(), 'temperature_degc': None
        if turns.temperature is None else turns.temperature.tolist(),
        'static_rad_per_turn': errors.static.tolist(),
        'modelled_rad_per_turn': errors.modelled.tolist(),
        'sweep': turns.sweep.tolist(), 'place': list(turns.location), 'remarks': remarks,
        **data}, (given.picture,))


def _predict_by_model(given: argparse.Namespace, model: GyroModel, log: Log,
                      found: Dwells) -> tuple[Array, Mask, list[str], dict[str, Any]]:
    """Return the rates of dwells, which of them are not outlying, remarks, and data."""
    result = compensate(model, found.output, found.temperature)
    names = [term.effect.name for term in model.terms]
    clipped, beyond = (int(np.count_nonzero(each))
                       for each in (result.temperature_clipped, result.beyond_range))
    used = [*names, *(['self-calibration'] if model.self_calibration else [])]
    remark = f'the model is {given.model}: {", ".join(used) or "no effects"}'
    is_fitted = any(sha256_digest(file) in str(model.origin)
                    for file in list_recording_files(given.log))
    if is_fitted or 'sha256' not in str(model.origin):
        remark += (f'; {"" if is_fitted else "if "}it was fitted to this log, '
                   f'{"so " if is_fitted else ""}these are errors of a fit, not of a prediction')
    remarks = [remark]
    if found.temperature is None and model.uses_channel('temperature'):
        remarks.append('the log has no temperature: that of reference was used')
    for count, where in ((clipped, 'outside the calibrated temperatures'),
                         (beyond, 'beyond the calibrated rates')):
        if count:
            remarks.append(f'{count} of {len(found)} dwells are {where}; the correction is '
                           'extrapolated')
    rate = result.rate
    if model.needs_history:  # the model depends on the past: the log is compensated row by row
        error = np.asarray(log.output) - compensate_log(model, log)
        rate = found.output - np.array([error[rows].mean() for rows in found.rows])
    return rate, find_inliers(found), remarks, {
        'effects': names, 'left_out': False, 'temperature_clipped': clipped,
        'beyond_range': beyond}


def _table(title: str, unit: float, rows: list[dict[str, Any]]) -> Iterator[str]:
    if not rows:
        return
    yield ''
    yield f'{"":26}  {"static bias only":^32}  {"with the model":^32}'.rstrip()
    yield (f'{title:20} {"turns":>5}' + 2 * f'  {"rms":^15}  {"largest":^15}').rstrip()
    yield f'{"":26}' + 4 * f'  {"deg":>7} {"%":>7}'
    for row in rows:
        low, high, count, *errors = row.values()
        label = f'{low / unit:.4g} to {high / unit:.4g}'
        yield f'{label:20} {count:5d}' + ''.join(
            f'  {value / DEGREE:7.3f} {100.0 * value / math.tau:7.3f}'
            for each in errors for value in each.values())


def _error_sizes(errors: TurnErrors, mask: Mask) -> dict[str, dict[str, float]]:
    return {name: {'rms_rad_per_turn': rms(each[mask]),
                   'largest_rad_per_turn': float(np.abs(each[mask]).max())}
            for name, each in (('static', errors.static), ('modelled', errors.modelled))}
