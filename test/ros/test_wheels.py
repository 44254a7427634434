# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""What odometry and commands of the last second show of the wheels."""

import math

from gyro_calibration.ros.inputs import (
    COASTING_DURATION,
    COMMAND,
    MAX_VELOCITY_AGE,
    ODOMETRY,
    Velocity,
    Wheels,
)
import pytest


def wheels(*received):
    """Return wheels of which came: source, velocity ahead, yaw rate, time."""
    made = Wheels()
    for source, ahead, turning, time in received:
        made.add(source, Velocity((ahead, 0.0, 0.0), (0.0, 0.0, turning)), time)
    return made


OLD = 10.0 + MAX_VELOCITY_AGE
STOPPED = (COMMAND, 1.0, 0.0, 10.0), (COMMAND, 0.0, 0.0, 10.1)
CASES = {  # what was received, when it is asked, whether the robot moves
    'nothing': ([], 10.0, None),
    'zero': ([(ODOMETRY, 0.0, 0.0, 10.0)], 10.5, False),
    'below the limits': ([(ODOMETRY, 9e-4, 1e-4, 10.0)], 10.5, False),
    'back': ([(ODOMETRY, -0.01, 0.0, 10.0)], 10.5, True),
    '0.05 deg/s': ([(ODOMETRY, 0.0, -9e-4, 10.0)], 10.5, True),
    'a second old': ([(ODOMETRY, 1.0, 0.3, 10.0)], OLD, True),
    'older': ([(ODOMETRY, 1.0, 0.3, 10.0)], OLD + 0.01, None),
    'one of two': ([(ODOMETRY, 0.0, 0.0, 10.0), (COMMAND, 1.0, 0.0, 10.0)], 10.1, True),
    'an old one of two': ([(COMMAND, 1.0, 0.0, 10.0), (ODOMETRY, 0.0, 0.0, 11.5)], 11.6, False),
    'coasting after the last command to move': (STOPPED, 10.0 + 0.9 * COASTING_DURATION, True),
    'no longer': (STOPPED, 10.01 + COASTING_DURATION, False),
    'odometry, which shows coasting itself': (
        [(ODOMETRY, 1.0, 0.0, 10.0), (ODOMETRY, 0.0, 0.0, 10.1)], 10.2, False),
    'not a number': ([(ODOMETRY, math.nan, 0.0, 10.0)], 10.1, None),
    'infinite': ([(ODOMETRY, math.inf, 0.0, 10.0)], 10.1, None),
    'finite before': ([(ODOMETRY, 1.0, 0.0, 10.0), (ODOMETRY, 0.0, math.nan, 10.1)], 10.2, True),
}


@pytest.mark.parametrize('received, now, moving', CASES.values(), ids=CASES)
def test_velocities_of_the_last_second_show_whether_the_robot_moves(received, now, moving):
    assert wheels(*received).is_moving(now) is moving


def test_age_and_yaw_rate_are_those_of_the_last_second():
    turning = wheels((ODOMETRY, 1.0, 0.3, 10.0), (ODOMETRY, 0.0, math.inf, 10.3))
    assert turning.age(10.5) == 0.5 and turning.turn_rate(OLD) == 0.3
    assert turning.turn_rate(OLD + 0.01) == 0.0
    assert wheels().age(10.0) == math.inf and wheels().turn_rate(10.0) == 0.0


def test_only_the_sources_that_are_asked_count():
    both = wheels((ODOMETRY, 0.0, 0.0, 10.0), (COMMAND, 1.0, 0.0, 10.0))
    assert both.is_moving(10.1, (ODOMETRY,)) is False and both.is_moving(10.1, (COMMAND,)) is True
    assert both.is_moving(10.1, ()) is None
