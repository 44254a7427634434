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
Experiments that distinguish causes which the data at hand cannot distinguish.

Each experiment is a motion, a temperature, a supply or a pose in the range that the logs have
shown, told in words with the numbers that are planned. It is simulated with each cause in turn, as
it was fitted, in the noise that was fitted. Another cause is fitted to that, with all its values
and shapes free, beside the bias of the power-on, the scale and the other named causes. What it
leaves is how far apart the two are, in sigmas. The log at hand is counted in: what it says of a
value binds the value in the experiment.

"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, permutations
import math

from gyro_calibration.diagnosis.candidates import columns_of, with_shape
from gyro_calibration.diagnosis.causes import CAUSES
from gyro_calibration.diagnosis.regression_problem import (
    fitted,
    free_shapes,
    is_of_the_rate,
    Named,
    RegressionProblem,
    seen,
)
from gyro_calibration.diagnosis.replay import Replay, replay
from gyro_calibration.diagnosis.spectrum import angles, Shape
from gyro_calibration.diagnosis.units import number
from gyro_calibration.logs.log import Array, DEGREE, Log
import numpy as np

#: Points of a plan: enough for quick motion over minutes, and few enough to try many plans.
MOST_POINTS = 8_000
#: What a hand or a small table can do, rad/s², and the fastest that is turned, rad/s, unless the
#: logs are faster.
ACCELERATION, MOST_RATE = 20.0, 300.0 * DEGREE
#: Corners of a motion are rounded over this time, s, as they are by any inertia.
ROUNDING = 0.1
#: How fast a gyro is heated and cooled, K/s, and with a hot-air gun or a freezer.
HEATING, QUICK_HEATING = (1.0 / 60.0, 10.0 / 60.0), 20.0 / 60.0
#: A smaller range of temperature shows nothing, K; so far experiments go beyond what was seen.
LEAST_SPAN, WIDER = 3.0, 10.0
#: A supply is stepped by this share where it was steady.
SUPPLY_SHARE = 0.05
#: Mean square of the vibration of a motor, where none was recorded, (m/s²)².
VIBRATION = 1.0
GRAVITY = 9.81
#: Sigmas that distinguish two causes even if the fitted values are somewhat off; with fewer than
#: the least, in expectation, an experiment is not worth its time.
ENOUGH, LEAST = 8.0, 4.0
#: A shape is changed by this part of itself to see what its column changes by.
_SMALL = 1e-4
#: Causes found against a model only: a cause that looks like one takes the value that explains it.
_AGAINST_A_MODEL = ('bias', 'scale_factor_error')

#: Straight lines one after another: (how long, s; the value at the end).
Pieces = Sequence[tuple[float, float]]
#: (true one, another) of the members of a set -> how far they are apart, sigmas.
Pairs = dict[tuple[int, int], float]


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

    def replay(self, generator: np.random.Generator) -> Replay:
        """Return the log of a gyro without error, its time since power-on; no gaps are filled."""
        log = Log(output=self.rate, time=self.time, temperature=self.temperature,
                  reference_rate=self.rate, supply=self.supply,
                  specific_force=self.specific_force)
        laid = replay(log, np.ones(len(self.time), bool), generator)
        return replace(laid, channels=replace(laid.channels, time=self.time))


@dataclass(frozen=True)
class ObservedRange:
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


@dataclass(frozen=True)
class Experiment:
    """
    What to do to distinguish causes.

    Attributes
    ----------
    name : of the experiment; '' where none distinguishes them
    sentence : for people: what to do, and what it would bring
    separation : of the pair of causes that it distinguishes least, with the logs at hand, sigmas
    now : what the logs at hand have of that pair
    conditions : the experiment itself; None where there is none

    """

    name: str
    sentence: str
    separation: float = 0.0
    now: float = 0.0
    conditions: Conditions | None = None


# the range that was observed

