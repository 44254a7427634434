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
Processing of the compensation node, without rclpy: samples, wheels, time and conflicts.

Stamps are nanoseconds since 1970 or of a simulation; guards and time-outs use the steady clock.

Two publishers are detected by their stamps: a sample of a second one divides an interval so that
one part is at most half of it. Two such intervals while the graph lists several publishers are the
proof. The graph alone is not, since it lists a killed driver for up to 20 s.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
import math
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

from gyro_calibration.calibration.self_calibration import RunLimits
from gyro_calibration.driver.timestamps import HostTimeConverter, read_clock_pair
from gyro_calibration.files import to_printable
from gyro_calibration.heading.bias_table import Prior
from gyro_calibration.heading.heading_estimator import (
    Assumptions, HeadingEstimator, MAX_SPECIFIC_FORCE, TEMPERATURE_TIMEOUT)
from gyro_calibration.heading.integration import Intervals, MAX_GAP, Threshold
from gyro_calibration.heading.tracker import TrackerSettings
from gyro_calibration.logs.cdr import NSEC_PER_SEC, UNMEASURED_VARIANCE
from gyro_calibration.logs.log import DEGREE
from gyro_calibration.ros.calibration_session import (
    CalibrationSession, FINISH_TIMEOUT, MIN_ODOMETRY_DURATION, MIN_TURN_ANGLE, PROFILE, REST,
    ROS_TIME_PAUSED)
from gyro_calibration.ros.health_monitor import (
    HealthMonitor, PulseDetector, RepeatedOutputDetector)
from gyro_calibration.ros.inputs import (
    AlternateTurns, ArrivalOrder, Clock, COMMAND, FAULT_DURATION, MAX_ANGULAR_ACCELERATION,
    MAX_VELOCITY_AGE, NodeParameter, ODOMETRY, RosTime, StampDelay, TurnComparison, Velocity,
    Wheels)
from gyro_calibration.ros.state_store import StateStore

PARAMETERS = (
    NodeParameter('model_file', '', 'Model of the gyro (YAML); empty for none.'),
    NodeParameter('calibration_file', '',
                  'Where self-calibrations are kept, and next to it biases at rest; empty for a '
                  'file in ROS_HOME named after the node.'),
    NodeParameter('heading_frame', 'odom', 'Fixed frame in which the heading is given.'),
    NodeParameter('wheels', 'none', 'What shows the tracker whether the robot moves.',
                  choices=('none', 'odom', 'cmd_vel', 'both')),
    NodeParameter('cmd_vel_stamped', False, 'Whether cmd_vel is a TwistStamped.'),
    NodeParameter('maximum_gap', MAX_GAP, 'Over a longer gap in the stamps nothing is integrated.',
                  's', (0.01, 60.0)),
    NodeParameter('stationary.method', 'rest',
                  'How standstill is found: by the statistics of the rate, by the threshold '
                  'filter, or not at all.', choices=('rest', 'threshold', 'none')),
    NodeParameter('stationary.threshold', Threshold.rate,
                  'Threshold filter: a mean rate over 0.2 s below it is zero; 0 switches it off.',
                  'rad/s', (0.0, 0.1)),
    NodeParameter('assumed.bias', Assumptions.bias,
                  'Standard deviation of the bias without a calibration.', 'rad/s', (0.0, 1.0)),
    NodeParameter('assumed.scale_factor_error', Assumptions.scale_factor_error,
                  'Standard deviation of the scale factor error without a calibration.', '1',
                  (0.0, 1.0)),
    NodeParameter('assumed.bias_temperature_coefficient', Assumptions.bias_temperature_coefficient,
                  'Standard deviation of the change of the bias with temperature; 0 for a gyro '
                  'that compensates it.', 'rad/s/K', (0.0, 0.1)),
    NodeParameter('calibration.reference', 'profile', 'What calibrate compares the gyro with.',
                  dynamic=True, choices=('profile', 'odometry', 'turns')),
    NodeParameter('calibration.profile_file', '',
                  'Motion profile (CSV); empty for the built-in one of 20 s.'),
    NodeParameter('calibration.drive', False, 'Drive the motion profile on cmd_vel.',
                  dynamic=True),
    NodeParameter('calibration.duration', 20.0, 'Length of a calibration by odometry.', 's',
                  (MIN_ODOMETRY_DURATION, FINISH_TIMEOUT), True),
    NodeParameter('calibration.turns', 0,
                  'Whole turns of a calibration by turns, counter-clockwise positive; 0 takes the '
                  'number that the gyro shows.', '', (-100, 100), True),
    NodeParameter('calibration.odometry_scale_deviation', 0.01,
                  'Standard deviation of the scale of turns by odometry.', '1', (0.0, 0.5), True),
    NodeParameter('calibration.maximum_bias', RunLimits.max_bias,
                  'A calibration with a larger bias is refused.', 'rad/s', (0.0, 10.0), True),
)

