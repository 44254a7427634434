# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""A measured gyro on a turntable: calibrated on 20 s, its heading follows the encoder 5 min."""

import math

from gyro_calibration.heading.integration import integrate
from gyro_calibration.logs.log import DEGREE, read_log
from gyro_calibration.ros.calibration_session import ODOMETRY
from gyro_calibration.ros.inputs import Velocity
import numpy as np
import pytest
from rig import Rig

DURATION = 300.0  # s


@pytest.fixture
def recording(data):
    """Return time, s, output, rad/s, and encoder heading, rad; the gyro is mounted upside down."""
    log = read_log(data / 'mems_encoder_turntable' / 'yaw_slow.csv.gz')
    part = log.time < DURATION
    heading = log.reference_heading[part]
    return log.time[part], -log.output[part], heading - heading[0]


def rms(error):
    return math.sqrt(np.mean(np.square(error))) / DEGREE


def test_calibrated_on_20_s_the_heading_follows_the_encoder_for_five_minutes(tmp_path, recording):
    time, output, heading = recording
    rig = Rig(tmp_path, model='', stationary_threshold=0.0, calibration_reference=ODOMETRY)
    rig.begin(ODOMETRY)
    answers, found = [], []
    for stamp, rate, turned in zip(time.tolist(), output.tolist(), heading.tolist()):
        nanoseconds = round(1e9 * stamp)
        rig.clock.now = 1000.0 + stamp
        rig.pipeline.add_odometry(nanoseconds, math.remainder(turned, math.tau), Velocity())
        found.append(rig.pipeline.add_sample(nanoseconds, rate).heading)
        if rig.session.run and rig.ended:
            answers.append(rig.session.conclude())
    assert answers and answers[0][0], answers
    error, pure = np.array(found) - found[0] - heading, integrate(time, output) - heading
    assert rms(error) < rms(pure) / 3.0, (rms(error), rms(pure), answers)
