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

from gyro_calibration.logs.log import Log, read_log, read_log_blocks, write_log
from gyro_calibration.model.motion import ROBOT_MOTION
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
    monkeypatch.setattr('gyro_calibration.cli.verb.read_log_blocks',
                        lambda *given, **more: read_log_blocks(*given, rows=300, **more))


WORDS = {'plain': [], 'threshold': ['--threshold', '0.3'], 'inverted': ['--invert'],
         'at a rate': ['--rate', '100']}


@pytest.mark.parametrize('words', WORDS.values(), ids=WORDS)
def test_a_log_in_blocks_gives_the_columns_of_one_piece(model, tmp_path, words, request, run):
    write_robot(tmp_path / 'log.csv', 4001)
    lines = (tmp_path / 'log.csv').read_text().splitlines()
    for lost in (1, 2, *range(290, 1300), 4001):  # outputs of whole blocks and of the last row
        time, _, degc = lines[lost].split(',')
        lines[lost] = f'{time},nan,{degc}'
    (tmp_path / 'log.csv').write_text('\n'.join(lines) + '\n')
    answers = []
    for out in ('whole.csv', 'blocks.csv.gz'):
        code, text, _ = run('compensate', tmp_path / 'log.csv', '--model', model,
                            '--out', tmp_path / out, '--json', *words)
        assert code == 0
        answers.append(text.replace(out, ''))
        request.getfixturevalue('small_blocks')
    assert answers[0] == answers[1] and '"rows_without_output": 1013' in answers[0]
    whole, blocks = (read_log(tmp_path / out).others for out in ('whole.csv', 'blocks.csv.gz'))
    assert list(whole) == list(blocks) and len(whole) == 6
    for name in whole:
        np.testing.assert_allclose(np.array(blocks[name], float), np.array(whole[name], float),
                                   rtol=1e-12, err_msg=name)


def test_a_log_without_any_output_is_refused(model, tmp_path, small_blocks, run):
    (tmp_path / 'log.csv').write_text(
        'time_s,gyro_rad_s\n' + ''.join(f'{row},nan\n' for row in range(1000)))
    code, _, error = run('compensate', tmp_path / 'log.csv', '--model', model,
                         '--out', tmp_path / 'out.csv')
    assert (code == 1 and 'no gyro output is finite' in error
            and not (tmp_path / 'out.csv').exists())


@pytest.mark.parametrize('time, output, interval', [
    # a gap of 3 s, then only every other sample
    (np.cumsum([0.0, *np.full(499, 0.01), 3.0, *np.full(500, 0.02)]), np.zeros(1001), 0.01),
    # a table writes a row at 100 Hz, and the gyro has a value in one of ten
    (np.arange(2000) / 100.0, np.where(np.arange(2000) % 10, np.nan, 0.0), 0.1)],
    ids=['gaps', 'rows of others'])
def test_a_rate_is_as_noisy_as_samples_of_the_first_interval(
        tmp_path, small_blocks, run, time, output, interval):
    (tmp_path / 'model.yaml').write_text('effects: {}\nnoise: {angle_random_walk: 7.3e-4}')
    write_log(tmp_path / 'log.csv', Log(output=output, time=time))
    assert run('compensate', tmp_path / 'log.csv', '--model', tmp_path / 'model.yaml',
               '--out', tmp_path / 'out.csv')[0] == 0
    deviation = np.array(read_log(tmp_path / 'out.csv').others['rate_std_rad_s'], float)
    assert deviation[np.isfinite(output)] == pytest.approx(7.3e-4 / math.sqrt(interval), rel=1e-9)
