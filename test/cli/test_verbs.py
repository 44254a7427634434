# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The verbs fit and diagnose, as people and other programs call them."""

import json
import os
from pathlib import Path
import shutil

from conftest import strict
from diagnosed import log_of
from gyro_calibration.diagnosis.causes import CAUSES
from gyro_calibration.logs.log import DEGREE, Log, write_log
from gyro_calibration.model.gyro_model import GyroModel
from gyro_calibration.model.model_file import read_model
from gyro_calibration_bench.hidden import hide
import numpy as np
import pytest
from recovery import SINE, Table


def write(path, dwells):
    write_log(path, Log(output=dwells.output, reference_rate=dwells.rate,
                        temperature=dwells.temperature,
                        others={'sweep': tuple(map(str, dwells.sweep.tolist()))}))
    return path


@pytest.fixture
def table(tmp_path):
    return write(tmp_path / 'table.csv',
                 Table().measure(GyroModel(SINE), np.random.default_rng(1)))


def test_the_default_gives_a_model_that_compensates(run, table, tmp_path):
    code, text, _ = run('fit', table, '--technology', 'open_loop_fog', '--out',
                        tmp_path / 'model.yaml', '--name', 'bench')
    assert code == 0 and 'sine_response k' in text
    assert 'what the physics of open_loop_fog gives' in ' '.join(text.split())
    model = read_model(tmp_path / 'model.yaml')
    assert model.gyro == {'name': 'bench', 'technology': 'open_loop_fog'}
    assert model.origin['files'][0]['name'] == 'table.csv'
    truth = GyroModel(SINE)
    assert model.rate(truth.output(1.5, 30.0), 30.0) == pytest.approx(1.5, abs=0.02 * DEGREE)


def test_a_model_that_lacks_an_effect_is_reported(run, table):
    code, text, _ = run('fit', table, '--effects', 'bias,scale_factor_error')
    assert code == 0 and 'the model lacks an effect' in ' '.join(text.split())


def test_a_residual_above_the_noise_of_dwells_whose_rates_occur_once_is_reported(run, tmp_path):
    """An asymmetry, in dwells of 12 s, that so few dwells do not show beside their scatter."""
    generator = np.random.default_rng(2)
    rate = np.repeat([0.0, -50.0, -20.0, 20.0, 50.0, 0.0], 600)
    path, output = tmp_path / 'log.csv', rate + 0.001 * np.abs(rate)
    write_log(path, Log(np.arange(3600) / 50.0, DEGREE * (
        output + 0.02 * generator.standard_normal(3600)), reference_rate=DEGREE * rate))
    for words, is_reported in ((('--effects', 'bias,scale_factor_error'), True),
                               (('--effects', 'bias,scale_factor_error,scale_factor_asymmetry'),
                                False)):
        remarks = strict(run('fit', path, '--json', *words)[1])['remarks']
        assert any('times the noise within the dwells' in each
                   for each in remarks) == is_reported, remarks


def test_three_speeds_in_counts_give_scale_and_bias(run, tmp_path):
    # the record player of the blog, an L3G4200D at 70 mdps a count, turned clockwise
    (tmp_path / 'player.csv').write_text(
        'reference_rate_dps,gyro_counts\n0,2.5654\n200,-2854.5\n270,-3857.9\n')
    words = ['fit', tmp_path / 'player.csv', '--sensitivity', '0.07', '--invert', '--json']
    code, text, _ = run(*words)
    effects = strict(text)['effects']
    assert code == 0 and effects['scale_factor_error'][
        'scale_factor_error']['estimate'] == pytest.approx(6.65e-4, rel=1e-2)
    low, high = effects['bias']['bias']['ci95']
    assert low < -2.5654 * 0.07 * DEGREE < high


def fit_rates(run, path, rate):
    """Return the answer to a log at 100 Hz with a reference rate, deg/s; the gyro has 2 %."""
    output = 0.5 + 1.02 * rate + 0.1 * np.random.default_rng(2).standard_normal(len(rate))
    write_log(path, Log(np.arange(len(rate)) / 100.0, DEGREE * output,
                        reference_rate=DEGREE * rate))
    code, text, _ = run('fit', path, '--json')
    answer = strict(text)
    low, high = answer['effects']['scale_factor_error']['scale_factor_error']['ci95']
    assert code == 0 and low < 0.02 < high and high - low < 0.01
    return answer


