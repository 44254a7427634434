# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Scores of answers, and the table of a set of them."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
import itertools
from typing import Any

from gyro_calibration_bench.hidden import Cause, OUTSIDE
from gyro_calibration_bench.hidden.effects import COUNTED, STEPPED
from scipy.stats import binomtest

#: Causes that no log can distinguish.
SAME = {'reference_scale': 'scale_factor_error'}
#: Largest number of names in a set that counts as right.
LARGEST_SET = 3
#: Causes without an interval: counted faults, steps, and causes without a size.
WITHOUT_SIZE = {*COUNTED, *STEPPED, 'unit_error', 'bias_instability'}


@dataclass(frozen=True)
class Named:
    """
    A cause that an answer names.

    Attributes
    ----------
    effect : its name
    ambiguous_with : names of effects that explain the log as well
    size, interval : of the leading parameter in SI and its 95 % interval, where they are known

    """

    effect: str
    ambiguous_with: tuple[str, ...] = ()
    size: float | None = None
    interval: tuple[float, float] | None = None


@dataclass(frozen=True)
class Judged:
    """
    Scores of an answer.

    Attributes
    ----------
    detected : something is reported
    first : the strongest finding has the right name
    in_set : each hidden cause is in the set of a separate finding
    set_sizes : of the findings that contain a hidden cause
    extra : names of the findings that contain none
    beyond : variables of structures without a name
    right : each hidden cause is in a set of at most three, and nothing else is reported; a cause
        outside the catalogue is reported as unexplained, and nothing is named
    held : for each cause that is named with a number, whether its 95 % interval includes the truth

    """

    detected: bool
    first: bool
    in_set: bool
    set_sizes: tuple[int, ...]
    extra: tuple[str, ...]
    beyond: tuple[str, ...]
    right: bool
    held: dict[str, bool]


def judged(causes: Sequence[Cause], findings: Sequence[Named], beyond: Sequence[str],
           allowed: Collection[str] = ()) -> Judged:
    """
    Compare an answer with the truth.

    Parameters
    ----------
    causes : that were hidden
    findings : the named causes
    beyond : variables along which there is structure without a name
    allowed : names of findings that are true though they were not hidden

    """
    wanted = {SAME.get(cause.name, cause.name) for cause in causes}
    findings = [each for each in findings if each.effect not in allowed or each.effect in wanted]
    sets = [_names(each) for each in findings]
    matched = _matched(sorted(wanted - set(OUTSIDE)), sets)
    extra = tuple(each.effect for each, names in zip(findings, sets) if not names & wanted)
    sizes = tuple(len(each) for each in sets if each & wanted)
    complete = (len(matched) == len(wanted) == len(sizes) and max(sizes, default=0) <= LARGEST_SET
                and not extra and not beyond)
    right = bool(beyond) and not findings if wanted & set(OUTSIDE) else complete
    return Judged(bool(findings or beyond),
                  bool(findings) and SAME.get(findings[0].effect, findings[0].effect) in wanted,
                  len(matched) == len(wanted), sizes, extra, tuple(beyond), right,
                  held(causes, findings))


def _names(finding: Named) -> set[str]:
    """Return the set of a finding; causes that no log can distinguish are one."""
    return {SAME.get(name, name) for name in (finding.effect, *finding.ambiguous_with)}


def _matched(wanted: Sequence[str], sets: Sequence[set[str]]) -> dict[str, int]:
    """Assign to as many hidden causes as possible a separate finding that contains the cause."""
    places: list[list[int | None]] = [
        [*(place for place, each in enumerate(sets) if name in each), None] for name in wanted]
    ways = (way for way in itertools.product(*places) if _once(way))
    best = max(ways, key=lambda way: sum(place is not None for place in way))
    return {name: place for name, place in zip(wanted, best) if place is not None}


def _once(way: Sequence[int | None]) -> bool:
    given = [place for place in way if place is not None]
    return len(set(given)) == len(given)


