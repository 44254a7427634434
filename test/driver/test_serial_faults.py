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

from gyro_calibration.driver.serial_faults import damaged, delivered, SerialFaults
import numpy as np
import pytest

DATA = bytes(range(256)) * 400  # 102400 bytes, each unlike its neighbours


def arrived(**faults):
    """Return what arrives of the data."""
    return damaged(SerialFaults(**faults), DATA, np.random.default_rng(1))


def test_a_line_without_faults_changes_nothing_and_asks_no_generator():
    assert damaged(SerialFaults(), DATA, None) == DATA
    assert not SerialFaults(burst=0.016, piece=1).is_random


@pytest.mark.parametrize('fault, sign', [('lost_bytes', -1), ('doubled_bytes', 1)])
def test_so_many_bytes_are_lost_or_doubled_as_were_asked_for(fault, sign):
    """Of a binomial count, five standard deviations."""
    difference = sign * (len(arrived(**{fault: 0.1})) - len(DATA))
    assert difference == pytest.approx(0.1 * len(DATA), abs=5 * (0.09 * len(DATA)) ** 0.5)


def test_a_doubled_byte_comes_twice_in_its_place():
    received = arrived(doubled_bytes=0.01)
    assert bytes(byte for byte, _ in itertools.groupby(received)) == DATA


def test_a_flipped_byte_has_one_bit_flipped():
    differences = (np.frombuffer(arrived(flipped_bytes=0.1), np.uint8)
                   ^ np.frombuffer(DATA, np.uint8))
    assert np.isin(differences, [0, *(1 << np.arange(8))]).all()
    assert np.count_nonzero(differences) == pytest.approx(0.1 * len(DATA),
                                                          abs=5 * (0.09 * len(DATA)) ** 0.5)


def test_all_can_be_lost():
    assert arrived(lost_bytes=1.0) == b''


def test_bursts_hand_over_at_their_ends_and_lose_nothing():
    sent = [(0.001 * number, bytes([number])) for number in range(100)]
    pieces = list(delivered(SerialFaults(burst=0.016), sent, 9600))
    assert b''.join(data for _, data in pieces) == bytes(range(100))
    assert [time for time, _ in pieces] == pytest.approx([0.016 * number for number in range(8)])
    assert all(0.0 <= time - 0.001 * byte < 0.016 + 1e-9 for time, data in pieces for byte in data)


def test_pieces_come_at_the_pace_of_the_line():
    pieces = list(delivered(SerialFaults(piece=1), [(1.0, b'abc')], 9600))
    assert [data for _, data in pieces] == [b'a', b'b', b'c']
    assert [time for time, _ in pieces] == pytest.approx([1.0, 1.0 + 10 / 9600, 1.0 + 20 / 9600])


def test_a_source_is_not_asked_before_what_it_gave_was_delivered():
    asked = []
    pieces = delivered(SerialFaults(), (asked.append(number) or (float(number), b'x')
                                        for number in range(9)), 9600)
    next(pieces)
    assert asked == [0]


@pytest.mark.parametrize('fault, words',
                         [({'lost_bytes': 1.5}, 'lost_bytes is 1.5, but must be a probability'),
                          ({'flipped_bytes': float('nan')}, 'flipped_bytes is nan'),
                          ({'lost_bytes': 0.6, 'doubled_bytes': 0.6}, 'more than 1'),
                          ({'burst': -1.0}, 'burst is -1.0 s'), ({'piece': -1}, 'piece -1')])
def test_a_line_that_is_not_possible_is_refused(fault, words):
    with pytest.raises(ValueError, match=words):
        SerialFaults(**fault)
