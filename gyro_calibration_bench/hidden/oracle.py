# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The improvement with the truth known."""

from __future__ import annotations

from dataclasses import dataclass

from gyro_calibration_bench.hidden.log import HiddenLog
import numpy as np


@dataclass(frozen=True)
class OracleGain:
    """Rms of output less prediction, rad/s, and of its integral over windows, rad."""

    rate_before: float
    rate_after: float
    heading_before: float
    heading_after: float

    @property
    def rate(self) -> float:
        """Return the share of the rate error that is won, 0 to 1."""
        return 1.0 - self.rate_after / self.rate_before

    @property
    def heading(self) -> float:
        """Return the share of the heading error that is won, 0 to 1."""
        return 1.0 - self.heading_after / self.heading_before


def oracle_gain(log: HiddenLog, rows: slice | np.ndarray = slice(None),
                window: float = 60.0) -> OracleGain:
    """
    Return the improvement of the gyro's model by the exact hidden effects.

    Parameters
    ----------
    log : a hidden log
    rows : of a part of it, in one piece, such as the part that a diagnosis held out
    window : over which the heading error is counted, s

    """
    truth, time = log.truth, log.columns['time_s'][rows]
    output, good = log.columns['gyro_rad_s'], truth.is_good
    design = np.column_stack([np.ones_like(output), truth.reference])
    simple = design @ np.linalg.lstsq(design[good], output[good], rcond=None)[0]
    before, after = (np.where(good, output - each, 0.0)[rows]
                     for each in (simple, truth.prediction))
    return OracleGain(_rms(before), _rms(after),
                      *(_rms(_window_changes(time, each, window)) for each in (before, after)))


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values ** 2))) if len(values) else float('nan')


def _window_changes(time: np.ndarray, rate_error: np.ndarray, window: float) -> np.ndarray:
    """Return the change of the integral over windows that follow one another."""
    angle = np.concatenate([[0.0], np.cumsum(np.diff(time) * rate_error[1:])])
    edges = np.searchsorted(time, np.arange(time[0], time[-1], window))
    return np.diff(angle[edges])
