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
KVH DSP-3000, a fibre-optic gyro with one axis: lines like ``       0.015733   1``.

They hold the rate in deg/s, positive clockwise seen from above, and 1 if the gyro marks it as
valid, else 0: this line is -0.015733 deg/s. Blanks on the left distinguish a whole line from a
part of one. The letter R, sent three times at the start, selects rates. The clock is 2 to 3 % off
from unit to unit, so samples must never be integrated with the nominal interval.

Source: KVH DSP-3000 technical manual, 54-0215 revision C, section 2, for the unit with the
asynchronous interface of 100 Hz (part 02-1222-01). The linearity is given up to 375 deg/s, and
beyond 500 deg/s the output is unreliable, whatever the valid bit is (table 2).

Not supported: the unit that sends binary at 1000 Hz (part 02-1222-07). Section 3.1 of the manual
states 115200 baud and a message of 32 bits, most significant byte first: bit 31 valid, 30 and 29
synchronization, 28 and 27 type (0 rate, 1 increment, 2 integrated angle), 26 odd parity, 25 to 0
the value, 60 micro-deg/s a count for rates. Section 3.1.4 defines the two bits of synchronization,
without which the first byte of a message cannot be identified; no public copy of it was found.
"""

from functools import partial
import math
import re

from gyro_calibration.driver.protocols.protocol import (
    LineSplitter, Protocol, Reading, Settings, stateless)

_LINE = re.compile(rb' *(-?[0-9]{1,3}\.[0-9]{6}) +([01]) *')


def _parse(line: bytes, settings: Settings) -> Reading | None:
    match = _LINE.fullmatch(line)
    return match and Reading(float(match[1]), valid=match[2] == b'1')


KVH_DSP3000 = Protocol(
    name='kvh_dsp3000', text=__doc__,
    baud=38400, rate=100.0, sensitivity=math.radians(1.0),
    splitter=partial(LineSplitter, (b' ',)), parser=stateless(_parse),
    writer=lambda settings: lambda value, sample: b'%15.6f   1\r\n' % value,
    invert=True, full_scale=math.radians(500.0), startup=b'RRR',
    noise_density=math.radians(4.0 / 3600.0))  # data sheet: 4 deg/h/√Hz, 0.067 deg/√h
