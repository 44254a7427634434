# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Effects and compensation: simulate, compensate, and the rate is back; ranges and memory."""

from dataclasses import replace
import itertools
import math

from gyro_calibration.logs.log import CACHE_BLOCK_SAMPLES, DEGREE, Log
from gyro_calibration.model.channels import ChannelHistory, channels_from_log
from gyro_calibration.model.compensation import (
    compensate, quadratic_form, rate_sensitivity, uncertainty_covariance)
from gyro_calibration.model.effects import (
    BIAS, CATALOGUE, Channels, polynomial_from_matrix, polynomial_to_matrix,
    rate_temperature_polynomial, SCALE_FACTOR_ERROR)
from gyro_calibration.model.gyro_model import GyroModel, SelfCalibration, Term, Tolerance
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


# Compensation: model, then self-calibration; beyond the valid range; channels with memory

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


def test_a_log_longer_than_the_cache_is_compensated_as_its_pieces():
    model = GyroModel((WARM, *MODEL.terms), None, (-0.5, 0.5), (10.0, 40.0),
                      self_calibration=CALIBRATION)
    count, generator = 2 * CACHE_BLOCK_SAMPLES + 77, np.random.default_rng(0)
    output, temperature = generator.normal(size=count), generator.uniform(0.0, 50.0, count)
    cuts = [0, 1, 500, CACHE_BLOCK_SAMPLES + 3, count]
    for degc in (temperature, np.full(count, 31.0)):
        whole = compensate(model, output, 31.0 if degc is not temperature else degc)
        pieces = [compensate(model, output[first:end], degc[first:end])
                  for first, end in zip(cuts, cuts[1:])]
        for name in ('model_rate', 'rate', 'temperature', 'temperature_clipped', 'beyond_range'):
            joined = np.concatenate([getattr(piece, name) for piece in pieces])
            assert (joined == getattr(whole, name)).all(), name


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
    change, run = iter(change), model.self_calibration
    terms = tuple(Term(term.effect, tuple(
        value + (next(change) if place in term.fitted_indices else 0.0)
        for place, value in enumerate(term.values))) for term in model.terms)
    return replace(model, terms=terms, self_calibration=run and SelfCalibration(
        run.scale_factor_error + next(change), run.bias + next(change)))


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
