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
The diagnosis of logs whose reference has errors of its own, such as a course over ground.

Causes are searched for as beside an exact reference, but over spans, under the noise of gyro and
reference that is found with a column of each cause, and under any wander of the bias.

Several logs are joined, each with a bias of its own; a cause has the same values in all.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
import math

from gyro_calibration.calibration.dwells import require_output
from gyro_calibration.calibration.heading_regression import (
    fit_spans, MIN_STRETCHES, SpanFit, whiten_regression)
from gyro_calibration.calibration.joined_logs import join_logs
from gyro_calibration.calibration.likelihood import MISALIGNMENT_REMEDY, oblique_angle
from gyro_calibration.calibration.reference_noise import MAX_GYRO_LAG, OwnInstants
from gyro_calibration.calibration.selection import FALSE_ALARM_RATE
from gyro_calibration.calibration.spans import (
    BASE_VALUES, CauseTerm, design_matrix, lay_out_spans, MISALIGNMENT_TERM,
    OWN_BIAS, OWN_DELAY)
from gyro_calibration.diagnosis.candidates import (
    MIN_CHANNEL_RANGE, observed_range)
from gyro_calibration.diagnosis.causes import (
    Cause, CAUSES, sized_finding, untestable_causes, value_finding)
from gyro_calibration.diagnosis.data_quality import inspect_record, strongest_findings
from gyro_calibration.diagnosis.extended_model import (
    add_terms, gain_from_errors, heading_curve, heading_error_shares, HEADING_WINDOW,
    MAX_WINDOW_SHARE, previous_origins, window_changes)
from gyro_calibration.diagnosis.findings import (
    Curve, detectable_sigmas, Diagnosis, Estimate, Finding, Gain, MIN_PROBABILITY, OnProgress,
    Reference, SEARCH_ALARM_RATE, TIME_LIMIT_REMARK, VALUE_ALARM_RATE)
from gyro_calibration.diagnosis.search import SelectedCause
from gyro_calibration.diagnosis.span_search import (
    follows_the_rate, OF_FIXED_SIZE, propose_terms, select_causes, suspect_terms, term_of)
from gyro_calibration.heading.log_compensation import compensate_log
from gyro_calibration.logs.log import Array, DEGREE, Log, NORMAL_QUANTILE_975
from gyro_calibration.model.effects import BIAS, CATALOGUE, SCALE_FACTOR_ERROR, SINE_RESPONSE
from gyro_calibration.model.gyro_model import GyroModel, Term, Tolerance
from gyro_calibration.model.noise import Noise
import numpy as np
from scipy.stats import chi2

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
    'established if its evidence holds beyond the scatter between stretches, and if its size on '
    'some stretches predicts the others; else it is suspected. Only established causes are '
    'in the model. Intervals are of 95 %.')
#: Causes that are not candidates, because they are tested in each log.
_ALWAYS_TESTED = {*BASE_VALUES, 'bias_step', 'outliers', 'stuck_samples', 'dropped_samples',
                  'unit_error', 'quantization', 'saturation'}


