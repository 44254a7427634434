"""A gyro's model: its effects with their values, how well they are known, and the last self-calibration; to and from YAML."""

from __future__ import annotations

import math
import reprlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from gyro_calibration.effects import CATALOGUE, Channels, Effect, Number, polynomial_from_matrix, rate_temperature_polynomial
from gyro_calibration.files import write_atomically
from gyro_calibration.log import DEGREE, Array
from gyro_calibration.noise import Noise

FORMAT = 'gyro_calibration/model'
VERSION = 1
POLYNOMIAL = 'rate_temperature_polynomial'


class ModelError(ValueError):
    """A file is not a model; the message names file, place and remedy."""


@dataclass(frozen=True)
class Term:
    """One effect of a model with the values of its parameters, shapes first."""

    effect: Effect
    values: tuple[float, ...]

    def columns(self, channels: Channels) -> Sequence[Number]:
        """Return one column a coefficient."""
        return self.effect.columns(channels, *self.values[:len(self.effect.shapes)])

    def error(self, channels: Channels) -> Number:
        """Return what the effect adds to the output, rad/s."""
        coefficients = self.values[len(self.effect.shapes):]
        return sum(value * column for value, column in zip(coefficients, self.columns(channels)))


@dataclass(frozen=True)
class SelfCalibration:
    """
    Scale factor error s and bias b that a run found behind the model (Hong and Park, eq. 1 to 3).

    Attributes
    ----------
    scale_factor_error : s, 1
    bias : b, rad/s
    covariance : of (s, b), shape (2, 2)
    time : when, ISO 8601
    temperature : at which, degC; None where it was not known
    method : likelihood, heading, rate or rest

    """

    scale_factor_error: float = 0.0
    bias: float = 0.0
    covariance: tuple[tuple[float, float], tuple[float, float]] = ((0.0, 0.0), (0.0, 0.0))
    time: str = ''
    temperature: float | None = None
    method: str = ''

    @property
    def scale(self) -> float:
        """Return s̄ = 1 / (1 + s) of eq. 3."""
        return 1.0 / (1.0 + self.scale_factor_error)

    @property
    def offset(self) -> float:
        """Return b̄ = -b / (1 + s) of eq. 3, rad/s."""
        return -self.bias * self.scale

    @property
    def standard_deviations(self) -> tuple[float, float]:
        """Return those of s and b, 1 and rad/s."""
        return math.sqrt(self.covariance[0][0]), math.sqrt(self.covariance[1][1])

    def correct(self, rate: Number) -> Number:
        """Return the rate, rad/s, from one that the model has compensated (eq. 3)."""
        return self.scale * rate + self.offset

    def figures(self) -> dict[str, Any]:
        """Return what there is to know, by name, in SI."""
        scale_deviation, bias_deviation = self.standard_deviations
        return {'scale_factor_error': self.scale_factor_error, 'scale_factor_error_standard_deviation': scale_deviation,
                'bias': self.bias, 'bias_standard_deviation': bias_deviation, 's_bar': self.scale, 'b_bar': self.offset,
                'calibration_time': self.time, 'calibration_temperature': self.temperature, 'method': self.method}

    def __str__(self) -> str:
        """Return a sentence for people."""
        scale_deviation, bias_deviation = self.standard_deviations
        temperature = '' if self.temperature is None else f' at {self.temperature:.1f} degC'
        return (f'scale factor error {100 * self.scale_factor_error:.3f} +- {100 * scale_deviation:.3f} %, '
                f'bias {self.bias / DEGREE:.4f} +- {bias_deviation / DEGREE:.4f} deg/s '
                f'(s_bar {self.scale:.6f}, b_bar {self.offset:.6f} rad/s){temperature}')


