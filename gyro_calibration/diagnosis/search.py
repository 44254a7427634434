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
Search for the causes that the data support.

Causes are added one by one, the strongest first. The shapes of the candidates are refined before
one is selected, so that a large effect of a slightly wrong shape leaves no residual that other
causes would explain. In the end each cause is removed on trial, to find out whether another one
explains the data better, or none is needed.

"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from dataclasses import field as field_of
import math
from typing import Any, TypeAlias

from gyro_calibration.diagnosis.candidates import (
    Candidate,
    candidate_transforms,
    effect_candidate,
    fitted_shape_indices,
    gaussian_pulse,
    generic_terms,
    indices_by_cause,
    is_named,
    MIN_THERMAL_LAG,
    propose_candidates,
    step_time_spacing,
    with_shape,
)
from gyro_calibration.diagnosis.findings import RULED_OUT_DEFICIT, SUSPECTED_RATE_FACTOR
from gyro_calibration.diagnosis.noise_likelihood import (
    column_evidence,
    draw_residuals,
    Indices,
    log_sum_exp,
    marginalize_nuisances,
    noise_likelihood,
)
from gyro_calibration.diagnosis.regression import (
    add_cause,
    add_nuisance_columns,
    build_problem,
    fit_causes,
    is_rate_distortion,
    RegressionFit,
    RegressionProblem,
    SelectedCause,
    with_distorted_rate,
)
from gyro_calibration.diagnosis.replay import cosine_transform, inverse_cosine_transform, Replay
from gyro_calibration.diagnosis.steps import OnPart
from gyro_calibration.logs.log import Array, DataRefused
import numpy as np
from scipy.optimize import minimize_scalar
from scipy.signal import correlate

#: Residuals of noise alone that are drawn for the distribution of the evidence.
NOISE_DRAWS = 400
#: Most likely noises from which these residuals are drawn, at most.
MAX_DRAWN_NOISES = 60
#: Least penalty of a fitted shape, in log-likelihood.
SHAPE_PENALTY = 2.0
#: Causes without a grid of first shapes: all frequencies or times are scanned.
SCANNED_CAUSES = frozenset({'interference_tone', 'reference_slip'})
#: Largest number of a kind in one log: all slips form one cause, and more tones indicate a
#: disturbance that is not periodic.
MAX_PER_LOG = {'interference_tone': 3, 'reference_slip': 1}
#: Least number of periods of a tone in a log; slower variations are bias wander.
MIN_TONE_PERIODS = 20
#: Durations of a slip of the reference that are tried, s.
SLIP_DURATIONS = (0.0, 0.05, 0.1, 0.2, 0.4)
#: Largest number of slips in a log.
MAX_SLIPS = 20
#: Largest deficit in log-likelihood, relative to the best noise, of the noises that are kept.
MAX_LIKELIHOOD_DEFICIT = 12.0
#: Evidence above which an effect distorts the likelihood of the noises, so that all are kept.
STRONG_EVIDENCE = 60.0
#: Penalty of each column beyond the first, in log-likelihood.
COLUMN_PENALTY = 1.2
#: Additional penalty of a structure without a name, in log-likelihood.
UNNAMED_PENALTY = 4.0
#: Largest number of candidates that are refined in each step.
MAX_CONFOUNDERS = 9
#: Largest number of named causes.
MAX_CAUSES = 6
#: A cause is established if its gain in log-likelihood on held-out stretches exceeds so many
#: standard deviations (one-sided 5 %). The gain of one stretch is limited to a likelihood ratio of
#: 20, so that no single stretch establishes a cause. Number of stretches of all logs together.
MIN_PREDICTION_SIGMAS, MAX_STRETCH_GAIN, STRETCH_COUNT = 1.65, 3.0, 64


@dataclass(frozen=True)
class NullDistribution:
    """
    Distribution of the evidence of causes in noise alone: an exponential tail.

    The evidence exceeds `tail_start` with the probability `tail_probability`, and falls by e every
    `tail_scale`.

    """

    tail_start: Mapping[str, float]
    tail_scale: Mapping[str, float]
    tail_probability: float

    def threshold(self, cause: str, rate: float) -> float:
        """Return the evidence that noise alone exceeds with a given probability."""
        # scanned: its evidence contains the number of places already
        if cause not in self.tail_start:
            return -float(np.log(rate))
        return (self.tail_start[cause]
                + self.tail_scale[cause] * float(np.log(self.tail_probability / rate)))

    def p_value(self, cause: str, evidence: float) -> float:
        """Return the probability that noise alone reaches an evidence."""
        if cause not in self.tail_start:
            return float(np.exp(-max(evidence, 0.0)))
        return min(1.0, self.tail_probability * float(np.exp(
            min(-(evidence - self.tail_start[cause]) / self.tail_scale[cause], 700.0))))


