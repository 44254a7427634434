# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Calibration from dwells: on simulated rate tables of known truth, and against least squares."""

from dataclasses import replace
import math

from gyro_calibration.calibration.dwells import (
    Dwells, dwells_from_table, extract_dwells, select_dwells)
from gyro_calibration.calibration.rate_table import channels_of, fit_effects
from gyro_calibration.calibration.scatter import find_inliers
from gyro_calibration.logs.log import DataRefused, DEGREE, Log, read_log
from gyro_calibration.model.effects import (
    BIAS, BIAS_TEMPERATURE, BIAS_TEMPERATURE_QUADRATIC, rate_temperature_polynomial,
    SCALE_FACTOR_ASYMMETRY, SCALE_FACTOR_ERROR, SINE_RESPONSE, STATIC_EFFECTS)
from gyro_calibration.model.gyro_model import GyroModel, Term
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


# estimates

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


# few dwells

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


# scatter

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


# refusals

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


# a polynomial of the output

def test_a_likelihood_of_the_scatter_does_not_reward_a_polynomial_that_takes_the_output_away(data):
    """On this table 0.1.0 stated t0w1 = 0.097 +- 46 deg/s, with a residual of 0.045."""
    fit = fit_effects(dwells_from_table(read_log(data / 'fog_rate_table' / 'table.csv')),
                      [rate_temperature_polynomial(3, 2)])
    assert np.sqrt(np.diag(fit.model.covariance)).max() < 2.0 * fit.residual_rms


# coarse steps

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
