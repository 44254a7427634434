# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""What comes of samples, temperatures, wheels and clocks: rates, headings, variances, reports."""

import itertools
import math
from pathlib import Path
import re

from gyro_calibration.logs.cdr import UNMEASURED_VARIANCE
from gyro_calibration.logs.log import DEGREE
from gyro_calibration.model.noise import Noise
from gyro_calibration.ros.calibration_session import REST
from gyro_calibration.ros.inputs import (
    COASTING_DURATION, COMMAND, MAX_VELOCITY_AGE, ODOMETRY, Velocity, Wheels)
from hypothesis import given, HealthCheck, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from rig import INTERVAL, rested, Rig, Robot
import yaml

NOISE, BIAS, SLOW = 5e-4, 0.012, 0.04  # rad/√s, rad/s, s between samples
KNOWN = ('effects: {bias: {bias: 0.01}}\n'
         'noise: {angle_random_walk: 5.0e-4, bias_instability: 1.0e-5}\n')
CERTAIN = KNOWN.replace('0.01}}', '0.01}, scale_factor_error: {scale_factor_error: 0.0}}') + (
    'covariance: [[1.0e-8, 0.0], [0.0, 1.0e-10]]\norigin: {date: "2023-11-14T22:00:00+00:00"}\n')


def noisy(seconds, rate=0.0, bias=BIAS, seed=0):
    """Return what a gyro with the noise of the model reports while it turns at a rate."""
    deviation = math.sqrt(Noise(NOISE).rate_variance(SLOW))
    return rate + bias + deviation * np.random.default_rng(seed).standard_normal(
        round(seconds / SLOW))


def headings(found):
    return np.array([each.heading for each in found])


def test_raw_rates_are_integrated_by_the_trapezoid_rule_without_wrapping_until_a_reset(tmp_path):
    rig = Rig(tmp_path, model='', stationary_threshold=0.0)
    rates = 3.0 + 0.5 * np.sin(np.arange(300) * 0.02)
    found = rig.feed(rates)
    expected = np.concatenate([[0], np.cumsum((rates[1:] + rates[:-1]) * INTERVAL / 2)])
    np.testing.assert_allclose(headings(found), expected, atol=1e-7)
    np.testing.assert_allclose([each.rate for each in found], rates, atol=1e-12)
    assert expected[-1] > math.tau
    # the noise is not known
    assert all(each.rate_variance >= (0.5 * DEGREE) ** 2 for each in found)
    assert all(each.heading_variance == UNMEASURED_VARIANCE for each in found)
    rig.pipeline.reset_heading()
    assert rig.feed(rates[-1:])[0].heading == pytest.approx(rates[-1] * INTERVAL, abs=1e-7)


@pytest.mark.parametrize('jump, turned, count, words, given', [
    (0.49, 0.25, {'lost_samples': 49, 'restarts': 0}, '', {}),
    (-5.0, 0.0, {'restarts': 1}, 'jumps back by 4.970', {}),
    (3.0, 0.0, {'restarts': 1}, 'no samples for 3.010', {}),
    (3.0, 1.505, {'lost_samples': 300, 'restarts': 0}, '', {'maximum_gap': 20.0})])
def test_a_short_gap_is_bridged_and_after_a_jump_of_the_stamps_integration_begins_anew(
        tmp_path, jump, turned, count, words, given):
    rig = Rig(tmp_path, model='', **given)
    heading = rig.feed(np.full(100, 0.5))[-1].heading + turned
    rig.skip(jump, steady=abs(jump))
    if jump < 0.0:
        assert rig.feed([0.5, 0.5]) == [None, None], 'they may be late'
    assert rig.feed([0.5])[0].heading == pytest.approx(heading, abs=1e-6)
    assert rig.journal.counts | count == rig.journal.counts
    assert words in rig.journal.event and not rig.pipeline.conflict
    assert rig.feed([0.5])[0].heading == pytest.approx(heading + 0.5 * INTERVAL, abs=1e-6)


@pytest.mark.parametrize('rate', [0.5, 0.0])
def test_what_turns_while_the_stamps_stand_is_in_the_variance(tmp_path, rate):
    rig = Rig(tmp_path, model=CERTAIN)
    before = rig.feed(np.resize([0.009, 0.01, 0.011], 100))[-1]
    for _ in range(300):
        rig.skip(-INTERVAL, steady=0.0)
        assert rig.feed([rate]) == [None]
    after = rig.feed([0.01])[0]
    assert after.heading == pytest.approx(before.heading, abs=1e-3)
    assert math.sqrt(after.heading_variance) == pytest.approx(rate * 300 * INTERVAL, rel=0.02,
                                                              abs=1e-3)
    assert 'stood still for 3.0 s' in rig.journal.event


@pytest.mark.parametrize('value', [math.nan, math.inf, -math.inf, 1e155, -500.0, 101.0])
def test_an_impossible_rate_is_refused_and_leaves_a_gap(tmp_path, value):
    rig = Rig(tmp_path, model='')
    begin = rig.feed(np.full(10, 0.5))[-1].heading
    assert rig.feed([value]) == [None] and rig.journal.counts['refused_samples'] == 1
    assert rig.feed([0.5])[0].heading == pytest.approx(begin + 0.5 * 2 * INTERVAL, abs=1e-6)


# Gaps, dead gyros and outliers

@pytest.mark.parametrize(('wheels', 'odometry', 'known'), [
    ('none', 0.0, False), ('odom', 0.0, True), ('odom', 0.8, False), ('odom', None, False)],
    ids=['without wheels', 'wheels that stand', 'wheels that turn', 'without odometry'])
