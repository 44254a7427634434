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

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

from gyro_calibration.logs.log import Array
from gyro_calibration.model.noise import CALIBRATED, known_mean, Noise
import numpy as np
from scipy.linalg import pinvh

#: Indices of heading, random walk and first flicker component in the state.
HEADING, WALK, _FLICKER = 0, 1, 2


@dataclass(slots=True)
class RateIntegral:
    """
    Integral of the rates over some time.

    Attributes
    ----------
    duration : s
    turned : integral of the compensated rate, rad
    sensitivity : integral of the sensitivity of the rate to the calibration, shape (m,)
    lost : variance of rotation that was not measured, rad²
    noise : additional variance of the noise by lost samples, rad²
    wander : variance of the rotation during a detected rest that may be a straight drive, rad²
    unseen : there were no rates: the heading is constant, and errors of rates do not affect it;
        not to be added to others

    """

    duration: float
    turned: float
    sensitivity: Array
    lost: float = 0.0
    noise: float = 0.0
    wander: float = 0.0
    unseen: bool = False

    def __add__(self, other: RateIntegral) -> RateIntegral:
        """Return the integral over both, one after the other."""
        return RateIntegral(self.duration + other.duration, self.turned + other.turned,
                            self.sensitivity + other.sensitivity,
                            self.lost + other.lost, self.noise + other.noise)

    def __sub__(self, other: RateIntegral) -> RateIntegral:
        """Return the rest of this integral after another with which it begins."""
        return RateIntegral(self.duration - other.duration, self.turned - other.turned,
                            self.sensitivity - other.sensitivity,
                            self.lost - other.lost, self.noise - other.noise)


@dataclass(frozen=True)
class Step:
    """
    Transition of the state over some time, without the rotation itself.

    Attributes
    ----------
    seen : contribution of each component to the integral of the compensated rate, shape (n,)
    kept : decay factor of each component, shape (n,)
    grown : covariance of the process noise, shape (n, n); the first row and column are those of
        the integral of the rate, negated

    """

    seen: Array
    kept: Array
    grown: Array


