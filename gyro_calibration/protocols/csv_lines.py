"""
Numbers parted by commas, one sample a line: how any gyro comes from a microcontroller of one's own.

The columns are named by `Settings.columns` in the words of the log format. An empty or ``nan`` temperature or time is one that is not
known; a line without a finite output is discarded, as is a header.

"""

import math
import re
from functools import partial

from .lines import NUMBER, LineSplitter
from .protocol import GYRO_COLUMNS, Protocol, Reading

_NUMBER = re.compile(NUMBER)
_UNKNOWN = (b'', b'nan')


def _check(settings):
    counts = 'gyro_counts' in settings.columns
    if counts and settings.sensitivity is None:
        raise ValueError('columns hold gyro_counts, but sensitivity is not set: set it to the rad/s of one count')
    if not counts and settings.sensitivity is not None:
        raise ValueError('sensitivity is set, but columns hold no gyro_counts: name the column gyro_counts, or leave sensitivity out')


def _parse(line, settings):
    fields = [field.strip() for field in line.split(b',')]
    try:
        return _reading(dict(zip(settings.columns, fields, strict=True)))
    except ValueError:
        return None


def _reading(fields):
    name = next(name for name in GYRO_COLUMNS if name in fields)
    temperature, time = (fields.get(column, b'') for column in ('temperature_degc', 'time_s'))
    return Reading(
        value=_number(fields[name]) * GYRO_COLUMNS[name],
        temperature=None if temperature.lower() in _UNKNOWN else _number(temperature),
        time=None if time.lower() in _UNKNOWN else _number(time),
    )


def _number(text):
    value = float(text) if _NUMBER.fullmatch(text) else math.nan
    if not math.isfinite(value):
        raise ValueError('not a finite number')
    return value


def _write(reading, settings):
    return b','.join(_field(name, reading) for name in settings.columns) + b'\r\n'


def _field(name, reading):
    if name == 'time_s':
        return b'nan' if reading.time is None else b'%.6f' % reading.time
    if name == 'temperature_degc':
        return b'nan' if reading.temperature is None else b'%.4f' % reading.temperature
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
    parse=_parse,
    write=_write,
    awakening=b'\r\n',
    is_timed=True,
    check=_check,
)
