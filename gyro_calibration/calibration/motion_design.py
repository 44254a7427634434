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

The columns and priors of `fit_likelihood` and the noise figures of the gyro give the covariance of
scale factor error s and bias b, with the rest after the run as in `check_rest`, and that of the
heading of a later drive. The deviation of b depends on the white noise and the time, not on the
motion, which determines s: a motion that returns has no net turn.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
import math

from gyro_calibration.calibration.likelihood import (
    block_duration, DELAY_DEVIATION, LAG_DEVIATION, MAX_BLOCK_DURATION, tracking_error_columns)
from gyro_calibration.calibration.self_calibration import (
    combine_with_rest, rest_variance, RunLimits, SETTLING_TIME)
from gyro_calibration.logs.log import Array, DataRefused, DEGREE, Number
from gyro_calibration.model.motion import Motion, motion_from_rates
from gyro_calibration.model.noise import increment_covariance, Noise
import numpy as np
from scipy.optimize import differential_evolution
from scipy.special import ndtri

#: Cells in which the noise is counted, in one block of the fit, and points of the motion in each.
_CELLS_PER_BLOCK = 5
#: Median of the absolute value of a normal variable, standard deviations.
_MEDIAN_SIGMA = float(ndtri(0.75))


@dataclass(frozen=True)
class RobotLimits:
    """The limits of the motion of a robot."""

    # largest absolute values, rad/s, rad/s², rad/s³; inf for no limit of the jerk
    rate: float
    acceleration: float
    jerk: float = math.inf
    # smallest rate of a turn between its ramps, rad/s, at which the robot turns smoothly
    slowest: float = 0.0
    # limits of the heading, rad, which begins at 0
    lowest: float = -math.inf
    highest: float = math.inf
    rest: float = 1.0  # minimum duration of the rests at the beginning and at the end, s

    def ramp_times(self, rate: Number) -> tuple[Number, Number]:
        """Return the time of a ramp from rest to a rate less its rounding, and the rounding, s."""
        jerked = np.sqrt(rate / self.jerk)
        return (np.maximum(rate / self.acceleration, jerked),
                np.minimum(self.acceleration / self.jerk, jerked))

    def ramp_duration(self, rate: Number) -> Number:
        """Return the duration of a ramp from rest to a rate, s."""
        rising, rounding = self.ramp_times(rate)
        return rising + rounding

    def max_turn_rate(self, angle: float) -> float:
        """Return the fastest rate, rad/s, whose ramps fit into a turn by an angle above 0, rad."""
        jerked = 0.5 * self.acceleration ** 2 / self.jerk
        steep = math.sqrt(jerked ** 2 + self.acceleration * angle) - jerked
        low = (0.25 * angle ** 2 * self.jerk) ** (1.0 / 3.0)
        return min(self.rate, low if low < 2.0 * jerked else steep)

    def max_turn_angle(self, duration: float) -> float:
        """Return the largest turn from rest to rest in a duration, s, rad."""
        half, rounding = 0.5 * duration, self.acceleration / self.jerk
        rate = min(self.rate, self.acceleration * (half - rounding) if half > 2.0 * rounding
                   else 0.25 * self.jerk * half ** 2)
        return rate * (duration - float(self.ramp_duration(rate)))


@dataclass(frozen=True)
class Prediction:
    """The expected accuracy of a calibration by a motion."""

    scale_deviation: float  # standard deviation of s, 1
    bias_deviation: float  # of b against the mean bias of the drive, rad/s
    heading_error: float  # mean absolute error of the heading over that drive, rad
    floor: float  # the part that white noise causes


