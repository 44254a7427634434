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

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations, product
import math
from typing import Any

from gyro_calibration.diagnosis.replay import Replay
from gyro_calibration.heading.integration import integrate
from gyro_calibration.logs.log import Array, DEGREE
from gyro_calibration.model.effects import CATALOGUE
import numpy as np
from scipy.interpolate import BSpline

#: Times of a bias step, and of a bump, that are tried in all logs together.
MAX_STEP_TIMES = 64
#: Lack of log-likelihood at the ends of the interval of 95 % of the time of a step: a random walk
#: with a drift of minus half its variance on either side exceeds it with that probability.
MAX_STEP_TIME_LACK = -math.log(1.0 - math.sqrt(0.95))
#: Least change of a channel in a log, K, V and m/s²; with less it counts as missing.
MIN_CHANNEL_RANGE = {'temperature': 0.2, 'supply': 1e-9, 'specific_force': 1e-9}

#: Prefix of the name of structure without a name, which its variable follows; and the name of an
#: error that is proportional to the rate in a part of a log.
_UNNAMED_PREFIX = '~'
PART_OF_LOG = f'{_UNNAMED_PREFIX}rate and time'

#: Columns of one log: (replay, *shapes) -> arrays of shape (n,); and a variable that they are of.
_ColumnFunction = Callable[..., Sequence[Array]]
_Variable = Callable[[Replay], Array]


@dataclass(frozen=True)
class Candidate:
    """One cause with its shapes; after its selection, also with its values."""

    cause: str  # its name
    shapes: tuple[float, ...]  # their values, in the order of the effect
    function: _ColumnFunction  # of a log and the shapes
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

    def columns(self, log: Any) -> Sequence[Array]:
        """Return its columns of a log."""
        return self.function(log, *self.shapes)

    @property
    def distorts(self) -> bool:
        """Tell whether it distorts the rate before errors are added to it."""
        return (self.amplitude is not None and self.cause in CATALOGUE
                and CATALOGUE[self.cause].stage == 'rate')


def effect_candidate(name: str, *shapes: float, log_index: int | None = None,
                     half_width: float | None = None) -> Candidate:
    """Return the candidate of an effect of the gyro, or of the reference."""
    if name in _REFERENCE_EFFECTS:
        return Candidate(name, shapes, _REFERENCE_EFFECTS[name], log_index)
    known = CATALOGUE[name]
    if (distortion := known.distortion) is not None:
        # change of the rate by a delay, a lag, a clock rate or a limit
        def rate_change(each: Replay, *sizes: float) -> Sequence[Array]:
            rate = each.channels.rate
            return (distortion(rate, each.channels.time, *sizes) - rate,)
        return Candidate(name, shapes, rate_change, log_index, 1.0)
    amplitude = known.coefficients[0].default if known.coefficients else None
    return Candidate(name, shapes, lambda each, *sizes: known.columns(each.channels, *sizes),
                     log_index, amplitude, half_width)


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
    return [] if candidate.cause in _DISCONTINUOUS else fitted_shape_indices(candidate)


def with_shape(candidate: Candidate, shape_index: int, value: float) -> Candidate:
    """Return a candidate without values with another shape, within the bounds of its effect."""
    if candidate.cause in CATALOGUE:
        value = float(np.clip(value, *CATALOGUE[candidate.cause].parameters[shape_index].bounds))
    shapes = (*candidate.shapes[:shape_index], value, *candidate.shapes[shape_index + 1:])
    return replace(candidate, shapes=shapes, values=())


def common_channels(replays: Sequence[Replay]) -> frozenset[str]:
    """Return the channels that all logs have."""
    return frozenset.intersection(*(each.available_channels for each in replays))


def constant_channels(replays: Sequence[Replay]) -> frozenset[str]:
    """Return the channels that are nearly constant in each log that has them."""
    known = {name: [getattr(each.channels, name) for each in replays
                    if name in each.available_channels] for name in MIN_CHANNEL_RANGE}
    return frozenset(name for name, values in known.items() if values
                     and max(float(np.ptp(value)) for value in values) < MIN_CHANNEL_RANGE[name])


