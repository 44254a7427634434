# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Compensation: model, then self-calibration; beyond the valid range; channels with memory."""

from dataclasses import replace
import math

from gyro_calibration.logs.log import CACHE_BLOCK_SAMPLES, DEGREE, Log
from gyro_calibration.model.channels import ChannelHistory, channels_from_log
from gyro_calibration.model.compensation import (
    compensate, quadratic_form, rate_sensitivity, uncertainty_covariance)
from gyro_calibration.model.effects import (
    BIAS, CATALOGUE, polynomial_from_matrix, SCALE_FACTOR_ERROR)
from gyro_calibration.model.gyro_model import GyroModel, SelfCalibration, Term, Tolerance
import numpy as np
import pytest

WARM = Term(*polynomial_from_matrix([[0.1], [0.0]]))  # the bias is 0.1 deg/s a degC
CALIBRATION = SelfCalibration(0.04, 0.002, ((1e-6, 1e-8), (1e-8, 1e-6)))
MODEL = GyroModel((Term(BIAS, (0.01,)), Term(SCALE_FACTOR_ERROR, (0.001,))), np.diag([1e-6, 4e-6]),
                  (-2.0, 2.0), (10.0, 40.0))


def test_the_self_calibration_comes_after_the_model_within_its_ranges():
    """Eq. 13 of Ojeda et al., then eq. 3 of Hong and Park."""
    done = compensate(replace(MODEL, self_calibration=CALIBRATION), 0.5)
    assert done.model_rate == pytest.approx((0.5 - 0.01) / 1.001, abs=1e-12)
    assert done.rate == pytest.approx((done.model_rate - 0.002) / 1.04, abs=1e-12)
    assert compensate(MODEL, np.array([-2.1, -2.0, 0.0, 2.0, 2.1])).beyond_range.tolist() == [
        True, False, False, False, True]
    assert (not compensate(GyroModel(), 99.0).beyond_range
            and compensate(GyroModel(), 101.0).beyond_range)
    warm = GyroModel((WARM,), reference_temperature=31.0)
    assert (compensate(warm, 0.2).rate == compensate(warm, 0.2, 31.0).rate
            != compensate(warm, 0.2, 30.0).rate), 'that of the reference where none is given'


def test_beyond_the_calibrated_temperatures_the_correction_is_extrapolated_and_then_held():
    model = GyroModel((WARM,), temperature_range=(10.0, 40.0))
    degc = np.array([-30.0, -20.0, 10.0, 25.0, 40.0, 69.0, 90.0, 1e4])
    done = compensate(model, np.zeros(8), degc)
    assert done.rate / DEGREE == pytest.approx(-0.1 * np.clip(degc, -20.0, 70.0))
    assert done.temperature.tolist() == [*degc[:-1].tolist(), 200.0]
    assert done.temperature_clipped.tolist() == [True, True, False, False, False, True, True, True]
    assert ([bool(compensate(model, 0.0, float(one)).temperature_clipped) for one in degc]
            == done.temperature_clipped.tolist())


@pytest.mark.parametrize('calibration', [None, CALIBRATION],
                         ids=['model alone', 'self-calibrated'])
@pytest.mark.parametrize('given', [None, 31.0, 'all', 'clipped'])
def test_a_log_longer_than_the_cache_is_compensated_as_its_pieces(calibration, given):
    model = GyroModel((WARM, *MODEL.terms), None, (-0.5, 0.5), (10.0, 40.0),
                      self_calibration=calibration)
    count, generator = 2 * CACHE_BLOCK_SAMPLES + 77, np.random.default_rng(0)
    output = generator.normal(size=count)
    temperature = {'all': generator.uniform(20.0, 30.0, count),
                   'clipped': generator.uniform(0.0, 50.0, count)}.get(given, given)
    whole = compensate(model, output, temperature)
    cuts = [0, 1, 500, CACHE_BLOCK_SAMPLES + 3, count]
    for first, end in zip(cuts, cuts[1:]):
        here = temperature[first:end] if isinstance(temperature, np.ndarray) else temperature
        piece = compensate(model, output[first:end], here)
        for name in ('model_rate', 'rate', 'temperature', 'temperature_clipped', 'beyond_range'):
            of_whole = np.broadcast_to(getattr(whole, name), count)[first:end]
            assert np.array_equal(of_whole,
                                  np.broadcast_to(getattr(piece, name), end - first)), name


