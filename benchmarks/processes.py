# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Processes that are measured: how they end, and what they use."""

from contextlib import suppress
import signal
import subprocess
import time


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
