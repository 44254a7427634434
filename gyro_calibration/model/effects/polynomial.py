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
The error polynomial over output and temperature, and its matrix in the form of the paper.

The polynomial is one of the output, not of the true rate: Ojeda, Chung and Borenstein regress the
error on the output, so that compensation is one subtraction (their eq. 13). Its powers are centred
and scaled, since the condition number of raw powers of deg/s and degC is about 1e11.

"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from gyro_calibration.logs.log import Array, DEGREE, Number
from gyro_calibration.model.effects.effect import Channels, Effect, Parameter
import numpy as np


def rate_temperature_polynomial(rate_order: int, temperature_order: int) -> Effect:
    """
    Return the error polynomial of Ojeda, Chung and Borenstein (2000), eq. 9 to 13.

    The coefficient ``t{j}w{i}`` belongs to power j of temperature and i of output. The index of
    eq. 10 as printed collides; here every product of powers has its own column.

    Parameters
    ----------
    rate_order, temperature_order : p and q of the paper, not negative

    """
    names = [f't{j}w{i}' for j in range(temperature_order + 1) for i in range(rate_order + 1)]

    def scale_inputs(channels: Channels, output_centre: float, output_scale: float,
                     temperature_centre: float, temperature_scale: float) -> tuple[Number, Number]:
        output = channels.output - output_centre
        output /= output_scale
        if not temperature_order:  # the temperature may be unknown
            return output, 0.0 * output
        temperature = channels.temperature - temperature_centre
        temperature /= temperature_scale
        return output, temperature

    def columns(channels: Channels, *shapes: float) -> Sequence[Number]:
        output, temperature = scale_inputs(channels, *shapes)
        outputs = _powers(output, rate_order)
        return [of_temperature * of_output
                for of_temperature in _powers(temperature, temperature_order)
                for of_output in outputs]

    def sum_columns(channels: Channels, shapes: Sequence[float],
                    coefficients: Sequence[float]) -> Number:
        output, temperature = scale_inputs(channels, *shapes)
        width = rate_order + 1
        inner = [_evaluate_horner(coefficients[begin:begin + width], output)
                 for begin in range(0, len(coefficients), width)]
        return _evaluate_horner(inner, temperature)

    return Effect(
        'rate_temperature_polynomial',
        'The scale factor is not linear, and bias and scale factor change with temperature.',
        frozenset({'output', 'temperature'} if temperature_order else {'output'}),
        tuple(Parameter(name, 'rad/s') for name in names), columns,
        (Parameter('output_centre', 'rad/s', 0.0),
         Parameter('output_scale', 'rad/s', 1.0, (1e-9, np.inf)),
         Parameter('temperature_centre', 'degC', 0.0),
         Parameter('temperature_scale', 'K', 1.0, (1e-9, np.inf))),
        'turn at more rates, at more temperatures, or take lower orders', sum_columns)


def _powers(value: Number, order: int) -> list[Number]:
    powers = [value * 0.0 + 1.0]
    for _ in range(order):
        powers.append(powers[-1] * value)
    return powers


def _evaluate_horner(coefficients: Sequence[Number], value: Number) -> Number:
    """Return the sum of coefficients times `_powers`, by Horner's rule, with one new array."""
    if len(coefficients) == 1:
        return coefficients[0] * (value * 0.0 + 1.0)
    total = coefficients[-1] * value
    total += coefficients[-2]
    for coefficient in coefficients[-3::-1]:
        total *= value
        total += coefficient
    return total


def polynomial_from_matrix(matrix: Any) -> tuple[Effect, tuple[float, ...]]:
    """
    Read the matrix C of eq. 11 of Ojeda et al.

    Parameters
    ----------
    matrix : shape (q + 1, p + 1), for deg/s and degC, highest powers first:
        ``error = [T² T 1] C [w³ w² w 1]'`` (eq. 12)

    Returns
    -------
    the effect, and the values of its parameters in SI

    """
    c = np.array(matrix, dtype=float)
    rows, columns = c.shape
    in_si = c[::-1, ::-1] * DEGREE ** (1.0 - np.arange(columns))
    effect = rate_temperature_polynomial(columns - 1, rows - 1)
    return effect, (0.0, 1.0, 0.0, 1.0, *in_si.ravel().tolist())


def polynomial_to_matrix(effect: Effect, values: Sequence[float]) -> Array:
    """Return the matrix C of eq. 11 of Ojeda et al.: the inverse of `polynomial_from_matrix`."""
    output_centre, output_scale, temperature_centre, temperature_scale = values[:4]
    rows = 1 + max(int(parameter.name[1:].split('w')[0]) for parameter in effect.coefficients)
    c = np.reshape(values[4:], (rows, -1))
    columns = c.shape[1]
    of_temperature = _raw_power_coefficients(temperature_centre, temperature_scale, rows)
    raw = of_temperature.T @ c @ _raw_power_coefficients(output_centre, output_scale, columns)
    return (raw * DEGREE ** (np.arange(columns) - 1.0))[::-1, ::-1]


def _raw_power_coefficients(centre: float, scale: float, count: int) -> Array:
    """Return rows i of the coefficients of ``((x - centre) / scale)**i``, lowest power first."""
    rows = np.zeros((count, count))
    for power in range(count):
        polynomial = np.polynomial.Polynomial([-centre / scale, 1 / scale]) ** power
        rows[power, :power + 1] = polynomial.coef
    return rows
