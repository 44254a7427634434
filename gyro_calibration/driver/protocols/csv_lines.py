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
Numbers separated by commas, one sample a line: any gyro behind a microcontroller.

The columns are named by `Settings.columns` in names of the log format. An empty or ``nan``
temperature, time, acceleration or supply is unknown. An output that is ``nan`` or ``inf``, or
beyond 2000 deg/s where no full scale is set, is refused: such values are mostly lines that lost
their decimal point. A line without an output is discarded, as is a header.

"""

from __future__ import annotations

from functools import partial
import math
import re

from gyro_calibration.driver.protocols.protocol import (
    GYRO_COLUMNS,
    LineSplitter,
    NUMBER,
    OPTIONAL_COLUMNS,
    Protocol,
    Reading,
    refuse_increments,
    Settings,
    stateless,
    WrittenReading,
)

_NUMBER = re.compile(NUMBER)
_NOT_FINITE = re.compile(rb'[+-]?(?:nan|inf(?:inity)?)', re.IGNORECASE)
_MISSING_VALUES = (b'', b'nan')


def _check_settings(settings: Settings) -> None:
    refuse_increments(settings)
    counts = 'gyro_counts' in settings.columns
    if counts and settings.sensitivity is None:
        raise ValueError('columns hold gyro_counts, but sensitivity is not set: set it to the '
                         'rad/s of one count')
    if not counts and settings.sensitivity is not None:
        raise ValueError('sensitivity is set, but columns hold no gyro_counts: name the column '
                         'gyro_counts, or leave sensitivity out')


def _parse(line: bytes, settings: Settings) -> Reading | None:
    texts = [text.strip() for text in line.split(b',')]
    if len(texts) != len(settings.columns):
        return None
    fields = dict(zip(settings.columns, texts))
    name = next(name for name in GYRO_COLUMNS if name in fields)
    output = fields[name]  # the decoder may refuse it
    if not (_NUMBER.fullmatch(output) or _NOT_FINITE.fullmatch(output)):
        return None
    known: list[float | None] = []
    for column in OPTIONAL_COLUMNS:
        text = fields.get(column, b'')
        if text.lower() in _MISSING_VALUES:
            known.append(None)
        elif _NUMBER.fullmatch(text) and math.isfinite(value := float(text)):
            known.append(value)
        else:
            return None
    temperature, time, force, supply = known
    return Reading(float(output) * GYRO_COLUMNS[name], True, temperature, time, None, force,
                   {} if supply is None else {'supply_v': supply})


def _write(reading: WrittenReading, settings: Settings) -> bytes:
    known = dict(zip(OPTIONAL_COLUMNS, (reading.temperature, reading.time, reading.specific_force,
                                        reading.health.get('supply_v'))))
    fields = {name: b'nan' if value is None else b'%.6f' % value for name, value in known.items()}
    fields |= {name: b'%.9g' % (reading.value / unit) for name, unit in GYRO_COLUMNS.items()}
    fields['gyro_counts'] = b'%d' % round(reading.value)
    return b','.join(fields.get(name, b'0') for name in settings.columns) + b'\r\n'


CSV = Protocol(name='csv', description='numbers separated by commas, columns named by a parameter',
               baud=115200, rate=100.0, sensitivity=1.0, splitter=partial(LineSplitter, 1024),
               parser=stateless(_parse), writer=stateless(_write), full_scale=math.radians(2000.0),
               preamble=b'\r\n', check_settings=_check_settings)
