"""Whether the wheels of a robot turn, as far as odometry and commands of the last second say."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

#: What is older, by its arrival, says nothing, s.
FRESH = 1.0
#: A robot coasts so long after its last command to move, s.
COASTING = 0.5
ODOMETRY, COMMAND = 'odom', 'cmd_vel'


@dataclass(frozen=True)
class Standing:
    """Speeds up to which wheels stand, m/s and rad/s."""

    linear: float = 0.001
    angular: float = 0.0002


class Wheels:
    """What was heard of the wheels, by its source."""

    def __init__(self, standing: Standing):
        """Begin with nothing heard."""
        self._standing = standing
        self._heard: dict[str, tuple[float, bool]] = {}
        self._commanded = -math.inf

    def hear(self, source: str, twist: Any, now: float) -> None:
        """Take a velocity with the parts of a `geometry_msgs/Twist`, that came at a time, s; one that is not finite says nothing."""
        limits = ((twist.linear, self._standing.linear), (twist.angular, self._standing.angular))
        given = [(value, limit) for part, limit in limits for value in (part.x, part.y, part.z)]
        if not all(math.isfinite(value) for value, _ in given):
            return
        moving = any(abs(value) > limit for value, limit in given)
        self._heard[source] = now, moving
        if moving and source == COMMAND:
            self._commanded = now

    def moving(self, now: float) -> bool | None:
        """Return whether they turn; None where nobody says so."""
        fresh = [moving for heard, moving in self._heard.values() if abs(now - heard) <= FRESH]
        if not fresh:
            return None
        return any(fresh) or 0.0 <= now - self._commanded < COASTING

    def age(self, now: float) -> float:
        """Return how old the newest word of them is, s."""
        return now - max((heard for heard, _ in self._heard.values()), default=-math.inf)
