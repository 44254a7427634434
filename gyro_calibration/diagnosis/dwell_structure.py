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
What no cause explains in the errors of dwells: curves, and errors that repeat at single rates.

The curves are over rate, temperature, their product, the order of dwells, and within sweeps. What
the dwells of a sweep share, a bias and a scale factor that wander, is scatter and no structure.
The size of the scatter is not known either; so each chance is averaged over what it may be, as the
intervals of a calibration are.

"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from gyro_calibration.calibration.dwells import Dwells, take
from gyro_calibration.calibration.rate_table import Calibration, columns_of
from gyro_calibration.calibration.scatter import (
    parts_of,
    SMALLEST_TEMPERATURE_SPREAD,
    Uncertainty,
    Whitener,
)
from gyro_calibration.diagnosis.findings import Unexplained
from gyro_calibration.logs.log import Array
import numpy as np
from scipy.interpolate import BSpline
from scipy.stats import f as fisher

#: So many columns a curve has at most.
_MOST_COLUMNS = 9
#: Fewer dwells than this for each column do not tell a curve from chance.
_DWELLS_A_COLUMN = 4
#: What of a curve the model explains already to this part of its length is not tried again.
_NEW = 1e-3
RATE, TEMPERATURE, PRODUCT, ORDER, SWEEP = (
    'rate', 'temperature', 'rate_times_temperature', 'order_of_dwells', 'sweep')
SINGLE_RATES = 'single_rates'
#: A rate that is repeated in so many sweeps may show an error of its own.
_REPEATED = 4


@dataclass(frozen=True)
class Left:
    """
    Structure without a name.

    Attributes
    ----------
    found : where it lies, the clearest first
    misfit : by what each lowers the sum of the whitened squared residuals

    """

    found: tuple[Unexplained, ...]
    misfit: Mapping[str, float]


def what_is_left(fit: Calibration, level: float, doubt: Array) -> Left:
    """
    Look for structure in what a fit leaves.

    Parameters
    ----------
    fit : of dwells
    level : the chance to find any where there is none
    doubt : what deviations of the model's values add to each dwell, rad/s, shape (n, m): that is
        no structure

    """
    used = take(fit.dwells, fit.scatter.kept)
    probes = {name: columns for name, columns in _probes(used).items() if columns.shape[1]}
    known, error = columns_of(used, fit.terms), fit.residual[fit.scatter.kept]
    found, gains, tried = [], {}, len(probes)
    while probes:
        judged = [_judged(name, fit, known, columns, error, doubt)
                  for name, columns in probes.items()]
        best, gain = min(judged, key=lambda each: (each[0].p_value, -each[1]))
        chance = min(1.0, tried * best.p_value)
        if chance >= level:
            break
        found.append(replace(best, p_value=chance))
        gains[best.along] = gain
        known = np.column_stack([known, probes.pop(best.along)])
    return Left(tuple(found), gains)


def _judged(name: str, fit: Calibration, known: Array, columns: Array, error: Array,
            doubt: Array) -> tuple[Unexplained, float]:
    """Return what a curve explains beside what is known, its chance, and the misfit it saves."""
    used = take(fit.dwells, fit.scatter.kept)
    whitener = Whitener(used, fit.scatter)
    base = _orthonormal(whitener.whiten(known))
    white = whitener.whiten(error)
    white = white - base @ (base.T @ white)
    new = _beside(base, whitener.whiten(columns))
    count, freedom = new.shape[1], len(used) - base.shape[1] - new.shape[1]
    if not count or freedom < 3:
        return Unexplained(name, 0.0, 1.0), 0.0
    gain, total = float(np.sum((new.T @ white) ** 2)), float(white @ white)
    share = 1.0 - (total - gain) / freedom / (total / (freedom + count))
    # Columns in their own unit, for the covariance of the dwells may be another one.
    plain = [np.apply_along_axis(whitener.restore, 0, each) for each in (base, new)]
    chance = _chance(Uncertainty.of(used, fit.scatter, np.column_stack(plain), error),
                     new.T @ whitener.whiten(doubt))
    return Unexplained(name, min(max(share, 0.0), 1.0), chance), gain


