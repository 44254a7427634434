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
Search for dwells: the stretches of a log in time in which the table turns at a constant rate.

There the reference heading, or the integral of the reference rate, is a straight line in time but
for the steps of an encoder. Ramps, the settling of the gyro after them, outliers and repeated
samples are left out.

"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
import math
from typing import NamedTuple

from gyro_calibration.heading.integration import integrate
from gyro_calibration.logs.log import Array, DataRefused, DEGREE, Log, Mask
from gyro_calibration.logs.quality import (
    find_runs,
    mask_outliers,
    mask_repeated_samples,
    quantization_step,
)
from gyro_calibration.logs.stamps import count_lost_samples
from gyro_calibration.logs.stamps import Integers as Numbers
import numpy as np
from scipy.ndimage import maximum_filter1d, uniform_filter1d

#: Minimum number of samples of a dwell.
_MIN_SAMPLES = 8
#: Duration of the blocks in which the heading is averaged, s.
_BLOCK_DURATION = 0.1


@dataclass(frozen=True)
class SteadinessLimits:
    """
    The limits of a stretch of a log that is a dwell.

    Attributes
    ----------
    min_duration : minimum duration after all cuts, s
    margin : minimum cut at both ends, s, which excludes a time offset between gyro and reference
        from the means
    max_rate_deviation : half of the largest difference of the rates of its quarters, rad/s
    relative_rate_deviation : fraction of the rate that is added to that, 1
    max_heading_deviation : largest deviation of the heading from a straight line, in addition to
        its steps, rad; less where it is straighter
    max_gap : in longer gaps the reference is taken as unknown, s
    max_ramp_duration : longest ramp between two dwells that shows the settling of the gyro, s
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
    max_ramp_duration: float = 5.0
    max_settling_time: float = 3.0
    max_temperature_change: float = 1.0
    outlier_threshold: float = 6.0
    min_dwell_share: float = 0.05


class Samples(NamedTuple):
    """
    Samples with output and reference, arrays of shape (n,).

    `heading` is that of the reference, or the integral of its `rate`; `step` is that of an
    encoder, rad, and `scale` the approximate ratio of output to reference.

    """

    time: Array
    output: Array
    rate: Array | None
    heading: Array
    step: float
    temperature: Array | None
    scale: float = 1.0

    @property
    def error(self) -> Array:
        """Return the output, less the share of a reference rate: it is steady in a dwell."""
        return self.output if self.rate is None else self.output - self.scale * self.rate

    def duration(self, rows: Numbers | slice) -> float:
        """Return the time from the first to the last sample of a part of the log, s."""
        return float(np.ptp(self.time[rows]))

    def slope(self, rows: Numbers, angle: Array) -> float:
        """
        Return the mean rate of an angle over some samples, rad/s.

        It is the slope of a straight line through a heading, whose errors are those of single
        samples, and the difference of both ends over the duration where a rate was integrated.

        """
        time = self.time[rows]
        return (fit_slope(time, angle) if self.rate is None
                else float((angle[-1] - angle[0]) / (time[-1] - time[0])))


class FoundDwells(NamedTuple):
    """The rows of each dwell among the samples, and remarks on samples that were left out."""

    samples: Samples
    rows: list[Numbers]
    remarks: tuple[str, ...]


def find_dwell_rows(log: Log, limits: SteadinessLimits) -> FoundDwells:
    """
    Find the dwells of a log in time by its reference heading, or else by its reference rate.

    Raises
    ------
    DataRefused : output or reference are missing, or the reference is never steady for long enough

    """
    samples, remarks = _select_samples(log)
    parts = [np.arange(part.start, part.stop) for part in _find_straight(samples, limits)
             if samples.duration(part) > limits.min_duration]
    samples = samples._replace(scale=_estimate_scale(samples, parts))
    is_outlier, is_repeated = np.zeros((2, len(samples.time)), dtype=bool)
    kept = []
    for part in parts:
        is_repeated[part] = mask_repeated_samples(samples.output[part])
        fresh = part[~is_repeated[part]]
        is_outlier[fresh] = mask_outliers(samples.error[fresh], limits.outlier_threshold)
        kept.append(fresh[~is_outlier[fresh]])
    settled, cut = _trim_settling(samples, kept, limits)
    divided = [part for rows in settled for part in _split_by_temperature(samples, rows, limits)]
    dwells = [rows for rows in divided
              if len(rows) >= _MIN_SAMPLES and samples.duration(rows) >= limits.min_duration]
    if short := len(divided) - len(dwells):
        remarks.append(f'steady stretches shorter than {limits.min_duration:g} s without the '
                       f'settling, left out: {short}')
    remarks.append(cut)
    if more := len(divided) - len(settled):
        remarks.append('dwells that warmed or cooled by more than '
                       f'{limits.max_temperature_change:g} K are divided, which makes {more} more')
    within = np.zeros(len(samples.time), dtype=bool)
    for rows in dwells:
        within[rows[0]:rows[-1] + 1] = True
    remarks += _describe_left_out(samples, is_outlier & within, is_repeated & within)
    remarks += _describe_missing_samples(log, samples, within)
    share = sum(map(samples.duration, dwells)) / float(np.ptp(samples.time))
    if share < limits.min_dwell_share:
        raise DataRefused(
            f'the reference is steady to {limits.max_rate_deviation / DEGREE:g} deg/s and '
            f'straight to {limits.max_heading_deviation / DEGREE:g} deg, for '
            f'{limits.min_duration:g} s at a time without the settling, in {100.0 * share:.0f} % '
            'of the log; hold each rate for longer, or use the heading itself with '
            '--method likelihood')
    if share <= 0.25:
        remarks.append(f'only {100.0 * share:.0f} % of the time is in dwells; --method likelihood '
                       'uses all of it, where there is a heading')
    return FoundDwells(samples, dwells, tuple(remarks))


# samples

def _select_samples(log: Log) -> tuple[Samples, list[str]]:
    """Return the samples with output and reference, none near a lost reference, and remarks."""
    output, time, rate = require_output(log), log.time, log.reference_rate
    if log.reference_heading is not None and (
            rate is None or np.isfinite(log.reference_heading).any()):
        rate = None  # it is often the derivative of the heading
    reference = log.reference_heading if rate is None else rate
    if time is None or reference is None:
        raise DataRefused('the log has no time or no reference; to find dwells it needs time_s '
                          'and one of reference_rate_dps and reference_heading_deg')
    known = np.isfinite(reference)
    lost = find_lost_reference(known)
    # A reference has errors up to 0.05 s before and after a loss: motion capture loses its markers
    # one by one. Stamps may come in bursts, so the mean interval counts.
    steps = np.diff(time)
    steps = steps[steps < 1.0]
    reach = round(0.05 / float(steps.mean())) if len(steps) else 0
    good = np.flatnonzero(~maximum_filter1d(lost, 2 * reach + 1) & known & np.isfinite(output))
    if len(good) < _MIN_SAMPLES:
        raise DataRefused(f'{len(good)} of {len(time)} samples hold both a gyro output and '
                          'a reference; check the columns')
    places = [f'{time[run.start]:.2f} s' for run in find_runs(lost)]
    remark = (f'the reference was lost {_format_occurrences(len(places))}, for {lost.sum()} '
              f'samples, at {format_list(places)}; they are left out')
    angle = reference[good] if rate is None else integrate(time[good], reference[good])
    return Samples(time[good], output[good], None if rate is None else rate[good], angle,
                   quantization_step(angle) if rate is None else 0.0,
                   None if log.temperature is None else log.temperature[good]), (
                       [remark] if places else [])


def require_output(log: Log) -> Array:
    """Return the output of a log, or refuse it."""
    if log.output is None:
        raise DataRefused('the log holds no gyro output in rad/s; with gyro_counts alone, say how '
                          'many deg/s a count is')
    return log.output


def find_lost_reference(known: Mask) -> Mask:
    """Mark samples without a reference, where its values are above 1.5 median intervals apart."""
    apart = np.diff(np.flatnonzero(known), prepend=-1, append=len(known))
    usual = float(np.median(apart[1:-1])) if len(apart) > 2 else 1.0
    lost = ~known
    lost[~known] = np.repeat(apart > 1.5 * usual, apart - 1)
    return lost


def few_values_remedy(time: Array, known: Mask, wanted: int) -> str:
    """Return how to record more values of a reference: longer, where they come evenly."""
    stamps = time[known]
    if not 1 < len(stamps) < wanted or find_lost_reference(known).mean() > 0.5:
        return 'repair its line and record again'
    duration = (stamps[-1] - stamps[0]) * (wanted - 1) / (len(stamps) - 1)
    return f'record longer, {math.ceil(duration)} s at the interval of the reference'


def interpolate_reference(time: Array, values: Array) -> Array:
    """Return a slow reference at each sample, linear between its values; nan where it is lost."""
    known = np.isfinite(values)
    if known.all() or not known.any():
        return values
    return np.where(find_lost_reference(known), np.nan,
                    np.interp(time, time[known], values[known], np.nan, np.nan))


def _estimate_scale(samples: Samples, parts: list[Numbers]) -> float:
    """Return the approximate ratio of output to reference, of any sign and unit."""
    rate = np.array([samples.slope(rows, samples.heading[rows]) for rows in parts])
    output = np.array([np.median(samples.output[rows]) for rows in parts])
    # Rests alone do not determine it.
    return fit_slope(rate, output) if len(rate) > 1 and np.ptp(rate) > 1.0 * DEGREE else 1.0


def fit_slope(x: Array, values: Array) -> float:
    """Return the slope of the straight line through some values."""
    centred = x - x.mean()
    return float(centred @ values / (centred @ centred))


# straight stretches

def _find_straight(samples: Samples, limits: SteadinessLimits) -> list[slice]:
    """Return the stretches in which the heading is a straight line, but for encoder steps."""
    step, time = samples.step, samples.time
    first = np.unique(np.floor((time - time[0]) / _BLOCK_DURATION), return_index=True)[1]
    edges = np.append(first, len(time))
    times, headings = (np.add.reduceat(values, first) / np.diff(edges)
                       for values in (time, samples.heading))
    tolerance = step + _straightness_tolerance(headings, limits.max_heading_deviation)
    kept: list[slice] = []
    for cone in _split_into_lines(times, headings, 2.0 * tolerance, limits.max_gap):
        if times[cone.stop - 1] - times[cone.start] < 0.5 * limits.min_duration:
            continue
        part = _extend_line(times, headings, cone, tolerance, step)
        # of two stretches that overlap, the longer one has the more accurate line
        if kept and part.start < kept[-1].stop and _length(part) > _length(kept[-1]):
            kept.pop()
        if not kept or part.start >= kept[-1].stop:
            kept.append(part)
    whole = [slice(int(edges[part.start]), int(edges[part.stop]))
             for part in kept if _length(part) > 4]
    return [part for part in whole if _has_constant_slope(samples, part, limits)]


def _length(part: slice) -> int:
    return int(part.stop - part.start)


def _straightness_tolerance(heading: Array, upper_limit: float) -> float:
    """Return three times the median deviation from a straight line within 1 s, rad, clipped."""
    # A vibration of the table cancels over a whole number of its periods, so several lengths are
    # used.
    deviations = [
        np.abs(heading[reach:-reach] - 0.5 * (heading[2 * reach:] + heading[:-2 * reach]))
        for reach in (2, 3, 5) if len(heading) > 2 * reach]
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


def _has_constant_slope(samples: Samples, part: slice, limits: SteadinessLimits) -> bool:
    """Return whether the quarters of a stretch have one slope, unlike those of a slow swing."""
    quarters = [rows for rows in np.array_split(np.arange(part.start, part.stop), 4)
                if len(rows) > 2]
    slopes = np.array([fit_slope(samples.time[rows], samples.heading[rows]) for rows in quarters])
    blur = 8.0 * samples.step / samples.duration(part)
    return not quarters or bool(np.ptp(slopes) <= blur + 2.0 * (
        limits.max_rate_deviation + limits.relative_rate_deviation * np.abs(slopes).max()))


# settling and temperature

def _trim_settling(samples: Samples, dwells: Sequence[Numbers],
                   limits: SteadinessLimits) -> tuple[list[Numbers], str]:
    """Cut margin or settling time, if longer, off both ends of dwells; return a remark."""
    time, error = samples.time, samples.error
    rate_change = np.diff([np.median(samples.output[rows]) for rows in dwells])
    spacing = np.array(
        [time[later[0]] - time[rows[-1]] for rows, later in zip(dwells, dwells[1:])])
    rate_change = np.where(spacing < limits.max_ramp_duration, rate_change, 0.0)
    # a time offset shows before a ramp, in the mirrored log
    mirrored = [(len(time) - 1 - rows)[::-1] for rows in dwells[:-1]]
    after, before = (max(limits.margin, _settling_time(*each, limits.max_settling_time))
                     for each in ((time, error, dwells[1:], rate_change),
                                  (-time[::-1], error[::-1], mirrored, -rate_change)))
    kept = [rows[(time[rows] >= time[rows[0]] + after) & (time[rows] <= time[rows[-1]] - before)]
            for rows in dwells]
    return kept, f'{after:.2f} s after each ramp and {before:.2f} s before the next are cut away'


def _settling_time(time: Array, error: Array, dwells: Sequence[Numbers], rate_change: Array,
                   max_settling: float) -> float:
    """
    Return the settling time of the output after a ramp, s.

    A linear response (a filter, a delay) is proportional to the change of rate, so it is averaged
    over all dwells, which determines a response below the noise of one dwell. It is settled where
    it is within four standard deviations of its last half; below 20 ppm it always is.

    """
    if not len(dwells):
        return 0.0
    durations = np.array([float(np.ptp(time[rows])) for rows in dwells])
    interval, width = max(0.05, float(np.median(np.diff(time)))), 4
    bins = int(min(np.quantile(durations, 0.25), 3.0 * max_settling) / interval)
    edges = np.arange(bins + 1) * interval
    used = durations >= edges[-1]
    if bins < 8 * width or not rate_change[used].any():
        return 0.0
    angles = [np.interp(edges, time[rows] - time[rows[0]], integrate(time[rows], error[rows]))
              for rows, wanted in zip(dwells, used) if wanted]
    means = np.diff(angles, axis=1) / interval
    late = means[:, bins // 2:].mean(axis=1, keepdims=True)
    response = uniform_filter1d(rate_change[used] @ (means - late) / np.sum(
        rate_change[used] ** 2), width, mode='nearest')
    spread = max(float(response[bins // 2:].std()), 2e-5)
    unsettled = np.flatnonzero(np.abs(response[:bins // 3]) > 4.0 * spread)
    # after ten bins within the limit the response has ended; later ones exceed it by chance
    unsettled = unsettled[np.cumprod(np.diff(unsettled, prepend=-1) <= 10) > 0]
    return (int(unsettled[-1]) + 1 + width // 2) * interval if len(unsettled) else 0.0


def _split_by_temperature(samples: Samples, rows: Numbers,
                          limits: SteadinessLimits) -> list[Numbers]:
    """Divide a dwell in which the temperature changes, so that its slope can be fitted."""
    if samples.temperature is None or len(rows) < 24:
        return [rows]
    twelfths = np.array_split(samples.temperature[rows], 12)
    change = float(np.ptp([part.mean() for part in twelfths]))
    number = min(math.ceil(change / limits.max_temperature_change),
                 int(samples.duration(rows) / limits.min_duration))
    return np.array_split(rows, max(1, number))


# remarks

def _describe_left_out(samples: Samples, is_outlier: Mask, is_repeated: Mask) -> Iterator[str]:
    """Yield remarks on the outliers and repeated samples within the dwells."""
    places = [f'{time:.2f} s' for time in samples.time[is_outlier]]
    if places:
        yield f'outliers, left out: {len(places)}, at {format_list(places)}'
    places = [f'{samples.time[run.start]:.2f} s ({run.stop - run.start} samples)'
              for run in find_runs(is_repeated)]
    if places:
        yield (f'the output was repeated {_format_occurrences(len(places))}, at '
               f'{format_list(places)}; the repeats are left out')


def _describe_missing_samples(log: Log, samples: Samples, within: Mask) -> Iterator[str]:
    """Yield a remark on lost gyro samples within the dwells, or on stamps too irregular."""
    assert log.time is not None and log.output is not None
    time = log.time[np.isfinite(log.output)]
    lost = count_lost_samples(time)
    if lost is None:
        yield 'the stamps are too irregular to count lost samples'
        return
    gaps = np.flatnonzero((lost > 0) & (np.interp(time[1:], samples.time, within) > 0.5))
    if len(gaps):
        yield (f'samples missing within the dwells: {lost[gaps].sum()}, '
               f'after {format_list([f"{time[gap]:.2f} s" for gap in gaps])}; at a '
               'constant rate the means are not affected')


def _format_occurrences(number: int) -> str:
    return 'once' if number == 1 else f'{number} times'


def format_list(items: Sequence[str], limit: int = 5) -> str:
    """Return the first words, separated by commas, and the number of further ones."""
    return ', '.join(items[:limit]) + (
        f' and {len(items) - limit} more' if len(items) > limit else '')
