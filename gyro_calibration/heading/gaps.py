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
Uncertainty of the heading over gaps, where samples are lost.

The rate is interpolated linearly over a gap. The uncertainty of this is estimated from the
deviation of the samples of the last seconds from the line between their neighbours, over intervals
h up to 0.4 s: c = r(t) - (r(t - h) + r(t + h)) / 2. Its mean square is q h / 2 for a Brownian
motion, whose integral over a gap of T = 2 h has the variance q T³ / 12 = T² / 3 E(c²). Means over
neighbouring blocks of length h have half of that mean square.

The integral over a gap depends on the two samples at its ends alone, each with the noise N² / dt,
so that its variance is T² N² / (2 dt) instead of N² T.

"""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from dataclasses import dataclass
import math

from gyro_calibration.logs.log import Array, MIN_SAMPLE_INTERVAL
from gyro_calibration.model.noise import Noise
import numpy as np

#: Length of the shortest blocks whose means are compared, s, and the number of lengths, each twice
#: the previous one.
_BLOCK_DURATION, _LEVEL_COUNT = 0.1, 3
#: Memory of the statistics, s; for long blocks, in blocks.
_MEMORY_DURATION, _MEMORY_BLOCKS = 2.0, 5
#: Ratio of the variance after a gap of T to T² E(c²), for points and for means over blocks:
#: between Brownian motion, with 1/3 and 2/3, and a rate of constant curvature, with 4/9 for both.
_POINT_VARIANCE_SHARE, _MEAN_VARIANCE_SHARE = 0.4, 0.5
#: Ratio of a step over a gap to the usual one, above which it did not occur in the last seconds:
#: the robot began to turn, or stopped.
_NEW_STEP_RATIO = 5.0
#: Tolerance of durations, s: the resolution of stamps in seconds since 1970.
TIME_TOLERANCE = 1e-6
#: Largest rate, rad/s, and gap, s, so that the variance after a gap is finite.
MAX_RATE, MAX_GAP = 1e4, 1e9
#: Number of intervals in the memory, and least number for the detection of a gap.
_MAX_INTERVALS, _MIN_INTERVALS = 256, 16
#: Least ratio of a gap to the usual interval; largest ratio of an interval in a burst, or after a
#: late sample.
_GAP_RATIO, _BURST_RATIO = 1.5, 0.5
#: Stamps in bursts have more than this share of short intervals, or a mean interval of so many
#: times the median.
_MIN_BURST_SHARE, _BURST_MEAN_RATIO = 0.1, 2.0


@dataclass(frozen=True)
class Gap:
    """
    A gap in the samples.

    Attributes
    ----------
    lost_samples : number of samples
    duration : of the lost samples, s
    motion_variance : variance of the heading by deviations of the rate from the straight line,
        rad²
    noise_variance : additional variance of the heading by the noise of the samples at the ends,
        rad²

    """

    lost_samples: int
    duration: float
    motion_variance: float
    noise_variance: float

    @property
    def variance(self) -> float:
        """Return the variance of the heading by motion and noise, rad²."""
        return self.motion_variance + self.noise_variance


class Intervals:
    """
    The usual interval of stamps that may jitter or come in bursts, and the samples lost in others.

    Attributes
    ----------
    usual_interval : s; inf while it is not known
    lost_samples : samples lost so far
    longest_gap : gap, s; 0 where there was none

    """

    def __init__(self) -> None:
        """Begin with nothing known."""
        self.usual_interval, self.lost_samples, self.longest_gap = math.inf, 0, 0.0
        self._history: deque[float] = deque(maxlen=_MAX_INTERVALS)
        self._until_update, self._gap_limit = _MIN_INTERVALS, math.inf
        self._even_interval, self._late_samples = math.inf, 0

    def add(self, interval: float) -> int:
        """Take the next interval, s; return how many samples are lost in it."""
        self._history.append(interval)
        self._until_update -= 1
        if not self._until_update:
            self._update_usual_interval()
        return self.count_lost(interval)

    def add_many(self, intervals: Array) -> tuple[Array, int]:
        """
        Take intervals, s, as `add` does one by one, up to the first with a lost sample.

        Returns
        -------
        the usual interval behind each that was taken, s, and how many samples the last has lost

        """
        taken, usual = 0, np.empty(len(intervals))
        while taken < len(intervals):
            first, part = taken, intervals[taken:taken + max(self._until_update - 1, 1)]
            if self._late_samples or self._until_update == 1 or part[0] > self._gap_limit:
                taken, lost = taken + 1, self.add(float(part[0]))
                usual[first] = self.usual_interval
                if lost:
                    return usual[:taken], lost
                continue
            even = part <= self._gap_limit
            if not even.all():
                part = part[:int(np.argmin(even))]
            self._history.extend(part.tolist())
            self._until_update -= len(part)
            taken += len(part)
            usual[first:taken] = self.usual_interval
        return usual, 0

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
        if self._late_samples and interval < _BURST_RATIO * self.usual_interval:  # late, not lost
            self._late_samples -= 1
            self.lost_samples -= 1
        else:
            self._late_samples = 0
        return 0

    def _update_usual_interval(self) -> None:
        """Find the usual interval: the median, unless the stamps come in bursts."""
        self._until_update = max(len(self._history) // 4, _MIN_INTERVALS)
        steps = sorted(self._history)
        middle = self._even_interval = self.usual_interval = max(
            steps[len(steps) // 2], MIN_SAMPLE_INTERVAL)
        if (sum(steps) > _BURST_MEAN_RATIO * middle * len(steps)
                or bisect_left(steps, _BURST_RATIO * middle) > _MIN_BURST_SHARE * len(steps)):
            # the longest may be gaps
            self._even_interval = steps[-1 - len(steps) // 100]
            mean = sum(min(step, self._even_interval) for step in steps) / len(steps)
            self.usual_interval = max(mean, MIN_SAMPLE_INTERVAL)
        self._gap_limit = self._even_interval + (_GAP_RATIO - 1.0) * self.usual_interval


class _Level:
    """
    Means over blocks of one length, and their second and first differences.

    Attributes
    ----------
    length : of a block, s
    curvature_square : mean square of the deviation from the line between the neighbours, (rad/s)²
    step_square : mean square of the differences of neighbours, (rad/s)²

    """

    def __init__(self, length: float):
        self.length, self.curvature_square, self.step_square = length, 0.0, 0.0
        self._weight = max(length / _MEMORY_DURATION, 1.0 / _MEMORY_BLOCKS)
        self._last_mean, self._last_step, self._odd_mean, self._block_count = 0.0, 0.0, 0.0, 0

    def without_noise(self, density: float) -> tuple[float, float]:
        """Return both mean squares less those of white noise of a density, rad²/s."""
        return (max(self.curvature_square - 1.5 * density / self.length, 0.0),
                max(self.step_square - 2.0 * density / self.length, 0.0))

    def clear(self) -> None:
        """Forget the last blocks, as after a gap."""
        self._block_count = 0

    def add(self, mean: float) -> float | None:
        """Take the next block, and return the mean of two, if they are complete."""
        step = mean - self._last_mean
        if self._block_count > 0:
            self.step_square += self._weight * (step * step - self.step_square)
        if self._block_count > 1:
            self.curvature_square += (
                self._weight * (0.25 * (step - self._last_step) ** 2 - self.curvature_square))
        self._last_mean, self._last_step, self._block_count = mean, step, self._block_count + 1
        if self._block_count % 2:
            self._odd_mean = mean
            return None
        return 0.5 * (self._odd_mean + mean)


class GapModel:
    """
    Uncertainty over gaps, estimated from stamps and rates.

    Attributes
    ----------
    intervals : of the stamps
    noise : of the gyro

    """

    def __init__(self, noise: Noise):
        """Begin with nothing known."""
        self.intervals, self.noise = Intervals(), noise
        self._levels = [_Level(_BLOCK_DURATION * 2 ** level) for level in range(_LEVEL_COUNT)]
        self._curvature_square = self._step_square = 0.0
        self.clear()

    def clear(self) -> None:
        """Forget the last rates, as after a time without any."""
        for level in self._levels:
            level.clear()
        self._begin_block()
        self._lost_duration = self._last_step = 0.0

    def _begin_block(self) -> None:
        self._count = self._steps = 0
        self._duration = self._total = self._squares = self._products = 0.0

    def add(self, interval: float, rate: float, rate_before: float,
            lost: int | None = None) -> Gap | None:
        """
        Take a sample that came `interval` s after the one before.

        Parameters
        ----------
        interval : s
        rate, rate_before : of this sample and of the one before, rad/s
        lost : samples between them, where the `intervals` have taken this one already

        Returns
        -------
        the gap between them, if samples are lost

        """
        if lost is None:
            lost = self.intervals.add(interval)
        if lost:
            gap = self._make_gap(lost, interval, rate - rate_before)
            self._lost_duration, self._last_step = gap.duration, 0.0
            if interval > _BLOCK_DURATION:
                self._begin_block()
                for level in self._levels:
                    level.clear()
                return gap
        else:
            gap, step = None, rate - rate_before
            self._steps += 1
            self._squares += step * step
            self._products += step * self._last_step
            self._last_step, self._lost_duration = step, 0.0
        self._count += 1
        self._total += rate
        self._duration += interval
        if self._duration >= _BLOCK_DURATION - TIME_TOLERANCE:
            self._finish_block()
        return gap

    def add_many(self, intervals: Array, rates: Array, rate_before: float) -> None:
        """Take samples without a gap, which the `intervals` have taken already."""
        steps = np.diff(rates, prepend=rate_before)
        squares, products = steps * steps, steps * np.append(self._last_step, steps[:-1])
        begin, ends = 0, block_ends(intervals, _BLOCK_DURATION, self._duration)
        starts = [0, *ends[:-1]] if ends and ends[-1] == len(rates) else [0, *ends]
        sums = zip(*(np.add.reduceat(values, starts).tolist()
                     for values in (rates, squares, products, intervals)))
        for end, (total, squared, multiplied, duration) in zip([*ends, len(rates)], sums):
            self._count += end - begin
            self._steps += end - begin
            self._total += total
            self._squares += squared
            self._products += multiplied
            self._duration += duration
            if self._duration >= _BLOCK_DURATION - TIME_TOLERANCE:
                self._finish_block()
            begin = end
        self._last_step, self._lost_duration = float(steps[-1]), 0.0

    def _finish_block(self) -> None:
        """Update the statistics at the end of a block."""
        mean: float | None = min(max(self._total / self._count, -MAX_RATE), MAX_RATE)
        if self._steps and self._squares < MAX_RATE ** 2:
            weight = self._duration / (_MEMORY_DURATION + self._duration)
            self._step_square += weight * (self._squares / self._steps - self._step_square)
            curvature = max(0.5 * (self._squares - self._products) / self._steps, 0.0)
            self._curvature_square += weight * (curvature - self._curvature_square)
        for level in self._levels:
            if mean is None:
                break
            mean = level.add(mean)
        self._begin_block()

    def _make_gap(self, lost: int, interval: float, step: float) -> Gap:
        usual, step = self.intervals.usual_interval, min(abs(step), MAX_RATE)
        interval = min(interval, MAX_GAP)
        surplus = min(lost * usual, interval)
        ends = self.noise.angle_random_walk ** 2 / usual
        noise = ends * (surplus * (0.5 * surplus + usual) + 0.5 * self._lost_duration * surplus)
        # a step larger than those before may have occurred at any time within the gap
        usual_square = _interpolate_power_law(self._steps_by_length(), interval, 2.0) + 2.0 * ends
        new_square = max(step * step - _NEW_STEP_RATIO ** 2 * usual_square, 0.0)
        curvature = _interpolate_power_law(self._curvatures_by_length(), 0.5 * interval, 4.0)
        return Gap(lost, surplus, interval ** 2 * (curvature + new_square / 12.0), noise)

    def _curvatures_by_length(self) -> list[tuple[float, float]]:
        """Return lengths, s, and the variance by curvature without noise, (rad/s)²."""
        density, usual = self.noise.angle_random_walk ** 2, self.intervals.usual_interval
        curvature = max(self._curvature_square - 1.5 * density / usual, 0.0)
        return [(usual, _POINT_VARIANCE_SHARE * curvature),
                *((each.length, _MEAN_VARIANCE_SHARE * each.without_noise(density)[0])
                  for each in self._levels[usual > 0.5 * _BLOCK_DURATION:])]

    def _steps_by_length(self) -> list[tuple[float, float]]:
        """Return lengths, s, and the mean squares of steps without noise, (rad/s)²."""
        density, usual = self.noise.angle_random_walk ** 2, self.intervals.usual_interval
        return [(usual, max(self._step_square - 2.0 * density / usual, 0.0)),
                *((each.length, each.without_noise(density)[1])
                  for each in self._levels if each.length > usual)]


def block_ends(intervals: Array, length: float, elapsed: float = 0.0) -> list[int]:
    """
    Return the numbers of samples up to the ends of blocks of `length` s or slightly longer.

    Parameters
    ----------
    intervals : before each sample, s
    length : s
    elapsed : elapsed duration of the first block, s

    """
    until, ends = np.cumsum(intervals).tolist(), list[int]()
    target, place = length - TIME_TOLERANCE - elapsed, 0
    while (place := bisect_left(until, target, place)) < len(until):
        target = until[place] + length - TIME_TOLERANCE
        place += 1
        ends.append(place)
    return ends


def _interpolate_power_law(quantities: list[tuple[float, float]], length: float,
                           max_power: float) -> float:
    """Return a quantity at a length, by power laws between those at increasing lengths."""
    if len(quantities) == 1:  # the sample interval is longer than all blocks
        return quantities[0][1]
    (near, low), (far, high) = next(
        ((below, above) for below, above in zip(quantities, quantities[1:]) if length <= above[0]),
        quantities[-2:])
    if high <= 0.0:
        return low
    power = min(math.log(high / low) / math.log(far / near), max_power) if low > 0.0 else max_power
    return high * (length / far) ** power
