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

Numbers = NDArray[np.intp]
#: The estimated standard deviations, and the share of the stated variance that is independent
#: between logs.
UNITS, DRIVES, POWER_ONS, OWN = 'units', 'drives', 'power_ons', 'own_share'
#: Standard deviations of the slopes of units over the first column and the second.
SLOPES = ('slopes_0', 'slopes_1')
#: Minimum number of logs of a unit, at different values of a column, for a slope of its own.
_FEWEST = 3
#: Points of the sequence over the variances, and of a slice through the likeliest point.
_POINTS, _SLICE = 512, 41
#: Largest possible standard deviation, in standard deviations of the values about their median.
_LARGEST = 30.0


@dataclass(frozen=True)
class Observed:
    """
    One value over the logs of a type.

    Attributes
    ----------
    value, deviation : in one unit, shape (n,)
    unit : number of the unit of each log, from 0 on, shape (n,)
    drive : number of the drive, from 0 on, or -1 where a log stands alone, shape (n,)
    columns : fixed effects in addition to the mean, such as age, shape (n, k)
    slopes : the number of the first columns whose effect may differ from unit to unit, at most 2

    """

    value: Array
    deviation: Array
    unit: Numbers
    drive: Numbers
    columns: Array = field(default_factory=lambda: np.empty((0, 0)))
    slopes: int = 0

    def __len__(self) -> int:
        return len(self.value)

    @property
    def fixed(self) -> Array:
        """Return the columns with that of the mean, shape (n, 1 + k)."""
        more = self.columns if self.columns.size else np.empty((len(self), 0))
        return np.column_stack([np.ones(len(self)), more])

    def with_column(self, column: Array) -> Observed:
        """Return the same with one more fixed effect."""
        return replace(self, columns=np.column_stack([self.fixed[:, 1:], column]))


@dataclass(frozen=True)
class Wanted:
    """
    Linear functions of the estimates: of fixed effects, one unit and one drive each.

    Attributes
    ----------
    fixed : shape (k, 1 + columns)
    unit, drive : numbers, -1 for none, shape (k,)
    error : standard deviation that a log will state; its own share is added, shape (k,)
    of_unit : weights of the value of the unit and of its slopes, shape (1 + slopes,)
    more : name of a variance -> its multiple that is added, for quantities that are not estimated,
        such as the next power-on

    """

    fixed: Array
    unit: Numbers
    drive: Numbers
    error: Array
    of_unit: Array
    more: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Interval:
    """Estimates with standard deviations and bounds, each of shape (k,), or numbers."""

    value: Array
    deviation: Array
    low: Array
    high: Array