UNCERTAIN = {
    'bias and scale': MODEL,
    'sine response': GyroModel(
        (Term(CATALOGUE['sine_response'], (0.6, 1.0)), Term(SCALE_FACTOR_ERROR, (0.02,)),
         Term(BIAS, (0.01,)), Term(CATALOGUE['scale_factor_temperature'], (25.0, 1e-3))),
        np.array([[4e-6, 1e-7, 0.0, 0.0], [1e-7, 1e-6, 1e-7, 0.0], [0.0, 1e-7, 1e-6, 0.0],
                  [0.0, 0.0, 0.0, 1e-9]])),
    'polynomial': GyroModel(
        (Term(*polynomial_from_matrix([[1e-4, 2e-3, 0.1], [1e-5, 4e-3, -0.05]])),),
        np.diag(np.arange(1.0, 7.0)) * 1e-7),
}


def with_values(model, change):
    """Return the model with its fitted values, then s and b, changed by so much."""
    change, terms = list(change), []
    for term in model.terms:
        values = list(term.values)
        for place in term.fitted_indices:
            values[place] += change.pop(0)
        terms.append(Term(term.effect, tuple(values)))
    if model.self_calibration is None:
        return replace(model, terms=tuple(terms))
    s, b = change
    calibration = SelfCalibration(model.self_calibration.scale_factor_error + s,
                                  model.self_calibration.bias + b)
    return replace(model, terms=tuple(terms), self_calibration=calibration)


@pytest.mark.parametrize('calibration', [None, CALIBRATION],
                         ids=['model alone', 'self-calibrated'])
@pytest.mark.parametrize('name', UNCERTAIN)
def test_the_sensitivity_is_the_derivative_of_the_rate(name, calibration):
    model, step = replace(UNCERTAIN[name], self_calibration=calibration), 1e-6
    rate = np.array([-1.4, -0.3, 0.0, 0.7, 1.5])
    temperature = np.array([22.0, 24.0, 25.0, 30.0, 31.0])
    output = model.output(rate, temperature)
    base = compensate(model, output, temperature).rate
    differences = [(compensate(with_values(model, row), output, temperature).rate - base) / step
                   for row in step * np.eye(len(uncertainty_covariance(model)))]
    assert rate_sensitivity(model, output, base, temperature) == pytest.approx(
        np.array(differences), rel=1e-4, abs=1e-6)


def test_what_a_sine_cannot_answer_has_a_large_but_finite_deviation():
    model = UNCERTAIN['sine response']
    output, degc = np.linspace(-3.0, 3.0, 101), np.full(101, 25.0)
    rate = compensate(model, output).rate
    variance = quadratic_form(uncertainty_covariance(model),
                              rate_sensitivity(model, output, rate, degc))
    assert np.isfinite(variance).all() and variance[0] > 25.0 * variance[50]


TOLERANT = replace(MODEL, tolerance=Tolerance(0.001, 0.0002, 1e-4, 2e-5, 0.003))


def test_the_standard_deviation_grows_outside_of_what_was_calibrated():
    def deviation(model, rate, degc):
        done = compensate(model, rate, degc)
        return math.sqrt(quadratic_form(uncertainty_covariance(model), rate_sensitivity(
            model, rate, done.rate, done.temperature)))

    inside = deviation(TOLERANT, 0.0, 25.0)
    assert inside == pytest.approx(math.hypot(1e-3, 0.001), rel=1e-3)  # of the bias alone
    warmer = [deviation(TOLERANT, 0.0, degc) for degc in (40.0, 45.0, 60.0, 90.0, 150.0)]
    assert warmer[0] == inside and np.all(np.diff(warmer) > 0.0)
    assert warmer[2] == pytest.approx(math.hypot(inside, 20.0 * 1e-4), rel=1e-3)
    turning = [deviation(TOLERANT, 1.0, degc) for degc in (40.0, 60.0)]
    assert turning[1] ** 2 - turning[0] ** 2 == pytest.approx(
        (20.0 * 1e-4) ** 2 + (20.0 * 2e-5) ** 2, rel=0.01)
    faster = [deviation(TOLERANT, rate, 25.0) for rate in (2.0, 3.0)]
    assert faster[1] ** 2 - faster[0] ** 2 > 0.9 * 0.003 ** 2
    # a self-calibration finds bias and scale factor of this run, at its temperature
    known = replace(TOLERANT, self_calibration=replace(CALIBRATION, temperature=55.0))
    assert deviation(known, 0.0, 55.0) == deviation(known, 0.0, 25.0) < deviation(known, 0.0, 60.0)


# Channels with memory: exact responses

UNEVEN = np.cumsum(np.random.default_rng(0).exponential(0.3, 3000))


