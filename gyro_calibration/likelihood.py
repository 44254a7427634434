"""
The likelihood of what a gyro said, given the heading that it turned through: scale factor error, bias, delay and lag, and how sure.

Everything is done on increments between blocks of up to half a second: rates integrated by the trapezoid rule against the reference.

"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded, solve_banded

from gyro_calibration.heading import integrate
from gyro_calibration.log import Array, DataRefused
from gyro_calibration.motion import Motion


@dataclass(frozen=True)
class Fit:
    """
    What a method found.

    Attributes
    ----------
    scale_factor_error, bias : s, 1, and b, rad/s
    covariance : of (s, b), shape (2, 2); nan where the method gives none
    time_offset : the gyro lags the profile by so much, s
    angle_random_walk, reference_noise : as the run shows them, rad/√s and rad
    residual : largest stretch that turned otherwise than the profile, rad, and how unlikely it is, in standard deviations

    """

    scale_factor_error: float
    bias: float
    covariance: Array
    time_offset: float = 0.0
    angle_random_walk: float = math.nan
    reference_noise: float = math.nan
    residual: tuple[float, float] = (0.0, 0.0)


#: Standard deviations that no stretch reaches by chance: 10 000 stretches, all runs of a robot's life.
CHANCE = 7.0


@dataclass(frozen=True)
class _Increments:
    """
    How far the gyro and the reference turned from block to block, each block being a mean over some points.

    Attributes
    ----------
    columns : reference increments, rad; intervals, s; what a time offset adds, rad/s; what a lag adds, rad/s²; shape (n, 4)
    turned : increments of the gyro's integral, rad, shape (n,)
    points : in a block
    resting : what the encoder's rounding adds wherever the reference stands, one column a stand, rad, shape (n, stands)

    """

    columns: Array
    turned: Array
    points: int
    resting: Array


#: Longest block, s. What a run does within it (vibration, backlash, an eccentric encoder) is no random walk and must not be taken for one.
_BLOCK = 0.5


class _Pairing:
    """A run and a motion, brought together at any time offset."""

    def __init__(self, time: Array, rate: Array, motion: Motion):
        self._time, self._rate, self._motion = time, rate, motion
        self._integral = integrate(time, rate)
        self.sampled = motion.rate is None
        self._points = motion.time if self.sampled else np.arange(0.0, motion.duration + 1e-9, 0.01)
        self._step = _encoder_step(motion.heading) if self.sampled else 0.0
        self._points_in_block = max(1, round(min(_BLOCK, motion.duration / 40.0) / float(np.median(np.diff(self._points)))))

    def _known(self, offset: float) -> Array:
        """Return at every point reference heading, time, rate and gyro's integral, shape (n, 4), if the gyro is `offset` s late."""
        points = self._points[(self._points + offset >= self._time[0]) & (self._points + offset <= self._time[-1])]
        rate = np.interp(points + offset, self._time, self._rate)
        return np.column_stack([self._motion.heading_at(points), points, rate, self._integral_at(points + offset, rate)])

    def increments(self, offset: float) -> _Increments:
        """Return the increments if the gyro is `offset` s late."""
        known = self._known(offset)
        blocks = len(known) // self._points_in_block
        grouped = known[:blocks * self._points_in_block].reshape(blocks, self._points_in_block, 4)
        steps = np.diff(grouped.mean(axis=1), axis=0)
        accelerations = (grouped[:, -1, 2] - grouped[:, 0, 2]) / max(grouped[0, -1, 1] - grouped[0, 0, 1], 1e-9)
        columns = np.column_stack([steps[:, :3], np.diff(accelerations)])
        resting = np.diff(_stands(grouped[:, :, 0]), axis=0) * self._step / math.sqrt(12.0)
        return _Increments(columns, steps[:, 3], self._points_in_block, resting)

    def _integral_at(self, at: Array, rate: Array) -> Array:
        """Return the integral of the rate that is linear between the samples."""
        index = np.clip(np.searchsorted(self._time, at, side='right') - 1, 0, len(self._time) - 1)
        return self._integral[index] + 0.5 * (at - self._time[index]) * (rate + self._rate[index])

    def coarse_offset(self, largest: float) -> float:
        """Return the offset, s, at which most increments fit; a slip does not count more than the blocks that it is in."""
        offsets = np.arange(-round(largest / 0.02), round(largest / 0.02) + 1) * 0.02
        return float(min(offsets, key=lambda offset: (self._misfit(offset), abs(offset))))

    def _misfit(self, offset: float) -> float:
        data = self.increments(offset)
        if len(data.turned) < 10:
            return math.inf
        return float(np.mean(np.abs(_robust_residual(data.columns[:, :2], data.turned, 3))))


