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
Kalman filter of a heading, of the errors of calibrated values, and of the wander of the bias.

The state is the heading, the rate random walk w, the components f of the flicker noise, and the
errors e of the values of the calibration. In motion, the heading changes by the integral of the
compensated rate, less the part that the state explains::

    turned = true turn + T w + sum of tau (1 - exp(-T / tau)) f - sensitivity e + white noise

At rest the true turn is zero, and the same equation is a measurement (d of Hong and Park, eq. 11,
with the noise figures of the model). It determines the bias, and through the correlation with the
heading also the earlier error of the heading.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache

from gyro_calibration.logs.log import Array
from gyro_calibration.model.noise import averaged_process_moments, BIAS_AVERAGING_TIME, Noise
import numpy as np
from scipy.linalg import pinvh

#: Indices of heading, random walk and first flicker component in the state.
HEADING_INDEX, WALK_INDEX, _FLICKER_INDEX = range(3)


#: Possible variances of the rotation in a rest, rad², and their probabilities: it is none.
STANDSTILL = np.array([[0.0], [1.0]])


@dataclass(slots=True)
class RateIntegral:
    """Integral of the rates over some time."""

    duration: float  # s
    angle: float  # integral of the compensated rate, rad
    sensitivity: Array  # integral of that of the rate to the calibration, shape (m,)
    lost_variance: float = 0.0  # of rotation that was not measured, rad²
    extra_noise_variance: float = 0.0  # additional variance of the noise by lost samples, rad²
    #: Of a rest that may be a straight drive: possible variances of its rotation, rad², and their
    #: probabilities, shape (2, k).
    wander: Array = field(default_factory=lambda: STANDSTILL)
    block_count: int = 0
    block_square_sum: float = 0.0  # of the angles of blocks, over their durations, rad²/s
    #: There were no rates: the heading is constant, and errors of rates do not affect it; not to
    #: be added to others.
    is_unobserved: bool = False

    def __add__(self, other: RateIntegral, sign: int = 1) -> RateIntegral:
        """Return the integral over both, one after the other."""
        return RateIntegral(
            self.duration + sign * other.duration, self.angle + sign * other.angle,
            self.sensitivity + sign * other.sensitivity,
            self.lost_variance + sign * other.lost_variance,
            self.extra_noise_variance + sign * other.extra_noise_variance, STANDSTILL,
            self.block_count + sign * other.block_count,
            self.block_square_sum + sign * other.block_square_sum)

    def __sub__(self, other: RateIntegral) -> RateIntegral:
        """Return the rest of this integral after another with which it begins."""
        return self.__add__(other, -1)


@dataclass(frozen=True)
class _Transition:
    """Transition of the state over some time, without the rotation itself."""

    observation: Array  # of each component in the integral of the compensated rate, shape (n,)
    retention: Array  # decay factor of each component, shape (n,)
    #: Covariance, shape (n, n); first row and column: of the integral of the rate, negated.
    process_noise: Array

    @property
    def matrix(self) -> Array:
        """Return that of the state in motion, shape (n, n)."""
        matrix = np.diag(self.retention)
        matrix[HEADING_INDEX] -= self.observation
        return matrix


