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
Candidate causes and their columns on a replayed log, for the shapes that are tried first.

Also generic terms, which are structure without a name: families of functions of each variable, of
two variables, and of time. They compete with the causes. If a generic term is clearly better than
every cause, the structure is reported as unexplained.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product
import math

from gyro_calibration.diagnosis.replay import Replay
from gyro_calibration.heading.integration import integrate
from gyro_calibration.logs.log import Array, DEGREE
from gyro_calibration.model.effects import CATALOGUE
import numpy as np
from scipy.interpolate import BSpline

#: Least step rate of an encoder, 1/s, at which a dead zone is searched for.
_MIN_ENCODER_STEP_RATE = 20.0
#: Times of a bias step, and of a bump, that are tried in all logs together.
MAX_STEP_TIMES = 64
#: Lack of log-likelihood at the ends of the interval of 95 % of the time of a step: a random walk
#: with a drift of minus half its variance on either side exceeds it with that probability.
MAX_STEP_TIME_LACK = -math.log(1.0 - math.sqrt(0.95))
#: Least change of a channel in a log, K, V and m/s²; with less it counts as missing.
MIN_CHANNEL_RANGE = {'temperature': 0.2, 'supply': 1e-9, 'specific_force': 1e-9}

#: Shortest thermal lag, s; a shorter one equals a sensitivity to the temperature rate.
_MIN_THERMAL_LAG = 12.0

#: Prefix of the name of structure without a name, which its variable follows; and the name of an
#: error that is proportional to the rate in a part of a log.
_UNNAMED_PREFIX = '~'
PART_OF_LOG = f'{_UNNAMED_PREFIX}rate and time'

#: Columns of one log: (replay) -> arrays of shape (n,).
ColumnFunction = Callable[[Replay], Sequence[Array]]


@dataclass(frozen=True)
class Candidate:
    """One cause with its shapes; after its selection, also with its values."""

    cause: str  # its name
    shapes: tuple[float, ...]  # their values, in the order of the effect
    columns: ColumnFunction  # of a log
    # number of the log for a single event; None for a cause in all logs
    log_index: int | None = None
    # fixed coefficient of its column if only shapes are fitted; None if it is free
    amplitude: float | None = None
    # of the range in which its shape, a time or a frequency, is searched; None for a shape that is
    # searched in logarithms
    half_width: float | None = None
    # coefficients of its columns; empty before a fit, and its shapes are then fixed
    values: tuple[float, ...] = ()
    penalty: float = 0.0  # penalty for the choice of its first shapes, in log-likelihood


def candidate_transforms(candidate: Candidate, replays: Sequence[Replay]) -> Array:
    """Return the cosine transforms of a candidate's columns over all logs, shape (columns, m)."""
    parts = []
    for run, each in enumerate(replays):
        values = candidate.columns(each)
        absent = candidate.log_index is not None and candidate.log_index != run
        parts.append(np.array([np.zeros(each.point_count - 1) if absent
                               else each.transform_samples(value) for value in values]))
    return np.concatenate(parts, axis=1)


def effect_candidate(name: str, *shapes: float, log_index: int | None = None,
                     half_width: float | None = None) -> Candidate:
    """Return the candidate of an effect of the gyro, or of the reference."""
    if name in _REFERENCE_EFFECTS:
        columns = _REFERENCE_EFFECTS[name]
        return Candidate(name, shapes, lambda each: columns(each, *shapes), log_index)
    known = CATALOGUE[name]
    if (distortion := known.distortion) is not None:
        # change of the rate by a delay, a lag, a clock rate or a limit
        def rate_change(each: Replay) -> Sequence[Array]:
            rate = each.channels.rate
            return (distortion(rate, each.channels.time, *shapes) - rate,)
        return Candidate(name, shapes, rate_change, log_index, 1.0)
    amplitude = known.coefficients[0].default if known.coefficients else None
    return Candidate(name, shapes, lambda each: known.columns(each.channels, *shapes), log_index,
                     amplitude, half_width)


def gaussian_pulse(time: Array, middle: float, width: float) -> Array:
    """Return the rate of a reference whose heading jumps by 1 rad within about a width."""
    return np.exp(-0.5 * ((time - middle) / width) ** 2) / (width * math.sqrt(2.0 * math.pi))


#: Effects of the reference -> columns by log and shapes; the times and the width of slips are
#: those of a scan, and only the width is fitted.
_REFERENCE_EFFECTS: Mapping[str, Callable[..., Sequence[Array]]] = {
    'reference_once_per_rev': lambda each: (
        -each.channels.rate * np.sin(each.channels.heading),
        -each.channels.rate * np.cos(each.channels.heading)),
    'reference_slip': lambda each, width, *moments: tuple(
        -gaussian_pulse(each.channels.time, moment, width) for moment in moments)}