def test_three_steady_speeds_in_a_log_in_time_give_scale_and_bias(run, tmp_path):
    answer = fit_rates(run, tmp_path / 'log.csv', np.repeat([0.0, 200.0, 270.0], 3000))
    assert answer['method'] == 'dwells' and answer['dwells'] == 3


@pytest.mark.parametrize('rests', [0, 2])
def test_a_reference_rate_that_is_never_steady_is_integrated(run, tmp_path, rests):
    time = np.arange(9000) / 100.0
    rate = 60.0 * np.sin(0.6 * time) * np.sin(0.2 * time) + 30.0 * np.sin(2.3 * time)
    if rests:
        rate[(time < 5.0) | (time > 85.0)] = 0.0
    answer = fit_rates(run, tmp_path / 'log.csv', rate)
    assert answer['method'] == 'likelihood' and 'the rate is integrated' in answer['remarks'][0]
    low, high = answer['effects']['bias']['bias']['ci95']
    assert low < 0.5 * DEGREE < high < 0.6 * DEGREE


def test_tables_in_several_files_are_one_calibration(run, tmp_path):
    generator = np.random.default_rng(3)
    paths = [write(tmp_path / f'{degc}.csv',
                   Table(sweeps=1, temperatures=(degc, degc)).measure(GyroModel(SINE), generator))
             for degc in (20.0, 35.0, 50.0)]
    code, text, _ = run('fit', *paths, '--json')
    answer = strict(text)
    assert code == 0 and answer['sweeps'] == 3 and 'scale_factor_temperature' in answer['effects']


def test_of_several_logs_the_one_without_a_reference_is_named(run, table, tmp_path):
    (tmp_path / 'rest.csv').write_text('time_s,gyro_dps\n0,0.1\n1,0.2\n')
    code, _, error = run('fit', table, tmp_path / 'rest.csv')
    assert code == 1 and 'rest.csv: the log has no time or no reference' in error


def test_a_gyro_that_counts_clockwise_is_not_fitted(run, tmp_path):
    path, time = tmp_path / 'log.csv', np.arange(0.0, 60.0, 0.05)
    write_log(path, Log(time, -np.sin(0.3 * time) + np.tile([1e-3, -1e-3], 600),
                        reference_heading=np.cos(0.3 * time) / -0.3))
    code, text, error = run('fit', path)
    assert code == 1 and not text and 'give or omit --invert' in error
    assert run('fit', path, '--invert')[0] == 0


def test_an_outlying_dwell_is_named(run, tmp_path):
    dwells = Table().measure(GyroModel(SINE), np.random.default_rng(1))
    dwells.output[30] += 1.0 * DEGREE
    code, text, _ = run('fit', write(tmp_path / 'table.csv', dwells))
    assert code == 0 and '1 outlying, not fitted: row 31 (+' in text


def test_as_many_values_as_dwells_are_fitted_but_nothing_says_how_sure_they_are(run, tmp_path):
    dwells = Table(sweeps=3, rates=4).measure(GyroModel(SINE), np.random.default_rng(1))
    path = write(tmp_path / 'table.csv', dwells)
    code, text, _ = run('fit', path, '--polynomial', '3,2')
    assert code == 0 and 'nan' not in text
    assert 'standard deviations are unknown: add dwells' in ' '.join(text.split())
    assert strict(run('fit', path, '--polynomial', '3,2', '--json')[1])['covariance'] is None


@pytest.mark.parametrize('words, code, said', [
    (['--polynomial', '3,0'], 1, '2 dwells do not determine 4 values'),
    (['--effects', 'bias,charm'], 2, "'charm' is no effect that dwells"),
    (['--polynomial', '3'], 2, 'is not two orders'),
    (['--polynomial', '3,2', '--effects', 'bias'], 2, 'not allowed with'),
    (['--method', 'likelihood'], 1, 'no reference over time')])
