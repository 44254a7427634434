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
Every cause that a diagnosis can name: effects of the gyro, faults of reference or record, noise.

The formulas and units of effects are in `effects`, with the variable along which each shows, and
the experiment that distinguishes it from similar causes.
"""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
import math
from typing import Any

from gyro_calibration.diagnosis.findings import (
    detectable_sigmas, Estimate, Finding, probabilities, RULED_OUT_DEFICIT)
from gyro_calibration.logs.log import Array, NORMAL_QUANTILE_975
from gyro_calibration.model.effects import CATALOGUE, Effect
from gyro_calibration.model.gyro_model import GyroModel
import numpy as np
from scipy.stats import t as student

#: Either of these serves as a reference.
REFERENCES = ('reference_rate', 'reference_heading')


@dataclass(frozen=True)
class Cause:
    """One cause."""

    name: str  # as in the catalogue of effects and in files
    sentence: str  # description for people
    units: Mapping[str, str]  # estimated parameter -> SI unit
    # columns of a log that are required to show it; 'reference' is one of `REFERENCES`
    required_channels: frozenset[str]
    along: str  # the variable along which it shows
    separate_by: str  # the experiment that distinguishes it from similar causes; '' without one
    origin: str  # what is to be corrected: 'gyro', 'reference', 'record' or 'noise'

    @property
    def unit(self) -> str:
        """Return the unit of the parameter that is named like it, SI."""
        return next(iter(self.units.values()))


#: Effect -> the experiment that distinguishes it in logs, where that of its record is one for a
#: rate table.
_LOG_EXPERIMENTS: Mapping[str, str] = {
    'bias': 'turn the axis over within one power-on, with all motors off',
    'scale_factor_error': 'make whole turns between marks, or use a second reference',
    'quadratic_nonlinearity': 'turn both ways at many speeds, slow ones too, with the sensor on '
                              'the axis of the table',
    'bias_temperature': 'heat and cool the gyro within one log, and start it both cold and warm',
}

#: Name, sentence, unit, origin, required channels, variable along which it shows, experiment.
_OTHER_CAUSES = (
    ('outliers', 'Single samples are outliers, as from a shock, a disturbed line or a corrected '
     'checksum.', '1', 'record', 'time', 'time', ''),
    ('stuck_samples', 'The last value is repeated instead of a new one.', '1', 'record', 'time',
     'time', 'turn without rest: the output of a working gyro then changes in each sample'),
    ('dropped_samples', 'Samples are missing from the record.', '1', 'record', 'time', 'time', ''),
    ('reference_once_per_rev', 'The reference errs once in a revolution, as an eccentric encoder '
     'or a wobbling table does.', '1', 'reference', 'time reference', 'heading',
     CATALOGUE['heading_sensitivity'].experiment),
    ('reference_scale', 'The scale of the reference itself is wrong.', '1', 'reference',
     'time reference', 'rate', _LOG_EXPERIMENTS['scale_factor_error']),
    ('reference_slip', 'The reference slipped: it shows a rotation that the gyro did not make.',
     'rad', 'reference', 'time reference', 'rate_change', ''),
    ('reference_drift', 'The reference drifts in motion, and stands at rest, as odometry does.',
     'rad/s', 'reference', 'time reference_heading', 'time',
     CATALOGUE['vibration_rectification'].experiment),
    ('axis_misalignment', 'The axis of the gyro is oblique to that of the attitude: parts of the '
     'rotations about other axes are in the output.', 'rad', 'reference', 'time cross_axis_1',
     'heading', ''),
    ('reference_lag', 'The motion follows the reference rate with a lag of its own, as a robot '
     'follows its command.', 's', 'reference', 'time reference_rate', 'rate_change', ''),
    ('reference_quantization', 'The reference heading is quantized, so that its rate between '
     'samples is coarse.', 'rad', 'reference', 'time reference_heading', 'heading', ''),
    ('unit_error', 'The output has another unit, or the other sign, than its name states.', '1',
     'record', 'reference', 'rate', 'compare the raw values of the gyro with its data sheet'),
    ('angle_random_walk', 'The angle random walk differs from the simulated one.', 'rad/√s',
     'noise', 'time', 'frequency', ''),
    ('bias_instability', 'The bias instability differs from the simulated one.', 'rad/s', 'noise',
     'time', 'frequency', 'record at rest for hours'),
    ('rate_random_walk', 'The rate random walk differs from the simulated one.', 'rad/s/√s',
     'noise', 'time', 'frequency',
     'record at rest for hours, twice: a random walk does not repeat'),
)


def _cause_of_effect(effect: Effect) -> Cause:
    units = {parameter.name: parameter.unit
             for parameter in effect.parameters if parameter.default is None}
    turned = effect.along in {'rate', 'heading', 'rate_change'} and effect.name != 'bias'
    needs = {'time', *(effect.inputs & {'temperature', 'specific_force', 'supply'}),
             *({'reference'} if turned or 'rate' in effect.inputs else ())}
    return Cause(effect.name, effect.cause, units, frozenset(needs), effect.along,
                 _LOG_EXPERIMENTS.get(effect.name, effect.experiment), 'gyro')


CAUSES: dict[str, Cause] = {
    **{name: _cause_of_effect(effect) for name, effect in CATALOGUE.items()},
    **{name: Cause(name, sentence, {name: unit}, frozenset(needs.split()), along, separate_by, of)
       for name, sentence, unit, of, needs, along, separate_by in _OTHER_CAUSES}}
NOISE_NAMES = tuple(name for name, cause in CAUSES.items() if cause.origin == 'noise')


def register_causes(effects: Iterable[Effect]) -> None:
    """Add user-defined effects of the catalogue to the causes that a diagnosis searches for."""
    for effect in effects:
        CAUSES[effect.name] = _cause_of_effect(effect)


def untestable_causes(testable: Collection[str], missing: Collection[str],
                      reason: Callable[[Cause], str]) -> dict[str, str]:
    """
    Return the reasons why causes cannot be seen.

    Parameters
    ----------
    testable : names of the causes that are tested in any case
    missing : the channels that the logs do not have
    reason : of a cause that lacks no channel; '' for one that is tested

    """
    found = {}
    for name, cause in CAUSES.items():
        lacks = ' and no '.join(
            {'cross_axis_1': 'attitude', 'supply': 'supply voltage'}.get(each, each)
            for each in sorted(cause.required_channels & {*missing}))
        if name not in testable and (why := f'the logs have no {lacks}'.replace('_', ' ')
                                     if lacks else reason(cause)):
            found[name] = why
    return found


#: Least p-value of a test; one of 0 is of what the samples themselves show.
_LEAST_CHANCE = 1e-300


def make_finding(name: str, parameters: Mapping[str, Estimate], p_value: float,
                 confounders: Sequence[str] = (), **fields: Any) -> Finding:
    """Return a finding of a cause, with the fields of the cause as defaults."""
    cause = CAUSES[name]
    defaults = {'cause': cause.sentence, 'along': cause.along,
                'separate_by': cause.separate_by if confounders else ''}
    return Finding(name, parameters=parameters, p_value=p_value,
                   ambiguous_with=tuple(confounders), **{**defaults, **fields})


def sized_finding(name: str, value: float, half_width: float, p_value: float,
                  confounders: Sequence[str] = (), **fields: Any) -> Finding:
    """Return a finding of a cause by its size and the half-width of the interval, in SI."""
    size = Estimate.from_half_width(float(value), half_width, CAUSES[name].unit)
    return make_finding(name, {name: size}, p_value, confounders, **fields)


def value_finding(name: str, value: float, deviation: float, level: float,
                  confounders: Sequence[str] = (), freedom: float = math.inf,
                  max_half_width: float = math.inf, **fields: Any) -> Finding | None:
    """Return a finding of a value, with Student's distribution, if it differs from 0."""
    chance = 2.0 * float(student.sf(abs(value) / deviation, freedom)) if deviation > 0.0 else 1.0
    if chance >= level:
        return None
    half = min(float(student.ppf(0.975, freedom)) * deviation, max_half_width)
    return sized_finding(name, value, half, max(chance, _LEAST_CHANCE), confounders,
                         minimum_detectable=detectable_sigmas(level) * deviation, **fields)


