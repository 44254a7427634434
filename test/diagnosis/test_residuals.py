# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The residual along each variable: bands of 95 % hold 95 % of it, whatever the noise."""

from gyro_calibration.diagnosis.regression import build_problem, fit_causes
from gyro_calibration.diagnosis.replay import replay
from gyro_calibration.diagnosis.residuals import BandEnergies, drop_tone_bands, residual_curves
from gyro_calibration.logs.log import Log
from gyro_calibration.model.noise import Noise, simulate_noise
import numpy as np
import pytest

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
    bands = BandEnergies(energy, count, parts, np.zeros(60))
    used = drop_tone_bands(bands)
    assert len(used.energy) == (60 if tone == 1.0 else 59)
    assert np.exp(0.5 * used.fit()[0][0]) == pytest.approx(2.0, rel=0.03)
    assert tone == 1.0 or np.exp(0.5 * bands.fit()[0][0]) > 2.2