_POWER_OFF_SILENCE = 10.0  # s; the gyro may have been without power, and its bias have changed
_TURN_CHECK_DURATION = 0.5  # s; averaging time of the rate that must be zero before a drive
_MAX_TEMPERATURE_STEP = 5.0  # K; a larger one must be confirmed by the next temperature
_INTERLEAVING_WINDOW = 1.0  # s; two changes of the frame in it show several publishers


class CorrectedSample(NamedTuple):
    stamp: int  # ns
    heading: float  # rad
    heading_variance: float  # rad²; as not measured where the noise of the gyro is unknown
    rate: float  # rad/s
    rate_variance: float  # (rad/s)²


COUNT_NAMES = ('samples', 'refused_samples', 'refused_temperatures', 'lost_samples',
               'repeated_stamps', 'restarts', 'rebuilt', 'temperature_clipped', 'beyond_range')


@dataclass
class _Journal:
    last_received: float  # time of the last sample, s of the steady clock
    counts: dict[str, int] = field(default_factory=lambda: dict.fromkeys(COUNT_NAMES, 0))
    event: str = ''  # the last one
    refusal: str = ''  # why the last sample was refused; '' where it was used
    clock_steps: str = ''  # of the host clock
    refused_calibrations: int = 0
    refusal_reasons: deque[str] = field(default_factory=lambda: deque(maxlen=3))
    channels: set[str] = field(default_factory=set)  # further ones in the samples


