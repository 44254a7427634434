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
The logs of a fleet: of which unit, type and drive each is, by a table, file names or notes.

The record of a log has its calibration and its diagnosis.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
import csv
from dataclasses import asdict, dataclass, replace
from datetime import date
from glob import glob
import gzip
import hashlib
from itertools import takewhile
import json
import math
import os
from pathlib import Path
import re
from typing import Any

from gyro_calibration import __version__
from gyro_calibration.calibration.encoder import calibrate
from gyro_calibration.calibration.noise_grid import (
    bias_wander_columns, fit_noise_grid, heading_noise)
from gyro_calibration.calibration.selection import SelectedEffects
from gyro_calibration.diagnosis.gates import is_at_rest, refuse_mismatch, refuse_unusable
from gyro_calibration.diagnosis.log_diagnosis import diagnose
from gyro_calibration.diagnosis.report import render_report
from gyro_calibration.files import (
    describe_error, InputError, open_regular_file, read_bytes, sha256_digest, to_printable,
    write_atomically)
from gyro_calibration.heading.integration import integrate
from gyro_calibration.logs.columns import find_delimiter
from gyro_calibration.logs.log import DataRefused, Log, QUANTITIES
from gyro_calibration.logs.quality import white_noise_deviation
from gyro_calibration.logs.recording import read_file
from gyro_calibration.logs.ros_bag import list_recording_files
from gyro_calibration.model.effects import BIAS
from gyro_calibration.model.gyro_model import GyroModel, Term
from gyro_calibration.model.noise import Noise
import numpy as np

#: Fields of a log in a table, in addition to its path.
_ENTRY_KEYS = ('unit', 'type', 'drive', 'date', 'temperature')
_LOG_SUFFIXES = ('.csv', '.csv.gz', '.mcap', '.mcap.zstd', '.db3', '.db3.zstd')
_MAX_NOTE_BYTES = 4096  # largest number of bytes that are read of the notes of a log
#: Notes, such as "unit: 7".
_KEYED_NOTE = re.compile(rf'\b({"|".join(_ENTRY_KEYS)})\s*[:=]\s*([^,;#\s]+)', re.IGNORECASE)


@dataclass(frozen=True)
class FleetLog:
    """A log of a fleet; '' where a text is not known."""

    log: str  # its path
    unit: str = ''  # which gyro
    type: str = ''  # noqa: A003  of the gyro; logs of one type are pooled
    #: Name common to units that were moved together with one reference; '' for a log that is a
    #: drive of its own.
    drive: str = ''
    date: str = ''  # ISO 8601
    temperature: float | None = None  # degC

    def fill_missing(self, stated: Mapping[str, str]) -> FleetLog:
        new: dict[str, Any] = {name: to_printable(text.strip())
                               for name, text in stated.items() if name in _ENTRY_KEYS
                               and text.strip() and getattr(self, name) in ('', None)}
        if 'temperature' in new:
            text = new['temperature']
            try:
                value = new['temperature'] = float(re.sub(r'\s*(deg)?[°cC]*$', '', text))
            except ValueError:
                value = math.nan
            if not -273.15 <= value <= 1e4:
                raise InputError(f'{self.log}: its temperature is given as {text!r}; wanted degC')
        if 'date' in new:
            try:
                new['date'] = date.fromisoformat(new['date'][:10]).isoformat()
            except ValueError:
                raise InputError(f'{self.log}: its date is given as {new["date"]!r}; wanted such '
                                 'as 2026-03-01') from None
        return replace(self, **new)

    def merge(self, other: FleetLog) -> FleetLog:
        """Return the fields of one log by two tables; raise `InputError` where they differ."""
        new = {name: getattr(other, name) for name in _ENTRY_KEYS
               if getattr(other, name) not in ('', None)}
        for name, value in new.items():
            if getattr(self, name) not in ('', None, value):
                raise InputError(f'{self.log}: is listed twice, with {name} '
                                 f'{getattr(self, name)} and {value}; delete one line')
        return replace(self, **new)


def find_logs(paths: Sequence[str], excluded_folder: str | Path = '') -> list[FleetLog]:
    """
    Return the logs of files, folders, globs, lists (.txt) and tables (.csv with a column log).

    A table inside a folder is used as well; the results of a fleet, also in `excluded_folder`, are
    not. Raise `InputError` where there is none, or a table is wrong or contradicts another one.
    """
    found: dict[str, FleetLog] = {}
    visited = {os.path.realpath(excluded_folder)} if excluded_folder else set()
    for path in paths:
        for entry in _expand_path(path, visited):
            absolute_path = os.path.abspath(entry.log)
            found[absolute_path] = (found[absolute_path].merge(entry)
                                    if absolute_path in found else entry)
    if not found:
        raise InputError(f'{", ".join(map(str, paths))}: holds no log; logs end in '
                         f'{", ".join(_LOG_SUFFIXES)}, or are the folder of a ROS 2 recording')
    return list(found.values())


