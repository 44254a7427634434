# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Motion of the wheels of a robot, by odometry and commands of the last second."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
import math

#: Largest age of a velocity that is used, s.
MAX_VELOCITY_AGE = 1.0
#: Longest motion after the last command to move, s.
COASTING_DURATION = 0.5
#: Largest speeds of wheels at standstill, m/s and rad/s.
STANDSTILL_SPEED, _STANDSTILL_RATE = 0.001, 0.0002
ODOMETRY, COMMAND = 'odom', 'cmd_vel'


@dataclass(frozen=True)
class Velocity:
    """A velocity as `geometry_msgs/Twist` has it, m/s and rad/s."""

    linear: tuple[float, float, float] = (0.0, 0.0, 0.0)
    angular: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def is_finite(self) -> bool:
        """Tell whether all parts are finite."""
        return all(math.isfinite(part) for part in (*self.linear, *self.angular))

    @property
    def is_moving(self) -> bool:
        """Tell whether it exceeds the speeds at standstill."""
        return (any(abs(part) > STANDSTILL_SPEED for part in self.linear)
                or any(abs(part) > _STANDSTILL_RATE for part in self.angular))


class Wheels:
    """The last velocity from each source, by the steady clock."""

    def __init__(self) -> None:
        """Start without velocities."""
        self._last: dict[str, tuple[float, Velocity]] = {}
        # begin of uninterrupted standstill by each source, s
        self._standing_since: dict[str, float] = {}
        self._last_motion_command = -math.inf

    def add(self, source: str, velocity: Velocity, now: float) -> None:
        """Add a velocity at its time of arrival, s; one that is not finite is ignored."""
        if not velocity.is_finite:
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
