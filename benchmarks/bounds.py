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
Bound the accuracy of headings: estimators that know more than a program can.

A Kalman filter and smoother is given the exact times of rest. It takes what there is to know of
scale factor, bias and flicker from the calibration and from the rests. So it bounds the accuracy
of a program that must detect the rests by itself. It shares nothing with the package but the
noise figures.
"""

from __future__ import annotations

import math

from drives import Drive
from gyro_calibration.heading.integration import integrate
from gyro_calibration.logs.log import Array, DEGREE
from gyro_calibration.model.motion import CALIBRATION_MOTION
from gyro_calibration.model.noise import Noise
import numpy as np

#: Longest time that is one step of the filter, s.
_BLOCK = 0.5
#: Time constants, s, of the Gauss-Markov processes whose sum is flicker; ratio of neighbours.
RATIO = math.sqrt(10.0)
CONSTANTS = 0.1 * RATIO ** np.arange(11)


def knows_errors(drive: Drive) -> Array:
    """Return the heading with scale factor and bias known at any time, but not the rests."""
    return integrate(drive.time, _true_rate(drive))


def knows_errors_and_rests(drive: Drive) -> Array:
    """Return the heading with scale factor, bias and rests known at any time."""
    return integrate(drive.time, np.where(drive.rate == 0.0, 0.0, _true_rate(drive)))


def _true_rate(drive: Drive) -> Array:
    return (drive.output - drive.bias) / (1.0 + drive.gyro.scale_factor_error)


def knows_rests(drive: Drive) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Return heading and variance, live and with hindsight, of who knows when the robot rests."""
    (time, output), noise = drive.run, drive.gyro.model.noise
    mean, covariance = prior(noise, 0.1, DEGREE)
    corners = np.searchsorted(time, np.arange(0.0, time[-1] + 1e-9, 0.1) - 1e-9)
    said, true = integrate(time, output)[corners], CALIBRATION_MOTION.heading_at(time[corners])
    for duration, gyro, turned in zip(np.diff(time[corners]), np.diff(said), np.diff(true)):
        mean, covariance = _measured(mean, covariance, _seen(turned / duration),
                                     (gyro - turned) / duration,
                                     noise.angle_random_walk ** 2 / duration)
        stays, grown = _process(noise, duration)
        mean, covariance = stays * mean, np.outer(stays, stays) * covariance + np.diag(grown)
    # from here on the state is relative to the calibrated scale
    scale, mean[1] = 1.0 + mean[1], 0.0
    return told_rests(drive.time, drive.output / scale, drive.rate == 0.0,
                      Noise(*(figure / scale for figure in vars(noise).values())),
                      mean / scale, covariance / scale ** 2)


def prior(noise: Noise, scale: float, bias: float) -> tuple[Array, Array]:
    """
    Return mean and covariance of a state before anything is known.

    It is the correction of the heading, rad, scale factor error, bias, rad/s, and flicker.
    """
    flicker = noise.bias_instability ** 2 * math.log(RATIO) / math.pi
    return np.zeros(3 + len(CONSTANTS)), np.diag(
        [0.0, scale ** 2, bias ** 2, *np.full(len(CONSTANTS), flicker)])


def told_rests(time: Array, output: Array, rests: Array, noise: Noise, mean: Array,
               covariance: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Return heading and variance of all samples, live and with hindsight, from a prior on."""
    still = rests[1:] & rests[:-1]
    corners = np.unique(np.concatenate([
        [0, len(time) - 1], np.flatnonzero(np.diff(still)) + 1,
        np.arange(0, len(time), round(_BLOCK / (time[1] - time[0])))]))
    gyro = integrate(time, output)
    turned, noisy = (np.concatenate([[0.0], np.cumsum(step * ~still)]) for step in (
        np.diff(gyro), np.diff(time) * noise.angle_random_walk ** 2))
    filtered, predicted, transitions = [], [(mean, covariance)], []
    for begin, end in zip(corners[:-1], corners[1:]):
        duration = time[end] - time[begin]
        stays, grown = _process(noise, duration)
        transition = np.diag(stays)
        if still[begin]:
            mean, covariance = _measured(mean, covariance, _seen(0.0),
                                         (gyro[end] - gyro[begin]) / duration,
                                         noise.angle_random_walk ** 2 / duration)
        else:
            transition[0] = _seen((turned[end] - turned[begin]) / duration) * duration
            transition[0, 0] = 1.0
        filtered.append((mean, covariance))
        mean, covariance = (transition @ mean,
                            transition @ covariance @ transition.T + np.diag(grown))
        predicted.append((mean, covariance))
        transitions.append(transition)
    smoothed = [predicted[-1]]  # Rauch, Tung and Striebel
    for (mean, covariance), (next_mean, next_covariance), transition in zip(
            filtered[::-1], predicted[:0:-1], transitions[::-1]):
        gain = np.linalg.lstsq(next_covariance, transition @ covariance, rcond=1e-12)[0].T
        later_mean, later_covariance = smoothed[-1]
        smoothed.append((mean + gain @ (later_mean - next_mean),
                         covariance + gain @ (later_covariance - next_covariance) @ gain.T))

    def headings(states: list[tuple[Array, Array]]) -> tuple[Array, Array]:
        correction, variance = np.array([(each[0], spread[0, 0]) for each, spread in states]).T
        return (turned - np.interp(time, time[corners], correction),
                noisy + np.interp(time, time[corners], variance))
    return headings(predicted), headings(smoothed[::-1])


def _process(noise: Noise, duration: float) -> tuple[Array, Array]:
    """Return what of each part of the state stays for a time, and the variance that comes new."""
    stays = np.exp(-duration / CONSTANTS)
    flicker = noise.bias_instability ** 2 * math.log(RATIO) / math.pi
    return np.concatenate([np.ones(3), stays]), np.concatenate(
        [[0.0, 0.0, noise.rate_random_walk ** 2 * duration], flicker * (1.0 - stays ** 2)])


def _seen(rate: float) -> Array:
    """Return what each part of the state adds to the output at a rate, rad/s."""
    return np.concatenate([[0.0, rate, 1.0], np.ones(len(CONSTANTS))])


def _measured(mean: Array, covariance: Array, seen: Array, value: float,
              variance: float) -> tuple[Array, Array]:
    along = covariance @ seen
    gain = along / (seen @ along + variance)
    return mean + gain * (value - seen @ mean), covariance - np.outer(gain, along)
