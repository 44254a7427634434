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
What a single log cannot tell from the wander of the bias: a ramp, a warm-up, the temperature.

Each is fitted alone with scale factor error and bias, to the increments of the heading over
spans, with the noise of `noise_grid`. In one log a wandering bias looks like any of them; over
many logs what repeats is an effect, and what does not is wander.

"""

from __future__ import annotations

from collections.abc import Collection
import math
from typing import Any

from gyro_calibration.calibration.noise_grid import BandedNoise, heading_noise, noise_grid, wander
from gyro_calibration.diagnosis.expected_output import bridged
from gyro_calibration.heading.integration import integrate
from gyro_calibration.logs.log import Array, DataRefused, Log
import numpy as np

#: Spans a log, and the shortest, s.
_SPANS, _SHORTEST = 60, 2.0
#: A log that lasts for less, s, shows nothing slow.
_LEAST = 60.0


def slow_effects(log: Log, time_offset: float = 0.0, names: Collection[str] | None = None
                 ) -> dict[str, dict[str, Any]]:
    """
    Return the slow effects of a log in time, by name: value, standard deviation and unit.

    Parameters
    ----------
    log : with a reference, or at rest
    time_offset : by which the gyro lags its reference, s
    names : of the effects; None for all

    """
    assert log.time is not None and log.output is not None
    known = np.isfinite(log.output)
    time = log.time[known] - time_offset
    if time[-1] - time[0] < _LEAST:
        return {}
    turned, heading = integrate(time, log.output[known]), _reference(log)
    step = max((time[-1] - time[0]) / _SPANS, _SHORTEST)
    ends = np.arange(time[0], time[-1] + 1e-9, step)
    if heading is None:
        at, columns, rate = ends, [], np.zeros(len(ends))
    else:
        at = heading[0][np.unique(np.searchsorted(heading[0], ends).clip(0, len(heading[0]) - 1))]
        true = np.interp(at, *heading)
        columns, rate = [np.diff(true)], np.gradient(true, at)
    if len(at) < 10:
        return {}
    seen = np.diff(np.interp(at, time, turned))
    noise = _noise(at, rate, rest=heading is None)
    found: dict[str, dict[str, Any]] = {}
    for name, (unit, column) in _effects(log, at).items():
        if names is not None and name not in names:
            continue
        fit = noise_grid(seen, np.column_stack([*columns, np.diff(at), column]), noise,
                         *wander(at), noisy_column=0 if columns else None,
                         wandering=len(columns))
        found[name] = {'value': float(fit.values[-1]), 'deviation': float(fit.deviations[-1]),
                       'unit': unit}
    return {name: each for name, each in found.items()
            if math.isfinite(each['deviation']) and each['deviation'] > 0.0}


def rest_bias(log: Log) -> tuple[float, float]:
    """
    Return the bias of a log at rest, rad/s, and its standard deviation with the wander.

    Raises
    ------
    DataRefused : it lasts too short a time

    """
    assert log.time is not None and log.output is not None
    known = np.isfinite(log.output)
    time = log.time[known]
    if known.sum() < 100 or time[-1] - time[0] < _LEAST:
        raise DataRefused(f'rests for less than {_LEAST:.0f} s: record for longer')
    at = np.linspace(time[0], time[-1], _SPANS + 1)
    seen = np.diff(np.interp(at, time, integrate(time, log.output[known])))
    fit = noise_grid(seen, np.diff(at)[:, None], _noise(at, np.zeros(len(at)), rest=True),
                     *wander(at), wandering=0)
    return float(fit.values[0]), float(fit.deviations[0])


def _reference(log: Log) -> tuple[Array, Array] | None:
    """Return times and headings of the reference; None at rest."""
    assert log.time is not None
    if log.reference_heading is not None:
        known = np.isfinite(log.reference_heading)
        if known.sum() > 1:
            return log.time[known], log.reference_heading[known]
    if log.reference_rate is not None and np.isfinite(log.reference_rate).any():
        return log.time, integrate(log.time, bridged(log.reference_rate))
    return None


def _noise(time: Array, rate: Array, rest: bool) -> list[BandedNoise]:
    parts = heading_noise(time, rate)
    return parts[:1] if rest else parts


def _effects(log: Log, at: Array) -> dict[str, tuple[str, Array]]:
    """Return what each effect of size one adds to the increments, with its unit."""
    assert log.time is not None
    since = at - log.time[0]
    middle = 0.5 * since[-1]
    found = {'rate_ramp': ('rad/s²', np.diff(0.5 * (since - middle) ** 2))}
    for constant in (60.0, 300.0):  # s; the same for all logs, as they are pooled
        found[f'warm_up_{constant:.0f}s'] = (
            'rad/s', np.diff(-constant * np.exp(-since / constant)))
    if log.temperature is not None and np.isfinite(log.temperature).all():
        warmer = log.temperature - log.temperature.mean()
        if np.ptp(warmer) > 0.0:
            found['bias_temperature'] = (
                'rad/s/K', np.diff(np.interp(at, log.time, integrate(log.time, warmer))))
    return found
