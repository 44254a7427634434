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
Fit of dwells given a model: bias and scale factor are refitted, and causes are added.

Effects of a model that are not refitted are subtracted from the output first. A polynomial of the
output is not refitted: together with effects of the rate it would explain the dwells by itself,
because output less rate is the error to be explained.

"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
import math

from gyro_calibration.calibration.dwells import Dwells, MIN_TEMPERATURE_SPREAD
from gyro_calibration.calibration.rate_table import (
    Calibration,
    channels_of,
    fit_effects,
    sensitivity_columns,
)
from gyro_calibration.calibration.scatter import cross_validation_parts, Uncertainty, Whitener
from gyro_calibration.calibration.selection import (
    CONFOUNDERS,
    distinguishing_rate,
    fit_supported_effects,
    MIN_DISTINGUISHING_SIGMAS,
    replace_effect,
    resolve_confounders,
    TECHNOLOGY_EFFECTS,
    try_fit,
)
from gyro_calibration.diagnosis.causes import CAUSES
from gyro_calibration.diagnosis.extended_model import previous_origins, widen_range
from gyro_calibration.diagnosis.findings import Unexplained
from gyro_calibration.logs.log import Array, DEGREE
from gyro_calibration.model.effects import (
    BIAS,
    BIAS_TEMPERATURE,
    BIAS_TEMPERATURE_QUADRATIC,
    Channels,
    Effect,
    SATURATION,
    SCALE_FACTOR_ERROR,
    STATIC_EFFECTS,
)
from gyro_calibration.model.gyro_model import GyroModel, Term
import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg import block_diag
from scipy.stats import f as fisher

#: Fitted in any case.
NUISANCE_EFFECTS = (BIAS, SCALE_FACTOR_ERROR)


@dataclass(frozen=True)
class NamedCauses:
    """
    Causes that dwells support on top of a model.

    Attributes
    ----------
    fit : of causes, bias and scale factor to dwells less the effects of the model that are kept
    change_fit : the same as changes in addition to the whole model, by which causes are tested
    causes : the named effects of the fit
    model : that is tested
    false_alarm_rate : false-alarm rate of the diagnosis

    """

    fit: Calibration
    change_fit: Calibration
    causes: tuple[Effect, ...]
    model: GyroModel
    false_alarm_rate: float

    def change_effect(self, effect: Effect) -> Effect:
        """Return the change that stands for an effect of the fit: itself, or its confounder."""
        return effect if effect in self.change_fit.effects else CONFOUNDERS.get(effect, effect)

    def p_value(self, effect: Effect) -> float:
        """Return the p-value of a cause, corrected for the number of causes tried."""
        if effect in NUISANCE_EFFECTS:
            return min(1.0, _change_p_value(self.fit, self.model, effect) * len(NUISANCE_EFFECTS))
        p_value = self.change_fit.p_value(self.change_effect(effect), by_model=model_uncertainty(
            self.change_fit, self.model))
        return min(1.0, p_value * (len(STATIC_EFFECTS) - len(NUISANCE_EFFECTS)))


# a model against dwells

def model_channels(model: GyroModel, dwells: Dwells) -> Channels:
    """Return the channels of a model, at its reference temperature if the table has none."""
    channels = channels_of(dwells)
    return (channels if dwells.temperature is not None
            else replace(channels, temperature=np.full(len(dwells), model.reference_temperature)))


def simulate_output(model: GyroModel, dwells: Dwells) -> Array:
    """Return the output that a model has for the dwells, rad/s, shape (n,)."""
    known = replace(model, terms=tuple(visible_terms(model)))
    return (np.asarray(known.output_from_channels(model_channels(model, dwells)))
            + np.zeros(len(dwells)))


def visible_terms(model: GyroModel) -> list[Term]:
    """Return the effects of a model that dwells can show: of rate, output and temperature."""
    return [term for term in model.terms
            if term.effect.inputs <= {'rate', 'output', 'temperature'}
            and term.effect.distortion is None]


def _subtract_effects(dwells: Dwells, model: GyroModel, refitted: Sequence[Effect] = ()) -> Dwells:
    """Return dwells whose output is without the effects of a model that are not refitted."""
    channels, names = model_channels(model, dwells), {effect.name for effect in refitted}
    return replace(dwells, output=dwells.output - sum(
        term.error(channels) for term in visible_terms(model) if term.effect.name not in names))


# choice of causes

