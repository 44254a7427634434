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
The diagnosis of a rate table, a log without time whose rows are dwells.

Effects of a model that are not refitted are subtracted from the output first. A polynomial of the
output is not refitted: together with effects of the rate it would explain the dwells by itself,
because output less rate is the error to be explained.

"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
import math

from gyro_calibration.calibration.dwells import (
    Dwells,
    dwells_from_table,
    format_list,
    MIN_TEMPERATURE_SPREAD,
    select_dwells,
)
from gyro_calibration.calibration.rate_table import (
    Calibration,
    channels_of,
    equal_bins,
    fit_effects,
    sensitivity_columns,
)
from gyro_calibration.calibration.scatter import (
    cross_validation_parts,
    MIN_SWEEPS,
    Scatter,
    surface_dof,
    Uncertainty,
    Whitener,
)
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
from gyro_calibration.diagnosis.causes import add_remedies, CAUSES, make_finding
from gyro_calibration.diagnosis.data_quality import inspect_record, resolve_unit
from gyro_calibration.diagnosis.extended_model import (
    gain_from_squares,
    HEADING_WINDOW,
    origin_notes,
    previous_origins,
    widen_range,
)
from gyro_calibration.diagnosis.findings import (
    Curve,
    Diagnosis,
    Estimate,
    Finding,
    Gain,
    OnProgress,
    Unexplained,
)
from gyro_calibration.diagnosis.gates import refuse_unusable
from gyro_calibration.diagnosis.words import format_amount
from gyro_calibration.logs.log import Array, DataRefused, DEGREE, Log, NORMAL_QUANTILE_975
from gyro_calibration.model.effects import (
    BIAS,
    BIAS_TEMPERATURE,
    BIAS_TEMPERATURE_QUADRATIC,
    Channels,
    CUBIC_NONLINEARITY,
    Effect,
    SATURATION,
    SCALE_FACTOR_ERROR,
    SCALE_FACTOR_TEMPERATURE,
    SINE_RESPONSE,
    STATIC_EFFECTS,
)
from gyro_calibration.model.gyro_model import GyroModel, Term
from gyro_calibration.model.noise import Noise
import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg import block_diag
from scipy.stats import f as fisher
from scipy.stats import norm
from scipy.stats import t as student

#: Fitted in any case.
NUISANCE_EFFECTS = (BIAS, SCALE_FACTOR_ERROR)
_METHOD_TEXT = (
    'The rates and temperatures of the dwells were simulated, and the difference of measured and '
    'simulated outputs was compared with the effects of rate and temperature. The scatter of '
    'dwells and sweeps was estimated by restricted likelihood about a smooth surface. An effect '
    'was taken if it predicts left-out sweeps better and is improbable by chance: of tables '
    'without any cause, {share:.2g} % give an alarm. Then curves over rate, temperature and the '
    'order of the dwells were tested on the residual. The reduction of the error was measured on '
    'held-out sweeps; intervals are of 95 %.')


