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

from gyro_calibration.calibration.self_calibration import RunLimits
from gyro_calibration.diagnosis.data_quality import DataQuality
from gyro_calibration.diagnosis.findings import Finding
from gyro_calibration.diagnosis.regression import (
    FittedValues,
    is_single_event,
    SelectedCause,
    with_distorted_rate,
)
from gyro_calibration.diagnosis.residuals import NOISE_NAMES
from gyro_calibration.logs.log import Array
from gyro_calibration.model.effects import (
    BIAS,
    BIAS_TEMPERATURE,
    BIAS_TEMPERATURE_QUADRATIC,
    CATALOGUE,
    Effect,
    SCALE_FACTOR_ERROR,
)
from gyro_calibration.model.gyro_model import GyroModel, have_same_effects, Term
from gyro_calibration.model.noise import Noise
import numpy as np

#: Limits of a plausible scale factor error and its standard deviation.
SCALE_FACTOR_LIMITS = RunLimits()
#: Effects with a reference value -> the effect that compensates a change of that value.
_COMPENSATING_EFFECTS: Mapping[str, Effect] = {
    'bias_temperature': BIAS, 'supply_sensitivity': BIAS,
    'scale_factor_temperature': SCALE_FACTOR_ERROR, 'bias_temperature_quadratic': BIAS_TEMPERATURE}


def extend_model(model: GyroModel | None, fit: FittedValues, quality: Sequence[DataQuality],
                 findings: Sequence[Finding], noise: Noise, bias_deviation: float) -> GyroModel:
    """
    Return the extended model; the given one if no finding concerns the gyro.

    Parameters
    ----------
    model : of the simulation, by `merge_self_calibration`; None for an ideal gyro
    fit : the causes and their values, none of them of `unmergeable_causes`
    quality : of each log
    findings : all; of the noise of a given model, only the figures with a finding are replaced
    noise : of the residual
    bias_deviation : standard deviation of the bias, rad/s

    """
    given = model or GyroModel()
    names = {name for each in findings for name in (each.effect, *each.ambiguous_with)}
    fitted = (model is None or names & {BIAS.name, SCALE_FACTOR_ERROR.name}
              or any(each.candidate.cause in CATALOGUE and fit.is_included(place)
                     for place, each in enumerate(fit.causes)))
    new = add_causes(given, fit, bias_deviation) if fitted else given
    # limit and quantization of the output, if they are findings, from the first log; exact
    output_terms: dict[str, Term] = {}
    for clean in quality:
        sizes = {'saturation': clean.limit, 'quantization': clean.output_step}
        for name in (each.effect for each in clean.findings if sizes.get(each.effect)):
            output_terms.setdefault(name, Term(CATALOGUE[name], (float(sizes[name] or 0.0),)))
    terms = [term for term in output_terms.values() if _is_within_bounds(term)]
    if terms:
        term_covariance = np.zeros((len(terms), len(terms)))
        new = replace(new, terms=_merge_terms(new.terms, terms),
                      covariance=_extended_covariance(new, terms, term_covariance))
    figures = replace(given.noise, **{each.effect: getattr(noise, each.effect)
                                      for each in findings if each.effect in NOISE_NAMES})
    if model is not None and have_same_effects(new, model) and figures == model.noise:
        return model
    figures = figures if given.noise.angle_random_walk else noise
    bounds = {name: ends for name, ends in given.noise_bounds.items()
              if getattr(figures, name) == getattr(given.noise, name)}
    return add_origin_notes(replace(new, noise=figures, noise_bounds=bounds), given, quality,
                            findings)


def add_causes(model: GyroModel, fit: FittedValues, bias_deviation: float) -> GyroModel:
    """Return a model with all named effects of the gyro, and with corrected bias and scale."""
    new, term_covariance = _terms_with_covariance(fit, bias_deviation)
    moves = _has_motion(fit) and not is_scale_implausible(fit)
    return add_terms(model, new, term_covariance,
                     [each.channels.output[each.valid] + each.simulated_error[each.valid]
                      for each in fit.replays if moves],
                     [each.channels.temperature[each.valid]
                      for each in fit.replays if 'temperature' in each.available_channels])


def add_terms(model: GyroModel, new: Sequence[Term], term_covariance: Array,
              outputs: Sequence[Array], temperatures: Sequence[Array]) -> GyroModel:
    """Return a model with more terms and their covariance, and ranges that include the logs."""
    has_ranges = bool(model.terms)
    return replace(
        model, terms=_merge_terms(model.terms, new),
        covariance=_extended_covariance(model, new, term_covariance),
        rate_range=widen_range(model.rate_range, outputs, has_ranges),
        temperature_range=widen_range(model.temperature_range, temperatures, has_ranges))


