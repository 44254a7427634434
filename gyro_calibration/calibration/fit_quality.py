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
from gyro_calibration.calibration.noise_grid import BandedNoise, GridFit, noise_grid
from gyro_calibration.heading.integration import integrate
from gyro_calibration.logs.log import Array, DataRefused, DEGREE
from gyro_calibration.model.motion import Motion
import numpy as np
from scipy.special import chdtr

#: A run is looked at again in so many windows.
_WINDOWS = 16
#: How often a fit to noise that adds up is looked at again in vain.
_CHANCE = 1e-3

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
    by restricted likelihood with less of it (`noise_grid`). The variance counts twice, for what
    wanders more slowly than the run lasts does not show in it, and may be as large.

    Parameters
    ----------
    fit : by `likelihood.fit_likelihood`
    time : s since the start of the motion, shape (n,)
    rate : output of the gyro, rad/s, shape (n,)
    motion : headings as measured; with a profile, which the robot follows late, the fit stays

    """
    windows = None if motion.rate is not None else _windows(fit, time, rate, motion)
    if windows is None:
        return fit
    walk, point = fit.angle_random_walk, max(windows.repeating, 1e-12)
    adding_up = _line(windows, (walk, walk), (1e-15, 1e-15))
    if not chdtr(_WINDOWS - 2, np.sum(adding_up.whiten(adding_up.residual) ** 2)) < _CHANCE:
        return fit
    found = _line(windows, (1e-3 * walk, walk), (1e-3 * point, point))
    weights = found.solve(np.diff(windows.time))
    slope = float(weights @ np.diff(windows.heading)) / float(weights @ np.diff(windows.time))
    scale_variance = fit.covariance[0, 0]
    covariance = np.array([[scale_variance, -slope * scale_variance],
                           [-slope * scale_variance,
                            2.0 * found.covariance[0, 0] + slope ** 2 * scale_variance]])
    return replace(fit, bias=float(found.values[0]), covariance=covariance,
                   repeating=windows.repeating)


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


def _line(windows: _Windows, walk: tuple[float, float], point: tuple[float, float]) -> GridFit:
    """Fit a bias, with ranges of N, rad/√s, and of the errors of the means of windows, rad."""
    ones = np.ones(len(windows.time) - 1)
    return noise_grid(
        np.diff(windows.turned), np.diff(windows.time)[:, None],
        [BandedNoise('angle_random_walk', 2.0 / 3.0 * windows.length * ones,
                     windows.length / 6.0 * ones, walk),
         BandedNoise('reference', 2.0 * ones, -ones, point)])


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
        raise DataRefused(f'the heading error is {fit.repeating / DEGREE:.1f} deg rms and '
                          f'repeats with the motion, at most {limit / DEGREE:g} deg are allowed; '
                          'scale and bias do not explain it: turn more slowly and gently, fasten '
                          'the gyro, or sample faster')


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
