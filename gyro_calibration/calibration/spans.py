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
A log as spans: the change of a reference heading less the integral of the gyro, and its columns.

The errors of the reference are larger than those of the gyro from sample to sample. So the heading
of the reference (the integral of a reference rate) is the observation, and all columns are
integrals of the most likely rate ``w`` given both (with a course, that of the gyro;
`Spans.with_corrected_rate`). With the output ``y`` and effects
``y = w + b + s w + sum(a f(w, T, t, ...))``, the heading ``psi`` of the reference is, at points
``t`` and except for a constant::

    psi(t) - J(t + d) = -b t - s J_w(t) - sum(a J_f(t)) + d w(t) + errors of the reference

with the integrals ``J``. A point is the mean over some samples; the observations are the
differences between points, so that a gap of the reference is a long span. A rest, in a gap or
where the reference stands, is one more observation: a turn by 0. Odometry, which stands at rest,
may drift in motion: one more value. An attitude shows the rotation about the two axes across that
of the gyro; as axes are never exactly parallel, parts of it are in the output: two more values.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
import math
from typing import NamedTuple

from gyro_calibration.calibration.dwells import find_lost_reference
from gyro_calibration.calibration.joined_logs import JoinedLogs
from gyro_calibration.calibration.noise_grid import bias_wander_columns, SharedNoise
from gyro_calibration.calibration.reference_noise import (
    find_rests, heading_difference, is_slow, keep_own_instants, OwnInstants, rate_noise_share)
from gyro_calibration.calibration.selection import TECHNOLOGY_PRIORS
from gyro_calibration.heading.integration import integrate, integrate_with_curvature
from gyro_calibration.logs.log import Array, DataRefused, DEGREE, Log, Mask
from gyro_calibration.logs.quality import (
    bridge_gaps, cross_rotation, encoder_step, find_holes, mark_rows, MISALIGNMENT_DEVIATION,
    quantization_step, robust_deviation, white_noise_deviation)
from gyro_calibration.model.channels import channels_from_log
from gyro_calibration.model.effects import CATALOGUE, Channels
import numpy as np
from numpy.typing import NDArray
from scipy.fft import dct, idct
from scipy.interpolate import CubicSpline
from scipy.linalg import solveh_banded
from scipy.ndimage import uniform_filter1d

#: Largest offset of gyro and encoder on one host, s; a swing may look alike half a period later.
MAX_ENCODER_OFFSET = 0.25
#: Cosines of a wander that one part of noise describes.
WANDER_COSINES = 8
#: Prior deviations of s and b, rad/s, where gyro and reference disagree by more than a gyro errs.
WIDE_PRIOR = (0.3, 10.0 * DEGREE)
#: Prior standard deviation of the smoothing of a course, s².
_SMOOTHING_DEVIATION = 0.1
#: Names of the values that are always fitted.
BASE_VALUES = ('scale_factor_error', 'bias', 'time_offset')
#: Largest trial delay in standard deviations of the prior.
_DELAY_SIGMAS = 1.5


def lag_deviation(delay: float) -> float:
    """
    Return the prior standard deviation of the lag that a delay, s, may be, s².

    The variance of the times by which gyro or reference is late, twice this, is up to the square
    of their mean, of a filter of first order, and at most that of a smoothed course.
    """
    return min(0.5 * delay ** 2, _SMOOTHING_DEVIATION)


@dataclass(frozen=True)
class _ReferenceTreatment:
    """Settings of the comparison of a kind of reference with the gyro."""

    min_span: float  # least length, s
    max_spans: int  # largest number of spans of a log
    # standard deviations of scale factor error, bias (rad/s) and delay (s)
    prior: tuple[float, float, float]
    # smallest and largest angle random walk, in units of `Spans.walk_bounds`
    walk_range: tuple[float, float]
    stretch_duration: float  # length of stretches whose scores are independent, s
    # whether its errors are small enough to show a random walk of the bias, and events
    is_fine: bool
    errs_as_heading: bool  # whether it has errors of a heading, not of an integrated rate
    wide_prior: tuple[float, float] = WIDE_PRIOR  # of scale factor error and bias, rad/s

    @property
    def largest_delay(self) -> float:
        """Return the largest trial delay, s."""
        return _DELAY_SIGMAS * self.prior[2]


COURSE_TREATMENT = _ReferenceTreatment(2.0, 400, (*TECHNOLOGY_PRIORS['mems'], 1.0), (0.1, 1.0),
                                       15.0, False, True)
