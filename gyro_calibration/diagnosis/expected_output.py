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

from gyro_calibration.calibration.course_over_ground import MIN_LOST_SHARE
from gyro_calibration.calibration.dwell_search import find_lost_reference
from gyro_calibration.diagnosis.findings import Reference
from gyro_calibration.logs.log import Array, DEGREE, Log, Mask
from gyro_calibration.logs.quality import find_codes, robust_deviation, white_noise_deviation
from gyro_calibration.model.gyro_model import GyroModel
import numpy as np
from scipy import stats
from scipy.ndimage import uniform_filter1d
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
    return _factor_ratio(factor, 1.0) > 1.4


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


def bridge_gaps(values: Array) -> Array:
    """Return values with nan interpolated linearly."""
    known = np.isfinite(values)
    if known.all():
        return values
    places = np.arange(len(values))
    return np.interp(places, places[known], values[known])


def integrate_trapezoidal(time: Array, rate: Array) -> Array:
    """Return the integral of a rate, from 0 on, shape (n,)."""
    return np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(time))])


def integrate_with_curvature(time: Array, rate: Array) -> Array:
    """Return the integral of a rate, corrected for its curvature between samples, shape (n,)."""
    slope = np.gradient(rate, time)
    step = float(np.median(np.diff(time)))
    return integrate_trapezoidal(time, rate) - step ** 2 / 12.0 * (slope - slope[0])


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

#: Least share of the changes of an encoder heading that are not collinear with the two before; in
#: a calculated motion, rates are constant or change evenly.
_MIN_IRREGULAR_SHARE = 0.1
REFERENCE_KINDS = ('rate_command', 'encoder', 'motion_capture', 'course', 'odometry', 'gyro',
                   'rest')
#: Span over which the errors of gyro and reference are compared, s, and least ratio of the errors
#: of a course to the noise of the gyro, also for a course that is straight between fixes (measured
#: in drives: 4.6 to 920, all below 8 on straight lines between fixes; simulated odometry with
#: noise up to 0.02 deg: up to 5).
_COMPARISON_SPAN, _COURSE_NOISE_RATIO, _FIX_NOISE_RATIO = 1.0, 8.0, 2.0
#: Largest noise of an exact reference rate as a share of that of the gyro: it adds 1e-4 to the
#: variance, which logs of up to 2e8 samples do not show. Largest error of an exact reference
#: heading as a share of the difference of the headings over a second: a fifth of its variance.
_MAX_RATE_NOISE_SHARE, _MAX_HEADING_ERROR_SHARE = 0.01, 0.25
#: Largest ratio of the error of an encoder heading to its rounding error. The treatment of exact
#: references takes rounding for white noise; but it is constant at rest, and jumps by up to a step
#: when the motion resumes. Largest step, rad, at which this causes no false slips (bench: 0.0055
#: deg, 50 Hz).
_MAX_ROUNDING_RATIO, _FINE_ENCODER_STEP = 1.5, 0.01 * DEGREE
#: Largest `_evenness` of a motion for which an encoder is taken as exact.
_MAX_EVENNESS = 0.5
#: Largest number of tones, and the probability of each in noise alone.
_MAX_TONES, _TONE_CHANCE = 10, 1e-6
#: Numerical error of a heading, rad.
_NUMERICAL_ERROR = 1e-9
#: Neighbouring third differences have a correlation of -0.75 for white noise, of -0.67 for a
#: random walk, and of -0.5 for its integral, which is as smooth as a motion.
_WHITE_CORRELATION_RATIO = -0.5
#: Noise of a reference rate that is not white is detected from so many standard deviations on, in
#: this quietest share of the log, in blocks of so many samples.
_DETECTION_SIGMAS, _QUIET_SHARE, _BLOCK_SAMPLES = 3.0, 0.03, 25
#: Largest ratio of the 90 % to the 99 % quantile of the second differences of a heading that is
#: straight between fixes.
_MAX_STRAIGHT_RATIO = 0.1


def encoder_step(heading: Array) -> float:
    """Return the step of an encoder heading, rad; 0 without one or for a calculated motion."""
    known = heading[np.isfinite(heading)]
    step = find_codes(known).step
    change = np.diff(known)
    changes, differing = (np.count_nonzero(np.abs(each) > 0.5 * step)
                          for each in (change, np.diff(change, 2)))
    return step if step and differing > _MIN_IRREGULAR_SHARE * changes else 0.0


