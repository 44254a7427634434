# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The diagnosis of a log whose reference is a heading with errors of its own, such as a course."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
import math

from gyro_calibration.diagnosis.causes import CAUSES
from gyro_calibration.diagnosis.confirmation import candidates, Confirmed, LEAST_CHANCE, search
from gyro_calibration.diagnosis.extension import with_terms
from gyro_calibration.diagnosis.finding import (
    Curve,
    Diagnosis,
    Estimate,
    Finding,
    Gain,
    HeadingCurve,
    Reference,
    Trace,
)
from gyro_calibration.diagnosis.gain import change_over, WINDOW
from gyro_calibration.diagnosis.hygiene import inspect
from gyro_calibration.diagnosis.regression import (
    all_columns,
    FEWEST_STRETCHES,
    Fitted,
    fitted,
    PLAIN,
    SPAN,
    spans_of,
    whitening,
)
from gyro_calibration.effects import BIAS, CATALOGUE, SCALE_FACTOR_ERROR
from gyro_calibration.log import Array, DEGREE, Log
from gyro_calibration.log_compensation import compensate_log
from gyro_calibration.model import GyroModel, Term
from gyro_calibration.noise import Noise
import numpy as np
from scipy.stats import t as student

#: Parts of a log that are held out in turn: at least, at most, and the least length of one, s.
_FEWEST_PARTS, _MOST_PARTS, _PART = 2, 6, 80.0
#: A window is no longer than this part of what is held out.
_WITHIN = 0.75
#: A gyro is no more sluggish than this, s.
_OF_A_LAG = 0.1
#: Bins of a curve.
_BINS = 20
_SPOKEN = {
    'course': 'a course over ground',
    'encoder': 'an encoder',
    'odometry': 'odometry',
    'motion_capture': 'motion capture',
    'gyro': 'another gyro',
}
_REMEDIES = {
    'gyro': 'it is in the extended model',
    'reference': 'mend or replace the reference, or see that it does not enter a calibration',
    'record': 'mend the recording',
    'noise': 'take the figures of the extended model',
}


def diagnose_heading(
    log: Log, reference: Reference, model: GyroModel | None, rate: float
) -> Diagnosis:
    """
    Say what a simulation gets wrong, by a reference heading that errs more than the gyro.

    Parameters
    ----------
    log : with output, time and reference heading
    reference : its kind
    model : of the simulation; an ideal gyro where it is None
    rate : of false alarms

    """
    record = inspect(replace(log, reference_heading=None, reference_rate=None))
    assert log.output is not None
    output = np.where(record.trusted, log.output, np.nan)
    mended = replace(log, output=output)
    corrected = mended if model is None else replace(mended, output=compensate_log(model, mended))
    plain = fitted(spans_of(corrected))
    extended, found = search(plain, rate)
    gain = _gain(plain, extended)
    if gain is not None and extended.causes and gain.models['extended'] > gain.models['plain']:
        found = [replace(each, established=False) for each in found]
        extended = plain
        gain = _gain(plain, plain)
    given = model or GyroModel()
    base = _model(GyroModel(), plain, log) if model is None else model
    findings = [
        *_of_values(plain, model is not None, rate),
        *record.findings,
        *(_finding(each, extended, plain) for each in found),
    ]
    shares = _shares(extended)
    findings = [
        replace(
            each,
            share_of_heading_error=shares.get(each.effect),
            remedy=each.remedy or _REMEDIES[CAUSES[each.effect].of],
        )
        for each in findings
    ]
    changed = any(
        each.status == 'established'
        and CAUSES[each.effect].of == 'gyro'
        and each.effect != 'time_offset'
        and each.effect not in {one.effect for one in record.findings}
        for each in findings
    )
    after = _model(given, extended, log) if changed or model is None else given
    findings.sort(key=lambda each: (each.status != 'established', each.p_value))
    noise = {name: extended.size(name) for name in ('reference', 'motion')}
    return Diagnosis(
        tuple(findings),
        (),
        _noise(extended),
        Noise() if model is None else model.noise,
        None if not changed and model is not None else gain,
        base,
        after,
        _cannot_show(plain),
        [_curve(extended)],
        _heading(extended),
        None,
        (*record.remarks, *_remarks(reference, plain)),
        rate,
        trace=_trace(extended),
        method=_method(reference),
        reference=replace(reference, noise=noise),
        heading_shares=shares,
    )


# values


