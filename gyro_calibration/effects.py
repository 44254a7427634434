"""
What stands between the true rate and the output of a gyro: the only place where an effect's formula stands.

Simulation, calibration and compensation meet here. Every effect adds ``sum(columns(channels, *shapes) * values)`` to the output.

"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gyro_calibration.log import DEGREE, Array, Number


@dataclass(frozen=True)
class Channels:
    """
    What an effect may look at, of one instant (numbers) or of many (arrays of shape (n,)).

    Attributes
    ----------
    rate : true rate, rad/s
    output : output of the gyro, rad/s
    temperature : degC

    """

    rate: Number
    output: Number
    temperature: Number


@dataclass(frozen=True)
class Parameter:
    """
    A coefficient or a shape parameter: its name, unit, the value taken where none is given, and its bounds.

    A shape with a default is a convention, such as a temperature to count from; one without is a property of the gyro, and is fitted.

    """

    name: str
    unit: str
    default: float | None = None
    bounds: tuple[float, float] = (-np.inf, np.inf)


@dataclass(frozen=True)
class Effect:
    """
    One effect.

    Attributes
    ----------
    name : as in the catalogue; files hold it
    cause : one sentence for people
    looks_at : the channels that it uses
    coefficients : what multiplies the columns
    columns : (channels, *shapes) -> one column a coefficient
    shapes : what the columns depend on, other than the channels
    shown_by : what to do so that data show it, apart from what looks like it
    nested : (channels, shapes, coefficients) -> the sum of the columns times the coefficients, where there is a shorter way to it

    """

    name: str
    cause: str
    looks_at: frozenset[str]
    coefficients: tuple[Parameter, ...]
    columns: Callable[..., Sequence[Number]]
    shapes: tuple[Parameter, ...] = ()
    shown_by: str = ''
    nested: Callable[[Channels, Sequence[float], Sequence[float]], Number] | None = None

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Shapes, then coefficients: the order of a term's values."""
        return self.shapes + self.coefficients

    def error(self, channels: Channels, values: Sequence[float]) -> Number:
        """Return what the effect adds to the output, rad/s, with these values of its parameters."""
        shapes, coefficients = values[:len(self.shapes)], values[len(self.shapes):]
        if self.nested is not None:
            return self.nested(channels, shapes, coefficients)
        return sum(value * column for value, column in zip(coefficients, self.columns(channels, *shapes)))


def _bias(channels: Channels) -> Sequence[Number]:
    return (np.ones_like(channels.rate),) if isinstance(channels.rate, np.ndarray) else (1.0,)


BIAS = Effect(
    'bias', 'The output is not zero at rest; it holds the Earth rate about the input axis.',
    frozenset(), (Parameter('bias', 'rad/s'),), _bias,
    shown_by='let the gyro rest')


def _scale_factor_error(channels: Channels) -> Sequence[Number]:
    return (channels.rate,)


SCALE_FACTOR_ERROR = Effect(
    'scale_factor_error', 'The output grows with the rate by another factor than the nominal one.',
    frozenset({'rate'}), (Parameter('scale_factor_error', '1'),), _scale_factor_error,
    shown_by='turn at several speeds, both ways')


def _sine_response(channels: Channels, k: float) -> Sequence[Number]:
    return (np.sin(k * channels.rate) / k - channels.rate,)


SCALE_FACTOR_ASYMMETRY = Effect(
    'scale_factor_asymmetry', 'The scale factor differs between the two senses of rotation.',
    frozenset({'rate'}), (Parameter('scale_factor_asymmetry', '1'),), lambda channels: (abs(channels.rate),),
    shown_by='turn both ways at many speeds, slow ones and rest too')


QUADRATIC_NONLINEARITY = Effect(
    'quadratic_nonlinearity', 'The output has a part that grows with the square of the rate.',
    frozenset({'rate'}), (Parameter('quadratic_nonlinearity', 's/rad'),), lambda channels: (channels.rate * channels.rate,),
    shown_by='turn both ways at many speeds up to full scale')


