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
Add compensated rates, and for samples in time the heading, to a log.

example: gyro_calibration compensate drive.csv --model model.yaml --out compensated.csv
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import datetime, timezone
import math
from typing import Any

from gyro_calibration.cli import verb
from gyro_calibration.cli.verb import Answer
from gyro_calibration.diagnosis.words import as_sentence
from gyro_calibration.files import InputError
from gyro_calibration.heading.bias_table import BiasTable
from gyro_calibration.heading.heading_estimator import Assumptions, HeadingEstimator
from gyro_calibration.heading.integration import BlockIntegrator, Intervals, MAX_GAP, Threshold
from gyro_calibration.heading.log_compensation import (
    LogCompensation, no_plausible_row_message, plausible_rows, rows_of, smooth_track)
from gyro_calibration.heading.tracker import TrackerSettings
from gyro_calibration.logs.log import (
    Array, CACHE_BLOCK_SAMPLES, DataRefused, DEGREE, Log, Mask, write_log)
from gyro_calibration.model.compensation import quadratic_form, uncertainty_covariance
from gyro_calibration.model.gyro_model import GyroModel, with_self_calibration
from gyro_calibration.model.model_file import read_model
from gyro_calibration.model.noise import Noise
import numpy as np


def add(parser: argparse.ArgumentParser) -> None:
    verb.add_log_options(parser)
    parser.add_argument('--model', required=True, metavar='MODEL.yaml')
    parser.add_argument('--out', required=True, metavar='OUT.csv', help='.csv or .csv.gz')
    parser.add_argument('--threshold', type=verb.non_negative_number, default=0.0, metavar='DPS',
                        help='rates below it are set to 0, as below 0.3 in the node; '
                        'default: 0, off')
    parser.add_argument('--rest', action='store_true', help='detect standstill, as the node does: '
                        'the heading is held there, and the bias is estimated')
    parser.add_argument('--hindsight', action='store_true',
                        help='as --rest, and smooth the heading by all later samples')


def run(given: argparse.Namespace) -> Answer:
    model = read_model(given.model)
    if (given.rest or given.hindsight) and (given.threshold or not model.noise.angle_random_walk):
        raise InputError('--rest and --hindsight need no --threshold and a model with an angle '
                         'random walk; run allan to add it to the model')
    log = verb.read(given)
    with verb.show_progress('heading'):
        found = (track_log(log, model, given.hindsight, given.log)
                 if given.rest or given.hindsight else integrate_log(log, model, Threshold(
                     given.threshold * DEGREE, angle_random_walk=model.noise.angle_random_walk),
                     given.log))
        write_log(given.out, log, found.columns)
    columns, known = found.columns, found.is_plausible
    without = int(np.count_nonzero(~np.isfinite(np.asarray(log.output))))
    unknown = [quantity for quantity in _MISSING_INPUTS if getattr(log, quantity) is None]
    data: dict[str, Any] = {
        'out': given.out, 'rows': len(log), 'rows_without_output': without,
        'rows_at_rest': int(np.nansum(columns.get('resting', 0.0))),
        'refused_samples': int(np.count_nonzero(~known)) - without,
        **{name: int(np.nansum(columns[name])) for name in ('temperature_clipped',
                                                            'beyond_range')},
        'lost_samples': found.intervals.lost_samples,
        'longest_gap_s': found.intervals.longest_gap,
        'temperature_known': 'temperature' not in unknown}
    lines = [f'{data["rows"]} rows compensated by {given.model}, written to {given.out}.']
    if 'heading_rad' in columns:
        lines += _describe_heading(log, found, model, data)
    estimator = found.estimator
    if estimator is None:
        data['bias_is_calibrated'] = bool(model.self_calibration or model.fits_scale_and_bias[1])
    else:
        data.update(bias_is_calibrated=not estimator.is_bias_assumed,
                    bias_ambiguity_rad_s=estimator.tracker.bias_ambiguity)
    lines += _describe_bias(estimator, log.moving is not None, data)
    lines += [words for quantity, words in _MISSING_INPUTS.items() if quantity in unknown
              and model.uses_channel(quantity.removeprefix('reference_'))]
    lines += [f'{term.effect.name}: {term.effect.not_compensated}' for term in model.terms
              if term.effect.not_compensated]
    if MAX_GAP < (interval := found.intervals.usual_interval) < math.inf:
        lines.append(f'The samples are {interval:g} s apart, between which the rate is taken to '
                     f'be constant; {_INTERVAL_REMEDY}.')
    for name, words in (
            ('rows_without_output',
             'rows have no output of the gyro; the heading is integrated across them.'),
            ('refused_samples', 'rows have an implausible rate or temperature and are not used; '
             'they count as lost.'),
            ('lost_samples', 'samples are lost; the heading is integrated over gaps of up to '
             f'{MAX_GAP:g} s, and unknown over longer ones, as its standard deviation tells.'),
            ('temperature_clipped', 'rows are outside the calibrated temperatures; the correction '
             'is extrapolated, and the standard deviation increases.'),
            ('beyond_range', 'rows are beyond the calibrated rates; the correction is '
             'extrapolated, or held where the model has no rate for the output.')):
        if data[name]:
            lines.append(f'{data[name]} {words}')
    return Answer(lines, data)


