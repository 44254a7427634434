# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Calibrations on a robot that obeys late: what they find, what ends them, and who is obeyed."""

import math
import re

from gyro_calibration.logs.log import DataRefused, DEGREE
from gyro_calibration.model.model_file import read_model
from gyro_calibration.model.motion import CALIBRATION_MOTION
from gyro_calibration.model.noise import Noise
from gyro_calibration.ros.calibration_session import (
    CalibrationRun, Drive, FINISH_TIMEOUT, fit_run, ODOMETRY, REST, SAMPLE_TIMEOUT, TURNS)
from gyro_calibration.ros.inputs import Velocity
import numpy as np
import pytest
from rig import driven, INTERVAL, MODEL, PROFILE, rested, Rig, Robot

SCALE, BIAS = 0.0373, 0.01  # of the robot's gyro
FULL = 45.0 * DEGREE
#: A command that the base has reached it follows for 0.15 s more, then it slows with 0.2 s.
STOPPING = FULL * (0.15 + 0.2)


def stored(rig):
    return read_model(rig.calibration_file).self_calibration


def test_a_run_drives_the_profile_and_finds_stores_and_uses_scale_and_bias(tmp_path):
    rig = rested(tmp_path, calibration_drive=True)
    begin, first = rig.clock.now, len(rig.outputs)
    success, message = rig.calibrate()
    assert success, message
    assert 'delay of the gyro 0.3' in message and 'at rest after it' in message
    kept = stored(rig)
    assert kept.scale_factor_error == pytest.approx(SCALE, abs=5e-4)
    assert kept.bias == pytest.approx(BIAS, abs=2e-4)
    assert rig.pipeline.estimator.model.self_calibration == kept
    # the commands
    times, rates = np.array(rig.commands).T
    assert (rates.max(), rates.min()) == pytest.approx((FULL, -FULL), abs=1e-6)
    np.testing.assert_allclose(
        rates[:-1], CALIBRATION_MOTION.rate_at(times[:-1] - begin - 0.01), atol=0.06)
    assert np.diff(times).max() < 1.5 * Drive.INTERVAL and rates[-1] == 0.0
    # the heading goes on with the old calibration, and does not jump to the new one
    rig.go(1.0)
    headings = np.array([each.heading for each in rig.outputs[first:]])
    assert np.abs(np.diff(headings)).max() < 1.1 * (1 + SCALE) * FULL * 0.01
    assert max(each.rate for each in rig.outputs[first:]) == pytest.approx(
        (1 + SCALE) * FULL, abs=0.01), 'not yet the new scale'


def faults():
    """Return, by name, what happens to a rig in mid-run, and words of the reason."""
    return {
        'unplugged': (lambda rig: setattr(rig.robot, 'unplugged', True), 'no sample came for'),
        'stamps stand': (lambda rig: setattr(rig.robot, 'stamps_stand', True), 'no sample came'),
        'soft stop': (lambda rig: setattr(rig, 'other', 0.0), 'another node sent a command'),
        'teleop': (lambda rig: setattr(rig, 'other', 0.3), 'another node sent a command'),
        'one command to drive ahead': (
            lambda rig: rig.pipeline.add_command(
                Velocity((0.2, 0.0, 0.0), (0.0, 0.0, rig.commands[-1][1]))),
            'another node sent a command'),
        'no receiver': (lambda rig: setattr(rig, 'receivers', 0), 'no other node receives'),
        'two publishers': (lambda rig: rig.publishers.append('/other'), '2 publishers send'),
        'forbidden': (lambda rig: rig.set(calibration_drive=False), 'calibration.drive was set'),
        'no caller': (lambda rig: setattr(rig, 'callers', 0), 'that called calibrate has ended'),
        'cancelled': (lambda rig: rig.session.cancel(), 'cancelled'),
        'ROS time stands': (lambda rig: setattr(rig, 'ros_speed', 0.0), 'ROS time stands still'),
        'ROS time stands, unplugged': (
            lambda rig: setattr(rig, 'ros_speed', 0.0) or setattr(rig.robot, 'unplugged', True),
            'ROS time stands still'),
    }


