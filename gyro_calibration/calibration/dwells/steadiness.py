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

from gyro_calibration.calibration.dwells.samples import count_samples
from gyro_calibration.logs.log import Array, DEGREE
from gyro_calibration.logs.quality import find_runs
import numpy as np
from scipy.ndimage import maximum_filter1d, median_filter, minimum_filter1d, uniform_filter1d


@dataclass(frozen=True)
class SteadinessLimits:
    """
    The limits of a stretch of a log that is a dwell.

    Attributes
    ----------
    min_duration : minimum duration after all cuts, s
    margin : minimum cut at both ends, s, which excludes a time offset between gyro and reference
        from the means
    max_rate_deviation : largest deviation of the reference, smoothed over the margin, from its
        middle, rad/s; less where it is quieter
    relative_rate_deviation : fraction of the rate that is added to that, 1
    max_heading_deviation : largest deviation of a reference heading from a straight line, in
        addition to its steps, rad; less where it is straighter
    max_gap : in longer gaps the reference is taken as unknown, s
    max_settling_time : longest settling time of a gyro, s
    max_temperature_change : a dwell that warms by more than this is divided, K
    outlier_threshold : a sample this many robust standard deviations from its neighbours, and from
        the middle of the dwell, is left out
    min_dwell_share : minimum share of the log in dwells, 1; a swing is steady for short times only

    """

    min_duration: float = 1.5
    margin: float = 0.25
    max_rate_deviation: float = 0.5 * DEGREE
    relative_rate_deviation: float = 0.005
    max_heading_deviation: float = 0.5 * DEGREE
    max_gap: float = 1.0
    max_settling_time: float = 3.0
    max_temperature_change: float = 1.0
    outlier_threshold: float = 6.0
    min_dwell_share: float = 0.05


def find_steady_rate(time: Array, rate: Array, limits: SteadinessLimits) -> list[slice]:
    """Return the stretches whose reference rate is steady."""
    width = max(3, count_samples(time, limits.margin))
    # A single outlier of the reference must not break a dwell.
    smooth = uniform_filter1d(median_filter(rate, 5, mode='nearest'), width, mode='nearest')
    deviation = (maximum_filter1d(smooth, width, mode='nearest')
                 - minimum_filter1d(smooth, width, mode='nearest'))
    allowed = float(np.clip(5.0 * np.median(deviation), 0.02 * DEGREE, limits.max_rate_deviation))
    is_steady = deviation <= allowed + limits.relative_rate_deviation * np.abs(smooth)
    # The windows of both filters extend beyond the end of a ramp; half of that is added to the
    # stretch again, so that the margin remains.
    is_steady = maximum_filter1d(is_steady, 2 * (width // 2) + 1)
    is_steady[1:] &= np.diff(time) <= limits.max_gap
    return [slice(run.start + part.start, run.start + part.stop) for run in find_runs(is_steady)
            for part in _split_by_drift(uniform_filter1d(smooth[run], 4 * width, mode='nearest'),
                                        allowed, limits.relative_rate_deviation)]


def _split_by_drift(rate: Array, allowed: float, relative: float) -> Iterator[slice]:
    """Divide a stretch where its rate drifts; the parts of a slow ramp are shorter than dwells."""
    start, low, high = 0, math.inf, -math.inf
    for place, value in enumerate(rate.tolist()):
        low, high = min(low, value), max(high, value)
        if high - low > 2.0 * (allowed + relative * abs(value)):
            yield slice(start, place)
            start, low, high = place, value, value
    yield slice(start, len(rate))
