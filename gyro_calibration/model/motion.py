# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Motion profiles about one axis, and the simulated output of a gyro in them."""

from collections.abc import Iterable
import csv
from dataclasses import dataclass, replace
import io
import itertools
import math
import os
from pathlib import Path

from gyro_calibration.files import (
    describe_error, InputError, MAX_MAGNITUDE, read_bytes, suggest_nearest)
from gyro_calibration.logs.columns import COLUMNS
from gyro_calibration.logs.log import (
    Array, DataRefused, DEGREE, excerpt, Log, MIN_SAMPLE_INTERVAL, Number)
from gyro_calibration.model.channels import ChannelHistory
from gyro_calibration.model.effects import Channels
from gyro_calibration.model.gyro_model import GyroModel
from gyro_calibration.model.noise import simulate_noise
import numpy as np


class MotionError(InputError):
    """A file is not a motion profile; the message names file and column."""


@dataclass(frozen=True)
class Motion:
    """A motion: rates, linear between given times, or headings alone, linear between them."""

    time: Array  # s, increasing, shape (n,), beginning at 0
    heading: Array  # rad, continuous, shape (n,), beginning at 0
    rate: Array | None = None  # rad/s, shape (n,); None where the motion was given by its heading
    name: str = 'profile'  # in messages
    is_measured: bool = False  # whether the heading is that of the robot, not of its command

    @property
    def duration(self) -> float:
        """Return the length, s."""
        return float(self.time[-1])

    def heading_at(self, time: Array) -> Array:
        """Return the heading, rad, at any times; before and after the motion it is constant."""
        time = np.clip(time, 0.0, self.duration)
        if self.rate is None:
            return np.interp(time, self.time, self.heading)
        index = np.clip(np.searchsorted(self.time, time, side='right') - 1, 0, len(self.time) - 2)
        since = time - self.time[index]
        slope = (np.diff(self.rate) / np.diff(self.time))[index]
        return self.heading[index] + since * (self.rate[index] + 0.5 * slope * since)

    def rate_at(self, time: Array) -> Array:
        """Return the rate, rad/s, at any times; before and after the motion it is 0."""
        if self.rate is None and not self.is_measured:
            index = np.clip(np.searchsorted(self.time, time, side='right') - 1, 0,
                            len(self.time) - 2)
            slope = (np.diff(self.heading) / np.diff(self.time))[index]
            return np.where((time >= 0.0) & (time <= self.duration), slope, 0.0)
        rate = np.gradient(self.heading, self.time) if self.rate is None else self.rate
        return np.interp(time, self.time, rate, left=0.0, right=0.0)


def motion_from_rates(time: Array, rate: Array) -> Motion:
    """Return the motion whose rate, rad/s, is linear between the given times, s."""
    heading = np.concatenate([[0.0], np.cumsum(np.diff(time) * (rate[1:] + rate[:-1]) / 2.0)])
    return Motion(np.asarray(time, float) - time[0], heading, np.asarray(rate, float))


def motion_from_headings(time: Array, heading: Array, is_measured: bool = True) -> Motion:
    """Return the motion through the given headings, rad, at the given times, s."""
    return Motion(np.asarray(time, float) - time[0], np.asarray(heading, float) - heading[0],
                  is_measured=is_measured)


def motion_from_log(log: Log) -> tuple[Motion, float]:
    """Return the motion of the reference of a log, and its begin, s."""
    for values, motion in ((log.reference_heading, motion_from_headings),
                           (log.reference_rate, motion_from_rates)):
        if values is not None and log.time is not None:
            known = np.isfinite(values)
            if known.sum() < 2:
                raise DataRefused(f'the reference has {known.sum()} values; at least 2 are '
                                  'needed: give the motion')
            return (replace(motion(log.time[known], values[known]), name='reference'),
                    float(log.time[known][0]))
    raise InputError('no reference over time; give the motion')


def constant_rate_motion(segments: list[tuple[float, float]], ramp: float = 0.5) -> Motion:
    """Return a motion of stretches (duration, s, rate, deg/s), each beginning with a ramp, s."""
    time, rate = [0.0], [0.0]
    for duration, value in segments:
        start = time[-1]
        time += [start + ramp, start + duration]
        rate += [value * DEGREE] * 2
    return motion_from_rates(np.array(time), np.array(rate))


def _turns_and_rests(first_rest: float, turns: Iterable[tuple[float, float, float]]) -> Motion:
    """Return the motion of turns of (duration, s, rate, deg/s, duration of the rest after, s)."""
    return constant_rate_motion([(first_rest, 0.0), *(
        stretch for duration, rate, rest in turns for stretch in ((duration, rate), (rest, 0.0)))])


#: 20 s that separate scale factor error from bias: both signs, two speeds, and rests.
CALIBRATION_MOTION = _turns_and_rests(1.0, (
    (duration, rate, 1.0) for duration, speed in ((4.0, 45.0), (3.5, 30.0))
    for rate in (speed, -speed)))
#: 160 s of a robot in a building, half of it at rest or on straight paths, with turns of 90 deg.
ROBOT_MOTION = _turns_and_rests(10.0, (
    (90 / abs(rate) + 0.5, rate, rest) for rate, rest in (
        (15, 6), (-15, 8), (-10, 6), (10, 6), (20, 8), (-20, 7), (-20, 8), (20, 7), (10, 6),
        (-10, 17))))
