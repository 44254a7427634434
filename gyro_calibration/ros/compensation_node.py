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
The compensation node: connects `pipeline` to topics, services and timers, and reports on it.

It subscribes to ``imu/data_raw``, ``imu/temperature``, ``odom`` and ``cmd_vel``, and publishes
``imu/data``, ``heading``, ``yaw_rate``, ``~/calibration_status`` and diagnostics.
"""

from __future__ import annotations

from collections.abc import Callable
import math
import os
from pathlib import Path
import sys
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import (
    PoseWithCovarianceStamped, Twist, TwistStamped, TwistWithCovarianceStamped)
from gyro_calibration.driver.timestamps import read_steady_clock
from gyro_calibration.logs.cdr import (
    NOT_REPORTED, NOT_REPORTED_COVARIANCE, NSEC_PER_SEC, quaternion_heading, serialize,
    UNMEASURED_VARIANCE, z_axis_covariance)
from gyro_calibration.logs.log import DEGREE
from gyro_calibration.model.motion import MotionError
from gyro_calibration.ros.calibration_session import (
    Drive, ODOMETRY, PROFILE, read_profile, REST, ROS_TIME_PAUSED)
from gyro_calibration.ros.inputs import Clock, ODOMETRY as ODOM, Velocity
from gyro_calibration.ros.pipeline import CorrectedSample, COUNT_NAMES, PARAMETERS, Pipeline
from gyro_calibration.ros.runner import (
    call_every, declare_parameters, Diagnostics, ERROR, LATCHED_QOS, OK, publish_on, publishers_on,
    Report, run_node, status_array, subscribe_to, WARN)
from nav_msgs.msg import Odometry
from rclpy.clock import ROSClock
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.task import Future
from rclpy.timer import Timer
from sensor_msgs.msg import Imu, Temperature
from std_srvs.srv import Trigger


#: Covariance of a pose or a twist of which only the last of six parts is measured, without it.
_UNMEASURED_AXES = (*5 * (UNMEASURED_VARIANCE, *6 * (0.0,)),)


class _NodeClock:
    steady, date = staticmethod(read_steady_clock), staticmethod(time.time)

    def __init__(self, node: Node):
        self._clock = node.get_clock()

    def simulated(self) -> float | None:
        clock = self._clock
        if isinstance(clock, ROSClock) and clock.ros_time_is_active:
            return clock.now().nanoseconds / NSEC_PER_SEC
        return None


class CompensationNode(Node):
    """Publish corrected rates and the heading, and calibrate on request."""

    def __init__(self) -> None:
        """Read the model and the last calibration; without them raw rates are published."""
        super().__init__('compensation_node')
        values = declare_parameters(self, PARAMETERS,
                                    lambda changed: setattr(self._pipeline, 'values', changed))
        clock = _NodeClock(self)
        self._velocity: Publisher | None = None
        self._velocity_type = TwistStamped if values.cmd_vel_stamped else Twist
        name = self.get_fully_qualified_name().strip('/').replace('/', '_')
        file = values.calibration_file or os.path.join(
            os.environ.get('ROS_HOME') or '~/.ros', 'gyro_calibration', f'{name}.yaml')
        self._pipeline = Pipeline(values, Path(os.path.expanduser(file)), clock,
                                  self._publish_command)
        if problem := self._pipeline.store.problem:
            self.get_logger().error(problem)
        try:
            read_profile(values.calibration_profile_file)
        except MotionError as error:
            self.get_logger().warning(f'{error}; calibrate refuses until it can be read')
        self._receivers = 0
        self._pending_answer: tuple[Trigger.Response, Future] | None = None
        self._timer: Timer | None = None

        self._imu = publish_on(self, Imu, 'imu/data')
        self._heading = publish_on(self, PoseWithCovarianceStamped, 'heading')
        self._yaw_rate = publish_on(self, TwistWithCovarianceStamped, 'yaw_rate')
        self._status = publish_on(self, DiagnosticArray, '~/calibration_status', LATCHED_QOS)
        self._has_subscribers = {self._heading: False, self._yaw_rate: False}
        temperatures = subscribe_to(self, Temperature, 'imu/temperature',
                                    lambda message: self._pipeline.add_temperature(
                                        _stamp_ns(message.header), message.temperature))
        self._samples = subscribe_to(self, Imu, 'imu/data_raw', self._on_imu)
        odometry = subscribe_to(self, Odometry, 'odom', self._on_odometry)
        self._other_topics = {
            ODOMETRY: odometry.topic_name, 'temperature': temperatures.topic_name,
            'imu': self._imu.topic_name, 'heading': self._heading.topic_name,
            'yaw_rate': self._yaw_rate.topic_name}
        subscribe_to(self, self._velocity_type, 'cmd_vel', self._on_command)
        if values.calibration_drive:
            self._offer_velocity()  # calibrate reports a failure

        self._report = CompensationReport(self._pipeline, clock)
        self._diagnostics = Diagnostics(self, 'heading', lambda: self._report.make())
        session = self._pipeline.session
        self._offer_service('calibrate', lambda answer: self._calibrate(
            self._pipeline.values.calibration_reference, answer))
        self._offer_service('calibrate_bias', lambda answer: self._calibrate(REST, answer))
        self._offer_service('finish_calibration', lambda answer: self._fill_response(
            answer, *session.finish()))
        self._offer_service('cancel_calibration', self._cancel)
        self._offer_service('reset_heading', lambda answer: self._fill_response(
            answer, True, self._pipeline.reset_heading()))
        # One timer for all: each one, also a cancelled one, costs time at every sample.
        self._poll_count = 0
        call_every(self, 0.2, self._poll_graph)
        self._publish_status()

    def _offer_service(self, name: str,
                       fill: Callable[[Trigger.Response], Trigger.Response | Future]) -> None:
        """Offer a service whose answer may be a `Future`, in every executor."""
        service = self.create_service(Trigger, f'~/{name}', lambda _, response: fill(response))
        send = service.send_response

        def send_when_done(response: Any, header: Any) -> None:
            if isinstance(response, Future):
                response.add_done_callback(lambda done: send(done.result(), header))
            else:
                send(response, header)

        service.send_response = send_when_done  # type: ignore[method-assign]

    # Subscriptions

    def _on_odometry(self, message: Odometry) -> None:
        turned = message.pose.pose.orientation
        heading = quaternion_heading(turned.x, turned.y, turned.z, turned.w)
        self._pipeline.add_odometry(_stamp_ns(message.header), float(heading),
                                    _to_velocity(message.twist.twist))

    def _on_command(self, message: Twist | TwistStamped) -> None:
        self._pipeline.add_command(
            _to_velocity(message if isinstance(message, Twist) else message.twist))
        self._answer_finished_run()

    def _on_imu(self, message: Imu) -> None:
        force: float | None = message.linear_acceleration.z
        if message.linear_acceleration_covariance[0] == NOT_REPORTED:
            force = None
        output = message.angular_velocity.z
        if message.angular_velocity_covariance[0] == NOT_REPORTED:
            output = math.nan  # REP-145: the message has no rate
        corrected = self._pipeline.add_sample(_stamp_ns(message.header), output, force,
                                              self._receivers, message.header.frame_id)
        if corrected is not None:
            self._publish(message, corrected)
        if self._pending_answer:
            self._answer_finished_run()

    def _publish(self, imu: Imu, corrected: CorrectedSample) -> None:
        """Publish the received message with its z corrected, and the heading."""
        x, y = imu.angular_velocity.x, imu.angular_velocity.y
        xx, xy, _, yx, yy, *_ = imu.angular_velocity_covariance.tolist()
        if not math.isfinite(x + y + xx + xy + yx + yy) or min(xx, yy) < 0.0:
            x = y = xy = yx = 0.0
            xx = yy = UNMEASURED_VARIANCE
        elif not (xx or yy):  # all zeros: not known
            xx = yy = self._pipeline.values.assumed_bias ** 2
        acceleration = imu.linear_acceleration
        force = acceleration.x, acceleration.y, acceleration.z
        of_force = imu.linear_acceleration_covariance.tolist()
        if not math.isfinite(sum(force) + sum(of_force)):
            force, of_force = (0.0, 0.0, 0.0), NOT_REPORTED_COVARIANCE
        elif of_force[0] != NOT_REPORTED and min(of_force[::4]) < 0.0:
            of_force = z_axis_covariance(UNMEASURED_VARIANCE)
        half = 0.5 * corrected.heading
        turned = 0.0, 0.0, math.sin(half), math.cos(half)
        stamp, frame, variance = corrected.stamp, imu.header.frame_id, corrected.heading_variance
        self._imu.publish(serialize(stamp, frame, (
            *turned, *z_axis_covariance(variance), x, y, corrected.rate,
            xx, xy, 0.0, yx, yy, 0.0, 0.0, 0.0, corrected.rate_variance, *force, *of_force)))
        if self._has_subscribers[self._heading]:
            self._heading.publish(serialize(stamp, self._pipeline.values.heading_frame, (
                0.0, 0.0, 0.0, *turned, *_UNMEASURED_AXES, variance)))
        if self._has_subscribers[self._yaw_rate]:
            self._yaw_rate.publish(serialize(stamp, frame, (
                0.0, 0.0, 0.0, 0.0, 0.0, corrected.rate, *_UNMEASURED_AXES,
                corrected.rate_variance)))

    def _publish_status(self) -> None:
        store, run = self._pipeline.store, self._pipeline.session.run
        calibration = store.model.self_calibration
        values: dict[str, object] = {
            'calibrated': calibration is not None, 'running': run is not None,
            **({'progress': f'{min(run.elapsed / run.max_duration, 1.0):.2f}'} if run else {}),
            **(calibration.to_dict() if calibration else {})}
        level, message = OK, str(calibration)
        if run:
            message = f'calibrating: {run.status}; the previous calibration is in use'
        elif store.problem:
            level, message = ERROR, store.problem
        elif store.calibration_hint:
            level, message = WARN, store.calibration_hint
        elif not calibration:
            level, message = WARN, 'no self-calibration is stored; call calibrate'
        self._status.publish(status_array(self, 'calibration', (level, message, values)))

    def _poll_graph(self) -> None:
        self._pipeline.update_publishers(publishers_on(self, self._samples.topic_name))
        self._pipeline.topic_conflicts = {
            role: f'several nodes publish on {topic} '
            f'({", ".join(publishers_on(self, topic))}), and a receiver cannot distinguish them: '
            'end or remap the other'
            for role, topic in self._other_topics.items() if self.count_publishers(topic) > 1}
        self._has_subscribers = {each: each.get_subscription_count() > 0
                                 for each in self._has_subscribers}
        self._count_receivers()
        if not self._pipeline.session.is_driving:  # else `_drive` does
            self._pipeline.poll(self._receivers)
        elif hasattr(self, 'count_clients'):  # not in Humble
            self._pipeline.session.update_callers(self.count_clients('~/calibrate'))
        self._answer_finished_run()
        if self._pipeline.session.run:
            self._publish_status()
        self._poll_count += 1
        second = self._poll_count % 5 == 0
        if second:
            self._pipeline.run_periodic_tasks()
        if second or self._report.level() > (self._diagnostics.level or OK):
            self._diagnostics.publish()

    # Services

    def _calibrate(self, kind: str, response: Trigger.Response) -> Trigger.Response | Future:
        """Begin a run, which `_answer_finished_run` answers, or refuse with the reason."""
        session, values = self._pipeline.session, self._pipeline.values
        obstacle = self._pipeline.find_conflict(kind)
        if kind == PROFILE and values.calibration_drive:
            obstacle = self._offer_velocity() or self._pipeline.find_obstacle()
        if refusal := session.begin(kind, values, obstacle):
            return self._refuse(response, refusal)
        if session.is_driving:
            self._timer = call_every(self, Drive.INTERVAL, self._drive)
        self._pending_answer = response, Future()
        self._publish_status()
        return self._pending_answer[1]

    def _answer_finished_run(self) -> None:
        """Fit a run that has ended, use its calibration, and answer the service."""
        session = self._pipeline.session
        if not self._pending_answer or session.run is None or session.run.end_reason is None:
            return
        if self._timer:
            self.destroy_timer(self._timer)
        (response, future), self._pending_answer, self._timer = self._pending_answer, None, None
        success, message = session.conclude()
        self._publish_status()
        future.set_result(self._fill_response(response, True, message) if success
                          else self._refuse(response, message))

    def _refuse(self, response: Trigger.Response, reason: str) -> Trigger.Response:
        journal = self._pipeline.journal
        journal.refused_calibrations += 1
        journal.refusal_reasons.append(reason)
        return self._fill_response(response, False, reason)

    def _fill_response(self, response: Trigger.Response, success: bool,
                       text: str) -> Trigger.Response:
        response.success, response.message = success, text if success else f'refused: {text}'
        self._pipeline.journal.event = response.message
        if success:  # rclpy wants each severity on a line of its own
            self.get_logger().info(response.message)
        else:
            self.get_logger().warning(response.message)
        return response

    def _cancel(self, response: Trigger.Response) -> Trigger.Response:
        success, text = self._pipeline.session.cancel()
        self._answer_finished_run()
        return self._fill_response(response, success, text)

    # Driving

    def _offer_velocity(self) -> str:
        """Create the publisher of cmd_vel before the first drive; return why it failed, or ''."""
        if self._velocity is None:
            try:
                self._velocity = publish_on(self, self._velocity_type, 'cmd_vel',
                                            QoSProfile(depth=10))
            except RuntimeError as error:  # the policy of a secured graph may forbid it
                reason = str(error).partition(',')[0]
                return (f'this node may not publish cmd_vel ({reason}): allow it in the policy, '
                        'or set calibration.drive to false')
        return ''

    def _count_receivers(self) -> None:
        """Count the other nodes that receive cmd_vel; this node is a subscriber too."""
        count = self._velocity.get_subscription_count() if self._velocity else 0
        self._receivers = max(count - 1, 0)

    def _drive(self) -> None:
        self._count_receivers()
        self._pipeline.poll(self._receivers)
        self._answer_finished_run()

    def _publish_command(self, rate: float) -> None:
        """Publish a rate about z, rad/s."""
        message = self._velocity_type()
        if isinstance(message, TwistStamped):
            message.header.stamp = self.get_clock().now().to_msg()
        (message if isinstance(message, Twist) else message.twist).angular.z = rate
        assert self._velocity is not None  # `_offer_velocity` comes before a run
        self._velocity.publish(message)

    def stop_robot(self, reason: str) -> None:
        """End a run by a reason, answer it, and wait until the robot has the command to stop."""
        self._pipeline.session.end(reason)
        self._answer_finished_run()
        if self._velocity:
            self._velocity.wait_for_all_acked(Duration(seconds=1.0))

    def destroy_node(self) -> None:
        """Stop the robot, store the bias table, answer a run, and destroy the node."""
        if hasattr(self, '_pipeline'):  # not where a parameter was refused
            self.stop_robot('this node was ended: start it, and run again')
            self._pipeline.run_periodic_tasks(is_final=True)
        super().destroy_node()


class CompensationReport:
    """Makes reports of a pipeline; counts are compared with those of the last report."""

    def __init__(self, pipeline: Pipeline, clock: Clock):
        self._pipeline, self._clock = pipeline, clock
        self._previous_counts, self._last_report_time = dict.fromkeys(COUNT_NAMES, 0), math.nan

    def level(self) -> bytes:
        return self._evaluate()[0]

    def make(self) -> Report:
        """Return level, message and values; only counts that increase give warnings."""
        level, (message, *others) = self._evaluate()
        pipeline, journal, now = self._pipeline, self._pipeline.journal, self._clock.steady()
        estimator, monitor, store = pipeline.estimator, pipeline.monitor, pipeline.store
        tracker, temperature, model = estimator.tracker, estimator.temperature, estimator.model
        counts, seconds = journal.counts, now - self._last_report_time
        rate = ((counts['samples'] - self._previous_counts['samples'])
                / seconds if seconds > 0.0 else 0.0)
        self._previous_counts, self._last_report_time = dict(counts), now
        has_noise = model.noise.angle_random_walk > 0.0
        deviation = math.sqrt(pipeline.heading_variance) / DEGREE if has_noise else math.nan
        low, high = model.temperature_range
        commands, samples = pipeline.session.max_lateness
        values: dict[str, object] = {
            **counts, 'rate_hz': f'{rate:.1f}',
            'longest_gap_s': f'{tracker.intervals.longest_gap:.3f}',
            'clock_steps': journal.clock_steps, 'stamp_pace': f'{pipeline.stamp_delay.pace:.4f}',
            'heading_deg': f'{tracker.heading / DEGREE:.3f}',
            'heading_standard_deviation_deg': f'{deviation:.3f}',
            'deleted_heading_deg': f'{tracker.deleted_heading / DEGREE:.3f}',
            'temperature_degc': '' if temperature is None else f'{temperature:.2f}',
            'temperature_range_degc': (f'{low:g} to {high:g}'
                                       if model.uses_channel('temperature') else ''),
            'command_lateness_s': f'{commands:.3f}', 'sample_lateness_s': f'{samples:.3f}',
            'last_event': journal.event, 'other_warnings': ' | '.join(others)}

        bias, deviation = tracker.bias
        slowest, age = tracker.slowest_detectable_rate / DEGREE, pipeline.wheels.age(now)
        moving, method = pipeline.wheels.is_moving(now), pipeline.values.stationary_method
        if method == 'rest' and not has_noise:
            method = ('threshold, since the model has no angle random walk: measure it with '
                      'allan for the method rest')
        values |= {
            'stationary_method': method, 'resting': tracker.is_resting,
            'bias_deg_s': f'{bias / DEGREE:.5f}',
            'bias_standard_deviation_deg_s': f'{deviation / DEGREE:.5f}',
            'slowest_noticed_turn_deg_s': f'{slowest:.4f}',
            'slow_turns': ('without wheels or commands, slower turns cannot be distinguished '
                           'from drift' if moving is None and not math.isnan(slowest) else ''),
            'wheels': {True: 'moving', False: 'standing', None: 'unknown'}[moving],
            'wheels_age_s': f'{age:.2f}' if math.isfinite(age) else '',
            'rests_checked': monitor.examined_count}
        if rest := monitor.last_rest:
            values |= {
                'rest_noise_ratio': f'{rest.noise_ratio:.3f}',
                'rest_rate_deg_s': f'{rest.bias / DEGREE:.5f}',
                'rest_rate_sigmas': f'{rest.sigmas:.2f}',
                'noise_alarm': monitor.noise_alarm, 'bias_alarm': monitor.bias_alarm}

        date, calibration = self._clock.date(), model.self_calibration
        written = store.table_written_time
        return level, message, {
            **values, **(calibration.to_dict() if calibration else {}),
            'calibration_age_h': f'{estimator.age(date) / 3600.0:.2f}' if calibration else '',
            'calibration_now': estimator.calibration_message,
            'refused_calibrations': journal.refused_calibrations,
            'refusals': ' | '.join(journal.refusal_reasons),
            'bias_table_entries': len(estimator.table.entries),
            'bias_table_held_back': estimator.table.held_back_count,
            'bias_table_written_min': '' if written is None else f'{(date - written) / 60.0:.1f}',
            'bias_table': store.table_hint}

    def _evaluate(self) -> tuple[bytes, list[str]]:
        """Return level and sentences: the first error, else the warnings, the worst one first."""
        pipeline, journal = self._pipeline, self._pipeline.journal
        tolerated = {'lost_samples': 3}  # per report
        growing = {name for name, count in journal.counts.items()
                   if count - self._previous_counts[name] > tolerated.get(name, 0)}
        now = self._clock.steady()
        silent = now - journal.last_received
        # a healthy gyro may begin so, at rest
        suspicion = (pipeline.repeat_suspicion if pipeline.repeat_detector.has_changed
                     or pipeline.wheels.is_moving(now) else '')
        if error := (pipeline.store.problem or pipeline.conflict or pipeline.publisher_conflict
                     or pipeline.repeat_fault or suspicion):
            return ERROR, [error]
        if pipeline.ros_time.paused_duration > 1.0:
            return ERROR, [ROS_TIME_PAUSED]
        if silent > 1.0 and 'repeated_stamps' in growing or silent <= 1.0 and 'rebuilt' in growing:
            return ERROR, [journal.event]
        if silent > 1.0:
            why = journal.event if 'refused_samples' in growing else 'is the driver running?'
            return ERROR, [f'no samples on imu/data_raw for {silent:.0f} s: {why}']

        estimator, store, monitor = pipeline.estimator, pipeline.store, pipeline.monitor
        low, high = estimator.model.valid_temperatures
        warnings = [pipeline.session.warning, pipeline.repeat_suspicion,
                    *pipeline.faults.values()]
        if growing & {'restarts', 'repeated_stamps', 'refused_samples', 'refused_temperatures'}:
            warnings.append(journal.event)
        warnings.append(pipeline.heading_loss)
        warnings += [text for name, text in {
            'lost_samples': 'samples are lost: check the cable, the baud rate and the load of the '
            'computer; the heading is integrated over the gaps, and its variance includes them',
            'beyond_range': 'the rate is beyond the calibrated range: extrapolated',
            'temperature_clipped': f'the temperature is outside the calibrated {low:g} to '
            f'{high:g} degC; the correction is extrapolated, and its variance increases',
        }.items() if name in growing]
        if estimator.temperature is None and estimator.model.uses_channel('temperature'):
            warnings.append('no temperature comes; the reference of the model is used, '
                            f'{estimator.model.reference_temperature:g} degC')
        elif estimator.temperature is not None and estimator.is_temperature_lost:
            warnings.append(f'the temperature is missing; the last, {estimator.temperature:.1f} '
                            'degC, is held, and the standard deviation of the bias increases')
        warnings += [f'the model needs the {channel.replace("_", " ")}, which no message '
                     'contains; that effect is left out'
                     for channel in ('supply', 'specific_force')
                     if estimator.current_model.uses_channel(channel)
                     and channel not in journal.channels]
        if (pipeline.values.wheels in ('odom', 'both')
                and pipeline.wheels.is_moving(now, (ODOM,)) is None):
            warnings.append('nothing that can be used comes on odom, which wheels was set to: '
                            'remap odom to the odometry of the wheels, or set wheels to another')
        warnings += [
            *pipeline.topic_conflicts.values(), store.calibration_hint, store.shared_hint,
            monitor.bias_alarm, monitor.noise_alarm, estimator.calibration_message,
            estimator.bias_message, store.table_hint]
        if any(warnings):
            return WARN, list(filter(None, warnings))
        tracked = estimator.tracker.slowest_detectable_rate > 0.0
        return OK, ['the heading is published' + (
            '' if tracked else '; the bias is not estimated at rest')]


def _stamp_ns(header: Any) -> int:
    return header.stamp.sec * NSEC_PER_SEC + header.stamp.nanosec


def _to_velocity(twist: Twist) -> Velocity:
    linear, angular = twist.linear, twist.angular
    return Velocity((linear.x, linear.y, linear.z), (angular.x, angular.y, angular.z))


def main() -> int:
    return run_node(CompensationNode)


if __name__ == '__main__':
    sys.exit(main())
