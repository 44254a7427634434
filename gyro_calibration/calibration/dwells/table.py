# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Dwells as a table: the rows of a rate table, or the dwells that are found in a log in time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from gyro_calibration.calibration.dwells.averaging import averaged
from gyro_calibration.calibration.dwells.samples import listed, Numbers, output_of
from gyro_calibration.calibration.dwells.steadiness import Steadiness
from gyro_calibration.calibration.dwells.stretches import find_stretches
from gyro_calibration.calibration.dwells.sweeps import numbered, sweeps
from gyro_calibration.logs.log import Array, DataRefused, DEGREE, Log, Mask
import numpy as np


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
    place : of each dwell in its file, for messages
    remarks : on what was found and left out, one sentence each
    rows : of the log, whose mean each dwell is

    """

    rate: Array
    output: Array
    temperature: Array | None
    deviation: Array
    sweep: Numbers
    place: tuple[str, ...]
    remarks: tuple[str, ...] = ()
    rows: tuple[Numbers, ...] = ()

    def __len__(self) -> int:
        return len(self.rate)


def dwells(log: Log, name: str = '') -> Dwells:
    """
    Return the dwells of a log: the rows of a rate table, or stretches of a log in time.

    Parameters
    ----------
    log : with output, and a reference rate or a reference heading
    name : of the file, put before the places and the remarks

    Raises
    ------
    DataRefused : output or reference are missing, or nothing is steady

    """
    found = from_table(log) if log.time is None else find_dwells(log)
    if not name:
        return found
    return replace(found, place=tuple(f'{name}: {place}' for place in found.place),
                   remarks=tuple(f'{name}: {remark}' for remark in found.remarks))


def take(dwells: Dwells, which: Mask) -> Dwells:
    """Return some of the dwells, by a mask of shape (n,)."""
    temperature = None if dwells.temperature is None else dwells.temperature[which]
    places = tuple(place for place, wanted in zip(dwells.place, which) if wanted)
    rows = tuple(rows for rows, wanted in zip(dwells.rows, which) if wanted)
    return replace(dwells, rate=dwells.rate[which], output=dwells.output[which],
                   temperature=temperature, deviation=dwells.deviation[which],
                   sweep=dwells.sweep[which], place=places, rows=rows)


def join(parts: Sequence[Dwells]) -> Dwells:
    """
    Return the dwells of several logs as one, with separate sweeps.

    They are without temperature where one of the logs has none.

    """
    if not parts:
        raise DataRefused('no dwells were given; give at least one log')
    first = np.cumsum([0] + [int(part.sweep.max()) + 1 for part in parts])
    temperatures = [part.temperature for part in parts if part.temperature is not None]
    whole = len(temperatures) == len(parts)
    remarks = sum((part.remarks for part in parts), ())
    if temperatures and not whole:
        remarks += (f'{len(parts) - len(temperatures)} of {len(parts)} logs hold no temperature, '
                    'so that of the others is not used',)
    return Dwells(np.concatenate([part.rate for part in parts]),
                  np.concatenate([part.output for part in parts]),
                  np.concatenate(temperatures) if whole else None,
                  np.concatenate([part.deviation for part in parts]),
                  np.concatenate([part.sweep + number for part, number in zip(parts, first)]),
                  sum((part.place for part in parts), ()), remarks,
                  sum((part.rows for part in parts), ()))


def from_table(log: Log) -> Dwells:
    """
    Return the rows of a rate table.

    The columns `sweep` (any text) and `deviation_dps` (of each mean) are used if present.

    Raises
    ------
    DataRefused : output or reference rate are missing, or no row holds both

    """
    output = output_of(log)
    if log.reference_rate is None:
        raise DataRefused('the rows have no time and no reference rate; a rate table needs the '
                          'column reference_rate_dps')
    good = np.isfinite(output) & np.isfinite(log.reference_rate)
    if not good.any():
        raise DataRefused(f'none of the {len(output)} rows holds both a gyro output and '
                          'a reference rate; check the columns')
    rows, lost = np.flatnonzero(good), np.flatnonzero(~good) + 1
    remark = (f'{len(lost)} rows without output or reference are left out: '
              f'{listed([str(row) for row in lost])}')
    rate, names = log.reference_rate[rows], log.others.get('sweep')
    sweep = sweeps(rate) if names is None else numbered([names[row] for row in rows])
    return Dwells(rate, output[rows], None if log.temperature is None else log.temperature[rows],
                  _told_deviation(log)[rows], sweep, tuple(f'row {row + 1}' for row in rows),
                  (remark,) if len(lost) else (), tuple(np.split(rows, len(rows))))


def _told_deviation(log: Log) -> Array:
    texts = log.others.get('deviation_dps')
    if texts is None:
        return np.full(len(log), np.nan)
    try:
        values = np.array(texts, dtype=float) * DEGREE
    except ValueError as error:
        raise DataRefused(f'column deviation_dps: {error}; wanted deg/s, '
                          'or nan where it is not known') from None
    return np.where(values > 0.0, values, np.nan)


def find_dwells(log: Log, limits: Steadiness | None = None) -> Dwells:
    """
    Find the dwells in a log in time.

    Raises
    ------
    DataRefused : output or reference are missing, or the reference is never steady for long enough

    """
    samples, dwells, remarks = find_stretches(log, limits or Steadiness())
    rate, output, deviation = averaged(samples, dwells)
    time, temperature = samples.time, samples.temperature
    row = np.searchsorted(np.asarray(log.time), time)
    return Dwells(rate, output,
                  None if temperature is None
                  else np.array([temperature[rows].mean() for rows in dwells]),
                  deviation, sweeps(rate),
                  tuple(f'{time[rows[0]]:.1f} to {time[rows[-1]]:.1f} s' for rows in dwells),
                  remarks, tuple(row[rows] for rows in dwells))
