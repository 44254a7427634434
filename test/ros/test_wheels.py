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

from gyro_calibration.ros.wheels import (
    COASTING_DURATION,
    COMMAND,
    MAX_VELOCITY_AGE,
    ODOMETRY,
    Velocity,
    Wheels,
)
import pytest


def velocity(ahead=0.0, turning=0.0):
    return Velocity((ahead, 0.0, 0.0), (0.0, 0.0, turning))


@pytest.fixture
def wheels():
    return Wheels()


def test_nothing_received_shows_nothing(wheels):
    assert wheels.is_moving(10.0) is None and wheels.age(10.0) == math.inf
    assert wheels.turn_rate(10.0) == 0.0


@pytest.mark.parametrize('given, moving', [(velocity(), False), (velocity(0.0009, 0.0001), False),
                                           (velocity(-0.01), True), (velocity(0.0, -9e-4), True)],
                         ids=['zero', 'below the limits', 'back', '0.05 deg/s'])
def test_a_velocity_beyond_small_limits_is_motion(wheels, given, moving):
    wheels.add(ODOMETRY, given, 10.0)
    assert wheels.is_moving(10.5) is moving and wheels.age(10.5) == 0.5


def test_what_is_older_than_a_second_shows_nothing(wheels):
    wheels.add(ODOMETRY, velocity(1.0, 0.3), 10.0)
    assert (wheels.is_moving(10.0 + MAX_VELOCITY_AGE) is True
            and wheels.turn_rate(10.0 + MAX_VELOCITY_AGE) == 0.3)
    assert (wheels.is_moving(10.01 + MAX_VELOCITY_AGE) is None
            and wheels.turn_rate(10.01 + MAX_VELOCITY_AGE) == 0.0)


def test_one_source_that_moves_is_enough_and_an_old_one_does_not_count(wheels):
    wheels.add(ODOMETRY, velocity(), 10.0)
    wheels.add(COMMAND, velocity(1.0), 10.0)
    assert wheels.is_moving(10.1) is True
    wheels.add(ODOMETRY, velocity(), 11.5)
    assert wheels.is_moving(11.6) is False


def test_only_the_sources_that_are_asked_count(wheels):
    wheels.add(ODOMETRY, velocity(), 10.0)
    wheels.add(COMMAND, velocity(1.0), 10.0)
    assert (wheels.is_moving(10.1, (ODOMETRY,)) is False
            and wheels.is_moving(10.1, (COMMAND,)) is True)
    assert wheels.is_moving(10.1, ()) is None


def test_a_robot_coasts_after_its_last_command_to_move(wheels):
    wheels.add(COMMAND, velocity(1.0), 10.0)
    wheels.add(COMMAND, velocity(), 10.1)
    assert wheels.is_moving(10.0 + 0.9 * COASTING_DURATION) is True
    assert wheels.is_moving(10.01 + COASTING_DURATION) is False
    wheels.add(ODOMETRY, velocity(1.0), 20.0)
    wheels.add(ODOMETRY, velocity(), 20.1)
    assert wheels.is_moving(20.2) is False, 'odometry shows coasting itself'


@pytest.mark.parametrize('value', [math.nan, math.inf])
def test_a_velocity_that_is_not_finite_shows_nothing(wheels, value):
    wheels.add(ODOMETRY, velocity(value), 10.0)
    assert wheels.is_moving(10.1) is None
    wheels.add(ODOMETRY, velocity(1.0), 10.2)
    wheels.add(ODOMETRY, velocity(0.0, value), 10.3)
    assert wheels.is_moving(10.4) is True and wheels.age(10.4) == pytest.approx(0.2)
