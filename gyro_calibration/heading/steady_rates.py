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
Steady rates of which one is that of a rest, while the bias is unknown.

To a gyro alone, a rest and a turn at a constant rate differ by the rate only. As long as the prior
of the bias is wider than a rest of 1 s measures it, each steady rate within this prior may be the
bias, or none of them is, and the bias has its prior. Under each of these hypotheses each other
steady rate is a rest or a turn, with the prior odds of a rest and a straight drive. The bias in
use is that of the first rest; the uncertainty of the heading contains all others, and the bias is
changed to another steady rate that is 19 times as probable as the one in use. Under another bias
the rests until then were turns: the heading changes by the difference times the time since its
begin.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
import math

from gyro_calibration.heading.kalman import HeadingState, RateIntegral
from gyro_calibration.heading.stationary import (
    chi_squared_quantile, MAX_SCATTER_RATIO, MEAN_LAGS, PRIOR_COUNTS, SCATTER_RATIOS,
    WINDOW_DURATION)
from gyro_calibration.logs.log import Array, Mask
from gyro_calibration.model.noise import Noise
import numpy as np
from scipy.special import log_softmax, logsumexp, ndtr, softmax

#: Steady rates in memory.
_MAX_RATES = 20
#: Prior probability that a steady rate is that of a rest.
_REST_PROBABILITY = PRIOR_COUNTS[0] / (PRIOR_COUNTS[0] + 1.0)
#: The prior of the bias as a sum of normal distributions: their means and their variance, relative
#: to its standard deviation and variance, and logarithms of their weights.
_PLACES, _PLACE_VARIANCE = np.arange(-6.0, 6.1, 0.5), 0.25
_PLACE_WEIGHTS = log_softmax(-0.5 * _PLACES ** 2 / (1.0 - _PLACE_VARIANCE))
#: Probability, of the one in use or it, from which on another steady rate is taken for the bias.
_CHANGE_PROBABILITY = 0.95


@dataclass
class _SteadyRate:
    """Samples at a steady rate, as one integral."""

    turn: RateIntegral
    end_time: float  # s
    step_count: int  # a single step does not tell whether its rate is steady
    is_possible: bool  # within the prior of the bias; else it is certainly a turn

    @property
    def is_candidate(self) -> bool:
        """Tell whether it may be that of a rest."""
        return self.step_count > 1 and self.is_possible


