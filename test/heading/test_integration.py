# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Heading from rates: trapezoids, threshold filter, lost samples, and variances by Monte Carlo."""

import math

from gyro_calibration.heading.integration import (
    BlockIntegrator, gap_variances, integrate, Intervals, Threshold,
    ThresholdFilter)
from gyro_calibration.heading.tracker import HeadingTracker, TrackerSettings
from gyro_calibration.logs.log import DEGREE, Log
from gyro_calibration.model.compensation import (
    compensate, rate_sensitivity, uncertainty_covariance)
from gyro_calibration.model.gyro_model import GyroModel, SelfCalibration
from gyro_calibration.model.motion import ROBOT_MOTION
from gyro_calibration.model.noise import Noise, simulate_noise
from heading_track import track
import numpy as np
import pytest

INTERVAL = 0.01
XV3500 = Noise(2.5 * DEGREE / 60)


SETTINGS = {'published': Threshold(window=0.0), 'mean': Threshold(),
            'rest test': Threshold(angle_random_walk=XV3500.angle_random_walk),
            'long': Threshold(1.0 * DEGREE, 1.0), 'off': Threshold(0.0)}


@pytest.mark.parametrize('settings', SETTINGS.values(), ids=SETTINGS)
def test_a_log_in_blocks_or_samples_is_filtered_and_integrated_as_in_one_piece(settings):
    model = GyroModel(noise=XV3500, self_calibration=SelfCalibration(S, B, UNCERTAIN))
    time = np.arange(16001) * INTERVAL
    rate = ROBOT_MOTION.rate_at(time) + simulate_noise(XV3500, len(time), INTERVAL,
                                                       np.random.default_rng(0))
    sensitivity = rate_sensitivity(model, rate, rate, 25.0)
    whole = BlockIntegrator(settings, XV3500,
                            uncertainty_covariance(model)).add(time, rate, sensitivity)
    cuts = np.sort(np.random.default_rng(0).choice(len(time), 40))
    cuts = [0, 0, 1, 2, *cuts.tolist(), 9000, 9001, 9001, len(time)]
    integrator = BlockIntegrator(settings, XV3500, uncertainty_covariance(model))
    pieces = [integrator.add(time[i:j], rate[i:j], sensitivity[:, i:j])
              for i, j in zip(sorted(cuts), sorted(cuts)[1:])]
    filtered, heading, deviation = (np.concatenate(parts) for parts in zip(*pieces))
    threshold = ThresholdFilter(settings)
    singly = [threshold.apply(*sample) for sample in zip(time.tolist(), rate.tolist())]
    for other in whole[0], ThresholdFilter(settings).apply_to_all(time, rate), singly:
        assert np.array_equal(filtered, other)
    assert np.array_equal(heading, whole[1]) and np.array_equal(heading, integrate(time, filtered))
    assert deviation == pytest.approx(whole[2], rel=1e-12)


S, B = 0.02, 0.002
UNCERTAIN = ((1e-4, -2e-6), (-2e-6, 1e-6))


def test_the_variance_is_that_of_many_runs_with_known_truth():
    model = GyroModel(noise=XV3500, self_calibration=SelfCalibration(S, B, UNCERTAIN))
    time, generator, ends = np.arange(6001) * INTERVAL, np.random.default_rng(0), []
    true = ROBOT_MOTION.rate_at(time)
    for _ in range(400):
        s, b = np.array([S, B]) + generator.multivariate_normal([0.0, 0.0], UNCERTAIN)
        output = (1 + s) * true + b + simulate_noise(XV3500, len(time), INTERVAL, generator)
        ends.append(integrate(time, compensate(model, output).rate)[[1500, 6000]]
                    - ROBOT_MOTION.heading_at(time)[[1500, 6000]])
    sensitivity = rate_sensitivity(model, true, true, np.full(len(time), 25.0))
    deviation = BlockIntegrator(Threshold(0.0), XV3500, uncertainty_covariance(model)).add(
        time, true, sensitivity)[2]
    ratios = np.mean(np.square(ends), axis=0) / deviation[[1500, 6000]] ** 2
    # To first order in s, 2 % here.
    assert ratios == pytest.approx(1.0, abs=4.0 * math.sqrt(2.0 / 400) + 0.05)


# Lost samples: how many, what they leave unknown of the heading, and rests across them. The stated
# variance is compared with the difference to the heading with all samples, over many drives.

def kept(count, share, longest, generator):
    """Return which samples come: a share is lost, in runs of 1 to `longest`, none at the ends."""
    begins = np.flatnonzero(generator.random(count) < 2.0 * share / (1 + longest))
    comes = np.ones(count, bool)
    for begin, length in zip(begins, generator.integers(1, longest + 1, len(begins))):
        comes[begin:begin + length] = False
    comes[:300] = comes[-1] = True
    return comes


def driven(duration, generator):
    """Return rates of stretches of 0.5 to 5 s, half of them at rest, with flanks of 0.3 s."""
    rates = np.zeros(0)
    while len(rates) < duration / INTERVAL:
        stretch = round(generator.uniform(0.5, 5.0) / INTERVAL)
        rates = np.append(
            rates, np.full(stretch, generator.choice([0.0, 1.0]) * generator.uniform(-1.0, 1.0)))
    return np.convolve(rates, np.ones(30) / 30.0, 'same')[:round(duration / INTERVAL)]


