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
The noise figures of a record: the coefficients of the noise terms, and their bounds.

Every combination of terms is fitted to the Allan variances at octaves. The fits are ranked by
likelihood, and the best one gives the figures.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
import itertools
import math

from gyro_calibration.allan.deviation import (
    allan_deviation, AllanChart, chi_squared_bounds, covariance_form)
from gyro_calibration.logs.log import Array, DataRefused, NORMAL_QUANTILE_975
from gyro_calibration.logs.stamps import Integers
from gyro_calibration.model.noise import (
    GaussMarkov, Noise, NOISE_TERMS, NoiseTerm, QUANTIZATION_NOISE)
import numpy as np
from scipy.optimize import nnls
from scipy.special import chdtrc

#: Largest difference in -2 ln likelihood of an alternative combination of terms.
_ALTERNATIVE_LIMIT = 6.0
#: A combination that is likelier by this in -2 ln likelihood, but has too many terms, widens the
#: bounds. At 0 those of the angle random walk are 6 to 35 % wider, and hold the truth as often.
_WIDENING_LIMIT = 1.0
#: Relative differences of the sum of the terms that are tried; the smallest sufficient is used.
_MISFIT_SHARES = (0.0, *np.geomspace(0.01, 0.32, 11).tolist())
_MIN_OCTAVES = 4  # least number of octaves that show a slope and its end
#: Indices of the terms, of a Gauss-Markov process, and of the reduction of the variance by a
#: filter: at times beyond its memory it has the slope of quantization, with a negative sign.
_N, _B, _K, _Q, _R, _PROCESS, _FILTER_BEND = range(len(NOISE_TERMS) + 2)
#: Combinations of terms, without and with quantization, and with the bend of a filter.
_COMBINATIONS = [combination for count in range(len(NOISE_TERMS))
                 for places in itertools.combinations((_N, _B, _K, _R), count) for combination in (
                     places, (*places, _Q), (*places, _FILTER_BEND) if _N in places else ())
                 if combination]


@dataclass(frozen=True)
class _OctaveVariances:
    """Allan variances at octaves and the terms of their covariance, all in samples."""

    samples: int  # of the record
    size: Integers  # averaging times, shape (n,)
    loss_factor: Array  # of the scatter of an Allan deviation by lost windows, shape (n,)
    variance: Array  # shape (n,)
    columns: Array  # of each term, a process, and a bend, for a coefficient of 1, shape (n, 7)
    process: GaussMarkov | None = None  # of 1 rad/s

    @classmethod
    def from_chart(cls, chart: AllanChart) -> _OctaveVariances:
        columns = np.column_stack([*(part.allan_variance(chart.size) for part in NOISE_TERMS),
                                   np.zeros(len(chart.size)),
                                   -QUANTIZATION_NOISE.allan_variance(chart.size)])
        scarcity = np.sqrt((chart.samples + 1 - 2 * chart.size) / chart.difference_count)
        return cls(chart.samples, chart.size, scarcity, chart.deviation ** 2, columns)

    @cached_property
    def forms(self) -> Array:
        """
        Return the covariance as a quadratic form of squared coefficients, shape (n, n, 5, 5).

        With a process it is (n, n, 6, 6).
        """
        sizes = self.size.tolist()
        return np.array([[covariance_form(self.samples, *sorted((one, other)), self.process)
                          for other in sizes] for one in sizes]) * np.outer(
            self.loss_factor, self.loss_factor)[:, :, None, None]

    def process_columns(self, process: GaussMarkov) -> Array:
        """Return the columns with that of a process of 1 rad/s, its times in samples."""
        columns = self.columns.copy()
        columns[:, _PROCESS] = process.allan_variance(self.size.astype(float))
        return columns

    def covariance(self, squares: Array) -> Array:
        """Return the covariance of the variances, shape (n, n), for these squared coefficients."""
        known = squares[:self.forms.shape[-1]]
        return np.einsum('ijpq,p,q->ij', self.forms, known, known)

    def model_variance(self, squares: Array) -> Array:
        """Return the sum of the terms for these squared coefficients, kept above zero."""
        return np.maximum(self.columns @ squares, 1e-3 * self.variance)


