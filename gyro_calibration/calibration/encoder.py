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
Calibrate a gyro against an encoder: scale factor error, bias and the residual heading.

The input is a log in time with a reference heading, and the method the likelihood of headings, or
the regression of a course over ground. The interval of the scale is the scatter between pieces of
the log, since the error that repeats in each period of a swing is no noise of the fit, and at
least that between places of the shaft; that of the bias is its wander between pieces.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
import math
from pathlib import Path
from typing import NamedTuple

from gyro_calibration.calibration.dwells import (
    extract_dwells, FEW_DWELLS_SHARE, few_values_remedy, find_lost_reference, format_list,
    join_dwells, MIN_DWELL_SHARE, NothingSteady)
from gyro_calibration.calibration.heading_regression import fit_course, MAX_FOLLOWED_RESIDUAL
from gyro_calibration.calibration.likelihood import (
    correct_shaft, fit_likelihood, MAX_BLOCK_DURATION, MISALIGNMENT_REMEDY, oblique_angle,
    ScaleBiasFit)
from gyro_calibration.calibration.noise_grid import (
    BandedNoise, bias_wander_columns, difference_covariance, fit_noise_grid, GridFit,
    HierarchicalPrior, mean_walk_covariance, TridiagonalMatrix)
from gyro_calibration.calibration.rate_table import fit_effects
from gyro_calibration.calibration.reference_kind import find_reference_kind, is_noisy
from gyro_calibration.calibration.reference_noise import (
    drop_repeated_references, keep_own_instants, MAX_ROUNDING_STEP, rate_noise_share)
from gyro_calibration.calibration.run_faults import (
    drop_dead_output, fit_profile, refuse_unit_error, split_run, UNIT_TOLERANCE)
from gyro_calibration.calibration.selection import (
    FALSE_ALARM_RATE, select_effects, SelectedEffects, TECHNOLOGY_PRIORS)
from gyro_calibration.calibration.self_calibration import (
    DRIVE_DURATION, refuse_one_speed, refuse_scale, refuse_uncertain_scale, rounding_covariance,
    RunLimits)
from gyro_calibration.calibration.spans import (
    COURSE_TREATMENT, lag_deviation, lay_out_spans, MAX_ENCODER_OFFSET, WANDER_COSINES)
from gyro_calibration.files import InputError
from gyro_calibration.heading.integration import integrate
from gyro_calibration.logs.log import (
    Array, DataRefused, DEGREE, Log, NORMAL_QUANTILE_975, refuse_wrapped)
from gyro_calibration.logs.quality import (
    bridge_gaps, cross_rotation, encoder_step, find_holes, quantization_step, refuse_dead,
    refuse_saturated, robust_deviation, white_noise_deviation)
from gyro_calibration.logs.stamps import count_lost_samples
from gyro_calibration.model.effects import BIAS, Effect, SCALE_FACTOR_ERROR
from gyro_calibration.model.gyro_model import GyroModel, Term
from gyro_calibration.model.motion import (
    Motion, motion_from_headings, motion_from_log, motion_from_rates)
from gyro_calibration.model.noise import Noise
import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.ndimage import maximum_filter1d, minimum_filter1d

#: Prior standard deviation of the lag of a gyro, half the square of its time constant, s².
_GYRO_LAG_DEVIATION = 2e-4


@dataclass(frozen=True)
class EncoderCalibration:
    """The calibration of a gyro by a log with a reference heading."""

    model: GyroModel  # scale factor error and bias with covariance and valid ranges
    method: str  # 'likelihood' or 'course'
    fit: ScaleBiasFit  # the same with noise and time offset, as found
    reference: Motion  # its headings over time, s since it began
    # heading of the gyro less that of the reference, without calibration and with it, rad, (n,)
    residual_before: Array
    residual_after: Array
    lost_samples: int  # where the stamps are regular enough to count them
    remarks: tuple[str, ...]  # one sentence each


