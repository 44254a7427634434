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

from __future__ import annotations

from abc import ABC, abstractmethod
import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
import math
import os
import signal
import sys
import threading
import time
from typing import Any

from gyro_calibration.cli import verb
from gyro_calibration.cli.verb import Answer, UsageError
from gyro_calibration.driver.connection import AUTO, Connection, ConnectionState
from gyro_calibration.driver.protocols import PROTOCOLS, Settings
from gyro_calibration.driver.protocols.csv_lines import CSV
from gyro_calibration.driver.recorder import (
    CsvRecorder,
    DiskFull,
    FILE_SUFFIXES,
    McapRecorder,
    NotesCallback,
    recording_notes,
    WRITE_INTERVAL,
)
from gyro_calibration.driver.timestamps import ClockStepDetector, read_steady_clock
from gyro_calibration.files import InputError, to_printable
from gyro_calibration.heading.gaps import Intervals
from gyro_calibration.logs import cdr
from gyro_calibration.logs.cdr import NSEC_PER_SEC
from gyro_calibration.logs.log import DataRefused, LogError, write_log
from gyro_calibration.logs.recording import read_recording, topic_type_fault, Topics
from gyro_calibration.logs.ros_bag import Message
from tqdm import tqdm

_Recorder = CsvRecorder | McapRecorder

_DEFAULT_TOPICS = {'gyro': 'imu/data_raw', 'temperature': 'imu/temperature'}
_INCREMENT_OPTIONS = {'always': True, 'never': False, 'default': None}
_MAX_BAUD = 4_000_000  # bit/s; the fastest serial line of Linux
_PUBLISHER_TIMEOUT = 5.0  # s; after which topics without a publisher are named


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--out', required=True, metavar='FILE',
                        help=f'a new file, {", ".join(FILE_SUFFIXES)}')
    parser.add_argument('--seconds', type=verb.positive_number, metavar='N',
                        help='duration, s; default: until interrupted')
    topics = parser.add_argument_group('from topics, with ROS 2')
    topics.add_argument('--topic', metavar='TOPIC',
                        help=f'topic of the gyro; default: {_DEFAULT_TOPICS["gyro"]}')
    topics.add_argument('--temperature-topic', metavar='TOPIC',
                        help=f'default: {_DEFAULT_TOPICS["temperature"]}')
    topics.add_argument('--reference-topic', metavar='TOPIC', action='append', default=[],
                        help='topic of a reference; several are possible with .mcap')
    topics.add_argument('--all', action='store_true', help='all topics, with .mcap')
    port = parser.add_argument_group('from the port, without ROS 2')
    port.add_argument('--port', metavar='PORT', help='port of the gyro, or a pattern such as '
                      '"/dev/serial/by-id/*A9003XYZ*"')
    port.add_argument('--protocol', metavar='NAME',
                      help=f'{", ".join(PROTOCOLS)}; default: {AUTO}, found by listening')
    port.add_argument('--baud', type=int, default=0, metavar='N',
                      help='bit/s; default: that of the protocol')
    port.add_argument('--columns', metavar='NAME,...', help='columns of the protocol csv; '
                      f'default: {",".join(Settings().columns)}')
    port.add_argument('--sensitivity', type=verb.positive_number, metavar='DPS',
                      help='deg/s per count; default: that of the protocol')
    port.add_argument('--axis', default='z', choices=['x', 'y', 'z'],
                      help='axis of a gyro with three; default: z')
    port.add_argument('--invert', action='store_true', default=None,
                      help='the gyro reports clockwise turns as positive')
    port.add_argument('--increments', choices=list(_INCREMENT_OPTIONS), default='default',
                      help='whether the gyro sends angles, not rates; '
                      'default: that of the protocol')
    port.add_argument('--sample-rate', type=verb.positive_number, metavar='HZ',
                      help='sample rate of the gyro; default: that of the protocol')


def run(given: argparse.Namespace) -> Answer:
    if not given.out.endswith(FILE_SUFFIXES):
        raise UsageError(f'{given.out} is no recording file; give a name that ends in '
                         f'{", ".join(FILE_SUFFIXES[:-1])} or {FILE_SUFFIXES[-1]}')
    with _stop_event(given.seconds) as stop:
        session = (_PortSession if given.port else _TopicSession)(given, stop)
        session.run()
    return session.answer()


