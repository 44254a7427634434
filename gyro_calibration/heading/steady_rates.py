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
Steady rates, of which each is that of a rest or of a straight way that bends.

To a gyro alone, a rest and a turn at a constant rate differ by the rate only. While the prior of
the bias is wider than a rest of 1 s measures it, each steady rate within this prior may be the
bias. If it is, each other one is a rest too, which agrees with it, or a turn, with the prior odds
of a rest and a straight drive. Their product is the probability of each. Equal rates without a
turn between them are one. The bias in use is that of the first rest; the uncertainty of the
heading contains all others, and the bias is changed when one of them is more probable than 95 %.
Under another bias the rests until then were turns: the heading changes by the difference times the
time since its begin.

A calibration is one more rest before the others, if the bias is still that of its power-on, which
is as probable as another one. One power-on in ten has five times the usual scatter, as without a
calibration; such a bias counts where no steady rate is near the usual ones. Without rests, all
steady rates are bends and the calibration holds.

With a known bias, either some of the steady rates near it are rests, or the vehicle never rests. A
bend has a rate of normal distribution and an exponential duration, and a rest may last. The share
of rests, the size of the bends and the mean durations are estimated from all steady rates of the
drive. Without rests, each of them measures the bias with the variance of the bends. The
heading is the mean of both hypotheses, and its variance contains both.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
import math

from gyro_calibration.heading.integration import TIME_TOLERANCE
from gyro_calibration.heading.kalman import HEADING_INDEX, HeadingState, RateIntegral
from gyro_calibration.heading.stationary import (
    MAX_SCATTER_RATIO, MEAN_LAGS, PRIOR_COUNTS, SCATTER_RATIOS, scatters_as_noise,
    WINDOW_DURATION)
from gyro_calibration.logs.log import Array
from gyro_calibration.model.noise import Noise
import numpy as np
from scipy.special import logsumexp, ndtr, softmax

#: Steady rates in memory.
_MAX_RATES = 20
#: Prior probability that a steady rate is that of a rest.
_REST_PROBABILITY = PRIOR_COUNTS[0] / (PRIOR_COUNTS[0] + 1.0)
#: Variances of the rates of bends, relative to that of white noise over 1 s.
_BENDS = np.unique(SCATTER_RATIOS[1:])
#: Shares of rests among steady rates near the bias, all of which are as probable.
_REST_SHARES = (np.arange(5) + 0.5) / 5.0
#: Logarithms of the prior probabilities: first that the vehicle never rests, which is as probable
#: as that it does, by size of bends, then by share of rests (row) and size of bends (column).
_LOG_PRIORS = np.log(np.outer([0.5, *np.full(len(_REST_SHARES), 0.5 / len(_REST_SHARES))],
                              np.full(len(_BENDS), 1.0 / len(_BENDS))))
#: Variances of the bias of another power-on, relative to the usual one, and their shares.
TURN_ON_RATIOS, TURN_ON_SHARES = np.array([1.0, 25.0]), np.array([0.9, 0.1])
#: Probability below which it is not computed what follows if the vehicle never rests.
_NEGLIGIBLE = 1e-6
#: Probability from which on another steady rate is taken for the bias.
CHANGE_PROBABILITY = 0.95


@dataclass
class _SteadyRate:
    """Samples at a steady rate, as one integral."""

    turn: RateIntegral
    end_time: float  # s
    step_count: int  # a single step does not tell whether its rate is steady
    is_possible: bool  # within the prior of the bias; else it is certainly a turn
    is_usual: bool  # within that of the usual scatter of power-ons
    way: int  # number of the way without a turn, on which equal rates are one
    #: Mean, rad/s, and variance of the error of the rate before it, with rests and without.
    errors: tuple[float, float, float, float]

    @property
    def is_candidate(self) -> bool:
        """Tell whether it may be that of a rest."""
        return (self.step_count > 1 and self.is_possible
                and self.turn.duration > 2.0 * MEAN_LAGS[0] - TIME_TOLERANCE)


