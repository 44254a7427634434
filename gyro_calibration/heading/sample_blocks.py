# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Samples of a log by whole blocks: their sums, and headings where nothing is learned."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from gyro_calibration.heading.gaps import block_ends
from gyro_calibration.heading.kalman import Drift, HEADING, RateIntegral
from gyro_calibration.heading.stationary import BLOCK, WINDOW
from gyro_calibration.logs.log import Array, SHORTEST
import numpy as np

#: A correction of the heading is taken over with this time constant while the robot moves, s.
SETTLING = 1.0
#: Blocks at rest whose samples are compared with the bias at once; it is known anew each second.
_LOOKED_AHEAD = 12


@dataclass(frozen=True)
class Samples:
    """Samples as `HeadingTracker.follow` is given them."""

    time: Array
    rate: Array
    moving: Array
    resting: Array
    wheels: Sequence[bool | None] | None
    still: Array | None

    def still_at(self, place: int) -> Array | None:
        return self.still if self.still is None or self.still.ndim == 1 else self.still[place]

    def sample(self, place: int, resting: bool,
               ) -> tuple[float, float, Array, bool | None, Array | None]:
        """Return what `HeadingTracker.add` wants."""
        return (float(self.time[place]), float(self.rate[place]),
                (self.resting if resting else self.moving)[place],
                None if self.wheels is None else self.wheels[place], self.still_at(place))


@dataclass
class Epoch:
    """
    Samples over which nothing is learned; heading and what is pending of it at the begin, rad.

    Attributes
    ----------
    place : of the sample behind which it begins
    taken : counts the epochs
    opens : behind which samples blocks ended, and what the rates came to since the state
    end : behind its last sample

    """

    place: int
    taken: int
    drift: Drift
    resting: bool
    heading: float
    pending: float
    opens: list[tuple[int, RateIntegral]]
    end: int = -1


