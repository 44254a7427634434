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
from gyro_calibration.diagnosis.words import (
    format_amount,
    format_quantity,
    join_list,
    readable_name,
)
from gyro_calibration.files import to_printable
from gyro_calibration.fleet.pooling import (
    Change,
    Component,
    DRIVES,
    find_changes,
    find_outliers,
    IntegerArray,
    Interval,
    Observations,
    Outlier,
    OWN_SHARE,
    PooledValue,
    POWER_ONS,
    SLOPES,
    UNITS,
)
from gyro_calibration.logs.log import Array, DataRefused, NORMAL_QUANTILE_975
from gyro_calibration.model.effects import CATALOGUE
from gyro_calibration.model.gyro_model import GyroModel, Term, Tolerance
from gyro_calibration.model.noise import Noise
import numpy as np
from numpy.typing import NDArray
from scipy.stats import binom

#: Probability of an alarm in a fleet without outliers, changes and missing effects.
FALSE_ALARM_RATE = 0.01
Record = Mapping[str, Any]


@dataclass(frozen=True)
class ValueSummary:
    """
    One value of a type.

    Attributes
    ----------
    name, unit : of the value, in SI
    is_slow : whether it is an effect that one log does not distinguish from the wander of the bias
    records : of the logs that hold it
    pooled : its variances
    mean : of the type
    units : of each, as the mean over power-ons
    type_deviation : difference of each unit from the mean of the type
    next_power_on : prediction for a further power-on of each unit, without an error of the
        reference
    new_unit : prediction for one more unit of the type
    drives : error common to the logs of each drive, apart from type and unit
    slopes : name -> drift of the type, over age in years or over temperature in K
    unit_slopes : the same of each unit, where the logs determine the difference between units
    p_value : p-value of the mean of the type against zero
    outlying_units, outlying_drives, changes : outliers and changes

    """

    name: str
    unit: str
    is_slow: bool
    records: Sequence[Record]
    pooled: PooledValue
    mean: Interval
    units: Interval
    type_deviation: Interval
    next_power_on: Interval
    new_unit: Interval
    drives: Interval
    slopes: Mapping[str, Interval]
    unit_slopes: Mapping[str, Interval]
    p_value: float
    outlying_units: Sequence[Outlier]
    outlying_drives: Sequence[Outlier]
    changes: Sequence[Change]

    @property
    def components(self) -> Mapping[str, Component]:
        """Return the standard deviations by name."""
        return self.pooled.components


@dataclass(frozen=True)
class TypeSummary:
    """
    The results of one type.

    Attributes
    ----------
    name : of the type, or ''
    units, drives, dates : their names in the order of their numbers
    records : of the logs
    values : by name
    significance : probability of a false alarm of each kind and value

    """

    name: str
    units: Sequence[str]
    drives: Sequence[str]
    dates: Sequence[str]
    records: Sequence[Record]
    values: Mapping[str, ValueSummary]
    significance: float


def summarize_types(records: Sequence[Record]) -> list[TypeSummary]:
    """
    Return the results of each type, by the records of logs that are not excluded.

    Parameters
    ----------
    records : as `work.process_log` returns them

    """
    types = sorted({str(each['type']) for each in records})
    logs = {kind: [each for each in records if each['type'] == kind] for kind in types}
    values = {kind: _list_values(logs[kind]) for kind in types}
    # four tests of each value: outlying units, outlying drives, changes, effects of the type; and
    # three of the effects of diagnoses: of the type, of a unit, of a drive
    tests = 4 * sum(map(len, values.values())) + 3 * len(types)
    return [_summarize_type(kind, logs[kind], values[kind], FALSE_ALARM_RATE / tests)
            for kind in types]


def _list_values(records: Sequence[Record]) -> list[tuple[str, bool]]:
    """Return the values of logs, and whether each is a slow effect."""
    names = [(name, slow) for each in records for slow in (False, True)
             for name in each['slow' if slow else 'values']]
    counts = {name: names.count(name) for name in dict.fromkeys(names)}
    return [name for name, count in counts.items() if count > 1]