def test_a_turn_while_the_gyro_is_unplugged_is_in_the_variance(tmp_path, wheels, odometry, known):
    """It rests before and after, so that the rates around the gap do not show the turn."""
    rig = Rig(tmp_path, model=KNOWN, wheels=wheels)
    before = rig.feed(noisy(5.0), SLOW, moving=0.0)[-1]
    for _ in range(60):
        rig.skip(0.1)
        if odometry is not None:
            rig.pipeline.add_odometry(rig.fed, 0.0, Velocity(angular=(0.0, 0.0, odometry)))
    after = rig.feed(noisy(5.0), SLOW, moving=0.0)[-1]
    assert after.heading == pytest.approx(before.heading, abs=0.01)
    assert (math.sqrt(after.heading_variance) < 0.05) == known
    assert known or after.heading_variance > math.tau ** 2


@pytest.mark.parametrize('wheels', ['none', 'odom'])
@pytest.mark.parametrize('value', ['at rest', 'in a turn', 'saturated'])
def test_a_gyro_that_repeats_one_value_is_an_error_and_the_heading_claims_nothing(
        tmp_path, reported, value, wheels):
    rig = rested(tmp_path, seconds=5.0, wheels=wheels)
    begin, right, still = len(rig.outputs) - 1, rig.robot.distort, rig.robot.bias
    if value == 'in a turn':
        rig.turn(0.7, 3.0)
    rig.robot.distort = {'at rest': lambda _: still, 'in a turn': lambda _: 0.7,
                         'saturated': lambda output: min(output, 0.3)}[value]
    rig.turn(0.0 if value == 'in a turn' else 0.7, 6.0)
    level, message, _ = reported(rig)
    assert level == ERROR and 'the gyro repeats' in message and 'it is dead' in message, message
    rig.robot.distort = right
    rig.go(3.0)
    error, deviation = rig.error(begin)
    assert abs(error) < 3.0 * deviation, (error, deviation)
    reported(rig)
    rig.go(1.0)
    assert reported(rig)[0] != ERROR


def stop(acceleration):
    """Return the output of a gyro of zeros at rest, on a robot that stops so fast, rad/s²."""
    rate = np.maximum(0.9 - acceleration * SLOW * np.arange(1.0, 60.0), 0.0)
    return np.where(rate > 0.0, noisy(59 * SLOW, rate), 0.0)


def coarse(step):
    return np.round(noisy(60.0, 0.5 * np.sin(np.arange(1500) / 50.0)) / step) * step


REPEATED = {  # outputs, what comes then, rate of the odometry, whether it is a fault
    'zero at rest': (noisy(5.0), np.zeros(3000), None, False),
    'coarse steps': (noisy(10.0), np.round(noisy(120.0) / 0.02) * 0.02, None, False),
    'each sample four times': (noisy(10.0), np.repeat(noisy(30.0), 4), None, False),
    'zero after a stop of a robot': (noisy(10.0, 0.9), stop(5.0), None, False),
    'zero where no robot stops so fast': (noisy(10.0, 0.9), stop(100.0), None, True),
    'zero after a hard stop that wheels show': (noisy(10.0, 0.9), stop(100.0), 0.0, False),
    'zero after noise at rest': (noisy(15.0), np.zeros(3000), None, True),
    'zero at each rest': (np.concatenate([noisy(5.0), np.zeros(100), noisy(30.0)]), np.zeros(3000),
                          None, False),
    'saturated': (coarse(0.002), np.full(500, 0.3), None, True),
    'saturated, or by chance, in coarse steps': (coarse(0.02), np.full(500, 0.3), None, False),
    'two codes': (coarse(0.0005), np.resize([0.3, 0.3005, 0.3005, 0.3], 500), None, True),
    'two codes after noise at rest': (
        np.round(noisy(15.0) / 1e-4) * 1e-4, np.resize([0.0, 1e-4, 1e-4], 500), None, True),
    'two codes of a coarse gyro': (
        np.round(noisy(20.0, 0.01) / 0.02) * 0.02, np.round(noisy(60.0, 0.01) / 0.02) * 0.02,
        None, False),
    'zero where odometry turns': ([], np.zeros(50), 0.3, True),
}


@pytest.mark.parametrize('before, after, moving, is_fault', REPEATED.values(), ids=REPEATED)
def test_repeated_values_are_a_fault_where_no_gyro_gives_them_by_itself(
        tmp_path, before, after, moving, is_fault):
    rig = Rig(tmp_path, model=KNOWN)
    rig.feed(before, SLOW)
    assert not rig.pipeline.repeat_fault
    rig.feed(after, SLOW, moving=moving)
    assert ('the gyro repeats the rate' in rig.pipeline.repeat_fault) == is_fault
    assert ('the gyro repeats' in rig.pipeline.find_obstacle()) == is_fault, 'nothing is driven'
    rig.pipeline.reset_heading()
    shown = rig.feed(noisy(1.0), SLOW)[-1]
    assert not is_fault or shown.heading_variance > math.pi ** 2, 'a reset shows nothing'


@pytest.mark.parametrize('value', [0.0, 2e-4])
@pytest.mark.parametrize('alive', [0.0, 5.0], ids=['from the first sample on', 'after 5 s'])
def test_a_gyro_that_is_dead_in_the_first_seconds_is_an_error_in_turns_and_claims_no_heading(
        tmp_path, reported, alive, value):
    rig = rested(tmp_path, seconds=0.0, model=CERTAIN)
    rig.go(alive)
    right, rig.robot.distort = rig.robot.distort, lambda _: value
    for rate in (0.0, 0.7, 0.0):
        rig.turn(rate, 5.0)
        level, message, values = reported(rig)
        may_rest = 'it is dead, or shows this at rest' in message
        assert level == (WARN if may_rest and not alive else ERROR), message
        assert 'the gyro repeats' in message
        assert may_rest == (rate == 0.0 and not rig.pipeline.repeat_fault)
        assert float(values['heading_standard_deviation_deg']) > 300.0
        assert rig.outputs[-1].heading_variance > math.pi ** 2
    rig.robot.distort = right
    rig.go(20.0)
    error, deviation = rig.error()
    assert abs(error) > 2.0 and (deviation > math.pi or alive and not value), 'it has been dead'


