"""The compensation node in the process of the test, which sets its clocks: silence, pauses, and services that meet the last sample."""

import contextlib
from types import SimpleNamespace

import numpy as np
import pytest

from gyro_calibration.log import DEGREE
from gyro_calibration.motion import CALIBRATION

try:
    import rclpy
    from diagnostic_msgs.msg import DiagnosticStatus
    from rclpy.parameter import Parameter
    from rclpy.signals import SignalHandlerOptions
    from rclpy.time import Time
    from sensor_msgs.msg import Imu
    from std_srvs.srv import Trigger

    from gyro_calibration.ros.compensation_node import CompensationNode
except ImportError:
    pass  # the fixture `ros_domain` skips every test that needs them, and says why


class Robot:
    """A node, the clocks of its computer, s, and a gyro at rest."""

    def __init__(self, node):
        self.node, self.steady, self.stamp = node, 1000.0, 1.7e9
        self._noise = np.random.default_rng(0)

    def sample(self, after=0.01, waited=None, rate=0.0):
        """Let the node take a sample, stamped so long after the one before, s; its clock goes on by that, or by what it waited."""
        self.stamp += after
        self.steady += after if waited is None else waited
        message = Imu()
        message.header.stamp = Time(nanoseconds=round(self.stamp * 1e9)).to_msg()
        message.angular_velocity.z = rate + 1e-3 * self._noise.standard_normal()
        self.node._on_imu(message)

    @property
    def beginnings(self):
        """Return how often the gyro was taken for one that has just been turned on, or calibrated."""
        return self.node._rooms.live.beginnings


@pytest.fixture
def start(ros_domain, monkeypatch, tmp_path):
    with contextlib.ExitStack() as closing:
        def start(**parameters):
            given = {'calibration_file': tmp_path / 'calibration.yaml', **parameters}
            words = [word for name, value in given.items() for word in ('-p', f'{name}:={value}')]
            rclpy.init(args=['test', '--ros-args', *words], signal_handler_options=SignalHandlerOptions.NO)
            closing.callback(rclpy.shutdown)
            robot = Robot(None)
            for place in ('host_clock', 'compensation_node'):
                monkeypatch.setattr(f'gyro_calibration.{place}.steady', lambda: robot.steady)
            monkeypatch.setattr('gyro_calibration.driver.host_clock.time', SimpleNamespace(time=lambda: robot.steady + 1.7e9))
            robot.node = CompensationNode()
            closing.callback(robot.node.destroy_node)
            return robot
        yield start


def played(robot, samples=50, **how):
    for _ in range(samples):
        robot.sample(**how)


def test_a_gyro_that_was_silent_by_its_stamps_too_may_have_been_without_power(start):
    robot = start()
    played(robot)
    robot.sample(9.0)
    assert robot.beginnings == 1
    robot.sample(12.0)
    assert robot.beginnings == 2


def test_samples_that_waited_while_the_node_was_busy_are_no_silence(start):
    robot = start()
    played(robot)
    robot.sample(waited=12.0)
    played(robot, waited=0.0)
    assert robot.beginnings == 1
    robot.sample(2.0, waited=15.0)
    assert robot.beginnings == 1, 'the queue overflowed, and still there was power'


def test_a_simulation_that_pauses_is_no_silence(start):
    robot = start(use_sim_time=True)
    clock = robot.node.get_clock()
    clock.set_ros_time_override(Time(seconds=100, clock_type=clock.clock_type))
    played(robot)
    robot.steady += 60.0
    robot.sample()
    assert robot.beginnings == 1


def test_without_standing_no_rate_is_rest_to_the_check_from_the_first_sample_on(start):
    assert start(standing='none').node._rooms.check.standing == 0.0


def asked(callback):
    """Call a service of the node, and return its coroutine, which waits for samples."""
    coroutine = callback(Trigger.Request(), Trigger.Response())
    coroutine.send(None)
    return coroutine


def answered(coroutine):
    """Return the response of a service whose run is complete."""
    with pytest.raises(StopIteration) as end:
        coroutine.send(None)
    return end.value.value


