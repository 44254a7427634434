# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""From the records of logs to what is the type's, the unit's and the reference's."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import date
import math
from typing import Any

from gyro_calibration.diagnosis.findings import Estimate
from gyro_calibration.diagnosis.words import amount, listed, quantity, spoken
from gyro_calibration.files import plain
from gyro_calibration.fleet.outliers import Change, changes, Outlier, outliers
from gyro_calibration.fleet.pooling import (
    Component,
    DRIVES,
    Interval,
    Numbers,
    Observed,
    OWN,
    Pooled,
    POWER_ONS,
    UNITS,
)
from gyro_calibration.logs.log import Array, DataRefused
import numpy as np

#: Chance that a fleet in which nothing stands out, changes or is missing gives any alarm.
FALSE_ALARMS = 0.01
#: Kinds of alarms of a value: a unit, a drive, a change, and an effect of the type.
_KINDS = 4
_YEAR = 365.25
Record = Mapping[str, Any]


@dataclass(frozen=True)
class Found:
    """
    One value of a type.

    Attributes
    ----------
    name, unit : of the value, in SI
    slow : whether it is an effect that one log cannot tell from the wander of the bias
    records : of the logs that hold it
    pooled : its variances
    mean : of the type
    units : of each, as the mean over power-ons
    from_type : by how much each unit differs from the mean of the type
    next_log : what a further power-on of each unit will have, without an error of the reference
    new_unit : what one more unit of the type will have
    drives : what the logs of each drive have in common, beside type and unit
    slopes : name -> drift of the type, over age in years or over temperature in K
    chance : that the mean of the type is as far from zero by chance
    outlying_units, outlying_drives, changed : what stands out

    """

    name: str
    unit: str
    slow: bool
    records: Sequence[Record]
    pooled: Pooled
    mean: Interval
    units: Interval
    from_type: Interval
    next_log: Interval
    new_unit: Interval
    drives: Interval
    slopes: Mapping[str, Interval]
    chance: float
    outlying_units: Sequence[Outlier]
    outlying_drives: Sequence[Outlier]
    changed: Sequence[Change]

    @property
    def components(self) -> Mapping[str, Component]:
        """Return the standard deviations by name."""
        return self.pooled.components


@dataclass(frozen=True)
class TypeFound:
    """
    What is known of one type.

    Attributes
    ----------
    name : of the type, or ''
    units, drives, dates : their names in the order of their numbers
    records : of the logs
    values : by name
    level : chance of a false alarm of each kind and value

    """

    name: str
    units: Sequence[str]
    drives: Sequence[str]
    dates: Sequence[str]
    records: Sequence[Record]
    values: Mapping[str, Found]
    level: float


def summarized(records: Sequence[Record], false_alarms: float = FALSE_ALARMS) -> list[TypeFound]:
    """
    Return what is known of each type, by the records of logs that are evidence.

    Parameters
    ----------
    records : as `work.done` returns them
    false_alarms : chance that a fleet without any cause gives an alarm

    """
    types = sorted({str(each['type']) for each in records})
    named = {kind: [[each for each in records if each['type'] == kind]] for kind in types}
    values = {kind: _names(logs[0]) for kind, logs in named.items()}
    tests = max(_KINDS * sum(map(len, values.values())), 1)
    return [_of_type(kind, named[kind][0], values[kind], false_alarms / tests) for kind in types]


def _names(records: Sequence[Record]) -> list[tuple[str, bool]]:
    """Return the values of logs, and whether each is a slow effect."""
    names = [(name, slow) for each in records for slow in (False, True)
             for name in each['slow' if slow else 'values']]
    counts = {name: names.count(name) for name in dict.fromkeys(names)}
    return [name for name, count in counts.items() if count > 1]


def _of_type(name: str, records: Sequence[Record], values: Sequence[tuple[str, bool]],
             level: float) -> TypeFound:
    units, drives, dates = (sorted({str(each[key]) for each in records} - {''}, key=_natural)
                            for key in ('unit', 'drive', 'date'))
    found = {}
    for value, slow in values:
        try:
            found[value] = _of_value(value, slow, records, units, drives, dates, level)
        except (DataRefused, np.linalg.LinAlgError):  # too few logs hold it
            continue
    return TypeFound(name, units, drives, dates, records, found, level)


def _natural(text: str) -> tuple[int, str]:
    """Return what sorts 2 before 10."""
    return len(text) if text.isdigit() else 0, text


