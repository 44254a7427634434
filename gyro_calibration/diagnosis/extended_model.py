# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The model extended by the findings: effects, limits, values, covariance, noise and origin."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

from gyro_calibration.calibration.self_calibration import Limits
from gyro_calibration.diagnosis.data_quality import DataQuality
from gyro_calibration.diagnosis.findings import Finding
from gyro_calibration.diagnosis.regression import FittedValues, happens_once, Named, seen
from gyro_calibration.diagnosis.residuals import NAMES
from gyro_calibration.logs.log import Array
from gyro_calibration.model.effects import (
    BIAS,
    BIAS_TEMPERATURE,
    BIAS_TEMPERATURE_QUADRATIC,
    CATALOGUE,
    Effect,
    SCALE_FACTOR_ERROR,
)
from gyro_calibration.model.gyro_model import GyroModel, same_effects, Term
from gyro_calibration.model.noise import Noise
import numpy as np

#: Limits of a plausible scale factor error and its standard deviation.
LIMITS = Limits()
#: Effects with a reference value -> the effect that compensates a change of that value.
_MADE_UP_BY: Mapping[str, Effect] = {
    'bias_temperature': BIAS, 'supply_sensitivity': BIAS,
    'scale_factor_temperature': SCALE_FACTOR_ERROR, 'bias_temperature_quadratic': BIAS_TEMPERATURE}


def with_findings(model: GyroModel | None, found: FittedValues, quality: Sequence[DataQuality],
                  findings: Sequence[Finding], noise: Noise, bias_deviation: float) -> GyroModel:
    """
    Return the extended model; the given one if no finding concerns the gyro.

    Parameters
    ----------
    model : of the simulation, `calibrated`; None for an ideal gyro
    found : the causes and their values, none of them `left_out`
    quality : of each log
    findings : all; of the noise of a given model, only the figures with a finding are replaced
    noise : of the residual
    bias_deviation : standard deviation of the bias, rad/s

    """
    given, names = (model or GyroModel(),
                    {name for each in findings for name in (each.effect, *each.ambiguous_with)})
    fitted = (model is None or names & {BIAS.name, SCALE_FACTOR_ERROR.name}
              or any(each.candidate.cause in CATALOGUE and found.explaining(place)
                     for place, each in enumerate(found.named)))
    new = extended(given, found, bias_deviation) if fitted else given
    # limit and quantization of the output, if they are findings, from the first log; exact
    exact: dict[str, Term] = {}
    for clean in quality:
        sizes = {'saturation': clean.limit, 'quantization': clean.step}
        for name in (each.effect for each in clean.findings if sizes.get(each.effect)):
            exact.setdefault(name, Term(CATALOGUE[name], (float(sizes[name] or 0.0),)))
    terms = [term for term in exact.values() if _is_within(term)]
    if terms:
        spread = np.zeros((len(terms), len(terms)))
        new = replace(new, terms=_all(new.terms, terms),
                      covariance=_covariance(new, terms, spread))
    figures = replace(given.noise, **{each.effect: getattr(noise, each.effect)
                                      for each in findings if each.effect in NAMES})
    if model is not None and same_effects(new, model) and figures == model.noise:
        return model
    figures = figures if given.noise.angle_random_walk else noise
    bounds = {name: ends for name, ends in given.noise_bounds.items()
              if getattr(figures, name) == getattr(given.noise, name)}
    return noted(replace(new, noise=figures, noise_bounds=bounds), given, quality, findings)


def extended(model: GyroModel, found: FittedValues, bias_deviation: float) -> GyroModel:
    """Return a model with all named effects of the gyro, and with corrected bias and scale."""
    new, spread = _values(found, bias_deviation)
    moves = _moves(found) and not implausible_scale(found)
    return with_terms(model, new, spread, [each.channels.output[each.kept] + each.added[each.kept]
                                           for each in found.replays if moves],
                      [each.channels.temperature[each.kept]
                       for each in found.replays if 'temperature' in each.has])


def with_terms(model: GyroModel, new: Sequence[Term], spread: Array, outputs: Sequence[Array],
               temperatures: Sequence[Array]) -> GyroModel:
    """Return a model with more terms of covariance `spread`, and ranges that include the logs."""
    was = bool(model.terms)
    return replace(model, terms=_all(model.terms, new), covariance=_covariance(model, new, spread),
                   rate_range=wider(model.rate_range, outputs, was),
                   temperature_range=wider(model.temperature_range, temperatures, was))


