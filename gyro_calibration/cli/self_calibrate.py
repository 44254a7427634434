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
Find scale factor error and bias from about 20 s of known motion, or from whole turns.

example: gyro_calibration self-calibrate run.csv --profile profile.csv --out model.yaml
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field
from datetime import datetime, timezone
import math
from pathlib import Path
import re
from typing import Any

from gyro_calibration.calibration.likelihood import ScaleBiasFit
from gyro_calibration.calibration.run_faults import (
    fit_profile, MAX_UNEXPLAINED_SHARE, refuse_unit_error, split_run, UNIT_TOLERANCE)
from gyro_calibration.calibration.selection import TECHNOLOGY_PRIORS
from gyro_calibration.calibration.self_calibration import (
    check_end, check_rest, default_reference_errors, describe_commanded_headings,
    describe_implausible_scale, find_rest_after, METHODS, ReferenceErrors, RestCheck, RunLimits,
    self_calibrate, SETTLING_TIME, to_model_record)
from gyro_calibration.calibration.whole_turns import calibrate_turns, MARK_DEVIATION
from gyro_calibration.cli import verb
from gyro_calibration.cli.plots import draw_headings
from gyro_calibration.cli.verb import Answer, PrintedResult, show_progress
from gyro_calibration.diagnosis.words import as_sentence
from gyro_calibration.files import InputError
from gyro_calibration.heading.integration import integrate
from gyro_calibration.heading.log_compensation import (
    compensate_log, no_plausible_row_message, plausible_rows)
from gyro_calibration.logs.log import Array, DataRefused, DEGREE, Log, Mask
from gyro_calibration.model.gyro_model import GyroModel, SelfCalibration, with_self_calibration
from gyro_calibration.model.model_file import read_model, write_model
from gyro_calibration.model.motion import Motion, motion_from_log, read_motion
import numpy as np

#: Value of --turns for the number of turns that is nearest to the angle of the gyro.
_NEAREST = 'nearest'


def add(parser: argparse.ArgumentParser) -> None:
    verb.add_log_options(parser)
    parser.add_argument('--profile', metavar='PROFILE.csv', help='time_s and commanded '
                        'heading_deg or rate_dps, or measured reference_heading_deg; default: '
                        'the reference of the log')
    parser.add_argument('--turns', type=_parse_turns, metavar='N', help='number of full turns '
                        'from a mark to the same mark with standstill at both ends, '
                        f'counter-clockwise positive; {_NEAREST}: the number nearest to the gyro')
    parser.add_argument('--marking', type=verb.non_negative_number, metavar='DEG',
                        help='standard deviation of the angle between both marks, deg; default: '
                        f'{MARK_DEVIATION / DEGREE:g}')
    parser.add_argument('--method', choices=list(METHODS), default='likelihood',
                        help='default: likelihood; the others as published')
    parser.add_argument('--model', metavar='MODEL.yaml', help='model to compensate by first')
    for name, unit, what in (('scale-deviation', '%%', 'the scale factor error'),
                             ('drift', 'deg/s', 'the drift'),
                             ('random-walk', 'deg/sqrt(h)', 'the angle random walk')):
        default = '; default: 0.58 for a commanded profile' if name == 'scale-deviation' else ''
        parser.add_argument(f'--reference-{name}', type=verb.non_negative_number, metavar='X',
                            help=f'standard deviation of {what} of the reference, '
                            f'or of the driven profile, {unit}{default}')
    verb.add_picture_option(parser, 'the heading and its error, before and after')
    parser.add_argument('--out', metavar='MODEL.yaml',
                        help='write the model with this self-calibration')


def _parse_turns(text: str) -> int | str:
    if text != _NEAREST and not re.fullmatch('[+-]?0*[1-9][0-9]*', text):
        raise argparse.ArgumentTypeError(f'{text} is no number of turns; give an integer other '
                                         f'than 0, or {_NEAREST}')
    return text if text == _NEAREST else int(text)


