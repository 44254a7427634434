# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""What a node takes from outside, without rclpy: parameters, clocks, motion of the wheels."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
import math
import reprlib
from types import SimpleNamespace
from typing import Protocol

from gyro_calibration.calibration.self_calibration import RunLimits
import numpy as np

_TYPE_NAMES: dict[type, str] = {bool: 'true or false', int: 'a whole number', float: 'a number',
                                str: 'text', list: 'a list of strings'}


@dataclass(frozen=True)
class NodeParameter:
    """One parameter of a node; its type is the type of its default."""

    name: str  # groups are separated by a dot, as in ``calibration.maximum_bias``
    default: bool | int | float | str | Sequence[str]
    description: str  # one sentence, without the unit
    unit: str = ''
    range: tuple[float, float] | None = None  # noqa: A003  lowest and highest value allowed
    dynamic: bool = False  # may be set while the node runs
    choices: tuple[str, ...] = ()  # allowed values of a text; empty for any

    @property
    def attribute(self) -> str:
        """Return the attribute in the record of values: ``calibration_maximum_bias``."""
        return self.name.replace('.', '_')

    @property
    def choices_text(self) -> str:
        return f'{", ".join(self.choices[:-1])} or {self.choices[-1]}' if self.choices else ''

    def check(self, value: object) -> object:
        """Return the value in the type of the default, or raise `ValueError` with valid ones."""
        if isinstance(self.default, float) and type(value) is int and abs(value) < 1 << 63:
            value = float(value)
        several = isinstance(self.default, Sequence) and not isinstance(self.default, str)
        wanted: type = list if several else type(self.default)
        texts = value if isinstance(value, list) else [value]
        if (type(value) is not wanted
                or several and not all(isinstance(each, str) for each in texts)):
            self._refuse(value, self.choices_text or f'{_TYPE_NAMES[wanted]}, for example '
                         f'{self.default!r}')
        if any('\0' in each for each in texts if isinstance(each, str)):
            self._refuse(value, 'without a zero byte')
        if isinstance(value, float) and not math.isfinite(value):
            self._refuse(value, f'finite, for example {self.default!r}')
        if self.range and isinstance(value, (int, float)):
            low, high = self.range
            if not low <= value <= high:
                self._refuse(value, f'from {low} to {high} {self.unit}'.rstrip())
        if self.choices and value not in self.choices:
            self._refuse(value, self.choices_text)
        if value == '' and self.default:
            self._refuse(value, f'not empty, for example {self.default!r}')
        return value

    def _refuse(self, value: object, wanted: str) -> None:
        raise ValueError(f'parameter {self.name} is {reprlib.repr(value)}, but must be {wanted}')


def parameter_values(table: Sequence[NodeParameter],
                     given: Mapping[str, object]) -> SimpleNamespace:
    """Return the values of a table by attribute: checked given values, else defaults."""
    return SimpleNamespace(**{each.attribute: each.check(given[each.name]) if each.name in given
                              else each.default for each in table})


class Clock(Protocol):
    """The clocks that a node reads; tests inject their own."""

    def steady(self) -> float:
        """Return seconds of the steady clock, for all guards and time-outs."""

    def date(self) -> float:
        """Return seconds since 1970 by the clock of the host."""

    def simulated(self) -> float | None:
        """Return simulated time, s, 0 before the simulation starts; None without one."""


def node_time(clock: Clock) -> float:
    """Return the time of the simulation, s, where there is one, else of the steady clock."""
    simulated = clock.simulated()
    return clock.steady() if simulated is None else simulated