#: A reference with errors of an instrument.
HEADING_TREATMENT = _ReferenceTreatment(0.2, 2000, (0.1, 10.0 * DEGREE, 1.0), (0.3, 1.5), 5.0,
                                        True, True)
_TREATMENTS = {
    'rate_command': replace(HEADING_TREATMENT, errs_as_heading=False),
    # on the host of the gyro: small delays, as a swing agrees again a period later
    'encoder': replace(HEADING_TREATMENT,
                       prior=(*HEADING_TREATMENT.prior[:2], MAX_ENCODER_OFFSET / _DELAY_SIGMAS)),
    'motion_capture': HEADING_TREATMENT, 'gyro': HEADING_TREATMENT}


class CauseTerm(NamedTuple):
    """One cause with the shapes of its effect, as columns of the regression."""

    cause: str
    shapes: tuple[float, ...] = ()  # of `OWN_BIAS` and `OWN_DELAY` the number of the log

    @property
    def is_single_event(self) -> bool:
        """Tell whether it happens once, at its first shape."""
        return self.cause in ('bias_step', 'reference_slip')

    @property
    def value_count(self) -> int:
        """Return the number of its columns."""
        if self.cause in ('reference_once_per_rev', 'axis_misalignment'):
            return 2
        effect = CATALOGUE.get(self.cause)
        return max(len(effect.coefficients), 1) if effect is not None else 1


_CLOCK_TERM, DRIFT_TERM, MISALIGNMENT_TERM = map(
    CauseTerm, ('clock_rate', 'reference_drift', 'axis_misalignment'))
#: Of each log of several but the first: its bias, or delay, less the mean of all.
OWN_BIAS, OWN_DELAY = 'own_bias', 'own_delay'


