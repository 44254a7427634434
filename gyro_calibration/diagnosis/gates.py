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

The gates check whether gyro and reference show the same motion, in the same units, time and sense.
Over spans, the change of the reference heading is regressed on the integral of the output and on
time, at the lag of the best agreement. A factor far from 1 indicates a unit, a sign or a unit of
time; a low coherence over all lengths of span indicates another motion, or an axis that tilts. A
gate that fails is the only finding.

"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
import math

from gyro_calibration.calibration.dwell_search import (
    find_lost_reference,
    interpolate_reference,
    require_output,
)
from gyro_calibration.diagnosis.expected_output import (
    bridge_gaps,
    fit_line,
    identify_unit_factor,
    integrate_trapezoidal,
    is_implausible_factor,
    model_scale_factor,
    reference_rate,
    UNIT_FACTORS,
)
from gyro_calibration.diagnosis.findings import Estimate, Finding, Gate
from gyro_calibration.logs.log import (
    Array,
    DataRefused,
    DEGREE,
    Log,
    NORMAL_QUANTILE_975,
    refuse_wrapped,
)
from gyro_calibration.logs.quality import find_codes, white_noise_deviation
from gyro_calibration.model.gyro_model import GyroModel
import numpy as np

#: Least number of samples and least duration, s, of a log in time, least number of rows of a rate
#: table, and least share of samples with values.
MIN_SAMPLES, MIN_DURATION, MIN_TABLE_ROWS, MIN_VALID_SHARE = 100, 20.0, 8, 0.1
#: Largest number of rows of a rate table; more are samples whose time is missing.
MAX_TABLE_ROWS = 5000
#: Longest log, s: three years; a longer one has stamps in another unit.
MAX_DURATION = 1e8
#: Largest deviation of means over 1 s from their median at rest, without a reference, rad/s.
REST_RATE_SPREAD = 3.0 * DEGREE
#: A reference may be at rest if it turns by less than this, rad, plus so many standard deviations
#: of its integrated noise; it is if the output depends on it by less than so many standard
#: deviations.
_MAX_REST_ANGLE, _REST_NOISE_SIGMAS, _FOLLOWING_SIGMAS = 1.0 * DEGREE, 4.0, 4.0
#: Largest residual, as a share of the spread of the output, of an output that was computed from
#: the reference.
_COPY_RESIDUAL_SHARE = 1e-6
#: Largest rounding step of such an output in the file, as a share of the spread.
_MAX_PRINT_STEP_SHARE = 1e-5
#: Largest deviation, as a factor, of a confusion of deg and rad from 57.3.
_DEGREE_RATIO_TOLERANCE = 1.3
#: Largest plausible ratio of the noise of a log to that of the model, and its inverse.
_MAX_NOISE_RATIO = 1000.0
#: Largest plausible ratio of the rates of a log to those of the model.
_MAX_RATE_RATIO = 20.0


def refuse_unusable(log: Log, model: GyroModel | None = None) -> None:
    """
    Raise for a log, or a model of it, that cannot be diagnosed.

    Raises
    ------
    DataRefused : with the reason and the remedy

    """
    output = require_output(log)
    log, _ = select_reference(log)
    if log.reference_rate is None:
        refuse_wrapped(log)
    if log.time is None:
        _refuse_table(log, output)
    else:
        _refuse_short(log.time, output)
        _refuse_without_reference(log, output)
    _refuse_constant(output)
    _refuse_copy(log, output)
    if model is not None:
        _refuse_units(log, output, model)


def check_model_units(log: Log, model: GyroModel) -> Gate:
    """Check whether model and log have the same units."""
    try:
        _refuse_units(select_reference(log)[0], require_output(log), model)
    except DataRefused as refusal:
        evidence, _, remedy = str(refusal).partition('; ')
        return Gate('model', False, evidence, remedy)
    return Gate('model', True, 'model and log have the same units')


