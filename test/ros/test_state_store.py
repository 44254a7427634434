# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The state files of a robot: what is read and kept, and reports on damaged or foreign files."""

import threading

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
    """Return what the table said to a bias at rest."""
    return memory.table.add(temperature, 0.001, 1e-9, NOW)


def test_nothing_stored_is_an_empty_model_and_no_trouble(remember):
    memory = remember()
    assert memory.model.self_calibration is None and not memory.table.entries
    assert memory.problem == memory.calibration_hint == memory.table_hint == ''


def test_what_is_kept_is_there_after_a_restart(remember):
    memory = remember()
    assert memory.store_calibration(SelfCalibration(0.01, 0.002)) == ''
    taught(memory)
    memory.store_table(NOW, is_final=True)
    assert memory.table_written_time == NOW
    again = remember()
    assert (again.model.self_calibration == SelfCalibration(0.01, 0.002)
            and len(again.table.entries) == 1)


def test_the_table_is_written_seldom_and_only_if_it_learned_something(remember, tmp_path):
    memory = remember()
    memory.store_table(NOW, is_final=True)
    assert not (tmp_path / 'biases.yaml').exists()
    taught(memory)
    memory.store_table(NOW)
    taught(memory, 35.0)
    memory.store_table(NOW + 0.9 * MIN_WRITE_INTERVAL)
    assert memory.table_written_time == NOW
    memory.store_table(NOW + 1.1 * MIN_WRITE_INTERVAL)
    assert memory.table_written_time == NOW + 1.1 * MIN_WRITE_INTERVAL


def test_a_damaged_table_is_reported_and_kept(remember, tmp_path):
    memory = remember(biases='entries: [')
    assert 'cannot be read' in memory.table_hint
    taught(memory)
    memory.store_table(NOW, is_final=True)
    assert ((tmp_path / 'biases.yaml.kept-1').read_text() == 'entries: ['
            and 'is now in' in memory.table_hint)


def test_a_folder_that_cannot_be_written_to_is_reported_and_not_tried_each_second(tmp_path):
    (tmp_path / 'file').write_text('')
    memory = StateStore('', tmp_path / 'calibration.yaml',
                        tmp_path / 'file' / 'biases.yaml', Prior())
    taught(memory)
    memory.store_table(NOW)
    assert 'cannot be written' in memory.table_hint and memory.table_written_time is None
    assert not memory.table.is_write_due(NOW + 1.0) and 'NOT STORED' not in memory.calibration_hint


def test_a_calibration_behind_another_model_is_not_used(remember):
    memory = remember(
        'effects: {bias: {bias: 0.1}}',
        calibration='effects: {}\nself_calibration: {scale_factor_error: 0.2, bias: 0.3}')
    assert (memory.model.self_calibration is None
            and 'belongs to another model' in memory.calibration_hint)


@pytest.mark.parametrize('of_model, of_calibration, used',
                         [('7', '7', True), ('7', '8', False), ('7', '', False), ('', '8', False)])
def test_a_calibration_of_another_gyro_is_not_used(remember, of_model, of_calibration, used):
    model, calibration = (f'effects: {{}}\ngyro: {{serial_number: "{number}"}}\n' if number
                          else 'effects: {}\n' for number in (of_model, of_calibration))
    memory = remember(
        model,
        calibration=f'{calibration}self_calibration: {{scale_factor_error: 0.2, bias: 0.3}}')
    assert (memory.model.self_calibration is not None) == used == (memory.calibration_hint == '')
    assert (used or f'and the model to {of_model or "one without"}; calibrate again'
            in memory.calibration_hint)


def test_without_a_model_that_can_be_read_nothing_is_learned(remember, tmp_path):
    memory = remember('effects: {bias: {bias:')
    assert memory.problem.startswith('uncalibrated: ')
    taught(memory)
    memory.store_table(NOW, is_final=True)
    assert not (tmp_path / 'biases.yaml').exists()


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


def test_of_two_that_write_at_the_same_moment_the_one_whose_content_is_lost_reports_it(remember):
    """Two threads keep calibrations in step; the one that is not in the file must report it."""
    memories, step, rounds = (remember(), remember()), threading.Barrier(3, timeout=20.0), 200

    def keep(memory, bias):
        for _ in range(rounds):
            step.wait()
            memory.store_calibration(SelfCalibration(0.01, bias))
            step.wait()
    writers = [threading.Thread(target=keep, args=(memory, bias))
               for memory, bias in zip(memories, (0.1, 0.2))]
    for writer in writers:
        writer.start()
    unknown = 0
    for _ in range(rounds):
        step.wait()
        step.wait()
        held = remember().model
        for memory in memories:
            memory.poll()
            unknown += memory.model != held and not memory.shared_hint
    for writer in writers:
        writer.join()
    assert unknown == 0