#: Causes whose columns do not depend smoothly on their shapes.
_DISCONTINUOUS = ('bias_step', 'dead_zone', PART_OF_LOG)


def fitted_shape_indices(candidate: Candidate) -> list[int]:
    """Return the indices of the shapes that are fitted, not set by convention."""
    if candidate.cause == PART_OF_LOG:
        return [0, 1]
    if candidate.cause not in CATALOGUE:
        return [0] if candidate.shapes and is_named(candidate) else []
    parameters = CATALOGUE[candidate.cause].parameters[:len(candidate.shapes)]
    return [place for place, parameter in enumerate(parameters) if parameter.default is None]


def smooth_shapes(candidate: Candidate) -> list[int]:
    """Return the indices of fitted shapes on which the columns depend smoothly."""
    return [] if is_discontinuous(candidate) else fitted_shape_indices(candidate)


def is_discontinuous(candidate: Candidate) -> bool:
    """Tell whether the columns of a candidate do not depend smoothly on its shapes."""
    return candidate.cause in _DISCONTINUOUS


def with_shape(candidate: Candidate, shape_index: int, value: float) -> Candidate:
    """Return a candidate without values with another shape, within the bounds of its effect."""
    if candidate.cause == PART_OF_LOG:
        ends = list(candidate.shapes)
        ends[shape_index] = value
        return replace(_part_of_log(ends[0], ends[1], candidate.log_index, candidate.half_width),
                       penalty=candidate.penalty)
    if candidate.cause in CATALOGUE:
        value = float(np.clip(value, *CATALOGUE[candidate.cause].parameters[shape_index].bounds))
    moved = effect_candidate(candidate.cause, *candidate.shapes[:shape_index], value,
                             *candidate.shapes[shape_index + 1:], log_index=candidate.log_index,
                             half_width=candidate.half_width)
    return replace(moved, penalty=candidate.penalty)


def depends_on_rate(candidate: Candidate) -> bool:
    """Tell whether the columns of a candidate depend on the rate that the gyro senses."""
    if not is_named(candidate):
        return bool({'rate', 'rate_change'} & {*unnamed_variable(candidate).split(' and ')})
    effect = CATALOGUE.get(candidate.cause)
    return effect is None or effect.distortion is not None or 'rate' in effect.inputs


def common_channels(replays: Sequence[Replay]) -> frozenset[str]:
    """Return the channels that all logs have."""
    return frozenset.intersection(*(each.available_channels for each in replays))


def constant_channels(replays: Sequence[Replay]) -> frozenset[str]:
    """Return the channels that are nearly constant in each log that has them."""
    known = {name: [getattr(each.channels, name) for each in replays
                    if name in each.available_channels] for name in MIN_CHANNEL_RANGE}
    return frozenset(name for name, values in known.items() if values
                     and max(float(np.ptp(value)) for value in values) < MIN_CHANNEL_RANGE[name])


def observed_range(replays: Sequence[Replay]) -> dict[str, float]:
    """Return rate, temperature and duration of proposed experiments, deg/s, degC and min."""
    numbers = {'long': 4.0 * math.ceil(max(each.duration for each in replays) / 60.0)}
    top = max(float(np.quantile(np.abs(each.channels.rate), 0.999)) for each in replays) / DEGREE
    if top > 0.0:
        numbers |= {'top': top, 'faster': 3.0 * top}
    if all('temperature' in each.available_channels for each in replays):
        degc = np.concatenate([each.channels.temperature for each in replays])
        # at least 20 K
        middle, half = 0.5 * (degc.max() + degc.min()), max(0.5 * float(np.ptp(degc)), 10.0)
        numbers |= {'low': float(middle - half), 'high': float(middle + half)}
    return numbers


def lasting_shapes(has: Collection[str], duration: float, temperature: Array,
                   moves: bool = True) -> Iterator[tuple[str, tuple[float, ...]]]:
    """
    Give the lasting causes that some channels may show, linear in size, with first shapes.

    They are those of the record of the effect, unless they depend on the log.
    """
    middle = float(temperature.mean())
    of_log: dict[str, list[tuple[float, ...]]] = {
        'warm_up': [(each,) for each in np.geomspace(
            duration / 100.0, duration * 0.7, 9).tolist()],
        'thermal_lag': [(each,) for each in np.geomspace(
            _MIN_THERMAL_LAG, min(duration, 3000.0), 8).tolist()],
        'thermal_hysteresis': [(1.0, 2e-3), (3.0, 5e-4), (3.0, 2e-3)],
        'bias_temperature': [(middle,)], 'scale_factor_temperature': [(middle,)],
        # that of data sheets, mean and first temperature; of two that are as likely, a few kelvin
        # apart, the coefficients differ by more than their intervals
        'bias_temperature_quadratic': [(25.0,), (middle,), (float(temperature[0]),)]}
    for name, effect in CATALOGUE.items():
        if (effect.inputs & MIN_CHANNEL_RANGE.keys() <= {*has}
                and (moves or not effect.inputs & {'rate', 'output', 'heading'})
                and effect.distortion is None and name not in ('bias', 'scale_factor_error')):
            # none of an effect with a shape that has no first values
            recorded = product(*(shape.begin_with or (
                () if shape.default is None else (shape.default,))
                for shape in effect.nonlinear_parameters))
            yield from ((name, shapes) for shapes in of_log.get(name, recorded))
    if moves:
        yield 'reference_once_per_rev', ()


