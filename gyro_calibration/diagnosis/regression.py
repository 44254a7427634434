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
Regression of logs on causes, under every noise of a grid.

The products of the transformed residual z and the columns X of all causes are summed once, band by
band. For any noise the likelihood is then linear algebra on these sums, so that every cause is
tested under every noise, and a slow cause is not absorbed by a random walk that was fitted before
it. The evidence of a cause is the likelihood with it over the likelihood without it, each averaged
over the noises, at the most likely value of the cause (a flat prior, scaled so that for a known
noise the evidence is n² / 2 for a value of n standard deviations).

Axes: g noises, b bands, m coefficients, q columns of a fit, p columns of candidates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
import math
from typing import Any

from gyro_calibration.diagnosis.candidates import (
    Candidate, fitted_shape_indices, is_named, MAX_STEP_TIME_LACK, MAX_STEP_TIMES, smooth_shapes,
    with_shape)
from gyro_calibration.diagnosis.findings import Estimate
from gyro_calibration.diagnosis.replay import (
    band_starts, coefficient_angles, inverse_cosine_transform, noise_grid, NoiseShape, Replay,
    stated_shapes)
from gyro_calibration.logs.log import Array, NORMAL_QUANTILE_975
from gyro_calibration.model.effects import CATALOGUE
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.optimize import bisect
from scipy.special import logsumexp

#: Indices of coefficients.
Indices = NDArray[np.intp]
#: Least share of a column that is independent of the nuisances; with less it is unidentifiable.
MIN_INDEPENDENT_SHARE = 1e-7
#: Penalty in log-likelihood of a fitted shape, at least, and of each column beyond the first.
VALUE_PENALTY = 1.2
#: Largest ratio of the power of noise in the last to that in the second quarter of the frequencies
#: of a smoothed record before causes are fitted (jumps have 0.18, noise not less).
SMOOTHED_RATIO = 0.05