def calibrate_encoder(log: Log, method: str | None = None,
                      technology: str = 'mems') -> EncoderCalibration:
    """
    Find scale factor error and bias from a log with a reference heading.

    Parameters
    ----------
    log : with time, output and reference heading, or a reference rate, which is integrated;
        samples without a number count as lost
    method : 'likelihood', or 'course' for a course over ground; None for 'course' where the
        reference is one, else 'likelihood'
    technology : of the gyro, one of `selection.TECHNOLOGY_PRIORS`; with 'course' its
        prior decides what a drive leaves open

    Raises
    ------
    DataRefused : with the reason and the remedy

    """
    log, chosen = choose_reference(log)
    refuse_wrapped(log)
    log, repeated = drop_repeated_references(log)
    time, output, motion, crossing = _extract_motion(log)
    spans = None if method or log.reference_heading is None else lay_out_spans(
        log, technology=technology)
    if method is None:
        kind, _ = find_reference_kind(log, spans)
        method = 'course' if kind in ('course', 'odometry') or (
            spans is not None and is_noisy(log, spans)) else 'likelihood'
    if spans is not None:
        longest = float(np.ptp(_find_holes(time), axis=1).max(initial=0.0))
        if longest < 0.5 * motion.duration and (
                hole := _find_turn_in_hole(time, output, motion)):
            method = 'course'
            chosen.append(f'{hole}, over which they are not compared')
    jumps: list[str] = []
    if method != 'course':  # which errs in bursts of some seconds
        log, jumps, _ = bridge_jumps(log)
        if jumps:
            time, output, motion, crossing = _extract_motion(log)
    bounds: dict[str, tuple[float, float]] = {}
    if method == 'course':
        refuse_dead(output)
        refuse_saturated(output)
        fit = fit_course(spans or lay_out_spans(log, technology=technology))
        for are_one in (False, True):  # a drive may have rates of whole steps
            fit = _with_rounding(time, output, fit, are_one)
    else:
        fit, bounds = _fit_encoder(time, output, motion, crossing, technology)
    model = GyroModel(
        (Term(BIAS, (fit.bias,)), Term(SCALE_FACTOR_ERROR, (fit.scale_factor_error,))),
        fit.covariance[::-1, ::-1], (float(output.min()), float(output.max())),
        noise=Noise(fit.angle_random_walk), noise_bounds=bounds)
    if log.temperature is not None:
        degc = log.temperature
        model = replace(model, temperature_range=(float(degc.min()), float(degc.max())),
                        reference_temperature=float(degc.mean()))
    on_reference = time - fit.time_offset
    lost = count_lost_samples(time)
    return EncoderCalibration(
        model, method, fit, motion, _heading_residual(on_reference, output, motion),
        _heading_residual(on_reference, (output - fit.bias) / (1.0 + fit.scale_factor_error),
                          motion),
        0 if lost is None else int(lost.sum()),
        (*chosen, *repeated, *jumps, *_list_remarks(fit, motion, method, technology)))


def _fit_encoder(time: Array, output: Array, motion: Motion, crossing: Array,
                 technology: str) -> tuple[ScaleBiasFit, dict[str, tuple[float, float]]]:
    """Return the fit by the likelihood, or refuse it, and the bounds of its noise."""
    limits = RunLimits(max_heading_error=15.0 * DEGREE)
    if hole := _find_turn_in_hole(time, output, motion):
        raise DataRefused(f'{hole}: use --method course, or fit the log before or after it (--to, '
                          '--from), or correct the stamps')
    refuse_one_speed(motion, limits)
    refuse_dead(output)
    refuse_saturated(output)
    # the gyro's lag is about that of a filter of 20 ms; a heading without steps may be a mean over
    # 0.2 s
    has_steps = encoder_step(motion.heading) >= MAX_ROUNDING_STEP
    fit = fit_likelihood(time, output, replace(motion, rate=None, is_measured=True),
                         MAX_ENCODER_OFFSET,
                         lag_deviation=_GYRO_LAG_DEVIATION if has_steps else 0.2 ** 2 / 24.0,
                         cross_rotation=crossing, bias_wanders=True)
    if motion.rate is not None:
        exact = fit.scale_factor_error
        fit = fit_likelihood(time, output, motion, MAX_ENCODER_OFFSET, lag_deviation=max(
            lag_deviation(fit.time_offset), _GYRO_LAG_DEVIATION), bias_wanders=True)
        # the shape of the response is not known: what it changes is uncertain
        fit = replace(fit, response_deviation=abs(fit.scale_factor_error - exact))
    refuse_unit_error(1.0 + fit.scale_factor_error, 'reference')
    refuse_scale(fit.scale_factor_error, 'reference',
                 'give or omit --invert, or turn the gyro over')
    corrected = (output - fit.bias) / (1.0 + fit.scale_factor_error)
    if fit.misalignment.size:  # the heading about the axis of the gyro
        motion = replace(motion, heading=motion.heading + crossing @ fit.misalignment / (
            1.0 + fit.scale_factor_error))
    elif fit.shaft_error.size:
        motion = replace(motion, heading=correct_shaft(motion.heading, fit.shaft_error))
    drift, (least_walk, largest_walk) = _estimate_drift(motion, _heading_residual(
        time - fit.time_offset, corrected, motion), fit.bias, technology)
    (bias,), (deviation,) = drift.values.tolist(), drift.deviations.tolist()
    # a bias within chance that could make a heading worse
    if (deviation * DRIVE_DURATION > limits.max_heading_error
            and abs(bias) < NORMAL_QUANTILE_975 * deviation):
        raise DataRefused(f'the log shows a bias of {bias / DEGREE:.3f} +- '
                          f'{deviation / DEGREE:.3f} deg/s, too uncertain to improve a '
                          'heading: turn more slowly, with rests, or for longer')
    fit = _with_rounding(time, output, _apply_drift(fit, drift, motion))
    refuse_uncertain_scale(math.sqrt(fit.covariance[0, 0]), limits)
    fit = replace(fit, covariance=fit.covariance + np.diag([fit.response_deviation ** 2, 0.0]))
    # the steps of an encoder hide white noise
    if has_steps:
        return replace(fit, angle_random_walk=min(fit.angle_random_walk, largest_walk)), {}
    low, high = fit.angle_random_walk / np.sqrt(
        stats.chi2.ppf([0.975, 0.025], fit.dof) / fit.dof)
    # what repeats within a piece, as a wobble of the shaft does, is no random walk
    if fit.angle_random_walk > largest_walk:
        low, fit = least_walk, replace(fit, angle_random_walk=largest_walk)
    return fit, {'angle_random_walk': (float(low), float(high))}


