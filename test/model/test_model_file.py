# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Model files, as settings files: a good one is read as written, a bad one is one sentence."""

import contextlib
from dataclasses import replace
import math
import time

from gyro_calibration.model.effects import CATALOGUE, rate_temperature_polynomial
from gyro_calibration.model.gyro_model import GyroModel, SelfCalibration, Term, Tolerance
from gyro_calibration.model.model_file import ModelError, read_model, write_model
from gyro_calibration.model.noise import Noise
from gyro_calibration.model.settings_file import format_settings, read_settings
import numpy as np
import pytest
import yaml

TERMS = (*(Term(effect, tuple(float(np.clip(0.5 if each.default is None else each.default,
                                            *each.bounds)) for each in effect.parameters))
           for effect in CATALOGUE.values()),
         Term(rate_temperature_polynomial(1, 1), (0.0, 1.7, 35.0, 10.0, 1e-3, 2e-3, 3e-4, 4e-5)))
FITTED = sum(len(term.fitted_indices) for term in TERMS)
FULL = GyroModel(TERMS, 1e-8 * np.diag(1.0 + np.arange(FITTED)), (-1.7, 1.7), (20.0, 50.0), 35.0,
                 Noise(7e-4, 9e-5, 1e-6), {'name': 'Köln', 'serial_number': '0012'},
                 {'files': ['a.csv'], 'date': '2024-05-01'},
                 SelfCalibration(0.0373, 2e-4, ((1e-8, 1e-10), (1e-10, 4e-8)),
                                 '2024-05-01T10:00:00+00:00', 31.5, 'likelihood'),
                 Tolerance(1e-5, 2e-4, 3e-5, 1e-4, 4e-3), {'bias_instability': (7e-5, 1.1e-4)})


def read(folder, text):
    path = folder / 'model.yaml'
    path.write_text(text)
    return read_model(path)


def test_a_file_written_by_hand_is_enough(tmp_path):
    model = read(tmp_path, 'effects: {bias: {bias: 0.01}}')
    assert (model.rate(0.5, 25.0) == 0.49 and model.covariance is None
            and model.self_calibration is None and model.tolerance == Tolerance())
    past = read(tmp_path, 'effects: {thermal_lag: {thermal_lag: 1e-4, time_constant: 120}, '
                          'thermal_hysteresis: {thermal_hysteresis: -2E-5}}')
    assert [term.values for term in past.terms] == [(120.0, 1e-4), (10.0, 1e-3, -2e-5)]
    assert past.needs_history and not model.needs_history
    assert past.rate(0.5, 25.0) == 0.5, 'without a history nothing lags'
    calibrated = read(tmp_path, 'effects: {}\nself_calibration: {scale_factor_error: 0.1, bias: '
                      '0.2, standard_deviations: {bias: 0.003, scale_factor_error: 0.002}}')
    assert calibrated.self_calibration.standard_deviations == pytest.approx((0.002, 0.003))


def test_a_model_is_read_back_as_it_was_written(tmp_path):
    write_model(tmp_path / 'model.yaml', FULL)
    again = read_model(tmp_path / 'model.yaml')
    for name, value in vars(FULL).items():
        if name == 'terms':
            assert [(each.effect.name, each.values) for each in again.terms] == [
                (each.effect.name, each.values) for each in value]
        else:
            assert np.all(getattr(again, name) == value), name
    shown = yaml.safe_load((tmp_path / 'model.yaml').read_text(encoding='utf-8'))
    assert shown['self_calibration']['standard_deviations'] == {
        'scale_factor_error': pytest.approx(1e-4), 'bias': pytest.approx(2e-4)}
    write_model(tmp_path / 'model.yaml', replace(FULL, tolerance=Tolerance()))
    assert 'tolerance' not in (tmp_path / 'model.yaml').read_text(encoding='utf-8')


