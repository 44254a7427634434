"""
Dwells: stretches of constant rate, each one row of means, out of which a rate table's calibration is made.

A rate table without time holds them already. In a log in time they are found: where the reference is steady, without the ramps and
the settling after them.

"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, median_filter, minimum_filter1d, uniform_filter1d
from scipy.special import digamma, polygamma

from gyro_calibration.log import DEGREE, Array, DataRefused, Log

Flags = NDArray[np.bool_]
Numbers = NDArray[np.integer[Any]]

#: Sweeps shorter than this on the whole are no sweeps but chance.
_ROWS_OF_A_SWEEP = 4
#: Blocks of consecutive dwells, where the order tells no sweeps.
_BLOCKS = 9
#: A dwell is divided into so many batches, whose scatter gives the deviation of the mean: fewer, where they got shorter than a vibration
#: of the table, or an answer of the gyro's filter, needs to average out, s.
_FEWEST_BATCHES, _MOST_BATCHES, _BATCH = 4, 12, 0.75
#: Samples that a dwell holds at least.
_SAMPLES = 8
#: Longer intervals than this say nothing of the sample rate, s.
_PAUSE = 1.0
#: The reference heading is looked at in blocks, s.
_BLOCK = 0.1


@dataclass(frozen=True)
class Dwells:
    """
    Means over stretches of constant rate (Ojeda et al., eq. 5 to 7), each array of shape (n,).

    Attributes
    ----------
    rate : of the reference, rad/s
    output : of the gyro, rad/s
    temperature : degC; None where the log holds none
    deviation : standard deviation of the mean output against the mean reference, rad/s; nan where it is not known
    sweep : number of the sweep, or block of time, that a dwell belongs to; what is left out together
    place : where each dwell stands in its file, for messages
    remarks : what was found and left out, one sentence each

    """

    rate: Array
    output: Array
    temperature: Array | None
    deviation: Array
    sweep: Numbers
    place: tuple[str, ...]
    remarks: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.rate)


@dataclass(frozen=True)
class Steadiness:
    """
    What a stretch of a log must keep to be a dwell.

    Attributes
    ----------
    duration : at least so long after all cuts, s
    margin : cut at both ends at least, s; a time offset between gyro and reference stays out of the means
    rate : the reference, smoothed over the margin, strays at most so far from its middle, rad/s; less where it is quieter
    relative : and this part of the rate, 1
    heading : a reference heading strays at most so far from a straight line, besides its steps, rad; less where it is straighter
    gap : over longer gaps nobody knows what the reference did, s
    settling : a gyro takes no longer than this to settle, s
    temperature : a dwell that warms by more than this is divided, K
    wild : a sample this many robust standard deviations from its neighbours, and from the middle of the dwell, is left out
    share : so much of the log is in dwells at least; a log that swings looks steady now and then, 1

    """

    duration: float = 1.5
    margin: float = 0.25
    rate: float = 0.5 * DEGREE
    relative: float = 0.005
    heading: float = 0.5 * DEGREE
    gap: float = 1.0
    settling: float = 3.0
    temperature: float = 1.0
    wild: float = 6.0
    share: float = 0.05


class _Samples(NamedTuple):
    """What of a log can be used: samples with output and reference, the latter a rate or a heading."""

    time: Array
    output: Array
    rate: Array | None
    heading: Array | None
    temperature: Array | None
    scale: float = 1.0

    @property
    def error(self) -> Array:
        """Return what is steady in a dwell: the output, less what a reference rate explains of it."""
        return self.output if self.rate is None else self.output - self.scale * self.rate

def dwells(log: Log, name: str = '') -> Dwells:
    """
    Return the dwells of a log: the rows of a rate table, or what is found in a log in time.

    Parameters
    ----------
    log : with output, and a reference rate or a reference heading
    name : of the file, put before the places and the remarks

    Raises
    ------
    DataRefused : output or reference are missing, or nothing is steady

    """
    found = from_table(log) if log.time is None else find_dwells(log)
    if not name:
        return found
    return replace(found, place=tuple(f'{name}: {place}' for place in found.place),
                   remarks=tuple(f'{name}: {remark}' for remark in found.remarks))


def join(parts: Sequence[Dwells]) -> Dwells:
    """Return the dwells of several logs as one, their sweeps numbered apart; without temperature where one of them has none."""
    if not parts:
        raise DataRefused('no dwells were given; give at least one log')
    first = np.cumsum([0] + [int(part.sweep.max()) + 1 for part in parts])
    temperatures = [part.temperature for part in parts if part.temperature is not None]
    whole = len(temperatures) == len(parts)
    remarks = sum((part.remarks for part in parts), ())
    if temperatures and not whole:
        remarks += (f'{len(parts) - len(temperatures)} of {len(parts)} logs hold no temperature, so that of the others is not used',)
    return Dwells(np.concatenate([part.rate for part in parts]), np.concatenate([part.output for part in parts]),
                  np.concatenate(temperatures) if whole else None, np.concatenate([part.deviation for part in parts]),
                  np.concatenate([part.sweep + number for part, number in zip(parts, first)]),
                  sum((part.place for part in parts), ()), remarks)


def from_table(log: Log) -> Dwells:
    """
    Return the rows of a rate table.

    The columns `sweep` (any text) and `deviation_dps` (of each mean) are used where the file has them.

    Raises
    ------
    DataRefused : output or reference rate are missing, or no row holds both

    """
    output = _output(log)
    if log.reference_rate is None:
        raise DataRefused('the rows have no time and no reference rate; a rate table needs the column reference_rate_dps')
    good = np.isfinite(output) & np.isfinite(log.reference_rate)
    if not good.any():
        raise DataRefused(f'none of the {len(output)} rows holds both a gyro output and a reference rate; look at the columns')
    rows = np.flatnonzero(good)
    rate = log.reference_rate[rows]
    names = log.others.get('sweep')
    sweep = _sweeps(rate) if names is None else _numbered([names[row] for row in rows])
    return Dwells(rate, output[rows], None if log.temperature is None else log.temperature[rows], _told_deviation(log)[rows], sweep,
                  tuple(f'row {row + 1}' for row in rows), tuple(_lost_rows(good)))


def _output(log: Log) -> Array:
    if log.output is None:
        raise DataRefused('the log holds no gyro output in rad/s; with gyro_counts alone, say how many deg/s a count is')
    return log.output


def _told_deviation(log: Log) -> Array:
    texts = log.others.get('deviation_dps')
    if texts is None:
        return np.full(len(log), np.nan)
    try:
        values = np.array(texts, dtype=float) * DEGREE
    except ValueError as error:
        raise DataRefused(f'column deviation_dps: {error}; wanted deg/s, or nan where it is not known') from None
    return np.where(values > 0.0, values, np.nan)


def _lost_rows(good: Flags) -> Iterator[str]:
    lost = np.flatnonzero(~good) + 1
    if len(lost):
        yield f'{len(lost)} rows without output or reference are left out: {_listed([str(row) for row in lost])}'


def _listed(words: Sequence[str], most: int = 5) -> str:
    return ', '.join(words[:most]) + (f' and {len(words) - most} more' if len(words) > most else '')


def _numbered(names: Sequence[str]) -> Numbers:
    numbers = {name: number for number, name in enumerate(dict.fromkeys(names))}
    return np.array([numbers[name] for name in names])


def _sweeps(rate: Array) -> Numbers:
    """
    Return the number of the sweep that each dwell belongs to, by the order of the rates, shape (n,).

    Tables go through the rates in one direction, or through their sizes with changing sign, with or without a rest between them. Where
    the order tells nothing, blocks of consecutive dwells stand for sweeps: they are as far apart in time.

    """
    turning = np.abs(rate) > max(1e-3 * np.abs(rate).max(), 0.01 * DEGREE)
    for used in (np.full(len(rate), True), turning) if turning.any() else ():
        for value in (rate, np.abs(rate)):
            sweep = np.zeros(len(rate), dtype=int)
            sweep[used] = _passes(value[used])
            # A rest belongs to the dwell before it.
            sweep = np.maximum.accumulate(np.where(used, sweep, 0))
            lengths = np.bincount(sweep[used])
            if len(lengths) > 1 and np.median(lengths) >= _ROWS_OF_A_SWEEP:
                return sweep
    return np.arange(len(rate)) * min(_BLOCKS, len(rate)) // len(rate)


def _passes(value: Array) -> Numbers:
    """Number the passes through some values: a new one begins where the direction of travel turns back or the values start anew."""
    change = np.diff(value)
    # Found rates of opposite sign are not of the same size to the last digit.
    steps = np.where(np.abs(change) > 0.005 * np.abs(value).max(), np.sign(change), 0.0)
    numbers = np.zeros(len(value), dtype=int)
    direction = 0.0
    for place in range(1, len(value)):
        step = steps[place - 1]
        turned = step * direction < 0.0
        numbers[place] = numbers[place - 1] + turned
        # The jump back to the start of the next pass says nothing about its direction.
        direction = 0.0 if turned else direction or step
    return numbers


def find_dwells(log: Log, limits: Steadiness | None = None) -> Dwells:
    """
    Find the dwells in a log in time.

    Raises
    ------
    DataRefused : output or reference are missing, or the reference is never steady for long enough

    """
    limits = limits or Steadiness()
    if log.reference_rate is None or not np.isfinite(log.reference_rate).any():
        found = _find(replace(log, reference_rate=None), limits)
    else:
        found = _find(replace(log, reference_heading=None), limits)
        if log.reference_heading is not None and np.isfinite(log.reference_heading).any():
            # A rate that was made of a coarse encoder's steps is hardly ever steady; the heading that it was made of may be straight.
            by_heading = _find(replace(log, reference_rate=None), limits)
            found = found if found.duration > 0.9 * by_heading.duration else by_heading
    if found.share < limits.share:
        raise DataRefused(_not_steady(found, limits))
    return _means(found)


class _Found(NamedTuple):
    """The rows of each dwell, and what was left out."""

    samples: _Samples
    rows: list[Numbers]
    remarks: tuple[str, ...]

    @property
    def duration(self) -> float:
        """Return the time in dwells, s."""
        return float(sum(self.samples.time[part[-1]] - self.samples.time[part[0]] for part in self.rows))

    @property
    def share(self) -> float:
        """Return the part of the log that is in dwells."""
        return self.duration / float(self.samples.time[-1] - self.samples.time[0])


def _find(log: Log, limits: Steadiness) -> _Found:
    samples, remarks = _usable(log)
    stretches = _straight(samples, limits) if samples.rate is None else _steady(samples.time, samples.rate, limits)
    stretches = [part for part in stretches if samples.time[part.stop - 1] - samples.time[part.start] > limits.duration]
    samples = samples._replace(scale=_scale(samples, stretches))
    cleaned = [_Cleaned.of(samples, part, limits) for part in stretches]
    rows, cuts = _settled(samples, [part.rows for part in cleaned], limits)
    rows, divided = _divided(samples, rows, limits)
    kept = [part for part in rows if len(part) >= _SAMPLES and samples.time[part[-1]] - samples.time[part[0]] >= limits.duration]
    if len(kept) < len(rows):
        remarks.append(f'steady stretches shorter than {limits.duration:g} s beside the settling, left out: {len(rows) - len(kept)}')
    remarks += [*cuts, *divided, *_left_out(samples, kept, cleaned), *_lost_samples(log, samples, kept)]
    found = _Found(samples, kept, tuple(remarks))
    return found if found.share > 0.25 else found._replace(remarks=found.remarks + (_little(found.share),))


def _scale(samples: _Samples, stretches: list[slice]) -> float:
    """Return roughly how the output goes with the reference: it may run the other way, or count in units of its own."""
    if samples.rate is not None:
        rate = np.array([samples.rate[part].mean() for part in stretches])
    else:
        assert samples.heading is not None
        rate = np.array([_slope(samples.time[part], samples.heading[part]) for part in stretches])
    output = np.array([np.median(samples.output[part]) for part in stretches])
    # Rests alone tell nothing of it.
    return _slope(rate, output) if len(rate) > 1 and np.ptp(rate) > 1.0 * DEGREE else 1.0


def _not_steady(found: _Found, limits: Steadiness) -> str:
    straight = '' if found.samples.heading is None else f' and straight to {limits.heading / DEGREE:g} deg'
    return (f'the reference is steady to {limits.rate / DEGREE:g} deg/s{straight}, for {limits.duration:g} s at a time beside the '
            f'settling, in {100.0 * found.share:.0f} % of the log; hold each rate for longer, or use the heading itself with '
            '--method likelihood')


def _usable(log: Log) -> tuple[_Samples, list[str]]:
    """Return the samples that have output and reference, not too near to where the reference was lost, and what was lost."""
    output, time = _output(log), log.time
    reference = log.reference_heading if log.reference_rate is None else log.reference_rate
    if time is None or reference is None:
        raise DataRefused('the log has no time or no reference; to find dwells it needs time_s and one of reference_rate_dps and '
                          'reference_heading_deg')
    lost = ~np.isfinite(reference)
    # A reference that gets lost errs before and after; the tracker loses its markers one by one.
    good = np.flatnonzero(~maximum_filter1d(lost, 2 * _count(time, 0.05) + 1) & np.isfinite(output))
    if len(good) < _SAMPLES:
        raise DataRefused(f'{len(good)} of {len(time)} samples hold both a gyro output and a reference; look at the columns')
    rate, heading, temperature = (None if values is None else values[good]
                                  for values in (log.reference_rate, log.reference_heading, log.temperature))
    return _Samples(time[good], output[good], rate, heading, temperature), list(_lost_reference(time, lost))


def _count(time: Array, span: float) -> int:
    """Return the number of samples in a span, by the mean interval: stamps that come in bursts have no typical one."""
    steps = np.diff(time)
    return round(span / float(steps[steps < _PAUSE].mean())) if (steps < _PAUSE).any() else 0


def _lost_reference(time: Array, lost: Flags) -> Iterator[str]:
    places = [f'{time[start]:.2f} s' for start, _ in _runs(lost)]
    if places:
        yield f'the reference was lost {_times(len(places))}, for {lost.sum()} samples, at {_listed(places)}; they are left out'


def _times(count: int) -> str:
    return 'once' if count == 1 else f'{count} times'


def _runs(flags: Flags) -> list[tuple[int, int]]:
    """Return start and stop of each run of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags, [0]])))
    return [(int(start), int(stop)) for start, stop in zip(edges[::2], edges[1::2])]


