# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.


"""Logs that begin with an unknown bias: a slow, steady turn differs from a rest by its rate."""

import math

from gyro_calibration import Log, read_model, track
from gyro_calibration.heading.bias_table import BiasTable
from gyro_calibration.heading.heading_estimator import Assumptions, HeadingEstimator
from gyro_calibration.heading.tracker import TrackerSettings
from gyro_calibration.logs.log import DEGREE
from gyro_calibration.model.gyro_model import GyroModel
from gyro_calibration.model.noise import Noise
import numpy as np
import pytest

RATE, WALK = 50.0, 0.03 * DEGREE
NOISE = Noise(WALK, WALK / 20.0, WALK / 300.0)
ASSUMED = Assumptions(bias_temperature_coefficient=0.0)
#: Durations, s, and rates, deg/s; the bias is far within its prior of 0.5 deg/s.
TURN_FIRST = [(20, 0.8), (20, 0), (4, 30), (10, 0), (4, -30), (10, 0)]
REST_FIRST = [(20, 0), (20, 0.8), (4, 30), (10, 0), (4, -30), (10, 0)]


def simulated(parts, seed=0, bias=-0.2):
    """Return time, output, and true heading, deg."""
    rate = np.concatenate([np.full(round(duration * RATE), value) for duration, value in parts])
    noise = WALK * math.sqrt(RATE) * np.random.default_rng(seed).standard_normal(len(rate))
    time = np.arange(len(rate)) / RATE
    return time, (rate + bias) * DEGREE + noise, np.append(0.0, np.cumsum(
        0.5 * (rate[1:] + rate[:-1]))) / RATE


def followed(parts, bias=0.5, hindsight=False, seed=0):
    """Return error and stated deviation of the heading, deg, with a prior of the bias, deg/s."""
    model = read_model({
        'effects': {'bias': {'bias': 0.0}}, 'covariance': [[(bias * DEGREE) ** 2]],
        'noise': vars(NOISE)})
    time, output, true = simulated(parts, seed)
    found = track(Log(time, output), model, hindsight=hindsight)
    return (found.heading - found.heading[0]) / DEGREE - true, found.heading_std / DEGREE


@pytest.mark.parametrize('seed', range(3))
def test_a_log_that_begins_with_a_slow_turn_ends_with_the_right_heading(seed):
    error, deviation = followed(TURN_FIRST, seed=seed)
    # at the end of the second steady rate either may be the bias
    assert abs(error[round(39 * RATE)]) < 3.0 * deviation[round(39 * RATE)]
    assert abs(error[-1]) < 3.0 * deviation[-1] < 10.0


def test_with_hindsight_the_turn_is_in_the_heading_from_the_begin_on():
    error, deviation = followed(TURN_FIRST, hindsight=True)
    assert (np.abs(error) <= 3.0 * deviation).all()
    assert np.abs(error).max() < 2.0


@pytest.mark.parametrize('bias', [0.5, 0.003], ids=['unknown', 'known'])
def test_a_slow_turn_after_a_rest_is_a_turn(bias):
    """Where the bias was not known before, the uncertainty allows for the opposite until later."""
    error, deviation = followed(REST_FIRST, bias)
    if bias == 0.5:
        assert abs(error[round(39 * RATE)]) < 1.0 < 4.0 < deviation[round(39 * RATE)]
        assert (np.abs(error) <= 3.0 * deviation).all()
        assert np.abs(error).max() < 2.0 and deviation[-1] < 2.0


def test_rests_alone_leave_no_ambiguity():
    error, deviation = followed([(20, 0), (4, 30), (3, 0), (4, 30), (10, 0)])
    assert (np.abs(error) <= 3.0 * deviation).all()
    assert deviation.max() < 1.0


def test_a_turn_at_the_limit_of_the_prior_counts_once():
    """With the bias it is at 6.1 sigma, which its steps cross: parts would confirm each other."""
    error, deviation = followed([(10, 0), (60, -2.854), (20, 9.0), (20, -7.0)])
    assert np.abs(error).max() < 2.0 and (np.abs(error) <= 3.0 * deviation).all()


def estimator():
    model = GyroModel(noise=NOISE)
    return HeadingEstimator(model, BiasTable(model), ASSUMED, TrackerSettings(), 1.7e9)


def test_blocks_have_the_heading_of_single_samples():
    time, output, _ = simulated(TURN_FIRST)
    one, many = estimator(), estimator()
    rows = []
    for at, value in zip(time, output):
        one.add(at, value, 1.7e9)
        rows.append((one.tracker.heading, one.tracker.variance, one.tracker.rate_variance))
    found = many.follow(time, output, 1.7e9)
    assert np.array(rows)[:, :2] == pytest.approx(np.asarray(found)[:, :2], rel=1e-9, abs=1e-12)


def test_a_user_is_warned_of_the_ambiguity():
    one = estimator()
    time, output, _ = simulated(TURN_FIRST)
    messages = []
    for at, value in zip(time, output):
        one.add(at, value, 1.7e9)
        messages.append(one.bias_message)
    assert messages[round(10 * RATE)] == ''
    assert 'several steady rates' in messages[round(38 * RATE)]
    assert messages[-1] == ''
