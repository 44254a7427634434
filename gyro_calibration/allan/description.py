# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""A combination of parts, fitted to Allan variances by generalized least squares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from gyro_calibration.allan.freedom import chi_squared_bounds
from gyro_calibration.allan.octaves import Octaves
from gyro_calibration.allan.parts import BEND_PLACE, RAMP_PLACE
from gyro_calibration.logs.log import Array
import numpy as np
from scipy.optimize import nnls
from scipy.special import chdtrc

#: What a further part must take off -2 ln likelihood. White noise alone then shows no further part
#: in 95 of 100 records.
_EVIDENCE = 10.0

#: A combination of other parts explains a record as well if its -2 ln likelihood is within this.
RIVAL = 6.0

#: Least probability of a misfit as large as that of an accepted description.
_CHANCE = 0.05

#: Passes of the fit; two or three suffice.
_PASSES = 12


@dataclass(frozen=True)
class Description:
    """
    A combination of parts, fitted to octaves.

    Attributes
    ----------
    octaves : the Allan variances that it describes
    squares : squared coefficients, shape (6,)
    half : Cholesky factor of the covariance of the variances

    """

    octaves: Octaves
    squares: Array
    half: Array

    @property
    def held(self) -> list[int]:
        """Return the places of the parts with a coefficient above zero."""
        return np.nonzero(self.squares)[0].tolist()

    def scores(self) -> tuple[Array, float]:
        """
        Return standard normal scores, and -2 ln of the density that they stand for.

        A mean square is no Gaussian value; its cube root nearly is (Wilson and Hilferty, 1931).

        """
        model, deviation = self.octaves.model(self.squares), np.sqrt((self.half ** 2).sum(axis=1))
        ninth = (deviation / model) ** 2 / 9.0
        normal = (np.cbrt(self.octaves.variance / model) - 1.0 + ninth) / np.sqrt(ninth)
        half = self.half / deviation[:, None]
        density = (np.log(ninth).sum() + 2.0 / 3.0 * np.log(model).sum()
                   + 2.0 * np.log(half.diagonal()).sum())
        return np.linalg.solve(half, normal), float(density)

    @cached_property
    def surprise(self) -> float:
        """Return -2 ln likelihood, up to a constant of all combinations."""
        normal, density = self.scores()
        return float(normal @ normal) + density

    def cost(self) -> float:
        """
        Return -2 ln likelihood with the evidence that each part must bring.

        A ramp must bring more, since in a single record a random walk looks like one.

        """
        return self.surprise + _EVIDENCE * len(self.held) + RIVAL * (RAMP_PLACE in self.held)

    def likely(self) -> bool:
        """Return whether chance explains the residuals."""
        normal, _ = self.scores()
        return chdtrc(len(normal) - len(self.held), float(normal @ normal)) > _CHANCE

    def estimate(self, places: Sequence[int]) -> tuple[Array, Array]:
        """Return the squares of parts by least squares, also negative; standard deviations."""
        white = np.linalg.solve(self.half, self.octaves.columns[:, list(places)])
        size = np.linalg.norm(white, axis=0)
        inverse = np.linalg.pinv((white / size).T @ (white / size))
        found = inverse @ (white / size).T @ np.linalg.solve(self.half, self.octaves.variance)
        return found / size, np.sqrt(inverse.diagonal()) / size

    def deviation(self, place: int) -> float:
        """Return the standard deviation of the square of a part that is held."""
        return float(self.estimate(self.held)[1][self.held.index(place)])

    def bounds(self, place: int) -> tuple[float, float]:
        """Return 95 % bounds of a coefficient, whose square is taken as a mean square."""
        square = self.squares[place]
        lower, upper = chi_squared_bounds(
            square, max(2.0 * (square / self.deviation(place)) ** 2, 1.0))
        return float(lower), float(upper)


def describe(octaves: Octaves, places: tuple[int, ...], misfit: float, held_at: int = -1,
             square: float = 0.0) -> Description:
    """
    Fit a combination of parts, none negative, with the covariance that the fitted noise implies.

    For `misfit` see `NoiseFit`. A further part may be held at a squared coefficient.

    """
    given = np.zeros(BEND_PLACE + 1)
    if held_at >= 0:
        given[held_at] = square
    both = np.column_stack([octaves.columns[:, places],
                            octaves.variance - octaves.columns @ given])
    squares, half = given.copy(), np.diag(octaves.variance)
    for number in range(_PASSES):
        white = np.linalg.solve(half, both)
        size = np.linalg.norm(white[:, :-1], axis=0)
        found = nnls(white[:, :-1] / size, white[:, -1])[0] / size
        if not (found.any() or square) or (number and np.allclose(
                squares[list(places)], found, rtol=1e-4, atol=0.0)):
            break
        squares[list(places)] = found
        half = _half(octaves, squares, misfit)
    return Description(octaves, squares, half)


def _half(octaves: Octaves, squares: Array, misfit: float) -> Array:
    """Return the Cholesky factor of the covariance of the variances, with a share of misfit."""
    model = octaves.model(squares)
    covariance = octaves.covariance(squares)
    covariance[np.diag_indices(len(model))] += 4.0 * (misfit * model) ** 2
    try:
        return np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        return _nearly_half(covariance, model)


def _nearly_half(covariance: Array, model: Array) -> Array:
    """
    Return the Cholesky factor of a covariance that is nearly singular, as that of a ramp alone.

    Correlations are kept away from one.

    """
    size = np.sqrt(np.maximum(covariance.diagonal(), 1e-12 * model ** 2))
    values, vectors = np.linalg.eigh(covariance / np.outer(size, size))
    return size[:, None] * np.linalg.cholesky((vectors * np.maximum(values, 1e-4)) @ vectors.T)
