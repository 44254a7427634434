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
What dwells say beside a model: bias and scale factor fitted anew, and the causes they support.

Effects of a model that are not fitted anew are subtracted from the output first, so that what is
left is that of a gyro without them. A polynomial of the output stays as it is: fitted together
with effects of the rate it would explain the dwells by itself, for the output less the rate is
what is to be explained.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from gyro_calibration.calibration.dwells import Dwells, take
from gyro_calibration.calibration.rate_table import (
    Calibration,
    channels_of,
    columns_of,
    fit_effects,
)
from gyro_calibration.calibration.scatter import Scatter, Uncertainty, Whitener
from gyro_calibration.calibration.selection import decided, supported_effects, TECHNOLOGIES
from gyro_calibration.diagnosis.extended_model import origins_before, wider
from gyro_calibration.logs.log import Array, DataRefused
from gyro_calibration.model.effects import (
    BIAS,
    BIAS_TEMPERATURE,
    BIAS_TEMPERATURE_QUADRATIC,
    Channels,
    CUBIC_NONLINEARITY,
    Effect,
    SCALE_FACTOR_ERROR,
    SINE_RESPONSE,
    STEADY,
)
from gyro_calibration.model.gyro_model import GyroModel, Term
import numpy as np
from scipy.linalg import block_diag

#: Fitted in any case.
NUISANCES = (BIAS, SCALE_FACTOR_ERROR)
#: What dwells without time can show of a model.
_SEEN = {'rate', 'output', 'temperature'}
#: Parts of the false-alarm rate: of causes beside bias and scale factor, and of a bias and a scale
#: factor that differ from the model's.
_CAUSES, _OF_NUISANCES = 0.65, 0.1
#: Temperatures from which a curve may count without a slope, degC, beside the mean and the first.
_USUAL = (25.0, 20.0)


@dataclass(frozen=True)
class Named:
    """
    Causes that dwells support on top of a model.

    Attributes
    ----------
    fit : of these and of bias and scale factor, to dwells less what stays of the model
    change : the same as changes of the model, each beside all of it; their evidence, but for bias
        and scale factor
    causes : those that are named, of the effects of the fit
    model : that is put to the test
    rate : of false alarms that the whole diagnosis may have

    """

    fit: Calibration
    change: Calibration
    causes: tuple[Effect, ...]
    model: GyroModel
    rate: float

    def changed(self, effect: Effect) -> Effect:
        """Return the change that stands for an effect of the fit: itself, or its confounder."""
        return _or_confounder(effect, self.change)

    def level_of(self, effect: Effect) -> float:
        """Return the chance at which an effect is named."""
        return _level(self.rate, effect in NUISANCES)

    def chance_of(self, effect: Effect) -> float:
        """Return how likely dwells without a cause show as much of any of those tried."""
        if effect in NUISANCES:
            return min(1.0, _chance_of_change(self.fit, self.model, effect) * len(NUISANCES))
        return min(1.0, _chance(self.change, self.model, self.changed(effect))
                   * (len(STEADY) - len(NUISANCES)))


# a model beside dwells

def surroundings(model: GyroModel, dwells: Dwells) -> Channels:
    """Return what a model looks at, at its reference temperature where the table holds none."""
    channels = channels_of(dwells)
    return channels if dwells.temperature is not None else replace(
        channels, temperature=np.full(len(dwells), model.reference_temperature))


def simulated(model: GyroModel, dwells: Dwells) -> Array:
    """Return the output that a model has for the dwells, rad/s, shape (n,)."""
    known = replace(model, terms=tuple(seen(model)))
    return np.asarray(known.output_in(surroundings(model, dwells))) + np.zeros(len(dwells))


def seen(model: GyroModel) -> list[Term]:
    """Return the effects of a model that dwells can show: of rate, output and temperature."""
    return [term for term in model.terms
            if term.effect.looks_at <= _SEEN and term.effect.distortion is None]


