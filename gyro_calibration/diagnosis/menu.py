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
Experiments that show more of a gyro: motions, temperatures, supplies and poses in its range.

Each is told in words and planned in numbers, and the words give the numbers that are planned.

"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
import math

from gyro_calibration.diagnosis.replay import Replay, replay
from gyro_calibration.logs.log import Array, DEGREE, Log
import numpy as np

#: Points of a plan: enough for quick motion over minutes, and few enough to try many plans.
MOST_POINTS = 8_000
#: What a hand or a small table can do, and what any motor can, rad/s².
ACCELERATION, GENTLY = 20.0, 4.0
#: Corners of a motion are rounded over this time, s, as they are by any inertia.
ROUNDING = 0.1
#: Nothing is turned faster than this for an experiment, unless it was already, rad/s.
MOST_RATE = 300.0 * DEGREE
#: How fast a gyro is heated and cooled, K/s; and what a hot-air gun or a freezer does.
SLOWEST_HEATING, FASTEST_HEATING, QUICK_HEATING = 1.0 / 60.0, 10.0 / 60.0, 20.0 / 60.0
#: A range of temperature smaller than this shows nothing, K; so far it is widened then, and beyond
#: what was seen.
LEAST_SPAN, WIDER = 3.0, 10.0
#: A supply is stepped by this share where it was steady.
SUPPLY_SHARE = 0.05
#: Mean square of the vibration of a motor, where none was recorded, (m/s²)².
VIBRATION = 1.0
GRAVITY = 9.81

#: Straight lines one after another: (how long, s; the value at the end).
Pieces = Sequence[tuple[float, float]]


@dataclass(frozen=True)
class Conditions:
    """
    An experiment: arrays of shape (n,) at evenly spaced times, true and without noise.

    Attributes
    ----------
    name : of the experiment
    to_do : what to do, for people, with its numbers
    time : since power-on, s
    rate : rad/s
    temperature, supply, specific_force : degC, V and m/s²; None where the logs have none
    beyond : it goes beyond the rates and temperatures that the logs have shown

    """

    name: str
    to_do: str
    time: Array
    rate: Array
    temperature: Array | None
    supply: Array | None
    specific_force: Array | None
    beyond: bool = False

    @property
    def minutes(self) -> float:
        """Return how long it takes, min."""
        return float(self.time[-1] - self.time[0]) / 60.0

    def log(self) -> Log:
        """Return the log that a gyro without error has of it."""
        return Log(output=self.rate, time=self.time, temperature=self.temperature,
                   reference_rate=self.rate, supply=self.supply,
                   specific_force=self.specific_force)

    def replay(self, generator: np.random.Generator) -> Replay:
        """Return it laid out as logs are, its time since power-on; the generator fills no gaps."""
        laid = replay(self.log(), np.ones(len(self.time), bool), generator)
        return replace(laid, channels=replace(laid.channels, time=self.time))


@dataclass(frozen=True)
class Reach:
    """
    What logs have shown, as far as experiments keep to it.

    Attributes
    ----------
    rate : the top rate, rad/s, of two digits in deg/s; 0 where it never turned
    low, high, last : temperatures, degC; whole degrees but for the last; nan where there is none
    heating : how fast the temperature changes at most, K/s
    duration : of the longest log, s
    interval : of its samples, s
    supply : lowest and highest, V; None where it is not known
    supply_over_temperature : V and V/K: what the supply is at 0 degC, and what heat does to it
    force : m/s² and m/s² per (rad/s)²: the specific force at rest, and what turning adds; None
        where it is not known
    vibration : its mean square over a second at most, and how it grows with the rate: (m/s²)² and
        (m/s²)² per rad/s

    """

    rate: float
    low: float
    high: float
    last: float
    heating: float
    duration: float
    interval: float
    supply: tuple[float, float] | None
    supply_over_temperature: tuple[float, float]
    force: tuple[float, float] | None
    vibration: tuple[float, float]

    @property
    def knows_temperature(self) -> bool:
        """Tell whether there is a temperature."""
        return math.isfinite(self.last)

    @property
    def span(self) -> float:
        """Return the range of temperature, K."""
        return self.high - self.low


