# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Logs of any length: compensate reads them in blocks, with memory independent of the length."""

import itertools
import math
import subprocess
import sys

from gyro_calibration.logs.log import Log, read_log_blocks
from gyro_calibration.model.gyro_model import GyroModel
from gyro_calibration.model.motion import ROBOT_MOTION
from gyro_calibration.model.noise import Noise
import numpy as np
import pytest

MODEL = (
    '\neffects:\n  rate_temperature_polynomial:\n'
    '    matrix_dps: [[2.0e-10, -3.0e-9, 1.0e-6, -2.0e-5], [-1.0e-8, 2.0e-7, -4.0e-5, 2.0e-3], '
    '[3.0e-7, -4.0e-6, 4.0e-3, -0.05]]\n'
    'valid: {rate: [-0.8, 0.8], temperature: [26.0, 45.0]}\n'
    'noise: {angle_random_walk: 7.3e-4}\n'
    'self_calibration: {scale_factor_error: 0.01, bias: 0.001, '
    'covariance: [[1.0e-6, 0.0], [0.0, 1.0e-8]]}\n')

#: Runs the program and then prints the peak memory of the process, KiB.
_MEASURED = """
import resource, sys
from gyro_calibration.cli.main import main
code = main(sys.argv[1:])
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
sys.exit(code)
"""


def write_robot(path, rows):
    """Write a log of the robot, which drives its way again and again."""
    time = np.arange(16000) * 0.01
    way = [f',{rate:.6f},{degc:.2f}\n'
           for rate, degc in zip(ROBOT_MOTION.rate_at(time), 35.0 + 12.0 * np.sin(time / 20.0))]
    with open(path, 'w') as file:
        file.write('time_s,gyro_rad_s,temperature_degc\n')
        file.writelines(f'{row / 100:.2f}{rest}'
                        for row, rest in zip(range(rows), itertools.cycle(way)))


@pytest.fixture
def model(tmp_path):
    path = tmp_path / 'model.yaml'
    path.write_text(MODEL)
    return path


def test_the_memory_does_not_grow_with_the_log(model, tmp_path):
    peaks = []
    for rows in (100_000, 400_000):
        write_robot(tmp_path / 'log.csv', rows)
        words = ['compensate', 'log.csv', '--model', model, '--out', 'out.csv',
                 '--threshold', '0.3']
        done = subprocess.run([sys.executable, '-c', _MEASURED, *map(str, words)],
                              capture_output=True, text=True, cwd=tmp_path)
        assert done.returncode == 0 and f'{rows} rows compensated' in done.stdout, done.stderr
        assert not done.stderr, 'a bar is for a terminal only'
        peaks.append(int(done.stdout.split()[-1]) / 1024)
    assert peaks[1] < peaks[0] + 14.0, 'MiB; half of what 300 000 more rows of twelve numbers are'


@pytest.fixture
def small_blocks(monkeypatch):
    """Let logs be read in blocks of 300 rows."""
    monkeypatch.setattr('gyro_calibration.cli.verb.BLOCK_ROWS', 300)
    monkeypatch.setattr('gyro_calibration.cli.verb.read_log_blocks',
                        lambda *given, **more: read_log_blocks(*given, rows=300, **more))


WORDS = {'plain': [], 'threshold': ['--threshold', '0.3'], 'inverted': ['--invert'],
         'at a rate': ['--rate', '100'], 'unwrapped': ['--unwrap']}


@pytest.mark.parametrize('words', WORDS.values(), ids=WORDS)
def test_a_log_in_blocks_gives_the_columns_of_one_piece(
        model, tmp_path, words, request, compensate):
    write_robot(tmp_path / 'log.csv', 4001)
    lines = (tmp_path / 'log.csv').read_text().splitlines()
    for lost in (1, 2, *range(290, 1300), 4001):  # outputs of whole blocks and of the last row
        time, _, degc = lines[lost].split(',')
        lines[lost] = f'{time},nan,{degc}'
    (tmp_path / 'log.csv').write_text('\n'.join(lines) + '\n')
    whole = compensate(tmp_path / 'log.csv', model, '--json', *words)
    request.getfixturevalue('small_blocks')
    blocks = compensate(tmp_path / 'log.csv', model, '--json', *words)
    assert whole.text == blocks.text and '"rows_without_output": 1013' in whole.text
    assert list(whole.columns) == list(blocks.columns) and len(whole.columns) == 6
    for name, values in whole.columns.items():
        np.testing.assert_allclose(blocks.columns[name], values, rtol=1e-12, err_msg=name)


def test_a_log_without_any_output_is_refused(model, small_blocks, compensate):
    done = compensate(Log(output=np.full(1000, np.nan), time=np.arange(1000.0)), model)
    assert done.code == 1 and 'no gyro output is finite' in done.error and done.log is None


@pytest.mark.parametrize('time, output, interval', [
    # a gap of 3 s, then only every other sample
    (np.cumsum([0.0, *np.full(499, 0.01), 3.0, *np.full(500, 0.02)]), np.zeros(1001), 0.01),
    # a table writes a row at 100 Hz, and the gyro has a value in one of ten
    (np.arange(2000) / 100.0, np.where(np.arange(2000) % 10, np.nan, 0.0), 0.1)],
    ids=['gaps', 'rows of others'])
def test_a_rate_is_as_noisy_as_samples_of_the_first_interval(
        small_blocks, compensate, time, output, interval):
    deviation = compensate(Log(output=output, time=time), GyroModel(noise=Noise(7.3e-4))).columns[
        'rate_std_rad_s']
    assert deviation[np.isfinite(output)] == pytest.approx(7.3e-4 / math.sqrt(interval), rel=1e-9)
