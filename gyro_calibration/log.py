"""
Read and write logs.

A log is a CSV file, one row a sample or, without time, one row a dwell of a rate table. The header names each column with its unit.

"""

from __future__ import annotations

import csv
import gzip
import io
import math
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gyro_calibration.files import write_atomically

Array = NDArray[np.floating[Any]]
Mask = NDArray[np.bool_]
Number = Any  # a float, or an array of shape (n,): most formulas serve both

DEGREE = math.pi / 180.0

#: So many samples of a dozen columns stay in the cache of a processor, which is three times as fast as to go through memory for each step.
CACHED = 1 << 14

#: Column name -> (quantity, factor to SI). The order of the quantities is the order of writing.
COLUMNS: Mapping[str, tuple[str, float]] = {
    'time_s': ('time', 1.0),
    'gyro_rad_s': ('output', 1.0),
    'gyro_dps': ('output', DEGREE),
    'gyro_counts': ('counts', 1.0),
    'temperature_degc': ('temperature', 1.0),
    'reference_rate_rad_s': ('reference_rate', 1.0),
    'reference_rate_dps': ('reference_rate', DEGREE),
    'reference_heading_rad': ('reference_heading', 1.0),
    'reference_heading_deg': ('reference_heading', DEGREE),
    'acceleration_mps2': ('specific_force', 1.0),
    'supply_v': ('supply', 1.0),
    'moving': ('moving', 1.0),
}
_MAY_BE_LOST = ('output', 'counts', 'reference_rate', 'reference_heading')


class LogError(ValueError):
    """A file is not a log; the message names file, row and column."""


class DataRefused(ValueError):
    """The data do not allow an answer; the message says why and what would."""


@dataclass(frozen=True)
class Log:
    """
    What was recorded, as arrays in SI, each of shape (n,) or absent.

    Attributes
    ----------
    output : what the gyro reported, rad/s, counter-clockwise positive
    counts : the same before any scaling, 1
    time : s, increasing; without it the rows are dwells of a rate table
    temperature : the gyro's own sensor, degC
    reference_rate, reference_heading : rad/s and rad; nan where the reference was lost; the heading is continuous
    specific_force : along the input axis, m/s²
    supply : V
    moving : 1 or 0
    notes : the lines before the header, without their '#'
    others : columns of the file that are not ours, as text, in their order

    """

    output: Array | None = None
    counts: Array | None = None
    time: Array | None = None
    temperature: Array | None = None
    reference_rate: Array | None = None
    reference_heading: Array | None = None
    specific_force: Array | None = None
    supply: Array | None = None
    moving: Array | None = None
    notes: tuple[str, ...] = ()
    others: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def __len__(self) -> int:
        first = self.output if self.output is not None else self.counts
        return 0 if first is None else len(first)


def read_log(path: str | Path, sensitivity: float | None = None, rate: float | None = None) -> Log:
    """
    Read a log file (.csv or .csv.gz).

    Parameters
    ----------
    path : the file
    sensitivity : rad/s a count; used where the file has raw counts alone
    rate : Hz; the samples came at this rate, whatever the file says of time

    Raises
    ------
    LogError : the file cannot be read, or is not a log; names file, row and column

    """
    notes, header, first_row, rows = _rows(Path(path))
    named = _named_columns(path, header)
    if len(rows) < 2:
        raise LogError(f'{path}: {len(rows)} rows of data; a log has at least two: record more')
    columns = list(zip(*rows))
    arrays = {quantity: _numbers(path, first_row, header[index], columns[index], quantity) * factor
              for quantity, (index, factor) in named.items()}
    if rate is not None:
        arrays['time'] = np.arange(len(rows)) / rate
    _refuse_time(path, first_row, arrays.get('time'))
    if 'output' not in arrays and sensitivity is not None:
        arrays['output'] = arrays['counts'] * sensitivity
    ours = {index for index, _ in named.values()}
    others = {name: tuple(columns[index]) for index, name in enumerate(header) if index not in ours}
    return Log(**arrays, notes=tuple(notes), others=others)


