# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""A gyro on a port: found, recognized, lost and found again by an injected clock; and emulated."""

import contextlib
import itertools
import math
import os
import termios
import threading
import tty

from fake_port import Reading, SETTINGS, World
from gyro_calibration.driver.connection import (
    Connection, Decimator, PortError, resolve_port, SerialPort)
from gyro_calibration.driver.emulator import Emulator
from gyro_calibration.driver.protocols import find_protocol, PROTOCOLS, Sample, Settings
import pytest

ONE_COLUMN = Settings(columns=('gyro_dps',))
NOTHING = 'nothing comes on /dev/gyro for 2 s: check the power and the wires of the gyro'


def turning(rate=0.5, frequency=100.0):
    return (Sample(rate, 31.5, k / frequency) for k in itertools.count())


def held():
    """Return how many threads and file descriptors this process has."""
    return threading.active_count(), len(os.listdir('/proc/self/fd'))


def test_a_port_that_goes_and_comes_back_leaves_nothing_behind(tmp_path):
    """Real ports, whose link is there or not; each is taken until it is lost."""
    after, found = [], []
    connection = Connection(str(tmp_path / 'gyro'), 'csv')
    before, stop = held(), threading.Event()
    for number in range(100):
        stop.clear()
        with Emulator(find_protocol('csv'), turning(0.01 * number), link=tmp_path / 'gyro'):
            for chunk in connection.chunks(stop):
                found.append(chunk.samples[-1].output)
                stop.set()
        after.append(held())
    assert set(after) == {before} and connection.open_count == 100
    assert found == pytest.approx([0.01 * number for number in range(100)])


@pytest.mark.parametrize('name', sorted(PROTOCOLS))
def test_auto_finds_the_protocol_and_reports_it(name):
    world = World(15.0, baud=find_protocol(name).baud)
    world.gyro(name, settings=SETTINGS[name])
    reading = Reading(world, settings=SETTINGS[name])
    assert reading.connection.protocol is find_protocol(name)
    assert reading.names == ['listening', 'reading'] and len(reading.samples) > 100
    assert reading.connection.baud == find_protocol(name).baud


def test_auto_asks_for_what_the_protocol_needs():
    world, counts = World(5.0), Settings(columns=('gyro_counts',))
    world.gyro('csv', settings=Settings(columns=('gyro_counts',), sensitivity=0.001))
    problem = Reading(world, settings=counts).problems[0]
    assert problem.startswith(
        'csv comes on /dev/gyro, but sensitivity, the rad/s of one count')


def test_a_gyro_is_found_again_under_another_name(tmp_path):
    """As in /dev/serial/by-id, where the name holds the serial number of the adapter."""
    world = World(30.0)
    names = [tmp_path / f'usb-FTDI_A9003XYZ-if0{number}' for number in range(2)]
    names[0].touch()
    world.gyro('csv', outputs=itertools.chain(itertools.repeat(0.1, 1500), itertools.repeat(0.2)))

    def lose():
        names[0].unlink()
        return world.unplug()
    world.at(10.0, lose)
    world.at(15.0, lambda: names[1].touch() or world.plug())
    reading = Reading(world, 'csv', tmp_path / '*A9003XYZ*')
    assert (reading.connection.path == str(names[1])
            and reading.samples[-1].output == pytest.approx(0.2))
    assert any(f'no port matches {tmp_path}/*A9003XYZ*: plug the gyro in' in problem
               for problem in reading.problems)


def test_several_ports_that_match_are_named_and_several_names_of_one_are_no_question(tmp_path):
    for name in ('gyro_a', 'gyro_b'):
        (tmp_path / name).touch()
    with pytest.raises(PortError,
                       match=r'2 ports match .*: .*gyro_a, .*gyro_b; set port to one of them'):
        resolve_port(str(tmp_path / 'gyro_?'))
    (tmp_path / 'gyro_b').unlink()
    (tmp_path / 'gyro_b').symlink_to(tmp_path / 'gyro_a')
    assert resolve_port(str(tmp_path / 'gyro_?')) == str(tmp_path / 'gyro_a')


