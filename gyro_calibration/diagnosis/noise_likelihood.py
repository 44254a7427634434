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
The evidence of causes in a residual whose noise is unknown.

The products of the transformed residual z and the columns X of all causes are summed once, band by
band. For any noise the likelihood is then linear algebra on these sums, so that every cause is
tested under every noise of a grid, and a slow cause is not absorbed by a random walk that was
fitted before it. The evidence of a cause is the likelihood with it over the likelihood without it,
each averaged over the noises, at the most likely value of the cause (a flat prior, scaled so that
for a known noise the evidence is n² / 2 for a value of n standard deviations).

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from gyro_calibration.logs.log import Array
import numpy as np
from numpy.typing import NDArray

#: Indices of coefficients.
Places = NDArray[np.intp]

#: Least share of a column that is independent of the nuisances; with less it is unidentifiable.
LEAST_LEFT = 1e-7


#: Indices of the columns of one candidate.
Group = Sequence[int]


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

    def take(self, kept: Places) -> Noises:
        """Return some of them."""
        return Noises(self.weights[kept], self.log_determinant[kept])


def drawn(noises: Noises, count: Array, probability: Array, draws: int,
          generator: np.random.Generator) -> Array:
    """
    Draw residuals of noise alone, each by a noise chosen with its probability, shape (draws, m).

    In single precision, which is sufficient here and twice as fast.

    """
    which = generator.choice(len(probability), draws, p=probability)
    deviation = np.repeat((1.0 / np.sqrt(noises.weights)).astype(np.float32), count.astype(int),
                          axis=1)
    return generator.standard_normal((draws, deviation.shape[1]), np.float32) * deviation[which]


@dataclass(frozen=True)
class Marginalized:
    """
    Information on the candidates given the nuisances under each noise.

    Attributes
    ----------
    own : information of the nuisances, shape (g, q, q)
    towards : coefficients of the projection of each column on the nuisances, shape (g, q, p)
    left : for each candidate the information of its columns given the nuisances, shape (g, k, k)
    log_determinant : of `own` and of the noise, shape (g,)
    unidentifiable : whether a candidate is a combination of the nuisances
    freedom : number of coefficients less nuisances

    """

    own: Array
    towards: Array
    left: tuple[Array, ...]
    log_determinant: Array
    unidentifiable: tuple[bool, ...]
    freedom: float


def _parts(starts: Places, size: int) -> list[slice]:
    return [slice(begin, end) for begin, end in zip(starts, [*starts[1:], size])]


def marginalized(nuisances: Array, columns: Array, groups: Sequence[Group], starts: Places,
                 noises: Noises) -> Marginalized:
    """
    Marginalize all candidates over the nuisances.

    Parameters
    ----------
    nuisances : columns whitened by the first noise, shape (q, m)
    columns : of the candidates, likewise, shape (p, m)
    groups : the indices of the columns of each candidate
    starts : first coefficient of each band, shape (b,)
    noises : that are tried

    """
    parts = _parts(starts, nuisances.shape[1])

    def products(one: Array, other: Array) -> Array:
        """Return the products of rows under each noise, shape (g, rows, rows of the other)."""
        return np.tensordot(noises.weights, np.array(
            [one[:, part] @ other[:, part].T for part in parts]), 1)

    own, crossing = products(nuisances, nuisances), products(nuisances, columns)
    towards = np.linalg.solve(own, crossing)
    squares = (noises.weights @ np.add.reduceat(columns ** 2, starts, axis=1).T if len(columns)
               else np.empty((len(noises.weights), 0)))
    left, unidentifiable = [], []
    for group in map(list, groups):
        whole = (squares[:, group, None] if len(group) == 1
                 else products(columns[group], columns[group]))
        part = whole - np.swapaxes(crossing[:, :, group], 1, 2) @ towards[:, :, group]
        left.append(part)
        unidentifiable.append(bool((_diagonal(part) <= LEAST_LEFT * _diagonal(whole)).any()))
    return Marginalized(own, towards, tuple(left),
                        noises.log_determinant + np.linalg.slogdet(own)[1], tuple(unidentifiable),
                        float(nuisances.shape[1] - len(nuisances)))


