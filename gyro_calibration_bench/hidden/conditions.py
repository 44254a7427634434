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
Logs under conditions of their own: look-alikes, and references that err.

Two causes are confounded under some conditions, and distinguishable under others.

Of a reference, a kind is a word and a number: `rate` and its white noise as a part of that of the
gyro, `capture` and the white noise of a heading, deg, `encoder` and its step, deg, `course` and
the fixes a second. A course is lost at rest, errs by 0.3 deg a fix and by side slip that grows
with the rate and wanders over 3 s, is straight between fixes, and is late by -0.2 to 0.7 s. The
kinds `held` and `lines` are headings with a value every so many s, held or on straight lines in
between, `heldrate` and `linesrate` rates; `lost` is a heading that is repeated so many times for
up to 2 s.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
import math
from typing import Any

from gyro_calibration_bench.hidden.effects import Shapes
from gyro_calibration_bench.hidden.log import draw_gyro, FixedParts, HiddenLog, hide, record
from gyro_calibration_bench.hidden.motion import Session, session
from gyro_calibration_bench.hidden.noise import draw_figures, NoiseFigures
import numpy as np
from scipy.signal import lfilter


@dataclass(frozen=True)
class LookAlikes:
    """Two causes that have the same column under some conditions, arguments of `session`."""

    confounding_conditions: Mapping[str, Any]
    separating_conditions: Mapping[str, Any] | None  # None if none are with this reference
    # recordings -> shapes and signs of effects, if only these are confounded
    fixed_parts: FixedParts | None = None
    multiple: float = 4.0  # of the minimum detectable effect
    figures: NoiseFigures | None = None  # noise of the gyro; None for any
    duration_factor: float = 1.0  # of the separating recording to the first one
    needs_model: bool = False  # they show only if a model has bias and scale factor error


def _shape(effect: str, **parts: float) -> FixedParts:
    """Return the parts of an effect that are not random; a time constant is of the duration."""
    def fixed(sessions: list[Session]) -> Mapping[str, Shapes]:
        duration = float(sessions[0].time[-1])
        return {effect: {name: value * duration if name == 'time_constant' else value
                         for name, value in parts.items()}}
    return fixed


def _turning_point_shapes(sessions: list[Session]) -> Mapping[str, Shapes]:
    return {'bias_step': {
        'run': 0, 'step_time': float(sessions[0].time[np.argmax(sessions[0].temperature)])}}


LOOK_ALIKES: Mapping[tuple[str, str], LookAlikes] = {
    ('bias_temperature', 'rate_ramp'): LookAlikes({'temperature': 'ramp'}, {}),
    ('bias_temperature', 'warm_up'): LookAlikes({'temperature': 'cold_start'}, {},
                                                _shape('warm_up', time_constant=0.2)),
    ('warm_up', 'rate_ramp'): LookAlikes(
        {}, {}, _shape('warm_up', time_constant=2.0), duration_factor=4.0),
    ('heading_sensitivity', 'reference_once_per_rev'): LookAlikes({'motion': 'one_speed'}, {}),
    ('scale_factor_asymmetry', 'quadratic_nonlinearity'): LookAlikes(
        {'motion': 'two_way'}, {}, multiple=8.0, duration_factor=2.0),
    ('scale_factor_asymmetry', 'vibration_rectification'): LookAlikes(
        {'motion': 'two_way', 'force': 'turning'}, {}),
    ('quadratic_nonlinearity', 'acceleration_sensitivity'): LookAlikes({'force': 'off_axis'}, {}),
    ('cubic_nonlinearity', 'sine_response'): LookAlikes(
        {'motion': 'slow'}, {'top_rate': 3.0}, _shape('cubic_nonlinearity', sign=-1.0),
        figures=NoiseFigures(2e-5)),
    ('time_offset', 'bandwidth'): LookAlikes(
        {'motion': 'smooth', 'top_rate': 2.0}, {'top_rate': 3.0}, _shape('time_offset', sign=1.0),
        multiple=20.0, figures=NoiseFigures(5e-4)),
    ('bias_temperature_rate', 'thermal_lag'): LookAlikes(
        {'temperature': 'smooth'}, {'temperature': 'triangles'},
        _shape('thermal_lag', time_constant=0.01)),
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
                    duration: float = 900.0, sample_rate: float = 50.0) -> HiddenLog:
    """Hide one of a pair of `LOOK_ALIKES` where it cannot be distinguished, as `hide` does."""
    twins = LOOK_ALIKES[pair]
    return hide([hidden], twins.multiple, generator, noise='white', duration=duration,
                sample_rate=sample_rate, figures=twins.figures,
                conditions=twins.confounding_conditions, fixed_parts=twins.fixed_parts,
                against_a_model=twins.needs_model)[0]


