# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The public names: same results as the command line, and a cheap import."""

from dataclasses import replace
import json
from pathlib import Path
import re
import subprocess
import sys

import gyro_calibration
from gyro_calibration import (
    allan, compensate, diagnose, fit, GyroModel, Log, read_log, read_model, self_calibrate,
    simulate, track, write_log, write_model)
from gyro_calibration.cli import plots
from gyro_calibration.model.motion import CALIBRATION_MOTION
import numpy as np
import pytest

ROOT = Path(gyro_calibration.__file__).parents[1]
GYRO = read_model(
    {'effects': {'bias': {'bias': 0.002}, 'scale_factor_error': {'scale_factor_error': 0.03}},
     'noise': {'angle_random_walk': 3e-4}})
NOISE = read_model({'effects': {}, 'noise': {'angle_random_walk': 3e-4}})


def run_and_rest():
    """Return the log of the built-in motion and of 10 s of rest after it."""
    return simulate(GYRO, (np.append(CALIBRATION_MOTION.time, 30.0),
                           np.append(CALIBRATION_MOTION.rate, 0.0)), seed=1)


@pytest.fixture(scope='module')
def run_model():
    """Return the model of a self-calibration by the built-in motion."""
    return self_calibrate(run_and_rest(), 'calibration', NOISE)


@pytest.mark.parametrize('value, words', [
    (np.nan, 'no output of the gyro'), (1e9, 'an implausible rate or temperature')])
def test_a_run_states_how_many_rows_were_not_used(run, tmp_path, value, words):
    log = run_and_rest()
    log.output[::2] = value
    sentence = f'{len(log.output[::2])} of {len(log)} rows have {words} and are not used.'
    assert sentence in str(self_calibrate(log, 'calibration', NOISE))
    write_log(tmp_path / 'log.csv', log)
    code, text, _ = run('self-calibrate', tmp_path / 'log.csv')
    assert code == 0 and sentence in text


@pytest.mark.parametrize('order', ['import gyro_calibration.allan.deviation; {}',
                                   '{}; import gyro_calibration.allan.deviation'])
def test_allan_is_a_function_and_a_folder_whichever_comes_first(order):
    program = order.format('from gyro_calibration import allan') + """
import gyro_calibration, gyro_calibration.allan.deviation as chart, numpy
from gyro_calibration.allan.deviation import allan_deviation
log = gyro_calibration.simulate(gyro_calibration.read_model(
    {'effects': {}, 'noise': {'angle_random_walk': 1e-3}}), 'rest', seed=1)
assert str(allan(log)) == str(gyro_calibration.allan(log)) and chart.allan_deviation
"""
    subprocess.run([sys.executable, '-c', program], check=True, timeout=120)


def test_importing_the_package_imports_neither_numpy_nor_scipy():
    program = 'import sys, gyro_calibration; assert not {"numpy", "scipy"} & set(sys.modules)'
    subprocess.run([sys.executable, '-c', program], check=True, timeout=60)


def test_no_other_name_is_public():
    assert gyro_calibration.__all__ == sys.modules['gyro_calibration.api'].__all__
    with pytest.raises(AttributeError, match='no_such_name'):
        _ = gyro_calibration.no_such_name
    assert (Path(gyro_calibration.__file__).parent / 'py.typed').exists()


def test_a_run_gives_what_the_command_line_gives(run_model, run, tmp_path):
    write_log(tmp_path / 'run.csv', run_and_rest())
    write_model(tmp_path / 'noise.yaml', NOISE)
    _, text, _ = run('self-calibrate', tmp_path / 'run.csv', '--model', tmp_path / 'noise.yaml',
                     '--profile', ROOT / 'config/motion_profile.csv', '--json')
    said = json.loads(text)
    assert run_model.scale_factor_error == pytest.approx(said['scale_factor_error'])
    assert run_model.bias == pytest.approx(said['bias'])
    assert run_model.bias_std == pytest.approx(said['bias_standard_deviation'])
    assert abs(run_model.scale_factor_error - 0.03) < 4.0 * run_model.scale_factor_error_std
    assert 'Scale factor error' in run_model._repr_html_()


def test_headings_are_those_of_the_command_line(run_model, run, tmp_path):
    drive = simulate(GYRO, 'robot', sample_rate=20.0, seed=2)
    write_log(tmp_path / 'drive.csv', drive)
    write_model(tmp_path / 'model.yaml', run_model.model)
    for found, words in ((compensate(drive, run_model.model), ()),
                         (track(drive, run_model.model, hindsight=True), ('--hindsight',))):
        run('compensate', tmp_path / 'drive.csv', '--model', tmp_path / 'model.yaml',
            '--out', tmp_path / 'out.csv', *words)
        wanted = np.array(read_log(tmp_path / 'out.csv').others['heading_rad'], float)
        assert np.allclose(found.heading, wanted, atol=1e-9)
        found.write(tmp_path / 'api.csv')
        assert (tmp_path / 'api.csv').read_text() == (tmp_path / 'out.csv').read_text()
    with pytest.raises(ValueError, match='angle random walk'):
        track(drive, GyroModel())