def _of_value(name: str, slow: bool, records: Sequence[Record], units: Sequence[str],
              drives: Sequence[str], dates: Sequence[str], level: float) -> Found:
    key = 'slow' if slow else 'values'
    held = [each for each in records if name in each[key]]
    observed, columns = _observed(held, name, key, units, drives)
    pooled = Pooled(observed)
    fixed = np.zeros((1, 1 + len(columns)))
    fixed[0, 0] = 1.0
    rows, none = np.tile(fixed, (len(units), 1)), 0.0 * np.tile(fixed, (len(drives), 1))
    each = np.arange(len(units))
    mean = pooled.wanted(fixed=fixed)
    slopes = {}
    for place, (covariate, (_, scale)) in enumerate(columns.items(), 1):
        row = np.zeros_like(fixed)
        row[0, place] = 1.0 / scale
        slopes[covariate] = pooled.estimate(pooled.wanted(fixed=row))
    numbers = np.array([dates.index(one['date']) if one['date'] else -1 for one in held])
    error = float(np.median(observed.deviation))
    return Found(
        name, held[0][key][name]['unit'], slow, held, pooled, pooled.estimate(mean),
        pooled.estimate(pooled.wanted(unit=each, fixed=rows)),
        pooled.estimate(pooled.wanted(unit=each, fixed=0.0 * rows)),
        pooled.estimate(pooled.wanted(unit=each, fixed=rows, power_ons=1.0)),
        pooled.estimate(pooled.wanted(fixed=fixed, units=1.0, power_ons=1.0)),
        pooled.estimate(pooled.wanted(drive=np.arange(len(drives)), fixed=none, error=error)),
        slopes, float(pooled.chance(mean)[0]), outliers(observed, UNITS, level, pooled),
        outliers(observed, DRIVES, level, pooled), changes(observed, numbers, level, pooled))


def _observed(records: Sequence[Record], name: str, key: str, units: Sequence[str],
              drives: Sequence[str]) -> tuple[Observed, dict[str, tuple[Array, float]]]:
    """Return a value over logs, and its covariates, centred, with the scale of each."""
    value, deviation = (np.array([each[key][name][what] for each in records])
                        for what in ('value', 'deviation'))
    unit = np.array([units.index(str(each['unit'])) for each in records])
    drive = np.array([drives.index(str(each['drive'])) if each['drive'] else -1
                      for each in records])
    columns = {}
    for covariate, column in (('age', _ages(records)), ('temperature', _temperatures(records))):
        if column is not None and (scale := _within(column, unit)) > 0.0:
            columns[covariate] = ((column - column.mean()) / scale, scale)
    more = (np.column_stack([column for column, _ in columns.values()]) if columns
            else np.empty((0, 0)))
    # slopes need logs enough beside the means of units
    if len(records) < len(set(unit.tolist())) + len(columns) + 2:
        more, columns = np.empty((0, 0)), {}
    return Observed(value, deviation, unit, drive, more), columns


def _ages(records: Sequence[Record]) -> Array | None:
    """Return the dates of logs in years; None where one has none."""
    if not all(each['date'] for each in records):
        return None
    return np.array([date.fromisoformat(each['date']).toordinal() / _YEAR for each in records])


def _temperatures(records: Sequence[Record]) -> Array | None:
    if any(each['temperature'] is None for each in records):
        return None
    return np.array([float(each['temperature']) for each in records])


def _within(column: Array, unit: Numbers) -> float:
    """Return how much a covariate varies within units; 0 where it is that of each unit."""
    centre = np.bincount(unit, column) / np.maximum(np.bincount(unit), 1)
    spread = float(np.std(column - centre[unit]))
    return spread if spread > 1e-9 * (1.0 + float(np.abs(column).max())) else 0.0


# who is to blame

def sentences(found: TypeFound) -> Iterator[str]:
    """Say whose each value is, and what stands out."""
    for each in found.values.values():
        yield from _blame(found, each)
    yield from _lacking(found)
    yield from (f'{spoken(name)}: {text}' for name, text in diagnosed(found))


def _blame(found: TypeFound, each: Found) -> Iterator[str]:
    """Say what a value owes to units, drives and power-ons, and which stand out."""
    if not each.slow:
        shares = {name: each.components[name] for name in (UNITS, DRIVES, POWER_ONS)
                  if name in each.components}
        owner = max(shares, key=lambda name: shares[name].estimate, default='')
        whose = {UNITS: "is the unit's: most of it differs between units and repeats",
                 DRIVES: "is the reference's or the vehicle's: most of it is common to the units "
                 'of a drive, and differs between drives',
                 POWER_ONS: 'differs most from one power-on to the next'}
        if owner and shares[owner].low > 0.0:
            yield f'{spoken(each.name)} {whose[owner]}'
    for outlier in each.outlying_units:
        yield (f'{spoken(each.name)}: unit {plain(found.units[outlier.number])} differs from its '
               f'type by {amount(outlier.excess, each.unit, each.name)} '
               f'(probability {outlier.chance:.1g})')
    for outlier in each.outlying_drives:
        yield (f'{spoken(each.name)}: all units of drive {plain(found.drives[outlier.number])} '
               f'are off by {amount(outlier.excess, each.unit, each.name)}, so its reference is '
               f'(probability {outlier.chance:.1g})')
    for change in each.changed:
        yield (f'{spoken(each.name)}: unit {plain(found.units[change.unit])} changed by '
               f'{amount(change.size, each.unit, each.name)} on {found.dates[change.since]} '
               f'(probability {change.chance:.1g})')