def diagnose_table(table: Log | Dwells, model: GyroModel | None, false_alarm_rate: float = 0.01,
                   on_progress: OnProgress = lambda share, words: None) -> Diagnosis:
    """
    Find the causes of the difference between a simulation and the dwells of a rate table.

    Parameters
    ----------
    table : a log without time, or its dwells
    model : that is tested; None is an ideal gyro with the best bias and scale factor
    false_alarm_rate : false alarms per table
    on_progress : is called with the share of the work done and the name of the step that begins

    Raises
    ------
    DataRefused : the dwells do not allow an answer

    """
    on_progress(0.0, 'search for causes')
    dwells = table if isinstance(table, Dwells) else dwells_from_table(table)
    log = Log(output=dwells.output, reference_rate=dwells.rate, temperature=dwells.temperature)
    refuse_unusable(log, model)
    if not np.ptp(dwells.rate) > 0.0:
        raise DataRefused('all dwells have one rate, which does not separate scale factor and '
                          'bias; record several rates, both ways')
    record = resolve_unit(inspect_record(log, model))
    dwells = replace(dwells, output=dwells.output * record.unit_factor)
    named = name_causes(dwells, model, false_alarm_rate)
    structures, gains = find_structure(named, 0.2 * false_alarm_rate)
    # structure along the variable of a cause, above a tenth of what that explains
    withdrawn = frozenset(
        effect.name for effect in named.causes if effect not in NUISANCE_EFFECTS
        and any(gain > 0.1 * _misfit_reduction(named, effect) for name, gain in gains.items()
                if CAUSES[effect.name].along in name.split('_times_')))
    if withdrawn:
        named = name_causes(dwells, model, false_alarm_rate, withdrawn)
        structures, _ = find_structure(named, 0.2 * false_alarm_rate)
    gain = (_cross_validated_gain(dwells, model, false_alarm_rate, withdrawn, on_progress)
            if named.causes else None)
    on_progress(0.97, 'findings')
    before = simulation_under_test(dwells, model, named)
    offered = bool(named.causes) and not (gain is not None and gain.is_worse)
    after = assemble_model(dwells, model, named.fit) if offered else before
    strongest_first = sorted(named.causes, key=lambda each: -_misfit_reduction(named, each))
    outliers = _outlier_findings(dwells, named.fit, 0.05 * false_alarm_rate)
    findings = add_remedies([*record.findings, *outliers, *(
        _cause_finding(named, effect) for effect in strongest_first)], {}, after)
    if after is not before:
        notes = origin_notes(findings, [record.unit_factor])
        after = replace(after, origin={**after.origin, **notes})
    return Diagnosis(
        tuple(findings), structures, Noise(),
        Noise() if model is None else model.noise, gain, before, after, _untestable_causes(dwells),
        error_curves(dwells, named.fit.scatter, before, after),
        remarks=(*record.remarks, *dwells.remarks,
                 *_remarks(dwells, model, named, structures, withdrawn, gain, offered)),
        false_alarm_rate=false_alarm_rate,
        method=_METHOD_TEXT.format(share=100.0 * false_alarm_rate))


# the steps

def _cross_validated_gain(dwells: Dwells, model: GyroModel | None, false_alarm_rate: float,
                          withdrawn: frozenset[str], on_progress: OnProgress) -> Gain | None:
    """Return the gain on sweeps left out of selection and fit in turn; None if not possible."""
    parts = cross_validation_parts(dwells)
    count = min(8, int(parts.max()) + 1)  # of groups of sweeps, for the computing time
    groups = parts * count // (parts.max() + 1)
    errors = {name: np.full(len(dwells), np.nan) for name in ('given', 'plain', 'extended')}
    for number in range(count):
        on_progress((number + 1) / (count + 2), f'cross-validation, part {number + 1} of {count}')
        hidden = groups == number
        rest, left_out = select_dwells(dwells, ~hidden), select_dwells(dwells, hidden)
        try:
            named = name_causes(rest, model, false_alarm_rate, withdrawn)
            models = (model or GyroModel(), simulation_under_test(rest, None, named),
                      assemble_model(rest, model, named.fit))
        except DataRefused:
            continue
        for each, error in zip(models, errors.values()):
            error[hidden] = left_out.output - simulate_output(each, left_out)
    known = np.isfinite(errors['extended'])
    if not known.any():
        return None
    part_numbers = np.unique(parts[known], return_inverse=True)[1]
    what = 'sweeps' if len(np.unique(dwells.sweep)) >= MIN_SWEEPS else 'consecutive dwells'
    # the heading error of a turn over the window at the rate of a dwell
    squares = {name: np.outer(np.bincount(part_numbers, error[known] ** 2),
                              [1.0, HEADING_WINDOW ** 2]) for name, error in errors.items()}
    return gain_from_squares(f'{what} left out, each of {count} groups in turn',
                             squares, np.outer(np.bincount(part_numbers), [1, 1]),
                             'plain' if model is None else 'given', HEADING_WINDOW)


