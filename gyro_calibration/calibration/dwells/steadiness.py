# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Steadiness: the limits of a dwell, and the stretches of a log with a steady reference rate."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
import math

from gyro_calibration.calibration.dwells.samples import count
from gyro_calibration.logs.log import Array, DEGREE
from gyro_calibration.logs.quality import runs
import numpy as np
from scipy.ndimage import maximum_filter1d, median_filter, minimum_filter1d, uniform_filter1d


@dataclass(frozen=True)
class Steadiness:
    """
    The limits of a stretch of a log that is a dwell.

    Attributes
    ----------
    duration : minimum duration after all cuts, s
    margin : minimum cut at both ends, s, which excludes a time offset between gyro and reference
        from the means
    rate : largest deviation of the reference, smoothed over the margin, from its middle, rad/s;
        less where it is quieter
    relative : fraction of the rate that is added to that, 1
    heading : largest deviation of a reference heading from a straight line, in addition to its
        steps, rad; less where it is straighter
    gap : in longer gaps the reference is taken as unknown, s
    settling : longest settling time of a gyro, s
    temperature : a dwell that warms by more than this is divided, K
    outlier : a sample this many robust standard deviations from its neighbours, and from the
        middle of the dwell, is left out
    share : minimum share of the log in dwells, 1; a swing is steady for short times only

    """

    duration: float = 1.5
    margin: float = 0.25
    rate: float = 0.5 * DEGREE
    relative: float = 0.005
    heading: float = 0.5 * DEGREE
    gap: float = 1.0
    settling: float = 3.0
    temperature: float = 1.0
    outlier: float = 6.0
    share: float = 0.05


def steady(time: Array, rate: Array, limits: Steadiness) -> list[slice]:
    """Return the stretches whose reference rate is steady."""
    width = max(3, count(time, limits.margin))
    # A single outlier of the reference must not break a dwell.
    smooth = uniform_filter1d(median_filter(rate, 5, mode='nearest'), width, mode='nearest')
    deviation = (maximum_filter1d(smooth, width, mode='nearest')
                 - minimum_filter1d(smooth, width, mode='nearest'))
    allowed = float(np.clip(5.0 * np.median(deviation), 0.02 * DEGREE, limits.rate))
    calm = deviation <= allowed + limits.relative * np.abs(smooth)
    # The windows of both filters extend beyond the end of a ramp; half of that is added to the
    # stretch again, so that the margin remains.
    calm = maximum_filter1d(calm, 2 * (width // 2) + 1)
    calm[1:] &= np.diff(time) <= limits.gap
    return [slice(run.start + part.start, run.start + part.stop) for run in runs(calm)
            for part in _level(uniform_filter1d(smooth[run], 4 * width, mode='nearest'),
                               allowed, limits.relative)]


def _level(rate: Array, allowed: float, relative: float) -> Iterator[slice]:
    """Divide a stretch where its rate drifts; the parts of a slow ramp are shorter than dwells."""
    start, low, high = 0, math.inf, -math.inf
    for place, value in enumerate(rate.tolist()):
        low, high = min(low, value), max(high, value)
        if high - low > 2.0 * (allowed + relative * abs(value)):
            yield slice(start, place)
            start, low, high = place, value, value
    yield slice(start, len(rate))