def _robust_residual(columns: Array, turned: Array, passes: int) -> Array:
    """Return what is left of a fit in which large residuals count by their size, not by its square (Huber)."""
    weights = np.ones(len(turned))
    for _ in range(passes):
        weighted = weights[:, None] * columns
        residual = turned - columns @ np.linalg.lstsq(weighted.T @ columns, weighted.T @ turned, rcond=1e-14)[0]
        size = np.abs(residual)
        weights = 1.0 / np.maximum(size, max(float(np.median(size)), 1e-12))
    return residual


def _encoder_step(heading: Array) -> float:
    """Return the step of an encoder's heading, rad, or 0 where the heading is no multiple of one."""
    steps = np.abs(np.diff(heading))
    moved = steps[steps > 1e-9]
    if not len(moved):
        return 0.0
    step = float(np.median(moved[moved < 1.5 * moved.min()]))
    return step if np.abs(moved / step - np.round(moved / step)).max() < 0.2 else 0.0


def _stands(headings: Array) -> Array:
    """Return which blocks, shape (n, points), stand together at one heading: a column of ones and zeros for each stand."""
    still = np.ptp(headings, axis=1) == 0.0
    begins = still & ~np.append(False, still[:-1] & (headings[1:, 0] == headings[:-1, 0]))
    number = np.cumsum(begins)
    return (still[:, None] & (number[:, None] == np.arange(1, number[-1] + 1))).astype(float)


class _Covariance:
    """
    Covariance of the increments, up to one factor: rate noise, and noise of the reference heading in each block.

    A random walk, averaged over blocks of m points, has increments of variance ``interval (2 m² + 1) / 3 m²`` and a covariance with the
    neighbours of ``interval (m² - 1) / 6 m²``; independent noise of the blocks adds ``2 ratio`` and ``-ratio``: a banded matrix.

    """

    def __init__(self, data: _Increments, ratio: float):
        intervals, squared = data.columns[:, 1], data.points ** 2
        band = np.zeros((2, len(intervals)))
        band[0, 1:] = np.sqrt(intervals[1:] * intervals[:-1]) * (squared - 1) / (6 * squared) - ratio
        band[1] = intervals * (2 * squared + 1) / (3 * squared) + 2.0 * ratio
        self.ratio = ratio
        self._factor = cholesky_banded(band)
        self.log_determinant = 2.0 * float(np.log(self._factor[1]).sum())

    def solve(self, vector: Array) -> Array:
        """Return the inverse times a vector or matrix."""
        return cho_solve_banded((self._factor, False), vector)

    def whiten(self, vector: Array) -> Array:
        """Return the vector as independent values of one variance."""
        lower = np.array([self._factor[1], np.append(self._factor[0, 1:], 0.0)])
        return solve_banded((1, 0), lower, vector)

    def reference_error(self, residual: Array) -> Array:
        """Return the part of the increments' residual that the noise of the headings is expected to be."""
        solved = np.concatenate([[0.0], self.solve(residual), [0.0]])
        return self.ratio * (2.0 * solved[1:-1] - solved[:-2] - solved[2:])


@dataclass(frozen=True)
class _Estimate:
    """Values of (1 + s, b, error of the time offset, lag), their covariance, and what is left."""

    values: Array
    covariance: Array
    residual: Array
    rate_variance: float
    log_likelihood: float


#: Variance of a block's reference noise over what the rate noise adds from block to block.
_RATIOS = np.geomspace(1e-3, 1e3, 19)
#: Standard deviations of what is assumed of s, b, time offset, s, and lag, s²; they matter only where the data do not show the two latter.
_PRIOR = np.array([math.inf, math.inf, 0.1, 0.1])


def _estimate(data: _Increments, noise: _Covariance, instrument: Array) -> _Estimate:
    """Solve the weighted normal equations; the restricted likelihood is that of the noise, the values being unknown."""
    freedom, weighted = len(data.turned) - 5, noise.solve(instrument)  # four values and the ratio of the noises
    matrix, vector = weighted.T @ data.columns, weighted.T @ data.turned
    rate_variance = 0.0
    for _ in range(3):
        regular = matrix + np.diag(rate_variance / _PRIOR ** 2)
        values = np.linalg.lstsq(regular, vector, rcond=1e-14)[0]
        residual = data.turned - data.columns @ values
        rate_variance = max(float(residual @ noise.solve(residual)) / freedom, 1e-30)
    inverse = np.linalg.pinv(regular, rcond=1e-14)
    resting = inverse @ (weighted.T @ data.resting)
    # the variance is estimated too, so that the values have Student's distribution, which is wider
    covariance = freedom / (freedom - 2) * rate_variance * inverse + resting @ resting.T
    log_determinants = noise.log_determinant + np.linalg.slogdet(regular)[1]
    return _Estimate(values, covariance, residual, rate_variance, -0.5 * (freedom * math.log(rate_variance) + log_determinants))


