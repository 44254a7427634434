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

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
import math

from gyro_calibration.calibration.dwells import (
    Dwells, dwells_from_table, format_list, MIN_TEMPERATURE_SPREAD, select_dwells)
from gyro_calibration.calibration.rate_table import (
    Calibration, channels_of, CONFOUNDERS, equal_bins, fit_effects, replaced_term,
    sensitivity_columns, static_terms, value_owners)
from gyro_calibration.calibration.scatter import cross_validation_parts, MIN_SWEEPS, surface_dof
from gyro_calibration.calibration.selection import (
    BASIC_EFFECTS, distinguishing_rate, FALSE_ALARM_RATE, find_supported_effects,
    MIN_DISTINGUISHING_SIGMAS, resolve_confounders, TECHNOLOGY_EFFECTS, try_fit, try_replace)
from gyro_calibration.diagnosis.causes import (
    Cause, cause_finding, CAUSES, REFERENCES, sized_finding, untestable_causes)
from gyro_calibration.diagnosis.data_quality import inspect_record
from gyro_calibration.diagnosis.extended_model import (
    complete_diagnosis, gain_from_errors, HEADING_WINDOW, previous_origins, widen_range)
from gyro_calibration.diagnosis.findings import (
    Curve, DETECTION_POWER, Diagnosis, Estimate, Finding, Gain, MIN_PREDICTION_SIGMAS, OnProgress,
    prediction_sigmas, SEARCH_ALARM_RATE, Unexplained, VALUE_ALARM_RATE)
from gyro_calibration.diagnosis.gates import examine_log, mismatch_diagnosis
from gyro_calibration.logs.log import Array, DataRefused, DEGREE, Log, NORMAL_QUANTILE_975
from gyro_calibration.model.effects import (
    BIAS, BIAS_TEMPERATURE, BIAS_TEMPERATURE_QUADRATIC, CATALOGUE, CUBIC_NONLINEARITY, Effect,
    SCALE_FACTOR_ERROR, SCALE_FACTOR_TEMPERATURE, SINE_RESPONSE, STATIC_EFFECTS)
from gyro_calibration.model.gyro_model import GyroModel, Term
from gyro_calibration.model.noise import Noise
import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg import block_diag
from scipy.stats import norm
from scipy.stats import t as student

_METHOD_TEXT = (
    'The rates and temperatures of the dwells were simulated, and the difference of measured and '
    'simulated outputs was compared with the effects of rate and temperature. The scatter of '
    'dwells and sweeps was estimated by restricted likelihood about a smooth surface. An effect '
    'was taken if it predicts left-out sweeps better and is improbable by chance: of tables '
    'without any cause, {share:.2g} % give an alarm. It is established, and in the model, if it '
    'predicts them better beyond the scatter between sweeps. Then curves over rate, temperature '
    'and the order of the dwells were tested on the residual. The reduction of the error was '
    'measured on held-out sweeps; intervals are of 95 %.')


