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

from gyro_calibration.logs.log import Array, SHORTEST
from gyro_calibration.model.noise import Noise
import numpy as np

#: Length of the shortest blocks whose means are compared, s, and the number of lengths, each twice
#: the previous one.
_BLOCK, _LEVELS = 0.1, 3
#: Memory of the statistics, s; for long blocks, in blocks.
_MEMORY, _BLOCKS = 2.0, 5
#: Ratio of the variance after a gap of T to T² E(c²), for points and for means over blocks:
#: between Brownian motion, with 1/3 and 2/3, and a rate of constant curvature, with 4/9 for both.
_OF_POINTS, _OF_MEANS = 0.4, 0.5
#: Ratio of a step over a gap to the usual one, above which it did not occur in the last seconds:
#: the robot began to turn, or stopped.
_UNMET = 5.0
#: Tolerance of durations, s: the resolution of stamps in seconds since 1970.
CLOSE = 1e-6
#: Largest rate, rad/s, and gap, s, so that the variance after a gap is finite.
FASTEST, LONGEST = 1e4, 1e9
#: Number of intervals in the memory, and least number for the detection of a gap.
_REMEMBERED, _NEEDED = 256, 16
#: Least ratio of a gap to the usual interval; largest ratio of an interval in a burst, or after a
#: late sample.
_GAP, _SHORT = 1.5, 0.5
#: Stamps in bursts have more than this share of short intervals, or a mean interval of so many
#: times the median.
_BURSTS, _TOGETHER = 0.1, 2.0


@dataclass(frozen=True)
class Gap:
    """
    A gap in the samples.

    Attributes
    ----------
    lost : number of samples
    duration : of the lost samples, s
    motion : variance of the heading by deviations of the rate from the straight line, rad²
    noise : additional variance of the heading by the noise of the samples at the ends, rad²

    """

    lost: int
    duration: float
    motion: float
    noise: float

    @property
    def variance(self) -> float:
        """Return the variance of the heading by motion and noise, rad²."""
        return self.motion + self.noise


