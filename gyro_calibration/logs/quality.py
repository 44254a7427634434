# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The quality of samples: white noise, quantization, outliers, repeated and saturated samples."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
import math

from gyro_calibration.logs.columns import ROTATIONS
from gyro_calibration.logs.log import Array, DataRefused, DEGREE, Log, Mask
import numpy as np
from scipy.special import ndtri


#: Standard deviation of the misalignment of the axes of gyro and reference, rad, as the cross-axis
#: sensitivity in data sheets of MEMS gyros (MPU-6050: 2 %).
MISALIGNMENT_DEVIATION = 0.02
#: Least alignment of codes on a lattice (length of the mean phasor): deviations of 0.13 steps rms.
_MIN_ALIGNMENT = 0.7


def robust_deviation(values: Array) -> float:
    """Return a robust standard deviation about zero, 1.4826 times the median magnitude."""
    return 1.4826 * float(np.median(np.abs(values)))


def find_holes(time: Array, longest: float) -> Array:
    """Return begin and end of each interval between samples beyond a length, s, shape (k, 2)."""
    return np.column_stack([time[:-1], time[1:]])[np.diff(time) > longest]


def bridge_gaps(values: Array) -> Array:
    """Return values with nan interpolated linearly."""
    known = np.isfinite(values)
    if known.all():
        return values
    places = np.arange(len(values))
    return np.interp(places, places[known], values[known])


def cross_rotation(log: Log) -> Array:
    """Return the rotation about the cross axes, rad, gaps bridged, (n, 2); (n, 0) if planar."""
    given = [getattr(log, name) for name in ROTATIONS[1:]]
    if log.time is None or log.output is None or any(
            each is None or np.isfinite(each).sum() < 2 for each in given):
        return np.empty((len(log), 0))
    turned, interval = np.column_stack([bridge_gaps(each) for each in given]), np.diff(log.time)
    noise = white_noise_deviation(log.output) * math.sqrt(np.median(interval) * interval.sum())
    # by a usual misalignment it turns the heading by less than the noise does
    is_planar = MISALIGNMENT_DEVIATION * np.ptp(turned, axis=0).max() <= noise
    return turned[:, :0] if is_planar else turned


def white_noise_deviation(values: Array, order: int = 3) -> float:
    """
    Return the standard deviation of the white part of a signal, by its differences.

    Those with nan are left out; if each has one, the samples with nan. Their order is 3 in motion,
    and 1 at rest, which shows filtered noise best.
    """
    off = np.abs(np.diff(values, order))
    off = off[np.isfinite(off)]
    if not off.size:
        off = np.abs(np.diff(values[np.isfinite(values)], order))
    # A high quantile, since most differences of a coarsely quantized output are zero.
    return (float(np.quantile(off, 0.9)) / -float(ndtri(0.05))
            / math.sqrt(math.comb(2 * order, order)) if off.size else math.inf)


@dataclass(frozen=True)
class QuantizationCodes:
    """The distinct values of an output in order, and their counts: arrays of shape (m,)."""

    values: Array
    counts: Array
    step: float = 0.0  # between neighbouring codes; 0 where there is no such step
    alignment: float = 0.0  # alignment of the codes with multiples of the step, 0 to 1
    step_deviation: float = 0.0  # standard deviation of the step


def find_codes(values: Array) -> QuantizationCodes:
    """Return the codes of values without nan, with the coarsest step that fits them."""
    found, counts = np.unique(values, return_counts=True)
    # a conversion of units may round equal values differently
    apart = np.concatenate([[True], np.diff(found) > 1e-12 * np.abs(found[[0, -1]]).max()])
    first = np.flatnonzero(apart)
    codes = QuantizationCodes(found[first], np.add.reduceat(counts, first))
    gaps = np.diff(codes.values)
    if not gaps.size:
        return codes
    # where many codes do not occur, few gaps are as small as the step, or none is
    starts = {*np.quantile(gaps, (0.0, 0.001, 0.02, 0.05, 0.1, 0.25, 0.5)).tolist(),
              gaps.min() / 2.0, gaps.min() / 3.0}
    fitting = [replace(codes, step=step, alignment=length, step_deviation=deviation)
               for step, length, deviation in (
                   _refine_step(codes, start) for start in sorted(starts, reverse=True))
               if length > _MIN_ALIGNMENT]
    # The best one, and the coarsest of equal ones. A few frequent codes, of rests and turns, fit
    # many steps, and the codes of a ramp nearly its change from sample to sample.
    seldom = np.minimum(codes.counts, np.median(codes.counts))
    aligned = [abs(_mean_phasor(codes.values, seldom, each.step)) for each in fitting]
    if max(aligned, default=0.0) > _MIN_ALIGNMENT:
        return fitting[int(np.argmax(np.round(aligned, 6)))]
    return (*fitting, codes)[0]


