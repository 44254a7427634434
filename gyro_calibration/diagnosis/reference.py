# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The kind of the reference of a log, and whether that or the gyro limits what is known."""

from __future__ import annotations

import math

from gyro_calibration.diagnosis.compared import bridged, white_noise
from gyro_calibration.diagnosis.finding import Reference
from gyro_calibration.diagnosis.hygiene import encoder_step
from gyro_calibration.dwells.samples import where_lost
from gyro_calibration.log import Array, DEGREE, Log
import numpy as np

KINDS = ('rate_command', 'encoder', 'motion_capture', 'course', 'odometry', 'gyro', 'rest')
#: Kinds that tell a heading, with errors that are not those of a rate.
OF_HEADING = ('encoder', 'motion_capture', 'course', 'odometry', 'gyro')
#: Span over which the errors of gyro and reference are compared, s, and by what factor those of a
#: course are larger than the noise of the gyro (measured: 22 to 560; exact references up to 66).
_SPAN, _LARGER, _LARGER_OF_FIXES = 1.0, 8.0, 2.0
#: A heading between fixes is straight: nine in ten of its second differences are below this part
#: of
#: the largest ones.
_STRAIGHT = 0.1


def reference_of(log: Log, told: str | None = None) -> Reference:
    """Return the kind of the reference of a log: as told, or as the log shows it."""
    if told is not None:
        return Reference(told, 'as told')
    if log.reference_rate is not None and np.isfinite(log.reference_rate).any():
        return Reference('rate_command', 'the log has a reference rate')
    heading = log.reference_heading
    if heading is None or not np.isfinite(heading).any():
        return Reference('rest', 'the log has no reference')
    if where_lost(np.isfinite(heading)).any() and _error_ratio(log) > (
        _LARGER_OF_FIXES if _between_fixes(heading) else _LARGER
    ):
        return Reference(
            'course',
            'the heading is lost at times, as a course is at low speed, and '
            'errs by more than the gyro',
        )
    if step := encoder_step(heading):
        return Reference('encoder', f'the heading comes in steps of {step / DEGREE:.3g} deg')
    return Reference('motion_capture', 'the heading has no steps')


def _between_fixes(heading: Array) -> bool:
    """Tell whether a heading lies on straight lines between fixes that come more slowly."""
    change = np.abs(np.diff(heading, 2))
    change = change[np.isfinite(change)]
    if not len(change):
        return False
    usual, large = np.quantile(change, [0.9, 0.99])
    return bool(usual < _STRAIGHT * large)


def limits(reference: Reference) -> bool:
    """Tell whether the errors of a reference, not those of the gyro, limit what a log shows."""
    return reference.kind in OF_HEADING and (
        reference.kind == 'course' or reference.known == 'as told'
    )


def _error_ratio(log: Log) -> float:
    """Return how much a reference heading errs over a span, in units of the noise of the gyro."""
    assert log.time is not None and log.output is not None and log.reference_heading is not None
    interval = float(np.median(np.diff(log.time)))
    every = max(1, round(_SPAN / interval))
    gap = log.reference_heading - integral_of(log.time, bridged(log.output))
    change = gap[2 * every:] - 2.0 * gap[every:-every] + gap[: -2 * every]
    walk = white_noise(log.output) * math.sqrt(interval)
    if not np.isfinite(change).any() or not walk > 0.0:
        return 0.0
    size = 1.4826 * float(np.nanmedian(np.abs(change)))
    return size / (walk * math.sqrt(2.0 * _SPAN))


def integral_of(time: Array, rate: Array) -> Array:
    """Return the integral of a rate, from 0 on, shape (n,)."""
    return np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(time))])
