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

from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
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
from gyro_calibration.driver.timestamps import MessageClock
from gyro_calibration.heading.gaps import Intervals
from gyro_calibration.logs import cdr
from gyro_calibration.logs.cdr import MessageError, NSEC_PER_SEC
from gyro_calibration.logs.log import LogError
from gyro_calibration.logs.recording import interpolated, wrong_kind
from gyro_calibration.logs.ros_bag import ABOUT, MCAP_END, McapWriter, Message
import numpy as np

KINDS = '.csv', '.csv.gz', '.mcap'

#: s; how long what was recorded may stay in memory.
PIECE = 0.5
#: s; how long the columns of a log wait for a first temperature or reference.
_PATIENCE = 3.0
#: ns; delay behind the gyro of a reference, and of a temperature that belongs to a sample.
_LATE, _BEHIND = NSEC_PER_SEC // 2, NSEC_PER_SEC // 20
_LARGEST_CHUNK = 1 << 22  # bytes
_REFERENCE_COLUMNS = 'reference_heading_rad', 'reference_rate_rad_s'


class DiskFull(OSError):
    """No more can be written; what was written stays."""


class AtomicAppender:
    """
    A new file that grows by whole pieces: each is in it completely, or not at all.

    The file is made with the first piece, so that a program that is killed before leaves its place
    free; that it can be made is tried at once.

    Attributes
    ----------
    size : bytes in the file
    is_full : whether a piece found no room

    Raises
    ------
    OSError : the file is there already, or its folder cannot be written to

    """

    def __init__(self, path: str):
        self.path, self.size, self.is_full = path, 0, False
        self._file: FileIO | None = None
        open(path, 'xb').close()
        os.unlink(path)

    def append(self, piece: bytes) -> None:
        """
        Write a piece, or take back what of it was written.

        Raises
        ------
        DiskFull : it cannot be written
        LogError : meanwhile another program has made the file

        """
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


class McapRecorder:
    """
    Writes messages as they are into an MCAP file, a chunk a piece.

    Parameters
    ----------
    path : of the new file
    notes : returns its notes

    Attributes
    ----------
    variance : of the rate of one sample of a port, (rad/s)²

    Raises
    ------
    OSError : as `AtomicAppender`

    """

    def __init__(self, path: str, notes: Notes):
        self._file, self._writer, self._notes = AtomicAppender(path), McapWriter(), notes
        self.variance = ASSUMED_NOISE ** 2

    @property
    def size(self) -> int:
        """Bytes in the file."""
        return self._file.size

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


