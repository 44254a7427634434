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
The records of an effect, its parameters and its input channels; and a first-order lag.

An effect is a record and a model is a tuple of effects. Effects are combined in any way, since
each only adds columns. Effects on the signal (a delay, a lag, rounding) are no function of one
instant and add no column; they are simulated at their stage, and `not_compensated` states what
compensation leaves of them.

`sum_columns` computes the sum of the columns faster than the columns; a test compares both.

"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
import math

from gyro_calibration.logs.log import Array, Number
import numpy as np


@dataclass(frozen=True)
class Channels:
    """
    Inputs of effects, at one instant (numbers) or at many (arrays of shape (n,)).

    The channels ``lagged`` and ``heating`` depend on earlier samples; `model.channels` makes them.
    Without them the past is taken to be constant.

    Attributes
    ----------
    rate : true rate, rad/s
    output : output of the gyro, rad/s
    temperature : degC
    time : since power-on, s
    specific_force : along the input axis, m/s²
    supply : V; None where it is not known
    heading : rad
    lagged : (channel, time constant) -> the channel through a first-order lag; channels are
        'temperature', 'specific_force', and 'vibration', the squared deviation of the specific
        force from its own mean over 1 s
    heating : (filter time, s, threshold, K/s) -> 1 after the temperature rose, -1 after it fell,
        0 before either

    """

    rate: Number
    output: Number
    temperature: Number
    time: Number = 0.0
    specific_force: Number = 0.0
    supply: Number | None = None
    heading: Number = 0.0
    lagged: Callable[[str, float], Number] | None = None
    heating: Callable[[float, float], Number] | None = None

    def with_rate(self, rate: Number, output: Number) -> Channels:
        """Return the same surroundings with another rate and output."""
        # The constructor would take three times as long.
        other = object.__new__(Channels)
        other.__dict__.update(self.__dict__, rate=rate, output=output)
        return other

    @staticmethod
    def instantaneous(rate: Number, output: Number, temperature: Number) -> Channels:
        """Return channels without history, in a third of the time of the constructor."""
        other = object.__new__(Channels)
        other.__dict__.update(rate=rate, output=output, temperature=temperature)
        return other

    def ones(self) -> Number:
        """Return 1 in the shape of the rates."""
        return np.ones_like(self.rate) if isinstance(self.rate, np.ndarray) else 1.0


@dataclass(frozen=True)
class Parameter:
    """
    A coefficient or a nonlinear parameter: name, unit, default value and bounds.

    A parameter with a default is a convention, such as a reference temperature; one without is a
    property of the gyro, and is fitted. `begin_with` holds the initial values of a nonlinear
    parameter in the search of a diagnosis.

    """

    name: str
    unit: str
    default: float | None = None
    bounds: tuple[float, float] = (-np.inf, np.inf)
    begin_with: tuple[float, ...] = ()


@dataclass(frozen=True)
class Effect:
    """
    One effect.

    Attributes
    ----------
    name : as in the catalogue and in files
    cause : one sentence for users
    inputs : the channels that it uses
    coefficients : factors of the columns
    columns : (channels, *shapes) -> one column per coefficient
    nonlinear_parameters : nonlinear parameters, on which the columns depend
    experiment : experiment that separates it from similar effects
    sum_columns : (channels, shapes, coefficients) -> the sum of the columns times the
        coefficients, where a faster formula exists
    distortion : (signal, time, *values) -> signal, of a whole log, for an effect that adds nothing
        but changes the signal itself
    stage : of the distortion: 'rate' before anything is added to the rate, or 'output' after the
        noise
    correct_stamps : (time, *values) -> time, of an effect that is compensated by shifting the
        stamps
    not_compensated : the part of the effect that compensation leaves, as a sentence; '' for none
    along : channel of the abscissa of its plot in a diagnosis

    """

    name: str
    cause: str
    inputs: frozenset[str] = frozenset()
    coefficients: tuple[Parameter, ...] = ()
    columns: Callable[..., Sequence[Number]] = lambda _channels, *_shapes: ()
    nonlinear_parameters: tuple[Parameter, ...] = ()
    experiment: str = ''
    sum_columns: Callable[[Channels, Sequence[float], Sequence[float]], Number] | None = None
    distortion: Callable[..., Array] | None = None
    stage: str = ''
    correct_stamps: Callable[..., Number] | None = None
    not_compensated: str = ''
    along: str = 'time'

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

    A lag obeys ``time_constant * d(lagged)/dt = signal - lagged``, solved exactly for a signal
    that is linear between its samples. The difference decays by exp(-x) over an interval of x time
    constants, and a change d of the signal reduces it by ``d (1 - exp(-x)) / x``.

    Parameters
    ----------
    interval : since the previous sample, s, not negative
    change : of the signal since the previous sample
    time_constant : s, above 0
    initial_difference : the difference at the sample before the first one

    """
    if not isinstance(interval, np.ndarray):
        x = interval / time_constant
        return math.exp(-x) * initial_difference + change * (math.expm1(-x) / x if x else -1.0)
    # an interval of 0 must not give 0 / 0
    x = np.maximum(interval / time_constant, 1e-300)
    fallen = np.expm1(-x)
    return _solve_recurrence(fallen + 1.0, change * (fallen / x), initial_difference)


def lagged_signal(signal: Array, time: Array, time_constant: float) -> Array:
    """Return a signal, shape (n,), through a lag that starts at its first value."""
    interval, change = np.diff(time, prepend=time[:1]), np.diff(signal, prepend=signal[:1])
    return signal + lag_difference(interval, change, time_constant)


def _solve_recurrence(factors: Array, added: Array, initial: float) -> Array:
    """
    Return y of ``y[k] = factors[k] * y[k - 1] + added[k]``, shape (n,).

    Rows of sqrt(n) samples are computed in parallel, each from zero; then the final value of the
    row before is propagated through each row.

    """
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
