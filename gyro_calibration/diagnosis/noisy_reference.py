# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.


"""The diagnosis of a log whose reference has errors of its own, such as a course over ground."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
import math

from gyro_calibration.diagnosis.causes import CAUSES, with_remedies
from gyro_calibration.diagnosis.confirmation import candidates, Confirmed, search
from gyro_calibration.diagnosis.cross_validation import (
    change_over,
    heading_curve,
    over_windows,
    shares,
    WINDOW,
    WITHIN,
)
from gyro_calibration.diagnosis.data_quality import inspect
from gyro_calibration.diagnosis.extended_model import origins_before, with_terms
from gyro_calibration.diagnosis.findings import (
    Curve,
    Diagnosis,
    Estimate,
    Finding,
    Gain,
    LEAST_PROBABILITY,
    Reference,
    Trace,
)
from gyro_calibration.diagnosis.spans import (
    all_columns,
    Column,
    FEWEST_STRETCHES,
    fit_spans,
    PLAIN,
    shared_noise,
    SpanFit,
    spans_of,
    whitened,
)
from gyro_calibration.heading.log_compensation import compensate_log
from gyro_calibration.logs.log import Array, DEGREE, Log
from gyro_calibration.model.effects import BIAS, CATALOGUE, SCALE_FACTOR_ERROR
from gyro_calibration.model.gyro_model import GyroModel, Term, Tolerance
from gyro_calibration.model.noise import Noise
import numpy as np
from scipy.stats import t as student

#: Parts of a log that are held out in turn: at least, at most, and the least length of one, s.
_FEWEST_PARTS, _MOST_PARTS, _PART = 2, 6, 80.0
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
_SPOKEN = {'rate_command': 'a reference rate with noise', 'course': 'a course over ground',
           'encoder': 'an encoder', 'odometry': 'odometry', 'motion_capture': 'motion capture',
           'gyro': 'another gyro'}
_METHOD = ('The heading by {} was compared with the integral of the output over spans of a second '
           'or more, under noise of gyro and reference that was found together with the causes. A '
           'cause is established if its evidence holds beyond the scatter between stretches, and '
           'if choice and fit on some stretches predict the others; else it is suspected. Only '
           'established causes are in the model. Intervals are of 95 %.')
#: What is no candidate, because it is looked for in any log.
_ALWAYS_SEEN = {*PLAIN, 'outliers', 'stuck_samples', 'dropped_samples', 'unit_error',
                'quantization', 'saturation'}


def diagnose_by_noisy_reference(log: Log, reference: Reference,
                                model: GyroModel | None, rate: float) -> Diagnosis:
    """
    Say what a simulation gets wrong, by a reference that errs more than the gyro.

    Parameters
    ----------
    log : with output, time and a reference
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
    mended = replace(log, output=np.where(record.trusted, log.output, np.nan))
    prior = None if model is None else model.prior
    plain = fit_spans(spans_of(mended if model is None else replace(
        mended, output=compensate_log(model, mended)), reference.kind, prior))
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
    parts, time = _contributions(extended), extended.spans.time
    noise = {name: extended.size(name) for name in ('reference', 'motion')}
    rates = extended.spans.rates()
    of_heading = shares([(parts, time)], 2.0 * (
        noise['reference'] ** 2 + noise['motion'] ** 2 * float(np.mean(rates ** 2))))
    findings = [*_of_values(extended, model, rate, reference), *record.findings,
                *(_finding(each, extended, plain) for each in found)]
    findings.sort(key=lambda each: (each.status != 'established', each.p_value))
    of_record = {each.effect for each in record.findings}
    changed = any(each.status == 'established' and CAUSES[each.effect].of == 'gyro'
                  and each.effect not in {'time_offset', *of_record} for each in findings)
    # between two clocks a delay is no property of the gyro
    late = next((each for each in findings if each.effect == 'time_offset'
                 and each.status == 'established' and reference.kind in _SAME_CLOCK), None)
    base = _model(GyroModel(), plain, log) if model is None else model
    after = (_model(model or GyroModel(), inside, log)
             if changed or late or model is None or prior is not None else model)
    if model is not None and prior is not None:
        # what is known of this unit now takes the place of what is usual of its type
        after = replace(after, tolerance=Tolerance(), origin=origins_before(model))
    if late:
        size = late.parameters['time_offset']
        deviation = (size.interval[1] - size.interval[0]) / (2.0 * 1.96)
        after = with_terms(after, [Term(CATALOGUE['time_offset'], (size.estimate,))],
                           np.array([[deviation ** 2]]), [np.array(after.rate_range)], [])
    curve, trace = _pictures(extended, parts)
    return Diagnosis(
        tuple(with_remedies(findings, of_heading, after)), (), _noise(extended),
        Noise() if model is None else model.noise,
        None if not changed and model is not None else gain, base, after, _cannot_show(plain),
        [curve], heading_curve(parts, time), None,
        (*record.remarks, *_remarks(reference, plain, prior is not None)), rate, trace=trace,
        method=_METHOD.format(_SPOKEN[reference.kind]), reference=replace(reference, noise=noise),
        heading_shares=of_heading)


