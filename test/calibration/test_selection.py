# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The selection of effects: present ones are found, absent ones not, confounded ones reported."""

from dataclasses import replace

from gyro_calibration.calibration.dwells import (
    Dwells, dwells_from_table, extract_dwells, join_dwells, select_dwells)
from gyro_calibration.calibration.selection import (
    FALSE_ALARM_RATE, MIN_DISTINGUISHING_SIGMAS, select_effects, TECHNOLOGY_EFFECTS)
from gyro_calibration.logs.log import DEGREE, Log, read_log
from gyro_calibration.model.effects import (
    BIAS_TEMPERATURE, BIAS_TEMPERATURE_QUADRATIC, CUBIC_NONLINEARITY, SINE_RESPONSE)
from gyro_calibration.model.gyro_model import GyroModel, Term
import numpy as np
import pytest
import rate_table
from rate_table import judge, least_squares_error, simulated
from recovery import CUBIC, LINEAR, SINE, Table, TRUTH
from scipy.stats import binom

#: Every gyro has these, and these tables determine them better than a data sheet.
SLOPES = ('bias_temperature', 'scale_factor_temperature')
#: Probability that a test of the choice fails by chance.
RARE = 1e-4
WANDERING = Table(sweep_bias=0.02 * DEGREE, sweep_scale=3e-4)


def names(selection):
    return {effect.name for effect in selection.calibration.effects}


def of_table(rate, output):
    return Dwells(rate, output, None, np.full(len(rate), np.nan),
                  np.zeros(len(rate), dtype=int), ('',) * len(rate))


def measured(table, terms, seed=1):
    return table.measure(GyroModel(terms), np.random.default_rng(seed))


@pytest.mark.parametrize('runs', [3, pytest.param(15, marks=pytest.mark.evidence)])
@pytest.mark.parametrize(
    'table', [Table(), WANDERING, Table(sweep_bias=0.05 * DEGREE, sweep_scale=1e-3, one_way=True)])
def test_effects_that_are_not_there_are_hardly_ever_taken(table, runs):
    generator = np.random.default_rng(2)
    wrong = sum(names(select_effects(table.measure(GyroModel(LINEAR), generator)))
                != {'bias', 'scale_factor_error', *SLOPES} for _ in range(runs))
    assert wrong <= binom.ppf(1 - RARE, runs, FALSE_ALARM_RATE)


@pytest.mark.parametrize('runs', [2, pytest.param(8, marks=pytest.mark.evidence)])
@pytest.mark.parametrize('terms, technology', [(CUBIC, 'mems'), (SINE, 'open_loop_fog')])
def test_effects_of_clear_size_are_found(terms, technology, runs):
    thermal = {'bias_temperature': Term(BIAS_TEMPERATURE, (36.0, 1e-4)),
               'bias_temperature_quadratic': Term(BIAS_TEMPERATURE_QUADRATIC, (36.0, 1e-5))}
    terms = [thermal.get(term.effect.name, term) for term in terms]
    generator = np.random.default_rng(3)
    found = [names(select_effects(Table().measure(GyroModel(terms), generator), technology))
             for _ in range(runs)]
    right = sum(each == {term.effect.name for term in terms} | set(SLOPES) for each in found)
    assert right >= binom.ppf(RARE, runs, 1 - FALSE_ALARM_RATE)


@pytest.mark.parametrize('technology', TECHNOLOGY_EFFECTS)
@pytest.mark.parametrize('wide', [True, False])
def test_what_the_gyro_is_decides_only_where_the_data_do_not(technology, wide):
    table = replace(WANDERING, fastest=300.0 * DEGREE) if wide else WANDERING
    selection = select_effects(measured(table, (*LINEAR, TRUTH['sine_response'])), technology)
    expected = SINE_RESPONSE if wide else TECHNOLOGY_EFFECTS[technology]
    assert expected in selection.calibration.effects
    assert selection.confounders[0].is_distinguishable == wide
    reason = selection.confounders[0].reason
    assert technology in reason or wide and TECHNOLOGY_EFFECTS[technology] is SINE_RESPONSE
    assert ('although' in reason) == (wide and TECHNOLOGY_EFFECTS[technology] is not SINE_RESPONSE)


