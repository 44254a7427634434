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
From dwells to a gyro's model: values of effects, covariance, and errors of left-out sweeps.

The errors are also those of full turns of 360 degrees (Ojeda et al., section 4), of the heading in
each turn, rad: with the bias of a rest before only, and with a model and that bias after it.
Dwells that allow no answer raise `DataRefused`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
import math
from typing import NamedTuple

from gyro_calibration.calibration.dwells import (
    Dwells, MIN_TEMPERATURE_SPREAD, Numbers, select_dwells)
from gyro_calibration.calibration.scatter import (
    cross_validation_parts, estimate_scatter, estimate_tolerance, rms, Scatter, sum_by_part,
    surface_dof, Uncertainty, Whitener)
from gyro_calibration.calibration.self_calibration import refuse_scale
from gyro_calibration.logs.log import Array, DataRefused, DEGREE, Mask, NORMAL_QUANTILE_975
from gyro_calibration.model.effects import (
    Channels, CUBIC_NONLINEARITY, Effect, SCALE_FACTOR_ERROR, SINE_RESPONSE)
from gyro_calibration.model.gyro_model import GyroModel, Term
import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import minimize_scalar
from scipy.stats import f as fisher

#: Beyond this condition number of the columns, each of length one, the effects are not separable.
_MAX_CONDITION_NUMBER = 1e3
#: Two effects that explain nearly the same -> the other one.
CONFOUNDERS = {SINE_RESPONSE: CUBIC_NONLINEARITY, CUBIC_NONLINEARITY: SINE_RESPONSE}
#: rad/s; the error of slower turns is mostly bias, not scale; as published.
MIN_TURN_RATE = 5.0 * DEGREE


class _ColumnTest(NamedTuple):
    """How much columns explain of the errors of dwells."""

    p_value: float  # that errors without them are explained as well
    gain: float  # reduction of the sum of the whitened squared residuals
    share: float  # of the variance, from 0 to 1


