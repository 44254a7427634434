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
The public interface: the functions of the command line for scripts and notebooks.

All quantities are in SI: s, rad, rad/s; temperatures are in degC. Each function takes a `Log` and
returns a record that prints its answer, as the verb of the same name does. Data that allow no
answer raise `DataRefused`, files that cannot be read `LogError` or `ModelError`, arguments that
are not possible `InputError`; all of them are a `ValueError` whose text says what to do.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from html import escape
import math
from pathlib import Path
import reprlib
from typing import Any

from gyro_calibration.calibration.encoder import calibrate
from gyro_calibration.calibration.selection import TECHNOLOGY_PRIORS
from gyro_calibration.calibration.self_calibration import default_reference_errors, ReferenceErrors
from gyro_calibration.cli import plots
from gyro_calibration.cli.allan import find_noise_figures, NoiseFigures
from gyro_calibration.cli.compensate import CompensatedLog, integrate_log, track_log
from gyro_calibration.cli.diagnose import diagnose_logs, write_diagnosis
from gyro_calibration.cli.fit import Fitted
from gyro_calibration.cli.self_calibrate import calibrate_run, Run
from gyro_calibration.cli.verb import PrintedResult
from gyro_calibration.diagnosis.findings import Diagnosis
from gyro_calibration.diagnosis.gates import REFERENCE_KINDS, refuse_mismatch
from gyro_calibration.diagnosis.report import render_report
from gyro_calibration.diagnosis.words import terminal_lines
from gyro_calibration.files import InputError
from gyro_calibration.heading.integration import integrate, Threshold
from gyro_calibration.logs.log import (
    Array, DEGREE, Log, log_from_table, unwrap_reference, write_log)
from gyro_calibration.logs.recording import read_file, Topics
from gyro_calibration.model import model_file
from gyro_calibration.model.effects import STATIC_EFFECTS
from gyro_calibration.model.gyro_model import GyroModel
from gyro_calibration.model.model_file import parse_model, write_model
from gyro_calibration.model.motion import Motion, motion_by_name, motion_from_log
from gyro_calibration.model.motion import simulate as simulate_motion
import numpy as np

__all__ = ['GyroModel', 'Log', 'allan', 'compensate', 'diagnose', 'fit', 'read_log', 'read_model',
           'self_calibrate', 'simulate', 'track', 'write_log', 'write_model']

#: A motion by its name or file, as (time, rate) in s and rad/s, or as the reference of a log.
_MotionLike = str | Path | tuple[Any, Any] | Log | Motion


def read_log(source: Any, columns: Mapping[str, str] = {}, *, axis: str = 'z',
             rate: float | None = None, sensitivity: float | None = None, unwrap: bool = False,
             topic: str | None = None, reference_topic: str | None = None,
             temperature_topic: str | None = None) -> Log:
    """
    Read a log.

    Parameters
    ----------
    source : a file in the log format (.csv, .csv.gz), a ROS 2 recording (folder, .mcap, .db3), or
        a table: a pandas DataFrame, or a mapping of names to arrays
    columns : quantity -> name, or name:unit, where columns have names of other programs, such as
        ``{'time': 't:ms', 'gyro': 'wz:deg/s', 'heading': 'yaw:deg'}``; without a unit SI;
        or 'attitude' -> the names of a quaternion, ``qw/qx/qy/qz``, whose rotation about the axis
        becomes the reference heading
    axis : x, y or z: the axis of the gyro, for a gyro or an attitude with three
    rate : sample rate, Hz, for a file whose times are not usable
    sensitivity : rad/s a count, for files with raw counts
    unwrap : remove jumps by whole turns from the reference heading
    topic, reference_topic, temperature_topic : of a recording; None takes the only gyro, no
        reference, and the temperature whose name is nearest to that of the gyro

    Returns
    -------
    Log
        The log in SI.

    """
    log = (read_file(source, Topics(topic, reference_topic, temperature_topic, axis), rate,
                     sensitivity, columns) if isinstance(source, (str, Path))
           else log_from_table(source, columns, axis))
    if not unwrap or log.reference_heading is None:
        return log
    _require_time(log)
    return unwrap_reference(log)


def read_model(source: str | Path | Mapping[str, Any]) -> GyroModel:
    """
    Return the model of a file, or of a mapping with the same keys; `ValueError` if it is none.

    ``read_model({'effects': {'bias': {'bias': 0.002}}, 'noise': {'angle_random_walk': 7e-4}})``
    is a gyro with a bias and white noise.
    """
    return (parse_model(dict(source)) if isinstance(source, Mapping)
            else model_file.read_model(source))


