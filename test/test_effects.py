"""
Every effect's formula, and the one recovery test that all of them pass: simulate, compensate, and the rate is back.

"""

import math

import numpy as np
import pytest

from gyro_calibration.compensation import compensate
from gyro_calibration.effects import (
    CATALOGUE,
    Channels,
    polynomial_from_matrix,
    polynomial_to_matrix,
    rate_temperature_polynomial,
)
from gyro_calibration.log import DEGREE
from gyro_calibration.model import GyroModel, Term
from gyro_calibration.model_file import read_model, write_model
from gyro_calibration.motion import CALIBRATION
from gyro_calibration.simulation import simulate

#: A matrix C of eq. 11 of Ojeda et al. of the size that their figures 5 and 6 show: errors of a few tenths of a deg/s at 100 deg/s.
C = np.array([[2e-10, -3e-9, 1e-6, -2e-5], [-1e-8, 2e-7, -4e-5, 2e-3], [3e-7, -4e-6, 4e-3, -0.05]])

POLYNOMIAL, POLYNOMIAL_VALUES = polynomial_from_matrix(C)
GYROS = {
    'bias': [('bias', (0.02,))],
    'bias, large': [('bias', (-3.0,))],
    'scale_factor_error, -10 %': [('scale_factor_error', (-0.1,))],
    'scale_factor_error, +20 %': [('scale_factor_error', (0.2,))],
    'scale_factor_asymmetry': [('scale_factor_asymmetry', (0.01,))],
    'quadratic_nonlinearity': [('quadratic_nonlinearity', (0.02,))],
    'cubic_nonlinearity': [('cubic_nonlinearity', (-0.02,))],
    'bias_temperature': [('bias_temperature', (25.0, 1e-3))],
    'bias_temperature_quadratic': [('bias_temperature_quadratic', (25.0, 1e-4))],
    'scale_factor_temperature': [('scale_factor_temperature', (25.0, 2e-3))],
    'sine_response': [('sine_response', (0.5, 1.0))],
    'sine_response, -10 %': [('sine_response', (0.5, 1.0)), ('scale_factor_error', (-0.1,)), ('bias', (0.01,))],
    'sine_response, +20 %': [('sine_response', (0.5, 1.0)), ('scale_factor_error', (0.2,)), ('bias', (0.01,))],
    'rate_temperature_polynomial': [],
    'all': [('bias', (0.02,)), ('scale_factor_error', (0.0373,)), ('sine_response', (0.1, 1.0)),
            ('scale_factor_asymmetry', (0.003,)), ('bias_temperature', (30.0, 1e-3)), ('scale_factor_temperature', (30.0, 1e-3))],
}


def gyro(name):
    """Return the model of that name."""
    terms = tuple(Term(CATALOGUE[effect], values) for effect, values in GYROS[name])
    return GyroModel(terms + ((Term(POLYNOMIAL, POLYNOMIAL_VALUES),) if name in ('rate_temperature_polynomial', 'all') else ()))


def test_every_effect_is_recovered_below():
    assert set(CATALOGUE) | {'rate_temperature_polynomial'} <= {name.partition(',')[0] for name in GYROS}


@pytest.mark.parametrize('name', GYROS)
def test_a_simulated_gyro_is_compensated_to_the_true_rate(name):
    model = gyro(name)
    rate = np.linspace(-2.0, 2.0, 401)  # the sine response goes up to k w = 1
    degc = np.linspace(10.0, 50.0, 401)
    output = model.output(rate, degc)
    assert np.abs(output - rate).max() > 1e-4, 'this gyro has no error, so nothing is shown'
    assert np.abs(compensate(model, output, degc).rate - rate).max() < 1e-9


@pytest.mark.parametrize('name', GYROS)
def test_a_log_in_one_call_and_sample_by_sample_gives_the_same_numbers(name):
    model = gyro(name)
    log = simulate(model, CALIBRATION, 20.0, temperature=31.5)
    at_once = compensate(model, log.output, log.temperature)
    singly = [compensate(model, float(output), float(degc)) for output, degc in zip(log.output, log.temperature)]
    assert [sample.rate for sample in singly] == at_once.rate.tolist()
    assert np.abs(at_once.rate - log.reference_rate).max() < 1e-9


@pytest.mark.parametrize('name', CATALOGUE)
def test_columns_have_the_shape_of_the_rates(name):
    effect = CATALOGUE[name]
    rate = np.linspace(-1.0, 1.0, 5)
    shapes = [0.5] * len(effect.shapes)
    columns = effect.columns(Channels(rate, rate, 25.0), *shapes)
    assert [np.shape(column) for column in columns] == [(5,)] * len(effect.coefficients)
    for index, w in enumerate(rate):
        assert [column[index] for column in columns] == list(effect.columns(Channels(float(w), float(w), 25.0), *shapes))