@dataclass(frozen=True)
class _CombinationFit:
    """A combination of terms, fitted to octaves."""

    octaves: _OctaveVariances
    squares: Array  # of the coefficients, shape (7,)
    cholesky_factor: Array  # of the covariance of the variances

    @property
    def active_terms(self) -> list[int]:
        """Return the indices of the terms with a coefficient above zero."""
        return np.nonzero(self.squares)[0].tolist()

    def _normal_scores(self) -> tuple[Array, float]:
        """Return standard normal scores, and -2 ln of the normalization of their density."""
        # The cube root of a mean square is nearly Gaussian (Wilson and Hilferty, 1931).
        model = self.octaves.model_variance(self.squares)
        deviation = np.sqrt((self.cholesky_factor ** 2).sum(axis=1))
        ninth = (deviation / model) ** 2 / 9.0
        normal = (np.cbrt(self.octaves.variance / model) - 1.0 + ninth) / np.sqrt(ninth)
        half = self.cholesky_factor / deviation[:, None]
        density = (np.log(ninth).sum() + 2.0 / 3.0 * np.log(model).sum()
                   + 2.0 * np.log(half.diagonal()).sum())
        return np.linalg.solve(half, normal), float(density)

    @cached_property
    def deviance(self) -> float:
        """Return -2 ln likelihood, up to a constant that all combinations share."""
        normal, density = self._normal_scores()
        return float(normal @ normal) + density

    def penalized_deviance(self) -> float:
        """Return -2 ln likelihood plus a penalty for each term."""
        # By 10 a term, 95 % of white records have no further one. In a single record a random walk
        # looks like a ramp. A process counts as two terms.
        return (self.deviance
                + 10.0 * (len(self.active_terms) + (_PROCESS in self.active_terms))
                + _ALTERNATIVE_LIMIT * (_R in self.active_terms))

    def is_likely(self) -> bool:
        """Return whether the residuals are within chance."""
        normal, _ = self._normal_scores()
        freedom = len(normal) - len(self.active_terms) - (_PROCESS in self.active_terms)
        return freedom > 0 and chdtrc(freedom, float(normal @ normal)) > 0.05

    def estimate_squares(self, indices: Sequence[int]) -> tuple[Array, Array]:
        """Return the squared coefficients by least squares, of any sign, and their deviations."""
        white = np.linalg.solve(self.cholesky_factor, self.octaves.columns[:, list(indices)])
        size = np.linalg.norm(white, axis=0)
        inverse = np.linalg.pinv((white / size).T @ (white / size))
        found = (inverse @ (white / size).T
                 @ np.linalg.solve(self.cholesky_factor, self.octaves.variance))
        return found / size, np.sqrt(inverse.diagonal()) / size

    def square_deviation(self, index: int) -> float:
        """Return the standard deviation of the squared coefficient of a term of the fit."""
        return float(self.estimate_squares(self.active_terms)[1][self.active_terms.index(index)])

    def coefficient_bounds(self, index: int) -> tuple[float, float]:
        """Return 95 % bounds of a coefficient, whose square is taken as a mean square."""
        square = self.squares[index]
        lower, upper = chi_squared_bounds(
            square, max(2.0 * (square / self.square_deviation(index)) ** 2, 1.0))
        return float(lower), float(upper)


def _solve_nonnegative(half: Array, columns: Array, observed: Array) -> Array:
    """Return squared coefficients, none negative, by a Cholesky factor of the covariance."""
    white = np.linalg.solve(half, np.column_stack([columns, observed]))
    size = np.linalg.norm(white[:, :-1], axis=0)
    return nnls(white[:, :-1] / size, white[:, -1])[0] / size


def _fit_combination(octaves: _OctaveVariances, indices: tuple[int, ...], misfit: float,
                     fixed_term: int = -1, fixed_square: float = 0.0) -> _CombinationFit:
    """Fit nonnegative terms, with the covariance of the fitted noise; one more may be fixed."""
    given = np.zeros(_FILTER_BEND + 1)
    if fixed_term >= 0:
        given[fixed_term] = fixed_square
    observed = octaves.variance - octaves.columns @ given
    squares, half = given.copy(), np.diag(octaves.variance)
    for number in range(12):
        found = _solve_nonnegative(half, octaves.columns[:, indices], observed)
        if not (found.any() or fixed_square) or (
                number and np.allclose(squares[list(indices)], found, rtol=1e-4, atol=0.0)):
            break
        squares[list(indices)] = found
        model, covariance = octaves.model_variance(squares), octaves.covariance(squares)
        covariance[np.diag_indices(len(model))] += 4.0 * (misfit * model) ** 2
        try:
            half = np.linalg.cholesky(covariance)
        except np.linalg.LinAlgError:
            # nearly singular, as for a ramp alone: limit the correlations below 1
            size = np.sqrt(np.maximum(covariance.diagonal(), 1e-12 * model ** 2))
            values, vectors = np.linalg.eigh(covariance / np.outer(size, size))
            half = size[:, None] * np.linalg.cholesky(
                (vectors * np.maximum(values, 1e-4)) @ vectors.T)
    return _CombinationFit(octaves, squares, half)


