"""
A drive with stops, wheels, temperature, a restart and a clock that jumps, for the node as a process of its own, by fake publishers.

What is computed is tested in test_live_heading.py; here, that the node brings it to topics, files, parameters and diagnostics.

"""

import math
from functools import partial
from itertools import count

import numpy as np
import pytest
import yaml
from fake_gyro import start_with_gyro

from gyro_calibration.log import DEGREE
from gyro_calibration.noise import Noise

try:
    from geometry_msgs.msg import PoseWithCovarianceStamped, TwistStamped
    from nav_msgs.msg import Odometry
    from rcl_interfaces.srv import SetParameters
    from rclpy.parameter import Parameter
    from std_msgs.msg import Bool
except ImportError:
    pass  # the fixture `ros` skips every test that needs them, and says why

INTERVAL, NOISE = 0.04, 5e-4
BIAS = 0.012  # rad/s; the model knows of most of it
MODEL = {'effects': {'bias': {'bias': 0.01}}, 'noise': {'angle_random_walk': NOISE, 'bias_instability': 1e-5}}


@pytest.fixture
def start(start_node, ros, wait_until, tmp_path):
    return partial(start_with_gyro, start_node, ros, wait_until, tmp_path, MODEL, INTERVAL, BIAS)


def outputs(seconds, rate=0.0, bias=BIAS, seed=0):
    """Return what the gyro says while the robot turns at a rate, rad/s."""
    samples = round(seconds / INTERVAL)
    deviation = math.sqrt(Noise(NOISE).rate_variance(INTERVAL))
    return rate + bias + deviation * np.random.default_rng(seed).standard_normal(samples)


def told(gyro, condition, what, bias=BIAS, temperature=None):
    """Play a rest, its noise never the same, until the newest diagnostics fulfil a condition, and return their values."""
    gyro.diagnostics.clear()
    seeds = count(1)
    gyro.wait_until(lambda: gyro.play(outputs(0.4, bias=bias, seed=next(seeds)), temperature) or gyro.diagnostics and condition(
        gyro.values()), what=what)
    return gyro.values()


def set_parameter(ros, name, value):
    """Set a parameter of the node, and return the result."""
    request = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
    return ros.call(SetParameters, '/compensation_node/set_parameters', request).results[0]


def headings(gyro):
    return np.array([message.data for message in gyro.heading])


def test_a_drive_with_stops(start, ros, wait_until):
    """The heading stands at rest and is continuous; who asks for its variance gets it; parameters act, and are checked."""
    _, gyro = start()
    latched = ros.collect(Bool, 'calibrated', _latched())
    for turn in (0.5, -0.3):
        gyro.play(outputs(20.0))
        stood = headings(gyro)[-100:]
        assert np.ptp(stood) == 0.0 and gyro.rate[-1].data == 0.0
        gyro.play(outputs(4.0, turn))
    gyro.play(outputs(15.0))
    assert headings(gyro)[-1] == pytest.approx(0.8, abs=0.02)
    assert np.abs(np.diff(headings(gyro))).max() < 1.2 * 0.5 * INTERVAL
    assert 0.0 < gyro.imu[-1].orientation_covariance[8] < (4.0 * 0.5 * 0.04) ** 2
    wait_until(lambda: latched and not latched[-1].data, what='the latched state')
    values = told(gyro, lambda values: values['resting'] == 'True', 'rest')
    assert float(values['bias_learned_deg_s']) == pytest.approx(0.002 / DEGREE, abs=0.02) and values['wheels'] == 'unknown'
    assert 'cannot be told from drift' in values['slow_turns'] and float(values['slowest_noticed_turn_deg_s']) > 0.0
    assert float(values['input_rate_hz']) > 50.0 and values['standing'] == 'rest'
    _poses_come_to_who_asks(gyro, ros)
    _parameters_act_and_are_checked(gyro, ros)


def _poses_come_to_who_asks(gyro, ros):
    poses = ros.collect(PoseWithCovarianceStamped, 'heading_with_covariance')
    gyro.wait_until(lambda: gyro.play(outputs(0.4)) or poses, what='poses')
    gyro.play(outputs(2.0, 0.5))
    gyro.wait_until(lambda: poses[-1].header == gyro.imu[-1].header, what='the last pose')
    pose, imu = poses[-1], gyro.imu[-1]
    assert pose.pose.pose.orientation == imu.orientation
    assert pose.pose.covariance[35] == imu.orientation_covariance[8] and pose.pose.covariance[0] == 1e6


