# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""A gyro's model as a YAML file that a person can read and write."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import math
from pathlib import Path
import reprlib
from typing import Any

from gyro_calibration.files import InputError, LARGEST, reason, write_atomically
from gyro_calibration.logs.log import Array, shown
from gyro_calibration.model.effects import (
    CATALOGUE,
    Effect,
    polynomial_from_matrix,
    rate_temperature_polynomial,
)
from gyro_calibration.model.gyro_model import GyroModel, SelfCalibration, Term, Tolerance
from gyro_calibration.model.noise import Noise
from gyro_calibration.model.settings_file import read_settings, settings_text
import numpy as np

FORMAT = 'gyro_calibration/model'
VERSION = 1
POLYNOMIAL = 'rate_temperature_polynomial'
#: Highest order of a polynomial.
_HIGHEST = 20
#: Largest standard deviation of a self-calibration, rad/s and 1; beyond it double precision does
#: not carry the variance of the heading.
_LEAST_KNOWN = 100.0


class ModelError(InputError):
    """A file is not a model; the message names file, place and remedy."""


class ModelMissing(ModelError):
    """There is no such file."""


def read_model(path: str | Path) -> GyroModel:
    """
    Read a model file.

    Raises
    ------
    ModelError : missing, empty, truncated, of a newer version, or no model; names file, place and
        remedy

    """
    try:
        content = read_settings(path)
    except FileNotFoundError:
        raise ModelMissing(f'{path}: there is no such file; calibrate first, or name another '
                           'model file') from None
    except (OSError, ValueError) as error:
        raise ModelError(f'{path}: cannot be read as YAML ({reason(error)}); '
                         'restore the file or calibrate again') from error
    try:
        return _from_content(content)
    except _PlaceError as error:
        raise ModelError(f'{path}: {error}') from None


_SHORT = reprlib.Repr()
_SHORT.maxlevel = 3


class _PlaceError(ValueError):

    def __init__(self, place: str, given: Any, wanted: str):
        super().__init__(f'{shown(place)} is {_SHORT.repr(given)}; wanted {wanted}')


def _from_content(content: Any) -> GyroModel:
    top = _mapping('the file', content)
    if top.get('format', FORMAT) != FORMAT:
        raise _PlaceError('format', top['format'], f'{FORMAT}: this is not a model file')
    version = top.get('version', VERSION)
    if not isinstance(version, int) or version > VERSION:
        raise _PlaceError('version', version,
                          f'at most {VERSION}: install a newer gyro_calibration')
    if 'effects' not in top:
        raise _PlaceError('effects', None,
                          'the effects with their values, such as {bias: {bias: 0.01}}')
    terms = tuple(_term(name, values)
                  for name, values in _mapping('effects', top['effects'] or {}).items())
    valid = _mapping('valid', top.get('valid', {}))
    temperature_range = _range('valid.temperature', valid.get('temperature'))
    middle = sum(temperature_range) / 2.0 if all(map(math.isfinite, temperature_range)) else 25.0
    noise = {name: _noise(f'noise.{name}', value)
             for name, value in _mapping('noise', top.get('noise', {})).items()}
    _only('noise', noise, Noise.__dataclass_fields__)
    return GyroModel(
        terms, _covariance(top.get('covariance'), sum(len(term.fitted) for term in terms)),
        _range('valid.rate', valid.get('rate')), temperature_range,
        _number('reference_temperature', top.get('reference_temperature', middle)), Noise(**noise),
        {key: _text(f'gyro.{key}', value)
         for key, value in _mapping('gyro', top.get('gyro', {})).items()},
        _mapping('origin', top.get('origin', {})), _self_calibration(top.get('self_calibration')),
        _tolerance(top.get('tolerance', {})), _noise_bounds(top.get('noise_bounds', {})))


def _noise_bounds(value: Any) -> dict[str, tuple[float, float]]:
    given = _mapping('noise_bounds', value)
    _only('noise_bounds', given, Noise.__dataclass_fields__)
    return {name: _range(f'noise_bounds.{name}', ends) for name, ends in given.items()}


