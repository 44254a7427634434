# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""From the records of logs to the errors of the type, the unit and the reference."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import date
import math
from typing import Any

from gyro_calibration.diagnosis.findings import Diagnosis, Estimate
from gyro_calibration.diagnosis.words import amount, listed, quantity, spoken
from gyro_calibration.files import plain
from gyro_calibration.fleet.pooling import (
    Change,
    changes,
    Component,
    DRIVES,
    Interval,
    Numbers,
    Observed,
    Outlier,
    outliers,
    OWN,
    Pooled,
    POWER_ONS,
    SLOPES,
    UNITS,
)
from gyro_calibration.logs.log import Array, DataRefused, NORMAL_95
from gyro_calibration.model.effects import CATALOGUE
from gyro_calibration.model.gyro_model import GyroModel, Term, Tolerance
from gyro_calibration.model.noise import Noise
import numpy as np
from numpy.typing import NDArray
from scipy.stats import binom

#: Probability of an alarm in a fleet without outliers, changes and missing effects.
FALSE_ALARMS = 0.01
Record = Mapping[str, Any]


@dataclass(frozen=True)
class Found:
    """
    One value of a type.

    Attributes
    ----------
    name, unit : of the value, in SI
    slow : whether it is an effect that one log does not distinguish from the wander of the bias
    records : of the logs that hold it
    pooled : its variances
    mean : of the type
    units : of each, as the mean over power-ons
    from_type : difference of each unit from the mean of the type
    next_log : prediction for a further power-on of each unit, without an error of the reference
    new_unit : prediction for one more unit of the type
    drives : error common to the logs of each drive, apart from type and unit
    slopes : name -> drift of the type, over age in years or over temperature in K
    unit_slopes : the same of each unit, where the logs determine the difference between units
    chance : p-value of the mean of the type against zero
    outlying_units, outlying_drives, changed : outliers and changes

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
    unit_slopes: Mapping[str, Interval]
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
    The results of one type.

    Attributes
    ----------
    name : of the type, or ''
    units, drives, dates : their names in the order of their numbers
    records : of the logs
    values : by name
    level : probability of a false alarm of each kind and value

    """

    name: str
    units: Sequence[str]
    drives: Sequence[str]
    dates: Sequence[str]
    records: Sequence[Record]
    values: Mapping[str, Found]
    level: float


def summarized(records: Sequence[Record]) -> list[TypeFound]:
    """
    Return the results of each type, by the records of logs that are not excluded.

    Parameters
    ----------
    records : as `work.done` returns them

    """
    types = sorted({str(each['type']) for each in records})
    logs = {kind: [each for each in records if each['type'] == kind] for kind in types}
    values = {kind: _names(logs[kind]) for kind in types}
    # four tests of each value: outlying units, outlying drives, changes, effects of the type; and
    # three of the effects of diagnoses: of the type, of a unit, of a drive
    tests = 4 * sum(map(len, values.values())) + 3 * len(types)
    return [_of_type(kind, logs[kind], values[kind], FALSE_ALARMS / tests) for kind in types]


def _names(records: Sequence[Record]) -> list[tuple[str, bool]]:
    """Return the values of logs, and whether each is a slow effect."""
    names = [(name, slow) for each in records for slow in (False, True)
             for name in each['slow' if slow else 'values']]
    counts = {name: names.count(name) for name in dict.fromkeys(names)}
    return [name for name, count in counts.items() if count > 1]