CUBIC_NONLINEARITY = Effect(
    'cubic_nonlinearity', 'The scale factor falls or grows with the square of the rate.',
    frozenset({'rate'}), (Parameter('cubic_nonlinearity', 's²/rad²'),),
    lambda channels: (channels.rate * channels.rate * channels.rate,), shown_by='turn at many speeds up to full scale')


SINE_RESPONSE = Effect(
    'sine_response', 'An open-loop fibre-optic gyro answers with the sine of its Sagnac phase.',
    frozenset({'rate'}), (Parameter('amplitude', '1', default=1.0),), _sine_response,
    (Parameter('k', 's', bounds=(1e-3, 30.0)),), 'turn at many speeds up to full scale')


#: From where the effects of temperature count, degC.
_REFERENCE_TEMPERATURE = Parameter('reference_temperature', 'degC', 25.0)


def _bias_temperature(channels: Channels, reference: float) -> Sequence[Number]:
    return (channels.temperature - reference + 0.0 * channels.rate,)


BIAS_TEMPERATURE = Effect(
    'bias_temperature', 'The bias changes in proportion to the temperature.',
    frozenset({'temperature'}), (Parameter('bias_temperature', 'rad/s/K'),), _bias_temperature, (_REFERENCE_TEMPERATURE,),
    'rest at two temperatures, and better go up and down again')


def _bias_temperature_quadratic(channels: Channels, reference: float) -> Sequence[Number]:
    return ((channels.temperature - reference) * (channels.temperature - reference) + 0.0 * channels.rate,)


BIAS_TEMPERATURE_QUADRATIC = Effect(
    'bias_temperature_quadratic', 'The bias is curved over temperature.',
    frozenset({'temperature'}), (Parameter('bias_temperature_quadratic', 'rad/s/K²'),), _bias_temperature_quadratic,
    (_REFERENCE_TEMPERATURE,), 'rest at three temperatures or more')


def _scale_factor_temperature(channels: Channels, reference: float) -> Sequence[Number]:
    return ((channels.temperature - reference) * channels.rate,)


SCALE_FACTOR_TEMPERATURE = Effect(
    'scale_factor_temperature', 'The scale factor changes in proportion to the temperature.',
    frozenset({'rate', 'temperature'}), (Parameter('scale_factor_temperature', '1/K'),), _scale_factor_temperature,
    (_REFERENCE_TEMPERATURE,), 'turn at two temperatures')


def rate_temperature_polynomial(rate_order: int, temperature_order: int) -> Effect:
    """
    Return the error polynomial over output and temperature of Ojeda, Chung and Borenstein (2000), eq. 9 to 13.

    The paper's error is a function of the output, so that one subtraction compensates (eq. 13). The powers are those of the centred and
    scaled output and temperature: raw powers have a condition number of 1e11. The coefficient ``t{j}w{i}`` belongs to power j of
    temperature and i of output. The index of eq. 10 as printed collides; here every product of powers has a column of its own.

    Parameters
    ----------
    rate_order, temperature_order : p and q of the paper, not negative

    """
    names = [f't{j}w{i}' for j in range(temperature_order + 1) for i in range(rate_order + 1)]

    def scaled(channels: Channels, output_centre: float, output_scale: float, temperature_centre: float,
               temperature_scale: float) -> tuple[Number, Number]:
        output = (channels.output - output_centre) / output_scale
        # Of order 0, it does not look at the temperature, which need not be known.
        return output, (channels.temperature - temperature_centre) / temperature_scale if temperature_order else 0.0 * output

    def columns(channels: Channels, *shapes: float) -> Sequence[Number]:
        output, temperature = scaled(channels, *shapes)
        outputs = _powers(output, rate_order)
        return [of_temperature * of_output for of_temperature in _powers(temperature, temperature_order) for of_output in outputs]

    def nested(channels: Channels, shapes: Sequence[float], coefficients: Sequence[float]) -> Number:
        output, temperature = scaled(channels, *shapes)
        width = rate_order + 1
        return _horner([_horner(coefficients[begin:begin + width], output) for begin in range(0, len(coefficients), width)], temperature)

    return Effect(
        'rate_temperature_polynomial', 'The scale factor is not linear, and bias and scale factor change with temperature.',
        frozenset({'output', 'temperature'} if temperature_order else {'output'}),
        tuple(Parameter(name, 'rad/s') for name in names), columns,
        (Parameter('output_centre', 'rad/s', 0.0), Parameter('output_scale', 'rad/s', 1.0, (1e-9, np.inf)),
         Parameter('temperature_centre', 'degC', 0.0), Parameter('temperature_scale', 'K', 1.0, (1e-9, np.inf))),
        'turn at more rates, at more temperatures, or take lower orders', nested)