def test_what_does_not_work_ends_with_one_sentence(run, tmp_path, words, code, said):
    (tmp_path / 'table.csv').write_text('reference_rate_dps,gyro_dps\n0,0.1\n10,10\n')
    ended, text, error = run('fit', tmp_path / 'table.csv', *words, '--out', tmp_path / 'a.yaml')
    assert ended == code and not text and said in error and 'Traceback' not in error
    assert not (tmp_path / 'a.yaml').exists()


# The verb diagnose: what it prints and writes

SHORT = {'duration': 400.0, 'sample_rate': 10.0}


@pytest.fixture
def log(tmp_path, monkeypatch):
    """Write a log in which a warm-up is hidden to drive.csv, in the folder of the test."""
    monkeypatch.chdir(tmp_path)
    hidden = hide(['warm_up'], 8.0, np.random.default_rng(3), noise='white', **SHORT)[0]
    write_log('drive.csv', log_of(hidden))


def test_the_files_hold_what_they_say_and_a_seed_gives_the_same_answer_again(log, run):
    code, text, errors = run('diagnose', 'drive.csv', '--seed', '7', '--out', 'found')
    assert code == 0 and 'warm up' in text and not errors
    assert set(os.listdir('found')) == {'diagnosis.json', 'report.html', 'model.yaml'}
    found = json.loads(Path('found/diagnosis.json').read_text())
    assert found['schema'] == 'gyro_calibration/diagnosis/2'
    assert found['verdict'] == 'extended' and found['false_alarm_rate'] == 0.01
    finding, = found['findings']
    assert finding['effect'] == 'warm_up' and found['unexplained'] == []
    assert finding['cause'].endswith('.') and 0.0 <= finding['p_value'] <= 1.0
    assert finding['minimum_detectable'] is None or finding['minimum_detectable'] > 0.0
    assert set(finding['ambiguous_with']) <= set(CAUSES) - {finding['effect']}
    assert bool(finding['ambiguous_with']) <= bool(finding['separate_by'])
    for value in finding['parameters'].values():
        low, high = value['ci95']
        assert low <= value['estimate'] <= high and value['unit']
    assert set(found['noise']) == {'angle_random_walk', 'bias_instability', 'rate_random_walk'}
    gain = found['gain']
    assert gain['held_out'] and gain['heading_rms']['window_s'] == 60
    for name in ('rate_rms', 'heading_rms'):
        low, high = gain[name]['ci95']
        assert gain[name]['after'] < gain[name]['before'] and low <= high
    model = read_model('found/model.yaml')
    assert 'warm_up' in {term.effect.name for term in model.terms}
    assert model.origin['files'][0]['name'] == 'drive.csv'
    assert '<html' in Path('found/report.html').read_text()
    shutil.rmtree('found')
    again = json.loads(run('diagnose', 'drive.csv', '--seed', '7', '--json')[1])
    assert again == found and os.listdir() == ['drive.csv'], 'files are written on request alone'


def test_several_logs_of_a_gyro_are_one_diagnosis(run, tmp_path):
    names = ['first.csv', 'second.csv']
    for name, log in zip(names, hide(['warm_up'], 8.0, np.random.default_rng(3), noise='white',
                                     runs=2, **SHORT)):
        write_log(tmp_path / name, log_of(log))
    code, text, errors = run('diagnose', *(tmp_path / name for name in names), '--json')
    assert code == 0, errors
    answer = json.loads(text)
    assert [name.rpartition('/')[2] for name in answer['logs']] == names
    assert [finding['effect'] for finding in answer['findings']] == ['warm_up']


@pytest.mark.parametrize('taken', ['found', 'found/model.yaml'], ids=['folder', 'file'])
def test_where_the_folder_or_one_file_cannot_be_written_nothing_is(taken, log, run, tmp_path):
    if taken == 'found':
        (tmp_path / taken).write_text('mine')
    else:
        (tmp_path / taken).mkdir(parents=True)
    before = sorted(tmp_path.rglob('*'))
    code, text, errors = run('diagnose', 'drive.csv', '--out', 'found')
    assert code != 0 and not text and errors.count('\n') == 1
    assert sorted(tmp_path.rglob('*')) == before
    assert taken != 'found' or (tmp_path / taken).read_text() == 'mine'