class StampDelay:
    """
    Delay of stamps behind the clock of a node, and tests whether both advance equally.

    Transport and a busy computer delay samples, but the least delay in the longest duration
    follows the stamps. Its changes, less the mean one since the clock of a gyro may drift, are
    time that the heading has missed or counted twice, with an error of up to `unknown_turn`, rad.
    """

    def __init__(self, clock: Clock, window: float, *tolerances: tuple[float, float]):
        """
        Compare with the delays of a window, s, by tolerances, the shortest duration first.

        A tolerance is a duration, s, in which some samples are not late, and a change of their
        delay, s.
        """
        self._clock, self._window, self._tolerances = clock, window, tolerances
        # time of arrival and delay, s, and heading, rad, of samples with less delay than any after
        # them; those of the least delay when the first duration was over, and at present
        self._min_delays = deque[tuple[float, float, float]]()
        self._begin: tuple[float, float, float] | None = None
        self._least = -math.inf, math.nan, math.nan
        self.unknown_turn = self._false_turn = 0.0
        self._first_time, self._last_check = math.inf, -math.inf  # s
        # Times, s, and the least delays at these times for each tolerance, s.
        self._earlier = deque[tuple[float, list[float]]]()

    def add(self, time: float, heading: float = 0.0) -> float:
        """Add a stamp, s, and a heading, rad; return the delay beyond the least one, s."""
        now = node_time(self._clock)
        if self._min_delays and self._least[0] < self._min_delays[0][0] < now:  # a burst is over
            self._use_least()
        while self._min_delays and self._min_delays[-1][1] >= now - time:
            self._min_delays.pop()
        self._min_delays.append((now, now - time, heading))
        return now - time - self.min_delay

    def _use_least(self) -> None:
        (then, delay, heading), self._least = self._least, self._min_delays[0]
        now, late, turned = self._least
        self._first_time = min(self._first_time, now)
        if self._begin is None and now - self._first_time > self._tolerances[-1][0]:
            self._begin = self._least
        if self._begin and self._begin[0] < then < now and self._clock.simulated() is None:
            drift = (delay - self._begin[1]) / (then - self._begin[0])
            self._false_turn += (turned - heading) * ((late - delay) / (now - then) - drift)
            self.unknown_turn = max(self.unknown_turn, abs(self._false_turn))

    @property
    def pace(self) -> float:
        """Return the mean advance of the stamps in 1 s of the clock, s; nan in the beginning."""
        (then, before, _), (now, late, _) = self._begin or self._least, self._least
        return 1.0 - (late - before) / (now - then) if now > then else math.nan

    @property
    def min_delay(self) -> float:
        """Return the least delay in the shortest duration, s."""
        return self._least_delay(self._tolerances[0][0])

    def _least_delay(self, duration: float) -> float:
        """Return the least delay in a duration before the last sample, s."""
        return next((delay for then, delay, _ in self._min_delays
                     if self._min_delays[-1][0] - then <= duration), math.nan)

    def find_fault(self) -> str:
        """Return a sentence if stamps and clock advance differently; else ''."""
        # Only samples that were too old at the last call: after a pause, more may wait.
        while (len(self._min_delays) > 1
                and self._last_check - self._min_delays[0][0] > self._tolerances[-1][0]):
            self._min_delays.popleft()
            self._use_least()
        self._last_check = now = node_time(self._clock)
        # In a fast simulation the same delay is more simulated time.
        factor = 1.0 if self._clock.simulated() is None else 4.0
        while self._earlier and not 0.0 <= now - self._earlier[0][0] <= self._window:
            self._earlier.popleft()
        least = [self._least_delay(duration) for duration, _ in self._tolerances]
        for then, before in self._earlier:
            elapsed = now - then
            for late, early, (_, tolerance) in zip(least, before, self._tolerances, strict=True):
                # the clocks of gyros are up to 3 % off
                if abs(late - early) > factor * tolerance + 0.05 * elapsed:
                    return ('this computer was busy, or the clock of the driver is wrong: the '
                            f'stamps on imu/data_raw advanced by {elapsed - late + early:.2f} s '
                            f'in {elapsed:.2f} s; check load, clock and use_sim_time')
        if self._min_delays and not (
                self._earlier and now - self._earlier[-1][0] < self._tolerances[-1][0]):
            self._earlier.append((now, least))
        return ''


