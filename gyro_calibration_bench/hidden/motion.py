# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Random conditions of a gyro during a recording: motion, temperature, supply, tilt, vibration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline
from scipy.ndimage import gaussian_filter1d
from scipy.signal import lfilter

#: Knots of the rate, s. A cubic B-spline through them is zero at rest, and its integral is exact.
KNOT_INTERVAL = 0.05
GRAVITY = 9.81


@dataclass(frozen=True)
class Motion:
    """The true rate, rad/s, and its integral from 0 on, rad, over the time since power-on."""

    rate: Callable[[np.ndarray], np.ndarray]
    heading: Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Session:
    """One recording without a gyro: arrays of shape (n,), true and without noise."""

    motion: Motion  # for times between the samples
    time: np.ndarray  # since power-on, s
    rate: np.ndarray  # rad/s
    heading: np.ndarray  # rad
    temperature: np.ndarray  # of the gyro, degC
    supply: np.ndarray  # V
    tilt_force: np.ndarray  # what of the specific force does not vibrate, m/s²
    vibration: np.ndarray  # the rest of it
    moving: np.ndarray  # it turns, or has turned or will turn within a second

    @property
    def interval(self) -> float:
        """Time between samples, s."""
        return float(self.time[1] - self.time[0])

    @property
    def specific_force(self) -> np.ndarray:
        """Along the input axis, m/s²."""
        return self.tilt_force + self.vibration


def session(generator: np.random.Generator, duration: float = 900.0, sample_rate: float = 50.0,
            motion: str = 'rich', temperature: str = 'rich', supply: str = 'rich',
            force: str = 'rich', top_rate: float | None = None) -> Session:
    """
    Draw a recording.

    Parameters
    ----------
    duration, sample_rate : s and Hz
    motion : rich, one_speed (never at rest), two_way (one speed both ways, and rest), slow (below
        0.3 rad/s), smooth (slow swings only)
    temperature : rich, ramp, cold_start, triangle (one turn), triangles (one speed both ways),
        smooth, constant
    supply : rich, heating (follows the temperature), constant
    force : rich, one_pose, turning (its power is proportional to the speed), off_axis
        (centripetal)
    top_rate : rad/s; random between 1 and 5 where it is None

    """
    time = np.arange(round(duration * sample_rate)) / sample_rate
    top = np.exp(generator.uniform(np.log(1.0), np.log(5.0))) if top_rate is None else top_rate
    turning = motion_from_knots(MOTIONS[motion](generator, duration, top))
    degc = TEMPERATURES[temperature](generator, time)
    return assemble_session(generator, time, turning, degc, supply, force)


def session_from_motion(generator: np.random.Generator, time: np.ndarray, rate: np.ndarray,
                        temperature: np.ndarray | None = None) -> Session:
    """Make a recording of a given motion and temperature at evenly spaced times."""
    knots = np.interp(np.arange(time[0], time[-1] + KNOT_INTERVAL, KNOT_INTERVAL), time, rate)
    degc = np.full(len(time), 25.0) if temperature is None else lag(temperature, time[1] - time[0],
                                                                    5.0)
    return assemble_session(generator, time - time[0], motion_from_knots(knots), degc, 'rich',
                            'rich')


def assemble_session(generator: np.random.Generator, time: np.ndarray, motion: Motion,
                     temperature: np.ndarray, supply: str, force: str) -> Session:
    """Add supply, tilt and vibration to a motion and a temperature."""
    rate = motion.rate(time)
    moving = gaussian_filter1d((np.abs(rate) > 1e-9).astype(float), 0.25 / time[1]) > 1e-3
    tilt_force, vibration = FORCES[force](generator, time, rate)
    return Session(motion, time, rate, motion.heading(time), temperature,
                   SUPPLIES[supply](generator, time, temperature), tilt_force, vibration, moving)