def name_causes(dwells: Dwells, model: GyroModel | None, false_alarm_rate: float,
                withdrawn: frozenset[str] = frozenset()) -> NamedCauses:
    """
    Find the causes that dwells support on top of a model, or of an ideal gyro.

    Parameters
    ----------
    dwells : of a rate table
    model : that is put to the test, if one was given
    false_alarm_rate : false-alarm rate of the diagnosis
    withdrawn : the names of causes that are withdrawn

    """
    tested = model or GyroModel()
    technology = tested.gyro.get('technology')
    technology = technology if technology in TECHNOLOGY_EFFECTS else None
    level = significance_level(false_alarm_rate)
    change = fit_supported_effects(
        _subtract_effects(dwells, tested), technology,
        level * (len(STATIC_EFFECTS) - len(NUISANCE_EFFECTS)))
    change = _refit(change, [each for each in change.effects if each.name not in withdrawn])
    by_model = model_uncertainty(change, tested)
    guilty = [each for each in change.effects if each not in NUISANCE_EFFECTS
              and change.p_value(each, by_model=by_model) < level]
    if BIAS_TEMPERATURE_QUADRATIC in guilty and BIAS_TEMPERATURE not in guilty:
        guilty.insert(0, BIAS_TEMPERATURE)  # a parabola needs its slope
    change = _refit(change, [each for each in change.effects
                             if each in (*NUISANCE_EFFECTS, *guilty)])
    if _is_slope_by_origin(change):
        guilty.remove(BIAS_TEMPERATURE)
    if model is None:
        return NamedCauses(change, change, tuple(guilty), tested, false_alarm_rate)
    # the changed effects as a whole, the values of the model and their changes
    own = {term.effect for term in model.terms}
    effects = tuple(CONFOUNDERS[each] if each not in own and CONFOUNDERS.get(each) in own else each
                    for each in change.effects)
    fit = fit_effects(_subtract_effects(dwells, model, effects), effects, change.scatter,
                      model.reference_temperature)
    fit, _ = resolve_confounders(fit, technology)
    level = significance_level(false_alarm_rate, is_nuisance=True)
    causes = (*(each if each in fit.effects else CONFOUNDERS[each] for each in guilty),
              *(each for each in NUISANCE_EFFECTS
                if each in fit.effects and _change_p_value(fit, model, each) < level))
    return NamedCauses(fit, change, causes, tested, false_alarm_rate)


def significance_level(false_alarm_rate: float, is_nuisance: bool = False) -> float:
    """
    Return the p-value below which one cause is named.

    Of the false-alarm rate, 65 % is for causes other than bias and scale factor, and 10 % for a
    bias and a scale factor that differ from the model's.

    """
    if is_nuisance:
        return 0.1 * false_alarm_rate / len(NUISANCE_EFFECTS)
    return 0.65 * false_alarm_rate / (len(STATIC_EFFECTS) - len(NUISANCE_EFFECTS))


def _refit(fit: Calibration, effects: Sequence[Effect]) -> Calibration:
    return (fit if len(effects) == len(fit.effects)
            else fit_effects(fit.dwells, effects, fit.scatter))


def _is_slope_by_origin(fit: Calibration) -> bool:
    """Return whether a parabola over temperature has its vertex near the measured ones."""
    values = {term.effect: term.values for term in fit.terms}
    if BIAS_TEMPERATURE_QUADRATIC not in values:
        return False
    origin, slope = values[BIAS_TEMPERATURE]
    temperature = np.asarray(fit.dwells.temperature)
    # the slope is then that at the temperature which it happens to be counted from
    vertex = origin - 0.5 * slope / values[BIAS_TEMPERATURE_QUADRATIC][1]
    return bool(abs(vertex - 0.5 * (temperature.max() + temperature.min()))
                < np.ptp(temperature))


def value_change(fit: Calibration, model: GyroModel, effect: Effect) -> float:
    """Return the change of bias or scale factor error from the model, which may have none."""
    found, own = ([term.values[-1] for term in each.terms if term.effect is effect]
                  for each in (fit, model))
    return float(sum(found) - sum(own))


def _change_p_value(fit: Calibration, model: GyroModel, effect: Effect) -> float:
    """Return the p-value of a change of bias or scale factor."""
    column = sensitivity_columns(fit.used, [each for each in fit.terms if each.effect is effect])
    return fit.p_value(effect, column[:, 0] * value_change(fit, model, effect),
                       model_uncertainty(fit, model))


