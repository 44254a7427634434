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

Everything is computed on increments between blocks of up to half a second, shorter where the
heading swings so fast that means would attenuate it: rates integrated by the trapezoid rule
against the reference. Errors within a block (vibration, backlash, an eccentric encoder) are no
random walk. The covariance of the increments is a banded matrix with one unknown ratio, and is
solved exactly for each ratio of a grid. A bias may wander by a random walk, of sizes of a grid.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
import math

from gyro_calibration.calibration.noise_grid import (
    average_hypotheses, bias_wander_columns, mean_walk_covariance, TridiagonalMatrix)
from gyro_calibration.calibration.run_faults import (
    DeviatingStretch, find_deviating_stretch, fit_profile, split_run)
from gyro_calibration.logs.log import Array, DataRefused, NORMAL_QUANTILE_975
from gyro_calibration.logs.quality import encoder_step, MISALIGNMENT_DEVIATION, robust_deviation
from gyro_calibration.model.motion import Motion
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline
from scipy.linalg import helmert
from scipy.special import softmax


@dataclass(frozen=True)
class GoodnessOfFit:
    """Comparison of the residual of a fit with the known noise."""

    chi_square: float  # sum of squares of the residual over the variance that is known
    dof: float  # degrees of freedom
    probability: float  # of as much, or more, by chance
    noise_ratio: float  # that accumulates in the heading, over the known one

    def __str__(self) -> str:
        """Return a sentence for people."""
        amount = ('as expected from the noise' if self.probability > MIN_FIT_PROBABILITY else
                  'larger than expected from the noise: the robot does not follow the motion '
                  'exactly, or vibrates')
        return (f'The residual is {amount} (chi-square {self.chi_square:.1f} with '
                f'{self.dof:.0f} degrees of freedom, probability {self.probability:.2g}; '
                f'noise {self.noise_ratio:.2f} times that of the model)')


#: Probability of a misfit by chance below which it is stated.
MIN_FIT_PROBABILITY = 1e-3


@dataclass(frozen=True)
class ScaleBiasFit:
    """The result of a fit."""

    scale_factor_error: float  # s, 1
    bias: float  # b, rad/s
    covariance: Array  # of (s, b), shape (2, 2); nan where the method gives none
    time_offset: float = 0.0  # how late the gyro is against the profile, s
    angle_random_walk: float = math.nan  # as the run shows it, rad/√s
    reference_noise: float = math.nan  # in one reading, as the run shows it, rad
    # largest deviation of a stretch of the run from the profile, rad, and in standard deviations
    stretch_residual: tuple[float, float] = (0.0, 0.0)
    time_offset_deviation: float = math.nan  # s
    # effect of the noise of each block on (s, b), and the times of the blocks, s, shape (n, 2 + 1)
    influence: Array = field(default_factory=lambda: np.empty((0, 3)))
    stretch_interval: tuple[float, float] = (0.0, 0.0)  # beginning and end of that stretch, s
    # true heading where the run begins, from the first one of a measured reference, and its
    # deviation, rad; nan against a profile
    start_heading: float = math.nan
    start_heading_deviation: float = math.nan
    residual_squares: float = math.nan  # their sum, in units of white noise of 1 rad/√s
    dof: float = 0.0  # degrees of freedom of these
    # ln of the likelihood of each ratio of the noises of gyro and reference, the variance of the
    # gyro's, rad²/s, and degrees of freedom, shape (k, 3)
    noise_profile: Array = field(default_factory=lambda: np.empty((0, 3)))
    goodness: GoodnessOfFit | None = None  # None where the noise is not known
    slip_deviation: float = 0.0  # of the fraction that each turn of a profile lost, 1
    # √6 times the rms of the difference of the headings that the fit leaves, rad
    heading_difference: float = math.nan
    rounding_variance: float = 0.0  # of a mean at a constant rate by output steps, (rad/s)²
    # drift in motion against rests, and half its interval of 95 %, rad/s; None without such rests
    reference_drift: tuple[float, float] | None = None
    reference_adds_up: bool = False  # whether the reference adds up its errors, as odometry
    # of s by a lag or smoothing that the motion does not determine; part of the covariance
    response_deviation: float = 0.0
    # of the axis of the gyro along the cross axes of an attitude, rad, (2,) or (0,); covariance
    misalignment: Array = field(default_factory=lambda: np.empty(0))
    misalignment_covariance: Array = field(default_factory=lambda: np.empty((0, 0)))
    # sizes of the error of a measured heading once in a revolution, rad, shape (2,), or none (0,)
    shaft_error: Array = field(default_factory=lambda: np.empty(0))


#: What to do about an oblique axis.
MISALIGNMENT_REMEDY = ('turn the axes of the attitude into those of the gyro, or turn about one '
                       'axis only; the model of one axis does not contain it')


def oblique_angle(misalignment: Array, covariance: Array) -> tuple[float, float, float]:
    """Return the angle of a misalignment, rad, half its interval of 95 %, and its p-value."""
    angle = float(np.hypot(*misalignment))
    along = misalignment / max(angle, 1e-300)
    square = float(misalignment @ np.linalg.pinv(covariance) @ misalignment)
    return (angle, NORMAL_QUANTILE_975 * math.sqrt(along @ covariance @ along),
            math.exp(-0.5 * square))  # the chi-squared distribution of two degrees of freedom


