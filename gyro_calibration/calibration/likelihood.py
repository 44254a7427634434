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
The likelihood of a gyro's output, given its heading: scale factor error, bias, delay and lag.

Everything is computed on increments between blocks of up to half a second: rates integrated by the
trapezoid rule against the reference.

Errors within a block (vibration, backlash, an eccentric encoder) are no random walk. The
covariance of the increments is a banded matrix with one unknown ratio, which is solved exactly for
each ratio of a grid. Blocks are shorter where the heading swings so fast that means over 0.5 s
would attenuate it.

"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
import math

from gyro_calibration.calibration.noise_grid import Tridiagonal
from gyro_calibration.heading.integration import integrate
from gyro_calibration.logs.log import Array, DataRefused
from gyro_calibration.logs.quality import quantization_step
from gyro_calibration.model.motion import Motion
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import helmert


@dataclass(frozen=True)
class Goodness:
    """
    Comparison of the residual of a fit with the known noise.

    Attributes
    ----------
    chi_square : sum of squares of the residual over the variance that is known
    freedom : degrees of freedom
    probability : of as much, or more, by chance
    noise_ratio : noise that accumulates in the heading, over the known one; noise that repeats or
        averages out is not included

    """

    chi_square: float
    freedom: float
    probability: float
    noise_ratio: float

    def __str__(self) -> str:
        """Return a sentence for people."""
        amount = ('what the noise explains' if self.probability > UNLIKELY else
                  'more than the noise explains: the robot follows the profile less well than the '
                  'gyro measures, or shakes')
        return (f'The residual is {amount} (chi-square {self.chi_square:.1f} with '
                f'{self.freedom:.0f} degrees of freedom, probability {self.probability:.2g}; '
                f'noise {self.noise_ratio:.2f} times that of the model)')


#: Below this probability the message says that the residual is more than the noise explains.
UNLIKELY = 1e-3


@dataclass(frozen=True)
class Fit:
    """
    The result of a fit.

    Attributes
    ----------
    scale_factor_error, bias : s, 1, and b, rad/s
    covariance : of (s, b), shape (2, 2); nan where the method gives none
    time_offset : how late the gyro is against the profile, s
    angle_random_walk, reference_noise : as the run shows them, rad/√s and rad in one reading
    residual : largest deviation of a stretch of the run from the profile, rad, and its
        significance in standard deviations
    time_offset_deviation : standard deviation of the time offset, s
    influence : the effect of the noise of each block on (s, b), shape (n, 2), and the times of the
        blocks, s, shape (n,), as one array (n, 3)
    stretch : beginning and end of that stretch, s
    start_heading, start_heading_deviation : true heading where gyro and reference begin, from the
        reference's first heading, and its standard deviation, rad; nan against a profile, which
        defines its own start
    squares, freedom : sum of squares of the residual, in units of white noise of 1 rad/√s, and its
        degrees of freedom
    goodness : comparison of that with the noise; None where the noise is not known
    repeating : error of the heading that repeats with the motion, rad, where the bias was fitted
        to windows because of it
    slip : standard deviation between the turns of a profile of the fraction that each lost, 1

    """

    scale_factor_error: float
    bias: float
    covariance: Array
    time_offset: float = 0.0
    angle_random_walk: float = math.nan
    reference_noise: float = math.nan
    residual: tuple[float, float] = (0.0, 0.0)
    time_offset_deviation: float = math.nan
    influence: Array = field(default_factory=lambda: np.empty((0, 3)))
    stretch: tuple[float, float] = (0.0, 0.0)
    start_heading: float = math.nan
    start_heading_deviation: float = math.nan
    squares: float = math.nan
    freedom: float = 0.0
    goodness: Goodness | None = None
    repeating: float = 0.0
    slip: float = 0.0


#: Limit of significance, standard deviations: noise does not exceed it in 10 000 stretches a run,
#: in all runs of a robot.
CHANCE = 7.0


@dataclass(frozen=True)
class _Points:
    """
    Where the reference is known: times, s, headings, rad, and variances, shape (n,) each.

    The variances are known up to one factor. Errors that several points share have columns, shape
    (n, k), and prior standard deviations, shape (k,), times one row of the factors `parts`, shape
    (m, k).

    """

    time: Array
    heading: Array
    variance: Array
    shared: Array
    shared_deviation: Array = field(default_factory=lambda: np.empty(0))
    parts: Array = field(default_factory=lambda: np.ones((1, 0)))


