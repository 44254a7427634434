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

from gyro_calibration.calibration.dwells.averaging import average_dwells
from gyro_calibration.calibration.dwells.samples import format_list, Numbers, require_output
from gyro_calibration.calibration.dwells.steadiness import SteadinessLimits
from gyro_calibration.calibration.dwells.stretches import find_dwell_rows
from gyro_calibration.calibration.dwells.sweeps import number_named_sweeps, number_sweeps
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
    DataRefused : output or reference are missing, or nothing is steady

    """
    found = dwells_from_table(log) if log.time is None else find_dwells(log)
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
    sweep = (number_sweeps(rate)
             if names is None else number_named_sweeps([names[row] for row in rows]))
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


def find_dwells(log: Log, limits: SteadinessLimits | None = None) -> Dwells:
    """
    Find the dwells in a log in time.

    Raises
    ------
    DataRefused : output or reference are missing, or the reference is never steady for long enough

    """
    samples, dwells, remarks = find_dwell_rows(log, limits or SteadinessLimits())
    rate, output, deviation = average_dwells(samples, dwells)
    time, temperature = samples.time, samples.temperature
    row = np.searchsorted(np.asarray(log.time), time)
    return Dwells(rate, output, None if temperature is None
                  else np.array([temperature[rows].mean() for rows in dwells]), deviation,
                  number_sweeps(rate),
                  tuple(f'{time[rows[0]]:.1f} to {time[rows[-1]]:.1f} s' for rows in dwells),
                  remarks, tuple(row[rows] for rows in dwells))
