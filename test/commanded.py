# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Logs of a robot that follows a commanded rate, which is their reference, as a second order."""

from gyro_calibration.logs.log import DEGREE, Log
import numpy as np
from scipy.signal import lsim

SCALE_FACTOR_ERROR, BIAS = 0.02, 0.3 * DEGREE


def commanded_log(seed, ramp=0.3, wobble=0.0, duration=200.0):
    """
    Return a log of 50 samples a second; each rate is held for 1 to 4 s, and so is zero.

    `ramp` is the time of a change of the command, s, and `wobble` the standard deviation of what
    the motion adds to it, deg/s.

    """
    generator = np.random.default_rng(seed)
    knots = [(0.0, 0.0), (4.0, 0.0)]
    while knots[-1][0] < duration:
        begin = knots[-1][0]
        rate = generator.choice([-1.0, 1.0]) * generator.uniform(10.0, 90.0) * DEGREE
        turn, rest = generator.uniform(1.0, 4.0, 2)
        knots += [(begin + ramp, rate), (begin + ramp + turn, rate),
                  (begin + 2.0 * ramp + turn, 0.0), (begin + 2.0 * ramp + turn + rest, 0.0)]
    time = np.arange(0.0, duration, 0.004)
    command = np.interp(time, *np.array(knots).T)
    frequency, damping = generator.uniform(5.0, 12.0), generator.uniform(0.5, 1.1)
    _, rate, _ = lsim(([frequency ** 2], [1.0, 2.0 * damping * frequency, frequency ** 2]),
                      np.interp(time - 0.06, time, command), time)
    slow = np.interp(time, np.arange(0.0, duration + 1.0), generator.standard_normal(
        int(duration) + 1))
    rate = rate + wobble * DEGREE * slow * (command != 0.0)
    output = (1.0 + SCALE_FACTOR_ERROR) * rate[::5] + BIAS + (
        0.02 * DEGREE * generator.standard_normal(len(time[::5])))
    return Log(output=output, time=time[::5], reference_rate=command[::5])