def observed_range(replays: Sequence[Replay]) -> ObservedRange:
    """Return what logs have shown."""
    has = frozenset.intersection(*(each.has for each in replays))

    def joined(channel: str, lag: float = 0.0) -> Array:
        return np.concatenate([
            each.on_grid(each.lagged(channel, lag) if lag
                         else np.asarray(getattr(each.channels, channel))) for each in replays])

    rate = joined('rate')
    low = high = last = heating = math.nan
    supply, force, over_temperature, vibration = None, None, (0.0, 0.0), (0.0, 0.0)
    if 'temperature' in has:
        degc, slow = joined('temperature'), [each.on_grid(each.lagged('temperature', 10.0))
                                             for each in replays]
        fastest = max(float(np.abs(np.gradient(each, log.step)).max())
                      for each, log in zip(slow, replays))
        low, high, last = math.ceil(degc.min()), math.floor(degc.max()), float(slow[-1][-1])
        heating = float(np.clip(_two_digits(60.0 * fastest) / 60.0, *HEATING))
    if 'supply' in has:
        volts = joined('supply')
        supply = float(np.quantile(volts, 0.01)), float(np.quantile(volts, 0.99))
        over_temperature = _line(degc if 'temperature' in has else 0.0 * volts, volts)
    if 'specific_force' in has:
        power = joined('vibration', 1.0)
        force = _line(rate ** 2, joined('specific_force', 1.0))
        vibration = float(power.max()), max(0.0, _line(np.abs(rate), power)[1])
    return ObservedRange(
        _two_digits(float(np.quantile(np.abs(rate), 0.999)) / DEGREE) * DEGREE, low, high, last,
        heating, max(each.duration for each in replays), min(each.step for each in replays),
        supply, over_temperature, force, vibration)


def _two_digits(value: float) -> float:
    """Return a number of two digits, not above; 0 where it is next to nothing."""
    step = 10.0 ** (math.floor(math.log10(max(value, 1e-3))) - 1)
    return math.floor(value / step + 1e-6) * step if value >= 1e-3 else 0.0


def _line(x: Array, y: Array) -> tuple[float, float]:
    """Return offset and slope of a line, or a constant where x does not explain most of y."""
    centred, other = x - x.mean(), y - y.mean()
    if not (centred.any() and other.any()):
        return float(y.mean()), 0.0
    slope = float(centred @ other) / float(centred @ centred)
    explained = slope ** 2 * float(centred @ centred) / float(other @ other)
    return ((float(y.mean()) - slope * float(x.mean()), slope) if explained > 0.5
            else (float(y.mean()), 0.0))


# the experiments

def candidate_experiments(seen: ObservedRange, replays: Sequence[Replay]) -> list[Conditions]:
    """Return the experiments that are feasible, of those that take as long the simplest first."""
    return [*_rests(seen, replays), *(_motions(seen) if seen.rate else []),
            *_surroundings(seen), *(_cycles(seen) if math.isfinite(seen.last) else [])]


def _plan(seen: ObservedRange, name: str, to_do: str, *, rate: Pieces = (),
          temperature: Pieces = (), start: float | None = None, supply: Pieces = (),
          pose: Pieces = (), motor: Pieces = (), settled: bool = True,
          beyond: bool = False) -> Conditions:
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
    time = np.arange(0.0, duration, max(seen.interval, duration / MOST_POINTS))

    def course(pieces: Pieces, first: float) -> Array:
        ends = [0.0, *accumulate(length for length, _ in pieces)]
        return np.interp(time, ends, [first, *(value for _, value in pieces)])

    count = min(round(ROUNDING / float(time[1] - time[0])), 100)
    window = np.hanning(2 * count + 1) if count else np.ones(1)
    turning = np.asarray(np.convolve(np.pad(course(rate, 0.0), count, 'edge'),
                                     window / window.sum(), 'valid'))
    degc = (course(temperature, seen.last if start is None else start)
            if math.isfinite(seen.last) else None)
    volts = force = None
    if seen.supply is not None:
        begin, slope = seen.supply_over_temperature
        volts = (course(supply, seen.supply[0]) if supply
                 else begin + slope * (0.0 * time if degc is None else degc))
    if seen.force is not None:
        mean = (course(pose, seen.force[0]) if pose
                else seen.force[0] + seen.force[1] * turning ** 2)
        power = course(motor, 0.0) if motor else seen.vibration[1] * np.abs(turning)
        # a vibration goes to and fro with each sample
        force = mean + np.sqrt(power) * (-1.0) ** np.arange(len(time))
    return Conditions(name, to_do, time + (seen.duration if settled else 0.0), turning, degc,
                      volts, force, beyond)