def _of_type(name: str, records: Sequence[Record], values: Sequence[tuple[str, bool]],
             level: float) -> TypeFound:
    def natural(text: str) -> tuple[int, str]:
        return len(text) if text.isdigit() else 0, text  # 2 before 10

    units, drives, dates = (sorted({str(each[key]) for each in records} - {''}, key=natural)
                            for key in ('unit', 'drive', 'date'))
    found = {}
    for value, slow in values:
        try:
            found[value] = _of_value(value, slow, records, units, drives, dates, level)
        except (DataRefused, np.linalg.LinAlgError):  # too few logs hold it
            continue
    return TypeFound(name, units, drives, dates, records, found, level)


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
    slopes, unit_slopes = {}, {}
    for place, covariate in enumerate(columns, 1):
        row = np.eye(1 + len(columns))[place:place + 1]
        slopes[covariate] = pooled.estimate(pooled.wanted(fixed=row))
        if SLOPES[place - 1] in pooled.names:
            unit_slopes[covariate] = pooled.estimate(pooled.wanted(
                unit=each, fixed=np.tile(row, (len(units), 1)), part=place))
    numbers = np.array([dates.index(one['date']) if one['date'] else -1 for one in held])
    return Found(
        name, held[0][key][name]['unit'], slow, held, pooled, pooled.estimate(mean),
        pooled.estimate(pooled.wanted(unit=each, fixed=rows)),
        pooled.estimate(pooled.wanted(unit=each, fixed=0.0 * rows)),
        pooled.estimate(pooled.wanted(unit=each, fixed=rows, power_ons=1.0)),
        pooled.estimate(pooled.wanted(fixed=fixed, units=1.0, power_ons=1.0)),
        pooled.estimate(pooled.wanted(drive=np.arange(len(drives)), fixed=none)),
        slopes, unit_slopes, float(pooled.chance(mean)[0]),
        outliers(observed, UNITS, level, pooled),
        outliers(observed, DRIVES, level, pooled), changes(observed, numbers, level, pooled))


def _observed(records: Sequence[Record], name: str, key: str, units: Sequence[str],
              drives: Sequence[str]) -> tuple[Observed, list[str]]:
    """Return a value over logs, and the names of its covariates, which are centred."""
    value, deviation = (np.array([each[key][name][what] for each in records])
                        for what in ('value', 'deviation'))
    unit = np.array([units.index(str(each['unit'])) for each in records])
    drive = np.array([drives.index(str(each['drive'])) if each['drive'] else -1
                      for each in records])
    days = [date.fromisoformat(each['date']).toordinal() for each in records if each['date']]
    warmth = [float(each['temperature']) for each in records if each['temperature'] is not None]
    columns = {covariate: column - column.mean() for covariate, column in (
        ('age', np.array(days) / 365.25), ('temperature', np.array(warmth)))
        if len(column) == len(records) and _varies(column, unit)}
    # slopes need logs enough in addition to the means of units
    if not columns or len(records) < len(set(unit.tolist())) + len(columns) + 2:
        return Observed(value, deviation, unit, drive), []
    return Observed(value, deviation, unit, drive, np.column_stack(list(columns.values())),
                    len(columns)), list(columns)


def _varies(column: Array, unit: Numbers) -> bool:
    """Tell whether a covariate varies within units."""
    centre = np.bincount(unit, column) / np.maximum(np.bincount(unit), 1)
    return bool(np.std(column - centre[unit]) > 1e-9 * (1.0 + np.abs(column).max()))


def in_words(of: Interval, place: int, unit: str, name: str) -> str:
    """Return a value with its interval, for people."""
    return str(quantity(Estimate(float(of.value[place]), (
        float(of.low[place]), float(of.high[place])), unit), name))


def sentences(found: TypeFound) -> Iterator[str]:
    """Give the sentences on the origin of each value, its outliers and its changes."""
    for each in found.values.values():
        yield from _shares(found, each)
    slow = [each for each in found.values.values() if each.slow]
    if repeating := lacking(found):
        first, *others = repeating
        names = listed([spoken(each.name) for each in others], 'or')
        also = f'; not distinguishable from {names}' if others else ''
        size = in_words(first.mean, 0, first.unit, first.name)
        yield (f'{spoken(first.name)}: it repeats in all units, so the model of the type lacks '
               f'it: {size}{also}')
    elif slow:
        yield (f'{listed([spoken(each.name) for each in slow])}: none repeats; in single logs '
               'they are the random walk of the bias')
    yield from (_of_count(each, len(found.units)) for each in counted(found))


