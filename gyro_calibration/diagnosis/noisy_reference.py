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
The diagnosis of a log whose reference has errors of its own, such as a course over ground.

The score of a candidate is summed over stretches. Its variance is that by the noise or that by the
scatter of the stretches, whichever is larger, and its distribution is Student's, with the
effective number of stretches less one as the degrees of freedom. The p-value of the best candidate
is that of a single one times their number; single events are counted separately. A cause is
established if it is also selected without each fold, and predicts the stretches of the folds
better than no cause; otherwise it is suspected.

"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
import math

from gyro_calibration.diagnosis.candidates import added_effects, LEAST_CHANGE
from gyro_calibration.diagnosis.causes import as_suspected, CAUSES, finding, with_remedies
from gyro_calibration.diagnosis.cross_validation import (
    gain_of,
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
    probabilities,
    Reference,
    SUSPECTED,
    Trace,
)
from gyro_calibration.diagnosis.search import SURELY, sureness
from gyro_calibration.diagnosis.spans import (
    all_columns,
    Column,
    FEWEST_STRETCHES,
    fit_spans,
    HEADING,
    PLAIN,
    shared_noise,
    SpanFit,
    spans_of,
    Whitened,
    whitened,
)
from gyro_calibration.diagnosis.steps import CHECKS, OnPart, OnProgress, Steps
from gyro_calibration.heading.log_compensation import compensate_log
from gyro_calibration.logs.log import Array, DEGREE, Log, Mask, NORMAL_95
from gyro_calibration.model.effects import BIAS, CATALOGUE, SCALE_FACTOR_ERROR
from gyro_calibration.model.gyro_model import GyroModel, Term, Tolerance
from gyro_calibration.model.noise import Noise
import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as fisher
from scipy.stats import t as student

#: Least and largest number of parts of a log that are held out in turn, and least length, s.
_FEWEST_PARTS, _MOST_PARTS, _PART = 2, 6, 80.0
#: Kinds of references that are sampled with the gyro, by one clock.
_SAME_CLOCK = ('rate_command', 'encoder')
#: Shares of the steps in the computing time, %, measured on 25 min of an encoder at 100 Hz.
_SHARES = {CHECKS: 4, 'data quality': 3, 'bias and scale factor error': 26,
           'search for causes': 45, 'cross-validation': 4, 'findings': 18}
#: Standard deviations of a value that is found in 95 % of logs, and of a lag that is ruled out.
SEEN, _RULED_OUT = 4.8, 3.0
#: Longest lag of a gyro, s.
_OF_A_LAG = 0.1
#: Bins of a curve.
_BINS = 20
#: Shares of the false-alarm rate: for the search for causes, for a delay, and, with a model, for
#: bias and scale factor error. A delay between two clocks is usual and has a separate level.
_OF_SEARCH, _OF_VALUE = 0.6, {'bias': 0.05, 'scale_factor_error': 0.05, 'time_offset': 0.1}
_SPOKEN = {'rate_command': 'a reference rate with noise', 'course': 'a course over ground',
           'encoder': 'an encoder', 'odometry': 'odometry', 'motion_capture': 'motion capture',
           'gyro': 'another gyro'}
_METHOD = ('The heading by {} was compared with the integral of the output over spans of a second '
           'or more, under noise of gyro and reference that was found together with the causes. A '
           'cause is established if its evidence holds beyond the scatter between stretches, and '
           'if choice and fit on some stretches predict the others; else it is suspected. Only '
           'established causes are in the model. Intervals are of 95 %.')
#: Causes that are not candidates, because they are tested in each log.
_ALWAYS_SEEN = {*PLAIN, 'outliers', 'stuck_samples', 'dropped_samples', 'unit_error',
                'quantization', 'saturation'}
