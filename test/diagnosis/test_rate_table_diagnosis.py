# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The diagnosis of rate tables: hidden effects are found, absent ones not, limits are stated."""

from dataclasses import replace
import json
import math
import re

from gyro_calibration.calibration.dwells import join_dwells
from gyro_calibration.calibration.rate_table import fit_effects
from gyro_calibration.calibration.scatter import rms
from gyro_calibration.diagnosis import table_diagnosis as diagnosis
from gyro_calibration.diagnosis.table_diagnosis import diagnose_table
from gyro_calibration.logs.log import DEGREE
from gyro_calibration.model.effects import CATALOGUE, rate_temperature_polynomial, STATIC_EFFECTS
from gyro_calibration.model.gyro_model import GyroModel, have_same_effects, Term
from gyro_calibration.model.model_file import read_model, write_model
import numpy as np
import pytest
from rate_table import table as recorded_table
from recovery import LINEAR, SCATTERS, Table
from scipy.stats import binom

#: A test fails by chance as rarely as this.
RARE = 1e-4
#: Sixteen sweeps tell how much they wander; eight hardly do.
WANDERING = Table(sweeps=16, rates=11, sweep_bias=0.005 * DEGREE, sweep_scale=1e-4)
NUISANCES = ('bias', 'scale_factor_error')
#: Of each effect, a size that nothing could overlook, to learn from which size on it is found.
LARGE = {'bias': 0.05, 'scale_factor_error': 0.05, 'scale_factor_asymmetry': 0.02,
         'quadratic_nonlinearity': 0.02, 'cubic_nonlinearity': 0.02, 'sine_response': 0.5,
         'bias_temperature': 1e-3, 'bias_temperature_quadratic': 1e-4,
         'scale_factor_temperature': 3e-3}


@pytest.fixture
def without_gain(monkeypatch):
    """Leave out what takes most of the time, where it does not matter."""
    monkeypatch.setattr(diagnosis, '_cross_validated_gain', lambda *given: None)


def gyro(name, size):
    """Return a gyro with bias, scale factor and one effect; temperature counts from 25 degC."""
    terms = {term.effect.name: term for term in LINEAR}
    known = terms[name].values[-1] if name in terms else 0.0
    values = {'sine_response': (size, 1.0)}.get(
        name) or (*[25.0] * len(STATIC_EFFECTS[name].nonlinear_parameters), known + size)
    return GyroModel(tuple({**terms, name: Term(STATIC_EFFECTS[name], values)}.values()))


def diagnosed(table, truth, generator, model=None):
    """Return the diagnosis of a simulated table."""
    return diagnose_table(table.measure(truth, generator), model)


def members(finding):
    return {finding.effect, *finding.ambiguous_with}


def names(found):
    return [finding.effect for finding in found.findings]


@pytest.mark.parametrize('name', STATIC_EFFECTS)
def test_an_effect_at_twice_the_smallest_size_is_found(without_gain, name):
    generator = np.random.default_rng(1)
    model = GyroModel(LINEAR) if name in NUISANCES else None
    large = diagnosed(WANDERING, gyro(name, LARGE[name]), generator, model)
    smallest = next(each.minimum_detectable for each in large.findings if each.effect == name)
    found = diagnosed(WANDERING, gyro(name, 2.0 * smallest), generator, model)
    assert found.findings and name in members(found.findings[0]), names(found)
    assert len(members(found.findings[0])) <= 3


@pytest.mark.parametrize('scatter',
                         ['alike for all dwells', 'grows with the rate', 'differs by dwell, told',
                          '4 sweeps', 'from sweep to sweep', 'much from sweep to sweep, one way'])
def test_where_nothing_is_hidden_hardly_anything_is_found(scatter):
    generator, runs = np.random.default_rng(2), 3
    found = [diagnosed(SCATTERS[scatter], GyroModel(LINEAR), generator) for _ in range(runs)]
    assert sum(each.verdict != 'adequate' or bool(each.findings)
               for each in found) <= binom.ppf(1 - RARE, runs, 0.01)


