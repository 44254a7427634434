# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""RepeatedSamples samples: the last value once more, beyond the honest repeats of coarse codes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
import math

from gyro_calibration.diagnosis.expected_output import Compared
from gyro_calibration.diagnosis.quantization import Codes, DeadBand, doubt_of, steps_about
from gyro_calibration.logs.log import Array, Mask
import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.special import ndtr

#: Motions that are told apart, by the change that is expected from one sample to the next.
_CLASSES = 8
#: From this share of repeats on, single ones of so coarse an output mean nothing; runs may.
_COARSE = 0.3
#: Single repeats are believed to be stuck where honest ones are as rare as this.
_RARE = 0.02
#: Excess of repeats over the honest ones, as a part of these, below which their number is not
#: known well enough.
_EXCESS = 0.5
#: A run is like others up to so many times the longest of them.
_ALIKE = 2.0
#: A code that is narrower than this part of the noise is a point.
_NARROW = 1e-5


@dataclass(frozen=True)
class RepeatedSamples:
    """
    Samples that repeat the one before.

    Attributes
    ----------
    repeats : those that are not honest, shape (n,)
    honest : how many repeats the codes and the noise explain
    p_value : the chance of as many, or of runs as long

    """

    repeats: Mask
    honest: float
    p_value: float

    @property
    def runs(self) -> int:
        """Return how often it stuck."""
        return len(_lengths(self.repeats))

    def has_one_more(self, at_limit: Mask) -> bool:
        """Tell whether samples at a limit are one run like the others: an extreme value stuck."""
        lengths = _lengths(at_limit)
        return len(lengths) == 1 and lengths[0] - 1 <= _ALIKE * _lengths(self.repeats).max()


@dataclass(frozen=True)
class _Honest:
    """
    What codes and noise explain of each change, arrays of shape (n - 1,).

    Attributes
    ----------
    chance : of it to be none
    again : the most that this is within a run of repeats
    width : of the code that it begins in, rad/s

    """

    chance: Array
    again: Array
    width: Array


def _lengths(marked: Mask) -> NDArray[np.int_]:
    """Return the lengths of the runs of marked samples."""
    edges = np.flatnonzero(np.diff(marked, prepend=False, append=False))
    return edges[1::2] - edges[::2]


def repeated_samples(seen: Compared, codes: Codes, band: DeadBand | None, good: Mask,
                     level: float) -> RepeatedSamples | None:
    """
    Find samples that are stuck, or return None.

    Parameters
    ----------
    seen : output and expectation
    codes : of the output
    band : of rates that the output has one value for, if it has one
    good : samples to look at; those at a limit repeat honestly
    level : chance of a false alarm

    """
    looked, change = good[1:] & good[:-1], np.diff(seen.output)
    same, expected = (change == 0.0) & looked, _expected_change(seen.expected, len(change))
    if not same.any():
        return None
    honest = _in_the_band(
        _honest(change, expected, steps_about(codes, seen.output[:-1]), looked), band, seen)
    repeats, p_value = np.zeros(len(good), dtype=bool), 1.0
    rare = (honest.chance < _COARSE) & looked
    excess, believed = int(np.count_nonzero(same & rare)), float(honest.chance[rare].sum())
    by_number = (float(stats.poisson.sf(excess - 1, believed))
                 if excess > believed * (1.0 + _EXCESS) else 1.0)
    if by_number < level:
        repeats[1:], p_value = same & (honest.chance < _RARE), by_number
    for start, stop, unlikely in _runs(same, honest, expected, doubt_of(seen)):
        if unlikely * len(good) < level:
            repeats[start + 1:stop + 1], p_value = True, min(p_value, unlikely * len(good))
    return (RepeatedSamples(repeats, float(honest.chance[looked].sum()), p_value)
            if repeats.any() else None)


def _expected_change(expected: Array | None, count: int) -> Array:
    return np.zeros(count) if expected is None else np.nan_to_num(np.diff(expected))


