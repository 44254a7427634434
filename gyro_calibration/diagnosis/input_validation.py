# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The door: refuse logs and models that allow no diagnosis, and say what would allow one."""

from __future__ import annotations

from dataclasses import replace
import math

from gyro_calibration.calibration.dwells.samples import between_values, output_of, where_lost
from gyro_calibration.diagnosis.expected_output import (
    bridged,
    line_between,
    reference_rate,
    scale_of,
    white_noise,
)
from gyro_calibration.diagnosis.findings import Gate
from gyro_calibration.diagnosis.quantization import codes_of
from gyro_calibration.logs.log import Array, DataRefused, DEGREE, Log, refuse_wrapped
from gyro_calibration.model.gyro_model import GyroModel
import numpy as np

#: Least samples and seconds of a log in time, rows of a rate table, and part of a log with values.
FEWEST, SHORTEST, FEWEST_ROWS, LEAST = 100, 20.0, 8, 0.1
#: Rows that a rate table has at most; more are samples whose time is missing.
MOST_ROWS = 5000
#: Of a log, s: three years, or stamps in another unit.
LONGEST = 1e8
#: Without a reference, a gyro is at rest while its means over 1 s stay this close together, rad/s.
REST = 3.0 * DEGREE
#: A reference that turns by less than this, rad, beside what its noise adds up to in so many
#: standard deviations, may stand still; it does where the output follows it by no more than so
#: many standard deviations.
_STILL, _ADDED, _FOLLOWED = 1.0 * DEGREE, 4.0, 4.0
#: An output within this part of its spread of a line over the reference was made from it.
_COPY = 1e-6
#: Steps of print up to this part of the spread hide in a copy.
_PRINT = 1e-5
#: A model in deg/s is off by 57.3; with errors of its own it is off by something near it.
_NEAR = 1.3
#: No gyro is noisier or quieter than its model by more than this.
_ABSURD = 1000.0
#: Nor turns it faster than its model was made for by more than this.
_TOO_FAST = 20.0


def refuse(log: Log, model: GyroModel | None = None) -> None:
    """
    Refuse a log, or a model for it, that allows no diagnosis.

    Raises
    ------
    DataRefused : with the reason and the remedy

    """
    output = output_of(log)
    log, _ = prepared(log)
    if log.reference_rate is None:
        refuse_wrapped(log)
    if log.time is None:
        _refuse_table(log, output)
    else:
        _refuse_few(log.time, output)
        _refuse_without_reference(log, output)
    _refuse_constant(output)
    _refuse_copy(log, output)
    if model is not None:
        _refuse_units(log, output, model)


def model_gate(log: Log, model: GyroModel) -> Gate:
    """Tell whether a model is of the units of a log."""
    try:
        _refuse_units(prepared(log)[0], output_of(log), model)
    except DataRefused as refusal:
        said, _, remedy = str(refusal).partition('; ')
        return Gate('model', False, said, remedy)
    return Gate('model', True, 'the model is of the units of the log')


def prepared(log: Log) -> tuple[Log, tuple[str, ...]]:
    """
    Return a log with the reference that is used, and what is to be said of that.

    The rate is dropped if it is known in less than half as many samples as the heading. A rate
    that is nothing but noise becomes that of a rest.

    """
    if log.time is None:
        return log, ()
    counts = [0 if values is None else int(np.isfinite(values).sum())
              for values in (log.reference_rate, log.reference_heading)]
    by_rate = counts[0] > 0 and 2 * counts[0] >= counts[1]
    said = () if by_rate or not counts[0] else (
        f'The reference rate is known in {counts[0]} samples only; '
        f'the heading, known in {counts[1]}, is used.',)
    log = replace(log, reference_rate=log.reference_rate if by_rate else None,
                  reference_heading=log.reference_heading if counts[1] else None)
    rate = reference_rate(log)
    if rate is None or not np.nanmax(np.abs(rate)) > 0.0 or not rests(log):
        return log, said
    return replace(log, reference_rate=0.0 * rate, reference_heading=None), (
        *said, 'What the reference shows is its noise, which the gyro does not see; '
        'it is taken to be at rest.')