def _expand_path(path: str, visited: set[str]) -> Iterator[FleetLog]:
    """Give the logs of a path; a folder that was visited before, or holds results, has none."""
    if os.path.isdir(path):
        folder = Path(path)
        if os.path.realpath(folder) in visited or (folder / 'fleet.json').is_file():
            return
        visited.add(os.path.realpath(folder))
        if (folder / 'metadata.yaml').is_file():
            yield FleetLog(path)  # a recording
            return
        for inner in sorted(folder.iterdir()):
            if (inner.is_dir() or inner.name.lower().endswith(_LOG_SUFFIXES)
                    and not inner.name.startswith('.')):
                yield from _expand_path(str(inner), visited)
    elif not os.path.exists(path) and glob(path, recursive=True):
        for each in sorted(glob(path, recursive=True)):
            yield from _expand_path(each, visited)
    elif path.endswith('.txt'):
        yield from (FleetLog(_resolve_log_path(path, line.strip()))
                    for line in _read_text(path).splitlines()
                    if line.strip() and not line.strip().startswith('#'))
    elif path.endswith('.csv') and os.path.exists(path) and (columns := _read_header(path)):
        if (not set(columns) <= {'log', *_ENTRY_KEYS} or 'log' not in columns
                or len(set(columns)) < len(columns)):
            raise InputError(f'{path}: its columns are {", ".join(columns)}; wanted log and any '
                             f'of {", ".join(_ENTRY_KEYS)}, each once')
        first, *lines = _read_text(path).splitlines()
        for number, row in enumerate(csv.reader(lines, delimiter=find_delimiter(first)), 2):
            if not any(map(str.strip, row)):
                continue
            if len(row) != len(columns):
                raise InputError(f'{path}, line {number}: holds {len(row)} values, wanted '
                                 f'{len(columns)} as in its first line')
            stated = dict(zip(columns, map(str.strip, row)))
            if not stated['log']:
                raise InputError(f'{path}, line {number}: names no log')
            yield FleetLog(_resolve_log_path(path, stated['log'])).fill_missing(stated)
    else:
        yield FleetLog(path)


def _read_text(path: str) -> str:
    try:
        return read_bytes(path, 50_000_000).decode('utf-8-sig')
    except ValueError as error:
        raise InputError(f'{path}: {to_printable(error)}; give a text file in UTF-8') from error


def _read_header(path: str) -> list[str]:
    """Return the columns of a table of logs; none of another file, such as a log."""
    try:
        with open_regular_file(path) as file:
            line = file.readline(_MAX_NOTE_BYTES).decode('utf-8-sig', 'replace')
    except OSError:  # reported where the log is read
        return []
    columns = [name.strip().strip('"').lower() for name in line.split(find_delimiter(line))]
    is_log = any(name.startswith(('time', 'gyro')) for name in columns)
    return columns if 'log' in columns or set(_ENTRY_KEYS) & set(columns) and not is_log else []


def _resolve_log_path(path: str, log: str) -> str:
    """Return the path of a log in a table, relative to the table or to the working folder."""
    relative = Path(path).parent / log
    return str(relative) if relative.exists() or not Path(log).exists() else log


def compile_file_pattern(text: str) -> re.Pattern[str]:
    """Return the pattern of a name such as ``rc_car_{drive}_unit{unit}``, or `InputError`."""
    parts = re.split(r'\{(\w*)\}', text)
    unknown = [name for name in parts[1::2] if name not in _ENTRY_KEYS]
    if unknown or len(parts) < 3 or len(set(parts[1::2])) < len(parts[1::2]):
        raise InputError(f'{text}: wanted a file name with {{unit}}, and perhaps '
                         f'{", ".join(f"{{{name}}}" for name in _ENTRY_KEYS[1:])}, each once')
    return re.compile(''.join(f'(?P<{part}>.+?)' if place % 2 else re.escape(part)
                              for place, part in enumerate(parts)))