# values

def _of_values(done: SpanFit, model: GyroModel | None, rate: float,
               reference: Reference) -> Iterator[Finding]:
    """Give delay, and beside a model bias and scale factor error, where they are established."""
    lag = next((each for each in done.causes if each.cause == 'bandwidth'), None)
    own_clock = reference.kind not in _SAME_CLOCK
    for place, name in enumerate(PLAIN):
        if name != 'time_offset' and model is None:
            continue
        value, deviation = float(done.values[place]), math.sqrt(done.covariance[place, place])
        if name == 'bias' and model is not None:
            # the mean of a log wanders about the bias of a model
            duration = float(done.spans.time[-1] - done.spans.time[0])
            deviation = math.sqrt(deviation ** 2 + max(
                2.0 / math.pi * each.bias_instability ** 2
                + each.rate_random_walk ** 2 * duration / 3.0
                for each in (_noise(done), model.noise)))
        if name == 'time_offset' and lag is not None:
            # to first order a lag is a delay
            place_of_lag = done.places(lag).start
            constant = _lag(float(done.values[place_of_lag]), done.half(place_of_lag))
            value -= constant.estimate
            deviation = math.hypot(
                deviation, (constant.interval[1] - constant.interval[0]) / (2.0 * 1.96))
        effective = float(done.stretches_of[place])
        freedom = max(effective - 1.0, 1.0)
        chance = float(2.0 * student.sf(abs(value) / deviation, freedom))
        if chance >= _OF_VALUE.get(name, 1.0) * rate or effective < FEWEST_STRETCHES:
            continue
        half = min(float(student.ppf(0.975, freedom)) * deviation,
                   1.96 * done.spans.treatment.prior[place])
        cause, remedy = CAUSES[name], ''
        sentence = cause.sentence
        confounders = [] if name != 'scale_factor_error' else ['reference_scale']
        if name == 'time_offset':
            of_reference = not 0.0 < value < _OF_A_LAG
            if not (of_reference or lag):
                confounders = ['bandwidth'] if _may_lag(done, value) else []
            if own_clock:
                remedy = 'synchronize the clocks of gyro and reference; the model has none of it'
                if of_reference:
                    sentence = 'Gyro and reference are not of the same time.'
        yield Finding(
            name, sentence, {name: Estimate.about(value, half, next(iter(cause.units.values())))},
            max(chance, LEAST_PROBABILITY), SEEN * deviation, ambiguous_with=tuple(confounders),
            separate_by=cause.separate_by if confounders else '',
            evidence=f'it rests on {effective:.0f} stretches', along=cause.along, remedy=remedy)


def _may_lag(done: SpanFit, delay: float) -> bool:
    """Tell whether a lag explains the log as well as the delay does."""
    if not done.spans.fine:
        return True
    data = whitened(done, (*done.causes, Column('bandwidth')))
    place = len(done.values)
    inverse = np.linalg.pinv(data.plain.T @ data.plain)
    square = float((inverse @ data.plain.T @ data.observed)[place])
    return abs(square - 0.5 * delay ** 2) < _RULED_OUT * math.sqrt(inverse[place, place])


