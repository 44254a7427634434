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

from gyro_calibration.logs.log import Array, DataRefused, DEGREE, Mask
import numpy as np
from scipy.special import ndtri

#: A gyro that gives one value in more than this part of its samples is dead, even if its last bit
#: toggles.
_DEAD = 0.9


def robust_deviation(values: Array) -> float:
    """Return the standard deviation of Gaussian values about zero, some of them outliers."""
    return 1.4826 * float(np.median(np.abs(values)))


def white_noise(values: Array, order: int = 3) -> float:
    """
    Return the standard deviation of the white part of a signal, by its differences.

    Parameters
    ----------
    values : shape (n,); differences with nan are left out
    order : of the differences: 3 in motion; 1 at rest, where noise that a filter has smoothed
        shows best

    """
    off = np.abs(np.diff(values, order))
    off = off[np.isfinite(off)]
    # Not by the median: an output of few codes has differences of zero mostly.
    return (float(np.quantile(off, 0.9)) / -float(ndtri(0.05)) / math.sqrt(math.comb(
        2 * order, order)) if off.size else math.inf)


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


def refuse_dead(output: Array) -> None:
    """Refuse samples of one value, or nearly all of one."""
    values, counts = np.unique(output, return_counts=True)
    share, value = counts.max() / len(output), float(values[counts.argmax()])
    if len(values) == 1:
        raise DataRefused(f'all {len(output)} samples have the same value, {value:g} rad/s: '
                          'the gyro is dead or not powered')
    if share > _DEAD:
        raise DataRefused(f'{100 * share:.1f} % of the samples have the same value, {value:g} '
                          'rad/s: the gyro is dead, not powered, or did not move')


def refuse_saturated(output: Array) -> None:
    """
    Refuse an output that stays at its largest or smallest value as no noise does.

    A flat top has at least 10 samples and 0.5 % of all at a limit, three times as many as at the
    next value. Codes so coarse that they hide the noise stay honestly: only the profile can show a
    limit then.

    """
    values, counts = np.unique(output, return_counts=True)
    if len(values) < 2 or not _noise_is_resolved(output):
        return
    for end, neighbour in ((-1, -2), (0, 1)):
        if counts[end] >= max(10, 0.005 * len(output)) and counts[end] > 3 * counts[neighbour]:
            raise DataRefused(
                f'the gyro is saturated: {100 * counts[end] / len(output):.0f} % of the samples '
                f'are at its limit of {values[end] / DEGREE:.4g} deg/s; turn slower, or set a '
                'wider range')


def _noise_is_resolved(output: Array) -> bool:
    """
    Tell whether a fifth of neighbouring samples differ where the rate is steady.

    That is in the flattest quarter of blocks of ten samples away from the extreme values.

    """
    blocks = output[:len(output) // 10 * 10].reshape(-1, 10)
    blocks = blocks[((blocks != output.max()) & (blocks != output.min())).all(axis=1)]
    if len(blocks) < 4:
        return False
    slopes = np.abs(blocks[:, 5:].mean(axis=1) - blocks[:, :5].mean(axis=1))
    flattest = blocks[np.argsort(slopes)[:len(blocks) // 4]]
    return bool(np.mean(np.diff(flattest, axis=1) != 0.0) > 0.2)
