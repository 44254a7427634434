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
Tests of the noise and the bias of a gyro at rest against its model, and for repeats and pulses.

Samples are collected in stretches of `REST_DURATION` s with a steady rate. In each the mean square
of differences of blocks is tested against the noise of the model, and the mean rate against zero,
at levels by a stated rate of false alarms.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
import math

from gyro_calibration.files import MAX_MAGNITUDE
from gyro_calibration.heading.bias_table import REST_DURATION
from gyro_calibration.heading.integration import Intervals, RECENT_DURATION
from gyro_calibration.heading.tracker import NOISE_TOLERANCE
from gyro_calibration.logs.log import Array, DEGREE, MIN_SAMPLE_INTERVAL
from gyro_calibration.logs.quality import quantization_step
from gyro_calibration.model.noise import Noise
from gyro_calibration.ros.inputs import (
    FAULT_DURATION, MAX_ANGULAR_ACCELERATION, MIN_ODOMETRY_TURN_RATE)
import numpy as np
from scipy.special import chdtr, chdtrc

_PART_DURATION = 1.0  # s; of the parts of a stretch that are compared: a push shows in one
#: Largest ratio of the noise of the model to the measured one, 1, as of a filtered output.
_MAX_NOISE_REDUCTION = 3.0
_MAX_DECELERATION = 20.0  # rad/s²; of a robot: six times the default of Nav2's controllers


@dataclass(frozen=True)
class _RestResult:
    noise_ratio: float  # standard deviation of the noise over that of the model
    is_noise_normal: bool  # within chance and tolerance
    bias: float  # mean rate, rad/s
    sigmas: float  # of the mean, by the variance of the model; nan where unknown
    is_bias_normal: bool  # within chance
    bias_deviation: float  # standard deviation of the mean by the noise of this stretch, rad/s