def _estimates(data: _Increments) -> tuple[list[_Covariance], list[_Estimate], Array]:
    """Return the estimates for every ratio of the two noises, and how likely each ratio is, summing to 1."""
    interval = float(np.median(data.columns[:, 1]))
    noises = [_Covariance(data, interval * ratio) for ratio in _RATIOS]
    estimates = [_estimate(data, noise, data.columns) for noise in noises]
    log_likelihoods = np.array([estimate.log_likelihood for estimate in estimates])
    weights = np.exp(log_likelihoods - log_likelihoods.max())
    return noises, estimates, weights / weights.sum()


def _errors_in_variables(data: _Increments, noise: _Covariance, estimate: _Estimate) -> _Estimate:
    """Estimate again with the reference heading smoothed by what the gyro says as the instrument."""
    for _ in range(3):
        instrument = data.columns.copy()
        instrument[:, 0] += noise.reference_error(estimate.residual) / _away_from_zero(estimate.values[0])
        estimate = _estimate(data, noise, instrument)
    return estimate


def _away_from_zero(scale: float) -> float:
    """Return the scale, but not one that a dead gyro has."""
    return math.copysign(max(abs(float(scale)), 1e-3), scale)


def fit_likelihood(time: Array, rate: Array, motion: Motion, largest_time_offset: float = 1.0) -> Fit:
    """
    Fit scale factor error, bias and time offset by likelihood.

    Rates are integrated by the trapezoid rule and compared with the reference heading increment by increment. The increments have noise
    of the rate (a random walk of the heading) and of the reference heading (an encoder's step), so that neighbours are correlated; the
    ratio of the two is found by restricted likelihood. A heading that was measured is smoothed by what the gyro says before it serves as
    the regressor, which makes this the errors-in-variables likelihood.

    A robot follows its profile late and smoothly, so delay and lag are fitted too, the lag to second order: left out, a first-order lag
    of 0.2 s costs 0.9 % of scale.

    Parameters
    ----------
    time : s since the start of the motion, shape (n,)
    rate : output of the gyro, rad/s, shape (n,)
    motion : what the gyro was put through
    largest_time_offset : how late or early the gyro's stamps may be against the motion, s

    Raises
    ------
    DataRefused : gyro and motion hardly overlap

    """
    pairing = _Pairing(time, rate, motion)
    offset = pairing.coarse_offset(largest_time_offset)
    for _ in range(6):
        data = pairing.increments(offset)
        if len(data.turned) < 10:
            raise DataRefused('the samples cover less than ten blocks of the profile: record the whole motion')
        noises, estimates, weights = _estimates(data)
        noise, estimate = noises[weights.argmax()], estimates[weights.argmax()]
        if pairing.sampled:
            estimate = _errors_in_variables(data, noise, estimate)
        step = float(np.clip(estimate.values[2], -0.02, 0.02))
        if abs(step) < 1e-9:
            break
        offset -= step
    covariance = np.tensordot(weights, [each.covariance for each in estimates], 1) + np.cov(
        np.array([each.values for each in estimates]).T, aweights=weights, ddof=0)
    scale, bias = estimate.values[:2]
    return Fit(float(scale) - 1.0, float(bias), covariance[:2, :2], offset, math.sqrt(estimate.rate_variance),
               math.sqrt(estimate.rate_variance * noise.ratio) / abs(_away_from_zero(scale)), _worst_stretch(noise, data))


def _worst_stretch(noise: _Covariance, data: _Increments) -> tuple[float, float]:
    """
    Return the largest stretch of the run that turned otherwise than the profile beyond chance, rad, and its size in standard deviations.

    All stretches of a few lengths are looked at. Fit and scale are robust, so that a slip does not hide itself.

    """
    residual = _robust_residual(data.columns, data.turned, 20)
    whitened = np.concatenate([[0.0], np.cumsum(noise.whiten(residual))])
    turned = np.concatenate([[0.0], np.cumsum(residual)])
    scale = max(float(np.median(np.abs(np.diff(whitened)))) / 0.6745, 1e-15)
    worst = (0.0, 0.0)
    for length in (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000):
        if length < len(whitened) / 2:
            sizes = np.abs(whitened[length:] - whitened[:-length]) / (scale * math.sqrt(length))
            turns = np.where(sizes > CHANCE, np.abs(turned[length:] - turned[:-length]), 0.0)
            worst = max(worst, (float(turns.max()), float(sizes[turns.argmax()])))
    return worst
