# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Straightness: where a reference heading is a straight line in time, but for encoder steps."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
import math

from gyro_calibration.calibration.dwells.samples import duration, fit_slope, Numbers
from gyro_calibration.calibration.dwells.steadiness import SteadinessLimits
from gyro_calibration.logs.log import Array, DEGREE
from gyro_calibration.logs.quality import quantization_step
import numpy as np

#: Duration of the blocks in which the heading is averaged, s.
_BLOCK_DURATION = 0.1


def _length(part: slice) -> int:
    return int(part.stop - part.start)


def find_straight_heading(time: Array, heading: Array, limits: SteadinessLimits) -> list[slice]:
    """Return the stretches whose reference heading is straight."""
    step = quantization_step(heading)
    edges, times, headings = _average_blocks(time, heading)
    tolerance = step + _straightness_tolerance(headings, limits.max_heading_deviation)
    stretches = [cone
                 for cone in _split_into_lines(times, headings, 2.0 * tolerance, limits.max_gap)
                 if duration(times, cone) >= 0.5 * limits.min_duration]
    parts = _drop_overlaps(
        _extend_line(times, headings, cone, tolerance, step) for cone in stretches)
    whole = [slice(int(edges[part.start]), int(edges[part.stop]))
             for part in parts if _length(part) > 4]
    return [part for part in whole if _has_constant_slope(time[part], heading[part], step, limits)]


def _average_blocks(time: Array, heading: Array) -> tuple[Numbers, Array, Array]:
    """Return where blocks begin and the last one ends, and their mean times and headings."""
    first = np.unique(np.floor((time - time[0]) / _BLOCK_DURATION), return_index=True)[1]
    edges = np.append(first, len(time))
    times, headings = (np.add.reduceat(values, first) / np.diff(edges)
                       for values in (time, heading))
    return edges, times, headings


def _straightness_tolerance(heading: Array, upper_limit: float) -> float:
    """Return three times the median deviation from a straight line within 1 s, rad, clipped."""
    # A vibration of the table cancels over a whole number of its periods, so several lengths are
    # used.
    lengths = [reach for reach in (2, 3, 5) if len(heading) > 2 * reach]
    deviations = [
        np.abs(heading[reach:-reach] - 0.5 * (heading[2 * reach:] + heading[:-2 * reach]))
        for reach in lengths]
    deviation = max((float(np.median(each)) for each in deviations), default=math.inf)
    return float(np.clip(3.0 * deviation, 0.02 * DEGREE, upper_limit))


def _split_into_lines(time: Array, heading: Array, tolerance: float,
                      gap: float) -> Iterator[slice]:
    """Divide a heading into the longest stretches that a line through their first point fits."""
    start, low, high = 0, -math.inf, math.inf
    times, headings = time.tolist(), heading.tolist()
    for place in range(1, len(times)):
        elapsed = times[place] - times[start]
        rise = headings[place] - headings[start]
        low, high = max(low, (rise - tolerance) / elapsed), min(high, (rise + tolerance) / elapsed)
        if low > high or times[place] - times[place - 1] > gap:
            yield slice(start, place)
            start, low, high = place, -math.inf, math.inf
    yield slice(start, len(times))


def _extend_line(time: Array, heading: Array, stretch: slice, tolerance: float,
                 step: float) -> slice:
    """Fit a line to the middle of a stretch, extend it within the tolerance, exclude the ramps."""
    fifth = _length(stretch) // 5
    middle = slice(stretch.start + fifth, stretch.stop - fifth)
    # By at most its own length at both ends, so that the time is linear in the length of the log.
    first = max(0, stretch.start - _length(stretch))
    last = min(len(time), stretch.stop + _length(stretch))
    line = heading[middle].mean() + fit_slope(time[middle], heading[middle]) * (
        time[first:last] - time[middle].mean())
    deviation = np.abs(heading[first:last] - line)
    beyond = np.flatnonzero(deviation > tolerance)
    before, after = beyond[beyond < middle.start - first], beyond[beyond >= middle.stop - first]
    begin = (0 if not len(before) else int(before[-1]) + 1
             + _count_ramp_blocks(deviation[before[-1]::-1], tolerance, step))
    end = (len(deviation) if not len(after)
           else int(after[0]) - _count_ramp_blocks(deviation[after[0]:], tolerance, step))
    return slice(first + begin, first + max(begin, end))


def _count_ramp_blocks(deviation: Array, tolerance: float, step: float) -> int:
    """
    Return how many blocks of a ramp are within the tolerance, from the deviation beyond them.

    On a ramp the deviation of the heading is proportional to the square of time, so the ratio of
    two deviations gives its beginning; a short ramp began later.

    """
    reference_block = round(0.5 / _BLOCK_DURATION)
    if len(deviation) <= reference_block:
        return 0
    ratio = math.sqrt(max(1.0, deviation[reference_block] / (tolerance + 0.5 * step)))
    return math.ceil(
        min(3.0 / _BLOCK_DURATION, reference_block / (ratio - 1.0) if ratio > 1.0 else math.inf))


def _drop_overlaps(parts: Iterable[slice]) -> list[slice]:
    """Keep the longer of two stretches that overlap: its line is more accurate."""
    kept: list[slice] = []
    for part in parts:
        if kept and part.start < kept[-1].stop and _length(part) > _length(kept[-1]):
            kept.pop()
        if not kept or part.start >= kept[-1].stop:
            kept.append(part)
    return kept


def _has_constant_slope(time: Array, heading: Array, step: float,
                        limits: SteadinessLimits) -> bool:
    """Return whether the quarters of a stretch have one slope, unlike those of a slow swing."""
    quarters = [quarter for quarter in np.array_split(np.arange(len(time)), 4) if len(quarter) > 2]
    if not quarters:
        return True
    slopes = np.array([fit_slope(time[quarter], heading[quarter]) for quarter in quarters])
    blur = 8.0 * step / (time[-1] - time[0])
    return bool(np.ptp(slopes) <= 2.0 * (limits.max_rate_deviation + limits.relative_rate_deviation
                                         * np.abs(slopes).max()) + blur)
