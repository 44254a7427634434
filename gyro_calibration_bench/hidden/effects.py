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
Physics of the hidden effects, as in the catalogue of effects.

Symbols: w rate, psi heading, t time since power-on, T temperature, y output. Each effect is a
`EffectForm`: how its shapes are drawn, and what it adds for a size of its leading parameter. Forms
state where in the chain they act: on the signal before all else ('signal'), added to it ('sum'),
on the finished output ('output'), on the reference ('reference'), on single samples ('samples'),
on the unit ('unit'), on the noise ('noise').
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
import math

from gyro_calibration_bench.hidden.motion import lag, Session
import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.stats import norm

REFERENCE_TEMPERATURE = 25.0
REFERENCE_SUPPLY = 5.0
Shapes = dict[str, float]

#: Effects that are findings only if a model differs from them.
MODEL_FINDINGS = ('bias', 'scale_factor_error', 'reference_scale', 'angle_random_walk',
                  'bias_instability', 'rate_random_walk')
#: Counted effects, and the number that is just detectable: more than occur by chance.
COUNTED_FAULTS = {'outliers': 3.0, 'stuck_samples': 3.0, 'dropped_samples': 3.0}
#: Quantization, whose added variance is just detectable by a test of the variance.
STEP_EFFECTS = ('quantization', 'reference_quantization')
#: Effects without a column.
WITHOUT_COLUMN = {*MODEL_FINDINGS, *COUNTED_FAULTS, *STEP_EFFECTS, 'unit_error'}


@dataclass(frozen=True)
class EffectForm:
    """How an effect is drawn and what it adds."""

    # (session, resulting rate w, shapes) -> its addition to output less reference, rad/s, for a
    # size of 1; of an effect that is not linear (session, w, size, shapes) -> the same
    formula: Callable[..., np.ndarray]
    unit: str  # of the leading parameter, which is named like the effect
    # (sessions, generator) -> the other parameters
    shapes: Callable[[list[Session], np.random.Generator], Shapes] = lambda sessions, generator: {}
    stage: str = 'sum'  # where it acts
    is_linear: bool = True  # the error is in proportion to the size
    is_signed: bool = True  # the size may be negative
    # (sessions) -> the largest reasonable size
    max_size: Callable[[list[Session]], float] = lambda sessions: math.inf
    # it is in one of several recordings only; `shapes` has its number as 'run'
    is_single_event: bool = False

    def error(self, session: Session, w: np.ndarray, size: float, shapes: Shapes) -> np.ndarray:
        """Return the addition to output less reference, rad/s."""
        return (size * self.formula(session, w, shapes) if self.is_linear
                else self.formula(session, w, size, shapes))


def top_rate(sessions: list[Session]) -> float:
    """Return the largest speed, rad/s."""
    return max(float(np.abs(session.rate).max()) for session in sessions)


def _log_uniform(generator: np.random.Generator, low: float, high: float) -> float:
    return math.exp(generator.uniform(math.log(low), math.log(high)))


def _draw_phase(sessions: list[Session], generator: np.random.Generator) -> Shapes:
    return {'phase': generator.uniform(-math.pi, math.pi)}


def _time_constant_drawer(high: float) -> Callable[[list[Session], np.random.Generator], Shapes]:
    def draw(sessions: list[Session], generator: np.random.Generator) -> Shapes:
        duration = sessions[0].time[-1]
        return {'time_constant': _log_uniform(generator, 0.03 * duration, high * duration)}
    return draw


def _draw_tone(sessions: list[Session], generator: np.random.Generator) -> Shapes:
    return {'frequency': _log_uniform(generator, 0.2, 0.45 / sessions[0].interval),
            **_draw_phase(sessions, generator)}


def _draw_step_time(sessions: list[Session], generator: np.random.Generator) -> Shapes:
    run = int(generator.integers(len(sessions)))
    return {'run': run, 'step_time': float(generator.uniform(0.15, 0.85) * sessions[run].time[-1])}


def temperature_rate(session: Session) -> np.ndarray:
    """Return dT/dt, K/s."""
    return np.gradient(session.temperature, session.interval)


