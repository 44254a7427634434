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
from gyro_calibration.calibration.scatter import estimate_scatter, Scatter
from gyro_calibration.calibration.tolerance import BIAS_SLOPE_DEVIATION, SCALE_SLOPE_DEVIATION
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
    STATIC_EFFECTS,
)
import numpy as np

#: Probability of taking an effect that is not there, in one calibration.
FALSE_ALARM_RATE = 0.01
#: Standard deviations from which on two causes are distinguished: the wrong one is then taken in
#: one of thirty thousand calibrations.
MIN_DISTINGUISHING_SIGMAS = 4.0
#: Standard deviations below which the data do not prefer one of two causes.
MIN_PREFERENCE_SIGMAS = 2.0
#: Technology -> the effect, of two that are hard to distinguish, that its physics causes.
TECHNOLOGY_EFFECTS = {'open_loop_fog': SINE_RESPONSE, 'closed_loop_fog': CUBIC_NONLINEARITY,
                      'mems': CUBIC_NONLINEARITY}
_CONFOUNDED_EFFECTS = ((SINE_RESPONSE, CUBIC_NONLINEARITY),)
#: Effects of every gyro that are fitted where their standard deviation is below these, which are
#: those of data sheets.
_TYPICAL_SLOPES = {BIAS_TEMPERATURE: BIAS_SLOPE_DEVIATION,
                   SCALE_FACTOR_TEMPERATURE: SCALE_SLOPE_DEVIATION}
#: Effect -> another one that it is fitted with only.
_REQUIRED_EFFECTS = {BIAS_TEMPERATURE_QUADRATIC: BIAS_TEMPERATURE}


@dataclass(frozen=True)
class EffectChoice:
    """
    Why an effect was taken or not.

    Attributes
    ----------
    effect : its name
    taken : whether it is in the model
    error_without, error_with : error of left-out sweeps, rad/s; nan where a fit was not possible
    p_value : p-value of the effect; nan as before
    reason : one sentence

    """

    effect: str
    taken: bool
    error_without: float
    error_with: float
    p_value: float
    reason: str


@dataclass(frozen=True)
class ConfoundedPair:
    """
    Two effects that explain the same errors.

    Attributes
    ----------
    taken, other : their names
    sigmas : standard deviations by which the data prefer the one that was taken; negative where
        they prefer the other
    distinguishing_rate : slowest rate, rad/s, at which two dwells each way would distinguish them;
        None if it is above three times the fastest
    reason : why it was taken, one sentence

    """

    taken: str
    other: str
    sigmas: float
    distinguishing_rate: float | None
    reason: str

    @property
    def is_distinguishable(self) -> bool:
        """Tell whether the data distinguish them."""
        return abs(self.sigmas) >= MIN_DISTINGUISHING_SIGMAS


@dataclass(frozen=True)
class Selection:
    """A calibration with the effects that the data support, the reasons, and confounded pairs."""

    calibration: Calibration
    choices: tuple[EffectChoice, ...]
    confounders: tuple[ConfoundedPair, ...]


def select_effects(dwells: Dwells, technology: str | None = None) -> Selection:
    """
    Fit the effects that the dwells support, each with its reason.

    Parameters
    ----------
    dwells : of a rate table or a log
    technology : one of `TECHNOLOGY_EFFECTS`, of the instrument; it decides where causes tie

    Raises
    ------
    DataRefused : too few dwells for anything

    """
    best, confounders = fit_supported_effects(dwells, technology)
    best = add_temperature_slopes(best)
    if technology is None:
        best, confounders = resolve_confounders(best, None, SINE_RESPONSE)
    tried = (len(STATIC_EFFECTS) - sum(effect in best.effects
                                       for effect in (BIAS, SCALE_FACTOR_ERROR)))
    choices = tuple(
        _explain_choice(best, effect, tried, confounders) for effect in STATIC_EFFECTS.values())
    return Selection(best, choices, confounders)


def fit_supported_effects(dwells: Dwells, technology: str | None = None,
                          false_alarm_rate: float = FALSE_ALARM_RATE) -> tuple[
                                  Calibration, tuple[ConfoundedPair, ...]]:
    """Fit the supported effects, without reasons, at a false alarm rate."""
    scatter = estimate_scatter(dwells)
    base = _fit_base(dwells, scatter)
    candidates = [effect for effect in STATIC_EFFECTS.values() if effect not in base.effects]
    limit = false_alarm_rate / len(candidates)
    best = _add_effects(base, candidates, limit)
    best = _remove_superfluous(best, base.effects, limit)
    return resolve_confounders(best, technology)