def select_reference(log: Log) -> tuple[Log, tuple[str, ...]]:
    """
    Return a log with the reference that is used, and remarks on it.

    The reference rate is dropped if it has less than half as many samples as the heading. A rate
    that consists of noise alone is replaced by that of a rest.

    """
    if log.time is None:
        return log, ()
    counts = [0 if values is None else int(np.isfinite(values).sum())
              for values in (log.reference_rate, log.reference_heading)]
    by_rate = counts[0] > 0 and 2 * counts[0] >= counts[1]
    notes = (() if by_rate or not counts[0]
             else (f'The reference rate is known in {counts[0]} samples only; '
                   f'the heading, known in {counts[1]}, is used.',))
    log = replace(log, reference_rate=log.reference_rate if by_rate else None,
                  reference_heading=log.reference_heading if counts[1] else None)
    rate = reference_rate(log)
    if rate is None or not np.nanmax(np.abs(rate)) > 0.0 or not is_at_rest(log):
        return log, notes
    return (replace(log, reference_rate=0.0 * rate, reference_heading=None),
            (*notes, 'The reference shows noise alone, which the gyro does not measure; '
             'the gyro is taken to be at rest.'))


def resample_reference(log: Log) -> Log:
    """Return a log with references interpolated if they have a lower rate than the output."""
    if log.time is None:
        return log
    rate, heading = (None if values is None else interpolate_reference(log.time, values)
                     for values in (log.reference_rate, log.reference_heading))
    return replace(log, reference_rate=rate, reference_heading=heading)


def is_at_rest(log: Log) -> bool:
    """Tell whether a gyro is at rest in the whole log: by reference, moving flag, or output."""
    rate = reference_rate(log)
    if rate is not None:
        return not np.nanmax(np.abs(rate)) > 0.0 or _is_reference_noise(log, rate)
    if log.moving is not None:
        return bool((log.moving == 0.0).all())
    if log.time is None or log.output is None or np.isfinite(log.output).sum() < MIN_SAMPLES:
        return False
    second = np.floor(log.time - log.time[0]).astype(np.int64)
    second = np.unique(second, return_inverse=True)[1]
    means = np.bincount(second, bridge_gaps(log.output)) / np.bincount(second)
    return float(np.abs(means - np.median(means)).max()) < REST_RATE_SPREAD


def _is_reference_noise(log: Log, rate: Array) -> bool:
    """Tell whether a reference rate is noise at rest: no rotation, and no output follows it."""
    if log.time is None or log.output is None or log.moving is not None and log.moving.any():
        return False
    steps, whole = np.diff(log.time), bridge_gaps(rate)
    noise = white_noise_deviation(whole) * math.sqrt(float(np.median(steps) * steps.sum()))
    if np.ptp(np.cumsum(whole[1:] * steps)) > _MAX_REST_ANGLE + _REST_NOISE_SIGMAS * noise:
        return False
    # Scaled, as a very small rate would be numerically zero next to the constant of the line.
    line = fit_line(log.time, rate / np.nanmax(np.abs(rate)), log.output)
    return line is None or abs(line.factor) < _FOLLOWING_SIGMAS * line.deviation


def _refuse_table(log: Log, output: Array) -> None:
    rate = log.reference_rate
    rows = 0 if rate is None else int(np.count_nonzero(np.isfinite(rate) & np.isfinite(output)))
    if rows < MIN_TABLE_ROWS:
        raise DataRefused(
            f'the log has no time_s, and {rows} rows with output and reference_rate_dps; '
            f'as a rate table it needs at least {MIN_TABLE_ROWS}, and as samples in time it needs '
            'time_s: add rows, or give --rate')
    if rows > MAX_TABLE_ROWS:
        raise DataRefused(
            f'the log has no time_s, and {rows} rows, where a rate table has at most '
            f'{MAX_TABLE_ROWS}: add time_s, or give the sample rate with --rate')


def _refuse_short(time: Array, output: Array) -> None:
    known = int(np.count_nonzero(np.isfinite(output)))
    if known < MIN_SAMPLES or known < MIN_VALID_SHARE * len(output):
        raise DataRefused(
            f'the gyro has a value in {known} of {len(output)} samples; at least {MIN_SAMPLES} '
            'and a tenth are needed: record again, and repair the line if it loses samples')
    if time[-1] - time[0] < MIN_DURATION:
        raise DataRefused(f'the log lasts {time[-1] - time[0]:.1f} s; '
                          f'a diagnosis needs at least {MIN_DURATION:g} s: record longer')
    if time[-1] - time[0] > MAX_DURATION:
        raise DataRefused(f'the log lasts {time[-1] - time[0]:.3g} s by its stamps; '
                          'check that time_s is in s, or give --rate')


