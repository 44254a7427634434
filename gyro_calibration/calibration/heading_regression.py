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
Headings over spans: regression of the change of a reference on the integral of the gyro.

It is done under noise of gyro and reference that is found together with the values. The intervals
are not narrower than the scatter between stretches.

A course over ground, the direction of travel by satellites, differs from the heading by the side
slip. It is smoothed, late or early against the gyro, lost below some speed, and in bursts of some
seconds several times less accurate. Where a drive does not determine scale factor error and bias,
a prior does: normal about zero, with a standard deviation that is not known, but limited by the
technology of the gyro.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math
from typing import Any

from gyro_calibration.calibration.dwells import find_lost_reference
from gyro_calibration.calibration.likelihood import ScaleBiasFit
from gyro_calibration.calibration.noise_grid import (
    average_hypotheses, fit_noise_grid, GridFit, heading_noise, HierarchicalPrior)
from gyro_calibration.calibration.run_faults import fit_profile, split_run
from gyro_calibration.calibration.selection import TECHNOLOGY_PRIORS
from gyro_calibration.calibration.spans import (
    BASE_VALUES, CauseTerm, design_matrix, DRIFT_TERM, MISALIGNMENT_TERM, Spans, WIDE_PRIOR)
from gyro_calibration.logs.log import Array, DataRefused, DEGREE, Mask, NORMAL_QUANTILE_975
from gyro_calibration.logs.quality import robust_deviation
from gyro_calibration.model.motion import motion_from_headings
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.special import expit
from scipy.stats import t as student

#: Least effective number of stretches of an established value.
MIN_STRETCHES = 3.0
#: Least number of spans, and largest deviation in a span from a gyro that follows, rad.
_MIN_SPANS, MAX_FOLLOWED_RESIDUAL = 10, 3.0 * DEGREE


@dataclass(frozen=True)
class SpanFit:
    """A regression with its noise."""

    spans: Spans  # the log
    causes: tuple[CauseTerm, ...]  # in addition to scale factor error, bias and delay
    fit: GridFit  # of the restricted likelihood
    values: Array
    covariance: Array  # cluster-robust
    effective_stretches: Array  # effective number of stretches that determine each value
    freedom: Array  # degrees of freedom of the deviation of each value

    @property
    def deviations(self) -> Array:
        """Return the standard deviations of the values, shape (m,)."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 1e-300))

    def half_width(self, value_index: int) -> float:
        """Return half the length of the interval of 95 % of a value."""
        return float(student.ppf(0.975, self.freedom[value_index]) * self.deviations[value_index])

    def p_value(self, value_index: int) -> float:
        """Return the probability by chance of a value as far from 0, two-sided."""
        ratio = abs(self.values[value_index]) / self.deviations[value_index]
        return 2.0 * float(student.sf(ratio, self.freedom[value_index]))

    @property
    def reference_drift(self) -> tuple[float, float] | None:
        """Return the drift in motion and its half width, rad/s; None if it stands in no rest."""
        if DRIFT_TERM not in self.causes:
            return None
        place = self.value_slice(DRIFT_TERM).start
        return float(self.values[place]), self.half_width(place)

    @property
    def normal_covariance(self) -> Array:
        """Return the covariance whose normal intervals are as wide as Student's."""
        widening = student.ppf(0.975, self.freedom) / NORMAL_QUANTILE_975
        return self.covariance * np.outer(widening, widening)

    @property
    def lacks_turns(self) -> bool:
        """Tell whether too few stretches turn to show the scale factor error."""
        return bool(self.effective_stretches[0] < MIN_STRETCHES)

    def value_slice(self, cause: CauseTerm) -> slice:
        """Return the places of the values of a cause."""
        return self.spans.value_slice(self.causes, cause)

    def noise_size(self, name: str) -> float:
        """Return the estimate of a part of the noise; 0 if the reference has no such part."""
        return self.fit.size(name) if name in self.fit.sizes else 0.0


