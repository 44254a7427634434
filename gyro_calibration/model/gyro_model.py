# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""A gyro's model: its effects with values and their covariance, and the last self-calibration."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from functools import cached_property
import math
from typing import Any

from gyro_calibration.logs.columns import PLAUSIBLE_TEMPERATURES
from gyro_calibration.logs.log import Array, DEGREE, Number
from gyro_calibration.model.channels import ChannelHistory
from gyro_calibration.model.effects import Channels, Effect, Parameter
from gyro_calibration.model.noise import Noise
import numpy as np

#: The response is inverted where the slope of the output over the rate is at least this, 1.
_MIN_OUTPUT_SLOPE = 0.1
#: Python floats need no error state of numpy; setting one for each sample would cost time.
_NO_ERROR_STATE = nullcontext()
#: Largest last step of a converged iteration, relative to 1 rad/s plus the rate.
STEP_TOLERANCE = 1e-10


@dataclass(frozen=True)
class Term:
    """One effect of a model with the values of its parameters, shapes first."""

    effect: Effect
    values: tuple[float, ...]

    def columns(self, channels: Channels) -> Sequence[Number]:
        return self.effect.columns(channels, *self.values[:len(self.effect.nonlinear_parameters)])

    @cached_property
    def error(self) -> Callable[[Channels], Number]:
        return self.effect.error_function(self.values)

    @cached_property
    def fitted_indices(self) -> tuple[int, ...]:
        """Return the indices of the fitted values: parameters without a default."""
        return tuple(place for place, parameter in enumerate(self.effect.parameters)
                     if parameter.default is None)

    def sensitivity(self, channels: Channels) -> list[Number]:
        """Return the derivative of the error by each fitted value."""
        shapes = len(self.effect.nonlinear_parameters)
        rows = [*[0.0] * shapes, *self.columns(channels)]
        for place in (each for each in self.fitted_indices if each < shapes):
            step = 1e-5 * abs(self.values[place]) or 1e-9
            below, above = (self.effect.error_function(
                (*self.values[:place], self.values[place] + change, *self.values[place + 1:]))(
                    channels) for change in (-step, step))
            rows[place] = (above - below) / (2.0 * step)
        return [rows[place] for place in self.fitted_indices]


@dataclass(frozen=True)
class SelfCalibration:
    """Scale factor error s and bias b that remain after the model (Hong and Park, eq. 1 to 3)."""

    scale_factor_error: float = 0.0  # s, 1
    bias: float = 0.0  # b, rad/s
    # of (s, b), shape (2, 2); None where it is not known
    covariance: tuple[tuple[float, float], tuple[float, float]] | None = None
    time: str = ''  # when, ISO 8601
    temperature: float | None = None  # at which, degC; None where it was not known
    method: str = ''  # likelihood, heading, rate, turns or rest

    @property
    def scale(self) -> float:
        """Return s̄ = 1 / (1 + s) of eq. 3."""
        return 1.0 / (1.0 + self.scale_factor_error)

    @property
    def offset(self) -> float:
        """Return b̄ = -b / (1 + s) of eq. 3, rad/s."""
        return -self.bias * self.scale

    @property
    def standard_deviations(self) -> tuple[float, float]:
        """Return those of s and b, 1 and rad/s; nan where they are not known."""
        if self.covariance is None:
            return math.nan, math.nan
        return math.sqrt(self.covariance[0][0]), math.sqrt(self.covariance[1][1])

    def correct(self, rate: Number) -> Number:
        """Return the rate, rad/s, from one that the model has compensated (eq. 3)."""
        return self.scale * rate + self.offset

    def to_dict(self) -> dict[str, Any]:
        """Return the values by name, in SI; None for unknown ones."""
        scale_deviation, bias_deviation = (None if math.isnan(value) else value
                                           for value in self.standard_deviations)
        return {'scale_factor_error': self.scale_factor_error,
                'scale_factor_error_standard_deviation': scale_deviation,
                'bias': self.bias, 'bias_standard_deviation': bias_deviation,
                's_bar': self.scale, 'b_bar': self.offset, 'calibration_time': self.time,
                'calibration_temperature': self.temperature, 'method': self.method}

    def __str__(self) -> str:
        known = self.covariance is not None
        scale, bias = (f' +- {deviation:.{digits}f}' if known else '' for deviation, digits in zip(
            (100 * self.standard_deviations[0], self.standard_deviations[1] / DEGREE), (3, 4)))
        temperature = '' if self.temperature is None else f' at {self.temperature:.1f} degC'
        return (f'scale factor error {100 * self.scale_factor_error:.3f}{scale} %, '
                f'bias {self.bias / DEGREE:.4f}{bias} deg/s '
                f'(s_bar {self.scale:.6f}, b_bar {self.offset:.6f} rad/s){temperature}')


