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
Calibration runs on a robot, without rclpy: data collection, drive, guards and fit.

All guards of a drive use the steady clock, not ROS time. A run ends with
`CalibrationRun.end_reason` set ('' where its samples are complete); `CalibrationSession.conclude`
then fits it. Own commands come back on `cmd_vel` in the order of sending; every other command is
foreign, of another node, also an additional zero.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from datetime import datetime, timezone
import math
import os
from pathlib import Path
from types import SimpleNamespace

from gyro_calibration.calibration.selection import TECHNOLOGY_PRIORS
from gyro_calibration.calibration.self_calibration import (
    calibrate_bias, check_rest, describe_commanded_headings, describe_implausible_scale,
    find_rest_after, ReferenceErrors, RunLimits, self_calibrate, SETTLING_TIME, to_model_record)
from gyro_calibration.calibration.whole_turns import calibrate_turns
from gyro_calibration.heading.heading_estimator import HeadingEstimator
from gyro_calibration.logs.log import Array, DataRefused, DEGREE
from gyro_calibration.model.gyro_model import SelfCalibration
from gyro_calibration.model.motion import (
    CALIBRATION_MOTION, Motion, motion_from_headings, motion_from_rates, MotionError, read_motion)
from gyro_calibration.model.noise import Noise
from gyro_calibration.ros.health_monitor import HealthMonitor
from gyro_calibration.ros.inputs import (
    Clock, FAULT_DURATION, MAX_ANGULAR_ACCELERATION, node_time, StampDelay, Velocity)
from gyro_calibration.ros.state_store import StateStore
import numpy as np

PROFILE, ODOMETRY, TURNS, REST = 'profile', 'odometry', 'turns', 'rest'
FINISH_TIMEOUT = 600.0  # s; longest duration of a run that waits for `finish`
MIN_ODOMETRY_DURATION = 5.0  # s; of a run by odometry, whose first and last second are not fitted
#: Longest time without a sample, and without a node that receives the commands, s; discovery may
#: take 3 s.
SAMPLE_TIMEOUT = 5.0
_STOPPING_DURATION = 1.5  # s; longest turn after the last command: latency and deceleration
#: Least change of the odometry heading that shows a turn, rad: beyond the slack of wheels at rest.
MIN_TURN_ANGLE = 1.0 * DEGREE
_MAX_NODE_PAUSE = 1.0  # s; after a longer one in a drive the base has stopped, or turned on

ROS_TIME_PAUSED = ('ROS time stands still: start or resume the simulation that publishes /clock, '
                   'or set use_sim_time to false')
_NO_RECEIVER = ('no other node receives cmd_vel: start what moves the robot, remap cmd_vel to its '
                'topic, or change cmd_vel_stamped')


@dataclass
class CalibrationRun:
    kind: str  # PROFILE, ODOMETRY, TURNS or REST
    duration: float  # of the compared motion, s; inf until `finish`
    last_received: float  # time of the last sample, or of the request, s of the steady clock
    motion: Motion | None = None  # the profile
    limits: RunLimits = RunLimits()
    reference_errors: ReferenceErrors = ReferenceErrors()  # of odometry
    turns: int = 0  # whole turns; with 0 the gyro determines their number
    end_reason: str | None = None  # reason of the end; '' where the samples are complete
    times: list[float] = field(default_factory=list)  # stamps, s
    outputs: list[float] = field(default_factory=list)  # rad/s
    rates: list[float] = field(default_factory=list)  # after the model, rad/s
    temperatures: list[float] = field(default_factory=list)  # degC
    #: Stamp, s, heading, rad, and rate, rad/s, of each odometry message.
    odometry: list[tuple[float, float, float]] = field(default_factory=list)

    def add(self, time: float, output: float, rate: float, temperature: float | None) -> None:
        self.times.append(time)
        self.outputs.append(output)
        self.rates.append(rate)
        self.temperatures += [] if temperature is None else [temperature]

    @property
    def due_end_reason(self) -> str | None:
        """Return '' if the samples are complete, the reason of a time-out, or None."""
        if self.elapsed < self.max_duration:
            return None
        return '' if math.isfinite(self.duration) else (
            f'finish_calibration was not called within {FINISH_TIMEOUT:g} s: call it when the '
            'robot stands on the mark again')

    @property
    def elapsed(self) -> float:
        """Return the time from the first sample to the last, s."""
        return self.times[-1] - self.times[0] if self.times else 0.0

    @property
    def max_duration(self) -> float:
        """Return the longest duration of the run, s; after the motion the robot rests."""
        if math.isinf(self.duration):
            return FINISH_TIMEOUT
        return self.duration + {REST: 0.0, TURNS: 2.5}.get(
            self.kind, self.limits.max_time_offset + SETTLING_TIME + self.limits.rest_duration)

    @property
    def status(self) -> str:
        return (f'{self.elapsed:.0f} of {self.max_duration:.0f} s' if math.isfinite(self.duration)
                else f'{self.elapsed:.0f} s; rest, turn, rest on the mark and call '
                'finish_calibration')