@dataclass(frozen=True)
class Calibration:
    """A model fitted to dwells, with residuals and cross-validation."""

    terms: tuple[Term, ...]  # effects with their values
    dwells: Dwells  # all of them
    given: GyroModel  # that is corrected; its effects that are not fitted count as known
    scatter: Scatter  # of the dwells, and which were fitted
    residual: Array  # error of each dwell that the effects do not explain, rad/s, shape (n,)
    # of a fit without the dwell's sweep, rad/s, (n,); nan at outlying dwells, infinite where the
    # other sweeps do not determine it
    left_out_residual: Array
    deviation: Array  # standard deviation of each dwell, rad/s, shape (n,)
    condition_number: float  # number of the columns, each of length one
    dof: int  # dwells less fitted values
    misfit: float  # sum of the whitened squared residuals; about `dof` where no effect is missing

    @property
    def effects(self) -> tuple[Effect, ...]:
        """Return the effects of the model."""
        return tuple(term.effect for term in self.terms)

    @cached_property
    def used(self) -> Dwells:
        """Return the dwells that were fitted."""
        return select_dwells(self.dwells, self.scatter.inliers)

    @cached_property
    def _whitener(self) -> Whitener:
        return Whitener(self.used, self.scatter)

    @cached_property
    def uncertainty(self) -> Uncertainty:
        """Return the distribution of the fitted values, of more dwells than there are values."""
        model, channels = GyroModel(self.terms), channels_of(self.used)
        columns = sensitivity_columns(channels, self.terms)
        residual = self.residual[self.scatter.inliers]
        if model.uses_channel('output'):
            # The polynomial depends on the output. With the measured one in the columns, a scale
            # factor error of -1 would make every residual zero: the Jacobian of output against
            # error is missing there. Columns and residual are those of the output that the model
            # expects: its change is that of the error over 1 - g, with g the slope of the error
            # over the output.
            expected, step = model.output_from_channels(channels), 1e-5
            below, here, above = (channels.with_rate(channels.rate, expected + change)
                                  for change in (-step, 0.0, step))
            slope = (model.error(above) - model.error(below)) / (2.0 * step)
            columns = (sensitivity_columns(here, self.terms)
                       / np.maximum(1.0 - slope, 0.1)[:, None])
            residual = self.used.output - expected
        return Uncertainty.from_fit(self.used, self.scatter, columns, residual)

    @cached_property
    def model(self) -> GyroModel:
        """Return effects with values, covariance and valid range; 1.96 deviations hold 95 %."""
        output, temperature = self.used.output, self.used.temperature
        model = GyroModel(self.terms, self.uncertainty.covariance() if self.dof else None,
                          (float(output.min()), float(output.max())))
        if temperature is not None:
            model = replace(
                model, temperature_range=(float(temperature.min()), float(temperature.max())),
                reference_temperature=round(float(temperature.mean()), 1))
        if model.covariance is None:
            return model
        sweeps = self.uncertainty.sweep_scatter
        scatter = replace(self.scatter, sweep_bias=float(sweeps[0]), sweep_scale=float(sweeps[1]))
        return replace(model, tolerance=estimate_tolerance(
            self.used, Whitener(self.used, scatter), sweeps,
            lambda rate, warm: sensitivity_columns(Channels(rate, rate, warm), self.terms),
            model.covariance))

    def last_index(self, effect: Effect) -> int:
        """Return the index of the last value of an effect among all fitted values."""
        owners = [owner.effect for owner in value_owners(self.terms)]
        return len(owners) - 1 - owners[::-1].index(effect)

    def effect_deviation(self, effect: Effect) -> float:
        """Return the standard deviation of the last value of an effect."""
        assert self.model.covariance is not None
        return math.sqrt(float(np.diag(self.model.covariance)[self.last_index(effect)]))

    def refit(self, effects: Sequence[Effect]) -> Calibration:
        """Fit other effects to the same dwells; raise `DataRefused` where that is not possible."""
        return (self if tuple(effects) == self.effects
                else fit_effects(self.dwells, effects, self.scatter, self.given))

    def p_value(self, effect: Effect) -> float:
        """Return the two-sided p-value of an effect, or of its change from the given model."""
        # the whole effect, not its derivative by a shape, which vanishes near zero for a sine
        change = self.change(effect)
        others = [each for each in self.terms if each.effect is not effect]
        known = sensitivity_columns(channels_of(self.used), others)
        return self.test(change[:, None], known, change).p_value

    def change(self, effect: Effect) -> Array:
        """Return the error of an effect less that of the given model, of fitted dwells, rad/s."""
        channels, zeros = channels_of(self.used), np.zeros(len(self.used))
        new, = (term.error(channels) for term in self.terms if term.effect is effect)
        replaced = replaced_term(self.given, effect)
        return zeros + new - (zeros if replaced is None else replaced.error(channels))

    def test(self, columns: Array, known: Array, unexplained: Array | float = 0.0) -> _ColumnTest:
        """
        Test whether columns explain the errors of the fitted dwells, given other columns.

        It is an F test, averaged over what the scatter may be, beside the uncertainty of the given
        model. Given are the columns, (n, m), those of other fitted values, (n, k), and an error in
        addition to the residual, rad/s, (n,).
        """
        known_basis, white, new = self._whiten_beside(known, unexplained, columns)
        # a sine may have its zeros at the rates of all dwells
        new_basis = _orthonormal_columns(new, 1.0 / _MAX_CONDITION_NUMBER)
        count, freedom = new_basis.shape[1], len(white) - known_basis.shape[1] - new_basis.shape[1]
        if not count or freedom < 1:
            return _ColumnTest(1.0, 0.0, 0.0)
        gain, total = float(np.sum((new_basis.T @ white) ** 2)), float(white @ white)
        share = 1.0 - (total - gain) / freedom / max(total / (freedom + count), 1e-300)
        # Columns in their own unit, for the covariance of the dwells may be another one.
        plain = self._whitener.restore(np.column_stack([known_basis, new_basis]))
        uncertain = Uncertainty.from_fit(self.used, self.scatter, plain,
                                         self.residual[self.scatter.inliers] + unexplained)
        of_model = new_basis.T @ self._whitener.whiten(self.given_errors)
        values = uncertain.offsets[:, -count:]
        covariances = uncertain.covariances[:, -count:, -count:] + of_model @ of_model.T
        squares = np.einsum('ki,ki->k', values,
                            np.linalg.solve(covariances, values[:, :, None])[:, :, 0])
        chance = float(uncertain.weights @ fisher.sf(squares / count, count, uncertain.dof))
        return _ColumnTest(chance, gain, min(max(share, 0.0), 1.0))

    def largest_gain(self, columns: Array, known: Array, unexplained: Array) -> float:
        """Return the gain of the best of several columns, with the arguments of `test`."""
        _, white, new = self._whiten_beside(known, unexplained, columns)
        lengths = np.linalg.norm(new, axis=0)
        new = new / np.where(lengths > 1.0 / _MAX_CONDITION_NUMBER, lengths, math.inf)
        return float(((new.T @ white) ** 2).max())

    def _whiten_beside(self, known: Array, unexplained: Array | float,
                       columns: Array) -> tuple[Array, Array, Array]:
        """Return a basis of known columns, the rest of the errors, and of columns of length 1."""
        known, error, columns = map(self._whitener.whiten, (
            known, self.residual[self.scatter.inliers] + unexplained, columns))
        known = _orthonormal_columns(
            known / np.maximum(np.linalg.norm(known, axis=0), 1e-300), 1e-6)
        columns = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
        return (known, error - known @ (known.T @ error),
                columns - known @ (known.T @ columns))

    @property
    def fit_p_value(self) -> float:
        """Return the p-value of the residual, by an F test against the surface of the scatter."""
        spare = surface_dof(self.used)
        beyond = self.dof - spare
        return (1.0 if min(spare, beyond) < 1 else
                float(fisher.sf((self.misfit - spare) / beyond, beyond, spare)))

    @cached_property
    def given_errors(self) -> Array:
        """Return the errors of fitted dwells by independent ones of the given model, rad/s."""
        known, covariance = static_terms(self.given), self.given.covariance
        if covariance is None:
            return np.empty((len(self.used), 0))
        chosen = [place for place, owner in enumerate(value_owners(self.given.terms))
                  if owner in known]
        sizes, directions = np.linalg.eigh(covariance[np.ix_(chosen, chosen)])
        channels = channels_of(self.used, self.given.reference_temperature)
        return (sensitivity_columns(channels, known)
                @ (directions * np.sqrt(np.maximum(sizes, 0.0))))

    def prediction_covariance(self, dwells: Dwells) -> Array:
        """Return the covariance of the errors of other dwells, of one sweep, (rad/s)², (n, n)."""
        rows = sensitivity_columns(channels_of(dwells), self.terms)
        shared = self.scatter.sweep_columns(dwells)
        of_fit = 0.0 if self.model.covariance is None else rows @ self.model.covariance @ rows.T
        return np.asarray(of_fit + np.diag(self.scatter.deviation(dwells) ** 2)
                          + shared @ shared.T)

    @cached_property
    def _dense_channels(self) -> Channels:
        """Return the inputs at rates also between those of the dwells, where a sine would hide."""
        rate = np.linspace(self.dwells.rate.min(), self.dwells.rate.max(), 1000)
        return Channels(rate, rate, self.given.reference_temperature)

    @property
    def min_non_monotonic_rate(self) -> float | None:
        """Return the slowest rate, rad/s, at which the output no longer grows with it, or None."""
        rate = np.abs(self._dense_channels.rate)
        folded = np.broadcast_to(
            GyroModel(self.terms).output_slope(self._dense_channels) <= 0.1, rate.shape)
        return float(rate[folded].min()) if folded.any() else None

    @property
    def is_ambiguous(self) -> bool:
        """
        Tell whether the output decreases anywhere between the rates of the dwells.

        It may do so with the scale factor error or without: a fast sine that passes through all
        dwells needs a large one.
        """
        others = tuple(each for each in self.terms if each.effect is not SCALE_FACTOR_ERROR)
        return any((np.diff(self._dense_channels.rate + GyroModel(terms).error(
            self._dense_channels)) < 0.0).any() for terms in (self.terms, others))

    @property
    def uncorrected_rms(self) -> float:
        """Return the root mean square of output less rate of what was fitted, rad/s."""
        return rms(self.used.output - self.used.rate)

    @property
    def residual_rms(self) -> float:
        """Return the root mean square of the residual of what was fitted, rad/s."""
        return rms(self.residual[self.scatter.inliers])

    @property
    def left_out_rms(self) -> float:
        """Return the root mean square of the errors of sweeps left out, rad/s."""
        return rms(self.left_out_residual[self.scatter.inliers])

    @property
    def left_out_rate(self) -> Array:
        """Return the rate of each dwell by a fit without its sweep, rad/s, shape (n,)."""
        slope = GyroModel(self.terms).output_slope(channels_of(self.dwells))
        return np.asarray(self.dwells.rate + self.left_out_residual / slope)

    @property
    def left_out_squares(self) -> Array:
        """Return the mean squared error of each left-out sweep, in dwell variances, (parts,)."""
        parts = cross_validation_parts(self.used)
        squares = (self.left_out_residual / self.deviation)[self.scatter.inliers] ** 2
        return np.asarray(sum_by_part(squares, parts) / np.bincount(parts))

    def cross_validation_misfit(self) -> float:
        """Return the mean over left-out sweeps of the mean squared error, in dwell variances."""
        return float(np.mean(self.left_out_squares))