def _with_rounding(time: Array, output: Array, fit: ScaleBiasFit,
                   are_one: bool = False) -> ScaleBiasFit:
    """Return a fit with the errors by steps of the output, which are seen between few rates."""
    unseen = np.diag(rounding_covariance(time, output, fit, are_one)[0] - fit.covariance)
    return replace(fit, covariance=fit.covariance + np.diag(np.maximum(unseen, 0.0)))


class _HeadingJumps(NamedTuple):
    """Jumps of a reference heading that the gyro does not show."""

    rows: NDArray[np.intp]  # first rows after them
    sizes: Array  # rad, of each
    deviation: float  # standard deviation of a size, rad
    p_value: float  # chance of the largest in noise


def bridge_jumps(log: Log) -> tuple[Log, list[str], _HeadingJumps | None]:
    """
    Return a log whose reference heading continues over its jumps as the gyro does, remarks, jumps.

    A jump is a change from one value to the next beyond all rates of the gyro around it, and
    beyond what noise gives in all of the log, by the exponential tail of the differences (Pickands
    1975). Two in a row, there and back, are a wrong value, which is left out.
    """
    if log.time is None or log.output is None or log.reference_heading is None:
        return log, [], None
    time, output = log.time, bridge_gaps(log.output)
    heading = np.asarray(keep_own_instants(log)[0].reference_heading)
    known = np.flatnonzero(np.isfinite(heading))
    if len(known) < 2:
        return log, [], None
    apart, turned = np.diff(time[known]), np.diff(heading[known])
    since = time - time[known[0]]
    possible = np.clip(turned, output.min() * apart, output.max() * apart)
    delay = fit_profile(split_run(since, output), motion_from_headings(
        since[known], np.append(0.0, np.cumsum(possible))), COURSE_TREATMENT.largest_delay)[2]
    output = np.interp(since + delay, since, output)
    difference = turned - np.diff(integrate(time, output)[known])
    late = MAX_ENCODER_OFFSET / float(np.median(np.diff(time)))
    around = 2 * math.ceil(min(late, len(time))) + 1
    slowest, fastest = (most.reduceat(find(output, around), known)[:-1] * apart for most, find in (
        (np.minimum, minimum_filter1d), (np.maximum, maximum_filter1d)))
    # a turn that the gyro shows late, or not at first, has such turns before and after it
    padded = np.pad(turned, 1, mode='edge')
    alone = turned - 0.5 * (padded[2:] + padded[:-2])
    beyond = np.minimum(np.maximum(turned - fastest, slowest - turned),
                        alone * np.sign(difference)) - quantization_step(heading[known])
    usual = (apart < 1.5 * np.median(apart)) & (np.abs(
        since[known[1:]] + delay - 0.5 * since[-1]) < 0.5 * since[-1])
    tail = 0.005  # share of the largest differences
    low, high = np.quantile(np.abs(difference[usual]), 1.0 - tail * np.array([2.0, 1.0]))
    noise = high + (high - low) * math.log2(max(tail * len(known) / FALSE_ALARM_RATE, 1.0))
    above = usual & (beyond > noise)
    once = above & (np.convolve(above, np.ones(3), 'same') == 1.0)
    jumps = known[1:][once]
    back = above[:-1] & above[1:] & (np.abs(difference[:-1] + difference[1:]) <= noise)
    wrong = known[1:-1][back]
    sizes, heading, remarks = np.zeros(len(time)), log.reference_heading.copy(), []
    found: _HeadingJumps | None = None
    if len(wrong):
        heading[wrong] = np.nan
        remarks.append('the reference is off in single values, which are left out, by up to '
                       f'{np.abs(difference[:-1][back]).max() / DEGREE:.1f} deg: '
                       + format_list([f'{time[row]:.2f} s' for row in wrong]))
    if len(jumps):
        # against the gyro, or where its delay matters, against the turns before and after
        change = min((difference, alone), key=lambda each: robust_deviation(each[usual]))
        sizes[jumps] = change[once]
        halvings = (beyond[once].max() - high) / max(high - low, 1e-300)
        found = _HeadingJumps(jumps, sizes[jumps], robust_deviation(change[usual]),
                              tail * len(known) * 2.0 ** -min(halvings, 1000.0))
        remarks.append(
            f'the reference jumps by up to {np.abs(sizes).max() / DEGREE:.1f} deg from one value '
            f'to the next, at {format_list([f"{time[row]:.2f} s" for row in jumps])}, where the '
            'gyro does not turn so fast, as after a lost reference or where rows are missing; the '
            'heading is compared before and after, not over, each jump')
    return replace(log, reference_heading=heading - np.cumsum(sizes)), remarks, found


