"""
A gyro on a serial port, whatever happens to the port: found, listened to, read, lost, and found again.

No ROS, and no thread: who wants samples takes them from `Connection.chunks`, in a thread or not.

"""

from __future__ import annotations

import glob
import math
import os
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

from gyro_calibration.driver.protocols import Decoder, Protocol, Sample, Settings, find
from gyro_calibration.driver.protocols.listening import BAUDS, Recognition, recognize
from gyro_calibration.driver.serial_port import PortError, SerialPort
from gyro_calibration.driver.timestamps import SampleClock

AUTO = 'auto'
"""In place of the name of a protocol: find out by listening."""

_RESTART = 5.0  # s; a board that restarts when its port is opened says nothing for so long at most
_ASKING = 0.8  # s; between two attempts to make a gyro send from which no sample has come: while it starts it does not listen
_LISTENING = 1.0  # s; a gyro of 10 Hz has sent enough by then
_GLANCE = 0.1  # s; between two looks at what was heard
_MOST_BYTES = 16384  # of what was heard last
_MOST_DOUBLINGS = 30  # of the waiting time; the limit is reached long before


@dataclass(frozen=True)
class Chunk:
    """
    Samples that came at one time, by the monotonic clock of the host.

    Attributes
    ----------
    samples : list of Sample
    stamps : list of float
        When they were sent, in seconds; they increase strictly over all chunks.
    arrival : float
        When they came, in seconds.

    """

    samples: list[Sample]
    stamps: list[float]
    arrival: float


@dataclass(frozen=True)
class State:
    """
    How a connection stands.

    Attributes
    ----------
    name : str
        ``'opening'``, ``'listening'``, ``'reading'`` (samples come) or ``'failed'`` (none come).
    problem : str
        One sentence while it has failed, else empty.
    waiting : float
        Seconds until the port is opened anew, while it has failed; a port that is open is heard until then.

    """

    name: str
    problem: str = ''
    waiting: float = 0.0


@dataclass(frozen=True)
class Counts:
    """What has happened since the start."""

    samples: int = 0
    lost_samples: int = 0
    discarded_bytes: int = 0
    device_faults: int = 0
    out_of_range: int = 0


def resolve(port: str) -> str:
    """
    Return the port that a pattern such as ``/dev/serial/by-id/*A9003XYZ*`` stands for now; what is no pattern stands for itself.

    Raises
    ------
    PortError : none matches, or several do that are not the same device

    """
    if os.path.exists(port) or not glob.has_magic(port):
        return port
    matches = sorted(glob.glob(port))
    if not matches:
        raise PortError(f'no port matches {port}: plug the gyro in, or set another port')
    if len({os.path.realpath(match) for match in matches}) > 1:
        raise PortError(f'{len(matches)} ports match {port}: {", ".join(matches)}; set port to one of them')
    return matches[0]


def _known(protocol: str) -> Protocol:
    try:
        return find(protocol)
    except ValueError as error:
        raise ValueError(f'{error}, or {AUTO} to find it by listening') from None


class _Silence:
    """
    The time without a sample, since the port was opened or since the last one came.

    It ends with the port being opened anew: after the timeout, but where no sample has come since the port was opened only when a board
    that is restarted by the opening must have begun to send, since it would be restarted again.

    Attributes
    ----------
    is_first : bool
        Whether no sample has come since the port was opened.
    end : float
        When the port is to be opened anew, s.

    """

    def __init__(self, timeout: float, now: float):
        self._timeout, self._asked = timeout, now
        self.is_first, self.end = True, now + timeout + _RESTART
        self._begin, self._looks = now, 0

    def break_off(self, now: float) -> None:
        """Begin anew: a sample came."""
        self.is_first, self.end = False, now + self._timeout
        self._begin, self._looks = now, 0

    def is_to_ask(self, now: float) -> bool:
        """Tell whether the gyro is to be asked once more to send."""
        if not self.is_first or now - self._asked < _ASKING:
            return False
        self._asked = now
        return True

    def look(self, now: float) -> bool:
        """Tell whether half of the timeout has passed since the last look, or all time is over."""
        if now < min(self._begin + 0.5 * self._timeout * (self._looks + 1), self.end):
            return False
        self._looks += 1
        return True

    @property
    def is_to_be_told(self) -> bool:
        """Whether it has lasted for the timeout."""
        return self._looks > 1


