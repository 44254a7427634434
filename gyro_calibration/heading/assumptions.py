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
Assumptions for uncalibrated values, and for temperatures without data.

The variance of the tracker contains only the errors that it is given. So it is given standard
deviations for all: scale factor error and bias of a model without a covariance, and the change of
the bias from the temperature of the calibration to the present temperature.

"""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass, replace
import math

from gyro_calibration.heading.bias_table import BiasTable
from gyro_calibration.logs.log import Array, DEGREE, Number
from gyro_calibration.model.compensation import uncertainty_covariance
from gyro_calibration.model.gyro_model import GyroModel, SelfCalibration, with_self_calibration
import numpy as np

#: Step of the temperatures for which the change of the bias is computed, K; linear between them.
_TEMPERATURE_STEP = 0.5


@dataclass(frozen=True)
class Assumptions:
    """
    Standard deviations of unknown values.

    Attributes
    ----------
    bias : of an uncalibrated gyro, rad/s
    scale_factor_error : of an uncalibrated gyro, 1
    bias_temperature_coefficient : rad/s/K; 0 for a gyro with temperature compensation

    """

    bias: float = 0.5 * DEGREE
    scale_factor_error: float = 0.03
    bias_temperature_coefficient: float = 0.03 * DEGREE

    @property
    def covariance(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return that of (s, b)."""
        return (self.scale_factor_error ** 2, 0.0), (0.0, self.bias ** 2)


def with_assumed_covariance(model: GyroModel, assumptions: Assumptions) -> GyroModel:
    """Return the model with an assumed covariance in its self-calibration if it has none."""
    calibration = model.self_calibration
    if calibration is None:
        return (model if model.covariance is not None else with_self_calibration(
            model, SelfCalibration(covariance=assumptions.covariance)))
    if calibration.covariance is not None and np.isfinite(calibration.covariance).all():
        return model
    return with_self_calibration(model, replace(calibration, covariance=assumptions.covariance))


def uncertain_covariance(model: GyroModel, assumptions: Assumptions) -> Array:
    """
    Return the covariance of a model's uncertain values, after `with_assumed_covariance`, (m, m).

    With a self-calibration, the temperature coefficient is before its s and b, which are the last
    two; without one, it is the last. `uncertain_sensitivity` has the same order.

    """
    values = uncertainty_covariance(model)
    place = _coefficient_index(model, len(values))
    whole = np.insert(np.insert(values, place, 0.0, axis=0), place, 0.0, axis=1)
    whole[place, place] = assumptions.bias_temperature_coefficient ** 2
    return whole


def uncertain_sensitivity(model: GyroModel, sensitivity: Array,
                          temperature_distance: Number) -> Array:
    """
    Return the sensitivity of the rate to each value of `uncertain_covariance`, shape (m, ...).

    Parameters
    ----------
    sensitivity : `compensation.rate_sensitivity` of the same model, shape (m - 1, ...)
    temperature_distance : of the temperature from that at which the bias is known, K, a number or
        shape (...)

    """
    place = _coefficient_index(model, len(sensitivity))
    whole = np.empty((len(sensitivity) + 1, *sensitivity.shape[1:]))
    whole[:place], whole[place + 1:] = sensitivity[:place], sensitivity[place:]
    whole[place] = -temperature_distance
    return whole


def _coefficient_index(model: GyroModel, value_count: int) -> int:
    return value_count if model.self_calibration is None else value_count - 2


class TemperatureCorrection:
    """
    Change of the bias from one temperature to others, by a copy of a bias table.

    Later entries of the table come from rests that the tracker has used itself. So they are not
    used here until the tracker is restarted.

    """

    def __init__(self, table: BiasTable, begin: float, now: float, coefficient: float):
        """
        Begin at a temperature, degC.

        Parameters
        ----------
        now : s since 1970
        coefficient : standard deviation in which distances are counted, rad/s/K; above 0

        """
        self._table, self.start_temperature, self._now = deepcopy(table), begin, now
        self._coefficient = coefficient
        self._known_steps: dict[int, tuple[float, float]] = {0: (0.0, 0.0)}

    def change_at(self, temperature: float) -> tuple[float, float]:
        """Return the change of the bias, rad/s, and the signed distance, K of the coefficient."""
        steps = (temperature - self.start_temperature) / _TEMPERATURE_STEP
        below = math.floor(steps)
        (first, near), (last, far) = self._change_at_step(below), self._change_at_step(below + 1)
        part = steps - below
        return first + part * (last - first), near + part * (far - near)

    def changes_at(self, temperature: Array) -> tuple[Array, Array]:
        """Return the same as `change_at` for several temperatures, shape (n,) each."""
        steps = (temperature - self.start_temperature) / _TEMPERATURE_STEP
        below = np.floor(steps).astype(int)
        known, places = np.unique(below, return_inverse=True)
        near, far = (np.array([self._change_at_step(int(step) + ahead) for step in known])[places]
                     for ahead in (0, 1))
        change, distance = (near + (steps - below)[:, None] * (far - near)).T
        return change, distance

    def _change_at_step(self, step: int) -> tuple[float, float]:
        if step not in self._known_steps:
            change, variance = self._table.bias_difference(
                self.start_temperature, self.start_temperature + step * _TEMPERATURE_STEP,
                self._now)
            self._known_steps[step] = (
                change, math.copysign(math.sqrt(variance), step) / self._coefficient)
        return self._known_steps[step]
