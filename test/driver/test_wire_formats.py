# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""What single wire formats have: axes, temperatures, checksums, values over several frames."""

import itertools
import math
import struct

from gyro_calibration.driver.protocols import find_protocol, Sample, Settings
import pytest

GRAVITY = 9.80665
ECORE, FIZOPTIKA, KVH_1750, RAZOR, WITMOTION = map(
    find_protocol, ('kvh_ecore', 'fizoptika', 'kvh_1750', 'razor', 'witmotion'))


def decoded(protocol, *frames, **settings):
    return protocol.decoder(Settings(**settings)).feed(b''.join(frames))


def test_a_frame_of_the_ecore_among_other_bytes_counts_where_another_one_follows():
    """One of 65536 places in other bytes is a frame by chance."""
    encode, decoder = ECORE.encoder(), ECORE.decoder()
    frames = [encode(Sample(rate)) for rate in (0.1, 0.2, 0.3)]
    assert decoder.feed(b'other' + frames[0] + b'bytes') == []
    found = [sample.output for byte in b''.join(frames) for sample in decoder.feed(bytes([byte]))]
    assert found == pytest.approx([0.1, 0.2, 0.3], abs=1e-4)
    assert decoder.discarded_bytes == len(b'other' + frames[0] + b'bytes')


# Fizoptika: values that are spread over two frames


ONE_COUNT = Settings(sensitivity=1.0)


def fizoptika(count, number=8, data=0):
    """Return a frame; the numbers from 8 on are reserved and hold nothing."""
    high, middle, low = count.to_bytes(3, 'big', signed=True)
    content = bytes([low, high, middle, number, data])
    return b'\xdd' + content + sum(content).to_bytes(2, 'big')


def values(*frames):
    return [(sample.temperature, dict(sample.health))
            for sample in decoded(FIZOPTIKA, *frames, sensitivity=1.0)]


@pytest.mark.parametrize('number, raw, temperature, health', [
    *((0, raw, degrees, {}) for raw, degrees in (
        (0, -50.0), (9830, 25.0), (1311, -40.0), (-1, -50.0), (0x7FFF, 200.0))),
    (2, 16384, None, {'supply_v': 5.0}), (2, -16384, None, {'supply_v': -5.0}),
    (4, 13107, None, {'source_current_a': 0.1}), (6, 13107, None, {'diagnostic_v': 1.0})])
def test_each_value_of_fizoptika_comes_in_two_frames(number, raw, temperature, health):
    high, low = raw.to_bytes(2, 'big', signed=True)
    first, second = values(fizoptika(1, number, high), fizoptika(2, number + 1, low))
    assert first == (None, {})
    assert second == (temperature if temperature is None else pytest.approx(temperature, abs=0.01),
                      pytest.approx(health, abs=1e-4))


def test_all_values_of_an_emulated_fizoptika_come_round_and_are_good():
    encode = FIZOPTIKA.encoder(ONE_COUNT)
    found = values(*(encode(Sample(0.0, -12.5, sequence=number)) for number in range(16)))
    assert ([temperature for temperature, _ in found if temperature is not None]
            == pytest.approx([-12.5] * 2, abs=0.01))
    health = {name: value for _, each in found for name, value in each.items()}
    assert health == pytest.approx(
        {'supply_v': 5.0, 'source_current_a': 0.1, 'diagnostic_v': 1.0}, abs=1e-4)
    assert health.keys() == FIZOPTIKA.normal_ranges.keys()
    assert all(low < health[name] < high for name, (low, high) in FIZOPTIKA.normal_ranges.items())


@pytest.mark.parametrize('count', [1, 2, 3])
def test_a_lost_frame_never_joins_halves_of_two_values(count):
    """Each byte of each value is another, so that any wrong pair would show."""
    frames = [fizoptika(k, k % 8, 0x0F * k + 1) for k in range(16)]
    right = values(*frames)
    for lost in itertools.combinations(range(16), count):
        rest = [k for k in range(16) if k not in lost]
        found = values(*(frames[k] for k in rest))
        assert all(each in (right[k], (None, {})) for k, each in zip(rest, found, strict=True))
        assert sum(each != (None, {}) for each in found) == sum(
            {2 * pair, 2 * pair + 1}.isdisjoint(lost) for pair in range(8))


def test_halves_with_garbage_between_are_not_joined():
    """Eight lost frames bring the right number back, but the low byte is of a later value."""
    halves = fizoptika(1, 2, 0x40), fizoptika(2, 3, 0x01)
    assert values(halves[0], b'\xdd\x00', halves[1]) == [(None, {}), (None, {})]
    decoder = FIZOPTIKA.decoder(ONE_COUNT)
    first, = decoder.feed(halves[0])
    decoder.reset()
    second, = decoder.feed(halves[1])
    assert first.health == second.health == {}