def model_uncertainty(fit: Calibration, model: GyroModel) -> Array | None:
    """Return the errors of dwells by 1-sigma errors of model values, rad/s, shape (n, m)."""
    known = [term for term in visible_terms(model) if term.fitted_indices]
    if model.covariance is None or not known:
        return None
    places = _covariance_indices(model.terms)
    chosen = [place for term in known for place in places[term.effect.name]]
    sizes, directions = np.linalg.eigh(model.covariance[np.ix_(chosen, chosen)])
    channels = model_channels(model, fit.used)
    rows = [row + np.zeros(len(fit.used)) for term in known for row in term.sensitivity(channels)]
    return np.column_stack(rows) @ (directions * np.sqrt(np.maximum(sizes, 0.0)))


# models

def simulation_under_test(dwells: Dwells, model: GyroModel | None,
                          named: NamedCauses) -> GyroModel:
    """Return the simulation under test: the given model, or the best bias and scale factor."""
    effects = [each for each in NUISANCE_EFFECTS if each in named.change_fit.effects]
    if model is not None or not effects:
        return model or GyroModel()
    scatter = named.fit.scatter
    is_same = len(scatter.inliers) == len(dwells)  # the scatter is that of these dwells
    return fit_effects(dwells, effects, scatter if is_same else None).model


def assemble_model(dwells: Dwells, model: GyroModel | None, fit: Calibration) -> GyroModel:
    """Return a model with the values of a fit in place of its own, or in addition to them."""
    if model is None:
        return fit.model
    new = {term.effect.name: term for term in fit.terms}
    own = {term.effect for term in model.terms}
    # the confounder of an effect of the model may stand in its place
    kept_terms = [term for term in model.terms
                  if term.effect in fit.effects or CONFOUNDERS.get(term.effect) in own
                  or CONFOUNDERS.get(term.effect) not in fit.effects]
    kept_names = [term.effect.name for term in kept_terms]
    terms = (*(new.get(name, term) for name, term in zip(kept_names, kept_terms)),
             *(term for name, term in new.items() if name not in kept_names))
    temperatures = [] if dwells.temperature is None else [dwells.temperature]
    # A self-calibration belongs to the old bias and scale factor of the model.
    return replace(model, terms=terms, covariance=_combined_covariance(model, fit, terms),
                   rate_range=widen_range(model.rate_range, [dwells.output], True),
                   temperature_range=widen_range(model.temperature_range, temperatures, True),
                   origin=previous_origins(model), self_calibration=None)


def _combined_covariance(model: GyroModel, fit: Calibration,
                         terms: Sequence[Term]) -> Array | None:
    """Return the covariance of all fitted values: of model and of dwells, as if independent."""
    found = fit.model.covariance
    kept_terms = [term for term in terms if term.effect not in fit.effects and term.fitted_indices]
    if found is None or (kept_terms and model.covariance is None):
        return None
    known = np.zeros((0, 0)) if model.covariance is None else model.covariance
    both, places = block_diag(known, found), []
    of_model, of_fit = _covariance_indices(model.terms), _covariance_indices(fit.terms, len(known))
    for term in terms:
        places += of_fit.get(term.effect.name, []) or of_model[term.effect.name]
    return both[np.ix_(places, places)]


def _covariance_indices(terms: Sequence[Term], first: int = 0) -> dict[str, list[int]]:
    """Return the indices of the fitted values of each term in a covariance."""
    ends = np.cumsum([first, *(len(term.fitted_indices) for term in terms)]).tolist()
    return {term.effect.name: list(range(begin, end))
            for term, begin, end in zip(terms, ends, ends[1:])}


# structure without a name

#: Largest number of columns of a curve, and least number of dwells for each.
_MAX_CURVE_COLUMNS, _MIN_DWELLS_PER_COLUMN = 9, 4


def find_structure(fit: Calibration, false_alarm_rate: float,
                   by_model: Array | None) -> tuple[tuple[Unexplained, ...], Mapping[str, float]]:
    """
    Search for structure in the residual of a fit.

    Parameters
    ----------
    fit : of dwells
    false_alarm_rate : false-alarm rate
    by_model : errors of dwells by errors of the model's values, rad/s, shape (n, m), which are not
        structure

    Returns
    -------
    structure without a name, the most significant first, and the reduction of the sum of the
    whitened squared residuals by each

    """
    curves = {name: columns
              for name, columns in _structure_curves(fit.used).items() if columns.shape[1]}
    known, curve_count = sensitivity_columns(fit.used, fit.terms), len(curves)
    found, gains = [], {}
    while curves:
        tested = [_test_curve(name, fit, known, columns, by_model)
                  for name, columns in curves.items()]
        best, gain = min(tested, key=lambda each: (each[0].p_value, -each[1]))
        chance = min(1.0, curve_count * best.p_value)
        if chance >= false_alarm_rate:
            break
        found.append(replace(best, p_value=chance))
        gains[best.along] = gain
        known = np.column_stack([known, curves.pop(best.along)])
    return tuple(found), gains


