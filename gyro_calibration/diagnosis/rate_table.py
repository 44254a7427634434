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

from gyro_calibration.calibration.dwells import Dwells, from_table, listed, take
from gyro_calibration.calibration.rate_table import (
    Calibration,
    channels_of,
    columns_of,
    fit_effects,
)
from gyro_calibration.calibration.scatter import (
    FEWEST_SWEEPS,
    freedom_beside_surface,
    parts_of,
    rms,
    Scatter,
    SMALLEST_TEMPERATURE_SPREAD,
    summed,
    Uncertainty,
    Whitener,
)
from gyro_calibration.calibration.selection import supported_effects, swapped_effects
from gyro_calibration.diagnosis.causes import CAUSES, finding, with_remedies
from gyro_calibration.diagnosis.cross_validation import gain_of, WINDOW
from gyro_calibration.diagnosis.data_quality import decided, inspect
from gyro_calibration.diagnosis.dwell_fit import (
    alternatives,
    assembled,
    change_of,
    level_of,
    model_before,
    name_causes,
    Named,
    NUISANCES,
    RATE,
    seen,
    simulated,
    SINGLE_RATES,
    tried,
    uncertainty_of,
    what_is_left,
)
from gyro_calibration.diagnosis.extended_model import notes_of
from gyro_calibration.diagnosis.findings import (
    Curve,
    Diagnosis,
    Estimate,
    Finding,
    Gain,
    Unexplained,
)
from gyro_calibration.diagnosis.gates import refuse
from gyro_calibration.diagnosis.steps import OnProgress
from gyro_calibration.diagnosis.words import amount
from gyro_calibration.logs.log import Array, DataRefused, DEGREE, Log, Mask, NORMAL_95
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

#: Shares of the false-alarm rate: for structure without a name, and for outlying dwells; the rest
#: is for causes.
_LEFT, _OUTLYING = 0.2, 0.05
#: Probability that an effect of the minimum detectable size is found.
_POWER = 0.95
_METHOD = (
    'The rates and temperatures of the dwells were simulated, and the difference of measured and '
    'simulated outputs was compared with the effects of rate and temperature. The scatter of '
    'dwells and sweeps was estimated by restricted likelihood about a smooth surface. An effect '
    'was taken if it predicts left-out sweeps better and is improbable by chance: of tables '
    'without any cause, {share:.2g} % give an alarm. Then curves over rate, temperature and the '
    'order of the dwells were tested on the residual. The reduction of the error was measured on '
    'held-out sweeps; intervals are of 95 %.')
#: Largest number of groups of sweeps that are left out in turn, for the computing time.
_MOST_GROUPS = 8
#: Largest number of bins of a curve, and least number of dwells in each.
_MOST_BINS, _DWELLS_A_BIN = 40, 4
#: Shares of the search and of the cross-validation in the computing time, measured on a table of
#: 700 dwells.
_FOUND, _VALIDATED = 0.22, 0.75
#: Largest ratio of unexplained structure along its variable to what a named cause explains.
_WITHDRAWN = 0.1


def diagnose_table(table: Log | Dwells, model: GyroModel | None, rate: float = 0.01,
                   on_progress: OnProgress = lambda share, words: None) -> Diagnosis:
    """
    Find the causes of the difference between a simulation and the dwells of a rate table.

    Parameters
    ----------
    table : a log without time, or its dwells
    model : that is tested; None is an ideal gyro with the best bias and scale factor
    rate : false alarms per table
    on_progress : is called with the share of the work done and the name of the step that begins

    Raises
    ------
    DataRefused : the dwells do not allow an answer

    """
    on_progress(0.0, 'search for causes')
    dwells = table if isinstance(table, Dwells) else from_table(table)
    log = Log(output=dwells.output, reference_rate=dwells.rate, temperature=dwells.temperature)
    refuse(log, model)
    if not np.ptp(dwells.rate) > 0.0:
        raise DataRefused('all dwells have one rate, which does not separate scale factor and '
                          'bias; record several rates, both ways')
    record = decided(inspect(log, model))
    dwells = replace(dwells, output=dwells.output * record.factor)
    named, left, withdrawn = _concluded(dwells, model, rate)
    gain = _gain(dwells, model, rate, withdrawn, on_progress) if named.causes else None
    on_progress(_FOUND + _VALIDATED, 'findings')
    before = model_before(dwells, model, named)
    offered = bool(named.causes) and not (gain is not None and gain.worse)
    after = assembled(dwells, model, named.fit) if offered else before
    strengths = {effect: _strength_of(named, effect) for effect in named.causes}
    findings = with_remedies([
        *record.findings, *_outliers(dwells, named.fit, _OUTLYING * rate),
        *(_finding(named, effect)
          for effect in sorted(named.causes, key=lambda each: -strengths[each]))], {}, after)
    if after is not before:
        after = replace(after, origin={**after.origin, **notes_of(findings, [record.factor])})
    return Diagnosis(
        tuple(findings), left, Noise(), Noise() if model is None else model.noise,
        gain, before, after, _cannot_show(dwells),
        curves(dwells, named.fit.scatter, before, after),
        remarks=(*record.remarks, *dwells.remarks,
                 *_remarks(dwells, model, named, left, withdrawn, gain, offered)),
        false_alarm_rate=rate, method=_METHOD.format(share=100.0 * rate))