@dataclass(frozen=True, eq=False)
class Spans:
    """One log as n spans between n + 1 points, and r rests."""

    log: Log  # with output, time and reference heading
    channels: Channels  # inputs of the effects; the rate is that of the gyro, as corrected so far
    value_times: Array  # times of the known values of the reference, s
    point_index: NDArray[np.intp]  # point of each of them
    time: Array  # of the points, s, shape (n + 1,)
    heading: Array  # of the points, rad
    # first and last row of each rest, shape (r, 2), and whether the reference is known there
    rests: NDArray[np.intp]
    stands: Mask
    treatment: _ReferenceTreatment  # of the kind of the reference
    # smaller and larger angle random walk, by the white noise of samples and reference rate, and
    # by the difference of gyro and reference over a second, rad/√s
    walk_bounds: tuple[float, float]
    reference_noise_ratio: float  # ratio of the noise of a reference rate to that of the gyro
    uses_code_changes: bool  # whether the points are changes of the code of an encoder
    # begin and end of each hole in the output that is as long as a span, s, shape (k, 2)
    holes: Array
    output_step: float  # quantization step of the output, rad/s; 0 without one
    adds_up: bool  # whether the reference is never lost, as odometry, which adds up its errors
    joined: JoinedLogs | None = None  # the logs of which it consists, if these are several
    delay: float = 0.0  # of the stamps of the gyro relative to the reference, s
    clock_rate: float = 0.0  # by which the clock of the gyro is slow, so that the delay decreases

    @property
    def stamps(self) -> Array:
        """Return the stamps of the gyro, s, shape (m,)."""
        return np.asarray(self.log.time)

    @property
    def output(self) -> Array:
        """Return its output, rad/s, shape (m,)."""
        return np.asarray(self.log.output)

    @cached_property
    def cross_rotation(self) -> Array:
        """Return the rotation of the reference about the cross axes, rad, (m, 2) or (m, 0)."""
        return cross_rotation(self.log)

    @cached_property
    def is_measured(self) -> Mask:
        """Tell which spans and rests the output covers, shape (n + r,)."""
        at, margin = self.gyro_stamps(self.time), 0.5 * float(np.median(np.diff(self.time)))
        first, last = np.concatenate([np.column_stack([at[:-1] - margin, at[1:] + margin]),
                                      self.stamps[self.rests]]).T
        begin, end = self.holes[:, :, None].transpose(1, 0, 2)
        covered = (self.time_outside[:-1] >= 0.0) & (self.time_outside[1:] <= 0.0)
        return np.asarray(~((begin < last) & (end > first)).any(axis=0)
                          & np.append(covered, np.ones(len(self.rests), dtype=bool)))

    @property
    def of_logs(self) -> list[slice]:
        """Return the spans of each log."""
        if self.joined is None:
            return [slice(0, len(self.time) - 1)]
        number = self.joined.find(self.time)
        return [slice(int(own[0]), int(own[-1])) for own in (
            np.flatnonzero(number == place) for place in range(len(self.joined.begins)))]

    @property
    def time_outside(self) -> Array:
        """Return the mean time of each point before the log, or after it, s, shape (n + 1,)."""
        at = self.gyro_stamps(self.value_times)
        outside = at - np.clip(at, self.stamps[0], self.stamps[-1])
        return self._means_of_values(outside)

    @property
    def stretch_numbers(self) -> NDArray[np.intp]:
        """Return the number of the stretch of each observation, shape (n + r,)."""
        middle = 0.5 * (self.time[1:] + self.time[:-1]) - self.time[0]
        count = max(int(np.ceil(middle[-1] / self.treatment.stretch_duration)), 1)
        of_spans = np.minimum(middle * count / (middle[-1] + 1e-9), count - 1).astype(np.intp)
        return np.append(of_spans, count + np.arange(len(self.rests)))

    @property
    def shaft_sectors(self) -> NDArray[np.intp]:
        """Return the number of the sector of 10 deg and sense of the shaft, shape (n + r,)."""
        middle = self.point_means(np.asarray(self.channels.heading))
        sector = np.floor(0.5 * (middle[1:] + middle[:-1]) / (10.0 * DEGREE))
        keys = np.append(2.0 * sector + (np.diff(middle) > 0.0), np.zeros(len(self.rests)))
        return np.unique(keys, return_inverse=True)[1].astype(np.intp)

    def all_causes(self, causes: Sequence[CauseTerm]) -> list[CauseTerm]:
        """Return causes, after those that are always fitted, misalignment and drift."""
        own = [MISALIGNMENT_TERM] * bool(self.cross_rotation.size)
        own += [DRIFT_TERM] * bool(self.stands.any())
        if self.joined is not None:
            own += [CauseTerm(name, (float(number),))
                    for name in [OWN_BIAS, *[OWN_DELAY] * bool(len(self.joined.delays))]
                    for number in range(1, len(self.joined.begins))]
        return [*dict.fromkeys([*own, *causes])]

    def prior_deviations(self, causes: Sequence[CauseTerm]) -> Array:
        """Return the prior standard deviations of the values, infinite of most causes."""
        own = {MISALIGNMENT_TERM.cause: MISALIGNMENT_DEVIATION,
               OWN_BIAS: self.treatment.prior[1], OWN_DELAY: self.treatment.prior[2],
               'dead_zone': 1.0}  # its amplitude, although no rate may be within it
        return np.concatenate([self.treatment.prior, *(
            np.full(each.value_count, own.get(each.cause, math.inf))
            for each in self.all_causes(causes))])

    def _of_log(self, term: CauseTerm) -> Array:
        """Return 1 in the samples of the log of a term, -1 in those of the first, (m,)."""
        assert self.joined is not None
        number = self.joined.find(self.stamps)
        return (number == term.shapes[0]) - 1.0 * (number == 0)

    def value_slice(self, causes: Sequence[CauseTerm], cause: CauseTerm) -> slice:
        """Return the places of the values of one of the causes."""
        before = causes[:causes.index(cause)]
        start = len(BASE_VALUES) + sum(each.value_count for each in before)
        return slice(start, start + cause.value_count)

    def correction(self, causes: Sequence[CauseTerm], count: int) -> Array:
        """Return the values for which the stamps are corrected, and 0 for the others."""
        values: Array = np.zeros(count)
        values[2] = self.delay
        if _CLOCK_TERM in causes:
            values[self.value_slice(causes, _CLOCK_TERM)] = self.clock_rate
        return values

    @cached_property
    def is_in_motion(self) -> Mask:
        """Tell which samples are not in a rest."""
        return ~mark_rows(self.rests, len(self.log))

    @cached_property
    def time_in_motion(self) -> Array:
        """Return the time without the rests, s, shape (m,)."""
        return integrate(self.stamps, self.is_in_motion.astype(float))

    @property
    def angles(self) -> Array:
        """Return the angle turned in each span, rad, (n,); 0 where a course shows noise."""
        by_gyro = np.diff(self.point_means(np.asarray(self.channels.heading)))
        turns = np.diff(self.heading) * by_gyro > 0.5 * by_gyro ** 2
        return np.asarray(np.where(turns | self.treatment.is_fine, by_gyro, 0.0))

    @property
    def rest_durations(self) -> Array:
        """Return the length of each rest, s, shape (r,)."""
        return np.diff(self.stamps[self.rests])[:, 0]

    @cached_property
    def rest_rounding(self) -> float:
        """Return the standard deviation of the mean output of all rests by its steps, rad/s."""
        variances = [np.var(self.output[first:last + 1]) for first, last in self.rests]
        # a noise of half a step averages it out
        is_coarse = bool(variances) and max(variances) <= 0.25 * self.output_step ** 2
        return is_coarse * self.output_step / math.sqrt(12.0)

    def gyro_stamps(self, time: Array) -> Array:
        """Return the stamps of the gyro at times of the reference, s."""
        return (time + self.delay) / (1.0 + self.clock_rate)

    @cached_property
    def _places(self) -> list[tuple[NDArray[np.intp], Array, Array]]:
        """Return the samples before the values, the shares of the intervals, and these, s."""
        time, found = self.stamps, list[tuple[NDArray[np.intp], Array, Array]]()
        # a change of code is the mean of two samples, between which the signal may be curved
        half = 0.5 * self.uses_code_changes * float(np.median(np.diff(time)))
        for shift in sorted({-half, half}):
            at = np.clip(self.gyro_stamps(self.value_times + shift), time[0], time[-1])
            before = np.clip(np.searchsorted(time, at, side='right') - 1, 0, len(time) - 2)
            interval = time[before + 1] - time[before]
            found.append((before, (at - time[before]) / interval, interval))
        return found

    def point_means(self, values: Array, slopes: Array | None = None) -> Array:
        """Return the means of a signal at the delayed points, linear or with slopes, (n + 1,)."""
        total: Array = np.zeros(len(self.value_times))
        for before, share, interval in self._places:
            change = values[before + 1] - values[before]
            here = values[before] + share * change
            if slopes is not None:  # by a cubic
                here += share * (1.0 - share) * (
                    (1.0 - share) * (interval * slopes[before] - change)
                    - share * (interval * slopes[before + 1] - change))
            total += here
        return self._means_of_values(total) / len(self._places)

    def _means_of_values(self, values: Array) -> Array:
        """Return the means over the values of each point, shape (n + 1,)."""
        return np.bincount(self.point_index, values) / np.bincount(self.point_index)

    def span_integrals(self, rate: Array) -> Array:
        """Return the change of the integral of a rate over spans and rests, shape (n + r,)."""
        rate = np.broadcast_to(rate, self.stamps.shape)
        moving: Array = rate * self.is_in_motion
        in_motion = self.point_means(integrate_with_curvature(self.stamps, moving), moving)
        at_rest = (np.diff(integrate_with_curvature(self.stamps, rate)[self.rests])[:, 0]
                   if len(self.rests) else np.zeros(0))
        return self.is_measured * np.append(np.diff(in_motion), at_rest)

    def span_changes(self, values: Array) -> Array:
        """Return the change of a signal over spans, 0 over rests, shape (n + r,)."""
        return self.is_measured * np.append(np.diff(self.point_means(values)),
                                            np.zeros(len(self.rests)))

    @property
    def observed(self) -> Array:
        """Return the change of the reference less that of the integral of the output, (n + r,)."""
        turned = np.append(np.diff(self.heading), np.zeros(len(self.rests)))
        return self.is_measured * turned - (1.0 + self.clock_rate) * self.span_integrals(
            self.output)

    @cached_property
    def _motion_share(self) -> Array:
        """Return the share of the motion in the power of each cosine of the rate, shape (m,)."""
        rate = np.asarray(self.channels.rate)
        power = uniform_filter1d(dct(rate, norm='ortho') ** 2, 101)  # of white noise to 14 %
        return np.maximum(1.0 - white_noise_deviation(rate) ** 2 / np.maximum(power, 1e-300), 0.0)

    def _smooth(self, rate: Array) -> Array:
        """Return a rate by a Wiener filter, rad/s, shape (m,)."""
        return np.asarray(idct(self._motion_share * dct(rate, norm='ortho'), norm='ortho'))

    @cached_property
    def smooth_rate(self) -> Array:
        """Return the rate by a Wiener filter: its noise would pass for information on a delay."""
        return self._smooth(np.asarray(self.channels.rate))

    def base_columns(self) -> Array:
        """Return the columns of scale factor error, bias and delay, shape (n + r, 3)."""
        rate = np.asarray(self.channels.rate)
        columns = np.column_stack([-self.span_integrals(rate), -self.span_integrals(np.ones(1)),
                                   self.span_changes(self.smooth_rate)])
        columns[:len(self.time) - 1, 0] *= self.angles != 0.0
        return columns

    def cause_columns(self, cause: CauseTerm) -> Array:
        """Return the columns of a cause, shape (n + r, k)."""
        time, heading = self.stamps, np.asarray(self.channels.heading)
        if cause.cause == OWN_BIAS:
            return -self.span_integrals(self._of_log(cause))[:, None]
        if cause.cause == OWN_DELAY:
            return self.span_changes(self._of_log(cause) * self.smooth_rate)[:, None]
        if cause.cause == 'bias_step':
            return self.step_columns(np.array(cause.shapes))
        if cause.cause == 'reference_once_per_rev':
            return np.column_stack([self.span_changes(np.sin(heading)),
                                    self.span_changes(np.cos(heading))])
        if cause == MISALIGNMENT_TERM:
            means = [self._means_of_values(np.interp(self.value_times, time, each))
                     for each in self.cross_rotation.T]
            return np.pad(np.diff(means), ((0, 0), (0, len(self.rests)))).T * np.where(
                self.is_measured, -1.0, 0.0)[:, None]
        if cause == DRIFT_TERM:
            return self.span_changes(self.time_in_motion)[:, None]
        if cause.cause == 'reference_slip':
            return self.span_changes((time >= cause.shapes[0]).astype(float))[:, None]
        if cause.cause == 'bandwidth':
            # to first order a lag is a delay; in second order they differ by half of lag² dw/dt
            return -self.span_changes(np.gradient(self.smooth_rate, time))[:, None]
        if cause.cause == 'clock_rate':
            rate = np.asarray(self.channels.rate)
            return (self.span_integrals(rate)
                    - self.span_changes(time * self.smooth_rate))[:, None]
        return np.column_stack([-self.span_integrals(np.asarray(each))
                                for each in self._effect_columns(cause)])

    def _effect_columns(self, cause: CauseTerm) -> Sequence[Array]:
        """Return the columns of an effect of the gyro in samples, each of shape (m,)."""
        channels = self.channels
        if cause.cause == 'dead_zone':  # noise would pass its limit
            channels = channels.with_rate(self.smooth_rate, self.output)
        return CATALOGUE[cause.cause].columns(channels, *cause.shapes)

    def step_columns(self, times: Array) -> Array:
        """Return the columns of steps of the bias, each between two samples, shape (n + r, k)."""
        time = self.stamps
        between = np.concatenate([time[:1], 0.5 * (time[1:] + time[:-1]), [math.inf]])
        begin, at = between[np.searchsorted(time, times)], self.gyro_stamps(self.value_times)
        # the time in motion since the step, as a mean over the values of each point
        moved, since = (np.interp(each, time, integrate_with_curvature(
            time, self.is_in_motion.astype(float))) for each in (at, begin))
        total, end = np.append(0.0, np.cumsum(moved)), np.cumsum(np.bincount(self.point_index))
        first = np.clip(np.searchsorted(at, begin), np.append(0, end[:-1])[:, None], end[:, None])
        means = ((total[end][:, None] - total[first] - since * (end[:, None] - first))
                 / np.bincount(self.point_index)[:, None])
        at_rest = np.diff(np.maximum(time[self.rests][:, :, None] - begin, 0.0), axis=1)[:, 0]
        turned = np.concatenate([np.diff(means, axis=0), at_rest])
        if self.joined is not None:  # it ends with its log
            of_rows = np.append(self.time[:-1], self.stamps[self.rests[:, 0]])
            turned *= self.joined.find(of_rows)[:, None] == self.joined.find(times)
        return np.asarray(-turned * self.is_measured[:, None])

    def biases(self, values: Array, causes: Sequence[CauseTerm]) -> Array:
        """Return the bias in each sample, which is that of its log, rad/s, shape (m,)."""
        return values[1] + sum((values[self.value_slice(causes, each)] * self._of_log(each)
                                for each in causes if each.cause == OWN_BIAS),
                               np.zeros(len(self.stamps)))

    def with_corrected_rate(self, values: Array, causes: Sequence[CauseTerm] = ()) -> Spans:
        """
        Return the spans with the rate corrected for scale factor error, bias, delay and causes.

        These are the causes that depend on the rate. Delay and clock rate are added to those of
        spans.
        """
        errors, clock_rate = self.biases(values, causes), self.clock_rate
        for cause in causes:
            own = values[self.value_slice(causes, cause)]
            if cause == _CLOCK_TERM:
                clock_rate += float(own[0])
            elif (cause.cause in CATALOGUE.keys() - {'bandwidth'}
                    and 'rate' in CATALOGUE[cause.cause].inputs):
                errors = errors + sum(size * column for size, column in zip(
                    own, self._effect_columns(cause)))
        rate: Array = self.is_in_motion * (self.output - errors) / (1.0 + values[0])
        moved = replace(self, delay=self.delay + float(values[2]), clock_rate=clock_rate)
        turned = integrate_with_curvature(self.stamps, rate)
        # the heading of the reference, between its points that of the gyro
        at = (1.0 + moved.clock_rate) * self.stamps - moved.delay
        heading_change: Array = self.heading - moved.point_means(turned, rate)
        if self.treatment.is_fine:
            heading_change = self._difference_of_gyro(heading_change)
            steps = np.clip(np.searchsorted(self.time, at) - 1, 0, len(heading_change) - 2)
            rate = rate + (np.diff(heading_change) / np.diff(self.time))[steps]
        return replace(
            moved, channels=replace(self.channels.with_rate(rate, self.output),
                                    heading=turned + np.interp(at, self.time, heading_change)))

    def _difference_of_gyro(self, heading_change: Array) -> Array:
        """
        Return the part of the difference of the headings, shape (n + 1,), that is of the gyro.

        The errors of the most likely heading given both are independent of the difference of both.
        """
        if not self.treatment.errs_as_heading:
            return heading_change / (1.0 + self.reference_noise_ratio ** 2)
        # what turned in a hole is known by the reference alone
        in_holes = np.append(0.0, np.cumsum(np.where(
            self.is_measured[:len(heading_change) - 1], 0.0, np.diff(heading_change))))
        walk: Array = self.walk_bounds[0] ** 2 * np.diff(self.time)
        second = robust_deviation(np.diff(heading_change, 2)) ** 2
        stiffness = max(second / 6.0 - float(np.median(walk)) / 3.0, 0.0) / walk
        banded = np.zeros((2, len(heading_change)))
        banded[1] = 1.0 + np.append(stiffness, 0.0) + np.append(0.0, stiffness)
        banded[0, 1:] = -stiffness
        return np.asarray(solveh_banded(banded, heading_change - in_holes)) + in_holes

    def bias_wander(self) -> tuple[Array, list[SharedNoise]]:
        """Return the columns of a wandering bias, and the parts of its noise."""
        least, most = self.walk_bounds
        # rad/s and rad/s/√s; beside a fine reference relative to the angle random walk
        options = (((3e-3 * least, 0.5 * most), (1e-4 * least, 0.1 * most))
                   if self.treatment.is_fine else (None, (1e-7, 1e-4), WANDER_COSINES))
        of_logs = []
        for own in self.of_logs:  # each log has a wander of its own
            time = self.time[own.start:own.stop + 1]
            columns, parts = bias_wander_columns(time, *options)
            omega = math.pi * np.arange(1, columns.shape[1] + 1) / (time[-1] - time[0])
            rest_times = np.clip(self.stamps[self.rests], time[0], time[-1])[:, :, None] - time[0]
            rows = np.diff(np.sin(omega * rest_times) / omega, axis=1)[:, 0]
            around = np.searchsorted(self.time - time[0], rest_times.mean(axis=(1, 2))) - 1
            waves = np.zeros((len(self.time) - 1, columns.shape[1]))
            waves[own] = columns
            np.subtract.at(waves, np.clip(around, 0, len(waves) - 1), rows)
            of_logs.append((np.concatenate([waves, rows]), parts))
        waves = np.column_stack([each for each, _ in of_logs])
        # the mean bias of all is that of independent walks
        parts = [replace(each[0], variance=np.concatenate([one.variance for one in each]),
                         unobservable_variance=sum(
                             one.unobservable_variance for one in each) / len(each) ** 2)
                 for each in zip(*(parts for _, parts in of_logs))]
        # column and size of what is shared by spans or rests
        single = []
        if self.rest_rounding:
            single.append(('rounding', np.append(np.zeros(len(self.time) - 1),
                                                 self.rest_durations), self.rest_rounding))
        # a smoothed reference errs in proportion to the acceleration
        if not self.treatment.is_fine:
            single.append(('smoothing', self.acceleration_changes(), _SMOOTHING_DEVIATION))
        elif self.delay:
            likely = lag_deviation(self.delay)
            lag, explained, unknown = self._lag_columns()
            # in units of their deviations, which may be tiny
            single += [('smoothing', likely * lag, 1.0),
                       ('lag', min(unknown, likely) * explained, 1.0)]
        for name, column, size in single:
            waves = np.column_stack([waves, column])
            parts = [*(replace(each, variance=np.append(each.variance, 0.0)) for each in parts),
                     SharedNoise(name, np.append(np.zeros(waves.shape[1] - 1), 1.0),
                                 (size, size))]
        return waves, parts

    def _lag_columns(self) -> tuple[Array, Array, float]:
        """
        Return the column of a lag without its noise, what others explain of it, both (n + r,).

        What other values do not explain of a lag may be noise of the gyro: it is reduced to the
        share that the reference shows too (regression calibration, Carroll and others 2006). The
        noise that is left is an error of the lag, s².
        """
        time, columns = self.stamps, self.base_columns()
        column = self.cause_columns(CauseTerm('bandwidth'))[:, 0]
        turned = np.column_stack([self.point_means(integrate_with_curvature(
            time, self.output), self.output), self.heading])
        rates = CubicSpline(self.time, turned)((1.0 + self.clock_rate) * time - self.delay, 1).T
        seen = np.column_stack([column, *(
            -self.span_changes(np.gradient(self._smooth(each), time)) for each in rates),
            self.observed])
        left = seen - columns @ np.linalg.lstsq(columns, seen, rcond=None)[0]
        products = left.T @ left
        common, explained = products[1, 2], column - left[:, 0]
        chance = math.sqrt(products[1, 1] * products[2, 2] / max(self._motion_share.sum(), 1.0))
        if common <= 2.0 * chance:
            return explained, explained, 0.0
        # the points reduce fast accelerations of gyro and reference alike
        share = min(products[0, 2] ** 2 / max(common * products[0, 0], 1e-300), 1.0)
        # the noise of gyro and of reference, which the observations have too, move these apart
        by_gyro, by_reference = products[1:3, 3] / common
        unknown = 0.5 * (abs(by_gyro - by_reference)
                         + abs(by_gyro + by_reference) * chance / common)
        return explained + share * left[:, 0], explained, float(unknown)

    def acceleration_changes(self) -> Array:
        """Return the change of the acceleration, by the turns of half a second, shape (n + r,)."""
        turned, half = integrate_with_curvature(self.stamps, self.output), 0.5
        after, now, before = (np.interp(self.stamps + shift, self.stamps, turned)
                              for shift in (half, 0.0, -half))
        return self.span_changes((after - 2.0 * now + before) / half ** 2)