def classify_reference(log: Log, stated_kind: str | None = None) -> Reference:
    """Return the kind of the reference of a log: as stated, or found from the log."""
    if stated_kind is not None:
        return Reference(stated_kind, 'as given')
    if log.reference_rate is not None and np.isfinite(log.reference_rate).any():
        return Reference('rate_command', 'the log has a reference rate')
    heading = log.reference_heading
    if heading is None or not np.isfinite(heading).any():
        return Reference('rest', 'the log has no reference')
    lost = float(find_lost_reference(np.isfinite(heading)).mean())
    if lost > MIN_LOST_SHARE and _is_course(log):
        return Reference('course', f'the heading is lost for {100.0 * lost:.2g} % of the log, as '
                         'for a course at low speed, and its errors exceed those of the gyro')
    if step := encoder_step(heading):
        return Reference('encoder', f'the heading comes in steps of {step / DEGREE:.3g} deg')
    return Reference('motion_capture', 'the heading has no steps')


def _is_course(log: Log) -> bool:
    """Tell whether the errors of a heading are as large as those of a course over ground."""
    assert log.time is not None and log.output is not None and log.reference_heading is not None
    walk = white_noise_deviation(log.output) * math.sqrt(float(np.median(np.diff(log.time))))
    bent = np.abs(np.diff(log.reference_heading, 2))
    # a heading between slower fixes lies on straight lines
    usual, large = (np.nanquantile(bent, [0.9, 0.99]) if np.isfinite(bent).any() else (0.0, 0.0))
    larger = _FIX_NOISE_RATIO if usual < _MAX_STRAIGHT_RATIO * large else _COURSE_NOISE_RATIO
    return heading_difference(replace(log, reference_rate=None)).total_walk > larger * walk > 0.0


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
            and _evenness(log, step) > _MAX_EVENNESS):
        return True
    if not (errors.is_significant or replace(errors, constant_error=rounding).is_significant):
        return False
    return (reference.kind != 'encoder' or step > _FINE_ENCODER_STEP
            or errors.constant_error > _MAX_ROUNDING_RATIO * rounding)


