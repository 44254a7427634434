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
Error of a calibrated rate in another run, at other temperatures and at other rates.

The covariance of the values states how well the dwells determine them, if the model is complete
and the gyro does not change. Bias and scale factor change from sweep to sweep, and by as much
after the calibration. Outside of the calibrated temperatures and rates, effects that were not
fitted add errors: slopes and curvatures over temperature, and another nonlinearity. Their size
follows from a larger fit, with normal priors for the values that the dwells do not determine.

"""

from __future__ import annotations

from collections.abc import Callable, Sequence
import math

from gyro_calibration.calibration.dwells import Dwells
from gyro_calibration.calibration.scatter import SMALLEST_TEMPERATURE_SPREAD, Whitener
from gyro_calibration.heading.bias_table import Prior
from gyro_calibration.logs.log import Array
from gyro_calibration.model.gyro_model import Tolerance
import numpy as np

#: Standard deviations between gyros, by data sheets: the change of the bias with temperature,
#: rad/s/K (L3G4200D: 0.03 deg/s/K), that of the scale factor, 1/K (L3G4200D: 2 % over 60 K), and
#: the nonlinearity at the fastest rate that is not fitted, 1 (L3G4200D: 0.2 %).
BIAS_SLOPE, SCALE_SLOPE, NONLINEARITY = Prior().coefficient, 3e-4, 2e-3

#: dwells at rates, rad/s, and temperatures, degC -> change of the output for each value, (n, m)
Columns = Callable[[Array, Array], Array]


def tolerance_of(dwells: Dwells, whitener: Whitener, sweeps: Array, columns: Columns,
                 covariance: Array) -> Tolerance:
    """
    Return the error of a rate that the covariance of the values does not contain.

    Effects that were not fitted may exist below the noise: a fit with more columns has a larger
    variance than that of the values. Its mean over the dwells is added to the variance of the
    bias; its value half a width outside of the calibrated range gives the slopes.

    Parameters
    ----------
    dwells : that were fitted
    whitener : of their scatter
    sweeps : scatter of bias and scale factor from sweep to sweep, rad/s and 1, shape (2,)
    columns : of the values
    covariance : of the values, shape (m, m)

    """
    fastest = max(float(np.abs(dwells.rate).max()), 1e-9)
    known = dwells.temperature is not None
    temperature = (np.asarray(dwells.temperature) if known else np.zeros(len(dwells)))
    low, high = float(temperature.min()), float(temperature.max())
    middle = 0.5 * (low + high)
    half = max(0.5 * (high - low), 0.5 * SMALLEST_TEMPERATURE_SPREAD)

    first = 0 if known else 4

    def larger(rate: Array, warm: Array) -> Array:
        return np.column_stack([columns(rate, warm),
                                _more(rate / fastest, warm - middle)[:, first:]])

    spread = np.array([*[math.inf] * len(covariance), *_priors(fastest)[first:]])
    white = whitener.whiten(larger(dwells.rate, temperature))
    lengths = np.linalg.norm(white, axis=0)
    lengths = np.where(lengths > 0.0, lengths, 1.0)
    gram = (white / lengths).T @ (white / lengths) + np.diag((spread * lengths) ** -2.0)
    inverse = np.linalg.pinv(gram, hermitian=True)

    def more(rate: Array, warm: Array) -> Array:
        """Return the variance of the larger fit less that of the values, (rad/s)²."""
        wide, row = larger(rate, warm) / lengths, columns(rate, warm)
        return np.maximum(((wide @ inverse) * wide).sum(axis=1)
                          - ((row @ covariance) * row).sum(axis=1), 0.0)

    ends, sides = np.array([low - half, high + half]), np.array([-1.0, 1.0])
    at_rest = more(np.zeros(2), ends).max()
    turning = more(fastest * np.repeat(sides, 2), np.tile(ends, 2)).max()
    faster = more(1.5 * fastest * sides, np.full(2, middle)).max()
    unfitted = more(dwells.rate, temperature).mean()
    return Tolerance(math.sqrt(sweeps[0] ** 2 + unfitted), float(sweeps[1]),
                     math.sqrt(at_rest) / half,
                     math.sqrt(max(turning - at_rest, 0.0)) / half / fastest,
                     math.sqrt(faster) / (0.5 * fastest))


def _more(speed: Array, warmer: Array) -> Array:
    """Return slopes and curves over temperature, and powers of the rate, shape (n, 6)."""
    return np.column_stack([warmer, warmer ** 2, warmer * speed, warmer ** 2 * speed, speed ** 2,
                            speed ** 3])


def _priors(fastest: float) -> Sequence[float]:
    """Return the standard deviations of the coefficients of `_more`."""
    curve = 0.5 / Prior().length  # a slope changes by its own size over this length
    return (BIAS_SLOPE, BIAS_SLOPE * curve, SCALE_SLOPE * fastest, SCALE_SLOPE * fastest * curve,
            *[NONLINEARITY * fastest] * 2)
