"""
The examples of the documents run as they stand, each in an empty folder.

"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from gyro_calibration.log import read_log
from gyro_calibration.model_file import read_model

FOLDER = Path(__file__).parents[1] / 'docs/examples'
QUICK = {'three_methods.py': ['2']}  # runs instead of 200


@pytest.fixture
def run(tmp_path):
    """Return a function that runs an example and gives what it prints."""
    def run(name):
        paths = [str(FOLDER.parents[1]), *filter(None, [os.environ.get('PYTHONPATH')])]
        environment = os.environ | {'PYTHONPATH': os.pathsep.join(paths)}
        command = [sys.executable, FOLDER / name, *QUICK.get(name, [])]
        result = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=60)
        assert result.returncode == 0 and not result.stderr, result.stderr
        return result.stdout
    return run


@pytest.mark.parametrize('name', sorted(path.name for path in FOLDER.glob('*.py')))
def test_an_example_runs_and_says_something(run, name):
    assert run(name).strip()


def test_the_written_model_can_be_read(run, tmp_path):
    run('write_a_model.py')
    model = read_model(tmp_path / 'model.yaml')
    assert model.temperature_range == (25.0, 45.0) and model.looks_at('temperature')


def test_the_self_calibration_is_in_the_written_model(run, tmp_path):
    run('self_calibrate_a_log.py')
    calibration = read_model(tmp_path / 'model.yaml').self_calibration
    assert abs(calibration.scale_factor_error + 0.1) < 4 * calibration.standard_deviations[0]


def test_the_compensated_log_has_a_heading(run, tmp_path):
    run('compensate_a_log.py')
    assert {'rate_rad_s', 'heading_rad', 'heading_std_rad'} <= set(read_log(tmp_path / 'compensated.csv').others)


def test_the_misprints_are_those_that_the_document_shows(run):
    text = (FOLDER.parent / 'self_calibration.md').read_text()
    lines = run('misprints.py').splitlines()
    assert lines and not [line for line in lines if line not in text]