def _chance(uncertainty: Uncertainty, doubt: Array) -> float:
    """Return how likely the last values are all doubt, by an F test averaged over the scatter."""
    count = len(doubt)
    values, covariances = (uncertainty.offsets[:, -count:],
                           uncertainty.covariances[:, -count:, -count:] + doubt @ doubt.T)
    squares = np.einsum('ki,ki->k', values,
                        np.linalg.solve(covariances, values[:, :, None])[:, :, 0])
    return float(uncertainty.weights @ fisher.sf(squares / count, count, uncertainty.freedom))


def _orthonormal(columns: Array) -> Array:
    left, sizes, _ = np.linalg.svd(columns / np.linalg.norm(columns, axis=0), full_matrices=False)
    return left[:, sizes > 1e-6 * sizes[0]]


def _beside(base: Array, columns: Array) -> Array:
    """Return orthonormal columns for what is new in some beside others."""
    columns = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    left, sizes, _ = np.linalg.svd(columns - base @ (base.T @ columns), full_matrices=False)
    return left[:, sizes > _NEW]


# the curves

def _probes(dwells: Dwells) -> Mapping[str, Array]:
    """Return the columns of each curve, shape (n, m)."""
    sweeps = len(np.unique(parts_of(dwells)))
    # What differs between sweeps alone has no more evidence than there are sweeps.
    slow = min(_MOST_COLUMNS, sweeps // 3)
    probes = {RATE: _spline(dwells.rate, min(_MOST_COLUMNS, len(dwells) // _DWELLS_A_COLUMN)),
              SINGLE_RATES: _by_rate(dwells),
              ORDER: _spline(np.arange(len(dwells)).astype(float), slow),
              SWEEP: _by_sweep(dwells)}
    if (dwells.temperature is not None
            and np.ptp(dwells.temperature) >= SMALLEST_TEMPERATURE_SPREAD):
        probes[TEMPERATURE] = _spline(dwells.temperature, slow)
        rate, temperature = _scaled(dwells.rate), _scaled(dwells.temperature)
        probes[PRODUCT] = np.column_stack([rate ** i * temperature ** j
                                           for i in (1, 2, 3) for j in range(1, min(slow, 2) + 1)]
                                          or [np.zeros((len(dwells), 0))])
    return probes


def _scaled(values: Array) -> Array:
    """Return values from -1 to 1."""
    low, high = float(values.min()), float(values.max())
    return (2.0 * values - low - high) / max(high - low, 1e-300)


def _spline(values: Array, most: int) -> Array:
    """Return a cubic spline over values, or fewer powers where they are few, shape (n, m)."""
    count = min(most, len(np.unique(np.round(_scaled(values), 3))) - 1)
    if count < 4:
        return _scaled(values)[:, None] ** np.arange(1, max(count, 0) + 1)
    inner = np.quantile(values, np.linspace(0.0, 1.0, count - 1))
    knots = np.concatenate([[inner[0]] * 3, np.unique(inner), [inner[-1]] * 3])
    return BSpline.design_matrix(values, knots, 3).toarray()


def _by_rate(dwells: Dwells) -> Array:
    """Return a column for each rate that several sweeps repeat, shape (n, rates)."""
    _, number = np.unique(np.round(_scaled(dwells.rate), 4), return_inverse=True)
    columns = (number[:, None] == np.arange(number.max() + 1)).astype(float)
    parts = parts_of(dwells)
    repeated = np.array([len(np.unique(parts[column > 0.0])) >= _REPEATED for column in columns.T])
    return (columns[:, repeated] if np.count_nonzero(repeated) * _DWELLS_A_COLUMN <= len(dwells)
            else columns[:, :0])


def _by_sweep(dwells: Dwells) -> Array:
    """Return a parabola over rate per sweep, which no bias or scale makes, shape (n, sweeps)."""
    parts = parts_of(dwells)
    if len(dwells) < 8 * (parts.max() + 1):
        return np.zeros((len(dwells), 0))
    return (parts[:, None] == np.arange(parts.max() + 1)) * (_scaled(dwells.rate) ** 2)[:, None]