@dataclass(frozen=True)
class CandidateColumns:
    """
    All candidates with their columns, for the rate that the gyro senses.

    Attributes
    ----------
    candidates : causes with their first shapes
    groups : indices of the columns of each candidate
    columns : whitened, shape (p, m)

    """

    candidates: tuple[Candidate, ...]
    groups: tuple[tuple[int, ...], ...]
    columns: Array


def log_mean_exp(logarithms: Array) -> Array:
    """Return the logarithm of the mean of likelihoods along the last axis."""
    return log_sum_exp(logarithms) - np.log(logarithms.shape[-1])


def make_candidate_columns(problem: RegressionProblem, candidates: Sequence[Candidate],
                           causes: Sequence[SelectedCause] = ()) -> CandidateColumns:
    """Compute the whitened columns of candidates."""
    if not candidates:
        return CandidateColumns((), (), np.empty((0, len(problem.deviation))))
    replays = [with_distorted_rate(each, causes) for each in problem.replays]
    parts = [candidate_transforms(each, replays) / problem.deviation for each in candidates]
    ends = np.cumsum([len(part) for part in parts])
    groups = tuple(tuple(range(end - len(part), end)) for end, part in zip(ends, parts))
    return CandidateColumns(tuple(candidates), groups, np.concatenate(parts))


#: Causes with their shapes.
CausesKey: TypeAlias = 'tuple[tuple[Any, ...], ...]'


@dataclass(frozen=True)
class Search:
    """
    State of a search.

    Attributes
    ----------
    problem : the logs
    candidate_columns : columns of all candidates without causes that distort the rate
    null_distribution : distribution of their evidence in noise alone
    rate : false alarms per cause
    scanned_causes : causes that are scanned for over all frequencies or times
    unidentifiable : causes that these logs cannot distinguish from bias and scale factor error
    columns_cache, step_cache : caches of columns and of steps, by the named causes
    on_part : is called with the name of each part of the work as it begins

    """

    problem: RegressionProblem
    candidate_columns: CandidateColumns
    null_distribution: NullDistribution
    rate: float
    scanned_causes: frozenset[str] = SCANNED_CAUSES
    unidentifiable: frozenset[str] = frozenset()
    columns_cache: dict[CausesKey, CandidateColumns] = field_of(default_factory=dict)
    step_cache: dict[CausesKey, tuple[SearchStep | None, list[SearchStep]]] = field_of(
        default_factory=dict)
    on_part: OnPart = lambda words: None

    @property
    def candidates(self) -> tuple[Candidate, ...]:
        """Return all causes with their first shapes."""
        return self.candidate_columns.candidates

    def excess_evidence(self, cause: str, evidence: float, rate_factor: float = 1.0) -> float:
        """Return an evidence less its threshold at so many times the false-alarm rate."""
        return evidence - self.null_distribution.threshold(cause, rate_factor * self.rate)


def screen_candidates(fit: RegressionFit, columns: CandidateColumns) -> Array:
    """Return the evidence of all candidates given the named causes, shape (candidates,)."""
    noises, starts = fit.problem.noises, fit.problem.band_starts
    by = marginalize_nuisances(fit.columns, columns.columns, columns.groups, starts, noises)
    shown = noise_likelihood(fit.residual[None], fit.columns, columns.columns, starts, noises, by)
    return _penalize_columns(column_evidence(shown, by, columns.groups), columns)[0]


def _penalize_columns(evidence: Array, columns: CandidateColumns) -> Array:
    """Return evidence, shape (d, candidates), less the penalty of columns beyond the first."""
    return evidence - COLUMN_PENALTY * np.array([len(group) - 1.0 for group in columns.groups])


