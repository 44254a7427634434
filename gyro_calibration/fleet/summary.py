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

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import date
import math
from typing import Any

from gyro_calibration.calibration.selection import FALSE_ALARM_RATE
from gyro_calibration.diagnosis.findings import Estimate
from gyro_calibration.diagnosis.words import format_amount, format_quantity, readable_name
from gyro_calibration.files import format_rows, to_printable
from gyro_calibration.fleet.pooling import (
    Alarm, DRIVES, find_changes, find_outlying_groups, Interval, Observations, OWN_SHARE,
    PooledValue, POWER_ONS, SLOPES, UNITS)
from gyro_calibration.logs.log import Array, DataRefused, NORMAL_QUANTILE_975
from gyro_calibration.model.effects import CATALOGUE
from gyro_calibration.model.gyro_model import GyroModel, Term, Tolerance
from gyro_calibration.model.noise import Noise
import numpy as np
from numpy.typing import NDArray
from scipy.stats import binom

COMPONENT_LABELS = {UNITS: 'between units', POWER_ONS: 'between power-ons',
                    DRIVES: 'common to a drive'}
_LogRecord = Mapping[str, Any]


@dataclass(frozen=True)
class _ValueSummary:
    """One value of a type; mappings over units and drives hold those with a log that has it."""

    name: str
    unit: str  # of the value, in SI
    records: Sequence[_LogRecord]  # of the logs that hold it
    components: Mapping[str, Interval]  # standard deviations
    mean: Interval  # of the type
    p_value: float  # of the mean against zero
    new_unit: Interval  # prediction for one more unit of the type
    units: Mapping[str, Interval]  # of each, as the mean over power-ons
    type_deviation: Mapping[str, Interval]  # difference of each unit from the mean of the type
    #: Prediction for a further power-on of each unit, without an error of the reference.
    next_power_on: Mapping[str, Interval]
    drives: Mapping[str, Interval]  # error common to the logs of a drive, apart from type and unit
    slopes: Mapping[str, Interval]  # drift of the type over age, years, or temperature, K
    #: The same of each unit, where the logs determine the difference between units.
    unit_slopes: Mapping[str, Mapping[str, Interval]]
    outlying_units: Sequence[Alarm]
    outlying_drives: Sequence[Alarm]
    changes: Sequence[Alarm]

    def format_interval(self, interval: Interval, per: str = '') -> str:
        """Return an estimate of the value with its interval, or of its slope per unit of time."""
        return format_quantity(Estimate(interval.value, (interval.low, interval.high),
                                        self.unit + per), self.name)

    def format_component(self, name: str) -> str:
        """Return a standard deviation with its interval, or its bound where it may be zero."""
        if (component := self.components.get(name)) is None:
            return 'not shown'
        return (self.format_interval(component) if component.low > 0.0
                else f'less than {format_amount(component.high, self.unit, self.name)}')


@dataclass(frozen=True)
class TypeSummary:
    name: str  # or ''
    units: Sequence[str]  # names in natural order
    drives: Sequence[str]
    records: Sequence[_LogRecord]  # of the logs
    values: Mapping[str, _ValueSummary]
    significance: float  # probability of a false alarm of each kind and value


def summarize_types(records: Sequence[_LogRecord]) -> list[TypeSummary]:
    """Return the results of each type by records of `logs.process_log` that are not excluded."""
    types = sorted({str(each['type']) for each in records})
    logs = {kind: [each for each in records if each['type'] == kind] for kind in types}
    values = {}  # the names in more than one log
    for kind in types:
        names = [name for each in logs[kind] for name in each['values']]
        values[kind] = [name for name in dict.fromkeys(names) if names.count(name) > 1]
    # of each value outlying units, outlying drives, changes; of effects type, unit, drive
    tests = 3 * sum(map(len, values.values())) + 3 * len(types)
    summaries = []
    for kind in types:
        found = {}
        for value in values[kind]:
            try:
                found[value] = _summarize_value(value, logs[kind], FALSE_ALARM_RATE / tests)
            except (DataRefused, np.linalg.LinAlgError):  # too few logs hold it
                continue
        units, drives = (_names(logs[kind], key) for key in ('unit', 'drive'))
        summaries.append(TypeSummary(kind, units, drives, logs[kind], found,
                                     FALSE_ALARM_RATE / tests))
    return summaries


