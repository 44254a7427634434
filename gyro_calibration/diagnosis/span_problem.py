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
A log as spans, for the search for causes beside a reference that has errors of its own.

The noise of gyro and reference is known, and the bias may wander by any size. The score of a cause
is also summed over stretches. Its variance is that by the noise or that by the scatter of the
stretches, whichever is larger, and its distribution is Fisher's, with the effective number of
stretches less that of the columns as the degrees of freedom. The evidence is at most that of this
test.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
import math

from gyro_calibration.calibration.heading_regression import (
    MIN_STRETCHES, SpanFit, whiten_regression, WhitenedRegression)
from gyro_calibration.calibration.noise_grid import GridFit
from gyro_calibration.calibration.spans import CauseTerm, Spans
from gyro_calibration.diagnosis.candidates import Candidate
from gyro_calibration.diagnosis.causes import CAUSES
from gyro_calibration.diagnosis.findings import prediction_sigmas
from gyro_calibration.diagnosis.regression import (
    column_evidence, fit_causes, group_columns, RegressionFit)
from gyro_calibration.diagnosis.scans import best_steps, Scored
from gyro_calibration.logs.log import Array
from gyro_calibration.model.effects import SINE_RESPONSE
import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2
from scipy.stats import f as fisher

#: Sizes of each part of the wander of the bias, and times of a step, that are tried.
_SIZES, _STEP_TIMES = 8, 400


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
        return self.whiten(np.transpose(candidate.columns(self.spans)))

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

    def robust_evidence(self, rest: RegressionFit, candidate: Candidate) -> tuple[float, float]:
        # the noise without a slow cause has its wander
        best, count = fit_causes(self, [*rest.causes, candidate]).best_noise, len(self.wander)
        rows, wander = self._with_wander(np.vstack([
            rest.columns, self.rows(candidate, rest.distorted), rest.rows[-1]]), best)
        given, sought = np.split(rows, [len(rest.columns)])
        base, _ = np.linalg.qr(np.vstack([given, wander]).T)
        left = sought.T - base @ (base.T @ sought.T)
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
                     amplitude=1.0 if name == SINE_RESPONSE.name else None)


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
    information = x.T @ x
    size = np.sqrt(np.diag(information)) + 1e-300
    # by the residual with the candidate: scores that contain the effect would overestimate scatter
    off = residual - x @ np.linalg.lstsq(x, residual, rcond=None)[0]
    count, found = x.shape[1], []
    root = np.linalg.inv(np.linalg.cholesky(information + 1e-12 * np.diag(size ** 2)))
    square = float(np.sum((root @ x.T @ residual) ** 2))
    for cluster in clusters:
        scores = np.array([np.bincount(cluster, part * off) for part in x.T])
        shares = np.bincount(cluster, np.sum((x / size) ** 2, axis=1))
        shares[cosines] = shares[cosines].mean()
        effective = float(shares.sum() ** 2 / (shares ** 2).sum())
        scatter = scores @ scores.T * effective / max(effective - 1.0 - count, 0.5)
        ratio = max(float(np.linalg.eigvalsh(root @ scatter @ root.T).max()), 1.0)
        found.append((1.0 if effective < MIN_STRETCHES else float(fisher.sf(
            square / ratio / count, count, max(effective - count, 1.0))), ratio))
    return max(found)