def _parameters_act_and_are_checked(gyro, ros):
    refused = set_parameter(ros, 'standing', 'off and on')
    assert not refused.successful and 'rest, threshold or none' in refused.reason
    assert not set_parameter(ros, 'rest_false_alarms', -1.0).successful
    gyro.play(outputs(5.0))
    before = gyro.heading[-1].data
    assert set_parameter(ros, 'standing', 'none').successful
    gyro.wait_until(lambda: gyro.play(outputs(0.4)) or gyro.rate[-1].data != 0.0, what='a rate at rest')
    assert gyro.heading[-1].data == pytest.approx(before, abs=0.01)


def _latched():
    from gyro_calibration.ros.runner import LATCHED_QOS
    return LATCHED_QOS


def test_wheels_and_commands_decide_on_slow_turns(start, ros):
    _, gyro = start(wheels='both', cmd_vel_stamped=True)
    odometry, commands = ros.publisher(Odometry, 'odom'), ros.publisher(TwistStamped, 'cmd_vel', 10)
    slow = 0.05 * DEGREE

    def says(rate):
        def before(number):
            if number % 5 == 0:
                message = Odometry()
                message.twist.twist.angular.z = rate
                odometry.publish(message)
        return before
    gyro.wait_until(odometry.get_subscription_count)
    gyro.play(outputs(60.0), before=says(0.0))
    gyro.wait_until(lambda: gyro.play(outputs(0.4), before=says(0.0)) or gyro.diagnostics and gyro.values()['wheels'] == 'standing')
    assert gyro.values()['slow_turns'] == ''
    begin = headings(gyro)[-1]
    gyro.play(outputs(60.0, slow), before=says(slow))
    assert headings(gyro)[-1] - begin == pytest.approx(60.0 * slow, rel=0.5)
    told(gyro, lambda values: values['wheels'] == 'unknown', 'a word of the wheels that is too old')
    command = TwistStamped()
    command.twist.linear.x = 0.3
    gyro.wait_until(lambda: commands.publish(command) or told(gyro, lambda values: True, 'diagnostics')['wheels'] == 'moving')


def test_a_temperature_step_a_restart_and_a_lost_temperature(start, tmp_path):
    coefficient = 0.02 * DEGREE
    (tmp_path / 'calibration_biases.yaml').write_text('format: something else\n')
    node, gyro = start()
    gyro.play(outputs(30.0), 25.0)
    deviation = math.sqrt(gyro.imu[-1].angular_velocity_covariance[8])
    gyro.play(outputs(5.0, 0.5, BIAS + 10.0 * coefficient), 35.0)
    assert math.sqrt(gyro.imu[-1].angular_velocity_covariance[8]) > 2.0 * deviation
    turned = gyro.heading[-1].data
    gyro.play(outputs(40.0, bias=BIAS + 10.0 * coefficient), 35.0)
    assert gyro.heading[-1].data == pytest.approx(turned, abs=0.05) and gyro.rate[-1].data == 0.0
    told(gyro, lambda values: int(values['bias_table_entries']) >= 2, 'a table', BIAS + 10.0 * coefficient, 35.0)
    assert node.stop() == 0
    assert (tmp_path / 'calibration_biases.yaml.kept-1').read_text() == 'format: something else\n'
    entries = yaml.safe_load((tmp_path / 'calibration_biases.yaml').read_text())['entries']
    assert {round(entry['temperature']) for entry in entries} == {25, 35}
    _, gyro = start()
    gyro.play(outputs(2.0), 25.0)
    assert int(told(gyro, lambda values: values['temperature_degc'], 'a temperature')['bias_table_entries']) >= 2
    gyro.play(outputs(15.0, 0.5))
    gyro.wait_until(lambda: gyro.play(outputs(0.4)) or gyro.says('no temperature comes any more; the last one, 25.0 degC, is held'))


def test_a_clock_that_jumps(start):
    _, gyro = start()
    gyro.play(outputs(10.0))
    for jump in (3600.0, -7200.0):
        gyro.play(outputs(2.0, 0.3))
        variance = gyro.imu[-1].orientation_covariance[8]
        gyro.wait(jump)
        gyro.play(outputs(2.0, 0.3))
        if jump > 0.0:
            assert gyro.imu[-1].orientation_covariance[8] > variance + (0.2 * jump) ** 2
    assert np.abs(np.diff(headings(gyro))).max() < 1.2 * 0.3 * INTERVAL
    gyro.play(outputs(10.0))
    assert gyro.rate[-1].data == 0.0 and int(told(gyro, lambda values: True, 'diagnostics')['restarts']) == 2