@pytest.mark.parametrize('first', [np.zeros(500), np.full(500, 0.3)], ids=['zeros', 'one code'])
def test_a_gyro_that_repeats_its_value_at_rest_is_suspected_until_it_has_turned(
        tmp_path, reported, first):
    """It reports zero at rest, or its steps are larger than its noise."""
    rig = Rig(tmp_path, model=CERTAIN)
    found, step = rig.feed(first, SLOW), 0.3
    assert reported(rig)[0] == WARN and found[-1].heading_variance > math.pi ** 2
    assert found[3].heading_variance < 0.1, 'before 20 of them'
    rig.pipeline.add_command(Velocity(angular=(0.0, 0.0, 0.5)))
    assert reported(rig)[0] == ERROR, 'it does not rest'
    turn = noisy(10.0, 0.5)
    found = rig.feed(np.round(turn / step) * step if first[0] else turn, SLOW)
    assert reported(rig)[0] != ERROR and found[-1].heading_variance < (1.0 if first[0] else 0.1)
    rig.feed(first, SLOW)
    assert reported(rig)[0] != ERROR, 'it is known to do so'


@pytest.mark.parametrize('seconds, is_known', [(2.0, False), (0.0, True)],
                         ids=['in the turn', 'before it'])
def test_a_gyro_whose_first_zeros_end_in_a_turn_has_missed_a_part_of_it(
        tmp_path, seconds, is_known):
    rig = rested(tmp_path, seconds=0.0, model=CERTAIN)
    right, rig.robot.distort = rig.robot.distort, lambda _: 0.0
    rig.go(10.0)
    rig.robot.command(0.7)
    rig.go(seconds)
    rig.robot.distort = right
    rig.go(4.0)
    assert (rig.outputs[-1].heading_variance < 0.1) == is_known


def test_the_error_of_a_coarse_output_is_in_the_variance(tmp_path):
    step, errors = 0.5 * DEGREE, []
    for part in range(8):
        rig = Rig(_folder(tmp_path, str(part)), model=CERTAIN.replace('0.01}', '0.0}'))
        rate = 0.5 + (part + 0.5) / 8.0 * step
        time = np.arange(1900) * INTERVAL
        turn = rate * np.clip(np.minimum(time - 10.0, 14.25 - time) / 0.25, 0.0, 1.0)
        wanted = np.round((turn + 1e-3 * np.random.default_rng(part).normal(size=1900)) / step)
        found = [each for each in rig.feed(wanted * step) if each][-1]
        deviation = math.sqrt(found.heading_variance)
        errors.append((found.heading - rate * 4.0) / deviation)
        assert deviation < 1.5 * DEGREE
    assert max(map(abs, errors)) < 3.0 and np.std(errors) > 0.3, errors


@pytest.mark.parametrize('acceleration', [5.0, 18.0])
def test_a_gyro_that_reports_zero_at_each_rest_keeps_the_heading_where_a_robot_stops_fast(
        tmp_path, reported, acceleration):
    rig = Rig(tmp_path, model=CERTAIN.replace('{bias: 0.01}', '{bias: 0.0}'))
    for _ in range(5):
        turn = np.concatenate([np.zeros(1000), stop(acceleration)[::-1], noisy(4.0, 0.9, 0.0),
                               stop(acceleration)])
        found = rig.feed(turn, SLOW)
        assert not rig.pipeline.repeat_fault and not rig.pipeline.monitor.noise_alarm
        assert found[-1].heading_variance < (2.0 * DEGREE) ** 2
    assert 'noise' not in reported(rig)[1]


def test_a_gyro_that_odometry_has_shown_to_be_dead_stays_so_at_the_next_stop(tmp_path, reported):
    rig = Rig(tmp_path, model=KNOWN.split('noise')[0])  # without noise figures
    for moving in (0.0, 0.3, 0.0):
        rig.feed(np.zeros(200), SLOW, moving=moving)
        assert ('it is dead' in reported(rig)[1]) == bool(moving or rig.pipeline.repeat_fault)
    assert rig.pipeline.repeat_fault
    rig.feed(noisy(2.0), SLOW)
    assert not rig.pipeline.repeat_fault


@pytest.mark.parametrize('size', [0.3, -1.0, 30.0])
def test_single_samples_that_deviate_do_not_turn_the_heading(tmp_path, size):
    rig, places = Rig(tmp_path, model=CERTAIN), np.arange(1500)
    found = rig.feed(noisy(60.0, 0.3, 0.01) + size * (places % 25 == 12) * (places > 250))
    error = found[-1].heading - 0.3 * 1499 * INTERVAL
    assert abs(error) < 4.0 * math.sqrt(found[-1].heading_variance)
    assert abs(error) < 0.1 * abs(size * 50 * INTERVAL)


@pytest.mark.parametrize('size, count', [(0.3, 20), (-1.0, 5), (2.0, 2)])
def test_several_samples_that_deviate_are_in_the_variance_and_a_turn_of_a_robot_is_not(
        tmp_path, size, count):
    rig = rested(tmp_path, model=CERTAIN, robot=Robot(bias=0.01, scale_factor_error=0.0))
    rig.turn(0.7, 0.4)  # the robot has begun to turn
    rig.go(2.6)
    assert rig.error()[1] < 0.1 * DEGREE
    numbers = iter(range(10 ** 6))
    rig.robot.distort = lambda output: output + size * (100 <= next(numbers) < 100 + count)
    rig.go(3.0)
    error, deviation = rig.error()
    assert 0.7 * abs(size * count * INTERVAL) < abs(error) < 1.5 * deviation


@pytest.mark.parametrize('value, begin', [(None, 220), (None, 231), (0.0, 236)],
                         ids=['before a turn', 'as it begins', 'zero in the turn'])
