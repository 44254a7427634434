"""
The model with what was found: named effects, values, covariance.

"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from gyro_calibration.diagnosis.outcome import Outcome
from gyro_calibration.effects import BIAS, CATALOGUE, SCALE_FACTOR_ERROR
from gyro_calibration.log import Array
from gyro_calibration.model import GyroModel, Term
from gyro_calibration.noise import Noise


def extended(model: GyroModel, found: Outcome, noise: Noise, bias_deviation: float, origin: Mapping[str, object]) -> GyroModel:
    """
    Return the model of the simulation with all effects of the gyro that were named.

    Parameters
    ----------
    model : of the simulation
    found : the causes and their values
    noise : of what they leave
    bias_deviation : standard deviation of the bias, rad/s
    origin : what the file is to say of where it comes from

    """
    bias = float(np.mean(found.biases))
    terms = _added(_added(list(model.terms), Term(BIAS, (bias,))), Term(SCALE_FACTOR_ERROR, (found.scale_factor_error.value,)))
    new = [(place, known) for place, known in enumerate(found.named) if known.candidate.cause in CATALOGUE]
    for place, known in new:
        candidate = known.candidate
        effect = CATALOGUE[candidate.cause]
        coefficients = [one.value for one in found.coefficients(place)] or [candidate.amplitude or 0.0][:len(effect.coefficients)]
        terms = _added(terms, Term(effect, (*candidate.shapes, *coefficients)))
    covariance = _covariance(terms, model, found, [place for place, _ in new], bias_deviation)
    rates, temperatures = _ranges(found)
    return replace(model, terms=tuple(terms), covariance=covariance, noise=noise, origin=dict(origin),
                   rate_range=_wider(model.rate_range, rates, bool(model.terms)),
                   temperature_range=_wider(model.temperature_range, temperatures, bool(model.terms)))


def _added(terms: list[Term], new: Term) -> list[Term]:
    """Return terms with one more, or with a larger value of one that is there already."""
    for place, term in enumerate(terms):
        shapes = len(new.effect.shapes)
        if term.effect.name == new.effect.name and term.values[:shapes] == new.values[:shapes] and new.effect.coefficients:
            values = [*term.values[:shapes], *(a + b for a, b in zip(term.values[shapes:], new.values[shapes:]))]
            return [*terms[:place], Term(term.effect, tuple(values)), *terms[place + 1:]]
    # A file names each effect once: of two, the one that was found first is the stronger.
    return terms if any(term.effect.name == new.effect.name for term in terms) else [*terms, new]


def _covariance(terms: Sequence[Term], model: GyroModel, found: Outcome, new: Sequence[int], bias_deviation: float) -> Array | None:
    """Return the covariance of all fitted values; None where that of the model's own is not known."""
    if model.terms and model.covariance is None:
        return None
    names: list[tuple[str, int]] = [(term.effect.name, place) for term in terms for place in term.fitted]
    at = {name: place for place, name in enumerate(names)}
    whole = np.zeros((len(names), len(names)))
    if model.covariance is not None:
        own = [at[term.effect.name, place] for term in model.terms for place in term.fitted]
        whole[np.ix_(own, own)] += model.covariance
    whole[at['bias', 0], at['bias', 0]] += bias_deviation ** 2
    pairs = list(_pairs(found, new, at))
    places, ranks = [pair[0] for pair in pairs], [pair[1] for pair in pairs]
    whole[np.ix_(places, places)] += found.covariance[np.ix_(ranks, ranks)]
    return whole


def _pairs(found: Outcome, new: Sequence[int], at: Mapping[tuple[str, int], int]) -> list[tuple[int, int]]:
    """Return for each new value its place in the model's covariance and in that of the search."""
    scale = found.place(-1, 0)
    pairs = [] if scale is None else [(at['scale_factor_error', 0], scale)]
    for cause in new:
        candidate = found.named[cause].candidate
        shapes = len(candidate.shapes)
        for (name, place), target in at.items():
            if name == candidate.cause:
                rank = found.place(cause, -1 - place if place < shapes else place - shapes)
                pairs += [] if rank is None else [(target, rank)]
    return pairs


def _ranges(found: Outcome) -> tuple[tuple[float, float], tuple[float, float]]:
    rates = [each.channels.output[each.kept] for each in found.replays]
    temperatures = [each.channels.temperature[each.kept] for each in found.replays if 'temperature' in each.has]
    return _range(rates), _range(temperatures)


def _range(parts: Sequence[Array]) -> tuple[float, float]:
    return (min(float(part.min()) for part in parts), max(float(part.max()) for part in parts)) if parts else (-np.inf, np.inf)


def _wider(known: tuple[float, float], new: tuple[float, float], was: bool) -> tuple[float, float]:
    return (min(known[0], new[0]), max(known[1], new[1])) if was else new
