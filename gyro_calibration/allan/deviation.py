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
Overlapping Allan deviation over averaging time, with bounds, of a record at rest.

Times are in samples, except in the chart. An Allan variance is a mean square of second differences
of the angle, and mean squares of Gaussian values have the covariance 2 c² summed over all pairs
(Greenhall and Riley, Uncertainty of stability variances based on finite differences, PTTI 2003).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
import math
from typing import Any

from gyro_calibration.calibration.likelihood import MAX_NOISE_SIGMAS
from gyro_calibration.calibration.whole_turns import FALSE_REFUSAL_RATE
from gyro_calibration.logs.log import Array, DataRefused, Mask
from gyro_calibration.logs.quality import (
    bridge_gaps, find_runs, mask_outliers, quantization_step, robust_deviation)
from gyro_calibration.logs.stamps import fit_stamp_grid, Integers, MIN_WINDOWS, StampGrid
from gyro_calibration.model.noise import (
    ANGLE_RANDOM_WALK, FLICKER, GaussMarkov, NOISE_TERMS, QUANTIZATION_NOISE, RATE_RAMP,
    RATE_RANDOM_WALK)
import numpy as np
from scipy.special import chdtri
from scipy.stats import pearsonr

#: Least number of samples for a noise figure; of white noise they determine it to 9 %.
_MIN_ALLAN_SAMPLES = 100
#: Largest share of lost samples in a window; it is also the largest change of the variance.
_MAX_LOST_PER_WINDOW = 0.01
#: Least number of spans in the test whether a reference turns with the output.
_MIN_SPANS = 8
#: Samples in a block that fits into the cache, and whose dot product takes one thread.
_BLOCK_SAMPLES = 8192
#: Indices of terms, the last ones those with independent second differences over longer times.
_QUANTIZATION_INDEX, _RAMP_INDEX = map(NOISE_TERMS.index, (QUANTIZATION_NOISE, RATE_RAMP))
_SHORT_MEMORY_INDICES = [
    place for place, part in enumerate(NOISE_TERMS) if part not in (RATE_RANDOM_WALK, RATE_RAMP)]


@dataclass(frozen=True)
class RestRecord:
    """Samples of a gyro at rest at even intervals."""

    rate: Array  # rad/s, shape (n,); nan where a sample is lost or left out
    interval: float  # s
    remarks: tuple[str, ...] = ()  # on bursts, lost samples and outliers, one sentence each