def thermal_branch(session: Session) -> np.ndarray:
    """Return +1 while heating, -1 while cooling; below 5e-4 K/s the last; 0 before."""
    speed = temperature_rate(session)
    known = np.where(np.abs(speed) > 5e-4, np.arange(len(speed)), -1)
    last = np.maximum.accumulate(known)
    return np.where(last < 0, 0.0, np.sign(speed[np.maximum(last, 0)]))


def vibration_power(session: Session) -> np.ndarray:
    """Return the mean square of the vibration over a second, (m/s²)²."""
    return uniform_filter1d(session.vibration ** 2, round(1.0 / session.interval))


def sensed_rate(session: Session, time_offset: float = 0.0, clock_rate: float = 0.0,
                bandwidth: float = 0.0) -> np.ndarray:
    """Return the rate that a gyro with delay, bandwidth and clock rate error senses."""
    if not bandwidth:
        return session.motion.rate((1.0 + clock_rate) * session.time - time_offset)
    finer = 8
    time = np.arange(len(session.time) * finer) * (session.interval / finer)
    rate = session.motion.rate((1.0 + clock_rate) * time - time_offset)
    return lag(rate, session.interval / finer, bandwidth)[::finer]


def _signal_error(name: str) -> Callable[[Session, np.ndarray, float, Shapes], np.ndarray]:
    return lambda session, w, size, shapes: sensed_rate(session, **{name: size}) - session.rate


def _draw_slips(sessions: list[Session], generator: np.random.Generator) -> Shapes:
    """Draw one to three moments of strong acceleration, at least a second apart."""
    run = int(generator.integers(len(sessions)))
    session = sessions[run]
    acceleration = np.abs(np.gradient(session.rate, session.interval))
    candidates = np.flatnonzero(acceleration > np.quantile(acceleration, 0.97))
    times = np.sort(session.time[generator.choice(candidates, generator.integers(1, 4))])
    kept = times[np.concatenate([[True], np.diff(times) > 1.0])]
    return {'run': run, 'width': generator.uniform(0.05, 0.2),
            **{f'slip_time_{number}': float(at) for number, at in enumerate(kept)}}


def _slip_rate(session: Session, shapes: Shapes) -> np.ndarray:
    """Return the rate of slips by 1 rad each, smooth in time, rad/s."""
    return np.sum([norm.pdf(session.time, at, shapes['width']) for at in _slip_times(shapes)],
                  axis=0)


def slip_angle(session: Session, shapes: Shapes) -> np.ndarray:
    """Return the integral of the rate of slips by 1 rad each, rad."""
    return np.sum([norm.cdf(session.time, at, shapes['width']) for at in _slip_times(shapes)],
                  axis=0)


def _slip_times(shapes: Shapes) -> list[float]:
    return [value for name, value in shapes.items() if name.startswith('slip_time')]


def _no_column(session: Session, w: np.ndarray, shapes: Shapes) -> np.ndarray:
    raise NotImplementedError('faults of samples have no column')


