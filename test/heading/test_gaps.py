# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""
Lost samples: how many, what they leave unknown of the heading, and rests across them.

The stated variance of the heading is compared with the difference to the heading with all
samples, over many drives.
"""

import math

from gyro_calibration.heading.integration import gap_variances, integrate, Intervals
from gyro_calibration.heading.tracker import HeadingTracker, TrackerSettings
from gyro_calibration.logs.log import Log
from gyro_calibration.model.gyro_model import GyroModel, SelfCalibration
from gyro_calibration.model.noise import Noise, simulate_noise
from gyro_calibration.model.presets import XV3500
from heading_track import track
import numpy as np
import pytest

WHITE = Noise(XV3500.noise.angle_random_walk)
INTERVAL = 0.01


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


def lost_heading(true, comes, generator):
    """Return the heading change by lost samples, rad, and the variance stated for it, rad²."""
    time = np.arange(len(true)) * INTERVAL
    rate = true + simulate_noise(WHITE, len(true), INTERVAL, generator)
    intervals = np.diff(time[comes])
    usual, lost = Intervals().add_many(intervals)
    assert lost.sum() == (~comes).sum()
    gaps = lost > 0
    of_gaps = gap_variances(WHITE, usual[gaps], lost[gaps], intervals[gaps],
                            np.diff(rate[comes])[gaps])
    return integrate(time[comes], rate[comes])[-1] - integrate(time, rate)[-1], np.sum(of_gaps)


# how many

@pytest.mark.parametrize('jitter', [0.0, 0.1])
@pytest.mark.parametrize('interval', [0.001, 0.01, 0.1])
def test_lost_samples_are_counted_where_stamps_are_even_or_jitter(interval, jitter):
    generator = np.random.default_rng(1)
    comes = kept(3000, 0.1, 5, generator)
    stamps = interval * (np.arange(3000) + jitter * generator.uniform(-1.0, 1.0, 3000))[comes]
    intervals = Intervals()
    for step in np.diff(stamps).tolist():
        intervals.add(step)
    assert (intervals.lost_samples == (~comes).sum()
            and intervals.usual_interval == pytest.approx(interval, rel=0.05 + jitter))
    assert intervals.longest_gap == pytest.approx(np.diff(stamps).max())


# what they leave unknown


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
    squares, pairs = [], []
    for seed in range(24):
        generator = np.random.default_rng(seed)
        true, comes = driven(60.0, generator), kept(6000, share, longest, generator)
        off, variance = lost_heading(true, comes, generator)
        squares.append(off * off / variance)
        pairs.append((off * off, variance))
    actual, stated = np.sqrt(np.mean(pairs, axis=0))
    assert np.mean(squares) < 1.0 + 4.0 * math.sqrt(2.0 / 24) and stated < 3.0 * actual


@pytest.mark.parametrize('frequency', [2.0, 5.0, 9.3])
@pytest.mark.parametrize('many', [False, True])
def test_a_vibration_in_a_gap_is_in_the_stated_variance(frequency, many):
    """Its ends may show the same rate."""
    squares = []
    for seed in range(20):
        generator, time = np.random.default_rng(seed), np.arange(0.0, 4.0, INTERVAL)
        true = 0.2 * np.sin(2.0 * math.pi * (frequency * time + generator.random()))
        rate, comes = true + simulate_noise(WHITE, len(time), INTERVAL, generator), time > -1.0
        for begin in generator.integers(250, 380, 2):
            comes[begin:begin + 19] = False
        tracker = HeadingTracker(WHITE, KNOWN, TrackerSettings())
        inputs = sensitivity_of(rate[comes]).T
        if many:
            tracker.follow(time[comes], rate[comes], inputs)
        else:
            for sample in zip(time[comes], rate[comes], inputs):
                tracker.add(*sample)
        off = tracker.heading - integrate(time, true)[-1]
        squares.append(off * off / tracker.variance)
    assert np.mean(squares) < 1.0 + 4.0 * math.sqrt(2.0 / 20)


# the heading

def sensitivity_of(rate):
    return -np.vstack([rate, np.ones(len(rate))])


KNOWN = np.diag([1e-10, 1e-10])


def test_a_rest_goes_on_over_gaps_and_what_begins_in_one_is_followed():
    generator, time = np.random.default_rng(3), np.arange(0.0, 60.0, INTERVAL)
    true = np.where(time > 50.3, 0.5, 0.0)
    rate = true + simulate_noise(WHITE, len(time), INTERVAL, generator)
    comes = np.ones(len(time), bool)
    for begin, gap in ((10.0, 0.2), (20.0, 0.45), (30.0, 0.6), (40.0, 0.9), (50.0, 0.8)):
        comes[(time > begin) & (time < begin + gap)] = False
    found = track(time[comes], rate[comes], sensitivity_of(rate[comes]), WHITE, KNOWN,
                  TrackerSettings())
    resting = found.resting[(time[comes] > 2.0) & (time[comes] < 50.0)]
    assert resting.all() and not found.resting[time[comes] > 51.0].any()
    assert abs(found.heading[-1] - 0.5 * 9.7) < 3.0 * math.sqrt(found.variance[-1]) < 0.5
    assert (found.intervals.lost_samples == (~comes).sum()
            and found.intervals.longest_gap == pytest.approx(0.9, abs=0.02))


@pytest.mark.parametrize('option', [(), ('--rest',)])
def test_compensating_a_log_says_what_is_lost_and_allows_for_it(option, compensate):
    model = GyroModel(noise=WHITE,
                      self_calibration=SelfCalibration(0.0, 0.0, ((1e-10, 0.0), (0.0, 1e-10))))
    deviations = []
    for lost in (False, True):
        generator = np.random.default_rng(6)
        true = driven(30.0, generator)
        comes = kept(len(true), 0.05, 20, generator) if lost else np.ones(len(true), bool)
        output = (true + simulate_noise(WHITE, len(true), INTERVAL, generator))[comes]
        text = compensate(Log(time=(np.arange(len(true)) * INTERVAL)[comes], output=output),
                          model, *option).text
        assert (f'{(~comes).sum()} samples are lost' in text) == lost
        deviations.append(float(text.partition('+-')[2].split()[0]))
    assert deviations[1] > 1.2 * deviations[0]