class RepeatedOutputDetector:
    """
    Detector of a gyro that repeats one value: it is dead, saturated, or its driver has stopped.

    20 equal values in 0.25 s count as repeated if odometry shows a different rate, if the noise is
    larger than the steps of the output, or if chance is excluded. Some gyros report zero at rest:
    a repeated zero counts only after a deceleration that no robot has, unless wheels stand then,
    or if a whole stretch at rest had the noise of the model before the first such zero. Two
    neighbouring codes, as of a dead gyro whose last bit toggles, count if chance is excluded; zero
    as above.

    A gyro with noise `is_suspected` while it repeats the value of its first sample, whose step is
    not known, or zero against chance for the first time. Later such zeros mean that it
    `is_zeroed`: it has neither noise nor bias now. Where what is suspected ends with an
    acceleration that no robot has, it was dead, unless wheels stood until then.

    A value held for longer than usual, not by chance, leaves a possible error of the integrated
    rate, `unseen_turn`, rad; a full turn where the first value shows later to have been that of a
    dead gyro. Each value is rounded to the steps of the output, by an error that lasts until the
    next one.
    """

    def __init__(self, noise: Noise):
        self._noise, self._step, self._changes = noise, math.inf, 0
        self._value, self._since, self._count = math.nan, 0.0, 0
        self._last_step = self._acceleration = 0.0  # to this value, rad/s, and rad/s² less noise
        self._reports_zero, self._holds = False, Intervals()
        self._is_fault = self.is_suspected = self.is_zeroed = self._has_left_zero = False
        self._first = 0.0, 0  # value, rad/s, and number of samples before the first change
        self._until = self.unseen_turn = 0.0  # last sample of this value, s
        # of the values before, rad², and standard deviation by this value so far, rad
        self._rounding_variance = self._rounded_turn = 0.0
        # smallest and largest value since a time, s, and the number of samples after the first
        self._band = math.nan, math.nan, 0.0, 0

    def add(self, time: float, output: float, odometry_rate: float,
            has_noise_at_rest: bool = False, stands: bool = False, rests: bool = False) -> bool:
        """
        Add a sample, s and rad/s, and tell if it is repeated.

        The rate by odometry, rad/s, is 0 without any; wheels show that the robot `stands`, or the
        statistics of the rate that it `rests`.
        """
        step = abs(output - self._value)
        if step:
            self._step = min(step, self._step)
        toggles, self.unseen_turn = self._is_toggling(time, output, has_noise_at_rest), 0.0
        if step or not self._changes:
            self._end_value(time, output, has_noise_at_rest, stands)
            return toggles
        if not rests and self.has_changed:
            self._rounded_turn += self._step / math.sqrt(12.0) * abs(time - self._until)
        self._count, self._until = self._count + 1, time
        if stands:  # the robot has stopped
            self._acceleration = 0.0
        lasts = time - self._since
        self._is_fault = self._is_fault or (
            lasts > _PART_DURATION and abs(odometry_rate) > MIN_ODOMETRY_TURN_RATE
            and abs(output - odometry_rate) > 0.5 * abs(odometry_rate))
        if toggles or self._is_fault or self._count < 20 or lasts < FAULT_DURATION:
            return toggles or self._is_fault
        is_sudden = self._acceleration > _MAX_DECELERATION
        self._reports_zero = self._reports_zero or output == 0.0 and not (
            has_noise_at_rest or is_sudden)
        # the step of the output is known after 100 changes; the first sample is one
        sample = self._noise.angle_random_walk / math.sqrt(lasts / self._count)
        is_no_chance = self._changes > 100 and (
            2.0 * _MAX_NOISE_REDUCTION * self._step < sample
            or self._excludes_chance(self._step, self._count, lasts / self._count))
        if output == 0.0 and self._reports_zero and not is_sudden:
            self.is_suspected = is_no_chance and not self._has_left_zero
            self.is_zeroed = is_no_chance and self._has_left_zero
        else:
            self._is_fault = is_no_chance
        self.is_suspected = self.is_suspected or sample > 0.0 and self._changes == 1
        return self._is_fault

    def _is_toggling(self, time: float, output: float, has_noise_at_rest: bool) -> bool:
        """Tell whether two neighbouring codes alternate for longer than noise allows."""
        low, high, since, count = self._band
        low, high, count = min(low, output), max(high, output), count + 1
        if not high - low < 1.5 * self._step:
            low, high, since, count = output, output, time, 0
        self._band = low, high, since, count
        lasts = time - since
        return (low < high and (has_noise_at_rest or not low <= 0.0 <= high)
                and self._changes > 100 and lasts > FAULT_DURATION
                and self._excludes_chance(2.0 * self._step, count, lasts / count))

    def _end_value(self, time: float, output: float, has_noise_at_rest: bool,
                   stands: bool) -> None:
        """Begin another value; the turn that the gyro may not have seen is `unseen_turn`."""
        step, changed_after = abs(output - self._value), abs(time - self._since)
        self._rounding_variance, self._rounded_turn = self.rounding_variance, 0.0
        if self._holds.add(changed_after) and self._changes > 100 and (
                self._value or has_noise_at_rest or self._acceleration > (
                    _MAX_DECELERATION if self._has_left_zero else MAX_ANGULAR_ACCELERATION)):
            usual, held = self._holds.usual_interval, self._until - self._since
            # a chance of e^-20 is once in 50 days at 100 Hz
            if self._excludes_chance(self._step, held / usual, usual, 20.0):
                # the mean square of a rate that goes on linearly or changes at once, and a turn
                self.unseen_turn = math.hypot(
                    math.hypot(step, self._last_step) * (held + usual) / math.sqrt(3.0),
                    0.25 * MAX_ANGULAR_ACCELERATION * (held + usual) ** 2)
        if self._changes == 1:
            self._first = self._value, self._count
        elif self._first[1] >= 20 and self._changes > 100 and (
                self._first[0] or has_noise_at_rest):
            if self._excludes_chance(self._step, self._first[1], self._holds.usual_interval):
                self.unseen_turn = math.tau
            self._first = 0.0, 0
        if self.is_suspected and not stands and (
                step - MIN_ODOMETRY_TURN_RATE > _MAX_DECELERATION * (time - self._until)):
            self.unseen_turn = math.tau
        self._is_fault = self.is_suspected = self.is_zeroed = False
        self._has_left_zero = self._reports_zero
        self._last_step = step
        self._acceleration = ((step - MIN_ODOMETRY_TURN_RATE)
                              / max(changed_after, MIN_SAMPLE_INTERVAL))
        self._value, self._since, self._until, self._count = output, time, time, 0
        self._changes += 1

    @property
    def rounding_variance(self) -> float:
        """Return the variance of the integrated rate by the steps of the output, rad²."""
        return self._rounding_variance + self._rounded_turn ** 2

    def reset_heading(self) -> None:
        self._rounding_variance = self._rounded_turn = 0.0

    @property
    def has_changed(self) -> bool:
        return self._changes > 1

    def _excludes_chance(self, width: float, count: float, interval: float,
                         level: float = 100.0) -> bool:
        """Tell whether chance is below e^-level for samples of noise within a width, rad/s."""
        if not (sample := self._noise.angle_random_walk / math.sqrt(interval)):
            return False
        stays = math.erf(_MAX_NOISE_REDUCTION * width / (2.0 * math.sqrt(2.0) * sample))
        return -count * math.log(max(stays, 1e-9)) > level