def test_waiting_doubles_up_to_its_limit_and_ends_with_samples():
    """Else a gyro with a loose plug would be waited for longer and longer."""
    world = World(60.0)
    world.plugged = False
    world.gyro('csv')
    world.at(30.0, world.plug)
    world.at(50.0, world.unplug)
    reading = Reading(world, 'csv')
    waits = [state.retry_delay for state in reading.states if state.name == 'failed']
    doubling = [0.1, 0.2, 0.4, 0.8, 1.6, 3.2]
    assert waits == pytest.approx([*doubling, *5 * [5.0], *doubling, 5.0])
    assert reading.connection.waited_duration == pytest.approx(31.3 + 10.0, abs=0.2)


@pytest.mark.parametrize('period', [1.5, 10.0])
def test_a_slow_gyro_is_silent_after_three_of_its_periods(period):
    """Its period is known from the second sample on, or from the parameter."""
    settings = Settings(columns=('gyro_dps',), sample_rate=1.0 / period if period > 5.0 else None)
    world = World(30.5 * period)
    world.send(b'1.0\r\n', end=20.5 * period, rate=1.0 / period)
    reading = Reading(world, 'csv', settings=settings)
    # the first line is cut off
    assert len(reading.samples) == 20 and reading.names[:2] == ['reading', 'failed']
    assert reading.times[1] == pytest.approx(23.0 * period, abs=1.0)


@pytest.mark.parametrize(('protocol', 'line', 'reason'), [
    ('csv', b'', NOTHING),
    ('csv', b'!ANG:1,2,3,AN:1,2,3,4,5,6,7,8,9\r\n',
     'bytes come on /dev/gyro, but no sample of csv for 2 s: check protocol, baud and'),
    ('kvh_dsp3000', b'       0.015733   0\r\n',
     'the gyro on /dev/gyro marks all samples as invalid for 2 s: turn it off'),
    ('kvh_dsp3000', b'     999.000000   1\r\n',
     'all samples on /dev/gyro are beyond full scale for 2 s: check protocol, sens'),
])
def test_a_gyro_without_samples_is_reported_with_its_reason(protocol, line, reason):
    world = World(30.0)
    world.send(line)
    reading = Reading(world, protocol)
    assert reading.problems[0].startswith(reason) and not reading.samples
    assert reading.times[0] == pytest.approx(2.0, abs=0.2)
    assert 3 <= reading.connection.open_count <= 5  # after 7 s each, as a board may restart


@pytest.mark.parametrize('protocol', ['razor', 'auto'])
def test_a_board_that_restarts_when_it_is_opened_is_asked_until_it_answers(protocol):
    world = World(10.0)
    world.restart, world.answer = (
        1.2, b'#YPRAG=-142.28,-5.38,33.52,12.8,-25.6,256.00,0.01,0.02,-0.03\r\n')
    world.send(b'#YPR=-142.28,-5.38,33.52\r\n')
    reading = Reading(world, protocol)
    assert len(reading.samples) > 500 and reading.connection.open_count == 1
    assert len(world.asked) <= 4, 'asked although it sends'


@pytest.mark.parametrize('protocol', ['csv', 'auto'])
def test_a_board_that_takes_long_to_restart_is_waited_for(protocol):
    world = World(10.0)
    world.restart = 4.5
    world.send(b'1.0\r\n')
    reading = Reading(world, protocol, settings=ONE_COLUMN)
    assert reading.samples and reading.connection.open_count == 1
    assert reading.problems == [NOTHING]


def test_a_pause_is_in_the_stamps_but_counts_as_no_loss():
    world = World(5.0)
    world.gyro('csv')
    assert Reading(world, 'csv').connection.longest_gap == 0.0
    world = World(20.0)
    world.gyro('csv')
    world.at(8.0, world.unplug)
    world.at(9.0, world.plug)
    reading = Reading(world, 'csv')
    # tried at 8, 8.1, 8.3, 8.7, 9.5
    assert reading.connection.longest_gap == max(reading.steps) == pytest.approx(1.5, abs=0.2)
    assert reading.connection.counts.lost_samples == 0


