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
    by_cause,
    Candidate,
    candidates,
    columns_of,
    effect,
    FASTEST_LAG,
    fitted_shapes,
    generic_terms,
    is_named,
    pulse,
    spacing_of_steps,
    with_shape,
)
from gyro_calibration.diagnosis.findings import RULED_OUT, SUSPECTED
from gyro_calibration.diagnosis.noise_likelihood import (
    drawn,
    evidence,
    log_sum,
    marginalized,
    noise_likelihood,
    Places,
)
from gyro_calibration.diagnosis.regression import (
    Fitted,
    fitted,
    is_of_the_rate,
    Named,
    regression_problem,
    RegressionProblem,
    seen,
    with_columns,
    with_one_more,
)
from gyro_calibration.diagnosis.replay import inverse, Replay, transform
from gyro_calibration.diagnosis.steps import OnPart
from gyro_calibration.logs.log import Array, DataRefused
import numpy as np
from scipy.optimize import minimize_scalar
from scipy.signal import correlate

#: Residuals of noise alone that are drawn for the distribution of the evidence.
DRAWS = 400
#: Most likely noises from which these residuals are drawn, at most.
MOST_NOISES = 60
#: Least penalty of a fitted shape, in log-likelihood.
PRICE_OF_SHAPE = 2.0
#: Causes without a grid of first shapes: all frequencies or times are scanned.
SCANNED = frozenset({'interference_tone', 'reference_slip'})
#: Largest number of a kind in one log: all slips form one cause, and more tones indicate a
#: disturbance that is not periodic.
MOST_OF = {'interference_tone': 3, 'reference_slip': 1}
#: Least number of periods of a tone in a log; slower variations are bias wander.
LEAST_PERIODS = 20
#: Durations of a slip of the reference that are tried, s.
WIDTHS = (0.0, 0.05, 0.1, 0.2, 0.4)
#: Largest number of slips in a log.
MOST_SLIPS = 20
#: Largest deficit in log-likelihood, relative to the best noise, of the noises that are kept.
UNLIKELY = 12.0
#: Evidence above which an effect distorts the likelihood of the noises, so that all are kept.
STRONG = 60.0
#: Penalty of each column beyond the first, in log-likelihood.
PRICE_OF_COLUMN = 1.2
#: Additional penalty of a structure without a name, in log-likelihood.
MARGIN = 4.0
#: Largest number of candidates that are refined in each step.
MOST_CONFOUNDERS = 9
#: Largest number of named causes.
MOST_CAUSES = 6
#: A cause is established if its gain in log-likelihood on held-out stretches exceeds so many
#: standard deviations (one-sided 5 %). The gain of one stretch is limited to a likelihood ratio of
#: 20, so that no single stretch establishes a cause. Number of stretches of all logs together.
SURELY, BOUND, STRETCHES = 1.65, 3.0, 64


@dataclass(frozen=True)
class Chance:
    """
    Distribution of the evidence of causes in noise alone: an exponential tail.

    The evidence exceeds `start` with the probability `share`, and falls by e every `scale`.

    """

    start: Mapping[str, float]
    scale: Mapping[str, float]
    share: float

    def threshold(self, cause: str, rate: float) -> float:
        """Return the evidence that noise alone exceeds with a given probability."""
        if cause not in self.start:  # scanned: its evidence contains the number of places already
            return -float(np.log(rate))
        return self.start[cause] + self.scale[cause] * float(np.log(self.share / rate))

    def p_value(self, cause: str, found: float) -> float:
        """Return the probability that noise alone reaches an evidence."""
        if cause not in self.start:
            return float(np.exp(-max(found, 0.0)))
        return min(1.0, self.share * float(np.exp(
            min(-(found - self.start[cause]) / self.scale[cause], 700.0))))


@dataclass(frozen=True)
class Bank:
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


def averaged(found: Array) -> Array:
    """Return the logarithm of the mean of likelihoods along the last axis."""
    return log_sum(found) - np.log(found.shape[-1])


def bank(whole: RegressionProblem, found: Sequence[Candidate],
         named: Sequence[Named] = ()) -> Bank:
    """Compute the whitened columns of candidates."""
    if not found:
        return Bank((), (), np.empty((0, len(whole.deviation))))
    replays = [seen(each, named) for each in whole.replays]
    parts = [columns_of(each, replays) / whole.deviation for each in found]
    ends = np.cumsum([len(part) for part in parts])
    groups = tuple(tuple(range(end - len(part), end)) for end, part in zip(ends, parts))
    return Bank(tuple(found), groups, np.concatenate(parts))