def test_a_true_model_is_adequate_and_stays_as_it_is():
    model = replace(gyro('cubic_nonlinearity', -0.005), covariance=None)
    found = diagnosed(WANDERING, model, np.random.default_rng(3), model)
    assert found.verdict == 'adequate' and found.gain is None and found.model is model


def test_a_cause_that_left_out_sweeps_do_not_confirm_is_suspected_and_in_no_model(
        without_gain, monkeypatch):
    generator, truth = np.random.default_rng(7), gyro('cubic_nonlinearity', -0.01)
    table = Table().measure(truth, generator)
    (found,) = diagnose_table(table, None).findings
    assert found.status == 'established' and sum(found.probability.values()) == pytest.approx(1.0)
    assert {*found.probability} == members(found)
    monkeypatch.setattr(diagnosis, 'MIN_PREDICTION_SIGMAS', math.inf)
    found = diagnose_table(table, None)
    assert [each.status for each in found.findings] == ['suspected']
    assert found.verdict == 'adequate'
    assert [term.effect.name for term in found.model.terms] == [*NUISANCES]


def test_a_sine_and_a_cubic_are_a_set_until_the_proposed_dwells_are_added(without_gain):
    generator, truth = np.random.default_rng(4), gyro('sine_response', 0.25)
    table = Table().measure(truth, generator)
    (found,) = diagnose_table(table, None).findings
    assert members(found) >= {'sine_response', 'cubic_nonlinearity'}
    (rate,) = (float(number) * DEGREE
               for number in re.findall(r'each way at (\d+) deg/s', found.separate_by))
    # Five standard deviations are aimed at, four needed: made twice, they leave nothing to chance.
    more = Table(sweeps=2, rates=4).measure(truth, generator)
    fast = np.tile([rate, -rate], 4)
    noise = more.output - truth.output(more.rate, more.temperature)
    more = replace(more, rate=fast, output=truth.output(fast, more.temperature) + noise)
    (found,) = diagnose_table(join_dwells([table, more]), None).findings
    assert members(found) == {'sine_response'}


def test_a_drift_while_the_table_heats_is_temperature_or_time_until_it_cools_again(without_gain):
    generator, truth = np.random.default_rng(6), gyro('bias_temperature', 1e-4)
    up = Table().measure(truth, generator)
    (found,) = diagnose_table(up, None).findings
    assert members(found) >= {'bias_temperature', 'rate_ramp'} and 'cool' in found.separate_by
    down = replace(Table(), temperatures=Table().temperatures[::-1]).measure(truth, generator)
    (found,) = diagnose_table(join_dwells([up, down]), None).findings
    assert members(found) == {'bias_temperature'}


def test_a_sine_in_the_model_gives_way_to_the_cubic_that_is_there(without_gain):
    table = replace(Table(), fastest=300.0 * DEGREE)
    found = diagnosed(table, gyro('cubic_nonlinearity', -0.01), np.random.default_rng(9),
                      gyro('sine_response', 0.25))
    assert names(found) == ['cubic_nonlinearity']
    assert [term.effect.name for term in found.model.terms] == [*NUISANCES, 'cubic_nonlinearity']


def test_what_dwells_cannot_test_of_a_model_is_left_and_reported(without_gain):
    model = GyroModel((*LINEAR, Term(CATALOGUE['time_offset'], (0.02,))))
    found = diagnosed(Table(), gyro('cubic_nonlinearity', -0.01), np.random.default_rng(11), model)
    assert (any('time_offset' in remark for remark in found.remarks)
            and model.terms[-1] in found.model.terms)