def _describe_heading(log: Log, found: CompensatedLog, model: GyroModel,
                      data: dict[str, Any]) -> Iterator[str]:
    """Give sentences on the heading at the end and its errors, and add them to the data."""
    headings, known = found.columns['heading_rad'], found.is_plausible
    heading, deviation = headings[known][-1], found.columns['heading_std_rad'][known][-1]
    # The deviation is zero where the model has neither noise nor covariance.
    is_known = bool(deviation > 0.0)
    data.update(heading_rad=float(heading), heading_std_rad=float(deviation) if is_known else None,
                noise_is_known=model.noise != Noise())
    spread = f' +- {deviation / DEGREE:.2f}' if is_known else ''
    yield f'Heading at the end: {heading / DEGREE:.2f}{spread} deg.'
    if is_known and not data['noise_is_known']:
        yield ('The model has no noise figures: noise and wander of the bias are not in the '
               'standard deviation; record a rest, and run allan to add them to the model.')
    if log.reference_heading is None:
        return
    error = headings - log.reference_heading
    error = error[np.isfinite(error)]
    if len(error):
        error -= error[0]
        mean, last = float(np.abs(error).mean()), float(error[-1])
        data.update(mean_heading_error_rad=mean, last_heading_error_rad=last)
        yield (f'Error against the reference heading: mean {mean / DEGREE:.3f} deg, at the end '
               f'{last / DEGREE:.3f} deg. Both start at 0 at the first row with a reference; '
               'unlike those of fit, this error includes its mean and a delay of the reference.')


def _describe_bias(estimator: HeadingEstimator | None, has_wheels: bool,
                   data: dict[str, Any]) -> Iterator[str]:
    """Give sentences on what the standard deviation does not contain of the bias."""
    if estimator is None:
        if not data['bias_is_calibrated']:
            yield ('The bias is not known from a calibration: 0 was used, and its error is not in '
                   'the standard deviation; run self-calibrate, or use --rest.')
        return
    if estimator.is_bias_assumed and not has_wheels:
        yield ('The bias is not known from a calibration: the first steady rate within '
               f'{Assumptions.bias / DEGREE:g} deg/s was taken for that of a rest. If the log '
               'begins in a turn, the heading may be off by more than its standard deviation; run '
               'self-calibrate, begin with a rest, or record the column moving.')
    if not (estimator.is_bias_assumed or data['rows_at_rest']):
        yield ('No rest was found: a change of the bias since the calibration is not in the '
               'standard deviation; rest now and then, or calibrate before each drive.')
    if estimator.is_scale_assumed:
        yield ('The scale factor error is not known from a calibration: '
               f'{100.0 * Assumptions.scale_factor_error:g} % is in the standard deviation; run '
               'self-calibrate, or give the model of fit, which states its covariance.')
    if estimator.bias_message:
        yield as_sentence(estimator.bias_message)
    if not data['temperature_known']:
        yield ('The log has no temperature: a change of the bias with it is not in the standard '
               'deviation; record the column temperature_degc.')


#: Other inputs of effects: quantity of a log -> the sentence where the log lacks it.
_MISSING_INPUTS = {
    'temperature': 'The log has no temperature: the model was used at its reference temperature.',
    'specific_force': 'The log has no specific force: 0 m/s² was assumed.',
    'supply': 'The log has no supply voltage: its effect was left out.',
    'reference_heading': 'The log has no reference heading: '
    'the compensated heading was used, from 0 on.'}


_INTERVAL_REMEDY = 'check the unit of time_s, or give the sample rate with --rate'


@dataclass(frozen=True)
class CompensatedLog:
    """The new columns of a log, nan in rows that are not plausible."""

    is_plausible: Mask
    columns: dict[str, Array]  # by name, each of shape (n,)
    intervals: Intervals
    estimator: HeadingEstimator | None  # after the log, where rests were detected


def _to_compensated(log: Log, known: Mask, columns: dict[str, Array], name: str,
                    intervals: Intervals,
                    estimator: HeadingEstimator | None = None) -> CompensatedLog:
    """Give columns of the plausible rows to all rows; refuse one that is not finite there."""
    found = {}
    for column, values in columns.items():
        # a standard deviation may be unknown, nan
        finite = ~np.isinf(values) if '_std_' in column else np.isfinite(values)
        if not finite.all():
            row = np.flatnonzero(known)[int(np.argmin(finite))]
            at = '' if log.time is None else f' at {log.time[row]:g} s'
            raise DataRefused(
                f'{name}: {column} is not finite for an output of '
                f'{np.asarray(log.output)[row]:g} rad/s{at}; remove the sample, or check columns, '
                'units and the model')
        found[column] = np.full(len(known), np.nan)
        found[column][known] = values
    return CompensatedLog(known, found, intervals, estimator)