@dataclass(frozen=True)
class Tolerance:
    """Errors of the rate beyond the covariance of the values: standard deviations."""

    # from one run to the next, rad/s and 1; a self-calibration replaces them
    bias: float = 0.0
    scale_factor_error: float = 0.0
    # per K outside of the calibrated temperatures, rad/s/K and 1/K
    bias_per_kelvin: float = 0.0
    scale_factor_error_per_kelvin: float = 0.0
    # error of the rate per rad/s of the output outside of the calibrated range, 1
    per_rate: float = 0.0


@dataclass(frozen=True, repr=False)
class GyroModel:
    """The model of one gyro."""

    terms: tuple[Term, ...] = ()  # its effects
    # of all fitted values in the order of the terms, shape (m, m); None if unknown
    covariance: Array | None = None
    # calibrated range of the fit, rad/s and degC
    rate_range: tuple[float, float] = (-math.inf, math.inf)
    temperature_range: tuple[float, float] = (-math.inf, math.inf)
    reference_temperature: float = 25.0  # where no temperature is known, degC
    noise: Noise = Noise()  # its noise figures
    # name, serial_number, technology, as text
    gyro: Mapping[str, str] = field(default_factory=dict)
    # files, date and program of the calibration
    origin: Mapping[str, Any] = field(default_factory=dict)
    self_calibration: SelfCalibration | None = None  # the last one
    tolerance: Tolerance = Tolerance()  # errors of the rate beyond the covariance
    # by name of a noise figure, the bounds that hold it with 95 % confidence
    noise_bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def __repr__(self) -> str:
        values = (f'{parameter.name} {value:.4g} {parameter.unit}'.removesuffix(' 1')
                  for _, parameter, value, _ in self.estimates())
        return f'<GyroModel: {", ".join(values) or "no errors"}>'

    def estimates(self) -> Iterator[tuple[str, Parameter, float, float]]:
        """Give effect name, parameter, value and standard deviation of each fitted value."""
        fitted = [(term, place) for term in self.terms for place in term.fitted_indices]
        deviations = ([math.nan] * len(fitted) if self.covariance is None
                      else np.sqrt(np.diag(self.covariance)).tolist())
        for (term, place), deviation in zip(fitted, deviations):
            yield term.effect.name, term.effect.parameters[place], term.values[place], deviation

    def error(self, channels: Channels) -> Number:
        return _sum_errors(self.terms, channels)

    def output_slope(self, channels: Channels) -> Number:
        """Return the derivative of rate plus error by the rate, 1; at least 0.1 (see `rate`)."""
        dependent = self._split_by_rate[1]
        if not dependent:
            return 1.0
        # rad/s; small against the curvature of effects, and large against rounding errors
        step = 1e-5
        below, above = (_sum_errors(dependent,
                                    channels.with_rate(channels.rate + change, channels.output))
                        for change in (-step, step))
        return np.maximum(1.0 + (above - below) / (2.0 * step), _MIN_OUTPUT_SLOPE)

    @cached_property
    def rate_limit(self) -> float:
        """Return the largest plausible output, rad/s."""
        # twice the largest valid rate, but at least 10 rad/s: a model may have been fitted at rest
        farther = max(map(abs, self.rate_range))
        return max(2.0 * farther, 10.0) if farther < math.inf else 100.0

    @cached_property
    def temperature_limits(self) -> tuple[float, float]:
        """Return the plausible temperatures, degC: at least -100 to 200."""
        (low, high), (coldest, hottest) = self.valid_temperatures, PLAUSIBLE_TEMPERATURES
        return min(low, coldest), max(high, hottest)

    @cached_property
    def valid_temperatures(self) -> tuple[float, float]:
        """Return the calibrated temperatures, degC; the plausible ones where none are stated."""
        low, high = ((value if math.isfinite(value) else usual)
                     for value, usual in zip(self.temperature_range, PLAUSIBLE_TEMPERATURES))
        return low, max(low, high)

    @cached_property
    def extrapolation_range(self) -> tuple[float, float]:
        """Return the temperatures, degC, up to which the correction is extrapolated."""
        (low, high), (coldest, hottest) = self.valid_temperatures, self.temperature_limits
        # the width of the valid range, but at least the warm-up of a robot after a cold start
        reach = max(high - low, 20.0)
        return max(low - reach, coldest), min(high + reach, hottest)

    @cached_property
    def active_tolerances(self) -> tuple[str, ...]:
        """Return the names of the tolerances above 0 that no self-calibration replaces."""
        found = ('bias', 'scale_factor_error') if self.self_calibration else ()
        return tuple(name for name, value in vars(self.tolerance).items()
                     if value > 0.0 and name not in found)

    @cached_property
    def fits_scale_and_bias(self) -> tuple[bool, bool]:
        """Tell whether scale factor error and bias are values of the model, or sums of them."""
        # whether columns of the effects add up to the rate, and to 1, in any surroundings
        number = np.arange(100.0)
        rates = np.cos(number)
        channels = Channels(rates, rates, self.reference_temperature + 10.0 * np.sin(3.0 * number),
                            number ** 2)
        columns = [np.broadcast_to(row, rates.shape) for term in self.terms
                   if not term.effect.not_compensated for row in term.sensitivity(channels)]
        if not columns:
            return False, False
        wanted = np.array([rates, np.ones(len(rates))]).T
        matrix = np.array(columns).T
        rest = wanted - matrix @ np.linalg.lstsq(matrix, wanted, rcond=None)[0]
        scale, bias = (np.abs(rest).max(axis=0) < 1e-6).tolist()
        return scale, bias

    @cached_property
    def prior_deviations(self) -> Array | None:
        """Return the deviations of (s, b) before a calibration, shape (2,); inf if unknown."""
        # the tolerance of a fleet is the spread of a type, that of another model of one gyro
        if 'fleet' not in self.origin:
            return None
        return np.array([getattr(self.tolerance, name) or math.inf
                         for name in ('scale_factor_error', 'bias')])

    @cached_property
    def rate_domain(self) -> tuple[float, float]:
        """Return the rates between which the response is inverted, rad/s."""
        # from the valid rate nearest to zero to where the output no longer grows with the rate at
        # some used temperature, or would not be plausible
        low, high = self.rate_range
        centre = min(max(0.0, low), high)
        dependent, ends = self._split_by_rate[1], list[float]()
        distances = np.concatenate(
            [[0.0], self.rate_limit / _MIN_OUTPUT_SLOPE * np.geomspace(1e-6, 1.0, 4000)])

        def output(rate: Array, temperature: float) -> Array:
            return rate + _sum_errors(dependent, Channels(rate, rate, temperature))

        for side in (-1.0, 1.0):
            with np.errstate(all='ignore'):
                # between the distances, and closely before each: a step down may be narrow
                good = np.all([
                    side * (output(centre + side * distances[1:], temperature)
                            - output(centre + side * begin, temperature))
                    >= _MIN_OUTPUT_SLOPE * (distances[1:] - begin)
                    for begin in (distances[:-1], (1.0 - 1e-6) * distances[1:])
                    for temperature in self.extrapolation_range], axis=0)
            ends.append(centre + side * float(
                distances[-1] if good.all() else distances[np.argmin(good)]))
        return ends[0], ends[1]

    def uses_channel(self, channel: str) -> bool:
        return any(channel in term.effect.inputs for term in self.terms)

    @cached_property
    def needs_history(self) -> bool:
        """Tell whether an effect needs a history: more than rate, output and temperature now."""
        return any(term.effect.inputs - {'rate', 'output', 'temperature'} for term in self.terms)

    @cached_property
    def moves_stamps(self) -> bool:
        """Tell whether samples were taken at another time than their stamps say."""
        return any(term.effect.correct_stamps is not None for term in self.terms)

    def start_history(self) -> ChannelHistory:
        """Return a new history, with the reference temperature and the bounds of this model."""
        return ChannelHistory(self.reference_temperature, *self.extrapolation_range)

    def output(self, rate: Number, temperature: Number) -> Number:
        """Return the output, rad/s, with ``output = rate + error(rate, output, temperature)``."""
        return self.output_from_channels(Channels(rate, rate, temperature))

    def output_from_channels(self, channels: Channels) -> Number:
        """Return the output, rad/s, without noise, at the rate and surroundings of channels."""
        rate, (independent, dependent) = channels.rate, self._split_by_output
        given = rate + _sum_errors(independent, channels)
        return _iterate_secant(
            lambda output: given + _sum_errors(dependent, channels.with_rate(rate, output)),
            rate)[0] if dependent else given

    def rate(self, output: Number, temperature: Number) -> Number:
        """Return the rate, rad/s, with ``rate = output - error(rate, output, temperature)``."""
        return self.rate_from_channels(Channels(output, output, temperature))[0]

    def rate_from_channels(self, channels: Channels) -> tuple[Number, Number]:
        """
        Return the rate, rad/s, at the output and the surroundings of channels.

        The second value tells whether no rate of the `rate_domain` has this output; then the
        correction at its end is used.
        """
        output, (independent, dependent) = channels.output, self._split_by_rate
        given = output - _sum_errors(independent, channels)
        if not dependent:
            return given, False
        seen = channels.with_rate(output, output)

        def error_at(rate: Number) -> Number:
            # `seen` is local to this call; new channels would take as long as the computation
            seen.__dict__['rate'] = rate
            return _sum_errors(dependent, seen)

        # solve ``rate + error_at(rate) = given``; in the domain the left side grows with the rate
        low, high = self.rate_domain
        many = isinstance(given, np.ndarray)
        with np.errstate(all='ignore') if many else _NO_ERROR_STATE:
            # a single sample may leave the domain by at most 1 rad/s during the iteration
            rate, step = _iterate_secant(
                lambda x: given - error_at(x), output, low - 1.0, high + 1.0)
            solved = ((low <= rate) & (rate <= high)
                      & (abs(step) <= STEP_TOLERANCE * (1.0 + abs(rate))))
        if solved.all() if many else solved:
            return rate, False
        with np.errstate(all='ignore'):
            at_low, at_high = error_at(low), error_at(high)
            below, above = given < low + at_low, given > high + at_high
            if not np.all(solved | below | above):
                begin, end = low + 0.0 * given, high + 0.0 * given
                for _ in range(80):
                    middle = 0.5 * (begin + end)
                    higher = middle + error_at(middle) < given
                    begin, end = np.where(higher, middle, begin), np.where(higher, end, middle)
                rate = np.where(solved, rate, begin)
            rate = np.where(below, given - at_low, np.where(above, given - at_high, rate))
        return (rate, below | above) if many else (float(rate), bool(below or above))

    def distort(self, stage: str, signal: Array, time: Array) -> Array:
        """Return the signal of a log after the effects of a stage, 'rate' or 'output'."""
        for term in self.terms:
            if term.effect.distortion is not None and term.effect.stage == stage:
                signal = term.effect.distortion(signal, time, *term.values)
        return signal

    def true_time(self, time: Number) -> Number:
        """Return the time of measurement of a sample by its stamp, both in s since power-on."""
        # in the inverse order of `distort`
        for term in reversed(self.terms):
            if term.effect.correct_stamps is not None:
                time = term.effect.correct_stamps(time, *term.values)
        return time

    # terms that do not depend on the unknown, which need no iteration, and terms that do

    @cached_property
    def _split_by_output(self) -> list[list[Term]]:
        return [[term for term in self.terms if ('output' in term.effect.inputs) == depends]
                for depends in (False, True)]

    @cached_property
    def _split_by_rate(self) -> list[list[Term]]:
        return [[term for term in self.terms if not term.effect.not_compensated
                 and ('rate' in term.effect.inputs) == depends] for depends in (False, True)]


