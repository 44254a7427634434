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
Integration of rates to a heading and its variance: lost samples, threshold filter, trapezoids.

The threshold is compared with the mean over a window, because single samples of a cheap gyro cross
it half of the time. A window of 0 is the published decision. Rates are integrated by the trapezoid
rule on the stamps: the rectangle rule has a delay of half a sample, and a nominal interval causes
a scale factor error.

Over a gap with lost samples the rate is interpolated linearly. If it differs at the ends by a step
d, it may have changed at any time in the gap of T, so that the integral has the variance
T² d² / 12. It depends on the two samples at the ends alone, each with the noise N² / dt, so that
the variance by noise is T² N² / (2 dt) instead of N² T. A vibration does not show at the ends: its
variance is that of the rates of the last seconds, see `varied_variance`.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from dataclasses import dataclass
import math

from gyro_calibration.logs.log import Array, CACHE_BLOCK_SAMPLES, DEGREE, MIN_SAMPLE_INTERVAL
from gyro_calibration.logs.stamps import SHORT_RATIO
from gyro_calibration.model.compensation import quadratic_form
from gyro_calibration.model.noise import Noise
import numpy as np

#: Tolerance of durations, s: the resolution of stamps in seconds since 1970.
TIME_TOLERANCE = 1e-6
#: Largest rate, rad/s, so that the variance after a gap is finite.
MAX_RATE = 1e4
#: Number of intervals in the memory, and least number for the detection of a gap.
_MAX_INTERVALS, _MIN_INTERVALS = 256, 16
#: Share of short intervals in the memory above which stamps come in bursts.
_MIN_BURST_SHARE = 0.1
#: Longest gap in the stamps that is integrated, s, unless the samples are as far apart.
MAX_GAP = 1.0
#: Duration, s, of the rates that show how the robot moves in a gap, and in which a rate after a
#: jump may be erroneous.
RECENT_DURATION = 2.0


