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
Dwells: stretches of constant rate, each one row of means, to which a calibration is fitted.

They are the rows of a rate table without time, or found in a log in time (`dwell_search`).

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math

from gyro_calibration.calibration.dwell_search import (
    find_dwell_rows,
    format_list,
    Numbers,
    require_output,
    Samples,
    SteadinessLimits,
)
from gyro_calibration.calibration.run_faults import (
    fit_scale,
    MAX_UNEXPLAINED_SHARE,
    refuse_unit_error,
)
from gyro_calibration.heading.integration import integrate
from gyro_calibration.logs.log import Array, DataRefused, DEGREE, Log, Mask
import numpy as np
from scipy.special import digamma, polygamma


@dataclass(frozen=True)
class Dwells:
    """
    Means over stretches of constant rate (Ojeda et al., eq. 5 to 7), each array of shape (n,).

    Attributes
    ----------
    rate : of the reference, rad/s
    output : of the gyro, rad/s
    temperature : degC; None where the log holds none
    deviation : standard deviation of the mean output against the mean reference, rad/s; nan where
        it is not known
    sweep : number of the sweep, or block of time, of each dwell; cross-validation leaves a sweep
        out as a whole
    location : of each dwell in its file, for messages
    remarks : on what was found and left out, one sentence each
    rows : of the log, whose mean each dwell is

    """

    rate: Array
    output: Array
    temperature: Array | None
    deviation: Array
    sweep: Numbers
    location: tuple[str, ...]
    remarks: tuple[str, ...] = ()
    rows: tuple[Numbers, ...] = ()

    def __len__(self) -> int:
        return len(self.rate)


def extract_dwells(log: Log, name: str = '') -> Dwells:
    """
    Return the dwells of a log: the rows of a rate table, or stretches of a log in time.

    Parameters
    ----------
    log : with output, and a reference rate or a reference heading
    name : of the file, put before the places and the remarks

    Raises
    ------
    DataRefused : output or reference are missing or in another unit, or nothing is steady

    """
    found = dwells_from_table(log) if log.time is None else find_dwells(log)
    unexplained, scale = fit_scale(found.output, found.rate)
    if unexplained <= MAX_UNEXPLAINED_SHARE and log.counts is None:  # of counts it is wanted
        refuse_unit_error(scale, 'reference')
    if not name:
        return found
    return replace(found, location=tuple(f'{name}: {place}' for place in found.location),
                   remarks=tuple(f'{name}: {remark}' for remark in found.remarks))


def select_dwells(dwells: Dwells, mask: Mask) -> Dwells:
    """Return some of the dwells, by a mask of shape (n,)."""
    temperature = None if dwells.temperature is None else dwells.temperature[mask]
    places = tuple(place for place, wanted in zip(dwells.location, mask) if wanted)
    rows = tuple(rows for rows, wanted in zip(dwells.rows, mask) if wanted)
    return replace(dwells, rate=dwells.rate[mask], output=dwells.output[mask],
                   temperature=temperature, deviation=dwells.deviation[mask],
                   sweep=dwells.sweep[mask], location=places, rows=rows)


def join_dwells(parts: Sequence[Dwells]) -> Dwells:
    """
    Return the dwells of several logs as one, with separate sweeps.

    They are without temperature where one of the logs has none.

    """
    if not parts:
        raise DataRefused('no dwells were given; give at least one log')
    first_sweep = np.cumsum([0] + [int(part.sweep.max()) + 1 for part in parts])
    temperatures = [part.temperature for part in parts if part.temperature is not None]
    has_temperature = len(temperatures) == len(parts)
    remarks = sum((part.remarks for part in parts), ())
    if temperatures and not has_temperature:
        remarks += (f'{len(parts) - len(temperatures)} of {len(parts)} logs hold no temperature, '
                    'so that of the others is not used',)
    return Dwells(np.concatenate([part.rate for part in parts]),
                  np.concatenate([part.output for part in parts]),
                  np.concatenate(temperatures) if has_temperature else None,
                  np.concatenate([part.deviation for part in parts]), np.concatenate(
                      [part.sweep + number for part, number in zip(parts, first_sweep)]),
                  sum((part.location for part in parts), ()), remarks,
                  sum((part.rows for part in parts), ()))