def _of_values(plain: Fitted, given: bool, rate: float) -> Iterator[Finding]:
    """Give delay, and beside a model bias and scale factor error, where they are established."""
    for place, name in enumerate(PLAIN):
        if name != 'time_offset' and not given:
            continue
        value, deviation = float(plain.values[place]), math.sqrt(plain.covariance[place, place])
        effective = float(plain.stretches_of[place])
        chance = float(2.0 * student.sf(abs(value) / deviation, max(effective - 1.0, 1.0)))
        if chance >= rate or effective < FEWEST_STRETCHES:
            continue
        half, cause = plain.half(place), CAUSES[name]
        of_reference = name == 'time_offset' and not 0.0 < value < _OF_A_LAG
        yield Finding(
            name,
            'Gyro and reference are not of the same time.' if of_reference else cause.sentence,
            {
                name: Estimate(
                    value, (value - half, value + half), next(iter(cause.units.values()))
                )
            },
            max(chance, LEAST_CHANCE),
            ambiguous_with={
                'time_offset': () if of_reference else ('bandwidth',),
                'scale_factor_error': ('reference_scale',),
            }.get(name, ()),
            separate_by=cause.separate_by if not of_reference else '',
            evidence=f'it rests on {effective:.0f} stretches',
            along=cause.along,
            remedy='synchronize the clocks of gyro and reference; the model has none of it'
            if name == 'time_offset'
            else '',
        )


def _finding(each: Confirmed, extended: Fitted, plain: Fitted) -> Finding:
    """Return a cause that the search found, with its values from a fit that holds it."""
    done = extended if each.established else fitted(plain.spans, [each.column])
    start = len(PLAIN)
    for cause in done.causes:
        width = done.spans.columns(cause).shape[1]
        if cause == each.column:
            break
        start += width
    name = each.column.cause
    values, half = done.values[start: start + width], [done.half(start + k) for k in range(width)]
    unit = (
        CATALOGUE[name].coefficients[0].unit
        if name in CATALOGUE
        else next(iter(CAUSES[name].units.values()))
    )
    if width == 1:
        size = float(values[0])
        parameters = {name: Estimate(size, (size - half[0], size + half[0]), unit)}
    else:
        size = float(np.hypot(*values))
        within = float(np.hypot(*(values * half))) / size
        parameters = {name: Estimate(size, (size - within, size + within), unit)}
    shapes = CATALOGUE[name].shapes if name in CATALOGUE else ()
    for parameter, value in zip(shapes, each.column.shapes):
        if parameter.default is None:
            parameters[parameter.name] = Estimate(value, (value, value), parameter.unit)
    known = CAUSES[name]
    others = tuple(other for other in each.probability if other != name)
    moment = each.column.shapes[0] if each.column.once else None
    status = 'established' if each.established else 'suspected'
    remedy = (
        ''
        if each.established
        else (
            f'record again: {known.separate_by}'
            if known.separate_by
            else 'record longer, and see whether it is found again'
        )
    )
    evidence = (
        f'it adds {each.predicted:.1f} to the log-likelihood of stretches that took no part '
        f'in choice and fit, and is chosen in {100.0 * each.chosen:.0f} % of them'
    )
    return Finding(
        name,
        known.sentence,
        parameters,
        each.p_value,
        None,
        others,
        known.separate_by if others else '',
        evidence,
        known.along,
        status,
        each.probability,
        None,
        None if moment is None else (moment, float(plain.spans.time[-1])),
        remedy,
    )


def _model(given: GyroModel, done: Fitted, log: Log) -> GyroModel:
    """Return a model with scale factor error, bias, and the causes of the gyro that are fitted."""
    own = 1.0 + sum(term.values[0] for term in given.terms if term.effect is SCALE_FACTOR_ERROR)
    scale, bias = (own * float(value) for value in done.values[:2])
    terms = [Term(BIAS, (bias,)), Term(SCALE_FACTOR_ERROR, (scale,))]
    places: list[int | None] = [1, 0]
    start = len(PLAIN)
    for cause in done.causes:
        width = done.spans.columns(cause).shape[1]
        if cause.cause in CATALOGUE:
            terms.append(
                Term(
                    CATALOGUE[cause.cause],
                    (*cause.shapes, *done.values[start: start + width].tolist()),
                )
            )
            places += [*(None for _ in cause.shapes), *range(start, start + width)]
        start += width
    spread = np.zeros((len(places), len(places)))
    fits = [row for row, place in enumerate(places) if place is not None]
    chosen = [place for place in places if place is not None]
    spread[np.ix_(fits, fits)] = done.covariance[np.ix_(chosen, chosen)]
    assert log.output is not None
    output = log.output[np.isfinite(log.output)]
    new = with_terms(given, terms, spread, output, log.temperature)
    return new if given.noise.angle_random_walk else replace(new, noise=_noise(done))