def test_a_turn_while_one_value_is_held_for_a_short_time_is_in_the_variance(
        tmp_path, value, begin):
    """A gyro of 100 Hz that is dead for 0.2 s, or its driver that stops."""
    rig = rested(tmp_path, model=CERTAIN,
                 robot=Robot(bias=0.01, scale_factor_error=0.0, noise=5e-3, latency=0.0, lag=0.1))
    outputs = []

    def hold(output):
        outputs.append(output)
        if not begin <= len(outputs) < begin + 20:
            return output
        return outputs[begin - 1] if value is None else value
    rig.robot.distort = hold
    rig.go(2.3)
    rig.turn(1.5, 3.0)
    assert 'repeats' not in rig.journal.event
    error, deviation = rig.error()
    assert abs(error) < 4.0 * deviation < 1.0


def test_the_threshold_filter_deletes_rates_at_rest_unless_it_is_switched_off(tmp_path):
    rig = Rig(tmp_path, model='')
    assert rig.feed(np.full(50, 0.1 * DEGREE))[-1].heading == 0.0
    assert rig.pipeline.estimator.tracker.deleted_heading > 0.03 * DEGREE
    rig = Rig(tmp_path / 'off', model='', stationary_threshold=0.0)
    assert rig.feed([0.1 * DEGREE] * 2)[-1].rate == pytest.approx(0.1 * DEGREE)


def test_odometry_that_turns_without_a_rate_is_a_warning_and_shows_no_standstill(
        tmp_path, reported):
    rig = rested(tmp_path, seconds=60.0, wheels='odom')
    begin, odometry = len(rig.outputs) - 1, rig.pipeline.add_odometry
    rig.pipeline.add_odometry = lambda stamp, heading, _: odometry(stamp, heading, Velocity())
    rig.turn(0.05 * DEGREE, 60.0)
    level, message, _ = reported(rig)
    assert level == WARN and 'odom turns by its headings' in message, message
    assert rig.pipeline.wheels.is_moving(rig.clock.now) is None
    error, deviation = rig.error(begin)
    assert abs(error) < 4.0 * deviation, (error, deviation)


@pytest.mark.parametrize('interval, has_rate, warns', [
    (2.0, True, False), (1.0, True, False), (0.5, True, False), (0.05, True, False),
    (1.0, False, True), (0.05, False, True)])
def test_slow_odometry_may_miss_a_turn_between_two_messages(tmp_path, interval, has_rate, warns):
    rig, count = rested(tmp_path, wheels='odom'), itertools.count(1)
    rig.odometry = lambda stamp, reading: next(count) % round(interval / INTERVAL) or (
        rig.pipeline.add_odometry(stamp, reading.heading, Velocity(
            angular=(0.0, 0.0, reading.rate * (has_rate and abs(reading.rate) > 1e-3)))))
    for rate, seconds in ((0.7, 4.0), (0.0, 5.0), *10 * ((0.9, 0.2), (0.0, 3.1))):
        rig.turn(rate, seconds)
    assert bool(rig.pipeline.faults['odometry']) == warns


@pytest.mark.parametrize('moved, wheels', [(1.5, 'none'), (3.0, 'odom'), (0.0, 'odom')])
def test_a_turn_by_the_gyro_alone_while_odometry_stands_is_a_warning_and_in_the_variance(
        tmp_path, reported, moved, wheels):
    """As of a bias that changed in the drive before, or of odometry that has stopped."""
    rig = rested(tmp_path, model=CERTAIN, seconds=12.0, wheels=wheels,
                 robot=Robot(bias=0.01, scale_factor_error=0.0))
    rig.turn(0.3, 3.0)
    rig.robot.bias += moved * DEGREE
    rig.go(10.0)
    rig.turn(0.0, 10.0)
    rig.pipeline.reset_heading() if not moved else None
    rig.go(2.0)
    level, message, _ = reported(rig)
    assert ('deg while odom shows that the robot stands' in message) == (level == WARN) == (
        moved > 0.0), message
    if moved:
        error, deviation = rig.error()
        assert 10.0 * DEGREE < abs(error) < 2.0 * deviation < 4.0 * abs(error)


@pytest.mark.parametrize('unit, warns', [
    (1.0 / DEGREE, True), (1.0, False), (-1.0, False), (10.0, False)])
def test_without_odometry_turns_are_compared_with_commands(tmp_path, reported, unit, warns):
    """Where others turn the robot the other way, or a base ten times as far, nothing is shown."""
    rig = rested(tmp_path)
    rig.odometry = lambda stamp, reading: None
    rig.robot.distort = lambda output: unit * output
    rig.other = 0.4
    rig.go(20.0)
    level, message, _ = reported(rig)
    assert ('times what cmd_vel shows: check the unit' in message) == warns, message
    assert (rig.error()[1] > math.tau) == warns


@pytest.mark.parametrize('gyro, wheels, words, is_unknown', [
    (1.0 / DEGREE, 1.0, 'check the unit', True), (-1.0, 1.0, 'check the unit', True),
    (1.0, -1.0, 'check the unit', True), (1.0, 1.0, '', False), (1.0, 3.0, '', False),
    (2.0, 1.0, 'check the sensitivity', False), (7.0, 1.0, 'check the sensitivity', False),
    (1e-3, 1.0, '', False)],
    ids=['deg/s', 'sense', 'sense of odom', 'right', 'odom three times', 'gyro twice',
         'gyro seven times', 'wheels that slip'])
def test_turns_that_contradict_odometry_are_a_warning_and_the_heading_may_claim_nothing(
        tmp_path, reported, gyro, wheels, words, is_unknown):
    rig = rested(tmp_path)
    begin, odometry = len(rig.outputs) - 1, rig.pipeline.add_odometry
    rig.pipeline.add_odometry = lambda stamp, heading, velocity: odometry(
        stamp, heading, Velocity(angular=(0.0, 0.0, wheels * velocity.angular[2])))
    rig.robot.distort = lambda output: gyro * output
    for rate in (0.7, -0.7):
        rig.turn(rate, 10.0)
        rig.turn(0.0, 4.0)
    level, message, _ = reported(rig)
    assert (level == WARN and f'times what odom shows: {words}' in message) == bool(words)
    assert (rig.error(begin)[1] > math.tau) == is_unknown


