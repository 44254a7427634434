# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The heading over a whole log, as it was known live or with all that came later."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from gyro_calibration.heading.gaps import Intervals
from gyro_calibration.heading.integration import integrate
from gyro_calibration.heading.kalman import Drift, HEADING, smoothed
from gyro_calibration.heading.tracker import ACCELERATION, HeadingTracker, JUMP, Settings
from gyro_calibration.logs.log import Array, Mask
from gyro_calibration.model.noise import Noise
import numpy as np


@dataclass(frozen=True)
class Track:
    """
    A heading over a log.

    Attributes
    ----------
    heading, variance, rate, rate_variance : rad, rad², rad/s and (rad/s)², shape (n,)
    resting : shape (n,)
    deleted : heading that was taken for bias or noise at rest, or by the threshold filter, rad
    intervals : of the samples, and how many are lost

    """

    heading: Array
    variance: Array
    rate: Array
    rate_variance: Array
    resting: Mask
    deleted: float
    intervals: Intervals


def track(time: Array, rate: Array, sensitivity: Array, noise: Noise, covariance: Array,
          settings: Settings, wheels: Sequence[bool | None] | None = None, hindsight: bool = False,
          age: float | None = 0.0, still: Array | None = None) -> Track:
    """
    Return the heading over a whole log.

    Parameters
    ----------
    time, rate : s and rad/s, compensated, shape (n,)
    sensitivity : of the rates to the values of the calibration, shape (m, n), as in `compensation`
    noise, covariance, settings, age : as in `HeadingTracker`
    wheels : whether wheels or commands move the robot, n of them, or None
    still : as in `HeadingTracker.add`
    hindsight : let all that came later count too

    Raises
    ------
    OverflowError : hindsight is wanted, and a heading or its variance is no finite number

    """
    tracker = HeadingTracker(noise, covariance, settings, age, hindsight)
    found = tracker.follow(time, rate, np.ascontiguousarray(sensitivity.T), wheels, still)
    heading, variance, shown, rate_variance, resting = found.T
    live = Track(heading, variance, shown, rate_variance, resting > 0.5, tracker.deleted,
                 tracker.intervals)
    if not hindsight:
        return live
    if not np.isfinite(found).all():
        raise OverflowError('the variance of the heading is not finite')
    later, with_hindsight, rested = in_hindsight(tracker, time, rate)
    return replace(live, heading=later, variance=with_hindsight, resting=rested)


def _without_spikes(time: Array, rate: Array) -> Array:
    """Return rates with what the tracker holds for no motion interpolated, shape (n,)."""
    jumps = np.abs(np.diff(rate)) > JUMP + ACCELERATION * np.diff(time)
    back = np.abs(rate[2:] - rate[:-2]) <= JUMP + ACCELERATION * (time[2:] - time[:-2])
    spikes = np.flatnonzero(jumps[:-1] & back) + 1
    if not len(spikes):
        return rate
    kept = np.delete(np.arange(len(rate)), spikes)
    return np.interp(time, time[kept], rate[kept])


def in_hindsight(tracker: HeadingTracker, time: Array, rate: Array) -> tuple[Array, Array, Mask]:
    """
    Return heading, rad, its variance, rad², and rest, shape (n,) each, with all that came later.

    The heading is what the rates came to, with the correction interpolated between the steps.

    Parameters
    ----------
    tracker : that kept its steps, and was given the samples
    time, rate : of the samples, s and rad/s, shape (n,)

    """
    last, steps, states = tracker.finish(), tracker.steps, list[Drift]()
    end, later = len(steps), None
    # a calibration that was used later knows the heading alone of what was before
    for first, before in [*tracker.renewed[::-1], (0, None)]:
        part = steps[first:end]
        states = smoothed(
            [*(step.before for step in part), last if later is None else later],
            [step.turn for step in part], [step.resting for step in part]) + states[1:]
        if before is not None:
            here, end = states[0], first
            later = last = before.known_to_head(
                float(here.mean[HEADING]), float(here.covariance[HEADING, HEADING]))
    ends = np.array([time[0], *(step.end for step in steps)])
    heading, variance = np.array([(state.mean[HEADING], state.covariance[HEADING, HEADING])
                                  for state in states]).T
    turned = integrate(time, _without_spikes(time, rate))
    rested = np.array([step.resting for step in steps] or [False])
    resting = rested[np.clip(np.searchsorted(ends, time, side='left') - 1, 0, len(rested) - 1)]
    moved = turned + np.interp(time, ends, heading - np.interp(ends, time, turned))
    return (np.where(resting, np.interp(time, ends, heading), moved),
            np.interp(time, ends, variance), resting)
