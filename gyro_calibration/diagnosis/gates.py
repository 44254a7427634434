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
time; a low coherence over all lengths of span, or over long ones, indicates another motion, or an
axis that tilts. A gate that fails is the only finding.

"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
import math
from typing import NamedTuple

from gyro_calibration.calibration.dwell_search import (
    few_values_remedy,
    find_lost_reference,
    interpolate_reference,
    require_output,
)
from gyro_calibration.diagnosis.expected_output import (
    fit_line,
    identify_unit_factor,
    is_implausible_factor,
    MAX_GYRO_RATIO,
    model_scale_factor,
    reference_rate,
    UNIT_FACTORS,
)
from gyro_calibration.diagnosis.findings import Estimate, Finding, Gate
from gyro_calibration.heading.integration import integrate
from gyro_calibration.logs.log import (
    Array,
    DataRefused,
    DEGREE,
    Log,
    NORMAL_QUANTILE_975,
    refuse_wrapped,
)
from gyro_calibration.logs.quality import bridge_gaps, find_codes, white_noise_deviation
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
#: Largest plausible ratios of the noise and of the rates of a log to those of the model.
_MAX_NOISE_RATIO, _MAX_RATE_RATIO = 1000.0, 20.0


def refuse_unusable(log: Log, model: GyroModel | None = None) -> None:
    """
    Raise for a log, or a model of it, that cannot be diagnosed.

    Raises
    ------
    DataRefused : with the reason and the remedy

    """
    require_output(log)
    log, _ = select_reference(log)
    if log.reference_rate is None:
        refuse_wrapped(log)
    for problem in _log_problems(log):
        raise DataRefused(problem)
    if model is not None and (problem := _unit_problem(log, model)):
        raise DataRefused(problem)


def check_model_units(log: Log, model: GyroModel) -> Gate:
    """Check whether model and log have the same units."""
    problem = _unit_problem(select_reference(log)[0], model)
    evidence, _, remedy = problem.partition('; ')
    return (Gate('model', False, evidence, remedy) if problem
            else Gate('model', True, 'model and log have the same units'))


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
    if np.ptp(np.cumsum(whole[1:] * steps)) > 1.0 * DEGREE + 4.0 * noise:
        return False
    # Scaled, as a very small rate would be numerically zero next to the constant of the line.
    line = fit_line(log.time, rate / np.nanmax(np.abs(rate)), log.output)
    return line is None or abs(line.factor) < 4.0 * line.deviation


def _log_problems(log: Log) -> Iterator[str]:
    """Give what keeps a log, with the reference that is used, from being diagnosed."""
    assert log.output is not None
    known = np.isfinite(log.output)
    reference = log.reference_heading if log.reference_rate is None else log.reference_rate
    has_reference = (np.zeros(len(known), dtype=bool) if reference is None
                     else np.isfinite(reference))
    both = int(np.count_nonzero(known & has_reference))
    if log.time is None:
        if both < MIN_TABLE_ROWS:
            yield (f'the log has no time_s, and {both} rows with output and reference_rate_dps; '
                   f'as a rate table it needs at least {MIN_TABLE_ROWS}, and as samples in time '
                   'it needs time_s: add rows, or give --rate')
        if both > MAX_TABLE_ROWS:
            yield (f'the log has no time_s, and {both} rows, where a rate table has at most '
                   f'{MAX_TABLE_ROWS}: add time_s, or give the sample rate with --rate')
    else:
        count, duration = int(np.count_nonzero(known)), log.time[-1] - log.time[0]
        if count < max(MIN_SAMPLES, MIN_VALID_SHARE * len(known)):
            yield (f'the gyro has a value in {count} of {len(known)} samples; at least '
                   f'{MIN_SAMPLES} and a tenth are needed: record again, and repair the line if '
                   'it loses samples')
        if duration < MIN_DURATION:
            yield (f'the log lasts {duration:.1f} s; a diagnosis needs at least '
                   f'{MIN_DURATION:g} s: record longer')
        if duration > MAX_DURATION:
            yield (f'the log lasts {duration:.3g} s by its stamps; check that time_s is in s, or '
                   'give --rate')
        if reference is None and not is_at_rest(log):
            yield ('the log has no reference, and the gyro is not at rest: add reference_rate_dps '
                   'or reference_heading_deg, or let it rest, and add a column moving of zeros')
        covered = np.count_nonzero(known & ~find_lost_reference(has_reference))
        is_lost = bool(covered < MIN_VALID_SHARE * len(known))
        if reference is not None and (both < MIN_SAMPLES or is_lost):
            yield (f'the reference has a value in {both} of {len(known)} samples; at least '
                   f'{MIN_SAMPLES}{", and a tenth or at even intervals," * is_lost} are needed: '
                   f'{few_values_remedy(log.time, known & has_reference, MIN_SAMPLES)}')
    values, counts = np.unique(log.output[known], return_counts=True)
    share = counts.max() / counts.sum()
    if share > 0.99:
        yield (f'the gyro gives {values[counts.argmax()] / DEGREE:.6g} deg/s in '
               f'{100.0 * share:.4g} % of the samples: it is dead, or its quantization step '
               'exceeds all rates of the log; check it, and record again')
    yield from _copy_problems(log, log.output)


