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
Logs, read from CSV files and written to them.

A row is a sample or, without time, a dwell of a rate table. The header names columns and units.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
import csv
from dataclasses import dataclass, field, replace
from functools import partial
import gzip
import io
import itertools
import math
import os
from pathlib import Path
import reprlib
from typing import Any, NamedTuple
import zlib

from gyro_calibration.files import (
    describe_error, format_rows, InputError, MAX_EXPANSION_RATIO, MAX_MAGNITUDE,
    MIN_EXPANSION_BYTES, open_regular_file, open_replacement)
from gyro_calibration.logs.columns import (
    ATTITUDE, AXES, Column, COLUMNS, DEGREE, excerpt, find_columns, find_delimiter, QUANTITIES,
    ROTATIONS)
import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation

Array = NDArray[np.floating]
Mask = NDArray[np.bool_]
Number = Any  # a float, or an array of shape (n,): most formulas serve both

#: Half-width of the central 95 % interval of a normal distribution, standard deviations.
NORMAL_QUANTILE_975 = 1.96

#: Samples of a dozen columns that fit into the cache of a processor; memory is half as fast.
CACHE_BLOCK_SAMPLES = 32768
MIN_SAMPLE_INTERVAL = 1e-9  # least interval between samples, s
_MAX_LINE_LENGTH = 65536  # characters
_MAX_LOG_VALUES = 500_000_000  # in memory, 4 GB; a text counts as ten
#: Largest time of a sample, s; the stamps of this era in ms, us or ns are beyond it.
MAX_TIME = 1e12
_NULLABLE_QUANTITIES = ('output', 'counts', 'reference_rate', *ROTATIONS, *ATTITUDE)
#: Line numbers of the rows and the line after, quantity -> values in SI, other columns as text.
_ParsedRows = tuple[Sequence[int], dict[str, Array], dict[str, tuple[str, ...]]]


class LogError(InputError):
    """A file is not a log; the message names file, row and column."""


class DataRefused(InputError):
    """The data do not allow an answer; the message says why and what would."""


@dataclass(frozen=True, repr=False)
class Log:
    """
    A log: arrays in SI, each of shape (n,) or absent; masked values are lost ones.

    Raises
    ------
    LogError : for other shapes, values that are no numbers, and time that does not increase

    """

    time: Array | None = None  # s, increasing; without it the rows are dwells of a rate table
    output: Array | None = None  # output of the gyro, rad/s, counter-clockwise positive
    counts: Array | None = None  # raw output before any scaling, 1
    temperature: Array | None = None  # by the sensor of the gyro, degC
    # rad/s and rad; nan where the reference was lost; the heading is continuous
    reference_rate: Array | None = None
    reference_heading: Array | None = None
    specific_force: Array | None = None  # along the input axis, m/s²
    supply: Array | None = None  # V
    moving: Array | None = None  # 1 or 0
    # rotation of the reference about the next two axes of the sensor, rad; nan where lost
    cross_axis_1: Array | None = None
    cross_axis_2: Array | None = None
    notes: tuple[str, ...] = ()  # the lines before the header, without their '#'
    # other columns of the file, as text; the second of two equal names becomes `name.1`
    others: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        arrays = {quantity: _to_floats(quantity, values) for quantity in QUANTITIES
                  if (values := getattr(self, quantity)) is not None}
        _refuse_invalid(arrays, {})
        for quantity, values in arrays.items():
            object.__setattr__(self, quantity, values)

    def __len__(self) -> int:
        first = self.output if self.output is not None else self.counts
        return 0 if first is None else len(first)

    def __repr__(self) -> str:
        named = [quantity for quantity in QUANTITIES if getattr(self, quantity) is not None]
        return f'<Log: {len(self)} rows of {", ".join([*named, *self.others])}>'


