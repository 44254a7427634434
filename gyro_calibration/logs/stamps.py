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
Stamps of samples on an even grid.

Samples are numbered, and a line fitted to the stamps gives the interval. Samples are lost where
the stamps stay late after a long step; where they catch up again, samples were only delayed.
"""

from dataclasses import dataclass

from gyro_calibration.logs.log import Array, DataRefused
import numpy as np
from numpy.typing import NDArray

Integers = NDArray[np.integer]

SHORT_RATIO = 0.5  # to the usual interval of a short one, as in a burst
#: Least number of windows in a record. None crosses a gap of more than this part of the record.
MIN_WINDOWS = 50


@dataclass(frozen=True)
class StampGrid:
    time: Array  # s, shape (n,)
    lost_after: Integers  # how many samples are lost after each but the last, shape (n - 1,)
    grid_index: Integers  # index on the grid, shape (n,); long gaps are cut to `max_gap`
    interval: float  # of the grid, s
    max_deviation: float  # largest deviation of the stamps from the grid, s
    has_bursts: bool  # the stamps come in bursts or with jitter; the grid is used instead
    max_gap: int  # to which longer gaps are cut, samples

    @property
    def burst_remarks(self) -> list[str]:
        return [f'The stamps come in bursts or with jitter, up to {self.max_deviation:.3g} s off '
                f'an even interval of {1000 * self.interval:.5g} ms, which is used.'
                ] if self.has_bursts and self.max_deviation else []

    @property
    def loss_remarks(self) -> list[str]:
        if not self.lost_after.any():
            return []
        longest, gaps = int(np.argmax(self.lost_after)), int(np.count_nonzero(self.lost_after))
        return [f'{self.lost_after.sum()} samples are lost in {gaps} gap{"s" * (gaps > 1)}; '
                f'the longest, of {self.lost_after[longest]}, is at {self.time[longest]:.3f} s.']

    def time_at(self, number: int | np.integer) -> float:
        """Return the time at an index on the grid, s."""
        return float(np.interp(number, self.grid_index, self.time))


def fit_stamp_grid(time: Array) -> StampGrid:
    """Fit an even grid to stamps, or raise `DataRefused` where there is none."""
    # the interval, s: by the median over 100 samples; by the steps themselves where nine of ten
    # are whole multiples of the median one, since samples are lost
    steps, lag = np.diff(time), min(100, len(time) // 4)
    interval, usual = float(np.median(time[lag:] - time[:-lag])) / lag, float(np.median(steps))
    alike = 0.8 < interval / usual < 1.25
    if not alike and float((np.abs(steps / usual - 1.0) < 0.5).mean()) > 0.9:
        raise DataRefused(f'most stamps are {1000 * usual:.4g} ms apart, but 100 samples take '
                          f'{100 * interval:.4g} s: most samples are lost, or come in long '
                          'bursts; give the sample rate with --rate, or record again')
    whole = np.abs(steps / usual - np.maximum(np.round(steps / usual), 1.0)) < 0.3
    usual = (float(steps[whole & (steps < 1.5 * usual)].mean())
             if alike and float(whole.mean()) > 0.9 else interval)
    bursts = float((steps < SHORT_RATIO * usual).mean()) > 0.02

    # The number of lost samples is that of the intervals by which the stamps remain late. Samples
    # that were delayed arrive in one burst of any size; the time to catch up begins after it.
    lost: Integers = np.zeros(len(steps), dtype=np.int64)
    shift, done = 0, 0
    # samples within which delayed stamps catch up, and the least loss beyond their jitter
    span, least = (300, 10) if bursts else (10, 1)
    late = (time - time[0]) / usual - np.arange(len(time))
    due = np.append(np.flatnonzero(steps >= SHORT_RATIO * usual), len(steps))
    for step in np.nonzero(steps > (least + 0.5) * usual)[0].tolist():
        late[done:step + 1] -= shift
        done = step + 1
        waited = int(due[np.searchsorted(due, done)])
        missing = round(late[done:waited + span].min() - shift
                        - late[max(done - span, 0):done].min())
        if missing >= least:
            lost[step] = missing
            shift += missing

    number = _number_samples(lost)
    interval = float(np.polyfit(number, time - time[0], 1)[0])
    off = time - time[0] - interval * number
    wander = float(np.abs(off - np.median(off)).max())
    # a burst is late by no more than the wait for it; beyond that the interval itself changes
    bursts = bursts and wander <= float(steps.max())
    uneven = not bursts and float(
        (np.abs(steps / usual - np.round(steps / usual)) > 0.4).mean()) > 0.2
    if uneven or wander > 0.05 * len(time) * interval:
        raise DataRefused(f'the stamps have no even interval (about {usual:g} s; up to {wander:g} '
                          's off); if the samples are even, give the sample rate with --rate')
    max_gap = len(time) // MIN_WINDOWS + 1
    return StampGrid(time, lost, _number_samples(np.minimum(lost, max_gap)), interval, wander,
                     bursts, max_gap)


def count_lost_samples(time: Array) -> Integers | None:
    """Return how many samples are lost after each but the last; None without an even interval."""
    try:
        return fit_stamp_grid(time).lost_after
    except DataRefused:
        return None


def _number_samples(lost: Integers) -> Integers:
    return np.arange(len(lost) + 1) + np.cumsum(np.concatenate([[0], lost]))
