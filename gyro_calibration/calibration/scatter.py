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
The scatter of dwells about a gyro's effects, and the uncertainty of the effects' values.

The error of a dwell, output less rate, is the sum of the effects and of three scatters: its own,
that of its sweep's bias, and that of its sweep's scale factor. Their sizes are estimated by
restricted likelihood about a smooth surface over rate and temperature, as about too few effects
they would include the error of a missing effect. The prior is uniform in the deviation of the
quietest dwell, relative to all (Chung et al. 2013, Psychometrika 78:685): by the likelihood alone,
a dwell of small deviation may be taken as exact.

The covariance of the values states how well the dwells determine them, the tolerance the errors of
another run, or outside of the calibrated temperatures and rates.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import math

from gyro_calibration.calibration.dwells import (
    Dwells, MIN_TEMPERATURE_SPREAD, Numbers, OUTLIER_THRESHOLD, select_dwells, step_covariance)
from gyro_calibration.calibration.likelihood import robust_residual
from gyro_calibration.heading.bias_table import Prior
from gyro_calibration.logs.log import Array, DataRefused, Mask, NORMAL_QUANTILE_975
from gyro_calibration.logs.quality import robust_deviation
from gyro_calibration.model.gyro_model import Tolerance
import numpy as np
from scipy.linalg import orth, solve_triangular
from scipy.optimize import minimize
from scipy.special import softmax
from scipy.stats import t as student

#: With fewer, the others do not determine a model without one of them.
MIN_SWEEPS = 4
#: With fewer, the dwells determine neither a robust surface nor scatters besides their own.
_MIN_DWELLS = 12
#: Standard deviations between gyros (L3G4200D): of the bias, rad/s/K, the scale factor, 1/K, and
#: the nonlinearity at the fastest rate, 1.
BIAS_SLOPE_DEVIATION, SCALE_SLOPE_DEVIATION, _NONLINEARITY_DEVIATION = (
    Prior().coefficient, 3e-4, 2e-3)


@dataclass(frozen=True)
class Scatter:
    """Standard deviations of dwells about a smooth surface over rate and temperature."""

    dwell_bias: float  # of a dwell, beyond its own deviation, rad/s
    # of the scale factor from dwell to dwell, 1, such as that of a table's speed
    dwell_scale: float
    sweep_bias: float  # of the bias from sweep to sweep, rad/s
    sweep_scale: float  # of the scale factor from sweep to sweep, 1
    inliers: Mask  # which dwells are not outlying, shape (n,)

    def deviation(self, dwells: Dwells) -> Array:
        """Return the standard deviation of each dwell without its sweep's, rad/s, shape (n,)."""
        known = np.isfinite(dwells.deviation)
        typical = rms(dwells.deviation[known]) if known.any() else 0.0
        return np.sqrt(np.where(known, dwells.deviation, typical) ** 2 + self.dwell_bias ** 2
                       + (self.dwell_scale * dwells.rate) ** 2)

    def sweep_columns(self, dwells: Dwells) -> Array:
        """Return the effect of one deviation of sweep bias and scale, rad/s, shape (n, 2)."""
        return np.column_stack([np.full(len(dwells), self.sweep_bias),
                                self.sweep_scale * dwells.rate])

    def mean_deviation(self, dwells: Dwells, sign: Array | float = 1.0) -> float:
        """Return the standard deviation of the mean error of some dwells, rad/s."""
        # errors common to a sweep do not average out within it
        shared = sum_by_part(self.sweep_columns(dwells) * np.broadcast_to(
            sign, len(dwells))[:, None], _sweep_numbers(dwells))
        return math.sqrt(float(np.sum(self.deviation(dwells) ** 2) + np.sum(shared ** 2))) / len(
            dwells)


def rms(values: Array) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(values ** 2)))


def cross_validation_parts(dwells: Dwells) -> Numbers:
    """
    Return the number of the part that each dwell is left out with, from 0 on, shape (n,).

    It is the sweep; with fewer than `MIN_SWEEPS` a block of time within a sweep, of about 60.
    """
    sweeps, count = _sweep_numbers(dwells), min(len(dwells), 60)
    if sweeps.max() + 1 >= MIN_SWEEPS:
        return sweeps
    return np.unique(sweeps * count + np.arange(len(dwells)) * count // len(dwells),
                     return_inverse=True)[1]


