# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.


"""A slow, steady turn differs from a rest by its rate: unknown biases, and ways that bend."""

from dataclasses import replace
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


#: Ways that bend at rates of their own, with turns between.
BENT = [part for way, bend in zip(
    np.random.default_rng(5).uniform(20.0, 60.0, 12), np.random.default_rng(6).normal(0.0, 0.1, 12)
) for part in ((way, bend), (3, 30))]


def simulated(parts, seed=0, bias=-0.2):
    """Return time, output, and true heading, deg."""
    rate = np.concatenate([np.full(round(duration * RATE), value) for duration, value in parts])
    noise = WALK * math.sqrt(RATE) * np.random.default_rng(seed).standard_normal(len(rate))
    time = np.arange(len(rate)) / RATE
    return time, (rate + bias) * DEGREE + noise, np.append(0.0, np.cumsum(
        0.5 * (rate[1:] + rate[:-1]))) / RATE


def followed(parts, bias=0.5, hindsight=False, seed=0, true_bias=-0.2):
    """Return error and stated deviation of the heading, deg, with a prior of the bias, deg/s."""
    model = read_model({
        'effects': {'bias': {'bias': 0.0}, 'scale_factor_error': {'scale_factor_error': 0.0}},
        'covariance': [[(bias * DEGREE) ** 2, 0.0], [0.0, 0.0]], 'noise': vars(NOISE)})
    time, output, true = simulated(parts, seed, true_bias)
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


@pytest.mark.parametrize('hindsight', [False, True], ids=['live', 'hindsight'])
def test_the_deviation_holds_where_a_vehicle_never_rests_and_each_way_bends(hindsight):
    """A bend within the deviation of the bias passes for a rest; others show that it is none."""
    inside = []
    for seed in range(8):
        generator = np.random.default_rng(seed)
        parts = [part for _ in range(12) for part in (
            (generator.uniform(20.0, 60.0), generator.normal(0.0, 0.1)), (3.0, 30.0))]
        error, deviation = followed(parts, 0.01, hindsight, seed + 100,
                                    generator.normal(0.0, 0.01))
        inside.append(np.mean(np.abs(error) <= 1.96 * deviation))
    assert np.mean(inside) > 0.7, inside  # at most half, without a state of no rests


def test_rests_that_agree_show_that_a_vehicle_rests():
    """After four rests the deviation is that of a vehicle that is known to rest, 0.451 deg."""
    deviations = [followed([*(rests * [(10.0, 0.0), (4.0, 30.0)]), (60.0, 10.0)], 0.01,
                           true_bias=0.01)[1][-1] for rests in (0, 1, 4)]
    assert deviations[0] > deviations[1] > deviations[2] and deviations[2] < 1.05 * 0.451


def estimator(bias):
    model = GyroModel(noise=NOISE)
    return HeadingEstimator(model, BiasTable(model), replace(ASSUMED, bias=bias * DEGREE),
                            TrackerSettings(), 1.7e9)


@pytest.mark.parametrize('bias, parts', [(0.5, TURN_FIRST), (0.01, BENT)])
def test_blocks_have_the_heading_of_single_samples(bias, parts):
    time, output, _ = simulated(parts, bias=-0.4 * bias)
    one, many = estimator(bias), estimator(bias)
    rows = []
    for at, value in zip(time, output):
        one.add(at, value, 1.7e9)
        rows.append((one.tracker.heading, one.tracker.variance, one.tracker.rate_variance))
    found = many.follow(time, output, 1.7e9)
    assert np.array(rows)[:, :2] == pytest.approx(np.asarray(found)[:, :2], rel=1e-9, abs=1e-12)


def test_a_user_is_warned_of_the_ambiguity():
    one = estimator(0.5)
    time, output, _ = simulated(TURN_FIRST)
    messages = []
    for at, value in zip(time, output):
        one.add(at, value, 1.7e9)
        messages.append(one.bias_message)
    assert messages[round(10 * RATE)] == ''
    assert 'several steady rates' in messages[round(38 * RATE)]
    assert messages[-1] == ''