#: Causes with their shapes.
Key: TypeAlias = 'tuple[tuple[Any, ...], ...]'


@dataclass(frozen=True)
class Search:
    """
    State of a search.

    Attributes
    ----------
    problem : the logs
    bank : columns of all candidates without causes that distort the rate
    chance : distribution of their evidence in noise alone
    rate : false alarms per cause
    scanned : causes that are scanned for over all frequencies or times
    unidentifiable : causes that these logs cannot distinguish from bias and scale factor error
    banks, found_before : caches of columns and of steps, by the named causes
    on_part : is called with the name of each part of the work as it begins

    """

    problem: RegressionProblem
    bank: Bank
    chance: Chance
    rate: float
    scanned: frozenset[str] = SCANNED
    unidentifiable: frozenset[str] = frozenset()
    banks: dict[Key, Bank] = field_of(default_factory=dict)
    found_before: dict[Key, tuple[Step | None, list[Step]]] = field_of(default_factory=dict)
    on_part: OnPart = lambda words: None

    @property
    def candidates(self) -> tuple[Candidate, ...]:
        """Return all causes with their first shapes."""
        return self.bank.candidates

    def excess(self, cause: str, found: float, times: float = 1.0) -> float:
        """Return an evidence less its threshold at so many times the false-alarm rate."""
        return found - self.chance.threshold(cause, times * self.rate)


def screen(done: Fitted, stock: Bank) -> Array:
    """Return the evidence of all candidates given the named causes, shape (candidates,)."""
    noises, starts = done.problem.noises, done.problem.starts
    by = marginalized(done.columns, stock.columns, stock.groups, starts, noises)
    shown = noise_likelihood(done.residual[None], done.columns, stock.columns, starts, noises, by)
    return _priced(evidence(shown, by, stock.groups), stock)[0]


def _priced(found: Array, stock: Bank) -> Array:
    """Return evidence, shape (d, candidates), less the penalty of columns beyond the first."""
    return found - PRICE_OF_COLUMN * np.array([len(group) - 1.0 for group in stock.groups])