def read_log(path: str | Path, sensitivity: float | None = None, rate: float | None = None,
             columns: Mapping[str, str] = {}, axis: str = 'z',
             on_progress: Callable[[int], object] | None = None) -> Log:
    """
    Read a log file (.csv or .csv.gz), with the parameters of `api.read_log`.

    Values are separated by commas or spaces, or by semicolons or tabs; then the decimal mark may
    be a comma. `on_progress` takes the number of bytes read. A `LogError` names file, row, column.
    """
    blocks: list[tuple[dict[str, Any], dict[str, tuple[str, ...]]]] = []
    count, last, compressed = 0, -math.inf, str(path).endswith('.gz')
    with _convert_read_errors(path), open_regular_file(path) as file, io.TextIOWrapper(
                gzip.GzipFile(fileobj=file) if compressed else file,  # type: ignore[arg-type]
                encoding='utf-8-sig', newline='') as text:
        lines = _iter_lines(text, ExpansionBudget(path) if compressed else None)
        table, first_line = _read_header(lines, columns, axis)
        if table.delimiter == ' ':  # of which there may be several
            lines = (' '.join(line.split()) + '\n' for line in lines)
        if rate is not None:
            table.columns.pop('time', None)
        while block := list(itertools.islice(lines, CACHE_BLOCK_SAMPLES)):
            places, arrays, others = (_parse_numeric_rows(block, first_line, table)
                                      or _parse_text_rows(block, lines, first_line, table))
            first_line, before, count = places[-1], count, count + len(places) - 1
            if count * (len(arrays) + 10 * len(others)) > _MAX_LOG_VALUES:
                raise LogError(f'has more than {_MAX_LOG_VALUES} numbers, the limit; split it')
            if rate is not None:
                arrays['time'] = np.arange(before, count) / rate
            last = _refuse_unordered_time(places, arrays.get('time'), last)
            if 'output' not in arrays and sensitivity is not None:
                arrays['output'] = arrays['counts'] * sensitivity
            if on_progress is not None:
                on_progress(file.tell())
            blocks.append((arrays, others))
        if count < 2:
            raise LogError(f'has {count} of the 2 rows of data that are needed; record more')
    arrays = {quantity: np.concatenate([part[quantity] for part, _ in blocks])
              for quantity in arrays}
    _replace_attitude(arrays, axis)
    return Log(**arrays, notes=table.notes, others={
        name: tuple(itertools.chain.from_iterable(texts[name] for _, texts in blocks))
        for name in others})


class ExpansionBudget:
    """The number of bytes to which the content of a compressed file may expand."""

    def __init__(self, path: str | Path):
        self._remaining = MIN_EXPANSION_BYTES + MAX_EXPANSION_RATIO * os.stat(path).st_size

    def spend(self, size: int) -> None:
        """Count bytes, and raise `LogError` beyond the limit."""
        self._remaining -= size
        if self._remaining < 0:
            raise LogError(f'decompresses to more than {MAX_EXPANSION_RATIO} times its size, the '
                           'limit; decompress it first')


@contextmanager
def _convert_read_errors(path: str | Path) -> Iterator[None]:
    """Put the name of the file before each error."""
    try:
        yield
    except InputError as error:
        raise LogError(f'{path}: {error}') from None
    except UnicodeDecodeError as error:
        code = 'UTF-16' if error.object[:1] in (b'\xff', b'\xfe') else 'WINDOWS-1252'
        raise LogError(f'{path}: is not text in UTF-8; convert it, as by iconv -f {code} '
                       f'-t UTF-8 {path} > log.csv') from error
    except (OSError, EOFError, zlib.error, csv.Error) as error:
        raise LogError(f'{path}: cannot be read as a log ({describe_error(error)}); '
                       'wanted a CSV file, .csv or .csv.gz') from error


