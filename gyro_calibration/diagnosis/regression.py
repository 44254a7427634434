# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Regression of logs on causes: whitened residual and columns, noises, and fitted values."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from gyro_calibration.diagnosis.candidates import (
    Candidate,
    candidate_transforms,
    fitted_shape_indices,
    with_shape,
)
from gyro_calibration.diagnosis.noise_likelihood import (
    Indices,
    log_sum_exp,
    marginalize_nuisances,
    Marginalized,
    noise_likelihood,
    NoiseHypotheses,
    NoiseLikelihood,
)
from gyro_calibration.diagnosis.replay import (
    band_starts,
    coefficient_angles,
    high_frequency_power_ratio,
    inverse_cosine_transform,
    noise_grid,
    NoiseShape,
    relative_part_powers,
    Replay,
    SMOOTHED_POWER_RATIO,
)
from gyro_calibration.logs.log import Array, NORMAL_QUANTILE_975
from gyro_calibration.model.effects import CATALOGUE
import numpy as np
from scipy.linalg import block_diag

#: Longest averaging interval of a smoothed residual, s; and number of iterations of the levels of
#: its noise, each with the most likely noise of the levels before.
_MAX_AVERAGING_TIME, _LEVEL_ITERATIONS = 0.1, 3
#: Relative step of a shape for the derivative of its columns.
_RELATIVE_SHAPE_STEP = 1e-4
#: Drop of the log-likelihood at the ends of a 95 % interval.
_LIKELIHOOD_DROP_95 = 1.92


@dataclass(frozen=True)
class SelectedCause:
    """
    A selected cause.

    Attributes
    ----------
    candidate : the cause with its shapes
    values : coefficients of its columns; empty before a fit, and its shapes are then fixed
    penalty : penalty for the choice of its first shapes, in log-likelihood

    """

    candidate: Candidate
    values: tuple[float, ...] = ()
    penalty: float = 0.0


@dataclass(frozen=True)
class RegressionProblem:
    """
    The logs and the noises that are tried.

    Attributes
    ----------
    replays : the logs
    reference_noise : the noise by which residual and columns are whitened first
    deviation : standard deviation of each coefficient by it, with the levels of the logs, relative
        to that of white noise, shape (m,)
    band_starts : first coefficient of each band
    noise_shapes : noises that are tried
    noises : the same, as weights of the bands

    """

    replays: tuple[Replay, ...]
    reference_noise: NoiseShape
    deviation: Array
    band_starts: Indices
    noise_shapes: tuple[NoiseShape, ...]
    noises: NoiseHypotheses

    def coefficient_angles(self) -> tuple[Array, Array]:
        """Return pi k / n of each coefficient, and the interval of its log, s."""
        parts = [coefficient_angles(each.point_count) for each in self.replays]
        intervals = [each.point_interval for each in self.replays]
        return np.concatenate(parts), np.repeat(intervals, [len(part) for part in parts])

    def whitening_factors(self, noise_index: int) -> Array:
        """Return the factors that whiten coefficients whitened by the first noise, shape (m,)."""
        count = np.diff(np.append(self.band_starts, len(self.deviation)))
        return np.repeat(np.sqrt(self.noises.weights[noise_index]), count)


def build_problem(replays: Sequence[Replay]) -> RegressionProblem:
    """Set up the regression of logs with a grid of noises."""
    rounding_ratio = (
        _estimate_rounding_ratio(replays) if any(each.heading_step for each in replays) else 0.0)
    return _assemble_problem(tuple(replays), NoiseShape(rounding_ratio=rounding_ratio),
                             noise_grid(min(each.point_interval for each in replays),
                                        max(each.duration for each in replays), rounding_ratio))


def _estimate_rounding_ratio(replays: Sequence[Replay]) -> float:
    """Return the most likely variance of the rounding of a heading, relative to white noise."""
    shapes = [NoiseShape(rounding_ratio=ratio) for ratio in (0.0, *np.geomspace(1e-3, 1e4, 43))]
    tried = _assemble_problem(
        tuple(replays), NoiseShape(),
        [replace(shape, walk_ratio=walk) for shape in shapes for walk in (0.0, 1e-4, 1e-2)])
    done = fit_causes(tried, [])
    return tried.noise_shapes[int(done.noise_likelihood.log_likelihood[0].argmax())].rounding_ratio


