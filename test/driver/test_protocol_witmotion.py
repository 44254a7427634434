# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""WitMotion: signs, temperatures, accelerations, and frames of other kinds between."""

import math
import struct

from gyro_calibration.driver.protocols import find_protocol, Sample, Settings
import pytest

PROTOCOL = find_protocol('witmotion')
GRAVITY = 9.80665


def frame(kind, *numbers):
    data = bytes([0x55, kind]) + struct.pack('<4h', *numbers)
    return data + bytes([sum(data) % 256])


def decoded(*frames, axis='z'):
    return PROTOCOL.decoder(Settings(axis=axis)).feed(b''.join(frames))


def test_the_axis_chooses_rate_and_acceleration():
    for axis, rate, force in (('x', 100, 4), ('y', -200, -5), ('z', 300, 2048)):
        sample, = decoded(frame(0x51, 4, -5, 2048, 2500),
                          frame(0x52, 100, -200, 300, 2534), axis=axis)
        assert sample.output == pytest.approx(math.radians(2000.0 * rate / 32768))
        assert (sample.specific_force == pytest.approx(16.0 * GRAVITY * force / 32768)
                and sample.temperature == pytest.approx(25.34))


@pytest.mark.parametrize('temperature', [-40.0, -0.01, 0.0, 61.7])
def test_the_temperature_has_a_sign(temperature):
    assert (decoded(frame(0x52, 0, 0, 0, round(100 * temperature)))[0].temperature
            == pytest.approx(temperature))
    assert (decoded(PROTOCOL.encoder()(Sample(0.1, temperature)))[0].temperature
            == pytest.approx(temperature))


def test_an_acceleration_belongs_to_the_next_rate_only():
    force, rate = frame(0x51, 0, 0, 2048, 0), frame(0x52, 0, 0, 1, 0)
    assert ([sample.specific_force is None for sample in decoded(force, rate, rate, force, rate)]
            == [False, True, False])
    assert decoded(force, b'\x55\x52', rate)[0].specific_force is None


def test_frames_of_other_kinds_are_passed_over():
    decoder = PROTOCOL.decoder()
    samples = decoder.feed(b''.join(frame(kind, 1, 2, 3, 4)
                                    for kind in (0x50, 0x51, 0x52, 0x53, 0x54, 0x59, 0x5A)))
    assert len(samples) == 1 and decoder.discarded_bytes == 0