@pytest.mark.parametrize('samples, cancelled', [(50, True), (110, False)])
def test_a_cancel_that_comes_with_the_last_sample_does_not_say_that_the_old_calibration_is_in_use(start, samples, cancelled):
    robot = start(bias_duration=1.0)
    services = robot.node._calibrations
    calibration = asked(services._on_calibrate_bias)
    played(robot, samples)
    cancel = services._on_cancel(Trigger.Request(), Trigger.Response())
    assert cancel.success is cancelled and ('the old one' in cancel.message) is cancelled, cancel.message
    assert answered(calibration).success is not cancelled


def test_a_pause_of_the_node_ends_no_calibration_whose_samples_wait_behind_the_timers(start):
    robot = start(bias_duration=1.0)
    calibration = asked(robot.node._calibrations._on_calibrate_bias)
    played(robot, 50)
    robot.steady += 60.0
    robot.node._watch()
    played(robot, 60, waited=0.0)
    assert answered(calibration).success


def test_silence_ends_a_calibration(start):
    robot = start(bias_duration=1.0)
    calibration = asked(robot.node._calibrations._on_calibrate_bias)
    played(robot)
    for _ in range(2):
        robot.steady += 6.0
        robot.node._watch()
    assert 'no sample came for 5 s' in answered(calibration).message


def driven(start):
    """Return a robot that the node drives from now on, the list of its commands, rad/s, and the coroutine of the calibration."""
    robot, commands = start(drive_profile=True), []
    services = robot.node._calibrations
    services._velocity = SimpleNamespace(publish=lambda message: commands.append(message.angular.z), wait_for_all_acked=lambda _: True,
                                         get_subscription_count=lambda: 1)
    return robot, commands, asked(services._on_calibrate)


def test_the_node_drives_the_profile_and_stops_the_robot_at_the_end(start):
    robot, commands, calibration = driven(start)
    for rate in CALIBRATION.rate_at(np.arange(0.0, CALIBRATION.duration + 4.1, 0.01)):
        robot.sample(rate=rate)
        robot.node._calibrations._drive()
    answer = answered(calibration)
    assert answer.success and commands[-1] == 0.0, answer.message
    assert (max(commands), min(commands)) == pytest.approx((45.0 * DEGREE, -45.0 * DEGREE), abs=1e-6)


def test_taking_drive_profile_back_gives_the_run_up_and_stops_the_robot(start):
    robot, commands, calibration = driven(start)
    for rate in CALIBRATION.rate_at(np.arange(0.0, 3.0, 0.01)):
        robot.sample(rate=rate)
        robot.node._calibrations._drive()
    assert commands[-1] > 0.5
    robot.node.set_parameters([Parameter('drive_profile', value=False)])
    robot.node._watch()
    assert 'drive_profile was set to false' in answered(calibration).message and commands[-1] == 0.0


def test_bad_news_are_told_at_once(start):
    """Not with the next report, a second later."""
    robot = start()
    played(robot)
    robot.node._diagnostics.now()
    assert robot.node._diagnostics.level == DiagnosticStatus.OK
    robot.sample(-10.0, waited=0.01)
    robot.node._watch()
    assert robot.node._diagnostics.level == DiagnosticStatus.WARN


@pytest.mark.parametrize('interval, burst', [(0.01, 2), (0.1, 1), (0.01, 20), (0.2, 1)], ids=['100 Hz', '10 Hz', 'bursts', '5 Hz'])
def test_a_robot_is_driven_on_between_samples_that_are_seldom_or_come_in_bursts_and_not_after_them(start, interval, burst):
    robot, commands, calibration = driven(start)
    services = robot.node._calibrations

    def wait(seconds):
        for _ in range(round(seconds / 0.02)):
            robot.steady += 0.02
            services._drive()
    for _ in range(round(3.0 / interval / burst)):
        wait(interval * burst)
        played(robot, burst, after=interval, waited=0.0)
    assert min(commands[-20:]) > 0.5
    commands.clear()
    wait(1.0)
    assert 'while the robot was driven' in answered(calibration).message
    assert sum(command != 0.0 for command in commands) <= 26 and commands[-1] == 0.0
