"""
What every wire format shares: the records, and the decoder that turns bytes into samples and counts what it threw away.

A format is a `Protocol`: a splitter that finds frames in a stream of bytes (`lines`, `frames`), and two functions, frame to `Reading`
and back. A reading is in the unit of the device; sign, sensitivity and full scale are applied here, for all formats alike.

"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol as Interface

GYRO_COLUMNS = {'gyro_dps': math.radians(1.0), 'gyro_rad_s': 1.0, 'gyro_counts': 1.0}
"""Columns of the log format that hold the output, and what their unit is in rad/s, or in counts."""


@dataclass(frozen=True)
class Sample:
    """
    What a gyro said once.

    Attributes
    ----------
    output : float
        rad/s, counter-clockwise positive.
    temperature : float or None
        degC.
    time : float or None
        Seconds, by the clock of the device.

    """

    output: float
    temperature: float | None = None
    time: float | None = None


@dataclass(frozen=True)
class Settings:
    """
    How a gyro is wired and scaled; None stands for what its protocol says.

    Attributes
    ----------
    sensitivity : float or None
        rad/s per count, or per unit of the device.
    invert : bool or None
        Whether the device counts clockwise turns positive.
    axis : str
        ``'x'``, ``'y'`` or ``'z'``: the one to read of a gyro with three.
    columns : tuple of str
        Of the protocol ``csv``, in the words of the log format; columns with other names are skipped.
    full_scale : float or None
        rad/s; what is beyond it is thrown away, since the device cannot mean it.

    Raises
    ------
    ValueError : a value is not possible

    """

    sensitivity: float | None = None
    invert: bool | None = None
    axis: str = 'z'
    columns: tuple[str, ...] = ('time_s', 'gyro_dps', 'temperature_degc')
    full_scale: float | None = None

    def __post_init__(self):
        for name in ('sensitivity', 'full_scale'):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0.0):
                raise ValueError(f'{name} is {value}, but must be above 0; for a gyro that counts the other way set invert')
        if self.axis not in ('x', 'y', 'z'):
            raise ValueError(f'axis is {self.axis!r}, but must be x, y or z')
        object.__setattr__(self, 'columns', tuple(self.columns))
        _check_columns(self.columns)


def _check_columns(columns):
    if sum(columns.count(name) for name in GYRO_COLUMNS) != 1:
        raise ValueError(f'columns are {", ".join(columns)}, but exactly one must be {", ".join(GYRO_COLUMNS)}')
    for name in ('time_s', 'temperature_degc'):
        if columns.count(name) > 1:
            raise ValueError(f'columns are {", ".join(columns)}, but {name} may stand there only once')


@dataclass(frozen=True)
class Reading:
    """
    What one frame holds: the value in the unit of the device and in its own sense of rotation, and whether the device stands by it.

    """

    value: float
    valid: bool = True
    temperature: float | None = None
    time: float | None = None


class Splitter(Interface):
    """
    Finds frames in bytes that come in any pieces; holds no more than one frame back, and counts the bytes that belong to none.

    """

    discarded_bytes: int

    def feed(self, data: bytes) -> list[bytes]:
        """Return the frames that these bytes complete."""

    def reset(self) -> None:
        """Forget the frame that has begun: the next bytes do not continue it."""


def _nothing_to_check(settings: Settings) -> None:
    """Accept any settings: the format does not ask for more than `Settings` itself."""


@dataclass(frozen=True)
class Protocol:
    """
    A wire format.

    Attributes
    ----------
    name, description : str
    baud : int
        Bits per second of the line, which has 8 data bits, no parity and 1 stop bit.
    rate : float
        Nominal samples per second.
    sensitivity : float
        rad/s per unit of the device.
    splitter : callable
        Returns a new `Splitter`.
    parse : callable
        ``parse(frame, settings)`` returns a `Reading`, or None when the frame is none.
    write : callable
        ``write(reading, settings)`` returns the bytes that a device sends.
    invert : bool
        Whether the device counts clockwise turns positive.
    full_scale : float or None
        rad/s, at the sensitivity above.
    startup : bytes
        What makes the device send.
    awakening : bytes
        What the emulated device sends first, so that its first sample is not taken for the rest of a line.
    is_timed : bool
        Whether samples may carry the time of the device, in a column ``time_s``.
    check : callable
        ``check(settings)`` raises ValueError when the format needs more.

    """

    name: str
    description: str
    baud: int
    rate: float
    sensitivity: float
    splitter: Callable[[], Splitter]
    parse: Callable[[bytes, Settings], Reading | None]
    write: Callable[[Reading, Settings], bytes]
    invert: bool = False
    full_scale: float | None = None
    startup: bytes = b''
    awakening: bytes = b''
    is_timed: bool = False
    check: Callable[[Settings], None] = _nothing_to_check

    def decoder(self, settings: Settings | None = None) -> Decoder:
        """
        Return a decoder for one connection.

        Raises
        ------
        ValueError : the settings do not suffice for this format

        """
        return Decoder(self, settings or Settings())

    def encode(self, sample: Sample, settings: Settings | None = None) -> bytes:
        """
        Return the bytes that the device sends for a sample; beyond full scale it saturates.

        Raises
        ------
        ValueError : the settings do not suffice for this format

        """
        settings = settings or Settings()
        self.check(settings)
        limit = self.limit(settings)
        output = min(max(sample.output, -limit), limit)
        return self.write(Reading(output / self.factor(settings), True, sample.temperature, sample.time), settings)

    def gives_time(self, settings: Settings) -> bool:
        """
        Return whether samples carry the time of the device.

        """
        return self.is_timed and 'time_s' in settings.columns

    def factor(self, settings: Settings) -> float:
        """
        Return the rad/s, counter-clockwise positive, of one unit of the device.

        """
        invert = self.invert if settings.invert is None else settings.invert
        return (-1.0 if invert else 1.0) * (settings.sensitivity or self.sensitivity)

    def limit(self, settings: Settings) -> float:
        """
        Return the full scale in rad/s: as set, or that of the device at the sensitivity that is set.

        """
        if settings.full_scale is not None:
            return settings.full_scale
        return math.inf if self.full_scale is None else self.full_scale * abs(self.factor(settings)) / self.sensitivity


class Decoder:
    """
    Turns the bytes of one gyro into samples; raises on no input, and holds no more than one frame.

    Attributes
    ----------
    faults : int
        Frames whose value the device itself calls invalid.
    out_of_range : int
        Frames with a value beyond full scale, which the device cannot mean.

    """

    def __init__(self, protocol: Protocol, settings: Settings):
        protocol.check(settings)
        self._splitter = protocol.splitter()
        self._parse = protocol.parse
        self._settings = settings
        self._factor = protocol.factor(settings)
        self._limit = protocol.limit(settings)
        self._refused_bytes = 0
        self.faults = 0
        self.out_of_range = 0

    @property
    def discarded_bytes(self) -> int:
        """
        Number of bytes that belonged to no frame.

        """
        return self._splitter.discarded_bytes + self._refused_bytes

    def feed(self, data: bytes) -> list[Sample]:
        """
        Return the samples that these bytes complete, the oldest first.

        """
        samples = (self._sample(frame) for frame in self._splitter.feed(data))
        return [sample for sample in samples if sample is not None]

    def reset(self) -> None:
        """
        Forget the frame that has begun, as after the port was lost; the counts go on.

        """
        self._splitter.reset()

    def _sample(self, frame):
        reading = self._parse(frame, self._settings)
        if reading is None:
            self._refused_bytes += len(frame)
            return None
        if not reading.valid:
            self.faults += 1
            return None
        output = reading.value * self._factor
        if not (math.isfinite(output) and abs(output) <= self._limit):
            self.out_of_range += 1
            return None
        return Sample(output, reading.temperature, reading.time)
