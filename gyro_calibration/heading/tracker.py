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

from bisect import bisect_right
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
import math

from gyro_calibration.heading.integration import (
    gap_variances, Intervals, MAX_GAP, MAX_RATE, RECENT_DURATION, Threshold, ThresholdFilter,
    TIME_TOLERANCE, varied_variance)
from gyro_calibration.heading.kalman import (
    HEADING_INDEX, HeadingState, initial_state, RateIntegral, STANDSTILL, TrackStep, WALK_INDEX)
from gyro_calibration.heading.standing_wheels import StandingWheels, WHEEL_DELAY
from gyro_calibration.heading.stationary import (
    Block, BLOCK_DURATION, BLOCK_RATIOS, CORRECTION_TIME, ENDING_RATES,
    EnergyDetector, Epoch, EvenSamples, MEAN_LAGS, mean_threshold_sigmas, median_ratio,
    RestScatter, Samples, SlowTurn, Snapshot, sum_ratios, update_scatter, WINDOW_DURATION)
from gyro_calibration.heading.steady_rates import SteadyRates
from gyro_calibration.logs.log import (
    Array, CACHE_BLOCK_SAMPLES, DEGREE, MIN_SAMPLE_INTERVAL, Number)
from gyro_calibration.model.noise import Noise
import numpy as np
from scipy.special import ndtri

#: Largest change of the rate between samples, rad/s, plus that by this acceleration, rad/s²; a
#: larger change that is reversed in the next sample is an outlier.
MAX_RATE_STEP, MAX_ACCELERATION = 0.5, 200.0
#: Longest step of the state, s.
_STEP_DURATION = MEAN_LAGS[0]
#: Standard deviations of the bias by which a sample at rest may deviate in addition to its noise.
_BIAS_MARGIN_SIGMAS = 4.0
#: Tolerance of the noise figures: factor of the noise of the samples to that of the model from
#: which on it is used, and factor of the thresholds of means.
NOISE_TOLERANCE = 1.25
#: A steady turn slower than so many times the slowest detectable one may be a change of the bias;
#: it is attributed to the bias after this time, s.
_SLOW_TURN_FACTOR, _SLOW_TURN_DECISION_TIME = 1.5, sum(MEAN_LAGS)
#: Variance relative to that of white noise with which a rate does not measure the bias.
_UNINFORMATIVE_RATIO = 1e6
#: Last blocks of a rest in memory, among which its end is located.
_MAX_REST_BLOCKS = round((2.0 * _STEP_DURATION + WINDOW_DURATION) / BLOCK_DURATION)
#: States of a rest in memory.
_MAX_SNAPSHOTS = round(MEAN_LAGS[-1] / _STEP_DURATION) + 1


@dataclass(frozen=True)
class TrackerSettings:
    """Settings of the heading tracker."""

    #: False detections of motion at rest, 1/h; 0 disables the detection of rest, as does an
    #: unknown noise; then the threshold is used.
    false_alarms: float = 0.1
    threshold: Threshold = Threshold(0.0)
    maximum_gap: float = MAX_GAP  # longest gap in the stamps that is integrated, s
    #: Usual standard deviation of the bias from one power-on to the next, rad/s: of most gyros
    #: 0.05 deg/s or less, of one in five 0.2 (`bias_table`), of one in ten five times larger.
    turn_on: float = 0.1 * DEGREE