def _test_curve(name: str, fit: Calibration, known: Array, columns: Array,
                by_model: Array | None) -> tuple[Unexplained, float]:
    """Return share, p-value and reduction of the misfit of a curve given the known columns."""
    whitener, error = Whitener(fit.used, fit.scatter), fit.residual[fit.scatter.inliers]
    known_basis = _orthonormal(whitener.whiten(known), 1e-6)
    white = whitener.whiten(error)
    white = white - known_basis @ (known_basis.T @ white)
    curve = whitener.whiten(columns)
    curve = curve / np.maximum(np.linalg.norm(curve, axis=0), 1e-300)
    left, sizes, _ = np.linalg.svd(curve - known_basis @ (known_basis.T @ curve),
                                   full_matrices=False)
    new_basis = left[:, sizes > 1e-3]  # what is new in the curve
    count, freedom = new_basis.shape[1], len(white) - known_basis.shape[1] - new_basis.shape[1]
    if not count or freedom < 3:
        return Unexplained(name, 0.0, 1.0), 0.0
    gain, total = float(np.sum((new_basis.T @ white) ** 2)), float(white @ white)
    share = 1.0 - (total - gain) / freedom / (total / (freedom + count))
    # Columns in their own unit, for the covariance of the dwells may be another one.
    plain = [np.apply_along_axis(whitener.restore, 0, each) for each in (known_basis, new_basis)]
    # an F test over what the scatter may be, given the errors of the model
    uncertain = Uncertainty.from_fit(fit.used, fit.scatter, np.column_stack(plain), error)
    values, covariances = uncertain.offsets[:, -count:], uncertain.covariances[:, -count:, -count:]
    if by_model is not None:
        of_model = new_basis.T @ whitener.whiten(by_model)
        covariances = covariances + of_model @ of_model.T
    squares = np.einsum('ki,ki->k', values,
                        np.linalg.solve(covariances, values[:, :, None])[:, :, 0])
    chance = float(uncertain.weights @ fisher.sf(squares / count, count, uncertain.dof))
    return Unexplained(name, min(max(share, 0.0), 1.0), chance), gain


def _orthonormal(columns: Array, tolerance: float) -> Array:
    left, sizes, _ = np.linalg.svd(columns / np.linalg.norm(columns, axis=0), full_matrices=False)
    return left[:, sizes > tolerance * sizes[0]]