@pytest.mark.parametrize('fault, ros',
                         [(fault, ros) for fault in faults()
                          for ros in (None, 1000.0) if ros or 'ROS time' not in fault])
def test_a_fault_in_mid_run_stops_the_robot_within_half_a_second(tmp_path, fault, ros):
    rig = driven(tmp_path, ros=ros)
    act, reason = faults()[fault]
    begin, heading = rig.clock.now, rig.robot.heading
    act(rig)
    success, message = rig.end(2.0)
    assert not success and reason in message, message
    assert rig.stopped_after(begin) < 0.5
    rig.go(2.0)
    assert rig.commands[-1][1] == 0.0 and not rig.session.is_driving
    if fault not in ('teleop', 'no receiver'):
        assert rig.robot.rate == pytest.approx(0.0, abs=1e-4)
        assert abs(rig.robot.heading - heading) < FULL * 0.5 + STOPPING
    assert not rig.calibration_file.exists()


@pytest.mark.parametrize('back', [0.03, 0.5, 10.0])
def test_commands_go_on_where_ros_time_jumps_back_and_the_stamps_do_not(tmp_path, back):
    rig = driven(tmp_path, ros=1000.0)
    stamp, begin = rig.stamp, rig.clock.now
    rig.clock.ros -= back
    rig.stamp = lambda reading: stamp(reading) + round(1e9 * back)
    rig.go(60.0, lambda: rig.ended)
    sent = [begin, *(when for when, _ in rig.commands if when > begin)]
    assert np.diff(sent).max() < 2.5 * Drive.INTERVAL


def late_commands(rig):
    """Let own commands come back as over best effort: some never, the others 0.4 s later."""
    late, taken, generator = [], rig.pipeline.add_command, np.random.default_rng(1)

    def delayed(velocity):
        if generator.random() > 0.3:
            late.append((rig.clock.now + 0.4, velocity))
        while late and late[0][0] <= rig.clock.now:
            taken(late.pop(0)[1])
    rig.pipeline.add_command = delayed


HARMLESS = {
    'a simulation at a quarter of the speed': (
        {'ros': 1000.0}, lambda rig: setattr(rig, 'speed', 0.25)),
    'a simulation at four times the speed': (
        {'ros': 1000.0}, lambda rig: setattr(rig, 'speed', 4.0)),
    'own commands that come back late': ({'wheels': 'both'}, late_commands),
    'a gyro whose clock is 3 % off': ({}, lambda rig: rig.pace_stamps(1.03)),
    'callers that are never seen': ({}, lambda rig: setattr(rig, 'callers', 0)),
}


@pytest.mark.parametrize('given, act', HARMLESS.values(), ids=HARMLESS)
def test_what_is_no_fault_does_not_keep_a_drive_from_its_calibration(tmp_path, given, act):
    rig = rested(tmp_path, robot=Robot(noise=5e-3), calibration_drive=True, **given)
    act(rig)
    success, message = rig.calibrate()
    assert success, message
    assert stored(rig).scale_factor_error == pytest.approx(SCALE, abs=5e-3)


@pytest.mark.parametrize('interval, burst', [(0.01, 2), (0.1, 1), (0.01, 20), (0.2, 1)],
                         ids=['100 Hz', '10 Hz', 'bursts', '5 Hz'])
def test_a_drive_goes_on_between_samples_that_are_rare_or_come_in_bursts(
        tmp_path, interval, burst):
    rig = Rig(tmp_path, model='', calibration_drive=True)
    rig.feed(np.zeros(round(2.0 / interval)), interval)
    assert not rig.begin()

    def wait(seconds):
        for _ in range(round(seconds / Drive.INTERVAL)):
            rig.clock.now += Drive.INTERVAL
            rig.pipeline.poll(1)

    for _ in range(round(3.0 / interval / burst)):
        wait(interval * burst)
        for _ in range(burst):
            rig.fed += round(1e9 * interval)
            rig.sample(rig.fed, 0.0)
    assert min(rate for _, rate in rig.commands[-20:]) > 0.5
    begin = rig.clock.now
    wait(1.5)
    assert rig.ended and 'while the robot was driven' in rig.session.run.end_reason
    assert rig.stopped_after(begin) <= max(0.25, 4.0 * interval) + 2.1 * Drive.INTERVAL