# rate tables

def dwells_from_table(log: Log) -> Dwells:
    """
    Return the rows of a rate table.

    The columns `sweep` (any text) and `deviation_dps` (of each mean) are used if present.

    Raises
    ------
    DataRefused : output or reference rate are missing, or no row holds both

    """
    output = require_output(log)
    if log.reference_rate is None:
        raise DataRefused('the rows have no time and no reference rate; a rate table needs the '
                          'column reference_rate_dps')
    good = np.isfinite(output) & np.isfinite(log.reference_rate)
    if not good.any():
        raise DataRefused(f'none of the {len(output)} rows holds both a gyro output and '
                          'a reference rate; check the columns')
    rows, lost = np.flatnonzero(good), np.flatnonzero(~good) + 1
    remark = (f'{len(lost)} rows without output or reference are left out: '
              f'{format_list([str(row) for row in lost])}')
    rate, names = log.reference_rate[rows], log.others.get('sweep')
    numbers = {name: number for number, name in enumerate(dict.fromkeys(names or ()))}
    sweep = (number_sweeps(rate) if names is None
             else np.array([numbers[names[row]] for row in rows]))
    return Dwells(rate, output[rows], None if log.temperature is None else log.temperature[rows],
                  _read_deviation_column(log)[rows], sweep,
                  tuple(f'row {row + 1}' for row in rows), (remark,) if len(lost) else (),
                  tuple(np.split(rows, len(rows))))


def _read_deviation_column(log: Log) -> Array:
    texts = log.others.get('deviation_dps')
    if texts is None:
        return np.full(len(log), np.nan)
    try:
        values = np.array(texts, dtype=float) * DEGREE
    except ValueError as error:
        raise DataRefused(f'column deviation_dps: {error}; wanted deg/s, '
                          'or nan where it is not known') from None
    return np.where(values > 0.0, values, np.nan)


def number_sweeps(rate: Array) -> Numbers:
    """
    Return the number of the sweep of each dwell, by the order of the rates, shape (n,).

    The rates of a sweep increase or decrease, or their absolute values do with changing sign, with
    or without a rest between them. Where the order shows no sweeps, that is where the median of
    them has less than four dwells, nine blocks of consecutive dwells are taken as sweeps.

    """
    turning = np.abs(rate) > max(1e-3 * np.abs(rate).max(), 0.01 * DEGREE)
    for used in (np.full(len(rate), True), turning) if turning.any() else ():
        for value in (rate, np.abs(rate)):
            sweep = np.zeros(len(rate), dtype=int)
            sweep[used] = _number_passes(value[used])
            # A rest belongs to the dwell before it.
            sweep = np.maximum.accumulate(np.where(used, sweep, 0))
            lengths = np.bincount(sweep[used])
            if len(lengths) > 1 and np.median(lengths) >= 4:
                return sweep
    return np.arange(len(rate)) * min(9, len(rate)) // len(rate)


def _number_passes(value: Array) -> Numbers:
    """Assign numbers to passes through values; a pass begins where the direction reverses."""
    change = np.diff(value)
    # Mean rates of opposite sign differ slightly in absolute value.
    steps = np.where(np.abs(change) > 0.005 * np.abs(value).max(), np.sign(change), 0.0)
    numbers = np.zeros(len(value), dtype=int)
    direction = 0.0
    for place, step in enumerate(steps, 1):
        is_reversed = step * direction < 0.0
        numbers[place] = numbers[place - 1] + is_reversed
        # The jump back to the start of the next pass does not show its direction.
        direction = 0.0 if is_reversed else direction or step
    return numbers


# logs in time

def find_dwells(log: Log, limits: SteadinessLimits | None = None) -> Dwells:
    """
    Find the dwells in a log in time.

    Raises
    ------
    DataRefused : output or reference are missing, or the reference is never steady for long enough

    """
    samples, dwells, remarks = find_dwell_rows(log, limits or SteadinessLimits())
    rate, output, deviation = _average(samples, dwells)
    time, temperature = samples.time, samples.temperature
    row = np.searchsorted(np.asarray(log.time), time)
    return Dwells(rate, output, None if temperature is None
                  else np.array([temperature[rows].mean() for rows in dwells]), deviation,
                  number_sweeps(rate),
                  tuple(f'{time[rows[0]]:.1f} to {time[rows[-1]]:.1f} s' for rows in dwells),
                  remarks, tuple(row[rows] for rows in dwells))


