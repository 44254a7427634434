# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The live health monitor on simulated gyros: its false alarm rate at rest and its detections."""

import math
import re

from chance import fewest, mean_bound, most
from gyro_calibration.heading.bias_table import REST_DURATION
from gyro_calibration.logs.log import DEGREE
from gyro_calibration.model.motion import ROBOT_MOTION
from gyro_calibration.model.noise import Noise, simulate_noise
from gyro_calibration.ros.health_monitor import examine_stretch, HealthMonitor
import numpy as np
import pytest

INTERVAL = 0.02
MEMS = Noise(1e-4, 3e-5, 2e-6)
FOG = Noise(3e-5, 5e-6, 1e-7)
SELDOM = 2e-5  # false alarms an hour: one in 40 000 of these tests, with an hour of rest each


def stretches(noise, hours, generator, scale=1.0):
    """Return outputs at rest in stretches, (n, samples), less the mean of one 600 s before."""
    size, before = round(REST_DURATION / INTERVAL), round(600.0 / INTERVAL)
    count = round(hours * 3600.0 / INTERVAL) // size * size
    whole = simulate_noise(Noise(scale * noise.angle_random_walk, noise.bias_instability,
                                 noise.rate_random_walk), before + count, INTERVAL, generator)
    return (whole[before:] - whole[:size].mean()).reshape(-1, size)


def examined(outputs, noise, false_alarms, step=0.0):
    """Examine each stretch alone, at the level of a health monitor, and return the results."""
    time = np.arange(outputs.shape[1]) * INTERVAL
    level = 0.25 * false_alarms * REST_DURATION / 3600.0
    variance = noise.angle_random_walk ** 2 / REST_DURATION
    return [examine_stretch(time, output, output, noise, level, step, variance,
                            600.0 + REST_DURATION * number)
            for number, output in enumerate(outputs)]


@pytest.mark.parametrize('runs', [30, pytest.param(100, marks=pytest.mark.evidence)])
@pytest.mark.parametrize('noise', [MEMS, FOG, Noise(1e-4)], ids=['MEMS', 'FOG', 'white'])
def test_single_stretches_give_false_alarms_no_more_often_than_stated(noise, runs):
    """State 40 alarms an hour, so that some occur; they correlate within a run, not beyond it."""
    stated, minutes, generator = 40.0, 6.0, np.random.default_rng(11)
    records = [stretches(noise, minutes / 60.0, generator) for _ in range(runs)]
    for step in (0.0, 1e-4, 3e-3):  # of the output
        coarse = [(np.round(each / step + 0.3) - 0.3) * step if step else each for each in records]
        rests = [examined(outputs, noise, stated, step) for outputs in coarse]
        alarms = [sum(not rest.is_noise_normal or not rest.is_bias_normal
                      for rest in run if rest is not None) for run in rests]
        assert np.mean(alarms) <= stated * minutes / 60.0 + mean_bound(alarms), step
        found = [rest is not None for run in rests for rest in run]
        assert np.mean(found) > 0.98, (step, 'rest is not taken for motion')


def test_the_level_of_the_bias_is_used_up_and_not_only_kept():
    """White noise, and a bias drawn with the stated deviation, which gets half of the alarms."""
    stated, generator, size = 40.0, np.random.default_rng(12), round(REST_DURATION / INTERVAL)
    level, time, deviation = (0.25 * stated * REST_DURATION / 3600.0,
                              np.arange(size) * INTERVAL, 1e-4)
    outputs = (generator.normal(0.0, 1e-4 / math.sqrt(INTERVAL), (4000, size))
               + generator.normal(0.0, deviation, (4000, 1)))
    misfits = sum(not examine_stretch(time, output, output, Noise(1e-4), level, 0.0,
                                      deviation ** 2).is_bias_normal for output in outputs)
    assert fewest(4000, 2.0 * level) <= misfits <= most(4000, 2.0 * level)


def fed(check, outputs, promised=False, begin=0.0, bias_variance=1e-12):
    for number, output in enumerate(np.ravel(outputs).tolist()):
        if check.add(begin + number * INTERVAL, output, output):
            check.examine_stretch(bias_variance, 600.0, promised)
    return check


@pytest.mark.parametrize('noise', [MEMS, FOG], ids=['MEMS', 'FOG'])
def test_three_times_the_noise_is_found_in_one_promised_rest_or_three_others(noise):
    outputs = stretches(noise, 0.1, np.random.default_rng(14), 3.0)
    alarm = fed(HealthMonitor(noise, 0.001), outputs[:2], promised=True).noise_alarm
    assert float(re.search(r'the noise at rest is ([\d.]+)', alarm)[1]) == pytest.approx(
        3.0, rel=0.2)
    assert not fed(HealthMonitor(noise, 0.001), outputs[:2]).noise_alarm
    assert 'unless the robot vibrates' in fed(HealthMonitor(noise, 0.001), outputs[:5]).noise_alarm


def test_motion_is_not_taken_for_a_misfit():
    """The robot stands half of the time and turns half of it, with a wobble of 1 % of its rate."""
    time = np.arange(0.0, ROBOT_MOTION.duration, INTERVAL)
    check, generator = HealthMonitor(MEMS, SELDOM, 0.3 * DEGREE), np.random.default_rng(18)
    for drive in range(20):
        wobble = (np.convolve(generator.normal(0.0, 0.01, len(time)), np.ones(25) / 5.0, 'same')
                  * ROBOT_MOTION.rate_at(time))
        fed(check, ROBOT_MOTION.rate_at(time) + wobble
            + generator.normal(0.0, 1e-4 / math.sqrt(INTERVAL), len(time)), begin=200.0 * drive)
        assert not check.noise_alarm and not check.bias_alarm, drive


def test_a_gap_begins_a_stretch_anew_and_a_gyro_that_never_changes_is_not_examined():
    check = HealthMonitor(MEMS, 0.001)
    assert not any(check.add(number * 0.02 + (0.0 if number < 300 else 1.0), 0.0, 0.0)
                   for number in range(600))
    fed(check, np.zeros(2000), begin=100.0)
    assert not check.examined_count and not check.noise_alarm
    assert check.is_enabled
    assert not HealthMonitor(Noise(), 0.001).is_enabled, 'without noise figures'
    assert not HealthMonitor(MEMS, 0.0).is_enabled


def test_a_dead_gyro_is_reported_once_its_quantization_is_known():
    outputs = stretches(MEMS, 0.1, np.random.default_rng(19))
    check = fed(HealthMonitor(MEMS, 0.001, 0.3 * DEGREE), outputs[:2])
    fed(check, np.zeros(2500), begin=100.0)
    assert 'check that the gyro responds to turns' in check.noise_alarm
