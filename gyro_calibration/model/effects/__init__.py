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
What stands between the true rate and the output of a gyro: the one place of each formula.

Simulation, calibration, diagnosis and compensation meet here. Most effects add
``sum(columns(channels, *shapes) * values)`` to the output. Others change the signal itself, such
as a delay, or rounding.

Reading order, each imports only from those before it: `effect` (the records: channels, parameters,
effects), `lag` (of first order), `steady` (of rate and temperature alone, as a rate table shows
them), `polynomial` (of Ojeda, Chung and Borenstein), `thermal` (what temperatures of the past
leave), `course` (of the time since power-on), `surroundings` (magnetic, mechanical, electrical),
`signal` (what is done to the signal itself).

"""

from collections.abc import Iterable

from gyro_calibration.logs.log import Number  # noqa: F401
from gyro_calibration.model.effects.course import BIAS_STEP, INTERFERENCE_TONE, RATE_RAMP, WARM_UP
from gyro_calibration.model.effects.effect import Channels, Effect, Parameter  # noqa: F401
from gyro_calibration.model.effects.polynomial import (  # noqa: F401
    polynomial_from_matrix,
    polynomial_to_matrix,
    rate_temperature_polynomial,
)
from gyro_calibration.model.effects.signal import (
    BANDWIDTH,
    CLOCK_RATE,
    DEAD_ZONE,
    QUANTIZATION,
    SATURATION,
    TIME_OFFSET,
)
from gyro_calibration.model.effects.steady import (
    BIAS,
    BIAS_TEMPERATURE,
    BIAS_TEMPERATURE_QUADRATIC,
    CUBIC_NONLINEARITY,
    QUADRATIC_NONLINEARITY,
    SCALE_FACTOR_ASYMMETRY,
    SCALE_FACTOR_ERROR,
    SCALE_FACTOR_TEMPERATURE,
    SINE_RESPONSE,
)
from gyro_calibration.model.effects.surroundings import (
    ACCELERATION_SENSITIVITY,
    HEADING_SENSITIVITY,
    SUPPLY_SENSITIVITY,
    VIBRATION_RECTIFICATION,
)
from gyro_calibration.model.effects.thermal import (
    BIAS_TEMPERATURE_RATE,
    THERMAL_HYSTERESIS,
    THERMAL_LAG,
)
import numpy as np

#: Those of rate and temperature alone, which dwells of a rate table can show.
STEADY = {effect.name: effect for effect in (
    BIAS, SCALE_FACTOR_ERROR, SCALE_FACTOR_ASYMMETRY, QUADRATIC_NONLINEARITY, CUBIC_NONLINEARITY,
    SINE_RESPONSE, BIAS_TEMPERATURE, BIAS_TEMPERATURE_QUADRATIC, SCALE_FACTOR_TEMPERATURE)}
#: All that a model may hold, except the polynomial.
CATALOGUE = STEADY | {effect.name: effect for effect in (
    BIAS_TEMPERATURE_RATE, THERMAL_LAG, THERMAL_HYSTERESIS, WARM_UP, RATE_RAMP, BIAS_STEP,
    HEADING_SENSITIVITY, ACCELERATION_SENSITIVITY, VIBRATION_RECTIFICATION, SUPPLY_SENSITIVITY,
    INTERFERENCE_TONE, BANDWIDTH, TIME_OFFSET, CLOCK_RATE, DEAD_ZONE, SATURATION, QUANTIZATION)}

#: Effects of the user's own, which `add_effects` put into the catalogue.
ADDED: dict[str, Effect] = {}


def add_effects(effects: Iterable[Effect]) -> None:
    """
    Put effects of one's own into the catalogue, for models and for the diagnosis of logs.

    Raises
    ------
    ValueError : if one is no `Effect`, has a name that is taken, or a shape to be fitted without
        values to begin with, or if its columns do not fit to its coefficients

    """
    rate = np.linspace(-1.0, 1.0, 5)
    channels = Channels(rate, rate, 25.0 + rate, 1.0 + rate, rate, 5.0 + rate, rate,
                        lambda channel, seconds: rate, lambda seconds, threshold: rate)
    for effect in effects:
        if not isinstance(effect, Effect):
            raise ValueError(f'{effect!r} is not an Effect')
        if effect.name in CATALOGUE and effect.name not in ADDED:
            raise ValueError(f'the name {effect.name} is taken; give the effect another')
        if any(shape.default is None and not shape.begin_with for shape in effect.shapes):
            raise ValueError(f'{effect.name} has a shape without a default and without begin_with')
        shapes = [shape.default if shape.default is not None else shape.begin_with[0]
                  for shape in effect.shapes]
        columns = effect.columns(channels, *shapes)
        if (len(columns) != len(effect.coefficients)
                or any(np.shape(column) != rate.shape for column in columns)):
            raise ValueError(f'{effect.name} has {len(effect.coefficients)} coefficients and '
                             f'{len(columns)} columns; give an array like channels.rate for each')
        ADDED[effect.name] = CATALOGUE[effect.name] = effect
