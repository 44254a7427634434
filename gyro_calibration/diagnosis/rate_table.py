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

from collections.abc import Iterator
from dataclasses import dataclass, replace
import math

from gyro_calibration.calibration.dwells import Dwells, from_table, listed, take
from gyro_calibration.calibration.rate_table import (
    Calibration,
    channels_of,
    columns_of,
    fit_effects,
)
from gyro_calibration.calibration.scatter import (
    freedom_beside_surface,
    rms,
    SMALLEST_TEMPERATURE_SPREAD,
    Uncertainty,
    Whitener,
)
from gyro_calibration.calibration.selection import supported_effects, swapped_effects
from gyro_calibration.diagnosis.causes import CAUSES
from gyro_calibration.diagnosis.cross_validation import WINDOW
from gyro_calibration.diagnosis.data_quality import decided, inspect
from gyro_calibration.diagnosis.dwell_confounders import alternatives
from gyro_calibration.diagnosis.dwell_cross_validation import curves, measure_gain
from gyro_calibration.diagnosis.dwell_fit import (
    change_of,
    doubt,
    model_after,
    model_before,
    name_causes,
    Named,
    NUISANCES,
    seen,
    tried,
)
from gyro_calibration.diagnosis.dwell_structure import Left, RATE, SINGLE_RATES, what_is_left
from gyro_calibration.diagnosis.extended_model import notes_of
from gyro_calibration.diagnosis.findings import Diagnosis, Estimate, Finding, Gain
from gyro_calibration.diagnosis.input_validation import refuse
from gyro_calibration.diagnosis.units import amount
from gyro_calibration.logs.log import Array, DataRefused, DEGREE, Log
from gyro_calibration.model.effects import (
    CUBIC_NONLINEARITY,
    Effect,
    SCALE_FACTOR_TEMPERATURE,
    SINE_RESPONSE,
    STEADY,
)
from gyro_calibration.model.gyro_model import GyroModel, Term
from gyro_calibration.model.noise import Noise
import numpy as np
from scipy.optimize import brentq
from scipy.stats import norm
from scipy.stats import t as student

#: Parts of the false-alarm rate: of structure without a name, and of outlying dwells; the rest is
#: that of causes.
_LEFT, _OUTLYING = 0.2, 0.05
#: An effect of the smallest size that is said is found with this probability.
_POWER = 0.95
_METHOD = (
    'The rates and temperatures of the dwells were put through the simulation, and what the '
    'measured outputs differ by was compared with',
    'the effects of rate and temperature. How dwells and sweeps scatter was found by restricted '
    'likelihood about a smooth surface. An',
    'effect was taken where it predicts left-out sweeps better, and chance alone, averaged over '
    'what the scatter may be, hardly shows as',
    'much: of tables without any cause, {share:.2g} % give an alarm. Then curves over rate, '
    'temperature and the order of the',
    'dwells were tried on what is left. What is won was measured on sweeps that took no part in '
    'choice or fit; intervals are of 95 %.')
#: A name is withdrawn where more than this part of what it explains is left along its variable.
_WITHDRAWN = 0.1


def diagnose_table(table: Log | Dwells, model: GyroModel | None, rate: float = 0.01) -> Diagnosis:
    """
    Say what a simulation gets wrong of the dwells of a rate table.

    Parameters
    ----------
    table : a log without time, or its dwells
    model : that is tested; an ideal gyro with the best bias and scale factor where it is None
    rate : of false alarms, a table

    Raises
    ------
    DataRefused : the dwells do not allow an answer

    """
    dwells = table if isinstance(table, Dwells) else from_table(table)
    refuse(_as_log(dwells), model)
    _refuse_one_rate(dwells)
    record = decided(inspect(_as_log(dwells), model))
    dwells = replace(dwells, output=dwells.output * record.factor)
    known = _conclude(dwells, model, rate)
    gain = (measure_gain(dwells, lambda part: _models(part, model, rate, known.withdrawn))
            if known.named.causes else None)
    before = model_before(dwells, model, known.named)
    offered = bool(known.named.causes) and not (gain is not None and gain.worse)
    after = model_after(dwells, model, known.named) if offered else before
    findings = (*record.findings, *_outliers(dwells, known.named.fit, _OUTLYING * rate),
                *_findings(known.named))
    return Diagnosis(
        findings, known.left.found, Noise(), Noise() if model is None else model.noise, gain,
        before, _noted(after, findings, before, record.factor), _cannot_show(dwells),
        curves(dwells, known.named.fit.scatter, before, after),
        remarks=(*record.remarks, *dwells.remarks, *_remarks(dwells, model, known, gain, offered)),
        false_alarm_rate=rate, method=' '.join(_METHOD).format(share=100.0 * rate))


def _as_log(dwells: Dwells) -> Log:
    return Log(output=dwells.output, reference_rate=dwells.rate, temperature=dwells.temperature)