def _outlier_findings(dwells: Dwells, fit: Calibration, level: float) -> Iterator[Finding]:
    """Give outlying dwells, if the largest deviation from a fit to the others is significant."""
    outlying = np.flatnonzero(~fit.scatter.inliers)
    freedom = surface_dof(select_dwells(dwells, fit.scatter.inliers))
    if not len(outlying) or min(freedom, fit.dof) < 1:
        return
    # in standard deviations about a fit without them
    used, shared = select_dwells(dwells, fit.scatter.inliers), fit.scatter.sweep_columns(dwells)
    columns = Whitener(used, fit.scatter).whiten(sensitivity_columns(used, fit.terms))
    of_fit = sensitivity_columns(dwells, fit.terms) @ np.linalg.pinv(columns)
    deviation = np.sqrt(fit.scatter.deviation(dwells) ** 2 + np.sum(shared ** 2, axis=1)
                        + np.sum(of_fit ** 2, axis=1))
    sigmas = (np.abs(fit.residual) / deviation)[outlying]
    chance = min(1.0, len(dwells) * 2.0 * float(student.sf(sigmas.max(), freedom)))
    if chance < level:
        places = format_list([dwells.location[row] for row in outlying])
        yield make_finding(
            'outliers', {'outliers': Estimate.from_half_width(float(len(outlying)), 0.0, '1')},
            chance, cause=CAUSES['outliers'].sentence.replace('samples', 'dwells'),
            evidence=f'{len(outlying)} of {len(dwells)} dwells are up to '
            f'{sigmas.max():.0f} sigma from the others: {places}', along='rate')


# causes that dwells support

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
    return fit_effects(dwells, effects, named.fit.scatter).model


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


def find_structure(named: NamedCauses, false_alarm_rate: float,
                   ) -> tuple[tuple[Unexplained, ...], dict[str, float]]:
    """
    Search for structure in the residual of a fit; errors by the model's values are none.

    Returns
    -------
    structure without a name, the most significant first, and the reduction of the sum of the
    whitened squared residuals by each

    """
    fit, by_model = named.fit, model_uncertainty(named.fit, named.model)
    curves = {name: columns
              for name, columns in _structure_curves(fit.used).items() if columns.shape[1]}
    known, curve_count = sensitivity_columns(fit.used, fit.terms), len(curves)
    found, gains = [], {}
    while curves:
        best, gain = min((_test_curve(name, fit, known, columns, by_model)
                          for name, columns in curves.items()),
                         key=lambda each: (each[0].p_value, -each[1]))
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
    known = whitener.whiten(known)
    left, sizes, _ = np.linalg.svd(known / np.linalg.norm(known, axis=0), full_matrices=False)
    known_basis = left[:, sizes > 1e-6 * sizes[0]]
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


def _structure_curves(dwells: Dwells) -> dict[str, Array]:
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


# findings

def _misfit_reduction(named: NamedCauses, effect: Effect) -> float:
    """Return the reduction of the sum of squares by a cause."""
    if effect in NUISANCE_EFFECTS:
        change = value_change(named.fit, named.model, effect)
        return (change / named.fit.effect_deviation(effect)) ** 2
    rest = _fit_without(named, effect)
    return math.inf if rest is None else rest.misfit - named.change_fit.misfit


def _fit_without(named: NamedCauses, effect: Effect) -> Calibration | None:
    fit, change = named.change_fit, named.change_effect(effect)
    return try_fit(fit, [each for each in fit.effects if each is not change])


def _cause_finding(named: NamedCauses, effect: Effect) -> Finding:
    others, separate_by = find_alternatives(named.fit, effect)
    along = {'along': 'temperature_while_turning'} if effect is SCALE_FACTOR_TEMPERATURE else {}
    own = _model_values(named, effect)
    # what is added to the model's values
    estimates = {parameter.name: Estimate.from_half_width(
        value - own[effect.parameters.index(parameter)], NORMAL_QUANTILE_975 * deviation,
        parameter.unit) for name, parameter, value, deviation in named.fit.model.estimates()
        if name == effect.name}
    return make_finding(effect.name, estimates, named.p_value(effect), others,
                        minimum_detectable=_minimum_detectable(named, effect),
                        separate_by=separate_by, evidence=_evidence_sentence(named, effect),
                        **along)