def _summarize_type(name: str, records: Sequence[Record], values: Sequence[tuple[str, bool]],
                    significance: float) -> TypeSummary:
    def natural_order(text: str) -> tuple[int, str]:
        return len(text) if text.isdigit() else 0, text  # 2 before 10

    units, drives, dates = (sorted({str(each[key]) for each in records} - {''}, key=natural_order)
                            for key in ('unit', 'drive', 'date'))
    found = {}
    for value, slow in values:
        try:
            found[value] = _summarize_value(value, slow, records, units, drives, dates,
                                            significance)
        except (DataRefused, np.linalg.LinAlgError):  # too few logs hold it
            continue
    return TypeSummary(name, units, drives, dates, records, found, significance)


def _summarize_value(name: str, slow: bool, records: Sequence[Record], units: Sequence[str],
                     drives: Sequence[str], dates: Sequence[str],
                     significance: float) -> ValueSummary:
    key = 'slow' if slow else 'values'
    value_records = [each for each in records if name in each[key]]
    observed, columns = _collect_observations(value_records, name, key, units, drives)
    pooled = PooledValue(observed)
    fixed = np.zeros((1, 1 + len(columns)))
    fixed[0, 0] = 1.0
    rows, zero_rows = np.tile(fixed, (len(units), 1)), 0.0 * np.tile(fixed, (len(drives), 1))
    unit_numbers = np.arange(len(units))
    mean = pooled.linear_functions(fixed=fixed)
    slopes, unit_slopes = {}, {}
    for place, covariate in enumerate(columns, 1):
        row = np.eye(1 + len(columns))[place:place + 1]
        slopes[covariate] = pooled.estimate(pooled.linear_functions(fixed=row))
        if SLOPES[place - 1] in pooled.variance_names:
            unit_slopes[covariate] = pooled.estimate(pooled.linear_functions(
                unit=unit_numbers, fixed=np.tile(row, (len(units), 1)), part=place))
    numbers = np.array([dates.index(one['date']) if one['date'] else -1 for one in value_records])
    return ValueSummary(
        name, value_records[0][key][name]['unit'], slow, value_records, pooled,
        pooled.estimate(mean),
        pooled.estimate(pooled.linear_functions(unit=unit_numbers, fixed=rows)),
        pooled.estimate(pooled.linear_functions(unit=unit_numbers, fixed=0.0 * rows)),
        pooled.estimate(pooled.linear_functions(unit=unit_numbers, fixed=rows, power_ons=1.0)),
        pooled.estimate(pooled.linear_functions(fixed=fixed, units=1.0, power_ons=1.0)),
        pooled.estimate(pooled.linear_functions(drive=np.arange(len(drives)), fixed=zero_rows)),
        slopes, unit_slopes, float(pooled.p_value(mean)[0]),
        find_outliers(observed, UNITS, significance, pooled),
        find_outliers(observed, DRIVES, significance, pooled),
        find_changes(observed, numbers, significance, pooled))


def _collect_observations(records: Sequence[Record], name: str, key: str, units: Sequence[str],
                          drives: Sequence[str]) -> tuple[Observations, list[str]]:
    """Return a value over logs, and the names of its covariates, which are centred."""
    value, deviation = (np.array([each[key][name][what] for each in records])
                        for what in ('value', 'deviation'))
    unit = np.array([units.index(str(each['unit'])) for each in records])
    drive = np.array([drives.index(str(each['drive'])) if each['drive'] else -1
                      for each in records])
    days = [date.fromisoformat(each['date']).toordinal() for each in records if each['date']]
    temperatures = [float(each['temperature'])
                    for each in records if each['temperature'] is not None]
    columns = {covariate: column - column.mean() for covariate, column in (
        ('age', np.array(days) / 365.25), ('temperature', np.array(temperatures)))
        if len(column) == len(records) and _varies_within_units(column, unit)}
    # slopes need logs enough in addition to the means of units
    if not columns or len(records) < len(set(unit.tolist())) + len(columns) + 2:
        return Observations(value, deviation, unit, drive), []
    return Observations(value, deviation, unit, drive, np.column_stack(list(columns.values())),
                        len(columns)), list(columns)