class ArrivalOrder:
    """
    Order of the stamps of one publisher, of which some may come late: after a later one.

    Three late ones in a row are of a clock that was set back. Late ones at equal intervals, up to
    a factor of two, while others come in between are of a second gyro.
    """

    def __init__(self) -> None:
        self.has_two_clocks, self._last, self._late_in_a_row = False, -1, 0
        self._late = deque[int](maxlen=24)  # stamps, ns

    def is_late(self, stamp: int) -> bool:
        """Add a stamp, ns, and tell whether it is late; not if its clock was set back."""
        self._late_in_a_row += 1
        if stamp >= self._last or self._late_in_a_row > 2:
            if stamp < self._last:
                self._late.clear()
            self._last, self._late_in_a_row = stamp, 0
            return False
        self._late.append(stamp)
        apart = np.diff(self._late)
        self.has_two_clocks = bool(len(self._late) == self._late.maxlen
                                   and 0 < apart.max() < 2 * apart.min())
        return True


class RosTime:

    def __init__(self) -> None:
        # since its last advance, s; 0 where it is not simulated, inf before a simulation starts
        self.paused_duration = 0.0
        self._last: float | None = -1.0
        self._last_change = self._last_poll = 0.0

    def poll(self, clock: Clock) -> None:
        """Compare with the last poll; to be called by one timer."""
        # only up to that poll: after a pause of this process, /clock comes after its timers
        now, time = clock.steady(), clock.simulated()
        if time != self._last:
            self._last, self._last_change, self._last_poll = time, now, now
        self.paused_duration = (0.0 if time is None else math.inf if not time
                                else self._last_poll - self._last_change)
        self._last_poll = now


#: Shortest fault of the samples, s: none come (of a slower gyro for four intervals), they repeat a
#: value, or their stamps or ROS time stand still.
FAULT_DURATION = 0.25
MAX_VELOCITY_AGE = 1.0  # largest age of a velocity that is used, s; slower odometry shows nothing
#: Longest motion after the last command to move, s: the default time-out of ros2_control's
#: diff_drive_controller.
COASTING_DURATION = 0.5
#: Least rate of a turn by odometry, rad/s: 2.9 deg/s, beyond the bias of a gyro.
MIN_ODOMETRY_TURN_RATE = 0.05
#: Angular acceleration between two samples, rad/s²: the default of Nav2's controllers.
MAX_ANGULAR_ACCELERATION = 3.2
ODOMETRY, COMMAND = 'odom', 'cmd_vel'


@dataclass(frozen=True)
class Velocity:
    """A velocity as `geometry_msgs/Twist` has it, m/s and rad/s."""

    linear: tuple[float, float, float] = (0.0, 0.0, 0.0)
    angular: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def is_moving(self) -> bool:
        # what turns slower adds 0.011 deg/s at most to the bias at rest
        return (any(abs(part) > 0.001 for part in self.linear)
                or any(abs(part) > 0.0002 for part in self.angular))


