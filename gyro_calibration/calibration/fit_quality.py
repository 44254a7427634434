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
Errors of a fit to a known motion that its noise does not contain, and refusal of imprecise fits.

The likelihood uses blocks of 0.5 s at most. The errors of a gyro that shakes on its mount, of a
reversal between two samples, or of an eccentric encoder repeat with the motion: within a block
they are as large as random errors, over longer times they cancel and do not accumulate.

"""

from __future__ import annotations

from dataclasses import replace
import math

from gyro_calibration.calibration.likelihood import ASYMMETRY_DEVIATION, ScaleBiasFit
from gyro_calibration.calibration.noise_grid import BandedNoise, fit_noise_grid, GridFit
from gyro_calibration.heading.integration import integrate
from gyro_calibration.logs.log import Array, DataRefused, DEGREE
from gyro_calibration.model.motion import Motion
import numpy as np
from scipy.special import chdtr

#: Number of windows of a run in the second fit of the bias.
_WINDOW_COUNT = 16
#: Duration of the drive, with a net turn of 360 degrees, for which the precision of a calibration
#: is judged, s.
DRIVE_DURATION = 300.0


def refit_bias_by_windows(fit: ScaleBiasFit, time: Array, rate: Array,
                          motion: Motion) -> ScaleBiasFit:
    """
    Return the fit with the bias by window means, where repeatable errors dominate the blocks.

    Scale factor error and time offset of the fit are kept; the remaining heading error is averaged
    over 16 windows. If the means differ by less than the noise of the fit implies, that noise does
    not accumulate: bias and deviation are then those of the windows, by restricted likelihood with
    a smaller noise (`noise_grid`). The variance is doubled, since a bias that wanders more slowly
    than the duration of the run is not observable in it and may be as large.

    Parameters
    ----------
    fit : by `likelihood.fit_likelihood`
    time : s since the start of the motion, shape (n,)
    rate : output of the gyro, rad/s, shape (n,)
    motion : headings as measured; with a profile, which the robot follows late, the fit is
        returned unchanged

    """
    gyro_time = motion.time + fit.time_offset
    inside = (gyro_time >= time[0]) & (gyro_time <= time[-1])
    gyro_time, heading = gyro_time[inside], motion.heading[inside]
    if motion.rate is not None or len(gyro_time) < 2 * _WINDOW_COUNT:
        return fit
    length = float(gyro_time[-1] - gyro_time[0]) / _WINDOW_COUNT
    place = np.minimum(((gyro_time - gyro_time[0]) / length).astype(np.intp), _WINDOW_COUNT - 1)
    count = np.bincount(place, minlength=_WINDOW_COUNT)
    if length < 1.0 or not count.all():
        return fit
    error = (np.interp(gyro_time, time, integrate(time, rate))
             - (1.0 + fit.scale_factor_error) * heading)
    means = [np.bincount(place, values) / count for values in (gyro_time, heading, error)]
    repeatable_error = float(np.std(error - means[2][place]))
    spacing, turned, moved = (np.diff(each) for each in means)
    ones = np.ones(_WINDOW_COUNT - 1)

    def fit_means(walk_range: tuple[float, float],
                  reference_range: tuple[float, float]) -> GridFit:
        """Fit a bias, with ranges of N, rad/√s, and of the errors of the means, rad."""
        return fit_noise_grid(moved, spacing[:, None], [
            BandedNoise('angle_random_walk', 2.0 / 3.0 * length * ones, length / 6.0 * ones,
                        walk_range),
            BandedNoise('reference', 2.0 * ones, -ones, reference_range)])

    walk, reference_deviation = fit.angle_random_walk, max(repeatable_error, 1e-12)
    random_walk_fit = fit_means((walk, walk), (1e-15, 1e-15))
    misfit = np.sum(random_walk_fit.whiten(random_walk_fit.residual) ** 2)
    # a random walk of the heading is refitted once in a thousand runs
    if not chdtr(_WINDOW_COUNT - 2, misfit) < 1e-3:
        return fit
    repeatable_fit = fit_means((1e-3 * walk, walk),
                               (1e-3 * reference_deviation, reference_deviation))
    weights = repeatable_fit.solve(spacing)
    slope = float(weights @ turned) / float(weights @ spacing)
    scale_variance = fit.covariance[0, 0]
    covariance = np.array([[scale_variance, -slope * scale_variance],
                           [-slope * scale_variance,
                            2.0 * repeatable_fit.covariance[0, 0] + slope ** 2 * scale_variance]])
    return replace(fit, bias=float(repeatable_fit.values[0]), covariance=covariance,
                   repeatable_error=repeatable_error)


def add_asymmetry_variance(fit: ScaleBiasFit, rate: Array) -> ScaleBiasFit:
    """
    Return the fit with the variance of a scale difference between both senses of turning added.

    For measured headings; against a profile the fit includes it. Such an error is proportional to
    the absolute value of the rate. The part of it that is proportional to the rate, or constant,
    is indistinguishable from scale factor error and bias. In a swing without rests, the mean
    absolute rate is indistinguishable from a bias.

    """
    columns = np.column_stack([rate, np.ones(len(rate))])
    absorbed = np.linalg.lstsq(columns, np.abs(rate), rcond=None)[0]
    return replace(
        fit, covariance=fit.covariance + ASYMMETRY_DEVIATION ** 2 * np.outer(absorbed, absorbed))


def refuse_repeatable_error(fit: ScaleBiasFit, limit: float) -> None:
    """Refuse a run whose heading error exceeds a limit, rad, for any scale and bias."""
    if fit.repeatable_error > limit:
        raise DataRefused(f'the heading error is {fit.repeatable_error / DEGREE:.1f} deg rms and '
                          f'repeats with the motion, at most {limit / DEGREE:g} deg are allowed; '
                          'scale and bias do not explain it: turn more slowly and gently, fasten '
                          'the gyro, or sample faster')


def refuse_no_improvement(fit: ScaleBiasFit, limit: float) -> None:
    """
    Refuse a calibration that by its own covariance makes a heading less accurate.

    Parameters
    ----------
    limit : accepted standard deviation of the heading after a drive of five minutes and a whole
        turn, rad, whatever it was before

    Raises
    ------
    DataRefused : the standard deviation exceeds the limit, and the error without the calibration

    """
    error_with = math.sqrt(
        (fit.covariance[1, 1] * DRIVE_DURATION + 2.0 * fit.covariance[0, 1] * math.tau)
        * DRIVE_DURATION + fit.covariance[0, 0] * math.tau ** 2)
    error_without = math.hypot(fit.bias * DRIVE_DURATION, fit.scale_factor_error * math.tau)
    if error_with > max(limit, error_without):
        raise DataRefused(f'the bias is known to {math.sqrt(fit.covariance[1, 1]) / DEGREE:.3f} '
                          f'deg/s only, which lets a heading drift by {error_with / DEGREE:.0f} '
                          'deg in five minutes; without the calibration it is '
                          f'{error_without / DEGREE:.0f} deg: turn more slowly, with rests, or '
                          'for longer')
