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

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math

from gyro_calibration.calibration.dwells import OUTLIER_THRESHOLD, require_output
from gyro_calibration.calibration.reference_noise import heading_white_noise
from gyro_calibration.diagnosis.causes import sized_finding
from gyro_calibration.diagnosis.findings import Finding
from gyro_calibration.diagnosis.gates import (
    fit_line, identify_unit_factor, is_at_rest, is_implausible_factor, model_scale_factor,
    reference_rate, resample_reference, select_reference, spline_rate, UNIT_FACTORS)
from gyro_calibration.logs.log import Array, DataRefused, DEGREE, Log, Mask, NORMAL_QUANTILE_975
from gyro_calibration.logs.quality import (
    bridge_gaps, encoder_step, find_codes, find_runs, QuantizationCodes, robust_deviation,
    white_noise_deviation)
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
#: Least step of codes that matters, as a share of the white noise.
_MIN_STEP_NOISE_RATIO = 0.2
#: Probability of a repeat from which on single repeats of a coarse output are not tested.
_COARSE_REPEAT_CHANCE = 0.3
#: A deviation that noise reaches rarely, in standard deviations: samples whose expected output is
#: as near to a limit are not used, as noise determines whether they are clipped.
_RARE_SIGMAS = 4.5
#: Number of neighbours on each side with which a sample is compared.
_NEIGHBOURS_PER_SIDE = 3


@dataclass(frozen=True)
class _Comparison:
    """Output and expectation, in rad/s, shape (n,)."""

    output: Array  # without nan; gaps are interpolated
    expected: Array | None  # from the reference, nan in its gaps; None without a reference
    noise_deviation: float  # standard deviation of the white noise of a sample
    deviation: float  # standard deviation of a sample from the expected output, at least that
    may_move: bool = False  # without an expectation, and not known to rest


# codes

def _local_code_steps(codes: QuantizationCodes, output: Array) -> Array:
    """
    Return an upper bound of the step of codes near each value, shape (n,).

    Steps grow with the values of 32-bit floats and of decimals with a number of significant
    digits.
    """
    step = max(codes.step, float(np.diff(codes.values).min()) if len(codes.values) > 1 else 1.0)
    sizes = np.unique(np.abs(codes.values))
    sizes = sizes[np.diff(sizes, prepend=-1.0) > 1e-9 * sizes]
    if len(sizes) < 2:
        return np.full(len(output), step)
    # among larger codes, and by the finest relative step, of one to ten times which all are
    closest = np.minimum.accumulate(np.diff(sizes)[::-1])[::-1]
    place = np.minimum(np.searchsorted(sizes, np.abs(output)), len(closest) - 1)
    finest = float((np.diff(sizes) / sizes[1:]).min())
    return np.maximum(step, np.minimum(closest[place], 10.0 * finest * np.abs(output)))


def _find_dead_band(codes: QuantizationCodes,
                    output: Array) -> tuple[float, float, Mask] | None:
    """Return a frequent value without others near, their distance, and samples in between."""
    counts = np.where(np.abs(codes.values) < _rest_rate_limit(output), codes.counts, 0)
    place = int(np.argmax(counts))
    value = float(codes.values[place])
    half_width = float(np.abs(np.delete(codes.values, place) - value).min(initial=np.inf))
    within = np.abs(output - value) < 0.5 * half_width
    return ((value, half_width, within)
            if counts[place] > 1 and len(find_runs(within)) > 1 and half_width > 1.5 * codes.step
            else None)


def _rest_rate_limit(output: Array) -> float:
    """Return the largest output of a rest, a tenth of the largest one but for outliers."""
    return 0.1 * float(np.quantile(np.abs(output), 0.99))


