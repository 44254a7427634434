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
Serialized ROS 2 messages of gyros, temperatures and references, without ROS.

A message is in the common data representation (CDR): four bytes state the byte order, then come
the fields, each aligned to its own size. The message definition, which recordings contain, lists
the fields. It is parsed here into a table of formats; nothing in it is run.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
import re
import struct

from gyro_calibration.files import MAX_DEPTH
from gyro_calibration.logs.log import Number
import numpy as np

NSEC_PER_SEC = 1_000_000_000
IMU, TEMPERATURE = 'sensor_msgs/msg/Imu', 'sensor_msgs/msg/Temperature'
ODOMETRY, POSE, TWIST = ('nav_msgs/msg/Odometry', 'geometry_msgs/msg/PoseStamped',
                         'geometry_msgs/msg/TwistStamped')

#: In element 0 of the covariance of a quantity that the message does not report (REP-145).
NOT_REPORTED = -1.0

#: Variance of quantities that a single-axis gyro does not measure, in (rad/s)², (m/s²)², rad² or
#: m². All zeros would declare the whole covariance unknown, z included; 1000 rad/s give these axes
#: no weight in a filter, and the matrix can still be inverted.
UNMEASURED_VARIANCE = 1e6


def z_axis_covariance(variance: float) -> tuple[float, ...]:
    """Return the covariance of a quantity that is measured about or along z only, shape (9,)."""
    return (UNMEASURED_VARIANCE, 0.0, 0.0, 0.0, UNMEASURED_VARIANCE, 0.0, 0.0, 0.0, variance)


NOT_REPORTED_COVARIANCE = (NOT_REPORTED, *8 * (0.0,))

_DEFINITION_SEPARATOR = '=' * 80
_STRUCT_CODES = {'bool': '?', 'byte': 'B', 'char': 'b', 'int8': 'b', 'uint8': 'B', 'int16': 'h',
                 'uint16': 'H', 'int32': 'i', 'uint32': 'I', 'int64': 'q', 'uint64': 'Q',
                 'float32': 'f', 'float64': 'd', 'string': 's'}
_FIELD_PATTERN = re.compile(r'(?P<kind>[\w/]+)(?:<=\d+)?(?:\[(?P<most><=)?(?P<count>\d{0,9})\])?'
                            r' +(?P<name>\w+) *(?P<constant>=?)')

#: Quantity -> fields that may hold it; the first one present is used. `{}` is the axis.
_QUANTITY_FIELDS = {
    **{f'orientation.{each}': tuple(f'{where}{each}' for where in (
        'orientation.', 'pose.pose.orientation.', 'pose.orientation.', 'transform.rotation.',
        'quaternion.')) for each in 'xyzw'},
    'orientation variance': ('orientation_covariance.0',),
    'rate': ('angular_velocity.{}', 'twist.twist.angular.{}', 'twist.angular.{}', 'vector.{}'),
    'rate variance': ('angular_velocity_covariance.0',),
    'force': ('linear_acceleration.{}',),
    'force variance': ('linear_acceleration_covariance.0',),
    'temperature': ('temperature',),
}
_IMU_RATE = 'angular_velocity.x'

_NESTED_DEFINITIONS = {
    'builtin_interfaces/Time': 'int32 sec\nuint32 nanosec',
    'std_msgs/Header': 'builtin_interfaces/Time stamp\nstring frame_id',
    **{f'geometry_msgs/{name}': '\n'.join(f'float64 {each}' for each in axes)
       for name, axes in (('Point', 'xyz'), ('Vector3', 'xyz'), ('Quaternion', 'xyzw'))},
    'geometry_msgs/Pose': 'geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation',
    'geometry_msgs/Twist': 'geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular',
    'geometry_msgs/PoseWithCovariance': 'geometry_msgs/Pose pose\nfloat64[36] covariance',
    'geometry_msgs/TwistWithCovariance': 'geometry_msgs/Twist twist\nfloat64[36] covariance',
}
_MESSAGE_FIELDS = {
    IMU: """geometry_msgs/Quaternion orientation
float64[9] orientation_covariance
geometry_msgs/Vector3 angular_velocity
float64[9] angular_velocity_covariance
geometry_msgs/Vector3 linear_acceleration
float64[9] linear_acceleration_covariance""",
    TEMPERATURE: 'float64 temperature\nfloat64 variance',
    ODOMETRY: """string child_frame_id
geometry_msgs/PoseWithCovariance pose
geometry_msgs/TwistWithCovariance twist""",
    POSE: 'geometry_msgs/Pose pose',
    TWIST: 'geometry_msgs/Twist twist',
}


#: Message type -> definition as ROS 2 writes it, for recordings without definitions and recorders.
DEFINITIONS: dict[str, str] = {}
for _kind, _fields in _MESSAGE_FIELDS.items():
    DEFINITIONS[_kind] = f'std_msgs/Header header\n{_fields}\n'
    for _name, _part in reversed(_NESTED_DEFINITIONS.items()):
        if f'{_name} ' in DEFINITIONS[_kind]:
            DEFINITIONS[_kind] += f'{_DEFINITION_SEPARATOR}\nMSG: {_name}\n{_part}\n'


class MessageError(ValueError):
    """Bytes are not a message of the expected type, or a definition is not valid."""


@dataclass(frozen=True)
class _MessageLayout:
    """The layout in bytes of a message type, with the quantities of a gyro or reference."""

    #: Runs of contiguous numbers: size in bytes of an element of the text or sequence before the
    #: run, 0 for the first run; and formats of the numbers.
    runs: tuple[tuple[int, str], ...]
    quantities: Mapping[str, int]  # name -> index among the numbers