def motion_from_knots(knots: np.ndarray) -> Motion:
    """Return the motion whose rate has these coefficients every `KNOT_INTERVAL` s, else 0."""
    margin = 4
    coefficients = np.concatenate([np.zeros(margin), knots, np.zeros(margin)])
    places = KNOT_INTERVAL * (np.arange(len(coefficients) + 4) - margin - 2)
    rate = BSpline(places, coefficients, 3)
    heading = rate.antiderivative()
    first, last = places[3], places[-4]
    start = heading(0.0)
    return Motion(lambda time: rate(np.clip(time, first, last)),
                  lambda time: heading(np.clip(time, first, last)) - start)


def _rich_motion(generator: np.random.Generator, duration: float, top: float) -> np.ndarray:
    """Draw pieces of all kinds between two rests until the time is full, and round the corners."""
    count = round(duration / KNOT_INTERVAL)
    pieces = [_rest_piece(generator, top, 10.0, 30.0)]
    length = len(pieces[0])
    while length < count:
        # each kind comes once before any comes again, so that a log of some minutes has them all
        for number in generator.permutation(len(PIECES)):
            pieces.append(PIECES[number](generator, top))
            if generator.random() < 0.4:
                pieces.append(_rest_piece(generator, top))
        length = sum(len(piece) for piece in pieces)
    knots = gaussian_filter1d(np.concatenate(pieces)[:count],
                              generator.uniform(0.1, 0.3) / KNOT_INTERVAL)
    knots[-round(5.0 / KNOT_INTERVAL):] = 0.0
    return gaussian_filter1d(knots, 0.1 / KNOT_INTERVAL)


def _draw_length(generator: np.random.Generator, low: float, high: float) -> int:
    return round(generator.uniform(low, high) / KNOT_INTERVAL)


def _draw_speed(generator: np.random.Generator, top: float) -> float:
    """Draw a speed with a sign, as often slow as fast."""
    fast = (generator.uniform(0.3, 1.0) if generator.random() < 0.5
            else np.exp(generator.uniform(np.log(0.01), np.log(0.5))))
    return float(generator.choice([-1.0, 1.0]) * top * fast)


def _rest_piece(generator: np.random.Generator, top: float, low: float = 3.0,
                high: float = 12.0) -> np.ndarray:
    return np.zeros(_draw_length(generator, low, high))


def _turn_piece(generator: np.random.Generator, top: float) -> np.ndarray:
    return np.full(_draw_length(generator, 3.0, 15.0), _draw_speed(generator, top))


def _staircase_piece(generator: np.random.Generator, top: float) -> np.ndarray:
    """Several speeds one after another, both ways."""
    return np.concatenate([np.full(_draw_length(generator, 1.5, 4.0), _draw_speed(generator, top))
                           for _ in range(6)])


def _ramp_piece(generator: np.random.Generator, top: float) -> np.ndarray:
    """From one speed through zero to another."""
    high = abs(_draw_speed(generator, top))
    return (np.linspace(-high, high, _draw_length(generator, 8.0, 20.0))
            * generator.choice([-1.0, 1.0]))


def _slow_sweep_piece(generator: np.random.Generator, top: float) -> np.ndarray:
    high = top * np.exp(generator.uniform(np.log(0.002), np.log(0.1)))
    return (np.linspace(-high, high, _draw_length(generator, 10.0, 25.0))
            * generator.choice([-1.0, 1.0]))


def _reversal_piece(generator: np.random.Generator, top: float) -> np.ndarray:
    high, half = generator.uniform(0.3, 1.0) * top, _draw_length(generator, 0.5, 1.5)
    return np.tile(np.repeat([high, -high], half), 3)


def _swing_piece(generator: np.random.Generator, top: float) -> np.ndarray:
    time = KNOT_INTERVAL * np.arange(_draw_length(generator, 8.0, 20.0))
    high = generator.uniform(0.2, 1.0) * top
    return high * np.sin(2.0 * np.pi * generator.uniform(0.1, 1.0) * time)