def _held(values: Sequence[float], length: float, ramp: float) -> Pieces:
    """Return one value after another, each reached within a ramp and held."""
    return [piece for value in values for piece in ((ramp, value), (length, value))]


def _degrees(rate: float) -> str:
    return f'{rate / DEGREE:.3g} deg/s'


def _minutes(seconds: float) -> str:
    return f'{math.ceil(seconds / 60.0)} min'


def _rests(seen: ObservedRange, replays: Sequence[Replay]) -> Iterator[Conditions]:
    """Give rests, and all once again: what happened once does not happen again."""
    for name, many in (('long_rest', 4.0), ('very_long_rest', 12.0)):
        long = 60.0 * math.ceil(many * seen.duration / 60.0)
        yield _plan(seen, name,
                    f'let it rest for {_minutes(long)} at one temperature, from power-on',
                    rate=[(long, 0.0)], settled=False)
    longest = max(replays, key=lambda each: each.duration)
    channels = longest.channels
    time = float(channels.time[longest.kept][0]) + np.arange(longest.points) * longest.step
    degc, volts, force = (
        longest.on_grid(np.asarray(getattr(channels, name))) if name in longest.has else None
        for name in ('temperature', 'supply', 'specific_force'))
    yield Conditions('repeat', f'record the same {longest.duration / 60.0:.0f} min again, from '
                     'another power-on', time, longest.on_grid(channels.rate), degc, volts, force)


def _motions(seen: ObservedRange) -> Iterator[Conditions]:
    top, ramp = seen.rate, max(0.1, 2.0 * seen.rate / ACCELERATION)
    yield _plan(seen, 'slow_sweep', 'sweep slowly through zero, between '
                f'-{_degrees(0.1 * top)} and {_degrees(0.1 * top)}, for 4 min',
                rate=[(30.0, 0.1 * top), *[(60.0, -0.1 * top), (60.0, 0.1 * top)] * 2][:5])
    # halves between 0.3 and 1.2 s beside the ramps, each in its turn
    halves = [0.3, 0.9, 0.5, 1.2, 0.4]
    many = int(60.0 / (ramp + 0.66))
    minute = [piece for place in range(many)
              for piece in _held([top * (-1.0) ** place], halves[place % len(halves)], ramp)]
    yield _plan(seen, 'reversals',
                f'swing fast with quick reversals for 2 min at up to {_degrees(top)}',
                rate=minute * 2)
    for name, times in (('staircase', 1), ('long_staircase', 8)):
        yield _plan(seen, name, f'turn both ways at eight speeds for {4 * times} min, slow ones '
                    f'too, up to {_degrees(top)}', rate=_staircase(top, ramp) * times)
    # each speed makes the same turns, as many back as forth
    length = max(120.0, 60.0 * math.ceil(56.0 * math.pi / (top * 60.0))) / 14.0
    yield _plan(seen, 'whole_turns', f'turn whole turns both ways at {_degrees(0.25 * top)}, '
                f'{_degrees(0.5 * top)} and {_degrees(top)}, one after another, '
                f'{_minutes(14.0 * length)}',
                rate=[piece for part in (0.25, 0.5, 1.0) for sign in (1.0, -1.0)
                      for piece in ((1.0, sign * part * top),
                                    (length / part - 1.0, sign * part * top))])
    slow = min(0.25 * top, 0.5)
    yield _plan(seen, 'eight_headings', 'stop at eight headings, 45 deg apart, for 20 s each',
                rate=[(0.5, slow), (0.25 * math.pi / slow - 0.5, slow), (0.5, 0.0),
                      (20.0, 0.0)] * 8)
    ends = 60.0 * math.ceil(4.0 * seen.duration / 60.0)
    yield _plan(seen, 'reversals_at_both_ends', f'record {_minutes(ends)} with quick '
                f'reversals at up to {_degrees(top)} at both ends',
                rate=[*minute, (1.0, 0.0), (ends - 121.0, 0.0), *minute], settled=False)
    for factor in (2.0, 3.0, 4.0, 6.0, 10.0):
        if factor * top <= MOST_RATE:
            fast = factor * top
            yield _plan(seen, f'{factor:.0f}_times_as_fast', 'turn faster than in the log, both '
                        f'ways at eight speeds for 4 min, up to {_degrees(fast)}',
                        rate=_staircase(fast, max(0.1, 2.0 * fast / ACCELERATION)), beyond=True)