class _Equations:
    """The mixed-model equations, at many points of the variances at a time."""

    def __init__(self, of: Observed, fixed: Array, shared: bool):
        """Lay out the columns: fixed effects, then drives."""
        self.of, self.fixed = of, fixed
        self.units = int(of.unit.max()) + 1
        self.drives = int(of.drive.max()) + 1 if shared else 0
        self.columns = fixed.shape[1] + self.drives
        #: the columns of the value of a unit, and of its slopes
        self.of_unit = fixed[:, :1 + of.slopes]
        self.to_unit = _summing(of.unit)
        if self.drives:
            on = np.flatnonzero(of.drive >= 0)
            self.on, self.to_drive = on, _summing(of.drive[on])
            pairs, place = np.unique(of.unit[on] * self.drives + of.drive[on],
                                     return_inverse=True)
            self.to_pair = _summing(place)
            self.pair_unit, self.pair_drive = np.divmod(pairs, self.drives)

    def chunks(self, points: int) -> list[slice]:
        """Divide the points into parts that are solved together, which bounds the memory."""
        size = (self.units * self.columns * (1 + self.of.slopes) + self.columns ** 2
                + len(self.of))
        step = max(2_000_000 // size, 1)
        return [slice(begin, begin + step) for begin in range(0, points, step)]


def _summing(group: Numbers) -> Any:
    """Return the matrix that sums over the members of each group."""
    return csr_array((np.ones(len(group)), (group, np.arange(len(group)))))


class _Solved:
    """Solutions for variances of shape (points,), which is the first axis of all arrays."""

    def __init__(self, at: _Equations, sizes: Mapping[str, Array]):
        of, fixed, count = at.of, at.fixed, len(next(iter(sizes.values())))
        none = np.zeros(count)
        own = sizes.get(OWN, none + 1.0)
        self._at = at
        tau = np.sqrt(np.column_stack([sizes.get(name, none)
                                       for name in (UNITS, *SLOPES[:of.slopes])]))
        self._tau = tau
        self._scale = np.sqrt(sizes.get(DRIVES, none))[:, None]
        variance = (sizes.get(POWER_ONS, none)[:, None] + own[:, None] * of.deviation ** 2)
        weight = 1.0 / variance

        def summed(matrix: Any, values: Array) -> Array:
            return np.asarray((matrix @ values.T).T)

        kept, total = fixed.shape[1], at.columns
        normal, right = np.zeros((count, total, total)), np.zeros((count, total))
        parts = at.of_unit.shape[1]
        alone = np.empty((count, at.units, parts))
        across = np.zeros((count, at.units, parts, total))
        normal[:, :kept, :kept] = np.einsum('pn,na,nb->pab', weight, fixed, fixed, optimize=True)
        right[:, :kept] = weight @ (of.value[:, None] * fixed)
        for part, column in enumerate(at.of_unit.T):
            alone[:, :, part] = summed(at.to_unit, weight * column * of.value)
            for place in range(kept):
                across[:, :, part, place] = summed(at.to_unit, weight * column * fixed[:, place])
        if at.drives:
            here, index = weight[:, at.on], kept + np.arange(at.drives)
            right[:, index] = self._scale * summed(at.to_drive, here * of.value[at.on])
            for part, column in enumerate(at.of_unit[at.on].T):
                across[:, at.pair_unit, part, index[at.pair_drive]] = self._scale * summed(
                    at.to_pair, here * column)
            for place in range(kept):
                normal[:, place, index] = self._scale * summed(
                    at.to_drive, here * fixed[at.on, place])
                normal[:, index, place] = normal[:, place, index]
            normal[:, index, index] = self._scale ** 2 * summed(at.to_drive, here)
            normal[:, range(kept, total), range(kept, total)] += 1.0
        # the columns of a unit are the first fixed effects
        precision = (np.eye(parts) + tau[:, None, :, None] * tau[:, None, None, :]
                     * across[:, :, :, :parts])
        self._within = np.linalg.inv(precision)
        self._across = tau[:, None, :, None] * across
        self._right = tau[:, None] * alone
        lighter = self._within @ self._across
        rows = count, at.units * parts
        triangle = np.linalg.cholesky(
            normal - np.swapaxes(lighter.reshape(*rows, total), 1, 2)
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

    def moments(self, wanted: Wanted) -> tuple[Array, Array]:
        """Return means and variances of linear functions, shape (points, k)."""
        at, kept = self._at, self._at.fixed.shape[1]
        rows = np.zeros((len(self._tau), len(wanted.unit), at.columns))
        rows[:, :, :kept] = wanted.fixed
        if at.drives:
            on = np.flatnonzero(wanted.drive >= 0)
            rows[:, on, kept + wanted.drive[on]] = self._scale
        unit = np.maximum(wanted.unit, 0)
        size = self._tau[:, None] * (wanted.of_unit * (wanted.unit >= 0)[:, None])
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


class Pooled:
    """
    One value, pooled over the logs of a type.

    Attributes
    ----------
    observed : the values
    names : of the variances that the logs distinguish
    likeliest : name -> variance (of `OWN`, a share) at the largest restricted likelihood

    """

    def __init__(self, observed: Observed):
        """Pool; raise `DataRefused` where there are not more logs than fixed effects."""
        fixed = observed.fixed
        if len(observed) < fixed.shape[1] + 1:
            raise DataRefused(f'{len(observed)} logs do not show how much a value varies; at '
                              f'least {fixed.shape[1] + 1} are needed')
        self.observed = observed
        self._middle = float(np.median(observed.value))
        error = float(np.median(observed.deviation))
        self._size = math.hypot(float(np.std(observed.value)), 1e-3 * error) or 1.0
        # columns of about one, so that the equations are well conditioned
        self._scales = np.maximum(np.abs(fixed).max(axis=0), 1e-300)
        self._fixed = fixed / self._scales
        # errors below 1e-5 of the spread of the values would make the equations ill-conditioned
        self._scaled = replace(
            observed, value=(observed.value - self._middle) / self._size,
            deviation=np.maximum(observed.deviation / self._size, 1e-5),
            columns=self._fixed[:, 1:])
        self.names = _distinguishable(observed)
        self._bounds = _bounds(self._scaled, self.names)
        self._equations = _Equations(self._scaled, self._fixed, DRIVES in self.names)
        self._best = self._search()
        self.likeliest = {name: float(value[0]) * (1.0 if name == OWN else self._size ** 2)
                          for name, value in self._sizes(self._best[None]).items()
                          if name in self.names}
        self._sample, self._weight = self._integrated()
        self._kept: _Solved | None = None

    # the variances

    def _sizes(self, points: Array) -> dict[str, Array]:
        """Return the variances at points: logarithms of variance plus a floor, and the share."""
        found = {name: column if name == OWN
                 else np.maximum(np.exp(column) - math.exp(self._bounds[name][0]), 0.0)
                 for name, column in zip(self.names, points.T)}
        return found or {POWER_ONS: np.zeros(len(points))}

    def _log_likelihood(self, points: Array, prior: bool = False) -> Array:
        """Return the restricted log-likelihoods at points, or with the log-prior added."""
        found = []
        for part in self._equations.chunks(len(points)):
            sizes = self._sizes(points[part])
            found.append(_Solved(self._equations, sizes).log_likelihood)
            if prior:
                found[-1] = found[-1] + _log_prior(self._equations, sizes) + sum(
                    column for name, column in zip(self.names, points[part].T) if name != OWN)
        return np.concatenate(found)

    def _search(self, without: str = '') -> Array:
        """Return the point of largest restricted likelihood, optionally without one variance."""
        if not self.names:
            return np.empty(0)
        bounds = [(self._bounds[name][0],) * 2 if name == without else self._bounds[name]
                  for name in self.names]
        point = np.array([low + 0.3 * (high - low) for low, high in bounds])
        for place, (low, high) in enumerate(bounds):
            if high > low:
                tried = _moved(point, place, np.linspace(low, high, 15))
                point = tried[np.argmax(self._log_likelihood(tried))]
        found = minimize(self._downhill, point, method='L-BFGS-B', jac=True, bounds=bounds,
                         options={'maxiter': 60})
        # the gradient search often misses an optimum at the floor
        ends = [_moved(found.x, place, np.array([low])) for place, (low, _) in enumerate(bounds)]
        tried = np.vstack([found.x, point, *ends])
        best: Array = tried[np.argmax(self._log_likelihood(tried))]
        return best

    def _downhill(self, point: Array) -> tuple[float, Array]:
        """Return minus the restricted likelihood and its slope."""
        step = 1e-5
        found = -self._log_likelihood(np.vstack([point, point + step * np.eye(len(point))]))
        return float(found[0]), (found[1:] - found[0]) / step

    def _integrated(self) -> tuple[Array, Array]:
        """Return points of the variances, shape (points, names), and their weights."""
        if not self.names:
            return np.empty((1, 0)), np.ones(1)
        uniform = qmc.Halton(len(self.names), scramble=False).random(_POINTS + 1)[1:]
        sample, log_density = np.empty_like(uniform), np.zeros(_POINTS)
        for place, name in enumerate(self.names):
            axis = np.linspace(*self._bounds[name], _SLICE)
            along = self._log_likelihood(_moved(self._best, place, axis), prior=True)
            # wider than the slice, since the other variances are not known
            density = np.exp(0.6 * (along - along.max()))
            density = density + 0.1 * density.mean()
            cells = 0.5 * (density[1:] + density[:-1]) * np.diff(axis)
            total = np.concatenate([[0.0], np.cumsum(cells)])
            sample[:, place] = np.interp(uniform[:, place], total / total[-1], axis)
            cell = np.clip(np.searchsorted(axis, sample[:, place]) - 1, 0, _SLICE - 2)
            log_density += np.log(cells[cell])  # within a cell the points are uniform
        log_weight = self._log_likelihood(sample, prior=True) - log_density
        weight = np.exp(log_weight - log_weight.max())
        return sample, weight / weight.sum()

    @cached_property
    def components(self) -> dict[str, Component]:
        """Return the standard deviations by name, and the independent share of the errors."""
        found, likeliest, sample = {}, self._sizes(self._best[None]), self._sizes(self._sample)
        for name in self.names:
            order = np.argsort(sample[name])
            total = np.cumsum(self._weight[order]) - 0.5 * self._weight[order]
            bounds = np.interp([0.025, 0.975], total, sample[name][order])
            values = np.array([likeliest[name][0], *bounds])
            if name != OWN:
                without = self._log_likelihood(np.vstack([self._best, self._search(name)]))
                # a variance of zero is rejected at 2.5 %, one-sided; half of the probability is at
                # zero (Self and Liang 1987)
                values = np.sqrt(values) * [1.0, 2.0 * (without[0] - without[1]) > 3.841, 1.0]
            size = (1.0 if name == OWN else self._size / self._scales[1 + SLOPES.index(name)]
                    if name in SLOPES else self._size)
            found[name] = Component(*(size * values).tolist())
        return found

    # estimates

    def _moments(self, wanted: Wanted) -> tuple[Array, Array]:
        """Return means and variances at each point, shape (points, k), in units of the values."""
        scaled = replace(wanted, fixed=wanted.fixed / self._scales,
                         of_unit=wanted.of_unit / self._scales[:1 + self.observed.slopes],
                         error=wanted.error / self._size)
        found = []
        for sizes, solved in self._solutions():
            mean, variance = solved.moments(scaled)
            for name, often in wanted.more.items():
                variance = variance + often * sizes.get(name, np.zeros(1))[:, None]
            own = sizes.get(OWN, np.ones(1))[:, None]
            found.append((mean, variance + own * scaled.error ** 2))
        mean, variance = (np.concatenate(each) for each in zip(*found))
        constant = self._middle * wanted.fixed[:, 0]
        return constant + self._size * mean, self._size ** 2 * np.maximum(variance, 1e-30)

    def _solutions(self) -> Iterator[tuple[Mapping[str, Array], _Solved]]:
        """Give variances and solutions at the points; a solution of all points is kept."""
        parts = self._equations.chunks(len(self._sample))
        for part in parts:
            sizes = self._sizes(self._sample[part])
            if len(parts) > 1:
                yield sizes, _Solved(self._equations, sizes)
                continue
            self._kept = self._kept or _Solved(self._equations, sizes)
            yield sizes, self._kept

    def estimate(self, wanted: Wanted) -> Interval:
        """Return estimates with intervals that hold with 95 %."""
        mean, variance = self._moments(wanted)
        value = self._weight @ mean
        deviation = np.sqrt(self._weight @ (variance + (mean - value) ** 2))
        low, high = (_quantile(mean, variance, self._weight, chance)
                     for chance in (0.025, 0.975))
        return Interval(value, deviation, low, high)

    def chance(self, wanted: Wanted) -> Array:
        """Return the two-sided p-values of linear functions against 0, shape (k,)."""
        mean, variance = self._moments(wanted)
        below = self._weight @ ndtr(-mean / np.sqrt(variance))
        return np.minimum(2.0 * np.minimum(below, 1.0 - below), 1.0)

    def wanted(self, unit: Numbers | None = None, drive: Numbers | None = None,
               fixed: Array | None = None, error: Array | float = 0.0,
               part: int = 0, **more: float) -> Wanted:
        """
        Return linear functions; by default the mean of the type, or of units and drives.

        Parameters
        ----------
        unit, drive, fixed, error, more : as of `Wanted`
        part : of a unit: 0 for its value, from 1 on for a slope

        """
        count = next((len(each) for each in (unit, drive, fixed) if each is not None), 1)
        none = np.full(count, -1)
        row = np.zeros((count, self._fixed.shape[1]))
        row[:, 0] = 1.0
        return Wanted(row if fixed is None else fixed, none if unit is None else unit,
                      none if drive is None else drive,
                      np.broadcast_to(np.asarray(error, float), (count,)),
                      np.eye(1 + self.observed.slopes)[part], more)

    def score(self, column: Array) -> float:
        """Return the approximate z-score of one more fixed effect."""
        fixed = np.column_stack([self._fixed, column])
        sizes = self._sizes(self._best[None])
        solved = _Solved(_Equations(self._scaled, fixed, DRIVES in self.names), sizes)
        row = np.zeros((1, fixed.shape[1]))
        row[0, -1] = 1.0
        mean, variance = solved.moments(self.wanted(fixed=row))
        return float(mean[0, 0] / math.sqrt(variance[0, 0]))

    def standing(self, kind: str) -> Array:
        """Return the approximate z-score of each unit or drive against the others."""
        number = self.observed.unit if kind == UNITS else self.observed.drive
        sizes = self._sizes(self._best[None])
        size = np.maximum(sizes.get(kind, np.zeros(1)), 1e-4)
        groups = np.arange(number.max() + 1)
        rows = np.zeros((len(groups), self._fixed.shape[1]))
        wanted = (self.wanted(unit=groups, fixed=rows) if kind == UNITS
                  else self.wanted(drive=groups, fixed=rows))
        mean, variance = _Solved(self._equations, {**sizes, kind: size}).moments(wanted)
        known = np.maximum(size - variance[0], 1e-12 * size)
        return np.asarray(mean[0] / np.sqrt(known))


def _distinguishable(of: Observed) -> list[str]:
    """Return the variances that the logs distinguish."""
    logs = np.bincount(of.unit)
    names = [UNITS] if len(logs) > 1 else []
    for name, column in zip(SLOPES, of.columns.T[:of.slopes]):
        many = sum(len(np.unique(column[of.unit == unit])) >= _FEWEST for unit in range(len(logs)))
        names += [name] if many > 1 else []
    if len(logs) == 1 or logs.max() > 1:
        names.append(POWER_ONS)
    on = of.drive[of.drive >= 0]
    if len(on) and np.bincount(on).max() > 1 and len(np.unique(on)) > 1:
        names += [DRIVES, OWN]
    return names


def _bounds(of: Observed, names: list[str]) -> dict[str, tuple[float, float]]:
    """Return the ends of each coordinate: the logarithm of floor, and of floor plus largest."""
    square = float(np.median(of.deviation ** 2))
    floors = {**dict.fromkeys((UNITS, *SLOPES), square * len(np.unique(of.unit)) / len(of)),
              DRIVES: square * len(np.unique(of.drive)) / len(of), POWER_ONS: square}
    found = {}
    for name in names:
        floor = max(floors.get(name, 0.0), 1e-8)
        found[name] = ((0.02, 1.0) if name == OWN
                       else (math.log(floor), math.log(floor + _LARGEST ** 2)))
    return found


def _log_prior(at: _Equations, sizes: Mapping[str, Array]) -> Array:
    """Return logarithms of Jeffreys' prior of the variances of groups, shape (points,)."""
    of, found = at.of, np.zeros(len(next(iter(sizes.values()))))
    own = sizes.get(OWN, found + 1.0)[:, None]
    variance = sizes.get(POWER_ONS, found)[:, None] + own * of.deviation ** 2

    def jeffreys(name: str, mean: Array) -> Array:
        """Return the log-prior of a variance in addition to that of the means of groups."""
        size = sizes[name][:, None]
        return np.asarray(0.5 * np.log(np.sum((size + mean) ** -2.0, axis=1)))

    if POWER_ONS in sizes:
        found = found + 0.5 * np.log(np.sum(variance ** -2.0, axis=1))
    known = np.maximum((at.to_unit @ (1.0 / variance).T).T, 1e-100)  # none of a unit without logs
    if UNITS in sizes:
        found = found + jeffreys(UNITS, 1.0 / known)
    for name, column in zip(SLOPES, of.columns.T):
        if name in sizes:
            first, second = ((at.to_unit @ (column ** power / variance).T).T for power in (1, 2))
            found = found + jeffreys(name, 1.0 / np.maximum(second - first ** 2 / known,
                                                            1e-12 * known))
    if DRIVES in sizes:
        found = found + jeffreys(DRIVES, 1.0 / (at.to_drive @ (1.0 / variance[:, at.on]).T).T)
    return found


def _moved(point: Array, place: int, values: Array) -> Array:
    """Return points that differ in one coordinate, shape (values, names)."""
    found = np.tile(point, (len(values), 1))
    found[:, place] = values
    return found


def _quantile(mean: Array, variance: Array, weight: Array, chance: float) -> Array:
    """Return quantiles of mixtures of normal distributions, shape (k,), by bisection."""
    deviation = np.sqrt(variance)
    # the probability of a mixture outside of this is negligible
    low, high = (mean - 40.0 * deviation).min(axis=0), (mean + 40.0 * deviation).max(axis=0)
    for _ in range(70):
        middle = 0.5 * (low + high)
        below = weight @ ndtr((middle - mean) / deviation) < chance
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return np.asarray(0.5 * (low + high))


#: Minimum number of units or drives for a test of outliers.
FEWEST = 4


@dataclass(frozen=True)
class Outlier:
    """
    An outlying unit or drive.

    Attributes
    ----------
    number : of the unit or drive
    excess : difference from the prediction by the others, in the unit of the value
    chance : p-value of the largest difference of as many units or drives

    """

    number: int
    excess: float
    chance: float


def outliers(observed: Observed, kind: str, level: float, pooled: Pooled | None = None
             ) -> list[Outlier]:
    """
    Return the outlying units or drives.

    Parameters
    ----------
    observed : one value over the logs of a type
    kind : `pooling.UNITS` or `pooling.DRIVES`
    level : probability of an outlier where there is none
    pooled : the value, where it is pooled already

    """
    number = observed.unit if kind == UNITS else observed.drive
    groups = np.unique(number[number >= 0])
    if len(groups) < FEWEST or len(observed) < FEWEST + 1:
        return []
    # Rosner's levels hold from 15 on
    most = min(len(groups) // 5, 10) if len(groups) >= 15 else 1
    found: list[Outlier] = []
    without: Observed = observed
    pooled = pooled or Pooled(observed)
    for _ in range(most):
        if kind not in pooled.names:
            break
        standing = np.abs(pooled.standing(kind))[groups]
        standing[np.isin(groups, [each.number for each in found])] = 0.0
        worst = int(groups[np.argmax(standing)])
        without = without.with_column((number == worst).astype(float))
        pooled = Pooled(without)
        excess, chance = _last(pooled)
        found.append(Outlier(worst, excess, min(chance * (len(groups) - len(found)), 1.0)))
    last = max((place for place, each in enumerate(found, 1) if each.chance < level), default=0)
    return found[:last]


@dataclass(frozen=True)
class Change:
    """
    A unit whose value changes at some date.

    Attributes
    ----------
    unit : its number
    since : number of the first date after the change
    size : of the change, in the unit of the value
    chance : p-value of the largest of as many possible changes

    """

    unit: int
    since: int
    size: float
    chance: float


def changes(observed: Observed, date: Numbers, level: float, pooled: Pooled | None = None
            ) -> list[Change]:
    """
    Return the most significant change of a unit between dates, beyond the scatter of power-ons.

    Parameters
    ----------
    observed : one value over the logs of a type
    date : number of the date of each log, in their order, or -1, shape (n,)
    level : probability of a change where there is none
    pooled : the value, where it is pooled already

    """
    pooled = pooled or Pooled(observed)
    if POWER_ONS not in pooled.names:
        return []
    candidates = [(int(unit), int(since)) for unit in np.unique(observed.unit)
                  for since in np.unique(date[(observed.unit == unit) & (date >= 0)])[1:]]
    if not candidates:
        return []
    columns = [((observed.unit == unit) & (date >= since)).astype(float)
               for unit, since in candidates]
    place = int(np.argmax([abs(pooled.score(column)) for column in columns]))
    size, chance = _last(Pooled(observed.with_column(columns[place])))
    chance = min(chance * len(candidates), 1.0)
    return [Change(*candidates[place], size, chance)] if chance < level else []


def _last(pooled: Pooled) -> tuple[float, float]:
    """Return the last fixed effect and its p-value."""
    row: Array = np.zeros((1, pooled.observed.fixed.shape[1]))
    row[0, -1] = 1.0
    wanted = pooled.wanted(fixed=row)
    return float(pooled.estimate(wanted).value[0]), float(pooled.chance(wanted)[0])