#: Limit of significance: noise does not exceed it in 10 000 stretches a run.
MAX_NOISE_SIGMAS = 7.0


@dataclass(frozen=True)
class _ReferencePoints:
    """
    Where the reference is known: times, s, headings, rad, and variances, shape (n,) each.

    The variances are known up to one factor. Errors that several points share have columns, (n,
    k), and prior standard deviations, (k,), times one row of the factors `prior_factors`, (m, k).
    """

    time: Array
    heading: Array
    variance: Array
    shared: Array
    shared_deviation: Array
    prior_factors: Array


@dataclass(frozen=True)
class _Increments:
    """Increments of headings of gyro and reference between blocks, each a mean over points."""

    # reference increments, rad; intervals, s; the change by a time offset, rad/s; by a lag,
    # rad/s²; by errors that several points share, rad; by a wandering bias, s; shape (n, m)
    columns: Array
    prior_deviation: Array  # prior standard deviations of the values, shape (m,)
    prior_factors: Array  # possible factors of the prior standard deviations, shape (l, m)
    prior_mean: Array  # prior means of the values, shape (m,)
    gyro_increments: Array  # increments of the gyro's integral, rad, shape (n,)
    # variance of increments of a random walk, and covariance with the one before, s, shape (n,)
    walk_variance: Array
    walk_covariance: Array
    # variance of the reference in each block, up to one factor, shape (n + 1,)
    reference_variance: Array
    time: Array  # of the blocks, s, shape (n + 1,)
    # of the first block against the first point: heading, time, shared errors, turn of the gyro
    start_offsets: Array
    # the change by a lag with accelerations by gyro and reference over `acceleration_time`, s,
    # rad/s², and by a term of the fourth order, rad/s⁴, shape (n, 3); empty for a profile
    accelerations: Array = field(default_factory=lambda: np.empty((0, 3)))
    acceleration_time: float = 0.0
    wander_count: int = 0  # number of the last columns, of a wandering bias


MAX_BLOCK_DURATION = 0.5  # s
#: Prior standard deviations: of the error of the present delay, s, and of the lag, s².
DELAY_DEVIATION, LAG_DEVIATION = 0.1, 0.1


class _RunAlignment:
    """A run and a motion, aligned at any time offset and lag."""

    def __init__(self, time: Array, rate: Array, motion: Motion, lag_deviation: float,
                 slip_deviation: float, cross_rotation: Array, bias_wanders: bool):
        self._time, self._rate, self._motion = time, rate, motion
        self.prior_deviation = np.array([math.inf, math.inf, DELAY_DEVIATION, lag_deviation])
        self._integral = make_interp_spline(time, rate, 1).antiderivative()
        # rate and acceleration are differences over this time to either side, s
        self._smoothing_time = max(float(np.median(np.diff(time))), 0.01)
        self._acceleration_time = self._smoothing_time
        self.is_measured, self._bias_wanders = motion.is_measured, bias_wanders
        self._block_duration = block_duration(motion)
        self._points = _select_reference_points(motion, self._block_duration, slip_deviation,
                                                cross_rotation)
        self.shaft_error: Array = np.zeros(2)  # in the columns of the shaft, rad
        self.has_shaft = self.is_measured and not cross_rotation.size

    def increments_at(self, offset: float, lag: float) -> _Increments:
        """
        Return the increments if the gyro is `offset` s late, part of it by a first-order lag.

        The output of a lag with the time constant √(2 `lag`), plus its rate times that, is the
        input. `DataRefused` is raised for hardly any.
        """
        points, constant = self._points, math.sqrt(2.0 * lag)
        gyro_time = points.time + offset - constant
        is_covered = (gyro_time >= self._time[0]) & (gyro_time <= self._time[-1])
        start = np.flatnonzero(is_covered)[:1]
        base = self._block_duration
        if self.is_measured:  # accelerations need a heading before and after
            for at, known in ((points.time, points.time), (gyro_time, self._time)):
                is_covered &= (at >= known[0] + base) & (at <= known[-1] - base)
        time, weight = points.time[is_covered], 1.0 / points.variance[is_covered]
        begins = np.flatnonzero(np.diff(np.floor((time - time[:1]) / base + 1e-6), prepend=-1.0))
        if len(begins) <= 10:
            raise DataRefused('the samples cover less than ten blocks of the motion: '
                              'record the whole motion')
        precision = np.add.reduceat(weight, begins)
        weight = weight / np.repeat(precision, np.diff(begins, append=len(time)))
        known = np.column_stack([points.heading[is_covered], time,
                                 *self._rate_and_integral(gyro_time[is_covered], constant),
                                 points.shared[is_covered]])
        means = np.add.reduceat(weight[:, None] * known, begins)
        columns = np.diff(np.delete(means, 4, axis=1), axis=0)
        prior = np.append(self.prior_deviation, points.shared_deviation)
        prior_factors = np.insert(points.prior_factors, [0] * 4, 1.0, axis=1)
        count = 0
        if self._bias_wanders:
            wander, (part,) = bias_wander_columns(means[:, 1], bias_instability=None)
            columns, count = np.column_stack([columns, wander]), wander.shape[1]
            prior = np.append(prior, np.sqrt(part.variance))
            prior_factors = np.array([
                np.append(factors, np.full(count, size))  # of the walk, rad/s/√s
                for factors in prior_factors for size in np.geomspace(1e-7, 1e-2, 6)])
        expected = np.zeros(len(prior))
        expected[3] = -lag
        last = np.append(begins[1:], len(time)) - 1
        walk = mean_walk_covariance(means[:, 1], time[last] - time[begins])
        accelerations = np.empty((0, 3))
        if self.is_measured:  # those by gyro and reference over a block, and the 4th order
            whole, half = (_second_difference(self._integral, gyro_time[is_covered], each)
                           for each in (base, 0.5 * base))
            of_reference = _second_difference(
                lambda at: np.interp(at, points.time, points.heading), time, base)
            accelerations = np.diff(np.add.reduceat(weight[:, None] * np.column_stack(
                [whole, of_reference, 16.0 * (whole - half) / base ** 2]), begins), axis=0)
        start_offsets = np.concatenate([
            [means[0, 0], means[0, 1] - points.time[start[0]]], means[0, 5:],
            means[0, 4] - self._rate_and_integral(gyro_time[start], constant)[2]])
        return _Increments(columns, prior, prior_factors, expected, np.diff(means[:, 4]), *walk,
                           1.0 / precision, means[:, 1], start_offsets, accelerations, base, count)

    def set_lag(self, lag: float) -> None:
        """Compute accelerations as in a Gaussian window of a lag, s² (Gauss and Hermite)."""
        self._acceleration_time = max(self._smoothing_time, min(
            math.sqrt(6.0 * abs(lag)), self._block_duration))

    def set_shaft_error(self, sizes: Array) -> None:
        """Compute the errors of a shaft at its headings without errors of these sizes, rad."""
        self.shaft_error = sizes
        self._points = replace(self._points, shared=_shaft_columns(correct_shaft(
            self._points.heading, sizes)))

    def _rate_and_integral(self, at: Array, constant: float) -> tuple[Array, Array, Array]:
        """Return rate, acceleration and integral of the rate at times, corrected for a lag."""
        base = self._smoothing_time
        integral, later, earlier = (self._integral(at + shift) for shift in (0.0, base, -base))
        rate = 0.5 * (later - earlier) / base
        acceleration = _second_difference(self._integral, at, self._acceleration_time)
        return rate + constant * acceleration, acceleration, integral + constant * rate

    def find_coarse_offset(self, largest: float) -> float:
        """Return the trial offset, s, at which gyro and motion agree best."""
        run = split_run(self._time, self._rate, self._motion)
        return fit_profile(run, self._motion, largest, 0.02)[2]