def _model_values(named: NamedCauses, effect: Effect) -> tuple[float, ...]:
    """Return the values that the model has of an effect, 0 where it has none."""
    return next((term.values for term in named.model.terms if term.effect is effect),
                (0.0,) * len(effect.parameters))


def _minimum_detectable(named: NamedCauses, effect: Effect) -> float | None:
    """Return the minimum detectable size of an effect, in the unit of its first value."""
    fit, change = named.change_fit, named.change_effect(effect)
    level = significance_level(named.false_alarm_rate, effect in NUISANCE_EFFECTS)
    if effect in NUISANCE_EFFECTS:
        return _detectable_size(named.fit, effect, level)
    if effect not in (SINE_RESPONSE, CUBIC_NONLINEARITY):
        return _detectable_size(fit, change, level)
    # A small sine response equals -k² w³ / 6.
    cubic = try_fit(fit, replace_effect(fit.effects, change, CUBIC_NONLINEARITY))
    if cubic is None:
        return None
    size, own = (_detectable_size(cubic, CUBIC_NONLINEARITY, level),
                 _model_values(named, SINE_RESPONSE)[0])
    return size if effect is CUBIC_NONLINEARITY else math.sqrt(own ** 2 + 6.0 * size) - own


def _detectable_size(fit: Calibration, effect: Effect, level: float) -> float:
    """Return the size of a value that is found with a probability of 95 %."""
    place, uncertainty = fit.last_index(effect), fit.uncertainty
    variance = np.tensordot(uncertainty.weights, uncertainty.covariances, axes=1)[place, place]
    return float(uncertainty.half_width(1.0 - level)[place]
                 + norm.ppf(0.95) * math.sqrt(variance))


def _evidence_sentence(named: NamedCauses, effect: Effect) -> str:
    sigmas = f'{math.sqrt(max(_misfit_reduction(named, effect), 0.0)):.1f} sigma from zero'
    if effect in NUISANCE_EFFECTS:
        parameter = effect.parameters[-1]
        change = format_amount(value_change(named.fit, named.model, effect), parameter.unit,
                               parameter.name)
        return f'it differs from that of the model by {change}; {sigmas}'
    rest = _fit_without(named, effect)
    if rest is None:
        return ''
    return (f'without it, left-out sweeps are predicted to {rest.left_out_rms / DEGREE:.3g} '
            f'deg/s, with it to {named.change_fit.left_out_rms / DEGREE:.3g} deg/s; {sigmas}')


# remarks


def _remarks(dwells: Dwells, model: GyroModel | None, named: NamedCauses,
             structures: Sequence[Unexplained], withdrawn: frozenset[str], gain: Gain | None,
             offered: bool) -> Iterator[str]:
    scatter = named.fit.scatter
    if withdrawn:
        yield (f'Not named: {", ".join(sorted(withdrawn))}: along the same '
               'variable, much structure is left without a name.')
    if named.causes and not offered:
        yield ('The errors of the extended model for left-out dwells are larger than those of the '
               'simulation; it is not offered.')
    if gain is not None:
        yield (f'Heading errors are the errors of dwells integrated over {HEADING_WINDOW:g} s.')
    if any(each.along == 'single_rates' for each in structures):
        yield ('Errors that repeat at single rates may belong to the table, or to the position '
               'within a sweep if all sweeps have the same order.')
    yield (f'Dwells scatter by {scatter.dwell_bias / DEGREE:.2g} deg/s and '
           f'{100.0 * scatter.dwell_scale:.2g} % of the rate, sweeps by '
           f'{scatter.sweep_bias / DEGREE:.2g} deg/s in bias and '
           f'{100.0 * scatter.sweep_scale:.2g} % in scale factor.')
    if model is None:
        return
    known = visible_terms(model)
    unseen = [term.effect.name for term in model.terms if term not in known]
    if unseen:
        yield (f'Dwells without time do not show {", ".join(unseen)}; these effects of the model '
               'are unchanged.')
    if (any(term.effect.inputs & {'temperature'} for term in known)
            and dwells.temperature is None):
        yield ('The table holds no temperature; the model is simulated at '
               f'{model.reference_temperature:g} degC.')