def _iter_lines(text: io.TextIOWrapper, budget: ExpansionBudget | None) -> Iterator[str]:
    """Give the lines of a file, without empty ones at its end."""
    empty: list[str] = []
    for line in iter(partial(text.readline, _MAX_LINE_LENGTH + 1), ''):
        if budget:
            budget.spend(len(line))
        if len(line) < 3 and not line.strip('\r\n') and len(empty) < _MAX_LINE_LENGTH:
            empty.append(line)
            continue
        if len(line) > _MAX_LINE_LENGTH:
            raise csv.Error(f'a line has more than {_MAX_LINE_LENGTH} characters')
        yield from empty
        empty.clear()
        yield line


class _FileHeader(NamedTuple):
    """Notes and names of a file, columns of quantities and of all others, and the delimiter."""

    notes: tuple[str, ...]
    header: list[str]
    columns: dict[str, Column]
    other_columns: dict[str, int]
    delimiter: str


def _read_header(lines: Iterator[str], columns: Mapping[str, str],
                 axis: str) -> tuple[_FileHeader, int]:
    """Return notes and header, and the number of the next line."""
    notes, line = [], next(lines, '')
    while line.startswith(('#', 'sep=')):  # spreadsheets write the delimiter into the first line
        notes.append(line.removeprefix('#').strip())
        line = next(lines, '')
    delimiter = find_delimiter(line)
    if delimiter not in line and len(line.split()) > 1:
        delimiter, line = ' ', ' '.join(line.split())
    rows = csv.reader(itertools.chain([line], lines), delimiter=delimiter)
    header = [_normalize_newlines(name.strip()) for name in next(rows, [])]
    if not header:
        raise LogError('has no line with the names of columns; name another file')
    found = find_columns(header, columns, axis)
    positions = {column.position for column in found.values()}
    # the other names, made unique: a second x becomes x.1
    others, names, numbers = dict[str, int](), set(header), Counter[str]()
    for index, name in enumerate(header):
        if index not in positions and name not in COLUMNS:
            unique = name
            while unique in others or unique != name and unique in names:
                numbers[name] += 1
                unique = f'{name}.{numbers[name]}'
            others[unique] = index
    return (_FileHeader(tuple(notes), header, found, others, delimiter),
            len(notes) + rows.line_num + 1)


def _parse_numeric_rows(lines: list[str], first_line: int,
                        table: _FileHeader) -> _ParsedRows | None:
    """Parse rows of numbers by numpy; None where they contain anything else."""
    # old versions of numpy read 1_0 and other digits than ASCII
    if table.other_columns or any('_' in line or not line.isascii() for line in lines):
        return None
    if table.delimiter != ',':
        lines = [line.replace(',', '.') for line in lines]
    try:
        values = np.loadtxt(lines, delimiter=table.delimiter, comments=None, ndmin=2)
    except ValueError:
        return None
    if values.shape != (len(lines), len(table.header)):
        return None
    arrays: dict[str, Array] = {}
    for quantity, (index, factor, offset) in table.columns.items():
        if mask_invalid(values[:, index], quantity).any():
            return None
        arrays[quantity] = values[:, index] * factor + offset
    return range(first_line, first_line + len(lines) + 1), arrays, {}


def _parse_text_rows(lines: list[str], remaining_lines: Iterator[str], first_line: int,
                     table: _FileHeader) -> _ParsedRows:
    """Parse rows with texts, which may span lines; name a faulty row and column."""
    reader = csv.reader(itertools.chain(lines, remaining_lines), delimiter=table.delimiter)
    places, rows, header = [first_line], [], table.header
    for row in reader:
        if len(row) != len(header):
            raise LogError(f'line {places[-1]} has {len(row)} values, and the header '
                           f'{len(header)}; correct or remove the line')
        rows.append(row)
        places.append(first_line + reader.line_num)
        if reader.line_num >= len(lines) and len(rows) > 1:
            break
    cells = list(zip(*rows))
    arrays: dict[str, Array] = {}
    for quantity, (index, factor, offset) in table.columns.items():
        texts, found = cells[index], list[float]()
        if table.delimiter != ',':
            texts = tuple(text.replace(',', '.') for text in texts)
        if quantity in _NULLABLE_QUANTITIES:
            texts = tuple(text.strip() or 'nan' for text in texts)
        try:
            found.extend(map(_to_number, texts))
        except ValueError:
            number = len(found)  # the first that is no number
            remedy = ('give seconds, or the sample rate with --rate'
                      if quantity == 'time' else 'leave the cell empty if the value is lost'
                      if quantity in _NULLABLE_QUANTITIES else 'correct or remove the row')
            raise LogError(f'line {places[number]}, column {header[index]}: '
                           f'{reprlib.repr(texts[number])} is not a number; {remedy}') from None
        values = np.array(found)
        wrong = mask_invalid(values, quantity)
        if wrong.any():
            number = int(np.argmax(wrong))
            fault = (f'beyond the limit of {_max_magnitude(quantity):g}'
                     if np.isfinite(values[number]) else 'not a finite number')
            raise LogError(f'line {places[number]}, column {header[index]}: '
                           f'{excerpt(texts[number])} is {fault}; remove the row')
        arrays[quantity] = values * factor + offset
    return places, arrays, {name: cells[index] for name, index in table.other_columns.items()}