# the steps

def _concluded(dwells: Dwells, model: GyroModel | None, rate: float,
               withdrawn: frozenset[str] = frozenset()
               ) -> tuple[Named, tuple[Unexplained, ...], frozenset[str]]:
    """Name causes, and withdraw names along a variable with much unexplained structure."""
    named = name_causes(dwells, model, rate, withdrawn)
    left, gains = what_is_left(named.fit, _LEFT * rate, uncertainty_of(named.fit, named.model))
    if withdrawn:
        return named, left, withdrawn
    withdrawn = frozenset(
        effect.name for effect in named.causes if effect not in NUISANCES
        and max((gain for name, gain in gains.items()
                 if CAUSES[effect.name].along in name.split('_times_')), default=0.0)
        > _WITHDRAWN * _strength_of(named, effect))
    return _concluded(dwells, model, rate, withdrawn) if withdrawn else (named, left, withdrawn)


def _gain(dwells: Dwells, model: GyroModel | None, rate: float,
          withdrawn: frozenset[str], on_progress: OnProgress) -> Gain | None:
    """Return the gain on sweeps left out of selection and fit in turn; None if not possible."""
    parts = parts_of(dwells)
    groups = parts * min(_MOST_GROUPS, parts.max() + 1) // (parts.max() + 1)
    errors = {name: np.full(len(dwells), np.nan) for name in ('given', 'plain', 'extended')}
    for number in range(groups.max() + 1):
        on_progress(_FOUND + _VALIDATED * number / (groups.max() + 1),
                    f'cross-validation, part {number + 1} of {groups.max() + 1}')
        hidden = groups == number
        rest, left_out = take(dwells, ~hidden), take(dwells, hidden)
        try:
            named = name_causes(rest, model, rate, withdrawn)
            models = (model or GyroModel(), model_before(rest, None, named),
                      assembled(rest, model, named.fit))
        except DataRefused:
            continue
        for each, error in zip(models, errors.values()):
            error[hidden] = left_out.output - simulated(each, left_out)
    known = np.isfinite(errors['extended'])
    if not known.any():
        return None
    numbered = np.unique(parts[known], return_inverse=True)[1]
    what = 'sweeps' if len(np.unique(dwells.sweep)) >= FEWEST_SWEEPS else 'consecutive dwells'
    # the heading error of a turn over the window at the rate of a dwell
    squares = {name: np.outer(np.bincount(numbered, error[known] ** 2), [1.0, WINDOW ** 2])
               for name, error in errors.items()}
    return gain_of(f'{what} left out, each of {groups.max() + 1} groups in turn', squares,
                   np.outer(np.bincount(numbered), [1, 1]),
                   'plain' if model is None else 'given', WINDOW)


def _outliers(dwells: Dwells, fit: Calibration, level: float) -> Iterator[Finding]:
    """Give outlying dwells, if the largest deviation from a fit to the others is significant."""
    outlying = np.flatnonzero(~fit.scatter.kept)
    freedom = freedom_beside_surface(take(dwells, fit.scatter.kept))
    if not len(outlying) or min(freedom, fit.freedom) < 1:
        return
    # in standard deviations about a fit without them
    used, shared = take(dwells, fit.scatter.kept), fit.scatter.shared(dwells)
    columns = Whitener(used, fit.scatter).whiten(columns_of(used, fit.terms))
    of_fit = columns_of(dwells, fit.terms) @ np.linalg.pinv(columns)
    deviation = np.sqrt(fit.scatter.deviation(dwells) ** 2 + np.sum(shared ** 2, axis=1)
                        + np.sum(of_fit ** 2, axis=1))
    far = (np.abs(fit.residual) / deviation)[outlying]
    chance = min(1.0, len(dwells) * 2.0 * float(student.sf(far.max(), freedom)))
    if chance < level:
        places = listed([dwells.place[row] for row in outlying])
        yield finding('outliers', {'outliers': Estimate.about(float(len(outlying)), 0.0, '1')},
                      chance, cause=CAUSES['outliers'].sentence.replace('samples', 'dwells'),
                      evidence=f'{len(outlying)} of {len(dwells)} dwells are up to '
                      f'{far.max():.0f} sigma from the others: {places}',
                      along=RATE)


# findings

