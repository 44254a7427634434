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
Dwells: stretches of constant rate, each one row of means, to which a calibration is fitted.

They are the rows of a rate table without time, or found in a log in time: there the reference
heading, or the integral of the reference rate, is a straight line but for the steps of an encoder.
Ramps, the settling of the gyro after them, outliers and repeated samples are left out.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import compress
import math
from typing import Any, NamedTuple

from gyro_calibration.calibration.run_faults import (
    fit_scale, MAX_UNEXPLAINED_SHARE, refuse_unit_error)
from gyro_calibration.calibration.self_calibration import refuse_scale
from gyro_calibration.heading.integration import integrate
from gyro_calibration.logs.log import Array, DataRefused, DEGREE, Log, Mask
from gyro_calibration.logs.quality import (
    find_runs, largest_divisor, mark_rows, mask_outliers, mask_repeated_samples,
    quantization_step)
from gyro_calibration.logs.stamps import Integers as Numbers
import numpy as np
from scipy.ndimage import maximum_filter1d, uniform_filter1d

#: Minimum number of samples of a dwell, and minimum duration after all cuts, s.
_MIN_SAMPLES, _MIN_DURATION = 8, 1.5
#: Largest deviation of the heading from a straight line beyond its steps, rad.
_MAX_DEVIATION = 0.5 * DEGREE
#: A dwell or a sample beyond this many robust standard deviations is outlying.
OUTLIER_THRESHOLD = 6.0
#: Minimum spread of temperatures, K; a smaller one is not distinguishable from sensor errors.
MIN_TEMPERATURE_SPREAD = 1.0
#: Minimum share of a log in dwells, and share up to which another method is the default.
MIN_DWELL_SHARE, FEW_DWELLS_SHARE = 0.05, 0.25
#: Duration of the blocks in which the heading is averaged, s, and how many of them show a ramp.
_BLOCK_DURATION, _RAMP_BLOCKS = 0.1, 5


@dataclass(frozen=True)
class Dwells:
    """Means over stretches of constant rate (Ojeda et al., eq. 5 to 7), arrays of shape (n,)."""

    rate: Array  # of the reference, rad/s
    output: Array  # of the gyro, rad/s
    temperature: Array | None  # degC; None where the log holds none
    deviation: Array  # of output against reference, rad/s; nan if unknown
    sweep: Numbers  # number of the sweep, or block of time, which cross-validation leaves out
    location: tuple[str, ...]  # of each dwell in its file, for messages
    remarks: tuple[str, ...] = ()  # on what was found and left out, one sentence each
    rows: tuple[Numbers, ...] = ()  # of the log, whose mean each dwell is
    # standard deviation of the error by the steps of the output, rad/s, which dwells share
    # (`step_covariance`); shape (n,), or empty
    rounding: Array = field(default_factory=lambda: np.empty(0))

    def __len__(self) -> int:
        return len(self.rate)


def extract_dwells(log: Log, name: str = '', min_share: float = MIN_DWELL_SHARE) -> Dwells:
    """
    Return the dwells of a log: the rows of a rate table, or stretches of a log in time.

    The name of a file is put before places and remarks. `DataRefused` is raised where something is
    missing, in another unit, or where less than `min_share` of a log in time is in dwells.
    """
    found = dwells_from_table(log) if log.time is None else find_dwells(log, min_share)
    if log.time is not None and not name:  # several logs may have a rate each
        # dwells over less than half of the rates of the log, such as rests alone
        low, high = np.nanquantile(require_output(log), [0.01, 0.99])
        if np.ptp(found.rate) < 0.5 * (high - low):
            raise NothingSteady(
                f'the reference is steady at {found.rate.min() / DEGREE:.1f} to '
                f'{found.rate.max() / DEGREE:.1f} deg/s only, and the gyro shows '
                f'{low / DEGREE:.1f} to {high / DEGREE:.1f} deg/s; hold faster rates for longer, '
                'or use --method likelihood')
    unexplained, scale = fit_scale(found.output, found.rate)
    if unexplained <= MAX_UNEXPLAINED_SHARE and log.counts is None:  # of counts it is wanted
        refuse_unit_error(scale, 'reference')
        refuse_scale(scale - 1.0, 'reference', 'give or omit --invert, or turn the gyro over')
    if (limited := _mark_limited(log, found)).any():
        places = [place for place, at_limit in zip(found.location, limited) if at_limit]
        remark = (f'{len(places)} dwells are at the limit of the output, '
                  f'{np.abs(found.output[limited]).max() / DEGREE:.4g} deg/s, and left out: '
                  f'{format_list(places)}')
        output = np.array(log.output)
        output[np.concatenate(list(compress(found.rows, limited)))] = math.nan
        log = replace(log, output=output)
        found = dwells_from_table(log) if log.time is None else find_dwells(log, 0.0)
        found = replace(found, remarks=(remark, *found.remarks))
    if not name:
        return found
    return replace(found, location=tuple(f'{name}: {place}' for place in found.location),
                   remarks=tuple(f'{name}: {remark}' for remark in found.remarks))


