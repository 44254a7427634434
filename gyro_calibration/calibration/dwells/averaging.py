# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Averaging: the means of dwells, and their standard deviations."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
import math
from typing import Any

from gyro_calibration.calibration.dwells.samples import duration, fit_slope, Numbers, Samples
from gyro_calibration.heading.integration import integrate
from gyro_calibration.logs.log import Array
from gyro_calibration.logs.quality import quantization_step
import numpy as np
from scipy.special import digamma, polygamma

#: Limits of the number of batches of a dwell, whose scatter gives the deviation of the mean, and
#: the minimum duration of each where there are more than four, s: a vibration of the table and the
#: response of the gyro's filter average out in it.
_MIN_BATCHES, _MAX_BATCHES, _MIN_BATCH_DURATION = 4, 12, 0.75


def average_dwells(samples: Samples, dwells: Sequence[Numbers]) -> tuple[Array, Array, Array]:
    """
    Return reference rate, output and its standard deviation of each dwell (Ojeda et al., eq. 6).

    A standard deviation that is not known is nan.

    """
    durations = np.array([duration(samples.time, rows) for rows in dwells])
    halves = np.array([len(rows) // 2 for rows in dwells])
    batches = np.clip(np.minimum(durations / _MIN_BATCH_DURATION, halves),
                      _MIN_BATCHES, _MAX_BATCHES).astype(int)
    average = _average_rates if samples.rate is not None else _average_slopes
    rate, output, variance, encoder_deviation = average(samples, dwells, batches)
    # The variance of white noise in a mean is proportional to 1 / duration; so the product of
    # variance and duration is the same in all dwells.
    deviation = np.sqrt(
        shrink_variances(variance * durations, batches - 1) / durations + encoder_deviation ** 2)
    return rate, output, np.where(deviation > 0.0, deviation, np.nan)


def _average_rates(samples: Samples, dwells: Sequence[Numbers],
                   batches: Numbers) -> tuple[Array, Array, Array, Array]:
    """Average dwells against a rate; return rate, output, its variance, and a blur of zero."""
    assert samples.rate is not None
    rate, output, errors = ([values[rows] for rows in dwells]
                            for values in (samples.rate, samples.output, samples.error))
    return (_map_to_array(np.mean, rate), _map_to_array(np.mean, output),
            _map_to_array(_variance_from_batch_means, errors, batches), np.zeros(len(dwells)))


def _average_slopes(samples: Samples, dwells: Sequence[Numbers],
                    batches: Numbers) -> tuple[Array, Array, Array, Array]:
    """
    Average dwells against a heading; return rate, output, its variance, and the encoder's blur.

    The rate is the slope of the heading. The output is averaged by the slope of its integral, with
    the same weights, so that deviations of the table from its steady rate are the same in both.
    The blur is the standard deviation that the steps of the encoder add.

    """
    assert samples.heading is not None
    step = quantization_step(samples.heading)
    time, output, heading = ([values[rows] for rows in dwells]
                             for values in (samples.time, samples.output, samples.heading))
    gyro_angle = list(map(integrate, time, output))
    errors = [angle - samples.scale * reference for angle, reference in zip(gyro_angle, heading)]
    # The scatter of the output includes the motion of the table, that of the error the steps of
    # the encoder. The smaller one is used.
    variance = min((_map_to_array(_variance_from_batch_slopes, time, angles, batches)
                    for angles in (gyro_angle, errors)), key=np.median)
    encoder_deviation = abs(samples.scale) * np.array(
        [_encoder_slope_deviation(*each, step) for each in zip(time, heading)])
    return (_map_to_array(fit_slope, time, heading), _map_to_array(fit_slope, time, gyro_angle),
            variance, encoder_deviation)


def _map_to_array(function: Callable[..., float], *columns: Iterable[Any]) -> Array:
    return np.array([function(*each) for each in zip(*columns)])


def _variance_from_batch_means(error: Array, batches: int) -> float:
    return _variance_of_mean([batch.mean() for batch in np.array_split(error, batches)])


def _variance_from_batch_slopes(time: Array, angle: Array, batches: int) -> float:
    return _variance_of_mean([fit_slope(*batch) for batch in zip(np.array_split(time, batches),
                                                                 np.array_split(angle, batches))])


def _variance_of_mean(batches: Sequence[float]) -> float:
    """Return the variance of the mean of all batches; noise may be correlated within a batch."""
    return float(np.var(batches, ddof=1)) / len(batches)


def _encoder_slope_deviation(time: Array, heading: Array, step: float) -> float:
    """
    Return the standard deviation of a heading's slope, due to the steps of an encoder, rad/s.

    Over M steps it is about 0.35 step / (M duration), and below one step 0.6 step / duration (by
    simulation). Each step is observed late by up to a sample, which adds the square root of M over
    the number of samples. A heading that stays on one step for the whole dwell is taken as a rest.

    """
    if np.ptp(heading) <= 0.5 * step or step == 0.0:
        return 0.0
    steps = abs(heading[-1] - heading[0]) / step
    samples = len(heading)
    return step / float(time[-1] - time[0]) * math.hypot(
        0.35 / max(steps, 0.6), math.sqrt(min(steps, samples)) / samples)


def shrink_variances(variance: Array, dof: Array) -> Array:
    """
    Shrink variances toward their common value, by more if they are uncertain or agree.

    A variance of twelve batches has a standard error of 40 %; weights computed from it would be
    random, and the smallest variances would dominate the fit. Empirical Bayes with an inverse
    gamma prior (Smyth 2004, sections 3 and 6.2): the scatter of their logarithms in excess of that
    of sampling gives the degrees of freedom of the prior.

    Parameters
    ----------
    variance : shape (n,)
    dof : degrees of freedom of each, shape (n,)

    """
    known = variance > 0.0
    if known.sum() < 3:
        return variance
    half_dof = dof[known] / 2.0
    logarithm = np.log(variance[known]) - digamma(half_dof) + np.log(half_dof)
    excess = float(logarithm.var(ddof=1) - polygamma(1, half_dof).mean())
    if excess <= 0.0:
        return np.full(len(variance), np.average(variance[known], weights=half_dof))
    prior_dof = 2.0 * _inverse_trigamma(excess)
    common_variance = math.exp(logarithm.mean() + digamma(prior_dof / 2.0)
                               - math.log(prior_dof / 2.0))
    return np.where(known, (prior_dof * common_variance + dof * variance) / (prior_dof + dof),
                    common_variance)


def _inverse_trigamma(value: float) -> float:
    """Solve trigamma(x) = value by Newton's method on 1 / trigamma (Smyth 2004, appendix)."""
    x = 0.5 + 1.0 / value
    for _ in range(20):
        x += float(polygamma(1, x) * (1.0 - polygamma(1, x) / value) / polygamma(2, x))
    return x
