"""The compensation node as a robot has it: its own process, fake publishers, service clients."""

import math
import os
import signal
import time

import numpy as np
import pytest
import yaml
from fake_gyro import INTERVAL, PACE, FakeGyro

from gyro_calibration.log import DEGREE
from gyro_calibration.model_file import read_model
from gyro_calibration.motion import CALIBRATION, from_rates
from gyro_calibration.self_calibration import fit_likelihood

try:
    from diagnostic_msgs.msg import DiagnosticStatus
    from geometry_msgs.msg import Twist
    from std_srvs.srv import Trigger
except ImportError:
    pass  # the fixture `ros` skips every test that needs them, and says why

SCALE_FACTOR_ERROR, BIAS = 0.0373, 0.75 * DEGREE / 60


def output(rates):
    """Return what a gyro with the errors of this test says of true rates, rad/s."""
    return (1 + SCALE_FACTOR_ERROR) * np.asarray(rates) + BIAS


def profile_rates(motion=CALIBRATION, after=4.1):
    """Return what it says of a motion, and of the rest after it: 1 s for a delay, 1 s to settle, 2 s for the check."""
    return output(motion.rate_at(np.arange(0.0, motion.duration + after, INTERVAL)))


@pytest.fixture
def start(start_node, ros, wait_until, tmp_path):
    def start(**parameters):
        given = {'calibration_file': tmp_path / 'calibration.yaml', **parameters}
        return start_node('compensation_node', parameters=given), FakeGyro(ros, wait_until)
    return start


def calibrate(gyro, rates=None, name='calibrate'):
    """Call a calibration, play the run and return the answer."""
    answer = gyro.call_later(name)
    gyro.wait_until(gyro.calibrating, what='the calibration to begin')
    gyro.play(profile_rates() if rates is None else rates, until=answer.done)
    gyro.wait_until(answer.done, what='the answer')
    return answer.result()


def test_without_a_model_it_integrates_raw_rates_by_the_trapezoid_rule_on_the_stamps(start):
    _, gyro = start(threshold=0.0)
    rates = 0.5 * np.sin(np.arange(300) * 0.02)
    gyro.play(rates)
    expected = np.concatenate([[0], np.cumsum((rates[1:] + rates[:-1]) * INTERVAL / 2)])
    np.testing.assert_allclose([message.data for message in gyro.heading], expected, atol=1e-7)
    np.testing.assert_allclose([message.data for message in gyro.rate], rates, atol=1e-12)


def test_the_heading_is_not_wrapped_and_stands_as_yaw_in_the_orientation(start):
    _, gyro = start()
    gyro.play(np.full(500, 4.0))
    assert gyro.heading[-1].data == pytest.approx(4.0 * (4.99 + INTERVAL / 2), abs=1e-6)
    z, w = gyro.imu[-1].orientation.z, gyro.imu[-1].orientation.w
    assert math.remainder(2 * math.atan2(z, w) - gyro.heading[-1].data, math.tau) == pytest.approx(0.0, abs=1e-9)


def test_samples_that_come_while_the_node_is_not_let_run_are_all_used(start):
    node, gyro = start(threshold=0.0)
    os.killpg(node.process.pid, signal.SIGSTOP)
    for _ in range(1000):
        gyro.send(0.5)
        time.sleep(PACE)
    os.killpg(node.process.pid, signal.SIGCONT)
    gyro.wait_until(lambda: len(gyro.heading) == 1000)
    assert gyro.heading[-1].data == pytest.approx(0.5 * (9.99 + INTERVAL / 2), abs=1e-6)


