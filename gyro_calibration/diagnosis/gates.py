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
Gates: whether gyro and reference show the same motion, in the same units, time and sense.

Headings are compared as headings. Over spans, the change of the reference is regressed on the
integral of the output and on time, at the lag at which they agree best. A factor far from 1 is a
unit, a sign or a unit of time; a low coherence over every length of span is another motion, or an
axis that tilts. A gate that fails is the only finding.

"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
import math

from gyro_calibration.diagnosis.expected_output import bridged, integral_of, scale_of
from gyro_calibration.diagnosis.findings import Estimate, Finding, Gate
from gyro_calibration.diagnosis.unit_confusion import FACTORS, is_far, unit_of_scale
from gyro_calibration.logs.log import Array, DataRefused, DEGREE, Log, refuse_wrapped
from gyro_calibration.model.gyro_model import GyroModel
import numpy as np

#: Spans that a log is cut into, and the lags that are tried, in spans, either way.
_SPANS, _LAGS = 1000, 25
#: Spans that are put together, for the noise of a reference fades over longer ones.
_TOGETHER = (1, 4, 16)
#: The least spans; how far a reference must turn in all, and how far gyro and reference must be
#: apart over the longest spans, rad, for a gyro that does not follow to be told so.
_FEWEST, _TURNED, _APART = 12, 30.0 * DEGREE, 10.0 * DEGREE
#: Shares of the variance in common: above the first the factor between both is known; below the
#: second they are different motions.
_KNOWN, _DIFFERENT = 0.8, 0.4
#: What an axis that tilts leaves over longer spans, rad, and beside shorter ones.
_WANDERED, _GROWN = 5.0 * DEGREE, 3.0
#: A power of ten between both is taken for a unit of time where the interval of the samples is
#: one that gyros have, s.
_INTERVALS = (2e-5, 0.25)


@dataclass(frozen=True)
class Agreement:
    """
    How the heading of the reference and the integral of the output agree.

    Attributes
    ----------
    factor : change of the reference over that of the integral
    deviation : its standard deviation
    coherence : share of the variance in common, at the length of span at which it is largest
    short, long : the same over the shortest and the longest spans
    grown : what is left over the longest spans, rad, and its ratio to that over the shortest
    range : over which the reference turned in all, rad

    """

    factor: float
    deviation: float
    coherence: float
    short: float
    long: float
    grown: tuple[float, float]
    range: float  # noqa: A003


def gates(log: Log, model: GyroModel | None = None) -> tuple[Gate, ...]:
    """Return what was checked of a log with a reference, up to the first that failed."""
    if (log.time is None or log.output is None
            or log.reference_heading is None and log.reference_rate is None):
        return ()
    passed: list[Gate] = []
    for gate in _checked(log, model):
        passed.append(gate)
        if gate.passed is False:
            break
    return tuple(passed)


def _checked(log: Log, model: GyroModel | None) -> Iterator[Gate]:
    assert log.time is not None
    if log.reference_rate is None:
        try:
            refuse_wrapped(log)
            yield Gate('wrapped_heading', True, 'the reference heading is continuous')
        except DataRefused as refusal:
            yield Gate('wrapped_heading', False, str(refusal).partition(';')[0],
                       'unwrap the reference heading (--unwrap), and diagnose again')
    found = agreement(log)
    if found is None:
        yield Gate('motion', None, 'the reference turns too little to compare it with the gyro')
        return
    yield _same_motion(found, log)
    if found.coherence > _KNOWN:
        own = 1.0 if model is None else scale_of(model, np.gradient(integral(log), log.time))
        # a model of other units is refused as such
        yield from _units(found, own if 0.1 < abs(own) < 10.0 else 1.0, log)