def observed_range(rates: Sequence[Array], temperatures: Sequence[Array],
                   duration: float) -> dict[str, float]:
    """
    Return rate, temperature and duration of proposed experiments, deg/s, degC and min.

    Given are those of the logs, rad/s, degC and s; no temperatures if they are not known.
    """
    numbers = {'long': 4.0 * math.ceil(duration / 60.0)}
    top = max(float(np.quantile(np.abs(each), 0.999)) for each in rates) / DEGREE
    if top > 0.0:
        numbers |= {'top': top, 'faster': 3.0 * top}
    if temperatures:
        degc = np.concatenate(temperatures)
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
        # a shorter one equals a sensitivity to the temperature rate
        'thermal_lag': [(each,) for each in np.geomspace(
            12.0, min(duration, 3000.0), 8).tolist()],
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
    # under all noises; the scan, under the likeliest one, finds them at each time
    per_log = max(MAX_STEP_TIMES // len(replays), 1)
    for run, each in enumerate(replays):
        begin, spacing = float(each.channels.time[each.valid][0]), each.duration / (per_log + 1)
        for number in range(1, per_log + 1):
            yield effect_candidate('bias_step', begin + number * spacing, log_index=run,
                                   half_width=1.5 * spacing)
    if not moves:
        return
    # At less than 20 steps of an encoder a second its quantization, or the largest noise of a
    # heading in a log, passes for a dead zone.
    slowest = max(1e-5 * fastest, *(
        max(20.0 * each.heading_step, each.heading_noise / each.interval
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
#: Linear response of a motion to its reference rate; lags between which it is constant, s: from
#: 0.1 s on two in an octave.
RESPONSE = f'{_UNNAMED_PREFIX}rate_change'
_RESPONSE_LAGS = np.append(0.05 * np.arange(-2, 2),
                           np.outer(2.0 ** np.arange(5), (0.1, 0.15)))
#: Widths of a bump in time as shares of the duration.
_BUMP_WIDTHS = (0.01, 0.05)


def is_named(candidate: Candidate) -> bool:
    """Tell whether a candidate is a cause, not structure without a name."""
    return not candidate.cause.startswith(_UNNAMED_PREFIX)


def unnamed_variable(candidate: Candidate) -> str:
    """Return the variable of a structure without a name."""
    return candidate.cause[len(_UNNAMED_PREFIX):]


def generic_terms(replays: Sequence[Replay]) -> Iterator[Candidate]:
    """Give the generic terms that these logs may show."""
    def unnamed(name: str, columns: Callable[..., Sequence[Array]],
                *variables: _Variable) -> Candidate:
        return Candidate(_UNNAMED_PREFIX + name, (), lambda each: columns(
            *(of(each) for of in variables)))

    def heading(each: Replay) -> Array:
        return each.channels.heading

    def splines(values: Array) -> Sequence[Array]:
        return tuple(BSpline.design_matrix(values, knots, 3).toarray().T[1:])

    # those that change in these logs, each scaled to -1 to 1
    variables: dict[str, _Variable] = {}
    has = common_channels(replays) - constant_channels(replays)
    known: dict[str, _Variable] = {
        'rate': lambda each: each.channels.rate,
        'temperature': lambda each: each.channels.temperature,
        'supply': lambda each: np.asarray(each.channels.supply),
        'specific_force': lambda each: each.lagged('specific_force', 0.3)}
    for name in (each for each in known if each == 'rate' or each in has):
        ends = [(float(values.min()), float(values.max())) for values in map(known[name], replays)]
        low, high = min(low for low, _ in ends), max(high for _, high in ends)
        if high > low:
            variables[name] = partial(_scaled, known[name], low, high)
    knots = np.concatenate([[-1.0] * 3, np.linspace(-1.0, 1.0, _SPLINE_KNOTS - 2), [1.0] * 3])
    for name, of in variables.items():
        for count in _WAVE_COUNTS if name in ('rate', 'temperature') else ():
            yield unnamed(name, partial(_waves, np.pi * count), of)
        # the sum of all splines is constant, as the bias is
        yield unnamed(name, splines, of)
    if 'rate' in variables:
        for number in _WAVE_COUNTS[1:]:
            yield unnamed('heading', partial(_waves, number), heading)
        for name, number in (('rate', 2), ('rate', 3), ('rate', 4), ('temperature', 1),
                             ('supply', 1)):
            if name in variables:
                yield unnamed(f'{name} and heading', partial(_waves, number), heading,
                              variables[name])
    if 'rate' in variables and 'reference_rate' in common_channels(replays):
        # the mean rate between two neighbouring lags less the rate, in samples of the slowest log
        interval = max(each.interval for each in replays)
        lags = np.unique(np.rint(_RESPONSE_LAGS / interval)) * interval

        def late_rates(each: Replay) -> Sequence[Array]:
            time, rate = each.channels.time, each.channels.rate
            late = np.interp(time - lags[:, None], time, integrate(time, rate))
            return [*((late[:-1] - late[1:]) / np.diff(lags)[:, None] - rate)]

        yield Candidate(RESPONSE, (), late_rates)
    for (first, one), (second, other) in combinations(variables.items(), 2):
        if (first, second) != ('rate', 'temperature'):  # scale_factor_temperature
            yield unnamed(f'{first} and {second}', lambda *values: (values[0] * values[1],), one,
                          other)
    yield from _terms_in_time(replays, 'rate' in variables)


def _terms_in_time(replays: Sequence[Replay], moves: bool) -> Iterator[Candidate]:
    """Give scale factors that differ in a part of a log, and bumps."""
    # so many ends have `MAX_STEP_TIMES` pairs
    ends_count = math.isqrt(2 * MAX_STEP_TIMES // len(replays)) + 1
    for run, each in enumerate(replays):
        begin, duration = float(each.channels.time[each.valid][0]), each.duration
        if moves:
            for part in combinations(begin + duration * np.linspace(0.0, 1.0, ends_count), 2):
                if part[1] - part[0] < 0.99 * duration:
                    yield Candidate(PART_OF_LOG, part, _part_of_log, run,
                                    half_width=duration / (ends_count - 1))
        for width in _BUMP_WIDTHS:
            number = min(MAX_STEP_TIMES, round(1.0 / width)) // len(replays) + 3
            for moment in begin + duration * np.linspace(0.0, 1.0, number)[1:-1]:
                yield Candidate(f'{_UNNAMED_PREFIX}time', (moment,), partial(
                    _bump, width * duration), run)


def _scaled(of: _Variable, low: float, high: float, each: Replay) -> Array:
    return np.clip((2.0 * of(each) - low - high) / (high - low), -1.0, 1.0)


def _waves(number: float, phase: Array, size: Array | float = 1.0) -> Sequence[Array]:
    return size * np.sin(number * phase), size * np.cos(number * phase)


def _bump(width: float, each: Replay, middle: float) -> Sequence[Array]:
    return (np.exp(-0.5 * ((each.channels.time - middle) / width) ** 2),)


def _part_of_log(each: Replay, first: float, last: float) -> Sequence[Array]:
    time = each.channels.time
    return (each.channels.rate * ((time >= first) & (time < last)),)