def record_separating(pair: tuple[str, str], log: HiddenLog,
                      generator: np.random.Generator) -> HiddenLog:
    """Record the gyro again, where the pair is distinguishable; single events do not recur."""
    twins, first = LOOK_ALIKES[pair], log.session
    if twins.separating_conditions is None:
        raise ValueError(f'{pair[0]} and {pair[1]} are distinguished by another reference alone')
    duration = twins.duration_factor * len(first.time) * first.interval
    return record(
        log.truth.gyro,
        session(generator, duration, 1.0 / first.interval, **twins.separating_conditions),
        generator, run=1)


#: White noise of a fix, side slip at rest and its growth with the rate, rad, rad and s, and time
#: over which it wanders, s.
FIX_NOISE, SIDE_SLIP, SIDE_SLIP_GROWTH, SIDE_SLIP_TIME = (
    math.radians(0.3), math.radians(0.3), 2.0, 3.0)


SLOW_KINDS = ('held', 'lines', 'heldrate', 'linesrate', 'lost')


@dataclass(frozen=True)
class ImperfectReference:
    """A kind of reference and the size of its error."""

    kind: str
    size: float

    def sizing_noise(self, angle_random_walk: float, sample_rate: float) -> tuple[float, float]:
        """Return the angle random walk, and the step of an encoder, that hide as much as it."""
        if self.kind == 'rate':
            return angle_random_walk * math.hypot(1.0, self.size), 0.0
        if self.kind in SLOW_KINDS:
            return angle_random_walk, 0.0
        if self.kind == 'course':
            # neighbouring fixes err alike by side slip: as many as are independent
            slip = SIDE_SLIP * math.sqrt(2.0 * SIDE_SLIP_TIME * sample_rate)
            noise = math.hypot(FIX_NOISE * math.sqrt(sample_rate / self.size), slip)
            return angle_random_walk, noise * math.sqrt(12.0)
        step = math.radians(self.size)
        return angle_random_walk, step if self.kind == 'encoder' else step * math.sqrt(12.0)


def hide_with_reference(names: Sequence[str], multiple: float, generator: np.random.Generator,
                        reference: ImperfectReference, noise: str = 'mixed') -> HiddenLog:
    """Hide effects in a log whose reference errs; sizes are for who knows its noise."""
    sample_rate = 25.0
    each, figures = session(generator, 600.0, sample_rate), draw_figures(noise, generator)
    walk, step = reference.sizing_noise(figures.angle_random_walk, sample_rate)
    gyro = replace(draw_gyro(names, multiple, generator, [each],
                             replace(figures, angle_random_walk=walk), step), figures=figures)
    made = record(gyro, each, generator, expected=figures, reference='both')
    columns = dict(made.columns)
    rate, heading = columns.pop('reference_rate_rad_s'), columns.pop('reference_heading_rad')
    white, time = generator.standard_normal(len(rate)), columns['time_s']
    if reference.kind == 'rate':
        own = reference.size * figures.sample_deviation(1.0 / sample_rate)
        columns['reference_rate_rad_s'] = rate + own * white
    elif reference.kind in SLOW_KINDS:
        is_rate = reference.kind.endswith('rate')
        columns['reference_rate_rad_s' if is_rate else 'reference_heading_rad'] = _slow_values(
            time, rate if is_rate else heading, reference, generator)
    elif reference.kind == 'capture':
        columns['reference_heading_rad'] = heading + math.radians(reference.size) * white
    elif reference.kind == 'encoder':
        size = math.radians(reference.size)
        columns['reference_heading_rad'] = np.floor(heading / size) * size
    else:
        factor = math.exp(-1.0 / (SIDE_SLIP_TIME * sample_rate))
        slip = SIDE_SLIP * lfilter([1.0], [1.0, -factor], math.sqrt(1.0 - factor ** 2) * white)
        slip *= 1.0 + SIDE_SLIP_GROWTH * np.abs(rate)
        delay = generator.uniform(-0.2, 0.7)
        fixes = np.arange(time[0], time[-1], 1.0 / reference.size)
        course = (np.interp(fixes - delay, time, heading + slip)
                  + FIX_NOISE * generator.standard_normal(len(fixes)))
        course = np.interp(time, fixes, course)
        course[np.interp(time - delay, time, columns['moving']) < 0.5] = np.nan
        columns['reference_heading_rad'] = course
        del columns['moving']
    return replace(made, columns=columns)


def _slow_values(time: np.ndarray, values: np.ndarray, reference: ImperfectReference,
                 generator: np.random.Generator) -> np.ndarray:
    """Return the values of a slow reference at the samples, or of one that is lost at times."""
    if reference.kind == 'lost':
        lost = values.copy()
        for begin in generator.integers(0, len(time), int(reference.size)).tolist():
            end = np.searchsorted(time, time[begin] + generator.uniform(0.2, 2.0))
            lost[begin:end] = values[begin]
        return lost
    at = np.arange(time[0] - generator.uniform(0.0, reference.size), time[-1] + reference.size,
                   reference.size)
    own = np.interp(at, time, values)
    return (np.interp(time, at, own) if reference.kind.startswith('lines')
            else own[np.searchsorted(at, time, 'right') - 1])
