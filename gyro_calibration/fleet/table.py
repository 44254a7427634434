# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Which log is of which unit, type and drive: from a table, notes, metadata or file names."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
import csv
from dataclasses import dataclass, replace
from datetime import date
from glob import glob
import gzip
from itertools import takewhile
import math
import os
from pathlib import Path
import re
from typing import Any

from gyro_calibration.files import InputError, open_regular_file, read_bytes, to_printable
from gyro_calibration.logs.ros_bag import read_metadata
from gyro_calibration.model.settings_file import read_settings

#: Fields of a log in a table, in addition to its path.
ENTRY_KEYS = ('unit', 'type', 'drive', 'date', 'temperature')
#: Ends of files that are logs.
LOG_SUFFIXES = ('.csv', '.csv.gz', '.mcap', '.mcap.zstd', '.db3', '.db3.zstd')
#: Largest number of bytes that are read of the notes of a log.
_MAX_NOTE_BYTES = 4096
#: Notes and names, such as "unit: 7", "Movella DOT unit 1, drive h" and rc_car_h_unit1.csv.gz.
_KEYED_NOTE = re.compile(r'\b(unit|type|drive|date|temperature)\s*[:=]\s*([^,;#\s]+)',
                         re.IGNORECASE)
_WORDED_NOTE = re.compile(r'\b(unit|drive) (\w*\d\w*|[a-z](?=[,;.)]|$))',
                          re.IGNORECASE | re.MULTILINE)
