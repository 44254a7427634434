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
The output compared with the output expected from the reference, sample by sample.

The expected output is a straight line over the reference rate. Also factors and delays that result
from confused units; and the kind of the reference, and whether its errors exceed those of the
gyro.

"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
import math

from gyro_calibration.calibration.course_over_ground import (
    is_course,
    MAX_ROUNDING_RATIO,
    MAX_ROUNDING_STEP,
)
from gyro_calibration.calibration.dwells import find_lost_reference
from gyro_calibration.calibration.reference_noise import (
    encoder_step,
    heading_difference,
    rate_noise_share,
    step_evenness,
)
from gyro_calibration.diagnosis.findings import Reference
from gyro_calibration.logs.log import Array, DEGREE, Log, MAX_PLAUSIBLE_FACTOR
from gyro_calibration.logs.quality import bridge_gaps, robust_deviation, white_noise_deviation
from gyro_calibration.model.gyro_model import GyroModel
import numpy as np
from scipy import stats
from scipy.signal import savgol_filter

#: Common confusions: degrees and radians, the sense of rotation, two ranges of a gyro.
_FACTORS = {'pi/180': DEGREE, '180/pi': 1.0 / DEGREE, '2': 2.0, '1/2': 0.5}
_COMMON_FACTORS: Mapping[str, float] = {
    **_FACTORS, '-1': -1.0, **{f'-{name}': -value for name, value in _FACTORS.items()}}
#: Powers of two instead of powers of ten, and vice versa.
_BINARY_FACTORS: Mapping[str, float] = {
    **{f'{2 ** power}/1000': 2 ** power / 1000.0 for power in range(1, 17)},
    '1000/1024': 1000.0 / 1024.0, '1048576/1000000': 1.048576, '1000000/1048576': 1.0 / 1.048576}
UNIT_FACTORS: Mapping[str, float] = {**_COMMON_FACTORS, **_BINARY_FACTORS}
#: Largest ratio of the factor of a gyro to 1 in the right unit, or to the factor of another unit.
MAX_GYRO_RATIO = 1.1
#: Largest relative difference between a factor and that of a unit.
_MAX_FACTOR_ERROR = 0.005
#: Largest standard deviation of a factor as a share of its distance to 1, and of a delay as a
#: share of the sample interval.
_MAX_DEVIATION = 0.1
#: The same for a factor near 1, where a coincidence is more frequent.
_MAX_DEVIATION_NEAR_ONE = 0.02


def identify_unit_factor(factor: float, deviation: float) -> str | None:
    """
    Return the confusion of units, such as 'pi/180', that explains a factor, or None.

    Far from 1, no gyro has such a scale factor, and a scale factor error of up to a tenth is
    allowed in addition to a confusion. Near 1, the factor must agree within two standard
    deviations, and its standard deviation must be below a fiftieth of its distance from 1.

    Parameters
    ----------
    factor : ratio of the output to the reference rate, or to the output of a model
    deviation : its standard deviation

    """
    matches = []
    for name, value in UNIT_FACTORS.items():
        # far from 1 a confusion is the only explanation
        least, known = ((_MAX_FACTOR_ERROR, _MAX_DEVIATION) if is_implausible_factor(value)
                        else (1e-4, _MAX_DEVIATION_NEAR_ONE))
        if (abs(factor - value) < max(2.0 * deviation, least * abs(value))
                and abs(factor / value - 1.0) < _MAX_FACTOR_ERROR
                and deviation < known * min(abs(value - 1.0), abs(value))):
            matches.append(name)
    if matches:
        return min(matches, key=lambda name: abs(factor - UNIT_FACTORS[name]))
    distant_matches = [name for name, value in _COMMON_FACTORS.items()
                       if _factor_ratio(factor, value) < MAX_GYRO_RATIO]
    return (distant_matches[0] if distant_matches and deviation < _MAX_DEVIATION * abs(factor)
            else None)


def is_implausible_factor(factor: float) -> bool:
    """Tell whether a factor is not plausible for a gyro with the right unit."""
    return _factor_ratio(factor, 1.0) > MAX_PLAUSIBLE_FACTOR


def _factor_ratio(factor: float, value: float) -> float:
    """Return the ratio of two factors, above 1; infinite if their signs differ."""
    return math.inf if factor * value <= 0.0 else max(factor / value, value / factor)