class Connection:
    """
    Gives the samples of a gyro, with stamps, until it is told to stop.

    After the port was lost, or no sample came for `silence_timeout`, it is opened again after `reopen_interval`, then after twice as long
    each time, up to `reopen_limit`, until samples come. Many a board restarts when its port is opened, so after an opening the port stays
    open for 5 s more, and the gyro is asked each second to send, until the first sample comes. With the protocol ``'auto'`` it listens
    first, at each baud in turn unless one is given, and sends nothing meanwhile. What was found stays as long as samples come of it
    after the port was lost.

    Parameters
    ----------
    port : str
        Path, or a pattern that finds it under any name.
    protocol : str
        Name of a protocol, or ``'auto'``.
    baud : int
        Bits per second; 0 for that of the protocol.
    settings : Settings or None
    silence_timeout, reopen_interval, reopen_limit : float
        Seconds.
    use_device_time : bool
        Whether the clock of the device is trusted, as for replays; see `SampleClock`.
    on_change : callable
        Gets each new `State`, in the thread that takes the samples.

    Attributes
    ----------
    state : State
    protocol : Protocol or None
        None until it is known.
    baud : int
        0 until it is known.
    path : str
        The device behind the port when it was last opened, links followed.
    heard : str
        What was recognized by listening, in a sentence.
    clock : SampleClock or None
        None until the protocol is known.
    openings : int
        How often the port was opened.
    waited : float
        Seconds that were waited for the port altogether.
    last_error : str

    Raises
    ------
    ValueError : the protocol is not known, sends no time though it is wanted, or the settings do not suffice for it

    """

    def __init__(
        self,
        port: str,
        protocol: str = AUTO,
        baud: int = 0,
        settings: Settings | None = None,
        silence_timeout: float = 2.0,
        reopen_interval: float = 0.1,
        reopen_limit: float = 5.0,
        use_device_time: bool = False,
        on_change: Callable[[State], None] = lambda state: None,
    ):
        self._pattern, self._given_baud, self._settings = port, baud, settings or Settings()
        self._silence_timeout = silence_timeout
        self._reopen_interval, self._reopen_limit = reopen_interval, reopen_limit
        self._use_device_time, self._on_change = use_device_time, on_change
        self.state = State('opening')
        self.protocol: Protocol | None = None
        self.clock: SampleClock | None = None
        self._decoder: Decoder | None = None
        self._port: SerialPort | None = None
        self._last_stamp = -math.inf
        self._past, self._samples, self._attempts, self._read_bytes = Counts(), 0, 0, 0
        self.baud, self.path, self.heard, self.last_error = 0, '', '', ''
        self.openings, self.waited = 0, 0.0
        self._is_auto = protocol == AUTO
        if not self._is_auto:
            known = _known(protocol)
            self._use(known, baud or known.baud)

    def counts(self) -> Counts:
        """Return what has happened since the start; may be called from any thread."""
        past, decoder, clock = self._past, self._decoder, self.clock
        if decoder is None or clock is None:
            return replace(past, samples=self._samples)
        return Counts(
            samples=self._samples,
            lost_samples=past.lost_samples + clock.lost,
            discarded_bytes=past.discarded_bytes + decoder.discarded_bytes,
            device_faults=past.device_faults + decoder.faults,
            out_of_range=past.out_of_range + decoder.out_of_range,
        )

    def chunks(self, stop: threading.Event) -> Iterator[Chunk]:
        """
        Give samples as they come, until the event is set; the port is then closed.

        A chunk may be long in coming: while the port is missing there is none.

        """
        try:
            while not stop.is_set():
                try:
                    yield from self._read(self._open(stop), stop)
                except PortError as error:
                    self._close()
                    self._wait(str(error), stop)
        finally:
            self._close()

    def _use(self, protocol: Protocol, baud: int) -> None:
        if self._use_device_time and not protocol.gives_time(self._settings):
            raise ValueError(f'time_source is device, but {protocol.name} sends no time: use fit, or csv with a column time_s')
        self._decoder = protocol.decoder(self._settings)
        self.clock = SampleClock(protocol.nominal_rate(self._settings), protocol.modulus, self._use_device_time, self._last_stamp)
        self.protocol, self.baud = protocol, baud

    def _forget(self) -> None:
        """Forget what was found by listening, but not what was counted."""
        self._past, self._decoder, self.clock, self.protocol = self.counts(), None, None, None

    def _open(self, stop: threading.Event) -> SerialPort:
        """Open the port, listen if nobody knows yet what to expect, and make the gyro send."""
        path = resolve(self._pattern)
        self.path = os.path.realpath(path)
        self._port = port = SerialPort(path, self.baud if self.protocol else self._bauds()[0])
        port.open()
        self.openings += 1
        if self.protocol is None:
            self._listen(port, stop)
        if self.protocol is not None:
            assert self._decoder is not None and self.clock is not None
            self._ask(port)
            self._decoder.reset()
            self.clock.interrupt()
        return port

    def _ask(self, port: SerialPort) -> None:
        assert self.protocol is not None
        port.write(self.protocol.startup)

    def _bauds(self) -> tuple[int, ...]:
        return (self._given_baud,) if self._given_baud else BAUDS

    def _listen(self, port: SerialPort, stop: threading.Event) -> None:
        """
        Find out at which baud which protocol comes; it remains unknown only when told to stop.

        The port stays open meanwhile, since opening it restarts many a microcontroller, and one that restarts needs some time to talk.

        """
        self._change(State('listening'))
        end = time.monotonic() + self._silence_timeout + _RESTART
        while self.protocol is None and not stop.is_set():
            problem = self._listen_at_each_baud(port, end, stop)
            if problem:
                self._tell_or_raise(problem, end)

    def _listen_at_each_baud(self, port: SerialPort, end: float, stop: threading.Event) -> str:
        """Return why no protocol was found, if so."""
        best: Recognition | None = None
        for baud in self._bauds():
            port.set_baud(baud)
            recognition = self._hear(port, end, stop)
            if stop.is_set():
                return ''
            if recognition.protocol is not None:
                self._find(recognition.protocol, recognition.words, baud)
                return ''
            best = max(best or recognition, recognition, key=lambda each: each.explained)
        assert best is not None
        tried = ', '.join(map(str, self._bauds()))
        return f'bytes come on {self._pattern}, but of no protocol for sure at {tried} bit/s; at best {best.words}'

    def _hear(self, port: SerialPort, restarted: float, stop: threading.Event) -> Recognition:
        """Return what is recognized within a second from the first byte on."""
        data, opened, end, look = b'', time.monotonic(), math.inf, 0.0
        while not stop.is_set():
            data = (data + port.read())[-_MOST_BYTES:]
            now = time.monotonic()
            if not data and now - opened > self._silence_timeout:
                self._tell_or_raise(self._nothing(), restarted)
            if data and now >= look:
                recognition, look, end = recognize(data, self._settings), now + _GLANCE, min(end, now + _LISTENING)
                if recognition.protocol is not None or now >= end:
                    return recognition
        return recognize(b'', self._settings)

    def _tell_or_raise(self, problem: str, end: float) -> None:
        """Tell what is wrong while the port stays open until a time, and raise `PortError` from then on."""
        now = time.monotonic()
        if now >= end:
            raise PortError(problem)
        if problem != self.state.problem:
            self._fail(problem, end - now)

    def _find(self, protocol: Protocol, words: str, baud: int) -> None:
        self.heard = words
        try:
            self._use(protocol, baud)
        except ValueError as error:
            raise PortError(f'{protocol.name} comes on {self._pattern}, but {error}') from error

    def _read(self, port: SerialPort, stop: threading.Event) -> Iterator[Chunk]:
        decoder = self._decoder
        if decoder is None:  # told to stop while it still listened
            return
        silence, said = _Silence(self._silence_timeout, time.monotonic()), self._said(decoder)
        while not stop.is_set():
            data = port.read()
            arrival = time.monotonic()
            samples = decoder.feed(data)
            self._read_bytes += len(data)
            if samples:
                yield self._chunk(samples, arrival)
                silence.break_off(arrival)
                continue
            if silence.is_to_ask(arrival):
                self._ask(port)
            if silence.look(arrival):
                before, said = said, self._said(decoder)
                if silence.is_to_be_told:
                    self._tell_or_raise(self._why_silent(decoder, before), silence.end)

    def _said(self, decoder: Decoder) -> tuple[int, int, int]:
        """Return what a gyro may say that is no sample: so many bytes, values that it calls invalid, and values beyond full scale."""
        return self._read_bytes, decoder.faults, decoder.out_of_range

    def _why_silent(self, decoder: Decoder, before: tuple[int, int, int]) -> str:
        said, port, limit = self._said(decoder), self._pattern, self._silence_timeout
        has_bytes, has_faults, is_beyond = (now > then for now, then in zip(said, before, strict=True))
        if has_faults:
            return f'the gyro on {port} calls each of its samples invalid for {limit} s: turn it off and on, then have it checked'
        if is_beyond:
            return f'each sample on {port} is beyond full scale for {limit} s: check protocol, sensitivity and full_scale'
        if not has_bytes:
            return self._nothing()
        assert self.protocol is not None
        problem = f'bytes come on {port}, but no sample of {self.protocol.name} for {limit} s: check protocol, baud and columns'
        if self._is_auto:
            self._forget()
            raise PortError(problem)
        return problem

    def _nothing(self) -> str:
        return f'nothing comes on {self._pattern} for {self._silence_timeout} s: check the power and the wires of the gyro'

    def _chunk(self, samples: list[Sample], arrival: float) -> Chunk:
        assert self.clock is not None
        stamps = self.clock.stamp(samples, arrival)
        self._samples, self._last_stamp = self._samples + len(samples), stamps[-1]
        if self.state.name != 'reading':
            self._attempts = 0
            self._change(State('reading'))
        return Chunk(samples, stamps, arrival)

    def _wait(self, problem: str, stop: threading.Event) -> None:
        delay = min(self._reopen_interval * 2.0 ** self._attempts, self._reopen_limit)
        self._attempts = min(self._attempts + 1, _MOST_DOUBLINGS)
        self._fail(problem, delay)
        begin = time.monotonic()
        stop.wait(delay)
        self.waited += time.monotonic() - begin

    def _fail(self, problem: str, waiting: float) -> None:
        self.last_error = problem
        self._change(State('failed', problem, waiting))

    def _change(self, state: State) -> None:
        self.state = state
        self._on_change(state)

    def _close(self) -> None:
        if self._port is not None:
            self._port.close()