def diagnose_table(table: Log | Dwells, model: GyroModel | None,
                   on_progress: OnProgress = lambda share, words: None) -> Diagnosis:
    """
    Find the causes of the difference between a simulation and the dwells of a rate table.

    Parameters
    ----------
    table : a log without time, or its dwells
    model : that is tested; None is an ideal gyro with the best bias and scale factor
    on_progress : is called with the share of the work done and the name of the step that begins

    Raises
    ------
    DataRefused : the dwells do not allow an answer

    """
    on_progress(0.0, 'search for causes')
    dwells = table if isinstance(table, Dwells) else dwells_from_table(table)
    log = Log(output=dwells.output, reference_rate=dwells.rate, temperature=dwells.temperature)
    gates = examine_log(log, model)
    if not np.ptp(dwells.rate) > 0.0:
        raise DataRefused('all dwells have one rate, which does not separate scale factor and '
                          'bias; record several rates, both ways')
    if (mismatch := mismatch_diagnosis(gates, model)) is not None:
        return mismatch
    record = inspect_record(log, model)
    named = _name_causes(dwells, model)
    structures, gains = _find_structure(named.fit)
    # structure along the variable of a cause, above a tenth of what that explains
    withdrawn = frozenset(
        effect for effect in named.without if effect not in BASIC_EFFECTS
        and any(gain > 0.1 * named.misfit_reduction(effect) for name, gain in gains.items()
                if CAUSES[effect.name].along in name.split('_times_')))
    if withdrawn:
        named = _NamedCauses.of(named.fit, model, withdrawn)
        structures, _ = _find_structure(named.fit)
    gain = (_cross_validated_gain(dwells, model, withdrawn, on_progress)
            if named.without else None)
    on_progress(0.97, 'findings')
    before = model or named.plain_model
    offered = bool(named.without) and not (gain is not None and gain.is_worse)
    after = _assemble_model(model, named.established_fit) if offered else before
    strongest_first = sorted(named.without, key=lambda each: -named.misfit_reduction(each))
    findings = [*record.findings, *_outlier_findings(named.fit),
                *(_cause_finding(named, effect) for effect in strongest_first)]
    return complete_diagnosis(Diagnosis(
        tuple(findings), structures, Noise(),
        Noise() if model is None else model.noise, gain, before, after, _untestable_causes(dwells),
        _error_curves(named.fit, before, after),
        remarks=(*record.remarks, *dwells.remarks,
                 *_remarks(dwells, model, named, structures, withdrawn, gain)),
        method=_METHOD_TEXT.format(share=100.0 * FALSE_ALARM_RATE), gates=gates))


# the steps

def _cross_validated_gain(dwells: Dwells, model: GyroModel | None, withdrawn: frozenset[Effect],
                          on_progress: OnProgress) -> Gain | None:
    """Return the gain on sweeps left out of selection and fit in turn; None if not possible."""
    parts = cross_validation_parts(dwells)
    count = min(8, int(parts.max()) + 1)  # of groups of sweeps, for the computing time
    groups = parts * count // (parts.max() + 1)
    errors = {name: np.full(len(dwells), np.nan) for name in ('given', 'plain', 'extended')}
    for number in range(count):
        if on_progress((number + 1) / (count + 2),
                       f'cross-validation, part {number + 1} of {count}'):
            break
        hidden = groups == number
        rest, left_out = select_dwells(dwells, ~hidden), select_dwells(dwells, hidden)
        try:
            named = _name_causes(rest, model, withdrawn)
            models = (model or GyroModel(), named.plain_model,
                      _assemble_model(model, named.established_fit))
        except DataRefused:
            continue
        for each, error in zip(models, errors.values()):
            error[hidden] = left_out.output - _simulate_output(each, left_out)
    known = np.isfinite(errors['extended'])
    if not known.any():
        return None
    what = 'sweeps' if len(np.unique(dwells.sweep)) >= MIN_SWEEPS else 'consecutive dwells'
    # the heading error of a turn over the window at the rate of a dwell
    of_parts = [{name: (error[rows], HEADING_WINDOW * error[rows])
                 for name, error in errors.items()}
                for rows in (known & (parts == part) for part in np.unique(parts[known]))]
    return gain_from_errors(f'{what} left out, each of {count} groups in turn', of_parts,
                            'plain' if model is None else 'given', HEADING_WINDOW)


def _outlier_findings(fit: Calibration) -> Iterator[Finding]:
    """Give outlying dwells, if the largest deviation from a fit to the others is significant."""
    outlying, freedom = ~fit.scatter.inliers, surface_dof(fit.used)
    if not outlying.any() or min(freedom, fit.dof) < 1:
        return
    dwells = select_dwells(fit.dwells, outlying)
    sigmas = np.abs(fit.residual[outlying]) / np.sqrt(np.diag(fit.prediction_covariance(dwells)))
    chance = min(1.0, len(fit.dwells) * 2.0 * float(student.sf(sigmas.max(), freedom)))
    if chance < 0.05 * FALSE_ALARM_RATE:
        yield sized_finding(
            'outliers', len(dwells), 0.0, chance,
            cause=CAUSES['outliers'].sentence.replace('samples', 'dwells'),
            evidence=f'{len(dwells)} of {len(fit.dwells)} dwells are up to '
            f'{sigmas.max():.0f} sigma from the others: {format_list(dwells.location)}',
            along='rate')


