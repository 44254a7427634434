# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.


"""The diagnosis of logs and rate tables: its steps in order."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
import math

from gyro_calibration.calibration.dwells import find_dwells, require_output
from gyro_calibration.calibration.encoder import bridge_jumps, choose_reference
from gyro_calibration.calibration.heading_regression import MIN_STRETCHES
from gyro_calibration.calibration.reference_noise import (
    drop_repeated_references, keep_own_instants, OwnInstants)
from gyro_calibration.calibration.selection import FALSE_ALARM_RATE
from gyro_calibration.diagnosis.candidates import (
    Candidate, common_channels, constant_channels, effect_candidate, is_named, observed_range,
    PART_OF_LOG, RESPONSE, unnamed_variable)
from gyro_calibration.diagnosis.causes import (
    Cause, CAUSES, make_finding, mark_parts_of_log, NOISE_NAMES, REFERENCES, slip_times,
    untestable_causes, value_finding)
from gyro_calibration.diagnosis.data_quality import DataQuality, inspect_record, strongest_findings
from gyro_calibration.diagnosis.extended_model import (
    add_causes, complete_diagnosis, drop_samples, extend_model, heading_contributions,
    heading_curve, heading_error_shares, is_scale_implausible, measure_gain,
    merge_self_calibration, unmergeable_causes)
from gyro_calibration.diagnosis.findings import (
    DETECTION_POWER, Diagnosis, Estimate, Finding, Gate, MIN_PROBABILITY, OnProgress, Reference,
    TIME_LIMIT_REMARK, Unexplained, VALUE_ALARM_RATE)
from gyro_calibration.diagnosis.gates import (
    classify_reference, examine_log, is_at_rest, is_reference_limiting, is_sample_offset,
    mismatch_diagnosis)
from gyro_calibration.diagnosis.noisy_reference import diagnose_by_noisy_reference
from gyro_calibration.diagnosis.reference_lag import (
    follow_reference, follows_rate, HIDDEN_CAUSES, is_late)
from gyro_calibration.diagnosis.regression import (
    average_filtered_noise, build_problem, complexity_penalty, fit_causes, is_single_event,
    RegressionFit, SMOOTHED_RATIO, Value)
from gyro_calibration.diagnosis.replay import Replay, replay
from gyro_calibration.diagnosis.residuals import (
    allan_curves, find_changed_figures, fit_noise_parameters, model_residuals, residual_curves)
from gyro_calibration.diagnosis.search import (
    confirm_causes, evidence_for, evidence_threshold, explain_selection, forget_searches, p_value,
    refine_shape, Search, search_causes, Selection, start_search)
from gyro_calibration.diagnosis.table_diagnosis import diagnose_table
from gyro_calibration.diagnosis.words import is_model_extended
from gyro_calibration.logs.log import DataRefused, Log, Mask, NORMAL_QUANTILE_975
from gyro_calibration.logs.quality import mark_rows
from gyro_calibration.model.effects import QUANTIZATION
from gyro_calibration.model.gyro_model import GyroModel
from gyro_calibration.model.noise import Noise
import numpy as np
from scipy.stats import mannwhitneyu, norm

_SETTLED_REMARK = (
    'Between the dwells, gyro and reference differ by more than the causes explain, as where a '
    'robot follows its command with a lag and overshoot; the log is diagnosed by its dwells '
    'alone: use a measured rate or heading as the reference to see more.')
_MOTION_REMARK = (
    'The motion has more of its own than a response to its command, as a wobble, a limit of '
    'acceleration, or commands at uneven times: use a measured rate or heading as the reference '
    'to see more.')
_HIDDEN_REASON = 'the motion follows the reference with a lag of its own'
#: Why a constant channel shows no cause.
_CONSTANT_REASONS = {'temperature': 'the temperature changes by less than 0.2 K',
                     'supply': 'the supply voltage does not change',
                     'specific_force': 'the specific force does not change'}


def diagnose(logs: Sequence[Log], generator: np.random.Generator, model: GyroModel | None = None,
             names: Sequence[str] = (), on_progress: OnProgress = lambda share, words: None,
             reference_kind: str | None = None) -> Diagnosis:
    """
    Find the causes of the difference between a simulation and logs.

    Parameters
    ----------
    logs : of one gyro, with time, and with a reference unless the gyro is at rest; or a single
        rate table
    generator : source of the noise that fills gaps
    model : of the simulation; None is an ideal gyro with the bias and scale factor error that fit
        best
    names : file names of the logs, for messages
    on_progress : is called with None and the name of each step that begins; returns whether to end
    reference_kind : of the reference, one of `gates.REFERENCE_KINDS`; None is found
        from the log

    Raises
    ------
    DataRefused : a diagnosis of these logs is not possible

    """
    merged = None if model is None else merge_self_calibration(model)
    if all(log.time is not None for log in logs):
        found = _diagnose_in_time(logs, generator, merged, names, on_progress, reference_kind)
    elif len(logs) == 1:
        found = replace(diagnose_table(logs[0], merged, on_progress), logs=tuple(names))
    else:
        raise DataRefused(
            f'{len(logs)} logs were given, and one has no time_s; give a rate table alone, '
            'or give the sample rate in Hz with --rate')
    return (found if model is None or is_model_extended(found)
            else replace(found, before=model, model=model))


def _diagnose_in_time(logs: Sequence[Log], generator: np.random.Generator,
                      model: GyroModel | None, names: Sequence[str], on_progress: OnProgress,
                      reference_kind: str | None) -> Diagnosis:
    """Check logs with time, and diagnose them by their kind of reference."""
    shown = names or [f'log {number}' for number in range(1, len(logs) + 1)]
    for one, other in combinations(range(len(logs)), 2):
        if np.array_equal(require_output(logs[one]), require_output(logs[other]), equal_nan=True):
            raise DataRefused(f'{shown[one]} and {shown[other]} have the same output; give each '
                              'log once')
    on_progress(None, 'checks of the log')
    all_gates: list[Gate] = []
    for log in logs:
        require_output(log)
    if reference_kind == 'rate_command':
        logs = [log if log.reference_rate is None else replace(log, reference_heading=None)
                for log in logs]
    logs, chosen = zip(*(choose_reference(log, prefer_rate=True) for log in logs))
    given, remarks = logs, [remark for each in chosen for remark in each]
    logs, instants = zip(*(_use_own_values(log, remarks) for log in logs))
    for place, log in enumerate(logs):
        try:
            passed = examine_log(log, model, reference_kind == 'rate_command', given[place])
        except DataRefused as error:
            name = f'{shown[place]}: ' * (len(logs) > 1)
            raise DataRefused(f'{name}{error}') from None
        if (mismatch := mismatch_diagnosis(passed, model)) is not None:
            return replace(mismatch, logs=tuple(names[place:place + 1]), remarks=(
                *mismatch.remarks, *[f'This is of {shown[place]} alone.'] * (len(logs) > 1)))
        all_gates += passed
    references = [classify_reference(log, reference_kind) for log in logs]
    if reference_kind is None:
        references = _agree_on_kind(logs, references, shown)
    logs, slips = zip(*(_bridge_jumps(log, each.kind, remarks)
                        for log, each in zip(logs, references)))
    limiting_logs = [place for place, log in enumerate(logs)
                     if not is_at_rest(log) and is_reference_limiting(log, references[place])]
    if limiting_logs:
        _refuse_different_references(logs, references, shown, limiting_logs[0])
    try:
        found = (diagnose_by_noisy_reference(logs, references[0], model, on_progress, instants)
                 if limiting_logs else _diagnose_by_exact_reference(
                     logs, generator, model, names, on_progress, references,
                     reference_kind == 'rate_command'))
    finally:
        forget_searches()
    findings = found.findings if len(logs) > 1 else mark_parts_of_log(found.findings)
    return complete_diagnosis(replace(
        found, logs=tuple(names), gates=tuple(all_gates),
        findings=(*findings, *(each for each in slips if each is not None)),
        remarks=(*dict.fromkeys(remarks), *found.remarks)))


def _agree_on_kind(logs: Sequence[Log], references: Sequence[Reference],
                   names: Sequence[str]) -> list[Reference]:
    """
    Return references of one kind if that of a log is known by errors that others may hide.

    This is a course or odometry, and all references are headings, or rates.
    """
    erring = [place for place, each in enumerate(references)
              if each.kind in ('course', 'odometry')]
    if not erring or len({(log.reference_heading is None, log.reference_rate is None)
                          for log in logs}) > 1:
        return [*references]
    shown = references[erring[0]]
    return [each if each.kind == shown.kind else replace(
        shown, evidence=f'as in {names[erring[0]]}: {shown.evidence}') for each in references]


def _refuse_different_references(logs: Sequence[Log], references: Sequence[Reference],
                                 names: Sequence[str], place: int) -> None:
    """Raise `DataRefused` if logs have references whose errors cannot be compared."""
    for other, log in enumerate(logs):
        if (references[other].kind != references[place].kind
                or (log.reference_heading is None) != (logs[place].reference_heading is None)):
            one, another = (references[each].kind.replace('_', ' ') for each in (place, other))
            raise DataRefused(
                f'the errors of the reference of {names[place]} ({one}) are larger than those of '
                f'the gyro, and {names[other]} ({another}) cannot be diagnosed together with it: '
                'give logs with one kind of reference (state it with --reference-kind if it is '
                'the same), or diagnose each alone')


def _bridge_jumps(log: Log, kind: str, remarks: list[str]) -> tuple[Log, Finding | None]:
    """Return a log without jumps of its heading, unless it errs so; their finding; add remarks."""
    if kind in ('course', 'odometry'):
        return log, None
    log, bridged, jumps = bridge_jumps(log)
    remarks += [f'{each[:1].upper()}{each[1:]}.' for each in bridged]
    if jumps is None:
        return log, None
    assert log.time is not None
    name, largest = 'reference_slip', int(np.abs(jumps.sizes).argmax())
    times = slip_times((log.time[jumps.rows] - log.time[0]).tolist())
    size = Estimate.from_half_width(float(jumps.sizes[largest]),
                                    NORMAL_QUANTILE_975 * jumps.deviation, CAUSES[name].unit)
    return log, make_finding(name, {name: size, **times}, max(jumps.p_value, MIN_PROBABILITY))


def _use_own_values(log: Log, remarks: list[str]) -> tuple[Log, OwnInstants | None]:
    """Return a log with the values that its reference measured, and when; add remarks."""
    log, instants = keep_own_instants(log)
    if instants is not None:
        remarks.append('The reference has a value of its own every '
                       f'{1000.0 * instants.interval:.3g} ms, and is held or interpolated in '
                       'between; its own values alone are used.')
    log, lost = drop_repeated_references(log)
    remarks += lost
    return log, instants


def _diagnose_by_exact_reference(logs: Sequence[Log], generator: np.random.Generator,
                                 model: GyroModel | None, names: Sequence[str],
                                 on_progress: OnProgress, references: Sequence[Reference],
                                 is_command: bool) -> Diagnosis:
    """Diagnose logs whose reference errs less than the gyro."""
    on_progress(None, 'data quality')
    quality = [inspect_record(log, model) for log in logs]
    on_progress(None, 'replay of the model')
    replays = [replay(log, clean.usable, generator, clean.heading_step, clean.output_step, model)
               for log, clean in zip(logs, quality)]
    searched = _search_logs(logs, replays, on_progress, is_command)
    selection = confirm_causes(searched.search, searched.causes)
    search = _with_possible_lag(searched.search, selection.named)
    if searched.followed is not None and selection.unnamed and len(logs) == 1:
        return _diagnose_by_spans(logs[0], searched, replays[0], references[0], model,
                                  on_progress)
    found = fit_causes(search.problem, selection.named)
    out = unmergeable_causes(model or GyroModel(), found)
    on_progress(None, 'noise figures')
    # without a model, rounding of the output counts only if it is a finding
    rounds = (any(each.effect == QUANTIZATION.name for clean in quality for each in clean.findings)
              if model is None else any(term.effect is QUANTIZATION for term in model.terms))
    simulated = Noise() if model is None else model.noise
    # a response without a name would be in noise and scale factor error
    responses = [each for each in selection.unnamed if each.cause == RESPONSE]
    noise = fit_noise_parameters(
        fit_causes(search.problem, [*selection.named, *responses]), rounds)
    time_is_up = on_progress(None, 'cross-validation')
    changed = [] if model is None else list(_model_value_findings(found, model, noise))
    within = [(known, members) for known, members in zip(found.causes, selection.alternatives)
              if known not in out]
    lasting = any(not is_single_event(known) for known, _ in within)
    gain = None
    if (lasting or changed) and not is_scale_implausible(found) and not time_is_up:
        tried = {name for _, members in within for name in members}
        gain = measure_gain(search, tried, model is not None)
    offered = gain is None or not gain.is_worse
    on_progress(None, 'findings')
    of_record = strongest_findings(quality)
    covered = {name for each in of_record for name in each.ambiguous_with}
    findings = [*_cause_findings(search, found, selection), *of_record, *searched.findings,
                *(each for each in changed if each.effect not in covered)]
    # a motion that follows has noise of its own
    if model is not None and not searched.hidden:
        findings += find_changed_figures(found, model, rounds).values()
    # without causes that the model has already and that cannot be merged with those
    inside = replace(fit_causes(search.problem, [
        *(each for each in found.causes if each not in out), *responses])
                     if out or responses else found, lasting_only=True)
    plain = fit_causes(search.problem, [])
    deviation = _mean_bias_deviation(inside, noise)
    best = replace(add_causes(GyroModel(), plain, deviation), noise=noise)
    before = model or best
    after = extend_model(model, inside, quality, findings, noise, deviation) if offered else before
    # Curves before the extension contain the best bias and scale factor error, unless these differ
    # significantly from those of the model.
    left = model_residuals(search.problem.replays) if changed else plain.unbiased_residuals
    shown = inside if offered else plain
    of_heading = heading_error_shares(
        [heading_contributions(found, run, plain if model is None else None)
         for run in range(len(replays))],
        float(np.mean([each.heading_step ** 2 for each in replays])) / 6.0)
    return Diagnosis(tuple(findings),
                     tuple(_unexplained_structures(search, found, selection.unnamed)), noise,
                     simulated, gain, before, after,
                     _untestable_causes(search, logs, searched.hidden),
                     residual_curves(left, shown), heading_curve(
                         *heading_contributions(shown, 0, None if changed else plain)),
                     allan_curves(found, noise, simulated),
                     (*_remarks(quality, names, found, selection, out, model),
                      *searched.remarks, *[TIME_LIMIT_REMARK] * bool(time_is_up)),
                     heading_shares=of_heading,
                     reference=references[0] if len(logs) == 1 else None)


def _with_possible_lag(search: Search, named: Sequence[Candidate]) -> Search:
    """Return a search whose logs may have a lag beside a delay, if that is named without one."""
    delays = [each.shapes[0] for each in named if each.cause == 'time_offset']
    if not delays or 'bandwidth' in {each.cause for each in named}:
        return search
    return replace(search, problem=build_problem(
        [each.with_possible_lag(delays[0]) for each in search.problem.replays]))


def _diagnose_by_spans(log: Log, searched: _Searched, given: Replay, reference: Reference,
                       model: GyroModel | None, on_progress: OnProgress) -> Diagnosis:
    """Diagnose a log by spans, if its motion has more of its own than a response to a command."""
    motion = searched.followed
    assert motion is not None and log.reference_rate is not None
    of_motion = np.where(motion.valid, log.reference_rate + motion.reference - given.reference,
                         np.nan)
    found = diagnose_by_noisy_reference([replace(log, reference_rate=of_motion)], reference, model,
                                        on_progress)
    # nor can a single event be told from what the motion has of its own
    hidden = {name: _HIDDEN_REASON
              for name in (*searched.hidden, 'bias_step', 'reference_slip') if name in CAUSES}
    shares = {name: share for name, share in found.heading_shares.items() if name not in hidden}
    shares['left'] += sum(found.heading_shares.values()) - sum(shares.values())
    return replace(found, findings=(*(each for each in found.findings
                                      if each.effect not in hidden), *searched.findings),
                   cannot_show={**found.cannot_show, **hidden}, heading_shares=shares,
                   remarks=(*found.remarks, _MOTION_REMARK))


@dataclass(frozen=True)
class _Searched:
    """A search, and what is reported of a motion that follows its reference."""

    search: Search
    causes: tuple[Candidate, ...]
    hidden: Collection[str] = ()  # causes that cannot be known beside the response of the motion
    findings: Sequence[Finding] = ()
    remarks: Sequence[str] = ()
    followed: Replay | None = None  # the first log, with the motion that follows


def _search_logs(logs: Sequence[Log], replays: Sequence[Replay], on_progress: OnProgress,
                 is_command: bool) -> _Searched:
    """Search for causes, given the motion that follows where a log follows its reference."""
    plain = average_filtered_noise(fit_causes(build_problem(replays), []), SMOOTHED_RATIO)
    replays = plain.problem.replays
    if not (follows_rate(replays) and (is_command or is_late(plain))):
        return _search_replays(_drop_unknown_ends(plain), on_progress)
    followed, lag = follow_reference(replays)
    within = (_find_settled(fit_causes(build_problem(followed), [])) if len(logs) == 1 else None)
    replays = followed if within is None else [drop_samples(followed[0], ~within)]
    return replace(_search_replays(replays, on_progress, {RESPONSE, *HIDDEN_CAUSES}),
                   findings=lag, followed=followed[0],
                   remarks=[] if within is None else [_SETTLED_REMARK])


def _drop_unknown_ends(plain: RegressionFit) -> Sequence[Replay]:
    """Return the logs of a fit without samples of which a delay or lag hides the motion."""
    replays = plain.problem.replays
    delays = {0.1, -0.1, *filter(None, (each.delay for each in replays))}
    late, likelihood = max((refine_shape(plain, effect_candidate(name, first)) for name, first in (
        *(('time_offset', each) for each in delays), ('bandwidth', 0.1))),
        key=lambda each: each[1])
    if p_value(late.cause, likelihood - plain.log_likelihood) > FALSE_ALARM_RATE:
        return replays
    # a lag, of which a delay may be a part, has decayed to less than 1 % after five time constants
    reach = 5.0 * abs(late.shapes[0])
    parts = []
    for each in replays:
        time, within = each.channels.time, min(reach, 0.1 * each.duration)
        parts.append(drop_samples(each, (time < time[0] + within) | (time > time[-1] - within)))
    return parts


def _search_replays(replays: Sequence[Replay], on_progress: OnProgress,
                    without: Collection[str] = ()) -> _Searched:
    """Search for causes, some left out; again where noise is filtered."""
    search = start_search(replays, on_progress, without)
    causes = search_causes(search)
    averaged = average_filtered_noise(fit_causes(search.problem, causes)).problem.replays
    if averaged is not search.problem.replays:
        search = start_search(averaged, on_progress, without)
        causes = search_causes(search)
    return _Searched(search, causes, without)


def _find_settled(fit: RegressionFit) -> Mask | None:
    """
    Return the samples in dwells of a motion if the residual is larger between them, or None.

    The mean squares of the residual are compared stretch by stretch (Mann and Whitney). Dwells of
    less than half the range of rates, such as rests alone, do not show what the motion does.
    """
    replay, = fit.problem.replays
    time, rate = replay.channels.time, np.asarray(replay.channels.rate)
    try:
        dwells = find_dwells(Log(time=time, output=replay.channels.output, reference_rate=rate))
    except DataRefused:
        return None
    if np.ptp(dwells.rate) < 0.5 * np.ptp(rate):
        return None
    within = mark_rows([(rows[0], rows[-1]) for rows in dwells.rows], len(time))
    squares, inside = fit.unbiased_residuals[0][replay.valid] ** 2, within[replay.valid]
    begin = np.concatenate([[0], np.flatnonzero(np.diff(inside)) + 1])
    means = np.add.reduceat(squares, begin) / np.diff(np.append(begin, len(squares)))
    steady, between = means[inside[begin]], means[~inside[begin]]
    if len(replay.shared_errors):
        steady = np.maximum(steady, replay.output_step ** 2 / 12.0)
    if (min(len(steady), len(between)) < MIN_STRETCHES or mannwhitneyu(
            between, steady, alternative='greater').pvalue > FALSE_ALARM_RATE):
        return None
    return within


def _cause_findings(search: Search, fit: RegressionFit, selection: Selection) -> Iterator[Finding]:
    """
    Give the named causes, and the uncertain ones as suspected, each given all named causes.

    A cause that is not significant where the noise has a random walk of any size may be that.
    """
    shapes, replays = search.problem.noise_shapes, fit.problem.replays
    walking = replace(search, problem=search.problem.with_noises([
        place for place, shape in enumerate(shapes[:len(shapes) - search.problem.stated_count])
        if shape.walk_ratio]))
    observed = observed_range(
        [each.channels.rate for each in replays],
        [each.channels.temperature for each in replays
         if 'temperature' in common_channels(replays)], max(each.duration for each in replays))
    for each in explain_selection(search, selection):
        name, place, log_index = each.cause.cause, each.place, each.cause.log_index
        confounders = []
        if each.is_established:
            if p_value(name, evidence_for(walking, each.fit.causes, place)) >= search.rate:
                confounders.append('rate_random_walk')
            each = replace(each, fit=fit)  # without structure that has no name
        known = each.fit.shapes(place)
        if name == 'time_offset':
            (offset,) = known.values()
            if is_sample_offset(offset.estimate, offset.deviation, replays[0].interval):
                confounders.append('unit_error')
        # the evidence of a size of n standard deviations is n² / 2
        threshold = evidence_threshold(name, search.rate) + complexity_penalty(each.cause)
        found = each.finding(
            *each.fit.coefficients(place), known, observed,
            math.sqrt(2.0 * max(threshold, 0.0)) + float(norm.ppf(DETECTION_POWER)),
            float(replays[log_index or 0].channels.time[-1]), confounders)
        yield (found if log_index is None or len(replays) == 1 or not found.evidence else
               replace(found, evidence=f'in log {log_index + 1}, {found.evidence}'))


def _mean_bias_deviation(fit: RegressionFit, noise: Noise) -> float:
    """Return the standard deviation of the mean bias of the logs, rad/s."""
    each = [noise.heading_variance(replay.duration) / replay.duration ** 2
            for replay in fit.problem.replays]
    return float(np.sqrt(np.mean(each) / len(each) + fit.bias_variance))


def _model_value_findings(fit: RegressionFit, model: GyroModel,
                          noise: Noise) -> Iterator[Finding]:
    """Give bias and scale factor error as findings if they differ from those of the model."""
    own = {name: deviation for name, _, _, deviation in model.estimates()
           if math.isfinite(deviation)}
    # A bias within the bias instability and random walk of the model is not a finding.
    likely = Noise(noise.angle_random_walk,
                   *(max(getattr(each, name) for each in (noise, model.noise))
                     for name in NOISE_NAMES[1:]))
    bias = Value(float(np.mean(fit.biases)), _mean_bias_deviation(fit, likely))
    for name, value, confounders in (
            ('bias', bias, ()),
            ('scale_factor_error', fit.scale_factor_error, ('reference_scale',))):
        deviation = math.hypot(value.deviation, own.get(name, 0.0))
        if found := value_finding(name, value.value, deviation, VALUE_ALARM_RATE, confounders):
            yield replace(found, evidence='it adds to the value of the model, '
                          f'{abs(value.value) / deviation:.3g} sigma from zero')


def _untestable_causes(search: Search, logs: Sequence[Log],
                       hidden: Collection[str]) -> dict[str, str]:
    """Return the reason for each cause that these logs cannot show."""
    replays, of_motion = search.problem.replays, {'reference', *REFERENCES}
    has = common_channels(replays) | {'time', 'output'}
    if any(getattr(log, name) is not None for log in logs for name in REFERENCES):
        has |= of_motion
    moves = any(np.any(each.reference[each.valid] != 0.0) for each in replays)
    constant = constant_channels(replays)

    def reason(cause: Cause) -> str:
        if not moves and cause.required_channels & of_motion:
            return 'the reference shows no motion'
        if cause.name in hidden:
            return _HIDDEN_REASON
        if unchanging := sorted(cause.required_channels & constant):
            return _CONSTANT_REASONS[unchanging[0]]
        return ('in these logs it cannot be distinguished from a bias or a scale factor error'
                if cause.name in search.unidentifiable else '')

    needed = {channel for cause in CAUSES.values() for channel in cause.required_channels}
    return untestable_causes((), needed - has, reason)


def _remarks(quality: Sequence[DataQuality], names: Sequence[str], fit: RegressionFit,
             selection: Selection, unmergeable: Sequence[Candidate],
             model: GyroModel | None) -> Iterator[str]:
    """Give remarks on the records, on parts of them, and on the model."""
    for place, clean in enumerate(quality):
        where = f'{names[place]}: ' if len(quality) > 1 and names else ''
        yield from (where + remark for remark in clean.remarks)
    parts = [each.shapes for each in selection.unnamed if each.cause == PART_OF_LOG]
    for begin, end, *_ in parts:
        yield (f'From {begin:.4g} s to {end:.4g} s the scale factor differs from that of the rest '
               'of the log: an effect of a part of the log.')
    if len(parts) > 1:
        yield ('A scale factor that differs from turn to turn is that of odometry whose wheels '
               'slip: if it is the reference, state --reference-kind odometry.')
    scale = fit.scale_factor_error
    own = {term.effect.name for term in ([] if model is None else model.terms)}
    if is_scale_implausible(fit):
        yield (f'A scale factor error of {100.0 * scale.value:.2g} +- '
               f'{100.0 * scale.deviation:.1g} % is not added to the model: the motion is too '
               'small for the noise of gyro and reference, or has one frequency, at which a lag '
               'does the same; turn faster, at several rates, in both directions.')
    for name in dict.fromkeys(each.cause for each in unmergeable):
        remedy = ('; remove that one from the given model, and diagnose again' if name in own
                  else '')
        yield (f'A second {name.replace("_", " ")} is not added to the extended model, as it '
               f'cannot be merged with the first one{remedy}.')


# findings

def _unexplained_structures(search: Search, fit: RegressionFit,
                            unnamed: Sequence[Candidate]) -> list[Unexplained]:
    """Return the structures without a name with the share of the residual that each explains."""
    causes = (*fit.causes, *unnamed)
    variables: dict[str, list[int]] = {}
    for place, known in enumerate(unnamed):
        name = (CAUSES[known.cause].along if is_named(known)
                else unnamed_variable(known))
        variables.setdefault(name, []).append(len(fit.causes) + place)
    least = _residual_variance(fit_causes(search.problem, causes))
    most = _residual_variance(fit_causes(search.problem, fit.causes))
    structures = []
    for name, places in variables.items():
        without = _residual_variance(fit_causes(search.problem, [
            known for place, known in enumerate(causes) if place not in places]))
        chance = min(p_value(causes[place].cause, evidence_for(search, causes, place))
                     for place in places)
        structures.append(Unexplained(name, max(without - least, 0.0) / most, chance))
    return structures


def _residual_variance(fit: RegressionFit) -> float:
    """Return the variance of the residual at the grid points, which have no gaps."""
    return float(np.var(np.concatenate([each.resample(left) for each, left
                                        in zip(fit.problem.replays, fit.unbiased_residuals)])))
