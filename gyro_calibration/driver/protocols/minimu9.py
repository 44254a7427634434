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
Pololu MinIMU-9 with its AHRS firmware: lines like ``!ANG:0.10,-0.20,90.00,AN:1,2,-100,...``.

After three angles, which are not used, follow nine raw counts of gyro x, y, z, accelerometer and
compass. A line without ``AN:`` holds no rate and is discarded; switch the raw output on in the
firmware. The parameter ``axis`` selects x, y or z. One count is 0.07 deg/s in the range of
2000 deg/s that the firmware sets; at 500 deg/s set ``sensitivity: 3.054e-4``, at 250 deg/s
``1.527e-4`` (data sheet of the L3G4200D, typical). No temperature is sent.

``!ANG:0.10,-0.20,90.00,AN:1,2,-100,4,5,250,7,8,9`` is -7 deg/s about z.
"""

from functools import partial
import math
import re

from gyro_calibration.driver.protocols.protocol import (
    LineSplitter, Protocol, Reading, Sample, Settings, stateless, to_signed_count)

_LINE = re.compile(rb'!ANG:[-+.0-9]+,[-+.0-9]+,[-+.0-9]+,AN:(-?[0-9]{1,5}(?:,-?[0-9]{1,5}){8}) *')


def _parse(line: bytes, settings: Settings) -> Reading | None:
    match = _LINE.fullmatch(line)
    return match and Reading(int(match[1].split(b',')['xyz'.index(settings.axis)]))


def _write(value: float, sample: Sample, settings: Settings) -> bytes:
    counts = [to_signed_count(value) if axis == settings.axis else 0 for axis in 'xyz']
    return b'!ANG:0.00,0.00,0.00,AN:%d,%d,%d,0,0,0,0,0,0\r\n' % tuple(counts)


MINIMU9 = Protocol(
    name='minimu9', text=__doc__,
    baud=115200, rate=50.0, sensitivity=math.radians(0.07),
    splitter=partial(LineSplitter, (b'!',)), parser=stateless(_parse),
    writer=stateless(_write), largest_count=0x8000,
    noise_density=math.radians(0.03))  # data sheet of the L3G4200D
