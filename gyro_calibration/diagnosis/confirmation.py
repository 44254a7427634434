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
Which causes a regression on spans establishes: robust evidence, confirmed by cross-fitting.

The score of a candidate is summed over stretches. Its variance is what the noise predicts or what
the stretches scatter by, whichever is larger, and its distribution Student's, with the effective
number of stretches less one as the degrees of freedom. The chance of the best of all candidates is
that of one times their number; those that happen once are counted apart. A cause is established
if, besides, it is chosen again without each fold, and predicts the stretches of the folds better
than no cause does; else it is suspected.

"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
import math

from gyro_calibration.diagnosis.candidates import added_effects, LEAST_CHANGE
from gyro_calibration.diagnosis.findings import LEAST_PROBABILITY
from gyro_calibration.diagnosis.spans import (
    Column,
    FEWEST_STRETCHES,
    fit_spans,
    SpanFit,
    Whitened,
    whitened,
)
from gyro_calibration.logs.log import Array, Mask
from gyro_calibration.model.effects import CATALOGUE
import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as fisher

#: Most causes that are added, and parts of a log for cross-fitting.
MOST, FOLDS = 4, 5
#: A cause is suspected up to so many times the level.
_SUSPECTED = 5.0
#: By how many standard deviations a cause must win on stretches that are held out (one-sided 5 %),
#: where a stretch counts no more than so much log-likelihood, a ratio of 20: no single stretch
#: establishes a cause.
_SURELY, _BOUND = 1.65, 3.0
#: Causes explain a log as well as the best of them up to this likelihood ratio.
_LIKELY = 25.0


@dataclass(frozen=True)
class Confirmed:
    """
    A cause that the search found.

    Attributes
    ----------
    column : the cause
    p_value : chance that the best of all candidates shows as much in noise, cluster-robust
    predicted : what it adds to the log-likelihood of stretches that took no part in choice and fit
    chosen : part of the folds in which the choice was the same
    established : whether it is confirmed
    probability : of it and of those that may be in its place, by name

    """

    column: Column
    p_value: float
    predicted: float
    chosen: float
    established: bool
    probability: dict[str, float]


def candidates(done: SpanFit) -> Iterator[Column]:
    """Give the causes that headings over spans can show, for the channels that the log has."""
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


def search(done: SpanFit, level: float) -> tuple[SpanFit, list[Confirmed]]:
    """Add one cause after the other, each confirmed, and fit again with those established."""
    found: list[Confirmed] = []
    offered = list(candidates(done))
    # beside one column of each cause, so that the noise does not swallow what a cause leaves
    columns = {each.cause: each for each in offered if not each.once}
    rich = fit_spans(done.spans, list(columns.values()))
    while len(found) < MOST:
        taken = [each.column for each in found]
        names = {each.cause for each in taken}
        best = _best(done, rich, [each for each in offered if each.cause not in names], taken,
                     level)
        if best is None:
            break
        found.append(best)
    inside = [each.column for each in found if each.established and not each.column.once]
    return (fit_spans(done.spans, inside) if inside else done), found


def _best(done: SpanFit, rich: SpanFit, open_ones: Sequence[Column], beside: Sequence[Column],
          level: float) -> Confirmed | None:
    """Return the best of the causes that are open, beside those found; None where it is chance."""
    data = whitened(done, beside, rich, most=True)
    widths = [done.spans.columns(each) for each in open_ones]
    columns = data.columns(np.column_stack(widths))
    edges = np.concatenate([[0], np.cumsum([each.shape[1] for each in widths])])
    places = [slice(begin, end) for begin, end in zip(edges[:-1], edges[1:])]
    positive = [each.positive for each in open_ones]
    chances = _evidences(data, columns, places, positive, np.ones(len(data.observed), dtype=bool))
    # what happens once is never established, and does not cost the others a part of the level
    lasting = sum(not each.once for each in open_ones)
    tried = [chance * (len(open_ones) if each.once else lasting)
             for each, (chance, _, _) in zip(open_ones, chances)]
    strongest = int(np.argmin(tried))
    once = open_ones[strongest].once
    if min(tried[strongest], 1.0) > (level if once else _SUSPECTED * level):
        return None
    best_of: dict[str, int] = {}
    for other, each in enumerate(open_ones):
        if each.cause not in best_of or chances[other][1] > chances[best_of[each.cause]][1]:
            best_of[each.cause] = other
    gain = chances[strongest][1]
    alike = {name: other for name, other in best_of.items()
             if chances[other][1] > gain - math.log(_LIKELY) or other == strongest}
    # of those that explain the log as well, the simplest: with the fewest values and fitted shapes
    place = min(alike.values(), key=lambda other: (widths[other].shape[1] + sum(
        each.default is None for each in getattr(CATALOGUE.get(open_ones[other].cause), 'shapes',
                                                 ())), tried[other]))
    column, p_value, stretches = open_ones[place], min(tried[place], 1.0), chances[place][2]
    found = _cross_fitted(data, columns, places, positive, open_ones, alike)
    # the errors of a course last: there a cause has to predict distant stretches as well
    surely, predicted, chosen = max(found) if done.spans.fine else min(found)
    weights = {name: float(np.exp(max(min(chances[other][1] - gain, 0.0), -50.0)))
               for name, other in best_of.items()}
    probability = {name: max(weight / sum(weights.values()), LEAST_PROBABILITY)
                   for name, weight in sorted(weights.items(), key=lambda each: -each[1])
                   if name in alike}
    established = (p_value < level and surely > _SURELY and chosen == 1.0 and not column.once
                   and stretches >= FEWEST_STRETCHES)
    return Confirmed(column, max(p_value, LEAST_PROBABILITY), predicted, chosen, established,
                     probability)