def _staircase(top: float, ramp: float) -> list[tuple[float, float]]:
    steps = [sign * top * part for part in (1.0, 0.04, 0.7, 0.15, 0.85, 0.3, 0.5, 0.02)
             for sign in (1.0, -1.0)]
    return list(_held(steps, 15.0 - ramp, ramp))


def _surroundings(seen: ObservedRange) -> Iterator[Conditions]:
    if seen.supply is not None:
        low, high = seen.supply
        steady = high - low < SUPPLY_SHARE * low
        if steady:
            low, high = (1.0 - SUPPLY_SHARE) * low, (1.0 + SUPPLY_SHARE) * high
        yield _plan(seen, 'supply_step', f'step the supply between {low:.2f} and {high:.2f} V '
                    'each minute for 6 min, at one temperature and at rest',
                    supply=_held([low, high] * 3, 59.5, 0.5), beyond=steady)
    if seen.force is not None:
        # slowly, for a quick change of pose is a vibration
        yield _plan(seen, 'poses', 'turn it over slowly and let it rest for half a minute each '
                    'with its axis up, level, down and level',
                    pose=_held([GRAVITY, 0.0, -GRAVITY, 0.0], 30.0, 40.0))
        level = seen.vibration[0] if seen.vibration[0] > 0.01 * VIBRATION else VIBRATION
        for name, many in (('motor', 5), ('long_motor', 30)):
            yield _plan(seen, name, 'run the motor and stop it each half minute for '
                        f'{many} min, at rest, shaking with {math.sqrt(level):.2g} m/s²',
                        motor=_held([0.0, level] * many, 29.5, 0.5))


def _cycles(seen: ObservedRange) -> Iterator[Conditions]:
    """Give cycles of temperature, within what was seen and beyond it."""
    for low, high, speed, beyond in ((seen.low, seen.high, seen.heating, False),
                                     (seen.low - WIDER, seen.high + WIDER, QUICK_HEATING, True)):
        if not beyond and seen.high - seen.low < LEAST_SPAN:
            continue
        leg, name = (high - low) / speed, '_beyond' if beyond else ''
        prefix = 'go beyond what the log has seen: ' if beyond else ''
        between, pace = f'between {low:.0f} and {high:.0f} °C', f'{60.0 * speed:.2g} K/min'
        if not beyond:
            yield _plan(seen, 'warm_start', f'heat it to {high:.0f} °C before power-on, keep it '
                        'there, and let it rest for 15 min', temperature=[(900.0, high)],
                        start=high, settled=False)
        triangles = [(leg, high), (leg, low)] * 2
        yield _plan(seen, f'triangle{name}', f'{prefix}heat and cool it {between} at {pace}, '
                    f'twice, at rest, {_minutes(4.0 * leg)}', temperature=triangles, start=low,
                    settled=False, beyond=beyond)
        yield _plan(seen, f'corners_at_two_speeds{name}', f'{prefix}heat and cool it {between} at '
                    f'{pace} and at {20.0 * speed:.2g} K/min, at rest, with corners and pauses of '
                    f'2 min, {_minutes(8.0 * leg + 480.0)}',
                    temperature=[(leg, high), (120.0, high), (3.0 * leg, low), (120.0, low),
                                 (3.0 * leg, high), (120.0, high), (leg, low), (120.0, low)],
                    start=low, settled=False, beyond=beyond)
        if seen.rate:
            yield _plan(seen, f'staircase_in_triangle{name}', f'{prefix}heat and cool it '
                        f'{between} at {pace} while it turns both ways at up to '
                        f'{_degrees(seen.rate)}, {_minutes(4.0 * leg)}', temperature=triangles,
                        start=low, rate=_staircase(seen.rate, 0.5) * max(1, int(leg / 60.0)),
                        settled=False, beyond=beyond)