def _powers(value: Number, order: int) -> list[Number]:
    powers = [value * 0.0 + 1.0]
    for _ in range(order):
        powers.append(powers[-1] * value)
    return powers


def _horner(coefficients: Sequence[Number], value: Number) -> Number:
    """Return the sum of coefficients times `_powers`, by Horner's rule and in place: one new array, whatever the order."""
    if len(coefficients) == 1:
        return coefficients[0] * (value * 0.0 + 1.0)
    total = coefficients[-1] * value
    total += coefficients[-2]
    for coefficient in coefficients[-3::-1]:
        total *= value
        total += coefficient
    return total


CATALOGUE = {effect.name: effect for effect in (
    BIAS, SCALE_FACTOR_ERROR, SCALE_FACTOR_ASYMMETRY, QUADRATIC_NONLINEARITY, CUBIC_NONLINEARITY, SINE_RESPONSE,
    BIAS_TEMPERATURE, BIAS_TEMPERATURE_QUADRATIC, SCALE_FACTOR_TEMPERATURE)}


def polynomial_from_matrix(matrix: Any) -> tuple[Effect, tuple[float, ...]]:
    """
    Read the matrix C of eq. 11 of Ojeda et al.

    Parameters
    ----------
    matrix : shape (q + 1, p + 1), for deg/s and degC, highest powers first: ``error = [T² T 1] C [w³ w² w 1]'`` (eq. 12)

    Returns
    -------
    the effect, and the values of its parameters in SI

    Raises
    ------
    ValueError : not a matrix of finite numbers

    """
    try:
        c = np.array(matrix, dtype=float)
    except (TypeError, ValueError, OverflowError):
        c = np.empty(0)
    if c.ndim != 2 or not c.size or not (np.abs(c) <= 1e100).all():
        raise ValueError('matrix_dps must be rows of finite numbers of one length, highest powers first, as eq. 11 of Ojeda et al.')
    rows, columns = c.shape
    in_si = c[::-1, ::-1] * DEGREE ** (1.0 - np.arange(columns))
    return rate_temperature_polynomial(columns - 1, rows - 1), (0.0, 1.0, 0.0, 1.0, *in_si.ravel().tolist())


def polynomial_to_matrix(effect: Effect, values: Sequence[float]) -> Array:
    """
    Write the matrix C of eq. 11 of Ojeda et al. out of a polynomial's values (the inverse of `polynomial_from_matrix`).

    Returns
    -------
    array of shape (q + 1, p + 1), for deg/s and degC, highest powers first

    """
    output_centre, output_scale, temperature_centre, temperature_scale = values[:4]
    rows = 1 + max(int(parameter.name[1:].split('w')[0]) for parameter in effect.coefficients)
    c = np.reshape(values[4:], (rows, -1))
    raw = _raw_powers(temperature_centre, temperature_scale, rows).T @ c @ _raw_powers(output_centre, output_scale, c.shape[1])
    return (raw * DEGREE ** (np.arange(c.shape[1]) - 1.0))[::-1, ::-1]


def _raw_powers(centre: float, scale: float, count: int) -> Array:
    """Return the matrix whose row i holds the raw coefficients of ``((x - centre) / scale)**i``, lowest power first."""
    rows = np.zeros((count, count))
    for power in range(count):
        polynomial = np.polynomial.Polynomial([-centre / scale, 1 / scale]) ** power
        rows[power, :power + 1] = polynomial.coef
    return rows
