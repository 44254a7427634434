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
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta, timezone
import math

from gyro_calibration.heading.assumptions import (
    assumed,
    Assumptions,
    sensitive,
    TemperatureCorrection,
    uncertain,
)
from gyro_calibration.heading.bias_table import BiasTable, propagated
from gyro_calibration.heading.gaps import CLOSE
from gyro_calibration.heading.tracker import HeadingTracker, Settings
from gyro_calibration.logs.log import Array, DEGREE, Number
from gyro_calibration.model.compensation import (
    compensate,
    Compensated,
    quadratic_form,
    rate_sensitivity,
)
from gyro_calibration.model.effects import Channels
from gyro_calibration.model.gyro_model import GyroModel, SelfCalibration, with_self_calibration
import numpy as np

#: Averaging time of an entry of the table at rest, s.
STRETCH = 10.0
#: Standard deviations from the final bias of the tracker beyond which a mean was not at rest.
_FAR = 4.5
#: Distance from the temperature of the last start, K, at which the tracker is restarted at rest,
#: with the new entries of the table.
_AWAY = 5.0
#: Assumed drift of the temperature after its last message, K/s, and its limit, K.
_LOST_RATE, _LOST = 1.0 / 60.0, 15.0
#: Interval at which the sensitivity at rest is computed, s.
_STILL = 0.5
#: Interval at which the sensitivity in motion is computed, s, and change of the rate at which it
#: is computed earlier, rad/s plus a share of the rate.
_HELD, _NEAR, _ALIKE = 0.1, 0.5 * DEGREE, 0.02
#: Age of a temperature, s, from which on it is held with a growing uncertainty.
TEMPERATURE_TIMEOUT = 10.0
#: Samples of a log in one chunk.
_AT_ONCE = 1 << 15
#: Step of the clock, s, after which the age of a calibration is computed again, and largest time
#: that a calibration may be dated in the future.
_OLDER = 3600.0
#: Largest plausible stamp, s, and specific force, m/s².
_LATEST, _STRONGEST = 1e12, 1e5
#: Assumed age of a calibration without a date, s.
_YEAR = 365.25 * 86400.0


@dataclass
class _Stretch:
    """
    Samples at rest, as sums.

    Attributes
    ----------
    begin : stamp of the first, s
    seen : sensitivity of the rate to each uncertain value, shape (m,), first at the begin, finally
        the mean
    count, modelled, temperature : number, and sums of rates after the model, rad/s, and of
        temperatures, degC
    over : whether the rest has ended

    """

    begin: float
    seen: Array
    count: int = 0
    modelled: float = 0.0
    temperature: float = 0.0
    over: bool = False

    def mean(self) -> tuple[float, float]:
        """Return the mean rate after the model, and temperature."""
        return self.modelled / self.count, self.temperature / self.count