@dataclass(frozen=True)
class HeadingState:
    """Mean and covariance of the state."""

    noise: Noise
    mean: Array  # shape (n,), where n = 2 + parts of the flicker + values of the calibration
    covariance: Array  # shape (n, n)

    @property
    def first_value_index(self) -> int:
        """Return the index of the first value of the calibration in the state."""
        return _FLICKER_INDEX + len(self.noise.flicker_processes()[0])

    def transition(self, rate_integral: RateIntegral) -> _Transition:
        """Return the transition of the state over an integral of rates."""
        seen, kept, grown, variance = self._observation(rate_integral)
        grown = grown.copy()
        grown[HEADING_INDEX, HEADING_INDEX] = variance
        return _Transition(seen, kept, grown)

    def _observation(self, rate_integral: RateIntegral) -> tuple[Array, Array, Array, float]:
        """Return `_Transition` as arrays, and the variance of the noise of an integral, rad²."""
        values = len(rate_integral.sensitivity)
        seen, kept, grown = _padded_transition(
            self.noise, round(rate_integral.duration, 6), rate_integral.is_unobserved, values)
        seen = seen.copy()
        seen[len(seen) - values:] = -rate_integral.sensitivity
        variance = (float(grown[HEADING_INDEX, HEADING_INDEX]) + rate_integral.lost_variance
                    + rate_integral.extra_noise_variance)
        if not rate_integral.is_unobserved:
            variance += self.noise.angle_random_walk ** 2 * rate_integral.duration
        return seen, kept, grown, variance

    def propagate(self, rate_integral: RateIntegral) -> HeadingState:
        """Return the state after a time in motion."""
        step = self.transition(rate_integral)
        matrix = step.matrix
        mean = matrix @ self.mean
        mean[HEADING_INDEX] += rate_integral.angle
        return HeadingState(self.noise, mean,
                            matrix @ self.covariance @ matrix.T + step.process_noise)

    def heading(self, rate_integral: RateIntegral) -> tuple[float, float]:
        """Return the heading after a time in motion, rad, and its variance, rad²."""
        seen, _, _, variance = self._observation(rate_integral)
        seen[HEADING_INDEX] -= 1.0
        return (rate_integral.angle - float(seen @ self.mean),
                float(seen @ self.covariance @ seen) + variance)

    def advance_at_rest(self, rate_integral: RateIntegral) -> HeadingState:
        """Return the state after a time of constant heading, with its measurement."""
        return self.measure_rest(rate_integral)[1]

    def measure_rest(self, rate_integral: RateIntegral
                     ) -> tuple[HeadingState, HeadingState, Array]:
        """Return the states before and after a rest given its measurement, and a covariance."""
        # The covariance is that of the state before with that after, (n, n). The measured mean
        # has the wander of the bias meanwhile in it, with which the bias at the end correlates. A
        # rotation by `wander` is in the measurement and in the heading, which is that at the end.
        # Mean and covariance are those of the mixture: the gain of each variance is a sum of two
        # directions, that of the state and the heading.
        step = self.transition(rate_integral)
        grown, (wander, chances) = step.process_noise, rate_integral.wander
        before = self.covariance @ step.observation
        variance = float(step.observation @ before + grown[HEADING_INDEX, HEADING_INDEX]) + wander
        innovation = rate_integral.angle - float(step.observation @ self.mean)
        after = np.zeros((2, len(before)))
        after[0] = step.retention * before - grown[HEADING_INDEX]
        after[0, HEADING_INDEX], after[1, HEADING_INDEX] = before[HEADING_INDEX], 1.0
        grown[HEADING_INDEX] = grown[:, HEADING_INDEX] = 0.0
        grown[HEADING_INDEX, HEADING_INDEX] = rate_integral.lost_variance + chances @ wander
        gains = np.array([np.ones(len(wander)), wander]) / variance
        gain = gains @ chances
        change = ((gains * (chances * (innovation ** 2 - variance))) @ gains.T
                  - innovation ** 2 * gain[:, None] * gain)
        kept = self.covariance * step.retention
        return (HeadingState(self.noise, self.mean + before * (gain[0] * innovation),
                             self.covariance + before[:, None] * before * change[0, 0]),
                HeadingState(self.noise, step.retention * self.mean + gain * innovation @ after,
                             step.retention[:, None] * kept + grown + after.T @ change @ after),
                kept + before[:, None] * (change[0] @ after))

    def expected_rest_angle(self, rate_integral: RateIntegral) -> tuple[float, float]:
        """Return the integral of the compensated rate at rest, rad, and its variance, rad²."""
        seen, _, _, variance = self._observation(rate_integral)
        return float(seen @ self.mean), float(seen @ self.covariance @ seen) + variance

    @cached_property
    def wander_rate(self) -> tuple[float, float]:
        """Return the sum of random walk and flicker, rad/s, and its variance."""
        parts = slice(WALK_INDEX, self.first_value_index)
        return float(self.mean[parts].sum()), float(self.covariance[parts, parts].sum())

    @cached_property
    def calibration_errors(self) -> tuple[Array, Array, Array]:
        """Return the calibration errors, their covariance, and that with `wander_rate`."""
        first = self.first_value_index
        return (self.mean[first:], self.covariance[first:, first:],
                self.covariance[WALK_INDEX:first, first:].sum(axis=0))

    def rate_error(self, sensitivity: Array) -> tuple[float, float]:
        """Return the error of the compensated rate, rad/s, and its variance; sensitivity (m,)."""
        offset, variance = self.wander_rate
        values, covariance, shared = self.calibration_errors
        return (offset - float(sensitivity @ values),
                variance + float(sensitivity @ (covariance @ sensitivity - 2.0 * shared)))

    def with_added_variance(self, index: int, variance: float) -> HeadingState:
        """Return the state with a variance added to one component."""
        covariance = self.covariance.copy()
        covariance[index, index] += variance
        return replace(self, covariance=covariance)

    def with_bias_change(self, change: float, variance: float, duration: float) -> HeadingState:
        """Return the state with a change of the bias, rad/s, that was there for a time, s."""
        change_of = np.zeros(len(self.mean))
        change_of[HEADING_INDEX], change_of[WALK_INDEX] = -duration, 1.0
        return replace(self, mean=self.mean + change * change_of,
                       covariance=self.covariance + variance * np.outer(change_of, change_of))

    def condition_on_heading(self, heading: float, variance: float) -> HeadingState:
        """Return the state given a later estimate of its heading, rad, and variance, rad²."""
        own = self.covariance[HEADING_INDEX, HEADING_INDEX]
        gain = (self.covariance[HEADING_INDEX] / own if own > 0.0
                else 0.0 * self.covariance[HEADING_INDEX])
        return replace(self, mean=self.mean + gain * (heading - self.mean[HEADING_INDEX]),
                       covariance=self.covariance + (variance - own) * np.outer(gain, gain))

    def with_heading(self, heading: float, variance: float) -> HeadingState:
        """Return the state with another heading, rad, and its variance, rad²."""
        mean, covariance = self.mean.copy(), self.covariance.copy()
        mean[HEADING_INDEX] = heading
        covariance[HEADING_INDEX] = covariance[:, HEADING_INDEX] = 0.0
        covariance[HEADING_INDEX, HEADING_INDEX] = variance
        return replace(self, mean=mean, covariance=covariance)


