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
A fleet: predicted drives, variances, alarms, smallest effects, scale and priors.

    python benchmarks/fleet.py drives FOLDER [OUT]    # rc_car_*.csv.gz of the wheeled drives
    python benchmarks/fleet.py first FOLDER [OUT]     # 20 s of each, with and without a prior
    python benchmarks/fleet.py variances slopes alarms smallest scale prior
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace
import sys
import tempfile
import time
from typing import Any

from gyro_calibration.calibration.self_calibration import ReferenceErrors, self_calibrate
from gyro_calibration.diagnosis.log_diagnosis import diagnose
from gyro_calibration.fleet.logs import (
    compile_file_pattern, find_logs, LogTask, process_log)
from gyro_calibration.fleet.pooling import (
    DRIVES, Observations, PooledValue, POWER_ONS, SLOPES, UNITS)
from gyro_calibration.fleet.run import process_executor, run_tasks
from gyro_calibration.fleet.summary import (
    build_models, count_effects, summarize_types)
from gyro_calibration.heading.integration import integrate
from gyro_calibration.heading.log_compensation import compensate_log
from gyro_calibration.logs.log import Array, DEGREE, Log, read_log, select_rows
from gyro_calibration.logs.quality import bridge_gaps
from gyro_calibration.model.gyro_model import GyroModel
from gyro_calibration.model.motion import motion_from_rates
import numpy as np
from numpy.random import Generator
from processes import calibrate, resident_memory
from scipy.special import ndtri
from scipy.stats import beta

#: Units, drives; standard deviations between units, drives and power-ons, and the stated error;
#: the share of the error that is a log's own.
FLEETS = ((5, 4, 0.44, 0.0, 0.01, 0.02, 0.5), (5, 4, 0.3, 0.5, 0.1, 0.7, 0.1),
          (4, 3, 0.0, 0.5, 0.3, 0.3, 1.0), (20, 5, 1.0, 0.5, 0.5, 0.3, 0.5))
Fleet = tuple[int, int, float, float, float, float, float]


def drawn(generator: Generator, fleet: Fleet) -> tuple[Observations, Array]:
    """Return values of a fleet whose type has the mean 3, and the true values of its units."""
    units, drives, between, common, power_on, error, own = fleet
    unit, drive = np.indices((units, drives)).reshape(2, -1)
    sigma = error * np.exp(0.3 * generator.standard_normal(len(unit)))
    true = 3.0 + between * generator.standard_normal(units)
    value = (true[unit] + common * generator.standard_normal(drives)[drive]
             + power_on * generator.standard_normal(len(unit))
             + np.sqrt(own) * sigma * generator.standard_normal(len(unit))
             + np.sqrt(1.0 - own) * error * generator.standard_normal(drives)[drive])
    return Observations(value, sigma, unit, drive), true


def variances(generator: Generator, fleets: int = 100) -> Iterator[str]:
    """Give how often the intervals of 95 % hold, and the root mean square of the estimates."""
    yield ('| units, drives | true: units, drives, power-ons | estimated | mean | units | '
           'one more |')
    yield '|---|---|---|---:|---:|---:|'
    for fleet in FLEETS:
        units, _, between, common, power_on, error, own = fleet
        true = {UNITS: between, DRIVES: np.hypot(common, np.sqrt(1.0 - own) * error),
                POWER_ONS: power_on}
        held: dict[str, list[Any]] = {name: [] for name in (*true, 'mean', 'unit', 'new')}
        estimates = []
        for _ in range(fleets):
            observed, values = drawn(generator, fleet)
            pooled = PooledValue(observed)
            found = pooled.components
            for name, value in true.items():
                held[name].append(found[name].low <= value <= found[name].high)
            estimates.append([found[name].value for name in true])
            for name, wanted, value in (
                    ('mean', {}, np.array([3.0])),
                    ('unit', {'unit': np.arange(units)}, values),
                    ('new', {'units': 1.0},
                     3.0 + between * generator.standard_normal(1))):
                interval = pooled.estimate(**wanted)
                held[name].extend((interval.low < value) & (value < interval.high))
        size = np.sqrt(np.mean(np.square(estimates), axis=0))
        yield (f'| {fleet[0]}, {fleet[1]} | ' + ', '.join(f'{each:.3g}' for each in true.values())
               + ' | ' + ', '.join(f'{each:.3g} ({100 * np.mean(held[name]):.0f} %)'
                                   for name, each in zip(true, size))
               + ''.join(f' | {100 * np.mean(held[name]):.1f} %' for name in
                         ('mean', 'unit', 'new')) + ' |')