def _second_difference(heading: Callable[[Array], Array], at: Array, base: float) -> Array:
    """Return the acceleration by headings at times, s, and `base` before and after, rad/s²."""
    return (heading(at + base) - 2.0 * heading(at) + heading(at - base)) / base ** 2


def block_duration(motion: Motion) -> float:
    """Return the length of a block, s, over which the heading varies little."""
    block = min(MAX_BLOCK_DURATION, motion.duration / 40.0)
    time = np.arange(0.0, motion.duration, block / 64.0)
    heading = motion.heading_at(time[:len(time) // 64 * 64]).reshape(-1, 64)
    whole = np.var(heading)
    within = [np.var(heading.reshape(-1, size), axis=1).mean() for size in (64, 32, 16, 8, 4)]
    halvings = int(np.argmax(np.append(np.array(within) < 0.05 * whole, True)))
    return block / 2.0 ** halvings


def _select_reference_points(motion: Motion, block: float, slip_deviation: float,
                             cross_rotation: Array) -> _ReferencePoints:
    """Return where a motion is known: at its samples, or for an encoder where it steps."""
    if not motion.is_measured:
        time = np.arange(0.0, motion.duration + 1e-9, 0.01)
        return _ReferencePoints(time, motion.heading_at(time), np.ones(len(time)),
                                *tracking_error_columns(motion, time, slip_deviation))
    step = encoder_step(motion.heading)
    if cross_rotation.size:  # an attitude, which has no shaft
        ones = np.ones(cross_rotation.shape[1])
        return _ReferencePoints(motion.time, motion.heading, np.ones(len(motion.time)),
                                cross_rotation, MISALIGNMENT_DEVIATION * ones, ones[None])
    points = np.column_stack([motion.time, motion.heading, np.ones(len(motion.time))])
    if step:
        points = np.concatenate([_find_step_crossings(motion, step),
                                 _find_constant_readings(motion, step, block)])
        points = points[np.argsort(points[:, 0], kind='stable')]
    time, heading, variance = points.T
    return _ReferencePoints(time, heading, variance, _shaft_columns(heading),
                            np.full(2, math.radians(1.0)),
                            np.repeat(_PRIOR_FACTORS[:, None], 2, axis=1))


def _shaft_columns(heading: Array) -> Array:
    """Return the errors once in a revolution of a shaft, from the heading 0 on, shape (n, 2)."""
    return np.column_stack([np.sin(heading), np.cos(heading) - 1.0])


def correct_shaft(heading: Array, sizes: Array) -> Array:
    """Return the headings of a shaft that errs once in a revolution, by sizes in rad, (2,)."""
    corrected = heading
    for _ in range(3):
        corrected = heading + _shaft_columns(corrected) @ sizes
    return corrected


#: Standard deviation of the scale factor error by which the two senses of turning may differ.
ASYMMETRY_DEVIATION = 1e-4
#: Possible factors of the prior standard deviations of the response, and of slips.
_PRIOR_FACTORS = np.array([1e-3, 0.1, 1.0])


def tracking_error_columns(motion: Motion, time: Array,
                           slip_deviation: float) -> tuple[Array, Array, Array]:
    """
    Return the deviations from a profile that scale, bias, delay and lag do not describe.

    They are a scale that differs between the senses of turning, a response of higher order, a
    delay and a lag of each turn, and slips of each turn and of its deceleration, of a standard
    deviation of at most `slip_deviation`.

    Returns
    -------
    columns of headings, rad, shape (n, k), their prior standard deviations, shape (k,), and
    possible factors of these, shape (m, k)
    """
    rate, heading = motion.rate_at(time), motion.heading_at(time)
    sense, acceleration = np.sign(rate), np.gradient(rate, time)
    heading_change = np.diff(heading, prepend=heading[:1])[:, None]
    turn = np.where(sense, np.cumsum((sense != 0.0) & (np.diff(sense, prepend=0.0) != 0.0)), 0)
    count = min(int(turn.max()), 12)  # groups of turns with a delay and a lag of their own
    if count < 2:
        return np.empty((len(time), 0)), np.empty(0), np.ones((1, 0))
    inside = (-(-turn * count // turn.max()))[:, None] == np.arange(1, count + 1)
    # the mean over the turns is delay, lag and scale
    contrasts = helmert(count).T
    columns = [rate[:, None] * (inside @ contrasts), acceleration[:, None] * (inside @ contrasts)]
    delays = 0.2 * np.arange(1, 5)  # of a response of higher order, as of overshooting, s
    columns.append(np.column_stack([heading - 2.0 * motion.heading_at(time - late)
                                    + motion.heading_at(time - 2.0 * late) for late in delays]))
    deviations = [np.full(count - 1, DELAY_DEVIATION),
                  np.full(count - 1, 0.02),  # of the lag, s²
                  np.full(len(delays), 0.3)]
    slips = np.ones(1)
    if slip_deviation:
        ending = inside & (rate * acceleration < 0.0)[:, None]
        columns += [np.cumsum(heading_change * part, axis=0)
                    for part in (inside @ contrasts, ending)]
        deviations.append(np.full(2 * count - 1, slip_deviation))
        slips = _PRIOR_FACTORS
    of_response, of_slips = (each.reshape(-1, 1) for each in np.meshgrid(_PRIOR_FACTORS, slips))
    prior_factors = np.hstack([
        np.repeat(of_response, 2 * count - 2 + len(delays), axis=1),
        np.repeat(of_slips, (2 * count - 1) * bool(slip_deviation), axis=1)])
    if sense.min() < 0.0 < sense.max():
        columns.append(np.cumsum(np.abs(heading_change), axis=0))
        deviations.append(np.array([ASYMMETRY_DEVIATION]))
        prior_factors = np.append(prior_factors, np.ones((len(prior_factors), 1)), axis=1)
    return np.hstack(columns), np.concatenate(deviations), prior_factors


def _find_step_crossings(motion: Motion, step: float) -> Array:
    """
    Return the middles between lasting readings one step apart, with variances in units of theirs.

    There the heading is the edge between the two, but for the turn between the samples. The
    columns are time, heading and variance.
    """
    change = np.abs(np.diff(motion.heading))
    index = np.flatnonzero(change > 0.5 * step)
    time, heading = (0.5 * (values[index] + values[index + 1])
                     for values in (motion.time, motion.heading))
    speed = np.abs(np.diff(heading) / np.diff(time))
    relative_deviation = np.maximum(np.append(speed, 0.0), np.append(0.0, speed))[:len(time)]
    relative_deviation = np.where(change[index] > 1.5 * step, 1.0,
                                  np.clip(relative_deviation * np.diff(motion.time)[index] / step,
                                          0.05, 1.0))
    # the accuracy of a reference is seldom that of its slowest steps
    relative_deviation = (np.maximum(relative_deviation, np.median(relative_deviation))
                          if len(time) else relative_deviation)
    alone = np.diff(index, prepend=-1, append=len(change)) == 1
    edges = (change[index] < 1.5 * step) & ~(alone[1:] & alone[:-1])
    return np.column_stack([time, heading, relative_deviation ** 2])[edges]


def _find_constant_readings(motion: Motion, step: float, block: float) -> Array:
    """
    Return the readings that are constant for longer than a block, single ones, the first and last.

    All samples of a constant reading count as one. The columns are time, heading and variance.
    """
    change = np.abs(np.diff(motion.heading, prepend=motion.heading[0]))
    run = np.cumsum(change > 0.5 * step)
    begins = np.flatnonzero(np.diff(run, prepend=-1))
    ends = np.append(begins[1:], len(run)) - 1
    is_used = (motion.time[ends] - motion.time[begins] > block) | (ends == begins)
    is_used[[0, -1]] = True
    kept = is_used[run] | (change > 1.5 * step)
    return np.column_stack([motion.time, motion.heading, np.bincount(run)[run]])[kept]


def robust_residual(columns: Array, observed: Array, passes: int) -> Array:
    """Return the residual of a fit in which large residuals have a linear loss (Huber)."""
    weights = np.ones(len(observed))
    for _ in range(passes):
        weighted = weights[:, None] * columns
        residual = observed - columns @ np.linalg.lstsq(
            weighted.T @ columns, weighted.T @ observed, rcond=1e-14)[0]
        size = np.abs(residual)
        weights = 1.0 / np.maximum(size, max(float(np.median(size)), 1e-12))
    return residual


class _IncrementCovariance(TridiagonalMatrix):
    """Covariance of the increments, up to one factor, by rate and reference noise."""

    def __init__(self, data: _Increments, ratio: float):
        self.ratio, self._reference = ratio, ratio * data.reference_variance
        super().__init__(data.walk_variance + self._reference[1:] + self._reference[:-1],
                         data.walk_covariance - self._reference[:-1])

    def expected_reference_error(self, residual: Array) -> Array:
        """Return the expected contribution of the noise of the headings to the residual."""
        solved = np.concatenate([[0.0], self.solve(residual), [0.0]])
        return np.diff(self._reference * -np.diff(solved))


@dataclass(frozen=True)
class _Estimate:
    """Values of (1 + s, b, error of the time offset, lag, ...), with their covariance."""

    prior_deviation: Array
    values: Array
    covariance: Array
    residual: Array
    dof: float
    rate_variance: float
    noise: _IncrementCovariance
    log_likelihood: float
    weighted: Array  # inverse of the covariance times the instruments of the columns

    @property
    def inverse(self) -> Array:
        """Return the inverse of the normal matrix, with the priors."""
        return self.covariance * ((self.dof - 2.0) / (self.dof * self.rate_variance))

    def influence(self, data: _Increments) -> Array:
        """Return the effect of each block's noise and bias on (s, b), shape (n, 2)."""
        wander = data.columns.shape[1] - data.wander_count
        noise = self.residual + data.columns[:, wander:] @ self.values[wander:]
        return noise[:, None] * (self.weighted @ self.inverse[:2].T)


def _solve_weighted(data: _Increments, noise: _IncrementCovariance, weighted: Array,
                    prior: Array) -> _Estimate:
    """Solve the weighted normal equations, and compute the likelihood of noise and prior."""
    count = len(data.gyro_increments)
    matrix, known = weighted.T @ data.columns, np.isfinite(prior)
    # of the deviations from a solution without priors, of which rounding leaves more digits
    start = np.linalg.lstsq(matrix, weighted.T @ data.gyro_increments, rcond=1e-14)[0]
    rest = data.gyro_increments - data.columns @ start
    gradient, residual, dof = weighted.T @ rest, rest, max(count - len(prior) - 1.0, 1.0)
    # above rounding errors
    least = 1e-18 * float(np.mean(data.gyro_increments ** 2 / data.walk_variance))
    for _ in range(3):
        rate_variance = max(float(residual @ noise.solve(residual)) / dof, least)
        precision = rate_variance / prior ** 2
        regular = matrix + np.diag(precision)
        size = np.sqrt(np.abs(np.diag(regular)))
        scaled = regular / np.outer(size, size) + 1e-14 * np.eye(len(prior))
        inverse = np.linalg.inv(scaled) / np.outer(size, size)
        change = inverse @ (gradient - precision * (start - data.prior_mean))
        # the values that the priors leave open, and the ratio of the noises
        dof = max(count - 1.0 - float(np.trace(inverse @ matrix)), 3.0)
        residual = rest - data.columns @ change
    values = start + change
    log_likelihood = -0.5 * (
        (count - len(prior) - 1.0) * math.log(rate_variance) + dof + noise.log_determinant
        + np.sum(((values - data.prior_mean) / prior)[known] ** 2 + 2.0 * np.log(prior[known]))
        + np.linalg.slogdet(scaled)[1] + 2.0 * np.log(size).sum())
    if np.diag(inverse).min() < 0.0:  # an instrument without information
        log_likelihood = -1e300
    return _Estimate(prior, values, dof / (dof - 2.0) * rate_variance * inverse, residual, dof,
                     rate_variance, noise, float(log_likelihood), weighted)


def _average_over_noise(data: _Increments, prior_factors: Array,
                        has_shaft: bool) -> tuple[Array, Array, _Estimate, Array]:
    """
    Return means over all ratios of noises and factors of priors, and their covariance.

    The others are the likeliest estimate, and `ScaleBiasFit.noise_profile`.
    An error of the shaft is included only where the likelihoods show it: over less than a
    revolution it has nearly the effect of a scale factor error. Errors that repeat count once.
    """
    # variance of a block's reference noise over what the rate noise adds from block to block
    typical = float(np.median(data.walk_variance) / np.median(data.reference_variance))
    noises = [_IncrementCovariance(data, ratio) for ratio in np.geomspace(1e-3, 1e5, 25) * typical]
    estimates = [_solve_weighted(data, noise, weighted, data.prior_deviation * factors)
                 for noise in noises for weighted in [noise.solve(_instrument(data, noise))]
                 for factors in prior_factors]
    logarithms, values, covariances = (
        np.array([getattr(each, name) for each in estimates])
        for name in ('log_likelihood', 'values', 'covariance'))
    if has_shaft and len(prior_factors) > 1:
        has_error = np.tile(prior_factors[:, 4] > prior_factors[0, 4], len(noises))
        repeated = _repetition(data, estimates[int(logarithms.argmax())])
        # by the chi-squared distribution of two degrees of freedom
        if math.exp((logarithms[~has_error].max() - logarithms.max()) / repeated) > (
                MIN_FIT_PROBABILITY):
            logarithms[has_error] = -math.inf
    weights = softmax(logarithms)
    profile = np.column_stack([logarithms, [(each.rate_variance, each.dof) for each in estimates]])
    return (*average_hypotheses(weights, values, covariances), estimates[int(weights.argmax())],
            profile)


def _repetition(data: _Increments, estimate: _Estimate) -> float:
    """
    Return how many times the same errors occur, as in an even swing: 1 if all are independent.

    It is the mean square of the mean of blocks at one place and sense, times their number, over
    that of all.
    """
    turned, white = data.columns[:, 0], estimate.noise.whiten(estimate.residual)
    heading = np.cumsum(turned) - 0.5 * turned
    extent = min(max(float(np.ptp(heading)), 1e-9), math.tau)
    count = max(math.ceil(0.5 * len(white) * extent / float(np.abs(turned).sum())), 1)
    place = np.mod(np.floor((heading - heading.min()) / extent * count), count)
    group = np.unique(place + count * (turned > 0.0), return_inverse=True)[1]
    sums, counts = np.bincount(group, white), np.bincount(group)
    free = len(counts) - 5  # scale, lag, delay, and the two of the shaft
    if free < 1:
        return len(white) / len(counts)
    return max(float(np.sum(sums ** 2 / counts)) / free / float(np.mean(white ** 2)), 1.0)


def _instrument(data: _Increments, noise: _IncrementCovariance) -> Array:
    """
    Return the columns with an acceleration whose noise is not correlated with the observations.

    White noise N² of the gyro has the covariance -N² / base with an acceleration by the gyro, and
    headings of the variance r have 2 r / base² with one by the reference: in a mean both cancel.
    """
    columns = data.columns.copy()
    if len(data.accelerations):
        base = data.acceleration_time
        share = base / (base + 2.0 * noise.ratio * float(np.median(data.reference_variance)))
        columns[:, 3] = data.accelerations[:, :2] @ [1.0 - share, share]
    return columns


def _lag_prior(data: _Increments, estimate: _Estimate, offset: float,
               possible: float) -> tuple[float, float]:
    """
    Return the prior standard deviation of a lag, and that of the scale by what is not known of it.

    The motion determines a lag by the part of the acceleration that gyro and reference both show
    and the other columns do not explain, less two standard deviations. If it does so more narrowly
    than what is `possible`, s², or than the lag that is found, only the shape of the response is
    not known: from a mean over a time to a filter of first order. Else the lag is 0, as in a swing
    of one frequency, and what it may do to the scale is uncertain.
    """
    of_first_order = 0.5 * offset ** 2
    possible = max(possible, of_first_order)
    others = np.arange(data.columns.shape[1]) != 3
    columns = np.vstack([estimate.noise.whiten(data.columns[:, others]), np.diag(
        math.sqrt(estimate.rate_variance) / estimate.prior_deviation[others])])
    whole = np.pad(estimate.noise.whiten(data.accelerations), ((0, int(others.sum())), (0, 0)))
    scales = np.linalg.lstsq(columns, whole, rcond=1e-14)[0]
    left = whole - columns @ scales
    products = left.T @ left / estimate.rate_variance
    information = products[0, 1] - 2.0 * math.sqrt(
        products[0, 0] * products[1, 1] / len(data.accelerations))
    of_lag, lag = scales[0, :2].mean(), float(estimate.values[3])
    if information * max(possible, abs(lag) / NORMAL_QUANTILE_975) ** 2 > 1.0:
        of_fourth = scales[0, 2] - products[1, 2] / products[0, 1] * of_lag
        return math.inf, abs(lag * max(0.2 * abs(lag), of_first_order) * float(of_fourth))
    return 1e-9, possible * abs(float(of_lag))


def _nonzero_scale(scale: float) -> float:
    """Return the scale, limited to at least 0.001 either way, for a dead gyro."""
    return math.copysign(max(abs(float(scale)), 1e-3), scale)


def fit_likelihood(time: Array, rate: Array, motion: Motion, largest_time_offset: float = 1.0,
                   lag_deviation: float = LAG_DEVIATION, slip_deviation: float = 0.0,
                   cross_rotation: Array | None = None,
                   bias_wanders: bool = False) -> ScaleBiasFit:
    """
    Fit scale factor error, bias and time offset by likelihood.

    The increments have noise of the rate (a random walk of the heading) and of the reference
    heading (an encoder's step), so that neighbours are correlated; the ratio of the two is found
    by restricted likelihood. A measured heading is smoothed by the gyro's output before it serves
    as the regressor (errors in variables).

    A robot follows its profile late and smoothly: without delay and lag, a first-order lag of 0.2
    s causes 0.9 % of scale factor error. Against headings, which were measured on the robot
    itself, the lag is small and taken to second order. `tracking_error_columns` are fitted within
    their priors, and so is a stretch with a turn of its own. `DataRefused` is raised where gyro
    and motion hardly overlap.

    Parameters
    ----------
    time, rate : s since the start of the motion, and output of the gyro, rad/s, shape (n,)
    largest_time_offset : how late or early the gyro's stamps may be against the motion, s
    lag_deviation : prior standard deviation of the lag, s²; with a measured motion only where it
        does not determine the lag, as a sine does not
    slip_deviation : largest one of the slip of each turn of a profile, as a fraction of it
    cross_rotation : of the motion about the two axes across that of the reference, at the times of
        a measured motion, rad, shape (n, 2) or (n, 0); None where it is not known
    bias_wanders : whether it may do so by a random walk; it is then the mean over the motion
    """
    if cross_rotation is None:
        cross_rotation = np.empty((len(motion.time), 0))
    alignment = _RunAlignment(time, rate, motion, lag_deviation, slip_deviation,
                              cross_rotation, bias_wanders)
    offset, data, averages, averaged_covariance, estimate, profile, response_deviation = (
        _fit_offset(alignment, largest_time_offset))
    values = estimate.values[:2]
    covariance = averaged_covariance[:2, :2] + np.diag([response_deviation ** 2, 0.0])
    start = math.nan, math.nan
    found, edges, inside, noise_deviation = _find_stretch_of_fit(estimate, data)
    if alignment.is_measured:
        # noise during turns only, such as slip of wheels, exceeds its robust estimate
        noise_deviation = max(noise_deviation,
                              math.sqrt(max(found.remaining_squares, 0.0) / (len(inside) - 4.0)))
        start = _start_heading(data, estimate)
        alone = estimate
    else:
        values, covariance = _average_over_stretch(
            averages[:2], covariance, estimate, data, found, inside, noise_deviation)
        # a profile itself has no noise, so that the ratio of the noises is not estimated
        white = _IncrementCovariance(data, 0.0)
        alone = _solve_weighted(data, white, white.solve(data.columns), estimate.prior_deviation)
    scale, bias = values.tolist()
    of_axes = slice(4, 4 + cross_rotation.shape[1])
    of_shaft = slice(4, 6 if alignment.has_shaft else 4)
    begin, end = data.time[edges[[found.first, found.last]]].tolist()
    residual_squares = float(alone.residual @ alone.noise.solve(alone.residual))
    dof = alone.dof + (not alignment.is_measured)
    if not alignment.is_measured:
        profile = np.array([[0.0, residual_squares / dof, dof]])
    reference_noise = (math.sqrt(estimate.rate_variance * estimate.noise.ratio)
                       / abs(_nonzero_scale(estimate.values[0])))
    return ScaleBiasFit(
        scale - 1.0, bias, covariance, offset, math.sqrt(estimate.rate_variance), reference_noise,
        (abs(found.excess_rate) * float(inside.sum()),
         math.sqrt(found.explained_squares) / noise_deviation),
        math.sqrt(averaged_covariance[2, 2]),
        np.column_stack([estimate.influence(data), data.time[1:]]), (begin, end), *start,
        residual_squares, dof, profile, slip_deviation=_rms_slip(data, averages, slip_deviation),
        heading_difference=math.sqrt(6.0 * np.mean(np.cumsum(estimate.residual) ** 2)),
        response_deviation=response_deviation,
        misalignment=estimate.values[of_axes],
        misalignment_covariance=averaged_covariance[of_axes, of_axes],
        shaft_error=estimate.values[of_shaft] / _nonzero_scale(scale))


def _rms_slip(data: _Increments, values: Array, slip_deviation: float) -> float:
    """Return the root mean square of the slips of turns with a prior deviation, 0 without any."""
    # first the columns of the differences between turns, then of the ends of turns
    slips = values[data.prior_deviation == slip_deviation]
    slips = slips[:len(slips) // 2]
    return math.sqrt(np.mean(slips ** 2)) if slip_deviation and len(slips) else 0.0


def _fit_offset(alignment: _RunAlignment, largest_time_offset: float) -> tuple[
        float, _Increments, Array, Array, _Estimate, Array, float]:
    """
    Return the time offset, s, the increments there, and their fits.

    First values and covariance averaged over the noise, then the estimate at the likeliest one,
    the profile, and the deviation of the scale by a lag that the motion does not determine.
    """
    lag, largest_lag = 0.0, 0.0 if alignment.is_measured else MAX_TRACKING_LAG
    offset = alignment.find_coarse_offset(largest_time_offset + largest_lag)
    data = alignment.increments_at(offset, lag)
    possible, response_deviation = float(alignment.prior_deviation[3]), 0.0
    estimate: _Estimate | None = None
    for prior_factors in (data.prior_factors[:1], data.prior_factors, data.prior_factors):
        before, shaft_error = offset, alignment.shaft_error
        if alignment.is_measured:
            alignment.prior_deviation[3] = math.inf
            if estimate is not None:
                alignment.prior_deviation[3], response_deviation = _lag_prior(
                    data, estimate, offset, possible)
                alignment.set_lag(float(estimate.values[3]))
            data = alignment.increments_at(offset, lag)
        values, covariance, estimate, profile = _average_over_noise(data, prior_factors,
                                                                    alignment.has_shaft)
        for _ in range(8):
            for _ in range(3 * alignment.is_measured):
                # errors in variables: with the reference smoothed by the gyro as the instrument
                instrument = _instrument(data, estimate.noise)
                instrument[:, 0] += (estimate.noise.expected_reference_error(estimate.residual)
                                     / _nonzero_scale(estimate.values[0]))
                estimate = _solve_weighted(data, estimate.noise, estimate.noise.solve(instrument),
                                           estimate.prior_deviation)
            delay_change = float(np.clip(estimate.values[2], -0.02, 0.02))
            lag_change = 0.0 if alignment.is_measured else max(float(estimate.values[3]), -lag)
            if abs(delay_change) < 1e-9 and abs(lag_change) < 1e-9:
                break
            offset, lag = offset - delay_change, lag + lag_change
            data = alignment.increments_at(offset, lag)
            noise = _IncrementCovariance(data, estimate.noise.ratio)
            estimate = _solve_weighted(data, noise, noise.solve(_instrument(data, noise)),
                                       estimate.prior_deviation)
        if alignment.has_shaft:
            alignment.set_shaft_error(estimate.values[4:6] / _nonzero_scale(estimate.values[0]))
        if (len(prior_factors) == len(data.prior_factors)
                and abs(offset - before) < 1e-3
                and np.abs(alignment.shaft_error ** 2 - shaft_error ** 2).max() < 1e-6):
            break
    assert estimate is not None
    return offset, data, values, covariance, estimate, profile, response_deviation


#: Largest additional delay of a robot that follows its profile with a lag, s.
MAX_TRACKING_LAG = 0.25


def _start_heading(data: _Increments, estimate: _Estimate) -> tuple[float, float]:
    """
    Return the true heading where gyro and reference begin, and its standard deviation, rad.

    It is that of the first block less its expected noise and the gyro's turn before it.
    """
    heading, elapsed, shared, gyro_angle = (data.start_offsets[0], data.start_offsets[1],
                                            data.start_offsets[2:-1], data.start_offsets[-1])
    scale, bias = _nonzero_scale(estimate.values[0]), estimate.values[1]
    prior = estimate.noise.ratio * data.reference_variance[0]
    first = np.append(1.0, np.zeros(len(data.gyro_increments) - 1))
    error = prior * float(estimate.noise.solve(estimate.residual)[0])
    row = estimate.noise.solve(data.columns)[0]
    left = float(estimate.noise.solve(first)[0]) - row @ estimate.inverse @ row
    variance = (estimate.rate_variance * (max(prior - prior ** 2 * left, 0.0) + elapsed / 3.0)
                + elapsed ** 2 * estimate.covariance[1, 1])
    of_shared = slice(4, 4 + len(shared))
    variance += shared @ estimate.covariance[of_shared, of_shared] @ shared
    start = heading + (shared @ estimate.values[of_shared] - error - gyro_angle
                       + bias * elapsed) / scale
    return float(start), math.sqrt(max(variance, 0.0)) / abs(scale)


#: Standard deviation of a turn beside the profile, by hand or a slip, rad/s.
EXCESS_RATE_DEVIATION = 0.0175


def _find_stretch_of_fit(estimate: _Estimate, data: _Increments) -> tuple[
        DeviatingStretch, NDArray[np.intp], Array, float]:
    """
    Return the unlikeliest stretch, the edges, its increments at 1 rad/s, s, and the robust noise.

    The values are fitted with the excess turn of each stretch, so that they do not absorb a slip.
    """
    noise, interval = estimate.noise, data.columns[:, 1]
    shared = data.columns[:, 4:] @ estimate.values[4:]
    robust = noise.whiten(robust_residual(data.columns[:, :4], data.gyro_increments - shared, 20))
    noise_deviation = max(
        robust_deviation(robust) * math.sqrt(len(robust) / (len(robust) - 4.0)), 1e-15)
    edges = np.unique(
        np.linspace(0, len(robust), min(len(robust), 150) + 1).astype(np.intp))
    steps = np.where(np.arange(len(robust))[:, None] >= edges, interval[:, None], 0.0)
    prior = noise_deviation / estimate.prior_deviation
    found = find_deviating_stretch(
        np.vstack([noise.whiten(data.columns), np.diag(prior)]),
        np.vstack([noise.whiten(steps), np.zeros((len(prior), len(edges)))]),
        np.append(noise.whiten(data.gyro_increments), prior * data.prior_mean))
    return found, edges, steps[:, found.first] - steps[:, found.last], noise_deviation


def _average_over_stretch(
        values: Array, covariance: Array, estimate: _Estimate, data: _Increments,
        found: DeviatingStretch, stretch_column: Array,
        noise_deviation: float) -> tuple[Array, Array]:
    """Return (1 + s, b) and covariance, averaged over a stretch with a turn of its own or none."""
    total_squares = max(found.remaining_squares + found.explained_squares, 1e-300)
    logarithms = -0.5 * (
        (estimate.dof - 1.0) * np.log1p(-np.minimum(
            found.all_explained_squares / total_squares, 1.0 - 1e-15))
        + np.log1p(found.column_squares * (EXCESS_RATE_DEVIATION / noise_deviation) ** 2))
    # prior odds of 0.1, times the mean over all stretches, each against none
    odds = 0.1 * float(np.exp(np.minimum(logarithms, 100.0)).sum()) / max(len(logarithms), 1)
    widened = replace(data, columns=np.insert(data.columns, 4, stretch_column, axis=1),
                      prior_mean=np.insert(data.prior_mean, 4, 0.0))
    other = _solve_weighted(widened, estimate.noise, estimate.noise.solve(widened.columns),
                            np.insert(estimate.prior_deviation, 4, EXCESS_RATE_DEVIATION))
    return average_hypotheses(
        np.array([1.0, odds]) / (1.0 + odds), np.array([values, other.values[:2]]),
        np.array([covariance, other.covariance[:2, :2]]))