def beside(dwells: Dwells, model: GyroModel, refitted: Sequence[Effect] = ()) -> Dwells:
    """Return dwells whose output is without the effects of a model that are not refitted."""
    channels, names = surroundings(model, dwells), {effect.name for effect in refitted}
    return replace(dwells, output=dwells.output - sum(
        term.error(channels) for term in seen(model) if term.effect.name not in names))


def technology(model: GyroModel) -> str | None:
    """Return what the instrument is, if the model says so and physics has an answer."""
    said = model.gyro.get('technology')
    return said if said in TECHNOLOGIES else None


# naming

def name_causes(dwells: Dwells, model: GyroModel | None, rate: float,
                without: frozenset[str] = frozenset()) -> Named:
    """
    Find the causes that dwells support on top of a model, or of an ideal gyro.

    Parameters
    ----------
    dwells : of a rate table
    model : that is put to the test, if one was given
    rate : of false alarms that the whole diagnosis may have
    without : the names of causes that are withdrawn

    """
    tested = model or GyroModel()
    change, _ = supported_effects(beside(dwells, tested), technology(tested), rate=_CAUSES * rate)
    change = _without(change, without)
    change, needless = _counted_well(change, model, _level(rate))
    guilty = tuple(each for each in change.effects if each not in (*NUISANCES, *needless)
                   and _chance(change, tested, each) < _level(rate))
    change = _without(change, frozenset(each.name for each in change.effects
                                        if each not in (*NUISANCES, *needless, *guilty)))
    if model is None:
        return Named(change, change, guilty, tested, rate)
    fit = _refitted(dwells, model, change)
    moved = [each for each in NUISANCES
             if each in fit.effects and _chance_of_change(fit, model, each) < _level(rate, True)]
    return Named(fit, change, (*(_or_confounder(each, fit) for each in guilty), *moved), tested,
                 rate)


def _level(rate: float, nuisance: bool = False) -> float:
    """Return the chance at which one cause is named."""
    return (_OF_NUISANCES * rate / len(NUISANCES) if nuisance
            else _CAUSES * rate / (len(STEADY) - len(NUISANCES)))


def _without(change: Calibration, names: frozenset[str]) -> Calibration:
    """Fit anew without the withdrawn causes, and without what was there for their sake."""
    kept = [each for each in change.effects if each.name not in names]
    return (change if len(kept) == len(change.effects)
            else fit_effects(change.dwells, kept, change.scatter))


def _refitted(dwells: Dwells, model: GyroModel, change: Calibration) -> Calibration:
    """Fit the values that changed as a whole: the model's own and the change of them are one."""
    own = {term.effect.name for term in model.terms}
    effects = tuple(
        other if (other := _confounder(each)) is not None and other.name in own - {each.name}
        else each for each in change.effects)
    fit, _ = decided(fit_effects(beside(dwells, model, effects), effects, change.scatter),
                     technology(model))
    return counted_from(fit, model.reference_temperature)


def _confounder(effect: Effect) -> Effect | None:
    return {SINE_RESPONSE: CUBIC_NONLINEARITY, CUBIC_NONLINEARITY: SINE_RESPONSE}.get(effect)


def change_of(fit: Calibration, model: GyroModel, effect: Effect) -> float:
    """Return the change of bias or scale factor from the model, which has 0 where it has none."""
    found, own = ([term.values[-1] for term in each.terms if term.effect is effect]
                  for each in (fit, model))
    return float(sum(found) - sum(own))


def _chance_of_change(fit: Calibration, model: GyroModel, effect: Effect) -> float:
    """Return how likely dwells show as much change of bias or scale factor without any."""
    column = columns_of(_used(fit), [term for term in fit.terms if term.effect is effect])[:, 0]
    return _chance(fit, model, effect, column * change_of(fit, model, effect))