def _refuse_without_reference(log: Log, output: Array) -> None:
    values = log.reference_heading if log.reference_rate is None else log.reference_rate
    if values is None and not is_at_rest(log):
        raise DataRefused(
            'the log has no reference, and the gyro is not at rest: add reference_rate_dps or '
            'reference_heading_deg, or let it rest, and add a column moving of zeros')
    if values is None:
        return
    known = np.isfinite(values)
    count, covered = (int(np.count_nonzero(each & np.isfinite(output)))
                      for each in (known, ~find_lost_reference(known)))
    if count < MIN_SAMPLES or covered < MIN_VALID_SHARE * len(output):
        raise DataRefused(
            f'the reference has a value in {count} of {len(output)} samples; at least '
            f'{MIN_SAMPLES} and a tenth are needed, or one at even intervals: repair its line and '
            'record again')


def _refuse_constant(output: Array) -> None:
    values, counts = np.unique(output[np.isfinite(output)], return_counts=True)
    share = counts.max() / counts.sum()
    if share > 0.99:
        raise DataRefused(
            f'the gyro gives {values[counts.argmax()] / DEGREE:.6g} deg/s in '
            f'{100.0 * share:.4g} % of the samples: it is dead, or its quantization step exceeds '
            'all rates of the log; check it, and record again')


def _refuse_copy(log: Log, output: Array) -> None:
    """Refuse a reference computed from the output, or an output computed from the reference."""
    for rate in _rates_of_reference(log):
        known = np.isfinite(rate) & np.isfinite(output)
        if np.count_nonzero(known) < MIN_TABLE_ROWS or not np.ptp(rate[known]) > 0.0:
            continue
        slope, offset = np.polyfit(rate[known], output[known], 1)
        off = float(np.std(output[known] - slope * rate[known] - offset))
        spread = float(np.std(output[known]))
        printed = math.hypot(find_codes(output[known]).step, slope * find_codes(rate[known]).step)
        if (off < _COPY_RESIDUAL_SHARE * spread
                or off < 0.5 * printed < _MAX_PRINT_STEP_SHARE * spread):
            raise DataRefused(
                f'the output is {slope:.6g} times the reference plus {offset / DEGREE:.4g} deg/s, '
                'to the last digit: one was computed from the other, without noise; give an '
                'independent reference, or a simulation with noise')


def _rates_of_reference(log: Log) -> list[Array]:
    """Return the rates of the reference: as recorded, and by differences of the heading."""
    rates = [] if log.reference_rate is None else [log.reference_rate]
    if log.reference_heading is None or log.time is None:
        return rates
    steps = np.diff(log.reference_heading) / np.diff(log.time)
    before, after = np.append(steps, np.nan), np.insert(steps, 0, np.nan)
    return [*rates, before, after, 0.5 * (before + after)]


def _refuse_units(log: Log, output: Array, model: GyroModel) -> None:
    """Refuse a model whose values are implausible for the log, as of one written in deg/s."""
    rate = reference_rate(log)
    line = None if rate is None else fit_line(log.time, rate, output)
    if rate is not None and line is not None:
        scale = model_scale_factor(model, rate)
        if not 0.1 < abs(scale) < 10.0:
            raise DataRefused(
                f'the scale factor of the model is {scale:.4g}, which is not plausible: it has '
                'other units; write it in rad/s, or fit it again')
    # By the reference, as the unit of the output may be wrong, which is a finding.
    fastest = float(np.nanquantile(np.abs(output if rate is None else rate), 0.99))
    widest = max(abs(limit) for limit in model.rate_range)
    if fastest > _MAX_RATE_RATIO * widest:
        raise DataRefused(
            f'the model is for rates up to {widest / DEGREE:.4g} deg/s, and the log goes to '
            f'{fastest / DEGREE:.4g} deg/s: it has other units, or belongs to another gyro; '
            'write it in rad/s, or fit it again')
    if log.time is not None and model.noise.angle_random_walk > 0.0:
        _refuse_noise(
            white_noise_deviation(output) * math.sqrt(float(np.median(np.diff(log.time)))),
            model.noise.angle_random_walk, is_at_rest(log))


