# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The instants at which a reference that is slower than the gyro has values of its own."""

from dataclasses import replace
from typing import NamedTuple

from gyro_calibration.calibration.dwells import find_lost_reference
from gyro_calibration.logs.log import Array, Log, MIN_SAMPLE_INTERVAL
from gyro_calibration.logs.quality import (
    bridge_gaps, find_runs, is_rounded_at_each_sample, quantization_step)
import numpy as np
from scipy.interpolate import CubicSpline

#: Longest interval of a slow reference, s; what is steady for longer is a motion.
_LONGEST_INTERVAL = 1.0
#: Longest lag of a gyro, s.
MAX_GYRO_LAG = 0.1
#: Step of a heading from which on it is that of an encoder, whose changes are exact, rad.
MAX_ROUNDING_STEP = 2e-4
_MIN_INSTANTS = 20


class OwnInstants(NamedTuple):
    """Where a slow reference has its own values."""

    # s, and rad or rad/s, shape (k,), or (n,) of the samples, nan where none is near
    time: Array
    values: Array
    interval: float  # the usual one, s
    is_held: bool  # in between; else on straight lines


def find_own_instants(time: Array, values: Array) -> OwnInstants | None:
    """
    Return where a slow reference has its own values, or None if it has one in each sample.

    Values that are held change in single samples. Straight lines between values meet at corners,
    which may lie between two samples. Both must come at even intervals. Times, s, and values have
    shape (n,), without nan.
    """
    step, sample = quantization_step(values), float(np.median(np.diff(time)))
    change = np.diff(values)
    renewed = 1 + np.flatnonzero(change)
    # changes of less than a step may be lost
    fast = np.abs(change[renewed[1:] - 1]) > 2.5 * step
    at, own = time[renewed], values[renewed]
    usual = _even_interval(np.diff(at)[fast], sample)
    is_held = usual is not None
    if usual is None:
        # the codes of an encoder at a steady rate have even patterns, without straight lines
        if step > MAX_ROUNDING_STEP and is_rounded_at_each_sample(values, step):
            return None
        at, own = _find_corners(time, values, step)
        usual = _even_interval(np.diff(at), sample, are_all_shown=True)
    if usual is None:
        return None
    counts = np.rint(np.diff(at) / sample)
    if is_held and not step > MAX_ROUNDING_STEP and np.any(counts % round(usual / sample)):
        # each was taken since the sample before; where all agree, at even intervals
        number = np.cumsum(np.rint(np.diff(at, prepend=at[0]) / usual))
        even = np.polyval(np.polyfit(number, at, 1), number)
        at = (even if np.abs(at - even).max() <= sample else at) - 0.5 * sample
    between = [np.linspace(begin, end, max(round((end - begin) / usual), 1), endpoint=False)
               for begin, end in zip(at[:-1], at[1:])]
    before, after = (usual * np.arange(1, int(max(length, 0.0) / usual) + 1)
                     for length in (at[0] - time[0], time[-1] - at[-1]))
    every = np.concatenate([at[0] - before[::-1], *between, at[-1:], at[-1] + after])
    all_values = (np.append(values[0], own)[np.searchsorted(at, every, 'right')] if is_held
                  else np.interp(every, time, values))
    all_values[np.searchsorted(every, at)] = own
    # two instants may be found where a gap ends
    every, place = np.unique(every, return_index=True)
    return OwnInstants(every, all_values[place], usual, is_held)


def _even_interval(gaps: Array, sample: float, are_all_shown: bool = False) -> float | None:
    """Return the usual interval of instants, s, some of which may be hidden; None if uneven."""
    if len(gaps) < _MIN_INSTANTS or np.quantile(gaps, 0.1) < 1.5 * sample:
        return None
    usual = float(np.median(gaps))
    single = np.abs(gaps - usual) <= 1.01 * sample
    # an instant with the same value, or on the same line, does not show
    several = np.abs(gaps - usual * np.rint(gaps / usual)) <= 0.1 * usual
    if are_all_shown and np.mean(single) < 2.0 / 3.0:
        return None
    return float(gaps[single].mean()) if np.mean(single | several) > 0.8 else None