def _chance(fit: Calibration, model: GyroModel, effect: Effect,
            added: Array | None = None) -> float:
    """
    Return how likely dwells and errors of the model's values show as much of an absent effect.

    Parameters
    ----------
    fit : of dwells beside the model
    model : whose own covariance counts too, where it has one
    added : the effect in each dwell that is fitted, rad/s; None for all that the effect adds

    """
    if not fit.freedom:
        return 1.0
    used, others = _used(fit), [term for term in fit.terms if term.effect is not effect]
    if added is None:
        added = (sum(term.error(channels_of(used)) for term in fit.terms if term.effect is effect)
                 + np.zeros(len(used)))
    if not np.any(added):
        return 1.0
    columns = np.column_stack([*columns_of(used, others).T, added]) if others else added[:, None]
    uncertain = Uncertainty.of(used, fit.scatter, columns, fit.residual[fit.scatter.kept])
    below = float(uncertain.below(-_of_dwells(fit, model, columns))[-1])
    return 2.0 * min(below, 1.0 - below)


def _used(fit: Calibration) -> Dwells:
    return take(fit.dwells, fit.scatter.kept)


def _of_dwells(fit: Calibration, model: GyroModel, columns: Array) -> float:
    """Return the deviation of the last value by dwells over that by dwells and model."""
    whitener = Whitener(_used(fit), fit.scatter)
    inverse = np.linalg.pinv(whitener.whiten(columns / np.linalg.norm(columns, axis=0)))[-1]
    by_model = inverse @ whitener.whiten(doubt(fit, model))
    by_dwells = float(inverse @ inverse)
    return float(np.sqrt(by_dwells / (by_dwells + by_model @ by_model)))


def doubt(fit: Calibration, model: GyroModel) -> Array:
    """Return what 1-sigma deviations of model values add to each dwell, rad/s, shape (n, m)."""
    known = [term for term in seen(model) if term.fitted]
    if model.covariance is None or not known:
        return np.zeros((len(_used(fit)), 1))
    places = _places(model.terms, 0)
    chosen = [place for term in known for place in places[term.effect.name]]
    sizes, directions = np.linalg.eigh(model.covariance[np.ix_(chosen, chosen)])
    channels = surroundings(model, _used(fit))
    rows = [row + np.zeros(len(_used(fit)))
            for term in known for row in term.sensitivity(channels)]
    return np.column_stack(rows) @ (directions * np.sqrt(np.maximum(sizes, 0.0)))


def _or_confounder(effect: Effect, fit: Calibration) -> Effect:
    """Return the effect, or its confounder where that stands for it in a fit."""
    confounder = _confounder(effect)
    return effect if effect in fit.effects or confounder is None else confounder


def _counted_well(fit: Calibration, model: GyroModel | None,
                  level: float) -> tuple[Calibration, tuple[Effect, ...]]:
    """Return a fit whose temperature counts from where no slope is needed, and needless slopes."""
    if fit.dwells.temperature is None:
        return fit, ()
    first = _USUAL if model is None else (model.reference_temperature, *_USUAL)
    if BIAS_TEMPERATURE_QUADRATIC in fit.effects:
        for place in (*first, float(fit.dwells.temperature.mean()),
                      float(fit.dwells.temperature[0])):
            counted = counted_from(fit, place)
            if counted.chance_of(BIAS_TEMPERATURE) > level:
                return ((counted if model is None else counted_from(fit, first[0])),
                        (BIAS_TEMPERATURE,))
    return (fit if model is None else counted_from(fit, first[0])), ()