class CsvRecorder:
    """
    Writes samples as rows of the log format, some rows a piece.

    Which columns there are is decided with the first piece: a file of rows cannot get another one
    later. Values that come less often than samples, such as the temperature, are held until the
    next.

    Parameters
    ----------
    path : of the new file, .csv or .csv.gz
    notes : returns its notes
    expected : columns that the first piece waits for, and 'reference' for those of a reference, as
        they come a little later than the samples that they belong to

    Attributes
    ----------
    missed : columns that came too late to get into the file

    Raises
    ------
    OSError : as `AtomicAppender`

    """

    def __init__(self, path: str, notes: Notes, expected: Sequence[str] = ()):
        self._file, self._is_packed = AtomicAppender(path), path.endswith('.gz')
        self._notes, self._expected = notes, set(expected)
        self._rows: deque[tuple[int, float]] = deque()
        self._changes: deque[tuple[int, Mapping[str, float]]] = deque()
        self._names: dict[str, None] = {}
        self._current: dict[str, float] = {}
        self._columns: list[str] = []
        self._reference = _Reference()
        self._begin = 0
        self.missed: set[str] = set()

    @property
    def size(self) -> int:
        """Bytes in the file."""
        return self._file.size

    def add_sample(self, stamp: int, sample: Sample) -> None:
        """Write a sample of a port; the stamp is in ns."""
        values = {'temperature_degc': sample.temperature,
                  'acceleration_mps2': sample.specific_force, **sample.health}
        self.hold(stamp, {name: value for name, value in values.items() if value is not None})
        self.add_row(stamp, sample.output)

    def hold(self, time: int, values: Mapping[str, float]) -> None:
        """Remember values that hold from a time on, ns."""
        if not values:
            return
        self._changes.append((time, values))
        self._names.update(dict.fromkeys(values))
        self._miss(values)

    def add_row(self, time: int, output: float) -> None:
        """Write a sample, at a time in ns that is later than that of the one before."""
        self._rows.append((time, output))

    def add_reference(self, time: int, heading: float | None, rate: float | None) -> None:
        """Keep a reference at a time, ns; nan where it is lost, None where it never reports it."""
        self._reference.add(time, heading, rate)
        self._miss(self._reference.names)

    def _miss(self, names: Iterable[str]) -> None:
        if self._columns:
            self.missed.update(set(names) - set(self._columns))

    def flush(self, everything: bool = False) -> None:
        """Write the piece that is due: the rows whose reference is known, or too late."""
        if not self._rows:
            return
        newest, has_reference = self._rows[-1][0], bool(self._reference.names)
        if not (self._columns or everything):
            waited = (newest - self._rows[0][0]) / NSEC_PER_SEC
            known = {*self._names, *(['reference'] if has_reference else [])}
            if not (waited > _PATIENCE or waited > 2.0 * PIECE and self._expected <= known):
                return
        text = io.StringIO()
        writer = csv.writer(text, lineterminator='\n')
        if not self._columns:
            self._open(text, writer)
        rows = list(self._rows)
        if self._expected and not everything:
            due = newest - _BEHIND
            if has_reference:
                due = min(due, max(self._reference.last, newest - _LATE))
            rows = [row for row in rows if row[0] <= due]
        references = self._reference.at([time for time, _ in rows])
        for (time, output), referred in zip(rows, references, strict=True):
            while self._changes and self._changes[0][0] <= time:
                self._current.update(self._changes.popleft()[1])
            values = {**self._current, **referred, 'gyro_rad_s': output}
            writer.writerow([repr((time - self._begin) / NSEC_PER_SEC),
                             *(repr(values[name]) for name in self._columns)])
        data = text.getvalue().encode()
        self._file.append(gzip.compress(data, 6, mtime=0) if self._is_packed else data)
        for _ in rows:
            self._rows.popleft()

    def close(self) -> None:
        """Write what is left, unless a piece found no room: the header may have been in it."""
        try:
            if not self._file.is_full:
                self.flush(everything=True)
        finally:
            self._file.close()

    def _open(self, text: io.StringIO, writer: Any) -> None:
        """Write notes and header; what came first holds from the beginning."""
        for _, values in reversed(self._changes):
            self._current.update(values)
        self._columns = ['gyro_rad_s', *self._names, *self._reference.names]
        self._begin = self._rows[0][0]
        seconds, nanoseconds = divmod(self._begin, NSEC_PER_SEC)
        begin = 'time_s counts from', f'{seconds}.{nanoseconds:09d} s'
        for name, value in (*self._notes().items(), begin):
            text.write(f'# {name}: {" ".join(value.split())}\n')
        writer.writerow(['time_s', *self._columns])


class _Reference:
    """The last values of a reference, for the rows of a log that are written meanwhile."""

    def __init__(self) -> None:
        self._known: deque[tuple[int, float, float]] = deque(maxlen=4096)
        self.names: list[str] = []
        self._heading = np.nan

    @property
    def last(self) -> int:
        return self._known[-1][0]

    def add(self, time: int, heading: float | None, rate: float | None) -> None:
        values = dict(zip(_REFERENCE_COLUMNS, (heading, rate)))
        self.names = [name for name, value in values.items()
                      if value is not None or name in self.names]
        if self._known and time <= self.last:
            return
        if heading is None or not np.isfinite(heading):
            heading = np.nan
        else:  # it goes on from the last one that is known
            if np.isfinite(self._heading):
                turned = np.remainder(heading - self._heading + np.pi, 2.0 * np.pi) - np.pi
                heading = self._heading + float(turned)
            self._heading = heading
        self._known.append((time, heading, np.nan if rate is None else rate))

    def at(self, times: Sequence[int]) -> list[dict[str, float]]:
        """Return the columns at some times: on the line between two values, nan where lost."""
        if not self.names or not times:
            return [{} for _ in times]
        at = np.array([time - times[0] for time, *_ in self._known]) / NSEC_PER_SEC
        wanted = np.array([time - times[0] for time in times]) / NSEC_PER_SEC
        _, headings, rates = zip(*self._known)
        columns = {name: interpolated(wanted, at, np.array(values)).tolist()
                   for name, values in zip(_REFERENCE_COLUMNS, (headings, rates))
                   if name in self.names}
        return [dict(zip(columns, row)) for row in zip(*columns.values())]