class CalibrationForecast:
    """Predictions for all motions of one length, with a rest, one gyro and one later drive."""

    def __init__(self, noise: Noise, duration: float, drive: Motion, drive_duration: float):
        """Prepare for a gyro with noise; durations are in s."""
        self._noise, self._duration, self._drive_duration = noise, duration, drive_duration
        cells = min(max(round(drive_duration), 1), 600)
        time = np.linspace(0.0, drive_duration, cells + 1)[1:]
        rounds = np.floor(time / drive.duration)  # the drive begins again where it ended
        heading = rounds * drive.heading[-1] + drive.heading_at(time - rounds * drive.duration)
        self._drive_columns = np.vstack([heading, time])
        self.floor = (math.sqrt(2.0 / math.pi) * noise.angle_random_walk
                      * float(np.sqrt(time).mean()))

    def predict(self, motion: Motion, in_search: bool = False) -> Prediction:
        """
        Return the prediction for a motion that turns and has the length of the forecast.

        In a search the blocks have one length, and the senses of turning one scale: else it would
        prefer fast motions, or slow ones, at the cost of the scale.
        """
        longest = min(MAX_BLOCK_DURATION, self._duration / 40.0)
        blocks = (math.ceil(self._duration / longest) if in_search
                  else round(self._duration / block_duration(motion)))
        white_precision, of_run, of_both, of_drive = _noise_covariances(
            self._noise, self._duration, blocks, self._drive_duration,
            self._drive_columns.shape[1])
        # the weights of (s, b) on increments of the gyro's integral, (2, n), and the covariance by
        # errors of the robot that the fit does not determine, (2, 2)
        count = blocks * _CELLS_PER_BLOCK ** 2
        point = (np.arange(count) + 0.5) * self._duration / count
        rate = motion.rate_at(point)
        known = np.column_stack([motion.heading_at(point), point, rate, np.gradient(rate, point)])
        prior = np.array([math.inf, math.inf, DELAY_DEVIATION, LAG_DEVIATION])
        if not in_search:
            columns, deviations, parts = tracking_error_columns(motion, point, 0.0)
            known, prior = np.hstack([known, columns]), np.append(prior, parts[0] * deviations)
        columns = np.diff(known.reshape(blocks, -1, len(prior)).mean(axis=1), axis=0)
        weighted = white_precision @ columns
        covariance = np.linalg.inv(columns.T @ weighted + np.diag(prior ** -2.0))
        weights = (covariance @ weighted.T)[:2]
        of_tracking = weights @ columns[:, 4:] * prior[4:]
        unweighed = of_tracking @ of_tracking.T
        # the median rest: its halves differ by `_MEDIAN_SIGMA` deviations, twice that of the mean
        white = self._noise.angle_random_walk / math.sqrt(RunLimits.rest_duration)
        stated = covariance[:2, :2] + np.diag([0.0, self._noise.allan_floor ** 2])
        expected, variance = (rest_variance(self._noise, RunLimits.rest_duration, white, change)
                              for change in (0.0, 2.0 * _MEDIAN_SIGMA * white))
        gain, combined = combine_with_rest(
            stated, _MEDIAN_SIGMA * math.sqrt(stated[1, 1] + expected), variance)
        share = np.eye(2) - np.outer(gain, (0.0, 1.0))
        weights = np.column_stack([share @ weights, gain])
        # another turn of the robot is no noise, but part of the stated variance
        unweighed = share @ (unweighed - stated) @ share.T + combined - variance * np.outer(
            gain, gain)

        # the drive
        fit_covariance = unweighed + weights @ of_run @ weights.T
        shared = weights @ of_both
        variances = (of_drive - 2.0 * (self._drive_columns * shared).sum(axis=0)
                     + (self._drive_columns * (fit_covariance @ self._drive_columns)).sum(axis=0))
        error = math.sqrt(2.0 / math.pi) * float(np.sqrt(np.maximum(variances, 0.0)).mean())
        # white noise is no part of the mean bias of the drive
        bias_variance = (fit_covariance[1, 1] - 2.0 * shared[1, -1] / self._drive_duration
                         + float(of_drive[-1]) / self._drive_duration ** 2
                         - self._noise.angle_random_walk ** 2 / self._drive_duration)
        return Prediction(math.sqrt(fit_covariance[0, 0]), math.sqrt(bias_variance), error,
                          self.floor)


@lru_cache(maxsize=64)
def _noise_covariances(noise: Noise, duration: float, blocks: int, drive_duration: float,
                       drive_cells: int) -> tuple[Array, Array, Array, Array]:
    """
    Return the noise of the observations of a run and its rest, and of the heading of the drive.

    The n observations are the increments between the blocks of the run, rad, and the mean rate of
    the rest, rad/s. Returned are the inverse covariance of the increments by white noise, the
    covariance of the observations by all noise, (n, n), that with the heading of the drive, (n,
    m), and the variance of that heading, rad², (m,).
    """
    cells = blocks * _CELLS_PER_BLOCK
    rest = duration + np.cumsum([SETTLING_TIME, RunLimits.rest_duration])
    edges = np.concatenate([np.linspace(0.0, duration, cells + 1), rest,
                            rest[-1] + np.linspace(0.0, drive_duration, drive_cells + 1)[1:]])
    covariance = increment_covariance(noise, edges)
    # heading between blocks for a unit rate in each cell, s, shape (blocks - 1, cells)
    rising = (np.arange(_CELLS_PER_BLOCK) + 0.5) / _CELLS_PER_BLOCK
    before_edge, after_edge = np.eye(blocks)[:-1], np.eye(blocks)[1:]
    spread = ((np.kron(before_edge, rising) + np.kron(after_edge, rising[::-1]))
              * (duration / blocks) / _CELLS_PER_BLOCK)
    sums = np.tril(np.full((drive_cells, drive_cells), drive_duration / drive_cells))
    white = spread @ spread.T * (noise.angle_random_walk ** 2 * cells / duration)
    before = cells + len(rest)
    observation_matrix = np.zeros((len(spread) + 1, before))
    observation_matrix[:-1, :cells], observation_matrix[-1, -1] = spread, 1.0
    return (np.linalg.inv(white),
            observation_matrix @ covariance[:before, :before] @ observation_matrix.T,
            observation_matrix @ covariance[:before, before:] @ sums.T,
            ((sums @ covariance[before:, before:]) * sums).sum(axis=1))


