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

After the header ``FE 81 FF 55`` come rotations about x, y, z and accelerations along them in g
(32-bit floats), status, a sequence of 0 to 127, the temperature in whole degC, and a CRC, all with
the most significant byte first. The CRC-32 has the polynomial 04C11DB7 and the initial value
FFFFFFFF, is neither reflected nor inverted, and covers the first 32 bytes. Bits 0 to 2 of the
status are 1 if the gyro of x, y, z is valid, bits 4 to 6 likewise for the accelerometers; only
those of the ``axis`` are used. A turn is positive counter-clockwise, seen from the tip of the
axis, and the acceleration of an axis that points up is 1 g. The line is RS-422.

A new unit sends the angle in rad since its last sample. The rate is that angle divided by the
interval that was set with ``=DR``: 1000 Hz, or ``sample_rate``, also where a signal at MSYNC
requests the samples. A wrong ``sample_rate`` makes all rates wrong by the same factor; the
diagnostics and ``record`` warn of 5 % or more. After ``=ROTFMT,RATE`` set ``increments`` to never.
If the unit sends degrees, set ``sensitivity`` to 0.0174533. A clock error of the unit of 100 ppm
is a scale factor error of 100 ppm, which the calibration includes.

``FE81FF55 37A96A6E 38586C1F B75BF862 BF803E78 BB650D28 3B0A37AC 77 3D 0028 4BFA34D8`` is
2.0196e-5, 5.1599e-5 and -1.3111e-5 rad, -1.00191, -0.003495 and 0.002109 g, all valid, sequence
61, 40 degC. At 1000 Hz these are 0.0202, 0.0516 and -0.0131 rad/s.

Source: KVH 1775 IMU interface control document, 56-0298 revision B: format A (tables 5-1, 5-2),
status (5-8), CRC (5-9), the example (5.2.1), data rates (8.8), senses (section 9). Not verified:
models other than the 1775, and the 1000 Hz of a new unit, which public drivers expect. Not
supported: formats B and C (headers ``FE 81 FF 56`` and ``57``), and temperatures in other units.
"""

from functools import partial
import math
import struct
import zlib

from gyro_calibration.driver.protocols.protocol import (
    FrameSplitter, Protocol, Reading, ROOM_TEMPERATURE, Sample, Settings, stateless,
    to_signed_count)
from gyro_calibration.logs.columns import STANDARD_GRAVITY

_HEADER = b'\xfe\x81\xff\x55'
_FRAME = struct.Struct('>4s3f3fBBh')
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


def _write(value: float, sample: Sample, settings: Settings) -> bytes:
    axis = 'xyz'.index(settings.axis)
    rotation, acceleration, status = [0.0] * 3, [0.0] * 3, 0x77  # all valid
    rotation[axis] = value
    if sample.specific_force is None:
        status &= ~(1 << 4 + axis)
    else:
        acceleration[axis] = sample.specific_force / STANDARD_GRAVITY
    temperature = ROOM_TEMPERATURE if sample.temperature is None else sample.temperature
    frame = _FRAME.pack(_HEADER, *rotation, *acceleration, status, (sample.sequence or 0) % 128,
                        to_signed_count(temperature))
    return frame + _checksum(frame)


KVH_1750 = Protocol(
    name='kvh_1750', text=__doc__,
    baud=921600, rate=1000.0, sensitivity=1.0,
    splitter=partial(FrameSplitter, rb'\xfe\x81\xff\x55.{32}', 36,
                     lambda frame: _checksum(frame[:32]) == frame[32:]),
    parser=stateless(_parse), writer=stateless(_write),
    full_scale=math.radians(500.0),  # the input range is 490 deg/s
    noise_density=math.radians(1.0 / 3600.0),  # 1 deg/h/√Hz for the 1725, others less
    increments=True, modulus=128)