@pytest.mark.parametrize('ros, within', [(None, 1.0), (1000.0, 2.2)], ids=['host', 'simulated'])
@pytest.mark.parametrize('pace', [1e-6, 0.3, 3.0])
def test_stamps_that_leave_the_clock_end_a_drive(tmp_path, pace, ros, within):
    """The motion goes on by them: where they all but stand, it would never end."""
    rig = driven(tmp_path, ros=ros)
    begin = rig.clock.now
    rig.pace_stamps(pace)
    assert rig.go(5.0, lambda: rig.ended)
    assert rig.stopped_after(begin) < within
    assert 'the stamps on imu/data_raw advanced by' in rig.session.conclude()[1]


def test_stamps_that_all_but_stand_end_a_run_that_does_not_drive(tmp_path):
    rig = rested(tmp_path)
    rig.pace_stamps(1e-6)
    success, message = rig.calibrate(REST)
    assert not success and 'advance too slowly' in message


@pytest.mark.parametrize('timer_first', [True, False])
def test_a_node_that_was_stopped_in_a_drive_does_not_go_on_with_it(tmp_path, timer_first):
    """As by SIGSTOP: what came meanwhile waits, and the robot followed the last command."""
    rig, waiting = rested(tmp_path, calibration_drive=True), []
    rig.drive_to()
    for _ in range(200):
        rig.clock.now += INTERVAL
        reading = rig.robot.step()
        waiting.append((rig.stamp(reading), reading.output, reading.heading))
    sent = len(rig.commands)
    if timer_first:
        rig.pipeline.poll(1)
    for each in waiting:
        rig.sample(*each)
    rig.go(2 * Drive.INTERVAL)
    assert rig.ended and {rate for _, rate in rig.commands[sent:]} == {0.0}
    assert 'the node was held up for 2.0 s' in rig.session.conclude()[1]


def test_a_stop_that_is_lost_on_the_way_is_repeated(tmp_path):
    rig = driven(tmp_path)
    command, rig.robot.command = rig.robot.command, lambda rate: None
    assert rig.session.cancel()[0] and not rig.session.conclude()[0]
    rig.robot.command = command
    rig.go(3.0)
    assert rig.robot.rate == pytest.approx(0.0, abs=1e-3)
    assert rig.commands[-1][0] < rig.clock.now - 1.9, 'only for a second'


@pytest.mark.parametrize('cancelled', [True, False])
def test_a_stop_is_not_repeated_once_another_node_commands(tmp_path, cancelled):
    rig = driven(tmp_path)
    if cancelled:
        rig.stop()
    sent, rig.other = len(rig.commands), 0.3
    rig.go(1.0)
    last = len(rig.commands)
    if not cancelled:
        rig.session.conclude()
    rig.go(2.0)
    assert len(rig.commands) == last and rig.robot.rate == pytest.approx(0.3, abs=1e-3)
    assert not cancelled or last <= sent + 1


OBSTACLES = {
    'teleop': ({}, lambda rig: setattr(rig, 'other', 0.3),
               'odom or cmd_vel shows that the robot moves'),
    'a soft stop': ({}, lambda rig: setattr(rig, 'other', 0.0),
                    'another node sends commands on cmd_vel'),
    'unplugged': ({}, lambda rig: setattr(rig.robot, 'unplugged', True), 'no sample comes'),
    'two publishers': ({}, lambda rig: rig.publishers.append('/b'), '2 publishers'),
    'no /clock': ({'ros': 0.0}, lambda rig: None, 'ROS time stands still'),
    '/clock stands': ({'ros': 1000.0}, lambda rig: setattr(rig, 'ros_speed', 0.0),
                      'ROS time stands still'),
    'a turn that only the gyro shows': (
        {}, lambda rig: setattr(rig.robot, 'distort', lambda output: output + 0.3),
        'the gyro shows a turn at 1'),
    'a reference that is not driven': (
        {'calibration_reference': ODOMETRY}, lambda rig: None, 'calibration.drive drives the'),
    'another one': ({'calibration_reference': TURNS}, lambda rig: None,
                    'calibration.drive drives the profile'),
}


