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
The state of a robot in files: the gyro model, the last self-calibration, biases at rest.

The calibration file is a model file with the effects that were in use at the calibration. If they
differ from the model in use, the self-calibration is not used.
"""

from __future__ import annotations

import math
import os
from pathlib import Path

from gyro_calibration.calibration.self_calibration import RunLimits
from gyro_calibration.files import (
    describe_error, file_version, keep_aside, remedy, to_printable)
from gyro_calibration.heading.bias_table import BiasTable, Prior, read_bias_table, write_bias_table
from gyro_calibration.model.gyro_model import (
    GyroModel, have_same_effects, SelfCalibration, with_self_calibration)
from gyro_calibration.model.model_file import ModelError, ModelNotFound, read_model, write_model
from gyro_calibration.model.noise import Noise
from gyro_calibration.model.settings_file import InvalidValue


class StateStore:
    """
    The files of one gyro: its model, empty if it cannot be read, and its table of biases at rest.

    `problem` says why the rates are uncalibrated; each hint names a fault of a file, or is ''.
    """

    def __init__(self, model_file: str, calibration_file: Path, bias_file: Path, prior: Prior,
                 max_bias: float = RunLimits.max_bias):
        """Read the files; a model with a bias beyond the largest one, rad/s, is a fault."""
        self._max_bias = max_bias
        self._calibration_file, self._bias_file = calibration_file, bias_file
        self.problem = self.calibration_hint = ''
        self.table_written_time: float | None = None
        self.model = self._load_model(model_file)
        self._is_unused = bool(self.calibration_hint)  # what the calibration file contains
        self.table, self.table_hint = BiasTable(self.model, prior), ''
        if not self.problem:
            self.table, self.table_hint = read_bias_table(bias_file, self.model, prior)
        self.shared_hint = ''
        self._file_versions = {file: _existing_version(file)
                               for file in (calibration_file, bias_file)}

    def poll(self) -> None:
        """Check whether another process has written to the files; to be called periodically."""
        for file, seen in self._file_versions.items():
            found = _existing_version(file)
            if found is not None and found != seen:
                self.shared_hint = to_printable(
                    f'{file} was written by another process: give each node a calibration_file '
                    'of its own, or restart this one to use that file')

    def _load_model(self, model_file: str) -> GyroModel:
        model = GyroModel()
        try:
            if model_file:
                read = read_model(os.path.expanduser(model_file))
                refuse_implausible_model(read, self._max_bias)
                model = read
        except (ModelError, InvalidValue) as error:
            named = '' if isinstance(error, ModelError) else f'{model_file}: '
            self.problem = f'uncalibrated: {named}{error}'
            return model
        try:
            stored = read_model(self._calibration_file)
        except ModelNotFound:
            return model
        except ModelError as error:
            self.calibration_hint = f'the last self-calibration is not used: {error}'
            return model
        theirs, ours = (each.gyro.get('serial_number', '') for each in (stored, model))
        fault = ''
        if stored.self_calibration is None:
            fault = 'the file has none; it may be truncated'
        elif not have_same_effects(stored, model):
            fault = 'it belongs to another model'
        elif theirs != ours:
            fault = (f'it belongs to the gyro with the serial number {theirs or "(none)"}, and '
                     f'the model to {ours or "(none)"}')
        else:
            try:
                refuse_implausible_model(stored, self._max_bias)
            except InvalidValue as error:
                fault = str(error)
        if fault:
            self.calibration_hint = to_printable(
                f'the self-calibration in {self._calibration_file} is not used: {fault}; '
                'calibrate again')
            return model
        return with_self_calibration(model, stored.self_calibration)

    def store_calibration(self, calibration: SelfCalibration) -> str:
        """Use and store a calibration; return a fault, or where an unused file is kept, or ''."""
        self.model, self.calibration_hint = with_self_calibration(self.model, calibration), ''
        kept = ''
        try:
            if self._is_unused and self._calibration_file.is_file():
                kept, self._is_unused = keep_aside(self._calibration_file), False
            self._file_versions[self._calibration_file] = write_model(self._calibration_file,
                                                                      self.model)
            self.shared_hint = ''
        except (OSError, ArithmeticError) as error:
            wanted = (remedy(error, self._calibration_file) if isinstance(error, OSError)
                      else 'check the rates')
            self.calibration_hint = to_printable(
                f'the calibration is in use but NOT STORED ({describe_error(error)}): {wanted}, '
                'and calibrate again')
        return self.calibration_hint or kept

    def store_table(self, now: float, is_final: bool = False) -> None:
        """Write the bias table if it is due, and at the end; `now` in s since 1970."""
        if self.problem or not self.table.is_write_due(now, is_final):
            return
        try:
            self.table_hint, written = write_bias_table(self._bias_file, self.table, now)
            self.table_written_time, self.shared_hint = now, ''
            self._file_versions[self._bias_file] = written
        except OSError as error:
            self.table.mark_write(now, is_written=False)
            self.table_hint = to_printable(f'the bias table cannot be written '
                                           f'({describe_error(error)}): '
                                           f'{remedy(error, self._bias_file)}')


def refuse_implausible_model(model: GyroModel, max_bias: float) -> None:
    """Raise `InvalidValue` for a bias, scale factor or noise that no gyro of a robot has."""
    limits = {'scale_factor_error': (RunLimits.max_scale_factor_error, 'a fraction, not in %'),
              'bias': (max_bias, 'in rad/s; calibration.maximum_bias allows another one')}
    given = [('effects.' + term.effect.name, term.effect.name, term.values[0])
             for term in model.terms]
    if model.self_calibration:
        given += [('self_calibration', name, getattr(model.self_calibration, name))
                  for name in limits]
    for group, name, value in given:
        if name in limits and not abs(value) <= limits[name][0]:
            limit, remedy = limits[name]
            raise InvalidValue(f'{group}.{name}', value,
                               f'at most {limit:.4g} of either sign, {remedy}')
    for name, value in vars(model.noise).items():
        if not math.sqrt(Noise(**{name: value}).heading_variance(1.0)) < math.pi / math.sqrt(3.0):
            raise InvalidValue(f'noise.{name}', value, 'SI units, rad and s: with this noise the '
                               'heading is unknown within 1 s')


def _existing_version(file: Path) -> tuple[int, int] | None:
    try:
        return file_version(file)
    except OSError:
        return None
