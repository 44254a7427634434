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
KVH 1725, 1750, 1760 and 1775, fibre-optic gyros with up to three axes: frames of 36 bytes.

After the header FE 81 FF 55 come three rotations and three accelerations in g (32-bit floats), a
status, a sequence of 0 to 127, the temperature in whole degC and the CRC, all with the most
significant byte first. A bit of the status stands for each axis: 0 to 2 for the gyros, 4 to 6 for
the accelerometers, 1 for valid.

A rotation is the angle in rad since the last sample, unless the unit is set to send rates
(``=ROTFMT,RATE``). An angle is divided by the interval of the data rate that the unit is set to
(``=DR``): 1000 Hz, or `Settings.sample_rate`. A turn is positive counter-clockwise, seen from the
tip of the axis, and the acceleration of an axis that points up is 1 g.

Source: KVH 1775 IMU interface control document, 56-0298 revision B: format A (tables 5-1, 5-2),
status (5-8), CRC (5-9), the example (5.2.1), data rates (8.8), senses (section 9); that a new unit
sends at 1000 Hz is what public drivers expect. Formats B and C, and temperatures in other units,
are not read.

"""

from __future__ import annotations

from functools import partial
import math
import struct
import zlib

from gyro_calibration.driver.protocols.protocol import (
    FrameSplitter,
    Protocol,
    Reading,
    ROOM_TEMPERATURE,
    Settings,
    STANDARD_GRAVITY,
    stateless,
    to_signed_count,
    WrittenReading,
)

_HEADER = b'\xfe\x81\xff\x55'
_FRAME = struct.Struct('>4s3f3fBBh')
_MODULUS = 128
_ALL_VALID = 0x77
_REVERSED_BITS = bytes(int(f'{byte:08b}'[::-1], 2) for byte in range(256))


def _checksum(data: bytes) -> bytes:
    """Return the CRC-32 of zlib with the bits in reverse order and not inverted at the end."""
    mirrored = zlib.crc32(data.translate(_REVERSED_BITS)) ^ 0xFFFFFFFF
    return mirrored.to_bytes(4, 'little').translate(_REVERSED_BITS)


def _parse(frame: bytes, settings: Settings) -> Reading:
    axis = 'xyz'.index(settings.axis)
    _, *values, status, sequence, temperature = _FRAME.unpack_from(frame)
    has_force = status >> 4 + axis & 1 and math.isfinite(values[3 + axis])
    return Reading(value=values[axis], valid=bool(status >> axis & 1),
                   temperature=float(temperature), sequence=sequence,
                   specific_force=values[3 + axis] * STANDARD_GRAVITY if has_force else None)


def _write(reading: WrittenReading, settings: Settings) -> bytes:
    axis = 'xyz'.index(settings.axis)
    rotation, acceleration, status = [0.0] * 3, [0.0] * 3, _ALL_VALID
    rotation[axis] = reading.value
    if reading.specific_force is None:
        status &= ~(1 << 4 + axis)
    else:
        acceleration[axis] = reading.specific_force / STANDARD_GRAVITY
    if not reading.valid:
        status &= ~(1 << axis)
    temperature = ROOM_TEMPERATURE if reading.temperature is None else reading.temperature
    frame = _FRAME.pack(_HEADER, *rotation, *acceleration, status, reading.sequence % _MODULUS,
                        to_signed_count(temperature))
    return frame + _checksum(frame)


KVH_1750 = Protocol(
    name='kvh_1750', description='KVH 1725, 1750, 1760, 1775 fibre-optic gyros, binary',
    baud=921600, rate=1000.0, sensitivity=1.0,
    splitter=partial(FrameSplitter, rb'\xfe\x81\xff\x55.{32}', 36,
                     lambda frame: _checksum(frame[:32]) == frame[32:]),
    parser=stateless(_parse), writer=stateless(_write),
    full_scale=math.radians(500.0),  # the input range is 490 deg/s
    noise_density=math.radians(1.0 / 3600.0),  # 1 deg/h/√Hz for the 1725, others less
    increments=True, modulus=_MODULUS, check_settings=lambda settings: None)