class EvenSamples:
    """
    Samples without jumps and gaps, n of them, and their sums by blocks, k of them.

    Attributes
    ----------
    time, rate, intervals, halves, turned : stamps, rates, the intervals before them, half of them,
        and the integrals of the rates over them, shape (n,)
    moving, resting : sensitivities, shape (n, m)
    seen : those that were used, with that of the sample before, shape (n + 1, m)
    begins, ends, whole : of the blocks, and which of them are whole
    sums : duration, integral, share of a pending correction that stays, and sums of the rates,
        their squares, and the squares of their steps, by block
    weighted : integrals of the sensitivities in motion and at rest, shape (k, m) each
    found : what `HeadingTracker.follow` returns
    rested : whether the last sample was taken at rest
    epochs : begun so far

    """

    def __init__(self, given: Samples, where: slice, last: tuple[float, float, float, Array],
                 begun: float, rested: bool, found: Array):
        """Begin behind the last sample, with a block that has begun for some time, s."""
        self._given, self._first, self.rested, self.found = given, where.start, rested, found
        self.time, self.rate = given.time[where], given.rate[where]
        self.moving, self.resting = given.moving[where], given.resting[where]
        count = len(self.time)
        self.intervals = np.diff(self.time, prepend=last[0])
        self.halves, steps = 0.5 * self.intervals, np.diff(self.rate, prepend=last[1])
        self.turned = self.halves * (2.0 * self.rate - steps)
        self.seen = np.empty((count + 1, len(last[3])))
        self.seen[0] = last[3]
        self.ends = block_ends(self.intervals, BLOCK, begun)
        whole = len(self.ends)
        if not self.ends or self.ends[-1] < count:
            self.ends.append(count)
        self.begins = [0, *self.ends[:-1]]
        self.whole = range(bool(begun), whole)
        moving = self._weighted(self.moving)
        self.weighted = moving, (moving if given.resting is given.moving
                                 else self._weighted(self.resting))
        sums = [self._by_blocks(values).tolist() for values in (
            self.intervals, self.turned, self.rate, self.rate * self.rate, steps * steps)]
        self._kept = 1.0 - self.intervals / SETTLING
        sums.insert(2, np.multiply.reduceat(self._kept, self.begins).tolist())
        self.sums = list(zip(*sums))
        self.epochs = list[Epoch]()
        self._extremes: tuple[int, int, list[float], list[float]] = -1, 0, [], []

    def _weighted(self, rows: Array) -> Array:
        before = np.concatenate([self.seen[:1], rows[:-1]])
        return self._by_blocks(self.halves[:, None] * (rows + before))

    def _by_blocks(self, values: Array) -> Array:
        return np.asarray(np.add.reduceat(values, self.begins))

    def moved(self, number: int) -> Sequence[bool | None]:
        """Return what is known of the wheels in a block."""
        wheels = self._given.wheels
        return () if wheels is None else wheels[self._first + self.begins[number]:
                                                self._first + self.ends[number]]

    def still(self, place: int) -> Array | None:
        return self._given.still_at(self._first + place)

    def extremes(self, number: int, offset: float, values: Array,
                 taken: int) -> tuple[float, float]:
        """Return the highest and the lowest corrected rate at rest of a block, rad/s."""
        known, first, highest, lowest = self._extremes
        if known != taken or number >= first + len(highest):
            first, last = number, min(number + _LOOKED_AHEAD, len(self.ends))
            rows = slice(self.begins[first], self.ends[last - 1])
            rate = self.rate[rows] + self.resting[rows] @ values
            rate -= offset
            places = np.array(self.begins[first:last]) - self.begins[first]
            highest, lowest = (which.reduceat(rate, places).tolist()
                               for which in (np.maximum, np.minimum))
            self._extremes = taken, first, highest, lowest
        return highest[number - first], lowest[number - first]

    def close(self, end: int) -> None:
        """Fill in heading and variance up to a sample where the last epoch ends."""
        if not self.epochs:
            return
        epoch = self.epochs[-1]
        begin, epoch.end = max(epoch.place, 0), end
        if end <= begin:
            return
        self.seen[epoch.place + 2:end + 2] = (
            self.resting if epoch.resting else self.moving)[epoch.place + 1:end + 1]
        rows = self.found[begin:end]
        rows[:, 4] = epoch.resting
        if epoch.resting:
            rows[:, 0] = epoch.heading
            rows[:, 1] = float(epoch.drift.covariance[HEADING, HEADING]) + epoch.pending ** 2
            return
        inside, offset, values = slice(epoch.place + 1, end), epoch.drift.offset[0], (
            epoch.drift.values[0])
        pending, turned = (np.empty(end - epoch.place) for _ in range(2))
        intervals = self.intervals[inside]
        pending[0], pending[1:] = epoch.pending, self._kept[inside]
        np.cumprod(pending, out=pending)
        turned[0] = epoch.heading + epoch.pending
        turned[1:] = self.turned[inside] - intervals * offset + self.halves[inside] * (
            (self.seen[1:][inside] + self.seen[:-1][inside]) @ values)
        np.cumsum(turned, out=turned)
        known = epoch.drift.heading_variances([turn for _, turn in epoch.opens])
        places = [place for place, _ in epoch.opens]
        since = np.append(0.0, np.cumsum(intervals))
        block = np.searchsorted(places, np.arange(epoch.place, end), side='right') - 1
        since -= since[np.array(places) - epoch.place][block]
        variance = known[block] + epoch.drift.noise.angle_random_walk ** 2 * since + pending ** 2
        rows[:, 0] = (turned - pending)[begin - epoch.place:]
        rows[:, 1] = variance[begin - epoch.place:]

    def rates(self, usual: Array) -> None:
        """Fill in the rates and their variances; `usual` are the intervals behind each sample."""
        found, interval = self.found, np.clip(np.minimum(self.intervals, usual), SHORTEST, None)
        for epoch in self.epochs:
            here = slice(max(epoch.place, 0), epoch.end)
            (offset, variance), (values, covariance, shared) = (
                epoch.drift.offset, epoch.drift.values)
            rows = self.seen[1:][here]
            found[here, 2] = (0.0 if epoch.resting
                              else self.rate[here] + rows @ values - offset)
            found[here, 3] = (variance + ((rows @ covariance - 2.0 * shared) * rows).sum(axis=1)
                              + epoch.drift.noise.angle_random_walk ** 2
                              / (WINDOW if epoch.resting else interval[here]))
