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
The errors of a reference: its own instants, noise beside that of the gyro, steps, and courses.

A reference that is slower than the gyro has values of its own at some instants, and is held or
interpolated in between.
"""

from dataclasses import dataclass, replace
import math
from typing import NamedTuple

from gyro_calibration.calibration.dwells import find_lost_reference
from gyro_calibration.calibration.selection import FALSE_ALARM_RATE
from gyro_calibration.heading.integration import integrate, integrate_with_curvature
from gyro_calibration.logs.log import Array, DEGREE, Log, Mask, MIN_SAMPLE_INTERVAL
from gyro_calibration.logs.quality import (
    bridge_gaps, cross_rotation, find_runs, is_rounded_at_each_sample, quantization_step,
    robust_deviation, white_noise_deviation)
import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.interpolate import CubicSpline
from scipy.ndimage import binary_erosion, maximum_filter1d, uniform_filter1d

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

    Held values change in single samples, straight lines meet at corners; both at even intervals.
    Times, s, and values have shape (n,), without nan.
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
    Return a log whose one reference is known at its own instants alone, and these.

    The samples next to instants get the values of a cubic spline. A rate that is held as a command
    is not slow. The instants have shape (n,), with nan; None if the reference is not slow.
    """
    is_heading = log.reference_heading is not None
    given = log.reference_heading if is_heading else log.reference_rate
    known = np.flatnonzero(np.isfinite([] if given is None else given))
    if log.time is None or given is None or len(known) <= _MIN_INSTANTS:
        return log, None
    stamps = log.time[known]
    found = find_own_instants(stamps, given[known])
    if found is None or not (found.interval <= _LONGEST_INTERVAL or found.is_held and is_heading):
        return log, None
    if found.is_held and not is_heading:
        assert log.output is not None
        both = np.isfinite(given) & np.isfinite(log.output)
        left = [(log.output - rate)[both] for rate in (
            given, np.interp(log.time, found.time, found.values))]
        steps, lines = (np.abs(each - np.median(each)).sum() for each in left)
        if steps < lines or _output_delay(log, given) > 0.0:
            return log, None
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
    return (replace(log, reference_heading=own) if is_heading
            else replace(log, reference_rate=own)), kept


def _output_delay(log: Log, rate: Array) -> float:
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


#: Samples of a block.
_BLOCK_SAMPLES = 25
#: The errors of an encoder are at most so many times its rounding error.
MAX_ROUNDING_RATIO = 1.5
#: Least ratio of the noise of a course to that of the gyro: measured are 4.6 to 920, below 8 only
#: on straight lines between slower fixes, and up to 5 for odometry.
COURSE_NOISE_RATIO = 8.0


