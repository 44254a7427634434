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
                                   [--out CASES.jsonl] [--only TEXT] [--seed N] [--with-model]

Each log has 15 min at 50 Hz of a random gyro in random motion, made by `test/hidden`, which shares
nothing with the package. Sizes are multiples of the minimum detectable effect. Every case has a
name, such as ``effects/warm_up/2/mixed/rate/0``, and its random numbers depend on its name and the
seed alone: ``--only`` with a part of a name runs those cases again, ``--verbose`` prints each
failed one, and ``--out`` writes all of them as JSON, one a line. Parts:

        nothing   N logs of each noise: any finding is a false alarm
        effects   N logs of each effect of the catalogue at 1.2, 2 and 5 times the detectable size
        pairs     N pairs of random effects that leave each other visible, at each multiple
        triples   the same with three
        outside   N logs of each effect outside the catalogue, at 3 times
        sets      N logs of each pair of twins, either of them hidden where they are confounded
        references
                  N logs of 10 min at 25 Hz for each reference that errs: with nothing hidden,
                  without a model, and with one that is right (its bias instability is the floor
                  of the Allan deviation); and N with effects at each multiple, in turn

    What is suspected only does not count, but for the column `suspected`, which has such names a
    log; of what happens once (`ONCE`), which is never established, it does. The figures:
    `detected`, something is reported; `first`, the strongest finding has the right name; `in
    set`, each hidden cause is a finding or in the set of one; `set size`, of the findings that
    hold a hidden cause; `extra`, findings that hold none, a log; `beyond`,
    structures without a name, a log; `right`, each hidden cause is found or in a set of at most
    three, and nothing else is reported; `interval`, the size lies in its 95 % interval, of those
    that are named and are numbers; `gain`, the improvement on held-out parts over that with all
    known but the bias; `heading`, the same of the change of heading over 60 s; `time`, of a
    processor a log.

    A scale factor error of the gyro and one of the reference are the same in any log, and count as
    one. The diagnosis is given no model, except for effects that show only against one: bias,
    scale factor, and noise; that model is right but for what is hidden. `--with-model` always
    gives such a model.

"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
import json
import math
from multiprocessing import get_context
import os
from pathlib import Path
import re
import sys
import time
from typing import Any
import zlib

os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
sys.path.insert(0, str(Path(__file__).parent.parent / 'test'))

from diagnosed import diagnosis_of, Judged, judged, won  # noqa: E402
from gyro_calibration.diagnosis.findings import Finding  # noqa: E402
from hidden import Cause, FORMS, HiddenLog, hide, OUTSIDE, twin, TWINS  # noqa: E402
from hidden.effects import AGAINST_A_MODEL  # noqa: E402
from hidden.reference import hide_beside, Imperfect  # noqa: E402
import numpy as np  # noqa: E402  (after the number of its threads is set)

MULTIPLES = (1.2, 2.0, 5.0)
#: The false alarms are counted in each of these; whatever else is hidden has them in turn.
ALARMS = ('white', 'walk', 'flicker')
NOISES = ('mixed', 'walk', 'flicker', 'white', 'gauss_markov')
#: References in turn: a rate, a heading, and the heading of an encoder.
REFERENCES = ('rate', 'heading', 'rate', 'encoder')
ENCODER_STEP = 2.0 * math.pi / 65536
#: References that err, and the effects that are hidden beside them in turn.
IMPERFECT = {
    f'{kind}_{size:g}': Imperfect(kind, size)
    for kind, sizes in (
        ('rate', (0.1, 0.3, 0.5)),
        ('capture', (0.02, 0.05, 0.1)),
        ('encoder', (0.09, 0.5)),
        ('course', (1.0, 5.0, 10.0)),
    )
    for size in sizes
}
BESIDE = (
    'scale_factor_asymmetry',
    'cubic_nonlinearity',
    'heading_sensitivity',
    'bias_temperature',
    'scale_factor_temperature',
    'warm_up',
    'time_offset',
    'bandwidth',
    'reference_once_per_rev',
    'reference_slip',
    'bias_step',
    'acceleration_sensitivity',
)
#: What is true of references without being hidden.
TRUE = {'encoder': ('reference_quantization',), 'course': ('time_offset',)}
#: Causes that happen once; their names count even where they are suspected only.
ONCE = ('bias_step', 'reference_slip')
#: Not in pairs: findings against a model only, and a wrong unit, which changes other sizes.
ALONE = {*AGAINST_A_MODEL, 'unit_error'}
#: So much of its multiple each of several effects must keep beside the others.
LEFT = 0.8