@pytest.mark.parametrize('given, prepare, reason', OBSTACLES.values(), ids=OBSTACLES)
def test_a_drive_begins_only_when_the_robot_rests_and_is_free(tmp_path, given, prepare, reason):
    rig = rested(tmp_path, calibration_drive=True, **given)
    prepare(rig)
    rig.go(2.0)
    assert reason in rig.begin(given.get('calibration_reference', PROFILE))
    assert not rig.session.run
    rig.go(1.0)
    assert not rig.commands


def test_a_large_bias_keeps_a_drive_from_beginning_until_it_is_calibrated(tmp_path):
    rig = rested(tmp_path, robot=Robot(bias=3.0 * DEGREE), calibration_drive=True)
    assert 'call calibrate_bias first' in rig.begin()
    assert rig.calibrate(REST)[0]
    rig.go(1.0)
    success, message = rig.calibrate()
    assert success, message


@pytest.mark.parametrize('comes', [True, False])
def test_a_drive_waits_for_a_receiver_of_its_commands_for_5_s(tmp_path, comes):
    rig = rested(tmp_path, calibration_drive=True)
    rig.receivers, begin = 0, rig.clock.now
    assert not rig.begin()
    rig.go(0.5 * SAMPLE_TIMEOUT)
    assert rig.session.run.elapsed == 0.0 and not rig.ended
    rig.receivers = int(comes)
    success, message = rig.end(40.0)
    assert success == comes
    if not comes:
        assert 'no other node receives cmd_vel' in message
        assert rig.clock.now - begin == pytest.approx(SAMPLE_TIMEOUT, abs=0.1)


def test_a_robot_that_turns_on_after_the_stop_is_reported_and_one_that_stops_late_is_not(tmp_path):
    rig = driven(tmp_path)
    rig.robot.deaf = True
    rig.stop()
    rig.go(1.4)
    assert not rig.session.warning, 'it may still be slowing down'
    rig.go(1.0)
    assert 'command time-out of the base' in rig.session.warning
    rig.robot.deaf = False
    rig.turn(0.0, 5.0)
    assert not rig.begin() and not rig.session.warning, 'a new run has a new chance'
    late = driven(tmp_path, robot=Robot(lag=0.3))
    late.stop()
    late.go(5.0)
    assert not late.session.warning
    assert not late.begin()
    late.stop()
    late.drive_to()
    late.go(1.0)
    assert not late.session.warning, 'the next drive turns it'


def test_a_run_that_commands_late_is_refused_by_naming_the_load(tmp_path):
    """This computer is busy for 0.3 s of each 0.8 s; what came meanwhile comes then."""
    rig = rested(tmp_path, calibration_drive=True)
    poll = rig.pipeline.poll
    rig.hold_up_samples(lambda: rig.clock.now % 0.8 < 0.3)
    rig.pipeline.poll = lambda count: rig.clock.now % 0.8 < 0.3 or poll(count)
    success, message = rig.calibrate()
    assert not success and '; besides, this computer was busy: commands were up to 0.' in message
    commands, samples = rig.session.max_lateness
    assert 0.1 < commands < 0.7 and 0.1 < samples < 0.7


def test_a_refusal_names_first_what_no_load_explains(tmp_path):
    """Samples that are 30 ms late are usual, and turn no gyro the other way."""
    rig = rested(tmp_path, calibration_drive=True)
    rig.robot.distort = lambda output: -output
    rig.hold_up_samples(lambda: rig.clock.now % 0.8 < 0.04)
    success, message = rig.calibrate()
    assert not success and message.startswith('the gyro turns the other way'), message
    assert 'this computer was busy' in message