# What odometry and commands of the last second show of the wheels

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


# Several publishers

@pytest.mark.parametrize('shift', [-0.3, -0.005, 0.3])
def test_stamps_that_interleave_are_an_error_and_the_heading_stands(tmp_path, shift):
    rig = rested(tmp_path, stationary_method='none')
    rig.robot.command(0.7)
    for _ in range(500):
        rig.step()
        reading = max(rig.truth)
        rig.sample(reading + round(1e9 * shift), 0.0)
    assert 'jump back repeatedly' in rig.pipeline.conflict
    turned = rig.outputs[-1].heading - rig.outputs[250].heading
    assert abs(turned) < 0.7 * 0.5, 'half a second at most'


@pytest.mark.parametrize('share, behind', [(0.0, 1), (0.005, 1), (0.1, 1), (0.02, 3)])
def test_samples_that_come_late_from_one_publisher_are_lost_samples(tmp_path, share, behind):
    rig, waiting = rested(tmp_path, model=CERTAIN, seconds=12.0,
                          robot=Robot(bias=0.01, scale_factor_error=0.0)), []
    sample, generator, begin = rig.sample, np.random.default_rng(1), len(rig.outputs) - 1

    def swap(*reading):
        if not waiting and (generator.random() < share or not share and len(rig.truth) == 1500):
            waiting.append((behind, reading))
            return
        sample(*reading)
        if waiting:
            left, late = waiting.pop()
            sample(*late) if left == 1 else waiting.append((left - 1, late))
    rig.sample = swap
    for rate in (0.7, -0.4, 0.5, 0.0):
        rig.turn(rate, 5.0)
    counts, (error, deviation) = rig.journal.counts, rig.error(begin)
    assert not rig.pipeline.conflict and not counts['restarts'] and counts['lost_samples'] > 0
    assert 'came after the next one' in rig.journal.event
    assert abs(error) < 4.0 * deviation < 0.3 * len(rig.outputs) * max(share, 1e-3) * DEGREE


def test_a_queue_that_is_stamped_on_arrival_is_no_stamp_that_stands_still(tmp_path, reported):
    rig = rested(tmp_path)
    rig.go(2.0)
    stamp = max(rig.truth) + 10 ** 7
    for _ in range(5):
        rig.pipeline.add_sample(stamp, 0.0)
    level, message, _ = reported(rig)
    assert level == WARN and 'several samples have the stamp' in message


@pytest.mark.parametrize('other, warns', [
    (lambda rate: 0.0, True), (lambda rate: -0.3 * rate, True), (lambda rate: rate, False),
    (lambda rate: 1.05 * rate + 0.01, False)], ids=['across', 'oblique', 'one gyro', 'same axis'])
def test_every_other_sample_of_another_gyro_is_a_warning_and_the_heading_claims_nothing(
        tmp_path, reported, other, warns):
    """One publisher, one frame and increasing stamps, as of a relay that joins two topics."""
    rig, count = rested(tmp_path), itertools.count()
    rig.robot.distort = lambda output: other(output) if next(count) % 2 else output
    for rate in (0.5, -0.8, 0.6, -0.4):
        rig.turn(rate, 6.0)
    level, message, _ = reported(rig)
    assert (level == WARN and 'every other sample on imu/data_raw' in message) == warns, message
    assert (rig.error()[1] > math.tau) == warns
    assert ('every other sample' in rig.pipeline.find_obstacle()) == warns


def test_samples_of_two_frames_through_one_publisher_are_an_error(tmp_path):
    rig = Rig(tmp_path, model='')
    for _ in range(100):
        rig.feed([0.5])
        rig.pipeline.add_sample(rig.fed + 5 * 10 ** 6, 0.0, frame='other')
    assert "samples of the frames '' and 'other' alternate" in rig.pipeline.conflict
    assert rig.outputs[-1].heading < 0.5 * 0.2
    rig.feed(np.full(150, 0.5))
    assert not rig.pipeline.conflict


def test_after_a_change_of_the_frame_the_heading_claims_nothing(tmp_path, reported):
    """The calibration may be that of another gyro, or of another mount."""
    rig = Rig(tmp_path)
    for frame, fault, is_known in (('gyro', '', True), ('gyro', '', True),
                                   ('other\n', "the frame 'other\\n', and had 'gyro'", False),
                                   ('gyro', '', False)):
        for _ in range(250):
            rig.clock.now += INTERVAL
            rig.fed += 10 ** 7
            rig.outputs.append(rig.pipeline.add_sample(
                rig.fed, rig.robot.step().output, frame=frame))
            rig.guards()
        found = rig.pipeline.faults['frame']
        assert fault in found and bool(fault) == bool(found)
        assert fault in reported(rig)[1] and fault in rig.pipeline.find_obstacle()
        assert (rig.outputs[-1].heading_variance < math.pi ** 2) == is_known


@pytest.mark.parametrize('reset', [False, True], ids=['', 'reset meanwhile'])
def test_a_turn_between_two_rests_while_two_publishers_send_is_in_the_variance(tmp_path, reset):
    rig = rested(tmp_path)
    begin = len(rig.outputs) - 1
    rig.publishers = ['/a/driver_node', '/b/driver_node']
    for step in range(700):
        if step == 100 and reset:
            rig.pipeline.reset_heading()
        if step in (100, 400):
            rig.robot.command(0.8 * (step == 100))
        rig.step()
        rig.pipeline.add_sample(max(rig.truth) + 4 * 10 ** 6, 0.0)
    assert rig.pipeline.conflict
    rig.publishers = ['/a/driver_node']
    rig.go(5.0)
    error, deviation = rig.error(begin)
    assert not rig.pipeline.conflict and 2.0 < abs(error) < 3.0 * deviation, (error, deviation)


