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

Codes are the values of a digital output, with their step, the dead band about zero, and the limit.
Repeated samples have the value of the sample before, more often than coarse codes explain.
Outliers are samples far from their neighbours that motion does not explain. Faults are reported,
and the samples concerned are not used; no fault is fitted.

The false-alarm rate for a log without faults is at most 1e-3: each of the five tests (lost
samples, repeated samples, outliers, a limit on either side) has a level of 2e-4. Quantization and
units are reported if they are large enough to matter.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
import math
from typing import Any

from gyro_calibration.calibration.dwells import OUTLIER_THRESHOLD, require_output
from gyro_calibration.diagnosis.causes import CAUSES, make_finding
from gyro_calibration.diagnosis.findings import Estimate, Finding
from gyro_calibration.diagnosis.gates import (
    compare_headings, compare_output, fit_line, identify_unit_factor, is_implausible_factor,
    LineFit, model_scale_factor, OutputComparison, reference_angle, reference_rate,
    resample_reference, select_reference, spline_rate, UNIT_FACTORS)
from gyro_calibration.logs.log import Array, DataRefused, DEGREE, Log, Mask, NORMAL_QUANTILE_975
from gyro_calibration.logs.quality import (
    bridge_gaps, encoder_step, find_codes, find_runs, QuantizationCodes, robust_deviation)
from gyro_calibration.logs.stamps import fit_stamp_grid
from gyro_calibration.model.gyro_model import GyroModel
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy import stats
from scipy.ndimage import binary_dilation, maximum_filter1d
from scipy.special import ndtr

#: False-alarm probability of each check.
FALSE_ALARM_CHANCE = 2e-4
#: Least step of codes that matters, as a share of the white noise; the same for a step of the
#: reference, as a share of the variance.
_MIN_STEP_NOISE_RATIO, _MIN_STEP_VARIANCE_SHARE = 0.2, 0.02
#: Least number of separate runs of an extreme code, which a repetition fault does not cause.
_MIN_LIMIT_RUNS = 3
#: Output of a rest, as a share of the largest; a limit is higher, and a dead band is lower.
_REST_RATE_SHARE = 0.1
#: Number of classes of motion, by the expected change near a sample.
_MOTION_CLASSES = 8
#: Probability of a repeat from which on single repeats of a coarse output are not tested, and up
#: to which they are marked as a fault.
_COARSE_REPEAT_CHANCE, _RARE_REPEAT_CHANCE = 0.3, 0.02
#: A deviation that noise reaches rarely, in standard deviations: from there to that of outliers
#: there are at most half as many samples as outliers, as more are a tail of the noise, and samples
#: whose expected output is as near to a limit are not used, as noise determines whether they are
#: clipped.
_RARE_SIGMAS = 4.5
#: Numbers of neighbours on each side with which a sample is compared, of samples between a jolt in
#: the output and in the reference, of samples in a block of constant scatter, and of consecutive
#: outliers, at most.
_NEIGHBOURS_PER_SIDE, _JOLT_SAMPLES, _SCATTER_BLOCK_SAMPLES, _MAX_OUTLIER_RUN = 3, 10, 256, 2


# codes

def _local_code_steps(codes: QuantizationCodes, output: Array) -> Array:
    """
    Return an upper bound of the step of codes near each value, shape (n,).

    Steps grow with the values of 32-bit floats and of decimals with a number of significant
    digits.
    """
    steps = np.full(len(output), max(
        codes.step, float(np.diff(codes.values).min()) if len(codes.values) > 1 else 1.0))
    sides = {sign: np.sort(sign * codes.values[sign * codes.values >= 0.0])
             for sign in (1.0, -1.0)}
    finest = min(float((np.diff(sizes) / sizes[1:]).min(initial=np.inf))
                 for sizes in sides.values())
    for sign, sizes in sides.items():
        if len(sizes) > 1:
            side = sign * output >= 0.0
            closest = np.minimum.accumulate(np.diff(sizes)[::-1])[::-1]
            place = np.minimum(np.searchsorted(sizes, sign * output[side]), len(closest) - 1)
            steps[side] = np.maximum(
                steps[side],
                np.minimum(closest[place], 10.0 * finest * np.abs(output[side])))
    return steps


