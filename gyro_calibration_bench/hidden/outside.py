# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Effects outside the catalogue: a diagnosis must report a remainder, without a name."""

from __future__ import annotations

from collections.abc import Mapping
import math

from gyro_calibration_bench.hidden.effects import (
    _draw_phase,
    _linear_error,
    EffectForm,
    Shapes,
    top_rate,
)
from gyro_calibration_bench.hidden.motion import Session
import numpy as np


def _median(values: list[np.ndarray]) -> float:
    return float(np.median(np.concatenate(values)))


def _draw_temperature_wave(sessions: list[Session], generator: np.random.Generator) -> Shapes:
    spread = max(float(np.ptp(session.temperature)) for session in sessions)
    return {'period': spread / generator.uniform(3.0, 6.0), **_draw_phase(sessions, generator)}


def _draw_pulse(sessions: list[Session], generator: np.random.Generator) -> Shapes:
    run = int(generator.integers(len(sessions)))
    duration = float(sessions[run].time[-1])
    return {'run': run, 'pulse_time': generator.uniform(0.15, 0.85) * duration,
            'width': duration * generator.uniform(0.01, 0.03)}


def _draw_telegraph(sessions: list[Session], generator: np.random.Generator) -> Shapes:
    """Draw the moments at which a bias jumps to its other value and back."""
    times = np.sort(generator.uniform(0.05, 0.95,
                                      generator.integers(12, 25)) * sessions[0].time[-1])
    return {f'jump_time_{number}': float(at) for number, at in enumerate(times)}


def _telegraph_level(session: Session, w: np.ndarray, shapes: Shapes) -> np.ndarray:
    return np.searchsorted(np.array(list(shapes.values())), session.time) % 2.0


def _heading_harmonic(number: int) -> EffectForm:
    return EffectForm(
        _linear_error(
            lambda session, w, shapes: np.sin(number * session.heading + shapes['phase'])),
        'rad/s', _draw_phase)


def _temperature_times_heading(session: Session, w: np.ndarray, shapes: Shapes) -> np.ndarray:
    return (session.temperature - shapes['middle']) * np.sin(session.heading + shapes['phase'])


def _resonance(session: Session, w: np.ndarray, shapes: Shapes) -> np.ndarray:
    """Return a bump over the speed, as of something that resonates at one."""
    return np.exp(-0.5 * ((np.abs(w) - shapes['speed']) / shapes['width']) ** 2)


def _supply_parabola(session: Session, w: np.ndarray, shapes: Shapes) -> np.ndarray:
    return (session.supply - shapes['middle']) ** 2


OUTSIDE_CATALOGUE: Mapping[str, EffectForm] = {
    'second_harmonic_of_heading': _heading_harmonic(2),
    'third_harmonic_of_heading': _heading_harmonic(3),
    'gear_of_heading': _heading_harmonic(7),
    'wave_over_rate': EffectForm(
        _linear_error(lambda session, w, shapes: np.sin(2.0 * math.pi * w / shapes[
            'period'] + shapes['phase'])), 'rad/s', lambda sessions, generator: {
                'period': top_rate(sessions) / generator.uniform(3.0, 6.0),
                **_draw_phase(sessions, generator)
            }),
    'resonance_at_a_speed': EffectForm(
        _linear_error(_resonance), 'rad/s', lambda sessions, generator: {
            'speed': top_rate(sessions) * generator.uniform(0.2, 0.8),
            'width': top_rate(sessions) * generator.uniform(0.03, 0.1)
        }),
    'wave_over_temperature': EffectForm(
        _linear_error(lambda session, w, shapes: np.sin(
            2.0 * math.pi * session.temperature / shapes['period'] + shapes['phase'])), 'rad/s',
        _draw_temperature_wave),
    'temperature_times_heading': EffectForm(
        _linear_error(_temperature_times_heading), 'rad/s/K', lambda sessions, generator: {
            'middle': _median([session.temperature for session in sessions]),
            **_draw_phase(sessions, generator)
        }),
    'bias_pulse': EffectForm(
        _linear_error(lambda session, w, shapes: np.exp(-0.5 * (
            (session.time - shapes['pulse_time']) / shapes['width']) ** 2)), 'rad/s', _draw_pulse,
        is_single_event=True),
    'telegraph': EffectForm(_linear_error(_telegraph_level), 'rad/s', _draw_telegraph),
    'supply_parabola': EffectForm(
        _linear_error(_supply_parabola), 'rad/s/V²', lambda sessions, generator:
        {'middle': float(np.quantile(sessions[0].supply, generator.uniform(0.35, 0.65)))}),
    'supply_times_rate': EffectForm(
        _linear_error(lambda session, w, shapes: (session.supply - shapes['middle']) * w), '1/V',
        lambda sessions, generator: {'middle': _median([session.supply for session in sessions])}),
    'force_times_rate': EffectForm(
        _linear_error(lambda session, w, shapes: (session.tilt_force - shapes['middle']) * w),
        '1/(m/s²)', lambda sessions, generator:
        {'middle': _median([session.tilt_force for session in sessions])}),
}
