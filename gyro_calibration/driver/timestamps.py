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
Clocks: the time of sending of each sample, and continuous time where a clock is set.

`SampleClock` stamps samples. They arrive late, because a USB adapter holds bytes for 16 ms or the
host is busy, but never early. So the time of a sample is a straight line over its number: the line
under all arrivals of the last 20 s with the least sum of distances [1]_. The number is the
sequence of the device, or its time, or a count. Lost samples without other evidence are detected
too: all later samples are late by whole periods. Samples counted twice are detected at the next
arrival, which is early.

`ClockSteps` detects that a clock was set. A computer without a battery starts with a wrong date
and is set by months when it finds a time server; then the stamps jump. `NodeTime` converts a
steady clock to stamps of such a clock, `HostClock` converts its stamps to a continuous time.

No clock is read here, except by `steady`: the caller gives the time of arrival.

References
----------
.. [1] Moon, Skelly, Towsley: Estimation and removal of clock skew from network delay
   measurements, INFOCOM 1999.

"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
import math
import time

from gyro_calibration.driver.protocols import Sample

_Point = tuple[float, float]

_LEAST_STEP = 1e-6  # s; least step of stamps: the resolution of a double in seconds since 1970
_WINDOW = 20.0  # s; window of the line: 200 arrivals at 10 Hz, little drift of a warming clock
_BLOCKS = 32  # least number of blocks in a full window; the largest is twice this
_SETTLED = 2.0  # s; least span of a line before its period shows lost samples
_SLEW = (0.2, 1.0)  # s; time constant of stamps to the line, before and after it has settled
_HOLD = 0.3  # s; least duration of lateness that proves a loss: a stalled host catches up
_LONG = 1.5  # s; duration after which the lateness itself is tested, not only its change
_CHANCE = 1e-6  # probability that as many arrivals are late without a loss
_WINDOWS = 64  # windows of `_HOLD` each, over which a slow sweep of the lateness is averaged
_SWEEPING = 0.2  # share of those windows that shows a sweep; by chance it is a few
_MEMORY = 256  # arrivals, over which the share of late ones without a loss is averaged
_JITTER_TIME = 10.0  # s; averaging time of the jitter
_DRIFT = 2e-5  # largest increase of the device clock rate while counts are uncertain, 1
_FINEST = 0.5e-3  # s; least lateness that proves a loss: the host may wake up later than before
_OUTLYING = 0.02  # s; largest lateness with a correct sequence, above the 16 ms of a burst
_ODD = 8  # successive advances that do not fit the mean one show that it is wrong
_LARGEST_JUMP = 3.0  # s; largest continuous step of the time of a device
_SET = 0.1  # s; largest difference of a clock that is slewed; beyond it the clock was set
_MIXED = 10.0  # s; after a clock was set, older stamps may still arrive for this time
_TOGETHER = 0.05  # s; longest duration of a simultaneous reading of two clocks
_FOLLOWING = 2.0  # s; time constant of the difference of two clocks


