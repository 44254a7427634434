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
Cases of the bench: hidden effects, noise and reference of each.

A case has a name, such as ``effects/warm_up/2/mixed/rate/0``; its random numbers depend on the
name and a seed alone.

"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
import math
import zlib

from gyro_calibration_bench.hidden import FORMS, HiddenLog, hide, OUTSIDE, part, twin, TWINS
from gyro_calibration_bench.hidden.effects import AGAINST_A_MODEL
from gyro_calibration_bench.hidden.reference import hide_beside, Imperfect
import numpy as np

#: In the order of the tables.
PARTS = ('nothing', 'effects', 'pairs', 'triples', 'outside', 'sets', 'separated', 'references')
MULTIPLES = (1.2, 2.0, 5.0)
#: Noises in which false alarms are counted.
ALARMS = ('white', 'walk', 'flicker')
NOISES = ('mixed', 'walk', 'flicker', 'white', 'gauss_markov')
#: References in turn: a rate, a heading, and the heading of an encoder.
REFERENCES = ('rate', 'heading', 'rate', 'encoder')
ENCODER_STEP = 2.0 * math.pi / 65536
#: References with errors, and the effects that are hidden in logs with them in turn.
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
#: Correct findings on references that were not hidden.
TRUE = {'encoder': ('reference_quantization',), 'course': ('time_offset',)}
#: Effects that are not combined: findings against a model, and a wrong unit, which changes sizes.
ALONE = {*AGAINST_A_MODEL, 'unit_error'}
#: Least share of the multiple of an effect that is independent of the others.
LEFT = 0.8


@dataclass(frozen=True)
class Case:
    """What is hidden in a log, or in two of one gyro; random by its name and a seed alone."""

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
        """Whether a model is given because of what the case is; None: what is hidden decides."""
        floor = self.part == 'references' and self.noise == 'floor'
        return floor or self.twins is not None and TWINS[self.twins].against_a_model or None

    @property
    def allowed(self) -> tuple[str, ...]:
        """Return the correct findings on the reference that were not hidden."""
        return TRUE.get(self.reference.partition('_')[0], ())

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
                'sets': 'look-alikes',
                'separated': 'look-alikes, and a log that separates them'}[self.part]


def cases(part: str, logs: int) -> Iterator[Case]:
    """Go through the cases of a part."""
    if part == 'nothing':
        yield from (Case(part, (), 0.0, noise, _turn(REFERENCES, number), number)
                    for number in range(logs) for noise in ALARMS)
    elif part in ('sets', 'separated'):
        yield from (Case(part, (name,), 0.0, 'white', 'rate', number, pair)
                    for number in range(logs) for pair in TWINS for name in pair
                    if part == 'sets' or TWINS[pair].apart is not None)
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


def source(case: Case, seed: int) -> np.random.Generator:
    """Return the source of all that is random in a case."""
    return np.random.default_rng([seed, zlib.crc32(str(case).encode())])


def made(case: Case, generator: np.random.Generator) -> list[HiddenLog]:
    """Hide what a case asks for; two logs of one gyro where the second separates look-alikes."""
    if case.part == 'references':
        noise = 'gauss_markov' if case.noise == 'floor' else case.noise
        return [hide_beside(
            case.names, case.multiple, generator, IMPERFECT[case.reference], noise)]
    if case.twins is not None:
        log = twin(case.twins, case.names[0], generator)
        return [log] if case.part == 'sets' else [log, part(case.twins, log, generator)]
    step = ({'reference': 'heading', 'encoder_step': ENCODER_STEP} if case.reference == 'encoder'
            else {'reference': case.reference})
    if case.part not in ('pairs', 'triples'):
        return hide(case.names, case.multiple, generator, noise=case.noise, **step)
    choices = [name for name in FORMS if name not in ALONE]
    while True:
        names = [str(name) for name in generator.choice(choices, 2 if case.part == 'pairs' else 3,
                                                        replace=False)]
        logs = hide(names, case.multiple, generator, noise=case.noise, **step)
        if all(not cause.apart < LEFT * cause.multiple for cause in logs[0].truth.gyro.causes):
            return logs
