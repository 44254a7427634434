# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The state files of a robot: what is read, kept and reported, through kills and without room."""

import itertools
import os
import signal
import sys

from gyro_calibration import files
from gyro_calibration.heading.bias_table import MIN_WRITE_INTERVAL, Prior
from gyro_calibration.model.gyro_model import SelfCalibration
from gyro_calibration.ros.state_store import StateStore
import pytest

NOW = 1.7e9


@pytest.fixture
def remember(tmp_path):
    def remember(model='', **files):
        if model:
            (tmp_path / 'model.yaml').write_text(model)
        for name, text in files.items():
            (tmp_path / f'{name}.yaml').write_text(text)
        return StateStore(str(tmp_path / 'model.yaml') if model else '',
                          tmp_path / 'calibration.yaml', tmp_path / 'biases.yaml', Prior())
    return remember


def taught(memory, temperature=25.0):
    return memory.table.add(temperature, 0.001, 1e-9, NOW)


def test_what_is_kept_is_there_after_a_restart(remember):
    memory = remember()
    assert memory.model.self_calibration is None and not memory.table.entries
    assert memory.problem == memory.calibration_hint == memory.table_hint == ''
    assert memory.store_calibration(SelfCalibration(0.01, 0.002)) == ''
    taught(memory)
    memory.store_table(NOW, is_final=True)
    assert memory.table_written_time == NOW
    again = remember()
    assert (again.model.self_calibration == SelfCalibration(0.01, 0.002)
            and len(again.table.entries) == 1)


@pytest.mark.parametrize('model, words', [
    ('effects: {scale_factor_error: {scale_factor_error: -1.0}}', 'is -1.0; wanted at most 0.3'),
    ('effects: {scale_factor_error: {scale_factor_error: 3.7356}}', 'a fraction, not in %'),
    ('effects: {}\nself_calibration: {scale_factor_error: 0.0, bias: -1.2}', 'is -1.2; wanted'),
    ('effects: {bias: {bias: 1.2}}', 'effects.bias.bias is 1.2; wanted at most 0.1745'),
    ('effects: {}\nnoise: {angle_random_walk: 2.5}', 'noise.angle_random_walk is 2.5; wanted SI'),
    ('effects: {}\nnoise: {bias_instability: 9.0}', 'unknown within 1 s'),
    ('effects: {}\nnoise: {rate_random_walk: 1.0}', 'unknown within 1 s'),
    ('effects: {scale_factor_error: {scale_factor_error: -0.3}, bias: {bias: 0.17}}\n'
     'noise: {angle_random_walk: 0.1, bias_instability: 0.1, rate_random_walk: 0.1}', '')])
def test_a_model_by_which_no_gyro_can_be_compensated_is_a_problem(remember, model, words):
    memory = remember(model)
    assert words in memory.problem and bool(words) == bool(memory.problem)
    assert bool(words) == (not memory.model.terms), 'the rates are uncalibrated'


def test_the_table_is_written_seldom_and_only_if_it_learned_something(remember, tmp_path):
    memory = remember()
    memory.store_table(NOW, is_final=True)
    assert not (tmp_path / 'biases.yaml').exists()
    taught(memory)
    # time, whether it learned another bias since, whether it ends, when it was written last
    for temperature, (later, learned, ends, written) in enumerate([
            (0.0, False, False, 0.0), (MIN_WRITE_INTERVAL, False, True, 0.0),
            (60.0, True, False, 0.0), (MIN_WRITE_INTERVAL - 1.0, False, False, 0.0),
            (MIN_WRITE_INTERVAL, False, False, MIN_WRITE_INTERVAL),
            (MIN_WRITE_INTERVAL + 60.0, True, True, MIN_WRITE_INTERVAL + 60.0),
            (0.0, True, False, 0.0)]):  # a clock that was set back
        if learned:
            taught(memory, 30.0 + 5.0 * temperature)
        memory.store_table(NOW + later, is_final=ends)
        assert memory.table_written_time == NOW + written, later


def test_a_folder_that_cannot_be_written_to_is_reported_and_not_tried_each_second(tmp_path):
    (tmp_path / 'file').write_text('')
    memory = StateStore('', tmp_path / 'calibration.yaml',
                        tmp_path / 'file' / 'biases.yaml', Prior())
    taught(memory)
    memory.store_table(NOW)
    assert 'cannot be written' in memory.table_hint and memory.table_written_time is None
    assert not memory.table.is_write_due(NOW + 1.0) and 'NOT STORED' not in memory.calibration_hint
    memory = StateStore('', tmp_path / 'file' / 'calibration.yaml', tmp_path / 'biases.yaml',
                        Prior())
    assert memory.store_calibration(SelfCalibration(0.01)).startswith(
        'the calibration is in use but NOT STORED')
    assert memory.model.self_calibration == SelfCalibration(0.01)


