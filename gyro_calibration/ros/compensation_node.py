"""
From raw to corrected rates, and from those to the heading, on a robot.

Joins the rooms to topics: ``imu/data_raw``, ``imu/temperature``, and what is known of the wheels, to `live_heading`; that to ``imu/data``,
``yaw_rate``, ``heading`` and ``heading_with_covariance``. Calibrations are in `calibration_services`, diagnostics in
`compensation_report`, files in `memory`.

"""

from __future__ import annotations

import math
import os
import sys
import time as clock
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseWithCovarianceStamped, Twist, TwistStamped
from nav_msgs.msg import Odometry
from rclpy.clock import ROSClock
from rclpy.node import Node, PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.subscription import Subscription
from sensor_msgs.msg import Imu, Temperature
from std_msgs.msg import Bool, Float64, Header

from gyro_calibration.bias_table import Prior
from gyro_calibration.driver.host_clock import Stamps, both, steady
from gyro_calibration.heading_estimator import HeadingEstimator
from gyro_calibration.ros.calibration_run import REST
from gyro_calibration.ros.calibration_services import CalibrationServices
from gyro_calibration.ros.compensation_report import Journal, Rooms, state, trouble, values
from gyro_calibration.ros.compensation_settings import PARAMETERS, assumptions, standing_wheels, tracking_settings
from gyro_calibration.ros.diagnostics import Diagnostics, Report
from gyro_calibration.ros.health_monitor import Check
from gyro_calibration.ros.runner import (
    LATCHED_QUALITY,
    NOT_REPORTED,
    SENSOR_QUALITY,
    UNMEASURED_VARIANCE,
    call_every,
    current,
    declare,
    run,
)
from gyro_calibration.ros.state_store import Memory
from gyro_calibration.ros.wheels import COMMAND, ODOMETRY, Wheels

# By default rclpy watches each topic for partners whose quality does not fit, and asks at every wake-up, which at 1 kHz costs 2 % of a
# core a topic. Every quality fits a subscription that asks for the least, and a publisher that offers the most.
_UNWATCHED_SUBSCRIPTION = SubscriptionEventCallbacks(use_default_callbacks=False)
_UNWATCHED_PUBLISHER = PublisherEventCallbacks(use_default_callbacks=False)

_Message = TypeVar('_Message')

#: Samples that are used before services, timers and other topics have their turn.
_MOST_AT_ONCE = 100
#: A gyro that was silent for so long, s, may have been without power, and turned on with another bias.
SILENT = 10.0


