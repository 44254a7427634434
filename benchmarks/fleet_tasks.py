# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Tasks for the workers of the benchmark of fleets; apart, so that a worker imports little."""

import os
import signal
import time

import numpy as np


def calibrate(number: int) -> tuple[float, int, float]:
    """
    Return the bias of a simulated log by least squares; a number below 0 kills the worker.

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