def _find_corners(time: Array, values: Array, step: float) -> tuple[Array, Array]:
    """Return times and values of the corners at which straight lines between samples meet."""
    slope = np.diff(values) / np.diff(time)
    usual = float(np.mean(np.abs(slope)))
    rounding = 2.0 * step / float(np.diff(time).min()) if step < MAX_ROUNDING_STEP else 0.0
    runs = find_runs(np.abs(np.diff(slope)) <= max(1e-3 * usual, rounding))
    first, last = np.array([(run.start, run.stop + 1) for run in runs],
                           dtype=np.intp).reshape(-1, 2).T
    # two corners within two samples each leave one interval in between on a line of its own
    alone = 1 + last[:-1][first[1:] - last[:-1] == 3]
    first, last = np.sort(np.append(first, alone))[1:], np.sort(np.append(last, alone + 1))[:-1]
    meet = first - last <= 1
    first, last = first[meet], last[meet]
    before, after = slope[last - 1], slope[np.minimum(first, len(slope) - 1)]
    crossing = before != after
    first, last, before, after = (each[crossing] for each in (first, last, before, after))
    ahead = (values[first] - values[last] - after * (time[first] - time[last])) / (before - after)
    ahead = np.clip(ahead, 0.0, time[first] - time[last])
    return time[last] + ahead, values[last] + before * ahead


def keep_own_instants(log: Log) -> tuple[Log, OwnInstants | None]:
    """
    Return a log whose reference is known at its own instants alone, and these.

    Where instants lie between samples, the samples next to them get the values of a cubic spline.
    A rate that is held as a command is not slow. The instants next to samples have shape (n,),
    with nan; None if no reference is slow.
    """
    kept = None
    for name in ('reference_rate', 'reference_heading'):
        given, is_heading = getattr(log, name), name == 'reference_heading'
        known = np.flatnonzero(np.isfinite([] if given is None else given))
        if log.time is None or len(known) <= _MIN_INSTANTS:
            continue
        stamps = log.time[known]
        found = find_own_instants(stamps, given[known])
        if found is None or not (found.interval <= _LONGEST_INTERVAL
                                 or found.is_held and is_heading):
            continue
        if found.is_held and not is_heading:
            assert log.output is not None
            both = np.isfinite(given) & np.isfinite(log.output)
            left = [(log.output - rate)[both] for rate in (
                given, np.interp(log.time, found.time, found.values))]
            steps, lines = (np.abs(each - np.median(each)).sum() for each in left)
            if steps < lines or output_delay(log, given) > 0.0:
                continue
        # not those in gaps
        after = np.clip(np.searchsorted(stamps, found.time), 1, len(stamps) - 1)
        inside = stamps[after] - stamps[after - 1] < found.interval
        if found.is_held and is_heading:  # it may be lost where it stands
            inside &= np.diff(found.values, prepend=np.nan) != 0.0
        at, values, after = found.time[inside], found.values[inside], after[inside]
        rows = known[after - (at - stamps[after - 1] < stamps[after] - at)]
        kept = found._replace(time=np.full(len(log), np.nan), values=np.full(len(log), np.nan))
        kept.time[rows], kept.values[rows] = at, values
        own = kept.values.copy()
        if np.abs(at - log.time[rows]).max(initial=0.0) > MIN_SAMPLE_INTERVAL:
            own[rows] = CubicSpline(found.time, found.values)(log.time[rows])
        log = (replace(log, reference_heading=own) if is_heading
               else replace(log, reference_rate=own))
    return log, kept


def output_delay(log: Log, rate: Array) -> float:
    """Return by how much the output of a gyro is later than a reference rate, up to 1 s, in s."""
    assert log.time is not None and log.output is not None
    known, output = np.isfinite(rate), bridge_gaps(log.output)
    sample = float(np.median(np.diff(log.time)))
    delays = sample * np.arange(-round(_LONGEST_INTERVAL / sample),
                                round(_LONGEST_INTERVAL / sample) + 1)
    late = (np.interp(log.time - delay, log.time[known], rate[known]) for delay in delays.tolist())
    # correlations but for the scatter of the output, which a dead gyro does not have
    alike = [(output - output.mean()) @ each / max(each.std(), 1e-300) for each in late]
    return float(delays[int(np.argmax(alike))])


def is_slow(values: Array) -> bool:
    """Tell whether a reference has a value in less than half of the samples where it is known."""
    known = np.isfinite(values)
    return bool(known.sum() < 0.5 * (len(known) - find_lost_reference(known).sum()))


def interpolate_by_splines(time: Array, values: Array) -> Array:
    """Return a slow reference at each sample, on cubic splines; nan where it is lost."""
    known = np.isfinite(values)
    if known.all() or known.sum() < 2:
        return values
    return np.where(find_lost_reference(known), np.nan,
                    CubicSpline(time[known], values[known], extrapolate=False)(time))
