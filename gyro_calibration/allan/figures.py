# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The noise figures of a record: the coefficient of each part of the noise, and its bounds."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
import math

from gyro_calibration.allan.chart import allan_deviation, AllanChart
from gyro_calibration.allan.description import describe
from gyro_calibration.allan.octaves import Octaves
from gyro_calibration.allan.parts import (
    ANGLE_WALK_PLACE,
    BEND_PLACE,
    FLICKER_PLACE,
    Part,
    PARTS,
    RATE_WALK_PLACE,
)
from gyro_calibration.allan.ranking import rank, Ranking
from gyro_calibration.logs.log import Array, DataRefused
from gyro_calibration.model.noise import Noise
import numpy as np

#: -2 ln likelihood above its least at the ends of an interval of 95 %: that of chi squared.
_CONFIDENCE = 3.84
#: Halvings of the distance to such an end.
_HALVINGS = 12
#: Parts of the size of a coefficient at which the least is looked for.
_TRIED = (0.25, 0.5, 0.75, 0.9, 1.0, 1.1)
#: Parts that may be there without being seen, and are fitted beside each other for the bounds.
_ALWAYS = (ANGLE_WALK_PLACE, FLICKER_PLACE, RATE_WALK_PLACE)
#: The least number that shows a slope and its end.
_FEWEST_OCTAVES = 4


@dataclass(frozen=True)
class Figure:
    """
    The coefficient of one part of the noise.

    Attributes
    ----------
    part : which
    value : its coefficient, in the part's unit; 0 where the record shows none
    standard_deviation : of the coefficient, if there are no parts but those that are seen; nan
        where the record shows none
    lower, upper : bounds with 95 % confidence, also if there is a little of other parts; where the
        record shows none, 0 and the largest coefficient that it can hide

    """

    part: Part
    value: float
    standard_deviation: float
    lower: float
    upper: float

    def variance(self, time: Array) -> Array:
        """Return the Allan variance that it makes, (rad/s)²."""
        return self.value ** 2 * self.part.variance(time)


@dataclass(frozen=True)
class NoiseFit:
    """
    The noise figures of a record.

    Attributes
    ----------
    figures : by symbol: N, B, K, Q, R
    chart : the Allan deviations that were fitted, at octaves
    shortest, longest : the averaging times that the fit holds for, s
    misfit : by how much more the Allan deviations differ from the sum of the parts than chance
        allows, as a share of them
    rivals : the symbols of other combinations of parts that explain the record nearly as well

    """

    figures: dict[str, Figure]
    chart: AllanChart
    shortest: float
    longest: float
    misfit: float
    rivals: tuple[str, ...] = ()

    @property
    def noise(self) -> Noise:
        """Return the figures that a model holds."""
        return Noise(*(self.figures[symbol].value for symbol in 'NBK'))

    @property
    def noise_bounds(self) -> dict[str, tuple[float, float]]:
        """Return the bounds of these figures, by their names in a model."""
        return {name: (self.figures[symbol].lower, self.figures[symbol].upper)
                for name, symbol in zip(Noise.__dataclass_fields__, 'NBK')}

    def deviation(self, time: Array) -> Array:
        """Return the Allan deviation, rad/s, that the figures add up to."""
        return np.sqrt(sum(figure.variance(time) for figure in self.figures.values()))

    @property
    def floor_reached(self) -> bool:
        """Return whether N and Q make less than half of the variance, an octave before the end."""
        time = self.chart.time[-2]
        falling = sum(figure.variance(time) for figure in self.figures.values()
                      if figure.part.slope < 0.0)
        return bool(falling < 0.5 * self.deviation(time) ** 2)


