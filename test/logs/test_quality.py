# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The quality of samples: steps and limits of outputs whose truth is known."""

from gyro_calibration.logs.log import DataRefused, DEGREE
from gyro_calibration.logs.quality import (
    quantization_step, refuse_saturated, white_noise_deviation)
import numpy as np
import pytest


def turns(generator, senses, noise):
    """Return an output at 25 Hz of constant turns between rests, with ramps of 1 s, rad/s."""
    rest, ramp = np.zeros(100), np.linspace(0.0, 1.0, 26)
    parts = [np.concatenate([rest, rate * ramp, np.full(250, rate), rate * ramp[::-1]])
             for rate in generator.uniform(40.0, 90.0) * np.array(senses)]
    rate = np.concatenate([*parts, rest]) + generator.normal(0.0, 0.5)
    return DEGREE * (rate + noise * generator.standard_normal(len(rate)))


def test_the_white_noise_of_samples_that_have_no_neighbours_is_known():
    values = np.full(3000, np.nan)
    values[::3] = np.random.default_rng(0).standard_normal(1000)
    assert white_noise_deviation(values) == pytest.approx(1.0, rel=0.1)


@pytest.mark.parametrize('senses', [[1.0], [-1.0], [1.0, -1.0]])
@pytest.mark.parametrize('step', [0.06, 0.5, 1.0])
def test_ramps_and_rests_do_not_hide_the_step_of_an_output(senses, step):
    """Ramps advance by nearly equal amounts, and most samples have one of a few codes."""
    for seed in range(20):
        generator = np.random.default_rng(seed)
        output = turns(generator, senses, generator.uniform(0.0, 0.5) * step)
        rounded = step * DEGREE * np.round(output / (step * DEGREE))
        assert quantization_step(rounded) / DEGREE == pytest.approx(step, rel=1e-6)


@pytest.mark.parametrize('senses', [[1.0], [-1.0], [1.0, -1.0]])
def test_a_coarse_turn_is_not_saturated_and_a_clipped_one_is(senses):
    for seed in range(20):
        generator = np.random.default_rng(seed)
        output = turns(generator, senses, 0.05)
        for step in (0.5, 1.0):
            refuse_saturated(step * DEGREE * np.round(output / (step * DEGREE)))
        limit = generator.uniform(0.5, 0.95) * np.abs(output).max()
        with pytest.raises(DataRefused, match=f'limit of {limit / DEGREE:.4g}'.replace(
                'of ', 'of -?')):
            refuse_saturated(np.clip(output, -limit, limit))