def test_covariances_follow_rep_145(start, tmp_path):
    model = tmp_path / 'model.yaml'
    model.write_text('effects: {bias: {bias: 0.01}}\nnoise: {angle_random_walk: 7.0e-4}')
    _, gyro = start(model_file=model, standing='none')
    gyro.play(np.full(201, 0.5))
    message = gyro.imu[-1]
    assert message.linear_acceleration_covariance[0] == -1.0
    scale, bias = 0.03 * 0.5, 0.5 * DEGREE  # of a gyro that nobody calibrated, at 0.5 rad/s
    assert message.angular_velocity_covariance[8] == pytest.approx(7.0e-4 ** 2 / INTERVAL + scale ** 2 + bias ** 2, rel=0.05)
    grown = message.orientation_covariance[8] - gyro.imu[0].orientation_covariance[8]
    assert grown == pytest.approx(7.0e-4 ** 2 * 2.0 + (2.0 * scale) ** 2 + (2.0 * bias) ** 2, rel=0.05)
    assert message.orientation_covariance[0] == message.orientation_covariance[4] == 1e6
    assert message.header.frame_id == 'gyro'


def test_unknown_noise_gives_unknown_covariance(start):
    _, gyro = start()
    gyro.play(np.full(20, 0.5))
    assert not any(gyro.imu[-1].angular_velocity_covariance) and not any(gyro.imu[-1].orientation_covariance)


def test_calibrate_finds_scale_and_bias_applies_and_stores_them(start, tmp_path):
    _, gyro = start(threshold=0.0)
    before = len(gyro.heading)
    result = calibrate(gyro)
    assert result.success, result.message
    stored = read_model(tmp_path / 'calibration.yaml').self_calibration
    assert stored.scale_factor_error == pytest.approx(SCALE_FACTOR_ERROR, abs=1e-6)
    assert stored.bias == pytest.approx(BIAS, abs=1e-6)
    gyro.play(output(np.full(50, 0.3)))
    assert gyro.rate[-1].data == pytest.approx(0.3, abs=1e-6)
    steps = np.abs(np.diff([message.data for message in gyro.heading[before:]]))
    assert steps.max() < 1.1 * 0.85 * INTERVAL, 'the heading jumped'


def test_the_heading_goes_on_with_the_old_calibration_during_a_run(start):
    _, gyro = start(threshold=0.0)
    rates = profile_rates()
    calibrate(gyro, rates)
    during = np.array([message.data for message in gyro.rate[:2090]])
    np.testing.assert_allclose(during, rates[:len(during)], atol=1e-12)


def test_the_next_start_uses_the_stored_calibration(start, tmp_path):
    node, gyro = start(threshold=0.0)
    assert calibrate(gyro).success
    assert node.stop() == 0
    _, gyro = start(threshold=0.0)
    gyro.wait_until(lambda: gyro.status and 'scale factor error 3.73' in gyro.status[-1].message, what='the status')
    gyro.play(output(np.full(20, 0.3)))
    assert gyro.rate[-1].data == pytest.approx(0.3, abs=1e-6)


def test_a_calibration_behind_another_model_is_not_used_and_this_is_said(start, tmp_path):
    (tmp_path / 'calibration.yaml').write_text('effects: {bias: {bias: 0.1}}\nself_calibration: {scale_factor_error: 0.2, bias: 0.3}')
    _, gyro = start(threshold=0.0)
    gyro.play(np.full(20, 0.5))
    assert gyro.rate[-1].data == 0.5
    gyro.wait_until(lambda: gyro.says('belongs to another model'))