def _shares(found: TypeFound, each: Found) -> Iterator[str]:
    """Give the origin of a value: unit, drive or power-on; then outliers and changes."""
    if not each.slow:
        shares = {name: each.components[name] for name in (UNITS, DRIVES, POWER_ONS)
                  if name in each.components}
        owner = max(shares, key=lambda name: shares[name].estimate, default='')
        whose = {UNITS: 'is an error of the unit: most of its variance is between units',
                 DRIVES: 'is an error of the reference or the vehicle: most of its variance is '
                 'between drives, and common to the units of a drive',
                 POWER_ONS: 'is not repeatable: most of its variance is between power-ons'}
        if owner and shares[owner].low > 0.0:
            yield f'{spoken(each.name)} {whose[owner]}'
    for outlier in each.outlying_units:
        yield (f'{spoken(each.name)}: unit {plain(found.units[outlier.number])} differs from its '
               f'type by {amount(outlier.excess, each.unit, each.name)} '
               f'(probability {outlier.chance:.1g})')
    for outlier in each.outlying_drives:
        yield (f'{spoken(each.name)}: all units of drive {plain(found.drives[outlier.number])} '
               f'deviate by {amount(outlier.excess, each.unit, each.name)}, an error of the '
               f'reference (probability {outlier.chance:.1g})')
    for change in each.changed:
        yield (f'{spoken(each.name)}: unit {plain(found.units[change.unit])} changed by '
               f'{amount(change.size, each.unit, each.name)} on {found.dates[change.since]} '
               f'(probability {change.chance:.1g})')


def lacking(found: TypeFound) -> list[Found]:
    """Return the slow effects that repeat in all units, the most significant first."""
    slow = [each for each in found.values.values() if each.slow and each.chance < found.level]
    return sorted(slow, key=lambda each: each.chance)


@dataclass(frozen=True)
class Counted:
    """
    An effect that diagnoses of single logs established, and that is not among the pooled values.

    Attributes
    ----------
    effect : its name
    logs, units, of : number of logs and of units that show it, and of logs that were diagnosed
    owner : of it, 'type', 'unit' or 'drive'; '' where false alarms explain the number of logs
    name : of the unit or drive
    chance : p-value of the number of logs under false alarms only, times the number of units or
        drives that it was chosen from

    """

    effect: str
    logs: int
    units: int
    of: int
    owner: str
    name: str
    chance: float


def counted(found: TypeFound) -> list[Counted]:
    """
    Assign the established effects of diagnoses by the numbers of logs that show them.

    A diagnosis names a false effect at a stated rate. An effect is assigned to the type where more
    logs show it than that rate explains, even without the unit, and without the drive, that show
    it most; else to the unit or the drive whose own logs show it more often.

    """
    logs = [each for each in found.records if each['diagnosis']]
    shown = [{one['effect'] for one in each['diagnosis']['findings']
              if one['status'] == 'established'} for each in logs]
    result = []
    for effect in sorted(set().union(*shown) - set(found.values)):
        has = np.array([effect in each for each in shown])
        rest, owners = [float(_by_chance(has))], []
        for kind in ('unit', 'drive'):
            other = 'drive' if kind == 'unit' else 'unit'
            groups = {str(each[kind]) for each in logs} - {''}
            own = {name: np.array([each[kind] == name for each in logs]) for name in groups}
            if len(groups) > 1:
                rest.append(max(_by_chance(has[~of]) for of in own.values()))
                # logs of one drive, or of one unit, do not distinguish the two
                owners += [(len(groups) * _by_chance(has[of]), kind, name)
                           for name, of in sorted(own.items())
                           if len({each[other] for each, one in zip(logs, of) if one}) > 1]
        whole = (max(rest), 'type', '') if len(rest) > 1 else (1.0, '', '')
        chance, owner, name = whole if whole[0] < found.level else min([*owners, whole])
        result.append(Counted(effect, int(has.sum()), len({
            each['unit'] for each, one in zip(logs, has) if one}), len(logs), *(
                (owner, name) if chance < found.level else ('', '')), min(chance, 1.0)))
    return result


def _by_chance(has: NDArray[np.bool_]) -> float:
    """Return the p-value of the number of logs with an effect under false alarms only."""
    return float(binom.sf(has.sum() - 1, len(has), Diagnosis.false_alarm_rate))


