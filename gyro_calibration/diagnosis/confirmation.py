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

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from gyro_calibration.diagnosis.regression import (
    all_columns,
    Column,
    FEWEST_STRETCHES,
    Fitted,
    fitted,
    whitening,
)
from gyro_calibration.log import Array, Mask
import numpy as np
from scipy.stats import f as fisher

#: Most causes that are added, and parts of a log for cross-fitting.
MOST, FOLDS = 4, 5
#: A cause is suspected up to so many times the level.
_SUSPECTED = 5.0
#: By how many standard deviations a cause must win on stretches that are held out.
_SURELY = 1.65
#: No probability below this is printed: the assumptions carry none.
LEAST_CHANCE = 1e-4


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


@dataclass(frozen=True)
class _Whitened:
    """Whitened observations, plain and candidate columns; the prior is rows of stretch -1."""

    observed: Array
    plain: Array
    candidates: Sequence[Array]
    stretch: Array

    def rest(self, rows: Mask, columns: Array) -> tuple[Array, Array]:
        """Return values of plain columns for each of some columns, and the rest of all rows."""
        values = np.linalg.lstsq(self.plain[rows], columns[rows], rcond=None)[0]
        return values, columns - self.plain @ values


def candidates(done: Fitted) -> Iterator[Column]:
    """Give the causes that headings over spans can show, for the channels that the log has."""
    log, duration = done.spans.log, float(done.spans.time[-1] - done.spans.time[0])
    for name in (
        'scale_factor_asymmetry',
        'quadratic_nonlinearity',
        'cubic_nonlinearity',
        'rate_ramp',
        'heading_sensitivity',
    ):
        yield Column(name)
    yield Column('reference_once_per_rev')
    for constant in np.geomspace(duration / 50.0, 0.7 * duration, 5):
        yield Column('warm_up', (float(constant),))
    for moment in np.linspace(done.spans.time[0], done.spans.time[-1], 22)[1:-1]:
        yield Column('bias_step', (float(moment),), once=True)
        yield Column('reference_slip', (float(moment),), once=True)
    if log.temperature is not None and np.ptp(log.temperature) > 0.2:
        middle = float(log.temperature.mean())
        for name in ('bias_temperature', 'bias_temperature_quadratic', 'scale_factor_temperature'):
            yield Column(name, (middle,))
        for filter_time in (3.0, 10.0):
            yield Column('bias_temperature_rate', (filter_time,))
    if log.specific_force is not None and np.ptp(log.specific_force) > 0.0:
        yield Column('acceleration_sensitivity')
        yield Column('vibration_rectification', (1.0,))
    if log.supply is not None and np.ptp(log.supply) > 0.0:
        yield Column('supply_sensitivity', (5.0,))


def search(done: Fitted, level: float) -> tuple[Fitted, list[Confirmed]]:
    """Add one cause after the other, each confirmed, and fit again with those established."""
    found: list[Confirmed] = []
    offered = list(candidates(done))
    # beside one column of each cause, so that the noise does not swallow what a cause leaves
    columns = {each.cause: each for each in offered if not each.once}
    rich = fitted(done.spans, list(columns.values()))
    whiten = whitening(rich.spans, rich.fit)
    while len(found) < MOST:
        taken = {each.column.cause for each in found}
        open_ones = [each for each in offered if each.cause not in taken]
        best = _best(done, whiten, open_ones, [each.column for each in found], level)
        if best is None:
            break
        found.append(best)
    inside = [each.column for each in found if each.established and not each.column.once]
    return (fitted(done.spans, inside) if inside else done), found


def _best(
    done: Fitted,
    whiten: Array,
    open_ones: Sequence[Column],
    beside: Sequence[Column],
    level: float,
) -> Confirmed | None:
    """Return the best of the causes that are open, beside those found; None where it is chance."""
    data = _whitened(done, whiten, open_ones, beside)
    everything = np.ones(len(data.observed), dtype=bool)
    chances = [_evidence(data, each, everything) for each in data.candidates]
    names = {each.cause for each in open_ones}
    # what happens once is never established, and does not cost the others a part of the level
    lasting = sum(not each.once for each in open_ones)
    tried = [
        chance * (len(open_ones) if each.once else lasting)
        for each, (chance, _, _) in zip(open_ones, chances)
    ]
    place = int(np.argmin(tried))
    _, gain, stretches = chances[place]
    p_value = min(tried[place], 1.0)
    if p_value > _SUSPECTED * level:
        return None
    predicted, surely, chosen = _cross_fitted(data, open_ones, place)
    column = open_ones[place]
    gains = {
        name: max(chances[other][1] for other, each in enumerate(open_ones) if each.cause == name)
        for name in names
    }
    weights = {
        name: float(np.exp(max(min(value - gain, 0.0), -50.0))) for name, value in gains.items()
    }
    total = sum(weights.values())
    probability = {
        name: max(weight / total, LEAST_CHANCE)
        for name, weight in sorted(weights.items(), key=lambda each: -each[1])
        if weight / total > 0.01
    }
    established = (
        p_value < level
        and surely > _SURELY
        and chosen == 1.0
        and not column.once
        and stretches >= FEWEST_STRETCHES
    )
    return Confirmed(
        column, max(p_value, LEAST_CHANCE), predicted, chosen, established, probability
    )