# KVH 1750: the frame of interface control document 56-0298, section 5.2.1


GOLDEN = bytes.fromhex('FE81FF5537A96A6E38586C1FB75BF862BF803E78BB650D283B0A37AC773D00284BFA34D8')
ROTATION = {'x': 2.019593e-5, 'y': 5.159911e-5, 'z': -1.3111248e-5}  # rad since the last sample
FORCE = {'x': -1.00191, 'y': -0.003495, 'z': 0.002109}  # g


def sealed(data):
    """Return a frame with its CRC."""
    remainder = 0xFFFFFFFF
    for byte in data:
        remainder ^= byte << 24
        for _ in range(8):
            remainder = (remainder << 1 ^ (0x04C11DB7 if remainder >> 31 else 0)) & 0xFFFFFFFF
    return data + remainder.to_bytes(4, 'big')


@pytest.mark.parametrize('axis', ['x', 'y', 'z'])
def test_the_frame_of_the_manual_of_the_1750_is_read_field_by_field(axis):
    sample, = decoded(KVH_1750, GOLDEN, axis=axis)
    # A new unit sends at 1000 Hz.
    assert sample.output == pytest.approx(ROTATION[axis] * 1000.0, rel=1e-6)
    assert sample.specific_force == pytest.approx(FORCE[axis] * GRAVITY, rel=2e-4)
    assert ((sample.temperature, sample.sequence, sample.missing, sample.time, sample.health)
            == (40.0, 61, 0, None, {}))


def test_a_frame_of_the_1750_is_written_as_the_manual_has_it():
    """But for the axes that are not read, which an emulated unit leaves at zero."""
    sample, = decoded(KVH_1750, GOLDEN)
    written = KVH_1750.encoder()(sample)
    assert (written[:4] == GOLDEN[:4] and written[12:16] == GOLDEN[12:16]
            and written[24:32] == GOLDEN[24:32])
    assert written == sealed(written[:32])


@pytest.mark.parametrize('settings, factor', [
    ({}, 1000.0),
    ({'increments': True, 'sample_rate': 3600.0}, 3600.0),
    ({'increments': False, 'sample_rate': 250.0}, 1.0),
    ({'increments': False, 'sensitivity': math.radians(1.0)}, math.radians(1.0)),
    ({'invert': True}, -1000.0),
])
def test_the_rate_is_the_angle_by_the_interval_that_the_1750_is_set_to(settings, factor):
    sample, = decoded(KVH_1750, GOLDEN, axis='y', **settings)
    assert sample.output == pytest.approx(ROTATION['y'] * factor, rel=1e-6)
    again, = decoded(KVH_1750, KVH_1750.encoder(Settings(**settings))(Sample(0.25)), **settings)
    assert again.output == pytest.approx(0.25, rel=1e-6)
    assert KVH_1750.nominal_rate(Settings(**settings)) == settings.get('sample_rate', 1000.0)


@pytest.mark.parametrize('axis', [0, 1, 2])
def test_only_the_status_bits_of_the_axis_count(axis):
    def with_status(status):
        return decoded(KVH_1750, sealed(GOLDEN[:28] + bytes([status]) + GOLDEN[29:32]), axis=name)
    gyro, accelerometer, name = 1 << axis, 1 << 4 + axis, 'xyz'[axis]
    sample, = with_status(gyro | accelerometer)
    assert sample.specific_force is not None
    sample, = with_status(0x77 & ~accelerometer)
    assert (sample.specific_force is None
            and sample.output == pytest.approx(ROTATION[name] * 1000.0, rel=1e-6))
    assert with_status(0x77 & ~gyro) == []


@pytest.mark.parametrize('value', [math.nan, math.inf, -math.inf, 3e38])
def test_a_float_that_is_no_rate_is_refused_and_one_that_is_no_force_left_out(value):
    decoder = KVH_1750.decoder(Settings(increments=False))
    assert decoder.feed(sealed(GOLDEN[:12] + struct.pack('>f', value) + GOLDEN[16:32])) == []
    assert (decoder.refused_samples, decoder.discarded_bytes) == (1, 0)
    sample, = decoded(KVH_1750, sealed(GOLDEN[:24] + struct.pack('>f', math.nan) + GOLDEN[28:32]))
    assert sample.specific_force is None


def test_what_the_1750_answers_between_frames_costs_no_sample():
    """The built-in test of the manual, section 5.3.1."""
    answer = bytes.fromhex('FE8100AA777F7B7F7F7F1E')
    decoder = KVH_1750.decoder()
    samples = decoder.feed(answer + GOLDEN + answer + GOLDEN)
    assert len(samples) == 2 and decoder.discarded_bytes == 22 and samples[1].missing == 0


# Razor: axes right and down, negated accelerations, and lines of other kinds


