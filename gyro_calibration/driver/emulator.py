# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""A gyro on a pseudo-terminal, which programs open like the port of a real one."""

from __future__ import annotations

from collections.abc import Iterable
import contextlib
from dataclasses import replace
import os
from pathlib import Path
import select
import threading
import time
import tty

from gyro_calibration.driver.protocols import Protocol, Sample, Settings

_POLL_INTERVAL = 0.05  # s; interval of checks for a reader or a stop


class Emulator:
    """
    An emulated gyro: `open`, `run` and `close` it, or use it as a context manager with a thread.

    Each sample, with a time, s, is taken from the source after the one before it was sent, so a
    source may be endless and may depend on commands. Samples without a sequence are numbered from
    0.

    The speed is a factor of real time; inf is the speed of the reader. Up to 1, bytes that are not
    read are lost, as on a real line; above 1 the emulator waits for the reader. Raise `ValueError`
    where settings that the protocol needs are missing.
    """

    def __init__(self, protocol: Protocol, samples: Iterable[Sample],
                 settings: Settings | None = None, speed: float = 1.0,
                 link: str | Path | None = None, wait_for_reader: bool = False):
        self._settings = settings or Settings()
        protocol.check_settings(self._settings)
        self._protocol, self._samples, self._speed = protocol, samples, speed
        self.link = None if link is None else Path(link)
        self._wait_for_reader = wait_for_reader
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self.run, name='emulator')
        self._master, self._reader_poll = -1, select.poll()
        self.path, self.sent_bytes, self.lost_bytes = '', 0, 0

    def open(self) -> None:  # noqa: A003
        """Make the pseudo-terminal and the link to it; `path` is then its name."""
        self._master, slave = os.openpty()
        tty.setraw(slave)  # without echo and line discipline
        self.path = os.ttyname(slave)
        os.close(slave)
        os.set_blocking(self._master, False)
        self._reader_poll.register(self._master, select.POLLIN)
        if self.link is None:
            return
        try:
            if self.link.exists() and not self.link.is_symlink():
                raise FileExistsError(f'{self.link} is no link, so it is not replaced: give '
                                      'another path for the link')
            temporary = self.link.with_name(f'.{self.link.name}.{os.getpid()}')
            os.symlink(self.path, temporary)
            os.replace(temporary, self.link)
        except OSError:
            self.close()
            raise

    def run(self) -> None:
        """Send the samples, which must have times, until they end or `stop` is called."""
        if self._wait_for_reader:
            while not self.has_reader() and not self._stop.wait(_POLL_INTERVAL):
                pass
            self._stop.wait(0.2)  # s; a reader that has opened the port discards its input
        self._send(self._protocol.preamble)
        encode, start, begin = self._protocol.encoder(self._settings), time.monotonic(), None
        for number, sample in enumerate(self._samples):
            assert sample.time is not None
            due = sample.time / self._speed
            begin = due if begin is None else begin
            wait = start + due - begin - time.monotonic()
            if self._stop.wait(wait) if wait > 0.0 else self._stop.is_set():
                return
            self._send(encode(sample if sample.sequence is not None
                              else replace(sample, sequence=number)))
        if self.has_reader():
            self._stop.wait(1.0)  # s, since closing discards data that were not read

    def has_reader(self) -> bool:
        """Return whether a program has the port open; discard its output."""
        events = dict(self._reader_poll.poll(0)).get(self._master, 0)
        if events & select.POLLIN:
            with contextlib.suppress(OSError):
                os.read(self._master, 65536)
        return not events & select.POLLHUP

    def wait_for_end_of_reader(self) -> None:
        """Wait up to 0.5 s for a driver that ends too, and would report a lost port."""
        deadline = time.monotonic() + 0.5
        while self.has_reader() and time.monotonic() < deadline:
            time.sleep(_POLL_INTERVAL)

    def stop(self) -> None:
        """Make `run` return soon; may be called from any thread and from a signal handler."""
        self._stop.set()

    def close(self) -> None:
        """Close the pseudo-terminal and remove the link, as if the gyro was unplugged."""
        link = self.link
        if link is not None and link.is_symlink() and os.readlink(link) == self.path:
            link.unlink()
        if self._master >= 0:
            os.close(self._master)
            self._master = -1

    def __enter__(self) -> Emulator:
        self.open()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
        self._thread.join()
        self.close()

    def _send(self, data: bytes) -> None:
        while data and not self._stop.is_set():
            written = 0
            if self.has_reader():
                with contextlib.suppress(BlockingIOError):
                    written = os.write(self._master, data)
            self.sent_bytes += written
            data = data[written:]
            if data and self._speed <= 1.0:
                self.lost_bytes += len(data)
                return
            if data:
                self._stop.wait(_POLL_INTERVAL / 10)