def fit_spans(spans: Spans, causes: Sequence[CauseTerm] = ()) -> SpanFit:
    """
    Fit scale factor error, bias, delay and causes, with the noise of gyro and reference.

    Rests that the motion contradicts are left out where no causes are given. Beside a course the
    values are means under the prior of the technology and a wide one, as of wheels of another
    size, weighted by their probability given the drive.
    """
    every, prior = spans.all_causes(causes), spans.treatment.prior
    corrected, point_variances = _correct_rate(spans, every)
    if not (causes or spans.stands.all()):
        corrected = _drop_contradicted_rests(corrected, every, point_variances)
    usual = _fit_with_noise(corrected, every, point_variances)
    if spans.treatment.is_fine or prior[0] == WIDE_PRIOR[0]:
        return usual
    # with the same rests, without which evidences cannot be compared
    wider = replace(spans, rests=corrected.rests, stands=corrected.stands,
                    treatment=replace(spans.treatment,
                                      prior=(*spans.treatment.wide_prior, prior[2])))
    corrected, point_variances = _correct_rate(wider, every)
    wide = _fit_with_noise(corrected, every, point_variances)
    assert spans.log.reference_heading is not None
    is_lost = find_lost_reference(np.isfinite(spans.log.reference_heading)).any()
    evidence = wide.fit.log_evidence - usual.fit.log_evidence
    of_scale, of_bias = (abs(wide.values[place]) - wide.half_width(place)
                         > NORMAL_QUANTILE_975 * prior[place] for place in (0, 1))
    if is_lost and of_bias and evidence > 0.0:  # it is not of the technology
        return fit_spans(replace(spans, treatment=replace(spans.treatment, prior=(
            TECHNOLOGY_PRIORS['mems'][0], spans.treatment.wide_prior[1], prior[2]))), causes)
    probability = 0.0 if is_lost and not of_scale else float(expit(
        evidence + math.log(1e-3 if is_lost else 1.0)))  # what is lost at times has no wheels
    likelier = wide if probability > 0.5 else usual
    if min(probability, 1.0 - probability) < 0.025:  # an interval of 95 % does not contain it
        return likelier
    values, covariance = average_hypotheses(
        np.array([1.0 - probability, probability]), np.array([usual.values, wide.values]),
        np.array([usual.normal_covariance, wide.normal_covariance]))
    widening = np.sqrt(np.diag(likelier.normal_covariance) / np.diag(likelier.covariance))
    return replace(likelier, values=values,
                   covariance=covariance / np.outer(widening, widening))


def _correct_rate(spans: Spans, causes: Sequence[CauseTerm]) -> tuple[Spans, Array]:
    """Return the spans with the rate corrected by first values, and variances of points."""
    scale, is_known = 0.0, spans.delay or spans.joined
    corrected = spans if is_known else replace(spans, delay=find_reference_delay(spans))
    for number in range(20):
        values, left = robust_least_squares(design_matrix(corrected, causes), corrected.observed,
                                            spans.prior_deviations(causes))
        corrected = corrected.with_corrected_rate(values, causes)
        change, scale = values[0] - scale, values[0]
        # the columns are of the rate by the scale before
        if number and abs(scale * change) < 1e-4:
            break
    return corrected, _point_variances(corrected, left)


def find_reference_delay(spans: Spans) -> float:
    """Return the trial delay of the best agreement of gyro and reference, s."""
    run = split_run(spans.stamps - spans.time[0], spans.output)
    return fit_profile(run, motion_from_headings(spans.time, spans.heading),
                       spans.treatment.largest_delay)[2]