def _refuse_one_rate(dwells: Dwells) -> None:
    if not np.ptp(dwells.rate) > 0.0:
        raise DataRefused('all dwells have one rate, so that nothing tells the scale factor from '
                          'the bias; record several rates, both ways')


# the steps

@dataclass(frozen=True)
class _Known:
    """What dwells show: named causes, and what is left."""

    named: Named
    left: Left
    withdrawn: frozenset[str] = frozenset()


def _conclude(dwells: Dwells, model: GyroModel | None, rate: float) -> _Known:
    """Name causes, and withdraw names along a variable where much has none."""
    named = name_causes(dwells, model, rate)
    left = what_is_left(named.fit, _LEFT * rate, doubt(named.fit, named.model))
    withdrawn = frozenset(effect.name for effect in named.causes if effect not in NUISANCES
                          and _doubtful(named, left, effect))
    if not withdrawn:
        return _Known(named, left)
    named = name_causes(dwells, model, rate, withdrawn)
    return _Known(named, what_is_left(named.fit, _LEFT * rate, doubt(named.fit, named.model)),
                  withdrawn)


def _doubtful(named: Named, left: Left, effect: Effect) -> bool:
    """Tell whether much is left along the variable beside what the effect explains."""
    along, explained = CAUSES[effect.name].along, _strength_of(named, effect)
    return max((gain for name, gain in left.misfit.items() if along in name.split('_times_')),
               default=0.0) > _WITHDRAWN * explained


def _models(dwells: Dwells, model: GyroModel | None, rate: float,
            withdrawn: frozenset[str]) -> tuple[GyroModel, GyroModel]:
    """Return the simulation before and extended, with causes chosen anew from some dwells."""
    named = name_causes(dwells, model, rate, withdrawn)
    return model_before(dwells, model, named), model_after(dwells, model, named)


def _outliers(dwells: Dwells, fit: Calibration, level: float) -> Iterator[Finding]:
    """Give outlying dwells, if the farthest is beyond chance beside a fit to the others."""
    outlying = np.flatnonzero(~fit.scatter.kept)
    freedom = freedom_beside_surface(take(dwells, fit.scatter.kept))
    if not len(outlying) or min(freedom, fit.freedom) < 1:
        return
    far = np.abs(fit.residual[outlying]) / _deviation_from(fit)[outlying]
    chance = min(1.0, len(dwells) * 2.0 * float(student.sf(far.max(), freedom)))
    if chance < level:
        cause, count = CAUSES['outliers'], float(len(outlying))
        places = listed([dwells.place[row] for row in outlying])
        yield Finding('outliers', cause.sentence.replace('samples', 'dwells'),
                      {'outliers': Estimate(count, (count, count), '1')}, chance,
                      evidence=f'{len(outlying)} of {len(dwells)} dwells are up to '
                      f'{far.max():.0f} standard deviations off what the others say: {places}',
                      along=RATE)


def _deviation_from(fit: Calibration) -> Array:
    """Return the standard deviation of each dwell about a fit without it, rad/s, shape (n,)."""
    used, shared = take(fit.dwells, fit.scatter.kept), fit.scatter.shared(fit.dwells)
    columns = Whitener(used, fit.scatter).whiten(columns_of(used, fit.terms))
    of_fit = columns_of(fit.dwells, fit.terms) @ np.linalg.pinv(columns)
    return np.asarray(np.sqrt(fit.scatter.deviation(fit.dwells) ** 2 + np.sum(shared ** 2, axis=1)
                              + np.sum(of_fit ** 2, axis=1)))


# findings

def _findings(named: Named) -> list[Finding]:
    """Return the named causes, the strongest first."""
    strengths = {effect: _strength_of(named, effect) for effect in named.causes}
    return [_finding(named, effect)
            for effect in sorted(named.causes, key=lambda each: -strengths[each])]


def _strength_of(named: Named, effect: Effect) -> float:
    """Return by what the sum of squares falls with a cause."""
    if effect not in NUISANCES:
        return _strength(named.change, named.changed(effect))
    return (change_of(named.fit, named.model, effect)
            / _with_deviations(named.fit, effect)[1][0]) ** 2


def _strength(fit: Calibration, effect: Effect) -> float:
    """Return by what the sum of squares falls with an effect."""
    rest = _rest(fit, effect)
    return math.inf if rest is None else rest.misfit - fit.misfit


def _rest(fit: Calibration, effect: Effect) -> Calibration | None:
    """Fit all but one effect."""
    return tried(fit, [each for each in fit.effects if each is not effect])


