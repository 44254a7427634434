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
The work on one log of a fleet: calibration, diagnosis and its record.

A single log does not distinguish slow effects (a ramp, a warm-up, the temperature) from the wander
of the bias. Each is fitted alone with scale factor error and bias, to the increments of the
heading over spans, with the noise of `noise_grid`. An effect repeats over many logs, wander does
not.

"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import asdict, dataclass
import hashlib
import json
import math
import os
from pathlib import Path
import re
from typing import Any

from gyro_calibration import __version__
from gyro_calibration.calibration.dwells import extract_dwells
from gyro_calibration.calibration.encoder import calibrate_encoder
from gyro_calibration.calibration.noise_grid import (
    BandedNoise,
    bias_wander_columns,
    fit_noise_grid,
    heading_noise,
)
from gyro_calibration.calibration.selection import select_effects
from gyro_calibration.diagnosis.data_quality import inspect_record
from gyro_calibration.diagnosis.expected_output import bridge_gaps, is_implausible_factor
from gyro_calibration.diagnosis.gates import (
    check_gates,
    is_at_rest,
    mismatch_finding,
    refuse_unusable,
)
from gyro_calibration.diagnosis.pipeline import diagnose
from gyro_calibration.diagnosis.rate_table import diagnose_table
from gyro_calibration.diagnosis.report import render_report
from gyro_calibration.files import (
    describe_error,
    InputError,
    sha256_digest,
    to_printable,
    write_atomically,
)
from gyro_calibration.fleet.table import describe_log, FleetLog
from gyro_calibration.heading.integration import integrate
from gyro_calibration.logs.log import Array, DataRefused, Log, QUANTITIES, read_log
from gyro_calibration.logs.quality import white_noise_deviation
from gyro_calibration.logs.recording import read_recording
from gyro_calibration.logs.ros_bag import is_recording, list_recording_files
from gyro_calibration.model.effects import BIAS
from gyro_calibration.model.gyro_model import GyroModel, Term
from gyro_calibration.model.noise import Noise
import numpy as np

#: Number of spans in a log, and the shortest one, s.
_SPAN_COUNT, _MIN_SPAN_DURATION = 60, 2.0
#: Shortest log for slow effects and for the bias at rest, s.
_MIN_LOG_DURATION = 60.0


def fit_slow_effects(log: Log, time_offset: float = 0.0,
                     names: Collection[str] | None = None) -> dict[str, dict[str, Any]]:
    """
    Return the slow effects of a log in time, by name: value, standard deviation and unit.

    Parameters
    ----------
    log : with a reference, or at rest
    time_offset : by which the gyro lags its reference, s
    names : of the effects; None for all

    """
    assert log.time is not None and log.output is not None
    known = np.isfinite(log.output)
    time = log.time[known] - time_offset
    if time[-1] - time[0] < _MIN_LOG_DURATION:
        return {}
    gyro_angle, heading = integrate(time, log.output[known]), _reference_heading(log)
    step = max((time[-1] - time[0]) / _SPAN_COUNT, _MIN_SPAN_DURATION)
    ends = np.arange(time[0], time[-1] + 1e-9, step)
    if heading is None:
        span_edges, columns, rate = ends, [], np.zeros(len(ends))
    else:
        span_edges = (
            heading[0][np.unique(np.searchsorted(heading[0], ends).clip(0, len(heading[0]) - 1))])
        true_heading = np.interp(span_edges, *heading)
        columns, rate = [np.diff(true_heading)], np.gradient(true_heading, span_edges)
    if len(span_edges) < 10:
        return {}
    increments = np.diff(np.interp(span_edges, time, gyro_angle))
    noise = _noise_parts(span_edges, rate, is_rest=heading is None)
    found: dict[str, dict[str, Any]] = {}
    for name, (unit, column) in _slow_effect_columns(log, span_edges).items():
        if names is not None and name not in names:
            continue
        fit = fit_noise_grid(increments, np.column_stack([*columns, np.diff(span_edges), column]),
                             noise, *bias_wander_columns(span_edges),
                             noisy_column=0 if columns else None, wandering_value=len(columns))
        found[name] = {'value': float(fit.values[-1]), 'deviation': float(fit.deviations[-1]),
                       'unit': unit}
    return {name: each for name, each in found.items()
            if math.isfinite(each['deviation']) and each['deviation'] > 0.0}