@contextmanager
def _stop_event(seconds: float | None) -> Iterator[threading.Event]:
    """
    Give an event that Ctrl-C, a SIGTERM, a terminal that closes or the end of the time sets.

    A second signal changes nothing, since the file is being closed. SIGHUP stays ignored where it
    is ignored already (nohup).

    """
    stop = threading.Event()
    numbers = [number for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
               if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN]
    previous_handlers = {number: signal.signal(number, lambda *_: stop.set())
                         for number in numbers}
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


@contextmanager
def _redirect_stdout() -> Iterator[None]:
    """Redirect prints of the ROS 2 middleware to standard error; standard output is the answer."""
    sys.stdout.flush()
    stdout_copy = os.dup(1)
    os.dup2(2, 1)
    try:
        yield
    finally:
        os.dup2(stdout_copy, 1)
        os.close(stdout_copy)


def _create_recorder(path: str, notes: NotesCallback) -> _Recorder:
    try:
        return (McapRecorder if path.endswith('.mcap') else CsvRecorder)(path, notes)
    except FileExistsError:
        raise UsageError(f'{path}: exists already, and recordings are never overwritten; '
                         'give a new name') from None


class _Session(ABC):
    """The common part of recordings from port and topics: file, pieces, progress, answer."""

    #: The remedy where no sample was received.
    remedy = ''

    def __init__(self, given: argparse.Namespace, stop: threading.Event, path: str,
                 notes: NotesCallback):
        self._given, self._stop, self._path = given, stop, path
        self._start_time = self._last_flush = time.monotonic()
        self._disk_full: DiskFull | None = None
        self._recorder = _create_recorder(path, notes)

    @abstractmethod
    def counts(self) -> tuple[int, int]:
        """Return how many samples were received from the gyro, and how many are known as lost."""

    @abstractmethod
    def _record_until_stopped(self, tick: Callable[[], None]) -> None:
        """Record; call `tick` after each chunk."""

    def run(self) -> None:
        """Record until the end, and close the file also after an error."""
        try:
            with tqdm(desc=to_printable(self._given.out), unit=' samples', leave=False,
                      disable=None) as bar:
                try:
                    self._record_until_stopped(lambda: self._flush_if_due(bar))
                finally:
                    self._recorder.close()
        except DiskFull as error:
            self._disk_full = error

    def _flush_if_due(self, bar: Any) -> None:
        if time.monotonic() - self._last_flush < WRITE_INTERVAL:
            return
        self._recorder.flush()
        self._last_flush = time.monotonic()
        samples, lost = self.counts()
        bar.set_postfix_str(f'{lost} lost', refresh=False)
        bar.update(samples - bar.n)

    def answer(self) -> Answer:
        """Return what was recorded."""
        (samples, lost), seconds = self.counts(), time.monotonic() - self._start_time
        if self._disk_full is not None:
            size = self._recorder.file.size
            written = (f'{size} bytes remain in {self._path}, which is complete but for the last '
                       f'{WRITE_INTERVAL:g} s' if size else 'nothing was written')
            raise DataRefused(f'{self._disk_full.strerror}; {written}: make room, then record '
                              'again')
        if not samples:
            raise DataRefused(f'no sample was received in {seconds:.1f} '
                              f's{self._describe_failure()}; no file was written: {self.remedy}')
        remarks = self._remarks()
        data = {'out': self._given.out, 'samples': samples, 'lost': lost, 'seconds': seconds,
                'bytes': os.path.getsize(self._given.out), **self._answer_data()}
        lines = [f'{samples} samples in {seconds:.1f} s, {lost} lost, '
                 f'written to {self._given.out}.', *remarks]
        return Answer(lines, {**data, 'remarks': remarks})

    def _describe_failure(self) -> str:
        return ''

    @abstractmethod
    def _answer_data(self) -> dict[str, Any]: ...

    @abstractmethod
    def _remarks(self) -> list[str]: ...


