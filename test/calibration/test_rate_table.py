# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Calibration from dwells of known truth, and the error of a full turn."""

from dataclasses import replace
from functools import partial
import json
import math

from gyro_calibration.calibration.dwells import (
    Dwells, dwells_from_table, extract_dwells, select_dwells)
from gyro_calibration.calibration.rate_table import channels_of, compute_turn_errors, fit_effects
from gyro_calibration.calibration.scatter import find_inliers
from gyro_calibration.heading.integration import integrate
from gyro_calibration.logs.log import DataRefused, DEGREE, Log, read_log, write_log
from gyro_calibration.model.compensation import compensate
from gyro_calibration.model.effects import (
    BIAS, BIAS_TEMPERATURE, BIAS_TEMPERATURE_QUADRATIC, rate_temperature_polynomial,
    SCALE_FACTOR_ASYMMETRY, SCALE_FACTOR_ERROR, SINE_RESPONSE, STATIC_EFFECTS)
from gyro_calibration.model.gyro_model import GyroModel, Term
from gyro_calibration.model.motion import motion_from_rates, simulate
from gyro_calibration.model.noise import Noise
import numpy as np
import pytest
from recovery import CUBIC, gyros, LINEAR, run, SINE, Table
from scipy.stats import binom, chi2

#: Probability that a test of an estimator fails by chance.
RARE = 1e-4


def dwells(rate, error, temperature=None, sweep=None, deviation=np.nan):
    rate = np.asarray(rate, dtype=float)
    return Dwells(rate, rate + error, temperature, deviation + np.zeros(len(rate)),
                  np.zeros(len(rate), int) if sweep is None else sweep,
                  tuple(f'row {row + 1}' for row in range(len(rate))))


def measured(terms=LINEAR, seed=1, **table):
    return Table(**table).measure(GyroModel(terms), np.random.default_rng(seed))


@pytest.mark.parametrize('stated', [False, True])
def test_no_dwell_is_taken_as_exact(stated):
    """A single rest beside turns, as if it scattered less, and a dwell of a tiny deviation."""
    rate, noise = np.append(0.0, np.outer(np.arange(1, 8), [0.5, -0.5])), 1e-4
    errors = []
    for seed in range(40):
        generator = np.random.default_rng(seed)
        truth = [5e-3, 1e-2] * generator.standard_normal(2)
        output = rate + truth @ [np.ones(15), rate] + noise * generator.standard_normal(15)
        deviation = np.full(15, noise if stated else math.nan)
        deviation[generator.integers(15)] *= 1e-3
        found = fit_effects(dwells(rate, output - rate, deviation=deviation),
                            [BIAS, SCALE_FACTOR_ERROR])
        sizes = np.sqrt(np.diag(found.model.covariance))
        errors.append((np.concatenate([term.values for term in found.terms]) - truth) / sizes)
        # a quarter of that by dwells that are known to be alike
        assert sizes[0] > 0.25 * noise / math.sqrt(15)
    assert np.abs(errors).max() < 4.0


def test_a_complete_model_lacks_an_effect_as_rarely_as_the_p_value_says():
    chances, rates = {0.0: [], 2e-3: []}, np.append(0.0, np.outer(np.arange(1, 8), [0.5, -0.5]))
    for seed in range(50):
        generator = np.random.default_rng(seed)
        truth = [5e-3, 1e-2] * generator.standard_normal(2)
        noise = 1e-4 * generator.standard_normal(15)
        for asymmetry, found in chances.items():
            error = truth @ [np.ones(15), rates] + asymmetry * np.abs(rates) + noise
            found.append(fit_effects(dwells(rates, error),
                                     [BIAS, SCALE_FACTOR_ERROR]).fit_p_value)
    assert np.sum(np.array(chances[0.0]) < 0.01) <= binom.ppf(1.0 - RARE, 50, 0.01)
    assert np.max(chances[2e-3]) < 0.01