@pytest.mark.parametrize('axis, rate, force', [
    ('x', 0.01, -0.05),  # forward in both frames; what is sent is negated
    ('y', -0.02, -0.1),  # right becomes left
    ('z', 0.03, 1.0),  # down becomes up, and what holds the sensor up is up
])
def test_axes_and_accelerations_of_a_razor_are_turned_as_in_ros(axis, rate, force):
    """As in the ROS driver: x, -y, -z of the rates and -x, y, z of the accelerations."""
    # at rest and level the axis that points down has 256
    line = b'#YPRAG=-142.28,-5.38,33.52,12.8,-25.6,256.00,0.01,0.02,-0.03\r\n'
    sample, = decoded(RAZOR, line, axis=axis)
    assert (sample.output == pytest.approx(rate)
            and sample.specific_force == pytest.approx(force * GRAVITY))
    again, = decoded(RAZOR, RAZOR.encoder(Settings(axis=axis))(sample), axis=axis)
    assert (again.output == pytest.approx(sample.output)
            and again.specific_force == pytest.approx(sample.specific_force, abs=0.001))


def test_a_line_of_a_razor_is_written_as_the_firmware_prints_it():
    assert (RAZOR.encoder()(Sample(-0.25, specific_force=GRAVITY))
            == b'#YPRAG=0.00,0.00,0.00,0.00,0.00,256.00,0.00,0.00,0.25\r\n')


@pytest.mark.parametrize('line', [
    b'#YPRAG=1,2,3,4,5,6,7,8', b'#YPRAG=1,2,3,4,5,6,7,8,9,10', b'#YPRAG=1,2,3,4,5,6,7,8,nan',
    b'#YPRAG=1,2,3,4,5,6,7,8,', b'YPRAG=1,2,3,4,5,6,7,8,9', b'#YPRAG=1,2,3,4,5,6,7,8,0x9'])
def test_other_lines_of_a_razor_are_discarded(line):
    decoder = RAZOR.decoder()
    assert decoder.feed(line + b'\r\n') == [] and decoder.discarded_bytes == len(line)


def test_the_angles_that_a_razor_sends_until_it_is_asked_for_more_are_in_order_but_no_sample():
    decoder = RAZOR.decoder()
    assert decoder.feed(b'#YPR=-142.28,-5.38,33.52\r\n') == [] and decoder.discarded_bytes == 0
    assert RAZOR.startup == b'#ox#o1'


# WitMotion: accelerations in frames of their own


def witmotion(kind, *numbers):
    data = bytes([0x55, kind]) + struct.pack('<4h', *numbers)
    return data + bytes([sum(data) % 256])


@pytest.mark.parametrize('axis, rate, force',
                         [('x', 100, 4), ('y', -200, -5), ('z', 300, 2048)])
def test_the_axis_chooses_rate_and_acceleration_of_a_witmotion(axis, rate, force):
    sample, = decoded(WITMOTION, witmotion(0x51, 4, -5, 2048, 2500),
                      witmotion(0x52, 100, -200, 300, 2534), axis=axis)
    assert sample.output == pytest.approx(math.radians(2000.0 * rate / 32768))
    assert (sample.specific_force == pytest.approx(16.0 * GRAVITY * force / 32768)
            and sample.temperature == pytest.approx(25.34))


def test_an_acceleration_belongs_to_the_next_rate_only():
    force, rate = witmotion(0x51, 0, 0, 2048, 0), witmotion(0x52, 0, 0, 1, 0)
    assert [sample.specific_force is None
            for sample in decoded(WITMOTION, force, rate, rate, force, rate)] == [
        False, True, False]
    assert decoded(WITMOTION, force, b'\x55\x52', rate)[0].specific_force is None


def test_frames_of_other_kinds_of_a_witmotion_are_passed_over():
    decoder = WITMOTION.decoder()
    samples = decoder.feed(b''.join(witmotion(kind, 1, 2, 3, 4)
                                    for kind in (0x50, 0x51, 0x52, 0x53, 0x54, 0x59, 0x5A)))
    assert len(samples) == 1 and decoder.discarded_bytes == 0


@pytest.mark.parametrize('temperature', [-40.0, -1.0, 0.0, 25.0, 85.0])
@pytest.mark.parametrize('protocol, frame', [
    (WITMOTION, lambda degc: witmotion(0x52, 0, 0, 0, round(100 * degc))),
    (KVH_1750, lambda degc: sealed(GOLDEN[:30] + struct.pack('>h', round(degc))))],
    ids=['witmotion', 'kvh_1750'])
def test_a_temperature_has_a_sign(protocol, frame, temperature):
    for data in (frame(temperature), protocol.encoder()(Sample(0.1, temperature))):
        sample, = decoded(protocol, data)
        assert sample.temperature == pytest.approx(temperature)
