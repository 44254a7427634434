"""
Compensation: the model, then its self-calibration; what lies outside the calibrated range; and what the rate owes to each value.

"""

from dataclasses import replace

import numpy as np
import pytest

from gyro_calibration.compensation import compensate, covariance, quadratic_form, rate_sensitivity
from gyro_calibration.effects import BIAS, SCALE_FACTOR_ERROR, Channels, polynomial_from_matrix, rate_temperature_polynomial
from gyro_calibration.log import CACHED
from gyro_calibration.model import GyroModel, SelfCalibration, Term

WARM = Term(*polynomial_from_matrix([[0.1], [0.0]]))  # the bias is 0.1 deg/s a degC
CALIBRATION = SelfCalibration(0.04, 0.002, ((1e-6, 1e-8), (1e-8, 1e-6)))
MODEL = GyroModel((Term(BIAS, (0.01,)), Term(SCALE_FACTOR_ERROR, (0.001,))), np.diag([1e-6, 4e-6]), (-2.0, 2.0), (10.0, 40.0))


def test_no_model_changes_nothing():
    assert compensate(GyroModel(), 0.123).rate == 0.123


def test_the_self_calibration_comes_after_the_model():
    """Eq. 13 of Ojeda et al., then eq. 3 of Hong and Park."""
    done = compensate(replace(MODEL, self_calibration=CALIBRATION), 0.5)
    assert done.modelled == pytest.approx((0.5 - 0.01) / 1.001, abs=1e-12)
    assert done.rate == pytest.approx((done.modelled - 0.002) / 1.04, abs=1e-12)


def test_beyond_the_calibrated_temperatures_their_nearest_end_is_used():
    model = GyroModel((WARM,), temperature_range=(10.0, 40.0))
    degc = np.array([-20.0, 10.0, 25.0, 40.0, 90.0])
    done = compensate(model, np.zeros(5), degc)
    assert done.rate.tolist() == compensate(model, np.zeros(5), np.clip(degc, 10.0, 40.0)).rate.tolist()
    assert done.temperature_clipped.tolist() == [True, False, False, False, True]
    assert [bool(compensate(model, 0.0, float(one)).temperature_clipped) for one in degc] == done.temperature_clipped.tolist()


def test_without_a_temperature_the_reference_temperature_is_taken():
    model = GyroModel((WARM,), reference_temperature=31.0)
    assert compensate(model, 0.2).rate == compensate(model, 0.2, 31.0).rate != compensate(model, 0.2, 30.0).rate


def test_outputs_beyond_the_calibrated_rates_are_marked():
    assert compensate(MODEL, np.array([-2.1, -2.0, 0.0, 2.0, 2.1])).beyond_range.tolist() == [True, False, False, False, True]
    assert not compensate(GyroModel(), 1e6).beyond_range


@pytest.mark.parametrize('calibration', [None, CALIBRATION], ids=['model alone', 'self-calibrated'])
@pytest.mark.parametrize('given', [None, 31.0, 'all', 'clipped'])
def test_a_log_longer_than_the_cache_is_compensated_as_its_pieces(calibration, given):
    model = GyroModel((WARM, *MODEL.terms), None, (-0.5, 0.5), (10.0, 40.0), self_calibration=calibration)
    count, generator = 2 * CACHED + 77, np.random.default_rng(0)
    output = generator.normal(size=count)
    temperature = {'all': generator.uniform(20.0, 30.0, count), 'clipped': generator.uniform(0.0, 50.0, count)}.get(given, given)
    whole = compensate(model, output, temperature)
    cuts = [0, 1, 500, CACHED + 3, count]
    for first, end in zip(cuts, cuts[1:]):
        here = temperature[first:end] if isinstance(temperature, np.ndarray) else temperature
        piece = compensate(model, output[first:end], here)
        for name in ('modelled', 'rate', 'temperature', 'temperature_clipped', 'beyond_range'):
            of_whole = np.broadcast_to(getattr(whole, name), count)[first:end]
            assert np.array_equal(of_whole, np.broadcast_to(getattr(piece, name), end - first)), name


@pytest.mark.parametrize('orders', [(0, 0), (0, 2), (1, 0), (1, 1), (3, 2), (5, 3)])
def test_the_shorter_way_to_a_polynomial_is_the_sum_of_its_columns(orders):
    effect, generator = rate_temperature_polynomial(*orders), np.random.default_rng(0)
    shapes, coefficients = (0.1, 1.7, 35.0, 10.0), generator.normal(size=len(effect.coefficients))
    channels = Channels(np.zeros(50), generator.uniform(-2.0, 2.0, 50), generator.uniform(10.0, 50.0, 50))
    error = effect.error(channels, (*shapes, *coefficients.tolist()))
    assert error == pytest.approx(coefficients @ np.array(effect.columns(channels, *shapes)), rel=1e-12, abs=1e-13)


@pytest.mark.parametrize('calibration', [None, CALIBRATION], ids=['model alone', 'self-calibrated'])
def test_the_sensitivity_is_the_derivative_of_the_rate(calibration):
    """To first order: within the size of the scale factor errors and, as the columns are taken at the last rate, of the last bias."""
    model, step = replace(MODEL, self_calibration=calibration), 1e-6
    output = np.array([-1.0, 0.0, 0.7])
    base = compensate(model, output).rate

    def changed(bias, scale, s, b):
        moved = None if calibration is None else replace(calibration, scale_factor_error=calibration.scale_factor_error + s, bias=0.002 + b)
        terms = (Term(BIAS, (0.01 + bias,)), Term(SCALE_FACTOR_ERROR, (0.001 + scale,)))
        return (compensate(replace(model, terms=terms, self_calibration=moved), output).rate - base) / step
    differences = np.array([changed(*row) for row in step * np.eye(4)[:2 if calibration is None else 4]])
    assert rate_sensitivity(model, output, base, np.full(3, 25.0)) == pytest.approx(differences, rel=0.05, abs=0.002)


def test_the_sensitivity_of_one_sample_is_that_of_the_log():
    model, rates = replace(MODEL, self_calibration=CALIBRATION), np.array([-1.0, 0.7])
    at_once = rate_sensitivity(model, rates, rates, np.full(2, 25.0))
    assert [rate_sensitivity(model, rate, rate, 25.0).tolist() for rate in rates.tolist()] == at_once.T.tolist()


def test_the_covariance_has_the_order_of_the_sensitivity():
    whole = covariance(replace(MODEL, self_calibration=CALIBRATION))
    assert whole.shape == (4, 4) and np.diag(whole).tolist() == [1e-6, 4e-6, 1e-6, 1e-6]
    assert whole[2, 3] == 1e-8 and not whole[:2, 2:].any()
    assert covariance(GyroModel()).shape == (0, 0)
    assert rate_sensitivity(GyroModel(), np.zeros(3), np.zeros(3), np.zeros(3)).shape == (0, 3)


def test_the_quadratic_form_serves_one_vector_and_many():
    matrix, vectors = np.array([[2.0, 1.0], [1.0, 3.0]]), np.array([[1.0, 0.0, 2.0], [0.0, 1.0, 1.0]])
    assert quadratic_form(matrix, vectors).tolist() == [2.0, 3.0, 15.0]
    assert quadratic_form(matrix, vectors[:, 2]) == 15.0
