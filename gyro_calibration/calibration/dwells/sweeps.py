# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Sweeps: which dwells belong to one pass through the rates."""

from __future__ import annotations

from collections.abc import Sequence

from gyro_calibration.calibration.dwells.samples import Numbers
from gyro_calibration.logs.log import Array, DEGREE
import numpy as np

#: If the median sweep has fewer dwells than this, the order of the rates is taken as random.
_MIN_SWEEP_DWELLS = 4
#: Blocks of consecutive dwells, where the order shows no sweeps.
_BLOCK_COUNT = 9


def number_named_sweeps(names: Sequence[str]) -> Numbers:
    """Give sweeps that have names their numbers, in the order in which they come."""
    numbers = {name: number for number, name in enumerate(dict.fromkeys(names))}
    return np.array([numbers[name] for name in names])


def number_sweeps(rate: Array) -> Numbers:
    """
    Return the number of the sweep of each dwell, by the order of the rates, shape (n,).

    The rates of a sweep increase or decrease, or their absolute values do with changing sign, with
    or without a rest between them. Where the order shows no sweeps, blocks of consecutive dwells
    are taken as sweeps.

    """
    turning = np.abs(rate) > max(1e-3 * np.abs(rate).max(), 0.01 * DEGREE)
    for used in (np.full(len(rate), True), turning) if turning.any() else ():
        for value in (rate, np.abs(rate)):
            sweep = np.zeros(len(rate), dtype=int)
            sweep[used] = _number_passes(value[used])
            # A rest belongs to the dwell before it.
            sweep = np.maximum.accumulate(np.where(used, sweep, 0))
            lengths = np.bincount(sweep[used])
            if len(lengths) > 1 and np.median(lengths) >= _MIN_SWEEP_DWELLS:
                return sweep
    return np.arange(len(rate)) * min(_BLOCK_COUNT, len(rate)) // len(rate)


def _number_passes(value: Array) -> Numbers:
    """Assign numbers to passes through values; a pass begins where the direction reverses."""
    change = np.diff(value)
    # Mean rates of opposite sign differ slightly in absolute value.
    steps = np.where(np.abs(change) > 0.005 * np.abs(value).max(), np.sign(change), 0.0)
    numbers = np.zeros(len(value), dtype=int)
    direction = 0.0
    for place, step in enumerate(steps, 1):
        is_reversed = step * direction < 0.0
        numbers[place] = numbers[place - 1] + is_reversed
        # The jump back to the start of the next pass does not show its direction.
        direction = 0.0 if is_reversed else direction or step
    return numbers
