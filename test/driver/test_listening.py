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

from fake_port import SETTINGS
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