def simulate_null_distribution(fit: RegressionFit, columns: CandidateColumns,
                               generator: np.random.Generator) -> NullDistribution:
    """Return the distribution of the evidence of causes in residuals of noise alone."""
    probable = fit.noise_likelihood.probability[0]
    kept = np.sort(np.argsort(-probable)[:MAX_DRAWN_NOISES])
    noises = fit.problem.noises.take(kept)
    starts = fit.problem.band_starts
    by = marginalize_nuisances(fit.columns, columns.columns, columns.groups, starts, noises)
    count = np.diff(np.append(starts, len(fit.residual)))
    single = fit.columns.astype(np.float32), columns.columns.astype(np.float32)
    found = []
    for _ in range(NOISE_DRAWS // 100):
        residuals = draw_residuals(noises, count, probable[kept] / probable[kept].sum(), 100,
                                   generator)
        shown = noise_likelihood(residuals, *single, starts, noises, by)
        found.append(_penalize_columns(column_evidence(shown, by, columns.groups), columns))
    null_evidence = np.concatenate(found)
    start, scale, share = {}, {}, 0.15
    for cause, own in indices_by_cause(columns.candidates).items():
        if not np.isfinite(null_evidence[:, own]).any():
            start[cause], scale[cause] = 0.0, 1.0  # not identifiable in these data
            continue
        ordered = np.sort(log_mean_exp(null_evidence[:, own]))
        most = ordered[int((1.0 - share) * len(ordered)):]
        start[cause], scale[cause] = float(most[0]), max(float((most - most[0]).mean()), 0.7)
    return NullDistribution(start, scale, share)


def start_search(replays: Sequence[Replay], generator: np.random.Generator, rate: float = 0.006,
                 on_part: OnPart = lambda words: None) -> Search:
    """Set up a search: candidates, likely noises, and the distribution of evidence in noise."""
    on_part('candidate causes')
    found = [*propose_candidates(replays), *generic_terms(replays)]
    everywhere = build_problem(replays)
    problem = _drop_unlikely_noises(everywhere, found)
    fit, columns = fit_causes(problem, []), make_candidate_columns(problem, found)
    shown, places = screen_candidates(fit, columns), indices_by_cause(found)
    if shown.max() > STRONG_EVIDENCE:
        problem, fit = everywhere, fit_causes(everywhere, [])
    unidentifiable = frozenset(
        cause for cause, own in places.items() if not np.isfinite(shown[own]).any())
    on_part('significance, by simulated noise')
    return Search(problem, columns, simulate_null_distribution(fit, columns, generator),
                  rate / len(places), unidentifiable=unidentifiable, on_part=on_part)


def restrict_search(search: Search, replays: Sequence[Replay], causes: Collection[str],
                    rate: float) -> Search:
    """Return a search for some causes in other parts of the logs, with a false-alarm rate."""
    found = [each for each in search.candidates if each.cause in causes]
    problem = build_problem(replays)
    return replace(search, problem=problem, rate=rate, columns_cache={}, step_cache={},
                   candidate_columns=make_candidate_columns(problem, found),
                   scanned_causes=SCANNED_CAUSES & frozenset(causes))


def _drop_unlikely_noises(problem: RegressionProblem,
                          candidates: Sequence[Candidate]) -> RegressionProblem:
    """Remove noises that are unlikely both without causes and with one column of each cause."""
    by_cause = indices_by_cause([each for each in candidates if is_named(each)])
    middle = [candidates[places[len(places) // 2]] for places in by_cause.values()]
    tried = [fit.noise_likelihood.log_likelihood[0]
             for fit in (fit_causes(problem, []), fit_causes(problem, [], middle))]
    kept = np.flatnonzero(
        np.any([each > each.max() - MAX_LIKELIHOOD_DEFICIT for each in tried], axis=0))
    if not len(kept):
        raise DataRefused('the residual of the simulation is larger than any noise that is tried; '
                          'check columns and units')
    return replace(problem, noise_shapes=tuple(problem.noise_shapes[place] for place in kept),
                   noises=problem.noises.take(kept))


@dataclass(frozen=True)
class _ScreenedCandidate:
    """A candidate: its evidence, and the mean evidence over all first shapes of its cause."""

    candidate: Candidate
    evidence: float
    mean_evidence: float


# scans over all frequencies and times

def _logs_to_scan(fit: RegressionFit, cause: str) -> list[int]:
    """Return the logs that may contain one more instance of a cause."""
    taken = [known.candidate.log_index for known in fit.causes if known.candidate.cause == cause]
    return [run
            for run in range(len(fit.problem.replays)) if taken.count(run) < MAX_PER_LOG[cause]]


def find_tones(fit: RegressionFit) -> list[_ScreenedCandidate]:
    """Return the strongest tone of all logs; in each, a tone has its own size and phase."""
    found, left = [], fit.whitened_series()
    for run in _logs_to_scan(fit, 'interference_tone'):
        each, white = fit.problem.replays[run], left[run]
        # Zero padding: a tone between two frequencies of the log would lose half of its power.
        power = np.abs(np.fft.rfft(white, 2 * len(white))) ** 2 / len(white)
        lowest = 2 * MIN_TONE_PERIODS
        if len(power) > 2 * lowest:
            best = lowest + int(power[lowest:-2].argmax())
            frequency = _unalias_frequency(each, 0.5 * best / each.duration)
            if each.heading_step and not _is_tone_of_gyro(each, frequency):
                continue
            most, places = float(power[best]) - COLUMN_PENALTY, len(power) * len(left)
            found.append(
                _ScreenedCandidate(effect_candidate('interference_tone', frequency, log_index=run),
                                   most, most - float(np.log(places))))
    return [max(found, key=lambda one: one.mean_evidence)] if found else []


def _unalias_frequency(replay: Replay, frequency: float) -> float:
    """Return the frequency of a tone before averaging: the strongest of its aliases."""
    if replay.decimation == 1:
        return frequency
    samples = replace(replay, decimation=1)
    power = np.abs(np.fft.rfft(samples.resample(replay.channels.output - replay.reference),
                               2 * samples.point_count)) ** 2
    alias_frequencies = np.arange(replay.decimation // 2 + 1) / replay.point_interval
    places = (2.0 * samples.duration
              * np.concatenate([alias_frequencies + frequency, alias_frequencies[1:] - frequency]))

    def relative_power(at: float) -> float:
        """Return the ratio of the power at a frequency to that of its neighbours."""
        place = round(at)
        usual = np.median(power[max(place - 60, 0):place + 61])
        return float(power[place - 2:place + 3].max() / usual)

    best = max(places[places < len(power) - 3], key=relative_power)
    return float(best) / (2.0 * samples.duration)


def _is_tone_of_gyro(replay: Replay, frequency: float) -> bool:
    """Tell whether a tone is in the output, not only in the reference of an encoder."""
    wave = np.exp(-2.0j * np.pi * frequency * replay.channels.time[replay.valid])
    output, reference = (np.abs(np.mean(values[replay.valid] * wave))
                         for values in (replay.channels.output, replay.reference))
    return bool(output > 0.7 * reference)


def find_slips(fit: RegressionFit) -> list[_ScreenedCandidate]:
    """Return the clearest jumps of the reference's heading, where it accelerates."""
    found = []
    parts = np.cumsum([each.point_count - 1 for each in fit.problem.replays])[:-1]
    divided = np.split(fit.problem.whitening_factors(
        int(fit.noise_likelihood.log_likelihood[0].argmax())) / fit.problem.deviation, parts)
    left = fit.whitened_series()
    for run in _logs_to_scan(fit, 'reference_slip'):
        each, white, factor = fit.problem.replays[run], left[run], divided[run]
        acceleration = np.abs(np.gradient(each.resample(each.channels.rate), each.point_interval))
        moments = np.flatnonzero(acceleration > 0.2 * acceleration.max())
        if acceleration.max() > 0.0 and len(moments):
            tried = [_fit_slips(each, run, white, factor, moments,
                                max(width, 0.5 * each.point_interval)) for width in SLIP_DURATIONS]
            # The largest number indicates a continuous disturbance, not slips.
            if max(len(one.candidate.shapes) - 1 for one in tried) < MAX_SLIPS:
                found += tried
    return [max(found, key=lambda one: one.mean_evidence)] if found else []


def _fit_slips(replay: Replay, log_index: int, white: Array, factor: Array, indices: Indices,
               width: float) -> _ScreenedCandidate:
    """Return slips of one duration, at least 1 s apart, with evidence for the times scanned."""
    time = np.arange(replay.point_count) * replay.point_interval
    likely = float(np.log(len(indices) * len(SLIP_DURATIONS)))
    size, deviation = _matched_filter(white, factor, time, width)
    wide, _ = _matched_filter(white, factor, time, 5.0 * width + 0.3)
    value = 0.5 * (size[indices] / deviation) ** 2 - likely - COLUMN_PENALTY
    # A slip is permanent; the sum of a temporary error over a longer time is 0. The rounding error
    # of an encoder is constant at rest, and differs by up to a step between two rests.
    is_temporary = wide[indices] / size[indices] < 0.3
    value[is_temporary | (np.abs(size[indices]) <= replay.heading_step)] = -np.inf
    chosen: list[float] = []
    total = 0.0
    for place in np.argsort(-value)[:200]:
        single = _isolated_point(replay, int(indices[place]), width)
        if single is not None and not _is_jump_of_reference(replay, float(time[single])):
            continue
        if (value[place] <= 0.0 and chosen) or len(chosen) == MAX_SLIPS:
            break
        at = float(replay.channels.time[replay.valid][0] + time[indices[place]])
        if all(abs(at - other) > 1.0 for other in chosen):
            chosen.append(at)
            total += float(value[place])
    return _ScreenedCandidate(
        effect_candidate('reference_slip', width, *chosen, log_index=log_index),
        total + likely * len(chosen), total if chosen else -np.inf)


def _matched_filter(white: Array, whitening_factor: Array, time: Array,
                    width: float) -> tuple[Array, float]:
    """Return the size of a pulse at each time, rad, and its standard deviation."""
    kernel = inverse_cosine_transform(
        cosine_transform(gaussian_pulse(time, time[len(time) // 2], width)) * whitening_factor)
    return (correlate(white, kernel, 'same') / (kernel @ kernel),
            float(1.0 / np.sqrt(kernel @ kernel)))


def _isolated_point(replay: Replay, index: int, width: float) -> int | None:
    """Return the point near another that has most of the deviation; None if there are several."""
    left = replay.resample(replay.channels.output - replay.channels.rate)
    reach = max(3, round(2.0 * width / replay.point_interval))
    begin = max(index - reach, 0)
    near = left[begin:index + reach + 1]
    off = (near - np.median(near)) ** 2
    return (begin + int(off.argmax()) if off.max() > max(40.0 * np.median(off), 0.4 * off.sum())
            else None)


def _is_jump_of_reference(replay: Replay, moment: float) -> bool:
    """Tell whether the reference jumps more than the output at a time."""
    at = int(np.clip(np.searchsorted(replay.channels.time[replay.valid],
                                     moment + replay.channels.time[replay.valid][0]),
                     3, replay.valid.sum() - 4))
    off = [np.abs(np.diff(values[replay.valid][at - 3:at + 4], 2)).max()
           for values in (replay.reference, replay.channels.output)]
    return bool(off[0] > off[1])


# one more cause

def _columns_given_causes(search: Search, causes: Sequence[SelectedCause]) -> CandidateColumns:
    """Return all candidates for the rate that the gyro senses, with shapes to two digits."""
    changes = [each for each in causes if is_rate_distortion(each.candidate.cause)]
    key = tuple((each.candidate.cause, *(float(f'{shape:.2g}') for shape in each.candidate.shapes))
                for each in changes)
    if not changes:
        return search.candidate_columns
    if key not in search.columns_cache:
        search.columns_cache.clear()  # one is hundreds of megabytes
        search.columns_cache[key] = make_candidate_columns(
            search.problem, search.candidates, changes)
    return search.columns_cache[key]


@dataclass(frozen=True)
class SearchStep:
    """A list of causes and its score."""

    causes: tuple[SelectedCause, ...]
    score: float


def refine_shape(fit: RegressionFit, candidate: Candidate, penalty: float) -> SearchStep:
    """
    Add a cause with its best shape near the given one.

    Parameters
    ----------
    fit : fit to which the cause is added
    candidate : the cause
    penalty : penalty for the choice of its shape, in log-likelihood

    """
    if not fitted_shape_indices(candidate) or candidate.cause == 'reference_slip':
        done = add_cause(fit, candidate)
        columns = COLUMN_PENALTY * max(done.column_counts[-1] - 1, 0)
        margin = 0.0 if is_named(candidate) else UNNAMED_PENALTY
        return SearchStep((*fit.causes, SelectedCause(candidate, penalty=penalty)),
                          done.log_likelihood - columns - penalty - margin)
    begin = candidate if candidate.amplitude is None else _linearized_start(fit, candidate)
    place = fitted_shape_indices(candidate)[0]
    low, high = _shape_bounds(fit.original_replays, begin, place)

    def cost(at: float) -> float:
        return -add_cause(fit,
                          with_shape(begin, place, _to_shape(at, begin, place))).log_likelihood

    best = minimize_scalar(cost, bounds=(low, high), method='bounded',
                           options={'xatol': 2e-3 * (high - low), 'maxiter': 14})
    columns = COLUMN_PENALTY if candidate.cause == 'interference_tone' else 0.0
    found = SelectedCause(with_shape(begin, place, _to_shape(best.x, begin, place)),
                          penalty=penalty)
    return SearchStep((*fit.causes, found), -float(best.fun) - penalty - columns)


def _to_shape(search_value: float, candidate: Candidate, shape_index: int) -> float:
    return (search_value if candidate.cause == 'bias_step'
            else float(np.copysign(np.exp(search_value), candidate.shapes[shape_index])))


def _shape_bounds(replays: Sequence[Replay], candidate: Candidate,
                  shape_index: int) -> tuple[float, float]:
    """Return the bounds of the search for a shape, in logarithms except for times."""
    shape = candidate.shapes[shape_index]
    if candidate.cause == 'bias_step':
        width = 1.5 * max(step_time_spacing(each, len(replays)) for each in replays)
        return shape - width, shape + width
    if candidate.amplitude is not None:
        return float(np.log(abs(shape))) - 0.7, float(np.log(abs(shape))) + 0.7
    if candidate.cause == 'interference_tone':
        width = 1.0 / (shape * replays[candidate.log_index or 0].duration)
        return float(np.log(shape)) - width, float(np.log(shape)) + width
    width = 0.8
    low = float(np.log(MIN_THERMAL_LAG)) if candidate.cause == 'thermal_lag' else -np.inf
    return max(float(np.log(abs(shape))) - width, low), float(np.log(abs(shape))) + width


#: Exponent with which an effect grows with its shape.
_SHAPE_EXPONENTS = {'sine_response': 2.0, 'time_offset': 1.0, 'bandwidth': 1.0, 'clock_rate': 1.0}


def _linearized_start(fit: RegressionFit, candidate: Candidate) -> Candidate:
    """Return a cause of fixed amplitude with the shape that a fit of its amplitude suggests."""
    if candidate.cause not in _SHAPE_EXPONENTS:
        return candidate
    own = candidate_transforms(candidate, fit.problem.replays) / fit.problem.deviation
    free = add_nuisance_columns(fit, own)
    ratio, place = float(free.estimates[0][-1]), fitted_shape_indices(candidate)[0]
    factor = math.copysign(abs(ratio) ** (1.0 / _SHAPE_EXPONENTS[candidate.cause]), ratio)
    return with_shape(candidate, place, candidate.shapes[place] * factor)


def find_strongest(search: Search,
                   causes: Sequence[SelectedCause]) -> tuple[SearchStep | None, list[SearchStep]]:
    """
    Search for one more cause.

    Returns
    -------
    the best step, None if no cause is significant, and all refined steps, the best first; if no
    cause is significant, those of suspected causes

    """
    key = tuple((each.candidate.cause, each.candidate.log_index, *each.candidate.shapes)
                for each in causes)
    if key not in search.step_cache:
        search.on_part(f'search for causes after {len(causes)} found' if causes
                       else 'search for causes')
        search.step_cache[key] = _search_strongest(search, causes)
    return search.step_cache[key]


def _search_strongest(search: Search, causes: Sequence[SelectedCause],
                      ) -> tuple[SearchStep | None, list[SearchStep]]:
    fit = fit_causes(search.problem, causes)
    first = _screen_causes(search, fit, causes)
    if not any(search.excess_evidence(each.candidate.cause, each.mean_evidence) > 0.0
               for each in first):
        found = [refine_shape(fit, each.candidate, each.evidence - each.mean_evidence)
                 for each in first if is_lasting(each.candidate)
                 and search.excess_evidence(each.candidate.cause, each.mean_evidence,
                                            SUSPECTED_RATE_FACTOR) > 0.0]
        return None, sorted(found, key=lambda step: -step.score)
    top = max(first, key=lambda each: each.evidence)
    # Causes that distort the rate are equal to first order; large ones need refined shapes.
    alike = is_rate_distortion(top.candidate.cause)
    worth = [each for each in first if each.evidence > 0.8 * top.evidence - 8.0
             or (alike and is_rate_distortion(each.candidate.cause))]
    worth = [each for each in worth if is_named(each.candidate)
             or search.excess_evidence(each.candidate.cause, each.mean_evidence) > 0.0]
    worth.sort(key=lambda each: -each.evidence)
    steps = [refine_shape(fit, each.candidate, each.evidence - each.mean_evidence)
             for each in worth[:MAX_CONFOUNDERS]]
    # The screening fits a free size at the first shape; after refinement a cause may explain less
    # than its penalty.
    steps = sorted((step for step in steps if step.score > fit.log_likelihood),
                   key=lambda step: -step.score)
    beyond = (step for step in steps if search.excess_evidence(
        step.causes[-1].candidate.cause, step.score - fit.log_likelihood) > 0.0)
    return next(beyond, None), steps


def is_lasting(candidate: Candidate) -> bool:
    """
    Tell whether a cause acts in all logs and has a free size: only such causes are suspected.

    A limit or a delay has no size apart from its shape, and its refinement would fit single peaks.

    """
    return is_named(candidate) and candidate.log_index is None and candidate.amplitude is None


def find_suspected(search: Search, selected: Sequence[SelectedCause]) -> SearchStep | None:
    """Return the named causes and one more, at `SUSPECTED_RATE_FACTOR` times the rate."""
    _, steps = find_strongest(search, selected)
    score = fit_causes(search.problem, selected).log_likelihood if steps else 0.0
    cause_names = {each.candidate.cause for each in selected}
    for step in steps:
        candidate = step.causes[-1].candidate
        if (is_lasting(candidate) and candidate.cause not in cause_names
                and search.excess_evidence(candidate.cause, step.score - score,
                                           SUSPECTED_RATE_FACTOR) > 0.0):
            return step
    return None


def _screen_causes(search: Search, fit: RegressionFit,
                   causes: Sequence[SelectedCause]) -> list[_ScreenedCandidate]:
    """Return the best first shape of each cause."""
    found = screen_candidates(fit, _columns_given_causes(search, causes))
    # A second cause without a free size would only correct the shape of the first.
    taken = {each.candidate.cause for each in causes if each.candidate.amplitude is not None}
    first = [_ScreenedCandidate(search.candidates[max(own, key=lambda place: found[place])],
                                float(found[own].max()), float(log_mean_exp(found[own])))
             for cause, own in indices_by_cause(search.candidates).items()
             if cause not in taken and np.isfinite(found[own]).any()]
    scans = {'interference_tone': find_tones, 'reference_slip': find_slips}
    return first + [each for cause in sorted(search.scanned_causes) for each in scans[cause](fit)
                    if np.isfinite(each.mean_evidence)]


def refine_jointly(search: Search, causes: Sequence[SelectedCause]) -> tuple[SelectedCause, ...]:
    """Refine all shapes and values together by Gauss-Newton steps."""
    current = tuple(causes)
    for _ in range(3 if causes else 0):
        done = fit_causes(search.problem, current)
        values, _ = done.estimates
        current = tuple(_gauss_newton_update(done, place, values) for place in range(len(current)))
    return current


def _gauss_newton_update(fit: RegressionFit, cause_index: int, values: Array) -> SelectedCause:
    known = fit.causes[cause_index]
    own = dict(zip(fit.column_owners, values))
    free = tuple(float(own.get((cause_index, number), 0.0))
                 for number in range(fit.column_counts[cause_index]))
    found = free or (known.candidate.amplitude or 0.0,)
    candidate = known.candidate
    for shape in fitted_shape_indices(candidate):
        change = own.get((cause_index, -1 - shape), 0.0)
        before = candidate.shapes[shape]
        candidate = with_shape(candidate, shape, before
                               + float(np.clip(change, -0.3 * abs(before), 0.3 * abs(before))))
    return replace(known, candidate=candidate, values=found or known.values)


def search_causes(search: Search) -> tuple[SelectedCause, ...]:
    """
    Return the causes that the data support, with values.

    The sum of several causes along one variable may resemble none of them. So if structure without
    a name is found, the search is repeated without generic terms, and the likelier result is used.

    """
    everything = _select_forward(search)
    if all(is_named(each.candidate) for each in everything):
        return everything
    nameable = [each for each in search.candidates if is_named(each)]
    named = _select_forward(
        replace(search, candidate_columns=make_candidate_columns(search.problem, nameable),
                columns_cache={}, step_cache={}))
    return max((everything, named),
               key=lambda named: fit_causes(search.problem, named).log_likelihood - sum(
                   complexity_penalty(each)
                   + (0.0 if is_named(each.candidate) else UNNAMED_PENALTY) for each in named))


def complexity_penalty(cause: SelectedCause) -> float:
    """Return the penalty of shapes and columns of a cause, in log-likelihood."""
    shapes = max(cause.penalty, SHAPE_PENALTY * len(fitted_shape_indices(cause.candidate)))
    return shapes + COLUMN_PENALTY * max(len(cause.values) - 1, 0)


def _select_forward(search: Search) -> tuple[SelectedCause, ...]:
    """Add causes one by one (forward selection)."""
    named: tuple[SelectedCause, ...] = ()
    for _ in range(2 * MAX_CAUSES):  # some are removed again
        step, _ = find_strongest(search, named) if len(named) < MAX_CAUSES else (None, [])
        if step is None:
            break
        named = refine_jointly(search, step.causes)
        if len(named) > 1:
            named = eliminate_backward(search, named)
    return _exchange_causes(search, eliminate_backward(search, named))


def eliminate_backward(search: Search,
                       causes: tuple[SelectedCause, ...]) -> tuple[SelectedCause, ...]:
    """Remove causes that are not significant given the others, the weakest first."""
    return remove_weakest(search, causes, lambda some: [
        search.excess_evidence(each.candidate.cause, evidence_for(search, some, place))
        for place, each in enumerate(some)], 0.0)[0]


def remove_weakest(search: Search, causes: tuple[SelectedCause, ...],
                   strength_of: Callable[[tuple[SelectedCause, ...]], Sequence[float]],
                   threshold: float) -> tuple[tuple[SelectedCause, ...], list[SelectedCause]]:
    """Remove the weakest cause and refine the others until all exceed a strength."""
    removed: list[SelectedCause] = []
    while causes:
        found = strength_of(causes)
        weakest = int(np.argmin(found))
        if found[weakest] > threshold:
            break
        removed.append(causes[weakest])
        causes = refine_jointly(search, causes[:weakest] + causes[weakest + 1:])
    return causes, removed


def _exchange_causes(search: Search,
                     causes: tuple[SelectedCause, ...]) -> tuple[SelectedCause, ...]:
    """Remove each cause on trial, and replace it if another is better or none is needed."""
    for known in causes[:-1]:
        others = tuple(each for each in causes if each is not known)
        step, _ = find_strongest(search, others)
        if step is None:
            return refine_jointly(search, others)
        if (step.causes[-1].candidate.cause != known.candidate.cause
                and step.score > fit_causes(search.problem, causes).log_likelihood + 1.0):
            return refine_jointly(search, step.causes)
    return causes


def find_alternatives(search: Search, causes: tuple[SelectedCause, ...],
                      cause_index: int) -> list[tuple[SelectedCause, float]]:
    """Return a named cause and its alternatives, with their deficits in log-likelihood."""
    cause = causes[cause_index].candidate.cause
    _, steps = find_strongest(search, causes[:cause_index] + causes[cause_index + 1:])
    mine = max((step.score for step in steps if step.causes[-1].candidate.cause == cause),
               default=np.inf)
    return [(step.causes[-1], mine - step.score) for step in steps
            if mine - step.score < RULED_OUT_DEFICIT and is_named(step.causes[-1].candidate)]


def evidence_for(search: Search, causes: Sequence[SelectedCause], cause_index: int) -> float:
    """Return the evidence for one of the causes given the others."""
    others = tuple(each for number, each in enumerate(causes) if number != cause_index)
    return (fit_causes(search.problem, causes).log_likelihood
            - fit_causes(search.problem, others).log_likelihood
            - complexity_penalty(causes[cause_index]))


def prediction_sigmas(log_likelihood_gains: Array) -> float:
    """Return the gain of held-out stretches in log-likelihood over its standard deviation."""
    clipped_gains = np.clip(log_likelihood_gains, -MAX_STRETCH_GAIN, MAX_STRETCH_GAIN)
    scatter = float(np.std(clipped_gains, ddof=1)) * len(log_likelihood_gains) ** 0.5
    return (float(np.sum(clipped_gains)) / max(scatter, 1e-9) if np.sum(log_likelihood_gains) > 0.0
            else 0.0)


def held_out_sigmas(search: Search, causes: Sequence[SelectedCause]) -> list[float]:
    """
    Return the gain of each cause on held-out stretches in standard deviations.

    The contribution of a cause, given the others, is scaled to fit best without each stretch in
    turn. Slips are single events, and are not required to predict other stretches.

    """
    full, found = fit_causes(search.problem, causes), []
    left = full.whitened_series()
    count = max(STRETCH_COUNT // len(left), 1)
    stretch = np.concatenate([run * count + np.arange(len(each)) * count // len(each)
                              for run, each in enumerate(left)])
    off = np.concatenate(left)
    for place, known in enumerate(causes):
        if known.candidate.cause == 'reference_slip':
            found.append(math.inf)
            continue
        rest = fit_causes(search.problem, [*causes[:place], *causes[place + 1:]])
        before = np.concatenate(rest.whitened_series(full))
        added = before - off
        score, information = (np.bincount(stretch, each) for each in (added * off, added ** 2))
        size = 1.0 - score / np.maximum(information.sum() - information, 1e-300)
        found.append(prediction_sigmas(
            0.5 * np.bincount(stretch, before ** 2 - (before - size[stretch] * added) ** 2)))
    return found