#: Largest number of causes that are added, and of parts of a log for cross-fitting.
MOST, FOLDS = 4, 5
#: Largest effect along the rate that is established, as a share of the rate: two standard
#: deviations of the prior of a scale factor error. Larger ones result from several similar columns
#: that nearly cancel each other.
_LARGEST = 2.0 * HEADING.prior[0]
#: Variables whose causes are similar to errors of an encoder that repeat with its position.
_OF_MOTION = frozenset({'rate', 'rate_change', 'heading'})
#: Largest likelihood ratio between the best cause and an equivalent one.
_LIKELY = 25.0


def diagnose_by_noisy_reference(log: Log, reference: Reference, model: GyroModel | None,
                                rate: float, on_progress: OnProgress) -> Diagnosis:
    """
    Diagnose a log with a reference whose errors are larger than those of the gyro.

    Parameters
    ----------
    log : with output, time and a reference
    reference : its kind
    model : of the simulation; None is an ideal gyro
    rate : of false alarms
    on_progress : is called with the share of the work done and the name of the step that begins

    """
    steps = Steps(on_progress, _SHARES)
    steps.begin('data quality')
    if reference.kind != 'rate_command' and log.reference_heading is not None:
        log = replace(log, reference_rate=None)
    else:
        log = replace(log, reference_heading=None)
    record = inspect(replace(log, reference_heading=None, reference_rate=None))
    assert log.output is not None
    mended = replace(log, output=np.where(record.trusted, log.output, np.nan))
    prior = None if model is None else model.prior
    steps.begin('bias and scale factor error')
    plain = fit_spans(spans_of(mended if model is None else replace(
        mended, output=compensate_log(model, mended)), reference.kind, prior))
    steps.begin('search for causes')
    extended, found = search(plain, _OF_SEARCH * rate, steps.within)
    steps.begin('cross-validation')
    gain = _gain(plain, extended)
    inside = extended
    if gain is not None and extended.causes and gain.models['extended'] > gain.models['plain']:
        # causes that do not improve the prediction are not added to the model
        inside = plain
        if not plain.spans.fine:
            found = [replace(each, established=False) for each in found]
            extended = plain
        gain = _gain(plain, plain)
    steps.begin('findings')
    parts, time = _contributions(extended), extended.spans.time
    noise = {name: extended.size(name) for name in ('reference', 'motion')}
    rates = extended.spans.rates()
    of_heading = shares([(parts, time)], 2.0 * (
        noise['reference'] ** 2 + noise['motion'] ** 2 * float(np.mean(rates ** 2))))
    findings = [*_of_values(extended, model, rate, reference), *record.findings,
                *(each for cause in found for each in [_finding(cause, extended)]
                  if not each.parameters[each.effect].holds_zero)]
    findings.sort(key=lambda each: (each.status != 'established', each.p_value))
    of_record = {each.effect for each in record.findings}
    changed = any(each.status == 'established' and CAUSES[each.effect].of == 'gyro'
                  and each.effect not in {'time_offset', *of_record} for each in findings)
    # between two clocks a delay is no property of the gyro
    late = next((each for each in findings if each.effect == 'time_offset'
                 and each.status == 'established' and reference.kind in _SAME_CLOCK), None)
    base = _model(GyroModel(), plain, log) if model is None else model
    after = (_extended(model, inside, log, late)
             if changed or late or model is None or prior is not None else model)
    curve, trace = _pictures(extended, parts)
    return Diagnosis(
        tuple(with_remedies(findings, of_heading, after)), (), _noise(extended),
        Noise() if model is None else model.noise,
        None if not changed and model is not None else gain, base, after, _cannot_show(plain),
        [curve], heading_curve(parts, time), None,
        (*record.remarks, *_remarks(reference, extended, prior is not None)), rate, trace=trace,
        method=_METHOD.format(_SPOKEN[reference.kind]), reference=replace(reference, noise=noise),
        heading_shares=of_heading)


# values

