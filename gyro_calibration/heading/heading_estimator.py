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
The heading on a robot, sample by sample, by model, calibration, temperature and bias at rest.

The computations are in `compensation`, `tracker` and `bias_table`. This module propagates a
calibration to the present time and temperature, corrects the bias for the temperature while the
robot drives, and adds the bias at rest to the table for the next run.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta, timezone
import math
from typing import Any

from gyro_calibration.heading.bias_table import (
    AGE_TOLERANCE, BiasTable, OUTLIER_SIGMAS, Prior, REST_DURATION, TemperatureCorrection, YEAR)
from gyro_calibration.heading.integration import TIME_TOLERANCE
from gyro_calibration.heading.stationary import BLOCK_DURATION
from gyro_calibration.heading.tracker import HeadingTracker, TrackerSettings
from gyro_calibration.logs.log import Array, CACHE_BLOCK_SAMPLES, DEGREE, MAX_TIME, Number
from gyro_calibration.model.compensation import (
    compensate, CompensatedSamples, quadratic_form, rate_sensitivity, uncertainty_covariance)
from gyro_calibration.model.effects import Channels
from gyro_calibration.model.gyro_model import GyroModel, SelfCalibration, with_self_calibration
import numpy as np
from scipy.linalg import block_diag

#: Assumed drift of the temperature after its last message, K/s.
_LOST_TEMPERATURE_RATE = 1.0 / 60.0
#: Age of a temperature, s, from which on it is held with a growing uncertainty.
TEMPERATURE_TIMEOUT = 10.0
#: Largest plausible specific force, m/s².
MAX_SPECIFIC_FORCE = 1e5


