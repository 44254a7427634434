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
Calibrate a gyro, so that a robot knows its heading.

Words. The *output* is what the gyro reports, the *rate* is the true rate about its input axis, the
*heading* is the integral of the rate. Each error is one *effect*, and
``output = rate + errors(rate, output, temperature) + noise``.

Frames. Everything is about one axis, z of the gyro's frame, counter-clockwise positive (REP-103).

Units. SI inside: rad, rad/s, s, K for differences; temperatures are in degC. Other units exist
only in files, wires and the command line, where the name says so: ``gyro_dps``.

Interface. The names in `__all__` are public, and imported when they are first used; everything
else may change. `from gyro_calibration import read_log, fit` needs no ROS 2.

Reading order: `logs`, `model`, `heading`, `calibration`, `allan`, `diagnosis`, `fleet`; then, with
ports, processes and ROS 2, `driver`, `ros`, `cli`; then `api`, which holds the public names. Each
folder imports only what stands before it, and so does each module of a folder, by the reading
order that its docstring gives. `files` opens and writes files for all.
"""

from importlib import import_module
from typing import Any, TYPE_CHECKING

if TYPE_CHECKING:
    from gyro_calibration.api import (
        allan, compensate, diagnose, fit, GyroModel, Log, read_log, read_model, self_calibrate,
        simulate, track, write_log, write_model)

__version__ = '0.2.0'
__all__ = ['GyroModel', 'Log', 'allan', 'compensate', 'diagnose', 'fit', 'read_log', 'read_model',
           'self_calibrate', 'simulate', 'track', 'write_log', 'write_model']


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    return getattr(import_module('gyro_calibration.api'), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
