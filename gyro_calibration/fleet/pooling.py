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
Partial pooling: the parts of a value by type, unit, drive and power-on.

Value ``y`` of the log ``i`` of unit ``u`` on drive ``d`` is taken as::

    y_i = x_i' beta + unit_u + t_i' slope_u + drive_d + power_on_i + error_i

* ``beta``: mean of the type, and its slopes over age and temperature ``t``;
* ``unit``, ``slope``, ``drive`` and ``power_on``: normal, with unknown standard deviations
  *between units*, of the slopes of units about that of the type, *between drives* and *between
  power-ons*;
* ``error``: of the variance ``sigma_i²`` that the calibration of the log states, the share
  ``lambda`` is independent between logs. The rest is an error of the reference, which all units of
  a drive have in common, so it is part of the variance between drives; or the stated variance is
  too large, since a single log does not distinguish the error of its reference from that of its
  gyro.

The restricted likelihood (REML) of the variances is integrated, not maximized, so that intervals
hold with few units and few drives: estimates are averaged over points of a quasi-random sequence,
weighted by likelihood times a prior. The prior is that of Jeffreys for the variance of groups,
``sqrt(sum 1 / (tau² + v_g)²)`` with ``v_g`` the variance of the mean of a group; in balanced data
it is flat in the logarithms of the expected mean squares, and the intervals are those of Student.

The equations are those of mixed models (Henderson 1975): units are eliminated first, as each log
is of one unit, so that only the columns of drives and ``beta`` are solved for.

An outlying unit or drive is given an effect of its own and the others are pooled again, so that it
is compared with their prediction for one more unit. Its p-value is multiplied by the number of
those that it was chosen from (Bonferroni). With 15 or more, the next one is tested together with
it, since two outliers mask each other; the last one below the level, and all before it, are
outliers (generalized extreme studentized deviate, Rosner 1983).

"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
import math
from typing import Any

from gyro_calibration.logs.log import Array, DataRefused
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.sparse import csr_array
from scipy.special import ndtr
from scipy.stats import qmc

IntegerArray = NDArray[np.intp]
#: The estimated standard deviations, and the share of the stated variance that is independent
#: between logs.
UNITS, DRIVES, POWER_ONS, OWN_SHARE = 'units', 'drives', 'power_ons', 'own_share'
#: Standard deviations of the slopes of units over the first column and the second.
SLOPES = ('slopes_0', 'slopes_1')
#: Minimum number of logs of a unit, at different values of a column, for a slope of its own.
_MIN_SLOPE_LOGS = 3
#: Points of the sequence over the variances, and of a slice through the likeliest point.
_SAMPLE_POINTS, _SLICE_POINTS = 512, 41
#: Largest possible standard deviation, in standard deviations of the values about their median.
_MAX_RELATIVE_DEVIATION = 30.0


@dataclass(frozen=True)
class Observations:
    """
    One value over the logs of a type.

    Attributes
    ----------
    value, deviation : in one unit, shape (n,)
    unit : number of the unit of each log, from 0 on, shape (n,)
    drive : number of the drive, from 0 on, or -1 where a log stands alone, shape (n,)
    columns : fixed effects in addition to the mean, such as age, shape (n, k)
    slope_count : the number of the first columns whose effect may differ from unit to unit, at
        most 2

    """

    value: Array
    deviation: Array
    unit: IntegerArray
    drive: IntegerArray
    columns: Array = field(default_factory=lambda: np.empty((0, 0)))
    slope_count: int = 0

    def __len__(self) -> int:
        return len(self.value)

    @property
    def fixed_effects(self) -> Array:
        """Return the columns with that of the mean, shape (n, 1 + k)."""
        more = self.columns if self.columns.size else np.empty((len(self), 0))
        return np.column_stack([np.ones(len(self)), more])

    def add_column(self, column: Array) -> Observations:
        """Return the same with one more fixed effect."""
        return replace(self, columns=np.column_stack([self.fixed_effects[:, 1:], column]))