class _PortSession(_Session):
    """Records samples from a port."""

    remedy = 'check the port, the power and the wires of the gyro'

    def __init__(self, given: argparse.Namespace, stop: threading.Event):
        if given.topic or given.temperature_topic or given.reference_topic or given.all:
            raise UsageError('--port and topics were both given; record one of them, '
                             'or the topics of a driver on that port')
        if not 0 <= given.baud <= _MAX_BAUD:
            raise UsageError(f'--baud is {given.baud}, but must be from 0 to {_MAX_BAUD}; '
                             'leave it out for that of the protocol')
        columns = tuple(given.columns.split(',')) if given.columns else Settings().columns
        try:
            self._settings = Settings(
                sensitivity=verb.sensitivity(given), invert=given.invert, axis=given.axis,
                columns=columns, increments=_INCREMENT_OPTIONS[given.increments],
                sample_rate=given.sample_rate)
            self._connection = Connection(given.port, given.protocol or AUTO, given.baud,
                                          self._settings, on_change=self._report_state)
        except ValueError as error:
            raise UsageError(str(error)) from None
        self._last_message = ''
        # Constant, so that the stamps do not jump when the clock is set.
        self._clock_offset = time.time_ns() - round(read_steady_clock() * NSEC_PER_SEC)
        super().__init__(given, stop, given.out, self._file_notes)

    def counts(self) -> tuple[int, int]:
        counts = self._connection.counts()
        return counts.samples, counts.lost_samples

    def _file_notes(self) -> dict[str, str]:
        """Return the notes; columns in rad/s or deg/s have the unit in the name, not here."""
        found, settings, scale = self._connection, self._settings, dict[str, str]()
        protocol = found.protocol
        if protocol:
            factor = protocol.unit_scale(settings)
            angles = (f', an angle at {protocol.nominal_rate(settings):g} Hz'
                      if protocol.sends_angles(settings) else '')
            scale['inverted'] = 'yes' if factor < 0.0 else 'no'
            if protocol is not CSV or settings.sensitivity is not None:
                scale['sensitivity'] = f'{abs(factor)!r} rad/s a unit of the device{angles}'
        return recording_notes(
            port=self._given.port, device=found.path, protocol=protocol and protocol.name,
            baud=found.baud, axis=settings.axis, **scale)

    def _record_until_stopped(self, tick: Callable[[], None]) -> None:
        for chunk in self._connection.chunks(self._stop):
            protocol = self._connection.protocol
            if protocol and isinstance(self._recorder, McapRecorder):
                self._recorder.variance = protocol.sample_variance(self._settings)
            for sample, stamp in zip(chunk.samples, chunk.stamps, strict=True):
                self._recorder.add_sample(round(stamp * NSEC_PER_SEC) + self._clock_offset, sample)
            tick()

    def _report_state(self, state: ConnectionState) -> None:
        if state.name == 'failed':
            self._recorder.flush()  # without samples no piece is written
        message, found = state.problem or state.name, self._connection
        if (state.name == 'opening' or message == self._last_message
                or state.name == 'listening' and self._last_message):
            return  # it listens again at each attempt
        self._last_message = message
        if state.name == 'reading' and found.protocol:
            message = f'samples of {found.protocol.name} come at {found.baud} bit/s'
        verb.print_message(message)

    def _describe_failure(self) -> str:
        return f' ({self._connection.last_error})' if self._connection.last_error else ''

    def _answer_data(self) -> dict[str, Any]:
        found = self._connection
        return {'protocol': found.protocol and found.protocol.name, 'baud': found.baud,
                'openings': found.open_count}

    def _remarks(self) -> list[str]:
        found, recorder = self._connection, self._recorder
        remarks = [f'{count} {name.replace("_", " ")}.'
                   for name, count in vars(found.counts()).items()
                   if name not in ('samples', 'lost_samples') and count]
        if found.protocol and found.clock and found.clock.is_settled:
            warning = found.protocol.sample_rate_warning(self._settings, found.clock.period)
            remarks += [f'{warning}.'] if warning else []
        if isinstance(recorder, CsvRecorder) and recorder.late_columns:
            remarks.append(f'{", ".join(sorted(recorder.late_columns))} began after the header '
                           'of the log was written, and is not in it; record into .mcap instead.')
        return remarks


