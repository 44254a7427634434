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
bias. If it is, each other one is a rest too, which agrees with it, or a turn, with the prior odds
of a rest and a straight drive. Their product is the probability of each. The bias in use is that
of the first rest; the uncertainty of the heading contains all others, and the bias is changed when
one of them is more probable than 95 %. Under another bias the rests until then were turns: the
heading changes by the difference times the time since its begin.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from gyro_calibration.heading.kalman import HeadingState, RateIntegral
from gyro_calibration.heading.stationary import (
    chi_squared_quantile, MAX_SCATTER_RATIO, MEAN_LAGS, PRIOR_COUNTS, SCATTER_RATIOS,
    WINDOW_DURATION)
from gyro_calibration.logs.log import Array
from gyro_calibration.model.noise import Noise
import numpy as np
from scipy.special import logsumexp, ndtr, softmax

#: Steady rates in memory.
_MAX_RATES = 20
#: Prior probability that a steady rate is that of a rest.
_REST_PROBABILITY = PRIOR_COUNTS[0] / (PRIOR_COUNTS[0] + 1.0)
#: Probability from which on another steady rate is taken for the bias.
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
        self._ended = deque[_SteadyRate](maxlen=_MAX_RATES)
        self._last: _SteadyRate | None = None
        #: Mean square of the difference between the bias in use and the right one, (rad/s)².
        self.variance = 0.0

    def add(self, turn: RateIntegral, time: float, noise: Noise, sigmas: float,
            is_rest: bool) -> bool:
        """
        Add an integral, which ends at a time, s; tell whether its rate is known to be steady.

        A rate that is off by so many standard deviations is another one.
        """
        rate, white = turn.angle / turn.duration, noise.angle_random_walk ** 2
        row = turn.sensitivity / turn.duration
        prior = float(row @ self._covariance @ row)
        last, freedom = self._last, turn.block_count - 1
        if (prior < white
                or not is_rest and freedom > 0 and turn.block_square_sum - turn.angle * rate
                > white * chi_squared_quantile(freedom, 2.0 * float(ndtr(-sigmas)))):
            self.end()
            return False
        count = 1 + is_rest
        if last is not None and (rate - last.turn.angle / last.turn.duration) ** 2 < (
                sigmas ** 2 * white * (1.0 / turn.duration + 1.0 / last.turn.duration)):
            turn, count = last.turn + turn, last.step_count + count
        else:
            self.end()
        # of the whole: parts of one rate at the limit would confirm each other
        self._last = _SteadyRate(turn, time, count, turn.angle ** 2 < sigmas ** 2 * turn.duration
                                 * (prior * turn.duration + white))
        return self._last.is_candidate

    def remove(self, turn: RateIntegral) -> None:
        """Remove the end of the last steady rate, which was no rest."""
        if self._last is not None:
            self._last.turn -= turn
            self._last.end_time -= turn.duration
            if self._last.turn.duration < WINDOW_DURATION:
                self._last = None

    def end(self) -> None:
        """End the last steady rate."""
        if self._last is not None and self._last.is_candidate:
            self._ended.append(self._last)
        self._last = None

    def compare(self, state: HeadingState, sigmas: float) -> tuple[float, float] | None:
        """Update `variance`; return the change to a likelier bias, rad/s, and its variance."""
        rates = [*self._ended, *([self._last] if self._last and self._last.is_candidate else [])]
        noise, count = state.noise, len(rates)
        if count < 2:
            return None
        white, floor = noise.angle_random_walk ** 2, noise.allan_floor ** 2
        durations, ends = np.array([(each.turn.duration, each.end_time) for each in rates]).T
        rows = np.array([each.turn.sensitivity for each in rates]) / durations[:, None]
        rate = np.array([each.turn.angle for each in rates]) / durations
        # less the bias in use
        off = rate - state.wander_rate[0] + rows @ state.calibration_errors[0]
        # variances of the prior, and of the difference of two rests
        prior = ((rows @ self._covariance) * rows).sum(axis=1)
        apart = rows[:, None] - rows
        same = (white * (1.0 / durations[:, None] + 1.0 / durations) + 2.0 * floor
                + noise.rate_random_walk ** 2 * np.abs(ends[:, None] - ends)
                + ((apart @ self._covariance) * apart).sum(axis=2))
        turned = np.unique(SCATTER_RATIOS[1:]) * white
        turned = turned[turned <= MAX_SCATTER_RATIO * prior.max()]
        square = (rate[:, None] - rate) ** 2
        as_rest = np.log(_REST_PROBABILITY) - 0.5 * (square / same + np.log(same))
        spread = same + turned[:, None, None]
        as_turn = (np.log((1.0 - _REST_PROBABILITY) / len(turned))
                   - durations[:, None] / MEAN_LAGS[-1]
                   + logsumexp(-0.5 * (square / spread + np.log(spread)), axis=0))
        either = np.logaddexp(as_rest, as_turn)
        np.fill_diagonal(either, 0.0)
        np.fill_diagonal(as_rest, 0.0)
        agrees = np.exp(as_rest - either)  # of each (row) if another (column) is a rest
        chances = softmax(-0.5 * (rate ** 2 / prior + np.log(prior)) + either.sum(axis=0)
                          - np.log(agrees.sum(axis=0)))
        in_use = off ** 2 < sigmas ** 2 * np.diagonal(same)
        if not in_use.any():
            return None
        together = chances @ agrees
        best = int(np.argmax(together))
        if in_use[best] or together[best] < _CHANGE_PROBABILITY:
            self.variance = float(chances @ np.where(in_use, 0.0, off ** 2))
            return None
        weights = agrees[:, best] * durations
        change = float(weights @ off / weights.sum())
        self.variance = float(chances @ np.where(agrees[:, best] > 0.5, 0.0, (off - change) ** 2))
        return change, white / float(weights.sum()) + floor
