# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""What an extension improves on sweeps left out of it, and curves of errors before and after."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import math

from gyro_calibration.calibration.dwells import Dwells, Numbers, take
from gyro_calibration.calibration.scatter import FEWEST_SWEEPS, parts_of, Scatter, summed
from gyro_calibration.diagnosis.cross_validation import change_over, WINDOW
from gyro_calibration.diagnosis.dwell_fit import simulated
from gyro_calibration.diagnosis.findings import Curve, Gain
from gyro_calibration.logs.log import Array, DataRefused, Mask
from gyro_calibration.model.gyro_model import GyroModel
import numpy as np

#: The most groups of parts of a table that are left out in turn: each choice of causes takes time.
_MOST_GROUPS = 8
#: Bins of a curve at most, and dwells in each at least.
_MOST_BINS, _DWELLS_A_BIN = 40, 4

#: Dwells -> the simulation before, and the extended one, from these dwells alone.
Extend = Callable[[Dwells], tuple[GyroModel, GyroModel]]


def measure_gain(dwells: Dwells, extend: Extend) -> Gain | None:
    """
    Return what an extension improves, or None where it cannot be made without a part of the table.

    Parameters
    ----------
    dwells : of a rate table, outlying ones too
    extend : chooses the causes anew, and fits them

    """
    parts = parts_of(dwells)
    groups = parts * min(_MOST_GROUPS, parts.max() + 1) // (parts.max() + 1)
    before, after = np.full(len(dwells), np.nan), np.full(len(dwells), np.nan)
    for number in np.unique(groups):
        hidden = groups == number
        try:
            models = extend(take(dwells, ~hidden))
        except DataRefused:
            continue
        left_out = take(dwells, hidden)
        before[hidden], after[hidden] = (left_out.output - simulated(model, left_out)
                                         for model in models)
    known = np.isfinite(before) & np.isfinite(after)
    if not known.any():
        return None
    numbered = np.unique(parts[known], return_inverse=True)[1]
    rate = change_over(summed(np.column_stack([before, after])[known] ** 2, numbered),
                       np.bincount(numbered).astype(float))
    # A heading error is that of so long a turn at the rate of a dwell.
    return Gain(_held_out(dwells, groups), rate, rate.scaled(WINDOW), WINDOW)


def _held_out(dwells: Dwells, groups: Numbers) -> str:
    what = 'sweeps' if len(np.unique(dwells.sweep)) >= FEWEST_SWEEPS else 'consecutive dwells'
    return f'{what} left out, each of {groups.max() + 1} groups in turn'


# curves

def curves(dwells: Dwells, scatter: Scatter, before: GyroModel,
           after: GyroModel) -> tuple[Curve, ...]:
    """Return the errors of dwells, without outliers, along rate, temperature and their order."""
    used = take(dwells, scatter.kept)
    ways, straight = np.sign(used.rate), np.ones(len(used))
    found = [_curve('rate', 'rad/s', used.rate, straight, used, scatter, before, after),
             _curve('order_of_dwells', '', np.arange(1.0, len(used) + 1.0), straight, used,
                    scatter, before, after)]
    if used.temperature is not None and np.ptp(used.temperature) > 0.0:
        found.append(_curve('temperature', 'degC', used.temperature, straight, used, scatter,
                            before, after))
        # A scale factor that changes with temperature averages out over turns both ways, unless
        # errors count in the sense of the turn.
        found.append(_curve('temperature_while_turning', 'degC', used.temperature, ways, used,
                            scatter, before, after))
    return tuple(found)


def _curve(along: str, unit: str, values: Array, sign: Array, dwells: Dwells, scatter: Scatter,
           before: GyroModel, after: GyroModel) -> Curve:
    outputs = [simulated(model, dwells) for model in (before, after)]
    errors = [sign * (dwells.output - outputs[0]), sign * (dwells.output - outputs[1]),
              sign * (outputs[0] - dwells.rate)]
    bins = list(_bins(values, sign != 0.0))
    at, *means = (np.array([float(each[chosen].mean()) for chosen in bins])
                  for each in (values, *errors))
    deviation = np.array([_deviation(dwells, scatter, sign, chosen) for chosen in bins])
    return Curve(along, unit, at, means[0], means[1], deviation, means[2])


def _bins(values: Array, wanted: Mask) -> Iterator[Mask]:
    """Give the members of bins of equal width that hold something."""
    count = max(1, min(_MOST_BINS, len(np.unique(values)), len(values) // _DWELLS_A_BIN))
    edges = np.linspace(values.min(), values.max(), count + 1)
    place = np.clip(np.searchsorted(edges, values, side='right') - 1, 0, count - 1)
    yield from (chosen for number in range(count) if (chosen := (place == number) & wanted).any())


def _deviation(dwells: Dwells, scatter: Scatter, sign: Array, chosen: Mask) -> float:
    """Return the standard deviation of the mean error of dwells; a sweep shares a part of it."""
    part = take(dwells, chosen)
    shared = summed(sign[chosen, None] * scatter.shared(part),
                    np.unique(part.sweep, return_inverse=True)[1])
    return math.sqrt(float(np.sum(scatter.deviation(part) ** 2) + np.sum(shared ** 2))) / len(part)
