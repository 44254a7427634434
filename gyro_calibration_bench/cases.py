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

from gyro_calibration_bench.hidden import (
    FORMS, HiddenLog, hide, hide_look_alike, LOOK_ALIKES, OUTSIDE_CATALOGUE, record_separating)
from gyro_calibration_bench.hidden.conditions import hide_with_reference, ImperfectReference
from gyro_calibration_bench.hidden.effects import MODEL_FINDINGS
import numpy as np

#: In the order of the tables.
PARTS = ('nothing', 'effects', 'pairs', 'triples', 'outside', 'sets', 'separated', 'references')
SIZE_MULTIPLES = (1.2, 2.0, 5.0)
#: Noises in which false alarms are counted.
ALARM_NOISES = ('white', 'walk', 'flicker')
NOISES = ('mixed', 'walk', 'flicker', 'white', 'gauss_markov')
#: References in turn: a rate, a heading, and the heading of an encoder.
REFERENCES = ('rate', 'heading', 'rate', 'encoder')
ENCODER_STEP = 2.0 * math.pi / 65536
#: References with errors, and the effects that are hidden in logs with them in turn.
IMPERFECT_REFERENCES = {
    f'{kind}_{size:g}': ImperfectReference(kind, size)
    for kind, sizes in (('rate', (0.1, 0.3, 0.5)),
                        ('capture', (0.0005, 0.002, 0.005, 0.02, 0.05, 0.1)),
                        ('encoder', (0.09, 0.5)), ('course', (1.0, 5.0, 10.0)), ('held', (0.2,)),
                        ('lines', (0.2,)), ('heldrate', (0.2,)), ('linesrate', (0.2,)),
                        ('lost', (10.0,))) for size in sizes}
COMPANION_EFFECTS = ('scale_factor_asymmetry', 'cubic_nonlinearity', 'heading_sensitivity',
                     'bias_temperature', 'scale_factor_temperature', 'warm_up', 'time_offset',
                     'bandwidth', 'reference_once_per_rev', 'reference_slip', 'bias_step',
                     'acceleration_sensitivity')
#: Correct findings on references that were not hidden.
TRUE_OF_REFERENCE = {'encoder': ('reference_quantization',), 'course': ('time_offset',),
                     'held': ('time_offset',), 'heldrate': ('time_offset',)}
#: Effects that are not combined: findings against a model, and a wrong unit, which changes sizes.
NOT_COMBINED = {*MODEL_FINDINGS, 'unit_error'}
#: Least share of the multiple of an effect that is independent of the others.
MIN_REMAINING_SHARE = 0.8


@dataclass(frozen=True)
class Case:
    """What is hidden in a log, or in two of one gyro; random by its name and a seed alone."""

    part: str
    names: tuple[str, ...]
    multiple: float
    noise: str
    reference: str
    number: int
    look_alikes: tuple[str, str] | None = None

    def __str__(self) -> str:
        what = '+'.join(self.names) or ('random' if self.multiple else 'nothing')
        suffix = '' if self.look_alikes is None else f'({"|".join(self.look_alikes)})'
        return (f'{self.part}/{what}{suffix}/{self.multiple:g}/{self.noise}/{self.reference}/'
                f'{self.number}')

    @property
    def has_model(self) -> bool | None:
        """Whether a model is given because of what the case is; None: what is hidden decides."""
        floor = self.part == 'references' and self.noise == 'floor'
        return (floor or self.look_alikes is not None and LOOK_ALIKES[self.look_alikes].needs_model
                or None)

    @property
    def allowed(self) -> tuple[str, ...]:
        """Return the correct findings on the reference that were not hidden."""
        return TRUE_OF_REFERENCE.get(self.reference.partition('_')[0], ())


def part_cases(part: str, repetitions: int) -> Iterator[Case]:
    if part == 'nothing':
        yield from (Case(part, (), 0.0, noise, _choose_in_turn(REFERENCES, number), number)
                    for number in range(repetitions) for noise in ALARM_NOISES)
    elif part in ('sets', 'separated'):
        yield from (Case(part, (name,), 0.0, 'white', 'rate', number, pair)
                    for number in range(repetitions) for pair in LOOK_ALIKES for name in pair
                    if part == 'sets' or LOOK_ALIKES[pair].separating_conditions is not None)
    elif part == 'references':
        for place, reference in enumerate(IMPERFECT_REFERENCES):
            for number in range(repetitions):
                yield Case(part, (), 0.0, _choose_in_turn(NOISES, number), reference, number)
                yield Case(part, (), 0.0, 'floor', reference, number)
                for multiple in SIZE_MULTIPLES:
                    name = _choose_in_turn(COMPANION_EFFECTS,
                                           number * len(IMPERFECT_REFERENCES) + place)
                    yield Case(part, (name,), multiple, _choose_in_turn(NOISES, number),
                               reference, number)
    else:
        multiples = (3.0,) if part == 'outside' else SIZE_MULTIPLES
        single = {'effects': FORMS, 'outside': OUTSIDE_CATALOGUE}.get(part, ())
        names: Sequence[tuple[str, ...]] = [(name,) for name in single] or [()]
        yield from (Case(part, each, multiple, _choose_in_turn(NOISES, number + place),
                         _choose_reference(each, number + place), number)
                    for number in range(repetitions) for multiple in multiples
                    for place, each in enumerate(names))


def _choose_in_turn(choices: Sequence[str], number: int) -> str:
    return choices[number % len(choices)]


def _choose_reference(names: Sequence[str], number: int) -> str:
    """Choose a reference; figures of the noise are sized without encoder steps."""
    is_noise = any(name in FORMS and FORMS[name].stage == 'noise' for name in names)
    return 'rate' if is_noise else _choose_in_turn(REFERENCES, number)


def random_source(case: Case, seed: int) -> np.random.Generator:
    """Return the source of all that is random in a case."""
    return np.random.default_rng([seed, zlib.crc32(str(case).encode())])


def make_logs(case: Case, generator: np.random.Generator) -> list[HiddenLog]:
    """Hide what a case asks for; two logs of one gyro where the second separates look-alikes."""
    if case.part == 'references':
        noise = 'gauss_markov' if case.noise == 'floor' else case.noise
        return [hide_with_reference(case.names, case.multiple, generator,
                                    IMPERFECT_REFERENCES[case.reference], noise)]
    if case.look_alikes is not None:
        log = hide_look_alike(case.look_alikes, case.names[0], generator)
        return ([log] if case.part == 'sets'
                else [log, record_separating(case.look_alikes, log, generator)])
    step = ({'reference': 'heading', 'encoder_step': ENCODER_STEP} if case.reference == 'encoder'
            else {'reference': case.reference})
    if case.part not in ('pairs', 'triples'):
        return hide(case.names, case.multiple, generator, noise=case.noise, **step)
    choices = [name for name in FORMS if name not in NOT_COMBINED]
    while True:
        names = [str(name) for name in generator.choice(choices, 2 if case.part == 'pairs' else 3,
                                                        replace=False)]
        logs = hide(names, case.multiple, generator, noise=case.noise, **step)
        if all(not cause.apart < MIN_REMAINING_SHARE * cause.multiple
               for cause in logs[0].truth.gyro.causes):
            return logs
