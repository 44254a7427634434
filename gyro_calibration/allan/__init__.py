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
Allan deviation of a gyro at rest, and its noise figures N, B, K, Q and R (IEEE Std 952, annex C).

The output of a gyro at rest is its bias and its noise. The Allan variance at the averaging time
tau is half the mean square of the difference between neighbouring means over tau. Here it is the
overlapping one, at every sample. Its uncertainty follows from the covariance of the second
differences of the angle, which are Gaussian.

Reading order: `deviation` (samples at rest on an even grid, the chart, and the covariance of Allan
variances), `noise_fit` (coefficients of the noise terms).

"""

from importlib import import_module
import sys
from types import ModuleType
from typing import Any

from gyro_calibration.allan.deviation import (
    allan_deviation,
    AllanChart,
    averaging_sizes,
    build_rest_record,
    Floor,
    RestRecord,
)
from gyro_calibration.allan.noise_fit import fit_noise, NoiseFigure, NoiseFit
from gyro_calibration.model.noise import NOISE_TERMS, NoiseTerm

__all__ = ['NOISE_TERMS', 'AllanChart', 'NoiseFigure', 'Floor', 'NoiseFit', 'NoiseTerm',
           'RestRecord', 'allan_deviation', 'averaging_sizes', 'build_rest_record', 'fit_noise']


class _CallableModule(ModuleType):
    """
    This package, which can be called as `gyro_calibration.api.allan`.

    An imported subpackage shadows the public function of the same name. So the subpackage is
    callable too.

    """

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        return import_module('gyro_calibration.api').allan(*arguments, **named)


sys.modules[__name__].__class__ = _CallableModule
