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
Channels that need a history: time since power-on, lagged channels, the sign of heating.

A stream of samples and a log in blocks have the same results. A lag starts at the value of its
channel where it is first requested.
"""

from __future__ import annotations

from collections.abc import Mapping
import math
from typing import Any

from gyro_calibration.logs.log import Log, Number
from gyro_calibration.model.effects import Channels, lag_difference
import numpy as np

#: By (channel, time constant) of a lag, and ('heating', filter time, threshold).
_LagStates = dict[tuple[Any, ...], float]


class ChannelHistory:
    """The state of all channels that depend on earlier samples."""

    def __init__(self, default_temperature: float = 25.0, min_temperature: float = -math.inf,
                 max_temperature: float = math.inf):
        """Begin without samples; a default temperature and the bounds of temperatures, degC."""
        self._default_temperature, self._min_temperature, self._max_temperature = (
            default_temperature, min_temperature, max_temperature)
        self._block: _Block | None = None
        self._start_time = 0.0

    def update(self, time: Number, temperature: Number | None = None,
               specific_force: Number | None = None, supply: Number | None = None,
               heading: Number = 0.0) -> Channels:
        """Take samples, numbers or (n,), in s, degC, m/s², V, rad; return their channels."""
        if self._block is None:
            self._start_time = float(_edge_value(time, 0))
        known = {'specific_force': specific_force}
        if temperature is not None:
            known['temperature'] = temperature = clip(
                temperature, self._min_temperature, self._max_temperature)
        here = self._default_temperature + 0.0 * time if temperature is None else temperature
        piece = self._block = _Block(time, {name: signal for name, signal in known.items()
                                            if signal is not None}, self._block)

        def lagged(channel: str, time_constant: float) -> Number:
            signal = here if channel == 'temperature' else piece.signal(channel)
            return signal + piece.lag_difference(channel, time_constant)

        return Channels(0.0 * time, 0.0 * time, here, time - self._start_time,
                        0.0 * time if specific_force is None else specific_force, supply,
                        heading, lagged, piece.heating_sign)


class _Block:
    """One sample, or the samples of a block, with the state at the end of the one before."""

    def __init__(self, time: Number, signals: Mapping[str, Number], previous: _Block | None):
        self._signals = dict(signals)
        self._end_time = _edge_value(time, -1)
        self._last_values: dict[str, float] = {}
        self._lag_states: _LagStates = {}
        begin = _edge_value(time, 0)
        if previous is not None:
            self._lag_states, begin = previous.end_states(), previous._end_time
            self._last_values = previous._last_values | {
                name: _edge_value(signal, -1) for name, signal in previous._signals.items()}
        self._end_states: _LagStates = {}
        self._interval = _differences(time, begin)

    def signal(self, channel: str) -> Number:
        if channel == 'vibration' and channel not in self._signals:
            # a second high-pass filter of 1 s, since after one a tilt within seconds still counts
            self._signals['fast_force'] = self.lag_difference('specific_force', 1.0)
            ahead = self.lag_difference('fast_force', 1.0)
            self._signals[channel] = ahead * ahead
        return self._signals.get(channel, 0.0)

    def lag_difference(self, channel: str, time_constant: float) -> Number:
        """Return the lagged channel minus the channel; the channel is held while it is unknown."""
        signal, key = self.signal(channel), (channel, time_constant)
        change = (_differences(signal, self._last_values.get(channel, _edge_value(signal, 0)))
                  if channel in self._signals else 0.0 * self._interval)
        ahead = lag_difference(self._interval, change, time_constant,
                               self._lag_states.get(key, 0.0))
        self._end_states[key] = _edge_value(ahead, -1)
        return ahead

    def heating_sign(self, filter_time: float, threshold: float) -> Number:
        """Return the last sign of the temperature rate while it exceeded a threshold, K/s."""
        fast, slow = (self.lag_difference('temperature', lag)
                      for lag in (0.5 * filter_time, filter_time))
        rate, key = (fast - slow) / (0.5 * filter_time), ('heating', filter_time, threshold)
        sign, previous = np.sign(rate) * (abs(rate) > threshold), self._lag_states.get(key, 0.0)
        if isinstance(sign, np.ndarray):
            last = np.maximum.accumulate(np.where(sign != 0.0, np.arange(len(sign)), -1))
            branch: Number = np.where(last < 0, previous, sign[last])
        else:
            branch = float(sign) or previous
        self._end_states[key] = _edge_value(branch, -1)
        return branch

    def end_states(self) -> _LagStates:
        """Return the state at the end, including lags that were not requested in this block."""
        for key in self._lag_states.keys() - self._end_states.keys():
            (self.heating_sign if key[0] == 'heating' else self.lag_difference)(*key[-2:])
        return self._end_states


def channels_from_log(log: Log) -> Channels:
    """Return the channels of a whole log, with rate and output 0, and time 0 without stamps."""
    time = np.zeros(len(log)) if log.time is None else log.time
    heading = np.zeros(len(log)) if log.reference_heading is None else log.reference_heading
    return ChannelHistory().update(time, log.temperature, log.specific_force, log.supply, heading)


def clip(value: Number, low: float, high: float) -> Number:
    # np.clip turns a number into a numpy scalar, which makes later computations 3 times slower
    return (np.clip(value, low, high) if isinstance(value, np.ndarray)
            else min(max(value, low), high))


def _edge_value(signal: Number, index: int) -> float:
    return float(signal[index]) if isinstance(signal, np.ndarray) else signal


def _differences(signal: Number, previous: float) -> Number:
    return (np.diff(signal, prepend=previous) if isinstance(signal, np.ndarray) else signal
            - previous)