def ramp_response(time, time_constant):
    """Return the exact response of a first-order lag to a ramp that begins at time zero."""
    return time - time_constant * (1.0 - np.exp(-time / time_constant))


def lagged(time, temperature, time_constant):
    return channels_from_log(Log(output=time, time=time, temperature=temperature)).lagged(
        'temperature', time_constant)


@pytest.mark.parametrize('time_constant', [0.02, 1.0, 25.0, 3000.0])
@pytest.mark.parametrize('time', [np.arange(2000) * 0.1, UNEVEN - UNEVEN[0]],
                         ids=['even', 'uneven'])
def test_ramps_and_their_corners_are_answered_exactly_whatever_the_stamps(time, time_constant):
    expected = ramp_response(time, time_constant)
    assert lagged(time + 7.0, 20.0 + 0.5 * time, time_constant) == pytest.approx(
        20.0 + 0.5 * expected, rel=0.0, abs=1e-10)
    corner = time[len(time) // 3]
    late = ramp_response(np.maximum(time - corner, 0.0), time_constant)
    assert lagged(time, np.minimum(time, corner), time_constant) == pytest.approx(
        expected - late, rel=0.0, abs=1e-10)


def test_vibration_is_the_mean_square_about_the_mean_and_tilting_is_none():
    time = np.arange(0.0, 3000.0, 0.01)
    white = 9.81 + 0.3 * np.random.default_rng(2).standard_normal(len(time))
    tilting = 9.81 * np.sin(time / 8.0)  # a second's mean of it errs by up to 1.2 m/s²
    shaken, tilted = (channels_from_log(Log(output=time, time=time, specific_force=force)).lagged(
        'vibration', 1.0)[1000:].mean() for force in (white, tilting))
    kept = 1.0 - 0.01  # of a white deviation; the two means over 1 s take the rest
    assert shaken == pytest.approx(0.09 * kept, rel=0.01) and tilted < 0.02


@pytest.mark.parametrize('noise', [0.0, 0.03])
def test_the_branch_turns_soon_after_the_temperature_does_and_not_by_noise(noise):
    time = np.arange(0.0, 1800.0, 0.05)
    turned = np.abs((time / 300.0) % 2.0 - 1.0)
    temperature = 40.0 - 6.0 * turned + noise * np.random.default_rng(3).standard_normal(len(time))

    def branch(temperature):
        log = Log(output=time, time=time, temperature=temperature)
        return channels_from_log(log).heating(10.0, 1e-3)
    settled = (time % 300.0) > 20.0
    assert (branch(temperature)[settled].tolist()
            == np.where((time // 300.0) % 2.0, -1.0, 1.0)[settled].tolist())
    # none before the temperature changes, and then it keeps the last one
    once = branch(np.clip(time, 200.0, 300.0))
    assert not once[time < 200.0].any() and once[time > 210.0].min() == 1.0


def test_a_lag_goes_on_in_blocks_that_do_not_use_it():
    history, temperature = ChannelHistory(), 25.0 + 8.0 * np.sin(UNEVEN / 90.0)
    history.update(UNEVEN[:10], temperature[:10]).lagged('temperature', 20.0)
    history.update(UNEVEN[10:2000], temperature[10:2000])
    last = history.update(UNEVEN[2000:], temperature[2000:]).lagged('temperature', 20.0)
    assert last == pytest.approx(
        ChannelHistory().update(UNEVEN, temperature).lagged('temperature', 20.0)[2000:], rel=1e-12)


def test_while_no_temperature_is_known_one_stands_in_and_nothing_is_lagging():
    history = ChannelHistory(default_temperature=33.0)
    early = history.update(0.0)
    assert early.temperature == early.lagged('temperature', 100.0) == 33.0
    first = history.update(1.0, 10.0)
    assert first.temperature == first.lagged('temperature', 100.0) == 10.0, (
        'a temperature that comes is no change of temperature')
    ahead = history.update(2.0, 12.0).lagged('temperature', 100.0) - 12.0
    lost = history.update(102.0)
    assert (lost.temperature == 33.0
            and lost.lagged('temperature', 100.0) - 33.0 == pytest.approx(ahead / np.e, rel=1e-12))
    channels = channels_from_log(Log(output=UNEVEN))
    assert (channels.supply is None and not channels.time.any()
            and channels.lagged('temperature', 10.0).tolist() == [25.0] * len(UNEVEN))
    assert set(lagged(UNEVEN, np.full(len(UNEVEN), 31.7), 50.0)) == {31.7}