class MessageLog:
    """
    Writes messages of topics as rows of a log, and counts the samples of the gyro.

    Parameters
    ----------
    rows : None to only count
    topics : those of the gyro, the temperature and the reference, by these words

    Attributes
    ----------
    samples : of the gyro
    damaged : messages that could not be read
    left_out : samples that are not later than one before
    of_another_kind : topics that are not of the kind that their role wants, with what it wants;
        where messages are only counted

    """

    def __init__(self, rows: CsvRecorder | None, topics: Mapping[str, str]):
        self._rows, self._roles = rows, {topic: role for role, topic in topics.items()}
        self._last: int | None = None
        self._clock = MessageClock()
        self.samples, self.damaged, self.left_out = 0, 0, 0
        self.of_another_kind: dict[str, str] = {}
        self._intervals = Intervals()

    @property
    def clock_steps(self) -> int:
        """How often the clock of the stamps was set."""
        return self._clock.count

    @property
    def lost(self) -> int:
        """How many samples are lost, by the stamps."""
        return self._intervals.lost

    def add(self, message: Message) -> None:
        """
        Take a message.

        Raises
        ------
        LogError : its topic has a role in the log, but is of another kind

        """
        role = self._roles.get(message.topic)
        wrong = wrong_kind(role, message.topic, message.kind) if role else ''
        if wrong and self._rows is not None:
            raise LogError(wrong)
        if wrong:
            self.of_another_kind[message.topic] = wrong
        if role is None or wrong:
            return
        try:
            stamp, numbers = cdr.parse(message.data, cdr.LAYOUTS[message.kind])
        except MessageError:
            self.damaged += 1
            return
        stamp = self._clock.time(role, stamp or message.received, message.received)
        if role == 'gyro':
            if self._last is not None and stamp <= self._last:
                self.left_out += 1
                return
            if self._last is not None:
                self._intervals.add((stamp - self._last) / NSEC_PER_SEC)
            self._last = stamp
            self.samples += 1
            if self._rows is None:
                return
            force = numbers[cdr.FORCE_Z]
            is_known = numbers[cdr.FORCE_COVARIANCE] != cdr.NOT_REPORTED
            if is_known and force and np.isfinite(force):
                self._rows.hold(stamp, {'acceleration_mps2': force})
            self._rows.add_row(stamp, numbers[cdr.RATE_Z])
        elif self._rows is not None and role == 'temperature' and np.isfinite(numbers[0]):
            self._rows.hold(stamp, {'temperature_degc': numbers[0]})
        elif self._rows is not None and role == 'reference':
            self._rows.add_reference(stamp, *_reference_of(message.kind, numbers))


def _reference_of(kind: str, numbers: Sequence[float]) -> tuple[float | None, float | None]:
    """Return heading and rate in a message of a reference; None where its kind holds none."""
    if kind == cdr.TWIST:
        return None, numbers[5]
    heading = float(cdr.heading_of(*(numbers[place] for place in cdr.LAYOUTS[kind].kept[:4])))
    if kind == cdr.IMU:
        has_heading = numbers[cdr.ORIENTATION_COVARIANCE] != cdr.NOT_REPORTED
        has_rate = numbers[cdr.RATE_COVARIANCE] != cdr.NOT_REPORTED
        return heading if has_heading else None, numbers[cdr.RATE_Z] if has_rate else None
    return heading, numbers[48] if kind == cdr.ODOMETRY else None