def test_dwells_of_any_deviations_beside_each_other_are_no_error():
    """Outputs on few steps have means without scatter, to rounding, beside ones with much."""
    generator = np.random.default_rng(0)
    rate = np.array([*[0.0] * 12, -1.31, 0.0, 0.0, -0.69, 0.0])
    for _ in range(50):
        found = fit_effects(dwells(
            rate, 0.019 * rate, deviation=10.0 ** generator.uniform(-16.0, -3.0, 17),
            sweep=np.arange(17) // 2), [BIAS, SCALE_FACTOR_ERROR])
        assert np.isfinite(found.model.covariance).all()
        assert found.terms[1].values[0] == pytest.approx(0.019, abs=1e-6)


@pytest.mark.parametrize(
    'terms, table', [(CUBIC, Table()), (SINE, Table(sweep_bias=0.02 * DEGREE, sweep_scale=3e-4)),
                     (SINE, Table(told=True)),
                     (CUBIC, Table(sweep_bias=0.05 * DEGREE, sweep_scale=1e-3, one_way=True))])
@pytest.mark.parametrize('runs', [10, pytest.param(100, marks=pytest.mark.evidence)])
def test_intervals_hold_the_truth_about_as_often_as_they_say(terms, table, runs):
    generator = np.random.default_rng(7)
    values, rates = (np.array(each)
                     for each in zip(*(run(terms, table, generator) for _ in range(runs))))
    for errors in (values, rates):
        held = (np.abs(errors) <= 1.96).sum(axis=0)
        # Wandering sweeps take up to 3 % off (docs/benchmarks.md); all columns share RARE.
        assert held.min() >= binom.ppf(RARE / errors.shape[1], runs, 0.92)
        # Nor are they too wide: the values of a run are correlated, so a run counts once.
        assert chi2.ppf(RARE, runs) / runs < np.mean(errors ** 2) < chi2.ppf(1 - RARE, runs) / runs


@pytest.mark.parametrize('name', [*gyros()])
def test_a_gyro_with_one_effect_is_compensated_to_its_true_rate(name):
    truth = GyroModel(gyros()[name])
    table = Table(dwell=0.0).measure(truth, np.random.default_rng(0))
    model = fit_effects(table, [term.effect for term in truth.terms]).model
    np.testing.assert_allclose(model.rate(table.output, table.temperature), table.rate, atol=1e-9)


@pytest.mark.parametrize('k', [0.05, 0.25, 0.6, 1.0])
def test_the_shape_of_a_sine_is_found_wherever_it_is(k):
    table = measured((*LINEAR, Term(SINE_RESPONSE, (k, 1.0))), dwell=1e-5 * DEGREE)
    fit = fit_effects(table, (BIAS, SCALE_FACTOR_ERROR, SINE_RESPONSE))
    assert fit.terms[2].values[0] == pytest.approx(k, rel=1e-3)


@pytest.mark.parametrize('runs', [40, pytest.param(400, marks=pytest.mark.evidence)])
def test_intervals_from_three_speeds_hold_the_truth(runs):
    generator = np.random.default_rng(3)
    held = 0
    for _ in range(runs):
        table = dwells([0.0, 3.49, 4.71], 0.01 + 0.02 * np.array([0.0, 3.49, 4.71])
                       + 1e-3 * generator.standard_normal(3))
        fit = fit_effects(table, (BIAS, SCALE_FACTOR_ERROR))
        held += abs(fit.terms[1].values[0] - 0.02) < 1.96 * math.sqrt(fit.model.covariance[1, 1])
    assert binom.ppf(RARE, runs, 0.95) <= held <= binom.ppf(1 - RARE, runs, 0.95)


@pytest.mark.parametrize('rates', [[0.0, 0.2], np.zeros(30), np.linspace(-0.3, 0.3, 41)])
def test_a_table_without_any_error_is_fitted(rates):
    fit = fit_effects(dwells(rates, 0.0), [BIAS])
    assert fit.model.terms[0].values[0] == pytest.approx(0.0, abs=1e-15)
    assert fit.p_value(BIAS) == 1.0


def test_what_is_left_out_is_what_a_fit_without_the_sweep_gives():
    table = measured(CUBIC, sweep_bias=0.02 * DEGREE)
    effects = [term.effect for term in CUBIC]
    fit = fit_effects(table, effects)
    seen = table.sweep != 2
    without = fit_effects(select_dwells(table, seen), effects,
                          replace(fit.scatter, inliers=np.ones(seen.sum(), bool))).model
    hidden = select_dwells(table, ~seen)
    np.testing.assert_allclose(fit.left_out_residual[~seen],
                               hidden.output - hidden.rate - without.error(channels_of(hidden)),
                               atol=1e-9)


def test_the_fast_dwells_of_a_sweep_of_another_scale_are_not_outlying():
    generator = np.random.default_rng(5)
    rate, sweep = np.tile(np.linspace(-2.0, 2.0, 11), 8), np.repeat(np.arange(8), 11)
    error = 2e-3 * (sweep == 3) * rate + 5e-5 * generator.standard_normal(len(rate))
    assert find_inliers(dwells(rate, error, sweep=sweep)).all()
    error[36] += 5e-3
    assert np.flatnonzero(~find_inliers(dwells(rate, error, sweep=sweep))).tolist() == [36]


ASCENDING = np.linspace(-1.0, 1.0, 20)
REFUSED = {
    'a swing at one speed does not part asymmetry from bias': (
        dwells(np.tile([0.5, -0.5], 10),
               0.01 + 1e-4 * np.random.default_rng(0).standard_normal(20)),
        (BIAS, SCALE_FACTOR_ERROR, SCALE_FACTOR_ASYMMETRY),
        'bias, scale_factor_asymmetry look alike .* many speeds, slow ones and rest too'),
    'no temperature': (dwells(ASCENDING, 0.01), (BIAS, BIAS_TEMPERATURE),
                       'bias_temperature cannot be seen: .*no temperature; record'),
    'one temperature': (dwells(ASCENDING, 0.01, np.full(20, 25.0)), (BIAS, BIAS_TEMPERATURE),
                        'bias_temperature cannot be seen: .*varies by 0 K'),
    'two temperatures show no curve': (
        dwells(np.tile(ASCENDING[::2], 2), 0.01, np.repeat([20.0, 40.0], 10)),
        (BIAS, SCALE_FACTOR_ERROR, BIAS_TEMPERATURE, BIAS_TEMPERATURE_QUADRATIC),
        'bias, .*bias_temperature_quadratic look alike.*three temperatures'),
    'a polynomial of too high an order': (
        dwells(np.repeat([-1.0, 0.0, 1.0], 8), 0.0), (rate_temperature_polynomial(4, 0),),
        r'.*cannot be determined from these dwells; \w'),
    'fewer dwells than values': (
        dwells([0.0, 1.0], 0.0, np.array([20.0, 40.0])), tuple(STATIC_EFFECTS.values()),
        '2 dwells do not determine 9 values; add dwells, or fit fewer'),
}


@pytest.mark.parametrize('table, effects, said', REFUSED.values(), ids=REFUSED)
def test_what_the_dwells_do_not_determine_is_refused_with_the_remedy(table, effects, said):
    with pytest.raises(DataRefused, match=f'^{said}'):
        fit_effects(table, effects)


def test_a_likelihood_of_the_scatter_does_not_reward_a_polynomial_that_takes_the_output_away(data):
    """On this table 0.1.0 stated t0w1 = 0.097 +- 46 deg/s, with a residual of 0.045."""
    fit = fit_effects(dwells_from_table(read_log(data / 'fog_rate_table' / 'table.csv')),
                      [rate_temperature_polynomial(3, 2)])
    assert np.sqrt(np.diag(fit.model.covariance)).max() < 2.0 * fit.residual_rms


@pytest.mark.parametrize('has_time', [False, True], ids=['table', 'log'])
def test_the_steps_of_an_output_without_noise_are_in_the_deviations(has_time):
    """On 0.2.0 the bias of three rates was stated to 1e-14 deg/s, 0.07 deg/s off."""
    draw, step, scores = np.random.default_rng(3), 0.2, []
    for rates in ([0, 45, -45], [0, 1, -1, 2, -2, 5, -5], [0, 33.3, -33.3, 78]):
        for _ in range(4):
            s, b = 0.004 * draw.standard_normal(), 0.3 * draw.standard_normal()
            turned = np.tile(np.array(rates, float), 3)
            time = None
            if has_time:
                turned = np.convolve(np.repeat(turned, 90), np.ones(20) / 20, mode='same')
                time = np.arange(len(turned)) / 20
            output = step * np.round(((1.0 + s) * turned + b) / step)
            dwells = extract_dwells(Log(time, output * DEGREE, reference_rate=turned * DEGREE))
            fit = fit_effects(dwells, [BIAS, SCALE_FACTOR_ERROR])
            deviations = np.sqrt(np.diag(fit.model.covariance))
            # rates of whole deg/s do not show a smaller step
            assert deviations[0] < 1.1 * step * DEGREE
            scores.append((np.array([term.values[0] for term in fit.terms])
                           - [b * DEGREE, s]) / deviations)
    assert np.abs(scores).max() < 3.5
    assert np.mean(np.abs(scores) < 1.96) >= 0.85


# The error of a full turn: by hand, against simulated turns, and as the program reports it

TURN = 2.0 * math.pi


def dwells_of(rates, errors, temperature=None, sweep=None):
    """Return the dwells of a rate table from rates and errors in deg/s."""
    rate = np.array(rates, dtype=float) * DEGREE
    number = np.zeros(len(rate), dtype=int) if sweep is None else np.array(sweep)
    degc = None if temperature is None else np.array(temperature, dtype=float)
    return Dwells(rate, rate + np.array(errors) * DEGREE, degc, np.full(len(rate), np.nan), number,
                  tuple(f'row {place + 1}' for place in range(len(rate))))


HAND = dwells_of([0.0, 10.0, -20.0], [0.1, 0.15, 0.06])


def test_a_turn_at_10_deg_s_takes_36_s_and_one_at_20_takes_18():
    errors = compute_turn_errors(HAND, HAND.rate + np.array([0.02, 0.03, 0.01]) * DEGREE)
    assert errors.static / DEGREE == pytest.approx([0.05 * 36.0, -0.04 * 18.0])
    assert errors.modelled / DEGREE == pytest.approx([0.01 * 36.0, -0.01 * 18.0])


def test_every_sweep_has_its_own_rest_and_one_without_takes_that_of_the_nearest_temperature():
    found = dwells_of([0, 10, 0, 10, 10], [0.1, 0.2, 0.5, 0.6, 0.6], [20, 21, 40, 41, 38],
                      [0, 0, 1, 1, 2])
    errors = compute_turn_errors(found, found.output)
    assert errors.static / DEGREE == pytest.approx([3.6, 3.6, 3.6])
    assert '1 of 3 sweeps have none' in errors.remarks[0]


@pytest.mark.parametrize('rates, said', [([10.0, 20.0, 30.0], 'record a rest'),
                                         ([0.0, 0.0, 3.0], 'none of 3 dwells turns at 5 deg/s')],
                         ids=['no rest', 'rests'])
def test_a_table_without_turns_or_a_rest_is_refused(rates, said):
    found = dwells_of(rates, [0.0] * 3)
    with pytest.raises(DataRefused, match=said):
        compute_turn_errors(found, found.output)


def test_a_gyro_that_is_upside_down_is_refused_with_the_way_out():
    with pytest.raises(DataRefused, match='the other way than the reference .* --invert'):
        compute_turn_errors(replace(HAND, output=-HAND.output), -HAND.output)


NOISE = Noise(angle_random_walk=5e-5)
GYRO = GyroModel((Term(BIAS, (0.004,)), Term(SCALE_FACTOR_ERROR, (0.01,)),
                  Term(SINE_RESPONSE, (0.3, 1.0))), noise=NOISE)
#: Its calibration has an error.
MODEL = GyroModel((Term(BIAS, (0.003,)), Term(SCALE_FACTOR_ERROR, (0.014,)),
                   Term(SINE_RESPONSE, (0.25, 1.0))))


@pytest.mark.parametrize('rate', [7.2, -12.0, 36.0, -90.0])
def test_a_simulated_turn_integrated_at_10_hz_is_off_by_as_much(rate):
    found = dwells_of([0.0, rate], [0.0, 0.0])
    found = replace(found, output=GYRO.output(found.rate, np.full(2, 25.0)))
    errors = compute_turn_errors(found, compensate(MODEL, found.output).rate)
    rest, lasts = 10.0, 360.0 / abs(rate)
    motion = motion_from_rates(np.array([0.0, rest, rest + 0.1, rest + lasts, rest + lasts + 0.1]),
                               np.array([0, 0, rate, rate, 0]) * DEGREE)
    log = simulate(GYRO, motion, 10.0, np.random.default_rng(1))
    assert log.reference_heading[-1] == pytest.approx(math.copysign(TURN, rate))
    deviation = NOISE.angle_random_walk * math.sqrt(lasts + lasts ** 2 / rest)
    for expected, output in ((errors.static[0], log.output),
                             (errors.modelled[0], compensate(MODEL, log.output).rate)):
        turned = (integrate(log.time[100:], output[100:] - output[:100].mean())[-1]
                  - math.copysign(TURN, rate))
        # The ramps of 0.1 s, at other rates than the turn, may add the error of 0.1 s.
        assert turned == pytest.approx(expected, abs=4.0 * deviation + 0.1 * abs(expected) / lasts)
        assert abs(expected) > 5.0 * deviation, 'the claim would be lost in the noise'


def test_turns_without_a_rate_by_the_model_are_counted_and_do_not_lend_their_rest():
    found = dwells_of([0, 20, 0, 20, 20], [0.1, 0.3, 0.2, 0.4, 0.5], [20, 20, 30, 30, 21],
                      [0, 0, 1, 1, 2])
    rate = np.where(found.sweep == 0, np.nan, found.rate + 0.1 * DEGREE)
    errors = compute_turn_errors(found, rate)
    assert (errors.static / DEGREE == pytest.approx([0.2 * 18.0, 0.3 * 18.0])
            and errors.modelled == pytest.approx(0.0))
    assert '1 turns are left out' in errors.remarks[1]


def sweeps(deviation=0.0):
    """Return four sweeps with a bias of 0.2 deg/s and a scale factor error of 0.01."""
    rates = np.tile(np.arange(-60.0, 61.0, 10.0), 4)
    scatter = np.random.default_rng(5).normal(0.0, deviation, len(rates))
    return dwells_of(rates, 0.2 + 0.01 * rates + scatter, sweep=np.repeat(np.arange(4), 13))


@pytest.fixture
def turn(run):
    return partial(run, 'turn')


@pytest.fixture
def log(tmp_path):
    """Return a file of four sweeps at 20 to 50 degC, with b = 0.2 deg/s and s = 0.01."""
    found = sweeps()
    write_log(tmp_path / 'table.csv', Log(output=found.output, reference_rate=found.rate,
                                          temperature=20.0 + 10.0 * found.sweep))
    return tmp_path / 'table.csv'


@pytest.fixture
def model(tmp_path):
    """Return a model file that leaves s = 0.002, valid to 35 deg/s and 30 degC."""
    path = tmp_path / 'model.yaml'
    path.write_text(
        'effects: {bias: {bias: 0.0}, scale_factor_error: {scale_factor_error: 0.008}}\n'
        'valid: {rate: [-0.611, 0.611], temperature: [0, 30]}')
    return path


def test_the_data_hold_every_turn_in_si(turn, log, model):
    code, text, _ = turn(log, '--model', model, '--json')
    answer = json.loads(text)
    assert code == 0 and answer['turns'] == 48 == len(answer['rate_rad_s'])
    ways = np.sign(answer['rate_rad_s'])
    assert answer['static_rad_per_turn'] == pytest.approx(TURN * 0.01 * ways)
    assert answer['modelled_rad_per_turn'] == pytest.approx(TURN * (1.01 / 1.008 - 1.0) * ways)
    assert answer['ratio_rms'] == pytest.approx(0.01 / (1.01 / 1.008 - 1.0))
    assert (sum(each['turns'] for each in answer['by_rate'])
            == sum(each['turns'] for each in answer['by_temperature']) == 48)


def test_the_table_gives_degrees_and_per_cent_and_what_is_beyond_the_range_of_the_model(
        turn, log, model):
    code, text, _ = turn(log, '--model', model)
    row = next(line.split() for line in text.splitlines() if line.startswith('10 to '))
    assert code == 0 and [float(cell) for cell in row[4:8]] == [3.6, 1.0, 3.6, 1.0]
    assert '\nrate [deg/s]' in text and '\ntemperature [degC]' in text
    assert '24 of 52 dwells are beyond the calibrated rates' in text
    assert '26 of 52 dwells are outside the calibrated temperatures' in text


def test_without_a_model_one_is_fitted_that_has_not_seen_the_sweep(turn, tmp_path):
    found = sweeps(0.01)
    write_log(tmp_path / 'table.csv', Log(output=found.output, reference_rate=found.rate))
    code, text, _ = turn(tmp_path / 'table.csv', '--json')
    answer = json.loads(text)
    assert code == 0 and answer['left_out'] and answer['effects'] == ['bias', 'scale_factor_error']
    assert answer['temperature_degc'] is None and answer['by_temperature'] == []
    assert answer['modelled']['rms_rad_per_turn'] < 0.3 * answer['static']['rms_rad_per_turn']


def test_a_model_that_looks_around_sees_the_surroundings_of_the_log(turn, tmp_path):
    """By means of dwells alone, a supply that depends on the direction acts as an asymmetry."""
    (tmp_path / 'model.yaml').write_text(
        'effects: {supply_sensitivity: {supply_sensitivity: 0.01}}')
    time = np.cumsum([0, 10, 0.5, 20, 0.5, 20, 0.5, 10])
    motion = motion_from_rates(time, np.array([0, 0, 30, 30, -30, -30, 0, 0]) * DEGREE)
    log = simulate(GyroModel(), motion, 50.0, np.random.default_rng(2))
    supply = np.where(np.abs(log.time - 20.0) < 11.0, 6.0, 5.0)
    write_log(tmp_path / 'log.csv',
              replace(log, output=log.output + 0.01 * (supply - 5.0), supply=supply))
    code, text, _ = turn(tmp_path / 'log.csv', '--model', tmp_path / 'model.yaml', '--json')
    answer = json.loads(text)
    assert (answer['static']['largest_rad_per_turn'] > 0.1
            and answer['modelled']['largest_rad_per_turn'] < 1e-9)