def channels_of(dwells: Dwells, temperature: float = math.nan) -> Channels:
    """Return the inputs of the effects, at a temperature, degC, where the dwells have none."""
    return Channels(dwells.rate, dwells.output, np.full(len(dwells), temperature)
                    if dwells.temperature is None else dwells.temperature,
                    np.arange(1.0, len(dwells) + 1.0))


def value_owners(terms: Sequence[Term]) -> list[Term]:
    """Return the term of each fitted value, in the order of a covariance."""
    return [term for term in terms for _ in term.fitted_indices]


def static_terms(model: GyroModel) -> list[Term]:
    """Return the effects of a model that dwells show: those of rate, output and temperature."""
    return [term for term in model.terms
            if term.effect.inputs <= {'rate', 'output', 'temperature'}
            and term.effect.distortion is None]


def replaced_term(model: GyroModel, effect: Effect) -> Term | None:
    """Return the term of a model in place of which an effect is fitted, or its confounder's."""
    terms = {term.effect: term for term in model.terms}
    return terms.get(effect) or terms.get(CONFOUNDERS.get(effect, effect))


# the fit

def fit_effects(dwells: Dwells, effects: Sequence[Effect], scatter: Scatter | None = None,
                given: GyroModel | None = None) -> Calibration:
    """
    Fit effects to dwells by generalised least squares, solved by QR.

    Effects of the rate are evaluated at the reference rate, the polynomial of Ojeda et al. (eq. 9
    to 12) at the output, whose noise is small where it is an average. A shape is found by
    Gauss-Newton steps from the best of a grid over its bounds. Dwells in which effects look alike
    are refused. Of a given model that is corrected, effects are known unless they, or their
    confounders, are among the fitted ones, and temperatures count from its reference temperature.
    """
    _refuse_unobservable(dwells, effects)
    temperature = np.zeros(2) if dwells.temperature is None else dwells.temperature
    given = given or GyroModel(reference_temperature=round(float(temperature.mean()), 1))
    # conventions are final; shapes and coefficients are fitted
    conventions = {
        'reference_temperature': given.reference_temperature,
        'output_centre': 0.5 * float(dwells.output.max() + dwells.output.min()),
        'output_scale': 0.5 * float(np.ptp(dwells.output)) or 1.0,
        'temperature_centre': 0.5 * float(temperature.max() + temperature.min()),
        'temperature_scale': 0.5 * float(np.ptp(temperature)) or 1.0,
    }
    terms = tuple(
        Term(effect, tuple(conventions.get(parameter.name, parameter.default or 0.0)
                           for parameter in effect.parameters)) for effect in effects)
    channels, known = channels_of(dwells, given.reference_temperature), static_terms(given)
    scatter = scatter or estimate_scatter(replace(dwells, output=dwells.output - sum(
        term.error(channels) for term in known)))
    replaced = [replaced_term(given, effect) for effect in effects]
    rest = replace(dwells, output=dwells.output - sum(
        term.error(channels) for term in known if term not in replaced))
    used = select_dwells(rest, scatter.inliers)
    values = len(value_owners(terms))
    if len(used) < values:
        raise DataRefused(f'{len(used)} dwells do not determine {values} values; '
                          'add dwells, or fit fewer effects')
    whitener = Whitener(used, scatter)
    terms = _search_shapes(used, terms)
    for _ in range(20):  # Gauss-Newton steps; the first is the solution for coefficients alone
        orthogonal, triangle, lengths = _factor_columns(used, terms, whitener)
        step = solve_triangular(
            triangle, orthogonal.T @ whitener.whiten(_unexplained_error(used, terms))) / lengths
        changes, new_terms = iter(step.tolist()), []
        for term in terms:
            for place in term.fitted_indices:
                term = _replace_value(term, place, term.values[place] + next(changes))
            new_terms.append(term)
        terms = tuple(new_terms)
        if np.all(np.abs(step) * lengths < 1e-6):  # of a standard deviation
            break
    orthogonal, triangle, lengths = _factor_columns(used, terms, whitener)
    whitened = whitener.whiten(_unexplained_error(used, terms))
    left_out, deviation = np.full((2, len(dwells)), np.nan)
    left_out[scatter.inliers] = _left_out_residuals(orthogonal, whitened, whitener,
                                                    cross_validation_parts(used))
    deviation[scatter.inliers] = whitener.deviation
    return Calibration(terms, dwells, given, scatter, _unexplained_error(rest, terms), left_out,
                       deviation, float(np.linalg.cond(triangle)), len(used) - len(lengths),
                       float(whitened @ whitened))


