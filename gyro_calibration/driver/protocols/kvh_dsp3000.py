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

They hold the rate in deg/s and 1 for valid. The rate is positive clockwise, seen from above. The
clock is 2 to 3 % off from unit to unit, so samples must never be integrated with the nominal
interval. The letter R, sent three times, asks for rates in place of increments or angles.

Source: KVH DSP-3000 technical manual, 54-0215 revision C, section 2, for the unit with the
asynchronous interface of 100 Hz (part 02-1222-01); that of 1000 Hz (02-1222-07) sends binary and
is not read here. The linearity is given up to 375 deg/s, and beyond 500 deg/s the output is
unreliable, whatever the valid bit is (table 2).

"""

from __future__ import annotations

from functools import partial
import math
import re

from gyro_calibration.driver.protocols.protocol import (
    LineSplitter,
    Protocol,
    Reading,
    Settings,
    stateless,
)

_LINE = re.compile(rb' *(-?[0-9]{1,3}\.[0-9]{6}) +([01]) *')


def _parse(line: bytes, settings: Settings) -> Reading | None:
    match = _LINE.fullmatch(line)
    return match and Reading(float(match[1]), valid=match[2] == b'1')


KVH_DSP3000 = Protocol(
    name='kvh_dsp3000', description='KVH DSP-3000 fibre-optic gyro, text with deg/s',
    baud=38400, rate=100.0, sensitivity=math.radians(1.0),
    splitter=partial(LineSplitter, 64, (b' ',)), parser=stateless(_parse),
    writer=lambda settings: lambda reading: b'%15.6f   %d\r\n' % (reading.value, reading.valid),
    invert=True, full_scale=math.radians(500.0), startup=b'RRR',
    noise_density=math.radians(4.0 / 3600.0))  # data sheet: 4 deg/h/√Hz, 0.067 deg/√h