def _sweep_numbers(dwells: Dwells) -> Numbers:
    """Return the number of the sweep of each dwell, from 0 on without gaps, shape (n,)."""
    return np.unique(dwells.sweep, return_inverse=True)[1]


def sum_by_part(values: Array, parts: Numbers) -> Array:
    """Return the sums of values of shape (n, ...) over each part, shape (parts, ...)."""
    order = np.argsort(parts, kind='stable')
    return np.add.reduceat(values[order], np.flatnonzero(np.diff(parts[order], prepend=-1)))


class Whitener:
    """The covariance of the errors of dwells: independent sweeps, by their Cholesky factors."""

    def __init__(self, dwells: Dwells, scatter: Scatter):
        self.deviation = scatter.deviation(dwells)
        shared = scatter.sweep_columns(dwells)
        # without errors in common, all dwells are independent
        parts = (_sweep_numbers if shared.any() else cross_validation_parts)(dwells)
        rows = (np.flatnonzero(parts == part) for part in range(parts.max() + 1))
        # by the factors of the covariance: exact dwells would be lost in it beside their sweep
        self._factors = [(own, np.asarray(np.linalg.qr(np.vstack(
            [np.diag(self.deviation[own]), shared[own].T]), mode='r')).T) for own in rows]

    def whiten(self, values: Array) -> Array:
        """Return columns of shape (n,) or (n, m) as independent ones of variance one."""
        whitened = np.empty_like(values)
        for own, factor in self._factors:
            whitened[own] = solve_triangular(factor, values[own], lower=True)
        return whitened

    def whiten_errors_of(self, rows: Numbers) -> tuple[Numbers, Array]:
        """Return the m rows of a sweep, and whitened errors of k of them, each 1 rad/s, (m, k)."""
        own, factor = next(each for each in self._factors if np.isin(rows[0], each[0]))
        return own, solve_triangular(factor, (own[:, None] == rows).astype(float), lower=True)

    def restore(self, whitened: Array) -> Array:
        """Return what `whiten` was given."""
        values = np.empty_like(whitened)
        for own, factor in self._factors:
            values[own] = factor @ whitened[own]
        return values


def estimate_scatter(dwells: Dwells) -> Scatter:
    """Return how dwells scatter, by restricted likelihood, and which of them are outlying."""
    kept = find_inliers(dwells)
    used = select_dwells(dwells, kept)
    error, surface = used.output - used.rate, _smooth_surface(used)
    # without the removal of what the surface explains, small errors would be lost in rounding
    error = error - surface @ (surface.T @ error)
    fastest = max(float(np.abs(used.rate).max()), 1e-9)
    # above rounding, or that would be explained and the Gram matrix of exact dwells singular
    size = (rms(error) * math.sqrt(len(used) / max(len(used) - surface.shape[1], 1))
            + 1e-12 * fastest + 1e-3 * float(np.nan_to_num(used.deviation).max(initial=0.0)))
    relative = size / fastest
    units = np.array([size, relative, size, relative])[:_count_scatter_terms(used)]

    def scatter(logarithms: Array) -> Scatter:
        return Scatter(*np.append(units * np.exp(logarithms), np.zeros(4 - len(units))).tolist(),
                       inliers=kept)  # type: ignore[misc]

    def deviance(logarithms: Array) -> float:
        """Return -ln of the restricted likelihood and the prior, up to a constant."""
        tried = scatter(logarithms)
        deviation = tried.deviation(used)
        log_determinant, misfit, *_ = _fit_values(
            used, deviation, surface, error, np.array([[tried.sweep_bias, tried.sweep_scale]]))
        # the likelihood does not fall where the values pass through a dwell that is taken as exact
        exactness = math.log(rms(deviation) / deviation.min())
        return exactness + 0.5 * float(
            log_determinant[0] + 2.0 * np.log(deviation).sum() + misfit[0])

    # a simplex would collapse onto a bound
    best = minimize(
        deviance, np.array([0.0, -1.5, -1.5, -1.5])[:len(units)], method='L-BFGS-B',
        bounds=[(-7.0, 2.0)] * len(units), options={'eps': 1e-4, 'ftol': 1e-7})
    return scatter(best.x)


def _count_scatter_terms(dwells: Dwells) -> int:
    """Return how many of the four scatters the dwells and sweeps determine."""
    if len(dwells) < _MIN_DWELLS:
        return 1
    return 4 if len(np.unique(dwells.sweep)) > 1 else 2