def _strength_of(named: Named, effect: Effect) -> float:
    """Return the reduction of the sum of squares by a cause."""
    if effect not in NUISANCES:
        rest = _rest(named.change, named.changed(effect))
        return math.inf if rest is None else rest.misfit - named.change.misfit
    return (change_of(named.fit, named.model, effect)
            / _with_deviations(named.fit, effect)[1][0]) ** 2


def _rest(fit: Calibration, effect: Effect) -> Calibration | None:
    """Fit all but one effect."""
    return tried(fit, [each for each in fit.effects if each is not effect])


def _finding(named: Named, effect: Effect) -> Finding:
    others, separate_by = alternatives(named.fit, effect)
    along = {'along': 'temperature_while_turning'} if effect is SCALE_FACTOR_TEMPERATURE else {}
    term, deviations = _with_deviations(named.fit, effect)
    own, parameters = _own_values(named, effect), effect.parameters
    # what is added to the model's values
    estimates = {parameters[place].name: Estimate.about(
        term.values[place] - own[place], NORMAL_95 * deviation, parameters[place].unit)
        for place, deviation in zip(term.fitted, deviations)}
    return finding(effect.name, estimates, named.chance_of(effect), others,
                   minimum_detectable=_smallest(named, effect), separate_by=separate_by,
                   evidence=_evidence(named, effect), **along)


def _own_values(named: Named, effect: Effect) -> tuple[float, ...]:
    """Return the values that the model has of an effect, 0 where it has none."""
    return next((term.values for term in named.model.terms if term.effect is effect),
                (0.0,) * len(effect.parameters))


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
    """Return the minimum detectable size of an effect, in the unit of its first value."""
    change, level = named.changed(effect), level_of(named.rate, effect in NUISANCES)
    if effect in NUISANCES:
        return _found_from(named.fit, effect, level)
    if effect not in (SINE_RESPONSE, CUBIC_NONLINEARITY):
        return _found_from(named.change, change, level)
    # A small sine response equals -k² w³ / 6.
    cubic = tried(named.change, swapped_effects(named.change.effects, change, CUBIC_NONLINEARITY))
    if cubic is None:
        return None
    size = _found_from(cubic, CUBIC_NONLINEARITY, level)
    own = _own_values(named, SINE_RESPONSE)[0]
    return size if effect is CUBIC_NONLINEARITY else math.sqrt(own ** 2 + 6.0 * size) - own


def _found_from(fit: Calibration, effect: Effect, level: float) -> float:
    """Return the size of a value that is found with a probability of 95 %."""
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
    sigmas = f'{math.sqrt(max(_strength_of(named, effect), 0.0)):.1f} sigma from zero'
    if effect in NUISANCES:
        parameter = effect.parameters[-1]
        change = amount(change_of(named.fit, named.model, effect), parameter.unit, parameter.name)
        return f'it differs from that of the model by {change}; {sigmas}'
    rest = _rest(named.change, named.changed(effect))
    if rest is None:
        return ''
    return (f'without it, left-out sweeps are predicted to {rest.left_out_rms / DEGREE:.3g} '
            f'deg/s, with it to {named.change.left_out_rms / DEGREE:.3g} deg/s; {sigmas}')


# remarks

def _remarks(dwells: Dwells, model: GyroModel | None, named: Named, left: Sequence[Unexplained],
             withdrawn: frozenset[str], gain: Gain | None, offered: bool) -> Iterator[str]:
    fit = named.fit
    if withdrawn:
        yield (f'Not named: {", ".join(sorted(withdrawn))}: along the same '
               'variable, much structure is left without a name.')
    if named.causes and not offered:
        yield ('The errors of the extended model for left-out dwells are larger than those of the '
               'simulation; it is not offered.')
    if gain is not None:
        yield (f'Heading errors are the errors of dwells integrated over {WINDOW:g} s.')
    if any(each.along == SINGLE_RATES for each in left):
        yield ('Errors that repeat at single rates may belong to the table, or to the position '
               'within a sweep if all sweeps have the same order.')
    scatter = fit.scatter
    yield (f'Dwells scatter by {scatter.dwell / DEGREE:.2g} deg/s and '
           f'{100.0 * scatter.dwell_scale:.2g} % of the rate, sweeps by '
           f'{scatter.sweep_bias / DEGREE:.2g} deg/s in bias and '
           f'{100.0 * scatter.sweep_scale:.2g} % in scale factor.')
    if model is not None:
        yield from _of_model(dwells, model, fit)


def _of_model(dwells: Dwells, model: GyroModel, fit: Calibration) -> Iterator[str]:
    """Give remarks on untested effects of a model, and on a replacement of its polynomial."""
    known = seen(model)
    unseen = [term.effect.name for term in model.terms if term not in known]
    if unseen:
        yield (f'Dwells without time do not show {", ".join(unseen)}; these effects of the model '
               'are unchanged.')
    if (any(term.effect.looks_at & {'temperature'} for term in known)
            and dwells.temperature is None):
        yield ('The table holds no temperature; the model is simulated at '
               f'{model.reference_temperature:g} degC.')
    if any('output' in term.effect.looks_at for term in known):
        yield from _against_polynomial(dwells, known)