class Intervals:
    """The usual interval of stamps, with jitter or bursts, and the samples lost in others."""

    def __init__(self) -> None:
        """Begin with nothing known."""
        # usual interval, s, and longest gap, s; inf and 0 where there is none
        self.usual_interval, self.lost_samples, self.longest_gap = math.inf, 0, 0.0
        self._history: deque[float] = deque(maxlen=_MAX_INTERVALS)
        self._until_update, self._gap_limit = _MIN_INTERVALS, math.inf
        self._even_interval, self._late_samples = math.inf, 0

    def add(self, interval: float) -> int:
        """Take the next interval, s; return how many samples are lost in it."""
        self._history.append(interval)
        self._until_update -= 1
        if not self._until_update:
            # the usual interval is the median, unless the stamps come in bursts
            self._until_update = max(len(self._history) // 4, _MIN_INTERVALS)
            steps = sorted(self._history)
            mean = sum(steps) / len(steps)
            usual = self._even_interval = steps[len(steps) // 2]
            if steps[int(_MIN_BURST_SHARE * len(steps))] < SHORT_RATIO * mean:
                # the longest may be gaps
                self._even_interval = steps[-1 - len(steps) // 100]
                usual = sum(min(step, self._even_interval) for step in steps) / len(steps)
            self.usual_interval = max(usual, MIN_SAMPLE_INTERVAL)
            self._gap_limit = self._even_interval + SHORT_RATIO * self.usual_interval
        return self.count_lost(interval)

    def add_many(self, intervals: Array) -> tuple[Array, Array]:
        """
        Take intervals, s, as `add` does one by one, and return two arrays of shape (n,).

        They are the usual interval after each, s, and the number of samples lost in it.
        """
        taken, usual, lost = 0, np.empty(len(intervals)), np.zeros(len(intervals), int)
        while taken < len(intervals):
            part = intervals[taken:taken + self._until_update - 1]
            even = part <= self._gap_limit
            count = len(part) if even.all() else int(np.argmin(even))
            if self._late_samples or not count:
                count, lost[taken] = 1, self.add(float(intervals[taken]))
            else:
                self._history.extend(part[:count].tolist())
                self._until_update -= count
            usual[taken:taken + count] = self.usual_interval
            taken += count
        return usual, lost

    def count_lost(self, interval: float) -> int:
        """
        Return how many samples are lost in an interval, s, and count them.

        Called alone for an interval that is not integrated, which is excluded from the usual one.
        """
        if interval > self._gap_limit:
            self._late_samples = max(round((interval - self._even_interval) / self.usual_interval),
                                     1)
            self.lost_samples += self._late_samples
            self.longest_gap = max(self.longest_gap, interval)
            return self._late_samples
        if self._late_samples and interval < SHORT_RATIO * self.usual_interval:  # late, not lost
            self._late_samples -= 1
            self.lost_samples -= 1
        else:
            self._late_samples = 0
        return 0


def block_ends(intervals: Array, length: float, elapsed: float) -> list[int]:
    """
    Return the numbers of samples up to the ends of blocks of `length` s or slightly longer.

    The intervals are those before each sample; `elapsed` is the duration of the first block so
    far, s.
    """
    until, ends = np.cumsum(intervals).tolist(), list[int]()
    target, place = length - TIME_TOLERANCE - elapsed, 0
    while (place := bisect_left(until, target, place)) < len(until):
        target = until[place] + length - TIME_TOLERANCE
        place += 1
        ends.append(place)
    return ends


def gap_variances(noise: Noise, usual: Array | float, lost: Array | int, interval: Array | float,
                  step: Array | float) -> tuple[Array | float, Array | float]:
    """
    Return the variances of an integral over gaps by motion, and additional ones by noise, rad².

    Given are the usual interval, s, the number of lost samples, and the interval, s, and the step
    of the rate, rad/s, between the samples around a gap.
    """
    ends = noise.angle_random_walk ** 2 / usual
    surplus = np.minimum(lost * usual, interval)
    return (interval ** 2 * np.maximum(step ** 2 - 2.0 * ends, 0.0) / 12.0,
            ends * surplus * (0.5 * surplus + usual))


def varied_variance(noise: Noise, usual: float, interval: float, time: Array,
                    rate: Array) -> float:
    """
    Return the variance of an integral over a gap, rad², where the rate varies as before it.

    The ends of a gap do not show a vibration. It is the mean square of the same error over all
    intervals of this length without the gap, less that by noise. Given are the usual interval, and
    that of the gap, s, and samples before it, s and rad/s, shape (n,).
    """
    ends = time[time >= time[0] + interval]
    if not len(ends):
        return 0.0
    angle = integrate(time, rate)
    turned, rates = (np.interp([ends - interval, ends], time, values) for values in (angle, rate))
    square = float(np.mean((turned[1] - turned[0] - 0.5 * interval * rates.sum(axis=0)) ** 2))
    return max(square - 0.5 * (noise.angle_random_walk * interval) ** 2 / usual, 0.0)


@dataclass(frozen=True)
class Threshold:
    """Settings of the threshold filter (Hong and Park, eq. 12)."""

    rate: float = 0.3 * DEGREE  # rad/s; below it the robot is at rest; 0 disables the filter
    window: float = 0.2  # s, of the mean that is compared; 0: single samples, as published
    #: rad/√s; a window whose standard deviation exceeds three times that of this noise is motion,
    #: whatever its mean; 0 disables this test.
    angle_random_walk: float = 0.0


class ThresholdFilter:
    """Set the rate to zero at rest, sample by sample; the caller counts the deleted heading."""

    def __init__(self, settings: Threshold):
        """Begin with an empty window."""
        self.settings = settings
        self._window = deque[tuple[float, float]]()

    def clear(self) -> None:
        """Forget the window, as after a gap."""
        self._window.clear()

    def apply(self, time: float, rate: float) -> float:  # noqa: A003
        """Return the rate, rad/s, or zero; `time` in s increases from call to call."""
        if not self.settings.rate:
            return rate
        window = self._window
        window.append((time, min(max(rate, -MAX_RATE), MAX_RATE)))
        while window[0][0] <= time - self.settings.window and len(window) > 1:
            window.popleft()
        # not a running sum, which would accumulate rounding errors
        rates = [each for _, each in window]
        mean = sum(rates) / len(rates)
        if not abs(mean) < self.settings.rate:
            return rate
        # motion if the window varies by more than the noise
        explained = 9.0 * self.settings.angle_random_walk ** 2 * len(rates)
        variance = sum(each * each for each in rates) / len(rates) - mean * mean
        return rate if 0.0 < explained < variance * (time - window[0][0]) else 0.0

    def apply_to_all(self, time: Array, rate: Array) -> Array:
        """Return the rates of the next n samples, rad/s, or zeros, shape (n,)."""
        return rate if not self.settings.rate else np.array(
            [self.apply(*each) for each in zip(time.tolist(), rate.tolist())])


def integrate(time: Array, rate: Array, begin: float = 0.0) -> Array:
    """Return the heading, rad, shape (n,), by the trapezoid rule, from `begin` on."""
    heading = np.empty(len(time))
    heading[:1] = begin
    for first in range(1, len(time), CACHE_BLOCK_SAMPLES):
        stop = min(first + CACHE_BLOCK_SAMPLES, len(time))
        here, before = slice(first, stop), slice(first - 1, stop - 1)
        turned = rate[here] + rate[before]
        turned *= 0.5
        turned *= time[here] - time[before]
        turned[0] += heading[first - 1]
        np.cumsum(turned, out=heading[here])
    return heading


def integrate_with_curvature(time: Array, rate: Array) -> Array:
    """Return the integral of a rate, corrected for its curvature between samples, shape (n,)."""
    slope = np.gradient(rate, time)
    step = float(np.median(np.diff(time)))
    return integrate(time, rate) - step ** 2 / 12.0 * (slope - slope[0])


class BlockIntegrator:
    """
    Filter and integrate a log block by block, with the same result as in one piece.

    The result is that of a `tracker.HeadingTracker` that does not detect rest. Over a gap longer
    than `MAX_GAP` nothing is integrated: the robot may have turned to any direction.
    """

    def __init__(self, settings: Threshold, noise: Noise, covariance: Array):
        """Begin at heading zero; `covariance` is that of the calibration, shape (m, m)."""
        self._filter, self._noise, self._covariance = ThresholdFilter(settings), noise, covariance
        self._recent: tuple[Array, Array] = np.zeros(0), np.zeros(0)
        self._last_rows: Array = np.zeros((3 + len(covariance), 0))
        self._integrals: Array = np.zeros(3 + len(covariance))
        self._gap_variance, self.intervals = 0.0, Intervals()

    def add(self, time: Array, rate: Array, sensitivity: Array) -> tuple[Array, Array, Array]:
        """
        Take the next block, which may be empty; return three arrays of shape (n,).

        Rates, rad/s, are those before the threshold filter, and the sensitivity, shape (m, n), as
        in `compensation`. Returned are filtered rates, heading and its deviation, rad.
        """
        if not len(time):
            return rate, rate, rate
        filtered = self._filter.apply_to_all(time, rate)
        kept = (filtered == rate).astype(float)
        carried = len(self._recent[0])
        recent = np.append(self._recent[0], time), np.append(self._recent[1], rate)
        time, rate = recent
        begin = np.searchsorted(time, time[-1] - RECENT_DURATION)
        self._recent = time[begin:], rate[begin:]

        # from the last sample of the block before on
        before = min(carried, 1)
        time, rate = time[carried - before:], rate[carried - before:]
        deleted = rate[before:] - filtered
        rows = np.hstack(
            [self._last_rows, np.vstack([filtered, kept, deleted, kept * sensitivity])])
        interval, step, used = np.diff(time), np.diff(rate), rows[1] > 0.0
        usual, lost = self.intervals.add_many(interval)
        is_long = (lost > 0) & (interval > MAX_GAP)
        observed = time - np.cumsum(np.append(0.0, is_long * interval))
        grown = np.array(
            [integrate(observed, row, begin) for row, begin in zip(rows, self._integrals)])
        gaps = np.flatnonzero((lost > 0) & ~is_long & (used[1:] | used[:-1]))
        motion, by_noise = gap_variances(self._noise, usual[gaps], lost[gaps], interval[gaps],
                                         step[gaps])
        begins, ends = (np.searchsorted(recent[0], each) for each in (
            time[gaps] - RECENT_DURATION, time[gaps + 1]))
        varied = [varied_variance(self._noise, *of_gap, *(each[begin:end] for each in recent))
                  for *of_gap, begin, end in zip(usual[gaps], interval[gaps], begins, ends)]
        unseen: Array = np.zeros(len(time))
        unseen[0] = self._gap_variance
        unseen[gaps + 1] = np.maximum(motion, varied) + by_noise
        fastest = np.maximum(np.abs(rate[1:]), np.abs(rate[:-1]))
        unseen[1:][is_long] = (fastest * interval)[is_long] ** 2 + math.tau ** 2
        unseen = np.cumsum(unseen)
        self._last_rows, self._integrals = rows[:, -1:], grown[:, -1]
        self._gap_variance = float(unseen[-1])
        variance = (quadratic_form(self._covariance, grown[3:])
                    + self._noise.heading_variance(grown[1]) + grown[2] ** 2 + unseen)
        return filtered, grown[0, before:], np.sqrt(variance[before:])
