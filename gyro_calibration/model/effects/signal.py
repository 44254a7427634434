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
Effects on the signal itself.

All but the dead zone are functions of the whole signal, and add no column.

"""

from __future__ import annotations

from collections.abc import Sequence

from gyro_calibration.logs.log import Array, Number
from gyro_calibration.model.effects.effect import Channels, Effect, nothing_added, Parameter
from gyro_calibration.model.effects.lag import lagged_signal
import numpy as np
from scipy.interpolate import CubicSpline

#: Points to each interval of the samples, for a lag.
FINER = 4
_FAST_REVERSALS = 'reverse quickly: a delay leaves the size of the swing as it is, a lag does not'


def _at(when: Array, time: Array, signal: Array) -> Array:
    """Return a signal at other times; beyond its ends it stays."""
    # Straight lines between samples would look like a delay in quick motion.
    return np.asarray(CubicSpline(time, signal)(np.clip(when, time[0], time[-1])))


def _earlier(time: Number, offset: float) -> Number:
    return time - offset


def _delayed(signal: Array, time: Array, offset: float) -> Array:
    return _at(_earlier(time, offset), time, signal)


TIME_OFFSET = Effect(
    'time_offset', 'The stamps of the samples are late by a constant time.',
    frozenset(), (), nothing_added, (Parameter('time_offset', 's', bounds=(-1.0, 1.0)),),
    _FAST_REVERSALS, distortion=_delayed, stage='rate', moved=_earlier,
    undone='It is undone by moving the stamps; what is late for a controller stays late.')


def _stretched(time: Number, clock_rate: float) -> Number:
    return (1.0 + clock_rate) * time


def _hastened(signal: Array, time: Array, clock_rate: float) -> Array:
    return _at(_stretched(time, clock_rate), time, signal)


CLOCK_RATE = Effect(
    'clock_rate', 'The clock of the gyro runs at another pace than that of the reference.',
    frozenset(), (), nothing_added, (Parameter('clock_rate', '1', bounds=(-0.1, 0.1)),),
    'record a long log with quick motion at both ends',
    distortion=_hastened, stage='rate', moved=_stretched,
    undone='It is undone by stretching the stamps of a log; a robot stamps by its own clock, '
           'where nothing is to be undone.')


def _lagged(signal: Array, time: Array, time_constant: float) -> Array:
    """Return the signal through a lag that takes it for straight between `FINER` points."""
    count = len(time)
    finer = np.interp(np.arange(FINER * (count - 1) + 1) / FINER, np.arange(count), time)
    return lagged_signal(_at(finer, time, signal), finer, time_constant)[::FINER]


BANDWIDTH = Effect(
    'bandwidth', 'The output follows the rate through a first-order lag.',
    frozenset(), (), nothing_added, (Parameter('bandwidth', 's', bounds=(1e-7, 10.0)),),
    _FAST_REVERSALS, distortion=_lagged, stage='rate',
    undone='Quick motion stays damped: sharpening it would raise the noise.')


def _dead_zone(channels: Channels, dead_zone: float) -> Sequence[Number]:
    return ((abs(channels.rate) < dead_zone) * -channels.rate,)


DEAD_ZONE = Effect(
    'dead_zone', 'The output stays zero while the rate is small.',
    frozenset({'rate'}), (Parameter('amplitude', '1', default=1.0),), _dead_zone,
    (Parameter('dead_zone', 'rad/s', bounds=(1e-7, 1.0)),), 'sweep slowly through zero',
    undone='Where the output is zero, nothing is known of the rate within the zone.')


def _clipped(signal: Array, _time: Array, limit: float) -> Array:
    return np.clip(signal, -limit, limit)


SATURATION = Effect(
    'saturation', 'The output cannot go beyond a limit.',
    frozenset(), (), nothing_added, (Parameter('saturation', 'rad/s', bounds=(1e-3, 1e3)),),
    'turn faster than the limit', distortion=_clipped, stage='output',
    undone='At the limit, nothing is known of the rate but that it is beyond.')


def _rounded(signal: Array, _time: Array, step: float) -> Array:
    return np.round(signal / step) * step


QUANTIZATION = Effect(
    'quantization', 'The output comes in steps.',
    frozenset(), (), nothing_added, (Parameter('quantization', 'rad/s', bounds=(1e-12, 1.0)),),
    'look at the set of codes', distortion=_rounded, stage='output',
    undone='What was rounded away is lost; noise above half a step keeps its mean.')
