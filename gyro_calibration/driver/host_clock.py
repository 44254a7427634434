"""
Times of a node: even seconds, the date, and stamps of a clock that people and time servers set.

A computer without a battery begins in the wrong year, and is set by months once it finds a time server. Then stamps jump, and nothing
else has happened. So a jump of the stamps counts as none if the clock of this host has just made the same one against its steady clock.

"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

#: A clock that is off by more was set, s; what is less is slewed.
_SET = 0.1
#: For so long after the clock was set stamps of before and after it may come, s.
_MIXED = 10.0
#: Clocks that are read with more between them are not read at one time, s.
_TOGETHER = 0.05


def steady() -> float:
    """Return seconds that nobody sets; they go on while the host sleeps, where it can tell."""
    return time.clock_gettime(_STEADY)


_STEADY = getattr(time, 'CLOCK_BOOTTIME', time.CLOCK_MONOTONIC)


def both() -> tuple[float, float] | None:
    """Return those seconds and the date, s since 1970, of one time; None where the program was held up between them."""
    before, date = steady(), time.time()
    return (before, date) if steady() - before <= _TOGETHER else None


@dataclass
class _Step:
    """A step of the clock, s, when it was seen, by the steady clock, and whether stamps have shown it."""

    size: float
    seen: float
    shown: bool = False


class Stamps:
    """
    Stamps on one axis of time, s, whatever is done to the clock of the host.

    Attributes
    ----------
    steps : how often the clock was set
    last : by how much it was the last time, s

    """

    def __init__(self) -> None:
        """Begin with nothing known of the clocks."""
        self.steps, self.last = 0, 0.0
        self._difference = math.nan
        self._offset = 0.0
        self._recent: list[_Step] = []

    def watch(self, now: float, date: float) -> float:
        """Take what the steady clock and the clock that is set say at one time, s; return by how much it was set since the last call."""
        before, self._difference = self._difference, date - now
        if self._recent and now - self._recent[0].seen > _MIXED:
            del self._recent[0]
        step = self._difference - before
        if not abs(step) > _SET:
            return 0.0
        self.steps, self.last = self.steps + 1, step
        self._recent.append(_Step(step, now))
        return step

    def of_sample(self, stamp: float, before: float, usual: float) -> float:
        """
        Return the time of a sample.

        Parameters
        ----------
        stamp : s
        before : time of the sample before it; -inf for the first, which shows no step of the clock
        usual : interval, s; inf while it is not known

        """
        if before == -math.inf:
            for step in self._recent:
                step.shown = True
        interval = stamp - self._offset - before
        found = min((step for step in self._recent if not step.shown), key=lambda step: abs(interval - step.size), default=None)
        if found is None or not abs(interval - found.size) < 0.5 * abs(interval):
            return stamp - self._offset
        found.shown = True
        left = interval - found.size
        least = usual if usual < math.inf else 0.0
        bridged = left if left > 0.5 * least else least
        self._offset += interval - bridged
        return before + bridged

    def of_other(self, stamp: float, sample: float) -> float:
        """Return the time of what came beside the samples, of which the last was at a time, s; it may be of before or after a step."""
        there = stamp - self._offset
        may_be = [there, *(there + sign * step.size for step in self._recent for sign in (1.0, -1.0))]
        return min(may_be, key=lambda each: abs(each - sample))