def _wander_piece(generator: np.random.Generator, top: float) -> np.ndarray:
    """Random motion, as by hand."""
    shape = gaussian_filter1d(generator.standard_normal(_draw_length(generator, 10.0, 20.0)),
                              generator.uniform(0.3, 1.0) / KNOT_INTERVAL)
    return generator.uniform(0.5, 1.0) * top * shape / np.abs(shape).max()


def _eighth_turn_piece(generator: np.random.Generator, top: float) -> np.ndarray:
    """Eighths of a turn with a stop after each."""
    steps = 1 + int(0.25 * np.pi / (0.3 * top) / KNOT_INTERVAL)
    move = np.full(steps, 0.25 * np.pi / (steps * KNOT_INTERVAL)) * generator.choice([-1.0, 1.0])
    return np.tile(np.concatenate([move, np.zeros(_draw_length(generator, 1.0, 2.5))]), 8)


PIECES = (_rest_piece, _turn_piece, _staircase_piece, _ramp_piece, _slow_sweep_piece,
          _reversal_piece, _swing_piece, _wander_piece, _eighth_turn_piece)


def _two_way_motion(generator: np.random.Generator, duration: float, top: float) -> np.ndarray:
    """Draw rests and turns of one speed both ways, with short ramps."""
    pieces, length = [], 0
    while length < duration / KNOT_INTERVAL:
        for sign in (1.0, -1.0):
            pieces += [_rest_piece(generator, top, 20.0, 40.0),
                       np.full(_draw_length(generator, 30.0, 60.0), sign * top)]
        length = sum(len(piece) for piece in pieces)
    knots = np.concatenate([*pieces[:-1], _rest_piece(generator, top)])
    return gaussian_filter1d(knots[:round(duration / KNOT_INTERVAL)], 2.0)


def _smooth_motion(generator: np.random.Generator, duration: float, top: float) -> np.ndarray:
    """Swing so slowly that lag and delay cannot be distinguished."""
    shape = gaussian_filter1d(generator.standard_normal(round(duration / KNOT_INTERVAL)),
                              6.0 / KNOT_INTERVAL)
    edge = (0.5 - 0.5 * np.cos(np.pi * np.minimum(1.0,
                                                  np.arange(len(shape)) * KNOT_INTERVAL / 30.0)))
    return top * shape / np.abs(shape).max() * edge * edge[::-1]


MOTIONS = {
    'rich': _rich_motion,
    'one_speed': lambda generator, duration, top: np.full(round(duration / KNOT_INTERVAL), top),
    'two_way': _two_way_motion,
    'slow': lambda generator, duration, top: _rich_motion(generator, duration, 0.3),
    'smooth': _smooth_motion
}


def _warm_up_and_cycles(generator: np.random.Generator, time: np.ndarray) -> np.ndarray:
    """Draw a cold start plus a chamber with two to four cycles, with pauses at some corners."""
    half_cycles = generator.integers(3, 7)
    inner = np.sort(generator.uniform(0.1, 0.95, half_cycles)) * time[-1]
    corners = np.concatenate([[0.0], inner, [1.3 * time[-1]]])
    swing = generator.uniform(3.0, 12.0, len(corners)) * (-1.0) ** np.arange(
        len(corners)) * generator.choice([-1.0, 1.0])
    warm_up = generator.uniform(0.0, 8.0) * -np.exp(-time / generator.uniform(60.0, 250.0))
    return (generator.uniform(18.0, 35.0) + warm_up
            + lag(np.interp(time, corners, swing), time[1] - time[0],
                  generator.uniform(15.0, 40.0)))


def _triangle_temperature(generator: np.random.Generator, time: np.ndarray) -> np.ndarray:
    turn = generator.uniform(0.4, 0.6) * time[-1]
    speed = generator.uniform(0.02, 0.04)
    return 20.0 + speed * (turn - np.abs(time - turn))