def _to_number(text: str) -> float:
    if '_' in text or not text.isascii():  # which Python reads, as 10 in 1_0
        raise ValueError(text)
    return float(text)


def _max_magnitude(quantity: str) -> float:
    # a single larger temperature decides a fit, degC
    return 1e5 if quantity == 'temperature' else MAX_MAGNITUDE


def mask_invalid(values: Array, quantity: str) -> Mask:
    """Tell which values a log cannot hold: beyond the limit, or nan where it may not be lost."""
    valid = np.abs(values) <= _max_magnitude(quantity)
    return ~(valid | np.isnan(values)) if quantity in _NULLABLE_QUANTITIES else ~valid


def _refuse_unordered_time(line_numbers: Sequence[int], time: Array | None,
                           previous_time: float, place: str = 'line') -> float:
    """Refuse time that does not increase or is too large; return the last time."""
    if time is None or not len(time):
        return previous_time
    if (far := np.abs(time) > MAX_TIME).any():
        row = int(np.argmax(far))
        raise LogError(f'{place} {line_numbers[row]}, column time_s: {time[row]:g} s is beyond '
                       f'{MAX_TIME:g} s; give its unit, as by --columns time=time_s:ns')
    late = ~(np.diff(time, prepend=previous_time) >= MIN_SAMPLE_INTERVAL)
    if late.any():
        row = int(np.argmax(late))
        raise LogError(f'{place} {line_numbers[row]}, column time_s: {time[row]:.12g} s is not '
                       f'later than {time[row - 1] if row else previous_time:.12g} s; sort the '
                       'rows, or give the sample rate with --rate')
    return float(time[-1])


def log_from_table(table: Any, columns: Mapping[str, str] = {}, axis: str = 'z') -> Log:
    """
    Return a log from a pandas DataFrame, or from a mapping of names to arrays of shape (n,).

    Raise `LogError` for no output, or values that are no log.
    """
    try:
        header = [str(name) for name in table]
        found = find_columns(header, columns, axis)
    except (TypeError, InputError) as error:
        raise LogError(f'the table is no log: {error}; wanted columns by their names') from None
    names = {quantity: header[column.position] for quantity, column in found.items()}
    arrays: dict[str, Any] = {
        quantity: _to_floats(names[quantity], table[list(table)[index]]) * factor + offset
        for quantity, (index, factor, offset) in found.items()}
    _refuse_invalid(arrays, names)
    if (count := len(next(iter(arrays.values())))) < 2:
        raise LogError(f'the table has {count} of the 2 rows that are needed; record more')
    _replace_attitude(arrays, axis)
    return Log(**arrays)