def reach(replays: Sequence[Replay]) -> Reach:
    """Return what logs have shown."""
    has = frozenset.intersection(*(each.has for each in replays))
    rate = np.concatenate([each.on_grid(each.channels.rate) for each in replays])
    low, high, last, heating = _temperatures(replays) if 'temperature' in has else (math.nan,) * 4
    supply, slope = (_supplies(replays, 'temperature' in has) if 'supply' in has
                     else (None, (0.0, 0.0)))
    force, vibration = _forces(replays, rate) if 'specific_force' in has else (None, (0.0, 0.0))
    return Reach(_rounded_down(float(np.quantile(np.abs(rate), 0.999)) / DEGREE) * DEGREE, low,
                 high, last, heating, max(each.duration for each in replays),
                 min(each.step for each in replays), supply, slope, force, vibration)


def _rounded_down(value: float) -> float:
    """Return a number of two digits, not above."""
    if value < 1e-3:
        return 0.0
    step = 10.0 ** (math.floor(math.log10(value)) - 1)
    return math.floor(value / step + 1e-6) * step


def _temperatures(replays: Sequence[Replay]) -> tuple[float, float, float, float]:
    slow = [each.on_grid(_lagged(each, 'temperature', 10.0)) for each in replays]
    known = np.concatenate([each.on_grid(each.channels.temperature) for each in replays])
    fastest = max(float(np.abs(np.gradient(each, log.step)).max())
                  for each, log in zip(slow, replays))
    return (math.ceil(known.min()), math.floor(known.max()), float(slow[-1][-1]),
            float(np.clip(_rounded_down(60.0 * fastest) / 60.0, SLOWEST_HEATING, FASTEST_HEATING)))


def _lagged(each: Replay, channel: str, time_constant: float) -> Array:
    assert each.channels.lagged is not None
    return np.asarray(each.channels.lagged(channel, time_constant))


def _supplies(replays: Sequence[Replay],
              warm: bool) -> tuple[tuple[float, float], tuple[float, float]]:
    supply = np.concatenate([each.on_grid(np.asarray(each.channels.supply)) for each in replays])
    bounds = float(np.quantile(supply, 0.01)), float(np.quantile(supply, 0.99))
    temperature = (np.concatenate([each.on_grid(each.channels.temperature) for each in replays])
                   if warm else 0.0 * supply)
    return bounds, _line(temperature, supply)


def _forces(replays: Sequence[Replay],
            rate: Array) -> tuple[tuple[float, float], tuple[float, float]]:
    force = np.concatenate([each.on_grid(_lagged(each, 'specific_force', 1.0))
                            for each in replays])
    power = np.concatenate([each.on_grid(_lagged(each, 'vibration', 1.0)) for each in replays])
    return _line(rate ** 2, force), (float(power.max()), max(0.0, _line(np.abs(rate), power)[1]))


def _line(x: Array, y: Array) -> tuple[float, float]:
    """Return offset and slope of a line, or a constant where x does not explain most of y."""
    centred, other = x - x.mean(), y - y.mean()
    if not (centred.any() and other.any()):
        return float(y.mean()), 0.0
    slope = float(centred @ other) / float(centred @ centred)
    explained = slope ** 2 * float(centred @ centred) / float(other @ other)
    return ((float(y.mean()) - slope * float(x.mean()), slope) if explained > 0.5
            else (float(y.mean()), 0.0))


# plans

def _plan(seen: Reach, name: str, to_do: str, *, rate: Pieces = (), temperature: Pieces = (),
          start: float | None = None, supply: Pieces = (), pose: Pieces = (), motor: Pieces = (),
          settled: bool = False, beyond: bool = False) -> Conditions:
    """
    Lay out an experiment; what it says nothing of stays as the logs have it.

    Parameters
    ----------
    seen : what the logs have shown
    name, to_do : of the experiment
    rate, supply, pose, motor : rad/s, V, m/s², and mean square of the vibration, (m/s²)²
    temperature, start : degC, and where it starts; the last one known where it is not given
    settled : the gyro has run for as long as the log when it begins
    beyond : it goes beyond what was seen

    """
    duration = max(sum(length for length, _ in each)
                   for each in (rate, temperature, supply, pose, motor))
    time = _spaced(duration, seen.interval)
    turning = _rounded(time, _course(time, rate, 0.0))
    degc = (_course(time, temperature, seen.last if start is None else start)
            if seen.knows_temperature else None)
    return Conditions(name, to_do, time + (seen.duration if settled else 0.0), turning, degc,
                      _supply(seen, time, supply, degc), _force(seen, time, turning, pose, motor),
                      beyond)