@pytest.mark.parametrize('rates, reason', [
    (np.zeros(2500), 'same value'),
    (BIAS + 1e-4 * np.random.default_rng(1).standard_normal(2500), 'did the robot move'),
    (-profile_rates(), 'invert'),
    (np.where(np.arange(2410) // 30 == 11, 0.0, profile_rates()), 'a slip or a bump'),
], ids=['dead', 'not moved', 'wrong sign', 'slip'])
def test_a_run_that_cannot_be_believed_is_refused_and_changes_nothing(start, tmp_path, rates, reason):
    _, gyro = start(threshold=0.0)
    result = calibrate(gyro, rates)
    assert not result.success and reason in result.message
    assert not (tmp_path / 'calibration.yaml').exists()
    gyro.play([0.5])
    assert gyro.rate[-1].data == 0.5


def test_calling_calibrate_twice_refuses_the_second_and_leaves_the_first_alone(start):
    _, gyro = start()
    first = gyro.call_later('calibrate')
    gyro.wait_until(gyro.calibrating)
    second = gyro.ros.call(Trigger, 'calibrate')
    assert not second.success and 'going on already' in second.message
    gyro.play(profile_rates(), until=first.done)
    gyro.wait_until(first.done)
    assert first.result().success


def test_cancel_ends_a_run_and_keeps_the_old_calibration(start, tmp_path):
    _, gyro = start()
    first = gyro.call_later('calibrate')
    gyro.wait_until(gyro.calibrating)
    gyro.play(profile_rates()[:500])
    assert gyro.ros.call(Trigger, 'cancel_calibration').success
    gyro.wait_until(first.done)
    assert not first.result().success and 'cancelled' in first.result().message
    assert not (tmp_path / 'calibration.yaml').exists()
    assert not gyro.ros.call(Trigger, 'cancel_calibration').success, 'there was nothing left to cancel'


def test_calibrate_without_samples_is_given_up(start):
    _, gyro = start(sample_timeout=0.5)
    result = gyro.ros.call(Trigger, 'calibrate')
    assert not result.success and 'no sample came for 0.5 s' in result.message


def test_calibrate_bias_takes_the_mean_at_rest_and_keeps_the_scale(start, tmp_path):
    _, gyro = start(bias_duration=2.0, threshold=0.0)
    assert calibrate(gyro).success
    noise = 1e-3 * np.random.default_rng(2).standard_normal(300)
    result = calibrate(gyro, 0.02 + noise, 'calibrate_bias')
    assert result.success, result.message
    stored = read_model(tmp_path / 'calibration.yaml').self_calibration
    assert stored.bias == pytest.approx(0.02, abs=4e-4)
    assert stored.scale_factor_error == pytest.approx(SCALE_FACTOR_ERROR, abs=1e-6)


def test_calibrate_bias_refuses_a_gyro_that_is_moved(start):
    _, gyro = start(bias_duration=2.0)
    rates = 1e-3 * np.random.default_rng(3).standard_normal(300)
    rates[100:150] += 0.1
    result = calibrate(gyro, rates, 'calibrate_bias')
    assert not result.success and 'was moved' in result.message


@pytest.mark.parametrize('end', ['cancel', 'signal', 'silence'])
def test_the_robot_is_stopped_on_cancel_signal_and_silence(start, end):
    node, gyro = start(drive_profile=True)
    commands = gyro.ros.collect(Twist, 'cmd_vel', 10)
    gyro.call_later('calibrate')
    gyro.wait_until(gyro.calibrating)
    gyro.play(profile_rates()[:250], until=lambda: commands and commands[-1].angular.z > 0.5)
    if end == 'cancel':
        gyro.call_later('cancel_calibration')
    elif end == 'signal':
        assert node.stop(signal.SIGTERM) == 0
    gyro.wait_until(lambda: commands and commands[-1].angular.z == 0.0)


def test_a_drive_waits_for_somebody_who_hears_it_and_is_refused_where_nobody_does(start):
    _, gyro = start(drive_profile=True, wheels='cmd_vel')  # the node hears itself, which does not count
    alone = gyro.call_later('calibrate')
    gyro.play(np.zeros(10 ** 5), until=alone.done)
    assert not alone.result().success and 'nobody hears cmd_vel as a Twist' in alone.result().message
    answer = gyro.call_later('calibrate')
    gyro.wait_until(gyro.calibrating)
    gyro.play(np.zeros(100))
    assert gyro.calibrating() and not answer.done()
    commands = gyro.ros.collect(Twist, 'cmd_vel', 10)
    gyro.play(np.zeros(10 ** 5), until=lambda: commands)
    gyro.call_later('cancel_calibration')
    gyro.wait_until(answer.done)
    assert answer.result().message == 'refused: cancelled'


def test_a_robot_is_not_driven_on_when_samples_stop_whatever_the_timeout(start):
    _, gyro = start(drive_profile=True)
    commands = gyro.ros.collect(Twist, 'cmd_vel', 10)
    answer = gyro.call_later('calibrate')
    gyro.wait_until(gyro.calibrating)
    gyro.play(profile_rates()[:250], until=lambda: commands and commands[-1].angular.z > 0.5)
    before = len(commands)
    gyro.wait_until(answer.done, what='the end of the run')
    assert 'while the robot was driven' in answer.result().message, answer.result().message
    gyro.wait_until(lambda: commands and commands[-1].angular.z == 0.0)
    assert sum(command.angular.z != 0.0 for command in commands[before:]) < 25, 'half a second at 50 Hz'


def test_reset_heading_makes_the_heading_zero(start):
    _, gyro = start()
    gyro.play(np.full(100, 0.5))
    assert gyro.ros.call(Trigger, 'reset_heading').success
    gyro.play([0.5])
    assert gyro.heading[-1].data == pytest.approx(0.5 * INTERVAL, abs=1e-7)


def test_a_stamp_that_stands_still_is_not_integrated_and_is_said(start):
    _, gyro = start()
    gyro.play(np.full(10, 0.5))
    heading = gyro.heading[-1].data
    gyro.wait(-INTERVAL)
    gyro.send(0.5)
    gyro.wait_until(lambda: gyro.says('stands still'))
    gyro.play([0.5])
    assert gyro.heading[-1].data == pytest.approx(heading + 0.5 * INTERVAL, abs=1e-6)


@pytest.mark.parametrize('jump, words', [(-5.0, 'jumps back by 4.990'), (3.0, 'no samples for 3.010')])
def test_after_a_jump_of_the_stamps_integration_begins_anew_and_this_is_said(start, jump, words):
    _, gyro = start()
    gyro.play(np.full(50, 0.5))
    heading = gyro.heading[-1].data
    gyro.wait(jump)
    gyro.play([0.5])
    assert gyro.heading[-1].data == heading
    gyro.wait_until(lambda: gyro.says(words))
    gyro.play([0.5])
    assert gyro.heading[-1].data == pytest.approx(heading + 0.5 * INTERVAL, abs=1e-6)


def test_a_short_gap_is_bridged_by_the_trapezoid(start):
    _, gyro = start()
    gyro.play(np.full(10, 0.5))
    heading = gyro.heading[-1].data
    gyro.wait(0.5 - INTERVAL)
    gyro.play([0.5])
    assert gyro.heading[-1].data == pytest.approx(heading + 0.25, abs=1e-6)


def test_a_rate_that_is_not_finite_is_not_used(start):
    _, gyro = start()
    gyro.play(np.full(10, 0.5))
    gyro.send(math.nan)
    gyro.send(math.inf)
    gyro.wait_until(lambda: gyro.says('not finite'))
    gyro.play([0.5])
    assert math.isfinite(gyro.heading[-1].data)


TEMPERATURE_MODEL = {
    'effects': {'rate_temperature_polynomial': {'orders': [0, 1], 't0w0': 0.0, 't1w0': 0.001}},
    'valid': {'temperature': [20.0, 40.0], 'rate': [-1.0, 1.0]}}


@pytest.mark.parametrize('temperature, used, words', [
    (25.0, 25.0, None), (60.0, 40.0, 'outside the calibrated 20 to 40 degC'), (None, 30.0, 'reference temperature of 30')])
def test_temperature_is_used_clipped_or_replaced_and_this_is_said(start, tmp_path, temperature, used, words):
    model = tmp_path / 'model.yaml'
    model.write_text(yaml.safe_dump(TEMPERATURE_MODEL))
    _, gyro = start(model_file=model, threshold=0.0)
    gyro.play(np.full(200, 0.5), temperature)
    assert gyro.rate[-1].data == pytest.approx(0.5 - 0.001 * used, abs=1e-12)
    if words:
        gyro.wait_until(lambda: any(words in status.message for array in gyro.diagnostics for status in array.status), what=words)


def test_a_rate_beyond_the_calibrated_range_is_said(start, tmp_path):
    model = tmp_path / 'model.yaml'
    model.write_text(yaml.safe_dump(TEMPERATURE_MODEL))
    _, gyro = start(model_file=model)
    gyro.play(np.full(10, 1.5), 30.0)
    gyro.wait_until(lambda: gyro.says('beyond the calibrated range'))


@pytest.mark.parametrize('text, words', [
    (None, 'no such file'), ('', 'wanted names with values'), ('effects: {bias: {bias:', 'cannot be read as YAML'),
    ('version: 99\neffects: {}', 'install a newer'), ('effects: {bias: {bias: .nan}}', 'effects.bias.bias is nan'),
    ('[1, 2]', 'the file is')])
def test_with_a_bad_model_it_goes_on_with_raw_rates_marked_uncalibrated(start, tmp_path, text, words):
    model = tmp_path / 'model.yaml'
    if text is not None:
        model.write_text(text)
    _, gyro = start(model_file=model, threshold=0.0)
    gyro.play(np.full(10, 0.5))
    assert gyro.rate[-1].data == 0.5
    gyro.wait_until(lambda: gyro.says('uncalibrated: ') and gyro.says(str(model)) and gyro.says(words), what=words)
    assert gyro.status[-1].level == DiagnosticStatus.ERROR
    refused = gyro.ros.call(Trigger, 'calibrate')
    assert not refused.success and words in refused.message


def test_a_profile_with_wrong_columns_is_refused_in_one_sentence(start, tmp_path):
    profile = tmp_path / 'profile.csv'
    profile.write_text('time_s,speed\n0,1\n1,2\n')
    _, gyro = start(profile_file=profile)
    refused = gyro.ros.call(Trigger, 'calibrate')
    assert not refused.success and 'time_s and one of heading_deg' in refused.message and str(profile) in refused.message


def test_a_calibration_that_cannot_be_stored_is_used_and_this_is_said(start, tmp_path):
    (tmp_path / 'file').write_text('')
    _, gyro = start(calibration_file=tmp_path / 'file' / 'calibration.yaml')
    result = calibrate(gyro)
    assert result.success and 'NOT STORED' in result.message


def test_the_threshold_filter_deletes_rates_at_rest_and_can_be_switched_off_while_it_runs(start):
    _, gyro = start()
    gyro.play(np.full(50, 0.1 * DEGREE))
    assert gyro.heading[-1].data == 0.0
    gyro.wait_until(lambda: gyro.diagnostics and any(value.key == 'deleted_heading_deg' and float(value.value) > 0.03
                    for value in gyro.diagnostics[-1].status[0].values), what='the deleted heading')
    _set_parameter(gyro.ros, 'threshold', 0.0)
    gyro.wait_until(lambda: gyro.play([0.1 * DEGREE] * 2) or gyro.rate[-1].data > 0.0)


def _set_parameter(ros, name, value):
    from rcl_interfaces.srv import SetParameters
    from rclpy.parameter import Parameter
    request = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
    assert ros.call(SetParameters, '/compensation_node/set_parameters', request).results[0].successful


def test_a_profile_of_measured_headings_serves_as_well(start, tmp_path):
    motion = from_rates(np.array([0.0, 1.0, 1.5, 4.0, 4.5, 5.5, 6.0, 9.0, 9.5, 10.0]), np.array([0, 0, 0.6, 0.6, 0, 0, -0.7, -0.7, 0, 0]))
    times = np.arange(0.0, 10.001, 0.05)
    profile = tmp_path / 'profile.csv'
    profile.write_text('time_s,heading_deg\n' + ''.join(f'{t},{h / DEGREE}\n' for t, h in zip(times, motion.heading_at(times))))
    _, gyro = start(profile_file=profile)
    result = calibrate(gyro, profile_rates(motion))
    assert result.success, result.message
    stored = read_model(tmp_path / 'calibration.yaml').self_calibration
    assert stored.scale_factor_error == pytest.approx(SCALE_FACTOR_ERROR, abs=1e-5)


def test_the_run_of_these_tests_is_itself_calibratable():
    """Whatever fails above, the fake run is not to blame."""
    rates = profile_rates()
    fit = fit_likelihood(np.arange(len(rates)) * INTERVAL, rates, CALIBRATION)
    assert fit.scale_factor_error == pytest.approx(SCALE_FACTOR_ERROR, abs=1e-9)
