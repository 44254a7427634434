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
is that of a single one times their number. A cause is established if it is also selected without
each fold, and predicts the stretches of the folds better than no cause; otherwise it is suspected.
Steps of the bias are searched for at all times.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
import math
from typing import NamedTuple

from gyro_calibration.calibration.heading_regression import (
    effective_clusters, fit_spans, MIN_STRETCHES, SpanFit, whiten_regression, WhitenedRegression)
from gyro_calibration.calibration.likelihood import MISALIGNMENT_REMEDY, oblique_angle
from gyro_calibration.calibration.reference_noise import MAX_GYRO_LAG, OwnInstants
from gyro_calibration.calibration.spans import (
    BASE_VALUES, CauseTerm, design_matrix, HEADING_TREATMENT, lay_out_spans, MISALIGNMENT_TERM,
    Spans)
from gyro_calibration.diagnosis.candidates import (
    lasting_shapes, MAX_STEP_TIME_LACK, MIN_CHANNEL_RANGE, observed_range)
from gyro_calibration.diagnosis.causes import (
    Cause, cause_finding, cause_parameters, CAUSES, SINGLE_EVENT_REMEDY, sized_finding,
    untestable_causes, value_finding)
from gyro_calibration.diagnosis.data_quality import inspect_record
from gyro_calibration.diagnosis.extended_model import (
    add_terms, gain_from_errors, heading_curve, heading_error_shares, HEADING_WINDOW,
    MAX_WINDOW_SHARE, previous_origins, window_changes)
from gyro_calibration.diagnosis.findings import (
    Curve, Diagnosis, Estimate, Finding, Gain, MIN_PROBABILITY, OnProgress, Reference,
    TIME_LIMIT_REMARK)
from gyro_calibration.diagnosis.search import MAX_CAUSES
from gyro_calibration.diagnosis.significance import (
    detectable_sigmas, MIN_PREDICTION_SIGMAS, prediction_sigmas, RULED_OUT_DEFICIT,
    SEARCH_ALARM_SHARE, SUSPECTED_RATE_FACTOR, VALUE_ALARM_SHARE)
from gyro_calibration.heading.log_compensation import compensate_log
from gyro_calibration.logs.log import Array, DEGREE, Log, Mask, NORMAL_QUANTILE_975
from gyro_calibration.model.effects import BIAS, CATALOGUE, SCALE_FACTOR_ERROR, SINE_RESPONSE
from gyro_calibration.model.gyro_model import GyroModel, Term, Tolerance
from gyro_calibration.model.noise import Noise
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq, minimize_scalar
from scipy.special import softmax
from scipy.stats import f as fisher
from scipy.stats import t as student

#: Kinds of references that are sampled with the gyro, by one clock.
_SAME_CLOCK = ('rate_command', 'encoder')
_REFERENCE_PHRASES = {
    'rate_command': 'a reference rate with noise',
    'course': 'a course over ground',
    'encoder': 'an encoder',
    'odometry': 'odometry',
    'motion_capture': 'motion capture',
    'gyro': 'another gyro'}
_METHOD_TEXT = (
    'The heading by {} was compared with the integral of the output over spans of a second or '
    'more, under noise of gyro and reference that was found together with the causes. A cause is '
    'established if its evidence holds beyond the scatter between stretches, and if choice and '
    'fit on some stretches predict the others; else it is suspected. Only established causes are '
    'in the model. Intervals are of 95 %.')
#: Causes that are not candidates, because they are tested in each log.
_ALWAYS_TESTED = {*BASE_VALUES, 'bias_step', 'outliers', 'stuck_samples', 'dropped_samples',
                  'unit_error', 'quantization', 'saturation'}
#: Correlation of the columns of two steps of the bias above which spans do not distinguish them.
_MAX_ALIKENESS = 0.999