# how far they distinguish causes

def distinguishing(whole: RegressionProblem, named: Sequence[Named], known: Named,
                   confounders: Sequence[Named], generator: np.random.Generator) -> Experiment:
    """
    Return the shortest experiment that tells a named cause from its confounders, or else the best.

    Parameters
    ----------
    whole : the logs
    named : all causes that are named, with values
    known : one of them
    confounders : causes that may stand in its place, with the shapes that fit best; values are
        fitted where they have none
    generator : source of what fills lost samples

    """
    others = tuple(each for each in named if each is not known)
    members = tuple(_valued(whole, others, each, known) for each in (known, *confounders))
    done = fitted(whole, [*others, members[0]])
    best = int(done.by_noise.likelihood[0].argmax())
    question = _Question(others, members, done.problem.shapes[best],
                         float(done.by_noise.squares[0, best]) / done.marginalized.freedom,
                         min(each.step for each in whole.replays))
    have = _root(question, whole.replays)
    # what happens once does not happen in another log
    again = replace(question, others=tuple(map(_gone, others)), members=tuple(map(_gone, members)))
    plans = candidate_experiments(observed_range(whole.replays), whole.replays)
    apart = [_apart(question, np.concatenate([have, _root(again, [plan.replay(generator)])]))
             for plan in plans]
    best = min(range(len(plans)), key=lambda place: _rank(plans[place], apart[place]))
    return _said(question, plans[best], apart[best], _apart(question, have))


@dataclass(frozen=True)
class _Question:
    """
    The causes to be distinguished.

    Attributes
    ----------
    others : causes that are named besides
    members : those to be distinguished, the named one first, with their values
    noise : relative to its white part, for points of `step` s
    level : spectral density of the white part, (rad/s)² s

    """

    others: tuple[Named, ...]
    members: tuple[Named, ...]
    noise: Shape
    level: float
    step: float

    def deviation(self, each: Replay) -> Array:
        """Return the standard deviation of the coefficients of a log."""
        # The rounding of a heading is one reading a point: its rate falls with the point's length.
        noise = replace(self.noise, reference=self.noise.reference * self.step / each.step)
        return np.sqrt(self.level * noise.variance(angles(each.points), each.step) / each.step)


def _gone(known: Named) -> Named:
    once = known.candidate.run is not None
    return replace(known, candidate=replace(known.candidate, run=-1)) if once else known


def _valued(whole: RegressionProblem, others: tuple[Named, ...], confounder: Named,
            known: Named) -> Named:
    """Return a cause with the values that fit best, where it has none."""
    candidate = confounder.candidate
    if confounder.values:
        return confounder
    if candidate.amplitude is not None:
        return replace(confounder, values=(candidate.amplitude,))
    if known.candidate.cause == 'bias':
        column = np.concatenate([candidate.columns(each)[0] for each in whole.replays])
        return replace(confounder, values=(known.values[0] / float(column.mean()),))
    done = fitted(whole, [*others, confounder])
    found = dict(zip(done.owner, done.estimates[0]))
    width = len(candidate.columns(whole.replays[0]))
    return replace(confounder, values=tuple(float(found.get((len(others), place), 0.0))
                                            for place in range(width)))