# causes that dwells support

@dataclass(frozen=True)
class _NamedCauses:
    """Causes that dwells support on top of a model."""

    fit: Calibration  # of causes, bias and scale factor to the dwells
    # named effect -> the fit with that effect as it is in the model, None if it is not possible
    without: Mapping[Effect, Calibration | None]

    @classmethod
    def of(cls, fit: Calibration, model: GyroModel | None,
           withdrawn: Collection[Effect] = ()) -> _NamedCauses:
        """Return the causes among the effects of a fit, without those that are withdrawn."""
        fit = fit.refit([each for each in fit.effects if each not in withdrawn])
        causes = [each for each in fit.effects if each not in BASIC_EFFECTS
                  or model is not None and fit.p_value(each) < VALUE_ALARM_RATE]
        values = {term.effect: term.values for term in fit.terms}
        if {BIAS_TEMPERATURE, BIAS_TEMPERATURE_QUADRATIC} <= values.keys():
            # If a parabola over temperature has its vertex near the measured ones, the slope is
            # that at the temperature which it happens to be counted from.
            origin, slope = values[BIAS_TEMPERATURE]
            temperature = np.asarray(fit.dwells.temperature)
            vertex = origin - 0.5 * slope / values[BIAS_TEMPERATURE_QUADRATIC][1]
            middle = 0.5 * (temperature.max() + temperature.min())
            if abs(vertex - middle) < np.ptp(temperature):
                causes.remove(BIAS_TEMPERATURE)
        return cls(fit, {effect: try_fit(fit, [each for each in fit.effects if each is not effect])
                         for effect in causes})

    def misfit_reduction(self, effect: Effect) -> float:
        """Return the reduction of the sum of squares by a cause."""
        rest = self.without[effect]
        return math.inf if rest is None else rest.misfit - self.fit.misfit

    def is_established(self, effect: Effect) -> bool:
        """Tell whether a cause predicts left-out sweeps better, beyond their scatter."""
        rest = self.without[effect]
        return rest is None or prediction_sigmas(0.5 * np.nan_to_num(
            rest.left_out_squares - self.fit.left_out_squares)) > MIN_PREDICTION_SIGMAS

    @property
    def established_fit(self) -> Calibration:
        """Return the fit without the causes that are only suspected."""
        return self.fit.refit([each for each in self.fit.effects
                               if each not in self.without or self.is_established(each)])

    @property
    def plain_model(self) -> GyroModel:
        """Return the best bias and scale factor of an ideal gyro."""
        basic = [each for each in BASIC_EFFECTS if each in self.fit.effects]
        return fit_effects(self.fit.dwells, basic, self.fit.scatter).model


def _name_causes(dwells: Dwells, model: GyroModel | None,
                 withdrawn: Collection[Effect] = ()) -> _NamedCauses:
    """Find the causes that dwells support on top of a model, or of an ideal gyro."""
    technology = model.gyro.get('technology') if model else None
    fit, _ = resolve_confounders(
        find_supported_effects(dwells, SEARCH_ALARM_RATE, model),
        technology if technology in TECHNOLOGY_EFFECTS else None)
    return _NamedCauses.of(fit, model, withdrawn)


def _simulate_output(model: GyroModel, dwells: Dwells) -> Array:
    """Return the output that a model has for the dwells, rad/s, shape (n,)."""
    known = replace(model, terms=tuple(static_terms(model)))
    return np.zeros(len(dwells)) + known.output_from_channels(
        channels_of(dwells, model.reference_temperature))


