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
Common parts of wire formats: records, decoder from bytes to samples, and splitters of a stream.

A format is a `Protocol`: a splitter that finds frames in a stream of bytes, a parser from a frame
to a `Reading` in the unit of the device, and a writer. Sign, sensitivity and full scale are
applied here for all formats.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
import math
import re
from typing import NamedTuple, TypeVar

from gyro_calibration.logs.columns import COLUMNS, PLAUSIBLE_TEMPERATURES

_OutputT = TypeVar('_OutputT')

ROOM_TEMPERATURE = 25.0  # degC; default of an emulated device
#: Columns of the log format that hold the output, with their unit in rad/s, or in counts.
GYRO_COLUMNS = {name: factor for name, (quantity, factor) in COLUMNS.items()
                if quantity in ('output', 'counts')}
#: Further columns of the log format.
OPTIONAL_COLUMNS = 'temperature_degc', 'time_s', 'acceleration_mps2', 'supply_v'
ASSUMED_NOISE = math.radians(0.5)  # of a sample of an unknown gyro, rad/s
ASSUMED_FORCE_NOISE = 0.1  # m/s²; beyond the noise of any such unit
#: Words for a setting that is None by default; not yes and no, which YAML reads as booleans.
TRISTATE = {'default': None, 'always': True, 'never': False}


@dataclass(frozen=True)
class Sample:
    """One sample of a gyro; None where the device does not send a value."""

    output: float  # rad/s, counter-clockwise positive
    temperature: float | None = None  # degC
    time: float | None = None  # s, by the clock of the device
    sequence: int | None = None  # count of the device, modulo `Protocol.modulus`
    missing: int = 0  # estimated samples lost directly before: damaged, invalid or refused
    specific_force: float | None = None  # m/s², along the input axis
    health: Mapping[str, float] = field(default_factory=dict)  # by names with units: ``supply_v``


@dataclass
class Counts:
    """Counts of a connection since its start."""

    samples: int = 0
    lost_samples: int = 0
    refused_samples: int = 0  # not finite, or beyond full scale
    refused_temperatures: int = 0  # not finite, or beyond the range of any sensor
    device_faults: int = 0  # samples that the gyro marks as invalid
    discarded_bytes: int = 0  # outside of frames


@dataclass(frozen=True)
class Settings:
    """Mounting and scaling of a gyro, above 0; None is the default of its protocol."""

    sensitivity: float | None = None  # rad/s per count, or per unit of the device
    invert: bool | None = None  # whether the device counts clockwise turns positive
    axis: str = 'z'  # x, y or z: the one to read of a gyro with three
    #: Of the protocol ``csv``, in names of the log format; those with other names are skipped.
    columns: tuple[str, ...] = ('time_s', 'gyro_dps', 'temperature_degc')
    full_scale: float | None = None  # rad/s; samples beyond it are refused
    increments: bool | None = None  # whether the device sends angles since its last sample
    sample_rate: float | None = None  # Hz; an angle times this rate is the rate of turn

    def __post_init__(self) -> None:
        object.__setattr__(self, 'columns', tuple(self.columns))
        named = f'columns are {", ".join(self.columns)}, but'
        if sum(self.columns.count(name) for name in GYRO_COLUMNS) != 1:
            raise ValueError(f'{named} exactly one must be {", ".join(GYRO_COLUMNS)}')
        for name in OPTIONAL_COLUMNS:
            if self.columns.count(name) > 1:
                raise ValueError(f'{named} {name} may occur only once')


@dataclass(frozen=True)
class Reading:
    """The content of one frame; what is not stated here is as in `Sample`."""

    value: float | None  # in unit and sense of the device; None in a correct frame without a rate
    valid: bool = True  # by the status that the device reports
    temperature: float | None = None
    time: float | None = None
    sequence: int | None = None
    specific_force: float | None = None
    health: Mapping[str, float] = field(default_factory=dict)


def to_signed_count(value: float, bits: int = 16) -> int:
    """Return the nearest signed integer of a number of bits, with saturation."""
    return min(max(round(value), -1 << bits - 1), (1 << bits - 1) - 1)


def stateless(convert: Callable[..., _OutputT]) -> Callable[[Settings], Callable[..., _OutputT]]:
    """Return the `Protocol.parser` or `writer` of a format with independent frames."""
    return lambda settings: lambda *given: convert(*given, settings)


class Frame(NamedTuple):
    """A frame, and the number of bytes before it outside of frames."""

    data: bytes
    skipped_bytes: int


class Splitter:
    """Finds frames in bytes that come in any pieces; buffers less than two frames."""

    def __init__(self) -> None:
        self._tail, self._skipped_bytes, self.discarded_bytes = b'', 0, 0

    def feed(self, data: bytes) -> list[Frame]:
        """Return the frames that these bytes complete."""
        raise NotImplementedError

    def _discard(self, count: int) -> None:
        self.discarded_bytes += count
        self._skipped_bytes += count

    def _make_frame(self, data: bytes) -> Frame:
        garbage, self._skipped_bytes = self._skipped_bytes, 0
        return Frame(data, garbage)


