"""From rates to a heading: the threshold filter, the integration on the stamps, and how far the heading may be off."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from gyro_calibration.compensation import quadratic_form
from gyro_calibration.log import CACHED, DEGREE, Array
from gyro_calibration.noise import Noise


@dataclass(frozen=True)
class Threshold:
    """
    Settings of the threshold filter (Hong and Park, eq. 12).

    Attributes
    ----------
    rate : rad/s; below it the robot counts as standing; 0 switches the filter off
    window : s; the mean over it is compared with the rate. 0 compares single samples, as published
    angle_random_walk : rad/√s; a window that varies by more than three times what this explains is motion, whatever its mean; 0 does
        not look at it

    """

    rate: float = 0.3 * DEGREE
    window: float = 0.2
    angle_random_walk: float = 0.0


class ThresholdFilter:
    """
    Set the rate to zero while the robot stands, sample by sample.

    As published the filter decides on single samples. With the noise of a cheap gyro this does next to nothing while it stands, so here
    the mean over a short window decides. What it takes away is for the caller to count: a turn slower than the threshold is lost.

    """

    def __init__(self, settings: Threshold):
        """Begin with an empty window."""
        self.settings = settings
        self._window: deque[tuple[float, float]] = deque()
        self._sum = 0.0
        self._squares = 0.0

    def clear(self) -> None:
        """Forget the window, as after a gap."""
        self._window.clear()
        self._sum = self._squares = 0.0

    def filter(self, time: float, rate: float) -> float:
        """Return the rate, rad/s, or zero; `time` in s increases from call to call."""
        if not self.settings.rate:
            return rate
        return 0.0 if self._stands(time, rate) else rate

    def _stands(self, time: float, rate: float) -> bool:
        window = self._window
        window.append((time, rate))
        self._sum += rate
        self._squares += rate * rate
        while window[0][0] <= time - self.settings.window and len(window) > 1:
            old = window.popleft()[1]
            self._sum -= old
            self._squares -= old * old
        mean = self._sum / len(window)
        return abs(mean) < self.settings.rate and not self._shakes(self._squares / len(window) - mean * mean)

    def _shakes(self, variance: float) -> bool:
        """Tell whether the window varies by more than noise would."""
        explained, lasts = self.settings.angle_random_walk ** 2 * len(self._window), self._window[-1][0] - self._window[0][0]
        return 0.0 < 9.0 * explained < variance * lasts


class HeadingIntegrator:
    """
    Integrate rates by the trapezoid rule on their stamps, with the variance of the heading.

    Attributes
    ----------
    heading : rad, continuous, not wrapped
    deleted : heading that the threshold filter took away, rad

    """

    def __init__(self, maximum_gap: float = 1.0):
        """Begin at heading zero; over a gap longer than `maximum_gap`, s, nothing is integrated."""
        self.heading = 0.0
        self.deleted = 0.0
        self._noise = Noise()
        self._maximum_gap = maximum_gap
        self._covariance = np.zeros((0, 0))
        self._settled = 0.0
        self._last: tuple[float, float, float, np.ndarray] | None = None
        self._begin_variance()

    def _begin_variance(self) -> None:
        self._moving_time = 0.0
        self._sensitivity = np.zeros(len(self._covariance))

    def reset(self) -> None:
        """Call this direction zero, known exactly."""
        self.heading = self.deleted = self._settled = 0.0
        self._begin_variance()

    def use(self, noise: Noise, covariance: np.ndarray) -> None:
        """Go on with other noise figures and another covariance of the calibration; the heading does not jump."""
        self._settled = self.variance
        self._noise, self._covariance = noise, covariance
        if self._last is not None:
            self._last = (*self._last[:3], np.zeros(len(covariance)))
        self._begin_variance()

    @property
    def variance(self) -> float:
        """Return the variance of the heading, rad²."""
        calibration = self._sensitivity @ self._covariance @ self._sensitivity
        return self._settled + float(calibration) + self._noise.heading_variance(self._moving_time)

    def add(self, time: float, rate: float, filtered: float, sensitivity: np.ndarray) -> str:
        """
        Take one sample.

        Parameters
        ----------
        time : stamp, s
        rate, filtered : before and after the threshold filter, rad/s
        sensitivity : of the rate to the values of the calibration, shape (m,), as in `compensation`

        Returns
        -------
        '', or why the integration began anew with this sample

        """
        last, self._last = self._last, (time, rate, filtered, sensitivity)
        if last is None:
            return ''
        before, last_rate, last_filtered, last_sensitivity = last
        interval = time - before
        if interval < 0.0 or interval > self._maximum_gap:
            return self._restart(interval, max(abs(rate), abs(last_rate)))
        half = 0.5 * interval
        self.heading += half * (filtered + last_filtered)
        self.deleted += half * (rate - filtered + last_rate - last_filtered)
        kept, last_kept = float(filtered == rate), float(last_filtered == last_rate)
        self._moving_time += half * (kept + last_kept)
        if len(sensitivity):
            self._sensitivity += half * (kept * sensitivity + last_kept * last_sensitivity)
        return ''

    def _restart(self, interval: float, fastest: float) -> str:
        """Begin anew after a gap or a jump back; what may have been turned meanwhile goes into the variance."""
        if interval < 0.0:
            return f'the stamp jumps back by {-interval:.3f} s'
        self._settled += (fastest * interval) ** 2
        return f'no samples for {interval:.3f} s'


def integrate(time: Array, rate: Array, begin: float = 0.0) -> Array:
    """Return the heading, rad, shape (n,), from rates by the trapezoid rule; it begins at `begin`."""
    heading = np.empty(len(time))
    heading[:1] = begin
    for first in range(1, len(time), CACHED):
        end = min(first + CACHED, len(time))
        turned = np.add(rate[first:end], rate[first - 1:end - 1], out=heading[first:end])
        turned *= time[first:end] - time[first - 1:end - 1]
        turned *= 0.5
        turned[0] += heading[first - 1]
        np.cumsum(turned, out=turned)
    return heading


def filter_rates(settings: Threshold, time: Array, rate: Array) -> Array:
    """Return what `ThresholdFilter` makes of a whole log, rad/s, shape (n,)."""
    if not settings.rate:
        return rate
    end = np.arange(1, len(rate) + 1)
    begin = np.minimum(np.searchsorted(time, time - settings.window, side='right'), end - 1)
    sums, squares = (np.concatenate([[0.0], np.cumsum(values)]) for values in (rate, rate * rate))
    count = end - begin
    mean = (sums[end] - sums[begin]) / count
    variance = (squares[end] - squares[begin]) / count - mean * mean
    explained = 9.0 * settings.angle_random_walk ** 2 * count
    shakes = (explained > 0.0) & (explained < variance * (time - time[begin]))
    return np.where((np.abs(mean) < settings.rate) & ~shakes, 0.0, rate)


class BlockIntegrator:
    """
    Filter and integrate the rates of a log that comes block by block, with the same result as in one piece.

    It gives what `ThresholdFilter` and `HeadingIntegrator` give sample by sample for a log without gaps.

    """

    def __init__(self, settings: Threshold, noise: Noise, covariance: Array):
        """Begin at heading zero; `covariance` is that of the values of the calibration, shape (m, m)."""
        self._settings, self._noise, self._covariance = settings, noise, covariance
        self._window: tuple[Array, Array] = np.zeros(0), np.zeros(0)
        self._last: tuple[Array, Array] = np.zeros(0), np.zeros((2 + len(covariance), 0))
        self._grown: Array = np.zeros(2 + len(covariance))

    def add(self, time: Array, rate: Array, sensitivity: Array) -> tuple[Array, Array, Array]:
        """
        Take the next block, which may be empty.

        Parameters
        ----------
        time, rate : s and rad/s, before the threshold filter, shape (n,)
        sensitivity : of the rates to the values of the calibration, shape (m, n), as in `compensation`

        Returns
        -------
        filtered rate, rad/s, heading and its standard deviation, rad, shape (n,) each

        """
        if not len(time):
            return rate, rate, rate
        filtered = self._filtered(time, rate)
        kept = (filtered == rate).astype(float)
        heading, moving_time, *grown = self._integrated(time, np.vstack([filtered, kept, kept * sensitivity]))
        calibration = quadratic_form(self._covariance, np.reshape(grown, (len(self._covariance), len(time))))
        return filtered, heading, np.sqrt(calibration + self._noise.heading_variance(moving_time))

    def _filtered(self, time: Array, rate: Array) -> Array:
        carried = len(self._window[0])
        time, rate = np.concatenate([self._window[0], time]), np.concatenate([self._window[1], rate])
        begin = np.searchsorted(time, time[-1] - self._settings.window, side='right')
        self._window = time[begin:], rate[begin:]
        return filter_rates(self._settings, time, rate)[carried:]

    def _integrated(self, time: Array, grows: Array) -> Array:
        carried = len(self._last[0])
        time, grows = np.concatenate([self._last[0], time]), np.hstack([self._last[1], grows])
        grown = np.array([integrate(time, row, begin) for row, begin in zip(grows, self._grown)])
        self._last, self._grown = (time[-1:], grows[:, -1:]), grown[:, -1]
        return grown[:, carried:]
