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
Any gyro behind a microcontroller: one line a sample, numbers separated by commas.

They stand in the order of the parameter ``columns``, whose names are those of the log format:
``gyro_dps``, ``gyro_rad_s`` or ``gyro_counts``, ``time_s``, ``temperature_degc``,
``acceleration_mps2``, ``supply_v``; columns with other names are skipped. Exactly one gyro column
is needed. ``gyro_counts`` needs ``sensitivity``, in rad/s a count; the other two do not allow it.
An empty value or ``nan`` in the other columns is unknown. A line with another number of values
than columns, or without an output, is discarded, as is a header. An output of ``nan`` or ``inf``
is refused, and one beyond full scale, for example from a line that lost its decimal point.

With the default columns, ``12.5,-3.25,24.5`` is -3.25 deg/s at 24.5 degC, 12.5 s by the clock of
the device.

An XV-3500CB gives 0.67 mV per deg/s. A converter of 12 bits and 3.3 V has 1.2 deg/s a count:
amplify or oversample.
"""

import math
import re

from gyro_calibration.driver.protocols.protocol import (
    GYRO_COLUMNS, LineSplitter, NUMBER, OPTIONAL_COLUMNS, Protocol, Reading, Sample, Settings,
    stateless)

_NUMBER = re.compile(NUMBER)
_NOT_FINITE = re.compile(rb'[+-]?(?:nan|inf(?:inity)?)', re.IGNORECASE)


def _check(settings: Settings) -> None:
    if ('gyro_counts' in settings.columns) != (settings.sensitivity is not None):
        raise ValueError('sensitivity, the rad/s of one count, belongs to a column gyro_counts: '
                         'give both or none')


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
        if text.lower() in (b'', b'nan'):
            known.append(None)
        elif _NUMBER.fullmatch(text) and math.isfinite(value := float(text)):
            known.append(value)
        else:
            return None
    temperature, time, force, supply = known
    return Reading(float(output) * GYRO_COLUMNS[name], True, temperature, time, None, force,
                   {} if supply is None else {'supply_v': supply})


def _write(value: float, sample: Sample, settings: Settings) -> bytes:
    known = dict(zip(OPTIONAL_COLUMNS, (sample.temperature, sample.time, sample.specific_force,
                                        sample.health.get('supply_v'))))
    fields = {name: b'nan' if each is None else b'%.6f' % each for name, each in known.items()}
    fields |= {name: b'%.9g' % (value / unit) for name, unit in GYRO_COLUMNS.items()}
    fields['gyro_counts'] = b'%d' % round(value)
    return b','.join(fields.get(name, b'0') for name in settings.columns) + b'\r\n'


CSV = Protocol(name='csv', text=__doc__,
               baud=115200, rate=100.0, sensitivity=1.0, splitter=LineSplitter,
               parser=stateless(_parse), writer=stateless(_write), preamble=b'\r\n', check=_check)