def _to_floats(name: str, values: Any) -> Array:
    """Return the values of a column as floats, nan where they are masked."""
    try:
        array = np.ma.getdata(values) if (mask := np.ma.getmask(values)) is np.ma.nomask else (
            np.where(mask, np.nan, np.ma.getdata(values)))
        if array.dtype.kind in 'cMm':
            raise ValueError(f'its type is {array.dtype}')
        return np.asarray(array, float)
    except (TypeError, ValueError) as error:
        raise LogError(f'{name} is no column of numbers ({describe_error(error)}); give dates as '
                       'seconds since the first') from None


def _refuse_invalid(arrays: Mapping[str, Array], names: Mapping[str, str]) -> None:
    """Refuse columns that are no log together; `names` are theirs, if not the quantities'."""
    shapes = {names.get(quantity, quantity): values.shape for quantity, values in arrays.items()}
    if len(set(shapes.values())) > 1 or any(len(shape) != 1 for shape in shapes.values()):
        given = ', '.join(f'{name} {shape}' for name, shape in shapes.items())
        raise LogError(f'the columns have the shapes {given}; wanted one shape (n,)')
    for quantity, values in arrays.items():
        if quantity != 'time' and (wrong := mask_invalid(values, quantity)).any():
            row = int(np.argmax(wrong))
            raise LogError(f'row {row} of {names.get(quantity, quantity)} is {values[row]:g}; '
                           'remove the row')
    _refuse_unordered_time(range(len(arrays.get('time', ()))), arrays.get('time'), -math.inf,
                           'row')


def select_rows(log: Log, rows: slice | Mask | NDArray[np.integer[Any]]) -> Log:
    which = np.arange(len(log))[rows]
    arrays: dict[str, Any] = {name: getattr(log, name)[which] for name in QUANTITIES
                              if getattr(log, name) is not None}
    others = {name: tuple(texts[place] for place in which) for name, texts in log.others.items()}
    return replace(log, **arrays, others=others)


def _replace_attitude(arrays: dict[str, Array], axis: str) -> None:
    """
    Replace the parts of a quaternion from sensor to room, in quantity -> values, by `ROTATIONS`.

    The rotation about an axis is the angle that a gyro with this axis turns, tilted or not: the
    rotations between neighbouring attitudes are added by their component along the axis of the
    sensor, less what coning adds to it (Bortz 1971). Over a gap in which the axis of the rotation
    changes, the gyro's own angle is taken, if it drifts by less.
    """
    if ATTITUDE[0] not in arrays:
        return
    quaternions = np.stack([arrays.pop(part) for part in ATTITUDE], axis=1)
    known = np.abs(np.linalg.norm(quaternions, axis=1) - 1.0) < 0.4  # as in recordings
    angles = np.full((len(known), 3), np.nan)
    arrays |= zip(ROTATIONS, angles.T)
    if known.sum() < 2:
        return
    # time, s or rows, and the integral of the output, rad, nan without an output
    time = arrays.get('time', np.arange(float(len(known))))
    output = arrays.get('output', np.full(len(known), np.nan))
    if (measured := np.isfinite(output)).any():
        output = np.interp(time, time[measured], output[measured])
    angle = cumulative_trapezoid(output, time, initial=0.0)
    time, by_gyro = time[known], np.diff(angle[known])
    apart, attitude = np.diff(time), Rotation.from_quat(quaternions[known][:, [1, 2, 3, 0]])
    step = (attitude[:-1].inv() * attitude[1:]).as_rotvec()
    usual = apart < 1.5 * np.median(apart)
    turned = step.copy()
    turned[1:] -= np.where((usual[:-1] & usual[1:])[:, None],
                           np.cross(step[:-1], step[1:]) / 12.0, 0.0)
    turned = np.roll(turned, -AXES.index(axis), axis=1)
    gap = np.flatnonzero(~usual)
    if len(gap) and np.isfinite(by_gyro).all():
        difference = by_gyro - turned[:, 0]
        drift = abs(difference[usual].sum()) / apart[usual].sum()
        turned[gap, 0] += 2.0 * np.pi * np.rint(difference[gap] / (2.0 * np.pi))
        # the coning that rotations as long as the gap, before and after it, would add
        first = np.searchsorted(time, time[gap] - apart[gap])
        last = np.minimum(np.searchsorted(time, time[gap + 1] + apart[gap]), len(time) - 1)
        largest = np.zeros(len(gap))
        for begin, end in ((first, gap), (gap + 1, last)):
            near = (attitude[begin].inv() * attitude[end]).as_rotvec()
            longer = apart[gap] / np.maximum(time[end] - time[begin], np.median(apart))
            added = np.linalg.norm(np.cross(step[gap], near), axis=1) * longer / 12.0
            largest = np.maximum(largest, added)
        unsure = gap[largest > drift * apart[gap]]
        turned[unsure] = np.column_stack([by_gyro[unsure], np.zeros((len(unsure), 2))])
    angles[known] = np.insert(np.cumsum(turned, axis=0), 0, 0.0, axis=0)