@pytest.mark.parametrize('names', [('/a', '/b'), ('/a', '/a')], ids=['two names', 'one name'])
@pytest.mark.parametrize('offset', [1, 3, 5, 9, -300, 300],
                         ids=lambda offset: f'{offset} ms apart')
def test_two_publishers_that_both_send_are_found_by_their_stamps(tmp_path, offset, names):
    rig = Rig(tmp_path, model='')
    rig.feed(np.full(100, 0.5))
    rig.publishers = list(names)
    rig.pipeline.update_publishers(rig.publishers)
    turned = rig.outputs[-1].heading
    for _ in range(30):
        rig.pipeline.add_sample(rig.fed + offset * 10 ** 6, 0.0)
        rig.feed([0.5])
    assert '2 publishers send' in rig.pipeline.conflict
    assert abs(rig.outputs[-1].heading - turned) < 0.5 * 30 * INTERVAL


def test_no_published_stamp_is_outside_of_ros_time(tmp_path):
    for offset, stamp in ((0.2, 0), (-0.2, 2 ** 31 * 10 ** 9 - 1)):
        model = f'effects: {{time_offset: {{time_offset: {offset}}}}}\n' + KNOWN.split('\n')[1]
        rig = Rig(tmp_path, model=model)
        assert not rig.pipeline.store.problem
        found = rig.pipeline.add_sample(stamp, 0.5)
        assert found is None or 0 <= found.stamp < 2 ** 31 * 10 ** 9


@pytest.mark.parametrize('stamp', [-1, 2 ** 31 * 10 ** 9, (2 ** 31 - 1) * 10 ** 9 + 2 ** 32])
def test_a_stamp_that_is_none_of_ros_time_is_refused(tmp_path, stamp):
    rig = Rig(tmp_path, model='')
    rig.feed(np.full(10, 0.5))
    assert rig.pipeline.add_sample(stamp, 0.5) is None
    assert 'outside the range of ROS time' in rig.journal.event
    assert rig.feed([0.5])[0].heading == pytest.approx(0.05, abs=1e-9)


THERMAL = ('effects: {bias: {bias: 0.01}, bias_temperature: {bias_temperature: 2.0e-3}}\n'
           'reference_temperature: 25.0\nnoise: {angle_random_walk: 5.0e-4}\n')


@pytest.mark.parametrize('given, used', [
    ([60.0], 25.0), ([60.0, 25.0, 60.0, 25.0, 60.0], 25.0), ([60.0, 61.0], 61.0),
    ([-240.0, -239.0], 25.0)],
    ids=['a leap', 'of a second sensor', 'a leap that stays', 'an impossible one that stays'])
def test_a_temperature_that_leaps_is_used_where_it_stays_and_is_possible(tmp_path, given, used):
    rig = Rig(tmp_path, model=THERMAL)
    rig.feed(noisy(20.0), SLOW, temperature=25.0)
    for each in given:
        rig.pipeline.add_temperature(rig.fed, each)
        rig.feed(noisy(1.0), SLOW)
    assert rig.pipeline.estimator.temperature == used
    assert rig.journal.counts['refused_temperatures'] >= given.count(60.0)


@pytest.mark.parametrize(('stamps', 'steady', 'beginnings'), [
    (9.0, 9.0, 1), (12.0, 12.0, 2), (0.0, 15.0, 1), (2.0, 15.0, 1)],
    ids=['short', 'long', 'a busy node, all samples waited', 'and its queue overflowed'])
def test_a_gyro_that_was_silent_for_10_s_may_have_been_without_power(
        tmp_path, stamps, steady, beginnings):
    rig = Rig(tmp_path)
    rig.feed(np.zeros(50))
    rig.skip(stamps, steady=steady)
    rig.feed([0.0])
    assert rig.pipeline.estimator.restart_count == beginnings


@pytest.mark.parametrize('step', [3600.0, -3600.0, -0.5, 2e7])
def test_a_clock_of_the_host_that_is_set_changes_neither_heading_nor_variance(tmp_path, step):
    plain, stepped = (Rig(folder, stationary_method='none', robot=Robot(seed=3))
                      for folder in (_folder(tmp_path, 'a'), _folder(tmp_path, 'b')))
    for rig in (plain, stepped):
        rig.turn(0.5, 5.0)
    stepped.clock.set_by = step
    for rig in (plain, stepped):
        rig.go(5.0)
    a, b = plain.outputs[-1], stepped.outputs[-1]
    assert b.heading == pytest.approx(a.heading, abs=1e-3)
    assert b.heading_variance == pytest.approx(a.heading_variance, rel=0.01)
    assert f'{step:+.1f} s' in stepped.journal.clock_steps
    assert stepped.journal.counts['restarts'] == 0


def _folder(path, name):
    (path / name).mkdir()
    return path / name


def test_stamps_that_leap_by_less_than_a_gap_are_in_the_variance(tmp_path):
    rig = rested(tmp_path)
    begin, stamp = len(rig.outputs) - 1, rig.stamp
    rig.turn(0.7, 3.0)
    rig.stamp = lambda reading: stamp(reading) + 9 * 10 ** 8
    rig.go(3.0)
    last = rig.outputs[-1]
    off = last.heading - rig.outputs[begin].heading - rig.truth[last.stamp]
    assert 0.5 < off < 3.0 * math.sqrt(last.heading_variance), off


@pytest.mark.parametrize('moved, parameters', [(0.15 * DEGREE, {}), (1.0 * DEGREE, {}),
                                               (0.15 * DEGREE, {'stationary_threshold': 0.0})],
                         ids=['below the threshold', 'above the threshold', 'without a threshold'])
def test_a_bias_that_moved_raises_an_alarm_which_a_calibration_at_rest_ends(
        tmp_path, moved, parameters):
    rates = noisy(90.0, bias=0.01 + moved)
    rig = Rig(tmp_path, model=CERTAIN, **parameters)
    rig.feed(rates[:1050], SLOW)
    monitor = rig.pipeline.monitor
    assert monitor.last_rest.bias == pytest.approx(moved, abs=1e-3) and not monitor.noise_alarm
    assert 'sigma of the model: calibrate' in monitor.bias_alarm
    rig.begin(REST)
    rig.feed(rates[1050:1450], SLOW)
    assert rig.session.conclude()[0]
    rig.feed(rates[1450:], SLOW)
    assert not rig.pipeline.monitor.bias_alarm


