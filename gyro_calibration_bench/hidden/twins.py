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
from gyro_calibration_bench.hidden.log import FixedParts, HiddenLog, hide, record
from gyro_calibration_bench.hidden.motion import Session, session
from gyro_calibration_bench.hidden.noise import NoiseFigures
import numpy as np


@dataclass(frozen=True)
class LookAlikes:
    """
    Two causes that have the same column under some conditions.

    Attributes
    ----------
    confounding_conditions : arguments of `session` under which they are confounded
    separating_conditions : arguments of `session` under which they are distinguishable; None if no
        recording with this reference is
    fixed_parts : recordings -> shapes and signs of effects, if only these are confounded
    multiple : of the minimum detectable effect
    figures : noise of the gyro; None for any
    duration_factor : ratio of the durations of the separating and the first recording
    needs_model : they show only if a model has bias and scale factor error

    """

    confounding_conditions: Mapping[str, Any]
    separating_conditions: Mapping[str, Any] | None
    fixed_parts: FixedParts | None = None
    multiple: float = 4.0
    figures: NoiseFigures | None = None
    duration_factor: float = 1.0
    needs_model: bool = False


def _cold_start_shapes(sessions: list[Session]) -> Mapping[str, Shapes]:
    return {'warm_up': {'time_constant': 0.2 * float(sessions[0].time[-1])}}


def _slow_warm_up_shapes(sessions: list[Session]) -> Mapping[str, Shapes]:
    return {'warm_up': {'time_constant': 2.0 * float(sessions[0].time[-1])}}


def _turning_point_shapes(sessions: list[Session]) -> Mapping[str, Shapes]:
    return {'bias_step': {
        'run': 0, 'step_time': float(sessions[0].time[np.argmax(sessions[0].temperature)])}}


def _fast_lag_shapes(sessions: list[Session]) -> Mapping[str, Shapes]:
    return {'thermal_lag': {'time_constant': 0.01 * float(sessions[0].time[-1])}}


def _negative_cubic_sign(sessions: list[Session]) -> Mapping[str, Shapes]:
    return {'cubic_nonlinearity': {'sign': -1.0}}


def _positive_offset_sign(sessions: list[Session]) -> Mapping[str, Shapes]:
    return {'time_offset': {'sign': 1.0}}


LOOK_ALIKES: Mapping[tuple[str, str], LookAlikes] = {
    ('bias_temperature', 'rate_ramp'): LookAlikes({'temperature': 'ramp'}, {}),
    ('bias_temperature', 'warm_up'): LookAlikes({'temperature': 'cold_start'}, {},
                                                _cold_start_shapes),
    ('warm_up', 'rate_ramp'): LookAlikes({}, {}, _slow_warm_up_shapes, duration_factor=4.0),
    ('heading_sensitivity', 'reference_once_per_rev'): LookAlikes({'motion': 'one_speed'}, {}),
    ('scale_factor_asymmetry', 'quadratic_nonlinearity'): LookAlikes(
        {'motion': 'two_way'}, {}, multiple=8.0, duration_factor=2.0),
    ('scale_factor_asymmetry', 'vibration_rectification'): LookAlikes(
        {
            'motion': 'two_way',
            'force': 'turning'
        }, {}),
    ('quadratic_nonlinearity', 'acceleration_sensitivity'): LookAlikes({'force': 'off_axis'}, {}),
    ('cubic_nonlinearity', 'sine_response'): LookAlikes(
        {'motion': 'slow'}, {'top_rate': 3.0}, _negative_cubic_sign, figures=NoiseFigures(2e-5)),
    ('time_offset', 'bandwidth'): LookAlikes({
        'motion': 'smooth',
        'top_rate': 2.0
    }, {'top_rate': 3.0}, _positive_offset_sign, multiple=20.0, figures=NoiseFigures(5e-4)),
    ('bias_temperature_rate', 'thermal_lag'): LookAlikes(
        {'temperature': 'smooth'}, {'temperature': 'triangles'}, _fast_lag_shapes),
    ('bias_temperature_rate', 'thermal_hysteresis'): LookAlikes({'temperature': 'triangles'}, {}),
    ('bias_step', 'thermal_hysteresis'): LookAlikes({'temperature': 'triangle'}, {},
                                                    _turning_point_shapes),
    ('bias_step', 'bias_temperature_rate'): LookAlikes({'temperature': 'triangle'}, {},
                                                       _turning_point_shapes),
    ('bias_temperature', 'supply_sensitivity'): LookAlikes({'supply': 'heating'}, {}),
    ('bias', 'acceleration_sensitivity'): LookAlikes({'force': 'one_pose'}, {}, multiple=8.0,
                                                     needs_model=True),
    ('scale_factor_error', 'reference_scale'): LookAlikes({}, None, needs_model=True),
}


def hide_look_alike(pair: tuple[str, str], hidden: str, generator: np.random.Generator, *,
                    multiple: float | None = None, noise: str = 'white',
                    duration: float = 900.0, sample_rate: float = 50.0) -> HiddenLog:
    """
    Hide one of a pair where it cannot be distinguished from the other.

    Parameters
    ----------
    pair : a key of `LOOK_ALIKES`
    hidden : one of the pair
    generator : source of all that is random
    multiple : of the minimum detectable effect; that of the pair where it is None
    noise : as for `hide`, where the pair says nothing of it
    duration, sample_rate : s and Hz

    """
    twins = LOOK_ALIKES[pair]
    return hide([hidden], multiple or twins.multiple, generator, noise=noise, duration=duration,
                sample_rate=sample_rate, figures=twins.figures,
                conditions=twins.confounding_conditions, fixed_parts=twins.fixed_parts,
                against_a_model=twins.needs_model)[0]


def record_separating(pair: tuple[str, str], log: HiddenLog,
                      generator: np.random.Generator) -> HiddenLog:
    """
    Record the gyro again, under conditions that distinguish the pair; single events do not recur.

    Raises
    ------
    ValueError : no recording with this reference distinguishes them

    """
    twins, first = LOOK_ALIKES[pair], log.session
    if twins.separating_conditions is None:
        raise ValueError(f'{pair[0]} and {pair[1]} are distinguished by another reference alone')
    duration = twins.duration_factor * len(first.time) * first.interval
    return record(
        log.truth.gyro,
        session(generator, duration, 1.0 / first.interval, **twins.separating_conditions),
        generator, run=1)