def _root(question: _Question, replays: Sequence[Replay]) -> Array:
    """Return a triangle with lengths and angles of the columns (see `_apart`), shape (q, q)."""
    deviation = np.concatenate([question.deviation(each) for each in replays])
    through = [seen(each, question.others) for each in replays]

    def columns(known: Named) -> Array:
        return columns_of(known.candidate,
                          replays if is_of_the_rate(known.candidate.cause) else through)

    def total(known: Named) -> Array:
        """Return what a cause does to the output."""
        return np.tensordot(known.values, columns(known), 1)

    def freedom(known: Named) -> Array:
        """Return what a cause can be changed by: its columns, and changes with its shapes."""
        own, changes = columns(known), []
        for place in free_shapes(known.candidate):
            shape = known.candidate.shapes[place]
            step = _SMALL * abs(shape) or 1e-6
            moved = replace(known, candidate=with_shape(known.candidate, place, shape + step))
            changes.append((total(moved) - total(known))[None] / step)
        return np.concatenate([own if known.candidate.amplitude is None else own[:0], *changes])

    scale = np.concatenate([each.coefficients(each.channels.rate) for each in through])[None]
    rows = np.concatenate([
        np.array([total(each) for each in question.members]), scale,
        *(freedom(each) for each in (*question.others, *question.members))]) / deviation
    padded = np.pad(rows, ((0, 0), (0, max(0, len(rows) - rows.shape[1]))))
    return np.asarray(np.linalg.qr(padded.T, mode='r'))


def _apart(question: _Question, root: Array) -> Pairs:
    """Return for each pair what the second cannot explain of the first, sigmas."""
    widths = [len(free_shapes(each.candidate))
              + (len(each.values) if each.candidate.amplitude is None else 0)
              for each in (*question.others, *question.members)]
    count, others = len(question.members), len(question.others)
    ends = count + 1 + np.cumsum(widths)
    places = [list(range(end - width, end)) for end, width in zip(ends.tolist(), widths)]
    common = [count, *(place for own in places[:others] for place in own)]
    found = {}
    for true, other in permutations(range(count), 2):
        bound = any(question.members[place].candidate.cause in _AGAINST_A_MODEL
                    for place in (true, other))
        free = root[:, [*common, *([] if bound else places[others + other])]]
        length = np.linalg.norm(free, axis=0)
        free = free[:, length > 0.0] / length[length > 0.0]
        column = root[:, true] - root[:, other]
        found[true, other] = float(np.linalg.norm(
            column - free @ np.linalg.lstsq(free, column, rcond=1e-9)[0]))
    return found


def _rank(plan: Conditions, apart: Pairs) -> tuple[float, ...]:
    """
    Return what is smallest for the best plan.

    First come those that distinguish all members, then those that tell the named one from all
    others; of both, those within what was seen, and of these the shortest, and the first of those
    that are as short. Where none is enough, the number of distinguished members counts.

    """
    reached = sum(min(value, ENOUGH) for value in apart.values())
    all_of_them = min(apart.values()) >= ENOUGH
    if not all_of_them and min(value for pair, value in apart.items() if 0 in pair) < ENOUGH:
        return (4.0, -reached, float(plan.beyond), round(plan.minutes))
    return (2.0 * plan.beyond + (not all_of_them), round(plan.minutes))


def _said(question: _Question, plan: Conditions, apart: Pairs, now: Pairs) -> Experiment:
    """Say what the best plan would bring; where that is nothing, what is known of the causes."""
    names = [each.candidate.cause for each in question.members]
    each_way = [min(apart[0, place], apart[place, 0]) for place in range(1, len(names))]
    distinct = [place for place, value in enumerate(each_way, 1) if value >= LEAST]
    if not distinct:
        return Experiment('', next((CAUSES[name].separate_by for name in names
                                    if name in CAUSES and CAUSES[name].separate_by), ''))
    worst = min(distinct, key=lambda place: each_way[place - 1])
    before, after = min(now[0, worst], now[worst, 0]), each_way[worst - 1]
    stay = [name for place, name in enumerate(names[1:], 1) if place not in distinct]
    rest = f'; {_listed(stay)} would stay possible' if stay else ''
    by = 'more than 100' if after > 100.0 else number(after, 2)
    return Experiment(
        plan.name, f'{plan.to_do}: would part {names[0]} from '
        f'{_listed([names[place] for place in distinct])} by {by} sigma (now {before:.1f}){rest}',
        after, before, plan)


def _listed(names: Sequence[str]) -> str:
    return ' and '.join(filter(None, [', '.join(names[:-1]), names[-1]]))
