# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Tasks for workers, two of which are fatal; apart, so that a worker imports little."""

import os
from pathlib import Path
import signal
import sys
import time

from gyro_calibration.fleet.run import process_executor, run_tasks

KILLS, TAKES_ALL_MEMORY = 3, 5


def task(number):
    if number == KILLS:
        os.kill(os.getpid(), signal.SIGKILL)
    if number == TAKES_ALL_MEMORY:
        try:
            return len(bytearray(4 << 30))
        except MemoryError:
            return 'no memory'
    return number


def begun(folder):
    (Path(folder) / str(os.getpid())).touch()
    time.sleep(3600.0)


if __name__ == '__main__':
    with process_executor(1) as executor:
        list(run_tasks(begun, sys.argv[1:], executor))