FORMS: Mapping[str, EffectForm] = {
    'bias': EffectForm(lambda session, w, shapes: np.ones_like(w), 'rad/s'),
    'scale_factor_error': EffectForm(lambda session, w, shapes: w, '1'),
    'scale_factor_asymmetry': EffectForm(lambda session, w, shapes: np.abs(w), '1'),
    'quadratic_nonlinearity': EffectForm(lambda session, w, shapes: w ** 2, 's/rad'),
    'cubic_nonlinearity': EffectForm(lambda session, w, shapes: w ** 3, 's²/rad²'),
    'sine_response': EffectForm(lambda session, w, k, shapes: np.sin(k * w) / k - w, 's',
                                is_linear=False, is_signed=False,
                                max_size=lambda sessions: 1.5 / top_rate(sessions)),
    'bias_temperature': EffectForm(
        lambda session, w, shapes: session.temperature - REFERENCE_TEMPERATURE, 'rad/s/K'),
    'bias_temperature_quadratic': EffectForm(
        lambda session, w, shapes: (session.temperature - REFERENCE_TEMPERATURE) ** 2,
        'rad/s/K²'),
    'scale_factor_temperature': EffectForm(
        lambda session, w, shapes: (session.temperature - REFERENCE_TEMPERATURE) * w, '1/K'),
    'bias_temperature_rate': EffectForm(
        lambda session, w, shapes: temperature_rate(session), 'rad/s/(K/s)'),
    'thermal_lag': EffectForm(
        lambda session, w, shapes: lag(session.temperature, session.interval, shapes[
            'time_constant']) - session.temperature, 'rad/s/K', _time_constant_drawer(0.3)),
    'thermal_hysteresis': EffectForm(
        lambda session, w, shapes: thermal_branch(session), 'rad/s'),
    'warm_up': EffectForm(
        lambda session, w, shapes: np.exp(-session.time / shapes['time_constant']), 'rad/s',
        _time_constant_drawer(0.35)),
    'rate_ramp': EffectForm(lambda session, w, shapes: session.time, 'rad/s²'),
    'bias_step': EffectForm(
        lambda session, w, shapes: (session.time >= shapes['step_time']).astype(float), 'rad/s',
        _draw_step_time, is_single_event=True),
    'heading_sensitivity': EffectForm(
        lambda session, w, shapes: np.sin(session.heading + shapes['phase']), 'rad/s',
        _draw_phase),
    'acceleration_sensitivity': EffectForm(
        lambda session, w, shapes: session.specific_force, '(rad/s)/(m/s²)'),
    'vibration_rectification': EffectForm(
        lambda session, w, shapes: vibration_power(session), '(rad/s)/(m/s²)²'),
    'supply_sensitivity': EffectForm(
        lambda session, w, shapes: session.supply - REFERENCE_SUPPLY, 'rad/s/V'),
    'interference_tone': EffectForm(
        lambda session, w, shapes: np.sin(2.0 * math.pi * shapes['frequency'] * session.time
                                          + shapes['phase']), 'rad/s', _draw_tone,
        is_signed=False),
    'bandwidth': EffectForm(_signal_error('bandwidth'), 's', stage='signal', is_linear=False,
                            is_signed=False, max_size=lambda sessions: 1.0),
    'time_offset': EffectForm(_signal_error('time_offset'), 's', stage='signal', is_linear=False,
                              max_size=lambda sessions: 0.5),
    'clock_rate': EffectForm(_signal_error('clock_rate'), '1', stage='signal', is_linear=False,
                             max_size=lambda sessions: 0.01),
    'dead_zone': EffectForm(
        lambda session, w, half_width, shapes: np.where(np.abs(w) < half_width, -w, 0.0), 'rad/s',
        is_linear=False, is_signed=False, max_size=lambda sessions: 0.3 * top_rate(sessions)),
    'saturation': EffectForm(lambda session, w, limit, shapes: np.clip(w, -limit, limit) - w,
                             'rad/s', stage='output', is_linear=False, is_signed=False,
                             max_size=top_rate),
    'quantization': EffectForm(_no_column, 'rad/s', stage='output', is_signed=False),
    'outliers': EffectForm(_no_column, '1', stage='samples', is_signed=False),
    'stuck_samples': EffectForm(_no_column, '1', stage='samples', is_signed=False),
    'dropped_samples': EffectForm(_no_column, '1', stage='samples', is_signed=False),
    'reference_once_per_rev': EffectForm(
        lambda session, w, shapes: -(session.rate * np.sin(session.heading + shapes['phase'])),
        '1', _draw_phase, stage='reference', is_signed=False),
    'reference_scale': EffectForm(lambda session, w, shapes: -session.rate, '1',
                                  stage='reference'),
    'reference_slip': EffectForm(lambda session, w, shapes: -_slip_rate(session, shapes), 'rad',
                                 _draw_slips, stage='reference', is_single_event=True),
    'reference_quantization': EffectForm(_no_column, 'rad', stage='reference', is_signed=False),
    'unit_error': EffectForm(_no_column, '1', stage='unit', is_signed=False),
    'angle_random_walk': EffectForm(_no_column, 'rad/√s', stage='noise'),
    'bias_instability': EffectForm(_no_column, 'rad/s', stage='noise', is_signed=False),
    'rate_random_walk': EffectForm(_no_column, 'rad/s/√s', stage='noise', is_signed=False),
}