def _processed(folder: str, out: str) -> list[dict[str, Any]]:
    """Return the records of the drives; what `fleet` has done in `out` is not done again."""
    with tempfile.TemporaryDirectory() as new:
        pattern = compile_file_pattern('{drive}_unit{unit}')
        return [process_log(LogTask(entry, out or new, file_pattern=pattern))
                for entry in find_logs([f'{folder}/rc_car_*'])]


def drives(folder: str, out: str = '') -> Iterator[str]:
    """Predict each log from the other drives, and from those and the other units of its drive."""
    records = _processed(folder, out)
    units, named = (sorted({each[key] for each in records}) for key in ('unit', 'drive'))
    unit, drive = (np.array([names.index(each[key]) for each in records])
                   for names, key in ((units, 'unit'), (named, 'drive')))
    yield ('| value | 0, rms | other units, rms | one other log, rms | drive left out, rms | '
           'held | log left out, rms | held | over 0, other units, one log |')
    yield '|---|---:|---:|---:|---:|---:|---:|---:|---|'
    for name, factor, spoken in (('bias', 1.0 / DEGREE, 'deg/s'),
                                 ('scale_factor_error', 100.0, '%'), ('time_offset', 1.0, 's')):
        value, sigma = (np.array([each['values'][name][what] for each in records])
                        for what in ('value', 'deviation'))
        of_type = [one - value[(unit != unit[place]) & (drive != drive[place])].mean()
                   for place, one in enumerate(value)]
        single = [value[place] - value[other] for place in range(len(value))
                  for other in np.flatnonzero(unit == unit[place]) if other != place]
        apart, alone = ([_predicted(value, sigma, unit, drive, left, known) for left in every]
                        for known, every in (
            (False, [drive == each for each in range(len(named))]),
            (True, np.eye(len(value), dtype=bool))))
        rms = [factor * np.sqrt(np.mean(np.square(each))) for each in (
            value, of_type, single, *(np.concatenate([one for one, _ in each])
                                      for each in (apart, alone)))]
        held = [np.concatenate([one for _, one in each]) for each in (apart, alone)]
        counts = [f'{each.sum()} of {len(each)}' for each in held]
        yield (f'| {name}, {spoken} | ' + ' | '.join(f'{each:.3g}' for each in rms[:4])
               + f' | {counts[0]} | {rms[4]:.3g} | {counts[1]} | '
               + ', '.join(f'{rms[4] / each:.2f}' for each in rms[:3]) + ' |')