def noted(new: GyroModel, given: GyroModel, quality: Sequence[DataQuality],
          findings: Sequence[Finding] = ()) -> GyroModel:
    """Return a new model with its ambiguities, output factors and predecessor in its origin."""
    used = {term.effect.name for term in new.terms if term not in given.terms}
    notes = notes_of([each for each in findings if each.effect in used],
                     [clean.factor for clean in quality])
    return replace(new, origin={**notes, **origins_before(given)})


def notes_of(findings: Sequence[Finding], factors: Sequence[float]) -> dict[str, object]:
    """Return the notes on ambiguous findings and on factors of the output for a model file."""
    sets = [f'{each.effect} is used; it may be {" or ".join(each.ambiguous_with)} instead'
            for each in findings if each.ambiguous_with]
    mended = list(factors) if any(factor != 1.0 for factor in factors) else []
    return {name: note for name, note in (('ambiguous', sets), ('output_multiplied_by', mended))
            if note}


def origins_before(model: GyroModel) -> dict[str, object]:
    """Return the origins of a model as a list, because its file has a limited nesting depth."""
    earlier = model.origin.get('before', [])
    own = {name: value for name, value in model.origin.items() if name != 'before'}
    return {'before': [own, *(earlier if isinstance(earlier, list) else [earlier])]} if own else {}


def calibrated(model: GyroModel) -> GyroModel:
    """Return a model with its self-calibration merged into its terms, to first order."""
    known = model.self_calibration
    if known is None:
        return model
    slope = 1.0 + sum(term.values[0] for term in model.terms if term.effect is SCALE_FACTOR_ERROR)
    new = [Term(SCALE_FACTOR_ERROR, (slope * known.scale_factor_error,)),
           Term(BIAS, (slope * known.bias,))]
    covariance = (None if known.covariance is None
                  else _covariance(model, new, slope ** 2 * np.array(known.covariance)))
    return replace(model, terms=_all(model.terms, new), covariance=covariance,
                   self_calibration=None)


def left_out(model: GyroModel, found: FittedValues) -> tuple[Named, ...]:
    """Return the lasting causes of the gyro that cannot be merged with terms of its model."""
    terms, out = model.terms, []
    for place, known in enumerate(found.named):
        if known.candidate.cause in CATALOGUE and not happens_once(known):
            more = _with(terms, _term(found, place))
            out += [known] if more is None else []
            terms = more or terms
    return tuple(out)


def implausible_scale(found: FittedValues) -> bool:
    """
    Tell whether the fitted scale factor error is implausible.

    If the gyro hardly turns, the noise of the reference passes for motion that the gyro does not
    measure, which gives a scale factor error of up to -100 %.

    """
    scale = found.scale_factor_error
    return _moves(found) and (scale.value < -LIMITS.scale_factor_error
                              or scale.deviation > LIMITS.scale_standard_deviation)


def _moves(found: FittedValues) -> bool:
    return found.place(-1, 0) is not None


# values

def _values(found: FittedValues, bias_deviation: float) -> tuple[list[Term], Array]:
    """Return the fitted terms, and the covariance of all their values, 0 for exact ones."""
    implausible = implausible_scale(found)
    scale = 0.0 if implausible else found.scale_factor_error.value
    # the mean bias of the logs given that scale factor error
    rates = [seen(each, found.named).channels.rate[each.kept].mean() for each in found.replays]
    bias = np.mean(found.biases) + (found.scale_factor_error.value - scale) * np.mean(rates)
    terms = [Term(BIAS, (float(bias),)), Term(SCALE_FACTOR_ERROR, (scale,))]
    ranks: list[int | None] = [None, None if implausible else found.place(-1, 0)]
    for place, known in enumerate(found.named):
        if known.candidate.cause in CATALOGUE and found.explaining(place):
            terms.append(_term(found, place))
            shapes = len(known.candidate.shapes)
            ranks += [found.place(place, -1 - number if number < shapes else number - shapes)
                      for number in range(len(terms[-1].values))]
    fitted = {number: rank for number, rank in enumerate(ranks) if rank is not None}
    spread = np.zeros((len(ranks), len(ranks)))
    spread[np.ix_(list(fitted), list(fitted))] = found.covariance[
        np.ix_(list(fitted.values()), list(fitted.values()))]
    spread[0, 0] = bias_deviation ** 2
    return terms, spread


