# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""What dwells cannot rule out in place of a cause, and which further dwells would."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
import math

from gyro_calibration.calibration.dwells import take
from gyro_calibration.calibration.rate_table import Calibration, channels_of, columns_of
from gyro_calibration.calibration.scatter import Whitener
from gyro_calibration.calibration.selection import DISTINGUISHED, separation, swapped_effects
from gyro_calibration.diagnosis.causes import CAUSES
from gyro_calibration.diagnosis.dwell_fit import tried
from gyro_calibration.logs.log import Array, DEGREE
from gyro_calibration.model.effects import (
    BIAS,
    BIAS_TEMPERATURE,
    BIAS_TEMPERATURE_QUADRATIC,
    CUBIC_NONLINEARITY,
    Effect,
    SATURATION,
    SCALE_FACTOR_ERROR,
    SINE_RESPONSE,
    STEADY,
)
import numpy as np

#: Of bias and scale factor, what dwells in one pose on one table never rule out.
_ALWAYS = {BIAS: 'acceleration_sensitivity', SCALE_FACTOR_ERROR: 'reference_scale'}
#: Further dwells are aimed at this, for two fits vary by one standard deviation.
_AIM = DISTINGUISHED + 1.0


@dataclass(frozen=True)
class Alternatives:
    """
    Causes that may stand in the place of one.

    Attributes
    ----------
    names : of them, the likeliest first
    separate_by : the experiment that would part them; '' where there is nothing to part

    """

    names: tuple[str, ...] = ()
    separate_by: str = ''


def alternatives(fit: Calibration, effect: Effect) -> Alternatives:
    """Return what dwells cannot rule out in place of one effect of a fit."""
    if effect in _ALWAYS:
        return Alternatives((_ALWAYS[effect],), CAUSES[effect.name].separate_by)
    steady = [(sigmas, other) for other in _others(fit, effect)
              if (sigmas := sigmas_of(fit, other)) < DISTINGUISHED]
    found = [(sigmas, other.effects[fit.effects.index(effect)].name) for sigmas, other in steady]
    found += [(sigmas, name) for name, columns in _beyond(fit, effect)
              if (sigmas := _sigmas(fit, effect, columns)) < DISTINGUISHED]
    if not found:
        return Alternatives()
    said = [_experiment(fit, steady[0][1])] if steady else []
    said += [CAUSES[effect.name].separate_by] if len(found) > len(steady) else []
    return Alternatives(tuple(name for _, name in sorted(found)), '; '.join(said))


def sigmas_of(fit: Calibration, other: Calibration) -> float:
    """Return by how many sigma a fit is better than another one of the same dwells."""
    return math.sqrt(max(other.misfit - fit.misfit, 0.0))


def _others(fit: Calibration, effect: Effect) -> Iterator[Calibration]:
    """Give fits with another steady effect in place of one."""
    if effect is BIAS_TEMPERATURE and BIAS_TEMPERATURE_QUADRATIC in fit.effects:
        return  # the curve would be without its slope
    for other in STEADY.values():
        swapped = (None if other in fit.effects
                   else tried(fit, swapped_effects(fit.effects, effect, other)))
        if swapped is not None:
            yield swapped


def _beyond(fit: Calibration, effect: Effect) -> Iterator[tuple[str, list[Array]]]:
    """Give causes that are no effects of rate or temperature, with columns tried one by one."""
    rate, order = fit.dwells.rate, np.arange(len(fit.dwells)) / len(fit.dwells)
    if effect in (BIAS_TEMPERATURE, BIAS_TEMPERATURE_QUADRATIC):
        yield 'rate_ramp', [order]
        yield 'warm_up', [np.exp(-order / time_constant)
                          for time_constant in (0.05, 0.1, 0.2, 0.5)]
    if effect in (CUBIC_NONLINEARITY, SINE_RESPONSE):
        limits = np.abs(rate).max() * np.linspace(0.5, 0.98, 25)
        assert SATURATION.distortion is not None
        yield 'saturation', [SATURATION.distortion(rate, order, limit) - rate
                             for limit in limits.tolist()]


def _sigmas(fit: Calibration, effect: Effect, columns: list[Array]) -> float:
    """Return by how many sigma an effect is better than the best column with a free factor."""
    used = take(fit.dwells, fit.scatter.kept)
    term = next(each for each in fit.terms if each.effect is effect)
    whitener = Whitener(used, fit.scatter)
    # the residual with what the effect explains
    error = whitener.whiten((fit.residual
                             + term.error(channels_of(fit.dwells)))[fit.scatter.kept])
    known = whitener.whiten(columns_of(used, [each for each in fit.terms if each is not term]))
    misfits = []
    for column in columns:
        both = np.column_stack([known, whitener.whiten(column[fit.scatter.kept])])
        lengths = np.linalg.norm(both, axis=0)
        both = both / np.where(lengths > 0.0, lengths, 1.0)
        left = error - both @ np.linalg.lstsq(both, error, rcond=None)[0]
        misfits.append(float(np.sum(left ** 2)))
    return math.sqrt(max(min(misfits) - fit.misfit, 0.0))


# what would distinguish them

def _sweeps(fit: Calibration) -> Iterator[tuple[str, Array, float]]:
    """Give sweeps that may be added, the easiest first: in words, rates, and temperature."""
    fastest = float(np.abs(fit.dwells.rate).max())
    middle = fit.model.reference_temperature
    slow = fastest * np.array([0.0, 0.02, 0.05, 0.1, 0.2])
    yield ('two dwells each way at 2, 5, 10 and 20 % of the fastest rate, and rests',
           np.tile([*slow, *-slow], 2), middle)
    for rate in (fastest * np.arange(1.0, 3.0, 0.05)).tolist():
        yield (f'two dwells each way at {rate / DEGREE:.0f} deg/s',
               np.array([rate, rate, -rate, -rate]), middle)
    if fit.dwells.temperature is not None:
        low, high = float(fit.dwells.temperature.min()), float(fit.dwells.temperature.max())
        rates = np.repeat(fastest * np.linspace(-1.0, 1.0, 9), 2)
        for beyond in (0.0, 5.0, 10.0, 20.0, 30.0):
            for temperature in (high + beyond, low - beyond):
                yield f'a sweep of 18 dwells at {temperature:.0f} degC', rates, temperature


def _experiment(fit: Calibration, other: Calibration) -> str:
    """Return the easiest sweep that would part two fits, or the best one, in words."""
    tried_sweeps = []
    for words, rates, temperature in _sweeps(fit):
        tried_sweeps.append((separation(fit, other, rates, temperature), words))
        if tried_sweeps[-1][0] >= _AIM:
            break
    sigmas, words = max(tried_sweeps)
    return (f'add {words}: that parts them by {sigmas:.1f} standard deviations'
            + ('' if sigmas >= _AIM else ', and repeat it'))
