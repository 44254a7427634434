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
Errors of a gyro: the formula of each effect between the true rate and the output.

Simulation, calibration, diagnosis and compensation use the same formulas. Most effects add
``sum(columns(channels, *shapes) * values)`` to the output. Others, such as a delay or rounding,
change the signal itself.

Reading order, each imports only from those before it: `effect` (the records: channels, parameters,
effects; the lag), `polynomial` (of Ojeda, Chung and Borenstein), `catalogue` (all others).

"""

from gyro_calibration.model.effects.catalogue import (
    add_effects,
    BIAS,
    BIAS_TEMPERATURE,
    BIAS_TEMPERATURE_QUADRATIC,
    CATALOGUE,
    CUBIC_NONLINEARITY,
    QUADRATIC_NONLINEARITY,
    QUANTIZATION,
    SATURATION,
    SCALE_FACTOR_ASYMMETRY,
    SCALE_FACTOR_ERROR,
    SCALE_FACTOR_TEMPERATURE,
    SINE_RESPONSE,
    STATIC_EFFECTS,
    USER_EFFECTS,
)
from gyro_calibration.model.effects.effect import Channels, Effect, Parameter
from gyro_calibration.model.effects.polynomial import (
    polynomial_from_matrix,
    polynomial_to_matrix,
    rate_temperature_polynomial,
)

__all__ = ['USER_EFFECTS', 'BIAS', 'BIAS_TEMPERATURE', 'BIAS_TEMPERATURE_QUADRATIC', 'CATALOGUE',
           'CUBIC_NONLINEARITY', 'Channels', 'Effect', 'Parameter', 'QUADRATIC_NONLINEARITY',
           'QUANTIZATION', 'SATURATION', 'SCALE_FACTOR_ASYMMETRY', 'SCALE_FACTOR_ERROR',
           'SCALE_FACTOR_TEMPERATURE', 'SINE_RESPONSE', 'STATIC_EFFECTS', 'add_effects',
           'polynomial_from_matrix', 'polynomial_to_matrix', 'rate_temperature_polynomial']