def cause_finding(name: str, parameters: Mapping[str, Estimate], p_value: float,
                  deficits: Mapping[str, float], is_established: bool = True,
                  observed: Mapping[str, float] | None = None, sigmas: float = math.nan,
                  confounders: Sequence[str] = (), **fields: Any) -> Finding:
    """
    Return the finding of a cause that was searched for; its first parameter is its size.

    Given are also what it and its alternatives lack in log-likelihood, the best first, other
    confounders, the numbers of `observed_range` for the next experiment, the smallest detectable
    size in standard deviations, and fields of the finding in place of those that follow from it.
    """
    size, others = next(iter(parameters.values())), {**deficits}
    others.pop(name, None)
    confounders = tuple(dict.fromkeys((*others, *confounders)))
    usual: dict[str, Any] = {'probability': probabilities({name: 0.0, **deficits})}
    if size.deviation > 0.0:
        usual |= {'minimum_detectable': sigmas * size.deviation,
                  'evidence': f'{abs(size.estimate) / size.deviation:.3g} sigma from zero'}
    experiment = '' if observed is None else next_experiment(name, [*others.items()], observed)
    if experiment:
        usual['separate_by'] = experiment
    found = make_finding(name, parameters, max(p_value, _LEAST_CHANCE), confounders,
                         **{**usual, **fields})
    return found if is_established else mark_suspected(found)


