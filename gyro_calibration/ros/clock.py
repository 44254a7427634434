# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The clocks of a node: steady seconds, the date, and ROS time, which may be paused."""

from __future__ import annotations

from collections import deque
import math
from typing import Protocol


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
    Delay of stamps behind the clock of a node, and a test whether both advance equally.

    `min_delay` is the least delay of recent samples, s; nan before the first.

    """

    def __init__(self, clock: Clock, tolerance: float, window: float):
        """Start without samples; tolerance of their delay and window of the test, both in s."""
        self._clock, self._tolerance, self._window = clock, tolerance, window
        self.min_delay = math.nan
        # Time of arrival and delay, s, of samples with less delay than any after them.
        self._min_delays = deque[tuple[float, float]]()
        self._previous: tuple[float, float] | None = None

    def add(self, time: float) -> float:
        """Add the stamp of a sample, s; return its delay beyond the least one, s."""
        now = node_time(self._clock)
        while self._min_delays and self._min_delays[-1][1] >= now - time:
            self._min_delays.pop()
        self._min_delays.append((now, now - time))
        # few samples are delayed for longer than this window, s, and a gyro clock that is 3 % off
        # drifts by 15 ms in it
        while now - self._min_delays[0][0] > 0.5:
            self._min_delays.popleft()
        self.min_delay = self._min_delays[0][1]
        return now - time - self.min_delay

    def find_fault(self) -> str:
        """Return a sentence if stamps and clock advance differently; else ''."""
        now = node_time(self._clock)
        then, before = self._previous or (now, self.min_delay)
        elapsed, grown = now - then, self.min_delay - before
        # In a fast simulation the same delay is more simulated time.
        limit = self._tolerance * (1.0 if self._clock.simulated() is None else 4.0)
        # the clocks of gyros are up to 3 % off
        if abs(grown) > limit + 0.05 * abs(elapsed):
            return (f'this computer was busy, or the clock of the driver is wrong: the stamps on '
                    f'imu/data_raw advanced by {elapsed - grown:.2f} s in {elapsed:.2f} s; reduce '
                    'the load, or check that clock and use_sim_time')
        if self._min_delays and (self._previous is None or elapsed > self._window):
            self._previous = now, self.min_delay
        return ''


class RosTime:
    """
    Whether ROS time advances.

    `paused_duration` is the time since its last advance, s of the steady clock; 0 where it is not
    simulated, inf before a simulation starts.

    """

    def __init__(self) -> None:
        """Start without readings."""
        self.paused_duration = 0.0
        self._last: float | None = -1.0
        self._last_change = self._last_poll = 0.0

    def poll(self, clock: Clock) -> None:
        """
        Compare with the last poll; to be called by one timer.

        Only the time up to that poll counts: after a pause of this process, queued messages of
        /clock are delivered after its timers.
        """
        now, time = clock.steady(), clock.simulated()
        if time != self._last:
            self._last, self._last_change, self._last_poll = time, now, now
        if time is None:
            self.paused_duration = 0.0
        else:
            self.paused_duration = self._last_poll - self._last_change if time else math.inf
        self._last_poll = now