@dataclass(frozen=True)
class LinearFunctions:
    """
    Linear functions of the estimates: of fixed effects, one unit and one drive each.

    Attributes
    ----------
    fixed : shape (k, 1 + columns)
    unit, drive : numbers, -1 for none, shape (k,)
    log_deviation : standard deviation that a log will state; its own share is added, shape (k,)
    unit_weights : weights of the value of the unit and of its slopes, shape (1 + slopes,)
    added_variances : name of a variance -> its multiple that is added, for quantities that are not
        estimated, such as the next power-on

    """

    fixed: Array
    unit: IntegerArray
    drive: IntegerArray
    log_deviation: Array
    unit_weights: Array
    added_variances: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Interval:
    """Estimates with standard deviations and bounds, each of shape (k,), or numbers."""

    value: Array
    deviation: Array
    low: Array
    high: Array


class _Equations:
    """The mixed-model equations, at many points of the variances at a time."""

    def __init__(self, observed: Observations, fixed: Array, has_drives: bool):
        """Lay out the columns: fixed effects, then drives."""
        self.observed, self.fixed = observed, fixed
        self.units = int(observed.unit.max()) + 1
        self.drives = int(observed.drive.max()) + 1 if has_drives else 0
        self.columns = fixed.shape[1] + self.drives
        #: the columns of the value of a unit, and of its slopes
        self.unit_columns = fixed[:, :1 + observed.slope_count]
        self.unit_sums = _group_sum_matrix(observed.unit)
        if self.drives:
            on = np.flatnonzero(observed.drive >= 0)
            self.on_drive, self.drive_sums = on, _group_sum_matrix(observed.drive[on])
            pairs, place = np.unique(observed.unit[on] * self.drives + observed.drive[on],
                                     return_inverse=True)
            self.pair_sums = _group_sum_matrix(place)
            self.pair_unit, self.pair_drive = np.divmod(pairs, self.drives)

    def split_points(self, points: int) -> list[slice]:
        """Divide the points into parts that are solved together, which bounds the memory."""
        size = (self.units * self.columns * (1 + self.observed.slope_count) + self.columns ** 2
                + len(self.observed))
        step = max(2_000_000 // size, 1)
        return [slice(begin, begin + step) for begin in range(0, points, step)]


def _group_sum_matrix(group: IntegerArray) -> Any:
    """Return the matrix that sums over the members of each group."""
    return csr_array((np.ones(len(group)), (group, np.arange(len(group)))))


class _Solution:
    """Solutions for variances of shape (points,), which is the first axis of all arrays."""

    def __init__(self, equations: _Equations, variances: Mapping[str, Array]):
        of, fixed, count = equations.observed, equations.fixed, len(next(iter(variances.values())))
        zeros = np.zeros(count)
        own_share = variances.get(OWN_SHARE, zeros + 1.0)
        self._equations = equations
        tau = np.sqrt(np.column_stack([variances.get(name, zeros)
                                       for name in (UNITS, *SLOPES[:of.slope_count])]))
        self._unit_deviations = tau
        self._drive_deviation = np.sqrt(variances.get(DRIVES, zeros))[:, None]
        variance = (variances.get(POWER_ONS, zeros)[:, None]
                    + own_share[:, None] * of.deviation ** 2)
        weight = 1.0 / variance

        def summed(matrix: Any, values: Array) -> Array:
            return np.asarray((matrix @ values.T).T)

        fixed_count, total = fixed.shape[1], equations.columns
        normal, right = np.zeros((count, total, total)), np.zeros((count, total))
        parts = equations.unit_columns.shape[1]
        unit_right = np.empty((count, equations.units, parts))
        unit_columns = np.zeros((count, equations.units, parts, total))
        normal[:, :fixed_count, :fixed_count] = np.einsum(
            'pn,na,nb->pab', weight, fixed, fixed, optimize=True)
        right[:, :fixed_count] = weight @ (of.value[:, None] * fixed)
        for part, column in enumerate(equations.unit_columns.T):
            unit_right[:, :, part] = summed(equations.unit_sums, weight * column * of.value)
            for place in range(fixed_count):
                unit_columns[:, :, part, place] = summed(
                    equations.unit_sums, weight * column * fixed[:, place])
        if equations.drives:
            drive_weight = weight[:, equations.on_drive]
            index = fixed_count + np.arange(equations.drives)
            right[:, index] = self._drive_deviation * summed(
                equations.drive_sums, drive_weight * of.value[equations.on_drive])
            for part, column in enumerate(equations.unit_columns[equations.on_drive].T):
                unit_columns[:, equations.pair_unit, part,
                             index[equations.pair_drive]] = self._drive_deviation * summed(
                                 equations.pair_sums, drive_weight * column)
            for place in range(fixed_count):
                normal[:, place, index] = self._drive_deviation * summed(
                    equations.drive_sums, drive_weight * fixed[equations.on_drive, place])
                normal[:, index, place] = normal[:, place, index]
            normal[:, index, index] = (self._drive_deviation ** 2
                                       * summed(equations.drive_sums, drive_weight))
            normal[:, range(fixed_count, total), range(fixed_count, total)] += 1.0
        # the columns of a unit are the first fixed effects
        precision = (np.eye(parts) + tau[:, None, :, None] * tau[:, None, None, :]
                     * unit_columns[:, :, :, :parts])
        self._within = np.linalg.inv(precision)
        self._across = tau[:, None, :, None] * unit_columns
        self._right = tau[:, None] * unit_right
        lighter = self._within @ self._across
        rows = count, equations.units * parts
        triangle = np.linalg.cholesky(normal - np.swapaxes(lighter.reshape(*rows, total), 1, 2)
                                      @ self._across.reshape(*rows, total))
        self._inverse = np.linalg.inv(triangle)  # of at most some hundred columns
        reduced = right - np.einsum('puac,pua->pc', lighter, self._right)
        half = np.einsum('pij,pj->pi', self._inverse, reduced)
        self._solution = np.einsum('pij,pi->pj', self._inverse, half)
        squares = (weight @ of.value ** 2 - np.sum(half ** 2, axis=1)
                   - np.einsum('pua,puab,pub->p', self._right, self._within, self._right))
        self.log_likelihood = -0.5 * (
            np.log(variance).sum(axis=1) + np.linalg.slogdet(precision)[1].sum(axis=1) + squares
            + 2.0 * np.log(np.diagonal(triangle, axis1=1, axis2=2)).sum(axis=1))

    def moments(self, wanted: LinearFunctions) -> tuple[Array, Array]:
        """Return means and variances of linear functions, shape (points, k)."""
        at, kept = self._equations, self._equations.fixed.shape[1]
        rows = np.zeros((len(self._unit_deviations), len(wanted.unit), at.columns))
        rows[:, :, :kept] = wanted.fixed
        if at.drives:
            on = np.flatnonzero(wanted.drive >= 0)
            rows[:, on, kept + wanted.drive[on]] = self._drive_deviation
        unit = np.maximum(wanted.unit, 0)
        size = self._unit_deviations[:, None] * (wanted.unit_weights * (wanted.unit >= 0)[:, None])
        share = np.einsum('pkab,pkb->pka', self._within[:, unit], size)
        rows -= np.einsum('pka,pkac->pkc', share, self._across[:, unit])
        mean = (np.einsum('pkc,pc->pk', rows, self._solution)
                + np.sum(share * self._right[:, unit], axis=2))
        spread = rows @ np.swapaxes(self._inverse, 1, 2)
        return mean, np.sum(size * share, axis=2) + np.sum(spread ** 2, axis=2)


@dataclass(frozen=True)
class Component:
    """A standard deviation: its REML estimate and the bounds that hold it with 95 %."""

    estimate: float
    low: float
    high: float


class PooledValue:
    """
    One value, pooled over the logs of a type.

    Attributes
    ----------
    observed : the values
    variance_names : of the variances that the logs distinguish
    likeliest_variances : name -> variance (of `OWN_SHARE`, a share) at the largest restricted
        likelihood

    """

    def __init__(self, observed: Observations):
        """Pool; raise `DataRefused` where there are not more logs than fixed effects."""
        fixed = observed.fixed_effects
        if len(observed) < fixed.shape[1] + 1:
            raise DataRefused(f'{len(observed)} logs do not show how much a value varies; at '
                              f'least {fixed.shape[1] + 1} are needed')
        self.observed = observed
        self._median = float(np.median(observed.value))
        error = float(np.median(observed.deviation))
        self._value_scale = math.hypot(float(np.std(observed.value)), 1e-3 * error) or 1.0
        # columns of about one, so that the equations are well conditioned
        self._column_scales = np.maximum(np.abs(fixed).max(axis=0), 1e-300)
        self._fixed = fixed / self._column_scales
        # errors below 1e-5 of the spread of the values would make the equations ill-conditioned
        self._scaled_observations = replace(
            observed, value=(observed.value - self._median) / self._value_scale,
            deviation=np.maximum(observed.deviation / self._value_scale, 1e-5),
            columns=self._fixed[:, 1:])
        self.variance_names = _identifiable_variances(observed)
        self._coordinate_bounds = _variance_bounds(self._scaled_observations, self.variance_names)
        self._equations = _Equations(self._scaled_observations, self._fixed,
                                     DRIVES in self.variance_names)
        self._best_point = self._find_best_point()
        self.likeliest_variances = {
            name: float(value[0]) * (1.0 if name == OWN_SHARE else self._value_scale ** 2)
            for name, value in self._variances_at(self._best_point[None]).items()
            if name in self.variance_names}
        self._sample_points, self._sample_weights = self._sample_variances()
        self._cached_solution: _Solution | None = None

    # the variances

    def _variances_at(self, points: Array) -> dict[str, Array]:
        """Return the variances at points: logarithms of variance plus a floor, and the share."""
        found = {name: column if name == OWN_SHARE
                 else np.maximum(np.exp(column) - math.exp(self._coordinate_bounds[name][0]), 0.0)
                 for name, column in zip(self.variance_names, points.T)}
        return found or {POWER_ONS: np.zeros(len(points))}

    def _log_likelihood(self, points: Array, prior: bool = False) -> Array:
        """Return the restricted log-likelihoods at points, or with the log-prior added."""
        found = []
        for part in self._equations.split_points(len(points)):
            sizes = self._variances_at(points[part])
            found.append(_Solution(self._equations, sizes).log_likelihood)
            if prior:
                found[-1] = found[-1] + _log_prior(self._equations, sizes) + sum(
                    column for name, column in zip(self.variance_names, points[part].T)
                    if name != OWN_SHARE)
        return np.concatenate(found)

    def _find_best_point(self, excluded: str = '') -> Array:
        """Return the point of largest restricted likelihood, optionally without one variance."""
        if not self.variance_names:
            return np.empty(0)
        bounds = [(self._coordinate_bounds[name][0],) * 2 if name == excluded
                  else self._coordinate_bounds[name] for name in self.variance_names]
        point = np.array([low + 0.3 * (high - low) for low, high in bounds])
        for place, (low, high) in enumerate(bounds):
            if high > low:
                tried = _replace_coordinate(point, place, np.linspace(low, high, 15))
                point = tried[np.argmax(self._log_likelihood(tried))]
        found = minimize(self._objective, point, method='L-BFGS-B', jac=True, bounds=bounds,
                         options={'maxiter': 60})
        # the gradient search often misses an optimum at the floor
        ends = [_replace_coordinate(found.x, place, np.array([low]))
                for place, (low, _) in enumerate(bounds)]
        tried = np.vstack([found.x, point, *ends])
        best: Array = tried[np.argmax(self._log_likelihood(tried))]
        return best

    def _objective(self, point: Array) -> tuple[float, Array]:
        """Return minus the restricted likelihood and its slope."""
        step = 1e-5
        found = -self._log_likelihood(np.vstack([point, point + step * np.eye(len(point))]))
        return float(found[0]), (found[1:] - found[0]) / step

    def _sample_variances(self) -> tuple[Array, Array]:
        """Return points of the variances, shape (points, names), and their weights."""
        if not self.variance_names:
            return np.empty((1, 0)), np.ones(1)
        uniform = qmc.Halton(len(self.variance_names), scramble=False).random(
            _SAMPLE_POINTS + 1)[1:]
        sample, log_density = np.empty_like(uniform), np.zeros(_SAMPLE_POINTS)
        for place, name in enumerate(self.variance_names):
            axis = np.linspace(*self._coordinate_bounds[name], _SLICE_POINTS)
            along = self._log_likelihood(_replace_coordinate(self._best_point, place, axis),
                                         prior=True)
            # wider than the slice, since the other variances are not known
            density = np.exp(0.6 * (along - along.max()))
            density = density + 0.1 * density.mean()
            cells = 0.5 * (density[1:] + density[:-1]) * np.diff(axis)
            total = np.concatenate([[0.0], np.cumsum(cells)])
            sample[:, place] = np.interp(uniform[:, place], total / total[-1], axis)
            cell = np.clip(np.searchsorted(axis, sample[:, place]) - 1, 0, _SLICE_POINTS - 2)
            log_density += np.log(cells[cell])  # within a cell the points are uniform
        log_weight = self._log_likelihood(sample, prior=True) - log_density
        weight = np.exp(log_weight - log_weight.max())
        return sample, weight / weight.sum()

    @cached_property
    def components(self) -> dict[str, Component]:
        """Return the standard deviations by name, and the independent share of the errors."""
        found, likeliest, sample = ({}, self._variances_at(self._best_point[None]),
                                    self._variances_at(self._sample_points))
        for name in self.variance_names:
            order = np.argsort(sample[name])
            total = np.cumsum(self._sample_weights[order]) - 0.5 * self._sample_weights[order]
            bounds = np.interp([0.025, 0.975], total, sample[name][order])
            values = np.array([likeliest[name][0], *bounds])
            if name != OWN_SHARE:
                without = self._log_likelihood(
                    np.vstack([self._best_point, self._find_best_point(name)]))
                # a variance of zero is rejected at 2.5 %, one-sided; half of the probability is at
                # zero (Self and Liang 1987)
                values = np.sqrt(values) * [1.0, 2.0 * (without[0] - without[1]) > 3.841, 1.0]
            size = (1.0 if name == OWN_SHARE else self._value_scale
                    / self._column_scales[1 + SLOPES.index(name)]
                    if name in SLOPES else self._value_scale)
            found[name] = Component(*(size * values).tolist())
        return found

    # estimates

    def _moments(self, wanted: LinearFunctions) -> tuple[Array, Array]:
        """Return means and variances at each point, shape (points, k), in units of the values."""
        scaled = replace(
            wanted, fixed=wanted.fixed / self._column_scales,
            unit_weights=wanted.unit_weights / self._column_scales[:1 + self.observed.slope_count],
            log_deviation=wanted.log_deviation / self._value_scale)
        found = []
        for sizes, solved in self._solutions():
            mean, variance = solved.moments(scaled)
            for name, count in wanted.added_variances.items():
                variance = variance + count * sizes.get(name, np.zeros(1))[:, None]
            own_share = sizes.get(OWN_SHARE, np.ones(1))[:, None]
            found.append((mean, variance + own_share * scaled.log_deviation ** 2))
        mean, variance = (np.concatenate(each) for each in zip(*found))
        constant = self._median * wanted.fixed[:, 0]
        return (constant + self._value_scale * mean,
                self._value_scale ** 2 * np.maximum(variance, 1e-30))

    def _solutions(self) -> Iterator[tuple[Mapping[str, Array], _Solution]]:
        """Give variances and solutions at the points; a solution of all points is kept."""
        parts = self._equations.split_points(len(self._sample_points))
        for part in parts:
            sizes = self._variances_at(self._sample_points[part])
            if len(parts) > 1:
                yield sizes, _Solution(self._equations, sizes)
                continue
            self._cached_solution = self._cached_solution or _Solution(self._equations, sizes)
            yield sizes, self._cached_solution

    def estimate(self, wanted: LinearFunctions) -> Interval:
        """Return estimates with intervals that hold with 95 %."""
        mean, variance = self._moments(wanted)
        value = self._sample_weights @ mean
        deviation = np.sqrt(self._sample_weights @ (variance + (mean - value) ** 2))
        low, high = (_mixture_quantile(mean, variance, self._sample_weights, chance)
                     for chance in (0.025, 0.975))
        return Interval(value, deviation, low, high)

    def p_value(self, wanted: LinearFunctions) -> Array:
        """Return the two-sided p-values of linear functions against 0, shape (k,)."""
        mean, variance = self._moments(wanted)
        below = self._sample_weights @ ndtr(-mean / np.sqrt(variance))
        return np.minimum(2.0 * np.minimum(below, 1.0 - below), 1.0)

    def linear_functions(self, unit: IntegerArray | None = None, drive: IntegerArray | None = None,
                         fixed: Array | None = None, error: Array | float = 0.0,
                         part: int = 0, **more: float) -> LinearFunctions:
        """
        Return linear functions; by default the mean of the type, or of units and drives.

        Parameters
        ----------
        unit, drive, fixed, error, more : as of `LinearFunctions`
        part : of a unit: 0 for its value, from 1 on for a slope

        """
        count = next((len(each) for each in (unit, drive, fixed) if each is not None), 1)
        none = np.full(count, -1)
        row = np.zeros((count, self._fixed.shape[1]))
        row[:, 0] = 1.0
        return LinearFunctions(row if fixed is None else fixed, none if unit is None else unit,
                               none if drive is None else drive,
                               np.broadcast_to(np.asarray(error, float), (count,)),
                               np.eye(1 + self.observed.slope_count)[part], more)

    def score_column(self, column: Array) -> float:
        """Return the approximate z-score of one more fixed effect."""
        fixed = np.column_stack([self._fixed, column])
        sizes = self._variances_at(self._best_point[None])
        solved = _Solution(
            _Equations(self._scaled_observations, fixed, DRIVES in self.variance_names), sizes)
        row = np.zeros((1, fixed.shape[1]))
        row[0, -1] = 1.0
        mean, variance = solved.moments(self.linear_functions(fixed=row))
        return float(mean[0, 0] / math.sqrt(variance[0, 0]))

    def standardized_effects(self, kind: str) -> Array:
        """Return the approximate z-score of each unit or drive against the others."""
        number = self.observed.unit if kind == UNITS else self.observed.drive
        sizes = self._variances_at(self._best_point[None])
        size = np.maximum(sizes.get(kind, np.zeros(1)), 1e-4)
        groups = np.arange(number.max() + 1)
        rows = np.zeros((len(groups), self._fixed.shape[1]))
        wanted = (self.linear_functions(unit=groups, fixed=rows) if kind == UNITS
                  else self.linear_functions(drive=groups, fixed=rows))
        mean, variance = _Solution(self._equations, {**sizes, kind: size}).moments(wanted)
        known = np.maximum(size - variance[0], 1e-12 * size)
        return np.asarray(mean[0] / np.sqrt(known))


def _identifiable_variances(observed: Observations) -> list[str]:
    """Return the variances that the logs distinguish."""
    logs = np.bincount(observed.unit)
    names = [UNITS] if len(logs) > 1 else []
    for name, column in zip(SLOPES, observed.columns.T[:observed.slope_count]):
        unit_count = sum(len(np.unique(column[observed.unit == unit])) >= _MIN_SLOPE_LOGS
                         for unit in range(len(logs)))
        names += [name] if unit_count > 1 else []
    if len(logs) == 1 or logs.max() > 1:
        names.append(POWER_ONS)
    drives = observed.drive[observed.drive >= 0]
    if len(drives) and np.bincount(drives).max() > 1 and len(np.unique(drives)) > 1:
        names += [DRIVES, OWN_SHARE]
    return names


def _variance_bounds(observed: Observations, names: list[str]) -> dict[str, tuple[float, float]]:
    """Return the ends of each coordinate: the logarithm of floor, and of floor plus largest."""
    square = float(np.median(observed.deviation ** 2))
    floors = {**dict.fromkeys((UNITS, *SLOPES),
                              square * len(np.unique(observed.unit)) / len(observed)),
              DRIVES: square * len(np.unique(observed.drive)) / len(observed), POWER_ONS: square}
    found = {}
    for name in names:
        floor = max(floors.get(name, 0.0), 1e-8)
        found[name] = ((0.02, 1.0) if name == OWN_SHARE
                       else (math.log(floor), math.log(floor + _MAX_RELATIVE_DEVIATION ** 2)))
    return found


def _log_prior(equations: _Equations, variances: Mapping[str, Array]) -> Array:
    """Return logarithms of Jeffreys' prior of the variances of groups, shape (points,)."""
    of, found = equations.observed, np.zeros(len(next(iter(variances.values()))))
    own_share = variances.get(OWN_SHARE, found + 1.0)[:, None]
    variance = variances.get(POWER_ONS, found)[:, None] + own_share * of.deviation ** 2

    def jeffreys(name: str, mean: Array) -> Array:
        """Return the log-prior of a variance in addition to that of the means of groups."""
        size = variances[name][:, None]
        return np.asarray(0.5 * np.log(np.sum((size + mean) ** -2.0, axis=1)))

    if POWER_ONS in variances:
        found = found + 0.5 * np.log(np.sum(variance ** -2.0, axis=1))
    # none of a unit without logs
    known = np.maximum((equations.unit_sums @ (1.0 / variance).T).T, 1e-100)
    if UNITS in variances:
        found = found + jeffreys(UNITS, 1.0 / known)
    for name, column in zip(SLOPES, of.columns.T):
        if name in variances:
            first, second = ((equations.unit_sums @ (column ** power / variance).T).T
                             for power in (1, 2))
            found = found + jeffreys(name,
                                     1.0 / np.maximum(second - first ** 2 / known, 1e-12 * known))
    if DRIVES in variances:
        found = found + jeffreys(
            DRIVES, 1.0 / (equations.drive_sums @ (1.0 / variance[:, equations.on_drive]).T).T)
    return found


def _replace_coordinate(point: Array, coordinate: int, values: Array) -> Array:
    """Return points that differ in one coordinate, shape (values, names)."""
    found = np.tile(point, (len(values), 1))
    found[:, coordinate] = values
    return found


def _mixture_quantile(mean: Array, variance: Array, weight: Array, probability: float) -> Array:
    """Return quantiles of mixtures of normal distributions, shape (k,), by bisection."""
    deviation = np.sqrt(variance)
    # the probability of a mixture outside of this is negligible
    low, high = (mean - 40.0 * deviation).min(axis=0), (mean + 40.0 * deviation).max(axis=0)
    for _ in range(70):
        middle = 0.5 * (low + high)
        is_below = weight @ ndtr((middle - mean) / deviation) < probability
        low, high = np.where(is_below, middle, low), np.where(is_below, high, middle)
    return np.asarray(0.5 * (low + high))


#: Minimum number of units or drives for a test of outliers.
MIN_GROUPS = 4


@dataclass(frozen=True)
class Outlier:
    """
    An outlying unit or drive.

    Attributes
    ----------
    group : of the unit or drive
    excess : difference from the prediction by the others, in the unit of the value
    p_value : p-value of the largest difference of as many units or drives

    """

    group: int
    excess: float
    p_value: float


def find_outliers(observed: Observations, kind: str, significance: float,
                  pooled: PooledValue | None = None) -> list[Outlier]:
    """
    Return the outlying units or drives.

    Parameters
    ----------
    observed : one value over the logs of a type
    kind : `pooling.UNITS` or `pooling.DRIVES`
    significance : probability of an outlier where there is none
    pooled : the value, where it is pooled already

    """
    number = observed.unit if kind == UNITS else observed.drive
    groups = np.unique(number[number >= 0])
    if len(groups) < MIN_GROUPS or len(observed) < MIN_GROUPS + 1:
        return []
    # Rosner's levels hold from 15 on
    max_outliers = min(len(groups) // 5, 10) if len(groups) >= 15 else 1
    found: list[Outlier] = []
    extended: Observations = observed
    pooled = pooled or PooledValue(observed)
    for _ in range(max_outliers):
        if kind not in pooled.variance_names:
            break
        effect_sizes = np.abs(pooled.standardized_effects(kind))[groups]
        effect_sizes[np.isin(groups, [each.group for each in found])] = 0.0
        farthest = int(groups[np.argmax(effect_sizes)])
        extended = extended.add_column((number == farthest).astype(float))
        pooled = PooledValue(extended)
        excess, chance = _test_last_column(pooled)
        found.append(Outlier(farthest, excess, min(chance * (len(groups) - len(found)), 1.0)))
    last = max((place for place, each in enumerate(found, 1) if each.p_value < significance),
               default=0)
    return found[:last]


@dataclass(frozen=True)
class Change:
    """
    A unit whose value changes at some date.

    Attributes
    ----------
    unit : its number
    first_date : number of the first date after the change
    size : of the change, in the unit of the value
    p_value : p-value of the largest of as many possible changes

    """

    unit: int
    first_date: int
    size: float
    p_value: float


def find_changes(observed: Observations, date: IntegerArray, significance: float,
                 pooled: PooledValue | None = None) -> list[Change]:
    """
    Return the most significant change of a unit between dates, beyond the scatter of power-ons.

    Parameters
    ----------
    observed : one value over the logs of a type
    date : number of the date of each log, in their order, or -1, shape (n,)
    significance : probability of a change where there is none
    pooled : the value, where it is pooled already

    """
    pooled = pooled or PooledValue(observed)
    if POWER_ONS not in pooled.variance_names:
        return []
    candidates = [(int(unit), int(since)) for unit in np.unique(observed.unit)
                  for since in np.unique(date[(observed.unit == unit) & (date >= 0)])[1:]]
    if not candidates:
        return []
    columns = [((observed.unit == unit) & (date >= since)).astype(float)
               for unit, since in candidates]
    place = int(np.argmax([abs(pooled.score_column(column)) for column in columns]))
    size, chance = _test_last_column(PooledValue(observed.add_column(columns[place])))
    chance = min(chance * len(candidates), 1.0)
    return [Change(*candidates[place], size, chance)] if chance < significance else []


def _test_last_column(pooled: PooledValue) -> tuple[float, float]:
    """Return the last fixed effect and its p-value."""
    row: Array = np.zeros((1, pooled.observed.fixed_effects.shape[1]))
    row[0, -1] = 1.0
    wanted = pooled.linear_functions(fixed=row)
    return float(pooled.estimate(wanted).value[0]), float(pooled.p_value(wanted)[0])
