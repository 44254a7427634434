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
The ROS 2 messages that a recording of a gyro is made of, as bytes; no ROS is needed for them.

A message is in the common data representation (CDR): four bytes give the order of bytes, then come
the fields, each aligned to its own size. All messages here are a header, perhaps another text, and
then only numbers of eight bytes.

"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
import struct

from gyro_calibration.logs.log import Number
import numpy as np

NSEC_PER_SEC = 1_000_000_000
IMU, TEMPERATURE = 'sensor_msgs/msg/Imu', 'sensor_msgs/msg/Temperature'
ODOMETRY, POSE, TWIST = ('nav_msgs/msg/Odometry', 'geometry_msgs/msg/PoseStamped',
                         'geometry_msgs/msg/TwistStamped')

#: In element 0 of the covariance of a quantity that the message does not report (REP-145).
NOT_REPORTED = -1.0

UNMEASURED_VARIANCE = 1e6
"""
Variance of what a gyro with one axis does not measure, in (rad/s)², (m/s²)², rad² or m².

All zeros would say that the whole covariance is unknown, z included. A standard deviation of
1000 rad/s gives these axes no weight in a filter, and the matrix can still be inverted.

"""

#: Places of quantities among the numbers of an Imu: the quaternion x, y, z, w first, each quantity
#: followed by its covariance.
ORIENTATION_COVARIANCE, RATE_Z, RATE_COVARIANCE, FORCE_Z, FORCE_COVARIANCE = 4, 15, 16, 27, 28


class MessageError(ValueError):
    """Bytes are not a message of the kind that they should be."""


@dataclass(frozen=True)
class Layout:
    """
    How a kind of message lies in bytes, after its header.

    Attributes
    ----------
    texts : how many texts stand before the numbers
    numbers : how many numbers there are
    kept : which of them say something of a gyro, a temperature or a reference

    """

    texts: int
    numbers: int
    kept: tuple[int, ...]


_QUATERNION_OF_POSE = (3, 4, 5, 6)

#: Kind -> layout, of an Imu for z. A heading comes of four numbers, the quaternion x, y, z, w.
LAYOUTS: Mapping[str, Layout] = {
    IMU: Layout(0, 37, (0, 1, 2, 3, ORIENTATION_COVARIANCE, RATE_Z, RATE_COVARIANCE, FORCE_Z,
                        FORCE_COVARIANCE)),
    TEMPERATURE: Layout(0, 2, (0,)),
    ODOMETRY: Layout(1, 85, (*_QUATERNION_OF_POSE, 48)),
    POSE: Layout(0, 7, _QUATERNION_OF_POSE),
    TWIST: Layout(0, 6, (5,)),
}


def layout(kind: str, axis: str) -> Layout:
    """Return the layout of a kind; of an Imu, rate and force about and along an axis are kept."""
    found = LAYOUTS[kind]
    if kind != IMU:
        return found
    back = 'zyx'.index(axis)
    kept = tuple(place - back if place in (RATE_Z, FORCE_Z) else place for place in found.kept)
    return replace(found, kept=kept)


def parse(data: bytes, layout: Layout) -> tuple[int, tuple[float, ...]]:
    """
    Return the stamp of a message, in ns since 1970, and its numbers.

    Raises
    ------
    MessageError : the bytes are no such message

    """
    if data[:2] not in (b'\0\0', b'\0\1'):
        raise MessageError(f'a message begins with {data[:4].hex()}, which is not plain CDR')
    order = '<' if data[1] else '>'
    try:
        seconds, nanoseconds, length = struct.unpack_from(f'{order}iII', data, 4)
        place = 16 + length
        for _ in range(layout.texts):
            place += -place % 4
            place += 4 + struct.unpack_from(f'{order}I', data, place)[0]
        # Aligned to eight bytes from the fifth on.
        return seconds * NSEC_PER_SEC + nanoseconds, struct.unpack_from(
            f'{order}{layout.numbers}d', data, place + (4 - place) % 8)
    except struct.error as error:
        raise MessageError(f'a message of {len(data)} bytes is too short for what it should '
                           'hold') from error


def serialize(stamp: int, frame: str, numbers: Sequence[float]) -> bytes:
    """Return a message of a header, with a stamp in ns since 1970, and of numbers, for `parse`."""
    text = frame.encode() + b'\0'
    head = struct.pack(f'<4xiII{len(text)}s', stamp // NSEC_PER_SEC, stamp % NSEC_PER_SEC,
                       len(text), text)
    return (b'\0\1\0\0' + head[4:] + bytes((4 - len(head)) % 8)
            + struct.pack(f'<{len(numbers)}d', *numbers))


def heading_of(x: Number, y: Number, z: Number, w: Number) -> Number:
    """Return the rotation about z of a quaternion, rad, wrapped; nan if its norm is far from 1."""
    with np.errstate(invalid='ignore', over='ignore'):
        length = w * w + x * x + y * y + z * z
        heading = np.arctan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)
        return np.where((length > 0.5) & (length < 2.0), heading, np.nan)


_LINE = '=' * 80
_HEADER = f"""{_LINE}
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
{_LINE}
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""

#: Kind -> its fields, as ROS 2 writes them; a recording carries them for programs that do not know
#: the kind.
DEFINITIONS: Mapping[str, str] = {
    IMU: f"""std_msgs/Header header
geometry_msgs/Quaternion orientation
float64[9] orientation_covariance
geometry_msgs/Vector3 angular_velocity
float64[9] angular_velocity_covariance
geometry_msgs/Vector3 linear_acceleration
float64[9] linear_acceleration_covariance
{_LINE}
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
{_LINE}
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
{_HEADER}""",
    TEMPERATURE: f"""std_msgs/Header header
float64 temperature
float64 variance
{_HEADER}""",
}
