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
Write the samples of a gyro into a log file or an MCAP recording, so that nothing written is lost.

A file grows by whole pieces, one about each half second: rows of a log, or a chunk of a recording.
A program that is killed, or meets a full disk, leaves a file that is complete up to the last
piece, and none before the first. A file that is there already is never written to.

"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
import csv
from datetime import datetime, timezone
import gzip
import io
from io import FileIO
import os
from typing import Any

from gyro_calibration import __version__
from gyro_calibration.driver.protocols import Sample
from gyro_calibration.driver.protocols.protocol import ASSUMED_FORCE_NOISE, ASSUMED_NOISE
from gyro_calibration.logs import cdr
from gyro_calibration.logs.cdr import NSEC_PER_SEC
from gyro_calibration.logs.log import LogError
from gyro_calibration.logs.ros_bag import ABOUT, MCAP_END, McapWriter, Message

KINDS = '.csv', '.csv.gz', '.mcap'

#: s; how long what was recorded may stay in memory.
PIECE = 0.5
#: s; how long the columns of a log wait for a first temperature.
_PATIENCE = 3.0
_LARGEST_CHUNK = 1 << 22  # bytes


class DiskFull(OSError):
    """No more can be written; what was written stays."""


class AtomicAppender:
    """
    A new file that grows by whole pieces: each is in it completely, or not at all.

    The file is made with the first piece, so that a program that is killed before leaves its place
    free; that it can be made is tried at once, and raises OSError where it is there already.

    Attributes
    ----------
    size : bytes in the file
    is_full : whether a piece found no room

    """

    def __init__(self, path: str):
        self.path, self.size, self.is_full = path, 0, False
        self._file: FileIO | None = None
        open(path, 'xb').close()
        os.unlink(path)

    def append(self, piece: bytes) -> None:
        """Write a piece, or take back what of it was written and raise `DiskFull`."""
        left = memoryview(piece)
        try:
            file = self._file = self._file or FileIO(self.path, 'xb')
            while left:
                left = left[file.write(left):]
        except FileExistsError:
            self.is_full = True
            raise LogError(f'{self.path}: another program has created it meanwhile, and '
                           'recordings are never overwritten; give a new name') from None
        except OSError as error:
            self.is_full = True
            if self._file:
                self._file.truncate(self.size)
                self._file.seek(self.size)
            problem = f'{self.path}: writing has failed ({error.strerror})'
            raise DiskFull(error.errno, problem) from error
        self.size += len(piece)

    def close(self) -> None:
        """Close it; a file without a whole piece is removed."""
        if self._file is None:
            return
        self._file.close()
        if not self.size:
            os.unlink(self.path)


#: Gives the notes of a recording, when the first piece is written: some are found out until then.
Notes = Callable[[], Mapping[str, str]]


def about(**details: object) -> dict[str, str]:
    """Return the notes of a recording: the program, the date, and details that are known."""
    known = {name.replace('_', ' '): str(value)
             for name, value in details.items() if value not in (None, '')}
    date = datetime.now(timezone.utc).isoformat(timespec='seconds')
    return {'recorded by': f'gyro_calibration {__version__}', 'date': date, **known}


class _Recorder:
    """A new file of a path and its notes; it raises as `AtomicAppender` does."""

    def __init__(self, path: str, notes: Notes):
        self._file, self._notes = AtomicAppender(path), notes

    @property
    def size(self) -> int:
        """Bytes in the file."""
        return self._file.size