def _refuse_noise(measured: float, simulated: float, is_resting: bool) -> None:
    """Refuse an angle random walk that is implausible, or, at rest, in deg instead of rad."""
    ratio = measured / simulated
    if (is_resting and is_degree_ratio(ratio)
            or not 1.0 / _MAX_NOISE_RATIO < ratio < _MAX_NOISE_RATIO):
        raise DataRefused(
            f'the log has {ratio:.3g} times the angle random walk of the model, {simulated:.3g} '
            'rad/√s: the model has other units, or belongs to another gyro; write its noise in '
            'rad/√s, or take it from `allan`')


def is_degree_ratio(ratio: float) -> bool:
    """Tell whether a ratio of noises is near that of deg and rad."""
    return any(1.0 / _DEGREE_RATIO_TOLERANCE < ratio * factor < _DEGREE_RATIO_TOLERANCE
               for factor in (DEGREE, 1.0 / DEGREE))


#: Number of spans of a log, and largest lag in either direction, in spans.
_SPAN_COUNT, _MAX_LAG_SPANS = 1000, 25
#: Numbers of spans that are combined to longer ones, which reduce the noise of the reference.
_SPAN_MULTIPLES = (1, 4, 16)
#: Least number of spans; least rotation of the reference, and least residual over the longest
#: spans, rad, for which another motion is detected.
_MIN_SPANS, _MIN_TURNED_ANGLE, _MIN_HEADING_DIFFERENCE = 12, 30.0 * DEGREE, 10.0 * DEGREE
#: Common share of the variance above which the factor between gyro and reference is tested, and
#: below which they show different motions.
_MIN_UNIT_COHERENCE, _MIN_MOTION_COHERENCE = 0.8, 0.4
#: Least residual of a tilting axis over the longest spans, rad, and its least ratio to that over
#: the shortest.
_MIN_TILT_ANGLE, _MIN_TILT_GROWTH = 5.0 * DEGREE, 3.0
#: Plausible sample intervals, s, for which a power of ten is taken for a unit of time.
_SAMPLE_INTERVAL_RANGE = (2e-5, 0.25)


@dataclass(frozen=True)
class Agreement:
    """
    Agreement of the heading of the reference with the integral of the output.

    Attributes
    ----------
    factor : ratio of the change of the reference to that of the integral
    deviation : its standard deviation
    coherence : common share of the variance, at the length of span at which it is largest
    short_span_coherence, long_span_coherence : the same over the shortest and the longest spans
    residual_and_growth : residual over the longest spans, rad, and its ratio to that over the
        shortest
    turned_range : largest less smallest heading of the reference, rad

    """

    factor: float
    deviation: float
    coherence: float
    short_span_coherence: float
    long_span_coherence: float
    residual_and_growth: tuple[float, float]
    turned_range: float  # noqa: A003


def check_gates(log: Log, model: GyroModel | None = None) -> tuple[Gate, ...]:
    """Return the gates of a log with a reference, up to the first that failed."""
    if (log.time is None or log.output is None
            or log.reference_heading is None and log.reference_rate is None):
        return ()
    results: list[Gate] = []
    for gate in _run_gates(log, model):
        results.append(gate)
        if gate.passed is False:
            break
    return tuple(results)


def _run_gates(log: Log, model: GyroModel | None) -> Iterator[Gate]:
    assert log.time is not None
    if log.reference_rate is None:
        try:
            refuse_wrapped(log)
            yield Gate('wrapped_heading', True, 'the reference heading is continuous')
        except DataRefused as refusal:
            yield Gate('wrapped_heading', False, str(refusal).partition(';')[0],
                       'unwrap the reference heading (--unwrap), and diagnose again')
    agreed = compare_headings(log)
    if agreed is None:
        yield Gate('motion', None, 'the reference turns too little to compare it with the gyro')
        return
    yield _motion_gate(agreed, log)
    if agreed.coherence > _MIN_UNIT_COHERENCE:
        own = (1.0 if model is None
               else model_scale_factor(model, np.gradient(reference_angle(log), log.time)))
        # a model with other units is refused by `check_model_units`
        yield from _unit_gates(agreed, own if 0.1 < abs(own) < 10.0 else 1.0, log)