def fit_noise(rate: Array, interval: float) -> NoiseFit:
    """
    Fit the parts of the noise to the Allan variances at octaves, and keep those that are seen.

    The squared coefficients are found by generalized least squares (as in the generalized method
    of wavelet moments of Guerrier, Skaloud, Stebler and Victoria-Feser, JASA 2013), none of them
    negative, with the covariance that the fitted noise itself implies. Of all combinations the
    likeliest is kept, if each further part makes the data likelier by more than chance does. The
    shortest averaging times are left out until the sum of the parts describes the rest, because
    the filters of a gyro bend that end.

    Parameters
    ----------
    rate : rad/s, shape (n,), one sample an interval; nan where a sample is lost
    interval : s

    Raises
    ------
    DataRefused : too few samples, or no sum of the parts describes them

    """
    chart = allan_deviation(rate, interval, 2.0 ** np.arange(
        max(math.floor(math.log2(max(len(rate), 8) / 6.0)), 1) + 1) * interval)
    if len(chart.size) < _FEWEST_OCTAVES or not chart.deviation.all():
        raise DataRefused(f'{len(chart.size)} octaves of averaging times without a gap, the '
                          'lowest Allan deviation '
                          f'{chart.deviation.min(initial=math.inf):g} rad/s; wanted '
                          f'{_FEWEST_OCTAVES} octaves, all above 0: record longer and without '
                          'losses')
    ranking = rank(Octaves.of(chart))
    figures = {part.symbol: _in_seconds(_figure(ranking, place), interval)
               for place, part in enumerate(PARTS)}
    return NoiseFit(figures, chart, float(chart.time[ranking.start]), float(chart.time[-1]),
                    ranking.misfit, _rivals(ranking))


def _figure(ranking: Ranking, place: int) -> Figure:
    """Return a figure with bounds that hold with and without parts of too little evidence."""
    best = ranking.best
    if place not in ranking.seen:
        return Figure(PARTS[place], 0.0, math.nan, 0.0, _bounds(ranking, place)[1])
    value = math.sqrt(best.squares[place])
    lower, upper = zip(_bounds(ranking, place), *(
        each.bounds(place) for each in ranking.tempting if place in each.held))
    return Figure(PARTS[place], value, 0.5 * best.deviation(place) / value,
                  min(*lower, value), max(*upper, value))


def _bounds(ranking: Ranking, place: int) -> tuple[float, float]:
    """
    Return the coefficients between which -2 ln likelihood is within `_CONFIDENCE` of the least.

    At each coefficient the other parts are fitted anew, those of `_ALWAYS` among them, so that
    what one of flicker and random walk takes from the other is in the bounds.

    """
    octaves, misfit = ranking.best.octaves, ranking.misfit
    held = {*_ALWAYS, *(each for one in (*ranking.tempting, *ranking.rivals)
                        for each in one.held)}
    others = tuple(sorted(held - {place}))
    joint = describe(octaves, (*others, place), misfit)
    (*_, square), (*_, deviation) = joint.estimate((*others, place))

    @cache
    def surprise(coefficient: float) -> float:
        return describe(octaves, others, misfit, place, coefficient ** 2).surprise

    found = math.sqrt(joint.squares[place])
    scale = math.sqrt(max(square, 0.0) + deviation)
    least = min(surprise(found), *(surprise(scale * factor) for factor in _TRIED))
    likeliest = min((found, *(scale * factor for factor in _TRIED)), key=surprise)

    def border(inside: float, outside: float) -> float:
        for _ in range(_HALVINGS):
            middle = 0.5 * (inside + outside)
            inside, outside = ((middle, outside) if surprise(middle) < least + _CONFIDENCE
                               else (inside, middle))
        return inside

    high = max(likeliest, scale)
    while surprise(high) < least + _CONFIDENCE and high < 1e3 * scale:
        high *= 1.5
    lower = 0.0 if surprise(0.0) < least + _CONFIDENCE else border(likeliest, 0.0)
    return lower, border(likeliest, high)


def _in_seconds(figure: Figure, interval: float) -> Figure:
    """Return a figure that is in samples in the part's unit."""
    unit = interval ** -figure.part.slope
    return Figure(figure.part, *(value * unit for value in (
        figure.value, figure.standard_deviation, figure.lower, figure.upper)))


def _rivals(ranking: Ranking) -> tuple[str, ...]:
    """Return the symbols of the rivals' parts."""
    return tuple(sorted({''.join(PARTS[place].symbol for place in each.held if place != BEND_PLACE)
                         for each in ranking.rivals}))
