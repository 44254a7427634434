# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Processes that are measured: how they begin and end, apart from others, and what they use."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
import fcntl
import os
from pathlib import Path
import random
import signal
import subprocess
import sys
import tempfile
import time

import numpy as np


@contextmanager
def apart() -> Iterator[Path]:
    """Give a folder to programs of ROS 2 that no other one hears: each run locks its domain."""
    for number in random.sample(range(1, 102), 101):
        with open(Path(tempfile.gettempdir()) / f'gyro_calibration_domain_{number}',
                  'w') as lock, tempfile.TemporaryDirectory() as folder, suppress(BlockingIOError):
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            os.environ.setdefault('AMENT_PREFIX_PATH', sys.prefix)
            os.environ.update(ROS_DOMAIN_ID=str(number), ROS_LOG_DIR=folder,
                              ROS_AUTOMATIC_DISCOVERY_RANGE='LOCALHOST')
            yield Path(folder)
            return
    raise RuntimeError('all ROS domains from 1 to 101 are taken by other runs: end some of them')


def node_command(name: str, parameters: Mapping[str, object]) -> list[str]:
    """Return the command that starts a node of this package with parameters."""
    texts = {key: str(value).lower() if isinstance(value, bool) else value
             for key, value in parameters.items()}
    return [sys.executable, '-m', f'gyro_calibration.ros.{name}', '--ros-args',
            *(word for key, text in texts.items() for word in ('-p', f'{key}:={text}'))]


def end(process: subprocess.Popen) -> None:
    """End a process, at all costs."""
    with suppress(ProcessLookupError):
        process.send_signal(signal.SIGINT)
    try:
        process.wait(10.0)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def processor_time(process: int) -> float:
    """Return the processor time of a process, s, by clock_getcpuclockid(3), finer than /proc."""
    return time.clock_gettime(~process << 3 | 2)


def resident_memory(process: int | str = 'self') -> int:
    """Return the resident memory of a process, bytes."""
    return int(Path(f'/proc/{process}/statm').read_text().split()[1]) * os.sysconf('SC_PAGE_SIZE')


def calibrate(number: int) -> tuple[float, int, float]:
    """
    Return the bias of a simulated log by least squares: a task of a fleet; below 0 it is killed.

    Also returned are the number of the process, and the time that it has computed for, s.
    """
    if number < 0:
        os.kill(os.getpid(), signal.SIGKILL)
    generator = np.random.default_rng(number)
    rate = np.cumsum(generator.standard_normal(20000)) * 1e-3
    output = 1.01 * rate + 0.01 + 1e-2 * generator.standard_normal(20000)
    bias = 0.0
    for _ in range(5):
        columns = np.column_stack([rate, np.ones(20000)])
        bias = float(np.linalg.lstsq(columns, output, rcond=None)[0][1])
    return bias, os.getpid(), time.process_time()
