# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Gyros and random drives of the benchmark of headings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from gyro_calibration.heading.integration import integrate
from gyro_calibration.logs.log import Array, DEGREE
from gyro_calibration.model.motion import CALIBRATION_MOTION, Motion, ROBOT_MOTION
from gyro_calibration.model.noise import Noise, simulate_noise
from gyro_calibration.model.presets import Preset, RD2100, XV3500
import numpy as np
from numpy.typing import NDArray

#: Motions are made at this interval, s, with corners on multiples of `GRID` after their begin.
STEP, GRID = 0.01, 0.1


MPU6050 = Preset('MPU-6050', 'as measured at rest on the encoder turntable', 0.64)
GOOD_MEMS = Preset('good MEMS', 'round figures of the better ones, such as the ADIS16488',
                   0.3, 6.0, 0.01, 0.2)
GYROS = {each.name: each for each in (XV3500, RD2100, GOOD_MEMS)}


@dataclass(frozen=True)
class Path:
    """True rate, rad/s, heading, rad, and wheels turning, every `STEP` s; zero at the ends."""

    rate: Array
    heading: Array
    moving: NDArray[np.bool_]


@dataclass(frozen=True)
class Drive:
    """What a gyro says of a calibration of 20 s and of the drive after it; arrays of (n,)."""

    gyro: Preset
    time: Array  # s, 0 at the beginning of the drive
    output: Array  # rad/s
    rate: Array
    bias: Array  # true and wandering, rad/s
    heading: Array  # rad, 0 at the beginning of the drive
    moving: NDArray[np.bool_]  # the wheels turn, or did or will within a sample
    run: tuple[Array, Array]  # time from its begin, s, and output, rad/s, of the calibration


def path(rate: Array, moving: NDArray[np.bool_]) -> Path:
    return Path(rate, integrate(np.arange(len(rate)) * STEP, rate), moving)


def of_motion(motion: Motion) -> Path:
    """Return a motion as a path; the wheels turn where the rate is not zero."""
    time = np.arange(round(motion.duration / STEP) + 1) * STEP
    rate = motion.rate_at(time)
    return Path(rate, motion.heading_at(time), rate != 0.0)


def _count(duration: float) -> int:
    """Return the steps of a duration, a multiple of `GRID`."""
    return round(duration / GRID) * round(GRID / STEP)


def _flank(count: int, ramp: float) -> Array:
    """Return what goes from 0 to 1, stays, and goes back to 0."""
    steps = np.arange(count)
    return np.clip(np.minimum(steps, count - steps) * STEP / ramp, 0.0, 1.0)


def _wobble(count: int, generator: np.random.Generator) -> Array:
    """Return the yaw on a straight line: shake of 0.5 to 2 deg/s at 0.5 to 2 Hz, and wander."""
    time = np.arange(count) * STEP
    shake = generator.uniform(0.5, 2.0) * np.sin(
        2.0 * np.pi * (generator.uniform(0.5, 2.0) * time + generator.uniform()))
    knots = np.arange(0.0, time[-1] + 1.0)
    wander = np.interp(time, knots, generator.normal(0.0, 0.2, len(knots)))
    return (shake + wander) * DEGREE * _flank(count, 0.3)


def _turn(generator: np.random.Generator) -> Array:
    """Return a turn of 20 to 180 deg at 10 to 90 deg/s."""
    speed = np.exp(generator.uniform(np.log(10.0), np.log(90.0)))
    ramp = 0.3
    count = _count(max(generator.uniform(20.0, 180.0) / speed + ramp, 3.0 * ramp))
    return generator.choice((-1.0, 1.0)) * speed * DEGREE * _flank(count, ramp)


def _slow_turn(generator: np.random.Generator) -> Array:
    """Return a turn at 0.5 to 3 deg/s for 10 to 40 s, every other time with a wobble."""
    count = _count(generator.uniform(10.0, 40.0))
    turn = generator.choice((-1.0, 1.0)) * generator.uniform(0.5, 3.0) * DEGREE * _flank(
        count, 0.5)
    return turn + generator.integers(2) * _wobble(count, generator)


