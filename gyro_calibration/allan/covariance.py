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
Covariance of second differences of the angle, and of Allan variances.

Everything is in samples. An Allan variance is a mean square of second differences, and mean
squares of Gaussian values have the covariance 2 c² summed over all pairs (Greenhall and Riley,
Uncertainty of stability variances based on finite differences, PTTI 2003).

"""

from __future__ import annotations

from gyro_calibration.allan.angle import Integers
from gyro_calibration.allan.parts import (
    Part,
    PARTS,
    QUANTIZATION_PLACE,
    RAMP_PLACE,
    RATE_WALK_PLACE,
)
from gyro_calibration.logs.log import Array
import numpy as np

#: Second difference.
_WEIGHTS = (1.0, -2.0, 1.0)

#: Lags to a window, and to the longer one of two: more change the covariance by less than 1 %.
FINE, _COARSE = 8, 512

#: Parts whose second differences are independent over longer times.
_FORGETTING = [place for place in range(len(PARTS)) if place not in (RATE_WALK_PLACE, RAMP_PLACE)]


def lag_covariance(part: Part, first: int, second: int, lags: Integers) -> Array:
    """Return the covariance of second differences over `first` and `second` samples at lags."""
    return np.sum([a * b * part.covariance(lags + (j * second - i * first))
                   for i, a in enumerate(_WEIGHTS) for j, b in enumerate(_WEIGHTS)], axis=0)


def _lag_covariances(first: int, second: int, lags: Integers) -> Array:
    return np.array([lag_covariance(part, first, second, lags) for part in PARTS])


def _pairs(counts: tuple[int, int], lags: Integers) -> Integers:
    """Return how many pairs of second differences, so many of each, stand at each lag."""
    return np.maximum(np.minimum(counts[0], counts[1] - lags) - np.maximum(0, -lags), 0)


def covariance_form(samples: int, first: int, second: int) -> Array:
    """
    Return the covariance of two Allan variances as a form of squared coefficients, shape (5, 5).

    Angle quantization is white: only lags at which two of its samples meet count. A ramp is no
    noise, but multiplies it: the covariance of squares of values with a mean m also has 4 m² c.

    """
    counts, area = ((samples + 1 - 2 * first, samples + 1 - 2 * second),
                    float(first) ** 2 * float(second) ** 2)
    pairs, values = _at_lags(counts, first, second)
    meeting_pairs, meeting = _where_quantization_meets(counts, first, second)
    # not a product of matrices, which starts threads
    form = np.array([[2.0 * (pairs * one * other).sum() for other in values] for one in values])
    form[QUANTIZATION_PLACE] = form[:, QUANTIZATION_PLACE] = 2.0 * (
        meeting * meeting[QUANTIZATION_PLACE] * meeting_pairs).sum(axis=1)
    slopes = (values * pairs).sum(axis=1)
    slopes[QUANTIZATION_PLACE] = meeting[QUANTIZATION_PLACE] @ meeting_pairs
    form[RAMP_PLACE] = form[:, RAMP_PLACE] = 2.0 * area * slopes
    return form / (4.0 * area * counts[0] * counts[1])


def _at_lags(counts: tuple[int, int], first: int, second: int) -> tuple[Array, Array]:
    """Return how many pairs stand at lags, dense enough but for quantization; the covariances."""
    longer, shorter = max(first, second), min(first, second)
    stride = max(1, shorter // FINE, longer // _COARSE)
    lags = np.arange(-(min(10 * longer, counts[0]) // stride),
                     min(10 * longer, counts[1]) // stride + 1) * stride
    values = _lag_covariances(first, second, lags)
    values[QUANTIZATION_PLACE] = 0.0
    if stride > max(1, shorter // 2):
        values[_FORGETTING] = 0.0  # independent over times so far apart
    return _pairs(counts, lags) * float(stride), values


def _where_quantization_meets(counts: tuple[int, int], first: int,
                              second: int) -> tuple[Integers, Array]:
    """Return how many pairs stand at lags at which two of its samples meet; the covariances."""
    lags = np.unique([i * first - j * second for i in range(3) for j in range(3)])
    return _pairs(counts, lags), _lag_covariances(first, second, lags)