@dataclass(frozen=True)
class Assumptions:
    """Standard deviations of uncalibrated values, and of the bias at temperatures without data."""

    # the variance of the tracker contains only the errors that it is given
    bias: float = 0.5 * DEGREE  # rad/s
    scale_factor_error: float = 0.03
    #: rad/s/K; 0 for a gyro with temperature compensation.
    bias_temperature_coefficient: float = Prior.coefficient

    @property
    def covariance(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return that of (s, b)."""
        return (self.scale_factor_error ** 2, 0.0), (0.0, self.bias ** 2)


@dataclass
class _RestStretch:
    """Samples at rest, as sums."""

    start_time: float  # stamp of the first, s
    sensitivity: Array  # of the rate to each uncertain value at the end, shape (m,)
    count: int = 0
    rate_sum: float = 0.0  # after the model, rad/s
    temperature_sum: float = 0.0  # degC
    has_ended: bool = False


class HeadingEstimator:
    """
    Estimate the heading of a robot.

    `model` has the stored calibration, `current_model` the present one, by which samples are
    compensated. `covariance`, shape (m, m), is that of the temperature coefficient of the bias and
    of the uncertain values of the current model. `rate` is the last one, rad/s, zero at rest, and
    `corrected_rate` that before the tracker. `temperature`, degC, is None before the first. The
    sum of `heading_before_resets` and the heading of the tracker, rad, is not changed by resets.
    `is_bias_assumed` tells whether neither the model nor a self-calibration has a bias with its
    variance, `is_scale_assumed` whether neither has a scale factor error.
    """

    def __init__(self, model: GyroModel, table: BiasTable, assumptions: Assumptions,
                 settings: TrackerSettings, now: float, keep: bool = False):
        """Begin at heading zero, now, s since 1970; `keep` steps for `smooth_track`."""
        self._assumptions, self._settings, self._keeps_steps = assumptions, settings, keep
        self.temperature: float | None = None
        self._temperature_time, self._follows_temperature = -math.inf, False
        self.is_calibrated_this_run = self._age_changed = False
        self.rate = self.corrected_rate = 0.0
        self.last_compensated = CompensatedSamples(0.0, 0.0, 0.0, False, False)
        self.restart_count = 0
        self._time, self._elapsed, self.heading_before_resets = -math.inf, 0.0, 0.0
        self._refused_count, self.refused_temperature_count = 0, 0
        self._stretch: _RestStretch | None = None
        self._pending_stretches: deque[_RestStretch] = deque(maxlen=8)
        self._table_message = ''
        self.model, self.table = model, table
        self._history = model.start_history()
        self.tracker: HeadingTracker  # of the first start
        self._restart(now)

    def use_calibration(self, model: GyroModel, now: float) -> None:
        """Use a self-calibration that was made just now; the heading does not jump."""
        self.model, self.is_calibrated_this_run = model, True
        self._restart(now, is_fresh=True)

    def begin_run(self, now: float) -> None:
        """Expect another bias, as after the gyro was without power; the heading does not jump."""
        self.table.begin_run()
        self.is_calibrated_this_run = False
        self._restart(now)

    def reset(self) -> None:
        """Set the heading to zero."""
        self.heading_before_resets += self.tracker.heading
        self.tracker.reset()

    def set_heading(self, heading: float, variance: float) -> None:
        """Set the heading, rad, and its variance, rad²."""
        self.heading_before_resets += self.tracker.heading - heading
        self.tracker.set_heading(heading, variance)

    def shift_clock(self, step: float) -> None:
        """Correct all dates of this run for a clock that was set by a step, s."""
        self._start_time += step
        self.table.shift_clock(step)
        calibration = self.model.self_calibration
        old = (not self.is_calibrated_this_run
               and (calibration is not None or len(self.table.entries) > 0))
        self._age_changed = self._age_changed or (old and abs(step) > AGE_TOLERANCE)
        if self.is_calibrated_this_run and calibration is not None and calibration.time:
            then = datetime.fromisoformat(calibration.time) + timedelta(seconds=step)
            self.model = with_self_calibration(
                self.model, replace(calibration, time=then.isoformat(timespec='seconds')))

    # The calibration at the start

    def _restart(self, now: float, is_fresh: bool = False) -> None:
        """Propagate the calibration to the present, unless it is new, and start the tracker."""
        model, here, self._calibration_message = self.model, self._known_temperature, ''
        calibration, assumed = model.self_calibration, self._assumptions.covariance
        fits_scale, fits_bias = (
            (False, False) if model.covariance is None else model.fits_scale_and_bias)
        if calibration is None and not (fits_scale and fits_bias):
            # What is not calibrated is not known; a self-calibration takes the place of both
            # tolerances of the model.
            calibration = SelfCalibration(covariance=(
                (model.tolerance.scale_factor_error ** 2 if fits_scale else assumed[0][0], 0.0),
                (0.0, model.tolerance.bias ** 2 if fits_bias else assumed[1][1])))
        elif calibration is not None and (calibration.covariance is None
                                          or not np.isfinite(calibration.covariance).all()):
            calibration, fits_scale, fits_bias = (
                replace(calibration, covariance=assumed), False, False)
        self.is_bias_assumed, self.is_scale_assumed = (not fits and (
            self.model.self_calibration is None or calibration is not model.self_calibration)
            for fits in (fits_bias, fits_scale))
        if calibration is not model.self_calibration:
            model = with_self_calibration(model, calibration)
        age: float | None = 0.0
        if not is_fresh and self.model.self_calibration is None and fits_bias:
            if here is None or not self.table.entries:
                age = None
            else:  # the bias of earlier runs
                bias, variance = self.table.predict(here, now)
                of_scale = 0.0 if calibration is None else assumed[0][0]
                model = with_self_calibration(
                    model, SelfCalibration(0.0, bias, ((of_scale, 0.0), (0.0, variance))))
        elif (not is_fresh and self.model.self_calibration is None
              and not self.table.entries):
            age = None
        elif calibration is not None and not is_fresh:
            calibration, self._calibration_message = self.table.propagate_calibration(
                calibration, self.age(now), now, here, self.is_calibrated_this_run)
            model = with_self_calibration(model, calibration)
            if (self._dated_age(now) or 0.0) < -AGE_TOLERANCE:
                self._calibration_message = (
                    f'the calibration is dated {calibration.time}, which is later than the clock '
                    'of this computer: its age is not known and taken for a year; set the clock, '
                    'or calibrate again')
        self.current_model = model
        self.covariance: Array = block_diag(self._assumptions.bias_temperature_coefficient ** 2,
                                            uncertainty_covariance(self.current_model))
        temperature = self.model.reference_temperature
        slope = None if self.current_model.needs_history else np.subtract(
            *(self._uncertain_sensitivity(rate, rate, temperature, None, 0.0)
              for rate in (DEGREE, 0.0))) / DEGREE
        if self.restart_count:
            self.tracker.use_calibration(self.current_model.noise, self.covariance, age, slope)
        else:
            self.tracker = HeadingTracker(self.current_model.noise, self.covariance,
                                          self._settings, age, self._keeps_steps, slope)
        self._start_time = now
        self._start_correction(now)
        self._unknown_since = (self._time if is_fresh and not self._follows_temperature
                               else math.inf)
        self._bias_shift, self._unobserved_distance, self._age_changed = 0.0, 0.0, False
        self._sensitivity: Array = np.zeros(len(self.covariance))
        self._rest_sensitivity: Array = self._sensitivity
        self._sensitivity_time = -math.inf
        self._stretch = None
        self._pending_stretches.clear()
        self.restart_count += 1

    def _start_correction(self, now: float) -> None:
        """Start the temperature correction of the bias at the present temperature, if known."""
        here, coefficient = self._known_temperature, self._assumptions.bias_temperature_coefficient
        self._follows_temperature = here is not None
        if here is not None and coefficient and not self.table.entries:
            # what a model explains of the temperature, with whatever sign, it leaves at most twice
            explained = 2.0 * self._largest_bias_slope(here)
            coefficient *= max(coefficient / explained, 1.0) if explained else 1.0
        self._correction = (TemperatureCorrection(self.table, here, now, coefficient)
                            if here is not None and coefficient else None)

    def _largest_bias_slope(self, temperature: float) -> float:
        """Return that of the model within 10 K, rad/s/K; 0 where it states no covariance."""
        model = self.current_model
        if model.covariance is None or model.needs_history:
            return 0.0
        around = temperature + np.array([-10.0, 0.0, 10.0])
        return float(np.abs(np.diff(compensate(model, np.zeros(3), around).rate)).max() / 10.0)

    @property
    def calibration_message(self) -> str:
        """Return the message on age and temperature of the calibration; '' if negligible."""
        return (self._calibration_message
                if self.tracker.bias[1] > 0.5 * math.sqrt(self.covariance[-1, -1]) else '')

    @property
    def bias_message(self) -> str:
        """Return the message on several rates that may be the bias; '' if it is known better."""
        tracker, ambiguity = self.tracker, self.tracker.bias_ambiguity
        return (f'several steady rates may be that of a rest: the bias may be off by '
                f'{ambiguity / DEGREE:.3f} deg/s, and the heading by '
                f'{math.sqrt(tracker.variance) / DEGREE:.1f} deg; let the robot rest again after '
                'a turn, or calibrate it' if ambiguity > tracker.bias[1] / math.sqrt(2.0) else '')

    def age(self, now: float) -> float:
        """Return the age of the calibration of the bias, s; a year if it is unknown."""
        age = self._dated_age(now)
        return YEAR if age is None or age < -AGE_TOLERANCE else max(age, 0.0)

    def _dated_age(self, now: float) -> float | None:
        """Return the age, s, by date and clock; None without a date."""
        calibration = self.model.self_calibration
        written = calibration.time if calibration else str(self.model.origin.get('date', ''))
        try:
            when = datetime.fromisoformat(written)
        except ValueError:
            return None
        return now - (when if when.tzinfo else when.replace(tzinfo=timezone.utc)).timestamp()

    def bias_age(self, now: float) -> float:
        """Return the age of the variance of the bias, s, which a propagated one includes."""
        return (self.age(now) if self.current_model.self_calibration is None
                else max(now - self._start_time, 0.0))

    @property
    def bias_variance(self) -> float:
        """Return the variance of the corrected rate at rest by the calibration, (rad/s)²."""
        return float(quadratic_form(self.covariance, self._rest_sensitivity))

    # Samples

    def add_temperature(self, time: float, temperature: float) -> None:
        """Take a temperature, degC, with its stamp, s; an implausible one is refused."""
        coldest, hottest = self.model.temperature_limits
        if coldest <= temperature <= hottest and abs(time) <= MAX_TIME:
            self.temperature, self._temperature_time = temperature, time
        else:
            self.refused_temperature_count += 1

    @property
    def refused_count(self) -> int:
        """Return how many samples were not used."""
        return self._refused_count + self.tracker.refused_count

    @property
    def is_temperature_lost(self) -> bool:
        """Tell whether the last temperature is too old at the last sample."""
        return self._temperature_lateness > 0.0

    @property
    def _known_temperature(self) -> float | None:
        """Return the present temperature, degC; None before the first or if it is too old."""
        return None if self.is_temperature_lost else self.temperature

    def add(self, time: float, output: float, now: float, force: float | None = None,
            wheels: bool | None = None, supply: float | None = None) -> str:
        """
        Take a sample; return why the integration began anew with it, or ''.

        Stamp and present date are in s, the output in rad/s, the specific force in m/s² and the
        supply in V, where they came; `wheels` tells whether wheels or commands move the robot,
        None where unknown. Where the sample is refused, only `refused_count` grows.
        """
        if not self.is_plausible(time, output, force):
            self._refused_count += 1
            return ''
        last, self._time = self._time, time
        known_again = not self._follows_temperature and self._known_temperature is not None
        goes_on = self.is_calibrated_this_run and last > -math.inf
        if self._age_changed or known_again and not goes_on:
            self._restart(now)
        around = None
        if self.current_model.needs_history:
            # Time increases with the stamps, also over gaps, and is constant when they jump back.
            # The heading is that of the tracker without its resets, extrapolated to this sample.
            interval = max(time - last, 0.0) if last > -math.inf else 0.0
            self._elapsed += interval
            ahead = self.rate * interval if interval <= self._settings.maximum_gap else 0.0
            around = self._history.update(
                self._elapsed, self.temperature, force, supply,
                heading=self.heading_before_resets + self.tracker.heading + ahead)
        if known_again and goes_on:
            # This run's calibration was made without a temperature, after the model at the one
            # that was assumed up to the last sample. The different output of the model at the
            # present temperature is not a change of the rate.
            assumed = self.last_compensated.temperature
            before = None if around is None else replace(around, temperature=assumed)
            here, held = (float(compensate(self.current_model, 0.0, degc, channels).model_rate)
                          for degc, channels in ((self.temperature, around), (assumed, before)))
            self._bias_shift = here - held
            self._unobserved_distance = _lost_temperature_distance(time - self._unknown_since)
            self._start_correction(now)
        self.last_compensated = result = compensate(self.current_model, output, self.temperature,
                                                    around)
        change, distance = self._bias_change(time, self.temperature, self._temperature_lateness)
        calibration, tracker = self.current_model.self_calibration, self.tracker
        rate = float(result.rate)
        if change:
            rate -= change * (1.0 if calibration is None else calibration.scale)
        if self._is_outdated(time):
            self._rest_sensitivity, self._sensitivity = (
                self._uncertain_sensitivity(output, seen, result.temperature, around, distance)
                for seen in (0.0, float(result.rate)))
        message = tracker.add(time, rate, self._sensitivity, wheels, self._rest_sensitivity)
        self.corrected_rate, self.rate = rate, tracker.rate
        if message or not tracker.is_resting:
            self._end_rest()
        elif self.temperature is None or self.is_temperature_lost:
            self._stretch = None
        else:
            self._extend_stretch(time, time, 1, float(result.model_rate), self.temperature)
        if tracker.is_resting:
            self._add_to_table(now, True)
        return message

    def is_plausible(self, time: float, output: float, force: float | None) -> bool:
        """Tell whether a sample is plausible for the gyro; `add` refuses others, and any nan."""
        limit = self.current_model.rate_limit
        return (-limit <= output <= limit and -MAX_TIME <= time <= MAX_TIME
                and (force is None or -MAX_SPECIFIC_FORCE <= force <= MAX_SPECIFIC_FORCE))

    def _is_outdated(self, time: float) -> bool:
        """Tell whether sensitivities, which are held for a block, are to be computed at a time."""
        outdated = abs(time - self._sensitivity_time) > BLOCK_DURATION + TIME_TOLERANCE
        if outdated:
            self._sensitivity_time = time
        return outdated

    def _uncertain_sensitivity(self, output: Number, rate: Number, temperature: Number,
                               around: Channels | None, distance: Number) -> Array:
        """Return the sensitivity of the rate to each value of `covariance`, shape (m, ...)."""
        known = rate_sensitivity(self.current_model, output, rate, temperature, around)
        return np.concatenate([np.broadcast_to(-distance, known.shape[1:])[None], known])

    def _bias_change(self, time: float, temperature: Number | None,
                     late: float) -> tuple[Any, Any]:
        """Return the change of the bias with temperature, rad/s, and the distance, K."""
        if temperature is None:
            return 0.0, 0.0
        if self._correction is None:
            return self._bias_shift, _lost_temperature_distance(time - self._unknown_since)
        change, distance = self._correction.change_at(temperature)
        return (self._bias_shift + change, self._unobserved_distance + distance
                + np.copysign(_lost_temperature_distance(late), distance))

    @property
    def _temperature_lateness(self) -> float:
        """Return the time since the temperature is too old, s."""
        return abs(self._time - self._temperature_time) - TEMPERATURE_TIMEOUT

    # A whole log

    def follow(self, time: Array, output: Array, start_time: float,
               temperature: Array | None = None, wheels: Sequence[bool | None] | None = None,
               force: Array | None = None, supply: Array | None = None) -> Array:
        """
        Take the samples of a log, with the same result as one by one.

        The arguments are arrays of those of `add`, or None; the start time is the date of time 0,
        s since 1970, and a temperature that did not come is nan. The result, shape (n, 8), has
        heading, its variance, rate, its variance, 1 at rest, the rate before the tracker, and 1
        where the temperature was clipped and where the output is beyond the range of the model.
        """
        found, place = np.empty((len(time), 8)), 0
        while place < len(time):
            # up to where model, table or temperature correction may change
            end = place
            if not (self.current_model.needs_history or self._time == -math.inf
                    or self._age_changed or self._follows_temperature == (temperature is None)
                    or temperature is None and self.temperature is not None):
                # a complete stretch of rest may restart the tracker
                begin = self._stretch.start_time if self._stretch else float(time[place])
                end += int(np.searchsorted(time[place:], begin + REST_DURATION - TIME_TOLERANCE))
                end = min(end + (self._stretch is not None), len(time),
                          place + CACHE_BLOCK_SAMPLES)
                rows, limit = slice(place, end), self.current_model.rate_limit
                known = (np.abs(output[rows]) <= limit) & (np.abs(time[rows]) <= MAX_TIME)
                if temperature is not None:
                    coldest, hottest = self.model.temperature_limits
                    known &= (coldest <= temperature[rows]) & (temperature[rows] <= hottest)
                if not known.all():
                    end = place + int(np.argmin(known))
            if end > place:
                rows = slice(place, end)
                self._follow_even_samples(time[rows], output[rows],
                                          None if temperature is None else temperature[rows],
                                          None if wheels is None else wheels[rows], found[rows])
            else:
                end = place + 1
                if temperature is not None and temperature[place] == temperature[place]:
                    self.add_temperature(float(time[place]), float(temperature[place]))
                self.add(float(time[place]), float(output[place]), start_time + float(time[place]),
                         None if force is None else float(force[place]),
                         None if wheels is None else wheels[place],
                         None if supply is None else float(supply[place]))
                tracker = self.tracker
                found[place] = (tracker.heading, tracker.variance, self.rate,
                                tracker.rate_variance, tracker.is_resting, self.corrected_rate,
                                self.last_compensated.temperature_clipped,
                                self.last_compensated.beyond_range)
            place, beginnings = end, self.restart_count
            if self.tracker.is_resting:
                self._add_to_table(start_time + float(time[place - 1]), True)
            if self.restart_count > beginnings:
                found[place - 1, [1, 3]] = self.tracker.variance, self.tracker.rate_variance
        return found

    def _follow_even_samples(self, time: Array, output: Array, temperature: Array | None,
                             wheels: Sequence[bool | None] | None, found: Array) -> None:
        """Take plausible samples, at most up to the end of a stretch of rest."""
        used, tracker, last = self.current_model, self.tracker, self._time
        self._time = float(time[-1])
        result = compensate(used, output, temperature)
        change, distance = np.zeros((2, len(time)))
        if temperature is not None:
            self.temperature, self._temperature_time = float(temperature[-1]), self._time
            known = self._bias_change(self._time, temperature, 0.0)
            change += known[0]
            distance += known[1]
        calibration = used.self_calibration
        scale = 1.0 if calibration is None else calibration.scale
        rate = np.asarray(result.rate) - change * scale
        # the sensitivities at rest and in motion, as `add` holds them, (n, m) each
        places = [place for place, at in enumerate(time.tolist()) if self._is_outdated(at)]
        counts, degc = np.diff([0, *places, len(time)]), result.temperature
        if isinstance(degc, np.ndarray):
            degc = degc[places]
        held = list[Array]()
        for before, seen in ((self._rest_sensitivity, np.zeros(len(time))),
                             (self._sensitivity, np.asarray(result.rate))):
            rows = before[None]
            if places:
                rows = np.concatenate([rows, self._uncertain_sensitivity(
                    output[places], seen[places], degc, None, distance[places]).T])
            held.append(np.repeat(rows, counts, axis=0))
        self._rest_sensitivity, self._sensitivity = held[0][-1], held[1][-1]
        found[:, :5] = tracker.follow(time, rate, held[1], wheels, held[0])
        found[:, 5], found[:, 6] = rate, result.temperature_clipped
        found[:, 7] = result.beyond_range
        self.last_compensated = CompensatedSamples(
            *(float(np.asarray(values)[-1]) if np.ndim(values) else values
              for values in vars(result).values()))
        self.corrected_rate, self.rate = float(rate[-1]), float(found[-1, 2])
        interval = np.diff(time, prepend=last)
        stops = np.flatnonzero(
            (found[:, 4] < 0.5) | (interval < 0.0) | (interval > self._settings.maximum_gap))
        first = int(stops[-1]) + 1 if len(stops) else 0
        if first:
            self._end_rest()
        if first < len(time) and temperature is not None:
            self._extend_stretch(float(time[first]), self._time, len(time) - first,
                                 float(np.sum(result.model_rate[first:])),
                                 float(temperature[first:].sum()))

    # The bias at rest for the next run

    def _extend_stretch(self, begin: float, end: float, count: int, modelled: float,
                        temperature: float) -> None:
        """Add samples at rest: stamps of the first and the last, s, and as in `_RestStretch`."""
        stretch = self._stretch = self._stretch or _RestStretch(begin, self._rest_sensitivity)
        stretch.count += count
        stretch.rate_sum += modelled
        stretch.temperature_sum += temperature
        if end - stretch.start_time >= REST_DURATION - TIME_TOLERANCE:
            stretch.sensitivity = self._rest_sensitivity
            self._pending_stretches.append(stretch)
            self._stretch = None

    def update_table(self, now: float, ending: bool = False) -> str:
        """Add the bias of complete rests to the table, regularly; return its message, or ''."""
        self._add_to_table(now, self.tracker.is_resting and not ending)
        message, self._table_message = self._table_message, ''
        return message

    def _end_rest(self) -> None:
        self._stretch = None
        for each in self._pending_stretches:
            each.has_ended = True

    def _add_to_table(self, now: float, resting: bool) -> None:
        """Add the bias of complete stretches of rest to the table."""
        # A stretch is pending until the next one is complete, or the rest or the run has ended: by
        # then the tracker has detected a slow turn.
        while len(self._pending_stretches) > resting:
            stretch = self._pending_stretches.popleft()
            bias, temperature = (total / stretch.count
                                 for total in (stretch.rate_sum, stretch.temperature_sum))
            variance = (self.current_model.noise.angle_random_walk ** 2 / REST_DURATION
                        + self.tracker.bias_ambiguity ** 2)
            # That by the tracker at present, after the model and before the self-calibration: by
            # now the rest may be over, and the temperature may have changed.
            calibration = self.current_model.self_calibration or SelfCalibration()
            expected = calibration.bias + self._bias_shift
            if self._correction is not None:
                expected += float(self._correction.change_at(temperature)[0])
            off, deviation = (value / calibration.scale
                              for value in self.tracker.bias_for(stretch.sensitivity))
            if abs(bias - expected - off) > OUTLIER_SIGMAS * math.sqrt(
                    deviation ** 2 + variance):
                continue
            message = self.table.add(temperature, bias, variance, now)
            self._table_message = message or self._table_message
            # with the new entries, where the coefficient may have changed
            if (self._correction is not None and resting and not stretch.has_ended
                    and abs(temperature - self._correction.start_temperature)
                    > Prior.correlation_length / 3.0):
                self._restart(now)


def _lost_temperature_distance(delay: float) -> float:
    """Return the assumed drift of the temperature, K, some time, s, after its last message."""
    return min(max(delay, 0.0) * _LOST_TEMPERATURE_RATE, Prior.unknown_distance)
