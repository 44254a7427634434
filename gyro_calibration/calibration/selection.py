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
Selection of a gyro's effects: by the prediction of left-out sweeps, each choice with its reason.

Bias, scale factor error and their slopes over temperature belong to every model, as every gyro has
them: the slopes where the dwells determine them better than a data sheet does. Another effect is
taken where it reduces the error of left-out sweeps and is significant, given the number of effects
tried. Where two effects explain the data equally well, the one by the physics of the instrument is
taken, if the instrument is known.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math

from gyro_calibration.calibration.dwells import Dwells
from gyro_calibration.calibration.rate_table import Calibration, fit_effects
from gyro_calibration.calibration.scatter import find_scatter, Scatter
from gyro_calibration.calibration.tolerance import BIAS_SLOPE, SCALE_SLOPE
from gyro_calibration.logs.log import Array, DataRefused
from gyro_calibration.model.effects import (
    BIAS,
    BIAS_TEMPERATURE,
    BIAS_TEMPERATURE_QUADRATIC,
    Channels,
    CUBIC_NONLINEARITY,
    Effect,
    SCALE_FACTOR_ERROR,
    SCALE_FACTOR_TEMPERATURE,
    SINE_RESPONSE,
    STEADY,
)
import numpy as np

#: Probability of taking an effect that is not there, in one calibration.
FALSE_ALARM_RATE = 0.01
#: Standard deviations from which on two causes are distinguished: the wrong one is then taken in
#: one of thirty thousand calibrations.
DISTINGUISHED = 4.0
#: Standard deviations below which the data do not prefer one of two causes.
HARDLY = 2.0
#: Technology -> the effect, of two that are hard to distinguish, that its physics causes.
TECHNOLOGIES = {'open_loop_fog': SINE_RESPONSE, 'closed_loop_fog': CUBIC_NONLINEARITY,
                'mems': CUBIC_NONLINEARITY}
_CONFOUNDERS = ((SINE_RESPONSE, CUBIC_NONLINEARITY),)
#: Effects of every gyro that are fitted where their standard deviation is below these, which are
#: those of data sheets.
_SLOPES = {BIAS_TEMPERATURE: BIAS_SLOPE, SCALE_FACTOR_TEMPERATURE: SCALE_SLOPE}
#: Effect -> another one that it is fitted with only.
_NEEDS = {BIAS_TEMPERATURE_QUADRATIC: BIAS_TEMPERATURE}


@dataclass(frozen=True)
class Choice:
    """
    Why an effect was taken or not.

    Attributes
    ----------
    effect : its name
    taken : whether it is in the model
    without, with_it : error of left-out sweeps, rad/s; nan where a fit was not possible
    chance : p-value of the effect; nan as before
    reason : one sentence

    """

    effect: str
    taken: bool
    without: float
    with_it: float
    chance: float
    reason: str


@dataclass(frozen=True)
class Confounders:
    """
    Two effects that explain the same errors.

    Attributes
    ----------
    taken, other : their names
    sigmas : standard deviations by which the data prefer the one that was taken; negative where
        they prefer the other
    rate : slowest rate, rad/s, at which two dwells each way would distinguish them; None if it is
        above three times the fastest
    reason : why it was taken, one sentence

    """

    taken: str
    other: str
    sigmas: float
    rate: float | None
    reason: str

    @property
    def distinguishable(self) -> bool:
        """Tell whether the data distinguish them."""
        return abs(self.sigmas) >= DISTINGUISHED


@dataclass(frozen=True)
class Selection:
    """A calibration with the effects that the data support, the reasons, and confounded pairs."""

    calibration: Calibration
    choices: tuple[Choice, ...]
    confounders: tuple[Confounders, ...]


def select_effects(dwells: Dwells, technology: str | None = None) -> Selection:
    """
    Fit the effects that the dwells support, each with its reason.

    Parameters
    ----------
    dwells : of a rate table or a log
    technology : one of `TECHNOLOGIES`, of the instrument; it decides where causes tie

    Raises
    ------
    DataRefused : too few dwells for anything

    """
    best, confounders = supported_effects(dwells, technology)
    best = with_slopes(best)
    if technology is None:
        best, confounders = decided(best, None, SINE_RESPONSE)
    tried = len(STEADY) - sum(effect in best.effects for effect in (BIAS, SCALE_FACTOR_ERROR))
    choices = tuple(_choice(best, effect, tried, confounders) for effect in STEADY.values())
    return Selection(best, choices, confounders)


