# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Each effect's formula, and one test for all: simulate, compensate, and the rate is back."""

from dataclasses import replace
import itertools
import math

from gyro_calibration.logs.log import DEGREE
from gyro_calibration.model.channels import ChannelHistory
from gyro_calibration.model.compensation import compensate, rate_sensitivity
from gyro_calibration.model.effects import (
    CATALOGUE, Channels, polynomial_from_matrix, polynomial_to_matrix, rate_temperature_polynomial)
from gyro_calibration.model.gyro_model import GyroModel, Term
from gyro_calibration.model.motion import simulate_gyro_output
from gyro_calibration.model.noise import Noise
import numpy as np
import pytest

#: A matrix C of eq. 11 of Ojeda et al. of the size in their figures 5 and 6: errors of some tenths
#: of a deg/s at 100 deg/s.
C = np.array([[2e-10, -3e-9, 1e-6, -2e-5], [-1e-8, 2e-7, -4e-5, 2e-3], [3e-7, -4e-6, 4e-3, -0.05]])

POLYNOMIAL, POLYNOMIAL_VALUES = polynomial_from_matrix(C)
GYROS = {
    'bias': [('bias', (0.02,))],
    'scale_factor_error, -10 %': [('scale_factor_error', (-0.1,))],
    'scale_factor_error, +20 %': [('scale_factor_error', (0.2,))],
    'scale_factor_asymmetry': [('scale_factor_asymmetry', (0.01,))],
    'quadratic_nonlinearity': [('quadratic_nonlinearity', (0.02,))],
    'cubic_nonlinearity': [('cubic_nonlinearity', (-0.02,))],
    'bias_temperature': [('bias_temperature', (25.0, 1e-3))],
    'bias_temperature_quadratic': [('bias_temperature_quadratic', (25.0, 1e-4))],
    'scale_factor_temperature': [('scale_factor_temperature', (25.0, 2e-3))],
    'sine_response, -10 %': [('sine_response', (0.5, 1.0)), ('scale_factor_error', (-0.1,)),
                             ('bias', (0.01,))],
    'sine_response, +20 %': [('sine_response', (0.5, 1.0)), ('scale_factor_error', (0.2,)),
                             ('bias', (0.01,))],
    'bias_temperature_rate': [('bias_temperature_rate', (10.0, 0.05))],
    'thermal_lag': [('thermal_lag', (120.0, -2e-3))],
    'thermal_hysteresis': [('thermal_hysteresis', (10.0, 2e-3, 0.003))],
    'warm_up': [('warm_up', (40.0, 0.02))],
    'rate_ramp': [('rate_ramp', (2e-5,))],
    'bias_step': [('bias_step', (8.0, -0.004))],
    'heading_sensitivity': [('heading_sensitivity', (0.003, -0.002))],
    'acceleration_sensitivity': [('acceleration_sensitivity', (1e-3,))],
    'vibration_rectification': [('vibration_rectification', (1.0, 5e-3))],
    'supply_sensitivity': [('supply_sensitivity', (5.0, 4e-3))],
    'interference_tone': [('interference_tone', (0.7, 0.004, 0.003))],
    'rate_temperature_polynomial': [],
    'all': [('bias', (0.02,)), ('scale_factor_error', (0.0373,)), ('sine_response', (0.1, 1.0)),
            ('scale_factor_asymmetry', (0.003,)), ('bias_temperature', (30.0, 1e-3)),
            ('scale_factor_temperature', (30.0, 1e-3))],
}


def gyro(name):
    terms = tuple(Term(CATALOGUE[effect], values) for effect, values in GYROS[name])
    return GyroModel(terms + ((Term(POLYNOMIAL, POLYNOMIAL_VALUES),)
                              if name in ('rate_temperature_polynomial', 'all') else ()))


def around(time):
    """Return the surroundings of a gyro with varying temperature, force, rate and supply."""
    generator = np.random.default_rng(0)
    return {'temperature': 30.0 + 20.0 * np.abs(1.0 - time / 20.0),
            'specific_force': np.where(time > 10.0, 2.0, 0.3) * np.sin(40.0 * time),
            'supply': 5.0 + 0.3 * generator.standard_normal(len(time)), 'heading': 0.4 * time}


def test_every_effect_is_recovered_or_declared_lost():
    recovered = {name.partition(',')[0] for name in GYROS}
    assert (recovered | {effect.name for effect in CATALOGUE.values() if effect.not_compensated}
            >= set(CATALOGUE) | {'rate_temperature_polynomial'})


@pytest.mark.parametrize('name', GYROS)
def test_a_simulated_gyro_is_compensated_to_the_true_rate_as_a_log_and_sample_by_sample(name):
    model, time = gyro(name), np.linspace(0.0, 40.0, 401)
    rate = np.linspace(-2.0, 2.0, 401)  # the sine response goes up to k w = 1
    columns = {'time': time, **around(time)}
    surroundings = model.start_history().update(**columns)
    output = simulate_gyro_output(model, time, surroundings.with_rate(rate, rate))
    assert np.abs(output - rate).max() > 1e-4, 'this gyro has no error, so nothing is shown'
    at_once = compensate(model, output, surroundings.temperature, surroundings).rate
    assert np.abs(at_once - rate).max() < 1e-9
    history, singly = model.start_history(), []
    for each, *sample in zip(output.tolist(), *(values.tolist() for values in columns.values())):
        now = history.update(**dict(zip(columns, sample)))
        singly.append(compensate(model, each, now.temperature, now).rate)
    assert singly == pytest.approx(at_once, rel=0.0, abs=1e-13)