def _names(records: Sequence[_LogRecord], key: str) -> list[str]:
    """Return the names of units, drives or dates; 2 comes before 10."""
    return sorted({str(each[key]) for each in records} - {''},
                  key=lambda text: (len(text) if text.isdigit() else 0, text))


def _summarize_value(name: str, records: Sequence[_LogRecord],
                     significance: float) -> _ValueSummary:
    records = [each for each in records if name in each['values']]
    units, drives, dates = (_names(records, kind) for kind in ('unit', 'drive', 'date'))
    unit, drive, day = (
        np.array([names.index(str(each[kind])) if each[kind] else -1 for each in records])
        for kind, names in (('unit', units), ('drive', drives), ('date', dates)))
    value, deviation = (np.array([each['values'][name][what] for each in records])
                        for what in ('value', 'deviation'))
    # age, years, and temperature, K, less their means, where they vary within units
    columns = {}
    for over, known in (
            ('age', [date.fromisoformat(each['date']).toordinal() / 365.25
                     for each in records if each['date']]),
            ('temperature', [float(each['temperature'])
                             for each in records if each['temperature'] is not None])):
        if len(known) == len(records):
            column = np.array(known)
            within = column - (np.bincount(unit, column) / np.bincount(unit))[unit]
            if np.std(within) > 1e-9 * (1.0 + np.abs(column).max()):
                columns[over] = column - column.mean()
    if len(records) < len(set(unit.tolist())) + len(columns) + 2:
        columns = {}  # slopes need logs enough in addition to the means of units
    pooled = PooledValue(Observations(value, deviation, unit, drive, np.column_stack(
        [*columns.values()]) if columns else np.empty((0, 0)), len(columns)))

    def of_units(fixed: Array, **more: Any) -> dict[str, Interval]:
        return _by_name(units, pooled.estimate(unit=np.arange(len(units)),
                                               fixed=np.tile(fixed, (len(units), 1)), **more))

    def of_type(fixed: Array, **more: Any) -> Interval:
        return _by_name([''], pooled.estimate(fixed=fixed[None], **more))['']

    mean, *slopes = np.eye(1 + len(columns))
    found_drives = pooled.estimate(drive=np.arange(len(drives)),
                                   fixed=np.zeros((len(drives), len(mean))))
    return _ValueSummary(
        name, records[0]['values'][name]['unit'], records, pooled.components, of_type(mean),
        float(pooled.p_value(fixed=mean[None])[0]), of_type(mean, units=1.0, power_ons=1.0),
        of_units(mean), of_units(0.0 * mean), of_units(mean, power_ons=1.0),
        _by_name(drives, found_drives) if DRIVES in pooled.variance_names else {},
        {over: of_type(row) for over, row in zip(columns, slopes)},
        {over: of_units(row, part=part)
         for part, (over, row) in enumerate(zip(columns, slopes), 1)
         if SLOPES[part - 1] in pooled.variance_names},
        find_outlying_groups(pooled, UNITS, units, significance),
        find_outlying_groups(pooled, DRIVES, drives, significance),
        find_changes(pooled, day, units, dates, significance))


def _by_name(names: Sequence[str], found: Interval) -> dict[str, Interval]:
    return {name: Interval(*map(float, parts))
            for name, *parts in zip(names, *vars(found).values())}


