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
Stamps of samples, and the even grid that they belong to.

A gyro samples by its own clock, which the stamps of a host do not show: so the samples are
numbered, and a straight line through the stamps gives the interval. Samples are lost where the
stamps stay late after a long step. Where the stamps catch up again, samples only came late.

"""

from __future__ import annotations

from dataclasses import dataclass

from gyro_calibration.logs.log import Array, DataRefused
import numpy as np
from numpy.typing import NDArray

Integers = NDArray[np.integer]

#: Samples that come within this part of the usual interval were waiting; from this share of them
#: on, stamps are taken to come in bursts.
_WAITING, _BURSTS = 0.5, 0.02

#: A gap of more than 1 / LONG of the record is crossed by no window; a longer window is too long
#: to show a motion.
LONG = 50


@dataclass(frozen=True)
class Stamps:
    """Stamps on an even grid."""

    time: Array  # s, shape (n,)
    lost: Integers  # how many samples are lost after each but the last, shape (n - 1,)
    number: Integers  # of each on the grid, shape (n,); long gaps are cut to `longest_gap`
    interval: float  # of the grid, s
    wander: float  # how far the stamps are off it at most, s
    bursts: bool  # the stamps come in bursts or with jitter, and the grid is believed instead

    @property
    def longest_gap(self) -> int:
        """Return how many samples of a gap are kept; no window crosses more."""
        return _longest_gap(self.time)

    @property
    def burst_remarks(self) -> list[str]:
        """Return how far stamps are off their grid, if they come in bursts."""
        if not (self.bursts and self.wander):
            return []
        return [f'The stamps come in bursts or with jitter, up to {self.wander:.3g} s off an even '
                f'interval of {1000 * self.interval:.5g} ms, which is used.']

    @property
    def loss_remarks(self) -> list[str]:
        """Return how many samples are lost, if any are."""
        if not self.lost.any():
            return []
        longest, gaps = int(np.argmax(self.lost)), int(np.count_nonzero(self.lost))
        return [f'{self.lost.sum()} samples are lost in {gaps} gap{"s" * (gaps > 1)}; '
                f'the longest, of {self.lost[longest]}, is at {self.time[longest]:.3f} s.']

    def at(self, number: int | np.integer) -> float:
        """Return the time of a place on the grid, s."""
        return float(np.interp(number, self.number, self.time))


def number_stamps(time: Array) -> Stamps:
    """Find the even grid that stamps belong to, or raise `DataRefused` where there is none."""
    steps = np.diff(time)
    usual = _usual_interval(time, steps)
    bursts = float((steps < _WAITING * usual).mean()) > _BURSTS
    lost = _lost_samples(time, steps, usual, bursts)
    number = _numbers(lost)
    interval = float(np.polyfit(number, time - time[0], 1)[0])
    off = time - time[0] - interval * number
    wander = float(np.abs(off - np.median(off)).max())
    uneven = not bursts and float(
        (np.abs(steps / usual - np.round(steps / usual)) > 0.4).mean()) > 0.2
    if uneven or wander > 0.05 * len(time) * interval:
        raise DataRefused(f'the stamps have no even interval (about {usual:g} s; up to '
                          f'{wander:g} s off); if the samples are even, give the sample rate '
                          'with --rate')
    return Stamps(time, lost, _numbers(np.minimum(lost, _longest_gap(time))), interval, wander,
                  bursts)


def even_times(time: Array) -> Array:
    """Return the even times of stamps with bursts or jitter below an interval, else the stamps."""
    try:
        stamps = number_stamps(time)
    except DataRefused:
        return time
    if stamps.wander > stamps.interval and not stamps.bursts:
        return time
    number = _numbers(stamps.lost)
    return np.polynomial.Polynomial.fit(number, time, 1)(number)


def lost_samples(time: Array) -> Integers | None:
    """Return how many samples are lost after each but the last; None without an even interval."""
    try:
        return number_stamps(time).lost
    except DataRefused:
        return None


def _longest_gap(time: Array) -> int:
    return len(time) // LONG + 1


def _usual_interval(time: Array, steps: Array) -> float:
    """Return the interval, s: the median over 100 samples, or the divisor of most steps."""
    lag = min(100, len(time) // 4)
    interval = float(np.median(time[lag:] - time[:-lag])) / lag
    usual = float(np.median(steps))
    alike = 0.8 < interval / usual < 1.25
    if not alike and float((np.abs(steps / usual - 1.0) < 0.5).mean()) > 0.9:
        raise DataRefused(
            f'most stamps are {1000 * usual:.4g} ms apart, but 100 samples take '
            f'{100 * interval:.4g} s: either most samples are lost, or they come in long bursts; '
            'give the sample rate with --rate, or record again')
    whole = np.abs(steps / usual - np.maximum(np.round(steps / usual), 1.0)) < 0.3
    # samples are lost where nine of ten steps are whole multiples of the middle one
    return (float(steps[whole & (steps < 1.5 * usual)].mean())
            if alike and float(whole.mean()) > 0.9 else interval)


def _lost_samples(time: Array, steps: Array, interval: float, bursts: bool) -> Integers:
    """
    Return how many samples are lost in each step.

    It is the number of intervals by which the stamps are late before they have caught up. What
    waited at a host comes all at once, however much it is; the time to catch up begins after it.

    """
    lost: Integers = np.zeros(len(steps), dtype=np.int64)
    shift, done = 0, 0
    # samples over which delayed stamps catch up, and how many lost ones their wander cannot be
    span, least = (300, 10) if bursts else (10, 1)
    late = (time - time[0]) / interval - np.arange(len(time))
    due = np.append(np.flatnonzero(steps >= _WAITING * interval), len(steps))
    for step in np.nonzero(steps > (least + 0.5) * interval)[0].tolist():
        late[done:step + 1] -= shift
        done = step + 1
        waited = int(due[np.searchsorted(due, done)])
        missing = round(late[done:waited + span].min() - shift
                        - late[max(done - span, 0):done].min())
        if missing >= least:
            lost[step] = missing
            shift += missing
    return lost


def _numbers(lost: Integers) -> Integers:
    """Return the number of each sample, if so many are lost before each but the first."""
    return np.arange(len(lost) + 1) + np.cumsum(np.concatenate([[0], lost]))
