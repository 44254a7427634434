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
Recorders of the samples of a gyro into a log file or an MCAP recording.

A file grows by complete pieces, about two per second: rows of a log, or a chunk of a recording.
After a kill or on a full disk the file is complete up to the last piece; before the first piece
there is no file. Existing files are never overwritten.

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
from gyro_calibration.logs.ros_bag import MCAP_END, McapWriter, Message, METADATA_NAME

FILE_SUFFIXES = '.csv', '.csv.gz', '.mcap'

#: Interval of pieces, s: the longest time that samples stay in memory.
WRITE_INTERVAL = 0.5
#: Longest wait of the first piece of a log for a temperature, s.
_TEMPERATURE_WAIT = 3.0
_MAX_CHUNK_BYTES = 1 << 22  # bytes


class DiskFull(OSError):
    """Nothing more can be written; the written pieces remain."""


class AtomicAppender:
    """
    A new file that grows by complete pieces.

    The file is created with the first piece, so that a program killed earlier leaves none. The
    constructor tests that it can be created, and raises OSError where it exists.

    Attributes
    ----------
    size : bytes in the file
    is_full : whether a piece could not be written

    """

    def __init__(self, path: str):
        self.path, self.size, self.is_full = path, 0, False
        self._file: FileIO | None = None
        open(path, 'xb').close()
        os.unlink(path)

    def append(self, piece: bytes) -> None:
        """Write a piece; on an error truncate the file to the pieces before, raise `DiskFull`."""
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
        """Close the file; remove it if it has no complete piece."""
        if self._file is None:
            return
        self._file.close()
        if not self.size:
            os.unlink(self.path)


#: Returns the notes of a recording; called with the first piece, when all notes are known.
NotesCallback = Callable[[], Mapping[str, str]]


def recording_notes(**details: object) -> dict[str, str]:
    """Return the notes of a recording: program, date, and details except empty ones."""
    known = {name.replace('_', ' '): str(value)
             for name, value in details.items() if value not in (None, '')}
    date = datetime.now(timezone.utc).isoformat(timespec='seconds')
    return {'recorded by': f'gyro_calibration {__version__}', 'date': date, **known}


class McapRecorder:
    """
    Writes serialized messages into an MCAP file; each piece is a chunk.

    Attributes
    ----------
    file : the `AtomicAppender`
    variance : variance of the rate of a sample, (rad/s)²

    """

    def __init__(self, path: str, notes: NotesCallback):
        self.file, self._notes = AtomicAppender(path), notes
        self._writer, self.variance = McapWriter(), ASSUMED_NOISE ** 2

    def add_sample(self, stamp: int, sample: Sample) -> None:
        """Write a sample as messages on the topics of the driver; the stamp is in ns."""
        force, temperature = sample.specific_force, sample.temperature
        of_force = (cdr.NOT_REPORTED_COVARIANCE
                    if force is None else cdr.z_axis_covariance(ASSUMED_FORCE_NOISE ** 2))
        messages = [] if temperature is None else [
            ('/imu/temperature', cdr.TEMPERATURE, [temperature, 0.0])]
        messages.append(
            ('/imu/data_raw', cdr.IMU,
             [0.0, 0.0, 0.0, 1.0, *cdr.NOT_REPORTED_COVARIANCE, 0.0, 0.0, sample.output,
              *cdr.z_axis_covariance(self.variance), 0.0, 0.0, force or 0.0, *of_force]))
        for topic, kind, numbers in messages:
            data = cdr.serialize(stamp, 'gyro', numbers)
            self.add_message(Message(topic, kind, stamp, data), cdr.DEFINITIONS[kind])

    def add_message(self, message: Message, definition: str) -> None:
        """Write a message with the definition of its kind, as text."""
        self._writer.add(message.topic, message.kind, definition, message.received, message.data)
        if self._writer.pending_bytes > _MAX_CHUNK_BYTES:
            self.flush()

    def flush(self) -> None:
        """Write the messages so far as a piece."""
        if self._writer.pending_bytes:
            head = b'' if self.file.size else self._writer.pack_header(
                f'gyro_calibration {__version__}', METADATA_NAME, self._notes())
            self.file.append(head + self._writer.pack_chunk())

    def close(self) -> None:
        """Write the last piece and the closing part; on a full disk without the index."""
        try:
            if not self.file.is_full:
                self.flush()
                if self.file.size:
                    self.file.append(self._writer.pack_summary())
            elif self.file.size:
                with suppress(DiskFull):  # a reader then takes the file for truncated
                    self.file.append(MCAP_END)
        finally:
            self.file.close()


class CsvRecorder:
    """
    Writes samples as rows of the log format.

    The columns are fixed with the first piece. Values that come less often than samples, such as
    the temperature, are repeated until the next one. The first piece waits for a temperature,
    since it is not known in advance whether the gyro sends one.

    Attributes
    ----------
    file : the `AtomicAppender`
    late_columns : columns that came after the first piece and are not in the file

    """

    def __init__(self, path: str, notes: NotesCallback):
        self.file, self._notes = AtomicAppender(path), notes
        self._is_compressed = path.endswith('.gz')
        self._rows: list[tuple[int, dict[str, float]]] = []
        self._held_values: dict[str, float] = {}
        self._columns: list[str] = []
        self._start_stamp = 0
        self.late_columns: set[str] = set()

    def add_sample(self, stamp: int, sample: Sample) -> None:
        """Add a sample; the stamp is in ns."""
        values = {'temperature_degc': sample.temperature,
                  'acceleration_mps2': sample.specific_force, **sample.health}
        self._held_values |= {name: value for name, value in values.items() if value is not None}
        if self._columns:
            self.late_columns.update(set(self._held_values) - set(self._columns))
        self._rows.append((stamp, {'gyro_rad_s': sample.output, **self._held_values}))

    def flush(self, is_final: bool = False) -> None:
        """Write the rows so far as a piece."""
        if not self._rows:
            return
        if not (self._columns or is_final):
            waited = (self._rows[-1][0] - self._rows[0][0]) / NSEC_PER_SEC
            if not waited > (2.0 * WRITE_INTERVAL
                             if 'temperature_degc' in self._held_values else _TEMPERATURE_WAIT):
                return
        text = io.StringIO()
        writer = csv.writer(text, lineterminator='\n')
        if not self._columns:
            self._write_header(text, writer)
        for time, values in self._rows:
            writer.writerow([repr((time - self._start_stamp) / NSEC_PER_SEC),
                             *(repr(values[name]) for name in self._columns)])
        data = text.getvalue().encode()
        self.file.append(gzip.compress(data, 6, mtime=0) if self._is_compressed else data)
        self._rows.clear()

    def close(self) -> None:
        """Write the last piece, unless one failed before: it may have had the header."""
        try:
            if not self.file.is_full:
                self.flush(is_final=True)
        finally:
            self.file.close()

    def _write_header(self, text: io.StringIO, writer: Any) -> None:
        """Write notes and header; the first value of each column applies from the beginning."""
        first: dict[str, float] = {}
        for _, values in reversed(self._rows):
            first |= values
        self._rows = [(time, {**first, **values}) for time, values in self._rows]
        self._columns = list(self._rows[-1][1])
        self._start_stamp = self._rows[0][0]
        seconds, nanoseconds = divmod(self._start_stamp, NSEC_PER_SEC)
        begin = 'time_s counts from', f'{seconds}.{nanoseconds:09d} s'
        for name, value in (*self._notes().items(), begin):
            text.write(f'# {name}: {" ".join(value.split())}\n')
        writer.writerow(['time_s', *self._columns])
