"""
Dwells: stretches of constant rate, each one row of means, out of which a rate table's calibration is made.

A rate table without time holds them already. In a log in time they are found: where the reference is steady, without the ramps and
the settling after them.

"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, minimum_filter1d, uniform_filter1d

from gyro_calibration.log import DEGREE, Array, DataRefused, Log

Flags = NDArray[np.bool_]
Numbers = NDArray[np.integer[Any]]

#: Sweeps shorter than this on the whole are no sweeps but chance.
_ROWS_OF_A_SWEEP = 4
#: Blocks of consecutive dwells, where the order tells no sweeps.
_BLOCKS = 9
#: Batches of a dwell, whose scatter gives the deviation of the mean.
_BATCHES = 12


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
    duration : shorter ones are left out, s
    margin : cut at both ends at least, s; holds a time offset between gyro and reference away from the means
    rate : the mean reference over a quarter of a second strays less than this from its middle, rad/s; less where the reference is quieter
    relative : and less than this part of the rate, 1
    gap : over longer gaps nobody knows what the reference did, s
    temperature : a dwell that warms by more than this is divided, K

    """

    duration: float = 2.0
    margin: float = 0.25
    rate: float = 0.5 * DEGREE
    relative: float = 0.005
    gap: float = 1.0
    temperature: float = 1.0


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
    turning = np.abs(rate) > 1e-3 * np.abs(rate).max()
    for used in (np.full(len(rate), True), turning):
        for value in (rate, np.abs(rate)):
            sweep = np.zeros(len(rate), dtype=int)
            sweep[used] = _passes(value[used])
            # A rest belongs to the dwell before it.
            sweep = np.maximum.accumulate(np.where(used, sweep, 0))
            lengths = np.bincount(sweep)
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
    output = _output(log)
    time, rate = log.time, log.reference_rate
    if time is None or rate is None:
        raise DataRefused('the log holds no reference rate')
    good = np.flatnonzero(np.isfinite(output) & np.isfinite(rate))
    time, rate, output = time[good], rate[good], output[good]
    temperature = None if log.temperature is None else log.temperature[good]
    parts = [_cut(time, part, limits) for part in _steady(time, rate, limits)]
    parts = [part for part in parts if part.stop > part.start + _BATCHES and time[part.stop - 1] - time[part.start] >= limits.duration]
    if not parts:
        raise DataRefused(f'the reference is nowhere steady to {limits.rate / DEGREE:g} deg/s for {limits.duration:g} s; '
                          'hold each rate for longer, or use the heading itself with --method likelihood')
    means = np.array([(rate[part].mean(), output[part].mean()) for part in parts])
    deviation = np.array([_scatter(output[part] - rate[part]) for part in parts])
    return Dwells(means[:, 0], means[:, 1], None if temperature is None else np.array([temperature[part].mean() for part in parts]),
                  deviation, _sweeps(means[:, 0]), tuple(f'{time[part.start]:.1f} to {time[part.stop - 1]:.1f} s' for part in parts))


def _steady(time: Array, rate: Array, limits: Steadiness) -> list[slice]:
    """Return the stretches whose reference rate is steady."""
    count = max(3, round(limits.margin / float(np.median(np.diff(time)))))
    smooth = uniform_filter1d(rate, count, mode='nearest')
    stray = maximum_filter1d(smooth, count, mode='nearest') - minimum_filter1d(smooth, count, mode='nearest')
    allowed = np.clip(3.0 * np.median(stray), 0.02 * DEGREE, limits.rate)
    calm = stray <= allowed + limits.relative * np.abs(smooth)
    calm[1:] &= np.diff(time) <= limits.gap
    edges = np.flatnonzero(np.diff(np.concatenate([[0], calm, [0]])))
    return [part for start, stop in zip(edges[::2], edges[1::2]) for part in _level(smooth, int(start), int(stop), allowed, limits)]


def _level(smooth: Array, start: int, stop: int, allowed: float, limits: Steadiness) -> Iterator[slice]:
    """Divide a stretch where its rate has wandered off: a slow ramp falls to pieces, too short to be dwells."""
    low = high = float(smooth[start])
    for place, value in enumerate(smooth[start:stop].tolist(), start):
        low, high = min(low, value), max(high, value)
        if high - low > 2.0 * (allowed + limits.relative * abs(value)):
            yield slice(start, place)
            start, low, high = place, value, value
    yield slice(start, stop)


def _cut(time: Array, part: slice, limits: Steadiness) -> slice:
    """Cut the margin off both ends."""
    begin, end = time[part.start] + limits.margin, time[part.stop - 1] - limits.margin
    return slice(int(np.searchsorted(time, begin)), int(np.searchsorted(time, end, side='right')))


def _scatter(error: Array) -> float:
    """Return the standard deviation of a mean, by batch means."""
    batches = np.array([batch.mean() for batch in np.array_split(error, _BATCHES)])
    return float(batches.std(ddof=1)) / math.sqrt(_BATCHES)
