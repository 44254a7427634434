# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The chart: overlapping Allan deviation over averaging time, with bounds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math

from gyro_calibration.allan.angle import angle_of, Integers, lost_before, refuse_few, Truths, whole
from gyro_calibration.allan.freedom import chi_squared_bounds, degrees_of_freedom
from gyro_calibration.logs.log import Array, DataRefused, Progress
from gyro_calibration.model.noise import ALLAN_FLOOR
import numpy as np

#: Samples in a block: its few arrays stay in the cache for all averaging times.
_BLOCK = 16384

#: Degrees of freedom of an averaging time, above the rounding of a single second difference.
_LEAST_FREEDOM = 1.0 - 1e-9

#: numpy gives longer products to several threads, which costs more than it saves.
_PRODUCT = 8192


@dataclass(frozen=True)
class Floor:
    """
    The lowest point of a chart, by the upper bound.

    The deviation itself would not do: at the end of the chart single points are low by chance.

    Attributes
    ----------
    time : averaging time, s
    deviation, lower, upper : Allan deviation there and its 95 % bounds, rad/s

    """

    time: float
    deviation: float
    lower: float
    upper: float

    @property
    def bias_instability(self) -> tuple[float, float, float]:
        """Return B, 1 / 0.664 of the floor (IEEE Std 952), and its bounds, rad/s."""
        return self.deviation / ALLAN_FLOOR, self.lower / ALLAN_FLOOR, self.upper / ALLAN_FLOOR


@dataclass(frozen=True)
class AllanChart:
    """
    The overlapping Allan deviation, each array of shape (n,).

    Attributes
    ----------
    interval : between samples, s
    samples : how many the record has, lost ones included
    size : averaging times in samples
    deviation : rad/s
    differences : how many second differences the mean square is taken over
    degrees_of_freedom : equivalent ones, of the mean square
    lower, upper : bounds of the deviation with 95 % confidence, rad/s

    """

    interval: float
    samples: int
    size: Integers
    deviation: Array
    differences: Integers
    degrees_of_freedom: Array
    lower: Array
    upper: Array

    @property
    def floor(self) -> Floor:
        """Return the lowest point."""
        lowest = int(np.argmin(self.upper))
        return Floor(*(float(values[lowest])
                       for values in (self.time, self.deviation, self.lower, self.upper)))

    @property
    def time(self) -> Array:
        """Return the averaging times, s."""
        return self.size * self.interval


def averaging_sizes(samples: int, per_decade: int = 10) -> Integers:
    """Return averaging times in samples, evenly spaced in log, up to a third of the record."""
    decades = math.log10(max(samples // 3, 1))
    return np.unique(np.round(
        np.logspace(0.0, decades, round(decades * per_decade) + 1)).astype(np.int64))


def allan_deviation(rate: Array, interval: float, times: Sequence[float] | Array | None = None,
                    progress: Progress = iter) -> AllanChart:
    """
    Return the overlapping Allan deviation (IEEE Std 952, C.1; NIST SP 1065, eq. 11).

    Parameters
    ----------
    rate : rad/s, shape (n,), one sample an interval; nan where a sample is lost
    interval : s
    times : averaging times, s, taken to the nearest whole number of intervals; default: ten a
        decade, up to a third of the record
    progress : is given the blocks of the record to go through, such as a progress bar

    Raises
    ------
    DataRefused : too few samples, or an averaging time that does not fit twice into the record

    """
    refuse_few(int(np.isfinite(rate).sum()))
    samples = len(rate)
    sizes = averaging_sizes(samples) if times is None else _sizes(samples, interval, times)
    sums, counts = _square_sums(rate, sizes, progress)
    some = counts > 0
    sizes, counts = sizes[some], counts[some]
    variance = sums[some] / (2.0 * sizes.astype(float) ** 2 * counts)
    freedom = degrees_of_freedom(samples, sizes, variance) * counts / (samples + 1 - 2 * sizes)
    # A few windows that fit between gaps are nearly the same ones and count less than a single
    # one: their deviation has no upper bound.
    told = freedom >= _LEAST_FREEDOM
    sizes, counts, variance, freedom = sizes[told], counts[told], variance[told], freedom[told]
    return AllanChart(interval, samples, sizes, np.sqrt(variance), counts, freedom,
                      *chi_squared_bounds(variance, freedom))


def _sizes(samples: int, interval: float, times: Sequence[float] | Array) -> Integers:
    """Return averaging times in samples, or refuse them."""
    sizes = np.unique(np.round(np.asarray(times, dtype=float) / interval).astype(np.int64))
    if not sizes.size or sizes[0] < 1 or 2 * sizes[-1] > samples:
        given = f'{sizes[0] * interval:g} to {sizes[-1] * interval:g} s' if sizes.size else 'none'
        raise DataRefused(f'averaging times: {given}; wanted at least one sample, {interval:g} s, '
                          f'and at most half the record, {samples // 2 * interval:g} s: '
                          'choose others, or record longer')
    return sizes


def _square_sums(rate: Array, sizes: Integers, progress: Progress) -> tuple[Array, Integers]:
    """Return the sums of the squared second differences of the angle, and their numbers."""
    angle, lost = angle_of(rate), lost_before(rate)
    twice, buffer = 2.0 * angle, np.empty(_BLOCK)
    sums, counts = np.zeros(len(sizes)), np.zeros(len(sizes), dtype=np.int64)
    for begin in progress(range(0, len(angle), _BLOCK)):
        for place, size in enumerate(sizes.tolist()):
            end = min(begin + _BLOCK, len(angle) - 2 * size)
            if end <= begin:
                break
            block = buffer[:end - begin]
            np.add(angle[begin + 2 * size:end + 2 * size], angle[begin:end], out=block)
            np.subtract(block, twice[begin + size:end + size], out=block)
            counts[place] += (len(block) if lost is None
                              else _leave_out(block, whole(lost, size, begin, end)))
            sums[place] += sum(float(part @ part) for part in (block[:_PRODUCT], block[_PRODUCT:]))
    return sums, counts


def _leave_out(block: Array, kept: Truths) -> int:
    """Set the other second differences to zero, and return how many are left."""
    block *= kept
    return int(np.count_nonzero(kept))
