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
The experiment that parts causes which the data at hand cannot part.

Each experiment of the menu is simulated with each cause in turn, as it was fitted, in the noise
that was fitted. Another cause is fitted to that, with all its values and shapes free, beside the
bias of the power-on, the scale and the other named causes. What it leaves is how far apart the two
are, in sigmas. The log at hand is counted in: what it says of a value binds the value in the
experiment.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import permutations

from gyro_calibration.diagnosis.candidates import columns_of, with_shape
from gyro_calibration.diagnosis.causes import CAUSES
from gyro_calibration.diagnosis.field import Field, free_shapes, is_of_the_rate, Named, seen, work
from gyro_calibration.diagnosis.menu import Conditions, menu, reach
from gyro_calibration.diagnosis.replay import Replay
from gyro_calibration.diagnosis.spectrum import angles, Shape
from gyro_calibration.diagnosis.units import number
from gyro_calibration.logs.log import Array
import numpy as np

#: Sigmas that part two causes even if the fitted values are somewhat off; more are not needed.
ENOUGH = 8.0
#: With fewer sigmas, in expectation, an experiment is not worth its time.
LEAST = 4.0
#: A shape is changed by this part of itself to see what its column changes by.
_SMALL = 1e-4
#: Causes found against a model only: a cause that looks like one takes the value that explains it.
_AGAINST_A_MODEL = ('bias', 'scale_factor_error')

#: (true one, another) of the members of a set -> how far they are apart, sigmas.
Pairs = dict[tuple[int, int], float]


@dataclass(frozen=True)
class Experiment:
    """
    What to do to part causes.

    Attributes
    ----------
    name : of the experiment; '' where none of the menu parts them
    sentence : for people: what to do, and what it would bring
    separation : of the pair of causes that it parts least, together with the logs at hand, sigmas
    now : what the logs at hand have of that pair
    minutes : how long it takes
    conditions : the experiment itself; None where there is none

    """

    name: str
    sentence: str
    separation: float = 0.0
    now: float = 0.0
    minutes: float = 0.0
    conditions: Conditions | None = None


@dataclass(frozen=True)
class _Question:
    """
    The causes to be parted.

    Attributes
    ----------
    others : causes that are named besides
    members : those to be parted, the named one first, with their values
    noise : relative to its white part, for points of `step` s
    level : spectral density of the white part, (rad/s)² s

    """

    others: tuple[Named, ...]
    members: tuple[Named, ...]
    noise: Shape
    level: float
    step: float

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """Return the pairs of members: the true one, and another that is to be ruled out."""
        return list(permutations(range(len(self.members)), 2))

    def again(self) -> _Question:
        """Return the same for another log, in which nothing happens that happens once."""
        return replace(self, others=tuple(map(_gone, self.others)),
                       members=tuple(map(_gone, self.members)))

    def deviation(self, each: Replay) -> Array:
        """Return the standard deviation of the coefficients of a log."""
        # The rounding of a heading is one reading a point: its rate falls with the point's length.
        noise = replace(self.noise, reference=self.noise.reference * self.step / each.step)
        return np.sqrt(self.level * noise.variance(angles(each.points), each.step) / each.step)


def _gone(known: Named) -> Named:
    once = known.candidate.run is not None
    return replace(known, candidate=replace(known.candidate, run=-1)) if once else known


def separating(whole: Field, named: Sequence[Named], known: Named, rivals: Sequence[Named],
               generator: np.random.Generator) -> Experiment:
    """
    Return the shortest experiment that parts a named cause from its rivals, or else the best.

    Parameters
    ----------
    whole : the logs
    named : all causes that are named, with values
    known : one of them
    rivals : causes that may stand in its place, with the shapes that fit best; values are fitted
        where they have none
    generator : source of what fills lost samples

    """
    question = _question(whole, named, known, rivals)
    have = _root(question, whole.replays)
    plans = menu(reach(whole.replays), whole.replays)
    apart = [_apart(question, np.concatenate([
        have, _root(question.again(), [plan.replay(generator)])])) for plan in plans]
    best = min(range(len(plans)), key=lambda place: _rank(plans[place], apart[place]))
    return _told(question, plans[best], apart[best], _apart(question, have))


def _question(whole: Field, named: Sequence[Named], known: Named,
              rivals: Sequence[Named]) -> _Question:
    others = tuple(each for each in named if each is not known)
    members = tuple(_valued(whole, others, each, known) for each in (known, *rivals))
    done = work(whole, [*others, members[0]])
    best = int(done.judged.likelihood[0].argmax())
    return _Question(others, members, done.field.shapes[best],
                     float(done.judged.squares[0, best]) / done.by.freedom,
                     min(each.step for each in whole.replays))


def _valued(whole: Field, others: tuple[Named, ...], rival: Named, known: Named) -> Named:
    """Return a cause with the values that fit best, where it has none."""
    candidate = rival.candidate
    if rival.values:
        return rival
    if candidate.amplitude is not None:
        return replace(rival, values=(candidate.amplitude,))
    if known.candidate.cause == 'bias':
        column = np.concatenate([candidate.columns(each)[0] for each in whole.replays])
        return replace(rival, values=(known.values[0] / float(column.mean()),))
    done = work(whole, [*others, rival])
    found = dict(zip(done.owner, done.estimates[0]))
    width = len(candidate.columns(whole.replays[0]))
    return replace(rival, values=tuple(float(found.get((len(others), place), 0.0))
                                       for place in range(width)))