def lay_out_spans(log: Log | JoinedLogs, kind: str = 'course', prior: Array | None = None,
                  instants: OwnInstants | None = None, technology: str = 'mems') -> Spans:
    """
    Divide a log, or logs, with a reference of some kind into spans.

    The prior are standard deviations of (s, b) by `GyroModel.prior_deviations`, the instants those
    of a slow reference.
    """
    treatment = _TREATMENTS.get(kind, COURSE_TREATMENT)
    joined = log if isinstance(log, JoinedLogs) else None
    if joined is not None:
        log, instants = joined.log, joined.instants
    assert isinstance(log, Log)
    given = log.reference_heading
    if not (treatment.is_fine or joined):
        log, instants = keep_own_instants(log)
    assert log.time is not None and log.output is not None
    measured_type = np.full(2, math.inf) if prior is None else prior
    scale, bias = np.minimum(
        treatment.prior[:2] if treatment.is_fine else TECHNOLOGY_PRIORS[technology], measured_type)
    treatment = replace(treatment, prior=(float(scale), float(bias), treatment.prior[2]),
                        wide_prior=(WIDE_PRIOR[0], min(WIDE_PRIOR[1], float(measured_type[1]))))
    time, measured = log.time - log.time[0], log.output
    output, step = bridge_gaps(measured), quantization_step(measured[np.isfinite(measured)])
    # less than a thousandth of a step does not show
    white = max(white_noise_deviation(measured), 1e-3 * step)
    reference, at = _place_values(log, instants)
    measured_rows, noisier, rate = np.isfinite(measured), 0.0, log.reference_rate
    if given is None and rate is not None:
        measured_rows &= ~find_lost_reference(np.isfinite(rate))
        if is_slow(rate):  # its integral errs by what happens between its values
            treatment = replace(treatment, errs_as_heading=True)
        elif treatment.is_fine:
            noisier = rate_noise_share(log)
            white = math.hypot(white, white_noise_deviation(rate))
    at_samples = reference if log.reference_heading is None else log.reference_heading
    given = at_samples if given is None else given
    log = replace(log, time=time, output=output, reference_heading=at_samples,
                  reference_rate=None)
    walks = [white * math.sqrt(float(np.median(np.diff(time))))]
    if treatment.is_fine:
        # vibration adds white noise without a random walk, and a filter reduces the white noise
        difference = heading_difference(log)
        walks.append(difference.total_walk)
        if difference.is_significant:  # or a heading that was differentiated
            treatment = replace(treatment, errs_as_heading=True)
    else:
        walks = [min(walks[0], 5e-4)]  # more is vibration of the vehicle
    by_code = kind == 'encoder' and encoder_step(reference) > 0.0 and (at == time).all()
    if by_code:
        at, reference = _find_code_changes(time, output, reference)
    rests, stands = find_rests(time, output, reference if treatment.is_fine else given)
    if treatment.is_fine:
        rests, stands = rests[~stands], stands[~stands]
    known = np.flatnonzero(np.isfinite(reference) & ~mark_rows(rests[stands], len(time)))
    if len(known) < 2:
        raise DataRefused(f'the reference has {len(known)} values outside of rests in which it '
                          'stands, 2 are needed: give a reference of this motion')
    length = max(treatment.min_span, float(np.ptp(at[known])) / treatment.max_spans,
                 2.0 * float(np.median(np.diff(time))))
    place = _number_points(at[known], length)
    if not treatment.errs_as_heading:
        # means of an integrated rate would not err independently
        known = known[np.diff(place, prepend=-1) > 0]
        place = np.arange(len(known))
    count = np.bincount(place)
    channels = replace(joined.channels if joined else channels_from_log(log), rate=output,
                       heading=integrate(time, output))
    return Spans(log, channels, at[known], place, np.bincount(place, at[known]) / count,
                 np.bincount(place, reference[known]) / count, rests, stands, treatment,
                 (max(min(walks), 1e-9), max(*walks, 1e-9)), noisier, by_code,
                 find_holes(time[measured_rows], length), step,
                 not find_lost_reference(np.isfinite(given[known[0]:known[-1] + 1])).any(),
                 joined)