def _unexplained_error(dwells: Dwells, terms: Sequence[Term]) -> Array:
    """Return the errors of the dwells that the effects do not explain, rad/s, shape (n,)."""
    channels = channels_of(dwells)
    return dwells.output - dwells.rate - sum(term.error(channels) for term in terms)


def sensitivity_columns(channels: Channels, terms: Sequence[Term]) -> Array:
    """Return the derivatives of the error by each fitted value, shape (n, m)."""
    zeros = np.zeros(len(np.asarray(channels.rate)))
    return np.column_stack([np.empty((len(zeros), 0)), *(
        row + zeros for term in terms for row in term.sensitivity(channels))])


def _search_shapes(dwells: Dwells, terms: tuple[Term, ...]) -> tuple[Term, ...]:
    """
    Set each fitted shape in turn to the best of a grid over its bounds.

    A smaller one that is not significantly worse is preferred: fast sines pass through evenly
    spaced dwells too.
    """
    channels = channels_of(dwells)

    def misfit(logarithm: float, terms: tuple[Term, ...], number: int, place: int) -> float:
        """Return the residual sum of squares with a shape, and the coefficients fitted."""
        tried, columns = _with_shape(terms, number, place, logarithm), []
        for term in tried:
            shapes = len(term.effect.nonlinear_parameters)
            columns += [term.columns(channels)[place - shapes]
                        for place in term.fitted_indices if place >= shapes]
        error = _unexplained_error(dwells, tried)
        matrix = np.column_stack([*columns, np.zeros(len(dwells))])
        return float(np.sum((error - matrix @ np.linalg.lstsq(matrix, error, rcond=None)[0]) ** 2))

    for number, term in enumerate(terms):
        for place in term.fitted_indices:
            if place >= len(term.effect.nonlinear_parameters):
                continue
            low, high = map(math.log, term.effect.nonlinear_parameters[place].bounds)
            grid = np.linspace(low, high, 60).tolist()
            sizes = [misfit(each, terms, number, place) for each in grid]
            best = int(np.argmin(sizes))
            found = grid[best]
            # slower minima of the grid, each refined between its neighbours
            minima = [at for at in range(1, best) if sizes[at] <= min(sizes[at - 1:at + 2])]
            if minima:
                refined = [minimize_scalar(misfit, args=(terms, number, place), method='bounded',
                                           bounds=(grid[at - 1], grid[min(at + 1, 59)]))
                           for at in [*minima, best]]
                dof = max(len(dwells) - len(value_owners(terms)), 1)
                limit = (1.0 + NORMAL_QUANTILE_975 ** 2 / dof) * min(each.fun for each in refined)
                found = next(float(each.x) for each in refined if each.fun <= limit)
            terms = _with_shape(terms, number, place, found)
    return terms


