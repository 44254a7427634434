# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The columns of each cause on a replayed log, for the shapes that are tried first."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
import math

from gyro_calibration.diagnosis.replay import Replay
from gyro_calibration.logs.log import Array
from gyro_calibration.model.effects import ADDED, CATALOGUE
import numpy as np

#: A dead zone is looked for where an encoder makes so many steps a second or more.
STEPS_A_SECOND = 20.0
#: Places of a step that are tried in all logs together.
STEPS = 64
#: A channel that changes by less than this in each log shows nothing.
LEAST_CHANGE = {'temperature': 0.2, 'supply': 1e-9, 'specific_force': 1e-9}

#: A thermal lag shorter than this, s, is nothing but the rate of the temperature.
FASTEST_LAG = 12.0

#: Columns of one log: (replay) -> arrays of shape (n,).
Columns = Callable[[Replay], Sequence[Array]]


@dataclass(frozen=True)
class Candidate:
    """
    One cause with its shapes.

    Attributes
    ----------
    cause : its name
    shapes : their values, in the order of the effect
    columns : of a log
    run : the log that it is in, where it happens once; None where it is in all
    amplitude : the value that its column must have, where only shapes are fitted; None if free

    """

    cause: str
    shapes: tuple[float, ...]
    columns: Columns
    run: int | None = None
    amplitude: float | None = None


def columns_of(candidate: Candidate, replays: Sequence[Replay]) -> Array:
    """Return the cosine transforms of a candidate's columns over all logs, shape (columns, m)."""
    parts = []
    for run, each in enumerate(replays):
        values = candidate.columns(each)
        absent = candidate.run is not None and candidate.run != run
        parts.append(np.array([np.zeros(each.points - 1) if absent else each.coefficients(value)
                               for value in values]))
    return np.concatenate(parts, axis=1)


def effect(name: str, *shapes: float, run: int | None = None) -> Candidate:
    """Return the candidate of an effect of the gyro, or of the reference."""
    if name in _OF_THE_REFERENCE:
        columns = _OF_THE_REFERENCE[name]
        return Candidate(name, shapes, lambda each: columns(each, *shapes), run)
    known = CATALOGUE[name]
    if known.distortion is not None:
        return Candidate(name, shapes, lambda each: (_distorted(each, name, *shapes),), run, 1.0)
    amplitude = known.coefficients[0].default if known.coefficients else None
    return Candidate(name, shapes, lambda each: known.columns(each.channels, *shapes), run,
                     amplitude)


def _distorted(each: Replay, name: str, *shapes: float) -> Array:
    """Return what a distortion changes of the rate: a delay, a lag, another clock, a limit."""
    rate = each.channels.rate
    known = CATALOGUE[name].distortion
    assert known is not None
    return known(rate, each.channels.time, *shapes) - rate


def _once_per_revolution(each: Replay) -> Sequence[Array]:
    rate, heading = each.channels.rate, each.channels.heading
    return -rate * np.sin(heading), -rate * np.cos(heading)


def pulse(time: Array, middle: float, width: float) -> Array:
    """Return the rate of a reference that jumps by 1 rad in its heading, within about a width."""
    return np.exp(-0.5 * ((time - middle) / width) ** 2) / (width * math.sqrt(2.0 * math.pi))


def _slip(each: Replay, width: float, *moments: float) -> Sequence[Array]:
    return tuple(-pulse(each.channels.time, moment, width) for moment in moments)


_OF_THE_REFERENCE: Mapping[str, Callable[..., Sequence[Array]]] = {
    'reference_once_per_rev': _once_per_revolution, 'reference_slip': _slip}
#: Cause -> the shapes of it that a fit finds; all that are no conventions.
_FITTED_OF_THE_REFERENCE = {'reference_once_per_rev': (), 'reference_slip': (0,)}


def fitted_shapes(candidate: Candidate) -> list[int]:
    """Return the places of the shapes that are no conventions."""
    if candidate.cause not in CATALOGUE:
        return list(_FITTED_OF_THE_REFERENCE.get(candidate.cause, ()))
    parameters = CATALOGUE[candidate.cause].parameters[:len(candidate.shapes)]
    return [place for place, parameter in enumerate(parameters) if parameter.default is None]


def with_shape(candidate: Candidate, place: int, value: float) -> Candidate:
    """Return a candidate with another shape, within the bounds that a model has for it."""
    if candidate.cause in CATALOGUE:
        value = float(np.clip(value, *CATALOGUE[candidate.cause].parameters[place].bounds))
    return effect(candidate.cause, *candidate.shapes[:place], value,
                  *candidate.shapes[place + 1:], run=candidate.run)


def constant(replays: Sequence[Replay]) -> frozenset[str]:
    """Return the channels that hardly change in any log that has them: as good as none."""
    known = {name: [getattr(each.channels, name) for each in replays if name in each.has]
             for name in LEAST_CHANGE}
    return frozenset(
        name for name, values in known.items()
        if values and max(float(np.ptp(value)) for value in values) < LEAST_CHANGE[name])


