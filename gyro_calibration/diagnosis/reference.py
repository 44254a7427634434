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

from gyro_calibration.calibration.dwells.samples import where_lost
from gyro_calibration.diagnosis.data_quality import encoder_step
from gyro_calibration.diagnosis.expected_output import bridged, integral_of, white_noise
from gyro_calibration.diagnosis.findings import Reference
from gyro_calibration.logs.log import Array, DEGREE, Log
import numpy as np

KINDS = ('rate_command', 'encoder', 'motion_capture', 'course', 'odometry', 'gyro', 'rest')
#: Kinds that tell a heading, with errors that are not those of a rate.
OF_HEADING = ('encoder', 'motion_capture', 'course', 'odometry', 'gyro')
#: Span over which the errors of gyro and reference are compared, s, and by what factor those of a
#: course are larger than the noise of the gyro (measured: 22 to 560; exact references up to 66).
_SPAN, _LARGER, _LARGER_OF_FIXES = 1.0, 8.0, 2.0
#: A reference rate with more noise than this part of that of the gyro, and a heading with more
#: than this part of what the gyro walks in a second, are not exact.
_NOISY, _BLURRED = 0.01, 0.25
#: The steps of an encoder finer than this, rad, are noise of a known size; the search for exact
#: references finds more beside them (measured at 0.0055 and 0.09 deg).
_FINE = 0.05 * DEGREE
#: Third differences of white noise have a correlation of -0.75 from one to the next.
_WHITE = -0.5
#: Other noise of a reference rate is seen from so many standard deviations on, in this part of the
#: log, in blocks of so many samples.
_SEEN, _QUIETEST, _BLOCK = 3.0, 0.3, 25
#: A heading between fixes is straight: nine in ten of its second differences are below this part
#: of the largest ones.
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


def limits(log: Log, reference: Reference) -> bool:
    """Tell whether the errors of a reference, not those of the gyro, limit what a log shows."""
    if log.time is None or reference.kind == 'rest':
        return False
    if reference.kind == 'rate_command' or log.reference_heading is None:
        return log.reference_rate is not None and rate_noise_share(log) > _NOISY
    if reference.kind == 'course' or reference.known == 'as told':
        return True
    if reference.kind == 'encoder' and encoder_step(log.reference_heading) < _FINE:
        return False
    return _heading_noise(log) > _BLURRED


def rate_noise_share(log: Log) -> float:
    """
    Return the noise of a reference rate over that of the gyro; 0 where none is seen.

    It is looked for where the reference is most quiet. White noise has third differences of
    alternating sign; other noise is what the gyro does not follow from sample to sample.

    """
    assert log.output is not None and log.reference_rate is not None
    known = np.isfinite(log.output) & np.isfinite(log.reference_rate)
    rate, output = log.reference_rate[known], log.output[known]
    if len(rate) < 100 or not np.ptp(rate) > 0.0:
        return 0.0
    line = np.polyfit(rate, output, 1)
    fast, left = np.diff(rate, 3), np.diff(output - np.polyval(line, rate), 3)
    blocks = len(fast) // _BLOCK
    energy = np.sum(fast[: blocks * _BLOCK].reshape(blocks, _BLOCK) ** 2, axis=1)
    quiet = np.repeat(energy <= np.quantile(energy, _QUIETEST), _BLOCK)
    fast, left = fast[: len(quiet)][quiet], left[: len(quiet)][quiet]
    energy_of_fast = float(fast @ fast)
    if energy_of_fast > 0.0 and float(fast[1:] @ fast[:-1]) < _WHITE * energy_of_fast:
        variance = energy_of_fast / len(fast) / 20.0
        gyro = float(np.mean(left**2)) / 20.0 - variance * line[0] ** 2
        return math.sqrt(variance / max(gyro, 1e-3 * variance))
    product = -fast * left / 20.0
    # third differences of white noise are correlated over three samples
    deviation = 2.0 * float(np.std(product)) / math.sqrt(len(product))
    variance = float(np.mean(product)) / line[0]
    if not variance > _SEEN * deviation:
        return 0.0
    gyro = float(np.mean(left**2)) / 20.0 - variance * line[0] ** 2
    return math.sqrt(variance / max(gyro, 1e-3 * variance))


def _heading_noise(log: Log) -> float:
    """Return the white noise of a reference heading over what the gyro wanders in a second."""
    assert log.time is not None and log.output is not None and log.reference_heading is not None
    interval = float(np.median(np.diff(log.time)))
    gyro = white_noise(log.output) * math.sqrt(interval)
    left = log.reference_heading - integral_of(log.time, bridged(log.output))
    return white_noise(left) / gyro if gyro > 0.0 else 0.0


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
