# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Reports of the compensation node: diagnostics each second, and the calibration status."""

from __future__ import annotations

from collections.abc import Mapping
import math

from gyro_calibration.logs.log import DEGREE
from gyro_calibration.ros.calibration_session import (
    CalibrationRun,
    DRIVE_SAMPLE_TIMEOUT,
    ROS_TIME_PAUSED,
)
from gyro_calibration.ros.clock import Clock
from gyro_calibration.ros.diagnostics import ERROR, OK, Report, WARN
from gyro_calibration.ros.health_monitor import HealthMonitor
from gyro_calibration.ros.pipeline import COUNT_NAMES, Pipeline
from gyro_calibration.ros.state_store import StateStore

#: Count -> largest increase per second without a warning.
_TOLERATED_COUNTS = {'lost_samples': 3}


class CompensationReport:
    """Makes reports of a pipeline; counts are compared with those of the last report."""

    def __init__(self, pipeline: Pipeline, clock: Clock):
        """Start without a report."""
        self._pipeline, self._clock = pipeline, clock
        self._previous_counts, self._last_report_time = dict.fromkeys(COUNT_NAMES, 0), math.nan

    def level(self) -> bytes:
        """Return the level of a report made now."""
        return self._evaluate(self._growing_counts())[0]

    def make(self) -> Report:
        """Return level, message and values; only counts that increase give warnings."""
        counts, now = self._pipeline.journal.counts, self._clock.steady()
        growing = self._growing_counts()
        seconds = now - self._last_report_time
        rate = ((counts['samples'] - self._previous_counts['samples'])
                / seconds if seconds > 0.0 else 0.0)
        self._previous_counts, self._last_report_time = dict(counts), now
        return *self._evaluate(growing), self._values(rate)

    def _growing_counts(self) -> set[str]:
        counts = self._pipeline.journal.counts
        return {name for name, count in counts.items()
                if count - self._previous_counts.get(name, 0) > _TOLERATED_COUNTS.get(name, 0)}

    def _evaluate(self, growing: set[str]) -> tuple[bytes, str]:
        pipeline = self._pipeline
        silent = self._clock.steady() - pipeline.journal.last_received
        if error := (pipeline.store.problem or pipeline.conflict or pipeline.publisher_conflict
                     or pipeline.repeat_fault):
            return ERROR, error
        if pipeline.ros_time.paused_duration > max(DRIVE_SAMPLE_TIMEOUT, 1.0):
            return ERROR, ROS_TIME_PAUSED
        if silent > 1.0 and 'repeated_stamps' in growing:
            return ERROR, pipeline.journal.event
        if silent > 1.0:
            refused = 'refused_samples' in growing
            why = pipeline.journal.event if refused else 'is the driver running?'
            return ERROR, f'no samples on imu/data_raw for {silent:.0f} s: {why}'
        if 'rebuilt' in growing:
            return ERROR, pipeline.journal.event
        estimator, store, monitor = pipeline.estimator, pipeline.store, pipeline.monitor
        missing = [f'the model needs the {channel.replace("_", " ")}, which no message contains; '
                   'that effect is left out'
                   for channel in estimator.missing_channels(pipeline.journal.channels)]
        others = (pipeline.session.warning, pipeline.clock_fault, pipeline.odometry_fault,
                  store.calibration_hint, store.shared_hint, monitor.bias_alarm,
                  monitor.noise_alarm, estimator.calibration_message, store.table_hint)
        low, high = estimator.model.valid_temperatures
        event = pipeline.journal.event
        counted = {'restarts': event, 'repeated_stamps': event, 'refused_samples': event,
                   'refused_temperatures': event,
                   'lost_samples': 'samples are lost: check the cable, the baud rate and the load '
                   'of the computer; the heading is integrated over the gaps, and '
                   'its variance includes them',
                   'beyond_range': 'the rate is beyond the calibrated range; the correction is '
                   'extrapolated',
                   'temperature_clipped': f'the temperature is outside the calibrated {low:g} to '
                   f'{high:g} degC; the correction is extrapolated, and its '
                   'variance increases'}
        temperature = ''
        if estimator.temperature is None and estimator.model.uses_channel('temperature'):
            temperature = ('no temperature comes; the model is used at its reference temperature '
                           f'of {estimator.model.reference_temperature:g} degC')
        elif estimator.temperature is not None and estimator.is_temperature_lost:
            temperature = (f'the temperature is missing; {estimator.temperature:.1f} degC, the '
                           'last one, is held, and the standard deviation of the bias increases')
        warnings = [*(text for name, text in counted.items() if name in growing),
                    *filter(None, (temperature, *missing, *others))]
        if warnings:
            return WARN, warnings[0]
        tracked = pipeline.estimator.tracker.slowest_detectable_rate > 0.0
        return OK, 'the heading is published' + (
            '' if tracked else '; the bias is not estimated at rest')

    def _values(self, rate: float) -> dict[str, object]:
        """Return the values of the report by name; `rate` is the sample rate, Hz."""
        pipeline, date = self._pipeline, self._clock.date()
        estimator, journal, store = pipeline.estimator, pipeline.journal, pipeline.store
        tracker = estimator.tracker
        heading_deviation = (math.sqrt(tracker.variance) / DEGREE
                             if estimator.model.noise.angle_random_walk > 0.0 else math.nan)
        low, high = estimator.model.temperature_range
        needed = estimator.model.uses_channel('temperature')
        calibration = estimator.model.self_calibration
        age = f'{estimator.age(date) / 3600.0:.2f}' if calibration else ''
        written = ('' if store.table_written_time is None
                   else f'{(date - store.table_written_time) / 60.0:.1f}')
        commands, samples = pipeline.session.max_lateness
        return {**journal.counts, 'rate_hz': f'{rate:.1f}',
                'longest_gap_s': f'{estimator.tracker.intervals.longest_gap:.3f}',
                'clock_steps': journal.clock_steps,
                'heading_deg': f'{tracker.heading / DEGREE:.3f}',
                'heading_standard_deviation_deg': f'{heading_deviation:.3f}',
                'deleted_heading_deg': f'{tracker.deleted_heading / DEGREE:.3f}',
                **self._rest_values(), **(calibration.to_dict() if calibration else {}),
                'calibration_age_h': age, 'calibration_now': estimator.calibration_message,
                'temperature_degc': '' if estimator.temperature is None
                else f'{estimator.temperature:.2f}',
                'temperature_range_degc': f'{low:g} to {high:g}' if needed else '',
                'command_lateness_s': f'{commands:.3f}', 'sample_lateness_s': f'{samples:.3f}',
                'refused_calibrations': journal.refused_calibrations,
                'refusals': ' | '.join(journal.refusal_reasons),
                'bias_table_entries': len(estimator.table.entries),
                'bias_table_held_back': estimator.table.held_back_count,
                'bias_table_written_min': written, 'bias_table': store.table_hint,
                **_monitor_values(pipeline.monitor), 'last_event': journal.event}

    def _rest_values(self) -> dict[str, object]:
        pipeline, now = self._pipeline, self._clock.steady()
        tracker, wheels = pipeline.estimator.tracker, pipeline.wheels
        bias, deviation = tracker.bias
        slowest, age = tracker.slowest_detectable_rate / DEGREE, wheels.age(now)
        moving = wheels.is_moving(now)
        method = pipeline.values.stationary_method
        if method == 'rest' and not pipeline.estimator.model.noise.angle_random_walk:
            method = ('threshold, since the model has no angle random walk: measure it with '
                      'allan for the method rest')
        unseen = moving is None and not math.isnan(slowest)
        return {'stationary_method': method, 'resting': tracker.is_resting,
                'bias_deg_s': f'{bias / DEGREE:.5f}',
                'bias_standard_deviation_deg_s': f'{deviation / DEGREE:.5f}',
                'slowest_noticed_turn_deg_s': f'{slowest:.4f}',
                'slow_turns': 'without wheels or commands, slower turns cannot be '
                'distinguished from drift' if unseen else '',
                'wheels': {True: 'moving', False: 'standing', None: 'unknown'}[moving],
                'wheels_age_s': f'{age:.2f}' if math.isfinite(age) else ''}