class McapRecorder(_Recorder):
    """
    Writes messages as they are into an MCAP file, a chunk a piece.

    Attributes
    ----------
    variance : of the rate of one sample of a port, (rad/s)²

    """

    def __init__(self, path: str, notes: Notes):
        super().__init__(path, notes)
        self._writer, self.variance = McapWriter(), ASSUMED_NOISE ** 2

    def add_sample(self, stamp: int, sample: Sample) -> None:
        """Write a sample of a port as messages on the topics of the driver; the stamp is in ns."""
        force, temperature = sample.specific_force, sample.temperature
        of_force = cdr.NO_COVARIANCE if force is None else cdr.along_z(ASSUMED_FORCE_NOISE ** 2)
        messages = [] if temperature is None else [
            ('/imu/temperature', cdr.TEMPERATURE, [temperature, 0.0])]
        messages.append(('/imu/data_raw', cdr.IMU, [
            0.0, 0.0, 0.0, 1.0, *cdr.NO_COVARIANCE,
            0.0, 0.0, sample.output, *cdr.along_z(self.variance),
            0.0, 0.0, force or 0.0, *of_force]))
        for topic, kind, numbers in messages:
            data = cdr.serialize(stamp, 'gyro', numbers)
            self.add_message(Message(topic, kind, stamp, data), cdr.DEFINITIONS[kind])

    def add_message(self, message: Message, definition: str) -> None:
        """Write a message with the definition of its kind, as text."""
        self._writer.add(message.topic, message.kind, definition, message.received, message.data)
        if self._writer.pending > _LARGEST_CHUNK:
            self.flush()

    def flush(self) -> None:
        """Write the piece that is due."""
        if self._writer.pending:
            head = b'' if self.size else self._writer.begin(
                f'gyro_calibration {__version__}', ABOUT, self._notes())
            self._file.append(head + self._writer.chunk())

    def close(self) -> None:
        """Write what is left and the closing part; after a full disk, without the index."""
        try:
            if not self._file.is_full:
                self.flush()
                if self.size:
                    self._file.append(self._writer.end())
            elif self.size:
                with suppress(DiskFull):  # no room for these bytes either: a reader finds it torn
                    self._file.append(MCAP_END)
        finally:
            self._file.close()


class CsvRecorder(_Recorder):
    """
    Writes samples as rows of the log format, some rows a piece.

    Which columns there are is decided with the first piece: a file of rows cannot get another one
    later. Values that come less often than samples, such as the temperature, are held until the
    next. Whether and how often a gyro sends its temperature is not known before, so the first
    piece waits for one.

    Attributes
    ----------
    missed : columns that came too late to get into the file

    """

    def __init__(self, path: str, notes: Notes):
        super().__init__(path, notes)
        self._is_packed = path.endswith('.gz')
        self._rows: list[tuple[int, dict[str, float]]] = []
        self._current: dict[str, float] = {}
        self._columns: list[str] = []
        self._begin = 0
        self.missed: set[str] = set()

    def add_sample(self, stamp: int, sample: Sample) -> None:
        """Write a sample of a port; the stamp is in ns."""
        values = {'temperature_degc': sample.temperature,
                  'acceleration_mps2': sample.specific_force, **sample.health}
        self._current |= {name: value for name, value in values.items() if value is not None}
        if self._columns:
            self.missed.update(set(self._current) - set(self._columns))
        self._rows.append((stamp, {'gyro_rad_s': sample.output, **self._current}))

    def flush(self, everything: bool = False) -> None:
        """Write the piece that is due."""
        if not self._rows:
            return
        if not (self._columns or everything):
            waited = (self._rows[-1][0] - self._rows[0][0]) / NSEC_PER_SEC
            if not waited > (2.0 * PIECE if 'temperature_degc' in self._current else _PATIENCE):
                return
        text = io.StringIO()
        writer = csv.writer(text, lineterminator='\n')
        if not self._columns:
            self._open(text, writer)
        for time, values in self._rows:
            writer.writerow([repr((time - self._begin) / NSEC_PER_SEC),
                             *(repr(values[name]) for name in self._columns)])
        data = text.getvalue().encode()
        self._file.append(gzip.compress(data, 6, mtime=0) if self._is_packed else data)
        self._rows.clear()

    def close(self) -> None:
        """Write what is left, unless a piece found no room: the header may have been in it."""
        try:
            if not self._file.is_full:
                self.flush(everything=True)
        finally:
            self._file.close()

    def _open(self, text: io.StringIO, writer: Any) -> None:
        """Write notes and header; what came first holds from the beginning."""
        first: dict[str, float] = {}
        for _, values in reversed(self._rows):
            first |= values
        self._rows = [(time, {**first, **values}) for time, values in self._rows]
        self._columns = list(self._rows[-1][1])
        self._begin = self._rows[0][0]
        seconds, nanoseconds = divmod(self._begin, NSEC_PER_SEC)
        begin = 'time_s counts from', f'{seconds}.{nanoseconds:09d} s'
        for name, value in (*self._notes().items(), begin):
            text.write(f'# {name}: {" ".join(value.split())}\n')
        writer.writerow(['time_s', *self._columns])
