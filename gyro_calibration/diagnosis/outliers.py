# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Outliers: single samples far from their neighbours, and not because the gyro moves."""

from __future__ import annotations

from dataclasses import dataclass

from gyro_calibration.diagnosis.expected_output import bridged, Compared
from gyro_calibration.logs.log import Array, Mask
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy import stats
from scipy.ndimage import maximum_filter1d

#: An outlier is beyond so many standard deviations, or more where so many samples reach that by
#: chance.
_WILD = 6.0
#: Samples on each side that one is compared with.
SIDE = 3
#: Samples by which a reference may tell of a jolt sooner or later.
_SOON = 10
#: Samples in which the scatter is taken to be the same.
_BLOCK = 256
#: Kinds of motion that are told apart, by how much the expectation changes about a sample.
_KINDS = 16
#: Shares of the farthest samples at which the scatter is measured, for the tail of rough motion.
_TAILS = (0.05, 0.01)
#: So many side by side are no single samples any more.
_LONGEST = 2
#: Mean rank among all samples, by the motion about them, from which on wild ones are blamed on it.
_DUE_TO_MOTION = 0.85
#: Fewer wild samples than this show no habit; one that they would have by such a chance is none.
_FEW, _BY_CHANCE = 3, 1e-3
#: From here to wild there must be half as many samples as wild ones at most, in standard
#: deviations: else they are a tail of the noise.
_NEAR = 4.5


@dataclass(frozen=True)
class Outliers:
    """
    Samples that are wild.

    Attributes
    ----------
    samples : shape (n,)
    largest : in standard deviations
    p_value : the chance of as many among Gaussian ones

    """

    samples: Mask
    largest: float
    p_value: float


def outlying_samples(seen: Compared, good: Mask, floor: float, level: float) -> Outliers | None:
    """
    Find wild samples, or return None.

    Parameters
    ----------
    seen : output and expectation
    good : samples that count; beside three and more of six that do not, as after a stuck run, one
        is not judged
    floor : the scatter is at least this, rad/s: half a code
    level : chance of a false alarm

    """
    output, expected = bridged(np.where(good, seen.output, np.nan)), _known(seen)
    limit = max(_WILD, float(stats.norm.isf(0.25 * level / len(output))))
    moved = np.zeros(len(output)) if expected is None else _moved(expected)
    far = _far(output, moved, good, floor)
    if expected is not None:
        beside = _far(output - expected, moved, good, floor)
        far = np.where(_explained(output, expected), 0.0, np.maximum(far, beside))
    judged = good & (np.count_nonzero(_neighbours(~good, SIDE), axis=1) < SIDE)
    wild = _single((far > limit) & judged)
    count, near = (int(np.count_nonzero(wild)),
                   int(np.count_nonzero((far > _NEAR) & (far <= limit) & judged)))
    if (not count or near > 0.5 * count + stats.poisson.isf(
            0.01, 2.0 * len(output) * stats.norm.sf(_NEAR)) or _due_to_motion(wild, moved, seen)):
        return None
    p_value = float(stats.poisson.sf(count - 1, 4.0 * len(output) * stats.norm.sf(limit)))
    return Outliers(wild, float(far[wild].max()), p_value) if p_value < level else None


def _neighbours(values: Array | Mask, side: int) -> Array:
    """Return the samples before and after each one, shape (n, 2 side)."""
    # Turned over about the first and last sample, a slope goes on as it is. These two are what
    # the samples beside them say, as one that is an outlier would agree with itself.
    if len(values) > SIDE + 1 and values.dtype != bool:
        ends = [np.median([part[0], 2.0 * part[1] - part[2], 2.0 * part[2] - part[4]])
                for part in (values, values[::-1])]
        values = np.concatenate([ends[:1], values[1:-1], ends[1:]])
    window = sliding_window_view(np.pad(values, side, mode='reflect', reflect_type='odd'),
                                 2 * side + 1)
    return np.delete(window, side, axis=1)


def _known(seen: Compared) -> Array | None:
    return (None if seen.expected is None or not np.isfinite(seen.expected).any()
            else bridged(seen.expected))


