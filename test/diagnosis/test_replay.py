# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""A log is laid out for the search whatever its reference lost; and what is left of it."""

import math

from chance import seeds
from diagnosed import estimates
from gyro_calibration.diagnosis.log_diagnosis import diagnose
from gyro_calibration.diagnosis.regression import build_problem, fit_causes
from gyro_calibration.diagnosis.replay import replay
from gyro_calibration.diagnosis.residuals import BandEnergies, drop_tone_bands, residual_curves
from gyro_calibration.logs.log import DEGREE, Log, select_rows
from gyro_calibration.model.noise import Noise, simulate_noise
import numpy as np
import pytest
from scipy.signal import lfilter


@pytest.mark.parametrize('frequency', [20.0, 100.0])
@pytest.mark.parametrize('seed', seeds(3))
def test_the_ends_of_a_fine_encoder_are_no_slips_or_steps(frequency, seed):
    generator = np.random.default_rng(400 + seed)
    time = np.arange(int(120.0 * frequency)) / frequency
    turns = list(zip(2.0 * np.pi * np.array([0.02, 0.05, 0.09, 0.15]), generator.uniform(0, 6, 4)))
    rate = sum(0.4 * np.sin(pace * time + phase) for pace, phase in turns)
    heading = -sum(0.4 / pace * np.cos(pace * time + phase) for pace, phase in turns)
    step = 0.005 * DEGREE
    noise = simulate_noise(Noise(angle_random_walk=3e-5), len(time), 1.0 / frequency, generator)
    log = Log(time=time, output=1.01 * rate + noise,
              reference_heading=step * np.round(heading / step))
    found = diagnose([log], np.random.default_rng(0))
    assert {cause.effect for cause in found.findings} == {'reference_quantization'}


@pytest.mark.parametrize('dead_zone', [0.0, 0.5])
@pytest.mark.parametrize('noise, step', [(0.0005, 0.0), (0.005, 0.0), (0.003, 0.001)])
def test_the_noise_of_a_heading_is_no_dead_zone_and_hides_none(dead_zone, noise, step):
    """The rests of a motion have noise of a rounded heading, deg; the zone is in deg/s."""
    generator = np.random.default_rng(77)
    time = np.arange(12_000) * 0.05
    turns = np.repeat(generator.uniform(-0.8, 0.8, 60) * (np.arange(60) % 2), 200)
    shape = np.hanning(61) / np.hanning(61).sum()
    rate = np.convolve(turns, shape, 'same')
    heading = np.cumsum(rate) * 0.05 - 0.025 * (rate + rate[0])
    output = (np.where(np.abs(rate) < dead_zone * DEGREE, 0.0, 1.005 * rate)
              + 0.07 * DEGREE * generator.standard_normal(len(time)))
    heading += noise * DEGREE * generator.standard_normal(len(time))
    if step:
        heading = step * DEGREE * np.round(heading / DEGREE / step)
    log = Log(time=time, output=output, reference_heading=heading)
    found = diagnose([log], np.random.default_rng(0)).findings
    assert [each.effect for each in found] == ['dead_zone'] * (dead_zone > 0.0)
    for each in found:
        assert each.parameters['dead_zone'].estimate == pytest.approx(dead_zone * DEGREE, rel=0.1)


@pytest.mark.parametrize('seed', seeds(3))
def test_one_sample_after_a_gap_is_no_step_of_the_bias(seed):
    log = record(Noise(angle_random_walk=3e-4), np.random.default_rng(seed), 260.0, 0.05)
    log.output[-1] += 3e-3  # 2 sigma
    log = select_rows(log, np.delete(np.arange(5200), slice(4799, -1)))
    found = diagnose([log], np.random.default_rng(0))
    assert [each.effect for each in found.findings] == ['dropped_samples']