@dataclass(frozen=True)
class TrackStep:
    """A part of the drive: state before it, integral of the rates, rest or motion, end in s."""

    state_before: HeadingState
    rate_integral: RateIntegral
    is_resting: bool
    end_time: float
    #: Heading before it, rad, and its variance, rad², if there was no rest.
    moving_heading: tuple[float, float] = (0.0, 0.0)


def initial_state(noise: Noise, covariance: Array, heading: float = 0.0, variance: float = 0.0,
                  age: float | None = None) -> HeadingState:
    """
    Return the state at a heading, rad, and its variance, rad², some time after a calibration.

    The covariance is that of the calibration, shape (m, m), by `uncertainty_covariance`. The age,
    s, is that of a self-calibration, whose bias, the last value, is a mean over
    `BIAS_AVERAGING_TIME`; None without one. Its variance contains the floor of the Allan deviation
    for the flicker, which is replaced here by that of the flicker components.
    """
    constants, flicker_variances = noise.flicker_processes()
    first = _FLICKER_INDEX + len(constants)
    mean, whole = np.zeros(first + len(covariance)), np.zeros((first + len(covariance),) * 2)
    mean[HEADING_INDEX], whole[HEADING_INDEX, HEADING_INDEX] = heading, variance
    whole[first:, first:] = covariance
    flicker = np.arange(_FLICKER_INDEX, first)
    whole[flicker, flicker] = flicker_variances
    if age is not None:
        within, shared = averaged_process_moments(constants)
        whole[WALK_INDEX, WALK_INDEX] = (
            noise.rate_random_walk ** 2 * (age + BIAS_AVERAGING_TIME / 3.0))
        whole[-1, -1] = (max(whole[-1, -1] - noise.allan_floor ** 2, 0.0)
                         + flicker_variances * np.sum(within))
        whole[-1, flicker] = whole[flicker, -1] = (
            -flicker_variances * shared * np.exp(-age / constants))
    return HeadingState(noise, mean, whole)


