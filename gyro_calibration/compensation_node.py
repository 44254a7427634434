"""
From raw to corrected rates, and from those to the heading, on a robot.

Compensates ``imu/data_raw`` by the stored model, the last self-calibration and the threshold filter, integrates on the message stamps,
and calibrates on request. What is computed is in `compensation`, `heading` and `self_calibration`; here it is joined to topics.

"""

import math
import os
import sys
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Twist
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.duration import Duration
from rclpy.node import Node, PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.task import Future
from sensor_msgs.msg import Imu, Temperature
from std_msgs.msg import Float64, Header
from std_srvs.srv import Trigger

from gyro_calibration.check import Check, changed
from gyro_calibration.compensation import compensate, covariance, quadratic_form, rate_sensitivity
from gyro_calibration.effects import Channels
from gyro_calibration.heading import HeadingIntegrator, Threshold, ThresholdFilter
from gyro_calibration.log import DEGREE, DataRefused
from gyro_calibration.model import GyroModel, SelfCalibration, same_effects, with_self_calibration
from gyro_calibration.model_file import ModelError, read_model, write_model
from gyro_calibration.motion import CALIBRATION, Motion, MotionError, read_motion
from gyro_calibration.node import (
    LATCHED_QUALITY,
    NOT_REPORTED,
    SENSOR_QUALITY,
    UNMEASURED_VARIANCE,
    Parameter,
    current,
    declare,
    diagnostic,
    run,
)
from gyro_calibration.self_calibration import Limits, calibrate_bias, record, self_calibrate

PARAMETERS = (
    Parameter('model_file', '', 'Model of the gyro (YAML); empty for none.'),
    Parameter('calibration_file', '', 'Where calibrations are kept; empty for a file in ROS_HOME named after the node.'),
    Parameter('profile_file', '', 'Motion profile of calibrate (CSV); empty for the built-in one of 20 s.'),
    Parameter('threshold', 0.3 * DEGREE, 'Below this rate the robot stands; 0 switches the filter off.', 'rad/s', (0.0, 0.1), True),
    Parameter('threshold_window', 0.2, 'The mean over it counts; 0 looks at single samples.', 's', (0.0, 5.0), True),
    Parameter('rest_test', True, 'Where the noise is known, a window that varies by more is motion, whatever its mean.', dynamic=True),
    Parameter('check_false_alarms', 0.001, 'Of the check of noise and bias, in an hour at rest; 0 switches it off.', '1/h', (0.0, 1.0)),
    Parameter('maximum_gap', 1.0, 'Over a longer gap in the stamps nothing is integrated.', 's', (0.01, 60.0)),
    Parameter('temperature_timeout', 10.0, 'An older temperature is not used.', 's', (0.1, 3600.0)),
    Parameter('sample_timeout', 5.0, 'A calibration is given up when no sample comes for so long.', 's', (0.1, 60.0)),
    Parameter('bias_duration', 15.0, 'Length of a calibration at rest.', 's', (1.0, 600.0), True),
    Parameter('drive_profile', False, 'Drive the motion profile on cmd_vel during calibrate.', dynamic=True),
    Parameter('maximum_time_offset', 1.0, 'The gyro may lag the motion profile by so much, either way.', 's', (0.0, 10.0)),
    Parameter('maximum_residual', 1.0 * DEGREE, 'A calibration with a longer stretch turned otherwise is refused.', 'rad', (0.0, 1.0)),
    Parameter('maximum_scale_factor_error', 0.3, 'A calibration with a larger one is refused.', '1', (0.0, 0.9)),
    Parameter('maximum_bias', 10.0 * DEGREE, 'A calibration with a larger one is refused.', 'rad/s', (0.0, 10.0)),
)

# By default rclpy watches each topic for partners whose quality does not fit, and asks at every wake-up, which at 1 kHz costs 2 % of a
# core a topic. Every quality fits a subscription that asks for the least, and a publisher that offers the most.
_UNWATCHED_SUBSCRIPTION = SubscriptionEventCallbacks(use_default_callbacks=False)
_UNWATCHED_PUBLISHER = PublisherEventCallbacks(use_default_callbacks=False)


_YEAR = 365.25 * 86400.0


