# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Fizoptika: signs, and values that are spread over two frames."""

import itertools

from gyro_calibration.driver.protocols import find_protocol, Sample, Settings
import pytest

PROTOCOL = find_protocol('fizoptika')
ONE_COUNT = Settings(sensitivity=1.0)
HEALTH = {'supply_v': 5.0, 'source_current_a': 0.1, 'diagnostic_v': 1.0}


def frame(count, number=8, data=0):
    """Return a frame; the numbers from 8 on are reserved and hold nothing."""
    high, middle, low = count.to_bytes(3, 'big', signed=True)
    content = bytes([low, high, middle, number, data])
    return b'\xdd' + content + sum(content).to_bytes(2, 'big')


def decoded(*frames):
    return PROTOCOL.decoder(ONE_COUNT).feed(b''.join(frames))


def values(*frames):
    return [(sample.temperature, dict(sample.health)) for sample in decoded(*frames)]


@pytest.mark.parametrize('number, raw, temperature, health', [
    *((0, raw, degrees, {}) for raw, degrees in (
        (0, -50.0), (9830, 25.0), (1311, -40.0), (-1, -50.0), (0x7FFF, 200.0))),
    (2, 16384, None, {'supply_v': 5.0}), (2, -16384, None, {'supply_v': -5.0}),
    (4, 13107, None, {'source_current_a': 0.1}), (6, 13107, None, {'diagnostic_v': 1.0})])
def test_each_value_comes_in_two_frames(number, raw, temperature, health):
    high, low = raw.to_bytes(2, 'big', signed=True)
    first, second = values(frame(1, number, high), frame(2, number + 1, low))
    assert first == (None, {})
    assert second == (temperature if temperature is None else pytest.approx(temperature, abs=0.01),
                      pytest.approx(health, abs=1e-4))


def test_all_values_come_round_and_are_good():
    encode = PROTOCOL.encoder(ONE_COUNT)
    samples = decoded(*(encode(Sample(0.0, -12.5, sequence=number)) for number in range(16)))
    assert ([sample.temperature for sample in samples if sample.temperature is not None]
            == pytest.approx([-12.5] * 2, abs=0.01))
    health = {name: value for sample in samples for name, value in sample.health.items()}
    assert (health == pytest.approx(HEALTH, abs=1e-4)
            and health.keys() == PROTOCOL.normal_ranges.keys())
    assert all(low < health[name] < high for name, (low, high) in PROTOCOL.normal_ranges.items())


@pytest.mark.parametrize('count', [1, 2, 3])
def test_a_lost_frame_never_joins_halves_of_two_values(count):
    """Each byte of each value is another, so that any wrong pair would show."""
    frames = [frame(k, k % 8, 0x0F * k + 1) for k in range(16)]
    right = values(*frames)
    for lost in itertools.combinations(range(16), count):
        rest = [k for k in range(16) if k not in lost]
        heard = values(*(frames[k] for k in rest))
        assert all(said in (right[k], (None, {})) for k, said in zip(rest, heard, strict=True))
        assert sum(said != (None, {}) for said in heard) == sum(
            {2 * pair, 2 * pair + 1}.isdisjoint(lost) for pair in range(8))


def test_halves_with_garbage_between_are_not_joined():
    """Eight lost frames bring the right number back, but the low byte is of a later value."""
    assert values(frame(1, 2, 0x40), b'\xdd\x00', frame(2, 3, 0x01)) == [(None, {}), (None, {})]
    decoder = PROTOCOL.decoder(ONE_COUNT)
    first, = decoder.feed(frame(1, 2, 0x40))
    decoder.reset()
    second, = decoder.feed(frame(2, 3, 0x01))
    assert first.health == second.health == {}
