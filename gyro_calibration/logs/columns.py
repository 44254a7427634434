# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Names and units of the columns of a log; the user may assign others, as `gyro=wz:deg/s`."""

from collections.abc import Mapping, Sequence
import math
from typing import NamedTuple

from gyro_calibration.files import InputError, suggest_nearest, to_printable

DEGREE = math.pi / 180.0
STANDARD_GRAVITY = 9.80665  # m/s²; what devices call one g
PLAUSIBLE_TEMPERATURES = -100.0, 200.0  # degC; others are taken for errors

#: Quantity -> names of its columns, that in SI first; in the order of writing.
_COLUMN_NAMES = {
    'time': ('time_s',),
    'output': ('gyro_rad_s', 'gyro_dps'),
    'counts': ('gyro_counts',),
    'temperature': ('temperature_degc',),
    'reference_rate': ('reference_rate_rad_s', 'reference_rate_dps'),
    'reference_heading': ('reference_heading_rad', 'reference_heading_deg'),
    'cross_axis_1': ('cross_axis_1_rad', 'cross_axis_1_deg'),
    'cross_axis_2': ('cross_axis_2_rad', 'cross_axis_2_deg'),
    'specific_force': ('acceleration_mps2',),
    'supply': ('supply_v',),
    'moving': ('moving',),
}
QUANTITIES = tuple(_COLUMN_NAMES)
#: Column name -> (quantity, factor to SI).
COLUMNS: Mapping[str, tuple[str, float]] = {
    name: (quantity, DEGREE if name.endswith(('_dps', '_deg')) else 1.0)
    for quantity, names in _COLUMN_NAMES.items() for name in names}
#: Parts of a quaternion, from which a reader computes the reference heading and `ROTATIONS`.
ATTITUDE = ('attitude_w', 'attitude_x', 'attitude_y', 'attitude_z')
#: The rotation about the axis of the gyro and about the next two, in the order x, y, z, x, y.
ROTATIONS = ('reference_heading', 'cross_axis_1', 'cross_axis_2')
AXES = ('x', 'y', 'z')  # axes of a gyro; column names may contain one, such as gyro_x_dps

RATE_UNITS = {'rad/s': 1.0, 'deg/s': DEGREE, 'dps': DEGREE, 'mrad/s': 1e-3,
              'deg/h': DEGREE / 3600.0}
#: Name of a quantity in options -> the quantity, and its units: factor to SI, that of SI first.
_OPTION_QUANTITIES: Mapping[str, tuple[str, Mapping[str, float]]] = {
    'time': ('time', {'s': 1.0, 'ms': 1e-3, 'us': 1e-6, 'ns': 1e-9, 'min': 60.0, 'h': 3600.0}),
    'gyro': ('output', RATE_UNITS),
    'counts': ('counts', {'1': 1.0}),
    'temperature': ('temperature', {'degC': 1.0, 'K': 1.0, 'degF': 5.0 / 9.0}),
    'rate': ('reference_rate', RATE_UNITS),
    'heading': ('reference_heading', {'rad': 1.0, 'deg': DEGREE, 'mrad': 1e-3,
                                      'turn': 2.0 * math.pi}),
    'acceleration': ('specific_force', {'m/s2': 1.0, 'g': STANDARD_GRAVITY,
                                        'mg': 1e-3 * STANDARD_GRAVITY}),
    'supply': ('supply', {'V': 1.0, 'mV': 1e-3}),
    'moving': ('moving', {'1': 1.0}),
    'attitude': ('reference_heading', {'1': 1.0}),
}


class Column(NamedTuple):
    """Column of a quantity in a file, and its conversion to SI: ``factor * value + offset``."""

    position: int
    factor: float
    offset: float = 0.0


def find_columns(header: Sequence[str], user_columns: Mapping[str, str],
                 axis: str) -> dict[str, Column]:
    """
    Return the column of each quantity of a log, and of each part of an `ATTITUDE`.

    `user_columns` has the name of a quantity in options -> name of its column, or name:unit. Raise
    `InputError` for an unknown quantity, column or unit, a quantity in two columns, or no output.
    """
    found, by_user = dict[str, Column](), set[str]()
    for name, text in user_columns.items():
        if name not in _OPTION_QUANTITIES:
            raise InputError(f'{name} is no quantity of a log, which are '
                             f'{", ".join(_OPTION_QUANTITIES)}'
                             f'{suggest_nearest(name, _OPTION_QUANTITIES)}')
        quantity, units = _OPTION_QUANTITIES[name]
        if quantity in by_user:
            raise InputError(f'heading and attitude both give the {quantity}; name one of them')
        by_user.add(quantity)
        columns = text.split('/') if name == 'attitude' else [text]
        parts = ATTITUDE if name == 'attitude' else (quantity,)
        if len(columns) != len(parts):
            raise InputError(f'{name}={text}: wanted the four columns of a quaternion, such as '
                             'attitude=qw/qx/qy/qz')
        for part, column in zip(parts, columns):
            given, unit = column, next(iter(units))
            if column not in header and ':' in column:
                column, _, unit = column.rpartition(':')
            if unit not in units:
                raise InputError(f'{name}={given}: {unit} is no unit of it; wanted one of '
                                 f'{", ".join(units)}{suggest_nearest(unit, units)}')
            if column not in header:
                raise InputError(f'{name}={given}: there is no column {column} among '
                                 f'{excerpt(",".join(header))}{suggest_nearest(column, header)}')
            offset = {'K': -273.15, 'degF': -160.0 / 9.0}.get(unit, 0.0)
            found[part] = Column(header.index(column), units[unit], offset)
    asked = {column.position for column in found.values()}
    for index, name in enumerate(header):
        first, _, rest = name.partition(f'_{axis}_')
        has_axis = rest and first in ('gyro', 'acceleration')  # as gyro_z_dps
        quantity, factor = COLUMNS.get(f'{first}_{rest}' if has_axis else name, ('', 0.0))
        if not quantity or index in asked or quantity in by_user:
            continue
        if quantity in found:
            raise InputError(f'columns {header[found[quantity].position]} and {name} both give '
                             f'the {quantity}; keep one of them')
        found[quantity] = Column(index, factor)
    if not {'output', 'counts'} & set(found):
        raise InputError(f'no gyro column among {excerpt(",".join(header))}; wanted gyro_dps, '
                         'gyro_rad_s or gyro_counts, and # before the lines above it, or other '
                         'names, as by --columns time=NAME:s,gyro=NAME:deg/s')
    return found


def find_delimiter(line: str) -> str:
    """Return the delimiter of the values of a line: comma, semicolon or tab."""
    return max(',;\t', key=line.count)


def excerpt(text: str) -> str:
    """Return the first 100 characters of a text of a file, for a message."""
    return to_printable(text[:100])