def _copy_problems(log: Log, output: Array) -> Iterator[str]:
    """Give a reference computed from the output, or an output computed from the reference."""
    for rate in _rates_of_reference(log):
        known = np.isfinite(rate) & np.isfinite(output)
        if np.count_nonzero(known) < MIN_TABLE_ROWS or not np.ptp(rate[known]) > 0.0:
            continue
        slope, offset = np.polyfit(rate[known], output[known], 1)
        spread = float(np.std(output[known]))
        off = float(np.std(output[known] - slope * rate[known] - offset)) / spread
        # or no more than the rounding of both in the file
        printed = math.hypot(find_codes(output[known]).step,
                             slope * find_codes(rate[known]).step) / spread
        if off < 1e-6 or off < 0.5 * printed < 1e-5:
            yield (f'the output is {slope:.6g} times the reference plus {offset / DEGREE:.4g} '
                   'deg/s, to the last digit: one was computed from the other, without noise; '
                   'give an independent reference, or a simulation with noise')


def _rates_of_reference(log: Log) -> list[Array]:
    """Return the rates of the reference: as recorded, and by differences of the heading."""
    rates = [] if log.reference_rate is None else [log.reference_rate]
    if log.reference_heading is None or log.time is None:
        return rates
    steps = np.diff(log.reference_heading) / np.diff(log.time)
    before, after = np.append(steps, np.nan), np.insert(steps, 0, np.nan)
    return [*rates, before, after, 0.5 * (before + after)]


def _unit_problem(log: Log, model: GyroModel) -> str:
    """Return why the values of a model are implausible for a log, as in deg/s; '' if they fit."""
    output, rate = require_output(log), reference_rate(log)
    line = None if rate is None else fit_line(log.time, rate, output)
    scale = 1.0 if rate is None or line is None else model_scale_factor(model, rate)
    if not 0.1 < abs(scale) < 10.0:
        return (f'the scale factor of the model is {scale:.4g}, which is not plausible: it has '
                'other units; write it in rad/s, or fit it again')
    # By the reference, as the unit of the output may be wrong, which is a finding.
    fastest = float(np.nanquantile(np.abs(output if rate is None else rate), 0.99))
    widest = max(abs(limit) for limit in model.rate_range)
    if fastest > _MAX_RATE_RATIO * widest:
        return (f'the model is for rates up to {widest / DEGREE:.4g} deg/s, and the log goes to '
                f'{fastest / DEGREE:.4g} deg/s: it has other units, or belongs to another gyro; '
                'write it in rad/s, or fit it again')
    simulated = model.noise.angle_random_walk
    if log.time is None or not simulated > 0.0:
        return ''
    ratio = (white_noise_deviation(output) * math.sqrt(float(np.median(np.diff(log.time))))
             / simulated)
    if (1.0 / _MAX_NOISE_RATIO < ratio < _MAX_NOISE_RATIO
            and not (is_degree_ratio(ratio) and is_at_rest(log))):
        return ''
    return (f'the log has {ratio:.3g} times the angle random walk of the model, {simulated:.3g} '
            'rad/√s: the model has other units, or belongs to another gyro; write its noise in '
            'rad/√s, or take it from `allan`')


