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
The kind of a reference, as found from a log: what it does in rests, in motion and when lost.

A course is lost at low speed, odometry stands in rests and errs in motion, an encoder has steps.
What errs in no such way is motion capture.
"""

from __future__ import annotations

from dataclasses import replace
import math
from typing import NamedTuple

from gyro_calibration.calibration.dwells import find_lost_reference
from gyro_calibration.calibration.heading_regression import (
    find_reference_delay, robust_least_squares)
from gyro_calibration.calibration.likelihood import robust_residual
from gyro_calibration.calibration.reference_noise import (
    COURSE_NOISE_RATIO, heading_difference, heading_white_noise, keep_own_instants, MAX_GYRO_LAG,
    MAX_ROUNDING_RATIO, MAX_ROUNDING_STEP)
from gyro_calibration.calibration.selection import FALSE_ALARM_RATE
from gyro_calibration.calibration.spans import CauseTerm, design_matrix, lay_out_spans, Spans
from gyro_calibration.heading.integration import integrate
from gyro_calibration.logs.log import Array, DEGREE, Log
from gyro_calibration.logs.quality import (
    bridge_gaps, cross_rotation, encoder_step, quantization_step, robust_deviation,
    white_noise_deviation)
import numpy as np
from scipy.stats import f as fisher
from scipy.stats import t as student
from scipy.stats import ttest_1samp

#: Least noise of a course, rad, over a second or from span to span; RTK in town has 0.4 deg.
_MIN_COURSE_NOISE = 0.25 * DEGREE
#: Lags that are fitted to see whether a motion follows a rate late, to both sides, s.
_ERROR_LAGS = np.array([0.0, 0.05, 0.1, 0.2, 0.4, 0.8])


def find_reference_kind(log: Log, spans: Spans | None = None) -> tuple[str, str]:
    """
    Return the kind of the reference of a log, as of `spans.lay_out_spans`, and how it is known.

    The spans are those of the log, if they have been laid out.
    """
    if log.reference_rate is not None and np.isfinite(log.reference_rate).any():
        return _as_odometry(log) or ('rate_command', 'the log has a reference rate')
    heading = log.reference_heading
    if heading is None or not np.isfinite(heading).any():
        return ('rest', 'the log has no reference')
    if is_course(log):
        lost = 100.0 * float(find_lost_reference(np.isfinite(heading)).mean())
        return ('course', f'the heading is lost for {lost:.2g} % of the log, as for a course at '
                'low speed, and its errors exceed those of the gyro')
    if (drift := find_drift(spans or lay_out_spans(log))) is not None:
        return ('odometry', 'it stands in the rests, and in motion drifts by '
                f'{drift[0] / DEGREE:.2g} +- {drift[1] / DEGREE:.2g} deg/s against them')
    step = encoder_step(heading)
    if 0.0 < step < MAX_ROUNDING_STEP:
        # The last digit of a file is a power of ten of a rad or a deg, or less than the noise of
        # the heading, which is also in its difference to that of the gyro, without the motion.
        powers = np.log10([step, step / DEGREE])
        if np.abs(powers - np.rint(powers)).min() < 1e-4 or step < heading_white_noise(log):
            step = 0.0
    if step:
        return ('encoder', f'the heading comes in steps of {step / DEGREE:.3g} deg')
    return _as_odometry(log) or (
        'motion_capture', 'the heading has no steps of an encoder')


def _as_odometry(log: Log) -> tuple[str, str] | None:
    """Return odometry and how it is known, if the errors of the reference add up in motion."""
    errors = _find_motion_errors(log)
    return None if errors is None else (
        'odometry', 'its errors add up in motion: over a second it differs from the gyro by '
        '{:.2g} deg in turns, by {:.2g} deg in rests or slow turns'.format(
            *np.array(errors) / DEGREE))


def is_course(log: Log) -> bool:
    """Tell whether a heading that is no attitude is lost at times and errs like a course."""
    log, _ = keep_own_instants(log)
    assert log.time is not None and log.output is not None and log.reference_heading is not None
    known = np.isfinite(log.reference_heading)
    lost = float(find_lost_reference(known).mean())
    rows = np.flatnonzero(known)
    if lost == 0.0 or len(rows) < 2 or cross_rotation(log).size:
        return False
    stamps, (first, last) = log.time[rows], rows[[0, -1]]
    at_ends = max(stamps[0] - log.time[0], log.time[-1] - stamps[-1])
    # a recorder does not begin, nor end, to receive all topics at once
    if (at_ends <= max(5.0 * float(np.median(np.diff(stamps))), 0.1)
            and not find_lost_reference(known[first:last + 1]).any()):
        return False
    walk = white_noise_deviation(log.output) * math.sqrt(float(np.median(np.diff(log.time))))
    bent = np.abs(np.diff(log.reference_heading, 2))
    usual, large = (np.nanquantile(bent, [0.9, 0.99]) if np.isfinite(bent).any() else (0.0, 0.0))
    # a heading between slower fixes is on straight lines
    larger = 2.0 if usual < 0.1 * large and lost > 0.003 else COURSE_NOISE_RATIO
    # an encoder errs by its rounding; a difference over a second has 3 times the variance
    rounding = quantization_step(log.reference_heading[known]) / 2.0
    return heading_difference(log).total_walk > max(larger * walk, MAX_ROUNDING_RATIO * rounding,
                                                    _MIN_COURSE_NOISE)


def find_drift(spans: Spans) -> tuple[float, float] | None:
    """
    Return how a reference drifts in motion, and half the interval of 95 %, rad/s.

    The bias that the motion shows is compared with that of the rests in which the reference
    stands, beside steady changes and what depends on the rate. None without such rests, or where
    both agree as a whole (Welch's test, at 0.01 %) or in the ways from rest to rest (at 1 %).
    """
    rests = spans.rests[spans.stands]
    if len(rests) < 2:
        return None
    time, output = np.asarray(spans.log.time), np.asarray(spans.log.output)
    halves = [half for first, last in rests
              for half in np.array_split(np.arange(first, last + 1), 2)]
    middle, means = 0.5 * time[-1], np.array([output[half].mean() for half in halves])
    spans = spans.with_corrected_rate(np.array([0.0, means.mean(), 0.0]))
    rows = np.column_stack([spans.observed, design_matrix(
        spans, [CauseTerm('rate_ramp'), CauseTerm('scale_factor_asymmetry')])])
    rows = -rows[:len(spans.time) - 1]
    rows = rows[rows[:, 2] > 0.0]
    in_motion = np.insert(rows[:, [2, 1, 3, 6]], 1, rows[:, 5] - middle * rows[:, 2], axis=1)
    at_rest = np.array([(1.0, time[half].mean() - middle) for half in halves])
    if any(len(each) <= each.shape[1] for each in (in_motion, at_rest)):
        return None
    of_motion, one, freedom_of_one, left = _weighted_fit(in_motion, rows[:, 0], 1.0 / rows[:, 2])
    of_rests, other, freedom_of_other, _ = _weighted_fit(
        at_rest, means, np.array([len(half) for half in halves], dtype=float))
    freedom = (one + other) ** 2 / (one ** 2 / freedom_of_one + other ** 2 / freedom_of_other
                                    + 1e-300)
    drift = of_rests[0] - of_motion[0]
    deviation = math.hypot(math.sqrt(one + other), spans.rest_rounding)
    # with a drifting bias, exact encoders are beyond 1 % more often than stated
    if abs(drift) <= student.isf(5e-5, freedom) * deviation:
        return None
    # the bias on each way from rest to rest, and that of the rests around it
    way = np.searchsorted(time[rests[:, 0]], in_motion[:, 1] / in_motion[:, 0] + middle) - 1
    ways = len(rests) - 1
    inside = (way >= 0) & (way < ways)
    turned, duration = (np.bincount(way[inside], each[inside], ways) for each in (
        in_motion[:, :2] @ of_motion[:2] + left, in_motion[:, 0]))
    of_each = means.reshape(-1, 2).mean(axis=1)
    known = duration > 0.0
    differences = (turned[known] / duration[known]
                   - 0.5 * (of_each[1:] + of_each[:-1])[known])
    if len(differences) < 3 or ttest_1samp(differences, 0.0).pvalue > 0.01:
        return None
    return drift, float(student.ppf(0.975, freedom)) * deviation


def _weighted_fit(columns: Array, observed: Array,
                  weights: Array) -> tuple[Array, float, int, Array]:
    """Return values, variance of the first, its degrees of freedom, and residual."""
    root, freedom = np.sqrt(weights), len(columns) - columns.shape[1]
    inverse = np.linalg.pinv(root[:, None] * columns)
    values = inverse @ (root * observed)
    left = observed - columns @ values
    variance = float(weights @ left ** 2 / freedom * inverse[0] @ inverse[0])
    return values, variance, freedom, left


class _Seconds(NamedTuple):
    """Whole seconds of a log, and by what gyro and reference differ beyond a fit, rad."""

    turns: Array  # of the reference, of each second in motion, shape (m,)
    in_motion: Array  # differences, shape (m,)
    at_rest: Array  # differences, shape (r,)
    value_count: int  # of the fit


def _find_motion_errors(log: Log) -> tuple[float, float] | None:
    """
    Return how odometry errs over a second in turns, and the gyro in rests or slow turns, rad.

    In motion the variance of the difference of their turns is more than twice that of rests, or of
    the slower half where a heading never rests (F-test, at 1 %), beyond what smooth functions of
    the rate explain (differences of neighbours: Rice, Annals of Statistics 12, 1984). None for
    another reference, one that is mostly steady in motion, and one that the motion follows late,
    as a command.
    """
    seconds = _compare_seconds(log)
    if seconds is None:
        return None
    turns, errors, at_rest, value_count = seconds
    # the median of differences has a third of the freedom of a variance
    freedom = (len(errors) - value_count) / 3.0, len(at_rest) - 2.0
    faster = np.abs(turns) > np.median(np.abs(turns))
    if freedom[1] >= 1.0:
        # the rounding of an output with little noise does not scatter in rests
        inliers = at_rest - np.median(at_rest)
        inliers = inliers[np.abs(inliers) <= 5.0 * robust_deviation(inliers)]
        usual, faster = float(np.std(inliers)), faster | True
    # errors of a heading that do not add up cancel in neighbouring seconds
    elif log.reference_rate is not None or robust_deviation(
            errors[1:] + errors[:-1]) < math.sqrt(1.5) * robust_deviation(errors):
        return None
    else:
        usual, freedom = _scatter(turns[~faster], errors[~faster]), (0.5 * freedom[0],) * 2
    if freedom[0] < 1.0:
        return None
    assert log.output is not None
    of_turns = _scatter(turns[faster], errors[faster])
    rounding = [quantization_step(log.output[np.isfinite(log.output)])]
    if log.reference_rate is None:
        assert log.reference_heading is not None
        known = np.isfinite(log.reference_heading)
        rounding.append(math.sqrt(2.0) * quantization_step(log.reference_heading[known]))
    usual = math.hypot(usual, *np.array(rounding) / math.sqrt(12.0))
    return ((of_turns, usual)
            if of_turns ** 2 > 2.0 * usual ** 2 * fisher.isf(FALSE_ALARM_RATE, *freedom) else None)


def _compare_seconds(log: Log) -> _Seconds | None:
    """
    Return the differences of gyro and reference over seconds, robustly; None for another motion.

    A delay, a lag, an error once per revolution, powers of the rate and a slow drift are fitted.
    """
    time, by_rate = log.time, log.reference_rate is not None
    reference = log.reference_rate if by_rate else log.reference_heading
    known = np.isfinite([] if reference is None else reference)
    if reference is None or time is None or log.output is None or not known.any():
        return None
    reference = np.interp(time, time[known], reference[known])
    rate = reference if by_rate else np.gradient(reference, time)
    turned = integrate(time, bridge_gaps(log.output))
    powers = [integrate(time, each) for each in (
        rate, np.abs(rate), rate ** 2, rate ** 3, (time - time.mean()) * rate)]
    if not by_rate:
        powers += [np.sin(reference), np.cos(reference)]
    at = np.arange(time[0] + _ERROR_LAGS[-1], time[-1] - _ERROR_LAGS[-1], 1.0)
    if len(at) < 2:
        return None
    # an output at its limits does not show the motion
    limits = np.nanmin(log.output), np.nanmax(log.output)
    is_lost = ~np.isfinite(log.output) | np.isin(log.output, limits) | find_lost_reference(known)
    counts = np.cumsum([np.ones(len(time)), is_lost, rate != 0.0,
                        np.diff(rate, prepend=rate[0]) != 0.0], axis=1)
    samples, lost, moved, changed = np.diff(counts[:, np.searchsorted(time, at)])
    is_whole = (lost == 0.0) & (samples > 0.5 * np.median(samples))
    in_motion, at_rest = is_whole & (moved > 0.5 * samples), is_whole & (moved == 0.0)
    if 2 * (in_motion & (changed == 0.0)).sum() >= in_motion.sum():
        return None
    lags = np.append(-_ERROR_LAGS[:0:-1], _ERROR_LAGS)
    columns = np.column_stack([
        *(np.diff(np.interp(at - lag, time, powers[0])) for lag in lags),
        *(np.diff(np.interp(at, time, each)) for each in powers[1:]),
        np.linspace(-1.0, 1.0, len(at) - 1)[:, None] ** np.arange(4.0), in_motion])  # a warm-up
    observed: Array = np.diff(np.interp(at, time, turned))
    values, _ = robust_least_squares(columns[is_whole], observed[is_whole],
                                     np.full(columns.shape[1], math.inf))
    response = values[:len(lags)]
    if response @ lags > MAX_GYRO_LAG * response.sum():
        return None
    left = observed - columns @ values
    return _Seconds(columns[in_motion, _ERROR_LAGS.size - 1], left[in_motion], left[at_rest],
                    columns.shape[1])


def _scatter(turns: Array, errors: Array) -> float:
    """Return the standard deviation of errors about a smooth function of the turns."""
    along = errors[np.argsort(turns, kind='stable')]
    return robust_deviation(np.diff(along)) / math.sqrt(2.0)


def is_noisy(log: Log, spans: Spans) -> bool:
    """Tell whether a heading has no steps and is as noisy from span to span as a course."""
    assert log.reference_heading is not None
    if cross_rotation(log).size or quantization_step(
            log.reference_heading[np.isfinite(log.reference_heading)]) > MAX_ROUNDING_STEP:
        return False
    count = len(spans.time) - 1
    if count < 10:
        return False
    spans = replace(spans, delay=find_reference_delay(spans))
    # an eccentric encoder is no course
    columns = np.column_stack([
        spans.base_columns(), spans.acceleration_changes(),
        spans.cause_columns(CauseTerm('reference_once_per_rev'))])[:count]
    residual = robust_residual(columns, spans.observed[:count], 10)
    # at a steady rate, an output with steps above its noise errs by up to half of one
    step = spans.output_step
    is_coarse = white_noise_deviation(np.asarray(log.output)) < 0.5 * step
    return robust_deviation(residual) > max(
        math.sqrt(2.0) * _MIN_COURSE_NOISE,
        is_coarse * 0.5 * step * float(np.median(np.diff(spans.time))))
