# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Follow a whole log, by the tracker or a fit: what benchmarks and tests of the heading share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from gyro_calibration.calibration.likelihood import ScaleBiasFit
from gyro_calibration.heading.integration import integrate, Intervals
from gyro_calibration.heading.log_compensation import smooth_track
from gyro_calibration.heading.tracker import HeadingTracker, TrackerSettings
from gyro_calibration.logs.log import Array, Mask
from gyro_calibration.model.compensation import quadratic_form
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


def follow(fit: ScaleBiasFit, time: Array, output: Array, heading: Array,
           noise: Noise) -> tuple[Array, Array]:
    """Return error of the heading and its stated deviation, rad, without the last second."""
    turned = integrate(time, (output - fit.bias) / (1.0 + fit.scale_factor_error))
    turned = np.interp(time + fit.time_offset, time,
                       turned) - np.interp(max(fit.time_offset, 0.0), time, turned)
    known = (quadratic_form(fit.covariance, np.array([heading, time]))
             / (1.0 + fit.scale_factor_error) ** 2)
    variance = known + noise.heading_variance(time) + fit.start_heading_deviation ** 2
    kept = time < time[-1] - 1.0
    return (turned + fit.start_heading - heading)[kept], np.sqrt(variance)[kept]
