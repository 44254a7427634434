# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Compensation: from the output of a gyro to the rate, the same for one sample and a whole log."""

from dataclasses import dataclass
import math
import sys

from gyro_calibration.logs.log import CACHE_BLOCK_SAMPLES, Number
from gyro_calibration.model.channels import clip
from gyro_calibration.model.effects import Channels
from gyro_calibration.model.gyro_model import GyroModel
import numpy as np
from scipy.linalg import block_diag

#: Rates beyond this, rad/s, are treated as overflow: the model's values are too large.
_MAX_COMPUTABLE_RATE = math.sqrt(sys.float_info.max)


@dataclass(frozen=True)
class CompensatedSamples:
    """Compensated samples: numbers, or arrays of shape (n,)."""

    model_rate: Number  # after the model, before the self-calibration, rad/s
    rate: Number  # rad/s
    temperature: Number  # degC, limited to plausible temperatures
    # outside the calibrated temperatures; beyond `GyroModel.extrapolation_range` the correction is
    # held, up to it extrapolated
    temperature_clipped: Number
    # outside the calibrated rates, or no rate has the output; beyond `GyroModel.rate_limit`, or at
    # a fold of the response, the correction is held, up to it extrapolated
    beyond_range: Number


def compensate(model: GyroModel, output: Number, temperature: Number | None = None,
               environment: Channels | None = None) -> CompensatedSamples:
    """
    Compensate by model (Ojeda et al., eq. 13), then self-calibration (Hong and Park, eq. 3).

    Output, rad/s, and temperature, degC, are numbers or have shape (n,); no temperature is the
    reference temperature. A model that `needs_history` needs the environment of its history.
    """
    given = model.reference_temperature if temperature is None else temperature
    if not isinstance(output, np.ndarray) or environment is not None:
        return _compensate_at_once(model, output, given, environment)
    modelled, clipped, beyond = (
        np.empty(len(output)), np.zeros(len(output), bool), np.zeros(len(output), bool))
    rate = modelled if model.self_calibration is None else np.empty(len(output))
    for begin in range(0, len(output), CACHE_BLOCK_SAMPLES):
        block = slice(begin, begin + CACHE_BLOCK_SAMPLES)
        part = _compensate_at_once(
            model, output[block], given[block] if isinstance(given, np.ndarray) else given)
        modelled[block] = part.model_rate
        if part.temperature_clipped is not False:
            clipped[block] = part.temperature_clipped
        if part.beyond_range is not False:
            beyond[block] = part.beyond_range
        if rate is not modelled:
            rate[block] = part.rate
    plausible = clip(given, *model.temperature_limits) if clipped.any() else given
    return CompensatedSamples(modelled, rate, plausible, clipped, beyond)


def _compensate_at_once(model: GyroModel, output: Number, temperature: Number,
                        environment: Channels | None = None) -> CompensatedSamples:
    (slowest, fastest), limit = model.rate_range, model.rate_limit
    # no masks are made where the extremes show that all samples are inside
    beyond = _mask_outside(output, max(slowest, -limit), min(fastest, limit))
    seen = output if beyond is False else clip(output, -limit, limit)
    clipped, used, plausible = (_mask_outside(temperature, *model.valid_temperatures), temperature,
                                temperature)
    if clipped is not False:
        used, plausible = (clip(temperature, *ends)
                           for ends in (model.extrapolation_range, model.temperature_limits))
    with np.errstate(all='ignore'):
        modelled, unexplained = model.rate_from_channels(
            Channels(seen, seen, used) if environment is None
            else environment.with_rate(seen, seen))
        if _mask_outside(modelled, -_MAX_COMPUTABLE_RATE, _MAX_COMPUTABLE_RATE) is not False:
            computed = abs(modelled) < _MAX_COMPUTABLE_RATE
            replaced: Number = np.where(computed, modelled, seen)
            modelled = replaced[()]
            unexplained = unexplained | np.logical_not(computed)
    rate = modelled if model.self_calibration is None else model.self_calibration.correct(modelled)
    if seen is not output:
        modelled, rate = modelled + (output - seen), rate + (output - seen)
    return CompensatedSamples(modelled, rate, plausible, clipped,
                              beyond if unexplained is False else beyond | unexplained)


def _mask_outside(values: Number, low: float, high: float) -> Number:
    """Return which values are outside of bounds; False where none is."""
    if not isinstance(values, np.ndarray):
        return not low <= values <= high
    if len(values) and low <= values.min() and values.max() <= high:
        return False
    return (values < low) | (values > high)


def rate_sensitivity(model: GyroModel, output: Number, rate: Number, temperature: Number,
                     environment: Channels | None = None) -> np.ndarray:
    """
    Return the derivative of the rate by each uncertain value of the model, shape (m, ...).

    First the fitted values of the model, if it has a covariance, then the
    `GyroModel.active_tolerances`, then (s, b) of the self-calibration. Effects that compensation
    cannot undo have a derivative of 0.
    """
    calibration, rows = model.self_calibration, []
    if model.covariance is not None or model.active_tolerances:
        modelled = rate if calibration is None else (rate - calibration.offset) / calibration.scale
        channels = (Channels(modelled, output, clip(temperature, *model.extrapolation_range))
                    if environment is None else environment.with_rate(modelled, output))
        steepness = model.output_slope(channels)
        if model.covariance is not None:
            rows = [0.0 if term.effect.not_compensated else row / steepness
                    for term in model.terms for row in term.sensitivity(channels)]
        if model.active_tolerances:
            # out of the calibrated ranges, which include the temperature of the self-calibration
            known = [] if calibration is None or calibration.temperature is None else [
                calibration.temperature]
            ends = (*model.valid_temperatures, *known)
            faster = output - clip(output, *model.rate_range)
            warmer = temperature - clip(temperature, min(ends), max(ends))
            sizes = {'bias': 1.0, 'scale_factor_error': modelled, 'bias_per_kelvin': warmer,
                     'scale_factor_error_per_kelvin': warmer * modelled, 'per_rate': faster}
            rows += [sizes[name] / steepness for name in model.active_tolerances]
    if calibration is not None:
        rows += [rate, 1.0]
    factor = -1.0 if calibration is None else -calibration.scale
    shape = np.shape(rate)
    return factor * np.array([np.broadcast_to(row, shape) for row in rows],
                             dtype=float).reshape(len(rows), *shape)


def uncertainty_covariance(model: GyroModel) -> np.ndarray:
    """Return the covariance of the values of `rate_sensitivity`, shape (m, m); nan if unknown."""
    blocks = [] if model.covariance is None else [model.covariance]
    blocks += [np.diag([getattr(model.tolerance, name) ** 2]) for name in model.active_tolerances]
    if model.self_calibration is not None:
        known = model.self_calibration.covariance
        blocks.append(np.full((2, 2), np.nan) if known is None else np.array(known))
    return block_diag(*blocks) if blocks else np.zeros((0, 0))


def quadratic_form(matrix: np.ndarray, vectors: np.ndarray) -> Number:
    """Return v' M v for vectors of shape (m, ...)."""
    return (vectors * (matrix @ vectors)).sum(axis=0)
