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
One likelihood for linear regressions whose noise has several parts of unknown size.

The model of ``n`` observations is ``observed = columns @ values + shared_columns @ u + e``:

* ``values``, shape (m,), are estimated, with a flat prior, or a normal one.
* ``e`` has the covariance ``sum(size_k**2 * banded_k)`` of tridiagonal parts (`BandedNoise`).
* ``u``, shape (q,), has independent elements with variances ``sum(size_j**2 * variance_j)``
  (`SharedNoise`): errors that many observations have in common, as of a wandering bias.

For each point of a grid over the sizes the restricted likelihood (REML: ``values`` with a flat
prior and ``u`` are integrated out) is computed, with ``V`` the covariance of ``e`` and ``P`` the
prior precision of ``(values, u)``, of which ``|P|+`` is the product of those that are not zero::

    log L = -1/2 [log|V| + log|A| - log|P|+ + y'V⁻¹y - c'A⁻¹c],    A = X'V⁻¹X + P,    c = X'V⁻¹y

Estimates and their covariance are averaged over the grid, so that intervals include the
uncertainty of the noise. The prior of each size is flat in its logarithm within its range. The
grid is refined three times around its likely points.

Headings at points ``t_0 ... t_n`` become increments over the spans between them (`heading_noise`).
The parts of the noise of such increments:

=================  =========  ==================================================================
name               unit       noise
=================  =========  ==================================================================
angle_random_walk  rad/√s     gyro, white: variance in proportion to the length of the span
reference          rad        reference, white from point to point; neighbouring spans share one
motion             s          the same, in proportion to the rate at the point: side slip, jitter
reference_walk     √rad       reference that adds up its errors, by the angle turned
bias_instability   rad/s      gyro, flicker of the two-sided spectrum B²/ω
rate_random_walk   rad/s/√s   gyro, random walk of the two-sided spectrum K²/ω²
=================  =========  ==================================================================
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
import math

from gyro_calibration.logs.log import Array, Mask
import numpy as np
from scipy.linalg import solve_banded
from scipy.linalg.lapack import dpttrf, dpttrs
from scipy.special import logsumexp, softmax


#: Standard deviation of a turn that nothing shows, rad.
_ANY_TURN = 100.0


@dataclass(frozen=True)
class BandedNoise:
    """A part of the noise whose covariance is ``size**2`` times a tridiagonal matrix."""

    name: str  # of the size
    diagonal: Array  # shape (n,)
    off_diagonal: Array | None  # with the one before, (n,); None where independent
    # smallest and largest size that is possible; equal where the size is known
    size_range: tuple[float, float]  # noqa: A003


@dataclass(frozen=True)
class SharedNoise:
    """A part of the variances of the shared values ``u``: ``size**2`` times `variance`."""

    name: str  # of the size
    variance: Array  # shape (q,)
    # smallest and largest size that is possible; equal where the size is known
    size_range: tuple[float, float]  # noqa: A003
    unobservable_variance: float = 0.0  # that looks like one of the values, in size²


@dataclass(frozen=True)
class HierarchicalPrior:
    """A value whose normal prior has a standard deviation of unknown size."""

    name: str  # of the size
    value_index: int  # number of the value
    # smallest and largest standard deviation, in the unit of the value
    size_range: tuple[float, float]  # noqa: A003


@dataclass(frozen=True)
class GridFit:
    """The result of a regression, averaged over the sizes of the noise."""

    values: Array  # estimates, shape (m,)
    covariance: Array  # of the values, shape (m, m), including the uncertainty of the noise
    # for each size its name, its estimate (mean of the logarithm), and the limits that hold 95 %
    sizes: Mapping[str, tuple[float, float, float]]
    # the size of each part at the point of the grid with the largest likelihood, by name
    likeliest_sizes: Mapping[str, float]
    log_evidence: float  # of the mean likelihood over the grid
    # observed - columns @ values - shared_columns @ u at the likeliest point, shape (n,)
    residual: Array
    unobservable_variance: float  # of the shared noise, that looks like one of the values
    _noise: TridiagonalMatrix

    @property
    def deviations(self) -> Array:
        """Return the standard deviations of the values, shape (m,)."""
        return np.sqrt(np.diag(self.covariance))

    def size(self, name: str) -> float:
        """Return the estimate of the size of one part of the noise."""
        return self.sizes[name][0]

    def whiten(self, columns: Array) -> Array:
        """Return columns, shape (n,) or (n, k), with independent banded noise of variance 1."""
        return self._noise.whiten(columns)