@dataclass(frozen=True)
class _Increments:
    """
    Increments of the headings of gyro and reference between blocks, each a mean over some points.

    Attributes
    ----------
    columns : reference increments, rad; intervals, s; the change by a time offset, rad/s; by a
        lag, rad/s²; by errors that several points share, rad; shape (n, 4 + k)
    prior, expected : prior standard deviations and means of the values, shape (4 + k,)
    parts : possible factors of the prior standard deviations, shape (m, 4 + k)
    turned : increments of the gyro's integral, rad, shape (n,)
    walk, neighbours : variance of the increments of a random walk, and covariance of each with the
        one before, s, shape (n,)
    reference : variance of the reference in each block, up to one factor, shape (n + 1,)
    time : of the blocks, s, shape (n + 1,)
    since : from the first point to the first block: its heading, the time, the shared errors in
        that block, then the turn of the gyro

    """

    columns: Array
    prior: Array
    parts: Array
    expected: Array
    turned: Array
    walk: Array
    neighbours: Array
    reference: Array
    time: Array
    since: Array


#: Longest block, s. Errors within a block (vibration, backlash, an eccentric encoder) are no
#: random walk, and are not modelled as one.
BLOCK = 0.5
#: Prior standard deviations: of the error of the present delay, s, and of the lag, s².
DELAY_DEVIATION, LAG_DEVIATION = 0.1, 0.1


#: Two offsets fit equally well if the ratio of their misfits is below this.
_ALIKE = 1.5


#: Rate and acceleration are differences over this time, s, or an interval if longer, to either
#: side: over less, noise dominates them.
_SMOOTH = 0.01


class _Pairing:
    """A run and a motion, aligned at any time offset and lag."""

    def __init__(self, time: Array, rate: Array, motion: Motion, lag: float, slip: float):
        self._time, self._rate = time, rate
        self._prior = np.array([math.inf, math.inf, DELAY_DEVIATION, lag])
        self._integral = integrate(time, rate)
        self._base = max(float(np.median(np.diff(time))), _SMOOTH)
        self.sampled = motion.rate is None
        self._block = block_length(motion)
        self._points = _points(motion, self._block, slip)

    def increments(self, offset: float, lag: float = 0.0) -> _Increments:
        """
        Return the increments if the gyro is `offset` s late, part of it by a first-order lag.

        The time constant of the lag has the square 2 `lag`. The output of such a lag plus its rate
        times the constant is the input, but for a delay.

        """
        points, constant = self._points, math.sqrt(2.0 * lag)
        at = points.time + offset - constant
        kept = (at >= self._time[0]) & (at <= self._time[-1])
        time, weight = points.time[kept], 1.0 / points.variance[kept]
        if len(time) < 2:
            return _Increments(np.empty((0, 4)), *np.empty((9, 0)))
        begins = np.flatnonzero(np.diff(np.floor((time - time[0]) / self._block + 1e-6),
                                        prepend=-1.0))
        precision = np.add.reduceat(weight, begins)
        weight = weight / np.repeat(precision, np.diff(begins, append=len(time)))
        known = np.column_stack([points.heading[kept], time,
                                 *self._rate_and_integral(at[kept], constant),
                                 points.shared[kept]])
        means = np.add.reduceat(weight[:, None] * known, begins)
        columns = np.diff(np.delete(means, 4, axis=1), axis=0)
        prior = np.append(self._prior, points.shared_deviation)
        parts = np.insert(points.parts, [0] * 4, 1.0, axis=1)
        expected = np.zeros(len(prior))
        expected[3] = -lag
        walk = _random_walk(time, weight, begins)
        since = np.concatenate([[means[0, 0], means[0, 1] - time[0]], means[0, 5:],
                                [means[0, 4] - known[0, 4]]])
        return _Increments(columns, prior, parts, expected, np.diff(means[:, 4]), *walk,
                           1.0 / precision, means[:, 1], since)

    def aligned(self, offset: float, lag: float) -> _Increments:
        """Return the increments, or refuse a run with hardly any."""
        data = self.increments(offset, lag)
        if len(data.turned) < 10:
            raise DataRefused('the samples cover less than ten blocks of the profile: '
                              'record the whole motion')
        return data

    def _rate_and_integral(self, at: Array, constant: float) -> tuple[Array, Array, Array]:
        """
        Return rate, acceleration and integral of the rate, linear between the samples.

        The lag is taken off the rate and the integral.

        """
        base = self._base
        integral, later, earlier = (self._turned(at + shift) for shift in (0.0, base, -base))
        rate, acceleration = (0.5 * (later - earlier) / base,
                              (later - 2.0 * integral + earlier) / base ** 2)
        return rate + constant * acceleration, acceleration, integral + constant * rate

    def _turned(self, at: Array) -> Array:
        inside = np.clip(at, self._time[0], self._time[-1])
        index = np.searchsorted(self._time, inside, side='right') - 1
        rate = np.interp(inside, self._time, self._rate)
        within = (self._integral[index]
                  + 0.5 * (inside - self._time[index]) * (rate + self._rate[index]))
        return within + (at - inside) * rate

    def coarse_offset(self, largest: float) -> float:
        """
        Return the offset, s, at which most increments fit.

        A slip affects only the blocks that contain it. A periodic motion fits about equally well
        at several offsets: the smallest of these is returned.

        """
        # a profile is smoother than measured headings
        step = 0.02 if self.sampled else 0.04
        offsets = np.arange(-round(largest / step), round(largest / step) + 1) * step
        misfits = np.array([self._misfit(offset) for offset in offsets])
        padded = np.pad(misfits, 1, constant_values=math.inf)
        bottoms = offsets[(misfits <= np.minimum(padded[:-2], padded[2:]))
                          & (misfits <= 6.0 * misfits.min())]
        if len(bottoms) < 2 or math.isinf(misfits.min()):
            return float(offsets[misfits.argmin()])
        fine = np.arange(-5, 6) * 0.002
        deepest = [min((self._misfit(offset), offset) for offset in bottom + fine)
                   for bottom in bottoms]
        alike = [offset for misfit, offset in deepest if misfit <= _ALIKE * min(deepest)[0]]
        return float(min(alike, key=abs))

    def _misfit(self, offset: float) -> float:
        data = self.increments(offset)
        if len(data.turned) < 10:
            return math.inf
        return float(np.mean(np.abs(robust_residual(data.columns[:, :2], data.turned, 3))))


