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

from gyro_calibration.calibration.dwells import Dwells, select_dwells
from gyro_calibration.calibration.rate_table import (
    Calibration,
    channels_of,
    fit_effects,
    sensitivity_columns,
)
from gyro_calibration.calibration.scatter import (
    cross_validation_parts,
    MIN_TEMPERATURE_SPREAD,
    Uncertainty,
    Whitener,
)
from gyro_calibration.calibration.selection import (
    fit_supported_effects,
    MIN_DISTINGUISHING_SIGMAS,
    replace_effect,
    resolve_confounders,
    separation_sigmas,
    TECHNOLOGY_EFFECTS,
)
from gyro_calibration.diagnosis.causes import CAUSES
from gyro_calibration.diagnosis.extended_model import previous_origins, widen_range
from gyro_calibration.diagnosis.findings import Unexplained
from gyro_calibration.logs.log import Array, DataRefused, DEGREE
from gyro_calibration.model.effects import (
    BIAS,
    BIAS_TEMPERATURE,
    BIAS_TEMPERATURE_QUADRATIC,
    Channels,
    CUBIC_NONLINEARITY,
    Effect,
    SATURATION,
    SCALE_FACTOR_ERROR,
    SINE_RESPONSE,
    STATIC_EFFECTS,
)
from gyro_calibration.model.gyro_model import GyroModel, Term
import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg import block_diag
from scipy.stats import f as fisher

#: Fitted in any case.
NUISANCE_EFFECTS = (BIAS, SCALE_FACTOR_ERROR)
#: Channels of effects that dwells without time can show.
_VISIBLE_CHANNELS = {'rate', 'output', 'temperature'}
#: Shares of the false-alarm rate: for causes other than bias and scale factor, and for a bias and
#: a scale factor that differ from the model's.
_CAUSE_ALARM_SHARE, _NUISANCE_ALARM_SHARE = 0.65, 0.1
#: Trial reference temperatures of a parabola without a slope, degC, in addition to the mean and
#: the first temperature.
_USUAL_TEMPERATURES = (25.0, 20.0)


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
        return _effect_or_confounder(effect, self.change_fit)

    def p_value(self, effect: Effect) -> float:
        """Return the p-value of a cause, corrected for the number of causes tried."""
        if effect in NUISANCE_EFFECTS:
            return min(1.0, _change_p_value(self.fit, self.model, effect) * len(NUISANCE_EFFECTS))
        return min(1.0, _effect_p_value(self.change_fit, self.model, self.change_effect(effect))
                   * (len(STATIC_EFFECTS) - len(NUISANCE_EFFECTS)))


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
            if term.effect.inputs <= _VISIBLE_CHANNELS and term.effect.distortion is None]


def subtract_effects(dwells: Dwells, model: GyroModel, refitted: Sequence[Effect] = ()) -> Dwells:
    """Return dwells whose output is without the effects of a model that are not refitted."""
    channels, names = model_channels(model, dwells), {effect.name for effect in refitted}
    return replace(dwells, output=dwells.output - sum(
        term.error(channels) for term in visible_terms(model) if term.effect.name not in names))


def stated_technology(model: GyroModel) -> str | None:
    """Return the technology of the instrument, if the model states a known one."""
    stated = model.gyro.get('technology')
    return stated if stated in TECHNOLOGY_EFFECTS else None


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
    change, _ = fit_supported_effects(subtract_effects(dwells, tested), stated_technology(tested),
                                      false_alarm_rate=_CAUSE_ALARM_SHARE * false_alarm_rate)
    change = _refit_without(change, withdrawn)
    level = significance_level(false_alarm_rate)
    change, needless = _choose_temperature_origin(change, model, level)
    kept = (*NUISANCE_EFFECTS, *needless)
    guilty = tuple(each for each in change.effects
                   if each not in kept and _effect_p_value(change, tested, each) < level)
    change = _refit_without(change, frozenset(each.name for each in change.effects
                                              if each not in (*kept, *guilty)))
    if model is None:
        return NamedCauses(change, change, guilty, tested, false_alarm_rate)
    fit = _refit_changed_values(dwells, model, change)
    level = significance_level(false_alarm_rate, is_nuisance=True)
    causes = (*(_effect_or_confounder(each, fit) for each in guilty),
              *(each for each in NUISANCE_EFFECTS
                if each in fit.effects and _change_p_value(fit, model, each) < level))
    return NamedCauses(fit, change, causes, tested, false_alarm_rate)


