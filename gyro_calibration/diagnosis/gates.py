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
Conditions for a diagnosis: usable logs and models, and a reference of the motion of the gyro.

Over spans, the change of the reference heading is regressed on the integral of the output and on
time, at the lag of the best agreement. A factor far from 1 indicates a unit, a sign or a unit of
time; a low coherence over all lengths of span, or over long ones, another motion, or an axis that
tilts. A gate that fails is the only finding.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
import math
from typing import NamedTuple

from gyro_calibration.calibration.dwells import (
    few_values_remedy, find_lost_reference, require_output)
from gyro_calibration.calibration.encoder import choose_reference
from gyro_calibration.calibration.reference_kind import find_reference_kind
from gyro_calibration.calibration.reference_noise import (
    heading_difference, heading_noise_share, interpolate_by_splines, is_slow,
    MAX_GYRO_LAG, MAX_ROUNDING_RATIO, rate_noise_share, step_evenness)
from gyro_calibration.calibration.run_faults import (
    fit_scale, reference_angle, UNIT_TOLERANCE)
from gyro_calibration.calibration.selection import FALSE_ALARM_RATE
from gyro_calibration.diagnosis.findings import Diagnosis, Estimate, Finding, Gate, Reference
from gyro_calibration.heading.integration import integrate, MAX_GAP
from gyro_calibration.logs.log import (
    Array, DataRefused, DEGREE, Log, MAX_PLAUSIBLE_FACTOR, NORMAL_QUANTILE_975, refuse_wrapped)
from gyro_calibration.logs.quality import (
    bridge_gaps, cross_rotation, encoder_step, find_codes, robust_deviation, white_noise_deviation)
from gyro_calibration.model.gyro_model import GyroModel
from gyro_calibration.model.noise import Noise
import numpy as np
from scipy import stats
from scipy.interpolate import make_interp_spline
from scipy.signal import savgol_filter

#: Common confusions: degrees and radians, the sense of rotation, two ranges of a gyro.
_FACTORS = {'pi/180': DEGREE, '180/pi': 1.0 / DEGREE, '2': 2.0, '1/2': 0.5}
_COMMON_FACTORS: Mapping[str, float] = {
    **_FACTORS, '-1': -1.0, **{f'-{name}': -value for name, value in _FACTORS.items()}}
#: And powers of two instead of powers of ten.
UNIT_FACTORS: Mapping[str, float] = {
    **_COMMON_FACTORS, **{f'{2 ** power}/1000': 2 ** power / 1000.0 for power in range(1, 17)}}
#: Largest relative difference between a factor and that of a unit.
_MAX_FACTOR_ERROR = 0.005
#: Largest standard deviation of a factor as a share of its distance to 1, and of a delay as a
#: share of the sample interval.
_MAX_DEVIATION = 0.1


def identify_unit_factor(factor: float, deviation: float) -> str | None:
    """
    Return the confusion of units, such as 'pi/180', that explains a factor, or None.

    Far from 1, no gyro has such a scale factor, and a scale factor error of up to a tenth is
    allowed in addition to a confusion. Near 1, the factor must agree within two standard
    deviations, and its standard deviation must be below a fiftieth of its distance from 1.
    """
    matches = []
    for name, value in UNIT_FACTORS.items():
        least, known = ((_MAX_FACTOR_ERROR, _MAX_DEVIATION) if is_implausible_factor(value)
                        else (1e-4, 0.02))
        if (abs(factor - value) < max(2.0 * deviation, least * abs(value))
                and abs(factor / value - 1.0) < _MAX_FACTOR_ERROR
                and deviation < known * min(abs(value - 1.0), abs(value))):
            matches.append(name)
    distant = [name for name, value in _COMMON_FACTORS.items()
               if _factor_ratio(factor, value) < UNIT_TOLERANCE
               and deviation < _MAX_DEVIATION * abs(factor)]
    return min(matches, key=lambda name: abs(factor - UNIT_FACTORS[name]),
               default=next(iter(distant), None))


def is_implausible_factor(factor: float) -> bool:
    """Tell whether a factor is not plausible for a gyro with the right unit."""
    return _factor_ratio(factor, 1.0) > MAX_PLAUSIBLE_FACTOR


def _factor_ratio(factor: float, value: float) -> float:
    """Return the ratio of two factors, above 1; infinite if their signs differ."""
    return math.inf if factor * value <= 0.0 else max(factor / value, value / factor)