def supported_effects(
        dwells: Dwells, technology: str | None = None,
        rate: float = FALSE_ALARM_RATE) -> tuple[Calibration, tuple[Confounders, ...]]:
    """Fit the supported effects, without reasons, at a false alarm rate."""
    scatter = find_scatter(dwells)
    base = _base(dwells, scatter)
    candidates = [effect for effect in STEADY.values() if effect not in base.effects]
    limit = rate / len(candidates)
    best = _grow(base, candidates, limit)
    best = _prune(best, base.effects, limit)
    return decided(best, technology)


def with_slopes(fit: Calibration) -> Calibration:
    """Add the slopes over temperature that the dwells determine better than a data sheet."""
    for slope, usual in _SLOPES.items():
        wider = None if slope in fit.effects else _try(fit.dwells, (*fit.effects, slope),
                                                       fit.scatter)
        if wider is not None and wider.freedom and wider.deviation_of(slope) < usual:
            fit = wider
    return fit


def _base(dwells: Dwells, scatter: Scatter) -> Calibration:
    """Fit bias and scale factor error, or the one of them that the dwells determine."""
    for effects in ((BIAS, SCALE_FACTOR_ERROR), (BIAS,), (SCALE_FACTOR_ERROR,)):
        fit = _try(dwells, effects, scatter)
        if fit is not None:
            return fit
    raise DataRefused(f'{len(dwells)} dwells show neither a bias nor a scale factor; '
                      'rest, and turn both ways at several speeds')


def _try(dwells: Dwells, effects: Sequence[Effect], scatter: Scatter) -> Calibration | None:
    try:
        return fit_effects(dwells, effects, scatter)
    except DataRefused:
        return None


def _supported(smaller: Calibration, larger: Calibration, limit: float) -> bool:
    """
    Return whether more effects predict left-out sweeps better, and each is significant.

    A response that no longer grows with the rate at some dwells cannot be undone there.

    """
    added = [effect for effect in larger.effects if effect not in smaller.effects]
    predicts = larger.predicted_misfit() < smaller.predicted_misfit()
    return (predicts and larger.folded_beyond is None
            and all(larger.chance_of(effect) < limit for effect in added))


def _grow(fit: Calibration, candidates: Sequence[Effect], limit: float) -> Calibration:
    """Add the effect that predicts left-out sweeps best, until none is supported."""
    while True:
        new = [effect for effect in candidates if _may_join(effect, fit.effects)]
        tried = [_try(fit.dwells, _joined(fit.effects, effect), fit.scatter)
                 for effect in new]
        better = [each for each in tried if each is not None and _supported(fit, each, limit)]
        if not better:
            return fit
        fit = min(better, key=Calibration.predicted_misfit)


def _may_join(effect: Effect, effects: Sequence[Effect]) -> bool:
    return effect not in effects and not any(
        effect in pair and any(each in effects for each in pair) for pair in _CONFOUNDERS)


def _joined(effects: Sequence[Effect], effect: Effect) -> tuple[Effect, ...]:
    """Return the effects with one more, and one it needs: a curve needs a slope, even if small."""
    needed = _NEEDS.get(effect)
    return ((*effects, effect) if needed is None or needed in effects
            else (*effects, needed, effect))


def _prune(fit: Calibration, base: Sequence[Effect], limit: float) -> Calibration:
    """Remove effects that later ones made superfluous."""
    for effect in fit.effects:
        rest = tuple(each for each in fit.effects if each is not effect)
        if effect in base or effect in map(_NEEDS.get, rest):
            continue
        smaller = _try(fit.dwells, rest, fit.scatter)
        if smaller is not None and not _supported(smaller, fit, limit):
            return _prune(smaller, base, limit)
    return fit


# confounders

def decided(fit: Calibration, technology: str | None,
            bounded: Effect | None = None) -> tuple[Calibration, tuple[Confounders, ...]]:
    """
    Decide between effects that explain the same errors.

    Without a technology, a `bounded` effect is taken where the data do not prefer the other one.

    """
    found = []
    for pair in _CONFOUNDERS:
        for taken, other in (pair, pair[::-1]):
            swapped = None
            if taken in fit.effects:
                swapped = _try(fit.dwells, swapped_effects(fit.effects, taken, other),
                               fit.scatter)
            # with all rates at its zeros a sine fits any data
            if swapped is not None and swapped.folded_beyond is None:
                fit, confounders = _decide((fit, taken), (swapped, other), technology, bounded)
                found.append(confounders)
                break
    return fit, tuple(found)


