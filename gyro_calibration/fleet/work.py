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

from collections.abc import Collection, Iterator
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
    bias_wander_columns,
    fit_noise_grid,
    heading_noise,
)
from gyro_calibration.calibration.selection import select_effects
from gyro_calibration.diagnosis.data_quality import inspect_record
from gyro_calibration.diagnosis.gates import (
    check_gates,
    is_at_rest,
    is_implausible_factor,
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
from gyro_calibration.logs.quality import bridge_gaps, white_noise_deviation
from gyro_calibration.logs.recording import read_recording
from gyro_calibration.logs.ros_bag import is_recording, list_recording_files
from gyro_calibration.model.effects import BIAS
from gyro_calibration.model.gyro_model import GyroModel, Term
from gyro_calibration.model.noise import Noise
import numpy as np

#: Shortest log for slow effects and for the bias at rest, s.
_MIN_LOG_DURATION = 60.0
#: Status of a log that was calibrated, and of one that is excluded.
DONE, NO_EVIDENCE = 'done', 'no evidence'
#: Schema of the records; records of another one are not read.
SCHEMA = 'gyro_calibration/fleet_log/2'


class _SpanFit:
    """Increments of the heading over spans of a log; `edges` of the spans are in s."""

    def __init__(self, log: Log, time_offset: float, heading: tuple[Array, Array] | None):
        """Take time and heading, s and rad, of a reference; None at rest."""
        assert log.time is not None and log.output is not None
        known = np.isfinite(log.output)
        time = log.time[known] - time_offset
        # 60 spans of at least 2 s
        self.edges = np.arange(time[0], time[-1] + 1e-9, max((time[-1] - time[0]) / 60.0, 2.0))
        self._turns: list[Array] = []
        rate = np.zeros(len(self.edges))
        if heading is not None:
            place = np.searchsorted(heading[0], self.edges).clip(0, len(heading[0]) - 1)
            self.edges = heading[0][np.unique(place)]
            true = np.interp(self.edges, *heading)
            self._turns = [np.diff(true)]
            rate = np.gradient(true, self.edges) if len(true) > 1 else 0.0 * true
        self._increments = np.diff(
            np.interp(self.edges, time, integrate(time, log.output[known])))
        noise = heading_noise(self.edges, rate)
        self._noise = noise if self._turns else noise[:1]

    def fit(self, *column: Array) -> tuple[float, float]:
        """Fit scale factor error, bias and a column; return the last value and its deviation."""
        found = fit_noise_grid(
            self._increments, np.column_stack([*self._turns, np.diff(self.edges), *column]),
            self._noise, *bias_wander_columns(self.edges),
            noisy_column=0 if self._turns else None, wandering_value=len(self._turns))
        return float(found.values[-1]), float(found.deviations[-1])


def _duration(log: Log) -> float:
    """Return the time from the first to the last output, s; 0 with less than 100 of them."""
    assert log.time is not None and log.output is not None
    time = log.time[np.isfinite(log.output)]
    return float(time[-1] - time[0]) if len(time) >= 100 else 0.0


def fit_slow_effects(log: Log, time_offset: float = 0.0,
                     names: Collection[str] | None = None) -> dict[str, dict[str, Any]]:
    """
    Return the slow effects of a log in time, by name: value, standard deviation and unit.

    The log has a reference, which the gyro lags by the time offset, s, or is at rest. `names` are
    those of the effects; None for all.

    """
    assert log.time is not None
    heading = None
    if log.reference_heading is not None and np.isfinite(log.reference_heading).sum() > 1:
        known = np.isfinite(log.reference_heading)
        heading = log.time[known], log.reference_heading[known]
    elif log.reference_rate is not None and np.isfinite(log.reference_rate).any():
        heading = log.time, integrate(log.time, bridge_gaps(log.reference_rate))
    if _duration(log) < _MIN_LOG_DURATION:
        return {}
    spans, found = _SpanFit(log, time_offset, heading), {}
    if len(spans.edges) < 10:
        return {}
    for name, unit, angle in _slow_effects(log, spans.edges):
        if names is None or name in names:
            value, deviation = spans.fit(np.diff(angle))
            if math.isfinite(deviation) and deviation > 0.0:
                found[name] = _value_record(value, deviation, unit)
    return found


def _slow_effects(log: Log, time: Array) -> Iterator[tuple[str, str, Array]]:
    """Give name, unit and integral over time of each effect, to some constant."""
    assert log.time is not None
    elapsed = time - log.time[0]
    yield 'rate_ramp', 'rad/s²', 0.5 * (elapsed - 0.5 * elapsed[-1]) ** 2
    for constant in (60.0, 300.0):  # s; the same for all logs, as they are pooled
        yield f'warm_up_{constant:.0f}s', 'rad/s', -constant * np.exp(-elapsed / constant)
    if log.temperature is not None and np.ptp(log.temperature) > 0.0:  # False with nan
        angle = integrate(log.time, log.temperature - log.temperature.mean())
        yield 'bias_temperature', 'rad/s/K', np.interp(time, log.time, angle)


@dataclass(frozen=True)
class LogTask:
    """The work on a log, with its options."""

    entry: FleetLog
    folder: str  # of the results
    technology: str = 'mems'  # of the gyros, one of `heading_regression.TECHNOLOGY_PRIORS`
    file_pattern: re.Pattern[str] | None = None  # by `table.compile_file_pattern`
    #: For the diagnosis, the same for each log; None without a diagnosis.
    generator: np.random.Generator | None = None
    default_type: str = ''  # of logs whose type is not stated
    sample_rate: float | None = None  # Hz, of logs without a usable time

    @property
    def record_path(self) -> Path:
        """Return the path of the stored record; its name is unique for the path of the log."""
        stem = re.sub(r'[^A-Za-z0-9_.-]', '_', Path(self.entry.log).name.partition('.')[0])
        path = os.path.abspath(self.entry.log).encode(errors='surrogateescape')
        name = f'{stem[:60]}-{hashlib.sha256(path).hexdigest()[:8]}.json'
        return Path(self.folder) / 'logs' / name


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
        state = None if task.generator is None else task.generator.bit_generator.state
        identity = [SCHEMA, __version__, task.technology, task.sample_rate, task.entry.log,
                    content, state]  # all that the record depends on
        key = hashlib.sha256(json.dumps(identity).encode()).hexdigest()
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
    method, model, offset = calibrate_log(log, task.technology)
    # by parameter where it is named as its effect
    values = {parameter.name if parameter.name == effect else f'{effect}.{parameter.name}':
              _value_record(value, deviation, parameter.unit)
              for effect, parameter, value, deviation in model.estimates()}
    if offset is not None:
        values['time_offset'] = _value_record(*offset, 's')
    temperature = (None if log.temperature is None or not np.isfinite(log.temperature).any()
                   else float(np.nanmean(log.temperature)))
    content = hashlib.sha256()
    for column in (getattr(log, quantity) for quantity in QUANTITIES):
        content.update(b'' if column is None else column.tobytes())
    found: dict[str, Any] = {
        'content': content.hexdigest(), 'mean_temperature': temperature, 'status': DONE,
        'reason': '', 'method': method, 'samples': len(log),
        'duration_s': None if log.time is None else float(log.time[-1] - log.time[0]),
        'values': values,
        'slow': {} if log.time is None else fit_slow_effects(log, offset[0] if offset else 0.0),
        'noise': {name: float(value) for name, value in vars(model.noise).items()},
        'diagnosis': None, 'page': ''}
    return found if task.generator is None else {**found, **_summarize_diagnosis(task, log)}


def _value_record(value: float, deviation: float, unit: str) -> dict[str, Any]:
    return {'value': float(value), 'deviation': float(deviation), 'unit': unit}


def calibrate_log(log: Log, technology: str = 'mems') -> tuple[str, GyroModel,
                                                               tuple[float, float] | None]:
    """
    Return the method of calibration of a log, its model, and the time offset of its reference.

    A log in time with a reference heading is calibrated by `calibrate_encoder`, which finds the
    offset and its standard deviation, s; a log at rest gives the bias only, and any other one is
    calibrated by dwells.

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
        offset = found.fit.time_offset, found.fit.time_offset_deviation
        return found.method, found.model, None if math.isnan(offset[0]) else offset
    refuse_unusable(log)
    if log.time is not None and is_at_rest(log):
        if _duration(log) < _MIN_LOG_DURATION:
            raise DataRefused(f'rests for less than {_MIN_LOG_DURATION:.0f} s: record for longer')
        bias, deviation = _SpanFit(log, 0.0, None).fit()
        walk = (white_noise_deviation(log.output, order=1)
                * math.sqrt(float(np.median(np.diff(log.time)))))
        return 'rest', GyroModel((Term(BIAS, (bias,)),), np.array([[deviation ** 2]]),
                                 noise=Noise(angle_random_walk=walk)), None
    table_quality = None if log.time is not None else inspect_record(log)
    if table_quality is not None and is_implausible_factor(table_quality.unit_factor):
        raise DataRefused(f'{table_quality.findings[0].evidence}: correct the unit or the sign of '
                          'the column of the gyro')
    return 'dwells', select_effects(extract_dwells(log), technology).calibration.model, None


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