def _spaced(duration: float, interval: float) -> Array:
    return np.arange(0.0, duration, max(interval, duration / MOST_POINTS))


def _course(time: Array, pieces: Pieces, first: float) -> Array:
    ends = [0.0, *accumulate(length for length, _ in pieces)]
    return np.interp(time, ends, [first, *(value for _, value in pieces)])


def _rounded(time: Array, rate: Array) -> Array:
    count = min(round(ROUNDING / float(time[1] - time[0])), 100)
    window = np.hanning(2 * count + 1) if count else np.ones(1)
    return np.asarray(np.convolve(np.pad(rate, count, 'edge'), window / window.sum(), 'valid'))


def _supply(seen: Reach, time: Array, pieces: Pieces, degc: Array | None) -> Array | None:
    if seen.supply is None:
        return None
    begin, slope = seen.supply_over_temperature
    return (_course(time, pieces, seen.supply[0]) if pieces
            else begin + slope * (0.0 * time if degc is None else degc))


def _force(seen: Reach, time: Array, rate: Array, pose: Pieces, motor: Pieces) -> Array | None:
    """Return what the specific force is; a vibration goes to and fro with each sample."""
    if seen.force is None:
        return None
    begin, by_square = seen.force
    mean = _course(time, pose, begin) if pose else begin + by_square * rate ** 2
    power = _course(time, motor, 0.0) if motor else seen.vibration[1] * np.abs(rate)
    return mean + np.sqrt(power) * (-1.0) ** np.arange(len(time))


def _held(values: Sequence[float], length: float, ramp: float) -> Pieces:
    """Return one value after another, each reached within a ramp and held."""
    return [piece for value in values for piece in ((ramp, value), (length, value))]


def _degrees(rate: float) -> str:
    return f'{rate / DEGREE:.3g} deg/s'


def menu(seen: Reach, replays: Sequence[Replay]) -> list[Conditions]:
    """Return the experiments that are feasible, of those that take as long the simplest first."""
    return [*_rests(seen), *_repeats(replays), *(_motions(seen) if seen.rate else []),
            *_surroundings(seen), *(_cycles(seen) if seen.knows_temperature else []),
            *(_beyond(seen) if seen.rate else [])]


def _rests(seen: Reach) -> Iterator[Conditions]:
    yield _plan(seen, 'rest', 'let it rest for 5 min when it has settled', rate=[(300.0, 0.0)],
                settled=True)
    for name, many in (('long_rest', 4.0), ('very_long_rest', 12.0)):
        long = 60.0 * math.ceil(many * seen.duration / 60.0)
        yield _plan(seen, name,
                    f'let it rest for {_minutes(long)} at one temperature, from power-on',
                    rate=[(long, 0.0)])


def _repeats(replays: Sequence[Replay]) -> Iterator[Conditions]:
    """Do all again: what happened once does not happen again."""
    longest = max(replays, key=lambda each: each.duration)
    channels = longest.channels
    time = float(channels.time[longest.kept][0]) + np.arange(longest.points) * longest.step
    known = {name: (longest.on_grid(np.asarray(getattr(channels, name))) if name in longest.has
                    else None)
             for name in ('temperature', 'supply', 'specific_force')}
    yield Conditions('repeat', f'record the same {longest.duration / 60.0:.0f} min again, from '
                     'another power-on', time, longest.on_grid(channels.rate),
                     known['temperature'], known['supply'], known['specific_force'])