class Pipeline:
    """Computes corrected rates and the heading from raw samples; faults are sentences or ''."""

    def __init__(self, values: SimpleNamespace, calibration_file: Path, clock: Clock,
                 send: Callable[[float], None]):
        """Read model and calibration; `send` publishes a rate about z on cmd_vel, rad/s."""
        self.values, self._clock = values, clock
        coefficient = values.assumed_bias_temperature_coefficient
        self.store = store = StateStore(
            values.model_file, calibration_file,
            calibration_file.with_name(f'{calibration_file.stem}_biases.yaml'),
            Prior(coefficient=coefficient), values.calibration_maximum_bias)
        noise = store.model.noise
        method = values.stationary_method
        self._standstill_rate = 0.0 if method == 'none' else values.stationary_threshold
        # of rests 0.1 per hour are taken for motion; with unknown noise the threshold is used
        self.estimator = HeadingEstimator(
            store.model, store.table,
            Assumptions(values.assumed_bias, values.assumed_scale_factor_error, coefficient),
            TrackerSettings(0.1 if method == 'rest' else 0.0, Threshold(
                self._standstill_rate, angle_random_walk=noise.angle_random_walk),
                values.maximum_gap), clock.date())
        # false alarms per hour of rest, and three deviations of the bias of an uncalibrated gyro
        self.monitor = HealthMonitor(noise, 0.001, self._standstill_rate,
                                     3.0 * values.assumed_bias)
        self.wheels, self.journal = Wheels(), _Journal(clock.steady())
        self.session = CalibrationSession(self.estimator, store, self.monitor, send, clock)
        self.ros_time, self._host_time = RosTime(), HostTimeConverter()
        self.conflict = ''  # why samples cannot be used
        # that several nodes publish on another topic, by its role: `ODOMETRY` of calibrations
        self.topic_conflicts: dict[str, str] = {}
        self._noise_is_known = noise.angle_random_walk > 0.0 and not store.problem
        self._epoch: int | None = None
        self._stamp_offset = round(NSEC_PER_SEC * store.model.true_time(0.0))
        self._last_time, self._last_stamp = -math.inf, 0
        self._jump_times = deque[float](maxlen=2)
        self._order = ArrivalOrder()
        self._intervals = Intervals()  # between all of them, so that they can end a conflict
        self._first_frame: str | None = None
        self._frame: str | None = None
        # that the graph lists several publishers, and samples too soon after the one before
        self.publisher_conflict, self._interleaved_count = '', 0
        self._last_arrival, self._backlog = clock.steady(), 0.0  # delay of the last samples, ns
        self._trusted_heading = 0.0, 0.0
        # begin of samples with a repeated stamp, s, and the largest rate among them, rad/s
        self._frozen_stamp: tuple[float, float] | None = None
        # that the gyro is dead, or may be so
        self.repeat_fault = self.repeat_suspicion = ''
        self.repeat_detector = RepeatedOutputDetector(noise)
        self._pulse_detector, self._outlier_count = PulseDetector(), 0
        self.clock_fault = self._suspected_clock_fault = ''
        self.stamp_delay = self._new_stamp_delay()
        self._suspect_temperature = math.nan  # a temperature, degC
        self._odometry_lateness = -math.inf, 0.0  # when it came, and its lateness, s
        # odometry heading when its rate became zero, rad, and times of the last odometry and of a
        # contradiction, s
        self._heading_at_rest = self._odometry_time = math.nan
        self._contradiction_time, self._is_motion_shown = -math.inf, False
        self._turns, self._alternate_turns = TurnComparison(), AlternateTurns()
        # time until which gyro and odometry agreed at standstill, s, whether it stands, and the
        # possible error of the heading and the turn by the gyro since then, rad
        self._agreed_time, self._stood, self._false_turn = math.inf, False, (0.0, 0.0)
        self._recent_rates, self._known_beginnings = deque[tuple[float, float]](), 0

    # Time

    def _new_stamp_delay(self) -> StampDelay:
        """Return a comparison of stamps and clock, whose tolerance a deviation of 6 % exceeds."""
        self._stamp_turn = 0.0  # unknown turn by them that is in the variance, rad
        # a busy computer delays all samples by a second for a short time
        return StampDelay(self._clock, 30.0, (0.5, 1.0), (5.0, FAULT_DURATION))

    def _since_epoch(self, stamp: int) -> float:
        """Return s since the second of the first stamp, so that a double resolves nanoseconds."""
        if self._epoch is None:
            self._epoch = stamp - stamp % NSEC_PER_SEC
        return 1e-9 * (stamp - self._epoch)

    def _message_time(self, stamp: int) -> float:
        """Return the time of a message other than a sample, s."""
        since = self._since_epoch(stamp)
        return (since if self._last_time == -math.inf
                else self._host_time.convert_message(since, self._last_time))

    def _update_host_clock(self) -> None:
        """Detect steps of the host clock, and correct stored dates by them."""
        clock, journal = self._clock, self.journal
        read = read_clock_pair(clock.steady, clock.date)
        if not read or not (step := self._host_time.update(*read)):
            return
        journal.event = (f'the clock of this computer was set by {step:+.1f} s; the heading '
                         'continues')
        journal.clock_steps = f'{self._host_time.steps.count}, last by {step:+.1f} s'
        self.estimator.shift_clock(step)
        if self.store.table_written_time is not None:
            self.store.table_written_time += step
        if self.estimator.is_calibrated_this_run and self.estimator.model.self_calibration:
            self.store.store_calibration(self.estimator.model.self_calibration)

    # Inputs

    def add_temperature(self, stamp: int, value: float) -> None:
        """Add a temperature, degC; a stamp far ahead of the samples is replaced by the last."""
        time = self._message_time(stamp)
        if time - self._last_time > TEMPERATURE_TIMEOUT and self._last_time > -math.inf:
            time = self._last_time
        estimator, counts = self.estimator, self.journal.counts
        refused, known = estimator.refused_temperature_count, estimator.temperature
        odd = (known is not None and not estimator.is_temperature_lost
               and not abs(value - known) <= _MAX_TEMPERATURE_STEP
               and not abs(value - self._suspect_temperature) <= _MAX_TEMPERATURE_STEP)
        self._suspect_temperature = value if odd else math.nan
        if not odd:
            estimator.add_temperature(time, value)
        if odd or estimator.refused_temperature_count > refused:
            counts['refused_temperatures'] += 1
            self.journal.event = (f'a temperature of {value:g} degC is implausible'
                                  f'{f" after {known:g} degC" if odd else ""} and not used: '
                                  'check the sensor, and that its driver sends degC')

    def add_odometry(self, stamp: int, heading: float, velocity: Velocity) -> None:
        """Add a heading, rad, and a velocity by the odometry."""
        now, rate, time = self._clock.steady(), velocity.angular[2], self._message_time(stamp)
        # what a robot may turn between two messages of standstill, unless none shows motion
        interval, self._odometry_time = time - self._odometry_time, time
        self._is_motion_shown = self._is_motion_shown or velocity.is_moving
        hidden = (0.25 * MAX_ANGULAR_ACCELERATION * interval ** 2
                  if self._is_motion_shown or interval > MAX_VELOCITY_AGE else 0.0)
        turned = abs(math.remainder(heading - self._heading_at_rest, math.tau))
        if velocity.is_moving:
            self._heading_at_rest = math.nan
        elif turned > max(hidden, MIN_TURN_ANGLE):
            self._contradiction_time, self._heading_at_rest = now, heading
            self.estimator.tracker.add_unknown_turn(MIN_TURN_ANGLE)
        elif not turned + hidden <= MIN_TURN_ANGLE:
            self._heading_at_rest = heading
        # how late it is for the last sample, or ahead of one that would come now
        late = self._last_time - time if self._last_time > -math.inf else 0.0
        late = max(late, 0.0) or min(late + now - self._last_arrival, 0.0)
        self._odometry_lateness = now, late
        # A late message is not used, and a contradictory one does not show standstill.
        if (not late > MAX_VELOCITY_AGE
                and (velocity.is_moving or not self._is_odometry_contradictory)):
            self.wheels.add(ODOMETRY, velocity, now)
        if math.isfinite(heading) and math.isfinite(rate):
            self._compare_turns(ODOMETRY, time, rate,
                                not velocity.is_moving and not self._is_odometry_contradictory)
            self.session.add_odometry(time, heading, rate)

    def _compare_turns(self, source: str, time: float, rate: float, stands: bool = False) -> None:
        """Compare the heading with a rate by odometry or commands, and add an unknown turn."""
        estimator, turns = self.estimator, self._turns
        turns.add(source, time, rate, self._heading, stands=stands)
        (duration, turned, least_rate), (known, _) = turns.turn_at_rest, self._false_turn
        if not duration:
            if self._stood and not known:
                self._agreed_time = time
            self._stood, self._false_turn = False, (0.0, 0.0)
            return
        self._stood = True
        if turned > 4.0 * estimator.tracker.bias[1] * duration + MIN_TURN_ANGLE:
            # a bias may have changed at any time since the last rest in which both agreed
            before = max(time - duration - self._agreed_time, 0.0)
            unknown = max(turned + least_rate * before, known)
            self._false_turn = unknown, turned
            estimator.tracker.add_unknown_turn(math.sqrt(unknown ** 2 - known ** 2))

    @property
    def _heading(self) -> float:
        """Return the heading as without resets, rad."""
        return self.estimator.heading_before_resets + self.estimator.tracker.heading

    @property
    def heading_variance(self) -> float:
        """Return the variance of the heading, rad², by codes and while the gyro may be dead."""
        return (self.estimator.tracker.variance + self.repeat_detector.rounding_variance
                + bool(self.repeat_suspicion) * math.tau ** 2)

    @property
    def heading_loss(self) -> str:
        """Return that the heading is unknown, in a sentence; else ''."""
        if not self._noise_is_known or self.heading_variance < math.tau ** 2:
            return ''
        event = self.journal.event or 'the errors of scale factor and bias have added up'
        return f'the heading is unknown ({event}): call reset_heading where it is to be zero'

    @property
    def _is_odometry_contradictory(self) -> bool:
        return self._clock.steady() - self._contradiction_time <= 600.0  # s

    @property
    def faults(self) -> dict[str, str]:
        """Return the faults of clocks, frames and turns, each a sentence or '', by name."""
        turned, (came, late) = self.stamp_delay.unknown_turn, self._odometry_lateness
        return {
            'clock': self.clock_fault,
            'frame': (self._frame != self._first_frame) * to_printable(
                f"the samples on imu/data_raw have the frame '{self._frame!s:.99}', and had "
                f"'{self._first_frame!s:.99}': the calibration may be that of another gyro; "
                'restart this node, and calibrate another gyro'),
            'alternation': self._alternate_turns.is_contradictory * (
                'every other sample on imu/data_raw shows another turn, as with two gyros on one '
                'topic: give each gyro a topic of its own'),
            **self._turns.faults,
            'stamp': (turned > MIN_TURN_ANGLE) * (
                f'the heading may be off by {turned / DEGREE:.1f} deg, since the pace of the '
                'stamps on imu/data_raw has changed: check that the driver stamps by a clock and '
                'loses no samples, then reset the heading'),
            'odometry_clock': (abs(late) > MAX_VELOCITY_AGE >= self._clock.steady() - came) * (
                f'odom is stamped {abs(late):.1f} s {"behind" if late > 0.0 else "ahead of"} '
                'imu/data_raw: stamp both by one clock, or synchronize those of their computers'),
            'odometry': self._is_odometry_contradictory * (
                'odom turns by its headings while its rate is zero: check its twist, without '
                'which it does not show that the robot stands'),
            'standstill': (self._false_turn[1] > 0.0) * (
                f'the gyro turned by {self._false_turn[1] / DEGREE:.1f} deg while odom shows that '
                'the robot stands: unless others turn it, call calibrate_bias, or check odom')}

    def add_command(self, velocity: Velocity) -> None:
        """Add a command from cmd_vel, also one of this node."""
        now = self._clock.steady()
        self.wheels.add(COMMAND, velocity, now)
        if self.wheels.is_moving(now, (ODOMETRY,)) is None:
            self._compare_turns(COMMAND, self._last_time, velocity.angular[2])
        self.session.add_command(velocity)

    def add_sample(self, stamp: int, output: float, specific_force: float | None = None,
                   receivers: int = 0, frame: str = '') -> CorrectedSample | None:
        """
        Return a sample corrected, or None where it cannot be used.

        The stamp is in ns, the output in rad/s, and the specific force along the input axis in
        m/s²; `receivers` is the number of other nodes that receive cmd_vel.
        """
        counts, journal, now = self.journal.counts, self.journal, self._clock.steady()
        counts['samples'] += 1
        end = NSEC_PER_SEC << 31  # `builtin_interfaces/Time` has 31 bits for seconds
        if not max(0, -self._stamp_offset) <= stamp < end - max(0, self._stamp_offset):
            counts['refused_samples'] += 1
            journal.event = (f'a stamp of {stamp / NSEC_PER_SEC:g} s is outside the range of ROS '
                             'time, and the sample is not used: check the clock of the driver')
            return None
        silence = now - self._last_arrival
        if self.publisher_conflict:
            self._order = ArrivalOrder()
        elif self._order.is_late(stamp) and frame == self._frame:
            journal.event = ('a sample came after the next one and is not used: the connection '
                             'to the driver changes their order')
            if self._order.has_two_clocks:
                self._note_jump(now, 'the stamps on imu/data_raw jump back repeatedly')
            return None
        self._detect_several_gyros(stamp, frame, now, silence)
        if 0.0 < (interval := 1e-9 * (stamp - self._last_stamp)) <= self.values.maximum_gap:
            self._intervals.add(interval)
        self._last_stamp, self._last_arrival = stamp, now
        if self.conflict:
            counts['refused_samples'] += 1
            return None
        time = self._since_epoch(stamp)
        if self._clock.simulated() is None:
            self._update_host_clock()
            time = self._host_time.convert_sample(
                time, self._last_time, self._intervals.usual_interval, silence)
        if self._is_repeated_stamp(time, stamp, output, now):
            counts['repeated_stamps'] += 1
            return None
        interval = time - self._last_time
        # Perhaps a loss of power; after a mere delay the stamps continue.
        if (now - journal.last_received > _POWER_OFF_SILENCE and interval < math.inf
                and not 0.0 < interval < _POWER_OFF_SILENCE):
            self.estimator.begin_run(self._clock.date())
        self._last_time = time
        if specific_force is not None and not abs(specific_force) <= MAX_SPECIFIC_FORCE:
            specific_force = None
        journal.channels = set() if specific_force is None else {'specific_force'}
        if not self._integrate(time, interval, silence, output, specific_force, now):
            return None
        self.stamp_delay.add(time, self._heading)
        self._check_repeats(time, output, now)
        self._alternate_turns.add(time, output)
        run, moving = self.session.run, self.wheels.is_moving(now)
        if moving or self.repeat_detector.is_zeroed:
            self.monitor.restart()
        elif self.monitor.is_enabled and self.monitor.add(time, output,
                                                          self.estimator.corrected_rate):
            self.monitor.examine_stretch(self.estimator.bias_variance,
                                         self.estimator.bias_age(self._clock.date()),
                                         run is not None and run.kind == REST,
                                         self.estimator.tracker.is_resting or moving is False)
        self.session.add(time, output, receivers)
        return self._corrected_sample(stamp, time)

    def _is_repeated_stamp(self, time: float, stamp: int, output: float, now: float) -> bool:
        """Tell whether a sample has the time of the last one; add what turned meanwhile, after."""
        first, fastest = self._frozen_stamp or (now, 0.0)
        lasts, text = now - first, f'{stamp / NSEC_PER_SEC:.3f} s'
        if time == self._last_time:
            self._frozen_stamp = first, max(fastest, abs(output))
            self.journal.event = (f'several samples have the stamp {text}, and only the first is '
                                  'used: let the driver stamp each when the gyro measures')
            return True
        self._frozen_stamp = None
        if lasts > FAULT_DURATION:
            self.estimator.tracker.add_unknown_turn(min(fastest * lasts, math.tau))
            self.journal.event = (f'the stamps stood still for {lasts:.1f} s while samples came; '
                                  'turns in this time are not in the heading')
        return False

    def _detect_several_gyros(self, stamp: int, frame: str, now: float, silence: float) -> None:
        """Detect frames that alternate, and samples of two publishers that interleave."""
        if frame != self._frame:
            before, self._frame = self._frame, frame
            if before is None:
                self._first_frame = frame
            else:
                self._note_jump(now, to_printable(
                    f"samples of the frames '{before:.99}' and '{frame:.99}' alternate on "
                    'imu/data_raw'))
        if not self.publisher_conflict:
            return
        # Samples that follow too soon, or go back, are not of the same publisher; nor, while the
        # middleware lists a killed driver, of one that sends twice as fast. Delayed samples also
        # follow too soon, until they have caught up.
        usual = NSEC_PER_SEC * self.estimator.tracker.intervals.usual_interval
        interval, behind = stamp - self._last_stamp, self._backlog
        self._backlog = 0.0 if silence > FAULT_DURATION else min(
            max(behind + interval - usual, 0.0), NSEC_PER_SEC * FAULT_DURATION)
        self._interleaved_count += interval < 0 or not (2.0 * interval > usual or behind)
        if self._interleaved_count > 1:
            self._refuse_all(self.publisher_conflict)

    def _note_jump(self, now: float, what: str) -> None:
        """Count a jump of stamps or frames; two within 1 s show several gyros."""
        self._jump_times.append(now)
        if len(self._jump_times) > 1 and now - self._jump_times[0] < _INTERLEAVING_WINDOW:
            self._refuse_all(f'{what}, as with several gyros on one topic: give each gyro a topic '
                             'of its own')

    def _integrate(self, time: float, interval: float, silence: float, output: float,
                   force: float | None, now: float) -> bool:
        """Use a sample, an interval by stamps and a silence, s, after the last; tell if it was."""
        estimator, journal, refused = self.estimator, self.journal, self.estimator.refused_count
        counts, lost = journal.counts, estimator.tracker.intervals.lost_samples
        wheels = self.values.wheels
        sources = (ODOMETRY, COMMAND) if wheels == 'both' else (wheels,)
        moving = self.wheels.is_moving(now, sources)
        unseen = not 0.0 < interval <= FAULT_DURATION
        if unseen and not moving and not self.wheels.has_stood(journal.last_received, now,
                                                               sources):
            moving = None
        restarted = estimator.add(time, output, self._clock.date(), force, moving)
        if estimator.refused_count > refused:
            counts['refused_samples'] += 1
            journal.event = journal.refusal = (
                'a sample without a rate (nan, or -1 in its covariance) is not used: check the '
                'gyro and its driver'
                if math.isnan(output) else
                f'a rate of {output:g} rad/s is beyond the range of this gyro, and not used: '
                'check that the driver sends rad/s, and the range of the model')
            return False
        journal.last_received, journal.refusal, tracker = now, '', estimator.tracker
        counts['temperature_clipped'] += int(estimator.last_compensated.temperature_clipped)
        counts['beyond_range'] += int(estimator.last_compensated.beyond_range)
        counts['lost_samples'] = tracker.intervals.lost_samples
        counts['rebuilt'] = tracker.rebuild_count
        if restarted:
            counts['restarts'] += 1
            journal.event = f'{restarted}: integration was restarted'
            self.monitor.restart()
            self.stamp_delay = self._new_stamp_delay()
            self._recent_rates.clear()
            self.session.interrupt(restarted)
        elif unseen and moving is not False and tracker.intervals.lost_samples > lost:
            turned = 0.25 * MAX_ANGULAR_ACCELERATION * interval ** 2
            if silence < 0.5 * interval:  # the stamps may have jumped without a loss
                turned += abs(estimator.rate) * interval
            tracker.add_unknown_turn(turned)
        return True

    def _corrected_sample(self, stamp: int, time: float) -> CorrectedSample | None:
        """Return what is published of the present state; None where it is not finite."""
        estimator, tracker, known = self.estimator, self.estimator.tracker, self._noise_is_known
        usual = self._intervals.usual_interval
        spread = 0.0 if known and usual < math.inf else self.values.assumed_bias ** 2
        # After a reset the variance is that of one sample; zero would state an exact heading.
        least = tracker.rate_variance * min(usual, 1.0) ** 2
        found = CorrectedSample(stamp + self._stamp_offset, tracker.heading,
                                max(self.heading_variance, least) if known
                                else UNMEASURED_VARIANCE,
                                estimator.rate, tracker.rate_variance + spread)
        if not math.isfinite(sum(found[1:])):
            return None
        if estimator.restart_count != self._known_beginnings:  # another calibration is in use
            self._known_beginnings = estimator.restart_count
            self._recent_rates.clear()
        self._recent_rates.append((time, estimator.corrected_rate))
        while time - self._recent_rates[0][0] > _TURN_CHECK_DURATION:
            self._recent_rates.popleft()
        return found

    def _check_repeats(self, time: float, output: float, now: float) -> None:
        """Detect repeated values and pulses, and add an unknown turn to the heading."""
        outliers, self._outlier_count = self._outlier_count, self.estimator.tracker.outlier_count
        pulse, size = self._pulse_detector.add(time, output)
        stands = self.wheels.is_moving(now) is False
        is_repeated = self.repeat_detector.add(
            time, output, self.wheels.turn_rate(now), self.monitor.has_noise_at_rest, stands,
            stands or self.estimator.tracker.is_resting)
        self.repeat_suspicion = (
            f'the gyro repeats the rate {output:g} rad/s without the noise of its model: it is '
            'dead, or shows this at rest; turn the robot to find out'
            if self.repeat_detector.is_suspected and not is_repeated else '')
        if not is_repeated:
            if self._outlier_count > outliers:  # the tracker has not used the sample
                pulse = 0.0
            unseen = math.hypot(self.repeat_detector.unseen_turn, pulse)
            if unseen and not self.repeat_fault:  # several samples may be a turn
                self.estimator.tracker.add_unknown_turn(unseen, -pulse if size == 1 else 0.0)
            self.repeat_fault = ''
        elif not self.repeat_fault:
            self.repeat_fault = (f'the gyro repeats the rate {output:g} rad/s: it is dead or '
                                 'saturated, or its driver has stopped')
            self.journal.event = self.repeat_fault
            self.estimator.tracker.add_unknown_turn(math.tau)
            if self.session.is_driving:
                self.session.end(self.repeat_fault)

    # Conflicts and obstacles

    def _refuse_all(self, conflict: str) -> None:
        """Refuse all samples, and restore the heading from before the conflict."""
        if not self.conflict:
            # Turns are unknown until only one gyro sends: add the variance of a full turn.
            heading, variance = self._trusted_heading
            self.estimator.set_heading(heading, variance + math.tau ** 2)
            self.journal.event = conflict
        self.conflict = conflict
        self.session.poll(self.values, 0, conflict=conflict)

    def update_publishers(self, names: Sequence[str]) -> None:
        """Take the names of the nodes that publish samples; called a few times per second."""
        self.publisher_conflict = '' if len(names) < 2 else (
            f'{len(names)} publishers send on imu/data_raw ({", ".join(sorted(names))}), and '
            'their samples cannot be distinguished: give each gyro a topic of its own')
        if not self.publisher_conflict:
            self._interleaved_count = 0
        if self._interleaved_count > 1:
            self._refuse_all(self.publisher_conflict)
        elif (not self._jump_times
                or self._clock.steady() - self._jump_times[-1] > _INTERLEAVING_WINDOW):
            self.conflict = ''
        if not self.conflict and not self._interleaved_count:
            tracker = self.estimator.tracker
            self._trusted_heading = tracker.heading, tracker.variance

    def find_conflict(self, kind: str) -> str:
        """Return why a calibration of a kind may mix gyros or odometries; else ''."""
        faults = self.faults
        return (self.conflict or faults['frame'] or faults['alternation']
                or self.topic_conflicts.get(kind, ''))

    def find_obstacle(self) -> str:
        """Return why the robot must not be driven now; '' if it may."""
        now = self._clock.steady()
        if self.ros_time.paused_duration > FAULT_DURATION:
            return ROS_TIME_PAUSED
        if (fault := self.find_conflict(PROFILE) or self.publisher_conflict or self.repeat_fault
                or self.faults['clock']):
            return fault
        if not self._recent_rates or now - self.journal.last_received > 1.0:
            return 'no sample comes on imu/data_raw: check the gyro and its driver'
        if self.wheels.is_moving(now):
            return 'odom or cmd_vel shows that the robot moves: stop it, and run again'
        bias, deviation = self.estimator.tracker.bias
        rate = sum(each for _, each in self._recent_rates) / len(self._recent_rates) - bias
        noise = self.store.model.noise.angle_random_walk / math.sqrt(_TURN_CHECK_DURATION)
        if abs(rate) > 4.0 * math.hypot(deviation, noise, self._standstill_rate):
            return (f'the gyro shows a turn at {rate / DEGREE:.2f} deg/s: stop the robot, or, if '
                    'it stands, call calibrate_bias first')
        return ''

    # Periodic calls

    def poll(self, receivers: int) -> None:
        """Check that time and samples advance; to be called several times per second."""
        self.ros_time.poll(self._clock)
        # A drive ends where several publishers exist, before their samples mix.
        conflict = self.find_conflict(self.session.run.kind if self.session.run else '') or (
            self.publisher_conflict if self.session.is_driving else '')
        if self._clock.steady() - self.journal.last_received > RunLimits.max_gap:
            conflict = conflict or self.journal.refusal
        self.session.poll(self.values, receivers,
                          self.ros_time.paused_duration > FAULT_DURATION, conflict)

    def run_periodic_tasks(self, is_final: bool = False) -> None:
        """Update bias table and files; to be called once per second, and at the end."""
        if self._clock.simulated() is None:
            self._update_host_clock()
        # two faults in a row: delayed samples come in a burst, and are late until then
        before = self._suspected_clock_fault
        self._suspected_clock_fault = self.stamp_delay.find_fault()
        self.clock_fault = before and self._suspected_clock_fault
        unknown, tracker = self.stamp_delay.unknown_turn, self.estimator.tracker
        added = unknown ** 2 - self._stamp_turn ** 2
        if added > 0.01 * tracker.variance:  # else the deviation changes by less than 0.5 %
            tracker.add_unknown_turn(math.sqrt(added))
            self._stamp_turn = unknown
        if any(map(self.faults.get, ('clock', 'frame', 'turn', 'alternation'))):
            tracker.add_unknown_turn(math.tau)
        date = self._clock.date()
        if event := self.estimator.update_table(date, is_final):
            self.journal.event = event
        self.store.store_table(date, is_final)
        self.store.poll()

    def reset_heading(self) -> str:
        """Set the heading to zero; return the answer of the service."""
        self.estimator.reset()
        self.repeat_detector.reset_heading()
        self.stamp_delay, self._trusted_heading = self._new_stamp_delay(), (0.0, 0.0)
        if self.conflict or self.repeat_fault:  # turns are not measured now
            self.estimator.set_heading(0.0, math.tau ** 2)
        return 'the heading is zero here and now'
