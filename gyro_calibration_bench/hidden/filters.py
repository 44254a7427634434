# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""First-order filters on evenly spaced samples."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter


def lag(signal: np.ndarray, interval: float, time_constant: float) -> np.ndarray:
    """Return the output of a first-order lag, exact for piecewise linear signals."""
    decay = np.exp(-interval / time_constant)
    ramp = time_constant / interval * -np.expm1(-interval / time_constant)
    # x' = (u - x) / tau over one interval: x1 = decay x0 + (ramp - decay) u0 + (1 - ramp) u1
    start = [ramp * signal[0]]
    return lfilter([1.0 - ramp, ramp - decay], [1.0, -decay], signal, zi=start)[0]


def autoregression(innovations: np.ndarray, factor: float) -> np.ndarray:
    """Return x with x[k] = factor x[k-1] + innovations[k]."""
    return lfilter([1.0], [1.0, -factor], innovations)