#: Largest difference from a full turn of a jump of a wrapped heading, turns.
_FULL_TURN_MARGIN = 0.1
#: Largest ratio of the rates of a gyro and its reference, in one unit: full scales differ by 2.
MAX_PLAUSIBLE_FACTOR = 1.4


def unwrap_heading(reference_time: Array, wrapped: Array, time: Array,
                   output: Array) -> tuple[Array, bool]:
    """
    Unwrap a heading, and return it with whether the gyro determined a number of turns.

    Over gaps and of a slow reference, the integral of the gyro gives the number of turns. A
    heading in deg instead of rad is left as it is, as its unit is to be corrected first. The
    reference, s and rad, has shape (m,), nan where it was lost; time and output of the gyro, s and
    rad/s, shape (n,).
    """
    known, heading = np.isfinite(wrapped), np.full(len(wrapped), np.nan)
    if known.sum() < 2:
        return heading, False
    if _is_in_degrees(reference_time[known], wrapped[known], time, np.nan_to_num(output)):
        return wrapped, False
    plainly = np.unwrap(wrapped[known])
    expected, _ = _heading_by_gyro(reference_time[known], plainly, time, np.nan_to_num(output))
    heading[known] = expected + np.unwrap(wrapped[known] - expected)
    return heading, bool(np.abs(np.diff(heading[known]) - np.diff(plainly)).max() > np.pi)


def unwrap_reference(log: Log) -> Log:
    """Return a log with output and time whose reference heading, if any, is unwrapped."""
    time, output, heading = (np.asarray(each) for each in (
        log.time, log.output, log.reference_heading))
    return log if log.reference_heading is None else replace(
        log, reference_heading=unwrap_heading(time, heading, time, output)[0])


def _heading_by_gyro(reference_time: Array, heading: Array, time: Array,
                     output: Array) -> tuple[Array, float]:
    """Return the heading, (m,), by the gyro with sign and bias fitted, and its scale factor."""
    angle = cumulative_trapezoid(output, time, initial=0.0)
    turned, steps = np.interp(reference_time, time, angle), np.diff(reference_time)
    # as rates, since over a gap the unwrapped change may be wrong by any number of turns
    rate, gyro_rate = np.diff(heading) / steps, np.diff(turned) / steps
    sign = -1.0 if np.dot(rate, gyro_rate) < 0.0 else 1.0
    bias = float(np.median(rate - sign * gyro_rate))
    close = steps <= 2.0 * np.median(steps)
    square = float(np.sum((gyro_rate[close] - np.mean(gyro_rate[close])) ** 2))
    factor = (float(np.sum(rate[close] * (gyro_rate[close] - np.mean(gyro_rate[close])))) / square
              if square > 0.0 else 0.0)
    return sign * turned + bias * reference_time, factor


def _is_in_degrees(reference_time: Array, heading: Array, time: Array, output: Array) -> bool:
    """Tell whether a heading exceeds a turn and, by the gyro, is not in rad."""
    _, factor = _heading_by_gyro(reference_time, heading, time, output)
    return (float(np.ptp(heading)) > (1.0 + _FULL_TURN_MARGIN) * 2.0 * math.pi
            and 1.0 / MAX_PLAUSIBLE_FACTOR < DEGREE * abs(factor) < MAX_PLAUSIBLE_FACTOR)


