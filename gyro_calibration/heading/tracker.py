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
The heading of a robot from compensated rates, with its variance, and the bias estimated at rest.

At rest the bias is estimated, the rate is zero and the heading is constant. In motion the bias is
constant, with a growing variance. A turn too slow to be detected at once is detected over a longer
time; its rotation, which was attributed to the bias meanwhile, is then added to the heading.

"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
import math

from gyro_calibration.heading.gaps import CLOSE, FASTEST, Gaps, LONGEST
from gyro_calibration.heading.integration import Threshold, ThresholdFilter
from gyro_calibration.heading.kalman import begin, Drift, HEADING, RateIntegral, WALK
from gyro_calibration.heading.stationary import (
    BEGINS,
    BLOCK,
    Block,
    Energy,
    Epoch,
    EvenSamples,
    LAGS,
    most_scatter,
    Samples,
    SCATTERED,
    SCATTERS,
    SETTLING,
    sigmas,
    SlowTurn,
    Snapshot,
    StraightDrives,
    WINDOW,
)
from gyro_calibration.logs.log import Array, DEGREE, SHORTEST
from gyro_calibration.model.noise import Noise
import numpy as np

#: Largest change of the rate between samples, rad/s, plus that by this acceleration, rad/s²; a
#: larger change that is reversed in the next sample is an outlier.
JUMP, ACCELERATION = 0.5, 200.0
#: Longest step of the state, s.
_STEP = 1.0
#: Standard deviations of the bias by which a sample at rest may deviate in addition to its noise.
_FAR = 4.0
#: Shortest rest without a sudden end, s.
_BRIEF = 2.0
#: Change of the bias that is assumed while the wheels stand, rad/s; largest delay of odometry
#: after the begin of a turn, s.
_UNSEEN, _LATE_WHEELS = 0.2 * DEGREE, 4.0
#: Tolerance of the noise figures: factor of the noise of the samples to that of the model from
#: which on it is used, and factor of the thresholds of means.
_ALLOWED = 1.25
#: A steady turn slower than so many times the slowest detectable one may be a change of the bias;
#: it is attributed to the bias after this time, s.
_SLOW_TURN, _DECIDED = 1.5, 2.0 * LAGS[-1]
#: When the detection of rest restarts, a pending correction is delayed by this time, s, so that a
#: continued rest is detected first.
_RECOGNIZED = 1.0
#: Samples of a log in one chunk.
_AT_ONCE = 1 << 15
#: Last blocks of a rest in memory, among which its end is located.
_BLOCKS = round((2.0 * _STEP + WINDOW) / BLOCK)
#: States of a rest in memory.
_SNAPSHOTS = round(LAGS[-1] / _STEP) + 8
#: Sigmas of a power of 95 %, for the slowest detectable turn.
_POWER = 1.645


@dataclass(frozen=True)
class Settings:
    """
    Settings of the heading tracker.

    Attributes
    ----------
    false_alarms : false detections of motion per hour at rest, 1/h; 0 disables the detection of
        rest, as does an unknown noise
    threshold : of the filter of Hong and Park, eq. 12; used without detection of rest
    maximum_gap : longest gap in the stamps that is integrated, s

    """

    false_alarms: float = 0.1
    threshold: Threshold = field(default_factory=lambda: Threshold(0.0))
    maximum_gap: float = 1.0


@dataclass(frozen=True)
class Step:
    """A part of the drive: state before it, integral of the rates, rest or motion, end in s."""

    before: Drift
    turn: RateIntegral
    resting: bool
    end: float