def diagnose_by_noisy_reference(log: Log, reference: Reference, model: GyroModel | None,
                                false_alarm_rate: float, on_progress: OnProgress,
                                instants: OwnInstants | None = None) -> Diagnosis:
    """
    Diagnose a log with a reference whose errors are larger than those of the gyro.

    The instants are those of a slow reference, by `keep_own_instants`.
    """
    on_progress(None, 'data quality')
    record = inspect_record(replace(log, reference_heading=None, reference_rate=None))
    assert log.output is not None
    cleaned_log = replace(log, output=np.where(record.usable, log.output, np.nan))
    prior = None if model is None else model.prior_deviations
    on_progress(None, 'bias and scale factor error')
    if model is not None:
        cleaned_log = replace(cleaned_log, output=compensate_log(model, cleaned_log))
    plain = fit_spans(lay_out_spans(cleaned_log, reference.kind, prior, instants))
    extended, found = select_causes(plain, SEARCH_ALARM_SHARE * false_alarm_rate,
                                    on_progress)
    time_is_up = on_progress(None, 'cross-validation')
    events = [each for each in extended.causes if each.is_single_event]
    lasting_terms = [each for each in extended.causes if not each.is_single_event]
    lasting = (extended if not events else plain if not lasting_terms
               else fit_spans(plain.spans, lasting_terms))
    gain = None if time_is_up else _cross_validated_gain(plain, lasting)
    model_fit = lasting
    if gain is not None and extended.causes and gain.models['extended'] > gain.models['plain']:
        # causes that do not improve the prediction are not added to the model
        model_fit = plain
        if not plain.spans.treatment.is_fine:
            found = [replace(each, is_established=each.is_established
                             and each.cause_term.is_single_event) for each in found]
            extended = fit_spans(plain.spans, events) if events else plain
        gain = _cross_validated_gain(plain, plain)
    on_progress(None, 'findings')
    parts, time = _heading_contributions(extended), extended.spans.time
    noise = {name: extended.noise_size(name) for name in ('reference', 'motion')}
    rates = extended.spans.point_means(np.asarray(extended.spans.channels.rate))
    motion_variance = noise['motion'] ** 2 * float(np.mean(rates ** 2))
    of_heading = heading_error_shares([(parts, time)],
                                      2.0 * (noise['reference'] ** 2 + motion_variance))
    findings = [*_value_findings(extended, model, false_alarm_rate, reference),
                *_reference_findings(extended, false_alarm_rate), *record.findings,
                *(each for cause in found for each in [_cause_finding(
                    cause, extended, VALUE_ALARM_SHARE * false_alarm_rate)]
                  if not each.parameters[each.effect].contains_zero)]
    of_record = {each.effect for each in record.findings}
    # between two clocks neither a delay nor a clock rate is a property of the gyro
    of_clocks = set() if reference.kind in _SAME_CLOCK else {'time_offset', 'clock_rate'}
    findings = [replace(each, remedy='synchronize the clocks of gyro and reference; the model '
                                     'does not contain it')
                if each.effect in of_clocks and each.status == 'established' else each
                for each in findings]
    changed = any(each.status == 'established' and CAUSES[each.effect].origin == 'gyro'
                  and each.effect not in {'time_offset', 'bias_step', *of_record, *of_clocks}
                  for each in findings)
    clock_delay = next((each for each in findings if each.effect == 'time_offset'
                        and each.status == 'established' and not of_clocks), None)
    rejected = gain is not None and gain.is_worse
    before = (model if model is not None else GyroModel() if rejected
              else _model_with_fit(GyroModel(), plain, log))
    after = (before if rejected or not (changed or clock_delay or model is None
                                        or prior is not None)
             else _extend_model(model, model_fit, log, clock_delay, of_clocks))
    curve, trace = _rate_curve_and_trace(extended, parts)
    return Diagnosis(tuple(findings), (), _gyro_noise(extended),
                     Noise() if model is None else model.noise,
                     None if not changed and model is not None else gain, before, after,
                     _untestable_causes(plain), [curve], heading_curve(parts, time), None,
                     (*record.remarks, *_remarks(reference, extended, prior is not None),
                      *[TIME_LIMIT_REMARK] * bool(time_is_up)),
                     false_alarm_rate, trace=trace,
                     method=_METHOD_TEXT.format(_REFERENCE_PHRASES[reference.kind]),
                     reference=replace(reference, noise=noise), heading_shares=of_heading)


# values

def _value_findings(fit: SpanFit, model: GyroModel | None, false_alarm_rate: float,
                    reference: Reference) -> Iterator[Finding]:
    """Give delay, and with a model bias and scale factor error, if they are established."""
    own_clock = reference.kind not in _SAME_CLOCK
    for place, name in enumerate(BASE_VALUES):
        effective = float(fit.effective_stretches[place])
        if name != 'time_offset' and model is None or effective < MIN_STRETCHES:
            continue
        value, variance = float(fit.values[place]), float(fit.covariance[place, place])
        if name == 'bias' and model is not None:
            # the mean bias of a log differs from that of the model by bias wander; beside a
            # course, the variance contains that of the log
            duration = float(fit.spans.time[-1] - fit.spans.time[0])
            shown = [_gyro_noise(fit)] if fit.spans.treatment.is_fine else []
            variance += max(2.0 / math.pi * each.bias_instability ** 2
                            + each.rate_random_walk ** 2 * duration / 3.0
                            for each in (*shown, model.noise))
        known, confounders = {}, ['reference_scale'] if name == 'scale_factor_error' else []
        # a delay between two clocks is usual
        level, is_usual = VALUE_ALARM_SHARE * false_alarm_rate, name == 'time_offset' and own_clock
        if name == 'time_offset':
            of_gyro = 0.0 < value < MAX_GYRO_LAG
            confounders = [other for other, might in (('bandwidth', of_gyro), ('clock_rate', True))
                           if might and _is_possible_instead(fit, other)]
            if own_clock and not of_gyro:
                known['cause'] = 'The gyro has a time offset from its reference.'
        if found := value_finding(name, value, math.sqrt(variance),
                                  false_alarm_rate if is_usual else level, confounders,
                                  float(fit.freedom[place]),
                                  NORMAL_QUANTILE_975 * fit.spans.treatment.prior[place],
                                  evidence=f'evidence from {effective:.0f} stretches', **known):
            yield found


def _reference_findings(fit: SpanFit, false_alarm_rate: float) -> Iterator[Finding]:
    """Give the misalignment, and the drift of a reference against the rests in which it stands."""
    if MISALIGNMENT_TERM in fit.causes:
        name, places = MISALIGNMENT_TERM.cause, fit.value_slice(MISALIGNMENT_TERM)
        angle, half, chance = oblique_angle(fit.values[places], fit.normal_covariance[
            places, places])
        if chance < false_alarm_rate:
            yield sized_finding(name, angle, half, max(chance, MIN_PROBABILITY),
                                remedy=MISALIGNMENT_REMEDY)
    name = 'reference_drift'
    if CauseTerm(name) not in fit.causes:
        return
    asymmetry = CauseTerm('scale_factor_asymmetry')
    if asymmetry not in fit.causes:  # it is in motion only, too
        fit = fit_spans(fit.spans, [*fit.causes, asymmetry])
    place = fit.value_slice(CauseTerm(name)).start
    if found := value_finding(
            name, float(fit.values[place]), math.sqrt(fit.covariance[place, place]),
            false_alarm_rate, ['vibration_rectification'], float(fit.freedom[place]),
            evidence=f'against {fit.spans.stands.sum()} rests, which determine the bias'):
        yield found