def significance_level(false_alarm_rate: float, is_nuisance: bool = False) -> float:
    """Return the p-value below which one cause is named."""
    if is_nuisance:
        return _NUISANCE_ALARM_SHARE * false_alarm_rate / len(NUISANCE_EFFECTS)
    return _CAUSE_ALARM_SHARE * false_alarm_rate / (len(STATIC_EFFECTS) - len(NUISANCE_EFFECTS))


def _refit_without(change: Calibration, names: frozenset[str]) -> Calibration:
    """Refit without some causes."""
    kept = [each for each in change.effects if each.name not in names]
    return (change if len(kept) == len(change.effects)
            else fit_effects(change.dwells, kept, change.scatter))


def _refit_changed_values(dwells: Dwells, model: GyroModel, change: Calibration) -> Calibration:
    """Refit the changed effects as a whole, the values of the model and their changes."""
    own = {term.effect.name for term in model.terms}
    effects = tuple(
        other if (other := _confounder(each)) is not None and other.name in own - {each.name}
        else each for each in change.effects)
    fit = fit_effects(subtract_effects(dwells, model, effects), effects, change.scatter)
    fit, _ = resolve_confounders(fit, stated_technology(model))
    return with_reference_temperature(fit, model.reference_temperature)


def _confounder(effect: Effect) -> Effect | None:
    return {SINE_RESPONSE: CUBIC_NONLINEARITY, CUBIC_NONLINEARITY: SINE_RESPONSE}.get(effect)


def value_change(fit: Calibration, model: GyroModel, effect: Effect) -> float:
    """Return the change of bias or scale factor error from the model, which may have none."""
    found, own = ([term.values[-1] for term in each.terms if term.effect is effect]
                  for each in (fit, model))
    return float(sum(found) - sum(own))


def _change_p_value(fit: Calibration, model: GyroModel, effect: Effect) -> float:
    """Return the p-value of a change of bias or scale factor."""
    own = [term for term in fit.terms if term.effect is effect]
    column = sensitivity_columns(_used_dwells(fit), own)[:, 0]
    return _effect_p_value(fit, model, effect, column * value_change(fit, model, effect))


def _effect_p_value(fit: Calibration, model: GyroModel, effect: Effect,
                    added: Array | None = None) -> float:
    """
    Return the p-value of an effect, by the errors of dwells and of the model's values.

    Parameters
    ----------
    fit : of dwells given the model
    model : whose covariance is included, if it has one
    added : the effect in each fitted dwell, rad/s; None for the whole effect

    """
    if not fit.dof:
        return 1.0
    used, others = _used_dwells(fit), [term for term in fit.terms if term.effect is not effect]
    if added is None:
        added = sum(term.error(channels_of(used))
                    for term in fit.terms if term.effect is effect) + np.zeros(len(used))
    if not np.any(added):
        return 1.0
    columns = (np.column_stack([*sensitivity_columns(used, others).T, added]) if others
               else added[:, None])
    uncertain = Uncertainty.from_fit(used, fit.scatter, columns, fit.residual[fit.scatter.inliers])
    # the deviation of the last value by dwells over that by dwells and model
    whitener = Whitener(used, fit.scatter)
    inverse = np.linalg.pinv(whitener.whiten(columns / np.linalg.norm(columns, axis=0)))[-1]
    by_model = inverse @ whitener.whiten(model_uncertainty(fit, model))
    by_dwells = float(inverse @ inverse)
    of_dwells = float(np.sqrt(by_dwells / (by_dwells + by_model @ by_model)))
    below = float(uncertain.probability_below(-of_dwells)[-1])
    return 2.0 * min(below, 1.0 - below)


def _used_dwells(fit: Calibration) -> Dwells:
    return select_dwells(fit.dwells, fit.scatter.inliers)


