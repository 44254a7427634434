# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Noise of a gyro by IEEE Std 952: terms, Allan variances, processes and simulated samples."""

from collections.abc import Callable
from dataclasses import dataclass
import math

from gyro_calibration.logs.log import Array, Number
import numpy as np
from scipy.fft import irfft, next_fast_len, rfft
from scipy.special import xlogy

#: Floor of the Allan deviation over the bias instability B: sqrt(2 ln 2 / pi).
ALLAN_FLOOR_RATIO = math.sqrt(2.0 * math.log(2.0) / math.pi)
#: Standard deviation of a Gauss-Markov process whose Allan deviation has its peak at the floor by
#: a bias instability of 1: the peak is at 1.89 correlation times.
MARKOV_FLOOR_RATIO = ALLAN_FLOOR_RATIO / 0.617
#: Averaging time of the bias estimate, s: the length of a self-calibration.
BIAS_AVERAGING_TIME = 20.0
#: Time constants, s, of the Gauss-Markov processes that approximate flicker from 1 s to hours.
_FLICKER_TIME_CONSTANTS = np.geomspace(3.0, 3000.0, 4)


@dataclass(frozen=True)
class Noise:
    """The noise figures of a gyro."""

    angle_random_walk: float = 0.0  # N, rad/√s; 0 where it is not known
    bias_instability: float = 0.0  # B, rad/s; the floor of the Allan deviation is 0.664 B
    rate_random_walk: float = 0.0  # K, rad/s/√s

    def rate_variance(self, interval: float) -> float:
        """Return the variance of the white noise of samples every `interval` s, (rad/s)²."""
        return self.angle_random_walk ** 2 / interval

    @property
    def allan_floor(self) -> float:
        """Return the floor of the Allan deviation by the flicker alone, rad/s."""
        return ALLAN_FLOOR_RATIO * self.bias_instability

    def allan_variance(self, duration: Number) -> Number:
        """Return the Allan variance at an averaging time of `duration` s, (rad/s)²."""
        return (self.angle_random_walk ** 2 / duration + self.allan_floor ** 2
                + self.rate_random_walk ** 2 * duration / 3.0)

    def mean_change_variance(self, elapsed: Number, duration: float) -> Number:
        """Return the variance of a change of means over `duration` s in `elapsed` s, (rad/s)²."""
        # White noise is not included. Flicker with the two-sided spectrum B² / (2 pi f) has the
        # generalized covariance -B² / pi log|t|.
        flicker = 2.0 / math.pi * self.bias_instability ** 2 * (
            np.log(np.maximum(elapsed / duration, 1.0)) + 1.5)
        return flicker + self.rate_random_walk ** 2 * np.maximum(elapsed, duration)

    def flicker_processes(self) -> tuple[Array, float]:
        """Return k time constants, s, and the variance, (rad/s)², of processes for flicker."""
        # With time constants a factor r apart and variances of B² ln(r) / pi, the two-sided
        # spectrum between them is B² / (2 pi f).
        constants = (_FLICKER_TIME_CONSTANTS
                     if self.bias_instability else _FLICKER_TIME_CONSTANTS[:0])
        return constants, self.bias_instability ** 2 * math.log(10.0) / math.pi

    def heading_variance(self, duration: Number) -> Number:
        """Return the variance, rad², of a heading after `duration` s."""
        # The bias is estimated as its mean over the `BIAS_AVERAGING_TIME` s before.
        variance = (self.angle_random_walk ** 2 * duration + self.rate_random_walk ** 2
                    * (duration ** 3 + BIAS_AVERAGING_TIME * duration ** 2) / 3.0)
        constants, of_each = self.flicker_processes()
        for constant in constants:
            within, shared = averaged_process_moments(constant)
            decayed = constant * (1.0 - np.exp(-duration / constant))
            variance = variance + of_each * (2.0 * constant * (duration - decayed) + duration ** 2
                                             * within - 2.0 * duration * decayed * shared)
        return variance


def averaged_process_moments(time_constant: Number) -> tuple[Number, Number]:
    """Return variance, and covariance with the end, of a unit process's calibration mean."""
    ratio = BIAS_AVERAGING_TIME / time_constant
    decayed = 1.0 - np.exp(-ratio)
    return 2.0 * (ratio - decayed) / ratio ** 2, decayed / ratio