BAD = {
    'a tolerance below zero': ('effects: {}\ntolerance: {bias: -1.0}', 'tolerance.bias is -1.0'),
    'empty': ('', 'the file is empty'),
    'no YAML': ('effects: {bias: {bias: 0.01}\nvalid: [', 'cannot be read as YAML (line 2: '),
    'a noise that vanishes when it is squared': (
        'effects: {}\nnoise: {angle_random_walk: 1.0e-300}', 'noise.angle_random_walk is 1e-300'),
    'other YAML': ('name: a robot\nwheels: 4\n', 'effects is empty'),
    'another format': ('format: a/b\neffects: {}\n', "format is 'a/b'"),
    'newer version': ('version: 2\neffects: {}',
                      'version is 2; wanted at most 1: install a newer'),
    'effects of text': ('effects: bias', "effects is 'bias'"),
    'unknown effect': ('effects: {magic: {magic: 1.0}}',
                       'an effect that this version knows, or one of your own '
                       '(--catalogue): bias'),
    'unknown value': ('effects: {bias: {bias: 1.0, bais: 2.0}}',
                      'effects.bias.bais is 2.0; wanted one of bias'),
    'nan': ('effects: {bias: {bias: .nan}}', 'effects.bias.bias is nan; wanted a finite number'),
    'an integer beyond all floats': ('effects: {bias: {bias: 1' + '0' * 400 + '}}',
                                     'effects.bias.bias'),
    'out of bounds': ('effects: {sine_response: {k: -1.0}}',
                      'effects.sine_response.k is -1.0; wanted 0.001 to 30 s'),
    'polynomial of order -1': ('effects: {rate_temperature_polynomial: {orders: [-1, 2]}}',
                               'the orders in rate and temperature'),
    'covariance too small': ('effects: {bias: {bias: 1.0}}\ncovariance: []',
                             '1 rows of 1 numbers'),
    'covariance with a stray number': ('effects: {bias: {bias: 1.0}}\ncovariance: [7, [1.0]]',
                                       '1 rows of 1 numbers'),
    'covariance not symmetric': ('effects: {}\nself_calibration: {scale_factor_error: 0, bias: 0, '
                                 'covariance: [[1, 0.5], [0, 1]]}',
                                 'symmetric'),
    'negative variance': ('effects: {bias: {bias: 1.0}}\ncovariance: [[-1.0]]',
                          'no negative variance'),
    'range upside down': ('effects: {}\nvalid: {rate: [1, -1]}', 'in this order'),
    'negative noise': ('effects: {}\nnoise: {angle_random_walk: -1}',
                       'noise.angle_random_walk is -1; wanted a finite number of at'),
    'unknown noise': ('effects: {}\nnoise: {pink: 1}', 'noise.pink'),
    'scale of zero': ('effects: {}\nself_calibration: {scale_factor_error: -1.0, bias: 0}',
                      'self_calibration.scale_factor_error is -1.0'),
    'polynomial of 100 rows': ('effects: {rate_temperature_polynomial: {matrix_dps: ['
                               + '[1],' * 100 + ']}}', 'up to order 20'),
    'beyond what a gyro has': ('effects: {bias: {bias: 1e300}}', 'effects.bias.bias is 1e+300'),
}


@pytest.mark.parametrize('text, message', BAD.values(), ids=BAD)
def test_a_bad_file_is_refused_in_one_sentence_with_file_place_and_remedy(tmp_path, text, message):
    with pytest.raises(ModelError) as refused:
        read(tmp_path, text)
    sentence = str(refused.value)
    assert sentence.startswith(str(tmp_path / 'model.yaml')) and message in sentence
    assert (('wanted' in sentence or 'calibrate again' in sentence) and '\n' not in sentence
            and len(sentence) < 800)


def test_a_calibration_cut_off_within_a_number_is_refused(tmp_path):
    path, stored = tmp_path / 'model.yaml', SelfCalibration(0.0125, 9.3e-6, ((1e-9, 0), (0, 2e-9)))
    write_model(path, GyroModel(self_calibration=stored))
    data, found = path.read_bytes(), []
    for end in range(len(data) + 1):
        path.write_bytes(data[:end])
        with contextlib.suppress(ModelError):
            found.append(read_model(path).self_calibration)
    values = {(each.scale_factor_error, each.bias) for each in found if each}
    assert found[-1] == stored and values == {(0.0125, 9.3e-6)}


