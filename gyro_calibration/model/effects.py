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
Errors of a gyro: the formula of each effect between the true rate and the output.

Most effects add ``sum(columns(channels, *shapes) * values)`` to the output. Others, such as a
delay or rounding, change the signal itself. A new effect is one more record here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
import math
from typing import Any

from gyro_calibration.logs.log import Array, DEGREE, Number
import numpy as np
from scipy.interpolate import CubicSpline


@dataclass(frozen=True)
class Channels:
    """Inputs of effects, at one instant (numbers) or at many (arrays of shape (n,))."""

    rate: Number  # true rate, rad/s
    output: Number  # output of the gyro, rad/s
    temperature: Number  # degC
    time: Number = 0.0  # since power-on, s
    specific_force: Number = 0.0  # along the input axis, m/s²
    supply: Number | None = None  # V; None where it is not known
    heading: Number = 0.0  # rad
    # of earlier samples, by `model.channels`; without them the past is taken to be constant
    # (channel, time constant) -> the channel through a first-order lag: 'temperature',
    # 'specific_force', or 'vibration', its squared deviation from its own mean over 1 s
    lagged: Callable[[str, float], Number] | None = None
    # (filter time, s, threshold, K/s) -> 1 after the temperature rose, -1 after it fell, else 0
    heating: Callable[[float, float], Number] | None = None

    def with_rate(self, rate: Number, output: Number) -> Channels:
        """Return the same surroundings with another rate and output."""
        # The constructor would take three times as long.
        other = object.__new__(Channels)
        other.__dict__.update(self.__dict__, rate=rate, output=output)
        return other

    def ones(self) -> Number:
        """Return 1 in the shape of the rates."""
        return np.ones_like(self.rate) if isinstance(self.rate, np.ndarray) else 1.0


@dataclass(frozen=True)
class Parameter:
    name: str
    unit: str
    default: float | None = None  # a convention; without one it is fitted
    bounds: tuple[float, float] = (-np.inf, np.inf)
    begin_with: tuple[float, ...] = ()  # first values of a nonlinear one in a diagnosis


@dataclass(frozen=True)
class Effect:
    name: str  # as in the catalogue and in files
    cause: str  # one sentence for users
    inputs: frozenset[str] = frozenset()  # the channels that it uses
    coefficients: tuple[Parameter, ...] = ()  # factors of the columns
    # (channels, *shapes) -> one column per coefficient
    columns: Callable[..., Sequence[Number]] = lambda _channels, *_shapes: ()
    # nonlinear parameters, on which the columns depend
    nonlinear_parameters: tuple[Parameter, ...] = ()
    experiment: str = ''  # experiment that separates it from similar effects
    # (channels, shapes, coefficients) -> the sum of the columns, where a faster formula exists
    sum_columns: Callable[[Channels, Sequence[float], Sequence[float]], Number] | None = None
    # (signal, time, *values) -> signal, for an effect that changes the signal of a whole log
    distortion: Callable[..., Array] | None = None
    # of the distortion: 'rate' before anything is added to the rate, or 'output' after the noise
    stage: str = ''
    # (time, *values) -> time, of an effect that is compensated by shifting the stamps
    correct_stamps: Callable[..., Number] | None = None
    # the part of the effect that compensation leaves, as a sentence; '' for none
    not_compensated: str = ''
    along: str = 'time'  # channel of the abscissa of its plot in a diagnosis

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Shapes, then coefficients: the order of a term's values."""
        return self.nonlinear_parameters + self.coefficients

    def error_function(self, values: Sequence[float]) -> Callable[[Channels], Number]:
        """Return a function of channels: what the effect adds to the output, rad/s."""
        shapes = values[:len(self.nonlinear_parameters)]
        coefficients = values[len(self.nonlinear_parameters):]
        sum_columns, columns = self.sum_columns, self.columns
        if sum_columns is not None:
            return lambda channels: sum_columns(channels, shapes, coefficients)
        if len(coefficients) == 1:
            value, = coefficients
            return lambda channels: value * columns(channels, *shapes)[0]
        return lambda channels: sum(
            value * column for value, column in zip(coefficients, columns(channels, *shapes)))