def is_degree_ratio(ratio: float) -> bool:
    """Tell whether a ratio of noises is near that of deg and rad."""
    return any(1.0 / 1.3 < ratio * factor < 1.3 for factor in (DEGREE, 1.0 / DEGREE))


#: Number of spans of a log, least number for a comparison, and numbers of spans that are combined
#: to longer ones, which reduce the noise of the reference.
_SPAN_COUNT, _MIN_SPANS, _SPAN_MULTIPLES = 1000, 12, (1, 4, 16)
#: Common share of the variance above which the factor between gyro and reference is tested, and
#: below which they show different motions; it may be lower over long spans by half of that.
_MIN_UNIT_COHERENCE, _MIN_MOTION_COHERENCE = 0.8, 0.4
#: Least residual over the longest spans, and least rotation of the reference, rad, for which
#: another motion is detected.
_MIN_HEADING_DIFFERENCE, _MIN_TURNED_ANGLE = 10.0 * DEGREE, 30.0 * DEGREE
#: Plausible sample intervals, s, for which a power of ten is taken for a unit of time.
_SAMPLE_INTERVAL_RANGE = (2e-5, 0.25)


class Agreement(NamedTuple):
    """
    Agreement of the heading of the reference with the integral of the output over spans.

    Attributes
    ----------
    factor, deviation : change of the reference over that of the integral; its standard deviation
    coherence : common share of the variance
    residual : standard deviation, rad

    """

    factor: float
    deviation: float
    coherence: float
    residual: float


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
                       'unwrap the reference heading (--unwrap)')
    reference = reference_angle(log)
    by_length = compare_headings(log, reference)
    if not by_length:
        yield Gate('motion', None, 'the reference turns too little to compare it with the gyro')
        return
    best = max(by_length, key=lambda each: each.coherence)
    if best.coherence < _MIN_MOTION_COHERENCE:
        yield _motion_gate(best, by_length, float(np.ptp(reference)), log)
        return
    own = 1.0 if model is None else model_scale_factor(model, np.gradient(reference, log.time))
    # a model with other units is refused by `check_model_units`
    scale = best.factor * (own if 0.1 < abs(own) < 10.0 else 1.0)
    relative = best.deviation / abs(best.factor)
    is_certain, unit = best.coherence > _MIN_UNIT_COHERENCE, (1.0 / scale, relative / abs(scale))
    is_excluded = is_implausible_factor(_nearest_scale(scale, relative, best.coherence))
    unit_gates = [*_unit_gates(*unit, log)]
    is_other_axis = (is_excluded and not is_certain and unit_gates[-1].name == 'unit'
                     and identify_unit_factor(*unit) is None)
    yield _motion_gate(best, by_length, float(np.ptp(reference)), log,
                       is_other_axis * f', where the output is {1.0 / scale:.2g} times the '
                       'reference')
    if is_certain or is_excluded and not is_other_axis:
        yield from unit_gates


def _nearest_scale(scale: float, relative_deviation: float, coherence: float) -> float:
    """Return the scale nearest to 1 that is not excluded; noise of the gyro reduces it."""
    half = NORMAL_QUANTILE_975 * relative_deviation
    return math.copysign(min(max(1.0, abs(scale) * (1.0 - half)),
                             abs(scale) * (1.0 + half) / coherence), scale)


