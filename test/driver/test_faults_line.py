# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Bytes lost, doubled and flipped: what the checks of each format let through."""

import math

from gyro_calibration.driver.protocols import find, PROTOCOLS, Sample, Settings
from gyro_calibration.driver.serial_faults import damaged, SerialFaults
from gyro_calibration.logs.log import DEGREE
import numpy as np
import pytest

SHARES = (0.001, 0.01, 0.1)
RATE = 100.0
CHECKED = {'kvh_1750'}  # the only ones with a CRC
SETTINGS = {
    name: Settings(sample_rate=RATE, sensitivity=DEGREE / 27880.0 if name == 'fizoptika' else None)
    for name in PROTOCOLS}
SENT = 0.5  # rad/s


def bad(share):
    """Return a line that strikes so many of the bytes, one way or another."""
    return SerialFaults(lost_bytes=share / 3.0, doubled_bytes=share / 3.0,
                        flipped_bytes=share / 3.0)


def exact(name):
    """Return what comes of the rate that is sent, over a good line: formats round it."""
    encode, decoder = find(name).encoder(SETTINGS[name]), find(name).decoder(SETTINGS[name])
    data = find(name).preamble + b''.join(encode(Sample(SENT, 25.0, 1.0, number))
                                          for number in range(4))
    return decoder.feed(data)[-1].output


def is_wrong(name, output):
    """Return whether a rate is another than the one that was sent."""
    return abs(output - exact(name)) > 1e-9


@pytest.mark.parametrize('share', SHARES)
@pytest.mark.parametrize('name', sorted(PROTOCOLS))
def test_a_decoder_counts_what_it_throws_away_and_a_crc_lets_nothing_wrong_through(name, share):
    protocol, generator = find(name), np.random.default_rng(1)
    encode, decoder = protocol.encoder(SETTINGS[name]), protocol.decoder(SETTINGS[name])
    pieces = (encode(Sample(SENT, 25.0, number / RATE, number)) for number in range(3000))
    samples = [sample for piece in pieces
               for sample in decoder.feed(damaged(bad(share), piece, generator))]
    assert decoder.discarded_bytes > 0 and samples
    assert all(math.isfinite(sample.output)
               and abs(sample.output) <= protocol.limit(SETTINGS[name]) for sample in samples)
    if name in CHECKED:
        assert not [sample.output for sample in samples if is_wrong(name, sample.output)]