@dataclass(frozen=True)
class _DeadBand:
    """A frequent value without other values near it."""

    value: float  # rad/s
    half_width: float  # distance of the nearest other value, rad/s

    def contains(self, output: Array) -> Mask:
        """Mark the samples in it."""
        return np.abs(output - self.value) < 0.5 * self.half_width

    def membership_chance(self, comparison: OutputComparison) -> Array:
        """Return the chance of each sample to be in it, by its expected output, or by a rest."""
        rest = (np.full(len(comparison.output), np.median(comparison.output))
                if comparison.expected is None else comparison.expected)
        off = np.nan_to_num(rest - self.value)
        deviation = max(comparison.deviation, 1e-9 * self.half_width)
        reach = self.half_width + 2.0 * deviation
        return ndtr((reach - off) / deviation) - ndtr((-reach - off) / deviation)


def _find_dead_band(codes: QuantizationCodes, output: Array) -> _DeadBand | None:
    """Return the dead band of an output, or None where it shows none."""
    counts = np.where(np.abs(codes.values) < _rest_rate_limit(output), codes.counts, 0)
    place = int(np.argmax(counts))
    away = np.abs(np.delete(codes.values, place) - codes.values[place])
    band = _DeadBand(float(codes.values[place]), float(away.min(initial=np.inf)))
    runs = np.count_nonzero(np.diff(band.contains(output), prepend=False, append=False)) // 2
    return (band if counts[place] > 1 and runs > 1
            and band.half_width > 1.5 * codes.step else None)


def _rest_rate_limit(output: Array) -> float:
    """Return the largest absolute output of a rest, by a quantile that excludes outliers."""
    return _REST_RATE_SHARE * float(np.quantile(np.abs(output), 0.99))


@dataclass(frozen=True)
class _Limit:
    """Largest and smallest code of a saturated output."""

    # low, high: the limit on each side, infinite where there is none
    low: float
    high: float
    p_value: float  # the chance that an output without one repeats its extreme codes as often

    @property
    def size(self) -> float:
        """Return the limit as a rate without sign."""
        return min(-self.low, self.high)

    def is_reached(self, output: Array) -> Mask:
        """Mark the samples at the limit."""
        slack = 1e-9 * self.size
        return (output >= self.high - slack) | (output <= self.low + slack)


def _find_limit(codes: QuantizationCodes, comparison: OutputComparison,
                level: float) -> _Limit | None:
    """
    Return the limit of an output, or None, by a test of this level on each side.

    An extreme code is a limit if it is larger than the output at rest; if it is more frequent than
    its neighbours, which are more frequent without a limit; and if the expected output is beyond
    it, which is not so for a coarse code at a constant rate.
    """
    chances, (low, high) = {}, codes.values[[0, -1]].tolist()
    deviation, noise = comparison.deviation, comparison.noise_deviation
    fine = codes.step < _MIN_STEP_NOISE_RATIO * noise
    for sign in (1.0, -1.0):
        values, counts = ((codes.values, codes.counts) if sign > 0.0
                          else (-codes.values[::-1], codes.counts[::-1]))
        extreme, step = values[-1], float(_local_code_steps(codes, sign * values[-1:])[0])
        # the chance of as many samples at the last code, if the density falls towards it
        reach = max(4.0 * step, 0.05 * noise)
        near = int(counts[:-1][values[:-1] > extreme - reach - 0.5 * step].sum())
        chance = float(stats.binom.sf(counts[-1] - 2, counts[-1] - 1 + near,
                                      1.0 / (min(reach / step, 1e6) + 1.0)))
        if chance >= level or extreme <= _rest_rate_limit(comparison.output):
            continue
        at_extreme = sign * comparison.output >= extreme - 1e-9 * abs(extreme)
        # a limit on either side counts the runs of both
        both = (_Limit(low, high, chance).is_reached(comparison.output)
                if abs(low + high) < 1.5 * step else at_extreme)
        expected = (np.array([]) if comparison.expected is None
                    else sign * comparison.expected[at_extreme])
        beyond = (float(np.nanmedian(expected)) - extreme if np.isfinite(expected).any()
                  else -math.inf)
        # The expected output errs by bias wander and nonlinearity, which these samples share.
        if (beyond > (-3.0 * deviation if fine else 0.5 * codes.step + 2.0 * deviation)
                or fine and len(find_runs(both)) >= _MIN_LIMIT_RUNS):
            chances[sign] = (sign * extreme, chance)
    if not chances:
        return None
    return _Limit(chances.get(-1.0, (-np.inf, 1.0))[0], chances.get(1.0, (np.inf, 1.0))[0],
                  min(chance for _, chance in chances.values()))


