"""
How much a residual speaks for a cause, whatever its noise.

The transformed residual z and the columns X of all causes are summed once, band by band. For any noise the likelihood is then a little
linear algebra on these sums, so that every cause is judged under every noise of a grid, and a slow cause cannot hide in a random walk that
was fitted before it was looked for. The evidence of a cause is the likelihood with it over the likelihood without, each averaged over the
noises, at the most likely value of the cause (a flat prior, scaled so that for a known noise it is half the square of its deviations).

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from gyro_calibration.log import Array, Mask

#: Numbers of coefficients.
Places = NDArray[np.intp]

#: A column that the nuisances leave less than this of has no place of its own in the data.
LEAST_LEFT = 1e-7


@dataclass(frozen=True)
class Sums:
    """
    What the bands know of the columns: b bands, p columns.

    Attributes
    ----------
    columns : X'X of each band, shape (b, p, p)
    roots : of each band, a matrix R of p rows so that R R' is X'X and R has no more columns than the band has coefficients
    count : coefficients of each band, shape (b,)

    All are of coefficients divided by the standard deviation that a first noise gives them.

    """

    columns: Array
    roots: tuple[Array, ...]
    count: Array


@dataclass(frozen=True)
class Sample:
    """
    What the bands know of residuals: d of them at once, one measured, or many drawn.

    Attributes
    ----------
    crossed : X'z, shape (d, b, p)
    squared : z'z, shape (d, b)

    """

    crossed: Array
    squared: Array


@dataclass(frozen=True)
class Noises:
    """
    The noises that are tried, relative to the first noise: g noises, b bands.

    Attributes
    ----------
    weights : one over the relative variance, shape (g, b)
    log_determinant : of the relative variances, shape (g,)

    """

    weights: Array
    log_determinant: Array

    def take(self, kept: Array) -> Noises:
        """Return some of them."""
        return Noises(self.weights[kept], self.log_determinant[kept])


def sums(columns: Array, starts: Places) -> Sums:
    """
    Sum whitened columns over bands.

    Parameters
    ----------
    columns : shape (p, m)
    starts : first index of each band, shape (b,)

    """
    parts = np.split(columns, starts[1:], axis=1)
    products = np.array([part @ part.T for part in parts])
    roots = tuple(part if part.shape[1] <= len(columns) else _root(product) for part, product in zip(parts, products))
    return Sums(products, roots, np.array([part.shape[1] for part in parts], float))


def _root(product: Array) -> Array:
    values, vectors = np.linalg.eigh(product)
    return vectors * np.sqrt(np.maximum(values, 0.0))


def measured(residual: Array, columns: Array, starts: Places) -> Sample:
    """Sum a whitened residual, shape (m,), over bands."""
    crossed = [part @ z for part, z in zip(np.split(columns, starts[1:], axis=1), np.split(residual, starts[1:]))]
    return Sample(np.array([crossed]), np.add.reduceat(residual ** 2, starts)[None])


def drawn(known: Sums, noises: Noises, probability: Array, count: int, generator: np.random.Generator) -> Sample:
    """Draw residuals that hold nothing but noise, each by one of the noises, as probable as given: no column of theirs is ever made."""
    which = generator.choice(len(probability), count, p=probability)
    deviation = 1.0 / np.sqrt(noises.weights[which])
    crossed, squared = np.empty((count, len(known.count), known.columns.shape[1])), np.empty((count, len(known.count)))
    for band, (root, size) in enumerate(zip(known.roots, known.count)):
        white = generator.standard_normal((count, root.shape[1]))
        rest = generator.chisquare(size - root.shape[1], count) if size > root.shape[1] else 0.0
        crossed[:, band] = deviation[:, band, None] * (white @ root.T)
        squared[:, band] = deviation[:, band] ** 2 * ((white ** 2).sum(axis=1) + rest)
    return Sample(crossed, squared)


@dataclass(frozen=True)
class Beside:
    """
    What nuisances leave of the columns under each noise.

    Attributes
    ----------
    nuisances : which columns they are
    own : information of the nuisances, shape (g, q, q)
    towards : the nuisances that each column looks like, shape (g, q, p)
    left : information of the columns beside the nuisances, shape (g, p, p)
    log_determinant : of `own` and of the noise, shape (g,)
    tied : columns that the nuisances leave nothing of, shape (p,)
    freedom : coefficients less nuisances

    """

    nuisances: list[int]
    own: Array
    towards: Array
    left: Array
    log_determinant: Array
    tied: Mask
    freedom: float


def beside(known: Sums, noises: Noises, nuisances: Sequence[int]) -> Beside:
    """Take nuisances, which are columns too, out of all columns."""
    chosen, information = list(nuisances), np.tensordot(noises.weights, known.columns, 1)
    own = information[:, chosen][:, :, chosen]
    towards = np.linalg.solve(own, information[:, chosen])
    left = information - np.swapaxes(information[:, chosen], 1, 2) @ towards
    tied: Mask = np.any(_diagonal(left) <= LEAST_LEFT * _diagonal(information), axis=0)
    return Beside(chosen, own, towards, left, noises.log_determinant + np.linalg.slogdet(own)[1], tied,
                  float(known.count.sum()) - len(chosen))


def _diagonal(matrices: Array) -> Array:
    return np.einsum('gpp->gp', matrices)


@dataclass(frozen=True)
class Judged:
    """
    Residuals beside the nuisances, under each noise.

    Attributes
    ----------
    likelihood : restricted log likelihood without any cause, shape (d, g)
    squares : sum of whitened squares that are left, shape (d, g)
    pull : X'z beside the nuisances, shape (d, g, p)

    """

    likelihood: Array
    squares: Array
    pull: Array

    @property
    def probability(self) -> Array:
        """Return how probable each noise is, shape (d, g)."""
        return np.exp(self.likelihood - logsumexp(self.likelihood, axis=1, keepdims=True))


def judge(sample: Sample, noises: Noises, by: Beside) -> Judged:
    """Take the nuisances out of residuals."""
    crossed = np.einsum('gb,dbp->dgp', noises.weights, sample.crossed, optimize=True)
    own = crossed[:, :, by.nuisances]
    squares = sample.squared @ noises.weights.T - np.einsum('dgq,dgq->dg', np.linalg.solve(by.own, own[..., None])[..., 0], own)
    likelihood = -0.5 * (by.freedom * np.log(squares) + by.log_determinant)
    return Judged(likelihood, squares, crossed - np.einsum('gqp,dgq->dgp', by.towards, own, optimize=True))


def evidence(judged: Judged, by: Beside, groups: Sequence[Sequence[int]]) -> Array:
    """
    Return the evidence of groups of columns, shape (d, groups); minus infinity where one is tied to the nuisances.

    Each group is one set of columns with free values.

    """
    return np.column_stack([_evidence(judged, by, list(group)) for group in groups])


def _evidence(judged: Judged, by: Beside, group: list[int]) -> Array:
    if by.tied[group].any():
        return np.full(len(judged.squares), -np.inf)
    own = by.left[:, group][:, :, group] + 1e-12 * np.eye(len(group)) * _diagonal(by.left)[:, group, None]
    pull = judged.pull[:, :, group]
    gained = (pull[..., 0] ** 2 / own[:, 0, 0] if len(group) == 1
              else np.einsum('dgq,dgq->dg', np.linalg.solve(own, pull[..., None])[..., 0], pull))
    return _summary(judged, gained, np.linalg.slogdet(own)[1], by.freedom, len(group))


def _summary(judged: Judged, gained: Array, logarithm: Array, freedom: float, size: int) -> Array:
    """Average over the noises: see the module."""
    ratio = np.log1p(-np.minimum(gained / judged.squares, 1.0 - 1e-9))
    change = 0.5 * (size * np.log(judged.squares) - (freedom - size) * ratio - logarithm)
    best = judged.likelihood.argmax(axis=1)
    scale = 0.5 * (logarithm[best] - size * np.log(judged.squares[np.arange(len(best)), best]))
    return logsumexp(judged.likelihood + change, axis=1) + scale - logsumexp(judged.likelihood, axis=1)
