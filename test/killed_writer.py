# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""
Writes calibrations and bias tables in processes that are killed meanwhile.

    python killed_writer.py FOLDER KILLS

Each of KILLS children is forked, so that it writes at once, and is killed at a random time around
its writing. What it leaves must be, byte by byte, what was there before or what the same writing
gives that nobody kills. Prints the number of each, as JSON.

"""

import copy
import json
import os
from pathlib import Path
import random
import signal
import sys
import time

from gyro_calibration.heading.bias_table import Prior
from gyro_calibration.model.gyro_model import SelfCalibration
from gyro_calibration.ros.state_store import StateStore

FILES = ('calibration.yaml', 'biases.yaml')
BEGIN, STEP = 1.7e9, 86400.0  # s since 1970, and from one run of the robot to the next


def opened(folder):
    """Return the memory of a robot that starts."""
    return StateStore('', folder / FILES[0], folder / FILES[1], Prior())


def write(memory, number):
    """Write a calibration, and each fourth time a bias table as well, as the node does."""
    memory.keep(SelfCalibration(0.01 + 1e-6 * number, 1e-3, ((1e-8, 0.0), (0.0, 1e-10)),
                                '2026-01-01T00:00:00+00:00', 25.0, 'rest'))
    if number % 4:
        return
    memory.table.add(10.0 + number % 32, 1e-3 + 1e-5 * (number % 7), 1e-10, BEGIN + STEP * number)
    memory.keep_table(BEGIN + STEP * number, ending=True)


def forked(memory, number):
    """Return the process number of a child that has just begun to write."""
    ready, begun = os.pipe()
    child = os.fork()
    if child == 0:
        os.write(begun, b'x')
        write(memory, number)
        os._exit(0)
    os.read(ready, 1)
    os.close(ready), os.close(begun)
    return child


def contents(folder):
    """Return what the files hold."""
    return [(folder / name).read_bytes() if (folder / name).exists() else b'' for name in FILES]


def taught(folder):
    """Return the memory of a robot that has seen a few temperatures in earlier runs."""
    folder.mkdir()
    memory = opened(folder)
    for number in range(-32, 0):
        write(memory, number)
    return memory


def main():
    """Kill, look, and print what was found."""
    folder, kills, moments = Path(sys.argv[1]), int(sys.argv[2]), random.Random(1)
    robot, unharmed = taught(folder / 'robot'), taught(folder / 'unharmed')
    found = {'old': [0, 0], 'new': [0, 0], 'torn': 0, 'half_written': 0}
    for number in range(kills):
        old, begin = contents(folder / 'robot'), time.monotonic()
        write(copy.deepcopy(unharmed), number)
        new, lasts = contents(folder / 'unharmed'), time.monotonic() - begin
        child = forked(robot, number)
        time.sleep(moments.uniform(0.0, 1.5 * lasts))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        for place, content in enumerate(contents(folder / 'robot')):
            if content not in (old[place], new[place]):
                found['torn'] += 1
            elif old[place] != new[place]:
                found['new' if content == new[place] else 'old'][place] += 1
        found['half_written'] += len(os.listdir(folder / 'robot')) > len(FILES)
    memory = opened(folder / 'robot')
    print(json.dumps(found | {'hints': memory.hint + memory.table_hint,
                              'left': sorted(os.listdir(folder / 'robot'))}))


if __name__ == '__main__':
    main()