@pytest.fixture
def terminal():
    master, slave = os.openpty()
    tty.setraw(slave)
    yield master, os.ttyname(slave)
    for descriptor in (master, slave):
        with contextlib.suppress(OSError):  # the test may have unplugged it
            os.close(descriptor)


def holds(port, count):
    """Return whether so many bytes wait; a terminal passes them on with a delay."""
    return port._port.in_waiting == count


def test_an_unplugged_port_is_lost_and_closed(terminal):
    master, path = terminal
    port = SerialPort(path, 115200)
    port.open()
    assert port.read() == b'', 'nothing has come'
    os.close(master)
    with pytest.raises(PortError, match=f'^lost {path}: the device was disconnected: plug it '
                                        'in again$'):
        port.read()
    with pytest.raises(PortError, match='is not open'):
        port.read()


def test_a_port_is_for_one_program(terminal):
    first, second = SerialPort(terminal[1], 115200), SerialPort(terminal[1], 115200)
    first.open()
    with pytest.raises(PortError, match='another program has opened it'):
        second.open()
    first.close()
    second.open()
    second.close()


@pytest.mark.parametrize(('path', 'reason'), [
    ('/nonexistent/tty', 'does not exist'),
    ('', 'does not exist'),
    ('/', 'is a folder'),
    (__file__, 'no serial port'),
])
def test_a_port_that_cannot_be_opened_says_why(path, reason):
    with pytest.raises(PortError, match=f'^cannot open .*: .*{reason}.*: .*'):
        SerialPort(path, 115200).open()


def test_the_speed_changes_without_opening_the_port_anew(terminal, wait_until):
    master, path = terminal
    port = SerialPort(path, 9600)
    port.open()
    os.write(master, b'garbage')
    wait_until(lambda: holds(port, 7))
    port.set_baud(115200)
    speed = termios.tcgetattr(master)[4]
    os.write(master, b'sense')
    wait_until(lambda: holds(port, 5))
    assert (speed, port.baud, port.read()) == (termios.B115200, 115200, b'sense')
    port.close()


PERIOD = 1e-3
EPOCH = 1.7e9


def means(size, numbers, temperatures=25 * (30.0,)):
    """Return what becomes of samples that hold their numbers, as many periods after 1970."""
    decimation = Decimator(size)
    samples = [Sample(1e-4 * number, temperature, specific_force=9.81)
               for number, temperature in zip(numbers, temperatures)]
    complete = list(decimation.add(samples,
                                   [EPOCH + PERIOD * number for number in numbers], PERIOD))
    rest = list(decimation.flush())
    assert not list(decimation.flush()), 'what has begun is given once'
    return complete, rest


def test_a_mean_has_the_mean_time_and_values_of_its_samples():
    complete, rest = means(10, range(25))
    assert [mean.sample.output for mean in complete] == pytest.approx([4.5e-4, 14.5e-4])
    assert [mean.stamp - EPOCH for mean in complete] == pytest.approx([4.5e-3, 14.5e-3], abs=1e-6)
    assert ({(mean.sample.temperature, round(mean.sample.specific_force, 9)) for mean in complete}
            == {(30.0, 9.81)})
    assert [mean.sample_count for mean in [*complete, *rest]] == [10, 10, 5]
    complete, rest = means(1, range(5))
    assert [(mean.sample.output, mean.sample_count) for mean in complete] == [
        (1e-4 * number, 1) for number in range(5)] and not rest
    (mean,), _ = means(3, range(3), (20.0, None, 30.0))
    assert mean.sample.temperature == 25.0


@pytest.mark.parametrize('numbers, sizes', [([*range(4), *range(50, 60)], [4, 10]),
                                            ([100, 101, 50, 51], [2, 2])],
                         ids=['a gap', 'stamps that are set back'])
def test_a_jump_of_the_stamps_ends_a_group(numbers, sizes):
    complete, rest = means(10, numbers)
    assert [mean.sample_count for mean in [*complete, *rest]] == sizes


# The emulated gyro, read through a real pseudo-terminal

def samples(count=None, rate=100.0):
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