def _of_values(done: SpanFit, model: GyroModel | None, rate: float,
               reference: Reference) -> Iterator[Finding]:
    """Give delay, and with a model bias and scale factor error, if they are established."""
    lag = next((each for each in done.causes if each.cause == 'bandwidth'), None)
    own_clock = reference.kind not in _SAME_CLOCK
    for place, name in enumerate(PLAIN):
        if name != 'time_offset' and model is None:
            continue
        value, deviation = float(done.values[place]), math.sqrt(done.covariance[place, place])
        if name == 'bias' and model is not None:
            # the mean bias of a log differs from that of the model by bias wander
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
            deviation = math.hypot(deviation, constant.deviation)
        effective = float(done.stretches_of[place])
        freedom = float(done.freedom[place])
        chance = float(2.0 * student.sf(abs(value) / deviation, freedom))
        share = 1.0 if name == 'time_offset' and own_clock else _OF_VALUE[name]
        if chance >= share * rate or effective < FEWEST_STRETCHES:
            continue
        half = min(float(student.ppf(0.975, freedom)) * deviation,
                   NORMAL_95 * done.spans.treatment.prior[place])
        known, confounders = {}, ['reference_scale'] if name == 'scale_factor_error' else []
        if name == 'time_offset':
            of_reference = not 0.0 < value < _OF_A_LAG
            if not (of_reference or lag) and _may_lag(done, value):
                confounders = ['bandwidth']
            if own_clock:
                known = {'remedy': 'synchronize the clocks of gyro and reference; the model does '
                         'not contain it'}
                if of_reference:
                    known['cause'] = 'The gyro has a time offset from its reference.'
        yield finding(name, {name: Estimate.about(value, half, CAUSES[name].unit)},
                      max(chance, LEAST_PROBABILITY), confounders,
                      minimum_detectable=SEEN * deviation,
                      evidence=f'evidence from {effective:.0f} stretches', **known)


def _may_lag(done: SpanFit, delay: float) -> bool:
    """Tell whether a lag explains the log as well as the delay does."""
    if not done.spans.fine:
        return True
    data = whitened(done, (*done.causes, Column('bandwidth')))
    place = len(done.values)
    inverse = np.linalg.pinv(data.plain.T @ data.plain)
    square = float((inverse @ data.plain.T @ data.observed)[place])
    return abs(square - 0.5 * delay ** 2) < _RULED_OUT * math.sqrt(inverse[place, place])


def _finding(each: Confirmed, extended: SpanFit) -> Finding:
    """Return a cause that the search found, with its values given the established ones."""
    done = (extended if each.established
            else fit_spans(extended.spans, [*extended.causes, each.column]))
    name, known, places = each.column.cause, CAUSES[each.column.cause], done.places(each.column)
    values = done.values[places]
    half = np.array([done.half(place) for place in range(places.start, places.stop)])
    effect = CATALOGUE.get(name)
    unit = (effect.coefficients[0].unit if effect is not None and effect.coefficients
            else known.unit)
    if name == 'bandwidth':
        parameters = {name: _lag(float(values[0]), float(half[0]))}
    else:
        size = float(values[0]) if len(values) == 1 else float(np.hypot(*values))
        within = half[0] if len(values) == 1 else float(np.hypot(*(values * half))) / size
        parameters = {name: Estimate.about(size, float(within), unit)}
    for parameter, value in zip(() if effect is None else effect.shapes, each.column.shapes):
        if parameter.default is None and parameter.name not in parameters:
            parameters[parameter.name] = Estimate.about(value, 0.0, parameter.unit)
    shown = finding(
        name, parameters, each.p_value, [other for other in each.probability if other != name],
        minimum_detectable=(SEEN * float(half[0]) / NORMAL_95
                            if len(values) == 1 and name != 'bandwidth' else None),
        evidence=f'it adds {each.predicted:.1f} to the log-likelihood of held-out stretches, and '
        f'is selected in {100.0 * each.chosen:.0f} % of the folds',
        probability=each.probability,
        where=(each.column.shapes[0], float(done.spans.time[-1])) if each.column.once else None)
    return shown if each.established else as_suspected(shown)


def _lag(square: float, half: float) -> Estimate:
    """Return a time constant from half of its square."""
    low, size, high = (math.sqrt(2.0 * max(each, 0.0))
                       for each in (square - half, square, square + half))
    return Estimate(size, (low, high), 's')