def _finding(named: Named, effect: Effect) -> Finding:
    cause, others = CAUSES[effect.name], alternatives(named.fit, effect)
    along = 'temperature_while_turning' if effect is SCALE_FACTOR_TEMPERATURE else cause.along
    return Finding(effect.name, cause.sentence, _estimates(named, effect), named.chance_of(effect),
                   _smallest(named, effect), others.names, others.separate_by,
                   _evidence(named, effect), along)


def _estimates(named: Named, effect: Effect) -> dict[str, Estimate]:
    """Return what is added to the model's values of an effect; 1.96 deviations hold 95 %."""
    term, deviations = _with_deviations(named.fit, effect)
    own = _own_values(named, effect)
    return {effect.parameters[place].name: _estimate(term.values[place] - own[place], deviation,
                                                     effect.parameters[place].unit)
            for place, deviation in zip(term.fitted, deviations)}


def _own_values(named: Named, effect: Effect) -> tuple[float, ...]:
    """Return the values that the model has of an effect, 0 where it has none."""
    return next((term.values for term in named.model.terms if term.effect is effect),
                (0.0,) * len(effect.parameters))


def _estimate(value: float, deviation: float, unit: str) -> Estimate:
    return Estimate(value, (value - 1.96 * deviation, value + 1.96 * deviation), unit)


def _with_deviations(fit: Calibration, effect: Effect) -> tuple[Term, list[float]]:
    """Return the term of an effect, and the standard deviations of its fitted values."""
    owners = [each for each in fit.terms for _ in each.fitted]
    term = next(each for each in fit.terms if each.effect is effect)
    covariance = fit.model.covariance
    deviations = (np.full(len(owners), math.nan) if covariance is None
                  else np.sqrt(np.diag(covariance)))
    return term, [float(deviation) for owner, deviation in zip(owners, deviations)
                  if owner is term]


def _smallest(named: Named, effect: Effect) -> float | None:
    """Return the size from which an effect is found, in the unit of its first value."""
    change, level = named.changed(effect), named.level_of(effect)
    if effect in NUISANCES:
        return _found_from(named.fit, effect, level)
    if effect not in (SINE_RESPONSE, CUBIC_NONLINEARITY):
        return _found_from(named.change, change, level)
    # A small sine response is found as what it begins with, -k² w³ / 6.
    cubic = tried(named.change, swapped_effects(named.change.effects, change, CUBIC_NONLINEARITY))
    if cubic is None:
        return None
    size = _found_from(cubic, CUBIC_NONLINEARITY, level)
    own = _own_values(named, SINE_RESPONSE)[0]
    return size if effect is CUBIC_NONLINEARITY else math.sqrt(own ** 2 + 6.0 * size) - own


def _found_from(fit: Calibration, effect: Effect, level: float) -> float:
    """Return the size from which on a value is found with a probability of 95 %."""
    used = take(fit.dwells, fit.scatter.kept)
    place = [term.effect for term in fit.terms for _ in term.fitted].index(effect)
    uncertain = Uncertainty.of(used, fit.scatter, columns_of(used, fit.terms),
                               fit.residual[fit.scatter.kept])
    deviation = math.sqrt(float(np.tensordot(uncertain.weights, uncertain.covariances,
                                             axes=1)[place, place]))

    def excess(sigmas: float) -> float:
        outside = (uncertain.below(-sigmas * deviation)[place]
                   + 1.0 - uncertain.below(sigmas * deviation)[place])
        return float(outside) - level

    return deviation * (float(brentq(excess, 0.1, 1e3)) + float(norm.ppf(_POWER)))


def _evidence(named: Named, effect: Effect) -> str:
    sigmas = (f'it stands out by {math.sqrt(max(_strength_of(named, effect), 0.0)):.1f} standard '
              'deviations')
    if effect in NUISANCES:
        parameter = effect.parameters[-1]
        change = amount(change_of(named.fit, named.model, effect), parameter.unit, parameter.name)
        return f'it differs from that of the model by {change}; {sigmas}'
    rest = _rest(named.change, named.changed(effect))
    if rest is None:
        return ''
    return (f'without it, left-out sweeps are predicted to {rest.left_out_rms / DEGREE:.3g} '
            f'deg/s, with it to {named.change.left_out_rms / DEGREE:.3g} deg/s; {sigmas}')


# what a person should know

def _noted(model: GyroModel, findings: tuple[Finding, ...], before: GyroModel,
           factor: float) -> GyroModel:
    """Return the extended model with notes for its file: what is ambiguous, and the factor."""
    return (model if model is before
            else replace(model, origin={**model.origin, **notes_of(findings, [factor])}))