def cause_parameters(name: str, coefficients: Array, covariance: Array,
                     shapes: Mapping[str, Estimate]) -> dict[str, Estimate]:
    """
    Return the parameters of a cause, first the one with its name.

    Those of sine and cosine are amplitude and phase. Given are the coefficients of its columns,
    (k,), their covariance, by which normal intervals hold 95 %, and its fitted shapes.
    """
    effect = CATALOGUE.get(name)
    own = () if effect is None else effect.coefficients
    unit = own[0].unit if own else CAUSES[name].units.get(name, '1')
    half = NORMAL_QUANTILE_975 * np.sqrt(np.maximum(np.diag(covariance), 0.0))
    if len(own) > 1 and [each.name for each in own] != ['sine', 'cosine']:
        found = {each.name: Estimate.from_half_width(value, within, each.unit)
                 for each, value, within in zip(own, coefficients.tolist(), half.tolist())}
    elif len(coefficients) == 2 and name != 'reference_slip':
        sine, cosine = coefficients.tolist()
        amplitude = math.hypot(sine, cosine)
        rotation = np.array([[sine, cosine], [-cosine, sine]]) / amplitude
        half = NORMAL_QUANTILE_975 * np.sqrt(np.diag(rotation @ covariance @ rotation.T))
        found = {name: Estimate.from_half_width(amplitude, float(half[0]), unit),
                 'phase': Estimate.from_half_width(math.atan2(cosine, sine),
                                                   float(half[1]) / amplitude, 'rad')}
    else:
        found = {}
        if len(coefficients):
            found[name] = Estimate.from_half_width(float(coefficients[0]), float(half[0]), unit)
    for shape, size in shapes.items():
        found[shape if found else name] = size
    return found


def slip_times(times: Iterable[float]) -> dict[str, Estimate]:
    """Return the times of slips of a reference, s, as parameters."""
    return {f'slip_time_{place}': Estimate(at, (at, at), 's') for place, at in enumerate(times)}


def mark_suspected(found: Finding) -> Finding:
    """Return a finding as suspected, with the experiment that would establish it as remedy."""
    separate_by = CAUSES[found.effect].separate_by
    if not separate_by:
        remedy = 'record longer, and check that it is found again'
    elif separate_by.startswith('record again'):
        remedy = separate_by
    else:
        remedy = f'record again: {separate_by}'
    return replace(found, status='suspected', remedy=remedy)


def mark_parts_of_log(findings: Sequence[Finding]) -> list[Finding]:
    """Return findings of one log; steps of the bias that cancel are an effect of a part of it."""
    marked = list(findings)
    places = [place for place, each in enumerate(marked)
              if each.effect == 'bias_step' and each.status == 'established']
    places.sort(key=lambda place: marked[place].where or ())
    while len(places) > 1:
        first, second = places[0], places[1]
        one, other = (marked[place].parameters['bias_step'] for place in (first, second))
        begin, end = (marked[place].where for place in (first, second))
        places = places[1:]
        if begin and end and abs(one.estimate + other.estimate) < NORMAL_QUANTILE_975 * math.hypot(
                one.deviation, other.deviation):
            marked[first] = replace(marked[first], where=(begin[0], end[0]),
                                    cause='The bias differs in a part of the log.')
            marked[second] = replace(marked[second],
                                     cause='The bias returns to its earlier value.')
            places = places[1:]
    return marked


#: Remedy of an event that is not added to a model.
SINGLE_EVENT_REMEDY = 'find its cause; it occurs in this log alone, and is not added to the model'
_REMEDIES = {
    'gyro': 'add it to the model of the gyro',
    'reference': 'repair or replace the reference, or keep it out of calibrations',
    'record': 'repair the recording',
    'outliers': 'avoid shocks, or repair the line or the recording',
    'noise': 'use the noise figures of the extended model'}