def identify_sample_offset(estimate: float, deviation: float, interval: float) -> str | None:
    """
    Return 'one sample' or 'half a sample' if a time offset is either within 2 sigma; or None.

    Parameters
    ----------
    estimate, deviation : of the offset, s
    interval : of the samples, s

    """
    if deviation > _MAX_DEVIATION * interval:
        return None
    for name, part in (('one sample', 1.0), ('half a sample', 0.5)):
        if abs(abs(estimate) - part * interval) < max(2.0 * deviation, 1e-3 * interval):
            return name
    return None


#: Length of the parabolas by which a heading is differentiated, s; shorter ones would show its
#: quantization.
_SMOOTHING_DURATION = 0.15


@dataclass(frozen=True)
class LineFit:
    """Output = factor * rate + offset; standard deviation of the factor by scatter of parts."""

    factor: float
    offset: float
    deviation: float


@dataclass(frozen=True)
class OutputComparison:
    """
    Output and expectation, in rad/s, shape (n,).

    Attributes
    ----------
    output : without nan; gaps are interpolated
    expected : from the reference, nan in its gaps; None without a reference
    noise_deviation : standard deviation of the white noise of a sample
    deviation : standard deviation of a sample from the expected output, at least that

    """

    output: Array
    expected: Array | None
    noise_deviation: float
    deviation: float


def compare_output(output: Array, expected: Array | None) -> OutputComparison:
    """Compare an output with the expected one."""
    whole, noise = bridge_gaps(output), white_noise_deviation(output)
    if expected is None:
        return OutputComparison(whole, None, noise, noise)
    difference = (output - expected)[np.isfinite(output) & np.isfinite(expected)]
    noise = min(noise, white_noise_deviation(output - expected))
    scatter = robust_deviation(difference) if len(difference) else math.inf
    return OutputComparison(whole, expected, noise, max(noise, scatter))


