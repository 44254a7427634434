# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The error of a full turn: by hand, against simulated turns, and as the program reports it."""

from dataclasses import replace
from functools import partial
import hashlib
import json
import math

from gyro_calibration.calibration.dwells import Dwells
from gyro_calibration.calibration.rate_table import compute_turn_errors
from gyro_calibration.heading.integration import integrate
from gyro_calibration.logs.log import DataRefused, DEGREE, Log, write_log
from gyro_calibration.model.compensation import compensate
from gyro_calibration.model.effects import BIAS, SCALE_FACTOR_ERROR, SINE_RESPONSE
from gyro_calibration.model.gyro_model import GyroModel, Term
from gyro_calibration.model.motion import motion_from_rates, simulate
from gyro_calibration.model.noise import Noise
import numpy as np
import pytest

TURN = 2.0 * math.pi


def table(rates, errors, temperature=None, sweep=None):
    """Return the dwells of a rate table from rates and errors in deg/s."""
    rate = np.array(rates, dtype=float) * DEGREE
    number = np.zeros(len(rate), dtype=int) if sweep is None else np.array(sweep)
    degc = None if temperature is None else np.array(temperature, dtype=float)
    return Dwells(rate, rate + np.array(errors) * DEGREE, degc, np.full(len(rate), np.nan), number,
                  tuple(f'row {place + 1}' for place in range(len(rate))))


# the published formulas, by hand

HAND = table([0.0, 10.0, -20.0], [0.1, 0.15, 0.06])


def test_a_turn_at_10_deg_s_takes_36_s_and_one_at_20_takes_18():
    errors = compute_turn_errors(HAND, HAND.rate + np.array([0.02, 0.03, 0.01]) * DEGREE)
    assert errors.static / DEGREE == pytest.approx([0.05 * 36.0, -0.04 * 18.0])
    assert errors.modelled / DEGREE == pytest.approx([0.01 * 36.0, -0.01 * 18.0])


def test_every_sweep_has_its_own_rest_and_one_without_takes_that_of_the_nearest_temperature():
    found = table([0, 10, 0, 10, 10], [0.1, 0.2, 0.5, 0.6, 0.6], [20, 21, 40, 41, 38],
                  [0, 0, 1, 1, 2])
    errors = compute_turn_errors(found, found.output)
    assert errors.static / DEGREE == pytest.approx([3.6, 3.6, 3.6])
    assert '1 of 3 sweeps have none' in errors.remarks[0]


@pytest.mark.parametrize('rates, said', [([10.0, 20.0, 30.0], 'record a rest'),
                                         ([0.0, 0.0, 3.0], 'none of 3 dwells turns at 5 deg/s')],
                         ids=['no rest', 'rests'])
def test_a_table_without_turns_or_a_rest_is_refused(rates, said):
    found = table(rates, [0.0] * 3)
    with pytest.raises(DataRefused, match=said):
        compute_turn_errors(found, found.output)


def test_a_gyro_that_is_upside_down_is_refused_with_the_way_out():
    with pytest.raises(DataRefused, match='the other way than the reference .* --invert'):
        compute_turn_errors(replace(HAND, output=-HAND.output), -HAND.output)


# a real turn

NOISE = Noise(angle_random_walk=5e-5)
GYRO = GyroModel((Term(BIAS, (0.004,)), Term(SCALE_FACTOR_ERROR, (0.01,)),
                  Term(SINE_RESPONSE, (0.3, 1.0))), noise=NOISE)
#: Its calibration has an error.
MODEL = GyroModel((Term(BIAS, (0.003,)), Term(SCALE_FACTOR_ERROR, (0.014,)),
                   Term(SINE_RESPONSE, (0.25, 1.0))))


@pytest.mark.parametrize('rate', [7.2, -12.0, 36.0, -90.0])
def test_a_simulated_turn_integrated_at_10_hz_is_off_by_as_much(rate):
    found = table([0.0, rate], [0.0, 0.0])
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
    found = table([0, 20, 0, 20, 20], [0.1, 0.3, 0.2, 0.4, 0.5], [20, 20, 30, 30, 21],
                  [0, 0, 1, 1, 2])
    rate = np.where(found.sweep == 0, np.nan, found.rate + 0.1 * DEGREE)
    errors = compute_turn_errors(found, rate)
    assert (errors.static / DEGREE == pytest.approx([0.2 * 18.0, 0.3 * 18.0])
            and errors.modelled == pytest.approx(0.0))
    assert '1 turns are left out' in errors.remarks[1]


# the program