def test_every_answer_has_a_picture_with_a_unit_on_every_axis(run_model, run, tmp_path,
                                                              monkeypatch):
    pytest.importorskip('matplotlib', reason='matplotlib is not installed')
    figures, save = [], plots._save_figure
    monkeypatch.setattr(plots, '_save_figure',
                        lambda *given: figures.append(given[0]) or save(*given))
    log = simulate(GYRO, 'robot', sample_rate=20.0, seed=2)
    rate = np.tile(np.linspace(-1.0, 1.0, 21), 4)
    output = 1.01 * rate + 1e-4 * np.random.default_rng(1).standard_normal(len(rate))
    output[[20, 50]] += 0.1, -0.05
    table = Log(output=output, reference_rate=rate, temperature=np.repeat([0.0, 20.0, 40.0], 28))
    for answer in (run_model, compensate(log, run_model.model), fit(table),
                   fit(replace(table, temperature=None), effects=['bias', 'scale_factor_error']),
                   fit(Log(log.time, log.output, reference_heading=log.reference_heading)),
                   allan(simulate(NOISE, 'rest', seed=1))):
        answer.plot(tmp_path / 'picture.svg')
        assert (tmp_path / 'picture.svg').read_text().rstrip().endswith('</svg>')
    for each in table, replace(table, temperature=None):
        write_log(tmp_path / 'table.csv', each)
        code, _, error = run('turn', tmp_path / 'table.csv', '--picture', tmp_path / 'a.png')
        assert code == 0, error
    assert len(figures) == 8 and (tmp_path / 'a.png').stat().st_size > 10_000
    for figure in figures:
        assert figure.get_supxlabel().endswith('.'), 'a line says what to see'
        panels = [axes for axes in figure.axes if axes.get_label() != '<colorbar>']
        assert panels and all('[' in axes.get_ylabel() for axes in panels)
        assert all('[' in axes.get_xlabel() for axes in panels
                   if any(label.get_visible() for label in axes.get_xticklabels()))
        assert all('[' in axes.get_xlabel() + axes.get_ylabel() for axes in figure.axes)


def test_a_diagnosis_names_its_causes_writes_its_files_and_shows_its_report(tmp_path):
    rate = np.tile(np.linspace(-1.0, 1.0, 21), 6)
    output = rate + 0.02 * rate ** 3 + 1e-4 * np.random.default_rng(1).standard_normal(len(rate))
    log = Log(output=output, reference_rate=rate)
    assert repr(log) == '<Log: 126 rows of output, reference_rate>'
    found = diagnose(log)
    assert 'cubic_nonlinearity' in found.causes
    found.write(tmp_path)
    assert read_model(tmp_path / 'model.yaml').terms == found.model.terms
    assert repr(found.model).startswith('<GyroModel: ') and 'cubic_nonl' in repr(found.model)
    assert 'cubic nonlinearity' in found._repr_html_() and 'iframe srcdoc' in found._repr_html_()
    pytest.importorskip('matplotlib', reason='matplotlib is not installed')
    figure = found.plot(tmp_path / 'picture.png')
    assert 'rate [deg/s]' in [axes.get_xlabel() for axes in figure.axes]


@pytest.mark.parametrize(('call', 'sentence'), [
    (lambda log: fit(log, technology='x'), "technology is 'x', but must be of mems, "),
    (lambda log: fit(log, method='x'), "method is 'x', but must be of dwells, "),
    (lambda log: fit(log, effects=['x']), "effects is 'x', but must be of bias, "),
    (lambda log: diagnose(log, kind='x'), "kind is 'x', but must be of rate_command, "),
    (lambda log: self_calibrate(log, method='x'), "method is 'x', but must be of likelihood, "),
    (lambda log: fit(), 'None is no log; read_log(path) reads one'),
    (lambda log: fit([log]), 'is no log; read_log(path) reads one'),
    (lambda log: compensate('log.csv', GYRO), "'log.csv' is no log; read_log(path) reads one"),
    (lambda log: allan(Log([0.0, 0.5])), 'the log has no output of the gyro'),
    (lambda log: track(Log(output=[0.0, 0.1]), NOISE), 'the log has no time'),
    (lambda log: compensate(log, 'm.yaml'), "'m.yaml' is no model; read_model(path) reads one"),
    (lambda log: diagnose(log, model='m.yaml'), "'m.yaml' is no model"),
    (lambda log: simulate(GYRO, 5), '5 is no motion; wanted calibration, robot or rest, '),
    (lambda log: simulate(GYRO, ([0, 1], [0])), 'shapes time (2,), reference_rate (1,); wanted'),
    (lambda log: simulate(GYRO, sample_rate=0), 'sample_rate is 0; wanted a number of Hz'),
    (lambda log: simulate(GYRO, temperature=[1, 2]), 'temperature has the shape (2,); wanted'),
    (lambda log: fit(log), 'the gyro has a value in 3 of 3 samples; at least 100 are needed')])
def test_what_is_not_possible_is_refused_in_one_sentence_with_what_is(call, sentence):
    log = Log([0.0, 0.5, 1.0], [0.0, 0.1, 0.2], reference_heading=[0.0, 0.05, 0.1])
    with pytest.raises(ValueError, match=re.escape(sentence)):
        call(log)