def evened(log: Log) -> Log:
    """Return a log with references interpolated where they come more slowly than the output."""
    if log.time is None:
        return log
    rate, heading = (None if values is None else between_values(log.time, values)
                     for values in (log.reference_rate, log.reference_heading))
    return replace(log, reference_rate=rate, reference_heading=heading)


def rests(log: Log) -> bool:
    """Tell whether a gyro rests all the time: by reference, moving flag, or its own output."""
    rate = reference_rate(log)
    if rate is not None:
        return not np.nanmax(np.abs(rate)) > 0.0 or _stands(log, rate)
    if log.moving is not None:
        return bool((log.moving == 0.0).all())
    if log.time is None or log.output is None or np.isfinite(log.output).sum() < FEWEST:
        return False
    second = np.floor(log.time - log.time[0]).astype(np.int64)
    second = np.unique(second, return_inverse=True)[1]
    means = np.bincount(second, bridged(log.output)) / np.bincount(second)
    return float(np.abs(means - np.median(means)).max()) < REST


def _stands(log: Log, rate: Array) -> bool:
    """Tell whether a reference is noise at rest: it turns nowhere, and no output follows it."""
    if log.time is None or log.output is None or log.moving is not None and log.moving.any():
        return False
    steps, whole = np.diff(log.time), bridged(rate)
    noise = white_noise(whole) * math.sqrt(float(np.median(steps) * steps.sum()))
    if np.ptp(np.cumsum(whole[1:] * steps)) > _STILL + _ADDED * noise:
        return False
    # In units of its own, for a rate of next to nothing would be lost beside the line's constant.
    line = line_between(log.time, rate / np.nanmax(np.abs(rate)), log.output)
    return line is None or abs(line.factor) < _FOLLOWED * line.deviation


def _refuse_table(log: Log, output: Array) -> None:
    rate = log.reference_rate
    rows = 0 if rate is None else int(np.count_nonzero(np.isfinite(rate) & np.isfinite(output)))
    if rows < FEWEST_ROWS:
        raise DataRefused(
            f'the log has no time_s, and {rows} rows with output and reference_rate_dps; '
            f'as a rate table it needs at least {FEWEST_ROWS}, and as samples in time it needs '
            'time_s: add rows, or give --rate')
    if rows > MOST_ROWS:
        raise DataRefused(
            f'the log has no time_s, and {rows} rows, where a rate table has at most {MOST_ROWS}: '
            'add time_s, or say with --rate how many samples a second it holds')


def _refuse_few(time: Array, output: Array) -> None:
    known = int(np.count_nonzero(np.isfinite(output)))
    if known < FEWEST or known < LEAST * len(output):
        raise DataRefused(
            f'the gyro has a value in {known} of {len(output)} samples; at least {FEWEST} and a '
            'tenth are needed: record again, and mend the line if it loses samples')
    if time[-1] - time[0] < SHORTEST:
        raise DataRefused(f'the log lasts {time[-1] - time[0]:.1f} s; '
                          f'a diagnosis wants at least {SHORTEST:g} s: record longer')
    if time[-1] - time[0] > LONGEST:
        raise DataRefused(f'the log lasts {time[-1] - time[0]:.3g} s by its stamps; '
                          'see whether time_s is in s, or give --rate')


def _refuse_without_reference(log: Log, output: Array) -> None:
    values = log.reference_heading if log.reference_rate is None else log.reference_rate
    if values is None and not rests(log):
        raise DataRefused(
            'the log has no reference, and the gyro is not at rest: add reference_rate_dps or '
            'reference_heading_deg, or let it rest, and say so with a column moving of zeros')
    if values is None:
        return
    known = np.isfinite(values)
    count, covered = (int(np.count_nonzero(each & np.isfinite(output)))
                      for each in (known, ~where_lost(known)))
    if count < FEWEST or covered < LEAST * len(output):
        raise DataRefused(
            f'the reference has a value in {count} of {len(output)} samples; at least {FEWEST} '
            'and a tenth are needed, or one at even intervals: mend its line and record again')


