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
The search for causes of a log as spans, which has the interface of that of a log in samples.

The score of a cause is also summed over stretches. Its variance is that by the noise or that by
the scatter of the stretches, whichever is larger, and its distribution is Fisher's, with the
effective number of stretches less that of the columns as the degrees of freedom. The evidence is
at most that of this test.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
import math

from gyro_calibration.calibration.heading_regression import (
    fit_spans, MIN_STRETCHES, SpanFit, whiten_regression, WhitenedRegression)
from gyro_calibration.calibration.noise_grid import GridFit
from gyro_calibration.calibration.spans import (
    CauseTerm, design_matrix, HEADING_TREATMENT, Spans)
from gyro_calibration.diagnosis.candidates import (
    Candidate, indices_by_cause, lasting_shapes, MIN_CHANNEL_RANGE)
from gyro_calibration.diagnosis.causes import CAUSES
from gyro_calibration.diagnosis.findings import Estimate, OnProgress, prediction_sigmas
from gyro_calibration.diagnosis.regression import (
    column_evidence, columns_of, fit_causes, group_columns, RegressionFit)
from gyro_calibration.diagnosis.scans import best_steps, Scored
from gyro_calibration.diagnosis.search import (
    confirm_causes, explain_selection, Search, search_causes, SelectedCause)
from gyro_calibration.logs.log import Array, NORMAL_QUANTILE_975
from gyro_calibration.logs.quality import quantization_step
from gyro_calibration.model.effects import CATALOGUE, SINE_RESPONSE
import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2
from scipy.stats import f as fisher

#: Sizes of each part of the wander of the bias, times of a step, and dead zones that are tried.
_SIZES, _STEP_TIMES, _DEAD_ZONES = 8, 400, 14
#: Most rounds in which the rate in a dead zone and its size are found, and sizes tried in each.
_ZONE_ROUNDS, _ZONE_SIZES = 6, 61
_DEAD_ZONE = 'dead_zone'
#: Causes of which only the shape is unknown, and which have a column of this shape.
OF_FIXED_SIZE = (SINE_RESPONSE.name, _DEAD_ZONE)


