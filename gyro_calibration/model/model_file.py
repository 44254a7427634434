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

from collections.abc import Mapping
import math
from pathlib import Path
from typing import Any

from gyro_calibration.files import (
    describe_error, InputError, MAX_MAGNITUDE, suggest_nearest, write_atomically)
from gyro_calibration.logs.log import Array
from gyro_calibration.model.effects import (
    CATALOGUE, Effect, polynomial_from_matrix, rate_temperature_polynomial)
from gyro_calibration.model.gyro_model import GyroModel, SelfCalibration, Term, Tolerance
from gyro_calibration.model.noise import Noise
from gyro_calibration.model.settings_file import (
    format_settings, InvalidValue, parse_number, parse_text, read_settings, refuse_unknown_names,
    validate)
import numpy as np

_FORMAT = 'gyro_calibration/model'
_VERSION = 1
POLYNOMIAL = 'rate_temperature_polynomial'
_NOISE_NAMES = tuple(Noise.__dataclass_fields__)
_MAX_POLYNOMIAL_ORDER = 20  # highest order of a polynomial


class ModelError(InputError):
    """A file is not a model; the message names file, place and remedy."""


class ModelNotFound(ModelError):
    """The model file does not exist."""


def read_model(path: str | Path) -> GyroModel:
    """Read a model file; a `ModelError` names file, place and remedy."""
    try:
        content = read_settings(path)
    except FileNotFoundError:
        raise ModelNotFound(f'{path}: there is no such file; calibrate, or name another') from None
    except (OSError, ValueError) as error:
        raise ModelError(f'{path}: cannot be read as YAML ({describe_error(error)}); '
                         'restore the file or calibrate again') from error
    return parse_model(content, str(path))


def parse_model(content: Any, name: str = 'the model') -> GyroModel:
    """Return the model that a mapping holds, with the keys of a model file."""
    try:
        top = validate('the file', content, None)
        if top.get('format', _FORMAT) != _FORMAT:
            raise InvalidValue('format', top['format'], f'{_FORMAT}: this is not a model file')
        version = top.get('version', _VERSION)
        if not isinstance(version, int) or version > _VERSION:
            raise InvalidValue('version', version,
                               f'at most {_VERSION}: install a newer gyro_calibration')
        if 'effects' not in top:
            raise InvalidValue('effects', None,
                               'the effects with their values, such as {bias: {bias: 0.01}}')
        terms = tuple(_parse_term(name, values)
                      for name, values in validate('effects', top['effects'] or {}, None).items())
        size = sum(len(term.fitted_indices) for term in terms)
        valid = validate('valid', top.get('valid', {}), None)
        temperature_range = _parse_range('valid.temperature', valid.get('temperature'))
        is_finite = all(map(math.isfinite, temperature_range))
        middle = sum(temperature_range) / 2.0 if is_finite else 25.0

        def parse_section(name: str, schema: Any) -> Any:
            return validate(name, top.get(name, {}), schema)

        return GyroModel(
            terms, None if top.get('covariance') is None
            else _parse_covariance('covariance', top['covariance'], size),
            _parse_range('valid.rate', valid.get('rate')), temperature_range,
            parse_number('reference_temperature', top.get('reference_temperature', middle)),
            Noise(**parse_section('noise', dict.fromkeys(_NOISE_NAMES, _parse_noise_figure))),
            {name: parse_text(f'gyro.{name}', value)
             for name, value in parse_section('gyro', None).items()},
            parse_section('origin', None), _parse_self_calibration(top.get('self_calibration')),
            Tolerance(**parse_section('tolerance', dict.fromkeys(Tolerance.__dataclass_fields__,
                                                                 _parse_nonnegative))),
            parse_section('noise_bounds', dict.fromkeys(_NOISE_NAMES, _parse_range)))
    except InvalidValue as error:
        raise ModelError(f'{name}: {error}; correct it (see docs/reference/error_model.md) '
                         'or calibrate again') from None


def _parse_nonnegative(key_path: str, value: Any) -> float:
    return parse_number(key_path, value, low=0.0)


def _parse_noise_figure(key_path: str, value: Any) -> float:
    """Read a noise figure: 0, or large enough that its square does not underflow."""
    if 0.0 < (size := _parse_nonnegative(key_path, value)) < 1.0 / MAX_MAGNITUDE:
        raise InvalidValue(key_path, value,
                           f'0 where it is not known, or at least {1.0 / MAX_MAGNITUDE}')
    return size


def _parse_range(key_path: str, value: Any) -> tuple[float, float]:
    if value is None:
        return (-math.inf, math.inf)
    if not isinstance(value, list) or len(value) != 2:
        raise InvalidValue(key_path, value, '[lowest, highest]')
    low, high = (parse_number(f'{key_path}[{index}]', item) for index, item in enumerate(value))
    if low > high:
        raise InvalidValue(key_path, value, '[lowest, highest] in this order')
    return low, high


def _parse_matrix(key_path: str, value: Any, wanted: str) -> Array:
    lengths = {len(row) if isinstance(row, list) else 0
               for row in value} if isinstance(value, list) else {0}
    if len(lengths) != 1 or 0 in lengths:
        raise InvalidValue(key_path, value, wanted)
    return np.array([[parse_number(f'{key_path}[{i}][{j}]', item) for j, item in enumerate(row)]
                     for i, row in enumerate(value)])