def test_samples_that_are_held_up_do_not_hold_up_the_motion(tmp_path):
    """By up to 0.2 s, in 0.2 s of each 0.8 s; by the last sample it would fall back."""
    rig = rested(tmp_path, calibration_drive=True)
    while not 0.2 < rig.clock.now % 0.8 < 0.3:
        rig.step()
    rig.hold_up_samples(lambda: rig.clock.now % 0.8 < 0.2)
    begin = rig.clock.now
    success, message = rig.calibrate()
    assert success, message
    times, rates = np.array(rig.commands[:-1]).T
    np.testing.assert_allclose(rates, CALIBRATION_MOTION.rate_at(times - begin - 0.01), atol=0.06)
    assert rig.session.max_lateness[1] == pytest.approx(0.2, abs=0.02)


def test_a_second_calibration_is_refused_and_leaves_the_first_alone(tmp_path):
    rig = rested(tmp_path, calibration_drive=True)
    rig.begin()
    rig.go(3.0)
    assert 'is in progress' in rig.begin(REST) and 'is in progress' in rig.begin()
    assert rig.end(40.0)[0]


def test_cancel_keeps_the_calibration_in_use_and_there_is_nothing_left_to_cancel(tmp_path):
    rig = rested(tmp_path)
    rig.begin()
    rig.go(5.0)
    assert rig.session.cancel() == (True, 'cancelled; the previous calibration is in use')
    assert rig.session.conclude() == (False, 'cancelled')
    assert rig.session.cancel() == (False, 'no calibration is in progress')
    assert not rig.calibration_file.exists()


def test_a_cancel_that_comes_with_the_last_sample_does_not_promise_the_old_calibration(tmp_path):
    rig = rested(tmp_path)
    rig.begin(REST)
    assert rig.go(20.0, lambda: rig.ended)
    success, message = rig.session.cancel()
    assert not success and 'has just ended' in message
    assert rig.session.conclude()[0]


@pytest.mark.parametrize('kind', [PROFILE, REST, ODOMETRY, TURNS])
def test_a_run_without_samples_ends_after_5_s(tmp_path, kind):
    rig = rested(tmp_path, calibration_reference=kind if kind != REST else 'profile')
    rig.robot.unplugged = True
    begin = rig.clock.now
    success, message = rig.calibrate(kind)
    assert not success and 'no sample came for 5 s' in message
    assert rig.clock.now - begin == pytest.approx(SAMPLE_TIMEOUT, abs=0.6)


def test_a_jump_of_the_stamps_ends_a_run_and_the_reason_names_it(tmp_path):
    rig = Rig(tmp_path)
    rig.feed(np.zeros(300))
    rig.begin(REST)
    rig.feed(np.zeros(300))
    rig.skip(3.0)
    rig.feed([0.0])
    success, message = rig.session.conclude()
    assert not success and 'no samples for 3.0' in message and 'run again' in message


def test_an_error_in_the_fit_changes_nothing_and_the_next_run_works(tmp_path, monkeypatch):
    rig = rested(tmp_path, calibration_drive=True)
    with monkeypatch.context() as patched:
        patched.setattr('gyro_calibration.ros.calibration_session.fit_run', lambda *_: 1 / 0)
        success, message = rig.calibrate()
    assert not success and 'nothing was changed' in message and 'ZeroDivisionError' in message
    assert rig.calibrate()[0]


@pytest.mark.parametrize('kind, model, profile, words', [
    (PROFILE, MODEL, 'time_s,speed\n0,1\n1,2\n', 'profile.csv: .*time_s and one of heading_deg'),
    (PROFILE, MODEL, 'time_s,rate_rad_s\n0,0\n1,0\n2,45\n3,0\n20,0\n',
     'the profile turns at 2578 deg/s, faster than 275 deg/s'),
    (REST, 'effects: {bias: {bias: .nan}}', '', 'effects.bias.bias is nan')],
    ids=['no profile', 'too fast for a robot', 'no model'])
def test_what_cannot_be_calibrated_by_is_refused_in_one_sentence(
        tmp_path, kind, model, profile, words):
    (tmp_path / 'profile.csv').write_text(profile)
    rig = rested(tmp_path, model=model, calibration_drive=True,
                 calibration_profile_file=str(tmp_path / 'profile.csv'))
    assert re.search(words, rig.begin(kind)) and not rig.session.run