def lag_difference(interval: Number, change: Number, time_constant: float,
                   initial_difference: float = 0.0) -> Number:
    """
    Return the lagged signal minus the signal, at one instant or at many (shape (n,)).

    ``time_constant * d(lagged)/dt = signal - lagged`` is solved exactly for a signal that is
    linear between its samples. Interval, s, and change are those since the previous sample.
    """
    if not isinstance(interval, np.ndarray):
        x = interval / time_constant
        return math.exp(-x) * initial_difference + change * (math.expm1(-x) / x if x else -1.0)
    # an interval of 0 must not give 0 / 0
    x = np.maximum(interval / time_constant, 1e-300)
    fallen = np.expm1(-x)
    return _solve_recurrence(fallen + 1.0, change * (fallen / x), initial_difference)


def _solve_recurrence(factors: Array, added: Array, initial: float) -> Array:
    """Return y of ``y[k] = factors[k] * y[k - 1] + added[k]``, shape (n,)."""
    # rows of sqrt(n) samples in parallel from zero; then the end of each is propagated to the next
    count = len(factors)
    width = math.isqrt(max(count - 1, 0)) + 1
    padding = (0, -count % width)
    product = np.ascontiguousarray(np.pad(factors, padding).reshape(-1, width).T)
    total = np.ascontiguousarray(np.pad(added, padding).reshape(-1, width).T)
    for k in range(1, width):
        total[k] += product[k] * total[k - 1]
        product[k] *= product[k - 1]
    starts = [initial]
    for factor, sum_of_row in zip(product[-1].tolist(), total[-1].tolist()):
        starts.append(factor * starts[-1] + sum_of_row)
    product *= np.array(starts[:-1])
    total += product
    return total.T.ravel()[:count]


def rate_temperature_polynomial(rate_order: int, temperature_order: int) -> Effect:
    """
    Return the error polynomial of Ojeda, Chung and Borenstein (2000), eq. 9 to 13.

    It is one of the output, so that compensation is one subtraction (eq. 13). Its powers are
    centred and scaled: the condition number of raw powers of deg/s and degC is about 1e11. The
    coefficient ``t{j}w{i}`` belongs to power j of temperature and i of output.
    """
    names = [f't{j}w{i}' for j in range(temperature_order + 1) for i in range(rate_order + 1)]

    def scale_inputs(channels: Channels, output_centre: float, output_scale: float,
                     temperature_centre: float, temperature_scale: float) -> tuple[Number, Number]:
        output = channels.output - output_centre
        output *= 1.0 / output_scale
        if not temperature_order:  # the temperature may be unknown
            return output, 0.0 * output
        temperature = channels.temperature - temperature_centre
        temperature *= 1.0 / temperature_scale
        return output, temperature

    def columns(channels: Channels, *shapes: float) -> Sequence[Number]:
        output, temperature = scale_inputs(channels, *shapes)
        outputs = _powers(output, rate_order)
        return [of_temperature * of_output
                for of_temperature in _powers(temperature, temperature_order)
                for of_output in outputs]

    def sum_columns(channels: Channels, shapes: Sequence[float],
                    coefficients: Sequence[float]) -> Number:
        output, temperature = scale_inputs(channels, *shapes)
        width = rate_order + 1
        inner = [_evaluate_horner(coefficients[begin:begin + width], output)
                 for begin in range(0, len(coefficients), width)]
        return _evaluate_horner(inner, temperature)

    return Effect(
        'rate_temperature_polynomial',
        'The scale factor is not linear, and bias and scale factor change with temperature.',
        frozenset({'output', 'temperature'} if temperature_order else {'output'}),
        tuple(Parameter(name, 'rad/s') for name in names), columns,
        (Parameter('output_centre', 'rad/s', 0.0),
         Parameter('output_scale', 'rad/s', 1.0, (1e-9, np.inf)),
         Parameter('temperature_centre', 'degC', 0.0),
         Parameter('temperature_scale', 'K', 1.0, (1e-9, np.inf))),
        'turn at more rates, at more temperatures, or take lower orders', sum_columns)


def _powers(value: Number, order: int) -> list[Number]:
    powers = [value * 0.0 + 1.0]
    for _ in range(order):
        powers.append(powers[-1] * value)
    return powers


def _evaluate_horner(coefficients: Sequence[Number], value: Number) -> Number:
    """Return the sum of coefficients times `_powers`, by Horner's rule, with one new array."""
    if len(coefficients) == 1:
        return coefficients[0] * (value * 0.0 + 1.0)
    total = coefficients[-1] * value
    total += coefficients[-2]
    for coefficient in coefficients[-3::-1]:
        total *= value
        total += coefficient
    return total