def first(folder: str, out: str = '') -> Iterator[str]:
    """
    Diagnose 20 s of each log without a model, and with those of a fleet of other drives.

    The model of the type is that of the other units. The heading by the model that comes out is
    compared with the course over the next 60 s.
    """
    records = _processed(folder, out)
    error: dict[str, list[float]] = {}
    for record in records:
        log = read_log(record['log'])
        offset = record['values']['time_offset']['value']
        assert log.time is not None and log.reference_heading is not None
        begin = log.time[np.isfinite(log.reference_heading)][0]
        short = select_rows(log, (log.time >= begin) & (log.time <= begin + 20.0))
        others = [each for each in records if each['drive'] != record['drive']]
        (of_type,), (of_unit,) = (summarize_types(each) for each in (
            [each for each in others if each['unit'] != record['unit']], others))
        given = {'none': None, 'type': dict(build_models(of_type))[''],
                 'unit': dict(build_models(of_unit))[record['unit']]}
        for name, model in given.items():
            found = diagnose([short], np.random.default_rng(0), model).model
            for how, used in (('20 s', found), ('model alone', model)):
                if used is not None:
                    error.setdefault(f'{name}, {how}', []).append(
                        _error_over(log, used, begin + 20.0, offset))
        print(record['log'], {name: each[-1] / DEGREE for name, each in error.items()},
              file=sys.stderr)
    yield '| prior, what was fitted | heading error after 60 s, rms, deg | median |'
    yield '|---|---:|---:|'
    for name, each in sorted(error.items()):
        sizes = np.abs(each) / DEGREE
        yield f'| {name} | {np.sqrt(np.mean(sizes ** 2)):.2f} | {np.median(sizes):.2f} |'


def _error_over(log: Log, model: GyroModel, begin: float, offset: float) -> float:
    """Return by how much the heading is off after 60 s, rad, as means over 5 s of course."""
    assert log.time is not None and log.reference_heading is not None
    turned = integrate(log.time, bridge_gaps(compensate_log(model, log)))
    known = np.isfinite(log.reference_heading)
    at, course = log.time[known], log.reference_heading[known]
    left = np.interp(at + offset, log.time, turned) - course
    ends = [left[(at >= start) & (at < start + 5.0)] for start in (begin, begin + 60.0)]
    return float(np.mean(ends[1]) - np.mean(ends[0])) if all(map(len, ends)) else np.nan


def _predicted(value: Array, sigma: Array, unit: Any, drive: Any, left: Any, known: bool
               ) -> tuple[Array, Array]:
    """Return errors of predicted values of the logs that are left out, and whether they hold."""
    pooled = PooledValue(
        Observations(value[~left], sigma[~left], unit[~left],
                     drive[~left] if known else np.unique(drive[~left], return_inverse=True)[1]))
    found = pooled.estimate(unit=unit[left], error=sigma[left], power_ons=1.0,
                            **({'drive': drive[left]} if known else {'drives': 1.0}))
    return value[left] - found.value, (found.low < value[left]) & (value[left] < found.high)


def slopes(generator: Generator, fleets: int = 100) -> Iterator[str]:
    """Give how often intervals of 95 % hold of slopes over age and temperature, and of spreads."""
    yield ('| units, drives | slope over | true: of the type, between units | type | units | '
           'between units |')
    yield '|---|---|---|---:|---:|---:|'
    mean = np.array([0.3, -0.2])
    for fleet, between in (((5, 4, 1.0, 0.3, 0.3, 0.2, 1.0), np.array([0.5, 0.3])),
                           ((10, 6, 1.0, 0.5, 0.3, 0.2, 0.5), np.array([0.5, 0.3])),
                           ((10, 6, 1.0, 0.0, 0.3, 0.2, 1.0), np.zeros(2))):
        held: dict[str, list[Any]] = {}
        spreads = {UNITS: 1.0, DRIVES: np.hypot(fleet[3], np.sqrt(1.0 - fleet[6]) * fleet[5]),
                   POWER_ONS: fleet[4], **dict(zip(SLOPES, between))}
        for _ in range(fleets):
            observed, _ = drawn(generator, fleet)
            # all units have the age of the drive, and temperatures of their own
            columns = np.column_stack([observed.drive, generator.uniform(-2.0, 2.0,
                                                                         len(observed.value))])
            columns = columns - columns.mean(axis=0)
            true = mean + between * generator.standard_normal((fleet[0], 2))
            pooled = PooledValue(replace(
                observed, value=observed.value + np.sum(true[observed.unit] * columns, axis=1),
                columns=columns, slope_count=2))
            for name, value in spreads.items():
                of = pooled.components[name]
                held.setdefault(name, []).append(of.low <= value <= of.high)
            for place in range(2):
                row = np.eye(3)[1 + place:2 + place]
                of_type = pooled.estimate(fixed=row)
                of_units = pooled.estimate(
                    unit=np.arange(fleet[0]), fixed=np.tile(row, (fleet[0], 1)), part=1 + place)
                for name, interval, value in (('type', of_type, mean[place:place + 1]),
                                              ('units', of_units, true[:, place])):
                    held.setdefault(f'{name}_{place}', []).extend(
                        (interval.low < value) & (value < interval.high))
        for place, over in enumerate(('age', 'temperature')):
            yield (f'| {fleet[0]}, {fleet[1]} | {over} | {mean[place]}, {between[place]} | '
                   + ' | '.join(f'{100.0 * np.mean(held[name]):.1f} %' for name in (
                       f'type_{place}', f'units_{place}', SLOPES[place])) + ' |')
        yield (f'| {fleet[0]}, {fleet[1]} | none: units, drives, power-ons | '
               + ', '.join(f'{spreads[name]:.3g}' for name in (UNITS, DRIVES, POWER_ONS))
               + ' | | | ' + ', '.join(f'{100.0 * np.mean(held[name]):.1f} %' for name in (
                   UNITS, DRIVES, POWER_ONS)) + ' |')