def _number_points(stamps: Array, length: float) -> NDArray[np.intp]:
    """Return the point of each value: that of its span, s; a gap begins a new point."""
    number = np.floor((stamps - stamps[0]) / length + 1e-6)
    return np.cumsum((np.diff(number, prepend=number[0]) > 0.0)
                     | (np.diff(stamps, prepend=stamps[0]) > length))


def _find_code_changes(time: Array, output: Array, codes: Array) -> tuple[Array, Array]:
    """Return the times at which the code of an encoder changes, and its headings then, or nan."""
    # between two readings with different codes the shaft was in the middle of both, but for what
    # the gyro turns unevenly; a single code gives only a range, and its error at rest or at a
    # reversal is systematic
    rows = np.flatnonzero(np.isfinite(codes))
    (begin, end), turned = (rows[:-1], rows[1:]), integrate(time, output)
    middle = 0.5 * (time[begin] + time[end])
    bent = np.interp(middle, time, turned) - 0.5 * (turned[begin] + turned[end])
    apart = time[end] - time[begin]
    around = np.maximum(np.append(apart[1:], 0.0), np.append(0.0, apart[:-1]))
    passed = (codes[begin] != codes[end]) & (apart <= 1.5 * around)
    at, reference = time.copy(), np.full(len(time), np.nan)
    at[begin] = middle
    reference[begin[passed]] = (0.5 * (codes[begin] + codes[end]) + bent)[passed]
    return at, reference


