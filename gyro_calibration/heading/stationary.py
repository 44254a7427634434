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

from collections import deque
from collections.abc import Sequence
from dataclasses import astuple, dataclass, field
from functools import lru_cache
import math

from gyro_calibration.heading.integration import block_ends, TIME_TOLERANCE
from gyro_calibration.heading.kalman import (
    HEADING_INDEX, heading_variances, HeadingState, RateIntegral, TrackStep)
from gyro_calibration.logs.log import Array, MIN_SAMPLE_INTERVAL
from gyro_calibration.model.noise import Noise
import numpy as np
from scipy.special import chdtri, ndtri

#: Length of a block of samples, and of the window whose energy is tested, s.
BLOCK_DURATION, WINDOW_DURATION = 0.1, 0.5
#: Durations, s, over which the mean of the rate is compared with the bias known before them.
MEAN_LAGS = tuple((2.0 ** np.arange(7)).tolist())
#: Least number of samples in a window.
_MIN_WINDOW_SAMPLES = 8
#: Windows in the memory of the noise, least number for its use, and largest ratio to the noise of
#: the model, unless wheels show that it is that of rests.
_MAX_WINDOWS, _MIN_WINDOWS, _MAX_NOISE_FACTOR = 120, 20, 3.0
#: Variances of means over 1 s in a detected rest, in addition to that of white noise and relative
#: to it, correlations of neighbours, and variances of blocks about these means: first those of a
#: rest, then those of straight drives, up to bends that keep their rate for many minutes.
#: With variances beyond `MAX_SCATTER_RATIO` times that of white noise or of the bias, most means
#: over 1 s are beyond the limit of `mean_threshold_sigmas`, and most windows beyond that of the
#: energy. The largest is that of 0.5 deg/s and a fibre optic gyro.
SCATTER_RATIOS, SCATTER_CORRELATIONS, BLOCK_RATIOS = np.array(
    [(0.0, 0.0, 0.0), *((ratio, shared, fast) for ratio in 4.0 ** np.arange(11)
                        for shared in (0.0, *np.exp(-1.0 / np.array([4.0, 64.0, 1024.0])))
                        for fast in (0.0, 1.0, 4.0))]).T
MAX_SCATTER_RATIO = 64.0
#: Prior numbers of rests, 3, and of straight drives that pass for rests with a known bias, 1, all
#: of which are as probable; largest total.
PRIOR_COUNTS = np.full(
    len(SCATTER_RATIOS), 1.0 / np.sum(SCATTER_RATIOS[1:] <= MAX_SCATTER_RATIO))
PRIOR_COUNTS[0] = 3.0
_MAX_STRETCHES = 20.0
#: Rates at which a straight way ends, 1/s, on average after the longest lag; a rest may last.
ENDING_RATES = (SCATTER_RATIOS > 0.0) / MEAN_LAGS[-1]
#: Number of tests that share the false alarms, and factor of false alarms by overlapping windows.
_TEST_COUNT, _OVERLAP_FACTOR = len(MEAN_LAGS) + 2, 3.0
#: Time constant with which a pending correction of the heading is applied in motion, s.
CORRECTION_TIME = 1.0


@dataclass(slots=True)
class Block:
    """Samples of a short time, as sums."""

    duration: float = 0.0  # of its samples, s, without gaps
    count: int = 0
    rate_sum: float = 0.0  # of the compensated rate, rad/s
    square_sum: float = 0.0  # (rad/s)²
    difference_square_sum: float = 0.0  # of squared differences of neighbours, (rad/s)²

    def add(self, duration: float, rate: float, rate_before: float) -> None:
        """Add a sample with a duration, s."""
        self.duration += duration
        self.count += 1
        self.rate_sum += rate
        self.square_sum += rate * rate
        self.difference_square_sum += (rate - rate_before) ** 2


@lru_cache(maxsize=1024)
def mean_threshold_sigmas(lag: float, false_alarms: float) -> float:
    """Return the sigmas of a mean over `lag` s that give `false_alarms` per hour at rest."""
    chances = 3600.0 / lag * _OVERLAP_FACTOR
    return -float(ndtri(min(0.5 * false_alarms / (_TEST_COUNT * chances), 0.25)))


@lru_cache(maxsize=1024)
def _chi_squared_quantile(degrees_of_freedom: int, chance: float) -> float:
    return float(chdtri(degrees_of_freedom, chance))