TEMPERATURES = {
    'rich': _warm_up_and_cycles,
    'ramp': lambda generator, time: (
        generator.uniform(15.0, 25.0) + generator.uniform(8.0, 20.0) * time / time[-1]),
    'cold_start': lambda generator, time: (
        generator.uniform(30.0, 40.0)
        - generator.uniform(8.0, 15.0) * np.exp(-time / (0.2 * time[-1]))),
    'triangle': _triangle_temperature,
    'triangles': lambda generator, time: 20.0 + 24.0 * np.abs(
        (time / time[-1] * generator.integers(3, 6) + generator.random()) % 1.0 - 0.5),
    # half a wave, slow beside any lag of a gyro
    'smooth': lambda generator, time: (
        25.0 + generator.uniform(-10.0, 10.0) * np.cos(np.pi * time / time[-1])),
    'constant': lambda generator, time: np.full(len(time), generator.uniform(20.0, 30.0))
}


def _stepped_supply(generator: np.random.Generator, time: np.ndarray,
                    temperature: np.ndarray) -> np.ndarray:
    """Draw a supply that is switched between levels some times, and wanders by some millivolts."""
    interval = time[1] - time[0]
    edges = np.sort(generator.uniform(0.0, time[-1], generator.integers(12, 25)))
    levels = generator.uniform(-0.25, 0.25, len(edges) + 1)
    wander = gaussian_filter1d(generator.standard_normal(len(time)), 20.0 / interval)
    return generator.choice([3.3, 5.0]) + lag(levels[np.searchsorted(edges, time)], interval,
                                              0.2) + 0.01 * wander / np.std(wander)


SUPPLIES = {'rich': _stepped_supply,
            'heating': lambda generator, time, temperature: 5.0 + 0.02 * (temperature - 25.0),
            'constant': lambda generator, time, temperature: np.full(len(time), 5.0)}


def _rich_force(generator: np.random.Generator, time: np.ndarray,
                rate: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Tilt slowly between poses, and vibrate while a motor runs, at rest and in motion."""
    edges = np.sort(generator.uniform(0.0, time[-1], generator.integers(8, 15)))
    poses = generator.uniform(-0.7 * np.pi, 0.7 * np.pi, len(edges) + 1)
    angle = lag(lag(poses[np.searchsorted(edges, time)], time[1] - time[0], 8.0),
                time[1] - time[0], 8.0)
    starts = np.sort(generator.uniform(0.0, time[-1], generator.integers(10, 25)))
    levels = generator.choice([0.0, 1.0],
                              len(starts) + 1) * generator.uniform(0.3, 2.0, len(starts) + 1)
    # the vibration comes and goes within 0.5 s
    level = lag(levels[np.searchsorted(starts, time)], time[1] - time[0], 0.2)
    return GRAVITY * np.cos(angle), generator.standard_normal(len(time)) * level


def _turning_force(generator: np.random.Generator, time: np.ndarray,
                   rate: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Shake in proportion to the square root of the speed, so that power is as the speed."""
    return (np.full(len(time), GRAVITY),
            generator.choice([-1.0, 1.0], len(time)) * np.sqrt(np.abs(rate)))


FORCES = {'rich': _rich_force,
          'one_pose': lambda generator, time, rate: (np.full(len(time), GRAVITY),
                                                     np.zeros(len(time))),
          'turning': _turning_force,
          'off_axis': lambda generator, time, rate: (GRAVITY + 0.15 * rate ** 2,
                                                     np.zeros(len(time)))}


def lag(signal: np.ndarray, interval: float, time_constant: float) -> np.ndarray:
    """Return the output of a first-order lag, exact for piecewise linear signals."""
    decay = np.exp(-interval / time_constant)
    ramp = time_constant / interval * -np.expm1(-interval / time_constant)
    # x' = (u - x) / tau over one interval: x1 = decay x0 + (ramp - decay) u0 + (1 - ramp) u1
    start = [ramp * signal[0]]
    return lfilter([1.0 - ramp, ramp - decay], [1.0, -decay], signal, zi=start)[0]
