# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""A clock of the computer that is set while both nodes run: real processes, and libfaketime."""

import itertools
import math
import os
from pathlib import Path

from gyro_calibration.driver.emulator import Emulator
from gyro_calibration.driver.protocols import find_protocol, Sample
import numpy as np
import pytest

try:
    from diagnostic_msgs.msg import DiagnosticArray
    from sensor_msgs.msg import Imu
except ImportError:
    pass  # the fixture `ros` skips every test that needs them, and says why

# The variant for threads: the other gives a wrong time now and then if threads read at once.
FAKETIME = [Path(f'/usr/lib/{machine}-linux-gnu/faketime/libfaketimeMT.so.1')
            for machine in ('x86_64', 'aarch64')]
HOUR = 3600.0


@pytest.fixture
def set_clock(tmp_path, monkeypatch):
    """
    Return a function that sets the clock of all nodes started after this.

    It takes the offset from the true clock, s, and sets 2 h at first. The offset is never below 0:
    Fast DDS loses messages of writers whose clock is ahead of the reader's, and here only one of
    the two is moved.

    """
    library = next((path for path in FAKETIME if path.exists()), None)
    if library is None:
        pytest.skip('libfaketime is not installed (apt-get install faketime)')
    offset = tmp_path / 'offset'

    def set_clock(seconds):
        new = offset.with_suffix('.new')
        new.write_text(f'{seconds:+.0f}')
        os.replace(new, offset)
    set_clock(2.0 * HOUR)
    for name, value in {'LD_PRELOAD': library, 'FAKETIME_TIMESTAMP_FILE': offset,
                        'FAKETIME_NO_CACHE': 1, 'FAKETIME_DONT_FAKE_MONOTONIC': 1}.items():
        monkeypatch.setenv(name, str(value))
    return set_clock


def test_driver_and_compensation_go_on_together_where_the_clock_is_set(
        set_clock, start_node, ros, wait_until, tmp_path):
    """The gyro turns evenly: the stamps jump as the clock did, once, and the heading does not."""
    (tmp_path / 'model.yaml').write_text(
        'effects: {bias: {bias: 0.01}}\nnoise: {angle_random_walk: 5.0e-4}\n')
    heading = ros.collect(Imu, 'imu/data')
    diagnostics = ros.collect(DiagnosticArray, '/diagnostics', 10)
    samples = (Sample(0.31, None, 0.01 * number) for number in itertools.count())
    with Emulator(find_protocol('kvh_dsp3000'), samples, wait_for_reader=True) as gyro:
        start_node('compensation_node', {'calibration_file': tmp_path / 'calibration.yaml',
                                         'model_file': tmp_path / 'model.yaml'})
        start_node('driver_node', {'port': gyro.path})
        wait_until(lambda: len(heading) > 200, 90.0, 'headings')
        for hours in (3.0, 1.0):
            later = heading[-1].header.stamp.sec + (HOUR if hours == 3.0 else -2.0 * HOUR)
            begin = len(heading)
            set_clock(hours * HOUR)
            wait_until(lambda: abs(heading[-1].header.stamp.sec - later) < 100.0  # noqa: B023
                       and len(heading) > begin + 200,  # noqa: B023
                       timeout=90.0, what='headings with stamps of the clock that was set')
        wait_until(lambda: any(value.value.startswith('2, ')
                               for value in values_of(diagnostics, 'clock_steps')),
                   what='two steps of the clock')
    messages = list(heading)
    steps = np.diff([stamp.sec + 1e-9 * stamp.nanosec
                     for stamp in (message.header.stamp for message in messages)])
    jumps = np.where(np.abs(steps) > 100.0, np.round(steps / HOUR) * HOUR, 0.0)
    assert jumps[jumps != 0.0] == pytest.approx([HOUR, -2.0 * HOUR])
    directions = np.unwrap(
        [2.0 * math.atan2(message.orientation.z, message.orientation.w) for message in messages])
    assert directions - directions[0] == pytest.approx(
        0.3 * np.append(0.0, np.cumsum(steps - jumps)), abs=0.3 * 0.1)
    assert all(value.value == '0' for value in values_of(diagnostics, 'restarts'))
    assert max(message.orientation_covariance[8] for message in heading) < 0.5 ** 2


def values_of(diagnostics, key):
    return [value for array in diagnostics for status in array.status for value in status.values
            if value.key == key]
