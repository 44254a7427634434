# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Units taken for another: factors and delays that a confused or forgotten unit explains."""

from __future__ import annotations

from collections.abc import Mapping
import math

#: What people confuse: degrees and radians, the sense of rotation, two ranges of a gyro.
_CONFUSED: Mapping[str, float] = {
    'pi/180': math.pi / 180.0, '180/pi': 180.0 / math.pi,
    '-pi/180': -math.pi / 180.0, '-180/pi': -180.0 / math.pi,
    '-1': -1.0, '2': 2.0, '1/2': 0.5, '-2': -2.0, '-1/2': -0.5}
#: Powers of two taken for powers of ten, and the other way round.
_BINARY: Mapping[str, float] = {
    **{f'{2 ** power}/1000': 2 ** power / 1000.0 for power in range(1, 17)},
    '1000/1024': 1000.0 / 1024.0,
    '1048576/1000000': 1.048576, '1000000/1048576': 1.0 / 1.048576}
FACTORS: Mapping[str, float] = {**_CONFUSED, **_BINARY}
#: The largest ratio of a gyro's factor to 1 in the right unit, or to the factor of another unit.
_OF_A_GYRO = 1.1
#: Of its own, a factor is no unit unless it is as close as this.
_CLOSE = 0.005
#: The most that the standard deviation may be of the distance to 1, or of an interval for a delay.
_KNOWN = 0.1
#: The same for a factor near 1, where a factor that is so by chance would come close too often.
_WELL_KNOWN = 0.02


def unit_of_scale(factor: float, deviation: float) -> str | None:
    """
    Return which confusion of units a factor of output over rate is, such as 'pi/180', or None.

    Far from 1, no gyro has such a scale factor, and its own error of up to a tenth may come on top
    of a confusion. Near 1, the factor must be close, within two standard deviations, and known to
    a fiftieth of its distance from 1.

    Parameters
    ----------
    factor : of the output over the rate, or over what a model makes of it
    deviation : its standard deviation

    """
    close = [name for name, value in FACTORS.items() if _is(factor, deviation, value)]
    if close:
        return min(close, key=lambda name: abs(factor - FACTORS[name]))
    far = [name for name, value in _CONFUSED.items() if _ratio(factor, value) < _OF_A_GYRO]
    return far[0] if far and deviation < _KNOWN * abs(factor) else None


def is_far(factor: float) -> bool:
    """Tell whether no gyro of the right unit has such a factor."""
    return _ratio(factor, 1.0) > 1.4


def _is(factor: float, deviation: float, value: float) -> bool:
    least = _CLOSE if is_far(value) else 1e-4  # far from 1 there is nothing else that it could be
    near = (abs(factor - value) < max(2.0 * deviation, least * abs(value))
            and abs(factor / value - 1.0) < _CLOSE)
    return near and deviation < (_KNOWN if is_far(value) else _WELL_KNOWN) * min(
        abs(value - 1.0), abs(value))


def _ratio(factor: float, value: float) -> float:
    """Return by what ratio two factors differ, above 1; infinite where their signs do."""
    return math.inf if factor * value <= 0.0 else max(factor / value, value / factor)


def unit_of_offset(estimate: float, deviation: float, interval: float) -> str | None:
    """
    Return 'one sample' or 'half a sample' if a time offset is either within 2 sigma; or None.

    Parameters
    ----------
    estimate, deviation : of the offset, s
    interval : of the samples, s

    """
    if deviation > _KNOWN * interval:
        return None
    for name, part in (('one sample', 1.0), ('half a sample', 0.5)):
        if abs(abs(estimate) - part * interval) < max(2.0 * deviation, 1e-3 * interval):
            return name
    return None
