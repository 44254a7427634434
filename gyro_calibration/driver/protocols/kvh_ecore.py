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
KVH E-Core 2000 family, fibre-optic gyros with one axis: frames of 8 bytes.

Only the first byte has bit 7 set. Their low seven bits, most significant first, are seven bytes
with the sum 0 modulo 256. The last two are the rate, a signed 16-bit number, most significant byte
first; the meaning of bytes two to five is not known. One of 65536 places in other bytes looks like
a frame, so that a frame after other bytes counts only if another one follows directly. A unit for
60 deg/s has 0.00183 deg/s a count, a unit for 30 deg/s half of that: set
``sensitivity: 1.597e-5``. The RD2100 is assumed to have the same format. Baud and sense of
rotation were inferred, not read in a manual: check sign and scale on your unit.

``8A 40 00 00 00 00 07 68`` is a count of 1000, which is 1.83 deg/s.
"""

from functools import partial
import math

from gyro_calibration.driver.protocols.protocol import (
    FrameSplitter, Protocol, Reading, Sample, Settings, stateless, to_signed_count)


def _unpack_content(frame: bytes) -> bytes:
    bits = 0
    for byte in frame:
        bits = bits << 7 | byte & 0x7F
    return bits.to_bytes(7, 'big')


def _write(value: float, sample: Sample, settings: Settings) -> bytes:
    rate = to_signed_count(value).to_bytes(2, 'big', signed=True)
    bits = int.from_bytes(bytes([-sum(rate) % 256, 0, 0, 0, 0]) + rate, 'big')
    frame = bytes(bits >> shift & 0x7F for shift in range(49, -1, -7))
    return bytes([frame[0] | 0x80]) + frame[1:]


KVH_ECORE = Protocol(
    name='kvh_ecore',
    text=__doc__, baud=9600,
    rate=10.0, sensitivity=math.radians(0.00183),
    splitter=partial(FrameSplitter, rb'[\x80-\xff][\x00-\x7f]{7}', 8,
                     lambda frame: sum(_unpack_content(frame)) % 256 == 0, is_weak=True),
    parser=lambda settings: lambda frame: Reading(
        int.from_bytes(_unpack_content(frame)[5:], 'big', signed=True)),
    writer=stateless(_write), largest_count=0x8000)