def _motion_gate(best: Agreement, by_length: Sequence[Agreement], turned_angle: float,
                 log: Log, other_axis: str = '') -> Gate:
    evidence = (f'{100.0 * best.coherence:.3g} % of the variance of the heading over spans is '
                f'common to gyro and reference{other_axis}')
    longest = by_length[-1]
    if best.coherence - longest.coherence > 0.5 * _MIN_MOTION_COHERENCE:
        evidence += f', and {100.0 * longest.coherence:.2g} % over the longest ones'
    elif best.coherence >= _MIN_MOTION_COHERENCE and not other_axis:
        return Gate('motion', True, evidence)
    if longest.residual < _MIN_HEADING_DIFFERENCE or turned_angle < _MIN_TURNED_ANGLE:
        return Gate('motion', best.coherence >= _MIN_MOTION_COHERENCE or None,
                    f'{evidence}; the difference is within the errors of a reference')
    others = [name for name in log.others if 'gyro' in name.lower()]
    axis = f'; or take another axis of the gyro ({", ".join(others[:3])})' if others else ''
    return Gate('motion', False, evidence, 'give a reference of this motion and this axis, with '
                'stamps of the same clock; where the sensor tilts or tumbles, transform the rates '
                f'of all three axes into the frame of the reference first{axis}')


def _unit_gates(factor: float, deviation: float, log: Log) -> Iterator[Gate]:
    """Give the gates of sense and unit, by the factor of the output over the reference."""
    assert log.time is not None and log.output is not None
    evidence = f'the output is {factor:.4g} times the reference'
    if not is_implausible_factor(factor):
        yield Gate('sense', True, f'{evidence}: the same sense')
        yield Gate('unit', True, f'{evidence}: the same unit')
        return
    half = NORMAL_QUANTILE_975 * deviation
    known = (factor, (factor - half, factor + half))
    name = identify_unit_factor(factor, deviation)
    power, interval = round(math.log10(abs(factor))), float(np.median(np.diff(log.time)))
    slower = 10.0 ** power
    correct_gyro = ('correct the unit or the range of the gyro (gyro_dps, gyro_rad_s, '
                    '--sensitivity)')
    if name == '-1' or name is None and not is_implausible_factor(-factor):
        yield Gate('sense', False, f'{evidence}: the two count in opposite senses',
                   'give or omit --invert, or change the sign of the column of the gyro', known)
    elif (name is None and power and log.reference_rate is None
            and 1.0 / MAX_GYRO_RATIO < abs(factor) / slower < MAX_GYRO_RATIO
            and _SAMPLE_INTERVAL_RANGE[0] < interval / slower < _SAMPLE_INTERVAL_RANGE[1]):
        yield Gate('time_unit', False, f'{evidence}, as if the stamps ran {slower:g} times too '
                   f'fast, {interval:.4g} s between samples where {interval / slower:.4g} s would '
                   'agree',
                   f'divide time_s by {slower:g}, or give --rate {slower / interval:.6g}'
                   + ' (the stamps are in ms)' * (slower == 1e3)
                   # units of time differ by powers of 1000
                   + f'; or, if they are right, {correct_gyro}' * (power % 3 != 0), known)
    elif name is not None and '180' in name:
        fastest = float(np.nanquantile(np.abs(log.output), 0.99)) / DEGREE
        either = log.reference_heading is not None and 0.1 <= fastest <= 4000.0
        yield Gate('unit', False, f'{evidence}, and {name} is {UNIT_FACTORS[name]:.5g}',
                   'correct the unit of the column of the gyro (gyro_dps or gyro_rad_s)'
                   + ', or that of the reference heading (deg or rad)' * either, known)
    else:
        meaning = (', which is not plausible for a gyro' if name is None
                   else f', and {name} is {UNIT_FACTORS[name]:.5g}')
        yield Gate('unit', False, evidence + meaning,
                   f'{correct_gyro}, or that of the reference', known)


