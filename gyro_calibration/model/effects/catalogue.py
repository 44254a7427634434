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
All effects except the polynomial, each a record with its formula.

In this order: effects of rate and temperature alone, which dwells of a rate table show; of past
temperatures; of the time since power-on; of the surroundings; and effects that change the signal
itself. A new effect is one more record here.

"""

from __future__ import annotations

from collections.abc import Iterable
import math

from gyro_calibration.logs.log import Array, Number
from gyro_calibration.model.effects.effect import Channels, Effect, lagged_signal, Parameter
import numpy as np
from scipy.interpolate import CubicSpline

BIAS = Effect(
    'bias', 'The output at rest is not zero; it includes the Earth rate about the input axis.',
    frozenset(), (Parameter('bias', 'rad/s'),),
    lambda channels: (channels.ones(),), experiment='record at rest')
SCALE_FACTOR_ERROR = Effect(
    'scale_factor_error', 'The scale factor differs from the nominal one.',
    frozenset({'rate'}), (Parameter('scale_factor_error', '1'),),
    lambda channels: (channels.rate,), experiment='turn at several speeds, both ways')
SCALE_FACTOR_ASYMMETRY = Effect(
    'scale_factor_asymmetry', 'The scale factor differs between the two senses of rotation.',
    frozenset({'rate'}), (Parameter('scale_factor_asymmetry', '1'),),
    lambda channels: (abs(channels.rate),),
    experiment='turn both ways at many speeds, slow ones and rest too')
QUADRATIC_NONLINEARITY = Effect(
    'quadratic_nonlinearity', 'The output has a part in proportion to the square of the rate.',
    frozenset({'rate'}), (Parameter('quadratic_nonlinearity', 's/rad'),),
    lambda channels: (channels.rate * channels.rate,),
    experiment='turn both ways at many speeds up to full scale')
CUBIC_NONLINEARITY = Effect(
    'cubic_nonlinearity', 'The scale factor changes with the square of the rate.',
    frozenset({'rate'}), (Parameter('cubic_nonlinearity', 's²/rad²'),),
    lambda channels: (channels.rate * channels.rate * channels.rate,),
    experiment='turn at many speeds up to full scale')
SINE_RESPONSE = Effect(
    'sine_response', 'An open-loop fibre-optic gyro responds with the sine of its Sagnac phase.',
    frozenset({'rate'}), (Parameter('amplitude', '1', default=1.0),),
    lambda channels, k: (np.sin(k * channels.rate) / k - channels.rate,),
    (Parameter('k', 's', bounds=(1e-3, 30.0)),), 'turn at many speeds up to full scale')

#: Temperature at which the effects of temperature are zero, degC.
_REFERENCE_TEMPERATURE = Parameter('reference_temperature', 'degC', 25.0)
BIAS_TEMPERATURE = Effect(
    'bias_temperature', 'The bias changes in proportion to the temperature.',
    frozenset({'temperature'}), (Parameter('bias_temperature', 'rad/s/K'),),
    lambda channels, reference: (channels.temperature - reference + 0.0 * channels.rate,),
    (_REFERENCE_TEMPERATURE,), 'rest at two temperatures, and better go up and down again')
BIAS_TEMPERATURE_QUADRATIC = Effect(
    'bias_temperature_quadratic', 'The bias changes with the square of the temperature.',
    frozenset({'temperature'}), (Parameter('bias_temperature_quadratic', 'rad/s/K²'),),
    lambda channels, reference: ((channels.temperature - reference) ** 2 + 0.0 * channels.rate,),
    (_REFERENCE_TEMPERATURE,), 'rest at three temperatures or more')
SCALE_FACTOR_TEMPERATURE = Effect(
    'scale_factor_temperature', 'The scale factor changes in proportion to the temperature.',
    frozenset({'rate', 'temperature'}), (Parameter('scale_factor_temperature', '1/K'),),
    lambda channels, reference: ((channels.temperature - reference) * channels.rate,),
    (_REFERENCE_TEMPERATURE,), 'turn at two temperatures')


def _temperature_lag(channels: Channels, time_constant: float) -> Number:
    """Return the lagged temperature minus the temperature, K."""
    if channels.lagged is None:
        return 0.0
    return channels.lagged('temperature', time_constant) - channels.temperature


_THERMAL_HISTORY_EFFECTS = (
    Effect(
        'bias_temperature_rate',
        'The bias changes in proportion to the rate of change of the temperature, by gradients '
        'within the instrument (in fibre gyros the Shupe effect).',
        frozenset({'temperature', 'lagged'}), (Parameter('bias_temperature_rate', 'rad/s/(K/s)'),),
        lambda channels, filter_time: (
            -_temperature_lag(channels, filter_time) / filter_time + 0.0 * channels.rate,),
        (Parameter('filter_time', 's', 10.0, (1e-3, 1e4)),),
        'heat and cool at two speeds, with corners in the temperature'),
    Effect(
        'thermal_lag',
        'The bias follows the temperature of the sensing element, which lags behind that of the '
        'thermometer.',
        frozenset({'temperature', 'lagged'}), (Parameter('thermal_lag', 'rad/s/K'),),
        lambda channels, time_constant: (
            _temperature_lag(channels, time_constant) + 0.0 * channels.rate,),
        (Parameter('time_constant', 's', bounds=(1.0, 3000.0)),),
        'heat and cool at two speeds, with corners in the temperature'),
    Effect(
        'thermal_hysteresis', 'The bias while heating differs from that while cooling.',
        frozenset({'temperature', 'heating'}), (Parameter('thermal_hysteresis', 'rad/s'),),
        lambda channels, filter_time, threshold: (
            (0.0 if channels.heating is None else channels.heating(filter_time, threshold))
            + 0.0 * channels.rate,),
        (Parameter('filter_time', 's', 10.0, (1e-3, 1e4)),
         Parameter('threshold', 'K/s', 1e-3, (0.0, 10.0))),
        'go through the same cycle of temperature at two speeds'))

_TIME_EFFECTS = (
    Effect(
        'warm_up', 'After power-on the bias settles exponentially.',
        frozenset({'time'}), (Parameter('warm_up', 'rad/s'),),
        lambda channels, time_constant: (
            np.exp(-channels.time / time_constant) + 0.0 * channels.rate,),
        (Parameter('time_constant', 's', bounds=(1.0, 1e5)),),
        'compare a cold start with a warm start'),
    Effect(
        'rate_ramp', 'The bias grows steadily with time.',
        frozenset({'time'}), (Parameter('rate_ramp', 'rad/s²'),),
        lambda channels: (channels.time + 0.0 * channels.rate,),
        experiment='let it run several times, heating in one and cooling in another'),
    Effect(
        'bias_step', 'The bias changes in a single step.',
        frozenset({'time'}), (Parameter('bias_step', 'rad/s'),),
        lambda channels, step_time: ((channels.time >= step_time) * channels.ones(),),
        (Parameter('step_time', 's', bounds=(0.0, 1e9)),), 'repeat the run: the step occurs once'))

_ENVIRONMENT_EFFECTS = (
    Effect(
        'heading_sensitivity',
        'The bias depends on the heading, mostly by the magnetic field of the Earth.',
        frozenset({'heading'}), (Parameter('sine', 'rad/s'), Parameter('cosine', 'rad/s')),
        lambda channels: [wave(channels.heading) + 0.0 * channels.rate
                          for wave in (np.sin, np.cos)],
        experiment='turn at several speeds, and rest at eight headings'),
    Effect(
        'acceleration_sensitivity',
        'The bias changes in proportion to the specific force along the input axis.',
        frozenset({'specific_force'}), (Parameter('acceleration_sensitivity', '(rad/s)/(m/s²)'),),
        lambda channels: (channels.specific_force + 0.0 * channels.rate,),
        experiment='rest in several poses within one power-on'),
    Effect(
        'vibration_rectification', 'Vibration shifts the bias in proportion to its mean square.',
        frozenset({'specific_force', 'lagged'}),
        (Parameter('vibration_rectification', '(rad/s)/(m/s²)²'),),
        lambda channels, time_constant: (
            (0.0 if channels.lagged is None else channels.lagged('vibration', time_constant))
            + 0.0 * channels.rate,),
        (Parameter('time_constant', 's', 1.0, (1e-3, 1e4)),),
        'run the motor and stop it, at rest'),
    Effect(
        'supply_sensitivity', 'The bias changes in proportion to the supply voltage.',
        frozenset({'supply'}), (Parameter('supply_sensitivity', 'rad/s/V'),),
        lambda channels, reference: (
            (0.0 if channels.supply is None else channels.supply - reference)
            + 0.0 * channels.rate,),
        (Parameter('reference_supply', 'V', 5.0),), 'step the supply at one temperature'),
    Effect(
        'interference_tone',
        'The output contains a periodic signal, or an alias from above half the sample rate.',
        frozenset({'time'}), (Parameter('sine', 'rad/s'), Parameter('cosine', 'rad/s')),
        lambda channels, frequency: [
            wave(2.0 * math.pi * frequency * channels.time) + 0.0 * channels.rate
            for wave in (np.sin, np.cos)],
        (Parameter('frequency', 'Hz', bounds=(1e-4, 1e5)),),
        'sample at another rate: an alias changes its frequency, a tone does not'))


def _interpolate(new_time: Array, time: Array, signal: Array) -> Array:
    """Return a signal at other times; beyond its ends it is constant."""
    # Linear interpolation would look like a delay in fast motion.
    return np.asarray(CubicSpline(time, signal)(np.clip(new_time, time[0], time[-1])))


def _filter_lag(signal: Array, time: Array, time_constant: float) -> Array:
    """Return the signal through a lag, interpolated at 4 points a sample."""
    count = len(time)
    finer = np.interp(np.arange(4 * (count - 1) + 1) / 4, np.arange(count), time)
    return lagged_signal(_interpolate(finer, time, signal), finer, time_constant)[::4]


_FAST_REVERSALS = 'reverse quickly: a lag reduces the amplitude, a delay does not'
_SIGNAL_EFFECTS = (
    Effect(
        'bandwidth', 'The output follows the rate through a first-order lag.',
        nonlinear_parameters=(Parameter('bandwidth', 's', bounds=(1e-7, 10.0)),),
        experiment=_FAST_REVERSALS, distortion=_filter_lag, stage='rate',
        not_compensated='The attenuation of fast motion remains: to undo it would amplify the '
        'noise.'),
    Effect(
        'time_offset', 'The stamps of the samples are late by a constant time.',
        nonlinear_parameters=(Parameter('time_offset', 's',
                                        bounds=(-1.0, 1.0)),), experiment=_FAST_REVERSALS,
        distortion=lambda signal, time, offset: _interpolate(time - offset, time, signal),
        stage='rate', correct_stamps=lambda time, offset: time - offset,
        not_compensated='It is compensated by shifting the stamps; the delay for a controller '
        'remains.'),
    Effect(
        'clock_rate', 'The clock of the gyro runs at a different rate than that of the reference.',
        nonlinear_parameters=(Parameter('clock_rate', '1', bounds=(-0.1, 0.1)),),
        experiment='record a long log with quick motion at both ends',
        distortion=lambda signal, time, rate: _interpolate((1.0 + rate) * time, time, signal),
        stage='rate', correct_stamps=lambda time, rate: (1.0 + rate) * time,
        not_compensated='It is compensated by scaling the stamps of a log; a robot stamps by its '
        'own '
        'clock, without this effect.'),
    Effect('dead_zone', 'The output stays zero while the rate is small.', frozenset({'rate'}),
           (Parameter('amplitude', '1', default=1.0),), lambda channels, dead_zone: (
               (abs(channels.rate) < dead_zone) * -channels.rate,),
           (Parameter('dead_zone', 'rad/s', bounds=(1e-7, 1.0)), ), 'sweep slowly through zero',
           not_compensated='An output of zero does not determine the rate within the zone.'))
SATURATION = Effect(
    'saturation', 'The output cannot go beyond a limit.',
    nonlinear_parameters=(Parameter('saturation', 'rad/s', bounds=(1e-3, 1e3)),),
    experiment='turn faster than the limit',
    distortion=lambda signal, _time, limit: np.clip(signal, -limit, limit), stage='output',
    not_compensated='An output at the limit does not determine the rate beyond it.')
QUANTIZATION = Effect(
    'quantization', 'The output comes in steps.',
    nonlinear_parameters=(Parameter('quantization', 'rad/s', bounds=(1e-12, 1.0)),),
    experiment='list the distinct values of the output',
    distortion=lambda signal, _time, step: np.round(signal / step) * step, stage='output',
    not_compensated='The rounding error remains; with noise above half a step its mean is zero.')

#: Effects of rate and temperature alone, which dwells of a rate table can show.
STATIC_EFFECTS = {effect.name: effect for effect in (
    BIAS, SCALE_FACTOR_ERROR, SCALE_FACTOR_ASYMMETRY, QUADRATIC_NONLINEARITY, CUBIC_NONLINEARITY,
    SINE_RESPONSE, BIAS_TEMPERATURE, BIAS_TEMPERATURE_QUADRATIC, SCALE_FACTOR_TEMPERATURE)}
#: All effects except the polynomial.
CATALOGUE = STATIC_EFFECTS | {effect.name: effect for effect in (
    *_THERMAL_HISTORY_EFFECTS, *_TIME_EFFECTS, *_ENVIRONMENT_EFFECTS, *_SIGNAL_EFFECTS, SATURATION,
    QUANTIZATION)}
#: Effects of the user, which `add_effects` added to the catalogue.
USER_EFFECTS: dict[str, Effect] = {}


def add_effects(effects: Iterable[Effect]) -> None:
    """
    Add effects of the user to the catalogue, for models and for the diagnosis of logs.

    Raises
    ------
    ValueError : an item is no `Effect`, its name is taken, a nonlinear parameter that is to be
        fitted has no initial values, or the columns do not match the coefficients

    """
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
            raise ValueError(f'{effect.name} has a shape without a default and without begin_with')
        shapes = [shape.default if shape.default is not None else shape.begin_with[0]
                  for shape in effect.nonlinear_parameters]
        columns = effect.columns(channels, *shapes)
        if (len(columns) != len(effect.coefficients)
                or any(np.shape(column) != rate.shape for column in columns)):
            raise ValueError(f'{effect.name} has {len(effect.coefficients)} coefficients and '
                             f'{len(columns)} columns; give an array like channels.rate for each')
        USER_EFFECTS[effect.name] = CATALOGUE[effect.name] = effect
