"""
Scale factor error and bias from about 20 s of known motion, with the reasons to refuse.

The gyro is taken as ``output = (1 + s) rate + b + noise`` (Hong and Park, eq. 1). Three methods: the paper's two as they stand, and a
likelihood fit that has neither their errors nor needs the start of the motion to the millisecond.

"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from gyro_calibration.likelihood import CHANCE, Fit, fit_likelihood
from gyro_calibration.log import DEGREE, Array, DataRefused
from gyro_calibration.model import SelfCalibration
from gyro_calibration.motion import Motion
from gyro_calibration.noise import ALLAN_FLOOR, Noise


@dataclass(frozen=True)
class Limits:
    """
    What a run must keep to be believed.

    Attributes
    ----------
    samples : at least so many
    gap : no longer one between samples, s
    rate_spread : the standard deviation of the profile's rate is at least this, rad/s; one speed cannot part scale from bias
    scale_factor_error : at most this, 1
    bias : at most this, rad/s
    scale_standard_deviation : the scale is known at least so well, 1
    residual : no stretch of the run may turn otherwise than the profile by more than this beyond chance, rad
    time_offset : the gyro may lag the profile by at most this, either way, s

    """

    samples: int = 50
    gap: float = 0.5
    rate_spread: float = 1.0 * DEGREE
    scale_factor_error: float = 0.3
    bias: float = 10.0 * DEGREE
    scale_standard_deviation: float = 0.02
    residual: float = 1.0 * DEGREE
    time_offset: float = 1.0


def fit_heading(time: Array, rate: Array, motion: Motion) -> Fit:
    """
    Fit by Hong and Park's heading reference as it stands (eq. 4 to 7).

    The rectangle rule of eq. 4 is kept: against a continuous heading it errs by several percent where the sampling is slow.

    Parameters
    ----------
    time : s since the start of the motion, shape (n,)
    rate : output of the gyro, rad/s, shape (n,)

    """
    step = np.diff(time)
    g = np.column_stack([np.cumsum(step * rate[:-1]), np.cumsum(step)])
    z = motion.heading_at(time[1:]) - motion.heading_at(time[:1])
    scale, offset = _solve(g.T @ g, g.T @ z)
    return _from_inverse(scale, offset)


def fit_rate(time: Array, rate: Array, motion: Motion) -> Fit:
    """
    Fit by Hong and Park's rate reference (eq. 8 and 9), the columns of the matrix in the order that q = [s̄, b̄] wants.

    Parameters
    ----------
    time : s since the start of the motion, shape (n,)
    rate : output of the gyro, rad/s, shape (n,)

    """
    true = motion.rate_at(time)
    g = np.array([[rate @ rate, rate.sum()], [rate.sum(), len(rate)]])
    scale, offset = _solve(g, np.array([true @ rate, true.sum()]))
    return _from_inverse(scale, offset)


def _solve(matrix: Array, vector: Array) -> Array:
    if not np.linalg.cond(matrix) < 1e12:
        raise DataRefused('the gyro did not change its rate, so scale and bias cannot be parted: turn both ways, with stops')
    return np.linalg.solve(matrix, vector)


def _from_inverse(scale: float, offset: float) -> Fit:
    """Turn s̄ and b̄ of eq. 3 into s and b."""
    return Fit(float(1.0 / scale - 1.0), float(-offset / scale), np.full((2, 2), np.nan))


METHODS = {'likelihood': fit_likelihood, 'heading': fit_heading, 'rate': fit_rate}


def self_calibrate(time: Array, rate: Array, motion: Motion, method: str = 'likelihood', limits: Limits | None = None,
                   noise: Noise | None = None) -> Fit:
    """
    Fit a run by one of `METHODS` and refuse what cannot be believed.

    Parameters
    ----------
    time : s since the start of the motion, shape (n,)
    rate : output of the gyro, after its model if it has one, rad/s, shape (n,)
    noise : of the gyro, if it is known; the wander of the bias goes into its standard deviation

    Raises
    ------
    DataRefused : with the reason and the remedy

    """
    limits = limits or Limits()
    _refuse_samples(time, rate, limits)
    _refuse_motion(time, motion, limits)
    if method == 'likelihood':
        fit = fit_likelihood(time, rate, motion, limits.time_offset)
    else:
        fit = METHODS[method](time, rate, motion)
    fit = replace(fit, covariance=fit.covariance + np.diag([0.0, _wander(noise)]))
    _refuse_fit(fit, motion, limits)
    return fit


def _wander(noise: Noise | None) -> float:
    """Return the variance of the bias, (rad/s)², that no averaging takes away."""
    return 0.0 if noise is None else (ALLAN_FLOOR * noise.bias_instability) ** 2


def _refuse_samples(time: Array, rate: Array, limits: Limits) -> None:
    if len(time) < limits.samples:
        raise DataRefused(f'only {len(time)} samples came; at least {limits.samples} are needed: look at the gyro\'s line and rate')
    if not np.isfinite(rate).all():
        raise DataRefused(f'{np.sum(~np.isfinite(rate))} samples are not a finite number: leave them out, or mend the line')
    gap = float(np.diff(time).max())
    if gap > limits.gap:
        raise DataRefused(f'no samples came for {gap:.2f} s; at most {limits.gap:g} s may be missing: mend the line and run again')
    refuse_dead(rate)


def refuse_dead(rate: Array) -> None:
    """Refuse samples of one value."""
    if np.ptp(rate) == 0.0:
        raise DataRefused(f'all {len(rate)} samples have the same value, {rate[0]:g} rad/s: the gyro is dead or not powered')


def _refuse_motion(time: Array, motion: Motion, limits: Limits) -> None:
    if not np.isfinite(motion.heading).all():
        raise DataRefused('the reference was lost somewhere in the profile: leave those points out, or run again')
    points = np.arange(0.0, motion.duration, 0.05)
    spread = float(np.std(motion.rate_at(points)))
    if spread < limits.rate_spread:
        raise DataRefused(f'the profile turns at one speed (its rate varies by {spread / DEGREE:.2f} deg/s): scale and bias '
                                 'cannot be parted; turn both ways, with stops')
    if time[-1] - time[0] < 0.9 * motion.duration - 2.0 * limits.time_offset:
        covered = time[-1] - time[0]
        raise DataRefused(f'the samples cover {covered:.1f} s of the profile\'s {motion.duration:.1f} s: record the whole motion')


def refuse_scale(s: float, reference: str, remedy: str) -> None:
    """Refuse a gyro that saw next to nothing of what the reference turned, or all of it the other way, with what puts its sign right."""
    if abs(1.0 + s) < 0.5:
        raise DataRefused(f'the gyro saw {100 * (1 + s):.0f} % of the {reference}\'s turns: did the robot move, and is the gyro alive?')
    if s < -1.5:
        raise DataRefused(f'the gyro turns the other way than the {reference} (scale {1 + s:.2f}): {remedy}')


def _refuse_fit(fit: Fit, motion: Motion, limits: Limits) -> None:
    s, b = fit.scale_factor_error, fit.bias
    refuse_scale(s, 'profile', 'set the driver\'s parameter invert')
    turned, size = fit.residual
    if turned > limits.residual:
        raise DataRefused(f'a stretch of the run turned {turned / DEGREE:.1f} deg otherwise than the profile '
                                 f'({size:.0f} standard deviations): a slip or a bump; run again on free ground')
    deviation = math.sqrt(fit.covariance[0, 0])
    if abs(s) > limits.scale_factor_error + 3.0 * np.nan_to_num(deviation):
        raise DataRefused(f'a scale factor error of {100 * s:.0f} % is beyond {100 * limits.scale_factor_error:.0f} %: look at the '
                                 'sensitivity and at the profile\'s unit')
    if abs(b) > limits.bias:
        raise DataRefused(f'a bias of {b / DEGREE:.2f} deg/s is beyond {limits.bias / DEGREE:g} deg/s: '
                                 'was the robot turned by hand?')
    if deviation > limits.scale_standard_deviation:
        raise DataRefused(f'the scale factor error is known to {100 * deviation:.1f} % only, wanted '
                                 f'{100 * limits.scale_standard_deviation:g} %: turn further, faster, or more often, '
                                 'and check that the profile is the one that was driven')


def calibrate_bias(time: Array, rate: Array, limits: Limits | None = None, noise: Noise | None = None) -> tuple[float, float]:
    """
    Return the bias of a gyro at rest, rad/s, and its standard deviation (Ojeda et al., eq. 1, or 15 for compensated rates).

    The mean holds the Earth's rate about the axis. A turn slow and steady enough looks just like a bias: the limit on the bias is what
    guards against it.

    Parameters
    ----------
    time : s, shape (n,)
    rate : compensated by the model, rad/s, shape (n,)
    noise : of the gyro, if it is known; the mean is not taken to be better known than that allows

    Raises
    ------
    DataRefused : too few samples, a dead gyro, motion, or a mean that is no bias

    """
    limits = limits or Limits()
    _refuse_samples(time, rate, limits)
    blocks = np.array([block.mean() for block in np.array_split(rate, 10)])
    within = math.sqrt(np.mean([block.var(ddof=1) for block in np.array_split(rate, 10)]) / (len(rate) / 10))
    _refuse_change(np.abs(blocks - np.median(blocks)), np.full(10, within))
    _refuse_change(*_steps(blocks, within))
    # Ten blocks may scatter by half of what they should by chance.
    of_model = noise.angle_random_walk ** 2 / float(time[-1] - time[0]) if noise is not None else 0.0
    bias, deviation = float(rate.mean()), math.sqrt(max(blocks.var(ddof=1) / 10.0, of_model) + _wander(noise))
    if abs(bias) > limits.bias:
        raise DataRefused(f'a mean of {bias / DEGREE:.2f} deg/s is beyond {limits.bias / DEGREE:g} deg/s: '
                                 'the gyro turns, or is broken')
    if noise is not None and noise.angle_random_walk:
        _refuse_shaking(time, rate, noise)
    return bias, deviation


def _steps(blocks: Array, within: float) -> tuple[Array, Array]:
    """Return how far the mean after each block is from the mean before, and the standard deviation of that, shape (n - 1,) each."""
    first = np.arange(1, len(blocks))
    last = len(blocks) - first
    sums = np.cumsum(blocks)
    return np.abs((sums[-1] - sums[:-1]) / last - sums[:-1] / first), within * np.sqrt(1.0 / first + 1.0 / last)


def _refuse_change(changes: Array, deviations: Array) -> None:
    beyond = np.where(changes > np.maximum(CHANCE * deviations, 0.05 * DEGREE), changes, 0.0).max()
    if beyond:
        raise DataRefused(f'the gyro was moved: its mean changed by {beyond / DEGREE:.2f} deg/s within the rest; '
                                 'keep it still and run again')


def _refuse_shaking(time: Array, rate: Array, noise: Noise) -> None:
    expected = math.sqrt(noise.rate_variance(float(np.median(np.diff(time)))))
    if rate.std() > 3.0 * expected:
        raise DataRefused(f'the rate varies by {rate.std() / DEGREE:.2f} deg/s where rest gives {expected / DEGREE:.2f} deg/s: '
                                 'stop the robot and its motors, and run again')


def record(fit: Fit, method: str, time: str, temperature: float | None) -> SelfCalibration:
    """Return what a model keeps of a fit."""
    (a, b), (_, c) = fit.covariance.tolist()
    covariance = None if math.isnan(a) else ((a, b), (b, c))
    return SelfCalibration(fit.scale_factor_error, fit.bias, covariance, time, temperature, method)