# repeated samples

@dataclass(frozen=True)
class _SampleFault:
    """Faulty samples."""

    is_faulty: Mask  # mask of the samples, shape (n,)
    p_value: float  # of their number, or of the length of a run
    sigmas: float = 0.0  # largest deviation of outliers in standard deviations


def _find_repeated_samples(comparison: OutputComparison, codes: QuantizationCodes,
                           band: _DeadBand | None, valid: Mask,
                           level: float) -> _SampleFault | None:
    """Find repeated samples among valid ones, or return None."""
    known, change = valid[1:] & valid[:-1], np.diff(comparison.output)
    same = (change == 0.0) & known
    expected = (np.zeros(len(change)) if comparison.expected is None
                else np.nan_to_num(np.diff(comparison.expected)))
    if not same.any():
        return None
    width = _local_code_steps(codes, comparison.output[:-1])
    chance = _repeat_chances(change, expected, width, known)
    if band is not None:  # a sample in it repeats while the next is due in it
        within = band.contains(comparison.output[:-1])
        chance = np.where(
            within, np.maximum(chance, band.membership_chance(comparison)[1:]), chance)
        width = np.where(within, 2.0 * band.half_width, width)
    repeats, p_value, by_run = np.zeros(len(valid), dtype=bool), 1.0, 1.0
    rare = (chance < _COARSE_REPEAT_CHANCE) & known
    excess, expected_count = int(np.count_nonzero(same & rare)), float(chance[rare].sum())
    by_number = float(stats.poisson.sf(excess - 1, expected_count))
    if by_number < level and excess > 1.5 * expected_count:
        repeats[1:], p_value = same & (chance < _RARE_REPEAT_CHANCE), by_number
    product, travel = (np.concatenate([[0.0], np.cumsum(each)])
                       for each in (np.log(np.maximum(chance, 1e-12)), expected))
    for run in find_runs(same):
        if run.stop - run.start < 2:
            continue
        if chance[run].max() < _COARSE_REPEAT_CHANCE:
            unlikely = math.exp(max(product[run.stop] - product[run.start], -700.0))
        else:
            # Repeats of a coarse code depend on each other: a fault only if it should have left.
            left = abs(travel[run.stop] - travel[run.start]) - width[run.start]
            unlikely = float(2.0 * stats.norm.sf(
                left / (math.sqrt(2.0) * comparison.deviation))) if left > 0.0 else 1.0
        if unlikely * len(valid) < level:
            repeats[run.start + 1:run.stop + 1] = True
            by_run = min(by_run, unlikely * len(valid))
    if not repeats.any():
        return None
    return _SampleFault(repeats, min(by_run, p_value))


def _repeat_chances(change: Array, expected: Array, step: Array, known: Mask) -> Array:
    """
    Return an upper bound of the probability of each repeat, shape (n - 1,).

    That of a change by less than a step for the scatter of changes of similar expectation, and no
    less than the share of changes by one code or two, each way.
    """
    chances, classes = np.ones(len(change)), _motion_classes(np.abs(expected))
    for each in np.unique(classes):
        members = np.flatnonzero((classes == each) & known)
        if len(members):
            due, steps, size = expected[members], step[members], np.abs(change[members])
            # zeros count: with many, the codes are coarse
            scale = np.maximum(_robust_quantile(np.abs(change[members] - due)), 1e-9 * steps)
            count = np.count_nonzero((size > 0.5 * steps) & (size < 2.5 * steps))
            chances[members] = np.maximum(
                ndtr((steps - due) / scale) - ndtr((-steps - due) / scale),
                (count + 2.0 * np.sqrt(count)) / 4.0 / len(size))
    return chances