@dataclass(frozen=True)
class _Ranking:
    """All combinations of terms, fitted to the same octaves."""

    first_octave: int  # that is fitted
    misfit: float  # see `NoiseFit`
    fits: tuple[_CombinationFit, ...]  # the likeliest first
    #: The best with a Gauss-Markov process in place of its flicker and rate random walk, and in
    #: place of the walk alone.
    process_fits: tuple[_CombinationFit, ...] = ()

    @property
    def best(self) -> _CombinationFit:
        """Return the fit with the least penalized -2 ln likelihood."""
        return self.fits[0]

    @property
    def best_process(self) -> _CombinationFit | None:
        """Return the best fit with a process, if it is better than the best without."""
        found = min(self.process_fits, key=_CombinationFit.penalized_deviance, default=None)
        return (found
                if found and found.penalized_deviance() < self.best.penalized_deviance() else None)

    @cached_property
    def alternatives(self) -> list[_CombinationFit]:
        """Return the combinations of other terms, not more of them, that are nearly as likely."""
        best = self.best
        return [each for each in self.fits if each.deviance < best.deviance + _ALTERNATIVE_LIMIT
                and len(each.active_terms) <= len(best.active_terms)
                and not set(each.active_terms) - {_FILTER_BEND, _Q} <= set(best.active_terms)]

    @cached_property
    def plausible_fits(self) -> list[_CombinationFit]:
        """Return the best, likelier ones with more terms, and those joined with alternatives."""
        best = self.best
        both = [{*best.active_terms, *other.active_terms} for other in self.alternatives]
        return [best, *(each for each in self.fits if each.deviance
                        < best.deviance - _WIDENING_LIMIT or set(each.active_terms) in both)]


def _rank_from_octave(octaves: _OctaveVariances, start: int, misfit: float) -> _Ranking:
    """Fit all combinations of terms to the octaves from one on."""
    since = replace(octaves, **{name: getattr(octaves, name)[start:]
                                for name in ('size', 'loss_factor', 'variance', 'columns')})
    descriptions = tuple(
        sorted((_fit_combination(since, places, misfit) for places in _COMBINATIONS),
               key=_CombinationFit.penalized_deviance))
    best = descriptions[0]
    kept = {tuple(place for place in best.active_terms if place not in replaced)
            for replaced in ((_B, _K), (_K,)) if set(replaced) & set(best.active_terms)}
    return _Ranking(start, misfit, descriptions,
                    tuple(filter(None, (_fit_with_process(best, each, misfit) for each in kept))))


def _fit_with_process(best: _CombinationFit, kept_terms: tuple[int, ...],
                      misfit: float) -> _CombinationFit | None:
    """Return the best fit of some terms and a Gauss-Markov process, or None without one."""
    # The peak of the Allan deviation of the process, at 1.9 correlation times, must be in the
    # chart, and it must make less than half of the first Allan variance, as white noise after a
    # lag. The correlation time is found with the covariance of the best fit, scaled by the Allan
    # deviations.
    octaves, places = best.octaves, (*kept_terms, _PROCESS)
    longest, known = octaves.size[-1] / 1.9, octaves.model_variance(best.squares)

    def approximate_deviance(process: GaussMarkov) -> float:
        columns, squares, half = (octaves.process_columns(process), np.zeros(_FILTER_BEND + 1),
                                  best.cholesky_factor)
        for _ in range(2):
            squares[list(places)] = _solve_nonnegative(half, columns[:, places], octaves.variance)
            model = np.maximum(columns @ squares, 1e-3 * octaves.variance)
            half = best.cholesky_factor * (model / known)[:, None]
        return _CombinationFit(replace(octaves, columns=columns), squares, half).deviance

    process = min((GaussMarkov(math.sqrt(2.0 / constant), constant) for constant in np.geomspace(
        octaves.size[0], longest, 4 * len(octaves.size)).tolist()), key=approximate_deviance)
    found = _fit_combination(replace(octaves, columns=octaves.process_columns(process),
                                     process=process), places, misfit)
    first = found.squares * found.octaves.columns[0]
    return found if 0.0 < first[_PROCESS] < 0.5 * first.sum() else None


