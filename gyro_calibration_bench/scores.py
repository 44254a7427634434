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
from typing import Any

from gyro_calibration_bench.hidden import Cause, OUTSIDE_CATALOGUE
from gyro_calibration_bench.hidden.effects import COUNTED_FAULTS, STEP_EFFECTS
import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.stats import binomtest

#: Causes that no log can distinguish.
EQUIVALENT_CAUSES = {'reference_scale': 'scale_factor_error'}
#: Largest number of names in a set that counts as right.
MAX_SET_SIZE = 3
#: Causes without an interval: counted faults, steps, and causes without a size.
WITHOUT_SIZE = {*COUNTED_FAULTS, *STEP_EFFECTS, 'unit_error', 'bias_instability'}


@dataclass(frozen=True)
class NamedCause:
    """A cause that an answer names."""

    effect: str
    ambiguous_with: tuple[str, ...] = ()  # effects that explain the log as well
    size: float | None = None  # of the leading parameter in SI, where it is known
    interval: tuple[float, float] | None = None  # of 95 %


@dataclass(frozen=True)
class Judgement:
    """Scores of an answer."""

    is_detected: bool  # something is reported
    is_first: bool  # the strongest finding has the right name
    is_in_set: bool  # each hidden cause is in the set of a separate finding
    set_sizes: tuple[int, ...]  # of the findings that contain a hidden cause
    false_names: tuple[str, ...]  # of the findings that contain none
    unexplained_variables: tuple[str, ...]  # of structures without a name
    # each hidden cause is in a set of at most three, and nothing else is reported; a cause outside
    # the catalogue is reported as unexplained, and nothing is named
    is_right: bool
    # for each cause that is named with a number, whether its 95 % interval includes the truth
    interval_holds: dict[str, bool]


def judge_answer(causes: Sequence[Cause], findings: Sequence[NamedCause],
                 unexplained_variables: Sequence[str], allowed: Collection[str] = ()) -> Judgement:
    """Compare an answer with the hidden causes; allowed names are true though not hidden."""
    wanted = {EQUIVALENT_CAUSES.get(cause.name, cause.name) for cause in causes}
    findings = [each for each in findings if each.effect not in allowed or each.effect in wanted]
    sets = [_names_in_set(each) for each in findings]
    # as many hidden causes as possible have a separate finding that contains the cause
    fits = np.array([[name in each for each in sets] for name in wanted], bool).reshape(
        len(wanted), len(sets))
    matched = int(fits[linear_sum_assignment(fits, maximize=True)].sum())
    extra = tuple(each.effect for each, names in zip(findings, sets) if not names & wanted)
    sizes = tuple(len(each) for each in sets if each & wanted)
    complete = (matched == len(wanted) == len(sizes) and max(sizes, default=0) <= MAX_SET_SIZE
                and not extra and not unexplained_variables)
    right = (bool(unexplained_variables) and not findings if wanted & set(OUTSIDE_CATALOGUE)
             else complete)
    return Judgement(
        bool(findings or unexplained_variables),
        bool(findings) and EQUIVALENT_CAUSES.get(findings[0].effect, findings[0].effect) in wanted,
        matched == len(wanted), sizes, extra, tuple(unexplained_variables), right,
        interval_holds(causes, findings))


def _names_in_set(finding: NamedCause) -> set[str]:
    """Return the set of a finding; causes that no log can distinguish are one."""
    return {EQUIVALENT_CAUSES.get(name, name)
            for name in (finding.effect, *finding.ambiguous_with)}


def interval_holds(causes: Iterable[Cause], findings: Sequence[NamedCause],
                   interval_sigmas: float = 1.96) -> dict[str, bool]:
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
            half = 0.5 * (found.interval[1] - found.interval[0]) * interval_sigmas / 1.96
            size = abs(cause.size) if 'phase' in cause.shapes else cause.size
            holds[cause.name] = bool(abs(found.size - size) <= half)
    return holds


# the table of a set of answers

@dataclass(frozen=True)
class ScoredCase:
    """A case with its answer."""

    row: str  # of the table
    # of look-alikes both have to be in the set of one finding, and with a log that separates them
    # the hidden one alone
    is_right: bool
    judgement: Judgement
    has_hidden: bool


def score_case(truth: Mapping[str, Any], answer: Mapping[str, Any]) -> ScoredCase:
    """Compare an answer, as in the file of answers, with the truth, as in `truth.json`."""
    causes = [Cause(**each) for each in truth['causes']]
    findings = [NamedCause(each['effect'], tuple(each.get('ambiguous_with', ())), each.get('size'),
                           each.get('interval') and tuple(each['interval']))
                for each in answer.get('causes', ())]
    how = judge_answer(causes, findings, ['unexplained'] * bool(answer.get('unexplained')),
                       truth['allowed'])
    right = how.is_right
    if truth['part'] == 'sets':
        pair = {EQUIVALENT_CAUSES.get(name, name) for name in truth['look_alikes']}
        right = right and any(pair <= _names_in_set(each) for each in findings)
    elif truth['part'] == 'separated':
        right = right and max(how.set_sizes) == 1
    is_clean = truth['part'] == 'references' and not causes
    row = truth['part'] + (', nothing hidden' if is_clean else '')
    return ScoredCase(row, right, how, bool(causes))


def summarize(scores: Sequence[ScoredCase]) -> dict[str, dict[str, tuple[int, int]]]:
    """Return by row and by column how many of how many."""
    rows: dict[str, list[ScoredCase]] = {}
    for each in scores:
        rows.setdefault(each.row, []).append(each)
    rows['all with something hidden'] = [each for each in scores if each.has_hidden]
    rows['all with nothing hidden'] = [each for each in scores if not each.has_hidden]
    return {name: _count_scores(own) for name, own in rows.items() if own}


def _count_scores(scores: Sequence[ScoredCase]) -> dict[str, tuple[int, int]]:
    columns = {
        'detected': [each.judgement.is_detected for each in scores],
        'first': [each.judgement.is_first for each in scores if each.has_hidden],
        'in set': [each.judgement.is_in_set for each in scores if each.has_hidden],
        'right': [each.is_right for each in scores],
        'interval': [held for each in scores for held in each.judgement.interval_holds.values()]}
    return {name: (sum(values), len(values)) for name, values in columns.items()}


def wilson_interval(good: int, count: int) -> tuple[float, float]:
    """Return the 95 % interval of a share after Wilson."""
    both = binomtest(good, count).proportion_ci(method='wilson')
    return float(both.low), float(both.high)


def markdown_table(found: Mapping[str, Mapping[str, tuple[int, int]]]) -> str:
    """Return the table in Markdown: shares with their 95 % intervals, %."""
    lines = ['| part | cases | detected | named first | in set | right | interval holds |',
             f'|---|---:{"|---:" * 5}|']
    for row, counts in found.items():
        cells = [f'{100.0 * good / count:.0f} ({100.0 * low:.0f} to {100.0 * high:.0f})' if count
                 else '' for good, count in counts.values()
                 for low, high in [wilson_interval(good, count) if count else (0.0, 0.0)]]
        lines.append(f'| {row} | {counts["right"][1]} | {" | ".join(cells)} |')
    return '\n'.join(lines)