def _extended(model: GyroModel | None, inside: SpanFit, log: Log,
              late: Finding | None) -> GyroModel:
    """Return the extended model of a fit, with a delay of the gyro."""
    after = _model(model or GyroModel(), inside, log)
    if model is not None and model.prior is not None:
        # the values of this unit replace those of its type
        after = replace(after, tolerance=Tolerance(), origin=origins_before(model))
    if late is None:
        return after
    size = late.parameters['time_offset']
    return with_terms(after, [Term(CATALOGUE['time_offset'], (size.estimate,))],
                      np.array([[size.deviation ** 2]]), [np.array(after.rate_range)], [])


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
    """Return the noise of the gyro; bias wander that the log does not show is 0."""
    # at the edge of the grid nothing bounds it from below
    return Noise(done.size('angle_random_walk'), **{
        part.name: done.size(part.name)
        if done.fit.sizes[part.name][1] > 1.01 * part.range[0] else 0.0
        for part in shared_noise(done.spans)})


# gain

def _contributions(done: SpanFit) -> dict[str, Array]:
    """Return contributions of causes to the change of heading over spans, and residual, rad."""
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
    # under the noise of the plain fit, given the prior of the wandering bias
    noisy = whitened(plain, ())
    prior = len(noisy.observed) - len(spans.observed)
    models = {'given': (spans.plain()[:, 2:], noisy.plain[:, 2:]),
              'plain': (all_columns(spans, ()), noisy.plain),
              'extended': (all_columns(extended.spans, extended.causes),
                           whitened(extended, extended.causes, plain).plain)}
    squares: dict[str, list[tuple[float, float]]] = {name: [] for name in models}
    counts: list[tuple[int, int]] = []
    for part in range(parts):
        held = np.flatnonzero(number == part)
        # whitened observations across the borders of the part are left out
        kept = np.setdiff1d(np.arange(len(spans.observed)), [*held, *(held + 1), *(held - 1)])
        if len(held) < 4 or len(kept) < 8:
            return None
        rows = np.append(kept, len(spans.observed) + np.arange(prior))
        for name, (columns, white) in models.items():
            values = np.linalg.lstsq(white[rows], noisy.observed[rows], rcond=None)[0]
            left = (spans.observed - columns @ values[:columns.shape[1]])[:count][held]
            stamps = time[held[0]:held[-1] + 2]
            turned = over_windows(left, stamps, window)
            squares[name].append((float(np.sum((left / np.diff(stamps)) ** 2)),
                                  float(np.sum(turned ** 2))))
        counts.append((len(left), len(turned)))
    return gain_of(f'each of {parts} parts of the log in turn, the others being fitted', squares,
                   counts, 'given', window) if np.all(counts) else None


# for people

def _cannot_show(plain: SpanFit) -> dict[str, str]:
    """Return the reason for each cause that was not searched for."""
    seen = {each.cause for each in candidates(plain)} | _ALWAYS_SEEN
    missing = {channel for channel in ('temperature', 'specific_force', 'supply')
               if getattr(plain.spans.log, channel) is None}
    shown = {}
    for name, cause in CAUSES.items():
        lacks = sorted(missing & cause.needs)
        if name not in seen:
            shown[name] = (f'the logs have no {" and no ".join(lacks)}'.replace('_', ' ') if lacks
                           else 'fewer than three stretches turn, which do not distinguish it '
                           'from a scale factor error'
                           if plain.scale_held and _follows_the_rate(name)
                           else 'the errors of the reference hide it over short spans')
    return shown


def _remarks(reference: Reference, done: SpanFit, of_fleet: bool) -> Iterator[str]:
    if of_fleet:
        yield ('The model of the fleet is used as the prior of bias and scale factor error.')
    errors = (f'{done.size("reference") / DEGREE:.2g} deg from point to point, and '
              f'{1000.0 * done.size("motion"):.2g} ms times the rate'
              if done.spans.treatment.of_heading
              else f'white noise of {done.spans.noisier:.2g} times that of the gyro')
    yield (f'The reference is taken as {_SPOKEN[reference.kind]} ({reference.known}); if '
           f'it is another kind, state it with --reference-kind. Its errors: {errors}.')
    if done.scale_held:
        yield ('Fewer than three stretches with rotation determine the scale factor error, and it '
               f'is kept at 0 +- {100.0 * done.spans.treatment.prior[0]:g} %: turn more often, '
               'in both directions.')


