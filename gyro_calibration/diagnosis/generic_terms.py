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
Structure without a name: families of functions of each variable, of two of them, and of time.

They compete with the causes. Where one of them is clearly better than every cause, the cause is
none that is known here.

"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import combinations

from gyro_calibration.diagnosis.candidates import Candidate, constant
from gyro_calibration.diagnosis.replay import Replay
from gyro_calibration.logs.log import Array
import numpy as np
from scipy.interpolate import BSpline

#: Begins the name of what has none; the variable follows along which it lies.
UNNAMED = '~'
#: Knots of splines over a variable: few for what is smooth, many for what is not.
KNOTS = {'rate': (8, 24), 'temperature': (8, 24)}
_OTHER_KNOTS = (8,)
#: Moments and widths of a bump in a log, as parts of it.
MOMENTS, BUMPS = 40, (0.007, 0.02, 0.05)
#: Waves over the range of a variable, so dense that none falls between two.
WAVES = {'rate': tuple(np.arange(1.0, 12.5, 0.5)), 'temperature': tuple(np.arange(1.0, 8.5, 0.5))}
_OTHER_WAVES = (1.0, 1.5, 2.0, 3.0, 4.0)
HARMONICS = range(2, 11)

Of = Callable[[Replay], Array]


def is_named(candidate: Candidate) -> bool:
    """Tell a cause from a structure without a name."""
    return not candidate.cause.startswith(UNNAMED)


def along(candidate: Candidate) -> str:
    """Return the variable of a structure without a name."""
    return candidate.cause[len(UNNAMED):]


def generic_terms(replays: Sequence[Replay]) -> list[Candidate]:
    """Return what may be in these logs without a name."""
    variables = dict(_variables(replays))
    found = [each for name, of in variables.items() for each in _of_one(name, of)]
    if 'rate' in variables:
        found += _of_turning(variables)
    for (first, one), (second, other) in combinations(variables.items(), 2):
        if (first, second) != ('rate', 'temperature'):  # their product has a name
            found.append(_term(f'{first} and {second}', _product(one, other)))
    for run, each in enumerate(replays):
        begin = float(each.channels.time[each.kept][0])
        for width in BUMPS:
            count = min(MOMENTS, round(1.0 / width)) // len(replays) + 3
            for moment in begin + each.duration * np.linspace(0.0, 1.0, count)[1:-1]:
                found.append(_term('time', _bump(moment, width * each.duration), run, moment))
    return found


def _term(name: str, columns: Callable[[Replay], Sequence[Array]], run: int | None = None,
          *shapes: float) -> Candidate:
    return Candidate(UNNAMED + name, shapes, columns, run)


def _variables(replays: Sequence[Replay]) -> Iterator[tuple[str, Of]]:
    """Give the variables that these logs have and that change in them, each scaled to -1 to 1."""
    has = frozenset.intersection(*(each.has for each in replays)) - constant(replays)
    known: dict[str, Of] = {'rate': lambda each: each.channels.rate}
    if 'temperature' in has:
        known['temperature'] = lambda each: each.channels.temperature
    if 'supply' in has:
        known['supply'] = lambda each: np.asarray(each.channels.supply)
    if 'specific_force' in has:
        known['specific_force'] = lambda each: each.lagged('specific_force', 0.3)
    for name, of in known.items():
        low = min(float(of(each).min()) for each in replays)
        high = max(float(of(each).max()) for each in replays)
        if high > low:
            yield name, _scaled(of, low, high)


def _scaled(of: Of, low: float, high: float) -> Of:
    return lambda each: np.clip((2.0 * of(each) - low - high) / (high - low), -1.0, 1.0)


def _of(of: Of, shape: Callable[..., Sequence[Array]],
        value: Array | float) -> Callable[[Replay], Sequence[Array]]:
    """Return the columns of a function of a variable and a value."""
    return lambda each: shape(of(each), value)


def _product(one: Of, other: Of) -> Callable[[Replay], Sequence[Array]]:
    return lambda each: (one(each) * other(each),)


def _of_one(name: str, of: Of) -> Iterator[Candidate]:
    for waves in WAVES.get(name, _OTHER_WAVES):
        yield _term(name, _of(of, lambda x, waves: (np.sin(np.pi * waves * x),
                                                    np.cos(np.pi * waves * x)), waves))
    for power in (2, 4, 5) if name == 'rate' else (3, 4) if name == 'temperature' else (2, 3):
        if (name, power) != ('rate', 2):
            yield _term(name, _of(of, lambda x, power: (x ** power,), power))
    for steep in (-8.0, -4.0, 4.0, 8.0):
        yield _term(name, _of(of, lambda x, steep: (np.exp(steep * x - abs(steep)),), steep))
    for count in KNOTS.get(name, _OTHER_KNOTS):
        knots = np.concatenate([[-1.0] * 3, np.linspace(-1.0, 1.0, count - 2), [1.0] * 3])
        # together they are constant, which is the bias
        yield _term(name, _of(of, lambda x, knots: tuple(
            BSpline.design_matrix(x, knots, 3).toarray().T[1:]), knots))


def _of_turning(variables: Mapping[str, Of]) -> Iterator[Candidate]:
    """Give roots of the rate, and harmonics of the heading, alone and times a variable."""
    rate = variables['rate']
    for power in (0.25, 0.5, 0.75, 1.5):
        yield _term('rate', _of(rate, lambda x, power: (np.abs(x) ** power,), power))
        yield _term('rate', _of(rate, lambda x, power: (np.abs(x) ** power * np.sign(x),), power))
    for harmonic in HARMONICS:
        yield _term('heading', _harmonic(harmonic, None))
    for harmonic in HARMONICS[:3]:
        yield _term('rate and heading', _harmonic(harmonic, rate))
    for name in ('temperature', 'supply'):
        if name in variables:
            yield _term(f'{name} and heading', _harmonic(1, variables[name]))


def _harmonic(number: int, times: Of | None) -> Callable[[Replay], Sequence[Array]]:
    def columns(each: Replay) -> Sequence[Array]:
        phase, factor = number * each.channels.heading, 1.0 if times is None else times(each)
        return factor * np.sin(phase), factor * np.cos(phase)
    return columns


def _bump(middle: float, width: float) -> Callable[[Replay], Sequence[Array]]:
    return lambda each: (np.exp(-0.5 * ((each.channels.time - middle) / width) ** 2),)