def model_uncertainty(fit: Calibration, model: GyroModel) -> Array:
    """Return the errors of dwells by 1-sigma errors of model values, rad/s, shape (n, m)."""
    known = [term for term in visible_terms(model) if term.fitted_indices]
    if model.covariance is None or not known:
        return np.zeros((len(_used_dwells(fit)), 1))
    places = _covariance_indices(model.terms, 0)
    chosen = [place for term in known for place in places[term.effect.name]]
    sizes, directions = np.linalg.eigh(model.covariance[np.ix_(chosen, chosen)])
    channels = model_channels(model, _used_dwells(fit))
    rows = [row + np.zeros(len(_used_dwells(fit)))
            for term in known for row in term.sensitivity(channels)]
    return np.column_stack(rows) @ (directions * np.sqrt(np.maximum(sizes, 0.0)))


def _effect_or_confounder(effect: Effect, fit: Calibration) -> Effect:
    """Return the effect, or its confounder if that replaces it in a fit."""
    confounder = _confounder(effect)
    return effect if effect in fit.effects or confounder is None else confounder


def _choose_temperature_origin(fit: Calibration, model: GyroModel | None,
                               level: float) -> tuple[Calibration, tuple[Effect, ...]]:
    """Return a fit with a reference temperature that needs no slope, and the unneeded effects."""
    if fit.dwells.temperature is None:
        return fit, ()
    first = (_USUAL_TEMPERATURES if model is None
             else (model.reference_temperature, *_USUAL_TEMPERATURES))
    if BIAS_TEMPERATURE_QUADRATIC in fit.effects:
        for origin in (*first, float(fit.dwells.temperature.mean()),
                       float(fit.dwells.temperature[0])):
            moved = with_reference_temperature(fit, origin)
            if moved.p_value(BIAS_TEMPERATURE) > level:
                return ((moved if model is None else with_reference_temperature(fit, first[0])),
                        (BIAS_TEMPERATURE,))
    return (fit if model is None else with_reference_temperature(fit, first[0])), ()


def with_reference_temperature(fit: Calibration, temperature: float) -> Calibration:
    """Return the same fit with another reference temperature of its effects."""
    terms = [replace(term, values=(temperature, *term.values[1:]))
             if [each.name for each in term.effect.nonlinear_parameters][:1]
             == ['reference_temperature'] else term for term in fit.terms]
    places = [place for place, term in enumerate(terms)
              if not any(shape.default is None for shape in term.effect.nonlinear_parameters)]
    channels = channels_of(fit.dwells)
    total = sum(fit.terms[place].error(channels) for place in places) + np.zeros(len(fit.dwells))
    columns = sensitivity_columns(fit.dwells, [terms[place] for place in places])
    lengths = np.linalg.norm(columns, axis=0)
    values = iter((np.linalg.lstsq(columns / lengths, total, rcond=None)[0] / lengths).tolist())
    for place in places:
        shapes = terms[place].values[:len(terms[place].effect.nonlinear_parameters)]
        terms[place] = replace(
            terms[place], values=(*shapes, *(next(values) for _ in terms[place].fitted_indices)))
    return replace(fit, terms=tuple(terms))


# models


def simulation_under_test(dwells: Dwells, model: GyroModel | None,
                          named: NamedCauses) -> GyroModel:
    """Return the simulation under test: the given model, or the best bias and scale factor."""
    effects = [each for each in NUISANCE_EFFECTS if each in named.change_fit.effects]
    if model is not None or not effects:
        return model or GyroModel()
    scatter = named.fit.scatter
    # if it is that of these dwells
    same = len(scatter.inliers) == len(dwells)
    return fit_effects(dwells, effects, scatter if same else None).model


def assemble_model(dwells: Dwells, model: GyroModel | None, fit: Calibration) -> GyroModel:
    """Return a model with the values of a fit in place of its own, or in addition to them."""
    if model is None:
        return fit.model
    new = {term.effect.name: term for term in fit.terms}
    # the confounder of an effect of the model may stand in its place
    kept_terms = [
        term for term in model.terms
        if term.effect in fit.effects or (other := _confounder(term.effect)) not in fit.effects
        or any(each.effect is other for each in model.terms)]
    own = [term.effect.name for term in kept_terms]
    terms = (*(new.get(term.effect.name, term) for term in kept_terms),
             *(term for name, term in new.items() if name not in own))
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
    of_model = _covariance_indices(model.terms, 0)
    of_fit = _covariance_indices(fit.terms, len(known))
    for term in terms:
        places += of_fit.get(term.effect.name, []) or of_model[term.effect.name]
    return both[np.ix_(places, places)]


