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
Measure how well a diagnosis finds hidden effects: false alarms, names, sets, estimates, gain.

    python benchmarks/diagnosis.py [--logs N] [--part PART ...] [--processes 2] [--verbose]
                                   [--out CASES.jsonl] [--only TEXT] [--seed N]

Each log has 15 min at 50 Hz of a random gyro in random motion, made by `gyro_calibration_bench`,
which shares nothing with the package. Sizes are multiples of the minimum detectable effect. Every
case has a name, such as ``effects/warm_up/2/mixed/rate/0``, and its random numbers depend on its
name and the seed alone: ``--only`` with a part of a name runs those cases again, ``--verbose``
prints each failed one, and ``--out`` writes all of them as JSON, one a line. Parts:

        nothing   N logs of each noise: any finding is a false alarm
        effects   N logs of each effect of the catalogue at 1.2, 2 and 5 times the detectable size
        pairs     N pairs of random effects that leave each other visible, at each multiple
        triples   the same with three
        outside   N logs of each effect outside the catalogue, at 3 times
        sets      N logs of each pair of twins, either of them hidden where they are confounded
        separated the same, with a second log that separates them
        references
                  N logs of 10 min at 25 Hz for each reference that errs: with nothing hidden,
                  without a model, and with one that is right (its bias instability is the floor
                  of the Allan deviation); and N with effects at each multiple, in turn

    What is suspected only does not count, but for the column `suspected`, which has such names a
    log; of what happens once (`methods.SINGLE_EVENTS`), which is never established, it does. The
    figures: `detected`, something is reported; `first`, the strongest finding has the right name;
    `in set`, each hidden cause is a finding or in the set of one; `set size`, of the findings that
    hold a hidden cause; `extra`, findings that hold none, a log; `beyond`,
    structures without a name, a log; `right`, each hidden cause is found or in a set of at most
    three, and nothing else is reported; `interval`, the size lies in its 95 % interval, of those
    that are named and are numbers; `gain`, the improvement on held-out parts over that with all
    known but the bias; `heading`, the same of the change of heading over 60 s; `time`, of a
    processor a log.

    A scale factor error of the gyro and one of the reference are the same in any log, and count as
    one. The diagnosis is given no model, except for effects that show only against one: bias,
    scale factor, and noise; that model is right but for what is hidden.

"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
import json
import math
from multiprocessing import get_context
import os
from pathlib import Path
import re
import sys
import time
from typing import Any

os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
sys.path.insert(0, str(Path(__file__).parent.parent / 'test'))

from diagnosed import diagnosis_of, judge_findings, won  # noqa: E402
from gyro_calibration.diagnosis.findings import Finding  # noqa: E402
from gyro_calibration_bench.cases import (  # noqa: E402
    Case,
    make_logs,
    part_cases,
    PARTS,
    random_source,
)
from gyro_calibration_bench.hidden import Cause  # noqa: E402
from gyro_calibration_bench.methods import reported_findings  # noqa: E402
from gyro_calibration_bench.scores import Judgement  # noqa: E402
import numpy as np  # noqa: E402  (after the number of its threads is set)


@dataclass(frozen=True)
class Answer:
    """What was hidden in a case, what was answered, and how right that is."""

    case: str
    row: str
    hidden: Mapping[str, Mapping[str, Any]]
    findings: Sequence[Mapping[str, Any]]
    problem: str
    seconds: float
    how: Judgement
    gain: Mapping[str, tuple[float, float]]
    right: bool
    suspected: Sequence[str]


# the answers

def answered(case: Case, seed: int) -> Answer:
    """Run a case; one that fails in whatever way is a row of the table, and not the end of it."""
    generator = random_source(case, seed)
    logs = make_logs(case, generator)
    hidden = logs[0]
    begin, found, problem = time.process_time(), None, ''
    try:
        found = diagnosis_of(logs, generator, case.has_model)
    except Exception as raised:
        problem = f'{type(raised).__name__}: {raised}'
    seconds = time.process_time() - begin
    findings, beyond = ([], []) if found is None else (
        reported_findings(found.findings), [each.along for each in found.unexplained])
    suspected = [] if found is None else [each.effect for each in found.findings
                                          if each not in findings]
    how = judge_findings(hidden, findings, beyond, case.allowed)
    return Answer(str(case), case.table_row,
                  {cause.name: _told(cause) for cause in hidden.truth.gyro.causes},
                  [_answer(each) for each in findings], problem, seconds, how,
                  won(hidden, found) if found is not None and hidden.truth.names
                  and case.part not in ('references', 'separated') else {},
                  how.is_right and not problem, suspected)


def _told(cause: Cause) -> dict[str, Any]:
    return {key: value for key, value in asdict(cause).items() if key != 'name'
            and not (isinstance(value, float) and math.isnan(value))}