def _estimate_rest_bias(log: Log) -> tuple[float, float]:
    """
    Return the bias of a log at rest, rad/s, and its standard deviation with the wander.

    Raises
    ------
    DataRefused : it lasts too short a time

    """
    assert log.time is not None and log.output is not None
    known = np.isfinite(log.output)
    time = log.time[known]
    if known.sum() < 100 or time[-1] - time[0] < _MIN_LOG_DURATION:
        raise DataRefused(f'rests for less than {_MIN_LOG_DURATION:.0f} s: record for longer')
    span_edges = np.linspace(time[0], time[-1], _SPAN_COUNT + 1)
    increments = np.diff(np.interp(span_edges, time, integrate(time, log.output[known])))
    fit = fit_noise_grid(increments, np.diff(span_edges)[:, None],
                         _noise_parts(span_edges, np.zeros(len(span_edges)), is_rest=True),
                         *bias_wander_columns(span_edges), wandering_value=0)
    return float(fit.values[0]), float(fit.deviations[0])


def _reference_heading(log: Log) -> tuple[Array, Array] | None:
    """Return times and headings of the reference; None at rest."""
    assert log.time is not None
    if log.reference_heading is not None:
        known = np.isfinite(log.reference_heading)
        if known.sum() > 1:
            return log.time[known], log.reference_heading[known]
    if log.reference_rate is not None and np.isfinite(log.reference_rate).any():
        return log.time, integrate(log.time, bridge_gaps(log.reference_rate))
    return None


def _noise_parts(time: Array, rate: Array, is_rest: bool) -> list[BandedNoise]:
    parts = heading_noise(time, rate)
    return parts[:1] if is_rest else parts


def _slow_effect_columns(log: Log, span_edges: Array) -> dict[str, tuple[str, Array]]:
    """Return the unit and the column of each effect in the increments."""
    assert log.time is not None
    elapsed = span_edges - log.time[0]
    middle = 0.5 * elapsed[-1]
    found = {'rate_ramp': ('rad/s²', np.diff(0.5 * (elapsed - middle) ** 2))}
    for constant in (60.0, 300.0):  # s; the same for all logs, as they are pooled
        found[f'warm_up_{constant:.0f}s'] = (
            'rad/s', np.diff(-constant * np.exp(-elapsed / constant)))
    if log.temperature is not None and np.isfinite(log.temperature).all():
        temperature_deviation = log.temperature - log.temperature.mean()
        if np.ptp(temperature_deviation) > 0.0:
            found['bias_temperature'] = 'rad/s/K', np.diff(
                np.interp(span_edges, log.time, integrate(log.time, temperature_deviation)))
    return found


#: Status of a log that was calibrated, and of one that is excluded.
DONE, NO_EVIDENCE = 'done', 'no evidence'
#: Schema of the records; records of another one are not read.
SCHEMA = 'gyro_calibration/fleet_log/2'


@dataclass(frozen=True)
class LogTask:
    """
    The work on a log, with its options.

    Attributes
    ----------
    entry : the log
    folder : of the results
    technology : of the gyros, one of `course_over_ground.TECHNOLOGY_PRIORS`
    file_pattern : pattern of the file names, by `table.compile_file_pattern`
    generator : for the diagnosis, the same for each log; None without a diagnosis
    default_type : of logs whose type is not stated
    sample_rate : Hz, of the samples of logs without a usable time

    """

    entry: FleetLog
    folder: str
    technology: str = 'mems'
    file_pattern: re.Pattern[str] | None = None
    generator: np.random.Generator | None = None
    default_type: str = ''
    sample_rate: float | None = None

    @property
    def name(self) -> str:
        """Return the name of the log's files among the results, which is unique for its path."""
        stem = re.sub(r'[^A-Za-z0-9_.-]', '_', Path(self.entry.log).name.partition('.')[0])
        path = os.path.abspath(self.entry.log).encode(errors='surrogateescape')
        return f'{stem[:60]}-{hashlib.sha256(path).hexdigest()[:8]}'

    @property
    def record_path(self) -> Path:
        """Return the path of the stored record."""
        return Path(self.folder) / 'logs' / f'{self.name}.json'


