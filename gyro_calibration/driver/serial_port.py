# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The serial port of a gyro."""

from __future__ import annotations

from collections.abc import Callable
import errno
import os
import select
import termios
from typing import TypeVar

import serial

_Result = TypeVar('_Result')

_REMEDIES = {
    errno.ENOENT: 'it does not exist: plug the gyro in, or set another port',
    errno.ENODEV: 'no device is behind it: plug the gyro in again',
    errno.EACCES: 'permission denied: add the user to the group that owns it, often dialout',
    errno.EPERM: 'permission denied: add the user to the group that owns it, often dialout',
    errno.EBUSY: 'another program has opened it: stop that one',
    errno.EAGAIN: 'another program has opened it: stop that one',
    errno.ENOTTY: 'it is no serial port: set another port',
    errno.EISDIR: 'it is a folder, no serial port: set another port',
    errno.EIO: 'the device was disconnected: plug it in again',
}


class PortError(OSError):
    """A port that cannot be opened, or is lost; the message is one sentence."""


class SerialPort:
    """
    A port that can be lost and opened again.

    Parameters
    ----------
    path : str
    baud : bits per second, with 8 data bits, no parity and 1 stop bit
    timeout : how long `read` waits for the first byte, in seconds

    """

    def __init__(self, path: str, baud: int, timeout: float = 0.1):
        self.path = path
        self.baud = baud
        self._timeout = timeout
        self._port: serial.Serial | None = None

    @property
    def is_open(self) -> bool:
        """Whether the port is open, as far as is known."""
        return self._port is not None

    def open(self) -> None:  # noqa: A003
        """
        Open the port for this program alone, and drop what came before.

        Raises
        ------
        PortError : it cannot be opened

        """
        self.close()
        try:
            self._port = serial.Serial(self.path, self.baud, timeout=self._timeout,
                                       write_timeout=1.0, exclusive=True)
        except (OSError, ValueError, termios.error) as error:
            raise PortError(f'cannot open {self.path}: {_reason(error)}') from error

    def read(self) -> bytes:
        """
        Return the bytes that are there, waiting a short time for the first; none, if none came.

        Raises
        ------
        PortError : the device was disconnected; the port is then closed

        """
        return self._guarded(self._read)

    def write(self, data: bytes) -> None:
        """
        Send bytes to the device.

        Raises
        ------
        PortError : the device was disconnected; the port is then closed

        """
        self._guarded(lambda port: port.write(data))

    def set_baud(self, baud: int) -> None:
        """
        Change the speed of the open port, and drop what came before.

        The device does not see it opened anew.

        Raises
        ------
        PortError : the device was disconnected, or lacks that speed; the port is then closed

        """
        self.baud = baud

        def change(port: serial.Serial) -> None:
            port.baudrate = baud
            port.reset_input_buffer()

        self._guarded(change)

    def close(self) -> None:
        """Close the port, if it is open."""
        port, self._port = self._port, None
        if port is not None:
            port.close()

    def _read(self, port: serial.Serial) -> bytes:
        # pyserial's own read gives the first byte alone, and needs two more calls for the rest
        if not select.select([port], [], [], self._timeout)[0]:
            return b''
        data = os.read(port.fileno(), 65536)
        if not data:
            raise OSError(errno.EIO, 'end of file')
        return data

    def _guarded(self, action: Callable[[serial.Serial], _Result]) -> _Result:
        if self._port is None:
            raise PortError(f'{self.path} is not open: open it first')
        try:
            return action(self._port)
        except (OSError, ValueError, termios.error) as error:
            self.close()
            raise PortError(f'lost {self.path}: {_reason(error)}') from error


def _reason(error: BaseException) -> str:
    """Return why a port failed, and a remedy; pyserial hides some error numbers in the cause."""
    cause: BaseException | None = error
    while cause is not None:
        number = getattr(cause, 'errno', None) or next(iter(cause.args), None)
        if number in _REMEDIES:
            return _REMEDIES[number]
        error, cause = cause, cause.__context__
    return f'{error}: set another port or baud'
