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
The rules by which causes are named, of logs and of rate tables alike.

A cause is selected if noise alone rarely shows as much. It is established if it also predicts
stretches of the data that took no part in its fit; otherwise it is suspected. Alternatives that
explain the data nearly as well form a set with it, each with its probability.
"""

from __future__ import annotations

from collections.abc import Mapping
import math

from gyro_calibration.diagnosis.findings import MIN_PROBABILITY
from gyro_calibration.logs.log import Array
import numpy as np
from scipy.stats import norm

#: Shares of the false-alarm rate: for the search for causes, and for each value or noise figure.
SEARCH_ALARM_SHARE, VALUE_ALARM_SHARE = 0.6, 0.05
#: Ratio of the level at which a lasting cause is suspected to that at which it is established.
SUSPECTED_RATE_FACTOR = 5.0
#: Probability that an effect of the minimum detectable size is found.
DETECTION_POWER = 0.95
#: Least deficit in log-likelihood, relative to the best cause, of a cause that is ruled out (2.5
#: sigma).
RULED_OUT_DEFICIT = 3.2
#: A cause is confirmed if its gain in log-likelihood on held-out stretches exceeds so many
#: standard deviations. The gain of one stretch is limited to a likelihood ratio of one over the
#: same level, so that no single stretch confirms a cause.
_LEVEL = 0.05
MIN_PREDICTION_SIGMAS, _MAX_STRETCH_GAIN = float(norm.isf(_LEVEL)), -math.log(_LEVEL)


def detectable_sigmas(level: float) -> float:
    """Return the size, in standard deviations, that is found at a two-sided level."""
    return float(norm.isf(0.5 * level) + norm.ppf(DETECTION_POWER))


def prediction_sigmas(gains: Array) -> float:
    """Return the gain of held-out stretches in log-likelihood over its standard deviation."""
    if not np.sum(gains) > 0.0:
        return 0.0
    clipped = np.clip(gains, -_MAX_STRETCH_GAIN, _MAX_STRETCH_GAIN)
    scatter = float(np.std(clipped, ddof=1)) * len(gains) ** 0.5
    return float(np.sum(clipped)) / max(scatter, 1e-9)


def probabilities(deficits: Mapping[str, float]) -> dict[str, float]:
    """Return the probabilities of causes by their deficits in log-likelihood, largest first."""
    weights = {name: math.exp(-min(max(lack, 0.0), 700.0)) for name, lack in deficits.items()}
    return {name: max(weight / sum(weights.values()), MIN_PROBABILITY)
            for name, weight in sorted(weights.items(), key=lambda each: -each[1])}