def robust_least_squares(columns: Array, observed: Array, prior: Array) -> tuple[Array, Array]:
    """Return values by robust weighted least squares, and the residual."""
    left: Array = observed
    values: Array = np.zeros(columns.shape[1])
    own = np.diag(1.0 / prior)
    for _ in range(5):
        size = robust_deviation(left) + 1e-12
        weight = 1.0 / np.maximum(np.abs(left) / (2.0 * size), 1.0) / size
        rows = np.vstack([columns * weight[:, None], own])
        values = np.asarray(np.linalg.lstsq(
            rows, np.append(observed * weight, np.zeros(len(prior))), rcond=None)[0])
        left = np.asarray(observed - columns @ values)
    return values, left


def _drop_contradicted_rests(spans: Spans, causes: Sequence[CauseTerm],
                             point_variances: Array) -> Spans:
    """Return the spans without rests whose rate is not the bias that the course shows."""
    by_course = _fit_with_noise(replace(spans, rests=spans.rests[spans.stands],
                                        stands=spans.stands[spans.stands]), causes,
                                point_variances)
    rates = np.array([spans.output[first:last].mean() for first, last in spans.rests])
    biases = spans.biases(by_course.values, causes)[spans.rests[:, 0]]
    agree = spans.stands | (np.abs(rates - biases) < by_course.half_width(1))
    return replace(spans, rests=spans.rests[agree], stands=spans.stands[agree])


def _point_variances(spans: Spans, left: Array) -> Array:
    """
    Return the variance of each point relative to the usual one, by the residual, shape (n + 1,).

    Outliers have more, by up to 100, and beside a course all points around bursts of errors, which
    last for about 5 s.
    """
    error = np.append(0.0, np.cumsum(left[:len(spans.time) - 1]))
    if spans.treatment.is_fine:
        off = np.abs(error - median_filter(error, 9, mode='nearest'))
        # a monotonic drift is equal to its median
        by_steps = robust_deviation(np.diff(error, 2)) / math.sqrt(6.0)
        size = max(robust_deviation(off), by_steps) + 1e-9
        return np.clip(off / (3.0 * size), 1.0, 10.0) ** 2
    around = np.abs(spans.time[:, None] - spans.time) <= 2.5
    squares, count = around @ (error - np.median(error)) ** 2, around.sum(axis=1)
    usual = max(float(np.median(squares / count)), 1e-12)
    # Student's distribution with 4 degrees of freedom, and one for each observed error
    return np.asarray((4.0 + squares / usual) / (4.0 + count))


def _fit_with_noise(spans: Spans, causes: Sequence[CauseTerm],
                    point_variances: Array) -> SpanFit:
    """Fit by the restricted likelihood over a grid of noise."""
    columns, (least, most) = design_matrix(spans, causes), spans.walk_bounds
    low, high = spans.treatment.walk_range
    rates = spans.point_means(np.asarray(spans.channels.rate))
    in_motion = spans.point_means(spans.time_in_motion) + spans.time_outside
    durations = spans.rest_durations
    prior, deviation = spans.treatment.prior, spans.prior_deviations(causes)
    observed, (waves, shared) = spans.observed, spans.bias_wander()

    # by many small slips, the errors of odometry add up with the angle turned
    parts = heading_noise(in_motion, rates, point_variances, (low * least, high * most),
                          np.abs(spans.angles) if spans.adds_up and not spans.treatment.is_fine
                          else None, spans.is_measured[:len(spans.time) - 1])
    parts = [replace(part, diagonal=np.append(part.diagonal, of_rests),
                     off_diagonal=None if part.off_diagonal is None
                     else np.append(part.off_diagonal, 0.0 * durations))
             for part, of_rests in zip(parts, [
                 durations, *[0.0 * durations] * (len(parts) - 1)])]
    if not spans.treatment.errs_as_heading:
        parts = parts[:1] + parts[3:]
    # what a drive of minutes does not determine is drawn to 0
    options: dict[str, Any] = {} if spans.treatment.is_fine else {
        'wandering_value': 1, 'hierarchical_priors': [
            HierarchicalPrior(name, place, (1e-2 * size, size))
            for place, (name, size) in enumerate(zip(BASE_VALUES, prior[:2]))]}
    fit = fit_noise_grid(observed, columns, parts, waves, shared, prior_deviation=deviation,
                         **options)
    values = fit.values + spans.correction(causes, len(fit.values))
    done = SpanFit(spans, tuple(causes), fit, values, fit.covariance, np.zeros(len(values)),
                   np.ones(len(values)))
    covariance, effective, freedom = _cluster_robust_covariance(
        whiten_regression(done, causes), fit, np.array(prior))
    return replace(done, covariance=covariance, effective_stretches=effective, freedom=freedom)