def polynomial_from_matrix(matrix: Any) -> tuple[Effect, tuple[float, ...]]:
    """
    Return the effect of the matrix C of eq. 11 of Ojeda et al., and its values in SI.

    C has shape (q + 1, p + 1), highest powers first: ``error = [T² T 1] C [w³ w² w 1]'`` (eq. 12).
    """
    c = np.array(matrix, dtype=float)
    rows, columns = c.shape
    in_si = c[::-1, ::-1] * DEGREE ** (1.0 - np.arange(columns))
    effect = rate_temperature_polynomial(columns - 1, rows - 1)
    return effect, (0.0, 1.0, 0.0, 1.0, *in_si.ravel().tolist())


def polynomial_to_matrix(effect: Effect, values: Sequence[float]) -> Array:
    """Return the matrix C of eq. 11 of Ojeda et al.: the inverse of `polynomial_from_matrix`."""
    output_centre, output_scale, temperature_centre, temperature_scale = values[:4]
    rows = 1 + max(int(parameter.name[1:].split('w')[0]) for parameter in effect.coefficients)
    c = np.reshape(values[4:], (rows, -1))
    columns = c.shape[1]
    of_temperature = _raw_power_coefficients(temperature_centre, temperature_scale, rows)
    raw = of_temperature.T @ c @ _raw_power_coefficients(output_centre, output_scale, columns)
    return (raw * DEGREE ** (np.arange(columns) - 1.0))[::-1, ::-1]


def _raw_power_coefficients(centre: float, scale: float, count: int) -> Array:
    """Return rows i of the coefficients of ``((x - centre) / scale)**i``, lowest power first."""
    rows = np.zeros((count, count))
    for power in range(count):
        polynomial = np.polynomial.Polynomial([-centre / scale, 1 / scale]) ** power
        rows[power, :power + 1] = polynomial.coef
    return rows


def _at_each(channels: Channels, value: Number) -> Number:
    return value + 0.0 * channels.rate


BIAS = Effect(
    'bias', 'The output at rest is not zero; it includes the Earth rate about the input axis.',
    frozenset(), (Parameter('bias', 'rad/s'),),
    lambda channels: (channels.ones(),), experiment='record at rest', along='rate')
SCALE_FACTOR_ERROR = Effect(
    'scale_factor_error', 'The scale factor differs from the nominal one.',
    frozenset({'rate'}), (Parameter('scale_factor_error', '1'),),
    lambda channels: (channels.rate,), experiment='turn at several speeds, both ways',
    along='rate')
SCALE_FACTOR_ASYMMETRY = Effect(
    'scale_factor_asymmetry', 'The scale factor differs between the two senses of rotation.',
    frozenset({'rate'}), (Parameter('scale_factor_asymmetry', '1'),),
    lambda channels: (abs(channels.rate),),
    experiment='turn both ways at many speeds, slow ones and rest too', along='rate')
QUADRATIC_NONLINEARITY = Effect(
    'quadratic_nonlinearity', 'The output has a part in proportion to the square of the rate.',
    frozenset({'rate'}), (Parameter('quadratic_nonlinearity', 's/rad'),),
    lambda channels: (channels.rate * channels.rate,),
    experiment='turn both ways at many speeds up to full scale', along='rate')
CUBIC_NONLINEARITY = Effect(
    'cubic_nonlinearity', 'The scale factor changes with the square of the rate.',
    frozenset({'rate'}), (Parameter('cubic_nonlinearity', 's²/rad²'),),
    lambda channels: (channels.rate * channels.rate * channels.rate,),
    experiment='turn at many speeds up to full scale', along='rate')
SINE_RESPONSE = Effect(
    'sine_response', 'An open-loop fibre-optic gyro responds with the sine of its Sagnac phase.',
    frozenset({'rate'}), (Parameter('amplitude', '1', default=1.0),),
    lambda channels, k: (np.sin(k * channels.rate) / k - channels.rate,),
    (Parameter('k', 's', bounds=(1e-3, 30.0)),), 'turn at many speeds up to full scale',
    along='rate')

#: Temperature at which the effects of temperature are zero, degC.
_REFERENCE_TEMPERATURE = Parameter('reference_temperature', 'degC', 25.0)
BIAS_TEMPERATURE = Effect(
    'bias_temperature', 'The bias changes in proportion to the temperature.',
    frozenset({'temperature'}), (Parameter('bias_temperature', 'rad/s/K'),),
    lambda channels, reference: (_at_each(channels, channels.temperature - reference),),
    (_REFERENCE_TEMPERATURE,), 'rest at two temperatures, and better go up and down again',
    along='temperature')
