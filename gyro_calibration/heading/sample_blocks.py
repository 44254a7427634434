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
from gyro_calibration.heading.kalman import Drift, HEADING, heading_variances, RateIntegral
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
        """End the last epoch before a sample."""
        if self.epochs:
            epoch = self.epochs[-1]
            epoch.end = end
            if end > max(epoch.place, 0):
                self.seen[epoch.place + 2:end + 2] = (
                    self.resting if epoch.resting else self.moving)[epoch.place + 1:end + 1]

    def fill(self, usual: Array) -> None:
        """Fill in what was found in the epochs; `usual` are the intervals behind each sample."""
        found, interval = self.found, np.clip(np.minimum(self.intervals, usual), SHORTEST, None)
        moving = list[Epoch]()
        for epoch in self.epochs:
            here = slice(max(epoch.place, 0), epoch.end)
            if here.stop <= here.start:
                continue
            drift, rows = epoch.drift, self.seen[1:][here]
            (offset, variance), (values, covariance, shared) = drift.offset, drift.values
            found[here, 3] = (variance + ((rows @ covariance - 2.0 * shared) * rows).sum(axis=1)
                              + drift.noise.angle_random_walk ** 2
                              / (WINDOW if epoch.resting else interval[here]))
            found[here, 4] = epoch.resting
            if epoch.resting:
                found[here, :3] = epoch.heading, (
                    float(drift.covariance[HEADING, HEADING]) + epoch.pending ** 2), 0.0
                continue
            moving.append(epoch)
            found[here, 2] = self.rate[here] + rows @ values - offset
            pending, turned = np.empty(epoch.end - epoch.place), np.empty(epoch.end - epoch.place)
            inside = slice(epoch.place + 1, epoch.end)
            pending[0], pending[1:] = epoch.pending, self._kept[inside]
            np.cumprod(pending, out=pending)
            turned[0], turned[1:] = epoch.heading + epoch.pending, self.turned[inside]
            turned[1:] += self.halves[inside] * (
                (self.seen[1:][inside] + self.seen[:-1][inside]) @ values - 2.0 * offset)
            np.cumsum(turned, out=turned)
            first = here.start - epoch.place
            found[here, 0] = (turned - pending)[first:]
            found[here, 1] = pending[first:] ** 2
        if moving:
            self._add_variances(moving)

    def _add_variances(self, epochs: list[Epoch]) -> None:
        """Add the variance of the heading in epochs of motion."""
        opens = [(epoch.drift, turn) for epoch in epochs for _, turn in epoch.opens]
        known = heading_variances(*map(list, zip(*opens)))
        white = [drift.noise.angle_random_walk ** 2 for drift, _ in opens]
        places = np.array([place for epoch in epochs for place, _ in epoch.opens])
        until = np.append(np.cumsum(self.intervals), 0.0)  # the last is that of the place -1
        rows = np.concatenate([np.arange(max(epoch.place, 0), epoch.end) for epoch in epochs])
        block = np.searchsorted(places, rows, side='right') - 1
        self.found[rows, 1] += known[block] + np.array(white)[block] * (
            until[rows] - until[places[block]])