def _motions(seen: Reach) -> Iterator[Conditions]:
    top, ramp = seen.rate, max(0.1, 2.0 * seen.rate / ACCELERATION)
    slow = 0.1 * top
    yield _plan(seen, 'slow_sweep', f'sweep slowly through zero, between -{_degrees(slow)} and '
                f'{_degrees(slow)}, for 4 min',
                rate=[(30.0, slow), *[(60.0, -slow), (60.0, slow)] * 2][:5], settled=True)
    fastest = max(2.0, 2.0 * math.pi * top / ACCELERATION)
    for name, period in (('slow_swings', 2.5 * fastest), ('swings', 1.6 * fastest),
                         ('quick_swings', fastest)):
        yield _plan(seen, name, f'swing evenly to and fro for 2 min at up to {_degrees(top)}, the '
                    f'quickest swings in {period:.1f} s', rate=_swings(top, period), settled=True)
    gentle = max(0.5, 2.0 * top / GENTLY)
    yield _plan(seen, 'gentle_reversals', 'swing to and fro with reversals within '
                f'{gentle:.1f} s for 2 min at up to {_degrees(top)}',
                rate=_reversals(top, gentle, 120.0), settled=True)
    yield _plan(seen, 'reversals',
                f'swing fast with quick reversals for 2 min at up to {_degrees(top)}',
                rate=_reversals(top, ramp, 120.0), settled=True)
    for name, many in (('staircase', 1), ('long_staircase', 8)):
        yield _plan(seen, name, f'turn both ways at eight speeds for {4 * many} min, slow ones '
                    f'too, up to {_degrees(top)}',
                    rate=list(_staircase(top, ramp)) * many, settled=True)
    yield _plan(seen, 'one_speed', f'turn at {_degrees(0.5 * top)} for 3 min',
                rate=[(ramp, 0.5 * top), (180.0, 0.5 * top)], settled=True)
    yield _plan(seen, 'whole_turns', f'turn whole turns both ways at {_degrees(0.25 * top)}, '
                f'{_degrees(0.5 * top)} and {_degrees(top)}, one after another, '
                f'{_turning_time(top) / 60.0:.0f} min', rate=_whole_turns(top), settled=True)
    yield _plan(seen, 'eight_headings', 'stop at eight headings, 45 deg apart, for 20 s each',
                rate=_eighths(top), settled=True)
    ends = 60.0 * math.ceil(4.0 * seen.duration / 60.0)
    yield _plan(seen, 'reversals_at_both_ends', f'record {ends / 60.0:.0f} min with quick '
                f'reversals at up to {_degrees(top)} at both ends',
                rate=[*_reversals(top, ramp, 60.0), (1.0, 0.0), (ends - 121.0, 0.0),
                      *_reversals(top, ramp, 60.0)])


def _swings(top: float, fastest: float) -> Pieces:
    """Swing as a sine does, more and more quickly, for 2 min."""
    time = np.arange(1.0, 120.0 / 0.05) * 0.05
    frequency = np.linspace(0.2 / fastest, 1.0 / fastest, len(time))
    return [(0.05, value)
            for value in (top * np.sin(2.0 * math.pi * np.cumsum(frequency) * 0.05)).tolist()]


def _reversals(top: float, ramp: float, duration: float) -> Pieces:
    """Go to and fro, with halves between 0.3 and 1.2 s beside the ramps, each in its turn."""
    halves = np.resize([0.3, 0.9, 0.5, 1.2, 0.4], int(duration / (ramp + 0.66)))
    return [piece for number, half in enumerate(halves.tolist())
            for piece in _held([top * (-1.0) ** number], half, ramp)]


def _staircase(top: float, ramp: float) -> Pieces:
    steps = [sign * top * part for part in (1.0, 0.04, 0.7, 0.15, 0.85, 0.3, 0.5, 0.02)
             for sign in (1.0, -1.0)]
    return _held(steps, 15.0 - ramp, ramp)


def _turning_time(top: float) -> float:
    return max(120.0, 60.0 * math.ceil(8.0 * math.pi * 7.0 / (top * 60.0)))


def _whole_turns(top: float) -> Pieces:
    """Share the time so that each speed makes the same turns, as many back as forth."""
    length = _turning_time(top) / 14.0
    return [piece for part, many in ((0.25, 4.0), (0.5, 2.0), (1.0, 1.0)) for sign in (1.0, -1.0)
            for piece in ((1.0, sign * part * top), (many * length - 1.0, sign * part * top))]


def _eighths(top: float) -> Pieces:
    """Turn by an eighth at a quarter of the top rate, and stop."""
    rate = min(0.25 * top, 0.5)
    return [piece for _ in range(8)
            for piece in ((0.5, rate), (0.25 * math.pi / rate - 0.5, rate), (0.5, 0.0),
                          (20.0, 0.0))]