def run(given: argparse.Namespace) -> Answer:
    if given.turns is not None and (given.profile or given.picture):
        raise InputError('--turns has no motion, which --profile gives and --picture draws; give '
                         'one of them')
    if given.turns is None and given.marking is not None:
        raise InputError('--marking is the error of the mark of --turns; give both or none')
    model = read_model(given.model) if given.model else GyroModel()
    log = verb.read(given)
    verb.require_time(given, log)
    plausible, output = plausible_rows(model, log), np.asarray(log.output)
    if not plausible.any() and np.isfinite(output).any():
        raise DataRefused(f'{given.log}: {no_plausible_row_message(model)}')
    data: dict[str, Any]
    if given.turns is None:
        run, data, lines = _calibrate_by_motion(given, model, log)
        calibration, is_used = run.model.self_calibration, run.is_used
    else:
        rates = compensate_log(with_self_calibration(model, None), log)
        marking = MARK_DEVIATION if given.marking is None else given.marking * DEGREE
        found = calibrate_turns(np.asarray(log.time)[plausible], rates[plausible],
                                None if given.turns == _NEAREST else given.turns,
                                noise=model.noise, mark_deviation=marking,
                                output=output[plausible])
        (before, after), is_used = found.rest_durations, plausible
        calibration = make_self_calibration(found.fit, 'turns', log, plausible)
        data = {'turns': found.turns, 'turning_s': found.duration, 'rests_s': [before, after],
                'marking_rad': marking}
        direction = 'counter-clockwise' if found.turns > 0 else 'clockwise'
        lines = [f'{abs(found.turns)} full turns {direction} in {found.duration:.1f} s, between '
                 f'standstills of {before:.1f} and {after:.1f} s; standard deviation of the mark '
                 f'{marking / DEGREE:g} deg.']
    assert calibration is not None
    if given.out:
        write_model(given.out, with_self_calibration(verb.add_origin(given, model), calibration))
    first = as_sentence(f'{calibration}, from {is_used.sum()} samples')
    return Answer([first, *lines, *describe_unused_rows(log, plausible)],
                  {**calibration.to_dict(), 'samples': int(is_used.sum()),
                   'rows_without_output': int(np.count_nonzero(~np.isfinite(output))),
                   'refused_samples': int(np.count_nonzero(np.isfinite(output) & ~plausible)),
                   **data, 'out': given.out}, (given.picture, given.out))


def describe_unused_rows(log: Log, plausible: Mask) -> list[str]:
    """Return a sentence on the rows without an output, and one on those that are implausible."""
    known = np.isfinite(np.asarray(log.output))
    return [f'{rows.sum()} of {len(log)} rows have {words} and are not used.' for rows, words in (
        (~known, 'no output of the gyro'),
        (known & ~plausible, 'an implausible rate or temperature')) if rows.any()]


def _calibrate_by_motion(given: argparse.Namespace, model: GyroModel,
                         log: Log) -> tuple[Run, dict[str, Any], list[str]]:
    """Return the run, data and lines of the answer."""
    try:
        motion, begin = ((read_motion(given.profile), np.asarray(log.time)[0]) if given.profile
                         else motion_from_log(log))
    except InputError as error:
        if given.profile:
            raise
        raise type(error)(f'{given.log}: {error} with --profile') from None
    scale = given.reference_scale_deviation
    usual = default_reference_errors(motion) if given.profile else ReferenceErrors()
    reference = ReferenceErrors(usual.scale_deviation if scale is None else scale / 100.0,
                                (given.reference_drift or 0.0) * DEGREE,
                                (given.reference_random_walk or 0.0) * DEGREE / 60.0)
    with show_progress('fit of scale factor error, bias and delay'):
        run = calibrate_run(log, model, motion, begin, given.method, reference)
    if given.picture:
        run.plot(given.picture)
    lines, fit, check = list[str](), run.fit, run.rest_check
    if given.method == 'likelihood':
        lines.append(f'Delay of the gyro behind the {motion.name}: {fit.time_offset:.4f} '
                     f'+- {fit.time_offset_deviation:.4f} s.')
    if not math.isnan(fit.start_heading):
        lines.append(f'The run began {fit.start_heading / DEGREE:.3f} '
                     f'+- {fit.start_heading_deviation / DEGREE:.3f} deg from the first heading '
                     'of the reference.')
    if fit.goodness:
        lines.append(f'{fit.goodness}.')
    if check:
        lines.append(f'At rest after the run the corrected rate is {check.rate / DEGREE:.4f} '
                     f'deg/s; limit: {check.limit / DEGREE:.4f} deg/s.')
    elif motion.name == 'profile' and given.method == 'likelihood':
        wanted = max(fit.time_offset, 0.0) + SETTLING_TIME + RunLimits().rest_duration
        lines.append(f'The log has no rest up to {wanted:.1f} s after the profile. A steady turn '
                     'throughout has the effect of a bias: let the robot rest after the run, and '
                     'record until then.')
    technology = model.gyro.get('technology', 'mems')
    lines += [as_sentence(remark) for remark in (
        describe_commanded_headings(motion), describe_implausible_scale(
            fit, TECHNOLOGY_PRIORS.get(technology, TECHNOLOGY_PRIORS['mems'])[0], motion.name))
        if remark]
    return run, {
        'time_offset_s': fit.time_offset,
        'time_offset_standard_deviation_s': fit.time_offset_deviation,
        'start_heading_rad': fit.start_heading,
        'start_heading_standard_deviation_rad': fit.start_heading_deviation,
        'degrees_of_freedom': getattr(fit.goodness, 'dof', math.nan),
        **{name: getattr(fit.goodness, name, math.nan)
           for name in ('chi_square', 'probability', 'noise_ratio')},
        'rest_rate_rad_s': check.rate if check else math.nan,
        'rest_limit_rad_s': check.limit if check else math.nan}, lines