def _diagonal(matrices: Array) -> Array:
    return np.einsum('gpp->gp', matrices)


@dataclass(frozen=True)
class NoiseLikelihood:
    """
    Likelihood of d residuals, one measured or many drawn, given the nuisances under each noise.

    Attributes
    ----------
    likelihood : restricted log likelihood without any candidate, shape (d, g)
    squares : sum of whitened squares of the residual, shape (d, g)
    towards : scores of the nuisances, N'z, shape (d, g, q)
    pull : scores of the candidates, X'z given the nuisances, shape (d, g, p)

    """

    likelihood: Array
    squares: Array
    towards: Array
    pull: Array

    @property
    def probability(self) -> Array:
        """Return the probability of each noise, shape (d, g)."""
        top = np.exp(self.likelihood - self.likelihood.max(axis=1, keepdims=True))
        return top / top.sum(axis=1, keepdims=True)


def noise_likelihood(residuals: Array, nuisances: Array, columns: Array, starts: Places,
                     noises: Noises, by: Marginalized) -> NoiseLikelihood:
    """Return the likelihood of residuals, (d, m), whitened by the first noise."""
    parts = _parts(starts, nuisances.shape[1])
    towards, crossed = (noises.weights @ np.stack(
        [residuals[:, part] @ each[:, part].T for part in parts], axis=1)
        for each in (nuisances, columns))
    value = np.linalg.solve(by.own, towards[..., None])[..., 0]
    squares = (np.add.reduceat(residuals ** 2, starts, axis=1) @ noises.weights.T
               - (value * towards).sum(axis=-1))
    likelihood = -0.5 * (by.freedom * np.log(squares) + by.log_determinant)
    pull = crossed - (towards[:, :, None, :] @ by.towards)[:, :, 0]
    return NoiseLikelihood(likelihood, squares, towards, pull)


def evidence(by_noise: NoiseLikelihood, by: Marginalized, groups: Sequence[Group]) -> Array:
    """Return the evidence of candidates, shape (d, groups), -inf if unidentifiable."""
    if not groups:
        return np.empty((len(by_noise.squares), 0))
    return np.column_stack([_evidence(by_noise, by, place, list(group))
                            for place, group in enumerate(groups)])


def _evidence(by_noise: NoiseLikelihood, by: Marginalized, place: int, group: list[int]) -> Array:
    if by.unidentifiable[place]:
        return np.full(len(by_noise.squares), -np.inf)
    own, pull = by.left[place], by_noise.pull[:, :, group]
    own = own + 1e-10 * np.eye(len(group)) * _diagonal(own)[:, None]
    if len(group) == 1:
        return _summary(by_noise, pull[..., 0] ** 2 / own[:, 0, 0], np.log(own[:, 0, 0]),
                        by.freedom, 1)
    gained = ((pull[:, :, None, :] @ np.linalg.inv(own))[:, :, 0] * pull).sum(axis=-1)
    return _summary(by_noise, gained, np.linalg.slogdet(own)[1], by.freedom, len(group))


def _summary(by_noise: NoiseLikelihood, gained: Array, logarithm: Array, freedom: float,
             size: int) -> Array:
    """Return the evidence averaged over the noises (see the module)."""
    ratio = np.log1p(-np.minimum(gained / by_noise.squares, 1.0 - 1e-9))
    change = 0.5 * (size * np.log(by_noise.squares) - (freedom - size) * ratio - logarithm)
    best = by_noise.likelihood.argmax(axis=1)
    scale = 0.5 * (logarithm[best] - size * np.log(by_noise.squares[np.arange(len(best)), best]))
    return log_sum(by_noise.likelihood + change) + scale - log_sum(by_noise.likelihood)


def log_sum(logarithms: Array) -> Array:
    """Return the logarithm of the sum of exponentials along the last axis."""
    top = logarithms.max(axis=-1)
    with np.errstate(invalid='ignore'):
        return np.where(np.isfinite(top),
                        top + np.log(np.exp(logarithms - top[..., None]).sum(axis=-1)), top)
