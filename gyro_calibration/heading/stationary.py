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
Detection of rest: energy of the rate against the known noise, and tests of means of the rate.

Each test has its share of the false alarms per hour at rest. A detected rest may be a straight
drive; its probability follows from the scatter of the means. The samples of a log are tested in
whole blocks.

"""

from __future__ import annotations

from bisect import bisect_left, insort
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
import math

from gyro_calibration.heading.gaps import block_ends, CLOSE
from gyro_calibration.heading.kalman import Drift, HEADING, heading_variances, RateIntegral
from gyro_calibration.logs.log import Array, SHORTEST
from gyro_calibration.model.noise import Noise
import numpy as np
from scipy.special import chdtri, ndtri

#: Length of a block of samples, and of the window whose energy is tested, s.
BLOCK, WINDOW = 0.1, 0.5
#: Durations, s, over which the mean of the rate is compared with the bias known before them.
LAGS = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0)
#: Durations, s, over which the scatter of means over 1 s is compared with the noise.
SCATTERED = (4.0, 8.0, 16.0, 32.0, 64.0)
#: Least number of samples in a window.
_SAMPLES = 8
#: Windows in the memory of the noise, least number for its use, and largest ratio to the noise of
#: the model.
_REMEMBERED, _NEEDED, _TRUSTED = 120, 20, 3.0
#: Variances of means over 1 s in a detected rest, in addition to that of white noise and relative
#: to it; the first is that of a rest, the others are those of straight drives.
SCATTERS = np.append(0.0, 4.0 ** np.arange(7))
#: Prior numbers of rests, and of straight drives that pass for rests; largest total of both.
_RESTS, _STRAIGHT, _STRETCHES = 3.0, 1.0, 20.0
#: Threshold per mean for the onset of scatter: the maximum likelihood for a variance of three
#: times that of the noise.
BEGINS = math.log(3.0) / (1.0 - 1.0 / 3.0)


@dataclass(slots=True)
class Block:
    """
    Samples of a short time, as sums.

    Attributes
    ----------
    duration : of its samples, s, without gaps
    count : of samples
    total, squares : of the compensated rate, rad/s and (rad/s)²
    differences : sum of the squared differences of neighbours, (rad/s)²

    """

    duration: float = 0.0
    count: int = 0
    total: float = 0.0
    squares: float = 0.0
    differences: float = 0.0

    def add(self, duration: float, rate: float, before: float) -> None:
        """Add a sample with a duration, s."""
        self.duration += duration
        self.count += 1
        self.total += rate
        self.squares += rate * rate
        self.differences += (rate - before) ** 2


@lru_cache(maxsize=1024)
def sigmas(lag: float, false_alarms: float) -> float:
    """Return the sigmas of a mean over `lag` s that give `false_alarms` per hour at rest."""
    chances = 3600.0 / lag * _OVERLAPPING
    return -float(ndtri(min(0.5 * false_alarms / (_TESTS * chances), 0.25)))


@lru_cache(maxsize=1024)
def _exceeded(freedom: int, chance: float) -> float:
    """Return the value that chi squared exceeds with a probability."""
    return float(chdtri(freedom, chance))


def most_scatter(lag: float, freedom: int, false_alarms: float) -> float:
    """Return the sum of squares of means over `lag` s that gives `false_alarms` per hour."""
    chances = 3600.0 / lag * _OVERLAPPING
    return _exceeded(freedom, min(false_alarms / (_TESTS * chances), 0.5))


#: Number of tests that share the false alarms, and factor of false alarms by overlapping windows.
_TESTS, _OVERLAPPING = len(LAGS) + 2, 3.0


class _Quietest:
    """The 10 % quantile of the last values."""

    def __init__(self) -> None:
        self._seen: deque[float] = deque()
        self._sorted: list[float] = []

    @property
    def count(self) -> int:
        return len(self._sorted)

    def add(self, value: float) -> float:
        """Take the next value; return the quantile of 10 %."""
        if len(self._seen) == _REMEMBERED:
            self._sorted.pop(bisect_left(self._sorted, self._seen.popleft()))
        self._seen.append(value)
        insort(self._sorted, value)
        place = 0.1 * (len(self._sorted) - 1)
        below = int(place)
        low, high = self._sorted[below], self._sorted[min(below + 1, len(self._sorted) - 1)]
        return low + (place - below) * (high - low)


class Energy:
    """
    The energy of the last `WINDOW` s.

    Attributes
    ----------
    factor : ratio of the noise of the samples to that of the model, by the quietest windows; 1
        until there are enough windows

    """

    def __init__(self, noise: Noise, false_alarms: float):
        """Begin with an empty window."""
        self.factor = 1.0
        self._noise = noise
        self._level = false_alarms / (_TESTS * 3600.0 / WINDOW * _OVERLAPPING)
        self._alarms = false_alarms / _OVERLAPPING
        self._blocks: deque[Block] = deque()
        self._energies, self._roughnesses = _Quietest(), _Quietest()
        self._since, self._interval = 0.0, BLOCK
        self._sudden: float | None = None

    def clear(self) -> None:
        """Clear the window, as before rates of another calibration."""
        self._blocks.clear()

    def add(self, block: Block) -> bool | None:
        """Add a block; tell whether the window contains only noise; None until it is full."""
        blocks = self._blocks
        blocks.append(block)
        duration, count = 0.0, 0
        for each in blocks:
            duration += each.duration
            count += each.count
        while (duration - blocks[0].duration >= WINDOW + BLOCK - CLOSE
               and count - blocks[0].count >= _SAMPLES):
            duration -= blocks[0].duration
            count -= blocks.popleft().count
        total = squares = differences = means = 0.0
        for each in blocks:
            total += each.total
            squares += each.squares
            differences += each.differences
            means += each.total * each.total / each.count
        if duration < WINDOW + BLOCK - CLOSE or count < _SAMPLES:
            return None
        self._interval, self._sudden = duration / count, None
        claimed = self._noise.rate_variance(self._interval)
        energy = (squares - total * total / count) / (count - 1)
        self._learn(block.duration, count, energy / claimed, 0.5 * differences / count / claimed)
        claimed *= self.factor ** 2
        if energy >= claimed * _exceeded(count - 1, self._level) / (count - 1):
            return False
        # motion is slower than the samples, so that means over blocks show it far better
        freedom = len(blocks) - 1
        return bool(freedom < 2 or means - total * total / count
                    < claimed * _exceeded(freedom, self._level))

    def _learn(self, duration: float, count: int, energy: float, differences: float) -> None:
        """
        Update the noise of the samples by the quietest tenth of the windows.

        Vibration in a straight drive is not noise; it contributes less to differences of
        neighbours.

        """
        self._since += duration
        if self._since < WINDOW - CLOSE:
            return
        self._since = 0.0
        quietest, rough = self._energies.add(energy), self._roughnesses.add(differences)
        if self._energies.count >= _NEEDED:
            quietest = min(quietest, rough) * (count - 1) / _exceeded(count - 1, 0.9)
            self.factor = math.sqrt(min(max(quietest, 1.0), _TRUSTED ** 2))

    def sudden(self) -> float:
        """
        Return the largest deviation of a single sample at rest, rad/s.

        Its noise is that of the usual interval: late samples and bursts were sampled evenly too.

        """
        if self._sudden is None:
            limit = sigmas(round(self._interval, 9), self._alarms)
            self._sudden = limit * self.factor * math.sqrt(
                self._noise.rate_variance(self._interval))
        return self._sudden


@dataclass(frozen=True)
class Snapshot:
    """
    State at some time during a rest.

    Attributes
    ----------
    drift, deleted, steps : the state, the heading deleted until then, rad, and number of steps
    turn : integral of the rates since the rest began
    squares, means : sum of the squared normalized innovations since it began, and their number
    likelihood : log-likelihood of their scatter for each of `SCATTERS`, shape (k,)

    """

    drift: Drift
    turn: RateIntegral
    deleted: float
    steps: int
    squares: float = 0.0
    means: int = 0
    likelihood: Array = field(default_factory=lambda: np.zeros(len(SCATTERS)))


@dataclass
class StraightDrives:
    """
    Distribution of the scatter of the rates in detected rests.

    Attributes
    ----------
    counts : number of rests with each of `SCATTERS`, shape (k,)

    """

    counts: Array = field(default_factory=lambda: np.append(
        _RESTS, np.full(len(SCATTERS) - 1, _STRAIGHT / (len(SCATTERS) - 1))))

    def chances(self, likelihood: Array) -> Array:
        """Return the probability of each scatter, shape (k,)."""
        chances = self.counts * np.exp(likelihood - likelihood.max())
        return np.asarray(chances / chances.sum())

    def learn(self, last: Snapshot) -> None:
        """Add a detected rest that has ended."""
        kept = _STRETCHES / max(_STRETCHES, float(self.counts.sum()))
        self.counts = kept * self.counts + self.chances(last.likelihood)


@dataclass
class SlowTurn:
    """
    A turn that was detected late, and is so slow that it may be a change of the bias.

    Attributes
    ----------
    before : the state when it began
    rate : of the turn, rad/s
    turn : integral of the rates since then

    """

    before: Snapshot
    rate: float
    turn: RateIntegral


#: Time constant with which a pending correction of the heading is applied in motion, s.
SETTLING = 1.0
#: Blocks at rest whose samples are compared with one estimate of the bias.
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
        """Return the arguments of `HeadingTracker.add`."""
        return (float(self.time[place]), float(self.rate[place]),
                (self.resting if resting else self.moving)[place],
                None if self.wheels is None else self.wheels[place], self.still_at(place))


@dataclass
class Epoch:
    """
    Samples with one state; heading and pending correction at the begin, rad.

    Attributes
    ----------
    place : index of the sample before its first
    taken : number of the state
    opens : last samples of its blocks, and integrals of the rates since the state
    end : index after its last sample

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
    n samples without jumps and gaps, and their sums over k blocks.

    Attributes
    ----------
    time, rate, intervals, halves, turned : stamps, rates, the intervals before them, half of them,
        and the integrals of the rates over them, shape (n,)
    moving, resting : sensitivities, shape (n, m)
    seen : the sensitivities used, first that of the sample before, shape (n + 1, m)
    begins, ends, whole : first samples and ends of the blocks, and range of complete blocks
    sums : duration, integral, remaining share of a pending correction, and sums of the rates,
        their squares, and the squares of their steps, by block
    weighted : integrals of the sensitivities in motion and at rest, shape (k, m) each
    found : the result of `HeadingTracker.follow`
    rested : whether the last sample was at rest
    epochs : so far

    """

    def __init__(self, given: Samples, where: slice, last: tuple[float, float, float, Array],
                 begun: float, rested: bool, found: Array):
        """Begin after the last sample, with an elapsed duration of the first block, s."""
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
        """Return whether wheels moved the robot, for the samples of a block."""
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
        """Compute the results of the epochs; `usual` are the usual intervals at each sample."""
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
