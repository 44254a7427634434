# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The quality of samples: white noise, quantization, outliers, repeated and saturated samples."""

from __future__ import annotations

import math

from gyro_calibration.logs.log import Array, Mask
import numpy as np


def robust_deviation(values: Array) -> float:
    """Return the standard deviation of Gaussian values about zero, some of them outliers."""
    return 1.4826 * float(np.median(np.abs(values)))


def white_noise(values: Array) -> float:
    """Return the standard deviation of the white part of a signal, by third differences."""
    off = np.abs(np.diff(values, 3))
    off = off[np.isfinite(off)]
    # Not by the median: an output of few codes has differences of zero mostly. Of a normal
    # distribution, 90 % are within 1.645 standard deviations.
    of_one = 1.6448536269514722 * math.sqrt(20.0)
    return float(np.quantile(off, 0.9)) / of_one if off.size else math.inf


def quantization_step(values: Array) -> float:
    """Return the step of an encoder or another digital output; about 0 where it has none."""
    # Rounding in the file splits a step in two sizes, and fast turns leave steps out: so it is
    # neither the smallest nor the median gap.
    gaps = np.diff(np.unique(values))
    gaps = gaps[gaps > 1e-9]
    return float(np.quantile(gaps, 0.05)) if len(gaps) else 0.0


def runs(mask: Mask) -> list[slice]:
    """Return each run of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask, [0]])))
    return [slice(int(start), int(stop)) for start, stop in zip(edges[::2], edges[1::2])]


def outliers(values: Array, limit: float) -> Mask:
    """
    Mark single samples far from their neighbours and the median; not drift or vibration.

    Parameters
    ----------
    values : shape (n,)
    limit : in robust standard deviations

    """
    if len(values) < 4:
        return np.zeros(len(values), dtype=bool)
    # The median of six neighbours resists two outliers among them.
    edged = np.pad(values, 3, mode='reflect')
    alone = values - np.median([edged[place:place + len(values)]
                                for place in (0, 1, 2, 4, 5, 6)], axis=0)
    # A coarsely quantized output mostly equals its neighbours; then the limit is in steps.
    least = max(quantization_step(values), 1e-9)
    return np.logical_and(*(np.abs(off) > limit * max(robust_deviation(off), least)
                            for off in (alone, values - np.median(values))))


def repeated_samples(output: Array) -> Mask:
    """Mark the repeats in runs of one value that are too long for its share of the samples."""
    repeated = np.zeros(len(output), dtype=bool)
    share = np.unique(output, return_counts=True)[1].max() / len(output)
    # Mostly one value: a coarsely quantized gyro at rest, or a simulation without noise. It cannot
    # be distinguished from a gyro that repeats samples.
    if share > 0.9:
        return repeated
    longest = math.log(1e-6 / len(output)) / math.log(share)
    for run in runs(np.concatenate([[False], np.diff(output) == 0.0])):
        repeated[run] = run.stop - run.start > longest
    return repeated