def _build_motion(robot: RobotLimits, turns: Iterable[tuple[float, float, float]]) -> Motion:
    """Return a rest, then turns of angle, rad, signed, rate above 0, rad/s, and rest after, s."""
    time, rate = [0.0, robot.rest], [0.0, 0.0]
    for angle, speed, rest in turns:
        # a ramp: times, s, and fractions of the rate from 0 to 1; rounded where jerk is limited
        rising, rounding = robot.ramp_times(speed)
        since, share = np.array([0.0, rising]), np.array([0.0, 1.0])
        if rounding:
            since = np.linspace(0.0, rising + rounding, 17)
            squares = [np.maximum(since - begin, 0.0) ** 2
                       for begin in (0.0, rising, rounding, rising + rounding)]
            share = (squares[0] - squares[1] - squares[2] + squares[3]) / (
                2.0 * rising * rounding)
        steady = abs(angle) / speed - robot.ramp_duration(speed)
        up = time[-1] + since[1:]
        down = time[-1] + since[1:] + since[-1] + max(steady, 0.0)
        rates = math.copysign(speed, angle) * share
        time += [*up, *([down[0] - since[1]] if steady > 1e-9 else []), *down]
        rate += [*rates[1:], *([rates[-1]] if steady > 1e-9 else []), *rates[-2::-1]]
        if rest > 1e-9:
            time.append(time[-1] + rest)
            rate.append(0.0)
    return motion_from_rates(np.array(time), np.array(rate))