def _structure_curves(dwells: Dwells) -> Mapping[str, Array]:
    """Return the columns of each curve, shape (n, m)."""
    sweeps = len(np.unique(cross_validation_parts(dwells)))
    # A variable that differs between sweeps alone has as many independent values as sweeps.
    slow = min(_MAX_CURVE_COLUMNS, sweeps // 3)
    curves = {
        'rate': _spline_columns(
            dwells.rate, min(_MAX_CURVE_COLUMNS, len(dwells) // _MIN_DWELLS_PER_COLUMN)),
        'single_rates': _rate_columns(dwells),
        'order_of_dwells': _spline_columns(np.arange(len(dwells)).astype(float), slow)}
    if dwells.temperature is not None and np.ptp(dwells.temperature) >= MIN_TEMPERATURE_SPREAD:
        curves['temperature'] = _spline_columns(dwells.temperature, slow)
        rate, temperature = (_scale_to_unit_range(each)
                             for each in (dwells.rate, dwells.temperature))
        curves['rate_times_temperature'] = np.column_stack(
            [np.zeros((len(dwells), 0)), *(rate ** i * temperature ** j for i in (1, 2, 3)
                                           for j in range(1, min(slow, 2) + 1))])
    return curves


def _scale_to_unit_range(values: Array) -> Array:
    """Return values from -1 to 1."""
    low, high = float(values.min()), float(values.max())
    return (2.0 * values - low - high) / max(high - low, 1e-300)


def _spline_columns(values: Array, max_columns: int) -> Array:
    """Return a cubic spline over values, or fewer powers where they are few, shape (n, m)."""
    count = min(max_columns, len(np.unique(np.round(_scale_to_unit_range(values), 3))) - 1)
    if count < 4:
        return _scale_to_unit_range(values)[:, None] ** np.arange(1, max(count, 0) + 1)
    inner = np.quantile(values, np.linspace(0.0, 1.0, count - 1))
    knots = np.concatenate([[inner[0]] * 3, np.unique(inner), [inner[-1]] * 3])
    return BSpline.design_matrix(values, knots, 3).toarray()


def _rate_columns(dwells: Dwells) -> Array:
    """Return a column for each rate that at least four sweeps repeat, shape (n, rates)."""
    _, number = np.unique(np.round(_scale_to_unit_range(dwells.rate), 4), return_inverse=True)
    columns = (number[:, None] == np.arange(number.max() + 1)).astype(float)
    parts = cross_validation_parts(dwells)
    repeated = np.array([len(np.unique(parts[column > 0.0])) >= 4 for column in columns.T])
    if np.count_nonzero(repeated) * _MIN_DWELLS_PER_COLUMN > len(dwells):
        return columns[:, :0]
    return columns[:, repeated]


# alternatives of a cause

#: Confounders of bias and scale factor that dwells in one pose on one table never rule out.
_ALWAYS_CONFOUNDED = {BIAS: 'acceleration_sensitivity', SCALE_FACTOR_ERROR: 'reference_scale'}


def find_alternatives(fit: Calibration, effect: Effect) -> tuple[list[str], str]:
    """Return the alternatives of an effect, and the experiment that would distinguish them."""
    experiment = CAUSES[effect.name].separate_by
    if effect in _ALWAYS_CONFOUNDED:
        return [_ALWAYS_CONFOUNDED[effect]], experiment
    whitener, term = (Whitener(fit.used, fit.scatter),
                      next(each for each in fit.terms if each.effect is effect))
    inliers = fit.scatter.inliers
    # the residual with what the effect explains
    error = whitener.whiten(fit.residual[inliers] + term.error(channels_of(fit.used)))
    known = whitener.whiten(
        sensitivity_columns(fit.used, [each for each in fit.terms if each is not term]))
    found = []
    for name, columns in _alternative_columns(fit, effect):
        misfits = []
        for column in columns:
            both = np.column_stack([known, whitener.whiten(column[inliers])])
            lengths = np.linalg.norm(both, axis=0)
            both = both / np.where(lengths > 0.0, lengths, 1.0)
            left = error - both @ np.linalg.lstsq(both, error, rcond=None)[0]
            misfits.append(float(left @ left))
        sigmas = math.sqrt(max(min(misfits) - fit.misfit, 0.0))
        if sigmas < MIN_DISTINGUISHING_SIGMAS:
            found.append((sigmas, name))
    names = [name for _, name in sorted(found)]
    other = CONFOUNDERS.get(effect)
    if other is not None and other.name in names:
        swapped = try_fit(fit, replace_effect(fit.effects, effect, other))
        rate = None if swapped is None else distinguishing_rate(fit, swapped)
        if rate is not None:
            experiment = f'add two dwells each way at {rate / DEGREE:.0f} deg/s'
    return names, experiment if names else ''


def _alternative_columns(fit: Calibration, effect: Effect) -> Iterator[tuple[str, list[Array]]]:
    """Give the causes that may stand for an effect, with columns of dwells tried one by one."""
    dwells, channels = fit.dwells, channels_of(fit.dwells)
    is_slope_of_curve = (effect is BIAS_TEMPERATURE
                         and BIAS_TEMPERATURE_QUADRATIC in fit.effects)
    for name, other in () if is_slope_of_curve else STATIC_EFFECTS.items():
        if other in fit.effects or ('temperature' in other.inputs and (
                dwells.temperature is None or np.ptp(dwells.temperature)
                < MIN_TEMPERATURE_SPREAD)):
            continue
        shapes: list[list[float]] = [[]]
        for shape in other.nonlinear_parameters:
            shapes = ([[fit.model.reference_temperature]] if shape.default is not None
                      else [[value] for value in np.geomspace(*shape.bounds, 60).tolist()])
        yield name, [np.asarray(Term(other, (*shape, 1.0)).error(channels))
                     + np.zeros(len(dwells)) for shape in shapes]
    order = np.arange(len(dwells)) / len(dwells)
    if effect in (BIAS_TEMPERATURE, BIAS_TEMPERATURE_QUADRATIC):
        yield 'rate_ramp', [order]
        yield 'warm_up', [np.exp(-order / constant) for constant in (0.05, 0.1, 0.2, 0.5)]
    if effect in CONFOUNDERS:
        assert SATURATION.distortion is not None
        yield 'saturation', [
            SATURATION.distortion(dwells.rate, order, limit) - dwells.rate
            for limit in (np.abs(dwells.rate).max() * np.linspace(0.5, 0.98, 25)).tolist()]
