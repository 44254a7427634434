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
Fizoptika fibre-optic gyros with one axis: frames of 8 bytes, ``DD low high mid id data sum sum``.

The rate is a signed number of 24 bits in counts, whose meaning differs from unit to unit (27880
counts per deg/s in one). The sum is that of the second to the sixth byte, most significant byte
first. Each frame holds half of a value about the unit itself: the even numbers ``id`` have the
high byte, the odd ones after them the low byte of a signed number of 16 bits. They are joined only
if the two frames follow each other with nothing between.

Source: the public decoder `riptide_gyro` of Ohio State University, which names the numbers from 8
to 15 as reserved; its sign extension is off by one count and was not adopted. No manual was seen:
the sample rate, which is not given anywhere, and the sense of rotation are not verified.

"""

from __future__ import annotations

from functools import partial

from gyro_calibration.driver.protocols.protocol import (
    FrameSplitter,
    Protocol,
    Reading,
    require_sensitivity,
    Settings,
    to_signed_count,
    WrittenReading,
)

_HEADER = 0xDD
# number of the high byte: name, unit of one count, offset, default of an emulated unit
_STATUS_VALUES = {
    0: ('temperature', 250.0 / 0x8000, -50.0, 25.0),
    2: ('supply_v', 10.0 / 0x8000, 0.0, 5.0),
    4: ('source_current_a', 0.25 / 0x8000, 0.0, 0.1),
    6: ('diagnostic_v', 2.5 / 0x8000, 0.0, 1.0),
}


def _checksum(frame: bytes) -> bytes:
    return sum(frame[1:6]).to_bytes(2, 'big')


class _Parser:
    """Joins the halves of values that span two frames."""

    def __init__(self, settings: Settings):
        self._last_id, self._last_byte = -1, 0

    def __call__(self, frame: bytes) -> Reading:
        _, low, high, middle, number, byte, *_ = frame
        (before, first), (self._last_id, self._last_byte) = (
            (self._last_id, self._last_byte), (number, byte))
        rate = int.from_bytes((high, middle, low), 'big', signed=True)
        if before not in _STATUS_VALUES or number != before + 1:
            return Reading(rate)
        name, unit, offset, _ = _STATUS_VALUES[before]
        value = int.from_bytes((first, byte), 'big', signed=True) * unit + offset
        if name == 'temperature':
            return Reading(rate, temperature=value)
        return Reading(rate, health={name: value})


class _Writer:
    """Sends each value in two frames: both halves are of the same instant."""

    def __init__(self, settings: Settings):
        self._latched: dict[int, bytes] = {}

    def __call__(self, reading: WrittenReading) -> bytes:
        number = reading.sequence % 8
        even = number & ~1
        if number == even or even not in self._latched:
            name, unit, offset, usual = _STATUS_VALUES[even]
            value = reading.temperature if name == 'temperature' else reading.health.get(name)
            half = to_signed_count(((usual if value is None else value) - offset) / unit)
            self._latched = {even: half.to_bytes(2, 'big', signed=True)}
        high, middle, low = to_signed_count(reading.value, 24).to_bytes(3, 'big', signed=True)
        frame = bytes([_HEADER, low, high, middle, number, self._latched[even][number - even]])
        return frame + _checksum(frame)


FIZOPTIKA = Protocol(
    name='fizoptika', description='Fizoptika fibre-optic gyros, binary with raw counts',
    baud=921600, rate=1000.0, sensitivity=1.0,
    splitter=partial(FrameSplitter, rb'\xdd.{7}', 8, lambda frame: _checksum(frame) == frame[6:]),
    parser=_Parser, writer=_Writer, largest_count=0x800000, normal_ranges={
        'supply_v': (4.75, 5.25), 'source_current_a': (0.07, 0.15), 'diagnostic_v': (0.95, 1.05)},
    check_settings=require_sensitivity)
