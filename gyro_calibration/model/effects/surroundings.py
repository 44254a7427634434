# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Effects of what is around the gyro: magnetic, mechanical, electrical."""

from __future__ import annotations

from collections.abc import Sequence

from gyro_calibration.logs.log import Number
from gyro_calibration.model.effects.effect import Channels, Effect, Parameter
import numpy as np


def _heading_sensitivity(channels: Channels) -> Sequence[Number]:
    nothing = 0.0 * channels.rate
    return np.sin(channels.heading) + nothing, np.cos(channels.heading) + nothing


HEADING_SENSITIVITY = Effect(
    'heading_sensitivity',
    'The bias depends on the heading, mostly by the magnetic field of the Earth.',
    frozenset({'heading'}), (Parameter('sine', 'rad/s'), Parameter('cosine', 'rad/s')),
    _heading_sensitivity, shown_by='turn at several speeds, and rest at eight headings')


ACCELERATION_SENSITIVITY = Effect(
    'acceleration_sensitivity',
    'The bias changes in proportion to the specific force along the input axis.',
    frozenset({'specific_force'}), (Parameter('acceleration_sensitivity', '(rad/s)/(m/s²)'),),
    lambda channels: (channels.specific_force + 0.0 * channels.rate,),
    shown_by='rest in several poses within one power-on')


def _vibration_rectification(channels: Channels, time_constant: float) -> Sequence[Number]:
    square = 0.0 if channels.lagged is None else channels.lagged('vibration', time_constant)
    return (square + 0.0 * channels.rate,)


VIBRATION_RECTIFICATION = Effect(
    'vibration_rectification', 'Vibration shifts the bias in proportion to its mean square.',
    frozenset({'specific_force', 'lagged'}),
    (Parameter('vibration_rectification', '(rad/s)/(m/s²)²'),), _vibration_rectification,
    (Parameter('time_constant', 's', 1.0, (1e-3, 1e4)),), 'run the motor and stop it, at rest')


def _supply_sensitivity(channels: Channels, reference: float) -> Sequence[Number]:
    difference = 0.0 if channels.supply is None else channels.supply - reference
    return (difference + 0.0 * channels.rate,)


SUPPLY_SENSITIVITY = Effect(
    'supply_sensitivity', 'The bias changes in proportion to the supply voltage.',
    frozenset({'supply'}), (Parameter('supply_sensitivity', 'rad/s/V'),), _supply_sensitivity,
    (Parameter('reference_supply', 'V', 5.0),), 'step the supply at one temperature')