def sweeps(deviation=0.0):
    """Return four sweeps with a bias of 0.2 deg/s and a scale factor error of 0.01."""
    rates = np.tile(np.arange(-60.0, 61.0, 10.0), 4)
    scatter = np.random.default_rng(5).normal(0.0, deviation, len(rates))
    return table(rates, 0.2 + 0.01 * rates + scatter, sweep=np.repeat(np.arange(4), 13))


@pytest.fixture
def run(run):
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


def test_the_data_hold_every_turn_in_si(run, log, model):
    code, text, _ = run(log, '--model', model, '--json')
    answer = json.loads(text)
    assert code == 0 and answer['turns'] == 48 == len(answer['rate_rad_s'])
    ways = np.sign(answer['rate_rad_s'])
    assert answer['static_rad_per_turn'] == pytest.approx(TURN * 0.01 * ways)
    assert answer['modelled_rad_per_turn'] == pytest.approx(TURN * (1.01 / 1.008 - 1.0) * ways)
    assert answer['ratio_rms'] == pytest.approx(0.01 / (1.01 / 1.008 - 1.0))
    assert (sum(each['turns'] for each in answer['by_rate'])
            == sum(each['turns'] for each in answer['by_temperature']) == 48)


@pytest.mark.parametrize(
    'origin, said', [('{}', 'if it was fitted to this log'),
                     ('{files: [{name: table.csv, sha256: THIS}]}', 'it was fitted to this log'),
                     ('{files: [{name: table.csv, sha256: 00ff}]}', '')])
def test_a_model_that_was_fitted_to_the_log_is_distinguished_from_others(
        run, log, model, origin, said):
    digest = hashlib.sha256(log.read_bytes()).hexdigest()
    model.write_text(model.read_text() + f'\norigin: {origin.replace("THIS", digest)}')
    remark = next(each for each in json.loads(run(log, '--model', model, '--json')[1])['remarks']
                  if 'the model is' in each)
    assert (('; ' in remark) == bool(said) and remark.count('errors of a fit') == bool(said)
            and f'; {said}' in remark + '; ')


def test_the_table_gives_degrees_and_per_cent_and_what_is_beyond_the_range_of_the_model(
        run, log, model):
    code, text, _ = run(log, '--model', model)
    row = next(line.split() for line in text.splitlines() if line.startswith('10 to '))
    assert code == 0 and [float(cell) for cell in row[4:8]] == [3.6, 1.0, 3.6, 1.0]
    assert '\nrate [deg/s]' in text and '\ntemperature [degC]' in text
    assert '24 of 52 dwells are beyond the calibrated rates' in text
    assert '26 of 52 dwells are outside the calibrated temperatures' in text


def test_without_a_model_one_is_fitted_that_has_not_seen_the_sweep(run, tmp_path):
    found = sweeps(0.01)
    write_log(tmp_path / 'table.csv', Log(output=found.output, reference_rate=found.rate))
    code, text, _ = run(tmp_path / 'table.csv', '--json')
    answer = json.loads(text)
    assert code == 0 and answer['left_out'] and answer['effects'] == ['bias', 'scale_factor_error']
    assert answer['temperature_degc'] is None and answer['by_temperature'] == []
    assert answer['modelled']['rms_rad_per_turn'] < 0.3 * answer['static']['rms_rad_per_turn']


def test_an_outlying_dwell_is_named_and_left_out(run, log, model, tmp_path):
    lines = log.read_text().splitlines()
    cells = lines[4].split(',')
    lines[4] = ','.join([str(float(cells[0]) + 1.0), *cells[1:]])
    (tmp_path / 'outlying.csv').write_text('\n'.join(lines))
    assert ('1 outlying dwells are left out: row 4'
            in run(tmp_path / 'outlying.csv', '--model', model)[1])


def test_a_model_that_looks_around_sees_the_surroundings_of_the_log(run, tmp_path):
    """By means of dwells alone, a supply that depends on the direction acts as an asymmetry."""
    (tmp_path / 'model.yaml').write_text(
        'effects: {supply_sensitivity: {supply_sensitivity: 0.01}}')
    time = np.cumsum([0, 10, 0.5, 20, 0.5, 20, 0.5, 10])
    motion = motion_from_rates(time, np.array([0, 0, 30, 30, -30, -30, 0, 0]) * DEGREE)
    log = simulate(GyroModel(), motion, 50.0, np.random.default_rng(2))
    supply = np.where(np.abs(log.time - 20.0) < 11.0, 6.0, 5.0)
    write_log(tmp_path / 'log.csv',
              replace(log, output=log.output + 0.01 * (supply - 5.0), supply=supply))
    answer = json.loads(run(tmp_path / 'log.csv', '--model', tmp_path / 'model.yaml', '--json')[1])
    assert (answer['static']['largest_rad_per_turn'] > 0.1
            and answer['modelled']['largest_rad_per_turn'] < 1e-9)