def turn_to_and_fro(rig, rest):
    """Begin a run by odometry, turn each way by somebody's commands, and rest for so many s."""
    rig.begin(ODOMETRY)
    for rate, seconds in ((0.6, 4.0), (0.0, 3.0), (-0.6, 4.0), (0.0, rest)):
        rig.turn(rate, seconds)


@pytest.mark.parametrize('has_yaw', [True, False], ids=['headings', 'rates alone'])
def test_odometry_is_a_reference(tmp_path, has_yaw):
    rig = rested(tmp_path, calibration_reference=ODOMETRY)
    rig.odometry = lambda stamp, reading: rig.pipeline.add_odometry(
        stamp, math.remainder(reading.heading, math.tau) * has_yaw,
        Velocity(angular=(0.0, 0.0, reading.rate)))
    turn_to_and_fro(rig, 13.5)
    assert rig.ended
    success, message = rig.session.conclude()
    assert success and 'at rest after it' in message, message
    kept = stored(rig)
    assert kept.method == 'odometry' and kept.scale_factor_error == pytest.approx(SCALE, abs=2e-3)
    assert kept.standard_deviations[0] > 0.0099 * (1 + SCALE), 'no run is better than its odometry'


@pytest.mark.parametrize('spoil, reason', [(lambda given: [], '0 messages with an orientation'),
                                           (lambda given: given[:20],
                                            '20 messages came on odom, but in 0 s of 20 s only'),
                                           (lambda given: given[::-1], 'stamps on odom')],
                         ids=['none', 'too few', 'out of order'])
def test_odometry_that_cannot_be_used_is_refused(tmp_path, spoil, reason):
    rig = rested(tmp_path, calibration_reference=ODOMETRY)
    turn_to_and_fro(rig, 13.5)
    rig.session.run.odometry = spoil(rig.session.run.odometry)
    success, message = rig.session.conclude()
    assert not success and reason in message, message


@pytest.mark.parametrize('spoil, reason', [
    (lambda time, heading: heading + 0.15 * (time > 6.0), 'differs by .* deg from the odometry'),
    (lambda time, heading: heading - 2.0 * (time > 6.0), 'does not follow the odometry'),
    (lambda time, heading: heading * (time < 6.0), 'of the odometry|the gyro .* the odometry'),
    (lambda time, heading: heading / DEGREE, 'the odometry in deg/s and read as rad/s'),
    (lambda time, heading: -heading, 'the other way than the odometry'),
    (lambda time, heading: 0.0, 'the odometry does not turn')],
    ids=['a slip', 'a jump', 'a reset', 'deg', 'sense', 'no turn'])
def test_what_is_wrong_with_odometry_is_not_said_of_a_profile(tmp_path, spoil, reason):
    rig = rested(tmp_path, calibration_reference=ODOMETRY)
    begin = rig.clock.now
    rig.odometry = lambda stamp, reading: rig.pipeline.add_odometry(
        stamp, math.remainder(spoil(rig.clock.now - begin, reading.heading), math.tau),
        Velocity())
    turn_to_and_fro(rig, 13.5)
    success, message = rig.session.conclude()
    assert not success and re.search(reason, message) and 'profile' not in message, message


@pytest.mark.parametrize('late, is_missing, succeeds', [
    (-5.0, lambda time: False, False), (3600.0, lambda time: False, False),
    (0.0, lambda time: 2.0 < time < 9.0, False), (0.0, lambda time: 4.5 < time < 6.5, True)],
    ids=['ahead', 'behind', 'a gap with two turns', 'a gap at rest'])
def test_odometry_of_another_clock_or_without_the_turns_is_refused(
        tmp_path, late, is_missing, succeeds):
    rig = rested(tmp_path, calibration_reference=ODOMETRY)
    begin, odometry = rig.clock.now, rig.odometry
    rig.odometry = lambda stamp, reading: is_missing(rig.clock.now - begin) or odometry(
        stamp - round(1e9 * late), reading)
    turn_to_and_fro(rig, 13.5)
    assert ('odom is stamped' in rig.pipeline.faults['odometry_clock']) == bool(late)
    success, message = rig.session.conclude()
    assert success == succeeds, message