@dataclass(frozen=True)
class Protocol:
    name: str  # of the parameter ``protocol``
    text: str | None  # what documents state: devices, layout of a frame, sources, unverified
    baud: int  # with 8 data bits, no parity and 1 stop bit
    rate: float  # nominal samples per second; see `nominal_rate`
    #: rad/s per unit of the device, or rad where it sends angles; None for counts that differ from
    #: unit to unit, whose sensitivity must be set.
    sensitivity: float | None
    splitter: Callable[[], Splitter]
    #: Makes the parser of one connection: a frame to a reading, or None if it is not valid.
    parser: Callable[[Settings], Callable[[bytes], Reading | None]]
    #: Makes the writer of one device: a value in its unit and the further values of a sample,
    #: whose sequence counts from 0 and never wraps, to bytes.
    writer: Callable[[Settings], Callable[[float, Sample], bytes]]
    invert: bool = False  # whether the device counts clockwise turns positive
    full_scale: float = math.radians(2000.0)  # rad/s
    largest_count: int | None = None  # times the sensitivity it is the full scale
    noise_density: float | None = None  # white noise by the data sheet, rad/s/√Hz
    increments: bool = False  # whether it sends angles since its last sample, unless set to rates
    startup: bytes = b''  # request to the device to send
    preamble: bytes = b''  # of an emulated device, whose first line is then no rest of a line
    modulus: int = 0  # of the sequence of the device; 0 where it has none
    normal_ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)  # of `health`
    #: Raises ValueError if settings are missing or wrong.
    check: Callable[[Settings], None] = lambda settings: None

    def check_settings(self, settings: Settings) -> None:
        """Raise ValueError if settings are missing, or do not fit the device."""
        if settings.increments and not self.increments:
            raise ValueError('increments is set, but this gyro sends rates, not angles: leave '
                             'increments out')
        if settings.sensitivity is None and self.sensitivity is None:
            raise ValueError('sensitivity is not set, but this gyro sends counts: set it to the '
                             'rad/s of one count')
        self.check(settings)

    def decoder(self, settings: Settings | None = None, counts: Counts | None = None) -> Decoder:
        """Return a decoder for one opening of a port, or raise as `check_settings` does."""
        return Decoder(self, settings or Settings(), counts or Counts())

    def encoder(self, settings: Settings | None = None) -> Callable[[Sample], bytes]:
        """Return ``encode(sample)``: the bytes of a device, which saturates at full scale."""
        settings = settings or Settings()
        self.check_settings(settings)
        limit, factor, write = (self.effective_full_scale(settings), self.unit_scale(settings),
                                self.writer(settings))

        def encode(sample: Sample) -> bytes:
            # a log has nan where a sensor failed
            temperature, force = (each if each is not None and math.isfinite(each) else None
                                  for each in (sample.temperature, sample.specific_force))
            return write(min(max(sample.output, -limit), limit) / factor,
                         replace(sample, temperature=temperature, specific_force=force,
                                 sequence=sample.sequence or 0))

        return encode

    def nominal_rate(self, settings: Settings) -> float:
        return settings.sample_rate or self.rate

    def sends_angles(self, settings: Settings) -> bool:
        return self.increments if settings.increments is None else settings.increments

    def sample_rate_warning(self, settings: Settings, period: float) -> str:
        """Return a warning if angles come at another period, s, than that of the sample rate."""
        rate = self.nominal_rate(settings)
        # the clocks of gyros are 2 to 3 % off
        if not self.sends_angles(settings) or abs(period * rate - 1.0) <= 0.05:
            return ''
        return (f'the gyro sends {1.0 / period:.0f} samples per second, but angles are converted '
                f'to rates by {rate:g}: set sample_rate')

    def unit_scale(self, settings: Settings) -> float:
        """Return the rad/s, counter-clockwise positive, of one unit of the device."""
        invert = self.invert if settings.invert is None else settings.invert
        factor = settings.sensitivity or self.sensitivity or math.nan
        if self.sends_angles(settings):
            factor *= self.nominal_rate(settings)
        return -factor if invert else factor

    def effective_full_scale(self, settings: Settings) -> float:
        """Return the full scale in rad/s, as set or of the device."""
        if settings.full_scale is not None:
            return settings.full_scale
        if self.largest_count is not None:
            return self.largest_count * (settings.sensitivity or self.sensitivity or math.nan)
        return self.full_scale

    def sample_variance(self, settings: Settings) -> float:
        """Return the assumed variance of one sample, (rad/s)²."""
        if self.noise_density is None:
            return ASSUMED_NOISE ** 2
        return self.noise_density ** 2 * self.nominal_rate(settings)