def _mean_phasor(values: Array, counts: Array, step: float) -> complex:
    """Return the mean phasor of the positions of values on a lattice."""
    return complex(np.sum(counts * np.exp(2j * np.pi * values / step)) / counts.sum())


def _refine_step(codes: QuantizationCodes, step: float) -> tuple[float, float, float]:
    """Refine a step from near to far codes; return step, alignment and deviation."""
    gaps = np.diff(codes.values)
    near = gaps < 8.5 * step
    step = float(gaps[near].sum() / max(np.rint(gaps[near] / step).sum(), 1.0))
    # begin with the 16 densest codes, and increase the range by a factor of 4 each time
    width = min(16, len(codes.values) - 1)
    span = codes.values[width:] - codes.values[:-width]
    first = int(np.argmin(span))
    place = codes.values - codes.values[first + width // 2]
    reach, deviation = float(span[first]) / step + 0.5, 0.0
    while True:
        within = np.abs(place) < reach * step
        # without the most frequent code: a value at every rest would outweigh all others
        counts = codes.counts[within]
        if len(counts) > 1:
            counts = np.where(np.arange(len(counts)) == np.argmax(counts), 0, counts)
        mean = _mean_phasor(place[within], counts, step)
        aligned, offset = abs(mean), float(np.angle(mean)) * step / (2.0 * np.pi)
        if aligned < _MIN_ALIGNMENT:
            return step, aligned, deviation
        number = np.rint((place[within] - offset) / step)
        if np.ptp(number) > 0.0:
            fitted = np.polyfit(number, place[within], 1)
            step = float(fitted[0])
            deviation = float(np.std(place[within] - np.polyval(fitted, number))
                              / (np.std(number) * math.sqrt(len(number))))
        if within.all():
            return (step, aligned, deviation) if np.ptp(number) > 0.0 else (step, 0.0, 0.0)
        reach *= 4.0


def quantization_step(values: Array) -> float:
    """Return the quantization step of an encoder or a digital output; 0 without one."""
    return find_codes(values).step


def encoder_step(heading: Array) -> float:
    """Return the step of an encoder heading, rad; 0 without one or for a calculated motion."""
    known = heading[np.isfinite(heading)]
    step = find_codes(known).step
    change = np.diff(known)
    changes, differing = (np.count_nonzero(np.abs(each) > 0.5 * step)
                          for each in (change, np.diff(change, 2)))
    # In a calculated motion, rates are constant or change evenly. At rates of whole steps few
    # changes differ, but the error of each reading shows.
    return step if step and (10 * differing > changes
                             or is_rounded_at_each_sample(known, step)) else 0.0


def is_rounded_at_each_sample(values: Array, step: float) -> bool:
    """Tell whether changes of values by other numbers of steps return at the next sample."""
    bent = np.diff(values, 2)
    returning = np.count_nonzero(bent[1:] * bent[:-1] < -0.5 * step ** 2)
    return bool(10 * returning > np.count_nonzero(np.abs(bent) > 0.5 * step))


def find_runs(mask: Mask) -> list[slice]:
    """Return the slices of consecutive true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask, [0]])))
    return [slice(int(start), int(stop)) for start, stop in zip(edges[::2], edges[1::2])]


def mark_rows(ends: Iterable[Sequence[int]], count: int) -> Mask:
    """Mark the rows from the first to the last of each pair, shape (count,)."""
    marked = np.zeros(count, dtype=bool)
    for first, last in ends:
        marked[first:last + 1] = True
    return marked


def mask_outliers(values: Array, limit: float, step: float) -> Mask:
    """Mark single samples beyond a limit, robust deviations or steps of the output."""
    if len(values) < 4:
        return np.zeros(len(values), dtype=bool)
    # The median of six neighbours resists two outliers among them.
    edged = np.pad(values, 3, mode='reflect')
    alone = values - np.median([edged[place:place + len(values)] for place in (0, 1, 2, 4, 5, 6)],
                               axis=0)
    # a coarsely quantized output mostly equals its neighbours, and then the limit is in steps
    return np.logical_and(*(np.abs(off) > limit * max(robust_deviation(off), step, 1e-9)
                            for off in (alone, values - np.median(values))))


def mask_repeated_samples(output: Array) -> Mask:
    """Mark repeats of a value in runs longer than its share of the samples explains."""
    repeated = np.zeros(len(output), dtype=bool)
    share = np.unique(output, return_counts=True)[1].max() / len(output)
    if share > 0.9:  # a coarsely quantized gyro at rest, or a simulation without noise
        return repeated
    longest = math.log(1e-6 / len(output)) / math.log(share)
    for run in find_runs(np.concatenate([[False], np.diff(output) == 0.0])):
        repeated[run] = run.stop - run.start > longest
    return repeated


def refuse_dead(output: Array) -> None:
    """Refuse samples of which more than 90 % have one value."""
    values, counts = np.unique(output, return_counts=True)
    share, value = counts.max() / len(output), float(values[counts.argmax()])
    if len(values) == 1:
        raise DataRefused(f'all {len(output)} samples have the same value, {value / DEGREE:g} '
                          'deg/s: the gyro is dead or not powered; check power and wires')
    if share > 0.9:  # the last bit may toggle
        raise DataRefused(f'{100 * share:.1f} % of the samples have the same value, '
                          f'{value / DEGREE:g} deg/s: the gyro is dead, not powered, or did not '
                          'move; check power and wires')


def largest_divisor(values: Array) -> float:
    """Return the greatest common divisor of values, to 1e-9 of the largest; or 0."""
    values = np.abs(values)
    smallest = 1e-9 * float(values.max(initial=0.0))
    while (values > smallest).any():
        divisor = float(values[values > smallest].min())
        rest = np.abs(values - divisor * np.rint(values / divisor))
        off = rest > smallest
        if not off.any():
            return divisor
        values = np.append(rest[off], divisor)
    return 0.0


def refuse_saturated(output: Array) -> None:
    """Refuse an output that is clipped at its largest or smallest value."""
    # A range holds both senses: the lesser end of turns one way is a rest, and no limit.
    values, counts = np.unique(output, return_counts=True)
    ends = [end for end in (-1, 0) if abs(values[end]) > 0.5 * np.abs(values).max()]
    # Not if its codes are too coarse to show its noise at any place in a step: most of the
    # flattest quarter of blocks of ten samples, away from the limits, hold one or two values.
    blocks = output[:len(output) // 10 * 10].reshape(-1, 10)
    blocks = blocks[~np.isin(blocks, values[ends]).any(axis=1)]
    slopes = np.abs(blocks[:, 5:].mean(axis=1) - blocks[:, :5].mean(axis=1))
    flattest = blocks[np.argsort(slopes)[:len(blocks) // 4]]
    differing = np.count_nonzero(np.diff(np.sort(flattest), axis=1), axis=1)
    if not len(flattest) or np.median(differing) < 2:
        return
    # A clipped output has at least 10 samples and 0.5 % of all at a limit, and three times as many
    # as at the next value.
    for end in ends:
        neighbour = -2 if end else 1
        if counts[end] >= max(10, 0.005 * len(output)) and counts[end] > 3 * counts[neighbour]:
            raise DataRefused(f'the gyro is saturated: {100 * counts[end] / len(output):.0f} % of '
                              f'the samples are at its limit of {values[end] / DEGREE:.4g} deg/s; '
                              'turn slower, or set a wider range')