def _noise(done: Fitted) -> Noise:
    """Return the noise of the gyro; a wander that the log does not show is none."""
    lower = done.fit.sizes['bias_instability'][1]
    seen = done.size('bias_instability') if lower > 1e-6 else 0.0
    return Noise(done.size('angle_random_walk'), seen)


# what is won


def _contributions(done: Fitted) -> dict[str, Array]:
    """Return what each cause adds to the change of heading over spans, and what is left, rad."""
    values = done.values.copy()
    values[2] -= done.spans.delay
    columns = all_columns(done.spans, done.causes) * values
    found = {name: columns[:, place] for place, name in enumerate(PLAIN) if name != 'time_offset'}
    start = len(PLAIN)
    for cause in done.causes:
        width = done.spans.columns(cause).shape[1]
        found[cause.cause] = columns[:, start: start + width].sum(axis=1)
        start += width
    found['left'] = done.spans.observed - columns.sum(axis=1)
    return {name: part[: len(done.spans.time) - 1] for name, part in found.items()}


def _shares(done: Fitted) -> dict[str, float]:
    """Return which part of the mean square heading error over windows each cause explains."""
    parts = _contributions(done)
    time = done.spans.time
    window = min(WINDOW, _WITHIN * float(time[-1] - time[0]))
    over = {name: _over(part, time, window) for name, part in parts.items()}
    total = sum(over.values(), np.zeros(len(over['left'])))
    square = float(np.mean(total**2))
    if not square > 0.0:
        return {}
    found = {name: float(np.mean(part * total)) / square for name, part in over.items()}
    rates = done.spans.rates()
    own = (
        2.0
        * (done.size('reference') ** 2 + done.size('motion') ** 2 * float(np.mean(rates**2)))
        / square
    )
    left = found.pop('left')
    return {**found, 'reference': min(own, max(left, 0.0)), 'left': max(left - own, 0.0)}


def _over(change: Array, time: Array, window: float) -> Array:
    """Return changes over windows from changes over spans."""
    whole = np.concatenate([[0.0], np.cumsum(change)])
    later = np.searchsorted(time, time + window - 0.5 * SPAN)
    inside = np.flatnonzero(later < len(time))
    return np.asarray(whole[later[inside]] - whole[inside])


def _gain(plain: Fitted, extended: Fitted) -> Gain | None:
    """Hold out each part of a log in turn, fit the others, and predict heading and rate there."""
    time, spans = plain.spans.time, plain.spans
    duration = float(time[-1] - time[0])
    parts = int(np.clip(duration / _PART, _FEWEST_PARTS, _MOST_PARTS))
    count = len(time) - 1
    number = np.minimum(((time[1:] - time[0]) * parts / duration).astype(int), parts - 1)
    whiten = whitening(plain.spans, plain.fit)
    window = min(WINDOW, _WITHIN * duration / parts)
    models = {
        'given': plain.spans.plain()[:, 2:],
        'plain': all_columns(spans, ()),
        'extended': all_columns(extended.spans, extended.causes),
    }
    priors = {
        'given': plain.prior[2:],
        'plain': plain.prior,
        'extended': np.append(extended.prior, np.full(models['extended'].shape[1] - 3, np.inf)),
    }
    squares: dict[str, list[tuple[float, float]]] = {name: [] for name in models}
    sizes: list[tuple[int, int]] = []
    for part in range(parts):
        held = np.flatnonzero(number == part)
        # the log goes on on both sides: what is whitened across the border is left out
        kept = np.setdiff1d(np.arange(len(spans.observed)), [*held, *(held + 1), *(held - 1)])
        if len(held) < 4 or len(kept) < 8:
            return None
        for name, columns in models.items():
            rows = np.vstack([whiten[kept] @ columns, np.diag(1.0 / priors[name])])
            target = np.append(whiten[kept] @ spans.observed, np.zeros(len(priors[name])))
            values = np.linalg.lstsq(rows, target, rcond=None)[0]
            left = (spans.observed - columns @ values)[:count][held]
            stamps = time[held[0]: held[-1] + 2]
            turned = _over(left, stamps, window)
            squares[name].append(
                (float(np.sum(turned**2)), float(np.sum((left / np.diff(stamps)) ** 2)))
            )
        sizes.append((len(turned), len(left)))
    weight = np.array(sizes, float)
    if not (weight > 0).all():
        return None
    tables = {name: np.array(each) for name, each in squares.items()}
    rms = {name: np.sqrt(each.sum(axis=0) / weight.sum(axis=0)) for name, each in tables.items()}
    heading, rate = (
        change_over(
            np.column_stack([tables['given'][:, k], tables['extended'][:, k]]), weight[:, k]
        )
        for k in (0, 1)
    )
    return Gain(
        f'each of {parts} parts of the log in turn, the others being fitted',
        rate,
        heading,
        window,
        {name: float(each[0]) for name, each in rms.items()},
    )