@pytest.mark.parametrize('runs', [2, pytest.param(12, marks=pytest.mark.evidence)])
def test_the_rate_that_is_proposed_distinguishes_confounders(runs):
    generator, sigmas = np.random.default_rng(4), []
    truth = GyroModel((*LINEAR, TRUTH['sine_response']))
    for _ in range(runs):
        table = Table().measure(truth, generator)
        rate = select_effects(table).confounders[0].distinguishing_rate
        more = Table(sweeps=1, rates=4).measure(truth, generator)
        fast = np.array([rate, -rate, rate, -rate])
        noise = more.output - truth.output(more.rate, more.temperature)
        more = replace(more, rate=fast, output=truth.output(fast, more.temperature) + noise)
        pair = select_effects(join_dwells([table, more])).confounders[0]
        sigmas.append(pair.sigmas if pair.taken == 'sine_response' else -pair.sigmas)
    # The aim is one sigma more than needed; a single pair of fits varies by one sigma.
    assert np.mean(sigmas) > MIN_DISTINGUISHING_SIGMAS - 3.7 / np.sqrt(runs), sigmas


@pytest.mark.parametrize('technology', [None, 'open_loop_fog'])
def test_a_sine_that_passes_through_evenly_spaced_rates_is_not_taken_for_a_cubic(technology):
    """Rates of multiples of 20 deg/s do not distinguish k from 18 s - k, of the other sign."""
    terms = (*LINEAR, Term(CUBIC_NONLINEARITY, (0.001,)))
    table = measured(Table(sweeps=16, rates=11, dwell=0.01 * DEGREE), terms)
    assert 'cubic_nonlinearity' in names(select_effects(table, technology))


def test_a_sine_is_taken_up_to_its_fringe_and_beyond_it_the_reason_says_so():
    rate = np.tile(np.linspace(-300.0, 300.0, 5), 4) * DEGREE
    for angle in (1.5, 1.8):
        k = angle / rate.max()
        output = np.sin(k * rate) / k + 9e-5 * np.random.default_rng(0).standard_normal(20)
        selection = select_effects(of_table(rate, output), 'open_loop_fog')
        reason, = (each.reason for each in selection.choices if each.effect == 'sine_response')
        if angle < 0.5 * np.pi:
            k_found = selection.calibration.terms[-1].values[0]
            assert names(selection) == {'bias', 'scale_factor_error', 'sine_response'}
            assert k_found == pytest.approx(k, rel=1e-3)
        else:
            assert 'beyond its fringe' in reason and '--effects' in reason


def test_rests_show_a_bias_alone():
    table = measured(Table(), LINEAR)
    steady = replace(table, rate=np.zeros(len(table)), output=table.output - table.rate)
    assert names(select_effects(steady)) == {'bias', 'bias_temperature'}


@pytest.mark.parametrize('technology', [None, *TECHNOLOGY_EFFECTS])
def test_on_the_recorded_table_the_default_predicts_rates_beyond_those_it_saw(data, technology):
    dwells = rate_table.table(data)
    assert rate_table.beyond(rate_table.chosen(technology), dwells) < 0.085 * DEGREE


def test_on_the_recorded_table_sine_and_cubic_are_hardly_distinguished_and_a_rate_is_proposed(
        data):
    dwells = rate_table.table(data)
    selection = select_effects(dwells, 'open_loop_fog')
    assert names(selection) == {'bias', 'scale_factor_error', 'sine_response', *SLOPES}
    pair, = selection.confounders
    assert (pair.other == CUBIC_NONLINEARITY.name and 1.5 < pair.sigmas < MIN_DISTINGUISHING_SIGMAS
            and 110.0 < pair.distinguishing_rate / DEGREE < 200.0)
    assert selection.calibration.left_out_rms < 0.05 * DEGREE