def _moved(expected: Array) -> Array:
    """Return how much the output is expected to change about each sample, shape (n,)."""
    window = sliding_window_view(np.pad(expected, 2 * SIDE, mode='edge'), 4 * SIDE + 1)
    return np.ptp(window, axis=1)


def _off(values: Array) -> Array:
    """Return how far each sample is from the median of its neighbours."""
    return np.abs(values - np.median(_neighbours(values, SIDE), axis=1))


def _explained(output: Array, expected: Array) -> Mask:
    """Mark samples near which the reference jumps half as much: a jolt, or it is wild itself."""
    jumps = maximum_filter1d(_off(expected), 2 * _SOON + 1)
    return jumps > 0.5 * np.minimum(_off(output), _off(output - expected))


def _far(values: Array, moved: Array, good: Mask, floor: float) -> Array:
    """Return distances from neighbours, in standard deviations about here and in such motion."""
    near = _neighbours(values, SIDE)
    off = np.abs(values - np.median(near, axis=1))
    # A step, a corner or a steep slope leaves the median, but not what its neighbours span.
    outside = np.maximum(values - near.max(axis=1), near.min(axis=1) - values)
    scale = np.maximum(np.maximum(_about_here(off, good), _in_such_motion(off, moved, good)),
                       max(floor, 1e-300))
    return np.where(outside > 0.5 * off, off / scale, 0.0)


def _about_here(off: Array, good: Mask) -> Array:
    """Return the robust standard deviation in blocks, the largest of those next to a sample."""
    blocks = max(1, len(off) // _BLOCK)
    scales = np.array([_robust(part[kept]) for part, kept in zip(np.array_split(off, blocks),
                                                                 np.array_split(good, blocks))])
    edged = np.pad(scales, 1, mode='edge')
    scales = np.maximum(np.maximum(edged[:-2], edged[1:-1]), edged[2:])
    return np.repeat(scales, [len(part) for part in np.array_split(off, blocks)])


def _robust(off: Array) -> float:
    return float(np.quantile(off, 0.6827)) if off.size else 0.0


def _in_such_motion(off: Array, moved: Array, good: Mask) -> Array:
    """Return the standard deviation among samples of like motion, by far ones too if enough."""
    edges = (np.unique(np.quantile(moved[good], np.linspace(0.0, 1.0, _KINDS + 1)[1:-1]))
             if good.any() else np.array([]))
    kinds = np.searchsorted(edges, moved, side='left')
    scales = np.zeros(len(edges) + 1)
    for kind in range(len(scales)):
        members = off[(kinds == kind) & good]
        if members.size:
            tails = [np.quantile(members, 1.0 - share) / stats.norm.isf(0.5 * share)
                     for share in _TAILS if share * members.size > 5]
            scales[kind] = max([_robust(members), *tails])
    return scales[kinds]


def _single(wild: Mask) -> Mask:
    """Leave out those with more wild ones at their side than single samples have."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], wild.astype(np.int8), [0]])))
    single = np.zeros(len(wild), dtype=bool)
    for start, stop in zip(edges[::2], edges[1::2]):
        single[start:stop] = stop - start <= _LONGEST
    return single


def _due_to_motion(wild: Mask, moved: Array, seen: Compared) -> bool:
    """Tell whether wild samples stand where motion changes most, or at certain rates."""
    if np.count_nonzero(wild) < _FEW or seen.expected is None or not np.ptp(moved) > 0.0:
        return False
    ranks = _ranks(moved[wild], moved)
    by_chance = 0.5 + stats.norm.isf(_BY_CHANCE) / np.sqrt(12.0 * len(ranks))
    if ranks.mean() > max(_DUE_TO_MOTION, by_chance):
        return True
    turning = (moved > 3.0 * seen.white) & np.isfinite(seen.expected)
    if np.count_nonzero(wild & turning) < _FEW:
        return False
    speeds = np.abs(seen.expected)
    return bool(stats.kstest(_ranks(speeds[wild & turning], speeds[turning]),
                             'uniform').pvalue < _BY_CHANCE)


def _ranks(values: Array, among: Array) -> Array:
    return np.searchsorted(np.sort(among), values) / len(among)