def _decide(first: tuple[Calibration, Effect], second: tuple[Calibration, Effect],
            technology: str | None, bounded: Effect | None) -> tuple[Calibration, Confounders]:
    (fit, taken), (swapped, other) = sorted((first, second), key=lambda each: each[0].misfit)
    sigmas = math.sqrt(max(swapped.misfit - fit.misfit, 0.0))
    reason = f'{taken.name} fits better by {sigmas:.1f} standard deviations'
    if sigmas < DISTINGUISHED and technology is not None:
        physical = TECHNOLOGIES[technology]
        if physical is other:
            (fit, taken), (swapped, other), sigmas = (swapped, other), (fit, taken), -sigmas
        reason = (f'{taken.name} is what the physics of {technology} gives, and fits '
                  f'{"better" if sigmas > 0.0 else "worse"} by {abs(sigmas):.1f} '
                  'standard deviations')
    elif technology is not None and TECHNOLOGIES[technology] is other:
        reason += f', although the physics of {technology} gives {other.name}'
    if technology is None and bounded is other and sigmas < HARDLY:
        (fit, taken), (swapped, other), sigmas = (swapped, other), (fit, taken), -sigmas
        reason = (f'{taken.name} fits worse by {abs(sigmas):.1f} standard deviations only, and '
                  'its error stays bounded beyond the rates that were seen')
    return fit, Confounders(taken.name, other.name, sigmas, _distinguishing_rate(fit, swapped),
                            reason)


def _distinguishing_rate(fit: Calibration, swapped: Calibration) -> float | None:
    """Return the slowest new rate, rad/s, at which two dwells each way distinguish two fits."""
    fastest = float(np.abs(fit.dwells.rate).max())
    for rate in fastest * np.arange(1.05, 3.0, 0.05):
        if separation(fit, swapped, np.array([rate, rate, -rate, -rate]),
                      fit.model.reference_temperature) >= DISTINGUISHED + 1.0:
            return float(rate)
    return None


def separation(fit: Calibration, swapped: Calibration, rates: Array,
               temperature: float) -> float:
    """Return the difference of two fits in one more sweep at rates (n,), standard deviations."""
    count, known = len(rates), fit.dwells.deviation[np.isfinite(fit.dwells.deviation)]
    deviation = np.full(count, np.median(known) if len(known) else np.nan)
    sweep = Dwells(rates, rates, None, deviation, np.zeros(count, dtype=int), ('',) * count)
    channels = Channels(rates, rates, np.full(count, temperature))
    rows = np.column_stack([row for term in fit.terms for row in term.sensitivity(channels)])
    uncertain = 0.0 if fit.model.covariance is None else rows @ fit.model.covariance @ rows.T
    shared = fit.scatter.shared(sweep)
    covariance = uncertain + np.diag(fit.scatter.deviation(sweep) ** 2) + shared @ shared.T
    difference = np.asarray(fit.model.error(channels) - swapped.model.error(channels))
    return math.sqrt(float(difference @ np.linalg.solve(covariance, difference)))


# reasons

def _choice(fit: Calibration, effect: Effect, tried: int,
            confounders: Sequence[Confounders]) -> Choice:
    """Return the gain of a fit with the effect over one without it, or with its confounder."""
    for pair in confounders:
        if effect.name == pair.other:
            swapped = fit_effects(
                fit.dwells, swapped_effects(fit.effects, STEADY[pair.taken], effect), fit.scatter)
            reason = f'explains the same as {pair.taken}, in place of which it is tried here'
            return Choice(effect.name, False, fit.left_out_rms, swapped.left_out_rms, math.nan,
                          reason)
    taken = effect in fit.effects
    rest = tuple(each for each in fit.effects if each is not effect)
    if taken and not rest:
        return Choice(effect.name, True, math.nan, fit.left_out_rms, math.nan,
                      'nothing else can be seen')
    try:
        other = fit_effects(fit.dwells, rest if taken else _joined(rest, effect), fit.scatter)
    except DataRefused as error:
        return Choice(effect.name, taken, math.nan, math.nan, math.nan, str(error))
    smaller, larger = (other, fit) if taken else (fit, other)
    reason = 'no better than chance'
    if not larger.freedom:
        reason = 'as many values as dwells: no significance can be stated; add dwells'
    elif taken:
        reason = ('predicts left-out sweeps better'
                  if _supported(smaller, larger, FALSE_ALARM_RATE / tried)
                  else 'belongs to every model')
    return Choice(effect.name, taken, smaller.left_out_rms, larger.left_out_rms,
                  larger.chance_of(effect), reason)


def swapped_effects(effects: Sequence[Effect], taken: Effect, other: Effect) -> tuple[Effect, ...]:
    """Return the effects with another one in place of one of them."""
    return tuple(other if each is taken else each for each in effects)