class HeadingTracker:
    """
    Track the heading, rad, which is continuous, and the rate, rad/s, zero at rest.

    `deleted_heading` is that attributed to bias or noise at rest, or deleted by the threshold
    filter, rad. Samples beyond the largest rate are refused, those beyond the largest acceleration
    are outliers, and both count as lost; `rebuild_count` tells how often the state was not finite.
    """

    def __init__(self, noise: Noise, covariance: Array, settings: TrackerSettings,
                 age: float | None = 0.0, keeps_steps: bool = False,
                 sensitivity_slope: Array | None = None):
        """
        Begin at heading zero.

        The covariance is that of the calibration, shape (m, m), by `uncertainty_covariance`, and
        the age, s, that of a self-calibration, whose s and b are the last values; None without
        one. Steps are kept for `log_compensation.smooth_track`. The slope is the change of the
        sensitivity with the rate, shape (m,): the rates include the bias estimated at rest, on
        which a scale factor error does not act.
        """
        self._sensitivity_slope = sensitivity_slope
        self.steps, self._keeps_steps = list[TrackStep](), keeps_steps
        # numbers of steps before another calibration was used, and the states before it
        self.recalibrations = list[tuple[int, HeadingState]]()
        self._interval, self.intervals = math.inf, Intervals()
        self._last_time = 0.0
        self._motion_start_time = 0.0  # of the motion since the last rest, s
        self._standing = StandingWheels(settings.turn_on)
        self._last_sample: tuple[float, float, float, Array] | None = None
        self._held_jump: tuple[float, float, Array, bool | None, Array | None] | None = None
        # Stamp, s, and rate, rad/s, of the last sample before the last accepted jump, and turn
        # since then beyond that rate, rad.
        self._before_jump, self._erroneous_turn = (-math.inf, 0.0), 0.0
        self._recent_rates = deque[tuple[float, float]]()  # stamps, s, and rates, rad/s
        self._rest_scatter, self._state_version = RestScatter(), 0
        self.refused_count = self.outlier_count = self.rebuild_count = 0
        self._rebuild_message, self._settings = '', settings
        self._initialize(noise, covariance, age)
        self._configure()

    def _initialize(self, noise: Noise, covariance: Array, age: float | None, heading: float = 0.0,
                    variance: float = 0.0) -> None:
        """Begin with a heading, rad, and its variance, rad², and nothing else known."""
        self.heading, self.rate, self.deleted_heading = heading, 0.0, 0.0
        self.is_resting = self._wheels_stand = False
        self._quiet_duration, self._pending_correction = WINDOW_DURATION, 0.0
        self._recent_blocks = deque[RateIntegral]()  # in motion, which may be the begin of a rest
        self._rest_blocks = deque[RateIntegral](maxlen=_MAX_REST_BLOCKS)
        self._suspected_turn: SlowTurn | None = None
        self._last_finite_heading = heading, variance
        self._error_sensitivity: Array | None = None
        self._bias_sensitivity: Array | None = None
        self._cached_rate_error, self._cached_bias = 0.0, (0.0, 0.0)
        self._energy = EnergyDetector(noise, self._settings.false_alarms)
        self._use_state(noise, covariance, heading, variance, age)

    def _use_state(self, noise: Noise, covariance: Array, heading: float, variance: float,
                   age: float | None) -> None:
        self._model_noise, self._calibration = noise, (covariance, age)
        self._state = initial_state(noise, covariance, heading, variance,
                                    age if len(covariance) else None)
        self._still_sensitivity: Array | None = None
        self._open_variance: float | None = None
        self._standing.reset()
        self._filtered_turn = 0.0  # deleted by the threshold filter, rad
        # None with wheels, which tell of rests
        self._steady_rates: SteadyRates | None = SteadyRates(
            self._state, covariance, self._settings.turn_on)
        self._mixture_variance = 0.0  # of the heading, beyond that of the state, rad²
        self._moving_heading = 0.0, 0.0  # before the last step, as in `TrackStep`
        self._heading_begin_time = self._last_time
        self._zero_integral = RateIntegral(0.0, 0.0, np.zeros(len(covariance)))
        self._open_integral = self._zero_integral
        self._block_integral = replace(self._zero_integral)
        if self._last_sample is not None:
            self._last_sample = (*self._last_sample[:3], np.zeros(len(covariance)))

    def _configure(self) -> None:
        """Go on with the noise of another calibration."""
        settings = self._settings
        self._detects_rest = (settings.false_alarms > 0.0
                              and self._model_noise.angle_random_walk > 0.0)
        self._energy.configure(self._model_noise, settings.false_alarms)
        self._block, self._wheels_moved = Block(), False
        self._filter = ThresholdFilter(replace(settings.threshold, rate=0.0) if self._detects_rest
                                       else settings.threshold)
        self._sigmas = {lag: NOISE_TOLERANCE * mean_threshold_sigmas(lag, settings.false_alarms)
                        for lag in (WINDOW_DURATION, *MEAN_LAGS)} if self._detects_rest else {}
        self._begin_anew()

    def _begin_anew(self) -> None:
        """Begin the present rest or motion again, with the state as it is."""
        if self.is_resting and self._detects_rest:
            self._enter_rest()
        else:
            self._enter_motion(WINDOW_DURATION)
            self._adopt_state()

    def use_calibration(self, noise: Noise, covariance: Array, age: float | None = 0.0,
                        sensitivity_slope: Array | None = None) -> None:
        """
        Continue with other noise figures and another calibration.

        The heading does not jump. The estimate of the bias at rest is cleared, but the corrections
        of the heading by it remain.
        """
        heading = self.heading + self._pending_correction
        variance = self.variance - self._pending_correction ** 2
        if self._keeps_steps and self._last_sample is not None:
            state, turn = self._state, self._open_integral + self._block_integral
            if turn.duration > TIME_TOLERANCE:  # else a measurement at rest without variance
                self._propagate_state(self._with_still_sensitivity(turn) if self.is_resting
                                      else turn, self._last_time)
            self.recalibrations.append((len(self.steps), self._state))
            self._state = state
        self._energy.clear()
        self._sensitivity_slope = sensitivity_slope
        self._use_state(noise, covariance, heading, variance, age)
        self._configure()

    def reset(self) -> None:
        """Set the heading to zero, without uncertainty."""
        self.deleted_heading = 0.0
        self.set_heading(0.0, 0.0)

    def set_heading(self, heading: float, variance: float) -> None:
        """Set the heading, rad, and its variance, rad²; the bias estimate remains."""
        self._advance_to_last_sample()
        self.heading, self._suspected_turn = heading, None
        self._heading_begin_time = self._last_time
        self._filtered_turn = self._erroneous_turn = 0.0
        if self._steady_rates is not None:
            self._steady_rates.restart(self._steady_rates.moving_state(
                self._state.noise).with_heading(heading, variance))
        self._state = self._state.with_heading(heading, variance)
        self._begin_anew()

    def add_unknown_turn(self, deviation: float, angle: float = 0.0) -> None:
        """Add a turn that was not measured, rad, with its standard deviation."""
        self._advance_to_last_sample()
        self._suspected_turn = None
        self._add_unobserved_turn(deviation ** 2 + self._erroneous_turn ** 2, angle=angle)
        self._begin_anew()

    @property
    def variance(self) -> float:
        """Return the variance of the heading, rad², with the square of a pending correction."""
        unknown = (self._pending_correction ** 2 + self._erroneous_turn ** 2
                   + self._mixture_variance + self.ambiguity_variance(self._last_time))
        if self.is_resting:
            return float(self._state.covariance[HEADING_INDEX, HEADING_INDEX]) + unknown
        if self._open_variance is None:
            self._open_variance = self._state.heading(
                self._with_unbiased_sensitivity(self._open_integral))[1]
        part = self._block_integral
        return (self._open_variance + self._filtered_turn ** 2
                + self._state.noise.angle_random_walk ** 2 * part.duration
                + part.lost_variance + part.extra_noise_variance + unknown)

    @property
    def bias_ambiguity(self) -> float:
        """Return the deviation, rad/s, of the bias if another steady rate was that of a rest."""
        return (self._standing.ambiguity if self._steady_rates is None
                else math.sqrt(self._steady_rates.variance))

    def ambiguity_variance(self, time: Number) -> Number:
        """Return the variance of the heading at a stamp, s, by `bias_ambiguity`, rad²."""
        return (self.bias_ambiguity * (time - self._ambiguity_begin_time)) ** 2

    @property
    def _ambiguity_begin_time(self) -> float:
        """Return since when the heading contains `bias_ambiguity`, s."""
        return max(self._heading_begin_time, self._standing.sudden_time)

    # Samples

    def add(self, time: float, rate: float, sensitivity: Array, wheels: bool | None = None,
            still: Array | None = None) -> str:
        """
        Take one sample; return why the integration was restarted with it, or ''.

        The stamp is in s, the compensated rate in rad/s; the sensitivity, shape (m,), is that of
        the rate to the calibration, and `still` that of a true rate of zero. Without the latter
        that of the samples is used at rest too: their noise then acts as a scale factor error,
        which matters unless the scale factor is well known. `wheels` tells whether wheels or
        commands move the robot, or moved it since the last sample; None where that is not known.
        """
        if not -MAX_RATE < rate < MAX_RATE:
            self.refused_count += 1
            return ''
        spike, self._held_jump = self._held_jump, None
        last = self._last_sample
        # whether the rate changed by more than a robot can
        if (last is not None and (step := abs(rate - last[1])) > MAX_RATE_STEP
                and 0.0 <= time - last[0] <= self._settings.maximum_gap
                and step > MAX_RATE_STEP + MAX_ACCELERATION * (time - last[0])):
            if spike is None:
                self._held_jump = time, rate, sensitivity, wheels, still
                return ''
            if not self._may_be_erroneous(spike[0]):
                self._before_jump = last[:2]
            elif abs(spike[1] - self._before_jump[1]) < abs(spike[1] - last[1]):
                self._before_jump = -math.inf, 0.0  # the rate is as before
            self._take_sample(*spike)
        elif spike is not None:
            self.outlier_count += 1
        return self._take_sample(time, rate, sensitivity, wheels, still)

    def _may_be_erroneous(self, time: float) -> bool:
        """Tell whether the rate has jumped so shortly before that it may be erroneous."""
        return 0.0 <= time - self._before_jump[0] < RECENT_DURATION

    def _take_sample(self, time: float, rate: float, sensitivity: Array, wheels: bool | None,
                     still: Array | None, gap: tuple[int, float] | None = None) -> str:
        """Take a sample; `gap` is the number of lost samples and the usual interval, if known."""
        self._still_sensitivity = still
        if self.is_resting and still is not None:
            sensitivity = still
        filtered = self._filter.apply(time, rate)
        last, self._last_sample = self._last_sample, (time, rate, filtered, sensitivity)
        if last is None:
            self._remember([time], [rate])
            self._last_time = self._motion_start_time = self._standing.motion_time = time
            self._heading_begin_time = time
            self.rate = rate - self._rate_error(sensitivity)
            return ''
        interval = time - last[0]
        if interval < 0.0 or interval > self._settings.maximum_gap:
            message = self._restart_after_gap(interval, max(abs(rate), abs(last[1])),
                                              wheels is not False)
            self._remember([time], [rate])
            self.rate = rate - self._rate_error(sensitivity)
            return message
        self._interval, self._last_time = interval, time
        self._integrate(interval, last)
        lost, usual = gap or (self.intervals.add(interval), self.intervals.usual_interval)
        if lost:
            if filtered == rate or last[2] == last[1]:
                motion, noise = gap_variances(self._state.noise, usual, lost, interval,
                                              rate - last[1])
                times, rates = np.array(self._recent_rates).T
                varied = varied_variance(self._state.noise, usual, interval, times, rates)
                self._block_integral.lost_variance += max(float(motion), varied)
                self._block_integral.extra_noise_variance += float(noise)
            interval -= min(lost * usual, interval)
        if gap is None or lost:  # `_follow_piece` remembers the others
            self._remember([time], [rate])
        if self._detects_rest:
            # sudden motion at each sample, and slower motion at the end of each block
            self._block.add(interval, rate, last[1])
            if self.is_resting and (wheels or abs(rate - self._rate_error(sensitivity))
                                    > math.hypot(self._energy.sudden_limit, self._bias_margin)):
                self._revert_to_motion(0.0)
            self._wheels_moved = self._wheels_moved or bool(wheels)
            if self._block.duration >= BLOCK_DURATION - TIME_TOLERANCE:
                self._end_block(self._wheels_moved or wheels)
        elif self._block_integral.duration >= BLOCK_DURATION - TIME_TOLERANCE:
            self._close_block()
            if self._open_integral.duration >= _STEP_DURATION - TIME_TOLERANCE:
                self._advance_state()
        self.rate = (0.0 if self.is_resting or filtered != rate
                     else rate - self._rate_error(sensitivity))
        if self._may_be_erroneous(time):
            self._erroneous_turn += (rate - self._before_jump[1]) * (time - last[0])
        elif self._erroneous_turn:
            self._advance_to_last_sample()
            self._add_unobserved_turn(self._erroneous_turn ** 2)
        if not -math.inf < self.heading + self.rate < math.inf:
            self._rebuild_state()
        message, self._rebuild_message = self._rebuild_message, ''
        return message

    def _remember(self, time: Sequence[float], rate: Sequence[float]) -> None:
        self._recent_rates.extend(zip(time, rate))
        while self._recent_rates[-1][0] - self._recent_rates[0][0] > RECENT_DURATION:
            self._recent_rates.popleft()

    # Many samples at once

    def follow(self, time: Array, rate: Array, sensitivity: Array,
               wheels: Sequence[bool | None] | None = None, still: Array | None = None) -> Array:
        """
        Take n samples as `add` does, in whole blocks where no decision falls within them.

        The sensitivity has shape (n, m), `still` too, or (m,). The result, shape (n, 5), has
        heading, its variance, rate, its variance, and 1 at rest, as `add` leaves them.
        """
        given = Samples(time, rate, sensitivity, wheels, None if still is None
                        else np.broadcast_to(still, sensitivity.shape))
        found, begin = np.empty((len(time), 5)), 0
        while begin < len(time):
            # up to the next jump of stamps or rates
            end = begin
            if (self._detects_rest and self._last_sample is not None and self._held_jump is None
                    and not self._may_be_erroneous(float(time[begin]))):
                here = slice(begin, begin + CACHE_BLOCK_SAMPLES)
                intervals = np.diff(time[here], prepend=self._last_sample[0])
                with np.errstate(invalid='ignore'):
                    steps = np.abs(np.diff(rate[here], prepend=self._last_sample[1]))
                    even = ((np.abs(rate[here]) < MAX_RATE) & (intervals >= 0.0)
                            & (intervals <= self._settings.maximum_gap)
                            & (steps <= MAX_RATE_STEP + MAX_ACCELERATION * intervals))
                end += len(even) if even.all() else int(np.argmin(even))
            if end == begin:
                self.add(*given.sample(begin))
                found[begin] = self._result_row(self.intervals.usual_interval)
                begin += 1
                continue
            # whole pieces between lost samples, and these singly
            usual, lost = self.intervals.add_many(intervals[:end - begin])
            for gap in [*(np.flatnonzero(lost) + begin).tolist(), end]:
                if gap > begin:
                    self._follow_piece(given, begin, gap, usual[begin - end:][:gap - begin], found)
                if gap < end:
                    known = float(usual[gap - end])
                    self._take_sample(*given.sample(gap), gap=(int(lost[gap - end]), known))
                    found[gap] = self._result_row(known)
                begin = min(gap + 1, end)
        return found

    def _result_row(self, usual: float) -> tuple[float, float, float, float, bool]:
        return (self.heading, self.variance, self.rate, self._rate_variance(usual),
                self.is_resting)

    def _follow_piece(self, given: Samples, begin: int, end: int, usual: Array,
                      found: Array) -> None:
        """Take samples without jumps and gaps, with the usual interval after each."""
        assert self._last_sample is not None
        piece = EvenSamples(given, slice(begin, end), self._last_sample, self._block.duration,
                            self.is_resting, found[begin:end])
        if not self._block.duration:
            piece.epochs.append(self._new_epoch(-1))
        for number, until in enumerate(piece.block_stops):
            if number == piece.whole_blocks.start and piece.whole_blocks:
                here = range(number, piece.whole_blocks.stop)
                self._energy.look_ahead(piece.block_sums[:, number:here.stop],
                                        [piece.wheels_of(each) for each in here])
            if number in piece.whole_blocks and self._take_block(piece, number):
                if self._state_version != piece.epochs[-1].state_version:
                    piece.close_epoch(until - 1)
                    piece.epochs.append(self._new_epoch(until - 1))
                elif not self.is_resting:
                    piece.epochs[-1].open_integrals.append(self._open_row(until - 1))
                continue
            piece.close_epoch(piece.block_starts[number])
            for place in range(piece.block_starts[number], until):
                piece.last_at_rest = self.is_resting
                known = float(usual[place])
                self._take_sample(*given.sample(begin + place), gap=(0, known))
                piece.used_sensitivity[place + 1] = self._last_sample[3]
                found[begin + place] = self._result_row(known)
            if not self._block.duration:
                piece.epochs.append(self._new_epoch(until - 1))
        if not self._block.duration:
            piece.close_epoch(end - begin)
        first = int(np.searchsorted(piece.time, piece.time[-1] - RECENT_DURATION))
        self._remember(piece.time[first:].tolist(), piece.rate[first:].tolist())
        piece.fill_results(usual)
        self.rate = float(piece.results[-1, 2])

    def _new_epoch(self, place: int) -> Epoch:
        return Epoch(place, self._state_version, self._state, self.is_resting, self.heading,
                     self._pending_correction, self.bias_ambiguity ** 2,
                     self._ambiguity_begin_time, self._mixture_variance, [self._open_row(place)])

    def _open_row(self, place: int) -> tuple[int, float, float, Array]:
        """Return the open integral after a sample as that of an `Epoch`."""
        turn = self._with_unbiased_sensitivity(self._open_integral)
        return (place, turn.duration, turn.lost_variance + turn.extra_noise_variance,
                turn.sensitivity)

    def _take_block(self, piece: EvenSamples, number: int) -> bool:
        """Take a whole block; return False, and take nothing, if a rest ends within it."""
        begin, end = piece.block_starts[number], piece.block_stops[number]
        wheels = piece.wheels_of(number)
        rows = piece.rest_sensitivity if self.is_resting else piece.motion_sensitivity
        if self.is_resting:
            rates = (piece.rate[begin:end] - self._wander_rate
                     + rows[begin:end] @ self._calibration_errors)
            limit = math.hypot(self._energy.sudden_limit, self._bias_margin)
            if wheels or rates.max() > limit or rates.min() < -limit:
                return False
        part = self._block_integral
        part.duration, part.angle = (float(piece.block_sums[0, number]),
                                     float(piece.block_angles[number]))
        part.sensitivity = piece.sensitivity_integrals[self.is_resting][number]
        if self.is_resting != piece.last_at_rest:
            assert self._last_sample is not None
            part.sensitivity = (part.sensitivity + piece.half_intervals[begin]
                                * (self._last_sample[3] - rows[begin - 1]))
            piece.last_at_rest = self.is_resting
        self._block.duration = part.duration
        turned = self._corrected_angle(part)
        if self.is_resting:
            self.deleted_heading += turned
        else:
            decayed = float(piece.block_retentions[number])
            self.heading += turned + self._pending_correction * (1.0 - decayed)
            self._pending_correction *= decayed
        time, rate = float(piece.time[end - 1]), float(piece.rate[end - 1])
        self._last_sample = time, rate, rate, rows[end - 1]
        self._interval, self._last_time = float(piece.intervals[end - 1]), time
        self._still_sensitivity = None if piece.still is None else piece.still[end - 1]
        self._end_block(wheels)
        if not -math.inf < self.heading < math.inf:
            self._rebuild_state()
        return True

    def _rate_error(self, sensitivity: Array) -> float:
        """Return the error of a rate as estimated at rest, rad/s; cached for one sensitivity."""
        if sensitivity is not self._error_sensitivity:
            self._error_sensitivity, self._cached_rate_error = (
                sensitivity, self._wander_rate - float(sensitivity @ self._calibration_errors))
        return self._cached_rate_error

    def _integrate(self, interval: float, last: tuple[float, float, float, Array]) -> None:
        """Integrate the heading up to the last sample."""
        assert self._last_sample is not None
        _, rate, filtered, sensitivity = self._last_sample
        _, last_rate, last_filtered, last_sensitivity = last
        half = 0.5 * interval
        kept, last_kept = half * (filtered == rate), half * (last_filtered == last_rate)
        duration, turned = kept + last_kept, half * (filtered + last_filtered)
        if sensitivity is last_sensitivity:
            seen = duration * sensitivity
            corrected = turned - duration * self._rate_error(sensitivity)
        else:
            seen = kept * sensitivity + last_kept * last_sensitivity
            corrected = (turned - duration * self._wander_rate
                         + float(seen @ self._calibration_errors))
        part = self._block_integral
        part.duration += duration
        part.angle += turned
        part.sensitivity = part.sensitivity + seen
        if self.is_resting:
            self.deleted_heading += corrected
            return
        deleted = half * (rate - filtered + last_rate - last_filtered)
        self.deleted_heading += deleted
        self._filtered_turn += deleted
        settled = self._pending_correction * duration / CORRECTION_TIME
        self._pending_correction -= settled
        self.heading += corrected + settled

    def _end_block(self, wheels: bool | None) -> None:
        """Decide on rest or motion, by whether wheels moved in the block; None if unknown."""
        quiet = self._energy.add(self._block, wheels)
        if wheels:
            quiet = False
        self._block, self._wheels_moved = Block(), False
        part = self._close_block()
        if wheels is not False:
            self._standing.motion_time = self._last_time
        if wheels is not None and self._steady_rates is not None:
            self._steady_rates = None
            if self.is_resting:  # with what the wheels show
                self._begin_rest_again()
        if self.is_resting:
            self._rest_blocks.append(part)
            self._wheels_stand = wheels is False
            if quiet is False:
                self._revert_to_motion(WINDOW_DURATION)
            elif self._open_integral.duration >= _STEP_DURATION - TIME_TOLERANCE:
                self._advance_state()
                if self._steady_rates is not None and self._steady_rates.is_changing:
                    self._begin_rest_again()  # the bias changes in this rest too
                elif wheels is False and self._find_other_power_on():
                    self._begin_rest_again()
                else:
                    self._compare_means(wheels)
                    standing = self._standing
                    if (wheels is False and standing.is_undecided and self.is_resting
                            and self._rest_integral.duration >= WHEEL_DELAY):
                        # what turned may have been a change of the bias that has ended
                        self._end_sudden_rate(standing.ambiguity * standing.is_turned)
                        self._enter_rest()
            return
        if not quiet or wheels:
            self._quiet_duration, self._suspected_turn = WINDOW_DURATION, None
        if wheels:
            # a constant turn has the energy of a rest: no blocks are held while wheels move
            self._enter_motion(WINDOW_DURATION)

        # the last blocks, which may be the begin of a rest, are held
        self._recent_blocks.append(part)
        duration = sum(each.duration for each in self._recent_blocks)
        least = self._quiet_duration - TIME_TOLERANCE
        while (len(self._recent_blocks) > 2
               and duration - self._recent_blocks[0].duration >= least):
            duration -= self._recent_blocks.popleft().duration
        if self._open_integral.duration - duration >= _STEP_DURATION - TIME_TOLERANCE:
            self._advance_state(self._held_integral)
        if quiet and duration >= least and len(self._recent_blocks) > 1:
            self._decide_on_rest(wheels)

    def _decide_on_rest(self, wheels: bool | None) -> None:
        """Begin a rest with the last blocks if their mean is that of a rest."""
        held = self._held_integral - self._recent_blocks[0]  # in which the robot may still move
        still = self._with_still_sensitivity(held)
        difference, variance = _rate_difference(self._state, still)
        is_expected = difference ** 2 < self._sigmas[WINDOW_DURATION] ** 2 * variance
        standing, repeats, change = self._standing, False, 0.0
        if wheels is False:
            ambiguity = standing.ambiguity
            repeats = standing.add_rate(held, is_expected, self._state.noise,
                                        self._sigmas[WINDOW_DURATION])
            self._state_version += standing.ambiguity != ambiguity
            change = standing.largest_change(repeats)
        is_after_slow_turn = self._quiet_duration > WINDOW_DURATION
        sigmas = (0.5 if is_after_slow_turn else 1.0) * self._sigmas[self._quiet_duration]
        if not difference ** 2 < sigmas ** 2 * (variance + change ** 2):
            if is_after_slow_turn and not self._accept_slow_turn_as_bias():
                self._enter_motion(self._quiet_duration)
            return
        self._advance_state(held)
        change, lasts = 0.0, (
            wheels is False and not is_expected and standing.lasts(self._last_time))
        if wheels is False:
            standing.shows_other_power_on(held, self._state.noise, difference, variance)
        if standing.is_first_bias(repeats, lasts, held, self._state.noise):
            self._change_bias(0.0, standing.adopt_power_on(
                difference, self._last_time), still)
        elif lasts or repeats:
            change = difference  # that only the wheels explain
        standing.has_rested |= is_expected or bool(change)
        if standing.is_undecided:
            if change:
                self._end_sudden_rate(change)
        else:
            if standing.has_rested:
                standing.ambiguity = 0.0
            # it may have come at any time since the last rest
            self._state = self._state.with_added_variance(
                HEADING_INDEX, (change * (self._last_time - self._motion_start_time)) ** 2)
        self._enter_rest(change)
        self._rest_blocks.extend([*self._recent_blocks][1:])

    def _end_sudden_rate(self, rate: float) -> None:
        """Add the variance of a turn at a rate, rad/s, since a rate began suddenly."""
        begin, end = self._ambiguity_begin_time, self._last_time
        if self.is_resting:
            end -= self._rest_integral.duration
        self._state = self._state.with_added_variance(HEADING_INDEX, (rate * (end - begin)) ** 2)
        self._standing.end_sudden_rate(self._last_time)

    def _find_other_power_on(self) -> bool:
        """Tell whether the rate of a rest that wheels show is that of another power-on."""
        return self._standing.shows_other_power_on(
            self._rest_integral, self._state.noise, *_rate_difference(
                self._snapshots[0].state, self._with_still_sensitivity(self._rest_integral)))

    @property
    def _held_integral(self) -> RateIntegral:
        """Return the integral over the last blocks, which may be the begin of a rest."""
        return sum(self._recent_blocks, self._zero_integral)

    def _close_block(self) -> RateIntegral:
        """Add the integral of the block to the open one, and return it."""
        part = self._block_integral
        self._block_integral = RateIntegral(0.0, 0.0, self._zero_integral.sensitivity)
        if part.duration > 0.0:
            part.block_count, part.block_square_sum = 1, part.angle ** 2 / part.duration
        self._open_integral += part
        self._open_variance = None
        return part

    def _accept_slow_turn_as_bias(self) -> bool:
        """Attribute a slow, constant turn to a change of the bias at rest; tell whether so."""
        # A robot does not turn at a constant rate for minutes. Otherwise a bias that wanders by
        # more than the model states would cause a permanent drift of the heading at rest.
        suspected, held = self._suspected_turn, self._with_still_sensitivity(self._held_integral)
        if suspected is None:
            return False
        if suspected.rate_integral.duration + held.duration < _SLOW_TURN_DECISION_TIME:
            suspected.rate_integral += held
            return False
        start = suspected.snapshot.state.with_added_variance(WALK_INDEX, suspected.rate ** 2)
        moved = start.advance_at_rest(self._with_still_sensitivity(suspected.rate_integral))
        if (abs(self._normalized_innovation(moved, held))
                > self._sigmas[self._quiet_duration]):
            suspected.rate_integral += held
            return False
        if self._keeps_steps:
            assert self._last_sample is not None
            moving = next((step.moving_heading for step in self.steps[
                suspected.snapshot.step_count:]), self._moving_heading)
            self._restore_steps(suspected.snapshot)
            self.steps.append(
                TrackStep(start, self._with_still_sensitivity(suspected.rate_integral), True,
                          self._last_sample[0] - self._block_integral.duration - held.duration,
                          moving))
        self._state, self._open_integral, self._suspected_turn = moved, self._held_integral, None
        self._enter_rest()
        return True

    def _normalized_innovation(self, state: HeadingState, turn: RateIntegral) -> float:
        """Return the deviation of an integral from that at rest, in standard deviations."""
        difference, variance = _rate_difference(state, turn)
        return difference / math.sqrt(variance)

    def _compare_means(self, wheels: bool | None) -> None:
        """Compare the means over the longer lags with the bias that was known before them."""
        for lag in MEAN_LAGS:
            before = self._snapshot_before(lag)
            if before is None:
                return
            turn = self._rest_integral - before.rate_integral
            expected, variance = before.state.expected_rest_angle(turn)
            if wheels is not False:
                variance += (before.scatter * turn.duration
                             * before.state.noise.angle_random_walk ** 2)
            if abs(turn.angle - expected) > self._sigmas[lag] * math.sqrt(variance):
                change = (turn.angle - expected) / turn.duration
                if wheels is not False or self._standing.is_sudden(
                        change, lag, before.rate_integral.duration):
                    self._revert_to_motion(lag)
                elif lag < WHEEL_DELAY:
                    continue
                else:
                    if self._standing.is_undecided:
                        self._end_sudden_rate(change)
                    self._enter_rest(change)
                return

    def _snapshot_before(self, lag: float) -> Snapshot | None:
        """Return the state `lag` s before the last step of this rest; None if before its begin."""
        place = bisect_right(self._snapshots, self._rest_integral.duration - lag + TIME_TOLERANCE,
                             key=lambda each: each.rate_integral.duration)
        return self._snapshots[place - 1] if place else None

    # From rest to motion and back

    def _enter_rest(self, bias_change: float = 0.0) -> None:
        """Begin a rest with the state as it is, or with an unexpected change of bias, rad/s."""
        self._state = self._state.with_added_variance(WALK_INDEX, bias_change ** 2)
        self.is_resting, self._rest_integral = True, self._zero_integral
        self._wheels_stand = False
        self._rest_blocks = deque(maxlen=_MAX_REST_BLOCKS)
        self._rest_scatter.begin_rest(
            (self._state_bias(self.sensitivity)[1] / self._state.noise.angle_random_walk) ** 2)
        median = median_ratio(self._rest_scatter.probabilities(np.zeros(1)))
        self._snapshots = [Snapshot(self._state, self._zero_integral, self.deleted_heading,
                                    len(self.steps), scatter=median)]
        self._adopt_state()

    def _begin_rest_again(self) -> None:
        """Take this rest for a motion, after which a rest may begin at once."""
        self._revert_to_motion(self._rest_integral.duration)
        self._quiet_duration, self._suspected_turn = WINDOW_DURATION, None

    def _enter_motion(self, quiet_duration: float) -> None:
        """Begin a motion, which lasts until the rate is quiet for `quiet_duration` s."""
        if self.is_resting and len(self._snapshots) > 1:
            self._standing.end_rest(self._rest_integral)
            self._motion_start_time = self._last_time - self._open_integral.duration
        self.is_resting, self._quiet_duration = False, quiet_duration
        self._recent_blocks.clear()

    def _revert_to_motion(self, lag: float) -> None:
        """Revise a rest to a motion since `lag` s before the last block."""
        self._advance_state()
        snapshot = self._snapshot_before(max(lag, WINDOW_DURATION)) or self._snapshots[0]
        turn = self._rest_integral - snapshot.rate_integral
        if lag <= WINDOW_DURATION:
            snapshot, turn = self._locate_motion_start(snapshot, turn)
        self._suspected_turn = None
        if lag >= MEAN_LAGS[0]:
            longest = replace(self._zero_integral, duration=MEAN_LAGS[-1])
            least = (self._sigmas[MEAN_LAGS[-1]] / MEAN_LAGS[-1]
                     * math.sqrt(snapshot.state.expected_rest_angle(longest)[1]))
            turn_rate = (turn.angle - snapshot.state.expected_rest_angle(turn)[0]) / turn.duration
            if abs(turn_rate) < _SLOW_TURN_FACTOR * least:  # it may be a change of the bias
                self._suspected_turn = SlowTurn(snapshot, turn_rate, turn + self._zero_integral)
        if len(self._snapshots) > 1 and not self._wheels_stand:
            self._rest_scatter.learn(self._snapshots[-1])
        self._state, self.deleted_heading = snapshot.state, snapshot.deleted_heading
        self._open_integral = turn
        if self._steady_rates is not None:
            self._steady_rates.remove(turn)
        self._restore_steps(snapshot)
        self._rest_integral = snapshot.rate_integral
        is_sudden = self._wheels_stand and self._standing.has_settled(
            snapshot.rate_integral.duration)
        self._enter_motion(max(lag, WINDOW_DURATION))
        if is_sudden:
            self._standing.begin_sudden_rate(self._motion_start_time)
        self._advance_state()

    def _locate_motion_start(self, snapshot: Snapshot,
                             turn: RateIntegral) -> tuple[Snapshot, RateIntegral]:
        """Return the state at the last block at rest since a snapshot, and the integral after."""
        # The begin of motion is located by maximum likelihood, with rates of unknown scatter in
        # motion; the block before it is counted as motion, as it may contain the begin.
        blocks, duration = list[RateIntegral](), 0.0
        for block in reversed(self._rest_blocks):
            if duration + block.duration > turn.duration + TIME_TOLERANCE:
                break
            blocks.insert(0, self._with_still_sensitivity(block))
            duration += block.duration
        if len(blocks) < 3 or turn.duration - duration > BLOCK_DURATION:
            return snapshot, turn
        state, innovations = snapshot.state, list[float]()
        for block in blocks:
            innovations.append(self._normalized_innovation(state, block))
            state = state.advance_at_rest(block)  # an error of the bias is in the first alone
        squares = np.square(innovations)
        at_rest = np.cumsum(squares)[:-1]
        moving = np.maximum((squares.sum() - at_rest) / np.arange(len(blocks) - 1, 0, -1), 1.0)
        last = int(np.argmin(at_rest + np.arange(len(blocks) - 1, 0, -1) * (1.0 + np.log(moving))))
        if not last or abs(innovations[0]) > _BIAS_MARGIN_SIGMAS:  # as of a sample at rest
            return snapshot, turn
        quiet = sum(blocks[1:last], blocks[0])
        while self._snapshots[-1] is not snapshot:
            self._snapshots.pop()
        self._restore_steps(snapshot)
        self._state = snapshot.state
        self._rest_integral = snapshot.rate_integral + self._zero_integral
        self.deleted_heading = (snapshot.deleted_heading + quiet.angle
                                - snapshot.state.expected_rest_angle(quiet)[0]
                                + self._corrected_angle(self._block_integral))
        self._advance_at_rest(quiet, turn - quiet)
        return self._snapshots[-1], turn - quiet

    def _restart_after_gap(self, interval: float, fastest: float, may_have_turned: bool) -> str:
        """Restart after a gap or a backward jump of the stamps; nothing is integrated over it."""
        # Unless the wheels stood, the robot may have turned to any direction meanwhile, also
        # between two rests. The duration of a backward jump is unknown.
        self._advance_to_last_sample()
        assert self._last_sample is not None
        self._last_time = self._last_sample[0]
        self._block, self._wheels_moved = Block(), False
        self._energy.clear()
        self._filter.clear()
        self._recent_rates.clear()
        self._enter_motion(WINDOW_DURATION)
        duration = max(interval, 0.0)
        if interval > 0.0:
            self.intervals.count_lost(interval)
        lost = (fastest * duration) ** 2 + may_have_turned * math.tau ** 2
        self._add_unobserved_turn(lost + self._erroneous_turn ** 2, duration)
        return (f'no samples for {interval:.3f} s' if interval > 0.0
                else f'the stamp jumps back by {-interval:.3f} s')

    def _add_unobserved_turn(self, variance: float, duration: float = 0.0,
                             angle: float = 0.0) -> None:
        """Add a turn, rad, that was not measured in a time, s, after the last sample."""
        self._erroneous_turn = 0.0
        if variance or duration:  # else a measurement at rest without variance
            turn = replace(self._zero_integral, duration=duration, angle=angle,
                           lost_variance=variance, is_unobserved=True)
            if self._steady_rates is not None:
                self._moving_heading = self._steady_rates.moving_heading(self._state.noise)
                self._steady_rates.restart(self._steady_rates.moving_state(
                    self._state.noise).propagate(turn))
            self._propagate_state(turn, self._last_time)
        self._adopt_state()

    def _advance_to_last_sample(self) -> None:
        """Propagate the state to the last sample."""
        self._close_block()
        if not self.is_resting:
            self._enter_motion(self._quiet_duration)
        self._advance_state()

    def _advance_state(self, remaining: RateIntegral | None = None) -> None:
        """Propagate the state over the open integral, except for the part `remaining`."""
        remaining = remaining or self._zero_integral
        turn, self._open_integral = self._open_integral - remaining, remaining
        if turn.duration > TIME_TOLERANCE:
            end = self._last_time - self._block_integral.duration - remaining.duration
            still, before = self._with_still_sensitivity(turn), self._state
            if self._keeps_steps and self._steady_rates is not None:
                self._moving_heading = self._steady_rates.moving_heading(before.noise)
            if self.is_resting:
                self._advance_at_rest(still, remaining)
            else:
                self._propagate_state(turn, end)
            rates, sigmas = self._steady_rates, self._sigmas.get(MEAN_LAGS[0], 0.0)
            if (rates is not None
                    and rates.add(turn, still, end, before, sigmas, self.is_resting)
                    and (change := rates.compare(self._state, sigmas)) and not self.is_resting):
                self._change_bias(*change[:2], still)
                rates.adopt(self._state, change[2])
        self._adopt_state()

    def _change_bias(self, change: float, variance: float, still: RateIntegral) -> None:
        """Add a change of the bias, rad/s, and its variance, since the begin of the heading."""
        end = self._last_time - self._block_integral.duration - self._open_integral.duration
        self._state = self._state.with_bias_change(
            change, variance, end - self._heading_begin_time)
        # there was no rest: the steps are computed again with the change
        first = self.recalibrations[-1][0] if self.recalibrations else 0
        if first < len(self.steps):
            state, row = self.steps[first].state_before, still.sensitivity / still.duration
            state = state.with_bias_change(
                self._state.rate_error(row)[0] - state.rate_error(row)[0], variance, 0.0)
        for place, step in enumerate(self.steps[first:], first):
            self.steps[place] = replace(step, state_before=state, is_resting=False,
                                        moving_heading=state.heading(self._zero_integral))
            state = state.propagate(step.rate_integral)

    def _advance_at_rest(self, turn: RateIntegral, remaining: RateIntegral) -> None:
        """Propagate the state over a part of a rest, and update the scatter of its rates."""
        # A rest is one step of at most `MEAN_LAGS[-1]` s, extended and computed again with what is
        # known of its scatter: the parts of a straight drive are alike, and confirm each other.
        before, noise = self._snapshots[-1], self._state.noise
        white = noise.angle_random_walk ** 2
        if before.scatter_state is None:
            expected, variance = self._state.expected_rest_angle(turn)
            scatter_state = np.array([
                [0.0], [expected / turn.duration], [0.0], [0.0],
                [max(variance / turn.duration ** 2 - white / turn.duration, 0.0)]])
        else:
            # a random walk whose estimate has the Allan deviation of the floor, for the flicker
            walk = noise.rate_random_walk ** 2 + noise.allan_floor ** 4 / white
            scatter_state = before.scatter_state + np.array(
                [[0.0], [0.0], [0.0], [0.0], [walk * turn.duration]])
        lost = turn.extra_noise_variance + turn.lost_variance
        scatter_state, likelihood = update_scatter(
            scatter_state, turn.angle / turn.duration,
            (white + lost / turn.duration) / turn.duration, white)
        # of the blocks about their mean
        scatter = turn.block_square_sum - turn.angle ** 2 / turn.duration
        blocks = scatter * turn.duration / (
            self._energy.noise_factor ** 2 * self._model_noise.angle_random_walk ** 2
            * turn.duration + lost)
        likelihood += before.log_likelihood - 0.5 * (
            (turn.block_count - 1) * np.log1p(BLOCK_RATIOS)
            - blocks * BLOCK_RATIOS / (1.0 + BLOCK_RATIOS)) - ENDING_RATES * turn.duration
        start, part, count, last = self._state, turn, len(self.steps), before.step
        moving = self._moving_heading
        if (last is not None and last.rate_integral.duration < MEAN_LAGS[-1] - TIME_TOLERANCE
                and self._wheels_stand == (last.rate_integral.wander is STANDSTILL)):
            start, part = replace(last.state_before, noise=noise), last.rate_integral + turn
            count, moving = before.step_count - 1, last.moving_heading
        chances = self._rest_scatter.probabilities(likelihood)
        if not self._wheels_stand:
            ratios = sum_ratios(max(part.duration, 1.0))
            if part.duration < 2.0 * _STEP_DURATION - TIME_TOLERANCE:
                # Until two parts of a rest have been compared, a drive passes for one just where
                # its rate is near the expected one, and does not measure the bias.
                ratios = np.where(ratios > 0.0, _UNINFORMATIVE_RATIO, 0.0)
            part.wander = np.array([ratios * (white * part.duration), chances])
        step = TrackStep(start, part, True, self._last_time - self._block_integral.duration
                         - remaining.duration, moving)
        self._state = start.advance_at_rest(part)
        self._rest_integral += turn
        self._snapshots.append(Snapshot(
            self._state, self._rest_integral,
            self.deleted_heading - self._corrected_angle(self._block_integral), count + 1, step,
            scatter_state, median_ratio(chances), likelihood))
        self._restore_steps(self._snapshots[-1])
        del self._snapshots[:-_MAX_SNAPSHOTS]

    def _restore_steps(self, snapshot: Snapshot) -> None:
        """Keep the steps until a state during a rest."""
        if self._keeps_steps:
            last = [] if snapshot.step is None else [snapshot.step]
            self.steps[snapshot.step_count - len(last):] = last

    def _propagate_state(self, turn: RateIntegral, end: float) -> None:
        """Propagate the state over an integral that ends at a time, s."""
        turn = turn if self.is_resting else self._with_unbiased_sensitivity(turn)
        if self._keeps_steps:
            self.steps.append(TrackStep(
                self._state, turn, self.is_resting, end, self._moving_heading))
        self._state = (self._state.advance_at_rest(turn) if self.is_resting
                       else self._state.propagate(turn))

    def _with_unbiased_sensitivity(self, turn: RateIntegral) -> RateIntegral:
        """Return an integral with the sensitivity for the rates without their bias."""
        if (self._sensitivity_slope is None or self._still_sensitivity is None
                or turn.is_unobserved):
            return turn
        bias = self._wander_rate - self._still_sensitivity @ self._calibration_errors
        return replace(turn, sensitivity=turn.sensitivity
                       - turn.duration * bias * self._sensitivity_slope)

    def _with_still_sensitivity(self, turn: RateIntegral) -> RateIntegral:
        """Return an integral with the sensitivity of a rest, free of the noise of the rates."""
        copy = turn + self._zero_integral
        if self._still_sensitivity is not None:
            copy.sensitivity = turn.duration * self._still_sensitivity
        return copy

    def _adopt_state(self) -> None:
        """Adopt the new state and the noise of the samples; the heading does not jump."""
        if not math.isfinite(float(self._state.mean.sum()) + float(self._state.covariance.sum())):
            self._rebuild_state()
        walk = self._model_noise.angle_random_walk * (
            self._energy.noise_factor
            if self._detects_rest and self._energy.noise_factor > NOISE_TOLERANCE else 1.0)
        if walk != self._state.noise.angle_random_walk:
            self._state = replace(
                self._state, noise=replace(self._model_noise, angle_random_walk=walk))
        self._wander_rate = self._state.wander_rate[0]
        self._calibration_errors = self._state.calibration_errors[0]
        self._error_sensitivity = self._bias_sensitivity = None
        self._bias_margin = _BIAS_MARGIN_SIGMAS * self._state_bias(self.sensitivity)[1]
        self._open_variance, self._state_version = None, self._state_version + 1
        estimate = (float(self._state.mean[HEADING_INDEX])
                    + (0.0 if self.is_resting
                       else self._corrected_angle(self._open_integral + self._block_integral)))
        if self._steady_rates is not None:
            shift, self._mixture_variance = self._steady_rates.heading_shift(self._state)
            estimate += shift
        self._pending_correction = estimate - self.heading
        self._last_finite_heading = (self.heading,
                                     float(self._state.covariance[HEADING_INDEX, HEADING_INDEX]))

    def _rebuild_state(self) -> None:
        """Initialize the state at the last finite heading, with an uncertainty of a full turn."""
        heading, variance = self._last_finite_heading
        covariance, age = self._calibration
        self._initialize(self._model_noise, np.nan_to_num(covariance), age, heading,
                         variance + math.tau ** 2)
        self.rebuild_count += 1
        self._rebuild_message = ('the state was not finite and was initialized again; '
                                 'the heading error may be up to a full turn')
        self._configure()

    def _corrected_angle(self, part: RateIntegral) -> float:
        """Return the integral of the rates less their error as estimated at rest, rad."""
        return (part.angle - part.duration * self._wander_rate
                + float(part.sensitivity @ self._calibration_errors))

    # What is known

    def heading_shifts(self, states: Sequence[HeadingState]) -> Array:
        """
        Return what smoothed states are to be changed by, if the vehicle may never rest.

        The states, shape (k,), are those before the last steps and that at the end. The result,
        shape (2, k), has angles, rad, and variances, rad²; it is zero before another calibration.
        """
        first, rates = self.recalibrations[-1][0] if self.recalibrations else 0, self._steady_rates
        if rates is None:
            return np.zeros((2, len(states)))
        moving = [*(step.moving_heading for step in self.steps[first:]),
                  rates.moving_heading(self._state.noise)]
        return np.array([(0.0, 0.0)] * (len(states) - len(moving)) + [
            rates.heading_shift(state, each)
            for state, each in zip(states[len(states) - len(moving):], moving)]).T

    def finish(self) -> HeadingState:
        """Propagate the state to the last sample, and return it."""
        self._advance_to_last_sample()
        return self._state

    @property
    def bias(self) -> tuple[float, float]:
        """Return the bias at rest in addition to the calibration, and its deviation, rad/s."""
        return self.bias_for(self.sensitivity)

    @property
    def sensitivity(self) -> Array:
        """Return that of the last sample."""
        return (self._zero_integral.sensitivity if self._last_sample is None
                else self._last_sample[3])

    def bias_for(self, sensitivity: Array) -> tuple[float, float]:
        """Return the same for another sensitivity, (m,), as of samples at another temperature."""
        bias, deviation = self._state_bias(sensitivity)
        return bias, math.hypot(deviation, self.bias_ambiguity)

    def _state_bias(self, sensitivity: Array) -> tuple[float, float]:
        """Return the same without `bias_ambiguity`."""
        if sensitivity is not self._bias_sensitivity:
            bias, variance = self._state.rate_error(sensitivity)
            self._bias_sensitivity, self._cached_bias = sensitivity, (bias, math.sqrt(variance))
        return self._cached_bias

    @property
    def rate_variance(self) -> float:
        """Return the variance of the last rate, (rad/s)², by noise, bias and scale."""
        return self._rate_variance(self.intervals.usual_interval)

    def _rate_variance(self, usual: float) -> float:
        interval = max(min(self._interval, usual), MIN_SAMPLE_INTERVAL)
        return self.bias[1] ** 2 + self._state.noise.rate_variance(
            WINDOW_DURATION if self.is_resting else interval)

    @property
    def slowest_detectable_rate(self) -> float:
        """Return the slowest turn, rad/s, that is detected in 95 % of cases; nan if unknown."""
        turns = ([(lag, replace(self._zero_integral, duration=lag)) for lag in MEAN_LAGS]
                 if self._detects_rest else [])
        power_sigmas = -float(ndtri(0.05))
        return min(((self._sigmas[lag] + power_sigmas)
                    * math.sqrt(self._state.expected_rest_angle(turn)[1]) / lag
                    for lag, turn in turns), default=math.nan)


def _rate_difference(state: HeadingState, turn: RateIntegral) -> tuple[float, float]:
    """Return what a mean rate differs by from that at rest, rad/s, and its variance."""
    expected, variance = state.expected_rest_angle(turn)
    return (turn.angle - expected) / turn.duration, variance / turn.duration ** 2
