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

from gyro_calibration.diagnosis.candidates import Candidate, columns_of, fitted_shapes, with_shape
from gyro_calibration.diagnosis.noise_likelihood import (
    log_sum,
    Marginalized,
    marginalized,
    noise_likelihood,
    NoiseLikelihood,
    Noises,
    Places,
)
from gyro_calibration.diagnosis.replay import (
    angles,
    bands,
    fall,
    inverse,
    levels,
    noise_grid,
    Replay,
    Shape,
    SMOOTHED,
)
from gyro_calibration.logs.log import Array, NORMAL_95
from gyro_calibration.model.effects import CATALOGUE
import numpy as np
from scipy.linalg import block_diag

#: Longest averaging interval of a smoothed residual, s; and number of iterations of the levels of
#: its noise, each with the most likely noise of the levels before.
_LONGEST, _ROUNDS = 0.1, 3
#: Relative step of a shape for the derivative of its columns.
_SMALL = 1e-4
#: Drop of the log-likelihood at the ends of a 95 % interval.
_FALL = 1.92


@dataclass(frozen=True)
class Named:
    """
    A selected cause.

    Attributes
    ----------
    candidate : the cause with its shapes
    values : coefficients of its columns; empty before a fit, and its shapes are then fixed
    price : penalty for the choice of its first shapes, in log-likelihood

    """

    candidate: Candidate
    values: tuple[float, ...] = ()
    price: float = 0.0


@dataclass(frozen=True)
class RegressionProblem:
    """
    The logs and the noises that are tried.

    Attributes
    ----------
    replays : the logs
    first : the noise by which residual and columns are whitened first
    deviation : standard deviation of each coefficient by it, with the levels of the logs, relative
        to that of white noise, shape (m,)
    starts : first coefficient of each band
    shapes : noises that are tried
    noises : the same, as weights of the bands

    """

    replays: tuple[Replay, ...]
    first: Shape
    deviation: Array
    starts: Places
    shapes: tuple[Shape, ...]
    noises: Noises

    def angles(self) -> tuple[Array, Array]:
        """Return pi k / n of each coefficient, and the interval of its log, s."""
        parts = [angles(each.points) for each in self.replays]
        return np.concatenate(parts), np.concatenate([
            np.full(len(part), each.step) for part, each in zip(parts, self.replays)])

    def divided(self, noise: int) -> Array:
        """Return the factors that whiten coefficients whitened by the first noise, shape (m,)."""
        count = np.diff(np.append(self.starts, len(self.deviation)))
        return np.repeat(np.sqrt(self.noises.weights[noise]), count)


def regression_problem(replays: Sequence[Replay]) -> RegressionProblem:
    """Set up the regression of logs with a grid of noises."""
    reference = _rounding(replays) if any(each.rounded for each in replays) else 0.0
    return _problem(tuple(replays), Shape(reference=reference), noise_grid(
        min(each.step for each in replays), max(each.duration for each in replays), reference))


def _rounding(replays: Sequence[Replay]) -> float:
    """Return the most likely variance of the rounding of a heading, relative to white noise."""
    shapes = [Shape(reference=ratio) for ratio in (0.0, *np.geomspace(1e-3, 1e4, 43))]
    tried = _problem(tuple(replays), Shape(), [replace(shape, walk=walk) for shape in shapes
                                               for walk in (0.0, 1e-4, 1e-2)])
    done = fitted(tried, [])
    return tried.shapes[int(done.by_noise.likelihood[0].argmax())].reference


def _problem(replays: tuple[Replay, ...], first: Shape,
             shapes: Sequence[Shape]) -> RegressionProblem:
    parts = [(angles(each.points), each.step) for each in replays]
    plain = np.concatenate([first.variance(angle, step) / step for angle, step in parts])
    deviation = np.sqrt(plain * np.concatenate([each.level() for each in replays]))
    offsets = np.cumsum([0, *(len(angle) for angle, _ in parts)])
    starts = np.concatenate([bands(angle, step) + offset
                             for (angle, step), offset in zip(parts, offsets)])
    count = np.diff(np.append(starts, offsets[-1])).astype(float)
    # The mean variance of a band is computed from some of its coefficients.
    few = [np.unique(np.linspace(begin, end - 1.0, 9).round().astype(int))
           for begin, end in zip(starts, [*starts[1:], offsets[-1]])]
    angle, step = (np.concatenate([part for part, _ in parts]),
                   np.concatenate([np.full(len(part), step) for part, step in parts]))
    chosen, first_of = np.concatenate(few), np.cumsum([0, *(len(part) for part in few)])[:-1]
    relative = np.array([
        np.add.reduceat(shape.variance(angle[chosen], step[chosen]) / step[chosen] / plain[chosen],
                        first_of)
        for shape in shapes]) / [len(part) for part in few]
    # Each combination of components has the same prior probability, whatever its number of sizes.
    kinds = [(bool(each.walk), bool(each.strength), bool(each.flicker)) for each in shapes]
    rare = [np.log(kinds.count(kind)) for kind in kinds]
    noises = Noises(1.0 / relative, np.log(relative) @ count + 2.0 * np.array(rare))
    return RegressionProblem(replays, first, deviation, starts, tuple(shapes), noises)


