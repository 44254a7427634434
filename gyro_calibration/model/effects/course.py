# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Effects of the time since power-on."""

from __future__ import annotations

from collections.abc import Sequence
import math

from gyro_calibration.logs.log import Number
from gyro_calibration.model.effects.effect import Channels, Effect, Parameter
import numpy as np


def _warm_up(channels: Channels, time_constant: float) -> Sequence[Number]:
    return (np.exp(-channels.time / time_constant) + 0.0 * channels.rate,)


WARM_UP = Effect(
    'warm_up', 'After power-on the bias settles exponentially.',
    frozenset({'time'}), (Parameter('warm_up', 'rad/s'),), _warm_up,
    (Parameter('time_constant', 's', bounds=(1.0, 1e5)),), 'start cold, and start warm')


RATE_RAMP = Effect(
    'rate_ramp', 'The bias grows steadily with time.',
    frozenset({'time'}), (Parameter('rate_ramp', 'rad/s²'),),
    lambda channels: (channels.time + 0.0 * channels.rate,),
    shown_by='let it run several times, heating in one and cooling in another')


def _bias_step(channels: Channels, step_time: float) -> Sequence[Number]:
    return ((channels.time >= step_time) * channels.ones(),)


BIAS_STEP = Effect(
    'bias_step', 'At one moment the bias becomes another one.',
    frozenset({'time'}), (Parameter('bias_step', 'rad/s'),), _bias_step,
    (Parameter('step_time', 's', bounds=(0.0, 1e9)),), 'run again: it happens once')


def _interference_tone(channels: Channels, frequency: float) -> Sequence[Number]:
    phase = 2.0 * math.pi * frequency * channels.time
    return np.sin(phase) + 0.0 * channels.rate, np.cos(phase) + 0.0 * channels.rate


INTERFERENCE_TONE = Effect(
    'interference_tone',
    'Something periodic gets into the output, or folds down from above half the sample rate.',
    frozenset({'time'}), (Parameter('sine', 'rad/s'), Parameter('cosine', 'rad/s')),
    _interference_tone, (Parameter('frequency', 'Hz', bounds=(1e-4, 1e5)),),
    'sample at another rate: an alias moves, a tone stays')