def diagnose_by_noisy_reference(logs: Sequence[Log], reference: Reference,
                                model: GyroModel | None, on_progress: OnProgress,
                                instants: Sequence[OwnInstants | None] = (None,)) -> Diagnosis:
    """
    Diagnose logs with a kind of reference whose errors are larger than those of the gyro.

    The instants are those of a slow reference in each log, by `keep_own_instants`.
    """
    on_progress(None, 'data quality')
    records = [inspect_record(replace(log, reference_heading=None, reference_rate=None))
               for log in logs]
    cleaned = [replace(log, output=np.where(record.usable, require_output(log), np.nan))
               for log, record in zip(logs, records)]
    prior = None if model is None else model.prior_deviations
    on_progress(None, 'bias and scale factor error')
    if model is not None:
        cleaned = [replace(log, output=compensate_log(model, log)) for log in cleaned]
    each_alone = [fit_spans(lay_out_spans(log, reference.kind, prior, own))
                  for log, own in zip(cleaned, instants)]
    plain = each_alone[0] if len(logs) == 1 else _fit_joined(
        cleaned, reference.kind, prior, instants, each_alone)
    extended, found = select_causes(plain, SEARCH_ALARM_RATE, on_progress)
    if len(logs) > 1:
        extended, found = _withdraw_differing_causes(extended, found, each_alone)
    time_is_up = on_progress(None, 'cross-validation')
    events = [each for each in extended.causes if each.is_single_event]
    lasting = [each for each in extended.causes if not each.is_single_event]
    model_fit = (extended if not events else plain if not lasting
                 else fit_spans(plain.spans, lasting))
    gain = None if time_is_up else _cross_validated_gain(plain, model_fit)
    if gain is not None and extended.causes and gain.models['extended'] > gain.models['plain']:
        # causes that do not improve the prediction are not added to the model
        model_fit, gain = plain, _cross_validated_gain(plain, plain)
        if not plain.spans.treatment.is_fine:
            found = suspect_terms(found, lasting)
            extended = fit_spans(plain.spans, events) if events else plain
    on_progress(None, 'findings')
    of_logs, of_record = _heading_contributions(extended), strongest_findings(records)
    # between two clocks neither a delay nor a clock rate is a property of the gyro
    of_clocks = set() if reference.kind in _SAME_CLOCK else {'time_offset', 'clock_rate'}
    findings = [*_value_findings(extended, model, reference), *_reference_findings(extended),
                *of_record, *_cause_findings(found, extended)]
    findings = [replace(each, remedy='synchronize the clocks of gyro and reference; the model '
                                     'does not contain it')
                if each.effect in of_clocks and each.status == 'established' else each
                for each in findings]
    not_in_model = {'time_offset', 'bias_step', *of_clocks, *(each.effect for each in of_record)}
    changed = any(each.status == 'established' and CAUSES[each.effect].origin == 'gyro'
                  and each.effect not in not_in_model for each in findings)
    clock_delay = next((each for each in findings if each.effect == 'time_offset'
                        and each.status == 'established' and not of_clocks), None)
    rejected = gain is not None and gain.is_worse
    before = (model if model is not None else GyroModel() if rejected
              else _model_with_fit(GyroModel(), plain, logs))
    after = (before if rejected or not (changed or clock_delay or model is None
                                        or prior is not None)
             else _extend_model(model, model_fit, logs, clock_delay, of_clocks))
    curve, trace = _rate_curve_and_trace(extended, of_logs)
    return Diagnosis(tuple(findings), (), _gyro_noise(extended),
                     Noise() if model is None else model.noise,
                     None if not changed and model is not None else gain, before, after,
                     _untestable_causes(plain), [curve], heading_curve(*of_logs[0]), None,
                     (*(f'log {number}: {remark}' if len(logs) > 1 else remark
                        for number, record in enumerate(records, 1) for remark in record.remarks),
                      *_remarks(reference, extended, prior is not None),
                      *_differences_of_logs(extended, each_alone),
                      *[TIME_LIMIT_REMARK] * bool(time_is_up)),
                     trace=trace, method=_METHOD_TEXT.format(_REFERENCE_PHRASES[reference.kind]),
                     reference=replace(reference, noise={
                         name: extended.noise_size(name) for name in ('reference', 'motion')}),
                     heading_shares=heading_error_shares(of_logs, 2.0 * _point_variance(extended)))


# several logs

def _fit_joined(logs: Sequence[Log], kind: str, prior: Array | None,
                instants: Sequence[OwnInstants | None], each_alone: Sequence[SpanFit]) -> SpanFit:
    """Fit scale factor error, bias and delay to logs with the same quantity as the reference."""
    delays = [float(fit.values[2]) for fit in each_alone]
    has_one_clock = kind in _SAME_CLOCK and not _differ(
        np.array(delays), np.array([fit.normal_covariance[2, 2] for fit in each_alone]))
    spans = lay_out_spans(join_logs(logs, instants, () if has_one_clock else delays), kind, prior)
    return fit_spans(replace(spans, delay=float(np.mean(delays))) if has_one_clock else spans)


def _differ(values: Array, variances: Array) -> bool:
    """Tell whether values of logs, shape (k,), differ beyond chance."""
    mean = np.average(values, weights=1.0 / variances)
    return bool(chi2.sf(np.sum((values - mean) ** 2 / variances),
                        max(len(values) - 1, 1)) < FALSE_ALARM_RATE)


def _withdraw_differing_causes(fit: SpanFit, found: list[SelectedCause],
                               each_alone: Sequence[SpanFit]
                               ) -> tuple[SpanFit, list[SelectedCause]]:
    """Return the fit without causes whose values differ between logs beyond chance."""
    established = [term_of(each.cause) for each in found if each.is_established]
    lasting = [each for each in established if not each.is_single_event]
    if not lasting:
        return fit, found
    fits = [fit_spans(alone.spans, lasting) for alone in each_alone
            if len(alone.spans.time) > design_matrix(alone.spans, lasting).shape[1] + 1]
    differing = set[CauseTerm]()
    for term in lasting:
        values, variances = np.moveaxis(np.array([
            (each.values[own], np.diag(each.normal_covariance)[own])
            for each in fits for own in [each.value_slice(term)]]), 1, 0)
        if any(map(_differ, values.T, variances.T)):
            differing.add(term)
    if not differing:
        return fit, found
    return (fit_spans(fit.spans, [each for each in established if each not in differing]),
            suspect_terms(found, differing))


