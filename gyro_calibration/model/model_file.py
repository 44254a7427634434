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

from collections.abc import Mapping
import math
from pathlib import Path
from typing import Any

from gyro_calibration.files import InputError, LARGEST, reason, write_atomically
from gyro_calibration.logs.log import Array
from gyro_calibration.model.effects import (
    CATALOGUE,
    Effect,
    polynomial_from_matrix,
    rate_temperature_polynomial,
)
from gyro_calibration.model.gyro_model import GyroModel, SelfCalibration, Term, Tolerance
from gyro_calibration.model.noise import Noise
from gyro_calibration.model.settings_file import (
    checked,
    number,
    read_settings,
    refuse_others,
    settings_text,
    text,
    WrongValue,
)
import numpy as np

FORMAT = 'gyro_calibration/model'
VERSION = 1
POLYNOMIAL = 'rate_temperature_polynomial'
_NOISES = tuple(Noise.__dataclass_fields__)
#: Highest order of a polynomial.
_HIGHEST = 20
#: Largest standard deviation of a self-calibration, rad/s and 1; beyond it the variance of the
#: heading exceeds double precision.
_LEAST_KNOWN = 100.0


class ModelError(InputError):
    """A file is not a model; the message names file, place and remedy."""


class ModelMissing(ModelError):
    """The model file does not exist."""


def read_model(path: str | Path) -> GyroModel:
    """Read a model file; a `ModelError` names file, place and remedy."""
    try:
        content = read_settings(path)
    except FileNotFoundError:
        raise ModelMissing(f'{path}: there is no such file; calibrate first, or name another '
                           'model file') from None
    except (OSError, ValueError) as error:
        raise ModelError(f'{path}: cannot be read as YAML ({reason(error)}); '
                         'restore the file or calibrate again') from error
    return model_of(content, str(path))


def model_of(content: Any, name: str = 'the model') -> GyroModel:
    """Return the model that a mapping holds, with the keys of a model file."""
    try:
        return _from_content(content)
    except WrongValue as error:
        raise ModelError(f'{name}: {error}; correct it (see docs/explanation/error_model.md) '
                         'or calibrate again') from None


def _from_content(content: Any) -> GyroModel:
    top = checked('the file', content, None)
    if top.get('format', FORMAT) != FORMAT:
        raise WrongValue('format', top['format'], f'{FORMAT}: this is not a model file')
    version = top.get('version', VERSION)
    if not isinstance(version, int) or version > VERSION:
        raise WrongValue('version', version,
                         f'at most {VERSION}: install a newer gyro_calibration')
    if 'effects' not in top:
        raise WrongValue('effects', None,
                         'the effects with their values, such as {bias: {bias: 0.01}}')
    terms = tuple(_term(name, values)
                  for name, values in checked('effects', top['effects'] or {}, None).items())
    size = sum(len(term.fitted) for term in terms)
    valid = checked('valid', top.get('valid', {}), None)
    temperature_range = _range('valid.temperature', valid.get('temperature'))
    middle = sum(temperature_range) / 2.0 if all(map(math.isfinite, temperature_range)) else 25.0

    def part(name: str, schema: Any) -> Any:
        return checked(name, top.get(name, {}), schema)

    return GyroModel(
        terms,
        None if top.get('covariance') is None else _matrix('covariance', top['covariance'], size),
        _range('valid.rate', valid.get('rate')), temperature_range,
        number('reference_temperature', top.get('reference_temperature', middle)),
        Noise(**part('noise', dict.fromkeys(_NOISES, _noise))),
        {name: text(f'gyro.{name}', value) for name, value in part('gyro', None).items()},
        part('origin', None), _self_calibration(top.get('self_calibration')),
        Tolerance(**part('tolerance', dict.fromkeys(Tolerance.__dataclass_fields__, _size))),
        part('noise_bounds', dict.fromkeys(_NOISES, _range)))


def _size(place: str, value: Any) -> float:
    return number(place, value, low=0.0)


def _noise(place: str, value: Any) -> float:
    """Read a noise figure: 0, or large enough that its square does not underflow."""
    if 0.0 < (size := _size(place, value)) < 1.0 / LARGEST:
        raise WrongValue(place, value, f'0 where it is not known, or at least {1.0 / LARGEST}')
    return size


def _range(place: str, value: Any) -> tuple[float, float]:
    if value is None:
        return (-math.inf, math.inf)
    if not isinstance(value, list) or len(value) != 2:
        raise WrongValue(place, value, '[lowest, highest]')
    low, high = (number(f'{place}[{index}]', item) for index, item in enumerate(value))
    if low > high:
        raise WrongValue(place, value, '[lowest, highest] in this order')
    return low, high


def _rows(place: str, value: Any) -> list[list[float]]:
    return [[number(f'{place}[{i}][{j}]', item) for j, item in enumerate(row)]
            for i, row in enumerate(value)]


def _matrix(place: str, value: Any, size: int = 2) -> Array:
    if not isinstance(value, list) or [len(row) if isinstance(row, list) else -1
                                       for row in value] != [size] * size:
        raise WrongValue(place, value, f'{size} rows of {size} numbers, one a fitted value')
    matrix = np.array(_rows(place, value)).reshape(size, size)
    rounding = 1e-9 * np.abs(matrix).max(initial=0.0)
    smallest = min([*matrix.diagonal(), *(np.linalg.eigvalsh(matrix) + rounding)], default=0.0)
    if not np.allclose(matrix, matrix.T, atol=rounding) or smallest < 0.0:
        raise WrongValue(place, value, 'a covariance: symmetric, with no negative variance')
    return matrix