def _mark_limited(log: Log, dwells: Dwells) -> Mask:
    """
    Return which dwells are at a limit of the output of their log, in one sense or both, (n,).

    A line through the others is beyond it at each of their rates, and leaves far less than a line
    and one more effect of the rate through all; or they alone have no noise.
    """
    output, nothing = require_output(log), np.zeros(len(dwells), dtype=bool)
    ends = np.array([np.nanmin(output), np.nanmax(output)])
    step = largest_divisor(np.unique(output[np.isfinite(output)]) - ends[0])
    constant = np.array([np.ptp(output[rows]) == 0.0 for rows in dwells.rows])
    rate = dwells.rate / max(float(np.abs(dwells.rate).max()), 1e-9)
    line = np.column_stack([np.ones(len(rate)), rate])

    def residual(columns: Array, rows: Mask) -> Array:
        return np.asarray(dwells.output - columns @ np.linalg.lstsq(
            columns[rows], dwells.output[rows], rcond=None)[0])

    instead = min(float(np.sum(residual(np.column_stack([line, effect]), ~nothing) ** 2))
                  for effect in (np.abs(rate), rate ** 2, rate ** 3))
    for extremes in (ends, ends[:1], ends[1:]):
        limited = np.array([np.isclose(output[rows][:, None], extremes, 1e-9, 0.0).any(
            axis=1).mean() > 0.5 for rows in dwells.rows])
        if limited.sum() < 2 or len(np.unique(rate[~limited])) < 3:
            continue
        off = residual(line, ~limited)
        left = float(np.sum(off[~limited] ** 2)) + len(rate) * step ** 2 / 12.0
        is_beyond = -np.sign(dwells.output[limited]) * off[limited] > 0.0
        if is_beyond.all() and ((limited == constant).all()
                                or instead > OUTLIER_THRESHOLD * left):
            return limited
    return nothing


def select_dwells(dwells: Dwells, mask: Mask) -> Dwells:
    """Return some of the dwells, by a mask of shape (n,)."""
    chosen: dict[str, Any] = {
        name: tuple(compress(values, mask)) if isinstance(values, tuple) else values[mask]
        for name, values in vars(dwells).items()
        if name != 'remarks' and values is not None and len(values)}
    return replace(dwells, **chosen)


def join_dwells(parts: Sequence[Dwells]) -> Dwells:
    """Return the dwells of several logs as one, without temperature if one has none."""
    if not parts:
        raise DataRefused('no dwells were given; give at least one log')
    first_sweep = np.cumsum([0] + [int(part.sweep.max()) + 1 for part in parts])
    temperatures = [part.temperature for part in parts if part.temperature is not None]
    has_temperature = len(temperatures) == len(parts)
    remarks = sum((part.remarks for part in parts), ())
    if temperatures and not has_temperature:
        remarks += (f'{len(parts) - len(temperatures)} of {len(parts)} logs hold no temperature, '
                    'so that of the others is not used',)
    rate, output, deviation, rounding = (
        np.concatenate([getattr(part, name) for part in parts])
        for name in ('rate', 'output', 'deviation', 'rounding'))
    sweep = np.concatenate([part.sweep + number for part, number in zip(parts, first_sweep)])
    return Dwells(rate, output, np.concatenate(temperatures) if has_temperature else None,
                  deviation, sweep, sum((part.location for part in parts), ()), remarks,
                  sum((part.rows for part in parts), ()),
                  rounding if len(rounding) == len(rate) else np.empty(0))