@dataclass(frozen=True)
class GyroModel:
    """
    What is known of one gyro.

    Attributes
    ----------
    terms : its effects
    covariance : of all coefficients in the order of the terms, shape (m, m), or None where it is not known
    rate_range, temperature_range : what the values were fitted on, rad/s and degC
    noise : its noise figures
    gyro : name, serial_number, technology, as text
    origin : files, date and program that it comes from
    self_calibration : the last one

    """

    terms: tuple[Term, ...] = ()
    covariance: Array | None = None
    rate_range: tuple[float, float] = (-math.inf, math.inf)
    temperature_range: tuple[float, float] = (-math.inf, math.inf)
    reference_temperature: float = 25.0
    noise: Noise = Noise()
    gyro: Mapping[str, str] = field(default_factory=dict)
    origin: Mapping[str, Any] = field(default_factory=dict)
    self_calibration: SelfCalibration | None = None

    def error(self, channels: Channels) -> Number:
        """Return the sum of all effects, rad/s."""
        return _sum(self.terms, channels)

    def looks_at(self, channel: str) -> bool:
        """Tell whether an effect uses the channel."""
        return any(channel in term.effect.looks_at for term in self.terms)

    def output(self, rate: Number, temperature: Number) -> Number:
        """Return the output, rad/s, that solves ``output = rate + error(rate, output, temperature)``; without noise."""
        known, sought = self._split('output')
        given = rate + _sum(known, Channels(rate, rate, temperature))
        return _solve(lambda output: given + _sum(sought, Channels(rate, output, temperature)), rate, bool(sought))

    def rate(self, output: Number, temperature: Number) -> Number:
        """Return the rate, rad/s, that solves ``rate = output - error(rate, output, temperature)``."""
        known, sought = self._split('rate')
        given = output - _sum(known, Channels(output, output, temperature))
        return _solve(lambda rate: given - _sum(sought, Channels(rate, output, temperature)), output, bool(sought))

    def _split(self, channel: str) -> tuple[list[Term], list[Term]]:
        """Return the effects that do not look at a channel, which need no repetition to solve for it, and those that do."""
        known = [term for term in self.terms if channel not in term.effect.looks_at]
        return known, [term for term in self.terms if channel in term.effect.looks_at]


def _sum(terms: Sequence[Term], channels: Channels) -> Number:
    return sum(term.error(channels) for term in terms)


def _solve(g: Callable[[Number], Number], start: Number, implicit: bool) -> Number:
    """
    Solve x = g(x) for a slope of g well below one.

    The plain repetition wins a factor of the slope a pass; along the secant each pass wins more than the one before, and a slope that is
    constant is solved at once. The number of passes is fixed, so that a sample and a whole log take the same steps.

    """
    a, b = start, g(start)
    if not implicit:
        return b
    g_a = b
    for _ in range(6):
        g_b = g(b)
        step = b - a
        slope = (g_b - g_a) / (step + (step == 0.0))
        slope = slope * (abs(slope) < 0.9)
        a, g_a, b = b, g_b, b + (g_b - b) / (1.0 - slope)
    return b


def read_model(path: str | Path) -> GyroModel:
    """
    Read a model file.

    Raises
    ------
    ModelError : missing, empty, truncated, of a newer version, or no model; names file, place and remedy

    """
    try:
        content = yaml.safe_load(Path(path).read_text(encoding='utf-8'))
    except FileNotFoundError:
        raise ModelError(f'{path}: there is no such file; calibrate first, or name another model file') from None
    except (OSError, ValueError, RecursionError, yaml.YAMLError) as error:
        place = f'line {error.problem_mark.line + 1}: ' if getattr(error, 'problem_mark', None) else ''
        raise ModelError(f'{path}: {place}cannot be read as YAML; restore the file or calibrate again') from error
    try:
        return _from_content(content)
    except _PlaceError as error:
        raise ModelError(f'{path}: {error}') from None


_SHORT = reprlib.Repr()  # a few lines of YAML can unfold to gigabytes
_SHORT.maxlevel = 3


class _PlaceError(ValueError):
    def __init__(self, place: str, given: Any, wanted: str):
        super().__init__(f'{place} is {_SHORT.repr(given)}; wanted {wanted}')