def _whitened(
    done: Fitted, whiten: Array, open_ones: Sequence[Column], beside: Sequence[Column]
) -> _Whitened:
    spans = done.spans
    plain = all_columns(spans, beside)
    prior = np.diag(1.0 / done.prior)
    rows = np.concatenate([whiten @ plain, np.pad(prior, ((0, 0), (0, plain.shape[1] - 3)))])
    columns = [np.pad(whiten @ spans.columns(each), ((0, 3), (0, 0))) for each in open_ones]
    return _Whitened(
        np.append(whiten @ spans.observed, np.zeros(3)),
        rows,
        columns,
        np.append(spans.stretches, [-1, -1, -1]),
    )


def _evidence(data: _Whitened, columns: Array, rows: Mask) -> tuple[float, float, float]:
    """Return chance, gain in log-likelihood (both cluster-robust) and effective stretches."""
    _, both = data.rest(rows, np.column_stack([columns, data.observed]))
    x, left = both[rows, :-1], both[rows, -1]
    information = x.T @ x
    size = np.sqrt(np.diag(information))
    if not (size > 1e-9 * np.sqrt(np.sum(columns**2, axis=0) + 1e-300)).all():
        return 1.0, 0.0, 0.0
    stretch = data.stretch[rows] + 1
    # by what the candidate leaves: a score that holds the effect itself would hide it
    off = left - x @ np.linalg.lstsq(x, left, rcond=None)[0]
    scores = np.array([np.bincount(stretch, part * off) for part in x.T])
    shares = np.bincount(stretch, np.sum((x / size) ** 2, axis=1))
    effective = float(shares.sum() ** 2 / (shares**2).sum())
    count = x.shape[1]
    scatter = scores @ scores.T * effective / max(effective - 1.0 - count, 0.5)
    root = np.linalg.inv(np.linalg.cholesky(information + 1e-12 * np.diag(size**2)))
    more = float(np.linalg.eigvalsh(root @ scatter @ root.T).max())
    statistic = float(np.sum((root @ x.T @ left) ** 2)) / max(more, 1.0)
    freedom = max(effective - count, 1.0)
    return float(fisher.sf(statistic / count, count, freedom)), 0.5 * statistic, effective


def _cross_fitted(
    data: _Whitened, open_ones: Sequence[Column], place: int
) -> tuple[float, float, float]:
    """
    Choose and fit without each fold, and predict it.

    Returns
    -------
    what is won in log-likelihood, the same over its standard deviation by the scatter between
    stretches, and the part of the folds in which the choice was the same

    """
    numbers = np.unique(data.stretch[data.stretch >= 0])
    folds = min(FOLDS, len(numbers))
    won: list[float] = []
    same = 0
    for fold in range(folds):
        held = np.isin(data.stretch, numbers[fold::folds])
        rest = ~held
        gains = [_evidence(data, each, rest)[1] for each in data.candidates]
        best = int(np.argmax(gains))
        same += open_ones[best].cause == open_ones[place].cause
        plain = data.rest(rest, data.observed[:, None])[1][held, 0]
        both = np.column_stack([data.plain, data.candidates[best]])
        values = np.linalg.lstsq(both[rest], data.observed[rest], rcond=None)[0]
        left = data.observed[held] - both[held] @ values
        won += np.bincount(
            np.searchsorted(numbers[fold::folds], data.stretch[held]), 0.5 * (plain**2 - left**2)
        ).tolist()
    total, scatter = float(np.sum(won)), float(np.std(won, ddof=1)) * len(won) ** 0.5
    return total, total / scatter if scatter > 0.0 else 0.0, same / folds
