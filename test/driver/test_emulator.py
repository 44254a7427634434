# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The emulated gyro, read through a real pseudo-terminal."""

import itertools
import math
import os
import time

from fake_port import SETTINGS
from gyro_calibration.driver.connection import PortError, SerialPort
from gyro_calibration.driver.emulator import emulate, Emulator
from gyro_calibration.driver.protocols import find_protocol, PROTOCOLS, Sample, Settings
import pytest


def samples(count=None, rate=100.0):
    """Return samples at a fixed rate, endless without a count."""
    indices = itertools.count() if count is None else range(count)
    return (Sample(0.1 * math.sin(k), 25.0, 5.0 + k / rate) for k in indices)


def read_all(path, protocol, enough=None, settings=None, until=lambda received: True):
    """Read until the gyro is unplugged, or enough samples are there and a condition holds."""
    port, decoder, received = (SerialPort(str(path), 115200),
                               find_protocol(protocol).decoder(settings), [])
    port.open()
    try:
        while enough is None or len(received) < enough or not until(received):
            received += decoder.feed(port.read())
    except PortError:
        pass
    finally:
        port.close()
    return received


@pytest.mark.parametrize('name', sorted(PROTOCOLS))
def test_a_reader_gets_every_sample(name, tmp_path):
    settings, protocol = SETTINGS[name], find_protocol(name)
    emulator = Emulator(protocol, samples(200), settings, speed=math.inf,
                        link=tmp_path / 'gyro', wait_for_reader=True)
    with emulator:
        received = read_all(emulator.path, name, 200, settings)
    resolution = settings.sensitivity or protocol.sensitivity
    assert [sample.output for sample in received] == pytest.approx(
        [sample.output for sample in samples(200)], abs=resolution)


@pytest.mark.parametrize('speed', [1.0, 10.0])
def test_samples_come_at_their_times(speed):
    """Where a busy machine holds them up, the next ones come at their times again."""
    arrivals = []

    def is_in_time(received):
        arrivals.append(time.monotonic())
        sent = (received[-1].time - received[0].time) / speed
        return (sent > 0.5 and arrivals[-1] - arrivals[0] == pytest.approx(sent, abs=0.05)
                or arrivals[-1] - arrivals[0] > 20.0)

    with Emulator(find_protocol('csv'), samples(rate=100.0), speed=speed,
                  wait_for_reader=True) as emulator:
        read_all(emulator.path, 'csv', 1, until=is_in_time)
    assert arrivals[-1] - arrivals[0] < 20.0


def test_bytes_that_are_not_read_are_lost_in_real_time(wait_until):
    with Emulator(find_protocol('csv'), samples(rate=1000.0)) as emulator:
        wait_until(lambda: emulator.lost_bytes > 1000)
        assert emulator.sent_bytes == 0
        first = read_all(emulator.path, 'csv', enough=1)[0]
    assert first.time > 5.02


def test_a_replay_waits_for_its_reader():
    with Emulator(find_protocol('csv'), samples(20000), speed=math.inf) as emulator:
        received = read_all(emulator.path, 'csv', enough=19990)
    assert emulator.lost_bytes == 0
    assert received[-1].time - received[0].time == pytest.approx(0.01 * (len(received) - 1))


def test_the_link_is_replaced_and_removed_unless_another_gyro_has_taken_it(tmp_path):
    link = tmp_path / 'gyro'
    link.symlink_to('/nonexistent')
    with Emulator(find_protocol('csv'), samples(), link=link) as emulator:
        assert os.readlink(link) == emulator.path
    assert list(tmp_path.iterdir()) == []
    with Emulator(find_protocol('csv'), samples(), link=link):
        second = Emulator(find_protocol('csv'), samples(), link=link)
        second.open()
    assert os.readlink(link) == second.path
    second.close()


def test_a_file_in_the_place_of_the_link_is_kept(tmp_path):
    (tmp_path / 'notes').write_text('precious')
    with pytest.raises(FileExistsError, match='give another path'):
        Emulator(find_protocol('csv'), samples(), link=tmp_path / 'notes').open()
    assert (tmp_path / 'notes').read_text() == 'precious'


@pytest.mark.parametrize('given, words', [
    *(({'speed': speed}, 'speed is .* above 0') for speed in (0.0, -1.0, math.nan)),
    ({'settings': Settings(columns=('gyro_counts',))}, 'sensitivity')])
def test_what_an_emulator_cannot_do_is_refused_before_the_start(given, words):
    with pytest.raises(ValueError, match=words):
        Emulator(find_protocol('csv'), samples(), **given)


def test_a_sample_without_a_time_is_refused():
    with pytest.raises(ValueError, match='set Sample.time'):
        emulate(Emulator(find_protocol('csv'), [Sample(0.5)]))


def test_eleven_thousand_samples_a_second_are_sent_in_time():
    """As fast as fizoptika sends. It waits for its reader: the buffer holds 40 ms at most."""
    gyro = Emulator(find_protocol('kvh_ecore'), samples(11500, 5750.0), speed=2.0,
                    wait_for_reader=True)
    with gyro:
        port, decoder, count, begin, used = (SerialPort(gyro.path, 921600),
                                             find_protocol('kvh_ecore').decoder(),
                                             0, math.inf, time.process_time())
        port.open()
        while count < 11500 and time.monotonic() < begin + 20.0:
            count += len(decoder.feed(port.read()))
            begin = min(begin, time.monotonic())
        elapsed, used = time.monotonic() - begin, time.process_time() - used
        port.close()
    assert count == 11500
    # A busy machine is late, but its work must not last longer than the samples.
    assert elapsed > 0.9 and used < 1.5