class TridiagonalMatrix:
    """A positive definite tridiagonal matrix, factored as L D L'."""

    def __init__(self, diagonal: Array, neighbours: Array):
        """Factor it; raise `numpy.linalg.LinAlgError` where it is not positive definite."""
        self._d, self._e, info = dpttrf(diagonal, neighbours[1:])
        if info:
            raise np.linalg.LinAlgError('the covariance is not positive definite')
        self.log_determinant = float(np.log(self._d).sum())

    def solve(self, columns: Array) -> Array:
        """Return the inverse times columns, shape (n,) or (n, k)."""
        solved: Array = dpttrs(self._d, self._e, columns.reshape(len(columns), -1))[0]
        return solved.reshape(columns.shape)

    def whiten(self, columns: Array) -> Array:
        """Return D^(-1/2) L⁻¹ times columns, shape (n,) or (n, k)."""
        whitened = solve_banded((1, 0), np.array([np.ones(len(self._d)), np.append(self._e, 0.0)]),
                                columns)
        return (whitened.T / np.sqrt(self._d)).T


def heading_noise(time: Array, rate: Array, point_variance: Array | None = None,
                  angle_random_walk: tuple[float, float] | None = None,
                  reference_walk: Array | None = None,
                  is_measured: Mask | None = None) -> list[BandedNoise]:
    """
    Return the parts of the noise of increments between headings.

    Parameters
    ----------
    time : of the points, s, shape (n + 1,)
    rate : at the points, rad/s, shape (n + 1,)
    point_variance : of the reference at each point, relative to the others, shape (n + 1,); larger
        where a point is an outlier
    angle_random_walk : smallest and largest N that is possible, rad/√s, where a log at rest, a
        data sheet or the differences between samples bound it; equal ends where it is known
    reference_walk : variance by which errors of a reference that add up grow over each span,
        relative to the others, shape (n,); the third part is then 'reference_walk'
    is_measured : whether the gyro is known in each span, (n,); any turn is possible in others

    """
    points = np.ones(len(time)) if point_variance is None else point_variance
    rate_rms = math.sqrt(float(np.mean(rate**2))) + 1e-12
    sizes = math.radians(1e-4), math.radians(10.0)  # possible ones of the reference
    moving = (BandedNoise('reference_walk', reference_walk, None, sizes)
              if reference_walk is not None else BandedNoise(
                  'motion', *difference_covariance(points * rate ** 2),
                  (1e1 * sizes[0] / rate_rms, sizes[1] / rate_rms)))
    unknown = np.zeros(0) if is_measured is None else (~is_measured).astype(float)
    holes = [BandedNoise('hole', unknown, None, (_ANY_TURN, _ANY_TURN))] if unknown.any() else []
    return [BandedNoise('angle_random_walk', np.diff(time), None, angle_random_walk or sizes),
            BandedNoise('reference', *difference_covariance(points), sizes), moving, *holes]


def difference_covariance(variance: Array) -> tuple[Array, Array]:
    """Return variances of differences between points, and covariances with the one before."""
    return variance[1:] + variance[:-1], -variance[:-1]


def mean_walk_covariance(middle: Array, duration: Array) -> tuple[Array, Array]:
    """
    Return the noise of increments between means over blocks by a random walk of 1 rad/√s.

    Given are the mean times and the durations of the blocks, s, shape (n + 1,). Returned are the
    variances and the covariances with the one before, s, shape (n,).
    """
    spacing, within = np.diff(middle), (duration[1:] + duration[:-1]) / 6.0
    return np.maximum(spacing - within, within), duration[:-1] / 6.0


def bias_wander_columns(time: Array, bias_instability: tuple[float, float] | None = (1e-7, 1e-3),
                        rate_random_walk: tuple[float, float] | None = (1e-8, 1e-4),
                        cosine_count: int = 24) -> tuple[Array, list[SharedNoise]]:
    """
    Return the columns of a wandering bias in increments between points, and its noise parts.

    About its mean over the log a bias is the sum of ``u_j cos(ω_j (t - t_0))`` with ``ω_j = π j /
    T``. The variance of ``u_j`` is ``2 / T`` times the two-sided spectrum at ``ω_j``, ``B²/ω`` and
    ``K²/ω²``. That mean differs from the bias where the log began by the variance ``2/π B²`` and
    ``K² T / 3``, which `fit_noise_grid` adds to the value `wandering_value`.

    Parameters
    ----------
    time : of the points, s, shape (n + 1,)
    bias_instability, rate_random_walk : ranges of B, rad/s, and K, rad/s/√s; None without it

    Returns
    -------
    columns, s, shape (n, q); and the parts of the noise
    """
    duration = float(time[-1] - time[0])
    omega = math.pi * np.arange(1, cosine_count + 1) / duration
    columns = np.diff(np.sin(omega * (time - time[0])[:, None]) / omega, axis=0)
    parts = [SharedNoise(name, 2.0 / duration / omega**power, limits, mean)
             for name, power, mean, limits in (
                 ('bias_instability', 1, 2.0 / math.pi, bias_instability),
                 ('rate_random_walk', 2, duration / 3.0, rate_random_walk)) if limits is not None]
    return columns, parts