def block_length(motion: Motion) -> float:
    """Return the length of a block, s, over which the heading varies little."""
    block = min(BLOCK, motion.duration / 40.0)
    time = np.arange(0.0, motion.duration, block / 64.0)
    heading = motion.heading_at(time[:len(time) // 64 * 64]).reshape(-1, 64)
    whole, within = np.var(heading), [np.var(heading.reshape(-1, size), axis=1).mean()
                                      for size in (64, 32, 16, 8, 4)]
    halvings = int(np.argmax(np.append(np.array(within) < 0.05 * whole, True)))
    return block / 2.0 ** halvings


def _points(motion: Motion, block: float, slip: float) -> _Points:
    """Return where a motion is known: at its samples, or for an encoder where it steps."""
    if motion.rate is not None:
        time = np.arange(0.0, motion.duration + 1e-9, 0.01)
        return _Points(time, motion.heading_at(time), np.ones(len(time)),
                       *following(motion, time, slip))
    step = quantization_step(motion.heading)
    if not step:
        return _Points(motion.time, motion.heading, np.ones(len(motion.time)),
                       np.empty((len(motion.time), 0)))
    crossings, stands = _crossings(motion, step), _stands(motion, step, block)
    order = np.argsort(np.append(crossings.time, stands.time), kind='stable')
    time, heading, variance, shared = (
        np.concatenate([getattr(points, name) for points in (crossings, stands)])[order]
        for name in ('time', 'heading', 'variance', 'shared'))
    return _Points(time, heading, variance, shared, np.full(2, step / math.sqrt(12.0)),
                   np.ones((1, 2)))


#: Standard deviation of the scale factor error by which the two senses of turning may differ.
ASYMMETRY = 1e-4
#: Prior standard deviations of the differences between turns in the response of a robot: delay, s,
#: and lag, s².
_TURN_DELAY, _TURN_LAG = 0.1, 0.02
#: Largest number of groups of neighbouring turns with a delay and a lag of their own.
_MOST_TURNS = 12
#: A response of higher order, as of a robot that overshoots, as a sum of second differences of the
#: heading: their times, s, and prior standard deviation, 1.
_RESPONSE, _RESPONSE_DEVIATION = (0.15, 0.3, 0.45, 0.6, 0.8), 0.3
#: Possible factors of the prior standard deviations of the response, and of slips.
_FOLLOWING, _SLIPS = np.array([0.001, 0.1, 1.0]), np.array([0.001, 0.03, 0.1, 0.3, 1.0])


def following(motion: Motion, time: Array, slip: float) -> tuple[Array, Array, Array]:
    """
    Return the deviations from a profile that scale, bias, delay and lag do not describe.

    The gyro's scale may differ between the two senses of turning. The response of the robot may be
    of higher order than a lag, and have a delay and a lag of its own in each turn, as where the
    acceleration is limited. The robot may slip in each turn, and while it decelerates.

    Parameters
    ----------
    time : s, shape (n,)
    slip : largest standard deviation of the slip of a turn, as a fraction of it

    Returns
    -------
    columns of headings, rad, shape (n, k), their prior standard deviations, shape (k,), and
    possible factors of these, shape (m, k)

    """
    rate, heading = motion.rate_at(time), motion.heading_at(time)
    sense, acceleration = np.sign(rate), np.gradient(rate, time)
    turned = np.diff(heading, prepend=heading[:1])[:, None]
    turn = np.where(sense, np.cumsum((sense != 0.0) & (np.diff(sense, prepend=0.0) != 0.0)), 0)
    count = min(int(turn.max()), _MOST_TURNS)
    if count < 2:
        return np.empty((len(time), 0)), np.empty(0), np.ones((1, 0))
    inside = (-(-turn * count // turn.max()))[:, None] == np.arange(1, count + 1)
    # the mean over the turns is delay, lag and scale
    apart = helmert(count).T
    columns = [rate[:, None] * (inside @ apart), acceleration[:, None] * (inside @ apart)]
    columns.append(np.column_stack([
        heading - 2.0 * motion.heading_at(time - late) + motion.heading_at(time - 2.0 * late)
        for late in _RESPONSE]))
    deviations = [np.full(count - 1, _TURN_DELAY), np.full(count - 1, _TURN_LAG),
                  np.full(len(_RESPONSE), _RESPONSE_DEVIATION)]
    following, slips = _FOLLOWING, np.ones(1)
    if slip:
        ending = inside & (rate * acceleration < 0.0)[:, None]
        columns += [np.cumsum(turned * part, axis=0) for part in (inside @ apart, ending)]
        deviations.append(np.full(2 * count - 1, slip))
        slips = _SLIPS
    parts = np.hstack([
        np.repeat(np.tile(following, len(slips))[:, None], 2 * count - 2 + len(_RESPONSE), axis=1),
        np.repeat(np.repeat(slips, len(following))[:, None], (2 * count - 1) * bool(slip),
                  axis=1)])
    if sense.min() < 0.0 < sense.max():
        columns.append(np.cumsum(np.abs(turned), axis=0))
        deviations.append(np.array([ASYMMETRY]))
        parts = np.append(parts, np.ones((len(parts), 1)), axis=1)
    return np.hstack(columns), np.concatenate(deviations), parts


def _crossings(motion: Motion, step: float) -> _Points:
    """
    Return the middles between lasting readings one step apart, with variances in units of theirs.

    A constant reading has a constant error of up to half a step; where it changes by one step, the
    heading is the edge between the two, but for the turn between the samples.

    """
    moved = np.abs(np.diff(motion.heading))
    index = np.flatnonzero(moved > 0.5 * step)
    time, heading = (0.5 * (values[index] + values[index + 1])
                     for values in (motion.time, motion.heading))
    speed = np.abs(np.diff(heading) / np.diff(time))
    turned = (np.maximum(np.append(speed, 0.0), np.append(0.0, speed)[:len(time)])
              if len(time) else time)
    turned = np.where(moved[index] > 1.5 * step, 1.0,
                      np.clip(turned * np.diff(motion.time)[index] / step, _SHARPEST, 1.0))
    # none has more weight than the median one: the accuracy of a reference is seldom that of its
    # slowest steps
    turned = np.maximum(turned, np.median(turned)) if len(time) else turned
    alone = np.diff(index, prepend=-1, append=len(moved)) == 1
    edges = (moved[index] < 1.5 * step) & ~(alone[1:] & alone[:-1])
    return _Points(time[edges], heading[edges], turned[edges] ** 2,
                   np.zeros((int(edges.sum()), 2)))


#: Least standard deviation of a heading where an encoder steps, in units of that of a reading.
_SHARPEST = 0.05


def _stands(motion: Motion, step: float, block: float) -> _Points:
    """
    Return the readings that are constant for longer than a block, single ones, the first and last.

    All samples of a constant reading count as one. At the first and the last the gyro rests if
    they last much longer than the readings next to them; then their samples share one error.

    """
    run = np.cumsum(np.abs(np.diff(motion.heading, prepend=motion.heading[0])) > 0.5 * step)
    begins = np.flatnonzero(np.diff(run, prepend=-1))
    ends = np.append(begins[1:], len(run)) - 1
    lasts = motion.time[ends] - motion.time[begins]
    stays = (lasts > block) | (ends == begins)
    stays[[0, -1]] = True
    rests = np.zeros((len(begins), 2))
    if len(begins) > 2:
        rests[0, 0], rests[-1, 1] = (lasts[end] > max(block, 2.0 * lasts[next_to])
                                     for end, next_to in ((0, 1), (-1, -2)))
    variance = np.where(rests.any(axis=1), 1.0, np.bincount(run))
    kept = stays[run]
    return _Points(motion.time[kept], motion.heading[kept], variance[run[kept]], rests[run[kept]])


def _random_walk(time: Array, weight: Array, begins: NDArray[np.intp]) -> tuple[Array, Array]:
    """
    Return the variance of increments by a random walk, and the covariance of neighbours, s, (n,).

    The random walk has unit variance a second, the increments are between weighted means of
    blocks. With A the weights summed up to each point, the mean of a block is its last value less
    the sum of A times the steps, and its first value plus the sum of (1 - A) times the steps.

    """
    interval = np.diff(time, append=time[-1])
    until = np.cumsum(weight)
    until -= np.repeat(until[begins] - weight[begins], np.diff(begins, append=len(time)))
    last = np.append(begins[1:], len(time)) - 1
    gap = interval[last]
    within = interval.copy()
    within[last] = 0.0
    before, after, both = (np.add.reduceat(product * within, begins)
                           for product in (until ** 2, (1 - until) ** 2, until * (1 - until)))
    return before[:-1] + gap[:-1] + after[1:], both[:-1]


def robust_residual(columns: Array, turned: Array, passes: int) -> Array:
    """Return the residual of a fit in which large residuals have a linear loss (Huber)."""
    weights = np.ones(len(turned))
    for _ in range(passes):
        weighted = weights[:, None] * columns
        residual = turned - columns @ np.linalg.lstsq(weighted.T @ columns, weighted.T @ turned,
                                                      rcond=1e-14)[0]
        size = np.abs(residual)
        weights = 1.0 / np.maximum(size, max(float(np.median(size)), 1e-12))
    return residual


class _Covariance(Tridiagonal):
    """Covariance of the increments, up to one factor, by rate and reference noise."""

    def __init__(self, data: _Increments, ratio: float):
        self.ratio, self._reference = ratio, ratio * data.reference
        super().__init__(data.walk + self._reference[1:] + self._reference[:-1],
                         data.neighbours - self._reference[:-1])

    def reference_error(self, residual: Array) -> Array:
        """Return the expected contribution of the noise of the headings to the residual."""
        solved = np.concatenate([[0.0], self.solve(residual), [0.0]])
        return np.diff(self._reference * -np.diff(solved))


@dataclass(frozen=True)
class _Estimate:
    """Values of (1 + s, b, error of the time offset, lag, ...), with their covariance."""

    prior: Array
    values: Array
    covariance: Array
    residual: Array
    freedom: float
    rate_variance: float
    noise: _Covariance
    influence: Array


#: Variance of a block's reference noise over what the rate noise adds from block to block.
_RATIOS = np.geomspace(1e-3, 1e5, 25)


def _estimate(data: _Increments, noise: _Covariance, instrument: Array,
              prior: Array) -> _Estimate:
    """Solve the weighted normal equations."""
    weighted = noise.solve(instrument)
    matrix, vector = weighted.T @ data.columns, weighted.T @ data.turned
    rate_variance = 0.0
    for _ in range(3):
        precision = rate_variance / prior ** 2
        regular = matrix + np.diag(precision)
        values = np.linalg.lstsq(regular, vector + precision * data.expected, rcond=1e-14)[0]
        inverse = np.linalg.pinv(regular, rcond=1e-14)
        # the values that the priors leave open, and the ratio of the noises
        freedom = len(data.turned) - 1.0 - float(np.trace(inverse @ matrix))
        residual = data.turned - data.columns @ values
        rate_variance = max(float(residual @ noise.solve(residual)) / freedom, _least(data))
    return _Estimate(prior, values, freedom / (freedom - 2.0) * rate_variance * inverse, residual,
                     freedom, rate_variance, noise, residual[:, None] * (weighted @ inverse[:2].T))


@dataclass(frozen=True)
class _Mixture:
    """
    Estimates averaged over the sizes of both noises and of the priors, weighted by likelihood.

    Attributes
    ----------
    values, covariance : means of the values, shape (k,), and their covariance, shape (k, k)
    ratio, prior : of the noises, and prior standard deviations, shape (k,), that are likeliest

    """

    values: Array
    covariance: Array
    ratio: float
    prior: Array


def _mixture(data: _Increments, parts: Array) -> _Mixture:
    """Return the average over all ratios of the noises and factors of the priors, (m, k)."""
    ratios = _RATIOS * float(np.median(data.walk) / np.median(data.reference))
    priors, count, known = data.prior * parts, len(data.turned), np.isfinite(data.prior)
    given = []
    for ratio in ratios:
        noise = _Covariance(data, ratio)
        weighted = noise.solve(data.columns)
        matrix = weighted.T @ data.columns
        plain = np.linalg.lstsq(matrix, weighted.T @ data.turned, rcond=1e-14)[0]
        left = data.turned - data.columns @ plain
        given.append((matrix, plain, weighted.T @ left, left @ noise.solve(left),
                      noise.log_determinant))
    matrix, plain, gradient, squares, determinant = (
        np.array(each)[:, None] for each in zip(*given))
    least, freedom = _least(data), count - len(data.prior) - 1.0
    variance = np.maximum(np.repeat(squares, len(parts), axis=1) / freedom, least)
    for _ in range(3):
        precision = variance[..., None] / priors ** 2
        regular = matrix + precision[..., None] * np.eye(len(data.prior))
        size = np.sqrt(np.einsum('...ii->...i', regular))
        scaled = regular / size[..., None] / size[..., None, :] + 1e-14 * np.eye(len(data.prior))
        inverse = np.linalg.inv(scaled) / size[..., None] / size[..., None, :]
        change = np.einsum('...ij,...j->...i', inverse,
                           gradient - precision * (plain - data.expected))
        freedom = count - 1.0 - np.einsum('...ij,...ji->...', inverse, matrix)
        left = squares + np.einsum('...i,...i->...', change, np.einsum(
            '...ij,...j->...i', matrix, change) - 2.0 * gradient)
        variance = np.maximum(left / freedom, least)
    values = plain + change
    logarithms = -0.5 * (
        (count - len(data.prior) - 1.0) * np.log(variance) + freedom + determinant
        + (((values - data.expected) / priors)[..., known] ** 2
           + 2.0 * np.log(priors[:, known])).sum(axis=-1)
        + np.linalg.slogdet(scaled)[1] + 2.0 * np.log(size).sum(axis=-1)).ravel()
    weights = np.exp(logarithms - logarithms.max())
    weights /= weights.sum()
    # the variance is estimated too, so the values have Student's distribution, which is wider
    within = np.einsum('g,gij->ij', weights * (variance * freedom / (freedom - 2.0)).ravel(),
                       inverse.reshape(-1, *inverse.shape[2:]))
    values = values.reshape(len(weights), -1)
    ratio, part = divmod(int(weights.argmax()), len(parts))
    return _Mixture(weights @ values, within + np.cov(values.T, aweights=weights, ddof=0),
                    float(ratios[ratio]), priors[part])


def _least(data: _Increments) -> float:
    """Return the smallest variance of the noise above rounding errors."""
    return 1e-18 * float(np.mean(data.turned ** 2 / data.walk))


def _errors_in_variables(data: _Increments, estimate: _Estimate) -> _Estimate:
    """Estimate again, with the reference heading smoothed by the gyro as the instrument."""
    for _ in range(3):
        instrument = data.columns.copy()
        instrument[:, 0] += (estimate.noise.reference_error(estimate.residual)
                             / _away_from_zero(estimate.values[0]))
        estimate = _estimate(data, estimate.noise, instrument, estimate.prior)
    return estimate


def _away_from_zero(scale: float) -> float:
    """Return the scale, limited to at least 0.001 either way, for a dead gyro."""
    return math.copysign(max(abs(float(scale)), 1e-3), scale)


def fit_likelihood(time: Array, rate: Array, motion: Motion, largest_time_offset: float = 1.0,
                   lag: float = LAG_DEVIATION, slip: float = 0.0) -> Fit:
    """
    Fit scale factor error, bias and time offset by likelihood.

    Rates are integrated by the trapezoid rule and compared with the reference heading increment by
    increment. The increments have noise of the rate (a random walk of the heading) and of the
    reference heading (an encoder's step), so that neighbours are correlated; the ratio of the two
    is found by restricted likelihood. A measured heading is smoothed by the gyro's output before
    it serves as the regressor, which makes this the errors-in-variables likelihood.

    A robot follows its profile late and smoothly, so delay and lag are fitted too: without them, a
    first-order lag of 0.2 s causes 0.9 % of scale factor error. The lag is of first order against
    a profile of rates, which a robot only follows; against headings, which were measured on the
    robot itself, it is small and taken to second order. Other deviations from a profile
    (`following`) are fitted within their priors, and so is a stretch with a turn of its own,
    weighted by its probability.

    Parameters
    ----------
    time : s since the start of the motion, shape (n,)
    rate : output of the gyro, rad/s, shape (n,)
    motion : of the gyro
    largest_time_offset : how late or early the gyro's stamps may be against the motion, s
    lag : prior standard deviation of the lag, s²; a sine does not separate it from the scale
    slip : largest standard deviation of the slip of each turn of a profile, as a fraction of it

    Raises
    ------
    DataRefused : gyro and motion hardly overlap

    """
    pairing = _Pairing(time, rate, motion, lag, slip)
    offset, found_lag = pairing.coarse_offset(
        largest_time_offset + (0.0 if pairing.sampled else FOLLOWING)), 0.0
    data = pairing.aligned(offset, found_lag)
    for parts in (data.parts[:1], data.parts, data.parts):
        before = offset
        mixture = _mixture(data, parts)
        estimate = _estimate(data, _Covariance(data, mixture.ratio), data.columns, mixture.prior)
        for _ in range(8):
            if pairing.sampled:
                estimate = _errors_in_variables(data, estimate)
            late = float(np.clip(estimate.values[2], -0.02, 0.02))
            lagging = 0.0 if pairing.sampled else max(float(estimate.values[3]), -found_lag)
            if abs(late) < 1e-9 and abs(lagging) < 1e-9:
                break
            offset, found_lag = offset - late, found_lag + lagging
            data = pairing.aligned(offset, found_lag)
            estimate = _estimate(data, _Covariance(data, estimate.noise.ratio), data.columns,
                                 estimate.prior)
        if len(parts) == len(data.parts) and abs(offset - before) < _ALIGNED:
            break
    values, late = estimate.values[:2], math.sqrt(mixture.covariance[2, 2])
    covariance = mixture.covariance[:2, :2]
    found, edges, inside, chance = _unlikeliest(estimate, data)
    if pairing.sampled:
        # noise during turns only, such as slip of wheels, exceeds its robust estimate
        chance = max(chance, math.sqrt(max(found.left, 0.0) / (len(inside) - 4.0)))
    else:
        values = mixture.values[:2]
        part, others, covered = _of_stretch(estimate, data, found, inside, chance)
        apart = others - values
        covariance = ((1.0 - part) * covariance + part * covered
                      + part * (1.0 - part) * np.outer(apart, apart))
        values = values + part * apart
    scale, bias = values.tolist()
    # with a slip, first the columns of the differences between turns, then of the ends of turns
    slips = mixture.values[data.prior == slip]
    slips = slips[:len(slips) // 2]
    begin, end = data.time[edges[[found.first, found.last]]].tolist()
    return Fit(scale - 1.0, bias, covariance, offset, math.sqrt(estimate.rate_variance),
               math.sqrt(estimate.rate_variance * estimate.noise.ratio)
               / abs(_away_from_zero(estimate.values[0])),
               (abs(found.rate) * float(inside.sum()), math.sqrt(found.gain) / chance), late,
               np.column_stack([estimate.influence, data.time[1:]]),
               (begin, end),
               *(_start_heading(data, estimate) if pairing.sampled else (math.nan, math.nan)),
               *_squares(data, estimate, pairing.sampled),
               slip=math.sqrt(float(np.mean(slips ** 2))) if slip and len(slips) else 0.0)


#: The noise is estimated again where the offset changed by more than this, s.
_ALIGNED = 1e-3
#: Largest additional delay of a robot that follows its profile with a lag, s.
FOLLOWING = 0.25


def _squares(data: _Increments, estimate: _Estimate, sampled: bool) -> tuple[float, float]:
    """Return weighted sum of squares and degrees of freedom; a profile itself has no noise."""
    if not sampled:
        estimate = _estimate(data, _Covariance(data, 0.0), data.columns, estimate.prior)
    return (float(estimate.residual @ estimate.noise.solve(estimate.residual)),
            estimate.freedom + (not sampled))  # the ratio of the noises is not estimated


def _start_heading(data: _Increments, estimate: _Estimate) -> tuple[float, float]:
    """
    Return the true heading where gyro and reference begin, and its standard deviation, rad.

    It is relative to the reference's first heading. The expected noise of the first block's
    heading, given all that follows, is subtracted, and then the gyro's turn before that block.

    """
    heading, since, shared, turned = (data.since[0], data.since[1], data.since[2:-1],
                                      data.since[-1])
    scale, bias = _away_from_zero(estimate.values[0]), estimate.values[1]
    prior, first = estimate.noise.ratio * data.reference[0], np.eye(len(data.turned))[0]
    error = prior * float(estimate.noise.solve(estimate.residual)[0])
    weighted = estimate.noise.solve(data.columns)
    left = (float(estimate.noise.solve(first)[0])
            - weighted[0] @ np.linalg.pinv(weighted.T @ data.columns, rcond=1e-14) @ weighted[0])
    variance = (estimate.rate_variance * (max(prior - prior ** 2 * left, 0.0) + since / 3.0)
                + since ** 2 * estimate.covariance[1, 1])
    variance += shared @ estimate.covariance[4:, 4:] @ shared
    start = heading + (shared @ estimate.values[4:] - error - turned + bias * since) / scale
    return float(start), math.sqrt(variance) / abs(scale)


@dataclass(frozen=True)
class Stretch:
    """
    The stretch of a run that improves a fit most by a turn of its own.

    Attributes
    ----------
    first, last : edges that it begins and ends at
    rate : its excess rate, rad/s
    gain, left : sum of squares that it explains, and that remains
    gains, squares : sums of squares that each stretch explains, and of its column without the part
        that the fit explains, for all stretches that are distinguishable from the fit, shape (m,)

    """

    first: int
    last: int
    rate: float
    gain: float
    left: float
    gains: Array
    squares: Array

    def odds(self, freedom: float, rate: float, chance: float) -> float:
        """
        Return the mean odds of all stretches, each against none.

        Parameters
        ----------
        freedom : remaining degrees of freedom
        rate : standard deviation of the excess rates that are expected, rad/s
        chance : standard deviation of the white noise

        """
        none = max(self.left + self.gain, 1e-300)
        odds = -0.5 * (freedom * np.log1p(-np.minimum(self.gains / none, 1.0 - 1e-15))
                       + np.log1p(self.squares * (rate / chance) ** 2))
        return float(np.exp(np.minimum(odds, 100.0)).sum()) / max(len(odds), 1)


#: A turn that the profile does not contain, by hand or by a single slip: standard deviation of its
#: rate, rad/s, and its prior odds.
TURNED, TURNED_ODDS = 0.0175, 0.1
#: Largest number of places of a run at which a stretch begins or ends.
_EDGES = 150


def _unlikeliest(estimate: _Estimate, data: _Increments) -> tuple[
        Stretch, NDArray[np.intp], Array, float]:
    """
    Return the unlikeliest stretch, the edges, its increments at 1 rad/s, s, and the noise.

    The values are fitted together with the excess turn of each stretch, so that they do not absorb
    a slip. The standard deviation of the noise is that of a robust fit.

    """
    noise, interval = estimate.noise, data.columns[:, 1]
    shared = data.columns[:, 4:] @ estimate.values[4:]
    robust = noise.whiten(robust_residual(data.columns[:, :4], data.turned - shared, 20))
    chance = max(float(np.median(np.abs(robust))) / 0.6745
                 * math.sqrt(len(robust) / (len(robust) - 4.0)), 1e-15)
    edges = np.unique(np.linspace(0, len(robust), min(len(robust), _EDGES) + 1).astype(np.intp))
    steps = np.where(np.arange(len(robust))[:, None] >= edges, interval[:, None], 0.0)
    prior = chance / estimate.prior
    found = unlikeliest(np.vstack([noise.whiten(data.columns), np.diag(prior)]),
                        np.vstack([noise.whiten(steps), np.zeros((len(prior), len(edges)))]),
                        np.append(noise.whiten(data.turned), prior * data.expected))
    return found, edges, steps[:, found.first] - steps[:, found.last], chance


def _of_stretch(estimate: _Estimate, data: _Increments, found: Stretch,
                inside: Array, chance: float) -> tuple[float, Array, Array]:
    """Return the probability of a stretch with a turn of its own, and (1 + s, b) with it."""
    odds = TURNED_ODDS * found.odds(estimate.freedom - 1.0, TURNED, chance)
    widened = replace(data, columns=np.insert(data.columns, 4, inside, axis=1),
                      expected=np.insert(data.expected, 4, 0.0))
    other = _estimate(widened, estimate.noise, widened.columns,
                      np.insert(estimate.prior, 4, TURNED))
    return odds / (1.0 + odds), other.values[:2], other.covariance[:2, :2]


def unlikeliest(columns: Array, steps: Array, turned: Array) -> Stretch:
    """
    Return the stretch that improves a fit most.

    Parameters
    ----------
    columns : of the fit, white, shape (n, k)
    steps : the addition of a turn of 1 rad/s from each edge on, white, shape (n, m); the last edge
        is the end
    turned : what is fitted, white, shape (n,)

    """
    left, singular, _ = np.linalg.svd(
        columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300), full_matrices=False)
    left = left[:, singular > 1e-7]
    apart = steps - left @ (left.T @ steps)
    sums, products, whole = apart.T @ turned, apart.T @ apart, steps.T @ steps
    differences = sums[:, None] - sums
    norms, wholes = (np.add.outer(np.diag(matrix), np.diag(matrix)) - 2.0 * matrix
                     for matrix in (products, whole))
    # neither stretches that scale and bias explain nearly as well, nor empty ones
    distinct = np.triu(norms > _APART * wholes, 1)
    gains = np.where(distinct, differences ** 2 / np.where(distinct, norms, 1.0), 0.0)
    first, last = np.unravel_index(int(gains.argmax()), gains.shape)
    gain = float(gains[first, last])
    return Stretch(int(first), int(last),
                   float(differences[first, last] / max(norms[first, last], 1e-300)), gain,
                   float(turned @ turned - np.sum((left.T @ turned) ** 2)) - gain,
                   gains[distinct], norms[distinct])


#: Fraction of a stretch that the columns of a fit must not explain, so that the two are
#: distinguishable; with less, noise gives a stretch a large turn.
_APART = 0.2
