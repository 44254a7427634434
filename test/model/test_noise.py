# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Simulated noise has the Allan deviation of IEEE Std 952: N/sqrt(tau), 0.664 B, K sqrt(tau/3)."""

import math
from pathlib import Path

from chance import mean_bound
from gyro_calibration.model.model_file import read_model
from gyro_calibration.model.noise import ALLAN_FLOOR_RATIO, Noise, simulate_noise
from gyro_calibration.model.presets import XV3500
import numpy as np
import pytest

INTERVAL = 0.01


def allan_variance(rate, size):
    """Return Allan variance (IEEE Std 952, C.1) of `size` samples, and how many differences."""
    means = rate[:len(rate) // size * size].reshape(-1, size).mean(axis=1)
    return np.mean(np.diff(means) ** 2) / 2.0, len(means) - 1


#: Noise, samples of the means, and the Allan variance of such means.
PARTS = {
    'white': (Noise(7e-4), (1, 10, 100, 1000), lambda size: 7e-4 ** 2 / (size * INTERVAL)),
    'flicker': (Noise(bias_instability=1e-4), (100, 300, 1000),
                lambda size: (ALLAN_FLOOR_RATIO * 1e-4) ** 2),
    'walk': (Noise(rate_random_walk=1e-5), (30, 100, 1000),  # exact in steps
             lambda size: 1e-5 ** 2 * size * INTERVAL / 3.0 * (1.0 + 0.5 / size ** 2))}


@pytest.mark.parametrize('noise, sizes, wanted', PARTS.values(), ids=PARTS)
def test_simulated_noise_has_the_allan_variance_of_ieee_952(noise, sizes, wanted):
    """
    Allow four standard errors.

    The n differences of neighbours correlate by -1/2 or less, so that their mean square has a
    relative variance of at most 3 / n.

    """
    assert round(ALLAN_FLOOR_RATIO, 3) == 0.664
    generator = np.random.default_rng(952)
    records = [simulate_noise(noise, 2 ** 18, INTERVAL, generator) for _ in range(8)]
    for size in sizes:
        found = [allan_variance(record, size) for record in records]
        tolerance = 4.0 * math.sqrt(3.0 / (found[0][1] * len(records)))
        assert tolerance < 0.25
        assert (np.mean([variance for variance, _ in found]) / wanted(size)
                == pytest.approx(1.0, abs=tolerance)), size
        assert noise.allan_variance(size * INTERVAL) == pytest.approx(wanted(size), rel=1e-3)


@pytest.mark.parametrize('noise', [Noise(bias_instability=1e-4), Noise(rate_random_walk=1e-5)],
                         ids=['flicker', 'walk'])
@pytest.mark.parametrize('apart', [3, 20])
def test_means_wander_as_predicted(noise, apart):
    generator, duration, size = np.random.default_rng(5), 2.0, 200
    squares = []
    for _ in range(12):
        means = simulate_noise(noise, 2 ** 16 // size * size, INTERVAL,
                               generator).reshape(-1, size).mean(axis=1)[20:]
        squares.append(np.mean((means[apart:] - means[:-apart]) ** 2))
    assert np.mean(squares) == pytest.approx(
        noise.mean_change_variance(apart * duration, duration), abs=mean_bound(squares), rel=0.12)


def test_the_xv3500_walks_2_5_degrees_in_an_hour_and_11_where_hong_and_park_say_so():
    """2.5 deg/sqrt(h) and 18 deg/h give up to 11 deg in 30 min, as their introduction states."""
    assert (math.degrees(math.sqrt(Noise(XV3500.noise.angle_random_walk).heading_variance(3600.0)))
            == pytest.approx(2.5))
    assert (math.degrees(math.sqrt(XV3500.noise.heading_variance(1800.0)))
            == pytest.approx(11.0, abs=1.0))
    model = read_model(Path(__file__).parents[2] / 'config/xv3500.yaml')
    assert vars(model.noise) == pytest.approx(vars(XV3500.noise), rel=1e-4)
    assert model.output(0.5, 25.0) == pytest.approx(XV3500.model.output(0.5, 25.0), rel=1e-6)