def _assemble_problem(replays: tuple[Replay, ...], first: NoiseShape,
                      shapes: Sequence[NoiseShape]) -> RegressionProblem:
    parts = [(coefficient_angles(each.point_count), each.point_interval) for each in replays]
    plain = np.concatenate([first.variance(angle, step) / step for angle, step in parts])
    deviation = np.sqrt(plain * np.concatenate([each.noise_level() for each in replays]))
    offsets = np.cumsum([0, *(len(angle) for angle, _ in parts)])
    starts = np.concatenate([band_starts(angle, step) + offset
                             for (angle, step), offset in zip(parts, offsets)])
    count = np.diff(np.append(starts, offsets[-1])).astype(float)
    # The mean variance of a band is computed from some of its coefficients.
    few = [np.unique(np.linspace(begin, end - 1.0, 9).round().astype(int))
           for begin, end in zip(starts, [*starts[1:], offsets[-1]])]
    angle = np.concatenate([part for part, _ in parts])
    step = np.concatenate([np.full(len(part), step) for part, step in parts])
    chosen, first_of = np.concatenate(few), np.cumsum([0, *(len(part) for part in few)])[:-1]
    angle, step, plain = angle[chosen], step[chosen], plain[chosen]
    sums = [np.add.reduceat(shape.variance(angle, step) / step / plain, first_of)
            for shape in shapes]
    relative = np.array(sums) / [len(part) for part in few]
    # Each combination of components has the same prior probability, whatever its number of sizes.
    kinds = [(bool(each.walk_ratio), bool(each.markov_ratio), bool(each.flicker_corner))
             for each in shapes]
    rare = [np.log(kinds.count(kind)) for kind in kinds]
    noises = NoiseHypotheses(1.0 / relative, np.log(relative) @ count + 2.0 * np.array(rare))
    return RegressionProblem(replays, first, deviation, starts, tuple(shapes), noises)


@dataclass(frozen=True)
class RegressionFit:
    """
    A regression with some causes.

    Attributes
    ----------
    problem : the logs with the rate that the gyro senses, distorted by causes
    original_replays : the logs with the reference rate
    causes : causes
    residual : whitened, less the columns of causes of fixed amplitude, shape (m,)
    columns : whitened and independent: scale factor error, those of the causes, and derivatives
        with respect to their shapes, shape (q, m)
    column_owners : of each column: (index of the cause, or -1 for the scale factor error, or -2;
        index of its value, or -1 less index of its shape)
    column_counts : number of columns with free values of each cause
    marginalized, noise_likelihood : see `noise_likelihood`

    """

    problem: RegressionProblem
    original_replays: tuple[Replay, ...]
    causes: tuple[SelectedCause, ...]
    residual: Array
    columns: Array
    column_owners: tuple[tuple[int, int], ...]
    column_counts: tuple[int, ...]
    marginalized: Marginalized
    noise_likelihood: NoiseLikelihood

    @property
    def log_likelihood(self) -> float:
        """
        Return the logarithm of the likelihood at the best values, averaged over the noises.

        This is the restricted likelihood without its dependence on the units of the columns: see
        `column_evidence`.

        """
        by_noise = self.noise_likelihood
        best = int(self.noise_likelihood.log_likelihood[0].argmax())
        _, logarithm = np.linalg.slogdet(self.marginalized.nuisance_information[best])
        return float(log_sum_exp(by_noise.log_likelihood)[0] + 0.5 * (
            logarithm - len(self.columns) * np.log(by_noise.residual_squares[0, best])))

    def whitened_series(self, noise_fit: RegressionFit | None = None) -> list[Array]:
        """Return the residual of each log, whitened in time to variance 1: shape (points,)."""
        return [inverse_cosine_transform(part) for part in self.whitened_transforms(noise_fit)]

    def whitened_transforms(self, noise_fit: RegressionFit | None = None) -> list[Array]:
        """Return each log's whitened residual, by its own or another's noise: (points - 1,)."""
        of = noise_fit or self
        best = int(of.noise_likelihood.log_likelihood[0].argmax())
        factor = of.problem.whitening_factors(best) * np.sqrt(
            of.marginalized.degrees_of_freedom / of.noise_likelihood.residual_squares[0, best])
        return [part * own
                for part, own in zip(self.residual_transforms(), self._split_by_log(factor))]

    def residual_transforms(self) -> list[Array]:
        """Return each log's residual whitened by the first noise: shape (points - 1,)."""
        values, _ = self.estimates
        return self._split_by_log(self.residual - values @ self.columns)

    def _split_by_log(self, coefficients: Array) -> list[Array]:
        return np.split(coefficients,
                        np.cumsum([each.point_count - 1 for each in self.problem.replays])[:-1])

    @property
    def estimates(self) -> tuple[Array, Array]:
        """Return the values of the independent columns and covariance, averaged over noises."""
        probable = self.noise_likelihood.probability[0]
        kept = np.flatnonzero(probable > 1e-3 * probable.max())
        weights = probable[kept] / probable[kept].sum()
        covariance = np.linalg.inv(self.marginalized.nuisance_information[kept])
        values = np.einsum('gpq,gq->gp', covariance,
                           self.noise_likelihood.nuisance_scores[0, kept])
        mean = weights @ values
        variances = (weights * self.noise_likelihood.residual_squares[0, kept]
                     / self.marginalized.degrees_of_freedom)
        inside = np.einsum('g,gpq->pq', variances, covariance)
        return mean, inside + np.einsum('g,gp,gq->pq', weights, values - mean, values - mean)