def add_origin_notes(new: GyroModel, base_model: GyroModel, quality: Sequence[DataQuality],
                     findings: Sequence[Finding] = ()) -> GyroModel:
    """Return a new model with its ambiguities, output factors and predecessor in its origin."""
    used = {term.effect.name for term in new.terms if term not in base_model.terms}
    notes = origin_notes([each for each in findings if each.effect in used],
                         [clean.unit_factor for clean in quality])
    return replace(new, origin={**notes, **previous_origins(base_model)})


def origin_notes(findings: Sequence[Finding], factors: Sequence[float]) -> dict[str, object]:
    """Return the notes on ambiguous findings and on factors of the output for a model file."""
    sets = [f'{each.effect} is used; it may be {" or ".join(each.ambiguous_with)} instead'
            for each in findings if each.ambiguous_with]
    output_factors = list(factors) if any(factor != 1.0 for factor in factors) else []
    return {name: note for name, note in (('ambiguous', sets),
                                          ('output_multiplied_by', output_factors)) if note}


def previous_origins(model: GyroModel) -> dict[str, object]:
    """Return the origins of a model as a list, because its file has a limited nesting depth."""
    earlier = model.origin.get('before', [])
    own = {name: value for name, value in model.origin.items() if name != 'before'}
    return {'before': [own, *(earlier if isinstance(earlier, list) else [earlier])]} if own else {}


def merge_self_calibration(model: GyroModel) -> GyroModel:
    """Return a model with its self-calibration merged into its terms, to first order."""
    known = model.self_calibration
    if known is None:
        return model
    slope = 1.0 + sum(term.values[0] for term in model.terms if term.effect is SCALE_FACTOR_ERROR)
    new = [Term(SCALE_FACTOR_ERROR, (slope * known.scale_factor_error,)),
           Term(BIAS, (slope * known.bias,))]
    covariance = (None if known.covariance is None
                  else _extended_covariance(model, new, slope ** 2 * np.array(known.covariance)))
    return replace(model, terms=_merge_terms(model.terms, new), covariance=covariance,
                   self_calibration=None)


def unmergeable_causes(model: GyroModel, fit: FittedValues) -> tuple[SelectedCause, ...]:
    """Return the lasting causes of the gyro that cannot be merged with terms of its model."""
    terms, unmergeable = model.terms, []
    for place, known in enumerate(fit.causes):
        if known.candidate.cause in CATALOGUE and not is_single_event(known):
            more = _merge_term(terms, _term_of_cause(fit, place))
            unmergeable += [known] if more is None else []
            terms = more or terms
    return tuple(unmergeable)


def is_scale_implausible(fit: FittedValues) -> bool:
    """
    Tell whether the fitted scale factor error is implausible.

    If the gyro hardly turns, the noise of the reference passes for motion that the gyro does not
    measure, which gives a scale factor error of up to -100 %.

    """
    scale = fit.scale_factor_error
    return _has_motion(fit) and (scale.value < -SCALE_FACTOR_LIMITS.max_scale_factor_error
                                 or scale.deviation > SCALE_FACTOR_LIMITS.max_scale_deviation)


def _has_motion(fit: FittedValues) -> bool:
    return fit.estimate_index(-1, 0) is not None


# values

def _terms_with_covariance(fit: FittedValues, bias_deviation: float) -> tuple[list[Term], Array]:
    """Return the fitted terms, and the covariance of all their values, 0 for exact ones."""
    implausible = is_scale_implausible(fit)
    scale = 0.0 if implausible else fit.scale_factor_error.value
    # the mean bias of the logs given that scale factor error
    rates = [with_distorted_rate(each, fit.causes).channels.rate[each.valid].mean()
             for each in fit.replays]
    bias = np.mean(fit.biases) + (fit.scale_factor_error.value - scale) * np.mean(rates)
    terms = [Term(BIAS, (float(bias),)), Term(SCALE_FACTOR_ERROR, (scale,))]
    ranks: list[int | None] = [None, None if implausible else fit.estimate_index(-1, 0)]
    for place, known in enumerate(fit.causes):
        if known.candidate.cause in CATALOGUE and fit.is_included(place):
            terms.append(_term_of_cause(fit, place))
            shapes = len(known.candidate.shapes)
            ranks += [
                fit.estimate_index(place, -1 - number if number < shapes else number - shapes)
                for number in range(len(terms[-1].values))]
    fitted = [number for number, rank in enumerate(ranks) if rank is not None]
    chosen = [rank for rank in ranks if rank is not None]
    term_covariance = np.zeros((len(ranks), len(ranks)))
    term_covariance[np.ix_(fitted, fitted)] = fit.covariance[np.ix_(chosen, chosen)]
    term_covariance[0, 0] = bias_deviation ** 2
    return terms, term_covariance