def scatters_as_noise(turn: RateIntegral, noise: Noise, chance: float) -> bool:
    """Tell whether the blocks of an integral scatter as white noise, which exceeds by chance."""
    freedom = turn.block_count - 1
    return freedom < 1 or (
        turn.block_square_sum - turn.angle ** 2 / turn.duration
        <= noise.angle_random_walk ** 2 * _chi_squared_quantile(freedom, chance))


class EnergyDetector:
    """The energy of the last `WINDOW_DURATION` s."""

    def __init__(self, noise: Noise, false_alarms: float):
        """Begin with an empty window."""
        # ratio of the noise of the samples to that of the model, by the quietest windows, and the
        # largest deviation of a single sample at rest, rad/s
        self.noise_factor, self.sudden_limit = 1.0, math.inf
        self._blocks: Array = np.zeros((5, 0))  # rows of `Block`
        self._ratios = deque[tuple[float, float]](maxlen=_MAX_WINDOWS)
        self._since_last_window = 0.0
        # of the next blocks: quiet, noise factor, and limit of the samples after it, rad/s
        self._results = deque[tuple[bool | None, float, float]]()
        self.configure(noise, false_alarms)

    def configure(self, noise: Noise, false_alarms: float) -> None:
        """Go on with other settings."""
        self._noise = noise
        self._false_alarm_chance = (
            false_alarms / (_TEST_COUNT * 3600.0 / WINDOW_DURATION * _OVERLAP_FACTOR))
        self._sample_false_alarms = false_alarms / _OVERLAP_FACTOR

    def clear(self) -> None:
        """Clear the window, as before rates of another calibration."""
        self._blocks = self._blocks[:, :0]
        self._results.clear()

    def add(self, block: Block, wheels: bool | None) -> bool | None:
        """
        Add a block; tell whether the window contains only noise; None until it is full.

        Given is whether wheels moved in the block, None where unknown.
        """
        if not self._results:
            self.look_ahead(np.array([astuple(block)]).T, [wheels])
        quiet, self.noise_factor, self.sudden_limit = self._results.popleft()
        return quiet

    def _next_noise_factor(self, factor: float, stands: bool, duration: float,
                           count: float, energy: float, differences: float) -> float:
        """Return the noise of the samples by the quietest tenth of the windows, after a block."""
        # Vibration in a straight drive is not noise; it contributes less to differences of
        # neighbours. The noise of standing wheels may be that of a fan.
        self._since_last_window += duration
        if self._since_last_window < WINDOW_DURATION - TIME_TOLERANCE:
            return factor
        self._since_last_window = 0.0
        self._ratios.append((energy, differences))
        if len(self._ratios) < _MIN_WINDOWS:
            return factor
        quietest = min(sorted(each)[len(each) // 10] for each in zip(*self._ratios))
        quietest *= (count - 1) / _chi_squared_quantile(round(count) - 1, 0.9)
        return math.sqrt(min(max(quietest, 1.0), math.inf if stands else _MAX_NOISE_FACTOR ** 2))

    def _sample_limit(self, interval: float, variance: float) -> float:
        """Return the largest deviation of a single sample at rest, rad/s."""
        # Its noise is that of the usual interval: late samples and bursts were sampled evenly too.
        return (mean_threshold_sigmas(round(interval, 9), self._sample_false_alarms)
                * math.sqrt(variance))

    def look_ahead(self, blocks: Array, wheels: Sequence[bool | None]) -> None:
        """Compute the results of the next k blocks, as for `add`, given as `Block`, (5, k)."""
        sums, kept = np.hstack([self._blocks, blocks]), self._blocks.shape[1]
        sums = np.vstack([sums, sums[2] ** 2 / sums[1]])
        until = np.cumsum(np.pad(sums[:2], ((0, 0), (1, 0))), axis=1)
        end = np.arange(kept, sums.shape[1]) + 1
        least = WINDOW_DURATION + BLOCK_DURATION - TIME_TOLERANCE, _MIN_WINDOW_SAMPLES
        begin = np.min([np.searchsorted(each, each[end] - shortest, side='right') - 1
                        for each, shortest in zip(until, least)], axis=0)
        full = begin >= 0
        begin = np.maximum(begin, 0)
        duration, count, total, squares, differences, means = np.add.reduceat(
            np.pad(sums, ((0, 0), (0, 1))), np.stack([begin, end], axis=1).ravel(), axis=1)[:, ::2]
        interval, freedom = duration / count, count - 1.0
        energy = (squares - total * total / count) / np.maximum(freedom, 1.0)
        variance = self._noise.rate_variance(1.0) / interval
        factors, factor = [], self.noise_factor
        for moved, is_full, *values in zip(wheels, *(each.tolist() for each in (
                full, blocks[0], count, energy / variance,
                0.5 * differences / count / variance))):
            if is_full and not moved:
                factor = self._next_noise_factor(factor, moved is False, *values)
            factors.append(factor)
        variance *= np.square(factors)
        # motion is slower than the samples, so that means over blocks show it far better
        of_samples, of_blocks = (chdtri(np.maximum(each, 1.0), self._false_alarm_chance)
                                 for each in (freedom, end - begin - 1.0))
        quiet = (energy * freedom < variance * of_samples) & (
            (end - begin < 3) | (means - total * total / count < variance * of_blocks))
        self._blocks = sums[:5, begin[-1]:]
        self._results.extend(
            (each, factor, self._sample_limit(*sampled)) if known
            else (None, factor, self.sudden_limit) for known, each, factor, *sampled in zip(
                full.tolist(), quiet.tolist(), factors, interval.tolist(), variance.tolist()))


@dataclass(frozen=True)
class Snapshot:
    """State at some time during a rest."""

    state: HeadingState
    rate_integral: RateIntegral  # since the rest began
    deleted_heading: float  # until then, rad
    step_count: int  # of all steps until then
    step: TrackStep | None = None  # the last one until then
    #: Scatter of the last mean and bias, rad/s, and their covariance, shape (5, k), by
    #: `SCATTER_RATIOS`.
    scatter_state: Array | None = None
    scatter: float = 0.0  # median of `SCATTER_RATIOS` by the innovations; 0 before the first
    #: Of the innovations since the rest began, by `SCATTER_RATIOS`, shape (k,).
    log_likelihood: Array = field(default_factory=lambda: np.zeros(len(SCATTER_RATIOS)))


class RestScatter:
    """Distribution of the scatter of the rates in detected rests."""

    def __init__(self) -> None:
        """Begin with the prior numbers."""
        self._learned: Array = np.zeros(len(SCATTER_RATIOS))
        self._retention = 1.0
        self.begin_rest(0.0)

    def begin_rest(self, bias_ratio: float) -> None:
        """Begin a rest with a ratio of the variance of the bias, over 1 s, to the white noise."""
        passes = MAX_SCATTER_RATIO * max(bias_ratio, 1.0) >= SCATTER_RATIOS
        # numbers of rests with each of `SCATTER_RATIOS` that pass in this rest, shape (k,)
        self.counts = self._learned + self._retention * PRIOR_COUNTS * passes

    def probabilities(self, likelihood: Array) -> Array:
        """Return the probability of each scatter, shape (k,)."""
        possible = np.where(self.counts > 0.0, likelihood, -math.inf)
        chances = self.counts * np.exp(possible - possible.max())
        return np.asarray(chances / chances.sum())

    def learn(self, last: Snapshot) -> None:
        """Add a detected rest that has ended."""
        kept = _MAX_STRETCHES / max(_MAX_STRETCHES, float(self.counts.sum()))
        self._learned = kept * self._learned + self.probabilities(last.log_likelihood)
        self._retention *= kept


def median_ratio(chances: Array) -> float:
    """Return the median of `SCATTER_RATIOS`, which have these probabilities, shape (k,)."""
    return float(SCATTER_RATIOS[np.searchsorted(np.cumsum(chances), 0.5)])


def sum_ratios(count: float) -> Array:
    """Return the ratios of variances of sums of `count` means, per mean, shape (k,)."""
    shared = SCATTER_CORRELATIONS  # of processes of first order
    return np.asarray(SCATTER_RATIOS / (1.0 - shared) ** 2 * (
        1.0 - shared ** 2 - 2.0 * shared * (1.0 - shared ** count) / count))


def update_scatter(state: Array, rate: float, noise: float, white: float) -> tuple[Array, Array]:
    """
    Return `Snapshot.scatter_state` after a mean rate, and its log-likelihood, shape (k,).

    The scatter of means over 1 s is a process of first order, stationary at first. Given are the
    state before, (5, 1) or (5, k), the rate, rad/s, and the variances of its noise and of the
    white noise over 1 s, (rad/s)².
    """
    variance, shared = SCATTER_RATIOS * white, SCATTER_CORRELATIONS
    scatter, bias, own, joint, of_bias = state
    if len(scatter) == 1:
        own = variance
    scatter, joint = shared * scatter, shared * joint
    own = variance + shared ** 2 * (own - variance)
    seen, seen_bias = own + joint, joint + of_bias
    total = seen + seen_bias + noise
    innovation = (rate - scatter - bias) / total
    return (np.array([scatter + seen * innovation, bias + seen_bias * innovation,
                      own - seen ** 2 / total, joint - seen * seen_bias / total,
                      of_bias - seen_bias ** 2 / total]),
            -0.5 * (innovation ** 2 * total + np.log(total / noise)))


@dataclass
class SlowTurn:
    """A turn that was detected late, and is so slow that it may be a change of the bias."""

    snapshot: Snapshot  # when it began
    rate: float  # rad/s
    rate_integral: RateIntegral  # since then


@dataclass(frozen=True)
class Samples:
    """Samples as `HeadingTracker.follow` is given them."""

    time: Array
    rate: Array
    sensitivity: Array
    wheels: Sequence[bool | None] | None
    still: Array | None

    def sample(self, place: int) -> tuple[float, float, Array, bool | None, Array | None]:
        """Return the arguments of `HeadingTracker.add`."""
        return (float(self.time[place]), float(self.rate[place]), self.sensitivity[place],
                None if self.wheels is None else self.wheels[place],
                None if self.still is None else self.still[place])


@dataclass
class Epoch:
    """Samples with one state; heading and pending correction at the begin, rad."""

    start_index: int  # of the sample before its first
    state_version: int
    state: HeadingState
    is_resting: bool
    heading: float
    pending: float
    ambiguity_variance: float  # of the bias, (rad/s)²
    begin_time: float  # of the heading, s
    mixture_variance: float  # of the heading, beyond that of the state, rad²
    #: Of each block, its last sample, and of the integral of the rates since the state: duration,
    #: s, lost variance, rad², and sensitivity, shape (m,).
    open_integrals: list[tuple[int, float, float, Array]]
    end_index: int = -1  # after its last sample


class EvenSamples:
    """n samples without jumps and gaps, and their sums over k blocks."""

    def __init__(self, given: Samples, where: slice, last: tuple[float, float, float, Array],
                 begun: float, rested: bool, found: Array):
        """Begin after the last sample, with an elapsed duration of the first block, s."""
        self.last_at_rest, self.results = rested, found
        self.time, self.rate = given.time[where], given.rate[where]
        self.wheels = None if given.wheels is None else given.wheels[where]
        self.still = None if given.still is None else given.still[where]
        self.motion_sensitivity = given.sensitivity[where]
        self.rest_sensitivity = self.motion_sensitivity if self.still is None else self.still
        count = len(self.time)
        self.intervals = np.diff(self.time, prepend=last[0])
        self.half_intervals, steps = 0.5 * self.intervals, np.diff(self.rate, prepend=last[1])
        self.angles = self.half_intervals * (2.0 * self.rate - steps)
        # the sensitivities used, first that of the sample before
        self.used_sensitivity = np.empty((count + 1, len(last[3])))
        self.used_sensitivity[0] = last[3]
        self.block_stops = block_ends(self.intervals, BLOCK_DURATION, begun)
        whole = len(self.block_stops)
        if not self.block_stops or self.block_stops[-1] < count:
            self.block_stops.append(count)
        self.block_starts = [0, *self.block_stops[:-1]]
        self.whole_blocks = range(bool(begun), whole)
        moving = self._integrate_sensitivity(self.motion_sensitivity)
        resting = (moving if self.still is None
                   else self._integrate_sensitivity(self.rest_sensitivity))
        self.sensitivity_integrals = moving, resting  # shape (k, m) each
        # by block: duration, count, sums of the rates, their squares and the squares of their
        # steps; integrals, and remaining shares of a pending correction
        self.block_sums = np.array([self._sum_by_blocks(values) for values in (
            self.intervals, np.ones(count), self.rate, self.rate * self.rate, steps * steps)])
        self.block_angles = self._sum_by_blocks(self.angles)
        self._pending_retention = 1.0 - self.intervals / CORRECTION_TIME
        self.block_retentions = np.multiply.reduceat(self._pending_retention, self.block_starts)
        self.epochs = list[Epoch]()

    def wheels_of(self, number: int) -> bool | None:
        """Return whether wheels moved in a block; None if unknown at its last sample."""
        if self.wheels is None:
            return None
        moved = self.wheels[self.block_starts[number]:self.block_stops[number]]
        return True in moved or moved[-1]

    def _integrate_sensitivity(self, rows: Array) -> Array:
        before = np.concatenate([self.used_sensitivity[:1], rows[:-1]])
        return self._sum_by_blocks(self.half_intervals[:, None] * (rows + before))

    def _sum_by_blocks(self, values: Array) -> Array:
        return np.asarray(np.add.reduceat(values, self.block_starts))

    def close_epoch(self, end: int) -> None:
        """End the last epoch before a sample."""
        if self.epochs:
            epoch = self.epochs[-1]
            epoch.end_index, first = end, epoch.start_index + 1
            if end >= max(first, 1):
                rows = self.rest_sensitivity if epoch.is_resting else self.motion_sensitivity
                self.used_sensitivity[first + 1:end + 2] = rows[first:end + 1]

    def fill_results(self, usual_intervals: Array) -> None:
        """Compute the results of the epochs; `usual_intervals` has a row for each sample."""
        found = self.results
        interval = np.clip(np.minimum(self.intervals, usual_intervals), MIN_SAMPLE_INTERVAL, None)
        moving = list[Epoch]()
        for epoch in self.epochs:
            here = slice(max(epoch.start_index, 0), epoch.end_index)
            if here.stop <= here.start:
                continue
            state, rows = epoch.state, self.used_sensitivity[1:][here]
            offset, variance = state.wander_rate
            values, covariance, shared = state.calibration_errors
            found[here, 3] = (variance + ((rows @ covariance - 2.0 * shared) * rows).sum(axis=1)
                              + state.noise.angle_random_walk ** 2
                              / (WINDOW_DURATION if epoch.is_resting else interval[here]))
            found[here, 4] = epoch.is_resting
            unknown = epoch.mixture_variance + epoch.ambiguity_variance * (
                self.time[here] - epoch.begin_time) ** 2
            found[here, 3] += epoch.ambiguity_variance
            if epoch.is_resting:
                variance = float(state.covariance[HEADING_INDEX, HEADING_INDEX])
                found[here, 0], found[here, 2] = epoch.heading, 0.0
                found[here, 1] = variance + epoch.pending ** 2 + unknown
                continue
            moving.append(epoch)
            found[here, 2] = self.rate[here] + rows @ values - offset
            pending = np.empty(epoch.end_index - epoch.start_index)
            turned = np.empty(epoch.end_index - epoch.start_index)
            inside = slice(epoch.start_index + 1, epoch.end_index)
            pending[0], pending[1:] = epoch.pending, self._pending_retention[inside]
            np.cumprod(pending, out=pending)
            turned[0], turned[1:] = epoch.heading + epoch.pending, self.angles[inside]
            turned[1:] += self.half_intervals[inside] * (
                (self.used_sensitivity[1:][inside] + self.used_sensitivity[:-1][inside]) @ values
                - 2.0 * offset)
            np.cumsum(turned, out=turned)
            first = here.start - epoch.start_index
            found[here, 0] = (turned - pending)[first:]
            found[here, 1] = pending[first:] ** 2 + unknown
        if not moving:
            return
        # the variance of the heading in motion
        states = [epoch.state for epoch in moving for _ in epoch.open_integrals]
        places, *turns = map(np.array, zip(*(
            each for epoch in moving for each in epoch.open_integrals)))
        variances = heading_variances(states, *turns)
        white = np.array([state.noise.angle_random_walk ** 2 for state in states])
        until = np.append(np.cumsum(self.intervals), 0.0)  # the last is that of the place -1
        rows = np.concatenate(
            [np.arange(max(epoch.start_index, 0), epoch.end_index) for epoch in moving])
        block = np.searchsorted(places, rows, side='right') - 1
        found[rows, 1] += (variances[block]
                           + white[block] * (until[rows] - until[places[block]]))
