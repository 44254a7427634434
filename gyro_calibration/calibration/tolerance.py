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

from collections.abc import Callable
import math

from gyro_calibration.calibration.dwells import Dwells
from gyro_calibration.calibration.scatter import MIN_TEMPERATURE_SPREAD, Whitener
from gyro_calibration.heading.bias_table import Prior
from gyro_calibration.logs.log import Array
from gyro_calibration.model.gyro_model import Tolerance
import numpy as np

#: Standard deviations between gyros, by data sheets: the change of the bias with temperature,
#: rad/s/K (L3G4200D: 0.03 deg/s/K), that of the scale factor, 1/K (L3G4200D: 2 % over 60 K), and
#: the nonlinearity at the fastest rate that is not fitted, 1 (L3G4200D: 0.2 %).
BIAS_SLOPE_DEVIATION, SCALE_SLOPE_DEVIATION, NONLINEARITY_DEVIATION = (
    Prior().coefficient, 3e-4, 2e-3)


def estimate_tolerance(dwells: Dwells, whitener: Whitener, sweep_scatter: Array,
                       columns: Callable[[Array, Array], Array], covariance: Array) -> Tolerance:
    """
    Return the error of a rate that the covariance of the values does not contain.

    Effects that were not fitted may exist below the noise: a fit with more columns has a larger
    variance than that of the values. Its mean over the dwells is added to the variance of the
    bias; its value half a width outside of the calibrated range gives the slopes.

    Parameters
    ----------
    dwells : that were fitted
    whitener : of their scatter
    sweep_scatter : scatter of bias and scale factor from sweep to sweep, rad/s and 1, shape (2,)
    columns : of rates, rad/s, and temperatures, degC: change of the output for each value, (n, m)
    covariance : of the values, shape (m, m)

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
        SCALE_SLOPE_DEVIATION * fastest * curve, *[NONLINEARITY_DEVIATION * fastest] * 2]
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
