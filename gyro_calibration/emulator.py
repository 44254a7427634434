"""
A gyro on a pseudo-terminal: samples from a simulation or a recording, sent in a wire format at their times.

A program opens the emulator's path as it would open the port of a real gyro. What it sends is read and ignored.

"""

from __future__ import annotations

import contextlib
import os
import select
import threading
import time
import tty
from collections.abc import Callable, Iterable
from pathlib import Path

from .protocols import Protocol, Sample, Settings

_POLL = 0.05  # s; how soon a reader, or the wish to stop, is noticed
_SETTLING = 0.2  # s; a reader that opens a port drops what is in it just afterwards
_LINGERING = 1.0  # s; closing a pseudo-terminal throws away what its reader has not yet taken


class Emulator:
    """
    A gyro that programs can open.

    Use it as a context manager, which sends from a thread of its own, or call `emulate`, which sends until the samples end.

    Samples are pulled one by one, each after the one before it was sent, so a source may be endless and may follow a motion that is
    commanded meanwhile. The time of the first is the beginning; a source that is itself slower than its times sets the pace.

    Parameters
    ----------
    protocol : Protocol
    samples : iterable of Sample
        Each with its time, in seconds.
    settings : Settings or None
    speed : float
        How many times faster than real time; inf is as fast as the reader reads. At 1 or slower, bytes that nobody reads are lost, as on
        a real line; faster is a replay, so it waits for the reader.
    link : path or None
        A symbolic link to the pseudo-terminal, whose own name differs from run to run. It is removed at the end.
    wait_for_reader : bool
        Whether to send the first sample only after a reader has opened the port.

    Raises
    ------
    ValueError : the speed is not above 0, or the settings do not suffice for the protocol
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
    ):
        if not speed > 0.0:
            raise ValueError(f'speed is {speed}, but must be above 0: 1 is real time, 10 is ten times faster')
        self._settings = settings or Settings()
        protocol.check(self._settings)
        self._protocol = protocol
        self._samples = samples
        self._speed = speed
        self.link = None if link is None else Path(link)
        self._wait_for_reader = wait_for_reader
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self.run, name='emulator')
        self._master, self._reader_poll = -1, select.poll()
        self.path = ''
        self.sent_bytes = 0
        self.lost_bytes = 0

    def open(self) -> None:
        """
        Make the pseudo-terminal and the link to it; `path` is then its name.

        """
        self._master, slave = os.openpty()
        tty.setraw(slave)  # else it echoes every sample, and its line discipline eats control characters
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
        self._send(self._protocol.awakening)
        start = None
        for sample in self._samples:
            due = _time(sample) / self._speed
            start = time.monotonic() - due if start is None else start
            if self._stopped_before(start + due):
                return
            self._send(self._protocol.encode(sample, self._settings))
        if self.is_read():
            self._stop.wait(_LINGERING)

    def is_read(self) -> bool:
        """
        Return whether a program has the port open; what it has written is dropped.

        """
        events = dict(self._reader_poll.poll(0)).get(self._master, 0)
        if events & select.POLLIN:
            with contextlib.suppress(OSError):
                os.read(self._master, 65536)
        return not events & select.POLLHUP

    def stop(self) -> None:
        """
        Make `run` return soon; may be called from any thread and from a signal handler.

        """
        self._stop.set()

    def close(self) -> None:
        """
        Unplug the gyro: its reader sees that the port is gone.

        """
        if self.link is not None and self.link.is_symlink() and os.readlink(self.link) == self.path:
            self.link.unlink()
        if self._master >= 0:
            os.close(self._master)
            self._master = -1

    def join(self) -> None:
        """
        Wait until all samples were sent.

        """
        self._thread.join()

    def __enter__(self) -> Emulator:
        self.open()
        self._thread.start()
        return self

    def __exit__(self, *_) -> None:
        self.stop()
        self._thread.join()
        self.close()

    def _make_link(self):
        if self.link is None:
            return
        if self.link.exists() and not self.link.is_symlink():
            raise FileExistsError(f'{self.link} is no link, so it is not replaced: choose another path for the link')
        temporary = self.link.with_name(f'.{self.link.name}.{os.getpid()}')
        os.symlink(self.path, temporary)
        os.replace(temporary, self.link)

    def _wait_until_read(self):
        while not self.is_read() and not self._stop.wait(_POLL):
            pass
        self._stop.wait(_SETTLING)

    def _stopped_before(self, due):
        delay = due - time.monotonic()
        return self._stop.wait(delay) if delay > 0.0 else self._stop.is_set()

    def _send(self, data):
        while data and not self._stop.is_set():
            written = self._write(data)
            self.sent_bytes += written
            data = data[written:]
            if data and self._speed <= 1.0:
                self.lost_bytes += len(data)
                return
            if data:
                self._stop.wait(_POLL / 10)

    def _write(self, data):
        if not self.is_read():
            return 0
        try:
            return os.write(self._master, data)
        except BlockingIOError:
            return 0


def _time(sample):
    if sample.time is None:
        raise ValueError('a sample has no time, but the emulator sends each at its time: set Sample.time in seconds')
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