def counted_from(fit: Calibration, temperature: float) -> Calibration:
    """Return the same fit with effects of temperature that count from another temperature."""
    terms = [_with_reference(term, temperature) for term in fit.terms]
    places = [place for place, term in enumerate(terms)
              if not any(shape.default is None for shape in term.effect.shapes)]
    channels = channels_of(fit.dwells)
    total = sum(fit.terms[place].error(channels) for place in places) + np.zeros(len(fit.dwells))
    columns = columns_of(fit.dwells, [terms[place] for place in places])
    lengths = np.linalg.norm(columns, axis=0)
    values = iter((np.linalg.lstsq(columns / lengths, total, rcond=None)[0] / lengths).tolist())
    for place in places:
        shapes = terms[place].values[:len(terms[place].effect.shapes)]
        terms[place] = replace(terms[place],
                               values=(*shapes, *(next(values) for _ in terms[place].fitted)))
    return replace(fit, terms=tuple(terms))


def _with_reference(term: Term, temperature: float) -> Term:
    if not term.effect.shapes or term.effect.shapes[0].name != 'reference_temperature':
        return term
    return replace(term, values=(temperature, *term.values[1:]))


# models

def model_before(dwells: Dwells, model: GyroModel | None, named: Named) -> GyroModel:
    """Return the simulation under test: the given model, or the best bias and scale factor."""
    effects = [each for each in NUISANCES if each in named.change.effects]
    if model is not None or not effects:
        return model or GyroModel()
    return fit_effects(dwells, effects, _scatter(dwells, named)).model


def _scatter(dwells: Dwells, named: Named) -> Scatter | None:
    """Return the scatter that was found, if it is that of these dwells."""
    return named.fit.scatter if len(named.fit.scatter.kept) == len(dwells) else None


def assembled(dwells: Dwells, model: GyroModel | None, fit: Calibration) -> GyroModel:
    """Return a model with the values of a fit in place of its own, or beside them."""
    if model is None:
        return fit.model
    new = {term.effect.name: term for term in fit.terms}
    stays = [term for term in model.terms if not _replaced(term.effect, model, fit)]
    own = [term.effect.name for term in stays]
    terms = (*(new.get(term.effect.name, term) for term in stays),
             *(term for name, term in new.items() if name not in own))
    temperatures = [] if dwells.temperature is None else [dwells.temperature]
    # A self-calibration behind the model was of its old bias and scale factor.
    return replace(model, terms=terms, covariance=_covariance(model, fit, terms),
                   rate_range=wider(model.rate_range, [dwells.output], True),
                   temperature_range=wider(model.temperature_range, temperatures, True),
                   origin=origins_before(model), self_calibration=None)


def _replaced(effect: Effect, model: GyroModel, fit: Calibration) -> bool:
    """Tell whether the confounder of an effect of the model stands in its place."""
    confounder = _confounder(effect)
    return (confounder in fit.effects and effect not in fit.effects
            and all(term.effect is not confounder for term in model.terms))


def _covariance(model: GyroModel, fit: Calibration, terms: Sequence[Term]) -> Array | None:
    """Return the covariance of all fitted values: of model and of dwells, as if independent."""
    found = fit.model.covariance
    stays = [term for term in terms if term.effect not in fit.effects and term.fitted]
    if found is None or (stays and model.covariance is None):
        return None
    known = np.zeros((0, 0)) if model.covariance is None else model.covariance
    both, places = block_diag(known, found), []
    of_model, of_fit = _places(model.terms, 0), _places(fit.terms, len(known))
    for term in terms:
        places += of_fit.get(term.effect.name, []) or of_model[term.effect.name]
    return both[np.ix_(places, places)]


def _places(terms: Sequence[Term], first: int) -> dict[str, list[int]]:
    """Return where the fitted values of each term stand in a covariance."""
    ends = np.cumsum([first, *(len(term.fitted) for term in terms)]).tolist()
    return {term.effect.name: list(range(begin, end))
            for term, begin, end in zip(terms, ends, ends[1:])}


def tried(fit: Calibration, effects: Sequence[Effect]) -> Calibration | None:
    """Fit other effects to the dwells of a fit, or return None where they cannot be parted."""
    try:
        return fit_effects(fit.dwells, effects, fit.scatter)
    except DataRefused:
        return None