def _assemble_model(model: GyroModel | None, fit: Calibration) -> GyroModel:
    """Return a model with the values of a fit in place of its own, or in addition to them."""
    if model is None:
        return fit.model
    new = {replaced_term(model, term.effect) or term: term for term in fit.terms}
    terms = [new.pop(term, term) for term in model.terms]
    terms += new.values()
    temperatures = [] if fit.dwells.temperature is None else [fit.dwells.temperature]
    # the covariance of all fitted values: of model and of dwells, as if independent
    covariance, found, known = None, fit.model.covariance, model.covariance
    kept_terms = [term for term in terms if term not in fit.terms and term.fitted_indices]
    if found is not None and not (kept_terms and known is None):
        owners = [*([] if known is None else value_owners(model.terms)), *value_owners(fit.terms)]
        both = found if known is None else block_diag(known, found)
        places = [place for term in terms for place, owner in enumerate(owners) if owner is term]
        covariance = both[np.ix_(places, places)]
    # A self-calibration belongs to the old bias and scale factor of the model.
    return replace(model, terms=tuple(terms), covariance=covariance,
                   rate_range=widen_range(model.rate_range, [fit.dwells.output], True),
                   temperature_range=widen_range(model.temperature_range, temperatures, True),
                   origin=previous_origins(model), self_calibration=None)


# structure without a name

#: Largest number of columns of a curve, and least number of dwells for each.
_MAX_CURVE_COLUMNS, _MIN_DWELLS_PER_COLUMN = 9, 4