@dataclass(frozen=True, eq=False)
class SpanProblem:
    """A log as spans, as a `RegressionProblem`, under each size of a wander of the bias."""

    spans: Spans  # with the rate as corrected so far
    noise: GridFit  # of gyro and reference, which whitens
    data: WhitenedRegression  # with the prior of the values; its last w rows are of the wander
    base: Array  # rows of what is always fitted, and last of the observations
    wander: Array  # columns of the wandering bias, whitened, shape (w, m)
    deviations: Array  # of the wander, under each noise, shape (g, w)
    cosine_count: int  # number of the columns that are cosines

    @classmethod
    def of(cls, fit: SpanFit, noise_fit: SpanFit) -> SpanProblem:
        """Return the problem of a log under the noise of a fit, with wanders of all sizes."""
        waves, parts = fit.spans.bias_wander()
        axes = [np.geomspace(*part.size_range, 1 if len({*part.size_range}) == 1 else _SIZES)
                for part in parts]
        variances = np.array([*product(*axes)]) ** 2 @ np.array([each.variance for each in parts])
        data, count = whiten_regression(fit, (), noise_fit), waves.shape[1]
        rows = np.column_stack([data.design, data.observed])[:-count].T
        return cls(fit.spans, noise_fit.fit, data, np.delete(rows, slice(-count - 1, -1), axis=0),
                   rows[-count - 1:-1], np.sqrt(variances),
                   int(np.count_nonzero(parts[0].variance)))

    def whiten(self, columns: Array) -> Array:
        """Return columns, shape (n + r, k), in units of the noise, shape (k, m)."""
        white = self.noise.whiten(columns).T
        return np.pad(white, ((0, 0), (0, self.wander.shape[1] - white.shape[1])))

    @cached_property
    def _scaled(self) -> Array:
        """Return identity and products of the wander in its deviations, shape (g, w, w)."""
        gram = self.wander @ self.wander.T
        return np.eye(len(gram)) + self.deviations[:, :, None] * gram * self.deviations[:, None]

    @cached_property
    def _reduction(self) -> Array:
        """Return the matrices by which the wander reduces products, shape (g, w, w)."""
        return np.asarray(self.deviations[:, :, None] * np.linalg.inv(self._scaled)
                          * self.deviations[:, None])

    # as of `RegressionProblem`

    @cached_property
    def log_determinants(self) -> Array:
        return np.linalg.slogdet(self._scaled)[1]

    @property
    def durations(self) -> list[float]:
        return [float(np.ptp(self.spans.time))]

    def distorted(self, causes: Sequence[Candidate]) -> tuple[Spans, ...]:
        return (self.spans,)

    def base_rows(self, logs: tuple[Spans, ...]) -> Array:
        return self.base

    def rows(self, candidate: Candidate, logs: tuple[Spans, ...]) -> Array:
        return self.whiten(columns_of(replace(candidate, values=()), self.spans).T)

    def products(self, one: Array, other: Array) -> Array:
        of_one, of_other = (each @ self.wander.T for each in (one, other))
        return one @ np.swapaxes(other, -1, -2) - np.einsum(
            '...rw,gwv,...sv->g...rs', of_one, self._reduction, of_other, optimize=True)

    def with_noises(self, kept: list[int]) -> SpanProblem:
        return replace(self, deviations=self.deviations[kept])

    def _with_wander(self, rows: Array, noise: int) -> tuple[Array, Array]:
        """Return rows, shape (k, m), and the wander with its prior under a noise, (w, m + w)."""
        prior = np.diag(1.0 / self.deviations[noise])
        return np.pad(rows, ((0, 0), (0, len(prior)))), np.hstack([self.wander, prior])

    def held_out_gains(self, full: RegressionFit, rest: RegressionFit,
                       known: Candidate) -> Array | None:
        # all values are fitted without each fifth of the log, or every fifth stretch, where slow
        # causes are also predicted by the wander of neighbouring ones; errors of a course are
        # correlated, so that distant stretches must be predicted
        if known.log_index is not None:
            return None
        stretch, count = self.data.clusters[0], self.data.stretch_count
        gains = []
        for fold in [stretch * 5 // count, stretch % 5][:1 + self.spans.treatment.is_fine]:
            losses = []
            for fit in (rest, full):
                rows, wander = self._with_wander(fit.rows, full.best_noise)
                design, observed = np.vstack([rows[:-1], wander]).T, rows[-1]
                left: Array = np.zeros(len(observed))
                for held in (np.equal(fold, part) & (stretch < count) for part in range(5)):
                    values = np.linalg.lstsq(design[~held], observed[~held], rcond=None)[0]
                    left[held] = observed[held] - design[held] @ values
                losses.append(0.5 * np.bincount(stretch, left ** 2)[:count])
            gains.append(losses[0] - losses[1])
        return max(gains, key=prediction_sigmas)

    def without_causes(self, rest: RegressionFit, rows: Array, noise: int) -> Array:
        """Return rows and residual, (m, k + 1), less what wander and causes of a fit explain."""
        rows, wander = self._with_wander(np.vstack([rest.columns, rows, rest.rows[-1]]), noise)
        given, sought = np.split(rows, [len(rest.columns)])
        base, _ = np.linalg.qr(np.vstack([given, wander]).T)
        return np.asarray(sought.T - base @ (base.T @ sought.T))

    def robust_evidence(self, rest: RegressionFit, candidate: Candidate) -> tuple[float, float]:
        # the noise without a slow cause has its wander
        best, count = fit_causes(self, [*rest.causes, candidate]).best_noise, len(self.wander)
        left = self.without_causes(rest, self.rows(candidate, rest.distorted), best)
        # along the motion they are similar to errors of an encoder that repeat with its position
        along = CAUSES[candidate.cause].along in ('rate', 'heading')
        chance, ratio = _cluster_robust_chance(
            left[:, :-1], left[:, -1], self.data.clusters[:None if along else 1],
            slice(-count, self.cosine_count - count or None))
        return 0.5 * float(chi2.isf(max(chance, 1e-300), 1)) - candidate.penalty, ratio


def span_candidate(name: str, *shapes: float) -> Candidate:
    """Return a cause for the search, whose columns are those of spans."""
    def columns(spans: Spans, *sizes: float) -> Sequence[Array]:
        found: Array = (spans.step_columns(np.array(sizes)) if name == 'bias_step'
                        else spans.cause_columns(CauseTerm(name, sizes)))
        return [*found.T]

    return Candidate(name, shapes, columns,
                     amplitude=1.0 if name in OF_FIXED_SIZE else None)


def find_span_steps(fit: RegressionFit) -> list[Scored]:
    """Return the clearest step of the bias of a log as spans."""
    problem = fit.problem
    times = problem.spans.time[2:-2]
    times = times[::math.ceil(len(times) / _STEP_TIMES)]
    evidence = column_evidence(fit, group_columns(
        problem, problem.whiten(problem.spans.step_columns(times)),
        np.arange(len(times))[:, None].tolist()))
    return best_steps([(times, evidence)], span_candidate)


def _cluster_robust_chance(x: Array, residual: Array, clusters: Sequence[NDArray[np.intp]],
                           cosines: slice) -> tuple[float, float]:
    """
    Return the largest p-value of columns by any of the clusterings, and the ratio of variances.

    It is the variance by the scatter of the clusters over that by the noise, at least 1. Evidence
    against a wander of the bias counts as that of all its cosines, since all of them show its
    size, although a slow cause is in few of them. Fewer clusters than `MIN_STRETCHES` show none.
    """
    size = np.linalg.norm(x, axis=0) + 1e-300
    axes, lengths, _ = np.linalg.svd(x / size, full_matrices=False)
    axes = axes[:, lengths > 1e-6]  # columns that depend on each other count once
    count, found = axes.shape[1], []
    if not count:
        return 1.0, 1.0
    # by the residual with the candidate: scores that contain the effect would overestimate scatter
    along = axes.T @ residual
    off = residual - axes @ along
    for cluster in clusters:
        scores = np.array([np.bincount(cluster, part * off) for part in axes.T])
        shares = np.bincount(cluster, np.sum((x / size) ** 2, axis=1))
        shares[cosines] = shares[cosines].mean()
        effective = float(shares.sum() ** 2 / (shares ** 2).sum())
        scatter = scores @ scores.T * effective / max(effective - 1.0 - count, 0.5)
        ratio = max(float(np.linalg.eigvalsh(scatter).max()), 1.0)
        found.append((1.0 if effective < MIN_STRETCHES else float(fisher.sf(
            along @ along / ratio / count, count, max(effective - count, 1.0))), ratio))
    return max(found)


# the search

def term_of(cause: Candidate) -> CauseTerm:
    """Return a cause of the search as one of spans."""
    return CauseTerm(cause.cause, cause.shapes)


def suspect_terms(found: Sequence[SelectedCause],
                  terms: Collection[CauseTerm]) -> list[SelectedCause]:
    """Return causes, of which some are no longer established."""
    return [replace(each, is_established=each.is_established
                    and term_of(each.cause) not in terms) for each in found]


def follows_the_rate(cause: str) -> bool:
    """Tell whether a cause adds nothing to the heading where the gyro does not turn."""
    effect = CATALOGUE.get(cause)
    return cause == 'clock_rate' or effect is not None and 'rate' in effect.inputs


def _slowest_rate(fit: SpanFit) -> float:
    """
    Return the rate, rad/s, above which a dead zone beside an encoder is not one of its errors.

    A span turns by more than a step. The noise of a rate by the reference, of variance v, is in
    the observations too, so that all n spans show a zone d with an evidence of up to
    ``1.5 n v / d²``, which is to be that of two sigma at most.
    """
    heading, time = np.asarray(fit.spans.log.reference_heading), fit.spans.time
    noise = fit.noise_size('reference') * math.sqrt(2.0 * 0.75 * len(time))
    return max(quantization_step(heading[np.isfinite(heading)]), noise) / float(
        np.median(np.diff(time)))


def propose_terms(fit: SpanFit) -> list[CauseTerm]:
    """
    Return the causes that headings over spans can show, for the channels that the log has.

    Where too few stretches turn, none that follows the rate can be told from the scale factor
    error.
    """
    log, fine, time = fit.spans.log, fit.spans.treatment.is_fine, fit.spans.time
    has = {name for name, least in MIN_CHANNEL_RANGE.items()
           if getattr(log, name) is not None and np.ptp(getattr(log, name)) > least}
    terms = [CauseTerm(*each) for each in lasting_shapes(
        has, float(time[-1] - time[0]), np.asarray(fit.spans.channels.temperature))]
    fastest = float(np.abs(fit.spans.channels.rate).max())
    terms += [CauseTerm('clock_rate')] * (fit.spans.joined is None)
    if fine and fastest > 0.0:
        terms.append(CauseTerm(SINE_RESPONSE.name, (0.5 / fastest,)))
    slowest = _slowest_rate(fit)
    # a noise of other headings that is not white passes for slow motion that the gyro lacks
    if fit.spans.uses_code_changes and slowest < 0.5 * fastest:
        terms += [CauseTerm(_DEAD_ZONE, (size,)) for size in np.geomspace(
            slowest, 0.5 * fastest, _DEAD_ZONES).tolist()]
    return [each for each in terms if (fine or each.cause != 'reference_once_per_rev')
            and not (fit.lacks_turns and follows_the_rate(each.cause))]


def select_causes(fit: SpanFit, false_alarm_rate: float,
                  on_progress: OnProgress) -> tuple[SpanFit, list[SelectedCause]]:
    """Search for causes, and fit again with those that are established."""
    terms = propose_terms(fit)
    candidates = tuple(span_candidate(each.cause, *each.shapes) for each in terms)
    # noise given one column of each cause, so that it does not absorb their contributions
    rich = [*{each.cause: each for each in terms if each.cause != SINE_RESPONSE.name}.values()]
    # of a log with fewer spans than columns, the noise is that without them
    noise_fit = (fit_spans(fit.spans, rich)
                 if design_matrix(fit.spans, rich).shape[1] < len(fit.spans.time) - 1 else fit)
    search = Search(SpanProblem.of(fit, noise_fit), candidates,
                    false_alarm_rate / (1 + len(indices_by_cause(candidates))),
                    {'bias_step': find_span_steps}, on_progress=on_progress)
    causes = search_causes(search)
    found = [*explain_selection(search, confirm_causes(search, causes))]
    while established := [term_of(each.cause) for each in found if each.is_established]:
        extended = fit_spans(fit.spans, established)
        worst = max(established,
                    key=lambda each: _implausibility(extended, each, false_alarm_rate))
        if _implausibility(extended, worst, false_alarm_rate) < 1.0:
            return _refine_dead_zone(extended, found)
        found = suspect_terms(found, [worst])
    return fit, found


def _implausibility(fit: SpanFit, cause: CauseTerm, false_alarm_rate: float) -> float:
    """
    Return the ratio of an effect to the largest plausible one; inf if it may be 0.

    It may be if it is not significant under the noise that is fitted with it, by which the search
    does not test: a single value at the level of the search.
    """
    places = fit.value_slice(cause)
    values = fit.values[places]
    if cause.cause == _DEAD_ZONE and cause.shapes[0] < _slowest_rate(fit):
        return math.inf
    if cause.cause == 'reference_once_per_rev':
        # from 1 on, the reference would turn back
        return float(np.hypot(*values))
    if len(values) == 1 and fit.p_value(places.start) >= false_alarm_rate:
        return math.inf
    if (CAUSES[cause.cause].along not in ('rate', 'heading')
            or cause.cause not in CATALOGUE):
        return 0.0
    columns = CATALOGUE[cause.cause].columns(fit.spans.channels, *cause.shapes)
    added = np.abs(np.tensordot(values, np.array(columns), 1)).max()
    # of two standard deviations of the prior of a scale factor error, as a share of the rate;
    # larger ones result from several similar columns that nearly cancel each other
    return float(added / np.abs(fit.spans.channels.rate).max()) / (
        2.0 * HEADING_TREATMENT.prior[0])


def _refine_dead_zone(fit: SpanFit,
                      found: list[SelectedCause]) -> tuple[SpanFit, list[SelectedCause]]:
    """
    Return a fit, and its causes, with the likeliest size of a dead zone, if there is one.

    The rate within the zone is that of the reference, which is found with the zone: both in turn.
    A size is in the interval unless it is worse by more than twice the scatter of the difference
    between stretches (Vuong 1989); to its ends is added what the rate changes within a span where
    it passes the limit.
    """
    others = [each for each in fit.causes if each.cause != _DEAD_ZONE]
    if len(others) == len(fit.causes):
        return fit, found
    (size,), = (each.shapes for each in fit.causes if each.cause == _DEAD_ZONE)
    sizes = list[float]()
    while size not in sizes and len(sizes) < _ZONE_ROUNDS:
        sizes.append(size)
        problem = SpanProblem.of(fit, fit)
        rest = fit_causes(problem, [
            span_candidate(each.cause, *each.shapes) for each in others if each.cause in CAUSES])
        tried = size * np.geomspace(0.5, 2.0, _ZONE_SIZES)
        columns = np.concatenate([problem.rows(span_candidate(_DEAD_ZONE, each), rest.distorted)
                                  for each in tried.tolist()])
        noise = fit_causes(problem, [*rest.causes, span_candidate(_DEAD_ZONE, size)]).best_noise
        *zones, left = problem.without_causes(rest, columns, noise).T
        stretch, count = problem.data.clusters[0], problem.data.stretch_count
        losses = np.array([0.5 * np.bincount(stretch, (left - zone) ** 2)[:count]
                           for zone in zones])
        best = int(losses.sum(axis=1).argmin())
        size = float(tried[best])
        fit = fit_spans(fit.spans, [*others, CauseTerm(_DEAD_ZONE, (size,))])
    excess = losses - losses[best]
    likely = tried[excess.sum(axis=1) <= 2.0 * np.linalg.norm(excess, axis=1)]
    half = _limit_half_width(fit.spans, size)
    known = Estimate(size, (max(float(likely[0]) - half, 0.0), float(likely[-1]) + half), 'rad/s')
    return fit, [replace(each, sizes={_DEAD_ZONE: known}) if each.cause.cause == _DEAD_ZONE
                 else each for each in found]


def _limit_half_width(spans: Spans, limit: float) -> float:
    """Return the half-width, rad/s, of the interval of 95 % of a limit that the rate passes."""
    rates = np.abs(np.diff(spans.point_means(np.asarray(spans.channels.heading)))
                   / np.diff(spans.time))
    change = np.maximum(np.abs(np.diff(rates)), np.finfo(float).tiny)[np.diff(rates < limit)]
    # each pass shows it to within the change from span to span, a slow pass best
    return NORMAL_QUANTILE_975 * math.sqrt(max(len(change), 1) / 12.0) / float(
        np.sum(1.0 / change, initial=1.0 / limit))