def _term(found: FittedValues, place: int) -> Term:
    """Return a cause of the gyro as a term."""
    candidate = found.named[place].candidate
    effect = CATALOGUE[candidate.cause]
    coefficients = ([one.value for one in found.coefficients(place)]
                    or [candidate.amplitude or 0.0][:len(effect.coefficients)])
    return Term(effect, (*candidate.shapes, *coefficients))


# terms among others

def _all(terms: tuple[Term, ...], new: Sequence[Term]) -> tuple[Term, ...]:
    for each in new:
        terms = _with(terms, each) or terms
    return terms


def _with(terms: tuple[Term, ...], new: Term) -> tuple[Term, ...] | None:
    """Return terms with one more, merged with that of its effect; None if not possible."""
    old = next((term for term in terms if term.effect.name == new.effect.name), None)
    if old is None:
        return (*terms, new)
    alike, *others = _counted_like(old, new)
    one = _one(old, alike)
    return None if one is None else _all(
        tuple(one if term is old else term for term in terms), others)


def _counted_like(old: Term, new: Term) -> list[Term]:
    """Return a term with the reference value of another, and the terms that compensate this."""
    if new.effect.name not in _MADE_UP_BY or new.values[0] == old.values[0]:
        return [new]
    begin, value = old.values[0], new.values[1]
    way, other, alike = (begin - new.values[0], _MADE_UP_BY[new.effect.name],
                         Term(new.effect, (begin, value)))
    if new.effect is BIAS_TEMPERATURE_QUADRATIC:
        return [alike, Term(other, (begin, 2.0 * way * value)), Term(BIAS, (way ** 2 * value,))]
    return [alike, Term(other, (way * value,))]


def _one(old: Term, new: Term) -> Term | None:
    """Return the term that is equivalent to two terms of one effect; None without one."""
    effect, shapes = new.effect, len(new.effect.shapes)
    if effect.stage == 'output':
        # Logs are compared without limits and quantization of the model.
        return new
    # Delays add up, and so do clock rate errors, to first order.
    first = 0 if effect.moved is not None else shapes
    if new.values[:first] != old.values[:first] or (first and not effect.coefficients) or any(
            each.default is not None for each in effect.coefficients):
        return None
    one = Term(effect, (*new.values[:first],
                        *(a + b for a, b in zip(old.values[first:], new.values[first:]))))
    return one if _is_within(one) else None


def _is_within(term: Term) -> bool:
    """Tell whether the values of a term are within the bounds of its effect."""
    return all(parameter.bounds[0] <= value <= parameter.bounds[1]
               for parameter, value in zip(term.effect.parameters, term.values))


# covariance

def _covariance(model: GyroModel, new: Sequence[Term], spread: Array) -> Array | None:
    """
    Return the covariance of all fitted values of a model with new terms; None if unknown before.

    Parameters
    ----------
    model : whose values come first; new ones are independent of them
    new : the added terms
    spread : covariance of all their values

    """
    if model.terms and model.covariance is None:
        return None
    values, moved = _fitted(_all(model.terms, new)), np.sqrt(np.diag(spread))
    changes = np.zeros((len(values), len(spread)))
    for place in np.flatnonzero(moved).tolist():
        changes[:, place] = (_fitted(_all(
            model.terms, list(_moved(new, place, moved[place])))) - values) / moved[place]
    whole = changes @ spread @ changes.T
    if model.covariance is not None:
        whole[:len(model.covariance), :len(model.covariance)] += model.covariance
    return whole


def _fitted(terms: Sequence[Term]) -> Array:
    return np.array([term.values[place] for term in terms for place in term.fitted])


def _moved(terms: Sequence[Term], place: int, change: float) -> Iterator[Term]:
    """Give terms of which one value, by its index among all values, is changed."""
    for term in terms:
        here = 0 <= place < len(term.values)
        yield replace(term, values=(*term.values[:place], term.values[place] + change,
                                    *term.values[place + 1:])) if here else term
        place -= len(term.values)


def wider(known: tuple[float, float], parts: Sequence[Array], was: bool) -> tuple[float, float]:
    """Return a range that includes the logs; only theirs if the model had none before."""
    if not parts:
        return known
    low, high = min(float(part.min()) for part in parts), max(float(part.max()) for part in parts)
    return (min(known[0], low), max(known[1], high)) if was else (low, high)
