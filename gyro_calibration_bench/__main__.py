# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.
"""Make a bench, answer it by gyro_calibration, and score answers."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict
import json
import os
from pathlib import Path
import sys
import time
from typing import Any

# the matrices are small; threads that wait for each other make it slower
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

# ruff: noqa: E402
from gyro_calibration.files import format_json
from gyro_calibration_bench.cases import Case, make_logs, part_cases, PARTS, random_source
from gyro_calibration_bench.hidden import FORMS
from gyro_calibration_bench.hidden.effects import MODEL_FINDINGS
from gyro_calibration_bench.methods import answer_logs
from gyro_calibration_bench.scores import markdown_table, score_case, summarize, wilson_interval
import numpy as np
from tqdm import tqdm

CASES, TRUTH, ANSWERS = (f'gyro_calibration_bench/{name}/1'
                         for name in ('cases', 'truth', 'answers'))


def main(words: Sequence[str] | None = None) -> int:
    """Run a command, and return 0, or 2 for a file that is not as it should be."""
    parser = argparse.ArgumentParser(prog='python -m gyro_calibration_bench', description=__doc__)
    commands = parser.add_subparsers(required=True, metavar='COMMAND')
    command = commands.add_parser('make', help='write logs, cases.json and truth.json')
    command.add_argument('folder', type=Path, metavar='DIR')
    command.add_argument('--seed', type=int, default=0)
    command.add_argument('--cases', type=int, default=2, help='of each part; default: 2')
    command.add_argument('--part', nargs='+', choices=PARTS, default=PARTS)
    command.set_defaults(command=make)
    command = commands.add_parser('answer', help='answer the cases by gyro_calibration')
    command.add_argument('folder', type=Path, metavar='DIR')
    command.add_argument('--out', type=Path, required=True, metavar='ANSWERS.json')
    command.set_defaults(command=answer)
    command = commands.add_parser('score', help='compare answers with the truth')
    command.add_argument('folder', type=Path, metavar='DIR')
    command.add_argument('answers', type=Path, metavar='ANSWERS.json')
    command.add_argument('--json', action='store_true', help='print counts and intervals as JSON')
    command.set_defaults(command=score)
    given = parser.parse_args(words)
    try:
        given.command(given)
    except (OSError, ValueError) as problem:
        print(f'{parser.prog}: {problem}', file=sys.stderr)
        return 2
    return 0


def make(given: argparse.Namespace) -> None:
    """Draw cases of each part, and write them in an order that does not tell the part."""
    generator = np.random.default_rng(given.seed)
    drawn: list[Case] = []
    for part in given.part:
        every = list(part_cases(part, given.cases))
        drawn += [every[place]
                  for place in generator.choice(len(every), given.cases, replace=False)]
    given.folder.mkdir(parents=True, exist_ok=True)
    public: dict[str, Any] = {}
    truth: dict[str, Any] = {}
    for number, place in enumerate(tqdm(generator.permutation(len(drawn)), 'logs are made',
                                        disable=None)):
        case, name = drawn[place], f'{number:04d}'
        logs = make_logs(case, random_source(case, given.seed))
        paths = [each.write(given.folder / f'{name}{"ab"[run] if len(logs) > 1 else ""}.csv.gz')
                 for run, each in enumerate(logs)]
        causes = logs[0].truth.gyro.causes
        wanted = case.has_model or any(each.name in MODEL_FINDINGS for each in causes)
        public[name] = {'logs': [path.name for path in paths],
                        'model': dict(logs[0].truth.expected) if wanted else None}
        truth[name] = {'case': str(case), 'part': case.part, 'look_alikes': case.look_alikes,
                       'allowed': case.allowed, 'causes': [asdict(each) for each in causes]}
    effects = {name: form.unit for name, form in FORMS.items()}
    _write(given.folder / 'cases.json', CASES, seed=given.seed, effects=effects, cases=public)
    _write(given.folder / 'truth.json', TRUTH, seed=given.seed, cases=truth)
    print(f'{len(drawn)} cases in {given.folder}; cases.json lists them, truth.json is for '
          'scoring alone')


def answer(given: argparse.Namespace) -> None:
    """Answer all cases; one that fails has an empty answer, and its error."""
    public = _read(given.folder / 'cases.json', CASES)['cases']
    answers: dict[str, Any] = {}
    begin = time.process_time()
    for name, case in tqdm(public.items(), 'cases are answered', disable=None):
        try:
            causes, unexplained = answer_logs([given.folder / log for log in case['logs']],
                                              case['model'])
            answers[name] = {'causes': [asdict(each) for each in causes],
                             'unexplained': unexplained}
        except Exception as problem:
            answers[name] = {'causes': [], 'error': f'{type(problem).__name__}: {problem}'}
    _write(given.out, ANSWERS, method='gyro_calibration',
           seconds=round(time.process_time() - begin, 1), answers=answers)
    failed = sum('error' in each for each in answers.values())
    print(f'{len(answers)} answers in {given.out}, {failed} with an error')


def score(given: argparse.Namespace) -> None:
    """Print the table; a case without an answer counts as one in which nothing is reported."""
    truth = _read(given.folder / 'truth.json', TRUTH)['cases']
    content = _read(given.answers, ANSWERS)
    answers = content['answers']
    if unknown := set(answers) - set(truth):
        raise ValueError(f'{given.answers}: no such cases: {", ".join(sorted(unknown)[:5])}')
    found = summarize(
        [score_case(each, answers.get(name, {}))
         for name, each in sorted(truth.items(), key=lambda item: PARTS.index(item[1]['part']))])
    if given.json:
        print(json.dumps(
            {row: {column: {'good': good, 'of': count,
                            'interval': wilson_interval(good, count) if count else None}
                   for column, (good, count) in counts.items()} for row, counts in found.items()}))
        return
    print(f'{content.get("method", "")}: {len(answers)} answers to {len(truth)} cases; %, with '
          f'Wilson intervals of 95 %\n\n{markdown_table(found)}')


def _write(path: Path, schema: str, **content: Any) -> None:
    path.write_text(format_json({'schema': schema, **content}) + '\n')


def _read(path: Path, schema: str) -> Any:
    content = json.loads(path.read_text())
    if not isinstance(content, dict) or content.get('schema') != schema:
        raise ValueError(f'{path}: "schema" is not "{schema}"')
    return content


if __name__ == '__main__':
    sys.exit(main())
