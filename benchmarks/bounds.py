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

A Kalman filter is given the exact times of rest. It takes what there is to know of scale factor,
bias and flicker from the calibration and from the rests. So it bounds the accuracy of a program
that must detect the rests by itself. It shares nothing with the package but the noise figures.

"""

from __future__ import annotations

import math

from drives import Drive
from gyro_calibration.heading.integration import integrate
from gyro_calibration.logs.log import Array, DEGREE
from gyro_calibration.model.motion import CALIBRATION_MOTION
import numpy as np

#: Longest time that is one step of the filter, s.
_BLOCK = 0.5
#: Time constants, s, of the Gauss-Markov processes whose sum is flicker; ratio of neighbours.
_RATIO = math.sqrt(10.0)
_CONSTANTS = 0.3 * _RATIO ** np.arange(10)
#: Places in the state: correction of the heading, s, b; the flicker comes after them.
_CORRECTION, _SCALE, _BIAS, _FLICKER = 0, 1, 2, 3
_SIZE = _FLICKER + len(_CONSTANTS)


def knows_errors(drive: Drive) -> Array:
    """Return the heading with scale factor and bias known at any time, but not the rests."""
    return integrate(drive.time, _true_rate(drive))


def knows_errors_and_rests(drive: Drive) -> Array:
    """Return the heading with scale factor, bias and rests known at any time."""
    return integrate(drive.time, np.where(drive.rate == 0.0, 0.0, _true_rate(drive)))


def _true_rate(drive: Drive) -> Array:
    return (drive.output - drive.bias) / (1.0 + drive.gyro.true_values[0])


def knows_rests(drive: Drive) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Return heading and variance, live and with hindsight, of who knows when the robot rests."""
    mean, covariance = _calibrated(drive)
    scale, mean[_SCALE] = 1.0 + mean[_SCALE], 0.0  # from here on the uncalibrated part of s
    rests = (drive.rate[1:] == 0.0) & (drive.rate[:-1] == 0.0)
    corners = _corners(drive.time, rests)
    output = integrate(drive.time, drive.output)
    turned, noisy = (np.concatenate([[0.0], np.cumsum(step * ~rests)]) for step in (
        np.diff(output) / scale,
        np.diff(drive.time) * (drive.gyro.model.noise.angle_random_walk / scale) ** 2))
    filtered, predicted, transitions = [(mean, covariance)], [], []
    for begin, end in zip(corners[:-1], corners[1:]):
        duration = drive.time[end] - drive.time[begin]
        transition, grown = _transition(drive, duration)
        if rests[begin]:
            mean, covariance = _measured(mean, covariance, _seen(0.0),
                                         (output[end] - output[begin]) / duration,
                                         drive.gyro.model.noise.angle_random_walk ** 2 / duration)
            filtered[-1] = mean, covariance
        else:
            transition = transition.copy()
            transition[_CORRECTION] = (
                _seen((turned[end] - turned[begin]) / duration) * duration / scale)
            transition[_CORRECTION, _CORRECTION] = 1.0
        mean, covariance = transition @ mean, transition @ covariance @ transition.T + grown
        predicted.append((mean, covariance))
        transitions.append(transition)
        filtered.append((mean, covariance))
    live = [filtered[0], *predicted]
    return (_headings(drive.time, corners, turned, noisy, live),
            _headings(drive.time, corners, turned, noisy,
                      _smoothed(filtered, predicted, transitions)))


def _calibrated(drive: Drive) -> tuple[Array, Array]:
    """Return mean and covariance of the state after the calibration."""
    (time, output), noise = drive.run, drive.gyro.model.noise
    flicker = noise.bias_instability ** 2 * math.log(_RATIO) / math.pi
    mean, covariance = np.zeros(_SIZE), np.diag([0.0, 0.1 ** 2, DEGREE ** 2,
                                                 *np.full(len(_CONSTANTS), flicker)])
    corners = np.searchsorted(time, np.arange(0.0, time[-1] + 1e-9, 0.1) - 1e-9)
    said, true = integrate(time, output)[corners], CALIBRATION_MOTION.heading_at(time[corners])
    for duration, gyro, turned in zip(np.diff(time[corners]), np.diff(said), np.diff(true)):
        mean, covariance = _measured(mean, covariance, _seen(turned / duration),
                                     (gyro - turned) / duration,
                                     noise.angle_random_walk ** 2 / duration)
        transition, grown = _transition(drive, duration)
        mean, covariance = transition @ mean, transition @ covariance @ transition.T + grown
    return mean, covariance


def _corners(time: Array, rests: Array) -> Array:
    """Return the samples between which the filter steps: ends of rests, at most a block apart."""
    changes = np.flatnonzero(np.diff(rests)) + 1
    count = round(_BLOCK / (time[1] - time[0]))
    return np.unique(np.concatenate([[0], changes, np.arange(0, len(time), count),
                                     [len(time) - 1]]))


def _transition(drive: Drive, duration: float) -> tuple[Array, Array]:
    """Return what of the state stays for a time, and what comes new, shape (n, n) each."""
    stays = np.exp(-duration / _CONSTANTS)
    flicker = drive.gyro.model.noise.bias_instability ** 2 * math.log(_RATIO) / math.pi
    return np.diag([1.0, 1.0, 1.0, *stays]), np.diag([0.0, 0.0, 0.0,
                                                      *flicker * (1.0 - stays ** 2)])


def _seen(rate: float) -> Array:
    """Return what each part of the state adds to the output at a rate, rad/s."""
    return np.concatenate([[0.0, rate, 1.0], np.ones(len(_CONSTANTS))])


def _measured(mean: Array, covariance: Array, seen: Array, value: float,
              variance: float) -> tuple[Array, Array]:
    along = covariance @ seen
    gain = along / (seen @ along + variance)
    return mean + gain * (value - seen @ mean), covariance - np.outer(gain, along)


def _smoothed(filtered: list, predicted: list, transitions: list) -> list:
    """Go back over the filter's steps (Rauch, Tung and Striebel)."""
    states = [filtered[-1]]
    for (mean, covariance), (next_mean, next_covariance), transition in zip(
            filtered[-2::-1], predicted[::-1], transitions[::-1]):
        gain = np.linalg.lstsq(next_covariance, transition @ covariance, rcond=1e-12)[0].T
        later_mean, later_covariance = states[-1]
        states.append((mean + gain @ (later_mean - next_mean),
                       covariance + gain @ (later_covariance - next_covariance) @ gain.T))
    return states[::-1]


def _headings(time: Array, corners: Array, turned: Array, noisy: Array,
              states: list) -> tuple[Array, Array]:
    """Return heading and variance of every sample."""
    correction, variance = np.array([(mean[_CORRECTION], covariance[_CORRECTION, _CORRECTION])
                                     for mean, covariance in states]).T
    return (turned - np.interp(time, time[corners], correction),
            noisy + np.interp(time, time[corners], variance))
