# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The ranking of all combinations of parts, the likeliest first."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
import itertools

from gyro_calibration.allan.description import describe, Description, RIVAL
from gyro_calibration.allan.octaves import Octaves
from gyro_calibration.allan.parts import ANGLE_WALK_PLACE, BEND_PLACE, PARTS, QUANTIZATION_PLACE
from gyro_calibration.logs.log import DataRefused

#: Shares by which the Allan deviations may differ from the sum of the parts; the smallest one that
#: suffices is taken.
_MISFITS = (0.0, *(0.01 * 2.0 ** (step / 2.0) for step in range(11)))

#: A combination that is likelier by this, but lacks evidence, widens the bounds.
_TEMPTING = 1.0


def _with_short_end(places: tuple[int, ...]) -> list[tuple[int, ...]]:
    """Return a combination without and with quantization, and with a bend of its random walk."""
    return [places, (*places, QUANTIZATION_PLACE)] + (
        [(*places, BEND_PLACE)] if ANGLE_WALK_PLACE in places else [])


_COMBINATIONS = [combination for count in range(len(PARTS))
                 for places in itertools.combinations(
                     [place for place in range(len(PARTS)) if place != QUANTIZATION_PLACE], count)
                 for combination in _with_short_end(places) if combination]


@dataclass(frozen=True)
class Ranking:
    """
    All combinations of parts, fitted to the same octaves.

    Attributes
    ----------
    start : the first octave that they describe
    misfit : see `NoiseFit`
    descriptions : the likeliest first

    """

    start: int
    misfit: float
    descriptions: tuple[Description, ...]

    @property
    def best(self) -> Description:
        """Return the likeliest."""
        return self.descriptions[0]

    @property
    def seen(self) -> list[int]:
        """Return the places of the best's parts; after a bent end quantization is no figure."""
        return [place for place in self.best.held if place != BEND_PLACE
                and (place != QUANTIZATION_PLACE or self.start == 0)]

    @cached_property
    def rivals(self) -> list[Description]:
        """Return the combinations of other parts, not more, that are nearly as likely."""
        best = self.best
        return [each for each in self.descriptions
                if each.surprise < best.surprise + RIVAL and len(each.held) <= len(best.held)
                and not set(each.held) - {BEND_PLACE, QUANTIZATION_PLACE} <= set(best.held)]

    @cached_property
    def tempting(self) -> list[Description]:
        """Return the best, those that are likelier without evidence, and those with a rival."""
        best = self.best
        both = [{*best.held, *rival.held} for rival in self.rivals]
        return [best, *(each for each in self.descriptions
                        if each.surprise < best.surprise - _TEMPTING or set(each.held) in both)]


def rank(octaves: Octaves) -> Ranking:
    """
    Rank all combinations of parts.

    The first octave is the earliest one that chance allows; if none is, a misfit is added. The
    filters that bend the short end fade slowly: one octave more than that is left out.

    Raises
    ------
    DataRefused : no combination describes the octaves

    """
    last = max(len(octaves.variance) // 2 - 1, 0)
    for misfit, start in itertools.product(_MISFITS, range(last + 1)):
        ranking = _rank_since(octaves, start, misfit)
        if ranking.best.likely():
            return _rank_since(octaves, start + 1, misfit) if 0 < start < last else ranking
    raise DataRefused(f'the Allan deviations are more than {100 * _MISFITS[-1]:.0f} % off any sum '
                      'of the five kinds of noise: there is something else in the record, such as '
                      'a swing or a vibration; record again at rest')


def _rank_since(octaves: Octaves, start: int, misfit: float) -> Ranking:
    since = octaves.since(start)
    return Ranking(start, misfit, tuple(sorted(
        (describe(since, places, misfit) for places in _COMBINATIONS), key=Description.cost)))
