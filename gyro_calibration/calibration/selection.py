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

Bias, scale factor error and the slopes over temperature that the dwells determine better than a
data sheet belong to every model. Another effect is taken where it reduces the error of left-out
sweeps and is significant, given the number of effects tried. Sine response and cubic nonlinearity
explain nearly the same; the physics of the instrument decides where the data do not.
"""

from collections.abc import Sequence
from dataclasses import dataclass
import math

from gyro_calibration.calibration.dwells import Dwells
from gyro_calibration.calibration.rate_table import (
    Calibration, channels_of, CONFOUNDERS, fit_effects)
from gyro_calibration.calibration.scatter import BIAS_SLOPE_DEVIATION, SCALE_SLOPE_DEVIATION
from gyro_calibration.logs.log import DataRefused, DEGREE, NORMAL_QUANTILE_975
from gyro_calibration.model.effects import (
    BIAS, BIAS_TEMPERATURE, BIAS_TEMPERATURE_QUADRATIC, CUBIC_NONLINEARITY, Effect,
    SCALE_FACTOR_ERROR, SCALE_FACTOR_TEMPERATURE, SINE_RESPONSE, STATIC_EFFECTS)
from gyro_calibration.model.gyro_model import GyroModel
import numpy as np

#: Probability of taking an effect that is not there, and of a false alarm in a fleet.
FALSE_ALARM_RATE = 0.01
#: Standard deviations from which on two causes are distinguished.
MIN_DISTINGUISHING_SIGMAS = 4.0
#: Technology -> which of sine response and cubic nonlinearity its physics causes.
TECHNOLOGY_EFFECTS = {'open_loop_fog': SINE_RESPONSE, 'closed_loop_fog': CUBIC_NONLINEARITY,
                      'mems': CUBIC_NONLINEARITY}
#: Largest standard deviations of scale factor error and bias, rad/s, by technology.
TECHNOLOGY_PRIORS = {
    'mems': (0.01, 1.0 * DEGREE),
    'open_loop_fog': (0.005, 0.02 * DEGREE),
    'closed_loop_fog': (0.001, 0.002 * DEGREE),
}
#: Effects of every gyro.
BASIC_EFFECTS = BIAS, SCALE_FACTOR_ERROR


@dataclass(frozen=True)
class _EffectChoice:
    """Why an effect was taken or not."""

    effect: str  # its name
    taken: bool  # whether it is in the model
    error_without: float  # of left-out sweeps, rad/s; nan where a fit was not possible
    error_with: float
    p_value: float
    reason: str  # one sentence


@dataclass(frozen=True)
class _ConfoundedPair:
    """Two effects that explain the same errors."""

    taken: str  # its name
    other: str
    sigmas: float  # by which the data prefer the one taken; negative for the other
    distinguishing_rate: float | None  # rad/s; None above three times the fastest
    reason: str  # why it was taken, one sentence

    @property
    def is_distinguishable(self) -> bool:
        """Tell whether the data distinguish them."""
        return abs(self.sigmas) >= MIN_DISTINGUISHING_SIGMAS


@dataclass(frozen=True)
class SelectedEffects:
    """A calibration with the effects that the data support, the reasons, and confounded pairs."""

    calibration: Calibration
    choices: tuple[_EffectChoice, ...]
    confounders: tuple[_ConfoundedPair, ...]

    @property
    def model(self) -> GyroModel:
        """Return the model of the calibration."""
        return self.calibration.model


def select_effects(dwells: Dwells, technology: str | None = None) -> SelectedEffects:
    """Fit the effects that the dwells support, each with its reason; a technology decides ties."""
    base = _add_slopes(_fit_base(dwells, None))
    best = _add_slopes(find_supported_effects(dwells, FALSE_ALARM_RATE, base=base))
    best, confounders = resolve_confounders(
        best, technology, None if technology else SINE_RESPONSE)
    tried = len(STATIC_EFFECTS) - len({*BASIC_EFFECTS} & {*best.effects})
    choices = (_explain_choice(best, effect, FALSE_ALARM_RATE / tried, confounders)
               for effect in STATIC_EFFECTS.values())
    return SelectedEffects(best, tuple(choices), confounders)


def _add_slopes(fit: Calibration) -> Calibration:
    """Add the slopes over temperature that the dwells determine better than a data sheet does."""
    for slope, typical_deviation in ((BIAS_TEMPERATURE, BIAS_SLOPE_DEVIATION),
                                     (SCALE_FACTOR_TEMPERATURE, SCALE_SLOPE_DEVIATION)):
        extended = None if slope in fit.effects else try_fit(fit, (*fit.effects, slope))
        if (extended is not None and extended.dof
                and extended.effect_deviation(slope) < typical_deviation):
            fit = extended
    return fit


def find_supported_effects(dwells: Dwells, false_alarm_rate: float,
                           given: GyroModel | None = None,
                           base: Calibration | None = None) -> Calibration:
    """
    Fit the effects that predict left-out sweeps better, at a false alarm rate.

    The best one is added until none is supported, then superfluous ones are removed, but for those
    of a `base`. With a given model they are changes of it.
    """
    best = base = base or _fit_base(dwells, given)
    candidates = [effect for effect in STATIC_EFFECTS.values() if effect not in base.effects]
    limit = false_alarm_rate / len(candidates)
    while True:
        tried = [try_fit(best, _add_effect(best.effects, effect)) for effect in candidates
                 if not {effect, CONFOUNDERS.get(effect)} & {*best.effects}]
        better = [each
                  for each in tried if each is not None and _is_supported(best, each, limit)]
        if not better:
            return _remove_superfluous(best, base.effects, limit)
        best = min(better, key=Calibration.cross_validation_misfit)


def try_fit(fit: Calibration, effects: Sequence[Effect]) -> Calibration | None:
    """Fit other effects to the dwells of a fit; None if they cannot be separated."""
    try:
        return fit.refit(effects)
    except DataRefused:
        return None


def _fit_base(dwells: Dwells, given: GyroModel | None) -> Calibration:
    """Fit bias and scale factor error, or the one of them that the dwells determine."""
    for effects in (BASIC_EFFECTS, *((each,) for each in BASIC_EFFECTS)):
        try:
            return fit_effects(dwells, effects, given=given)
        except DataRefused:
            continue
    raise DataRefused(f'{len(dwells)} dwells show neither a bias nor a scale factor; '
                      'rest, and turn both ways at several speeds')


def _is_supported(smaller: Calibration, larger: Calibration, significance: float) -> bool:
    """Return whether more effects predict left-out sweeps better, and each is significant."""
    added = [effect for effect in larger.effects if effect not in smaller.effects]
    predicts = larger.cross_validation_misfit() < smaller.cross_validation_misfit()
    return (predicts and not larger.is_ambiguous
            and all(larger.p_value(effect) < significance for effect in added))


def _add_effect(effects: Sequence[Effect], effect: Effect) -> tuple[Effect, ...]:
    """Return the effects with one more; a curve over temperature needs a slope, even if small."""
    needed = ([BIAS_TEMPERATURE] if effect is BIAS_TEMPERATURE_QUADRATIC
              and BIAS_TEMPERATURE not in effects else [])
    return (*effects, *needed, effect)


def _remove_superfluous(fit: Calibration, base: Sequence[Effect],
                        significance: float) -> Calibration:
    """Remove effects that later ones made superfluous."""
    for effect in fit.effects:
        is_needed = effect is BIAS_TEMPERATURE and BIAS_TEMPERATURE_QUADRATIC in fit.effects
        if effect in base or is_needed:
            continue
        smaller = try_fit(fit, [each for each in fit.effects if each is not effect])
        if smaller is not None and not _is_supported(smaller, fit, significance):
            return _remove_superfluous(smaller, base, significance)
    return fit


def resolve_confounders(fit: Calibration, technology: str | None, bounded_effect: Effect
                        | None = None) -> tuple[Calibration, tuple[_ConfoundedPair, ...]]:
    """
    Decide between sine response and cubic nonlinearity where a fit has one of them.

    The one that fits better is taken, or, if the data do not decide, the one by the physics of the
    technology, and without one a `bounded_effect`, whose error stays bounded beyond the rates
    seen.
    """
    effect = next((each for each in CONFOUNDERS if each in fit.effects), None)
    if effect is None:
        return fit, ()
    swapped = try_replace(fit, effect, CONFOUNDERS[effect])
    # with all rates at its zeros a sine fits any data
    if swapped is None or swapped.is_ambiguous:
        return fit, ()
    best, second = sorted((fit, swapped), key=lambda each: each.misfit)
    taken = next(each for each in CONFOUNDERS if each in best.effects)
    sigmas = math.sqrt(max(second.misfit - best.misfit, 0.0))
    preferred, limit = ((bounded_effect, NORMAL_QUANTILE_975) if technology is None
                        else (TECHNOLOGY_EFFECTS[technology], MIN_DISTINGUISHING_SIGMAS))
    fits = f'fits better by {sigmas:.1f} standard deviations'
    if preferred is CONFOUNDERS[taken] and sigmas < limit:
        best, second, taken, sigmas = second, best, preferred, -sigmas
        fits = f'fits worse by {-sigmas:.1f} standard deviations'
    reason = f'{taken.name} {fits}'
    if technology is None and sigmas <= 0.0 and preferred is taken:
        reason += ' only, and its error stays bounded beyond the rates that were seen'
    elif technology is not None and preferred is not taken:
        reason += f', although the physics of {technology} gives {CONFOUNDERS[taken].name}'
    elif technology is not None and sigmas < limit:
        reason = f'{taken.name} is what the physics of {technology} gives, and {fits}'
    return best, (_ConfoundedPair(taken.name, CONFOUNDERS[taken].name, sigmas,
                                  distinguishing_rate(best, second), reason),)


def distinguishing_rate(fit: Calibration, other: Calibration) -> float | None:
    """Return the slowest rate, rad/s, at which two dwells each way distinguish fits, or None."""
    known = fit.dwells.deviation[np.isfinite(fit.dwells.deviation)]
    deviation = np.full(4, np.median(known) if len(known) else np.nan)
    temperature = np.full(4, fit.model.reference_temperature)
    for rate in float(np.abs(fit.dwells.rate).max()) * np.arange(1.05, 3.0, 0.05):
        rates = rate * np.array([1.0, 1.0, -1.0, -1.0])
        sweep = Dwells(rates, rates, temperature, deviation, np.zeros(4, dtype=int), ('',) * 4)
        apart = np.asarray(fit.model.error(channels_of(sweep))
                           - other.model.error(channels_of(sweep)))
        sigmas = math.sqrt(apart @ np.linalg.solve(fit.prediction_covariance(sweep), apart))
        if sigmas >= MIN_DISTINGUISHING_SIGMAS + 1.0:
            return float(rate)
    return None


def try_replace(fit: Calibration, taken: Effect, other: Effect) -> Calibration | None:
    """Fit another effect in place of one of a fit; None if that is not possible."""
    return try_fit(fit, [other if each is taken else each for each in fit.effects])


def _explain_choice(fit: Calibration, effect: Effect, significance: float,
                    confounders: Sequence[_ConfoundedPair]) -> _EffectChoice:
    """Return the gain of a fit with the effect over one without it, or with its confounder."""
    for pair in confounders:
        if effect.name == pair.other:
            swapped = try_replace(fit, CONFOUNDERS[effect], effect)
            assert swapped is not None
            reason = f'explains the same as {pair.taken}, in place of which it is tried here'
            return _EffectChoice(effect.name, False, fit.left_out_rms, swapped.left_out_rms,
                                 math.nan, reason)
    taken = effect in fit.effects
    rest = tuple(each for each in fit.effects if each is not effect)
    if taken and not rest:
        return _EffectChoice(effect.name, True, math.nan, fit.left_out_rms, math.nan,
                             'the only effect that these dwells determine')
    try:
        other = fit.refit(rest if taken else _add_effect(rest, effect))
    except DataRefused as error:
        return _EffectChoice(effect.name, taken, math.nan, math.nan, math.nan, str(error))
    smaller, larger = (other, fit) if taken else (fit, other)
    reason = 'does not predict left-out dwells better'
    if not larger.dof:
        reason = 'as many values as dwells: no significance can be stated; add dwells'
    elif taken:
        reason = ('predicts left-out dwells better'
                  if _is_supported(smaller, larger, significance) else 'belongs to every model')
    elif larger.p_value(effect) >= significance:
        reason = f'its p-value is above {significance:.2g}, the limit for one effect'
    elif larger.is_ambiguous:
        reason = ('the output would decrease with the rate within the dwells; if the gyro turned '
                  'beyond its fringe, give the effects with --effects')
    return _EffectChoice(effect.name, taken, smaller.left_out_rms, larger.left_out_rms,
                         larger.p_value(effect), reason)