def _pictures(done: SpanFit, parts: dict[str, Array]) -> tuple[Curve, Trace]:
    """Return the residual along the rate, and the measured and simulated rate over time."""
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


# the search

@dataclass(frozen=True)
class Confirmed:
    """
    A cause that the search found.

    Attributes
    ----------
    column : the cause
    p_value : of the best of all candidates in noise, cluster-robust
    predicted : gain in log-likelihood on held-out stretches
    chosen : share of the folds in which the same cause was selected
    established : whether it is confirmed
    probability : of the cause and of its alternatives, by name

    """

    column: Column
    p_value: float
    predicted: float
    chosen: float
    established: bool
    probability: dict[str, float]


def candidates(done: SpanFit) -> Iterator[Column]:
    """
    Give the causes that headings over spans can show, for the channels that the log has.

    Where the scale factor error is left at 0, every cause that follows the rate would take it up,
    so that none of these is a candidate.

    """
    return (each for each in _columns(done)
            if not (done.scale_held and _follows_the_rate(each.cause)))


def _follows_the_rate(cause: str) -> bool:
    """Tell whether a cause adds nothing to the heading where the gyro does not turn."""
    effect = CATALOGUE.get(cause)
    return (cause == 'reference_once_per_rev' if effect is None
            else 'rate' in effect.looks_at)


def _columns(done: SpanFit) -> Iterator[Column]:
    """Give the columns of all causes for the channels that the log has."""
    log, fine, time = done.spans.log, done.spans.fine, done.spans.time
    duration = float(time[-1] - time[0])
    for name in ('scale_factor_asymmetry', 'quadratic_nonlinearity', 'cubic_nonlinearity',
                 'rate_ramp', 'heading_sensitivity', 'reference_once_per_rev'):
        yield Column(name)
    if fine:
        yield Column('bandwidth', positive=True)
    for constant in np.geomspace(duration / 50.0, 0.7 * duration, 8 if fine else 5).tolist():
        yield Column('warm_up', (constant,))
    for moment in np.linspace(time[0], time[-1], 62 if fine else 22)[1:-1].tolist():
        yield Column('bias_step', (moment,), once=True)
        if not fine:
            yield Column('reference_slip', (moment,), once=True)
    if log.temperature is not None and np.ptp(log.temperature) > 0.2:
        middle = float(log.temperature.mean())
        for name in ('bias_temperature', 'bias_temperature_quadratic', 'scale_factor_temperature'):
            yield Column(name, (middle,))
        for filter_time in (3.0, 10.0):
            yield Column('bias_temperature_rate', (filter_time,))
        if fine:
            for constant in np.geomspace(5.0, min(duration, 3000.0), 6).tolist():
                yield Column('thermal_lag', (constant,))
            for filter_time, threshold in ((1.0, 2e-3), (3.0, 5e-4)):
                yield Column('thermal_hysteresis', (filter_time, threshold))
    if log.specific_force is not None and np.ptp(log.specific_force) > 0.0:
        yield Column('acceleration_sensitivity')
        yield Column('vibration_rectification', (1.0,))
    if log.supply is not None and np.ptp(log.supply) > 0.0:
        yield Column('supply_sensitivity', (5.0,))
    has = [name for name in LEAST_CHANGE if getattr(log, name) is not None]
    for name, shapes in added_effects(has, moves=True):
        yield Column(name, shapes)