def lacking(found: TypeFound) -> list[Found]:
    """Return the slow effects that repeat in all units, the clearest first."""
    slow = [each for each in found.values.values() if each.slow and each.chance < found.level]
    return sorted(slow, key=lambda each: each.chance)


def _lacking(found: TypeFound) -> Iterator[str]:
    slow = [each for each in found.values.values() if each.slow]
    repeating = lacking(found)
    if repeating:
        first, *others = repeating
        also = (f'; {listed([spoken(each.name) for each in others], "or")} would look alike'
                if others else '')
        size = quantity(Estimate(float(first.mean.value[0]),
                                 (float(first.mean.low[0]), float(first.mean.high[0])),
                                 first.unit), first.name)
        yield (f'{spoken(first.name)}: it repeats in all units, so the model of the type lacks '
               f'it: {size}{also}')
    elif slow:
        yield (f'{listed([spoken(each.name) for each in slow])}: none repeats, so what single '
               'logs show of them is the wander of the bias')


def diagnosed(found: TypeFound) -> Iterator[tuple[str, str]]:
    """Give each established effect that is not among the pooled values, and whose it is."""
    seen: dict[str, list[Record]] = {}
    for each in found.records:
        for finding in (each['diagnosis'] or {}).get('findings', ()):
            if finding['status'] == 'established' and finding['effect'] not in found.values:
                seen.setdefault(finding['effect'], []).append(each)
    for effect, logs in seen.items():
        units, drives = ({str(each[key]) for each in logs} for key in ('unit', 'drive'))
        many = len(units) > 0.5 * len(found.units) and len(drives) > 0.5 * len(found.drives)
        whose = ("the type's" if many and len(units) > 1
                 else f"the unit's, {plain(min(units))}" if len(units) == 1 and len(drives) > 1
                 else f"the drive's, {plain(min(drives))}"
                 if len(drives) == 1 and len(units) > 1 and drives != {''} else 'not settled')
        yield effect, (f'established in {len(logs)} of {len(found.records)} logs, of {len(units)} '
                       f'of {len(found.units)} units: {whose}')


# as data

def data(found: TypeFound) -> dict[str, Any]:
    """Return what is known of a type as JSON can hold it."""
    return {'type': found.name, 'units': list(found.units), 'drives': list(found.drives),
            'logs': len(found.records), 'level': found.level,
            'values': {name: _value_data(found, each) for name, each in found.values.items()},
            'effects': [{'effect': effect, 'said': text} for effect, text in diagnosed(found)],
            'lacking': [each.name for each in lacking(found)],
            'sentences': list(sentences(found))}


def _value_data(found: TypeFound, each: Found) -> dict[str, Any]:
    held = {str(record['unit']) for record in each.records}
    spoken = {UNITS: 'between_units', POWER_ONS: 'between_power_ons', DRIVES: 'between_drives',
              OWN: 'own_share_of_errors'}
    return {
        'unit': each.unit, 'slow': each.slow, 'logs': len(each.records),
        **{spoken[name]: {'estimate': part.estimate, 'ci95': [part.low, part.high]}
           for name, part in each.components.items()},
        'type_mean': _interval(each.mean, 0), 'new_unit': _interval(each.new_unit, 0),
        'chance_of_zero_mean': each.chance,
        'units': {name: {**_interval(each.units, place),
                         'from_type': _interval(each.from_type, place),
                         'next_power_on': _interval(each.next_log, place)}
                  for place, name in enumerate(found.units) if name in held},
        'drives': {name: _interval(each.drives, place)
                   for place, name in enumerate(found.drives)} if DRIVES in each.pooled.names
        else {},
        'slopes': {name: _interval(slope, 0) for name, slope in each.slopes.items()},
        'outlying_units': [_alarm(found.units, one) for one in each.outlying_units],
        'outlying_drives': [_alarm(found.drives, one) for one in each.outlying_drives],
        'changed_units': [{'name': found.units[one.unit], 'since': found.dates[one.since],
                           'size': one.size, 'chance': one.chance} for one in each.changed]}


def _interval(of: Interval, place: int) -> dict[str, Any]:
    ends = [float(of.low[place]), float(of.high[place])]
    return {'estimate': float(of.value[place]), 'standard_deviation': float(of.deviation[place]),
            'ci95': ends if all(map(math.isfinite, ends)) else None}


def _alarm(names: Sequence[str], of: Outlier) -> dict[str, Any]:
    return {'name': names[of.number], 'excess': of.excess, 'chance': of.chance}