@dataclass(frozen=True)
class Case:
    """One log to be diagnosed; its random numbers come of its name and a seed."""

    part: str
    names: tuple[str, ...]
    multiple: float
    noise: str
    reference: str
    number: int
    twins: tuple[str, str] | None = None

    def __str__(self) -> str:
        what = '+'.join(self.names) or ('random' if self.multiple else 'nothing')
        beside = '' if self.twins is None else f'({"|".join(self.twins)})'
        return (f'{self.part}/{what}{beside}/{self.multiple:g}/{self.noise}/{self.reference}/'
                f'{self.number}')

    @property
    def against_a_model(self) -> bool | None:
        """Whether twins show only beside a model; None where what is hidden decides it."""
        return True if self.twins is not None and TWINS[self.twins].against_a_model else None

    @property
    def row(self) -> str:
        """Return the row of the table that it belongs to."""
        if self.part == 'references':
            kind, beside = self.reference, ', with a model' if self.noise == 'floor' else ''
            return f'{kind}, ' + (f'{self.multiple:g} times' if self.names else 'nothing' + beside)
        return {'nothing': f'nothing, {self.noise}',
                'effects': f'one effect, {self.multiple:g} times',
                'pairs': f'two effects, {self.multiple:g} times',
                'triples': f'three effects, {self.multiple:g} times',
                'outside': f'outside the catalogue, {self.multiple:g} times',
                'sets': 'twins, not to be told apart'}[self.part]


@dataclass(frozen=True)
class Answer:
    """What was hidden in a case, what was answered, and how right that is."""

    case: str
    row: str
    hidden: Mapping[str, Mapping[str, Any]]
    findings: Sequence[Mapping[str, Any]]
    problem: str
    seconds: float
    how: Judged
    gain: Mapping[str, tuple[float, float]]
    right: bool
    suspected: Sequence[str]


# the cases

def cases(part: str, logs: int) -> Iterator[Case]:
    """Go through the cases of a part."""
    if part == 'nothing':
        yield from (Case(part, (), 0.0, noise, _turn(REFERENCES, number), number)
                    for number in range(logs) for noise in ALARMS)
    elif part == 'sets':
        yield from (Case(part, (name,), 0.0, 'white', 'rate', number, pair)
                    for number in range(logs) for pair in TWINS for name in pair)
    elif part == 'references':
        for place, reference in enumerate(IMPERFECT):
            for number in range(logs):
                yield Case(part, (), 0.0, _turn(NOISES, number), reference, number)
                yield Case(part, (), 0.0, 'floor', reference, number)
                for multiple in MULTIPLES:
                    name = _turn(BESIDE, number * len(IMPERFECT) + place)
                    yield Case(part, (name,), multiple, _turn(NOISES, number), reference, number)
    else:
        multiples = (3.0,) if part == 'outside' else MULTIPLES
        names: Sequence[tuple[str, ...]] = (
            [(name,) for name in {'effects': FORMS, 'outside': OUTSIDE}.get(part, ())] or [()])
        yield from (Case(part, each, multiple, _turn(NOISES, number + place),
                         _reference(each, number + place), number) for number in range(logs)
                    for multiple in multiples for place, each in enumerate(names))


def _turn(choices: Sequence[str], number: int) -> str:
    return choices[number % len(choices)]


def _reference(names: Sequence[str], number: int) -> str:
    """Choose a reference; figures of the noise are sized without encoder steps."""
    return 'rate' if any(name in FORMS and FORMS[name].stage == 'noise'
                         for name in names) else _turn(REFERENCES, number)


def made(case: Case, generator: np.random.Generator) -> HiddenLog:
    """Hide what a case asks for."""
    if case.part == 'references':
        noise = 'gauss_markov' if case.noise == 'floor' else case.noise
        return hide_beside(
            case.names, case.multiple, generator, IMPERFECT[case.reference], noise)
    if case.twins is not None:
        return twin(case.twins, case.names[0], generator)
    step = ({'reference': 'heading', 'encoder_step': ENCODER_STEP} if case.reference == 'encoder'
            else {'reference': case.reference})
    if case.part not in ('pairs', 'triples'):
        return hide(case.names, case.multiple, generator, noise=case.noise, **step)[0]
    choices = [name for name in FORMS if name not in ALONE]
    while True:
        names = [str(name) for name in generator.choice(choices, 2 if case.part == 'pairs' else 3,
                                                        replace=False)]
        log, = hide(names, case.multiple, generator, noise=case.noise, **step)
        if all(not cause.apart < LEFT * cause.multiple for cause in log.truth.gyro.causes):
            return log