def propose_candidates(replays: Sequence[Replay]) -> Iterator[Candidate]:
    """Give all causes that these logs may show, each with its first shapes."""
    has = common_channels(replays) - constant_channels(replays)
    duration, interval = max(each.duration for each in replays), replays[0].interval
    fastest = max(float(np.abs(each.channels.rate).max()) for each in replays)
    moves = any(np.ptp(each.channels.rate) > 0.0 for each in replays)
    temperature = np.concatenate([np.atleast_1d(each.channels.temperature) for each in replays])
    yield from (effect_candidate(name, *shapes)
                for name, shapes in lasting_shapes(has, duration, temperature, moves))
    per_log = max(MAX_STEP_TIMES // len(replays), 1)
    for run, each in enumerate(replays):
        begin, spacing = float(each.channels.time[each.valid][0]), each.duration / (per_log + 1)
        for number in range(1, per_log + 1):
            yield effect_candidate('bias_step', begin + number * spacing, log_index=run,
                                   half_width=1.5 * spacing)
    if not moves:
        return
    # At lower rates the quantization of the encoder, or the largest noise of a heading in a log,
    # passes for a dead zone.
    slowest = max(1e-5 * fastest, *(
        max(_MIN_ENCODER_STEP_RATE * each.heading_step, each.heading_noise / each.interval
            * math.sqrt(2.0 * math.log(each.point_count))) for each in replays))
    distortions = {
        'sine_response': [angle / fastest for angle in (0.5, 1.0, 1.5, 2.0)],
        'dead_zone': np.geomspace(slowest, 0.5 * fastest, 14).tolist(),
        'saturation': [limit * fastest for limit in (0.5, 0.65, 0.8, 0.9, 0.97)],
        'time_offset': [*(sign * offset for offset in (0.2 * interval, 0.02, 0.1, 0.3)
                          for sign in (1.0, -1.0)),
                        *filter(None, {each.delay for each in replays})],
        'bandwidth': [0.2 * interval, 0.01, 0.03, 0.1, 0.3], 'clock_rate': [1e-6]}
    for name, sizes in distortions.items():
        yield from (effect_candidate(name, size) for size in sizes)


def indices_by_cause(candidates: Sequence[Candidate]) -> Mapping[str, list[int]]:
    """Return the indices of the candidates of each cause."""
    places: dict[str, list[int]] = {}
    for place, candidate in enumerate(candidates):
        places.setdefault(candidate.cause, []).append(place)
    return places


#: Numbers of waves over a turn or the range of rate or temperature, and of knots of splines.
_WAVE_COUNTS, _SPLINE_KNOTS = range(1, 13), 8
#: Linear response of a motion to its reference rate; lags between which it is constant, s.
RESPONSE = f'{_UNNAMED_PREFIX}rate_change'
_RESPONSE_LAGS = (-0.1, -0.05, 0.0, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.6, 0.8, 1.2, 1.6, 2.4)
#: Widths of a bump in time as shares of the duration.
_BUMP_WIDTHS = (0.01, 0.05)

Variable = Callable[[Replay], Array]


def is_named(candidate: Candidate) -> bool:
    """Tell whether a candidate is a cause, not structure without a name."""
    return not candidate.cause.startswith(_UNNAMED_PREFIX)


def unnamed_variable(candidate: Candidate) -> str:
    """Return the variable of a structure without a name."""
    return candidate.cause[len(_UNNAMED_PREFIX):]


def generic_terms(replays: Sequence[Replay]) -> Iterator[Candidate]:
    """Give the generic terms that these logs may show."""
    def heading(each: Replay) -> Array:
        return each.channels.heading

    variables = dict(_scaled_variables(replays))
    for name, of in variables.items():
        for count in _WAVE_COUNTS if name in ('rate', 'temperature') else ():
            yield _unnamed_term(name, _wave_columns(of, np.pi * count))
        yield _unnamed_term(name, _spline_columns(of))
    if 'rate' in variables:
        for number in _WAVE_COUNTS[1:]:
            yield _unnamed_term('heading', _wave_columns(heading, number))
        for name, number in (('rate', 2), ('rate', 3), ('rate', 4), ('temperature', 1),
                             ('supply', 1)):
            if name in variables:
                yield _unnamed_term(f'{name} and heading',
                                    _wave_columns(heading, number, variables[name]))
    if 'rate' in variables and 'reference_rate' in common_channels(replays):
        yield _response_term(max(each.interval for each in replays))
    for (first, one), (second, other) in combinations(variables.items(), 2):
        if (first, second) != ('rate', 'temperature'):  # scale_factor_temperature
            yield _unnamed_term(f'{first} and {second}', _product_columns(one, other))
    # a scale factor that differs in a part of a log; so many ends have `MAX_STEP_TIMES` pairs
    ends = math.isqrt(2 * MAX_STEP_TIMES // len(replays)) + 1
    for run, each in enumerate(replays):
        begin = float(each.channels.time[each.valid][0])
        if 'rate' in variables:
            for part in combinations(begin + each.duration * np.linspace(0.0, 1.0, ends), 2):
                if part[1] - part[0] < 0.99 * each.duration:
                    yield _part_of_log(*part, run, each.duration / (ends - 1))
        for width in _BUMP_WIDTHS:
            count = min(MAX_STEP_TIMES, round(1.0 / width)) // len(replays) + 3
            for moment in begin + each.duration * np.linspace(0.0, 1.0, count)[1:-1]:
                yield _unnamed_term('time', _bump_columns(moment, width * each.duration), run,
                                    moment)


def _unnamed_term(name: str, columns: ColumnFunction, log_index: int | None = None,
                  *shapes: float) -> Candidate:
    return Candidate(_UNNAMED_PREFIX + name, shapes, columns, log_index)


def _scaled_variables(replays: Sequence[Replay]) -> Iterator[tuple[str, Variable]]:
    """Give the variables that change in these logs, each scaled to -1 to 1."""
    has = common_channels(replays) - constant_channels(replays)
    known: dict[str, Variable] = {
        'rate': lambda each: each.channels.rate,
        'temperature': lambda each: each.channels.temperature,
        'supply': lambda each: np.asarray(each.channels.supply),
        'specific_force': lambda each: each.lagged('specific_force', 0.3)}
    for name in ('rate', *(each for each in list(known)[1:] if each in has)):
        of = known[name]
        low = min(float(of(each).min()) for each in replays)
        high = max(float(of(each).max()) for each in replays)
        if high > low:
            yield name, _scale_to_unit_range(of, low, high)


def _scale_to_unit_range(variable: Variable, low: float, high: float) -> Variable:
    return lambda each: np.clip((2.0 * variable(each) - low - high) / (high - low), -1.0, 1.0)


def _product_columns(one: Variable, other: Variable) -> ColumnFunction:
    return lambda each: (one(each) * other(each),)


def _wave_columns(phase: Variable, number: float,
                  factor_variable: Variable | None = None) -> ColumnFunction:
    def columns(each: Replay) -> Sequence[Array]:
        factor = 1.0 if factor_variable is None else factor_variable(each)
        return (factor * np.sin(number * phase(each)), factor * np.cos(number * phase(each)))
    return columns


def _spline_columns(variable: Variable) -> ColumnFunction:
    knots = np.concatenate([[-1.0] * 3, np.linspace(-1.0, 1.0, _SPLINE_KNOTS - 2), [1.0] * 3])
    # their sum is constant, as the bias is
    return lambda each: tuple(BSpline.design_matrix(variable(each), knots, 3).toarray().T[1:])


def _response_term(interval: float) -> Candidate:
    """Return the mean rate between two lags less the rate, for each pair of neighbouring lags."""
    # whole samples of the slowest log
    edges = np.unique(np.rint(np.array(_RESPONSE_LAGS) / interval)) * interval

    def columns(each: Replay) -> Sequence[Array]:
        time, rate = each.channels.time, each.channels.rate
        late = np.interp(time - edges[:, None], time, integrate(time, rate))
        return [*((late[:-1] - late[1:]) / np.diff(edges)[:, None] - rate)]

    return Candidate(RESPONSE, (), columns)


def _part_of_log(first: float, last: float, log_index: int | None,
                 half_width: float | None) -> Candidate:
    """Return a scale factor error from a first to a last time."""
    return Candidate(PART_OF_LOG, (first, last), lambda each: (each.channels.rate * (
        (each.channels.time >= first) & (each.channels.time < last)),), log_index,
        half_width=half_width)


def _bump_columns(middle: float, width: float) -> ColumnFunction:
    return lambda each: (np.exp(-0.5 * ((each.channels.time - middle) / width) ** 2),)