class Decoder:
    """
    Decodes the bytes of one gyro to samples; never raises, and buffers less than two frames.

    Values that span several frames are joined only if nothing was lost between them. A refused
    sample counts as missing before the next one; a refused temperature is left out of its sample.
    """

    def __init__(self, protocol: Protocol, settings: Settings, counts: Counts):
        protocol.check_settings(settings)
        self._splitter = protocol.splitter()
        self._parser = partial(protocol.parser, settings)
        self._parse = self._parser()
        self._factor = protocol.unit_scale(settings)
        self._limit = protocol.effective_full_scale(settings)
        self._skipped_bytes, self._refused_frames, self._has_sample = 0, 0, False
        self.counts = counts

    def feed(self, data: bytes) -> list[Sample]:
        """Return the samples that these bytes complete, the oldest first."""
        samples, (coldest, hottest), counts = [], PLAUSIBLE_TEMPERATURES, self.counts
        discarded = self._splitter.discarded_bytes
        frames = self._splitter.feed(data)
        counts.discarded_bytes += self._splitter.discarded_bytes - discarded
        for frame in frames:
            if frame.skipped_bytes:
                self._parse = self._parser()  # the previous frame is not adjacent
                self._skipped_bytes += frame.skipped_bytes
            reading = self._parse(frame.data)
            if reading is None:
                counts.discarded_bytes += len(frame.data)
                self._skipped_bytes += len(frame.data)
                continue
            if reading.value is None:
                continue
            output = reading.value * self._factor
            if not (reading.valid and abs(output) <= self._limit):
                counts.device_faults += not reading.valid
                counts.refused_samples += reading.valid
                self._refused_frames += 1
                continue
            missing = (self._refused_frames + round(self._skipped_bytes / len(frame.data))
                       if self._has_sample else 0)
            self._skipped_bytes, self._refused_frames, self._has_sample = 0, 0, True
            temperature = reading.temperature
            if temperature is not None and not coldest <= temperature <= hottest:
                counts.refused_temperatures += 1
                temperature = None
            samples.append(Sample(output, temperature, reading.time, reading.sequence, missing,
                                  reading.specific_force, reading.health))
        return samples


#: A finite number in text: `float` also takes nan, inf and 1_0.
NUMBER = rb'[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?'

_MAX_LINE = 1024  # bytes; a longer line is discarded, so that an endless one fills no memory


class LineSplitter(Splitter):
    """
    Splits bytes into complete, nonempty lines without their ends.

    The first line, which may be the rest of one, is discarded unless it begins as complete ones
    do.
    """

    def __init__(self, line_starts: tuple[bytes, ...] = ()):
        super().__init__()
        self._line_starts = line_starts
        self._has_line_start = self._is_too_long = False

    def feed(self, data: bytes) -> list[Frame]:
        first, *rest = re.split(rb'[\r\n]', data)  # the tail has no line end
        *lines, tail = self._tail + first, *rest
        whole = []
        for line in lines:
            good = not self._is_too_long and len(line) <= _MAX_LINE
            good = good and (self._has_line_start or line.startswith(self._line_starts))
            self._has_line_start, self._is_too_long = True, False
            if not good:
                self._discard(len(line))
            elif line:
                whole.append(self._make_frame(line))
        self._tail = tail
        if self._is_too_long or len(tail) > _MAX_LINE:
            self._discard(len(tail))
            self._tail, self._is_too_long = b'', True
        return whole


class FrameSplitter(Splitter):
    """
    Splits bytes into frames that match a pattern (``.`` is any byte) and pass their check.

    If other bytes often pass the check, which is then weak, a frame after other bytes counts only
    if another one follows directly.
    """

    def __init__(self, pattern: bytes, length: int, is_intact: Callable[[bytes], bool],
                 is_weak: bool = False):
        super().__init__()
        self._pattern = re.compile(pattern, re.DOTALL)
        self._length, self._is_intact, self._is_weak = length, is_intact, is_weak

    def feed(self, data: bytes) -> list[Frame]:
        data, position, end, frames = self._tail + data, 0, 0, []
        while match := self._pattern.search(data, position):
            position = match.start() + 1
            if not self._is_intact(match.group()):
                continue
            if self._is_weak and (match.start() > end or self._skipped_bytes):
                following = data[match.end():match.end() + self._length]
                if len(following) < self._length:
                    position = match.start()
                    break
                if not (self._pattern.match(following) and self._is_intact(following)):
                    continue
            self._discard(match.start() - end)
            frames.append(self._make_frame(match.group()))
            position = end = match.end()
        else:
            position = max(position, len(data) - self._length + 1)
        self._discard(position - end)
        self._tail = data[position:]
        return frames