def _is_possible_instead(fit: SpanFit, cause: str) -> bool:
    """Tell whether a lag, or a clock rate, explains a log as well as the delay, to three sigma."""
    if CauseTerm(cause) in fit.causes:
        return False
    if cause == 'bandwidth' and not fit.spans.treatment.is_fine:
        return True
    data = whiten_regression(fit, (*fit.causes, CauseTerm(cause)))
    inverse = np.linalg.pinv(data.design)
    values, delay = inverse @ data.observed, float(fit.values[2])
    # the square of a lag; and the delay that a clock rate leaves
    place, left = ((len(fit.values), 0.5 * delay ** 2) if cause == 'bandwidth'
                   else (2, -fit.spans.delay))
    return bool(abs(values[place] - left) < 3.0 * np.linalg.norm(inverse[place]))


def _cause_finding(found: FoundCause, extended: SpanFit, level: float) -> Finding:
    """Return a cause that the search found, with its values given the established ones."""
    term, spans = found.cause_term, extended.spans
    fit = (extended if found.is_established
           else fit_spans(spans, [*extended.causes, term]))
    places, effect, shapes = fit.value_slice(term), CATALOGUE.get(term.cause), {}
    values, covariance = fit.values[places], fit.normal_covariance[places, places]
    evidence = {'evidence': f'it adds {found.prediction_gain:.1f} to the log-likelihood of '
                'held-out stretches, and is selected in '
                f'{100.0 * found.selection_share:.0f} % of the folds'}
    if term.is_single_event:
        evidence = {}
    if term.cause == SINE_RESPONSE.name:
        size, slope = _shape_of_sine(term, float(values[0]))
        shapes['k'] = Estimate.from_half_width(size, slope * fit.half_width(places.start), 's')
        values, covariance = values[1:], covariance[1:, 1:]
    elif term.cause == 'bias_step':
        by_time, shapes['step_time'] = _step_time(fit, term)
        covariance = covariance + by_time
    elif found.shape_interval is not None and effect is not None:
        shape, = effect.nonlinear_parameters
        shapes[shape.name] = Estimate(term.shapes[0], found.shape_interval, shape.unit)
    log = spans.log
    return cause_finding(
        term.cause, cause_parameters(term.cause, values, covariance, shapes), found.p_value,
        found.deficits, found.is_established, observed_range(
            [np.asarray(spans.channels.rate)], [each for each in [log.temperature]
                                                if each is not None], float(spans.time[-1])),
        detectable_sigmas(level), **evidence,
        where=(term.shapes[0], float(spans.time[-1])) if term.is_single_event else None,
        remedy=SINGLE_EVENT_REMEDY if term.is_single_event else '')


