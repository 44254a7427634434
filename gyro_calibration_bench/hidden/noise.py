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
The noise of a hidden gyro, its generation, and the information on an effect in it.

Everything that is not white is a sum of first-order Markov processes: the rate random walk is one
that never decays, and flicker is a ladder of stationary ones, whose time constants increase by
factors of four. The information on an effect is then exact and cheap: the precision matrix of all
their states over all samples is banded, and so ``x' S^-1 y`` takes one banded Cholesky factor
(`Whitening`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
import math

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.signal import lfilter

#: Between the time constants of the ladder that makes flicker.
TIME_CONSTANT_RATIO = 4.0
#: Bias instability B whose Allan floor equals the peak of a Gauss-Markov process of standard
#: deviation 1: 0.437 sqrt(2) / 0.664.
GAUSS_MARKOV_FLOOR = 0.437 * math.sqrt(2.0) / math.sqrt(2.0 * math.log(2.0) / math.pi)
KINDS = ('white', 'walk', 'flicker', 'gauss_markov', 'mixed')


@dataclass(frozen=True)
class NoiseFigures:
    """The noise of one gyro, in SI."""

    angle_random_walk: float  # N, rad/√s
    bias_instability: float = 0.0  # B, rad/s, with the spectrum B² / (2 pi f)
    rate_random_walk: float = 0.0  # K, rad/s/√s
    correlated: float = 0.0  # standard deviation of a Gauss-Markov process, rad/s
    correlation_time: float = 60.0  # its time constant, s

    @property
    def equivalent_floor(self) -> float:
        """Bias instability without a Gauss-Markov process, at equal worst deviation, rad/s."""
        return math.hypot(self.bias_instability, GAUSS_MARKOV_FLOOR * self.correlated)

    def sample_deviation(self, interval: float) -> float:
        """Return the standard deviation of the white noise of one sample, rad/s."""
        return self.angle_random_walk / math.sqrt(interval)


def draw_figures(kind: str, generator: np.random.Generator) -> NoiseFigures:
    """
    Draw the figures of a gyro between a good fibre gyro and a cheap micromachined one.

    Flicker, random walk and Gauss-Markov process rise out of the white noise at random averaging
    times.
    """
    if kind not in KINDS:
        raise ValueError(f'no noise {kind!r}; wanted one of {", ".join(KINDS)}')
    white = math.exp(generator.uniform(math.log(5e-6), math.log(5e-4)))
    crossing = np.exp(generator.uniform(math.log(20.0), math.log(300.0), 3))
    figures = NoiseFigures(white, white / math.sqrt(crossing[0]) / 0.664,
                           math.sqrt(3.0) * white / crossing[1],
                           white / math.sqrt(crossing[2]) * generator.uniform(1.0, 2.5),
                           math.exp(generator.uniform(math.log(5.0), math.log(150.0))))
    absent_figures = {'white': ('bias_instability', 'rate_random_walk', 'correlated'),
                      'walk': ('bias_instability', 'correlated'),
                      'flicker': ('rate_random_walk', 'correlated'),
                      'gauss_markov': ('bias_instability', 'rate_random_walk'),
                      'mixed': ('bias_instability',) if generator.random() < 0.5 else ()}[kind]
    return replace(figures, **dict.fromkeys(absent_figures, 0.0))


@dataclass(frozen=True)
class MarkovProcess:
    """x[k] = factor x[k-1] + innovations of a standard deviation, from a first x of its own."""

    factor: float
    innovation: float
    first_deviation: float


def markov_processes(figures: NoiseFigures, count: int, interval: float) -> list[MarkovProcess]:
    """Return the first-order processes that the noise has beside the white one."""
    found = []
    if figures.rate_random_walk:
        step = figures.rate_random_walk * math.sqrt(interval)
        found.append(MarkovProcess(1.0, step, step))
    if figures.correlated:
        found.append(_stationary(figures.correlated, figures.correlation_time, interval))
    if figures.bias_instability:
        # processes of variance v per factor e of the time constant have the spectrum v / (2 f)
        each = figures.bias_instability * math.sqrt(math.log(TIME_CONSTANT_RATIO) / math.pi)
        rungs = math.ceil(math.log(16.0 * count) / math.log(TIME_CONSTANT_RATIO))
        found += [_stationary(each, 0.5 * interval * TIME_CONSTANT_RATIO ** rung, interval)
                  for rung in range(rungs)]
    return found


def _stationary(deviation: float, time_constant: float, interval: float) -> MarkovProcess:
    factor = math.exp(-interval / time_constant)
    return MarkovProcess(
        factor, deviation * math.sqrt(-math.expm1(-2.0 * interval / time_constant)), deviation)


def generate_noise(figures: NoiseFigures, count: int, interval: float,
                   generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return the white part and the slow part of noise, rad/s."""
    white = figures.sample_deviation(interval) * generator.standard_normal(count)
    slow = np.zeros(count)
    for process in markov_processes(figures, count, interval):
        innovations = process.innovation * generator.standard_normal(count)
        innovations[0] *= process.first_deviation / process.innovation
        slow += lfilter([1.0], [1.0, -process.factor], innovations)
    return white, slow


class Whitening:
    """
    Inner products x' S^-1 y for the covariance S of the noise of one recording.

    With r = white + H s, where s are the states of the slow processes and P their banded precision
    matrix, S^-1 = (1 - H C H' / v) / v with C = (P + H' H / v)^-1 and v the variance of the white
    noise. The steps of an encoder add a state for each sample, the error of the reference's
    heading, whose differences are in the residual.
    """

    def __init__(self, figures: NoiseFigures, count: int, interval: float,
                 encoder_step: float = 0.0):
        self._variance = figures.sample_deviation(interval) ** 2
        slow = markov_processes(figures, count, interval)
        self._slow_count, self._has_encoder = len(slow), encoder_step > 0.0
        self._state_count, self._count, self._interval = (
            len(slow) + self._has_encoder, count, interval)
        if self._state_count:
            self._factor = cholesky_banded(self._precision(slow, encoder_step), overwrite_ab=True,
                                           check_finite=False)

    def _precision(self, slow: list[MarkovProcess], encoder_step: float) -> np.ndarray:
        """Return P + H' H / v, upper banded, the states of one sample side by side."""
        width, count, information = self._state_count, self._count, 1.0 / self._variance
        # band[width - d, k, j]: with the state d places before state j of sample k
        band = np.zeros((width + 1, count, width))
        for place, process in enumerate(slow):
            inner = 1.0 / process.innovation ** 2
            band[width, :, place] = inner * (1.0 + process.factor ** 2)
            band[width, 0, place] = (1.0 / process.first_deviation ** 2
                                     + inner * process.factor ** 2)
            band[width, -1, place] = inner
            band[0, 1:, place] = -inner * process.factor
        for later in range(self._slow_count):
            for earlier in range(later + 1):
                band[width - later + earlier, :, later] += information
        if self._has_encoder:
            self._add_encoder(band, encoder_step, information)
        return band.reshape(width + 1, count * width)

    def _add_encoder(self, band: np.ndarray, step: float, information: float) -> None:
        """Add the heading error e of the reference: residual -(e[k] - e[k-1]) / interval."""
        width, last, rate = self._state_count, self._state_count - 1, 1.0 / self._interval
        band[width, :, last] += 12.0 / step ** 2
        band[width, 1:, last] += information * rate ** 2
        band[width, :-1, last] += information * rate ** 2
        band[0, 1:, last] -= information * rate ** 2
        for place in range(self._slow_count):
            band[width - last + place, 1:, last] -= information * rate  # with e of the same sample
            band[width - 1 - place, 1:, place] += information * rate  # of the sample before

    def solve(self, signal: np.ndarray) -> np.ndarray:
        """Return S^-1 times a signal of shape (n,)."""
        if not self._state_count:
            return signal / self._variance
        seen = np.zeros((self._count, self._state_count))
        seen[:, :self._slow_count] = signal[:, None]
        if self._has_encoder:
            seen[1:, -1] -= signal[1:] / self._interval
            seen[:-1, -1] += signal[1:] / self._interval
        states = cho_solve_banded((self._factor, False), seen.ravel(),
                                  check_finite=False).reshape(self._count, self._state_count)
        explained = states[:, :self._slow_count].sum(axis=1)
        if self._has_encoder:
            explained[1:] -= np.diff(states[:, -1]) / self._interval
        return (signal - explained / self._variance) / self._variance


def spectrum(figures: NoiseFigures, count: int, interval: float) -> np.ndarray:
    """Return the variances of the noise at k / (2 T), k = 1 to n - 1, scaled as of white noise."""
    angle = math.pi * np.arange(1, count) / count
    total = np.full(count - 1, figures.sample_deviation(interval) ** 2)
    for process in markov_processes(figures, count, interval):
        total += process.innovation ** 2 / (1.0 - 2.0 * process.factor * np.cos(angle)
                                            + process.factor ** 2)
    return total


def divergence(figures: NoiseFigures, expected: NoiseFigures, count: int,
               interval: float) -> float:
    """
    Return the distance of a noise from another, in standard deviations.

    It is the root of twice the information that distinguishes them. For a small change of one
    figure it is the change over its standard deviation.
    """
    ratio = spectrum(figures, count, interval) / spectrum(expected, count, interval)
    return math.sqrt(float(np.sum(ratio - 1.0 - np.log(ratio))))