def _place_values(log: Log, instants: OwnInstants | None) -> tuple[Array, Array]:
    """Return the known headings of a reference, nan where there is none, and their times, (n,)."""
    assert log.time is not None
    rate, heading = log.reference_rate, log.reference_heading
    values = rate if heading is None else heading
    assert values is not None
    own, at = np.isfinite(values), log.time - log.time[0]
    if instants is not None and np.isfinite(instants.time[own]).all():
        values = instants.values
        at = np.where(own, instants.time - log.time[0], at)
    if heading is not None:
        return np.where(own, values, np.nan), at
    assert rate is not None
    if not is_slow(rate):
        return integrate_with_curvature(at, bridge_gaps(rate)), at
    turned = np.full(len(at), np.nan)
    steps = np.diff(CubicSpline(at[own], values[own]).antiderivative()(at[own]))
    # a spline swings where the motion stops
    steps[(values[own][1:] == 0.0) & (values[own][:-1] == 0.0)] = 0.0
    turned[own] = np.append(0.0, np.cumsum(steps))
    return turned, at


def design_matrix(spans: Spans, causes: Sequence[CauseTerm]) -> Array:
    """Return the columns of scale factor error, bias and delay, and those of causes."""
    return np.column_stack([spans.base_columns(), *(spans.cause_columns(each)
                                                    for each in spans.all_causes(causes))])
