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
The programs of the nodes, which end with exit code 0 also at a signal during the slow imports.

The nodes handle the signals themselves as soon as they run.
"""

from importlib import import_module
import os
import signal
from typing import Any


def handle_end_signals(handler: Any) -> dict[int, Any]:
    r"""Handle Ctrl-C, Ctrl-\, SIGTERM and, but for nohup, a lost terminal; return the old ones."""
    return {number: signal.signal(number, handler)
            for number in (signal.SIGINT, signal.SIGQUIT, signal.SIGTERM, signal.SIGHUP)
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN}


def start_driver() -> int:
    return _start('driver_node')


def start_compensation() -> int:
    return _start('compensation_node')


def _start(name: str) -> int:
    handle_end_signals(lambda *_: os._exit(0))  # nothing runs yet that had to be closed
    node: Any = import_module(f'gyro_calibration.ros.{name}')
    code: int = node.main()
    return code