@dataclass(frozen=True)
class _Regression:
    """All columns together, shape (n, m + q), with the prior precisions of known size."""

    observed: Array
    columns: Array
    value_count: int
    prior_precision: Array
    banded: Sequence[BandedNoise]
    shared: Sequence[SharedNoise]  # and priors of unknown size; with variances of shape (m + q,)

    def banded_covariance(self, sizes: Iterable[float]) -> TridiagonalMatrix:
        """Return the covariance of the banded noise."""
        diagonal, neighbours = np.zeros((2, len(self.observed)))
        for size, part in zip(sizes, self.banded):
            diagonal += size**2 * part.diagonal
            if part.off_diagonal is not None:
                neighbours += size**2 * part.off_diagonal
        return TridiagonalMatrix(diagonal, neighbours)

    def prior_precisions(self, sizes: Array) -> Array:
        """Return prior precisions, shape (k, m + q), for sizes of shape (k, parts)."""
        variance = sum((size[:, None] ** 2 * part.variance
                        for size, part in zip(sizes.T, self.shared)), np.zeros((len(sizes), 1)))
        return np.where(variance > 0.0, 1.0 / np.maximum(variance, 1e-300), self.prior_precision)

    def solve(self, covariance: TridiagonalMatrix,
              precisions: Array) -> tuple[Array, Array, Array]:
        """
        Solve for one banded noise, and k variances of the shared values.

        Return log likelihoods, (k,), values, (k, m + q), and m columns of inverses, (k, m + q, m).
        """
        weighted = covariance.solve(np.column_stack([self.columns, self.observed]))
        gram = self.columns.T @ weighted
        # scaled, since the columns have different units
        scale = 1.0 / np.sqrt(np.maximum(np.diag(gram[:, :-1]) + precisions, 1e-300))
        normal = ((gram[:, :-1] + precisions[:, :, None] * np.eye(len(gram))) * scale[:, :, None]
                  * scale[:, None, :])
        solve = ((lambda a, b: np.linalg.pinv(a, rcond=1e-12, hermitian=True) @ b)
                 if self.value_count and np.linalg.cond(normal[0]) > 1e12 else np.linalg.solve)
        log_determinant = np.linalg.slogdet(normal)[1] - 2.0 * np.log(scale).sum(axis=1)
        sought = np.column_stack([np.eye(len(gram), self.value_count), gram[:, -1]])
        found = scale[:, :, None] * solve(normal, scale[:, :, None] * sought)
        inverse, values = found[:, :, :-1], found[:, :, -1]
        # by the residual of the first values, as rounding leaves nothing of the difference of sums
        residual, change = self.observed - self.columns @ values[0], values - values[0]
        solved = covariance.solve(residual)
        squares = (residual @ solved - 2.0 * change @ (self.columns.T @ solved)
                   + ((change @ gram[:, :-1]) * change + precisions * values**2).sum(axis=1))
        proper = np.log(np.where(precisions > 0.0, precisions, 1.0)).sum(axis=1)
        return (-0.5 * (covariance.log_determinant + log_determinant - proper + squares), values,
                inverse)


