# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Files of a robot, through kills at any moment and a full disk: the old file or the new one."""

import json
import os
from pathlib import Path
import resource
import subprocess
import sys
from types import SimpleNamespace

from gyro_calibration.files import open_replacement, remove_leftovers, write_atomically
from gyro_calibration.model.model_file import read_model
from gyro_calibration.ros.calibration_session import REST
import pytest
from rig import rested


@pytest.mark.parametrize('kills', [60, pytest.param(500, marks=pytest.mark.evidence)])
def test_kills_leave_the_old_files_or_the_new_ones(tmp_path, kills):
    """A process writes what the node writes, with the same code."""
    command = [sys.executable, Path(__file__).parents[1] / 'killed_writer.py', tmp_path,
               str(kills)]
    found = json.loads(
        subprocess.run(command, check=True, capture_output=True, timeout=300).stdout)
    assert found['torn'] == 0 and found['hints'] == ''
    assert min(*found['old'], *found['new'], found['half_written']) > kills / 50, (
        f'kills too early or too late: {found}')
    assert found['left'] == ['biases.yaml', 'calibration.yaml']


def test_what_a_killed_writer_left_is_removed_and_what_is_being_written_is_not(tmp_path):
    path = tmp_path / 'model.yaml'
    (tmp_path / '.model.yaml.abcd1234').write_text('half')
    (tmp_path / '.model.yaml.swp').write_text('of an editor')
    (tmp_path / '.other.yaml.abcd1234').write_text('of another file')
    with open_replacement(path) as file:
        file.write(b'new')
        write_atomically(path, b'of another process, in between')
        remove_leftovers(path)
    assert path.read_bytes() == b'new'
    assert sorted(os.listdir(tmp_path)) == ['.model.yaml.swp', '.other.yaml.abcd1234',
                                            'model.yaml']


class Disk:
    """A small disk that can be filled, or, without one, a limit to the files of a process."""

    def __init__(self, folder):
        self.folder, self.process = folder, None
        self.is_mounted = subprocess.run(['mount', '-t', 'tmpfs', '-o', 'size=64k', 'tmpfs',
                                          folder], capture_output=True).returncode == 0

    def fill(self):
        """Leave no room."""
        if not self.is_mounted:
            resource.prlimit(self.process.pid, resource.RLIMIT_FSIZE, (0, resource.RLIM_INFINITY))
            return
        with open(self.folder / 'ballast', 'wb', buffering=0) as file:
            try:
                while True:
                    file.write(bytes(256))
            except OSError:
                pass

    def free(self):
        """Make room again."""
        if self.is_mounted:
            (self.folder / 'ballast').unlink()
        else:
            resource.prlimit(self.process.pid, resource.RLIMIT_FSIZE,
                             (resource.RLIM_INFINITY, resource.RLIM_INFINITY))


@pytest.fixture
def disk(tmp_path):
    """Return a `Disk`; skip where neither way works."""
    folder = tmp_path / 'disk'
    folder.mkdir()
    disk = Disk(folder)
    if not disk.is_mounted and not hasattr(resource, 'prlimit'):
        pytest.skip('a disk can be filled neither by mounting a small one (that takes root) nor '
                    'by prlimit (Linux has it)')
    yield disk
    if disk.is_mounted:
        subprocess.run(['umount', '-l', folder], check=True)


def test_on_a_full_disk_the_calibration_is_used_and_written_when_there_is_room(disk, tmp_path):
    """As the node does it, in this process."""
    disk.process = SimpleNamespace(pid=os.getpid())
    calibration, biases = disk.folder / 'calibration.yaml', disk.folder / 'calibration_biases.yaml'
    rig = rested(tmp_path, calibration_file=calibration)

    def calibrated(bias):
        rig.robot.bias = bias
        return rig.calibrate(REST)
    assert calibrated(0.01)[0]
    old = calibration.read_bytes()
    disk.fill()
    success, message = calibrated(0.02)
    assert success and 'NOT STORED' in message and f'make room in {disk.folder}' in message
    assert rig.pipeline.store.calibration_hint.startswith(
        'the calibration is in use but NOT STORED')
    for _ in range(3000):  # rests, with a temperature, teach the table of biases
        rig.pipeline.add_temperature(max(rig.truth), 25.0)
        rig.step()
    rig.pipeline.run_periodic_tasks(is_final=True)
    assert 'cannot be written' in rig.pipeline.store.table_hint
    assert calibration.read_bytes() == old and not biases.exists()
    left = ['calibration.yaml'] + ['ballast'] * disk.is_mounted
    assert sorted(os.listdir(disk.folder)) == sorted(left)
    disk.free()
    assert calibrated(0.03)[0] and calibration.read_bytes() != old
    assert read_model(calibration).self_calibration.bias == pytest.approx(0.03, abs=1e-4)
    rig.pipeline.run_periodic_tasks(is_final=True)
    assert biases.exists(), 'what could not be written is written at the end at the latest'