def _from_content(content: Any) -> GyroModel:
    top = _mapping('the file', content)
    if top.get('format', FORMAT) != FORMAT:
        raise _PlaceError('format', top['format'], f'{FORMAT}: this is not a model file')
    version = top.get('version', VERSION)
    if not isinstance(version, int) or version > VERSION:
        raise _PlaceError('version', version, f'at most {VERSION}: install a newer gyro_calibration')
    if 'effects' not in top:
        raise _PlaceError('effects', None, 'the effects with their values, such as {bias: {bias: 0.01}}')
    terms = tuple(_term(name, values) for name, values in _mapping('effects', top['effects'] or {}).items())
    valid = _mapping('valid', top.get('valid', {}))
    temperature_range = _range('valid.temperature', valid.get('temperature'))
    middle = sum(temperature_range) / 2.0 if all(map(math.isfinite, temperature_range)) else 25.0
    noise = {name: _number(f'noise.{name}', value, low=0.0) for name, value in _mapping('noise', top.get('noise', {})).items()}
    _only('noise', noise, Noise.__dataclass_fields__)
    return GyroModel(
        terms, _covariance(top.get('covariance'), sum(len(term.effect.coefficients) for term in terms)),
        _range('valid.rate', valid.get('rate')), temperature_range,
        _number('reference_temperature', top.get('reference_temperature', middle)), Noise(**noise),
        {str(key): _text(f'gyro.{key}', value) for key, value in _mapping('gyro', top.get('gyro', {})).items()},
        _mapping('origin', top.get('origin', {})), _self_calibration(top.get('self_calibration')))