def _find_structure(fit: Calibration) -> tuple[tuple[Unexplained, ...], dict[str, float]]:
    """
    Search for structure in the residual of a fit; errors by the model's values are none.

    Returns
    -------
    structure without a name, the most significant first, and the reduction of the sum of the
    whitened squared residuals by each

    """
    dwells, parts = fit.used, cross_validation_parts(fit.used)
    # A variable that differs between sweeps alone has as many independent values as sweeps.
    slow = min(_MAX_CURVE_COLUMNS, len(np.unique(parts)) // 3)
    # a column for each rate that at least four sweeps repeat
    _, number = np.unique(np.round(_scale_to_unit_range(dwells.rate), 4), return_inverse=True)
    single = (number[:, None] == np.arange(number.max() + 1)).astype(float)
    repeated = np.array([len(np.unique(parts[column > 0.0])) >= 4 for column in single.T])
    if np.count_nonzero(repeated) * _MIN_DWELLS_PER_COLUMN > len(dwells):
        repeated[:] = False
    curves = {
        'rate': _spline_columns(
            dwells.rate, min(_MAX_CURVE_COLUMNS, len(dwells) // _MIN_DWELLS_PER_COLUMN)),
        'single_rates': single[:, repeated],
        'order_of_dwells': _spline_columns(np.arange(len(dwells)).astype(float), slow)}
    if dwells.temperature is not None and _shows_temperature(dwells):
        curves['temperature'] = _spline_columns(dwells.temperature, slow)
        rate, temperature = map(_scale_to_unit_range, (dwells.rate, dwells.temperature))
        curves['rate_times_temperature'] = np.column_stack(
            [np.zeros((len(dwells), 0)), *(rate ** i * temperature ** j for i in (1, 2, 3)
                                           for j in range(1, min(slow, 2) + 1))])
    curves = {name: columns for name, columns in curves.items() if columns.shape[1]}
    known, curve_count = sensitivity_columns(channels_of(dwells), fit.terms), len(curves)
    found, gains = [], {}
    while curves:
        tests = {name: fit.test(columns, known) for name, columns in curves.items()}
        name = min(tests, key=lambda each: (tests[each].p_value, -tests[each].gain))
        chance = min(1.0, curve_count * tests[name].p_value)
        if chance >= 0.2 * FALSE_ALARM_RATE:
            break
        found.append(Unexplained(name, tests[name].share, chance))
        gains[name] = tests[name].gain
        known = np.column_stack([known, curves.pop(name)])
    return tuple(found), gains


def _shows_temperature(dwells: Dwells) -> bool:
    return (dwells.temperature is not None
            and bool(np.ptp(dwells.temperature) >= MIN_TEMPERATURE_SPREAD))


def _scale_to_unit_range(values: Array) -> Array:
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


# findings

def _cause_finding(named: _NamedCauses, effect: Effect) -> Finding:
    fit = named.fit
    deficits, separate_by = _find_alternatives(fit, effect)
    # what is added to the model's values
    own = next((term.values for term in fit.given.terms if term.effect is effect),
               (0.0,) * len(effect.parameters))
    estimates = {parameter.name: Estimate.from_half_width(
        value - own[effect.parameters.index(parameter)], NORMAL_QUANTILE_975 * deviation,
        parameter.unit) for name, parameter, value, deviation in fit.model.estimates()
        if name == effect.name}
    rest = named.without[effect]
    evidence = '' if rest is None else (
        f'without it, left-out sweeps are predicted to {rest.left_out_rms / DEGREE:.3g} deg/s, '
        f'with it to {fit.left_out_rms / DEGREE:.3g} deg/s; '
        f'{math.sqrt(max(named.misfit_reduction(effect), 0.0)):.1f} sigma from zero')
    basic = len(BASIC_EFFECTS)
    count, rate = ((basic, basic * VALUE_ALARM_RATE) if effect in BASIC_EFFECTS
                   else (len(STATIC_EFFECTS) - basic, SEARCH_ALARM_RATE))
    # That of a sine response is by the cubic: a small one equals -k² w³ / 6.
    detectable, fitted = None, CUBIC_NONLINEARITY if effect is SINE_RESPONSE else effect
    if (by_cubic := fit if fitted is effect else try_replace(fit, effect, fitted)) is not None:
        place, uncertainty = by_cubic.last_index(fitted), by_cubic.uncertainty
        detectable = float(
            uncertainty.half_width(1.0 - rate / count)[place]
            + norm.ppf(DETECTION_POWER) * math.sqrt(uncertainty.covariance()[place, place]))
        if effect is SINE_RESPONSE:
            detectable = math.sqrt(own[0] ** 2 + 6.0 * detectable) - own[0]
    return cause_finding(effect.name, estimates, min(1.0, fit.p_value(effect) * count), deficits,
                         named.is_established(effect), minimum_detectable=detectable,
                         separate_by=separate_by, evidence=evidence,
                         along=('temperature_while_turning' if effect is SCALE_FACTOR_TEMPERATURE
                                else CAUSES[effect.name].along))


def _remarks(dwells: Dwells, model: GyroModel | None, named: _NamedCauses,
             structures: Sequence[Unexplained], withdrawn: Collection[Effect],
             gain: Gain | None) -> Iterator[str]:
    scatter = named.fit.scatter
    if withdrawn:
        yield (f'Not named: {", ".join(sorted(each.name for each in withdrawn))}: along the same '
               'variable, much structure is left without a name.')
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
    known = static_terms(model)
    unseen = [term.effect.name for term in model.terms if term not in known]
    if unseen:
        yield (f'Dwells without time do not show {", ".join(unseen)}; these effects of the model '
               'are unchanged.')
    if (any(term.effect.inputs & {'temperature'} for term in known)
            and dwells.temperature is None):
        yield ('The table holds no temperature; the model is simulated at '
               f'{model.reference_temperature:g} degC.')


# what cannot be shown

def _untestable_causes(dwells: Dwells) -> dict[str, str]:
    def needed_columns(cause: Cause) -> str:
        more = cause.required_channels - {'time', 'temperature', *REFERENCES, 'reference'}
        columns = ' and '.join(['time', *sorted(more)]).replace('_', ' ')
        return f'means at constant rates do not show it; record samples with {columns}'

    found = untestable_causes({*STATIC_EFFECTS, 'outliers', 'unit_error'}, (),
                              needed_columns)
    found['reference_scale'] = ('only a second reference separates the scale of the first from '
                                'that of the gyro')
    if not _shows_temperature(dwells):
        constant = ('the table holds no temperature; record temperature_degc'
                    if dwells.temperature is None else 'the temperature varies by '
                    f'{np.ptp(dwells.temperature):.2g} K only; repeat the rates at another one')
        found |= {name: constant for name, effect in STATIC_EFFECTS.items()
                  if 'temperature' in effect.inputs}
    return found


# curves

def _error_curves(fit: Calibration, before: GyroModel, after: GyroModel) -> tuple[Curve, ...]:
    """Return the errors of dwells, without outliers, along rate, temperature and their order."""
    used, scatter = fit.used, fit.scatter
    ones = np.ones(len(used))
    variables = [('rate', 'rad/s', used.rate, ones),
                 ('order_of_dwells', '', np.arange(1.0, len(used) + 1.0), ones)]
    if used.temperature is not None and np.ptp(used.temperature) > 0.0:
        # A scale factor that changes with temperature averages out over turns both ways, unless
        # errors count in the sense of the turn.
        variables += [('temperature', 'degC', used.temperature, ones),
                      ('temperature_while_turning', 'degC', used.temperature, np.sign(used.rate))]
    outputs = [_simulate_output(model, used) for model in (before, after)]
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


def _find_alternatives(fit: Calibration, effect: Effect) -> tuple[dict[str, float], str]:
    """Return the deficits of alternatives, and the experiment that would distinguish them."""
    experiment = CAUSES[effect.name].separate_by
    if effect in _ALWAYS_CONFOUNDED:
        return {_ALWAYS_CONFOUNDED[effect]: 0.0}, experiment
    dwells, channels = fit.used, channels_of(fit.used)
    # a curve over temperature keeps its slope
    names = [] if effect is BIAS_TEMPERATURE and BIAS_TEMPERATURE_QUADRATIC in fit.effects else [
        name for name, other in STATIC_EFFECTS.items() if other not in fit.effects]
    if not _shows_temperature(dwells):
        names = [name for name in names if 'temperature' not in STATIC_EFFECTS[name].inputs]
    if effect in (BIAS_TEMPERATURE, BIAS_TEMPERATURE_QUADRATIC):
        names += ['rate_ramp', 'warm_up']
    tried = {}  # a column for each of their shapes
    for name in names:
        other = CATALOGUE[name]
        shapes = [[fit.given.reference_temperature] if shape.default is not None
                  else np.geomspace(*shape.bounds, 60).tolist()
                  for shape in other.nonlinear_parameters]
        tried[name] = np.column_stack([
            np.asarray(Term(other, (*shape, 1.0)).error(channels)) for shape in product(*shapes)])
    if effect in CONFOUNDERS:
        fastest = float(np.abs(dwells.rate).max())
        tried['saturation'] = np.column_stack([
            np.clip(dwells.rate, -limit, limit) - dwells.rate
            for limit in (fastest * np.linspace(0.5, 0.98, 25)).tolist()])
    others, change = [each for each in fit.terms if each.effect is not effect], fit.change(effect)
    known = sensitivity_columns(channels_of(dwells), others)
    lacks = {name: 0.5 * (fit.largest_gain(change[:, None], known, change)
                          - fit.largest_gain(columns, known, change))
             for name, columns in tried.items()}
    deficits = {name: max(lack, 0.0) for name, lack in sorted(
        lacks.items(), key=lambda each: each[1]) if lack < 0.5 * MIN_DISTINGUISHING_SIGMAS ** 2}
    if effect in CONFOUNDERS and CONFOUNDERS[effect].name in deficits:
        swapped = try_replace(fit, effect, CONFOUNDERS[effect])
        rate = None if swapped is None else distinguishing_rate(fit, swapped)
        if rate is not None:
            experiment = f'add two dwells each way at {rate / DEGREE:.0f} deg/s'
    return deficits, experiment if deficits else ''