@pytest.mark.parametrize('seed', seeds(2))
def test_single_lost_samples_neither_cost_nor_bias_a_scale_in_a_random_walk(seed):
    generator = np.random.default_rng(300 + seed)
    time = np.arange(12_000) / 40.0
    rate = (0.6 * np.sin(0.3 * time) + 0.3 * np.sin(1.1 * time)
            + 0.2 * np.sin(0.07 * time ** 1.2))
    noise = simulate_noise(Noise(angle_random_walk=1.5e-3, rate_random_walk=8e-3),
                           len(time), 0.025, generator)
    log = Log(time=time, output=1.003 * rate + noise, reference_rate=rate)
    kept = generator.random(len(time)) > 0.15
    values = []
    for each in (log, Log(time=time[kept], output=log.output[kept], reference_rate=rate[kept])):
        found = diagnose([each], np.random.default_rng(0))
        assert {cause.effect for cause in found.findings} <= {'dropped_samples'}
        assert not found.reference.noise
        values.append(estimates(found)['scale_factor_error'])
    (_, whole), (scale, deviation) = values
    assert deviation < 1.15 * whole and abs(scale - 0.003) < 4.0 * deviation


@pytest.mark.parametrize('step, noise', [(1.0, 0.2), (0.5, 0.1)])
def test_coarse_codes_in_slow_turns_are_quantization_alone(step, noise):
    time = np.arange(6000) / 50.0
    rate = 3.0 * np.sin(2.0 * np.pi * time / 47.0)
    output = 1.01 * rate + 0.3 + noise * np.random.default_rng(0).standard_normal(len(time))
    found = diagnose([Log(time=time, output=np.round(output / step) * step * DEGREE,
                          reference_rate=rate * DEGREE)], np.random.default_rng(0))
    assert [each.effect for each in found.findings] == ['quantization']
    assert not found.unexplained


# The residual along each variable: bands of 95 % hold 95 % of it, whatever the noise

WHITE = 1e-4
NOISES = {'white': Noise(WHITE), 'flicker': Noise(WHITE, bias_instability=1e-4),
          'walk': Noise(WHITE, rate_random_walk=2e-5)}


def record(noise, generator, duration, interval):
    """Return a log of noise in motion, with rising temperature and a shaking specific force."""
    time = np.arange(round(duration / interval)) * interval
    rate = np.sin(0.3 * time) + 0.4 * np.sin(0.071 * time + 1.0)
    return Log(time=time, output=rate + simulate_noise(noise, len(time), interval, generator),
               reference_rate=rate, temperature=20.0 + time / 60.0 + np.sin(0.05 * time),
               specific_force=0.1 * generator.standard_normal(len(time)))


def inside(log, generator):
    """Return which bins of all curves but the spectrum are within their bands, and how many."""
    laid = replay(log, np.ones(len(log.time), dtype=bool), generator)
    found = fit_causes(build_problem([laid]), [])
    shown = [each for each in residual_curves(found.unbiased_residuals, found)
             if each.along != 'frequency']
    off = np.concatenate([np.abs(each.after) / each.deviation for each in shown])
    assert ({'time', 'rate', 'heading', 'temperature',
             'specific_force'} <= {each.along for each in shown})
    return np.count_nonzero(off < 1.96), len(off)


@pytest.mark.parametrize('noise, interval, runs', [
    ('white', 0.05, 8), ('flicker', 0.05, 8), ('walk', 0.05, 8),
    ('flicker', 0.002, 2)])  # samples that are averaged before the search
def test_bands_of_95_percent_hold_about_as_many_bins(noise, interval, runs):
    generator = np.random.default_rng(1)
    held, count = np.sum([inside(record(NOISES[noise], generator, 600.0, interval), generator)
                          for _ in range(runs)], axis=0)
    assert 0.9 < held / count < 0.99, held / count


