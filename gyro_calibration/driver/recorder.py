"""
Write what comes of a gyro into a log file or into an MCAP recording, so that nothing written is ever lost again.

A file grows by whole pieces, one about each half second: rows of a log, or a chunk of a recording. Whoever is killed, or meets a full
disk, leaves a file that is complete up to the last piece. A file that is there already is never written to.

"""

from __future__ import annotations

import csv
import gzip
import io
import os
from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from datetime import datetime, timezone
from typing import Any

import numpy as np

from gyro_calibration import __version__
from gyro_calibration.driver.protocols import Sample
from gyro_calibration.gaps import Intervals
from gyro_calibration.log import LogError
from gyro_calibration.messages import (
    BILLION,
    DEFINITIONS,
    FORCE_COVARIANCE,
    FORCE_Z,
    IMU,
    LAYOUTS,
    NOT_REPORTED,
    ODOMETRY,
    ORIENTATION_COVARIANCE,
    RATE_COVARIANCE,
    RATE_Z,
    TEMPERATURE,
    TWIST,
    MessageError,
    heading_of,
    parse,
    serialize,
)
from gyro_calibration.recording import wrong_kind
from gyro_calibration.storage import ABOUT, MCAP_END, Message

KINDS = '.csv', '.csv.gz', '.mcap'

#: s; how long what was recorded may stay in memory.
PIECE = 0.5
#: s; how long the columns of a log wait for a first temperature or reference.
_PATIENCE = 3.0
#: ns; how far behind the gyro a reference may come, and a temperature that belongs to a sample.
_LATE, _BEHIND = BILLION // 2, BILLION // 20
#: s; stamps that step back by so much, or ahead by so much more than the time of receiving, are those of a clock that was set.
_BACK, _AHEAD = 1.0, 10.0
_LARGEST_CHUNK = 1 << 22


class DiskFull(OSError):
    """No more can be written; what was written stays."""