def _monitor_values(monitor: HealthMonitor) -> dict[str, object]:
    """Return the results of the last rest by name."""
    rest = monitor.last_rest
    if rest is None:
        return {'rests_checked': 0}
    return {'rests_checked': monitor.examined_count, 'rest_noise_ratio': f'{rest.noise_ratio:.3f}',
            'rest_rate_deg_s': f'{rest.bias / DEGREE:.5f}',
            'rest_rate_sigmas': f'{rest.sigmas:.2f}',
            'noise_alarm': monitor.noise_alarm, 'bias_alarm': monitor.bias_alarm}


def calibration_status(store: StateStore, run: CalibrationRun | None) -> tuple[
        bytes, str, Mapping[str, object]]:
    """Return level, message and values of the latched state of the calibration."""
    calibration = store.model.self_calibration
    values: dict[str, object] = {'calibrated': calibration is not None, 'running': run is not None}
    if run:
        values['progress'] = f'{run.progress:.2f}'
    values.update(calibration.to_dict() if calibration else {})
    if run:
        return OK, f'calibrating: {run.status}; the previous calibration is in use', values
    if store.problem:
        return ERROR, store.problem, values
    if store.calibration_hint:
        return WARN, store.calibration_hint, values
    if not calibration:
        return WARN, 'no self-calibration is stored; call calibrate', values
    return OK, str(calibration), values