def _same_motion(found: Agreement, log: Log) -> Gate:
    said = (f'{100.0 * found.coherence:.3g} % of the variance of the heading over spans is common '
            'to gyro and reference')
    wanders = (found.grown[0] > _WANDERED and found.grown[1] > _GROWN
               and found.long < found.short - 0.5 * _DIFFERENT)
    if found.coherence >= _DIFFERENT and not wanders:
        return Gate('motion', True, said)
    if not wanders and (found.grown[0] < _APART or found.range < _TURNED):
        return Gate('motion', None,
                    f'{said}; what differs is as small as the errors of a reference')
    others = [name for name in log.others if 'gyro' in name.lower()]
    axis = f'; or take another axis of the gyro ({", ".join(others[:3])})' if others else ''
    turned = 'turn the rates of all three axes into the frame of the reference first'
    if wanders:
        return Gate('tilt', False, f'{said} over short spans, and {100.0 * found.long:.2g} % over '
                    f'longer ones, where {found.grown[0] / DEGREE:.3g} deg are left: the axis of '
                    'the gyro tilts', f'{turned}, or keep the sensor level{axis}')
    return Gate('motion', False, said, 'give a reference of this motion and this axis, with '
                f'stamps of the same clock; where the sensor tumbles, {turned}{axis}')


def _units(found: Agreement, own: float, log: Log) -> Iterator[Gate]:
    """Give the gates of sense and unit, by the factor of the output over the reference."""
    assert log.time is not None
    factor, deviation = 1.0 / (found.factor * own), found.deviation / found.factor ** 2 / abs(own)
    said = f'the output is {factor:.4g} times what the reference says'
    size = factor, (factor - 1.96 * deviation, factor + 1.96 * deviation)
    if not is_far(factor):
        yield Gate('sense', True, f'{said}: the same sense')
        yield Gate('unit', True, f'{said}: the same unit')
        return
    name = unit_of_scale(factor, deviation)
    if name == '-1' or name is None and is_far(-factor) is False:
        yield Gate('sense', False, f'{said}: the two count in opposite senses',
                   'give --invert, or change the sign of the column of the gyro', size)
        return
    power, interval = round(math.log10(abs(factor))), float(np.median(np.diff(log.time)))
    slower = 10.0 ** power
    if (name is None and power and abs(abs(factor) / slower - 1.0) < 0.3
            and log.reference_rate is None
            and _INTERVALS[0] < interval / slower < _INTERVALS[1]):
        yield Gate('time_unit', False, f'{said}: the stamps run {slower:g} times too fast, '
                   f'{interval:.4g} s between samples where {interval / slower:.4g} s would agree',
                   f'divide time_s by {slower:g}, or give --rate {slower / interval:.6g}'
                   + (' (the stamps are in ms)' if power == 3 else ''), size)
        return
    remedy = ('mend the unit or the range of the gyro (gyro_dps, gyro_rad_s, --sensitivity), or '
              'that of the reference')
    if name is not None and '180' in name:
        assert log.output is not None
        fastest = float(np.nanquantile(np.abs(log.output), 0.99)) / DEGREE
        either = log.reference_heading is not None and 0.1 <= fastest <= 4000.0
        remedy = ('mend the unit of the column of the gyro (gyro_dps or gyro_rad_s)'
                  + (', or that of the reference heading (deg or rad)' if either else ''))
    yield Gate('unit', False, f'{said}, and {name} is {FACTORS[name]:.5g}' if name
               else f'{said}, which is the factor of no gyro', remedy, size)


def integral(log: Log) -> Array:
    """Return the heading of the reference at each sample, bridged by straight lines, rad."""
    assert log.time is not None
    if log.reference_rate is None:
        assert log.reference_heading is not None
        return bridged(log.reference_heading)
    return integral_of(log.time, bridged(log.reference_rate))


