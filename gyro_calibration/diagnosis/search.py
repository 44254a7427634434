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
Search for the causes that the data support, and their confirmation.

Causes are added one by one, the strongest first. The shapes of the candidates are refined before
one is selected, so that a large effect of a slightly wrong shape leaves no residual that other
causes would explain. A cause that is selected is confirmed if it predicts stretches of the logs
that are held out, and if the interval of its size excludes 0.
"""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import combinations
import math
from typing import Any

from gyro_calibration.calibration.likelihood import MIN_FIT_PROBABILITY
from gyro_calibration.calibration.selection import FALSE_ALARM_RATE
from gyro_calibration.diagnosis.candidates import (
    Candidate, fitted_shape_indices, generic_terms, indices_by_cause, is_named, MAX_STEP_TIMES,
    propose_candidates, smooth_shapes, unnamed_variable, with_shape)
from gyro_calibration.diagnosis.causes import (
    cause_finding, cause_parameters, CAUSES, SINGLE_EVENT_REMEDY, slip_times)
from gyro_calibration.diagnosis.findings import (
    Estimate, Finding, MIN_PREDICTION_SIGMAS, OnProgress, prediction_sigmas, RULED_OUT_DEFICIT,
    SEARCH_ALARM_RATE, SUSPECTED_RATE_FACTOR)
from gyro_calibration.diagnosis.regression import (
    build_problem, column_evidence, ColumnGroups, complexity_penalty, fit_causes, forget_fits,
    group_columns, is_single_event, likelihood_with, RegressionFit, VALUE_PENALTY)
from gyro_calibration.diagnosis.replay import Replay
from gyro_calibration.diagnosis.scans import (
    find_slips, find_steps, find_tones, MAX_PER_LOG, Scored)
from gyro_calibration.logs.log import Array, DataRefused, NORMAL_QUANTILE_975
import numpy as np
from scipy.optimize import minimize_scalar
from scipy.special import logsumexp
from scipy.stats import chi2

#: Penalty in log-likelihood of a structure without a name.
_UNNAMED_PENALTY = 4.0
#: Largest numbers of candidates that are refined in each step, and of causes.
_MAX_CONFOUNDERS, MAX_CAUSES = 9, 6
#: Largest number of Gauss-Newton steps.
_MAX_REFINEMENTS = 12

Causes = tuple[Candidate, ...]


def evidence_threshold(cause: str, rate: float) -> float:
    """Return the evidence that noise alone exceeds with a given probability: see `p_value`."""
    return -math.log(rate) if cause in MAX_PER_LOG else 0.5 * float(chi2.isf(rate, 1))


def p_value(cause: str, evidence: float) -> float:
    """
    Return the probability that noise alone reaches an evidence.

    A value of n standard deviations has the evidence n² / 2, and the mean over the shapes of a
    cause is not larger, so that twice the evidence is at most chi-squared with one degree of
    freedom. That of a scanned cause, at the best of all places, is half a chi-squared with two
    degrees of freedom less the logarithm of their number.
    """
    evidence = max(evidence, 0.0)
    return math.exp(-evidence) if cause in MAX_PER_LOG else float(chi2.sf(2.0 * evidence, 1))


@dataclass(frozen=True, eq=False)
class Search:
    """State of a search."""

    problem: Any  # the logs, as of `RegressionProblem`
    candidates: tuple[Candidate, ...]  # causes with their first shapes
    rate: float  # false alarms per cause
    # causes that are scanned for over all frequencies or times -> their candidates, given a fit
    scans: Mapping[str, Callable[[RegressionFit], list[Scored]]]
    # causes that these logs cannot distinguish from bias and scale factor error
    unidentifiable: frozenset[str] = frozenset()
    # is called with None and the name of each step that begins
    on_progress: OnProgress = lambda share, words: None
    finds_several: bool = True  # whether several steps are searched for at once

    def candidate_evidence(self, fit: RegressionFit) -> Array:
        """Return the evidence of each candidate, less the penalty of columns beyond the first."""
        if not self.candidates:
            return np.empty(0)
        # for the rate that the gyro senses, with shapes to two digits
        logs = self.problem.distorted([
            replace(each, shapes=tuple(float(f'{shape:.2g}') for shape in each.shapes))
            for each in fit.causes if each.distorts])
        known = _candidate_columns(self.problem, self.candidates, logs)
        penalty = VALUE_PENALTY * np.array([len(group) - 1.0 for group in known.groups])
        return column_evidence(fit, known) - penalty


@lru_cache(maxsize=2)
def _candidate_columns(problem: Any, candidates: tuple[Candidate, ...],
                       logs: tuple[Any, ...]) -> ColumnGroups:
    parts = [problem.rows(each, logs) for each in candidates]
    ends = np.cumsum([len(part) for part in parts]).tolist()
    return group_columns(problem, np.concatenate(parts), [
        range(end - len(part), end) for end, part in zip(ends, parts)])


def start_search(replays: Sequence[Replay],
                 on_progress: OnProgress = lambda share, words: None,
                 without: Collection[str] = ()) -> Search:
    """Set up a search: candidates, some causes left out, and noises."""
    on_progress(None, 'candidate causes')
    found = tuple(each for each in (*propose_candidates(replays), *generic_terms(replays))
                  if each.cause not in without)
    problem, places = build_problem(replays), indices_by_cause(found)
    fit = fit_causes(problem, [])
    if not np.isfinite(fit.noise_log_likelihood).all():
        raise DataRefused('the residual of the simulation is larger than any noise that is tried; '
                          'check columns and units')
    scans = {'bias_step': find_steps, 'interference_tone': find_tones,
             'reference_slip': find_slips}
    search = Search(problem, found, SEARCH_ALARM_RATE / len(places), {
        cause: scan for cause, scan in scans.items() if cause not in without},
        on_progress=on_progress)
    shown = search.candidate_evidence(fit)
    return replace(search, unidentifiable=frozenset(
        cause for cause, own in places.items() if not np.isfinite(shown[own]).any()))


def restrict_search(search: Search, replays: Sequence[Replay], causes: Collection[str]) -> Search:
    """Return a silent search for some causes, found already, in other parts of the logs."""
    return replace(search, problem=build_problem(replays), rate=FALSE_ALARM_RATE,
                   on_progress=lambda share, words: None,
                   scans={each: scan for each, scan in search.scans.items() if each in causes},
                   candidates=tuple(each for each in search.candidates if each.cause in causes))


def forget_searches() -> None:
    """Release the columns and fits that searches keep for the next ones."""
    for kept in (_candidate_columns, _find_strongest):
        kept.cache_clear()
    forget_fits()


# one more cause

@lru_cache(maxsize=32)
def _find_strongest(search: Search, causes: Causes) -> tuple[Candidate | None, list[Scored]]:
    """
    Search for one more cause.

    Return the best cause, None if none is significant, and all that were refined with their
    log-likelihoods, the best first; if none is significant, those that are suspected.
    """
    fit = fit_causes(search.problem, causes)
    first = _screen_causes(search, fit)
    significant = [each for each, evidence in first
                   if p_value(each.cause, evidence - each.penalty) < search.rate]
    if significant:
        top = max(evidence for _, evidence in first)
        worth = [(each, evidence) for each, evidence in first
                 if (is_named(each) or each in significant) and evidence > 0.8 * top - 8.0]
    else:
        worth = [(each, evidence) for each, evidence in first
                 if _is_lasting(each) and p_value(
                     each.cause, evidence - each.penalty) < SUSPECTED_RATE_FACTOR * search.rate]
    worth.sort(key=lambda each: -each[1])
    steps = sorted((refine_shape(fit, each) for each, _ in worth[:_MAX_CONFOUNDERS]),
                   key=lambda each: -each[1])
    best = None
    if significant:
        # The screening fits a free size at the first shape; after refinement a cause may explain
        # less than its penalty.
        steps = [(each, score) for each, score in steps if score > fit.log_likelihood]
        best = next((each for each, score in steps if p_value(each.cause, min(
            score - fit.log_likelihood, search.problem.robust_evidence(fit, each)[0]))
            < search.rate), None)
    return best, steps


def _screen_causes(search: Search, fit: RegressionFit) -> list[Scored]:
    """
    Return the best first shape of each cause with its evidence.

    Its penalty is the difference to the mean evidence over all first shapes of the cause.
    """
    found = search.candidate_evidence(fit)
    # A second cause of this kind would only correct the shape of the first.
    taken = {each.cause for each in fit.causes if each.amplitude is not None or _is_lasting(each)}
    first = []
    for cause, own in indices_by_cause(search.candidates).items():
        if cause not in taken and np.isfinite(found[own]).any():
            best = max(own, key=lambda place: found[place])
            mean = float(logsumexp(found[own])) - math.log(len(own))
            first.append((replace(search.candidates[best], penalty=float(found[best]) - mean),
                          float(found[best])))
    first += [each for scan in search.scans.values() for each in scan(fit)
              if math.isfinite(each[1])]
    return list({each.cause: (each, evidence) for each, evidence in sorted(
        first, key=lambda scored: scored[1] - scored[0].penalty)}.values())


def refine_shape(fit: RegressionFit, candidate: Candidate) -> Scored:
    """Return a cause with its best shape near the given one, and the likelihood with it."""
    places = fitted_shape_indices(candidate) if candidate.cause != 'reference_slip' else []
    half = candidate.half_width
    half_range = half or 0.8  # in logarithms
    # those of smooth columns follow by Gauss-Newton steps
    for place in places[:1] if smooth_shapes(candidate) else places:
        # those of fixed amplitude that grow with their shapes begin with that of a free amplitude
        if candidate.cause in ('sine_response', 'time_offset', 'bandwidth', 'clock_rate'):
            free = replace(candidate, cause='column', amplitude=None)
            ratio = float(fit_causes(fit.problem, [*fit.causes, free]).coefficients(
                len(fit.causes))[0][0])
            size = math.sqrt(abs(ratio)) if candidate.cause == 'sine_response' else abs(ratio)
            candidate = with_shape(candidate, place,
                                   candidate.shapes[place] * math.copysign(size, ratio))
        start = candidate

        def moved(by: float, start: Candidate = start, place: int = place) -> Candidate:
            first = start.shapes[place]
            return with_shape(start, place, first + by if half else first * math.exp(by))

        best = minimize_scalar(
            lambda by: -likelihood_with(fit, moved(by)), bounds=(-half_range, half_range),
            method='bounded', options={'xatol': 4e-3 * half_range, 'maxiter': 14})
        candidate = moved(best.x)
    more = max(_free_column_count(candidate, fit) - 1, 0)
    return candidate, (likelihood_with(fit, candidate) - VALUE_PENALTY * more
                       - candidate.penalty - (0.0 if is_named(candidate) else _UNNAMED_PENALTY))


def _free_column_count(candidate: Candidate, fit: RegressionFit) -> int:
    return 0 if candidate.amplitude is not None else len(candidate.columns(fit.distorted[0]))


def _is_lasting(candidate: Candidate) -> bool:
    """
    Tell whether a cause acts in all logs and has a free size: only such causes are suspected.

    The refinement of a limit or a delay would fit single peaks.
    """
    return is_named(candidate) and candidate.log_index is None and candidate.amplitude is None


# the growing search

def search_causes(search: Search) -> Causes:
    """
    Return the causes that the data support, with values.

    If structure without a name is found, the search is repeated without generic terms, as the sum
    of several causes along one variable may resemble none of them, and the likelier result is
    used.
    """
    everything = _select_forward(search)
    if all(is_named(each) for each in everything):
        return everything
    # without generic terms nothing tells a part from another structure in time
    named = _select_forward(replace(search, candidates=tuple(filter(is_named, search.candidates)),
                                    finds_several=False))
    return max((everything, named),
               key=lambda causes: fit_causes(search.problem, causes).log_likelihood - sum(
                   complexity_penalty(each)
                   + (0.0 if is_named(each) else _UNNAMED_PENALTY) for each in causes))


def _select_forward(search: Search) -> Causes:
    named: Causes = ()
    for _ in range(2 * MAX_CAUSES):  # some are removed again
        if search.on_progress(None, f'search for causes, {len(named)} found'):
            break
        one_more = _find_strongest(search, named)[0] if len(named) < MAX_CAUSES else None
        more = _with_several(search, named) if one_more is None else (*named, one_more)
        if not more:
            break
        named = _eliminate_backward(search, refine_jointly(search, _divide_delay(search, more)))
    return named


def _divide_delay(search: Search, causes: Causes) -> Causes:
    """Return causes; if the last joins a delay or a lag, with the likeliest shares of both."""
    pair = {each.cause: each for each in causes if each.cause in ('time_offset', 'bandwidth')}
    if len(pair) < 2 or causes[-1].cause not in pair:
        return causes
    delay, lag = pair['time_offset'], pair['bandwidth']
    others = tuple(each for each in causes if each.cause not in pair)
    whole = (delay if lag is causes[-1] else lag).shapes[0]
    first = [each.shapes[0] for each in search.candidates if each.cause == 'bandwidth']
    tried = [(*others, with_shape(delay, 0, whole - share), with_shape(lag, 0, share))
             for share in (lag.shapes[0], *np.geomspace(min(first), max(first), 13).tolist())]
    return max(tried, key=lambda some: fit_causes(search.problem, some).log_likelihood)


def _with_several(search: Search, causes: Causes) -> Causes:
    """
    Return causes with several more, steps of the bias among them; nothing without them.

    A random walk explains several steps, or steps and a drift, about as well as any one of them:
    they are looked for in white noise, and must be significant together. A drift replaces the
    steps that follow it.
    """
    if 'bias_step' not in search.scans or not search.finds_several:
        return ()
    problem, grown, tried = search.problem, causes, []
    white = replace(
        search, scans={}, candidates=tuple(filter(_is_lasting, search.candidates)),
        problem=problem.with_noises([0]))  # white
    while len(grown) < MAX_CAUSES:
        step, evidence = max(search.scans['bias_step'](fit_causes(white.problem, grown)),
                             key=lambda each: each[1] - each[0].penalty)
        # the first of a pair may not be significant alone
        if len(grown) > len(causes) + 1 and p_value(
                'bias_step', evidence - step.penalty) > search.rate:
            break
        grown = _refine_in_turn(white, (*grown, step), len(causes))
        tried.append(grown)
    for drift, _ in sorted(_screen_causes(white, fit_causes(white.problem, grown)),
                           key=lambda each: each[0].penalty - each[1])[:3]:
        tried.append(_eliminate_backward(
            white, _refine_in_turn(white, (*grown, drift), len(causes))))

    def evidence_of(several: Causes) -> float:
        """Return the evidence for several in place of the causes beyond that of noise alone."""
        score, before = (fit_causes(problem, some).log_likelihood
                         - sum(map(complexity_penalty, some)) for some in (several, causes))
        more = max(len(several) - len(causes), 1)
        return score - before - 0.5 * float(chi2.isf(search.rate / len(tried), more))

    def are_apart(several: Causes) -> bool:
        """Tell whether no steps of opposite signs are as near as the ends of a pulse, or a gap."""
        steps = [each for each in several if each.cause == 'bias_step']
        return all(one.log_index != other.log_index or one.values[0] * other.values[0] > 0.0
                   or abs(one.shapes[0] - other.shapes[0]) * (MAX_STEP_TIMES + 1)
                   >= problem.durations[one.log_index or 0]
                   for one, other in combinations(steps, 2))

    best = max(filter(are_apart, tried), key=evidence_of, default=())
    if not best or evidence_of(best) < 0.0:
        return ()
    best = _eliminate_backward(search, _refine_in_turn(search, best, len(causes)))
    return best if len(best) > len(causes) + 1 else ()


def _refine_in_turn(search: Search, causes: Causes, first: int) -> Causes:
    """Refine the shape of each cause from a first on, given the others, and then all together."""
    for place in range(first, len(causes)):
        fit = fit_causes(search.problem, _without(causes, place))
        causes = (*causes[:place], refine_shape(fit, causes[place])[0], *causes[place + 1:])
    return refine_jointly(search, causes)


def _without(causes: Sequence[Candidate], place: int) -> Causes:
    return *causes[:place], *causes[place + 1:]


def refine_jointly(search: Search, causes: Sequence[Candidate]) -> Causes:
    """Refine all shapes and values together by Gauss-Newton steps."""
    current, moved = list(causes), math.inf
    for _ in range(_MAX_REFINEMENTS if causes else 0):
        if moved < 0.1:  # standard deviations
            break
        fit = fit_causes(search.problem, current)
        own = dict(zip(fit.column_owners, zip(
            fit.estimates[0].tolist(), np.sqrt(np.diag(fit.estimates[1])).tolist())))
        # without values, the derivatives by shapes are not in the fit
        moved = 0.0 if all(each.values for each in current) else math.inf
        for place, candidate in enumerate(fit.causes):
            values = tuple(own.get((place, number), (0.0,))[0]
                           for number in range(fit.column_counts[place]))
            for shape in fitted_shape_indices(candidate):
                change, deviation = own.get((place, -1 - shape), (0.0, 1.0))
                moved = max(moved, abs(change) / deviation)
                most = 0.3 * abs(candidate.shapes[shape]) + 3.0 * deviation
                candidate = with_shape(candidate, shape, candidate.shapes[shape]
                                       + float(np.clip(change, -most, most)))
            current[place] = replace(candidate, values=values or (candidate.amplitude or 0.0,))
    return tuple(current)


def evidence_for(search: Search, causes: Sequence[Candidate], cause_index: int) -> float:
    """
    Return the evidence for one of the causes given the others.

    Of two distortions of the rate, such as a delay and a lag, one may stand in for the other:
    without one, the shape of the other is refined.
    """
    known, rest = causes[cause_index], _without(causes, cause_index)
    fit, rest_fit = (fit_causes(search.problem, some) for some in (causes, rest))
    without = rest_fit.log_likelihood
    if known.distorts and any(each.distorts for each in rest):
        without = max(without, fit_causes(
            search.problem, refine_jointly(search, rest)).log_likelihood)
    return min(fit.log_likelihood - without - complexity_penalty(known),
               search.problem.robust_evidence(rest_fit, known)[0])


def _eliminate_backward(search: Search, causes: Causes, kept: Causes = ()) -> Causes:
    """Remove causes that are not significant given the others and some kept, weakest first."""
    while causes:
        chances = [p_value(each.cause, evidence_for(search, (*causes, *kept), place))
                   for place, each in enumerate(causes)]
        weakest = int(np.argmax(chances))
        if chances[weakest] < search.rate:
            break
        causes = refine_jointly(search, _without(causes, weakest))
    return causes


# names

def _withdraw_names(search: Search, causes: Causes) -> tuple[Causes, Causes]:
    """
    Separate named causes from structure without a name.

    A name is withdrawn if structure without a name lies along the same variable, if there are many
    tones, or if a cause along a temperature differs between logs.
    """
    variables = {unnamed_variable(each) for each in causes if not is_named(each)}
    exceeded = {name for variable in variables for name in variable.split(' and ')}
    tones = [each.log_index for each in causes if each.cause == 'interference_tone']
    if any(tones.count(run) >= MAX_PER_LOG['interference_tone'] for run in tones):
        exceeded.add('frequency')
    kept, problem = [], search.problem
    for each in causes:
        if not is_named(each) or CAUSES[each.cause].along in exceeded:
            continue
        # as far as it is one along a temperature, with its own size in each log but the last
        alone = [replace(each, log_index=run, values=()) for run in range(
            len(problem.durations) - 1) if each.amplitude is None
            and CAUSES[each.cause].along in ('temperature', 'temperature_rate')]
        more = 2.0 * (fit_causes(problem, [*causes, *alone]).log_likelihood
                      - fit_causes(problem, causes).log_likelihood) if alone else 0.0
        if not alone or chi2.sf(
                max(more, 0.0), len(each.values) * len(alone)) > MIN_FIT_PROBABILITY:
            kept.append(each)
    if len(kept) == len(causes):
        return causes, ()
    unnamed = tuple(each for each in causes if each not in kept and (
        not is_named(each) or CAUSES[each.cause].along not in variables))
    left = _eliminate_backward(search, refine_jointly(search, (*kept, *unnamed)))
    keys = {(each.cause, each.log_index) for each in kept}
    return tuple(each for each in left if (each.cause, each.log_index) in keys), unnamed


# confirmation

@dataclass(frozen=True)
class Selection:
    """The causes that the data support, and what is left of a search."""

    named: Causes  # confirmed, each the simplest of its alternatives
    # of each named cause, itself included, with deficits in log-likelihood, the best first
    alternatives: Sequence[Mapping[str, float]]
    unnamed: Causes  # structure without a name, and causes whose names it withdraws
    suspected: Causes


def confirm_causes(search: Search, causes: Causes) -> Selection:
    """Withdraw names, confirm the others, and take the simplest of what the data allow."""
    search.on_progress(None, 'alternatives')
    named, unnamed = _withdraw_names(search, causes)
    named, removed = _remove_unconfirmed(search, named, unnamed)
    named, alternatives = _choose_simplest(search, named, unnamed)
    taken = {each.cause for each in named}
    suspected = tuple(each for each in removed if _is_lasting(each) and each.cause not in taken)
    if not suspected:  # one more cause at a higher rate, if there is one
        selected = (*named, *unnamed)
        _, steps = _find_strongest(search, selected)
        rest = fit_causes(search.problem, selected)
        score = rest.log_likelihood
        suspected = tuple(each for each, likelihood in steps if _is_lasting(each)
                          and each.cause not in {other.cause for other in selected} and p_value(
                              each.cause, min(likelihood - score, search.problem.robust_evidence(
                                  rest, each)[0]))
                          < SUSPECTED_RATE_FACTOR * search.rate)[:1]
    return Selection(named, alternatives, unnamed, suspected)


@dataclass(frozen=True)
class SelectedCause:
    """A cause of a selection."""

    fit: RegressionFit  # with all causes of the selection
    place: int  # of the cause among them
    p_value: float  # that noise alone shows as much, given the others
    is_established: bool  # whether it is confirmed
    # what it and its alternatives lack in log-likelihood, the best first
    deficits: Mapping[str, float]
    sizes: Mapping[str, Estimate] = field(default_factory=dict)  # all shapes, if refined

    @property
    def shapes(self) -> dict[str, Estimate]:
        """Return the fitted shapes, by their names."""
        return {**self.fit.shapes(self.place), **self.sizes}

    @property
    def cause(self) -> Candidate:
        """Return the cause with its shapes."""
        known = self.fit.causes[self.place]
        return replace(known, shapes=tuple(each.estimate for each in self.sizes.values())
                       or known.shapes)

    def finding(self, values: Array, covariance: Array, shapes: Mapping[str, Estimate],
                observed: Mapping[str, float], sigmas: float, end: float,
                confounders: Sequence[str] = ()) -> Finding:
        """
        Return the finding: `cause_finding` with the coefficients, their covariance, and shapes.

        Single events are in a part of a log, up to its end, s, or between the first and the last.
        """
        known, where = self.cause, None
        if known.cause == 'bias_step':
            where = known.shapes[0], end
        elif known.cause == 'reference_slip':
            where = min(known.shapes[1:]), max(known.shapes[1:])
            shapes = {**shapes, **slip_times(known.shapes[1:])}
        return cause_finding(
            known.cause, cause_parameters(known.cause, values, covariance, shapes), self.p_value,
            self.deficits, self.is_established, observed, sigmas, confounders, where=where,
            remedy=SINGLE_EVENT_REMEDY if is_single_event(known) else '')


def explain_selection(search: Search, selection: Selection) -> Iterator[SelectedCause]:
    """Give the causes of a selection, the named ones first, then those that are suspected."""
    def explained(causes: Causes, place: int, is_established: bool,
                  deficits: Mapping[str, float]) -> SelectedCause:
        return SelectedCause(fit_causes(search.problem, causes), place, p_value(
            causes[place].cause, evidence_for(search, causes, place)), is_established, deficits)

    causes = (*selection.named, *selection.unnamed)
    for place, deficits in enumerate(selection.alternatives):
        yield explained(causes, place, True, deficits)
    for known in selection.suspected:
        yield explained(refine_jointly(search, (*causes, known)), len(causes), False, {})


def _remove_unconfirmed(search: Search, causes: Causes,
                        unnamed: Causes) -> tuple[Causes, Causes]:
    """
    Separate causes from those that predict no held-out stretches, or may have the size 0.

    A cause whose shape the data do not determine may have any size: its simplest alternative,
    which has no such shape, is tested in its place.
    """
    removed: Causes = ()
    while causes:
        fit, sigmas = fit_causes(search.problem, causes), []
        for place, (known, held_out) in enumerate(zip(causes, held_out_sigmas(search, causes))):
            values, covariance = fit.coefficients(place)
            sizes = [(one.estimate, one.deviation) for one in fit.shapes(place).values()]
            if len(values):
                sizes = [*zip(values.tolist(), np.sqrt(np.diag(covariance)).tolist())]
            # sine or cosine alone may be 0 for a wave that is not
            is_wave = len(sizes) == 2 and known.cause != 'reference_slip'
            size = (math.inf if is_wave or not sizes or not sizes[0][1]
                    else abs(sizes[0][0]) / sizes[0][1])
            sigmas.append(min(held_out / MIN_PREDICTION_SIGMAS, size / NORMAL_QUANTILE_975))
        weakest = int(np.argmin(sigmas))
        if sigmas[weakest] > 1.0:
            break
        simplest, _ = _alternatives(search, causes, weakest, unnamed)
        more = () if simplest is causes[weakest] else (simplest,)
        removed = removed if more else (*removed, causes[weakest])
        causes = refine_jointly(search, causes[:weakest] + more + causes[weakest + 1:])
    return causes, removed


def held_out_sigmas(search: Search, causes: Sequence[Candidate]) -> list[float]:
    """Return the gain of each cause on held-out stretches in standard deviations."""
    full = fit_causes(search.problem, causes)
    gains = [search.problem.held_out_gains(full, fit_causes(
        search.problem, _without(causes, place)), known) for place, known in enumerate(causes)]
    return [math.inf if each is None else prediction_sigmas(each) for each in gains]


def _choose_simplest(search: Search, named: Causes,
                     unnamed: Causes) -> tuple[Causes, list[dict[str, float]]]:
    """
    Replace each cause by its simplest alternative, and remove those that are not significant then.

    Return the causes, and for each itself and its alternatives, with deficits in log-likelihood.
    """
    sets = []
    for place in range(len(named)):
        simplest, members = _alternatives(search, named, place, unnamed)
        if simplest is not named[place]:
            named = refine_jointly(search, (*named[:place], simplest, *named[place + 1:]))
        sets.append(members)
    kept = _eliminate_backward(search, named, unnamed)
    return (named, sets) if kept is named else _choose_simplest(search, kept, unnamed)


def _alternatives(search: Search, named: Causes, place: int,
                  unnamed: Causes) -> tuple[Candidate, dict[str, float]]:
    """Return the simplest alternative of a cause, or itself, and all with their deficits."""
    def size(known: Candidate) -> int:
        """Return the number of fitted values of a cause."""
        return len(fitted_shape_indices(known)) + _free_column_count(known, rest)

    own, others = named[place], (*_without(named, place), *unnamed)
    _, steps = _find_strongest(search, others)
    mine = max((score for each, score in steps if each.cause == own.cause), default=math.inf)
    rest = fit_causes(search.problem, others)
    _, ratio = search.problem.robust_evidence(rest, own)
    members = [(each, lack) for each, score in steps if is_named(each)
               and (lack := (mine - score) / ratio) < RULED_OUT_DEFICIT] or [(own, 0.0)]
    simplest = min((each for each, _ in members), key=size)
    return (simplest if size(simplest) < size(own) else own,
            {each.cause: lack for each, lack in members})