def _finding(each: Confirmed, extended: SpanFit, plain: SpanFit) -> Finding:
    """Return a cause that the search found, with its values from a fit that holds it."""
    done = extended if each.established else fit_spans(plain.spans, [each.column])
    name, known, places = each.column.cause, CAUSES[each.column.cause], done.places(each.column)
    values = done.values[places]
    half = np.array([done.half(place) for place in range(places.start, places.stop)])
    effect = CATALOGUE.get(name)
    unit = (effect.coefficients[0].unit if effect is not None and effect.coefficients
            else next(iter(known.units.values())))
    if name == 'bandwidth':
        parameters = {name: _lag(float(values[0]), float(half[0]))}
    else:
        size = float(values[0]) if len(values) == 1 else float(np.hypot(*values))
        within = half[0] if len(values) == 1 else float(np.hypot(*(values * half))) / size
        parameters = {name: Estimate.about(size, float(within), unit)}
    for parameter, value in zip(() if effect is None else effect.shapes, each.column.shapes):
        if parameter.default is None and parameter.name not in parameters:
            parameters[parameter.name] = Estimate.about(value, 0.0, parameter.unit)
    others = tuple(other for other in each.probability if other != name)
    remedy = '' if each.established else (
        f'record again: {known.separate_by}' if known.separate_by
        else 'record longer, and see whether it is found again')
    return Finding(
        name, known.sentence, parameters, each.p_value,
        SEEN * float(half[0]) / 1.96 if len(values) == 1 and name != 'bandwidth' else None,
        others, known.separate_by if others else '',
        f'it adds {each.predicted:.1f} to the log-likelihood of stretches that took no part in '
        f'choice and fit, and is chosen in {100.0 * each.chosen:.0f} % of them', known.along,
        'established' if each.established else 'suspected', each.probability, None,
        (each.column.shapes[0], float(plain.spans.time[-1])) if each.column.once else None, remedy)


def _lag(square: float, half: float) -> Estimate:
    """Return a time constant from half of its square."""
    low, size, high = (math.sqrt(2.0 * max(each, 0.0))
                       for each in (square - half, square, square + half))
    return Estimate(size, (low, high), 's')


def _model(given: GyroModel, done: SpanFit, log: Log) -> GyroModel:
    """Return a model with scale factor error, bias, and the causes of the gyro that are fitted."""
    own = 1.0 + sum(term.values[0] for term in given.terms if term.effect is SCALE_FACTOR_ERROR)
    scale, bias = (own * float(value) for value in done.values[:2])
    terms = [Term(BIAS, (bias,)), Term(SCALE_FACTOR_ERROR, (scale,))]
    places: list[int | None] = [1, 0]
    for cause in done.causes:
        own_places = done.places(cause)
        values = done.values[own_places].tolist()
        if cause.cause == 'bandwidth':
            terms.append(Term(CATALOGUE['bandwidth'],
                              (math.sqrt(2.0 * max(values[0], 1e-10)),)))
            places.append(None)
        elif cause.cause in CATALOGUE:
            terms.append(Term(CATALOGUE[cause.cause], (*cause.shapes, *values)))
            places += [*(None for _ in cause.shapes), *range(own_places.start, own_places.stop)]
    spread = np.zeros((len(places), len(places)))
    fits = [row for row, place in enumerate(places) if place is not None]
    chosen = [place for place in places if place is not None]
    spread[np.ix_(fits, fits)] = done.covariance[np.ix_(chosen, chosen)]
    assert log.output is not None
    output = log.output[np.isfinite(log.output)]
    new = with_terms(given, terms, spread, [output],
                     [] if log.temperature is None else [log.temperature])
    return new if given.noise.angle_random_walk else replace(new, noise=_noise(done))


def _noise(done: SpanFit) -> Noise:
    """Return the noise of the gyro; a wander that the log does not show is none."""
    # at the edge of the grid nothing bounds it from below
    return Noise(done.size('angle_random_walk'), **{
        part.name: done.size(part.name)
        if done.fit.sizes[part.name][1] > 1.01 * part.range[0] else 0.0
        for part in shared_noise(done.spans)})


# what is won

def _contributions(done: SpanFit) -> dict[str, Array]:
    """Return what each cause adds to the change of heading over spans, and what is left, rad."""
    values = done.values.copy()
    values[2] -= done.spans.delay
    columns = all_columns(done.spans, done.causes) * values
    found = {name: columns[:, place] for place, name in enumerate(PLAIN) if name != 'time_offset'}
    for cause in done.causes:
        found[cause.cause] = columns[:, done.places(cause)].sum(axis=1)
    found['left'] = done.spans.observed - columns.sum(axis=1)
    return {name: part[:len(done.spans.time) - 1] for name, part in found.items()}