class TurnComparison:
    """
    Comparison of the turns by the gyro with those by odometry or commands, a radian at a time.

    Turns contradict each other where two in a row have opposite signs by odometry, or a ratio
    beyond the geometric mean of 1 and that of deg/s to rad/s. As a robot may be turned by others
    than the commands, or scale them, the ratio by commands times the rate by the gyro, usually
    about 1 rad/s, must exceed 57.3 rad/s.

    The sensitivity of the gyro is wrong where it turns further than odometry from one standstill
    to the next, twice in a row and by more than the largest scale factor error of a calibration:
    wheels that slip turn further than the gyro.
    """

    def __init__(self) -> None:
        # found twice in a row, each a sentence or ''; and what the last turn shows
        self.faults, self._last_faults = (dict.fromkeys(('turn', 'scale'), '')
                                          for _ in range(2))
        self._source = ''
        self._stood_at, self._since_standstill = math.nan, 0.0  # by the gyro and wheels, rad
        self._last = math.nan, math.nan
        self._by_wheels = self._by_gyro = self._path = self._duration = 0.0  # rad, rad, rad, s
        self._at_rest: list[tuple[float, float]] = []  # as `_last`, a second apart, at standstill
        self._least_rate = math.inf  # by the gyro, in a second at standstill, rad/s

    @property
    def turn_at_rest(self) -> tuple[float, float, float]:
        """Return duration, s, turn, rad, and least rate in a second, at standstill."""
        # two seconds pass before a robot stands, and one until a late odometry shows its turn
        if len(self._at_rest) < 4:
            return 0.0, 0.0, 0.0
        (begin, before), (end, after) = self._at_rest[2], self._at_rest[-2]
        return end - begin, abs(after - before), self._least_rate

    def add(self, source: str, time: float, rate: float, heading: float, *,
            stands: bool = False) -> None:
        """Add time, s, and rate, rad/s, by a source, and the heading by the gyro, not reset."""
        (then, before), self._last = self._last, (time, heading)
        is_next = 0.0 < time - then <= MAX_VELOCITY_AGE and source == (self._source or source)
        self._source = source
        if not (is_next and stands):
            self._at_rest.clear()
            self._least_rate = math.inf
        if stands and (not self._at_rest or time - self._at_rest[-1][0] >= MAX_VELOCITY_AGE):
            if len(self._at_rest) > 2:
                past, angle = self._at_rest[-1]
                self._least_rate = min(self._least_rate, abs(heading - angle) / (time - past))
            del self._at_rest[3:-1]
            self._at_rest.append((time, heading))
            if len(self._at_rest) == 3:
                self._compare_whole_turn(heading)
        self._since_standstill += rate * (time - then) if is_next else math.nan
        # at slower rates the bias of a gyro may be larger
        if not is_next or abs(rate) <= MIN_ODOMETRY_TURN_RATE:
            return
        self._by_wheels += rate * (time - then)
        self._by_gyro += heading - before
        self._path += abs(heading - before)
        self._duration += time - then
        if abs(self._by_wheels) > 1.0:  # rad
            ratio, rate = self._by_gyro / self._by_wheels, self._path / self._duration
            confused, is_odometry = 180.0 / math.pi, source == ODOMETRY
            between, shown = math.sqrt(confused), f'{ratio:.2g} times what {source} shows'
            is_wrong = (ratio > between and (is_odometry or ratio * rate > confused)
                        or is_odometry and ratio < -0.5)
            self._check('turn', is_wrong * (f'{shown}: check the unit and the sense of rotation '
                                            f'of the gyro, and those of {source}'))
            self._by_wheels = self._by_gyro = self._path = self._duration = 0.0

    def _check(self, name: str, fault: str) -> None:
        before, self._last_faults[name] = self._last_faults[name], fault
        self.faults[name] = fault and before and f'the gyro turns by {fault}'

    def _compare_whole_turn(self, heading: float) -> None:
        """Compare the turn since the last standstill, of which late odometry misses nothing."""
        turned, by_wheels = heading - self._stood_at, self._since_standstill
        self._stood_at, self._since_standstill = heading, 0.0
        if self._source == ODOMETRY and abs(by_wheels) > 1.0:  # rad
            ratio = turned / by_wheels
            self._check('scale', (ratio > 1.0 + RunLimits.max_scale_factor_error) * (
                f'{ratio:.2f} times what odom shows: check the sensitivity of the gyro, and '
                'diameter and distance of the wheels'))