_FILE_NAME_PATTERNS = {
    'unit': re.compile(r'(?:^|[_.-])(?:unit|sn)[_-]?([A-Za-z0-9]+)', re.IGNORECASE),
    'date': re.compile(r'(?:^|[_.-])(\d{4}-\d\d-\d\d)'),
    'drive': re.compile(r'(?:^|[_.-])drive[_-]?([A-Za-z0-9]+)', re.IGNORECASE)
}


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
        """Return the entry with its empty fields filled."""
        new: dict[str, Any] = {name: to_printable(text.strip())
                               for name, text in stated.items() if name in ENTRY_KEYS
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
        new = {name: getattr(other, name) for name in ENTRY_KEYS
               if getattr(other, name) not in ('', None)}
        for name, value in new.items():
            if getattr(self, name) not in ('', None, value):
                raise InputError(f'{self.log}: is listed twice, with {name} '
                                 f'{getattr(self, name)} and {value}; delete one line')
        return replace(self, **new)


def find_logs(paths: Sequence[str], excluded_folder: str | Path = '') -> list[FleetLog]:
    """
    Return the logs of files, folders, globs, lists (.txt) and tables (.csv with a column log).

    A log that is named several times is one entry. A table inside a folder is used as well; the
    results of an earlier fleet, and of this one in `excluded_folder`, are not.

    Raises
    ------
    InputError : there is none, or a table is wrong or contradicts another one
    OSError : a table cannot be read

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
                         f'{", ".join(LOG_SUFFIXES)}, or are the folder of a ROS 2 recording')
    return list(found.values())


def _expand_path(path: str, visited: set[str]) -> Iterator[FleetLog]:
    """Give the logs of a path; a folder that was visited before has none."""
    if os.path.isdir(path):
        yield from _search_folder(Path(path), visited)
    elif not os.path.exists(path) and glob(path, recursive=True):
        for each in sorted(glob(path, recursive=True)):
            yield from _expand_path(each, visited)
    elif path.endswith('.txt'):
        yield from (FleetLog(_resolve_log_path(path, line.strip()))
                    for line in _read_text(path).splitlines()
                    if line.strip() and not line.strip().startswith('#'))
    elif path.endswith('.csv') and os.path.exists(path) and (columns := _read_header(path)):
        yield from _read_rows(path, columns)
    else:
        yield FleetLog(path)


def _search_folder(folder: Path, visited: set[str]) -> Iterator[FleetLog]:
    """Give the logs in a folder and in those inside it; one with metadata.yaml is a recording."""
    if os.path.realpath(folder) in visited or (folder / 'fleet.json').is_file():
        return
    visited.add(os.path.realpath(folder))
    if (folder / 'metadata.yaml').is_file():
        yield FleetLog(str(folder))
        return
    for path in sorted(folder.iterdir()):
        if (path.is_dir() or path.name.lower().endswith(LOG_SUFFIXES)
                and not path.name.startswith('.')):
            yield from _expand_path(str(path), visited)


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
    columns = [name.strip().strip('"').lower() for name in line.split(_find_separator(line))]
    is_log = any(name.startswith(('time', 'gyro')) for name in columns)
    return columns if 'log' in columns or set(ENTRY_KEYS) & set(columns) and not is_log else []


def _find_separator(line: str) -> str:
    """Return the separator of values, as in a log: comma, semicolon or tab."""
    return max(',;\t', key=line.count)


def _resolve_log_path(path: str, log: str) -> str:
    """Return the path of a log in a table: relative to the table, or to the working folder."""
    relative = Path(path).parent / log
    return str(relative) if relative.exists() or not Path(log).exists() else log


def _read_rows(path: str, columns: Sequence[str]) -> Iterator[FleetLog]:
    if not set(columns) <= {'log', *ENTRY_KEYS} or 'log' not in columns or len(set(columns)) < len(
            columns):
        raise InputError(f'{path}: its columns are {", ".join(columns)}; wanted log and any of '
                         f'{", ".join(ENTRY_KEYS)}, each once')
    lines = _read_text(path).splitlines()
    rows = csv.reader(lines, delimiter=_find_separator(lines[0]))
    next(rows)
    for number, row in enumerate(rows, 2):
        if not any(map(str.strip, row)):
            continue
        if len(row) != len(columns):
            raise InputError(f'{path}, line {number}: holds {len(row)} values, wanted '
                             f'{len(columns)} as in its first line')
        stated = dict(zip(columns, row))
        log = stated.pop('log').strip()
        if not log:
            raise InputError(f'{path}, line {number}: names no log')
        yield FleetLog(_resolve_log_path(path, log)).fill_missing(stated)


def compile_file_pattern(text: str) -> re.Pattern[str]:
    """
    Return the regular expression of a file name such as ``rc_car_{drive}_unit{unit}``.

    Raises
    ------
    ValueError : it names no field, or an unknown one

    """
    parts = re.split(r'\{(\w*)\}', text)
    unknown = [name for name in parts[1::2] if name not in ENTRY_KEYS]
    if unknown or len(parts) < 3 or len(set(parts[1::2])) < len(parts[1::2]):
        raise ValueError(f'{text}: wanted a file name with {{unit}}, and perhaps '
                         f'{", ".join(f"{{{name}}}" for name in ENTRY_KEYS[1:])}, each once')
    return re.compile(''.join(f'(?P<{part}>.+?)' if place % 2 else re.escape(part)
                              for place, part in enumerate(parts)))


def describe_log(entry: FleetLog, file_pattern: re.Pattern[str] | None = None) -> FleetLog:
    """
    Return an entry with its empty fields filled from file name, notes or metadata.

    The order of precedence is: table, pattern of the user (by `compile_file_pattern`), notes and
    metadata, usual file names.

    """
    stem = re.sub(f'({"|".join(map(re.escape, sorted(LOG_SUFFIXES, key=len, reverse=True)))})$',
                  '', Path(entry.log).name, flags=re.IGNORECASE)
    if file_pattern is not None and (found := file_pattern.fullmatch(stem)):
        entry = entry.fill_missing(found.groupdict())
    stated, rest = {}, stem
    for name, shape in _FILE_NAME_PATTERNS.items():
        if found := shape.search(rest):
            stated[name] = found[1]
            rest = rest.replace(found[0], '')
    if 'unit' in stated and rest.strip('_.-'):  # the rest of the name is the drive
        stated.setdefault('drive', rest.strip('_.-'))
    return entry.fill_missing(_read_notes(entry.log)).fill_missing(stated)


def _read_notes(path: str) -> dict[str, str]:
    """Return the fields in the notes of a log, or in the metadata of a recording."""
    stated: dict[str, str] = {}
    recordings = [Path(path)] if path.endswith('.mcap') else []
    if os.path.isdir(path):
        recordings = sorted(Path(path).glob('*.mcap'))
        with suppress(OSError, ValueError, KeyError, TypeError, AttributeError):
            content = read_settings(Path(path) / 'metadata.yaml')
            custom = content['rosbag2_bagfile_information']['custom_data'] or {}
            stated.update({str(name).lower(): str(value) for name, value in custom.items()})
    for each in recordings:
        with suppress(OSError):  # reported where the log is read
            stated.update({name.lower(): value for name, value in read_metadata(each).items()})
    if os.path.isdir(path) or not path.lower().endswith(('.csv', '.csv.gz')):
        return stated
    with open_regular_file(path) as file:
        try:
            data = (gzip.GzipFile(fileobj=file).read(_MAX_NOTE_BYTES) if path.endswith('.gz')
                    else file.read(_MAX_NOTE_BYTES))
        except (OSError, EOFError):  # read again, and reported, where the log is read
            return {}
    lines = takewhile(lambda line: line.startswith('#'),
                      data.decode(errors='replace').splitlines())
    text = '\n'.join(lines)
    return {name.lower(): value for notes in (_WORDED_NOTE, _KEYED_NOTE)
            for name, value in reversed(notes.findall(text))}
