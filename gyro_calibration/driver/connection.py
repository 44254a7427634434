# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""A gyro on a serial port: opens, recognizes and reads it, and opens it again after a loss."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
import errno
import glob
import math
from operator import attrgetter, sub
import os
import select
from statistics import fmean
import termios
import threading
from typing import NamedTuple

from gyro_calibration.driver.protocols import (
    AUTO, BAUDS, Counts, find_protocol, Protocol, recognize_protocol, Sample, Settings)
from gyro_calibration.driver.protocols.protocol import ASSUMED_FORCE_NOISE
from gyro_calibration.driver.timestamps import read_steady_clock, SampleClock
from gyro_calibration.logs import cdr
import serial

_REMEDIES = {
    errno.ENOENT: 'it does not exist: plug the gyro in, or set another port',
    errno.ENODEV: 'no device is behind it: plug the gyro in again',
    **dict.fromkeys((errno.EACCES, errno.EPERM), 'permission denied: add the user to the group '
                    'that owns it, often dialout'),
    **dict.fromkeys((errno.EBUSY, errno.EAGAIN), 'another program has opened it: stop that one'),
    errno.ENOTTY: 'it is no serial port: set another port',
    errno.EISDIR: 'it is a folder, no serial port: set another port',
    errno.EIO: 'the device was disconnected: plug it in again',
}


class PortError(OSError):
    """A port cannot be opened, or was lost; the message is one sentence."""


class SerialPort:
    """
    A port that can be lost and opened again, with 8 data bits, no parity and 1 stop bit.

    Each method raises `PortError` where the device fails; the port is then closed.
    """

    def __init__(self, path: str, baud: int):
        self.path, self.baud = path, baud
        self._port: serial.Serial | None = None

    def open(self) -> None:  # noqa: A003
        """Open the port exclusively, and discard earlier input."""
        self.close()
        try:
            self._port = serial.Serial(self.path, self.baud, write_timeout=1.0, exclusive=True)
        except (OSError, ValueError, termios.error) as error:
            raise PortError(f'cannot open {self.path}: {_describe_error(error)}') from error

    def read(self) -> bytes:
        """Return the available bytes; wait for the first one up to 0.1 s."""
        with self._open_port() as port:
            # read of pyserial returns the first byte alone, and needs two more calls for the rest
            if not select.select([port], [], [], 0.1)[0]:
                return b''
            data = os.read(port.fileno(), 65536)
            if not data:
                raise OSError(errno.EIO, 'end of file')
            return data

    def write(self, data: bytes) -> None:
        with self._open_port() as port:
            port.write(data)

    def set_baud(self, baud: int) -> None:
        """Change the baud rate and discard input, without opening the port again."""
        with self._open_port() as port:
            self.baud = port.baudrate = baud
            port.reset_input_buffer()

    def close(self) -> None:
        port, self._port = self._port, None
        if port is not None:
            port.close()

    @contextmanager
    def _open_port(self) -> Iterator[serial.Serial]:
        if self._port is None:
            raise PortError(f'{self.path} is not open: open it first')
        try:
            yield self._port
        except (OSError, ValueError, termios.error) as error:
            self.close()
            raise PortError(f'lost {self.path}: {_describe_error(error)}') from error


def _describe_error(error: BaseException) -> str:
    """Return why a port failed, with a remedy; pyserial has some error numbers in the cause."""
    cause: BaseException | None = error
    while cause is not None:
        number = getattr(cause, 'errno', None) or next(iter(cause.args), None)
        if number in _REMEDIES:
            return _REMEDIES[number]
        error, cause = cause, cause.__context__
    return f'{error}: set another port or baud'


MAX_BAUD = 4_000_000  # bit/s; the fastest serial line of Linux
_SILENCE_TIMEOUT = 2.0  # s; time without a sample, after which the port is opened again
#: Longest silence of a board that restarts when its port is opened, and of delays to open it, s.
_RESTART_DURATION = 5.0
#: Interval of attempts to recognize the protocol, and first delay before a port is reopened, s.
_ATTEMPT_INTERVAL = 0.1
#: Listening time at a baud, s, for ten samples of a slow gyro; and interval of requests to send.
_LISTENING_DURATION = 1.0


