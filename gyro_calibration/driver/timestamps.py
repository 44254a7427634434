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
under all arrivals of the last 20 s with the least sum of distances (Moon, Skelly, Towsley:
Estimation and removal of clock skew from network delay measurements, INFOCOM 1999). The number is
the sequence of the device, or its time, or a count. Lost samples without other evidence show as
well: all later samples are late by whole periods; and samples counted twice arrive early.

A computer without a battery starts with a wrong date and is set by months when it finds a time
server. `NodeTimeConverter` converts a steady clock to stamps of such a clock, `HostTimeConverter`
converts its stamps to a continuous time.
"""

from collections import deque
from collections.abc import Callable, Sequence
from itertools import pairwise
import math
from statistics import median
import time

from gyro_calibration.driver.protocols import Sample
from gyro_calibration.logs.cdr import NSEC_PER_SEC

_MIN_STAMP_STEP = 1e-6  # s; least step of stamps: the resolution of a double in seconds since 1970
_LINE_WINDOW = 20.0  # s; of the line: 200 arrivals at 10 Hz, little drift of a warming clock
_WINDOW_BLOCKS = 64  # in the window: a block takes 0.3 s, in which no clock drifts visibly
#: Least span of a line before its period shows lost samples, and time constant of the difference
#: of two clocks, s.
_SETTLING_DURATION = 2.0
_LATE_DURATION = 0.3  # s; of lateness that proves a loss: a stalled host catches up
#: Largest lateness with a correct sequence, s, above the 16 ms of a burst.
_OUTLIER_LATENESS = 0.02
#: Largest difference of a clock that is slewed, not set, s; ntpd sets it from 0.128 s on.
_CLOCK_STEP_THRESHOLD = 0.1


class _LowerLine:
    """The line below all points of the last 20 s with the least sum of distances."""

    def __init__(self, slope: float):
        self.slope = slope
        self.points = deque[tuple[float, float]](maxlen=_WINDOW_BLOCKS)
        self._anchor = (0.0, 0.0)
        self._begin, self._block_begin = 0.0, -math.inf

    def value_at(self, x: float) -> float:
        return self._anchor[1] + self.slope * (x - self._anchor[0])

    def time_span(self) -> float:
        """Return the height of the last point above the first one ever added."""
        return self.points[-1][1] - self._begin if self.points else 0.0

    def add(self, x: float, y: float) -> None:
        """Add a point that is not lower than the one before; x is larger than before."""
        if not self.points:
            self._begin, self._anchor = y, (x, y)
        # only the lowest point of each block of time is kept
        if y - self._block_begin >= _LINE_WINDOW / _WINDOW_BLOCKS:
            self.points.append((x, y))
            self._block_begin = y
        elif y - self.slope * x <= self.points[-1][1] - self.slope * self.points[-1][0]:
            self.points[-1] = (x, y)
        else:
            return

        # the corners of the lower convex hull
        hull: list[tuple[float, float]] = []
        for x, y in self.points:
            while hull:
                (a, height), (left, low) = hull[-1], hull[-2] if len(hull) > 1 else (0.0, 0.0)
                is_above = (height - low) * (x - left) >= (y - low) * (a - left)
                if a < x and not (len(hull) > 1 and is_above):
                    break
                hull.pop()
            hull.append((x, y))
        # its edge at the mean; of a single point the given slope remains
        middle = sum(x for x, _ in self.points) / len(self.points)
        begin, end = next((edge for edge in pairwise(hull) if edge[1][0] >= middle),
                          (hull[-1], None))
        self._anchor = begin
        if end is not None and end[1] > begin[1]:
            self.slope = (end[1] - begin[1]) / (end[0] - begin[0])

    def shift(self, start: float, offset: float) -> None:
        """Shift the points from a height on along x, and drop points that they overtake."""
        moved = [(x + offset, y) for x, y in self.points if y >= start]
        first = moved[0][0] if moved else math.inf
        kept = [(x, y) for x, y in self.points if y < start and x < first]
        self.points = deque([*kept, *moved], _WINDOW_BLOCKS)


class _SampleCounter:
    """Numbers samples in nominal periods: by sequence or time of the device, or by counting."""

    def __init__(self, rate: float, modulus: int):
        self._rate, self._modulus = rate, modulus
        self.mean_advance = 1.0  # the usual one
        #: Of how many samples the number may be wrong by a multiple; 0 by the time of the device.
        self.ambiguity = 1
        self._advances = deque[float](maxlen=8)  # three may be wrong
        self._sequence: int | None = None
        self._time: float | None = None
        self._outlier_time: float | None = None

    def advance(self, sample: Sample, max_advance: float, following: int) -> tuple[float, int]:
        """
        Return the advance to this sample, and the number of samples lost before it.

        `following` is the number of samples that arrived with it, after it.
        """
        # A time of the device beyond `max_advance` is wrong: the sample came too early.
        missing = sample.missing
        if self._modulus and sample.sequence is not None:
            last, self._sequence = self._sequence, sample.sequence
            self.ambiguity = self._modulus
            if last is None:
                return 1, 0
            advance = (sample.sequence - last) % self._modulus
            if not advance:  # it stands still
                self.ambiguity = 1
                return 1 + missing, missing
            # The number of missing samples by damaged bytes gives the number of wraps.
            advance += self._modulus * max(0, round((1 + missing - advance) / self._modulus))
            return advance, advance - 1
        time, usual = sample.time, self.mean_advance * (1 + missing)
        if time is not None:
            self.ambiguity = 0
            largest = max_advance / self._rate
            for earlier in (self._time, self._outlier_time):
                if earlier is not None and _MIN_STAMP_STEP <= time - earlier <= largest:
                    has_restarted = earlier == self._outlier_time
                    self._time, self._outlier_time = time, None
                    by_time = (time - earlier) * self._rate
                    if has_restarted and _LATE_DURATION < largest < math.inf:
                        # a gyro that was off meanwhile: only the arrival shows how long
                        lost = max(0, math.floor(max_advance / self.mean_advance) - 1 - following)
                        return (1 + lost) * self.mean_advance, lost
                    self._advances.append(by_time)
                    self.mean_advance = median(self._advances)
                    is_known = len(self._advances) == self._advances.maxlen
                    return by_time, (max(0, round(by_time / self.mean_advance) - 1)
                                     if is_known else 0)
            self._outlier_time = time  # a single outlier in the time of the device
        self._time = time if self._time is None else self._time + usual / self._rate
        return usual, missing


class _LatenessTest:
    """Test whether samples have been late for so long that some must be lost."""

    def __init__(self) -> None:
        self.late_since: float | None = None
        self.step, self._least = 0.0, math.inf
        # least lateness of arrivals that were not late, since the start of a window
        self._least_on_time, self._window_start = math.inf, -math.inf
        self._last_arrival = 0.0

    def is_loss_proven(self, lateness: float, bound: float, arrival: float,
                       period: float) -> bool:
        """Add an arrival; tell whether all since `late_since` have been late, by `step`, s."""
        if lateness <= bound:
            self.late_since = None
            if arrival - self._window_start > 5.0 * _LATE_DURATION:
                self._window_start, self._least_on_time = arrival, math.inf
            self._least_on_time = min(self._least_on_time, lateness)
            return False
        silence, self._last_arrival = arrival - self._last_arrival, arrival
        # Lateness before a silence does not show losses in the silence.
        if self.late_since is None or silence > max(0.5 * _LATE_DURATION, 3.0 * period):
            self.late_since, self._least = arrival, math.inf
        self._least, lasts = min(self._least, lateness), arrival - self.late_since
        # bursts near a multiple of the sample rate let the lateness grow slowly to a period and
        # fall to zero: so its step is tested, and itself after a longer time
        self.step = self._least - (0.0 if lasts > 5.0 * _LATE_DURATION
                                   else max(0.0, self._least_on_time))
        return lasts >= max(_LATE_DURATION, 3.0 * period) and self.step > bound


class SampleClock:
    """
    Stamps samples; stamps increase strictly.

    Corrections by the line are slewed; a stamp jumps only where later arrivals show a loss. The
    nominal rate, Hz, is used for the first samples only: clocks of gyros are 2 to 3 % off.
    `modulus` is that of `Sample.sequence`, 0 without one, and `min_stamp` the last stamp of
    another clock.
    """

    def __init__(self, rate: float, modulus: int = 0, min_stamp: float = -math.inf):
        self._device = rate, modulus
        self._counter = _SampleCounter(*self._device)
        self._lateness = _LatenessTest()
        self._line = _LowerLine(1.0 / rate)
        self._last_number, self._slew_offset = 0.0, 0.0
        self._uncertain_losses, self._uncertain_since, self._newly_lost = 0, 0.0, 0
        self._last_stamp, self._last_arrival = min_stamp, -math.inf
        self.lost_count = 0  # while the port was open

    @property
    def period(self) -> float:  # s
        return self._line.slope * self._counter.mean_advance

    @property
    def is_settled(self) -> bool:
        """Whether the line spans enough time to know the period."""
        return self._line.time_span() >= _SETTLING_DURATION

    def interrupt(self) -> None:
        """Start a new line, as after a loss of the port; no samples count as lost meanwhile."""
        self._counter = _SampleCounter(*self._device)
        self._restart_line()

    def stamp_samples(self, samples: Sequence[Sample], arrival: float) -> list[float]:
        """Return stamps of samples by their time of arrival on a steady clock, s."""
        if not samples:
            return []
        self._last_arrival = arrival = max(arrival, self._last_arrival)
        line, number, before, numbers = self._line, self._last_number, self.lost_count, []
        for following, sample in zip(reversed(range(len(samples))), samples):
            # the largest advance to a sample that has arrived
            margin = 0.5 * self.period if self.is_settled else _OUTLIER_LATENESS
            left = (arrival + margin - line.value_at(number)) / line.slope
            advance, lost = self._counter.advance(
                sample, max(left, 1.5 * self._counter.mean_advance) if line.points else math.inf,
                following)
            number += advance
            self.lost_count += lost
            numbers.append(number)
        self._newly_lost = self.lost_count - before
        if self._newly_lost:
            self._uncertain_losses += self._newly_lost
            self._uncertain_since = arrival
        if shift := self._correct_losses(number, arrival):
            numbers = [each + shift for each in numbers]

        # the new line, and the difference to the one before, which is slewed
        line, number = self._line, numbers[-1]
        is_first, expected, lowest = (
            not line.time_span(), line.value_at(number) + self._slew_offset, -math.inf)
        if self.is_settled and self._uncertain_losses and self._counter.ambiguity and (
                arrival - self._uncertain_since < _LATE_DURATION):  # their number may be too large
            lowest = line.value_at(number)
        line.add(number, max(arrival, lowest))
        elapsed, self._last_number = max(0.0, number - self._last_number) * line.slope, number
        slew = 0.0 if is_first else expected - line.value_at(number)
        slew *= math.exp(-elapsed / 1.0)  # s, so that no rate is off by the correction
        self._slew_offset = min(slew, arrival - line.value_at(number))
        stamps = [line.value_at(each) + self._slew_offset for each in numbers]

        # increasing stamps
        if stamps[0] < self._last_stamp + _MIN_STAMP_STEP:
            step = max((stamps[-1] - self._last_stamp) / len(stamps), _MIN_STAMP_STEP)
            stamps = [self._last_stamp + step * (index + 1) for index in range(len(stamps))]
        self._last_stamp = stamps[-1]
        return stamps

    def _correct_losses(self, number: float, arrival: float) -> int:
        """Correct the count of lost samples by the arrivals; return the correction."""
        if not self.is_settled:
            return 0
        unit, period = self._counter.ambiguity, self.period
        lateness = arrival - self._line.value_at(number)
        # After a restart of the sequence, all samples are off by the same part of it.
        bound = period if unit < 2 else max(3.0 * period, _OUTLIER_LATENESS)
        if lateness < -0.5 * bound:
            excess = unit and unit * round(-lateness / (unit * period))
            if excess and excess <= self._uncertain_losses:
                return self._renumber(-excess)
            if not unit:  # a wrong time of the device: the apparent losses are cancelled
                self.lost_count -= self._newly_lost
            if unit != 1:
                self._restart_line()
        elif unit and self._lateness.is_loss_proven(lateness, 0.75 * bound, arrival, period):
            lost = unit * math.floor(self._lateness.step / (unit * period) + 0.25)
            begin, self._lateness.late_since = self._lateness.late_since, None
            assert begin is not None
            if lost:
                self._uncertain_since = begin
                return self._renumber(lost)
            self._restart_line()
        return 0

    def _renumber(self, offset: int) -> int:
        self._line.shift(self._uncertain_since, offset)
        self.lost_count += offset
        self._uncertain_losses += offset
        return offset

    def _restart_line(self) -> None:
        self._line = _LowerLine(self._line.slope)
        self._lateness = _LatenessTest()
        self._slew_offset, self._uncertain_losses = 0.0, 0


def read_steady_clock() -> float:
    """Return seconds of the steady clock, including suspension of the host if supported."""
    return time.clock_gettime(getattr(time, 'CLOCK_BOOTTIME', time.CLOCK_MONOTONIC))


def read_date_offset() -> int:
    """Return the date less the steady clock, ns; added to the latter it does not jump."""
    return time.time_ns() - round(read_steady_clock() * NSEC_PER_SEC)


def read_clock_pair(steady_clock: Callable[[], float],
                    other_clock: Callable[[], float]) -> tuple[float, float] | None:
    """Read two clocks at one time, s; None if five readings were all interrupted."""
    for _ in range(5):
        before, value = steady_clock(), other_clock()
        after = steady_clock()
        if after - before <= 0.5 * _CLOCK_STEP_THRESHOLD:
            return 0.5 * (before + after), value
    return None


class _ClockStepDetector:
    """Detects that a clock was set, by comparison with a steady one; all in s."""

    def __init__(self) -> None:
        self.count = 0  # of steps
        self.steady_time = self.other_time = math.nan  # at the last update, s

    def update(self, steady_time: float, other_time: float) -> float:
        """Take the times of both clocks, s; return the step of the clock, 0 without one."""
        interval = other_time - self.other_time
        step = interval - (steady_time - self.steady_time)
        self.steady_time, self.other_time = steady_time, other_time
        if not (abs(step) > _CLOCK_STEP_THRESHOLD or interval < -_CLOCK_STEP_THRESHOLD):
            return 0.0
        self.count += 1
        return step


class NodeTimeConverter:
    """Conversion of a steady clock to that of a node, by a filtered difference of the two."""

    def __init__(self) -> None:
        self.steps = _ClockStepDetector()
        self._difference, self._last_stamp = math.nan, -math.inf

    def update(self, steady_time: float, node_time: float) -> float:
        """Take the times of both clocks, s; return the step of the node's clock."""
        elapsed = steady_time - self.steps.steady_time
        was_set_back = node_time < self.steps.other_time
        step = self.steps.update(steady_time, node_time)
        error = node_time - steady_time - self._difference
        if not step and abs(error) <= _CLOCK_STEP_THRESHOLD:
            self._difference += min(1.0, elapsed / _SETTLING_DURATION) * error
            return 0.0
        if was_set_back:
            self._last_stamp = -math.inf
        self._difference = node_time - steady_time
        return step

    def convert(self, stamp: float) -> float:
        """Convert a time to the clock of the node; stamps increase until it is set back."""
        self._last_stamp = max(stamp + self._difference, self._last_stamp + _MIN_STAMP_STEP)
        return self._last_stamp