def _sum_errors(terms: Sequence[Term], channels: Channels) -> Number:
    if not terms:
        return 0.0
    total = terms[0].error(channels)
    for term in terms[1:]:
        total = total + term.error(channels)
    return total


def _iterate_secant(g: Callable[[Number], Number], start: Number, low: float = -math.inf,
                    high: float = math.inf) -> tuple[Number, Number]:
    """Solve x = g(x) for a slope of g well below one; return x, and the last step."""
    # a single sample skips passes that would change nothing, and is limited to the bounds
    a, b = start, g(start)
    many, g_a, step = isinstance(b, np.ndarray), b, b - a
    for _ in range(6):
        g_b = g(b)
        if not many and g_b == b:
            return b, 0.0
        slope = (g_b - g_a) / (step + (step == 0.0))
        slope = slope * (slope < 0.9)
        a, g_a, b = b, g_b, b + (g_b - b) / (1.0 - slope)
        if not many:
            b = min(max(b, low), high)
        step = b - a
    return b, step


def with_self_calibration(model: GyroModel, calibration: SelfCalibration | None) -> GyroModel:
    return replace(model, self_calibration=calibration)


def have_same_effects(model: GyroModel, other: GyroModel) -> bool:
    """Tell whether two models have the same effects, so that a self-calibration fits both."""
    first, second = ([(term.effect.name, term.values) for term in each.terms]
                     for each in (model, other))
    return first == second
