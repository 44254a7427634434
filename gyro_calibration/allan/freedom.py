# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Degrees of freedom of Allan variances, and the bounds that follow from them."""

from __future__ import annotations

from typing import Any

from gyro_calibration.allan.angle import Integers
from gyro_calibration.allan.covariance import FINE, lag_covariance
from gyro_calibration.allan.parts import (
    ANGLE_RANDOM_WALK,
    FLICKER,
    Part,
    QUANTIZATION,
    RATE_RANDOM_WALK,
)
from gyro_calibration.logs.log import Array
import numpy as np
from scipy.special import chdtri


def chi_squared_bounds(mean_square: Any, freedom: Any) -> tuple[Any, Any]:
    """Return the 95 % bounds of a root mean square (NIST SP 1065, eq. 45)."""
    lower, upper = (np.sqrt(mean_square * freedom / chdtri(freedom, tail))
                    for tail in (0.025, 0.975))
    return lower, upper


def degrees_of_freedom(samples: int, sizes: Integers, variance: Array) -> Array:
    """Return the equivalent degrees of freedom of Allan variances, by the noise of their slope."""
    return np.array([_freedom(samples, int(size), part)
                     for size, part in zip(sizes, _parts(sizes, variance))])


def _freedom(samples: int, size: int, part: Part) -> float:
    """Return (sum of variances)² / sum of covariances² (Greenhall and Riley, PTTI 2003)."""
    count = samples + 1 - 2 * size
    # quantization is white: its covariance is above zero at single lags only
    stride = 1 if part is QUANTIZATION else max(1, size // FINE)
    lags = np.arange(min(10 * size, count - 1) // stride + 1) * stride
    squares = lag_covariance(part, size, size, lags) ** 2 * (count - lags) * stride
    return max(1.0, float(squares[0]) * count / stride / float(2.0 * squares.sum() - squares[0]))


def _parts(sizes: Integers, variance: Array) -> list[Part]:
    """
    Return the random part that fits the slope of each Allan variance.

    Quantization stands at the short end; a steep fall elsewhere is chance.

    """
    slopes = _slopes(sizes, variance)
    random = (ANGLE_RANDOM_WALK, FLICKER, RATE_RANDOM_WALK)
    parts = [min(random, key=lambda part: abs(2.0 * part.slope - slope)) for slope in slopes]
    steep = int(np.argmin(np.append(slopes < -1.5, False)))
    return [QUANTIZATION] * steep + parts[steep:]


def _slopes(sizes: Integers, variance: Array) -> Array:
    """Return the slope of log Allan variance from half to twice each time; -1 for a lone one."""
    low, high = (np.searchsorted(sizes, sizes / 2.0),
                 np.searchsorted(sizes, 2.0 * sizes, side='right') - 1)
    rise = np.log(np.maximum(variance[high], 1e-300) / np.maximum(variance[low], 1e-300))
    return np.where(high > low,
                    rise / np.where(high > low, np.log(sizes[high] / sizes[low]), 1.0), -1.0)
