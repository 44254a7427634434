"""
Stamps for samples: when each was sent, from when the pieces came in which many arrive at once.

Samples arrive late, by a USB adapter that holds bytes for 16 ms, or by a host that is busy, but never early. So the time of a sample is a
line over its number, and the line is the one under all arrivals of the last 20 s with the least sum of distances [1]_.
The number is the device's own sequence, or its time, or what was counted. What was lost without a trace shows, too: since then all
samples are late by whole periods. What was counted too often shows at the next arrival, which is early.

No clock is read here: whoever reads the port says when.

References
----------
.. [1] Moon, Skelly, Towsley: Estimation and removal of clock skew from network delay measurements, INFOCOM 1999.

"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

from gyro_calibration.driver.protocols import Sample

_Point = tuple[float, float]

_LEAST_STEP = 1e-6  # s; what double precision can still tell apart in seconds since 1970
_WINDOW = 20.0  # s; long enough for the least lateness of 200 arrivals, short enough for a clock that drifts with its temperature
_BLOCKS = 32  # at least so many in a full window, and twice as many at most
_SETTLED = 2.0  # s; a younger line does not know the period well enough to miss samples by it
_SLEW = (0.2, 1.0)  # s; in which stamps follow the line, before and after it has settled
_HOLD = 0.3  # s; for so long all arrivals must be late before samples count as lost: a host that stalls has caught up by then
_LONG = 1.5  # s; after which it counts how late they are, and not only by how much that has changed
_CHANCE = 1e-6  # that as many arrivals are late without any loss
_WINDOWS = 64  # of `_HOLD` each, over which it is learned whether the lateness sweeps slowly
_SWEEPING = 0.2  # of those windows; by chance alone it is a few
_MEMORY = 256  # arrivals, over which it is learned how many are late without any loss
_JITTER_TIME = 10.0  # s; over which jitter is averaged
_DRIFT = 2e-5  # by which the clock of a device may become faster while counts are in doubt
_FINEST = 0.5e-3  # s; a host that wakes up later than it used to is no proof of lost samples below this
_STRANGE = 0.02  # s; above the 16 ms of a burst: where a sequence shows what is lost, no sample is early or always late by more
_LARGEST_JUMP = 3.0  # s; beyond it the time of the device does not continue
_SET = 0.1  # s; a clock that differs by more was set
_FOLLOWING = 2.0  # s; in which the difference of two clocks is followed


class LowerLine:
    """
    The line under points that may lie too high, with the least sum of distances.

    Of each block of time only the lowest point is kept, and of those the edge of their lower hull that spans their mean is the line.
    Blocks grow with the time that the points span, up to 20 s altogether; what is older is forgotten.

    Parameters
    ----------
    slope : float
        Until there are two points.

    """

    def __init__(self, slope: float):
        self.slope = slope
        self._points: list[_Point] = []
        self._anchor = (0.0, 0.0)
        self._begin, self._block_begin, self._length = 0.0, -math.inf, 0.0

    def at(self, x: float) -> float:
        """Return the height of the line."""
        return self._anchor[1] + self.slope * (x - self._anchor[0])

    def span(self) -> float:
        """Return how high the last point is above the first that was ever added."""
        return self._points[-1][1] - self._begin if self._points else 0.0

    def add(self, x: float, y: float) -> None:
        """Add a point that is not lower than the one before; x may be anything above it."""
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
        """Move the points from a height on to the right; to the left they push away what is then no longer left of them."""
        moved = [(x + by, y) for x, y in self._points if y >= since]
        first = moved[0][0] if moved else math.inf
        self._points = [(x, y) for x, y in self._points if y < since and x < first] + moved

    def _limit(self) -> None:
        """Merge blocks in pairs while they are short, and forget the oldest when they are not."""
        if len(self._points) <= 2 * _BLOCKS:
            return
        if self._length >= _WINDOW / 2 / _BLOCKS:
            del self._points[0]
            return
        pairs = zip(self._points[0::2], [*self._points[1::2], self._points[-1]], strict=False)
        self._points = [min(pair, key=lambda point: point[1] - self.slope * point[0]) for pair in pairs]
        self._length = max(2.0 * self._length, self.span() / _BLOCKS)

    def _fit(self) -> None:
        hull = _lower_hull(self._points)
        middle = sum(x for x, _ in self._points) / len(self._points)
        left, right = next((edge for edge in pairwise(hull) if edge[1][0] >= middle), (hull[-1], None))
        self._anchor = left
        if right is not None and right[1] > left[1]:
            self.slope = (right[1] - left[1]) / (right[0] - left[0])


def _lower_hull(points: Sequence[_Point]) -> list[_Point]:
    """Return the corners of the lower convex hull of points in the order of x."""
    hull: list[_Point] = []
    for x, y in points:
        while hull and (hull[-1][0] >= x or len(hull) > 1 and _is_above(hull[-1], hull[-2], (x, y))):
            hull.pop()
        hull.append((x, y))
    return hull


def _is_above(point: _Point, left: _Point, right: _Point) -> bool:
    """Tell whether a point is on or above the line from left to right."""
    return (point[1] - left[1]) * (right[0] - left[0]) >= (right[1] - left[1]) * (point[0] - left[0])


class _Numbers:
    """
    How far each sample is from the one before, in nominal periods: by sequence, by time, or by counting.

    Attributes
    ----------
    size : float
        How far a sample is from the next on average.
    unit : int
        By so many samples, or a multiple, the number may be wrong; 0 where the time of the device leaves no doubt.

    """

    def __init__(self, rate: float, modulus: int):
        self._rate, self._modulus = rate, modulus
        self._sequence: int | None = None
        self._time: float | None = None
        self._strange: float | None = None
        self.forget()

    def forget(self) -> None:
        self.size, self.unit, self._unevenness = 1.0, 1, 0.0
        self._sequence = self._time = self._strange = None

    def step(self, sample: Sample) -> tuple[float, int]:
        """Return how far it is to this sample, and how many were lost before it."""
        if self._modulus and sample.sequence is not None:
            return self._by_sequence(sample.sequence, sample.missing)
        if sample.time is not None:
            return self._by_time(sample.time, sample.missing)
        advance = self.size * (1 + sample.missing)
        self._time = None if self._time is None else self._time + advance / self._rate
        return advance, sample.missing

    def _by_sequence(self, sequence: int, missing: int) -> tuple[int, int]:
        last, self._sequence, self.unit = self._sequence, sequence, self._modulus
        if last is None:
            return 1, 0
        advance = (sequence - last) % self._modulus or self._modulus
        # Missing is counted from damaged bytes, so it is right to a few, which tells how often the sequence has wrapped.
        advance += self._modulus * max(0, round((1 + missing - advance) / self._modulus))
        return advance, advance - 1

    def _by_time(self, time: float, missing: int) -> tuple[float, int]:
        self.unit = 0
        elapsed = self._elapsed(time)
        if elapsed is None:
            self._time = time if self._time is None else self._time + self.size * (1 + missing) / self._rate
            return self.size * (1 + missing), missing
        self._time, self._strange = time, None
        advance = elapsed * self._rate
        return advance, max(missing, self._lost(advance))

    def _elapsed(self, time: float) -> float | None:
        """Return the time since the last sample, if it may be; one damaged time is none, but two that belong together are."""
        for last in (self._time, self._strange):
            if last is not None and _LEAST_STEP <= time - last <= _LARGEST_JUMP:
                return time - last
        self._strange = time
        return None

    def _lost(self, advance: float) -> int:
        if self._unevenness == 0.0 or advance < 0.3 * self.size:
            self.size, self._unevenness = advance, max(self._unevenness, 0.01)
            return 0
        steps = advance / self.size
        if steps <= 2.5:
            self.size += 0.05 * (advance - self.size)
            self._unevenness += 0.05 * (abs(steps - round(steps)) - self._unevenness)
        # Times that are coarse against the period tell nothing of single samples.
        return round(steps) - 1 if steps > 2.5 or steps > 1.5 and self._unevenness < 0.15 else 0


class _Lateness:
    """
    Whether samples have been late for so long that some must be lost.

    Where bursts come nearly as often as samples, or a multiple, the lateness grows slowly to a period and falls to nothing. So it counts
    by how much the least lateness has stepped up; the lateness itself counts only when it has lasted for longer. Where it is seen to sweep
    so, a step to one period is a sample that has slipped into the next burst, and no loss.

    """

    def __init__(self) -> None:
        self.since: float | None = None
        self._usual = 0.5  # part of the arrivals that are not late
        self._in_time = math.inf  # the last arrival that was not
        self._least_in_time, self._least_before, self._window = math.inf, math.inf, -math.inf
        self._sweeping = 0.0  # part of the windows in which no arrival was in time by half
        self.forget()

    def forget(self) -> None:
        self.since, self.step, self._least, self._count, self._number, self._arrival = None, 0.0, math.inf, 0, 0.0, 0.0

    def is_proven(self, lateness: float, bound: float, number: float, arrival: float, period: float) -> bool:
        """Take one arrival, and tell whether for long enough now all are late by more than the bound: by `step`, since `since`."""
        if lateness <= bound:
            self._is_in_time(lateness, bound, arrival)
            return False
        # What was late before a silence tells nothing of what was lost in it.
        if self.since is None or arrival - self._arrival > max(0.5 * _HOLD, 3.0 * period):
            self.since, self._number, self._count, self._least = arrival, number, 0, math.inf
        self._least, self._count, self._arrival = min(self._least, lateness), self._count + 1, arrival
        needed = math.log(_CHANCE) / math.log1p(-min(max(self._usual, 0.02), 0.99))
        lasts = arrival - self.since
        before = 0.0 if lasts > _LONG else max(0.0, min(self._least_in_time, self._least_before))
        self.step = self._least - before
        is_slip = self._sweeping > _SWEEPING and self._least < 1.5 * bound
        return lasts >= _HOLD and self._count >= needed and self.step > bound and not is_slip

    def is_no_loss(self, number: float, arrival: float, slope: float) -> bool:
        """Tell whether samples have become slower altogether, or are later than the time since the last that was in time."""
        assert self.since is not None
        grows = (number - self._number) * slope < 0.5 * (arrival - self.since)
        return grows or self._least > self.since - self._in_time + _HOLD

    def _is_in_time(self, lateness: float, bound: float, arrival: float) -> None:
        self._learn()
        self.forget()
        self._in_time = arrival
        if arrival - self._window > _HOLD:
            self._sweeping += ((0.5 * bound < self._least_in_time < math.inf) - self._sweeping) / _WINDOWS
            self._window, self._least_before, self._least_in_time = arrival, self._least_in_time, math.inf
        self._least_in_time = min(self._least_in_time, lateness)

    def _learn(self) -> None:
        """Learn from one arrival in time, and from those before it that were late without any loss."""
        self._usual *= (1.0 - 1.0 / _MEMORY) ** self._count
        self._usual += (1.0 - self._usual) / _MEMORY


class SampleClock:
    """
    Gives each sample its stamp; stamps increase strictly.

    By the line under all arrivals, see `LowerLine`, whose corrections are slewed and never jump. A stamp jumps only where it turns out
    later that samples were lost. The gyro's nominal rate is used for the first piece only: its clock is 2 to 3 % off from unit to unit.

    By the device, the first sample has the time at which it came, and from there the intervals of the device are trusted; so a recording
    can be replayed faster than it was made. A sample without a time is a usual interval after the one before. After a jump of the
    device's time it begins anew, but never before the last stamp. Do not use it for hours with a device whose clock drifts: nothing ties
    it to the time of the host.

    Parameters
    ----------
    rate : float
        Nominal samples per second.
    modulus : int
        At which `Sample.sequence` begins anew; 0 for a device without one.
    use_device_time : bool
    after : float
        All stamps are later than this, the last one of another clock.

    Attributes
    ----------
    lost : int
        Samples lost so far while the port was open: missing in the sequence or in the time of the device, or damaged, or shown by all that
        came since to be late.
    period : float
        Seconds from one sample to the next, as fitted.
    jitter_before, jitter_after : float
        Seconds, root mean square over the last ten: how late samples arrive, and how far stamps are from the line.

    """

    def __init__(self, rate: float, modulus: int = 0, use_device_time: bool = False, after: float = -math.inf):
        self._use_device_time = use_device_time
        self._numbers = _Numbers(rate, modulus)
        self._lateness, self._strangeness = _Lateness(), _Lateness()
        self._line = LowerLine(1.0 / rate)
        self._number, self._slew = 0.0, 0.0
        self._doubtful, self._doubtful_since, self._just_lost = 0, 0.0, 0
        self._last, self._arrival, self._before = after, -math.inf, -math.inf
        self._device_time: float | None = None
        self._offset = 0.0
        self._squares: tuple[float, ...] = (0.0, 0.0)
        self.lost = 0

    @property
    def period(self) -> float:
        """Seconds from one sample to the next."""
        return self._line.slope * self._numbers.size

    @property
    def is_settled(self) -> bool:
        """Whether the period has been watched for long enough."""
        return self._line.span() >= _SETTLED

    @property
    def jitter_before(self) -> float:
        """How late samples arrive, in seconds."""
        return math.sqrt(self._squares[0])

    @property
    def jitter_after(self) -> float:
        """How far stamps are from the line, in seconds."""
        return math.sqrt(self._squares[1])

    def interrupt(self) -> None:
        """Forget where the samples stood, as when the port was lost; what did not come meanwhile does not count as lost."""
        self._numbers.forget()
        self._begin_anew()

    def stamp(self, samples: Sequence[Sample], arrival: float) -> list[float]:
        """
        Return the stamps of the samples that came at one time, by the clock of the arrivals.

        Parameters
        ----------
        samples : sequence of Sample, shape (n,)
        arrival : float
            When they came, in seconds of a clock that never goes back.

        """
        if not samples:
            return []
        if self._use_device_time and (self._device_time is not None or samples[0].time is not None):
            self._count(samples, arrival)
            return [self._follow_device(sample, arrival) for sample in samples]
        self._before, self._arrival = self._arrival, max(arrival, self._arrival)
        arrival = self._arrival
        numbers = self._count(samples, arrival)
        shift = self._evidence(numbers[-1], arrival)
        if shift:
            numbers = [number + shift for number in numbers]
        self._fit(numbers[-1], arrival)
        return self._increasing([self._line.at(number) + self._slew for number in numbers], arrival)

    def _count(self, samples: Sequence[Sample], arrival: float) -> list[float]:
        number, before = self._number, self.lost
        numbers: list[float] = []
        for sample in samples:
            advance, lost = self._numbers.step(sample)
            number += advance
            self.lost += lost
            numbers.append(number)
        self._just_lost = self.lost - before
        if self._just_lost:
            self._doubtful += self._just_lost
            self._doubtful_since = arrival
        return numbers

    def _evidence(self, number: float, arrival: float) -> int:
        """Return by how much the numbers are wrong, as the arrivals show; the count of what was lost is then corrected."""
        if not self.is_settled:
            return 0
        unit, lateness = self._numbers.unit, arrival - self._line.at(number)
        bound = max((unit or 1) * self.period, _FINEST)
        if lateness < -0.5 * bound:
            return self._counted_too_often(unit, lateness)
        if unit and self._lateness.is_proven(lateness, 0.75 * bound, number, arrival, self.period):
            return self._lost_without_trace(unit, number, arrival)
        if unit > 1 and self._was_restarted(lateness, 0.75 * bound, number, arrival):
            self._begin_anew()
        return 0

    def _was_restarted(self, lateness: float, bound: float, number: float, arrival: float) -> bool:
        """Tell whether the sequence began anew: since then samples are early or late by less than a wrap, and always by the same."""
        least = max(3.0 * self.period, _STRANGE)
        return lateness < -least or lateness < bound and self._strangeness.is_proven(lateness, least, number, arrival, self.period)

    def _counted_too_often(self, unit: int, lateness: float) -> int:
        excess = unit and unit * round(-lateness / (unit * self.period))
        if excess and excess <= self._doubtful:
            return self._renumber(self._doubtful_since, -excess)
        if not unit:  # a wrong time of the device: what it seemed to skip was not lost
            self.lost -= self._just_lost
        if unit != 1:  # or a sequence that began anew
            self._begin_anew()
        return 0

    def _lost_without_trace(self, unit: int, number: float, arrival: float) -> int:
        late = self._lateness
        lost = unit * math.floor(late.step / (unit * self.period) + 0.25)
        assert late.since is not None
        since, is_no_loss = late.since, late.is_no_loss(number, arrival, self._line.slope)
        late.forget()
        if is_no_loss:
            self._begin_anew()
            return 0
        self._doubtful_since = since
        return self._renumber(since, lost)

    def _renumber(self, since: float, by: int) -> int:
        self._line.shift(since, by)
        self.lost += by
        self._doubtful += by
        return by

    def _begin_anew(self) -> None:
        self._line = LowerLine(self._line.slope)
        self._lateness.forget()
        self._strangeness.forget()
        self._slew, self._doubtful = 0.0, 0

    def _fit(self, number: float, arrival: float) -> None:
        line, is_first = self._line, not self._line.span()
        before = line.at(number) + self._slew
        line.add(number, max(arrival, self._lowest(number, arrival)))
        elapsed, self._number = max(0.0, number - self._number) * line.slope, number
        slew = 0.0 if is_first else before - line.at(number)
        slew *= math.exp(-elapsed / _SLEW[line.span() > _SETTLED])
        self._slew = min(slew, arrival - line.at(number))

    def _lowest(self, number: float, arrival: float) -> float:
        """Return how low a point may be: after a count in doubt, nearly the line, until it is seen whether all are early since then."""
        in_doubt = self.is_settled and self._doubtful and self._numbers.unit and arrival - self._doubtful_since < _HOLD
        return self._line.at(number) - _DRIFT * (arrival - self._before) if in_doubt else -math.inf

    def _increasing(self, stamps: list[float], arrival: float) -> list[float]:
        self._measure(stamps, arrival)
        if stamps[0] < self._last + _LEAST_STEP:
            step = max((stamps[-1] - self._last) / len(stamps), _LEAST_STEP)
            stamps = [self._last + step * (index + 1) for index in range(len(stamps))]
        self._last = stamps[-1]
        return stamps

    def _measure(self, stamps: list[float], arrival: float) -> None:
        first, last = (arrival - stamp + self._slew for stamp in (stamps[0], stamps[-1]))
        weight = min(1.0, len(stamps) * self.period / _JITTER_TIME)
        now = (first * first + first * last + last * last) / 3.0, self._slew * self._slew  # the mean square of what is spread evenly
        self._squares = tuple(old + weight * (new - old) for old, new in zip(self._squares, now, strict=True))

    def _follow_device(self, sample: Sample, arrival: float) -> float:
        time = sample.time
        if time is None:  # as of a damaged line
            self._last += max(self.period * (1 + sample.missing), _LEAST_STEP)
            return self._last
        continues = self._device_time is not None and 0.0 <= time - self._device_time <= _LARGEST_JUMP
        self._device_time = time
        if not continues:
            self._offset = max(arrival, self._last + _LEAST_STEP) - time
        # Not the last stamp plus an interval, which would add up the rounding of seconds since 1970.
        self._last = max(time + self._offset, self._last + _LEAST_STEP)
        return self._last


class ClockDifference:
    """From a clock that never goes back to one that people set: its difference is followed slowly, and at once where the clock was set."""

    def __init__(self) -> None:
        self._difference = math.nan
        self._steady, self._other, self._last = -math.inf, -math.inf, -math.inf

    def follow(self, steady: float, other: float) -> None:
        """Take what both clocks say at one time, in seconds."""
        elapsed, was_set_back = steady - self._steady, other < self._other
        self._steady, self._other = steady, other
        difference = other - steady
        if abs(difference - self._difference) <= _SET:
            difference = self._difference + min(1.0, elapsed / _FOLLOWING) * (difference - self._difference)
        elif was_set_back:
            self._last = -math.inf
        self._difference = difference

    def other(self, stamp: float) -> float:
        """Return what the other clock says at a time of the steady one; it increases strictly, unless the other clock was set back."""
        self._last = max(stamp + self._difference, self._last + _LEAST_STEP)
        return self._last