def _with_shape(terms: tuple[Term, ...], number: int, place: int,
                logarithm: float) -> tuple[Term, ...]:
    return (*terms[:number], _replace_value(terms[number], place, math.exp(logarithm)),
            *terms[number + 1:])


def _replace_value(term: Term, index: int, value: float) -> Term:
    low, high = term.effect.parameters[index].bounds
    return replace(term, values=(*term.values[:index], min(max(value, low), high),
                                 *term.values[index + 1:]))


def _factor_columns(dwells: Dwells, terms: Sequence[Term],
                    whitener: Whitener) -> tuple[Array, Array, Array]:
    """Return Q and R of the whitened columns, each of length one, and their lengths before."""
    columns = whitener.whiten(sensitivity_columns(channels_of(dwells), terms))
    lengths = np.linalg.norm(columns, axis=0)
    orthogonal, triangle = np.linalg.qr(columns / np.where(lengths > 0.0, lengths, 1.0))
    if np.linalg.cond(triangle) < _MAX_CONDITION_NUMBER:
        return orthogonal, triangle, lengths
    # the effects whose columns nearly cancel
    direction = np.abs(np.linalg.svd(triangle)[2][-1])
    owners = [owner.effect for owner in value_owners(terms)]
    alike = [effect for effect in dict.fromkeys(owners)
             if max(size for size, owner in zip(direction, owners) if owner is effect)
             > 0.1 * direction.max()]
    if len(alike) == 1:
        raise DataRefused(f'{alike[0].name} cannot be determined from these dwells; '
                          f'{alike[0].experiment}')
    advice = '; '.join(dict.fromkeys(effect.experiment for effect in alike[::-1]
                                     if effect.experiment))
    raise DataRefused(f'{", ".join(effect.name for effect in alike)} look alike in these dwells '
                      f'and cannot be distinguished; {advice}, or leave one out')


