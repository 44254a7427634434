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
The wire formats: their bytes, bad bytes, settings, recognition, and what single ones have.

Any bytes, in any pieces, are decoded in test_fuzz.py: alike, and right again after two frames.
"""

from dataclasses import replace
import itertools
import math
import random
import struct

from fake_port import SETTINGS
from gyro_calibration.driver.protocols import (
    BAUDS, find_protocol, PROTOCOLS, recognize_protocol, Sample, Settings)
import pytest

ALL = sorted(PROTOCOLS)
DPS = math.radians(1.0)
GRAVITY = 9.80665

COARSE = Settings(sensitivity=0.00875 * DPS)  # a MinIMU-9 set to 250 deg/s still has 16 bits
# Format, settings other than the usual ones, bytes, deg/s counter-clockwise as in REP-103; the
# DSP-3000 counts clockwise positive.
VECTORS = [
    # technical manual, section 2.1
    ('kvh_dsp3000', None, b'       0.015733   1\r\n', -0.015733),
    ('kvh_dsp3000', None, b'    -120.500000   1\r\n', 120.5),
    # Count +1000, worked out by hand from the layout of a public decoder.
    ('kvh_ecore', None, bytes.fromhex('8A40000000000768'), 1.83),
    # As the firmware prints it; 0.07 deg/s a count.
    ('minimu9', None, b'!ANG:0.10,-0.20,90.00,AN:1,2,-100,4,5,250,7,8,9\r\n', -7.0),
    ('minimu9', COARSE, b'!ANG:0,0,0,AN:0,0,32000,0,0,0,0,0,0\r\n', 280.0),
    *(('minimu9', Settings(axis=axis), b'!ANG:0.10,-0.20,90.00,AN:100,200,300,4,5,250,7,8,9\r\n',
       rate) for axis, rate in (('x', 7.0), ('y', 14.0), ('z', 21.0))),
    # 27880 counts, worked out by hand from the layout.
    ('fizoptika', None, bytes.fromhex('DDE8006C02130169'), 1.0),
    ('fizoptika', None, bytes.fromhex('DD18FF93021301BF'), -1.0),
    # 512 of 32768 of 2000 deg/s, at 25 degC, worked out by hand.
    ('witmotion', None, bytes.fromhex('5552000000000002C40976'), 31.25),
    # As in the comments of the firmware, but for a sign.
    ('razor', None, b'#YPRAG=-142.28,-5.38,33.52,0.1,0.1,1.0,0.01,0.01,-0.01\r\n', 0.01 / DPS),
    ('csv', None, b'12.5,-3.25,24.5\r\n', -3.25),
    ('csv', Settings(columns=('gyro_rad_s',)), b'0.5\r', 0.5 / DPS),
    ('csv', Settings(columns=('temperature_degc', 'gyro_counts', 'time_s'), sensitivity=0.001),
     b'20,500,1\r', 0.5 / DPS),
    ('csv', Settings(columns=('sequence', 'gyro_dps', 'voltage')), b'x,90,?\r', 90.0),
    ('csv', Settings(full_scale=100.0), b'0.1,5000.0,20.0\n', 5000.0),
]


def opened(name, settings=None):
    """Return a decoder that knows where the next frame begins."""
    decoder = find_protocol(name).decoder(settings or SETTINGS[name])
    decoder.feed(find_protocol(name).preamble)
    return decoder


@pytest.mark.parametrize(('name', 'settings', 'data', 'rate'), VECTORS)
def test_frames_of_the_documented_layout_are_read_by_the_settings(name, settings, data, rate):
    sample, = opened(name, settings).feed(data)
    assert sample.output == pytest.approx(rate * DPS, rel=1e-9)


def sent(name, sample, settings=None):
    settings = settings or SETTINGS[name]
    return opened(name, settings).feed(find_protocol(name).encoder(settings)(sample))


def step(name):
    """Return the smallest rate that a format can send, rad/s; half of it is the rounding error."""
    rates = (received.output for power in range(-40, 0)
             for received in sent(name, Sample(2.0 ** power)))
    return min(rate for rate in rates if rate)


@pytest.mark.parametrize('name', ALL)
def test_decoding_undoes_encoding(name):
    largest = 0.999 * find_protocol(name).effective_full_scale(SETTINGS[name])
    assert 0.0 < step(name) < 0.011
    for invert, part in itertools.product((True, False), (-1.0, -0.3, 0.0, 1e-3, 1.0)):
        sample, = sent(name, Sample(part * largest), replace(SETTINGS[name], invert=invert))
        assert sample.output == pytest.approx(part * largest, abs=0.51 * step(name), rel=1e-7)


@pytest.mark.parametrize('name', ALL)
def test_a_temperature_that_cannot_be_sent_does_not_stop_an_emulated_gyro(name):
    """A log has nan where its sensor failed."""
    for value in (math.nan, math.inf, 1e9, -1e9):
        sample, = sent(name, Sample(0.1, value, 0.1, specific_force=math.nan))
        assert sample.output == pytest.approx(0.1, abs=step(name), rel=1e-7)


def test_csv_takes_what_its_columns_name_by_the_words_of_the_log_format():
    sample, = sent('csv', Sample(0.5, 21.25, 1700000000.125))
    assert (sample.time, sample.temperature, sample.specific_force, sample.health) == (
        1700000000.125, 21.25, None, {})
    settings = Settings(columns=('supply_v', 'gyro_rad_s', 'acceleration_mps2'))
    first, second = opened('csv', settings).feed(b'4.98,0.5,-9.81\nnan,0.5,\n')
    assert (first.health, first.specific_force, second.health, second.specific_force) == (
        {'supply_v': 4.98}, -9.81, {}, None)
    again, = sent('csv', first, settings)
    assert again == first


@pytest.mark.parametrize('name', ['kvh_dsp3000', 'minimu9', 'razor', 'csv'])
def test_half_a_number_is_no_number(name):
    """A port is opened in the middle of a line, where 120.5 looks like 20.5."""
    data = b''.join(frames(name, 3, MOTIONS['shaking']))
    whole = {sample.output for sample in find_protocol(name).decoder().feed(data)}
    for start in range(len(find_protocol(name).preamble) + 1, len(data)):
        assert ({sample.output for sample in find_protocol(name).decoder().feed(data[start:])}
                <= whole)


@pytest.mark.parametrize('name', ['kvh_1750', 'kvh_ecore', 'fizoptika', 'witmotion'])
def test_a_flipped_bit_gives_no_wrong_rate(name):
    encode = find_protocol(name).encoder(SETTINGS[name])
    frames = [encode(Sample(rate * DPS, 20.0, None, number, 0, 9.8))
              for number, rate in enumerate((1.0, -2.0, 3.0, 4.0, 5.0))]
    good = [sample.output for sample in opened(name).feed(b''.join(frames))]
    assert len(good) == 5
    for bit in range(8 * len(frames[1])):
        damaged = bytearray(frames[1])
        damaged[bit // 8] ^= 1 << bit % 8
        decoder = opened(name)
        received = [sample.output
                    for sample in decoder.feed(b''.join([frames[0], damaged, *frames[2:]]))]
        if name == 'witmotion' and bit < 88:  # in the frame of the acceleration
            assert received == good
        else:
            assert set(received) <= set(good) - {good[1]} and received[-2:] == good[-2:]
        assert decoder.counts.discarded_bytes >= len(frames[1]) / (1 + (name == 'witmotion'))


@pytest.mark.parametrize('name', ALL)
def test_samples_whose_frames_are_damaged_are_missing_before_the_next(name):
    encode, decoder = find_protocol(name).encoder(SETTINGS[name]), opened(name)
    frames = [encode(Sample(0.1 * number, 20.0, 0.01 * number)) for number in range(1, 9)]
    frames[3] = frames[3][:2] + b'\x55' + frames[3][4:]
    frames[4] = frames[4][:3] + b'\x55' + frames[4][3:]
    assert [sample.missing for sample in decoder.feed(b''.join(frames))] == [0, 0, 0, 2, 0, 0]


@pytest.mark.parametrize(('name', 'data', 'counts'), [
    *(('csv', b'0.1,' + text + b',20.0\n', (0, len(text) + 9))  # no number
      for text in (b'1_0', b'0x10', b'', b'\xb2', b'1.5.2', b'--1', b'nano')),
    # no rate of a gyro; the last one is 12.345678 without its decimal point
    *(('csv', b'0.1,' + text + b',20.0\n', (1, 0)) for text in (
        b'nan', b'inf', b'-inf', b'1e999', b'infinity', b'-2000.1', b'12345678')),
    ('kvh_dsp3000', b'     501.000000   1\r\n', (1, 0)),  # manual of the DSP-3000, table 2
    ('minimu9', b'!ANG:0,0,0,AN:0,0,40000,0,0,0,0,0,0\r\n', (1, 0)),  # counts have 16 bits
    # rad/s, taken for angles
    ('kvh_1750', find_protocol('kvh_1750').encoder(Settings(increments=False))(
        Sample(0.501 * DPS)), (1, 0)),
    ('razor', b'#YPRAG=0,0,0,0,0,0,0,0,2290.0\r\n', (1, 0)),
    *(('razor', line + b'\r\n', (0, len(line))) for line in (
        b'#YPRAG=1,2,3,4,5,6,7,8', b'#YPRAG=1,2,3,4,5,6,7,8,9,10', b'#YPRAG=1,2,3,4,5,6,7,8,nan',
        b'#YPRAG=1,2,3,4,5,6,7,8,', b'YPRAG=1,2,3,4,5,6,7,8,9', b'#YPRAG=1,2,3,4,5,6,7,8,0x9'))])
def test_what_is_no_rate_is_discarded_or_refused_and_counted_and_costs_no_other_sample(
        name, data, counts):
    decoder, good = opened(name), find_protocol(name).encoder(SETTINGS[name])(Sample(0.1))
    assert len(decoder.feed(good)) == 1 and decoder.feed(data) == []
    assert (decoder.counts.refused_samples, decoder.counts.discarded_bytes) == counts
    after, = decoder.feed(good)
    assert after.missing >= counts[0]


@pytest.mark.parametrize('text', [b'2500', b'-127.1', b'1e308', b'-1e308', b'nan', b'NaN', b''])
def test_a_temperature_that_no_sensor_reports_is_refused_and_the_rate_is_kept(text):
    """One that failed, nan or nothing, is not counted."""
    decoder = opened('csv')
    sample, = decoder.feed(b'0.1,1.0,' + text + b'\n')
    assert sample.temperature is None and sample.output == pytest.approx(DPS)
    failed = text in (b'nan', b'NaN', b'')
    assert (decoder.counts.refused_temperatures, decoder.counts.refused_samples) == (not failed, 0)


@pytest.mark.parametrize('name', ALL)
def test_every_protocol_has_an_assumed_noise_and_a_full_scale_at_which_it_saturates(name):
    protocol, settings = find_protocol(name), SETTINGS[name]
    assert 0.0 < protocol.effective_full_scale(settings) < math.inf
    assert 0.0 < protocol.sample_variance(settings) <= (0.5 * DPS) ** 2
    sample, = opened(name).feed(protocol.encoder(settings)(Sample(-1000.0)))
    assert sample.output == pytest.approx(-protocol.effective_full_scale(settings), rel=2e-4)


@pytest.mark.parametrize(('name', 'values', 'message'), [
    ('csv', {'columns': ('time_s',)}, 'exactly one'),
    ('csv', {'columns': ('gyro_dps', 'gyro_counts')}, 'exactly one'),
    ('csv', {'columns': ('gyro_dps', 'time_s', 'time_s')}, 'only once'),
    ('csv', {'columns': ('gyro_counts',)}, 'gyro_counts: give both'),
    ('csv', {'sensitivity': 0.1}, 'sensitivity'),
    ('fizoptika', {'sensitivity': None}, 'sensitivity is not set.*rad/s of one count'),
    *((name, {'increments': True}, 'sends rates') for name in ALL if name != 'kvh_1750')])
def test_settings_that_do_not_fit_are_refused(name, values, message):
    with pytest.raises(ValueError, match=message):
        find_protocol(name).decoder(replace(SETTINGS[name], **values))


# Listening

MOTIONS = {
    'rest': lambda k: 1e-4 * math.sin(7.0 * k),
    'stillness': lambda k: 0.0,  # an emulated gyro without noise
    'turn': lambda k: 0.8,
    'shaking': lambda k: 5.0 * math.sin(k),
}


def frames(name, count, rate=MOTIONS['rest'], force=None):
    encode = find_protocol(name).encoder(SETTINGS[name])
    return [
        find_protocol(name).preamble,
        *(encode(Sample(rate(k), 20.0 + 0.01 * k, 0.01 * k, k, 0, force)) for k in range(count))]


def received(data, ratio, idle=0):
    """
    Return the bytes of a receiver whose bits are ``ratio`` times shorter than the sender's.

    Each byte is 10 bits: low, the data from the lowest bit on, high. The receiver waits for a
    falling edge and samples the middle of each of its bits; it ignores a missing stop bit, as in a
    break, as terminals do in raw mode.
    """
    line = [1]
    for byte in data:
        line += [0, *(byte >> bit & 1 for bit in range(8)), *[1] * (1 + idle)]
    result, start, step = bytearray(), 0.0, 1.0 / ratio
    while start + 9.5 * step < len(line):
        if line[int(start)]:
            start = math.floor(start) + 1.0
            continue
        bits = [line[int(start + (1.5 + bit) * step)] for bit in range(8)]
        result.append(sum(value << bit for bit, value in enumerate(bits)))
        start += 9.5 * step
        while start < len(line) and not line[int(start)]:
            start = math.floor(start) + 1.0
    return bytes(result)


@pytest.mark.parametrize('name', ALL)
def test_every_format_is_recognized_from_five_samples_and_as_no_other(name):
    for motion, force in itertools.product(MOTIONS.values(), (None, 9.8)):
        data = joined(name, 5, motion, force)
        assert recognize_protocol(data, Settings()) is find_protocol(name)


@pytest.mark.parametrize('name', ALL)
def test_bytes_are_recognized_wherever_they_begin_and_end_and_if_one_in_100_is_damaged(name):
    generator, data = random.Random(2), bytearray(b''.join(frames(name, 100)))
    for place in generator.sample(range(len(data)), len(data) // 100):
        data[place] ^= 1 << generator.randrange(8)
    few, length = b''.join(frames(name, 8)), len(data) // 100
    cuts = [slice(generator.randrange(2 * length), -generator.randrange(1, length))
            for _ in range(50)]
    for part in (bytes(data), *(few[cut] for cut in cuts)):
        assert recognize_protocol(part, Settings()) is find_protocol(name)


@pytest.mark.parametrize('idle', [0, 30])
@pytest.mark.parametrize('name', ALL)
def test_a_wrong_baud_is_no_format(name, idle):
    data = b''.join(frames(name, 300))[:1500]
    assert received(data, 1.0, idle) == data, 'at the right one'
    for baud in set(BAUDS) - {find_protocol(name).baud}:
        other = received(data, baud / find_protocol(name).baud, idle)
        assert recognize_protocol(other, Settings()) is None, baud


def joined(*given):
    return b''.join(frames(*given))


ZEROS = b'\x80' + bytes(7)  # which pass the check of the E-Core
FOUR = b'0.1,2.0,3.0,4.0\r\n' * 5
DSP3000 = b'       0.015733   1\r\n' * 8
CASES = {  # bytes, columns if not the default ones, protocol
    'nothing': (b'', None, None),
    'a single frame': (frames('kvh_1750', 1)[1], None, None),
    'as many bytes of two formats': (joined('fizoptika', 11) + joined('witmotion', 8), None, None),
    'a tenth of another format': (joined('kvh_1750', 20) + joined('fizoptika', 9), None,
                                  'kvh_1750'),
    'a few frames in much noise': (random.Random(8).randbytes(4000) + joined('fizoptika', 50),
                                   None, None),
    'noise long ago': (random.Random(4).randbytes(1_000_000) + joined('minimu9', 300), None,
                       'minimu9'),
    'some frames of zeros': ((4 * ZEROS + b'\xff' * 8) * 10, None, None),
    'nearly all frames of zeros': ((39 * ZEROS + b'\xff' * 8) * 10, None, 'kvh_ecore'),
    'more numbers than columns': (FOUR, None, None),
    'as many numbers as columns': (FOUR, ('time_s', 'gyro_dps', 'a', 'b'), 'csv'),
    'one number a line': (b'17\r\n' * 5, ('gyro_dps',), 'csv'),
    'a DSP-3000, where one column is wanted': (DSP3000, ('gyro_dps',), 'kvh_dsp3000'),
    'a DSP-3000, where two are wanted': (DSP3000, ('gyro_dps', 'valid'), 'kvh_dsp3000'),
    'a Razor that was not yet asked for rates': (b'#YPR=-142.28,-5.38,33.52\r\n' * 5, None,
                                                 'razor'),
    **{f'{byte:#x} again and again': (bytes([byte]) * 8192, None, None)
       for byte in (0x00, 0x55, 0x80, 0xDD, 0xFE, 0xFF, 0x0A, 0x20, 0x30)},
}


@pytest.mark.parametrize('data, columns, name', CASES.values(), ids=CASES)
def test_what_comes_is_recognized_or_not(data, columns, name):
    settings = Settings(columns=columns) if columns else Settings()
    assert recognize_protocol(data, settings) is (name and find_protocol(name))


# What single formats have: axes, temperatures, checksums, values over several frames

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
    assert decoder.counts.discarded_bytes == len(b'other' + frames[0] + b'bytes')


# Fizoptika: values that are spread over two frames


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


def test_the_angles_that_a_razor_sends_until_it_is_asked_for_more_are_in_order_but_no_sample():
    decoder = RAZOR.decoder()
    assert decoder.feed(b'#YPR=-142.28,-5.38,33.52\r\n') == []
    assert decoder.counts.discarded_bytes == 0
    assert RAZOR.startup == b'#ox#o1'


# WitMotion: accelerations in frames of their own

def witmotion(kind, *numbers):
    data = bytes([0x55, kind]) + struct.pack('<4h', *numbers)
    return data + bytes([sum(data) % 256])


@pytest.mark.parametrize('axis, rate, force', [('x', 100, 4), ('y', -200, -5), ('z', 300, 2048)])
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
    assert len(samples) == 1 and decoder.counts.discarded_bytes == 0


@pytest.mark.parametrize('temperature', [-40.0, -1.0, 0.0, 25.0, 85.0])
@pytest.mark.parametrize('protocol, frame', [
    (WITMOTION, lambda degc: witmotion(0x52, 0, 0, 0, round(100 * degc))),
    (KVH_1750, lambda degc: sealed(GOLDEN[:30] + struct.pack('>h', round(degc))))],
    ids=['witmotion', 'kvh_1750'])
def test_a_temperature_has_a_sign(protocol, frame, temperature):
    for data in (frame(temperature), protocol.encoder()(Sample(0.1, temperature))):
        sample, = decoded(protocol, data)
        assert sample.temperature == pytest.approx(temperature)