def build_rest_record(time: Array, output: Array, moving: Array | None = None,
                      heading: Array | None = None) -> RestRecord:
    """
    Put samples with increasing stamps, s and rad/s, shape (n,), on an even grid; lost are nan.

    An output that is nan counts as lost, as does one with `moving` 1; without `moving` the heading
    by a reference, rad, is tested for motion. Raise `DataRefused` for what is no record at rest.
    """
    _refuse_few(len(output))
    known = np.isfinite(output) if moving is None else np.isfinite(output) & (moving == 0.0)
    at_rest = output[known]
    _refuse_few(len(at_rest), 'samples at rest with an output')
    same = max(find_runs(np.diff(at_rest) == 0.0), key=lambda run: run.stop - run.start,
               default=slice(0, 0))
    count = same.stop - same.start + 1
    if count > max(len(at_rest) // 10, 50):
        raise DataRefused(f'the gyro gives the same value {count} times in a row from '
                          f'{time[known][same.start]:g} s on: it is dead or its steps are coarser '
                          'than its noise; check it, and record again')
    stamps = fit_stamp_grid(time)
    rate = np.full(int(stamps.grid_index[-1]) + 1, np.nan)
    rate[stamps.grid_index[known]] = output[known]
    remarks = [*stamps.burst_remarks,
               *(f'{remark} Windows with more than {100 * _MAX_LOST_PER_WINDOW:g} % lost are not '
                 'used.' for remark in stamps.loss_remarks)]
    left_out = int(np.count_nonzero(~known))
    if left_out:
        remarks.append(f'{left_out} samples without output, or moving, are left out.')
    # single samples far beyond the noise; a motion or a jolt lasts longer than two samples
    outliers = np.flatnonzero(mask_outliers(bridge_gaps(rate), MAX_NOISE_SIGMAS,
                                            quantization_step(output[known])))
    if 0 < outliers.size <= 0.001 * len(rate):
        rate[outliers] = np.nan
        remarks.append(f'Far beyond the noise, and left out: {outliers.size} single '
                       f'sample{"s" * (outliers.size > 1)}, the first at '
                       f'{stamps.time_at(outliers[0]):.3f} s.')
    _refuse_motion(rate, stamps)
    if heading is not None and moving is None:
        _refuse_turning(time, output, heading)
    # long gaps are cut, since no window crosses them
    kept = np.ones(len(rate), dtype=bool)
    for gap in find_runs(np.isnan(rate)):
        kept[gap.start + stamps.max_gap:gap.stop] = False
    return RestRecord(rate[kept], stamps.interval, tuple(remarks))


def _refuse_few(count: int, samples: str = 'samples') -> None:
    """Refuse fewer samples than a noise figure needs."""
    if count < _MIN_ALLAN_SAMPLES:
        raise DataRefused(f'{count} {samples}; an Allan deviation needs at least '
                          f'{_MIN_ALLAN_SAMPLES}: record longer')


def _refuse_turning(time: Array, output: Array, heading: Array) -> None:
    """Refuse a record whose reference heading correlates with the output at some span."""
    sums = np.concatenate([[0.0], np.nancumsum(output)])
    duration = time[-1] - time[0]
    shortest, longest = max(1.0, duration / len(time)), duration / _MIN_SPANS
    for span in np.geomspace(shortest, longest, 1 + int(np.log2(max(longest / shortest, 1.0)))):
        ends = np.searchsorted(time, np.arange(time[0], time[-1], span))
        mean, change = np.diff(sums[ends]) / np.maximum(np.diff(ends), 1), np.diff(heading[ends])
        known = np.isfinite(change)
        both = np.stack([mean[known], change[known]])
        if (known.sum() < _MIN_SPANS
                or (np.ptp(both, axis=1) <= 1e-9 * np.abs(both).max(axis=1)).any()):
            continue
        correlation, chance = pearsonr(*both)
        if correlation ** 2 > 0.5 and chance < FALSE_REFUSAL_RATE:
            raise DataRefused(
                f'the reference heading turns with the output ({100.0 * correlation ** 2:.0f} % '
                f'of the variance of means over {span:g} s): the gyro was moved; give a part at '
                'rest by --from and --to, or record one')


def _refuse_motion(rate: Array, stamps: StampGrid) -> None:
    """Refuse a record whose means change by more than noise, and name its longest part at rest."""
    angle, lost = _integrate_angle(rate), _count_lost_before(rate)
    moved, worst, over = np.zeros(len(rate), dtype=bool), 0.0, 0
    step = quantization_step(rate[np.isfinite(rate)])
    for size in (2 ** octave for octave in range(max(int(math.log2(len(rate) / MIN_WINDOWS)), 0))):
        # changes of the mean over `size` samples, times `size`
        end, every = len(angle) - 2 * size, max(1, size // 4)
        at = np.arange(0, end, every)
        if lost is not None:
            at = at[_mask_complete_windows(lost, size, 0, end, every)]
        if len(at) < MIN_WINDOWS:
            break
        change = np.abs(angle[at + 2 * size] - 2.0 * angle[at + size] + angle[at])
        # the rms where most of them are zero; beyond the limit as seldom as normal noise by
        # Bernstein's inequality for sums of whole steps
        scale = robust_deviation(change) or float(np.sqrt(np.mean(change ** 2)))
        limit = MAX_NOISE_SIGMAS * (MAX_NOISE_SIGMAS * step / 6.0 + math.hypot(
            MAX_NOISE_SIGMAS * step / 6.0, scale))
        for begin in at[change > limit]:
            moved[begin:begin + 2 * size] = True
        if change.max() > worst * limit:
            worst, over = float(change.max() / limit), size
    if not moved.any():
        return
    rest = max(find_runs(~moved), key=lambda run: run.stop - run.start, default=slice(0, 0))
    remedy = 'record again at rest'
    if rest.stop - rest.start >= _MIN_ALLAN_SAMPLES:  # to a tenth of a second within it
        begin, end = math.ceil(10.0 * stamps.time_at(rest.start)) / 10.0, math.floor(
            10.0 * stamps.time_at(rest.stop - 1)) / 10.0
        remedy = f'use the longest part at rest, from {begin:.1f} to {end:.1f} s, or record again'
    raise DataRefused('the gyro was moved, or its output jumped: from '
                      f'{stamps.time_at(int(np.argmax(moved))):.2f} s on means over '
                      f'{over * stamps.interval:.3g} s change up to '
                      f'{MAX_NOISE_SIGMAS * worst:.0f} standard deviations: {remedy}')


def _integrate_angle(rate: Array) -> Array:
    """
    Return the integral of the rate minus its mean, shape (n + 1,), in rate times samples.

    Gaps get the mean over 5 gap lengths on each side: the noise of the samples at both ends,
    integrated over a gap, would pass for a random walk.
    """
    known = np.isfinite(rate)
    values = rate - rate[known].mean()
    if not known.all():
        values[~known] = 0.0
        begins, ends = np.array([(gap.start, gap.stop) for gap in find_runs(~known)]).T
        margin = 5 * (ends - begins) + 5
        low, high = np.maximum(begins - margin, 0), np.minimum(ends + margin, len(rate))
        sums, counts = (np.concatenate([[0.0], np.cumsum(each)]) for each in (values, known))
        means = (sums[high] - sums[low]) / np.maximum(counts[high] - counts[low], 1.0)
        values[~known] = np.repeat(means, ends - begins)
    return np.concatenate([[0.0], np.cumsum(values)])


def _count_lost_before(rate: Array) -> Integers | None:
    """Return how many samples are lost before each one, shape (n + 1,), or None without losses."""
    lost = np.isnan(rate)
    return np.concatenate([[0], np.cumsum(lost)]) if lost.any() else None


def _mask_complete_windows(lost: Integers, size: int, begin: int, end: int, step: int = 1) -> Mask:
    """Return which second differences over `size` samples have few of the samples lost before."""
    return np.asarray(lost[begin + 2 * size:end + 2 * size:step] - lost[begin:end:step]
                      <= _MAX_LOST_PER_WINDOW * 2 * size)


@dataclass(frozen=True)
class AllanChart:
    """The overlapping Allan deviation, each array of shape (n,)."""

    interval: float  # between samples, s
    samples: int  # in the record, lost ones included
    size: Integers  # averaging times in samples
    deviation: Array  # rad/s
    difference_count: Integers  # number of second differences in the mean square
    degrees_of_freedom: Array  # equivalent ones of the mean square
    lower: Array  # bounds of the deviation with 95 % confidence, rad/s
    upper: Array

    @property
    def floor(self) -> dict[str, float]:
        """Return the point with the lowest upper bound: time, deviation and its bounds."""
        # not the lowest deviation: at the end of the chart single points are low by chance
        lowest = int(np.argmin(self.upper))
        return {name: float(getattr(self, name)[lowest])
                for name in ('time', 'deviation', 'lower', 'upper')}

    @property
    def time(self) -> Array:
        """Return the averaging times, s."""
        return self.size * self.interval


def averaging_sizes(samples: int) -> Integers:
    """Return averaging times in samples, ten a decade, up to a third of the record."""
    decades = math.log10(max(samples // 3, 1))
    return np.unique(np.round(np.logspace(0.0, decades, round(10 * decades) + 1)).astype(np.int64))


def allan_deviation(rate: Array, interval: float,
                    times: Sequence[float] | Array | None = None) -> AllanChart:
    """
    Return the overlapping Allan deviation (IEEE Std 952, C.1; NIST SP 1065, eq. 11).

    The rate, rad/s, shape (n,), has one sample an interval, s; nan where it is lost. Averaging
    times, s, are taken to whole intervals; by default they are ten a decade, up to a third of the
    record. Raise `DataRefused` for too few samples.
    """
    _refuse_few(int(np.isfinite(rate).sum()))
    samples = len(rate)
    sizes = (averaging_sizes(samples) if times is None else
             np.unique(np.round(np.asarray(times, dtype=float) / interval).astype(np.int64)))
    # sums of the squared second differences of the angle, and their numbers
    angle, lost = _integrate_angle(rate), _count_lost_before(rate)
    twice, buffer = 2.0 * angle, np.empty(_BLOCK_SAMPLES)
    sums, counts = np.zeros(len(sizes)), np.zeros(len(sizes), dtype=np.int64)
    for begin in range(0, len(angle), _BLOCK_SAMPLES):
        for place, size in enumerate(sizes.tolist()):
            end = min(begin + _BLOCK_SAMPLES, len(angle) - 2 * size)
            if end <= begin:
                break
            block = buffer[:end - begin]
            np.add(angle[begin + 2 * size:end + 2 * size], angle[begin:end], out=block)
            np.subtract(block, twice[begin + size:end + size], out=block)
            if lost is None:
                counts[place] += len(block)
            else:
                kept = _mask_complete_windows(lost, size, begin, end)
                block *= kept
                counts[place] += np.count_nonzero(kept)
            sums[place] += float(block @ block)
    some = counts > 0
    sizes, counts = sizes[some], counts[some]
    variance = sums[some] / (2.0 * sizes.astype(float) ** 2 * counts)
    freedom = _degrees_of_freedom(samples, sizes, variance) * counts / (samples + 1 - 2 * sizes)
    # a few windows between gaps may have less than one degree of freedom, and no upper bound
    bounded = freedom >= 1.0 - 1e-9
    sizes, counts = sizes[bounded], counts[bounded]
    variance, freedom = variance[bounded], freedom[bounded]
    return AllanChart(interval, samples, sizes, np.sqrt(variance), counts, freedom,
                      *chi_squared_bounds(variance, freedom))


def chi_squared_bounds(mean_square: Any, degrees_of_freedom: Any) -> tuple[Any, Any]:
    """Return the 95 % bounds of a root mean square (NIST SP 1065, eq. 45)."""
    lower, upper = (np.sqrt(mean_square * degrees_of_freedom / chdtri(degrees_of_freedom, tail))
                    for tail in (0.025, 0.975))
    return lower, upper


def _degrees_of_freedom(samples: int, sizes: Integers, variance: Array) -> Array:
    """Return twice the squared variance over its own variance, shape (n,)."""
    # Those of the random term that fits the slope of each Allan variance best, from half to twice
    # each time. Quantization is assumed at the short end only; a steep slope elsewhere is chance.
    low = np.searchsorted(sizes, sizes / 2.0)
    high = np.searchsorted(sizes, 2.0 * sizes, side='right') - 1
    rise = np.log(np.maximum(variance[high], 1e-300) / np.maximum(variance[low], 1e-300))
    slopes = np.where(
        high > low, rise / np.where(high > low, np.log(sizes[high] / sizes[low]), 1.0), -1.0)
    steep, freedom = int(np.argmin(np.append(slopes < -1.5, False))), []
    for number, (size, slope) in enumerate(zip(sizes.tolist(), slopes)):
        part = QUANTIZATION_NOISE if number < steep else min(
            (ANGLE_RANDOM_WALK, FLICKER, RATE_RANDOM_WALK),
            key=lambda term: abs(2.0 * term.slope - slope))
        place = NOISE_TERMS.index(part)
        freedom.append(max(1.0, 2.0 * float(part.allan_variance(size)) ** 2
                           / float(covariance_form(samples, size, size)[place, place])))
    return np.array(freedom)


def _lag_covariance(angle_covariance: Callable[[Integers], Array], first: int, second: int,
                    lags: Integers) -> Array:
    """Return the covariance of second differences over `first` and `second` samples at lags."""
    return np.sum([a * b * angle_covariance(lags + (j * second - i * first))
                   for i, a in enumerate((1.0, -2.0, 1.0))
                   for j, b in enumerate((1.0, -2.0, 1.0))], axis=0)


@lru_cache(maxsize=4096)  # each pair of times is in many fits
def covariance_form(samples: int, first: int, second: int,
                    process: GaussMarkov | None = None) -> Array:
    """
    Return the covariance of two Allan variances as a form of squared coefficients, shape (5, 5).

    Angle quantization is white: only lags at which two of its samples coincide contribute. A ramp
    adds a mean m to values with the covariance c, and 4 m² c to the covariance of their squares. A
    process, its times in samples, adds a row and column.
    """
    counts = (samples + 1 - 2 * first, samples + 1 - 2 * second)
    area = float(first) ** 2 * float(second) ** 2
    angles = [part.angle_covariance for part in NOISE_TERMS]
    if process is not None:
        angles.append(process.angle_covariance)

    def count_pairs(lags: Integers) -> Integers:
        """Return how many pairs of second differences stand at each lag."""
        return np.maximum(np.minimum(counts[0], counts[1] - lags) - np.maximum(0, -lags), 0)

    # lags that are dense enough for all but quantization: more change less than 1 %
    longer, shorter = max(first, second), min(first, second)
    stride = max(1, shorter // 8, longer // 512)
    lags = np.arange(-(min(10 * longer, counts[0]) // stride),
                     min(10 * longer, counts[1]) // stride + 1) * stride
    values = np.array([_lag_covariance(angle, first, second, lags) for angle in angles])
    values[_QUANTIZATION_INDEX] = 0.0
    if stride > max(1, shorter // 2):
        values[_SHORT_MEMORY_INDICES] = 0.0  # independent at lags of this size
        if process is not None and process.correlation_time < stride:
            values[-1] = 0.0
    pairs = count_pairs(lags) * float(stride)
    # lags at which two samples of quantization coincide
    lags = np.unique([i * first - j * second for i in range(3) for j in range(3)])
    meeting = np.array([_lag_covariance(angle, first, second, lags) for angle in angles])
    meeting_pairs = count_pairs(lags)
    # no matrix product, which would start threads
    form = np.array([[2.0 * (pairs * one * other).sum() for other in values] for one in values])
    form[_QUANTIZATION_INDEX] = form[:, _QUANTIZATION_INDEX] = 2.0 * (
        meeting * meeting[_QUANTIZATION_INDEX] * meeting_pairs).sum(axis=1)
    slopes = (values * pairs).sum(axis=1)
    slopes[_QUANTIZATION_INDEX] = meeting[_QUANTIZATION_INDEX] @ meeting_pairs
    form[_RAMP_INDEX] = form[:, _RAMP_INDEX] = 2.0 * area * slopes
    return form / (4.0 * area * counts[0] * counts[1])