def chances(done: Fitted, stock: Bank, generator: np.random.Generator) -> Chance:
    """Return the distribution of the evidence of causes in residuals of noise alone."""
    probable = done.by_noise.probability[0]
    kept = np.sort(np.argsort(-probable)[:MOST_NOISES])
    noises = done.problem.noises.take(kept)
    starts = done.problem.starts
    by = marginalized(done.columns, stock.columns, stock.groups, starts, noises)
    count = np.diff(np.append(starts, len(done.residual)))
    single = done.columns.astype(np.float32), stock.columns.astype(np.float32)
    found = []
    for _ in range(DRAWS // 100):
        residuals = drawn(noises, count, probable[kept] / probable[kept].sum(), 100, generator)
        shown = noise_likelihood(residuals, *single, starts, noises, by)
        found.append(_priced(evidence(shown, by, stock.groups), stock))
    every = np.concatenate(found)
    start, scale, share = {}, {}, 0.15
    for cause, own in by_cause(stock.candidates).items():
        if not np.isfinite(every[:, own]).any():
            start[cause], scale[cause] = 0.0, 1.0  # not identifiable in these data
            continue
        most = np.sort(averaged(every[:, own]))[int((1.0 - share) * len(every)):]
        start[cause], scale[cause] = float(most[0]), max(float((most - most[0]).mean()), 0.7)
    return Chance(start, scale, share)


def begin(replays: Sequence[Replay], generator: np.random.Generator, rate: float = 0.006,
          on_part: OnPart = lambda words: None) -> Search:
    """Set up a search: candidates, likely noises, and the distribution of evidence in noise."""
    on_part('candidate causes')
    found = [*candidates(replays), *generic_terms(replays)]
    everywhere = regression_problem(replays)
    whole = _of_likely_noises(everywhere, found)
    done, stock = fitted(whole, []), bank(whole, found)
    shown, places = screen(done, stock), by_cause(found)
    if shown.max() > STRONG:
        whole, done = everywhere, fitted(everywhere, [])
    hidden = frozenset(cause for cause, own in places.items()
                       if not np.isfinite(shown[own]).any())
    on_part('significance, by simulated noise')
    return Search(whole, stock, chances(done, stock, generator), rate / len(places),
                  unidentifiable=hidden, on_part=on_part)


def relaid(search: Search, replays: Sequence[Replay], causes: Collection[str],
           rate: float) -> Search:
    """Return a search for some causes in other parts of the logs, with a false-alarm rate."""
    found = [each for each in search.candidates if each.cause in causes]
    whole = regression_problem(replays)
    return replace(search, problem=whole, bank=bank(whole, found), rate=rate,
                   scanned=SCANNED & frozenset(causes), banks={}, found_before={})


def _of_likely_noises(whole: RegressionProblem, found: Sequence[Candidate]) -> RegressionProblem:
    """Remove noises that are unlikely both without causes and with one column of each cause."""
    middle = [places[len(places) // 2]
              for places in by_cause([each for each in found if is_named(each)]).values()]
    tried = [each.by_noise for each in (fitted(whole, []),
                                        fitted(whole, [], [found[place] for place in middle]))]
    kept = np.flatnonzero(np.any([each.likelihood[0] > each.likelihood[0].max() - UNLIKELY
                                  for each in tried], axis=0))
    if not len(kept):
        raise DataRefused('the residual of the simulation is larger than any noise that is tried; '
                          'check columns and units')
    return replace(whole, shapes=tuple(whole.shapes[place] for place in kept),
                   noises=whole.noises.take(kept))


@dataclass(frozen=True)
class _First:
    """A candidate: its evidence, and the mean evidence over all first shapes of its cause."""

    candidate: Candidate
    most: float
    mean: float


# scans over all frequencies and times

def _runs(done: Fitted, cause: str) -> list[int]:
    """Return the logs that may contain one more instance of a cause."""
    taken = [known.candidate.run for known in done.named if known.candidate.cause == cause]
    return [run for run in range(len(done.problem.replays)) if taken.count(run) < MOST_OF[cause]]


def tones(done: Fitted) -> list[_First]:
    """Return the strongest tone of all logs; in each, a tone has its own size and phase."""
    found, left = [], done.white()
    for run in _runs(done, 'interference_tone'):
        each, white = done.problem.replays[run], left[run]
        # Zero padding: a tone between two frequencies of the log would lose half of its power.
        power = np.abs(np.fft.rfft(white, 2 * len(white))) ** 2 / len(white)
        lowest = 2 * LEAST_PERIODS
        if len(power) > 2 * lowest:
            best = lowest + int(power[lowest:-2].argmax())
            frequency = _unfolded(each, 0.5 * best / each.duration)
            if each.rounded and not _of_the_gyro(each, frequency):
                continue
            most, places = float(power[best]) - PRICE_OF_COLUMN, len(power) * len(left)
            found.append(_First(effect('interference_tone', frequency, run=run), most,
                                most - float(np.log(places))))
    return [max(found, key=lambda one: one.mean)] if found else []


def _unfolded(each: Replay, frequency: float) -> float:
    """Return the frequency of a tone before averaging: the strongest of its aliases."""
    if each.every == 1:
        return frequency
    samples = replace(each, every=1)
    power = np.abs(np.fft.rfft(samples.on_grid(each.channels.output - each.reference),
                               2 * samples.points)) ** 2
    folds = np.arange(each.every // 2 + 1) / each.step
    places = 2.0 * samples.duration * np.concatenate([folds + frequency, folds[1:] - frequency])

    def outstanding(at: float) -> float:
        """Return the ratio of the power at a frequency to that of its neighbours."""
        place = round(at)
        return float(power[place - 2:place + 3].max()
                     / np.median(power[max(place - 60, 0):place + 61]))

    return float(max(places[places < len(power) - 3], key=outstanding)) / (2.0 * samples.duration)


def _of_the_gyro(each: Replay, frequency: float) -> bool:
    """Tell whether a tone is in the output, not only in the reference of an encoder."""
    wave = np.exp(-2.0j * np.pi * frequency * each.channels.time[each.kept])
    output, reference = (np.abs(np.mean(values[each.kept] * wave))
                         for values in (each.channels.output, each.reference))
    return bool(output > 0.7 * reference)


def slips(done: Fitted) -> list[_First]:
    """Return the clearest jumps of the reference's heading, where it accelerates."""
    found = []
    parts = np.cumsum([each.points - 1 for each in done.problem.replays])[:-1]
    divided = np.split(done.problem.divided(int(done.by_noise.likelihood[0].argmax()))
                       / done.problem.deviation, parts)
    left = done.white()
    for run in _runs(done, 'reference_slip'):
        each, white, factor = done.problem.replays[run], left[run], divided[run]
        acceleration = np.abs(np.gradient(each.on_grid(each.channels.rate), each.step))
        moments = np.flatnonzero(acceleration > 0.2 * acceleration.max())
        if acceleration.max() > 0.0 and len(moments):
            tried = [_slipped(each, run, white, factor, moments, max(width, 0.5 * each.step))
                     for width in WIDTHS]
            # The largest number indicates a continuous disturbance, not slips.
            if max(len(one.candidate.shapes) - 1 for one in tried) < MOST_SLIPS:
                found += tried
    return [max(found, key=lambda one: one.mean)] if found else []


def _slipped(each: Replay, run: int, white: Array, factor: Array, moments: Places,
             width: float) -> _First:
    """Return slips of one duration, at least 1 s apart, with evidence for the times scanned."""
    time = np.arange(each.points) * each.step
    likely = float(np.log(len(moments) * len(WIDTHS)))
    size, deviation = _matched(white, factor, time, width)
    wide, _ = _matched(white, factor, time, 5.0 * width + 0.3)
    value = 0.5 * (size[moments] / deviation) ** 2 - likely - PRICE_OF_COLUMN
    # A slip is permanent; the sum of a temporary error over a longer time is 0. The rounding error
    # of an encoder is constant at rest, and differs by up to a step between two rests.
    value[(wide[moments] / size[moments] < 0.3)
          | (np.abs(size[moments]) <= each.rounded)] = -np.inf
    chosen: list[float] = []
    total = 0.0
    for place in np.argsort(-value)[:200]:
        single = _single(each, int(moments[place]), width)
        if single is not None and not _of_the_reference(each, float(time[single])):
            continue
        if (value[place] <= 0.0 and chosen) or len(chosen) == MOST_SLIPS:
            break
        at = float(each.channels.time[each.kept][0] + time[moments[place]])
        if all(abs(at - other) > 1.0 for other in chosen):
            chosen.append(at)
            total += float(value[place])
    return _First(effect('reference_slip', width, *chosen, run=run), total + likely * len(chosen),
                  total if chosen else -np.inf)


def _matched(white: Array, factor: Array, time: Array, width: float) -> tuple[Array, float]:
    """Return the size of a pulse at each time, rad, and its standard deviation."""
    kernel = inverse(transform(pulse(time, time[len(time) // 2], width)) * factor)
    return (correlate(white, kernel, 'same') / (kernel @ kernel),
            float(1.0 / np.sqrt(kernel @ kernel)))


def _single(each: Replay, at: int, width: float) -> int | None:
    """Return the point near another that has most of the deviation; None if there are several."""
    left = each.on_grid(each.channels.output - each.channels.rate)
    reach = max(3, round(2.0 * width / each.step))
    begin = max(at - reach, 0)
    near = left[begin:at + reach + 1]
    off = (near - np.median(near)) ** 2
    return (begin + int(off.argmax())
            if off.max() > max(40.0 * np.median(off), 0.4 * off.sum()) else None)


def _of_the_reference(each: Replay, moment: float) -> bool:
    """Tell whether the reference jumps more than the output at a time."""
    at = int(np.clip(np.searchsorted(each.channels.time[each.kept],
                                     moment + each.channels.time[each.kept][0]),
                     3, each.kept.sum() - 4))
    off = [np.abs(np.diff(values[each.kept][at - 3:at + 4], 2)).max()
           for values in (each.reference, each.channels.output)]
    return bool(off[0] > off[1])


# one more cause

def _stock(search: Search, named: Sequence[Named]) -> Bank:
    """Return all candidates for the rate that the gyro senses, with shapes to two digits."""
    changes = [each for each in named if is_of_the_rate(each.candidate.cause)]
    key = tuple((each.candidate.cause, *(float(f'{shape:.2g}') for shape in each.candidate.shapes))
                for each in changes)
    if not changes:
        return search.bank
    if key not in search.banks:
        search.banks.clear()  # one is hundreds of megabytes
        search.banks[key] = bank(search.problem, search.candidates, changes)
    return search.banks[key]


@dataclass(frozen=True)
class Step:
    """A list of causes and its score."""

    named: tuple[Named, ...]
    score: float


def refined(before: Fitted, candidate: Candidate, price: float) -> Step:
    """
    Add a cause with its best shape near the given one.

    Parameters
    ----------
    before : fit to which the cause is added
    candidate : the cause
    price : penalty for the choice of its shape, in log-likelihood

    """
    if not fitted_shapes(candidate) or candidate.cause == 'reference_slip':
        done = with_one_more(before, candidate)
        columns = PRICE_OF_COLUMN * max(done.widths[-1] - 1, 0)
        margin = 0.0 if is_named(candidate) else MARGIN
        return Step((*before.named, Named(candidate, price=price)),
                    done.score - columns - price - margin)
    begin = candidate if candidate.amplitude is None else _unbent(before, candidate)
    place = fitted_shapes(candidate)[0]
    low, high = _around(before.plain, begin, place)

    def cost(at: float) -> float:
        return -with_one_more(before, with_shape(begin, place, _shape(at, begin, place))).score

    best = minimize_scalar(cost, bounds=(low, high), method='bounded',
                           options={'xatol': 2e-3 * (high - low), 'maxiter': 14})
    columns = PRICE_OF_COLUMN if candidate.cause == 'interference_tone' else 0.0
    found = Named(with_shape(begin, place, _shape(best.x, begin, place)), price=price)
    return Step((*before.named, found), -float(best.fun) - price - columns)


def _shape(at: float, begin: Candidate, place: int) -> float:
    return (at if begin.cause == 'bias_step'
            else float(np.copysign(np.exp(at), begin.shapes[place])))


def _around(replays: Sequence[Replay], begin: Candidate, place: int) -> tuple[float, float]:
    """Return the bounds of the search for a shape, in logarithms except for times."""
    mine = begin.shapes[place]
    if begin.cause == 'bias_step':
        width = 1.5 * max(spacing_of_steps(each, len(replays)) for each in replays)
        return mine - width, mine + width
    if begin.amplitude is not None:
        return float(np.log(abs(mine))) - 0.7, float(np.log(abs(mine))) + 0.7
    if begin.cause == 'interference_tone':
        width = 1.0 / (mine * replays[begin.run or 0].duration)
        return float(np.log(mine)) - width, float(np.log(mine)) + width
    width = 0.8
    low = float(np.log(FASTEST_LAG)) if begin.cause == 'thermal_lag' else -np.inf
    return max(float(np.log(abs(mine))) - width, low), float(np.log(abs(mine))) + width


#: Exponent with which an effect grows with its shape.
_POWERS = {'sine_response': 2.0, 'time_offset': 1.0, 'bandwidth': 1.0, 'clock_rate': 1.0}


def _unbent(before: Fitted, candidate: Candidate) -> Candidate:
    """Return a cause of fixed amplitude with the shape that a fit of its amplitude suggests."""
    if candidate.cause not in _POWERS:
        return candidate
    own = columns_of(candidate, before.problem.replays) / before.problem.deviation
    free = with_columns(before, own)
    values, _ = free.estimates
    ratio = float(values[-1])
    place = fitted_shapes(candidate)[0]
    return with_shape(candidate, place, candidate.shapes[place]
                      * float(np.copysign(abs(ratio) ** (1.0 / _POWERS[candidate.cause]), ratio)))


def strongest(search: Search, named: Sequence[Named]) -> tuple[Step | None, list[Step]]:
    """
    Search for one more cause.

    Returns
    -------
    the best step, None if no cause is significant, and all refined steps, the best first; if no
    cause is significant, those of suspected causes

    """
    key = tuple((each.candidate.cause, each.candidate.run, *each.candidate.shapes)
                for each in named)
    if key not in search.found_before:
        search.on_part(f'search for causes after {len(named)} found' if named
                       else 'search for causes')
        search.found_before[key] = _strongest(search, named)
    return search.found_before[key]


def _strongest(search: Search, named: Sequence[Named]) -> tuple[Step | None, list[Step]]:
    done = fitted(search.problem, named)
    first = _first(search, done, named)
    if not any(search.excess(each.candidate.cause, each.mean) > 0.0 for each in first):
        found = [refined(done, each.candidate, each.most - each.mean) for each in first
                 if search.excess(each.candidate.cause, each.mean,
                                  SUSPECTED if lasts(each.candidate) else 1.0) > 0.0]
        return None, sorted(found, key=lambda step: -step.score)
    top = max(first, key=lambda each: each.most)
    # Causes that distort the rate are equal to first order; large ones need refined shapes.
    alike = is_of_the_rate(top.candidate.cause)
    worth = [each for each in first if each.most > 0.8 * top.most - 8.0
             or (alike and is_of_the_rate(each.candidate.cause))]
    worth = [each for each in worth if is_named(each.candidate)
             or search.excess(each.candidate.cause, each.mean) > 0.0]
    worth.sort(key=lambda each: -each.most)
    steps = [refined(done, each.candidate, each.most - each.mean)
             for each in worth[:MOST_CONFOUNDERS]]
    # The screening fits a free size at the first shape; after refinement a cause may explain less
    # than its penalty.
    steps = sorted((step for step in steps if step.score > done.score),
                   key=lambda step: -step.score)
    beyond = (step for step in steps
              if search.excess(step.named[-1].candidate.cause, step.score - done.score) > 0.0)
    return next(beyond, None), steps


def lasts(candidate: Candidate) -> bool:
    """
    Tell whether a cause acts in all logs and has a free size: only such causes are suspected.

    A limit or a delay has no size apart from its shape, and its refinement would fit single peaks.

    """
    return is_named(candidate) and candidate.run is None and candidate.amplitude is None


def suspected(search: Search, named: Sequence[Named]) -> Step | None:
    """Return the named causes and one more that is significant at `SUSPECTED` times the rate."""
    _, steps = strongest(search, named)
    score = fitted(search.problem, named).score if steps else 0.0
    causes = {each.candidate.cause for each in named}
    candidates = ((step, step.named[-1].candidate) for step in steps)
    return next((step for step, candidate in candidates
                 if lasts(candidate) and candidate.cause not in causes
                 and search.excess(candidate.cause, step.score - score, SUSPECTED) > 0.0), None)


def _first(search: Search, done: Fitted, named: Sequence[Named]) -> list[_First]:
    """Return the best first shape of each cause."""
    found = screen(done, _stock(search, named))
    # A second cause without a free size would only correct the shape of the first.
    taken = {each.candidate.cause for each in named if each.candidate.amplitude is not None}
    first = [_First(search.candidates[max(own, key=lambda place: found[place])],
                    float(found[own].max()), float(averaged(found[own])))
             for cause, own in by_cause(search.candidates).items()
             if cause not in taken and np.isfinite(found[own]).any()]
    scans = {'interference_tone': tones, 'reference_slip': slips}
    return first + [each for cause in sorted(search.scanned) for each in scans[cause](done)
                    if np.isfinite(each.mean)]


def polished(search: Search, named: Sequence[Named]) -> tuple[Named, ...]:
    """Refine all shapes and values together by Gauss-Newton steps."""
    current = tuple(named)
    for _ in range(3 if named else 0):
        done = fitted(search.problem, current)
        values, _ = done.estimates
        current = tuple(_updated(done, place, values) for place in range(len(current)))
    return current


def _updated(done: Fitted, place: int, values: Array) -> Named:
    known = done.named[place]
    own = dict(zip(done.owner, values))
    free = tuple(float(own.get((place, number), 0.0)) for number in range(done.widths[place]))
    found = free or (known.candidate.amplitude or 0.0,)
    candidate = known.candidate
    for shape in fitted_shapes(candidate):
        change = own.get((place, -1 - shape), 0.0)
        before = candidate.shapes[shape]
        candidate = with_shape(candidate, shape, before + float(
            np.clip(change, -0.3 * abs(before), 0.3 * abs(before))))
    return replace(known, candidate=candidate, values=found or known.values)


def searched(search: Search) -> tuple[Named, ...]:
    """
    Return the causes that the data support, with values.

    The sum of several causes along one variable may resemble none of them. So if structure without
    a name is found, the search is repeated without generic terms, and the likelier result is used.

    """
    everything = _grown(search)
    if all(is_named(each.candidate) for each in everything):
        return everything
    nameable = [each for each in search.candidates if is_named(each)]
    named = _grown(replace(search, bank=bank(search.problem, nameable), banks={}, found_before={}))
    return max((everything, named),
               key=lambda named: fitted(search.problem, named).score - sum(
                   price_of_freedom(each) + (0.0 if is_named(each.candidate) else MARGIN)
                   for each in named))


def price_of_freedom(known: Named) -> float:
    """Return the penalty of shapes and columns of a cause, in log-likelihood."""
    shapes = max(known.price, PRICE_OF_SHAPE * len(fitted_shapes(known.candidate)))
    return shapes + PRICE_OF_COLUMN * max(len(known.values) - 1, 0)


def _grown(search: Search) -> tuple[Named, ...]:
    """Add causes one by one (forward selection)."""
    named: tuple[Named, ...] = ()
    for _ in range(2 * MOST_CAUSES):  # some are removed again
        step, _ = strongest(search, named) if len(named) < MOST_CAUSES else (None, [])
        if step is None:
            break
        named = polished(search, step.named)
        if len(named) > 1:
            named = pruned(search, named)
    return _exchanged(search, pruned(search, named))


def pruned(search: Search, named: tuple[Named, ...]) -> tuple[Named, ...]:
    """Remove causes that are not significant given the others, the weakest first."""
    return without_weakest(search, named, lambda some: [
        search.excess(each.candidate.cause, evidence_of(search, some, place))
        for place, each in enumerate(some)], 0.0)[0]


def without_weakest(search: Search, named: tuple[Named, ...],
                    strengths: Callable[[tuple[Named, ...]], Sequence[float]],
                    least: float) -> tuple[tuple[Named, ...], list[Named]]:
    """Remove the weakest cause and refine the others until all exceed a strength."""
    out: list[Named] = []
    while named:
        found = strengths(named)
        weakest = int(np.argmin(found))
        if found[weakest] > least:
            break
        out.append(named[weakest])
        named = polished(search, named[:weakest] + named[weakest + 1:])
    return named, out


def _exchanged(search: Search, named: tuple[Named, ...]) -> tuple[Named, ...]:
    """Remove each cause on trial, and replace it if another is better or none is needed."""
    for known in named[:-1]:
        others = tuple(each for each in named if each is not known)
        step, _ = strongest(search, others)
        if step is None:
            return polished(search, others)
        if (step.named[-1].candidate.cause != known.candidate.cause
                and step.score > fitted(search.problem, named).score + 1.0):
            return polished(search, step.named)
    return named


def alternatives(search: Search, named: tuple[Named, ...],
                 place: int) -> list[tuple[Named, float]]:
    """Return a named cause and its alternatives, with their deficits in log-likelihood."""
    cause = named[place].candidate.cause
    _, steps = strongest(search, named[:place] + named[place + 1:])
    mine = max((step.score for step in steps if step.named[-1].candidate.cause == cause),
               default=np.inf)
    return [(step.named[-1], mine - step.score) for step in steps
            if mine - step.score < RULED_OUT and is_named(step.named[-1].candidate)]


def evidence_of(search: Search, named: Sequence[Named], place: int) -> float:
    """Return the evidence for one of the causes given the others."""
    others = tuple(each for number, each in enumerate(named) if number != place)
    return (fitted(search.problem, named).score - fitted(search.problem, others).score
            - price_of_freedom(named[place]))


def sureness(won: Array) -> float:
    """Return the gain of held-out stretches in log-likelihood over its standard deviation."""
    bounded = np.clip(won, -BOUND, BOUND)
    scatter = float(np.std(bounded, ddof=1)) * len(won) ** 0.5
    return float(np.sum(bounded)) / max(scatter, 1e-9) if np.sum(won) > 0.0 else 0.0


def sureness_of(search: Search, named: Sequence[Named]) -> list[float]:
    """
    Return the gain of each cause on held-out stretches in standard deviations.

    The contribution of a cause, given the others, is scaled to fit best without each stretch in
    turn. Slips are single events, and are not required to predict other stretches.

    """
    full, found = fitted(search.problem, named), []
    left = full.white()
    count = max(STRETCHES // len(left), 1)
    stretch = np.concatenate([run * count + np.arange(len(each)) * count // len(each)
                              for run, each in enumerate(left)])
    off = np.concatenate(left)
    for place, known in enumerate(named):
        if known.candidate.cause == 'reference_slip':
            found.append(math.inf)
            continue
        rest = fitted(search.problem, [*named[:place], *named[place + 1:]])
        before = np.concatenate(rest.white(full))
        added = before - off
        score, information = (np.bincount(stretch, each) for each in (added * off, added ** 2))
        size = 1.0 - score / np.maximum(information.sum() - information, 1e-300)
        found.append(sureness(0.5 * np.bincount(
            stretch, before ** 2 - (before - size[stretch] * added) ** 2)))
    return found