@dataclass(frozen=True)
class Fitted:
    """
    A regression with some causes.

    Attributes
    ----------
    problem : the logs with the rate that the gyro senses, distorted by causes
    plain : the logs with the reference rate
    named : causes
    residual : whitened, less the columns of causes of fixed amplitude, shape (m,)
    columns : whitened and independent: scale factor error, those of the causes, and derivatives
        with respect to their shapes, shape (q, m)
    owner : of each column: (index of the cause, or -1 for the scale factor error, or -2; index of
        its value, or -1 less index of its shape)
    widths : number of columns with free values of each cause
    marginalized, by_noise : see `noise_likelihood`

    """

    problem: RegressionProblem
    plain: tuple[Replay, ...]
    named: tuple[Named, ...]
    residual: Array
    columns: Array
    owner: tuple[tuple[int, int], ...]
    widths: tuple[int, ...]
    marginalized: Marginalized
    by_noise: NoiseLikelihood

    @property
    def score(self) -> float:
        """
        Return the logarithm of the likelihood at the best values, averaged over the noises.

        This is the restricted likelihood without its dependence on the units of the columns: see
        `evidence`.

        """
        by_noise, best = self.by_noise, int(self.by_noise.likelihood[0].argmax())
        _, logarithm = np.linalg.slogdet(self.marginalized.own[best])
        return float(log_sum(by_noise.likelihood)[0] + 0.5 * (
            logarithm - len(self.columns) * np.log(by_noise.squares[0, best])))

    def white(self, noise: Fitted | None = None) -> list[Array]:
        """Return the residual of each log, whitened in time to variance 1: shape (points,)."""
        return [inverse(part) for part in self.whitened(noise)]

    def whitened(self, noise: Fitted | None = None) -> list[Array]:
        """Return each log's whitened residual, by its own or another's noise: (points - 1,)."""
        of = noise or self
        best = int(of.by_noise.likelihood[0].argmax())
        factor = of.problem.divided(best) * np.sqrt(
            of.marginalized.freedom / of.by_noise.squares[0, best])
        return [part * own for part, own in zip(self.left(), self._by_log(factor))]

    def left(self) -> list[Array]:
        """Return each log's residual whitened by the first noise: shape (points - 1,)."""
        values, _ = self.estimates
        return self._by_log(self.residual - values @ self.columns)

    def _by_log(self, coefficients: Array) -> list[Array]:
        return np.split(coefficients,
                        np.cumsum([each.points - 1 for each in self.problem.replays])[:-1])

    @property
    def estimates(self) -> tuple[Array, Array]:
        """Return the values of the independent columns and covariance, averaged over noises."""
        probable = self.by_noise.probability[0]
        kept = np.flatnonzero(probable > 1e-3 * probable.max())
        weights = probable[kept] / probable[kept].sum()
        covariance = np.linalg.inv(self.marginalized.own[kept])
        values = np.einsum('gpq,gq->gp', covariance, self.by_noise.towards[0, kept])
        mean = weights @ values
        variances = weights * self.by_noise.squares[0, kept] / self.marginalized.freedom
        inside = np.einsum('g,gpq->pq', variances, covariance)
        return mean, inside + np.einsum('g,gp,gq->pq', weights, values - mean, values - mean)


def is_of_the_rate(name: str) -> bool:
    """Tell whether a cause distorts the rate before errors are added to it."""
    return name in CATALOGUE and CATALOGUE[name].stage == 'rate'


def seen(each: Replay, named: Sequence[Named]) -> Replay:
    """Return a log with the rate that the gyro senses, distorted by causes."""
    rate, time = each.channels.rate, each.channels.time
    for known in named:
        if is_of_the_rate(known.candidate.cause):
            distortion = CATALOGUE[known.candidate.cause].distortion
            assert distortion is not None
            rate = distortion(rate, time, *known.candidate.shapes)
    return each.with_rate(rate)