def _of_count(each: Counted, units: int) -> str:
    of_type = ('the references of all drives have it' if each.effect.startswith('reference_')
               else 'the model of the type lacks it')
    whose = {'type': of_type, '': 'within the rate of false alarms',
             'unit': f'assigned to unit {plain(each.name)}',
             'drive': f'assigned to drive {plain(each.name)}, its reference or its vehicle'}
    return (f'{spoken(each.effect)}: established in {each.logs} of {each.of} logs, of '
            f'{each.units} of {units} units: {whose[each.owner]}')


def data(found: TypeFound) -> dict[str, Any]:
    """Return the results of a type as JSON data."""
    return {'type': found.name, 'units': list(found.units), 'drives': list(found.drives),
            'logs': len(found.records), 'level': found.level,
            'values': {name: _value_data(found, each) for name, each in found.values.items()},
            'effects': [asdict(each) for each in counted(found)],
            'lacking': [each.name for each in lacking(found)],
            'sentences': list(sentences(found))}


def _value_data(found: TypeFound, each: Found) -> dict[str, Any]:
    held = {str(record['unit']) for record in each.records}
    spoken = {UNITS: 'between_units', POWER_ONS: 'between_power_ons', DRIVES: 'between_drives',
              OWN: 'own_share_of_errors',
              **{name: f'between_units_over_{over}' for name, over in zip(SLOPES, each.slopes)}}
    return {
        'unit': each.unit, 'slow': each.slow, 'logs': len(each.records),
        **{spoken[name]: {'estimate': part.estimate, 'ci95': [part.low, part.high]}
           for name, part in each.components.items()},
        'type_mean': _interval(each.mean, 0), 'new_unit': _interval(each.new_unit, 0),
        'chance_of_zero_mean': each.chance,
        'units': {name: {**_interval(each.units, place),
                         'from_type': _interval(each.from_type, place),
                         'next_power_on': _interval(each.next_log, place),
                         'slopes': {over: _interval(slope, place)
                                    for over, slope in each.unit_slopes.items()}}
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


def models(found: TypeFound) -> Iterator[tuple[str, GyroModel]]:
    """
    Give for a further unit of a type, with the name '', and for each unit: name and model.

    They hold the mean values, and as tolerance the deviation of a power-on from them, so that
    their interval of 95 % is that of the fleet. The compensation adds the tolerance until there is
    a self-calibration, which uses it as its prior (`GyroModel.prior`).

    """
    yield '', _model(found, None)
    for place, name in enumerate(found.units):
        yield name, _model(found, place)


def _model(found: TypeFound, unit: int | None) -> GyroModel:
    terms, variances = [], []
    spread = {'bias': 0.0, 'scale_factor_error': 0.0}
    for name, each in found.values.items():
        # the time offset of logs is that of their references
        if each.slow or name not in CATALOGUE or name == 'time_offset':
            continue
        effect = CATALOGUE[name]
        of, place = (each.new_unit, 0) if unit is None else (each.next_log, unit)
        low, high = float(of.low[place]), float(of.high[place])
        # of the normal distribution with this interval
        value, deviation = 0.5 * (high + low), 0.5 * (high - low) / NORMAL_95
        if effect.shapes or len(effect.parameters) > 1 or not math.isfinite(deviation):
            continue
        terms.append(Term(effect, (value,)))
        variances.append(0.0 if name in spread else deviation ** 2)
        if name in spread:
            spread[name] = deviation
    gyro = {'name': found.name, 'serial_number': '' if unit is None else found.units[unit]}
    logs = (len(found.records) if unit is None
            else sum(each['unit'] == found.units[unit] for each in found.records))
    noise = {name: float(np.median([each['noise'].get(name, 0.0) for each in found.records]))
             for name in Noise.__dataclass_fields__}
    return GyroModel(
        tuple(terms), np.diag(variances), noise=Noise(**noise),
        gyro={name: text for name, text in gyro.items() if text},
        origin={'fleet': {'units': len(found.units) if unit is None else 1, 'logs': logs}},
        tolerance=Tolerance(**spread))
