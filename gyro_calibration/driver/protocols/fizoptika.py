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
Fizoptika fibre-optic gyros with one axis: frames of 8 bytes.

They are ``DD``, the low, the high and the middle byte of a signed 24-bit count, a number, a byte,
and the sum of these five, most significant byte first. The value of a count differs from unit to
unit, so ``sensitivity`` must be set; one unit has 27880 counts per deg/s, 6.260e-7 rad/s a count.

The number identifies the byte: 0 and 1 are the high and the low byte of the temperature, 2 and 3
of the supply, 4 and 5 of the current of the light source, 6 and 7 of the diagnostic voltage; 8 to
15 are reserved. The values are signed 16-bit numbers: at 32768 they are 250 degC (less 50 degC),
10 V, 0.25 A and 2.5 V. Two bytes are joined if their frames follow each other with nothing
between. A loss of exactly eight frames that leaves no other bytes is not detected.

``DD E8 00 6C 02 13 01 69`` is a count of 27880, and the high byte of the supply, 13 hexadecimal.

Source: the public decoder ``riptide_gyro`` of Ohio State University; its sign extension is off by
one count and was not adopted. No manual was seen. The sample rate is not known: 1000 Hz is assumed
until samples come, so set ``sample_rate``. The sense of rotation is not verified: the maker's
glossary calls a clockwise turn positive, without the direction of view.
"""

from functools import partial

from gyro_calibration.driver.protocols.protocol import (
    FrameSplitter, Protocol, Reading, ROOM_TEMPERATURE, Sample, Settings, to_signed_count)

_HEADER = 0xDD
_FULL_COUNT = 0x8000  # of a status value
# number of the high byte: name, value of the full count, offset, default of an emulated unit
_STATUS_VALUES = {
    0: ('temperature', 250.0, -50.0, ROOM_TEMPERATURE),
    2: ('supply_v', 10.0, 0.0, 5.0),
    4: ('source_current_a', 0.25, 0.0, 0.1),
    6: ('diagnostic_v', 2.5, 0.0, 1.0),
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
        name, full, offset, _ = _STATUS_VALUES[before]
        value = int.from_bytes((first, byte), 'big', signed=True) * full / _FULL_COUNT + offset
        if name == 'temperature':
            return Reading(rate, temperature=value)
        return Reading(rate, health={name: value})


class _Writer:
    """Sends each value in two frames: both halves are of the same instant."""

    def __init__(self, settings: Settings):
        self._latched: dict[int, bytes] = {}

    def __call__(self, value: float, sample: Sample) -> bytes:
        number = (sample.sequence or 0) % 8
        even = number & ~1
        if number == even or even not in self._latched:
            name, full, offset, usual = _STATUS_VALUES[even]
            known = sample.temperature if name == 'temperature' else sample.health.get(name)
            status = usual if known is None else known
            half = to_signed_count((status - offset) / full * _FULL_COUNT)
            self._latched = {even: half.to_bytes(2, 'big', signed=True)}
        high, middle, low = to_signed_count(value, 24).to_bytes(3, 'big', signed=True)
        frame = bytes([_HEADER, low, high, middle, number, self._latched[even][number - even]])
        return frame + _checksum(frame)


FIZOPTIKA = Protocol(
    name='fizoptika', text=__doc__,
    baud=921600, rate=1000.0, sensitivity=None,
    splitter=partial(FrameSplitter, rb'\xdd.{7}', 8, lambda frame: _checksum(frame) == frame[6:]),
    parser=_Parser, writer=_Writer, largest_count=0x800000, normal_ranges={
        'supply_v': (4.75, 5.25), 'source_current_a': (0.07, 0.15), 'diagnostic_v': (0.95, 1.05)})