def _term(name: str, values: Any) -> Term:
    place = f'effects.{name}'
    given = checked(place, values, None)
    if name == POLYNOMIAL:
        return _polynomial(place, given)
    if name not in CATALOGUE:
        raise WrongValue(place, given, 'an effect that this version knows, or one of your own '
                         f'(--catalogue): {", ".join([*CATALOGUE, POLYNOMIAL])}')
    return Term(CATALOGUE[name], _values(place, CATALOGUE[name], given))


def _values(place: str, effect: Effect, given: Mapping[str, Any]) -> tuple[float, ...]:
    refuse_others(place, given, [parameter.name for parameter in effect.parameters])
    values = []
    for parameter in effect.parameters:
        value = number(f'{place}.{parameter.name}', given.get(parameter.name, parameter.default))
        low, high = parameter.bounds
        if not low <= value <= high:
            raise WrongValue(f'{place}.{parameter.name}', value,
                             f'{low:g} to {high:g} {parameter.unit}')
        values.append(value)
    return tuple(values)


def _polynomial(place: str, given: Mapping[str, Any]) -> Term:
    """Read a polynomial: the paper's matrix, or orders [rate, temperature] with named values."""
    if 'matrix_dps' in given:
        return Term(*checked(place, given, {'matrix_dps': _effect_of_matrix})['matrix_dps'])
    orders = given.get('orders')
    if not isinstance(orders, list) or len(orders) != 2 or not all(
            type(order) is int and 0 <= order <= _HIGHEST for order in orders):
        raise WrongValue(f'{place}.orders', orders,
                         'the orders in rate and temperature, such as [3, 2], or matrix_dps')
    effect = rate_temperature_polynomial(*orders)
    return Term(effect, _values(
        place, effect, {name: value for name, value in given.items() if name != 'orders'}))


def _effect_of_matrix(place: str, rows: Any) -> tuple[Effect, tuple[float, ...]]:
    if (not isinstance(rows, list) or not all(isinstance(row, list) for row in rows)
            or max(map(len, [rows, *rows])) > _HIGHEST + 1):
        raise WrongValue(place, rows, f'rows of finite numbers, up to order {_HIGHEST}')
    try:
        return polynomial_from_matrix(_rows(place, rows))
    except WrongValue:
        raise
    except ValueError as error:
        raise WrongValue(place, rows, str(error)) from None


_OF_A_RUN = {'scale_factor_error': lambda place, value: number(place, value, low=-0.9),
             'bias': number, 'covariance': _matrix,
             'standard_deviations': {'scale_factor_error': _size, 'bias': _size}, 'time': text,
             'temperature': lambda place, value: value if value is None else number(place, value),
             'method': text}


def _self_calibration(value: Any) -> SelfCalibration | None:
    """Read a self-calibration; standard deviations may stand in for its covariance."""
    if value is None:
        return None
    place, needed = 'self_calibration', {'scale_factor_error': None, 'bias': None}
    run = checked(place, {**needed, **value} if isinstance(value, dict) else value, _OF_A_RUN)
    deviations, matrix = run.pop('standard_deviations', None), run.pop('covariance', None)
    if matrix is None and deviations is not None:
        place = f'{place}.standard_deviations'
        matrix = np.diag([_size(f'{place}.{name}', deviations.get(name)) ** 2 for name in needed])
    if matrix is None:
        return SelfCalibration(**run)
    (a, b), (_, c) = matrix.tolist()
    if max(a, c) > _LEAST_KNOWN ** 2:
        raise WrongValue(place, value, f'standard deviations of at most {_LEAST_KNOWN:g}')
    return SelfCalibration(**run, covariance=((a, b), (b, c)))


def write_model(path: str | Path, model: GyroModel) -> tuple[int, int]:
    """Write a model file atomically, and return its version (see `files`)."""
    return write_atomically(path, model_text(model).encode())


def model_text(model: GyroModel) -> str:
    """Return the text of a model file."""
    content: dict[str, Any] = {'format': FORMAT, 'version': VERSION}
    content['effects'] = effects = dict[str, Any]()
    for term in model.terms:
        named: dict[str, Any] = {parameter.name: value for parameter, value in zip(
            term.effect.parameters, term.values)}
        if term.effect.name == POLYNOMIAL:
            temperature_order, rate_order = map(
                int, term.effect.coefficients[-1].name[1:].split('w'))
            named = {'orders': [rate_order, temperature_order], **named}
        effects[term.effect.name] = named
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
        content['self_calibration'] = run = dict(vars(model.self_calibration))
        covariance = run.pop('covariance')
        if covariance is not None:
            run['covariance'] = [list(row) for row in covariance]
            run['standard_deviations'] = dict(zip(('scale_factor_error', 'bias'),
                                                  model.self_calibration.standard_deviations))
    if model.tolerance != Tolerance():
        content['tolerance'] = dict(vars(model.tolerance))
    return settings_text(content)