def is_rate_distortion(name: str) -> bool:
    """Tell whether a cause distorts the rate before errors are added to it."""
    return name in CATALOGUE and CATALOGUE[name].stage == 'rate'


def with_distorted_rate(replay: Replay, causes: Sequence[SelectedCause]) -> Replay:
    """Return a log with the rate that the gyro senses, distorted by causes."""
    rate, time = replay.channels.rate, replay.channels.time
    for known in causes:
        if is_rate_distortion(known.candidate.cause):
            distortion = CATALOGUE[known.candidate.cause].distortion
            assert distortion is not None
            rate = distortion(rate, time, *known.candidate.shapes)
    return replay.with_rate(rate)


def fit_causes(problem: RegressionProblem, causes: Sequence[SelectedCause],
               nuisance_candidates: Sequence[Candidate] = ()) -> RegressionFit:
    """
    Fit causes to logs.

    Parameters
    ----------
    problem : the logs with the reference rate
    causes : causes with their shapes and values
    nuisance_candidates : candidates whose columns are nuisances too

    """
    replays = [with_distorted_rate(each, causes) for each in problem.replays]
    widths = []
    residual = np.concatenate([
        each.transform_residual(
            each.channels.output - each.reference - (new.channels.rate - each.channels.rate))
        for each, new in zip(problem.replays, replays)])
    columns, owner = [np.concatenate([each.transform_samples(each.channels.rate)
                                      for each in replays])[None]], [(-1, 0)]
    for place, known in enumerate(causes):
        own = candidate_transforms(
            known.candidate,
            replays if not is_rate_distortion(known.candidate.cause) else problem.replays)
        widths.append(len(own) if known.candidate.amplitude is None else 0)
        if known.candidate.amplitude is None:
            columns.append(own)
            owner += [(place, number) for number in range(len(own))]
        elif not is_rate_distortion(known.candidate.cause):
            residual = residual - known.candidate.amplitude * own[0]
        changes = _shape_derivatives(
            known, problem.replays if is_rate_distortion(known.candidate.cause) else replays,
            own) if known.values else []
        columns += [change[None] for _, change in changes]
        owner += [(place, -1 - number) for number, _ in changes]
    for candidate in nuisance_candidates:
        own = candidate_transforms(candidate, replays)
        columns.append(own)
        owner += [(-2, 0)] * len(own)
    return _fit_columns(replace(problem, replays=tuple(replays)), problem.replays, tuple(causes),
                        residual / problem.deviation, np.concatenate(columns) / problem.deviation,
                        tuple(owner), tuple(widths))


def _shape_derivatives(cause: SelectedCause, replays: Sequence[Replay],
                       columns: Array) -> list[tuple[int, Array]]:
    """Return the derivative of a cause's contribution to each smooth, fitted shape."""
    found: list[tuple[int, Array]] = []
    for place in smooth_shapes(cause.candidate):
        moved = _perturb_shape(cause.candidate, place, max(each.duration for each in replays))
        change = np.tensordot(cause.values, candidate_transforms(moved, replays) - columns, 1)
        found.append((place, change / (moved.shapes[place] - cause.candidate.shapes[place])))
    return found


def _perturb_shape(candidate: Candidate, shape_index: int, duration: float) -> Candidate:
    """Return a cause with a small change of a shape, within its bounds."""
    shape = candidate.shapes[shape_index]
    # The phase of a wave must change little up to the end of the log.
    step = (1e-3 / duration if candidate.cause == 'interference_tone'
            else _RELATIVE_SHAPE_STEP * abs(shape) if shape else 1e-6)
    moved = with_shape(candidate, shape_index, shape + step)
    return (with_shape(candidate, shape_index, shape - step) if moved.shapes[shape_index] == shape
            else moved)


