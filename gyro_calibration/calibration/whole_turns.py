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
Scale factor error and bias from whole turns between two rests on one mark.

The robot rests on the mark, turns at any rates, and rests on the mark again. The mark is the only
reference. The rests give the bias, and the remaining angle over the turns gives the scale.
"""

from dataclasses import dataclass
import math

from gyro_calibration.calibration.likelihood import MAX_NOISE_SIGMAS, ScaleBiasFit
from gyro_calibration.calibration.run_faults import refuse_unit_error
from gyro_calibration.calibration.self_calibration import (
    find_rounding, refuse_bias, refuse_samples, refuse_scale, RunLimits)
from gyro_calibration.heading.integration import integrate
from gyro_calibration.logs.log import Array, DataRefused, DEGREE
from gyro_calibration.logs.quality import (
    quantization_step, refuse_saturated, white_noise_deviation)
from gyro_calibration.model.noise import Noise
import numpy as np
from scipy.special import ndtri

#: Standard deviation of a robot put on a mark by hand or eye, rad: a finger at half a metre.
MARK_DEVIATION = 1.0 * DEGREE
#: Shortest rest, s.
_MIN_REST_DURATION = 1.0
#: Length of the means that separate rest from motion, s; smallest deviation of motion, rad/s.
_PART_DURATION, _MIN_MOVING_RATE = 0.25, 0.5 * DEGREE
#: Largest difference between the angle and the number of turns, in turns.
_MAX_COUNT_ERROR = 0.35
#: Scale factor error up to which the turns are counted by the gyro itself, 1.
_MAX_COUNTING_SCALE_ERROR = 0.05
#: Probability of refusing by chance: two rests of equal bias, or a reference beside noise.
FALSE_REFUSAL_RATE = 1e-4


@dataclass(frozen=True)
class _TurnCalibration:
    """The result of a calibration by whole turns."""

    fit: ScaleBiasFit  # s and b with their covariance
    turns: int  # number, counter-clockwise positive
    duration: float  # from rest to rest, s
    rest_durations: tuple[float, float]  # durations of the rests at both ends, s


def calibrate_turns(time: Array, rate: Array, turns: int | None = None,
                    limits: RunLimits = RunLimits(), noise: Noise = Noise(),
                    mark_deviation: float = MARK_DEVIATION,
                    output: Array | None = None) -> _TurnCalibration:
    """
    Find scale factor error and bias from whole turns between two rests on one mark.

    Only the net number of turns matters, counter-clockwise positive; None is the nearest whole
    one. The deviation is that of the angle between the rests on the mark, rad. The rest is that of
    `self_calibrate`.
    """
    refuse_samples(time, rate, limits, output)
    output = rate if output is None else output
    refuse_saturated(output)
    # N², rad²/s: by differences between neighbours, and at least the known one
    white_density = max(white_noise_deviation(rate) ** 2 * float(np.median(np.diff(time))),
                        noise.angle_random_walk ** 2)
    step = quantization_step(output)
    begin, end = _find_turns(time, rate, white_density, step)
    rest_durations, duration = (float(begin - time[0]), float(time[-1] - end)), end - begin
    parts = np.array([time <= begin, time >= end, (time > begin) & (time < end)])
    weights = parts / parts.sum(axis=1)[:, None]
    means = weights[:2] @ rate
    # variances of their difference by white noise, and by the wander of the bias
    of_white = white_density / rest_durations[0] + white_density / rest_durations[1]
    of_wander = noise.mean_change_variance(duration, min(rest_durations))
    # of the means of both rests and of the turns, by the steps of the output at rest, since the
    # few values of a ramp may lie on a coarser grid
    at_rest = output[parts[0] | parts[1]]
    found = find_rounding(time, output, quantization_step(at_rest) or step)
    of_steps = np.zeros((3, 3)) if found is None else found.covariance(weights)
    # a bias that wanders within one code changes its error
    difference = float(means[1] - means[0])
    deviation = max(math.sqrt(of_white + of_wander + of_steps[0, 0] + of_steps[1, 1]), 1e-12)
    if abs(difference) > max(-float(ndtri(0.5 * FALSE_REFUSAL_RATE)) * deviation,
                             limits.max_rest_rate):
        raise DataRefused(
            f'the rests before and after the turns differ by {difference / DEGREE:.4f} deg/s, '
            f'{abs(difference) / deviation:.1f} standard deviations: the robot did not rest at '
            'both ends, or the gyro still warms up; wait, and run again')
    bias, variance = float(means.mean()), 0.25 * of_white + 0.5 * of_wander
    refuse_bias(bias, limits, 'let the robot rest at both ends')
    integral = np.interp((begin, end), time, integrate(time, rate))
    gyro_angle = float(integral[1] - integral[0]) - bias * duration
    count = _count_turns(gyro_angle / math.tau, turns, limits)
    scale = gyro_angle / math.tau / count
    true_angle = count * math.tau
    if abs(scale - 1.0) > limits.max_scale_factor_error:
        raise DataRefused(f'a scale factor error of {100 * (scale - 1.0):.0f} % is beyond '
                          f'{100 * limits.max_scale_factor_error:.0f} %: count the turns again, '
                          'and check the sensitivity')
    angle_variance = (white_density * duration + variance * duration ** 2
                      + (scale * mark_deviation) ** 2)
    shared = -variance * duration / true_angle
    covariance = np.array([[angle_variance / true_angle ** 2, shared], [shared, variance]])
    # s by the mean of the turns less the bias, and b
    of_means = np.array([[-0.5, -0.5, 1.0], [0.5, 0.5, 0.0]]) * [[duration / true_angle], [1.0]]
    covariance += of_means @ of_steps @ of_means.T
    return _TurnCalibration(ScaleBiasFit(scale - 1.0, bias, covariance), count, duration,
                            rest_durations)


def _count_turns(measured: float, turns: int | None, limits: RunLimits) -> int:
    """Return the whole number of turns, as given or nearest to the gyro, or refuse it."""
    count = round(measured) if turns is None else turns
    if not count:
        raise DataRefused(f'{measured:.2f} turns are left when all is added up: '
                          'turn once at least, all in one direction or nearly so')
    if turns is None and _MAX_COUNTING_SCALE_ERROR * (2 * abs(count) + 1) > 1.0:
        raise DataRefused(f'{abs(measured):.2f} turns are too many to count by a gyro that may be '
                          f'off by {100 * _MAX_COUNTING_SCALE_ERROR:g} %: give the number of '
                          'turns')
    scale = measured / count
    if turns is not None:
        # another unit or sign explains the scale; a factor of two may be a wrong count
        if abs(scale - 1.0) > limits.max_scale_factor_error and not 0.4 < abs(scale) < 2.5:
            refuse_unit_error(scale, '')
        refuse_scale(scale - 1.0, 'mark', 'clockwise turns count negative; '
                     "else set the driver's parameter invert")
    if abs(measured - count) > (_MAX_COUNT_ERROR if turns else _MAX_COUNTING_SCALE_ERROR
                                * abs(count)):
        given = f', and {turns} were given' if turns else ''
        raise DataRefused(f'the gyro counts {measured:.2f} turns{given}, which is not near one '
                          'whole number; close the turns on the mark, count them, or make fewer')
    return count


def _find_turns(time: Array, rate: Array, white_density: float,
                step: float) -> tuple[float, float]:
    """Return the times at which the turns begin and end, s, after and before the rests."""
    part = ((time - time[0]) / _PART_DURATION).astype(int)
    means = np.bincount(part, rate) / np.maximum(np.bincount(part), 1)
    # at rest, coarse samples may change by a step
    limit = max(MAX_NOISE_SIGMAS * math.sqrt(white_density / _PART_DURATION), _MIN_MOVING_RATE,
                step)
    lengths = []
    for name, values in (('before', means), ('after', means[:-1][::-1])):
        # number of means, from the first on, whose differences are within the noise
        middle = np.array([np.median(values[:end]) for end in range(1, len(values) + 1)])
        steady = int(np.argmax(np.append(np.abs(values - middle) > limit, True)))
        lengths.append((steady - 1) * _PART_DURATION)
        if lengths[-1] < _MIN_REST_DURATION:
            raise DataRefused(f'the robot rests for {max(lengths[-1], 0.0):.1f} s {name} the '
                              f'turns, wanted {_MIN_REST_DURATION:g} s at least: leave it at rest '
                              'on the mark, and record until after that')
    if sum(lengths) >= time[-1] - time[0] - 2.0 * _PART_DURATION:
        raise DataRefused('the gyro rests all the time: did the robot turn, '
                          'and does the gyro respond?')
    return float(time[0] + lengths[0]), float(time[-1] - lengths[1])