def test_the_sine_response_is_the_sine_of_the_sagnac_phase():
    model = GyroModel((Term(CATALOGUE['sine_response'], (0.5, 1.0)),))
    assert model.output(1.2, 25.0) == pytest.approx(math.sin(0.5 * 1.2) / 0.5, abs=1e-15)


def test_looking_at_channels_is_honest():
    effects = [*CATALOGUE.values(), POLYNOMIAL, rate_temperature_polynomial(3, 0)]
    base = {'rate': 0.3, 'output': 0.4, 'temperature': 30.0}
    for effect in effects:
        shapes = [shape.default if shape.default is not None else 0.5 for shape in effect.shapes]
        for channel in base:
            here, there = (np.array(effect.columns(Channels(**(base | {channel: value})), *shapes)) for value in (base[channel], 1.7))
            assert (channel in effect.looks_at) or np.array_equal(here, there), (effect.name, channel)


def eq_12(matrix, output, degc):
    """Return the error, deg/s, by eq. 12 of Ojeda et al. as printed, for deg/s and degC."""
    return np.array([degc ** 2, degc, 1.0]) @ matrix @ np.array([output ** 3, output ** 2, output, 1.0])


@pytest.mark.parametrize('output', [-100.0, -12.5, 0.0, 3.0, 100.0])
@pytest.mark.parametrize('degc', [0.0, 25.0, 45.0])
def test_the_matrix_of_eq_11_gives_the_error_of_eq_12_and_one_subtraction_compensates(output, degc):
    model = gyro('rate_temperature_polynomial')
    error = model.error(Channels(rate=math.nan, output=output * DEGREE, temperature=degc))
    assert error / DEGREE == pytest.approx(eq_12(C, output, degc), abs=1e-12)
    assert compensate(model, output * DEGREE, degc).rate / DEGREE == pytest.approx(output - eq_12(C, output, degc), abs=1e-12)  # eq. 13


@pytest.mark.parametrize('matrix', [C, C[:, 2:], C[2:], [[0.5]], [[1e-4, 0.5]]], ids=['3x4', '3x2', '1x4', '1x1', '1x2'])
def test_the_matrix_of_eq_11_comes_out_as_it_went_in(matrix):
    assert polynomial_to_matrix(*polynomial_from_matrix(matrix)) == pytest.approx(np.array(matrix), rel=1e-12, abs=0)


def test_a_centred_and_scaled_polynomial_is_written_out_as_eq_11():
    effect = rate_temperature_polynomial(3, 2)
    values = (0.1, 1.7, 35.0, 10.0, *np.random.default_rng(0).normal(size=12) * 1e-3)
    matrix = polynomial_to_matrix(effect, values)
    for output, degc in [(-90.0, 26.0), (0.0, 35.0), (55.0, 44.0)]:
        error = Term(effect, values).error(Channels(math.nan, output * DEGREE, degc))
        assert eq_12(matrix, output, degc) == pytest.approx(error / DEGREE, abs=1e-9)


def test_every_product_of_powers_has_a_column_of_its_own():
    """The index of eq. 10 as printed, i + (j - 1) p, collides: the four columns of one power of temperature overlap the next one's."""
    printed = {i + (j - 1) * 3 for i in range(1, 5) for j in range(1, 4)}
    assert len(printed) == 10, 'of 12'
    generator = np.random.default_rng(0)
    channels = Channels(math.nan, generator.uniform(-1, 1, 50), generator.uniform(-1, 1, 50))
    columns = rate_temperature_polynomial(3, 2).columns(channels, 0.0, 1.0, 0.0, 1.0)
    assert np.linalg.matrix_rank(np.array(columns)) == 12


@pytest.mark.parametrize('matrix', [
    [], [[]], 'abc', None, [[1, 2], [3]], [[math.nan]], [[math.inf, 1]], [1, 2], [[[1]]], [['a']], [[10 ** 400]], [[1e308, 0, 0, 0]], {}])
def test_what_is_no_matrix_of_eq_11_is_refused(matrix):
    with pytest.raises(ValueError, match='rows of finite numbers'):
        polynomial_from_matrix(matrix)


def test_a_polynomial_survives_its_file(tmp_path):
    model = gyro('all')
    write_model(tmp_path / 'model.yaml', model)
    again = read_model(tmp_path / 'model.yaml')
    assert again.terms[-1].values == POLYNOMIAL_VALUES
    assert again.rate(1.0, 33.0) == model.rate(1.0, 33.0)
