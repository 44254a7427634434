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
Checks of a record for faults that are not errors of the gyro.

Faults are reported, and the samples concerned are not used; no fault is fitted.

The false-alarm rate for a log without faults is at most 1e-3: each of the five tests (lost
samples, repeated samples, outliers, a limit on either side) has a level of 2e-4. Quantization and
units are reported if they are large enough to matter.

"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
import math

from gyro_calibration.calibration.course_over_ground import MIN_LOST_SHARE
from gyro_calibration.calibration.dwell_search import find_lost_reference, require_output
from gyro_calibration.diagnosis.causes import CAUSES, make_finding
from gyro_calibration.diagnosis.expected_output import (
    bridge_gaps,
    compare_output,
    fit_line,
    identify_unit_factor,
    integrate_with_curvature,
    is_implausible_factor,
    LineFit,
    model_scale_factor,
    OutputComparison,
    reference_rate,
    UNIT_FACTORS,
)
from gyro_calibration.diagnosis.findings import Estimate, Finding, Reference
from gyro_calibration.diagnosis.gates import resample_reference, select_reference
from gyro_calibration.diagnosis.samples import (
    find_dead_band,
    find_limit,
    find_outliers,
    find_repeated_samples,
    Limit,
    NEIGHBOURS_PER_SIDE,
    Outliers,
    RepeatedSamples,
)
from gyro_calibration.logs.log import Array, DataRefused, DEGREE, Log, Mask, NORMAL_QUANTILE_975
from gyro_calibration.logs.quality import (
    find_codes,
    QuantizationCodes,
    robust_deviation,
    white_noise_deviation,
)
from gyro_calibration.logs.stamps import fit_stamp_grid, StampGrid
from gyro_calibration.model.gyro_model import GyroModel
import numpy as np
from scipy import stats
from scipy.ndimage import binary_dilation, uniform_filter1d

#: False-alarm probability of each check.
FALSE_ALARM_CHANCE = 2e-4
#: Least step of codes that matters, as a share of the white noise; the same for a step of the
#: reference, as a share of the variance.
MIN_STEP_NOISE_RATIO, MIN_STEP_VARIANCE_SHARE = 0.2, 0.02
#: Samples whose expected output is within so many standard deviations of a limit are not used,
#: because noise determines whether they are clipped.
_LIMIT_MARGIN_SIGMAS = 4.0
#: Least share of the changes of an encoder heading that are not collinear with the two before; in
#: a calculated motion, rates are constant or change evenly.
_MIN_IRREGULAR_SHARE = 0.1


@dataclass(frozen=True)
class DataQuality:
    """
    Faults of a record, and the samples to use.

    Attributes
    ----------
    findings : one for each cause
    remarks : for people, one sentence each
    usable : the samples to use, shape (n,)
    unit_factor : by which the output is multiplied to be in rad/s; 1 if the unit is right
    limit : largest absolute output, rad/s after the factor; None without a limit
    output_step : quantization step of the output, rad/s after the factor; 0 if it does not matter
    heading_step : quantization step of the reference heading, rad; 0 without one
    update_interval : of a reference that is held in between, s; None if it is new in each sample

    """

    findings: tuple[Finding, ...]
    remarks: tuple[str, ...]
    usable: Mask
    unit_factor: float = 1.0
    limit: float | None = None
    output_step: float = 0.0
    heading_step: float = 0.0
    update_interval: float | None = None


