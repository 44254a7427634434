# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Heading from rates: trapezoid rule, threshold filter, and a variance that Monte Carlo checks."""

import math

from gyro_calibration.heading.integration import (
    BlockIntegrator, filter_rates, integrate, Threshold, ThresholdFilter)
from gyro_calibration.heading.tracker import HeadingTracker, TrackerSettings
from gyro_calibration.logs.log import DEGREE
from gyro_calibration.model.compensation import (
    compensate, rate_sensitivity, uncertainty_covariance)
from gyro_calibration.model.gyro_model import GyroModel, SelfCalibration
from gyro_calibration.model.motion import ROBOT_MOTION
from gyro_calibration.model.noise import Noise, simulate_noise
import numpy as np
import pytest

INTERVAL = 0.01
XV3500 = Noise(2.5 * DEGREE / 60)


def noisy_robot():
    """Return times and rates of the robot with the XV3500's white noise."""
    time = np.arange(16001) * INTERVAL
    noise = simulate_noise(XV3500, len(time), INTERVAL, np.random.default_rng(0))
    return time, ROBOT_MOTION.rate_at(time) + noise


def filtered_singly(settings, time, rate):
    """Return what the filter makes of samples that come one by one."""
    threshold = ThresholdFilter(settings)
    return np.array([threshold.apply(*sample) for sample in zip(time.tolist(), rate.tolist())])


SETTINGS = {'published': Threshold(window=0.0), 'mean': Threshold(),
            'rest test': Threshold(angle_random_walk=XV3500.angle_random_walk),
            'long': Threshold(1.0 * DEGREE, 1.0), 'off': Threshold(0.0)}


@pytest.mark.parametrize('settings', SETTINGS.values(), ids=SETTINGS)
def test_a_log_in_blocks_or_samples_is_filtered_and_integrated_as_in_one_piece(settings):
    model = GyroModel(noise=XV3500, self_calibration=SelfCalibration(S, B, UNCERTAIN))
    time, rate = noisy_robot()
    sensitivity = rate_sensitivity(model, rate, rate, 25.0)
    whole = BlockIntegrator(settings, XV3500,
                            uncertainty_covariance(model)).add(time, rate, sensitivity)
    cuts = np.sort(np.random.default_rng(0).choice(len(time), 40))
    cuts = [0, 0, 1, 2, *cuts.tolist(), 9000, 9001, 9001, len(time)]
    integrator = BlockIntegrator(settings, XV3500, uncertainty_covariance(model))
    pieces = [integrator.add(time[i:j], rate[i:j], sensitivity[:, i:j])
              for i, j in zip(sorted(cuts), sorted(cuts)[1:])]
    filtered, heading, deviation = (np.concatenate(parts) for parts in zip(*pieces))
    for other in (whole[0], filter_rates(settings, time, rate),
                  filtered_singly(settings, time, rate)):
        assert np.array_equal(filtered, other)
    assert np.array_equal(heading, whole[1]) and np.array_equal(heading, integrate(time, filtered))
    assert deviation == pytest.approx(whole[2], rel=1e-12)


S, B = 0.02, 0.002
UNCERTAIN = ((1e-4, -2e-6), (-2e-6, 1e-6))


def test_the_variance_is_that_of_many_runs_with_known_truth():
    """60 s of driving with white noise, and s and b drawn from their covariance."""
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


@pytest.mark.parametrize('settings', [Threshold(), Threshold(0.0)], ids=['threshold', 'pure'])
@pytest.mark.parametrize('offset', [0.0, 1.7e9], ids=['from zero', 'stamps since 1970'])
def test_a_tracker_that_looks_for_no_rests_does_as_the_blocks(settings, offset):
    model = GyroModel(noise=XV3500, self_calibration=SelfCalibration(S, B, UNCERTAIN))
    time, rate = (np.delete(values[:3000], np.r_[900:905, 1300, 2000:2020])
                  for values in noisy_robot())
    sensitivity = rate_sensitivity(model, rate, rate, np.full(len(time), 25.0))
    tracker = HeadingTracker(XV3500, uncertainty_covariance(model),
                             TrackerSettings(false_alarms=0.0, threshold=settings))
    headings, variances = [], []
    for index in range(len(time)):
        assert not tracker.add(float(time[index]) + offset, float(rate[index]),
                               sensitivity[:, index])
        headings.append(tracker.heading)
        variances.append(tracker.variance)
    integrator = BlockIntegrator(settings, XV3500, uncertainty_covariance(model))
    _, heading, deviation = integrator.add(time, rate, sensitivity)
    assert integrator.intervals.lost_samples == tracker.intervals.lost_samples == 26
    # Stamps near 1e9 s have steps of 0.1 us.
    assert headings == pytest.approx(heading, abs=1e-9 if not offset else 1e-5)
    # the tracker counts the calibration's part once a second
    around_the_gap = slice(1980, 2000)
    assert deviation[around_the_gap] ** 2 == pytest.approx(variances[around_the_gap], rel=1e-2)
    tracker.finish()
    assert math.sqrt(tracker.variance) == pytest.approx(deviation[-1], rel=1e-3)
    deleted = integrate(time, rate)[-1] - heading[-1]
    assert tracker.deleted_heading == pytest.approx(deleted, abs=1e-5)