STORED = '\nself_calibration: {scale_factor_error: 0.2, bias: 0.1}\n'
SEVEN, EIGHT = (f'gyro: {{serial_number: "{number}"}}' for number in '78')
ONE, OTHER = 'effects: {}\n', 'effects: {bias: {bias: 0.1}}\n'


@pytest.mark.parametrize('model, calibration, hint', [
    (ONE + SEVEN, ONE + SEVEN + STORED, ''),
    (ONE + SEVEN, ONE + EIGHT + STORED, 'and the model to 7; calibrate again'),
    (ONE + SEVEN, ONE + STORED, 'and the model to 7; calibrate again'),
    (ONE, ONE + EIGHT + STORED, 'and the model to (none); calibrate again'),
    (OTHER, ONE + STORED, 'belongs to another model'),
    (ONE, ONE + STORED.replace('0.1', '3.0'), 'self_calibration.bias is 3.0; wanted at most 0.17'),
    ('', ONE + STORED.replace('0.2', '0.9'), 'scale_factor_error is 0.9; wanted at most 0.3'),
    ('', ONE, 'the file has none'), (ONE + STORED, ONE, 'the file has none'),
    ('', '\n', 'the file'),
    ('', ONE + 'self_calibration:\n  scale_factor_error: 0.1\n', 'self_calibration.bias')])
def test_a_calibration_that_cannot_be_used_is_reported_and_that_of_the_model_is_kept(
        remember, model, calibration, hint):
    memory = remember(model, calibration=calibration)
    assert bool(hint) == bool(memory.calibration_hint) == ('calibrate again'
                                                           in memory.calibration_hint)
    assert hint in memory.calibration_hint
    assert (memory.model.self_calibration is None) == (bool(hint) and STORED not in model)


@pytest.mark.parametrize('model, calibration', [(ONE + SEVEN, ONE + EIGHT + STORED),
                                                (OTHER, ONE + STORED), ('', 'of somebody else')])
def test_a_calibration_that_cannot_be_used_is_kept_when_the_next_one_is_stored(
        remember, tmp_path, model, calibration):
    memory, old = remember(model, calibration=calibration), tmp_path / 'calibration.yaml.kept-1'
    assert memory.store_calibration(SelfCalibration(0.01)).endswith(f'is now in {old}')
    assert memory.store_calibration(SelfCalibration(0.02)) == '' == memory.calibration_hint
    assert old.read_text() == calibration
    assert remember(model).model.self_calibration == SelfCalibration(0.02)


def test_without_a_model_that_can_be_read_nothing_is_learned(remember, tmp_path):
    memory = remember('effects: {bias: {bias:')
    assert memory.problem.startswith('uncalibrated: ')
    taught(memory)
    memory.store_table(NOW, is_final=True)
    assert not (tmp_path / 'biases.yaml').exists()


def is_killed_at(number, write):
    """Write in a child, and kill it before a line of files.py by its number in the run."""
    child = os.fork()
    if not child:
        lines = itertools.count()

        def trace(frame, *_):
            if frame.f_code.co_filename != files.__file__:
                return None
            if next(lines) == number:
                os.kill(os.getpid(), signal.SIGKILL)
            return trace
        sys.settrace(trace)
        write()
        os._exit(0)
    return os.WIFSIGNALED(os.waitpid(child, 0)[1])


def test_a_kill_at_any_line_leaves_the_old_file_or_the_new_one(remember, tmp_path):
    memory, found = remember(ONE), []
    memory.store_calibration(SelfCalibration(0.01, 1e-3))
    old = (tmp_path / 'calibration.yaml').read_bytes()
    while is_killed_at(len(found), lambda: memory.store_calibration(SelfCalibration(0.02, 1e-3))):
        found.append((tmp_path / 'calibration.yaml').read_bytes())
        (tmp_path / 'calibration.yaml').write_bytes(old)
    new = (tmp_path / 'calibration.yaml').read_bytes()
    assert new != old and set(found) == {old, new}


def test_what_another_node_writes_to_the_same_file_is_reported_until_this_one_writes(remember):
    first, second = remember(), remember()
    first.poll()
    assert not first.shared_hint
    second.store_calibration(SelfCalibration(0.01, 0.02))
    first.poll()
    second.poll()
    assert 'was written by another process' in first.shared_hint and not second.shared_hint
    first.store_calibration(SelfCalibration(0.01, 0.03))
    assert not first.shared_hint