class HeadingTracker:
    """
    Track the heading sample by sample.

    Attributes
    ----------
    heading : published heading, rad, continuous, not wrapped
    rate : rad/s; zero at rest
    resting : whether the robot is at rest
    deleted : heading attributed to bias or noise at rest, or deleted by the threshold filter, rad
    intervals : of the samples, with the number of lost ones
    refused : number of samples beyond the largest rate; they count as lost
    outliers : number of samples beyond the largest acceleration; they count as lost
    rebuilt : number of times that the state was not finite and was initialized again
    steps : the drive so far, if it is kept
    renewed : numbers of steps before another calibration was used, and the state before it

    """

    def __init__(self, noise: Noise, covariance: Array, settings: Settings,
                 age: float | None = 0.0, keep: bool = False, per_rate: Array | None = None):
        """
        Begin at heading zero.

        Parameters
        ----------
        noise : of the model
        covariance : of the calibration, shape (m, m), from `compensation.covariance`
        age : of the self-calibration, whose s and b are the last values, s; None without one
        keep : the `steps`, for `smoothed`
        per_rate : change of the sensitivity with the rate, shape (m,): the rates include the bias
            estimated at rest, on which a scale factor error does not act

        """
        self._per_rate = per_rate
        self.heading = self.rate = self.deleted = 0.0
        self.resting, self.steps, self._keep, self._interval = False, list[Step](), keep, math.inf
        self.renewed = list[tuple[int, Drift]]()
        self._wanted, self._held, self._pending = WINDOW, RateIntegral(0.0, 0.0, np.zeros(0)), 0.0
        self._blocks, self._sure = deque[RateIntegral](maxlen=_BLOCKS), False
        self._known: float | None = None
        self._slow: SlowTurn | None = None
        self._last: tuple[float, float, float, Array] | None = None
        self._reached = self._hesitates = 0.0
        self._drives, self.outliers, self._taken = StraightDrives(), 0, 0
        self._spike: tuple[float, float, Array, bool | None, Array | None] | None = None
        # Stamp, s, and rate, rad/s, of the last sample before the last accepted jump.
        self._leap = -math.inf, 0.0
        self.refused, self.rebuilt, self._mended, self._good = 0, 0, '', (0.0, 0.0)
        self._seen: Array | None = None
        self._biased: Array | None = None
        self._seen_off, self._bias_seen = 0.0, (0.0, 0.0)
        self._still: Array | None = None
        self._gaps, self._energy, self._tested = (
            Gaps(noise), Energy(noise, settings.false_alarms), (noise, settings.false_alarms))
        self.intervals = self._gaps.intervals
        self._begin(noise, covariance, 0.0, 0.0, age)
        self.set(settings)

    def _begin(self, noise: Noise, covariance: Array, heading: float, variance: float,
               age: float | None) -> None:
        self._claimed, self._calibrated = noise, (covariance, age)
        self._drift = begin(noise, covariance, heading, variance, age if len(covariance) else None)
        self._nothing = RateIntegral(0.0, 0.0, np.zeros(len(covariance)))
        self._part, self._open = self._none(), self._nothing

    def _none(self) -> RateIntegral:
        return RateIntegral(0.0, 0.0, self._nothing.sensitivity)

    def set(self, settings: Settings) -> None:  # noqa: A003
        """Go on with other settings."""
        self._settings = settings
        self._seeks = settings.false_alarms > 0.0 and self._claimed.angle_random_walk > 0.0
        rests = (self.resting and self._seeks
                 and self._tested == (self._claimed, settings.false_alarms))
        if self._tested != (self._claimed, settings.false_alarms):
            self._tested = self._claimed, settings.false_alarms
            self._energy = Energy(*self._tested)
        self._block, self._driven = Block(), False
        self._filter = ThresholdFilter(replace(settings.threshold, rate=0.0) if self._seeks
                                       else settings.threshold)
        self._sigmas = {lag: _ALLOWED * sigmas(lag, settings.false_alarms)
                        for lag in (WINDOW, *LAGS)} if self._seeks else {}
        if rests:
            self._rest()
        else:
            self._recognize()
        self._take()

    def use(self, noise: Noise, covariance: Array, age: float | None = 0.0,
            per_rate: Array | None = None) -> None:
        """
        Continue with other noise figures and another calibration.

        The heading does not jump. The estimate of the bias at rest is cleared, but the corrections
        of the heading by it remain.

        """
        heading, variance = self.heading + self._pending, self.variance - self._pending ** 2
        if self._keep and self._last is not None:
            drift, turn = self._drift, self._open + self._part
            self._go_on(self._at_rest(turn) if self.resting else turn, self._reached)
            self.renewed.append((len(self.steps), self._drift))
            self._drift = drift
        self._still, self._per_rate = None, per_rate
        if self._last is not None:
            self._last = (*self._last[:3], np.zeros(len(covariance)))
        self._energy.clear()
        self._begin(noise, covariance, heading, variance, age)
        self.set(self._settings)

    def reset(self) -> None:
        """Set the heading to zero, without uncertainty."""
        self._settle()
        self.heading = self.deleted = 0.0
        self._drift = self._drift.turned_to(0.0)
        if self._slow:
            # if the turn was a change of the bias, the heading was the same at its begin
            self._slow.before = replace(
                self._slow.before, drift=self._slow.before.drift.turned_to(0.0), deleted=0.0)
        self._take()
        if self.resting:
            self._rest()

    def rewind(self, heading: float, variance: float) -> None:
        """Set the heading, rad, and its variance, rad²; the bias estimate remains."""
        self._settle()
        self._recognize()
        self.heading, self._slow = heading, None
        self._drift = self._drift.turned_to(heading, variance)
        self._take()

    @property
    def variance(self) -> float:
        """Return the variance of the heading, rad², with the square of a pending correction."""
        if self.resting:
            return float(self._drift.covariance[HEADING, HEADING]) + self._pending ** 2
        if self._known is None:
            self._known = self._drift.heading_variance(self._moving(self._open))
        part = self._part
        return (self._known + self._drift.noise.angle_random_walk ** 2 * part.duration
                + part.lost + part.noise + self._pending ** 2)

    # Samples

    def add(self, time: float, rate: float, sensitivity: Array, wheels: bool | None = None,
            still: Array | None = None) -> str:
        """
        Take one sample.

        Parameters
        ----------
        time : stamp, s
        rate : compensated, rad/s
        sensitivity : of the rate to the calibration, shape (m,), as in `compensation`
        wheels : whether wheels or commands move the robot, or moved it since the last sample; None
            where that is not known
        still : the sensitivity if the true rate is zero; without it that of the samples is used at
            rest too: their noise then acts as a scale factor error, which matters unless the scale
            factor is well known

        Returns
        -------
        '', or why the integration was restarted with this sample

        """
        if not -FASTEST < rate < FASTEST:
            self.refused += 1
            return ''
        spike, self._spike = self._spike, None
        if self._last is not None and self._jumps(time, rate):
            if spike is None:
                self._spike = time, rate, sensitivity, wheels, still
                return ''
            # the jump is permanent; its time between the samples is not known
            self._part.lost += (0.5 * (spike[1] - self._last[1]) * (spike[0] - self._last[0])) ** 2
            # a rate between two jumps within 2 s may be erroneous
            begun, before = self._leap
            if 0.0 < spike[0] - begun < _BRIEF:
                self._part.lost += ((self._last[1] - before) * (spike[0] - begun)) ** 2
            self._leap = self._last[:2]
            self._add(*spike)
        elif spike is not None:
            self.outliers += 1
        return self._add(time, rate, sensitivity, wheels, still)

    def _jumps(self, time: float, rate: float) -> bool:
        """Tell whether the rate changed by more than a robot can since the last sample."""
        if self._last is None:
            return False
        interval, step = time - self._last[0], abs(rate - self._last[1])
        return (step > JUMP and step > JUMP + ACCELERATION * interval
                and 0.0 <= interval <= self._settings.maximum_gap)

    def _add(self, time: float, rate: float, sensitivity: Array, wheels: bool | None,
             still: Array | None, lost: int | None = None) -> str:
        """Take a sample; `lost` is the number of lost samples before it, if known already."""
        self._still = still
        filtered = self._filter.filter(time, rate)
        last, self._last = self._last, (time, rate, filtered, sensitivity)
        if last is None:
            self._reached, self.rate = time, rate - self._off(sensitivity)
            return ''
        interval = time - last[0]
        if interval < 0.0 or interval > self._settings.maximum_gap:
            message = self._restart(interval, max(abs(rate), abs(last[1])), wheels is not False)
            self.rate = rate - self._off(sensitivity)
            return message
        self._interval, self._reached = interval, time
        self._integrate(interval, last)
        gap = None if lost == 0 else self._gaps.add(interval, rate, last[1], lost)
        if gap is not None and (filtered == rate or last[2] == last[1]):
            self._part.lost += gap.motion
            self._part.noise += gap.noise
        if self._seeks:
            self._look(interval if gap is None else interval - gap.duration, last[1], wheels)
        elif self._part.duration >= BLOCK - CLOSE:
            self._open, self._part, self._known = self._open + self._part, self._none(), None
            if self._open.duration >= _STEP - CLOSE:
                self._advance()
        self.rate = 0.0 if self.resting or filtered != rate else rate - self._off(sensitivity)
        if not -math.inf < self.heading + self.rate < math.inf:
            self._rebuild()
        message, self._mended = self._mended, ''
        return message

    # Many samples at once

    def follow(self, time: Array, rate: Array, sensitivity: Array,
               wheels: Sequence[bool | None] | None = None, still: Array | None = None,
               resting: Array | None = None) -> Array:
        """
        Take samples as `add` does, in whole blocks where no decision falls within them.

        Parameters
        ----------
        time, rate : as in `add`, shape (n,)
        sensitivity : as in `add`, shape (n, m)
        wheels : as in `add`, n of them, or None
        still : as in `add`, shape (m,) or (n, m)
        resting : stands for `sensitivity` where the robot rests before a sample, shape (n, m)

        Returns
        -------
        heading, its variance, rate, its variance, and 1 at rest, as `add` leaves them, (n, 5)

        """
        given = Samples(time, rate, sensitivity, sensitivity if resting is None else resting,
                        wheels, still)
        found, begin = np.empty((len(time), 5)), 0
        while begin < len(time):
            count = self._even(time[begin:begin + _AT_ONCE], rate[begin:begin + _AT_ONCE])
            if count:
                begin = self._follow_even(given, begin, begin + count, found)
            else:
                self.add(*given.sample(begin, self.resting))
                found[begin] = self._found()
                begin += 1
        return found

    def _found(self) -> tuple[float, float, float, float, bool]:
        return self.heading, self.variance, self.rate, self.rate_variance, self.resting

    def _even(self, time: Array, rate: Array) -> int:
        """Return how many samples come without a jump of stamps or rates."""
        if not self._seeks or self._last is None or self._spike is not None:
            return 0
        intervals = np.diff(time, prepend=self._last[0])
        with np.errstate(invalid='ignore'):
            steps = np.abs(np.diff(rate, prepend=self._last[1]))
            even = ((np.abs(rate) < FASTEST) & (intervals >= 0.0)
                    & (intervals <= self._settings.maximum_gap)
                    & (steps <= JUMP + ACCELERATION * intervals))
        return len(even) if even.all() else int(np.argmin(even))

    def _follow_even(self, given: Samples, begin: int, end: int, found: Array) -> int:
        """Take samples without jumps up to the next lost ones; return the index after the last."""
        assert self._last is not None
        usual, lost = self.intervals.add_many(
            np.diff(given.time[begin:end], prepend=self._last[0]))
        count = len(usual) - bool(lost)
        if count:
            piece = EvenSamples(given, slice(begin, begin + count), self._last,
                                self._block.duration, self.resting,
                                found[begin:begin + count])
            self._gaps.add_many(piece.intervals, piece.rate, self._last[1])
            if not self._block.duration:
                piece.epochs.append(self._epoch(-1))
            for number, until in enumerate(piece.ends):
                if number in piece.whole and self._take_block(piece, number):
                    if self._taken != piece.epochs[-1].taken:
                        piece.close(until - 1)
                        piece.epochs.append(self._epoch(until - 1))
                    elif not self.resting:
                        piece.epochs[-1].opens.append((until - 1, self._moving(self._open)))
                    continue
                piece.close(piece.begins[number])
                for place in range(piece.begins[number], until):
                    piece.rested = self.resting
                    sample = given.sample(begin + place, self.resting)
                    piece.seen[place + 1] = sample[2]
                    self._add(*sample, lost=0)
                    found[begin + place] = self._found()
                if not self._block.duration:
                    piece.epochs.append(self._epoch(until - 1))
            if not self._block.duration:
                piece.close(count)
            piece.fill(usual[:count])
            self.rate = float(piece.found[-1, 2])
        if lost:
            self._add(*given.sample(begin + count, self.resting), lost=lost)
            found[begin + count] = self._found()
        return begin + len(usual)

    def _epoch(self, place: int) -> Epoch:
        return Epoch(place, self._taken, self._drift, self.resting, self.heading, self._pending,
                     [(place, self._moving(self._open))])

    def _take_block(self, piece: EvenSamples, number: int) -> bool:
        """Take a whole block; return False, and take nothing, if a rest ends within it."""
        begin, end, moved = piece.begins[number], piece.ends[number], piece.moved(number)
        driven = True in moved
        if self.resting:
            highest, lowest = piece.extremes(number, self._offset, self._values, self._taken)
            limit = math.hypot(self._energy.sudden(), self._unsure)
            if driven or highest > limit or lowest < -limit:
                return False
        elif self._hesitates > 0.0:
            return False
        part, block, sums = self._part, self._block, piece.sums[number]
        rows = piece.resting if self.resting else piece.moving
        part.duration, part.turned, decayed, block.total, block.squares, block.differences = sums
        part.sensitivity = piece.weighted[self.resting][number]
        if self.resting != piece.rested:
            assert self._last is not None
            part.sensitivity = (part.sensitivity
                                + piece.halves[begin] * (self._last[3] - rows[begin - 1]))
            piece.rested = self.resting
        block.duration, block.count = part.duration, end - begin
        turned = self._corrected(part)
        if self.resting:
            self.deleted += turned
        else:
            self.heading += turned + self._pending * (1.0 - decayed)
            self._pending *= decayed
        time, rate = float(piece.time[end - 1]), float(piece.rate[end - 1])
        self._last = time, rate, rate, rows[end - 1]
        self._interval, self._reached = float(piece.intervals[end - 1]), time
        self._still = piece.still(end - 1)
        self._end_block(driven, moved[-1] if moved else None)
        if not -math.inf < self.heading < math.inf:
            self._rebuild()
        return True

    def _off(self, sensitivity: Array) -> float:
        """Return the error of a rate as estimated at rest, rad/s; cached for one sensitivity."""
        if sensitivity is not self._seen:
            self._seen, self._seen_off = (
                sensitivity, self._offset - float(sensitivity @ self._values))
        return self._seen_off

    def _integrate(self, interval: float, last: tuple[float, float, float, Array]) -> None:
        """Integrate the heading up to the last sample."""
        assert self._last is not None
        (_, rate, filtered, sensitivity), (_, last_rate, last_filtered, last_sensitivity) = (
            self._last, last)
        half = 0.5 * interval
        kept, last_kept = half * (filtered == rate), half * (last_filtered == last_rate)
        duration, turned = kept + last_kept, half * (filtered + last_filtered)
        if sensitivity is last_sensitivity:
            seen, corrected = duration * sensitivity, turned - duration * self._off(sensitivity)
        else:
            seen = kept * sensitivity + last_kept * last_sensitivity
            corrected = turned - duration * self._offset + float(seen @ self._values)
        part = self._part
        part.duration += duration
        part.turned += turned
        part.sensitivity = part.sensitivity + seen
        if self.resting:
            self.deleted += corrected
            return
        self.deleted += half * (rate - filtered + last_rate - last_filtered)
        if self._hesitates > 0.0:
            self._hesitates -= interval
            settled = 0.0
        else:
            settled = self._pending * duration / SETTLING
            self._pending -= settled
        self.heading += corrected + settled

    def _look(self, duration: float, before: float, wheels: bool | None) -> None:
        """Detect sudden motion at each sample, and slower motion at the end of each block."""
        assert self._last is not None
        _, rate, _, sensitivity = self._last
        self._block.add(duration, rate, before)
        if self.resting and (wheels or abs(rate - self._off(sensitivity))
                             > math.hypot(self._energy.sudden(), self._unsure)):
            self._notice(0.0)
        self._driven = self._driven or bool(wheels)
        if self._block.duration >= BLOCK - CLOSE:
            self._end_block(self._driven, wheels)

    def _end_block(self, driven: bool, wheels: bool | None) -> None:
        quiet = self._energy.add(self._block)
        self._decide(False if driven else quiet, driven or wheels)
        self._block, self._driven = Block(), False

    def _decide(self, quiet: bool | None, wheels: bool | None) -> None:
        """Decide on rest or motion at the end of a block."""
        part, self._part, self._known = self._part, self._none(), None
        self._open += part
        if self.resting:
            self._blocks.append(part)
            self._sure = wheels is False
            if quiet is False:
                self._notice(WINDOW)
            elif self._open.duration >= _STEP - CLOSE:
                self._advance()
                self._compare(wheels)
            return
        if not quiet or wheels:
            self._wanted, self._slow = WINDOW, None
        if wheels:
            # a constant turn has the energy of a rest: no blocks are held while wheels move
            self._move(WINDOW)
        self._hold(part)
        if self._open.duration >= self._held.duration + _STEP - CLOSE:
            self._advance(self._held)
        if quiet and self._stands(wheels):
            self._advance(self._settled())
            self._rest()
            self._take()
            self._blocks.extend([*self._recent][1:])

    def _hold(self, part: RateIntegral) -> None:
        """Hold the last blocks, which may be the begin of a rest."""
        self._recent.append(part)
        self._held += part
        while (len(self._recent) > 2
               and self._held.duration - self._recent[0].duration >= self._wanted - CLOSE):
            self._held -= self._recent.popleft()

    def _settled(self) -> RateIntegral:
        """Return the held integral without its first block, in which the robot may move."""
        return self._held - self._recent[0]

    def _stands(self, wheels: bool | None) -> bool:
        """Tell whether the mean over a quiet time of sufficient length is that of a rest."""
        if self._held.duration < self._wanted - CLOSE or len(self._recent) < 2:
            return False
        most = self._sigmas[self._wanted] * (1.0 if self._wanted == WINDOW else 0.5)
        stands = abs(self._surprise(self._drift, self._at_rest(self._settled()),
                                    _UNSEEN if wheels is False else 0.0)) < most
        if not stands and self._wanted > WINDOW and not self._drifted():
            self._move(self._wanted)
        return stands

    def _drifted(self) -> bool:
        """
        Attribute a slow turn of constant rate to a change of the bias at rest; tell whether so.

        A robot does not turn at a constant rate for minutes. Otherwise a bias that wanders by more
        than the model states would cause a permanent drift of the heading at rest.

        """
        slow, held = self._slow, self._at_rest(self._held)
        if slow is None:
            return False
        start = slow.before.drift.uncertain(WALK, slow.rate ** 2)
        moved = start.rested(self._at_rest(slow.turn))
        if (slow.turn.duration + held.duration < _DECIDED
                or abs(self._surprise(moved, held)) > self._sigmas[self._wanted]):
            slow.turn += held
            return False
        if self._keep:
            assert self._last is not None
            del self.steps[slow.before.steps:]
            self.steps.append(Step(start, self._at_rest(slow.turn), True,
                                   self._last[0] - self._part.duration - held.duration))
        self._drift, self._open, self._slow = moved, self._held, None
        self._rest()
        self._take()
        return True

    def _surprise(self, drift: Drift, turn: RateIntegral, unseen: float = 0.0) -> float:
        """Return the deviation of an integral from that at rest, in standard deviations."""
        expected, variance = drift.expected(turn)
        return (turn.turned - expected) / math.sqrt(variance + (unseen * turn.duration) ** 2)

    def _compare(self, wheels: bool | None) -> None:
        """Compare the means over the longer lags with the bias that was known before them."""
        for lag in LAGS:
            before = self._before(lag)
            if before is None:
                return
            turn = self._rested - before.turn
            if abs(self._surprise(before.drift, turn)) > self._sigmas[lag]:
                if wheels is False:
                    if lag < _LATE_WHEELS:
                        continue
                    expected, _ = before.drift.expected(turn)
                    self._drift = self._drift.uncertain(
                        WALK, ((turn.turned - expected) / turn.duration) ** 2)
                    self._rest()
                    self._take()
                else:
                    self._notice(lag)
                return
        if wheels is not False:
            self._compare_scatter()

    def _compare_scatter(self) -> None:
        """Compare the scatter of the means over 1 s with the noise, over the longer lags."""
        last = self._snapshots[-1]
        for lag in SCATTERED:
            before = self._before(lag)
            if before is None:
                return
            if last.squares - before.squares > _ALLOWED ** 2 * most_scatter(
                    lag, last.means - before.means, self._settings.false_alarms):
                self._notice(lag, max(self._snapshots, key=lambda each: (
                    last.squares - each.squares - BEGINS * (last.means - each.means))))
                return

    def _before(self, lag: float) -> Snapshot | None:
        """Return the state `lag` s before the last step of this rest; None if before its begin."""
        snapshots, until = self._snapshots, self._rested.duration - lag + CLOSE
        if snapshots[0].turn.duration > until:
            return None
        place = max(len(snapshots) - 1 - round(lag / _STEP), 0)
        while place + 1 < len(snapshots) and snapshots[place + 1].turn.duration <= until:
            place += 1
        while snapshots[place].turn.duration > until:
            place -= 1
        return snapshots[place]

    # From rest to motion and back

    def _rest(self) -> None:
        """Begin a rest."""
        self.resting, self._rested, self._hesitates = True, self._nothing, 0.0
        self._sure = False
        self._blocks = deque(maxlen=_BLOCKS)
        self._snapshots = [Snapshot(self._drift, self._nothing, self.deleted, len(self.steps))]

    def _move(self, wanted: float) -> None:
        """Begin a motion, which lasts until the rate is quiet for `wanted` s."""
        self.resting, self._wanted, self._recent, self._held = (
            False, wanted, deque[RateIntegral](), self._nothing)

    def _recognize(self) -> None:
        """Restart the detection of rest; a rest may continue."""
        if self.resting:
            self._hesitates = _RECOGNIZED
        self._move(WINDOW)

    def _notice(self, lag: float, before: Snapshot | None = None) -> None:
        """Revise a rest to a motion since `lag` s before the last block, or since a snapshot."""
        self._advance()
        scattered = before is not None
        before = before or self._before(max(lag, WINDOW)) or self._snapshots[0]
        sudden = lag <= WINDOW and not scattered
        if not sudden and self._rested.duration < _BRIEF - CLOSE:
            before = self._snapshots[0]
        turn = self._rested - before.turn
        if sudden:
            before, turn = self._until_motion(before, turn)
        self._slow = (self._slow_turn(before, turn) if lag >= LAGS[0] and not scattered else None)
        if self._snapshots[-1].means and not self._sure:
            self._drives.learn(self._snapshots[-1])
        self._drift, self.deleted, self._open = before.drift, before.deleted, turn
        del self.steps[before.steps:]
        self._move(max(lag, WINDOW))
        self._advance()

    def _until_motion(self, before: Snapshot,
                      turn: RateIntegral) -> tuple[Snapshot, RateIntegral]:
        """
        Return the state after the last block at rest after a snapshot, and the integral since.

        The begin of motion is located by maximum likelihood, with rates of unknown scatter in
        motion; the block before it is counted as motion, as it may contain the begin.

        """
        blocks, duration = list[RateIntegral](), 0.0
        for block in reversed(self._blocks):
            if duration + block.duration > turn.duration + CLOSE:
                break
            blocks.insert(0, self._at_rest(block))
            duration += block.duration
        if len(blocks) < 3 or turn.duration - duration > BLOCK:
            return before, turn
        squares = np.square([self._surprise(before.drift, block) for block in blocks])
        at_rest = np.cumsum(squares)[:-1]
        moving = np.maximum((squares.sum() - at_rest) / np.arange(len(blocks) - 1, 0, -1), 1.0)
        last = int(np.argmin(at_rest + np.arange(len(blocks) - 1, 0, -1)
                             * (1.0 + np.log(moving))))
        if not last:
            return before, turn
        quiet = sum(blocks[1:last], blocks[0])
        while self._snapshots[-1] is not before:
            self._snapshots.pop()
        del self.steps[before.steps:]
        self._drift, self._rested = before.drift, before.turn + self._nothing
        self.deleted = (before.deleted + quiet.turned - before.drift.expected(quiet)[0]
                        + self._corrected(self._part))
        self._advance_at_rest(quiet, turn - quiet)
        return self._snapshots[-1], turn - quiet

    def _slow_turn(self, before: Snapshot, turn: RateIntegral) -> SlowTurn | None:
        """Return the detected turn if it is so slow that it may be a change of the bias."""
        longest = replace(self._nothing, duration=LAGS[-1])
        least = self._sigmas[LAGS[-1]] * math.sqrt(before.drift.expected(longest)[1]) / LAGS[-1]
        rate = (turn.turned - before.drift.expected(turn)[0]) / turn.duration
        return (SlowTurn(before, rate, turn + self._nothing) if abs(rate) < _SLOW_TURN * least
                else None)

    def _restart(self, interval: float, fastest: float, unseen: bool) -> str:
        """
        Restart after a gap or a backward jump of the stamps, over which nothing is integrated.

        Unless the wheels stood, the robot may have turned to any direction meanwhile, also between
        two rests. The duration of a backward jump is unknown.

        """
        self._settle()
        assert self._last is not None
        interval, self._reached = min(max(interval, -LONGEST), LONGEST), self._last[0]
        self._block, self._driven = Block(), False
        self._energy.clear()
        self._filter.clear()
        self._gaps.clear()
        self._recognize()
        duration = max(interval, 0.0)
        if interval > 0.0:
            self.intervals.count(interval)
        lost = (fastest * duration) ** 2 + unseen * math.tau ** 2
        self._go_on(replace(self._nothing, duration=duration, lost=lost, unseen=True),
                    self._reached)
        self._take()
        return (f'no samples for {interval:.3f} s' if interval > 0.0
                else f'the stamp jumps back by {-interval:.3f} s')

    def _settle(self) -> None:
        """Propagate the state to the last sample."""
        self._open, self._part = self._open + self._part, self._none()
        if not self.resting:
            self._move(self._wanted)
        self._advance()

    def _advance(self, left: RateIntegral | None = None) -> None:
        """Propagate the state over the open integral, except for the part `left`."""
        left = left or self._nothing
        turn, self._open = self._open - left, left
        if turn.duration > CLOSE:
            if self.resting:
                self._advance_at_rest(self._at_rest(turn), left)
            else:
                self._go_on(turn, self._reached - self._part.duration - left.duration)
        self._take()

    def _advance_at_rest(self, turn: RateIntegral, left: RateIntegral) -> None:
        """Propagate the state over a part of a rest, and update the scatter of its rates."""
        before, (expected, variance) = self._snapshots[-1], self._drift.expected(turn)
        white = self._drift.noise.angle_random_walk ** 2 * turn.duration
        squared = (turn.turned - expected) ** 2 / variance
        ratios = 1.0 + SCATTERS * white / variance
        likelihood = before.likelihood - 0.5 * (squared / ratios + np.log(ratios))
        turn.wander = (0.0 if self._sure
                       else float(self._drives.chances(likelihood) @ SCATTERS) * white)
        self._go_on(turn, self._reached - self._part.duration - left.duration)
        self._rested += turn
        self._snapshots.append(Snapshot(
            self._drift, self._rested, self.deleted - self._corrected(self._part),
            len(self.steps), before.squares + squared, before.means + 1, likelihood))
        del self._snapshots[:-_SNAPSHOTS]

    def _go_on(self, turn: RateIntegral, end: float) -> None:
        """Propagate the state over an integral that ends at a time, s."""
        turn = turn if self.resting else self._moving(turn)
        if self._keep:
            self.steps.append(Step(self._drift, turn, self.resting, end))
        self._drift = self._drift.rested(turn) if self.resting else self._drift.moved(turn)

    def _moving(self, turn: RateIntegral) -> RateIntegral:
        """Return an integral with the sensitivity for the rates without their bias."""
        if self._per_rate is None or self._still is None or turn.unseen:
            return turn
        bias, _ = self._drift.bias(self._still)
        return replace(turn, sensitivity=turn.sensitivity - turn.duration * bias * self._per_rate)

    def _at_rest(self, turn: RateIntegral) -> RateIntegral:
        """Return an integral with the sensitivity of a rest, free of the noise of the rates."""
        return (turn + self._nothing if self._still is None
                else replace(turn, sensitivity=turn.duration * self._still))

    def _take(self) -> None:
        """Adopt the new state and the noise of the samples; the heading does not jump."""
        if not math.isfinite(float(self._drift.mean.sum()) + float(self._drift.covariance.sum())):
            self._rebuild()
        walk = self._claimed.angle_random_walk * (
            self._energy.factor if self._seeks and self._energy.factor > _ALLOWED else 1.0)
        if walk != self._drift.noise.angle_random_walk:
            self._drift = replace(
                self._drift, noise=replace(self._claimed, angle_random_walk=walk))
        self._gaps.noise = self._drift.noise
        self._offset, self._values, self._seen, self._biased = (
            self._drift.offset[0], self._drift.values[0], None, None)
        self._unsure = _FAR * self.bias[1]
        self._known, self._taken = None, self._taken + 1
        estimate = float(self._drift.mean[HEADING]) + (
            0.0 if self.resting else self._corrected(self._open + self._part))
        self._pending = estimate - self.heading
        self._good = self.heading, float(self._drift.covariance[HEADING, HEADING])

    def _rebuild(self) -> None:
        """Initialize the state at the last finite heading, with an uncertainty of a full turn."""
        heading, variance = self._good
        covariance, age = self._calibrated
        self._begin(self._claimed, np.nan_to_num(covariance), heading, variance + math.tau ** 2,
                    age)
        self.heading, self.rate, self.deleted, self._hesitates, self._still, self._slow = (
            heading, 0.0, 0.0, 0.0, None, None)
        if self._last is not None:
            self._last = (*self._last[:3], np.zeros(len(covariance)))
        self._energy, self._block, self._driven = Energy(*self._tested), Block(), False
        intervals, self._gaps = self.intervals, Gaps(self._claimed)
        self.intervals = self._gaps.intervals = intervals
        self._filter.clear()
        self._move(WINDOW)
        self._known, self._pending = None, 0.0
        self.rebuilt += 1
        self._mended = ('the state was not finite and was initialized again; '
                        'the heading error may be up to a full turn')
        self._take()

    def _corrected(self, part: RateIntegral) -> float:
        """Return the integral of the rates less their error as estimated at rest, rad."""
        return part.turned - part.duration * self._offset + float(part.sensitivity @ self._values)

    # What is known

    def finish(self) -> Drift:
        """Propagate the state to the last sample, and return it."""
        self._settle()
        return self._drift

    @property
    def bias(self) -> tuple[float, float]:
        """Return the bias at rest in addition to the calibration, and its deviation, rad/s."""
        return self.bias_by(self.sensitivity)

    @property
    def sensitivity(self) -> Array:
        """Return that of the last sample."""
        return self._nothing.sensitivity if self._last is None else self._last[3]

    def bias_by(self, sensitivity: Array) -> tuple[float, float]:
        """Return the same for another sensitivity, (m,), as of samples at another temperature."""
        if sensitivity is not self._biased:
            bias, variance = self._drift.bias(sensitivity)
            self._biased, self._bias_seen = sensitivity, (bias, math.sqrt(variance))
        return self._bias_seen

    @property
    def rate_variance(self) -> float:
        """Return the variance of the last rate, (rad/s)², by noise, bias and scale."""
        interval = max(min(self._interval, self.intervals.usual), SHORTEST)
        return self.bias[1] ** 2 + self._drift.noise.rate_variance(
            WINDOW if self.resting else interval)

    @property
    def slowest_noticed(self) -> float:
        """Return the slowest turn, rad/s, that is detected in 95 % of cases; nan if unknown."""
        turns = ([(lag, replace(self._nothing, duration=lag)) for lag in LAGS]
                 if self._seeks else [])
        return min(((self._sigmas[lag] + _POWER) * math.sqrt(self._drift.expected(turn)[1]) / lag
                    for lag, turn in turns), default=math.nan)