@dataclass(frozen=True)
class Drift:
    """
    Mean and covariance of the state, shape (n,) and (n, n).

    n = 2 + parts of the flicker + values of the calibration.

    """

    noise: Noise
    mean: Array
    covariance: Array

    @property
    def calibrated(self) -> int:
        """Return the index of the first value of the calibration in the state."""
        return _FLICKER + len(self.noise.flicker()[0])

    def step(self, turn: RateIntegral) -> Step:
        """Return the transition of the state over an integral of rates."""
        seen, variance = self._seen(turn)
        _, kept, grown = self._wandered(turn)
        grown = grown.copy()
        grown[HEADING, HEADING] = variance
        return Step(seen, kept, grown)

    def _wandered(self, turn: RateIntegral) -> tuple[Array, Array, Array]:
        return _step(self.noise, round(turn.duration, 6), turn.unseen, len(turn.sensitivity))

    def _seen(self, turn: RateIntegral) -> tuple[Array, float]:
        """Return `Step.seen`, and the variance of the noise of the integral, rad²."""
        seen, _, grown = self._wandered(turn)
        seen = seen.copy()
        seen[len(seen) - len(turn.sensitivity):] = -turn.sensitivity
        white = 0.0 if turn.unseen else self.noise.angle_random_walk ** 2 * turn.duration
        return seen, float(grown[HEADING, HEADING]) + white + turn.lost + turn.noise

    def moved(self, turn: RateIntegral) -> Drift:
        """Return the state after a time in motion."""
        step = self.step(turn)
        transition = np.diag(step.kept)
        transition[HEADING] -= step.seen
        mean = step.kept * self.mean
        mean[HEADING] += turn.turned - step.seen @ self.mean
        return Drift(self.noise, mean, transition @ self.covariance @ transition.T + step.grown)

    def heading_variance(self, turn: RateIntegral) -> float:
        """Return the variance of the heading after a time in motion, rad²."""
        row, variance = self._seen(turn)
        row[HEADING] -= 1.0
        return float(row @ self.covariance @ row) + variance

    def rested(self, turn: RateIntegral) -> Drift:
        """Return the state after a time at rest, with its measurement."""
        step = self.step(turn)
        return self.measured(turn, step).carried(turn, step)

    def measured(self, turn: RateIntegral, step: Step | None = None) -> Drift:
        """
        Return the state at the begin of a time at rest, updated by its measurement.

        A `wander` of the turn is added to the variance of the measurement and to that of the
        heading, which is then the heading at the end.

        """
        step = step or self.step(turn)
        along = self.covariance @ step.seen
        variance = float(step.seen @ along + step.grown[HEADING, HEADING]) + turn.wander
        off = turn.turned - float(step.seen @ self.mean)
        covariance = self.covariance
        if turn.wander:
            along[HEADING] += turn.wander
            covariance = covariance.copy()
            covariance[HEADING, HEADING] += turn.wander
        return Drift(self.noise, self.mean + along * (off / variance),
                     covariance - along[:, None] * along / variance)

    def carried(self, turn: RateIntegral, step: Step | None = None) -> Drift:
        """Return the state after a time of constant heading without a measurement."""
        step = step or self.step(turn)
        grown = step.grown.copy()
        grown[HEADING] = grown[:, HEADING] = 0.0
        grown[HEADING, HEADING] = turn.lost
        return Drift(self.noise, step.kept * self.mean,
                     step.kept[:, None] * self.covariance * step.kept + grown)

    def expected(self, turn: RateIntegral) -> tuple[float, float]:
        """Return the integral of the compensated rate at rest, rad, and its variance, rad²."""
        seen, variance = self._seen(turn)
        return float(seen @ self.mean), float(seen @ self.covariance @ seen) + variance

    @cached_property
    def offset(self) -> tuple[float, float]:
        """Return the sum of random walk and flicker, rad/s, and its variance."""
        parts = slice(WALK, self.calibrated)
        return float(self.mean[parts].sum()), float(self.covariance[parts, parts].sum())

    @cached_property
    def values(self) -> tuple[Array, Array, Array]:
        """Return the errors of the calibration, their covariance, and that with the `offset`."""
        first = self.calibrated
        return (self.mean[first:], self.covariance[first:, first:],
                self.covariance[WALK:first, first:].sum(axis=0))

    def bias(self, sensitivity: Array) -> tuple[float, float]:
        """Return the error of the compensated rate, rad/s, and its variance; sensitivity (m,)."""
        (offset, variance), (values, covariance, shared) = self.offset, self.values
        return (offset - float(sensitivity @ values),
                variance + float(sensitivity @ (covariance @ sensitivity - 2.0 * shared)))

    def uncertain(self, place: int, variance: float) -> Drift:
        """Return the state with a variance added to one component."""
        covariance = self.covariance.copy()
        covariance[place, place] += variance
        return replace(self, covariance=covariance)

    def known_to_head(self, heading: float, variance: float) -> Drift:
        """Return the state given a later estimate of its heading, rad, and variance, rad²."""
        own = self.covariance[HEADING, HEADING]
        gain = self.covariance[HEADING] / own if own > 0.0 else 0.0 * self.covariance[HEADING]
        return replace(
            self, mean=self.mean + gain * (heading - self.mean[HEADING]),
            covariance=self.covariance + (variance - own) * np.outer(gain, gain))

    def turned_to(self, heading: float, variance: float = 0.0) -> Drift:
        """Return the state with another heading, rad, and its variance, rad²."""
        mean, covariance = self.mean.copy(), self.covariance.copy()
        mean[HEADING] = heading
        covariance[HEADING] = covariance[:, HEADING] = 0.0
        covariance[HEADING, HEADING] = variance
        return replace(self, mean=mean, covariance=covariance)


def begin(noise: Noise, covariance: Array, heading: float = 0.0, variance: float = 0.0,
          age: float | None = None) -> Drift:
    """
    Return the state some time after a calibration.

    Parameters
    ----------
    noise : of the model
    covariance : of the calibration, shape (m, m), from `compensation.covariance`
    heading, variance : rad and rad²
    age : of a self-calibration, s, whose bias, the last value, is a mean over `CALIBRATED` s; None
        without one. Its variance contains the floor of the Allan deviation for the flicker, which
        is replaced here by that of the flicker components

    """
    constants, of_each = noise.flicker()
    first = _FLICKER + len(constants)
    mean, whole = np.zeros(first + len(covariance)), np.zeros((first + len(covariance),) * 2)
    mean[HEADING], whole[HEADING, HEADING] = heading, variance
    whole[first:, first:] = covariance
    flicker = np.arange(_FLICKER, first)
    whole[flicker, flicker] = of_each
    if age is not None:
        within, shared = known_mean(constants)
        whole[WALK, WALK] = noise.rate_random_walk ** 2 * (age + CALIBRATED / 3.0)
        whole[-1, -1] = max(whole[-1, -1] - noise.floor ** 2, 0.0) + of_each * np.sum(within)
        whole[-1, flicker] = whole[flicker, -1] = -of_each * shared * np.exp(-age / constants)
    return Drift(noise, mean, whole)