def require_output(log: Log) -> Array:
    """Return the output of a log, or refuse it."""
    if log.output is None:
        raise DataRefused('the log holds no gyro output in rad/s; with gyro_counts alone, say how '
                          'many deg/s a count is')
    if not np.isfinite(log.output).any():
        raise DataRefused('the output of the gyro has no numbers: check its column, and the line '
                          'that it came by')
    return log.output


def format_list(items: Sequence[str]) -> str:
    """Return the first five words, separated by commas, and the number of further ones."""
    return ', '.join(items[:5]) + (f' and {len(items) - 5} more' if len(items) > 5 else '')


# rate tables

def dwells_from_table(log: Log) -> Dwells:
    """Return the rows of a rate table, by its columns `sweep` and `deviation_dps` if present."""
    output = require_output(log)
    if log.reference_rate is None:
        raise DataRefused('the rows have no time and no reference rate; a rate table needs the '
                          'column reference_rate_dps')
    good = np.isfinite(output) & np.isfinite(log.reference_rate)
    if not good.any():
        raise DataRefused(f'none of the {len(output)} rows holds both a gyro output and '
                          'a reference rate; check the columns')
    rows, lost = np.flatnonzero(good), np.flatnonzero(~good) + 1
    remark = (f'{len(lost)} rows without output or reference are left out: '
              f'{format_list([str(row) for row in lost])}')
    rate, names = log.reference_rate[rows], log.others.get('sweep')
    remarks = [remark] if len(lost) else []
    if names is None:
        sweep, how = _number_sweeps(rate)
        remarks.append(f'without a column sweep, the {sweep[-1] + 1} sweeps are {how}')
    else:
        sweep = np.array([list(dict.fromkeys(names)).index(names[row]) for row in rows])
    try:
        deviation: Array = np.array(log.others.get(
            'deviation_dps', [math.nan] * len(log)), dtype=float)[rows] * DEGREE
        deviation[~(deviation > 0.0)] = math.nan
    except ValueError as error:
        raise DataRefused(f'column deviation_dps: {error}; wanted deg/s, '
                          'or nan where it is not known') from None
    output, temperature = output[rows], None if log.temperature is None else log.temperature[rows]
    # The step is the largest one that all differences are multiples of. Where they are on a line,
    # as of a gyro without errors, it is at most 1 deg/s.
    changes = output - output[0]
    step = largest_divisor(changes)
    if fit_scale(output, rate)[0] * np.sum((output - output.mean()) ** 2) < (1e-3 * step) ** 2:
        step = largest_divisor(np.append(changes, DEGREE))
    # of means over many samples it is that of the digits of the file
    rounding = np.full(len(rate), step / math.sqrt(12.0))
    of_steps = _independent_deviation(rate, output, rounding)
    deviation = np.hypot(deviation, of_steps) if (deviation > 0.0).any() else of_steps
    return Dwells(rate, output, temperature, np.where(deviation > 0.0, deviation, np.nan), sweep,
                  tuple(f'row {row + 1}' for row in rows), tuple(remarks),
                  tuple(np.split(rows, len(rows))), rounding)


def _number_sweeps(rate: Array) -> tuple[Numbers, str]:
    """
    Return the number of the sweep of each dwell, by the order of the rates, shape (n,), and how.

    The rates of a sweep, or their absolute values with changing sign, increase or decrease:
    whichever gives the fewest sweeps. Where their median has less than four dwells, blocks are
    taken as sweeps.
    """
    number, largest = np.arange(len(rate)), float(np.abs(rate).max(initial=0.0))
    turning = np.abs(rate) > max(1e-3 * largest, 0.01 * DEGREE)
    # Mean rates of opposite sign differ slightly in absolute value.
    tolerance = 0.005 * largest
    if turning.any():
        passes = min((_number_passes(value, tolerance)
                      for value in (rate[turning], np.abs(rate[turning]))),
                     key=lambda each: int(each[-1]))
        # Of the rests between two sweeps, as many as precede the first sweep begin the next.
        places, count = np.flatnonzero(turning), np.cumsum(turning)
        after = np.minimum(count, len(places) - 1)
        begins = ~turning & (places[after] - number <= places[0])
        sweep = passes[np.where(begins, after, np.maximum(count - 1, 0))]
        lengths = np.bincount(passes)
        lengths += np.bincount(sweep) > lengths  # the rests of a sweep are one of its rates
        if passes[-1] and np.median(lengths) >= 4:
            return sweep, 'numbered by the order of the rates'
    return (number * min(9, len(rate)) // len(rate),
            'blocks of consecutive dwells, since the order of the rates shows no sweeps')


