"""The services of the compensation node: runs of known motion, of rest and of whole turns, and who drives the robot meanwhile."""

from __future__ import annotations

import math
from collections.abc import Callable
from datetime import datetime, timezone
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from geometry_msgs.msg import Twist, TwistStamped
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.task import Future
from std_srvs.srv import Trigger

from gyro_calibration.log import DataRefused
from gyro_calibration.model import SelfCalibration
from gyro_calibration.motion import CALIBRATION, Motion, MotionError, read_motion
from gyro_calibration.ros.calibration_run import ODOMETRY, PROFILE, REST, Rules, Run, calibrated, wanted_after
from gyro_calibration.ros.compensation_report import Rooms
from gyro_calibration.ros.compensation_settings import PARAMETERS, limits, odometry
from gyro_calibration.ros.health_monitor import changed
from gyro_calibration.ros.runner import current
from gyro_calibration.ros.wheels import COMMAND
from gyro_calibration.self_calibration import Limits

#: A robot is driven for so long, s, or so many intervals of the samples after the last one, but not over a gap that refuses the run.
_BLIND, _BLIND_INTERVALS = 0.25, 4.0
#: Somebody must hear the commands within this time, s; until nodes know of each other may take three.
_HEARING = 5.0


class CalibrationServices:
    """
    Calibrate on request.

    Attributes
    ----------
    run : the one that goes on, or None

    """

    def __init__(self, node: Node, rooms: Rooms, show: Callable[[], None], now: Callable[[], float]):
        """Offer the services; `show` publishes the state of the calibration, and `now` returns seconds that nobody sets."""
        self.run: Run | None = None
        self._now = now
        self._node, self._rooms, self._show, self._settings = node, rooms, show, current(node, PARAMETERS)
        self._velocity: Publisher | None = None
        if self._settings.drive_profile:
            self._learn_to_drive()  # where it cannot, calibrate says so
        # A run answers after 20 s. In a group where callbacks may overlap it locks out neither the samples nor a second call.
        group = ReentrantCallbackGroup()
        for name, callback in (('calibrate', self._on_calibrate), ('calibrate_bias', self._on_calibrate_bias),
                               ('finish_calibration', self._on_finish), ('cancel_calibration', self._on_cancel),
                               ('reset_heading', self._on_reset)):
            node.create_service(Trigger, name, callback, callback_group=group)
        # A robot that is driven must not drive on for an hour because somebody set the clock back.
        self._drive_timer = node.create_timer(0.02, self._drive, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._drive_timer.cancel()  # it runs only while the robot is driven, for a wake-up costs as much as a sample
        self._blind = self._is_silent = False
        self._asked = 0.0

    # What the node brings

    def add(self, time: float, output: float, heard: float) -> None:
        """Take a sample into the run that goes on."""
        if not self.run:
            return
        if self._is_unheard:
            self.run.heard = heard
        else:
            live = self._rooms.live
            self.run.add(time, output, float(live.last.modelled), None if live.temperature_is_lost else live.temperature, heard)

    def interrupt(self, reason: str) -> None:
        """Give a run up over which integration began anew."""
        if self.run and self.run.times:
            self.run.answer(f"{reason}: look at the gyro's line and run again")

    def watch(self) -> None:
        """Give up a run that hears nothing, or that may no longer drive the robot."""
        if self.run and self._driving and not current(self._node, PARAMETERS).drive_profile:
            self.run.answer('drive_profile was set to false while the robot was driven: set it to true and run again')
        if self.run and self._is_unheard and self._now() - self._asked > _HEARING:
            kind = 'TwistStamped' if self._settings.cmd_vel_stamped else 'Twist'
            self.run.answer(f'nobody hears cmd_vel as a {kind}: start what moves the robot, remap cmd_vel to its topic, '
                            'or change cmd_vel_stamped')
        # At the second look, for after a pause of this node the samples that wait come after the timers.
        before, self._is_silent = self._is_silent, self.run is not None and self._now() - self.run.heard > self._settings.sample_timeout
        if self.run and self._is_silent and before:
            self.run.answer(f'no sample came for {self._settings.sample_timeout:g} s: look at the gyro and its driver')

    # Runs

    async def _on_calibrate(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        values = current(self._node, PARAMETERS)
        if values.reference == PROFILE:
            try:
                motion = read_motion(Path(values.profile_file).expanduser()) if values.profile_file else CALIBRATION
            except MotionError as error:
                return self._refused(response, f'refused: {error}')
            return await self._calibrate(PROFILE, motion.duration, values, response, motion)
        duration = values.reference_duration if values.reference == ODOMETRY else math.inf
        return await self._calibrate(values.reference, duration, values, response)

    async def _on_calibrate_bias(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        values = current(self._node, PARAMETERS)
        return await self._calibrate(REST, values.bias_duration, values, response)

    async def _calibrate(self, kind: str, duration: float, values: SimpleNamespace, response: Trigger.Response,
                         motion: Motion | None = None) -> Trigger.Response:
        """Collect a run, fit it and use it; or change nothing and say why."""
        if self.run:
            return self._refused(response, 'refused: a calibration is going on already; wait for its end, or call cancel_calibration')
        if self._rooms.memory.problem:
            return self._refused(response, f'refused: {self._rooms.memory.problem}')
        drives = motion is not None and values.drive_profile
        if drives and (forbidden := self._learn_to_drive()):
            return self._refused(response, f'refused: {forbidden}')
        rules = Rules(limits(values), odometry(values), values.turns, values.check_after_run)
        future = Future()
        self.run = run = Run(kind, duration, wanted_after(kind, rules), self._now(), _once(future), motion)
        self._rooms.check.restart()
        if drives:
            self._asked = run.heard
            self._drive_timer.reset()
        self._show()
        message, success = await self._outcome(run, rules, future)
        self.run = None
        self.stop_robot()
        self._show()
        return self._answer(response, message) if success else self._refused(response, message)

    async def _outcome(self, run: Run, rules: Rules, future: Future) -> tuple[str, bool]:
        try:
            reason = await future
            if reason:
                raise DataRefused(reason)
            return self._finish(run, rules), True
        except DataRefused as error:
            return f'refused: {error}', False
        except Exception as error:  # whatever happens, the robot stops, the caller hears of it and the node lives
            return f'failed, and nothing was changed: {error!r}', False

    def _finish(self, run: Run, rules: Rules) -> str:
        """Fit a complete run and use what it gives."""
        live, now = self._rooms.live, datetime.now(timezone.utc)
        calibration, said = calibrated(run, rules, live.model.noise, now.isoformat(timespec='seconds'))
        if run.kind == REST:
            calibration = self._with_scale(calibration)
        different = changed(self._claimed(), calibration, live.model.noise, live.known_for(now.timestamp()))
        trouble = self._rooms.memory.keep(calibration)
        live.use(self._rooms.memory.model, now.timestamp())
        self._rooms.check.recalibrated()
        return '; '.join(filter(None, [f'{calibration}, from {len(run.times)} samples', said, different, trouble]))

    def _with_scale(self, calibration: SelfCalibration) -> SelfCalibration:
        """Return a calibration of the bias with the scale that is in use; without a self-calibration the model knows how well."""
        used = self._rooms.live.used.self_calibration
        last = self._rooms.live.model.self_calibration or used or SelfCalibration(covariance=((0.0, 0.0), (0.0, 0.0)))
        of_scale = (last.covariance or (used and used.covariance) or ((0.0, 0.0), (0.0, 0.0)))[0][0]
        assert calibration.covariance is not None
        covariance = ((of_scale, 0.0), (0.0, calibration.covariance[1][1]))
        return SelfCalibration(last.scale_factor_error, calibration.bias, covariance, calibration.time, calibration.temperature, 'rest')

    def _claimed(self) -> SelfCalibration:
        """Return what was claimed so far; without a calibration the model claims a bias of zero, as well as it knows that."""
        return self._rooms.live.claimed

    # Answers

    def _answer(self, response: Trigger.Response, message: str) -> Trigger.Response:
        response.success, response.message = True, message
        self._rooms.journal.event = message
        self._node.get_logger().info(message)
        return response

    def _refused(self, response: Trigger.Response, message: str) -> Trigger.Response:
        response.success, response.message = False, message
        self._rooms.journal.event = message
        self._rooms.journal.refuse(message)
        self._node.get_logger().warning(message)
        return response

    def _on_finish(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        run = self.run if self.run and self.run.has_button else None
        if run and run.times:
            return self._answer(response, run.finish())
        response.success, response.message = False, 'refused: no calibration by turns or by odometry is going on'
        if run:
            response.message = 'refused: no sample has come since the calibration began: look at the gyro and its driver'
        return response

    def _on_cancel(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if not self.run:
            response.success, response.message = False, 'refused: no calibration is going on'
            return response
        self.stop_robot()
        if not self.run.answer('cancelled'):
            response.success, response.message = False, 'refused: the calibration has just ended; its own answer says whether it is in use'
            return response
        return self._answer(response, 'cancelled; the calibration in use is the old one')

    def _on_reset(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._rooms.live.reset()
        return self._answer(response, 'the heading is zero here and now')

    # Who drives

    def _learn_to_drive(self) -> str:
        """
        Become a publisher of `cmd_vel`, which the node is not where `drive_profile` never allowed it.

        Returns
        -------
        str
            Why it cannot be one, or ''.

        """
        if self._velocity is None:
            kind = TwistStamped if self._settings.cmd_vel_stamped else Twist
            try:
                self._velocity = self._node.create_publisher(kind, 'cmd_vel', 10)
            except RuntimeError as error:  # the policy of a secured graph may forbid it
                reason = str(error).partition(',')[0]  # then come places in the source of others
                return f'this node may not publish cmd_vel ({reason}): allow it in the policy, or set drive_profile to false'
        return ''

    @property
    def _driving(self) -> bool:
        return not self._drive_timer.is_canceled()

    @property
    def _is_unheard(self) -> bool:
        """Tell whether a run that drives the robot has yet to wait for somebody who hears its commands, other than this node."""
        if not self._driving or not self.run or self.run.times:
            return False
        assert self._velocity is not None  # nobody drives before `_learn_to_drive`
        return self._velocity.get_subscription_count() <= (self._settings.wheels in ('cmd_vel', 'both'))

    def _drive(self) -> None:
        """Command what the profile wants now; the robot moves only while samples come."""
        if not self.run or not self.run.motion or not self.run.times:
            return
        silent = self._now() - self.run.heard
        before, self._blind = self._blind, silent > self._blind_limit
        if self._blind and before:  # at the second look, as in `watch`
            self.run.answer(f'no sample came for {silent:.2f} s while the robot was driven: look at the gyro and its driver')
        self._command(0.0 if self._blind else float(self.run.motion.rate_at(np.array(self.run.elapsed + silent))))

    @property
    def _blind_limit(self) -> float:
        return min(max(_BLIND, _BLIND_INTERVALS * self._rooms.live.tracker.intervals.usual), Limits.gap)

    def _command(self, rate: float) -> None:
        message = TwistStamped() if self._settings.cmd_vel_stamped else Twist()
        twist = message
        if self._settings.cmd_vel_stamped:
            message.header.stamp, twist = self._node.get_clock().now().to_msg(), message.twist
        twist.angular.z = rate
        self._rooms.wheels.hear(COMMAND, twist, self._now())
        assert self._velocity is not None  # nobody drives before `_learn_to_drive`
        self._velocity.publish(message)

    def stop_robot(self) -> None:
        """Stop the robot, if it is being driven."""
        if self._driving:
            self._drive_timer.cancel()
            self._command(0.0)

    def close(self) -> None:
        """Stop the robot, and wait until it has heard of that."""
        if self._driving:
            self.stop_robot()
            assert self._velocity is not None
            self._velocity.wait_for_all_acked(Duration(seconds=1.0))


def _once(future: Future) -> Callable[[str], bool]:
    """Return what lets the service go on to its answer, once."""
    def answer(reason: str) -> bool:
        first = not future.done()
        if first:
            future.set_result(reason)
        return first
    return answer