# Settings files, which model files and others are

LAUGHS = 'a0: &a0 [ha, ha]\n' + ''.join(f'a{i + 1}: &a{i + 1} [*a{i}, *a{i}, *a{i}]\n'
                                        for i in range(40))

UNSAFE = {
    'ten to the nineteenth laughs': (LAUGHS, 'line 1: an anchor or alias is not read'),
    'a call': ('a: !!python/object/apply:os.getcwd []', 'line 1: a tag is not read'),
    'twice the same': ('a: 1\nb: 2\na: 3', "line 3: 'a' is given twice; keep one of them"),
    'a list as name': ('? [1]\n: 2', 'a name is a list'),
    'deep': ('[' * 100_000, 'more than 10 levels'),
    'large': ('#' * 1_000_001, 'more than 1000000 bytes'),
    'two documents': ('a: 1\n---\nb: 1', 'another document'),
    'a zero byte': ('a: \0', 'not allowed'),
    'Latin-1': ('a: größe'.encode('latin-1'), 'utf-8'),
    'half a line': ('a: {b: 1', 'line 1: '),
    'a tab': ('a:\n\tb: 1', 'line 2: '),
}


def written(folder, content):
    path = folder / 'settings.yaml'
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@pytest.fixture(scope='module')
def allowed_time(tmp_path_factory):
    """Return ten times the CPU time that a good file of 20 000 values takes, s."""
    path, before = written(tmp_path_factory.mktemp('good'), '- 1\n' * 20_000), time.process_time()
    assert len(read_settings(path)) == 20_000
    return 10.0 * (time.process_time() - before)


@pytest.mark.parametrize('content, message', UNSAFE.values(), ids=UNSAFE)
def test_what_is_no_file_of_settings_is_refused_in_a_line_and_soon(
        tmp_path, content, message, allowed_time):
    path, before = written(tmp_path, content), time.process_time()
    with pytest.raises(ValueError) as refused:
        read_settings(path)
    assert (message in str(refused.value) and '\n' not in str(refused.value)
            and len(str(refused.value)) < 300)
    assert time.process_time() - before < allowed_time


@pytest.mark.parametrize('text, value', [
    ('1e-4', 1e-4), ('-2E+5', -2e5), ('.5', 0.5), ('1.', 1.0), ('010', 10), ('-.inf', -math.inf),
    ('true', True), ('', None), ('~', None), ('yes', 'yes'), ('2026-11-21', '2026-11-21'),
    ('2024-13-45', '2024-13-45'), ('0x10', '0x10'), ('1_0', '1_0'), ('1:30', '1:30'), ('<<', '<<'),
    ('"1"', '1'), ('9' * 401, '9' * 401), ('9' * 400, 10 ** 400 - 1)])
def test_a_value_is_what_a_person_takes_it_for(tmp_path, text, value):
    found = read_settings(written(tmp_path, f'\ufeffa: {text}'))['a']  # hides no name
    assert found == value and type(found) is type(value)


def test_texts_are_read_back_whatever_they_look_like(tmp_path):
    content = {'texts': ['1e4', '010', '09', '1.5e3', 'null', '', 'true', 'yes', '<<', '=', '*a',
                         '&a', '!!int', 'a\nb', '\x85', '\u2028', '😀', ' x ', '#', '1:30',
                         '2026-11-21', "it's", '9' * 500],
               '010': 1e-7, 'yes': [[], {}, None, True, -1, 1e22]}
    content['again'] = content['texts']
    assert read_settings(written(tmp_path, format_settings(content))) == content


def test_numbers_of_numpy_are_written_as_those_of_python(tmp_path):
    content = {'a': [np.float64(1e-7), np.float32(0.5), np.longdouble(2.0), np.int64(3), np.True_]}
    assert read_settings(written(tmp_path, format_settings(content))) == {
        'a': [1e-7, 0.5, 2.0, 3, True]}
    with pytest.raises(ArithmeticError):
        format_settings({'a': np.float64(math.nan)})