def _varies_within_units(column: Array, unit: IntegerArray) -> bool:
    """Tell whether a covariate varies within units."""
    centre = np.bincount(unit, column) / np.maximum(np.bincount(unit), 1)
    return bool(np.std(column - centre[unit]) > 1e-9 * (1.0 + np.abs(column).max()))


def format_interval(interval: Interval, index: int, unit: str, name: str) -> str:
    """Return a value with its interval, for people."""
    return str(format_quantity(Estimate(float(interval.value[index]), (
        float(interval.low[index]), float(interval.high[index])), unit), name))


def describe_type(summary: TypeSummary) -> Iterator[str]:
    """Give the sentences on the origin of each value, its outliers and its changes."""
    for each in summary.values.values():
        yield from _describe_value(summary, each)
    slow = [each for each in summary.values.values() if each.is_slow]
    if repeating := find_missing_effects(summary):
        first, *others = repeating
        names = join_list([readable_name(each.name) for each in others], 'or')
        alternatives = f'; not distinguishable from {names}' if others else ''
        size = format_interval(first.mean, 0, first.unit, first.name)
        yield (f'{readable_name(first.name)}: it repeats in all units, so the model of the type '
               f'lacks it: {size}{alternatives}')
    elif slow:
        yield (f'{join_list([readable_name(each.name) for each in slow])}: none repeats; in '
               'single logs they are the random walk of the bias')
    yield from (_describe_count(each, len(summary.units)) for each in count_effects(summary))


def _describe_value(summary: TypeSummary, value: ValueSummary) -> Iterator[str]:
    """Give the origin of a value: unit, drive or power-on; then outliers and changes."""
    if not value.is_slow:
        shares = {name: value.components[name] for name in (UNITS, DRIVES, POWER_ONS)
                  if name in value.components}
        owner = max(shares, key=lambda name: shares[name].estimate, default='')
        meanings = {UNITS: 'is an error of the unit: most of its variance is between units',
                    DRIVES: 'is an error of the reference or the vehicle: most of its variance is '
                    'between drives, and common to the units of a drive',
                    POWER_ONS: 'is not repeatable: most of its variance is between power-ons'}
        if owner and shares[owner].low > 0.0:
            yield f'{readable_name(value.name)} {meanings[owner]}'
    for outlier in value.outlying_units:
        yield (f'{readable_name(value.name)}: unit {to_printable(summary.units[outlier.group])} '
               f'differs from its type by {format_amount(outlier.excess, value.unit, value.name)} '
               f'(probability {outlier.p_value:.1g})')
    for outlier in value.outlying_drives:
        yield (f'{readable_name(value.name)}: all units of drive '
               f'{to_printable(summary.drives[outlier.group])} deviate by '
               f'{format_amount(outlier.excess, value.unit, value.name)}, an error of the '
               f'reference (probability {outlier.p_value:.1g})')
    for change in value.changes:
        yield (f'{readable_name(value.name)}: unit {to_printable(summary.units[change.unit])} '
               f'changed by {format_amount(change.size, value.unit, value.name)} on '
               f'{summary.dates[change.first_date]} (probability {change.p_value:.1g})')


def find_missing_effects(summary: TypeSummary) -> list[ValueSummary]:
    """Return the slow effects that repeat in all units, the most significant first."""
    slow = [each for each in summary.values.values()
            if each.is_slow and each.p_value < summary.significance]
    return sorted(slow, key=lambda each: each.p_value)


@dataclass(frozen=True)
class EffectCount:
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


