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
Integration of rates to a heading and its variance: threshold filter, and trapezoids on the stamps.

The threshold is compared with the mean over a window, because single samples of a cheap gyro cross
it half of the time. A window of 0 is the published decision. Rates are integrated by the trapezoid
rule on the stamps: the rectangle rule has a delay of half a sample, and a nominal interval causes
a scale factor error.

"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from gyro_calibration.heading.gaps import GapModel, MAX_RATE
from gyro_calibration.logs.log import Array, CACHE_BLOCK_SAMPLES, DEGREE
from gyro_calibration.model.compensation import quadratic_form
from gyro_calibration.model.noise import Noise
import numpy as np


@dataclass(frozen=True)
class Threshold:
    """
    Settings of the threshold filter (Hong and Park, eq. 12).

    Attributes
    ----------
    rate : rad/s; below it the robot is taken to be at rest; 0 disables the filter
    window : s; the mean over it is compared with the rate. 0 compares single samples, as published
    angle_random_walk : rad/√s; a window whose standard deviation exceeds three times that of this
        noise is motion, whatever its mean; 0 disables this test

    """

    rate: float = 0.3 * DEGREE
    window: float = 0.2
    angle_random_walk: float = 0.0


class ThresholdFilter:
    """
    Set the rate to zero while the robot is at rest, sample by sample.

    The published filter uses single samples. With the noise of a cheap gyro this has little effect
    at rest, so the mean over a short window is used here. A turn slower than the threshold is
    lost; the caller counts the deleted heading.

    """

    def __init__(self, settings: Threshold):
        """Begin with an empty window."""
        self.settings = settings
        self._window = deque[tuple[float, float]]()

    def clear(self) -> None:
        """Forget the window, as after a gap."""
        self._window.clear()

    def apply(self, time: float, rate: float) -> float:  # noqa: A003
        """Return the rate, rad/s, or zero; `time` in s increases from call to call."""
        if not self.settings.rate:
            return rate
        return 0.0 if self._is_standing(time, rate) else rate

    def _is_standing(self, time: float, rate: float) -> bool:
        window = self._window
        window.append((time, min(max(rate, -MAX_RATE), MAX_RATE)))
        while window[0][0] <= time - self.settings.window and len(window) > 1:
            window.popleft()
        # not a running sum, which would accumulate rounding errors
        rates = [each for _, each in window]
        mean = sum(rates) / len(rates)
        if not abs(mean) < self.settings.rate:
            return False
        # motion if the window varies by more than the noise
        explained = 9.0 * self.settings.angle_random_walk ** 2 * len(rates)
        variance = sum(each * each for each in rates) / len(rates) - mean * mean
        return not 0.0 < explained < variance * (time - window[0][0])


def integrate(time: Array, rate: Array, begin: float = 0.0) -> Array:
    """Return the heading, rad, shape (n,), by the trapezoid rule, from `begin` on."""
    heading = np.empty(len(time))
    heading[:1] = begin
    for first in range(1, len(time), CACHE_BLOCK_SAMPLES):
        end = min(first + CACHE_BLOCK_SAMPLES, len(time))
        turned = np.add(rate[first:end], rate[first - 1:end - 1], out=heading[first:end])
        turned *= time[first:end] - time[first - 1:end - 1]
        turned *= 0.5
        turned[0] += heading[first - 1]
        np.cumsum(turned, out=turned)
    return heading


def integrate_with_curvature(time: Array, rate: Array) -> Array:
    """Return the integral of a rate, corrected for its curvature between samples, shape (n,)."""
    slope = np.gradient(rate, time)
    step = float(np.median(np.diff(time)))
    return integrate(time, rate) - step ** 2 / 12.0 * (slope - slope[0])


