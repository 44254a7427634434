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
Compensation of a whole log, and its heading by filter or smoother.

A model with history is evaluated over blocks of the log.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from gyro_calibration.heading.integration import integrate
from gyro_calibration.heading.kalman import HEADING_INDEX, HeadingState, smooth_states
from gyro_calibration.heading.tracker import HeadingTracker, MAX_ACCELERATION, MAX_RATE_STEP
from gyro_calibration.logs.log import Array, DEGREE, Log, Mask, select_rows
from gyro_calibration.model.compensation import compensate, CompensatedSamples, rate_sensitivity
from gyro_calibration.model.gyro_model import GyroModel, STEP_TOLERANCE
import numpy as np
from numpy.typing import NDArray


class LogCompensation:
    """
    Compensate a log block by block, with the same result as in one piece.

    The heading of effects is the integral of the compensated rates, from 0 on, plus its deviation
    from the reference, interpolated between the values of the reference: before its first value
    the deviation is that at this value. Across the border of blocks the next value is not known,
    and the result differs slightly.
    """

    def __init__(self, model: GyroModel):
        """Begin with an empty history."""
        self._model, self._history = model, model.start_history()
        self._start_time: float | None = None
        self._last_integration: tuple[Array, Array, float] = np.zeros(0), np.zeros(0), 0.0

    def add(self, log: Log) -> tuple[CompensatedSamples, Array]:
        """Take the next rows, with known outputs; return them with their `rate_sensitivity`."""
        assert log.output is not None
        channels = None
        if self._model.needs_history and len(log):
            channels = self._history.update(
                np.zeros(len(log)) if log.time is None else log.time, log.temperature,
                log.specific_force, log.supply, 0.0)
            if self._model.uses_channel('heading') and log.time is not None:
                # compensate with a heading, and integrate the rates to the next heading
                last_time, last_rate, begin = self._last_integration
                carried = len(last_time)
                time = np.concatenate([last_time, self.true_time(log.time)])
                reference = np.append(np.full(carried, begin), np.full(len(log), np.nan)
                                      if log.reference_heading is None else log.reference_heading)
                known, heading = np.isfinite(reference), np.full(len(time), begin)
                for _ in range(50):
                    channels = replace(channels, heading=heading[carried:])
                    rate = np.concatenate([last_rate, compensate(
                        self._model, log.output, log.temperature, channels).rate])
                    before, heading = heading, integrate(time, rate, begin)
                    if known.any():
                        heading += np.interp(time, time[known], (reference - heading)[known])
                    if np.abs(heading - before).max() < STEP_TOLERANCE:
                        break
                self._last_integration = time[-1:], rate[-1:], float(heading[-1])
                channels = replace(channels, heading=heading[carried:])
        result = compensate(self._model, log.output, log.temperature, channels)
        sensitivity = rate_sensitivity(self._model, log.output, result.rate, result.temperature,
                                       channels)
        return CompensatedSamples(*(np.broadcast_to(each, np.shape(log.output))
                                    for each in vars(result).values())), sensitivity

    def true_time(self, time: Array) -> Array:
        """Return when the samples with the next stamps, s, were taken."""
        if self._start_time is None and len(time):
            self._start_time = float(time[0])
        begin = self._start_time or 0.0
        return np.asarray(begin + self._model.true_time(time - begin))


def plausible_rows(model: GyroModel, log: Log) -> Mask:
    """Return which rows have a plausible output and temperature, shape (n,); no nan is one."""
    assert log.output is not None
    found = np.abs(log.output) <= model.rate_limit
    if log.temperature is not None:
        coldest, hottest = model.temperature_limits
        found &= (coldest <= log.temperature) & (log.temperature <= hottest)
    return np.asarray(found)


def no_plausible_row_message(model: GyroModel) -> str:
    """Return the message for a log without a plausible row."""
    coldest, hottest = model.temperature_limits
    return (f'no row is plausible, with an output within {model.rate_limit / DEGREE:.0f} deg/s '
            f'and a temperature from {coldest:.0f} to {hottest:.0f} degC; check columns and units')


def compensate_log(model: GyroModel, log: Log) -> Array:
    """Return the rates of a log with output, rad/s, shape (n,); nan where not plausible."""
    known = plausible_rows(model, log)
    rate = np.full(len(log), np.nan)
    rate[known] = LogCompensation(model).add(rows_of(log, known))[0].rate
    return rate


def rows_of(log: Log, rows: NDArray[np.integer[Any]] | Mask) -> Log:
    """Return some rows of a log, by their numbers or by a mask, without unknown columns."""
    return select_rows(replace(log, others={}), rows)


def smooth_track(tracker: HeadingTracker, time: Array, rate: Array) -> tuple[Array, Array, Mask]:
    """Return smoothed heading, rad, its variance, rad², and rest, shape (n,) each."""
    # The heading is the integral of the rates, with the correction interpolated between the steps.
    # The tracker has taken all samples, s and rad/s, and kept its steps.
    last, steps, states = tracker.finish(), tracker.steps, list[HeadingState]()
    end, later = len(steps), None
    # of the data before another calibration, only the heading is in its state
    for first, before in [*tracker.recalibrations[::-1], (0, None)]:
        part = steps[first:end]
        states = smooth_states(
            [*(step.state_before for step in part), last if later is None else later],
            [step.rate_integral for step in part], [step.is_resting for step in part]) + states[1:]
        if before is not None:
            here, end = states[0], first
            later = last = before.condition_on_heading(
                float(here.mean[HEADING_INDEX]),
                float(here.covariance[HEADING_INDEX, HEADING_INDEX]))
    ends = np.array([time[0], *(step.end_time for step in steps)])
    heading, variance = np.array(
        [(state.mean[HEADING_INDEX], state.covariance[HEADING_INDEX, HEADING_INDEX])
         for state in states]).T + tracker.heading_shifts(states)
    # share of the rates in the heading: 1 in motion, in a rest that of a straight drive
    share = np.array([1.0 if not step.is_resting else step.rate_integral.wander[1] @ (
        step.rate_integral.wander[0] / (
            step.rate_integral.wander[0] + step.state_before.noise.angle_random_walk ** 2
            * step.rate_integral.duration)) for step in steps] or [1.0])
    place = np.clip(np.searchsorted(ends, time, side='left') - 1, 0, len(share) - 1)
    # with the outliers of the tracker interpolated
    jumps = np.abs(np.diff(rate)) > MAX_RATE_STEP + MAX_ACCELERATION * np.diff(time)
    back = (np.abs(rate[2:] - rate[:-2]) <= MAX_RATE_STEP
            + MAX_ACCELERATION * (time[2:] - time[:-2]))
    kept = np.delete(np.arange(len(rate)), np.flatnonzero(jumps[:-1] & back) + 1)
    if len(kept) < len(rate):
        rate = np.interp(time, time[kept], rate[kept])
    turned = integrate(time, rate)
    followed = turned - np.interp(time, ends, np.interp(ends, time, turned))
    resting = np.array([step.is_resting for step in steps] or [False])[place]
    return (np.interp(time, ends, heading) + share[place] * followed,
            np.interp(time, ends, variance) + tracker.ambiguity_variance(time), resting)