def refuse_wrapped(log: Log) -> None:
    """Raise `DataRefused` for a reference heading that jumps by full turns: it is wrapped."""
    # over a gap of the reference, a jump is a full turn that the gyro does not show
    if log.time is None or log.reference_heading is None:
        return
    known = np.flatnonzero(np.isfinite(log.reference_heading))
    time, change = log.time[known], np.diff(log.reference_heading[known])
    # vehicles do not turn faster than 35 rad/s
    is_jump = ((np.abs(np.abs(change) / (2.0 * math.pi) - 1.0) < _FULL_TURN_MARGIN)
               & (np.abs(change) > 35.0 * np.diff(time)))
    measured = np.isfinite(np.nan if log.output is None else log.output)
    if log.output is not None and len(known) > 2 and measured.sum() > 2:
        # gaps with full turns that the gyro lacks
        output, stamps = log.output[measured], log.time[measured]
        expected, factor = _heading_by_gyro(time, log.reference_heading[known], stamps, output)
        turns = (change - np.diff(expected)) / (2.0 * math.pi)
        # the integral of the gyro errs by less than its longest interval times its largest rate
        pauses = np.diff(stamps)
        begin = np.clip(np.searchsorted(stamps, time, 'right') - 1, 0, len(pauses) - 1)
        longest = np.maximum.reduceat(pauses, begin)[:-1]
        is_jump |= ((longest * np.abs(output).max() < _FULL_TURN_MARGIN * 2.0 * math.pi)
                    & (np.rint(turns) != 0.0)
                    & (np.abs(turns - np.rint(turns)) < _FULL_TURN_MARGIN)
                    & (known[1:] > known[:-1] + 1)
                    & (1.0 / MAX_PLAUSIBLE_FACTOR < abs(factor) < MAX_PLAUSIBLE_FACTOR))
    jumps = np.flatnonzero(is_jump)
    if len(jumps) and not (log.output is not None and _is_in_degrees(
            time, log.reference_heading[known], log.time, np.nan_to_num(log.output))):
        first, last = known[jumps[0]], known[jumps[0] + 1]
        where = '' if last == first + 1 else ' that the gyro does not show'
        raise DataRefused(f'the reference heading jumps by a full turn{where}, first at '
                          f'{log.time[last]:.3f} s: use --unwrap, or unwrap_heading in Python')


def write_log(path: str | Path, log: Log, more: Mapping[str, Array] = {}) -> None:
    """Write a log and more columns, name -> (n,), to .csv or .csv.gz in SI, atomically."""
    columns: dict[str, Any] = {
        name: getattr(log, quantity) for name, (quantity, factor) in COLUMNS.items()
        if factor == 1.0 and getattr(log, quantity) is not None}
    texts = {name: list(map(_normalize_newlines, texts)) for name, texts in log.others.items()}
    columns |= texts | {name: np.asarray(values, dtype=float) for name, values in more.items()}
    with (open_replacement(path) as file,
          # without a time, so that the same log gives the same file
          gzip.GzipFile('', 'wb', compresslevel=6, fileobj=file, mtime=0)
          if str(path).endswith('.gz') else nullcontext(file) as data):
        text = ''.join(f'# {" ".join(note.splitlines())}\n' for note in log.notes)
        text += format_rows([columns])
        for begin in range(0, len(log), CACHE_BLOCK_SAMPLES):
            parts = (each[begin:begin + CACHE_BLOCK_SAMPLES] for each in columns.values())
            text += format_rows(zip(*(part if isinstance(part, list) else part.tolist()
                                      for part in parts)))
            data.write(text.encode('utf-8', 'backslashreplace'))
            text = ''


def _normalize_newlines(text: str) -> str:
    return text.replace('\r\n', '\n').replace('\r', '\n') if '\r' in text else text