class Drive:
    """The commands of a run that drives the robot, and its guards."""

    INTERVAL = 0.02  # time between commands, s

    def __init__(self, run: CalibrationRun, motion: Motion, clock: Clock):
        self._run, self._motion, self._clock = run, motion, clock
        self._start_time = self._last_poll = clock.steady()
        self._has_receiver = self._had_callers = self._lost_callers = False
        self._next_command_time = -math.inf
        self._stamp_delay = StampDelay(clock, 2.0, (0.5, FAULT_DURATION))
        self.command_lateness = self.sample_lateness = 0.0  # largest ones, s

    def add_sample(self, time: float) -> None:
        self.sample_lateness = max(self.sample_lateness, self._stamp_delay.add(time))

    def is_waiting(self, receivers: int) -> bool:
        """Tell whether the run still waits for a node that receives its commands."""
        self._has_receiver = self._has_receiver or receivers > 0
        return not self._has_receiver

    def find_fault(self, receivers: int, is_ros_time_paused: bool) -> str:
        """Return why the run must end; '' if it continues."""
        now = self._clock.steady()
        pause, self._last_poll = now - self._last_poll, now
        if self.is_waiting(receivers):
            return _NO_RECEIVER if now - self._start_time > SAMPLE_TIMEOUT else ''
        if not receivers:
            return _NO_RECEIVER
        if is_ros_time_paused:
            return ROS_TIME_PAUSED
        if pause > _MAX_NODE_PAUSE:
            return (f'this computer was busy: the node was held up for {pause:.1f} s while it '
                    'drove the robot; reduce its load and run again')
        return self._stamp_delay.find_fault()

    def is_abandoned(self, callers: int) -> bool:
        """Tell whether the service has lost its callers at two polls in a row."""
        self._had_callers = self._had_callers or callers > 0
        before, self._lost_callers = self._lost_callers, self._had_callers and not callers
        return before and self._lost_callers

    def next_command(self, is_silent: bool) -> float | None:
        """Return the rate to command now, rad/s, 0 in a silence; None if no command is due."""
        now = node_time(self._clock)
        left = self._next_command_time - now  # more than an interval if ROS time has jumped back
        if 0.5 * self.INTERVAL < left <= 1.5 * self.INTERVAL:
            return None
        if self._next_command_time > -math.inf:
            self.command_lateness = max(self.command_lateness, now - self._next_command_time)
        self._next_command_time = now + self.INTERVAL
        # After a pause of this process, queued samples may be delivered before the next poll.
        held_up = self._clock.steady() - self._last_poll > _MAX_NODE_PAUSE
        if is_silent or held_up or not self._run.times:
            return 0.0
        # By the stamps, but delayed samples do not delay the motion.
        elapsed = max(now - self._stamp_delay.min_delay - self._run.times[0], self._run.elapsed)
        return float(self._motion.rate_at(np.array(elapsed)))

    def describe_lateness(self, limits: RunLimits) -> str:
        """Return a sentence where commands or samples were late beyond the residual limit."""
        late = max(self.command_lateness, self.sample_lateness)
        if late * _max_rate(self._motion) <= limits.max_stretch_residual:
            return ''
        return (f'this computer was busy: commands were up to {self.command_lateness:.2f} s late '
                f'and samples up to {self.sample_lateness:.2f} s; reduce its load and run again')