class AlternateTurns:
    """
    Comparison of the turns by every other sample, and by those between, half a radian at a time.

    Both are equal, of samples of a single gyro. They contradict each other, as with another gyro
    on the topic, where they differ by more than the largest scale factor error of a calibration,
    in the same proportion in turns of a row whose sense changes twice: a vibration near half the
    sample rate has the opposite proportion in the other sense. Turns of less than 0.025 rad/s do
    not count, as the biases of the two may differ.
    """

    def __init__(self) -> None:
        self._samples: list[tuple[float, float]] = []  # the last ones, up to 2; s and rad/s
        self._turned = self._between = self._duration = 0.0  # rad, rad, s
        # difference over sum in turns of a row, their last sense, and how often it changed
        self._share, self._sense, self._changes = math.nan, 0.0, 0
        self.is_contradictory = False

    def add(self, time: float, rate: float) -> None:
        """Add a sample, s and rad/s."""
        self._samples.append((time, rate))
        if len(self._samples) < 3:
            return
        (begin, before), (_, middle), _ = self._samples
        self._samples, interval = self._samples[2:], time - begin
        if 0.0 < interval <= MAX_VELOCITY_AGE:
            # the mean of both neighbours is the rate between them also while the robot accelerates
            self._turned += 0.5 * (before + rate) * interval
            self._between += middle * interval
            self._duration += interval
            total, apart = self._turned + self._between, self._turned - self._between
            if abs(total) > 1.0:  # rad
                allowed, share = RunLimits.max_scale_factor_error, apart / total
                if not abs(apart) > allowed * max(abs(self._turned), abs(self._between)):
                    share = math.nan
                is_alike = abs(share - self._share) <= allowed * abs(share)
                self._changes = is_alike * (self._changes + (total * self._sense < 0.0))
                self.is_contradictory = self._changes > 1
                self._share, self._sense = self._share if is_alike else share, total
            elif self._duration * MIN_ODOMETRY_TURN_RATE <= 1.0:
                return
        self._turned = self._between = self._duration = 0.0


class Wheels:
    """The last velocity from each source, by the steady clock."""

    def __init__(self) -> None:
        self._last: dict[str, tuple[float, Velocity]] = {}
        # begin of uninterrupted standstill by each source, s
        self._standing_since: dict[str, float] = {}
        self._last_motion_command = -math.inf

    def add(self, source: str, velocity: Velocity, now: float) -> None:
        """Add a velocity at its time of arrival, s; one that is not finite is ignored."""
        if not all(map(math.isfinite, (*velocity.linear, *velocity.angular))):
            return
        then, _ = self._last.get(source, (-math.inf, None))
        if velocity.is_moving or now - then > MAX_VELOCITY_AGE:
            self._standing_since[source] = now
        self._last[source] = now, velocity
        if velocity.is_moving and source == COMMAND:
            self._last_motion_command = now

    def is_moving(self, now: float, sources: Collection[str] = (ODOMETRY, COMMAND)) -> bool | None:
        """Return whether the robot moves by these sources; None without recent data."""
        fresh = [velocity.is_moving for source, (then, velocity) in self._last.items()
                 if source in sources and now - then <= MAX_VELOCITY_AGE]
        if not fresh:
            return None
        return (any(fresh)
                or COMMAND in sources and now - self._last_motion_command < COASTING_DURATION)

    def has_stood(self, since: float, now: float, sources: Collection[str]) -> bool:
        """Tell whether one of these sources has shown standstill since a time, s."""
        return self.is_moving(now, sources) is False and any(
            self._standing_since[source] <= since
            for source in sources if source in self._standing_since)

    def turn_rate(self, now: float) -> float:
        """Return the rate about z by odometry, rad/s; 0 without recent data."""
        then, velocity = self._last.get(ODOMETRY, (-math.inf, Velocity()))
        return velocity.angular[2] if now - then <= MAX_VELOCITY_AGE else 0.0

    def age(self, now: float) -> float:
        """Return the age of the last velocity, s."""
        return now - max((then for then, _ in self._last.values()), default=-math.inf)