def describe_type(summary: TypeSummary) -> Iterator[str]:
    meanings = {UNITS: 'is an error of the unit: most of its variance is between units',
                DRIVES: 'is an error of the reference or the vehicle: most of its variance is '
                'between drives, and common to the units of a drive',
                POWER_ONS: 'is not repeatable: most of its variance is between power-ons'}
    for value in summary.values.values():
        label = readable_name(value.name)
        shares = {name: value.components[name] for name in meanings if name in value.components}
        owner = max(shares, key=lambda name: shares[name].value, default='')
        if owner and shares[owner].low > 0.0:
            yield f'{label} {meanings[owner]}'
        for alarms, who, differs, of in (
                (value.outlying_units, 'unit', 'differs from its type by', ''),
                (value.outlying_drives, 'all units of drive', 'deviate by',
                 ', an error of the reference'),
                (value.changes, 'unit', 'changed by', '')):
            for alarm in alarms:
                since = f' on {alarm.since}' if alarm.since else ''
                yield (f'{label}: {who} {to_printable(alarm.name)} {differs} '
                       f'{format_amount(alarm.size, value.unit, value.name)}{since}{of} '
                       f'(probability {alarm.p_value:.1g})')
    for count in count_effects(summary):
        name = to_printable(count.name)
        of_type = ('the references of all drives have it' if count.effect.startswith('reference_')
                   else 'the model of the type lacks it')
        origin = {'type': of_type, '': 'within the rate of false alarms',
                  'unit': f'assigned to unit {name}',
                  'drive': f'assigned to drive {name}, its reference or its vehicle'}
        yield (f'{readable_name(count.effect)}: established in {count.logs} of {count.of} logs, '
               f'of {count.units} of {len(summary.units)} units: {origin[count.owner]}')


@dataclass(frozen=True)
class _EffectCount:
    """An effect that diagnoses of single logs established, and that is no pooled value."""

    effect: str
    logs: int  # that show it
    units: int  # that show it
    of: int  # logs that were diagnosed
    owner: str  # 'type', 'unit' or 'drive'; '' where false alarms explain the number of logs
    name: str  # of the unit or drive
    chance: float  # p-value of the number of logs under false alarms only, times the candidates


def count_effects(summary: TypeSummary) -> list[_EffectCount]:
    """
    Assign the established effects of diagnoses by the numbers of logs that show them.

    An effect is assigned to the type where more logs show it than the rate of false effects
    explains, even without the unit, and without the drive, that show it most; else to the unit or
    the drive whose own logs show it more often.
    """
    logs = [each for each in summary.records if each['diagnosis']]
    shown = [{one['effect'] for one in each['diagnosis']['findings']
              if one['status'] == 'established'} for each in logs]

    def p_value(shows: NDArray[np.bool_]) -> float:
        return float(binom.sf(shows.sum() - 1, len(shows), FALSE_ALARM_RATE))

    result = []
    for effect in sorted(set().union(*shown) - set(summary.values)):
        shows = np.array([effect in each for each in shown])
        type_chances, candidates = [p_value(shows)], []
        for kind, other in (('unit', 'drive'), ('drive', 'unit')):
            groups = {name: np.array([each[kind] == name for each in logs])
                      for name in _names(logs, kind)}
            if len(groups) < 2:
                continue
            type_chances.append(max(p_value(shows[~of]) for of in groups.values()))
            # logs of one drive, or of one unit, do not distinguish the two
            candidates += [(len(groups) * p_value(shows[of]), kind, name)
                           for name, of in groups.items()
                           if len({each[other] for each, one in zip(logs, of) if one}) > 1]
        of_type = (max(type_chances), 'type', '') if len(type_chances) > 1 else (1.0, '', '')
        chance, owner, name = (of_type if of_type[0] < summary.significance
                               else min([*candidates, of_type]))
        if chance >= summary.significance:
            owner = name = ''
        units = {each['unit'] for each, one in zip(logs, shows) if one}
        result.append(_EffectCount(effect, int(shows.sum()), len(units), len(logs), owner, name,
                                   min(chance, 1.0)))
    return result