def _motion_classes(motion: Array) -> NDArray[np.intp]:
    """Return the class of each sample, with as many samples in each class, by its motion."""
    edges = np.quantile(motion, np.linspace(0.0, 1.0, _MOTION_CLASSES + 1)[1:-1])
    return np.searchsorted(np.unique(edges), motion, side='left')


def _robust_quantile(off: Array) -> float:
    """Return a robust standard deviation of magnitudes."""
    return float(np.quantile(off, 0.6827)) if off.size else 0.0


# outliers

def _find_outliers(comparison: OutputComparison, valid: Mask, min_scatter: float,
                   level: float) -> _SampleFault | None:
    """Find outliers among valid samples, or return None; `min_scatter` is half a code."""
    measured = output = bridge_gaps(np.where(valid, comparison.output, np.nan))
    # more for very long logs
    limit = max(OUTLIER_THRESHOLD, float(stats.norm.isf(0.25 * level / len(output))))
    # how much the output is expected to change about each sample, and how far it jumps
    expected: Array = np.zeros(len(output))
    expected_change = jumps = expected
    if comparison.expected is not None and np.isfinite(comparison.expected).any():
        expected = bridge_gaps(comparison.expected)
        output = output - expected
        padded = np.pad(expected, 2 * _NEIGHBOURS_PER_SIDE, mode='edge')
        expected_change = np.ptp(sliding_window_view(padded, 4 * _NEIGHBOURS_PER_SIDE + 1), axis=1)
        # from the cubic through two samples on each side
        by_cubic = np.abs(np.diff(np.pad(expected, 2, mode='edge'), 4)) / 6.0
        jumps = maximum_filter1d(by_cubic, 2 * _JOLT_SAMPLES + 1)
    off = _distance_to_median(output)
    sigmas = _outlier_sigmas(output, off, expected_change, valid, min_scatter)
    # an outlier is one among samples of the same rate too, and in the output itself
    sigmas *= np.minimum(_distance_to_median(output, np.argsort(expected, kind='stable'))
                         / np.maximum(off, 1e-300), 1.0)
    sigmas[_distance_to_parabola(measured) < 0.5 * off] = 0.0
    # near a jump of the reference of half the size: a jolt, or the reference is outlying
    sigmas[jumps > 0.5 * off] = 0.0
    missing = np.count_nonzero(_neighbour_samples(~valid), axis=1)
    tested = valid & (missing < _NEIGHBOURS_PER_SIDE)
    outlying = (sigmas > limit) & tested
    for run in find_runs(outlying):
        outlying[run] = run.stop - run.start <= _MAX_OUTLIER_RUN
    count = int(np.count_nonzero(outlying))
    near = int(np.count_nonzero((sigmas > _RARE_SIGMAS) & (sigmas <= limit) & tested))
    usual = stats.poisson.isf(0.01, 2.0 * len(output) * stats.norm.sf(_RARE_SIGMAS))
    if not count or near > 0.5 * count + usual:
        return None
    p_value = float(stats.poisson.sf(count - 1, 4.0 * len(output) * stats.norm.sf(limit)))
    return (_SampleFault(outlying, p_value, float(sigmas[outlying].max())) if p_value < level
            else None)


def _windows(values: NDArray[Any]) -> tuple[NDArray[Any], NDArray[np.intp]]:
    """Return the seven samples about each one, the outer ones at the ends, and its place there."""
    size, index = 2 * _NEIGHBOURS_PER_SIDE + 1, np.arange(len(values))
    first = np.clip(index - _NEIGHBOURS_PER_SIDE, 0, len(values) - size)
    return sliding_window_view(values, size)[first], index - first


