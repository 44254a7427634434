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

Each of KILLS children is forked and killed before a random one of the lines of files.py that it
runs, or ends. What it leaves must be, byte by byte, what was there before or what the same writing
gives that nobody kills. Prints the number of each, as JSON.

"""

import copy
import itertools
import json
import os
from pathlib import Path
import random
import signal
import sys

from gyro_calibration import files
from gyro_calibration.heading.bias_table import Prior
from gyro_calibration.model.gyro_model import SelfCalibration
from gyro_calibration.ros.state_store import StateStore

KEPT = ('calibration.yaml', 'biases.yaml')
BEGIN, STEP = 1.7e9, 86400.0  # s since 1970, and from one run of the robot to the next


def opened(folder):
    return StateStore('', folder / KEPT[0], folder / KEPT[1], Prior())


def write(memory, number):
    """Write a calibration, and each second time a bias table as well, as the node does."""
    memory.store_calibration(
        SelfCalibration(0.01 + 1e-6 * number, 1e-3, ((1e-8, 0.0), (0.0, 1e-10)),
                        '2026-01-01T00:00:00+00:00', 25.0, 'rest'))
    if number % 2:
        return
    memory.table.add(10.0 + number % 32, 1e-3 + 1e-5 * (number % 7), 1e-10, BEGIN + STEP * number)
    memory.store_table(BEGIN + STEP * number, is_final=True)


def lines_of(memory, number, on_line=lambda line: None):
    """Write, call a function before each line of files.py with its number; return how many."""
    lines = itertools.count()

    def trace(frame, event, _):
        if frame.f_code.co_filename == files.__file__:
            on_line(next(lines))
            return trace
        return None
    sys.settrace(trace)
    write(memory, number)
    sys.settrace(None)
    return next(lines)


def write_killed(memory, number, line):
    child = os.fork()
    if child == 0:
        lines_of(memory, number,
                 lambda each: each == line and os.kill(os.getpid(), signal.SIGKILL))
        os._exit(0)
    os.waitpid(child, 0)


def contents(folder):
    return [(folder / name).read_bytes() if (folder / name).exists() else b'' for name in KEPT]


def taught(folder):
    """Return the memory of a robot that has seen a few temperatures in earlier runs."""
    folder.mkdir()
    memory = opened(folder)
    for number in range(-32, 0):
        write(memory, number)
    return memory


def main():
    folder, kills, moments = Path(sys.argv[1]), int(sys.argv[2]), random.Random(1)
    robot, unharmed = taught(folder / 'robot'), taught(folder / 'unharmed')
    found = {'old': [0, 0], 'new': [0, 0], 'torn': 0, 'half_written': 0}
    for number in range(kills):
        old, memory = contents(folder / 'robot'), copy.deepcopy(unharmed)
        lines = lines_of(memory, number)
        new = contents(folder / 'unharmed')
        write_killed(robot, number, moments.randrange(round(1.3 * lines)))
        for place, content in enumerate(contents(folder / 'robot')):
            if content not in (old[place], new[place]):
                found['torn'] += 1
            elif old[place] != new[place]:
                found['new' if content == new[place] else 'old'][place] += 1
        found['half_written'] += len(os.listdir(folder / 'robot')) > len(KEPT)
    memory = opened(folder / 'robot')
    print(json.dumps(found | {'hints': memory.calibration_hint + memory.table_hint,
                              'left': sorted(os.listdir(folder / 'robot'))}))


if __name__ == '__main__':
    main()