@pytest.mark.parametrize('odometry', [True, False], ids=['odometry', 'no wheels'])
@pytest.mark.parametrize('rate', [1.6, 5.0, 20.0])
def test_an_even_turn_of_a_circle_is_no_change_of_the_bias(tmp_path, rate, odometry):
    rig = Rig(tmp_path, model=CERTAIN)
    for seconds, each in ((12.0, 0.0), (60.0, rate * DEGREE), (12.0, 0.0)):
        for part in range(round(seconds)):
            rig.feed(noisy(1.0, each, 0.01, part), SLOW, moving=each if odometry else None)
            assert not rig.pipeline.monitor.bias_alarm
    assert rig.pipeline.monitor.examined_count > 1


PLAIN = {'bias': {'bias': 0.002}, 'scale_factor_error': {'scale_factor_error': 0.02},
         'bias_temperature': {'bias_temperature': 2e-4, 'reference_temperature': 25.0}}
PAST = {'thermal_lag': {'thermal_lag': -8e-4, 'time_constant': 40.0},
        'warm_up': {'warm_up': 0.004, 'time_constant': 80.0},
        'bias_temperature_rate': {'bias_temperature_rate': 0.02},
        'thermal_hysteresis': {'thermal_hysteresis': 5e-4},
        'heading_sensitivity': {'sine': 1e-3, 'cosine': -5e-4}}


def model(effects):
    return yaml.safe_dump({'effects': effects, 'noise': {'angle_random_walk': 1e-5}})


def test_a_time_offset_moves_the_published_stamps(tmp_path):
    rig = Rig(tmp_path, model=model({'time_offset': {'time_offset': 0.02}}))
    found = rig.feed(np.full(3, 0.5))
    assert [rig.fed - each.stamp for each in found] == [40_000_000, 30_000_000, 20_000_000]


@pytest.fixture
def reported():
    module = pytest.importorskip('gyro_calibration.ros.compensation_node')
    reports = {}

    def report(rig):
        known = reports.setdefault(id(rig), module.CompensationReport(rig.pipeline, rig.clock))
        level, message, values = known.make()
        return int.from_bytes(level, 'little'), message, values
    return report


OK, WARN, ERROR = range(3)


@pytest.mark.parametrize('fault, level, words', [
    (lambda rig: None, OK, 'the heading is published'),
    (lambda rig: setattr(rig.robot, 'unplugged', True), ERROR, 'no samples on imu/data_raw for'),
    (lambda rig: setattr(rig.robot, 'stamps_stand', True), ERROR, 'several samples have'),
    (lambda rig: rig.publishers.append('/other'), ERROR, '2 publishers send'),
    (lambda rig: setattr(rig, 'ros_speed', 0.0), ERROR, 'ROS time stands still'),
    (lambda rig: setattr(rig.robot, 'bias', 1e9), ERROR, 'beyond the range of this gyro'),
    (lambda rig: setattr(rig.session, 'warning', 'it turned on'), WARN, 'it turned on'),
], ids=['none', 'unplugged', 'stamps', 'publishers', 'clock', 'absurd rates',
        'a robot that turned on after a drive'])
def test_the_diagnostics_name_what_is_wrong_within_two_seconds(
        tmp_path, reported, fault, level, words):
    rig = rested(tmp_path, ros=1000.0)
    reported(rig)
    fault(rig)
    rig.go(2.0)
    found, message, _ = reported(rig)
    assert (found, words in message) == (level, True), message


@pytest.mark.parametrize('wheels, warns', [
    ('odom', True), ('both', True), ('none', False), ('cmd_vel', False)])
def test_wheels_by_an_odometry_that_does_not_come_are_a_warning(
        tmp_path, reported, wheels, warns):
    rig = rested(tmp_path, wheels=wheels)
    assert reported(rig)[0] == OK
    rig.odometry = lambda stamp, reading: None
    rig.go(3.0)
    level, message, _ = reported(rig)
    assert (level == WARN and 'remap odom to the odometry' in message) == warns, message


def test_lost_samples_hide_no_worse_warning_and_are_reported_with_it(tmp_path, reported):
    rig, count = rested(tmp_path), itertools.count()
    sample = rig.sample
    rig.sample = lambda *reading: next(count) % 4 == 0 or sample(*reading)
    rig.pace_stamps(0.5)
    for _ in range(10):
        rig.go(1.0)
        level, message, values = reported(rig)
    assert level == WARN and 'stamps on imu/data_raw advanced by' in message, message
    assert 'the heading is unknown' in values['other_warnings']
    assert 'samples are lost' in values['other_warnings']


@pytest.mark.parametrize('pace, seconds', [(0.8, 2.0), (1.2, 2.0), (0.97, 30.0), (1.03, 30.0)])
def test_a_turn_while_stamps_advance_unevenly_for_a_time_is_a_warning_and_in_the_variance(
        tmp_path, reported, pace, seconds):
    rig = rested(tmp_path, robot=Robot(scale_factor_error=0.0, bias=0.0), seconds=60.0)
    rig.turn(0.5, 1.0)
    rig.pace_stamps(pace)
    rig.go(seconds)
    rig.pace_stamps(2.0 - pace)
    rig.turn(0.0, 8.0)
    error, deviation = rig.error(10)
    missed = (pace - 1.0) * 0.5 * seconds
    assert error == pytest.approx(missed, rel=0.5) and abs(error) < 2.0 * deviation
    level, message, _ = reported(rig)
    assert level == WARN and 'the heading may be off by' in message
    rig.pipeline.reset_heading()
    assert not rig.pipeline.faults['stamp']