def _parse_covariance(key_path: str, value: Any, size: int = 2) -> Array:
    wanted = f'{size} rows of {size} numbers, one a fitted value'
    matrix = np.zeros((0, 0)) if value == [] else _parse_matrix(key_path, value, wanted)
    if matrix.shape != (size, size):
        raise InvalidValue(key_path, value, wanted)
    rounding = 1e-9 * np.abs(matrix).max(initial=0.0)
    smallest = min([*matrix.diagonal(), *(np.linalg.eigvalsh(matrix) + rounding)], default=0.0)
    if not np.allclose(matrix, matrix.T, atol=rounding) or smallest < 0.0:
        raise InvalidValue(key_path, value, 'a covariance: symmetric, with no negative variance')
    return matrix


def _parse_term(name: str, values: Any) -> Term:
    place = f'effects.{name}'
    given = validate(place, values, None)
    if name != POLYNOMIAL:
        if name not in CATALOGUE:
            raise InvalidValue(place, given, 'an effect that this version knows, or one of your '
                               f'own (--catalogue): {", ".join([*CATALOGUE, POLYNOMIAL])}'
                               f'{suggest_nearest(name, CATALOGUE)}')
        return Term(CATALOGUE[name], _parse_values(place, CATALOGUE[name], given))
    # the paper's matrix, or orders [rate, temperature] with named values
    if 'matrix_dps' in given:
        refuse_unknown_names(place, given, ['matrix_dps'])
        place, rows = f'{place}.matrix_dps', given['matrix_dps']
        wanted = f'rows of finite numbers of one length, up to order {_MAX_POLYNOMIAL_ORDER}'
        matrix = _parse_matrix(place, rows, wanted)
        if max(matrix.shape) > _MAX_POLYNOMIAL_ORDER + 1:
            raise InvalidValue(place, rows, wanted)
        return Term(*polynomial_from_matrix(matrix))
    orders = given.get('orders')
    if not isinstance(orders, list) or len(orders) != 2 or not all(
            type(order) is int and 0 <= order <= _MAX_POLYNOMIAL_ORDER for order in orders):
        raise InvalidValue(f'{place}.orders', orders,
                           'the orders in rate and temperature, such as [3, 2], or matrix_dps')
    effect = rate_temperature_polynomial(*orders)
    return Term(effect, _parse_values(
        place, effect, {key: value for key, value in given.items() if key != 'orders'}))


def _parse_values(key_path: str, effect: Effect, given: Mapping[str, Any]) -> tuple[float, ...]:
    known = {parameter.name: parameter.default for parameter in effect.parameters}
    refuse_unknown_names(key_path, given, known)
    values = []
    for parameter in effect.parameters:
        place = f'{key_path}.{parameter.name}'
        value = parse_number(place, given.get(parameter.name, parameter.default))
        low, high = parameter.bounds
        if not low <= value <= high:
            raise InvalidValue(place, value, f'{low:g} to {high:g} {parameter.unit}')
        values.append(value)
    return tuple(values)


_SELF_CALIBRATION_SCHEMA = {
    'scale_factor_error': lambda place, value: parse_number(place, value, low=-0.9),
    'bias': parse_number, 'covariance': _parse_covariance,
    'standard_deviations': {'scale_factor_error': _parse_nonnegative, 'bias': _parse_nonnegative},
    'time': parse_text, 'temperature': lambda place, value: value if value is None
    else parse_number(place, value), 'method': parse_text}


def _parse_self_calibration(value: Any) -> SelfCalibration | None:
    """Read a self-calibration; standard deviations may stand in for its covariance."""
    if value is None:
        return None
    place, needed = 'self_calibration', {'scale_factor_error': None, 'bias': None}
    run = validate(place, {**needed, **value} if isinstance(value, dict) else value,
                   _SELF_CALIBRATION_SCHEMA)
    deviations, matrix = run.pop('standard_deviations', None), run.pop('covariance', None)
    if matrix is None and deviations is not None:
        place = f'{place}.standard_deviations'
        matrix = np.diag(
            [_parse_nonnegative(f'{place}.{name}', deviations.get(name)) ** 2 for name in needed])
    if matrix is None:
        return SelfCalibration(**run)
    (a, b), (_, c) = matrix.tolist()
    return SelfCalibration(**run, covariance=((a, b), (b, c)))


def write_model(path: str | Path, model: GyroModel) -> tuple[int, int]:
    """Write a model file atomically, and return its version (see `files`)."""
    return write_atomically(path, format_model(model).encode())


def format_model(model: GyroModel) -> str:
    effects: dict[str, Any] = {}
    for term in model.terms:
        named: dict[str, Any] = {parameter.name: value
                                 for parameter, value in zip(term.effect.parameters, term.values)}
        if term.effect.name == POLYNOMIAL:
            temperature_order, rate_order = map(
                int, term.effect.coefficients[-1].name[1:].split('w'))
            named = {'orders': [rate_order, temperature_order], **named}
        effects[term.effect.name] = named
    ranges = {'rate': model.rate_range, 'temperature': model.temperature_range}
    run = model.self_calibration and dict(vars(model.self_calibration))
    if run and model.self_calibration and (covariance := run.pop('covariance')):
        run['covariance'] = [list(row) for row in covariance]
        run['standard_deviations'] = dict(
            zip(('scale_factor_error', 'bias'), model.self_calibration.standard_deviations))
    content = {
        'format': _FORMAT, 'version': _VERSION, 'effects': effects,
        'covariance': None if model.covariance is None else model.covariance.tolist(),
        'valid': {name: list(values)
                  for name, values in ranges.items() if all(map(math.isfinite, values))},
        'reference_temperature': model.reference_temperature, 'noise': dict(vars(model.noise)),
        'noise_bounds': {name: list(ends) for name, ends in model.noise_bounds.items()} or None,
        'gyro': dict(model.gyro), 'origin': dict(model.origin), 'self_calibration': run,
        'tolerance': None if model.tolerance == Tolerance() else dict(vars(model.tolerance))}
    return format_settings({name: value for name, value in content.items() if value is not None})