@dataclass(frozen=True)
class NoiseFigure:
    """The coefficient of one noise term, in the unit of the term."""

    term: NoiseTerm
    value: float  # 0 where it is not detected
    standard_deviation: float  # if only the detected terms are present; nan where not detected
    #: with 95 % confidence, and undetected terms; the largest undetectable one where not detected
    lower: float
    upper: float

    def allan_variance(self, time: Array) -> Array:
        return self.value ** 2 * self.term.allan_variance(time)


@dataclass(frozen=True)
class NoiseFit:
    """The noise figures of a record."""

    figures: dict[str, NoiseFigure]  # by symbol: N, B, K, Q, R
    chart: AllanChart  # the Allan deviations that were fitted, at octaves
    min_time: float  # shortest averaging time of the fit, s
    max_time: float  # s
    misfit: float  # relative difference of Allan deviations and sum of terms, beyond chance
    alternatives: tuple[str, ...] = ()  # symbols of combinations that fit nearly as well
    #: in place of flicker and rate random walk, where it fits better
    process: GaussMarkov | None = None

    @property
    def noise(self) -> Noise:
        """Return the noise figures of a model."""
        return Noise(*(self.figures[symbol].value for symbol in 'NBK'))

    @property
    def noise_bounds(self) -> dict[str, tuple[float, float]]:
        """Return the bounds of these figures, by their names in a model."""
        return {name: (self.figures[symbol].lower, self.figures[symbol].upper)
                for name, symbol in zip(Noise.__dataclass_fields__, 'NBK')}

    def deviation(self, time: Array) -> Array:
        """Return the Allan deviation of the sum of the terms, rad/s."""
        return np.sqrt(sum(figure.allan_variance(time) for figure in self.figures.values()))

    @property
    def is_floor_reached(self) -> bool:
        """Return whether N and Q make less than half of the variance, an octave before the end."""
        time = self.chart.time[-2]
        falling = sum(figure.allan_variance(time) for figure in self.figures.values()
                      if figure.term.slope < 0.0)
        return bool(falling < 0.5 * self.deviation(time) ** 2)


