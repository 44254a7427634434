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
References that err, for hidden logs.

A kind is a word and a number: `rate` and its white noise as a part of that of the gyro, `capture`
and the white noise of a heading, deg, `encoder` and its step, deg, `course` and the fixes a
second. A course is lost at rest, errs by 0.3 deg a fix and by side slip that grows with the rate
and wanders over 3 s, is straight between fixes, and is late by -0.2 to 0.7 s.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math

from gyro_calibration_bench.hidden.filters import autoregression
from gyro_calibration_bench.hidden.log import draw_gyro, HiddenLog, record
from gyro_calibration_bench.hidden.motion import session
from gyro_calibration_bench.hidden.noise import draw_figures
import numpy as np

#: White noise of a fix, side slip at rest and its growth with the rate, rad, rad and s, and time
#: over which it wanders, s.
FIX_NOISE, SIDE_SLIP, SIDE_SLIP_GROWTH, SIDE_SLIP_TIME = (
    math.radians(0.3), math.radians(0.3), 2.0, 3.0)


@dataclass(frozen=True)
class ImperfectReference:
    """A kind of reference and the size of its error."""

    kind: str
    size: float

    def sizing_noise(self, angle_random_walk: float, sample_rate: float) -> tuple[float, float]:
        """Return the angle random walk, and the step of an encoder, that hide as much as it."""
        if self.kind == 'rate':
            return angle_random_walk * math.hypot(1.0, self.size), 0.0
        if self.kind == 'course':
            # neighbouring fixes err alike by side slip: as many as are independent
            slip = SIDE_SLIP * math.sqrt(2.0 * SIDE_SLIP_TIME * sample_rate)
            noise = math.hypot(FIX_NOISE * math.sqrt(sample_rate / self.size), slip)
            return angle_random_walk, noise * math.sqrt(12.0)
        step = math.radians(self.size)
        return angle_random_walk, step if self.kind == 'encoder' else step * math.sqrt(12.0)


def hide_with_reference(names: Sequence[str], multiple: float, generator: np.random.Generator,
                        reference: ImperfectReference, noise: str = 'mixed',
                        duration: float = 600.0, sample_rate: float = 25.0) -> HiddenLog:
    """Hide effects in a log whose reference errs; sizes are for who knows its noise."""
    each, figures = session(generator, duration, sample_rate), draw_figures(noise, generator)
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
    elif reference.kind == 'capture':
        columns['reference_heading_rad'] = heading + math.radians(reference.size) * white
    elif reference.kind == 'encoder':
        size = math.radians(reference.size)
        columns['reference_heading_rad'] = np.floor(heading / size) * size
    else:
        factor = math.exp(-1.0 / (SIDE_SLIP_TIME * sample_rate))
        slip = SIDE_SLIP * autoregression(math.sqrt(1.0 - factor ** 2) * white, factor)
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