@pytest.mark.parametrize('sine', [True, False], ids=['open-loop', 'MEMS'])
@pytest.mark.parametrize('gyros', [4, pytest.param(40, marks=pytest.mark.evidence)])
def test_the_stated_deviation_is_that_of_another_campaign(sine, gyros):
    """The 12 sweeps of a gyro are correlated, so z² scatters as that of a few numbers."""
    errors, z, peers = [], [], []
    for seed in range(100, 100 + gyros):
        cool, hot = (simulated(np.random.default_rng(seed), sine, each) for each in (False, True))
        found = judge(select_effects(cool).calibration.model, hot)
        errors.append(found[0])
        z.append(found[1])
        peers.append(least_squares_error(cool, hot))
    assert np.mean(errors) < 1.1 * np.mean(peers)
    assert 0.4 < np.sqrt(np.mean(np.square(z))) < 2.0


def test_on_the_recorded_table_the_cooler_half_predicts_the_hotter_one(data):
    dwells = dwells_from_table(read_log(data / 'fog_rate_table' / 'table.csv'))
    first, second = (select_dwells(dwells, (dwells.sweep < 12) == part) for part in (True, False))
    error, z = judge(select_effects(first).calibration.model, second)
    assert error < 0.065 and z < 1.6
    slow = select_dwells(first, np.abs(first.rate) < 60.0 * DEGREE)
    error, z = judge(select_effects(slow).calibration.model, second)
    assert error < 0.08 and z < 1.6


# Tables of outputs in steps or at their limit

def stepped_table(generator, step, limit=np.inf, cubic=0.0, deviation=None):
    """Return two sweeps of nine rates with noise of 0.02 steps, and s and b of the gyro."""
    s, b = generator.normal(0.0, 0.01), generator.normal(0.0, 0.2)
    rate = np.tile(generator.uniform(50.0, 200.0) * np.linspace(-1.0, 1.0, 9), 2)
    output = (1.0 + s) * rate + b - cubic * rate ** 3
    output = np.clip(output + 0.02 * step * generator.standard_normal(18), -limit * rate.max(),
                     limit * rate.max())
    columns = {} if deviation is None else {'deviation_dps': np.full(18, deviation).astype(str)}
    return Log(output=step * np.round(output / step) * DEGREE, reference_rate=rate * DEGREE,
               others=columns), s, b * DEGREE


def is_right(selection, s, b):
    """Tell whether s and b are within 4 deviations, and no other effect was taken."""
    (_, _, bias, of_bias), (_, _, scale, of_scale) = selection.model.estimates()
    return abs(bias - b) < 4.0 * of_bias and abs(scale - s) < 4.0 * of_scale


@pytest.mark.parametrize('step', [0.001, 0.1, 0.5])
def test_dwells_at_the_limit_of_an_output_are_left_out_not_taken_for_a_sine(step):
    for seed in range(20):
        generator = np.random.default_rng(seed)
        table, s, b = stepped_table(generator, step, generator.uniform(0.6, 0.95))
        dwells = extract_dwells(table)
        assert 'at the limit of the output' in dwells.remarks[0]
        assert is_right(select_effects(dwells), s, b)
        coarse = extract_dwells(stepped_table(generator, step, cubic=1e-6)[0])
        assert 'at the limit' not in ' '.join(coarse.remarks)


@pytest.mark.parametrize('deviation', [None, 0.0001, 0.01])
@pytest.mark.parametrize('step', [0.061, 0.25])
def test_identical_sweeps_of_a_coarse_output_show_no_other_effect(step, deviation):
    """Their rounding errors are the same: a second sweep tells no more of them."""
    for seed in range(20):
        table, s, b = stepped_table(np.random.default_rng(seed), step, deviation=deviation)
        assert is_right(select_effects(extract_dwells(table)), s, b)