@cache
def parse_layout(definition: str, axis: str = 'z') -> _MessageLayout:
    """Return the layout of a message type by its definition, with the rate about an axis."""
    if len(definition) > 100_000:
        raise MessageError('it has more than 100000 characters')
    parts: dict[str, list[re.Match[str]]] = {}
    for part in f'MSG: /\n{definition}'.split(f'{_DEFINITION_SEPARATOR}\n'):
        name, _, text = part.partition('\n')
        fields = [found for line in text.split('\n')
                  if (found := _FIELD_PATTERN.match(line.partition('#')[0].strip()))]
        name = name.removeprefix('MSG: ').strip()
        # Definitions name messages of the same package without the package.
        parts[name] = parts[name.rpartition('/')[2] or name] = [
            field for field in fields if not field['constant']]
    names, runs = list[str](), [['', '']]
    for number, (name, code) in enumerate(_flatten_fields(parts, '/', '', 0)):
        if number > 5000:
            raise MessageError('it has more than 5000 parts')
        if name and code:
            names.append(name)
            runs[-1][1] += code
        elif code:
            runs.append([code, ''])
    # drivers nest an Imu in a message of their own
    nested = [name.removesuffix(_IMU_RATE) for name in names if name.endswith(f'.{_IMU_RATE}')]
    inside = nested[0] if len(nested) == 1 and _IMU_RATE not in names else ''
    stamp = ['header.stamp.sec', 'header.stamp.nanosec']
    if names[:2] not in (stamp, [inside + name for name in stamp]):
        raise MessageError('it does not begin with a header')
    places = {name.removeprefix(inside): place - 2 for place, name in enumerate(names)
              if name.startswith(inside)}
    quantities = {quantity: places[found] for quantity, fields in _QUANTITY_FIELDS.items()
                  for found in [field.format(axis) for field in fields
                                if field.format(axis) in places][:1]}
    return _MessageLayout(tuple((struct.calcsize(before), codes) for before, codes in runs),
                          quantities)


def _flatten_fields(parts: Mapping[str, Sequence[re.Match[str]]], part: str, path: str,
                    depth: int) -> Iterator[tuple[str, str]]:
    """Give names and formats of numbers; texts and sequences have no name, messages no format."""
    # Fields after a sequence of texts or of messages are left out: their offset is not fixed.
    for field in parts[part]:
        kind, count, name = field['kind'], field['count'], f'{path}{field["name"]}'
        code = _STRUCT_CODES.get(kind, '')
        if field['most'] or count == '':
            if code in ('', 's'):
                return
            yield '', code
            continue
        if not code and (kind not in parts or depth == MAX_DEPTH):
            raise MessageError(f'{kind} in it is not defined')
        for number in range(int(count or 1)):
            each = name if count is None else f'{name}.{number}'
            yield '' if code == 's' else each, code
            if not code:
                yield from _flatten_fields(parts, kind, f'{each}.', depth + 1)


#: Message type -> layout, with the rate about z.
LAYOUTS = {kind: parse_layout(text) for kind, text in DEFINITIONS.items()}


@cache
def _padded_struct(order: str, codes: str, offset: int) -> struct.Struct:
    """Return the format of numbers with padding, from an offset modulo 8 bytes on."""
    text = [order]
    for code in codes:
        size = struct.calcsize(code)
        text.append(f'{-offset % size}x{code}')
        offset += -offset % size + size
    return struct.Struct(''.join(text))


_UNPACK_LENGTH = {order: struct.Struct(f'{order}I').unpack_from for order in '<>'}


def parse(data: bytes, layout: _MessageLayout) -> tuple[int, tuple[float, ...]]:
    """Return the stamp of a message, in ns since 1970, and its numbers, or raise MessageError."""
    if data[:2] not in (b'\0\0', b'\0\1'):
        raise MessageError(f'a message begins with {data[:4].hex()}, which is not plain CDR')
    order = '<' if data[1] else '>'
    numbers: tuple[float, ...] = ()
    place = 4
    try:
        for size, codes in layout.runs:
            if size:
                place += -place % 4 + 4
                length = _UNPACK_LENGTH[order](data, place - 4)[0]
                place += (-(place - 4) % size if length else 0) + length * size
            if codes:
                run = _padded_struct(order, codes, (place - 4) % 8)
                numbers += run.unpack_from(data, place)
                place += run.size
    except (struct.error, OverflowError) as error:
        raise MessageError(f'a message of {len(data)} bytes is shorter than its definition '
                           'requires') from error
    return int(numbers[0]) * NSEC_PER_SEC + int(numbers[1]), numbers[2:]


def parse_frame(data: bytes) -> str:
    """Return the frame of the header with which a valid message begins."""
    length = _UNPACK_LENGTH['<' if data[1] else '>'](data, 12)[0]
    return data[16:16 + length].rstrip(b'\0').decode(errors='replace')


def serialize(stamp: int, frame: str, numbers: Sequence[float]) -> bytes:
    """Return a message with a header (stamp in ns since 1970) and numbers, as `parse` reads it."""
    text = frame.encode() + b'\0'
    head = struct.pack(f'<4xiII{len(text)}s', stamp // NSEC_PER_SEC, stamp % NSEC_PER_SEC,
                       len(text), text)
    return (b'\0\1\0\0' + head[4:] + bytes((4 - len(head)) % 8)
            + struct.pack(f'<{len(numbers)}d', *numbers))


def quaternion_heading(x: Number, y: Number, z: Number, w: Number) -> Number:
    """Return the rotation about z of a quaternion, rad, wrapped; nan if its norm is far from 1."""
    with np.errstate(invalid='ignore', over='ignore'):
        length = w * w + x * x + y * y + z * z
        heading = np.arctan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)
        return np.where((length > 0.5) & (length < 2.0), heading, np.nan)
