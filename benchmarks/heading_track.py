# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Follow a whole log by the tracker alone: what benchmarks and tests of the heading share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from gyro_calibration.heading.integration import Intervals
from gyro_calibration.heading.log_compensation import smooth_track
from gyro_calibration.heading.tracker import HeadingTracker, TrackerSettings
from gyro_calibration.logs.log import Array, Mask
from gyro_calibration.model.noise import Noise
import numpy as np


@dataclass(frozen=True)
class Track:
    """A heading over a log: arrays of shape (n,)."""

    heading: Array  # rad
    variance: Array  # rad²
    rate: Array  # rad/s
    rate_variance: Array  # (rad/s)²
    resting: Mask
    deleted_heading: float  # attributed to bias or noise at rest, or deleted by the filter, rad
    intervals: Intervals  # of the samples, with the number of lost ones


def track(time: Array, rate: Array, sensitivity: Array, noise: Noise, covariance: Array,
          settings: TrackerSettings, wheels: Sequence[bool | None] | None = None,
          hindsight: bool = False,
          age: float | None = 0.0, still: Array | None = None) -> Track:
    """
    Return the heading over a whole log, with hindsight smoothed by all later data.

    The compensated rates, rad/s, have shape (n,), their sensitivity to the values of the
    calibration (m, n); wheels state whether something moves the robot. All else is as in
    `HeadingTracker`.
    """
    tracker = HeadingTracker(noise, covariance, settings, age, hindsight)
    found = tracker.follow(time, rate, np.ascontiguousarray(sensitivity.T), wheels, still)
    heading, variance, shown, rate_variance, resting = found.T
    live = Track(heading, variance, shown, rate_variance, resting > 0.5, tracker.deleted_heading,
                 tracker.intervals)
    if not hindsight:
        return live
    later, with_hindsight, rested = smooth_track(tracker, time, rate)
    return replace(live, heading=later, variance=with_hindsight, resting=rested)