def _records(generator: Generator, units: int, drives: int) -> list[dict[str, Any]]:
    """Return records of a fleet without outliers, with false alarms in 1 % of the diagnoses."""
    found = []
    size = {'bias': (0.4, 0.01, 0.01, 0.02), 'scale_factor_error': (0.3, 0.6, 0.1, 0.4),
            'time_offset': (0.0, 0.4, 0.02, 0.002)}
    values = {name: drawn(generator, (units, drives, *each, 0.5))[0]
              for name, each in size.items()}
    for place in range(units * drives):
        unit, drive = divmod(place, drives)
        of = {name: {'value': float(each.value[place]),
                     'deviation': float(each.deviation[place]), 'unit': '1'}
              for name, each in values.items()}
        false = ([{'effect': f'effect_{generator.integers(5)}', 'status': 'established'}]
                 if generator.random() < 0.01 else [])
        found.append({'log': str(place), 'unit': str(unit), 'type': '', 'drive': str(drive),
                      'date': f'2026-01-{drive + 1:02d}', 'temperature': None, 'noise': {},
                      'diagnosis': {'findings': false}, 'values': of})
    return found


def alarms(generator: Generator, fleets: int = 100) -> Iterator[str]:
    """Give how many fleets in which nothing is give any alarm; 1 % is stated."""
    yield '| units, drives | fleets | with an alarm | at most, with 95 % |'
    yield '|---|---:|---:|---:|'
    for units, count in ((5, 4), (16, 3), (30, 2)):
        found = 0
        for _ in range(fleets):
            (each,) = summarize_types(_records(generator, units, count))
            found += any(one.owner for one in count_effects(each)) or any(
                one.outlying_units or one.outlying_drives or one.changes
                for one in each.values.values())
        yield (f'| {units}, {count} | {fleets} | {found} | '
               f'{100.0 * beta.ppf(0.95, found + 1, fleets - found):.1f} % |')


def smallest(generator: Generator, fleets: int = 20) -> Iterator[str]:
    """Give the smallest effect of a type that is found, against the number of its units."""
    yield '| units, each on a drive of its own | smallest found | times root of units |'
    yield '|---:|---:|---:|'
    for units in (5, 10, 20, 40, 80, 160):
        sizes = []
        for _ in range(fleets):
            observed = Observations(generator.standard_normal(units), np.full(units, 0.3),
                                    np.arange(units), np.full(units, -1))
            pooled = PooledValue(observed)
            found = pooled.estimate()
            sizes.append(float(ndtri(0.995) * found.deviation[0]))
        yield f'| {units} | {np.mean(sizes):.3g} | {np.mean(sizes) * np.sqrt(units):.3g} |'


