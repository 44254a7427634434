# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""From what was searched and estimated to findings that people can read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
import math

from gyro_calibration.diagnosis.candidates import Candidate
from gyro_calibration.diagnosis.causes import CAUSES
from gyro_calibration.diagnosis.findings import Estimate, Finding, Unexplained
from gyro_calibration.diagnosis.fitted_values import FittedValues, happens_once, joined, Value
from gyro_calibration.diagnosis.generic_terms import along, is_named
from gyro_calibration.diagnosis.regression_problem import fitted, Named
from gyro_calibration.diagnosis.search import evidence_of, MOST_SLIPS, price_of_freedom, Search
from gyro_calibration.diagnosis.unit_confusion import unit_of_offset
from gyro_calibration.model.effects import CATALOGUE
from gyro_calibration.model.gyro_model import GyroModel
import numpy as np
from scipy.stats import norm

#: No probability below this is printed: the assumptions carry none.
LEAST_CHANCE = 1e-4
#: Power with which an effect of the minimum detectable size is found.
_POWER = 0.95
_DEVIATIONS = 1.96
#: Names of what has no other.
_SHAPES = {'reference_slip': ('width', *(f'slip_time_{place}' for place in range(MOST_SLIPS)))}


_ONCE = 'look for what caused it; it is of this log alone, and in no model for others'
_REMEDIES = {
    'gyro': 'add it to the model of the gyro',
    'reference': 'mend or replace the reference, or see that it does not enter a calibration',
    'record': 'mend the recording',
    'noise': 'take the figures of the extended model'}


def with_remedies(findings: Sequence[Finding], shares: Mapping[str, float],
                  model: GyroModel) -> list[Finding]:
    """Return findings with their share of the heading error, and what to do about them."""
    inside = {term.effect.name for term in model.terms}
    return [replace(each, share_of_heading_error=shares.get(each.effect), remedy=each.remedy or (
        '' if CAUSES[each.effect].of == 'gyro' and each.effect not in inside
        else _REMEDIES[CAUSES[each.effect].of])) for each in findings]


def named_finding(search: Search, found: FittedValues, place: int, p_value: float,
                  members: Sequence[tuple[Named, float]], separate_by: str) -> Finding:
    """Return what is said of a named cause, and of those that may be in its place."""
    candidate = found.named[place].candidate
    cause = CAUSES[candidate.cause]
    parameters = _parameters(found, place)
    lacks = {each.candidate.cause: lack for each, lack in reversed(members)}
    lacks.setdefault(candidate.cause, 0.0)
    weights = {name: math.exp(-max(lack, 0.0)) for name, lack in lacks.items()}
    probability = {name: max(weight / sum(weights.values()), LEAST_CHANCE)
                   for name, weight in sorted(weights.items(), key=lambda each: -each[1])}
    confounders = tuple(dict.fromkeys(each.candidate.cause for each, _ in members
                                      if each.candidate.cause != candidate.cause))
    unit = _unit(candidate.cause, parameters, found)
    size = next(iter(parameters.values()))
    half = 0.5 * (size.interval[1] - size.interval[0]) / _DEVIATIONS
    return Finding(candidate.cause, cause.sentence, parameters, p_value,
                   _detectable(search, found.named[place], half), (*confounders, *unit),
                   separate_by or (cause.separate_by if confounders or unit else ''),
                   _evidence(size, half, candidate.run, len(found.replays)), cause.along,
                   probability=probability, where=_where(found, candidate),
                   remedy=_ONCE if happens_once(found.named[place]) else '')


def _where(found: FittedValues, candidate: Candidate) -> tuple[float, float] | None:
    """Return from when to when a cause is in its log, s; None of the whole log."""
    if candidate.cause == 'bias_step':
        return candidate.shapes[0], float(found.replays[candidate.run or 0].channels.time[-1])
    if candidate.cause == 'reference_slip':
        return min(candidate.shapes[1:]), max(candidate.shapes[1:])
    return None


def _evidence(size: Estimate, half: float, run: int | None, logs: int) -> str:
    where = '' if run is None or logs == 1 else f'in log {run + 1}, '
    return f'{where}{abs(size.estimate) / half:.3g} sigma from zero' if half > 0.0 else ''


def _unit(name: str, parameters: Mapping[str, Estimate], found: FittedValues) -> tuple[str, ...]:
    """Return 'unit_error' where a delay is one that comes of a confusion."""
    if name != 'time_offset':
        return ()
    offset = parameters[name]
    deviation = (offset.interval[1] - offset.interval[0]) / (2.0 * _DEVIATIONS)
    return (('unit_error',)
            if unit_of_offset(offset.estimate, deviation, found.replays[0].interval) else ())