def heading_variances(states: list[HeadingState], durations: Array, lost: Array,
                      sensitivities: Array) -> Array:
    """
    Return the variance of the heading after each turn from its state, rad², shape (k,).

    Of the integrals of rates, given are durations, s, and variances of what was lost and of its
    noise, rad², shape (k,), and the sensitivities, (k, m).
    """
    # flicker and random walk have the same parameters in all states
    seen, variances = _integrated_wander(states[0].noise, np.round(durations, 6))
    white = np.array([state.noise.angle_random_walk for state in states]) ** 2 * durations
    rows = np.concatenate([-seen, sensitivities], axis=1)
    rows[:, HEADING_INDEX] += 1.0
    spread = np.matmul([state.covariance for state in states], rows[:, :, None])[:, :, 0]
    return np.asarray((spread * rows).sum(axis=1) + variances + (lost + white))


def _integrated_wander(noise: Noise, durations: Array) -> tuple[Array, Array]:
    """Return contributions of heading, walk and flicker to integrals, (k, parts), and variance."""
    constants, variance = noise.flicker_processes()
    ratio = durations[:, None] / constants
    left = np.exp(-ratio)
    seen = np.zeros((len(durations), _FLICKER_INDEX + len(constants)))
    seen[:, WALK_INDEX], seen[:, _FLICKER_INDEX:] = durations, constants * (1.0 - left)
    parts = constants ** 2 * np.maximum(2.0 * ratio - 3.0 + 4.0 * left - left ** 2, 0.0)
    walk = noise.rate_random_walk ** 2 * durations ** 3 / 3.0
    return seen, walk + variance * parts.sum(axis=1)


@lru_cache(maxsize=4096)
def _padded_transition(noise: Noise, duration: float, is_unobserved: bool,
                       value_count: int) -> tuple[Array, Array, Array]:
    """Return contributions to the integral, decay and process noise, calibrated values last."""
    # White noise is not included. Without rates, walk and flicker go on, and contribute nothing.
    constants, variance = noise.flicker_processes()
    left, walk = np.exp(-duration / constants), noise.rate_random_walk ** 2
    (seen,), (integral,) = _integrated_wander(noise, np.array([duration]))
    grown = np.diag(np.concatenate(
        [[0.0, walk * duration], variance * (1.0 - left ** 2), np.zeros(value_count)]))
    if is_unobserved:
        seen[:] = 0.0
    else:
        flicker = slice(_FLICKER_INDEX, len(seen))
        grown[HEADING_INDEX, WALK_INDEX] = -0.5 * walk * duration ** 2
        grown[HEADING_INDEX, flicker] = -variance * constants * (1.0 - left) ** 2
        grown[:, HEADING_INDEX] = grown[HEADING_INDEX]
        grown[HEADING_INDEX, HEADING_INDEX] = integral
    return (np.concatenate([seen, np.zeros(value_count)]),
            np.concatenate([[1.0, 1.0], left, np.ones(value_count)]), grown)


def smooth_states(states: list[HeadingState], rate_integrals: list[RateIntegral],
                  resting: list[bool]) -> list[HeadingState]:
    """Smooth n + 1 states around n integrals by all later data (Rauch, Tung and Striebel)."""
    later = [states[-1]]
    for state, turn, rest in zip(states[-2::-1], rate_integrals[::-1], resting[::-1]):
        if rest:
            start, after, shared = state.measure_rest(turn)
        else:
            step = state.transition(turn)
            start, after, shared = (state, state.propagate(turn),
                                    state.covariance @ step.matrix.T)
        # the pseudo-inverse of correlations, as variances may be zero and of any size
        size = np.sqrt(np.diagonal(after.covariance))
        size = np.where(size > 0.0, size, 1.0)
        sizes = np.outer(size, size)
        smoother_gain = shared @ (pinvh(after.covariance / sizes) / sizes)
        known = later[-1].covariance
        if rest:
            covariance = start.covariance + (
                smoother_gain @ (known - after.covariance) @ smoother_gain.T)
        else:  # a sum of positive parts, as a rest may reduce the variance by many digits
            left = np.eye(len(known)) - smoother_gain @ step.matrix
            covariance = (left @ start.covariance @ left.T
                          + smoother_gain @ (step.process_noise + known) @ smoother_gain.T)
        later.append(replace(start, covariance=covariance,
                             mean=start.mean + smoother_gain @ (later[-1].mean - after.mean)))
    return later[::-1]