def search(done: SpanFit, level: float, on_part: OnPart) -> tuple[SpanFit, list[Confirmed]]:
    """Add one cause after the other, each cross-fitted, and fit again with those established."""
    found: list[Confirmed] = []
    offered = list(candidates(done))
    # noise given one column of each cause, so that it does not absorb their contributions
    columns = {each.cause: each for each in offered if not each.once}
    rich = fit_spans(done.spans, list(columns.values()))
    while len(found) < MOST:
        taken = [each.column for each in found]
        names = {each.cause for each in taken}
        on_part(f'search for causes after {len(found)} found' if found else 'search for causes')
        best = _best(done, rich, [each for each in offered if each.cause not in names], taken,
                     level)
        if best is None:
            break
        found.append(best)
    found = [each for each in found if each.predicted > 0.0]
    extended = done
    while inside := [each.column for each in found if each.established]:
        extended = fit_spans(done.spans, inside)
        worst = max(inside, key=lambda each: _contradiction(extended, each))
        if _contradiction(extended, worst) < 1.0:
            return extended, found
        found = [replace(each, established=each.established and each.column != worst)
                 for each in found]
    return done, found


def _contradiction(done: SpanFit, cause: Column) -> float:
    """Return the ratio of an effect to the largest plausible one; inf if it may be 0."""
    places = done.places(cause)
    values = done.values[places]
    if len(values) == 1 and abs(values[0]) < done.half(places.start):
        return math.inf
    if CAUSES[cause.cause].along != 'rate' or cause.cause not in CATALOGUE:
        return 0.0
    columns = CATALOGUE[cause.cause].columns(done.spans.channels, *cause.shapes)
    added = np.abs(np.tensordot(values, np.array(columns), 1)).max()
    return float(added / np.abs(done.spans.channels.rate).max()) / _LARGEST


def _best(done: SpanFit, rich: SpanFit, open_ones: Sequence[Column], given: Sequence[Column],
          level: float) -> Confirmed | None:
    """Return the best of the remaining causes, given those found; None if insignificant."""
    # what a scale factor error that is kept at 0 would explain is no evidence of a cause
    data = whitened(replace(done, prior=np.array(done.spans.treatment.prior)), given, rich,
                    most=True)
    widths = [done.spans.columns(each) for each in open_ones]
    columns = data.columns(np.column_stack(widths))
    edges = np.concatenate([[0], np.cumsum([each.shape[1] for each in widths])])
    places = [slice(begin, end) for begin, end in zip(edges[:-1], edges[1:])]
    chances = _evidences(data, columns, places, open_ones, np.ones(len(data.observed), dtype=bool))
    # single events are never established, and are not counted in the number of the others
    lasting = sum(not each.once for each in open_ones)
    tried = [chance * (len(open_ones) if each.once else lasting)
             for each, (chance, _, _) in zip(open_ones, chances)]
    strongest = int(np.argmin(tried))
    once = open_ones[strongest].once
    if min(tried[strongest], 1.0) > (level if once else SUSPECTED * level):
        return None
    best_of: dict[str, int] = {}
    for other, each in enumerate(open_ones):
        if each.cause not in best_of or chances[other][1] > chances[best_of[each.cause]][1]:
            best_of[each.cause] = other
    gain = chances[strongest][1]
    alike = {name: other for name, other in best_of.items()
             if chances[other][1] > gain - math.log(_LIKELY) or other == strongest}
    # the simplest of the equivalent causes: with the fewest values and fitted shapes
    place = min(alike.values(), key=lambda other: (widths[other].shape[1] + sum(
        each.default is None for each in getattr(CATALOGUE.get(open_ones[other].cause), 'shapes',
                                                 ())), tried[other]))
    column, p_value, stretches = open_ones[place], min(tried[place], 1.0), chances[place][2]
    found = _cross_fitted(data, columns, places, open_ones, alike)
    # errors of a course are correlated over time, so that distant stretches must be predicted too
    surely, predicted, chosen = max(found) if done.spans.fine else min(found)
    probability = {name: chance for name, chance in probabilities(
        {name: gain - chances[other][1] for name, other in best_of.items()}).items()
        if name in alike}
    established = (p_value < level and surely > SURELY and chosen == 1.0 and not column.once
                   and stretches >= FEWEST_STRETCHES)
    return Confirmed(column, max(p_value, LEAST_PROBABILITY), predicted, chosen, established,
                     probability)