def _motion_gate(agreed: Agreement, log: Log) -> Gate:
    evidence = (f'{100.0 * agreed.coherence:.3g} % of the variance of the heading over spans is '
                'common to gyro and reference')
    residual, growth = agreed.residual_and_growth
    loss = agreed.short_span_coherence - agreed.long_span_coherence
    wanders = (residual > _MIN_TILT_ANGLE and growth > _MIN_TILT_GROWTH
               and loss > 0.5 * _MIN_MOTION_COHERENCE)
    if agreed.coherence >= _MIN_MOTION_COHERENCE and not wanders:
        return Gate('motion', True, evidence)
    if not wanders and (residual < _MIN_HEADING_DIFFERENCE
                        or agreed.turned_range < _MIN_TURNED_ANGLE):
        return Gate('motion', None,
                    f'{evidence}; the difference is within the errors of a reference')
    others = [name for name in log.others if 'gyro' in name.lower()]
    axis = f'; or take another axis of the gyro ({", ".join(others[:3])})' if others else ''
    turned = 'transform the rates of all three axes into the frame of the reference first'
    if wanders:
        evidence += (f' over short spans, and {100.0 * agreed.long_span_coherence:.2g} % over '
                     f'longer ones, where {residual / DEGREE:.3g} deg are left: the axis of the '
                     'gyro tilts')
        return Gate('tilt', False, evidence, f'{turned}, or keep the sensor level{axis}')
    return Gate('motion', False, evidence, 'give a reference of this motion and this axis, with '
                f'stamps of the same clock; where the sensor tumbles, {turned}{axis}')


def _unit_gates(agreed: Agreement, configured_scale_factor: float, log: Log) -> Iterator[Gate]:
    """Give the gates of sense and unit, by the factor of the output over the reference."""
    assert log.time is not None
    factor = 1.0 / (agreed.factor * configured_scale_factor)
    deviation = agreed.deviation / agreed.factor ** 2 / abs(configured_scale_factor)
    evidence = f'the output is {factor:.4g} times the reference'
    half = NORMAL_QUANTILE_975 * deviation
    factor_with_interval = (factor, (factor - half, factor + half))
    if not is_implausible_factor(factor):
        yield Gate('sense', True, f'{evidence}: the same sense')
        yield Gate('unit', True, f'{evidence}: the same unit')
        return
    name = identify_unit_factor(factor, deviation)
    if name == '-1' or name is None and is_implausible_factor(-factor) is False:
        yield Gate('sense', False, f'{evidence}: the two count in opposite senses',
                   'give --invert, or change the sign of the column of the gyro',
                   factor_with_interval)
        return
    power, interval = round(math.log10(abs(factor))), float(np.median(np.diff(log.time)))
    slower = 10.0 ** power
    if (name is None and power and abs(abs(factor) / slower - 1.0) < 0.3
            and log.reference_rate is None
            and _SAMPLE_INTERVAL_RANGE[0] < interval / slower < _SAMPLE_INTERVAL_RANGE[1]):
        yield Gate('time_unit', False, f'{evidence}: the stamps run {slower:g} times too fast, '
                   f'{interval:.4g} s between samples where {interval / slower:.4g} s would agree',
                   f'divide time_s by {slower:g}, or give --rate {slower / interval:.6g}'
                   + (' (the stamps are in ms)' if power == 3 else ''), factor_with_interval)
        return
    remedy = ('correct the unit or the range of the gyro (gyro_dps, gyro_rad_s, --sensitivity), '
              'or that of the reference')
    if name is not None and '180' in name:
        assert log.output is not None
        fastest = float(np.nanquantile(np.abs(log.output), 0.99)) / DEGREE
        either = log.reference_heading is not None and 0.1 <= fastest <= 4000.0
        remedy = ('correct the unit of the column of the gyro (gyro_dps or gyro_rad_s)'
                  + (', or that of the reference heading (deg or rad)' if either else ''))
    yield Gate('unit', False, f'{evidence}, and {name} is {UNIT_FACTORS[name]:.5g}' if name
               else f'{evidence}, which is not plausible for a gyro', remedy, factor_with_interval)


def reference_angle(log: Log) -> Array:
    """Return the heading of the reference at each sample, gaps interpolated, rad."""
    assert log.time is not None
    if log.reference_rate is None:
        assert log.reference_heading is not None
        return bridge_gaps(log.reference_heading)
    return integrate_trapezoidal(log.time, bridge_gaps(log.reference_rate))


