"""
Numbers parted by commas, one sample a line: how any gyro comes from a microcontroller of one's own.

The columns are named by `Settings.columns` in the words of the log format. An empty or ``nan`` temperature, time, acceleration or supply is
one that is not known; a line without a finite output is discarded, as is a header.

"""

from __future__ import annotations

import math
import re
from functools import partial

from gyro_calibration.driver.protocols.lines import NUMBER, LineSplitter
from gyro_calibration.driver.protocols.protocol import (
    GYRO_COLUMNS,
    KNOWN_COLUMNS,
    Protocol,
    Reading,
    Settings,
    Written,
    check_rates,
    stateless,
)

_NUMBER = re.compile(NUMBER)
_UNKNOWN = (b'', b'nan')


def _check(settings: Settings) -> None:
    check_rates(settings)
    counts = 'gyro_counts' in settings.columns
    if counts and settings.sensitivity is None:
        raise ValueError('columns hold gyro_counts, but sensitivity is not set: set it to the rad/s of one count')
    if not counts and settings.sensitivity is not None:
        raise ValueError('sensitivity is set, but columns hold no gyro_counts: name the column gyro_counts, or leave sensitivity out')


def _parse(line: bytes, settings: Settings) -> Reading | None:
    fields = [field.strip() for field in line.split(b',')]
    try:
        return _reading(dict(zip(settings.columns, fields, strict=True)))
    except ValueError:
        return None


def _reading(fields: dict[str, bytes]) -> Reading:
    name = next(name for name in GYRO_COLUMNS if name in fields)
    temperature, time, force, supply = (_known(fields.get(column, b'')) for column in KNOWN_COLUMNS)
    health = {} if supply is None else {'supply_v': supply}
    return Reading(_number(fields[name]) * GYRO_COLUMNS[name], True, temperature, time, None, force, health)


def _known(text: bytes) -> float | None:
    return None if text.lower() in _UNKNOWN else _number(text)


def _number(text: bytes) -> float:
    value = float(text) if _NUMBER.fullmatch(text) else math.nan
    if not math.isfinite(value):
        raise ValueError('not a finite number')
    return value


def _write(reading: Written, settings: Settings) -> bytes:
    return b','.join(_field(name, reading) for name in settings.columns) + b'\r\n'


def _field(name: str, reading: Written) -> bytes:
    if name in KNOWN_COLUMNS:
        values = reading.temperature, reading.time, reading.specific_force, reading.health.get('supply_v')
        value = values[KNOWN_COLUMNS.index(name)]
        return b'nan' if value is None else b'%.6f' % value
    if name == 'gyro_counts':
        return b'%d' % round(reading.value)
    return b'%.9g' % (reading.value / GYRO_COLUMNS[name]) if name in GYRO_COLUMNS else b'0'


CSV = Protocol(
    name='csv',
    description='numbers parted by commas, columns named by a parameter',
    baud=115200,
    rate=100.0,
    sensitivity=1.0,
    splitter=partial(LineSplitter, 1024),
    parser=stateless(_parse),
    writer=stateless(_write),
    awakening=b'\r\n',
    is_timed=True,
    check=_check,
)