def _answer(finding: Finding) -> dict[str, Any]:
    return {'effect': finding.effect, 'ambiguous_with': list(finding.ambiguous_with),
            'p_value': finding.p_value,
            'parameters': {name: [each.estimate, *each.interval]
                           for name, each in finding.parameters.items()}}


# the table

HEADER = ('| hidden | logs | detected | first | in set | set size | extra | beyond '
          '| suspected | right | interval | gain | heading | time, s |')


def line(row: str, answers: Sequence[Answer]) -> str:
    """Return a row of the table in Markdown, in percent where it is a share."""
    sizes = [size for each in answers for size in each.how.set_sizes]
    held = [value for each in answers for value in each.how.interval_holds.values()]
    cells = [row, str(len(answers)), _percent([each.how.is_detected for each in answers])]
    hidden = [_percent([getattr(each.how, name) for each in answers])
              for name in ('is_first', 'is_in_set')]
    cells += hidden if any(each.hidden for each in answers) else ['', '']
    cells += [
        f'{np.mean(sizes):.2f}' if sizes else '',
        f'{np.mean([len(each.how.false_names) for each in answers]):.3f}',
        f'{np.mean([len(each.how.unexplained_variables) for each in answers]):.3f}',
        f'{np.mean([len(each.suspected) for each in answers]):.3f}',
        _percent([each.right for each in answers]),
        _percent(held),
        _share(answers, 'rate'),
        _share(answers, 'heading'), f'{np.mean([each.seconds for each in answers]):.1f}'
    ]
    return f'| {" | ".join(cells)} |'


def _percent(values: Sequence[bool]) -> str:
    return f'{100.0 * float(np.mean(values)):.1f}' if values else ''


def _share(answers: Sequence[Answer], name: str) -> str:
    """Return what was won of all that an oracle wins."""
    both = np.array([each.gain[name] for each in answers if name in each.gain])
    return f'{both[:, 0].sum() / both[:, 1].sum():.3f}' if len(both) else ''


def failing(answer: Answer) -> str:
    """Return what went wrong in a case, in a line or two."""
    hidden = ', '.join(f'{name} {_short(each)}' for name, each in answer.hidden.items())
    said = [f'{"|".join([each["effect"], *each["ambiguous_with"]])} p={each["p_value"]:.1e} '
            f'{_short(each["parameters"])}' for each in answer.findings]
    said += [f'unexplained along {along}' for along in answer.how.unexplained_variables
             ] + [answer.problem] * bool(answer.problem)
    return (f'{answer.case}\n    hidden: {hidden or "nothing"}\n'
            f'    answer: {"; ".join(said) or "nothing"}')


def _short(value: Any) -> str:
    """Return numbers with four digits."""
    if isinstance(value, Mapping):
        return '{' + ', '.join(f'{name}: {_short(each)}'
                               for name, each in value.items() if name != 'unit') + '}'
    if isinstance(value, (list, tuple)):
        return f'[{", ".join(_short(each) for each in value)}]'
    return f'{value:.4g}' if isinstance(value, float) else str(value)


def main(words: Sequence[str] | None = None) -> None:
    """Run the parts and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').strip().splitlines()[0])
    parser.add_argument('--logs', type=int, default=2, help='of each kind; default: 2')
    parser.add_argument('--part', nargs='+', default=PARTS)
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--only', default='',
                        help='cases in whose names this regular expression is found')
    parser.add_argument('--processes', type=int, default=1)
    parser.add_argument('--verbose', action='store_true', help='print each case that fails')
    parser.add_argument('--out', help='a file for all cases, JSON, one a line')
    given = parser.parse_args(words)
    print(f'seed {given.seed}, {given.logs} logs of each kind\n\n{HEADER}\n|---|{"---:|" * 13}',
          flush=True)
    for part in given.part:
        chosen = [
            case for case in part_cases(part, given.logs) if re.search(given.only, str(case))
        ]
        _print(_run(chosen, given))


def _run(chosen: Sequence[Case], given: argparse.Namespace) -> Iterator[Answer]:
    """Run cases, in some processes, and keep them in a file."""
    with get_context('fork').Pool(given.processes) as pool:
        for answer in pool.imap(partial(answered, seed=given.seed), chosen):
            if given.verbose and not answer.right:
                print(failing(answer), file=sys.stderr, flush=True)
            if given.out:
                with open(given.out, 'a') as file:
                    file.write(json.dumps(asdict(answer)) + '\n')
            yield answer


def _print(answers: Iterable[Answer]) -> None:
    rows: dict[str, list[Answer]] = {}
    for answer in answers:
        rows.setdefault(answer.row, []).append(answer)
    for row, own in rows.items():
        print(line(row, own), flush=True)


if __name__ == '__main__':
    main()
