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
Razor AHRS firmware (SparkFun 9DoF Razor IMU, Sensor Stick, OpenLog Artemis): lines ``#YPRAG=``.

Their nine numbers are yaw, pitch and roll, the accelerations and the rates about x, y and z. The
driver requests them at the start with ``#ox#o1``; earlier lines ``#YPR=`` are skipped. The rates
in rad/s have two decimals, a step of 0.57 deg/s: too coarse for a calibration, unless the noise is
larger than the step. Print more decimals in the firmware. The accelerations are in 1/256 g and
negated, so that the axis that points down has 256. The axes of the firmware point forward, right
and down; here they are turned to forward, left and up (REP-103), so that y and z change their
sign.

``#YPRAG=-142.28,-5.38,33.52,12.8,-25.6,256.00,0.01,0.02,-0.03`` is 0.03 rad/s about z,
counter-clockwise from above, and 9.81 m/s² up.

Source: the comments of the firmware and the driver in ``razor_imu_9dof`` 1.3.0 (file
Razor_AHRS.ino, on axes and serial commands; node imu_node.py). For older firmware that sends
counts set ``sensitivity``.
"""

from functools import partial
import math
import re

from gyro_calibration.driver.protocols.protocol import (
    LineSplitter, NUMBER, Protocol, Reading, Sample, Settings, stateless)
from gyro_calibration.logs.columns import STANDARD_GRAVITY

_LINE = re.compile(rb'#YPRAG=(' + NUMBER + rb'(?:,' + NUMBER + rb'){8}) *')
# default output of the firmware
_ANGLES_LINE = re.compile(rb'#YPR=' + NUMBER + rb'(?:,' + NUMBER + rb'){2} *')
_FORCE_PER_COUNT = STANDARD_GRAVITY / 256.0
_AXIS_SIGNS = {'x': 1.0, 'y': -1.0, 'z': -1.0}  # from forward, right, down to forward, left, up


def _parse(line: bytes, settings: Settings) -> Reading | None:
    match = _LINE.fullmatch(line)
    if match is None:
        return Reading(None) if _ANGLES_LINE.fullmatch(line) else None
    axis, turned = 'xyz'.index(settings.axis), _AXIS_SIGNS[settings.axis]
    numbers = match[1].split(b',')
    force = -turned * float(numbers[3 + axis]) * _FORCE_PER_COUNT
    return Reading(turned * float(numbers[6 + axis]),
                   specific_force=force if math.isfinite(force) else None)


def _write(value: float, sample: Sample, settings: Settings) -> bytes:
    turned, force = _AXIS_SIGNS[settings.axis], sample.specific_force
    force = STANDARD_GRAVITY if force is None else force
    accelerations, rates = [0.0] * 3, [0.0] * 3
    axis = 'xyz'.index(settings.axis)
    accelerations[axis], rates[axis] = -turned * force / _FORCE_PER_COUNT, turned * value
    return b'#YPRAG=0.00,0.00,0.00,%.2f,%.2f,%.2f,%.2f,%.2f,%.2f\r\n' % (*accelerations, *rates)


RAZOR = Protocol(
    name='razor', text=__doc__,
    baud=57600, rate=50.0, sensitivity=1.0, splitter=partial(LineSplitter, (b'#',)),
    parser=stateless(_parse), writer=stateless(_write), startup=b'#ox#o1',
    # just above the 16 bits of an ITG-3200, 0.06957 deg/s each, the widest range of these gyros
    full_scale=40.0)