def _rows(path: Path) -> tuple[list[str], list[str], int, list[list[str]]]:
    """Return notes, header, the line number of the first row, and the rows, each as long as the header."""
    try:
        data = path.read_bytes()
        lines = (gzip.decompress(data) if path.suffix == '.gz' else data).decode('utf-8-sig').splitlines(keepends=True)
        start = next((number for number, line in enumerate(lines) if not line.startswith('#')), len(lines))
        table = list(csv.reader(lines[start:]))
    except (OSError, EOFError, zlib.error, UnicodeDecodeError, csv.Error) as error:
        raise LogError(f'{path}: cannot be read as a log ({error}); wanted a CSV file, .csv or .csv.gz') from error
    notes = [line[1:].strip() for line in lines[:start]]
    header = [name.strip() for name in table[0]] if table else []
    if not any(name in COLUMNS for name in header):
        raise LogError(f'{path}: line {start + 1} is no header; name the columns there, such as time_s,gyro_dps,temperature_degc')
    rows = table[1:]
    while rows and not rows[-1]:
        rows.pop()
    for number, row in enumerate(rows, start + 2):
        if len(row) != len(header):
            raise LogError(f'{path}: line {number} has {len(row)} values where the header has {len(header)}; mend or remove the line')
    return notes, header, start + 2, rows


def _named_columns(path: str | Path, header: list[str]) -> dict[str, tuple[int, float]]:
    named: dict[str, tuple[int, float]] = {}
    for index, name in enumerate(header):
        if name not in COLUMNS:
            continue
        quantity, factor = COLUMNS[name]
        if quantity in named:
            raise LogError(f'{path}: columns {header[named[quantity][0]]} and {name} both give the {quantity}; keep one of them')
        named[quantity] = (index, factor)
    if not {'output', 'counts'} & set(named):
        raise LogError(f'{path}: no gyro column among {",".join(header)}; wanted gyro_dps, gyro_rad_s or gyro_counts')
    return named


def _numbers(path: str | Path, first_row: int, name: str, texts: tuple[str, ...], quantity: str) -> Array:
    try:
        values = np.array(texts, dtype=np.float64)
    except ValueError:
        row = next(number for number, text in enumerate(texts) if not _is_number(text))
        raise LogError(f'{path}: line {first_row + row}, column {name}: {texts[row]!r} is not a number') from None
    wrong = np.isinf(values) if quantity in _MAY_BE_LOST else ~np.isfinite(values)
    if wrong.any():
        row = int(np.argmax(wrong))
        raise LogError(f'{path}: line {first_row + row}, column {name}: {texts[row]} is not a finite number; remove the row')
    return values


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _refuse_time(path: str | Path, first_row: int, time: Array | None) -> None:
    if time is None:
        return
    late = np.diff(time) <= 0
    if late.any():
        row = int(np.argmax(late)) + 1
        raise LogError(f'{path}: line {first_row + row}, column time_s: {time[row]:g} s does not come after {time[row - 1]:g} s; '
                       'sort the rows, or give --rate where the stamps are no use')


def write_log(path: str | Path, log: Log, more: Mapping[str, Array] | None = None) -> None:
    """
    Write a log in SI columns, then its other columns, then more named columns; the file is complete or not there.

    Parameters
    ----------
    path : .csv or .csv.gz
    log : what to write
    more : name -> array of shape (n,)

    """
    columns: dict[str, list[str]] = {}
    for name, (quantity, factor) in COLUMNS.items():
        values = getattr(log, quantity)
        if factor == 1.0 and values is not None:
            columns[name] = [repr(value) for value in values.tolist()]
    columns.update({name: list(texts) for name, texts in log.others.items()})
    columns.update({name: [repr(value) for value in np.asarray(values, dtype=float).tolist()] for name, values in (more or {}).items()})
    text = io.StringIO()
    text.writelines(f'# {note}\n' for note in log.notes)
    writer = csv.writer(text, lineterminator='\n')
    writer.writerow(columns)
    writer.writerows(zip(*columns.values()))
    data = text.getvalue().encode()
    write_atomically(path, gzip.compress(data) if str(path).endswith('.gz') else data)
