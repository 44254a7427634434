# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Effects of rate and temperature alone, as a rate table shows them."""

from __future__ import annotations

from collections.abc import Sequence

from gyro_calibration.logs.log import Number
from gyro_calibration.model.effects.effect import Channels, Effect, Parameter
import numpy as np


def _bias(channels: Channels) -> Sequence[Number]:
    return (channels.ones(),)


BIAS = Effect(
    'bias', 'The output is not zero at rest; it holds the Earth rate about the input axis.',
    frozenset(), (Parameter('bias', 'rad/s'),), _bias,
    shown_by='let the gyro rest')


def _scale_factor_error(channels: Channels) -> Sequence[Number]:
    return (channels.rate,)


SCALE_FACTOR_ERROR = Effect(
    'scale_factor_error', 'The output grows with the rate by another factor than the nominal one.',
    frozenset({'rate'}), (Parameter('scale_factor_error', '1'),), _scale_factor_error,
    shown_by='turn at several speeds, both ways')


def _sine_response(channels: Channels, k: float) -> Sequence[Number]:
    return (np.sin(k * channels.rate) / k - channels.rate,)


SCALE_FACTOR_ASYMMETRY = Effect(
    'scale_factor_asymmetry', 'The scale factor differs between the two senses of rotation.',
    frozenset({'rate'}), (Parameter('scale_factor_asymmetry', '1'),),
    lambda channels: (abs(channels.rate),),
    shown_by='turn both ways at many speeds, slow ones and rest too')


QUADRATIC_NONLINEARITY = Effect(
    'quadratic_nonlinearity', 'The output has a part that grows with the square of the rate.',
    frozenset({'rate'}), (Parameter('quadratic_nonlinearity', 's/rad'),),
    lambda channels: (channels.rate * channels.rate,),
    shown_by='turn both ways at many speeds up to full scale')


CUBIC_NONLINEARITY = Effect(
    'cubic_nonlinearity', 'The scale factor falls or grows with the square of the rate.',
    frozenset({'rate'}), (Parameter('cubic_nonlinearity', 's²/rad²'),),
    lambda channels: (channels.rate * channels.rate * channels.rate,),
    shown_by='turn at many speeds up to full scale')


SINE_RESPONSE = Effect(
    'sine_response', 'An open-loop fibre-optic gyro answers with the sine of its Sagnac phase.',
    frozenset({'rate'}), (Parameter('amplitude', '1', default=1.0),), _sine_response,
    (Parameter('k', 's', bounds=(1e-3, 30.0)),), 'turn at many speeds up to full scale')


#: From where the effects of temperature count, degC.
_REFERENCE_TEMPERATURE = Parameter('reference_temperature', 'degC', 25.0)


def _bias_temperature(channels: Channels, reference: float) -> Sequence[Number]:
    return (channels.temperature - reference + 0.0 * channels.rate,)


BIAS_TEMPERATURE = Effect(
    'bias_temperature', 'The bias changes in proportion to the temperature.',
    frozenset({'temperature'}), (Parameter('bias_temperature', 'rad/s/K'),), _bias_temperature,
    (_REFERENCE_TEMPERATURE,), 'rest at two temperatures, and better go up and down again')


def _bias_temperature_quadratic(channels: Channels, reference: float) -> Sequence[Number]:
    difference = channels.temperature - reference
    return (difference * difference + 0.0 * channels.rate,)


BIAS_TEMPERATURE_QUADRATIC = Effect(
    'bias_temperature_quadratic', 'The bias is curved over temperature.',
    frozenset({'temperature'}), (Parameter('bias_temperature_quadratic', 'rad/s/K²'),),
    _bias_temperature_quadratic, (_REFERENCE_TEMPERATURE,), 'rest at three temperatures or more')


def _scale_factor_temperature(channels: Channels, reference: float) -> Sequence[Number]:
    return ((channels.temperature - reference) * channels.rate,)


SCALE_FACTOR_TEMPERATURE = Effect(
    'scale_factor_temperature', 'The scale factor changes in proportion to the temperature.',
    frozenset({'rate', 'temperature'}), (Parameter('scale_factor_temperature', '1/K'),),
    _scale_factor_temperature, (_REFERENCE_TEMPERATURE,), 'turn at two temperatures')