def data(summary: TypeSummary) -> dict[str, Any]:
    values = {}
    for value in summary.values.values():
        keys = {UNITS: 'between_units', POWER_ONS: 'between_power_ons', DRIVES: 'between_drives',
                OWN_SHARE: 'own_share_of_errors',
                **{name: f'between_units_over_{over}' for name, over in zip(SLOPES, value.slopes)}}
        values[value.name] = {
            'unit': value.unit, 'logs': len(value.records),
            **{keys[name]: {'estimate': part.value, 'ci95': [part.low, part.high]}
               for name, part in value.components.items()},
            'type_mean': _interval_data(value.mean), 'new_unit': _interval_data(value.new_unit),
            'chance_of_zero_mean': value.p_value,
            'units': {name: {**_interval_data(interval),
                             'from_type': _interval_data(value.type_deviation[name]),
                             'next_power_on': _interval_data(value.next_power_on[name]),
                             'slopes': {over: _interval_data(slopes[name])
                                        for over, slopes in value.unit_slopes.items()}}
                      for name, interval in value.units.items()},
            'drives': {name: _interval_data(interval) for name, interval in value.drives.items()},
            'slopes': {name: _interval_data(slope) for name, slope in value.slopes.items()},
            'outlying_units': [each.to_dict() for each in value.outlying_units],
            'outlying_drives': [each.to_dict() for each in value.outlying_drives],
            'changed_units': [each.to_dict() for each in value.changes]}
    return {'type': summary.name, 'units': list(summary.units), 'drives': list(summary.drives),
            'logs': len(summary.records), 'level': summary.significance, 'values': values,
            'effects': [asdict(each) for each in count_effects(summary)],
            'sentences': list(describe_type(summary))}


def _interval_data(interval: Interval) -> dict[str, Any]:
    ends = [interval.low, interval.high]
    return {'estimate': interval.value, 'standard_deviation': interval.deviation,
            'ci95': ends if all(map(math.isfinite, ends)) else None}


def build_models(summary: TypeSummary) -> Iterator[tuple[str, GyroModel]]:
    """
    Give for a further unit of a type, with the name '', and for each unit: name and model.

    The tolerance is the deviation of a power-on from the mean values, so that their interval of 95
    % is that of the fleet. A self-calibration uses it as its prior.
    """
    for unit in ('', *summary.units):
        terms, variances, tolerances = [], [], {'bias': 0.0, 'scale_factor_error': 0.0}
        for name, each in summary.values.items():
            # the time offset of logs is that of their references
            if name not in CATALOGUE or name == 'time_offset':
                continue
            effect, found = CATALOGUE[name], each.next_power_on.get(unit, each.new_unit)
            # of the normal distribution with this interval
            deviation = 0.5 * (found.high - found.low) / NORMAL_QUANTILE_975
            if (effect.nonlinear_parameters or len(effect.parameters) > 1
                    or not math.isfinite(deviation)):
                continue
            terms.append(Term(effect, (0.5 * (found.high + found.low),)))
            variances.append(0.0 if name in tolerances else deviation ** 2)
            if name in tolerances:
                tolerances[name] = deviation
        gyro = {'name': summary.name, 'serial_number': unit}
        noise = {name: float(np.median([each['noise'].get(name, 0.0) for each in summary.records]))
                 for name in Noise.__dataclass_fields__}
        logs = [each for each in summary.records if unit in ('', each['unit'])]
        yield unit, GyroModel(
            tuple(terms), np.diag(variances), noise=Noise(**noise),
            gyro={name: text for name, text in gyro.items() if text},
            origin={'fleet': {'units': 1 if unit else len(summary.units), 'logs': len(logs)}},
            tolerance=Tolerance(**tolerances))


def log_table(records: Sequence[Mapping[str, Any]]) -> str:
    """Return the values of logs as CSV, one row a log, in SI."""
    rows = []
    for record in records:
        rows.append({key: record.get(key) for key in (
            'log', 'type', 'unit', 'drive', 'date', 'temperature', 'status', 'reason', 'method',
            'samples', 'duration_s', 'sha256', 'page')})
        for name, value in record.get('values', {}).items():
            rows[-1] |= {name: value['value'], f'{name}_deviation': value['deviation']}
    columns = dict.fromkeys(key for row in rows for key in row)
    return format_rows([columns, *([row.get(key) for key in columns] for row in rows)])
