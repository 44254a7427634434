# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The parts of the noise of IEEE Std 952, C.1."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import math

from gyro_calibration.allan.angle import Integers
from gyro_calibration.logs.log import Array
from gyro_calibration.model.noise import ALLAN_FLOOR
import numpy as np


@dataclass(frozen=True)
class Part:
    """
    A part of the noise, by the slope of its Allan deviation (IEEE Std 952, C.1).

    Attributes
    ----------
    name, symbol, unit : as in IEEE Std 952; the unit in SI
    slope : of the Allan deviation in the logarithmic chart
    factor : Allan variance = factor * coefficient² * tau ** (2 slope)
    covariance : of the angle, for a coefficient of 1, as a function of the time between, up to
        terms that second differences remove

    """

    name: str
    symbol: str
    unit: str
    slope: float
    factor: float
    covariance: Callable[[Integers], Array]

    def variance(self, time: Array | Integers) -> Array:
        """Return the Allan variance for a coefficient of 1."""
        return self.factor * np.asarray(time, dtype=float) ** (2.0 * self.slope)


def _flicker_covariance(time: Integers) -> Array:
    """Return t² ln t / (2 pi): the second difference has the Allan variance 2 ln 2 / pi."""
    size = np.abs(time)
    return size ** 2 * np.log(np.where(size == 0.0, 1.0, size)) / (2.0 * math.pi)


ANGLE_RANDOM_WALK = Part('angle_random_walk', 'N', 'rad/√s', -0.5, 1.0,
                         lambda time: -0.5 * np.abs(time))
FLICKER = Part('flicker', 'B', 'rad/s', 0.0, ALLAN_FLOOR ** 2, _flicker_covariance)
RATE_RANDOM_WALK = Part('rate_random_walk', 'K', 'rad/s/√s', 0.5, 1.0 / 3.0,
                        lambda time: np.abs(time) ** 3 / 12.0)
QUANTIZATION = Part('quantization', 'Q', 'rad', -1.0, 3.0,
                    lambda time: (np.asarray(time) == 0.0).astype(float))
RATE_RAMP = Part('rate_ramp', 'R', 'rad/s²', 1.0, 0.5, lambda time: 0.0 * np.asarray(time))

PARTS = (ANGLE_RANDOM_WALK, FLICKER, RATE_RANDOM_WALK, QUANTIZATION, RATE_RAMP)

#: Places of the parts that are treated apart.
ANGLE_WALK_PLACE, RATE_WALK_PLACE = PARTS.index(ANGLE_RANDOM_WALK), PARTS.index(RATE_RANDOM_WALK)
FLICKER_PLACE = PARTS.index(FLICKER)
QUANTIZATION_PLACE, RAMP_PLACE = PARTS.index(QUANTIZATION), PARTS.index(RATE_RAMP)

#: Beside the parts: what a filter takes from the variance. Over times beyond the memory of the
#: filter it has the slope of quantization, with the other sign.
BEND_PLACE = len(PARTS)