class PulseDetector:
    """
    Detector of samples that deviate from those before and after as no rate of a robot does.

    A pulse begins with a step of more than 20 rad/s² and ten times the median one of the last 2 s,
    and ends with such a step back, at most 0.25 s later.
    """

    def __init__(self) -> None:
        self._last = math.nan, math.nan
        self._steps = deque[tuple[float, float]]()  # stamps, s, and sizes, rad/s
        self._median_step, self._median_time = math.nan, -math.inf  # rad/s, and of when, s
        # rate before the pulse, rad/s; its begin, s, largest step, rad/s, and samples so far
        self._pulse: tuple[float, float, float, int] | None = None
        self._turn = 0.0  # by the pulse so far, rad

    def add(self, time: float, output: float) -> tuple[float, int]:
        """Add a sample, s and rad/s; return turn, rad, and samples of a pulse that ended."""
        (then, before), self._last = self._last, (time, output)
        step, interval = output - before, abs(time - then)
        while self._steps and not 0.0 <= time - self._steps[0][0] <= RECENT_DURATION:
            self._steps.popleft()
        if self._steps and not 0.0 <= time - self._median_time < 0.05 * RECENT_DURATION:
            self._median_time = time
            self._median_step = float(np.median([size for _, size in self._steps]))
        # 5 of 1.2 million samples of cars and turntables are higher than ten medians
        is_jump = abs(step) > _MAX_DECELERATION * interval + 10.0 * self._median_step
        found = 0.0, 0
        if self._pulse and not 0.0 <= time - self._pulse[1] <= FAULT_DURATION:
            self._pulse = None
        if self._pulse is None:
            if is_jump:
                self._pulse, self._turn = (before, time, step, 1), step * interval
        else:
            base, begin, first, count = self._pulse
            if is_jump and step * first < 0.0 and abs(output - base) < 0.5 * abs(first):
                found, self._pulse = (self._turn, count), None
            else:
                self._turn += (output - base) * interval
                self._pulse = base, begin, first, count + 1
        self._steps.append((time, abs(step)))
        return found


class HealthMonitor:
    """Monitor of noise and bias at rest on a robot; its alarms are a sentence each, or ''."""

    def __init__(self, noise: Noise, false_alarm_rate: float, standstill_rate: float = 0.0,
                 largest_bias: float = math.inf):
        """
        Take the noise of the model, the largest rate of false alarms, 1/h, and rates in rad/s.

        Means below the standstill rate are rest; one above may be a steady turn, and counts only
        if it stays in several stretches, and, unless a rest is known otherwise, is below the
        largest bias.
        """
        self._noise, self.standstill_rate = noise, standstill_rate
        self._largest_bias = largest_bias
        # Four tests: noise and bias, upwards and downwards.
        self._level = 0.25 * false_alarm_rate * REST_DURATION / 3600.0
        self.is_enabled = noise.angle_random_walk > 0.0 and self._level > 0.0
        self._samples: list[tuple[float, float, float]] = []
        # in a row, which decide in a rest that was not announced: a robot may vibrate
        self._rests = deque[_RestResult](maxlen=3)
        self._step = math.inf
        self.noise_alarm = self.bias_alarm = ''
        self.last_rest: _RestResult | None = None
        self.examined_count, self.has_noise_at_rest = 0, False

    def restart(self) -> None:
        """Discard the samples so far, as after a gap."""
        self._samples = []

    def reset_biases(self) -> None:
        self.restart()
        self._rests.clear()
        self.bias_alarm = ''

    def add(self, time: float, output: float, rate: float) -> bool:
        """Add a sample, s and rad/s; return whether `examine_stretch` is to be called."""
        if self._samples and not 0.0 < time - self._samples[-1][0] <= 0.5:
            self.restart()
        self._samples.append((time, output, rate))
        return time - self._samples[0][0] >= REST_DURATION

    def examine_stretch(self, bias_variance: float, age: float, is_announced: bool,
                        is_resting: bool = False) -> _RestResult | None:
        """Test the complete stretch, and start the next; a run announces a rest."""
        # the last sample is alone in its part, and may be the first of a turn
        time, output, rate = np.array(self._samples[:-1]).T
        self.restart()
        if np.ptp(output) > 0.0:
            self._step = min(self._step, quantization_step(output))
        rest = examine_stretch(time, output, rate, self._noise, self._level, self._step,
                               bias_variance, age)
        if rest is None:
            return None
        self.last_rest, self.examined_count = rest, self.examined_count + 1
        # not only normal as of a coarse output, which may hide all noise
        self.has_noise_at_rest = (
            self.has_noise_at_rest or rest.is_noise_normal and rest.is_bias_normal
            and 1.0 / _MAX_NOISE_REDUCTION < rest.noise_ratio < _MAX_NOISE_REDUCTION)
        self._rests.append(rest)
        last, several = self._rests, len(self._rests) == self._rests.maxlen
        # the mean was the same in the last stretches, unlike in turns
        biases = [each.bias for each in last]
        stays = max(biases) - min(biases) < 6.0 * max(each.bias_deviation for each in last)
        if rest.is_noise_normal:
            self.noise_alarm = ''
        elif is_announced or several and not any(each.is_noise_normal for each in last):
            remedy = (': check that the gyro responds to turns' if rest.noise_ratio < 1.0 else
                      ', unless the robot vibrates: record a log at rest, and run allan on it')
            self.noise_alarm = (f'the noise at rest is {rest.noise_ratio:.2f} times that of the '
                                f'model{remedy}')
        if rest.is_bias_normal:
            self.bias_alarm = ''
        elif (is_announced or abs(rest.bias) < self.standstill_rate
              or several and stays and not any(each.is_bias_normal for each in last)
              and (is_resting or abs(rest.bias) < self._largest_bias)):
            is_rest = is_announced or is_resting or abs(rest.bias) < self.standstill_rate
            self.bias_alarm = (f'{"at rest" if is_rest else "unless the robot turns evenly,"} '
                               f'the corrected rate is {rest.bias / DEGREE:.4f} deg/s, '
                               f'{rest.sigmas:.0f} sigma of the model: calibrate, and if this '
                               'occurs again, diagnose a log')
        return rest


