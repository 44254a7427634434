# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Settings files: a valid one is read, a hostile one is refused at once, in one sentence."""

import math
import time

from gyro_calibration.model.settings_file import format_settings, read_settings
import numpy as np
import pytest

LAUGHS = 'a0: &a0 [ha, ha]\n' + ''.join(f'a{i + 1}: &a{i + 1} [*a{i}, *a{i}, *a{i}]\n'
                                        for i in range(40))

REFUSED = {
    'ten to the nineteenth laughs': (LAUGHS, 'line 1: an anchor or alias is not read'),
    'a call': ('a: !!python/object/apply:os.getcwd []', 'line 1: a tag is not read'),
    'twice the same': ('a: 1\nb: 2\na: 3', "line 3: 'a' is given twice; keep one of them"),
    'a list as name': ('? [1]\n: 2', 'a name is a list'),
    'deep': ('[' * 100_000, 'more than 10 levels'),
    'large': ('#' * 1_000_001, 'more than 1000000 bytes'),
    'two documents': ('a: 1\n---\nb: 1', 'another document'),
    'a zero byte': ('a: \0', 'not allowed'),
    'UTF-16': ('a: 1'.encode('utf-16'), 'utf-8'),
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


@pytest.mark.parametrize('content, message', REFUSED.values(), ids=REFUSED)
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
