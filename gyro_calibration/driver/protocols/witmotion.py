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
WitMotion modules (WT901 and similar): frames of 11 bytes.

They are ``55``, a type from 50 to 5F, eight bytes, and the low byte of the sum of the ten. Type 52
has the rates about x, y, z, 2000 deg/s at 32768, and the temperature in hundredths of a degC; all
are signed 16-bit numbers, low byte first. Type 51, directly before it, has the accelerations, 16 g
at 32768. Other types are skipped. A new module sends ten samples a second at 9600 baud. For 200 a
second it needs 115200 baud: set ``baud``, and ``sample_rate`` to the rate of the module.

``55 52 00 00 00 00 00 02 C4 09 76`` is 31.25 deg/s about z at 25 degC.

Source: WT901 data sheet v20-0702, sections 5.1.2 and 5.1.3. Older modules (BWT61CL, data sheet
v20-0630) send the temperature as count/340 + 36.53 degC. The frames do not identify the module, so
the temperature of older modules is wrong. Not verified: whether a module that lies flat reports
+1 g.
"""

from functools import partial
import math
import struct

from gyro_calibration.driver.protocols.protocol import (
    FrameSplitter, Protocol, Reading, ROOM_TEMPERATURE, Sample, Settings, stateless,
    to_signed_count)
from gyro_calibration.logs.columns import STANDARD_GRAVITY

_FORCE_PER_COUNT = 16.0 * STANDARD_GRAVITY / 0x8000  # m/s² of one count
_ACCELERATION, _RATE = 0x51, 0x52


class _Parser:
    """Joins each rate with the acceleration of the preceding frame."""

    def __init__(self, settings: Settings):
        self._axis = 'xyz'.index(settings.axis)
        self._force: float | None = None

    def __call__(self, frame: bytes) -> Reading:
        numbers = struct.unpack_from('<2x4h', frame)
        if frame[1] == _ACCELERATION:
            self._force = numbers[self._axis] * _FORCE_PER_COUNT
        if frame[1] != _RATE:
            return Reading(None)
        force, self._force = self._force, None
        return Reading(numbers[self._axis], temperature=numbers[3] * 0.01, specific_force=force)


def _write(value: float, sample: Sample, settings: Settings) -> bytes:
    degrees, data = ROOM_TEMPERATURE if sample.temperature is None else sample.temperature, b''
    force = sample.specific_force
    for kind, number in ((_ACCELERATION, force and force / _FORCE_PER_COUNT), (_RATE, value)):
        if number is not None:
            numbers = *(number * (each == settings.axis) for each in 'xyz'), 100.0 * degrees
            frame = bytes([0x55, kind]) + struct.pack('<4h', *map(to_signed_count, numbers))
            data += frame + bytes([sum(frame) & 0xFF])
    return data


WITMOTION = Protocol(name='witmotion', text=__doc__, baud=9600,
                     rate=10.0, sensitivity=math.radians(2000.0) / 0x8000,
                     splitter=partial(FrameSplitter, rb'\x55[\x50-\x5f].{9}', 11,
                                      lambda frame: sum(frame[:10]) & 0xFF == frame[10]),
                     parser=_Parser, writer=stateless(_write), largest_count=0x8000)