def _evidences(data: Whitened, columns: Array, places: Sequence[slice], positive: Sequence[bool],
               rows: Mask) -> list[tuple[float, float, float]]:
    """Return chance, gain in log-likelihood and effective stretches of each cause."""
    base, _ = np.linalg.qr(data.plain[rows])
    both = np.column_stack([columns, data.observed])[rows]
    both -= base @ (base.T @ both)
    stretch = data.stretch[rows]
    sizes = np.sqrt(np.sum(columns[rows] ** 2, axis=0)) + 1e-300
    return [(1.0, 0.0, 0.0) if above and float(both[:, place.start] @ both[:, -1]) <= 0.0
            else _evidence(both[:, place], both[:, -1], stretch, 1e-6 * sizes[place])
            for place, above in zip(places, positive)]


def _evidence(x: Array, left: Array, stretch: NDArray[np.intp],
              least: Array) -> tuple[float, float, float]:
    """Return chance, gain in log-likelihood (both cluster-robust) and effective stretches."""
    information = x.T @ x
    size = np.sqrt(np.diag(information))
    if not (size > least).all():
        return 1.0, 0.0, 0.0
    # by what the candidate leaves: a score that holds the effect itself would hide it
    off = left - x @ np.linalg.lstsq(x, left, rcond=None)[0]
    scores = np.array([np.bincount(stretch, part * off) for part in x.T])
    shares = np.bincount(stretch, np.sum((x / size) ** 2, axis=1))
    effective = float(shares.sum() ** 2 / (shares ** 2).sum())
    count = x.shape[1]
    scatter = scores @ scores.T * effective / max(effective - 1.0 - count, 0.5)
    root = np.linalg.inv(np.linalg.cholesky(information + 1e-12 * np.diag(size**2)))
    more = float(np.linalg.eigvalsh(root @ scatter @ root.T).max())
    statistic = float(np.sum((root @ x.T @ left) ** 2)) / max(more, 1.0)
    freedom = max(effective - count, 1.0)
    return float(fisher.sf(statistic / count, count, freedom)), 0.5 * statistic, effective


def _cross_fitted(data: Whitened, columns: Array, places: Sequence[slice],
                  positive: Sequence[bool], open_ones: Sequence[Column],
                  alike: Mapping[str, int]) -> list[tuple[float, float, float]]:
    """
    Choose and fit without each fold, and predict it.

    Returns
    -------
    for folds of every fifth stretch, and for fifths of the log (between neighbours, what is slow
    is predicted by the wander as well): what is won in log-likelihood over its standard
    deviation by the scatter between stretches, what is won, and the part of the folds in which
    the choice was one of those alike

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
            gains = [each[1] for each in _evidences(data, columns, places, positive, rest)]
            best = int(np.argmax(gains))
            same += open_ones[best].cause in alike
            off = []
            for design in (data.plain, np.column_stack([data.plain, columns[:, places[best]]])):
                values = np.linalg.lstsq(design[rest], data.observed[rest], rcond=None)[0]
                off.append(data.observed[held] - design[held] @ values)
            won += np.bincount(np.searchsorted(fold, data.stretch[held]),
                               0.5 * (off[0] ** 2 - off[1] ** 2)).tolist()
        bounded = np.clip(won, -_BOUND, _BOUND)
        scatter = float(np.std(bounded, ddof=1)) * len(won) ** 0.5
        total = float(np.sum(won))
        surely = float(np.sum(bounded)) / max(scatter, 1e-9) if total > 0.0 else 0.0
        found.append((surely, total, same / folds))
    return found