def compare_headings(log: Log) -> Agreement | None:
    """Compare the changes of heading over spans; None if there are too few values."""
    assert log.time is not None and log.output is not None
    values = log.reference_heading if log.reference_rate is None else log.reference_rate
    assert values is not None
    known = np.flatnonzero(np.isfinite(values))
    if len(known) < 2 * _MIN_SPANS or np.isfinite(log.output).sum() < 2 * _MIN_SPANS:
        return None
    reference = reference_angle(log)
    turned = integrate_trapezoidal(log.time, bridge_gaps(log.output))
    span = max((log.time[-1] - log.time[0]) / _SPAN_COUNT,
               4.0 * float(np.median(np.diff(log.time))))
    number = np.floor((log.time[known] - log.time[0]) / span)
    chosen = known[np.flatnonzero(np.diff(number, prepend=-1.0) > 0.0)]
    at, heading = log.time[chosen], reference[chosen]
    by_length = [_regress_at_best_lag(log.time, turned, at[::together], heading[::together], span)
                 for together in _SPAN_MULTIPLES if len(at[::together]) > _MIN_SPANS]
    if not by_length or not np.ptp(heading) > 0.0:
        return None
    factor, deviation, coherence, _ = max(by_length, key=lambda each: each[2])
    short, long = by_length[0], by_length[-1]
    return Agreement(factor, deviation, coherence, short[2], long[2],
                     (long[3], long[3] / max(short[3], 1e-12)), float(np.ptp(heading)))


def _regress_at_best_lag(time: Array, turned: Array, point_times: Array, heading: Array,
                         span: float) -> tuple[float, float, float, float]:
    """Return factor, its deviation, coherence and residual, rad, at the best lag."""
    change, steps = np.diff(heading), np.diff(point_times)
    lags = span * np.arange(-_MAX_LAG_SPANS, _MAX_LAG_SPANS + 1)
    found = [_regress_changes(np.diff(np.interp(point_times - lag, time, turned)), steps, change)
             for lag in lags]
    least = min(1.0 - each[2] for each in found)
    # a periodic motion agrees again a period later
    near = [place for place, each in enumerate(found) if 1.0 - each[2] <= 1.5 * least + 0.01]
    return found[min(near, key=lambda place: abs(lags[place]))]


def _regress_changes(gyro: Array, steps: Array,
                     change: Array) -> tuple[float, float, float, float]:
    """Return factor, its deviation, coherence and residual, rad, without outlying spans."""
    scale = math.sqrt(float(np.mean(gyro ** 2))) or 1.0
    columns = np.column_stack([gyro / scale, steps / steps.mean()])
    kept = np.ones(len(change), dtype=bool)
    for _ in range(3):
        values = np.linalg.lstsq(columns[kept], change[kept], rcond=None)[0]
        off = change - columns @ values
        kept = np.abs(off) <= 6.0 * 1.4826 * float(np.median(np.abs(off))) + 1e-15
        if kept.sum() < max(_MIN_SPANS, len(change) // 2):
            kept[:] = True
    variance, left = float(np.var(change[kept])), float(np.var(off[kept]))
    coherence = max(1.0 - left / variance, 0.0) if variance > 0.0 else 0.0
    deviation = math.sqrt(
        left / max(kept.sum() - 2, 1) / max(float(np.var(columns[kept, 0])), 1e-300))
    return float(values[0]) / scale, deviation / scale, coherence, math.sqrt(left)


#: Gate that failed -> its meaning, for people.
_GATE_SENTENCES = {
    'sense': 'Gyro and reference count in opposite senses.',
    'unit': 'Gyro and reference have different units.',
    'time_unit': 'The stamps are in another unit of time.',
    'wrapped_heading': 'The reference heading is wrapped.',
    'tilt': 'The axis of the gyro tilts, so that the integral of its rate is not the heading.',
    'motion': 'The reference shows another motion than the gyro.',
    'model': 'The model has other units than the log, or belongs to another gyro.'}


def mismatch_finding(results: Sequence[Gate]) -> Finding | None:
    """Return the finding of a gate that failed, or None."""
    failed = next((gate for gate in results if gate.passed is False), None)
    if failed is None:
        return None
    parameters = {} if failed.factor is None else {'unit_error': Estimate(*failed.factor, '1')}
    return Finding('unit_error' if parameters else failed.name, _GATE_SENTENCES[failed.name],
                   parameters, 0.0, evidence=failed.evidence, along='rate', remedy=failed.remedy)