def fitted(whole: RegressionProblem, named: Sequence[Named],
           extra: Sequence[Candidate] = ()) -> Fitted:
    """
    Fit causes to logs.

    Parameters
    ----------
    whole : the logs with the reference rate
    named : causes with their shapes and values
    extra : candidates whose columns are nuisances too

    """
    replays = [seen(each, named) for each in whole.replays]
    widths = []
    residual = np.concatenate([
        each.noisy(each.channels.output - each.reference
                   - (new.channels.rate - each.channels.rate))
        for each, new in zip(whole.replays, replays)])
    columns, owner = [np.concatenate([each.coefficients(each.channels.rate)
                                      for each in replays])[None]], [(-1, 0)]
    for place, known in enumerate(named):
        own = columns_of(known.candidate, replays if not is_of_the_rate(known.candidate.cause)
                         else whole.replays)
        widths.append(len(own) if known.candidate.amplitude is None else 0)
        if known.candidate.amplitude is None:
            columns.append(own)
            owner += [(place, number) for number in range(len(own))]
        elif not is_of_the_rate(known.candidate.cause):
            residual = residual - known.candidate.amplitude * own[0]
        changes = _changes(known, whole.replays if is_of_the_rate(known.candidate.cause)
                           else replays, own) if known.values else []
        columns += [change[None] for _, change in changes]
        owner += [(place, -1 - number) for number, _ in changes]
    for candidate in extra:
        own = columns_of(candidate, replays)
        columns.append(own)
        owner += [(-2, 0)] * len(own)
    return _summed(replace(whole, replays=tuple(replays)), whole.replays, tuple(named),
                   residual / whole.deviation, np.concatenate(columns) / whole.deviation,
                   tuple(owner), tuple(widths))


def _changes(known: Named, replays: Sequence[Replay], own: Array) -> list[tuple[int, Array]]:
    """Return the derivative of a cause's contribution to each smooth, fitted shape."""
    found: list[tuple[int, Array]] = []
    for place in free_shapes(known.candidate):
        moved = _moved(known.candidate, place, max(each.duration for each in replays))
        change = np.tensordot(known.values, columns_of(moved, replays) - own, 1)
        found.append((place, change / (moved.shapes[place] - known.candidate.shapes[place])))
    return found


def _moved(candidate: Candidate, place: int, duration: float) -> Candidate:
    """Return a cause with a small change of a shape, within its bounds."""
    shape = candidate.shapes[place]
    # The phase of a wave must change little up to the end of the log.
    step = (1e-3 / duration if candidate.cause == 'interference_tone'
            else _SMALL * abs(shape) if shape else 1e-6)
    moved = with_shape(candidate, place, shape + step)
    return with_shape(candidate, place, shape - step) if moved.shapes[place] == shape else moved


def free_shapes(candidate: Candidate) -> list[int]:
    """Return the indices of fitted shapes on which the columns depend smoothly."""
    return [] if candidate.cause in ('bias_step', 'dead_zone') else fitted_shapes(candidate)


def leaping_shapes(candidate: Candidate) -> list[int]:
    """Return the indices of fitted shapes on which the columns do not depend smoothly."""
    return [place for place in fitted_shapes(candidate) if place not in free_shapes(candidate)]


def deviation_of_leaping(done: Fitted, place: int, shape: int) -> float:
    """Return the standard deviation of a shape by the profile of the likelihood."""
    candidate = done.named[place].candidate
    others = fitted(replace(done.problem, replays=done.plain),
                    done.named[:place] + done.named[place + 1:])
    least = with_one_more(others, candidate).score - _FALL

    def falls(by: float) -> bool:
        return with_one_more(others, with_shape(
            candidate, shape, candidate.shapes[shape] + by)).score < least

    first = (done.plain[0].step if candidate.cause == 'bias_step'
             else 1e-3 * candidate.shapes[shape])
    return max(_until(falls, first), _until(falls, -first)) / NORMAL_95


def _until(falls: Callable[[float], bool], first: float) -> float:
    """Return the distance at which a predicate is first true, to 1 %, by doubling and halving."""
    near, far = 0.0, first
    while not falls(far) and abs(far) < 1e6 * abs(first):
        near, far = far, 2.0 * far
    for _ in range(7):
        middle = 0.5 * (near + far)
        near, far = (near, middle) if falls(middle) else (middle, far)
    return abs(far)