def candidates(replays: Sequence[Replay]) -> list[Candidate]:
    """Return all causes that these logs may show, each with the shapes to begin with."""
    has = frozenset.intersection(*(each.has for each in replays)) - constant(replays)
    moves = any(np.ptp(each.channels.rate) > 0.0 for each in replays)
    found = [*_of_time(replays), *(_of_temperature(replays) if 'temperature' in has else []),
             *_of_surroundings(has),
             *(effect(name, *shapes) for name, shapes in added_effects(has, moves))]
    return [*found, *(_of_rate(replays, has) if moves else [])]


def added_effects(has: Collection[str], moves: bool) -> Iterator[tuple[str, tuple[float, ...]]]:
    """Give the effects of the user's own that logs can show, with the shapes to begin with."""
    for name, own in ADDED.items():
        turned = own.looks_at & {'rate', 'output', 'heading'}
        if own.looks_at & LEAST_CHANGE.keys() <= set(has) and (moves or not turned):
            yield from ((name, shapes) for shapes in product(*(
                shape.begin_with or (shape.default or 0.0,) for shape in own.shapes)))


def _of_time(replays: Sequence[Replay]) -> Iterator[Candidate]:
    duration = max(each.duration for each in replays)
    yield effect('rate_ramp')
    for time_constant in np.geomspace(duration / 100.0, duration * 0.7, 9):
        yield effect('warm_up', time_constant)
    for run, each in enumerate(replays):
        begin, spacing = (float(each.channels.time[each.kept][0]),
                          spacing_of_steps(each, len(replays)))
        for number in range(1, _steps(len(replays)) + 1):
            yield effect('bias_step', begin + number * spacing, run=run)


def _steps(logs: int) -> int:
    """Return how many places of a step are tried in each of so many logs."""
    return max(STEPS // logs, 1)


def spacing_of_steps(each: Replay, logs: int) -> float:
    """Return how far apart the places of a step are that are tried in one of so many logs, s."""
    return each.duration / (_steps(logs) + 1)


def reference_temperatures(replays: Sequence[Replay]) -> list[float]:
    """Return the temperatures that a parabola may count from: the usual, the first, the mean."""
    known = np.concatenate([each.channels.temperature for each in replays])
    return [25.0, 20.0, float(known.mean()), float(known[0])]


def _of_temperature(replays: Sequence[Replay]) -> Iterator[Candidate]:
    middle = reference_temperatures(replays)[2]
    duration = max(each.duration for each in replays)
    yield effect('bias_temperature', middle)
    for reference in reference_temperatures(replays):
        yield effect('bias_temperature_quadratic', reference)
    for filter_time in (0.3, 1.0, 3.0, 10.0):
        yield effect('bias_temperature_rate', filter_time)
    for time_constant in np.geomspace(FASTEST_LAG, min(duration, 3000.0), 8):
        yield effect('thermal_lag', time_constant)
    for filter_time, threshold in ((1.0, 2e-3), (3.0, 5e-4), (3.0, 2e-3)):
        yield effect('thermal_hysteresis', filter_time, threshold)


def _of_surroundings(has: frozenset[str]) -> Iterator[Candidate]:
    if 'specific_force' in has:
        yield effect('acceleration_sensitivity')
        for time_constant in (0.1, 0.3, 1.0):
            yield effect('vibration_rectification', time_constant)
    if 'supply' in has:
        yield effect('supply_sensitivity', 5.0)


def _of_rate(replays: Sequence[Replay], has: frozenset[str]) -> Iterator[Candidate]:
    fastest = max(float(np.abs(each.channels.rate).max()) for each in replays)
    for name in ('scale_factor_asymmetry', 'quadratic_nonlinearity', 'cubic_nonlinearity'):
        yield effect(name)
    for phase in (0.5, 1.0, 1.5, 2.0):
        yield effect('sine_response', phase / fastest)
    yield effect('heading_sensitivity')
    yield effect('reference_once_per_rev')
    if 'temperature' in has:
        yield effect('scale_factor_temperature', reference_temperatures(replays)[2])
    # Slower than so many steps a second, it is the encoder that stands still.
    slowest = max(1e-5 * fastest, STEPS_A_SECOND * max(each.rounded for each in replays))
    for zone in np.geomspace(slowest, 0.5 * fastest, 14):
        yield effect('dead_zone', zone)
    for limit in (0.5, 0.65, 0.8, 0.9, 0.97):
        yield effect('saturation', limit * fastest)
    yield from _of_the_signal(replays[0].interval)


def _of_the_signal(interval: float) -> Iterator[Candidate]:
    for offset in (0.2 * interval, 0.02, 0.1, 0.3):
        yield effect('time_offset', offset)
        yield effect('time_offset', -offset)
    for lag in (0.2 * interval, 0.01, 0.03, 0.1, 0.3):
        yield effect('bandwidth', lag)
    yield effect('clock_rate', 1e-6)


#: Cause -> the candidates of it, by their places in a list.
def by_cause(found: Sequence[Candidate]) -> Mapping[str, list[int]]:
    """Return the places of the candidates of each cause."""
    places: dict[str, list[int]] = {}
    for place, candidate in enumerate(found):
        places.setdefault(candidate.cause, []).append(place)
    return places


def phase(sine: float, cosine: float) -> tuple[float, float]:
    """Return amplitude and phase of ``sine sin + cosine cos``."""
    return math.hypot(sine, cosine), math.atan2(cosine, sine)