def find_inliers(dwells: Dwells) -> Mask:
    """
    Return which dwells are not outlying, by a robust fit of the surface.

    Where there are dwells enough, each sweep has a bias and scale of its own besides. Of few
    dwells none is left out.
    """
    if len(dwells) < _MIN_DWELLS:
        return np.ones(len(dwells), dtype=bool)
    columns = _smooth_surface(dwells)
    if _count_scatter_terms(dwells) == 4:
        parts = _sweep_numbers(dwells)
        own = (parts[:, None] == np.arange(parts.max() + 1)).astype(float)
        turning = dwells.rate / max(float(np.abs(dwells.rate).max()), 1e-9)
        extended = orth(np.column_stack([columns, own, own * turning[:, None]]), 1e-4)
        if 2 * extended.shape[1] <= len(dwells):
            columns = extended
    residual = np.abs(robust_residual(columns, dwells.output - dwells.rate, 20))
    # Such a fit passes through as many dwells as it has columns; these are left out of the median.
    spread = robust_deviation(np.sort(residual)[columns.shape[1]:])
    limit = OUTLIER_THRESHOLD * np.hypot(spread, np.nan_to_num(dwells.deviation)) + 1e-12
    return np.asarray(residual <= limit)


def _smooth_surface(dwells: Dwells) -> Array:
    """Return orthonormal columns of a surface, (n, m), at most one for three dwells."""
    if len(dwells) < 2:
        raise DataRefused('a single dwell shows no effect: '
                          'turn at more rates, and rest between them')
    rate = dwells.rate / max(float(np.abs(dwells.rate).max()), 1e-9)
    temperature = (np.zeros(len(rate)) if dwells.temperature is None
                   else dwells.temperature - dwells.temperature.mean())
    temperature = temperature / max(float(np.abs(temperature).max()), 0.5 * MIN_TEMPERATURE_SPREAD)
    powers = sorted(((i, j) for i in range(6) for j in range(3)),
                    key=lambda power: (power[0] + 2 * power[1], power[1]))
    products = [rate ** i * temperature ** j for i, j in powers]
    columns = np.column_stack([*products[:4], np.abs(rate),
                               *products[4:]])[:, :max(len(rate) // 3, min(len(rate) - 1, 2))]
    return np.asarray(orth(columns, 1e-4))


def surface_dof(dwells: Dwells) -> int:
    """Return the number of dwells less that of the columns of the surface of their scatter."""
    return len(dwells) - _smooth_surface(dwells).shape[1]


def _fit_values(dwells: Dwells, deviation: Array, columns: Array, error: Array,
                sizes: Array) -> tuple[Array, Array, Array, Array]:
    """
    Fit columns (n, m) to an error (n,) for each of k scatters of sweeps' bias and scale, (k, 2).

    Return the logarithm of the determinants of covariance, in that of the dwells, and Gram matrix,
    the sum of the squared whitened residuals, the values, (k, m), and the inverse Gram matrix, (k,
    m, m).
    """
    columns = np.column_stack([columns, error]) / deviation[:, None]
    shared = np.column_stack([np.ones(len(dwells)), dwells.rate]) / deviation[:, None]
    inner, outer = (sum_by_part(shared[:, :, None] * each[:, None, :],
                                _sweep_numbers(dwells)) for each in (shared, columns))
    # Woodbury: the covariance is diagonal plus two shared columns for each sweep
    inner = np.eye(2) + sizes[:, None, :, None] * inner * sizes[:, None, None, :]
    outer = sizes[:, None, :, None] * outer
    gram = columns.T @ columns - np.einsum('ksij,ksil->kjl', outer,
                                           np.linalg.solve(inner, outer), optimize=True)
    inverse, right = np.linalg.inv(gram[:, :-1, :-1]), gram[:, :-1, -1]
    values = np.einsum('kij,kj->ki', inverse, right)
    misfit = np.maximum(gram[:, -1, -1] - np.einsum('ki,ki->k', values, right),
                        1e-12 * (columns[:, -1] @ columns[:, -1])) + 1e-200
    return (np.linalg.slogdet(inner)[1].sum(axis=1) - np.linalg.slogdet(inverse)[1], misfit,
            values, inverse)


@dataclass(frozen=True)
class Uncertainty:
    """
    The uncertainty of values fitted to dwells, averaged over possible scatters.

    That of the dwells gives Student's distribution, that of the sweeps is summed over a grid. Its
    prior is uniform in the logarithm of the variance of a sweep's own bias, or scale (Box and Tiao
    1973, section 5.2). That sweeps do not differ has the weight of a factor of e in that variance,
    without which their intervals would be too wide.
    """

    weights: Array  # of possible scatters, shape (k,)
    # from the values that were fitted to the middle of their distribution, shape (k, m)
    offsets: Array
    covariances: Array  # scale matrices of the distribution, shape (k, m, m)
    dof: int  # of Student's distribution
    # standard deviations of the bias of a sweep, rad/s, and of its scale factor, 1, shape (k, 2)
    sweep_deviations: Array

    @classmethod
    def from_fit(cls, dwells: Dwells, scatter: Scatter, columns: Array,
                 error: Array) -> Uncertainty:
        """
        Average over the possible scatters of dwells, of which there are more than values.

        Given are the change of the error for each value, (n, m), and the residual, rad/s, (n,).
        """
        lengths, deviation = np.linalg.norm(columns, axis=0), scatter.deviation(dwells)
        dof, likeliest = len(dwells) - len(lengths), (scatter.sweep_bias, scatter.sweep_scale)
        axes, priors = [np.zeros(1)] * 2, [np.ones(1)] * 2
        if _count_scatter_terms(dwells) == 4:
            # variance of bias and scale of each sweep by its dwells, shape (2, sweeps)
            weights = np.column_stack([np.ones(len(dwells)), np.maximum(dwells.rate ** 2, 1e-18)])
            variances = 1.0 / sum_by_part(
                weights / deviation[:, None] ** 2, _sweep_numbers(dwells)).T
            for place, variance in enumerate(variances):
                # possible sizes of this scatter about the likely one, and their prior
                typical, size = 1.0 / math.sqrt(float(np.mean(1.0 / variance))), likeliest[place]
                grid = np.geomspace(
                    max(0.3 * typical, size / 30.0), 100.0 * max(typical, size), 25)
                prior = grid ** 2 * np.sqrt(
                    np.mean((grid[:, None] ** 2 + variance) ** -2.0, axis=1))
                axes[place] = np.append(0.0, grid)
                priors[place] = np.append(
                    0.5 + 0.5 * prior[0], prior * math.log(grid[1] / grid[0]))
        sizes = [np.column_stack([np.full(len(axes[1]), bias), axes[1]])
                 for bias in axes[0]]  # in turn, for the memory
        log_determinant, misfit, offsets, inverses = (np.concatenate(each) for each in zip(*(
            _fit_values(dwells, deviation, columns / lengths, error, each) for each in sizes)))
        logarithm = -0.5 * (log_determinant + dof * np.log(misfit))
        weights = softmax(logarithm) * np.outer(*priors).ravel()
        likely = weights > 1e-4 * weights.sum()
        weights = weights[likely] / weights[likely].sum()
        size = misfit[likely] / dof
        covariances = inverses[likely] * size[:, None, None]
        if len(dwells.rounding):
            # errors by the steps of the output are known: a small residual does not remove them
            whiten = Whitener(dwells, scatter).whiten
            sizes_known, directions = np.linalg.eigh(step_covariance(
                dwells.rate, dwells.output, dwells.rounding))
            known = np.linalg.pinv(whiten(columns / lengths)) @ whiten(
                directions * np.sqrt(np.maximum(sizes_known, 0.0)))
            covariances += np.maximum(1.0 - size, 0.0)[:, None, None] * (known @ known.T)
        return cls(weights, offsets[likely] / lengths, covariances / np.outer(lengths, lengths),
                   dof, np.concatenate(sizes)[likely] * np.sqrt(size)[:, None])

    def half_width(self, probability: float) -> Array:
        """Return half of the intervals about the fitted values of a probability, shape (m,)."""
        return self._half_width(probability, self.offsets, np.sqrt(
            np.diagonal(self.covariances, axis1=1, axis2=2)))

    def _half_width(self, probability: float, offsets: Array, deviations: Array) -> Array:
        """Return half of the intervals about zero, of offsets and deviations (k, m)."""
        deviations = np.maximum(deviations, 1e-12 * deviations.max(axis=0) + 1e-300)
        low = np.zeros(offsets.shape[1])
        high = (2.0 * student.ppf(0.5 + 0.5 * probability, self.dof)
                * (deviations + np.abs(offsets)).max(axis=0))
        for _ in range(25):
            half = 0.5 * (low + high)
            below, above = (student.cdf((end - offsets) / deviations, self.dof)
                            for end in (-half, half))
            narrow = self.weights @ (above - below) < probability
            low, high = np.where(narrow, half, low), np.where(narrow, high, half)
        return high

    @property
    def sweep_scatter(self) -> Array:
        """Return the deviations of bias and scale of another sweep, which hold 68.3 %, (2,)."""
        return self._half_width(0.6827, np.zeros_like(self.sweep_deviations),
                                self.sweep_deviations)

    def covariance(self) -> Array:
        """Return the covariance, (m, m), so wide that 1.96 standard deviations hold 95 %."""
        covariance = np.tensordot(self.weights, self.covariances, axes=1)
        widening = self.half_width(0.95) / NORMAL_QUANTILE_975 / np.sqrt(np.diag(covariance))
        return covariance * np.outer(widening, widening)


def estimate_tolerance(dwells: Dwells, whitener: Whitener, sweep_scatter: Array,
                       columns: Callable[[Array, Array], Array], covariance: Array) -> Tolerance:
    """
    Return the error of a rate that the covariance of the values, (m, m), does not contain.

    Effects that were not fitted may exist below the noise: a fit with more columns has a larger
    variance. Its mean over the fitted dwells is added to the variance of the bias; its value half
    a width outside of the calibrated range gives the slopes. `columns` are functions of rates,
    rad/s, and temperatures, degC; the scatter is that of bias and scale factor of sweeps, rad/s
    and 1, (2,).
    """
    fastest = max(float(np.abs(dwells.rate).max()), 1e-9)
    temperature = (np.zeros(len(dwells)) if dwells.temperature is None
                   else np.asarray(dwells.temperature))
    low, high = float(temperature.min()), float(temperature.max())
    middle = 0.5 * (low + high)
    half_width = max(0.5 * (high - low), 0.5 * MIN_TEMPERATURE_SPREAD)
    curve = 0.5 / Prior().correlation_length  # a slope changes by its own size over this length
    unfitted_deviations = [
        BIAS_SLOPE_DEVIATION, BIAS_SLOPE_DEVIATION * curve, SCALE_SLOPE_DEVIATION * fastest,
        SCALE_SLOPE_DEVIATION * fastest * curve, *[_NONLINEARITY_DEVIATION * fastest] * 2]
    first = 4 if dwells.temperature is None else 0

    def extended_columns(rate: Array, warm: Array) -> Array:
        """Return the columns of the values, slopes and curves over temperature, and powers."""
        w, t = rate / fastest, warm - middle
        unfitted = np.column_stack([t, t ** 2, t * w, t ** 2 * w, w ** 2, w ** 3])
        return np.column_stack([columns(rate, warm), unfitted[:, first:]])

    prior_deviation = np.array([*[math.inf] * len(covariance), *unfitted_deviations[first:]])
    white = whitener.whiten(extended_columns(dwells.rate, temperature))
    lengths = np.linalg.norm(white, axis=0)
    lengths = np.where(lengths > 0.0, lengths, 1.0)
    gram = (white / lengths).T @ (white / lengths) + np.diag((prior_deviation * lengths) ** -2.0)
    inverse = np.linalg.pinv(gram, hermitian=True)

    def excess_variance(rate: Array, warm: Array) -> Array:
        """Return the variance of the larger fit less that of the values, (rad/s)²."""
        wide, row = extended_columns(rate, warm) / lengths, columns(rate, warm)
        return np.maximum(
            ((wide @ inverse) * wide).sum(axis=1) - ((row @ covariance) * row).sum(axis=1), 0.0)

    ends, sides = np.array([low - half_width, high + half_width]), np.array([-1.0, 1.0])
    at_rest = excess_variance(np.zeros(2), ends).max()
    turning = excess_variance(fastest * np.repeat(sides, 2), np.tile(ends, 2)).max()
    faster = excess_variance(1.5 * fastest * sides, np.full(2, middle)).max()
    unfitted = excess_variance(dwells.rate, temperature).mean()
    return Tolerance(math.sqrt(sweep_scatter[0] ** 2 + unfitted), float(sweep_scatter[1]),
                     math.sqrt(at_rest) / half_width,
                     math.sqrt(max(turning - at_rest, 0.0)) / half_width / fastest,
                     math.sqrt(faster) / (0.5 * fastest))