def count_effects(summary: TypeSummary) -> list[EffectCount]:
    """
    Assign the established effects of diagnoses by the numbers of logs that show them.

    A diagnosis names a false effect at a stated rate. An effect is assigned to the type where more
    logs show it than that rate explains, even without the unit, and without the drive, that show
    it most; else to the unit or the drive whose own logs show it more often.

    """
    logs = [each for each in summary.records if each['diagnosis']]
    shown = [{one['effect'] for one in each['diagnosis']['findings']
              if one['status'] == 'established'} for each in logs]
    result = []
    for effect in sorted(set().union(*shown) - set(summary.values)):
        shows_effect = np.array([effect in each for each in shown])
        type_chances, owners = [float(_count_probability(shows_effect))], []
        for kind in ('unit', 'drive'):
            other = 'drive' if kind == 'unit' else 'unit'
            groups = {str(each[kind]) for each in logs} - {''}
            group_masks = {name: np.array([each[kind] == name for each in logs])
                           for name in groups}
            if len(groups) > 1:
                type_chances.append(
                    max(_count_probability(shows_effect[~of]) for of in group_masks.values()))
                # logs of one drive, or of one unit, do not distinguish the two
                owners += [(len(groups) * _count_probability(shows_effect[of]), kind, name)
                           for name, of in sorted(group_masks.items())
                           if len({each[other] for each, one in zip(logs, of) if one}) > 1]
        type_candidate = ((max(type_chances), 'type', '') if len(type_chances) > 1
                          else (1.0, '', ''))
        chance, owner, name = (type_candidate if type_candidate[0] < summary.significance
                               else min([*owners, type_candidate]))
        result.append(EffectCount(effect, int(shows_effect.sum()), len({
            each['unit'] for each, one in zip(logs, shows_effect) if one}), len(logs), *(
                (owner, name) if chance < summary.significance else ('', '')), min(chance, 1.0)))
    return result


def _count_probability(shows_effect: NDArray[np.bool_]) -> float:
    """Return the p-value of the number of logs with an effect under false alarms only."""
    return float(binom.sf(shows_effect.sum() - 1, len(shows_effect), Diagnosis.false_alarm_rate))


def _describe_count(effect_count: EffectCount, units: int) -> str:
    of_type = ('the references of all drives have it' if
               effect_count.effect.startswith('reference_') else 'the model of the type lacks it')
    owners = {'type': of_type, '': 'within the rate of false alarms',
              'unit': f'assigned to unit {to_printable(effect_count.name)}',
              'drive': f'assigned to drive {to_printable(effect_count.name)}, its reference or '
                       'its vehicle'}
    return (f'{readable_name(effect_count.effect)}: established in {effect_count.logs} of '
            f'{effect_count.of} logs, of '
            f'{effect_count.units} of {units} units: {owners[effect_count.owner]}')


def data(summary: TypeSummary) -> dict[str, Any]:
    """Return the results of a type as JSON data."""
    return {'type': summary.name, 'units': list(summary.units), 'drives': list(summary.drives),
            'logs': len(summary.records), 'level': summary.significance,
            'values': {name: _value_data(summary, each) for name, each in summary.values.items()},
            'effects': [asdict(each) for each in count_effects(summary)],
            'lacking': [each.name for each in find_missing_effects(summary)],
            'sentences': list(describe_type(summary))}