class HostTimeConverter:
    """Conversion of stamps to a continuous time, s, less the jumps of the clock of the host."""

    def __init__(self) -> None:
        self.steps = _ClockStepDetector()
        self._offset = 0.0
        # size and time on the steady clock, s; of all, and of those that no sample has shown
        self._recent_steps: list[tuple[float, float]] = []
        self._unshown_steps: list[tuple[float, float]] = []

    def update(self, steady_time: float, date: float) -> float:
        """Take the times of both clocks, s; return the step of the date."""
        self._recent_steps, self._unshown_steps = (
            [each for each in steps if steady_time - each[1] <= 10.0]  # older stamps may come
            for steps in (self._recent_steps, self._unshown_steps))
        step = self.steps.update(steady_time, date)
        if step:
            self._recent_steps.append((step, steady_time))
            self._unshown_steps.append((step, steady_time))
        return step

    def convert_sample(self, stamp: float, previous_time: float, usual_interval: float,
                       arrival_interval: float = 0.0) -> float:
        """
        Return the time of a sample, s; the usual interval, s, is inf while it is not known.

        Over a gap the stamps jump by the time between their arrivals, but not over a step of the
        clock.
        """
        if previous_time == -math.inf:
            self._unshown_steps.clear()
        interval = stamp - self._offset - previous_time
        # late arrivals of samples whose interval is the usual one are no step of the clock
        if abs(interval - usual_interval) < 0.5 * usual_interval:
            return stamp - self._offset
        # each step once: a later gap whose arrivals are late is none
        found = min([(0.0, 0.0), *self._unshown_steps],
                    key=lambda each: abs(interval - each[0] - arrival_interval))
        if shift := found[0]:
            self._unshown_steps.remove(found)
            least = usual_interval if usual_interval < math.inf else 0.0
            bridged = interval - shift if interval - shift > 0.5 * least else least
            self._offset += interval - bridged
        return stamp - self._offset

    def convert_message(self, stamp: float, sample_time: float) -> float:
        """Return the time of another message, s, with a stamp from before or after a step."""
        there = stamp - self._offset
        return min((there, *(there + sign * size for size, _ in self._recent_steps
                             for sign in (1.0, -1.0))),
                   key=lambda each: abs(each - sample_time))