BIAS_TEMPERATURE_QUADRATIC = Effect(
    'bias_temperature_quadratic', 'The bias changes with the square of the temperature.',
    frozenset({'temperature'}), (Parameter('bias_temperature_quadratic', 'rad/s/K²'),),
    lambda channels, reference: (_at_each(channels, (channels.temperature - reference) ** 2),),
    (_REFERENCE_TEMPERATURE,), 'rest at three temperatures or more', along='temperature')
SCALE_FACTOR_TEMPERATURE = Effect(
    'scale_factor_temperature', 'The scale factor changes in proportion to the temperature.',
    frozenset({'rate', 'temperature'}), (Parameter('scale_factor_temperature', '1/K'),),
    lambda channels, reference: ((channels.temperature - reference) * channels.rate,),
    (_REFERENCE_TEMPERATURE,), 'turn at two temperatures', along='temperature')


def _temperature_lag(channels: Channels, time_constant: float) -> Number:
    if channels.lagged is None:
        return 0.0
    return channels.lagged('temperature', time_constant) - channels.temperature


_THERMAL_CYCLE = ('heat and cool the resting gyro at two temperature rates, with abrupt changes '
                  'from heating to cooling')
_FILTER_TIME = Parameter('filter_time', 's', 10.0, (1e-3, 1e4), (0.3, 1.0, 3.0, 10.0))
_THERMAL_HISTORY_EFFECTS = (
    Effect(
        'bias_temperature_rate',
        'The bias changes in proportion to the rate of change of the temperature, by gradients '
        'within the instrument (in fibre gyros the Shupe effect).',
        frozenset({'temperature', 'lagged'}), (Parameter('bias_temperature_rate', 'rad/s/(K/s)'),),
        lambda channels, filter_time: (
            _at_each(channels, -_temperature_lag(channels, filter_time) / filter_time),),
        (_FILTER_TIME,),
        _THERMAL_CYCLE, along='temperature_rate'),
    Effect(
        'thermal_lag',
        'The bias follows the temperature of the sensing element, which lags behind that of the '
        'thermometer.',
        frozenset({'temperature', 'lagged'}), (Parameter('thermal_lag', 'rad/s/K'),),
        lambda channels, time_constant: (
            _at_each(channels, _temperature_lag(channels, time_constant)),),
        (Parameter('time_constant', 's', bounds=(1.0, 3000.0)),),
        _THERMAL_CYCLE, along='temperature_rate'),
    Effect(
        'thermal_hysteresis', 'The bias while heating differs from that while cooling.',
        frozenset({'temperature', 'heating'}), (Parameter('thermal_hysteresis', 'rad/s'),),
        lambda channels, filter_time, threshold: (
            _at_each(channels, 0.0 if channels.heating is None
                     else channels.heating(filter_time, threshold)),),
        (_FILTER_TIME, Parameter('threshold', 'K/s', 1e-3, (0.0, 10.0))),
        'repeat the same temperature cycle at two temperature rates', along='temperature_rate'))

_TIME_EFFECTS = (
    Effect(
        'warm_up', 'After power-on the bias settles exponentially.',
        frozenset({'time'}), (Parameter('warm_up', 'rad/s'),),
        lambda channels, time_constant: (
            _at_each(channels, np.exp(-channels.time / time_constant)),),
        (Parameter('time_constant', 's', bounds=(1.0, 1e5)),),
        'start the gyro both cold and warm, and let it rest'),
    Effect(
        'rate_ramp', 'The bias grows steadily with time.',
        frozenset({'time'}), (Parameter('rate_ramp', 'rad/s²'),),
        lambda channels: (_at_each(channels, channels.time),),
        experiment='record again, from a power-on at another temperature: only a ramp repeats'),
    Effect(
        'bias_step', 'The bias changes in a single step.',
        frozenset({'time'}), (Parameter('bias_step', 'rad/s'),),
        lambda channels, step_time: ((channels.time >= step_time) * channels.ones(),),
        (Parameter('step_time', 's', bounds=(0.0, 1e9)),), 'record again: a step does not repeat'))