@pytest.mark.parametrize('turns', [
    ((0.0, 16.0), (0.6, 6.0), (-0.6, 5.0)), ((0.7, 3.0), (0.0, 15.0), (-0.7, 9.0))],
    ids=['a turn at the end', 'turns at both ends'])
def test_odometry_may_begin_and_end_in_a_turn(tmp_path, turns):
    rig = rested(tmp_path, calibration_reference=ODOMETRY)
    if turns[0][0]:
        rig.turn(turns[0][0], 2.0)
    rig.begin(ODOMETRY)
    for each in turns:
        rig.turn(*each)
    success, message = rig.session.conclude()
    assert success and stored(rig).scale_factor_error == pytest.approx(SCALE, abs=5e-3), message


def test_a_gyro_beyond_its_range_during_a_calibration_is_named_by_its_rate(tmp_path):
    rig = rested(tmp_path, calibration_reference=ODOMETRY)
    rig.robot.distort = lambda output: output * 57.3 * 3.0
    turn_to_and_fro(rig, 13.5)
    success, message = rig.session.conclude()
    assert not success and 'beyond the range of this gyro, and not used' in message


def test_odometry_that_is_computed_from_the_gyro_is_no_reference(tmp_path):
    rig = rested(tmp_path, robot=Robot(bias=0.0), calibration_reference=ODOMETRY)
    estimator, turned = rig.pipeline.estimator, 0.0

    def fused(stamp, reading):
        nonlocal turned
        turned += estimator.corrected_rate * INTERVAL
        rig.pipeline.add_odometry(stamp, math.remainder(turned, math.tau),
                                  Velocity(angular=(0.0, 0.0, estimator.corrected_rate)))

    rig.odometry = fused
    turn_to_and_fro(rig, 13.5)
    success, message = rig.session.conclude()
    assert not success and 'the reference is computed from this gyro' in message, message


def test_odometry_may_be_finished_early(tmp_path):
    rig = rested(tmp_path, calibration_reference=ODOMETRY, calibration_duration=600.0)
    rig.begin(ODOMETRY)
    rig.turn(0.6, 2.0)
    success, message = rig.session.finish()
    assert not success and 'and one by odometry 5 s at least' in message and not rig.ended
    for rate, seconds in ((0.0, 3.0), (-0.6, 4.0), (0.0, 3.0)):
        rig.turn(rate, seconds)
    assert rig.session.finish() == (True, 'leave the robot at rest for 4.0 s more')
    rig.go(1.0)
    assert rig.session.finish() == (True, 'leave the robot at rest for 3.0 s more')
    assert rig.end(5.0)[0]


def test_whole_turns_on_a_mark_are_a_reference(tmp_path):
    rig = rested(tmp_path, calibration_reference=TURNS, calibration_turns=2)
    assert rig.session.finish() == (False, 'no calibration by turns or by odometry is in progress')
    rig.begin(TURNS)
    assert 'no sample has come so far' in rig.session.finish()[1]
    rig.go(3.0)
    rig.turn(0.6, 2.0 * math.tau / 0.6)
    rig.turn(0.0, 4.0)
    assert rig.robot.heading == pytest.approx(2.0 * math.tau, abs=0.02), 'two turns'
    assert rig.session.finish()[0]
    success, message = rig.end(5.0)
    assert success and '2 whole turns' in message, message
    kept = stored(rig)
    assert kept.method == 'turns' and kept.scale_factor_error == pytest.approx(SCALE, abs=2e-3)


def test_calibrate_bias_keeps_the_scale_factor_error(tmp_path):
    rig = rested(tmp_path, calibration_drive=True)
    assert rig.calibrate()[0]
    before = stored(rig)
    rig.robot.bias = 0.02
    assert rig.calibrate(REST)[0]
    assert stored(rig).bias == pytest.approx(0.02, abs=4e-4)
    assert stored(rig).scale_factor_error == before.scale_factor_error
    assert stored(rig).standard_deviations[0] == pytest.approx(before.standard_deviations[0])


