"""A gyro's model: its effects with their values, how well they are known, and the last self-calibration."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from gyro_calibration.effects import Channels, Effect, Number
from gyro_calibration.history import History
from gyro_calibration.log import DEGREE, Array
from gyro_calibration.noise import Noise


@dataclass(frozen=True)
class Term:
    """One effect of a model with the values of its parameters, shapes first."""

    effect: Effect
    values: tuple[float, ...]

    def columns(self, channels: Channels) -> Sequence[Number]:
        """Return one column a coefficient."""
        return self.effect.columns(channels, *self.values[:len(self.effect.shapes)])

    def error(self, channels: Channels) -> Number:
        """Return what the effect adds to the output, rad/s."""
        return self.effect.error(channels, self.values)

    @property
    def fitted(self) -> tuple[int, ...]:
        """Return the places of the values that a fit finds: those of the parameters without a default."""
        return tuple(place for place, parameter in enumerate(self.effect.parameters) if parameter.default is None)

    def sensitivity(self, channels: Channels) -> list[Number]:
        """Return what the error changes by for each fitted value: its column, or for a shape the derivative (0 where nothing is added)."""
        columns, shapes = self.columns(channels), len(self.effect.shapes)
        return [self._derivative(place, channels) if place < shapes else columns[place - shapes] for place in self.fitted]

    def _derivative(self, place: int, channels: Channels) -> Number:
        step = 1e-5 * abs(self.values[place]) or 1e-9
        below, above = (replace(self, values=(*self.values[:place], self.values[place] + change, *self.values[place + 1:]))
                        for change in (-step, step))
        return (above.error(channels) - below.error(channels)) / (2.0 * step)


@dataclass(frozen=True)
class SelfCalibration:
    """
    Scale factor error s and bias b that a run found behind the model (Hong and Park, eq. 1 to 3).

    Attributes
    ----------
    scale_factor_error : s, 1
    bias : b, rad/s
    covariance : of (s, b), shape (2, 2); None where it is not known
    time : when, ISO 8601
    temperature : at which, degC; None where it was not known
    method : likelihood, heading, rate, turns or rest

    """

    scale_factor_error: float = 0.0
    bias: float = 0.0
    covariance: tuple[tuple[float, float], tuple[float, float]] | None = None
    time: str = ''
    temperature: float | None = None
    method: str = ''

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

    def figures(self) -> dict[str, Any]:
        """Return what there is to know, by name, in SI; None for what is not known."""
        scale_deviation, bias_deviation = (None if math.isnan(value) else value for value in self.standard_deviations)
        return {'scale_factor_error': self.scale_factor_error, 'scale_factor_error_standard_deviation': scale_deviation,
                'bias': self.bias, 'bias_standard_deviation': bias_deviation, 's_bar': self.scale, 'b_bar': self.offset,
                'calibration_time': self.time, 'calibration_temperature': self.temperature, 'method': self.method}

    def __str__(self) -> str:
        """Return a sentence for people."""
        known = self.covariance is not None
        scale, bias = (f' +- {deviation:.{digits}f}' if known else '' for deviation, digits in zip(
            (100 * self.standard_deviations[0], self.standard_deviations[1] / DEGREE), (3, 4)))
        temperature = '' if self.temperature is None else f' at {self.temperature:.1f} degC'
        return (f'scale factor error {100 * self.scale_factor_error:.3f}{scale} %, bias {self.bias / DEGREE:.4f}{bias} deg/s '
                f'(s_bar {self.scale:.6f}, b_bar {self.offset:.6f} rad/s){temperature}')


@dataclass(frozen=True)
class GyroModel:
    """
    What is known of one gyro.

    Attributes
    ----------
    terms : its effects
    covariance : of all fitted values in the order of the terms, shape (m, m), or None where it is not known
    rate_range, temperature_range : what the values were fitted on, rad/s and degC
    noise : its noise figures
    gyro : name, serial_number, technology, as text
    origin : files, date and program that it comes from
    self_calibration : the last one

    """

    terms: tuple[Term, ...] = ()
    covariance: Array | None = None
    rate_range: tuple[float, float] = (-math.inf, math.inf)
    temperature_range: tuple[float, float] = (-math.inf, math.inf)
    reference_temperature: float = 25.0
    noise: Noise = Noise()
    gyro: Mapping[str, str] = field(default_factory=dict)
    origin: Mapping[str, Any] = field(default_factory=dict)
    self_calibration: SelfCalibration | None = None

    def error(self, channels: Channels) -> Number:
        """Return the sum of all effects, rad/s."""
        return _sum(self.terms, channels)

    def steepness(self, channels: Channels) -> Number:
        """Return what rate and error together grow by with the rate, 1; not below 0.1, as `rate` solves for no effect beyond that."""
        sought = self._parted_by_rate[1]
        if not sought:
            return 1.0
        step = 1e-5  # rad/s; small beside what bends an effect, and large beside the rounding of its error
        below, above = (_sum(sought, channels.moving(channels.rate + change, channels.output)) for change in (-step, step))
        return np.maximum(1.0 + (above - below) / (2.0 * step), 0.1)

    def looks_at(self, channel: str) -> bool:
        """Tell whether an effect uses the channel."""
        return any(channel in term.effect.looks_at for term in self.terms)

    @cached_property
    def looks_around(self) -> bool:
        """Tell whether an effect looks at more than rate, output and temperature of the moment, so that a history is needed."""
        return any(term.effect.looks_at - {'rate', 'output', 'temperature'} for term in self.terms)

    @cached_property
    def moves_stamps(self) -> bool:
        """Tell whether samples were taken at another time than their stamps say."""
        return any(term.effect.moved is not None for term in self.terms)

    def history(self) -> History:
        """Return a history that begins now, of the temperatures that the model uses."""
        return History(self.reference_temperature, *self.temperature_range)

    def output(self, rate: Number, temperature: Number) -> Number:
        """Return the output, rad/s, that solves ``output = rate + error(rate, output, temperature)``; without noise."""
        return self.output_in(Channels(rate, rate, temperature))

    def output_in(self, channels: Channels) -> Number:
        """Return the output, rad/s, at the rate of the channels and in their surroundings; without noise."""
        rate, (known, sought) = channels.rate, self._parted_by_output
        given = rate + _sum(known, channels)
        return _solve(lambda output: given + _sum(sought, channels.moving(rate, output)), rate, bool(sought))

    def rate(self, output: Number, temperature: Number) -> Number:
        """Return the rate, rad/s, that solves ``rate = output - error(rate, output, temperature)``; what cannot be undone stays."""
        return self.rate_in(Channels(output, output, temperature))

    def rate_in(self, channels: Channels) -> Number:
        """Return the rate, rad/s, at the output of the channels and in their surroundings, of which the rate does not matter."""
        output, (known, sought) = channels.output, self._parted_by_rate
        given = output - _sum(known, channels)
        return _solve(lambda rate: given - _sum(sought, channels.moving(rate, output)), output, bool(sought))

    def distorted(self, stage: str, signal: Array, time: Array) -> Array:
        """Return the signal of a whole log after the effects that change it at a stage, 'rate' or 'output'."""
        for term in self.terms:
            if term.effect.distortion is not None and term.effect.stage == stage:
                signal = term.effect.distortion(signal, time, *term.values)
        return signal

    def true_time(self, time: Number) -> Number:
        """Return when a sample was taken, s since power-on, that has a stamp of `time`, s since power-on."""
        # As `distorted` has it: the last effect changed the signal that the ones before it had moved already.
        for term in reversed(self.terms):
            if term.effect.moved is not None:
                time = term.effect.moved(time, *term.values)
        return time

    @cached_property
    def _parted_by_output(self) -> Parted:
        return _parted(self.terms, 'output')

    @cached_property
    def _parted_by_rate(self) -> Parted:
        return _parted([term for term in self.terms if not term.effect.undone], 'rate')


#: Effects that do not look at what is sought, which need no repetition to solve for it, and those that do.
Parted = tuple[list[Term], list[Term]]


def _parted(terms: Sequence[Term], channel: str) -> Parted:
    known = [term for term in terms if channel not in term.effect.looks_at]
    return known, [term for term in terms if channel in term.effect.looks_at]


def _sum(terms: Sequence[Term], channels: Channels) -> Number:
    return sum(term.error(channels) for term in terms)


def _solve(g: Callable[[Number], Number], start: Number, implicit: bool) -> Number:
    """
    Solve x = g(x) for a slope of g well below one.

    The plain repetition wins a factor of the slope a pass; along the secant each pass wins more than the one before, and a slope that is
    constant is solved at once. The number of passes is fixed, so that a sample and a whole log take the same steps; of a single sample
    those are left out that would change nothing.

    """
    a, b = start, g(start)
    if not implicit:
        return b
    g_a = b
    for _ in range(6):
        g_b = g(b)
        if not isinstance(b, np.ndarray) and g_b == b:
            break
        step = b - a
        slope = (g_b - g_a) / (step + (step == 0.0))
        slope = slope * (abs(slope) < 0.9)
        a, g_a, b = b, g_b, b + (g_b - b) / (1.0 - slope)
    return b


def with_self_calibration(model: GyroModel, calibration: SelfCalibration | None) -> GyroModel:
    """Return the model with another self-calibration."""
    return replace(model, self_calibration=calibration)


def same_effects(model: GyroModel, other: GyroModel) -> bool:
    """Tell whether two models compensate alike, so that a self-calibration behind one holds behind the other."""
    first, second = ([(term.effect.name, term.values) for term in each.terms] for each in (model, other))
    return first == second
