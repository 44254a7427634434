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
Units and drives that stand out of their type, and units that change, at a stated level.

The one that is farthest off is given an effect of its own and all else is pooled again, so that it
is compared with what the others predict for one more unit. Its chance is multiplied by the number
of those that it was chosen from (Bonferroni). Where there are many, the next is looked at beside
it, for two that stand out hide each other; the last one below the level counts, and all before it
(generalized extreme studentized deviate, Rosner 1983).

"""

from __future__ import annotations

from dataclasses import dataclass

from gyro_calibration.fleet.pooling import Numbers, Observed, Pooled, POWER_ONS, UNITS
from gyro_calibration.logs.log import Array
import numpy as np

#: Fewer units or drives do not show what is usual.
FEWEST = 4


@dataclass(frozen=True)
class Outlier:
    """
    A unit or drive that stands out.

    Attributes
    ----------
    number : of the unit or drive
    excess : by how much it differs from what the others predict, in the unit of the value
    chance : that the farthest of as many would be as far off

    """

    number: int
    excess: float
    chance: float


def outliers(observed: Observed, kind: str, level: float, pooled: Pooled | None = None
             ) -> list[Outlier]:
    """
    Return the units or drives that stand out.

    Parameters
    ----------
    observed : one value over the logs of a type
    kind : `pooling.UNITS` or `pooling.DRIVES`
    level : chance that any stands out where none does
    pooled : the value, where it is pooled already

    """
    number = observed.unit if kind == UNITS else observed.drive
    groups = np.unique(number[number >= 0])
    if len(groups) < FEWEST or len(observed) < FEWEST + 1:
        return []
    # Rosner's levels hold from 15 on
    most = min(len(groups) // 5, 10) if len(groups) >= 15 else 1
    found: list[Outlier] = []
    without: Observed = observed
    pooled = pooled or Pooled(observed)
    for _ in range(most):
        if kind not in pooled.names:
            break
        standing = np.abs(pooled.standing(kind))[groups]
        standing[np.isin(groups, [each.number for each in found])] = 0.0
        worst = int(groups[np.argmax(standing)])
        without = without.with_column((number == worst).astype(float))
        pooled = Pooled(without)
        excess, chance = _last(pooled)
        found.append(Outlier(worst, excess, min(chance * (len(groups) - len(found)), 1.0)))
    last = max((place for place, each in enumerate(found, 1) if each.chance < level), default=0)
    return found[:last]


@dataclass(frozen=True)
class Change:
    """
    A unit that is another one from some date on.

    Attributes
    ----------
    unit : its number
    since : number of the first date on which it is another one
    size : of the change, in the unit of the value
    chance : that the largest of as many possible changes would be as large

    """

    unit: int
    since: int
    size: float
    chance: float


def changes(observed: Observed, date: Numbers, level: float, pooled: Pooled | None = None
            ) -> list[Change]:
    """
    Return the units that change between dates, beyond how they repeat; the clearest change alone.

    Parameters
    ----------
    observed : one value over the logs of a type
    date : number of the date of each log, in their order, or -1, shape (n,)
    level : chance that any changes where none does
    pooled : the value, where it is pooled already

    """
    pooled = pooled or Pooled(observed)
    if POWER_ONS not in pooled.names:
        return []
    candidates = [(int(unit), int(since)) for unit in np.unique(observed.unit)
                  for since in np.unique(date[(observed.unit == unit) & (date >= 0)])[1:]]
    if not candidates:
        return []
    columns = [((observed.unit == unit) & (date >= since)).astype(float)
               for unit, since in candidates]
    place = int(np.argmax([abs(pooled.score(column)) for column in columns]))
    size, chance = _last(Pooled(observed.with_column(columns[place])))
    chance = min(chance * len(candidates), 1.0)
    return [Change(*candidates[place], size, chance)] if chance < level else []


def _last(pooled: Pooled) -> tuple[float, float]:
    """Return the last fixed effect, and the chance that it is as far from zero."""
    row: Array = np.zeros((1, pooled.observed.fixed.shape[1]))
    row[0, -1] = 1.0
    wanted = pooled.wanted(fixed=row)
    return float(pooled.estimate(wanted).value[0]), float(pooled.chance(wanted)[0])
