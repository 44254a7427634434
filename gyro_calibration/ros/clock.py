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

import math
from typing import Protocol


class Clock(Protocol):
    """The clocks that a node reads; tests have their own."""

    def steady(self) -> float:
        """Return seconds of the steady clock, which all guards and time-outs use."""

    def date(self) -> float:
        """Return seconds since 1970 by the clock of the host."""

    def simulated(self) -> float | None:
        """Return simulated time, s, 0 before the simulation starts; None without one."""


def node_time(clock: Clock) -> float:
    """Return the time of the simulation, s, where there is one, else of the steady clock."""
    simulated = clock.simulated()
    return clock.steady() if simulated is None else simulated


class RosTime:
    """
    Whether ROS time advances.

    Attributes
    ----------
    standing : for how long it has stood still, s of the steady clock; 0 where it is not
        simulated, and inf before a simulation starts

    """

    def __init__(self) -> None:
        """Begin with nothing seen."""
        self.standing = 0.0
        self._last: float | None = -1.0
        self._changed = self._polled = 0.0

    def poll(self, clock: Clock) -> None:
        """
        Compare with the last poll; by one timer.

        Only the time up to that poll counts: after a pause of this process, the messages of
        /clock that wait in its queue come after its timers.
        """
        now, time = clock.steady(), clock.simulated()
        if time != self._last:
            self._last, self._changed, self._polled = time, now, now
        if time is None:
            self.standing = 0.0
        else:
            self.standing = self._polled - self._changed if time else math.inf
        self._polled = now
