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
Allan deviation of a gyro at rest, and its noise figures N, B, K, Q and R (IEEE Std 952, annex C).

Reading order: `deviation` (samples at rest on an even grid, the chart, and the covariance of Allan
variances), `noise_fit` (coefficients of the noise terms).
"""

from importlib import import_module
import sys
from types import ModuleType
from typing import Any


class _CallableModule(ModuleType):
    """This package, callable as `api.allan`: once imported, it shadows that function."""

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        return import_module('gyro_calibration.api').allan(*arguments, **named)


sys.modules[__name__].__class__ = _CallableModule
