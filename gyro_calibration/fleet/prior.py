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
Models of a fleet: one for a further unit of a type, and one for each unit that is known.

They hold the values that are usual, and as tolerance how far a power-on may be from them, so that
their interval of 95 % is that of the fleet. The compensation counts the tolerance until there is a
self-calibration; that takes it as its prior (`GyroModel.prior`).

"""

from __future__ import annotations

from collections.abc import Iterator
import math

from gyro_calibration.fleet.pooling import Interval
from gyro_calibration.fleet.summary import TypeFound
from gyro_calibration.model.effects import CATALOGUE
from gyro_calibration.model.gyro_model import GyroModel, Term, Tolerance
from gyro_calibration.model.noise import Noise
import numpy as np

_TOLERATED = ('bias', 'scale_factor_error')
#: Of a normal distribution, for 95 %.
_BAND = 1.96


def models(found: TypeFound) -> Iterator[tuple[str, GyroModel]]:
    """Give for a further unit of a type, with the name '', and for each unit: name and model."""
    yield '', _model(found, None)
    for place, name in enumerate(found.units):
        yield name, _model(found, place)


def _model(found: TypeFound, unit: int | None) -> GyroModel:
    terms, variances = [], []
    spread = dict.fromkeys(_TOLERATED, 0.0)
    for name, each in found.values.items():
        # the time offset of logs is that of their references
        if each.slow or name not in CATALOGUE or name == 'time_offset':
            continue
        effect = CATALOGUE[name]
        value, deviation = _known(each.new_unit if unit is None else each.next_log, unit or 0)
        if effect.shapes or len(effect.parameters) > 1 or not math.isfinite(deviation):
            continue
        terms.append(Term(effect, (value,)))
        variances.append(0.0 if name in spread else deviation ** 2)
        if name in spread:
            spread[name] = deviation
    gyro = {'name': found.name, 'serial_number': '' if unit is None else found.units[unit]}
    logs = (len(found.records) if unit is None
            else sum(each['unit'] == found.units[unit] for each in found.records))
    noise = {name: float(np.median([each['noise'].get(name, 0.0) for each in found.records]))
             for name in Noise.__dataclass_fields__}
    return GyroModel(
        tuple(terms), np.diag(variances), noise=Noise(**noise),
        gyro={name: text for name, text in gyro.items() if text},
        origin={'fleet': {'units': len(found.units) if unit is None else 1, 'logs': logs}},
        tolerance=Tolerance(**spread))


def _known(of: Interval, place: int) -> tuple[float, float]:
    """Return the middle of an interval, and the deviation of as wide a normal distribution."""
    return (0.5 * float(of.high[place] + of.low[place]),
            0.5 * float(of.high[place] - of.low[place]) / _BAND)