def increment_covariance(noise: Noise, edges: Array) -> Array:
    """
    Return the covariance of means of the noise between edges, s, shape (n - 1, n - 1), (rad/s)².

    For sums whose weights add up to zero: flicker and random walk have no finite variance.
    """
    apart, lengths = edges[:, None] - edges, np.diff(edges)
    angle = (noise.bias_instability ** 2 * FLICKER.angle_covariance(apart)
             + noise.rate_random_walk ** 2 * RATE_RANDOM_WALK.angle_covariance(apart))
    means = np.diff(np.diff(angle, axis=0), axis=1) / np.outer(lengths, lengths)
    return means + np.diag(noise.angle_random_walk ** 2 / lengths)


@dataclass(frozen=True)
class GaussMarkov:
    """A first-order process: density of the driving noise, rad/s/√s, and correlation time, s."""

    density: float
    correlation_time: float

    def allan_variance(self, duration: Array) -> Array:
        """Return the Allan variance at averaging times, s, of shape (n,) (IEEE 952, C.21)."""
        ratio = duration / self.correlation_time
        # a series where the difference of the exponentials would lose all digits
        series = ratio ** 3 * (2.0 / 3.0 - ratio / 2.0)
        bracket = 2.0 * ratio + 4.0 * np.expm1(-ratio) - np.expm1(-2.0 * ratio)
        bracket = np.where(ratio < 1e-3, series, bracket)
        return self.density ** 2 * self.correlation_time * bracket / (2.0 * ratio ** 2)

    @property
    def standard_deviation(self) -> float:
        """Return the standard deviation of the process, rad/s."""
        return self.density * math.sqrt(0.5 * self.correlation_time)

    def angle_covariance(self, time: Number) -> Array:
        """Return the covariance of the angle, rad², as `NoiseTerm.angle_covariance` does."""
        ratio = np.abs(np.asarray(time, dtype=float)) / self.correlation_time
        # a series where ratio - 1 + exp(-ratio) would lose all digits
        growth = np.where(ratio < 1e-4, ratio ** 2 * (0.5 - ratio / 6.0), ratio + np.expm1(-ratio))
        return -(self.standard_deviation * self.correlation_time) ** 2 * growth


@dataclass(frozen=True)
class NoiseTerm:
    """A noise term by the slope of its Allan deviation (IEEE Std 952, C.1)."""

    name: str
    symbol: str
    unit: str  # in SI
    slope: float  # of log Allan deviation over log averaging time
    allan_factor: float  # of coefficient² * time ** (2 slope) in the Allan variance
    #: at a time difference, for a coefficient of 1, except what second differences remove
    angle_covariance: Callable[[Number], Array]

    def allan_variance(self, time: Number) -> Array:
        """Return the Allan variance for a coefficient of 1."""
        return self.allan_factor * np.asarray(time, dtype=float) ** (2.0 * self.slope)


ANGLE_RANDOM_WALK = NoiseTerm('angle_random_walk', 'N', 'rad/√s', -0.5, 1.0,
                              lambda time: -0.5 * np.abs(time))
FLICKER = NoiseTerm('bias_instability', 'B', 'rad/s', 0.0, ALLAN_FLOOR_RATIO ** 2,
                    lambda time: xlogy(np.square(time), np.abs(time)) / (2.0 * math.pi))
RATE_RANDOM_WALK = NoiseTerm('rate_random_walk', 'K', 'rad/s/√s', 0.5, 1.0 / 3.0,
                             lambda time: np.abs(time) ** 3 / 12.0)
QUANTIZATION_NOISE = NoiseTerm('quantization', 'Q', 'rad', -1.0, 3.0,
                               lambda time: (np.asarray(time) == 0.0).astype(float))
RATE_RAMP = NoiseTerm('rate_ramp', 'R', 'rad/s²', 1.0, 0.5, lambda time: 0.0 * np.asarray(time))
NOISE_TERMS = (ANGLE_RANDOM_WALK, FLICKER, RATE_RANDOM_WALK, QUANTIZATION_NOISE, RATE_RAMP)


def simulate_noise(noise: Noise, count: int, interval: float,
                   generator: np.random.Generator) -> Array:
    """Return noise of shape (count,), rad/s, for samples every `interval` s."""
    # Flicker is white noise through the half-integrator of Kasdin (1995), eq. 116.
    white = generator.standard_normal(count) * noise.angle_random_walk / math.sqrt(interval)
    innovations = generator.standard_normal(count) * noise.bias_instability
    response = np.cumprod(np.concatenate([[1.0], 1.0 - 0.5 / np.arange(1.0, count)]))
    flicker = innovations
    if noise.bias_instability:  # through a causal response
        length = next_fast_len(2 * count, real=True)
        flicker = irfft(rfft(innovations, length) * rfft(response, length), length)[:count]
    walk = (np.cumsum(generator.standard_normal(count))
            * noise.rate_random_walk * math.sqrt(interval))
    return white + flicker + walk