def add_temperature_slopes(fit: Calibration) -> Calibration:
    """Add the slopes over temperature that the dwells determine better than a data sheet."""
    for slope, typical_deviation in _TYPICAL_SLOPES.items():
        extended = None if slope in fit.effects else _try_fit(
            fit.dwells, (*fit.effects, slope), fit.scatter)
        if (extended is not None and extended.dof
                and extended.effect_deviation(slope) < typical_deviation):
            fit = extended
    return fit


def _fit_base(dwells: Dwells, scatter: Scatter) -> Calibration:
    """Fit bias and scale factor error, or the one of them that the dwells determine."""
    for effects in ((BIAS, SCALE_FACTOR_ERROR), (BIAS,), (SCALE_FACTOR_ERROR,)):
        fit = _try_fit(dwells, effects, scatter)
        if fit is not None:
            return fit
    raise DataRefused(f'{len(dwells)} dwells show neither a bias nor a scale factor; '
                      'rest, and turn both ways at several speeds')


def _try_fit(dwells: Dwells, effects: Sequence[Effect], scatter: Scatter) -> Calibration | None:
    try:
        return fit_effects(dwells, effects, scatter)
    except DataRefused:
        return None


def _is_supported(smaller: Calibration, larger: Calibration, significance: float) -> bool:
    """
    Return whether more effects predict left-out sweeps better, and each is significant.

    A response that no longer grows with the rate at some dwells cannot be undone there.

    """
    added = [effect for effect in larger.effects if effect not in smaller.effects]
    predicts = larger.cross_validation_misfit() < smaller.cross_validation_misfit()
    return (predicts and larger.min_non_monotonic_rate is None
            and all(larger.p_value(effect) < significance for effect in added))


def _add_effects(fit: Calibration, candidates: Sequence[Effect],
                 significance: float) -> Calibration:
    """Add the effect that predicts left-out sweeps best, until none is supported."""
    while True:
        excluded = [*fit.effects, *(effect for pair in _CONFOUNDED_EFFECTS for effect in pair
                                    if any(each in fit.effects for each in pair))]
        tried = [_try_fit(fit.dwells, _add_with_required(fit.effects, effect), fit.scatter)
                 for effect in candidates if effect not in excluded]
        better = [each
                  for each in tried if each is not None and _is_supported(fit, each, significance)]
        if not better:
            return fit
        fit = min(better, key=Calibration.cross_validation_misfit)


def _add_with_required(effects: Sequence[Effect], effect: Effect) -> tuple[Effect, ...]:
    """Return the effects with one more, and one it needs: a curve needs a slope, even if small."""
    needed = _REQUIRED_EFFECTS.get(effect)
    return ((*effects, effect) if needed is None or needed in effects
            else (*effects, needed, effect))


def _remove_superfluous(fit: Calibration, base: Sequence[Effect],
                        significance: float) -> Calibration:
    """Remove effects that later ones made superfluous."""
    for effect in fit.effects:
        rest = tuple(each for each in fit.effects if each is not effect)
        if effect in base or effect in map(_REQUIRED_EFFECTS.get, rest):
            continue
        smaller = _try_fit(fit.dwells, rest, fit.scatter)
        if smaller is not None and not _is_supported(smaller, fit, significance):
            return _remove_superfluous(smaller, base, significance)
    return fit


# confounders


def resolve_confounders(fit: Calibration, technology: str | None, bounded_effect: Effect
                        | None = None) -> tuple[Calibration, tuple[ConfoundedPair, ...]]:
    """
    Decide between effects that explain the same errors.

    Without a technology, a `bounded_effect` effect is taken where the data do not prefer the other
    one.

    """
    found = []
    for pair in _CONFOUNDED_EFFECTS:
        for taken, other in (pair, pair[::-1]):
            swapped = None
            if taken in fit.effects:
                swapped = _try_fit(fit.dwells, replace_effect(fit.effects, taken, other),
                                   fit.scatter)
            # with all rates at its zeros a sine fits any data
            if swapped is not None and swapped.min_non_monotonic_rate is None:
                fit, confounders = _resolve_pair(
                    (fit, taken), (swapped, other), technology, bounded_effect)
                found.append(confounders)
                break
    return fit, tuple(found)