class LowerLine:
    """
    The line below all points with the least sum of distances.

    Only the lowest point of each block of time is kept. The line is the edge of their lower hull
    over their mean. Blocks grow with the time span of the points, up to 20 s in total; older
    points are dropped. With less than two points, the slope is the given one.

    """

    def __init__(self, slope: float):
        self.slope = slope
        self._points: list[_Point] = []
        self._anchor = (0.0, 0.0)
        self._begin, self._block_begin, self._length = 0.0, -math.inf, 0.0

    @property
    def is_known(self) -> bool:
        """Whether there is a point."""
        return bool(self._points)

    def at(self, x: float) -> float:
        """Return the height of the line."""
        return self._anchor[1] + self.slope * (x - self._anchor[0])

    def span(self) -> float:
        """Return the height of the last point above the first one ever added."""
        return self._points[-1][1] - self._begin if self._points else 0.0

    def add(self, x: float, y: float) -> None:
        """Add a point that is not lower than the one before; x is larger than before."""
        if not self._points:
            self._begin, self._anchor = y, (x, y)
        if y - self._block_begin >= self._length:
            self._points.append((x, y))
            self._block_begin = y
            self._limit()
        elif y - self.slope * x <= self._points[-1][1] - self.slope * self._points[-1][0]:
            self._points[-1] = (x, y)
        else:
            return
        self._fit()

    def shift(self, since: float, by: float) -> None:
        """Shift the points from a height on along x, and drop points that they overtake."""
        moved = [(x + by, y) for x, y in self._points if y >= since]
        first = moved[0][0] if moved else math.inf
        self._points = [(x, y) for x, y in self._points if y < since and x < first] + moved

    def _limit(self) -> None:
        """Merge blocks in pairs while they are short, then drop the oldest."""
        if len(self._points) <= 2 * _BLOCKS:
            return
        if self._length >= _WINDOW / 2 / _BLOCKS:
            del self._points[0]
            return
        pairs = zip(self._points[0::2], [*self._points[1::2], self._points[-1]], strict=False)
        self._points = [min(pair, key=lambda point: point[1] - self.slope * point[0])
                        for pair in pairs]
        self._length = max(2.0 * self._length, self.span() / _BLOCKS)

    def _fit(self) -> None:
        hull = _lower_hull(self._points)
        middle = sum(x for x, _ in self._points) / len(self._points)
        left, right = next((edge for edge in pairwise(hull) if edge[1][0] >= middle),
                           (hull[-1], None))
        self._anchor = left
        if right is not None and right[1] > left[1]:
            self.slope = (right[1] - left[1]) / (right[0] - left[0])


def _lower_hull(points: Sequence[_Point]) -> list[_Point]:
    """Return the corners of the lower convex hull of points in the order of x."""
    hull: list[_Point] = []
    for x, y in points:
        while hull:
            (a, height), (left, low) = hull[-1], hull[-2] if len(hull) > 1 else (0.0, 0.0)
            is_above = (height - low) * (x - left) >= (y - low) * (a - left)
            if a < x and not (len(hull) > 1 and is_above):
                break
            hull.pop()
        hull.append((x, y))
    return hull