def process_log(task: LogTask) -> dict[str, Any]:
    """
    Return the record of a log, and store it; a stored record of the same content is used again.

    It is JSON data, and equal to the bit on all machines. A change of unit, type or drive in a
    table does not cause a new computation.

    Returns
    -------
    ``status`` is `DONE` or `NO_EVIDENCE` with a ``reason``; ``sha256`` is of the file, and
    ``content`` of the values in it; ``values`` has name -> value, standard deviation and unit;
    ``slow`` the same of effects that a single log does not distinguish from the wander of the
    bias, each fitted alone; ``diagnosis`` a summary

    """
    try:
        entry = describe_log(task.entry, task.file_pattern).fill_missing(
            {'type': task.default_type})
        content = sha256_digest(*list_recording_files(task.entry.log))
        key = _record_key(task, content)
        found = _load_record(task.record_path, key)
        if found is None:
            found = {'schema': SCHEMA, 'key': key, 'sha256': content,
                     **_calibrate_and_diagnose(task)}
            write_atomically(task.record_path, json.dumps(found, allow_nan=False).encode())
        stated = _stated_fields(entry)
        if entry.temperature is None:
            stated['temperature'] = found['mean_temperature']
        return {**found, **stated}
    except (InputError, ArithmeticError, np.linalg.LinAlgError, OSError, MemoryError) as error:
        return make_refused_record(task.entry, _format_reason(error, task.entry.log))


def make_refused_record(entry: FleetLog, reason_text: str) -> dict[str, Any]:
    """Return the record of an excluded log."""
    return {'schema': SCHEMA, 'key': '', 'sha256': '', 'content': '', **_stated_fields(entry),
            'status': NO_EVIDENCE, 'reason': reason_text}


def _stated_fields(entry: FleetLog) -> dict[str, Any]:
    return {**asdict(entry), 'log': to_printable(entry.log)}


def _format_reason(error: Exception, path: str) -> str:
    if isinstance(error, MemoryError):
        return 'takes more memory than a worker may use; give --memory more, or a shorter log'
    if isinstance(error, InputError):
        return str(error).removeprefix(f'{to_printable(path)}: ')
    return describe_error(error)


def _record_key(task: LogTask, content: str) -> str:
    """Return a hash of all that the record depends on."""
    generator_state = None if task.generator is None else task.generator.bit_generator.state
    identity = [SCHEMA, __version__, task.technology, task.sample_rate, task.entry.log, content,
                generator_state]
    return hashlib.sha256(json.dumps(identity).encode()).hexdigest()


def _load_record(path: Path, key: str) -> dict[str, Any] | None:
    try:
        kept = json.loads(path.read_bytes())
        return kept if kept['key'] == key else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _calibrate_and_diagnose(task: LogTask) -> dict[str, Any]:
    path = task.entry.log
    log = (read_recording(path, rate=task.sample_rate) if is_recording(path)
           else read_log(path, rate=task.sample_rate))
    method, model, extra_values = calibrate_log(log, task.technology)
    temperature = (None if log.temperature is None or not np.isfinite(log.temperature).any()
                   else float(np.nanmean(log.temperature)))
    content = hashlib.sha256()
    for values in (getattr(log, quantity) for quantity in QUANTITIES):
        content.update(b'' if values is None else values.tobytes())
    offset = extra_values['time_offset']['value'] if extra_values else 0.0
    found: dict[str, Any] = {
        'content': content.hexdigest(), 'mean_temperature': temperature, 'status': DONE,
        'reason': '', 'method': method, 'samples': len(log),
        'duration_s': None if log.time is None else float(log.time[-1] - log.time[0]),
        'values': {**_value_records(model), **extra_values},
        'slow': {} if log.time is None else fit_slow_effects(log, offset),
        'noise': {name: float(value) for name, value in vars(model.noise).items()},
        'diagnosis': None, 'page': ''}
    if task.generator is not None:
        found |= _summarize_diagnosis(task, log)
    return found