@dataclass(frozen=True)
class Run(PrintedResult):
    """A self-calibration by a known motion, checked by the rest after it."""

    model: GyroModel  # the given model with the new self-calibration
    scale_factor_error: float
    bias: float  # rad/s
    scale_factor_error_std: float
    bias_std: float  # rad/s
    fit: ScaleBiasFit = field(repr=False)  # with the delay of the gyro and the goodness of fit
    remarks: tuple[str, ...]  # on the rows of the log that were not used
    rest_check: RestCheck | None
    is_used: Mask = field(repr=False)  # which rows of the log
    time: Array = field(repr=False)  # of these rows, on the clock of the motion, s
    rate: Array = field(repr=False)  # of these rows, rad/s
    motion: Motion = field(repr=False)  # that was driven

    def __str__(self) -> str:
        return ' '.join([as_sentence(str(self.model.self_calibration)), *self.remarks])

    def plot(self, path: str | Path | None = None) -> Any:
        """Return a figure of the run and of its heading error before and after."""
        fit = self.fit
        delay = 0.0 if math.isnan(fit.time_offset) else fit.time_offset
        time, true = self.time, self.motion.heading_at(self.time - delay)
        return draw_headings(path, time, true - true[0], {
            'not calibrated': integrate(time, self.rate),
            'calibrated': integrate(time, (self.rate - fit.bias) / (1.0 + fit.scale_factor_error))
        })


def calibrate_run(log: Log, model: GyroModel, motion: Motion, begin: float, method: str,
                  reference: ReferenceErrors) -> Run:
    """Calibrate by the motion that began at a time of the log, s, and by the rest after it."""
    time, known = np.asarray(log.time) - begin, plausible_rows(model, log)
    output, within = np.asarray(log.output), (time >= -1.0) & (time <= motion.duration + 1.0)
    run, whole = known & within, np.isfinite(output) & within
    if (whole & ~known).any():  # in a wrong unit rates may be implausible
        unexplained, scale, _ = fit_profile(
            split_run(time[whole], output[whole]), motion, RunLimits().max_time_offset)
        if unexplained <= MAX_UNEXPLAINED_SHARE and abs(scale) > UNIT_TOLERANCE:
            refuse_unit_error(scale, motion.name)
            raise DataRefused(f'the gyro reports {scale:.4g} times what was turned: correct its '
                              'unit or sensitivity')
    rate = compensate_log(with_self_calibration(model, None), log)
    fit = self_calibrate(time[run], rate[run], motion, method, noise=model.noise,
                         reference=reference, output=output[run],
                         prior=model.prior_deviations)
    rest = find_rest_after(time[known], rate[known], fit, motion)
    check = (None if rest is None
             else check_rest(time[known][rest], rate[known][rest], fit, model.noise))
    fit = (check.fit if check is not None else
           check_end(time[known], rate[known], fit, motion, model.noise))
    calibration = make_self_calibration(fit, method, log, run)
    return Run(with_self_calibration(model, calibration), fit.scale_factor_error, fit.bias,
               *calibration.standard_deviations, fit, tuple(describe_unused_rows(log, known)),
               check, run, time[run], rate[run], motion)


def make_self_calibration(fit: ScaleBiasFit, method: str, log: Log,
                          is_used: Mask) -> SelfCalibration:
    """Return a fit as the calibration of now, at the mean temperature of the rows used."""
    temperature = None if log.temperature is None else float(log.temperature[is_used].mean())
    return to_model_record(fit, method, datetime.now(timezone.utc).isoformat(timespec='seconds'),
                           temperature)