def _term_of_cause(fit: FittedValues, cause_index: int) -> Term:
    """Return a cause of the gyro as a term."""
    candidate = fit.causes[cause_index].candidate
    effect = CATALOGUE[candidate.cause]
    coefficients = ([one.value for one in fit.coefficients(cause_index)]
                    or [candidate.amplitude or 0.0][:len(effect.coefficients)])
    return Term(effect, (*candidate.shapes, *coefficients))


# terms among others

def _merge_terms(terms: tuple[Term, ...], new: Sequence[Term]) -> tuple[Term, ...]:
    for each in new:
        terms = _merge_term(terms, each) or terms
    return terms


def _merge_term(terms: tuple[Term, ...], new: Term) -> tuple[Term, ...] | None:
    """Return terms with one more, merged with that of its effect; None if not possible."""
    old = next((term for term in terms if term.effect.name == new.effect.name), None)
    if old is None:
        return (*terms, new)
    aligned, *others = _align_reference(old, new)
    one = _combine_terms(old, aligned)
    return (None if one is None
            else _merge_terms(tuple(one if term is old else term for term in terms), others))


def _align_reference(old: Term, new: Term) -> list[Term]:
    """Return a term with the reference value of another, and the terms that compensate this."""
    if new.effect.name not in _COMPENSATING_EFFECTS or new.values[0] == old.values[0]:
        return [new]
    begin, value = old.values[0], new.values[1]
    offset, compensating_effect = begin - new.values[0], _COMPENSATING_EFFECTS[new.effect.name]
    aligned = Term(new.effect, (begin, value))
    if new.effect is BIAS_TEMPERATURE_QUADRATIC:
        return [aligned, Term(compensating_effect, (begin, 2.0 * offset * value)),
                Term(BIAS, (offset ** 2 * value, ))]
    return [aligned, Term(compensating_effect, (offset * value,))]


def _combine_terms(old: Term, new: Term) -> Term | None:
    """Return the term that is equivalent to two terms of one effect; None without one."""
    effect, shapes = new.effect, len(new.effect.nonlinear_parameters)
    if effect.stage == 'output':
        # Logs are compared without limits and quantization of the model.
        return new
    # Delays add up, and so do clock rate errors, to first order.
    first = 0 if effect.correct_stamps is not None else shapes
    if new.values[:first] != old.values[:first] or (first and not effect.coefficients) or any(
            each.default is not None for each in effect.coefficients):
        return None
    combined = Term(effect, (*new.values[:first],
                             *(a + b for a, b in zip(old.values[first:], new.values[first:]))))
    return combined if _is_within_bounds(combined) else None


def _is_within_bounds(term: Term) -> bool:
    """Tell whether the values of a term are within the bounds of its effect."""
    return all(parameter.bounds[0] <= value <= parameter.bounds[1]
               for parameter, value in zip(term.effect.parameters, term.values))


# covariance


def _extended_covariance(model: GyroModel, new: Sequence[Term],
                         term_covariance: Array) -> Array | None:
    """
    Return the covariance of all fitted values of a model with new terms; None if unknown before.

    Parameters
    ----------
    model : whose values come first; new ones are independent of them
    new : the added terms
    term_covariance : covariance of all their values

    """
    if model.terms and model.covariance is None:
        return None
    values = _fitted_values(_merge_terms(model.terms, new))
    deviations = np.sqrt(np.diag(term_covariance))
    changes = np.zeros((len(values), len(term_covariance)))
    for place in np.flatnonzero(deviations).tolist():
        changes[:, place] = (_fitted_values(
            _merge_terms(model.terms, list(_perturb_value(new, place, deviations[place]))))
                             - values) / deviations[place]
    covariance = changes @ term_covariance @ changes.T
    if model.covariance is not None:
        covariance[:len(model.covariance), :len(model.covariance)] += model.covariance
    return covariance


def _fitted_values(terms: Sequence[Term]) -> Array:
    return np.array([term.values[place] for term in terms for place in term.fitted_indices])


def _perturb_value(terms: Sequence[Term], place: int, change: float) -> Iterator[Term]:
    """Give terms of which one value, by its index among all values, is changed."""
    for term in terms:
        here = 0 <= place < len(term.values)
        yield replace(term, values=(*term.values[:place], term.values[place] + change,
                                    *term.values[place + 1:])) if here else term
        place -= len(term.values)


def widen_range(known: tuple[float, float], parts: Sequence[Array],
                is_existing: bool) -> tuple[float, float]:
    """Return a range that includes the logs; only theirs if the model had none before."""
    if not parts:
        return known
    low, high = min(float(part.min()) for part in parts), max(float(part.max()) for part in parts)
    return (min(known[0], low), max(known[1], high)) if is_existing else (low, high)