def inspect_record(log: Log, model: GyroModel | None = None) -> DataQuality:
    """
    Check a record.

    Parameters
    ----------
    log : with output; of a rate table without time only the unit is checked
    model : of the simulation; its quantization and saturation are no findings

    """
    log, notes = select_reference(log)
    output, rate = require_output(log), reference_rate(resample_reference(log))
    has_output = np.isfinite(output)
    line = None if rate is None else fit_line(log.time, rate, output)
    factor, units = 1.0, []
    if rate is not None and line is not None:
        # a factor in addition to the scale factor of the model
        own = 1.0 if model is None else model_scale_factor(model, rate)
        ratio, deviation = line.factor / own, line.deviation / abs(own)
        name = identify_unit_factor(ratio, deviation)
        if name is not None:
            factor = 1.0 / UNIT_FACTORS[name]
            units = [_sized_finding(
                'unit_error', ratio, NORMAL_QUANTILE_975 * deviation,
                float(2.0 * stats.norm.sf(abs(ratio - 1.0) / max(deviation, 1e-300))),
                f'the output is {ratio:.5g} +- {deviation:.2g} times the reference, and '
                f'{name} is {UNIT_FACTORS[name]:.5g}',
                () if is_implausible_factor(ratio) else ('scale_factor_error',))]
    found = DataQuality(tuple(units), notes, has_output, factor)
    if log.time is None:
        return found
    found = _check_stamps(found, log, has_output)
    found = _check_reference(found, log)
    line = None if line is None else LineFit(line.factor * factor, line.offset * factor,
                                             line.deviation * abs(factor))
    return _check_samples(found, output * factor, rate, line, model, has_output, log)


def resolve_unit(quality: DataQuality) -> DataQuality:
    """Return the treatment of the unit; a factor that a gyro may have is a scale factor error."""
    if quality.unit_factor == 1.0:
        return quality
    if is_implausible_factor(quality.unit_factor):
        note = (f'The output was multiplied by {quality.unit_factor:.6g} first, and a new model '
                'applies to the corrected output: correct the unit or the sign of the log (its '
                'column, --sensitivity, --invert) before it is compensated.')
        return replace(quality, remarks=(*quality.remarks, note))
    note = (f'The output was not multiplied by {quality.unit_factor:.6g}, as this factor may '
            'belong to the gyro: a new model contains it as a scale factor error.')
    return replace(quality, unit_factor=1.0, output_step=quality.output_step / quality.unit_factor,
                   limit=None if quality.limit is None else quality.limit / quality.unit_factor,
                   remarks=(*quality.remarks, note))


def _sized_finding(name: str, value: float, half_width: float, p_value: float, evidence: str,
                   confounders: Sequence[str] = ()) -> Finding:
    return make_finding(
        name, {name: Estimate.from_half_width(float(value), half_width, CAUSES[name].unit)},
        p_value, confounders, evidence=evidence)


def _check_stamps(found: DataQuality, log: Log, has_output: Mask) -> DataQuality:
    """Check the stamps: lost samples are a finding; bursts and clock drift are remarks."""
    assert log.time is not None
    without = np.count_nonzero(~has_output)
    remarks = [f'{without} samples have no output, and are left out.'] if without else []
    try:
        stamps = fit_stamp_grid(log.time)
    except DataRefused as refused:
        return replace(found, remarks=(*found.remarks, *remarks,
                                       f'Lost samples cannot be counted: {refused}.'))
    found = replace(found, remarks=(*found.remarks, *remarks, *stamps.burst_remarks,
                                    *_interval_drift_remarks(stamps)))
    lost, steps = stamps.lost_after, np.diff(stamps.time)
    if not lost.any():
        return found
    jitter = robust_deviation(steps - np.median(steps)) + 1e-9 * stamps.interval
    late = (lost.max() - 0.5) * stamps.interval / jitter
    chance = min(1.0, len(steps) * float(stats.norm.sf(late)))
    return found if chance >= FALSE_ALARM_CHANCE else replace(
        found, findings=(*found.findings,
                         _sized_finding('dropped_samples', int(lost.sum()), 0.0, chance,
                                        stamps.loss_remarks[0].rstrip('.'))))


def _interval_drift_remarks(stamps: StampGrid) -> Iterator[str]:
    """Give a remark if the interval differs between the ends of the log by more than jitter."""
    number = np.arange(len(stamps.time)) + np.concatenate([[0], np.cumsum(stamps.lost_after)])
    third = len(number) // 3
    if third < 30:
        return
    intervals, deviations = [], []
    for part in (slice(0, third), slice(-third, None)):
        line = np.polyfit(number[part], stamps.time[part] - stamps.time[part][0], 1)
        off = np.std(stamps.time[part] - stamps.time[part][0] - np.polyval(line, number[part]))
        intervals.append(line[0])
        deviations.append(off / np.ptp(number[part]))
    change = intervals[1] / intervals[0] - 1.0
    if abs(change) > max(1e-5, 6.0 * np.hypot(*deviations) / stamps.interval):
        yield (f'The interval of the samples changes by {1e6 * change:+.0f} ppm from the first to '
               'the last third of the log.')


