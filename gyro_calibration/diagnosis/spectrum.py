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
The noise of a residual in its cosine transform, where whitening is a division.

White noise and a random walk of the rate with any start have cosines as their exact eigenvectors;
those of a Gauss-Markov process are nearly so. The coefficient of order 0 is the bias and is left
out. The rounding of an encoder is white noise of the heading; its rate by cubic splines is that
times ``(3 sin / (2 + cos))²``.

"""

from __future__ import annotations

from dataclasses import dataclass
import math

from gyro_calibration.logs.log import Array
import numpy as np
from scipy.fft import dct, idct

#: Parts of the angle in which the noise of a filtered output has levels of its own, at most; the
#: least number of coefficients in each; and the lowest level, for what is nearly free of noise
#: would count for more than it is worth.
_PARTS, _LEAST, _LOWEST = 32, 100, 0.003
#: By how many of its standard deviations the level must fall for a filter: that of the logarithm
#: of a median of n is 2.33 over root n.
_SURE, _SCATTER = 4.5, 2.33
#: Numbers of random walks, of strengths and times of Gauss-Markov processes, and of corners of
#: flicker that are tried: see `noise_grid`.
_WALKS, _STRENGTHS, _TIMES, _CORNERS = 14, 7, 7, 14


@dataclass(frozen=True)
class Shape:
    """
    A noise relative to its white part: variance of a coefficient over that of white noise.

    Attributes
    ----------
    walk : rate random walk, K² / N², 1/s²
    strength : variance of the Gauss-Markov part over the spectral density of the white one, 1/s
    correlation_time : of the Gauss-Markov part, s
    reference : variance of the reference's rounding over the interval squared, relative to that of
        a white sample
    flicker : frequency where the spectral density of flicker, B² / (2 pi f), is the white one, Hz

    """

    walk: float = 0.0
    strength: float = 0.0
    correlation_time: float = 1.0
    reference: float = 0.0
    flicker: float = 0.0

    def variance(self, angle: Array, interval: Array | float) -> Array:
        """
        Return the variance of coefficients relative to the white part.

        Parameters
        ----------
        angle : pi k / n of each coefficient
        interval : of the samples, s

        """
        wave = 2.0 - 2.0 * np.cos(angle)
        total = 1.0 + self.reference * differentiated(angle)
        if self.walk:
            total = total + self.walk * interval ** 2 / wave
        if self.flicker:
            total = total + self.flicker * 2.0 * math.pi * interval / angle
        if self.strength:
            kept = np.exp(-interval / self.correlation_time)
            total = total + (self.strength * interval * (1.0 - kept ** 2)
                             / ((1.0 - kept) ** 2 + kept * wave))
        return total


def differentiated(angle: Array) -> Array:
    """Return the gain in variance of white noise by a cubic spline's derivative, interval 1."""
    return (3.0 * np.sin(angle) / (2.0 + np.cos(angle))) ** 2


def transform(values: Array) -> Array:
    """Return the cosine transform of a signal or of each row, no mean: shape (..., n - 1)."""
    return dct(values, norm='ortho', axis=-1)[..., 1:]


def inverse(coefficients: Array) -> Array:
    """Return the signal of coefficients, with no mean: shape (n,)."""
    return idct(np.concatenate([[0.0], coefficients]), norm='ortho')


def angles(count: int) -> Array:
    """Return pi k / n of the coefficients of a signal of so many samples: shape (n - 1,)."""
    return np.arange(1, count) * math.pi / count


def levels(whitened: Array) -> Array:
    """
    Return the power in equal parts of the angle over that in the second part: shape (parts,).

    The first part is as the second: what is slow is for `Shape` to say. Too few coefficients have
    one part.

    """
    parts = np.array_split(whitened ** 2, max(min(_PARTS, len(whitened) // _LEAST), 1))
    found = np.array([part.mean() for part in parts])
    return (np.maximum(np.concatenate([found[1:2], found[1:]]) / found[1], _LOWEST)
            if len(found) > 1 else np.ones(1))


def fall(whitened: Array) -> float:
    """Return the power in the last quarter of the angle over the second; 1 if maybe chance."""
    _, second, _, last = (float(np.median(part ** 2)) for part in np.array_split(whitened, 4))
    by_chance = math.exp(-_SURE * _SCATTER * math.sqrt(8.0 / len(whitened)))
    return last / second if last < by_chance * second else 1.0


def level(angle: Array, found: Array) -> Array:
    """Return the level at each angle, by lines in the logarithm between middles of parts."""
    return np.exp(np.interp(angle, (np.arange(len(found)) + 0.5) * math.pi / len(found),
                            np.log(found)))


def bands(angle: Array, interval: float, single: int = 24, ratio: float = 1.12) -> Array:
    """Return the first index of each band of coefficients: the lowest alone, then by ratio."""
    edges, count = list(range(min(single, len(angle)))), len(angle)
    while edges and edges[-1] * ratio + 1.0 < count:
        edges.append(int(math.ceil(edges[-1] * ratio + 0.5)))
    return np.unique([edge for edge in edges if edge < count])


def noise_grid(interval: float, duration: float, reference: float = 0.0) -> list[Shape]:
    """
    Return noises that a residual may have, coarse enough to try all.

    A random walk shows where it is stronger than white noise over the log; a Gauss-Markov part
    where its correlation time lies between some samples and the log. Flicker takes the place of a
    Gauss-Markov part.

    """
    lowest = 0.02 / duration ** 2
    highest = max(1e5 * lowest, 1e-3 / interval ** 2 * 1e-3)
    walks = [0.0, *np.geomspace(lowest, highest, _WALKS)]
    times = np.geomspace(max(4.0 * interval, duration / 2000.0), duration / 3.0, _TIMES)
    # By their density at frequency 0 over the white one, from hardly seen to a hundred times.
    strong = [(ratio / (2.0 * time), time) for time in times
              for ratio in np.geomspace(0.3, 1000.0, _STRENGTHS)]
    plain = [Shape(walk, strength, time, reference) for walk in walks
             for strength, time in [(0.0, 1.0), *strong]]
    corners = np.geomspace(0.1 / duration, 0.3 / interval, _CORNERS)
    return plain + [Shape(walk, reference=reference, flicker=corner) for walk in walks[::4]
                    for corner in corners]