def filter_rates(settings: Threshold, time: Array, rate: Array) -> Array:
    """Return what `ThresholdFilter` makes of a whole log, rad/s, shape (n,)."""
    if not settings.rate:
        return rate
    end = np.arange(1, len(rate) + 1)
    begin = np.minimum(np.searchsorted(time, time - settings.window, side='right'), end - 1)
    # each window is summed by itself: one large value would ruin a running sum from there on
    bounded, count = np.clip(rate, -MAX_RATE, MAX_RATE), end - begin
    windows = np.stack([begin, end], axis=1).ravel()
    sums, squares = (np.add.reduceat(np.append(values, 0.0), windows)[::2]
                     for values in (bounded, bounded * bounded))
    mean = sums / count
    variance = squares / count - mean * mean
    explained = 9.0 * settings.angle_random_walk ** 2 * count
    shakes = (explained > 0.0) & (explained < variance * (time - time[begin]))
    return np.where((np.abs(mean) < settings.rate) & ~shakes, 0.0, rate)


class BlockIntegrator:
    """
    Filter and integrate a log block by block, with the same result as in one piece.

    The result is that of a `tracker.HeadingTracker` that does not detect rest, for a log without
    gaps longer than its `maximum_gap`.

    Attributes
    ----------
    intervals : of the samples, with the number of lost ones

    """

    def __init__(self, settings: Threshold, noise: Noise, covariance: Array):
        """Begin at heading zero; `covariance` is that of the calibration, shape (m, m)."""
        self._settings, self._noise, self._covariance = settings, noise, covariance
        self._window_samples: tuple[Array, Array] = np.zeros(0), np.zeros(0)
        self._last_sample: tuple[Array, Array] = np.zeros(0), np.zeros((2 + len(covariance), 0))
        self._integrals: Array = np.zeros(2 + len(covariance))
        self._gaps, self._gap_variance, self._last_rate = GapModel(noise), 0.0, 0.0
        self.intervals = self._gaps.intervals

    def add(self, time: Array, rate: Array, sensitivity: Array) -> tuple[Array, Array, Array]:
        """
        Take the next block, which may be empty.

        Parameters
        ----------
        time, rate : s and rad/s, before the threshold filter, shape (n,)
        sensitivity : of the rates to the calibration, shape (m, n), as in `compensation`

        Returns
        -------
        filtered rate, rad/s, heading and its standard deviation, rad, shape (n,) each

        """
        if not len(time):
            return rate, rate, rate
        filtered = self._filter_block(time, rate)
        kept = (filtered == rate).astype(float)
        unseen = self._gap_variances(time, rate, kept)
        heading, moving_time, *grown = self._integrate_rows(
            time, np.vstack([filtered, kept, kept * sensitivity]))
        calibration = quadratic_form(self._covariance,
                                     np.reshape(grown, (len(self._covariance), len(time))))
        return (filtered, heading,
                np.sqrt(calibration + self._noise.heading_variance(moving_time) + unseen))

    def _gap_variances(self, time: Array, rate: Array, kept: Array) -> Array:
        """Return the variance by the gaps so far, rad², shape (n,)."""
        unseen, (last_time, last_rows) = np.zeros(len(time)), self._last_sample
        before = ((float(last_time[0]), self._last_rate, bool(last_rows[1, 0])) if len(last_time)
                  else None)
        samples = zip(time.tolist(), rate.tolist(), (kept > 0.0).tolist())
        for index, sample in enumerate(samples):
            gap = self._gaps.add(sample[0] - before[0], sample[1], before[1]) if before else None
            if gap is not None and before is not None and (sample[2] or before[2]):
                self._gap_variance += gap.variance
            unseen[index], before = self._gap_variance, sample
        self._last_rate = float(rate[-1])
        return unseen

    def _filter_block(self, time: Array, rate: Array) -> Array:
        carried = len(self._window_samples[0])
        time = np.concatenate([self._window_samples[0], time])
        rate = np.concatenate([self._window_samples[1], rate])
        begin = np.searchsorted(time, time[-1] - self._settings.window, side='right')
        self._window_samples = time[begin:], rate[begin:]
        return filter_rates(self._settings, time, rate)[carried:]

    def _integrate_rows(self, time: Array, rows: Array) -> Array:
        carried = len(self._last_sample[0])
        time = np.concatenate([self._last_sample[0], time])
        rows = np.hstack([self._last_sample[1], rows])
        grown = np.array(
            [integrate(time, row, begin) for row, begin in zip(rows, self._integrals)])
        self._last_sample, self._integrals = (time[-1:], rows[:, -1:]), grown[:, -1]
        return grown[:, carried:]