@dataclass(frozen=True)
class _Chunk:
    """Samples that arrived at one time, by the steady clock of the host, s."""

    samples: list[Sample]
    stamps: list[float]  # times of sending; strictly increasing over all chunks
    arrival: float


@dataclass(frozen=True)
class ConnectionState:
    """State of a connection: opening, listening, reading (samples come) or failed."""

    name: str
    problem: str = ''  # one sentence while failed
    retry_delay: float = 0.0  # s; while failed: time until the port is opened again


def resolve_port(port: str) -> str:
    """Return the port that matches a pattern, or a path itself; none or several: `PortError`."""
    if os.path.exists(port) or not glob.has_magic(port):
        return port
    matches = sorted(glob.glob(port))
    if not matches:
        raise PortError(f'no port matches {port}: plug the gyro in, or set another port')
    if len({os.path.realpath(match) for match in matches}) > 1:
        raise PortError(f'{len(matches)} ports match {port}: {", ".join(matches)}; set port to '
                        'one of them')
    return matches[0]


class Connection:
    """
    Gives the samples of a gyro, with stamps, until it is stopped.

    If the port is lost, or no sample comes for 2 s (three periods of a slower gyro), it is opened
    again after 0.1 s, then with twice the delay each time, up to 5 s, until samples come. Many
    boards restart when their port is opened, so the port then stays open for 5 s more, and the
    gyro is requested to send each second, until the first sample. With the protocol ``'auto'`` it
    first listens, at each baud in turn unless one is given, and sends nothing.

    The port is a path, or a pattern that finds it under any name; the baud is in bit/s, 0 for that
    of the protocol. `on_change` is called in the thread that reads. Raise `ValueError` for an
    unknown protocol, or missing settings. Tests have a clock of their own, s, and ports.
    """

    def __init__(self, port: str, protocol: str, baud: int = 0,
                 settings: Settings | None = None,
                 on_change: Callable[[ConnectionState], None] = lambda state: None,
                 clock: Callable[[], float] = read_steady_clock,
                 make_port: Callable[[str, int], SerialPort] = SerialPort):
        self._pattern, self._settings = port, settings or Settings()
        self._bauds = (baud,) if baud else BAUDS
        self._on_change, self._read_clock, self._make_port = on_change, clock, make_port
        self.state = ConnectionState('opening')
        self.protocol: Protocol | None = None  # until it is known
        self.clock: SampleClock | None = None
        self.counts = Counts()  # of the thread that reads
        self._port: SerialPort | None = None
        self._last_stamp = -math.inf
        self._reopen_delay, self._read_bytes = _ATTEMPT_INTERVAL, 0
        self.baud, self.last_error = 0, ''
        self.path = ''  # the device of the port when it was last opened, links resolved
        self.open_count, self.waited_duration = 0, 0.0  # s
        self.longest_gap = 0.0  # between two samples, s; 0 while none exceeds 1.5 periods
        self._is_auto = protocol == AUTO
        if not self._is_auto:
            try:
                known = find_protocol(protocol)
            except ValueError as error:
                raise ValueError(f'{error}, or {AUTO} to find it by listening') from None
            self._set_protocol(known, baud or known.baud)

    def chunks(self, stop: threading.Event) -> Iterator[_Chunk]:
        """Give samples as they arrive, until the event is set; the port is then closed."""
        try:
            while not stop.is_set():
                try:
                    yield from self._read(stop)
                except PortError as error:
                    self._close()
                    self._set_state('failed', str(error), self._reopen_delay)
                    begin = self._read_clock()
                    stop.wait(self._reopen_delay)
                    self.waited_duration += self._read_clock() - begin
                    self._reopen_delay = min(2.0 * self._reopen_delay, _RESTART_DURATION)
        finally:
            self._close()

    def _set_protocol(self, protocol: Protocol, baud: int) -> None:
        protocol.check_settings(self._settings)
        self.clock = SampleClock(protocol.nominal_rate(self._settings), protocol.modulus,
                                 self._last_stamp)
        self.protocol, self.baud = protocol, baud

    def _listen(self, port: SerialPort, stop: threading.Event) -> None:
        """Find protocol and baud; they stay unknown only after a stop."""
        # the port stays open, since opening it restarts many microcontrollers
        self._set_state('listening')
        end = self._read_clock() + _SILENCE_TIMEOUT + _RESTART_DURATION
        while True:
            for baud in self._bauds:
                port.set_baud(baud)
                # within 1 s after the first byte
                data, opened, last, due = b'', self._read_clock(), math.inf, 0.0
                while True:
                    if stop.is_set():
                        return
                    data += port.read()
                    now = self._read_clock()
                    if not data and now - opened > _SILENCE_TIMEOUT:
                        self._report_or_raise(self._no_data_message(_SILENCE_TIMEOUT), end)
                    if data and now >= due:
                        found = recognize_protocol(data, self._settings)
                        due, last = now + _ATTEMPT_INTERVAL, min(last, now + _LISTENING_DURATION)
                        if found is not None or now >= last:
                            break
                if found is not None:
                    try:
                        self._set_protocol(found, baud)
                    except ValueError as error:
                        raise PortError(f'{found.name} comes on {self._pattern}, but '
                                        f'{error}') from error
                    return
            self._report_or_raise(
                f'bytes come on {self._pattern}, but of no known protocol at '
                f'{", ".join(map(str, self._bauds))} bit/s: set protocol, or for csv columns', end)

    def _report_or_raise(self, problem: str, deadline: float) -> None:
        """Report a problem while the port stays open; raise `PortError` after a time."""
        now = self._read_clock()
        if now >= deadline:
            raise PortError(problem)
        if problem != self.state.problem:
            self._set_state('failed', problem, deadline - now)

    def _read(self, stop: threading.Event) -> Iterator[_Chunk]:
        """Open the port, listen if the protocol is unknown, and read until a loss of the port."""
        path = resolve_port(self._pattern)
        self.path = os.path.realpath(path)
        self._port = port = self._make_port(path, self.baud if self.protocol else self._bauds[0])
        port.open()
        self.open_count += 1
        if self.protocol is None:
            self._listen(port, stop)
        protocol, clock, counts = self.protocol, self.clock, self.counts
        if protocol is None or clock is None:  # stopped while listening
            return
        port.write(protocol.startup)
        decoder = protocol.decoder(self._settings, counts)
        clock.interrupt()
        received, begin = 0, self._read_clock()
        last_request, seen = begin, list[tuple[int, int, int]]()
        while not stop.is_set():
            data = port.read()
            now = self._read_clock()
            samples = decoder.feed(data)
            self._read_bytes += len(data)
            if samples:
                lost = clock.lost_count
                stamps = clock.stamp_samples(samples, now)
                counts.lost_samples += clock.lost_count - lost
                if counts.samples:
                    longest = max(map(sub, stamps, [self._last_stamp, *stamps]))
                    if longest > max(self.longest_gap, 1.5 * clock.period):
                        self.longest_gap = longest
                counts.samples, self._last_stamp = counts.samples + len(samples), stamps[-1]
                if self.state.name != 'reading':
                    self._reopen_delay = _ATTEMPT_INTERVAL
                    self._set_state('reading')
                yield _Chunk(samples, stamps, now)
                received, begin, seen = received + len(samples), now, []
                continue
            if not received and now - last_request >= _LISTENING_DURATION:
                port.write(protocol.startup)
                last_request = now
            timeout = max(_SILENCE_TIMEOUT, 3.0 * clock.period)
            # to open the port again would restart a board that still starts; the second sample
            # shows the period
            deadline = begin + timeout + (_RESTART_DURATION if received < 2 else 0.0)
            if now >= min(begin + 0.5 * timeout * (len(seen) + 1), deadline):
                seen.append((self._read_bytes, counts.device_faults, counts.refused_samples))
                if len(seen) > 1:
                    problem = self._explain_silence(seen[-2], seen[-1], timeout)
                    self._report_or_raise(problem, deadline)

    def _explain_silence(self, before: tuple[int, int, int], after: tuple[int, int, int],
                         limit: float) -> str:
        """Return why no samples come, by the counts of bytes, faults and refused samples."""
        has_bytes, has_faults, is_beyond = (
            now > then for now, then in zip(after, before, strict=True))
        port = self._pattern
        if has_faults:
            return (f'the gyro on {port} marks all samples as invalid for {limit:g} s: turn it '
                    'off and on, then have it checked')
        if is_beyond:
            return (f'all samples on {port} are beyond full scale for {limit:g} s: check '
                    'protocol, sensitivity and full_scale')
        if not has_bytes:
            return self._no_data_message(limit)
        assert self.protocol is not None
        problem = (f'bytes come on {port}, but no sample of {self.protocol.name} for {limit:g} s: '
                   'check protocol, baud and columns')
        if self._is_auto:
            self.clock = self.protocol = None  # listen again
            raise PortError(problem)
        return problem

    def _no_data_message(self, limit: float) -> str:
        return (f'nothing comes on {self._pattern} for {limit:g} s: check the power and the wires '
                'of the gyro')

    def _set_state(self, name: str, problem: str = '', retry_delay: float = 0.0) -> None:
        self.last_error = problem or self.last_error
        self.state = ConnectionState(name, problem, retry_delay)
        self._on_change(self.state)

    def _close(self) -> None:
        if self._port is not None:
            self._port.close()