# what cannot be shown

_AVERAGED_REASON = 'a dwell is a mean at a constant rate; record samples with their time'
_NO_TIME_REASON = 'a table without time does not show what changes with time; record a log in time'
#: Cause, or the variable along which it shows -> why a table does not show it.
_UNTESTABLE_REASONS = {
    'dead_zone': _AVERAGED_REASON, 'saturation': _AVERAGED_REASON,
    'reference_scale':
        'only a second reference separates the scale of the first from that of the gyro',
    'rate_change':
        'at constant rates a delay has no effect; record fast reversals with their time',
    'temperature_rate': _NO_TIME_REASON, 'time': _NO_TIME_REASON,
    'frequency': _AVERAGED_REASON, 'output': _AVERAGED_REASON,
    'heading':
        'whole turns average over all headings; record reference_heading_deg in time',
    **dict.fromkeys(('specific_force', 'vibration'),
                    'only rates and temperatures of a table are evaluated; record '
                    'acceleration_mps2 in several poses, with time'),
    'supply': 'only rates and temperatures of a table are evaluated; record supply_v with time'}


def _untestable_causes(dwells: Dwells) -> dict[str, str]:
    """Return the causes that the table cannot show, with the reasons."""
    found = {name: _UNTESTABLE_REASONS.get(name) or _UNTESTABLE_REASONS[cause.along]
             for name, cause in CAUSES.items()
             if name not in {*STATIC_EFFECTS, 'outliers', 'unit_error'}}
    thermal = [name for name, effect in STATIC_EFFECTS.items() if 'temperature' in effect.inputs]
    if dwells.temperature is None:
        return {**found, **dict.fromkeys(
            thermal, 'the table holds no temperature; record temperature_degc')}
    if np.ptp(dwells.temperature) < MIN_TEMPERATURE_SPREAD:
        return {**found, **dict.fromkeys(
            thermal, f'the temperature varies by {np.ptp(dwells.temperature):.2g} K only; repeat '
            'the rates at another temperature')}
    return found


# curves

def error_curves(dwells: Dwells, scatter: Scatter, before: GyroModel,
                 after: GyroModel) -> tuple[Curve, ...]:
    """Return the errors of dwells, without outliers, along rate, temperature and their order."""
    used = select_dwells(dwells, scatter.inliers)
    ones = np.ones(len(used))
    variables = [('rate', 'rad/s', used.rate, ones),
                 ('order_of_dwells', '', np.arange(1.0, len(used) + 1.0), ones)]
    if used.temperature is not None and np.ptp(used.temperature) > 0.0:
        # A scale factor that changes with temperature averages out over turns both ways, unless
        # errors count in the sense of the turn.
        variables += [('temperature', 'degC', used.temperature, ones),
                      ('temperature_while_turning', 'degC', used.temperature, np.sign(used.rate))]
    outputs = [simulate_output(model, used) for model in (before, after)]
    errors = np.array([used.output - outputs[0], used.output - outputs[1],
                       outputs[0] - used.rate])
    found = []
    for along, unit, values, sign in variables:
        masks = [within & (sign != 0.0) for _, _, within in equal_bins(
            values, max(1, min(40, len(values) // 4)))]
        masks = [mask for mask in masks if mask.any()]
        at, *means = (np.array([float(each[mask].mean()) for mask in masks])
                      for each in (values, *sign * errors))
        deviation = np.array([scatter.mean_deviation(select_dwells(used, mask), sign[mask])
                              for mask in masks])
        found.append(Curve(along, unit, at, means[0], means[1], deviation, means[2]))
    return tuple(found)


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