def simulate(model: GyroModel, motion: _MotionLike = 'robot', *, sample_rate: float = 100.0,
             seed: int | None = None, temperature: Any = None) -> Log:
    """
    Return the log of a simulated gyro, with the true rate and heading as reference.

    Parameters
    ----------
    model : effects and noise of the gyro
    motion : ``calibration`` (20 s), ``robot`` (160 s), ``rest`` (60 s), a profile file, (time,
        rate) in s and rad/s, or a log whose reference is the motion
    sample_rate : Hz
    seed : seed of the noise; None simulates without noise
    temperature : degC, one value or one for each sample, shape (n,)

    Returns
    -------
    Log
        Output and temperature of the gyro, with the true rate and heading.

    """
    _require_model(model)
    if not (isinstance(sample_rate, (int, float)) and 0.0 < sample_rate < math.inf):
        raise InputError(f'sample_rate is {sample_rate!r}; wanted a number of Hz above 0')
    generator = None if seed is None else np.random.default_rng(seed)
    return simulate_motion(model, _to_motion(motion)[0], sample_rate, generator, temperature)


@dataclass(frozen=True)
class Headings(PrintedResult):
    """Rates and heading of a log, corrected by a model; nan where the output was not plausible."""

    log: Log  # the log as it was given
    rate: Array  # corrected rate, rad/s, shape (n,)
    rate_std: Array  # its standard deviation, rad/s, shape (n,)
    heading: Array | None  # integral of the rate, from 0, rad, shape (n,); None without time
    heading_std: Array | None  # its standard deviation, rad, shape (n,)
    #: All columns that `gyro_calibration compensate` adds, by name.
    columns: Mapping[str, Array] = field(repr=False)

    def __str__(self) -> str:
        if self.heading is None or self.heading_std is None:
            return f'{len(self.log)} rows corrected.'
        return (f'{len(self.log)} rows corrected. Heading at the end: '
                f'{self.heading[-1] / DEGREE:.2f} +- {self.heading_std[-1] / DEGREE:.2f} deg.')

    def write(self, path: str | Path) -> None:
        """Write the log with the new columns, .csv or .csv.gz."""
        write_log(path, self.log, self.columns)

    def plot(self, path: str | Path | None = None) -> Any:
        """Return a figure of the heading, with the reference where the log has one."""
        time, output = _require_time(self.log)
        assert self.heading is not None
        known = np.isfinite(output) & np.isfinite(self.heading)
        raw = integrate(time[known], output[known])
        reference = self.log.reference_heading
        true = (self.heading[known] if reference is None
                else reference[known] - reference[np.isfinite(reference)][0])
        return plots.draw_headings(path, time[known], true, {
            'as reported': raw, 'corrected': self.heading[known]})


def compensate(log: Log, model: GyroModel) -> Headings:
    """
    Correct the rates of a log by a model, and integrate them to a heading.

    Raises `ValueError` if no row of the log has a plausible output.
    """
    _require_logs(log)
    _require_model(model)
    return _make_headings(log, integrate_log(log, model, Threshold(0.0), 'the log'))


def track(log: Log, model: GyroModel, *, hindsight: bool = False) -> Headings:
    """
    Estimate the heading of a log as the node does: constant at rest, where it estimates the bias.

    Parameters
    ----------
    log : a log in time
    model : a model with an angle random walk, which `allan` determines
    hindsight : smooth the heading by all later samples

    Returns
    -------
    Headings
        Corrected rates and headings with their standard deviations.

    """
    _require_time(log)
    _require_model(model)
    if not model.noise.angle_random_walk:
        raise InputError('the model has no angle random walk, by which rests are found; '
                         'allan finds it in a log at rest')
    return _make_headings(log, track_log(log, model, hindsight, 'the log'))


def _make_headings(log: Log, found: CompensatedLog) -> Headings:
    columns = found.columns
    return Headings(log, columns['rate_rad_s'], columns['rate_std_rad_s'],
                    columns.get('heading_rad'), columns.get('heading_std_rad'), columns)


def self_calibrate(log: Log, motion: _MotionLike | None = None, model: GyroModel | None = None, *,
                   method: str = 'likelihood') -> Run:
    """
    Determine scale factor error and bias from about 20 s of known motion.

    Parameters
    ----------
    log : log of the run, beginning within 1 s of the motion
    motion : the motion that was driven, as for `simulate`; None takes the reference of the log
    model : model by which the log is corrected first, with its noise; None is an ideal gyro
    method : likelihood, heading or rate

    Returns
    -------
    Run
        The two values with their standard deviations, and the model with them.

    """
    model = GyroModel() if model is None else model
    _require_model(model)
    begin = _require_time(log)[0][0]
    _require_choice('method', method, ('likelihood', 'heading', 'rate'))
    driven, reference_begin = _to_motion(log if motion is None else motion)
    return (calibrate_run(log, model, driven, reference_begin, method, ReferenceErrors())
            if motion is None else
            calibrate_run(log, model, driven, begin, method, default_reference_errors(driven)))