def sample_messages(sample: Sample, stamp: int, frame: str,
                    variance: float) -> list[tuple[str, bytes]]:
    """
    Return types and serialized messages of a sample: its temperature if known, its rate.

    The stamp is in ns, the variance of the rate in (rad/s)².
    """
    force = sample.specific_force
    imu = (0.0, 0.0, 0.0, 1.0, *cdr.NOT_REPORTED_COVARIANCE,
           0.0, 0.0, sample.output, *cdr.z_axis_covariance(variance),
           0.0, 0.0, force or 0.0, *(cdr.NOT_REPORTED_COVARIANCE if force is None
                                     else cdr.z_axis_covariance(ASSUMED_FORCE_NOISE ** 2)))
    messages = [(cdr.IMU, cdr.serialize(stamp, frame, imu))]
    if sample.temperature is not None:
        messages.insert(0, (cdr.TEMPERATURE,
                            cdr.serialize(stamp, frame, (sample.temperature, 0.0))))
    return messages


class SampleMean(NamedTuple):
    """The mean stamp, s, and the mean of a number of samples."""

    stamp: float
    sample: Sample
    sample_count: int


class Decimator:
    """Averages groups of samples; a group with losses has fewer samples and the same length."""

    def __init__(self, size: int):
        self._size = size
        self._group: list[tuple[float, Sample]] = []

    def add(self, samples: Sequence[Sample], stamps: Sequence[float],
            period: float) -> Iterator[SampleMean]:
        """Add samples with stamps and the period of the gyro, s; give means of complete groups."""
        longest = (self._size - 0.5) * period
        for sample, stamp in zip(samples, stamps, strict=True):
            if self._group and not 0.0 < stamp - self._group[0][0] < longest:
                yield from self.flush()
            self._group.append((stamp, sample))
            if len(self._group) >= self._size:
                yield from self.flush()

    def flush(self) -> Iterator[SampleMean]:
        """Give the mean of an incomplete group, before a wait for the next sample."""
        if not self._group:
            return
        group, self._group = self._group, []
        if len(group) == 1:
            yield SampleMean(*group[0], 1)
            return
        stamps, samples = zip(*group, strict=True)
        begin = stamps[0]  # sums of seconds since 1970 would lose digits
        temperatures, forces = (
            [value for value in map(attrgetter(name), samples) if value is not None]
            for name in ('temperature', 'specific_force'))
        yield SampleMean(begin + fmean(stamp - begin for stamp in stamps),
                         Sample(fmean(sample.output for sample in samples),
                                fmean(temperatures) if temperatures else None,
                                specific_force=fmean(forces) if forces else None), len(group))
