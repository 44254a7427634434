# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Noise within the bounds that a model states is that of the model, and no finding."""

from gyro_calibration.diagnosis.pipeline import _of_noise
from gyro_calibration.diagnosis.residuals import NoiseParameters
from gyro_calibration.model.gyro_model import GyroModel
from gyro_calibration.model.noise import Noise
import pytest

FIGURES = NoiseParameters(Noise(1.1e-3), {'angle_random_walk': (1.05e-3, 1.15e-3)},
                          {'angle_random_walk': 1e-9})


@pytest.mark.parametrize('bounds, found', [
    ({}, 1), ({'angle_random_walk': (0.9e-3, 1.06e-3)}, 0),
    ({'angle_random_walk': (0.9e-3, 1.04e-3)}, 1)], ids=['none', 'wide', 'narrow'])
def test_noise_within_the_bounds_of_a_model_is_no_finding(bounds, found):
    model = GyroModel(noise=Noise(1e-3), noise_bounds=bounds)
    assert len(_of_noise(FIGURES, model, 0.01, ())) == found
