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
  a drive have in common, so it is part of the variance between drives.

The restricted likelihood (REML) of the variances is integrated, not maximized, so that intervals
hold with few units and few drives: estimates are averaged over points of a quasi-random sequence,
weighted by likelihood times a prior. The prior is that of Jeffreys for the variance of groups,
``sqrt(sum 1 / (tau² + v_g)²)`` with ``v_g`` the variance of the mean of a group; in balanced data
the intervals are those of Student.

The equations are those of mixed models (Henderson 1975): units are eliminated first, as each log
is of one unit, so that only the columns of drives and ``beta`` are solved for.

An outlying unit or drive is given an effect of its own and the others are pooled again. Its
p-value is multiplied by the number of those that it was chosen from (Bonferroni). With 15 or more,
the next one is tested together with it, since two outliers mask each other; the last one below the
level, and all before it, are outliers (generalized extreme studentized deviate, Rosner 1983).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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

_IntegerArray = NDArray[np.intp]
#: The estimated standard deviations, and the share of the stated variance that is independent
#: between logs.
UNITS, DRIVES, POWER_ONS, OWN_SHARE = 'units', 'drives', 'power_ons', 'own_share'
#: Standard deviations of the slopes of units over the first column and the second.
SLOPES = ('slopes_0', 'slopes_1')


@dataclass(frozen=True)
class Observations:
    """One value over the logs of a type; arrays have the shape (n,)."""

    value: Array
    deviation: Array  # standard deviation that the log states, in the unit of the value
    unit: _IntegerArray  # number of the unit of each log, from 0 on
    drive: _IntegerArray  # number of the drive, from 0 on, or -1 where a log stands alone
    #: Fixed effects in addition to the mean, such as age, shape (n, k).
    columns: Array = field(default_factory=lambda: np.empty((0, 0)))
    slope_count: int = 0  # of the first columns whose effect may differ from unit to unit, up to 2

    @property
    def fixed_effects(self) -> Array:
        """Return the columns with that of the mean, shape (n, 1 + k)."""
        ones = np.ones((len(self.value), 1))
        return np.hstack([ones, self.columns]) if self.columns.size else ones


@dataclass(frozen=True)
class Interval:
    """Estimates with 95 % bounds and standard deviations: each of shape (k,), or numbers."""

    value: Any
    low: Any
    high: Any
    deviation: Any = math.nan


def _sum_matrix(place: _IntegerArray, terms: Array, size: int) -> Any:
    """Return the matrix that sums weights of logs times terms, shape (logs, ...), into places."""
    count = terms[0].size
    logs = np.repeat(np.arange(len(terms)), count)
    return csr_array((terms.ravel(), (place.ravel(), logs)), shape=(size, len(terms)))