def read_profile(file: str) -> Motion:
    """Return the motion of a profile, the built-in one for ''; raise `MotionError`."""
    return read_motion(Path(os.path.expanduser(file))) if file else CALIBRATION_MOTION


def _max_rate(motion: Motion) -> float:
    return float(np.abs(motion.rate_at(motion.time)).max())


class CalibrationSession:
    """Calibrations on request; `run` is the one in progress, or None."""

    def __init__(self, estimator: HeadingEstimator, store: StateStore, monitor: HealthMonitor,
                 send: Callable[[float], None], clock: Clock):
        """Start without a run; `send` publishes a rate about z on cmd_vel, rad/s."""
        self.run: CalibrationRun | None = None
        # that the robot kept turning after a drive; lateness in it of commands and samples, s
        self.warning, self.max_lateness = '', (0.0, 0.0)
        self._estimator, self._store, self._monitor = estimator, store, monitor
        self._send, self._clock = send, clock
        self._drive: Drive | None = None
        self._pending_commands: deque[float] = deque(maxlen=256)  # own, that have not come back
        self._last_foreign_command = self._stop_time = self._stop_repeat_end = -math.inf
        self._start_time, self._is_silent = 0.0, False

    @property
    def is_driving(self) -> bool:
        return self._drive is not None

    # Start

    def begin(self, kind: str, values: SimpleNamespace, obstacle: str = '') -> str:
        """Begin a run; return '', or why it is refused."""
        if self.run:
            return 'a calibration is in progress; wait for its end, or call cancel_calibration'
        if self._store.problem:
            return self._store.problem
        if kind in (ODOMETRY, TURNS) and values.calibration_drive:
            return (f'calibration.drive drives the profile, not a calibration by {kind}: set '
                    'calibration.reference to profile, or calibration.drive to false')
        motion, drives = None, kind == PROFILE and values.calibration_drive
        duration = {ODOMETRY: values.calibration_duration, REST: 15.0}.get(kind, math.inf)
        if kind == PROFILE:
            try:
                motion = read_profile(values.calibration_profile_file)
            except MotionError as error:
                return str(error)
            duration = motion.duration
            # less than any gyro's limit; one in deg/s that was taken for rad/s is faster
            fastest, limit = _max_rate(motion), _STOPPING_DURATION * MAX_ANGULAR_ACCELERATION
            if drives and fastest > limit:
                return (f'the profile turns at {fastest / DEGREE:.0f} deg/s, faster than '
                        f'{limit / DEGREE:.0f} deg/s, from which a robot stops in '
                        f'{_STOPPING_DURATION:g} s: correct calibration.profile_file')
        if obstacle:
            return obstacle
        now = self._clock.steady()
        if drives and now - self._last_foreign_command < 1.0:
            return 'another node sends commands on cmd_vel: stop it, and run again'
        self._start_time, self._is_silent, self.warning = node_time(self._clock), False, ''
        self.run = CalibrationRun(
            kind, duration, now, motion, RunLimits(max_bias=values.calibration_maximum_bias),
            ReferenceErrors(scale_deviation=values.calibration_odometry_scale_deviation),
            values.calibration_turns)
        self._drive = Drive(self.run, motion, self._clock) if motion and drives else None
        self._monitor.restart()
        return ''

    # Inputs

    def add(self, time: float, output: float, receivers: int) -> None:
        """Add a sample; `receivers` is the number of other nodes that receive the commands."""
        run = self.run
        if run is None or run.end_reason is not None:
            return
        run.last_received = self._clock.steady()
        if self._drive:
            self._drive.add_sample(time)
            if self._drive.is_waiting(receivers):
                return
        estimator = self._estimator
        run.add(time, output, float(estimator.last_compensated.model_rate),
                None if estimator.is_temperature_lost else estimator.temperature)
        if (reason := run.due_end_reason) is not None:
            self.end(reason)
        self._command_if_due()

    def add_odometry(self, time: float, heading: float, rate: float) -> None:
        if self.run:
            self.run.odometry.append((time, heading, rate))
        since = self._clock.steady() - self._stop_time
        alone = self._last_foreign_command < self._stop_time and not self._drive
        if (alone and _STOPPING_DURATION < since < 2.0 * _STOPPING_DURATION
                and abs(rate) > 1.0 * DEGREE):
            self.warning = (f'odom shows a turn at {rate / DEGREE:.0f} deg/s {since:.1f} s after '
                            'the command to stop: set the command time-out of the base, and check '
                            'for other nodes that command it')

    def add_command(self, velocity: Velocity) -> None:
        """Add a command from cmd_vel; a foreign one ends a drive."""
        for place, rate in enumerate(self._pending_commands):
            if velocity == Velocity(angular=(0.0, 0.0, rate)):
                for _ in range(place + 1):
                    self._pending_commands.popleft()
                return
        self._last_foreign_command = self._clock.steady()
        if self._drive or self.run and self.run.kind == REST and velocity.is_moving:
            self.end('another node sent a command on cmd_vel during the run, and controls the '
                     'robot now: stop that node and run again')
        self._stop_repeat_end = -math.inf

    # Guards

    def poll(self, values: SimpleNamespace, receivers: int, is_ros_time_paused: bool = False,
             conflict: str = '') -> None:
        """
        Send the next command of a drive, or end a run by its guards or a conflict, if not ''.

        To be called every `Drive.INTERVAL` while `is_driving`, else a few times per second.
        """
        run, drive, now = self.run, self._drive, self._clock.steady()
        if now < self._stop_repeat_end and not drive:
            self._command(0.0)
        if run is None or run.end_reason is not None:
            return
        reason, timeout, is_driven = conflict, SAMPLE_TIMEOUT, False
        if drive:
            reason = reason or drive.find_fault(receivers, is_ros_time_paused)
            if not values.calibration_drive:
                reason = ('calibration.drive was set to false while the robot was driven: set it '
                          'to true and run again')
            if not drive.is_waiting(receivers):
                usual = self._estimator.tracker.intervals.usual_interval
                timeout = min(max(FAULT_DURATION, 4.0 * usual), run.limits.max_gap)
                is_driven = True
        # at the second poll: after a pause of this process, queued samples come after its timers
        silence = now - run.last_received
        before, self._is_silent = self._is_silent, silence > timeout
        if before and self._is_silent:
            lasted = (f'{silence:.2f} s while the robot was driven' if is_driven
                      else f'{timeout:g} s')
            reason = reason or f'no sample came for {lasted}: check the gyro and its driver'
        if node_time(self._clock) - self._start_time > 2.0 * run.max_duration + SAMPLE_TIMEOUT:
            reason = reason or ('the stamps on imu/data_raw advance too slowly: check the clock '
                                'of the driver, and use_sim_time')
        if reason:
            self.end(reason)
        self._command_if_due()

    def update_callers(self, count: int) -> None:
        """End a drive without clients of the service; called a few times per second."""
        if self._drive and self._drive.is_abandoned(count):
            self.end('the program that called calibrate has ended before the answer: keep it '
                     'running until the answer')

    def interrupt(self, reason: str) -> None:
        """End a run in which the integration was restarted."""
        if self.run and self.run.times:
            self.end(f'{reason}: check gyro, driver and clock, and run again')

    def _command_if_due(self) -> None:
        """Send the next command if it is due, at samples and polls: simulations may be fast."""
        if (self._drive and self.run and self.run.end_reason is None
                and (rate := self._drive.next_command(self._is_silent)) is not None):
            self._command(rate)

    def _command(self, rate: float) -> None:
        self._pending_commands.append(rate)
        self._send(rate)

    # End

    def end(self, reason: str) -> None:
        """End the run and stop the robot; the reason is '' if its samples are complete."""
        if self.run and self.run.end_reason is None:
            self.run.end_reason = reason
            if self._drive:
                self._command(0.0)
                self._stop_time = self._clock.steady()
                if reason:  # zero is repeated for 1 s, since the link to the base may lose some
                    self._stop_repeat_end = self._stop_time + 1.0

    def finish(self) -> tuple[bool, str]:
        """End the motion now; return the remaining instruction for the user, or why not."""
        run = self.run
        if run is None or run.kind not in (ODOMETRY, TURNS):
            return False, 'no calibration by turns or by odometry is in progress'
        if not run.times:
            return False, 'no sample has come so far: check the gyro and its driver'
        if run.kind == ODOMETRY and run.elapsed < MIN_ODOMETRY_DURATION:
            return False, (f'the run lasts {run.elapsed:.1f} s so far, and one by odometry '
                           f'{MIN_ODOMETRY_DURATION:g} s at least: turn both ways, and call again')
        run.duration = min(run.duration, run.elapsed)
        return True, f'leave the robot at rest for {run.max_duration - run.elapsed:.1f} s more'

    def cancel(self) -> tuple[bool, str]:
        if self.run is None:
            return False, 'no calibration is in progress'
        if self.run.end_reason is not None:
            return False, 'the calibration has just ended; its answer states whether it is in use'
        self.end('cancelled')
        return True, 'cancelled; the previous calibration is in use'

    def conclude(self) -> tuple[bool, str]:
        """Fit a finished run and use its calibration, or return why nothing was changed."""
        run, drive, estimator = self.run, self._drive, self._estimator
        assert run is not None and run.end_reason is not None
        try:
            if run.end_reason:
                raise DataRefused(run.end_reason)
            now = datetime.fromtimestamp(self._clock.date(), timezone.utc)
            calibration, remark = fit_run(run, estimator.model.noise,
                                          now.isoformat(timespec='seconds'),
                                          estimator.model.prior_deviations)
            if run.kind == REST:  # the scale factor error in use is kept
                used = estimator.current_model.self_calibration
                unknown = SelfCalibration(covariance=((0.0, 0.0), (0.0, 0.0)))
                last = estimator.model.self_calibration or used or unknown
                known = last.covariance or used and used.covariance or unknown.covariance
                assert known is not None and calibration.covariance is not None
                calibration = replace(
                    calibration, scale_factor_error=last.scale_factor_error,
                    covariance=((known[0][0], 0.0), (0.0, calibration.covariance[1][1])))
                rest = self._monitor.last_rest
                if rest and self._monitor.bias_alarm:
                    remark = (f'by the bias until now the rate was {rest.bias / DEGREE:.2f} deg/s,'
                              f' {rest.sigmas:.0f} sigma from rest: if the robot turned evenly, '
                              'let it stand and run again')
            trouble = self._store.store_calibration(calibration)
            estimator.use_calibration(self._store.model, now.timestamp())
            self._monitor.reset_biases()
            return True, '; '.join(filter(None, [
                f'{calibration}, from {len(run.times)} samples', remark, trouble]))
        except DataRefused as error:
            cause = drive.describe_lateness(run.limits) if drive and not run.end_reason else ''
            return False, f'{error}; besides, {cause}' if cause else str(error)
        except Exception as error:  # the robot stands; answer the caller and continue
            return False, f'the fit failed and nothing was changed: {error!r}'
        finally:
            if drive:
                self.max_lateness = drive.command_lateness, drive.sample_lateness
            self.run = self._drive = None