def _step_time(fit: SpanFit, term: CauseTerm) -> tuple[float, Estimate]:
    """Return the variance of the size of a step by its time, and that time."""
    place = fit.value_slice(term).start
    inflation = float(fit.covariance[place, place] / fit.fit.covariance[place, place])
    data = whiten_regression(fit, [each for each in fit.causes if each != term])
    times = fit.spans.time[2:-2]
    times = times[::max(len(times) // 200, 1)]
    for _ in range(2):
        times = np.unique(np.append(times, term.shapes))
        gains, sizes = _step_gains(fit, data, times)
        index = int(np.searchsorted(times, term.shapes[0]))
        lack = (gains[index] - gains) / inflation
        # the times around that of the step, and then between its neighbours
        outside = np.flatnonzero(lack > MAX_STEP_TIME_LACK)
        after = np.searchsorted(outside, index)
        first = outside[after - 1] if after > 0 else 0
        last = outside[after] if after < len(outside) else len(times) - 1
        interval = float(times[first]), float(times[last])
        inside = slice(first, last + 1)
        weights = softmax(-lack[inside])
        variance = float(weights @ (sizes[inside] - weights @ sizes[inside]) ** 2)
        times = np.linspace(*interval, 100)
    return variance, Estimate(term.shapes[0], interval, 's')


def _shape_of_sine(term: CauseTerm, amplitude: float) -> tuple[float, float]:
    """
    Return the k of a sine response of amplitude 1, and its derivative by the fitted amplitude.

    The effect, ``sin(k w) / k - w``, is proportional to k² to first order.
    """
    root = math.sqrt(max(amplitude, 0.0))
    return term.shapes[0] * root, 0.5 * term.shapes[0] / max(root, 1e-3)


def _extend_model(model: GyroModel | None, fit: SpanFit, log: Log,
                  delay_finding: Finding | None, left_out: Collection[str]) -> GyroModel:
    """Return the extended model of a fit, with a delay of the gyro, without some causes."""
    after = _model_with_fit(model or GyroModel(), fit, log, left_out)
    if model is not None and model.prior_deviations is not None:
        # the values of this unit replace those of its type
        after = replace(after, tolerance=Tolerance(), origin=previous_origins(model))
    if delay_finding is None:
        return after
    size = delay_finding.parameters['time_offset']
    return add_terms(after, [Term(CATALOGUE['time_offset'], (size.estimate,))], [0],
                     np.array([[size.deviation ** 2]]), [np.array(after.rate_range)], [])


def _model_with_fit(base_model: GyroModel, fit: SpanFit, log: Log,
                    left_out: Collection[str] = ()) -> GyroModel:
    """Return a model with scale factor error, bias, and the causes of the gyro that are fitted."""
    own = 1.0 + sum(
        term.values[0] for term in base_model.terms if term.effect is SCALE_FACTOR_ERROR)
    scale, bias = (own * float(value) for value in fit.values[:2])
    terms, indices = [Term(BIAS, (bias,)), Term(SCALE_FACTOR_ERROR, (scale,))], [1, 0]
    slopes = np.ones(len(fit.values))
    for cause in fit.causes:
        if cause.cause in CATALOGUE.keys() - {*left_out}:
            places = fit.value_slice(cause)
            shapes, values = cause.shapes, fit.values[places].tolist()
            of_term = [*(-1 for _ in shapes), *range(places.start, places.stop)]
            if cause.cause == SINE_RESPONSE.name:
                # the shape instead of the amplitude
                shape, slopes[places] = _shape_of_sine(cause, values[0])
                shapes, values, of_term = (shape,), [1.0], [places.start, -1]
            terms.append(Term(CATALOGUE[cause.cause], (*shapes, *values)))
            indices += of_term
    assert log.output is not None
    new = add_terms(base_model, terms, indices, fit.normal_covariance * np.outer(slopes, slopes),
                    [log.output[np.isfinite(log.output)]],
                    [] if log.temperature is None else [log.temperature])
    return new if base_model.noise.angle_random_walk else replace(new, noise=_gyro_noise(fit))


def _gyro_noise(fit: SpanFit) -> Noise:
    """Return the noise of the gyro; bias wander that the log does not show is 0."""
    # at the edge of the grid nothing bounds it from below
    return Noise(fit.noise_size('angle_random_walk'),
                 **{part.name: fit.noise_size(part.name)
                    if fit.fit.sizes[part.name][1] > 1.01 * part.size_range[0] else 0.0
                    for part in fit.spans.bias_wander()[1]
                    if part.name in vars(Noise())})


# gain

def _heading_contributions(fit: SpanFit) -> dict[str, Array]:
    """Return contributions of causes to the change of heading over spans, and residual, rad."""
    values = fit.values - fit.spans.correction(fit.causes, len(fit.values))
    columns = design_matrix(fit.spans, fit.causes) * values
    found = {name: columns[:, place]
             for place, name in enumerate(BASE_VALUES) if name != 'time_offset'}
    for cause in fit.causes:
        if cause.cause != 'clock_rate':
            found[cause.cause] = found.get(cause.cause, 0.0) + columns[
                :, fit.value_slice(cause)].sum(axis=1)
    found['left'] = fit.spans.observed - columns.sum(axis=1)
    return {name: part[:len(fit.spans.time) - 1] for name, part in found.items()}


def _cross_validated_gain(plain: SpanFit, extended: SpanFit) -> Gain | None:
    """Hold out each part of a log in turn, fit the others, and predict heading and rate there."""
    time, spans = plain.spans.time, plain.spans
    duration = float(time[-1] - time[0])
    parts = int(np.clip(duration / 80.0, 2, 6))
    number = np.minimum(((time[1:] - time[0]) * parts / duration).astype(int), parts - 1)
    window = min(HEADING_WINDOW, MAX_WINDOW_SHARE * duration / parts)
    # under the noise of the plain fit, given the prior of the wandering bias
    noisy = whiten_regression(plain, ())
    prior = len(noisy.observed) - len(spans.observed)
    # a misalignment is of no model
    given = slice(2, 3 + spans.cross_rotation.shape[1])
    models = {'given': (design_matrix(spans, ())[:, given], noisy.design[:, 2:]),
              'plain': (design_matrix(spans, ()), noisy.design),
              'extended': (design_matrix(extended.spans, extended.causes),
                           whiten_regression(extended, extended.causes, plain).design)}
    errors = []
    for part in range(parts):
        held = np.flatnonzero(number == part)
        # whitened observations across the borders of the part are left out
        kept = np.setdiff1d(np.arange(len(spans.observed)), [*held, *(held + 1), *(held - 1)])
        if len(held) < 4 or len(kept) < 8:
            return None
        rows = np.append(kept, len(spans.observed) + np.arange(prior))
        stamps, of_part = time[held[0]:held[-1] + 2], {}
        for name, (columns, white) in models.items():
            values = np.linalg.lstsq(white[rows], noisy.observed[rows], rcond=None)[0]
            left = (spans.observed - columns @ values[:columns.shape[1]])[held]
            of_part[name] = left / np.diff(stamps), window_changes(left, stamps, window)
        if not len(of_part['given'][1]):
            return None
        errors.append(of_part)
    return gain_from_errors(f'each of {parts} parts of the log in turn, the others being fitted',
                            errors, 'given', window)


# for people

def _untestable_causes(plain: SpanFit) -> dict[str, str]:
    """Return the reason for each cause that was not searched for."""
    def reason(cause: Cause) -> str:
        if plain.lacks_turns and _follows_the_rate(cause.name):
            return ('fewer than three stretches turn, which do not distinguish it from a scale '
                    'factor error')
        return {'axis_misalignment': 'the reference is planar',
                'reference_drift': 'the reference is known in no rest',
                'reference_once_per_rev': 'a course over ground has no shaft'}.get(
                    cause.name, 'the errors of the reference hide it over short spans')

    seen = {each.cause for each in (*_propose_terms(plain), *plain.causes)}
    return untestable_causes(seen | _ALWAYS_TESTED, [
        channel for channel in MIN_CHANNEL_RANGE if getattr(plain.spans.log, channel) is None],
        reason)


def _remarks(reference: Reference, done: SpanFit, is_fleet_model: bool) -> Iterator[str]:
    if is_fleet_model:
        yield ('The model of the fleet is used as the prior of bias and scale factor error.')
    errors = (f'{done.noise_size("reference") / DEGREE:.2g} deg from point to point, and '
              f'{1000.0 * done.noise_size("motion"):.2g} ms times the rate'
              if done.spans.treatment.errs_as_heading
              else f'white noise of {done.spans.reference_noise_ratio:.2g} times that of the gyro')
    yield (f'The reference is taken as {_REFERENCE_PHRASES[reference.kind]} '
           f'({reference.evidence}); if it is another kind, state it with --reference-kind. Its '
           f'errors: {errors}.')
    if done.lacks_turns:
        yield ('Fewer than three stretches of '
               f'{done.spans.treatment.stretch_duration:g} s have most of the rotation, and '
               'determine the scale factor error, whose interval of 95 % is +- '
               f'{100.0 * done.half_width(0):.2g} %: turn more often, in both directions.')


def _rate_curve_and_trace(fit: SpanFit, parts: dict[str, Array]) -> tuple[Curve, Curve]:
    """Return the residual along the rate, and the measured and simulated rate over time."""
    steps, time = np.diff(fit.spans.time), fit.spans.time
    assert fit.spans.log.output is not None
    measured = fit.spans.span_integrals(fit.spans.log.output)[:len(steps)] / steps
    before, after = (-each / steps
                     for each in (sum(parts.values(), 0.0 * parts['left']), parts['left']))
    order = np.array_split(np.argsort(measured, kind='stable'), min(20, len(steps) // 4 + 1))
    at, given, left = (np.array([float(each[part].mean()) for part in order])
                       for each in (measured, before, after))
    deviation = np.array([float(after[part].std()) / math.sqrt(len(part)) for part in order])
    return (Curve('rate', 'rad/s', at, given, left, deviation, np.zeros(len(order))),
            Curve('time', 's', time[:-1] + 0.5 * steps, before, after,
                  simulated=measured - before))


# the search

class Evidence(NamedTuple):
    """Evidence for a term."""

    chance: float  # p-value of it alone
    gain: float  # in log-likelihood
    stretches: float  # effective number of stretches
    # variance by the scatter of the stretches relative to that by the noise, at least 1
    variance_ratio: float


@dataclass(frozen=True)
class FoundCause:
    """A cause that the search found."""

    cause_term: CauseTerm  # the cause
    p_value: float  # of the best of all candidates in noise, cluster-robust
    prediction_gain: float  # gain in log-likelihood on held-out stretches
    selection_share: float  # share of the folds in which the same cause was selected
    is_established: bool  # whether it is confirmed
    # what it and its alternatives lack in log-likelihood, the best first
    deficits: Mapping[str, float]
    shape_interval: tuple[float, float] | None = None  # of 95 %; None if no shape was fitted


def _propose_terms(fit: SpanFit) -> list[CauseTerm]:
    """
    Return the causes that headings over spans can show, for the channels that the log has.

    Where too few stretches turn, none that follows the rate can be told from the scale factor
    error.
    """
    log, fine, time = fit.spans.log, fit.spans.treatment.is_fine, fit.spans.time
    has = {name for name, least in MIN_CHANNEL_RANGE.items()
           if getattr(log, name) is not None and np.ptp(getattr(log, name)) > least}
    terms = [CauseTerm(*each) for each in lasting_shapes(
        has, float(time[-1] - time[0]), np.asarray(fit.spans.channels.temperature))]
    fastest = float(np.abs(fit.spans.channels.rate).max())
    terms += [CauseTerm('clock_rate'),
              *[CauseTerm(SINE_RESPONSE.name, (0.5 / fastest,))] * (fine and fastest > 0.0)]
    return [each for each in terms if (fine or each.cause != 'reference_once_per_rev')
            and not (fit.lacks_turns and _follows_the_rate(each.cause))]


def _follows_the_rate(cause: str) -> bool:
    """Tell whether a cause adds nothing to the heading where the gyro does not turn."""
    effect = CATALOGUE.get(cause)
    return (cause == 'clock_rate' or effect is not None
            and 'rate' in effect.inputs)


def select_causes(fit: SpanFit, false_alarm_rate: float,
                  on_progress: OnProgress) -> tuple[SpanFit, list[FoundCause]]:
    """Add one cause after the other, each cross-fitted, and fit again with those established."""
    fit_with = cache(lambda *causes: fit_spans(fit.spans, causes))
    steps = _find_steps(fit, fit_with, (), false_alarm_rate)
    found, candidates = list(steps), _propose_terms(fit)
    # noise given one column of each cause, so that it does not absorb their contributions
    columns = {each.cause: each for each in candidates if each.cause != SINE_RESPONSE.name}
    rich = [*columns.values(), *(each.cause_term for each in steps)]
    # of a log with fewer spans than columns, the noise is that without them
    rich_fit = (fit_with(*rich)
                if design_matrix(fit.spans, rich).shape[1] < len(fit.spans.time) - 1 else fit)
    while len(found) < MAX_CAUSES:
        found_terms = [each.cause_term for each in found]
        names = {each.cause for each in found_terms}
        if on_progress(None, f'search for causes, {len(found)} found'):
            break
        at = fit
        for _ in range(2):
            data = whiten_regression(at, found_terms, rich_fit, use_max_random_walk=True)
            remaining = [fitted for each in candidates if each.cause not in names
                         for fitted in _fit_shape(at.spans, data, each)]
            best = _find_best_cause(at.spans, data, remaining, false_alarm_rate)
            if best is None or 'rate' not in getattr(CATALOGUE.get(best.cause_term.cause),
                                                     'inputs', ()):
                break
            # once more, at the rate without this cause: similar ones differ in higher order
            at = fit_with(*found_terms, best.cause_term)
        if best is None:
            break
        found.append(best)
    found = [each for each in found if each.prediction_gain > 0.0]
    causes = [each for each in found if each not in steps]
    if causes:
        # a step may have been part of another cause, or have been hidden by it
        found = causes + _find_steps(fit, fit_with, [
            each.cause_term for each in causes if each.is_established], false_alarm_rate)
    while established := [each.cause_term for each in found if each.is_established]:
        extended = fit_with(*established)
        worst = max(established,
                    key=lambda each: _implausibility(extended, each, false_alarm_rate))
        if _implausibility(extended, worst, false_alarm_rate) < 1.0:
            return extended, found
        found = [replace(each, is_established=each.is_established and each.cause_term != worst)
                 for each in found]
    return fit, found


def _fit_shape(spans: Spans, data: WhitenedRegression, term: CauseTerm) -> list[CauseTerm]:
    """Return a term, that of a sine response with the k for the amplitude 1; none without one."""
    if term.cause != SINE_RESPONSE.name:
        return [term]
    # beyond a quarter of a wave the output would fall while the rate increases
    largest = 0.5 * math.pi / float(np.abs(spans.channels.rate).max())
    for _ in range(20):  # each of which multiplies its error
        column, left = _given_design(data, data.whiten_columns(spans.cause_columns(term)))
        square = float(np.sum(column ** 2))
        amplitude = float(left @ column[:, 0]) / square if square > 0.0 else 0.0
        shape = _shape_of_sine(term, amplitude)[0]
        if not SINE_RESPONSE.parameters[0].bounds[0] < shape < largest:
            break
        term = CauseTerm(term.cause, (shape,))
        if abs(amplitude - 1.0) < 1e-3:
            return [term]
    return []


def _find_steps(fit: SpanFit, fit_with: Callable[..., SpanFit], causes: Sequence[CauseTerm],
                false_alarm_rate: float) -> list[FoundCause]:
    """
    Return the steps of the bias given some causes, at most three.

    A step is tried at each point, and around the best of them; first also two at once. The noise
    is fitted again with the steps, so that a random walk that they had caused does not hide them,
    and one that the log has is not a step. Of three steps those that are not significant are
    removed, the weakest first. A step beside a fine reference that too few stretches show is
    suspected.
    """
    times = fit.spans.time[2:-2]
    every = max(len(times) // 200, 1)
    likely = math.log(2.0 * len(times))
    steps: list[CauseTerm] = []

    def given_noise(others: Sequence[CauseTerm]) -> WhitenedRegression:
        """Return the regression on causes and other steps, under the noise with them."""
        with_steps = fit_with(*causes, *others) if causes or others else fit
        return whiten_regression(with_steps, with_steps.causes)

    def refined(data: WhitenedRegression, place: int) -> tuple[CauseTerm, float]:
        """Return the best step around one of the times, and its gain."""
        # in a gap between two points, such as a rest of an encoder, the time matters too
        begin, end = max(place - every, 0), min(place + every, len(times) - 1)
        near = np.linspace(times[begin], times[end], 20 * (end - begin) + 1)
        gains = _step_gains(fit, data, near)[0]
        return CauseTerm('bias_step', (float(near[gains.argmax()]),)), float(gains.max())

    while len(steps) < 3:
        data = given_noise(steps)
        step, gain = refined(data, every * int(np.argmax(
            _step_gains(fit, data, times[::every])[0])))
        by_two, pair = (gain, (0, 0)) if steps else _best_pair(fit, data, times[::every])
        # one is tried in any case beside a fine reference: a random walk may have hidden it
        if max(gain, by_two - likely) < likely - math.log(false_alarm_rate) and (
                steps or not fit.spans.treatment.is_fine):
            break
        if gain >= by_two - likely:
            steps.append(step)
            continue
        # one step explains little of a bias that differs in a part of a log
        steps = [CauseTerm('bias_step', (float(times[every * place]),)) for place in pair]
        for number, place in enumerate(pair):
            steps[number] = refined(given_noise([steps[1 - number]]), every * place)[0]
    while steps:
        with_steps = fit_with(*causes, *steps)
        places = [with_steps.value_slice(each).start for each in steps]
        deviations = np.sqrt(np.diag(with_steps.covariance)[places])
        sigmas = np.abs(with_steps.values[places]) / deviations
        # given the other steps, a step between them rests on the stretches there
        data = whiten_regression(with_steps, with_steps.causes)
        influence = data.design @ np.linalg.pinv(data.design.T @ data.design)[:, places]
        inside = data.clusters[0] < data.stretch_count
        stretches = effective_clusters(data.clusters[0][inside], influence[inside])
        chances = 2.0 * student.sf(sigmas, np.maximum(stretches - 1.0, 1.0))
        if fit.spans.treatment.is_fine:
            # at the best of all times, beside the noise without the step
            evidence = np.array([_step_evidence(with_steps, fit_with(
                *causes, *(other for other in steps if other != each)), each) for each in steps])
            chances = np.maximum(data.stretch_count * chances, 2.0 * len(times) * np.exp(
                -np.maximum(evidence, 0.0)))
            most = SUSPECTED_RATE_FACTOR * false_alarm_rate
        else:
            chances = np.where(stretches < MIN_STRETCHES, 1.0, 2.0 * len(times) * chances)
            most = false_alarm_rate
        weakest = int(chances.argmax())
        if chances[weakest] < most:
            return [FoundCause(each, chance, 0.5 * size ** 2, 1.0,
                               chance < false_alarm_rate and count >= MIN_STRETCHES, {})
                    for each, chance, size, count in zip(
                        steps, chances.tolist(), sigmas.tolist(), stretches.tolist())]
        del steps[weakest]
    return []


def _step_evidence(fit: SpanFit, without: SpanFit, step: CauseTerm) -> float:
    """Return the gain in log-likelihood by a step, averaged over the noises of each fit."""
    place = fit.value_slice(step).start
    return (fit.fit.log_evidence - without.fit.log_evidence
            - 0.5 * math.log(fit.fit.covariance[place, place]))


def _best_pair(fit: SpanFit, data: WhitenedRegression,
               times: Array) -> tuple[float, tuple[int, int]]:
    """Return the largest gain in log-likelihood by two steps of the bias, and their places."""
    step, left = _given_design(data, data.whiten_columns(fit.spans.step_columns(times)))
    size = np.sqrt(np.sum(step ** 2, axis=0)) + 1e-100
    alone, alike = left @ step / size, step.T @ step / np.outer(size, size)
    gains = 0.5 * (alone ** 2 + alone[:, None] ** 2 - 2.0 * alike * np.outer(alone, alone)) / (
        1.0 - np.minimum(np.abs(alike), 1.0 - 1e-6) ** 2)
    gains[np.abs(alike) > _MAX_ALIKENESS] = 0.0
    first, second = np.unravel_index(int(gains.argmax()), gains.shape)
    return float(gains.max()), (int(min(first, second)), int(max(first, second)))


def _step_gains(fit: SpanFit, data: WhitenedRegression, times: Array) -> tuple[Array, Array]:
    """Return the gain in log-likelihood by a step of the bias at each time, and its size."""
    whole = data.whiten_columns(fit.spans.step_columns(times))
    step, left = _given_design(data, whole)
    score, information = left @ step, np.maximum(np.sum(step ** 2, axis=0), 1e-300)
    # a step that these spans do not distinguish from another explains nothing
    distinct = information > (1.0 - _MAX_ALIKENESS ** 2) * np.sum(whole ** 2, axis=0)
    return 0.5 * distinct * score ** 2 / information, distinct * score / information


def _implausibility(fit: SpanFit, cause: CauseTerm, false_alarm_rate: float) -> float:
    """
    Return the ratio of an effect to the largest plausible one; inf if it may be 0.

    It may be if it is not significant under the noise that is fitted with it, by which the search
    does not test: a single value at the level of the search.
    """
    places = fit.value_slice(cause)
    values = fit.values[places]
    if cause.cause == 'reference_once_per_rev':
        # from 1 on, the reference would turn back
        return float(np.hypot(*values))
    if len(values) == 1 and fit.p_value(places.start) >= false_alarm_rate:
        return math.inf
    if (CAUSES[cause.cause].along not in ('rate', 'heading')
            or cause.cause not in CATALOGUE):
        return 0.0
    columns = CATALOGUE[cause.cause].columns(fit.spans.channels, *cause.shapes)
    added = np.abs(np.tensordot(values, np.array(columns), 1)).max()
    # of two standard deviations of the prior of a scale factor error, as a share of the rate;
    # larger ones result from several similar columns that nearly cancel each other
    return float(added / np.abs(fit.spans.channels.rate).max()) / (
        2.0 * HEADING_TREATMENT.prior[0])


def _find_best_cause(spans: Spans, data: WhitenedRegression, terms: Sequence[CauseTerm],
                     false_alarm_rate: float) -> FoundCause | None:
    """Return the best of the remaining causes, given those found; None if insignificant."""
    widths = [spans.cause_columns(each) for each in terms]
    columns = data.whiten_columns(np.column_stack(widths))
    ends = np.cumsum([each.shape[1] for each in widths]).tolist()
    places = list(map(slice, [0, *ends], ends))
    evidences = _term_evidences(data, columns, places, terms,
                                np.ones(len(data.observed), dtype=bool))
    p_values = [min(evidence.chance * len(terms), 1.0) for evidence in evidences]
    strongest = min(range(len(terms)), key=lambda place: (p_values[place], place))
    if p_values[strongest] > SUSPECTED_RATE_FACTOR * false_alarm_rate:
        return None
    # with one variance for all, as similar causes scatter alike
    likelihoods = [each.gain * each.variance_ratio / evidences[strongest].variance_ratio
                   for each in evidences]
    best_of = {terms[place].cause: place
               for place in sorted(range(len(terms)), key=likelihoods.__getitem__)}
    gain = likelihoods[strongest]
    equivalent = {name: place for name, place in reversed(best_of.items()) if place == strongest
                  or gain - likelihoods[place] < RULED_OUT_DEFICIT}

    def complexity(place: int) -> tuple[int, float, float]:
        """Return the number of values and fitted shapes, the p-value, and less the likelihood."""
        effect = CATALOGUE.get(terms[place].cause)
        return (widths[place].shape[1] if effect is None
                else sum(each.default is None for each in effect.parameters), p_values[place],
                -evidences[place].gain)

    simplest = min(equivalent.values(), key=complexity)
    # every fifth stretch, where slow causes are also predicted by the bias wander of neighbouring
    # ones, and fifths of the log
    numbers, count = np.arange(data.stretch_count), min(5, data.stretch_count)
    folds = [_cross_fit(data, columns, places, terms, equivalent, sets)
             for sets in ([numbers[fold::count] for fold in range(count)],
                          np.array_split(numbers, count))]
    # errors of a course are correlated over time, so that distant stretches must be predicted too
    confirmed = [(sigmas > MIN_PREDICTION_SIGMAS and selected == 1.0, sigmas, predicted, selected)
                 for sigmas, predicted, selected in folds]
    is_confirmed, _, predicted, selected = (
        max(confirmed) if spans.treatment.is_fine else min(confirmed, key=lambda each: each[1:]))
    established = (p_values[simplest] < false_alarm_rate and is_confirmed
                   and evidences[simplest].stretches >= MIN_STRETCHES)
    term, interval = _profile_shape(spans, data, terms[simplest], [
        each.shapes for each in terms if each.cause == terms[simplest].cause],
        evidences[simplest].variance_ratio)
    return FoundCause(term, p_values[simplest], predicted, selected, established, {
        name: gain - likelihoods[place] for name, place in equivalent.items()}, interval)


def _profile_shape(spans: Spans, data: WhitenedRegression, term: CauseTerm,
                   tried: Sequence[tuple[float, ...]], variance_ratio: float
                   ) -> tuple[CauseTerm, tuple[float, float] | None]:
    """
    Return a term with its best shape, and the 95 % interval by the profile of the likelihood.

    The shape is a positive one that the effect leaves to the data, such as a time constant. The
    interval is within the range of those that were tried; None if there is no such shape.
    """
    effect = CATALOGUE.get(term.cause)
    parameters = () if effect is None else effect.nonlinear_parameters
    if len(parameters) != 1 or parameters[0].default is not None or len(tried) < 2:
        return term, None

    def likelihood(logarithm: float) -> float:
        trial = CauseTerm(term.cause, (math.exp(logarithm),))
        columns = data.whiten_columns(spans.cause_columns(trial))
        (evidence,) = _term_evidences(data, columns, [slice(None)], [trial],
                                      np.ones(len(data.observed), dtype=bool))
        return evidence.gain * evidence.variance_ratio / variance_ratio

    shapes = sorted(each for each, in tried)
    place, logarithms = shapes.index(term.shapes[0]), np.log(shapes).tolist()
    best = float(minimize_scalar(
        lambda logarithm: -likelihood(logarithm), method='bounded',
        bounds=(logarithms[max(place - 1, 0)],
                logarithms[min(place + 1, len(shapes) - 1)])).x)
    least = likelihood(best) - 0.5 * NORMAL_QUANTILE_975 ** 2
    low, high = (math.exp(end if likelihood(end) > least else float(brentq(
        lambda logarithm: likelihood(logarithm) - least, end, best)))
        for end in (logarithms[0], logarithms[-1]))
    return CauseTerm(term.cause, (math.exp(best),)), (low, high)


def _term_evidences(data: WhitenedRegression, columns: Array, places: Sequence[slice],
                    terms: Sequence[CauseTerm], rows: Mask) -> list[Evidence]:
    """Return the evidence for each term in some of the rows."""
    given, left = _given_design(data, columns, rows)
    clusters = [each[rows] for each in data.clusters]
    least = 1e-6 * (np.sqrt(np.sum(columns[rows] ** 2, axis=0)) + 1e-300)
    # along the motion they are similar to errors of an encoder that repeat with its position
    return [_cluster_robust_evidence(
        given[:, place], left, clusters if CAUSES[each.cause].along in ('rate', 'heading')
        else clusters[:1], data.cosines, least[place]) for place, each in zip(places, terms)]


def _given_design(data: WhitenedRegression, columns: Array,
                  rows: Mask | slice = slice(None)) -> tuple[Array, Array]:
    """Return what of more columns and of the observations the design does not explain."""
    base, _ = np.linalg.qr(data.design[rows])
    both = np.column_stack([columns, data.observed])[rows]
    both -= base @ (base.T @ both)
    return both[:, :-1], both[:, -1]


def _cluster_robust_evidence(x: Array, residual: Array, clusters: Sequence[NDArray[np.intp]],
                             cosines: slice, min_sizes: Array) -> Evidence:
    """
    Return the least evidence by any of the clusterings.

    Evidence against a wander of the bias counts as that of all its cosines, since all of them show
    its size, although a slow cause is in few of them.
    """
    information = x.T @ x
    size = np.sqrt(np.diag(information))
    if not (size > min_sizes).all():
        return Evidence(1.0, 0.0, 0.0, 1.0)
    # by the residual with the candidate: scores that contain the effect would overestimate scatter
    off = residual - x @ np.linalg.lstsq(x, residual, rcond=None)[0]
    count, found = x.shape[1], []
    root = np.linalg.inv(np.linalg.cholesky(information + 1e-12 * np.diag(size ** 2)))
    square = float(np.sum((root @ x.T @ residual) ** 2))
    for cluster in clusters:
        scores = np.array([np.bincount(cluster, part * off) for part in x.T])
        shares = np.bincount(cluster, np.sum((x / size) ** 2, axis=1))
        shares[cosines] = shares[cosines].mean()
        effective = float(shares.sum() ** 2 / (shares ** 2).sum())
        scatter = scores @ scores.T * effective / max(effective - 1.0 - count, 0.5)
        ratio = max(float(np.linalg.eigvalsh(root @ scatter @ root.T).max()), 1.0)
        statistic, freedom = square / ratio, max(effective - count, 1.0)
        found.append(Evidence(float(fisher.sf(statistic / count, count, freedom)),
                              0.5 * statistic, effective, ratio))
    return max(found)


def _cross_fit(data: WhitenedRegression, columns: Array, places: Sequence[slice],
               terms: Sequence[CauseTerm], equivalent: Mapping[str, int],
               folds: Sequence[NDArray[np.intp]]) -> tuple[float, float, float]:
    """
    Select and fit without each fold, and predict it.

    Return the gain in log-likelihood over its standard deviation by the scatter of stretches, the
    gain, and the share of the folds in which one of the equivalent causes was selected.
    """
    gains: list[float] = []
    same_choices = 0
    for fold in folds:
        held = np.isin(data.clusters[0], fold)
        rest = ~held
        evidences = _term_evidences(data, columns, places, terms, rest)
        best = int(np.argmax([each.gain for each in evidences]))
        same_choices += terms[best].cause in equivalent
        off = []
        for design in (data.design, np.column_stack([data.design, columns[:, places[best]]])):
            values = np.linalg.lstsq(design[rest], data.observed[rest], rcond=None)[0]
            off.append(data.observed[held] - design[held] @ values)
        gains += np.bincount(np.searchsorted(fold, data.clusters[0][held]),
                             0.5 * (off[0] ** 2 - off[1] ** 2)).tolist()
    return prediction_sigmas(np.array(gains)), float(np.sum(gains)), same_choices / len(folds)
