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
Record a gyro, from its port or from topics, until Ctrl-C.

example: gyro_calibration record --port /dev/ttyUSB0 --out drive.csv
"""

import argparse
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from datetime import datetime, timezone
import gzip
import io
import os
import signal
import sys
import threading
import time
from typing import Any

from gyro_calibration import __version__
from gyro_calibration.cli import verb
from gyro_calibration.cli.verb import Answer
from gyro_calibration.driver.connection import (
    Connection, ConnectionState, MAX_BAUD, sample_messages)
from gyro_calibration.driver.protocols import AUTO, PROTOCOLS, Sample, Settings
from gyro_calibration.driver.protocols.csv_lines import CSV
from gyro_calibration.driver.protocols.protocol import ASSUMED_NOISE, TRISTATE
from gyro_calibration.driver.timestamps import read_date_offset
from gyro_calibration.files import format_rows, InputError, to_printable
from gyro_calibration.heading.integration import Intervals
from gyro_calibration.logs import cdr
from gyro_calibration.logs.cdr import NSEC_PER_SEC
from gyro_calibration.logs.log import DataRefused, LogError, write_log
from gyro_calibration.logs.recording import format_seconds, read_recording, Topics
from gyro_calibration.logs.ros_bag import MCAP_END, McapWriter, Message
from gyro_calibration.ros.start import handle_end_signals

_EXISTS = '{}: exists already, and recordings are never overwritten; give a new name'
_FILE_SUFFIXES = '.csv', '.csv.gz', '.mcap'
_DEFAULT_TOPICS = {'gyro': 'imu/data_raw', 'temperature': 'imu/temperature'}


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--out', required=True, metavar='FILE',
                        help=f'a new file, {", ".join(_FILE_SUFFIXES)}')
    parser.add_argument('--seconds', type=verb.positive_number, metavar='N',
                        help='duration, s; default: until interrupted')
    topics = parser.add_argument_group('from topics, with ROS 2')
    topics.add_argument('--topic', metavar='TOPIC',
                        help=f'topic of the gyro; default: {_DEFAULT_TOPICS["gyro"]}')
    topics.add_argument('--temperature-topic', metavar='TOPIC',
                        help=f'default: {_DEFAULT_TOPICS["temperature"]}')
    topics.add_argument('--reference-topic', metavar='TOPIC', action='append', default=[],
                        help='topic of a reference; several are possible with .mcap')
    port = parser.add_argument_group('from the port, without ROS 2')
    port.add_argument('--port', metavar='PORT', help='port of the gyro, or a pattern such as '
                      '"/dev/serial/by-id/*A9003XYZ*"')
    port.add_argument('--protocol', metavar='NAME',
                      help=f'{", ".join(PROTOCOLS)}; default: {AUTO}, found by listening')
    port.add_argument('--baud', type=int, default=0, metavar='N',
                      help='bit/s; default: that of the protocol')
    port.add_argument('--columns', metavar='NAME,...', help='columns of the protocol csv; '
                      f'default: {",".join(Settings().columns)}')
    port.add_argument('--sensitivity', type=verb.degrees, metavar='DPS',
                      help='deg/s per count; default: that of the protocol')
    port.add_argument('--axis', default='z', choices=['x', 'y', 'z'],
                      help='axis of a gyro with three; default: z')
    port.add_argument('--invert', action='store_true', default=None,
                      help='the gyro reports clockwise turns as positive')
    port.add_argument('--increments', choices=list(TRISTATE), default='default',
                      help='the gyro sends angles, not rates; default: that of the protocol')
    port.add_argument('--sample-rate', type=verb.positive_number, metavar='HZ',
                      help='sample rate of the gyro; default: that of the protocol')


def run(given: argparse.Namespace) -> Answer:
    if not given.out.endswith(_FILE_SUFFIXES):
        raise InputError(f'{given.out} is no recording file; give a name that ends in '
                         f'{", ".join(_FILE_SUFFIXES)}')
    if os.path.exists(given.out):
        raise InputError(_EXISTS.format(given.out))
    with _stop_event(given.seconds) as stop:
        session = (_PortSession if given.port else _TopicSession)(given, stop)
        recorder, start = session.recorder, time.monotonic()
        last_flush = start

        def on_chunk() -> None:
            nonlocal last_flush
            if time.monotonic() - last_flush >= 0.5:  # s
                recorder.flush()
                last_flush = time.monotonic()
                samples, lost = session.counts()
                on_progress(None, f'{to_printable(given.out)}: {samples} samples, {lost} lost')

        try:
            with verb.show_progress(to_printable(given.out)) as on_progress:
                try:
                    session.record(on_chunk)
                finally:
                    recorder.close()
        except _DiskFull as error:
            written = (f'{recorder.size} bytes remain in {recorder.path}, complete but for the '
                       'last moment' if recorder.size else 'nothing was written')
            raise DataRefused(
                f'{error.strerror}; {written}: make room, then record again') from None
        (samples, lost), seconds = session.counts(), time.monotonic() - start
        if not samples:
            with suppress(FileNotFoundError):  # other messages may have come
                os.unlink(recorder.path)
            raise DataRefused(f'no sample was received in {seconds:.1f} s{session.failure}; no '
                              f'file was written: {session.remedy}')
        data, remarks = session.conclude()
    return Answer([f'{samples} samples in {seconds:.1f} s, {lost} lost, written to {given.out}.',
                   *remarks],
                  {'out': given.out, 'samples': samples, 'lost': lost, 'seconds': seconds,
                   'bytes': os.path.getsize(given.out), **data, 'remarks': remarks})


@contextmanager
def _stop_event(seconds: float | None) -> Iterator[threading.Event]:
    """Give an event that Ctrl-C, a SIGTERM, a terminal that closes or the end of the time sets."""
    # a second signal changes nothing, since the file is being closed
    stop = threading.Event()
    previous_handlers = handle_end_signals(lambda *_: stop.set())
    timer = threading.Timer(seconds or 0.0, stop.set)
    timer.daemon = True
    if seconds:
        timer.start()
    try:
        yield stop
    finally:
        timer.cancel()
        for number, handler in previous_handlers.items():
            signal.signal(number, handler)


# Files


class _DiskFull(OSError):
    """Nothing more can be written; the written pieces remain."""


class _Recorder:
    """A new file that grows by complete pieces, and is removed at the end if it has none."""

    def __init__(self, path: str, notes: Callable[[], Mapping[str, str]]):
        """Create the file; `notes` is called with the first piece, when all are known."""
        # size of the complete pieces, bytes, and whether one could not be written
        self.size, self.is_full = 0, False
        self.path, self._notes = path, notes
        try:
            self._file = io.FileIO(path, 'xb')
        except FileExistsError:
            raise InputError(_EXISTS.format(path)) from None

    def append(self, piece: bytes) -> None:
        """Write a piece; on an error truncate the file to the pieces before, raise `DiskFull`."""
        left = memoryview(piece)
        try:
            while left:
                left = left[self._file.write(left):]
        except OSError as error:
            self.is_full = True
            self._file.truncate(self.size)
            self._file.seek(self.size)
            raise _DiskFull(error.errno,
                            f'{self.path}: writing has failed ({error.strerror})') from error
        self.size += len(piece)

    def flush(self, is_due: bool = False) -> None:
        """Write what was added as a piece; a silence or the end makes it due."""
        raise NotImplementedError

    def end(self) -> bytes:
        """Return what closes a file with pieces, also after one that failed."""
        return b''

    def close(self) -> None:
        """Write what remains, unless a piece failed, and close the file."""
        try:
            if not self.is_full:
                self.flush(is_due=True)
            if self.size:
                with suppress(_DiskFull) if self.is_full else nullcontext():
                    self.append(self.end())
        finally:
            self._file.close()
            if not self.size:
                os.unlink(self.path)


class McapRecorder(_Recorder):
    """Messages in an MCAP file; `variance` is that of the rate of a sample, (rad/s)²."""

    def __init__(self, path: str, notes: Callable[[], Mapping[str, str]]):
        super().__init__(path, notes)
        self.writer = McapWriter(f'gyro_calibration {__version__}', notes)
        self.variance = ASSUMED_NOISE ** 2

    def add_sample(self, stamp: int, sample: Sample) -> None:
        """Add a sample as messages on the topics of the driver; the stamp is in ns."""
        for kind, data in sample_messages(sample, stamp, 'gyro', self.variance):
            topic = _DEFAULT_TOPICS['gyro' if kind == cdr.IMU else 'temperature']
            self.writer.add(Message(f'/{topic}', kind, stamp, data))

    def flush(self, is_due: bool = False) -> None:
        if piece := self.writer.pack_chunk():
            self.append(piece)

    def end(self) -> bytes:
        """Return the summary, on a full disk a short end that readers understand."""
        return MCAP_END if self.is_full else self.writer.pack_summary()


class CsvRecorder(_Recorder):
    """
    Samples as rows of the log format, whose columns are fixed with the first piece.

    Values that come less often than samples, such as the temperature, are repeated.
    """

    def __init__(self, path: str, notes: Callable[[], Mapping[str, str]]):
        super().__init__(path, notes)
        self._rows: list[tuple[int, dict[str, float]]] = []
        self._held_values: dict[str, float] = {}
        self._columns: list[str] = []
        self._start_stamp = 0
        self.late_columns: set[str] = set()  # came after the first piece, and are not in the file

    def add_sample(self, stamp: int, sample: Sample) -> None:
        """Add a sample; the stamp is in ns."""
        values = {'temperature_degc': sample.temperature,
                  'acceleration_mps2': sample.specific_force, **sample.health}
        self._held_values |= {name: value for name, value in values.items() if value is not None}
        if self._columns:
            self.late_columns |= set(self._held_values) - set(self._columns)
        self._rows.append((stamp, {'gyro_rad_s': sample.output, **self._held_values}))

    def flush(self, is_due: bool = False) -> None:
        """Write the rows so far; the first ones after some seconds, when the columns are known."""
        # s; the header waits for values that come seldom
        wait = 1.0 if 'temperature_degc' in self._held_values else 3.0
        if not self._rows or not (self._columns or is_due or self._rows[-1][0]
                                  - self._rows[0][0] > wait * NSEC_PER_SEC):
            return
        text = ''
        if not self._columns:
            # the first value of each column applies from the beginning
            first: dict[str, float] = {}
            for _, values in reversed(self._rows):
                first |= values
            self._rows = [(stamp, {**first, **values}) for stamp, values in self._rows]
            self._columns, self._start_stamp = list(first), self._rows[0][0]
            notes = {**self._notes(),
                     'time_s counts from': f'{format_seconds(self._start_stamp)} s'}
            text = ''.join(f'# {name}: {" ".join(note.split())}\n'
                           for name, note in notes.items())
            text += format_rows([['time_s', *self._columns]])
        text += format_rows([(stamp - self._start_stamp) / NSEC_PER_SEC,
                             *(values[name] for name in self._columns)]
                            for stamp, values in self._rows)
        data = text.encode()
        self.append(gzip.compress(data, mtime=0) if self.path.endswith('.gz') else data)
        self._rows.clear()


def _recording_notes(**details: object) -> dict[str, str]:
    """Return the notes of a recording: program, date, and details except empty ones."""
    known = {name.replace('_', ' '): str(value)
             for name, value in details.items() if value not in (None, '')}
    date = datetime.now(timezone.utc).isoformat(timespec='seconds')
    return {'recorded by': f'gyro_calibration {__version__}', 'date': date, **known}


# Sources


class _PortSession:
    """Records samples from a port; `_TopicSession` has the same attributes and methods."""

    remedy = 'check the port, the power and the wires of the gyro'

    def __init__(self, given: argparse.Namespace, stop: threading.Event):
        if given.topic or given.temperature_topic or given.reference_topic:
            raise InputError('--port and topics were both given; record one of them')
        if not 0 <= given.baud <= MAX_BAUD:
            raise InputError(f'--baud is {given.baud}, but must be from 0 to {MAX_BAUD}; '
                             'leave it out for that of the protocol')
        columns = tuple(given.columns.split(',')) if given.columns else Settings().columns
        try:
            self._settings = Settings(
                sensitivity=given.sensitivity, invert=given.invert, axis=given.axis,
                columns=columns, increments=TRISTATE[given.increments],
                sample_rate=given.sample_rate)
            self._connection = Connection(given.port, given.protocol or AUTO, given.baud,
                                          self._settings, on_change=self._report_state)
        except ValueError as error:
            raise InputError(str(error)) from None
        self._given, self._stop, self._last_message = given, stop, ''
        kind = McapRecorder if given.out.endswith('.mcap') else CsvRecorder
        self.recorder = kind(given.out, self._file_notes)

    def counts(self) -> tuple[int, int]:
        counts = self._connection.counts
        return counts.samples, counts.lost_samples

    def _file_notes(self) -> dict[str, str]:
        """Return the notes; columns in rad/s or deg/s have the unit in the name, not here."""
        found, settings, scale = self._connection, self._settings, dict[str, str]()
        if protocol := found.protocol:
            factor = protocol.unit_scale(settings)
            angles = (f', an angle at {protocol.nominal_rate(settings):g} Hz'
                      if protocol.sends_angles(settings) else '')
            scale['inverted'] = 'yes' if factor < 0.0 else 'no'
            if protocol is not CSV or settings.sensitivity is not None:
                scale['sensitivity'] = f'{abs(factor)!r} rad/s a unit of the device{angles}'
        return _recording_notes(
            port=self._given.port, device=found.path, protocol=protocol and protocol.name,
            baud=found.baud, axis=settings.axis, **scale)

    def record(self, on_chunk: Callable[[], None]) -> None:
        offset = read_date_offset()
        for chunk in self._connection.chunks(self._stop):
            if self._connection.protocol and isinstance(self.recorder, McapRecorder):
                self.recorder.variance = self._connection.protocol.sample_variance(self._settings)
            for sample, stamp in zip(chunk.samples, chunk.stamps, strict=True):
                self.recorder.add_sample(round(stamp * NSEC_PER_SEC) + offset, sample)
            on_chunk()

    def _report_state(self, state: ConnectionState) -> None:
        if state.name == 'failed':
            self.recorder.flush(is_due=True)  # without samples no piece is written
        message, found = state.problem or state.name, self._connection
        if message == self._last_message or state.name == 'listening' and self._last_message:
            return  # it listens again at each attempt
        self._last_message = message
        if state.name == 'reading' and found.protocol:
            message = f'samples of {found.protocol.name} come at {found.baud} bit/s'
        verb.print_message(message)

    @property
    def failure(self) -> str:
        return f' ({self._connection.last_error})' if self._connection.last_error else ''

    def conclude(self) -> tuple[dict[str, Any], list[str]]:
        found, recorder = self._connection, self.recorder
        remarks = [f'{count} {name.replace("_", " ")}.'
                   for name, count in vars(found.counts).items()
                   if name not in ('samples', 'lost_samples') and count]
        if (found.protocol and found.clock and found.clock.is_settled and (
                warning := found.protocol.sample_rate_warning(self._settings,
                                                              found.clock.period))):
            remarks.append(f'{warning}.')
        if isinstance(recorder, CsvRecorder) and recorder.late_columns:
            remarks.append(f'{", ".join(sorted(recorder.late_columns))} came too late for the '
                           'header of the log, and is not in it; record into .mcap instead.')
        return {'protocol': found.protocol and found.protocol.name, 'baud': found.baud,
                'openings': found.open_count}, remarks


class _TopicSession:
    """Records messages from topics into a recording, from which a log is written at the end."""

    remedy = ('check that a driver publishes, and that ROS_DOMAIN_ID and '
              'ROS_AUTOMATIC_DISCOVERY_RANGE agree')
    failure = ''

    def __init__(self, given: argparse.Namespace, stop: threading.Event):
        port_options = (given.protocol, given.columns, given.sensitivity, given.invert, given.baud,
                        given.sample_rate)
        if any(port_options) or given.increments != 'default':
            raise InputError('options of a port need --port; give it or omit them')
        self._is_mcap = given.out.endswith('.mcap')
        if not self._is_mcap and len(given.reference_topic) > 1:
            raise InputError(f'{given.out}: a log has one gyro and one reference; '
                             'record several topics into .mcap')
        try:
            from gyro_calibration.ros.recorder_node import take_messages
        except ImportError as error:
            raise InputError(f'topics need ROS 2, which is not available ({error}); '
                             'source it, or record from --port') from None
        self._take_messages = take_messages
        roles = [(given.topic or _DEFAULT_TOPICS['gyro'], 'gyro'),
                 (given.temperature_topic or _DEFAULT_TOPICS['temperature'], 'temperature'),
                 *((topic, 'reference') for topic in given.reference_topic)]
        self._roles = {'/' + topic.lstrip('/'): role for topic, role in roles}
        if len(self._roles) < len(roles):
            raise InputError(f'a topic was named twice: {", ".join(topic for topic, _ in roles)}')
        self._messages, self._samples, self._damaged, self._is_waiting = 0, 0, 0, True
        self._received: dict[str, str] = {}  # role -> topic
        self._previous, self._intervals, self._clock_steps = (0, 0), Intervals(), 0
        self._conflicts: dict[str, str] = {}  # topics with several publishers, as of the node
        self._given, self._stop, self._start_time = given, stop, time.monotonic()
        self.recorder = McapRecorder(given.out if self._is_mcap else f'{given.out}.mcap',
                                     lambda: _recording_notes(topics=', '.join(self._roles)))

    def counts(self) -> tuple[int, int]:
        samples = self._samples or (self._messages if self._is_mcap else 0)
        return samples, self._intervals.lost_samples

    def record(self, on_chunk: Callable[[], None]) -> None:
        def tick(node: Any) -> None:
            on_chunk()
            self._conflicts = node.conflicts
            if self._is_waiting and time.monotonic() - self._start_time > 5.0:
                self._is_waiting = False
                if missing := node.missing_topics:
                    known = sorted(name for name, _ in node.get_topic_names_and_types())
                    verb.print_message(f'no publisher so far of {", ".join(missing)}; '
                                       f'there are {", ".join(known) or "none"}')
                if not self._samples and next(iter(self._roles)) not in missing:
                    verb.print_message(f'no message so far on {next(iter(self._roles))}')

        # prints of the middleware go to standard error; standard output is the answer
        sys.stdout.flush()
        stdout_copy = os.dup(1)
        os.dup2(2, 1)
        try:
            self._take_messages(self._roles, self._add_message, tick, self._stop)
        finally:
            os.dup2(stdout_copy, 1)
            os.close(stdout_copy)

    def _add_message(self, role: str, message: Message) -> None:
        self._messages += 1
        self.recorder.writer.add(message)
        self._received[role] = message.topic
        if role == 'gyro':
            try:
                stamp = cdr.parse(message.data, cdr.LAYOUTS[message.kind])[0] or message.received
            except cdr.MessageError:
                self._damaged += 1
                return
            self._samples += 1
            before, self._previous = self._previous, (stamp, message.received)
            interval = stamp - before[0]
            # a message may be late, and a recording may be played faster
            was_set = not (-NSEC_PER_SEC < interval
                           < message.received - before[1] + 10 * NSEC_PER_SEC)
            self._clock_steps += was_set and before[0] > 0
            if interval > 0 and not was_set:
                self._intervals.add(interval / NSEC_PER_SEC)

    def conclude(self) -> tuple[dict[str, Any], list[str]]:
        """Write the log; the recording is kept where that fails."""
        recording, out = self.recorder.path, self._given.out
        if not self._is_mcap:
            try:
                if os.path.exists(out):
                    raise LogError(f'{out}: another program has created it meanwhile')
                write_log(out, read_recording(recording, Topics(**self._received)))
            except (InputError, OSError) as error:
                raise DataRefused(f'{error}; what was recorded is in {recording}') from None
            os.unlink(recording)
        remarks = [*self._conflicts.values()]
        if self._damaged:
            remarks.append(f'{self._damaged} messages of the gyro could not be read.')
        if self._clock_steps:
            remarks.append(f'The clock of the stamps was set {self._clock_steps} times.')
        return {'messages': self._messages}, remarks