def _straight(generator: np.random.Generator) -> Array:
    return _wobble(_count(generator.uniform(3.0, 15.0)), generator)


def _rest(shortest: float, longest: float, generator: np.random.Generator) -> Array:
    return np.zeros(_count(generator.uniform(shortest, longest)))


#: Probability of each kind of stretch; about half of the time the robot rests or goes straight.
STRETCHES: tuple[tuple[float, Callable[[np.random.Generator], Array]], ...] = (
    (0.2, partial(_rest, 3.0, 20.0)), (0.2, partial(_rest, 0.2, 0.5)), (0.2, _straight),
    (0.3, _turn), (0.1, _slow_turn))


def random_path(duration: float, generator: np.random.Generator) -> Path:
    """Return a path of random stretches; at the end it stops within 0.3 s and rests for `GRID`."""
    count, shares = round((duration - GRID) / STEP), [share for share, _ in STRETCHES]
    rates, moving, length = [], [], 0
    while length < count:
        kind = generator.choice(len(STRETCHES), p=shares)
        rates.append(STRETCHES[kind][1](generator))
        moving.append(np.full(len(rates[-1]), kind > 1))
        length += len(rates[-1])
    rate = np.concatenate(rates)[:count] * np.clip(np.arange(count, 0, -1) * STEP / 0.3, 0.0, 1.0)
    rest = (0, round(GRID / STEP) + 1)
    return path(np.pad(rate, rest), np.pad(np.concatenate(moving)[:count], rest))


def slow_path(rate: float, generator: np.random.Generator, rest: float = 30.0,
              duration: float = 600.0) -> Path:
    """Return a rest and then one turn at a rate, rad/s, either way."""
    still, turn = (np.zeros(_count(rest)),
                   generator.choice((-1.0, 1.0)) * rate * _flank(_count(duration), 0.5))
    whole = np.concatenate([still, turn, [0.0]])
    return path(whole, whole != 0.0)


def begun_any_time(way: Path, generator: np.random.Generator) -> Path:
    """
    Return a path that begins up to `GRID` later.

    So corners are not at the edges of blocks of samples, where a robot would not put them.
    """
    late = int(generator.integers(round(GRID / STEP)))
    rate, moving = (np.append(np.append(np.zeros(late), each[:len(each) - 1 - late]), 0.0)
                    for each in (way.rate, way.moving))
    return path(rate, moving > 0.5)


@dataclass(frozen=True)
class Course:
    """What a robot drives, and how long its gyro has been on before the calibration, s."""

    path: Callable[[np.random.Generator], Path]
    warm: float = 600.0


#: The first is that of `gyro_calibration_reproduction.hong_park`, whose gyro comes fresh.
COURSES = {
    'robot, 160 s': Course(lambda generator: of_motion(ROBOT_MOTION), 0.0),
    'random, 160 s': Course(partial(random_path, 160.0)),
    'random, 30 min': Course(partial(random_path, 1800.0)),
}


def simulate(gyro: Preset, course: Course, generator: np.random.Generator) -> Drive:
    """Return what a gyro says of a calibration and of a course after it."""
    way = begun_any_time(course.path(generator), generator)
    every, before = round(gyro.interval / STEP), round(course.warm / gyro.interval)
    begin = of_motion(CALIBRATION_MOTION)
    rate = np.concatenate([begin.rate[:-1], way.rate])[::every]
    count, first = len(rate), round(CALIBRATION_MOTION.duration / gyro.interval)
    noise, s, b = gyro.model.noise, gyro.scale_factor_error, gyro.bias * DEGREE
    white = simulate_noise(Noise(noise.angle_random_walk), count, gyro.interval, generator)
    slow = Noise(0.0, noise.bias_instability, noise.rate_random_walk)
    bias = b + simulate_noise(slow, before + count, gyro.interval, generator)[before:]
    output, time = (1.0 + s) * rate + bias + white, np.arange(count) * gyro.interval
    moving = np.convolve(way.moving, np.ones(2 * every + 1), 'same')[::every] > 0.5
    return Drive(gyro, time[first:] - time[first], output[first:], rate[first:], bias[first:],
                 way.heading[::every], moving, (time[:first + 1], output[:first + 1]))