@pytest.mark.parametrize('pace, warns', [(1e-6, True), (0.9, True), (1.1, True), (2.0, True),
                                         (1.03, False), (1.0, False)])
def test_stamps_that_leave_the_clock_are_a_warning_and_the_heading_claims_nothing(
        tmp_path, reported, pace, warns):
    """What turns in the meantime is not what the stamps say."""
    rig = rested(tmp_path)
    first = len(rig.outputs) - 1
    rig.pace_stamps(pace)
    rig.turn(0.5, 17.0)
    reported(rig)
    rig.go(1.0)
    level, message, _ = reported(rig)
    assert (level == WARN and 'stamps on imu/data_raw advanced by' in message) == warns, message
    assert (rig.error(first)[1] > math.tau) == warns
    rig.go(60.0)
    assert warns or float(reported(rig)[2]['stamp_pace']) == pytest.approx(pace, abs=3e-3)


@pytest.mark.parametrize('fault, words', [
    (lambda rig: rig.go(3.0), 'no samples for 3.0'), (lambda rig: None, 'jumps back by 0.97')],
    ids=['unplugged', 'a jump back'])
def test_while_the_heading_is_unknown_a_warning_says_why_until_a_reset(
        tmp_path, reported, fault, words):
    rig = rested(tmp_path)
    rig.turn(0.5, 2.0)
    rig.robot.unplugged = True
    fault(rig)
    rig.robot.unplugged = False
    if 'back' in words:
        rig.stamp = lambda reading, stamp=rig.stamp: stamp(reading) - 10 ** 9
    for _ in range(3):
        rig.go(5.0)
        reported(rig)
        level, message, values = reported(rig)
        assert level == WARN and 'the heading is unknown (' in message, message
        assert words in message and 'call reset_heading' in message
        assert float(values['heading_standard_deviation_deg']) >= 360.0
    rig.pipeline.reset_heading()
    rig.go(2.0)
    assert reported(rig)[:2] == (OK, 'the heading is published')


def test_a_count_is_a_warning_only_while_it_grows(tmp_path, reported):
    rig = Rig(tmp_path, model='')
    rig.feed(np.full(200, 0.5))
    rig.feed([math.nan])
    reported(rig)
    rig.feed(np.full(200, 0.5))
    level, message, values = reported(rig)
    assert level == OK, message
    assert values['refused_samples'] == 1


def test_the_values_tell_what_is_known(tmp_path, reported):
    rig = Rig(tmp_path, model=KNOWN)
    rig.feed(noisy(40.0), SLOW)
    reported(rig)
    rig.feed(noisy(5.0, seed=1), SLOW)
    _, _, values = reported(rig)
    assert values['resting'] is True and values['wheels'] == 'unknown'
    assert float(values['bias_deg_s']) == pytest.approx(0.002 / DEGREE, abs=0.02)
    assert 'cannot be distinguished from drift' in values['slow_turns']
    assert float(values['slowest_noticed_turn_deg_s']) > 0.0
    assert float(values['rate_hz']) == pytest.approx(25.0, rel=0.05)
    assert math.isfinite(float(values['heading_standard_deviation_deg']))


def test_every_value_has_a_key_in_snake_case_that_the_documents_name(tmp_path, reported):
    rig = rested(tmp_path)
    rig.calibrate(REST)
    rig.feed(noisy(60.0), SLOW)
    _, _, values = reported(rig)
    page = (Path(__file__).parents[2] / 'docs/reference/on_a_robot.md').read_text()
    assert [key for key in values if not re.fullmatch('[a-z0-9_]+', key)] == []
    assert [key for key in values if f'`{key}`' not in page] == []


finite = st.floats(allow_nan=True, allow_infinity=True)
event = st.one_of(
    st.tuples(st.just('sample'), st.integers(-2 ** 62, 2 ** 62), finite, finite),
    st.tuples(st.just('temperature'), st.integers(-2 ** 62, 2 ** 62), finite, st.just(0.0)),
    st.tuples(st.just('odometry'), st.integers(-2 ** 62, 2 ** 62), finite, finite),
    st.tuples(st.sampled_from(['command', 'reset']), st.just(0), finite, finite))


ANY = {'cubic': PLAIN | {'cubic_nonlinearity': {'cubic_nonlinearity': 1e-3}},
       'negative': PLAIN | {'cubic_nonlinearity': {'cubic_nonlinearity': -1e-3}},
       'past': PLAIN | PAST | {'acceleration_sensitivity': {'acceleration_sensitivity': 1e-3}}}


@settings(max_examples=60, derandomize=True, deadline=None,
          suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(events=st.lists(event, max_size=20), name=st.sampled_from([*ANY]))
def test_no_value_leaves_a_heading_that_is_no_number_or_no_variance(tmp_path, events, name):
    rig = Rig(tmp_path, model=yaml.safe_dump(
        {'effects': ANY[name], 'noise': {'angle_random_walk': NOISE, 'bias_instability': 1e-5}}))
    assert not rig.pipeline.store.problem
    rig.feed(noisy(4.0), SLOW)
    pipeline, published = rig.pipeline, []
    for kind, stamp, first, second in events:
        velocity = Velocity((first, 0.0, 0.0), (0.0, 0.0, second))
        if kind == 'sample':
            published.append(pipeline.add_sample(stamp, first, second))
        elif kind == 'temperature':
            pipeline.add_temperature(stamp, first)
        elif kind == 'odometry':
            pipeline.add_odometry(stamp, first, velocity)
        elif kind == 'command':
            pipeline.add_command(velocity)
        else:
            pipeline.reset_heading()
        rig.guards()
    rig.clock.now += 2.0
    rig.guards()
    published += rig.feed(noisy(20.0), SLOW)
    assert published[-1] is not None and math.isfinite(published[-1].heading)
    assert all(math.isfinite(value) for found in published if found for value in found)
    assert all(min(found.rate_variance, found.heading_variance) > 0.0
               for found in published if found)