def smooth_shapes(candidate: Candidate) -> list[int]:
    """Return the indices of fitted shapes on which the columns depend smoothly."""
    return [] if candidate.cause in ('bias_step', 'dead_zone') else fitted_shape_indices(candidate)


def discontinuous_shapes(candidate: Candidate) -> list[int]:
    """Return the indices of fitted shapes on which the columns do not depend smoothly."""
    return [place
            for place in fitted_shape_indices(candidate) if place not in smooth_shapes(candidate)]


def profile_deviation(fit: RegressionFit, cause_index: int, shape_index: int) -> float:
    """Return the standard deviation of a shape by the profile of the likelihood."""
    candidate = fit.causes[cause_index].candidate
    others = fit_causes(replace(fit.problem, replays=fit.original_replays),
                        fit.causes[:cause_index] + fit.causes[cause_index + 1:])
    least = add_cause(others, candidate).log_likelihood - _LIKELIHOOD_DROP_95

    def is_below_threshold(by: float) -> bool:
        return add_cause(others, with_shape(
            candidate, shape_index, candidate.shapes[shape_index] + by)).log_likelihood < least

    first = (fit.original_replays[0].point_interval if candidate.cause == 'bias_step'
             else 1e-3 * candidate.shapes[shape_index])
    return (max(_find_first_true(is_below_threshold, first),
                _find_first_true(is_below_threshold, -first)) / NORMAL_QUANTILE_975)


def _find_first_true(predicate: Callable[[float], bool], first: float) -> float:
    """Return the distance at which a predicate is first true, to 1 %, by doubling and halving."""
    near, far = 0.0, first
    while not predicate(far) and abs(far) < 1e6 * abs(first):
        near, far = far, 2.0 * far
    for _ in range(7):
        middle = 0.5 * (near + far)
        near, far = (near, middle) if predicate(middle) else (middle, far)
    return abs(far)


def estimate_noise_levels(fit: RegressionFit) -> tuple[Replay, ...]:
    """
    Return the logs with the levels of filtered noise, averaged where hardly any noise is left.

    The levels are those of the residual of the causes. Before the causes are fitted, motion that
    is delayed or filtered would pass for noise.

    """
    is_filtered = [high_frequency_power_ratio(part) < 1.0 for part in fit.whitened_transforms()]
    while any(needs_averaging := [
            high_frequency_power_ratio(part) < SMOOTHED_POWER_RATIO
            and 2.0 * each.point_interval <= _MAX_AVERAGING_TIME
            for each, part in zip(fit.original_replays, fit.whitened_transforms())]):
        fit = _refit(fit, [replace(each, decimation=each.decimation * (1 + more))
                           for each, more in zip(fit.original_replays, needs_averaging)])
    for number in range(_LEVEL_ITERATIONS if any(is_filtered) else 0):
        # First by the residual that is not whitened, or slow noise would compensate the filter.
        of = zip(fit.original_replays,
                 fit.whitened_transforms() if number else fit.residual_transforms(), is_filtered)
        fit = _refit(fit, [each.with_scaled_noise_levels(relative_part_powers(part)) if falls
                           else each for each, part, falls in of])
    return fit.original_replays


def _refit(fit: RegressionFit, replays: Sequence[Replay]) -> RegressionFit:
    """Fit the same causes to the logs with other points or levels."""
    return fit_causes(build_problem(replays), fit.causes)


def add_cause(fit: RegressionFit, candidate: Candidate) -> RegressionFit:
    """Add a cause to a fit at its present shapes, and keep the other columns."""
    if is_rate_distortion(candidate.cause):
        return fit_causes(replace(fit.problem, replays=fit.original_replays),
                          [*fit.causes, SelectedCause(candidate)])
    own = candidate_transforms(candidate, fit.problem.replays) / fit.problem.deviation
    residual, columns = fit.residual, fit.columns
    owner, place = fit.column_owners, len(fit.causes)
    if candidate.amplitude is None:
        columns = np.concatenate([columns, own])
        owner = (*owner, *((place, number) for number in range(len(own))))
    else:
        residual = residual - candidate.amplitude * own[0]
    widths = (*fit.column_counts, len(own) if candidate.amplitude is None else 0)
    return _fit_columns(fit.problem, fit.original_replays, (*fit.causes, SelectedCause(candidate)),
                        residual, columns, owner, widths)