class _Numbers:
    """
    Numbers samples in nominal periods; the mean advance is `size`.

    By the sequence of the device, by its time, or by counting. The number may be wrong by a
    multiple of `unit` samples; `unit` is 0 where the device gives its time.

    """

    def __init__(self, rate: float, modulus: int):
        self._rate, self.modulus = rate, modulus
        self._time: float | None = None
        self._outlier: float | None = None
        self.reset()

    def reset(self) -> None:
        self.size, self.unit, self._unevenness, self._stands = 1.0, 1, 0.0, False
        self._odd_advances, self._odd_lost = list[float](), 0
        self._sequence: int | None = None
        self._time = self._outlier = None

    def step(self, sample: Sample, most: float = math.inf,
             round_fits: bool = False) -> tuple[float, int]:
        """
        Return the advance to this sample, and the number of samples lost before it.

        A time of the device beyond `most` is wrong: the sample came too early. A repeated sequence
        is stuck, unless a whole cycle of it fits into the time.

        """
        if self.modulus and sample.sequence is not None:
            return self._by_sequence(sample.sequence, sample.missing, round_fits)
        if sample.time is not None:
            return self._by_time(sample.time, sample.missing, most)
        advance = self.size * (1 + sample.missing)
        self._time = None if self._time is None else self._time + advance / self._rate
        return advance, sample.missing

    def _by_sequence(self, sequence: int, missing: int, round_fits: bool) -> tuple[int, int]:
        last, self._sequence, stood = self._sequence, sequence, self._stands
        self._stands = sequence == last and (stood or not round_fits)
        self.unit = 1 if self._stands else self.modulus
        if last is None:
            return 1, 0
        if self._stands or stood:  # after it was stuck, it counts from the next sample on
            return 1 + missing, missing
        advance = (sequence - last) % self.modulus or self.modulus
        # The number of missing samples by damaged bytes gives the number of wraps.
        advance += self.modulus * max(0, round((1 + missing - advance) / self.modulus))
        return advance, advance - 1

    def _by_time(self, time: float, missing: int, most: float) -> tuple[float, int]:
        self.unit = 0
        largest = min(_LARGEST_JUMP, most / self._rate)
        elapsed = next((time - last for last in (self._time, self._outlier)
                        if last is not None and _LEAST_STEP <= time - last <= largest), None)
        if elapsed is None:  # a single outlier in the time of the device
            self._outlier = time
            advance = self.size * (1 + missing)
            self._time = time if self._time is None else self._time + advance / self._rate
            return advance, missing
        self._time, self._outlier = time, None
        advance = elapsed * self._rate
        lost = self._lost(advance)
        if lost >= 0:  # damaged bytes show losses that coarse times do not
            lost = max(lost, min(missing, round(advance / self.size) - 1))
        return advance, lost

    def _lost(self, advance: float) -> int:
        if self._unevenness == 0.0:
            self.size, self._unevenness = advance, 0.01
            return 0
        steps = advance / self.size
        # Times with a resolution near the period do not show single samples.
        lost = round(steps) - 1 if steps > 2.5 or steps > 1.5 and self._unevenness < 0.15 else 0
        if not 0.3 <= steps <= 2.5:
            return self._odd(advance, max(lost, 0))
        self._odd_advances, self._odd_lost = [], 0
        self.size += 0.05 * (advance - self.size)
        self._unevenness += 0.05 * (abs(steps - round(steps)) - self._unevenness)
        return lost

    def _odd(self, advance: float, lost: int) -> int:
        """Set the mean advance from odd ones in a row; cancel the losses that they showed."""
        self._odd_advances.append(advance)
        self._odd_lost += lost
        if len(self._odd_advances) < _ODD:
            return lost
        self.size = sorted(self._odd_advances)[_ODD // 2]
        before = self._odd_lost - lost
        self._odd_advances, self._odd_lost = [], 0
        return -before


class _Lateness:
    """
    Test whether samples have been late for so long that some must be lost.

    Where the rate of bursts is near a multiple of the sample rate, the lateness grows slowly to a
    period and falls to zero (a sweep). So the step of the least lateness is tested; the lateness
    itself is tested only after a longer time. During a sweep, a step by one period is a sample
    that moved into the next burst, and no loss.

    """

    def __init__(self) -> None:
        self.since: float | None = None
        self._usual = 0.5  # share of the arrivals in time
        self._in_time = math.inf  # the last arrival in time
        self._least_in_time, self._least_before, self._window = math.inf, math.inf, -math.inf
        self._sweeping = 0.0  # share of windows whose least lateness exceeds half of the bound
        self.reset()

    def reset(self) -> None:
        self.since, self.step, self._least = None, 0.0, math.inf
        self._count, self._number, self._arrival = 0, 0.0, 0.0

    def is_proven(self, lateness: float, bound: float, number: float, arrival: float,
                  period: float) -> bool:
        """
        Add an arrival; tell whether all have been late beyond the bound for long enough.

        They are late by `step`, since `since`.

        """
        if lateness <= bound:
            self._is_in_time(lateness, bound, arrival)
            return False
        # Lateness before a silence does not show losses in the silence.
        if self.since is None or arrival - self._arrival > max(0.5 * _HOLD, 3.0 * period):
            self.since, self._number, self._count, self._least = arrival, number, 0, math.inf
        self._least, self._arrival = min(self._least, lateness), arrival
        self._count += 1
        needed = math.log(_CHANCE) / math.log1p(-min(max(self._usual, 0.02), 0.99))
        lasts = arrival - self.since
        before = 0.0 if lasts > _LONG else max(0.0, min(self._least_in_time, self._least_before))
        self.step = self._least - before
        is_slip = self._sweeping > _SWEEPING and self._least < 1.5 * bound
        return lasts >= _HOLD and self._count >= needed and self.step > bound and not is_slip

    def is_no_loss(self, number: float, arrival: float, slope: float) -> bool:
        """Tell whether the sample rate fell, or the lateness exceeds the time that it lasts."""
        assert self.since is not None
        grows = (number - self._number) * slope < 0.5 * (arrival - self.since)
        return grows or self._least > self.since - self._in_time + _HOLD

    def _is_in_time(self, lateness: float, bound: float, arrival: float) -> None:
        # Average over one arrival in time, and the late ones before it without a loss.
        self._usual *= (1.0 - 1.0 / _MEMORY) ** self._count
        self._usual += (1.0 - self._usual) / _MEMORY
        self.reset()
        self._in_time = arrival
        if arrival - self._window > _HOLD:
            is_late = 0.5 * bound < self._least_in_time < math.inf
            self._sweeping += (is_late - self._sweeping) / _WINDOWS
            self._window, self._least_before = arrival, self._least_in_time
            self._least_in_time = math.inf
        self._least_in_time = min(self._least_in_time, lateness)


class SampleClock:
    """
    Stamps samples; stamps increase strictly.

    Corrections by the line, see `LowerLine`, are slewed. A stamp jumps only where later arrivals
    show that samples were lost. The nominal rate of the gyro is used for the first samples only:
    its clock is 2 to 3 % off from unit to unit.

    Parameters
    ----------
    rate : nominal samples per second
    modulus : modulus of `Sample.sequence`; 0 for a device without a sequence
    after : lower limit of the stamps: the last stamp of another clock

    Attributes
    ----------
    lost : samples lost so far while the port was open: missing in the sequence or in the time of
        the device, damaged, or shown by the lateness of all later samples
    period : fitted interval between samples, s
    jitter : root mean squares over the last 10 s: lateness of samples, and deviation of stamps
        from the line, s

    """

    def __init__(self, rate: float, modulus: int = 0, after: float = -math.inf):
        self._numbers = _Numbers(rate, modulus)
        self._lateness, self._outlying = _Lateness(), _Lateness()
        self._line = LowerLine(1.0 / rate)
        self._number, self._slew = 0.0, 0.0
        self._uncertain, self._uncertain_since, self._just_lost = 0, 0.0, 0
        self._last, self._arrival, self._before = after, -math.inf, -math.inf
        self._squares = 0.0, 0.0
        self.lost = 0

    @property
    def period(self) -> float:
        """Seconds from one sample to the next."""
        return self._line.slope * self._numbers.size

    @property
    def is_settled(self) -> bool:
        """Whether the line spans enough time to know the period."""
        return self._line.span() >= _SETTLED

    @property
    def jitter(self) -> tuple[float, float]:
        """Root mean squares of lateness and of the deviation of stamps from the line, s."""
        return math.sqrt(self._squares[0]), math.sqrt(self._squares[1])

    def interrupt(self) -> None:
        """Start a new line, as after a loss of the port; no samples count as lost meanwhile."""
        self._numbers.reset()
        self._begin_anew()

    def stamp(self, samples: Sequence[Sample], arrival: float) -> list[float]:
        """Return stamps of samples by their time of arrival on a steady clock, s."""
        if not samples:
            return []
        self._before, self._arrival = self._arrival, max(arrival, self._arrival)
        arrival = self._arrival
        numbers = self._count(samples, arrival)
        if shift := self._evidence(numbers[-1], arrival):
            numbers = [number + shift for number in numbers]
        self._fit(numbers[-1], arrival)
        return self._increasing([self._line.at(number) + self._slew for number in numbers],
                                arrival)

    def _count(self, samples: Sequence[Sample], arrival: float) -> list[float]:
        number, before = self._number, self.lost
        numbers: list[float] = []
        for sample in samples:
            most = self._most(number, arrival)
            round_fits = self.is_settled and most >= self._numbers.modulus
            advance, lost = self._numbers.step(sample, most, round_fits)
            number += advance
            self.lost += lost
            numbers.append(number)
        self._just_lost = self.lost - before
        if self._just_lost:
            self._uncertain += self._just_lost
            self._uncertain_since = arrival
        return numbers

    def _most(self, number: float, arrival: float) -> float:
        """Return the largest advance from a number to a sample that has arrived."""
        if not self._line.is_known:
            return math.inf
        margin = 0.5 * max(self.period, _FINEST) if self.is_settled else _OUTLYING
        left = (arrival + margin - self._line.at(number)) / self._line.slope
        return max(left, 1.5 * self._numbers.size)

    def _evidence(self, number: float, arrival: float) -> int:
        """Correct the count of lost samples by the arrivals; return the correction."""
        if not self.is_settled:
            return 0
        unit, lateness = self._numbers.unit, arrival - self._line.at(number)
        bound = max((unit or 1) * self.period, _FINEST)
        if lateness < -0.5 * bound:
            return self._counted_too_often(unit, lateness)
        late = lateness, 0.75 * bound, number, arrival, self.period
        if unit and self._lateness.is_proven(*late):
            return self._lost_without_trace(unit, number, arrival)
        # After a restart of the sequence, all samples are off by the same part of it.
        least = max(3.0 * self.period, _OUTLYING)
        if unit > 1 and (lateness < -least or lateness < 0.75 * bound and self._outlying.is_proven(
                lateness, least, number, arrival, self.period)):
            self._begin_anew()
        return 0

    def _counted_too_often(self, unit: int, lateness: float) -> int:
        excess = unit and unit * round(-lateness / (unit * self.period))
        if excess and excess <= self._uncertain:
            return self._renumber(self._uncertain_since, -excess)
        if not unit:  # a wrong time of the device: the apparent losses are cancelled
            self.lost -= self._just_lost
        if unit != 1:  # or a sequence that was restarted
            self._begin_anew()
        return 0

    def _lost_without_trace(self, unit: int, number: float, arrival: float) -> int:
        late = self._lateness
        lost = unit * math.floor(late.step / (unit * self.period) + 0.25)
        assert late.since is not None
        since, is_no_loss = late.since, late.is_no_loss(number, arrival, self._line.slope)
        late.reset()
        if is_no_loss:
            self._begin_anew()
            return 0
        self._uncertain_since = since
        return self._renumber(since, lost)

    def _renumber(self, since: float, by: int) -> int:
        self._line.shift(since, by)
        self.lost += by
        self._uncertain += by
        return by

    def _begin_anew(self) -> None:
        self._line = LowerLine(self._line.slope)
        self._lateness.reset()
        self._outlying.reset()
        self._slew, self._uncertain = 0.0, 0

    def _fit(self, number: float, arrival: float) -> None:
        line, is_first = self._line, not self._line.span()
        before = line.at(number) + self._slew
        lowest = -math.inf
        if (self.is_settled and self._uncertain and self._numbers.unit
                and arrival - self._uncertain_since < _HOLD):  # near the line
            lowest = line.at(number) - _DRIFT * (arrival - self._before)
        line.add(number, max(arrival, lowest))
        elapsed, self._number = max(0.0, number - self._number) * line.slope, number
        slew = 0.0 if is_first else before - line.at(number)
        slew *= math.exp(-elapsed / _SLEW[line.span() > _SETTLED])
        self._slew = min(slew, arrival - line.at(number))

    def _increasing(self, stamps: list[float], arrival: float) -> list[float]:
        first, last = (arrival - stamp + self._slew for stamp in (stamps[0], stamps[-1]))
        weight = min(1.0, len(stamps) * self.period / _JITTER_TIME)
        # mean square of a lateness that is linear from the first sample to the last
        late, (before, after) = (first * first + first * last + last * last) / 3.0, self._squares
        self._squares = (before + weight * (late - before),
                         after + weight * (self._slew * self._slew - after))
        if stamps[0] < self._last + _LEAST_STEP:
            step = max((stamps[-1] - self._last) / len(stamps), _LEAST_STEP)
            stamps = [self._last + step * (index + 1) for index in range(len(stamps))]
        self._last = stamps[-1]
        return stamps


def steady() -> float:
    """Return seconds of the steady clock, including suspension of the host if supported."""
    return time.clock_gettime(_STEADY)


_STEADY = getattr(time, 'CLOCK_BOOTTIME', time.CLOCK_MONOTONIC)


def read_together(even: Callable[[], float], other: Callable[[], float]
                  ) -> tuple[float, float] | None:
    """Read two clocks at one time, s; None if five readings were all interrupted."""
    for _ in range(5):
        before, value = even(), other()
        after = even()
        if after - before <= _TOGETHER:
            return 0.5 * (before + after), value
    return None


class ClockSteps:
    """
    Detects that a clock was set, by comparison with a steady one; all in s.

    A clock that was not set gains at most `ahead`, loses at most `behind` against the steady one,
    and goes back by at most `back`. `count` is the number of steps, `last` the size of the last.

    """

    def __init__(self, ahead: float = _SET, behind: float = _SET, back: float = _SET):
        self.count, self.last = 0, 0.0
        self._ahead, self._behind, self._back = ahead, behind, back
        self._even = self._other = math.nan

    def step(self, even: float, other: float) -> float:
        """Return the step of the clock since the last `watch`, s; 0 without one."""
        interval = other - self._other
        step = interval - (even - self._even)
        was_set = step > self._ahead or step < -self._behind or interval < -self._back
        return step if was_set else 0.0

    def watch(self, even: float, other: float) -> float:
        """Take the times of both clocks, s, and return the step as `step` does."""
        step = self.step(even, other)
        self._even, self._other = even, other
        if step:
            self.count, self.last = self.count + 1, step
        return step


class NodeTime:
    """
    Conversion of a steady clock to that of a node, which may be set or simulated.

    The difference is filtered, and taken at once where the clock was set.

    """

    def __init__(self) -> None:
        self.steps = ClockSteps()
        self._difference = math.nan
        self._even, self._node, self._last = -math.inf, -math.inf, -math.inf

    def watch(self, even: float, node: float) -> float:
        """Take the times of both clocks, s; return the step of the node's clock."""
        elapsed, was_set_back = even - self._even, node < self._node
        self._even, self._node = even, node
        step = self.steps.watch(even, node)
        error = node - even - self._difference
        if not step and abs(error) <= _SET:
            self._difference += min(1.0, elapsed / _FOLLOWING) * error
            return 0.0
        if was_set_back:
            self._last = -math.inf
        self._difference = node - even
        return step

    def of(self, stamp: float) -> float:
        """Convert a time to the clock of the node; stamps increase until it is set back."""
        self._last = max(stamp + self._difference, self._last + _LEAST_STEP)
        return self._last


@dataclass
class _Step:
    """A step of the clock, s, its time on the steady clock, and whether stamps showed it."""

    size: float
    seen: float
    shown: bool = False


class HostClock:
    """
    Conversion of stamps to a continuous time, s, also where the clock of the host is set.

    A jump of the stamps is removed if the clock of the host has just made the same one against the
    steady clock: one of `steps`.

    """

    def __init__(self) -> None:
        self.steps = ClockSteps()
        self._offset = 0.0
        self._recent: list[_Step] = []

    def watch(self, even: float, date: float) -> float:
        """Take the times of both clocks, s; return the step of the date."""
        if self._recent and even - self._recent[0].seen > _MIXED:
            del self._recent[0]
        step = self.steps.watch(even, date)
        if step:
            self._recent.append(_Step(step, even))
        return step

    def of_sample(self, stamp: float, before: float, usual: float,
                  silence: float = 0.0) -> float:
        """
        Return the time of a sample.

        Parameters
        ----------
        stamp : seconds
        before : time of the previous sample, s; -inf for the first, which shows no step
        usual : interval, s; inf while it is not known
        silence : time between their arrivals, s; it equals the jump of the stamps over a gap, but
            not over a step of the clock

        """
        if before == -math.inf:
            for step in self._recent:
                step.shown = True
        interval = stamp - self._offset - before
        unshown = [step for step in self._recent if not step.shown]
        found = min(unshown, key=lambda step: abs(interval - step.size), default=None)
        if (found is None or not abs(interval - found.size) < 0.5 * abs(interval)
                or abs(interval - silence) < abs(interval - silence - found.size)):
            return stamp - self._offset
        found.shown = True
        left = interval - found.size
        least = usual if usual < math.inf else 0.0
        bridged = left if left > 0.5 * least else least
        self._offset += interval - bridged
        return before + bridged

    def of_other(self, stamp: float, sample: float) -> float:
        """Return the time of another message, s, with a stamp from before or after a step."""
        there = stamp - self._offset
        shifts = [sign * step.size for step in self._recent for sign in (1.0, -1.0)]
        return min((there, *(there + shift for shift in shifts)),
                   key=lambda each: abs(each - sample))