def _covariance_indices(terms: Sequence[Term], first: int) -> dict[str, list[int]]:
    """Return the indices of the fitted values of each term in a covariance."""
    ends = np.cumsum([first, *(len(term.fitted_indices) for term in terms)]).tolist()
    return {term.effect.name: list(range(begin, end))
            for term, begin, end in zip(terms, ends, ends[1:])}


def try_fit(fit: Calibration, effects: Sequence[Effect]) -> Calibration | None:
    """Fit other effects to the dwells of a fit; None if they cannot be separated."""
    try:
        return fit_effects(fit.dwells, effects, fit.scatter)
    except DataRefused:
        return None


#: Largest number of columns of a curve.
_MAX_CURVE_COLUMNS = 9
#: Least number of dwells for each column.
_MIN_DWELLS_PER_COLUMN = 4
#: Least part of the columns of a curve that is independent of the model.
_MIN_INDEPENDENT_SHARE = 1e-3
RATE, TEMPERATURE, PRODUCT = 'rate', 'temperature', 'rate_times_temperature'
ORDER, SWEEP = 'order_of_dwells', 'sweep'
SINGLE_RATES = 'single_rates'
#: Least number of sweeps that repeat a rate for a column of that rate.
_MIN_REPEATING_SWEEPS = 4


def find_structure(fit: Calibration, false_alarm_rate: float,
                   by_model: Array) -> tuple[tuple[Unexplained, ...], Mapping[str, float]]:
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
    used = select_dwells(fit.dwells, fit.scatter.inliers)
    probes = {name: columns
              for name, columns in _structure_curves(used).items() if columns.shape[1]}
    known, error = sensitivity_columns(used, fit.terms), fit.residual[fit.scatter.inliers]
    found, gains, curve_count = [], {}, len(probes)
    while probes:
        tested = [_test_curve(name, fit, known, columns, error, by_model)
                  for name, columns in probes.items()]
        best, gain = min(tested, key=lambda each: (each[0].p_value, -each[1]))
        chance = min(1.0, curve_count * best.p_value)
        if chance >= false_alarm_rate:
            break
        found.append(replace(best, p_value=chance))
        gains[best.along] = gain
        known = np.column_stack([known, probes.pop(best.along)])
    return tuple(found), gains


def _test_curve(name: str, fit: Calibration, known: Array, columns: Array, error: Array,
                by_model: Array) -> tuple[Unexplained, float]:
    """Return share, p-value and reduction of the misfit of a curve given the known columns."""
    used = select_dwells(fit.dwells, fit.scatter.inliers)
    whitener = Whitener(used, fit.scatter)
    white = whitener.whiten(known)
    left, sizes, _ = np.linalg.svd(white / np.linalg.norm(white, axis=0), full_matrices=False)
    known_basis = left[:, sizes > 1e-6 * sizes[0]]
    white = whitener.whiten(error)
    white = white - known_basis @ (known_basis.T @ white)
    # orthonormal columns for what is new in the curve
    curve = whitener.whiten(columns)
    curve = curve / np.maximum(np.linalg.norm(curve, axis=0), 1e-300)
    left, sizes, _ = np.linalg.svd(curve - known_basis @ (known_basis.T @ curve),
                                   full_matrices=False)
    new_basis = left[:, sizes > _MIN_INDEPENDENT_SHARE]
    count, freedom = new_basis.shape[1], len(used) - known_basis.shape[1] - new_basis.shape[1]
    if not count or freedom < 3:
        return Unexplained(name, 0.0, 1.0), 0.0
    gain, total = float(np.sum((new_basis.T @ white) ** 2)), float(white @ white)
    share = 1.0 - (total - gain) / freedom / (total / (freedom + count))
    # Columns in their own unit, for the covariance of the dwells may be another one.
    plain = [np.apply_along_axis(whitener.restore, 0, each) for each in (known_basis, new_basis)]
    # an F test over what the scatter may be, given the errors of the model
    uncertain = Uncertainty.from_fit(used, fit.scatter, np.column_stack(plain), error)
    by_model = new_basis.T @ whitener.whiten(by_model)
    values = uncertain.offsets[:, -count:]
    covariances = uncertain.covariances[:, -count:, -count:] + by_model @ by_model.T
    squares = np.einsum('ki,ki->k', values,
                        np.linalg.solve(covariances, values[:, :, None])[:, :, 0])
    chance = float(uncertain.weights @ fisher.sf(squares / count, count, uncertain.dof))
    return Unexplained(name, min(max(share, 0.0), 1.0), chance), gain