class _TopicSession(_Session):
    """Records messages from topics into a recording, from which a log is written at the end."""

    remedy = ('check that a driver publishes, and that ROS_DOMAIN_ID and '
              'ROS_AUTOMATIC_DISCOVERY_RANGE agree')

    def __init__(self, given: argparse.Namespace, stop: threading.Event):
        port_options = (given.protocol, given.columns, given.sensitivity, given.invert, given.baud,
                        given.sample_rate)
        if any(port_options) or given.increments != 'default':
            raise UsageError('options of a port were given without --port; '
                             'give --port or omit them')
        self._is_mcap = given.out.endswith('.mcap')
        if not self._is_mcap and (given.all or len(given.reference_topic) > 1):
            raise UsageError(f'{given.out}: a log has one gyro and one reference; '
                             'record several topics into .mcap')
        try:
            from gyro_calibration.ros.recorder_node import take_messages
        except ImportError as error:
            raise UsageError(f'topics need ROS 2, which is not available ({error}); '
                             'source it, or record from --port') from None
        self._take_messages = take_messages
        roles = {'gyro': given.topic or _DEFAULT_TOPICS['gyro'],
                 'temperature': given.temperature_topic or _DEFAULT_TOPICS['temperature'],
                 **dict(zip(('reference',), given.reference_topic))}
        roles = {role: '/' + topic.lstrip('/') for role, topic in roles.items()}
        self._roles = {topic: role for role, topic in roles.items()}
        if len(self._roles) < len(roles):
            raise UsageError(f'one topic was named twice, of {", ".join(roles.values())}; '
                             f'name one each for {", ".join(roles)}')
        self._topics = [*self._roles, *given.reference_topic[1:]]
        self._messages, self._samples, self._damaged_messages, self._is_waiting = 0, 0, 0, True
        self._received: set[str] = set()
        self._mismatched_topics: dict[str, str] = {}
        self._unknown_topics: dict[str, str] = {}
        self._last_stamp, self._intervals = 0, Intervals()
        # s; a message may be late, and a recording be played faster
        self._clock_steps = ClockStepDetector(max_ahead=10.0, max_behind=math.inf,
                                              max_backward=1.0)

        def notes() -> dict[str, str]:
            return recording_notes(topics='everything' if given.all else ', '.join(self._topics))

        if not self._is_mcap:
            _create_recorder(given.out, notes)  # fails now where the log cannot be written
        super().__init__(given, stop, given.out if self._is_mcap else f'{given.out}.mcap', notes)

    def counts(self) -> tuple[int, int]:
        samples = self._samples or (self._messages if self._is_mcap else 0)
        return samples, self._intervals.lost_samples

    def run(self) -> None:
        """Record, and write the log; the recording is kept where that fails."""
        super().run()
        if self._is_mcap or self._disk_full:
            return
        if self._samples:
            topics = {self._roles[topic]: topic for topic in self._received}
            try:
                if os.path.exists(self._given.out):
                    raise LogError(f'{self._given.out}: another program has created it meanwhile')
                write_log(self._given.out, read_recording(self._path, Topics(**topics)))
            except (InputError, OSError) as error:
                raise DataRefused(f'{error}; what was recorded is in {self._path}') from None
        with suppress(FileNotFoundError):
            os.unlink(self._path)

    def _record_until_stopped(self, tick: Callable[[], None]) -> None:
        with _redirect_stdout():
            self._take_messages(self._topics, self._given.all, self._add_message,
                                lambda node: self._check_publishers(node, tick), self._stop)

    def _add_message(self, message: Message, definition: str) -> None:
        assert isinstance(self._recorder, McapRecorder)
        role = self._roles.get(message.topic)
        wrong = topic_type_fault(role, message.topic, message.kind) if role else ''
        if wrong and not self._is_mcap:
            raise LogError(wrong)
        self._messages += 1
        self._recorder.add_message(message, definition)
        if wrong:
            self._mismatched_topics[message.topic] = wrong
        elif role:
            self._received.add(message.topic)
            try:
                stamp = cdr.parse(message.data, cdr.LAYOUTS[message.kind])[0] or message.received
            except cdr.MessageError:
                self._damaged_messages += 1
                return
            if role == 'gyro':
                self._samples += 1
                was_set = self._clock_steps.update(
                    message.received / NSEC_PER_SEC, stamp / NSEC_PER_SEC)
                if self._last_stamp and not was_set and stamp > self._last_stamp:
                    self._intervals.add((stamp - self._last_stamp) / NSEC_PER_SEC)
                self._last_stamp = stamp

    def _check_publishers(self, node: Any, tick: Callable[[], None]) -> None:
        tick()
        self._unknown_topics = node.unknown_topics
        if self._is_waiting and time.monotonic() - self._start_time > _PUBLISHER_TIMEOUT:
            self._is_waiting = False
            if missing := node.missing_topics:
                verb.print_message(f'no publisher so far of {", ".join(missing)}; '
                                   f'there are {", ".join(node.known_topics()) or "none"}')

    def _answer_data(self) -> dict[str, Any]:
        return {'messages': self._messages}

    def _remarks(self) -> list[str]:
        remarks = [f'{topic}: {reason}; it was not recorded.'
                   for topic, reason in self._unknown_topics.items()]
        remarks += [f'{wrong}; it was recorded as it is.'
                    for wrong in self._mismatched_topics.values()]
        if self._damaged_messages:
            remarks.append(f'{self._damaged_messages} messages could not be read.')
        if self._clock_steps.count:
            remarks.append(f'The clock of the stamps was set {self._clock_steps.count} times.')
        return remarks
