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
Targets for fuzzing: each takes any bytes, and raises where a claim about its reader is broken.

The documented errors (LogError, ModelError, MotionError, ValueError of a parameter) are the right
answer to wrong bytes; any other exception is a fault, and so is a message of several lines.
`benchmarks/fuzz.py` runs them, guided by coverage.
"""


from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
import json
import math
import os
from pathlib import Path
import random
import struct
import tempfile
from typing import Any
from unittest import mock
import zlib

from fake_port import SETTINGS
from gyro_calibration.cli.plan import write_motion
from gyro_calibration.driver.protocols import Protocol, PROTOCOLS, Sample, Settings
from gyro_calibration.driver.protocols.protocol import LineSplitter
from gyro_calibration.driver.timestamps import SampleClock
from gyro_calibration.files import MAX_MAGNITUDE
from gyro_calibration.heading.bias_table import BiasTable, read_bias_table, write_bias_table
from gyro_calibration.logs.cdr import IMU, LAYOUTS, serialize, TEMPERATURE
from gyro_calibration.logs.log import (
    Log, LogError, QUANTITIES, read_log, write_log)
from gyro_calibration.logs.recording import read_recording, Topics
from gyro_calibration.model.compensation import compensate
from gyro_calibration.model.effects import CATALOGUE, rate_temperature_polynomial
from gyro_calibration.model.gyro_model import GyroModel, SelfCalibration, Term
from gyro_calibration.model.model_file import format_model, ModelError, read_model, write_model
from gyro_calibration.model.motion import CALIBRATION_MOTION, MotionError, read_motion
from gyro_calibration.model.noise import Noise
import numpy as np
from recordings import channel, chunk, database, MCAP, record, text

#: Longest message of an error, in characters without the path; s that an input may take; bytes
#: that a decoder may hold back.
MESSAGE, SECONDS, HELD = 1000, 5.0, 1024
#: In memory, where the machine can: a fuzzer writes a file thousands of times a second.
_FOLDER = tempfile.TemporaryDirectory(prefix='gyro_calibration_fuzz_',
                                      dir='/dev/shm' if os.access('/dev/shm', os.W_OK) else None)


@dataclass(frozen=True)
class Target:
    #: Takes any bytes, raises where a claim is broken, and tells whether they were read.
    check: Callable[[bytes], object]
    seeds: Callable[[], Sequence[bytes]]  # inputs to begin with, as the project writes them
    longest: int = 2048  # bytes of an input
    words: Sequence[bytes] = ()  # what such inputs are made of
    weight: float = 1.0  # of its share of the time


def path_of(suffix: str) -> Path:
    return Path(_FOLDER.name) / f'{os.getpid()}{suffix}'


def _file(data: bytes, suffix: str) -> Path:
    path = path_of(suffix)
    path.write_bytes(data)
    return path


def _check_message(error: Exception | str, path: object = '') -> None:
    text = str(error)
    assert text.startswith(str(path)), text
    assert len(text.splitlines()) == 1 and len(text.replace(str(path), '')) <= MESSAGE, (
        text[:2 * MESSAGE])


def _read(read: Callable[[Path], Any], error: type[Exception], path: Path) -> Any:
    try:
        return read(path)
    except error as refused:
        _check_message(refused, path)
        return None


# Decoders

@dataclass(frozen=True)
class _Wire:
    """A protocol with settings, and good frames of it with the rates that they hold."""

    protocol: Protocol
    settings: Settings
    frames: list[bytes]
    rates: list[float]


def _wire(protocol: Protocol) -> _Wire:
    settings, decoder = SETTINGS[protocol.name], protocol.decoder(SETTINGS[protocol.name])
    encode = protocol.encoder(settings)
    frames = [encode(Sample(0.01 * number - 0.05, 20.0, 0.01 * number, number))
              for number in range(1, 5)]
    decoder.feed(protocol.preamble)
    return _Wire(protocol, settings, frames,
                 [sample.output for frame in frames for sample in decoder.feed(frame)])


def pieces(data: bytes) -> list[bytes]:
    """Cut bytes at places that follow from them, so that the same bytes repeat a failure."""
    chosen = zlib.crc32(data)
    cuts = sorted((chosen >> 4 * number) * 2654435761 % (len(data) + 1)
                  for number in range(chosen % 6))
    return [data[begin:end] for begin, end in zip([0, *cuts], [*cuts, len(data)])]


def check_decoder(wire: _Wire, data: bytes) -> int:
    """Check that pieces of any bytes give the same finite samples, and two frames recover."""
    whole, in_pieces = (wire.protocol.decoder(wire.settings) for _ in range(2))
    samples = whole.feed(data)
    assert [sample for piece in pieces(data) for sample in in_pieces.feed(piece)] == samples
    assert whole.counts == in_pieces.counts, (whole.counts, in_pieces.counts)
    for sample in samples:
        numbers = (sample.output, sample.temperature, sample.time, sample.specific_force,
                   *sample.health.values())
        assert (all(number is None or math.isfinite(number) for number in numbers)
                and sample.missing >= 0), sample
    _check_account(wire, data, (len(samples) + whole.counts.device_faults
                                + whole.counts.refused_samples))
    after = [(sample.output, sample.missing) for sample in whole.feed(b''.join(wire.frames))]
    assert after[-len(wire.rates) + 2:] == [(rate, 0) for rate in wire.rates[2:]], (
        'not right again after two frames')
    return len(samples)


def _check_account(wire: _Wire, data: bytes, used: int) -> None:
    """Check that every byte is accounted for, little is held back, and garbage costs one line."""
    good, splitter = b''.join(wire.frames), wire.protocol.splitter()
    splitter.feed(data)
    synchronized = wire.protocol.splitter()  # knows where the next frame begins
    synchronized.feed(wire.protocol.preamble)
    found, wanted = len(splitter.feed(good)), len(synchronized.feed(good))
    assert found >= wanted - isinstance(splitter, LineSplitter), 'garbage costs more than itself'
    splitter = wire.protocol.splitter()
    if zlib.crc32(data) % 16 == 0:
        data += data[-40:] * 50
    frames = splitter.feed(data)
    held = len(splitter._tail)
    ends = data.count(b'\r') + data.count(b'\n') if isinstance(splitter, LineSplitter) else 0
    framed = sum(len(frame.data) for frame in frames)
    discarded = splitter.discarded_bytes
    assert framed + discarded + held + ends == len(data), (framed, discarded, held, ends)
    assert (held <= HELD and sum(frame.skipped_bytes for frame in frames) <= discarded
            and used <= len(frames))


def _decoder_seeds(wire: _Wire) -> list[bytes]:
    frames, garbage = wire.frames, random.Random(0).randbytes(20)
    return [wire.protocol.preamble + b''.join(frames), frames[0] + garbage + frames[1],
            frames[0][:-1] + b''.join(frames[1:]), frames[2]]


#: Every protocol, also those to come.
WIRES = {name: _wire(protocol) for name, protocol in PROTOCOLS.items()}


def check_clock(data: bytes) -> int:
    """Check that stamps of any samples are finite and increase, and losses are counted."""
    head, data = (data[:2] + b'\0\0')[:2], data[2:]
    clock = SampleClock((1.0, 10.0, 100.0, 1000.0, 11000.0)[head[0] % 5],
                        (0, 128, 256, 65536)[head[1] % 4])
    arrival, last = 1000.0, -math.inf
    for sequence, late, count, missing in struct.iter_unpack('<HBBB', data[:len(data) // 5 * 5]):
        arrival += 10.0 ** (late / 32.0 - 5.0)
        samples = [
            Sample(0.0, None,
                   struct.unpack('<d', struct.pack('<HHHH', sequence, missing, count, sequence))[0]
                   if late & 8 else 0.001 * sequence + index,
                   sequence + index, missing % 64)
            for index in range(1 + count % 4)]
        samples = [sample for sample in samples if math.isfinite(sample.time)]
        if missing == 255:
            clock.interrupt()
        stamps = clock.stamp_samples(samples, arrival)
        assert len(stamps) == len(samples)
        for stamp in stamps:
            assert math.isfinite(stamp) and stamp > last, (stamp, last)
            last = stamp
    assert math.isfinite(clock.period) and clock.period > 0.0
    assert isinstance(clock.lost_count, int) and clock.lost_count >= 0, clock.lost_count
    return len(data)


def _clock_seeds() -> list[bytes]:
    even = b''.join(struct.pack('<HBBB', number, 96, 0, 0) for number in range(60))
    bursts = b''.join(struct.pack('<HBBB', 4 * number, 112, 3, number % 7 == 0)
                      for number in range(60))
    return [b'\2\0' + even, b'\3\1' + even, b'\3\1' + bursts, b'\2\4' + even]


# Files

def _full_model() -> GyroModel:
    terms = (Term(CATALOGUE['bias'], (0.002,)), Term(CATALOGUE['scale_factor_error'], (-0.1,)),
             Term(rate_temperature_polynomial(1, 1),
                  (0.1, 2.0, 25.0, 10.0, 0.01, 0.02, -0.03, 0.04)))
    noise = Noise(7.3e-4, 8.7e-5, 1e-6)
    calibration = SelfCalibration(0.01, -0.002, ((1e-6, 1e-8), (1e-8, 1e-7)),
                                  '2026-11-21T12:00:00+00:00', 21.5, 'likelihood')
    return GyroModel(terms, np.diag([1e-8, 1e-6, 1e-8, 1e-8, 1e-8, 1e-8]), (-1.0, 1.0),
                     (0.0, 50.0), 25.0, noise, {'name': 'a gyro', 'serial_number': '0012e3'},
                     {'date': '2026-11-21', 'files': [{'name': 'a.csv'}]}, calibration)


def check_log(data: bytes, suffix: str = '.csv') -> bool:
    """Check that a log is refused in a line, or read the same whole, in blocks, and rewritten."""
    path = _file(data, suffix)
    log = _read(read_log, LogError, path)
    with mock.patch('gyro_calibration.logs.log.CACHE_BLOCK_SAMPLES', 2):
        other = _read(read_log, LogError, path)
    assert (log is None) == (other is None), 'refused as a whole or in blocks only'
    if log is None:
        return False
    assert np.array_equal(_values(other), _values(log), equal_nan=True)
    assert not (np.abs(_values(log)) > MAX_MAGNITUDE).any()
    assert all(np.isfinite(values).all()
               for values in (log.time, log.temperature, log.specific_force, log.supply)
               if values is not None)
    again = path_of('_again.csv')
    write_log(again, log)
    other = read_log(again)
    assert (np.array_equal(_values(other), _values(log), equal_nan=True)
            and list(other.others) == list(log.others))
    return True


def _values(log: Log) -> np.ndarray:
    arrays = [getattr(log, quantity) for quantity in QUANTITIES]
    return np.array([values for values in arrays if values is not None])


def _log_seeds(suffix: str = '.csv') -> list[bytes]:
    path, generator = path_of(f'_seed{suffix}'), np.random.default_rng(0)
    time = 0.01 * np.arange(12)
    seeds = []
    for log in (Log(output=generator.normal(size=12), time=time, temperature=20.0 + time,
                    notes=('a log',)),
                Log(counts=np.arange(12.0), reference_rate=np.full(12, math.nan),
                    others={'lap': tuple('ab"\n,fghijkl')}),
                Log(output=time, reference_heading=time, specific_force=time, supply=time,
                    moving=time)):
        write_log(path, log)
        seeds.append(path.read_bytes())
    return seeds


def check_model(data: bytes) -> bool:
    """Refuse a model in a line, or compensate with it and find it the same once written."""
    model = _read(read_model, ModelError, _file(data, '.yaml'))
    if model is None:
        return False
    noise, values = (vars(model.noise).values(),
                     [value for term in model.terms for value in term.values])
    assert all(abs(value) <= MAX_MAGNITUDE
               for value in (*noise, *values, model.reference_temperature)), values
    text = format_model(model)
    again = path_of('_again.yaml')
    write_model(again, model)
    assert format_model(read_model(again)) == text
    with np.errstate(all='ignore'):
        if not model.needs_history:
            compensate(model, np.array([-1.0, 0.0, 1.0]), np.array([-20.0, 20.0, 60.0]))
        model.noise.heading_variance(60.0)
    if model.self_calibration is not None:
        json.dumps([str(model.self_calibration), model.self_calibration.to_dict()],
                   allow_nan=False)
    return True


def _model_seeds() -> list[bytes]:
    lag = GyroModel((Term(CATALOGUE['thermal_lag'], (120.0, 1e-4)),
                     Term(CATALOGUE['sine_response'], (1.0, 0.01))))
    by_hand = (b'effects: {rate_temperature_polynomial: {matrix_dps: [[1, 2], [3, 4]]}}\n'
               b'self_calibration: {scale_factor_error: 0, bias: 0}')
    return [
        *(format_model(model).encode() for model in (_full_model(), GyroModel(), lag)), by_hand
    ]


def check_bias_table(data: bytes) -> bool:
    """Read a bias table or refuse it in a line; what is read is of use."""
    path = _file(data, '.yaml')
    table, said = read_bias_table(path, GyroModel())
    if said:
        _check_message(said, '' if said.startswith('the bias') else path)
        return False
    with np.errstate(all='ignore'):
        bias, variance = table.predict(25.0, 1.7e9)
        change, spread = table.bias_difference(10.0, 30.0, 1.7e9)
        now, _ = table.propagate_calibration(
            SelfCalibration(0.0, 0.001, ((1e-6, 0.0), (0.0, 1e-8)), temperature=20.0), 3600.0,
            1.7e9, 25.0)
    assert (all(map(math.isfinite, (bias, change, spread, now.bias))) and variance > 0.0
            and spread >= 0.0)
    table.add(24.0, bias, 1e-8, 1.7e9)
    write_bias_table(path, table, 1.7e9)
    assert not read_bias_table(path, GyroModel())[1]
    return True


def _bias_table_seeds() -> list[bytes]:
    path, table = path_of('_seed.yaml'), BiasTable(GyroModel())
    for number in range(8):
        table.add(20.0 + 3.0 * number, 0.001 * number, 1e-8, 1.6e9 + 1e5 * number)
        table.begin_run()
    write_bias_table(path, table, 1.7e9)
    return [path.read_bytes()]


def check_profile(data: bytes) -> bool:
    motion = _read(read_motion, MotionError, _file(data, '.csv'))
    if motion is None:
        return False
    times = np.linspace(-1.0, motion.duration + 1.0, 9)
    assert (np.isfinite(motion.heading_at(times)).all()
            and np.isfinite(motion.rate_at(times)).all() and motion.duration > 0.0)
    return True


def _profile_seeds() -> list[bytes]:
    path = path_of('_seed.csv')
    write_motion(str(path), CALIBRATION_MOTION)
    return [path.read_bytes(), b'\xef\xbb\xbftime_s,heading_deg\r\n0,0\r\n1,90\r\n2,0\r\n']


def check_recording(suffix: str, data: bytes) -> bool:
    path = _file(data, suffix)
    with np.errstate(all='ignore'):
        _read(lambda path: read_recording(path, Topics(reference='table')), LogError, path)
    log = _read(read_recording, LogError, path)
    if log is None:
        return False
    assert log.time is not None and (np.diff(log.time) > 0.0).all() and np.isfinite(log.time).all()
    assert not np.isinf(log.output).any()
    return True


def _messages() -> list[tuple[str, str, int, bytes]]:
    found = []
    for number in range(5):
        stamp = 1_700_000_000_000_000_000 + 10_000_000 * number
        for topic, kind in (('imu/data_raw', IMU), ('imu/temperature', TEMPERATURE),
                            ('table', 'geometry_msgs/msg/PoseStamped')):
            found.append((topic, kind, stamp + 1000,
                          serialize(stamp, 'gyro', [0.1 * number] * (sum(
                              len(codes) for _, codes in LAYOUTS[kind].runs) - 2))))
    return found


def _mcap_seeds() -> list[bytes]:
    """Return a recording in MCAP: a magic, records of one byte, length and content, the magic."""
    numbers = {topic: number for number, (topic, *_) in enumerate(_messages()[:3], 1)}
    declared = b''.join(channel(numbers[topic], topic, kind)
                        for topic, kind, _, _ in _messages()[:3])
    messages = b''.join(record(5, struct.pack('<HIQQ', numbers[topic], 0, time, time) + data)
                        for topic, _, time, data in _messages())
    whole = chunk(declared + messages, checksum=zlib.crc32(declared + messages))
    head, end = record(1, text('ros2') + text('')), record(15, bytes(4)) + record(2, bytes(20))
    return [MCAP + head + declared + messages + end + MCAP, MCAP + head + whole + end + MCAP,
            MCAP + head + whole[:-40]]


def _database_seeds() -> list[bytes]:
    path = path_of('_seed.db3')
    path.unlink(missing_ok=True)
    database(path, {topic: kind for topic, kind, _, _ in _messages()[:3]},
             [(topic, time, data) for topic, _, time, data in _messages()],
             'PRAGMA page_size = 512').close()
    return [path.read_bytes()]


_YAML = (b'[' * 60, b'- ' * 30, b': ', b'- ', b'{', b'}', b'[', b']', b'&a ', b'*a', b'!!int',
         b'"', b"'", b'|', b'>', b'? ', b'---', b'...', b'#', b'%', b'.nan', b'.inf', b'1e300',
         b'9' * 30, b'null', b'true', b'\\x00', b'<<')
_MODEL = (b'effects', b'covariance', b'valid', b'rate', b'temperature', b'reference_temperature',
          b'noise', b'gyro', b'origin', b'self_calibration', b'standard_deviations', b'orders',
          b'matrix_dps', b'version', b'format', *(name.encode() for name in CATALOGUE))
_CSV = (b',', b'\n', b'\r\n', b'"', b'#', b'nan', b'inf', b'1e300', b'-0', b'1_0', b'time_s',
        b'gyro_dps', b'gyro_rad_s', b'gyro_counts', b'temperature_degc', b'reference_rate_dps',
        b'reference_heading_deg', b'heading_deg', b'rate_dps', b'\xef\xbb\xbf')
_TABLE = (b'entries', b'jumps', b'standard_deviation', b'time', b'run', b'bias', b'temperature',
          b'model', b'1e-9', b'1e9')

TARGETS: dict[str, Target] = {
    # made of whole frames with their checks, which no fuzzer guesses, and their beginning
    **{f'decoder {name}':
       Target(partial(check_decoder, wire), partial(_decoder_seeds, wire), 256,
              (wire.frames[0][:4], *(frame[:64] for frame in wire.frames[:2])), 2.0)
       for name, wire in WIRES.items()},
    'sample clock': Target(check_clock, _clock_seeds, 512),
    'log': Target(check_log, _log_seeds, 1024, _CSV),
    'compressed log': Target(partial(check_log, suffix='.csv.gz'),
                             partial(_log_seeds, '.csv.gz'), 1024),
    'model': Target(check_model, _model_seeds, 2048, (*_YAML, *_MODEL)),
    'bias table': Target(check_bias_table, _bias_table_seeds, 2048, (*_YAML, *_TABLE)),
    'motion profile': Target(check_profile, _profile_seeds, 1024, _CSV),
    'recording .mcap': Target(partial(check_recording, '.mcap'), _mcap_seeds, 4096),
    'recording .db3': Target(partial(check_recording, '.db3'), _database_seeds, 8192),
}