def is_sample_offset(estimate: float, deviation: float, interval: float) -> bool:
    """Tell whether a time offset is a sample interval or half of it within 2 sigma; all in s."""
    return deviation <= _MAX_DEVIATION * interval and any(
        abs(abs(estimate) - offset) < max(2.0 * deviation, 1e-3 * interval)
        for offset in (interval, 0.5 * interval))


class _LineFit(NamedTuple):
    """Output = factor * rate + offset."""

    factor: float
    offset: float
    deviation: float  # standard deviation of the factor


def reference_rate(log: Log) -> Array | None:
    """Return the reference rate, rad/s, nan in gaps; None without a reference."""
    if log.reference_rate is not None and np.isfinite(log.reference_rate).any():
        return log.reference_rate
    if (log.reference_heading is None or log.time is None
            or np.isfinite(log.reference_heading).sum() < 2):
        return None
    known = np.isfinite(log.reference_heading)
    # parabolas over 0.15 s; shorter ones would show the quantization of the heading
    length = min(max(5, 2 * round(0.075 / float(np.median(np.diff(log.time)))) + 1),
                 (len(known) - 1) // 2 * 2 + 1)
    if length < 3:
        return None
    smooth = savgol_filter(bridge_gaps(log.reference_heading), length, 2)
    return np.where(known, np.gradient(smooth, log.time), np.nan)


def spline_rate(time: Array, heading: Array) -> Array:
    """Return the rate of a heading by a quintic spline, gaps interpolated, rad/s, shape (n,)."""
    known = np.isfinite(heading)
    whole = np.interp(time, time[known], heading[known])
    return np.asarray(make_interp_spline(time, whole, 5)(time, 1))


def fit_line(time: Array | None, rate: Array, output: Array) -> _LineFit | None:
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
        if len(rate) < 8:
            return None
    low, high = output.min(), output.max()
    # without the ends, which may be clipped, unless most samples are there
    ends = 0.05 * (high - low)
    inliers = (output > low + ends) & (output < high - ends)
    if np.count_nonzero(inliers) < 8 or not np.ptp(rate[inliers]) > 0.3 * np.ptp(rate):
        inliers = np.ones(len(rate), dtype=bool)
    columns = np.column_stack([rate, np.ones(len(rate))])
    for _ in range(4):
        if np.count_nonzero(inliers) < 8 or not np.ptp(rate[inliers]) > 0.0:
            return None
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
    variance = max((inverse @ scores @ scores.T @ inverse)[0, 0], 0.0)
    return _LineFit(float(solution[0]), float(solution[1]), float(student * math.sqrt(variance)))


def model_scale_factor(model: GyroModel, rate: Array) -> float:
    """Return the slope of a model's output between the 90 % quantiles of the speed, both ways."""
    speeds = np.abs(rate[np.isfinite(rate)])
    speed = float(np.quantile(speeds, 0.9)) if speeds.size else 0.0
    if speed == 0.0:
        return 1.0
    forth, back = (float(model.output(sign * speed, model.reference_temperature))
                   for sign in (1.0, -1.0))
    return (forth - back) / (2.0 * speed)


# logs that are refused

#: Least number of samples and least duration, s, of a log in time, least number of rows of a rate
#: table, and least share of samples with values.
MIN_SAMPLES, _MIN_DURATION, _MIN_TABLE_ROWS, MIN_VALID_SHARE = 100, 20.0, 8, 0.1
#: Largest number of rows of a rate table; more are samples whose time is missing.
_MAX_TABLE_ROWS = 5000
#: Longest log, s: three years; a longer one has stamps in another unit.
_MAX_DURATION = 1e8


def refuse_unusable(log: Log) -> None:
    """
    Raise for a log that cannot be diagnosed.

    Raises
    ------
    DataRefused : with the reason and the remedy

    """
    output = require_output(log)
    log, _ = select_reference(log)
    if log.reference_rate is None:
        refuse_wrapped(log)
    known = np.isfinite(output)
    reference = log.reference_heading if log.reference_rate is None else log.reference_rate
    has_reference = (np.zeros(len(known), dtype=bool) if reference is None
                     else np.isfinite(reference))
    both = int(np.count_nonzero(known & has_reference))
    if log.time is None:
        if both < _MIN_TABLE_ROWS:
            raise DataRefused(
                f'the log has no time_s, and {both} rows with output and reference_rate_dps; '
                f'as a rate table it needs at least {_MIN_TABLE_ROWS}, and as samples in time '
                'it needs time_s: add rows, or give --rate')
        if both > _MAX_TABLE_ROWS:
            raise DataRefused(
                f'the log has no time_s, and {both} rows, where a rate table has at most '
                f'{_MAX_TABLE_ROWS}: add time_s, or give the sample rate with --rate')
    else:
        count, duration = int(np.count_nonzero(known)), log.time[-1] - log.time[0]
        if count < max(MIN_SAMPLES, MIN_VALID_SHARE * len(known)):
            raise DataRefused(
                f'the gyro has a value in {count} of {len(known)} samples; at least '
                f'{MIN_SAMPLES} and a tenth are needed: record again, and repair the line if '
                'it loses samples')
        if duration < _MIN_DURATION:
            raise DataRefused(f'the log lasts {duration:.4g} s; a diagnosis needs at least '
                              f'{_MIN_DURATION:g} s: record longer')
        if duration > _MAX_DURATION:
            raise DataRefused(f'the log lasts {duration:.3g} s by its stamps; check that time_s '
                              'is in s, or give --rate')
        if reference is None and not is_at_rest(log):
            raise DataRefused(
                'the log has no reference, and the gyro is not at rest: add reference_rate_dps '
                'or reference_heading_deg, or let it rest, and add a column moving of zeros')
        covered = np.count_nonzero(known & ~find_lost_reference(has_reference))
        is_lost = bool(covered < MIN_VALID_SHARE * len(known))
        if reference is not None and (both < MIN_SAMPLES or is_lost):
            raise DataRefused(
                f'the reference has a value in {both} of {len(known)} samples; at least '
                f'{MIN_SAMPLES}{", and a tenth or at even intervals," * is_lost} are needed: '
                f'{few_values_remedy(log.time, known & has_reference, MIN_SAMPLES)}')
    values, counts = np.unique(output[known], return_counts=True)
    share = counts.max() / counts.sum()
    if share > 0.99:
        raise DataRefused(
            f'the gyro gives {values[counts.argmax()] / DEGREE:.6g} deg/s in '
            f'{100.0 * share:.4g} % of the samples: it is dead, or its quantization step '
            'exceeds all rates of the log; check it, and record again')
    _refuse_copy(log, output)


def select_reference(log: Log) -> tuple[Log, tuple[str, ...]]:
    """Return a log with the reference of `choose_reference`, 0 where it is noise, and remarks."""
    if log.time is None:
        return log, ()
    log, notes = choose_reference(log, prefer_rate=True)
    rate = reference_rate(log)
    if rate is None or not np.nanmax(np.abs(rate)) > 0.0 or not is_at_rest(log):
        return log, tuple(notes)
    return (replace(log, reference_rate=0.0 * rate, reference_heading=None),
            (*notes, 'The reference shows noise alone, which the gyro does not measure; '
             'the gyro is taken to be at rest.'))


def resample_reference(log: Log) -> Log:
    """Return a log with references on splines if they have a lower rate than the output."""
    if log.time is None:
        return log
    rate, heading = (None if values is None else interpolate_by_splines(log.time, values)
                     for values in (log.reference_rate, log.reference_heading))
    return replace(log, reference_rate=rate, reference_heading=heading)


def is_at_rest(log: Log) -> bool:
    """Tell whether a gyro is at rest in the whole log: by reference, moving flag, or output."""
    rate = reference_rate(log)
    if rate is None:
        if log.moving is not None:
            return bool((log.moving == 0.0).all())
        if log.time is None or log.output is None or np.isfinite(log.output).sum() < MIN_SAMPLES:
            return False
        second = np.floor(log.time - log.time[0]).astype(np.int64)
        second = np.unique(second, return_inverse=True)[1]
        means = np.bincount(second, bridge_gaps(log.output)) / np.bincount(second)
        return float(np.abs(means - np.median(means)).max()) < 3.0 * DEGREE
    fastest = np.nanmax(np.abs(rate))
    if not fastest > 0.0:
        return True
    # a rate that is noise: no rotation, and no output follows it
    if log.time is None or log.output is None or log.moving is not None and log.moving.any():
        return False
    steps, whole = np.diff(log.time), bridge_gaps(rate)
    noise = white_noise_deviation(whole) * math.sqrt(float(np.median(steps) * steps.sum()))
    if np.ptp(np.cumsum(whole[1:] * steps)) > 1.0 * DEGREE + 4.0 * noise:
        return False
    # Scaled, as a very small rate would be numerically zero next to the constant of the line.
    line = fit_line(log.time, rate / fastest, log.output)
    return line is None or abs(line.factor) < 4.0 * line.deviation


def _refuse_copy(log: Log, output: Array) -> None:
    """Refuse a reference computed from the output, or an output computed from the reference."""
    rates = [] if log.reference_rate is None else [log.reference_rate]
    if log.reference_heading is not None and log.time is not None:
        steps = np.diff(log.reference_heading) / np.diff(log.time)
        before, after = np.append(steps, np.nan), np.insert(steps, 0, np.nan)
        rates += [before, after, 0.5 * (before + after)]
    for rate in rates:
        known = np.isfinite(rate) & np.isfinite(output)
        if np.count_nonzero(known) < _MIN_TABLE_ROWS or not np.var(rate[known]) > 0.0:
            continue
        spread, slope = float(np.std(output[known])), fit_scale(output[known], rate[known])[1]
        offset = float(output[known].mean() - slope * rate[known].mean())
        off = float(np.std(output[known] - slope * rate[known])) / spread
        # or no more than the rounding of both in the file
        printed = math.hypot(find_codes(output[known]).step,
                             slope * find_codes(rate[known]).step) / spread
        if off < max(1e-6, 0.5 * printed * (printed < 2e-5)):
            raise DataRefused(
                f'the output is {slope:.6g} times the reference plus {offset / DEGREE:.4g} '
                'deg/s, to the last digit: one was computed from the other, without noise; '
                'give an independent reference, or a simulation with noise')


def _unit_problem(log: Log, model: GyroModel) -> str:
    """Return why the values of a model are implausible for a log, as in deg/s; '' if they fit."""
    output, rate = require_output(log), reference_rate(log)
    line = None if rate is None else fit_line(log.time, rate, output)
    scale = 1.0 if rate is None or line is None else model_scale_factor(model, rate)
    if not 0.1 < abs(scale) < 10.0:
        return (f'the scale factor of the model is {scale:.4g}, which is not plausible: it has '
                'other units; write it in rad/s, or fit it again')
    fastest = float(np.nanquantile(np.abs(output if rate is None else rate), 0.99))
    widest = max(abs(limit) for limit in model.rate_range)
    if fastest > 20.0 * widest:
        return (f'the model is for rates up to {widest / DEGREE:.4g} deg/s, and the log goes to '
                f'{fastest / DEGREE:.4g} deg/s: it has other units, or belongs to another gyro; '
                'write it in rad/s, or fit it again')
    simulated = model.noise.angle_random_walk
    if log.time is None or not simulated > 0.0:
        return ''
    ratio = (white_noise_deviation(output) * math.sqrt(float(np.median(np.diff(log.time))))
             / simulated)
    if 1e-3 < ratio < 1e3 and not (is_degree_ratio(ratio) and is_at_rest(log)):
        return ''
    return (f'the log has {ratio:.3g} times the angle random walk of the model, {simulated:.3g} '
            'rad/√s: the model has other units, or belongs to another gyro; write its noise in '
            'rad/√s, or take it from `allan`')


def is_degree_ratio(ratio: float) -> bool:
    """Tell whether a ratio of noises is near that of deg and rad."""
    return any(1.0 / 1.3 < ratio * factor < 1.3 for factor in (DEGREE, 1.0 / DEGREE))


#: Least number of spans for a comparison.
_MIN_SPANS = 12
#: Common share of the variance below which gyro and reference show different motions; it may be
#: lower over long spans by half of that.
_MIN_MOTION_COHERENCE = 0.4
#: Largest trial lag and distance of trial lags, in spans; and ratio of the lags at which a motion
#: follows its reference.
_MAX_LAG_SPANS, _LAG_STEP, _LAG_RATIO = 25, 0.25, 1.5
#: Plausible sample intervals, s, for which a power of ten is taken for a unit of time.
_SAMPLE_INTERVAL_RANGE = (2e-5, 0.25)


class _Agreement(NamedTuple):
    """Agreement of the heading of the reference with the integral of the output over spans."""

    # factor, deviation: change of the reference over that of the integral; its standard deviation
    factor: float
    deviation: float
    coherence: float  # common share of the variance
    residual: float  # standard deviation, rad
    noise_share: float  # largest share of the variance of the integral that may be white noise
    lag: float = 0.0  # of the reference behind the integral, s
    span: float = 0.0  # shortest one, s


def check_gates(log: Log, model: GyroModel | None = None, is_command: bool = False
                ) -> tuple[Gate, ...]:
    """
    Return the gates of a log with a reference, up to the first that failed.

    The motion may follow a command with any response, which is fitted later.
    """
    log, _ = choose_reference(log, prefer_rate=True)
    results = [] if log.output is None else list(_run_gates(log, model))
    first = next((place for place, gate in enumerate(results) if gate.passed is False), None)
    if first is None:
        return tuple(results)
    failed, results = results[first], results[:first]
    if log.time is None or log.output is None or log.reference_rate is None:
        return (*results, failed)
    # A motion may follow a rate late: later than a gyro, and not in the ratio of two units at all
    # frequencies, as a robot follows its command; it turns opposite to a swing half a period later
    reference = reference_angle(log)
    best = max(compare_headings(log, reference), key=lambda each: each.coherence, default=None)
    if best is None or abs(best.lag) <= max(MAX_GYRO_LAG, _LAG_STEP * best.span):
        return (*results, failed)
    # The gain is the sum of the response at lags from 0 to 25 spans, each with a prior of 0 +- 1.
    turned, span = integrate(log.time, bridge_gaps(log.output)), best.span
    lags = span * np.append(0.0, _LAG_RATIO ** np.arange(
        int(math.log(_MAX_LAG_SPANS) / math.log(_LAG_RATIO)) + 1))
    at = np.arange(log.time[0] + lags[-1], log.time[-1], span)
    moved = np.diff(np.interp(at, log.time, turned))
    columns = np.array([*(np.diff(np.interp(at - lag, log.time, reference)) for lag in lags),
                        np.full(len(moved), span)]).T
    left = moved - columns @ np.linalg.lstsq(columns, moved, rcond=None)[0]
    variance = float(left @ left) / (len(left) - len(lags) - 1)
    inverse = np.linalg.inv(columns.T @ columns + variance * np.diag([*np.ones(len(lags)), 0.0]))
    sums = inverse[:-1].sum(axis=0)
    gain, deviation = float(sums @ (columns.T @ moved)), math.sqrt(variance * sums[:-1].sum())
    # how well the motion follows
    coherence = 1.0 - float(np.var(left) / max(np.var(moved), np.finfo(float).tiny))
    if gain < -5.0 * deviation and not is_implausible_factor(-gain):
        failed = next(each for each in _unit_gates(gain, deviation, log) if each.passed is False)
    elif coherence >= _MIN_MOTION_COHERENCE and (
            failed.name == 'motion' or deviation >= _MAX_DEVIATION * abs(gain)
            or _factor_ratio(gain, 1.0 / best.factor) >= UNIT_TOLERANCE):
        evidence = (f'{100.0 * coherence:.3g} % of the variance of the heading over spans follows '
                    'the reference, but late, and slow motion in another ratio than fast motion')
        failed = (Gate('motion', None, evidence) if is_command
                  else Gate('motion', False, evidence,
                            'if this is the command of a robot, state --reference-kind '
                            'rate_command, and turn at several rates for several seconds each, '
                            'with rests; otherwise give a reference of this motion, with stamps '
                            'of the same clock'))
    return (*results, failed)


def examine_log(log: Log, model: GyroModel | None = None, is_command: bool = False,
                given_log: Log | None = None) -> tuple[Gate, ...]:
    """
    Return the gates of a log and its model, up to the first that failed.

    Raises `DataRefused` for a log that cannot be diagnosed, as it was given if that differs.
    """
    gates = check_gates(log, model, is_command)
    have_passed = all(gate.passed is not False for gate in gates)
    if have_passed or gates[-1].name != 'wrapped_heading':
        refuse_unusable(log if given_log is None else given_log)
    if have_passed and model is not None:
        problem = _unit_problem(select_reference(log)[0], model)
        evidence, _, remedy = problem.partition('; ')
        gates += (Gate('model', False, evidence, remedy) if problem
                  else Gate('model', True, 'model and log have the same units')),
    return gates


def _run_gates(log: Log, model: GyroModel | None) -> Iterator[Gate]:
    assert log.output is not None
    if log.time is None:
        line = (None if log.reference_rate is None
                else fit_line(None, log.reference_rate, log.output))
        if line is not None:
            yield from _unit_gates(line.factor, line.deviation, log)
        return
    if log.reference_heading is None and log.reference_rate is None:
        return
    if log.reference_rate is None:
        try:
            refuse_wrapped(log)
            yield Gate('wrapped_heading', True, 'the reference heading is continuous')
        except DataRefused as refusal:
            yield Gate('wrapped_heading', False, str(refusal).rpartition(':')[0],
                       'unwrap the reference heading (--unwrap)')
    reference = reference_angle(log)
    if not np.isfinite(log.output).any():
        yield Gate('motion', False, 'the output of the gyro has no numbers',
                   'check its column, and the line that it came by')
        return
    by_length = compare_headings(log, reference)
    if not by_length:
        still = replace(log, reference_rate=None, reference_heading=None, moving=None)
        differs = not np.ptp(reference) > 0.0 and not is_at_rest(still)
        evidence, remedy = (('the reference stands, and the gyro turns',
                             'give a reference of this motion') if differs
                            else ('the reference turns too little, or too evenly, to compare it '
                                  'with the gyro', ''))
        yield Gate('motion', False if differs else None, evidence, remedy)
        return
    best = max(by_length, key=lambda each: each.coherence)
    if best.coherence < _MIN_MOTION_COHERENCE:
        yield _motion_gate(best, by_length, float(np.ptp(reference)), log)
        return
    own = 1.0 if model is None else model_scale_factor(model, np.gradient(reference, log.time))
    # a model with other units is refused by `check_model_units`
    scale = best.factor * (own if 0.1 < abs(own) < 10.0 else 1.0)
    relative = best.deviation / abs(best.factor)
    is_certain, unit = best.coherence > 0.8, (1.0 / scale, relative / abs(scale))
    # the scale nearest to 1 that is not excluded; noise of the gyro reduces it
    half = NORMAL_QUANTILE_975 * relative
    is_excluded = is_implausible_factor(math.copysign(
        min(max(1.0, abs(scale) * (1.0 - half)), abs(scale) * (1.0 + half) / best.coherence),
        scale))
    yield _motion_gate(best, by_length, float(np.ptp(reference)), log)
    if is_certain or is_excluded:
        yield from _unit_gates(*unit, log)


def _motion_gate(best: _Agreement, by_length: Sequence[_Agreement], turned_angle: float,
                 log: Log) -> Gate:
    evidence = (f'{100.0 * best.coherence:.3g} % of the variance of the heading over spans is '
                'common to gyro and reference')
    longest = by_length[-1]
    if best.coherence - longest.coherence > 0.5 * _MIN_MOTION_COHERENCE:
        evidence += f', and {100.0 * longest.coherence:.2g} % over the longest ones'
    elif best.coherence >= _MIN_MOTION_COHERENCE:
        return Gate('motion', True, evidence)
    # errors leave the factor as it is: the reference may have made half the turns of the gyro
    if turned_angle < 30.0 * DEGREE or longest.residual < 10.0 * DEGREE and all(
            each.factor + NORMAL_QUANTILE_975 * each.deviation > 0.5 * (1.0 - each.noise_share)
            for each in by_length):
        return Gate('motion', best.coherence >= _MIN_MOTION_COHERENCE or None,
                    f'{evidence}; the difference is within the errors of a reference')
    others = [name for name in log.others if 'gyro' in name.lower()]
    axis = f'; or take another axis of the gyro ({", ".join(others[:3])})' if others else ''
    return Gate('motion', False, evidence, 'give a reference of this motion and this axis, with '
                'errors below its turns and stamps of the same clock; where the sensor tilts or '
                'tumbles, transform the rates of all three axes into the frame of the reference '
                f'first{axis}')


def _unit_gates(factor: float, deviation: float, log: Log) -> Iterator[Gate]:
    """Give the gates of sense and unit, by the factor of the output over the reference."""
    evidence = f'the output is {factor:.4g} times the reference'
    if not is_implausible_factor(factor):
        yield Gate('sense', True, f'{evidence}: the same sense')
        yield Gate('unit', True, f'{evidence}: the same unit')
        return
    half = NORMAL_QUANTILE_975 * deviation
    known = (factor, (factor - half, factor + half))
    name = identify_unit_factor(factor, deviation)
    power = round(math.log10(abs(factor)))
    interval = 0.0 if log.time is None else float(np.median(np.diff(log.time)))
    slower = 10.0 ** power
    correct_units = ('correct the unit or the range of the gyro (gyro_dps, gyro_rad_s, '
                     '--sensitivity), or the unit of the reference (deg or rad)')
    if name == '-1' or name is None and not is_implausible_factor(-factor):
        yield Gate('sense', False, evidence,
                   'give or omit --invert, or change the sign of the column of the gyro', known)
    elif (name is None and power and log.reference_rate is None
            and 1.0 / UNIT_TOLERANCE < abs(factor) / slower < UNIT_TOLERANCE
            and _SAMPLE_INTERVAL_RANGE[0] < interval / slower < _SAMPLE_INTERVAL_RANGE[1]):
        yield Gate('time_unit', False, f'{evidence}, as if the stamps ran {slower:g} times too '
                   f'fast, {interval:.4g} s between samples where {interval / slower:.4g} s would '
                   'agree',
                   f'divide time_s by {slower:g}, or give --rate {slower / interval:.6g}'
                   + ' (the stamps are in ms)' * (slower == 1e3)
                   + f'; or, if the stamps are right, {correct_units}', known)
    elif name is not None:
        yield Gate('unit', False, f'{evidence}, and {name} is {UNIT_FACTORS[name]:.5g}',
                   correct_units, known)
    else:
        # a mean over time shows less of a fast motion, as does a line between values
        yield Gate('unit', False, f'{evidence}, which is not plausible for a gyro',
                   f'{correct_units}, or give a reference that is not smoothed or interpolated, '
                   'or take another axis of the gyro', known)


def compare_headings(log: Log, reference: Array) -> list[_Agreement]:
    """
    Compare the changes of heading over spans of each length; none if there are too few.

    Each is compared at the best lag, up to 25 of the shortest spans.
    """
    values = log.reference_heading if log.reference_rate is None else log.reference_rate
    assert log.time is not None and log.output is not None and values is not None
    known = np.flatnonzero(np.isfinite(values))
    if len(known) < 2 * _MIN_SPANS or np.isfinite(log.output).sum() < 2 * _MIN_SPANS:
        return []
    output = bridge_gaps(log.output)
    turned = integrate(log.time, output)
    span = max((log.time[-1] - log.time[0]) / 1000.0,
               4.0 * float(np.median(np.diff(log.time))))
    number = np.floor((log.time[known] - log.time[0]) / span)
    chosen = known[np.flatnonzero(np.diff(number, prepend=-1.0) > 0.0)]
    at, heading = log.time[chosen], reference[chosen]
    rates = np.diff(heading) / np.diff(at)
    if not np.ptp(rates) > 1e-9 * np.abs(rates).max():  # they differ by rounding
        return []
    white = white_noise_deviation(output) ** 2 * float(np.median(np.diff(log.time)))
    # at fractions of a span, of which a delay may be a swing's phase of some degrees: where no lag
    # near zero agrees, one half a period later does, in the opposite sense
    most, best = _MAX_LAG_SPANS / _LAG_STEP, []
    lags = _LAG_STEP * span * np.arange(-most, most + 1.0)
    # what the gyro turned in a gap of its samples, or of those of a reference rate, is not known
    sampled = log.time[np.isfinite(log.output) & (
        np.isfinite(values) if log.reference_rate is not None else True)]
    usual = float(np.median(np.diff(log.time[known])))
    gaps = np.flatnonzero(np.diff(sampled) > max(span, MAX_GAP, 2.0 * usual))
    for together in (1, 4, 16):  # longer ones reduce the noise of the reference
        points, change = at[::together], np.diff(heading[::together])
        used = np.searchsorted(sampled[gaps], points[1:]) == np.searchsorted(
            sampled[gaps + 1], points[:-1], side='right')
        if used.sum() >= _MIN_SPANS:
            found = [_regress_changes(np.diff(np.interp(points - lag, log.time, turned))[used],
                                      np.diff(points)[used], change[used], white) for lag in lags]
            highest = max(each.coherence for each in found)
            # a periodic motion agrees again a period later
            best.append(min((each._replace(lag=lag, span=span)
                             for each, lag in zip(found, lags.tolist())
                             if 1.0 - each.coherence <= 1.5 * (1.0 - highest) + 0.01),
                            key=lambda each: abs(each.lag)))
    return best


def _regress_changes(gyro: Array, steps: Array, change: Array, white: float) -> _Agreement:
    """Return the agreement without outlying spans; white noise in rad²/s."""
    scale = math.sqrt(float(np.mean(gyro ** 2))) or 1.0
    columns = np.column_stack([gyro / scale, steps / steps.mean()])

    def variance_of(values: Array) -> float:
        """Return the variance in the kept spans without what a steady rate turns in each."""
        time, values = steps[kept], values[kept]
        return float(np.var(values - time * (time @ values) / (time @ time)))

    turned = np.abs(gyro), np.abs(change)
    kept = np.ones(len(change), dtype=bool)
    for _ in range(3):
        values = np.linalg.lstsq(columns[kept], change[kept], rcond=None)[0]
        off = change - columns @ values
        kept = np.abs(off) <= 6.0 * robust_deviation(off) + 1e-15
        # With long rests, all turns of the gyro are outlying if the reference makes others; and
        # with a rate that stays the same, all others, while the rest has nothing in common.
        if (kept.sum() < _MIN_SPANS or turned[0][kept].sum() < 0.5 * turned[0].sum()
                or np.var(off[kept]) >= (1.0 - _MIN_MOTION_COHERENCE) * variance_of(change)):
            kept[:] = True
    variance, left = variance_of(change), float(np.var(off[kept]))
    coherence = max(1.0 - left / variance, 0.0) if variance > 0.0 else 0.0
    deviation = math.sqrt(
        left / max(kept.sum() - 2, 1) / max(variance_of(gyro) / scale ** 2, 1e-300))
    noise_share = (white * float(steps[kept].mean()) / max(variance_of(gyro), 1e-300)
                   * float(stats.chi2.isf(FALSE_ALARM_RATE, kept.sum())) / kept.sum())
    return _Agreement(float(values[0]) / scale, deviation / scale, coherence, math.sqrt(left),
                      min(noise_share, 1.0))


#: Gate that failed -> its meaning, for people.
_GATE_SENTENCES = {
    'sense': 'Gyro and reference count in opposite senses.',
    'unit': 'Gyro and reference have different units.',
    'time_unit': 'Gyro and reference differ by a power of ten, as with another unit of time.',
    'wrapped_heading': 'The reference heading is wrapped.',
    'motion': 'The reference shows another motion than the gyro, or the axis of the gyro tilts.',
    'model': 'The model has other units than the log, or belongs to another gyro.'}


def mismatch_diagnosis(results: tuple[Gate, ...], model: GyroModel | None) -> Diagnosis | None:
    """Return the diagnosis of a log of which a gate failed, with a given model; otherwise None."""
    failed = next((gate for gate in results if gate.passed is False), None)
    if failed is None:
        return None
    parameters = {} if failed.factor is None else {'unit_error': Estimate(*failed.factor, '1')}
    found = Finding('unit_error' if parameters else failed.name, _GATE_SENTENCES[failed.name],
                    parameters, 0.0, evidence=failed.evidence, along='rate', remedy=failed.remedy)
    own = model or GyroModel()
    return Diagnosis((found,), (), Noise(), own.noise, None, own, own, gates=results)


def refuse_mismatch(log: Log) -> None:
    """Raise `DataRefused` where a gate fails, with its evidence and remedy."""
    mismatch = mismatch_diagnosis(check_gates(log), None)
    if mismatch is not None:
        (failed,) = mismatch.findings
        raise DataRefused(f'{failed.cause[:1].lower()}{failed.cause[1:].rstrip(".")} '
                          f'({failed.evidence}): {failed.remedy}')


# the kind of the reference

REFERENCE_KINDS = ('rate_command', 'encoder', 'motion_capture', 'course', 'odometry', 'gyro',
                   'rest')
#: Largest rate noise of an exact reference as a share of that of the gyro: it adds 1e-4 to the
#: variance, which logs of up to 2e8 samples do not show.
_MAX_RATE_NOISE_SHARE = 0.01


def classify_reference(log: Log, stated_kind: str | None = None) -> Reference:
    """Return the kind of the reference of a log: as stated, or found from the log."""
    return (Reference(*find_reference_kind(log)) if stated_kind is None
            else Reference(stated_kind, 'as given'))


def is_reference_limiting(log: Log, reference: Reference) -> bool:
    """Tell whether the errors of the reference, not those of the gyro, limit a diagnosis."""
    if log.time is None or log.output is None or reference.kind == 'rest':
        return False
    if reference.kind == 'odometry':
        return True
    if reference.kind == 'rate_command' or log.reference_heading is None:
        return (log.reference_rate is not None
                and (is_slow(log.reference_rate)
                     or rate_noise_share(log, reference.evidence == 'as given')
                     > _MAX_RATE_NOISE_SHARE))
    if (reference.kind == 'course' or reference.evidence == 'as given'
            or cross_rotation(log).size):  # of which a part is in the output
        return True
    errors, step = heading_difference(log), encoder_step(log.reference_heading)
    interval = float(np.median(np.diff(log.time)))
    # the exact motion between its values is not known
    if is_slow(log.reference_heading):
        return True
    # the rounding error of an encoder does not show while its shaft rests
    rounding = step / math.sqrt(12.0)
    rate_rounding = math.sqrt(2.0) * rounding / interval
    if (rate_rounding > _MAX_RATE_NOISE_SHARE * white_noise_deviation(log.output)
            and step_evenness(log, step) > 0.5):
        return True
    if reference.kind == 'motion_capture' and heading_noise_share(log) > _MAX_RATE_NOISE_SHARE:
        return True
    if not (errors.is_significant or replace(errors, constant_error=rounding).is_significant):
        return False
    # The treatment of exact references takes the rounding of an encoder for white noise; but it is
    # constant at rest, and jumps by up to a step when the motion resumes. Up to 0.01 deg this
    # causes no false slips (bench: 0.0055 deg, 50 Hz).
    return (reference.kind != 'encoder' or step > 0.01 * DEGREE
            or errors.constant_error > MAX_ROUNDING_RATIO * rounding)
