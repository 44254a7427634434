# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The diagnosis of a rate table, a log without time whose rows are dwells."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
import math

from gyro_calibration.calibration.dwells import (
    Dwells,
    dwells_from_table,
    format_list,
    MIN_TEMPERATURE_SPREAD,
    select_dwells,
)
from gyro_calibration.calibration.rate_table import Calibration, equal_bins, sensitivity_columns
from gyro_calibration.calibration.scatter import (
    cross_validation_parts,
    MIN_SWEEPS,
    Scatter,
    surface_dof,
    Whitener,
)
from gyro_calibration.calibration.selection import replace_effect, try_fit
from gyro_calibration.diagnosis.causes import add_remedies, CAUSES, make_finding
from gyro_calibration.diagnosis.data_quality import inspect_record, resolve_unit
from gyro_calibration.diagnosis.dwell_fit import (
    assemble_model,
    find_alternatives,
    find_structure,
    model_uncertainty,
    name_causes,
    NamedCauses,
    NUISANCE_EFFECTS,
    significance_level,
    simulate_output,
    simulation_under_test,
    value_change,
    visible_terms,
)
from gyro_calibration.diagnosis.extended_model import (
    gain_from_squares,
    HEADING_WINDOW,
    origin_notes,
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
from gyro_calibration.logs.log import DataRefused, DEGREE, Log, NORMAL_QUANTILE_975
from gyro_calibration.model.effects import (
    CUBIC_NONLINEARITY,
    Effect,
    SCALE_FACTOR_TEMPERATURE,
    SINE_RESPONSE,
    STATIC_EFFECTS,
)
from gyro_calibration.model.gyro_model import GyroModel
from gyro_calibration.model.noise import Noise
import numpy as np
from scipy.stats import norm
from scipy.stats import t as student

_METHOD_TEXT = (
    'The rates and temperatures of the dwells were simulated, and the difference of measured and '
    'simulated outputs was compared with the effects of rate and temperature. The scatter of '
    'dwells and sweeps was estimated by restricted likelihood about a smooth surface. An effect '
    'was taken if it predicts left-out sweeps better and is improbable by chance: of tables '
    'without any cause, {share:.2g} % give an alarm. Then curves over rate, temperature and the '
    'order of the dwells were tested on the residual. The reduction of the error was measured on '
    'held-out sweeps; intervals are of 95 %.')
#: Share of the search in the computing time, measured on a table of 700 dwells; the findings take
#: the last 3 %.
_SEARCH_TIME_SHARE = 0.22


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
    named, structures, withdrawn = _conclude_causes(dwells, model, false_alarm_rate)
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

def _conclude_causes(dwells: Dwells, model: GyroModel | None, false_alarm_rate: float,
                     ) -> tuple[NamedCauses, tuple[Unexplained, ...], frozenset[str]]:
    """Return causes, structure without a name, and names that were withdrawn."""
    withdrawn: frozenset[str] = frozenset()
    while True:
        named = name_causes(dwells, model, false_alarm_rate, withdrawn)
        structures, gains = find_structure(named.fit, 0.2 * false_alarm_rate,
                                           model_uncertainty(named.fit, named.model))
        # structure along the variable of a cause, above a tenth of what that explains
        doubtful = [effect.name for effect in named.causes if effect not in NUISANCE_EFFECTS
                    and max((gain for name, gain in gains.items()
                             if CAUSES[effect.name].along in name.split('_times_')), default=0.0)
                    > 0.1 * _misfit_reduction(named, effect)]
        if withdrawn or not doubtful:
            return named, structures, withdrawn
        withdrawn = frozenset(doubtful)


def _cross_validated_gain(dwells: Dwells, model: GyroModel | None, false_alarm_rate: float,
                          withdrawn: frozenset[str], on_progress: OnProgress) -> Gain | None:
    """Return the gain on sweeps left out of selection and fit in turn; None if not possible."""
    parts = cross_validation_parts(dwells)
    count = min(8, int(parts.max()) + 1)  # of groups of sweeps, for the computing time
    groups = parts * count // (parts.max() + 1)
    errors = {name: np.full(len(dwells), np.nan) for name in ('given', 'plain', 'extended')}
    for number in range(count):
        on_progress(_SEARCH_TIME_SHARE + (0.97 - _SEARCH_TIME_SHARE) * number / count,
                    f'cross-validation, part {number + 1} of {count}')
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