def scale(_: Generator, logs: int = 10_000) -> Iterator[str]:
    """Give the cost of a task, and the memory of the coordinator."""
    yield '| logs | CPU a log, ms: alone, worker, coordinator | memory, MB |'
    yield '|---:|---:|---|'
    alone = [_alone()]
    begin = time.process_time()
    memory, used = [], {}
    with process_executor(2, preload=['fleet', 'processes']) as executor:
        for number, (_, found) in enumerate(run_tasks(calibrate, range(logs), executor), 1):
            used[found[1]] = found[2]
            if number % max(logs // 4, 1) == 0:
                memory.append(resident_memory() / 1e6)
    own = time.process_time() - begin
    alone.append(_alone())  # a busy machine is slower at one time than at another
    cost = [1e3 * each for each in (np.mean(alone), sum(used.values()) / logs, own / logs)]
    yield (f'| {logs} | {", ".join(f"{each:.2f}" for each in cost)} | '
           f'{", ".join(f"{each:.0f}" for each in memory)} |')


def _alone(logs: int = 500) -> float:
    """Return the CPU time of a log in this process, s."""
    begin = time.process_time()
    for number in range(logs):
        calibrate(number)
    return (time.process_time() - begin) / logs


def prior(generator: Generator, runs: int = 40) -> Iterator[str]:
    """Give the errors of runs of 20 s of one more unit, without and with the prior of its type."""
    spread, slip = np.array([0.003, 0.05 * DEGREE]), 0.0058
    times = np.arange(0.0, 20.0, 0.02)
    motion = motion_from_rates(times, 0.5 * np.sin(2.0 * np.pi * times / 10.0))
    yield '| | scale factor error, rms, % | held | bias, rms, deg/s | held |'
    yield '|---|---:|---:|---:|---:|'
    found: dict[str, list[Any]] = {'without': [], 'with': []}
    for _ in range(runs):
        s, b = spread * generator.standard_normal(2)
        driven = 1.0 + slip * generator.standard_normal()
        noise = 3e-3 * generator.standard_normal(len(times))
        rate = (1.0 + s) * driven * motion.rate_at(times) + b + noise
        for name, known in (('without', None), ('with', spread)):
            fit = self_calibrate(times, rate, motion, reference=ReferenceErrors(slip), prior=known)
            error = np.array([fit.scale_factor_error - s, fit.bias - b])
            found[name].append([*error, *(np.abs(error) < 1.96 * np.sqrt(
                np.diag(fit.covariance)))])
    for name, rows in found.items():
        (s, b, *held) = (np.array(each, float) for each in zip(*rows))
        yield (f'| {name} prior | {100 * np.sqrt(np.mean(s ** 2)):.3f} | '
               f'{100 * np.mean(held[0]):.0f} % | {np.sqrt(np.mean(b ** 2)) / DEGREE:.4f} | '
               f'{100 * np.mean(held[1]):.0f} % |')


PARTS = {each.__name__: each for each in (variances, slopes, alarms, smallest, scale, prior)}


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('what', nargs='+', help='drives FOLDER, first FOLDER, or of '
                        f'{", ".join(PARTS)}')
    parser.add_argument('--seed', type=int, default=None, help='default: a fresh one')
    parser.add_argument('--fleets', type=int, help='as many, or runs')
    given = parser.parse_args(arguments)
    if given.what[0] in ('drives', 'first'):
        of_drives = drives if given.what[0] == 'drives' else first
        print('\n'.join(of_drives(*given.what[1:])))
        return
    for name in given.what:
        generator = np.random.default_rng(given.seed)
        print(f'{name}:\n')
        for line in PARTS[name](generator, *([given.fleets] if given.fleets else [])):
            print(line, flush=True)
        print()


if __name__ == '__main__':
    sys.exit(main())