# what is left of one cause by another

def _root(question: _Question, replays: Sequence[Replay]) -> Array:
    """Return a triangle with lengths and angles of the columns (see `_apart`), shape (q, q)."""
    deviation = np.concatenate([question.deviation(each) for each in replays])
    through = [seen(each, question.others) for each in replays]
    scale = np.concatenate([each.coefficients(each.channels.rate) for each in through])[None]
    freedoms = [_freedom(each, replays, through) for each in (*question.others, *question.members)]
    totals = [_total(each, replays, through) for each in question.members]
    columns = np.concatenate([np.array(totals), scale, *freedoms]) / deviation
    padded = np.pad(columns, ((0, 0), (0, max(0, len(columns) - columns.shape[1]))))
    return np.asarray(np.linalg.qr(padded.T, mode='r'))


def _total(known: Named, replays: Sequence[Replay], through: Sequence[Replay]) -> Array:
    """Return what a cause does to the output."""
    return np.tensordot(known.values, _columns(known, replays, through), 1)


def _columns(known: Named, replays: Sequence[Replay], through: Sequence[Replay]) -> Array:
    return columns_of(known.candidate,
                      replays if is_of_the_rate(known.candidate.cause) else through)


def _freedom(known: Named, replays: Sequence[Replay], through: Sequence[Replay]) -> Array:
    """Return what a cause can be changed by: its columns, and their changes with its shapes."""
    own, changes = _columns(known, replays, through), []
    for place in free_shapes(known.candidate):
        step = _SMALL * abs(known.candidate.shapes[place]) or 1e-6
        moved = replace(known, candidate=with_shape(known.candidate, place,
                                                    known.candidate.shapes[place] + step))
        changes.append((_total(moved, replays, through)
                        - _total(known, replays, through))[None] / step)
    return np.concatenate([own if known.candidate.amplitude is None else own[:0], *changes])


def _apart(question: _Question, root: Array) -> Pairs:
    """Return for each pair what the second cannot explain of the first, sigmas."""
    count = len(question.members)
    common, owned = _places(question)
    found = {}
    for true, other in question.pairs:
        bound = any(question.members[place].candidate.cause in _AGAINST_A_MODEL
                    for place in (true, other))
        free = root[:, [count, *common, *([] if bound else owned[other])]]
        found[true, other] = _left(root[:, true] - root[:, other], free)
    return found


def _places(question: _Question) -> tuple[list[int], list[list[int]]]:
    """Return the columns of the root that belong to the other causes, and those of each member."""
    widths = [len(free_shapes(each.candidate))
              + (len(each.values) if each.candidate.amplitude is None else 0)
              for each in (*question.others, *question.members)]
    ends = len(question.members) + 1 + np.cumsum(widths)
    places = [list(range(end - width, end)) for end, width in zip(ends.tolist(), widths)]
    others = len(question.others)
    return [place for own in places[:others] for place in own], places[others:]


def _left(column: Array, free: Array) -> float:
    """Return the length of a column beside others."""
    length = np.linalg.norm(free, axis=0)
    free = free[:, length > 0.0] / length[length > 0.0]
    return float(np.linalg.norm(column - free @ np.linalg.lstsq(free, column, rcond=1e-9)[0]))


# choice and words

def _rank(plan: Conditions, apart: Pairs) -> tuple[float, ...]:
    """
    Return what is smallest for the best plan.

    First come those that part all members, then those that part the named one from all others; of
    both, those within what was seen, and of these the shortest, and the first of the menu of those
    that are as short. Where none is enough, the number of parted members counts.

    """
    reached = sum(min(value, ENOUGH) for value in apart.values())
    parts_all = min(apart.values()) >= ENOUGH
    if not parts_all and min(value for pair, value in apart.items() if 0 in pair) < ENOUGH:
        return (4.0, -reached, float(plan.beyond), round(plan.minutes))
    return (2.0 * plan.beyond + (not parts_all), round(plan.minutes))


def _told(question: _Question, plan: Conditions, apart: Pairs, now: Pairs) -> Experiment:
    """Say what the best plan would part; where that is nothing, what is known of these causes."""
    names = [each.candidate.cause for each in question.members]
    each_way = [min(apart[0, place], apart[place, 0]) for place in range(1, len(names))]
    parted = [place for place, value in enumerate(each_way, 1) if value >= LEAST]
    if not parted:
        return Experiment('', next((CAUSES[name].separate_by for name in names
                                    if name in CAUSES and CAUSES[name].separate_by), ''))
    worst = min(parted, key=lambda place: each_way[place - 1])
    before, after = min(now[0, worst], now[worst, 0]), each_way[worst - 1]
    stay = [name for place, name in enumerate(names[1:], 1) if place not in parted]
    rest = f'; {_listed(stay)} would stay possible' if stay else ''
    by = 'more than 100' if after > 100.0 else number(after, 2)
    return Experiment(
        plan.name, f'{plan.to_do}: would part {names[0]} from '
        f'{_listed([names[place] for place in parted])} by {by} sigma (now {before:.1f}){rest}',
        after, before, plan.minutes, plan)


def _listed(names: Sequence[str]) -> str:
    return ' and '.join(filter(None, [', '.join(names[:-1]), names[-1]]))