def _honest(change: Array, expected: Array, step: Array, looked: Mask) -> _Honest:
    """
    Return what codes and noise explain of each change.

    The chance is the part of a code that the sample before leaves for this one, averaged over the
    noise, among changes that are expected alike. The longer a run is, the likelier its code is the
    one in whose middle the expectation lies; so within it that code counts.

    """
    chances, again = np.ones((2, len(change)))
    edges = np.quantile(np.abs(expected), np.linspace(0.0, 1.0, _CLASSES + 1)[1:-1])
    classes = np.searchsorted(edges, np.abs(expected), side='left')
    for each in np.unique(classes):
        members = np.flatnonzero((classes == each) & looked)
        if len(members):
            due, steps = expected[members], step[members]
            deviation = _deviation_of_changes(change[members] - due, change[members] == 0.0,
                                              float(np.median(steps)))
            chances[members] = np.maximum(_same_code(due, deviation, steps),
                                          _share_of_neighbours(change[members], steps))
            again[members] = np.maximum(_middle_code(due, deviation, steps), chances[members])
    return _Honest(chances, again, step)


def _in_the_band(honest: _Honest, band: DeadBand | None, seen: Compared) -> _Honest:
    """Return the same, where a sample in a dead band repeats while the next is due in it."""
    if band is None:
        return honest
    within, chances = band.holds(seen.output[:-1]), band.chances(seen)[1:]
    chance, again = (np.where(within, np.maximum(each, chances), each)
                     for each in (honest.chance, honest.again))
    return _Honest(chance, again, np.where(within, 2.0 * band.half, honest.width))


def _share_of_neighbours(change: Array, step: Array) -> float:
    """Return an upper bound of the share of changes by one code or two, each way."""
    size = np.abs(change)
    count = np.count_nonzero((size > 0.5 * step) & (size < 2.5 * step))
    return float((count + 2.0 * np.sqrt(count)) / 4.0 / len(change))


def _deviation_of_changes(change: Array, same: Mask, step: float) -> float:
    """Return the standard deviation of changes by noise; zeros count as those due."""
    moved = np.abs(change[~same])
    if len(moved) < 2:
        return 0.0
    moved = np.minimum(moved, 4.0 * np.median(moved))
    square = float(np.mean(moved ** 2))
    variance = square
    for _ in range(20):
        variance = square * (1.0 - float(_same_code(np.zeros(1), np.sqrt(variance),
                                                    np.array([step]))[0]))
    return float(np.sqrt(variance))


def _same_code(expected: Array, deviation: float, step: Array) -> Array:
    """Return the mean of max(0, 1 - |D| / step) for normal D: the chance of the same code."""
    scale = np.maximum(deviation, 1e-9 * step)
    low, middle, high = ((edge - expected) / scale for edge in (-step, 0.0, step))
    above, below = ndtr(high) - ndtr(middle), ndtr(middle) - ndtr(low)
    sizes = (expected * (above - below)
             + scale * (2.0 * _density(middle) - _density(high) - _density(low)))
    # Differences of nearly nothing are rounding.
    return np.where(step < _NARROW * scale, step / scale * _density(middle),
                    np.clip(above + below - sizes / step, 0.0, 1.0))


def _middle_code(expected: Array, deviation: float, step: Array) -> Array:
    """Return the chance of the code in the middle between two expectations, for each sample."""
    scale = np.maximum(deviation / math.sqrt(2.0), 1e-9 * step)
    return ndtr(0.5 * (step - expected) / scale) - ndtr(-0.5 * (step + expected) / scale)


def _density(values: Array) -> Array:
    return np.exp(-0.5 * values ** 2) / math.sqrt(2.0 * math.pi)


def _runs(same: Mask, honest: _Honest, expected: Array,
          doubt: float) -> Iterator[tuple[int, int, float]]:
    """Give where runs of at least two repeats begin and end, and how unlikely each is."""
    edges: NDArray[np.intp] = np.flatnonzero(
        np.diff(np.concatenate([[0], same.astype(np.int8), [0]])))
    starts, stops = edges[::2], edges[1::2]
    product, due = (np.concatenate([[0.0], np.cumsum(each)])
                    for each in (np.log(np.maximum(honest.again, 1e-12)), expected))
    for start, stop in zip(starts[stops - starts >= 2].tolist(),
                           stops[stops - starts >= 2].tolist()):
        if honest.chance[start:stop].max() < _COARSE:
            yield start, stop, float(np.exp(max(product[stop] - product[start], -700.0)))
        else:
            # Repeats of a coarse code depend on each other: stuck only if it should have left.
            left = abs(due[stop] - due[start]) - honest.width[start]
            yield start, stop, (float(2.0 * stats.norm.sf(left / (math.sqrt(2.0) * doubt)))
                                if left > 0.0 else 1.0)