def add_nuisance_columns(fit: RegressionFit, columns: Array) -> RegressionFit:
    """Add whitened columns to a fit that belong to no cause."""
    owner = (*fit.column_owners, *[(-2, 0)] * len(columns))
    return _fit_columns(fit.problem, fit.original_replays, fit.causes, fit.residual,
                        np.concatenate([fit.columns, columns]), owner, fit.column_counts)


def _fit_columns(problem: RegressionProblem, original_replays: tuple[Replay, ...],
                 causes: tuple[SelectedCause, ...], residual: Array, columns: Array,
                 column_owners: tuple[tuple[int, int], ...],
                 column_counts: tuple[int, ...]) -> RegressionFit:
    """Return the fit of a whitened residual to independent columns under each noise."""
    kept = _independent_columns(columns)
    of, nothing = columns[kept], np.empty((0, len(residual)))
    by = marginalize_nuisances(of, nothing, (), problem.band_starts, problem.noises)
    return RegressionFit(
        problem, original_replays, causes, residual, of,
        tuple(column_owners[place] for place in kept), column_counts, by,
        noise_likelihood(residual[None], of, nothing, problem.band_starts, problem.noises, by))


def _independent_columns(columns: Array) -> list[int]:
    """Return the columns that are linearly independent of those before them."""
    product = columns @ columns.T
    length = np.sqrt(np.diag(product))
    kept: list[int] = []
    for place in np.flatnonzero(length > 0.0).tolist():
        own = product[np.ix_(kept, kept)] / np.outer(length[kept], length[kept])
        towards = product[kept, place] / (length[kept] * length[place])
        if 1.0 - (towards @ np.linalg.solve(own, towards) if kept else 0.0) > 1e-9:
            kept.append(place)
    return kept


@dataclass(frozen=True)
class Value:
    """A fitted value and its standard deviation."""

    value: float
    deviation: float