class _MotionFamily:
    """
    Motions of one duration that alternate between two headings, as points of a unit cube.

    The axes: number of turns, sense of the first one, shares of the headings above and below 0,
    rates of one pair of turns and of the next, and share of rests between turns.
    """

    def __init__(self, robot: RobotLimits, duration: float):
        self._robot, self._moving_duration = robot, duration - 2.0 * robot.rest
        reach = robot.max_turn_angle(0.5 * self._moving_duration)
        self._reach_up, self._reach_down = min(robot.highest, reach), min(-robot.lowest, reach)
        heading_span = self._reach_up + self._reach_down
        rate = robot.max_turn_rate(heading_span)
        sweep = heading_span / rate + robot.ramp_duration(rate)
        self._max_turns = min(max(2.0 * self._moving_duration / sweep + 3.0, 3.0), 64.0)

    def motion_at(self, point: Array) -> Motion | None:
        """Return the motion at a point, or None where the robot is not able to do it."""
        robot, count = self._robot, int(2.0 * (self._max_turns / 2.0) ** point[0])
        ends = np.zeros(count + 1)
        first = int(point[1] >= 0.5)
        ends[1 + first:-1:2] = point[2] * self._reach_up
        ends[2 - first:-1:2] = -point[3] * self._reach_down
        angles = np.diff(ends)
        if not np.abs(angles).min() > 0.0:
            return None
        # stretched up to the time, at fractions of the fastest rate
        max_stretch = min(
            [place / end for place, end in ((self._reach_up, ends.max()),
                                            (self._reach_down, -ends.min())) if end > 0.0])
        speeds = np.where(np.arange(count) // 2 % 2, point[5], point[4])
        rates = np.array([speed * robot.max_turn_rate(abs(angle) * max_stretch)
                          for speed, angle in zip(speeds, angles)])
        ramps = robot.ramp_duration(rates)
        stretch = ((self._moving_duration * (1.0 - point[6]) - ramps.sum())
                   / (np.abs(angles) / rates).sum())
        angles = angles * min(stretch, max_stretch)
        left = self._moving_duration - float((np.abs(angles) / rates + ramps).sum())
        if (stretch <= 0.0 or left < -1e-9 or rates.min() < robot.slowest
                or (np.abs(angles) < rates * ramps).any()):
            return None
        rests = np.append(np.full(count - 1, max(left, 0.0) / (count - 1)), robot.rest)
        return _build_motion(robot, zip(angles.tolist(), rates.tolist(), rests.tolist()))


def find_best_motion(robot: RobotLimits, forecast: CalibrationForecast, duration: float,
                     generator: np.random.Generator,
                     generations: int = 60) -> tuple[Motion, Prediction]:
    """
    Return the motion of a length, s, with the least heading error in the forecast's drive.

    It comes with its prediction. Each generation of the search tries 70 motions. `DataRefused` is
    raised where the robot cannot make one, or none would calibrate well enough.
    """
    _refuse_impossible(robot, duration)
    family = _MotionFamily(robot, duration)

    def cost(point: Array) -> float:
        motion = family.motion_at(point)
        return math.inf if motion is None else forecast.predict(motion, True).heading_error
    found = differential_evolution(cost, [(0.0, 1.0)] * 7, maxiter=generations, popsize=10,
                                   tol=0.0, seed=generator, polish=False)
    if (motion := family.motion_at(found.x)) is None:
        raise DataRefused(f'no motion of {duration:g} s that turns there and back was found: '
                          'allow more seconds or a larger angle')
    prediction, limits = forecast.predict(motion), RunLimits()
    # a self-calibration by it would be refused
    deviation = prediction.scale_deviation
    spread = float(np.std(motion.rate_at(np.arange(0.0, motion.duration, 0.05))))
    if deviation > limits.max_scale_deviation or spread < limits.min_rate_spread:
        raise DataRefused(
            f'the best motion of {motion.duration:g} s determines the scale factor to '
            f'{100.0 * deviation:.2g} %, and its rate varies by {spread / DEGREE:.2g} deg/s; '
            f'needed are {100.0 * limits.max_scale_deviation:g} % and '
            f'{limits.min_rate_spread / DEGREE:g} deg/s: allow more seconds, a larger angle or '
            'faster turns')
    return motion, prediction


def _refuse_impossible(robot: RobotLimits, duration: float) -> None:
    """Refuse limits that leave no time or no angle for a turn there and one back."""
    shortest = 2.0 * robot.rest + 4.0 * robot.ramp_duration(robot.slowest)
    if duration <= shortest:
        raise DataRefused(f'{duration:g} s are too short for rests of {robot.rest:g} s at both '
                          f'ends, a turn there and one back, which take more than {shortest:.3g} '
                          's: allow more seconds or shorter rests')
    angle = robot.slowest * robot.ramp_duration(robot.slowest)
    heading_span = max(robot.highest, -robot.lowest)
    if heading_span <= angle:
        raise DataRefused(f'the headings allow a turn of {heading_span / DEGREE:.3g} deg, and at '
                          f'the slowest smooth rate the ramps alone need {angle / DEGREE:.3g} '
                          'deg: allow a larger angle or more acceleration')


def plain_motion(robot: RobotLimits, duration: float) -> Motion:
    """Return a motion, s, of one turn there and back with rests, at half the fastest rate."""
    _refuse_impossible(robot, duration)
    place, half = max(robot.highest, -robot.lowest), 0.5 * duration - robot.rest
    rate = max(0.5 * robot.max_turn_rate(min(place, robot.max_turn_angle(half))), robot.slowest)
    angle = min(place, rate * (half - robot.ramp_duration(rate)))
    between = 2.0 * (half - angle / rate - robot.ramp_duration(rate))
    side = 1.0 if robot.highest == place else -1.0
    return _build_motion(
        robot, [(side * angle, rate, between), (-side * angle, rate, robot.rest)])


def can_follow(robot: RobotLimits, motion: Motion) -> bool:
    """Tell whether the robot can follow a motion of linear rates, its jerk aside."""
    heading = motion.heading_at(np.linspace(0.0, motion.duration, 2001))
    rate = motion.rate_at(motion.time)
    steepest = np.abs(np.diff(rate) / np.diff(motion.time)).max()
    exceeds = (np.abs(rate).max() / robot.rate - 1.0, steepest / robot.acceleration - 1.0,
               heading.max() - robot.highest, robot.lowest - heading.min())
    return bool(max(exceeds) < 1e-9)