def _own_biases(fit: SpanFit) -> Array:
    """Return the bias of each log, rad/s."""
    others = np.array([float(fit.values[fit.value_slice(each)][0])
                       for each in fit.causes if each.cause == OWN_BIAS])
    return np.append(-others.sum(), others) + fit.values[1]


def _power_on_variance(fit: SpanFit) -> float:
    """Return by how much the bias of one more power-on differs from the mean of several."""
    biases = _own_biases(fit)
    count = len(biases)
    return float(np.var(biases, ddof=1)) * (1.0 + 1.0 / count) if count > 1 else 0.0


def _differences_of_logs(fit: SpanFit, each_alone: Sequence[SpanFit]) -> Iterator[str]:
    """Give what differs between logs, in words."""
    joined = fit.spans.joined
    if joined is None:
        return
    biases = ', '.join(f'{bias / DEGREE:.4g}' for bias in _own_biases(fit).tolist())
    yield (f'Each log has a bias of its own: {biases} deg/s in turn; the model has their mean, '
           'and their scatter in its covariance. Curves over time are those of the first log.')
    if len(joined.delays):
        yield ('Each log has a delay by its own clock: '
               f'{", ".join(f"{1000.0 * delay:.4g}" for delay in joined.delays.tolist())} ms in '
               'turn, which is corrected.')
    missing = [name for name in MIN_CHANNEL_RANGE if getattr(fit.spans.log, name) is None
               and any(getattr(each.spans.log, name) is not None for each in each_alone)]
    if missing:
        yield (f'Not every log has a {" and a ".join(missing).replace("_", " ")}, which is not '
               'used; what it causes may be taken for a drift or a warm-up: give logs that have '
               'it.')
    scales, variances = np.array([(each.values[0], each.normal_covariance[0, 0])
                                  for each in each_alone]).T
    # another cause may differ between the motions of the logs
    if _differ(scales, variances) and not any(each.cause in CAUSES for each in fit.causes):
        shown = ', '.join(f'{100.0 * scale:.3g} +- {100.0 * one.half_width(0):.2g}'
                          for scale, one in zip(scales.tolist(), each_alone))
        yield (f'The scale factor errors of the logs alone, {shown} %, differ beyond chance; the '
               'model has one for all.')


# values

def _value_findings(fit: SpanFit, model: GyroModel | None,
                    reference: Reference) -> Iterator[Finding]:
    """Give delay, and with a model bias and scale factor error, if they are established."""
    own_clock = reference.kind not in _SAME_CLOCK
    for place, name in enumerate(BASE_VALUES):
        effective = float(fit.effective_stretches[place])
        if name != 'time_offset' and model is None or effective < MIN_STRETCHES:
            continue
        if name == 'time_offset' and fit.spans.joined is not None and len(
                fit.spans.joined.delays):  # each log has its own
            continue
        value, variance = float(fit.values[place]), float(fit.covariance[place, place])
        if name == 'bias' and model is not None:
            # the mean bias of a log differs from that of the model by bias wander; beside a
            # course, the variance contains that of the log
            duration = float(fit.spans.time[-1] - fit.spans.time[0])
            shown = [_gyro_noise(fit)] if fit.spans.treatment.is_fine else []
            variance += _power_on_variance(fit) + max(
                2.0 / math.pi * each.bias_instability ** 2
                + each.rate_random_walk ** 2 * duration / 3.0 for each in (*shown, model.noise))
        known, confounders = {}, ['reference_scale'] if name == 'scale_factor_error' else []
        # a delay between two clocks is usual
        is_usual = name == 'time_offset' and own_clock
        if name == 'time_offset':
            of_gyro = 0.0 < value < MAX_GYRO_LAG
            confounders = [other for other, might in (('bandwidth', of_gyro), ('clock_rate', True))
                           if might and _is_possible_instead(fit, other)]
            if own_clock and not of_gyro:
                known['cause'] = 'The gyro has a time offset from its reference.'
        if found := value_finding(name, value, math.sqrt(variance),
                                  FALSE_ALARM_RATE if is_usual else VALUE_ALARM_RATE, confounders,
                                  float(fit.freedom[place]),
                                  NORMAL_QUANTILE_975 * fit.spans.treatment.prior[place],
                                  evidence=f'evidence from {effective:.0f} stretches', **known):
            yield found