class CompensationNode(Node):
    """Publish corrected rates and the heading, and calibrate on request."""

    def __init__(self) -> None:
        """Read the model and the last calibration; what is wrong with them is reported, and raw rates are published meanwhile."""
        super().__init__('compensation_node')
        settings = self._settings = declare(self, PARAMETERS)
        calibration = Path(settings.calibration_file or self._default_path()).expanduser()
        bias_file = Path(settings.bias_file or calibration.with_name(f'{calibration.stem}_biases.yaml')).expanduser()
        memory = Memory(settings.model_file, calibration, bias_file, Prior(coefficient=settings.bias_temperature_coefficient))
        if memory.problem:
            self.get_logger().error(memory.problem)
        self._tracking = tracking_settings(settings, memory.model.noise)
        live = HeadingEstimator(memory.model, memory.table, assumptions(settings), self._tracking,
                                settings.temperature_timeout, clock.time())
        check = Check(memory.model.noise, settings.check_false_alarms, self._tracking.threshold.rate)
        self._rooms = Rooms(live, memory, check, Wheels(standing_wheels(settings)), Journal(self._now()))
        self._epoch: int | None = None
        self._stamps = Stamps()
        self._last_time, self._interval, self._offset = -math.inf, math.inf, round(1e9 * memory.model.true_time(0.0))
        self._make_messages()
        self._connect()
        self._calibrations = CalibrationServices(self, self._rooms, self._show_state, self._now)
        self._show_state()

    def _default_path(self) -> Path:
        home = os.environ.get('ROS_HOME', '~/.ros')
        return Path(home) / 'gyro_calibration' / f'{self.get_fully_qualified_name().strip("/").replace("/", "_")}.yaml'

    def _connect(self) -> None:
        self._imu = self.create_publisher(Imu, 'imu/data', SENSOR_QUALITY)
        self._yaw_rate = self.create_publisher(Float64, 'yaw_rate', SENSOR_QUALITY)
        self._yaw = self.create_publisher(Float64, 'heading', SENSOR_QUALITY)
        self._pose = self.create_publisher(PoseWithCovarianceStamped, 'heading_with_covariance', SENSOR_QUALITY)
        self._status = self.create_publisher(DiagnosticStatus, 'calibration_status', LATCHED_QUALITY, event_callbacks=_UNWATCHED_PUBLISHER)
        self._calibrated = self.create_publisher(Bool, 'calibrated', LATCHED_QUALITY, event_callbacks=_UNWATCHED_PUBLISHER)
        self._samples = self._listen(Imu, 'imu/data_raw', self._on_imu)
        self._temperatures = self._listen(Temperature, 'imu/temperature', self._on_temperature)
        self._hears_odometry = False
        if self._settings.wheels in ('odom', 'both'):
            self._hear_odometry()
        if self._settings.wheels in ('cmd_vel', 'both'):
            self._listen(TwistStamped if self._settings.cmd_vel_stamped else Twist, 'cmd_vel', self._on_command)
        self._diagnostics = Diagnostics(self, 'heading', self._report)
        call_every(self, 0.2, self._watch)
        call_every(self, 1.0, self._learn)

    def _listen(self, message_type: type[_Message], topic: str, callback: Callable[[_Message], None]) -> Subscription:
        return self.create_subscription(message_type, topic, callback, SENSOR_QUALITY, event_callbacks=_UNWATCHED_SUBSCRIPTION)

    def _hear_odometry(self) -> None:
        if not self._hears_odometry:
            self._hears_odometry = True
            self._listen(Odometry, 'odom', self._on_odometry)

    def _make_messages(self) -> None:
        """Make the messages once; only their values change from sample to sample."""
        self._imu_message, self._rate_message, self._heading_message = Imu(), Float64(), Float64()
        self._imu_message.linear_acceleration_covariance[0] = NOT_REPORTED
        self._pose_message, self._pose_wanted = PoseWithCovarianceStamped(), False
        for place in range(5):
            self._pose_message.pose.covariance[7 * place] = UNMEASURED_VARIANCE

    # Samples

    def _now(self) -> float:
        """Return seconds that nobody sets, or those of a simulation."""
        return self.get_clock().now().nanoseconds * 1e-9 if self._simulated else steady()

    @property
    def _simulated(self) -> bool:
        own = self.get_clock()
        return isinstance(own, ROSClock) and own.ros_time_is_active

    def _since_epoch(self, header: Header) -> float:
        """Return a stamp in s since the first one's second, where a double still resolves nanoseconds."""
        stamp = header.stamp
        if self._epoch is None:
            self._epoch = stamp.sec
        return stamp.sec - self._epoch + 1e-9 * stamp.nanosec

    def _time(self, header: Header) -> float:
        """Return the time of what came beside the samples, s."""
        since = self._since_epoch(header)
        return since if self._last_time == -math.inf else self._stamps.of_other(since, self._last_time)

    def _time_of_sample(self, header: Header) -> float:
        """Return the time of a sample, s; where somebody set the clock of this host, its times go on all the same."""
        if self._simulated:
            return self._since_epoch(header)
        self._see_clock()
        return self._stamps.of_sample(self._since_epoch(header), self._last_time, self._interval)

    def _see_clock(self) -> None:
        """Look whether somebody set the clock of this host, and take dates that the old one gave for those of the new one."""
        read, rooms = both(), self._rooms
        if not read or not (step := self._stamps.watch(*read)):
            return
        rooms.journal.event = f'the clock of this computer was set by {step:+.1f} s; the heading goes on'
        rooms.journal.clock_set = f'{self._stamps.steps} time{"s" * (self._stamps.steps > 1)}, last by {step:+.1f} s'
        rooms.live.clock_was_set(step)
        if rooms.memory.written is not None:
            rooms.memory.written += step
        if rooms.live.calibrated_now and rooms.live.model.self_calibration:
            rooms.memory.keep(rooms.live.model.self_calibration)

    def _on_temperature(self, message: Temperature) -> None:
        if math.isfinite(message.temperature):
            self._rooms.live.hear_temperature(self._time(message.header), message.temperature)

    def _on_odometry(self, message: Odometry) -> None:
        if self._settings.wheels in ('odom', 'both'):
            self._rooms.wheels.hear(ODOMETRY, message.twist.twist, self._now())
        if self._calibrations.run:
            turned = message.pose.pose.orientation
            heading = math.atan2(2.0 * (turned.w * turned.z + turned.x * turned.y), 1.0 - 2.0 * (turned.y ** 2 + turned.z ** 2))
            self._calibrations.run.odometry.append((self._time(message.header), heading, message.twist.twist.angular.z))

    def _on_command(self, message: Twist | TwistStamped) -> None:
        self._rooms.wheels.hear(COMMAND, message.twist if isinstance(message, TwistStamped) else message, self._now())

    def _on_imu(self, message: Imu) -> None:
        """Use a sample, and at once those that wait behind it: a round of the executor takes longer than a sample does."""
        self._use(message)
        for _ in range(_MOST_AT_ONCE):
            if not (taken := self._samples.handle.take_message(Imu, False)):
                return
            # a driver sends the temperature first, and a sample shall not overtake its own
            if temperature := self._temperatures.handle.take_message(Temperature, False):
                self._on_temperature(temperature[0])
            self._use(taken[0])

    def _use(self, message: Imu) -> None:
        output, journal, live = message.angular_velocity.z, self._rooms.journal, self._rooms.live
        journal.counts['samples'] += 1
        if not math.isfinite(output):
            journal.counts['not_finite'] += 1
            return
        now = self._now()
        time = self._time_of_sample(message.header)
        if time == self._last_time:
            journal.counts['stamps_ignored'] += 1
            journal.event = f'the stamp stands still at {time:.3f} s; the sample is not used'
            return
        if 0.0 < time - self._last_time <= self._settings.maximum_gap:
            self._interval = min(time - self._last_time, live.tracker.intervals.usual)
        if self._was_silent(time, now):
            live.begin_run(clock.time())
        self._last_time, journal.heard = time, now
        said = live.add(time, output, clock.time(), self._force(message), self._rooms.wheels.moving(now))
        journal.counts['temperature_clipped'] += int(live.last.temperature_clipped)
        journal.counts['beyond_range'] += int(live.last.beyond_range)
        journal.counts['lost_samples'] = live.tracker.intervals.lost
        if said:
            self._note(said)
        check = self._rooms.check
        if check.works and check.add(time, output, live.corrected):
            self._examine()
        self._calibrations.add(time, output, now)
        self._publish(message.header)

    def _was_silent(self, time: float, now: float) -> bool:
        """Tell whether the gyro may have been without power before this sample; it was not where samples waited while the node was busy."""
        since = time - self._last_time
        return now - self._rooms.journal.heard > SILENT and since < math.inf and not 0.0 < since < SILENT

    def _force(self, message: Imu) -> float | None:
        """Return the specific force about z, where the message reports it."""
        force = message.linear_acceleration.z
        known = message.linear_acceleration_covariance[0] != NOT_REPORTED and math.isfinite(force)
        self._rooms.journal.brought = {'specific_force'} if known else set()
        return force if known else None

    def _examine(self) -> None:
        """Compare a stretch of samples with what the calibration claims; during a calibration at rest, rest is promised."""
        live, run = self._rooms.live, self._calibrations.run
        self._rooms.check.examine(live.bias_variance, live.known_for(clock.time()), run is not None and run.kind == REST)

    def _note(self, restarted: str) -> None:
        """Report that integration began anew; a calibration cannot go on over that."""
        self._rooms.check.restart()
        self._rooms.journal.counts['restarts'] += 1
        self._rooms.journal.event = f'{restarted}: integration began anew'
        self._calibrations.interrupt(restarted)

    # What is published

    def _publish(self, header: Header) -> None:
        imu, live = self._imu_message, self._rooms.live
        heading = live.tracker.heading
        imu.header = self._true(header)
        imu.angular_velocity.z = live.rate
        imu.orientation.z, imu.orientation.w = math.sin(0.5 * heading), math.cos(0.5 * heading)
        known = live.model.noise.angle_random_walk > 0.0 and not self._rooms.memory.problem and self._interval < math.inf
        self._set_covariances(imu, known)
        self._imu.publish(imu)
        self._rate_message.data, self._heading_message.data = live.rate, heading
        self._yaw_rate.publish(self._rate_message)
        self._yaw.publish(self._heading_message)
        if self._pose_wanted:
            pose = self._pose_message
            pose.header, pose.pose.pose.orientation = imu.header, imu.orientation
            pose.pose.covariance[35] = imu.orientation_covariance[8] if known else UNMEASURED_VARIANCE
            self._pose.publish(pose)

    def _true(self, header: Header) -> Header:
        """Move the stamp to when the gyro was in the motion that it reports."""
        if self._offset:
            nanoseconds = header.stamp.sec * 10 ** 9 + header.stamp.nanosec + self._offset
            header.stamp.sec, header.stamp.nanosec = divmod(nanoseconds, 10 ** 9)
        return header

    def _set_covariances(self, imu: Imu, known: bool) -> None:
        """Set both covariances; all zeros, unknown, where the noise of the gyro is not known or its model could not be read."""
        tracker = self._rooms.live.tracker
        variances = (tracker.rate_variance, tracker.variance) if known else (0.0, 0.0)
        for matrix, variance in zip((imu.angular_velocity_covariance, imu.orientation_covariance), variances):
            matrix[0] = matrix[4] = UNMEASURED_VARIANCE if known else 0.0
            matrix[8] = variance

    def _watch(self) -> None:
        """Show the progress of a calibration, take on changed parameters, ask who listens, and tell of bad news at once."""
        self._calibrations.watch()
        if self._calibrations.run:
            self._show_state()
        self._pose_wanted = self._pose.get_subscription_count() > 0
        now = current(self, PARAMETERS)
        if now.reference == 'odometry':
            self._hear_odometry()
        tracking = tracking_settings(now, self._rooms.memory.model.noise)
        if tracking != self._tracking:
            self._tracking = tracking
            self._rooms.live.set(tracking)
            self._rooms.check.standing = tracking.threshold.rate
        level, _ = trouble(self._rooms, self._rooms.journal.growing(), self._now())
        if self._diagnostics.level is not None and level > self._diagnostics.level:
            self._diagnostics.now()

    def _show_state(self) -> None:
        """Publish the latched state of the calibration."""
        level, message, shown = state(self._rooms.memory, self._calibrations.run)
        pairs = [KeyValue(key=key, value=str(value)) for key, value in shown.items()]
        self._status.publish(DiagnosticStatus(level=level, name=f'{self.get_name()}: calibration', message=message, values=pairs))
        self._calibrated.publish(Bool(data=bool(shown['calibrated'])))

    def _learn(self) -> None:
        """Let the table of biases learn, once a second."""
        if not self._simulated:
            self._see_clock()
        date = clock.time()
        said = self._rooms.live.learn(date)
        if said:
            self._rooms.journal.event = said
        self._rooms.memory.keep_table(date)
        self._rooms.memory.look()

    def _report(self) -> Report:
        """Return how it goes."""
        now = self._now()
        grown, rate = self._rooms.journal.grown(now)
        return *trouble(self._rooms, grown, now), values(self._rooms, rate, current(self, PARAMETERS).standing, now, clock.time())

    def destroy_node(self) -> None:
        """Stop the robot, if it is being driven, keep what was learned, and close."""
        self._calibrations.close()
        self._rooms.live.learn(clock.time(), ending=True)
        self._rooms.memory.keep_table(clock.time(), ending=True)
        super().destroy_node()


def main() -> int:
    """Run the node until SIGINT or SIGTERM."""
    return run(CompensationNode)


if __name__ == '__main__':
    sys.exit(main())
