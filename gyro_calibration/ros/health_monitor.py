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
Check whether a gyro at rest has the noise and the bias of its model.

Samples are gathered to stretches of `STRETCH` s in which the rate is steady, as it is at rest. In
each, the noise is compared with the model's by the mean square of differences of neighbouring
blocks, and the mean rate with zero. The levels of both tests follow from a stated rate of false
alarms.

"""

from __future__ import annotations

from dataclasses import dataclass
import math

from gyro_calibration.files import LARGEST
from gyro_calibration.logs.log import Array, DEGREE
from gyro_calibration.logs.quality import quantization_step
from gyro_calibration.model.gyro_model import SelfCalibration
from gyro_calibration.model.noise import Noise
import numpy as np
from scipy.special import chdtr, chdtrc

#: Length of a stretch, of a part that must be steady, and of a block whose mean is compared with
#: its neighbour's, s.
STRETCH, _PART, _BLOCK = 10.0, 1.0, 0.05
#: Longest interval between samples, s.
_GAP = 0.5
#: Noise up to this many times the model's is accepted: figures are inexact and change with age.
_TOLERANCE = 1.25
#: Noise down to the model's divided by this is accepted: a gyro that filters its output has less
#: noise in neighbouring blocks.
_QUIET = 3.0
#: Limit of the variance of parts over the one that noise explains; with 9 degrees of freedom
#: chance exceeds it once in a million stretches.
_STEADY = 6.0
#: Chance that a calibration is falsely reported to differ from the one before.
CHANCE = 1e-3
#: A value that comes so often, and for so long, s, is repeated: a gyro whose noise is _QUIET times
#: less than that of the model, and 2 steps of its output, repeats a value with a chance of 0.2.
_REPEATS, _REPEATED = 20, 0.25
#: Also a gyro of larger steps is dead where this is exceeded by the logarithm of the chance of so
#: many repeated values: e^-25 for a gyro that sends each sample four times.
_IMPROBABLE = 100.0
#: So many changes show the step of an output.
_CHANGES = 100
#: Odometry shows a turn from this rate on, rad/s.
_TURNS = 0.05
#: No robot stops a turn faster, rad/s².
_BRAKING = 20.0
#: Number of stretches in a row that decide where the rest is not announced, since a robot that
#: goes straight may shake for a while.
_IN_A_ROW = 3


@dataclass(frozen=True)
class Rest:
    """The result of one stretch at rest."""

    time: float  # of its end, s
    noise_ratio: float  # standard deviation of the noise over that of the model
    noise_fits: bool  # within chance and tolerance
    bias: float  # mean rate, rad/s
    sigmas: float  # of the mean, by what the model explains; nan where it does not say
    bias_fits: bool  # within chance
    bias_deviation: float  # standard deviation of the mean by the noise of this stretch, rad/s
    announced: bool


class RepeatedOutput:
    """
    Find out whether a gyro repeats one value: it is dead, saturated, or its driver has stopped.

    That is so where odometry shows another turn, and where its noise is larger than the steps of
    its output, or chance is excluded. Some gyros report zero at rest: a repeated zero counts only
    after a stop that is too sudden for a robot.

    """

    def __init__(self, noise: Noise):
        """Begin with nothing seen; `noise` of the model."""
        self._noise, self._step, self._changes = noise, math.inf, 0
        self._value, self._since, self._count, self._fell = math.nan, 0.0, 0, False

    def add(self, time: float, output: float, turning: float) -> bool:
        """Take a sample, s and rad/s, and the rate by odometry or 0; tell if it is repeated."""
        if output != self._value:
            step = abs(output - self._value)
            self._step = min(step, self._step)
            self._fell = step > _TURNS + _BRAKING * abs(time - self._since)
            self._value, self._since, self._count = output, time, 0
            self._changes += 1
            return False
        self._count += 1
        lasts = time - self._since
        if self._count < _REPEATS or lasts < _REPEATED:
            return False
        if lasts > _PART and abs(turning) > _TURNS and abs(output - turning) > 0.5 * abs(turning):
            return True
        sample = self._noise.angle_random_walk / math.sqrt(lasts / self._count)
        if output == 0.0 and not self._fell or self._changes <= _CHANGES or not sample:
            return False
        # the chance of one more sample with the value, where the noise is low and lies around it
        repeats = math.erf(_QUIET * self._step / (2.0 * math.sqrt(2.0) * sample))
        return (2.0 * _QUIET * self._step < sample
                or -self._count * math.log(max(repeats, 1e-9)) > _IMPROBABLE)


class HealthMonitor:
    """
    Compare noise and bias at rest with the model, on a robot.

    Attributes
    ----------
    standing : a mean below this, rad/s, is rest; one above may be a steady turn, and counts if it
        is the same in several stretches
    noise_alarm, bias_alarm : one sentence each, '' without an alarm
    last : the last stretch at rest, or None
    examined : number of stretches at rest

    """

    def __init__(self, noise: Noise, false_alarms: float, standing: float = 0.0):
        """
        Begin with nothing gathered.

        Parameters
        ----------
        noise : of the model; without an angle random walk nothing is checked
        false_alarms : largest rate of false alarms at rest, 1/h; 0 checks nothing
        standing : see above, rad/s

        """
        self._noise, self.standing = noise, standing
        # Four ways to alarm: noise or bias, upwards or downwards.
        self._level = 0.25 * false_alarms * STRETCH / 3600.0
        self._gathered: list[tuple[float, float, float]] = []
        self._rests: list[Rest] = []
        self._step = math.inf
        self.noise_alarm = self.bias_alarm = ''
        self.last: Rest | None = None
        self.examined = 0

    @property
    def works(self) -> bool:
        """Return whether there is anything to check."""
        return self._noise.angle_random_walk > 0.0 and self._level > 0.0

    def restart(self) -> None:
        """Drop the samples gathered so far, as after a gap."""
        self._gathered = []

    def recalibrated(self) -> None:
        """Drop the past biases, as another calibration is in use."""
        self.restart()
        self._rests.clear()
        self.bias_alarm = ''

    def add(self, time: float, output: float, rate: float) -> bool:
        """
        Take a sample: its stamp, s, output and corrected rate, rad/s.

        Tell whether a stretch is complete, and `examine` is to be called.

        """
        if self._gathered and not 0.0 < time - self._gathered[-1][0] <= _GAP:
            self.restart()
        self._gathered.append((time, output, rate))
        return time - self._gathered[0][0] >= STRETCH

    def examine(self, bias_variance: float, age: float, announced: bool = False) -> Rest | None:
        """
        Examine the stretch that is complete, and begin the next.

        Parameters
        ----------
        bias_variance : of the bias by its calibration, (rad/s)²; nan where it is not known
        age : of that calibration, s
        announced : whether the rest was announced

        Returns
        -------
        the result; None where the rate is not steady, which is no rest

        """
        time, output, rate = np.array(self._gathered).T
        self.restart()
        if np.ptp(output) > 0.0:
            self._step = min(self._step, quantization_step(output))
        rest = examine(time, output, rate, self._noise, self._level, self._step, bias_variance,
                       age, announced)
        if rest is not None:
            self.last, self.examined = rest, self.examined + 1
            self._rests = [*self._rests, rest][-_IN_A_ROW:]
            self._set_alarms(rest)
        return rest

    def _set_alarms(self, rest: Rest) -> None:
        last, several = self._rests, len(self._rests) == _IN_A_ROW
        biases = [each.bias for each in last]
        # the mean was the same in the last stretches, unlike that of turns
        stays = max(biases) - min(biases) < 6.0 * max(each.bias_deviation for each in last)
        if rest.noise_fits:
            self.noise_alarm = ''
        elif rest.announced or several and not any(each.noise_fits for each in last):
            remedy = ('record a log at rest, and run allan or diagnose on it'
                      if rest.noise_ratio > 1.0 else 'check that the gyro responds to turns')
            shaken = ('' if rest.announced or rest.noise_ratio < 1.0
                      else ', or the robot vibrates')
            self.noise_alarm = (f'the noise at rest is {rest.noise_ratio:.2f} times that of the '
                                f'model{shaken}: {remedy}')
        if rest.bias_fits:
            self.bias_alarm = ''
        elif (rest.announced or abs(rest.bias) < self.standing
              or several and stays and not any(each.bias_fits for each in last)):
            self.bias_alarm = (f'at rest the corrected rate is {rest.bias / DEGREE:.4f} deg/s, '
                               f'{rest.sigmas:.0f} sigma of the model: calibrate, and if this '
                               'occurs again, diagnose a log')


def examine(time: Array, output: Array, rate: Array, noise: Noise, level: float,
            step: float = 0.0, bias_variance: float = math.nan, age: float = 0.0,
            announced: bool = False) -> Rest | None:
    """
    Test a stretch of samples against noise and bias of a model.

    The codes of a gyro that rounds coarsely do not show its noise: the tests allow for what
    rounding may add or hide.

    Parameters
    ----------
    time, output, rate : s and rad/s, shape (n,); the rate is after model and self-calibration
    noise : of the model
    level : chance of each of the four false alarms
    step : between the codes of the output, rad/s; inf where the output never changed
    bias_variance, age, announced : as in `HealthMonitor.examine`

    Returns
    -------
    the result; None where the rate is not steady, samples are too few, or values are absurd

    """
    if max(np.abs(output).max(), np.abs(rate).max()) > LARGEST:
        return None  # no gyro has such rates, and their squares may overflow
    interval = (time[-1] - time[0]) / (len(time) - 1)
    size = max(1, round(_BLOCK / interval))
    if len(time) < 20 * size or step == math.inf:
        return None
    sample_variance = noise.allan_variance(interval)
    hidden = step > 2.0 * math.sqrt(sample_variance)
    rounding = step * step * (0.25 if hidden else 1.0 / 12.0) / size
    # differences of means over neighbouring blocks, each block used once
    blocks = output[:len(output) // (2 * size) * 2 * size].reshape(-1, 2, size).mean(axis=2)
    squares = (blocks[:, 1] - blocks[:, 0]) ** 2
    measured, claimed = 0.5 * float(np.mean(squares)), noise.allan_variance(size * interval)
    largest = max(measured, claimed + rounding)
    if not _steady(time, rate, largest * size * interval, noise):
        return None
    count = len(squares)
    too_much = chdtrc(count, count * measured / ((claimed + rounding) * _TOLERANCE ** 2)) < level
    too_little = not hidden and chdtr(count, count * measured * _QUIET ** 2 / claimed) < level
    return Rest(float(time[-1]), math.sqrt(measured / claimed), not (too_much or too_little),
                *_bias(time, rate, largest * size * interval, noise, level, bias_variance, age,
                       0.5 * step if hidden else 0.0), announced)


def _bias(time: Array, rate: Array, spectrum: float, noise: Noise, level: float,
          bias_variance: float, age: float, unsure: float) -> tuple[float, float, bool, float]:
    """Return the mean rate, its number of sigmas, whether it fits, and its deviation by noise."""
    duration, mean = float(time[-1] - time[0]), float(rate.mean())
    of_noise = spectrum / duration + unsure ** 2
    variance = of_noise + noise.wander(age, duration) + bias_variance
    sigmas = max(abs(mean) - unsure, 0.0) / math.sqrt(variance) if variance > 0.0 else math.nan
    fits = not math.erfc(sigmas / math.sqrt(2.0)) < 2.0 * level
    return mean, sigmas, fits, math.sqrt(of_noise + noise.wander(duration, duration))


def _steady(time: Array, rate: Array, spectrum: float, noise: Noise) -> bool:
    """Return whether parts of the stretch differ by no more than noise; one part shows nothing."""
    part = ((time - time[0]) / _PART).astype(int)
    count = np.bincount(part)
    means = (np.bincount(part, rate) / np.maximum(count, 1))[count > 0.5 * count.max()]
    explained = spectrum / _PART + noise.wander(STRETCH, _PART)
    return len(means) > 1 and bool(means.var(ddof=1) <= _STEADY * explained)


def changed(before: SelfCalibration, after: SelfCalibration, noise: Noise, age: float,
            level: float = CHANCE) -> str:
    """
    Return how a calibration differs from the one before, if noise does not explain it, else ''.

    Parameters
    ----------
    before : an infinite variance is of a value that was not known
    noise : of the model, by which the bias drifts
    age : time between the two, s
    level : chance of a false report

    """
    if before.covariance is None or after.covariance is None:
        return ''
    variances = (np.diagonal(before.covariance) + np.diagonal(after.covariance)
                 + [0.0, noise.wander(age, STRETCH)])
    differences = np.array([after.scale_factor_error - before.scale_factor_error,
                            after.bias - before.bias])
    sigmas = np.abs(differences) / np.sqrt(variances)
    found = [f'the {name} changed by {text} ({size:.1f} sigma)' for name, text, size in zip(
        ('scale factor error', 'bias'),
        (f'{100 * differences[0]:.3f} %', f'{differences[1] / DEGREE:.4f} deg/s'), sigmas)
        if math.erfc(size / math.sqrt(2.0)) < 0.5 * level]
    return (f'{" and ".join(found)}, more than the model predicts; '
            'if this occurs again, diagnose a log' if found else '')