class WholePieces:
    """
    A new file that grows by whole pieces: each is in it completely, or not at all.

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
        self._file = open(path, 'xb', buffering=0)  # noqa: SIM115, it outlives this line

    def append(self, piece: bytes) -> None:
        """Write a piece, or take back what of it was written."""
        left = memoryview(piece)
        try:
            while left:
                left = left[self._file.write(left):]
        except OSError as error:
            self.is_full = True
            self._file.truncate(self.size)
            self._file.seek(self.size)
            raise DiskFull(error.errno, f'{self.path}: cannot be written any more ({error.strerror})') from error
        self.size += len(piece)

    def close(self) -> None:
        """Close it; a file that nothing was written to is removed, so that the next attempt finds its place free."""
        self._file.close()
        if not self.size:
            os.unlink(self.path)


#: Gives what a recording says of itself; asked when the first piece is written, for some of it is found out until then.
Notes = Callable[[], Mapping[str, str]]


def about(**details: object) -> dict[str, str]:
    """Return what a recording says of itself: the program, the date, and details that are known."""
    told = {name.replace('_', ' '): str(value) for name, value in details.items() if value not in (None, '')}
    return {'recorded by': f'gyro_calibration {__version__}', 'date': datetime.now(timezone.utc).isoformat(timespec='seconds'), **told}


class McapRecorder:
    """
    Writes messages as they are into an MCAP file, a chunk a piece.

    Parameters
    ----------
    path : of the new file
    notes : give what it says of itself

    Raises
    ------
    LogError : the library mcap is missing
    OSError : as `WholePieces`

    """

    def __init__(self, path: str, notes: Notes):
        try:
            from mcap.writer import Writer
        except ImportError:
            raise LogError('to write .mcap needs the Python package mcap: pip install mcap; or record into .csv') from None
        self._stream = _Pending(WholePieces(path))
        self._writer = Writer(self._stream, chunk_size=_LARGEST_CHUNK)  # type: ignore[arg-type]
        self._writer.start(profile='ros2', library=f'gyro_calibration {__version__}')
        self._notes = notes
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}

    @property
    def size(self) -> int:
        """Bytes in the file."""
        return self._stream.file.size

    def add_sample(self, stamp: int, sample: Sample) -> None:
        """Write a sample of a port as the messages that the driver would publish; the stamp is in ns."""
        numbers = 37 * [0.0]
        numbers[3], numbers[ORIENTATION_COVARIANCE], numbers[RATE_Z] = 1.0, NOT_REPORTED, sample.output
        numbers[FORCE_Z], numbers[FORCE_COVARIANCE] = _force(sample.specific_force)
        if sample.temperature is not None:
            self._add_numbers('/imu/temperature', TEMPERATURE, stamp, [sample.temperature, 0.0])
        self._add_numbers('/imu/data_raw', IMU, stamp, numbers)

    def _add_numbers(self, topic: str, kind: str, stamp: int, numbers: Sequence[float]) -> None:
        self.add_message(Message(topic, kind, stamp, serialize(stamp, 'gyro', numbers)), DEFINITIONS[kind])

    def add_message(self, message: Message, definition: str) -> None:
        """Write a message with the definition of its kind, as text."""
        if not self._channels:
            self._writer.add_metadata(ABOUT, dict(self._notes()))
        if message.kind not in self._schemas:
            self._schemas[message.kind] = self._writer.register_schema(message.kind, 'ros2msg', definition.encode())
        if message.topic not in self._channels:
            self._channels[message.topic] = self._writer.register_channel(message.topic, 'cdr', self._schemas[message.kind])
        self._writer.add_message(self._channels[message.topic], message.received, message.data, message.received)

    def flush(self) -> None:
        """Write the piece that is due."""
        if self._channels:
            self._writer.flush()

    def close(self) -> None:
        """Write what is left, with the closing part; where a piece found no room, without the index, for that piece is in it."""
        try:
            if self._stream.file.is_full:
                self._close_without_index()
            elif self._channels:
                self._writer.finish()
                self._stream.flush()
        finally:
            self._stream.file.close()

    def _close_without_index(self) -> None:
        with suppress(DiskFull):  # not even room for these bytes: whoever reads it finds it torn
            if self.size:
                self._stream.file.append(MCAP_END)


def _force(value: float | None) -> tuple[float, float]:
    return (0.0, NOT_REPORTED) if value is None else (value, 0.0)


class _Pending:
    """The file that the library writes to: its pieces wait here until they are whole."""

    def __init__(self, file: WholePieces):
        self.file, self._pieces, self._length = file, list[bytes](), 0

    def write(self, data: bytes) -> None:
        self._pieces.append(data)
        self._length += len(data)

    def tell(self) -> int:
        return self.file.size + self._length

    def flush(self) -> None:
        data = b''.join(self._pieces)
        self._pieces.clear()
        self._length = 0
        self.file.append(data)


class CsvRecorder:
    """
    Writes samples as rows of the log format, some rows a piece.

    Which columns there are is decided with the first piece, for a file of rows cannot get another one later. Values that come more seldom
    than samples, such as the temperature, are held until the next.

    Parameters
    ----------
    path : of the new file, .csv or .csv.gz
    notes : give what it says of itself
    expected : columns that the first piece waits for, and 'reference' for those of a reference; they come by ways of their own, and so a
        little later than the samples that they belong to

    Attributes
    ----------
    missed : columns that came too late to get into the file

    Raises
    ------
    OSError : as `WholePieces`

    """

    def __init__(self, path: str, notes: Notes, expected: Sequence[str] = ()):
        self._file, self._is_packed = WholePieces(path), path.endswith('.gz')
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
        values = {'temperature_degc': sample.temperature, 'acceleration_mps2': sample.specific_force, **sample.health}
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
        """Remember what a reference says at a time, ns; nan where it is lost, None where it never says it."""
        self._reference.add(time, heading, rate)
        self._miss(self._reference.names)

    def _miss(self, names: Iterable[str]) -> None:
        if self._columns:
            self.missed.update(set(names) - set(self._columns))

    def flush(self, everything: bool = False) -> None:
        """Write the piece that is due: the rows whose reference is known, or too late."""
        if not self._rows or not (self._columns or everything or self._may_begin()):
            return
        text = io.StringIO()
        writer = csv.writer(text, lineterminator='\n')
        if not self._columns:
            self._open(text, writer)
        rows = self._due(everything)
        for (time, output), referred in zip(rows, self._reference.at([time for time, _ in rows]), strict=True):
            while self._changes and self._changes[0][0] <= time:
                self._current.update(self._changes.popleft()[1])
            values = {**self._current, **referred, 'gyro_rad_s': output}
            writer.writerow([repr((time - self._begin) / BILLION), *(repr(values[name]) for name in self._columns)])
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

    def _may_begin(self) -> bool:
        waited = (self._rows[-1][0] - self._rows[0][0]) / BILLION
        known = {*self._names, *(['reference'] if self._reference.names else [])}
        return waited > _PATIENCE or waited > 2.0 * PIECE and self._expected <= known

    def _due(self, everything: bool) -> list[tuple[int, float]]:
        newest = self._rows[-1][0]
        if everything or not self._expected:
            return list(self._rows)
        known = newest - _BEHIND
        if self._reference.names:
            known = min(known, max(self._reference.last, newest - _LATE))
        return [row for row in self._rows if row[0] <= known]

    def _open(self, text: io.StringIO, writer: Any) -> None:
        """Write notes and header; what came first holds from the beginning."""
        for _, values in reversed(self._changes):
            self._current.update(values)
        self._columns = ['gyro_rad_s', *self._names, *self._reference.names]
        self._begin = self._rows[0][0]
        for name, value in (*self._notes().items(), ('time_s counts from', f'{self._begin // BILLION}.{self._begin % BILLION:09d} s')):
            text.write(f'# {name}: {" ".join(value.split())}\n')
        writer.writerow(['time_s', *self._columns])


class _Reference:
    """What a reference said lately, for the rows of a log that are written meanwhile."""

    def __init__(self) -> None:
        self._known: deque[tuple[int, float, float]] = deque(maxlen=4096)
        self.names: list[str] = []
        self._heading = np.nan

    @property
    def last(self) -> int:
        return self._known[-1][0]

    def add(self, time: int, heading: float | None, rate: float | None) -> None:
        told = dict(zip(_REFERENCE_COLUMNS, (heading, rate)))
        self.names = [name for name, value in told.items() if value is not None or name in self.names]
        if self._known and time <= self.last:
            return
        self._known.append((time, self._continuous(heading), np.nan if rate is None else rate))

    def _continuous(self, heading: float | None) -> float:
        """Return a heading that goes on from the last one that is known."""
        if heading is None or not np.isfinite(heading):
            return np.nan
        if np.isfinite(self._heading):
            heading = self._heading + float(np.remainder(heading - self._heading + np.pi, 2.0 * np.pi) - np.pi)
        self._heading = heading
        return heading

    def at(self, times: Sequence[int]) -> list[dict[str, float]]:
        """Return the columns of the reference at some times: on the line between two values, nan where it is lost."""
        stamps = [time for time, _, _ in self._known]
        steps = np.diff(stamps[-256:])
        longest = max(5.0 * float(np.median(steps)), 0.1 * BILLION) if len(steps) else 0.0
        return [self._between(bisect_left(stamps, time), time, longest) for time in times]

    def _between(self, after: int, time: int, longest: float) -> dict[str, float]:
        if not self.names:
            return {}
        values: Sequence[float] = (np.nan, np.nan)
        if after < len(self._known) and self._known[after][0] == time:
            values = self._known[after][1:]
        elif 0 < after < len(self._known):
            (begin, *low), (end, *high) = self._known[after - 1], self._known[after]
            share = (time - begin) / (end - begin)
            values = [a + share * (b - a) if end - begin <= longest else np.nan for a, b in zip(low, high)]
        return {name: float(value) for name, value in zip(_REFERENCE_COLUMNS, values) if name in self.names}


_REFERENCE_COLUMNS = 'reference_heading_rad', 'reference_rate_rad_s'


class MessageLog:
    """
    Takes messages of topics, and writes them as rows of a log; counts samples of the gyro, and how many are lost.

    Parameters
    ----------
    rows : where to, or None to only count
    topics : of the gyro, the temperature and the reference

    Attributes
    ----------
    samples : of the gyro, that were taken
    damaged : messages that could not be read
    left_out : samples that are not later than one before
    of_another_kind : topics that are not of the kind that their role wants, and what it wants; where messages are only counted

    """

    def __init__(self, rows: CsvRecorder | None, topics: Mapping[str, str]):
        self._rows, self._roles = rows, {topic: role for role, topic in topics.items()}
        self._last: int | None = None
        self._clock = _Clock()
        self.samples, self.damaged, self.left_out = 0, 0, 0
        self.of_another_kind: dict[str, str] = {}
        self._intervals = Intervals()

    @property
    def clock_steps(self) -> int:
        """How often the clock of the stamps was set."""
        return self._clock.steps

    @property
    def lost(self) -> int:
        """How many samples the stamps say are lost."""
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
            stamp, numbers = parse(message.data, LAYOUTS[message.kind])
        except MessageError:
            self.damaged += 1
            return
        stamp = self._clock.steady(role, stamp or message.received, message.received)
        if role == 'gyro':
            self._add_gyro(stamp, numbers)
        elif self._rows is not None and role == 'temperature' and np.isfinite(numbers[0]):
            self._rows.hold(stamp, {'temperature_degc': numbers[0]})
        elif self._rows is not None and role == 'reference':
            self._rows.add_reference(stamp, *_reference_of(message.kind, numbers))

    def _add_gyro(self, stamp: int, numbers: Sequence[float]) -> None:
        if self._last is not None and stamp <= self._last:
            self.left_out += 1
            return
        if self._last is not None:
            self._intervals.add((stamp - self._last) / BILLION)
        self._last = stamp
        self.samples += 1
        if self._rows is None:
            return
        if numbers[FORCE_COVARIANCE] != NOT_REPORTED and np.isfinite(numbers[FORCE_Z]) and numbers[FORCE_Z]:
            self._rows.hold(stamp, {'acceleration_mps2': numbers[FORCE_Z]})
        self._rows.add_row(stamp, numbers[RATE_Z])


class _Clock:
    """
    Lets stamps go on by the time of receiving where their clock was set.

    Any role may be the first that says so, and the others follow by the same step; a message that is still under way then has the stamp of
    the old clock.

    Attributes
    ----------
    steps : how often the clock was set

    """

    def __init__(self) -> None:
        self.steps, self._offset = 0, 0
        self._last: dict[str, tuple[int, int, int]] = {}

    def steady(self, role: str, stamp: int, received: int) -> int:
        """Return a stamp of a role as the clock would have said it that the recording began by; all in ns."""
        last, arrival, offset = self._last.get(role, (stamp + self._offset, received, self._offset))
        passed = received - arrival
        known = (each for each in (self._offset, offset) if -_BACK * BILLION < stamp + each - last < passed + _AHEAD * BILLION)
        found = next(known, None)
        if found is None:
            self.steps += 1
            found = self._offset = last + passed - stamp
        if stamp + found >= last:
            self._last[role] = stamp + found, received, found
        return stamp + found


def _reference_of(kind: str, numbers: Sequence[float]) -> tuple[float | None, float | None]:
    """Return heading and rate that a message of a reference says; None where its kind says none."""
    if kind == TWIST:
        return None, numbers[5]
    heading = float(heading_of(*(numbers[place] for place in LAYOUTS[kind].kept[:4])))
    if kind == IMU:
        turned, turns = (numbers[place] != NOT_REPORTED for place in (ORIENTATION_COVARIANCE, RATE_COVARIANCE))
        return heading if turned else None, numbers[RATE_Z] if turns else None
    return heading, numbers[48] if kind == ODOMETRY else None