class SteadyRates:
    """Steady rates, the ambiguity of the bias by them, and the state if there was no rest."""

    def __init__(self, state: HeadingState, covariance: Array, turn_on: float):
        """
        Begin with a state and the covariance of the calibration, shape (m, m).

        It holds, or the bias is that of another power-on, with this standard deviation, rad/s;
        both are as probable.
        """
        self._covariance, self._turn_on_variance = covariance, turn_on ** 2
        self._ended = list[_SteadyRate]()
        self._last: _SteadyRate | None = None
        self._way, self._way_rate, self._begin_time = 0, math.inf, math.inf
        self._is_calibrated = self.is_changing = self._has_changed = False
        self._agreement = 0.0  # largest square of the difference of rates over 1 s, (rad/s)²
        #: Mean square of the difference between the bias in use and the right one, (rad/s)².
        self.variance = 0.0
        #: Probability that the vehicle never rests; 0 with an unknown bias.
        self.moving_probability = self._ended_probability = 0.0
        self._log_weights: Array | None = None  # as `_LOG_PRIORS`; None until the bias is known
        self._evaluated_duration = 0.0  # of the last rate, s
        self._repeats = False  # whether the next integral was added before
        # numbers of bends and rests, and their total durations, s
        self._counts, self._durations = np.ones(2), np.full(2, MEAN_LAGS[-1])
        self.restart(state)

    def restart(self, moving: HeadingState) -> None:
        """Continue with another state for the case that there was no rest."""
        self._moving, self._since = moving, RateIntegral(
            0.0, 0.0, np.zeros(len(self._covariance)))

    def moving_state(self, noise: Noise) -> HeadingState:
        """Return the state now if there was no rest."""
        return replace(self._moving, noise=noise).propagate(self._since)

    def add(self, turn: RateIntegral, still: RateIntegral, time: float, before: HeadingState,
            sigmas: float, is_rest: bool) -> bool:
        """
        Add an integral, which ends at a time, s; tell whether it may be an unknown bias.

        It is given with its sensitivity and with that of a rest, and the state before it. A rate
        that is off by so many standard deviations is another one.
        """
        rate, white = still.angle / still.duration, before.noise.angle_random_walk ** 2
        row = still.sensitivity / still.duration
        prior = float(row @ self._covariance @ row)
        if self._log_weights is None and prior < white:
            self._log_weights = _LOG_PRIORS
            self.moving_probability = self._ended_probability = float(
                np.exp(_LOG_PRIORS[0]).sum())
        # else the prior contains the scatter of power-ons
        self._is_calibrated = prior < 0.5 * self._turn_on_variance
        usual, widest = (prior + self._is_calibrated * self._turn_on_variance
                         * TURN_ON_RATIOS).tolist()
        is_possible = rate ** 2 < sigmas ** 2 * (widest + white / still.duration)
        self._agreement, self._begin_time = sigmas ** 2 * white, min(
            self._begin_time, time - turn.duration)
        # a turn is beyond what a bias may differ by, from that of the last steady rate
        before_it = self._way_rate if self._is_calibrated and self._way_rate < math.inf else 0.0
        self._way += (rate - before_it) ** 2 >= sigmas ** 2 * (usual + white / still.duration)
        last = self._last
        is_steady = is_rest or scatters_as_noise(
            still, before.noise, 2.0 * float(ndtr(-sigmas)))
        if is_steady and last is not None and self._agree(last.turn, still):
            still, count, errors = last.turn + still, last.step_count + 1 + is_rest, last.errors
        else:
            self.end(before.noise)
            count = 1 + is_rest
            errors = (*before.rate_error(row), *self.moving_state(before.noise).rate_error(row)
                      ) if is_steady else (0.0, 0.0, 0.0, 0.0)
        if not self._repeats:
            self._since += turn
        self._repeats = False
        if not is_steady:
            return False
        # of the whole: parts of one rate at the limit would confirm each other
        rate = still.angle / still.duration
        is_possible = rate ** 2 < sigmas ** 2 * (widest + white / still.duration)
        if count > 1 and is_possible:
            self._way += (rate - self._way_rate) ** 2 > MAX_SCATTER_RATIO * white
            self._way_rate = rate
        is_usual = rate ** 2 < sigmas ** 2 * (usual + white / still.duration)
        self._last = _SteadyRate(still, time, count, is_possible, is_usual, self._way, errors)
        is_due = count > 1 and still.duration >= 2.0 * self._evaluated_duration
        if is_due:
            self._evaluate(before.noise)
        return self._last.is_candidate and (
            self.is_changing or is_due if self._is_calibrated else self._log_weights is None)

    def _agree(self, one: RateIntegral, other: RateIntegral) -> bool:
        return (one.angle / one.duration - other.angle / other.duration) ** 2 < (
            self._agreement * (1.0 / one.duration + 1.0 / other.duration))

    def _evaluate(self, noise: Noise, has_ended: bool = False) -> None:
        """Update the probability that the vehicle never rests with the last rate."""
        if self._last is None or self._last.step_count < 2 or self._log_weights is None:
            return
        turn, (error, variance, moving_error, moving_variance) = self._last.turn, self._last.errors
        white, duration = noise.angle_random_walk ** 2, turn.duration
        rate = turn.angle / duration
        # of faster ones it is known that they are turns
        fastest = math.sqrt(MAX_SCATTER_RATIO * max(white, variance))
        self._evaluated_duration = duration
        if not abs(rate - error) < fastest:
            return

        # logarithms of normal densities among rates below the fastest: of bends without rests and
        # with them, by size, and of a rest
        bends = _BENDS * white
        mean = np.repeat([moving_error, error], [len(bends), len(bends) + 1])
        size = np.sqrt(np.concatenate([moving_variance + bends, variance + bends, [variance]])
                       + white / duration)
        slower = ndtr((error + fastest - mean) / size) - ndtr((error - fastest - mean) / size)
        densities = -0.5 * ((rate - mean) / size) ** 2 - np.log(
            size * np.maximum(slower, np.finfo(float).tiny))
        ratios = duration * self._counts / self._durations  # a rest may last, a way may not
        as_bend = densities[:-1].reshape(2, -1) - ratios[0]
        as_rest = densities[-1] - np.log1p(ratios[1]) + np.log(_REST_SHARES)[:, None]
        either = np.vstack([as_bend[0], np.logaddexp(
            as_bend[1] + np.log1p(-_REST_SHARES)[:, None], as_rest)])
        weights = self._log_weights + either
        weights -= weights.max()
        chances = np.exp(weights)
        chances /= chances.sum()
        self.moving_probability = float(chances[0].sum())
        if has_ended:
            self._log_weights, self._ended_probability = weights, self.moving_probability
            rests = float((chances[1:] * np.exp(as_rest - either[1:])).sum())
            self._counts = self._counts + [1.0 - rests, rests]
            self._durations = self._durations + duration * np.array([1.0 - rests, rests])
            if self.moving_probability > _NEGLIGIBLE and (
                    duration < self._since.duration + TIME_TOLERANCE):
                self._since -= turn
                bent = np.array([bends * duration ** 2, chances[0] / chances[0].sum()])
                self.restart(self.moving_state(noise).advance_at_rest(replace(turn, wander=bent)))

    def adopt(self, state: HeadingState, variance: float) -> None:
        """Continue with the state after a change of the bias, and with `variance` after it."""
        self.restart(state)
        self.variance = variance
        self.is_changing, self._has_changed = False, True
        if self._log_weights is not None:
            self._log_weights = _LOG_PRIORS.copy()
            self._log_weights[0] += math.log(1.0 / CHANGE_PROBABILITY - 1.0)
            self.moving_probability = self._ended_probability = 1.0 - CHANGE_PROBABILITY

    def moving_heading(self, noise: Noise) -> tuple[float, float]:
        """Return the heading now if there was no rest, rad, and its variance, rad²."""
        return replace(self._moving, noise=noise).heading(self._since)

    def heading_shift(self, state: HeadingState, moving: tuple[float, float] | None = None
                      ) -> tuple[float, float]:
        """Return the way from a heading to the mean, rad, and the change of variance, rad²."""
        chance = self.moving_probability
        if chance < _NEGLIGIBLE:
            return 0.0, 0.0
        heading, variance = moving or self.moving_heading(state.noise)
        off = heading - float(state.mean[HEADING_INDEX])
        return chance * off, chance * ((1.0 - chance) * off ** 2 + variance - float(
            state.covariance[HEADING_INDEX, HEADING_INDEX]))

    def remove(self, turn: RateIntegral) -> None:
        """Remove the end of the last steady rate, which was no rest and is added again."""
        self._repeats = turn.duration > TIME_TOLERANCE
        if self._last is not None:
            self._last.turn -= turn
            self._last.end_time -= turn.duration
            if self._last.turn.duration < WINDOW_DURATION:
                self._last = None

    def end(self, noise: Noise) -> None:
        """End the last steady rate."""
        self._evaluate(noise, has_ended=True)
        self.moving_probability = self._ended_probability
        self._ended = self._candidates()
        if len(self._ended) > _MAX_RATES:
            self._ended.remove(min(self._ended, key=lambda each: (
                each.is_usual or self._has_changed, each.turn.duration)))
        self._last, self._evaluated_duration = None, 0.0

    def _candidates(self) -> list[_SteadyRate]:
        """Return the rates that may be the bias, of which equal ones on one way are one."""
        last, found = self._last, self._ended
        if last is None or not last.is_candidate:
            return found
        for place, each in enumerate(found):
            if each.way == last.way and self._agree(each.turn, last.turn):
                return [*found[:place], *found[place + 1:],
                        replace(last, turn=each.turn + last.turn)]
        return [*found, last]

    def compare(self, state: HeadingState, sigmas: float) -> tuple[float, float, float] | None:
        """
        Update `variance`; return the change to a likelier bias, or None.

        The change, rad/s, is that for `adopt`, with its variance and the value of `variance` after
        it, (rad/s)².
        """
        rates, noise, is_known = self._candidates(), state.noise, self._is_calibrated
        self.is_changing = False
        # another power-on with an unusual bias has no rest at a usual one
        if is_known and not self._has_changed:
            rates = [each for each in rates if each.is_usual] or rates
        if len(rates) + is_known < 2 or not rates:
            return None
        white, floor = noise.angle_random_walk ** 2, noise.allan_floor ** 2
        durations, ends = np.array([(each.turn.duration, each.end_time) for each in rates]).T
        rows = np.array([each.turn.sensitivity for each in rates]) / durations[:, None]
        rate = np.array([each.turn.angle for each in rates]) / durations
        # variances of the prior
        prior = ((rows @ self._covariance) * rows).sum(axis=1)
        lasting = durations
        if is_known:
            # a calibration is one more rest before the others, as long as it is certain, and not
            # refuted by a single turn, however long
            rate, rows = np.append(rate, 0.0), np.append(rows, rows[-1:], axis=0)
            lasting = np.minimum(np.append(durations, 0.0), MEAN_LAGS[-1])
            durations = np.append(durations, white / max(prior[-1], np.finfo(float).tiny))
            ends, prior = np.append(ends, self._begin_time), np.append(prior, prior[-1])
        # less the bias in use
        off = rate - state.wander_rate[0] + rows @ state.calibration_errors[0]
        # variances of the difference of two rests
        apart = rows[:, None] - rows
        same = (white * (1.0 / durations[:, None] + 1.0 / durations) + 2.0 * floor
                + noise.rate_random_walk ** 2 * np.abs(ends[:, None] - ends)
                + ((apart @ self._covariance) * apart).sum(axis=2))
        turn_on = self._turn_on_variance * (TURN_ON_RATIOS if is_known else np.zeros(1))
        agrees, chances = _compare_rests(rate, prior + turn_on[:, None], same, lasting, white,
                                         is_known)
        # the rate whose bias is in use: first that of the calibration
        used = int(np.argmin(np.abs(off))) if self._has_changed or not is_known else len(rates)
        if used < len(rates) and off[used] ** 2 > sigmas ** 2 * same[used, used]:
            return None
        in_use = agrees[:, used] > 0.5
        together = chances @ agrees
        best = int(np.argmax(together))
        self.variance = float(chances @ np.where(in_use, 0.0, off ** 2))
        if is_known:
            # the calibration is one more reason, as good as that by which a bias is changed: it
            # holds, is given up, or neither is decided
            least, held = (1.0 - CHANGE_PROBABILITY) ** 2, float(chances[in_use].sum())
            self.variance *= held < 1.0 - least
            if held > least:
                return None
        if in_use[best] or together[best] < CHANGE_PROBABILITY:
            return None
        self.is_changing = is_known
        weights = np.where(agrees[:, best] > 0.5, agrees[:, best] * durations, 0.0)
        change = float(weights @ off / weights.sum())
        return (change, white / float(weights.sum()) + floor,
                float(chances @ np.where(weights > 0.0, 0.0, (off - change) ** 2)))