def _mapping(place: str, value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise _PlaceError(place, value, 'names with values (see docs/error_model.md), or calibrate again')
    return value


#: Beyond this no value of a gyro lies, and its square still is a number.
_LARGEST = 1e100


def _text(place: str, value: Any) -> str:
    if isinstance(value, (list, dict, set)):
        raise _PlaceError(place, value, 'a text')
    return str(value)


def _number(place: str, value: Any, low: float = -math.inf) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= _LARGEST or value < low:
        least = f' of at least {low:g}' if low > -math.inf else ''
        raise _PlaceError(place, value, f'a finite number{least}; mend it or calibrate again')
    return float(value)


def _only(place: str, given: Mapping[str, Any], known: Sequence[str] | Mapping[str, Any]) -> None:
    for name in given:
        if name not in known:
            raise _PlaceError(f'{place}.{name}', given[name], f'one of {", ".join(known)}')


def _range(place: str, value: Any) -> tuple[float, float]:
    if value is None:
        return (-math.inf, math.inf)
    if not isinstance(value, list) or len(value) != 2:
        raise _PlaceError(place, value, '[lowest, highest]')
    low, high = (_number(f'{place}[{index}]', item) for index, item in enumerate(value))
    if low > high:
        raise _PlaceError(place, value, '[lowest, highest] in this order')
    return low, high


def _matrix(place: str, value: Any, size: int) -> Array:
    if not isinstance(value, list) or [len(row) if isinstance(row, list) else -1 for row in value] != [size] * size:
        raise _PlaceError(place, value, f'{size} rows of {size} numbers, one a coefficient')
    numbers = [[_number(f'{place}[{i}][{j}]', item) for j, item in enumerate(row)] for i, row in enumerate(value)]
    matrix = np.array(numbers).reshape(size, size)
    smallest = min([*matrix.diagonal(), *(np.linalg.eigvalsh(matrix) + 1e-9 * np.abs(matrix).max(initial=0.0))], default=0.0)
    if not np.allclose(matrix, matrix.T) or smallest < 0.0:
        raise _PlaceError(place, value, 'a covariance: symmetric, with no negative variance')
    return matrix


def _covariance(value: Any, size: int) -> Array | None:
    return None if value is None else _matrix('covariance', value, size)


def _term(name: str, values: Any) -> Term:
    place = f'effects.{name}'
    given = _mapping(place, values)
    if name == POLYNOMIAL:
        return _polynomial(place, given)
    if name not in CATALOGUE:
        raise _PlaceError(place, given, f'an effect that this version knows: {", ".join([*CATALOGUE, POLYNOMIAL])}')
    return Term(CATALOGUE[name], _values(place, CATALOGUE[name], given))


def _values(place: str, effect: Effect, given: Mapping[str, Any]) -> tuple[float, ...]:
    _only(place, given, [parameter.name for parameter in effect.parameters])
    values = []
    for parameter in effect.parameters:
        value = _number(f'{place}.{parameter.name}', given.get(parameter.name, parameter.default))
        low, high = parameter.bounds
        if not low <= value <= high:
            raise _PlaceError(f'{place}.{parameter.name}', value, f'{low:g} to {high:g} {parameter.unit}')
        values.append(value)
    return tuple(values)


def _polynomial(place: str, given: Mapping[str, Any]) -> Term:
    """Read a polynomial: the paper's matrix, or orders [rate, temperature] with named values."""
    if 'matrix_dps' in given:
        _only(place, given, ['matrix_dps'])
        return _polynomial_from_matrix(f'{place}.matrix_dps', given['matrix_dps'])
    orders = given.get('orders')
    if not isinstance(orders, list) or len(orders) != 2 or not all(type(order) is int and 0 <= order <= 20 for order in orders):
        raise _PlaceError(f'{place}.orders', orders, 'the orders in rate and temperature, such as [3, 2], or matrix_dps')
    effect = rate_temperature_polynomial(*orders)
    return Term(effect, _values(place, effect, {name: value for name, value in given.items() if name != 'orders'}))


def _polynomial_from_matrix(place: str, rows: Any) -> Term:
    if not isinstance(rows, list) or not all(isinstance(row, list) for row in rows):
        raise _PlaceError(place, rows, 'rows of finite numbers')
    numbers = [[_number(f'{place}[{i}][{j}]', item) for j, item in enumerate(row)] for i, row in enumerate(rows)]
    try:
        return Term(*polynomial_from_matrix(numbers))
    except ValueError as error:
        raise _PlaceError(place, rows, str(error)) from None


def _self_calibration(value: Any) -> SelfCalibration | None:
    if value is None:
        return None
    given = _mapping('self_calibration', value)
    _only('self_calibration', given, SelfCalibration.__dataclass_fields__)
    scale_factor_error = _number('self_calibration.scale_factor_error', given.get('scale_factor_error'), low=-0.9)
    covariance = _matrix('self_calibration.covariance', given.get('covariance', [[0.0, 0.0], [0.0, 0.0]]), 2).tolist()
    temperature = given.get('temperature')
    return SelfCalibration(
        scale_factor_error, _number('self_calibration.bias', given.get('bias')), tuple(map(tuple, covariance)),
        _text('self_calibration.time', given.get('time', '')),
        None if temperature is None else _number('self_calibration.temperature', temperature),
        _text('self_calibration.method', given.get('method', '')))


def write_model(path: str | Path, model: GyroModel) -> None:
    """Write a model file; it is complete or not there."""
    write_atomically(path, yaml.safe_dump(_to_content(model), sort_keys=False, allow_unicode=True).encode())


def _to_content(model: GyroModel) -> dict[str, Any]:
    content: dict[str, Any] = {'format': FORMAT, 'version': VERSION}
    content['effects'] = {term.effect.name: _term_content(term) for term in model.terms}
    if model.covariance is not None:
        content['covariance'] = model.covariance.tolist()
    ranges = {'rate': model.rate_range, 'temperature': model.temperature_range}
    content['valid'] = {name: list(values) for name, values in ranges.items() if all(map(math.isfinite, values))}
    content['reference_temperature'] = model.reference_temperature
    content['noise'] = dict(vars(model.noise))
    content['gyro'] = dict(model.gyro)
    content['origin'] = dict(model.origin)
    if model.self_calibration is not None:
        rows = [list(row) for row in model.self_calibration.covariance]
        content['self_calibration'] = {**vars(model.self_calibration), 'covariance': rows}
    return content


def _term_content(term: Term) -> dict[str, Any]:
    named = {parameter.name: value for parameter, value in zip(term.effect.parameters, term.values)}
    if term.effect.name != POLYNOMIAL:
        return named
    temperature_order, rate_order = (int(text) for text in term.effect.coefficients[-1].name[1:].split('w'))
    return {'orders': [rate_order, temperature_order], **named}


def with_self_calibration(model: GyroModel, calibration: SelfCalibration | None) -> GyroModel:
    """Return the model with another self-calibration."""
    return replace(model, self_calibration=calibration)


def same_effects(model: GyroModel, other: GyroModel) -> bool:
    """Tell whether two models compensate alike, so that a self-calibration behind one holds behind the other."""
    return _to_content(replace(model, self_calibration=None))['effects'] == _to_content(replace(other, self_calibration=None))['effects']