def _against_polynomial(dwells: Dwells, known: list[Term]) -> Iterator[str]:
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
    count, of_polynomial = (sum(len(term.fitted) for term in fit.terms)
                            for fit in (named, polynomial))
    yield (f'{effects} alone, {count} values, predict the rates of left-out sweeps to '
           f'{of_rate / DEGREE:.3g} deg/s; a polynomial of the orders that the model has, '
           f'{of_polynomial} values, to {polynomial.left_out_rms / DEGREE:.3g} deg/s.')


# what cannot be shown

_AVERAGED = 'a dwell is a mean at a constant rate; record samples with their time'
_NO_TIME = 'a table without time does not show what changes with time; record a log in time'
_REASONS = {
    **dict.fromkeys(('bandwidth', 'time_offset', 'clock_rate', 'reference_slip'),
                    'at constant rates a delay has no effect; record fast reversals with their '
                    'time'),
    **dict.fromkeys(('bias_temperature_rate', 'thermal_lag', 'thermal_hysteresis', 'warm_up',
                     'rate_ramp', 'bias_step'), _NO_TIME),
    **dict.fromkeys(('interference_tone', 'quantization', 'dead_zone', 'saturation',
                     'stuck_samples', 'dropped_samples', 'angle_random_walk', 'bias_instability',
                     'rate_random_walk'), _AVERAGED),
    **dict.fromkeys(('heading_sensitivity', 'reference_once_per_rev', 'reference_quantization'),
                    'whole turns average over all headings; record reference_heading_deg in time'),
    **dict.fromkeys(('acceleration_sensitivity', 'vibration_rectification'),
                    'only rates and temperatures of a table are evaluated; record '
                    'acceleration_mps2 in several poses, with time'),
    'supply_sensitivity':
        'only rates and temperatures of a table are evaluated; record supply_v with time',
    'reference_scale':
        'only a second reference separates the scale of the first from that of the gyro'}


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


# curves

def curves(dwells: Dwells, scatter: Scatter, before: GyroModel,
           after: GyroModel) -> tuple[Curve, ...]:
    """Return the errors of dwells, without outliers, along rate, temperature and their order."""
    used = take(dwells, scatter.kept)
    ways, straight = np.sign(used.rate), np.ones(len(used))
    found = [_curve('rate', 'rad/s', used.rate, straight, used, scatter, before, after),
             _curve('order_of_dwells', '', np.arange(1.0, len(used) + 1.0), straight, used,
                    scatter, before, after)]
    if used.temperature is not None and np.ptp(used.temperature) > 0.0:
        found.append(_curve('temperature', 'degC', used.temperature, straight, used, scatter,
                            before, after))
        # A scale factor that changes with temperature averages out over turns both ways, unless
        # errors count in the sense of the turn.
        found.append(_curve('temperature_while_turning', 'degC', used.temperature, ways, used,
                            scatter, before, after))
    return tuple(found)


def _curve(along: str, unit: str, values: Array, sign: Array, dwells: Dwells, scatter: Scatter,
           before: GyroModel, after: GyroModel) -> Curve:
    outputs = [simulated(model, dwells) for model in (before, after)]
    errors = [sign * (dwells.output - outputs[0]), sign * (dwells.output - outputs[1]),
              sign * (outputs[0] - dwells.rate)]
    # of equal width, those that hold something
    count = max(1, min(_MOST_BINS, len(np.unique(values)), len(values) // _DWELLS_A_BIN))
    edges = np.linspace(values.min(), values.max(), count + 1)
    place = np.clip(np.searchsorted(edges, values, side='right') - 1, 0, count - 1)
    bins = [chosen for number in range(count)
            if (chosen := (place == number) & (sign != 0.0)).any()]
    at, *means = (np.array([float(each[chosen].mean()) for chosen in bins])
                  for each in (values, *errors))
    deviation = np.array([_deviation(dwells, scatter, sign, chosen) for chosen in bins])
    return Curve(along, unit, at, means[0], means[1], deviation, means[2])


def _deviation(dwells: Dwells, scatter: Scatter, sign: Array, chosen: Mask) -> float:
    """Return the standard deviation of the mean error of dwells; a sweep shares a part of it."""
    part = take(dwells, chosen)
    shared = summed(sign[chosen, None] * scatter.shared(part),
                    np.unique(part.sweep, return_inverse=True)[1])
    return math.sqrt(float(np.sum(scatter.deviation(part) ** 2) + np.sum(shared ** 2))) / len(part)