def _orthonormal_columns(columns: Array, tolerance: float) -> Array:
    """Return orthonormal columns that span others, shape (n, m), but for parts below a size."""
    left, sizes, _ = np.linalg.svd(columns, full_matrices=False)
    return left[:, sizes > tolerance]


def _left_out_residuals(orthogonal: Array, whitened: Array, whitener: Whitener,
                        parts: Numbers) -> Array:
    """Return each dwell's residual of a fit without its part: the deleted residuals."""
    left_out = np.full(len(whitened), math.inf)
    for part in range(parts.max() + 1):
        rows = np.flatnonzero(parts == part)
        sweep, own = whitener.whiten_errors_of(rows)
        own = own / (lengths := np.linalg.norm(own, axis=0))
        shown = orthogonal[sweep].T @ own
        remaining_gram = own.T @ own - shown.T @ shown
        # else only this part shows some value
        if np.linalg.eigvalsh(remaining_gram)[0] > 1e-9:
            left_out[rows] = np.linalg.solve(remaining_gram, own.T @ whitened[sweep]) / lengths
    return left_out


def _refuse_unobservable(dwells: Dwells, effects: Sequence[Effect]) -> None:
    thermal = [effect.name for effect in effects if 'temperature' in effect.inputs]
    if not thermal:
        return
    unseen = f'{", ".join(thermal)} cannot be seen'
    if dwells.temperature is None:
        raise DataRefused(f'{unseen}: the log holds no temperature; record temperature_degc too')
    spread = float(np.ptp(dwells.temperature))
    if spread < MIN_TEMPERATURE_SPREAD:
        raise DataRefused(
            f'{unseen}: the temperature varies by {spread:.2g} K, wanted at least '
            f'{MIN_TEMPERATURE_SPREAD:g} K; repeat the rates at another temperature')


@dataclass(frozen=True)
class _Bin:
    """Dwells of nearly one rate, or nearly one temperature."""

    low: float  # in the unit of what was binned
    high: float
    count: int  # of dwells
    uncorrected: float  # mean error without the model, rad/s
    residual: float  # and with it
    deviation: float  # standard deviation of the mean residual, rad/s
    rms: float  # of the residual, rad/s


def bin_errors(fit: Calibration, values: Array) -> list[_Bin]:
    """Return the errors over one quantity, shape (n,), in non-empty bins of equal width."""
    dwells, found = fit.dwells, []
    for low, high, within in equal_bins(values, 8):
        chosen = within & fit.scatter.inliers
        if chosen.any():
            part, residual = select_dwells(dwells, chosen), fit.residual[chosen]
            found.append(_Bin(low, high, len(part), float((part.output - part.rate).mean()),
                              float(residual.mean()), fit.scatter.mean_deviation(part),
                              rms(residual)))
    return found


