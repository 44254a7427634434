# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The verb diagnose: what it prints and writes, and its messages where data do not suffice."""

from contextlib import redirect_stderr, redirect_stdout
import io
import json
import os

from diagnosed import log_of
from gyro_calibration.cli.main import main
from gyro_calibration.diagnosis.causes import CAUSES
from gyro_calibration.logs.log import write_log
from gyro_calibration.model.model_file import read_model
from gyro_calibration_bench.hidden import hide
import numpy as np
import pytest

FILES = {'diagnosis.json', 'report.html', 'model.yaml'}
SHORT = {'duration': 400.0, 'sample_rate': 10.0}


@pytest.fixture(scope='module')
def hidden():
    """Return a log in which a warm-up is hidden, with the truth."""
    return hide(['warm_up'], 8.0, np.random.default_rng(3), noise='white', **SHORT)[0]


@pytest.fixture(scope='module')
def diagnosed(hidden, tmp_path_factory):
    """Return the folder with that log, the findings, and the output of the program."""
    folder = tmp_path_factory.mktemp('diagnosed')
    write_log(folder / 'drive.csv', log_of(hidden))
    with redirect_stdout(io.StringIO()) as out, redirect_stderr(io.StringIO()) as errors:
        code = main(['diagnose', str(folder / 'drive.csv'), '--seed', '7',
                     '--out', str(folder / 'found')])
    return folder, (code, out.getvalue(), errors.getvalue())


@pytest.fixture
def log(hidden, tmp_path):
    """Return that log as the program reads it, and write it to drive.csv."""
    write_log(tmp_path / 'drive.csv', log_of(hidden))
    return log_of(hidden)


def test_the_files_hold_what_they_say(diagnosed):
    folder, (code, text, errors) = diagnosed
    assert code == 0 and 'warm up' in text and not errors
    assert set(os.listdir(folder / 'found')) == FILES
    found = json.loads((folder / 'found/diagnosis.json').read_text())
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
    model = read_model(folder / 'found/model.yaml')
    assert 'warm_up' in {term.effect.name for term in model.terms}
    assert model.origin['files'][0]['name'] == 'drive.csv'
    assert '<html' in (folder / 'found/report.html').read_text()


def test_a_seed_gives_the_same_answer_again_and_a_file_is_written_into_a_folder_alone(
        diagnosed, log, run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, text, _ = run('diagnose', 'drive.csv', '--seed', '7', '--json')
    again, found = (json.loads(each) for each in (
        text, (diagnosed[0] / 'found/diagnosis.json').read_text()))
    assert code == 0 and os.listdir() == ['drive.csv']
    assert {**again, 'logs': 0} == {**found, 'logs': 0}


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
    code, text, errors = run('diagnose', tmp_path / 'drive.csv', '--out', tmp_path / 'found')
    assert code != 0 and not text and errors.count('\n') == 1
    assert sorted(tmp_path.rglob('*')) == before
    assert taken != 'found' or (tmp_path / taken).read_text() == 'mine'