def _cluster_robust_covariance(data: WhitenedRegression, fit: GridFit,
                               prior: Array) -> tuple[Array, Array, Array]:
    """
    Return the covariance of the values, not less than the scatter of the scores of stretches.

    Nor less than their mean square error under the widest prior, nor than what they change by
    without each place of a shaft (jackknife, Tukey 1958). The intervals of the first values are
    not wider than those of their priors; that of a scale factor error that fewer than
    `MIN_STRETCHES` stretches determine is as wide. Also the effective number of stretches of each
    value, and the freedom.
    """
    count, (stretch, *sectors) = len(fit.values), data.clusters
    values = np.linalg.lstsq(data.design, data.observed, rcond=None)[0]
    left = data.observed - data.design @ values
    inverse = np.linalg.pinv(data.design.T @ data.design)[:, :count]
    influence = data.design @ inverse
    inside = stretch < data.stretch_count
    scores = np.array([np.bincount(stretch, part * left) for part in influence.T])
    number = float(stretch.max()) + 1.0
    scatter = np.sum(scores ** 2, axis=1) * number / max(number - 1.0, 0.5)
    variances = np.maximum(np.maximum(np.diag(fit.covariance), scatter),
                           np.diag(inverse) + (values[:count] - fit.values) ** 2)
    effective = _effective_clusters(stretch[inside], data.design[inside, :count])
    freedom = np.maximum(effective - 1.0, 1.0)
    for cluster in sectors:
        rests_on = _effective_clusters(cluster[inside], influence[inside])
        scatter = _jackknife(data, cluster, inside)[:count]
        freedom = np.where(scatter > variances, np.maximum(rests_on - 1.0, 1.0), freedom)
        variances = np.maximum(variances, scatter)
    if effective[0] < MIN_STRETCHES and prior[0] != WIDE_PRIOR[0]:
        variances[0] = math.inf
    largest = NORMAL_QUANTILE_975 * prior / student.ppf(0.975, freedom[:len(prior)])
    variances[:len(prior)] = np.minimum(variances[:len(prior)], largest ** 2)
    inflation = np.sqrt(variances / np.diag(fit.covariance))
    return fit.covariance * np.outer(inflation, inflation), effective, freedom


def _jackknife(data: WhitenedRegression, cluster: NDArray[np.intp], inside: Mask) -> Array:
    """Return the variance of the values by what they are without each cluster in turn."""
    rows = np.column_stack([data.design, data.observed])
    scale = np.sqrt(np.sum(rows ** 2, axis=0)) + 1e-300
    rows = rows / scale
    whole, without = rows.T @ rows, []
    for number in np.unique(cluster[inside]):
        own = rows[cluster == number]
        gram = whole - own.T @ own
        without.append(np.linalg.pinv(gram[:-1, :-1], hermitian=True) @ gram[:-1, -1])
    parts = len(without)
    return np.asarray((parts - 1) * np.var(without, axis=0) * (scale[-1] / scale[:-1]) ** 2)


def _effective_clusters(cluster: NDArray[np.intp], columns: Array) -> Array:
    """Return the effective number of clusters that determine each column."""
    shares = np.array([np.bincount(cluster, part ** 2) for part in columns.T])
    return np.asarray(shares.sum(axis=1) ** 2 / np.maximum((shares ** 2).sum(axis=1), 1e-300))


