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

from collections.abc import Iterator
import math

from gyro_calibration.logs.log import DEGREE
from gyro_calibration.ros.calibration_session import ROS_TIME_PAUSED
from gyro_calibration.ros.clock import Clock
from gyro_calibration.ros.pipeline import COUNT_NAMES, Pipeline
from gyro_calibration.ros.runner import ERROR, OK, Report, WARN


class CompensationReport:
    """Makes reports of a pipeline; counts are compared with those of the last report."""

    def __init__(self, pipeline: Pipeline, clock: Clock):
        """Start without a report."""
        self._pipeline, self._clock = pipeline, clock
        self._previous_counts, self._last_report_time = dict.fromkeys(COUNT_NAMES, 0), math.nan

    def level(self) -> bytes:
        """Return the level of a report made now."""
        return self._evaluate()[0]

    def make(self) -> Report:
        """Return level, message and values; only counts that increase give warnings."""
        level, message = self._evaluate()
        counts, now = self._pipeline.journal.counts, self._clock.steady()
        seconds = now - self._last_report_time
        rate = ((counts['samples'] - self._previous_counts['samples'])
                / seconds if seconds > 0.0 else 0.0)
        self._previous_counts, self._last_report_time = dict(counts), now
        return level, message, {**self._sample_values(rate), **self._rest_values(),
                                **self._calibration_values()}

    def _evaluate(self) -> tuple[bytes, str]:
        """Return level and message: the first error, else the first warning."""
        pipeline, journal = self._pipeline, self._pipeline.journal
        tolerated = {'lost_samples': 3}  # per report
        growing = {name for name, count in journal.counts.items()
                   if count - self._previous_counts[name] > tolerated.get(name, 0)}
        silent = self._clock.steady() - journal.last_received
        if error := (pipeline.store.problem or pipeline.conflict or pipeline.publisher_conflict
                     or pipeline.repeat_fault):
            return ERROR, error
        if pipeline.ros_time.paused_duration > 1.0:
            return ERROR, ROS_TIME_PAUSED
        if silent > 1.0 and 'repeated_stamps' in growing or silent <= 1.0 and 'rebuilt' in growing:
            return ERROR, journal.event
        if silent > 1.0:
            why = journal.event if 'refused_samples' in growing else 'is the driver running?'
            return ERROR, f'no samples on imu/data_raw for {silent:.0f} s: {why}'
        for warning in filter(None, self._warnings(growing)):
            return WARN, warning
        tracked = pipeline.estimator.tracker.slowest_detectable_rate > 0.0
        return OK, 'the heading is published' + (
            '' if tracked else '; the bias is not estimated at rest')

    def _warnings(self, growing: set[str]) -> Iterator[str]:
        """Give the warnings, the most important first; some are ''."""
        pipeline, event = self._pipeline, self._pipeline.journal.event
        estimator, store, monitor = pipeline.estimator, pipeline.store, pipeline.monitor
        low, high = estimator.model.valid_temperatures
        for name, text in {
                'restarts': event, 'repeated_stamps': event, 'refused_samples': event,
                'refused_temperatures': event,
                'lost_samples': 'samples are lost: check the cable, the baud rate and the load of '
                'the computer; the heading is integrated over the gaps, and its variance includes '
                'them',
                'beyond_range': 'the rate is beyond the calibrated range; the correction is '
                'extrapolated',
                'temperature_clipped': f'the temperature is outside the calibrated {low:g} to '
                f'{high:g} degC; the correction is extrapolated, and its variance increases',
        }.items():
            if name in growing:
                yield text
        if estimator.temperature is None and estimator.model.uses_channel('temperature'):
            yield ('no temperature comes; the model is used at its reference temperature of '
                   f'{estimator.model.reference_temperature:g} degC')
        elif estimator.temperature is not None and estimator.is_temperature_lost:
            yield (f'the temperature is missing; {estimator.temperature:.1f} degC, the last one, '
                   'is held, and the standard deviation of the bias increases')
        for channel in estimator.missing_channels(pipeline.journal.channels):
            yield (f'the model needs the {channel.replace("_", " ")}, which no message contains; '
                   'that effect is left out')
        yield from (pipeline.session.warning, pipeline.clock_fault, pipeline.odometry_fault,
                    store.calibration_hint, store.shared_hint, monitor.bias_alarm,
                    monitor.noise_alarm, estimator.calibration_message, store.table_hint)

    def _sample_values(self, rate: float) -> dict[str, object]:
        """Return counts, heading and temperature; `rate` is the sample rate, Hz."""
        estimator, journal = self._pipeline.estimator, self._pipeline.journal
        tracker, temperature = estimator.tracker, estimator.temperature
        deviation = (math.sqrt(tracker.variance) / DEGREE
                     if estimator.model.noise.angle_random_walk > 0.0 else math.nan)
        low, high = estimator.model.temperature_range
        commands, samples = self._pipeline.session.max_lateness
        return {
            **journal.counts, 'rate_hz': f'{rate:.1f}',
            'longest_gap_s': f'{tracker.intervals.longest_gap:.3f}',
            'clock_steps': journal.clock_steps,
            'heading_deg': f'{tracker.heading / DEGREE:.3f}',
            'heading_standard_deviation_deg': f'{deviation:.3f}',
            'deleted_heading_deg': f'{tracker.deleted_heading / DEGREE:.3f}',
            'temperature_degc': '' if temperature is None else f'{temperature:.2f}',
            'temperature_range_degc': (f'{low:g} to {high:g}'
                                       if estimator.model.uses_channel('temperature') else ''),
            'command_lateness_s': f'{commands:.3f}', 'sample_lateness_s': f'{samples:.3f}',
            'last_event': journal.event}

    def _rest_values(self) -> dict[str, object]:
        """Return the bias at rest, the motion of the wheels, and the results of the monitor."""
        pipeline, now = self._pipeline, self._clock.steady()
        tracker, monitor, rest = (pipeline.estimator.tracker, pipeline.monitor,
                                  pipeline.monitor.last_rest)
        bias, deviation = tracker.bias
        slowest, age = tracker.slowest_detectable_rate / DEGREE, pipeline.wheels.age(now)
        moving, method = pipeline.wheels.is_moving(now), pipeline.values.stationary_method
        if method == 'rest' and not pipeline.estimator.model.noise.angle_random_walk:
            method = ('threshold, since the model has no angle random walk: measure it with '
                      'allan for the method rest')
        unseen = moving is None and not math.isnan(slowest)
        values = {
            'stationary_method': method, 'resting': tracker.is_resting,
            'bias_deg_s': f'{bias / DEGREE:.5f}',
            'bias_standard_deviation_deg_s': f'{deviation / DEGREE:.5f}',
            'slowest_noticed_turn_deg_s': f'{slowest:.4f}',
            'slow_turns': ('without wheels or commands, slower turns cannot be distinguished '
                           'from drift' if unseen else ''),
            'wheels': {True: 'moving', False: 'standing', None: 'unknown'}[moving],
            'wheels_age_s': f'{age:.2f}' if math.isfinite(age) else '',
            'rests_checked': monitor.examined_count}
        return values if rest is None else {
            **values, 'rest_noise_ratio': f'{rest.noise_ratio:.3f}',
            'rest_rate_deg_s': f'{rest.bias / DEGREE:.5f}',
            'rest_rate_sigmas': f'{rest.sigmas:.2f}',
            'noise_alarm': monitor.noise_alarm, 'bias_alarm': monitor.bias_alarm}

    def _calibration_values(self) -> dict[str, object]:
        """Return the calibration in use, refused ones, and the state of the bias table."""
        estimator, store, journal = (self._pipeline.estimator, self._pipeline.store,
                                     self._pipeline.journal)
        date, calibration = self._clock.date(), estimator.model.self_calibration
        written = store.table_written_time
        return {
            **(calibration.to_dict() if calibration else {}),
            'calibration_age_h': f'{estimator.age(date) / 3600.0:.2f}' if calibration else '',
            'calibration_now': estimator.calibration_message,
            'refused_calibrations': journal.refused_calibrations,
            'refusals': ' | '.join(journal.refusal_reasons),
            'bias_table_entries': len(estimator.table.entries),
            'bias_table_held_back': estimator.table.held_back_count,
            'bias_table_written_min': '' if written is None else f'{(date - written) / 60.0:.1f}',
            'bias_table': store.table_hint}


def calibration_status(pipeline: Pipeline) -> Report:
    """Return level, message and values of the latched state of the calibration."""
    store, run = pipeline.store, pipeline.session.run
    calibration = store.model.self_calibration
    values: dict[str, object] = {'calibrated': calibration is not None, 'running': run is not None,
                                 **({'progress': f'{run.progress:.2f}'} if run else {}),
                                 **(calibration.to_dict() if calibration else {})}
    if run:
        return OK, f'calibrating: {run.status}; the previous calibration is in use', values
    if store.problem:
        return ERROR, store.problem, values
    if store.calibration_hint:
        return WARN, store.calibration_hint, values
    if not calibration:
        return WARN, 'no self-calibration is stored; call calibrate', values
    return OK, str(calibration), values