def heading_variances(drifts: list[Drift], turns: list[RateIntegral]) -> Array:
    """Return the variance of the heading after each turn from its state, rad², shape (k,)."""
    figures = np.array([(turn.duration, turn.lost + turn.noise
                         + drift.noise.angle_random_walk ** 2 * turn.duration)
                        for drift, turn in zip(drifts, turns)])
    # flicker and random walk have the same parameters in all states
    seen, variances = _integrated(drifts[0].noise, np.round(figures[:, 0], 6))
    rows = np.concatenate([-seen, [turn.sensitivity for turn in turns]], axis=1)
    rows[:, HEADING] += 1.0
    spread = np.matmul([drift.covariance for drift in drifts], rows[:, :, None])[:, :, 0]
    return np.asarray((spread * rows).sum(axis=1) + variances + figures[:, 1])


def _integrated(noise: Noise, durations: Array) -> tuple[Array, Array]:
    """Return contributions of heading, walk and flicker to integrals, (k, parts), and variance."""
    constants, variance = noise.flicker()
    ratio = durations[:, None] / constants
    left = np.exp(-ratio)
    seen = np.zeros((len(durations), _FLICKER + len(constants)))
    seen[:, WALK], seen[:, _FLICKER:] = durations, constants * (1.0 - left)
    return seen, (noise.rate_random_walk ** 2 * durations ** 3 / 3.0 + variance * (
        constants ** 2 * np.maximum(2.0 * ratio - 3.0 + 4.0 * left - left ** 2, 0.0)).sum(axis=1))


@lru_cache(maxsize=4096)
def _step(noise: Noise, duration: float, unseen: bool,
          values: int) -> tuple[Array, Array, Array]:
    """Return `_wander` or `_unseen` with room for the values of a calibration."""
    seen, kept, grown = (_unseen if unseen else _wander)(noise, duration)
    whole = np.zeros((len(kept) + values, len(kept) + values))
    whole[:len(kept), :len(kept)] = grown
    return (np.concatenate([seen, np.zeros(values)]), np.concatenate([kept, np.ones(values)]),
            whole)


def _wander(noise: Noise, duration: float) -> tuple[Array, Array, Array]:
    """
    Return contributions of heading, walk and flicker to the integral, decay, and process noise.

    White noise is not included.

    """
    constants, variance = noise.flicker()
    left, walk = np.exp(-duration / constants), noise.rate_random_walk ** 2
    kept = np.concatenate([[1.0, 1.0], left])
    (seen,), (integral,) = _integrated(noise, np.array([duration]))
    grown = np.diag(np.concatenate([[0.0, walk * duration], variance * (1.0 - left ** 2)]))
    grown[HEADING, WALK] = -0.5 * walk * duration ** 2
    grown[HEADING, _FLICKER:] = -variance * constants * (1.0 - left) ** 2
    grown[:, HEADING] = grown[HEADING]
    grown[HEADING, HEADING] = integral
    return seen, kept, grown


def _unseen(noise: Noise, duration: float) -> tuple[Array, Array, Array]:
    """Return the same without rates: walk and flicker go on, and contribute nothing."""
    seen, kept, grown = (values.copy() for values in _wander(noise, duration))
    seen[:] = grown[HEADING] = grown[:, HEADING] = 0.0
    return seen, kept, grown


def smoothed(states: list[Drift], turns: list[RateIntegral], resting: list[bool]) -> list[Drift]:
    """
    Return the states smoothed by all later data (Rauch, Tung and Striebel).

    Parameters
    ----------
    states : before each turn, and after the last; n + 1 of them
    turns, resting : n each

    """
    later = [states[-1]]
    for state, turn, rest in zip(states[-2::-1], turns[::-1], resting[::-1]):
        later.append(_with_hindsight(state, turn, rest, later[-1]))
    return later[::-1]


def _with_hindsight(state: Drift, turn: RateIntegral, rest: bool, later: Drift) -> Drift:
    """Return a state updated by the smoothed state after it."""
    step, start = state.step(turn), state
    if rest:
        after = state.measured(turn).carried(turn)
        expected, variance = state.expected(turn)
        along, variance = state.covariance @ step.seen, variance + turn.wander
        start = replace(state, mean=state.mean + along / variance * (turn.turned - expected),
                        covariance=state.covariance - np.outer(along, along) / variance)
        shared = start.covariance * step.kept
        shared[:, HEADING] -= along * turn.wander / variance
    else:
        after, transition = state.moved(turn), np.diag(step.kept)
        transition[HEADING] -= step.seen
        shared = state.covariance @ transition.T
    back = shared @ _inverse(after.covariance)
    return replace(
        start, mean=start.mean + back @ (later.mean - after.mean),
        covariance=start.covariance + back @ (later.covariance - after.covariance) @ back.T)


def _inverse(covariance: Array) -> Array:
    """Return the pseudo-inverse of a covariance that may have zero variances."""
    size = np.sqrt(np.diagonal(covariance))
    size = np.where(size > 0.0, size, 1.0)
    return pinvh(covariance / np.outer(size, size)) / np.outer(size, size)