class Intervals:
    """
    The usual interval of stamps that may jitter or come in bursts, and the samples lost in others.

    Attributes
    ----------
    usual : s; inf while it is not known
    lost : samples lost so far
    longest : gap, s; 0 where there was none

    """

    def __init__(self) -> None:
        """Begin with nothing known."""
        self.usual, self.lost, self.longest = math.inf, 0, 0.0
        self._seen: deque[float] = deque(maxlen=_REMEMBERED)
        self._until, self._limit, self._even, self._late = _NEEDED, math.inf, math.inf, 0

    def add(self, interval: float) -> int:
        """Take the next interval, s; return how many samples are lost in it."""
        self._seen.append(interval)
        self._until -= 1
        if not self._until:
            self._look()
        return self.count(interval)

    def add_many(self, intervals: Array) -> tuple[Array, int]:
        """
        Take intervals, s, as `add` does one by one, up to the first with a lost sample.

        Returns
        -------
        the usual interval behind each that was taken, s, and how many samples the last has lost

        """
        taken, usual = 0, np.empty(len(intervals))
        while taken < len(intervals):
            first, part = taken, intervals[taken:taken + max(self._until - 1, 1)]
            if self._late or self._until == 1 or part[0] > self._limit:
                taken, lost = taken + 1, self.add(float(part[0]))
                usual[first] = self.usual
                if lost:
                    return usual[:taken], lost
                continue
            even = part <= self._limit
            if not even.all():
                part = part[:int(np.argmin(even))]
            self._seen.extend(part.tolist())
            self._until -= len(part)
            taken += len(part)
            usual[first:taken] = self.usual
        return usual, 0

    def count(self, interval: float) -> int:
        """
        Return how many samples are lost in an interval, s, and count them.

        Called alone for an interval that is not integrated, which is excluded from the usual one.

        """
        if interval > self._limit:
            self._late = max(round((interval - self._even) / self.usual), 1)
            self.lost += self._late
            self.longest = max(self.longest, interval)
            return self._late
        if self._late and interval < _SHORT * self.usual:  # late, not lost
            self._late -= 1
            self.lost -= 1
        else:
            self._late = 0
        return 0

    def _look(self) -> None:
        """Find the usual interval: the median, unless the stamps come in bursts."""
        self._until = max(len(self._seen) // 4, _NEEDED)
        steps = sorted(self._seen)
        middle = self._even = self.usual = max(steps[len(steps) // 2], SHORTEST)
        if (sum(steps) > _TOGETHER * middle * len(steps)
                or bisect_left(steps, _SHORT * middle) > _BURSTS * len(steps)):
            # the longest may be gaps
            self._even = steps[-1 - len(steps) // 100]
            self.usual = max(sum(min(step, self._even) for step in steps) / len(steps), SHORTEST)
        self._limit = self._even + (_GAP - 1.0) * self.usual


class _Level:
    """
    Means over blocks of one length, and their second and first differences.

    Attributes
    ----------
    length : of a block, s
    curved : mean square of the deviation from the line between the neighbours, (rad/s)²
    stepped : mean square of the differences of neighbours, (rad/s)²

    """

    def __init__(self, length: float):
        self.length, self.curved, self.stepped = length, 0.0, 0.0
        self._weight = max(length / _MEMORY, 1.0 / _BLOCKS)
        self._last, self._step, self._odd, self._known = 0.0, 0.0, 0.0, 0

    def without_noise(self, density: float) -> tuple[float, float]:
        """Return both mean squares less those of white noise of a density, rad²/s."""
        return (max(self.curved - 1.5 * density / self.length, 0.0),
                max(self.stepped - 2.0 * density / self.length, 0.0))

    def clear(self) -> None:
        """Forget the last blocks, as after a gap."""
        self._known = 0

    def add(self, mean: float) -> float | None:
        """Take the next block, and return the mean of two, if they are complete."""
        step = mean - self._last
        if self._known > 0:
            self.stepped += self._weight * (step * step - self.stepped)
        if self._known > 1:
            self.curved += self._weight * (0.25 * (step - self._step) ** 2 - self.curved)
        self._last, self._step, self._known = mean, step, self._known + 1
        if self._known % 2:
            self._odd = mean
            return None
        return 0.5 * (self._odd + mean)


class Gaps:
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
        self._levels = [_Level(_BLOCK * 2 ** level) for level in range(_LEVELS)]
        self._curved = self._stepped = 0.0
        self.clear()

    def clear(self) -> None:
        """Forget the last rates, as after a time without any."""
        for level in self._levels:
            level.clear()
        self._begin_block()
        self._surplus = self._step = 0.0

    def _begin_block(self) -> None:
        self._duration, self._count, self._total, self._steps, self._squares, self._products = (
            0.0, 0, 0.0, 0, 0.0, 0.0)

    def add(self, interval: float, rate: float, before: float,
            lost: int | None = None) -> Gap | None:
        """
        Take a sample that came `interval` s after the one before.

        Parameters
        ----------
        interval : s
        rate, before : of this sample and of the one before, rad/s
        lost : samples between them, where the `intervals` have taken this one already

        Returns
        -------
        the gap between them, if samples are lost

        """
        if lost is None:
            lost = self.intervals.add(interval)
        if lost:
            gap = self._gap(lost, interval, rate - before)
            self._surplus = gap.duration
            self._step = 0.0
            if interval > _BLOCK:
                self._begin_block()
                for level in self._levels:
                    level.clear()
                return gap
        else:
            gap, step = None, rate - before
            self._steps += 1
            self._squares += step * step
            self._products += step * self._step
            self._step, self._surplus = step, 0.0
        self._count += 1
        self._total += rate
        self._duration += interval
        if self._duration >= _BLOCK - CLOSE:
            self._learn()
        return gap

    def add_many(self, intervals: Array, rates: Array, before: float) -> None:
        """Take samples without a gap, which the `intervals` have taken already."""
        steps = np.diff(rates, prepend=before)
        squares, products = steps * steps, steps * np.append(self._step, steps[:-1])
        begin, ends = 0, block_ends(intervals, _BLOCK, self._duration)
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
            if self._duration >= _BLOCK - CLOSE:
                self._learn()
            begin = end
        self._step, self._surplus = float(steps[-1]), 0.0

    def _learn(self) -> None:
        """Update the statistics at the end of a block."""
        mean: float | None = min(max(self._total / self._count, -FASTEST), FASTEST)
        if self._steps and self._squares < FASTEST ** 2:
            weight = self._duration / (_MEMORY + self._duration)
            self._stepped += weight * (self._squares / self._steps - self._stepped)
            self._curved += weight * (
                max(0.5 * (self._squares - self._products) / self._steps, 0.0) - self._curved)
        for level in self._levels:
            if mean is None:
                break
            mean = level.add(mean)
        self._begin_block()

    def _gap(self, lost: int, interval: float, step: float) -> Gap:
        usual, step, interval = (
            self.intervals.usual, min(abs(step), FASTEST), min(interval, LONGEST))
        surplus = min(lost * usual, interval)
        ends = self.noise.angle_random_walk ** 2 / usual
        noise = ends * (surplus * (0.5 * surplus + usual) + 0.5 * self._surplus * surplus)
        # a step larger than those before may have occurred at any time within the gap
        unmet = max(step * step - _UNMET ** 2
                    * (_between(self._steps_seen(), interval, 2.0) + 2.0 * ends), 0.0)
        return Gap(lost, surplus, interval ** 2 * (
            _between(self._curves_seen(), 0.5 * interval, 4.0) + unmet / 12.0), noise)

    def _curves_seen(self) -> list[tuple[float, float]]:
        """Return lengths, s, and the variance by curvature without noise, (rad/s)²."""
        density, usual = self.noise.angle_random_walk ** 2, self.intervals.usual
        points = [(usual, _OF_POINTS * max(self._curved - 1.5 * density / usual, 0.0))]
        return points + [(each.length, _OF_MEANS * each.without_noise(density)[0])
                         for each in self._levels[usual > 0.5 * _BLOCK:]]

    def _steps_seen(self) -> list[tuple[float, float]]:
        """Return lengths, s, and the mean squares of steps without noise, (rad/s)²."""
        density, usual = self.noise.angle_random_walk ** 2, self.intervals.usual
        points = [(usual, max(self._stepped - 2.0 * density / usual, 0.0))]
        return points + [(each.length, each.without_noise(density)[1])
                         for each in self._levels if each.length > usual]


def block_ends(intervals: Array, length: float, begun: float = 0.0) -> list[int]:
    """
    Return the numbers of samples up to the ends of blocks of `length` s or slightly longer.

    Parameters
    ----------
    intervals : before each sample, s
    length : s
    begun : elapsed duration of the first block, s

    """
    until, ends = np.cumsum(intervals).tolist(), list[int]()
    target, place = length - CLOSE - begun, 0
    while (place := bisect_left(until, target, place)) < len(until):
        target = until[place] + length - CLOSE
        place += 1
        ends.append(place)
    return ends


def _between(known: list[tuple[float, float]], length: float, steepest: float) -> float:
    """Return a quantity at a length, by power laws between those at increasing lengths."""
    if len(known) == 1:  # the sample interval is longer than all blocks
        return known[0][1]
    (near, low), (far, high) = next(((below, above) for below, above in zip(known, known[1:])
                                     if length <= above[0]), known[-2:])
    if high <= 0.0:
        return low
    power = min(math.log(high / low) / math.log(far / near), steepest) if low > 0.0 else steepest
    return high * (length / far) ** power