def _find_limit(codes: QuantizationCodes, comparison: _Comparison) -> tuple[float, float, float]:
    """
    Return the low and high limit of an output, infinite without one, and the p-value of a test.

    An extreme code is a limit if it is larger than the output at rest; if it is more frequent than
    its neighbours, which are more frequent without a limit; and if the expected output is beyond
    it, which is not so for a coarse code at a constant rate.
    """
    found, p_value = {1.0: math.inf, -1.0: math.inf}, 1.0
    deviation, noise = comparison.deviation, comparison.noise_deviation
    # a repetition fault begins at one of two extreme samples as seldom as at any other
    by_fault = 2.0 * len(find_runs(np.diff(comparison.output) == 0.0)) / codes.counts.sum()
    fine = codes.step < _MIN_STEP_NOISE_RATIO * noise
    for sign in (1.0, -1.0):
        values, counts = ((codes.values, codes.counts) if sign > 0.0
                          else (-codes.values[::-1], codes.counts[::-1]))
        extreme, step = values[-1], float(_local_code_steps(codes, values[-1:])[0])
        # the chance of as many samples at the last code, if the density falls towards it
        reach = max(4.0 * step, 0.05 * noise)
        near = int(counts[:-1][values[:-1] > extreme - reach - 0.5 * step].sum())
        chance = float(stats.binom.sf(counts[-1] - 2, counts[-1] - 1 + near,
                                      1.0 / (min(reach / step, 1e6) + 1.0)))
        if chance >= FALSE_ALARM_CHANCE or extreme <= _rest_rate_limit(comparison.output):
            continue
        at_extreme = sign * comparison.output >= extreme - 1e-9 * abs(extreme)
        expected = (np.array([]) if comparison.expected is None
                    else sign * comparison.expected[at_extreme])
        beyond = (float(np.nanmedian(expected)) - extreme if np.isfinite(expected).any()
                  else -math.inf)
        # The expected output errs by bias wander and nonlinearity, which these samples share.
        if (beyond > (-3.0 * deviation if fine else 0.5 * codes.step + 2.0 * deviation)
                or fine and stats.poisson.sf(
                    len(find_runs(at_extreme)) - 1, by_fault) < FALSE_ALARM_CHANCE):
            found[sign], p_value = float(extreme), min(p_value, chance)
    return -found[-1.0], found[1.0], p_value


# repeated samples

def _find_repeated_samples(comparison: _Comparison, codes: QuantizationCodes,
                           band: tuple[float, float, Mask] | None,
                           valid: Mask) -> tuple[Mask, float]:
    """Mark repeated samples among valid ones; and return the p-value of number or longest run."""
    known, change = valid[1:] & valid[:-1], np.diff(comparison.output)
    same = (change == 0.0) & known
    expected = (np.zeros(len(change)) if comparison.expected is None
                else np.nan_to_num(np.diff(comparison.expected)))
    repeats, p_value, by_run = np.zeros(len(valid), dtype=bool), 1.0, 1.0
    if not same.any():
        return repeats, p_value
    width, runs = _local_code_steps(codes, comparison.output[:-1]), find_runs(same)
    if comparison.may_move:
        # Codes that stand between changes of one or two are those of a steady rate, which steps
        # coarser than the noise repeat; those of a rest between two fast turns look like a fault.
        size = np.pad(np.abs(change), 1, constant_values=math.inf)
        explained = [min(size[run.start], size[run.stop + 1]) < 2.5 * width[run.start]
                     for run in runs]
        if 2 * sum(explained) > len(runs):
            return repeats, p_value
    # an upper bound of the probability of each repeat: that of a change by less than a step for
    # the scatter of changes of similar expectation, and no less than the share of changes by one
    # code or two, each way
    chance, classes = np.ones(len(change)), _motion_classes(np.abs(expected))
    for each in np.unique(classes):
        members = np.flatnonzero((classes == each) & known)
        if len(members):
            due, steps, size = expected[members], width[members], np.abs(change[members])
            # zeros count: with many, the codes are coarse
            scale = np.maximum(_robust_quantile(np.abs(change[members] - due)), 1e-9 * steps)
            count = np.count_nonzero((size > 0.5 * steps) & (size < 2.5 * steps))
            chance[members] = np.maximum(_chance_within(due, steps, scale),
                                         (count + 2.0 * np.sqrt(count)) / 4.0 / len(size))
    if band is not None:
        # a sample in it repeats while the next is due in it, by its expected output or by a rest
        due = (np.full(len(change), np.median(comparison.output)) if comparison.expected is None
               else comparison.expected[1:])
        value, half_width, within = band
        deviation = max(comparison.deviation, 1e-9 * half_width)
        member = _chance_within(np.nan_to_num(due - value), half_width + 2.0 * deviation,
                                deviation)
        chance = np.where(within[:-1], np.maximum(chance, member), chance)
        width = np.where(within[:-1], 2.0 * half_width, width)
    rare = (chance < _COARSE_REPEAT_CHANCE) & known
    excess, expected_count = int(np.count_nonzero(same & rare)), float(chance[rare].sum())
    by_number = float(stats.poisson.sf(excess - 1, expected_count))
    if by_number < FALSE_ALARM_CHANCE and excess > 1.5 * expected_count:
        repeats[1:], p_value = same & (chance < 0.02), by_number
    product, travel = (np.concatenate([[0.0], np.cumsum(each)])
                       for each in (np.log(np.maximum(chance, 1e-12)), expected))
    for run in runs:
        if run.stop - run.start < 2:
            continue
        if chance[run].max() < _COARSE_REPEAT_CHANCE:
            unlikely = math.exp(max(product[run.stop] - product[run.start], -700.0))
        else:
            # Repeats of a coarse code depend on each other: a fault only if it should have left.
            left = abs(travel[run.stop] - travel[run.start]) - width[run.start]
            unlikely = float(2.0 * stats.norm.sf(
                left / (math.sqrt(2.0) * comparison.deviation))) if left > 0.0 else 1.0
        if unlikely * len(valid) < FALSE_ALARM_CHANCE:
            repeats[run.start + 1:run.stop + 1] = True
            by_run = min(by_run, unlikely * len(valid))
    return repeats, min(by_run, p_value)