def test_samples_that_come_late_or_in_bursts_are_not_lost():
    late = np.arange(0.0, 10.0, 0.01)
    late[500:510] = late[509] - np.arange(9, -1, -1) * 2e-4
    bursts = (np.ceil(np.arange(0.0, 10.0, 0.001) / 0.016 + 1e-9) * 0.016
              + np.arange(10000) % 16 * 1e-5)
    for stamps in (late, bursts):
        intervals = Intervals()
        for step in np.diff(stamps).tolist():
            intervals.add(step)
        assert intervals.lost_samples == 0


@pytest.mark.parametrize('share, longest', [(0.01, 1), (0.1, 1), (0.1, 20), (0.03, 85)])
def test_turns_in_gaps_are_in_the_stated_variance_and_not_much_more(share, longest):
    squares, variances, time = [], [], np.arange(6000) * INTERVAL
    for seed in range(24):
        generator = np.random.default_rng(seed)
        true, comes = driven(60.0, generator), kept(6000, share, longest, generator)
        rate = true + simulate_noise(XV3500, 6000, INTERVAL, generator)
        intervals = np.diff(time[comes])
        usual, lost = Intervals().add_many(intervals)
        assert lost.sum() == (~comes).sum()
        gaps = lost > 0
        variances.append(np.sum(gap_variances(XV3500, usual[gaps], lost[gaps], intervals[gaps],
                                              np.diff(rate[comes])[gaps])))
        squares.append((integrate(time[comes], rate[comes])[-1] - integrate(time, rate)[-1]) ** 2)
    assert np.mean(np.divide(squares, variances)) < 1.0 + 4.0 * math.sqrt(2.0 / 24)
    assert np.mean(variances) < 9.0 * np.mean(squares)


@pytest.mark.parametrize('frequency', [2.0, 5.0, 9.3])
def test_a_vibration_in_a_gap_is_in_the_stated_variance(frequency):
    """Its ends may show the same rate."""
    squares = []
    for seed in range(20):
        generator, time = np.random.default_rng(seed), np.arange(0.0, 4.0, INTERVAL)
        true = 0.2 * np.sin(2.0 * math.pi * (frequency * time + generator.random()))
        rate, comes = true + simulate_noise(XV3500, len(time), INTERVAL, generator), time > -1.0
        for begin in generator.integers(250, 380, 2):
            comes[begin:begin + 19] = False
        tracker = HeadingTracker(XV3500, KNOWN, TrackerSettings())
        tracker.follow(time[comes], rate[comes], sensitivity_of(rate[comes]).T)
        off = tracker.heading - integrate(time, true)[-1]
        squares.append(off * off / tracker.variance)
    assert np.mean(squares) < 1.0 + 4.0 * math.sqrt(2.0 / 20)


def sensitivity_of(rate):
    return -np.vstack([rate, np.ones(len(rate))])


KNOWN = np.diag([1e-10, 1e-10])


def test_a_rest_goes_on_over_gaps_and_what_begins_in_one_is_followed():
    generator, time = np.random.default_rng(3), np.arange(0.0, 60.0, INTERVAL)
    true = np.where(time > 50.3, 0.5, 0.0)
    rate = true + simulate_noise(XV3500, len(time), INTERVAL, generator)
    comes = np.ones(len(time), bool)
    for begin, gap in ((10.0, 0.2), (20.0, 0.45), (30.0, 0.6), (40.0, 0.9), (50.0, 0.8)):
        comes[(time > begin) & (time < begin + gap)] = False
    found = track(time[comes], rate[comes], sensitivity_of(rate[comes]), XV3500, KNOWN,
                  TrackerSettings())
    resting = found.resting[(time[comes] > 2.0) & (time[comes] < 50.0)]
    assert resting.all() and not found.resting[time[comes] > 51.0].any()
    assert abs(found.heading[-1] - 0.5 * 9.7) < 3.0 * math.sqrt(found.variance[-1]) < 0.5
    assert (found.intervals.lost_samples == (~comes).sum()
            and found.intervals.longest_gap == pytest.approx(0.9, abs=0.02))


@pytest.mark.parametrize('option', [(), ('--rest',)])
def test_compensating_a_log_says_what_is_lost_and_allows_for_it(option, compensate):
    model = GyroModel(noise=XV3500,
                      self_calibration=SelfCalibration(0.0, 0.0, ((1e-10, 0.0), (0.0, 1e-10))))
    deviations = []
    for lost in (False, True):
        generator = np.random.default_rng(6)
        true = driven(30.0, generator)
        comes = kept(len(true), 0.05, 20, generator) if lost else np.ones(len(true), bool)
        output = (true + simulate_noise(XV3500, len(true), INTERVAL, generator))[comes]
        text = compensate(Log(time=(np.arange(len(true)) * INTERVAL)[comes], output=output),
                          model, *option).text
        assert (f'{(~comes).sum()} samples are lost' in text) == lost
        deviations.append(float(text.partition('+-')[2].split()[0]))
    assert deviations[1] > 1.2 * deviations[0]