def _evenness(log: Log, step: float) -> float:
    """
    Return how evenly a shaft moves through the steps of its encoder, 0 to 1.

    Rounding errors are independent from sample to sample if the rate varies. At a constant rate
    they are a sawtooth, which passes for tones, and at rest they are constant.

    """
    assert log.time is not None and log.output is not None
    interval = float(np.median(np.diff(log.time)))
    # means over a fifth of a second, as the noise of single samples is too large
    rate = uniform_filter1d(bridge_gaps(log.output),
                            max(round(0.2 * _COMPARISON_SPAN / interval), 5))
    count = max(round(2.0 * _COMPARISON_SPAN / interval), _BLOCK_SAMPLES)
    blocks = np.exp(2j * math.pi * interval / step * rate[:len(rate) // count * count])
    if not len(blocks):
        return 1.0
    return float(np.mean(np.abs(blocks.reshape(-1, count).mean(axis=1)) ** 2))


@dataclass(frozen=True)
class HeadingDifference:
    """
    Difference of the headings of gyro and reference over a second.

    Attributes
    ----------
    constant_error : standard deviation of the part that does not grow with time, rad: errors of
        the reference, of stamps, or by vibration of the gyro
    walk : angle random walk of the rest, at most that of the white noise of the gyro, rad/√s
    total_walk : angle random walk that is equivalent to the whole difference in a second, rad/√s

    """

    constant_error: float
    walk: float
    total_walk: float

    @property
    def is_significant(self) -> bool:
        """Tell whether the error is a significant part of the difference over a second."""
        return (self.constant_error > max(_MAX_HEADING_ERROR_SHARE * self.total_walk,
                                          _NUMERICAL_ERROR))


def heading_difference(log: Log) -> HeadingDifference:
    """
    Separate the difference of the headings of gyro and reference by its growth over time.

    Its second differences over a lag have the variance ``6 error² + 2 walk² lag`` after a delay,
    a lag and a scale factor of the motion are fitted. An error that was smoothed shows at lags
    beyond its time constant.

    """
    assert log.time is not None and log.output is not None
    interval, output = float(np.median(np.diff(log.time))), bridge_gaps(log.output)
    turned, heading = integrate_with_curvature(log.time, output), log.reference_heading
    slope = np.gradient(output, log.time)
    if log.reference_rate is not None and np.isfinite(log.reference_rate).any():
        rate = bridge_gaps(log.reference_rate)
        motion = np.column_stack([output, slope, np.ones(len(output))])
        heading = integrate_with_curvature(log.time, rate + _fit_tones(output - rate, motion))
    assert heading is not None
    longest = max(round(_COMPARISON_SPAN / interval), 4)
    variance = {}
    for lag in [*(2 ** np.arange(int(math.log2(longest // 4)) + 1)).tolist(), longest]:
        off, *motions = (each[2 * lag:] - 2.0 * each[lag:-lag] + each[:-2 * lag]
                         for each in (heading - turned, turned, output, slope))
        known = np.isfinite(off)
        if np.count_nonzero(known) > 2 * _BLOCK_SAMPLES:
            columns = np.column_stack(motions)[known]
            left = off[known] - columns @ np.linalg.lstsq(columns, off[known], rcond=None)[0]
            variance[lag / longest] = (float(np.quantile(np.abs(left), 0.9))
                                       / float(stats.norm.isf(0.05))) ** 2
    whole = variance.pop(1.0, 0.0)
    error = max(((each - part * whole) / (6.0 * (1.0 - part)) for part, each in variance.items()),
                default=0.0)
    error = max(error, 0.0)
    white = white_noise_deviation(log.output) * math.sqrt(interval)
    walk = math.sqrt(max(whole - 6.0 * error, 0.0) / (2.0 * _COMPARISON_SPAN))
    return HeadingDifference(math.sqrt(error), min(white, walk),
                             math.sqrt(whole / (2.0 * _COMPARISON_SPAN)))


def _fit_tones(difference: Array, motion: Array) -> Array:
    """Return the tones in the difference of gyro and reference rate, shape (n,)."""
    residual = difference - motion @ np.linalg.lstsq(motion, difference, rcond=None)[0]
    count, tones = len(residual), np.zeros(len(residual))
    for _ in range(_MAX_TONES):
        power = np.abs(np.fft.rfft(residual, 2 * count)) ** 2
        best = _BLOCK_SAMPLES + int(power[_BLOCK_SAMPLES:-2].argmax())
        level = float(np.median(power[max(best - 100, 0):best + 100])) / math.log(2.0)
        if power[best] < level * math.log(count / _TONE_CHANCE):
            break
        low, high = (float(np.sqrt(power[best + side])) for side in (-1, 1))
        place = best + 0.5 * (low - high) / (low - 2.0 * float(np.sqrt(power[best])) + high)
        phase = math.pi * place / count * np.arange(count)
        wave = np.column_stack([np.cos(phase), np.sin(phase)])
        tone = wave @ np.linalg.lstsq(wave, residual, rcond=None)[0]
        residual, tones = residual - tone, tones + tone
    return tones


def rate_noise_share(log: Log) -> float:
    """
    Return the ratio of the noise of a reference rate to that of the gyro; 0 if none is detected.

    It is estimated where the reference is quietest. White noise is detected by third differences
    of alternating sign, other noise by changes from sample to sample that the gyro does not show.

    """
    assert log.output is not None and log.reference_rate is not None
    known = np.isfinite(log.output) & np.isfinite(log.reference_rate)
    rate, output = log.reference_rate[known], log.output[known]
    if len(rate) < 100 or not np.ptp(rate) > 0.0:
        return 0.0
    line = np.polyfit(rate, output, 1)
    every, rest = np.diff(rate, 3), np.diff(output - np.polyval(line, rate), 3)
    # a quick swing may have no three blocks in a row without a reversal, but as many half as long
    fast = left = every[:0]
    for block in (_BLOCK_SAMPLES, _BLOCK_SAMPLES // 2):
        quiet = _select_quietest(every, block)
        part = every[:len(quiet)][quiet]
        if len(part) and not (len(fast) and np.mean(fast ** 2) <= 3.0 * np.mean(part ** 2)):
            fast, left = part, rest[:len(quiet)][quiet]
    if not len(fast):
        return 0.0
    energy_of_fast = float(fast @ fast)
    variance = energy_of_fast / len(fast) / 20.0
    if not (variance > 0.0
            and float(fast[1:] @ fast[:-1]) < _WHITE_CORRELATION_RATIO * energy_of_fast):
        product = -fast * left / 20.0
        # third differences of white noise are correlated over three samples
        deviation = 2.0 * float(np.std(product)) / math.sqrt(len(product))
        variance = float(np.mean(product)) / line[0]
        if not variance > _DETECTION_SIGMAS * deviation:
            return 0.0
    gyro = float(np.mean(left ** 2)) / 20.0 - variance * line[0] ** 2
    return math.sqrt(variance / max(gyro, 1e-3 * variance))


def _select_quietest(fast: Array, block: int) -> Mask:
    """Tell which third differences of a rate are in the quietest blocks."""
    blocks = len(fast) // block
    energy = np.sum(fast[:blocks * block].reshape(blocks, block) ** 2, axis=1)
    # selected by the blocks on both sides, as a block that is quiet itself may be so by chance;
    # one with far more energy than these is a motion between two rests
    sides = np.maximum(np.roll(energy, 1), np.roll(energy, -1))
    most = np.quantile(sides, min(max(_QUIET_SHARE, 8.0 / blocks), 1.0))
    return np.asarray(np.repeat((sides <= most) & (energy <= 3.0 * most), block))