def _chance_within(expected: Array, half_width: Array | float, deviation: Array | float) -> Array:
    """Return the probability that normal values are within a half-width about zero."""
    return ndtr((half_width - expected) / deviation) - ndtr((-half_width - expected) / deviation)


def _motion_classes(motion: Array) -> NDArray[np.intp]:
    """Return the class of each sample: eight by motion, with as many samples each."""
    edges = np.quantile(motion, np.linspace(0.0, 1.0, 9)[1:-1])
    return np.searchsorted(np.unique(edges), motion, side='left')


def _robust_quantile(off: Array) -> float:
    """Return a robust standard deviation of magnitudes."""
    return float(np.quantile(off, 0.6827)) if off.size else 0.0


# outliers

def _find_outliers(comparison: _Comparison, valid: Mask,
                   min_scatter: float) -> tuple[Mask, float, float]:
    """Mark outliers among valid samples; return their p-value and the largest one's sigmas."""
    measured = output = bridge_gaps(np.where(valid, comparison.output, np.nan))
    count = len(output)
    # more for very long logs
    limit = max(OUTLIER_THRESHOLD, float(stats.norm.isf(0.25 * FALSE_ALARM_CHANCE / count)))
    # how much the output is expected to change about each sample, and how far it jumps
    expected: Array = np.zeros(count)
    expected_change = jumps = expected
    if comparison.expected is not None and np.isfinite(comparison.expected).any():
        expected = bridge_gaps(comparison.expected)
        output = output - expected
        padded = np.pad(expected, 2 * _NEIGHBOURS_PER_SIDE, mode='edge')
        expected_change = np.ptp(sliding_window_view(padded, 4 * _NEIGHBOURS_PER_SIDE + 1), axis=1)
        # from the cubic through two samples on each side; a jolt of the output is near
        by_cubic = np.abs(np.diff(np.pad(expected, 2, mode='edge'), 4)) / 6.0
        jumps = maximum_filter1d(by_cubic, 21)
    # the samples about each one, the outer ones at the ends, and those without itself
    size, index = 2 * _NEIGHBOURS_PER_SIDE + 1, np.arange(count)
    first = np.clip(index - _NEIGHBOURS_PER_SIDE, 0, count - size)
    window = first[:, None] + np.arange(size)
    neighbours = window[window != index[:, None]].reshape(count, size - 1)
    near = output[neighbours]
    off = np.abs(output - np.median(near, axis=1))
    # in standard deviations: of the samples about it, and of those that move alike, by far ones
    # too if there are enough, for rough motion
    blocks = max(1, count // 256)
    parts, kept = np.array_split(off, blocks), np.array_split(valid, blocks)
    of_blocks = [_robust_quantile(part[own]) for part, own in zip(parts, kept)]
    scale = np.repeat(maximum_filter1d(of_blocks, 3, mode='nearest'),
                      [len(part) for part in parts])
    classes = _motion_classes(expected_change)
    for each in np.unique(classes):
        members, own = off[(classes == each) & valid], classes == each
        scale[own] = np.maximum(scale[own], max(
            [_robust_quantile(members),
             *(np.quantile(members, 1.0 - share) / stats.norm.isf(0.5 * share)
               for share in (0.05, 0.01) if share * members.size > 5)]))
    # A step, a corner or a steep slope is off the median, but within the range of its neighbours.
    outside = np.maximum(output - near.max(axis=1), near.min(axis=1) - output)
    sigmas = np.where(outside > 0.5 * off, off / np.maximum(scale, max(min_scatter, 1e-300)), 0.0)
    # an outlier of the output itself is off the parabola through its neighbours
    powers, weights = np.vander(np.arange(size), 3), np.eye(size)
    for place, row in enumerate(weights):
        others = np.arange(size) != place
        row[others] = -powers[place] @ np.linalg.pinv(powers[others])
    sigmas[np.abs((measured[window] * weights[index - first]).sum(axis=1)) < 0.5 * off] = 0.0
    # near a jump of the reference of half the size: a jolt, or the reference is outlying
    sigmas[jumps > 0.5 * off] = 0.0
    tested = valid & (np.count_nonzero(~valid[neighbours], axis=1) < _NEIGHBOURS_PER_SIDE)
    outlying = (sigmas > limit) & tested
    for run in find_runs(outlying):
        outlying[run] = run.stop - run.start <= 2
    found = int(np.count_nonzero(outlying))
    p_value = float(stats.poisson.sf(found - 1, 4.0 * count * stats.norm.sf(limit)))
    if p_value >= FALSE_ALARM_CHANCE:
        outlying[:] = False
    return outlying, p_value, float(sigmas[outlying].max(initial=0.0))


# the record

@dataclass(frozen=True)
class DataQuality:
    """Faults of a record, and the samples to use."""

    findings: tuple[Finding, ...]  # one for each cause
    remarks: tuple[str, ...]  # for people, one sentence each
    usable: Mask  # the samples to use, shape (n,)
    limit: float | None = None  # largest absolute output, rad/s; None without a limit
    output_step: float = 0.0  # quantization step of the output, rad/s; 0 if it does not matter
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
    resampled = resample_reference(log)
    output, rate = require_output(log), reference_rate(resampled)
    has_output, heading = np.isfinite(output), resampled.reference_heading
    if log.time is not None and log.reference_rate is None and heading is not None:
        rate = np.where(np.isfinite(heading), spline_rate(log.time, heading), np.nan)
    line = None if rate is None else fit_line(log.time, rate, output)
    units = []
    if rate is not None and line is not None:
        # a factor in addition to the scale factor of the model; one far from 1 fails a gate
        own = 1.0 if model is None else model_scale_factor(model, rate)
        ratio, deviation = line.factor / own, line.deviation / abs(own)
        name = None if is_implausible_factor(ratio) else identify_unit_factor(ratio, deviation)
        if name is not None:
            units = [sized_finding(
                'unit_error', ratio, NORMAL_QUANTILE_975 * deviation,
                float(2.0 * stats.norm.sf(abs(ratio - 1.0) / max(deviation, 1e-300))),
                ['scale_factor_error'],
                evidence=f'the output is {ratio:.5g} +- {deviation:.2g} times the reference, and '
                f'{name} is {UNIT_FACTORS[name]:.5g}; a new model has it as a scale factor error')]
    if log.time is None:
        return DataQuality(tuple(units), notes, has_output)
    lost, remarks = _check_stamps(log.time, has_output)
    whole, noise = bridge_gaps(output), white_noise_deviation(output)
    comparison = _Comparison(whole, None, noise, noise, rate is None and not is_at_rest(log))
    if rate is not None and line is not None:
        expected = line.factor * rate + line.offset
        off = (output - expected)[np.isfinite(output) & np.isfinite(expected)]
        noise = min(noise, white_noise_deviation(output - expected))
        comparison = _Comparison(whole, expected, noise, max(
            noise, robust_deviation(off) if len(off) else math.inf))
    heading = log.reference_heading if log.reference_rate is None else None
    step = (0.0 if heading is None or np.count_nonzero(np.isfinite(heading)) < 3
            else encoder_step(heading))
    if step and step < heading_white_noise(log):  # the last digit of a file
        step = 0.0
    return _check_samples(DataQuality((*units, *lost), (*notes, *remarks), has_output,
                                      heading_step=step), comparison, model, log.time)


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
    return [sized_finding('dropped_samples', int(lost.sum()), 0.0, chance,
                          evidence=stamps.loss_remarks[0].rstrip('.'))], remarks


def _check_samples(quality: DataQuality, comparison: _Comparison, model: GyroModel | None,
                   time: Array) -> DataQuality:
    """Check the samples of the gyro for quantization, limits, repeats and outliers."""
    has_output, output, noise = quality.usable, comparison.output, comparison.noise_deviation
    codes = find_codes(output[has_output])
    (low, high, p_limit), band = _find_limit(codes, comparison), _find_dead_band(codes, output)
    rounded = 1.0 - 1e-9
    at_limit = (output >= rounded * high) | (output <= rounded * low)
    repeated, p_repeated = _find_repeated_samples(comparison, codes, band, has_output & ~at_limit)
    valid = has_output & ~at_limit & ~repeated
    # Samples next to a dead band are the tail of the noise outside it.
    tested = valid if band is None else valid & ~binary_dilation(
        band[2], iterations=_NEIGHBOURS_PER_SIDE)
    outlying, p_outlying, sigmas = _find_outliers(comparison, tested, 0.5 * codes.step)
    valid &= ~outlying
    if comparison.expected is not None:
        # by the expected output: a selection by the measured output would be biased by its noise
        near = _RARE_SIGMAS * comparison.deviation
        valid &= ~((comparison.expected > high - near) | (comparison.expected < low + near))

    def is_in_model(name: str, value: float) -> bool:
        return any(term.effect.name == name and abs(term.values[0] / value - 1.0) < 0.02
                   for term in ([] if model is None else model.terms))

    findings = list(quality.findings)
    matters = codes.step >= _MIN_STEP_NOISE_RATIO * noise
    if matters and codes.step and not is_in_model('quantization', codes.step):
        chance = float(np.exp(-min(codes.counts.sum() * codes.alignment ** 2, 700.0)))
        findings.append(sized_finding(
            'quantization', codes.step, NORMAL_QUANTILE_975 * codes.step_deviation, chance,
            evidence=f'the output has {len(codes.values)} codes, '
            f'{codes.step / DEGREE:.4g} deg/s apart, '
            f'where its white noise is {noise / DEGREE:.3g} deg/s'))
    limit = min(-low, high)
    if math.isfinite(limit) and not is_in_model('saturation', limit):
        sides = [f'{value / DEGREE:.5g} deg/s' for value in (low, high) if np.isfinite(value)]
        findings.append(sized_finding(
            'saturation', limit, 0.0, p_limit,
            evidence=f'{np.count_nonzero(at_limit)} samples '
            f'({100.0 * at_limit.mean():.2g} %) have the extreme code {" or ".join(sides)}'))
    for name, fault, p_value in (('stuck_samples', repeated, p_repeated),
                                 ('outliers', outlying, p_outlying)):
        if fault.any():
            count, runs = int(fault.sum()), len(find_runs(fault))
            first = f'the first at {time[int(np.argmax(fault))]:.3f} s'
            findings.append(sized_finding(
                name, count, 0.0, p_value,
                evidence=f'{count} single samples differ from their neighbours by up to '
                f'{sigmas:.0f} sigma, {first}' if name == 'outliers' else
                f'{count} samples in {runs} run{"s" * (runs > 1)} repeat the one before, '
                f'{first}; codes and noise do not explain them'))
    interval, step = float(np.median(np.diff(time))), quality.heading_step
    if step and step ** 2 / 6.0 > 0.02 * (interval * noise) ** 2:
        findings.append(sized_finding(
            'reference_quantization', step, 0.0, 0.0,
            evidence='the reference heading comes in steps of '
            f'{step / DEGREE:.4g} deg: its rate over one sample is uncertain by '
            f'{step / np.sqrt(6.0) / interval / DEGREE:.3g} deg/s, where the gyro has '
            f'{noise / DEGREE:.3g} deg/s of noise'))
    return replace(quality, findings=tuple(findings), usable=valid,
                   limit=limit if math.isfinite(limit) else None,
                   output_step=codes.step if matters else 0.0)


def strongest_findings(records: Sequence[DataQuality]) -> list[Finding]:
    """Return the findings of records, of each effect that with the smallest p-value."""
    return [*{each.effect: each for each in sorted(
        (each for record in records for each in record.findings),
        key=lambda each: -each.p_value)}.values()]
