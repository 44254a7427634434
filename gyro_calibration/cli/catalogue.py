# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Effects of the user's own, from a Python file that the user names in the command line."""

from __future__ import annotations

from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

from gyro_calibration.cli.verb import UsageError
from gyro_calibration.diagnosis.causes import add_causes
from gyro_calibration.model.effects import add_effects


def load_effects(path: str) -> None:
    """
    Run a Python file and add the effects of its list EFFECTS to the catalogue.

    Only the command line names such a file; models and logs cannot.

    Raises
    ------
    UsageError : if the file cannot be run, or its effects cannot be used

    """
    spec = spec_from_file_location('effects_of_the_user', path)
    if spec is None or spec.loader is None or not Path(path).is_file():
        raise UsageError(f'{path} is not a Python file; wanted one, .py, with a list EFFECTS')
    module = module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
        add_effects(module.EFFECTS)
        add_causes(module.EFFECTS)
    except Exception as error:
        raise UsageError(f'{path} cannot be used as a catalogue ({type(error).__name__}: '
                         f'{error}); wanted EFFECTS, a list of gyro_calibration.model.effects.'
                         'Effect') from None