def effect_errors(form: EffectForm, size: float, shapes: Shapes,
                  sessions: list[Session]) -> list[np.ndarray]:
    """Return the addition of an effect to output less reference of each recording, rad/s."""
    return [form.error(each, each.rate, size, shapes)
            if not form.is_single_event or shapes['run'] == run else np.zeros(len(each.time))
            for run, each in enumerate(sessions)]


#: What a wrong unit multiplies the output by; and delays, in samples.
UNIT_FACTORS = {'pi/180': math.pi / 180.0, '180/pi': 180.0 / math.pi, '-1': -1.0, '2': 2.0,
                '1024/1000': 1.024, '4096/1000': 4.096}
UNIT_DELAYS = {'one sample': 1.0, 'half a sample': 0.5}


# outside the catalogue: a diagnosis must report a remainder, without a name

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


def _heading_harmonic(number: int) -> EffectForm:
    return EffectForm(
        lambda session, w, shapes: np.sin(number * session.heading + shapes['phase']), 'rad/s',
        _draw_phase)


OUTSIDE_CATALOGUE: Mapping[str, EffectForm] = {
    'second_harmonic_of_heading': _heading_harmonic(2),
    'third_harmonic_of_heading': _heading_harmonic(3),
    'gear_of_heading': _heading_harmonic(7),
    'wave_over_rate': EffectForm(
        lambda session, w, shapes: np.sin(2.0 * math.pi * w / shapes['period'] + shapes['phase']),
        'rad/s', lambda sessions, generator: {
            'period': top_rate(sessions) / generator.uniform(3.0, 6.0),
            **_draw_phase(sessions, generator)}),
    'resonance_at_a_speed': EffectForm(
        lambda session, w, shapes: np.exp(
            -0.5 * ((np.abs(w) - shapes['speed']) / shapes['width']) ** 2), 'rad/s',
        lambda sessions, generator: {
            'speed': top_rate(sessions) * generator.uniform(0.2, 0.8),
            'width': top_rate(sessions) * generator.uniform(0.03, 0.1)}),
    'wave_over_temperature': EffectForm(
        lambda session, w, shapes: np.sin(
            2.0 * math.pi * session.temperature / shapes['period'] + shapes['phase']), 'rad/s',
        _draw_temperature_wave),
    'temperature_times_heading': EffectForm(
        lambda session, w, shapes: (session.temperature - shapes['middle'])
        * np.sin(session.heading + shapes['phase']), 'rad/s/K', lambda sessions, generator: {
            'middle': _median([session.temperature for session in sessions]),
            **_draw_phase(sessions, generator)}),
    'bias_pulse': EffectForm(
        lambda session, w, shapes: np.exp(
            -0.5 * ((session.time - shapes['pulse_time']) / shapes['width']) ** 2), 'rad/s',
        _draw_pulse, is_single_event=True),
    'telegraph': EffectForm(
        lambda session, w, shapes: np.searchsorted(list(shapes.values()), session.time) % 2.0,
        'rad/s', _draw_telegraph),
    'supply_parabola': EffectForm(
        lambda session, w, shapes: (session.supply - shapes['middle']) ** 2, 'rad/s/V²',
        lambda sessions, generator: {
            'middle': float(np.quantile(sessions[0].supply, generator.uniform(0.35, 0.65)))}),
    'supply_times_rate': EffectForm(
        lambda session, w, shapes: (session.supply - shapes['middle']) * w, '1/V',
        lambda sessions, generator: {'middle': _median([session.supply for session in sessions])}),
    'force_times_rate': EffectForm(
        lambda session, w, shapes: (session.tilt_force - shapes['middle']) * w, '1/(m/s²)',
        lambda sessions, generator: {
            'middle': _median([session.tilt_force for session in sessions])}),
}