# the curves

def _structure_curves(dwells: Dwells) -> Mapping[str, Array]:
    """Return the columns of each curve, shape (n, m)."""
    sweeps = len(np.unique(cross_validation_parts(dwells)))
    # A variable that differs between sweeps alone has as many independent values as sweeps.
    slow = min(_MAX_CURVE_COLUMNS, sweeps // 3)
    probes = {
        RATE: _spline_columns(
            dwells.rate, min(_MAX_CURVE_COLUMNS, len(dwells) // _MIN_DWELLS_PER_COLUMN)),
        SINGLE_RATES: _rate_columns(dwells),
        ORDER: _spline_columns(np.arange(len(dwells)).astype(float), slow),
        SWEEP: _sweep_columns(dwells)}
    if dwells.temperature is not None and np.ptp(dwells.temperature) >= MIN_TEMPERATURE_SPREAD:
        probes[TEMPERATURE] = _spline_columns(dwells.temperature, slow)
        rate = _scale_to_unit_range(dwells.rate)
        temperature = _scale_to_unit_range(dwells.temperature)
        probes[PRODUCT] = np.column_stack([rate ** i * temperature ** j
                                           for i in (1, 2, 3) for j in range(1, min(slow, 2) + 1)]
                                          or [np.zeros((len(dwells), 0))])
    return probes


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
    """Return a column for each rate that several sweeps repeat, shape (n, rates)."""
    _, number = np.unique(np.round(_scale_to_unit_range(dwells.rate), 4), return_inverse=True)
    columns = (number[:, None] == np.arange(number.max() + 1)).astype(float)
    parts = cross_validation_parts(dwells)
    repeated = np.array(
        [len(np.unique(parts[column > 0.0])) >= _MIN_REPEATING_SWEEPS for column in columns.T])
    if np.count_nonzero(repeated) * _MIN_DWELLS_PER_COLUMN > len(dwells):
        return columns[:, :0]
    return columns[:, repeated]


def _sweep_columns(dwells: Dwells) -> Array:
    """Return a parabola over rate per sweep, which no bias or scale makes, shape (n, sweeps)."""
    parts = cross_validation_parts(dwells)
    if len(dwells) < 8 * (parts.max() + 1):
        return np.zeros((len(dwells), 0))
    is_in_sweep = parts[:, None] == np.arange(parts.max() + 1)
    return is_in_sweep * (_scale_to_unit_range(dwells.rate) ** 2)[:, None]


#: Confounders of bias and scale factor that dwells in one pose on one table never rule out.
_ALWAYS_CONFOUNDED = {BIAS: 'acceleration_sensitivity', SCALE_FACTOR_ERROR: 'reference_scale'}
#: Sigmas by which proposed dwells are to separate two fits, one more than required.
_TARGET_SIGMAS = MIN_DISTINGUISHING_SIGMAS + 1.0


def find_alternatives(fit: Calibration, effect: Effect) -> tuple[list[str], str]:
    """Return the alternatives of an effect, and the experiment that would distinguish them."""
    if effect in _ALWAYS_CONFOUNDED:
        return [_ALWAYS_CONFOUNDED[effect]], CAUSES[effect.name].separate_by
    steady = [
        (sigmas, other) for other in _swapped_fits(fit, effect)
        if (sigmas := math.sqrt(max(other.misfit - fit.misfit, 0.0))) < MIN_DISTINGUISHING_SIGMAS]
    found = [(sigmas, other.effects[fit.effects.index(effect)].name) for sigmas, other in steady]
    found += [(sigmas, name) for name, columns in _unsteady_causes(fit, effect)
              if (sigmas := _advantage_sigmas(fit, effect, columns)) < MIN_DISTINGUISHING_SIGMAS]
    experiments = [_distinguishing_sweep(fit, steady[0][1])] if steady else []
    experiments += [CAUSES[effect.name].separate_by] if len(found) > len(steady) else []
    return [name for _, name in sorted(found)], '; '.join(experiments)


def _swapped_fits(fit: Calibration, effect: Effect) -> Iterator[Calibration]:
    """Give fits with another steady effect in place of one."""
    if effect is BIAS_TEMPERATURE and BIAS_TEMPERATURE_QUADRATIC in fit.effects:
        return  # the quadratic effect needs its slope
    for other in STATIC_EFFECTS.values():
        swapped = (None if other in fit.effects
                   else try_fit(fit, replace_effect(fit.effects, effect, other)))
        if swapped is not None:
            yield swapped


def _unsteady_causes(fit: Calibration, effect: Effect) -> Iterator[tuple[str, list[Array]]]:
    """Give causes other than effects of rate or temperature, with columns tried one by one."""
    rate, order = fit.dwells.rate, np.arange(len(fit.dwells)) / len(fit.dwells)
    if effect in (BIAS_TEMPERATURE, BIAS_TEMPERATURE_QUADRATIC):
        yield 'rate_ramp', [order]
        yield 'warm_up', [np.exp(-order / time_constant)
                          for time_constant in (0.05, 0.1, 0.2, 0.5)]
    if effect in (CUBIC_NONLINEARITY, SINE_RESPONSE):
        limits = np.abs(rate).max() * np.linspace(0.5, 0.98, 25)
        assert SATURATION.distortion is not None
        yield 'saturation', [SATURATION.distortion(rate, order, limit) - rate
                             for limit in limits.tolist()]


def _advantage_sigmas(fit: Calibration, effect: Effect, columns: list[Array]) -> float:
    """Return by how many sigma an effect is better than the best column with a free factor."""
    used = select_dwells(fit.dwells, fit.scatter.inliers)
    term = next(each for each in fit.terms if each.effect is effect)
    whitener = Whitener(used, fit.scatter)
    # the residual with what the effect explains
    error = whitener.whiten(
        (fit.residual + term.error(channels_of(fit.dwells)))[fit.scatter.inliers])
    known = whitener.whiten(
        sensitivity_columns(used, [each for each in fit.terms if each is not term]))
    misfits = []
    for column in columns:
        both = np.column_stack([known, whitener.whiten(column[fit.scatter.inliers])])
        lengths = np.linalg.norm(both, axis=0)
        both = both / np.where(lengths > 0.0, lengths, 1.0)
        left = error - both @ np.linalg.lstsq(both, error, rcond=None)[0]
        misfits.append(float(np.sum(left ** 2)))
    return math.sqrt(max(min(misfits) - fit.misfit, 0.0))


# experiments

def _proposed_sweeps(fit: Calibration) -> Iterator[tuple[str, Array, float]]:
    """Give sweeps that may be added, the easiest first: in words, rates, and temperature."""
    fastest = float(np.abs(fit.dwells.rate).max())
    middle = fit.model.reference_temperature
    slow = fastest * np.array([0.0, 0.02, 0.05, 0.1, 0.2])
    yield ('two dwells each way at 2, 5, 10 and 20 % of the fastest rate, and rests',
           np.tile([*slow, *-slow], 2), middle)
    for rate in (fastest * np.arange(1.0, 3.0, 0.05)).tolist():
        yield (f'two dwells each way at {rate / DEGREE:.0f} deg/s',
               np.array([rate, rate, -rate, -rate]), middle)
    if fit.dwells.temperature is not None:
        low, high = float(fit.dwells.temperature.min()), float(fit.dwells.temperature.max())
        rates = np.repeat(fastest * np.linspace(-1.0, 1.0, 9), 2)
        for beyond in (0.0, 5.0, 10.0, 20.0, 30.0):
            for temperature in (high + beyond, low - beyond):
                yield f'a sweep of 18 dwells at {temperature:.0f} degC', rates, temperature


def _distinguishing_sweep(fit: Calibration, other: Calibration) -> str:
    """Return the easiest sweep that would separate two fits, or the best one, in words."""
    tried_sweeps = []
    for words, rates, temperature in _proposed_sweeps(fit):
        tried_sweeps.append((separation_sigmas(fit, other, rates, temperature), words))
        if tried_sweeps[-1][0] >= _TARGET_SIGMAS:
            break
    sigmas, words = max(tried_sweeps)
    return (f'add {words}: that separates them by {sigmas:.1f} sigma'
            + ('' if sigmas >= _TARGET_SIGMAS else ', and repeat it'))
