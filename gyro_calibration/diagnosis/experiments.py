# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""What to record next to distinguish causes that the data at hand cannot: a table of pairs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
import math

from gyro_calibration.diagnosis.causes import CAUSES
from gyro_calibration.diagnosis.replay import Replay
from gyro_calibration.logs.log import DEGREE
import numpy as np

_REVERSALS = 'swing with quick reversals for 2 min or more at up to {top:.3g} deg/s'
_SPEEDS = 'turn both ways at eight speeds, slow ones too, up to {top:.3g} deg/s'
_FASTER = ('turn both ways at up to {faster:.3g} deg/s, or as far beyond {top:.3g} deg/s as the '
           'gyro allows')
_CORNERS = ('heat and cool it twice between {low:.0f} and {high:.0f} °C at rest, at two speeds, '
            'with corners and pauses of 2 min')
_CYCLE = ('heat and cool it twice between {low:.0f} and {high:.0f} °C within one log, at rest, '
          'from a power-on at {high:.0f} °C')
_REST = 'let it rest for {long:.0f} min at one temperature, from power-on'
_POSES = ('rest for half a minute each with the axis up, level, down and level, turned over '
          'slowly within one power-on')
_AGAIN = 'record the same again, from another power-on: what happens once does not repeat'
_MOTOR = 'rest with the motor on and off, half a minute each, for 5 min'
_SUPPLY = 'step the supply by 5 % each minute at one temperature and at rest'
_HEADINGS = 'turn whole turns at three speeds, and stop at eight headings, 45 deg apart'
_BOTH_ENDS = 'record {long:.0f} min with quick reversals at up to {top:.3g} deg/s at both ends'

#: Two causes that may look alike -> the experiment in which they differ.
_OF_PAIRS: Mapping[frozenset[str], str] = {frozenset(pair.split()): words for pair, words in (
    ('bias_temperature rate_ramp', _CYCLE),
    ('bias_temperature warm_up', _CYCLE),
    ('warm_up rate_ramp', _REST),
    ('heading_sensitivity reference_once_per_rev', _HEADINGS),
    ('scale_factor_asymmetry quadratic_nonlinearity', _SPEEDS),
    ('scale_factor_asymmetry vibration_rectification', _MOTOR),
    ('quadratic_nonlinearity vibration_rectification', _MOTOR),
    ('quadratic_nonlinearity acceleration_sensitivity', _POSES),
    ('scale_factor_asymmetry acceleration_sensitivity', _POSES),
    ('heading_sensitivity acceleration_sensitivity', _POSES),
    ('cubic_nonlinearity sine_response', _FASTER),
    ('cubic_nonlinearity saturation', _FASTER),
    ('sine_response saturation', _FASTER),
    ('bias acceleration_sensitivity', _POSES),
    ('time_offset bandwidth', _REVERSALS),
    ('time_offset clock_rate', _BOTH_ENDS),
    ('clock_rate scale_factor_error', _BOTH_ENDS),
    ('bias_temperature_rate thermal_lag', _CORNERS),
    ('bias_temperature_rate thermal_hysteresis', _CORNERS),
    ('thermal_lag thermal_hysteresis', _CORNERS),
    ('bias_temperature thermal_lag', _CORNERS),
    ('bias_step thermal_hysteresis', _AGAIN),
    ('bias_step bias_temperature_rate', _AGAIN),
    ('bias_step warm_up', _AGAIN),
    ('bias_temperature supply_sensitivity', _SUPPLY),
)}


def experiment(name: str, others: Sequence[tuple[str, float]], replays: Sequence[Replay]) -> str:
    """
    Return what to record next to distinguish a cause from others, in words.

    Parameters
    ----------
    name : of the cause
    others : names of those that may be in its place, with what each lacks in logarithm of the
        likelihood, half the square of the sigmas by which the logs distinguish them already
    replays : the logs, whose rates and temperatures give the numbers

    """
    numbers = dict(_numbers(replays))
    found: dict[str, list[str]] = {}
    for other, lack in others:
        words = _OF_PAIRS.get(frozenset((name, other)), '')
        if not words or any(f'{{{key}:' in words for key in {'top', 'low'} - numbers.keys()):
            words = CAUSES[name].separate_by or CAUSES[other].separate_by
        found.setdefault(words.format(**numbers), []).append(
            f'{other.replace("_", " ")} by {math.sqrt(2.0 * max(lack, 0.0)):.1f}')
    return '; '.join(f'{words} (the data at hand distinguish {", ".join(names)} sigma)'
                     for words, names in found.items() if words)


def _numbers(replays: Sequence[Replay]) -> Iterator[tuple[str, float]]:
    """Give the numbers of the experiments that the logs have, in deg/s, degC and min."""
    yield 'long', 4.0 * math.ceil(max(each.duration for each in replays) / 60.0)
    top = max(float(np.quantile(np.abs(each.channels.rate), 0.999)) for each in replays) / DEGREE
    if top > 0.0:
        yield from (('top', top), ('faster', 3.0 * top))
    if all('temperature' in each.has for each in replays):
        degc = np.concatenate([each.channels.temperature for each in replays])
        # a range that shows something
        middle, half = 0.5 * (degc.max() + degc.min()), max(0.5 * float(np.ptp(degc)), 10.0)
        yield from (('low', middle - half), ('high', middle + half))
