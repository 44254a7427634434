# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Listening: each format is recognized from few bytes; noise and a wrong baud match none."""

import itertools
import math
import random

from gyro_calibration.driver.protocols import find_protocol, PROTOCOLS, Sample, Settings
from gyro_calibration.driver.protocols.listening import BAUDS, recognize_protocol
import pytest

ALL = sorted(PROTOCOLS)
SETTINGS = {name: Settings() for name in ALL} | {'fizoptika': Settings(sensitivity=1e-6)}
MOTIONS = {
    'rest': lambda k: 1e-4 * math.sin(7.0 * k),
    'stillness': lambda k: 0.0,  # an emulated gyro without noise
    'turn': lambda k: 0.8,
    'shaking': lambda k: 5.0 * math.sin(k),
}


def frames(name, count, rate=MOTIONS['rest'], force=None):
    """Return what a device sends, one sample after the other."""
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
def test_it_does_not_matter_where_the_bytes_begin_and_end(name):
    data = b''.join(frames(name, 8))
    generator = random.Random(1)
    length = len(data) // 8
    for _ in range(50):
        recognition = recognize_protocol(
            data[generator.randrange(2 * length):-generator.randrange(1, length)])
        assert recognition.protocol is find_protocol(name), recognition.summary


@pytest.mark.parametrize('name', ALL)
def test_a_line_that_damages_a_byte_in_a_hundred_is_recognized(name):
    generator, data = random.Random(2), bytearray(b''.join(frames(name, 100)))
    for place in generator.sample(range(len(data)), len(data) // 100):
        data[place] ^= 1 << generator.randrange(8)
    recognition = recognize_protocol(bytes(data))
    assert (recognition.protocol is find_protocol(name)
            and 0.5 < recognition.explained_share < 1.0), recognition.summary


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


def test_frames_that_are_always_the_same_must_be_almost_all_there_is():
    """Zeros pass the check of the E-Core."""
    zeros = b'\x80' + bytes(7)
    assert recognize_protocol((4 * zeros + b'\xff' * 8) * 10).protocol is None
    assert (recognize_protocol((39 * zeros + b'\xff' * 8) * 10).protocol
            is find_protocol('kvh_ecore'))


def test_a_few_frames_in_much_noise_are_not_enough():
    recognition = recognize_protocol(
        random.Random(8).randbytes(4000) + b''.join(frames('fizoptika', 50)))
    assert (recognition.protocol is None
            and 'of which too few are frames of fizoptika' in recognition.summary)


def test_noise_is_no_format():
    generator = random.Random(3)
    for _ in range(50):
        recognition = recognize_protocol(generator.randbytes(8192))
        assert recognition.protocol is None and recognition.explained_share < 0.01
        assert 'no known format' in recognition.summary or 'too few' in recognition.summary


def test_one_byte_again_and_again_is_no_format():
    for byte in (0x00, 0x55, 0x80, 0xDD, 0xFE, 0xFF, 0x0A, 0x20, 0x30):
        assert recognize_protocol(bytes([byte]) * 8192).protocol is None, byte


def test_few_bytes_or_none_are_reported_as_such():
    assert (recognize_protocol(b'').summary
            == 'nothing came: check the power and the wires of the gyro')
    recognition = recognize_protocol(frames('kvh_1750', 1)[1])
    assert recognition.protocol is None and 'listen longer' in recognition.summary


def test_two_formats_at_once_are_reported_as_ambiguous():
    """Eleven frames of 8 bytes are as many bytes as eight frames of 11."""
    recognition = recognize_protocol(b''.join(frames('fizoptika', 11) + frames('witmotion', 8)))
    assert recognition.protocol is None
    assert ('may be fizoptika or witmotion' in recognition.summary
            or 'may be witmotion or fizoptika' in recognition.summary)


def test_a_format_in_which_a_tenth_looks_like_another_is_recognized():
    recognition = recognize_protocol(b''.join(frames('kvh_1750', 20) + frames('fizoptika', 9)))
    assert recognition.protocol is find_protocol('kvh_1750')
    assert 'next is fizoptika with 9%' in recognition.summary


def test_lines_of_numbers_that_do_not_fit_the_columns_are_explained():
    recognition = recognize_protocol(b'0.1,2.0,3.0,4.0\r\n' * 5)
    assert (recognition.protocol is None
            and 'lines of 4 numbers came, but columns names 3' in recognition.summary)
    assert recognize_protocol(
        b'0.1,2.0,3.0,4.0\r\n' * 5,
        Settings(columns=('time_s', 'gyro_dps', 'a', 'b'))).protocol is find_protocol('csv')
    assert (recognize_protocol(b'17\r\n' * 5, Settings(columns=('gyro_dps',))).protocol
            is find_protocol('csv'))


def test_columns_that_do_not_fit_are_reported_although_another_baud_shows_some_frames():
    """At a wrong baud, text makes some E-Core frames; the baud that explains most is reported."""
    data = b''.join(b'%d,%f,3.5,4.25\n' % (10 * k, math.sin(k)) for k in range(100))
    wrong = [recognize_protocol(received(data, baud / find_protocol('csv').baud))
             for baud in set(BAUDS) - {find_protocol('csv').baud}]
    assert max(each.explained_share for each in wrong) > 0.0
    assert recognize_protocol(data).explained_share > max(each.explained_share for each in wrong)


def test_lines_of_a_dsp3000_are_no_columns():
    """Two numbers in a line, and with one column a line is one number."""
    data = b'       0.015733   1\r\n' * 8
    for columns in (('gyro_dps',), ('gyro_dps', 'valid')):
        assert (recognize_protocol(data, Settings(columns=columns)).protocol
                is find_protocol('kvh_dsp3000'))


def test_a_gyro_that_counts_is_recognized_before_its_sensitivity_is_set():
    for name in ('fizoptika', 'csv'):
        settings = Settings(columns=('time_s', 'gyro_counts', 'temperature_degc'))
        protocol = recognize_protocol(b''.join(frames(name, 5)), settings).protocol
        assert protocol is find_protocol(name)
        with pytest.raises(ValueError, match='sensitivity is not set'):
            protocol.check_settings(settings)


def test_a_razor_that_was_not_yet_asked_for_rates_is_recognized():
    assert (recognize_protocol(b'#YPR=-142.28,-5.38,33.52\r\n' * 5).protocol
            is find_protocol('razor'))


def test_what_came_long_ago_does_not_count():
    data = random.Random(4).randbytes(1_000_000) + b''.join(frames('minimu9', 300))
    assert recognize_protocol(data).protocol is find_protocol('minimu9')