def fit_noise_grid(observed: Array, columns: Array, banded: Sequence[BandedNoise],
                   shared_columns: Array | None = None, shared: Sequence[SharedNoise] = (),
                   prior_deviation: Array | None = None,
                   wandering_value: int | None = None,
                   hierarchical_priors: Sequence[HierarchicalPrior] = ()) -> GridFit:
    """
    Estimate values by a likelihood over a grid of the sizes of the noise.

    There must be more observations than values, or `ValueError` is raised.

    Parameters
    ----------
    observed, columns : shape (n,), and those of the values, shape (n, m)
    banded : parts of the noise; their sum must be positive definite
    shared_columns, shared : of the shared values, shape (n, q), and parts of their variances
    prior_deviation : of the values about zero, shape (m,); infinite for a flat prior
    wandering_value : number of the value whose variance includes `unobservable_variance`
    hierarchical_priors : values with a prior of unknown size
    """
    count = columns.shape[1]
    if len(observed) <= count:
        raise ValueError(
            f'{len(observed)} observations do not determine {count} values and their noise')
    together = columns if shared_columns is None else np.column_stack([columns, shared_columns])
    width = together.shape[1]
    # shared values without a variance are zero
    precision = np.append(np.zeros(count), np.full(width - count, 1e300))
    if prior_deviation is not None:
        precision[:count] = 1.0 / np.square(prior_deviation)
    shared = [*(replace(part, variance=np.append(np.zeros(count), part.variance))
                for part in shared),
              *(SharedNoise(prior.name, np.eye(width)[prior.value_index], prior.size_range)
                for prior in hierarchical_priors)]
    regression = _Regression(observed, together, count, precision, banded, shared)
    parts: list[BandedNoise | SharedNoise] = [*banded, *shared]
    axes = [np.array([low]) if low == high else np.geomspace(low, high, 5)
            for low, high in (part.size_range for part in parts)]
    for remaining in reversed(range(4)):
        sizes, log_likelihoods, all_values, covariances = _evaluate_grid(regression, axes)
        weights = softmax(log_likelihoods)
        if remaining:
            axes = [_refine_axis(axis, sizes[:, place], weights, part.size_range)
                    for place, (axis, part) in enumerate(zip(axes, parts))]
    unobservable = sizes[:, len(banded):] ** 2 @ np.array(
        [part.unobservable_variance for part in shared])
    if wandering_value is not None:
        covariances[:, wandering_value, wandering_value] += unobservable
    values, covariance = average_hypotheses(weights, all_values, covariances)
    best = int(log_likelihoods.argmax())
    noise = regression.banded_covariance(sizes[best, :len(banded)])
    _, (likeliest,), _ = regression.solve(
        noise, regression.prior_precisions(sizes[best: best + 1, len(banded):]))
    names = [part.name for part in parts]
    return GridFit(values, covariance,
                   {name: _interval_95(each, weights) for name, each in zip(names, sizes.T)},
                   dict(zip(names, sizes[best].tolist())),
                   float(logsumexp(log_likelihoods)) - math.log(len(weights)),
                   regression.observed - regression.columns @ likeliest,
                   float(weights @ unobservable), noise)


def _refine_axis(axis: Array, sizes: Array, weights: Array, limits: tuple[float, float]) -> Array:
    """Return an axis where the sizes are likely, at least to the middle between old points."""
    if len(axis) == 1:
        return axis
    logarithms, step = np.log(sizes), math.log(axis[1] / axis[0])
    middle = float(weights @ logarithms)
    spread = math.sqrt(float(weights @ (logarithms - middle) ** 2))
    half_width = max(2.5 * spread, 0.6 * step)
    low, high = (min(max(end, math.log(limits[0])), math.log(limits[1]))
                 for end in (middle - half_width, middle + half_width))
    return np.exp(np.linspace(low, high, len(axis)))


def _evaluate_grid(regression: _Regression, axes: Sequence[Array]) -> Iterator[Array]:
    """Give sizes, (k, parts), log likelihoods, (k,), values, (k, m), and their covariances."""
    banded, count = len(regression.banded), regression.value_count
    inner = np.array(list(product(*axes[banded:])))  # one empty row where nothing is shared
    precisions = regression.prior_precisions(inner)
    found = []
    for sizes in product(*axes[:banded]):
        log_likelihood, values, inverse = regression.solve(
            regression.banded_covariance(sizes), precisions)
        found.append((np.column_stack([np.tile(sizes, (len(inner), 1)), inner]), log_likelihood,
                      values[:, :count], inverse[:, :count]))
    return (np.concatenate(each) for each in zip(*found))


def average_hypotheses(weights: Array, values: Array, covariances: Array) -> tuple[Array, Array]:
    """
    Return mean and covariance of values that hold with some probability, by total variance.

    The shapes are (k,), (k, m) and (k, m, m).
    """
    mean = weights @ values
    apart = values - mean
    return mean, np.tensordot(weights, covariances, 1) + (apart * weights[:, None]).T @ apart


def _interval_95(sizes: Array, weights: Array) -> tuple[float, float, float]:
    """Return the mean of the logarithm as a size, and the limits that hold 95 %."""
    order = np.argsort(sizes, kind='stable')
    below = np.cumsum(weights[order]) - 0.5 * weights[order]
    low, high = np.interp([0.025, 0.975], below, np.log(sizes[order]))
    return math.exp(float(weights @ np.log(sizes))), math.exp(low), math.exp(high)
