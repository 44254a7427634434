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
The wire formats: their bytes, bad bytes, refused settings, and recognition from few bytes.

Any bytes, in any pieces, are decoded in test_fuzz.py: alike, and right again after two frames.

"""

from dataclasses import replace
import itertools
import math
from pathlib import Path
import random
import time

from fake_port import SETTINGS
from gyro_calibration.driver import protocols
from gyro_calibration.driver.protocols import (
    BAUDS,
    find_protocol,
    PROTOCOLS,
    recognize_protocol,
    Sample,
    Settings,
)
import pytest

ALL = sorted(PROTOCOLS)
DPS = math.radians(1.0)

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


def test_each_module_of_the_folder_is_a_format_and_describes_itself():
    modules = {path.stem for path in Path(protocols.__file__).parent.glob('*.py')}
    assert len(PROTOCOLS) == len(modules - {'__init__', 'protocol'}) > 0
    assert all(protocol.text.strip() for protocol in PROTOCOLS.values())


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
    """Return the samples that arrive of one."""
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
        assert decoder.discarded_bytes >= len(frames[1]) / (1 + (name == 'witmotion'))


@pytest.mark.parametrize('name', ALL)
def test_samples_whose_frames_are_damaged_are_missing_before_the_next(name):
    encode, decoder = find_protocol(name).encoder(SETTINGS[name]), opened(name)
    frames = [encode(Sample(0.1 * number, 20.0, 0.01 * number))
              for number in range(1, 9)]
    frames[3] = frames[3][:2] + b'\x55' + frames[3][4:]
    frames[4] = frames[4][:3] + b'\x55' + frames[4][3:]
    assert [sample.missing for sample in decoder.feed(b''.join(frames))] == [0, 0, 0, 2, 0, 0]


LENGTH = 300_000
HOSTILE = {
    'noise': random.Random(6).randbytes(LENGTH),
    'zeros': bytes(LENGTH),
    'line ends': b'\r\n' * (LENGTH // 2),
    'blanks': b' ' * LENGTH,
    'commas': b',' * LENGTH,
    'digits': b'1' * LENGTH,
    'headers of the 1750': b'\xfe\x81\xff\x55' * (LENGTH // 4),
    'headers of fizoptika': b'\xdd' * LENGTH,
    'headers of witmotion': b'\x55\x52' * (LENGTH // 2),
    'headers of the ecore': b'\x80' * LENGTH,
    'almost frames of the ecore': b'\x80' + b'\x01\x00\x00\x00\x00\x00\x00\x80' * (LENGTH // 8),
    'almost lines of the razor': b'#YPRAG=1,1,1,1,1,1,1,1,\n' * (LENGTH // 24),
    'a long number': b'#YPRAG=' + b'1' * 200 + b'\n',
}


@pytest.mark.parametrize('kind', sorted(HOSTILE))
def test_anything_is_decoded_in_less_time_than_it_takes_to_come(kind):
    """Eight decoders, in one piece and bytewise, take less than the 3.3 s of 921600 baud."""
    begin = time.process_time()
    for name in ALL:
        whole, pieces = opened(name), opened(name)
        received = whole.feed(HOSTILE[kind])
        small = [sample for start in range(0, 10_000)
                 for sample in pieces.feed(HOSTILE[kind][start:start + 1])]
        assert (received[:len(small)] == small
                and all(math.isfinite(sample.output) for sample in received))
        assert len(whole._splitter._tail) <= 1024
    assert time.process_time() - begin < LENGTH / 92160


@pytest.mark.parametrize('text', [b'1_0', b'0x10', b'', b'\xb2', b'1.5.2', b'--1', b'nano'])
def test_csv_discards_what_is_no_rate(text):
    decoder = opened('csv')
    assert decoder.feed(b'0.1,' + text + b',20.0\n') == []
    assert decoder.discarded_bytes == len(text) + 9


# the last one is 12.345678 without its decimal point
@pytest.mark.parametrize('text',
                         [b'nan', b'inf', b'-inf', b'1e999', b'infinity', b'-2000.1', b'12345678'])
def test_csv_refuses_a_rate_that_no_gyro_reports_and_leaves_a_gap(text):
    decoder = opened('csv')
    samples = decoder.feed(b'0.1,1.0,20.0\n0.2,' + text + b',20.0\n0.3,1.0,20.0\n')
    assert [sample.missing for sample in samples] == [0, 1]
    assert (decoder.refused_samples, decoder.discarded_bytes) == (1, 0)


@pytest.mark.parametrize('text', [b'2500', b'-127.1', b'1e308', b'-1e308', b'nan', b'NaN', b''])
def test_a_temperature_that_no_sensor_reports_is_refused_and_the_rate_is_kept(text):
    """One that failed, nan or nothing, is not counted."""
    decoder = opened('csv')
    sample, = decoder.feed(b'0.1,1.0,' + text + b'\n')
    assert sample.temperature is None and sample.output == pytest.approx(DPS)
    failed = text in (b'nan', b'NaN', b'')
    assert (decoder.refused_temperatures, decoder.refused_samples) == (not failed, 0)


@pytest.mark.parametrize('name', ALL)
def test_every_protocol_has_an_assumed_noise_and_a_full_scale_at_which_it_saturates(name):
    protocol, settings = find_protocol(name), SETTINGS[name]
    assert 0.0 < protocol.effective_full_scale(settings) < math.inf
    assert 0.0 < protocol.sample_variance(settings) <= (0.5 * DPS) ** 2
    sample, = opened(name).feed(protocol.encoder(settings)(Sample(-1000.0)))
    assert sample.output == pytest.approx(-protocol.effective_full_scale(settings), rel=2e-4)


RATES = Settings(increments=False)


@pytest.mark.parametrize(('name', 'data', 'settings'), [
    ('kvh_dsp3000', b'     501.000000   1\r\n', Settings()),  # manual of the DSP-3000, table 2
    ('csv', b'0.1,59.0,20.0\n', Settings(full_scale=0.5)),
    ('minimu9', b'!ANG:0,0,0,AN:0,0,40000,0,0,0,0,0,0\r\n', Settings()),  # counts have 16 bits
    # rad/s, taken for angles
    ('kvh_1750', find_protocol('kvh_1750').encoder(RATES)(Sample(0.501 * DPS)),
     Settings()),
    ('razor', b'#YPRAG=0,0,0,0,0,0,0,0,2290.0\r\n', Settings()),
])
def test_a_rate_that_the_device_cannot_mean_is_refused(name, data, settings):
    decoder = opened(name, settings)
    assert decoder.feed(data) == []
    assert decoder.refused_samples == 1


@pytest.mark.parametrize(('name', 'values', 'message'), [
    ('csv', {'sensitivity': -1.0}, 'set invert'),
    ('csv', {'sensitivity': math.nan}, 'above 0'),
    ('csv', {'full_scale': math.inf}, 'above 0'),
    ('csv', {'sample_rate': 0.0}, 'above 0'),
    ('csv', {'axis': 'w'}, 'x, y or z'),
    ('csv', {'columns': ('time_s',)}, 'exactly one'),
    ('csv', {'columns': ('gyro_dps', 'gyro_counts')}, 'exactly one'),
    ('csv', {'columns': ('gyro_dps', 'time_s', 'time_s')}, 'only once'),
    ('csv', {'columns': ('gyro_counts',)}, 'sensitivity is not set'),
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
        recognition = recognize_protocol(b''.join(frames(name, 5, motion, force)))
        assert recognition.protocol is find_protocol(name), recognition.summary
        assert (recognition.explained_share > 0.99
                and recognition.summary.startswith(f'{name} explains 100% of'))


@pytest.mark.parametrize('name', ALL)
def test_bytes_are_recognized_wherever_they_begin_and_end_and_if_one_in_100_is_damaged(name):
    generator, data = random.Random(2), bytearray(b''.join(frames(name, 100)))
    for place in generator.sample(range(len(data)), len(data) // 100):
        data[place] ^= 1 << generator.randrange(8)
    few, length, shares = b''.join(frames(name, 8)), len(data) // 100, []
    cuts = [slice(generator.randrange(2 * length), -generator.randrange(1, length))
            for _ in range(50)]
    for part in (bytes(data), *(few[cut] for cut in cuts)):
        recognition = recognize_protocol(part)
        assert recognition.protocol is find_protocol(name), recognition.summary
        shares.append(recognition.explained_share)
    assert 0.5 < shares[0] < 1.0 and min(shares) > 0.5


@pytest.mark.parametrize('idle', [0, 30])
@pytest.mark.parametrize('name', ALL)
def test_a_wrong_baud_is_no_format(name, idle):
    data = b''.join(frames(name, 300))[:1500]
    assert received(data, 1.0, idle) == data, 'at the right one'
    for baud in set(BAUDS) - {find_protocol(name).baud}:
        recognition = recognize_protocol(received(data, baud / find_protocol(name).baud, idle))
        assert recognition.protocol is None, (baud, recognition)


def test_a_device_of_another_kind_is_no_format_at_any_baud():
    """Frames with zeros come closest: at a wrong baud they look like frames of the E-Core."""
    generator = random.Random(7)
    for ratio in (0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 12.0):
        for _ in range(10):
            content = bytes(generator.choice((0x00, 0x00, 0x01, 0x55, 0x80, 0xFF, 0xA5))
                            for _ in range(generator.randrange(4, 30)))
            data = b''.join(content + generator.randbytes(1) for _ in range(30))
            recognition = recognize_protocol(
                received(data[:400], ratio, generator.choice((0, 3, 30))))
            assert recognition.protocol is None, (ratio, content, recognition.summary)


def joined(name, count):
    return b''.join(frames(name, count))


ZEROS = b'\x80' + bytes(7)  # which pass the check of the E-Core
FOUR = b'0.1,2.0,3.0,4.0\r\n' * 5
DSP3000 = b'       0.015733   1\r\n' * 8
CASES = {  # bytes, columns if not the default ones, protocol, part of the summary
    'nothing': (b'', None, None, 'nothing came: check the power and the wires of the gyro'),
    'a single frame': (frames('kvh_1750', 1)[1], None, None, 'listen longer'),
    'as many bytes of two formats': (joined('fizoptika', 11) + joined('witmotion', 8), None, None,
                                     'may be '),
    'a tenth of another format': (joined('kvh_1750', 20) + joined('fizoptika', 9), None,
                                  'kvh_1750', 'next is fizoptika with 9%'),
    'a few frames in much noise': (random.Random(8).randbytes(4000) + joined('fizoptika', 50),
                                   None, None, 'of which too few are frames of fizoptika'),
    'noise long ago': (random.Random(4).randbytes(1_000_000) + joined('minimu9', 300), None,
                       'minimu9', ''),
    'some frames of zeros': ((4 * ZEROS + b'\xff' * 8) * 10, None, None, ''),
    'nearly all frames of zeros': ((39 * ZEROS + b'\xff' * 8) * 10, None, 'kvh_ecore', ''),
    'more numbers than columns': (FOUR, None, None,
                                  'name as many columns as a line has numbers'),
    'as many numbers as columns': (FOUR, ('time_s', 'gyro_dps', 'a', 'b'), 'csv', ''),
    'one number a line': (b'17\r\n' * 5, ('gyro_dps',), 'csv', ''),
    'a DSP-3000, where one column is wanted': (DSP3000, ('gyro_dps',), 'kvh_dsp3000', ''),
    'a DSP-3000, where two are wanted': (DSP3000, ('gyro_dps', 'valid'), 'kvh_dsp3000', ''),
    'a Razor that was not yet asked for rates': (b'#YPR=-142.28,-5.38,33.52\r\n' * 5, None,
                                                 'razor', ''),
    **{f'{byte:#x} again and again': (bytes([byte]) * 8192, None, None, '')
       for byte in (0x00, 0x55, 0x80, 0xDD, 0xFE, 0xFF, 0x0A, 0x20, 0x30)},
}


@pytest.mark.parametrize('data, columns, name, words', CASES.values(), ids=CASES)
def test_what_comes_is_recognized_or_explained(data, columns, name, words):
    settings = Settings(columns=columns) if columns else Settings()
    recognition = recognize_protocol(data, settings)
    assert recognition.protocol is (name and find_protocol(name)), recognition.summary
    assert words in recognition.summary