class HeadingEstimator:
    """
    Estimate the heading of a robot.

    Attributes
    ----------
    model : with the stored calibration
    used : the model with the present calibration, by which samples are compensated
    tracker : of the heading
    table : of biases at rest
    temperature : last temperature, degC; None before the first
    rate : last rate, rad/s; zero at rest
    corrected : last rate before the tracker, rad/s
    last : result of the compensation of the last sample
    beginnings : number of starts of the tracker
    refused : number of implausible samples, which are not used and count as lost
    refused_temperatures : number of implausible temperatures, which are not used

    """

    def __init__(self, model: GyroModel, table: BiasTable, assumptions: Assumptions,
                 settings: Settings, temperature_timeout: float, now: float, keep: bool = False):
        """
        Begin at heading zero.

        Parameters
        ----------
        model : with its stored self-calibration, if it has one
        assumptions : of uncalibrated values
        settings : of the tracker
        temperature_timeout : an older temperature is held, and counts as less and less known, s
        now : s since 1970
        keep : the steps of the tracker, for `log_compensation.in_hindsight`

        """
        self._assumptions, self._settings, self._timeout, self._keep = (
            assumptions, settings, temperature_timeout, keep)
        self.temperature: float | None = None
        self._temperature_time, self._anchored, self._this_run, self._other_age = (
            -math.inf, False, False, False)
        self.rate = self.corrected = 0.0
        self.last, self.beginnings = Compensated(0.0, 0.0, 0.0, False, False), 0
        self._time, self._elapsed, self._turned_before = -math.inf, 0.0, 0.0
        self._refused, self.refused_temperatures = 0, 0
        self._stretch: _Stretch | None = None
        self._pending: deque[_Stretch] = deque(maxlen=8)
        self._table_message = ''
        self.model, self.table = model, table
        self._tracker: HeadingTracker | None = None
        self._history = model.history()
        self._begin(now)

    @property
    def tracker(self) -> HeadingTracker:
        """Return the tracker of the heading."""
        assert self._tracker is not None
        return self._tracker

    def use(self, model: GyroModel, now: float) -> None:
        """Use a self-calibration that was made just now; the heading does not jump."""
        self.model, self._this_run = model, True
        self._begin(now, fresh=True)

    def begin_run(self, now: float) -> None:
        """Expect another bias, as after the gyro was without power; the heading does not jump."""
        self.table.begin_run()
        self._this_run = False
        self._begin(now)

    def set(self, settings: Settings) -> None:  # noqa: A003
        """Use other settings of the tracker."""
        self._settings = settings
        self.tracker.set(settings)

    def reset(self) -> None:
        """Set the heading to zero."""
        self._turned_before += self.tracker.heading
        self.tracker.reset()

    def rewind(self, heading: float, variance: float) -> None:
        """Set the heading, rad, and its variance, rad²."""
        self._turned_before += self.tracker.heading - heading
        self.tracker.rewind(heading, variance)

    @property
    def calibrated_now(self) -> bool:
        """Tell whether the calibration was made in this run."""
        return self._this_run

    def clock_was_set(self, step: float) -> None:
        """Correct all dates of this run for a clock that was set by a step, s."""
        self._begun += step
        self.table.clock_was_set(step)
        calibration = self.model.self_calibration
        old = not self._this_run and (calibration is not None or len(self.table.entries) > 0)
        self._other_age = self._other_age or (old and abs(step) > _OLDER)
        if self._this_run and calibration is not None and calibration.time:
            then = datetime.fromisoformat(calibration.time) + timedelta(seconds=step)
            self.model = with_self_calibration(self.model, replace(
                calibration, time=then.isoformat(timespec='seconds')))

    # The calibration at the start

    def _begin(self, now: float, fresh: bool = False) -> None:
        """Propagate the calibration to the present, unless it is new, and start the tracker."""
        self._sentence = ''
        self.used, age = ((assumed(self.model, self._assumptions), 0.0) if fresh
                          else self._carried(now))
        self.covariance = uncertain(self.used, self._assumptions)
        temperature = self.model.reference_temperature
        per_rate = None if self.used.looks_around else np.subtract(*(
            self._sensitive(rate, rate, temperature, None, 0.0)
            for rate in (DEGREE, 0.0))) / DEGREE
        if self._tracker is None:
            self._tracker = HeadingTracker(self.used.noise, self.covariance, self._settings, age,
                                           self._keep, per_rate)
        else:
            self._tracker.use(self.used.noise, self.covariance, age, per_rate)
        self._begun = now
        self._anchor(now)
        self._unknown_since = self._time if fresh and not self._anchored else math.inf
        self._shift, self._unseen_distance, self._other_age = 0.0, 0.0, False
        self._sensitivity: Array = np.zeros(len(self.covariance))
        self._still: Array = self._sensitivity
        self._still_at, self._looked = -math.inf, (-math.inf, 0.0)
        self._held: Array | None = None
        self._stretch = None
        self._pending.clear()
        self.beginnings += 1

    def _anchor(self, now: float) -> None:
        """Start the temperature correction of the bias at the present temperature, if known."""
        here, coefficient = self._known_temperature, self._assumptions.bias_temperature_coefficient
        self._anchored = here is not None
        self._correction = (TemperatureCorrection(self.table, here, now, coefficient)
                            if here is not None and coefficient else None)

    def _resume_temperature(self, now: float, around: Channels | None) -> None:
        """
        Continue at the first temperature with a calibration of this run made without one.

        It was made after the model at the temperature that was assumed up to the last sample. The
        different output of the model at the present temperature is not a change of the rate.

        """
        here = compensate(self.used, 0.0, self.temperature, around).modelled
        before = None if around is None else replace(around, temperature=self.last.temperature)
        held = compensate(self.used, 0.0, self.last.temperature, before).modelled
        self._shift = float(here) - float(held)
        self._unseen_distance = _drifted_unseen(self._time - self._unknown_since)
        self._anchor(now)

    def _carried(self, now: float) -> tuple[GyroModel, float | None]:
        """Return the model to compensate with, and the age of its self-calibration, s, or None."""
        model = assumed(self.model, self._assumptions)
        calibration = model.self_calibration
        if calibration is None:
            here = self._known_temperature
            if here is None or not self.table.entries:
                return model, None
            # the bias of earlier runs
            bias, variance = self.table.predict(here, now)
            return with_self_calibration(
                model, SelfCalibration(0.0, bias, ((0.0, 0.0), (0.0, variance)))), 0.0
        if self.model.self_calibration is None and not self.table.entries:
            return model, None
        worth = propagated(calibration, self.table, self.age(now), now, self._known_temperature,
                           self._this_run)
        self._sentence = worth.sentence
        if (self._dated(now) or 0.0) < -_OLDER:
            self._sentence = (f'the calibration is dated {calibration.time}, which is later than '
                              'the clock of this computer: its age is not known and taken for a '
                              'year; set the clock, or calibrate again')
        return with_self_calibration(model, worth.calibration), 0.0

    @property
    def sentence(self) -> str:
        """Return the message on age and temperature of the calibration; '' if negligible."""
        return (self._sentence
                if self.tracker.bias[1] > 0.5 * math.sqrt(self.covariance[-1, -1]) else '')

    def age(self, now: float) -> float:
        """Return the age of the calibration of the bias, s; a year if it is unknown."""
        age = self._dated(now)
        return _YEAR if age is None or age < -_OLDER else max(age, 0.0)

    def _dated(self, now: float) -> float | None:
        """Return the age, s, by date and clock; None without a date."""
        calibration = self.model.self_calibration
        written = calibration.time if calibration else str(self.model.origin.get('date', ''))
        try:
            when = datetime.fromisoformat(written)
        except ValueError:
            return None
        return now - (when if when.tzinfo else when.replace(tzinfo=timezone.utc)).timestamp()

    def known_for(self, now: float) -> float:
        """Return the age of the variance of the bias, s, which a propagated one includes."""
        return self.age(now) if self.used.self_calibration is None else max(now - self._begun, 0.0)

    @property
    def claimed(self) -> SelfCalibration:
        """Return the calibration at this temperature; an unknown scale has infinite variance."""
        used = (self.used.self_calibration
                or SelfCalibration(covariance=((math.inf, 0.0), (0.0, 0.0))))
        assert used.covariance is not None  # an unknown one is assumed
        variance = self.bias_variance / used.scale ** 2
        return replace(used, bias=used.bias + self._bias_change(self._time)[0],
                       covariance=((used.covariance[0][0], 0.0), (0.0, variance)))

    @property
    def bias_variance(self) -> float:
        """Return the variance of the corrected rate at rest by the calibration, (rad/s)²."""
        return float(quadratic_form(self.covariance, self._still))

    # Samples

    def take_temperature(self, time: float, temperature: float) -> None:
        """Take a temperature, degC, with its stamp, s; an implausible one is refused."""
        coldest, hottest = self.model.temperature_limits
        if coldest <= temperature <= hottest and abs(time) <= _LATEST:
            self.temperature, self._temperature_time = temperature, time
        else:
            self.refused_temperatures += 1

    @property
    def refused(self) -> int:
        """Return how many samples were not used."""
        return self._refused + self.tracker.refused

    @property
    def temperature_is_lost(self) -> bool:
        """Tell whether the last temperature is too old at the last sample."""
        return abs(self._time - self._temperature_time) > self._timeout

    @property
    def _known_temperature(self) -> float | None:
        """Return the present temperature, degC; None before the first or if it is too old."""
        return None if self.temperature_is_lost else self.temperature

    def add(self, time: float, output: float, now: float, force: float | None = None,
            wheels: bool | None = None, supply: float | None = None) -> str:
        """
        Take a sample.

        Parameters
        ----------
        time : stamp, s
        output : rad/s
        now : s since 1970
        force : specific force, m/s², if it came
        wheels : whether wheels or commands move the robot; None where unknown
        supply : voltage, V, if it came

        Returns
        -------
        '', or why the integration began anew with this sample; where the sample is refused, only
        `refused` grows

        """
        if not self.plausible(time, output, force):
            self._refused += 1
            return ''
        last, self._time = self._time, time
        known_again, goes_on = (not self._anchored and self._known_temperature is not None,
                                self._this_run and last > -math.inf)
        if self._other_age or known_again and not goes_on:
            self._begin(now)
        around = (self._look_around(time - last, force, supply)
                  if self.used.looks_around else None)
        if known_again and goes_on:
            self._resume_temperature(now, around)
        self.last = result = compensate(self.used, output, self.temperature, around)
        change, distance = self._bias_change(time)
        calibration, tracker = self.used.self_calibration, self.tracker
        rate = float(result.rate)
        if change:
            rate -= change * (1.0 if calibration is None else calibration.scale)
        if abs(time - self._still_at) > _STILL + CLOSE:
            self._still, self._still_at = self._sensitive(
                output, 0.0, self.last.temperature, around, distance), time
        self._look_at(time, output, float(result.rate), around, distance)
        message = tracker.add(time, rate, self._sensitivity, wheels, self._still)
        self.corrected, self.rate = rate, tracker.rate
        if message or not tracker.resting:
            self._end_rest()
        elif self.temperature is None or self.temperature_is_lost:
            self._stretch = None
        else:
            self._gather(time, time, 1, float(result.modelled), self.temperature, [self._still])
        self._learn_at_rest(now)
        return message

    def plausible(self, time: float, output: float, force: float | None = None) -> bool:
        """Tell whether a sample is plausible for the gyro; `add` refuses others, and any nan."""
        limit = self.used.rate_limit
        return (-limit <= output <= limit and -_LATEST <= time <= _LATEST
                and (force is None or -_STRONGEST <= force <= _STRONGEST))

    def _look_at(self, time: float, output: float, rate: float, around: Channels | None,
                 distance: float) -> None:
        """Update the sensitivity, which is held at rest and for a short time at similar rates."""
        at, looked = self._looked
        if abs(time - at) > _HELD + CLOSE or abs(rate - looked) > _NEAR + _ALIKE * abs(rate):
            self._held, self._looked = None, (time, rate)
            self._held_at = output, rate, self.last.temperature, around, distance
        if self.tracker.resting:
            self._sensitivity = self._still
            return
        if self._held is None:
            self._held = self._sensitive(*self._held_at)
        self._sensitivity = self._held

    def _sensitive(self, output: float, rate: float, temperature: Number, around: Channels | None,
                   distance: float) -> Array:
        """Return the sensitivity of the rate to each uncertain value, shape (m,)."""
        return sensitive(self.used, rate_sensitivity(
            self.used, output, rate, temperature, around), distance)

    def _bias_change(self, time: float) -> tuple[float, float]:
        """Return the change of the bias with temperature, rad/s, and the distance, K."""
        if self.temperature is None:
            return 0.0, 0.0
        if self._correction is None:
            return self._shift, _drifted_unseen(time - self._unknown_since)
        change, distance = self._correction.at(self.temperature)
        late = abs(time - self._temperature_time) - self._timeout
        return (self._shift + change,
                self._unseen_distance + distance + math.copysign(_drifted_unseen(late), distance))

    def _look_around(self, interval: float, force: float | None,
                     supply: float | None) -> Channels:
        """
        Return the channels of effects other than rate, output and temperature.

        Time increases with the stamps, also over gaps, and is constant when they jump back. The
        heading is that of the tracker without its resets, extrapolated to this sample.

        """
        interval = max(interval, 0.0) if interval < math.inf else 0.0
        self._elapsed += interval
        ahead = self.rate * interval if interval <= self._settings.maximum_gap else 0.0
        return self._history.follow(
            self._elapsed, self.temperature, force, supply,
            heading=self._turned_before + self.tracker.heading + ahead)

    # A whole log

    def follow(self, time: Array, output: Array, begun: float, temperature: Array | None = None,
               wheels: Sequence[bool | None] | None = None, force: Array | None = None,
               supply: Array | None = None) -> Array:
        """
        Take the samples of a log, with the same result as one by one.

        Parameters
        ----------
        time, output : s and rad/s, shape (n,)
        begun : date of time 0, s since 1970
        temperature : degC; nan where none came, and None for none at all
        wheels, force, supply : as in `add`, n of them, or None

        Returns
        -------
        heading, its variance, rate, its variance, 1 at rest, the rate before the tracker,
        and 1 where the temperature was clipped and where the output is beyond the range of the
        model, shape (n, 8)

        """
        found, place = np.empty((len(time), 8)), 0
        while place < len(time):
            end = self._even(time, output, temperature, place)
            if end > place:
                rows = slice(place, end)
                self._follow_even(time[rows], output[rows],
                                  None if temperature is None else temperature[rows],
                                  None if wheels is None else wheels[rows], found[rows])
            else:
                end = place + 1
                if temperature is not None and temperature[place] == temperature[place]:
                    self.take_temperature(float(time[place]), float(temperature[place]))
                self.add(float(time[place]), float(output[place]), begun + float(time[place]),
                         None if force is None else float(force[place]),
                         None if wheels is None else wheels[place],
                         None if supply is None else float(supply[place]))
                tracker = self.tracker
                found[place] = (tracker.heading, tracker.variance, self.rate,
                                tracker.rate_variance, tracker.resting, self.corrected,
                                self.last.temperature_clipped, self.last.beyond_range)
            place, beginnings = end, self.beginnings
            self._learn_at_rest(begun + float(time[place - 1]))
            if self.beginnings > beginnings:
                found[place - 1, [1, 3]] = self.tracker.variance, self.tracker.rate_variance
        return found

    def _even(self, time: Array, output: Array, temperature: Array | None, place: int) -> int:
        """Return the end of the samples with the same model, table and temperature correction."""
        if (self.used.looks_around or self._time == -math.inf or self._other_age
                or self._anchored == (temperature is None)
                or temperature is None and self.temperature is not None):
            return place
        # a complete stretch of rest may restart the tracker
        begin = self._stretch.begin if self._stretch else float(time[place])
        end = int(np.searchsorted(time[place:], begin + STRETCH - CLOSE)) + place
        end = min(end + (self._stretch is not None), len(time), place + _AT_ONCE)
        rows, limit = slice(place, end), self.used.rate_limit
        known = (np.abs(output[rows]) <= limit) & (np.abs(time[rows]) <= _LATEST)
        if temperature is not None:
            coldest, hottest = self.model.temperature_limits
            known &= (coldest <= temperature[rows]) & (temperature[rows] <= hottest)
        return end if known.all() else place + int(np.argmin(known))

    def _follow_even(self, time: Array, output: Array, temperature: Array | None,
                     wheels: Sequence[bool | None] | None, found: Array) -> None:
        """Take plausible samples, at most up to the end of a stretch of rest."""
        used, tracker, last = self.used, self.tracker, self._time
        self._time = float(time[-1])
        result = compensate(used, output, temperature)
        change, distance = np.zeros(len(time)), np.zeros(len(time))
        if temperature is not None:
            self.temperature, self._temperature_time = float(temperature[-1]), self._time
            change += self._shift
            distance += self._unseen_distance
            if self._correction is not None:
                changed, far = self._correction.along(temperature)
                change, distance = change + changed, distance + far
            else:
                change[:], distance[:] = self._bias_change(self._time)
        calibration = used.self_calibration
        rate = np.asarray(result.rate) - change * (
            1.0 if calibration is None else calibration.scale)
        still = self._stills(time, output, result, distance)
        found[:, :5] = tracker.follow(
            time, rate, self._looks(time, output, result, distance), wheels, still, still)
        found[:, 5], found[:, 6], found[:, 7] = (
            rate, result.temperature_clipped, result.beyond_range)
        self.last = Compensated(*(float(np.asarray(values)[-1]) if np.ndim(values) else values
                                  for values in vars(result).values()))
        self.corrected, self.rate = float(rate[-1]), float(found[-1, 2])
        self._sensitivity = tracker.sensitivity
        interval = np.diff(time, prepend=last)
        moving = np.flatnonzero((found[:, 4] < 0.5) | (interval < 0.0)
                                | (interval > self._settings.maximum_gap))
        first = int(moving[-1]) + 1 if len(moving) else 0
        if first:
            self._end_rest()
        if first < len(time) and temperature is not None:
            self._gather(float(time[first]), self._time, len(time) - first,
                         float(np.sum(result.modelled[first:])),
                         float(temperature[first:].sum()), (still[first], still[-1]))

    def _stills(self, time: Array, output: Array, result: Compensated, distance: Array) -> Array:
        """Return the sensitivities at rest, computed every `_STILL` s, shape (n, m)."""
        places = list[int]()
        for place, at in enumerate(time.tolist()):
            if abs(at - self._still_at) > _STILL + CLOSE:
                places.append(place)
                self._still_at = at
        rows = self._rows(places, output, np.zeros(len(output)), result, distance)
        counts = np.diff([0, *places, len(time)])
        whole = np.repeat(np.vstack([self._still, rows]), counts, axis=0)
        self._still = whole[-1]
        return whole

    def _looks(self, time: Array, output: Array, result: Compensated, distance: Array) -> Array:
        """Return the sensitivities in motion, which are held for a short time, shape (n, m)."""
        places, (at, looked) = list[int](), self._looked
        rates = np.asarray(result.rate)
        for place, (now, rate) in enumerate(zip(time.tolist(), rates.tolist())):
            if abs(now - at) > _HELD + CLOSE or abs(rate - looked) > _NEAR + _ALIKE * abs(rate):
                places.append(place)
                at, looked = now, rate
        if self._held is None and (not places or places[0]) and self._looked[0] > -math.inf:
            self._held = self._sensitive(*self._held_at)
        held = self._still if self._held is None else self._held
        rows = self._rows(places, output, rates, result, distance)
        self._looked = at, looked
        whole = np.repeat(np.vstack([held, rows]), np.diff([0, *places, len(time)]), axis=0)
        self._held = whole[-1]
        return whole

    def _rows(self, places: list[int], output: Array, rate: Array, result: Compensated,
              distance: Array) -> Array:
        """Return the sensitivities of some samples, shape (k, m)."""
        if not places:
            return np.empty((0, len(self.covariance)))
        temperature = result.temperature
        return sensitive(self.used, rate_sensitivity(
            self.used, output[places], rate[places],
            temperature[places] if isinstance(temperature, np.ndarray) else temperature),
            distance[places]).T

    # The bias at rest for the next run

    def _gather(self, begin: float, end: float, count: int, modelled: float, temperature: float,
                seen: Sequence[Array]) -> None:
        """
        Add samples at rest to a stretch.

        Parameters
        ----------
        begin, end : stamps of the first and the last, s
        count, modelled, temperature : their number, and sums as in `_Stretch`
        seen : sensitivities at rest, of which the first and the last count

        """
        if self._stretch is None:
            self._stretch = _Stretch(begin, seen[0])
        stretch = self._stretch
        stretch.count += count
        stretch.modelled += modelled
        stretch.temperature += temperature
        if end - stretch.begin >= STRETCH - CLOSE:
            stretch.seen = 0.5 * (stretch.seen + seen[-1])
            self._pending.append(stretch)
            self._stretch = None

    def learn(self, now: float, ending: bool = False) -> str:
        """
        Add the bias of complete stretches of rest to the table; to be called regularly.

        A stretch is pending until the next one is complete, or the rest or the run has ended: by
        then the tracker has detected a slow turn.

        Returns
        -------
        '', or the message of the table since the last call

        """
        message, self._table_message = self._table_message, ''
        while len(self._pending) > (self.tracker.resting and not ending):
            message = self._add_to_table(self._pending.popleft(), now) or message
        return message

    def _end_rest(self) -> None:
        self._stretch = None
        for each in self._pending:
            each.over = True

    def _learn_at_rest(self, now: float) -> None:
        """Add a stretch to the table as soon as the next one is complete."""
        while len(self._pending) > 1 and self.tracker.resting:
            message = self._add_to_table(self._pending.popleft(), now)
            self._table_message = message or self._table_message

    def _add_to_table(self, stretch: _Stretch, now: float) -> str:
        bias, temperature = stretch.mean()
        variance = self.used.noise.angle_random_walk ** 2 / STRETCH
        expected, deviation = self._believed(temperature, stretch.seen)
        if abs(bias - expected) > _FAR * math.sqrt(deviation ** 2 + variance):
            return ''
        message = self.table.add(temperature, bias, variance, now)
        if (self._correction is not None and self.tracker.resting and not stretch.over
                and abs(temperature - self._correction.begin) > _AWAY):
            self._begin(now)
        return message

    def _believed(self, temperature: float, seen: Array) -> tuple[float, float]:
        """
        Return bias at a temperature and its standard deviation by the tracker at present, rad/s.

        It is the bias after the model and before the self-calibration. When a stretch is tested,
        its rest may be over, and the temperature may have changed.

        """
        calibration = self.used.self_calibration or SelfCalibration()
        change = self._shift
        if self._correction is not None:
            change += self._correction.at(temperature)[0]
        off, deviation = self.tracker.bias_by(seen)
        return calibration.bias + change + off / calibration.scale, deviation / calibration.scale

    def missing(self, brought: Collection[str]) -> list[str]:
        """Return the channels that the model needs and that no message contains."""
        return [channel for channel in ('supply', 'specific_force')
                if self.used.looks_at(channel) and channel not in brought]


def _drifted_unseen(late: float) -> float:
    """Return the assumed drift of the temperature, K, some time, s, after its last message."""
    return min(max(late, 0.0) * _LOST_RATE, _LOST)