_WAVES = Parameter('sine', 'rad/s'), Parameter('cosine', 'rad/s')
_ENVIRONMENT_EFFECTS = (
    Effect(
        'heading_sensitivity',
        'The bias depends on the heading, mostly by the magnetic field of the Earth.',
        frozenset({'heading'}), _WAVES,
        lambda channels: [_at_each(channels, wave(channels.heading))
                          for wave in (np.sin, np.cos)],
        experiment='turn at several speeds, and stop at eight headings', along='heading'),
    Effect(
        'acceleration_sensitivity',
        'The bias changes in proportion to the specific force along the input axis.',
        frozenset({'specific_force'}), (Parameter('acceleration_sensitivity', '(rad/s)/(m/s²)'),),
        lambda channels: (_at_each(channels, channels.specific_force),),
        experiment='rest in several poses within one power-on', along='specific_force'),
    Effect(
        'vibration_rectification', 'Vibration shifts the bias in proportion to its mean square.',
        frozenset({'specific_force', 'lagged'}),
        (Parameter('vibration_rectification', '(rad/s)/(m/s²)²'),),
        lambda channels, time_constant: (
            _at_each(channels, 0.0 if channels.lagged is None
                     else channels.lagged('vibration', time_constant)),),
        # the noise of a mean square over less would attenuate it
        (Parameter('time_constant', 's', 1.0, (1e-3, 1e4), (1.0, 3.0)),),
        'rest with the motor on and off', along='vibration'),
    Effect(
        'supply_sensitivity', 'The bias changes in proportion to the supply voltage.',
        frozenset({'supply'}), (Parameter('supply_sensitivity', 'rad/s/V'),),
        lambda channels, reference: (
            _at_each(channels, 0.0 if channels.supply is None else channels.supply - reference),),
        (Parameter('reference_supply', 'V', 5.0),), 'step the supply voltage at one temperature',
        along='supply'),
    Effect(
        'interference_tone',
        'The output contains a periodic signal, or an alias from above half the sample rate.',
        frozenset({'time'}), _WAVES,
        lambda channels, frequency: [
            _at_each(channels, wave(2.0 * math.pi * frequency * channels.time))
            for wave in (np.sin, np.cos)],
        (Parameter('frequency', 'Hz', bounds=(1e-4, 1e5)),),
        'sample at another rate: an alias changes its frequency, a tone does not',
        along='frequency'))


def _interpolate(new_time: Array, time: Array, signal: Array) -> Array:
    """Return a signal at other times; beyond its ends it is constant."""
    # Linear interpolation would look like a delay in fast motion.
    return np.asarray(CubicSpline(time, signal)(np.clip(new_time, time[0], time[-1])))


def _filter_lag(signal: Array, time: Array, time_constant: float) -> Array:
    """Return the signal through a lag, interpolated at 4 points a sample."""
    interval, coefficients = np.diff(time), CubicSpline(time, signal).c
    within = [signal[:-1], *(np.polyval(coefficients, share * interval)
                             for share in (0.25, 0.5, 0.75)), signal[1:]]
    # `lag_difference` over the quarters, of equal length, in one step of the recurrence
    x = np.maximum(0.25 * interval / time_constant, 1e-300)
    fallen = np.expm1(-x)
    added = np.polyval(np.diff(within, axis=0), fallen + 1.0) * (fallen / x)
    return signal + _solve_recurrence(np.append(1.0, (fallen + 1.0) ** 4), np.append(0.0, added),
                                      0.0)


_FAST_REVERSALS = ('swing fast with quick reversals: a lag reduces the amplitude of fast motion, '
                   'a delay does not')