def agreement(log: Log) -> Agreement | None:
    """Compare the changes of heading over spans; None where too little is known."""
    assert log.time is not None and log.output is not None
    values = log.reference_heading if log.reference_rate is None else log.reference_rate
    assert values is not None
    known = np.flatnonzero(np.isfinite(values))
    if len(known) < 2 * _FEWEST or np.isfinite(log.output).sum() < 2 * _FEWEST:
        return None
    reference, turned = integral(log), integral_of(log.time, bridged(log.output))
    span = max((log.time[-1] - log.time[0]) / _SPANS, 4.0 * float(np.median(np.diff(log.time))))
    number = np.floor((log.time[known] - log.time[0]) / span)
    chosen = known[np.flatnonzero(np.diff(number, prepend=-1.0) > 0.0)]
    at, heading = log.time[chosen], reference[chosen]
    by_length = [_at_best_lag(log.time, turned, at[::together], heading[::together], span)
                 for together in _TOGETHER if len(at[::together]) > _FEWEST]
    if not by_length or not np.ptp(heading) > 0.0:
        return None
    factor, deviation, coherence, _ = max(by_length, key=lambda each: each[2])
    short, long = by_length[0], by_length[-1]
    return Agreement(factor, deviation, coherence, short[2], long[2],
                     (long[3], long[3] / max(short[3], 1e-12)), float(np.ptp(heading)))


def _at_best_lag(time: Array, turned: Array, at: Array, heading: Array,
                 span: float) -> tuple[float, float, float, float]:
    """Return factor, its deviation, coherence and what is left, rad, at the lag that is best."""
    change, steps = np.diff(heading), np.diff(at)
    lags = span * np.arange(-_LAGS, _LAGS + 1)
    found = [_regressed(np.diff(np.interp(at - lag, time, turned)), steps, change) for lag in lags]
    least = min(1.0 - each[2] for each in found)
    # a periodic motion agrees again a period later
    near = [place for place, each in enumerate(found) if 1.0 - each[2] <= 1.5 * least + 0.01]
    return found[min(near, key=lambda place: abs(lags[place]))]


def _regressed(gyro: Array, steps: Array, change: Array) -> tuple[float, float, float, float]:
    """Return factor, its deviation, coherence and what is left, without spans far off, rad."""
    scale = math.sqrt(float(np.mean(gyro ** 2))) or 1.0
    columns = np.column_stack([gyro / scale, steps / steps.mean()])
    kept = np.ones(len(change), dtype=bool)
    for _ in range(3):
        values = np.linalg.lstsq(columns[kept], change[kept], rcond=None)[0]
        off = change - columns @ values
        kept = np.abs(off) <= 6.0 * 1.4826 * float(np.median(np.abs(off))) + 1e-15
        if kept.sum() < max(_FEWEST, len(change) // 2):
            kept[:] = True
    variance, left = float(np.var(change[kept])), float(np.var(off[kept]))
    coherence = max(1.0 - left / variance, 0.0) if variance > 0.0 else 0.0
    deviation = math.sqrt(left / max(kept.sum() - 2, 1)
                          / max(float(np.var(columns[kept, 0])), 1e-300))
    return float(values[0]) / scale, deviation / scale, coherence, math.sqrt(left)


#: Gate that failed -> what it means, for people.
_SENTENCES = {
    'sense': 'Gyro and reference count in opposite senses.',
    'unit': 'Gyro and reference are of different units.',
    'time_unit': 'The stamps are in another unit of time.',
    'wrapped_heading': 'The reference heading is wrapped.',
    'tilt': 'The axis of the gyro tilts, so that its integral is no heading.',
    'motion': 'The reference shows another motion than the gyro.',
    'model': 'The model is of other units than the log, or of another gyro.'}


def mismatch(checked: Sequence[Gate]) -> Finding | None:
    """Return the finding of a gate that failed, or None."""
    failed = next((gate for gate in checked if gate.passed is False), None)
    if failed is None:
        return None
    parameters = {} if failed.factor is None else {'unit_error': Estimate(*failed.factor, '1')}
    return Finding('unit_error' if parameters else failed.name, _SENTENCES[failed.name],
                   parameters, 0.0, evidence=failed.said, along='rate', remedy=failed.remedy)
