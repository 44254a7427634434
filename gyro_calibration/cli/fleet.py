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
Calibrate and diagnose many logs, and attribute errors to unit, type and reference.

example: gyro_calibration fleet drives/ --out fleet
"""

import argparse
from collections.abc import Iterator, Sequence
from concurrent.futures import BrokenExecutor, Executor
from contextlib import contextmanager
from dataclasses import replace
import json
import os
from pathlib import Path
import re
from typing import Any

from gyro_calibration.calibration.selection import FALSE_ALARM_RATE, TECHNOLOGY_PRIORS
from gyro_calibration.cli import verb
from gyro_calibration.cli.verb import Answer, show_progress
from gyro_calibration.diagnosis.gates import is_degree_ratio
from gyro_calibration.diagnosis.words import wrap_line
from gyro_calibration.files import InputError, to_printable, write_atomically
from gyro_calibration.fleet.logs import (
    compile_file_pattern, DONE, find_logs, LogTask, make_refused_record, NO_EVIDENCE, process_log)
from gyro_calibration.fleet.run import cluster_executor, process_executor, run_tasks
from gyro_calibration.fleet.summary import (
    build_models, COMPONENT_LABELS, describe_type, log_table, summarize_types, TypeSummary)
from gyro_calibration.fleet.summary import data as type_data
from gyro_calibration.logs.log import DataRefused
from gyro_calibration.model.model_file import format_model
import numpy as np


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('logs', metavar='LOGS', nargs='+', help='logs, folders or globs of them, '
                        'a list (.txt), or a table (.csv) with the columns log and any of unit, '
                        'type, drive, date, temperature')
    parser.add_argument('--out', metavar='DIR', required=True, help='folder of the results; logs '
                        'with a result there are not processed again')
    parser.add_argument('--pattern', metavar='TEXT', help='pattern of the file names, without '
                        "endings, such as 'rc_car_{drive}_unit{unit}'")
    parser.add_argument('--type', metavar='NAME', dest='gyro_type',
                        help='type of the gyro in logs without a type')
    parser.add_argument('--rate', type=verb.positive_number, metavar='HZ',
                        help='sample rate, for logs without a usable time_s')
    parser.add_argument('--technology', choices=list(TECHNOLOGY_PRIORS), default='mems',
                        help='technology of the gyros; default: mems')
    parser.add_argument('--no-diagnosis', action='store_true', help='calibrate only; faster')
    parser.add_argument('--seed', type=verb.non_negative_integer, default=0, metavar='N',
                        help='seed of the noise that fills gaps of a log; default: 0')
    parser.add_argument('--workers', type=verb.positive_integer, metavar='N',
                        help='number of processes; default: one per core')
    parser.add_argument('--memory', type=verb.positive_number, metavar='GB',
                        help='limit per worker; default: an equal share of this machine')
    parser.add_argument('--scheduler', metavar='ADDRESS', help='address of a Dask cluster, such '
                        'as tcp://host:8786; its workers need the same files')


def run(given: argparse.Namespace) -> Answer:
    pattern = compile_file_pattern(given.pattern) if given.pattern else None
    logs = find_logs(given.logs, excluded_folder=given.out)
    folder = os.path.abspath(given.out)
    verb.require_folder(given.out)
    generator = None if given.no_diagnosis else np.random.default_rng(given.seed)
    tasks = [LogTask(entry, folder, given.technology, pattern, generator, given.gyro_type or '',
                     given.rate) for entry in logs]
    done: dict[str, dict[str, Any]] = {}
    workers = given.workers or len(os.sched_getaffinity(0))
    try:
        with (_make_executor(given, workers) as executor,
              show_progress(f'0 of {len(tasks)} logs') as on_progress):
            for task, record in run_tasks(process_log, tasks, executor):
                if not isinstance(record, dict):
                    reason = f'its worker failed ({type(record).__name__}: {str(record)[:200]})'
                    record = make_refused_record(task.entry, reason)
                done[task.entry.log] = record
                on_progress(len(done) / len(tasks), f'{len(done)} of {len(tasks)} logs')
    except BrokenExecutor:
        suspects = [each.entry.log for each in tasks if each.entry.log not in done]
        raise DataRefused(
            'a worker was killed, perhaps since memory ran out, by one of '
            f'{", ".join(suspects[:2 * workers])}: give --workers 1, or leave the log out, and '
            'run the same command again to continue') from None
    except KeyboardInterrupt:
        raise DataRefused(f'interrupted after {len(done)} of {len(tasks)} logs; run the same '
                          'command again to continue') from None
    records = _exclude_invalid([done[task.entry.log] for task in tasks])
    used = [each for each in records if each['status'] == DONE]
    if not used:
        first = records[0]
        raise DataRefused(f'none of {len(records)} logs can be used; '
                          f'{first["log"]}: {first["reason"]}')
    excluded = [each for each in records if each['status'] == NO_EVIDENCE]
    lines = [f'{len(used)} of {len(records)} logs are calibrated.']
    lines += [f'{each["log"]}: excluded, {each["reason"]}.' for each in excluded]
    with show_progress('units, types and references'):
        types = summarize_types(used)
    for found in types:
        lines += ['', *_type_lines(found)]
    data = {'schema': 'gyro_calibration/fleet/1', 'out': given.out, 'logs': len(records),
            'false_alarm_rate': FALSE_ALARM_RATE,
            'no_evidence': [{'log': each['log'], 'reason': each['reason']} for each in excluded],
            'types': [type_data(found) for found in types]}
    content = {'fleet.json': (json.dumps(data, indent=1, allow_nan=False) + '\n').encode(),
               'logs.csv': log_table(records).encode()}
    names = list(content)
    for found in types:
        for unit, model in build_models(found):
            words = [found.name or 'type', *(['unit', unit] if unit else [])]
            name = 'models/' + '-'.join(re.sub(r'[^\w.-]', '_', each)[:60] for each in words)
            while f'{name}.yaml' in content:
                name += '_'
            content[f'{name}.yaml'] = format_model(replace(
                model, origin={**model.origin, **verb.make_origin([])})).encode()
            names += [] if unit else [f'{name}.yaml']
    for name, text in content.items():
        write_atomically(Path(given.out) / name, text)
    lines += ['', f'Written to {given.out}: {", ".join(names)}.']
    return Answer(lines, data)


def _type_lines(found: TypeSummary) -> Iterator[str]:
    counts = ', '.join(f'{len(each)} {name}{"" if len(each) == 1 else "s"}' for each, name in (
        (found.records, 'log'), (found.units, 'unit'), (found.drives, 'drive')) if each)
    texts = [f'{found.name or "Type not stated, pooled as one"}: {counts}.']
    for value in found.values.values():
        parts = [f'{label} {value.format_component(name)}'
                 for name, label in COMPONENT_LABELS.items() if name in value.components]
        texts.append(f'  {value.name}: {value.format_interval(value.mean)}; {", ".join(parts)}')
        texts.append('    ' + '; '.join(
            f'unit {to_printable(name)} {value.format_interval(interval)}'
            for name, interval in value.units.items()))
    texts += [f'  {text}.' for text in describe_type(found)]
    yield from (wrap_line(each, 2 + len(each) - len(each.lstrip())) for each in texts)


@contextmanager
def _make_executor(given: argparse.Namespace, workers: int) -> Iterator[Executor]:
    if given.scheduler is None:
        machine = os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES')
        memory = 1e9 * given.memory if given.memory else 0.8 * machine / workers
        with process_executor(workers, memory, ['gyro_calibration.fleet.logs']) as executor:
            yield executor
        return
    try:
        with cluster_executor(given.scheduler) as executor:
            yield executor
    except ImportError:
        raise InputError('--scheduler needs distributed, which is not installed; install '
                         'gyro_calibration[fleet] or omit --scheduler') from None
    except (OSError, ValueError) as error:
        raise InputError(f'{given.scheduler}: no Dask scheduler answers there '
                         f'({type(error).__name__}); give its address, such as '
                         'tcp://host:8786') from None


def _exclude_invalid(records: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the records, with those excluded whose fault only the whole fleet shows."""
    copies: dict[str, list[dict[str, Any]]] = {}
    for each in sorted(records, key=lambda one: not one['unit']):
        copies.setdefault(each['content'], []).append(each)
    median_noise = {each['type']: float(np.median([
        _rest_noise(one) for one in records if _rest_noise(one) and one['type'] == each['type']]))
        for each in records if _rest_noise(each)}
    found = []
    for each in records:
        exclusion, first = '', copies[each['content']][0]
        other = next((one for one in copies[each['content']]
                      if one['unit'] and one['unit'] != each['unit']), None)
        if each['status'] == DONE and each['unit'] and other is not None:
            exclusion = (f'it is of unit {to_printable(each["unit"])} and has the values of '
                         f'{other["log"]}, of unit {to_printable(other["unit"])}: delete the '
                         'copy, or correct its unit')
        elif each['status'] == DONE and first is not each:
            exclusion = f'it is a copy of {first["log"]}'
        elif each['status'] == DONE and not each['unit']:
            exclusion = 'its unit is unknown; give a table or --pattern'
        elif (_rest_noise(each)
                and is_degree_ratio(ratio := _rest_noise(each) / median_noise[each['type']])):
            exclusion = (f'its white noise is {ratio:.3g} times the median of its type, as by '
                         'deg/s in place of rad/s; correct the unit of its column, or its type')
        found.append({**each, 'status': NO_EVIDENCE, 'reason': exclusion} if exclusion else each)
    return found


def _rest_noise(record: dict[str, Any]) -> float:
    """Return the angle random walk of a log at rest; 0 for other logs, whose motion adds to it."""
    return record['noise']['angle_random_walk'] if record.get('method') == 'rest' else 0.0