def _tolerance(value: Any) -> Tolerance:
    given = _mapping('tolerance', value)
    _only('tolerance', given, Tolerance.__dataclass_fields__)
    return Tolerance(**{name: _number(f'tolerance.{name}', each, low=0.0)
                        for name, each in given.items()})


def _mapping(place: str, value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise _PlaceError(place, value,
                          'names with values (see docs/explanation/error_model.md), '
                          'or calibrate again')
    return value


def _text(place: str, value: Any) -> str:
    if isinstance(value, (list, dict)):
        raise _PlaceError(place, value, 'a text')
    return str(value)


def _number(place: str, value: Any, low: float = -math.inf) -> float:
    if (isinstance(value, bool) or not isinstance(value, (int, float))
            or not abs(value) <= LARGEST or value < low):
        least = f' of at least {low:g}' if low > -math.inf else ''
        raise _PlaceError(place, value, f'a finite number{least}; mend it or calibrate again')
    return float(value)


def _noise(place: str, value: Any) -> float:
    """Read a figure whose square can be divided by: 0, or none that vanishes."""
    number = _number(place, value, low=0.0)
    if 0.0 < number < 1.0 / LARGEST:
        raise _PlaceError(place, value, f'0 where it is not known, or at least {1.0 / LARGEST}')
    return number


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
    if not isinstance(value, list) or [len(row) if isinstance(row, list) else -1
                                       for row in value] != [size] * size:
        raise _PlaceError(place, value, f'{size} rows of {size} numbers, one a fitted value')
    numbers = [[_number(f'{place}[{i}][{j}]', item) for j, item in enumerate(row)]
               for i, row in enumerate(value)]
    matrix = np.array(numbers).reshape(size, size)
    rounding = 1e-9 * np.abs(matrix).max(initial=0.0)
    smallest = min([*matrix.diagonal(), *(np.linalg.eigvalsh(matrix) + rounding)], default=0.0)
    if not np.allclose(matrix, matrix.T, atol=rounding) or smallest < 0.0:
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
        raise _PlaceError(place, given, 'an effect that this version knows: '
                          f'{", ".join([*CATALOGUE, POLYNOMIAL])}')
    return Term(CATALOGUE[name], _values(place, CATALOGUE[name], given))


def _values(place: str, effect: Effect, given: Mapping[str, Any]) -> tuple[float, ...]:
    _only(place, given, [parameter.name for parameter in effect.parameters])
    values = []
    for parameter in effect.parameters:
        value = _number(f'{place}.{parameter.name}', given.get(parameter.name, parameter.default))
        low, high = parameter.bounds
        if not low <= value <= high:
            raise _PlaceError(f'{place}.{parameter.name}', value,
                              f'{low:g} to {high:g} {parameter.unit}')
        values.append(value)
    return tuple(values)


def _polynomial(place: str, given: Mapping[str, Any]) -> Term:
    """Read a polynomial: the paper's matrix, or orders [rate, temperature] with named values."""
    if 'matrix_dps' in given:
        _only(place, given, ['matrix_dps'])
        return _polynomial_from_matrix(f'{place}.matrix_dps', given['matrix_dps'])
    orders = given.get('orders')
    if not isinstance(orders, list) or len(orders) != 2 or not all(
            type(order) is int and 0 <= order <= _HIGHEST for order in orders):
        raise _PlaceError(f'{place}.orders', orders,
                          'the orders in rate and temperature, such as [3, 2], or matrix_dps')
    effect = rate_temperature_polynomial(*orders)
    return Term(effect, _values(
        place, effect, {name: value for name, value in given.items() if name != 'orders'}))


def _polynomial_from_matrix(place: str, rows: Any) -> Term:
    if (not isinstance(rows, list) or not all(isinstance(row, list) for row in rows)
            or max(map(len, [rows, *rows])) > _HIGHEST + 1):
        raise _PlaceError(place, rows, f'rows of finite numbers, up to order {_HIGHEST}')
    numbers = [[_number(f'{place}[{i}][{j}]', item) for j, item in enumerate(row)]
               for i, row in enumerate(rows)]
    try:
        return Term(*polynomial_from_matrix(numbers))
    except ValueError as error:
        raise _PlaceError(place, rows, str(error)) from None


def _self_calibration(value: Any) -> SelfCalibration | None:
    if value is None:
        return None
    place, given = 'self_calibration', _mapping('self_calibration', value)
    _only(place, given, [*SelfCalibration.__dataclass_fields__, 'standard_deviations'])
    temperature = given.get('temperature')
    return SelfCalibration(
        _number(f'{place}.scale_factor_error', given.get('scale_factor_error'), low=-0.9),
        _number(f'{place}.bias', given.get('bias')),
        _calibration_covariance(place, given),
        _text(f'{place}.time', given.get('time', '')),
        None if temperature is None else _number(f'{place}.temperature', temperature),
        _text(f'{place}.method', given.get('method', '')))


def _calibration_covariance(place: str, given: Mapping[str, Any]
                            ) -> tuple[tuple[float, float], tuple[float, float]] | None:
    """Read the covariance of (s, b), or else their standard deviations; None without both."""
    covariance = _read_covariance(place, given)
    if covariance and max(covariance[0][0], covariance[1][1]) > _LEAST_KNOWN ** 2:
        raise _PlaceError(place, given, f'standard deviations of at most {_LEAST_KNOWN:g}')
    return covariance


def _read_covariance(place: str, given: Mapping[str, Any]
                     ) -> tuple[tuple[float, float], tuple[float, float]] | None:
    if 'covariance' in given:
        (a, b), (_, c) = _matrix(f'{place}.covariance', given['covariance'], 2).tolist()
        return (a, b), (b, c)
    if 'standard_deviations' not in given:
        return None
    place, names = f'{place}.standard_deviations', ('scale_factor_error', 'bias')
    named = _mapping(place, given['standard_deviations'])
    _only(place, named, names)
    s, b = (_number(f'{place}.{name}', named.get(name), low=0.0) for name in names)
    return (s * s, 0.0), (0.0, b * b)


def write_model(path: str | Path, model: GyroModel) -> tuple[int, int]:
    """Write a model file, completely or not at all, and return its version (see `files`)."""
    return write_atomically(path, model_text(model).encode())


def model_text(model: GyroModel) -> str:
    """Return what a model file holds."""
    return settings_text(_to_content(model))


def _to_content(model: GyroModel) -> dict[str, Any]:
    content: dict[str, Any] = {'format': FORMAT, 'version': VERSION}
    content['effects'] = {term.effect.name: _term_content(term) for term in model.terms}
    if model.covariance is not None:
        content['covariance'] = model.covariance.tolist()
    ranges = {'rate': model.rate_range, 'temperature': model.temperature_range}
    content['valid'] = {name: list(values) for name, values in ranges.items()
                        if all(map(math.isfinite, values))}
    content['reference_temperature'] = model.reference_temperature
    content['noise'] = dict(vars(model.noise))
    if model.noise_bounds:
        content['noise_bounds'] = {name: list(ends) for name, ends in model.noise_bounds.items()}
    content['gyro'] = dict(model.gyro)
    content['origin'] = dict(model.origin)
    if model.self_calibration is not None:
        content['self_calibration'] = _self_calibration_content(model.self_calibration)
    if model.tolerance != Tolerance():
        content['tolerance'] = dict(vars(model.tolerance))
    return content


def _self_calibration_content(calibration: SelfCalibration) -> dict[str, Any]:
    content = dict(vars(calibration))
    covariance = content.pop('covariance')
    if covariance is not None:
        content['covariance'] = [list(row) for row in covariance]
        content['standard_deviations'] = dict(zip(('scale_factor_error', 'bias'),
                                                  calibration.standard_deviations))
    return content


def _term_content(term: Term) -> dict[str, Any]:
    named = {parameter.name: value
             for parameter, value in zip(term.effect.parameters, term.values)}
    if term.effect.name != POLYNOMIAL:
        return named
    temperature_order, rate_order = (
        int(text) for text in term.effect.coefficients[-1].name[1:].split('w'))
    return {'orders': [rate_order, temperature_order], **named}