def find_rests(time: Array, output: Array, reference: Array) -> tuple[NDArray[np.intp], Mask]:
    """
    Return rests of 3 s and more: first and last row, shape (r, 2), and where the reference stands.

    The gyro is quiet, and the reference is lost, or stands: it is known and does not change.
    """
    second = max(round(1.0 / float(np.median(np.diff(time)))), 2)
    blocks = len(output) // second
    scatter = output[:blocks * second].reshape(blocks, second).std(axis=1)
    # of filtered noise single seconds are quieter by chance; where steps hide the noise, a rest
    # does not show the bias
    quietest = (maximum_filter1d(scatter, 3)[1:-1].min(initial=math.inf) if scatter.all()
                else 0.0)
    is_quiet = scatter <= 2.0 * quietest + 1e-12
    known = np.flatnonzero(np.isfinite(reference))
    changed = known[np.diff(reference[known], prepend=np.nan) != 0.0]
    is_lost, is_same = (np.bincount(rows // second, minlength=blocks)[:blocks] == 0
                        for rows in (known, changed))
    is_standing = is_same & ~is_lost
    for run in (each for each in find_runs(is_standing) if each.stop - each.start >= 3):
        inner = slice(run.start + 1, run.stop - 1)
        is_quiet[inner] = np.sqrt(np.mean(scatter[inner] ** 2)) <= 2.0 * quietest + 1e-12
    # what comes after a gap may be another rest
    apart = np.diff(time, append=time[-1])[:blocks * second].reshape(blocks, second)
    is_quiet &= apart.max(axis=1, initial=0.0) <= second * np.median(np.diff(time))
    rests = [(second * run.start, second * run.stop - 1, stands)
             for stands, each in enumerate((binary_erosion(is_lost, border_value=1), is_standing))
             for run in find_runs(is_quiet & each) if run.stop - run.start >= 3]
    ends = np.array(rests, dtype=np.intp).reshape(-1, 3)
    return ends[:, :2], ends[:, 2] == 1


def step_evenness(log: Log, step: float) -> float:
    """Return how evenly a shaft moves through its steps, 0 to 1: then errors pass for tones."""
    assert log.time is not None and log.output is not None
    interval = float(np.median(np.diff(log.time)))
    # means over a fifth of a second, as the noise of single samples is too large
    rate = uniform_filter1d(bridge_gaps(log.output),
                            max(round(0.2 / interval), 5))
    count = max(round(2.0 / interval), _BLOCK_SAMPLES)
    blocks = np.exp(2j * math.pi * interval / step * rate[:len(rate) // count * count])
    if not len(blocks):
        return 1.0
    return float(np.mean(np.abs(blocks.reshape(-1, count).mean(axis=1)) ** 2))


@dataclass(frozen=True)
class _HeadingDifference:
    """Difference of the headings of gyro and reference over a second."""

    constant_error: float  # of the part that does not grow with time, rad
    # angle random walk that is equivalent to the whole difference in a second, rad/√s
    total_walk: float

    @property
    def is_significant(self) -> bool:
        """Tell whether the error is a significant part of the difference over a second."""
        # a fifth of the variance; a simulated log without noise has numerical errors of 1e-9 rad
        return self.constant_error > max(0.25 * self.total_walk, 1e-9)


def heading_difference(log: Log) -> _HeadingDifference:
    """
    Separate the difference of the headings of gyro and reference by its growth over time.

    Its second differences over a lag have the variance ``6 error² + 2 walk² lag`` after a delay,
    to second order from the best of some, a lag, a scale factor and a misalignment are fitted.
    """
    assert log.time is not None and log.output is not None and log.reference_heading is not None
    stamps, output = log.time, bridge_gaps(log.output)
    own = np.isfinite(log.reference_heading)
    if own.sum() < 2 * _BLOCK_SAMPLES:
        return _HeadingDifference(0.0, 0.0)
    signals = [integrate_with_curvature(stamps, output), output, np.gradient(output, stamps)]
    sample, white = float(np.median(np.diff(stamps))), white_noise_deviation(output)
    heading, time, *crossing = (each[own] for each in (
        log.reference_heading, stamps, *cross_rotation(log).T))
    # a slow reference has its values at the samples next to its own instants
    apart = np.diff(time)
    interval = float(apart[apart < 2.0 * np.median(apart)].mean())
    longest = max(round(1.0 / interval), 4)

    def find_variance(lag: int, delay: float, every: int = 1) -> float:
        """Return the variance of second differences, rad²; nan where too few are known."""
        begin, middle, end = (np.arange(shift, len(time) - 2 * lag + shift, every)
                              for shift in (0, lag, 2 * lag))
        known = ((np.abs(time[end] - time[begin] - 2.0 * lag * interval) < interval)
                 & (time[begin] + delay >= stamps[0]) & (time[end] + delay <= stamps[-1]))
        if np.count_nonzero(known) <= 2 * _BLOCK_SAMPLES:
            return math.nan
        rows = [each[known] for each in (begin, middle, end)]
        off, *columns = (first - 2.0 * second + third for first, second, third in (
            *([each[part] for part in rows] for each in (heading, *crossing)),
            *([np.interp(time[part] + delay, stamps, each) for part in rows]
              for each in signals)))
        design = np.column_stack(columns)
        values = np.linalg.lstsq(design, off, rcond=None)[0]
        left = off - design @ values
        # the noise of the output, and that of its slope, in what a delay and a lag explain
        by_output = 6.0 * (values[-2] ** 2 + 0.5 * (values[-1] / sample) ** 2) * white ** 2
        return max(float(np.quantile(np.abs(left), 0.9)) ** 2 / float(stats.norm.isf(0.05)) ** 2
                   - by_output, 0.0)

    # a delay that explains less than half is chance
    usual, delay, every = find_variance(longest, 0.0), 0.0, max(len(time) // 5000, 1)
    coarse = (0.1 * np.arange(-15.0, 16.0)).tolist()
    if tried := [each for each in ((find_variance(longest, trial, every), trial)
                                   for trial in coarse) if each[0] < 0.5 * usual]:
        delay = min((find_variance(longest, near, every), near)
                    for near in (min(tried)[1] + 0.01 * np.arange(-9.0, 10.0)).tolist())[1]
    variance = {lag / longest: find_variance(lag, delay) for lag in (
        *(2 ** np.arange(int(math.log2(longest // 4)) + 1)).tolist(), longest)}
    variance = {part: each for part, each in variance.items() if not math.isnan(each)}
    whole = variance.pop(1.0, 0.0)
    error = max([0.0, *((each - part * whole) / (6.0 * (1.0 - part))
                        for part, each in variance.items())])
    return _HeadingDifference(math.sqrt(error), math.sqrt(whole / (2.0 * longest * interval)))


def rate_noise_share(log: Log, is_commanded: bool = False) -> float:
    """Return the ratio of the noise of a reference rate to that of the gyro; 0 if none shows."""
    variance, gyro = _rate_noise_variances(log, is_commanded)
    return math.sqrt(variance / max(gyro, 1e-3 * variance)) if variance else 0.0


def _rate_noise_variances(log: Log, is_commanded: bool = False) -> tuple[float, float]:
    """
    Return the variances of a reference rate and of the gyro, (rad/s)²; 0, 0 if none is detected.

    A command has none. It is estimated where the reference is quietest, by the updates of a held
    one. White noise is detected by third differences of alternating sign, other noise by changes
    that the gyro does not show, unless the rate is known to be commanded.
    """
    assert log.output is not None and log.reference_rate is not None
    known = np.isfinite(log.output) & np.isfinite(log.reference_rate)
    rate, output = log.reference_rate[known], log.output[known]
    time = np.arange(len(known)) if log.time is None else log.time
    steps = np.diff(time[known])
    begins = np.flatnonzero(np.diff(rate, prepend=np.nan) != 0.0)
    if log.time is not None and (is_commanded or len(begins) < 0.5 * len(rate)):
        delay = _output_delay(log, log.reference_rate)
        if delay > (0.0 if len(begins) < 0.5 * len(rate) else MAX_GYRO_LAG):
            return 0.0, 0.0
    slow = None if log.time is None else find_own_instants(log.time[known], rate)
    if slow is not None and slow.is_held:
        counts = np.diff(begins, append=len(rate))
        rate, output = rate[begins], np.add.reduceat(output, begins) / counts
        steps = np.ones(len(begins) - 1)
    if len(rate) < 100 or not np.ptp(rate) > 0.0:
        return 0.0, 0.0
    line = np.polyfit(rate, output, 1)
    # across lost samples the motion has changed more
    index = np.flatnonzero(maximum_filter1d(steps, 3)[1:-1] < 1.5 * np.median(steps))
    every, rest = (np.diff(each, 3)[index] for each in (rate, output - np.polyval(line, rate)))
    # a quick swing may have no three blocks in a row without a reversal, but as many half as long
    fast = left = place = every[:0]
    for block in (_BLOCK_SAMPLES, _BLOCK_SAMPLES // 2):
        blocks = len(every) // block
        energies = np.sum(every[:blocks * block].reshape(blocks, block) ** 2, axis=1)
        # by the blocks on both sides, as one may be quiet by chance; one with far more energy than
        # these is a motion between two rests
        sides = np.maximum(np.roll(energies, 1), np.roll(energies, -1))
        most = np.quantile(sides, min(max(0.03, 8.0 / blocks), 1.0))
        quiet = np.repeat((sides <= most) & (energies <= 3.0 * most), block)
        part = every[:len(quiet)][quiet]
        if len(part) and not (len(fast) and np.mean(fast ** 2) <= 3.0 * np.mean(part ** 2)):
            fast, left, place = part, rest[:len(quiet)][quiet], index[:len(quiet)][quiet]
    if not len(fast):
        return 0.0, 0.0
    energy = float(np.mean(fast ** 2))
    variance, products = energy / 20.0, (fast[1:] * fast[:-1])[np.diff(place) == 1]
    # neighbouring third differences have a correlation of -0.75 for white noise, of -0.67 for a
    # random walk, and of -0.5 for its integral, which is as smooth as a motion
    if not (variance > 0.0 and products.sum() < -0.5 * energy * len(products)):
        if is_commanded:
            return 0.0, 0.0
        product = -fast * left / 20.0
        # third differences of white noise are correlated over three samples
        deviation = 2.0 * float(np.std(product)) / math.sqrt(len(product))
        variance = float(np.mean(product)) / line[0]
        if not variance > 3.0 * deviation:
            return 0.0, 0.0
    gyro = float(np.mean(left ** 2)) / 20.0 - variance * line[0] ** 2
    return variance, gyro


def heading_white_noise(log: Log) -> float:
    """
    Return the standard deviation of the white noise of a reference heading, rad.

    It is in the heading, and in its difference to that of the gyro, without the motion.
    """
    assert log.time is not None and log.output is not None and log.reference_heading is not None
    known = np.isfinite(log.reference_heading)
    own = integrate(log.time, bridge_gaps(log.output))
    return min(white_noise_deviation(each[known])
               for each in (log.reference_heading, log.reference_heading - own))


def heading_noise_share(log: Log) -> float:
    """
    Return the ratio of the rate noise of a reference heading to that of the gyro; 0 if none shows.

    A filter or a magnetometer errs like a random walk. White noise of the heading does not count.
    """
    assert log.time is not None and log.output is not None and log.reference_heading is not None
    turned = integrate(log.time, bridge_gaps(log.output))
    rows, walks = np.flatnonzero(np.isfinite(log.reference_heading)), list[float]()
    if len(rows) < 2:
        return 0.0
    for own in (rows, rows[::2]):
        steps = np.diff(log.time[own])
        variance, of_gyro = _rate_noise_variances(Log(
            time=log.time[own[1:]] - 0.5 * steps, output=np.diff(turned[own]) / steps,
            reference_rate=np.diff(log.reference_heading[own]) / steps))
        # the gyro has what is not in the difference
        walks.append(min(variance, variance + of_gyro) * float(np.median(steps)))  # rad²/s
    white = white_noise_deviation(log.output) ** 2 * float(np.median(np.diff(log.time)))
    # by white noise of the heading the second is half of the first; where either exceeds the noise
    # of the gyro by far, it does not matter
    if not (white > 0.0 < walks[0]
            and walks[1] > min(0.75 * walks[0], COURSE_NOISE_RATIO ** 2 * white)):
        return 0.0
    return math.sqrt(walks[0] / white)


def drop_repeated_references(log: Log) -> tuple[Log, list[str]]:
    """
    Return a log without references that are repeated while the gyro turns, as of a lost marker.

    Also a remark on the longest of these stretches. In it the gyro turns, beyond its usual bias,
    by more than the step of the reference and than it differs from the reference over as long a
    time elsewhere (at 1 %). A heading must then jump rather by what the gyro turned than not at
    all: a bias may drift in a rest. A rate must jump to where the output is before, to a half; of
    a steady rate the beginning is kept, in which the output mostly agrees to a tenth.
    """
    by_rate = log.reference_heading is None
    given = log.reference_rate if by_rate else log.reference_heading
    known = np.flatnonzero(np.isfinite([] if given is None else given))
    if log.time is None or log.output is None or given is None or len(known) < _BLOCK_SAMPLES:
        return log, []
    runs = [known[run.start:run.stop + 1] for run in find_runs(np.diff(given[known]) == 0.0)
            if run.stop > run.start + 1]
    if not runs:
        return log, []
    output = bridge_gaps(log.output)
    turned = integrate_with_curvature(log.time, output)
    heading = integrate(log.time, bridge_gaps(given)) if by_rate else given
    moving = heading.copy()
    if not by_rate:  # which is steady at all speeds
        moving[np.concatenate(runs)] = np.nan
    seconds = np.flatnonzero(np.isfinite(moving))[::_BLOCK_SAMPLES]
    if len(seconds) < 2:
        return log, []
    steps = np.diff(np.array([turned, moving, log.time])[:, seconds])
    factor = 1.0 if by_rate else float(np.linalg.lstsq(steps[1:].T, steps[0], rcond=None)[0][0])
    heading, difference = factor * heading, turned - factor * moving
    bias = float(np.median((steps[0] - factor * steps[1]) / steps[2]))
    # a heading that rests is taken for a repeated one by chance at this rate
    bound = math.sqrt(0.5 * math.log(2.0 * len(runs) / FALSE_ALARM_RATE))
    step = float(quantization_step(given[known]))
    kept = given.copy()
    lost = list[tuple[float, float, float]]()
    for rows in runs:
        after = int(known[min(int(np.searchsorted(known, rows[-1])) + 1, len(known) - 1)])
        if by_rate:
            rows, unseen, least = _missed_by_rate(log.time, output, given, bias, rows, after, step)
        else:
            turned_in = float(np.diff((turned - heading)[rows[[0, -1]]])[0])
            unseen, least = turned_in - bias * float(np.ptp(log.time[rows])), step
            jump = float(np.diff((heading - turned)[[rows[-1], after]])[0])
            if abs(jump - unseen) >= abs(jump):
                continue
        if abs(unseen) <= least:
            continue
        span = float(np.ptp(log.time[rows]))
        changes = _changes_over(span, log.time, difference) - bias * span
        if len(changes) and abs(unseen) > least + 2.0 * bound * robust_deviation(changes):
            kept[rows[1:]] = np.nan
            lost.append((*log.time[rows[[0, -1]]].tolist(), abs(unseen)))
    if not lost:
        return log, []
    begin, end, angle = max(lost, key=lambda each: each[1] - each[0])
    return (replace(log, reference_rate=kept) if by_rate
            else replace(log, reference_heading=kept)), [
        f'The reference stays the same from {begin:.4g} s to {end:.4g} s, where the gyro turns by '
        f'{angle / DEGREE:.3g} deg more, as if it were lost; it is not used there, nor where the '
        'same happens for a shorter time.']


def _missed_by_rate(time: Array, output: Array, given: Array, bias: float,
                    rows: NDArray[np.intp], after: int,
                    step: float) -> tuple[NDArray[np.intp], float, float]:
    """
    Return the rows of a repeated rate but for a steady beginning, what they miss, and its bound.

    Both are angles, rad; 0 is missed if the rate does not jump to the output at the row after.
    """
    last, white = int(rows[-1]), white_noise_deviation(output)
    jump, ahead = given[after] - given[last], output[last] - bias - given[last]
    # but for a scale factor error of up to a tenth; a steady rate may go before
    usual = step + quantization_step(output) + 5.0 * white + 0.1 * abs(given[last])
    error = np.abs(output[rows] - bias - given[last])
    agreeing = int(np.argmax(np.cumsum(np.where(error <= usual, 1, -1))))
    rows = rows[agreeing:]
    span = float(np.ptp(time[rows]))
    jumps_there = abs(ahead) > 5.0 * white and 2.0 * abs(jump - ahead) < abs(jump)
    return rows, jumps_there * float(error[agreeing:].mean()) * span, float(usual * span)


def _changes_over(span: float, time: Array, values: Array) -> Array:
    """Return the known changes of values over a span, s, from up to 500 samples of a log."""
    starts = np.searchsorted(time, np.linspace(time[0], time[-1] - span, 500))
    ends = np.minimum(np.searchsorted(time, time[starts] + span), len(time) - 1)
    changes = values[ends] - values[starts]
    return np.asarray(changes[np.isfinite(changes)])
