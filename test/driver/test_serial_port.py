# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The port, on a pseudo-terminal."""

import contextlib
import os
import termios
import tty

from gyro_calibration.driver.connection import PortError, SerialPort
import pytest


@pytest.fixture
def terminal():
    """Return the file descriptor of the device's end, and the path of the other."""
    master, slave = os.openpty()
    tty.setraw(slave)
    yield master, os.ttyname(slave)
    for descriptor in (master, slave):
        with contextlib.suppress(OSError):  # the test may have unplugged it
            os.close(descriptor)


def holds(port, count):
    """Return whether so many bytes wait; a terminal passes them on with a delay."""
    return port._port.in_waiting == count


def test_what_is_there_is_read_at_once(terminal, wait_until):
    master, path = terminal
    port = SerialPort(path, 115200)
    port.open()
    os.write(master, b'x' * 1000)
    wait_until(lambda: holds(port, 1000))
    assert port.read() == b'x' * 1000
    port.close()


def test_nothing_is_read_where_nothing_came(terminal):
    port = SerialPort(terminal[1], 115200, timeout=0.01)
    port.open()
    assert port.read() == port.read() == b''
    port.close()


def test_an_unplugged_port_is_lost_and_closed(terminal):
    master, path = terminal
    port = SerialPort(path, 115200)
    port.open()
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
    """What came at the other speed is dropped."""
    master, path = terminal
    port = SerialPort(path, 9600, timeout=0.01)
    port.open()
    os.write(master, b'garbage')
    wait_until(lambda: holds(port, 7))
    port.set_baud(115200)
    speed = termios.tcgetattr(master)[4]
    os.write(master, b'sense')
    wait_until(lambda: holds(port, 5))
    assert (speed, port.baud, port.read()) == (termios.B115200, 115200, b'sense')
    port.close()