def describe_log(entry: FleetLog, file_pattern: re.Pattern[str] | None) -> FleetLog:
    """Return an entry with its empty fields filled from file name or notes."""
    # in order of precedence: table, pattern of the user, notes
    stem = re.sub(f'({"|".join(map(re.escape, sorted(_LOG_SUFFIXES, key=len, reverse=True)))})$',
                  '', Path(entry.log).name, flags=re.IGNORECASE)
    if file_pattern is not None and (found := file_pattern.fullmatch(stem)):
        entry = entry.fill_missing(found.groupdict())
    return entry.fill_missing(_read_notes(entry.log))


def _read_notes(path: str) -> dict[str, str]:
    """Return the fields in the notes of a log; none of a recording."""
    if os.path.isdir(path) or not path.lower().endswith(('.csv', '.csv.gz')):
        return {}
    with open_regular_file(path) as file:
        try:
            data = (gzip.GzipFile(fileobj=file).read(_MAX_NOTE_BYTES) if path.endswith('.gz')
                    else file.read(_MAX_NOTE_BYTES))
        except (OSError, EOFError):  # read again, and reported, where the log is read
            return {}
    lines = takewhile(lambda line: line.startswith('#'),
                      data.decode(errors='replace').splitlines())
    return {name.lower(): value
            for name, value in reversed(_KEYED_NOTE.findall('\n'.join(lines)))}


# the record of a log

#: Status of a log that was calibrated, and of one that is excluded.
DONE, NO_EVIDENCE = 'done', 'no evidence'
#: Schema of the records; records of another one are not read.
_SCHEMA = 'gyro_calibration/fleet_log/3'


def _fit_rest(log: Log) -> tuple[float, float]:
    """Return the bias of a log at rest, and its standard deviation beside its wander, rad/s."""
    output = np.asarray(log.output)
    known = np.isfinite(output)
    time = np.asarray(log.time)[known]
    if len(time) < 100 or time[-1] - time[0] < 60.0:  # white noise hides the wander of the bias
        raise DataRefused('rests for less than 60 s: record for longer')
    # 60 spans of at least 2 s
    edges = np.arange(time[0], time[-1] + 1e-9, max((time[-1] - time[0]) / 60.0, 2.0))
    increments = np.diff(np.interp(edges, time, integrate(time, output[known])))
    found = fit_noise_grid(increments, np.diff(edges)[:, None],
                           heading_noise(edges, np.zeros(len(edges)))[:1],
                           *bias_wander_columns(edges), wandering_value=0)
    return float(found.values[0]), float(found.deviations[0])


@dataclass(frozen=True)
class LogTask:
    entry: FleetLog
    folder: str  # of the results
    technology: str = 'mems'  # of the gyros, one of `selection.TECHNOLOGY_PRIORS`
    file_pattern: re.Pattern[str] | None = None  # by `compile_file_pattern`
    #: For the diagnosis, the same for each log; None without a diagnosis.
    generator: np.random.Generator | None = None
    default_type: str = ''  # of logs whose type is not stated
    sample_rate: float | None = None  # Hz, of logs without a usable time

    @property
    def record_path(self) -> Path:
        """Return the path of the stored record; its name is unique for the path of the log."""
        stem = re.sub(r'[^A-Za-z0-9_.-]', '_', Path(self.entry.log).name.partition('.')[0])
        path = os.path.abspath(self.entry.log).encode(errors='surrogateescape')
        name = f'{stem[:60]}-{hashlib.sha256(path).hexdigest()[:8]}.json'
        return Path(self.folder) / 'logs' / name


def process_log(task: LogTask) -> dict[str, Any]:
    """
    Return the record of a log, and store it; a stored record of the same content is used again.

    It is JSON data, equal to the bit on all machines: a ``status``, `DONE` or `NO_EVIDENCE` with a
    ``reason``; ``sha256`` of the file and ``content`` of its values; ``values`` by name, with
    standard deviation and unit; a summary of the ``diagnosis``.
    """
    try:
        entry = describe_log(task.entry, task.file_pattern).fill_missing(
            {'type': task.default_type})
        content = sha256_digest(*list_recording_files(task.entry.log))
        state = None if task.generator is None else task.generator.bit_generator.state
        identity = [_SCHEMA, __version__, task.technology, task.sample_rate, task.entry.log,
                    content, state]  # all that the record depends on
        key = hashlib.sha256(json.dumps(identity).encode()).hexdigest()
        found = None
        with suppress(OSError, ValueError, KeyError, TypeError):  # none, or of another version
            kept = json.loads(task.record_path.read_bytes())
            found = kept if kept['key'] == key else None
        if found is None:
            found = {'schema': _SCHEMA, 'key': key, 'sha256': content,
                     **_calibrate_and_diagnose(task)}
            write_atomically(task.record_path, json.dumps(found, allow_nan=False).encode())
        stated = _stated_fields(entry)
        if entry.temperature is None:
            stated['temperature'] = found['mean_temperature']
        return {**found, **stated}
    except (InputError, ArithmeticError, np.linalg.LinAlgError, OSError, MemoryError) as error:
        return make_refused_record(task.entry, _format_reason(error, task.entry.log))