def _refuse_constant(output: Array) -> None:
    values, counts = np.unique(output[np.isfinite(output)], return_counts=True)
    share = counts.max() / counts.sum()
    if share > 0.99:
        raise DataRefused(
            f'the gyro gives {values[counts.argmax()] / DEGREE:.6g} deg/s in '
            f'{100.0 * share:.4g} % of the samples: it is dead, or its steps are coarser than all '
            'that it measures; check it, and record again')


def _refuse_copy(log: Log, output: Array) -> None:
    """Refuse a reference that was made from the output, or an output made from the reference."""
    for rate in _made_of(log):
        known = np.isfinite(rate) & np.isfinite(output)
        if np.count_nonzero(known) < FEWEST_ROWS or not np.ptp(rate[known]) > 0.0:
            continue
        slope, offset = np.polyfit(rate[known], output[known], 1)
        off, spread = (float(np.std(output[known] - slope * rate[known] - offset)),
                       float(np.std(output[known])))
        printed = math.hypot(codes_of(output[known]).step, slope * codes_of(rate[known]).step)
        if off < _COPY * spread or off < 0.5 * printed < _PRINT * spread:
            raise DataRefused(
                f'the output is {slope:.6g} times the reference plus {offset / DEGREE:.4g} deg/s, '
                'to the last digit: one is made of the other, without noise; give a reference of '
                'its own, or a simulation with noise')


def _made_of(log: Log) -> list[Array]:
    """Return the rates that an output made from the reference has: its rate, or heading steps."""
    rates = [] if log.reference_rate is None else [log.reference_rate]
    if log.reference_heading is None or log.time is None:
        return rates
    steps = np.diff(log.reference_heading) / np.diff(log.time)
    before, after = np.append(steps, np.nan), np.insert(steps, 0, np.nan)
    return [*rates, before, after, 0.5 * (before + after)]


def _refuse_units(log: Log, output: Array, model: GyroModel) -> None:
    """Refuse a model that is absurd for the log: most likely it was written in deg/s."""
    rate = reference_rate(log)
    line = None if rate is None else line_between(log.time, rate, output)
    if rate is not None and line is not None:
        scale = scale_of(model, rate)
        if not 0.1 < abs(scale) < 10.0:
            raise DataRefused(
                f'the model makes {scale:.4g} rad/s of each rad/s, which no gyro does: it is of '
                'other units; write it in rad/s, or fit it again')
    # By the reference, for the unit of the output may be wrong itself, which is a finding.
    fastest = float(np.nanquantile(np.abs(output if rate is None else rate), 0.99))
    widest = max(abs(limit) for limit in model.rate_range)
    if fastest > _TOO_FAST * widest:
        raise DataRefused(
            f'the model is for rates up to {widest / DEGREE:.4g} deg/s, and the log goes to '
            f'{fastest / DEGREE:.4g} deg/s: it is of other units, or of another gyro; '
            'write it in rad/s, or fit it again')
    if log.time is not None and model.noise.angle_random_walk > 0.0:
        _refuse_noise(white_noise(output) * math.sqrt(float(np.median(np.diff(log.time)))),
                      model.noise.angle_random_walk, rests(log))


def _refuse_noise(measured: float, simulated: float, resting: bool) -> None:
    """Refuse an angle random walk that is absurd, or, at rest, off by the ratio of deg and rad."""
    ratio = measured / simulated
    confused = resting and any(1.0 / _NEAR < ratio * factor < _NEAR
                               for factor in (DEGREE, 1.0 / DEGREE))
    if confused or not 1.0 / _ABSURD < ratio < _ABSURD:
        raise DataRefused(
            f'the log has {ratio:.3g} times the angle random walk of the model, {simulated:.3g} '
            'rad/√s: the model is of other units, or of another gyro; write its noise in rad/√s, '
            'or take it from `allan`')
