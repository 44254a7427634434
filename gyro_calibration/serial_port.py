"""
The serial port of a gyro, and the time stamps of its samples.

"""

from __future__ import annotations

import errno
import math
import os
import select
import termios
from collections.abc import Sequence

import serial

_REMEDIES = {
    errno.ENOENT: 'it does not exist: plug the gyro in, or set another port',
    errno.ENODEV: 'no device is behind it: plug the gyro in again',
    errno.EACCES: 'permission denied: add the user to the group that owns it, often dialout',
    errno.EPERM: 'permission denied: add the user to the group that owns it, often dialout',
    errno.EBUSY: 'another program has opened it: stop that one',
    errno.EAGAIN: 'another program has opened it: stop that one',
    errno.ENOTTY: 'it is no serial port: set another port',
    errno.EISDIR: 'it is a folder, no serial port: set another port',
    errno.EIO: 'the device is gone: plug it in again',
}


class PortError(OSError):
    """
    A port that cannot be opened, or is lost; the message is one sentence.

    """


class SerialPort:
    """
    A port that can be lost and opened again.

    Parameters
    ----------
    path : str
    baud : int
        Bits per second, with 8 data bits, no parity and 1 stop bit.
    timeout : float
        How long `read` waits for the first byte, in seconds.

    """

    def __init__(self, path: str, baud: int, timeout: float = 0.1):
        self.path = path
        self.baud = baud
        self._timeout = timeout
        self._port = None

    @property
    def is_open(self) -> bool:
        """
        Whether the port is open, as far as is known.

        """
        return self._port is not None

    def open(self) -> None:
        """
        Open the port for this program alone, and drop what came before.

        Raises
        ------
        PortError : it cannot be opened

        """
        self.close()
        try:
            self._port = serial.Serial(self.path, self.baud, timeout=self._timeout, write_timeout=1.0, exclusive=True)
        except (OSError, ValueError, termios.error) as error:
            raise PortError(f'cannot open {self.path}: {_reason(error)}') from error

    def read(self) -> bytes:
        """
        Return the bytes that are there, waiting a short time for the first; none, if none came.

        Raises
        ------
        PortError : the device is gone; the port is then closed

        """
        return self._guarded(self._read)

    def write(self, data: bytes) -> None:
        """
        Send bytes to the device.

        Raises
        ------
        PortError : the device is gone; the port is then closed

        """
        self._guarded(lambda port: port.write(data))

    def close(self) -> None:
        """
        Close the port, if it is open.

        """
        port, self._port = self._port, None
        if port is not None:
            port.close()

    def _read(self, port):
        # Without pyserial's own read, which gives the first byte alone and needs two more calls for the rest.
        if not select.select([port], [], [], self._timeout)[0]:
            return b''
        data = os.read(port.fileno(), 65536)
        if not data:
            raise OSError(errno.EIO, 'end of file')
        return data

    def _guarded(self, action):
        if self._port is None:
            raise PortError(f'{self.path} is not open: open it first')
        try:
            return action(self._port)
        except (OSError, termios.error) as error:
            self.close()
            raise PortError(f'lost {self.path}: {_reason(error)}') from error


def _reason(error):
    """
    Return why a port failed, and what to do about it; pyserial hides some error numbers in the cause.

    """
    while error is not None:
        number = getattr(error, 'errno', None) or next(iter(error.args), None)
        if number in _REMEDIES:
            return _REMEDIES[number]
        last, error = error, error.__context__
    return f'{last}: set another port or baud'


_LEAST_STEP = 1e-6  # s; what double precision can still tell apart in seconds since 1970
_GAP = 2.0  # average periods per sample, beyond which samples are missing
_GAIN = 0.05  # of the average period, a sample
_LARGEST_JUMP = 3.0  # s; beyond it the time of the device does not continue


class SampleClock:
    """
    Gives each sample its stamp; stamps increase strictly, unless the host's own clock is set back.

    By arrival, the last sample of a chunk has the time at which the chunk came, and those before it are spread evenly back to the
    previous stamp, so that the intervals add up to the time that passed; where samples are missing, the average period parts them.
    The gyro's nominal rate is used for the first chunk only: its clock is 2 to 3 % off from unit to unit.

    By the device, the first sample has the time at which it came, and from there the intervals of the device are trusted; so a recording
    can be replayed faster than it was made. After a jump of the device's time it begins anew, but never before the last stamp. Do not
    use it for hours with a device whose clock drifts: nothing ties it to the time of the host.

    Parameters
    ----------
    rate : float
        Nominal samples per second.
    use_device_time : bool

    """

    def __init__(self, rate: float, use_device_time: bool = False):
        self._period = 1.0 / rate
        self._use_device_time = use_device_time
        self._last = -math.inf
        self._arrival = -math.inf
        self._device_time, self._offset = None, 0.0

    def stamp(self, times: Sequence[float | None], arrival: float) -> list[float]:
        """
        Return the stamps of the samples of one chunk.

        Parameters
        ----------
        times : sequence of float or None, shape (n,)
            Times of the samples by the clock of the device, in seconds.
        arrival : float
            When the chunk came, by the clock of the host, in seconds.

        """
        if self._use_device_time and None not in times:
            return [self._follow_device(time, arrival) for time in times]
        return self._spread(len(times), arrival)

    def _spread(self, count, arrival):
        if count == 0:
            return []
        if arrival < self._arrival:
            self._last = -math.inf  # the clock of the host was set back, and the stamps go with it
        self._arrival = arrival
        arrival = max(arrival, self._last + count * _LEAST_STEP)
        period = self._measured_period(count, arrival)
        self._last = arrival
        return [arrival - (count - 1 - index) * period for index in range(count)]

    def _measured_period(self, count, arrival):
        if math.isinf(self._last):
            return self._period
        period = (arrival - self._last) / count
        gap = period > _GAP * self._period
        # Limited, so that one long gap does not spoil the average, and yet it finds a rate that is far from the nominal one.
        bounded = min(period, 4.0 * self._period)
        average, self._period = self._period, self._period + min(1.0, count * _GAIN) * (bounded - self._period)
        return average if gap else period

    def _follow_device(self, time, arrival):
        continues = self._device_time is not None and 0.0 <= time - self._device_time <= _LARGEST_JUMP
        self._device_time = time
        if not continues:
            self._offset = max(arrival, self._last + _LEAST_STEP) - time
        # Not the last stamp plus an interval, which would add up the rounding of seconds since 1970.
        self._last = max(time + self._offset, self._last + _LEAST_STEP)
        return self._last
