"""Calibrations by odometry and by whole turns, and the rest after a run that can still refuse it, for the node as a robot has it."""

import math

import numpy as np
import pytest
from fake_gyro import INTERVAL, FakeGyro

from gyro_calibration.log import DEGREE
from gyro_calibration.model_file import read_model
from gyro_calibration.motion import CALIBRATION, turns

try:
    from nav_msgs.msg import Odometry
    from std_msgs.msg import Bool
    from std_srvs.srv import Trigger
except ImportError:
    pass  # the fixture `ros` skips every test that needs them, and says why

SCALE_FACTOR_ERROR, BIAS = 0.0373, 0.75 * DEGREE / 60


def output(motion, after, noise=1e-4):
    """Return what a gyro with the errors of this test says of a motion and the rest after it."""
    rates = motion.rate_at(np.arange(0.0, motion.duration + after, INTERVAL))
    return (1 + SCALE_FACTOR_ERROR) * rates + BIAS + noise * np.random.default_rng(0).standard_normal(len(rates))


@pytest.fixture
def start(start_node, ros, wait_until, tmp_path):
    def start(**parameters):
        given = {'calibration_file': tmp_path / 'calibration.yaml', **parameters}
        return start_node('compensation_node', parameters=given), FakeGyro(ros, wait_until)
    return start


def begun(gyro):
    """Call a calibration, and return its answer to come."""
    answer = gyro.call_later('calibrate')
    gyro.wait_until(gyro.calibrating, what='the calibration to begin')
    return answer


def ended(gyro, answer):
    gyro.wait_until(answer.done, what='the answer')
    return answer.result()


def stored(tmp_path):
    return read_model(tmp_path / 'calibration.yaml').self_calibration


def test_odometry_is_a_reference(start, ros, tmp_path):
    _, gyro = start(reference='odometry')
    publisher, latched = ros.publisher(Odometry, 'odom'), ros.collect(Bool, 'calibrated', _latched())
    gyro.wait_until(publisher.get_subscription_count)

    def odometry(number):
        if number % 5 == 0:
            message, time = Odometry(), np.array(number * INTERVAL)
            message.header.stamp = gyro.stamp()
            half = 0.5 * float(CALIBRATION.heading_at(time))
            message.pose.pose.orientation.z, message.pose.pose.orientation.w = math.sin(half), math.cos(half)
            message.twist.twist.angular.z = float(CALIBRATION.rate_at(time))
            publisher.publish(message)
    answer = begun(gyro)
    gyro.play(output(CALIBRATION, 5.0), before=odometry, until=answer.done)
    result = ended(gyro, answer)
    assert result.success and 'at rest after it the rate was' in result.message, result.message
    assert stored(tmp_path).scale_factor_error == pytest.approx(SCALE_FACTOR_ERROR, abs=2e-3) and stored(tmp_path).method == 'odometry'
    assert stored(tmp_path).bias == pytest.approx(BIAS, abs=2e-4)
    assert stored(tmp_path).standard_deviations[0] > 0.01, 'no run is better than its odometry'
    gyro.wait_until(lambda: latched[-1].data, what='calibrated')


def _latched():
    from gyro_calibration.ros.runner import LATCHED_QOS
    return LATCHED_QOS


def test_without_odometry_it_is_refused_and_the_reason_stays_in_the_diagnostics(start):
    _, gyro = start(reference='odometry', reference_duration=5.0, check_after_run=False)
    answer = begun(gyro)
    gyro.play(output(CALIBRATION, 0.0)[:800], until=answer.done)
    result = ended(gyro, answer)
    assert not result.success and '0 messages came on odom' in result.message
    gyro.diagnostics.clear()
    gyro.wait_until(lambda: gyro.diagnostics and gyro.values()['refused_calibrations'] == '1')
    assert '0 messages came on odom' in gyro.values()['refusals']


def test_whole_turns_on_a_mark_are_a_reference(start, tmp_path):
    _, gyro = start(reference='turns', turns=2)
    assert not gyro.ros.call(Trigger, 'finish_calibration').success, 'nothing goes on'
    answer = begun(gyro)
    early = gyro.ros.call(Trigger, 'finish_calibration')
    assert not early.success and 'no sample has come since' in early.message
    motion = turns([(3.0, 0.0), (12.0, 60.0), (3.0, 0.0)])
    gyro.play(output(motion, 0.0))
    for _ in range(2):
        pressed = gyro.ros.call(Trigger, 'finish_calibration')
        assert pressed.success and 'leave the robot at rest for 2.5 s more' in pressed.message
    gyro.play(output(motion, 3.0)[-300:], until=answer.done)
    result = ended(gyro, answer)
    assert result.success and '2 whole turns' in result.message and stored(tmp_path).method == 'turns', result.message
    # The ramps to and from 60 deg/s are alike, so that these are two turns exactly.
    assert stored(tmp_path).scale_factor_error == pytest.approx(SCALE_FACTOR_ERROR, abs=2e-3)
    assert stored(tmp_path).bias == pytest.approx(BIAS, abs=1e-4)


def test_a_robot_that_drives_on_after_its_run_has_no_calibration(start, tmp_path):
    _, gyro = start()
    answer = begun(gyro)
    rates = output(CALIBRATION, 4.1)
    rates[2200:] += 2.0 * DEGREE
    gyro.play(rates, until=answer.done)
    result = ended(gyro, answer)
    assert not result.success and 'after the run' in result.message and not (tmp_path / 'calibration.yaml').exists()