def filtered(done: Fitted) -> tuple[Replay, ...]:
    """
    Return the logs with the levels of filtered noise, averaged where hardly any noise is left.

    The levels are those of the residual of the causes. Before the causes are fitted, motion that
    is delayed or filtered would pass for noise.

    """
    found = [fall(part) < 1.0 for part in done.whitened()]
    while any(deep := [fall(part) < SMOOTHED and 2.0 * each.step <= _LONGEST
                       for each, part in zip(done.plain, done.whitened())]):
        done = _again(done, [replace(each, every=each.every * (1 + more))
                             for each, more in zip(done.plain, deep)])
    for number in range(_ROUNDS if any(found) else 0):
        # First by the residual that is not whitened, or slow noise would compensate the filter.
        of = zip(done.plain, done.whitened() if number else done.left(), found)
        done = _again(done, [each.filtered(levels(part)) if falls else each
                             for each, part, falls in of])
    return done.plain


def _again(done: Fitted, replays: Sequence[Replay]) -> Fitted:
    """Fit the same causes to the logs with other points or levels."""
    return fitted(regression_problem(replays), done.named)


def with_one_more(before: Fitted, candidate: Candidate) -> Fitted:
    """Add a cause to a fit at its present shapes, and keep the other columns."""
    if is_of_the_rate(candidate.cause):
        return fitted(replace(before.problem, replays=before.plain),
                      [*before.named, Named(candidate)])
    own = columns_of(candidate, before.problem.replays) / before.problem.deviation
    residual, columns = before.residual, before.columns
    owner, place = before.owner, len(before.named)
    if candidate.amplitude is None:
        columns = np.concatenate([columns, own])
        owner = (*owner, *((place, number) for number in range(len(own))))
    else:
        residual = residual - candidate.amplitude * own[0]
    widths = (*before.widths, len(own) if candidate.amplitude is None else 0)
    return _summed(before.problem, before.plain, (*before.named, Named(candidate)), residual,
                   columns, owner, widths)


def with_columns(before: Fitted, columns: Array) -> Fitted:
    """Add whitened columns to a fit that belong to no cause."""
    owner = (*before.owner, *[(-2, 0)] * len(columns))
    return _summed(before.problem, before.plain, before.named, before.residual,
                   np.concatenate([before.columns, columns]), owner, before.widths)


def _summed(whole: RegressionProblem, plain: tuple[Replay, ...], named: tuple[Named, ...],
            residual: Array, columns: Array, owner: tuple[tuple[int, int], ...],
            widths: tuple[int, ...]) -> Fitted:
    """Return the fit of a whitened residual to independent columns under each noise."""
    kept = _independent(columns)
    of, nothing = columns[kept], np.empty((0, len(residual)))
    by = marginalized(of, nothing, (), whole.starts, whole.noises)
    return Fitted(whole, plain, named, residual, of, tuple(owner[place] for place in kept), widths,
                  by, noise_likelihood(residual[None], of, nothing, whole.starts, whole.noises,
                                       by))