# for people


def _cannot_show(plain: Fitted) -> dict[str, str]:
    """Say of each cause that was not searched for why such a reference cannot show it."""
    log = plain.spans.log
    seen = (
        {each.cause for each in candidates(plain)}
        | set(PLAIN)
        | {
            'outliers',
            'stuck_samples',
            'dropped_samples',
            'unit_error',
            'quantization',
            'saturation',
        }
    )
    missing = {
        'temperature': log.temperature,
        'specific_force': log.specific_force,
        'supply': log.supply,
    }
    told = {}
    for name, cause in CAUSES.items():
        if name in seen:
            continue
        lacks = [
            channel
            for channel, value in missing.items()
            if value is None and channel in cause.needs
        ]
        told[name] = (
            f'the logs have no {" and no ".join(lacks)}'.replace('_', ' ')
            if lacks
            else 'the errors of the reference hide it over short spans'
        )
    return told


def _remarks(reference: Reference, plain: Fitted) -> Iterator[str]:
    yield (
        f'The reference is taken as {_SPOKEN[reference.kind]} ({reference.known}); say so with '
        '--reference-kind if it is another. It errs by '
        f'{plain.size("reference") / DEGREE:.2g} deg from point to point, and by '
        f'{1000.0 * plain.size("motion"):.2g} ms of the motion.'
    )
    if plain.prior[0] < PLAIN['scale_factor_error']:
        yield (
            'The scale factor error rests on fewer than three stretches that turn, and is left '
            'at 0 +- 1 %: turn more often, both ways.'
        )


def _method(reference: Reference) -> str:
    return (
        f'The heading by {_SPOKEN[reference.kind]} was compared with the integral of the output '
        'over spans of a second or more, under noise of gyro and reference that was found '
        'together with the causes. A cause is established if its evidence holds beyond the '
        'scatter between stretches, and if choice and fit on some stretches predict the others; '
        'else it is suspected. Only established causes are in the model. Intervals are of 95 %.'
    )


def _heading(done: Fitted) -> HeadingCurve:
    parts = _contributions(done)
    total = sum(parts.values(), 0.0 * parts['left'])
    before, after = (np.concatenate([[0.0], np.cumsum(each)]) for each in (total, parts['left']))
    return HeadingCurve(done.spans.time, before, after)


def _rates(done: Fitted) -> tuple[Array, Array, Array, Array]:
    """Return duration of spans, and measured rates less given and extended simulation, rad/s."""
    parts, steps = _contributions(done), np.diff(done.spans.time)
    total = sum(parts.values(), 0.0 * parts['left'])
    assert done.spans.log.output is not None
    measured = done.spans.integrals(done.spans.log.output)[: len(steps)] / steps
    return steps, measured, -total / steps, -parts['left'] / steps


def _trace(done: Fitted) -> Trace:
    steps, measured, before, after = _rates(done)
    return Trace(done.spans.time[:-1] + 0.5 * steps, measured, measured - before, measured - after)


def _curve(done: Fitted) -> Curve:
    """Return what is left along the rate."""
    steps, measured, before, after = _rates(done)
    order = np.array_split(np.argsort(measured, kind='stable'), min(_BINS, len(steps) // 4 + 1))
    bins: Sequence[Array] = [
        np.array([float(each[part].mean()) for part in order])
        for each in (measured, before, after)
    ]
    deviation = np.array([float(after[part].std()) / math.sqrt(len(part)) for part in order])
    return Curve('rate', 'rad/s', bins[0], bins[1], bins[2], deviation, np.zeros(len(order)))