def _number_passes(value: Array, tolerance: float) -> Numbers:
    """
    Assign numbers to passes through values; a pass begins where the direction reverses.

    Values that are repeated where passes turn belong to both in equal parts.
    """
    change = np.diff(value)
    steps = np.where(np.abs(change) > tolerance, np.sign(change), 0.0)
    numbers = np.zeros(len(value), dtype=int)
    direction, last_step = 0.0, 0
    for place, step in enumerate(steps, 1):
        is_reversed = step * direction < 0.0
        numbers[place] = numbers[place - 1] + is_reversed
        if is_reversed and step * next((each for each in steps[place:] if each), 0.0) > 0.0:
            numbers[place - (place - last_step) // 2: place] += 1
        # The jump back to the start of the next pass does not show its direction.
        direction = 0.0 if is_reversed else direction or step
        last_step = place if step else last_step
    return numbers


# the reference of a log in time

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


class NothingSteady(DataRefused):
    """The reference of a log in time is hardly ever steady, so that it shows no dwells."""


class _Samples(NamedTuple):
    """Samples with output and reference, arrays of shape (n,)."""

    time: Array
    output: Array
    rate: Array | None
    heading: Array  # of the reference, or the integral of its rate
    step: float  # of an encoder, rad
    output_step: float  # rad/s; 0 without one
    temperature: Array | None
    scale: float = 1.0  # approximate ratio of output to reference

    @property
    def error(self) -> Array:
        """Return the output, less the share of a reference rate: it is steady in a dwell."""
        return self.output if self.rate is None else self.output - self.scale * self.rate

    def duration(self, rows: Numbers | slice) -> float:
        """Return the time from the first to the last sample of a part of the log, s."""
        return float(np.ptp(self.time[rows]))

    def slope(self, rows: Numbers, angle: Array) -> float:
        """Return the mean rate of an angle over some samples, rad/s."""
        time = self.time[rows]
        return (fit_scale(angle, time)[1] if self.rate is None
                else float((angle[-1] - angle[0]) / (time[-1] - time[0])))


def _select_samples(log: Log) -> tuple[_Samples, list[str]]:
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
    # Motion capture loses its markers one by one. Stamps may come in bursts: the mean counts.
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
    return _Samples(time[good], output[good], None if rate is None else rate[good], angle,
                    quantization_step(angle) if rate is None else 0.0,
                    _find_output_step(output[good]),
                    None if log.temperature is None else log.temperature[good]), (
                        [remark] if places else [])


def _find_output_step(output: Array) -> float:
    """Return the step of an output, rad/s: of few codes too, and of codes rounded to 1 % of it."""
    exact, step = largest_divisor(np.unique(output) - output.min()), quantization_step(output)
    return exact if exact > 0.01 * step else step


# dwells of a log in time

def find_dwells(log: Log, min_share: float = MIN_DWELL_SHARE) -> Dwells:
    """Find the dwells of a log in time by its reference heading, or else by its reference rate."""
    samples, remarks = _select_samples(log)
    time, temperature = samples.time, samples.temperature
    parts = [np.arange(part.start, part.stop) for part in _find_straight(samples)
             if samples.duration(part) > _MIN_DURATION]
    rates = np.array([samples.slope(rows, samples.heading[rows]) for rows in parts])
    if len(rates) > 1 and np.ptp(rates) > 1.0 * DEGREE:  # rests alone do not determine the scale
        outputs = np.array([np.median(samples.output[rows]) for rows in parts])
        samples = samples._replace(scale=fit_scale(outputs, rates)[1])
    is_outlier, is_repeated = np.zeros((2, len(time)), dtype=bool)
    kept = []
    for part in parts:
        is_repeated[part] = mask_repeated_samples(samples.output[part])
        fresh = part[~is_repeated[part]]
        is_outlier[fresh] = mask_outliers(samples.error[fresh], OUTLIER_THRESHOLD,
                                          samples.output_step)
        kept.append(fresh[~is_outlier[fresh]])
    # 0.25 s at least, for a time offset; it shows before a ramp, in the mirrored log
    error, rate_change = samples.error, np.diff([np.median(samples.output[rows]) for rows in kept])
    mirrored = [(len(time) - 1 - rows)[::-1] for rows in kept[:-1]]
    after, before = (max(0.25, _settling_time(*each))
                     for each in ((time, error, kept[1:], rate_change),
                                  (-time[::-1], error[::-1], mirrored, -rate_change)))
    ends = [(time[rows[0]] + after, time[rows[-1]] - before) for rows in kept]
    settled = [rows[(time[rows] >= begin) & (time[rows] <= end)]
               for rows, (begin, end) in zip(kept, ends)]
    divided = list[Numbers]()
    for rows in settled:
        pieces = 1
        if temperature is not None and len(rows) >= 24:  # so that its slope can be fitted
            twelfths = [part.mean() for part in np.array_split(temperature[rows], 12)]
            pieces = max(1, min(math.ceil(float(np.ptp(twelfths)) / MIN_TEMPERATURE_SPREAD),
                                int(samples.duration(rows) / _MIN_DURATION)))
        divided += np.array_split(rows, pieces)
    dwells = [rows for rows in divided
              if len(rows) >= _MIN_SAMPLES and samples.duration(rows) >= _MIN_DURATION]
    if short := len(divided) - len(dwells):
        remarks.append(f'steady stretches shorter than {_MIN_DURATION:g} s without the '
                       f'settling, left out: {short}')
    remarks.append(f'{after:.2f} s after each ramp and {before:.2f} s before the next are cut '
                   'away')
    if more := len(divided) - len(settled):
        remarks.append('dwells that warmed or cooled by more than '
                       f'{MIN_TEMPERATURE_SPREAD:g} K are divided, which makes {more} more')
    within = mark_rows([(rows[0], rows[-1]) for rows in dwells], len(time))
    remarks += _describe_left_out(samples, is_outlier & within, is_repeated & within)
    share = sum(map(samples.duration, dwells)) / float(np.ptp(time))
    if share < min_share:
        raise NothingSteady(
            'the reference turns at a constant rate (its heading is a straight line to '
            f'{_MAX_DEVIATION / DEGREE:g} deg), for {_MIN_DURATION:g} s at a time without the '
            f'settling, in {100.0 * share:.0f} % of the log; hold each rate for longer, or use '
            '--method likelihood')
    if share <= FEW_DWELLS_SHARE:
        remarks.append(f'only {100.0 * share:.0f} % of the time is in dwells; '
                       '--method likelihood uses all of it')
    rate, output, deviation, rounding = _average(samples, dwells)
    row = np.searchsorted(np.asarray(log.time), time)
    return Dwells(rate, output, None if temperature is None
                  else np.array([temperature[rows].mean() for rows in dwells]), deviation,
                  _number_sweeps(rate)[0],
                  tuple(f'{time[rows[0]]:.1f} to {time[rows[-1]]:.1f} s' for rows in dwells),
                  tuple(remarks), tuple(row[rows] for rows in dwells), rounding)


def _find_straight(samples: _Samples) -> list[slice]:
    """Return the stretches in which the heading is a straight line, but for encoder steps."""
    step, time = samples.step, samples.time
    first = np.unique(np.floor((time - time[0]) / _BLOCK_DURATION), return_index=True)[1]
    edges = np.append(first, len(time))
    times, headings = (np.add.reduceat(values, first) / np.diff(edges)
                       for values in (time, samples.heading))
    # A vibration of the table cancels over whole periods: several lengths.
    deviation = max((float(np.median(np.abs(
        headings[reach:-reach] - 0.5 * (headings[2 * reach:] + headings[:-2 * reach]))))
        for reach in (2, 3, 5) if len(headings) > 2 * reach), default=math.inf)
    tolerance = step + float(np.clip(3.0 * deviation, 0.02 * DEGREE, _MAX_DEVIATION))
    kept: list[range] = []
    for cone in _split_into_lines(times, headings, 2.0 * tolerance):
        if times[cone.stop - 1] - times[cone.start] < 0.5 * _MIN_DURATION:
            continue
        # a line through the middle is extended within the tolerance, by at most its own length
        length = len(cone)
        middle = slice(cone.start + length // 5, cone.stop - length // 5)
        begin, end = max(0, cone.start - length), min(len(times), cone.stop + length)
        slope = fit_scale(headings[middle], times[middle])[1]
        off = np.abs(headings[begin:end] - headings[middle].mean()
                     - slope * (times[begin:end] - times[middle].mean()))
        beyond = np.flatnonzero(off > tolerance)
        before, after = (beyond[beyond < middle.start - begin],
                         beyond[beyond >= middle.stop - begin])
        if len(after):
            end = begin + int(after[0]) - _count_ramp_blocks(off[after[0]:], tolerance)
        if len(before):
            begin += int(before[-1]) + 1 + _count_ramp_blocks(off[before[-1]::-1], tolerance)
        part = range(begin, max(begin, end))
        # of two stretches that overlap, the longer one has the more accurate line
        if kept and part.start < kept[-1].stop and len(part) > len(kept[-1]):
            kept.pop()
        if not kept or part.start >= kept[-1].stop:
            kept.append(part)
    return [slice(int(edges[part.start]), int(edges[part.stop]))
            for part in kept if len(part) > 4]


def _split_into_lines(time: Array, heading: Array, tolerance: float) -> Iterator[range]:
    """Divide a heading into the longest stretches that a line through their first point fits."""
    start, low, high = 0, -math.inf, math.inf
    times, headings = time.tolist(), heading.tolist()
    for place in range(1, len(times)):
        elapsed = times[place] - times[start]
        rise = headings[place] - headings[start]
        low, high = max(low, (rise - tolerance) / elapsed), min(high, (rise + tolerance) / elapsed)
        if low > high or times[place] - times[place - 1] > _MIN_DURATION:
            yield range(start, place)
            start, low, high = place, -math.inf, math.inf
    yield range(start, len(times))


def _count_ramp_blocks(deviation: Array, tolerance: float) -> int:
    """Return how many blocks of a ramp, of a deviation by time squared, are within tolerance."""
    if len(deviation) <= _RAMP_BLOCKS:
        return 0
    ratio = math.sqrt(max(1.0, deviation[_RAMP_BLOCKS] / tolerance))
    return math.ceil(min(6.0, 1.0 / max(ratio - 1.0, 1e-3)) * _RAMP_BLOCKS)


def _settling_time(time: Array, error: Array, dwells: Sequence[Numbers],
                   rate_change: Array) -> float:
    """
    Return the settling time of the output after a ramp, s.

    A linear response (a filter, a delay) is proportional to the change of rate, so it is averaged
    over dwells. It is settled within four standard deviations of its last half; below 20 ppm it
    always is.
    """
    durations = np.array([float(np.ptp(time[rows])) for rows in dwells])
    interval, width, found = max(0.05, float(np.median(np.diff(time)))), 4, 0.0
    for share in (0.25, 0.75) if len(dwells) else ():
        bins = int(min(np.quantile(durations, share), 9.0) / interval)
        edges = np.arange(bins + 1) * interval
        used = durations >= edges[-1]
        if bins < 8 * width or not rate_change[used].any():
            continue
        angles = [np.interp(edges, time[rows] - time[rows[0]], integrate(time[rows], error[rows]))
                  for rows in compress(dwells, used)]
        means = np.diff(angles, axis=1) / interval
        late = means[:, bins // 2:].mean(axis=1, keepdims=True)
        response = uniform_filter1d(rate_change[used] @ (means - late) / np.sum(
            rate_change[used] ** 2), width, mode='nearest')
        spread = max(float(response[bins // 2:].std()), 2e-5)
        unsettled = np.flatnonzero(np.abs(response[:bins // 2]) > 4.0 * spread)
        # after ten bins within the limit the response has ended; later ones exceed it by chance
        unsettled = unsettled[np.cumprod(np.diff(unsettled, prepend=-1) <= 10) > 0]
        if len(unsettled):
            found = max(found, (int(unsettled[-1]) + 1 + width // 2) * interval)
    return found


def _describe_left_out(samples: _Samples, is_outlier: Mask, is_repeated: Mask) -> Iterator[str]:
    """Yield remarks on outliers and repeated samples within the dwells."""
    places = [f'{time:.2f} s' for time in samples.time[is_outlier]]
    if places:
        yield f'outliers, left out: {len(places)}, at {format_list(places)}'
    places = [f'{samples.time[run.start]:.2f} s ({run.stop - run.start} samples)'
              for run in find_runs(is_repeated)]
    if places:
        yield (f'the output was repeated {_format_occurrences(len(places))}, at '
               f'{format_list(places)}; the repeats are left out')


def _format_occurrences(number: int) -> str:
    return 'once' if number == 1 else f'{number} times'


def _average(samples: _Samples,
             dwells: Sequence[Numbers]) -> tuple[Array, Array, Array, Array]:
    """
    Return reference rate, output and its standard deviation of each dwell (Ojeda et al., eq. 6).

    Heading and integral of the output are averaged with the same weights. The deviation is that of
    four to twelve batches of at least 0.75 s, in which vibration averages out, and of the rounding
    of an output with noise below half a step, which is returned too; nan where it is not known.
    """
    durations = np.array([samples.duration(rows) for rows in dwells])
    batches = np.clip(durations / 0.75, 4, 12).astype(int)
    batches = np.minimum(batches, [max(4, len(rows) // 2) for rows in dwells])
    rate, output, blur, by_output, by_error = np.empty((5, len(dwells)))
    for place, rows in enumerate(dwells):
        reference = samples.heading[rows]
        angle = integrate(samples.time[rows], samples.output[rows])
        rate[place], output[place] = (samples.slope(rows, each) for each in (reference, angle))
        # By simulation, the deviation of the slope over M steps of an encoder is about 0.35 step /
        # (M duration), below one step 0.6 step / duration. Each step is seen late by up to a
        # sample. A heading that stays on one step for the whole dwell is taken as a rest.
        blur[place] = 0.0
        if np.ptp(reference) > 0.5 * samples.step > 0.0:
            steps = abs(reference[-1] - reference[0]) / samples.step
            blur[place] = abs(samples.scale) * samples.step / durations[place] * math.hypot(
                0.35 / max(steps, 0.6), math.sqrt(min(steps, len(rows))) / len(rows))
        for variance, each in ((by_output, angle),
                               (by_error, angle - samples.scale * reference)):
            parts = np.array_split(np.arange(len(rows)), batches[place])
            slopes = [samples.slope(rows[part], each[part]) for part in parts]
            variance[place] = np.var(slopes, ddof=1) / len(parts)
    # Against a heading, the scatter of the output includes the motion of the table, that of the
    # error the steps of the encoder. Under white noise its product with the duration is constant.
    variance = durations * (by_error if samples.rate is not None
                            else min(by_output, by_error, key=np.median))
    # the noise of all dwells is one, as that of a few batches has an error of 40 %; of samples of
    # one value nothing is known
    common = float(np.mean(variance)) if np.any(
        variance > durations * (1e-9 * np.abs(output).max()) ** 2) else 0.0
    # the whole output shows its step, as dwells may be on one step each
    is_quiet = np.array([np.std(samples.output[rows]) <= 0.5 * samples.output_step
                         for rows in dwells])
    rounding = is_quiet * samples.output_step / math.sqrt(12.0)
    deviation = np.sqrt(common / durations + blur ** 2
                        + _independent_deviation(rate, output, rounding) ** 2)
    return rate, output, np.where(deviation > 0.0, deviation, np.nan), rounding


def step_covariance(rate: Array, output: Array, rounding: Array) -> Array:
    """
    Return the covariance of the errors of dwells by the steps of their output, (rad/s)², (n, n).

    Where in a step a value lies is not known, but how far two values lie apart is. The errors of
    two values without noise, uniform in a step, that are a part f of a step apart have the
    correlation ``1 - 6 f (1 - f)``. Over the range of rates the steps determine the scale, and so
    a distance, to half a step.
    """
    place = rate * fit_scale(output, rate)[1]
    apart = place[:, None] - place
    part = np.mod(apart / np.maximum(rounding * math.sqrt(12.0), 1e-300), 1.0)
    known = np.exp(-(math.pi * apart / max(float(np.abs(place).max()), 1e-300)) ** 2 / 6.0)
    return np.outer(rounding, rounding) * (1.0 - 6.0 * part * (1.0 - part)) * known


def _independent_deviation(rate: Array, output: Array, rounding: Array) -> Array:
    """Return deviations as of independent errors: of n equal ones each has n times its square."""
    shared = step_covariance(rate, output, rounding)
    return np.sqrt(np.maximum(shared.sum(axis=1), np.diag(shared)))
