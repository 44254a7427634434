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
The motion within the limits of a robot that minimizes the heading error of a later drive.

The accuracy of a run is computed before it is driven. `fit_likelihood` weighs increments of
headings; the same columns, the same priors on delay and lag and the noise figures of the gyro give
the covariance of scale factor error s and bias b. The rest after the run is combined with them as
in `check_rest`. From these follows the covariance of the heading of a later drive. Flicker and
random walk of the bias, which the fit does not weigh, are propagated through its weights.

A motion that returns has no net turn, so that the estimates of s and b are independent. The
deviation of the bias depends on the white noise N, the time T, N / √T, and the rest, but not on
the motion; that of s depends on the motion.

"""

from __future__ import annotations

from dataclasses import dataclass
import math

from gyro_calibration.calibration.likelihood import (
    BLOCK,
    block_length,
    DELAY_DEVIATION,
    following,
    LAG_DEVIATION,
)
from gyro_calibration.calibration.self_calibration import (
    combined_rest,
    Limits,
    rest_variance,
    SETTLED,
)
from gyro_calibration.logs.log import Array, DataRefused, DEGREE, Number
from gyro_calibration.model.motion import from_rates, Motion
from gyro_calibration.model.noise import increment_covariance, Noise
import numpy as np
from scipy.optimize import differential_evolution
from scipy.special import ndtri

#: Cells in which the noise is counted, in one block of the fit; points of the motion in one cell.
_CELLS, _POINTS = 5, 5
#: Largest number of cells of the drive, of 1 s or longer.
_MOST = 600
#: Median of the absolute value of a normal variable, standard deviations.
_MEDIAN = float(ndtri(0.75))


@dataclass(frozen=True)
class Ability:
    """
    The limits of the motion of a robot.

    Attributes
    ----------
    rate, acceleration, jerk : largest absolute values, rad/s, rad/s², rad/s³; inf for no limit of
        the jerk
    slowest : smallest rate of a turn between its ramps, rad/s, at which the robot turns smoothly
    lowest, highest : limits of the heading, rad, which begins at 0
    rest : minimum duration of the rests at the beginning and at the end, s

    """

    rate: float
    acceleration: float
    jerk: float = math.inf
    slowest: float = 0.0
    lowest: float = -math.inf
    highest: float = math.inf
    rest: float = 1.0

    def rising(self, rate: Number) -> tuple[Number, Number]:
        """Return the time of a ramp from rest to a rate less its rounding, and the rounding, s."""
        jerked = np.sqrt(rate / self.jerk)
        return (np.maximum(rate / self.acceleration, jerked),
                np.minimum(self.acceleration / self.jerk, jerked))

    def ramp(self, rate: Number) -> Number:
        """Return the duration of a ramp from rest to a rate, s."""
        rising, rounding = self.rising(rate)
        return rising + rounding

    def fastest(self, angle: float) -> float:
        """Return the fastest rate, rad/s, whose ramps fit into a turn by an angle above 0, rad."""
        jerked = 0.5 * self.acceleration ** 2 / self.jerk
        steep, low = (math.sqrt(jerked ** 2 + self.acceleration * angle) - jerked,
                      (0.25 * angle ** 2 * self.jerk) ** (1.0 / 3.0))
        return min(self.rate, low if low < 2.0 * jerked else steep)

    def reach(self, duration: float) -> float:
        """Return the largest turn from rest to rest in a duration, s, rad."""
        half, rounding = 0.5 * duration, self.acceleration / self.jerk
        rate = min(self.rate, self.acceleration * (half - rounding) if half > 2.0 * rounding
                   else 0.25 * self.jerk * half ** 2)
        return rate * (duration - float(self.ramp(rate)))


@dataclass(frozen=True)
class Prediction:
    """
    The expected accuracy of a calibration by a motion.

    Attributes
    ----------
    scale_deviation : standard deviation of s, 1
    bias_deviation : standard deviation of b against the mean bias of the drive that follows,
        rad/s; without flicker and random walk it is what the calibration states
    heading_error : mean absolute error of the heading over that drive, rad
    floor : the part of it that white noise causes, which remains if s and the bias are known at
        all times

    """

    scale_deviation: float
    bias_deviation: float
    heading_error: float
    floor: float


class Forecast:
    """Predictions for all motions of one length, one gyro and one later drive."""

    def __init__(self, noise: Noise, duration: float, drive: Motion, length: float,
                 rest: float = Limits.rest):
        """
        Prepare.

        Parameters
        ----------
        noise : of the gyro; its angle random walk is above 0
        duration : of the motions, s
        drive : motion of the robot after the rest, repeated where it ends
        length : of the drive, s
        rest : duration of the rest, which begins `SETTLED` s after the motion, s; 0 for none

        """
        self._noise, self._duration, self._length, self._rest = noise, duration, length, rest
        time = np.linspace(0.0, length, min(max(round(length), 1), _MOST) + 1)[1:]
        self._used = np.vstack([_heading(drive, time), time])
        self.floor = (math.sqrt(2.0 / math.pi) * noise.angle_random_walk
                      * float(np.sqrt(time).mean()))
        self._noises: dict[int, _Noises] = {}

    def predict(self, motion: Motion) -> Prediction:
        """Return the prediction for a motion that turns and has the length of the forecast."""
        return self._predict(motion, round(self._duration / block_length(motion)), True)

    def error(self, motion: Motion) -> float:
        """
        Return the heading error, rad, by blocks of one length for all motions.

        A fit takes shorter blocks where the motion is fast, and loses less at both ends, which
        improves the bias by 0.3 %. A search with these blocks would prefer fast motions for it, at
        the cost of the scale; with the allowance for a difference between the senses of turning it
        would prefer slow ones.

        """
        blocks = math.ceil(self._duration / min(BLOCK, self._duration / 40.0))
        return self._predict(motion, blocks, False).heading_error

    def _predict(self, motion: Motion, blocks: int, follows: bool) -> Prediction:
        if blocks not in self._noises:
            self._noises[blocks] = _noises(self._noise, self._duration, blocks, self._rest,
                                           self._length, self._used.shape[1])
        noises = self._noises[blocks]
        weights, own = self._weights(motion, blocks, noises, follows)
        own = own + weights @ noises.run @ weights.T
        shared = weights @ noises.shared
        variance = (noises.drive - 2.0 * (self._used * shared).sum(axis=0)
                    + (self._used * (own @ self._used)).sum(axis=0))
        error = math.sqrt(2.0 / math.pi) * float(np.sqrt(np.maximum(variance, 0.0)).mean())
        # white noise is no part of the mean bias of the drive
        of_mean = (float(noises.drive[-1]) / self._length ** 2
                   - self._noise.angle_random_walk ** 2 / self._length)
        of_bias = own[1, 1] - 2.0 * shared[1, -1] / self._length + of_mean
        return Prediction(math.sqrt(own[0, 0]), math.sqrt(of_bias), error, self.floor)

    def _weights(self, motion: Motion, blocks: int, noises: _Noises,
                 follows: bool) -> tuple[Array, Array]:
        """
        Return the weights of (s, b) on increments of the gyro's integral and the rest, (2, n).

        Then their covariance by errors of gyro and robot that the fit does not determine, (2, 2).

        """
        count = blocks * _CELLS * _POINTS
        point = (np.arange(count) + 0.5) * self._duration / count
        rate = motion.rate_at(point)
        known = np.column_stack([motion.heading_at(point), point, rate, np.gradient(rate, point)])
        prior = np.array([math.inf, math.inf, DELAY_DEVIATION, LAG_DEVIATION])
        if follows:
            columns, deviations, parts = following(motion, point, 0.0)
            known, prior = np.hstack([known, columns]), np.append(prior, parts[0] * deviations)
        columns = np.diff(known.reshape(blocks, -1, len(prior)).mean(axis=1), axis=0)
        weighted = noises.inverse @ columns
        covariance = np.linalg.inv(columns.T @ weighted + np.diag(prior ** -2.0))
        weights = (covariance @ weighted.T)[:2]
        left = weights @ columns[:, 4:] * prior[4:]
        if not self._rest:
            return weights, left @ left.T
        white = self._noise.angle_random_walk / math.sqrt(self._rest)
        stated = covariance[:2, :2] + np.diag([0.0, self._noise.floor ** 2])
        # the median rest: halves differ by twice the deviation of the mean, times `_MEDIAN`
        expected, variance = (rest_variance(self._noise, self._rest, white, change)
                              for change in (0.0, 2.0 * _MEDIAN * white))
        gain, combined = combined_rest(
            stated, _MEDIAN * math.sqrt(stated[1, 1] + expected), variance)
        of_run = np.eye(2) - np.outer(gain, (0.0, 1.0))
        # the probability of another turn of the robot is no noise, but part of the stated variance
        more = combined - of_run @ stated @ of_run.T - variance * np.outer(gain, gain)
        return (np.column_stack([of_run @ weights, gain]),
                of_run @ left @ left.T @ of_run.T + more)


@dataclass(frozen=True)
class _Noises:
    """
    Noise of the observations of a run and its rest, and of the heading of the drive.

    The n observations are the increments between the blocks of the run, rad, and the mean rate of
    the rest, rad/s, if there is one.

    Attributes
    ----------
    inverse : of the covariance of the increments by white noise, rad⁻²
    run : covariance of the observations by all noise, shape (n, n)
    shared : covariance of the observations with the heading of the drive, shape (n, m)
    drive : variance of the heading of the drive, rad², shape (m,)

    """

    inverse: Array
    run: Array
    shared: Array
    drive: Array


def _noises(noise: Noise, duration: float, blocks: int, rest: float, length: float,
            later: int) -> _Noises:
    cells = blocks * _CELLS
    waited = np.cumsum([SETTLED, rest]) if rest else np.zeros(0)
    begin = duration + (waited[-1] if rest else 0.0)
    edges = np.concatenate([np.linspace(0.0, duration, cells + 1), duration + waited,
                            begin + np.linspace(0.0, length, later + 1)[1:]])
    covariance, spread = increment_covariance(noise, edges), _spread(blocks, duration / blocks)
    sums = np.tril(np.full((later, later), length / later))
    white = spread @ spread.T * (noise.angle_random_walk ** 2 * cells / duration)
    before = cells + len(waited)
    shown = spread
    if rest:
        shown = np.zeros((len(spread) + 1, before))
        shown[:-1, :cells], shown[-1, -1] = spread, 1.0
    return _Noises(np.linalg.inv(white), shown @ covariance[:before, :before] @ shown.T,
                   shown @ covariance[:before, before:] @ sums.T,
                   ((sums @ covariance[before:, before:]) * sums).sum(axis=1))


def _spread(blocks: int, length: float) -> Array:
    """Return the heading between blocks for a unit rate in each cell, s, (blocks - 1, cells)."""
    rising = (np.arange(_CELLS) + 0.5) / _CELLS
    before, after = np.eye(blocks)[:-1], np.eye(blocks)[1:]
    return (np.kron(before, rising) + np.kron(after, rising[::-1])) * length / _CELLS


def _heading(drive: Motion, time: Array) -> Array:
    """Return the heading, rad, of a drive that begins again where it ended."""
    rounds = np.floor(time / drive.duration)
    return rounds * drive.heading[-1] + drive.heading_at(time - rounds * drive.duration)


@dataclass(frozen=True)
class Turn:
    """One turn through an angle, rad, signed, at a rate above 0, rad/s, and its rest after, s."""

    angle: float
    rate: float
    rest: float


def profile(ability: Ability, turns: list[Turn], first_rest: float) -> Motion:
    """Return the motion of a rest and then turns; angles are large enough for their rates."""
    time, rate = [0.0, first_rest], [0.0, 0.0]
    for turn in turns:
        ramp, steady = (_ramp(ability, turn.rate),
                        abs(turn.angle) / turn.rate - ability.ramp(turn.rate))
        up, down = (time[-1] + ramp[0][1:],
                    time[-1] + ramp[0][1:] + ramp[0][-1] + max(steady, 0.0))
        rates = math.copysign(turn.rate, turn.angle) * ramp[1]
        time += [*up, *([down[0] - ramp[0][1]] if steady > 1e-9 else []), *down]
        rate += [*rates[1:], *([rates[-1]] if steady > 1e-9 else []), *rates[-2::-1]]
        if turn.rest > 1e-9:
            time.append(time[-1] + turn.rest)
            rate.append(0.0)
    return from_rates(np.array(time), np.array(rate))


def _ramp(ability: Ability, rate: float) -> tuple[Array, Array]:
    """Return times, s, and fractions of the rate from 0 to 1; rounded where jerk is limited."""
    rising, rounding = ability.rising(rate)
    if not rounding:
        return np.array([0.0, rising]), np.array([0.0, 1.0])
    time = np.linspace(0.0, rising + rounding, 17)
    squares = [np.maximum(time - since, 0.0) ** 2
               for since in (0.0, rising, rounding, rising + rounding)]
    return time, (squares[0] - squares[1] - squares[2] + squares[3]) / (2.0 * rising * rounding)


#: Smallest angle of a turn, rad.
_LEAST = 1e-9


class _Family:
    """
    Motions of one duration that alternate between two headings, as points of a unit cube.

    The axes: number of turns, sense of the first one, fractions of the headings above and below 0
    that are used, rates of one pair of turns and of the next, and fraction of the time that is
    rest between turns. Angles are stretched up to the duration or the limits of the heading.

    """

    axes = 7

    def __init__(self, ability: Ability, duration: float):
        self._ability, self._moving = ability, duration - 2.0 * ability.rest
        reach = ability.reach(0.5 * self._moving)
        self._up, self._down = min(ability.highest, reach), min(-ability.lowest, reach)
        place = self._up + self._down
        rate = ability.fastest(place)
        sweep = place / rate + ability.ramp(rate)
        self._most = min(max(2.0 * self._moving / sweep + 3.0, 3.0), 64.0)

    def motion(self, point: Array) -> Motion | None:
        """Return the motion at a point, or None where the robot is not able to do it."""
        turns = self.turns(point)
        return None if turns is None else profile(self._ability, turns, self._ability.rest)

    def turns(self, point: Array) -> list[Turn] | None:
        """Return the turns at a point, the last followed by the rest at the end."""
        count = int(2.0 * (self._most / 2.0) ** point[0])
        ends = np.zeros(count + 1)
        first = int(point[1] >= 0.5)
        ends[1 + first:-1:2], ends[2 - first:-1:2] = point[2] * self._up, -point[3] * self._down
        angles = np.diff(ends)
        if not np.abs(angles).min() > _LEAST:
            return None
        return self._timed(angles, np.where(np.arange(count) // 2 % 2, point[5], point[4]),
                           point[6])

    def _timed(self, angles: Array, speeds: Array, resting: float) -> list[Turn] | None:
        """Return turns of these proportions, at fractions of the fastest rate, in the time."""
        ability, gaps = self._ability, len(angles) - 1
        ends = np.cumsum(angles)
        room = min([place / end for place, end
                    in ((self._up, ends.max()), (self._down, -ends.min())) if end > _LEAST])
        rates = np.array([speed * ability.fastest(abs(angle) * room)
                          for speed, angle in zip(speeds, angles)])
        stretch = ((self._moving * (1.0 - resting) - ability.ramp(rates).sum())
                   / (np.abs(angles) / rates).sum())
        angles = angles * min(stretch, room)
        left = self._moving - float((np.abs(angles) / rates + ability.ramp(rates)).sum())
        if (stretch <= 0.0 or left < -1e-9 or rates.min() < ability.slowest
                or (np.abs(angles) < rates * ability.ramp(rates)).any()):
            return None
        rests = np.append(np.full(gaps, max(left, 0.0) / gaps), ability.rest)
        return [Turn(*values) for values in zip(angles.tolist(), rates.tolist(), rests.tolist())]


@dataclass(frozen=True)
class Plan:
    """A motion and the expected accuracy of a calibration by it."""

    motion: Motion
    prediction: Prediction


def best(ability: Ability, forecast: Forecast, duration: float, generator: np.random.Generator,
         generations: int = 60) -> Plan:
    """
    Return the motion of that length, s, with the least heading error in the forecast's drive.

    Parameters
    ----------
    forecast : for motions of this length
    generations : of the search; each tries 70 motions

    Raises
    ------
    DataRefused : the robot cannot make such a motion, or none would calibrate it well enough

    """
    _refuse(ability, duration)
    family = _Family(ability, duration)

    def cost(point: Array) -> float:
        motion = family.motion(point)
        return math.inf if motion is None else forecast.error(motion)
    found = differential_evolution(cost, _BOUNDS, maxiter=generations, popsize=10, tol=0.0,
                                   seed=generator, polish=False)
    motion = family.motion(found.x)
    if motion is None:
        raise DataRefused(f'no motion of {duration:g} s that turns there and back was found: '
                          'give more seconds or more place')
    return believed(Plan(motion, forecast.predict(motion)))


#: Bounds of the axes of `_Family`.
_BOUNDS = [(0.0, 1.0)] * 4 + [(0.2, 1.0)] * 2 + [(0.0, 0.6)]


def _refuse(ability: Ability, duration: float) -> None:
    """Refuse limits that leave no time or no place for a turn there and one back."""
    shortest = 2.0 * ability.rest + 4.0 * ability.ramp(ability.slowest)
    if duration <= shortest:
        raise DataRefused(
            f'{duration:g} s are too short for rests of {ability.rest:g} s at both ends, a turn '
            f'there and one back, which take more than {shortest:.3g} s: give more seconds, or '
            'less rest')
    angle, place = (ability.slowest * ability.ramp(ability.slowest),
                    max(ability.highest, -ability.lowest))
    if place <= angle:
        raise DataRefused(
            f'the place leaves a turn of {place / DEGREE:.3g} deg, and at the slowest smooth rate '
            f'the ramps alone need {angle / DEGREE:.3g} deg: give more place or more acceleration')


def believed(plan: Plan, limits: Limits | None = None) -> Plan:
    """Return the plan, or refuse one whose self-calibration would be refused."""
    limits, motion = limits or Limits(), plan.motion
    deviation, spread = (plan.prediction.scale_deviation,
                         float(np.std(motion.rate_at(np.arange(0.0, motion.duration, 0.05)))))
    if deviation > limits.scale_standard_deviation or spread < limits.rate_spread:
        raise DataRefused(
            f'the best motion of {motion.duration:g} s determines the scale factor to '
            f'{100.0 * deviation:.2g} %, and its rate varies by {spread / DEGREE:.2g} deg/s; '
            f'needed are {100.0 * limits.scale_standard_deviation:g} % and '
            f'{limits.rate_spread / DEGREE:g} deg/s: allow more seconds, a larger angle or '
            'faster turns')
    return plan


def plain(ability: Ability, duration: float) -> Motion:
    """
    Return the plain motion of that length, s: rest, one turn there, rest, one turn back, rest.

    It turns at half of the robot's fastest rate, as far as time and place allow, to the wider
    side.

    """
    _refuse(ability, duration)
    place, half = max(ability.highest, -ability.lowest), 0.5 * duration - ability.rest
    rate = max(0.5 * ability.fastest(min(place, ability.reach(half))), ability.slowest)
    angle = min(place, rate * (half - ability.ramp(rate)))
    between = 2.0 * (half - angle / rate - ability.ramp(rate))
    side = 1.0 if ability.highest == place else -1.0
    return profile(ability, [Turn(side * angle, rate, between),
                             Turn(-side * angle, rate, ability.rest)], ability.rest)


def able(ability: Ability, motion: Motion) -> bool:
    """Tell whether the robot can follow a motion of linear rates, its jerk aside."""
    heading = motion.heading_at(np.linspace(0.0, motion.duration, 2001))
    rate = motion.rate_at(motion.time)
    steepest = np.abs(np.diff(rate) / np.diff(motion.time)).max()
    exceeds = (np.abs(rate).max() / ability.rate - 1.0, steepest / ability.acceleration - 1.0,
               heading.max() - ability.highest, ability.lowest - heading.min())
    return bool(max(exceeds) < 1e-9)