def integrate_log(log: Log, model: GyroModel, threshold: Threshold, name: str) -> CompensatedLog:
    """Return the rates of a log and, where it has a time, its heading."""
    known = plausible_rows(model, log)
    if not known.any():
        raise DataRefused(f'{name}: {no_plausible_row_message(model)}'
                          if np.isfinite(np.asarray(log.output)).any() else
                          f'{name}: no gyro output is finite; record again')
    integrator = BlockIntegrator(threshold, model.noise, uncertainty_covariance(model))
    compensation, variance, blocks = LogCompensation(model), 0.0, list[dict[str, Array]]()
    if log.time is not None:
        # The noise of a rate depends on the interval between samples. That of the first block is
        # used for all rates, since a lost sample does not reduce the noise of a gyro. Rows without
        # output may lie between samples.
        first = log.time[:CACHE_BLOCK_SAMPLES]
        of_output = first[known[:CACHE_BLOCK_SAMPLES]]
        variance = model.noise.rate_variance(
            float(np.median(np.diff(of_output if len(of_output) > 1 else first))))
    # in blocks, which limit the memory, unless rates are interpolated to the stamps
    size = len(log) if model.moves_stamps else CACHE_BLOCK_SAMPLES
    for begin in range(0, len(log), size):
        rows = rows_of(log, begin + np.flatnonzero(known[begin:begin + size]))
        result, sensitivity = compensation.add(rows)
        columns = {'rate_rad_s': result.rate}
        if rows.time is not None:
            time = compensation.true_time(rows.time) if model.moves_stamps else rows.time
            (columns['rate_rad_s'], columns['heading_rad'],
             columns['heading_std_rad']) = integrator.add(time, result.rate, sensitivity)
        columns['rate_std_rad_s'] = np.sqrt(
            variance + quadratic_form(uncertainty_covariance(model), sensitivity))
        if model.moves_stamps and rows.time is not None:
            columns = {name: np.interp(rows.time, time, values)
                       for name, values in columns.items()}
        columns |= {'temperature_clipped': result.temperature_clipped,
                    'beyond_range': result.beyond_range}
        blocks.append(columns)
    return _to_compensated(log, known, {
        column: np.concatenate([each[column] for each in blocks]) for column in columns},
        name, integrator.intervals)


def track_log(log: Log, model: GyroModel, hindsight: bool, name: str) -> CompensatedLog:
    """Return rates and heading of a log, with heading and bias tracked as by the node."""
    known = np.abs(np.asarray(log.output)) <= model.rate_limit
    if log.time is None or known.sum() < 2:
        raise DataRefused(f'{name}: standstill detection needs two or more samples with a time; '
                          'give a log with time_s, or --rate')
    if log.temperature is not None and not plausible_rows(model, log).any():
        raise DataRefused(f'{name}: {no_plausible_row_message(model)}')
    rows = rows_of(log, known)
    interval = float(np.median(np.diff(np.asarray(rows.time))))
    if interval > MAX_GAP:
        raise DataRefused(f'{name}: the samples are {interval:g} s apart, and standstill '
                          f'detection needs at least one in {MAX_GAP:g} s; {_INTERVAL_REMEDY}')
    time, output = LogCompensation(model).true_time(np.asarray(rows.time)), np.asarray(rows.output)
    # Where stamps are no dates, the age of a calibration is unknown and assumed to be 0; those
    # beyond 1e9 are s since 1970.
    begin, used, calibration = float(np.asarray(rows.time)[0]), model, model.self_calibration
    has_dates = begin > 1e9
    start_date = 0.0 if has_dates else 1e9  # of time 0
    now = start_date + begin
    if not has_dates and calibration is not None and calibration.temperature is None:
        temperatures = (np.zeros(0) if rows.temperature is None
                        else rows.temperature[np.isfinite(rows.temperature)])
        if len(temperatures):
            calibration = replace(calibration, temperature=float(temperatures[0]))
            used = with_self_calibration(model, calibration)
    estimator = HeadingEstimator(used, BiasTable(used), Assumptions(), TrackerSettings(), now,
                                 hindsight)
    if not has_dates and calibration is not None:
        estimator.use_calibration(with_self_calibration(used, replace(
            calibration, time=datetime.fromtimestamp(now, timezone.utc).isoformat())), now)
    # the state of the wheels
    moving = None if rows.moving is None else [bool(each) for each in rows.moving]
    found = estimator.follow(time, output, start_date, rows.temperature, moving,
                             rows.specific_force, rows.supply)
    heading, variance, rate, rate_variance, resting, corrected, clipped, beyond = found.T
    if hindsight:
        if not np.isfinite(found).all():
            raise DataRefused(f'{name}: the variance of the heading is not finite; '
                              'check columns, units and the model')
        heading, variance, resting = smooth_track(estimator.tracker, time, corrected)
    return _to_compensated(log, known, {
        'rate_rad_s': rate, 'heading_rad': heading, 'heading_std_rad': np.sqrt(variance),
        'rate_std_rad_s': np.sqrt(rate_variance), 'resting': resting.astype(float),
        'temperature_clipped': clipped, 'beyond_range': beyond}, name,
        estimator.tracker.intervals, estimator)
