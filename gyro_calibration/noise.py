"""The noise of a gyro, in the words and units of IEEE Std 952: angle random walk, bias instability, rate random walk."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.signal import oaconvolve

from gyro_calibration.log import Array, Number

#: Floor of the Allan deviation over the bias instability B: sqrt(2 ln 2 / pi).
ALLAN_FLOOR = math.sqrt(2.0 * math.log(2.0) / math.pi)


@dataclass(frozen=True)
class Noise:
    """
    The noise figures of a gyro.

    Attributes
    ----------
    angle_random_walk : N, rad/√s; 0 says that it is not known
    bias_instability : B, rad/s, so that the floor of the Allan deviation is 0.664 B
    rate_random_walk : K, rad/s/√s

    """

    angle_random_walk: float = 0.0
    bias_instability: float = 0.0
    rate_random_walk: float = 0.0

    def rate_variance(self, interval: float) -> float:
        """Return the variance of one sample, (rad/s)², that comes every `interval` s."""
        return self.angle_random_walk ** 2 / interval

    def allan_variance(self, duration: Number) -> Number:
        """Return the Allan variance at an averaging time of `duration` s, (rad/s)²: half the mean square of neighbours' difference."""
        return (self.angle_random_walk ** 2 / duration + (ALLAN_FLOOR * self.bias_instability) ** 2
                + self.rate_random_walk ** 2 * duration / 3.0)

    def wander(self, age: float, duration: float) -> float:
        """
        Return the variance of how far a mean over `duration` s is from one `age` s before, (rad/s)², but for the white noise.

        Flicker of spectrum B² / (2 pi f), on both sides of zero, has the generalized covariance -B² / pi log|t|. Of means over T that are a
        time t apart that gives 2 B² / pi (log(t / T) + 3/2), for t far above T.

        """
        flicker = 2.0 / math.pi * self.bias_instability ** 2 * (math.log(max(age / duration, 1.0)) + 1.5)
        return flicker + self.rate_random_walk ** 2 * max(age, duration)

    def heading_variance(self, duration: Number) -> Number:
        """
        Return the variance, rad², of a heading that was integrated for `duration` s from a bias known at its start.

        Flicker is counted by its Allan floor as if it were a constant bias, which is what it looks like for a while.

        """
        return (self.angle_random_walk ** 2 * duration + (ALLAN_FLOOR * self.bias_instability * duration) ** 2
                + self.rate_random_walk ** 2 * duration ** 3 / 3.0)


def simulate_noise(noise: Noise, count: int, interval: float, generator: np.random.Generator) -> Array:
    """
    Return noise of shape (count,), rad/s, for samples every `interval` s.

    Flicker is white noise through the half-integrator of Kasdin (1995), eq. 116; its spectrum is B² / (2 pi f).

    """
    white = generator.standard_normal(count) * noise.angle_random_walk / math.sqrt(interval)
    innovations = generator.standard_normal(count) * noise.bias_instability
    response = np.cumprod(np.concatenate([[1.0], 1.0 - 0.5 / np.arange(1.0, count)]))
    flicker = oaconvolve(innovations, response)[:count] if noise.bias_instability else innovations
    walk = np.cumsum(generator.standard_normal(count)) * noise.rate_random_walk * math.sqrt(interval)
    return white + flicker + walk