def _check_reference(found: DataQuality, log: Log) -> DataQuality:
    """Check the reference for quantization of its heading and for held values."""
    assert log.time is not None
    heading = log.reference_rate is None and log.reference_heading is not None
    values = log.reference_heading if heading else log.reference_rate
    if values is None or np.count_nonzero(np.isfinite(values)) < 3:
        return found
    step = encoder_step(values) if heading else 0.0
    update = update_interval(log.time, values, step)
    note = [f'The reference is updated every {1000.0 * update:.4g} ms, and held in between; '
            'it is interpolated.'] if update else []
    return replace(found, heading_step=step, update_interval=update,
                   remarks=(*found.remarks, *note))


def encoder_step(heading: Array) -> float:
    """Return the step of an encoder heading, rad; 0 without one or for a calculated motion."""
    known = heading[np.isfinite(heading)]
    step = find_codes(known).step
    change = np.diff(known)
    changes, differing = (np.count_nonzero(np.abs(each) > 0.5 * step)
                          for each in (change, np.diff(change, 2)))
    return step if step and differing > _MIN_IRREGULAR_SHARE * changes else 0.0


def update_interval(time: Array, values: Array, step: float) -> float | None:
    """Return the interval between updates of a held reference, s; None if each sample is new."""
    change = np.diff(values)
    renewed = np.flatnonzero(np.isfinite(change) & (change != 0.0))
    # Changes of less than a step may be lost.
    fast = np.abs(change[renewed[1:]]) > 2.5 * step
    gaps = np.diff(renewed)[fast]
    if len(gaps) < 20 or np.quantile(gaps, 0.1) < 2.0:
        return None
    usual = int(np.median(gaps))
    regular = np.abs(gaps - usual) <= 1
    return float(gaps[regular].mean() * np.median(np.diff(time))) if regular.mean() > 0.8 else None


def _check_samples(found: DataQuality, output: Array, rate: Array | None, line: LineFit | None,
                   model: GyroModel | None, has_output: Mask, log: Log) -> DataQuality:
    """Check the samples of the gyro for quantization, limits, repeats and outliers."""
    codes, comparison = find_codes(output[has_output]), compare_output(output, rate, line)
    limit = find_limit(codes, comparison, FALSE_ALARM_CHANCE)
    at_limit = (np.zeros(len(output), dtype=bool) if limit is None
                else limit.is_reached(comparison.output))
    valid, band = has_output & ~at_limit, find_dead_band(codes, comparison.output)
    repeated = find_repeated_samples(comparison, codes, band, valid, FALSE_ALARM_CHANCE)
    if repeated is not None and repeated.includes_limit_run(at_limit):
        limit, at_limit, valid = None, np.zeros_like(at_limit), has_output
        repeated = find_repeated_samples(comparison, codes, band, valid, FALSE_ALARM_CHANCE)
    valid = valid if repeated is None else valid & ~repeated.is_repeat
    # Samples next to a dead band are the tail of the noise outside it.
    tested = valid if band is None else valid & ~binary_dilation(
        band.contains(comparison.output), iterations=NEIGHBOURS_PER_SIDE)
    outlying = find_outliers(comparison, tested, 0.5 * codes.step, FALSE_ALARM_CHANCE)
    valid = valid if outlying is None else valid & ~outlying.is_outlier
    away_from_limit = np.ones(len(output), dtype=bool)
    if limit is not None and comparison.expected is not None:
        # by the expected output: a selection by the measured output would be biased by its noise
        near = _LIMIT_MARGIN_SIGMAS * max(comparison.noise_deviation, comparison.scatter)
        away_from_limit = ~(
            (comparison.expected > limit.high - near) | (comparison.expected < limit.low + near))
    findings = (*found.findings, *_code_findings(codes, comparison, limit, at_limit, model),
                *_sample_findings(repeated, outlying, log, found.heading_step,
                                  comparison.noise_deviation))
    matters = codes.step >= MIN_STEP_NOISE_RATIO * comparison.noise_deviation
    return replace(found, findings=findings, usable=valid & away_from_limit,
                   limit=None if limit is None else limit.size,
                   output_step=codes.step if matters else 0.0)