def _reference_findings(fit: SpanFit) -> Iterator[Finding]:
    """Give the misalignment, and the drift of a reference against the rests in which it stands."""
    if MISALIGNMENT_TERM in fit.causes:
        name, places = MISALIGNMENT_TERM.cause, fit.value_slice(MISALIGNMENT_TERM)
        angle, half, chance = oblique_angle(fit.values[places], fit.normal_covariance[
            places, places])
        if chance < FALSE_ALARM_RATE:
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
            FALSE_ALARM_RATE, ['vibration_rectification'], float(fit.freedom[place]),
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


def _cause_findings(found: Sequence[SelectedCause], extended: SpanFit) -> Iterator[Finding]:
    """Give the causes that the search found, unless they may have the size 0."""
    for cause in found:
        finding = _cause_finding(cause, extended)
        if not finding.parameters[finding.effect].contains_zero:
            yield finding


def _cause_finding(found: SelectedCause, extended: SpanFit) -> Finding:
    """Return a cause that the search found, with its values given the established ones."""
    term, spans = term_of(found.cause), extended.spans
    fit = (extended if found.is_established
           else fit_spans(spans, [*extended.causes, term]))
    places, shapes = fit.value_slice(term), found.shapes
    values, covariance = fit.values[places], fit.normal_covariance[places, places]
    if term.cause == SINE_RESPONSE.name:
        size, slope = _shape_of_sine(term, float(values[0]))
        shapes['k'] = Estimate.from_half_width(size, slope * fit.half_width(places.start), 's')
    if term.cause in OF_FIXED_SIZE:
        values, covariance = values[1:], covariance[1:, 1:]
    end, temperature, joined = float(spans.time[-1]), spans.log.temperature, spans.joined
    observed = observed_range([np.asarray(spans.channels.rate)],
                              [] if temperature is None else [temperature], end)
    finding = found.finding(values, covariance, shapes, observed,
                            detectable_sigmas(VALUE_ALARM_RATE), end)
    if joined is None or finding.where is None:
        return finding
    number = int(joined.find(begin := finding.where[0]))
    last = float(spans.stamps[joined.find(spans.stamps) == number][-1])
    shift, at = float(joined.begins[number]), finding.parameters['step_time']
    at = replace(at, estimate=at.estimate - shift,
                 interval=(at.interval[0] - shift, at.interval[1] - shift))
    return replace(finding, parameters={**finding.parameters, 'step_time': at},
                   where=(begin - shift, last - shift),
                   evidence=f'in log {number + 1}, {finding.evidence}')


def _shape_of_sine(term: CauseTerm, amplitude: float) -> tuple[float, float]:
    """
    Return the k of a sine response of amplitude 1, and its derivative by the fitted amplitude.

    The effect, ``sin(k w) / k - w``, is proportional to k² to first order.
    """
    root = math.sqrt(max(amplitude, 0.0))
    return term.shapes[0] * root, 0.5 * term.shapes[0] / max(root, 1e-3)


def _extend_model(model: GyroModel | None, fit: SpanFit, logs: Sequence[Log],
                  delay_finding: Finding | None, left_out: Collection[str]) -> GyroModel:
    """Return the extended model of a fit, with a delay of the gyro, without some causes."""
    after = _model_with_fit(model or GyroModel(), fit, logs, left_out)
    if model is not None and model.prior_deviations is not None:
        # the values of this unit replace those of its type
        after = replace(after, tolerance=Tolerance(), origin=previous_origins(model))
    if delay_finding is None:
        return after
    size = delay_finding.parameters['time_offset']
    return add_terms(after, [Term(CATALOGUE['time_offset'], (size.estimate,))], [0],
                     np.array([[size.deviation ** 2]]), [np.array(after.rate_range)], [])