def choose_reference(log: Log, prefer_rate: bool = False) -> tuple[Log, list[str]]:
    """
    Return a log with a single reference over time, and remarks on what was left out.

    Of a heading and a rate it is the heading, unless this is known for less than half as long, or
    the rate is preferred and both turn alike. Where they contradict each other, and one is further
    from the gyro than a scale factor error of 10 %, it is the other if that leaves less than half.
    """
    rate, heading = (None if each is None or not np.isfinite(each).any() else each
                     for each in (log.reference_rate, log.reference_heading))
    if log.time is None or rate is None or heading is None:
        return replace(log, reference_rate=rate, reference_heading=heading), []
    counts = [int(np.count_nonzero(~find_lost_reference(np.isfinite(each))))
              for each in (rate, heading)]
    by_rate, contradiction = 2 * counts[1] < counts[0], ''
    known = np.isfinite(rate) & np.isfinite(heading)
    if np.count_nonzero(known) >= 100:
        time = log.time[known] - log.time[known][0]
        pieces, motion = split_run(time, rate[known]), motion_from_headings(time, heading[known])
        turned, largest = pieces.reference_angle(motion), RunLimits().max_scale_deviation
        alike = np.sum((pieces.gyro_angle - turned) ** 2) <= largest ** 2 * np.sum(turned ** 2)
        by_rate |= prefer_rate and bool(alike)
        unexplained, scale, _ = fit_profile(pieces, motion, MAX_ENCODER_OFFSET)
        late, _, delay = fit_profile(pieces, motion, COURSE_TREATMENT.largest_delay)
        # a longer delay that explains less than half is chance, as in a motion that repeats
        if not alike and late < 0.5 * unexplained:
            contradiction = f'is {abs(delay):.1f} s {"behind" if delay > 0.0 else "ahead of"}'
        # what noise or another delay may do to the scale is less than the root of what they leave
        elif ((turned.any() or not alike)
              and abs(scale - 1.0) >= max(1e-3, math.sqrt(max(unexplained, 0.0)))):
            contradiction = f'turns {scale:.3f} times as far as'
        if contradiction and log.output is not None:
            rows = np.isfinite(log.output[known])
            gyro = split_run(time[rows], log.output[known][rows])
            left = []  # shares of the squares of what the gyro turned
            for each in (motion_from_rates(time, rate[known]), motion):
                delay = fit_profile(gyro, each, COURSE_TREATMENT.largest_delay)[2]
                off = gyro.gyro_angle - gyro.reference_angle(each, delay)
                left.append(float(np.var(off)) / max(float(np.var(gyro.gyro_angle)), 1e-300))
            if max(left) > max((UNIT_TOLERANCE - 1.0) ** 2, 2.0 * min(left)):
                by_rate = left[0] < left[1]
    remarks = [f'The reference heading is known in {counts[1]} samples only; the rate, known in '
               f'{counts[0]}, is used.'] if by_rate and 2 * counts[1] < counts[0] else []
    if contradiction:
        remarks.append(f'The reference rate {contradiction} the reference heading; the '
                       f'{"rate" if by_rate else "heading"} is used: check both, and leave '
                       'the wrong one out.')
    return (replace(log, reference_heading=None) if by_rate
            else replace(log, reference_rate=None)), remarks


