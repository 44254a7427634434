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
lost below some speed, and in bursts of some seconds several times less accurate. The noise of the
gyro is small compared with that, so the course is regressed on the gyro, over spans of some
seconds::

    Δcourse = p Δ(integral of the output) - q Δt + d Δrate + c Δacceleration + noise
    s = 1 / p - 1,  b = q / p

``d`` is the rest of the delay plus the side slip in proportion to the rate; ``c`` is the effect of
smoothing. The noise sizes are those of `noise_grid`; each point of the course has a variance of
its own, by the errors of the course around it.

Where a drive does not determine scale factor error and bias, a prior does: normal about zero, with
a standard deviation that is not known (`HierarchicalPrior`), but limited by the technology of the
gyro.

"""

from __future__ import annotations

from dataclasses import dataclass
import math

from gyro_calibration.calibration.likelihood import robust_residual, ScaleBiasFit
from gyro_calibration.calibration.noise_grid import (
    bias_wander_columns,
    fit_noise_grid,
    GridFit,
    heading_noise,
    HierarchicalPrior,
)
from gyro_calibration.heading.integration import integrate
from gyro_calibration.logs.log import Array, DataRefused, DEGREE
from gyro_calibration.logs.quality import quantization_step
from gyro_calibration.model.motion import Motion
import numpy as np

#: Largest standard deviations of scale factor error and bias, rad/s, by technology.
TECHNOLOGY_PRIORS = {
    'mems': (0.02, 1.0 * DEGREE),
    'open_loop_fog': (0.005, 0.02 * DEGREE),
    'closed_loop_fog': (0.001, 0.002 * DEGREE),
}
#: Length of a span, s; smoothing over a second then leaves the scale to a percent of its error.
SPAN_DURATION = 2.0
#: Largest time offset of the stamps of a gyro against satellites, either way, s.
MAX_TIME_OFFSET = 1.5
#: A reference that is lost for this part of the time, or noisier than this from span to span, rad,
#: is taken for a course; one in steps of more than this, rad, for an encoder.
MIN_LOST_SHARE, MIN_COURSE_NOISE, MAX_ROUNDING_STEP = 0.003, 0.25 * DEGREE, 2e-4
#: Minimum number of spans; fewer do not determine the noise of a course.
MIN_SPANS = 10
#: Prior standard deviations of the rest of the delay, s, and of the smoothing, s².
DELAY_DEVIATION, SMOOTHING_DEVIATION = 0.2, 0.1
#: Typical duration of a burst of errors of a course, s; length of the stretches between which the
#: scatter is taken, s.
BURST_DURATION, STRETCH_DURATION = 5.0, 15.0
#: The few errors within a burst hardly determine its variance: the errors of a course have
#: Student's distribution with so many degrees of freedom, plus one for each observed error.
STUDENT_DOF = 4.0
#: The gyro's noises that are possible, rad/√s and rad/s/√s, and cosines for its wander.
WHITE_NOISE_RANGE, RANDOM_WALK_RANGE, COSINE_COUNT = (1e-5, 1e-2), (1e-7, 1e-4), 8
#: Largest deviation of the course from a gyro that follows it, with any side slip, rad.
MAX_FOLLOWED_RESIDUAL = 3.0 * DEGREE


@dataclass(frozen=True)
class _Spans:
    """
    Means over spans in which the course is known.

    Attributes
    ----------
    time : s, shape (n,)
    course : rad, shape (n,)
    gyro_angle : integral of the output, rad, shape (n,)
    rate, acceleration : of the gyro, rad/s and rad/s², shape (n,)

    """

    time: Array
    course: Array
    gyro_angle: Array
    rate: Array
    acceleration: Array


class _CourseAlignment:
    """Gyro and course, aligned at any time offset."""

    def __init__(self, time: Array, rate: Array, motion: Motion):
        """Average the course over spans that are at least half known."""
        self._time, self._integral = time, integrate(time, rate)
        number = np.floor(motion.time / SPAN_DURATION).astype(np.intp)
        count = np.bincount(number)
        usual = float(np.median(count[count > 0]))
        self._is_used = (count >= 0.5 * usual)[number]
        number = np.unique(number[self._is_used], return_inverse=True)[1]
        self._begins = np.flatnonzero(np.diff(number, prepend=-1))
        self._span_sizes = np.diff(np.append(self._begins, len(number)))
        self._reference_time = motion.time[self._is_used]
        self.course = self._average_by_span(motion.heading[self._is_used])
        self.time = self._average_by_span(self._reference_time)

    def _average_by_span(self, values: Array) -> Array:
        return np.add.reduceat(values, self._begins) / self._span_sizes

    def gyro_angle(self, offset: float) -> Array:
        """Return the mean integral of the output in each span, rad, the gyro being late, s."""
        return self._average_by_span(
            np.interp(self._reference_time + offset, self._time, self._integral))

    def average_spans(self, offset: float) -> _Spans:
        """Return the spans for a time offset that the samples cover."""
        half_step = 0.5
        inside = (self.time + offset - half_step - 0.5 * SPAN_DURATION >= self._time[0]) & (
            self.time + offset + half_step + 0.5 * SPAN_DURATION <= self._time[-1])
        middle, later, earlier = (self.gyro_angle(offset + shift)[inside]
                                  for shift in (0, half_step, -half_step))
        return _Spans(self.time[inside], self.course[inside], middle,
                      (later - earlier) / (2.0 * half_step),
                      (later - 2.0 * middle + earlier) / half_step**2)

    def find_coarse_offset(self, largest: float) -> float:
        """Return the offset at which course less integral is straight for most of the time."""
        offsets = np.arange(-round(largest / 0.05), round(largest / 0.05) + 1) * 0.05
        line = np.column_stack([np.ones(len(self.time)), self.time])
        misfits = [
            float(np.mean(np.abs(robust_residual(line, self.course - self.gyro_angle(offset), 3))))
            for offset in offsets]
        return float(offsets[int(np.argmin(misfits))])


def fit_course(time: Array, rate: Array, motion: Motion, technology: str = 'mems',
               largest_time_offset: float = MAX_TIME_OFFSET) -> ScaleBiasFit:
    """
    Fit scale factor error, bias and time offset to a drive.

    Parameters
    ----------
    time : s since the course began, shape (n,)
    rate : output of the gyro, rad/s, shape (n,)
    motion : the courses that are known
    technology : of the gyro, one of `TECHNOLOGY_PRIORS`
    largest_time_offset : how late or early the gyro's stamps may be, s

    Raises
    ------
    DataRefused : the course is known for too short a time, or the gyro does not follow it

    """
    alignment = _CourseAlignment(time, rate, motion)
    offset = alignment.find_coarse_offset(largest_time_offset)
    spans = alignment.average_spans(offset)
    if len(spans.time) < MIN_SPANS:
        raise DataRefused(f'the course is known for {len(spans.time) * SPAN_DURATION:.0f} s, '
                          f'wanted at least {MIN_SPANS * SPAN_DURATION:.0f} s: drive for longer, '
                          'faster than a walk')
    _refuse_other_motion(spans)
    point_variance: Array = np.ones(len(spans.time))
    for _ in range(2):
        point_variance = burst_variance(spans.time, _point_errors(spans, point_variance))
    found = _regress_course(spans, point_variance, technology)
    scale, scaled_bias, late = found.values[:3]
    jacobian = np.array([[-1.0 / scale**2, 0.0], [-scaled_bias / scale**2, 1.0 / scale]])
    covariance = jacobian @ _stretch_covariance(found, spans) @ jacobian.T
    influence = found.influence[:, :2] @ jacobian.T
    return ScaleBiasFit(float(1.0 / scale - 1.0), float(scaled_bias / scale), covariance,
                        offset + float(late), found.size('angle_random_walk'),
                        found.size('reference'), time_offset_deviation=float(found.deviations[2]),
                        influence=np.column_stack([influence, spans.time[1:]]))


def is_course(time: Array, rate: Array, motion: Motion) -> bool:
    """
    Tell whether a reference is a course over ground: partly lost, or noisy, and no encoder.

    It is lost below some speed, where there is no direction of travel. An encoder is recognized by
    its step; smaller steps are rounding of the file.

    Parameters
    ----------
    time, rate : of the gyro, s since the reference began and rad/s, shape (n,)
    motion : by the reference

    """
    if quantization_step(motion.heading) > MAX_ROUNDING_STEP:
        return False
    interval = np.diff(np.concatenate([[time[0]], motion.time, [time[-1]]]))
    lost = float(np.sum(interval[interval > 5.0 * np.median(interval)]))
    if lost > MIN_LOST_SHARE * float(time[-1] - time[0]):
        return True
    alignment = _CourseAlignment(time, rate, motion)
    spans = alignment.average_spans(alignment.find_coarse_offset(MAX_TIME_OFFSET))
    if len(spans.time) < MIN_SPANS:
        return False
    residual = robust_residual(_regression_columns(spans), np.diff(spans.course), 10)
    return float(np.median(np.abs(residual))) > 0.6745 * math.sqrt(2.0) * MIN_COURSE_NOISE


def _regression_columns(spans: _Spans) -> Array:
    """Return the columns of p, q, d and c in the increments of the course, shape (n - 1, 4)."""
    return np.diff(
        np.column_stack([spans.gyro_angle, -spans.time, spans.rate, spans.acceleration]), axis=0)


def _regress_course(spans: _Spans, point_variance: Array, technology: str) -> GridFit:
    largest_scale, largest_bias = TECHNOLOGY_PRIORS[technology]
    columns, increments = _regression_columns(spans), np.diff(spans.course)
    cosines, wanders = bias_wander_columns(spans.time, None, RANDOM_WALK_RANGE, COSINE_COUNT)
    noise = heading_noise(spans.time, spans.rate, point_variance,
                          angle_random_walk=WHITE_NOISE_RANGE)
    return fit_noise_grid(
        increments, columns, noise, cosines, wanders, np.array([1.0, 0.0, 0.0, 0.0]),
        np.array([largest_scale, largest_bias, DELAY_DEVIATION, SMOOTHING_DEVIATION]),
        wandering_value=1, hierarchical_priors=(
            HierarchicalPrior('scale_factor_error', 0, (1e-2 * largest_scale, largest_scale)),
            HierarchicalPrior('bias', 1, (1e-3 * largest_bias, largest_bias))))


def _point_errors(spans: _Spans, point_variance: Array) -> Array:
    """Return the error of each point of the course about a fit weighted by their variances."""
    columns = np.column_stack([spans.time, spans.rate, np.ones(len(spans.time))])
    weights = 1.0 / np.sqrt(point_variance)[:, None]
    error = spans.course - spans.gyro_angle
    scale = np.abs(columns).max(axis=0) + 1e-12
    values = np.linalg.lstsq(columns / scale * weights, error * weights[:, 0], rcond=1e-10)[0]
    return error - columns / scale @ values


def burst_variance(time: Array, error: Array) -> Array:
    """
    Return the variance of each point of a course relative to the usual one.

    Parameters
    ----------
    time, error : of the points, s and rad, shape (n,)

    """
    around = np.abs(time[:, None] - time) <= 0.5 * BURST_DURATION
    squares, count = around @ error**2, around.sum(axis=1)
    usual = max(float(np.median(squares / count)), 1e-12)
    return np.asarray((STUDENT_DOF + squares / usual) / (STUDENT_DOF + count))


def _refuse_other_motion(spans: _Spans) -> None:
    """Refuse a gyro that explains less than half of the variation of the course."""
    residual_variation, course_variation = (
        _median_line_deviation(spans.time, each)
        for each in (spans.course - spans.gyro_angle, spans.course))
    if residual_variation > max(MAX_FOLLOWED_RESIDUAL, 0.5 * course_variation):
        raise DataRefused(f'within {STRETCH_DURATION:.0f} s the course varies by '
                          f'{course_variation / DEGREE:.1f} deg, and less the gyro by '
                          f'{residual_variation / DEGREE:.1f} deg (medians): the gyro does not '
                          'follow the course. Check that both belong to one drive, and check '
                          'axis, sign, units, and that the gyro responds')


def _median_line_deviation(time: Array, heading: Array) -> float:
    """Return the median deviation of a heading from a line within stretches, rad."""
    number = np.floor((time - time[0]) / STRETCH_DURATION).astype(np.intp)
    deviations = [np.empty(0)]
    for each in np.unique(number):
        inside = number == each
        if inside.sum() > 3:
            line = np.polyfit(time[inside], heading[inside], 1)
            deviations.append(np.abs(heading[inside] - np.polyval(line, time[inside])))
    joined = np.concatenate(deviations)
    return float(np.median(joined)) if len(joined) else 0.0


def _stretch_covariance(found: GridFit, spans: _Spans) -> Array:
    """Return the covariance of (p, q): by the noise, or by the scatter of stretches if larger."""
    covariance = found.covariance[:2, :2]
    number = np.floor((spans.time[1:] - spans.time[0]) / STRETCH_DURATION).astype(np.intp)
    sums = np.array([np.bincount(number, column) for column in found.influence[:, :2].T])
    stretches = max(sums.shape[1], 2)
    scatter = np.diag(sums @ sums.T) * stretches / (stretches - 1.0)
    widening = np.sqrt(np.maximum(scatter / np.diag(covariance), 1.0))
    return covariance * np.outer(widening, widening)