# the answers

def answered(case: Case, seed: int, with_model: bool | None = None) -> Answer:
    """Run a case; one that fails in whatever way is a row of the table, and not the end of it."""
    generator = np.random.default_rng([seed, zlib.crc32(str(case).encode())])
    hidden = made(case, generator)
    begin, found, problem = time.process_time(), None, ''
    try:
        found = diagnosis_of([hidden], generator, with_model or case.against_a_model
                             or case.noise == 'floor' or None)
    except Exception as raised:
        problem = f'{type(raised).__name__}: {raised}'
    seconds = time.process_time() - begin
    findings, beyond = ((), []) if found is None else (found.findings,
                                                       [each.along for each in found.unexplained])
    findings = tuple(each for each in findings
                     if each.status == 'established'
                     or each.effect in ONCE and each.p_value < 0.01)
    suspected = [] if found is None else [each.effect for each in found.findings
                                          if each not in findings]
    how = judged(hidden, findings, beyond, TRUE.get(case.reference.partition('_')[0], ()))
    return Answer(str(case), case.row,
                  {cause.name: _told(cause) for cause in hidden.truth.gyro.causes},
                  [_answer(each) for each in findings], problem, seconds, how,
                  won(hidden, found) if found is not None and hidden.truth.names
                  and case.part != 'references' else {},
                  how.right and not problem, suspected)


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
    held = [value for each in answers for value in each.how.held.values()]
    cells = [row, str(len(answers)), _percent([each.how.detected for each in answers])]
    hidden = [_percent([getattr(each.how, name) for each in answers])
              for name in ('first', 'in_set')]
    cells += hidden if any(each.hidden for each in answers) else ['', '']
    cells += [f'{np.mean(sizes):.2f}' if sizes else '',
              f'{np.mean([len(each.how.extra) for each in answers]):.3f}',
              f'{np.mean([len(each.how.beyond) for each in answers]):.3f}',
              f'{np.mean([len(each.suspected) for each in answers]):.3f}',
              _percent([each.right for each in answers]), _percent(held), _share(answers, 'rate'),
              _share(answers, 'heading'), f'{np.mean([each.seconds for each in answers]):.1f}']
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
    said += [f'unexplained along {along}'
             for along in answer.how.beyond] + [answer.problem] * bool(answer.problem)
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
    parser.add_argument('--part', nargs='+',
                        default=['nothing', 'effects', 'pairs', 'triples', 'outside', 'sets',
                                 'references'])
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--only', default='',
                        help='cases in whose names this regular expression is found')
    parser.add_argument('--with-model', action='store_true',
                        help='of the simulation, right but for what is hidden')
    parser.add_argument('--processes', type=int, default=1)
    parser.add_argument('--verbose', action='store_true', help='print each case that fails')
    parser.add_argument('--out', help='a file for all cases, JSON, one a line')
    given = parser.parse_args(words)
    print(f'seed {given.seed}, {given.logs} logs of each kind\n\n{HEADER}\n|---|{"---:|" * 13}',
          flush=True)
    for part in given.part:
        chosen = [case for case in cases(part, given.logs) if re.search(given.only, str(case))]
        _print(_run(chosen, given))


def _run(chosen: Sequence[Case], given: argparse.Namespace) -> Iterator[Answer]:
    """Run cases, in some processes, and keep them in a file."""
    jobs = [(case, given.seed, given.with_model or None) for case in chosen]
    with get_context('fork').Pool(given.processes) as pool:
        for answer in pool.imap(_answered, jobs):
            if given.verbose and not answer.right:
                print(failing(answer), file=sys.stderr, flush=True)
            if given.out:
                with open(given.out, 'a') as file:
                    file.write(json.dumps(asdict(answer)) + '\n')
            yield answer


def _answered(job: tuple[Case, int, bool | None]) -> Answer:
    return answered(*job)


def _print(answers: Iterable[Answer]) -> None:
    rows: dict[str, list[Answer]] = {}
    for answer in answers:
        rows.setdefault(answer.row, []).append(answer)
    for row, own in rows.items():
        print(line(row, own), flush=True)


if __name__ == '__main__':
    main()