def _is_in_model(model: GyroModel | None, name: str, value: float) -> bool:
    """Tell whether a model has an effect on the signal with this value, to 2 %."""
    terms = () if model is None else model.terms
    return any(term.effect.name == name and abs(term.values[0] / value - 1.0) < 0.02
               for term in terms)


def _code_findings(codes: QuantizationCodes, comparison: OutputComparison, limit: Limit | None,
                   at_limit: Mask, model: GyroModel | None) -> Iterator[Finding]:
    """Give quantization and saturation of the output, unless they are in the model."""
    if (codes.step >= MIN_STEP_NOISE_RATIO * comparison.noise_deviation and codes.step
            and not _is_in_model(model, 'quantization', codes.step)):
        chance = float(np.exp(-min(codes.counts.sum() * codes.alignment ** 2, 700.0)))
        yield _sized_finding(
            'quantization', codes.step, NORMAL_QUANTILE_975 * codes.step_deviation, chance,
            f'the output has {len(codes.values)} codes, {codes.step / DEGREE:.4g} deg/s apart, '
            f'where its white noise is {comparison.noise_deviation / DEGREE:.3g} deg/s')
    if limit is not None and not _is_in_model(model, 'saturation', limit.size):
        sides = [f'{value / DEGREE:.5g} deg/s' for value in (limit.low, limit.high)
                 if np.isfinite(value)]
        yield _sized_finding('saturation', limit.size, 0.0, limit.p_value,
                             f'{np.count_nonzero(at_limit)} samples '
                             f'({100.0 * at_limit.mean():.2g} %) have the extreme code '
                             f'{" or ".join(sides)}')


def _sample_findings(repeated: RepeatedSamples | None, outlying: Outliers | None, log: Log,
                     reference_step: float, noise_deviation: float) -> Iterator[Finding]:
    """Give repeated samples, outliers, and the step of the reference if it adds much variance."""
    assert log.time is not None
    if repeated is not None:
        count = int(np.count_nonzero(repeated.is_repeat))
        first = log.time[int(np.argmax(repeated.is_repeat))]
        yield _sized_finding('stuck_samples', count, 0.0, repeated.p_value,
                             f'{count} samples in {repeated.run_count} runs repeat the one '
                             f'before, the first at {first:.3f} s; codes and noise explain '
                             f'{repeated.expected_count:.2g} repeats in the whole log')
    if outlying is not None:
        count = int(np.count_nonzero(outlying.is_outlier))
        first = log.time[int(np.argmax(outlying.is_outlier))]
        yield _sized_finding('outliers', count, 0.0, outlying.p_value,
                             f'{count} single samples differ from their neighbours by up to '
                             f'{outlying.largest_sigmas:.0f} sigma, the first at {first:.3f} s')
    interval = float(np.median(np.diff(log.time)))
    noise = interval * noise_deviation
    if reference_step and (
            not noise or reference_step ** 2 / 6.0 / noise ** 2 > MIN_STEP_VARIANCE_SHARE):
        yield _sized_finding('reference_quantization', reference_step, 0.0, 0.0,
                             'the reference heading comes in steps of '
                             f'{reference_step / DEGREE:.4g} deg: its rate over one sample is '
                             'uncertain by '
                             f'{reference_step / np.sqrt(6.0) / interval / DEGREE:.3g} deg/s, '
                             f'where the gyro has {noise_deviation / DEGREE:.3g} deg/s of noise')


# the kind of the reference

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
