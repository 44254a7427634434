# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Effects of the temperatures of the past."""

from __future__ import annotations

from collections.abc import Sequence

from gyro_calibration.logs.log import Number
from gyro_calibration.model.effects.effect import Channels, Effect, Parameter


def _ahead(channels: Channels, time_constant: float) -> Number:
    """Return what the lagged temperature is above the temperature, K."""
    if channels.lagged is None:
        return 0.0
    return channels.lagged('temperature', time_constant) - channels.temperature


def _bias_temperature_rate(channels: Channels, filter_time: float) -> Sequence[Number]:
    return (-_ahead(channels, filter_time) / filter_time + 0.0 * channels.rate,)


BIAS_TEMPERATURE_RATE = Effect(
    'bias_temperature_rate',
    'The bias changes in proportion to how fast the temperature changes, as gradients within the '
    'instrument do (in fibre gyros the effect of Shupe).',
    frozenset({'temperature', 'lagged'}), (Parameter('bias_temperature_rate', 'rad/s/(K/s)'),),
    _bias_temperature_rate, (Parameter('filter_time', 's', 10.0, (1e-3, 1e4)),),
    'heat and cool at two speeds, with corners in the temperature')


def _thermal_lag(channels: Channels, time_constant: float) -> Sequence[Number]:
    return (_ahead(channels, time_constant) + 0.0 * channels.rate,)


THERMAL_LAG = Effect(
    'thermal_lag',
    'The bias follows the temperature of the sensing element, which lags behind that of the '
    'thermometer.',
    frozenset({'temperature', 'lagged'}), (Parameter('thermal_lag', 'rad/s/K'),), _thermal_lag,
    (Parameter('time_constant', 's', bounds=(1.0, 3000.0)),),
    'heat and cool at two speeds, with corners in the temperature')


def _thermal_hysteresis(channels: Channels, filter_time: float,
                        threshold: float) -> Sequence[Number]:
    heating = 0.0 if channels.heating is None else channels.heating(filter_time, threshold)
    return (heating + 0.0 * channels.rate,)


THERMAL_HYSTERESIS = Effect(
    'thermal_hysteresis', 'The bias is another one while the gyro cools than while it heats.',
    frozenset({'temperature', 'heating'}), (Parameter('thermal_hysteresis', 'rad/s'),),
    _thermal_hysteresis,
    (Parameter('filter_time', 's', 10.0, (1e-3, 1e4)),
     Parameter('threshold', 'K/s', 1e-3, (0.0, 10.0))),
    'go through the same cycle of temperature at two speeds')