def _remarks(dwells: Dwells, model: GyroModel | None, known: _Known, gain: Gain | None,
             offered: bool) -> Iterator[str]:
    fit = known.named.fit
    if known.withdrawn:
        yield (f'No name is given to {", ".join(sorted(known.withdrawn))}, for along the same '
               'variable much is left that has none.')
    if known.named.causes and not offered:
        yield ('The extension predicts left-out dwells worse than the simulation, so that it is '
               'not offered.')
    if gain is not None:
        yield (f'Heading errors are those that the error of a dwell makes in {WINDOW:g} s at its '
               'rate.')
    if any(each.along == SINGLE_RATES for each in known.left.found):
        yield ('What repeats at single rates may be of the table, or of the place within a sweep '
               'where all sweeps have the same order.')
    yield _scatter_said(fit)
    if model is not None:
        yield from _of_model(dwells, model, fit)


def _scatter_said(fit: Calibration) -> str:
    scatter = fit.scatter
    return (f'Dwells scatter by {scatter.dwell / DEGREE:.2g} deg/s and '
            f'{100.0 * scatter.dwell_scale:.2g} % of the rate, sweeps by '
            f'{scatter.sweep_bias / DEGREE:.2g} deg/s in bias and '
            f'{100.0 * scatter.sweep_scale:.2g} % in scale factor.')


def _of_model(dwells: Dwells, model: GyroModel, fit: Calibration) -> Iterator[str]:
    """Say what of a model dwells cannot test, and if named effects may replace its polynomial."""
    known = seen(model)
    unseen = [term.effect.name for term in model.terms if term not in known]
    if unseen:
        yield (f'Dwells without time do not show {", ".join(unseen)}; they are left as the model '
               'has them.')
    if (any(term.effect.looks_at & {'temperature'} for term in known)
            and dwells.temperature is None):
        yield ('The table holds no temperature; the model is simulated at '
               f'{model.reference_temperature:g} degC.')
    if any('output' in term.effect.looks_at for term in known):
        yield from _beside_polynomial(dwells, known)


def _beside_polynomial(dwells: Dwells, known: list[Term]) -> Iterator[str]:
    named, _ = supported_effects(dwells)
    try:
        polynomial = fit_effects(dwells, [term.effect for term in known
                                          if 'output' in term.effect.looks_at], named.scatter)
    except DataRefused:
        return
    effects = ', '.join(effect.name for effect in named.effects)
    # Effects of the rate leave an error of the output, a polynomial of the output one of the rate.
    of_rate = rms((named.left_out
                   / named.model.steepness(channels_of(dwells)))[named.scatter.kept])
    yield (f'{effects} alone, {_values(named)} values, predict the rates of left-out sweeps to '
           f'{of_rate / DEGREE:.3g} deg/s; a polynomial of the orders that the model has, '
           f'{_values(polynomial)} values, to {polynomial.left_out_rms / DEGREE:.3g} deg/s.')


def _values(fit: Calibration) -> int:
    return sum(len(term.fitted) for term in fit.terms)


# what cannot be shown

_AVERAGED = 'a dwell is a mean at a steady rate; record samples with their time'
_NO_TIME = 'a table without time does not tell what changes with it; record a log in time'
_REASONS = {
    **dict.fromkeys(('bandwidth', 'time_offset', 'clock_rate', 'reference_slip'),
                    'at steady rates nothing changes that could come late; record fast reversals '
                    'in time'),
    **dict.fromkeys(('bias_temperature_rate', 'thermal_lag', 'thermal_hysteresis', 'warm_up',
                     'rate_ramp', 'bias_step'), _NO_TIME),
    **dict.fromkeys(('interference_tone', 'quantization', 'dead_zone', 'saturation',
                     'stuck_samples', 'dropped_samples', 'angle_random_walk', 'bias_instability',
                     'rate_random_walk'), _AVERAGED),
    **dict.fromkeys(('heading_sensitivity', 'reference_once_per_rev', 'reference_quantization'),
                    'whole turns average over all headings; record reference_heading_deg in time'),
    **dict.fromkeys(('acceleration_sensitivity', 'vibration_rectification'),
                    'of a table, rates and temperatures alone are looked at; record '
                    'acceleration_mps2 in several poses, in time'),
    'supply_sensitivity':
        'of a table, rates and temperatures alone are looked at; record supply_v in time',
    'reference_scale':
        'only a second reference tells the scale of the first from that of the gyro'}


def _cannot_show(dwells: Dwells) -> dict[str, str]:
    """Return the causes that the table cannot show, with the reasons."""
    found = {name: _REASONS[name] for name in CAUSES if name in _REASONS}
    thermal = [name for name, effect in STEADY.items() if 'temperature' in effect.looks_at]
    if dwells.temperature is None:
        return {**found, **dict.fromkeys(
            thermal, 'the table holds no temperature; record temperature_degc')}
    if np.ptp(dwells.temperature) < SMALLEST_TEMPERATURE_SPREAD:
        return {**found, **dict.fromkeys(
            thermal, f'the temperature varies by {np.ptp(dwells.temperature):.2g} K only; repeat '
            'the rates at another temperature')}
    return found
