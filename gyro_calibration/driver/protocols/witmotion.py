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
WitMotion modules (WT901 and similar): frames of 11 bytes, ``55 type``, four numbers and a sum.

The numbers are signed, with 16 bits, low byte first. Frames 52 hold the rates about x, y and z,
2000 deg/s at 32768, and the temperature in hundredths of a degC. Frames 51, which come directly
before, hold the accelerations, 16 g at 32768. Others (time, angle, field and more) are skipped.
The sum is the low byte of the sum of the ten bytes before.

Source: WT901 data sheet v20-0702, sections 5.1.2 and 5.1.3. Older modules (BWT61CL data sheet
v20-0630) have the temperature as count/340 + 36.53 degC, which is not distinguished here; whether
a module that lies flat reports +1 g was not verified.

"""

from __future__ import annotations

from functools import partial
import math
import struct

from gyro_calibration.driver.protocols.protocol import (
    FrameSplitter,
    Protocol,
    Reading,
    ROOM_TEMPERATURE,
    Settings,
    STANDARD_GRAVITY,
    stateless,
    to_signed_count,
    WrittenReading,
)

_RATE_PER_COUNT = math.radians(2000.0) / 0x8000
_FORCE_PER_COUNT = 16.0 * STANDARD_GRAVITY / 0x8000  # m/s² of one count
_ACCELERATION, _RATE = 0x51, 0x52
_NUMBERS = struct.Struct('<2x4h')


class _Parser:
    """Joins each rate with the acceleration of the preceding frame."""

    def __init__(self, settings: Settings):
        self._axis = 'xyz'.index(settings.axis)
        self._force: float | None = None

    def __call__(self, frame: bytes) -> Reading:
        numbers = _NUMBERS.unpack_from(frame)
        if frame[1] == _ACCELERATION:
            self._force = numbers[self._axis] * _FORCE_PER_COUNT
        if frame[1] != _RATE:
            return Reading(None)
        force, self._force = self._force, None
        return Reading(numbers[self._axis], temperature=numbers[3] * 0.01, specific_force=force)


def _write(reading: WrittenReading, settings: Settings) -> bytes:
    degrees = ROOM_TEMPERATURE if reading.temperature is None else reading.temperature
    rate = _frame(_RATE, reading.value, 100.0 * degrees, settings.axis)
    if reading.specific_force is None:
        return rate
    force = reading.specific_force / _FORCE_PER_COUNT
    return _frame(_ACCELERATION, force, 100.0 * degrees, settings.axis) + rate


def _frame(kind: int, value: float, temperature: float, axis: str) -> bytes:
    numbers = [value if each == axis else 0.0 for each in 'xyz'] + [temperature]
    frame = bytes([0x55, kind]) + struct.pack('<4h', *map(to_signed_count, numbers))
    return frame + bytes([sum(frame) & 0xFF])


WITMOTION = Protocol(name='witmotion', description='WitMotion modules, binary', baud=9600,
                     rate=10.0, sensitivity=_RATE_PER_COUNT,
                     splitter=partial(FrameSplitter, rb'\x55[\x50-\x5f].{9}', 11,
                                      lambda frame: sum(frame[:10]) & 0xFF == frame[10]),
                     parser=_Parser, writer=stateless(_write), largest_count=0x8000)
