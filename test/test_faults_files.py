"""
What a robot keeps in files, through kills at any moment and a full disk: the old file or the new one, and nothing half written for long.

"""

import json
import os
import random
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from fake_gyro import FakeGyro

from gyro_calibration.files import remove_leftovers, replacing, write_atomically
from gyro_calibration.model_file import read_model

QUIET = {'bias_duration': 1.0, 'threshold': 0.0}


def test_500_kills_leave_the_old_files_or_the_new_ones(tmp_path):
    """A process that writes what the node writes, with the same code; the whole node is killed below."""
    command = [sys.executable, Path(__file__).parent / 'killed_writer.py', tmp_path, '500']
    found = json.loads(subprocess.run(command, check=True, capture_output=True, timeout=300).stdout)
    assert found['torn'] == 0 and found['hints'] == ''
    assert min(*found['old'], *found['new'], found['half_written']) > 10, f'kills that came too early or too late show nothing: {found}'
    assert found['left'] == ['biases.yaml', 'calibration.yaml']


def test_what_a_killed_writer_left_is_removed_and_what_is_being_written_is_not(tmp_path):
    path = tmp_path / 'model.yaml'
    (tmp_path / '.model.yaml.abcd1234').write_text('half')
    (tmp_path / '.model.yaml.swp').write_text('of an editor')
    (tmp_path / '.other.yaml.abcd1234').write_text('of another file')
    with replacing(path) as file:
        file.write(b'new')
        write_atomically(path, b'of another process, in between')
        remove_leftovers(path)
    assert path.read_bytes() == b'new'
    assert sorted(os.listdir(tmp_path)) == ['.model.yaml.swp', '.other.yaml.abcd1234', 'model.yaml']


def rest(seed, mean=0.0, count=400):
    """Return the rates of a gyro at rest."""
    return mean + 1e-4 * np.random.default_rng(seed).standard_normal(count)


def calibrated(gyro, seed, mean):
    """Return the answer of a calibration at rest."""
    answer = gyro.call_later('calibrate_bias')
    gyro.wait_until(gyro.calibrating, what='the calibration to begin')
    gyro.play(rest(seed, mean), until=answer.done)
    gyro.wait_until(answer.done, what='the answer')
    return answer.result()


@pytest.mark.usefixtures('by_udp')
def test_a_node_that_is_killed_while_it_keeps_its_calibration_starts_with_the_old_or_the_new_one(start_node, ros, wait_until, tmp_path):
    file, moments, found = tmp_path / 'calibration.yaml', random.Random(1), []
    for number in range(5):
        before = read_model(file).self_calibration.bias if number else 0.0
        node = start_node('compensation_node', parameters=QUIET | {'calibration_file': file})
        gyro = FakeGyro(ros, wait_until)
        told = next(status for status in reversed(gyro.status))
        assert number == 0 or 'bias' in told.message, f'the calibration of the run before is not used: {told.message}'
        answer, mean = gyro.call_later('calibrate_bias'), 0.01 * (number + 1)
        gyro.wait_until(gyro.calibrating, what='the calibration to begin')
        kill_while_it_writes(node, gyro, answer, mean, moments.uniform(0.0, 0.01))
        found.append(read_model(file).self_calibration.bias if file.exists() else 0.0)
        assert found[-1] == pytest.approx(mean, abs=1e-4) or found[-1] == before
        for topic in (gyro.imu, gyro.rate, gyro.heading, gyro.status):
            topic.clear()
    assert found[-1] != 0.0


def kill_while_it_writes(node, gyro, answer, mean, moment):
    """Kill the node a moment after the last sample of a calibration, or when it answers."""
    for rate in rest(1, mean, 99):
        gyro.send(rate)
        time.sleep(0.001)
    time.sleep(0.2)
    deadline = time.monotonic() + 10.0
    while not answer.done() and gyro.calibrating() and time.monotonic() < deadline:
        gyro.send(mean)
        time.sleep(0.001)
    time.sleep(moment)
    node.waited = True
    os.killpg(node.process.pid, signal.SIGKILL)
    node.process.wait()


class Disk:
    """A small disk that can be filled, or, where nobody may mount one, a limit to the files that a process writes."""

    def __init__(self, folder):
        self.folder, self.process = folder, None
        self.is_mounted = subprocess.run(['mount', '-t', 'tmpfs', '-o', 'size=64k', 'tmpfs', folder], capture_output=True).returncode == 0

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
            resource.prlimit(self.process.pid, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))


@pytest.fixture
def disk(tmp_path):
    """Return a `Disk`; skip where neither way works."""
    folder = tmp_path / 'disk'
    folder.mkdir()
    disk = Disk(folder)
    if not disk.is_mounted and not hasattr(resource, 'prlimit'):
        pytest.skip('a disk can be filled neither by mounting a small one (that takes root) nor by prlimit (Linux has it)')
    yield disk
    if disk.is_mounted:
        subprocess.run(['umount', '-l', folder], check=True)


def test_on_a_full_disk_the_node_says_so_goes_on_and_writes_when_there_is_room(start_node, ros, wait_until, disk, tmp_path):
    calibration, biases = disk.folder / 'calibration.yaml', disk.folder / 'biases.yaml'
    model = tmp_path / 'model.yaml'
    model.write_text('effects: {bias: {bias: 0.0}}\nnoise: {angle_random_walk: 1.0e-5}\n')  # without noise no rest is looked for
    files = {'model_file': model, 'calibration_file': calibration, 'bias_file': biases}
    node = start_node('compensation_node', parameters=QUIET | files)
    disk.process, gyro = node.process, FakeGyro(ros, wait_until)
    assert calibrated(gyro, 1, 0.01).success
    old = calibration.read_bytes()
    disk.fill()
    refused = calibrated(gyro, 2, 0.02)
    assert refused.success and 'NOT STORED' in refused.message and f'make room in {disk.folder}' in refused.message
    wait_until(lambda: gyro.status[-1].message.startswith('the calibration is in use but NOT STORED'))
    teach(gyro)
    gyro.play(rest(3, 0.02, 100))
    assert calibration.read_bytes() == old and not biases.exists()
    assert sorted(os.listdir(disk.folder)) == sorted(['calibration.yaml'] + ['ballast'] * disk.is_mounted)
    disk.free()
    assert calibrated(gyro, 4, 0.03).success and calibration.read_bytes() != old
    assert read_model(calibration).self_calibration.bias == pytest.approx(0.03, abs=1e-4)
    node.stop()
    assert biases.exists(), 'what could not be written is written at the end at the latest'


def teach(gyro):
    """Rest until the node has something to put into its table of biases, and says that it cannot."""
    gyro.wait_until(lambda: gyro.play(rest(5, 0.02), 25.0) or gyro.diagnostics and 'cannot be written' in gyro.values()['bias_table'],
                    60.0, 'the table')