def _average(samples: Samples, dwells: Sequence[Numbers]) -> tuple[Array, Array, Array]:
    """
    Return reference rate, output and its standard deviation of each dwell (Ojeda et al., eq. 6).

    Heading and integral of the output are averaged with the same weights, so that deviations of
    the table from its steady rate are the same in both. The deviation is that of four to twelve
    batches of at least 0.75 s, in which a vibration of the table and the response of the gyro's
    filter average out; nan where it is not known.

    """
    durations = np.array([samples.duration(rows) for rows in dwells])
    batches = np.clip(durations / 0.75, 4, 12).astype(int)
    batches = np.minimum(batches, [max(4, len(rows) // 2) for rows in dwells])
    rate, output, blur, by_output, by_error = np.empty((5, len(dwells)))
    for place, rows in enumerate(dwells):
        reference = samples.heading[rows]
        angle = integrate(samples.time[rows], samples.output[rows])
        rate[place], output[place] = (samples.slope(rows, each) for each in (reference, angle))
        blur[place] = abs(samples.scale) * _encoder_deviation(
            reference, samples.step, durations[place])
        for variance, each in ((by_output, angle),
                               (by_error, angle - samples.scale * reference)):
            parts = np.array_split(np.arange(len(rows)), batches[place])
            slopes = [samples.slope(rows[part], each[part]) for part in parts]
            variance[place] = np.var(slopes, ddof=1) / len(parts)
    # Against a heading, the scatter of the output includes the motion of the table, that of the
    # error the steps of the encoder; the smaller one is used. Its product with the duration is the
    # same in all dwells under white noise.
    variance = (by_error if samples.rate is not None
                else min(by_output, by_error, key=np.median))
    deviation = np.sqrt(shrink_variances(variance * durations, batches - 1) / durations
                        + blur ** 2)
    return rate, output, np.where(deviation > 0.0, deviation, np.nan)


def _encoder_deviation(heading: Array, step: float, duration: float) -> float:
    """
    Return the standard deviation of a heading's slope, due to the steps of an encoder, rad/s.

    Over M steps it is about 0.35 step / (M duration), and below one step 0.6 step / duration (by
    simulation). Each step is observed late by up to a sample, which adds the square root of M over
    the number of samples. A heading that stays on one step for the whole dwell is taken as a rest.

    """
    if np.ptp(heading) <= 0.5 * step or step == 0.0:
        return 0.0
    steps, samples = abs(heading[-1] - heading[0]) / step, len(heading)
    return step / duration * math.hypot(
        0.35 / max(steps, 0.6), math.sqrt(min(steps, samples)) / samples)


def shrink_variances(variance: Array, dof: Array) -> Array:
    """
    Shrink variances toward their common value, by more if they are uncertain or agree.

    A variance of twelve batches has a standard error of 40 %; weights computed from it would be
    random, and the smallest variances would dominate the fit. Empirical Bayes: the logarithms are
    shrunk by the part of their scatter that the degrees of freedom explain (Smyth 2004, section
    6.2).

    Parameters
    ----------
    variance : shape (n,); 0 where it is not known
    dof : degrees of freedom of each, shape (n,)

    """
    known = variance > 0.0
    if known.sum() < 3:
        return variance
    half_dof = dof[known] / 2.0
    logarithm = np.log(variance[known]) - digamma(half_dof) + np.log(half_dof)
    chance = polygamma(1, half_dof)
    middle = float(np.average(logarithm, weights=half_dof))
    excess = max(float(logarithm.var(ddof=1) - chance.mean()), 0.0)
    shrunk = np.full(len(variance), math.exp(middle))
    shrunk[known] = np.exp(middle + (logarithm - middle) * excess / (excess + chance))
    return shrunk
