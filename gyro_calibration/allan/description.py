"""A description of Allan variances: a combination of parts, fitted by generalized least squares, and how likely it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.optimize import nnls
from scipy.special import chdtrc

from gyro_calibration.allan.freedom import chi_squared_bounds
from gyro_calibration.allan.octaves import Octaves
from gyro_calibration.allan.parts import BEND_PLACE, RAMP_PLACE
from gyro_calibration.log import Array

#: What a further part must take off -2 ln likelihood. White noise alone then shows none in 95 of 100 records.
_EVIDENCE = 10.0

#: A combination of other parts that is less likely by no more than this is as good an explanation.
RIVAL = 6.0

#: A description is taken for good if it is off by more with this probability.
_CHANCE = 0.05

#: Passes of the fit; two or three suffice.
_PASSES = 12


@dataclass(frozen=True)
class Description:
    """
    A combination of parts, fitted.

    Attributes
    ----------
    octaves : those that it describes
    squares : squared coefficients, shape (6,)
    half : Cholesky factor of the covariance of the variances

    """

    octaves: Octaves
    squares: Array
    half: Array

    @property
    def held(self) -> list[int]:
        """Return the places of the parts that there is something of."""
        return np.nonzero(self.squares)[0].tolist()

    def scores(self) -> tuple[Array, float]:
        """
        Return standard normal scores, and -2 ln of the density that they stand for.

        A mean square is no Gaussian value; its cube root nearly is one (Wilson and Hilferty, 1931).

        """
        model, deviation = self.octaves.model(self.squares), np.sqrt((self.half ** 2).sum(axis=1))
        ninth = (deviation / model) ** 2 / 9.0
        normal = (np.cbrt(self.octaves.variance / model) - 1.0 + ninth) / np.sqrt(ninth)
        half = self.half / deviation[:, None]
        density = np.log(ninth).sum() + 2.0 / 3.0 * np.log(model).sum() + 2.0 * np.log(half.diagonal()).sum()
        return np.linalg.solve(half, normal), float(density)

    @cached_property
    def surprise(self) -> float:
        """Return -2 ln likelihood, up to what is the same for all combinations."""
        normal, density = self.scores()
        return float(normal @ normal) + density

    def cost(self) -> float:
        """Return -2 ln likelihood with the evidence that each part must bring; a ramp more: in one record a walk looks like it."""
        return self.surprise + _EVIDENCE * len(self.held) + RIVAL * (RAMP_PLACE in self.held)

    def likely(self) -> bool:
        """Tell whether chance explains what is left."""
        normal, _ = self.scores()
        return chdtrc(len(normal) - len(self.held), float(normal @ normal)) > _CHANCE

    def estimate(self, places: Sequence[int]) -> tuple[Array, Array]:
        """Return the squares of some parts by least squares, negative ones too, and their standard deviations."""
        white = np.linalg.solve(self.half, self.octaves.columns[:, list(places)])
        size = np.linalg.norm(white, axis=0)
        inverse = np.linalg.pinv((white / size).T @ (white / size))
        found = inverse @ (white / size).T @ np.linalg.solve(self.half, self.octaves.variance)
        return found / size, np.sqrt(inverse.diagonal()) / size

    def deviation(self, place: int) -> float:
        """Return the standard deviation of the square of a part that is held."""
        return float(self.estimate(self.held)[1][self.held.index(place)])

    def bounds(self, place: int) -> tuple[float, float]:
        """Return bounds of a coefficient with 95 % confidence, as if its square were a mean square of so many degrees of freedom."""
        square = self.squares[place]
        lower, upper = chi_squared_bounds(square, max(2.0 * (square / self.deviation(place)) ** 2, 1.0))
        return float(lower), float(upper)


def describe(octaves: Octaves, places: tuple[int, ...], misfit: float) -> Description:
    """Fit a combination of parts, none negative, with the covariance of the noise that was fitted; for `misfit` see `NoiseFit`."""
    both = np.column_stack([octaves.columns[:, places], octaves.variance])
    squares, half = np.zeros(BEND_PLACE + 1), np.diag(octaves.variance)
    for _ in range(_PASSES):
        white = np.linalg.solve(half, both)
        size = np.linalg.norm(white[:, :-1], axis=0)
        found = nnls(white[:, :-1] / size, white[:, -1])[0] / size
        if not found.any() or np.allclose(squares[list(places)], found, rtol=1e-4, atol=0.0):
            break
        squares[list(places)] = found
        half = _half(octaves, squares, misfit)
    return Description(octaves, squares, half)


def _half(octaves: Octaves, squares: Array, misfit: float) -> Array:
    """Return the Cholesky factor of the covariance of the variances, each of which may be off the sum by another share besides."""
    model = octaves.model(squares)
    covariance = octaves.covariance(squares)
    covariance[np.diag_indices(len(model))] += 4.0 * (misfit * model) ** 2
    try:
        return np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        return _nearly_half(covariance, model)


def _nearly_half(covariance: Array, model: Array) -> Array:
    """Return the same for a covariance that is nearly singular, as where a ramp is all there is: correlations are kept away from one."""
    size = np.sqrt(np.maximum(covariance.diagonal(), 1e-12 * model ** 2))
    values, vectors = np.linalg.eigh(covariance / np.outer(size, size))
    return size[:, None] * np.linalg.cholesky((vectors * np.maximum(values, 1e-4)) @ vectors.T)