def _evidences(data: Whitened, columns: Array, places: Sequence[slice],
               open_ones: Sequence[Column], rows: Mask) -> list[tuple[float, float, float]]:
    """Return chance, gain in log-likelihood and effective stretches of each cause."""
    base, _ = np.linalg.qr(data.plain[rows])
    both = np.column_stack([columns, data.observed])[rows]
    both -= base @ (base.T @ both)
    clusters = [each[rows] for each in (data.stretch, *data.places)]
    sizes = np.sqrt(np.sum(columns[rows] ** 2, axis=0)) + 1e-300
    return [(1.0, 0.0, 0.0) if each.positive and float(both[:, place.start] @ both[:, -1]) <= 0.0
            else _evidence(both[:, place], both[:, -1], clusters if CAUSES[each.cause].along
                           in _OF_MOTION else clusters[:1], 1e-6 * sizes[place])
            for place, each in zip(places, open_ones)]


def _evidence(x: Array, left: Array, clusters: Sequence[NDArray[np.intp]],
              least: Array) -> tuple[float, float, float]:
    """Return chance, gain in log-likelihood and effective number by the worst clusters."""
    information = x.T @ x
    size = np.sqrt(np.diag(information))
    if not (size > least).all():
        return 1.0, 0.0, 0.0
    # by the residual with the candidate: scores that contain the effect would overestimate scatter
    off = left - x @ np.linalg.lstsq(x, left, rcond=None)[0]
    count, found = x.shape[1], []
    root = np.linalg.inv(np.linalg.cholesky(information + 1e-12 * np.diag(size**2)))
    square = float(np.sum((root @ x.T @ left) ** 2))
    for cluster in clusters:
        scores = np.array([np.bincount(cluster, part * off) for part in x.T])
        shares = np.bincount(cluster, np.sum((x / size) ** 2, axis=1))
        effective = float(shares.sum() ** 2 / (shares ** 2).sum())
        scatter = scores @ scores.T * effective / max(effective - 1.0 - count, 0.5)
        more = float(np.linalg.eigvalsh(root @ scatter @ root.T).max())
        statistic, freedom = square / max(more, 1.0), max(effective - count, 1.0)
        found.append((float(fisher.sf(statistic / count, count, freedom)), 0.5 * statistic,
                      effective))
    return max(found)


def _cross_fitted(data: Whitened, columns: Array, places: Sequence[slice],
                  open_ones: Sequence[Column],
                  alike: Mapping[str, int]) -> list[tuple[float, float, float]]:
    """
    Select and fit without each fold, and predict it.

    Returns
    -------
    for folds of every fifth stretch, and for fifths of the log (in the first, slow causes are also
    predicted by the bias wander of neighbouring stretches): gain in log-likelihood over its
    standard deviation by the scatter of stretches, the gain, and the share of the folds in which
    one of the equivalent causes was selected

    """
    numbers = np.arange(data.of_log)
    folds = min(FOLDS, len(numbers))
    found = []
    for sets in ([numbers[fold::folds] for fold in range(folds)], np.array_split(numbers, folds)):
        won: list[float] = []
        same = 0
        for fold in sets:
            held = np.isin(data.stretch, fold)
            rest = ~held
            gains = [gain for _, gain, _ in _evidences(data, columns, places, open_ones, rest)]
            best = int(np.argmax(gains))
            same += open_ones[best].cause in alike
            off = []
            for design in (data.plain, np.column_stack([data.plain, columns[:, places[best]]])):
                values = np.linalg.lstsq(design[rest], data.observed[rest], rcond=None)[0]
                off.append(data.observed[held] - design[held] @ values)
            won += np.bincount(np.searchsorted(fold, data.stretch[held]),
                               0.5 * (off[0] ** 2 - off[1] ** 2)).tolist()
        found.append((sureness(np.array(won)), float(np.sum(won)), same / folds))
    return found
