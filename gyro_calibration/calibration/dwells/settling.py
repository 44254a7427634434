# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Settling: cut the response of the gyro to ramps off the ends of dwells."""

from __future__ import annotations

from collections.abc import Sequence

from gyro_calibration.calibration.dwells.samples import duration, Numbers, Samples
from gyro_calibration.calibration.dwells.steadiness import SteadinessLimits
from gyro_calibration.heading.integration import integrate
from gyro_calibration.logs.log import Array
import numpy as np
from scipy.ndimage import uniform_filter1d

#: Longest ramp between two dwells, s.
_MAX_RAMP_DURATION = 5.0


def trim_settling(samples: Samples, dwells: Sequence[Numbers],
                  limits: SteadinessLimits) -> tuple[list[Numbers], str]:
    """Cut margin or settling time, if longer, off both ends of dwells; return a remark."""
    time, error = samples.time, samples.error
    rate_change = np.diff([np.median(samples.output[rows]) for rows in dwells])
    spacing = np.array(
        [time[later[0]] - time[rows[-1]] for rows, later in zip(dwells, dwells[1:])])
    rate_change = np.where(spacing < _MAX_RAMP_DURATION, rate_change, 0.0)
    mirrored = [(len(time) - 1 - rows)[::-1] for rows in dwells[:-1]]
    after = max(limits.margin,
                _settling_time(time, error, dwells[1:], rate_change, limits.max_settling_time))
    before = max(limits.margin, _settling_time(-time[::-1], error[::-1], mirrored, -rate_change,
                                               limits.max_settling_time))
    kept = [rows[(time[rows] >= time[rows[0]] + after) & (time[rows] <= time[rows[-1]] - before)]
            for rows in dwells]
    return kept, f'{after:.2f} s after each ramp and {before:.2f} s before the next are cut away'


def _settling_time(time: Array, error: Array, dwells: Sequence[Numbers], rate_change: Array,
                   max_settling: float) -> float:
    """Return the settling time of the output after a ramp, s."""
    durations = np.array([duration(time, rows) for rows in dwells])
    if not len(durations):
        return 0.0
    interval = max(0.05, float(np.median(np.diff(time))))
    bins = int(min(np.quantile(durations, 0.25), 3.0 * max_settling) / interval)
    edges = np.arange(bins + 1) * interval
    used = durations >= edges[-1]
    if not rate_change[used].any():
        return 0.0
    means = np.array([_average_in_bins(time[rows] - time[rows[0]], error[rows], edges)
                      for rows, wanted in zip(dwells, used) if wanted])
    response = _unit_step_response(means, rate_change[used])
    # single bins, and means of four
    return max(_count_unsettled_bins(response, width) for width in (1, 4)) * interval


def _average_in_bins(time: Array, values: Array, edges: Array) -> Array:
    """Return the mean of the values in each bin, with gaps bridged by lines."""
    return np.diff(np.interp(edges, time, integrate(time, values))) / np.diff(edges)


def _unit_step_response(means: Array, rate_change: Array) -> Array:
    """
    Return the response to a unit of change in each bin, from means of shape (dwells, bins).

    A linear response (a filter, a delay) is proportional to the change of rate, so it is averaged
    over all dwells, which determines a response below the noise of one dwell.

    """
    late = means[:, means.shape[1] // 2:].mean(axis=1, keepdims=True)
    return rate_change @ (means - late) / (rate_change @ rate_change)


def _count_unsettled_bins(response: Array, width: int) -> int:
    """
    Return the number of bins until the response stays within four standard deviations of noise.

    The response is averaged over `width` bins and examined in the first third. The noise is the
    standard deviation of the response in the last half.

    """
    if len(response) < 8 * width:
        return 0
    smooth = uniform_filter1d(response, width, mode='nearest')
    # A response below 20 ppm of the change of rate is not cut, even without noise.
    spread = max(float(smooth[len(smooth) // 2:].std()), 2e-5)
    last_unsettled = -1
    for place in np.flatnonzero(np.abs(smooth[:len(smooth) // 3]) > 4.0 * spread):
        # After ten bins within the limit the response has ended; later ones exceed it by chance.
        last_unsettled = int(place) if place - last_unsettled <= 10 else last_unsettled
    return last_unsettled + 1 + width // 2 if last_unsettled >= 0 else 0
