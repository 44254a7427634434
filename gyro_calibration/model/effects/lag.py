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
A lag of first order, exact for a signal that is linear between its samples.

It obeys ``time_constant * d(lagged)/dt = signal - lagged``. It is followed by what the lagged
signal is ahead of the signal. That decays by exp(-x) over an interval of x time constants, and a
change of the signal by d over the interval takes ``d (1 - exp(-x)) / x`` away from it.

"""

from __future__ import annotations

import math

from gyro_calibration.logs.log import Array, Number
import numpy as np


def lag_ahead(interval: Number, change: Number, time_constant: float,
              ahead: float = 0.0) -> Number:
    """
    Return what a lagged signal is ahead of the signal, of one instant or of many (shape (n,)).

    Parameters
    ----------
    interval : since the sample before, s, not negative
    change : of the signal since the sample before
    time_constant : s, above 0
    ahead : what the lagged signal was ahead at the sample before the first one

    """
    if not isinstance(interval, np.ndarray):
        x = interval / time_constant
        return math.exp(-x) * ahead + change * (math.expm1(-x) / x if x else -1.0)
    # intervals of no length leave the formulas a number
    x = np.maximum(interval / time_constant, 1e-300)
    fallen = np.expm1(-x)
    return _recurrence(fallen + 1.0, change * (fallen / x), ahead)


def lagged_signal(signal: Array, time: Array, time_constant: float) -> Array:
    """Return a signal, shape (n,), through a lag that starts in its first value."""
    interval, change = np.diff(time, prepend=time[:1]), np.diff(signal, prepend=signal[:1])
    return signal + lag_ahead(interval, change, time_constant)


def _recurrence(factors: Array, added: Array, before: float) -> Array:
    """
    Return y of ``y[k] = factors[k] * y[k - 1] + added[k]``, shape (n,).

    Rows of sqrt(n) samples go on side by side, each from zero; then each gets what the row before
    it has come to.

    """
    count = len(factors)
    width = math.isqrt(max(count - 1, 0)) + 1
    padding = (0, -count % width)
    product = np.ascontiguousarray(np.pad(factors, padding).reshape(-1, width).T)
    total = np.ascontiguousarray(np.pad(added, padding).reshape(-1, width).T)
    for k in range(1, width):
        total[k] += product[k] * total[k - 1]
        product[k] *= product[k - 1]
    starts = [before]
    for factor, sum_of_row in zip(product[-1].tolist(), total[-1].tolist()):
        starts.append(factor * starts[-1] + sum_of_row)
    product *= np.array(starts[:-1])
    total += product
    return total.T.ravel()[:count]