def _value_data(summary: TypeSummary, value: ValueSummary) -> dict[str, Any]:
    held = {str(record['unit']) for record in value.records}
    spoken = {UNITS: 'between_units', POWER_ONS: 'between_power_ons', DRIVES: 'between_drives',
              OWN_SHARE: 'own_share_of_errors',
              **{name: f'between_units_over_{over}' for name, over in zip(SLOPES, value.slopes)}}
    return {
        'unit': value.unit,
        'slow': value.is_slow,
        'logs': len(value.records),
        **{
            spoken[name]: {
                'estimate': part.estimate,
                'ci95': [part.low, part.high]
            } for name, part in value.components.items()
        }, 'type_mean': _interval_data(value.mean, 0),
        'new_unit': _interval_data(value.new_unit, 0),
        'chance_of_zero_mean': value.p_value,
        'units': {
            name: {
                **_interval_data(value.units, place), 'from_type': _interval_data(
                    value.type_deviation, place),
                'next_power_on': _interval_data(value.next_power_on, place),
                'slopes': {
                    over: _interval_data(slope, place)
                    for over, slope in value.unit_slopes.items()
                }
            } for place, name in enumerate(summary.units) if name in held
        },
        'drives': {
            name: _interval_data(value.drives, place) for place, name in enumerate(summary.drives)
        } if DRIVES in value.pooled.variance_names else {},
        'slopes': {
            name: _interval_data(slope, 0) for name, slope in value.slopes.items()
        },
        'outlying_units': [_alarm_data(summary.units, one) for one in value.outlying_units],
        'outlying_drives': [_alarm_data(summary.drives, one) for one in value.outlying_drives],
        'changed_units': [{
            'name': summary.units[one.unit],
            'since': summary.dates[one.first_date],
            'size': one.size,
            'chance': one.p_value
        } for one in value.changes]
    }


def _interval_data(interval: Interval, index: int) -> dict[str, Any]:
    ends = [float(interval.low[index]), float(interval.high[index])]
    return {'estimate': float(interval.value[index]),
            'standard_deviation': float(interval.deviation[index]),
            'ci95': ends if all(map(math.isfinite, ends)) else None}


def _alarm_data(names: Sequence[str], outlier: Outlier) -> dict[str, Any]:
    return {'name': names[outlier.group], 'excess': outlier.excess, 'chance': outlier.p_value}


def build_models(summary: TypeSummary) -> Iterator[tuple[str, GyroModel]]:
    """
    Give for a further unit of a type, with the name '', and for each unit: name and model.

    They hold the mean values, and as tolerance the deviation of a power-on from them, so that
    their interval of 95 % is that of the fleet. The compensation adds the tolerance until there is
    a self-calibration, which uses it as its prior (`GyroModel.prior_deviations`).

    """
    yield '', _build_model(summary, None)
    for place, name in enumerate(summary.units):
        yield name, _build_model(summary, place)


def _build_model(summary: TypeSummary, unit: int | None) -> GyroModel:
    terms, variances = [], []
    tolerances = {'bias': 0.0, 'scale_factor_error': 0.0}
    for name, each in summary.values.items():
        # the time offset of logs is that of their references
        if each.is_slow or name not in CATALOGUE or name == 'time_offset':
            continue
        effect = CATALOGUE[name]
        of, place = (each.new_unit, 0) if unit is None else (each.next_power_on, unit)
        low, high = float(of.low[place]), float(of.high[place])
        # of the normal distribution with this interval
        value, deviation = 0.5 * (high + low), 0.5 * (high - low) / NORMAL_QUANTILE_975
        if (effect.nonlinear_parameters or len(effect.parameters) > 1
                or not math.isfinite(deviation)):
            continue
        terms.append(Term(effect, (value,)))
        variances.append(0.0 if name in tolerances else deviation ** 2)
        if name in tolerances:
            tolerances[name] = deviation
    gyro = {'name': summary.name, 'serial_number': '' if unit is None else summary.units[unit]}
    logs = (len(summary.records) if unit is None
            else sum(each['unit'] == summary.units[unit] for each in summary.records))
    noise = {name: float(np.median([each['noise'].get(name, 0.0) for each in summary.records]))
             for name in Noise.__dataclass_fields__}
    return GyroModel(
        tuple(terms), np.diag(variances), noise=Noise(**noise),
        gyro={name: text for name, text in gyro.items() if text},
        origin={'fleet': {'units': len(summary.units) if unit is None else 1, 'logs': logs}},
        tolerance=Tolerance(**tolerances))