class SteadyRates:
    """Steady rates since the bias was unknown, and the ambiguity of the bias by them."""

    def __init__(self, covariance: Array):
        """Begin with the covariance of the calibration, shape (m, m)."""
        self._covariance = covariance
        self._first_row: Array | None = None  # sensitivity at the begin, shape (m,)
        self._ended = deque[_SteadyRate](maxlen=_MAX_RATES)
        self._last: _SteadyRate | None = None
        #: Mean square of the difference between the bias in use and the right one, beyond the
        #: variance of the state, (rad/s)².
        self.variance = 0.0
        #: Whether `variance` contains the present rates.
        self.is_current = True
        self._compared_duration = 0.0  # of the last rate, s

    def add(self, turn: RateIntegral, time: float, noise: Noise, sigmas: float,
            is_rest: bool) -> bool:
        """
        Add an integral, which ends at a time, s; tell whether the bias was unknown before.

        A rate that is off by so many standard deviations is another one.
        """
        rate, white = turn.angle / turn.duration, noise.angle_random_walk ** 2
        row = turn.sensitivity / turn.duration
        if self._first_row is None:
            self._first_row = row
        prior = float(row @ self._covariance @ row)
        last, freedom = self._last, turn.block_count - 1
        if prior < white:
            return False
        if (not is_rest and freedom > 0 and turn.block_square_sum - turn.angle * rate
                > white * chi_squared_quantile(freedom, 2.0 * float(ndtr(-sigmas)))):
            self.end()
            return True
        count = 1 + is_rest
        if last is not None and (rate - last.turn.angle / last.turn.duration) ** 2 < (
                sigmas ** 2 * white * (1.0 / turn.duration + 1.0 / last.turn.duration)):
            turn, count = last.turn + turn, last.step_count + count
        else:
            self.end()
        # of the whole: parts of one rate at the limit would confirm each other
        self._last = _SteadyRate(turn, time, count, turn.angle ** 2 < sigmas ** 2 * turn.duration
                                 * (prior * turn.duration + white))
        if self._last.is_candidate and not (
                is_rest and turn.duration < 2.0 * self._compared_duration):
            self.is_current = False
        return True

    def remove(self, turn: RateIntegral) -> None:
        """Remove the end of the last steady rate, which was no rest."""
        if self._last is not None:
            self._last.turn -= turn
            self._last.end_time -= turn.duration
            self.is_current = False
            if self._last.turn.duration < WINDOW_DURATION:
                self._last = None

    def end(self) -> None:
        """End the last steady rate."""
        if self._last is not None and self._last.is_candidate:
            self._ended.append(self._last)
            self.is_current = False
        self._last, self._compared_duration = None, 0.0

    def compare(self, state: HeadingState, sigmas: float) -> tuple[float, float] | None:
        """Update `variance`; return the change to a likelier bias, rad/s, and its variance."""
        rates = [*self._ended, *([self._last] if self._last and self._last.is_candidate else [])]
        noise, count = state.noise, len(rates)
        self.is_current = True
        self._compared_duration = self._last.turn.duration if self._last else 0.0
        white, floor = noise.angle_random_walk ** 2, noise.allan_floor ** 2
        durations = np.array([each.turn.duration for each in rates])
        ends = np.array([each.end_time for each in rates])
        rate = np.array([each.turn.angle for each in rates]) / durations
        first, covariance = self._first_row, self._covariance
        assert first is not None
        rows = np.reshape([each.turn.sensitivity for each in rates],
                          (count, len(first))) / durations[:, None]
        # variances of the prior, and of the difference of two rests, or of a rate and a place
        prior = ((rows @ covariance) * rows).sum(axis=1)
        widest = float(first @ covariance @ first)
        places = math.sqrt(widest) * _PLACES
        centres = np.vstack([rows, np.tile(first, (len(places), 1))])
        apart = rows[:, None] - centres
        same = white / durations[:, None] + ((apart @ covariance) * apart).sum(axis=2)
        same[:, count:] += _PLACE_VARIANCE * widest
        same[:, :count] += (white / durations + 2.0 * floor
                            + noise.rate_random_walk ** 2 * np.abs(ends[:, None] - ends))
        turned = np.unique(SCATTER_RATIOS[1:]) * white
        turned = turned[turned <= MAX_SCATTER_RATIO * widest]
        # log-likelihoods of each rate (row) as a rest or a turn by hypothesis (column): that
        # another rate is a rest, or a place of the prior at which there is none
        square, spread = (rate[:, None] - np.append(rate, places)) ** 2, same + turned[
            :, None, None]
        as_rest = np.log(_REST_PROBABILITY) - 0.5 * (square / same + np.log(same))
        as_rest[:, count:] = -np.inf
        as_turn = (np.log((1.0 - _REST_PROBABILITY) / len(turned))
                   - durations[:, None] / MEAN_LAGS[-1]
                   + logsumexp(-0.5 * (square / spread + np.log(spread)), axis=0))
        np.fill_diagonal(as_rest, np.log(_REST_PROBABILITY))
        np.fill_diagonal(as_turn, -np.inf)
        either = np.logaddexp(as_rest, as_turn)
        rests = np.exp(as_rest - either)
        # rests that agree are one hypothesis
        chances = softmax(
            np.append(-0.5 * (rate ** 2 / prior + np.log(prior)), _PLACE_WEIGHTS)
            + either.sum(axis=0) - np.log(np.maximum(rests.sum(axis=0), 1.0)))
        rests *= chances
        # less the bias in use, whose variance the state has
        used, known = state.rate_error(first)
        off = np.append(rate - state.wander_rate[0] + rows @ state.calibration_errors[0],
                        places - used)
        beyond = np.append(np.zeros(count), np.full(len(places), _PLACE_VARIANCE * widest - known))

        def variance(change: float, agreeing: Mask) -> float:
            squares = beyond + (off - change) ** 2
            squares[:count][agreeing] = 0.0
            return max(float(chances @ squares), 0.0)

        in_use = off[:count] ** 2 < sigmas ** 2 * np.diagonal(same)
        self.variance = variance(0.0, in_use)
        if not count:
            return None
        best = int(np.argmax(rests.sum(axis=1)))
        weights = rests[:, best] * durations
        change = float(weights @ off[:count] / weights.sum())
        agreeing = rests[:, best] > 0.5 * chances[best]
        likely, rival = chances[:count] @ np.array([agreeing, in_use & ~agreeing]).T
        after = variance(change, agreeing)
        if (in_use[best] or after > self.variance
                or likely < _CHANGE_PROBABILITY * (likely + rival)):
            return None
        self.variance = after
        return change, white * float(chances[best] / weights.sum()) + floor
