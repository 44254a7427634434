"""What odometry and commands of the last second say of the wheels."""

from types import SimpleNamespace

import pytest

from gyro_calibration.ros.wheels import COASTING, COMMAND, FRESH, ODOMETRY, Standing, Wheels


def twist(ahead=0.0, turning=0.0):
    """Return a velocity as a message has it."""
    return SimpleNamespace(linear=SimpleNamespace(x=ahead, y=0.0, z=0.0), angular=SimpleNamespace(x=0.0, y=0.0, z=turning))


@pytest.fixture
def wheels():
    return Wheels(Standing())


def test_nothing_heard_says_nothing(wheels):
    assert wheels.moving(10.0) is None and wheels.age(10.0) == float('inf')


@pytest.mark.parametrize('given, moving', [
    (twist(), False), (twist(0.0009, 0.0001), False), (twist(-0.01), True), (twist(0.0, -9e-4), True)],
    ids=['zero', 'below the limits', 'back', '0.05 deg/s'])
def test_a_velocity_beyond_small_limits_is_motion(wheels, given, moving):
    wheels.hear(ODOMETRY, given, 10.0)
    assert wheels.moving(10.5) is moving and wheels.age(10.5) == 0.5


def test_what_is_older_than_a_second_says_nothing(wheels):
    wheels.hear(ODOMETRY, twist(1.0), 10.0)
    assert wheels.moving(10.0 + FRESH) is True and wheels.moving(10.01 + FRESH) is None
    assert wheels.moving(5.0) is None, 'the clock was set back'


def test_one_source_that_moves_is_enough_and_an_old_one_does_not_count(wheels):
    wheels.hear(ODOMETRY, twist(), 10.0)
    wheels.hear(COMMAND, twist(1.0), 10.0)
    assert wheels.moving(10.1) is True
    wheels.hear(ODOMETRY, twist(), 11.5)
    assert wheels.moving(11.6) is False


def test_a_robot_coasts_after_its_last_command_to_move(wheels):
    wheels.hear(COMMAND, twist(1.0), 10.0)
    wheels.hear(COMMAND, twist(), 10.1)
    assert wheels.moving(10.0 + 0.9 * COASTING) is True and wheels.moving(10.01 + COASTING) is False
    wheels.hear(ODOMETRY, twist(1.0), 20.0)
    wheels.hear(ODOMETRY, twist(), 20.1)
    assert wheels.moving(20.2) is False, 'odometry tells of coasting itself'


@pytest.mark.parametrize('value', [float('nan'), float('inf')])
def test_a_velocity_that_is_not_finite_says_nothing(wheels, value):
    wheels.hear(ODOMETRY, twist(value), 10.0)
    assert wheels.moving(10.1) is None
    wheels.hear(ODOMETRY, twist(1.0), 10.2)
    wheels.hear(ODOMETRY, twist(0.0, value), 10.3)
    assert wheels.moving(10.4) is True and wheels.age(10.4) == pytest.approx(0.2)
