# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""What a bad line makes of bytes, without any port."""

import itertools

import numpy as np
import pytest
from serial_faults import bursts, damaged, single_bytes

DATA = bytes(range(256)) * 400  # 102400 bytes, each unlike its neighbours


def arrived(**faults):
    """Return what arrives of the data."""
    return damaged(DATA, np.random.default_rng(1), **faults)


@pytest.mark.parametrize('fault, sign', [('lost', -1), ('doubled', 1)])
def test_so_many_bytes_are_lost_or_doubled_as_were_asked_for(fault, sign):
    """Of a binomial count, five standard deviations."""
    difference = sign * (len(arrived(**{fault: 0.1})) - len(DATA))
    assert difference == pytest.approx(0.1 * len(DATA), abs=5 * (0.09 * len(DATA)) ** 0.5)


def test_a_doubled_byte_comes_twice_in_its_place():
    received = arrived(doubled=0.01)
    assert bytes(byte for byte, _ in itertools.groupby(received)) == DATA


def test_a_flipped_byte_has_one_bit_flipped():
    differences = np.frombuffer(arrived(flipped=0.1), np.uint8) ^ np.frombuffer(DATA, np.uint8)
    assert np.isin(differences, [0, *(1 << np.arange(8))]).all()
    assert np.count_nonzero(differences) == pytest.approx(0.1 * len(DATA),
                                                          abs=5 * (0.09 * len(DATA)) ** 0.5)


def test_bursts_hand_over_at_their_ends_and_lose_nothing():
    pieces = list(bursts((0.001 * number, bytes([number])) for number in range(100)))
    assert b''.join(data for _, data in pieces) == bytes(range(100))
    assert [time for time, _ in pieces] == pytest.approx([0.016 * number for number in range(8)])
    assert all(0.0 <= time - 0.001 * byte < 0.016 + 1e-9 for time, data in pieces for byte in data)


def test_single_bytes_come_at_the_pace_of_the_line():
    pieces = list(single_bytes([(1.0, b'abc')], 9600))
    assert [data for _, data in pieces] == [b'a', b'b', b'c']
    assert [time for time, _ in pieces] == pytest.approx([1.0, 1.0 + 10 / 9600, 1.0 + 20 / 9600])
