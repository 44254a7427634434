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
Calibrate against a course over ground: the direction of travel by satellites.

A course differs from the heading by the side slip. It is smoothed, late or early against the gyro,
lost below some speed, and in bursts of some seconds several times less accurate. How it is
regressed on the gyro is in `heading_regression`, which the diagnosis uses, too.

Where a drive does not determine scale factor error and bias, a prior does: normal about zero, with
a standard deviation that is not known, but limited by the technology of the gyro.

"""

from __future__ import annotations

from dataclasses import replace
import math

from gyro_calibration.calibration.dwells import find_lost_reference
from gyro_calibration.calibration.heading_regression import (
    find_delay,
    fit_spans,
    lay_out_spans,
    TECHNOLOGY_PRIORS,
)
from gyro_calibration.calibration.likelihood import robust_residual, ScaleBiasFit
from gyro_calibration.calibration.reference_noise import drop_held_values, heading_difference
from gyro_calibration.logs.log import DataRefused, DEGREE, Log, NORMAL_QUANTILE_975
from gyro_calibration.logs.quality import (
    quantization_step,
    robust_deviation,
    white_noise_deviation,
)
import numpy as np

#: A reference that is lost for this part of the time, or noisier than this from span to span, rad,
#: is taken for a course; one in steps of more than this, rad, for an encoder.
MIN_LOST_SHARE, MIN_COURSE_NOISE, MAX_ROUNDING_STEP = 0.003, 0.25 * DEGREE, 2e-4
#: Least ratio of the errors of a course to the noise of the gyro, also for a course that is
#: straight between fixes (measured in drives: 4.6 to 920, all below 8 on straight lines between
#: fixes; simulated odometry with noise up to 0.02 deg: up to 5).
_COURSE_NOISE_RATIO, _FIX_NOISE_RATIO = 8.0, 2.0
#: Largest ratio of the 90 % to the 99 % quantile of the second differences of a heading that is
#: straight between fixes.
_MAX_STRAIGHT_RATIO = 0.1
#: Largest ratio of the error of an encoder heading to its rounding error.
MAX_ROUNDING_RATIO = 1.5
#: Minimum number of spans; fewer do not determine the noise of a course.
MIN_SPANS = 10
#: Largest deviation of the turn of a course in a span from that of a gyro that follows it, rad.
MAX_FOLLOWED_RESIDUAL = 3.0 * DEGREE


def fit_course(log: Log, technology: str = 'mems') -> ScaleBiasFit:
    """
    Fit scale factor error, bias and time offset to a drive.

    Parameters
    ----------
    log : with output, time and a course
    technology : of the gyro, one of `TECHNOLOGY_PRIORS`

    Raises
    ------
    DataRefused : the course is known for too short a time, or the gyro does not follow it

    """
    spans = lay_out_spans(log, 'course', np.array(TECHNOLOGY_PRIORS[technology]))
    length = spans.treatment.min_span
    if len(spans.time) < MIN_SPANS:
        raise DataRefused(f'the course is known for {len(spans.time) * length:.0f} s, wanted at '
                          f'least {MIN_SPANS * length:.0f} s: drive for longer, faster than a '
                          'walk')
    fit = fit_spans(spans)
    turned = np.diff(spans.heading)
    # a bias is the same in each span
    residual, variation = (robust_deviation(each - np.median(each))
                           for each in (fit.spans.observed[:len(turned)], turned))
    if residual > max(MAX_FOLLOWED_RESIDUAL, 0.5 * variation):
        raise DataRefused(f'from span to span of {length:.0f} s the course turns by '
                          f'{variation / DEGREE:.1f} deg, and less the gyro by '
                          f'{residual / DEGREE:.1f} deg (robust standard deviations): the gyro '
                          'does not follow the course. Check that both belong to one drive, and '
                          'check axis, sign, units, and that the gyro responds')
    # intervals of a normal distribution, as wide as those of Student's
    deviations = np.array([fit.half_width(place) for place in range(3)]) / NORMAL_QUANTILE_975
    widening = deviations / np.sqrt(np.diag(fit.covariance))
    covariance = fit.covariance * np.outer(widening, widening)
    scale, bias, delay = fit.values.tolist()
    return ScaleBiasFit(scale, bias, covariance[:2, :2], delay, fit.fit.size('angle_random_walk'),
                        fit.fit.size('reference'), time_offset_deviation=float(deviations[2]))


def is_course(log: Log) -> bool:
    """Tell whether a heading is lost at times, as a course at low speed, and errs like one."""
    log = drop_held_values(log)
    assert log.time is not None and log.output is not None and log.reference_heading is not None
    known = np.isfinite(log.reference_heading)
    if find_lost_reference(known).mean() <= MIN_LOST_SHARE:
        return False
    walk = white_noise_deviation(log.output) * math.sqrt(float(np.median(np.diff(log.time))))
    bent = np.abs(np.diff(log.reference_heading, 2))
    # a heading between slower fixes lies on straight lines
    usual, large = (np.nanquantile(bent, [0.9, 0.99]) if np.isfinite(bent).any() else (0.0, 0.0))
    larger = _FIX_NOISE_RATIO if usual < _MAX_STRAIGHT_RATIO * large else _COURSE_NOISE_RATIO
    # an encoder errs by the rounding of its steps, of which the difference in a second has 3 times
    # the variance
    rounding = quantization_step(log.reference_heading[known]) / 2.0
    return heading_difference(replace(log, reference_rate=None)).total_walk > max(
        larger * walk, MAX_ROUNDING_RATIO * rounding) > 0.0


def is_noisy(log: Log) -> bool:
    """Tell whether a heading without steps is as noisy as a course from span to span."""
    assert log.reference_heading is not None
    if quantization_step(log.reference_heading[np.isfinite(log.reference_heading)]
                         ) > MAX_ROUNDING_STEP:
        return False
    spans = lay_out_spans(log)
    count = len(spans.time) - 1
    if count < MIN_SPANS:
        return False
    spans = replace(spans, delay=find_delay(spans))
    columns = np.column_stack([spans.base_columns(), spans.acceleration_changes()])[:count]
    residual = robust_residual(columns, spans.observed[:count], 10)
    return robust_deviation(residual) > math.sqrt(2.0) * MIN_COURSE_NOISE
