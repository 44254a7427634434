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
Measure how well a diagnosis finds hidden effects: false alarms, names, sets, estimates.

    python benchmarks/diagnosis.py [--logs N] [--part PART ...] [--processes 2] [--verbose]
                                   [--only TEXT] [--seed N]

Each log has 15 min at 50 Hz of a random gyro in random motion, made by `gyro_calibration_bench`,
which shares nothing with the package. Sizes are multiples of the minimum detectable effect. Every
case has a name, such as ``effects/warm_up/2/mixed/rate/0``, and its random numbers depend on its
name and the seed alone: ``--only`` with a part of a name runs those cases again, and ``--verbose``
prints each failed one. Parts:

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

    What is suspected only does not count, except what happens once (`methods.SINGLE_EVENTS`),
    which is never established. The figures: `detected`, something is reported; `first`, the
    strongest finding has the right name; `in set`, each hidden cause is a finding or in the set of
    one; `set size`, of the findings that hold a hidden cause; `extra`, findings that hold none, a
    log; `beyond`, structures without a name, a log; `right`, each hidden cause is found or in a
    set of at most three, and nothing else is reported; `interval`, the size lies in its 95 %
    interval, of those that are named and are numbers; `time`, of a processor a log.

    A scale factor error of the gyro and one of the reference are the same in any log, and count as
    one. The diagnosis is given no model, except for effects that show only against one: bias,
    scale factor, and noise; that model is right but for what is hidden.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
import os
from pathlib import Path
import re
import sys
import time

os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
sys.path.insert(0, str(Path(__file__).parent.parent / 'test'))

from diagnosed import described, diagnosis_of, judge_findings  # noqa: E402
from gyro_calibration_bench.cases import (  # noqa: E402
    Case,
    make_logs,
    part_cases,
    PARTS,
    random_source,
)
from gyro_calibration_bench.methods import reported_findings  # noqa: E402
from gyro_calibration_bench.scores import Judgement  # noqa: E402
import numpy as np  # noqa: E402  (after the number of its threads is set)


@dataclass(frozen=True)
class Answer:
    """How right the answer to a case is, and what was hidden and answered, as text."""

    row: str
    how: Judgement
    right: bool
    is_hidden: bool
    seconds: float
    text: str


def table_row(case: Case) -> str:
    """Return the row of the table that a case counts in."""
    if case.part == 'references':
        kind, suffix = case.reference, ', with a model' if case.noise == 'floor' else ''
        return f'{kind}, ' + (f'{case.multiple:g} times' if case.names else 'nothing' + suffix)
    return {'nothing': f'nothing, {case.noise}',
            'effects': f'one effect, {case.multiple:g} times',
            'pairs': f'two effects, {case.multiple:g} times',
            'triples': f'three effects, {case.multiple:g} times',
            'outside': f'outside the catalogue, {case.multiple:g} times',
            'sets': 'look-alikes',
            'separated': 'look-alikes, and a log that separates them'}[case.part]


def answered(case: Case, seed: int) -> Answer:
    """Run a case; one that fails in whatever way is a row of the table, and not the end of it."""
    generator = random_source(case, seed)
    logs = make_logs(case, generator)
    hidden, begin, findings, beyond = logs[0], time.process_time(), [], []
    try:
        found = diagnosis_of(logs, generator, case.has_model)
        findings = reported_findings(found.findings)
        beyond, text, failed = ([each.along for each in found.unexplained],
                                described(hidden, found), False)
    except Exception as raised:
        text, failed = f'{type(raised).__name__}: {raised}', True
    seconds = time.process_time() - begin
    how = judge_findings(hidden, findings, beyond, case.allowed)
    return Answer(table_row(case), how, how.is_right and not failed, bool(hidden.truth.names),
                  seconds, f'{case}\n    {text}')


HEADER = ('| hidden | logs | detected | first | in set | set size | extra | beyond '
          '| right | interval | time, s |')


def line(row: str, answers: Sequence[Answer]) -> str:
    """Return a row of the table in Markdown, in percent where it is a share."""
    how = [each.how for each in answers]
    sizes = [size for each in how for size in each.set_sizes]
    held = [value for each in how for value in each.interval_holds.values()]
    hidden = [each.how for each in answers if each.is_hidden]
    cells = [row, str(len(answers)), _percent([each.is_detected for each in how]),
             _percent([each.is_first for each in hidden]),
             _percent([each.is_in_set for each in hidden]),
             f'{np.mean(sizes):.2f}' if sizes else '',
             f'{np.mean([len(each.false_names) for each in how]):.3f}',
             f'{np.mean([len(each.unexplained_variables) for each in how]):.3f}',
             _percent([each.right for each in answers]), _percent(held),
             f'{np.mean([each.seconds for each in answers]):.1f}']
    return f'| {" | ".join(cells)} |'


def _percent(values: Sequence[bool]) -> str:
    return f'{100.0 * float(np.mean(values)):.1f}' if values else ''


def main(words: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or '').strip().splitlines()[0])
    parser.add_argument('--logs', type=int, default=2, help='of each kind; default: 2')
    parser.add_argument('--part', nargs='+', default=PARTS)
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--only', default='',
                        help='cases in whose names this regular expression is found')
    parser.add_argument('--processes', type=int, default=1)
    parser.add_argument('--verbose', action='store_true', help='print each case that fails')
    given = parser.parse_args(words)
    print(f'seed {given.seed}, {given.logs} logs of each kind\n\n{HEADER}\n|---|{"---:|" * 10}',
          flush=True)
    with get_context('fork').Pool(given.processes) as pool:
        for part in given.part:
            rows: dict[str, list[Answer]] = {}
            for answer in pool.imap(partial(answered, seed=given.seed), [
                    case for case in part_cases(part, given.logs)
                    if re.search(given.only, str(case))]):
                rows.setdefault(answer.row, []).append(answer)
                if given.verbose and not answer.right:
                    print(answer.text, file=sys.stderr, flush=True)
            for row, own in rows.items():
                print(line(row, own), flush=True)


if __name__ == '__main__':
    main()
