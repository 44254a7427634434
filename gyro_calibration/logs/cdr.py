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
the fields, each aligned to its own size. All messages here have a header, some a second text, the
frame of the child, and then numbers of 64 bits.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
import struct

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
_NESTED_DEFINITIONS = {
    'builtin_interfaces/Time': 'int32 sec\nuint32 nanosec',
    'std_msgs/Header': 'builtin_interfaces/Time stamp\nstring frame_id',
    **{f'geometry_msgs/{name}': '\n'.join(f'float64 {each}' for each in axes)
       for name, axes in (('Point', 'xyz'), ('Vector3', 'xyz'), ('Quaternion', 'xyzw'))},
    'geometry_msgs/Pose': 'geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation',
    'geometry_msgs/Twist': 'geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular',
    'geometry_msgs/Transform': 'geometry_msgs/Vector3 translation\n'
    'geometry_msgs/Quaternion rotation',
    'geometry_msgs/PoseWithCovariance': 'geometry_msgs/Pose pose\nfloat64[36] covariance',
    'geometry_msgs/TwistWithCovariance': 'geometry_msgs/Twist twist\nfloat64[36] covariance',
}


@dataclass(frozen=True)
class _MessageLayout:
    """The content of a message type after its header."""

    fields: str  # as in a message definition
    size: int  # number of the numbers
    #: Quantity -> place of its number, or of its first one: of a rotation x, y, z, w follow each
    #: other, of a rate and a specific force x, y, z.
    places: Mapping[str, int]
    has_child_frame: bool = False


#: Message type -> layout.
LAYOUTS = {
    IMU: _MessageLayout("""geometry_msgs/Quaternion orientation
float64[9] orientation_covariance
geometry_msgs/Vector3 angular_velocity
float64[9] angular_velocity_covariance
geometry_msgs/Vector3 linear_acceleration
float64[9] linear_acceleration_covariance""", 37, {
        'rotation': 0, 'rotation variance': 4, 'rate': 13, 'rate variance': 16, 'force': 25,
        'force variance': 28}),
    TEMPERATURE: _MessageLayout('float64 temperature\nfloat64 variance', 2, {'temperature': 0}),
    ODOMETRY: _MessageLayout("""string child_frame_id
geometry_msgs/PoseWithCovariance pose
geometry_msgs/TwistWithCovariance twist""", 85, {'rotation': 3, 'rate': 46}, True),
    POSE: _MessageLayout('geometry_msgs/Pose pose', 7, {'rotation': 3}),
    TWIST: _MessageLayout('geometry_msgs/Twist twist', 6, {'rate': 3}),
    **{f'geometry_msgs/msg/{name}': layout for name, layout in {
        'PoseWithCovarianceStamped': _MessageLayout('geometry_msgs/PoseWithCovariance pose', 43,
                                                    {'rotation': 3}),
        'TransformStamped': _MessageLayout(
            'string child_frame_id\ngeometry_msgs/Transform transform', 7, {'rotation': 3}, True),
        'QuaternionStamped': _MessageLayout('geometry_msgs/Quaternion quaternion', 4,
                                            {'rotation': 0}),
        'TwistWithCovarianceStamped': _MessageLayout('geometry_msgs/TwistWithCovariance twist',
                                                     42, {'rate': 3}),
        'Vector3Stamped': _MessageLayout('geometry_msgs/Vector3 vector', 3, {'rate': 0})}.items()}}

#: Message type -> definition as ROS 2 writes it, for recorders.
DEFINITIONS: dict[str, str] = {}
for _kind, _layout in LAYOUTS.items():
    DEFINITIONS[_kind] = f'std_msgs/Header header\n{_layout.fields}\n'
    for _name, _part in reversed(_NESTED_DEFINITIONS.items()):
        if f'{_name} ' in DEFINITIONS[_kind]:
            DEFINITIONS[_kind] += f'{_DEFINITION_SEPARATOR}\nMSG: {_name}\n{_part}\n'


class MessageError(ValueError):
    """Bytes are not a message of the expected type."""


def parse(data: bytes, layout: _MessageLayout) -> tuple[int, tuple[float, ...]]:
    """Return the stamp of a message, in ns since 1970, and its numbers, or raise MessageError."""
    if data[:2] not in (b'\0\0', b'\0\1'):
        raise MessageError(f'a message begins with {data[:4].hex()}, which is not plain CDR')
    order = '<' if data[1] else '>'
    try:
        seconds, nanoseconds, length = struct.unpack_from(f'{order}iII', data, 4)
        place = 16 + length
        if layout.has_child_frame:
            place += -place % 4
            place += 4 + struct.unpack_from(f'{order}I', data, place)[0]
        place += (4 - place) % 8
        numbers = struct.unpack_from(f'{order}{layout.size}d', data, place)
    except (struct.error, OverflowError) as error:
        raise MessageError(f'a message of {len(data)} bytes is shorter than its type '
                           'requires') from error
    return seconds * NSEC_PER_SEC + nanoseconds, numbers


def parse_frame(data: bytes) -> str:
    """Return the frame of the header with which a valid message begins."""
    length = struct.unpack_from('<I' if data[1] else '>I', data, 12)[0]
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