@dataclass(frozen=True)
class WhitenedRegression:
    """
    A whitened regression, for which ordinary least squares is generalized least squares.

    The m priors of values and wandering bias are rows after the observations, each a cluster.
    """

    observed: Array  # shape (n + r + m,)
    # columns of scale factor error, bias, delay and causes, then those of the wander
    design: Array
    # numbers of the stretch of each row, and, of an encoder, of the place of the shaft
    clusters: tuple[NDArray[np.intp], ...]
    stretch_count: int  # number of stretches of the log; those after them are priors


def whiten_regression(fit: SpanFit, causes: Sequence[CauseTerm],
                      noise_fit: SpanFit | None = None) -> WhitenedRegression:
    """Return the regression of a log on causes, under the noise of a fit of the same log."""
    spans, noise = fit.spans, (noise_fit or fit).fit
    waves, shared = spans.bias_wander()
    variance: Array = np.zeros(waves.shape[1])
    for part in shared:
        variance += noise.likeliest_sizes[part.name] ** 2 * part.variance
    columns = np.column_stack([design_matrix(spans, causes), waves])
    deviation = np.append(spans.prior_deviations(causes), np.sqrt(variance))
    prior = np.diag(1.0 / deviation)[np.isfinite(deviation)]
    stretches = spans.stretch_numbers
    sectors = [spans.shaft_sectors] if spans.uses_code_changes else []
    clusters = tuple(np.concatenate([each, each.max() + 1 + np.arange(len(prior))])
                     for each in (stretches, *sectors))
    return WhitenedRegression(np.append(noise.whiten(spans.observed), np.zeros(len(prior))),
                              np.concatenate([noise.whiten(columns), prior]), clusters,
                              int(stretches.max()) + 1)


def fit_course(spans: Spans) -> ScaleBiasFit:
    """
    Fit scale factor error, bias and time offset to a drive with a course.

    `DataRefused` is raised where the course is known for too short a time, or the gyro does not
    follow it.
    """
    length = spans.treatment.min_span
    duration = len(spans.time) * length + spans.rest_durations[spans.stands].sum()
    if duration < _MIN_SPANS * length:
        raise DataRefused(f'the course is known for {duration:.0f} s, wanted at '
                          f'least {_MIN_SPANS * length:.0f} s: drive for longer, faster than a '
                          'walk')
    fit = fit_spans(spans)
    turned = np.diff(spans.heading)
    left = fit.spans.observed - fit.values[0] * fit.spans.base_columns()[:, 0]
    # a bias is the same in each span
    residual, variation = (robust_deviation(each - np.median(each))
                           for each in (left[:len(turned)], turned))
    if residual > max(MAX_FOLLOWED_RESIDUAL, 0.5 * variation):
        raise DataRefused(f'from span to span of {length:.0f} s the course turns by '
                          f'{variation / DEGREE:.1f} deg, and its difference to the gyro changes '
                          f'by {residual / DEGREE:.1f} deg (robust standard deviations): the gyro '
                          'does not follow the course. Check that both belong to one drive, and '
                          'check axis, sign, units, that the gyro responds, and that turns exceed '
                          'the errors of the course')
    covariance = fit.normal_covariance
    axes = (fit.value_slice(MISALIGNMENT_TERM) if MISALIGNMENT_TERM in fit.causes
            else slice(0))
    scale, bias, delay = fit.values[:len(BASE_VALUES)].tolist()
    return ScaleBiasFit(scale, bias, covariance[:2, :2], delay,
                        fit.noise_size('angle_random_walk'), fit.noise_size('reference'),
                        time_offset_deviation=math.sqrt(covariance[2, 2]),
                        reference_drift=fit.reference_drift,
                        # a course may be lost in the rests before and after the drive alone
                        reference_adds_up=spans.adds_up and bool(spans.stands.all()),
                        misalignment=fit.values[axes],
                        misalignment_covariance=covariance[axes, axes])