def fit(*logs: Log, effects: Sequence[str] | None = None, technology: str | None = None,
        method: str | None = None) -> Fitted:
    """
    Calibrate a gyro by a rate table, a turntable, or any log with a reference.

    Parameters
    ----------
    logs : logs of one gyro
    effects : names of the effects to fit; None selects those that the data support
    technology : open_loop_fog, closed_loop_fog or mems; decides between effects that the data do
        not distinguish
    method : dwells, likelihood or course; None selects it by the references of the logs

    Returns
    -------
    Fitted
        The model, and the fit.

    """
    _require_logs(*logs)
    for name in effects or ():
        _require_choice('effects', name, STATIC_EFFECTS)
    _require_choice('technology', technology, TECHNOLOGY_PRIORS)
    _require_choice('method', method, ('dwells', 'likelihood', 'course'))
    for log in logs:
        refuse_mismatch(log)
    found = calibrate({str(number): log for number, log in enumerate(logs)},
                      [STATIC_EFFECTS[name] for name in effects or ()], method, technology)
    return Fitted(replace(found.model, gyro={'technology': technology} if technology else {}),
                  found)


def allan(log: Log) -> NoiseFigures:
    """
    Determine the noise figures of a gyro from a log at rest, by its Allan deviation.

    Raises `ValueError` if the gyro moved, is dead, or has uneven stamps.
    """
    _require_time(log)
    return find_noise_figures(log)


@dataclass(frozen=True)
class Diagnosed(PrintedResult):
    """The error of a simulation against a log, and its causes."""

    model: GyroModel  # the extended model; the given one where no extension is offered
    found: Diagnosis = field(repr=False)  # findings, gates, gain and so on, as in diagnosis.json

    @property
    def causes(self) -> tuple[str, ...]:
        """Return the names of the causes, the strongest first."""
        return tuple(finding.effect for finding in self.found.findings)

    def __str__(self) -> str:
        return '\n'.join(terminal_lines(self.found))

    def _repr_html_(self) -> str:
        """Return the report in a frame, which keeps its style to itself."""
        return (f'<iframe srcdoc="{escape(render_report(self.found))}" '
                'style="width: 100%; height: 45em; border: 0"></iframe>')

    def plot(self, path: str | Path | None = None) -> Any:
        """Return a figure of the residual along the variables of the causes, before and after."""
        return plots.draw_diagnosis(path, self.found)

    def write(self, folder: str | Path) -> None:
        """Write diagnosis.json, report.html and model.yaml into a folder."""
        write_diagnosis(folder, self.found)


def diagnose(*logs: Log, model: GyroModel | None = None, seed: int = 0, kind: str | None = None,
             time_limit: float | None = None) -> Diagnosed:
    """
    Measure the error of a simulation against logs, name the causes, extend the model.

    Parameters
    ----------
    logs : logs of one gyro, each with a reference, or at rest; or a single rate table
    model : model of the simulation; None is an ideal gyro with the bias and scale factor error
        that fit the logs best
    seed : seed of the noise that fills gaps
    kind : kind of the reference: rate_command, encoder, motion_capture, course, odometry, gyro or
        rest; None detects it
    time_limit : the search for causes ends after half of it, s, and what was found is confirmed

    Returns
    -------
    Diagnosed
        The causes, and the extended model.

    """
    _require_logs(*logs)
    if model is not None:
        _require_model(model)
    _require_choice('kind', kind, REFERENCE_KINDS)
    found = diagnose_logs(logs, model, seed, kind, time_limit=time_limit)
    return Diagnosed(found.model, found)


def _require_choice(argument: str, value: str | None, choices: Collection[str]) -> None:
    if value is not None and value not in choices:
        raise InputError(f'{argument} is {value!r}, but must be of {", ".join(choices)}')


def _require_logs(*logs: Log) -> None:
    for log in logs or (None,):
        if not isinstance(log, Log):
            raise InputError(f'{reprlib.repr(log)} is no log; read_log(path) reads one, and '
                             'Log(time, output) makes one')
        if log.output is None or not len(log):
            raise InputError('the log has no output of the gyro; Log(time, output) has one')


def _require_model(model: GyroModel) -> None:
    if not isinstance(model, GyroModel):
        raise InputError(f'{reprlib.repr(model)} is no model; read_model(path) reads one')


def _require_time(log: Log) -> tuple[Array, Array]:
    _require_logs(log)
    if log.time is None or log.output is None:
        raise InputError('the log has no time, which this needs; Log(time, output) has one')
    return log.time, log.output


def _to_motion(motion: _MotionLike) -> tuple[Motion, float]:
    """Return a motion, and the time of its beginning in a log, s."""
    if isinstance(motion, Motion):
        return motion, 0.0
    if isinstance(motion, (str, Path)):
        return motion_by_name(motion), 0.0
    if isinstance(motion, tuple) and len(motion) == 2:
        return replace(motion_from_log(Log(motion[0], reference_rate=motion[1]))[0],
                       name='profile'), 0.0
    if not isinstance(motion, Log):
        raise InputError(f'{reprlib.repr(motion)} is no motion; wanted calibration, robot or '
                         'rest, a profile file, (time, rate), or a log with a reference')
    return motion_from_log(motion)