def _resolve_pair(first: tuple[Calibration, Effect], second: tuple[Calibration, Effect],
                  technology: str | None,
                  bounded_effect: Effect | None) -> tuple[Calibration, ConfoundedPair]:
    (fit, taken), (swapped, other) = sorted((first, second), key=lambda each: each[0].misfit)
    sigmas = math.sqrt(max(swapped.misfit - fit.misfit, 0.0))
    reason = f'{taken.name} fits better by {sigmas:.1f} standard deviations'
    if sigmas < MIN_DISTINGUISHING_SIGMAS and technology is not None:
        physical = TECHNOLOGY_EFFECTS[technology]
        if physical is other:
            (fit, taken), (swapped, other), sigmas = (swapped, other), (fit, taken), -sigmas
        reason = (f'{taken.name} is what the physics of {technology} gives, and fits '
                  f'{"better" if sigmas > 0.0 else "worse"} by {abs(sigmas):.1f} '
                  'standard deviations')
    elif technology is not None and TECHNOLOGY_EFFECTS[technology] is other:
        reason += f', although the physics of {technology} gives {other.name}'
    if technology is None and bounded_effect is other and sigmas < MIN_PREFERENCE_SIGMAS:
        (fit, taken), (swapped, other), sigmas = (swapped, other), (fit, taken), -sigmas
        reason = (f'{taken.name} fits worse by {abs(sigmas):.1f} standard deviations only, and '
                  'its error stays bounded beyond the rates that were seen')
    return fit, ConfoundedPair(taken.name, other.name, sigmas, _distinguishing_rate(fit, swapped),
                               reason)


def _distinguishing_rate(fit: Calibration, swapped: Calibration) -> float | None:
    """Return the slowest new rate, rad/s, at which two dwells each way distinguish two fits."""
    fastest = float(np.abs(fit.dwells.rate).max())
    for rate in fastest * np.arange(1.05, 3.0, 0.05):
        if separation_sigmas(fit, swapped, np.array([rate, rate, -rate, -rate]),
                             fit.model.reference_temperature) >= MIN_DISTINGUISHING_SIGMAS + 1.0:
            return float(rate)
    return None


def separation_sigmas(fit: Calibration, swapped: Calibration, rates: Array,
                      temperature: float) -> float:
    """Return the difference of two fits in one more sweep at rates (n,), standard deviations."""
    count, known = len(rates), fit.dwells.deviation[np.isfinite(fit.dwells.deviation)]
    deviation = np.full(count, np.median(known) if len(known) else np.nan)
    sweep = Dwells(rates, rates, None, deviation, np.zeros(count, dtype=int), ('',) * count)
    channels = Channels(rates, rates, np.full(count, temperature))
    rows = np.column_stack([row for term in fit.terms for row in term.sensitivity(channels)])
    fit_covariance = 0.0 if fit.model.covariance is None else rows @ fit.model.covariance @ rows.T
    shared = fit.scatter.sweep_columns(sweep)
    covariance = fit_covariance + np.diag(fit.scatter.deviation(sweep) ** 2) + shared @ shared.T
    difference = np.asarray(fit.model.error(channels) - swapped.model.error(channels))
    return math.sqrt(float(difference @ np.linalg.solve(covariance, difference)))


# reasons

def _explain_choice(fit: Calibration, effect: Effect, tried_count: int,
                    confounders: Sequence[ConfoundedPair]) -> EffectChoice:
    """Return the gain of a fit with the effect over one without it, or with its confounder."""
    for pair in confounders:
        if effect.name == pair.other:
            swapped = fit_effects(fit.dwells,
                                  replace_effect(fit.effects, STATIC_EFFECTS[pair.taken], effect),
                                  fit.scatter)
            reason = f'explains the same as {pair.taken}, in place of which it is tried here'
            return EffectChoice(effect.name, False, fit.left_out_rms, swapped.left_out_rms,
                                math.nan, reason)
    taken = effect in fit.effects
    rest = tuple(each for each in fit.effects if each is not effect)
    if taken and not rest:
        return EffectChoice(effect.name, True, math.nan, fit.left_out_rms, math.nan,
                            'nothing else can be seen')
    try:
        other = fit_effects(fit.dwells, rest if taken else _add_with_required(rest, effect),
                            fit.scatter)
    except DataRefused as error:
        return EffectChoice(effect.name, taken, math.nan, math.nan, math.nan, str(error))
    smaller, larger = (other, fit) if taken else (fit, other)
    reason = 'no better than chance'
    if not larger.dof:
        reason = 'as many values as dwells: no significance can be stated; add dwells'
    elif taken:
        reason = ('predicts left-out sweeps better'
                  if _is_supported(smaller, larger, FALSE_ALARM_RATE / tried_count)
                  else 'belongs to every model')
    return EffectChoice(effect.name, taken, smaller.left_out_rms, larger.left_out_rms,
                        larger.p_value(effect), reason)


def replace_effect(effects: Sequence[Effect], taken: Effect, other: Effect) -> tuple[Effect, ...]:
    """Return the effects with another one in place of one of them."""
    return tuple(other if each is taken else each for each in effects)