def make_refused_record(entry: FleetLog, reason_text: str) -> dict[str, Any]:
    return {'schema': _SCHEMA, 'key': '', 'sha256': '', 'content': '', **_stated_fields(entry),
            'status': NO_EVIDENCE, 'reason': reason_text}


def _stated_fields(entry: FleetLog) -> dict[str, Any]:
    return {**asdict(entry), 'log': to_printable(entry.log)}


def _format_reason(error: Exception, path: str) -> str:
    if isinstance(error, MemoryError):
        return 'takes more memory than a worker may use; give --memory more, or a shorter log'
    if isinstance(error, InputError):
        return str(error).removeprefix(f'{to_printable(path)}: ')
    return describe_error(error)


def _calibrate_and_diagnose(task: LogTask) -> dict[str, Any]:
    path = task.entry.log
    log = read_file(path, rate=task.sample_rate)
    method, model, offset = _calibrate_log(log, task.technology)
    # by parameter where it is named as its effect
    values = {parameter.name if parameter.name == effect else f'{effect}.{parameter.name}':
              _value_record(value, deviation, parameter.unit)
              for effect, parameter, value, deviation in model.estimates()}
    if offset is not None:
        values['time_offset'] = _value_record(*offset, 's')
    temperature = (None if log.temperature is None or not np.isfinite(log.temperature).any()
                   else float(np.nanmean(log.temperature)))
    content = hashlib.sha256()
    for column in (getattr(log, quantity) for quantity in QUANTITIES):
        content.update(b'' if column is None else column.tobytes())
    found: dict[str, Any] = {
        'content': content.hexdigest(), 'mean_temperature': temperature, 'status': DONE,
        'reason': '', 'method': method, 'samples': len(log),
        'duration_s': None if log.time is None else float(log.time[-1] - log.time[0]),
        'values': values,
        'noise': {name: float(value) for name, value in vars(model.noise).items()},
        'diagnosis': None, 'page': ''}
    if task.generator is None:
        return found
    try:
        diagnosis = diagnose([log], task.generator, names=[to_printable(path)])
    except (DataRefused, ArithmeticError, np.linalg.LinAlgError) as error:
        found['diagnosis'] = {'verdict': 'refused', 'reason': _format_reason(error, path),
                              'findings': []}
        return found
    page = task.record_path.with_suffix('.html')
    write_atomically(page, render_report(diagnosis).encode())
    found['page'] = f'logs/{page.name}'
    found['diagnosis'] = {'verdict': diagnosis.verdict, 'reason': '', 'findings': [
        {'effect': each.effect, 'status': each.status, 'p_value': each.p_value,
         'ambiguous_with': list(each.ambiguous_with),
         'parameters': {name: value.to_dict() for name, value in each.parameters.items()}}
        for each in diagnosis.findings]}
    return found


def _value_record(value: float, deviation: float, unit: str) -> dict[str, Any]:
    return {'value': float(value), 'deviation': float(deviation), 'unit': unit}


def _calibrate_log(log: Log, technology: str) -> tuple[str, GyroModel, tuple[float, float] | None]:
    """Return method, model, and time offset of the reference of a log, s, with its deviation."""
    if log.output is None:
        raise DataRefused('holds gyro_counts alone; convert them to gyro_dps')
    refuse_mismatch(log)
    if log.time is None or log.reference_rate is not None or log.reference_heading is None:
        refuse_unusable(log)
        if log.time is not None and is_at_rest(log):
            bias, deviation = _fit_rest(log)
            walk = (white_noise_deviation(log.output, order=1)
                    * math.sqrt(float(np.median(np.diff(log.time)))))
            return 'rest', GyroModel((Term(BIAS, (bias,)),), np.array([[deviation ** 2]]),
                                     noise=Noise(angle_random_walk=walk)), None
    fitted = calibrate({'': log}, technology=technology)
    if isinstance(fitted, SelectedEffects):
        return 'dwells', fitted.model, None
    offset = fitted.fit.time_offset, fitted.fit.time_offset_deviation
    return fitted.method, fitted.model, None if math.isnan(offset[0]) else offset
