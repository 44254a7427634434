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
What the rates at which wheels stand tell about the bias.

A robot whose wheels stand is at rest, unless its floor turns (lift, turntable, ship), or it creeps
on or is pushed. A rate beyond the bias in use is the bias if the wheels stand at it for
`WHEEL_DELAY`, or twice with motion between; at first this may be that of another power-on. One
that begins suddenly after such a rest is a turn. Until this is decided, the rate is contained in
the uncertainty of the bias.
"""

from __future__ import annotations

import math

from gyro_calibration.heading.kalman import RateIntegral
from gyro_calibration.heading.stationary import scatters_as_noise
from gyro_calibration.heading.steady_rates import (
    CHANGE_PROBABILITY, TURN_ON_RATIOS, TURN_ON_SHARES)
from gyro_calibration.logs.log import DEGREE, NORMAL_QUANTILE_975
from gyro_calibration.model.noise import Noise
import numpy as np
from scipy.special import softmax

#: Largest delay of odometry after the begin of a turn, s.
WHEEL_DELAY = 4.0
#: Change of the bias that is assumed from one stop of the wheels to the next, rad/s; least time in
#: which it may come while they stand, s.
_BIAS_CHANGE, _CHANGE_DURATION = 0.2 * DEGREE, 16.0
#: Share of sudden changes of the rate while the wheels stand that are changes of the bias. A floor
#: that turns, or wheels that creep or are pushed, are assumed to be ten times more frequent.
_CHANGE_SHARE = 0.1


class StandingWheels:
    """The rates at which the wheels stand, and what is open about the bias by them."""

    def __init__(self, turn_on: float):
        """Begin with the usual standard deviation of the bias of other power-ons, rad/s."""
        self._turn_on = turn_on
        self.motion_time = 0.0  # last time when the wheels did not stand, s
        self.reset()

    def reset(self) -> None:
        """Begin with another calibration."""
        self.has_rested = False  # at the bias in use, or a rate that became it
        #: Deviation of the bias in use by a rate of which it is open if it is the bias, rad/s.
        self.ambiguity = 0.0
        #: When a rate began suddenly after a rest, until it is decided, s.
        self.sudden_time = -math.inf
        self._settled_time = -math.inf  # when the bias in use was last seen, or decided, s
        # Unexpected rates since the wheels moved last, rad/s, at this time, s; integral of the
        # longest rest since then, and of that of the standstill before.
        self._rates, self._since = list[float](), math.nan
        self._present = self._earlier = RateIntegral(0.0, 0.0, np.zeros(0))
        # Probability of another power-on, with this rest and before it; 0 once it is excluded.
        self._turn_on_probability = self._earlier_probability = 0.5

    @property
    def is_undecided(self) -> bool:
        """Tell whether it is open if a rate that began suddenly was a turn or a bias."""
        return self.sudden_time > -math.inf

    @property
    def is_turned(self) -> bool:
        """Tell whether the wheels have not moved since a rate began suddenly."""
        return self.motion_time < self.sudden_time

    def has_settled(self, duration: float) -> bool:
        """Tell whether the bias in use was seen in this standstill, with s of rest at last."""
        return self.motion_time < self._settled_time or duration >= WHEEL_DELAY

    def begin_sudden_rate(self, time: float) -> None:
        """Begin a turn with a rate that may be a change of the bias, s."""
        if not self.is_turned:
            self.sudden_time = self._settled_time = time

    def end_sudden_rate(self, time: float) -> None:
        """End what began with a sudden rate, s, as the bias is known again."""
        self.sudden_time, self.ambiguity, self._settled_time = -math.inf, 0.0, time

    def add_rate(self, turn: RateIntegral, is_expected: bool, noise: Noise, sigmas: float) -> bool:
        """
        Add a rate at which the wheels stand; tell whether they stood so before, and moved since.

        An unexpected one is open until the bias is known, as is one that began suddenly, up to so
        many standard deviations of a usual change of the bias.
        """
        if self._since != self.motion_time:
            if self._present.duration:
                self._earlier = self._present
            self._rates, self._since = [], self.motion_time
            self._present = RateIntegral(0.0, 0.0, np.zeros(0))
        self._keep(turn)
        if is_expected:
            self._rates = []
            return False
        # after wheels have stopped a body may creep on for a second, or be pushed
        self._rates.append(turn.angle / turn.duration)
        if not self.has_rested or self.is_turned:
            rate = abs(float(np.median(self._rates)))
            self.ambiguity = rate if not self.is_turned else (
                math.sqrt(_CHANGE_SHARE) * rate * (rate < sigmas * _BIAS_CHANGE))
        return self._repeats(turn, noise)

    def _keep(self, turn: RateIntegral) -> None:
        """Keep an integral at rest as that of this standstill, if none is longer."""
        if turn.duration >= self._present.duration:
            self._present = turn

    def _repeats(self, turn: RateIntegral, noise: Noise) -> bool:
        """Tell whether the last standstill had the same rate, as far as white noise shows."""
        one, other = self._earlier, turn
        if not one.duration or not all(  # a body may sway
                scatters_as_noise(each, noise, 1.0 - CHANGE_PROBABILITY) for each in (one, other)):
            return False
        return (one.angle / one.duration - other.angle / other.duration) ** 2 < (
            NORMAL_QUANTILE_975 ** 2 * (noise.rate_variance(one.duration)
                                        + noise.rate_variance(other.duration)))

    def largest_change(self, repeats: bool) -> float:
        """Return the change of the bias, rad/s, that a rate may show that repeats, or does not."""
        if repeats:
            return math.sqrt(TURN_ON_RATIOS[-1]) * self._turn_on
        return 0.0 if self.is_turned else _BIAS_CHANGE

    def lasts(self, time: float) -> bool:
        """Tell whether the wheels stand since so long that a rate is no turn that begins, s."""
        return not self.is_turned and time - self.motion_time >= WHEEL_DELAY

    def is_sudden(self, change: float, lag: float, duration: float) -> bool:
        """Tell whether a rate, rad/s, over `lag` s after a rest, s, is no change of the bias."""
        # a bias changes slowly; of a standstill that began with it this is not known
        return self.has_settled(duration) and abs(change) > (
            _BIAS_CHANGE * max(lag, WHEEL_DELAY) / _CHANGE_DURATION)

    def is_first_bias(self, repeats: bool, lasts: bool, turn: RateIntegral, noise: Noise) -> bool:
        """Tell whether a rate is the bias of another power-on, as none was known before."""
        return self._turn_on_probability > CHANGE_PROBABILITY or not self.has_rested and (
            repeats or lasts and (turn.angle / turn.duration - float(np.median(self._rates))) ** 2
            < 2.0 * NORMAL_QUANTILE_975 ** 2 * noise.rate_variance(turn.duration))

    def adopt_power_on(self, difference: float, time: float) -> float:
        """Expect no further power-on, now, s; return the variance of a bias off by rad/s."""
        # short rests may have been turns
        self._turn_on_probability = (
            0.0 if time - self.motion_time >= WHEEL_DELAY else 1.0 - CHANGE_PROBABILITY)
        self.has_rested = True
        return max(difference ** 2, self._turn_on ** 2)

    def end_rest(self, turn: RateIntegral) -> None:
        """Keep the integral of a rest, and what was known of the power-on at its end."""
        self._earlier_probability = self._turn_on_probability
        self._keep(turn)

    def shows_other_power_on(self, turn: RateIntegral, noise: Noise, difference: float,
                             variance: float) -> bool:
        """
        Tell whether a rest, off by rad/s with a variance, shows the bias of another power-on.

        One of `WHEEL_DELAY` does alone; shorter ones, in which a body may creep on, if two in
        succession have the same rate.
        """
        # it is excluded, or the bias in use was seen before
        if (not self._turn_on_probability or self.motion_time < self._settled_time
                or self.is_undecided
                or turn.duration < WHEEL_DELAY and not self._repeats(turn, noise)):
            return False
        # of the calibration, and of other power-ons, which together are as probable
        variances = variance + self._turn_on ** 2 * np.append(0.0, TURN_ON_RATIOS)
        chances = softmax(-0.5 * (difference ** 2 / variances + np.log(variances)) + np.log(
            np.append(1.0 - self._earlier_probability,
                      self._earlier_probability * TURN_ON_SHARES)))
        self._turn_on_probability = float(chances[1:].sum())
        if self._turn_on_probability < (1.0 - CHANGE_PROBABILITY) ** 2:
            self._turn_on_probability = 0.0
        return self._turn_on_probability > CHANGE_PROBABILITY
