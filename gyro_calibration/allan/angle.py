# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The angle of rate samples; lost samples are nan."""

from __future__ import annotations

from gyro_calibration.logs.log import Array, DataRefused
from gyro_calibration.logs.stamps import Integers
import numpy as np
from numpy.typing import NDArray

Truths = NDArray[np.bool_]

#: The least number of samples for a noise figure.
FEWEST = 100

#: Largest share of lost samples in a window; the variance of its mean changes by at most as much.
LOST_SHARE = 0.01


def refuse_few(count: int, samples: str = 'samples') -> None:
    if count < FEWEST:
        raise DataRefused(f'{count} {samples}; an Allan deviation wants at least {FEWEST}: '
                          'record longer')


def angle_of(rate: Array) -> Array:
    """
    Return the angle before each sample and after the last, less the mean rate, shape (n + 1,).

    It is in rate units times samples.

    """
    angle = np.empty(len(rate) + 1)
    angle[0] = 0.0
    np.cumsum(filled(rate), out=angle[1:])
    return angle


def filled(rate: Array) -> Array:
    """Return the rate less its mean; a gap gets the mean of five times its length on each side."""
    known = np.isfinite(rate)
    values = rate - rate[known].mean()
    if known.all():
        return values
    values[~known] = 0.0
    begins, ends = gaps(known)
    margin = 5 * (ends - begins) + 5
    low, high = np.maximum(begins - margin, 0), np.minimum(ends + margin, len(rate))
    sums, counts = (np.concatenate([[0.0], np.cumsum(each)]) for each in (values, known))
    means = (sums[high] - sums[low]) / np.maximum(counts[high] - counts[low], 1.0)
    values[~known] = np.repeat(means, ends - begins)
    return values


def gaps(known: Truths) -> tuple[Integers, Integers]:
    """Return where each stretch of unknown samples begins, and where it has ended."""
    edges = np.diff(np.concatenate([[1], known.astype(np.int8), [1]]))
    return np.nonzero(edges < 0)[0], np.nonzero(edges > 0)[0]


def lost_before(rate: Array) -> Integers | None:
    """Return how many samples are lost before each one, shape (n + 1,), or None without losses."""
    lost = np.isnan(rate)
    return np.concatenate([[0], np.cumsum(lost)]) if lost.any() else None


def whole(lost: Integers, size: int, begin: int, end: int, step: int = 1) -> Truths:
    """
    Return which second differences over `size` samples, from `begin` to `end`, miss few samples.

    `lost` is the result of `lost_before`.

    """
    return (lost[begin + 2 * size:end + 2 * size:step] - lost[begin:end:step]
            <= LOST_SHARE * 2 * size)