def _detectable(search: Search, known: Named, deviation: float) -> float | None:
    """Return the smallest size found with the power asked for; None without a deviation."""
    needed = search.chance.threshold(known.candidate.cause, search.rate) + price_of_freedom(known)
    # Half the square of a size in standard deviations is its evidence.
    return (float(np.sqrt(2.0 * max(needed, 0.0)) + norm.isf(1.0 - _POWER)) * deviation
            if deviation > 0.0 else None)


def _parameters(found: FittedValues, place: int) -> dict[str, Estimate]:
    """Return the parameters of a cause, the one that is named like it first."""
    candidate = found.named[place].candidate
    coefficients, shapes = found.coefficients(place), found.shapes(place)
    name, effect = candidate.cause, CATALOGUE.get(candidate.cause)
    names = (_SHAPES.get(name, ()) if effect is None
             else tuple(parameter.name for parameter in effect.shapes + effect.coefficients))
    unit = (effect.coefficients[0].unit if effect is not None and effect.coefficients
            else CAUSES[name].units.get(name, '1'))
    parameters = {}
    own = () if effect is None else effect.coefficients
    if len(own) > 1 and [each.name for each in own] != ['sine', 'cosine']:
        parameters = {each.name: _estimate(value, each.unit)
                      for each, value in zip(own, coefficients)}
    elif len(coefficients) == 2 and name != 'reference_slip':
        parameters = _as_phase(found, place, name, coefficients, unit)
    elif coefficients:
        parameters = {name: _estimate(coefficients[0], unit)}
    for number, value in shapes.items():
        parameters[names[number] if parameters else name] = _estimate(
            value, 's' if effect is None else effect.parameters[number].unit)
    if name == 'reference_slip':
        parameters.update({names[1 + number]: Estimate(at, (at, at), 's')
                           for number, at in enumerate(candidate.shapes[1:])})
    return parameters


def _estimate(value: Value, unit: str) -> Estimate:
    return Estimate.about(value.value, _DEVIATIONS * value.deviation, unit)


def _as_phase(found: FittedValues, place: int, name: str, coefficients: Sequence[Value],
              unit: str) -> dict[str, Estimate]:
    """Return amplitude and phase of ``sine sin + cosine cos``, with intervals by covariance."""
    sine, cosine = (value.value for value in coefficients)
    amplitude, phase = float(np.hypot(sine, cosine)), float(np.arctan2(cosine, sine))
    ranks = [rank for rank in (found.place(place, number) for number in range(2))
             if rank is not None]
    covariance = found.covariance[np.ix_(ranks, ranks)]
    turn = np.array([[np.cos(phase), np.sin(phase)], [-np.sin(phase), np.cos(phase)]])
    deviation = np.sqrt(np.diag(turn @ covariance @ turn.T))
    return {name: _estimate(Value(amplitude, float(deviation[0])), unit),
            'phase': _estimate(Value(phase, float(deviation[1]) / amplitude), 'rad')}


def unexplained(search: Search, found: FittedValues,
                unnamed: Sequence[Named]) -> list[Unexplained]:
    """Return the structures without a name, with the part that each explains of what is left."""
    everything = (*found.named, *unnamed)
    variables: dict[str, list[int]] = {}
    for place, known in enumerate(unnamed):
        name = (CAUSES[known.candidate.cause].along if is_named(known.candidate)
                else along(known.candidate))
        variables.setdefault(name, []).append(len(found.named) + place)
    least, most = _variance(search, found, everything), _variance(search, found, found.named)
    told = []
    for name, places in variables.items():
        without = _variance(search, found, [known for place, known in enumerate(everything)
                                            if place not in places])
        chance = min(search.chance.p_value(everything[place].candidate.cause,
                                           evidence_of(search, everything, place))
                     for place in places)
        told.append(Unexplained(name, max(without - least, 0.0) / most, chance))
    return told


def _variance(search: Search, found: FittedValues, named: Sequence[Named]) -> float:
    """Return the variance of what some causes leave, on the points that are searched."""
    left = FittedValues(fitted(search.problem, named), found.replays)
    return float(np.var(joined([each.on_grid(rest - bias) for each, rest, bias
                                in zip(found.replays, left.residuals, left.biases)])))