def held(causes: Iterable[Cause], findings: Sequence[Named],
         deviations: float = 1.96) -> dict[str, bool]:
    """
    Return for each cause named with a number whether its interval includes the truth.

    The size of a wave has no sign if it has a phase. Counted faults have no interval, a wrong unit
    has no size, and flicker in addition to a Gauss-Markov process has none that an Allan deviation
    determines.

    """
    by_name = {each.effect: each for each in findings}
    holds = {}
    for cause in causes:
        found = None if cause.name in WITHOUT_SIZE else by_name.get(cause.name)
        if found is not None and found.size is not None and found.interval is not None:
            half = 0.5 * (found.interval[1] - found.interval[0]) * deviations / 1.96
            size = abs(cause.size) if 'phase' in cause.shapes else cause.size
            holds[cause.name] = bool(abs(found.size - size) <= half)
    return holds


# the table of a set of answers

@dataclass(frozen=True)
class Scored:
    """
    A case with its answer.

    Attributes
    ----------
    row : of the table
    right : as the bench counts it: of look-alikes both have to be in the set of one finding, and
        with a log that separates them the hidden one alone
    how : the rest

    """

    row: str
    right: bool
    how: Judged
    hidden: bool


def scored(truth: Mapping[str, Any], answer: Mapping[str, Any]) -> Scored:
    """Compare an answer, as in the file of answers, with the truth, as in `truth.json`."""
    causes = [Cause(**each) for each in truth['causes']]
    findings = [Named(each['effect'], tuple(each.get('ambiguous_with', ())), each.get('size'),
                      each.get('interval') and tuple(each['interval']))
                for each in answer.get('causes', ())]
    how = judged(causes, findings, ['unexplained'] * bool(answer.get('unexplained')),
                 truth['allowed'])
    right = how.right
    if truth['part'] == 'sets':
        pair = {SAME.get(name, name) for name in truth['look_alikes']}
        right = right and any(pair <= _names(each) for each in findings)
    elif truth['part'] == 'separated':
        right = right and max(how.set_sizes) == 1
    row = truth['part'] + (', nothing hidden' if truth['part'] == 'references' and not causes
                           else '')
    return Scored(row, right, how, bool(causes))


def summary(scores: Sequence[Scored]) -> dict[str, dict[str, tuple[int, int]]]:
    """Return by row and by column how many of how many."""
    rows: dict[str, list[Scored]] = {}
    for each in scores:
        rows.setdefault(each.row, []).append(each)
    rows['all with something hidden'] = [each for each in scores if each.hidden]
    rows['all with nothing hidden'] = [each for each in scores if not each.hidden]
    return {name: _counts(own) for name, own in rows.items() if own}


def _counts(scores: Sequence[Scored]) -> dict[str, tuple[int, int]]:
    columns = {'detected': [each.how.detected for each in scores],
               'first': [each.how.first for each in scores if each.hidden],
               'in set': [each.how.in_set for each in scores if each.hidden],
               'right': [each.right for each in scores],
               'interval': [held for each in scores for held in each.how.held.values()]}
    return {name: (sum(values), len(values)) for name, values in columns.items()}


def interval(good: int, count: int) -> tuple[float, float]:
    """Return the 95 % interval of a share after Wilson."""
    both = binomtest(good, count).proportion_ci(method='wilson')
    return float(both.low), float(both.high)


def table(found: Mapping[str, Mapping[str, tuple[int, int]]]) -> str:
    """Return the table in Markdown: shares with their 95 % intervals, %."""
    lines = ['| part | cases | detected | named first | in set | right | interval holds |',
             f'|---|---:{"|---:" * 5}|']
    for row, counts in found.items():
        cells = [f'{100.0 * good / count:.0f} ({100.0 * low:.0f} to {100.0 * high:.0f})'
                 if count else '' for good, count in counts.values()
                 for low, high in [interval(good, count) if count else (0.0, 0.0)]]
        lines.append(f'| {row} | {counts["right"][1]} | {" | ".join(cells)} |')
    return '\n'.join(lines)