NAMED_MOTIONS = {
    'calibration': CALIBRATION_MOTION,
    'robot': ROBOT_MOTION,
    'rest': constant_rate_motion([(60.0, 0.0)]),
}


def motion_by_name(motion: str | Path) -> Motion:
    """Return a motion of `NAMED_MOTIONS`, or that of a profile; raise as `read_motion`."""
    if str(motion) in NAMED_MOTIONS:
        return NAMED_MOTIONS[str(motion)]
    if not os.path.exists(motion):
        raise MotionError(f'{motion}: there is no such motion; '
                          f'give a file, or one of {", ".join(NAMED_MOTIONS)}'
                          f'{suggest_nearest(str(motion), NAMED_MOTIONS)}')
    return read_motion(motion)


_COLUMN_UNITS = {name: factor for column, (quantity, factor) in COLUMNS.items()
                 if quantity.startswith('reference_')
                 for name in (column.removeprefix('reference_'), column)}


def read_motion(path: str | Path) -> Motion:
    """
    Read a motion profile from a CSV file, or raise `MotionError`.

    It has time_s and one of heading_deg, heading_rad, rate_dps, rate_rad_s, which were commanded;
    or the measured reference of a log, without the rows where it was lost.
    """
    try:
        # twice the size of an hour at 100 Hz
        lines = io.StringIO(read_bytes(path, 16_000_000).decode('utf-8-sig'), newline=None)
        rows = csv.DictReader(line for line in lines if line.strip() and not line.startswith('#'))
        rows.fieldnames = header = [name.strip() for name in rows.fieldnames or ()]
        found = sorted(name for name in _COLUMN_UNITS if name in header)
        has_both = (len(found) == 2 and found[0].startswith('reference_heading')
                    and found[1].startswith('reference_rate'))
        if 'time_s' not in header or len(found) != 1 + has_both:
            given = excerpt(','.join(header)) or 'nothing'
            raise MotionError(f'{path}: the columns are {given}; wanted time_s and one of '
                              'heading_deg, heading_rad, rate_dps, rate_rad_s')
        name = found[0]
        numbers = []
        for row, column in itertools.product(rows, ('time_s', name)):
            try:
                value = float(row[column] or '')
            except ValueError:
                value = math.inf
            # a reference may be lost
            if not (abs(value) <= MAX_MAGNITUDE
                    or value != value and column.startswith('reference_')):
                raise MotionError(
                    f'{path}: column {column}: {excerpt(row[column] or "") or "an empty cell"} is '
                    'not a finite number; correct or remove the row')
            numbers.append(value)
        time, values = np.reshape(numbers, (-1, 2)).T
    except MotionError:
        raise
    except (OSError, ValueError, csv.Error) as error:
        raise MotionError(f'{path}: cannot be read as a motion profile ({describe_error(error)}); '
                          'wanted a CSV file with time_s and heading_deg') from error
    known = np.isfinite(values)
    time, values = time[known], values[known] * _COLUMN_UNITS[name]
    if len(time) < 2 or not (np.diff(time) >= MIN_SAMPLE_INTERVAL).all():
        raise MotionError(f'{path}: time_s must increase over at least two rows; sort the rows')
    if 'rate' in name:
        return motion_from_rates(time, values)
    is_measured = name.startswith('reference_')
    # changes of commanded headings by less than a nanoradian are rounding errors
    return motion_from_headings(time, values if is_measured else np.round(values, 9), is_measured)


def simulate(model: GyroModel, motion: Motion, sample_rate: float = 100.0,
             generator: np.random.Generator | None = None,
             temperature: Number | None = None) -> Log:
    """
    Return the log of a simulated gyro, as `api.simulate`, with the true motion as reference.

    Without a generator there is no noise; a temperature, degC, is of all samples or of each.
    """
    time = np.arange(round(motion.duration * sample_rate) + 1) / sample_rate
    rate, heading = motion.rate_at(time), motion.heading_at(time)
    degc = np.array(model.reference_temperature if temperature is None else temperature, float)
    if degc.shape not in ((), time.shape):
        raise InputError(f'temperature has the shape {degc.shape}; wanted one number, or one for '
                         f'each sample, {time.shape}')
    degc = np.broadcast_to(degc, time.shape).copy()
    channels = ChannelHistory().update(time, degc, heading=heading)
    output = simulate_gyro_output(model, time, channels.with_rate(rate, rate), generator)
    return Log(output=output, time=time, temperature=degc, reference_rate=rate,
               reference_heading=heading)


def simulate_gyro_output(model: GyroModel, time: Array, channels: Channels,
                         generator: np.random.Generator | None = None) -> Array:
    """
    Return the output, rad/s, shape (n,), at stamps, s, of channels with the true rate.

    The noise is that of their median interval; without a generator there is none.
    """
    rate = model.distort('rate', channels.rate, time)
    output = model.output_from_channels(channels.with_rate(rate, rate))
    if generator is not None:
        output = output + simulate_noise(model.noise, len(time), float(np.median(np.diff(time))),
                                         generator)
    return model.distort('output', output, time)
