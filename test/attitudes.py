# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""A sensor that is turned about three axes, with its attitude by a motion capture."""

from gyro_calibration.logs.log import DEGREE, log_from_table
import numpy as np
from scipy.spatial.transform import Rotation

SCALE, BIAS = 0.004, 0.2 * DEGREE


def tumbling(seed, misalignment=(0.0, 0.0), sizes=(70.0, 40.0, 40.0), noise=0.03):
    """
    Return the table of a log of 120 s at 100 Hz, and the rates of the sensor, rad/s, (n, 3).

    The angles of yaw, pitch and roll are sums of sines of so many deg; the misalignment in rad is
    the part of the rates about x and y in the output of the gyro, which is along z. The attitude
    has so many deg of noise, and is lost twice.
    """
    generator = np.random.default_rng(seed)
    time = 0.01 * np.arange(12000)
    still = np.clip(np.minimum(time - 5.0, 115.0 - time), 0.0, 1.0)
    omega = 2.0 * np.pi * generator.uniform(0.05, 0.6, (3, 4))
    phase = np.cumsum(still)[:, None, None] * 0.01 * omega
    shift = generator.uniform(0.0, 2.0 * np.pi, omega.shape)
    yaw, pitch, roll = (angles := np.sin(phase + shift).sum(axis=2) * 0.5 * DEGREE * sizes).T
    slopes = (omega * np.cos(phase + shift)).sum(axis=2) * 0.5 * DEGREE * sizes
    by_yaw, by_pitch, by_roll = (slopes * still[:, None]).T
    rates = np.column_stack([
        by_roll - by_yaw * np.sin(pitch),
        by_pitch * np.cos(roll) + by_yaw * np.sin(roll) * np.cos(pitch),
        by_yaw * np.cos(roll) * np.cos(pitch) - by_pitch * np.sin(roll)])
    attitude = Rotation.from_euler('ZYX', angles) * Rotation.from_rotvec(
        noise * DEGREE * generator.standard_normal((len(time), 3)))
    quaternion = attitude.as_quat()
    quaternion[[*range(3000, 3020), *range(8000, 8010)]] = np.nan
    white = 0.05 * DEGREE * generator.standard_normal(len(time))
    output = (1.0 + SCALE) * rates[:, 2] + rates[:, :2] @ misalignment + BIAS + white
    return {'time_s': time, 'gyro_rad_s': output,
            **dict(zip(('qx', 'qy', 'qz', 'qw'), quaternion.T))}, rates


def attitude_log(*given, **options):
    """Return the log of a table of `tumbling`."""
    return log_from_table(tumbling(*given, **options)[0], {'attitude': 'qw/qx/qy/qz'})