def fit_noise(rate: Array, interval: float) -> NoiseFit:
    """
    Fit the noise terms to the Allan variances at octaves, and keep those that are detected.

    The squared coefficients are found by generalized least squares (as in the generalized method
    of wavelet moments of Guerrier, Skaloud, Stebler and Victoria-Feser, JASA 2013), none of them
    negative. The shortest averaging times, which the filters of a gyro bend, are left out.

    The rate, rad/s, shape (n,), has one sample an interval, s; nan where it is lost. Raise
    `DataRefused` for too few samples, or where no sum of terms fits them.
    """
    chart = allan_deviation(
        rate, interval,
        2.0 ** np.arange(max(math.floor(math.log2(max(len(rate), 8) / 6.0)), 1) + 1) * interval)
    if len(chart.size) < _MIN_OCTAVES or not chart.deviation.all():
        raise DataRefused(f'{len(chart.size)} octaves of averaging times without a gap, the '
                          f'lowest Allan deviation {chart.deviation.min(initial=math.inf):g} '
                          f'rad/s; wanted {_MIN_OCTAVES} octaves, all above 0: record longer and '
                          'without losses')
    # If residuals are within chance from no octave on, a misfit is added. Filters bend the short
    # end gradually: one more octave is left out.
    octaves, last = _OctaveVariances.from_chart(chart), max(len(chart.size) // 2 - 1, 0)
    for misfit, start in itertools.product(_MISFIT_SHARES, range(last + 1)):
        ranking = _rank_from_octave(octaves, start, misfit)
        if (ranking.best.is_likely()
                or (ranking.best_process is not None and ranking.best_process.is_likely())):
            break
    else:
        raise DataRefused(
            f'the Allan deviations are more than {100 * _MISFIT_SHARES[-1]:.0f} % off any sum of '
            'the five noise terms: the record contains something else, such as a swing or a '
            'vibration; record again at rest')
    if 0 < start < last:
        ranking = _rank_from_octave(octaves, start + 1, misfit)
    process = None
    if ranking.best_process is not None and ranking.best_process.octaves.process is not None:
        time = ranking.best_process.octaves.process.correlation_time * interval
        process = GaussMarkov(
            math.sqrt(2.0 / time * ranking.best_process.squares[_PROCESS]), time)
    figures = {part.symbol: _build_figure(ranking, place, interval)
               for place, part in enumerate(NOISE_TERMS)}
    return NoiseFit(figures, chart, float(chart.time[ranking.first_octave]), float(chart.time[-1]),
                    ranking.misfit,
                    tuple(sorted({''.join(NOISE_TERMS[place].symbol
                                          for place in each.active_terms if place != _FILTER_BEND)
                                  for each in ranking.alternatives})), process)


def _build_figure(ranking: _Ranking, index: int, interval: float) -> NoiseFigure:
    """Return a figure with bounds that hold with and without undetected terms."""
    part, process = NOISE_TERMS[index], ranking.best_process
    # flicker and rate random walk approximate a process; the other terms are fitted with it
    best = ranking.best if process is None or index in (_B, _K) else process
    value, deviation = 0.0, math.nan
    lower, upper = _likelihood_bounds(ranking, best, index)
    # quantization is detected from the first octave on only
    if index in {*ranking.best.active_terms} & {*best.active_terms} and (
            index != _Q or ranking.first_octave == 0):
        value = math.sqrt(best.squares[index])
        deviation = 0.5 * best.square_deviation(index) / value
        possible = ranking.plausible_fits if best is ranking.best else [best]
        ends = [(value, value), (lower, upper), *(
            each.coefficient_bounds(index) for each in possible if index in each.active_terms)]
        lower, upper = min(low for low, _ in ends), max(high for _, high in ends)
        if index == _B:
            # a process may be in the record too; it has two figures
            joint = _fit_with_process(best, tuple(best.active_terms), ranking.misfit)
            if (joint is not None and index in joint.active_terms
                    and joint.deviance < best.deviance - 2.0 * _WIDENING_LIMIT):
                lower = min(lower, joint.coefficient_bounds(index)[0])
    # Where a process may replace a term, it may be 0. A random walk is a process with an infinite
    # correlation time, so the likelihoods are compared; in place of flicker, the penalized ones.
    excess = [each.deviance - ranking.best.deviance if index == _K
              else each.penalized_deviance() - ranking.best.penalized_deviance()
              for each in ranking.process_fits if index not in each.active_terms]
    if not value or index in (_B, _K) and min(excess, default=math.inf) < (
            NORMAL_QUANTILE_975 ** 2):
        lower = 0.0
    unit = interval ** -part.slope
    return NoiseFigure(part, *(each * unit for each in (value, deviation, lower, upper)))


def _likelihood_bounds(ranking: _Ranking, best: _CombinationFit,
                       index: int) -> tuple[float, float]:
    """Return the bounds of a coefficient, between which -2 ln likelihood is near its minimum."""
    # The other terms are fitted anew (profile likelihood): those of the best fits, N, B and K,
    # detected or not, and a process where it is fitted with the term.
    held = {_N, _B, _K, *(each for one in (best, *ranking.plausible_fits, *ranking.alternatives)
                          for each in one.active_terms)}
    others = tuple(sorted(held - {index}))
    joint = _fit_combination(best.octaves, (*others, index), ranking.misfit)
    (*_, square), (*_, deviation) = joint.estimate_squares((*others, index))

    @cache
    def deviance_at(coefficient: float) -> float:
        return _fit_combination(best.octaves, others, ranking.misfit, index,
                                coefficient ** 2).deviance

    found = math.sqrt(joint.squares[index])
    scale = math.sqrt(max(square, 0.0) + deviation)
    likeliest = min((found, *(scale * factor for factor in (0.25, 0.5, 0.75, 0.9, 1.0, 1.1))),
                    key=deviance_at)
    limit = deviance_at(likeliest) + NORMAL_QUANTILE_975 ** 2  # of chi squared, 95 %

    def bisect_limit(inside: float, outside: float) -> float:
        for _ in range(12):
            middle = 0.5 * (inside + outside)
            inside, outside = ((middle, outside) if deviance_at(middle) < limit
                               else (inside, middle))
        return inside

    high = max(likeliest, scale)
    while deviance_at(high) < limit and high < 1e3 * scale:
        high *= 1.5
    lower = 0.0 if deviance_at(0.0) < limit else bisect_limit(likeliest, 0.0)
    return lower, bisect_limit(likeliest, high)
