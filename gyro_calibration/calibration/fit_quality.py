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
What a fit to a known motion may be wrong by beyond its noise, and whether it is then of use.

The likelihood looks at blocks of half a second at most. A gyro that shakes on its mount, a
reversal between two samples, or an encoder out of centre err by as much there, but cancel over
longer times: such errors repeat with the motion, and do not add up.

"""

from __future__ import annotations

from dataclasses import dataclass, replace
import math

from gyro_calibration.calibration.likelihood import ASYMMETRY, Fit
from gyro_calibration.heading.integration import integrate
from gyro_calibration.logs.log import Array, DataRefused, DEGREE
from gyro_calibration.model.motion import Motion
import numpy as np
from scipy.special import chdtr

#: A run is looked at again in so many windows.
_WINDOWS = 16
#: How often a fit to noise that adds up is looked at again in vain.
_CHANCE = 1e-3
#: Ratios of the variance of errors of window means to what noise of the rate adds from window to
#: window that are tried.
_RATIOS = np.geomspace(1e-3, 1e4, 29)

#: A calibration is for a drive of this length, s, that ends so far from where it began, rad.
DRIVE, TURN = 300.0, 2.0 * math.pi


@dataclass(frozen=True)
class _Windows:
    """
    Means over windows of equal length, shape (n,) each, and what repeats with the motion.

    Attributes
    ----------
    length : of a window, s
    time, heading : means of times, s, and reference headings, rad
    turned : mean of what the gyro turned beyond the reference, rad
    repeating : standard deviation of that from its means within the windows, rad

    """

    length: float
    time: Array
    heading: Array
    turned: Array
    repeating: float


def look_slower(fit: Fit, time: Array, rate: Array, motion: Motion) -> Fit:
    """
    Return the fit with the bias by window means, where repeating errors spoil that of the blocks.

    The scale factor error and the time offset of the fit are taken; what the gyro turned beyond is
    averaged over 16 windows. Where these differ by less than the noise that the fit has found
    would make them, that noise does not add up: bias and deviation then are those of the windows,
    by restricted likelihood. The variance counts twice, for what wanders more slowly than the run
    lasts does not show in it, and may be as large.

    Parameters
    ----------
    fit : by `likelihood.fit_likelihood`
    time : s since the start of the motion, shape (n,)
    rate : output of the gyro, rad/s, shape (n,)
    motion : headings as measured; with a profile, which the robot follows late, the fit stays

    """
    windows = None if motion.rate is not None else _windows(fit, time, rate, motion)
    if windows is None or not _adds_up_to_less(windows, fit.angle_random_walk):
        return fit
    bias, variance, slope = _slow_bias(windows)
    scale_variance = fit.covariance[0, 0]
    covariance = np.array([[scale_variance, -slope * scale_variance],
                           [-slope * scale_variance,
                            2.0 * variance + slope ** 2 * scale_variance]])
    return replace(fit, bias=bias, covariance=covariance, repeating=windows.repeating)


def _windows(fit: Fit, time: Array, rate: Array, motion: Motion) -> _Windows | None:
    """Return the windows; None where one is empty, or hardly longer than a block of the fit."""
    at = motion.time + fit.time_offset
    inside = (at >= time[0]) & (at <= time[-1])
    at, heading = at[inside], motion.heading[inside]
    if len(at) < 2 * _WINDOWS:
        return None
    length = float(at[-1] - at[0]) / _WINDOWS
    place = np.minimum(((at - at[0]) / length).astype(np.intp), _WINDOWS - 1)
    count = np.bincount(place, minlength=_WINDOWS)
    if length < 1.0 or not count.all():
        return None
    beyond = np.interp(at, time, integrate(time, rate)) - (1.0 + fit.scale_factor_error) * heading
    middle, known, turned = (np.bincount(place, values) / count
                             for values in (at, heading, beyond))
    return _Windows(length, middle, known, turned, float(np.std(beyond - turned[place])))


def _walk(windows: _Windows, ratio: float) -> Array:
    """
    Return the covariance of increments between windows, s.

    They come of a random walk of unit variance per second, and of errors of the window means.

    """
    neighbours = np.eye(len(windows.time) - 1, k=1) + np.eye(len(windows.time) - 1, k=-1)
    return windows.length * ((2.0 / 3.0 + 2.0 * ratio) * np.eye(len(neighbours))
                             + (1.0 / 6.0 - ratio) * neighbours)


def _line(windows: _Windows, covariance: Array) -> tuple[float, float, float, Array]:
    """Return slopes of turn and heading over time, slope variance, and weighted squares left."""
    steps = np.diff(windows.time)
    weights = np.linalg.solve(covariance, steps)
    information = float(steps @ weights)
    turned = np.diff(windows.turned)
    bias, slope = (float(weights @ turned) / information,
                   float(weights @ np.diff(windows.heading)) / information)
    left = turned - bias * steps
    return bias, slope, 1.0 / information, left @ np.linalg.solve(covariance, left)


def _adds_up_to_less(windows: _Windows, angle_random_walk: float) -> bool:
    """Tell whether windows differ by less than a random walk would make them, beyond chance."""
    squares = _line(windows, angle_random_walk ** 2 * _walk(windows, 0.0))[3]
    return bool(chdtr(len(windows.time) - 2, squares) < _CHANCE)


def _slow_bias(windows: _Windows) -> tuple[float, float, float]:
    """
    Return the bias, its variance, and the slope of the heading over time.

    Every ratio of the noises counts by its likelihood.

    """
    freedom = len(windows.time) - 3  # the bias, and the ratio
    found, likelihoods = [], []
    for ratio in _RATIOS:
        covariance = _walk(windows, ratio)
        bias, slope, unit, squares = _line(windows, covariance)
        variance = float(squares) / freedom
        likelihoods.append(-0.5 * (freedom * math.log(max(variance, 1e-30))
                                   + np.linalg.slogdet(covariance)[1] - math.log(unit)))
        found.append((bias, freedom / (freedom - 2.0) * variance * unit, slope))
    weights = np.exp(np.array(likelihoods) - max(likelihoods))
    bias, variance, slope = np.average(found, axis=0, weights=weights).tolist()
    return (bias, variance + float(np.average((np.array(found)[:, 0] - bias) ** 2,
                                              weights=weights)), slope)


def allow_asymmetry(fit: Fit, rate: Array) -> Fit:
    """
    Return the fit with a small difference between both senses of turning in its covariance.

    For measured headings; against a profile the fit holds it. Such an error grows with the size of
    the rate. The run takes the part of it that looks like a rate and a bias for them. In a swing
    without rests, the mean size of the rate in each sense looks like a bias.

    """
    columns = np.column_stack([rate, np.ones(len(rate))])
    mistaken = np.linalg.lstsq(columns, np.abs(rate), rcond=None)[0]
    return replace(fit, covariance=fit.covariance + ASYMMETRY ** 2 * np.outer(mistaken, mistaken))


def refuse_repeating(fit: Fit, limit: float) -> None:
    """Refuse a run whose heading errs by more than a limit, rad, whatever scale and bias are."""
    if fit.repeating > limit:
        raise DataRefused(f'the heading is off by {fit.repeating / DEGREE:.1f} deg (rms) again '
                          f'and again with the motion, at most {limit / DEGREE:g} deg are '
                          'allowed, and no scale and bias take that away: turn more slowly and '
                          'gently, fasten the gyro, or sample faster')


def refuse_useless(fit: Fit, limit: float) -> None:
    """
    Refuse a calibration that makes a heading worse, by what it says itself.

    Parameters
    ----------
    limit : a heading known so well after a drive of five minutes and a whole turn, rad, is of use
        whatever it was before

    Raises
    ------
    DataRefused : the heading would be known less well than the limit, and not better than without
        the calibration

    """
    after = math.sqrt((fit.covariance[1, 1] * DRIVE + 2.0 * fit.covariance[0, 1] * TURN) * DRIVE
                      + fit.covariance[0, 0] * TURN ** 2)
    before = math.hypot(fit.bias * DRIVE, fit.scale_factor_error * TURN)
    if after > max(limit, before):
        raise DataRefused(f'the bias is known to {math.sqrt(fit.covariance[1, 1]) / DEGREE:.3f} '
                          'deg/s only, which lets a heading drift by '
                          f'{after / DEGREE:.0f} deg in five minutes; without the calibration it '
                          f'is {before / DEGREE:.0f} deg: turn more slowly, with rests, or for '
                          'longer')