@dataclass(frozen=True)
class FittedValues:
    """
    The values of a fit.

    Attributes
    ----------
    fit : the fit
    replays : the logs
    lasting_only : whether single events of the gyro are fitted, but excluded from the
        contributions, as in a model for other logs

    """

    fit: RegressionFit
    replays: tuple[Replay, ...]
    lasting_only: bool = False

    @property
    def causes(self) -> tuple[SelectedCause, ...]:
        """Return the causes."""
        return self.fit.causes

    def is_included(self, cause_index: int) -> bool:
        """Tell whether a cause, by its index, is included in the contributions."""
        return not (self.lasting_only and is_single_event(self.causes[cause_index]))

    @cached_property
    def _estimates(self) -> tuple[dict[tuple[int, int], int], Array, Array]:
        values, covariance = self.fit.estimates
        return ({owner: rank for rank, owner in enumerate(self.fit.column_owners)}, values,
                covariance)

    @cached_property
    def _profile_deviations(self) -> dict[tuple[int, int], float]:
        """Return standard deviations of discontinuous shapes, by cause and index."""
        return {(place, -1 - shape): profile_deviation(self.fit, place, shape)
                for place, known in enumerate(self.causes)
                for shape in discontinuous_shapes(known.candidate)}

    def estimate_index(self, cause_index: int, number: int) -> int | None:
        """Return the index of a value among the estimates: column from 0, or shape below 0."""
        ranks = [*self.fit.column_owners, *self._profile_deviations]
        return ranks.index((cause_index, number)) if (cause_index, number) in ranks else None

    @property
    def covariance(self) -> Array:
        """Return the covariance of all estimates."""
        return np.asarray(block_diag(self._estimates[2],
                                     np.diag(np.square(list(self._profile_deviations.values())))))

    def _estimated_value(self, cause_index: int, number: int, known: float | None = None) -> Value:
        ranks, values, covariance = self._estimates
        place = ranks.get((cause_index, number))
        if place is None:
            return (Value(0.0, 0.0) if known is None
                    else Value(known, self._profile_deviations.get((cause_index, number), 0.0)))
        return Value(float(values[place]) if known is None else known,
                     float(np.sqrt(max(covariance[place, place], 0.0))))

    @property
    def scale_factor_error(self) -> Value:
        """Return the scale factor error relative to the simulation, 1."""
        return self._estimated_value(-1, 0)

    def coefficients(self, cause_index: int) -> list[Value]:
        """Return the values of the columns of a cause."""
        candidate = self.causes[cause_index].candidate
        if candidate.amplitude is not None:
            return []
        return [self._estimated_value(cause_index, number)
                for number in range(len(self.causes[cause_index].values))]

    def shapes(self, cause_index: int) -> dict[int, Value]:
        """Return the fitted shapes of a cause, by their places."""
        candidate = self.causes[cause_index].candidate
        return {place: self._estimated_value(cause_index, -1 - place, candidate.shapes[place])
                for place in fitted_shape_indices(candidate)}

    @cached_property
    def explained_outputs(self) -> list[Array]:
        """Return the contributions of causes and scale to each output, rad/s, shape (n,)."""
        return [self.total_contribution(each, run) for run, each in enumerate(self.replays)]

    def output_contributions(self, replay: Replay, log_index: int) -> dict[str, Array]:
        """Return the contributions of scale and causes to the output of a log, rad/s, (n,)."""
        found: dict[str, Array | float] = {}
        new = replay
        for known in self.causes:
            if is_rate_distortion(known.candidate.cause):
                before, new = new, with_distorted_rate(new, [known])
                found[known.candidate.cause] = new.channels.rate - before.channels.rate
        found['scale_factor_error'] = self.scale_factor_error.value * new.channels.rate
        for place, known in enumerate(self.causes):
            candidate = known.candidate
            if (is_rate_distortion(candidate.cause) or candidate.log_index not in (None, log_index)
                    or not self.is_included(place)):
                continue
            values = ([candidate.amplitude] if candidate.amplitude is not None
                      else [one.value for one in self.coefficients(place)])
            for value, column in zip(values, candidate.columns(new)):
                found[candidate.cause] = found.get(candidate.cause, 0.0) + value * column
        return {name: np.asarray(part) for name, part in found.items()}

    def total_contribution(self, replay: Replay, log_index: int) -> Array:
        """Return the sum of the contributions of scale and causes to the output of a log."""
        return np.asarray(sum(self.output_contributions(replay, log_index).values()))

    def heading_contributions(self, log_index: int,
                              plain_fit: FittedValues | None) -> tuple[dict[str, Array], Array]:
        """
        Return the contributions to the change of heading of a log, rad, and its times, s.

        Parameters
        ----------
        log_index : number of the log
        plain_fit : bias and scale factor of the simulation, if they were fitted; else None

        """
        each = self.replays[log_index]
        parts = {**self.output_contributions(each, log_index),
                 'bias': np.full(len(each.valid), self.biases[log_index]),
                 'left': self.residuals[log_index] - self.biases[log_index]}
        if plain_fit is not None:
            parts['scale_factor_error'] -= plain_fit.total_contribution(each, log_index)
            parts['bias'] -= plain_fit.biases[log_index]
        return ({name: each.resample(part) * each.point_interval for name, part in parts.items()},
                np.arange(each.point_count + 1) * each.point_interval)

    @cached_property
    def residuals(self) -> list[Array]:
        """Return the residual of each log, with its bias, rad/s, shape (n,)."""
        return [each.channels.output - each.reference - added
                for each, added in zip(self.replays, self.explained_outputs)]

    @cached_property
    def biases(self) -> list[float]:
        """Return the bias of each log less the simulation's, rad/s."""
        return [float(left[each.valid].mean()) for each, left in zip(self.replays, self.residuals)]

    @cached_property
    def bias_variance(self) -> float:
        """Return the variance of the mean bias by the uncertainty of other values, (rad/s)²."""
        means = np.array([self._bias_sensitivity(*owner) for owner in self.fit.column_owners])
        return float(means @ self._estimates[2] @ means)

    def _bias_sensitivity(self, cause_index: int, number: int) -> float:
        """Return the derivative of the mean bias to a value, with the sign reversed."""
        if cause_index < 0:
            parts = [with_distorted_rate(each, self.causes).channels.rate for each in self.replays]
        elif number >= 0 and self.is_included(cause_index):
            parts = [self.causes[cause_index].candidate.columns(
                with_distorted_rate(each, self.causes))[number] for each in self.replays]
        else:
            return 0.0
        return float(np.mean([part[each.valid].mean() for part, each in zip(parts, self.replays)]))


def is_single_event(cause: SelectedCause) -> bool:
    """Tell whether a cause is an effect of the gyro in one log alone: a step or a tone."""
    return cause.candidate.log_index is not None and cause.candidate.cause in CATALOGUE