def _independent(columns: Array) -> list[int]:
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
    fitted : the fit
    replays : the logs
    lasting : whether single events of the gyro are fitted, but excluded from the contributions, as
        in a model for other logs

    """

    fitted: Fitted
    replays: tuple[Replay, ...]
    lasting: bool = False

    @property
    def named(self) -> tuple[Named, ...]:
        """Return the causes."""
        return self.fitted.named

    def explaining(self, cause: int) -> bool:
        """Tell whether a cause, by its index, is included in the contributions."""
        return not (self.lasting and happens_once(self.named[cause]))

    @cached_property
    def _estimates(self) -> tuple[dict[tuple[int, int], int], Array, Array]:
        values, covariance = self.fitted.estimates
        return {owner: rank for rank, owner in enumerate(self.fitted.owner)}, values, covariance

    @cached_property
    def _leaping(self) -> dict[tuple[int, int], float]:
        """Return standard deviations of discontinuous shapes, by cause and index."""
        return {(place, -1 - shape): deviation_of_leaping(self.fitted, place, shape)
                for place, known in enumerate(self.named)
                for shape in leaping_shapes(known.candidate)}

    def place(self, cause: int, number: int) -> int | None:
        """Return the index of a value among the estimates: column from 0, or shape below 0."""
        ranks = [*self.fitted.owner, *self._leaping]
        return ranks.index((cause, number)) if (cause, number) in ranks else None

    @property
    def covariance(self) -> Array:
        """Return the covariance of all estimates."""
        return np.asarray(block_diag(self._estimates[2],
                                     np.diag(np.square(list(self._leaping.values())))))

    def _value(self, cause: int, number: int, known: float | None = None) -> Value:
        ranks, values, covariance = self._estimates
        place = ranks.get((cause, number))
        if place is None:
            return (Value(0.0, 0.0) if known is None
                    else Value(known, self._leaping.get((cause, number), 0.0)))
        return Value(float(values[place]) if known is None else known,
                     float(np.sqrt(max(covariance[place, place], 0.0))))

    @property
    def scale_factor_error(self) -> Value:
        """Return the scale factor error relative to the simulation, 1."""
        return self._value(-1, 0)

    def coefficients(self, cause: int) -> list[Value]:
        """Return the values of the columns of a cause."""
        candidate = self.named[cause].candidate
        if candidate.amplitude is not None:
            return []
        return [self._value(cause, number) for number in range(len(self.named[cause].values))]

    def shapes(self, cause: int) -> dict[int, Value]:
        """Return the fitted shapes of a cause, by their places."""
        candidate = self.named[cause].candidate
        return {place: self._value(cause, -1 - place, candidate.shapes[place])
                for place in fitted_shapes(candidate)}

    @cached_property
    def explained(self) -> list[Array]:
        """Return the contributions of causes and scale to each output, rad/s, shape (n,)."""
        return [self.explains(each, run) for run, each in enumerate(self.replays)]

    def parts(self, each: Replay, run: int) -> dict[str, Array]:
        """Return the contributions of scale and causes to the output of a log, rad/s, (n,)."""
        found: dict[str, Array | float] = {}
        new = each
        for known in self.named:
            if is_of_the_rate(known.candidate.cause):
                before, new = new, seen(new, [known])
                found[known.candidate.cause] = new.channels.rate - before.channels.rate
        found['scale_factor_error'] = self.scale_factor_error.value * new.channels.rate
        for place, known in enumerate(self.named):
            candidate = known.candidate
            if (is_of_the_rate(candidate.cause) or candidate.run not in (None, run)
                    or not self.explaining(place)):
                continue
            values = ([candidate.amplitude] if candidate.amplitude is not None
                      else [one.value for one in self.coefficients(place)])
            for value, column in zip(values, candidate.columns(new)):
                found[candidate.cause] = found.get(candidate.cause, 0.0) + value * column
        return {name: np.asarray(part) for name, part in found.items()}

    def explains(self, each: Replay, run: int) -> Array:
        """Return the sum of the contributions of scale and causes to the output of a log."""
        return np.asarray(sum(self.parts(each, run).values()))

    def heading_changes(self, run: int,
                        plain: FittedValues | None) -> tuple[dict[str, Array], Array]:
        """
        Return the contributions to the change of heading of a log, rad, and its times, s.

        Parameters
        ----------
        run : number of the log
        plain : bias and scale factor of the simulation, if they were fitted; else None

        """
        each = self.replays[run]
        parts = {**self.parts(each, run), 'bias': np.full(len(each.kept), self.biases[run]),
                 'left': self.residuals[run] - self.biases[run]}
        if plain is not None:
            parts['scale_factor_error'] -= plain.explains(each, run)
            parts['bias'] -= plain.biases[run]
        return ({name: each.on_grid(part) * each.step for name, part in parts.items()},
                np.arange(each.points + 1) * each.step)

    @cached_property
    def residuals(self) -> list[Array]:
        """Return the residual of each log, with its bias, rad/s, shape (n,)."""
        return [each.channels.output - each.reference - added
                for each, added in zip(self.replays, self.explained)]

    @cached_property
    def biases(self) -> list[float]:
        """Return the bias of each log less the simulation's, rad/s."""
        return [float(left[each.kept].mean()) for each, left in zip(self.replays, self.residuals)]

    @cached_property
    def bias_variance(self) -> float:
        """Return the variance of the mean bias by the uncertainty of other values, (rad/s)²."""
        means = np.array([self._mean_change(place, number) for place, number in self.fitted.owner])
        return float(means @ self._estimates[2] @ means)

    def _mean_change(self, cause: int, number: int) -> float:
        """Return the derivative of the mean bias to a value, with the sign reversed."""
        if cause < 0:
            parts = [seen(each, self.named).channels.rate for each in self.replays]
        elif number >= 0 and self.explaining(cause):
            parts = [self.named[cause].candidate.columns(seen(each, self.named))[number]
                     for each in self.replays]
        else:
            return 0.0
        return float(np.mean([part[each.kept].mean() for part, each in zip(parts, self.replays)]))


def happens_once(known: Named) -> bool:
    """Tell whether a cause is an effect of the gyro in one log alone: a step or a tone."""
    return known.candidate.run is not None and known.candidate.cause in CATALOGUE