def equal_bins(values: Array, max_bins: int) -> Iterator[tuple[float, float, Mask]]:
    """Give the ends of bins of equal width, at most one for each value, and what they hold."""
    edges = np.linspace(values.min(), values.max(), min(max_bins, len(np.unique(values))) + 1)
    place = np.clip(np.searchsorted(edges, values, side='right') - 1, 0, len(edges) - 2)
    for number, (low, high) in enumerate(zip(edges.tolist(), edges[1:].tolist())):
        yield low, high, place == number


# errors of full turns

@dataclass(frozen=True)
class TurnErrors:
    """Errors of full turns, counter-clockwise positive as the heading is."""

    turns: Dwells  # their dwells
    static: Array  # with the static bias only, rad per turn, shape (n,)
    modelled: Array  # with the model, and the static bias after it, rad per turn, shape (n,)
    # on the source of the static bias, and on turns without an error, one sentence each
    remarks: tuple[str, ...] = ()


def compute_turn_errors(dwells: Dwells, rate: Array,
                        min_rate: float = MIN_TURN_RATE) -> TurnErrors:
    """
    Return the errors of full turns at the rates and temperatures of dwells that are not outlying.

    The rates by the model, rad/s, (n,), are nan where it has none; turns are faster than
    `min_rate`.
    """
    known = np.isfinite(rate)
    wanted = np.abs(dwells.rate) >= min_rate * (1.0 - 1e-6)  # text is rounded
    lost = int(np.count_nonzero(~known & wanted))
    dwells, rate, wanted = select_dwells(dwells, known), rate[known], wanted[known]
    if not wanted.any():
        raise DataRefused(f'none of {len(known)} dwells turns at {min_rate / DEGREE:g} deg/s or '
                          'faster and has a rate by the model; '
                          'record faster turns, or several sweeps')
    turns = select_dwells(dwells, wanted)
    scale = float(turns.rate @ turns.output) / float(turns.rate @ turns.rate)
    refuse_scale(scale - 1.0, 'reference', 'give or omit --invert, or turn the gyro over')
    rests, remark = _find_rests(dwells)
    # the rest of each turn's sweep, or else the nearest in temperature, then in order
    degc, at = ((np.zeros(len(each)) if each.temperature is None else each.temperature)
                for each in (dwells, turns))
    of_rest = {number: float(degc[rows].mean()) for number, rows in rests.items()}
    nearest = [rests[min(rests, key=lambda number: (
        number != sweep, abs(of_rest[number] - temperature), abs(number - sweep)))]
        for sweep, temperature in zip(turns.sweep.tolist(), at.tolist())]
    static, modelled = (
        # eq. 1 and 2, eq. 13 to 16: the integral over a turn of errors of a rate, less the bias
        (error[wanted] - [error[rows].mean() for rows in nearest])
        * 2.0 * math.pi / np.abs(turns.rate)
        for error in (dwells.output - dwells.rate, rate - dwells.rate))
    remarks = [remark]
    if lost:
        remarks.append(f'{lost} turns are left out: the other sweeps do not determine the model')
    return TurnErrors(turns, static, modelled, tuple(remarks))


def _find_rests(dwells: Dwells) -> tuple[dict[int, Numbers], str]:
    """Return the dwells at rest by the number of their sweep (eq. 1), and a remark on them."""
    at_rest = np.flatnonzero(np.abs(dwells.rate) <= 0.1 * DEGREE)
    if not len(at_rest):
        raise DataRefused(f'{len(dwells)} dwells hold no rest, so that nothing shows the static '
                          'bias; record a rest before each sweep')
    found = {number: at_rest[dwells.sweep[at_rest] == number]
             for number in np.unique(dwells.sweep[at_rest]).tolist()}
    remark, sweeps = 'the static bias is from the rest of each sweep', len(np.unique(dwells.sweep))
    if others := sweeps - len(found):
        remark += (f'; {others} of {sweeps} sweeps have none and take that of the nearest '
                   'temperature')
    return found, remark
