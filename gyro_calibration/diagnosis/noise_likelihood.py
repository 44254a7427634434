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
Indices = NDArray[np.intp]

#: Least share of a column that is independent of the nuisances; with less it is unidentifiable.
MIN_INDEPENDENT_SHARE = 1e-7


#: Indices of the columns of one candidate.
ColumnGroup = Sequence[int]


@dataclass(frozen=True)
class NoiseHypotheses:
    """
    The noises that are tried, relative to the first noise: g noises, b bands.

    Attributes
    ----------
    weights : one over the relative variance, shape (g, b)
    log_determinant : of the relative variances, shape (g,)

    """

    weights: Array
    log_determinant: Array

    def take(self, indices: Indices) -> NoiseHypotheses:
        """Return some of them."""
        return NoiseHypotheses(self.weights[indices], self.log_determinant[indices])


def draw_residuals(noises: NoiseHypotheses, count: Array, probability: Array, draws: int,
                   generator: np.random.Generator) -> Array:
    """
    Draw residuals of noise alone, each by a noise chosen with its probability, shape (draws, m).

    In single precision, which is sufficient here and twice as fast.

    """
    chosen_noises = generator.choice(len(probability), draws, p=probability)
    deviation = np.repeat((1.0 / np.sqrt(noises.weights)).astype(np.float32), count.astype(int),
                          axis=1)
    return generator.standard_normal((draws, deviation.shape[1]),
                                     np.float32) * deviation[chosen_noises]


@dataclass(frozen=True)
class Marginalized:
    """
    Information on the candidates given the nuisances under each noise.

    Attributes
    ----------
    nuisance_information : information of the nuisances, shape (g, q, q)
    projections : coefficients of the projection of each column on the nuisances, shape (g, q, p)
    conditional_information : for each candidate the information of its columns given the
        nuisances, shape (g, k, k)
    log_determinant : of `nuisance_information` and of the noise, shape (g,)
    unidentifiable : whether a candidate is a combination of the nuisances
    degrees_of_freedom : number of coefficients less nuisances

    """

    nuisance_information: Array
    projections: Array
    conditional_information: tuple[Array, ...]
    log_determinant: Array
    unidentifiable: tuple[bool, ...]
    degrees_of_freedom: float


def _band_slices(starts: Indices, size: int) -> list[slice]:
    return [slice(begin, end) for begin, end in zip(starts, [*starts[1:], size])]


def marginalize_nuisances(nuisances: Array, columns: Array, groups: Sequence[ColumnGroup],
                          starts: Indices, noises: NoiseHypotheses) -> Marginalized:
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
    parts = _band_slices(starts, nuisances.shape[1])

    def products(one: Array, other: Array) -> Array:
        """Return the products of rows under each noise, shape (g, rows, rows of the other)."""
        return np.tensordot(noises.weights,
                            np.array([one[:, part] @ other[:, part].T for part in parts]), 1)

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
        unidentifiable.append(
            bool((_diagonal(part) <= MIN_INDEPENDENT_SHARE * _diagonal(whole)).any()))
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
    log_likelihood : restricted log likelihood without any candidate, shape (d, g)
    residual_squares : sum of whitened squares of the residual, shape (d, g)
    nuisance_scores : scores of the nuisances, N'z, shape (d, g, q)
    candidate_scores : scores of the candidates, X'z given the nuisances, shape (d, g, p)

    """

    log_likelihood: Array
    residual_squares: Array
    nuisance_scores: Array
    candidate_scores: Array

    @property
    def probability(self) -> Array:
        """Return the probability of each noise, shape (d, g)."""
        top = np.exp(self.log_likelihood - self.log_likelihood.max(axis=1, keepdims=True))
        return top / top.sum(axis=1, keepdims=True)


def noise_likelihood(residuals: Array, nuisances: Array, columns: Array, starts: Indices,
                     noises: NoiseHypotheses, marginalization: Marginalized) -> NoiseLikelihood:
    """Return the likelihood of residuals, (d, m), whitened by the first noise."""
    parts = _band_slices(starts, nuisances.shape[1])
    towards, crossed = (
        noises.weights @ np.stack([residuals[:, part] @ each[:, part].T for part in parts], axis=1)
        for each in (nuisances, columns))
    value = np.linalg.solve(marginalization.nuisance_information, towards[..., None])[..., 0]
    squares = (np.add.reduceat(residuals ** 2, starts, axis=1) @ noises.weights.T
               - (value * towards).sum(axis=-1))
    likelihood = -0.5 * (marginalization.degrees_of_freedom * np.log(squares)
                         + marginalization.log_determinant)
    pull = crossed - (towards[:, :, None, :] @ marginalization.projections)[:, :, 0]
    return NoiseLikelihood(likelihood, squares, towards, pull)


def column_evidence(by_noise: NoiseLikelihood, marginalization: Marginalized,
                    groups: Sequence[ColumnGroup]) -> Array:
    """Return the evidence of candidates, shape (d, groups), -inf if unidentifiable."""
    if not groups:
        return np.empty((len(by_noise.residual_squares), 0))
    return np.column_stack([_candidate_evidence(by_noise, marginalization, place, list(group))
                            for place, group in enumerate(groups)])


def _candidate_evidence(by_noise: NoiseLikelihood, marginalization: Marginalized,
                        candidate_index: int, group: list[int]) -> Array:
    if marginalization.unidentifiable[candidate_index]:
        return np.full(len(by_noise.residual_squares), -np.inf)
    information = marginalization.conditional_information[candidate_index]
    scores = by_noise.candidate_scores[:, :, group]
    information = information + 1e-10 * np.eye(len(group)) * _diagonal(information)[:, None]
    if len(group) == 1:
        return _average_over_noises(by_noise, scores[..., 0] ** 2 / information[:, 0, 0],
                                    np.log(information[:, 0, 0]),
                                    marginalization.degrees_of_freedom, 1)
    gained = ((scores[:, :, None, :] @ np.linalg.inv(information))[:, :, 0] * scores).sum(axis=-1)
    return _average_over_noises(by_noise, gained, np.linalg.slogdet(information)[1],
                                marginalization.degrees_of_freedom, len(group))


def _average_over_noises(by_noise: NoiseLikelihood, explained_squares: Array,
                         log_determinant: Array, degrees_of_freedom: float,
                         column_count: int) -> Array:
    """Return the evidence averaged over the noises (see the module)."""
    ratio = np.log1p(-np.minimum(explained_squares / by_noise.residual_squares, 1.0 - 1e-9))
    change = 0.5 * (column_count * np.log(by_noise.residual_squares)
                    - (degrees_of_freedom - column_count) * ratio - log_determinant)
    best = by_noise.log_likelihood.argmax(axis=1)
    scale = 0.5 * (log_determinant[best]
                   - column_count * np.log(by_noise.residual_squares[np.arange(len(best)), best]))
    return (log_sum_exp(by_noise.log_likelihood + change) + scale
            - log_sum_exp(by_noise.log_likelihood))


def log_sum_exp(logarithms: Array) -> Array:
    """Return the logarithm of the sum of exponentials along the last axis."""
    top = logarithms.max(axis=-1)
    with np.errstate(invalid='ignore'):
        return np.where(np.isfinite(top),
                        top + np.log(np.exp(logarithms - top[..., None]).sum(axis=-1)), top)