@pytest.mark.parametrize('tone', [1.0, 4.0])
def test_a_vibration_is_not_in_the_angle_random_walk(tone):
    generator = np.random.default_rng(3)
    frequency = np.geomspace(0.01, 25.0, 60)
    count = np.maximum(np.round(100.0 * frequency), 1.0)
    parts = np.column_stack([np.ones(60), 1.0 / frequency, 1.0 / frequency ** 2])
    energy = 4.0 * generator.chisquare(count)
    energy[56] *= tone
    bands = BandEnergies(energy, count, parts, np.zeros(60), np.empty((60, 0)))
    used = drop_tone_bands(bands)
    assert len(used.energy) == (60 if tone == 1.0 else 59)
    assert np.exp(0.5 * used.fit()[0][0]) == pytest.approx(2.0, rel=0.03)
    assert tone == 1.0 or np.exp(0.5 * bands.fit()[0][0]) > 2.2


def test_corners_of_a_motion_that_jitters_are_no_cause():
    """A rate begins with a corner; in turns it jitters from sample to sample."""
    generator, interval, fine = np.random.default_rng(2), 0.05, 8
    step, count = interval / fine, 6000 * fine
    turns = np.repeat(generator.uniform(-1.0, 1.0, 60), count // 60) * np.tile(
        np.repeat([0.0, 1.0], count // 60), 30)
    rate = lfilter([step / 0.3], [1.0, step / 0.3 - 1.0], turns)
    jitter = lfilter([math.sqrt(2.0 * step / 0.5)], [1.0, step / 0.5 - 1.0],
                     0.012 * generator.standard_normal(count))
    rate = rate + jitter * (np.abs(rate) > 0.02)
    heading = np.append(0.0, np.cumsum(0.5 * (rate[1:] + rate[:-1]) * step))[::fine]
    log = Log(time=interval * np.arange(6000), reference_heading=heading,
              output=rate[::fine] + 1e-3 * generator.standard_normal(6000))
    assert not diagnose([log], generator).findings


@pytest.mark.parametrize('seed', [0, 3, *seeds(8)[1:]])
def test_a_coarse_output_at_few_rates_leaves_open_what_its_rounding_may_do(seed):
    generator = np.random.default_rng(seed)
    time, scale, bias = np.arange(10_000) / 50.0, 0.01, generator.normal(0.0, 0.01)
    corners = np.cumsum(generator.uniform(0.5, 4.0, 160))
    rate = np.interp(time, corners, np.repeat(generator.choice([-0.8, 0.0, 0.8], 80), 2))
    output = (1.0 + scale) * rate + bias + 2e-3 * generator.standard_normal(len(time))
    found = diagnose([Log(time=time, output=0.04 * np.round(output / 0.04),
                          reference_rate=rate)], np.random.default_rng(1))
    # each was off by up to 2000 deviations, and the scale factor error by 1 %
    for name, true, largest in (('bias', bias, 1e-3), ('scale_factor_error', scale, 1e-3)):
        value, deviation = estimates(found)[name]
        assert abs(value - true) < 6.0 * deviation < 6.0 * largest, (name, value, deviation)


@pytest.mark.parametrize('late', [-0.1, 0.5])
def test_a_heading_of_another_clock_is_late_and_nothing_else(late):
    """At the ends, the motion of the gyro is not known; and no smoothing passes for a lag."""
    generator, time = np.random.default_rng(1), np.arange(6000) / 50.0
    paces, phases = generator.uniform(0.06, 1.9, 6), generator.uniform(0.0, 6.3, 6)
    rate = 20.0 * DEGREE * np.sin(np.outer(time, paces) + phases).sum(axis=1)
    heading = -20.0 * DEGREE * (np.cos(np.outer(time - late, paces) + phases) / paces).sum(axis=1)
    output = 1.005 * rate + (0.2 + 0.1 * generator.standard_normal(len(time))) * DEGREE
    found = diagnose([Log(time=time, output=output, reference_heading=heading)], generator)
    assert [each.effect for each in found.findings] == ['time_offset']
    assert found.findings[0].parameters['time_offset'].estimate == pytest.approx(-late, abs=1e-3)