def _extract_motion(log: Log) -> tuple[Array, Array, Motion, Array]:
    """Return time and output of the gyro, motion and its cross rotation, without lost samples."""
    reference = log.reference_rate if log.reference_heading is None else log.reference_heading
    if log.time is None or log.output is None or reference is None:
        raise DataRefused('the log holds no reference over time: it needs values of time_s, '
                          'gyro_dps and reference_heading_deg or reference_rate_dps')
    output_known, reference_known = np.isfinite(log.output), np.isfinite(reference)
    # a reference may come far less often than the gyro
    for known, name, fewest, remedy in (
            (output_known, 'gyro', max(100, len(log) // 10), 'repair its line and record again'),
            (reference_known, 'reference', 100,
             few_values_remedy(log.time, reference_known, 100))):
        if known.sum() < fewest:
            raise DataRefused(f'the {name} has a value in {known.sum()} of {len(log)} samples; '
                              f'at least {fewest} are needed: {remedy}')
    motion, start = motion_from_log(log)
    if motion.rate is not None and rate_noise_share(log):  # else it may be a command
        motion = replace(motion, rate=None, is_measured=True)
    # the last value stands for an interval too; the rounding of stamps, 1 us, is no lack
    duration = motion.duration + float(np.median(np.diff(motion.time)))
    if duration < 10.0 - 1e-6:
        # not rounded up to the 10 s that are needed
        raise DataRefused(f'the log lasts {math.floor(10.0 * duration) / 10.0:g} s; at '
                          'least 10 s are needed: record longer')
    if motion.duration > 1e8:  # three years
        raise DataRefused(f'the log lasts {motion.duration:.3g} s by its stamps; '
                          'check that time_s is in s, or give --rate')
    return (log.time[output_known] - start, log.output[output_known], motion,
            cross_rotation(log)[reference_known])


def _find_holes(time: Array) -> Array:
    """Return begin and end of each hole that is longer than a block and than usual, s, (k, 2)."""
    return find_holes(time, max(MAX_BLOCK_DURATION, 2.5 * float(np.median(np.diff(time)))))


def _find_turn_in_hole(time: Array, output: Array, motion: Motion) -> str:
    """Return what the reference turns in a hole of the samples, as a clause; '' where nothing."""
    for begin, end in _find_holes(time):
        turned = float(motion.heading_at(end) - motion.heading_at(begin))
        by_gyro = 0.5 * float(np.interp([begin, end], time, output).sum()) * (end - begin)
        if abs(turned - by_gyro) > MAX_FOLLOWED_RESIDUAL:
            return (f'the gyro has no samples for {end - begin:.1f} s from {begin:.1f} s on, in '
                    f'which the reference turns by {abs(turned) / DEGREE:.0f} deg')
    return ''


def _number_pieces(time: Array) -> NDArray[np.intp]:
    """Return the piece of the log of each time: 8 to 64 pieces, of 5 s or more if above 8."""
    since = (time - time[0]) / (time[-1] - time[0])
    count = int(np.clip((time[-1] - time[0]) / 5.0, 8, 64))
    return np.minimum(since * count, count - 1).astype(np.intp)


def _estimate_drift(motion: Motion, error: Array, bias: float,
                    technology: str) -> tuple[GridFit, list[float]]:
    """
    Return the fit of the mean bias over a log, rad/s, and 95 % bounds of the angle random walk.

    By the drifts between pieces of the log; what repeats itself within a piece is noise of its
    mean heading. The bias has a normal prior about zero, of a tenth of the size that the
    technology has up to all of it: one that the log hardly shows would only harm a heading. Given
    are the error of the heading of the fit, rad, shape (n,), and its bias, rad/s.
    """
    piece = _number_pieces(motion.time)
    counts = np.bincount(piece)
    known = np.flatnonzero(counts)
    if len(known) < 6:
        raise DataRefused(f'the reference is known in {len(known)} of {piece[-1] + 1} parts of '
                          'the log; at least 6 are needed: repair its line and record again')
    middle, heading = (np.bincount(piece, values)[known] / counts[known]
                       for values in (motion.time, error))
    spacing, moved = np.diff(middle), np.diff(heading)
    begins = np.flatnonzero(np.diff(piece, prepend=-1))
    durations = motion.time[np.append(begins[1:], len(piece)) - 1] - motion.time[begins]
    walk = BandedNoise('angle_random_walk', *mean_walk_covariance(middle, durations), (1e-5, 1e-2))
    # a file has headings to 1e-6 rad
    rounding = max(quantization_step(motion.heading), 1e-6) / math.sqrt(
        12.0 * len(piece) / len(known))
    repeated = BandedNoise('reference', *difference_covariance(np.ones(len(known))),
                           (rounding, max(float(np.ptp(heading)), 2.0 * rounding)))
    largest = max(TECHNOLOGY_PRIORS[technology][1], 3.0 * abs(bias))
    found = fit_noise_grid(
        moved + bias * spacing, spacing[:, None], [walk, repeated],
        *bias_wander_columns(middle, cosine_count=WANDER_COSINES),
        hierarchical_priors=(HierarchicalPrior('bias', 0, (0.1 * largest, largest)),))
    white, steady = TridiagonalMatrix(*mean_walk_covariance(middle, durations)).whiten(
        np.column_stack([moved, spacing])).T
    squares = white @ white - (white @ steady) ** 2 / (steady @ steady)
    walks = np.sqrt(squares / stats.chi2.ppf([0.975, 0.025], len(white) - 1))
    return found, walks.tolist()


def _apply_drift(fit: ScaleBiasFit, drift: GridFit, motion: Motion) -> ScaleBiasFit:
    """Return the fit with the mean bias of a drift, and covariances by scatter between pieces."""
    turned = np.interp(fit.influence[:, 2], motion.time, motion.heading) / (2.0 * math.pi)
    scatter = _scatter_between(_number_pieces(fit.influence[:, 2]), fit.influence, turned)
    slope = scatter[0, 1] / scatter[1, 1]
    # the drift is that of a heading with the scale of the fit, whose error is one of the bias too
    own_variance = max(float(fit.covariance[0, 0]) - fit.response_deviation ** 2, 0.0)
    of_scale = fit.covariance[0, 1] / math.sqrt(own_variance) if own_variance else 0.0
    widening = np.array([1.0, math.sqrt(
        (drift.covariance[0, 0] + drift.unobservable_variance + of_scale ** 2) / scatter[1, 1])])
    covariance = scatter * np.outer(widening, widening)
    # 24 places in a revolution, whose errors are independent
    place = np.floor(np.mod(turned, 1.0) * 24.0).astype(np.intp) % 24
    # what the prior of the lag leaves open
    covariance[0, 0] = max(covariance[0, 0], own_variance)
    if len(np.unique(place)) > 7:  # fewer do not determine a variance
        covariance[0, 0] = max(covariance[0, 0],
                               _scatter_between(place, fit.influence, turned)[0, 0])
    # the components of a misalignment scatter as the scale factor error does
    widening = covariance[0, 0] / fit.covariance[0, 0]
    bias = float(drift.values[0])
    return replace(fit, bias=bias, scale_factor_error=fit.scale_factor_error
                   + float(slope) * (bias - fit.bias), covariance=covariance,
                   misalignment_covariance=max(widening, 1.0) * fit.misalignment_covariance)


def _scatter_between(group: NDArray[np.intp], influence: Array, turned: Array) -> Array:
    """
    Return the covariance of (s, b) by sums over groups of blocks, with Student's factor.

    What a group leaves is less by its share in the fit than what it is in error (MacKinnon and
    White 1985), and the effective number of groups has the freedom.
    """
    leverage = np.array([np.gradient(turned) ** 2 + 1e-300, np.ones(len(turned))])
    shares = np.array([np.bincount(group, each) / each.sum() for each in leverage])
    sums = np.array([np.bincount(group, values) for values in influence[:, :2].T])
    sums /= np.maximum(1.0 - shares, 1e-3)
    freedom = np.maximum(1.0 / np.sum(shares ** 2, axis=1) - 1.0, 1.0)
    sums *= (stats.t.ppf(0.975, freedom) / stats.norm.ppf(0.975))[:, None]
    return np.asarray(sums @ sums.T)


def _heading_residual(time: Array, rate: Array, motion: Motion) -> Array:
    """Return heading of the gyro less that of the reference, rad, (n,); its mean is 0."""
    error = np.interp(motion.time, time, integrate(time, rate)) - motion.heading
    covered = (motion.time >= time[0]) & (motion.time <= time[-1])
    error = np.interp(motion.time, motion.time[covered], error[covered])
    for begin, end in _find_holes(time):  # the gyro's heading begins anew after it
        before, after = motion.time <= begin, motion.time >= end
        if before.any() and after.any():  # by medians, as single references may be wrong
            last = np.median(error[before][-15:])
            error[after] -= np.median(error[after][:15]) - last
            error[~(before | after)] = last
    return np.asarray(error - error.mean())


def _list_remarks(fit: ScaleBiasFit, motion: Motion, method: str,
                  technology: str) -> Iterator[str]:
    s, largest = fit.scale_factor_error, (COURSE_TREATMENT.largest_delay if method == 'course'
                                          else MAX_ENCODER_OFFSET)
    if abs(fit.time_offset) + NORMAL_QUANTILE_975 * fit.time_offset_deviation >= largest:
        yield (f'the delay of {fit.time_offset:.3f} s is at the limit of those that are possible '
               f'({largest:g} s either way), so gyro and reference may not be of one motion, or '
               'their stamps not of one clock: check them before the model is used')
    if fit.response_deviation ** 2 > 0.5 * fit.covariance[0, 0]:
        yield ('the motion hardly distinguishes a scale factor error from a smoothing or a lag, '
               f'as where it has one frequency; {100.0 * fit.response_deviation:.2g} % of the '
               'standard deviation are for that, as far as the delay shows it. Turn slowly, at '
               'several speeds, with stops')
    if fit.misalignment.size:
        angle, half, chance = oblique_angle(fit.misalignment, fit.misalignment_covariance)
        if chance < FALSE_ALARM_RATE:
            yield (f'the axis of the gyro is oblique to that of the attitude by '
                   f'{angle / DEGREE:.3g} +- {half / DEGREE:.2g} deg (95 %), so that parts of the '
                   f'rotations about other axes are in the output: {MISALIGNMENT_REMEDY}')
        yield ('the scale factor error is that of rotations about the axis of the attitude which '
               '--axis names, not about the own axis of the gyro')
    if method == 'course':
        if fit.reference_drift is not None:
            rate, half = (each / DEGREE for each in fit.reference_drift)
            yield (f'in motion the reference drifts by {rate:.3f} +- {half:.3f} deg/s (95 %) '
                   'against the rests in which it stands; the bias is that of the rests')
        elif fit.reference_adds_up:
            yield ('the reference stands in no rest: its drift in motion has the same effect as a '
                   'bias, which the intervals do not include; rest now and then')
        half = NORMAL_QUANTILE_975 * math.sqrt(fit.covariance[0, 0])
        largest, largest_bias = NORMAL_QUANTILE_975 * np.array(TECHNOLOGY_PRIORS[technology])
        if abs(fit.bias) > largest_bias:
            yield (f'the bias exceeds {largest_bias / DEGREE:.3g} deg/s, which is usual with the '
                   f'technology {technology}: check --technology and units')
        elif abs(s) > largest:
            yield ('the scale factor error is beyond what gyros of the technology '
                   f'{technology} have: check the units, and the size and distance of wheels')
        elif half > 1.001 * largest:
            yield ('the drive does not show whether the reference has a wrong scale, as of wheels '
                   'at another distance: turn more often')
        else:
            yield (f'scale factor error and bias have priors of the technology {technology} '
                   '(--technology)')
        if not fit.reference_adds_up:
            return
    reference_error = -s / (1.0 + s)
    yield (f'a reference that shows {abs(100 * reference_error):.2f} % too '
           f'{"much" if reference_error > 0.0 else "little"}, '
           f'{360.0 * (1.0 + reference_error):.2f} for 360 deg, '
           f'would have the same effect as this scale factor error of {100 * s:+.2f} %: '
           'check it over whole turns closed on a mark')
    if fit.shaft_error.size and (turned := float(np.ptp(motion.heading))) < math.tau:
        yield (f'the reference turns by {turned / DEGREE:.0f} deg in all, in which an error once '
               'in a revolution, as of an eccentric encoder, may have the effect of a scale '
               'factor error, 0.1 deg that of up to 0.17 %, beyond the interval: turn further')


#: Fewer dwells leave nothing over for two values, bias and scale factor error.
_MIN_DWELLS = 3
_HEADING_ALONE = ('a reference heading determines bias and scale_factor_error only; for other '
                  'effects use --method dwells')


def calibrate(logs: Mapping[str, Log], effects: Sequence[Effect] = (), method: str | None = None,
              technology: str | None = None) -> SelectedEffects | EncoderCalibration:
    """Calibrate by the dwells of logs, by their paths, or by the heading of one (`api.fit`)."""
    for log in logs.values():
        _refuse_own_reference(log)
    others = {effect.name for effect in effects} - {'bias', 'scale_factor_error'}
    tries_dwells = method == 'dwells' or method is None and (others or any(
        log.time is None or log.reference_rate is not None or log.reference_heading is None
        for log in logs.values()))
    remarks, chosen = list[str](), dict[str, Log]()
    for path, log in logs.items():
        for part in (choose_reference, drop_dead_output, drop_repeated_references):
            log, notes = part(log)
            remarks += notes
        chosen[path] = log
    logs = chosen
    if tries_dwells:
        is_settled = effects or method or len(logs) > 1
        share, parts = MIN_DWELL_SHARE if is_settled else FEW_DWELLS_SHARE, []
        try:
            for path, log in logs.items():
                name = Path(path).name if len(logs) > 1 else ''
                try:
                    parts.append(extract_dwells(log, name, share))
                except DataRefused as error:
                    if name:
                        raise type(error)(f'{name}: {error}') from None
                    raise
            table = join_dwells(parts)
            table = replace(table, remarks=(*remarks, *table.remarks))
            if is_settled or len(table) >= _MIN_DWELLS or any(
                    log.time is None for log in logs.values()):
                return (SelectedEffects(fit_effects(table, effects), (), ()) if effects
                        else select_effects(table, technology))
        except NothingSteady:
            if is_settled:
                raise
    if len(logs) > 1:
        raise InputError((f'--method {method} takes one log' if method else
                          'a log with a reference heading is fitted alone')
                         + '; give one log, or use --method dwells')
    if others:
        raise InputError(_HEADING_ALONE)
    (log,) = logs.values()
    found = calibrate_encoder(log, method, technology=technology or 'mems')
    if log.reference_heading is None:
        remarks.append(
            f'the log has a reference rate, which is constant {_MIN_DWELLS - 1} times at most, or '
            f'for up to {100.0 * FEW_DWELLS_SHARE:g} % of the time; so the rate is integrated, '
            'and headings are compared. For other effects than bias and scale factor error, hold '
            'each rate for some seconds')
    return replace(found, remarks=(*remarks, *found.remarks))


def _refuse_own_reference(log: Log) -> None:
    """Refuse a reference that follows the noise of the output: it is computed from it."""
    if log.time is None or log.output is None:
        return
    # by the rectangle rule or the trapezoid rule, with any scale and bias
    columns = np.column_stack([log.output[1:], log.output[:-1], np.ones(len(log) - 1)])
    rates = [] if log.reference_rate is None else [log.reference_rate[1:]]
    if log.reference_heading is not None:
        rates.append(np.diff(log.reference_heading) / np.diff(log.time))
    for rate in rates:
        known = np.isfinite(rate) & np.isfinite(columns).all(axis=1)
        shares = np.linalg.lstsq(columns[known], rate[known], rcond=1e-12)[0]
        left = np.abs(rate[known] - columns[known] @ shares)
        # by rounding; a second gyro that shares vibration differs by 1e-3 of the noise or more
        if np.count_nonzero(known) > 100 and np.quantile(left, 0.9) < (
                1e-6 * white_noise_deviation(columns @ shares, 6)):
            raise DataRefused('the reference is computed from this gyro, since it follows its '
                              'noise from sample to sample: give a reference without it')