def reference_rate(log: Log) -> Array | None:
    """Return the reference rate, rad/s, nan in gaps; None without a reference."""
    if log.reference_rate is not None and np.isfinite(log.reference_rate).any():
        return log.reference_rate
    if (log.reference_heading is None or log.time is None
            or np.isfinite(log.reference_heading).sum() < 2):
        return None
    known = np.isfinite(log.reference_heading)
    length = min(
        max(5, 2 * round(0.5 * _SMOOTHING_DURATION / float(np.median(np.diff(log.time)))) + 1),
        (len(known) - 1) // 2 * 2 + 1)
    if length < 3:
        return None
    smooth = savgol_filter(bridge_gaps(log.reference_heading), length, 2)
    return np.where(known, np.gradient(smooth, log.time), np.nan)


def fit_line(time: Array | None, rate: Array, output: Array) -> LineFit | None:
    """Return the line of the output over the rate by block means, or None without motion."""
    known = np.isfinite(rate) & np.isfinite(output)
    if np.count_nonzero(known) < 8 or not np.ptp(rate[known]) > 0.0:
        return None
    rate, output = rate[known], output[known]
    if time is not None:
        whole, stamps = (rate, output), time[known]
        for length in (0.5, 0.1):  # s, shorter if the motion averages out
            number = np.floor((stamps - stamps[0]) / length)
            block = np.cumsum(np.diff(number, prepend=number[0]) > 0.0)
            rate, output = (np.bincount(block, each) / np.bincount(block) for each in whole)
            if np.std(rate) > 0.8 * np.std(whole[0]):
                break
    return _fit_robust_line(rate, output) if len(rate) >= 8 else None


def model_scale_factor(model: GyroModel, rate: Array) -> float:
    """Return the slope of a model's output between the 90 % quantiles of the speed, both ways."""
    speeds = np.abs(rate[np.isfinite(rate)])
    speed = float(np.quantile(speeds, 0.9)) if speeds.size else 0.0
    if speed == 0.0:
        return 1.0
    forth, back = (float(model.output(sign * speed, model.reference_temperature))
                   for sign in (1.0, -1.0))
    return (forth - back) / (2.0 * speed)


def _fit_robust_line(rate: Array, output: Array) -> LineFit | None:
    low, high = output.min(), output.max()
    # without the ends, which may be clipped, unless most samples are there
    ends = 0.05 * (high - low)
    inliers = (output > low + ends) & (output < high - ends)
    if np.count_nonzero(inliers) < 8 or not np.ptp(rate[inliers]) > 0.3 * np.ptp(rate):
        inliers = np.ones(len(rate), dtype=bool)
    for _ in range(4):
        if np.count_nonzero(inliers) < 8 or not np.ptp(rate[inliers]) > 0.0:
            return None
        columns = np.column_stack([rate, np.ones(len(rate))])
        solution = np.linalg.lstsq(columns[inliers], output[inliers], rcond=None)[0]
        residual = output - columns @ solution
        inliers = np.abs(residual) <= 5.0 * robust_deviation(residual) + 1e-15
    # the standard deviation by the scatter of up to 20 parts, as the noise is coloured
    columns, residual = columns[inliers], residual[inliers]
    count = len(residual)
    pieces = np.minimum(np.arange(count) * min(20, count // 2) // count, 19)
    scores = np.array([np.bincount(pieces, column * residual) for column in columns.T])
    inverse = np.linalg.pinv(columns.T @ columns)
    student = stats.t.ppf(0.975, scores.shape[1] - 1) / stats.norm.ppf(0.975)
    # of an exact line it is below 0 by rounding
    variance = (inverse @ scores @ scores.T @ inverse)[0, 0]
    deviation = student * math.sqrt(max(variance, 0.0))
    return LineFit(float(solution[0]), float(solution[1]), float(deviation))


# the kind of the reference

REFERENCE_KINDS = ('rate_command', 'encoder', 'motion_capture', 'course', 'odometry', 'gyro',
                   'rest')
#: Largest noise of an exact reference rate as a share of that of the gyro: it adds 1e-4 to the
#: variance, which logs of up to 2e8 samples do not show.
_MAX_RATE_NOISE_SHARE = 0.01
#: The treatment of exact references takes the rounding of an encoder for white noise; but it is
#: constant at rest, and jumps by up to a step when the motion resumes. Largest step, rad, at which
#: this causes no false slips (bench: 0.0055 deg, 50 Hz).
_FINE_ENCODER_STEP = 0.01 * DEGREE
#: Largest `step_evenness` of a motion for which an encoder is taken as exact.
_MAX_EVENNESS = 0.5


def classify_reference(log: Log, stated_kind: str | None = None) -> Reference:
    """Return the kind of the reference of a log: as stated, or found from the log."""
    if stated_kind is not None:
        return Reference(stated_kind, 'as given')
    if log.reference_rate is not None and np.isfinite(log.reference_rate).any():
        return Reference('rate_command', 'the log has a reference rate')
    heading = log.reference_heading
    if heading is None or not np.isfinite(heading).any():
        return Reference('rest', 'the log has no reference')
    if is_course(log):
        lost = 100.0 * float(find_lost_reference(np.isfinite(heading)).mean())
        return Reference('course', f'the heading is lost for {lost:.2g} % of the log, as '
                         'for a course at low speed, and its errors exceed those of the gyro')
    step = encoder_step(heading)
    if step >= MAX_ROUNDING_STEP or step and not _is_decimal(step):
        return Reference('encoder', f'the heading comes in steps of {step / DEGREE:.3g} deg')
    return Reference('motion_capture', 'the heading has no steps of an encoder')


def _is_decimal(step: float) -> bool:
    """Tell whether a step is a power of ten of a rad or a deg, as the last digit of a file."""
    powers = np.log10([step, step / DEGREE])
    return bool(np.abs(powers - np.rint(powers)).min() < 1e-4)


def is_reference_limiting(log: Log, reference: Reference) -> bool:
    """Tell whether the errors of the reference, not those of the gyro, limit a diagnosis."""
    if log.time is None or log.output is None or reference.kind == 'rest':
        return False
    if reference.kind == 'rate_command' or log.reference_heading is None:
        return log.reference_rate is not None and (rate_noise_share(log) > _MAX_RATE_NOISE_SHARE
                                                   or heading_difference(log).is_significant)
    if reference.kind == 'course' or reference.evidence == 'as given':
        return True
    errors, step = heading_difference(log), encoder_step(log.reference_heading)
    # the rounding error of an encoder does not show while its shaft rests
    rounding = step / math.sqrt(12.0)
    interval = float(np.median(np.diff(log.time)))
    rate_rounding = math.sqrt(2.0) * rounding / interval
    if (rate_rounding > _MAX_RATE_NOISE_SHARE * white_noise_deviation(log.output)
            and step_evenness(log, step) > _MAX_EVENNESS):
        return True
    if not (errors.is_significant or replace(errors, constant_error=rounding).is_significant):
        return False
    return (reference.kind != 'encoder' or step > _FINE_ENCODER_STEP
            or errors.constant_error > MAX_ROUNDING_RATIO * rounding)