def examine_stretch(time: Array, output: Array, rate: Array, noise: Noise, level: float,
                    step: float = 0.0, bias_variance: float = math.nan, age: float = 0.0
                    ) -> _RestResult | None:
    """
    Test a stretch of samples against noise and bias of a model; None where it tells nothing.

    Time, output and rate, after model and self-calibration, are in s and rad/s, of shape (n,); the
    level is the probability of each of the four false alarms, the step that of the quantization,
    rad/s, inf where the output never changed. The variance of the bias, (rad/s)², is that of its
    calibration of an age in s, nan where it is not known.
    """
    if max(np.abs(output).max(), np.abs(rate).max()) > MAX_MAGNITUDE:
        return None  # the squares may overflow
    interval = (time[-1] - time[0]) / (len(time) - 1)
    size = max(1, round(0.05 / interval))  # blocks of 0.05 s
    if len(time) < 20 * size or step == math.inf:
        return None
    hidden = step > 2.0 * math.sqrt(noise.allan_variance(interval))
    rounding = step * step * (0.25 if hidden else 1.0 / 12.0) / size
    # differences of means over neighbouring blocks, each block used once
    blocks = output[:len(output) // (2 * size) * 2 * size].reshape(-1, 2, size).mean(axis=2)
    squares = (blocks[:, 1] - blocks[:, 0]) ** 2
    count, measured = len(squares), 0.5 * float(np.mean(squares))
    claimed = noise.allan_variance(size * interval)
    spectrum = max(measured, claimed + rounding) * size * interval

    # the parts of a steady rate differ within noise; with 9 degrees of freedom chance exceeds the
    # ratio of 6 once in a million stretches
    part = ((time - time[0]) / _PART_DURATION).astype(int)
    samples = np.bincount(part)
    means = (np.bincount(part, rate) / np.maximum(samples, 1))[samples > 0.5 * samples.max()]
    explained = (spectrum / _PART_DURATION
                 + noise.mean_change_variance(REST_DURATION, _PART_DURATION))
    if len(means) < 2 or not means.var(ddof=1) <= 6.0 * explained:
        return None

    too_much = (chdtrc(count, count * measured / ((claimed + rounding) * NOISE_TOLERANCE ** 2))
                < level)
    too_little = (not hidden
                  and chdtr(count, count * measured * _MAX_NOISE_REDUCTION ** 2 / claimed) < level)
    rounding_error = 0.5 * step if hidden else 0.0
    duration, mean = float(time[-1] - time[0]), float(rate.mean())
    of_noise = spectrum / duration + rounding_error ** 2
    variance = of_noise + noise.mean_change_variance(age, duration) + bias_variance
    sigmas = (max(abs(mean) - rounding_error, 0.0)
              / math.sqrt(variance) if variance > 0.0 else math.nan)
    return _RestResult(
        math.sqrt(measured / claimed), not (too_much or too_little), mean, sigmas,
        not math.erfc(sigmas / math.sqrt(2.0)) < 2.0 * level,
        math.sqrt(of_noise + noise.mean_change_variance(duration, duration)))