def _refuse_turn_at_rest(run: CalibrationRun) -> None:
    if len(run.odometry) < 2:
        return
    at, headings, rates = np.array(run.odometry).T
    turned = max(float(np.mean(rates) * np.ptp(at)),
                 float(np.unwrap(headings)[-1] - headings[0]), key=abs)
    if abs(turned) > MIN_TURN_ANGLE:
        raise DataRefused(f'odom shows a turn by {turned / DEGREE:.1f} deg in {run.elapsed:.0f} s '
                          'of rest: keep the robot still, or remap odom to an odometry of the '
                          'wheels')


def _find_motion(run: CalibrationRun) -> tuple[float, Motion]:
    """Return the begin of the motion by odometry, s, and the motion from then on."""
    last = run.times[0] + run.duration
    rows = np.array([each for each in run.odometry if each[0] <= last])
    if len(rows) < 10:
        raise DataRefused(f'{len(rows)} messages with an orientation and a rate came on odom in '
                          f'{run.duration:.0f} s, of 10 at least: check the topic, its '
                          'quaternions of length 1, and its twist')
    at, headings, rates = rows.T
    if not (np.diff(at) > 0.0).all():
        raise DataRefused('the stamps on odom do not increase: check that one node publishes it')
    if (covered := float(np.ptp(at))) < 0.8 * run.duration:
        raise DataRefused(f'{len(rows)} messages came on odom, but in {covered:.0f} s of '
                          f'{run.duration:.0f} s only: check that it does not stop')
    headings = np.unwrap(headings)
    motion = (motion_from_headings(at, headings) if np.ptp(headings) > MIN_TURN_ANGLE
              else motion_from_rates(at - at[0], rates))
    return float(at[0]), replace(motion, name='odometry')