@pytest.mark.parametrize('shown, words', [
    ('rate', 'odom shows a turn by 43.0'),
    ('heading', 'odom shows a turn by 43.0'),
    ('command', 'another node sent a command on cmd_vel')])
def test_calibrate_bias_takes_no_even_turn_for_a_bias(tmp_path, shown, words):
    rig = rested(tmp_path)
    rig.other = 0.05 if shown == 'command' else None
    rig.robot.command(0.05)
    rig.odometry = lambda stamp, reading: rig.pipeline.add_odometry(
        stamp, reading.heading * (shown == 'heading'),
        Velocity(angular=(0.0, 0.0, reading.rate * (shown == 'rate'))))
    rig.go(3.0)
    success, message = rig.calibrate(REST)
    assert not success and words in message, message


@pytest.mark.parametrize('turn, words', [(0.03, 'the rate was 1.78 deg/s'), (0.0, '')])
def test_calibrate_bias_says_by_how_much_the_bias_has_changed(tmp_path, turn, words):
    """Only the robot's owner knows whether it has turned evenly, without odom."""
    rig = Rig(tmp_path, robot=Robot(bias=0.01))
    rig.odometry = lambda stamp, reading: None
    assert rig.calibrate(REST)[0]
    rig.turn(turn, 3.0)
    success, message = rig.calibrate(REST)
    assert success and ('if the robot turned evenly' in message) == bool(words)
    assert words in message, message


@pytest.mark.parametrize('kind, drives', [(PROFILE, True), (PROFILE, False), (REST, True)])
def test_samples_of_another_frame_end_a_calibration_and_none_begins_with_them(
        tmp_path, kind, drives):
    """What they show would be stored as the calibration of the first gyro."""
    rig = rested(tmp_path, calibration_drive=drives)
    assert not rig.begin(kind)
    rig.go(3.0)
    rig.sample = lambda stamp, output, heading: rig.pipeline.add_sample(
        stamp, output, receivers=1, frame='other')
    success, message = rig.end(1.0)
    assert not success and "have the frame 'other'" in message, message
    assert "have the frame 'other'" in rig.begin(kind)
    assert not rig.calibration_file.exists()


def test_turns_that_are_not_finished_are_given_up():
    run = CalibrationRun(TURNS, math.inf, 0.0)
    for time in (0.0, FINISH_TIMEOUT, FINISH_TIMEOUT + 1.0):
        run.add(time, 0.0, 0.0, None)
    assert 'finish_calibration' in run.due_end_reason and 'rest on the mark' in run.status


@pytest.mark.parametrize('kind, duration', [(ODOMETRY, 600.0), (PROFILE, 700.0), (TURNS, 599.0)])
def test_a_run_of_known_length_may_be_longer_than_one_that_waits_for_a_call(kind, duration):
    run = CalibrationRun(kind, math.inf if kind == TURNS else duration, 0.0)
    run.add(0.0, 0.0, 0.0, None)
    run.add(duration, 0.0, 0.0, None)
    if kind == TURNS:
        run.duration = run.elapsed
    run.add(duration + 2.0, 0.0, 0.0, None)
    assert run.due_end_reason is None and run.elapsed < run.max_duration
    run.add(duration + 4.0, 0.0, 0.0, None)
    assert run.due_end_reason == ''


def test_a_dead_gyro_at_rest_is_seen_behind_a_model_that_follows_the_temperature():
    run = CalibrationRun(REST, 10.0, 0.0)
    for number, noise in enumerate(1e-5 * np.random.default_rng(1).standard_normal(520)):
        run.add(0.02 * number, BIAS, BIAS + noise, 25.0)
    with pytest.raises(DataRefused, match='the gyro is dead'):
        fit_run(run, Noise(), '')
    run.outputs = [0.0 for _ in run.outputs]
    with pytest.raises(DataRefused, match='sets its output to zero at rest'):
        fit_run(run, Noise(), '')