_SIGNAL_EFFECTS = (
    Effect(
        'bandwidth', 'The output follows the rate through a first-order lag.',
        nonlinear_parameters=(Parameter('bandwidth', 's', bounds=(1e-7, 10.0)),),
        experiment=_FAST_REVERSALS, distortion=_filter_lag, stage='rate', along='rate_change',
        not_compensated='The attenuation of fast motion remains: to undo it would amplify the '
        'noise.'),
    Effect(
        'time_offset', 'The stamps of the samples are late by a constant time.',
        nonlinear_parameters=(Parameter('time_offset', 's',
                                        bounds=(-2.0, 2.0)),), experiment=_FAST_REVERSALS,
        distortion=lambda signal, time, offset: _interpolate(time - offset, time, signal),
        stage='rate', correct_stamps=lambda time, offset: time - offset, along='rate_change',
        not_compensated='It is compensated by shifting the stamps; the delay for a controller '
        'remains.'),
    Effect(
        'clock_rate', 'The clock of the gyro runs at a different rate than that of the reference.',
        nonlinear_parameters=(Parameter('clock_rate', '1', bounds=(-0.1, 0.1)),),
        experiment='record long, with sharp reversals at both ends',
        distortion=lambda signal, time, rate: _interpolate((1.0 + rate) * time, time, signal),
        stage='rate', correct_stamps=lambda time, rate: (1.0 + rate) * time,
        not_compensated='It is compensated by scaling the stamps of a log; a robot stamps by its '
        'own clock, without this effect.'),
    Effect('dead_zone', 'The output stays zero while the rate is small.', frozenset({'rate'}),
           (Parameter('amplitude', '1', default=1.0),), lambda channels, dead_zone: (
               (abs(channels.rate) < dead_zone) * -channels.rate,),
           (Parameter('dead_zone', 'rad/s', bounds=(1e-7, 1.0)), ), 'sweep slowly through zero',
           along='rate',
           not_compensated='An output of zero does not determine the rate within the zone.'),
    Effect('saturation', 'The output cannot go beyond a limit.',
           nonlinear_parameters=(Parameter('saturation', 'rad/s', bounds=(1e-3, 1e3)),),
           experiment='turn faster than the limit: the output stays at its extreme code',
           distortion=lambda signal, _time, limit: np.clip(signal, -limit, limit), stage='output',
           along='rate',
           not_compensated='An output at the limit does not determine the rate beyond it.'))
QUANTIZATION = Effect(
    'quantization', 'The output comes in steps.',
    nonlinear_parameters=(Parameter('quantization', 'rad/s', bounds=(1e-12, 1.0)),),
    experiment='turn slowly, and check the spacing of the output codes', along='output',
    distortion=lambda signal, _time, step: np.round(signal / step) * step, stage='output',
    not_compensated='The rounding error remains; with noise above half a step its mean is zero.')

#: Effects of rate and temperature alone, which dwells of a rate table can show.
STATIC_EFFECTS = {effect.name: effect for effect in (
    BIAS, SCALE_FACTOR_ERROR, SCALE_FACTOR_ASYMMETRY, QUADRATIC_NONLINEARITY, CUBIC_NONLINEARITY,
    SINE_RESPONSE, BIAS_TEMPERATURE, BIAS_TEMPERATURE_QUADRATIC, SCALE_FACTOR_TEMPERATURE)}
#: All effects except the polynomial.
CATALOGUE = STATIC_EFFECTS | {effect.name: effect for effect in (
    *_THERMAL_HISTORY_EFFECTS, *_TIME_EFFECTS, *_ENVIRONMENT_EFFECTS, *_SIGNAL_EFFECTS,
    QUANTIZATION)}
#: Effects of the user, which `add_effects` added to the catalogue.
USER_EFFECTS: dict[str, Effect] = {}


def add_effects(effects: Iterable[Effect]) -> None:
    """Add effects of the user to the catalogue; `ValueError` for one that does not fit."""
    rate = np.linspace(-1.0, 1.0, 5)
    channels = Channels(rate, rate, 25.0 + rate, 1.0 + rate, rate, 5.0 + rate, rate,
                        lambda channel, seconds: rate, lambda seconds, threshold: rate)
    for effect in effects:
        if not isinstance(effect, Effect):
            raise ValueError(f'{effect!r} is not an Effect')
        if effect.name in CATALOGUE and effect.name not in USER_EFFECTS:
            raise ValueError(f'the name {effect.name} is taken; give the effect another')
        if any(shape.default is None and not shape.begin_with
               for shape in effect.nonlinear_parameters):
            raise ValueError(f'{effect.name} has a nonlinear parameter without default; give it '
                             'begin_with')
        shapes = [shape.default if shape.default is not None else shape.begin_with[0]
                  for shape in effect.nonlinear_parameters]
        columns = effect.columns(channels, *shapes)
        if (len(columns) != len(effect.coefficients)
                or any(np.shape(column) != rate.shape for column in columns)):
            raise ValueError(f'{effect.name} has {len(effect.coefficients)} coefficients and '
                             f'{len(columns)} columns; give an array like channels.rate for each')
        USER_EFFECTS[effect.name] = CATALOGUE[effect.name] = effect