def distorted(name, *values, generator=None):
    """Return model, time, true rate and output of a gyro with one effect, at 1 kHz over 10 s."""
    model = GyroModel((Term(CATALOGUE[name], values),), noise=Noise(1e-4))
    time = np.arange(0.0, 10.0, 1e-3)
    rate = np.sin(1.7 * time)
    return model, time, rate, simulate_gyro_output(
        model, time, ChannelHistory().update(time).with_rate(rate, rate), generator)


@pytest.mark.parametrize('values', [{'time_offset': 0.02}, {'time_offset': -0.013},
                                    {'clock_rate': 0.01}, {'time_offset': 0.5, 'clock_rate': 0.05},
                                    {'clock_rate': 0.05, 'time_offset': 0.5}], ids=str)
def test_moving_the_stamps_undoes_a_delay_and_a_wrong_clock_in_the_order_of_the_model(values):
    model = GyroModel(tuple(Term(CATALOGUE[name], (value,)) for name, value in values.items()))
    time = np.arange(0.0, 10.0, 1e-3)
    output = model.distort('rate', np.sin(1.7 * time), time)
    assert np.abs(output - np.sin(1.7 * time)).max() > 0.01
    inside = (time > 1.0) & (time < 8.0)
    assert output[inside] == pytest.approx(np.sin(1.7 * model.true_time(time[inside])), abs=1e-6)


def test_the_output_of_a_band_limited_gyro_is_damped_and_late_as_a_lag_of_first_order():
    _, time, _, output = distorted('bandwidth', 0.05)
    gain = 1.0 / (1.0 + 1.7j * 0.05)
    assert output[time > 2.0] == pytest.approx(
        (gain * np.exp(1.7j * time)).imag[time > 2.0], abs=1e-5)


def test_in_the_dead_zone_nothing_comes_out():
    _, _, rate, output = distorted('dead_zone', 0.1, 1.0)
    assert output.tolist() == np.where(np.abs(rate) < 0.1, 0.0, rate).tolist()


def test_saturation_and_quantization_come_after_the_noise():
    for name, value in (('saturation', 0.8), ('quantization', 0.05)):
        output = distorted(name, value, generator=np.random.default_rng(0))[-1]
        codes = np.unique(np.round(output / value, 9))
        assert (codes.min() == -codes.max()
                and (name == 'quantization') == bool((codes == np.round(codes)).all())), name


def test_what_cannot_be_undone_is_passed_over():
    for name, effect in CATALOGUE.items():
        if effect.not_compensated:
            model, _, _, output = distorted(name, *(0.01 if each.default is None else each.default
                                                    for each in effect.parameters))
            assert model.rate(output, 25.0).tolist() == output.tolist(), name
            uncertain = replace(model, covariance=np.eye(1))
            assert not rate_sensitivity(uncertain, output, output, 25.0).any(), name


def test_an_effect_depends_on_no_other_channels_than_it_names():
    effects = [*CATALOGUE.values(), POLYNOMIAL, rate_temperature_polynomial(3, 0)]
    base = {'rate': 0.3, 'output': 0.4, 'temperature': 30.0, 'time': 0.2, 'specific_force': 1.0,
            'supply': 4.0, 'heading': 0.3, 'lagged': lambda channel, time_constant: 2.0,
            'heating': lambda filter_time, threshold: 1.0}
    other = dict.fromkeys(base, 1.7) | {'lagged': lambda channel, time_constant: 3.0,
                                        'heating': lambda filter_time, threshold: -1.0}
    for effect in effects:
        shapes = [shape.default if shape.default is not None else 0.5
                  for shape in effect.nonlinear_parameters]
        for channel in base:
            here, there = (
                np.array(effect.columns(Channels(**(base | {channel: of[channel]})), *shapes))
                for of in (base, other))
            assert (channel in effect.inputs) or np.array_equal(here, there), (
                effect.name, channel)


def eq_12(matrix, output, degc):
    """Return the error, deg/s, by eq. 12 of Ojeda et al. as printed, for deg/s and degC."""
    return np.array([degc ** 2, degc, 1.0]) @ matrix @ np.array(
        [output ** 3, output ** 2, output, 1.0])


def test_the_matrix_of_eq_11_gives_the_error_of_eq_12_and_one_subtraction_compensates():
    model = gyro('rate_temperature_polynomial')
    for output, degc in itertools.product((-100.0, -12.5, 0.0, 3.0, 100.0), (0.0, 25.0, 45.0)):
        error = model.error(Channels(rate=math.nan, output=output * DEGREE, temperature=degc))
        assert error / DEGREE == pytest.approx(eq_12(C, output, degc), abs=1e-12)
        # eq. 13
        assert compensate(model, output * DEGREE, degc).rate / DEGREE == pytest.approx(
            output - eq_12(C, output, degc), abs=1e-12)


def test_a_centred_and_scaled_polynomial_is_written_out_as_eq_11():
    effect = rate_temperature_polynomial(3, 2)
    values = (0.1, 1.7, 35.0, 10.0, *np.random.default_rng(0).normal(size=12) * 1e-3)
    matrix = polynomial_to_matrix(effect, values)
    for output, degc in [(-90.0, 26.0), (0.0, 35.0), (55.0, 44.0)]:
        error = Term(effect, values).error(Channels(math.nan, output * DEGREE, degc))
        assert eq_12(matrix, output, degc) == pytest.approx(error / DEGREE, abs=1e-9)
