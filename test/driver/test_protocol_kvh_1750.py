# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The KVH 1750: the frame of the manual field by field, the CRC, and the settings."""

import math
import struct

from gyro_calibration.driver.protocols import find_protocol, Sample, Settings
from gyro_calibration.driver.protocols.protocol import FrameSplitter
import pytest

#: Interface control document 56-0298, section 5.2.1.
GOLDEN = bytes.fromhex('FE81FF5537A96A6E38586C1FB75BF862BF803E78BB650D283B0A37AC773D00284BFA34D8')
ROTATION = {'x': 2.019593e-5, 'y': 5.159911e-5, 'z': -1.3111248e-5}  # rad since the last sample
FORCE = {'x': -1.00191, 'y': -0.003495, 'z': 0.002109}  # g
GRAVITY = 9.80665
PROTOCOL = find_protocol('kvh_1750')


def with_status(status, axis='z'):
    """Return what the golden frame says with another status, and a CRC of its own."""
    return decoded(sealed(GOLDEN[:28] + bytes([status]) + GOLDEN[29:32]), axis)


def sealed(data):
    remainder = 0xFFFFFFFF
    for byte in data:
        remainder ^= byte << 24
        for _ in range(8):
            remainder = (remainder << 1 ^ (0x04C11DB7 if remainder >> 31 else 0)) & 0xFFFFFFFF
    return data + remainder.to_bytes(4, 'big')


def decoded(data, axis='z', **settings):
    return PROTOCOL.decoder(Settings(axis=axis, **settings)).feed(data)


@pytest.mark.parametrize('axis', ['x', 'y', 'z'])
def test_the_frame_of_the_manual_is_read_field_by_field(axis):
    sample, = decoded(GOLDEN, axis)
    # A new unit sends at 1000 Hz.
    assert sample.output == pytest.approx(ROTATION[axis] * 1000.0, rel=1e-6)
    assert sample.specific_force == pytest.approx(FORCE[axis] * GRAVITY, rel=2e-4)
    assert ((sample.temperature, sample.sequence, sample.missing, sample.time, sample.health)
            == (40.0, 61, 0, None, {}))


def test_a_frame_is_written_as_the_manual_has_it():
    """But for the axes that are not read, which an emulated unit leaves at zero."""
    sample, = decoded(GOLDEN)
    written = PROTOCOL.encoder()(sample)
    assert (written[:4] == GOLDEN[:4] and written[12:16] == GOLDEN[12:16]
            and written[24:32] == GOLDEN[24:32])
    assert written == sealed(written[:32])


@pytest.mark.parametrize('settings, factor', [
    ({}, 1000.0),
    ({'sample_rate': 250.0}, 250.0),
    ({'increments': True, 'sample_rate': 3600.0}, 3600.0),
    ({'increments': False}, 1.0),
    ({'increments': False, 'sample_rate': 250.0}, 1.0),
    ({'increments': False, 'sensitivity': math.radians(1.0)}, math.radians(1.0)),
    ({'invert': True}, -1000.0),
])
def test_the_rate_is_the_angle_by_the_interval_that_the_unit_is_set_to(settings, factor):
    sample, = decoded(GOLDEN, 'y', **settings)
    assert sample.output == pytest.approx(ROTATION['y'] * factor, rel=1e-6)
    assert (decoded(PROTOCOL.encoder(Settings(**settings))(Sample(0.25)), **settings)[0].output
            == pytest.approx(0.25, rel=1e-6))
    assert PROTOCOL.nominal_rate(Settings(**settings)) == settings.get('sample_rate', 1000.0)


@pytest.mark.parametrize('axis', [0, 1, 2])
def test_only_the_bits_of_the_axis_count(axis):
    gyro, accelerometer, name = 1 << axis, 1 << 4 + axis, 'xyz'[axis]
    sample, = with_status(gyro | accelerometer, name)
    assert sample.specific_force is not None
    sample, = with_status(0x77 & ~accelerometer, name)
    assert (sample.specific_force is None
            and sample.output == pytest.approx(ROTATION[name] * 1000.0, rel=1e-6))
    assert with_status(0x77 & ~gyro, name) == []


@pytest.mark.parametrize('temperature', [-40, -1, 0, 25, 85])
def test_the_temperature_has_a_sign(temperature):
    sample, = decoded(sealed(GOLDEN[:30] + struct.pack('>h', temperature)))
    assert sample.temperature == temperature
    again, = decoded(PROTOCOL.encoder()(Sample(0.1, temperature + 0.3)))
    assert again.temperature == temperature


@pytest.mark.parametrize('value', [math.nan, math.inf, -math.inf, 3e38])
def test_a_float_that_is_no_rate_is_refused_and_one_that_is_no_force_left_out(value):
    decoder = PROTOCOL.decoder(Settings(increments=False))
    assert decoder.feed(sealed(GOLDEN[:12] + struct.pack('>f', value) + GOLDEN[16:32])) == []
    assert (decoder.refused_samples, decoder.discarded_bytes) == (1, 0)
    sample, = decoded(sealed(GOLDEN[:24] + struct.pack('>f', math.nan) + GOLDEN[28:32]))
    assert sample.specific_force is None


def test_no_two_flipped_bits_get_past_the_crc():
    """All 41 thousand pairs."""
    splitter = PROTOCOL.splitter()
    assert isinstance(splitter, FrameSplitter)
    whole, past = int.from_bytes(GOLDEN, 'big'), 0
    flips = [1 << bit for bit in range(8 * len(GOLDEN))]
    for place, first in enumerate(flips):
        past += sum(splitter._is_intact((whole ^ first ^ second).to_bytes(36, 'big'))
                    for second in flips[:place])
    assert past == 0


def test_what_the_unit_answers_between_frames_costs_no_sample():
    """The built-in test of the manual, section 5.3.1."""
    answer = bytes.fromhex('FE8100AA777F7B7F7F7F1E')
    decoder = PROTOCOL.decoder()
    samples = decoder.feed(answer + GOLDEN + answer + GOLDEN)
    assert len(samples) == 2 and decoder.discarded_bytes == 22 and samples[1].missing == 0