def _surroundings(seen: Reach) -> Iterator[Conditions]:
    if seen.supply is not None:
        low, high, steady = (*seen.supply,
                             seen.supply[1] - seen.supply[0] < SUPPLY_SHARE * seen.supply[0])
        if steady:
            low, high = (1.0 - SUPPLY_SHARE) * low, (1.0 + SUPPLY_SHARE) * high
        yield _plan(seen, 'supply_step', f'step the supply between {low:.2f} and {high:.2f} V '
                    'each minute for 6 min, at one temperature and at rest',
                    supply=_held([low, high] * 3, 59.5, 0.5), settled=True, beyond=steady)
    if seen.force is not None:
        # Slowly, for a quick change of pose is a vibration.
        yield _plan(seen, 'poses', 'turn it over slowly and let it rest for half a minute each '
                    'with its axis up, level, down and level',
                    pose=_held([GRAVITY, 0.0, -GRAVITY, 0.0], 30.0, 40.0), settled=True)
        level = seen.vibration[0] if seen.vibration[0] > 0.01 * VIBRATION else VIBRATION
        for name, many in (('motor', 5), ('long_motor', 30)):
            yield _plan(seen, name, 'run the motor and stop it each half minute for '
                        f'{many} min, at rest, shaking with {math.sqrt(level):.2g} m/s²',
                        motor=_held([0.0, level] * many, 29.5, 0.5), settled=True)


def _cycles(seen: Reach) -> Iterator[Conditions]:
    if seen.span >= LEAST_SPAN:
        yield from _cycles_between(seen, seen.low, seen.high, seen.heating, '', False)
        leg = seen.span / QUICK_HEATING
        many = math.ceil(600.0 / leg)
        yield _plan(seen, 'quick_triangles', 'heat and cool it faster than in the log, between '
                    f'{seen.low:.0f} and {seen.high:.0f} °C at {60.0 * QUICK_HEATING:.0f} K/min, '
                    f'{many} times, at rest, {_minutes(2.0 * many * leg)}',
                    temperature=[(leg, seen.high), (leg, seen.low)] * many, start=seen.low,
                    beyond=True)
    wide = 'go beyond what the log has seen: '
    yield from _cycles_between(seen, seen.low - WIDER, seen.high + WIDER, QUICK_HEATING, wide,
                               True)


def _cycles_between(seen: Reach, low: float, high: float, speed: float, prefix: str,
                    beyond: bool) -> Iterator[Conditions]:
    leg, name = (high - low) / speed, '_beyond' if beyond else ''
    between, pace = f'between {low:.0f} and {high:.0f} °C', f'{60.0 * speed:.2g} K/min'
    if not beyond:
        yield _plan(seen, 'warm_start', f'heat it to {high:.0f} °C before power-on, keep it '
                    'there, and let it rest for 15 min',
                    temperature=[(900.0, high)], start=high)
    yield _plan(seen, f'triangle{name}', f'{prefix}heat and cool it {between} at {pace}, twice, '
                f'at rest, {_minutes(4.0 * leg)}',
                temperature=[(leg, high), (leg, low)] * 2, start=low, beyond=beyond)
    slowly = [(leg, high), (120.0, high), (3.0 * leg, low), (120.0, low),
              (3.0 * leg, high), (120.0, high), (leg, low), (120.0, low)]
    yield _plan(seen, f'corners_at_two_speeds{name}', f'{prefix}heat and cool it {between} at '
                f'{pace} and at {20.0 * speed:.2g} K/min, at rest, with corners and pauses of '
                f'2 min, {_minutes(8.0 * leg + 480.0)}',
                temperature=slowly, start=low, beyond=beyond)
    if seen.rate:
        yield _plan(seen, f'staircase_in_triangle{name}', f'{prefix}heat and cool it {between} '
                    f'at {pace} while it turns both ways at up to {_degrees(seen.rate)}, '
                    f'{_minutes(4.0 * leg)}',
                    temperature=[(leg, high), (leg, low)] * 2, start=low,
                    rate=list(_staircase(seen.rate, 0.5)) * max(1, int(leg / 60.0)), beyond=beyond)


def _minutes(seconds: float) -> str:
    return f'{math.ceil(seconds / 60.0)} min'


def _beyond(seen: Reach) -> Iterator[Conditions]:
    for factor in (2.0, 3.0, 4.0, 6.0, 10.0):
        top = factor * seen.rate
        if top > MOST_RATE:
            break
        yield _plan(seen, f'{factor:.0f}_times_as_fast', 'turn faster than in the log, both ways '
                    f'at eight speeds for 4 min, up to {_degrees(top)}',
                    rate=_staircase(top, max(0.1, 2.0 * top / ACCELERATION)), settled=True,
                    beyond=True)
