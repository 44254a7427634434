# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The examples of the documents run as they stand, each once and in an empty folder."""

from functools import cache
import os
from pathlib import Path
import re
import subprocess
import sys

from gyro_calibration.logs.log import DEGREE, read_log
from gyro_calibration.model.model_file import read_model
import numpy as np
import pytest

FOLDER = Path(__file__).parents[1] / 'docs/examples'


@pytest.fixture(scope='module')
def ran(tmp_path_factory):
    @cache
    def ran(name):
        paths = [str(FOLDER.parents[1]), *filter(None, [os.environ.get('PYTHONPATH')])]
        environment = os.environ | {'PYTHONPATH': os.pathsep.join(paths)}
        command = [sys.executable, FOLDER / name]
        folder = tmp_path_factory.mktemp('example')
        result = subprocess.run(command, cwd=folder, env=environment, capture_output=True,
                                text=True, timeout=300)
        assert result.returncode == 0 and not result.stderr, result.stderr
        return folder, result.stdout
    return ran


@pytest.mark.parametrize('name', sorted(path.name for path in FOLDER.glob('*.py')))
def test_an_example_runs_and_says_something(ran, name):
    assert ran(name)[1].strip()


def test_the_written_model_can_be_read(ran):
    folder, _ = ran('write_a_model.py')
    model = read_model(folder / 'model.yaml')
    assert model.temperature_range == (25.0, 45.0) and model.uses_channel('temperature')


def test_the_self_calibration_is_in_the_written_model(ran):
    folder, _ = ran('self_calibrate_a_log.py')
    calibration = read_model(folder / 'model.yaml').self_calibration
    assert abs(calibration.scale_factor_error + 0.1) < 4 * calibration.standard_deviations[0]


def test_the_rate_table_gives_a_model_that_knows_the_true_rate(ran):
    folder, text = ran('rate_table.py')
    taken = set(re.findall(r'^(\w+) .* taken: predicts', text, re.MULTILINE))
    assert {'bias', 'sine_response', 'scale_factor_temperature'} <= taken
    model = read_model(folder / 'model.yaml')
    rate = float(text.split()[-2])
    output = 1.5 + 0.01 * DEGREE + np.sin(0.25 * 1.5) / 0.25 - 1.5 + 4e-4 * 5.0 * 1.5
    assert abs(rate - 1.5) < 1e-3 and abs(model.rate(output, 30.0) - rate) < 1e-5


def test_record_player_and_encoder_find_the_gyro(ran):
    text = ran('turntable.py')[1]
    for name, true in (('bias', 0.2), ('scale_factor_error', 1.3)):
        found = re.findall(rf'^{name} +(\S+) +(\S+) +\S+ to ', text, re.MULTILINE)
        assert len(found) == 2
        assert all(abs(float(value) - true) < 4.0 * float(deviation) for value, deviation in found)


def test_the_diagnosed_gyro_lags_behind_its_thermometer_and_another_drive_gains(ran):
    folder, text = ran('diagnose_a_log.py')
    off = [float(line.split()[-6])
           for line in text.splitlines() if line.startswith('Another drive')]
    lag, = (term.values for term in read_model(folder / 'model.yaml').terms
            if term.effect.name == 'thermal_lag')
    assert abs(lag[0] / 120.0 - 1.0) < 0.2 and abs(lag[1] / 2e-4 - 1.0) < 0.2
    assert off[1] < 0.3 * off[0] and (folder / 'report.html').exists()


def test_the_compensated_log_has_a_heading(ran):
    folder, _ = ran('compensate_a_log.py')
    assert {'rate_rad_s', 'heading_rad', 'heading_std_rad'} <= set(
        read_log(folder / 'compensated.csv').others)
