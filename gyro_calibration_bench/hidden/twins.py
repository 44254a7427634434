# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Look-alikes: conditions under which two causes are confounded, or distinguishable."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from gyro_calibration_bench.hidden.effects import Shapes
from gyro_calibration_bench.hidden.log import Given, HiddenLog, hide, record
from gyro_calibration_bench.hidden.motion import Session, session
from gyro_calibration_bench.hidden.noise import NoiseFigures
import numpy as np


@dataclass(frozen=True)
class Twins:
    """
    Two causes that have the same column under some conditions.

    Attributes
    ----------
    alike : arguments of `session` under which they are confounded
    apart : arguments of `session` under which they are distinguishable; None if no recording with
        this reference is
    given : recordings -> shapes and signs of effects, if only these are confounded
    multiple : of the minimum detectable effect
    figures : noise of the gyro; None for any
    longer : ratio of the durations of the separating and the first recording
    against_a_model : they show only if a model has bias and scale factor error

    """

    alike: Mapping[str, Any]
    apart: Mapping[str, Any] | None
    given: Given | None = None
    multiple: float = 4.0
    figures: NoiseFigures | None = None
    longer: float = 1.0
    against_a_model: bool = False


def _as_the_cold_start(sessions: list[Session]) -> Mapping[str, Shapes]:
    return {'warm_up': {'time_constant': 0.2 * float(sessions[0].time[-1])}}


def _very_slowly(sessions: list[Session]) -> Mapping[str, Shapes]:
    return {'warm_up': {'time_constant': 2.0 * float(sessions[0].time[-1])}}


def _at_the_turn(sessions: list[Session]) -> Mapping[str, Shapes]:
    return {'bias_step': {
        'run': 0, 'step_time': float(sessions[0].time[np.argmax(sessions[0].temperature)])}}


def _quickly(sessions: list[Session]) -> Mapping[str, Shapes]:
    return {'thermal_lag': {'time_constant': 0.01 * float(sessions[0].time[-1])}}


def _as_a_sine(sessions: list[Session]) -> Mapping[str, Shapes]:
    return {'cubic_nonlinearity': {'sign': -1.0}}


def _late(sessions: list[Session]) -> Mapping[str, Shapes]:
    return {'time_offset': {'sign': 1.0}}


TWINS: Mapping[tuple[str, str], Twins] = {
    ('bias_temperature', 'rate_ramp'): Twins({'temperature': 'ramp'}, {}),
    ('bias_temperature', 'warm_up'): Twins({'temperature': 'cold_start'}, {}, _as_the_cold_start),
    ('warm_up', 'rate_ramp'): Twins({}, {}, _very_slowly, longer=4.0),
    ('heading_sensitivity', 'reference_once_per_rev'): Twins({'motion': 'one_speed'}, {}),
    ('scale_factor_asymmetry', 'quadratic_nonlinearity'): Twins({'motion': 'two_way'}, {},
                                                                multiple=8.0, longer=2.0),
    ('scale_factor_asymmetry',
     'vibration_rectification'): Twins({'motion': 'two_way', 'force': 'turning'}, {}),
    ('quadratic_nonlinearity', 'acceleration_sensitivity'): Twins({'force': 'off_axis'}, {}),
    ('cubic_nonlinearity', 'sine_response'): Twins({'motion': 'slow'}, {'top_rate': 3.0},
                                                   _as_a_sine, figures=NoiseFigures(2e-5)),
    ('time_offset', 'bandwidth'): Twins({'motion': 'smooth', 'top_rate': 2.0}, {'top_rate': 3.0},
                                        _late, multiple=20.0, figures=NoiseFigures(5e-4)),
    ('bias_temperature_rate', 'thermal_lag'): Twins({'temperature': 'smooth'},
                                                    {'temperature': 'triangles'}, _quickly),
    ('bias_temperature_rate', 'thermal_hysteresis'): Twins({'temperature': 'triangles'}, {}),
    ('bias_step', 'thermal_hysteresis'): Twins({'temperature': 'triangle'}, {}, _at_the_turn),
    ('bias_step', 'bias_temperature_rate'): Twins({'temperature': 'triangle'}, {}, _at_the_turn),
    ('bias_temperature', 'supply_sensitivity'): Twins({'supply': 'heating'}, {}),
    ('bias', 'acceleration_sensitivity'): Twins({'force': 'one_pose'}, {}, multiple=8.0,
                                                against_a_model=True),
    ('scale_factor_error', 'reference_scale'): Twins({}, None, against_a_model=True),
}


def twin(pair: tuple[str, str], hidden: str, generator: np.random.Generator, *,
         multiple: float | None = None, noise: str = 'white',
         duration: float = 900.0, sample_rate: float = 50.0) -> HiddenLog:
    """
    Hide one of a pair where it cannot be distinguished from the other.

    Parameters
    ----------
    pair : a key of `TWINS`
    hidden : one of the pair
    generator : source of all that is random
    multiple : of the minimum detectable effect; that of the pair where it is None
    noise : as for `hide`, where the pair says nothing of it
    duration, sample_rate : s and Hz

    """
    twins = TWINS[pair]
    return hide([hidden], multiple or twins.multiple, generator, noise=noise, duration=duration,
                sample_rate=sample_rate, figures=twins.figures, conditions=twins.alike,
                given=twins.given, against_a_model=twins.against_a_model)[0]


def part(pair: tuple[str, str], log: HiddenLog, generator: np.random.Generator) -> HiddenLog:
    """
    Record the gyro again, under conditions that distinguish the pair; single events do not recur.

    Raises
    ------
    ValueError : no recording with this reference distinguishes them

    """
    twins, first = TWINS[pair], log.session
    if twins.apart is None:
        raise ValueError(f'{pair[0]} and {pair[1]} are distinguished by another reference alone')
    duration = twins.longer * len(first.time) * first.interval
    return record(log.truth.gyro,
                  session(generator, duration, 1.0 / first.interval, **twins.apart), generator,
                  run=1)
