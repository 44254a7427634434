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
    Column,
    FEWEST_STRETCHES,
    Fitted,
    fitted,
    PLAIN,
    shared_noise,
    spans_of,
    whitened,
)
from gyro_calibration.heading.log_compensation import compensate_log
from gyro_calibration.logs.log import Array, DEGREE, Log
from gyro_calibration.model.effects import BIAS, CATALOGUE, SCALE_FACTOR_ERROR
from gyro_calibration.model.gyro_model import GyroModel, Term
from gyro_calibration.model.noise import Noise
import numpy as np
from scipy.stats import t as student

#: Parts of a log that are held out in turn: at least, at most, and the least length of one, s.
_FEWEST_PARTS, _MOST_PARTS, _PART = 2, 6, 80.0
#: A window is no longer than this part of what is held out.
_WITHIN = 0.75
#: Kinds whose values come with the samples of the gyro, by one clock.
_SAME_CLOCK = ('rate_command', 'encoder')
#: Standard deviations from which on a value is found in 95 % of logs, and from which on a lag is
#: ruled out.
SEEN, _RULED_OUT = 4.8, 3.0
#: A gyro is no more sluggish than this, s.
_OF_A_LAG = 0.1
#: Bins of a curve.
_BINS = 20
#: Shares of the false-alarm rate: of the causes that are searched for, and beside a model of bias
#: and of scale factor error. A delay between two clocks is no surprise: it has a level of its own.
_OF_SEARCH, _OF_VALUE = 0.6, {'bias': 0.05, 'scale_factor_error': 0.05}
_SPOKEN = {
    'rate_command': 'a reference rate with noise',
    'course': 'a course over ground',
    'encoder': 'an encoder',
    'odometry': 'odometry',
    'motion_capture': 'motion capture',
    'gyro': 'another gyro',
}
_REMEDIES = {
    'gyro': 'add it to the model of the gyro',
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
    if reference.kind != 'rate_command' and log.reference_heading is not None:
        log = replace(log, reference_rate=None)
    else:
        log = replace(log, reference_heading=None)
    record = inspect(replace(log, reference_heading=None, reference_rate=None))
    assert log.output is not None
    output = np.where(record.trusted, log.output, np.nan)
    mended = replace(log, output=output)
    corrected = mended if model is None else replace(mended, output=compensate_log(model, mended))
    plain = fitted(spans_of(corrected, reference.kind))
    extended, found = search(plain, _OF_SEARCH * rate)
    gain = _gain(plain, extended)
    inside = extended
    if gain is not None and extended.causes and gain.models['extended'] > gain.models['plain']:
        # what predicts no better is in no model; a course shows no more than that
        inside = plain
        if not plain.spans.fine:
            found = [replace(each, established=False) for each in found]
            extended = plain
        gain = _gain(plain, plain)
    given = model or GyroModel()
    base = _model(GyroModel(), plain, log) if model is None else model
    findings = [
        *_of_values(extended, model, rate, reference),
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
    # between two clocks a delay is no property of the gyro
    late = next((each for each in findings if each.effect == 'time_offset'
                 and each.status == 'established' and reference.kind in _SAME_CLOCK), None)
    after = _model(given, inside, log) if changed or late or model is None else given
    if late:
        after = _delayed(after, late)
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


def _of_values(
    done: Fitted, model: GyroModel | None, rate: float, reference: Reference
) -> Iterator[Finding]:
    """Give delay, and beside a model bias and scale factor error, where they are established."""
    lag = next((each for each in done.causes if each.cause == 'bandwidth'), None)
    for place, name in enumerate(PLAIN):
        if name != 'time_offset' and model is None:
            continue
        value, deviation = float(done.values[place]), math.sqrt(done.covariance[place, place])
        if name == 'bias' and model is not None:
            deviation = math.sqrt(deviation**2 + _wander_of(done, model))
        if name == 'time_offset' and lag is not None:
            # to first order a lag is a delay
            square, half = _value_of(done, lag)
            constant = _lag(square, half)
            value -= constant.estimate
            deviation = math.hypot(
                deviation, (constant.interval[1] - constant.interval[0]) / (2.0 * 1.96)
            )
        effective = float(done.stretches_of[place])
        freedom = max(effective - 1.0, 1.0)
        chance = float(2.0 * student.sf(abs(value) / deviation, freedom))
        if chance >= _OF_VALUE.get(name, 1.0) * rate or effective < FEWEST_STRETCHES:
            continue
        half = min(
            float(student.ppf(0.975, freedom)) * deviation,
            1.96 * done.spans.treatment.prior[place],
        )
        cause = CAUSES[name]
        own_clock = reference.kind not in _SAME_CLOCK
        of_reference = name == 'time_offset' and not 0.0 < value < _OF_A_LAG
        twins = {
            'time_offset': () if of_reference or lag or not _may_lag(done, value)
            else ('bandwidth',),
            'scale_factor_error': ('reference_scale',),
        }.get(name, ())
        yield Finding(
            name,
            'Gyro and reference are not of the same time.'
            if of_reference and own_clock
            else cause.sentence,
            {
                name: Estimate(
                    value, (value - half, value + half), next(iter(cause.units.values()))
                )
            },
            max(chance, LEAST_CHANCE),
            SEEN * deviation,
            ambiguous_with=twins,
            separate_by=cause.separate_by if twins else '',
            evidence=f'it rests on {effective:.0f} stretches',
            along=cause.along,
            remedy='synchronize the clocks of gyro and reference; the model has none of it'
            if name == 'time_offset' and own_clock
            else '',
        )


def _value_of(done: Fitted, cause: Column) -> tuple[float, float]:
    """Return the first value of a cause, and half of its interval."""
    start = len(PLAIN)
    for each in done.causes:
        if each == cause:
            break
        start += done.spans.columns(each).shape[1]
    return float(done.values[start]), done.half(start)


def _may_lag(done: Fitted, delay: float) -> bool:
    """Tell whether a lag explains the log as well as the delay does."""
    if not done.spans.fine:
        return True
    data = whitened(done, (*done.causes, Column('bandwidth')))
    place = len(done.values)
    inverse = np.linalg.pinv(data.plain.T @ data.plain)
    square = float((inverse @ data.plain.T @ data.observed)[place])
    return abs(square - 0.5 * delay**2) < _RULED_OUT * math.sqrt(inverse[place, place])


def _wander_of(done: Fitted, model: GyroModel) -> float:
    """Return the variance of the mean of a log about the bias of a model, by their wander."""
    duration = float(done.spans.time[-1] - done.spans.time[0])
    seen, noise = _noise(done), model.noise
    of_log, of_model = (
        2.0 / math.pi * each.bias_instability**2 + each.rate_random_walk**2 * duration / 3.0
        for each in (seen, noise)
    )
    return max(of_log, of_model)


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
        if name in CATALOGUE and CATALOGUE[name].coefficients
        else next(iter(CAUSES[name].units.values()))
    )
    if name == 'bandwidth':
        parameters = {name: _lag(float(values[0]), half[0])}
    elif width == 1:
        size = float(values[0])
        parameters = {name: Estimate(size, (size - half[0], size + half[0]), unit)}
    else:
        size = float(np.hypot(*values))
        within = float(np.hypot(*(values * half))) / size
        parameters = {name: Estimate(size, (size - within, size + within), unit)}
    shapes = CATALOGUE[name].shapes if name in CATALOGUE else ()
    for parameter, value in zip(shapes, each.column.shapes):
        if parameter.default is None and parameter.name not in parameters:
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
        SEEN * half[0] / 1.96 if width == 1 and name != 'bandwidth' else None,
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


def _lag(square: float, half: float) -> Estimate:
    """Return a time constant from half of its square."""
    low, size, high = (
        math.sqrt(2.0 * max(each, 0.0)) for each in (square - half, square, square + half)
    )
    return Estimate(size, (low, high), 's')


def _model(given: GyroModel, done: Fitted, log: Log) -> GyroModel:
    """Return a model with scale factor error, bias, and the causes of the gyro that are fitted."""
    own = 1.0 + sum(term.values[0] for term in given.terms if term.effect is SCALE_FACTOR_ERROR)
    scale, bias = (own * float(value) for value in done.values[:2])
    terms = [Term(BIAS, (bias,)), Term(SCALE_FACTOR_ERROR, (scale,))]
    places: list[int | None] = [1, 0]
    start = len(PLAIN)
    for cause in done.causes:
        width = done.spans.columns(cause).shape[1]
        if cause.cause == 'bandwidth':
            size = math.sqrt(2.0 * max(float(done.values[start]), 1e-10))
            terms.append(Term(CATALOGUE['bandwidth'], (size,)))
            places.append(None)
        elif cause.cause in CATALOGUE:
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


def _delayed(model: GyroModel, found: Finding) -> GyroModel:
    """Return a model whose stamps are late by what was found."""
    size = found.parameters['time_offset']
    deviation = (size.interval[1] - size.interval[0]) / (2.0 * 1.96)
    term = Term(CATALOGUE['time_offset'], (size.estimate,))
    outputs = np.array(model.rate_range)
    return with_terms(model, [term], np.array([[deviation ** 2]]), outputs, None)


def _noise(done: Fitted) -> Noise:
    """Return the noise of the gyro; a wander that the log does not show is none."""
    shown = {}
    for part in shared_noise(done.spans):
        lower = done.fit.sizes[part.name][1]
        # at the edge of the grid nothing bounds it from below
        shown[part.name] = done.size(part.name) if lower > 1.01 * part.range[0] else 0.0
    return Noise(done.size('angle_random_walk'), **shown)


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
    later = np.searchsorted(time, time + window - 0.5 * float(np.median(np.diff(time))))
    inside = np.flatnonzero(later < len(time))
    return np.asarray(whole[later[inside]] - whole[inside])


def _gain(plain: Fitted, extended: Fitted) -> Gain | None:
    """Hold out each part of a log in turn, fit the others, and predict heading and rate there."""
    time, spans = plain.spans.time, plain.spans
    duration = float(time[-1] - time[0])
    parts = int(np.clip(duration / _PART, _FEWEST_PARTS, _MOST_PARTS))
    count = len(time) - 1
    number = np.minimum(((time[1:] - time[0]) * parts / duration).astype(int), parts - 1)
    window = min(WINDOW, _WITHIN * duration / parts)
    # under the noise of the plain fit, and beside the bias that wanders
    noisy = whitened(plain, ())
    prior = len(noisy.observed) - len(spans.observed)
    models = {
        'given': (plain.spans.plain()[:, 2:], noisy.plain[:, 2:]),
        'plain': (all_columns(spans, ()), noisy.plain),
        'extended': (
            all_columns(extended.spans, extended.causes),
            whitened(extended, extended.causes, plain).plain,
        ),
    }
    squares: dict[str, list[tuple[float, float]]] = {name: [] for name in models}
    sizes: list[tuple[int, int]] = []
    for part in range(parts):
        held = np.flatnonzero(number == part)
        # the log goes on on both sides: what is whitened across the border is left out
        kept = np.setdiff1d(np.arange(len(spans.observed)), [*held, *(held + 1), *(held - 1)])
        if len(held) < 4 or len(kept) < 8:
            return None
        rows = np.append(kept, len(spans.observed) + np.arange(prior))
        for name, (columns, white) in models.items():
            values = np.linalg.lstsq(white[rows], noisy.observed[rows], rcond=None)[0]
            values = values[: columns.shape[1]]
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
    if plain.prior[0] < plain.spans.treatment.prior[0]:
        yield (
            'The scale factor error rests on fewer than three stretches that turn, and is left '
            f'at 0 +- {100.0 * plain.spans.treatment.prior[0]:g} %: turn more often, both ways.'
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