def calibrate_log(log: Log,
                  technology: str = 'mems') -> tuple[str, GyroModel, dict[str, dict[str, Any]]]:
    """
    Return the method of calibration of a log, its model, and values that a model does not hold.

    A log in time with a reference heading is calibrated by `calibrate_encoder`, a log at rest
    gives the bias only, and any other one is calibrated by dwells.

    Raises
    ------
    DataRefused : with the reason and the remedy

    """
    if log.output is None:
        raise DataRefused('holds gyro_counts alone; convert them to gyro_dps')
    failed = mismatch_finding(check_gates(log, None))
    if failed is not None:
        raise DataRefused(f'{failed.evidence}: {failed.remedy}')
    if log.time is not None and log.reference_rate is None and log.reference_heading is not None:
        found = calibrate_encoder(log, technology=technology)
        offset = {} if math.isnan(found.fit.time_offset) else {'time_offset': _value_record(
            found.fit.time_offset, found.fit.time_offset_deviation, 's')}
        return found.method, found.model, offset
    refuse_unusable(log)
    if log.time is not None and is_at_rest(log):
        bias, deviation = _estimate_rest_bias(log)
        walk = (white_noise_deviation(log.output, order=1)
                * math.sqrt(float(np.median(np.diff(log.time)))))
        return 'rest', GyroModel((Term(BIAS, (bias,)),), np.array([[deviation ** 2]]),
                                 noise=Noise(angle_random_walk=walk)), {}
    table_quality = None if log.time is not None else inspect_record(log)
    if table_quality is not None and is_implausible_factor(table_quality.unit_factor):
        raise DataRefused(f'{table_quality.findings[0].evidence}: correct the unit or the sign of '
                          'the column of the gyro')
    return 'dwells', select_effects(extract_dwells(log), technology).calibration.model, {}


def _value_records(model: GyroModel) -> dict[str, dict[str, Any]]:
    """Return the fitted values of a model, by parameter where it is named as its effect."""
    return {parameter.name if parameter.name == effect else f'{effect}.{parameter.name}':
            _value_record(value, deviation, parameter.unit)
            for effect, parameter, value, deviation in model.estimates()}


def _value_record(value: float, deviation: float, unit: str) -> dict[str, Any]:
    return {'value': float(value), 'deviation': float(deviation), 'unit': unit}


def _summarize_diagnosis(task: LogTask, log: Log) -> dict[str, Any]:
    """Return a summary of the diagnosis, and write its page."""
    assert task.generator is not None
    try:
        found = (diagnose_table(log, None) if log.time is None
                 else diagnose([log], task.generator, names=[to_printable(task.entry.log)]))
    except (DataRefused, ArithmeticError, np.linalg.LinAlgError) as error:
        return {'diagnosis': {'verdict': 'refused',
                              'reason': _format_reason(error, task.entry.log), 'findings': []}}
    page = task.record_path.with_suffix('.html')
    write_atomically(page, render_report(found).encode())
    findings = [{'effect': each.effect, 'status': each.status, 'p_value': each.p_value,
                 'ambiguous_with': list(each.ambiguous_with),
                 'parameters': {name: value.to_dict() for name, value in each.parameters.items()}}
                for each in found.findings]
    return {'diagnosis': {'verdict': found.verdict, 'reason': '', 'findings': findings},
            'page': f'logs/{page.name}'}
