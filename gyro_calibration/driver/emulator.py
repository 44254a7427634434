# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""
A gyro on a pseudo-terminal: samples of a simulation or a recording, sent at their times.

A program opens the path of the emulator as it would open the port of a real gyro. What it sends is
read and ignored.

"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
import contextlib
from dataclasses import replace
import math
import os
from pathlib import Path
import select
import threading
import time
import tty

from gyro_calibration.driver.protocols import Protocol, Sample, Settings
from gyro_calibration.driver.serial_faults import damaged, delivered, SerialFaults
import numpy as np

_POLL = 0.05  # s; how soon a reader, or the wish to stop, is noticed
_SETTLING = 0.2  # s; a reader that opens a port drops what is in it just afterwards
_LINGERING = 1.0  # s; closing a pseudo-terminal throws away what its reader has not yet taken
_BATCH = 0.0005  # s; samples due within it are written together, as waiting takes too long


class Emulator:
    """
    A gyro that programs can open.

    Use it as a context manager, which sends from a thread of its own, or call `emulate`, which
    sends until the samples end.

    Samples are pulled one by one, each after the one before it was sent, so a source may be
    endless and may follow a motion that is commanded meanwhile. The time of the first is the
    beginning; a source that is itself slower than its times sets the pace. Above 2 kHz, and on a
    line with bursts, a few samples are pulled before they are sent together.

    Samples without a sequence are numbered from 0 on, before any are lost.

    Parameters
    ----------
    protocol : Protocol
    samples : iterable of Sample
        Each with its time, in seconds.
    settings : Settings or None
    speed : float
        Times real time; inf is as fast as the reader reads. At 1 or slower, bytes that are not
        read are lost, as on a real line; faster is a replay, which waits for the reader.
    link : path or None
        A symbolic link to the pseudo-terminal, whose own name differs from run to run. It is
        removed at the end.
    wait_for_reader : bool
        Whether to send the first sample only after a reader has opened the port.
    faults : SerialFaults or None
        What happens to samples and bytes on their way; None for nothing.
    generator : numpy.random.Generator or None
        Chooses which of them; a line without faults needs none.

    Raises
    ------
    ValueError : the speed is not above 0, the settings do not suffice for the protocol, or a
        generator is missing
    FileExistsError : the place of the link is taken by a file that is no link

    """

    def __init__(
        self,
        protocol: Protocol,
        samples: Iterable[Sample],
        settings: Settings | None = None,
        speed: float = 1.0,
        link: str | Path | None = None,
        wait_for_reader: bool = False,
        faults: SerialFaults | None = None,
        generator: np.random.Generator | None = None,
    ):
        if not speed > 0.0:
            raise ValueError(f'speed is {speed}, but must be above 0; 1 is real time')
        self._settings = settings or Settings()
        protocol.check(self._settings)
        self._protocol = protocol
        self._samples = samples
        self._speed = speed
        self.link = None if link is None else Path(link)
        self._wait_for_reader = wait_for_reader
        self._faults = faults = faults or SerialFaults()
        if generator is None and faults.is_random:
            raise ValueError('the line loses or damages bytes at random: give a numpy Generator')
        self._generator = generator or np.random.default_rng(0)  # never asked
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self.run, name='emulator')
        self._master, self._reader_poll = -1, select.poll()
        self.path = ''
        self.sent_bytes = 0
        self.lost_bytes = 0

    def open(self) -> None:  # noqa: A003
        """Make the pseudo-terminal and the link to it; `path` is then its name."""
        self._master, slave = os.openpty()
        tty.setraw(slave)  # else it echoes samples, and its line discipline takes characters out
        self.path = os.ttyname(slave)
        os.close(slave)
        os.set_blocking(self._master, False)
        self._reader_poll.register(self._master, select.POLLIN)
        try:
            self._make_link()
        except OSError:
            self.close()
            raise

    def run(self) -> None:
        """
        Send the samples until they end or `stop` is called.

        Raises
        ------
        ValueError : a sample has no time

        """
        if self._wait_for_reader:
            self._wait_until_read()
        self._send(self._protocol.preamble)
        self._send_in_time(delivered(self._faults, self._frames(), self._protocol.baud))
        if self.is_read():
            self._stop.wait(_LINGERING)

    def is_read(self) -> bool:
        """Return whether a program has the port open; what it has written is dropped."""
        events = dict(self._reader_poll.poll(0)).get(self._master, 0)
        if events & select.POLLIN:
            with contextlib.suppress(OSError):
                os.read(self._master, 65536)
        return not events & select.POLLHUP

    def stop(self) -> None:
        """Make `run` return soon; may be called from any thread and from a signal handler."""
        self._stop.set()

    def close(self) -> None:
        """Unplug the gyro: its reader sees that the port is gone."""
        link = self.link
        if link is not None and link.is_symlink() and os.readlink(link) == self.path:
            link.unlink()
        if self._master >= 0:
            os.close(self._master)
            self._master = -1

    def join(self) -> None:
        """Wait until all samples were sent."""
        self._thread.join()

    def __enter__(self) -> Emulator:
        self.open()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
        self._thread.join()
        self.close()

    def _make_link(self) -> None:
        if self.link is None:
            return
        if self.link.exists() and not self.link.is_symlink():
            raise FileExistsError(f'{self.link} is no link, so it is not replaced: give another '
                                  'path for the link')
        temporary = self.link.with_name(f'.{self.link.name}.{os.getpid()}')
        os.symlink(self.path, temporary)
        os.replace(temporary, self.link)

    def _wait_until_read(self) -> None:
        while not self.is_read() and not self._stop.wait(_POLL):
            pass
        self._stop.wait(_SETTLING)

    def _stopped_before(self, due: float, earliest: float) -> bool:
        now = time.monotonic()
        return self._stop.wait(max(due, earliest) - now) if due > now else self._stop.is_set()

    def _frames(self) -> Iterator[tuple[float, bytes]]:
        """
        Yield when each sample is due after the first, in the time of the host, and its bytes.

        Lost samples are left out.

        """
        begin, faults, generator = None, self._faults, self._generator
        encode = self._protocol.encoder(self._settings)
        for number, sample in enumerate(self._samples):
            due = _time(sample) / self._speed
            begin = due if begin is None else begin
            if faults.lost_samples and generator.random() < faults.lost_samples:
                continue
            if sample.sequence is None:
                sample = replace(sample, sequence=number)
            invalid = faults.invalid_samples and generator.random() < faults.invalid_samples
            yield due - begin, damaged(faults, encode(sample, not invalid), generator)

    def _send_in_time(self, pieces: Iterable[tuple[float, bytes]]) -> None:
        """Send each piece at its time, or with others that are due at once."""
        start, pending, sent = time.monotonic(), b'', -math.inf
        batch = 0.0 if self._faults.piece else _BATCH
        for due, data in pieces:
            if pending and start + due > time.monotonic():
                self._send(pending)
                pending, sent = b'', time.monotonic()
            if self._stopped_before(start + due, sent + batch):
                return
            pending += data
            if time.monotonic() >= sent + batch:
                self._send(pending)
                pending, sent = b'', time.monotonic()
        self._send(pending)

    def _send(self, data: bytes) -> None:
        while data and not self._stop.is_set():
            written = self._write(data)
            self.sent_bytes += written
            data = data[written:]
            if data and self._speed <= 1.0:
                self.lost_bytes += len(data)
                return
            if data:
                self._stop.wait(_POLL / 10)

    def _write(self, data: bytes) -> int:
        if not self.is_read():
            return 0
        try:
            return os.write(self._master, data)
        except BlockingIOError:
            return 0


def _time(sample: Sample) -> float:
    if sample.time is None:
        raise ValueError('a sample has no time at which to send it: set Sample.time in seconds')
    return sample.time


def emulate(emulator: Emulator, announce: Callable[[str], None] = lambda path: None) -> None:
    """
    Send all samples of an emulator from this thread, and clean up also after an interrupt.

    Parameters
    ----------
    emulator : Emulator
    announce : callable
        Gets the path to open, once it is there.

    """
    try:
        emulator.open()
        announce(emulator.path if emulator.link is None else str(emulator.link))
        emulator.run()
    finally:
        emulator.close()