@dataclass(frozen=True, eq=False)
class RegressionProblem:
    """The logs and the noises that are tried; `SpanProblem` is the same for a log as spans."""

    replays: tuple[Replay, ...]  # the logs, with the reference rate
    # standard deviation of each coefficient by the first noise, relative to that of white noise,
    # shape (m,); residual and columns are divided by it
    deviation: Array
    band_starts: Indices  # first coefficient of each band, shape (b,)
    noise_shapes: tuple[NoiseShape, ...]  # noises that are tried
    weights: Array  # one over the variance of each band relative to the first noise, shape (g, b)
    log_determinants: Array  # of the relative variances, and of the prior probability, shape (g,)
    stated_count: int = 0  # number of the last of the noises, which a model states

    def coefficient_angles(self) -> tuple[Array, Array]:
        """Return pi k / n of each coefficient, and the interval of its log, s."""
        parts = [coefficient_angles(each.point_count) for each in self.replays]
        intervals = [each.point_interval for each in self.replays]
        return np.concatenate(parts), np.repeat(intervals, [len(part) for part in parts])

    def by_coefficient(self, of_bands: Array) -> Array:
        """Return values of bands, (..., b), for each coefficient, (..., m)."""
        count = np.diff(np.append(self.band_starts, len(self.deviation)))
        return np.repeat(of_bands, count, axis=-1)

    def split_by_log(self, coefficients: Array) -> list[Array]:
        """Return the coefficients of each log."""
        return np.split(coefficients,
                        np.cumsum([each.point_count - 1 for each in self.replays])[:-1])

    # what a search needs

    @property
    def durations(self) -> list[float]:
        """Return the length of each log, s."""
        return [each.duration for each in self.replays]

    def distorted(self, causes: Sequence[Candidate]) -> tuple[Replay, ...]:
        """Return the logs with the rate that the gyro senses, distorted by causes."""
        distortions = tuple((each.cause, each.shapes) for each in causes if each.distorts)
        return tuple(_with_distorted_rate(each, distortions) for each in self.replays)

    def base_rows(self, logs: tuple[Replay, ...]) -> Array:
        """Return what is always fitted, and last the residual, whitened, shape (q + 1, m)."""
        residual, rate = _transforms_without_causes(self.replays, logs)
        return np.array([rate, residual]) / self.deviation

    def rows(self, candidate: Candidate, logs: tuple[Replay, ...]) -> Array:
        """Return the columns of a candidate, whitened by the first noise, shape (k, m)."""
        return _transforms(replace(candidate, values=()), logs) / self.deviation

    def products(self, one: Array, other: Array) -> Array:
        """Return the products of rows under each noise, shape (g, ..., rows, of the other)."""
        edges = [*self.band_starts, one.shape[-1]]
        of_bands = np.array([one[..., begin:end] @ np.swapaxes(other[..., begin:end], -1, -2)
                             for begin, end in zip(edges, edges[1:])])
        return np.tensordot(self.weights, of_bands, 1)

    def with_noises(self, kept: list[int]) -> RegressionProblem:
        """Return the problem with some of the noises, none of which a model states."""
        return replace(self, noise_shapes=tuple(self.noise_shapes[place] for place in kept),
                       weights=self.weights[kept], log_determinants=self.log_determinants[kept],
                       stated_count=0)

    def held_out_gains(self, full: RegressionFit, rest: RegressionFit,
                       known: Candidate) -> Array | None:
        """
        Return by how much a fit predicts held-out stretches better than one without a cause.

        In log-likelihood; given the others, the cause is scaled to fit best without each stretch
        in turn. None for a single event that no other stretch shows: slips, and a step of the bias
        that a random walk soon hides. Errors of a response to a command are events of the motion.
        """
        if known.cause == 'reference_slip':
            return None
        count = max(64 // len(self.replays), 1)  # stretches of each log
        stretch = np.concatenate([run * count + np.arange(each.point_count) * count
                                  // each.point_count for run, each in enumerate(self.replays)])
        off, before = (np.concatenate(each.whitened_series(full)) for each in (full, rest))
        added = before - off
        score, information = (np.bincount(stretch, each) for each in (added * off, added ** 2))
        if (known.log_index is not None and information.max() > 0.5 * information.sum()
                and self.replays[known.log_index].command is None):
            return None
        size = 1.0 - score / np.maximum(information.sum() - information, 1e-300)
        return 0.5 * np.bincount(stretch, before ** 2 - (before - size[stretch] * added) ** 2)

    def robust_evidence(self, rest: RegressionFit, candidate: Candidate) -> tuple[float, float]:
        """
        Return an upper bound of the evidence for one more cause, and a ratio of variances.

        The bound for a single event is by the noise of its log alone, whose slow noise may be
        larger than that of the others. The ratio is of the variance by the scatter of stretches
        to that by the noise, at least 1.
        """
        if len(self.replays) == 1 or candidate.log_index is None or not is_named(candidate):
            return math.inf, 1.0
        own, left = self.replays[candidate.log_index], rest.residuals[candidate.log_index]
        alone = fit_causes(build_problem([replace(own, channels=replace(
            own.channels, output=own.reference + left))]), [])
        return (likelihood_with(alone, replace(candidate, log_index=0)) - alone.log_likelihood
                - complexity_penalty(candidate)), 1.0


def build_problem(replays: Sequence[Replay]) -> RegressionProblem:
    """Set up the regression of logs with a grid of noises, and with the white noise of each."""
    logs, rounding_ratio = tuple(replays), 0.0
    if any(each.heading_noise for each in logs):
        # the most likely variance of the noise of a heading, relative to white noise
        tried = _assemble_problem(logs, NoiseShape(), [
            NoiseShape(walk, rounding_ratio=ratio) for ratio in (0.0, *np.geomspace(1e-3, 1e4, 43))
            for walk in (0.0, 1e-4, 1e-2)])
        rounding_ratio = tried.noise_shapes[fit_causes(tried, []).best_noise].rounding_ratio
    size = min(each.point_interval for each in logs), max(each.duration for each in logs)
    shapes = noise_grid(*size, rounding_ratio)
    first = NoiseShape(rounding_ratio=rounding_ratio)
    problem = _assemble_problem(logs, first, shapes)
    if len(logs) == 1 and not logs[0].stated_noises:
        return problem
    fit = fit_causes(problem, [])
    density = float(fit.residual_squares[fit.best_noise]) / fit.degrees_of_freedom
    stated = [shape for each in logs[0].stated_noises
              for shape in stated_shapes(each, density, *size, rounding_ratio)]
    if len(logs) == 1:
        return _assemble_problem(logs, first, shapes, stated=stated)
    # most coefficients are of white noise
    white = [float(np.median((part * factor) ** 2)) for part, factor in zip(
        fit.residual_transforms(), fit.whitening_factors())]
    return _assemble_problem(logs, first, shapes, (np.array(white) / np.mean(white)).tolist(),
                             stated)


def _assemble_problem(replays: tuple[Replay, ...], first: NoiseShape,
                      shapes: Sequence[NoiseShape], white: Sequence[float] = (),
                      stated: Sequence[NoiseShape] = ()) -> RegressionProblem:
    """
    Set up the regression with a grid of noises, and with those that the model states.

    Given are the variances of white noise in each log, relative to 1.
    """
    parts = [(coefficient_angles(each.point_count), each.point_interval) for each in replays]
    more = [each - 1.0 for each in white or [1.0] * len(parts)]
    plain = np.concatenate([(first.variance(angle, step) + own) / step
                            for (angle, step), own in zip(parts, more)])
    deviation = np.sqrt(plain)
    offsets = np.cumsum([0, *(len(angle) for angle, _ in parts)])
    starts = np.concatenate([band_starts(len(angle)) + offset
                             for (angle, _), offset in zip(parts, offsets)])
    count = np.diff(np.append(starts, offsets[-1])).astype(float)
    # The mean variance of a band is computed from some of its coefficients.
    few = [np.unique(np.linspace(begin, end - 1.0, 9).round().astype(int))
           for begin, end in zip(starts, [*starts[1:], offsets[-1]])]
    angle = np.concatenate([part for part, _ in parts])
    step, own = np.repeat([[step for _, step in parts], more], np.diff(offsets), axis=1)
    chosen, first_of = np.concatenate(few), np.cumsum([0, *(len(part) for part in few)])[:-1]
    angle, step, own, plain = angle[chosen], step[chosen], own[chosen], plain[chosen]
    sums = [np.add.reduceat((shape.variance(angle, step) + own) / step / plain, first_of)
            for shape in (*shapes, *stated)]
    relative = np.array(sums) / [len(part) for part in few]
    # Each combination of components has the same prior probability, whatever its number of sizes.
    kinds = [(bool(each.walk_ratio), bool(each.markov_ratio), bool(each.flicker_corner))
             for each in shapes]
    rare = [math.log(kinds.count(kind) * len({*kinds})) for kind in kinds]
    # those that are stated together are as probable as all others
    rare += [math.log(max(len(stated), 1))] * len(stated)
    return RegressionProblem(replays, deviation, starts, (*shapes, *stated), 1.0 / relative,
                             np.log(relative) @ count + 2.0 * np.array(rare), len(stated))


@dataclass(frozen=True)
class Value:
    """A fitted value and its standard deviation."""

    value: float
    deviation: float


@dataclass(frozen=True)
class RegressionFit:
    """A regression with some causes."""

    problem: Any  # the logs and noises, as of `RegressionProblem`
    # the logs with the rate that the gyro senses, distorted by causes
    distorted: tuple[Any, ...]
    causes: tuple[Candidate, ...]  # causes
    # whitened, shape (q + 1, m): the independent columns of scale factor error, causes, and
    # derivatives with respect to their shapes; the residual less the causes of fixed amplitude
    rows: Array
    # of each column: (index of the cause; index of its value, or -1 less index of its shape); -1
    # and 0 for the scale factor error
    column_owners: tuple[tuple[int, int], ...]
    column_counts: tuple[int, ...]  # number of columns with free values of each cause
    # information, scores: of the columns under each noise, shapes (g, q, q) and (g, q)
    information: Array
    scores: Array
    residual_squares: Array  # sum of whitened squares that are left under each noise, shape (g,)
    noise_log_likelihood: Array  # restricted log likelihood of each noise, shape (g,)
    # whether single events of the gyro are fitted, but excluded from the contributions, as in a
    # model for other logs
    lasting_only: bool = False

    # the likelihood

    @property
    def columns(self) -> Array:
        """Return the whitened independent columns, shape (q, m)."""
        return self.rows[:-1]

    @property
    def degrees_of_freedom(self) -> int:
        """Return the number of coefficients less columns."""
        return self.columns.shape[1] - len(self.columns)

    @property
    def best_noise(self) -> int:
        """Return the index of the most likely noise."""
        return int(self.noise_log_likelihood.argmax())

    @property
    def noise_probability(self) -> Array:
        """Return the probability of each noise, shape (g,)."""
        return np.exp(self.noise_log_likelihood - logsumexp(self.noise_log_likelihood))

    @property
    def log_likelihood(self) -> float:
        """
        Return the logarithm of the likelihood at the best values, averaged over the noises.

        This is the restricted likelihood without its dependence on the units of the columns: see
        `column_evidence`.
        """
        best = self.best_noise
        _, logarithm = np.linalg.slogdet(self.information[best])
        return float(logsumexp(self.noise_log_likelihood) + 0.5 * (
            logarithm - len(self.columns) * np.log(self.residual_squares[best])))

    @cached_property
    def inverse_information(self) -> Array:
        """Return the inverse of the information under each noise, shape (g, q, q)."""
        return np.linalg.inv(self.information)

    @cached_property
    def estimates(self) -> tuple[Array, Array]:
        """Return the values of the independent columns and covariance, averaged over noises."""
        probable = self.noise_probability
        kept = np.flatnonzero(probable > 1e-3 * probable.max())
        weights = probable[kept] / probable[kept].sum()
        covariance = self.inverse_information[kept]
        values = np.einsum('gpq,gq->gp', covariance, self.scores[kept])
        mean = weights @ values
        variances = weights * self.residual_squares[kept] / self.degrees_of_freedom
        inside = np.einsum('g,gpq->pq', variances, covariance)
        return mean, inside + np.einsum('g,gp,gq->pq', weights, values - mean, values - mean)

    # what is left

    def residual_transforms(self) -> list[Array]:
        """Return each log's residual whitened by the first noise: shape (points - 1,)."""
        return self.problem.split_by_log(self.rows[-1] - self.estimates[0] @ self.columns)

    def whitening_factors(self) -> list[Array]:
        """Return the factors to variance 1 of each log's coefficients, by the likeliest noise."""
        best = self.best_noise
        return self.problem.split_by_log(
            self.problem.by_coefficient(np.sqrt(self.problem.weights[best]))
            * np.sqrt(self.degrees_of_freedom / self.residual_squares[best]))

    def whitened_series(self, noise_fit: RegressionFit | None = None) -> list[Array]:
        """Return each log's residual, whitened by its own or another's noise: shape (points,)."""
        factors = (noise_fit or self).whitening_factors()
        return [inverse_cosine_transform(part * factor)
                for part, factor in zip(self.residual_transforms(), factors)]

    # fitted values

    def is_included(self, cause_index: int) -> bool:
        """Tell whether a cause, by its index, is included in the contributions."""
        return not (self.lasting_only and is_single_event(self.causes[cause_index]))

    @cached_property
    def _profile_deviations(self) -> dict[tuple[int, int], float]:
        """Return standard deviations of discontinuous shapes, by cause and index."""
        return {(place, -1 - shape): _profile_deviation(self, place, shape)
                for place, known in enumerate(self.causes)
                for shape in fitted_shape_indices(known)
                if shape not in smooth_shapes(known)}

    def estimate_index(self, cause_index: int, number: int) -> int | None:
        """Return the index of a value among the estimates: column from 0, or shape below 0."""
        ranks = [*self.column_owners, *self._profile_deviations]
        return ranks.index((cause_index, number)) if (cause_index, number) in ranks else None

    @property
    def covariance(self) -> Array:
        """Return the covariance of all estimates, discontinuous shapes last."""
        return np.asarray(block_diag(self.estimates[1],
                                     np.diag(np.square(list(self._profile_deviations.values())))))

    def _column_value(self, cause_index: int, number: int) -> Value:
        if (cause_index, number) not in self.column_owners:
            return Value(0.0, self._profile_deviations.get((cause_index, number), 0.0)
                         if number < 0 else 0.0)
        place = self.column_owners.index((cause_index, number))
        return Value(float(self.estimates[0][place]),
                     float(np.sqrt(max(self.estimates[1][place, place], 0.0))))

    @property
    def scale_factor_error(self) -> Value:
        """Return the scale factor error relative to the simulation, 1."""
        return self._column_value(-1, 0)

    def coefficients(self, cause_index: int) -> tuple[Array, Array]:
        """Return the values of the columns of a cause, and covariance; 0 for those left out."""
        owners = [(cause_index, number) for number in range(self.column_counts[cause_index])]
        ranks = np.array([self.column_owners.index(each) if each in self.column_owners else -1
                          for each in owners], dtype=np.intp)
        values, covariance = self.estimates
        return np.append(values, 0.0)[ranks], np.pad(covariance, (0, 1))[np.ix_(ranks, ranks)]

    def shapes(self, cause_index: int) -> dict[str, Estimate]:
        """Return the fitted shapes of a named cause, by their names."""
        known, found = self.causes[cause_index], {}
        effect = CATALOGUE.get(known.cause)
        names = ([('width', 's')] if effect is None else
                 [(shape.name, shape.unit) for shape in effect.nonlinear_parameters])
        for place in fitted_shape_indices(known):
            name, unit = names[place]
            found[name] = Estimate.from_half_width(
                known.shapes[place], NORMAL_QUANTILE_975 * self._column_value(
                    cause_index, -1 - place).deviation, unit)
        return found

    # contributions to the output

    def contributions(self, replay: Replay, log_index: int) -> dict[str, Array]:
        """Return the contributions of scale, causes and reference to a log, rad/s, (n,)."""
        found: dict[str, Array] = {}
        new = replay
        for known in self.causes:
            if known.distorts:
                before, new = new, _with_distorted_rate(new, ((known.cause, known.shapes),))
                found[known.cause] = new.channels.rate - before.channels.rate
        found['scale_factor_error'] = self.scale_factor_error.value * new.channels.rate
        for place, known in enumerate(self.causes):
            if (known.distorts or known.log_index not in (None, log_index)
                    or not self.is_included(place)):
                continue
            values = ([known.amplitude] if known.amplitude is not None
                      else self.coefficients(place)[0].tolist())
            for value, column in zip(values, known.columns(new)):
                found[known.cause] = found.get(known.cause, 0.0) + value * column
        if replay.command is not None or len(replay.shared_errors):
            fitted = self.problem.replays[log_index]
            # errors by quantization are several; one alone is that of a lag
            name = ('quantization' if replay.command is None and len(replay.shared_errors) > 1
                    else 'reference')
            found[name] = fitted.response(
                replay.channels.output - replay.reference - np.asarray(sum(found.values())))
        return found

    def total_contribution(self, replay: Replay, log_index: int) -> Array:
        """Return the sum of the contributions of scale and causes to the output of a log."""
        return np.asarray(sum(self.contributions(replay, log_index).values()))

    @cached_property
    def residuals(self) -> list[Array]:
        """Return the residual of each log, with its bias, rad/s, shape (n,)."""
        return [each.channels.output - each.reference - self.total_contribution(each, run)
                for run, each in enumerate(self.problem.replays)]

    @cached_property
    def biases(self) -> list[float]:
        """Return the bias of each log less the simulation's, rad/s."""
        return [float(left[each.valid].mean())
                for each, left in zip(self.problem.replays, self.residuals)]

    @property
    def unbiased_residuals(self) -> list[Array]:
        """Return the residual of each log without its bias, rad/s, shape (n,)."""
        return [left - bias for left, bias in zip(self.residuals, self.biases)]

    @property
    def bias_variance(self) -> float:
        """Return the variance of the mean bias by the uncertainty of other values, (rad/s)²."""
        means = np.zeros(len(self.columns))
        for rank, (place, number) in enumerate(self.column_owners):
            if place < 0:
                parts = [each.channels.rate for each in self.distorted]
            elif number >= 0 and self.is_included(place):
                parts = [self.causes[place].columns(each)[number]
                         for each in self.distorted]
            else:
                continue
            means[rank] = np.mean([(part - each.response(part))[each.valid].mean()
                                   for part, each in zip(parts, self.distorted)])
        shared = [each.shared_bias_variance for each in self.problem.replays]
        return float(means @ self.estimates[1] @ means + np.mean(shared) / len(shared))


def is_single_event(cause: Candidate) -> bool:
    """Tell whether a cause is an effect of the gyro in one log alone: a step or a tone."""
    return cause.log_index is not None and cause.cause in CATALOGUE


# columns, which many fits need

@lru_cache(maxsize=16)
def _with_distorted_rate(replay: Replay,
                         distortions: tuple[tuple[str, tuple[float, ...]], ...]) -> Replay:
    """Return a log with the rate that the gyro senses, distorted by causes with their shapes."""
    if not distortions:
        return replay
    before, (name, shapes) = _with_distorted_rate(replay, distortions[:-1]), distortions[-1]
    distortion = CATALOGUE[name].distortion
    assert distortion is not None
    return before.with_rate(distortion(before.channels.rate, before.channels.time, *shapes))


@lru_cache(maxsize=64)
def columns_of(candidate: Candidate, log: Any) -> Array:
    """Return the columns of a candidate without values, shape (columns, n)."""
    return np.array(candidate.columns(log))


@lru_cache(maxsize=32)
def _transforms(candidate: Candidate, replays: tuple[Replay, ...]) -> Array:
    """Return the cosine transforms of a candidate's columns over all logs, shape (columns, m)."""
    return np.concatenate([
        np.array([each.transform_samples(value) if candidate.log_index in (None, run)
                  else np.zeros(each.point_count - 1) for value in candidate.columns(each)])
        for run, each in enumerate(replays)], axis=1)


@lru_cache(maxsize=16)
def _transforms_without_causes(replays: tuple[Replay, ...],
                               distorted: tuple[Replay, ...]) -> tuple[Array, Array]:
    """Return the transforms of the residual and of the rate over all logs, each shape (m,)."""
    return (np.concatenate([
        each.transform_residual(
            each.channels.output - each.reference - (new.channels.rate - each.channels.rate))
        for each, new in zip(replays, distorted)]),
        np.concatenate([each.transform_samples(each.channels.rate) for each in distorted]))


def forget_fits() -> None:
    """Release the logs and columns that fits keep for the next ones."""
    for kept in (_with_distorted_rate, columns_of, _transforms, _transforms_without_causes,
                 _shape_derivative, _fit_causes):
        kept.cache_clear()


# fits

def fit_causes(problem: Any, causes: Sequence[Candidate]) -> RegressionFit:
    """Fit causes to logs, and the shapes of those that have values to first order."""
    return _fit_causes(problem, tuple(causes))


@lru_cache(maxsize=16)
def _fit_causes(problem: Any, causes: tuple[Candidate, ...]) -> RegressionFit:
    distorted = problem.distorted(causes)
    *base, residual = problem.base_rows(distorted)
    columns, owners, widths = [np.array(base)], [(-1, place) for place in range(len(base))], []
    for place, known in enumerate(causes):
        logs = problem.distorted(()) if known.distorts else distorted
        own = (problem.rows(known, logs) if known.values or not known.distorts
               else columns[0][:0])
        widths.append(len(own) if known.amplitude is None else 0)
        if known.amplitude is None:
            columns.append(own)
            owners += [(place, number) for number in range(len(own))]
        elif not known.distorts:
            residual = residual - known.amplitude * own[0]
        for shape in smooth_shapes(known) if known.values else ():
            columns.append(_shape_derivative(problem, known, shape, logs)[None])
            owners.append((place, -1 - shape))
    rows = np.concatenate([*columns, residual[None]])
    sums = problem.products(rows, rows)
    kept = [*_independent_columns((rows @ rows.T)[:-1, :-1]), len(rows) - 1]
    rows = rows if len(kept) == len(rows) else rows[kept]
    sums = sums[:, kept][:, :, kept[:-1]]
    information, scores = sums[:, :-1], sums[:, -1]
    # of what the values for one noise leave, as the difference of the whole sums is rounded
    left = np.append(-np.linalg.solve(information[0], scores[0]), 1.0) @ rows
    pull, squares = (problem.products(each, left[None]) for each in (rows[:-1], left[None]))
    squares = squares[:, 0, 0] - (pull * np.linalg.solve(information, pull)).sum(axis=(1, 2))
    determinants = problem.log_determinants + np.linalg.slogdet(information)[1]
    likelihood = -0.5 * ((len(left) - len(rows) + 1) * np.log(squares) + determinants)
    return RegressionFit(problem, distorted, causes, rows,
                         tuple(owners[place] for place in kept[:-1]), tuple(widths),
                         information, scores, squares, likelihood)


@lru_cache(maxsize=32)
def _shape_derivative(problem: Any, cause: Candidate, shape_index: int,
                      logs: tuple[Any, ...]) -> Array:
    """Return the derivative of a cause's contribution with respect to a shape, shape (m,)."""
    shape = cause.shapes[shape_index]
    # so small that the phase of a wave changes little up to the end of a log
    step = 1e-7 * (abs(shape) or 1.0)
    moved = with_shape(cause, shape_index, shape + step)
    if moved.shapes[shape_index] == shape:  # at its upper bound
        moved = with_shape(cause, shape_index, shape - step)
    change = np.tensordot(cause.values, problem.rows(moved, logs) - problem.rows(cause, logs), 1)
    return np.asarray(change / (moved.shapes[shape_index] - shape))


def _independent_columns(product: Array) -> list[int]:
    """Return the columns that are linearly independent of those before, by their products."""
    length = np.sqrt(np.diag(product))

    def are_independent(places: list[int]) -> bool:
        # the least eigenvalue is at most the share of any column that is independent of the others
        own = product[np.ix_(places, places)] / np.outer(length[places], length[places])
        return bool(np.linalg.eigvalsh(own)[0] > 1e-9)

    kept: list[int] = []
    every = np.flatnonzero(length > 0.0).tolist()
    if not every or are_independent(every):
        return every
    for place in every:
        if are_independent([*kept, place]):
            kept.append(place)
    return kept


# evidence

@dataclass(frozen=True)
class ColumnGroups:
    """Groups of columns of candidates."""

    columns: Array  # whitened, shape (p, m)
    groups: Sequence[Sequence[int]]  # the columns of each group
    # of all groups of one width: their places, shape (n,), their columns, shape (n, width), and
    # the products of these under each noise, shape (g, n, width, width)
    of_width: list[tuple[Indices, Indices, Array]]


def group_columns(problem: Any, columns: Array,
                  groups: Sequence[Sequence[int]]) -> ColumnGroups:
    """Return groups of whitened columns, shape (p, m)."""
    of_width = []
    for width in sorted({len(group) for group in groups}):
        places = np.array([place for place, group in enumerate(groups) if len(group) == width])
        members = np.array([groups[place] for place in places])
        parts = np.array_split(members, math.ceil(len(members) / 32))  # for the memory
        of_width.append((places, members, np.concatenate(
            [problem.products(columns[part], columns[part]) for part in parts], axis=1)))
    return ColumnGroups(columns, groups, of_width)


def column_evidence(fit: RegressionFit, groups: ColumnGroups) -> Array:
    """Return the evidence of groups of columns given a fit, -inf if unidentifiable."""
    # products, under each noise, of what the fit leaves of the columns, with the residual
    crossing = fit.problem.products(groups.columns, fit.rows)
    crossing, pull = crossing[:, :, :-1], crossing[:, :, -1]
    towards = crossing @ fit.inverse_information
    pull = pull - np.einsum('gpq,gq->gp', towards, fit.scores)
    squares, likelihood = fit.residual_squares[:, None], fit.noise_log_likelihood[:, None]
    found = np.full(len(groups.groups), -np.inf)
    for places, members, whole in groups.of_width:
        width = members.shape[1]
        left = whole - crossing[:, members] @ np.swapaxes(towards[:, members], -1, -2)
        of_left, of_whole = (np.einsum('gnpp->gnp', each) for each in (left, whole))
        shown = (of_left > MIN_INDEPENDENT_SHARE * of_whole).all(axis=(0, 2))
        # columns that depend on each other count as one
        products = left[:, shown] * (1.0 + 1e-10 * np.eye(width) * (width > 1))
        pulls = pull[:, members[shown]]
        explained = np.einsum('gnp,gnp->gn', pulls,
                              np.linalg.solve(products, pulls[..., None])[..., 0])
        ratio = np.log1p(-np.minimum(explained / squares, 1.0 - 1e-9))
        scale = 0.5 * (width * np.log(squares) - np.linalg.slogdet(products)[1])
        change = scale - 0.5 * (fit.degrees_of_freedom - width) * ratio
        found[places[shown]] = (logsumexp(likelihood + change, axis=0) - logsumexp(likelihood)
                                - scale[fit.best_noise])
    return found


def complexity_penalty(cause: Candidate) -> float:
    """Return the penalty of shapes and columns of a cause, in log-likelihood."""
    shapes = max(cause.penalty, VALUE_PENALTY * len(fitted_shape_indices(cause)))
    return shapes + VALUE_PENALTY * max(len(cause.values) - 1, 0)


def likelihood_with(fit: RegressionFit, candidate: Candidate) -> float:
    """Return the log-likelihood of a fit with one more cause, whose shapes are fixed."""
    return fit_causes(fit.problem, [*fit.causes, candidate]).log_likelihood


# deviations of discontinuous shapes

def _profile_deviation(fit: RegressionFit, cause_index: int, shape_index: int) -> float:
    """Return the standard deviation of a shape by the profile of the likelihood, to 1 %."""
    candidate, problem = fit.causes[cause_index], fit.problem
    rest = fit_causes(problem, fit.causes[:cause_index] + fit.causes[cause_index + 1:])

    def moved(by: float) -> Candidate:
        return with_shape(candidate, shape_index, candidate.shapes[shape_index] + by)

    half_range = candidate.half_width
    while half_range:  # a time: by all times that are about as likely
        shifts = np.linspace(-half_range, half_range, 2 * MAX_STEP_TIMES + 1)
        columns = np.concatenate([problem.rows(moved(by), rest.distorted)
                                  for by in shifts.tolist()])
        evidence = column_evidence(rest, group_columns(
            problem, columns, np.arange(len(shifts))[:, None].tolist()))
        likely = evidence >= evidence[len(shifts) // 2] - MAX_STEP_TIME_LACK
        largest = float(np.abs(shifts[likely]).max() + shifts[1] - shifts[0])
        if largest < half_range or half_range > max(problem.durations):
            return largest / NORMAL_QUANTILE_975
        half_range *= 2.0
    least = likelihood_with(rest, moved(0.0)) - 0.5 * NORMAL_QUANTILE_975 ** 2
    first, ends = 1e-3 * candidate.shapes[shape_index], []
    for end in (first, -first):
        while (excess := likelihood_with(rest, moved(end)) - least) >= 0.0 and (
                abs(end) < 1e6 * abs(first)):
            end *= 2.0
        ends.append(abs(end) if excess >= 0.0 else abs(bisect(
            lambda by: likelihood_with(rest, moved(by)) - least, 0.0, end, rtol=0.01)))
    return max(ends) / NORMAL_QUANTILE_975


# filtered noise

def average_filtered_noise(fit: RegressionFit,
                           max_ratio: float = 0.7) -> RegressionFit:
    """
    Average neighbouring points of logs whose noise is filtered, until no filter shows.

    A gyro with averaged samples, or a smoothed reference, has little noise at the highest
    frequencies, so that small errors of motion and reference would have too much weight there. It
    shows in the residual of the causes, as motion that is delayed or filtered would pass for
    noise.
    """
    while True:
        decimations = []
        for each, whitened in zip(fit.problem.replays, fit.residual_transforms()):
            _, second, _, last = (float(np.median(part ** 2))
                                  for part in np.array_split(whitened, 4))
            # 4.5 standard deviations; that of the logarithm of a median of n is 2.33 over root n
            by_chance = np.exp(-4.5 * 2.33 * np.sqrt(8.0 / len(whitened)))
            is_filtered = (last < min(by_chance, max_ratio) * second
                           and 2.0 * each.point_interval <= 0.25)  # s
            decimations.append(each.decimation * (1 + is_filtered))
        if decimations == [each.decimation for each in fit.problem.replays]:
            return fit
        fit = fit_causes(build_problem([
            replace(each, decimation=decimation)
            for each, decimation in zip(fit.problem.replays, decimations)]), fit.causes)