def fit_run(run: CalibrationRun, noise: Noise, date: str,
            prior: Array | None = None) -> tuple[SelfCalibration, str]:
    """Return the calibration by a run, and a remark; raise `DataRefused` as its methods do."""
    # the prior is that of a fleet model, for runs against a motion
    time, rate, output = (np.array(each) for each in (run.times, run.rates, run.outputs))
    limits = run.limits
    temperature = float(np.mean(run.temperatures)) if run.temperatures else None
    if run.kind == REST:
        if not output.any():
            raise DataRefused('the gyro reports zero only: it is dead, or sets its output to zero '
                              'at rest and shows no bias; turn the robot to find out')
        bias, deviation = calibrate_bias(time - time[0], rate, limits, noise, output)
        _refuse_turn_at_rest(run)
        return SelfCalibration(0.0, bias, ((0.0, 0.0), (0.0, deviation ** 2)), date, temperature,
                               'rest'), ''
    if run.kind == TURNS:
        found = calibrate_turns(time - time[0], rate, run.turns or None, limits, noise,
                                output=output)
        return (to_model_record(found.fit, 'turns', date, temperature),
                f'{abs(found.turns)} whole turns in {found.duration:.1f} s')
    by_odometry = run.motion is None
    begin, motion = _find_motion(run) if run.motion is None else (time[0], run.motion)
    time = time - begin
    # before and after a profile the robot rests, but odometry may begin or end in a turn
    around = limits.max_time_offset * (-1.0 if by_odometry else 1.0)
    inside = (time >= -around) & (time <= motion.duration + around)
    if not inside.any():
        raise DataRefused('no sample has a stamp between those of odom')
    fit = self_calibrate(time[inside], rate[inside], motion, limits=limits, noise=noise,
                         reference=run.reference_errors if by_odometry else None,
                         output=output[inside], prior=prior)
    remarks = [f'delay of the gyro {fit.time_offset:.3f} +- {fit.time_offset_deviation:.3f} s']
    if fit.goodness:
        remarks.append(str(fit.goodness))
    remarks += filter(None, [
        describe_commanded_headings(motion),
        describe_implausible_scale(fit, TECHNOLOGY_PRIORS['mems'][0], motion.name)])
    # After odometry the robot may drive on; a profile ends at rest.
    after = (find_rest_after(time, rate, fit, motion, limits) if by_odometry
             else time > motion.duration + max(fit.time_offset, 0.0) + SETTLING_TIME)
    if after is not None:
        rest = check_rest(time[after], rate[after], fit, noise, limits)
        fit = rest.fit
        remarks.append(f'at rest after it the rate was {rest.rate / DEGREE:.4f} deg/s, limit '
                       f'{rest.limit / DEGREE:.4f} deg/s')
    method = 'odometry' if by_odometry else 'likelihood'
    return to_model_record(fit, method, date, temperature), '; '.join(remarks)