def _gain(plain: SpanFit, extended: SpanFit) -> Gain | None:
    """Hold out each part of a log in turn, fit the others, and predict heading and rate there."""
    time, spans = plain.spans.time, plain.spans
    duration, count = float(time[-1] - time[0]), len(time) - 1
    parts = int(np.clip(duration / _PART, _FEWEST_PARTS, _MOST_PARTS))
    number = np.minimum(((time[1:] - time[0]) * parts / duration).astype(int), parts - 1)
    window = min(WINDOW, WITHIN * duration / parts)
    # under the noise of the plain fit, and beside the bias that wanders
    noisy = whitened(plain, ())
    prior = len(noisy.observed) - len(spans.observed)
    models = {'given': (spans.plain()[:, 2:], noisy.plain[:, 2:]),
              'plain': (all_columns(spans, ()), noisy.plain),
              'extended': (all_columns(extended.spans, extended.causes),
                           whitened(extended, extended.causes, plain).plain)}
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
            left = (spans.observed - columns @ values[:columns.shape[1]])[:count][held]
            stamps = time[held[0]:held[-1] + 2]
            turned = over_windows(left, stamps, window)
            squares[name].append((float(np.sum(turned ** 2)),
                                  float(np.sum((left / np.diff(stamps)) ** 2))))
        sizes.append((len(turned), len(left)))
    weight = np.array(sizes, float)
    if not (weight > 0).all():
        return None
    tables = {name: np.array(each) for name, each in squares.items()}
    heading, rate = (change_over(np.column_stack([tables[name][:, k]
                                                  for name in ('given', 'extended')]),
                                 weight[:, k]) for k in (0, 1))
    return Gain(f'each of {parts} parts of the log in turn, the others being fitted', rate,
                heading, window, {
                    name: float(np.sqrt(each[:, 0].sum() / weight[:, 0].sum()))
                    for name, each in tables.items()})


# for people

def _cannot_show(plain: SpanFit) -> dict[str, str]:
    """Say of each cause that was not searched for why such a reference cannot show it."""
    seen = {each.cause for each in candidates(plain)} | _ALWAYS_SEEN
    missing = {channel for channel in ('temperature', 'specific_force', 'supply')
               if getattr(plain.spans.log, channel) is None}
    shown = {}
    for name, cause in CAUSES.items():
        lacks = sorted(missing & cause.needs)
        if name not in seen:
            shown[name] = (f'the logs have no {" and no ".join(lacks)}'.replace('_', ' ') if lacks
                           else 'the errors of the reference hide it over short spans')
    return shown


def _remarks(reference: Reference, plain: SpanFit, of_fleet: bool) -> Iterator[str]:
    if of_fleet:
        yield ('What the log leaves open of bias and scale factor error is drawn to what is usual '
               'by the model, which is of a fleet.')
    yield (f'The reference is taken as {_SPOKEN[reference.kind]} ({reference.known}); say so with '
           '--reference-kind if it is another. It errs by '
           f'{plain.size("reference") / DEGREE:.2g} deg from point to point, and by '
           f'{1000.0 * plain.size("motion"):.2g} ms of the motion.')
    if plain.prior[0] < plain.spans.treatment.prior[0]:
        yield ('The scale factor error rests on fewer than three stretches that turn, and is left '
               f'at 0 +- {100.0 * plain.spans.treatment.prior[0]:g} %: turn more often, both '
               'ways.')


def _pictures(done: SpanFit, parts: dict[str, Array]) -> tuple[Curve, Trace]:
    """Return what is left along the rate, and the rate as it is measured and simulated."""
    steps, time = np.diff(done.spans.time), done.spans.time
    assert done.spans.log.output is not None
    measured = done.spans.integrals(done.spans.log.output)[:len(steps)] / steps
    before, after = (-each / steps
                     for each in (sum(parts.values(), 0.0 * parts['left']), parts['left']))
    order = np.array_split(np.argsort(measured, kind='stable'), min(_BINS, len(steps) // 4 + 1))
    at, given, left = (np.array([float(each[part].mean()) for part in order])
                       for each in (measured, before, after))
    deviation = np.array([float(after[part].std()) / math.sqrt(len(part)) for part in order])
    return (Curve('rate', 'rad/s', at, given, left, deviation, np.zeros(len(order))),
            Trace(time[:-1] + 0.5 * steps, measured, measured - before, measured - after))