class _Equations:
    """
    Sums over logs of the mixed-model equations, as matrices that multiply the weights of logs.

    The columns are the fixed effects, the drives, and the values, whose last row is the right
    side.
    """

    def __init__(self, observed: Observations, fixed: Array, has_drives: bool):
        self.observed, self.fixed_count = observed, fixed.shape[1]
        self.units = int(observed.unit.max()) + 1
        self.drives = int(observed.drive.max()) + 1 if has_drives else 0
        self.columns, self.parts = self.fixed_count + self.drives + 1, 1 + observed.slope_count
        column, entry = np.tile(np.arange(self.fixed_count), (len(fixed), 1)), fixed
        if self.drives:
            on = observed.drive >= 0
            column = np.column_stack([column, self.fixed_count + np.maximum(observed.drive, 0)])
            entry = np.column_stack([entry, on])
        column = np.column_stack([column, np.full(len(fixed), self.columns - 1)])
        entry = np.column_stack([entry, observed.value])
        part = fixed[:, :self.parts]
        unit = observed.unit[:, None] * self.parts + np.arange(self.parts)
        self._sums = [
            _sum_matrix(row[:, :, None] * size + place[:, None], left[:, :, None] * right[:, None],
                        rows * size)
            for (row, left, rows), (place, right, size) in (
                ((unit, part, self.units * self.parts),
                 (np.arange(self.parts)[None], part, self.parts)),
                ((unit, part, self.units * self.parts), (column, entry, self.columns)),
                ((column, entry, self.columns), (column, entry, self.columns)))]

    def sum_up(self, weight: Array) -> list[Array]:
        """Return the blocks of units, of units by columns, and of columns; shape (points, ...)."""
        shapes = ((self.units, self.parts, self.parts), (self.units, self.parts, self.columns),
                  (self.columns, self.columns))
        return [(matrix @ weight.T).T.reshape(len(weight), *shape)
                for matrix, shape in zip(self._sums, shapes)]

    def split_points(self, points: int) -> list[slice]:
        """Divide the points into parts that are solved together, which bounds the memory."""
        size = (self.units * self.columns * self.parts + self.columns ** 2
                + len(self.observed.value))
        step = max(2_000_000 // size, 1)
        return [slice(begin, begin + step) for begin in range(0, points, step)]


class _Solution:
    """Solutions for variances of shape (points,), which is the first axis of all arrays."""

    def __init__(self, equations: _Equations, variances: Mapping[str, Array]):
        self._equations, count = equations, len(next(iter(variances.values())))
        zeros, fixed = np.zeros(count), equations.fixed_count
        variance = _log_variances(equations.observed, variances)
        self._tau = np.sqrt(np.column_stack([
            variances.get(name, zeros) for name in (UNITS, *SLOPES)[:equations.parts]]))
        self._scale = np.ones((count, equations.columns))
        self._scale[:, fixed:-1] = np.sqrt(variances.get(DRIVES, zeros))[:, None]
        within, across, normal = equations.sum_up(1.0 / variance)
        tau = self._tau[:, None, :, None]
        within = np.eye(equations.parts) + tau * within * self._tau[:, None, None]
        self._across = tau * across * self._scale[:, None, None]
        self._within = np.linalg.inv(within)
        normal = self._scale[:, :, None] * normal * self._scale[:, None]
        # of drives by their variance; of the values a constant, which keeps the root real
        random = range(fixed, equations.columns)
        normal[:, random, random] += 1.0
        rows = count, equations.units * equations.parts, equations.columns
        lighter = (self._within @ self._across).reshape(rows)
        triangle = np.linalg.cholesky(
            normal - np.swapaxes(lighter, 1, 2) @ self._across.reshape(rows))
        self._inverse = np.linalg.inv(triangle[:, :-1, :-1])
        self._solution = np.einsum('pij,pi->pj', self._inverse, triangle[:, -1, :-1])
        diagonal = np.diagonal(triangle, axis1=1, axis2=2)
        self.log_likelihood = -0.5 * (
            np.log(variance).sum(axis=1) + np.linalg.slogdet(within)[1].sum(axis=1)
            + diagonal[:, -1] ** 2) - np.log(diagonal[:, :-1]).sum(axis=1)

    def moments(self, fixed: Array, unit: _IntegerArray, drive: _IntegerArray,
                weights: Array) -> tuple[Array, Array]:
        """Return means and variances of linear functions, shape (points, k)."""
        columns = np.zeros((len(self._tau), len(unit), self._equations.columns - 1))
        columns[:, :, :fixed.shape[1]] = fixed
        if self._equations.drives:
            on = np.flatnonzero(drive >= 0)
            place = fixed.shape[1] + drive[on]
            columns[:, on, place] = self._scale[:, place]
        size = self._tau[:, None] * (weights * (unit >= 0)[:, None])
        of = np.maximum(unit, 0)
        share = np.einsum('pkab,pkb->pka', self._within[:, of], size)
        across = np.einsum('pka,pkac->pkc', share, self._across[:, of])
        columns -= across[:, :, :-1]
        mean = np.einsum('pkc,pc->pk', columns, self._solution) + across[:, :, -1]
        spread = columns @ np.swapaxes(self._inverse, 1, 2)
        return mean, np.sum(size * share, axis=2) + np.sum(spread ** 2, axis=2)


def _log_variances(observed: Observations, variances: Mapping[str, Array]) -> Array:
    """Return the variances of logs about their units and drives, shape (points, n)."""
    zeros = np.zeros(len(next(iter(variances.values()))))
    return np.asarray(variances.get(POWER_ONS, zeros)[:, None]
                      + variances.get(OWN_SHARE, zeros + 1.0)[:, None] * observed.deviation ** 2)


class PooledValue:
    """
    One value, pooled over the logs of a type.

    Estimates and p-values are of linear functions, which `estimate` and `p_value` take as:

    unit, drive : their numbers, -1 for none, shape (k,)
    fixed : weights of the fixed effects, shape (k, 1 + columns); by default the mean of the type
    part : of a unit: 0 for its value, from 1 on for a slope
    error : standard deviation that a log will state; its own share is added, shape (k,)
    more : name of a variance -> its multiple that is added, for quantities that are not estimated,
        such as the next power-on
    """

    def __init__(self, observed: Observations):
        """Pool; raise `DataRefused` where there are not more logs than fixed effects."""
        fixed = observed.fixed_effects
        if len(fixed) < fixed.shape[1] + 1:
            raise DataRefused(f'{len(fixed)} logs do not show how much a value varies; at '
                              f'least {fixed.shape[1] + 1} are needed')
        self.observed = observed
        self._median = float(np.median(observed.value))
        error = float(np.median(observed.deviation))
        self._value_scale = math.hypot(float(np.std(observed.value)), 1e-3 * error) or 1.0
        # columns of about one, so that the equations are well conditioned
        self._column_scales = np.maximum(np.abs(fixed).max(axis=0), 1e-300)
        self._fixed = fixed / self._column_scales
        # errors below 1e-5 of the spread of the values would make the equations ill-conditioned
        self._scaled = replace(
            observed, value=(observed.value - self._median) / self._value_scale,
            deviation=np.maximum(observed.deviation / self._value_scale, 1e-5),
            columns=self._fixed[:, 1:])

        # the variances that the logs distinguish
        logs = np.bincount(observed.unit)
        self.variance_names = names = [UNITS] if np.count_nonzero(logs) > 1 else []
        for name, column in zip(SLOPES, observed.columns.T[:observed.slope_count]):
            # a slope of its own needs three logs of a unit, at different values of the column
            unit_count = sum(len(np.unique(column[observed.unit == unit])) >= 3
                             for unit in range(len(logs)))
            names += [name] if unit_count > 1 else []
        if not names or logs.max() > 1:
            names.append(POWER_ONS)
        drives = observed.drive[observed.drive >= 0]
        if len(drives) and np.bincount(drives).max() > 1 and len(np.unique(drives)) > 1:
            names += [DRIVES, OWN_SHARE]

        # the ends of each coordinate: the logarithm of floor, and of floor plus largest
        square, self._bounds = float(np.median(self._scaled.deviation ** 2)), {}
        for name in names:
            groups = {POWER_ONS: len(fixed), DRIVES: len(np.unique(observed.drive))}.get(
                name, len(np.unique(observed.unit)))
            floor = max(square * groups / len(fixed), 1e-8)
            # the largest standard deviation is 30 times that of the values about their median
            self._bounds[name] = ((0.02, 1.0) if name == OWN_SHARE
                                  else (math.log(floor), math.log(floor + 30.0 ** 2)))
        self._equations = _Equations(self._scaled, self._fixed, DRIVES in names)
        self._best_point = self._find_best_point()
        self._sample_points, self._sample_weights = self._sample_variances()
        self._cached_solution: _Solution | None = None

    # the variances

    def _variances_at(self, points: Array) -> dict[str, Array]:
        """Return the variances at points: logarithms of variance plus a floor, and the share."""
        return {name: column if name == OWN_SHARE
                else np.maximum(np.exp(column) - math.exp(self._bounds[name][0]), 0.0)
                for name, column in zip(self.variance_names, points.T)}

    def _log_likelihood(self, points: Array, prior: bool = False) -> Array:
        """Return the restricted log-likelihoods at points, or with the log-prior added."""
        found = []
        for part in self._equations.split_points(len(points)):
            variances = self._variances_at(points[part])
            found.append(_Solution(self._equations, variances).log_likelihood)
            if prior:
                found[-1] = found[-1] + _log_prior(self._scaled, variances) + sum(
                    column for name, column in zip(self.variance_names, points[part].T)
                    if name != OWN_SHARE)
        return np.concatenate(found)

    def _find_best_point(self, excluded: str = '') -> Array:
        """Return the point of largest restricted likelihood, optionally without one variance."""
        bounds = [(self._bounds[name][0],) * 2 if name == excluded else self._bounds[name]
                  for name in self.variance_names]
        point = np.array([low + 0.3 * (high - low) for low, high in bounds])
        for place, (low, high) in enumerate(bounds):
            tried = _replace_coordinate(point, place, np.linspace(low, high, 15))
            point = tried[np.argmax(self._log_likelihood(tried))]

        def objective(point: Array) -> tuple[float, Array]:
            step = 1e-5
            found = -self._log_likelihood(np.vstack([point, point + step * np.eye(len(point))]))
            return float(found[0]), (found[1:] - found[0]) / step

        found = minimize(objective, point, method='L-BFGS-B', jac=True, bounds=bounds,
                         options={'maxiter': 60})
        # the gradient search often misses an optimum at the floor
        ends = [_replace_coordinate(found.x, place, np.array([low]))
                for place, (low, _) in enumerate(bounds)]
        tried = np.vstack([found.x, point, *ends])
        best: Array = tried[np.argmax(self._log_likelihood(tried))]
        return best

    def _sample_variances(self) -> tuple[Array, Array]:
        """Return points of the variances, shape (points, names), and their weights."""
        # Each coordinate is drawn by a slice through the likeliest point.
        uniform = qmc.Halton(len(self.variance_names), scramble=False).random(513)[1:]
        sample, log_density = np.empty_like(uniform), np.zeros(len(uniform))
        for place, name in enumerate(self.variance_names):
            axis = np.linspace(*self._bounds[name], 41)
            along = self._log_likelihood(_replace_coordinate(self._best_point, place, axis),
                                         prior=True)
            # wider than the slice, since the other variances are not known
            density = np.exp(0.6 * (along - along.max()))
            density = density + 0.1 * density.mean()
            cells = 0.5 * (density[1:] + density[:-1]) * np.diff(axis)
            total = np.concatenate([[0.0], np.cumsum(cells)])
            sample[:, place] = np.interp(uniform[:, place], total / total[-1], axis)
            cell = np.clip(np.searchsorted(axis, sample[:, place]) - 1, 0, len(cells) - 1)
            log_density += np.log(cells[cell])  # within a cell the points are uniform
        log_weight = self._log_likelihood(sample, prior=True) - log_density
        weight = np.exp(log_weight - log_weight.max())
        return sample, weight / weight.sum()

    @cached_property
    def components(self) -> dict[str, Interval]:
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
                values = self._value_scale * np.sqrt(values) * [
                    1.0, 2.0 * (without[0] - without[1]) > 3.841, 1.0]
            if name in SLOPES:
                values = values / self._column_scales[1 + SLOPES.index(name)]
            found[name] = Interval(*values.tolist())
        return found

    # estimates

    def _moments(self, unit: _IntegerArray | None = None, drive: _IntegerArray | None = None,
                 fixed: Array | None = None, part: int = 0, error: Array | float = 0.0,
                 **more: float) -> tuple[Array, Array]:
        """Return means and variances at each point, shape (points, k), in units of the values."""
        none = np.full(next((len(each) for each in (unit, drive, fixed) if each is not None), 1),
                       -1)
        if fixed is None:
            fixed = np.zeros((len(none), len(self._column_scales)))
            fixed[:, 0] = 1.0
        weights = np.eye(self._equations.parts)[part] / self._column_scales[part]
        parts = self._equations.split_points(len(self._sample_points))
        found = []
        for points in parts:
            variances = self._variances_at(self._sample_points[points])
            solved = self._cached_solution or _Solution(self._equations, variances)
            self._cached_solution = solved if len(parts) == 1 else None
            mean, variance = solved.moments(
                fixed / self._column_scales, none if unit is None else unit,
                none if drive is None else drive, weights)
            for name, count in more.items():
                variance = variance + count * variances.get(name, np.zeros(1))[:, None]
            own_share = variances.get(OWN_SHARE, np.ones(1))[:, None]
            found.append((mean, variance + own_share * (error / self._value_scale) ** 2))
        mean, variance = (np.concatenate(each) for each in zip(*found))
        return (self._median * fixed[:, 0] + self._value_scale * mean,
                self._value_scale ** 2 * np.maximum(variance, 1e-30))

    def estimate(self, **wanted: Any) -> Interval:
        """Return estimates with intervals that hold with 95 %."""
        mean, variance = self._moments(**wanted)
        value = self._sample_weights @ mean
        deviation = np.sqrt(self._sample_weights @ (variance + (mean - value) ** 2))
        # quantiles of the mixtures of normal distributions by bisection; the probability outside
        # of these ends is negligible
        bounds, spread = [], np.sqrt(variance)
        for chance in (0.025, 0.975):
            low, high = (mean - 40.0 * spread).min(axis=0), (mean + 40.0 * spread).max(axis=0)
            for _ in range(70):
                middle = 0.5 * (low + high)
                is_below = self._sample_weights @ ndtr((middle - mean) / spread) < chance
                low, high = np.where(is_below, middle, low), np.where(is_below, high, middle)
            bounds.append(0.5 * (low + high))
        return Interval(value, bounds[0], bounds[1], deviation)

    def p_value(self, **wanted: Any) -> Array:
        """Return the two-sided p-values of linear functions against 0, shape (k,)."""
        mean, variance = self._moments(**wanted)
        below = self._sample_weights @ ndtr(-mean / np.sqrt(variance))
        return np.minimum(2.0 * np.minimum(below, 1.0 - below), 1.0)

    def add_strongest(self, columns: Sequence[Array]) -> tuple[int, PooledValue, float, float]:
        """
        Add the most significant one of several fixed effects.

        Return its place, the value pooled with it, its size, and its p-value times the number of
        effects.
        """
        scores, none = [], np.array([-1])
        for column in columns:
            fixed = np.column_stack([self._fixed, column])
            equations = _Equations(self._scaled, fixed, DRIVES in self.variance_names)
            solved = _Solution(equations, self._variances_at(self._best_point[None]))
            mean, variance = solved.moments(np.eye(fixed.shape[1])[-1:], none, none,
                                            np.zeros(equations.parts))
            scores.append(abs(mean[0, 0]) / math.sqrt(variance[0, 0]))
        place = int(np.argmax(scores))
        effects = np.column_stack([self.observed.fixed_effects[:, 1:], columns[place]])
        extended = PooledValue(replace(self.observed, columns=effects))
        row = np.eye(len(extended._column_scales))[-1:]
        return (place, extended, float(extended.estimate(fixed=row).value[0]),
                min(float(extended.p_value(fixed=row)[0]) * len(columns), 1.0))


def _log_prior(observed: Observations, variances: Mapping[str, Array]) -> Array:
    """Return logarithms of Jeffreys' prior of the variances of groups, shape (points,)."""
    variance = _log_variances(observed, variances)
    weight, found = 1.0 / variance, np.zeros(len(variance))

    def add(name: str, mean: Array) -> None:
        """Add the log-prior of a variance in addition to that of the means of groups."""
        nonlocal found
        if name in variances:
            size = variances[name][:, None] if name != POWER_ONS else 0.0
            found = found + 0.5 * np.log(np.sum((size + mean) ** -2.0, axis=1))

    def sums(group: _IntegerArray, weights: Array) -> Array:
        matrix = _sum_matrix(np.maximum(group, 0), (group >= 0).astype(float), group.max() + 1)
        return np.asarray((matrix @ weights.T).T)

    add(POWER_ONS, variance)
    known = np.maximum(sums(observed.unit, weight), 1e-100)  # none of a unit without logs
    add(UNITS, 1.0 / known)
    for name, column in zip(SLOPES, observed.columns.T):
        first, second = (sums(observed.unit, weight * column ** power) for power in (1, 2))
        add(name, 1.0 / np.maximum(second - first ** 2 / known, 1e-12 * known))
    if DRIVES in variances:
        add(DRIVES, 1.0 / np.maximum(sums(observed.drive, weight), 1e-100))
    return found


def _replace_coordinate(point: Array, coordinate: int, values: Array) -> Array:
    """Return points that differ in one coordinate, shape (values, names)."""
    found = np.tile(point, (len(values), 1))
    found[:, coordinate] = values
    return found


@dataclass(frozen=True)
class Alarm:
    """An outlying unit or drive, or a unit whose value changed."""

    name: str  # of the unit or drive
    size: float  # of the difference from the prediction by the others, or of the change
    p_value: float  # of the largest of as many units, drives or possible changes
    since: str = ''  # first date after a change

    def to_dict(self) -> dict[str, Any]:
        size = {'since': self.since, 'size': self.size} if self.since else {'excess': self.size}
        return {'name': self.name, **size, 'chance': self.p_value}


def find_outlying_groups(pooled: PooledValue, kind: str, names: Sequence[str],
                         significance: float) -> list[Alarm]:
    """Return the outlying units or drives; the significance is the probability of a false one."""
    number = pooled.observed.unit if kind == UNITS else pooled.observed.drive
    groups = np.unique(number[number >= 0]).tolist()
    if len(groups) < 4 or len(number) < 5 or kind not in pooled.variance_names:
        return []
    found: list[Alarm] = []
    # Rosner's levels hold from 15 on
    for _ in range(min(len(groups) // 5, 10) if len(groups) >= 15 else 1):
        place, pooled, size, p_value = pooled.add_strongest([number == each for each in groups])
        found.append(Alarm(names[groups.pop(place)], size, p_value))
    last = max((place for place, each in enumerate(found, 1) if each.p_value < significance),
               default=0)
    return found[:last]


def find_changes(pooled: PooledValue, date: _IntegerArray, units: Sequence[str],
                 dates: Sequence[str], significance: float) -> list[Alarm]:
    """
    Return the most significant change of a unit between dates, beyond the scatter of power-ons.

    `date` is the number of the date of each log, or -1, shape (n,).
    """
    unit = pooled.observed.unit
    candidates = [(int(one), int(since)) for one in np.unique(unit)
                  for since in np.unique(date[(unit == one) & (date >= 0)])[1:]]
    if not candidates or POWER_ONS not in pooled.variance_names:
        return []
    place, _, size, p_value = pooled.add_strongest(
        [(unit == one) & (date >= since) for one, since in candidates])
    one, since = candidates[place]
    return [Alarm(units[one], size, p_value, dates[since])] if p_value < significance else []