@pytest.mark.parametrize('waves', [6.0, 40.0])
def test_what_is_not_in_the_catalogue_gets_no_name(waves):
    generator = np.random.default_rng(12)
    table = Table().measure(GyroModel(LINEAR), generator)
    table = replace(table, output=table.output + 0.06 * DEGREE * np.sin(waves * table.rate + 1.0))
    found = diagnose_table(table, None)
    assert found.verdict == 'unexplained' and not found.findings
    assert (found.unexplained[0].along in ('rate', 'single_rates')
            and found.unexplained[0].share_of_variance > 0.3)


def test_outlying_dwells_are_not_fitted_and_a_wrong_unit_is_the_only_finding():
    generator = np.random.default_rng(13)
    table = Table().measure(GyroModel(LINEAR), generator)
    wild = table.output + np.where(np.arange(len(table)) == 50, 1.0 * DEGREE, 0.0)
    wrong = diagnose_table(replace(table, output=wild * DEGREE), None)
    assert names(wrong) == ['unit_error'] and wrong.verdict == 'mismatched'
    found = diagnose_table(replace(table, output=wild), None)
    assert names(found) == ['outliers'] and 'row 51' in found.findings[0].evidence
    assert found.before.terms[1].values[0] == pytest.approx(0.01, abs=1e-3)


def test_tables_without_temperature_say_what_they_cannot_show():
    generator = np.random.default_rng(14)
    found = diagnose_table(replace(Table().measure(GyroModel(LINEAR), generator),
                                   temperature=None), None)
    assert ('temperature_degc' in found.cannot_show['bias_temperature']
            and 'time' in found.cannot_show['thermal_lag'])
    known = {*found.cannot_show, *STATIC_EFFECTS, 'outliers', 'unit_error'}
    assert known == set(diagnosis.CAUSES)


def test_an_extension_is_measured_on_sweeps_left_out_and_can_be_used(tmp_path):
    generator, truth = np.random.default_rng(16), gyro('cubic_nonlinearity', -0.01)
    found = diagnosed(Table(), truth, generator)
    assert found.verdict == 'extended' and found.gain.rate.interval[0] > 0.0
    assert found.gain.rate.after < 1.2 * Table().dwell
    assert found.gain.heading.before == pytest.approx(60.0 * found.gain.rate.before)
    assert found.gain.models['extended'] == pytest.approx(found.gain.heading.after)
    assert found.gain.models['plain'] == pytest.approx(found.gain.heading.before)
    assert all(each.remedy for each in found.findings)
    write_model(tmp_path / 'model.yaml', found.model)
    written = read_model(tmp_path / 'model.yaml')
    assert (have_same_effects(written, found.model)
            and 'sine_response' in written.origin['ambiguous'][0])
    json.dumps(found.to_dict(), allow_nan=False)
    rate = next(curve for curve in found.curves if curve.along == 'rate')
    assert rms(rate.after / rate.deviation) < 2.0 < rms(rate.before / rate.deviation)


def test_of_the_recorded_table_the_sine_and_the_warm_scale_factor_are_named(data):
    found = diagnose_table(recorded_table(data), None)
    assert [members(finding)
            for finding in found.findings] == [{'sine_response', 'cubic_nonlinearity'},
                                               {'scale_factor_temperature'}]
    assert (found.gain.rate.before == pytest.approx(0.67 * DEGREE, rel=0.03)
            and found.gain.rate.after < 0.051 * DEGREE)
    assert '186 deg/s' in found.findings[0].separate_by
    # Errors of single rates, a fifth of the residual, fit neither an effect nor a polynomial.
    assert ([each.along for each in found.unexplained] == ['single_rates']
            and 0.15 < found.unexplained[0].share_of_variance < 0.25)


def test_of_the_recorded_table_a_polynomial_leaves_single_rates_alone(data):
    dwells = recorded_table(data)
    found = diagnose_table(dwells, fit_effects(dwells, [rate_temperature_polynomial(3, 2)]).model)
    assert not found.findings and [each.along for each in found.unexplained] == ['single_rates']