def add_remedies(findings: Sequence[Finding], shares: Mapping[str, float],
                 model: GyroModel) -> list[Finding]:
    """Return findings with their shares of the heading error and their remedies."""
    inside = {term.effect.name for term in model.terms}

    def remedy(effect: str) -> str:
        origin = CAUSES[effect].origin
        return ('find its cause; the extended model does not contain it'
                if origin == 'gyro' and effect not in inside
                else _REMEDIES.get(effect, _REMEDIES[origin]))

    return [replace(each, share_of_heading_error=shares.get(each.effect),
                    remedy=each.remedy or remedy(each.effect)) for each in findings]


#: Next experiment, with numbers of `observed_range` -> pairs of causes that it distinguishes.
_EXPERIMENTS: Mapping[str, str] = {
    'heat and cool it twice between {low:.0f} and {high:.0f} °C within one log, at rest, from a '
    'power-on at {high:.0f} °C': 'bias_temperature rate_ramp, bias_temperature warm_up',
    'heat and cool it twice between {low:.0f} and {high:.0f} °C at rest, at two temperature '
    'rates, with abrupt changes and pauses of 2 min':
        'bias_temperature_rate thermal_lag, bias_temperature_rate thermal_hysteresis, '
        'thermal_lag thermal_hysteresis, bias_temperature thermal_lag',
    'let it rest for {long:.0f} min at one temperature, from power-on': 'warm_up rate_ramp',
    'turn whole turns at three speeds, and stop at eight headings, 45 deg apart':
        'heading_sensitivity reference_once_per_rev',
    'turn both ways at eight speeds, slow ones too, up to {top:.3g} deg/s':
        'scale_factor_asymmetry quadratic_nonlinearity',
    'turn both ways at up to {faster:.3g} deg/s, or as far beyond {top:.3g} deg/s as the gyro '
    'allows': 'cubic_nonlinearity sine_response, cubic_nonlinearity saturation, '
              'sine_response saturation',
    'rest with the motor on and off, half a minute each, for 5 min':
        'scale_factor_asymmetry vibration_rectification, '
        'quadratic_nonlinearity vibration_rectification',
    'rest for half a minute each with the axis up, level, down and level, turned over slowly '
    'within one power-on':
        'quadratic_nonlinearity acceleration_sensitivity, '
        'scale_factor_asymmetry acceleration_sensitivity, '
        'heading_sensitivity acceleration_sensitivity, bias acceleration_sensitivity',
    'swing with quick reversals for 2 min or more at up to {top:.3g} deg/s':
        'time_offset bandwidth',
    'record {long:.0f} min with quick reversals at up to {top:.3g} deg/s at both ends':
        'time_offset clock_rate, clock_rate scale_factor_error',
    'record the same again, from another power-on: a single event does not repeat':
        'bias_step thermal_hysteresis, bias_step bias_temperature_rate, bias_step warm_up',
    'step the supply by 5 % each minute at one temperature and at rest':
        'bias_temperature supply_sensitivity',
}
_EXPERIMENT_BY_PAIR = {frozenset(pair.split()): words
                       for words, pairs in _EXPERIMENTS.items() for pair in pairs.split(', ')}


def next_experiment(name: str, alternatives: Sequence[tuple[str, float]],
                    observed_range: Mapping[str, float]) -> str:
    """
    Return the next experiment that distinguishes a cause from others, in words.

    The alternatives are names with their deficits in log-likelihood, half the square of the sigmas
    by which these logs distinguish them; similar logs together do by the root of their number
    more.
    """
    found: dict[str, list[str]] = {}
    for other, lack in alternatives:
        words = _EXPERIMENT_BY_PAIR.get(frozenset((name, other)), '')
        if (not words
                or any(f'{{{key}:' in words for key in {'top', 'low'} - observed_range.keys())):
            words = CAUSES[name].separate_by or CAUSES[other].separate_by
        sigmas = math.sqrt(2.0 * max(lack, 0.0))
        text = f'{other.replace("_", " ")} by {sigmas:.1f} sigma'
        if 0.1 * RULED_OUT_DEFICIT < lack < RULED_OUT_DEFICIT:  # up to ten logs are proposed
            logs = math.ceil(RULED_OUT_DEFICIT / lack)
            text += f', {logs} such logs together by {math.sqrt(logs) * sigmas:.1f}'
        found.setdefault(words.format(**observed_range), []).append(text)
    return '; '.join(f'{words} (the data at hand distinguish {", ".join(texts)})'
                     for words, texts in found.items() if words)