def _compare_rests(rate: Array, prior: Array, same: Array, lasting: Array, white: float,
                   is_known: bool) -> tuple[Array, Array]:
    """
    Return the probabilities that rates are rests if another is one, and that each is the bias.

    Of k rates, rad/s, given are the variances of their prior for each scatter of power-ons, shape
    (j, k), and of the difference of two rests, (k, k), (rad/s)², their durations, s, and the
    variance of white noise over 1 s. The last may be that of a calibration. The results have the
    shapes (k, k), with the other rate by column, and (k,).
    """
    # of turns as slow as bends, and as fast as the bias may be
    levels = math.floor(math.log(MAX_SCATTER_RATIO * prior.max() / white, 4.0)) + 1
    turned, count = white * 4.0 ** np.arange(max(levels, 1)), len(rate)
    square = (rate[:, None] - rate) ** 2
    as_rest = np.log(_REST_PROBABILITY) - 0.5 * (square / same + np.log(same))
    spread = same + turned[:, None, None]
    turns = (-0.5 * (square / spread + np.log(spread)) - np.log(len(turned))
             - lasting[:, None] / MEAN_LAGS[-1])
    as_turn = np.log(1.0 - _REST_PROBABILITY) + logsumexp(turns, axis=0)
    shares = TURN_ON_SHARES if is_known else np.ones(1)
    assumed = logsumexp(-0.5 * (rate ** 2 / prior + np.log(prior)), axis=0, b=shares[:, None])
    never = -math.inf
    own = np.log(_REST_PROBABILITY) * np.ones(count)
    if is_known:
        # without rests, all others are turns of one size
        never = float(logsumexp(turns[:, :-1, -1].sum(axis=1) + (
            count - 2) * np.log(len(turned))))
        own[-1] = np.log(0.5)
        as_rest[-1] += np.log(0.5 / _REST_PROBABILITY)
        as_turn[-1], assumed = np.log(0.5) + assumed, np.zeros(count)
    either = np.logaddexp(as_rest, as_turn)
    np.fill_diagonal(either, own)
    np.fill_diagonal(as_rest, own)
    agrees = np.exp(as_rest - either)
    chances = softmax(np.append(
        assumed + either.sum(axis=0) - np.log(agrees.sum(axis=0)), never))
    unrested, chances = float(chances[-1]), chances[:-1]
    chances[-1] += unrested  # and with the bias of the calibration
    return agrees, chances