def _steady(time: Array, rate: Array, limits: Steadiness) -> list[slice]:
    """Return the stretches whose reference rate is steady."""
    count = max(3, _count(time, limits.margin))
    # A single wild sample of the reference must not break a dwell.
    smooth = uniform_filter1d(median_filter(rate, 5, mode='nearest'), count, mode='nearest')
    stray = maximum_filter1d(smooth, count, mode='nearest') - minimum_filter1d(smooth, count, mode='nearest')
    allowed = float(np.clip(5.0 * np.median(stray), 0.02 * DEGREE, limits.rate))
    calm = stray <= allowed + limits.relative * np.abs(smooth)
    # The windows of both filters reach over a ramp's end; half of that is given back, the margin stays.
    calm = maximum_filter1d(calm, 2 * (count // 2) + 1)
    calm[1:] &= np.diff(time) <= limits.gap
    return [slice(start + part.start, start + part.stop) for start, stop in _runs(calm)
            for part in _level(uniform_filter1d(smooth[start:stop], 4 * count, mode='nearest'), allowed, limits)]


def _level(rate: Array, allowed: float, limits: Steadiness) -> Iterator[slice]:
    """Divide a stretch where its rate has wandered off: a slow ramp falls to pieces, too short to be dwells."""
    start, low, high = 0, math.inf, -math.inf
    for place, value in enumerate(rate.tolist()):
        low, high = min(low, value), max(high, value)
        if high - low > 2.0 * (allowed + limits.relative * abs(value)):
            yield slice(start, place)
            start, low, high = place, value, value
    yield slice(start, len(rate))


def code_step(values: Array) -> float:
    """Return the step of an encoder, or of any digital output, from the values that occur; next to nothing where it has no steps."""
    # Rounding in the file splits a step in two sizes, and fast turns leave codes out: neither the smallest nor the middle gap is it.
    gaps = np.diff(np.unique(values))
    gaps = gaps[gaps > 1e-9]
    return float(np.quantile(gaps, 0.05)) if len(gaps) else 0.0


def _straight(samples: _Samples, limits: Steadiness) -> list[slice]:
    """Return the stretches whose reference heading is a straight line in time, but for the steps of its encoder."""
    heading = samples.heading
    assert heading is not None
    step = code_step(heading)
    first = np.unique(np.floor((samples.time - samples.time[0]) / _BLOCK), return_index=True)[1]
    counts = np.diff(np.append(first, len(heading)))
    time, blocks = np.add.reduceat(samples.time, first) / counts, np.add.reduceat(heading, first) / counts
    tolerance = step + _crookedness(blocks, limits)
    edges = np.append(first, len(heading))
    parts: list[slice] = []
    for start, stop in _cones(time, blocks, 2.0 * tolerance, limits.gap):
        if time[stop - 1] - time[start] < 0.5 * limits.duration:
            continue
        part = _walked(time, blocks, start, stop, tolerance, step)
        # Two stretches of one dwell reach over each other; the longer one knows its line better.
        if parts and part.start < parts[-1].stop and _length(part) > _length(parts[-1]):
            parts.pop()
        if not (parts and part.start < parts[-1].stop):
            parts.append(part)
    whole = [slice(int(edges[part.start]), int(edges[part.stop])) for part in parts if _length(part) > 4]
    return [part for part in whole if _holds_its_slope(samples.time[part], heading[part], step, limits)]


def _length(part: slice) -> int:
    return int(part.stop - part.start)


def _crookedness(heading: Array, limits: Steadiness) -> float:
    """Return by how much the heading strays from a straight line within about a second, mostly, rad; within the limits."""
    # A vibration of the table is not seen over a whole number of its periods, so several lengths are looked at.
    reaches = [reach for reach in (2, 3, 5) if len(heading) > 2 * reach]
    strays = [np.abs(heading[reach:-reach] - 0.5 * (heading[2 * reach:] + heading[:-2 * reach])) for reach in reaches]
    stray = max((float(np.median(each)) for each in strays), default=math.inf)
    return float(np.clip(3.0 * stray, 0.02 * DEGREE, limits.heading))


def _cones(time: Array, heading: Array, tolerance: float, gap: float) -> Iterator[tuple[int, int]]:
    """Divide a heading, from its start, into the longest stretches that a straight line through their first point meets."""
    start, low, high = 0, -math.inf, math.inf
    times, headings = time.tolist(), heading.tolist()
    for place in range(1, len(times)):
        since = times[place] - times[start]
        rise = headings[place] - headings[start]
        low, high = max(low, (rise - tolerance) / since), min(high, (rise + tolerance) / since)
        if low > high or times[place] - times[place - 1] > gap:
            yield start, place
            start, low, high = place, -math.inf, math.inf
    yield start, len(times)


def _walked(time: Array, heading: Array, start: int, stop: int, tolerance: float, step: float) -> slice:
    """Fit a line to the middle of a stretch, walk from there as far as it holds, and step back from the ramps."""
    length = stop - start
    fifth = length // 5
    middle = slice(start + fifth, stop - fifth)
    # Not beyond as much again at both ends, so that the work does not grow with the square of the log.
    first, last = max(0, start - length), min(len(time), stop + length)
    line = heading[middle].mean() + _slope(time[middle], heading[middle]) * (time[first:last] - time[middle].mean())
    stray = np.abs(heading[first:last] - line)
    beyond = np.flatnonzero(stray > tolerance)
    before, after = beyond[beyond < middle.start - first], beyond[beyond >= middle.stop - first]
    begin = 0 if not len(before) else int(before[-1]) + 1 + _step_back(stray[before[-1]::-1], tolerance, step)
    end = len(stray) if not len(after) else int(after[0]) - _step_back(stray[after[0]:], tolerance, step)
    return slice(first + begin, first + max(begin, end))


def _step_back(stray: Array, tolerance: float, step: float) -> int:
    """
    Return how many blocks of a ramp hide within the tolerance, from how the heading strays beyond.

    On a ramp it strays with the square of time, so the ratio of two strays tells when it began; a short ramp began later.

    """
    reach = round(0.5 / _BLOCK)
    if len(stray) <= reach:
        return 0
    ratio = math.sqrt(max(1.0, stray[reach] / (tolerance + 0.5 * step)))
    return math.ceil(min(3.0 / _BLOCK, reach / (ratio - 1.0) if ratio > 1.0 else math.inf))


def _holds_its_slope(time: Array, heading: Array, step: float, limits: Steadiness) -> bool:
    """Tell whether the quarters of a stretch have one slope: a slow swing is straight for a while, but not steady."""
    quarters = [quarter for quarter in np.array_split(np.arange(len(time)), 4) if len(quarter) > 2]
    slopes = np.array([_slope(time[quarter], heading[quarter]) for quarter in quarters])
    blur = 8.0 * step / (time[-1] - time[0])
    return bool(np.ptp(slopes) <= 2.0 * (limits.rate + limits.relative * np.abs(slopes).max()) + blur)


def _slope(time: Array, heading: Array) -> float:
    centred = time - time.mean()
    return float(centred @ heading / (centred @ centred))


class _Cleaned(NamedTuple):
    """The rows of a stretch, and those that are left out of it."""

    rows: Numbers
    wild: Numbers
    stuck: Numbers

    @classmethod
    def of(cls, samples: _Samples, part: slice, limits: Steadiness) -> _Cleaned:
        rows = np.arange(part.start, part.stop)
        stuck = _stuck(samples.output[part])
        moving = rows[~stuck]
        wild = _wild(samples.error[moving], limits.wild)
        return cls(moving[~wild], moving[wild], rows[stuck])


def _wild(error: Array, limit: float) -> Flags:
    """Mark single samples far from their neighbours and from the rest: neither a drift nor a vibration of the table is wild."""
    if len(error) < 4:
        return np.zeros(len(error), dtype=bool)
    # The median of six neighbours resists two wild ones among them.
    edged = np.pad(error, 3, mode='reflect')
    alone = error - np.median([edged[place:place + len(error)] for place in (0, 1, 2, 4, 5, 6)], axis=0)
    # An output of few codes agrees with its neighbours mostly: then the code is the measure.
    least = max(code_step(error), 1e-9)
    return _far(alone, limit, least) & _far(error - np.median(error), limit, least)


def _far(values: Array, limit: float, least: float) -> Flags:
    return np.abs(values) > limit * max(1.4826 * float(np.median(np.abs(values))), least)


def _stuck(output: Array) -> Flags:
    """Mark the repeats in runs of one value that are longer than the share of this value in the stretch explains."""
    share = np.unique(output, return_counts=True)[1].max() / len(output)
    # Mostly one value: a gyro of coarse codes at rest, or a simulation without noise. That cannot be told from a stuck one.
    if share > 0.9:
        return np.zeros(len(output), dtype=bool)
    longest = math.log(1e-6 / len(output)) / math.log(share)
    stuck = np.zeros(len(output), dtype=bool)
    for start, stop in _runs(np.concatenate([[False], np.diff(output) == 0.0])):
        stuck[start:stop] = stop - start > longest
    return stuck


def _settled(samples: _Samples, rows: list[Numbers], limits: Steadiness) -> tuple[list[Numbers], list[str]]:
    """Cut off both ends as far as the gyro still, or already, answers a ramp there, and the margin at least."""
    time, error = samples.time, samples.error
    change = np.diff([np.median(samples.output[part]) for part in rows])
    # Where much time passes between two dwells, what happened there is not the change from one to the other.
    apart = np.array([time[later[0]] - time[part[-1]] for part, later in zip(rows, rows[1:])])
    change = np.where(apart < 5.0, change, 0.0)
    after = _settling(time, error, rows[1:], change, limits)
    before = _settling(-time[::-1], error[::-1], [(len(time) - 1 - part)[::-1] for part in rows[:-1]], -change, limits)
    after, before = max(after, limits.margin), max(before, limits.margin)
    kept = [part[(time[part] >= time[part[0]] + after) & (time[part] <= time[part[-1]] - before)] for part in rows]
    return kept, [f'{after:.2f} s after each ramp and {before:.2f} s before the next are cut away']


def _settling(time: Array, error: Array, rows: list[Numbers], change: Array, limits: Steadiness) -> float:
    """
    Return for how long after a ramp the output is not yet what it stays at, s.

    Whatever is linear (a filter, a delay) answers in proportion to the change of rate, so all dwells together show an answer that is
    hidden in the noise of each. Its own scatter later in the dwells is the measure of what is seen.

    """
    interval = max(0.05, float(np.median(np.diff(time))))
    lengths = np.array([time[part[-1]] - time[part[0]] for part in rows])
    if not len(lengths):
        return 0.0
    count = int(min(np.quantile(lengths, 0.25), 3.0 * limits.settling) / interval)
    edges = np.arange(count + 1) * interval
    used = [(part, step) for part, step, length in zip(rows, change, lengths) if length >= edges[-1]]
    answer = np.array([_binned(time[part] - time[part[0]], error[part], edges) for part, _ in used])
    late = slice(count // 2, None)
    weight = np.array([step for _, step in used])
    if not weight.any():
        return 0.0
    answer = weight @ (answer - answer[:, late].mean(axis=1, keepdims=True)) / (weight @ weight)
    # Bins, and what a few of them show together; it is looked for in the first third, the last half is the measure.
    return max(_last_seen(answer, width) for width in (1, 4)) * interval


def _binned(time: Array, values: Array, edges: Array) -> Array:
    """Return the mean of some values in each bin; bridges gaps."""
    return np.diff(np.interp(edges, time, _integral(time, values))) / np.diff(edges)


def _integral(time: Array, values: Array) -> Array:
    return np.concatenate([[0.0], np.cumsum(0.5 * np.diff(time) * (values[1:] + values[:-1]))])


def _last_seen(answer: Array, width: int) -> int:
    """Return the number of bins until the answer, averaged over some bins, stays within four of its later deviations."""
    if len(answer) < 8 * width:
        return 0
    smooth = uniform_filter1d(answer, width, mode='nearest')
    # An answer of 20 ppm of the change is not worth a cut, even where no noise hides it.
    spread = max(float(smooth[len(smooth) // 2:].std()), 2e-5)
    last = -1
    for place in np.flatnonzero(np.abs(smooth[:len(smooth) // 3]) > 4.0 * spread):
        # After ten quiet bins it is over; what is seen later is chance.
        last = int(place) if place - last <= 10 else last
    return last + 1 + width // 2 if last >= 0 else 0


def _divided(samples: _Samples, rows: list[Numbers], limits: Steadiness) -> tuple[list[Numbers], list[str]]:
    """Divide the dwells along which the temperature changes, so that its slope can be seen."""
    if samples.temperature is None:
        return rows, []
    pieces = [_pieces(samples.time[whole], samples.temperature[whole], limits) for whole in rows]
    parts = [part for whole, count in zip(rows, pieces) for part in np.array_split(whole, count)]
    more = len(parts) - len(rows)
    remark = f'dwells that warmed or cooled by more than {limits.temperature:g} K are divided, which makes {more} more'
    return parts, [remark] if more else []


def _pieces(time: Array, temperature: Array, limits: Steadiness) -> int:
    if len(temperature) < 2 * _MOST_BATCHES:
        return 1
    change = float(np.ptp([batch.mean() for batch in np.array_split(temperature, _MOST_BATCHES)]))
    return max(1, min(math.ceil(change / limits.temperature), int((time[-1] - time[0]) / limits.duration)))


def _left_out(samples: _Samples, rows: list[Numbers], found: list[_Cleaned]) -> list[str]:
    """Say which wild and stuck samples stand within the dwells."""
    inside = _inside(samples.time, rows)
    wild = [row for part in found for row in part.wild if inside[row]]
    stuck = np.zeros(len(samples.time), dtype=bool)
    stuck[[row for part in found for row in part.stuck]] = True
    runs = _runs(stuck & inside)
    remarks = []
    if wild:
        remarks.append(f'wild samples, left out: {len(wild)}, at {_listed([f"{samples.time[row]:.2f} s" for row in wild])}')
    if runs:
        places = [f'{samples.time[start]:.2f} s ({stop - start} samples)' for start, stop in runs]
        remarks.append(f'the output was stuck {_times(len(runs))}, at {_listed(places)}; the repeats are left out')
    return remarks


def _inside(time: Array, rows: list[Numbers]) -> Flags:
    inside = np.zeros(len(time), dtype=bool)
    for part in rows:
        inside[part[0]:part[-1] + 1] = True
    return inside


def _lost_samples(log: Log, samples: _Samples, rows: list[Numbers]) -> Iterator[str]:
    """Say how many samples of the gyro are missing within the dwells, where the stamps are regular enough to tell."""
    assert log.time is not None and log.output is not None
    time = log.time[np.isfinite(log.output)]
    steps = np.diff(time) / np.median(np.diff(time))
    if np.mean(np.abs(steps - 1.0) > 0.25) > 0.1:
        yield 'the stamps are too irregular to count lost samples'
        return
    inside = np.interp(time[1:], samples.time, _inside(samples.time, rows)) > 0.5
    gaps = np.flatnonzero((steps > 1.5) & inside)
    if len(gaps):
        lost = int(np.sum(np.round(steps[gaps]) - 1))
        yield (f'samples missing within the dwells: {lost}, after {_listed([f"{time[gap]:.2f} s" for gap in gaps])}; at a steady rate '
               'that does no harm')


def _little(share: float) -> str:
    return f'only {100.0 * share:.0f} % of the time is in dwells; --method likelihood uses all of it, where there is a heading'


def _means(found: _Found) -> Dwells:
    """Average each dwell (Ojeda et al., eq. 6)."""
    samples, rows, remarks = found
    time, temperature = samples.time, samples.temperature
    durations = np.array([time[part[-1]] - time[part[0]] for part in rows])
    halves = np.array([len(part) // 2 for part in rows])
    counts = np.clip(np.minimum(durations / _BATCH, halves), _FEWEST_BATCHES, _MOST_BATCHES).astype(int)
    average = _average_rates if samples.rate is not None else _average_slopes
    rate, mean, variance, blur = average(samples, rows, counts)
    # White noise in a mean goes with 1 / duration, so dwells are alike in the product.
    deviation = np.sqrt(moderated(variance * durations, counts - 1) / durations + blur ** 2)
    return Dwells(rate, mean, None if temperature is None else np.array([temperature[part].mean() for part in rows]),
                  np.where(deviation > 0.0, deviation, np.nan), _sweeps(rate),
                  tuple(f'{time[part[0]]:.1f} to {time[part[-1]]:.1f} s' for part in rows), remarks)


def _average_rates(samples: _Samples, rows: list[Numbers], counts: Numbers) -> tuple[Array, Array, Array, Array]:
    """Average dwells against a rate: rate, output, the variance of the output against it, and nothing else that blurs it."""
    assert samples.rate is not None
    rate, output = (np.array([values[part].mean() for part in rows]) for values in (samples.rate, samples.output))
    variance = [_variance([batch.mean() for batch in np.array_split(samples.error[part], count)]) for part, count in zip(rows, counts)]
    return rate, output, np.array(variance), np.zeros(len(rows))


def _average_slopes(samples: _Samples, rows: list[Numbers], counts: Numbers) -> tuple[Array, Array, Array, Array]:
    """
    Average dwells against a heading: rate, output, the variance of the output, and the deviation that the encoder's steps add.

    The rate is the slope of the heading. The output is averaged by the slope of its integral, with the same weights, so that what the
    table really does besides its steady rate is the same in both.

    """
    assert samples.heading is not None
    step = code_step(samples.heading)
    times, headings = ([values[part] for part in rows] for values in (samples.time, samples.heading))
    integrals = [_integral(samples.time[part], samples.output[part]) for part in rows]
    rate, output = (np.array([_slope(*pair) for pair in zip(times, angles)]) for angles in (headings, integrals))
    errors = [integral - samples.scale * heading for integral, heading in zip(integrals, headings)]
    # Both scatters hold too much: what the table does, or the encoder's steps. The smaller one holds less of it.
    scatters = [np.array([_variance(_batch_slopes(*each)) for each in zip(times, angles, counts)]) for angles in (integrals, errors)]
    variance = min(scatters, key=lambda scatter: float(np.median(scatter)))
    blur = abs(samples.scale) * np.array([_blur(heading, step, time[-1] - time[0]) for heading, time in zip(headings, times)])
    return rate, output, variance, blur


def _variance(batches: Sequence[float]) -> float:
    """Return the variance of the mean of some batches: what is correlated within a batch is counted once."""
    return float(np.var(batches, ddof=1)) / len(batches)


def _batch_slopes(time: Array, angle: Array, count: int) -> list[float]:
    return [_slope(time[batch], angle[batch]) for batch in np.array_split(np.arange(len(time)), count)]


def _blur(heading: Array, step: float, duration: float) -> float:
    """
    Return the standard deviation of a heading's slope that the steps of an ideal encoder cause, rad/s.

    Over M steps it is about 0.35 step / (M duration), and below one 0.6 step / duration (by simulation). Each step is seen late by up to
    a sample, which adds the square root of M over the number of samples. A heading that stays on one step for the whole dwell is a
    rest: nothing turns that slowly.

    """
    if np.ptp(heading) <= 0.5 * step or step == 0.0:
        return 0.0
    steps = abs(heading[-1] - heading[0]) / step
    samples = len(heading)
    return step / duration * math.hypot(0.35 / max(steps, 0.6), math.sqrt(min(steps, samples)) / samples)


def moderated(variance: Array, freedom: Array) -> Array:
    """
    Move each of some variances toward what they have in common, the more the less each knows and the more they agree.

    A variance out of a dozen batches errs by 40 %; weights made of it would be chance, and the smallest ones would rule the fit.
    Empirical Bayes with an inverse gamma prior (Smyth 2004, sections 3 and 6.2): the scatter of their logarithms beyond that of
    chance tells the degrees of freedom of the prior.

    Parameters
    ----------
    variance : shape (n,)
    freedom : degrees of freedom of each, shape (n,)

    """
    known = variance > 0.0
    if known.sum() < 3:
        return variance
    own = freedom[known] / 2.0
    logarithm = np.log(variance[known]) - digamma(own) + np.log(own)
    excess = float(logarithm.var(ddof=1) - polygamma(1, own).mean())
    if excess <= 0.0:
        return np.full(len(variance), np.average(variance[known], weights=own))
    prior = 2.0 * _inverse_trigamma(excess)
    common = math.exp(logarithm.mean() + digamma(prior / 2.0) - math.log(prior / 2.0))
    return np.where(known, (prior * common + freedom * variance) / (prior + freedom), common)


def _inverse_trigamma(value: float) -> float:
    """Solve trigamma(x) = value by Newton's steps on 1 / trigamma, which is nearly straight (Smyth 2004, appendix)."""
    x = 0.5 + 1.0 / value
    for _ in range(20):
        x += float(polygamma(1, x) * (1.0 - polygamma(1, x) / value) / polygamma(2, x))
    return x