@dataclass
class Run:
    """
    A calibration that goes on.

    Attributes
    ----------
    motion : what the gyro is put through; None at rest
    duration : of the samples wanted, s
    answer : gets '' when the samples are complete, or the reason to give up
    heard : when the last sample, or else the request, came by the node's clock, s

    """

    motion: Motion | None
    duration: float
    answer: Future
    heard: float
    times: list[float] = field(default_factory=list)
    rates: list[float] = field(default_factory=list)
    temperatures: list[float] = field(default_factory=list)

    @property
    def elapsed(self) -> float:
        """Return the time from the first sample to the last, s."""
        return self.times[-1] - self.times[0] if self.times else 0.0

    def add(self, time: float, rate: float, temperature: float | None, heard: float) -> None:
        """Take a sample, after the model."""
        self.times.append(time)
        self.rates.append(rate)
        if temperature is not None:
            self.temperatures.append(temperature)
        self.heard = heard
        if self.elapsed >= self.duration:
            self.end('')

    def end(self, reason: str) -> None:
        """Let the service go on to its answer."""
        if not self.answer.done():
            self.answer.set_result(reason)


class CompensationNode(Node):
    """Publish corrected rates and the heading, and calibrate on request."""

    def __init__(self):
        """Read the model and the last calibration; what is wrong with them is reported, and raw rates are published meanwhile."""
        super().__init__('compensation_node')
        self._settings = declare(self, PARAMETERS)
        self._calibration_path = Path(self._settings.calibration_file or self._default_path()).expanduser()
        self._problem, self._hint = '', ''
        self._model = self._stored_model()
        self._filter = ThresholdFilter(self._threshold())
        self._heading = HeadingIntegrator(self._settings.maximum_gap)
        self._check = Check(self._model.noise, self._settings.check_false_alarms, self._settings.threshold)
        self._use(self._model)
        self._temperature: tuple[float, float] | None = None
        self._epoch: int | None = None
        self._last_time, self._last_heard, self._interval, self._rate = -math.inf, self._now(), math.inf, 0.0
        self._history, self._elapsed, self._turned_before = self._model.history(), 0.0, 0.0
        self._brought: set[str] = set()
        self._run: Run | None = None
        self._counts = dict.fromkeys(('samples', 'not_finite', 'stamps_ignored', 'restarts', 'temperature_clipped', 'beyond_range'), 0)
        self._last_counts = dict(self._counts)
        self._events = ''
        self._make_messages()
        self._connect()
        self._show_state()

    def _default_path(self) -> Path:
        home = os.environ.get('ROS_HOME', '~/.ros')
        return Path(home) / 'gyro_calibration' / f'{self.get_fully_qualified_name().strip("/").replace("/", "_")}.yaml'

    def _connect(self) -> None:
        self._imu = self.create_publisher(Imu, 'imu/data', SENSOR_QUALITY)
        self._yaw_rate = self.create_publisher(Float64, 'yaw_rate', SENSOR_QUALITY)
        self._yaw = self.create_publisher(Float64, 'heading', SENSOR_QUALITY)
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self._status = self.create_publisher(DiagnosticStatus, 'calibration_status', LATCHED_QUALITY, event_callbacks=_UNWATCHED_PUBLISHER)
        self._velocity = self.create_publisher(Twist, 'cmd_vel', 10)
        self.create_subscription(Imu, 'imu/data_raw', self._on_imu, SENSOR_QUALITY, event_callbacks=_UNWATCHED_SUBSCRIPTION)
        self.create_subscription(Temperature, 'imu/temperature', self._on_temperature, SENSOR_QUALITY,
                                 event_callbacks=_UNWATCHED_SUBSCRIPTION)
        # A run answers after 20 s. In a group where callbacks may overlap it locks out neither the samples nor a second call.
        group = ReentrantCallbackGroup()
        for name, callback in (('calibrate', self._on_calibrate), ('calibrate_bias', self._on_calibrate_bias),
                               ('cancel_calibration', self._on_cancel), ('reset_heading', self._on_reset)):
            self.create_service(Trigger, name, callback, callback_group=group)
        self._drive_timer = self.create_timer(0.02, self._drive)
        self._drive_timer.cancel()  # it runs only while the robot is driven, for a wake-up costs as much as a sample
        self.create_timer(0.2, self._watch)
        self.create_timer(1.0, self._diagnose)

    def _make_messages(self) -> None:
        """Make the messages once; only their values change from sample to sample."""
        self._imu_message, self._rate_message, self._heading_message = Imu(), Float64(), Float64()
        self._imu_message.linear_acceleration_covariance[0] = NOT_REPORTED

    # What is stored

    def _stored_model(self) -> GyroModel:
        """Return the model with its self-calibration, or an empty one; `_problem` says why the rates are uncalibrated."""
        model = GyroModel()
        if self._settings.model_file:
            try:
                model = read_model(Path(self._settings.model_file).expanduser())
            except ModelError as error:
                self._problem = f'uncalibrated: {error}'
                self.get_logger().error(self._problem)
                return model
        if not self._calibration_path.exists():
            return model
        try:
            stored = read_model(self._calibration_path)
        except ModelError as error:
            self._hint = f'the last self-calibration is not used: {error}'
            return model
        if not same_effects(stored, model):
            self._hint = f'the self-calibration in {self._calibration_path} is not used: it belongs to another model; calibrate again'
            return model
        return with_self_calibration(model, stored.self_calibration)

    def _use(self, model: GyroModel) -> None:
        """Compensate by this model from the next sample on; the heading does not jump."""
        self._model, self._covariance = model, covariance(model)
        self._offset = round(1e9 * model.true_time(0.0))
        self._heading.use(model.noise, self._covariance)
        self._check.recalibrated()

    def _apply(self, calibration: SelfCalibration) -> str:
        """Use a calibration from the next sample on, keep it, and return what went wrong with keeping it."""
        self._use(with_self_calibration(self._model, calibration))
        self._hint = ''
        try:
            write_model(self._calibration_path, self._model)
        except OSError as error:
            self._hint = f'the calibration is in use but NOT STORED ({error}): make {self._calibration_path} writable and calibrate again'
        return self._hint

    def _threshold(self) -> Threshold:
        settings = current(self, PARAMETERS)
        return Threshold(settings.threshold, settings.threshold_window, self._model.noise.angle_random_walk if settings.rest_test else 0.0)

    def _limits(self) -> Limits:
        settings = self._settings
        return Limits(scale_factor_error=settings.maximum_scale_factor_error, bias=settings.maximum_bias,
                      residual=settings.maximum_residual, time_offset=settings.maximum_time_offset)

    # Samples

    def _now(self) -> float:
        return self.get_clock().now().nanoseconds * 1e-9

    def _time(self, stamp) -> float:
        """Return a stamp in s since the first one's second, where a double still resolves nanoseconds."""
        if self._epoch is None:
            self._epoch = stamp.sec
        return stamp.sec - self._epoch + 1e-9 * stamp.nanosec

    def _on_temperature(self, message: Temperature) -> None:
        if math.isfinite(message.temperature):
            self._temperature = (self._time(message.header.stamp), message.temperature)

    def _known_temperature(self, time: float) -> float | None:
        if self._temperature is None or abs(time - self._temperature[0]) > self._settings.temperature_timeout:
            return None
        return self._temperature[1]

    def _on_imu(self, message: Imu) -> None:
        output = message.angular_velocity.z
        self._counts['samples'] += 1
        if not math.isfinite(output):
            self._counts['not_finite'] += 1
            return
        time = self._time(message.header.stamp)
        if time == self._last_time:
            self._counts['stamps_ignored'] += 1
            self._events = f'the stamp stands still at {time:.3f} s; the sample is not used'
            return
        temperature = self._known_temperature(time)
        around = self._look_around(time, temperature, message) if self._model.looks_around else None
        result = compensate(self._model, output, temperature, around)
        self._counts['temperature_clipped'] += int(result.temperature_clipped)
        self._counts['beyond_range'] += int(result.beyond_range)
        rate = float(result.rate)
        self._sensitivity = rate_sensitivity(self._model, output, rate, result.temperature, around)
        self._advance(time, rate)
        if self._check.works and self._check.add(time, output, rate):
            self._examine()
        self._collect(time, float(result.modelled), temperature)
        self._publish(message.header)

    def _look_around(self, time: float, temperature: float | None, message: Imu) -> Channels:
        """
        Return what effects look at beside rate, output and temperature.

        Time goes on with the stamps, also over gaps, and stands while they jump back. The heading is the own one, as if it had never been
        reset, and goes on at the last rate up to this sample.

        """
        interval = max(time - self._last_time, 0.0) if self._last_time > -math.inf else 0.0
        self._elapsed += interval
        ahead = self._rate * interval if interval <= self._settings.maximum_gap else 0.0
        force = message.linear_acceleration.z
        known = message.linear_acceleration_covariance[0] != NOT_REPORTED and math.isfinite(force)
        self._brought = {'specific_force'} if known else set()
        return self._history.follow(self._elapsed, temperature, force if known else None,
                                    heading=self._turned_before + self._heading.heading + ahead)

    def _advance(self, time: float, rate: float) -> None:
        """Take the heading on to this sample."""
        interval = time - self._last_time
        if 0.0 < interval <= self._settings.maximum_gap:
            self._interval = interval
        else:
            self._filter.clear()
        self._last_time, self._last_heard = time, self._now()
        self._rate = self._filter.filter(time, rate)
        self._note(self._heading.add(time, rate, self._rate, self._sensitivity))

    def _examine(self) -> None:
        """Compare a stretch of samples with what the model claims; during a calibration at rest, rest is promised."""
        promised = self._run is not None and self._run.motion is None
        self._check.examine(self._bias_variance(), self._age(), promised)

    def _bias_variance(self) -> float:
        """Return the variance of the bias by the calibration, (rad/s)², as the last sample shows it; nan where it is not known."""
        known = self._model.covariance is not None or self._model.self_calibration is not None
        return float(quadratic_form(self._covariance, self._sensitivity)) if known and self._last_time > -math.inf else math.nan

    def _age(self) -> float:
        """Return how long ago the bias was calibrated, s; a year where nobody wrote it down."""
        calibration = self._model.self_calibration
        written = calibration.time if calibration else str(self._model.origin.get('date', ''))
        try:
            when = datetime.fromisoformat(written)
        except ValueError:
            return _YEAR
        when = when if when.tzinfo else when.replace(tzinfo=timezone.utc)
        return max((datetime.now(timezone.utc) - when).total_seconds(), 0.0)

    def _note(self, restarted: str) -> None:
        """Report that integration began anew, if it did; a calibration cannot go on over that."""
        if not restarted:
            return
        self._check.restart()
        self._counts['restarts'] += 1
        self._events = f'{restarted}: integration began anew'
        if self._run and self._run.times:
            self._run.end(f"{restarted}: look at the gyro's line and run again")

    def _collect(self, time: float, modelled: float, temperature: float | None) -> None:
        if self._run and not self._run.answer.done():
            self._run.add(time, modelled, temperature, self._last_heard)

    def _publish(self, header) -> None:
        imu, heading = self._imu_message, self._heading.heading
        imu.header = self._true(header)
        imu.angular_velocity.z = self._rate
        imu.orientation.z, imu.orientation.w = math.sin(0.5 * heading), math.cos(0.5 * heading)
        self._set_covariances(imu)
        self._imu.publish(imu)
        self._rate_message.data, self._heading_message.data = self._rate, heading
        self._yaw_rate.publish(self._rate_message)
        self._yaw.publish(self._heading_message)

    def _true(self, header: Header) -> Header:
        """Move the stamp to when the gyro was in the motion that it reports."""
        if self._offset:
            nanoseconds = header.stamp.sec * 10 ** 9 + header.stamp.nanosec + self._offset
            header.stamp.sec, header.stamp.nanosec = divmod(nanoseconds, 10 ** 9)
        return header

    def _set_covariances(self, imu: Imu) -> None:
        """Set both covariances; all zeros, unknown, where the noise of the gyro is not known or its model could not be read."""
        noise, variances = self._model.noise, (0.0, 0.0)
        known = noise.angle_random_walk > 0.0 and not self._problem and self._interval < math.inf
        if known:
            calibration = float(quadratic_form(self._covariance, self._sensitivity))
            variances = (noise.rate_variance(self._interval) + calibration, self._heading.variance)
            known = math.isfinite(sum(variances))  # a calibration whose covariance is not known gives nan
        for matrix, variance in zip((imu.angular_velocity_covariance, imu.orientation_covariance), variances):
            matrix[0] = matrix[4] = UNMEASURED_VARIANCE if known else 0.0
            matrix[8] = variance if known else 0.0

    # Calibrations

    async def _on_calibrate(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        try:
            motion = read_motion(Path(self._settings.profile_file).expanduser()) if self._settings.profile_file else CALIBRATION
            return await self._calibrate(motion, motion.duration + self._settings.maximum_time_offset, response)
        except MotionError as error:
            return self._answer(response, False, f'refused: {error}')

    async def _on_calibrate_bias(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        return await self._calibrate(None, current(self, PARAMETERS).bias_duration, response)

    async def _calibrate(self, motion: Motion | None, duration: float, response: Trigger.Response) -> Trigger.Response:
        """Collect a run, fit it and use it; or change nothing and say why."""
        if self._run:
            return self._answer(response, False, 'refused: a calibration is going on already; wait for its end, or call cancel_calibration')
        if self._problem:
            return self._answer(response, False, f'refused: {self._problem}')
        run = self._run = Run(motion, duration, Future(), self._now())
        self._check.restart()
        if motion is not None and current(self, PARAMETERS).drive_profile:
            self._drive_timer.reset()
        self._show_state()
        success, message = False, ''
        try:
            reason = await run.answer
            if reason:
                raise DataRefused(reason)
            success, message = True, self._finish(run)
        except DataRefused as error:
            message = f'refused: {error}'
        except Exception as error:  # whatever happens, the robot stops, the caller hears of it and the node lives
            message = f'failed, and nothing was changed: {error!r}'
        self._run = None
        self._stop_robot()
        self._show_state()
        return self._answer(response, success, message)

    def _finish(self, run: Run) -> str:
        """Fit a complete run and use what it gives."""
        times, rates = np.array(run.times) - run.times[0], np.array(run.rates)
        temperature = float(np.mean(run.temperatures)) if run.temperatures else None
        when = datetime.now(timezone.utc).isoformat(timespec='seconds')
        if run.motion is None:
            calibration = self._rested(times, rates, when, temperature)
        else:
            fit = self_calibrate(times, rates, run.motion, limits=self._limits(), noise=self._model.noise)
            calibration = record(fit, 'likelihood', when, temperature)
        different = changed(self._claimed(), calibration, self._model.noise, self._age())
        trouble = self._apply(calibration)
        return '; '.join(filter(None, [f'{calibration}, from {len(times)} samples', different, trouble]))

    def _claimed(self) -> SelfCalibration:
        """Return the calibration in use; without one the model claims a bias of zero, as well as it knows that."""
        variance = self._bias_variance()
        return self._model.self_calibration or SelfCalibration(covariance=None if math.isnan(variance) else (
            (math.inf, 0.0), (0.0, variance)))

    def _rested(self, times: np.ndarray, rates: np.ndarray, when: str, temperature: float | None) -> SelfCalibration:
        """Return the last calibration with the bias of a run at rest (Ojeda et al., eq. 16)."""
        bias, deviation = calibrate_bias(times, rates, self._limits(), self._model.noise)
        last = self._model.self_calibration or SelfCalibration()
        # Without a self-calibration the scale is the model's, which knows how well.
        of_scale = 0.0 if self._model.self_calibration is None and self._model.covariance is not None else \
            last.covariance and last.covariance[0][0]
        variances = None if of_scale is None else ((of_scale, 0.0), (0.0, deviation ** 2))
        return SelfCalibration(last.scale_factor_error, bias, variances, when, temperature, 'rest')

    def _answer(self, response: Trigger.Response, success: bool, message: str) -> Trigger.Response:
        response.success, response.message = success, message
        self._events = message
        # Each severity needs a line of its own: the logger ties a place in the code to one.
        if success:
            self.get_logger().info(message)
        else:
            self.get_logger().warning(message)
        return response

    def _on_cancel(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if not self._run:
            return self._answer(response, False, 'refused: no calibration is going on')
        self._run.end('cancelled')
        self._stop_robot()
        return self._answer(response, True, 'cancelled; the calibration in use is the old one')

    def _on_reset(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._turned_before += self._heading.heading
        self._heading.reset()
        return self._answer(response, True, 'the heading is zero here and now')

    @property
    def _driving(self) -> bool:
        return not self._drive_timer.is_canceled()

    def _drive(self) -> None:
        """Command what the profile wants now; the robot moves only while samples come."""
        if not self._run or not self._run.motion or not self._run.times:
            return
        now = self._run.elapsed + self._now() - self._run.heard
        command = Twist()
        command.angular.z = float(self._run.motion.rate_at(np.array(now)))
        self._velocity.publish(command)

    def _stop_robot(self) -> None:
        if self._driving:
            self._drive_timer.cancel()
            self._velocity.publish(Twist())

    # What goes on

    def _watch(self) -> None:
        """Give up a calibration that hears nothing, show its progress, and take on changed parameters."""
        run = self._run
        if run and self._now() - run.heard > self._settings.sample_timeout:
            run.end(f'no sample came for {self._settings.sample_timeout:g} s: look at the gyro and its driver')
        if run:
            self._show_state()
        threshold = self._threshold()
        if threshold != self._filter.settings:
            self._filter = ThresholdFilter(threshold)
            self._check.standing = threshold.rate

    def _show_state(self) -> None:
        """Publish the latched state of the calibration."""
        level, message = self._state()
        values: dict[str, object] = {'calibrated': self._model.self_calibration is not None, 'running': self._run is not None}
        if self._run:
            values['progress'] = f'{min(self._run.elapsed / self._run.duration, 1.0):.2f}'
        if self._model.self_calibration:
            values.update(self._model.self_calibration.figures())
        pairs = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
        self._status.publish(DiagnosticStatus(level=level, name=f'{self.get_name()}: calibration', message=message, values=pairs))

    def _state(self) -> tuple[bytes, str]:
        if self._run:
            return DiagnosticStatus.OK, f'calibrating: {self._run.elapsed:.0f} of {self._run.duration:.0f} s; the old calibration is in use'
        if self._problem or self._hint:
            return DiagnosticStatus.ERROR if self._problem else DiagnosticStatus.WARN, self._problem or self._hint
        if not self._model.self_calibration:
            return DiagnosticStatus.WARN, 'no self-calibration yet; call calibrate'
        return DiagnosticStatus.OK, str(self._model.self_calibration)

    def _diagnose(self) -> None:
        """Publish how it goes, once a second; a count is bad news only while it grows."""
        grown = {name for name, count in self._counts.items() if count > self._last_counts[name]}
        self._last_counts = dict(self._counts)
        level, message = self._trouble(grown)
        deviation = math.sqrt(self._heading.variance) / DEGREE if self._model.noise.angle_random_walk else math.nan
        degrees = {'heading_deg': self._heading.heading / DEGREE, 'heading_standard_deviation_deg': deviation,
                   'deleted_by_threshold_deg': self._heading.deleted / DEGREE}
        values = {**self._counts, **{name: f'{value:.3f}' for name, value in degrees.items()}, 'last_event': self._events}
        if self._temperature:
            values['temperature_degc'] = f'{self._temperature[1]:.2f}'
        if self._model.self_calibration:
            values.update(self._model.self_calibration.figures())
        self._diagnostics.publish(diagnostic(self, level, 'heading', message, values | self._checked()))

    def _checked(self) -> dict[str, object]:
        """Return what the last rest showed."""
        rest = self._check.last
        if rest is None:
            return {'rests_checked': 0}
        return {'rests_checked': self._check.examined, 'rest_noise_ratio': f'{rest.noise_ratio:.3f}',
                'rest_rate_deg_s': f'{rest.bias / DEGREE:.5f}', 'rest_rate_sigmas': f'{rest.sigmas:.2f}',
                'noise_alarm': self._check.noise_alarm, 'bias_alarm': self._check.bias_alarm}

    def _trouble(self, grown: set[str]) -> tuple[bytes, str]:
        silent = self._now() - self._last_heard
        if self._problem:
            return DiagnosticStatus.ERROR, self._problem
        if 'samples' not in grown and silent > 1.0:
            return DiagnosticStatus.ERROR, f'no samples on imu/data_raw for {silent:.0f} s: is the driver running?'
        low, high = self._model.temperature_range
        troubles = {
            'restarts': self._events, 'stamps_ignored': self._events, 'not_finite': 'rates that are not finite came and were not used',
            'beyond_range': 'the rate is beyond the calibrated range; the correction is extrapolated',
            'temperature_clipped': f'the temperature is outside the calibrated {low:g} to {high:g} degC; its nearest end is used'}
        found = [text for name, text in troubles.items() if name in grown]
        if self._model.looks_at('temperature') and self._known_temperature(self._last_time) is None:
            reference = self._model.reference_temperature
            found.append(f'no temperature comes; the model is used at its reference temperature of {reference:g} degC')
        found += [f'the model looks at the {channel.replace("_", " ")}, which no message brings; that effect is left out'
                  for channel in ('supply', 'specific_force') if self._model.looks_at(channel) and channel not in self._brought]
        found += [text for text in (self._hint, self._check.bias_alarm, self._check.noise_alarm) if text]
        return (DiagnosticStatus.WARN, found[0]) if found else (DiagnosticStatus.OK, 'heading goes on')

    def destroy_node(self) -> None:
        """Stop the robot, if it is being driven, and close."""
        if self._driving:
            self._stop_robot()
            self._velocity.wait_for_all_acked(Duration(seconds=1.0))
        super().destroy_node()


def main() -> int:
    """Run the node until SIGINT or SIGTERM."""
    return run(CompensationNode)


if __name__ == '__main__':
    sys.exit(main())