def reference_angle(log: Log) -> Array:
    """Return the heading of the reference at each sample, gaps interpolated, rad."""
    assert log.time is not None
    values = log.reference_heading if log.reference_rate is None else log.reference_rate
    assert values is not None
    if not np.isfinite(values).any():
        return np.zeros(len(values))
    return (bridge_gaps(values) if log.reference_rate is None
            else integrate(log.time, bridge_gaps(values)))


def compare_headings(log: Log, reference: Array) -> list[Agreement]:
    """Compare the changes of heading over spans of each length; none if there are too few."""
    assert log.time is not None and log.output is not None
    values = log.reference_heading if log.reference_rate is None else log.reference_rate
    assert values is not None
    known = np.flatnonzero(np.isfinite(values))
    if len(known) < 2 * _MIN_SPANS or np.isfinite(log.output).sum() < 2 * _MIN_SPANS:
        return []
    turned = integrate(log.time, bridge_gaps(log.output))
    span = max((log.time[-1] - log.time[0]) / _SPAN_COUNT,
               4.0 * float(np.median(np.diff(log.time))))
    number = np.floor((log.time[known] - log.time[0]) / span)
    chosen = known[np.flatnonzero(np.diff(number, prepend=-1.0) > 0.0)]
    at, heading = log.time[chosen], reference[chosen]
    if not np.ptp(heading) > 0.0:
        return []
    return [_regress_at_best_lag(log.time, turned, at[::together], heading[::together], span)
            for together in _SPAN_MULTIPLES if len(at[::together]) > _MIN_SPANS]


def _regress_at_best_lag(time: Array, turned: Array, point_times: Array, heading: Array,
                         span: float) -> Agreement:
    """Return the agreement at the best lag, in either direction up to 25 spans."""
    change, steps = np.diff(heading), np.diff(point_times)
    lags = span * np.arange(-25, 26)
    found = [_regress_changes(np.diff(np.interp(point_times - lag, time, turned)), steps, change)
             for lag in lags]
    least = min(1.0 - each.coherence for each in found)
    # a periodic motion agrees again a period later
    near = [place for place, each in enumerate(found)
            if 1.0 - each.coherence <= 1.5 * least + 0.01]
    return found[min(near, key=lambda place: abs(lags[place]))]


def _regress_changes(gyro: Array, steps: Array, change: Array) -> Agreement:
    """Return the agreement without outlying spans."""
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
    return Agreement(float(values[0]) / scale, deviation / scale, coherence, math.sqrt(left))


#: Gate that failed -> its meaning, for people.
_GATE_SENTENCES = {
    'sense': 'Gyro and reference count in opposite senses.',
    'unit': 'Gyro and reference have different units.',
    'time_unit': 'Gyro and reference differ by a power of ten, as with another unit of time.',
    'wrapped_heading': 'The reference heading is wrapped.',
    'motion': 'The reference shows another motion than the gyro, or the axis of the gyro tilts.',
    'model': 'The model has other units than the log, or belongs to another gyro.'}


def mismatch_finding(results: Sequence[Gate]) -> Finding | None:
    """Return the finding of a gate that failed, or None."""
    failed = next((gate for gate in results if gate.passed is False), None)
    if failed is None:
        return None
    parameters = {} if failed.factor is None else {'unit_error': Estimate(*failed.factor, '1')}
    return Finding('unit_error' if parameters else failed.name, _GATE_SENTENCES[failed.name],
                   parameters, 0.0, evidence=failed.evidence, along='rate', remedy=failed.remedy)


def refuse_mismatch(log: Log) -> None:
    """Raise `DataRefused` where a gate fails, with its evidence and remedy."""
    failed = mismatch_finding(check_gates(log))
    if failed is not None:
        raise DataRefused(f'{failed.cause[:1].lower()}{failed.cause[1:].rstrip(".")} '
                          f'({failed.evidence}): {failed.remedy}')