def _neighbour_samples(values: NDArray[Any]) -> NDArray[Any]:
    """Return the samples before and after each one, the next six at the ends, shape (n, 6)."""
    window, place = _windows(values)
    size = window.shape[1]
    return window[np.arange(size) != place[:, None]].reshape(-1, size - 1)


def _distance_to_median(values: Array, order: NDArray[np.intp] | None = None) -> Array:
    """Return how far each sample is from the median of its neighbours, in time or in an order."""
    if order is None:
        return np.abs(values - np.median(_neighbour_samples(values), axis=1))
    distance = np.empty(len(values))
    distance[order] = _distance_to_median(values[order])
    return distance


def _distance_to_parabola(values: Array) -> Array:
    """Return how far each sample is from the parabola through its neighbours."""
    window, place = _windows(values)
    powers = np.vander(np.arange(window.shape[1]), 3)
    weights = np.eye(len(powers))
    for each, row in enumerate(weights):
        others = np.arange(len(powers)) != each
        row[others] = -powers[each] @ np.linalg.pinv(powers[others])
    return np.abs((window * weights[place]).sum(axis=1))


def _outlier_sigmas(values: Array, off: Array, expected_change: Array, valid: Mask,
                    min_scatter: float) -> Array:
    """Return distances from neighbours in standard deviations, local ones and those by motion."""
    near = _neighbour_samples(values)
    # A step, a corner or a steep slope is off the median, but within the range of its neighbours.
    outside = np.maximum(values - near.max(axis=1), near.min(axis=1) - values)
    blocks = max(1, len(off) // _SCATTER_BLOCK_SAMPLES)
    parts, kept = np.array_split(off, blocks), np.array_split(valid, blocks)
    of_blocks = [_robust_quantile(part[own]) for part, own in zip(parts, kept)]
    local = np.repeat(maximum_filter1d(of_blocks, 3, mode='nearest'),
                      [len(part) for part in parts])
    by_motion, classes = np.zeros(len(off)), _motion_classes(expected_change)
    for each in np.unique(classes):
        members = off[(classes == each) & valid]
        # by far ones too if there are enough, for rough motion
        by_motion[classes == each] = max(
            [_robust_quantile(members),
             *(np.quantile(members, 1.0 - share) / stats.norm.isf(0.5 * share)
               for share in (0.05, 0.01) if share * members.size > 5)])
    scale = np.maximum(np.maximum(local, by_motion), max(min_scatter, 1e-300))
    return np.where(outside > 0.5 * off, off / scale, 0.0)


# the record

@dataclass(frozen=True)
class DataQuality:
    """Faults of a record, and the samples to use."""

    findings: tuple[Finding, ...]  # one for each cause
    remarks: tuple[str, ...]  # for people, one sentence each
    usable: Mask  # the samples to use, shape (n,)
    # by which the output is multiplied to be in rad/s; 1 if the unit is right
    unit_factor: float = 1.0
    # largest absolute output, rad/s after the factor; None without a limit
    limit: float | None = None
    # quantization step of the output, rad/s after the factor; 0 if it does not matter
    output_step: float = 0.0
    heading_step: float = 0.0  # quantization step of the reference heading, rad; 0 without one


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
    if (rate is not None and line is not None and log.time is not None
            and log.reference_rate is None):
        rate = _follow_corners(log, rate, line)
        line = fit_line(log.time, rate, output) or line
    factor, units = 1.0, []
    if rate is not None and line is not None:
        # a factor in addition to the scale factor of the model
        own = 1.0 if model is None else model_scale_factor(model, rate)
        ratio, deviation = line.factor / own, line.deviation / abs(own)
        name = identify_unit_factor(ratio, deviation)
        if name is not None and not _is_refuted_by_spans(log, UNIT_FACTORS[name]):
            factor = 1.0 / UNIT_FACTORS[name]
            units = [_sized_finding(
                'unit_error', ratio, NORMAL_QUANTILE_975 * deviation,
                float(2.0 * stats.norm.sf(abs(ratio - 1.0) / max(deviation, 1e-300))),
                f'the output is {ratio:.5g} +- {deviation:.2g} times the reference, and '
                f'{name} is {UNIT_FACTORS[name]:.5g}',
                () if is_implausible_factor(ratio) else ('scale_factor_error',))]
    if log.time is None:
        return DataQuality(tuple(units), notes, has_output, factor)
    lost, remarks = _check_stamps(log.time, has_output)
    expected = (None if rate is None or line is None
                else factor * (line.factor * rate + line.offset))
    heading = log.reference_heading if log.reference_rate is None else None
    step = (0.0 if heading is None or np.count_nonzero(np.isfinite(heading)) < 3
            else encoder_step(heading))
    found = DataQuality((*units, *lost), (*notes, *remarks), has_output, factor,
                        heading_step=step)
    return _check_samples(found, compare_output(output * factor, expected), model, log)


def _is_refuted_by_spans(log: Log, factor: float) -> bool:
    """
    Tell whether the headings over spans agree with 1 rather than with a factor of the output.

    Of a motion that is late, a rate shows less than its turns do.
    """
    spans = [] if log.time is None else compare_headings(log, reference_angle(log))
    best = max(spans, key=lambda each: each.coherence, default=None)
    return best is not None and (
        abs(best.factor - 1.0) < abs(best.factor - 1.0 / factor)
        and abs(best.factor - 1.0 / factor) > 5.0 * best.deviation)


def _follow_corners(log: Log, rate: Array, line: LineFit) -> Array:
    """
    Return the rate of a heading by splines where it is closer to the output than a smooth one.

    The smooth one errs at the ends of a log and at corners of the motion, and that by splines by
    the noise of the heading.
    """
    assert log.time is not None
    heading = resample_reference(log).reference_heading
    assert heading is not None
    sharp = np.where(np.isfinite(heading), spline_rate(log.time, heading), np.nan)
    return min((sharp, rate), key=lambda each: float(np.nanmean(
        (require_output(log) - line.factor * each - line.offset) ** 2)))


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


def _check_stamps(time: Array, has_output: Mask) -> tuple[list[Finding], list[str]]:
    """Return lost samples as a finding, and remarks on bursts and lost values."""
    without = np.count_nonzero(~has_output)
    remarks = [f'{without} samples have no output, and are left out.'] if without else []
    try:
        stamps = fit_stamp_grid(time)
    except DataRefused as refused:
        return [], [*remarks, f'Lost samples cannot be counted: {refused}.']
    remarks += stamps.burst_remarks
    lost, steps = stamps.lost_after, np.diff(stamps.time)
    jitter = robust_deviation(steps - np.median(steps)) + 1e-9 * stamps.interval
    late = (lost.max() - 0.5) * stamps.interval / jitter
    chance = min(1.0, len(steps) * float(stats.norm.sf(late)))
    if not lost.any() or chance >= FALSE_ALARM_CHANCE:
        return [], remarks
    return [_sized_finding('dropped_samples', int(lost.sum()), 0.0, chance,
                           stamps.loss_remarks[0].rstrip('.'))], remarks


def _check_samples(found: DataQuality, comparison: OutputComparison, model: GyroModel | None,
                   log: Log) -> DataQuality:
    """Check the samples of the gyro for quantization, limits, repeats and outliers."""
    has_output = found.usable
    codes, output = find_codes(comparison.output[has_output]), comparison.output
    limit = _find_limit(codes, comparison, FALSE_ALARM_CHANCE)
    at_limit = (np.zeros(len(output), dtype=bool) if limit is None
                else limit.is_reached(output))
    valid, band = has_output & ~at_limit, _find_dead_band(codes, output)
    repeated = _find_repeated_samples(comparison, codes, band, valid, FALSE_ALARM_CHANCE)
    if repeated is not None and len(find_runs(at_limit)) == 1 and np.count_nonzero(
            at_limit) - 1 <= 2 * max(run.stop - run.start
                                     for run in find_runs(repeated.is_faulty)):
        # one run at a limit that is like the others is one of repeats
        limit, at_limit, valid = None, np.zeros_like(at_limit), has_output
        repeated = _find_repeated_samples(comparison, codes, band, valid, FALSE_ALARM_CHANCE)
    valid = valid if repeated is None else valid & ~repeated.is_faulty
    # Samples next to a dead band are the tail of the noise outside it.
    tested = valid if band is None else valid & ~binary_dilation(
        band.contains(output), iterations=_NEIGHBOURS_PER_SIDE)
    outlying = _find_outliers(comparison, tested, 0.5 * codes.step, FALSE_ALARM_CHANCE)
    valid = valid if outlying is None else valid & ~outlying.is_faulty
    away_from_limit = np.ones(len(output), dtype=bool)
    if limit is not None and comparison.expected is not None:
        # by the expected output: a selection by the measured output would be biased by its noise
        near = _RARE_SIGMAS * comparison.deviation
        away_from_limit = ~(
            (comparison.expected > limit.high - near) | (comparison.expected < limit.low + near))
    findings = (*found.findings, *_code_findings(codes, comparison, limit, at_limit, model),
                *_sample_findings(repeated, outlying, log, found.heading_step,
                                  comparison.noise_deviation))
    matters = codes.step >= _MIN_STEP_NOISE_RATIO * comparison.noise_deviation
    return replace(found, findings=findings, usable=valid & away_from_limit,
                   limit=None if limit is None else limit.size,
                   output_step=codes.step if matters else 0.0)


def _is_in_model(model: GyroModel | None, name: str, value: float) -> bool:
    """Tell whether a model has an effect on the signal with this value, to 2 %."""
    terms = () if model is None else model.terms
    return any(term.effect.name == name and abs(term.values[0] / value - 1.0) < 0.02
               for term in terms)


def _code_findings(codes: QuantizationCodes, comparison: OutputComparison, limit: _Limit | None,
                   at_limit: Mask, model: GyroModel | None) -> Iterator[Finding]:
    """Give quantization and saturation of the output, unless they are in the model."""
    if (codes.step >= _MIN_STEP_NOISE_RATIO * comparison.noise_deviation and codes.step
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


def _sample_findings(repeated: _SampleFault | None, outlying: _SampleFault | None, log: Log,
                     reference_step: float, noise_deviation: float) -> Iterator[Finding]:
    """Give repeated samples, outliers, and the step of the reference if it adds much variance."""
    assert log.time is not None
    if repeated is not None:
        count, runs = int(np.count_nonzero(repeated.is_faulty)), find_runs(repeated.is_faulty)
        first = log.time[int(np.argmax(repeated.is_faulty))]
        yield _sized_finding('stuck_samples', count, 0.0, repeated.p_value,
                             f'{count} samples in {len(runs)} run{"s" * (len(runs) > 1)} repeat '
                             f'the one before, the first at {first:.3f} s; codes and noise '
                             'do not explain them')
    if outlying is not None:
        count = int(np.count_nonzero(outlying.is_faulty))
        first = log.time[int(np.argmax(outlying.is_faulty))]
        yield _sized_finding('outliers', count, 0.0, outlying.p_value,
                             f'{count} single samples differ from their neighbours by up to '
                             f'{outlying.sigmas:.0f} sigma, the first at {first:.3f} s')
    interval = float(np.median(np.diff(log.time)))
    noise = interval * noise_deviation
    if reference_step and (
            not noise or reference_step ** 2 / 6.0 / noise ** 2 > _MIN_STEP_VARIANCE_SHARE):
        yield _sized_finding('reference_quantization', reference_step, 0.0, 0.0,
                             'the reference heading comes in steps of '
                             f'{reference_step / DEGREE:.4g} deg: its rate over one sample is '
                             'uncertain by '
                             f'{reference_step / np.sqrt(6.0) / interval / DEGREE:.3g} deg/s, '
                             f'where the gyro has {noise_deviation / DEGREE:.3g} deg/s of noise')