def _model_with_fit(base_model: GyroModel, fit: SpanFit, logs: Sequence[Log],
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
            elif cause.cause in OF_FIXED_SIZE:
                values, of_term = [1.0], [-1, -1]
            terms.append(Term(CATALOGUE[cause.cause], (*shapes, *values)))
            indices += of_term
    outputs = [log.output for log in logs if log.output is not None]
    covariance = fit.normal_covariance.copy()
    covariance[1, 1] += _power_on_variance(fit)
    new = add_terms(base_model, terms, indices, covariance * np.outer(slopes, slopes),
                    [each[np.isfinite(each)] for each in outputs],
                    [log.temperature for log in logs if log.temperature is not None])
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

def _heading_contributions(fit: SpanFit) -> list[tuple[dict[str, Array], Array]]:
    """Return of each log what causes add to the heading in spans, and residual, rad; times, s."""
    values = fit.values - fit.spans.correction(fit.causes, len(fit.values))
    columns = design_matrix(fit.spans, fit.causes) * values
    found = {name: columns[:, place]
             for place, name in enumerate(BASE_VALUES) if name != 'time_offset'}
    for cause in fit.causes:
        if cause.cause not in ('clock_rate', OWN_DELAY):
            name = 'bias' if cause.cause == OWN_BIAS else cause.cause
            found[name] = found.get(name, 0.0) + columns[:, fit.value_slice(cause)].sum(axis=1)
    found['left'] = fit.spans.observed - columns.sum(axis=1)
    return [({name: part[spans] for name, part in found.items()},
             fit.spans.time[spans.start:spans.stop + 1]) for spans in fit.spans.of_logs]


def _point_variance(fit: SpanFit) -> float:
    """Return the mean variance of the errors of the reference at a point, rad²."""
    rates = fit.spans.point_means(np.asarray(fit.spans.channels.rate))
    return (fit.noise_size('reference') ** 2
            + fit.noise_size('motion') ** 2 * float(np.mean(rates ** 2)))


def _cross_validated_gain(plain: SpanFit, extended: SpanFit) -> Gain | None:
    """Hold out each part of logs in turn, fit the others, and predict heading and rate there."""
    time, spans, parts, window = plain.spans.time, plain.spans, 0, HEADING_WINDOW
    number = np.full(len(time) - 1, -1)
    for own in spans.of_logs:
        begin, duration = time[own.start], float(time[own.stop] - time[own.start])
        own_parts = int(np.clip(duration / 80.0, 2, 6))
        number[own] = parts + np.minimum(((
            time[1:][own] - begin) * own_parts / duration).astype(int), own_parts - 1)
        parts += own_parts
        window = min(window, MAX_WINDOW_SHARE * duration / own_parts)
    # under the noise of the plain fit, given the prior of the wandering bias
    noisy = whiten_regression(plain, ())
    prior = len(noisy.observed) - len(spans.observed)
    # a misalignment is of no model, nor are the delays of logs
    columns = design_matrix(spans, ())
    given = np.array([2, *range(3, 3 + spans.cross_rotation.shape[1]), *(
        plain.value_slice(each).start for each in plain.causes if each.cause == OWN_DELAY)])
    with_given = np.append(given, np.arange(columns.shape[1], noisy.design.shape[1]))
    models = {'given': (columns[:, given], noisy.design[:, with_given]),
              'plain': (columns, noisy.design),
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
    which = ('the log' if spans.joined is None
             else 'the logs, each with its own bias,')
    return gain_from_errors(f'each of {parts} parts of {which} in turn, the others being fitted',
                            errors, 'given', window)


# for people

def _untestable_causes(plain: SpanFit) -> dict[str, str]:
    """Return the reason for each cause that was not searched for."""
    def reason(cause: Cause) -> str:
        if plain.lacks_turns and follows_the_rate(cause.name):
            return ('fewer than three stretches turn, which do not distinguish it from a scale '
                    'factor error')
        return {'axis_misalignment': 'the reference is planar',
                'reference_drift': 'the reference is known in no rest',
                'reference_once_per_rev': 'a course over ground has no shaft'}.get(
                    cause.name, 'the errors of the reference hide it over short spans')

    seen = {each.cause for each in (*propose_terms(plain), *plain.causes)}
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


def _rate_curve_and_trace(fit: SpanFit, of_logs: Sequence[tuple[dict[str, Array], Array]]
                          ) -> tuple[Curve, Curve]:
    """Return the residual along the rate, and the rates of the first log over time."""
    turned, of_first = fit.spans.span_integrals(fit.spans.output), fit.spans.of_logs[0]
    time = np.concatenate([each[:-1] for _, each in of_logs])
    steps = np.concatenate([np.diff(each) for _, each in of_logs])
    measured = np.concatenate([turned[own] for own in fit.spans.of_logs]) / steps
    before, after = (-np.concatenate(each) / steps for each in zip(*(
        (sum(parts.values(), 0.0 * parts['left']), parts['left']) for parts, _ in of_logs)))
    order = np.array_split(np.argsort(measured, kind='stable'), min(20, len(steps) // 4 + 1))
    at, given, left = (np.array([float(each[part].mean()) for part in order])
                       for each in (measured, before, after))
    deviation = np.array([float(after[part].std()) / math.sqrt(len(part)) for part in order])
    return (Curve('rate', 'rad/s', at, given, left, deviation, np.zeros(len(order))),
            Curve('time', 's', (time + 0.5 * steps)[of_first], before[of_first], after[of_first],
                  simulated=(measured - before)[of_first]))
