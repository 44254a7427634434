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
Measure the accuracy of a bias table: coverage, gain, outliers, jumps, updated calibrations.

    python benchmarks/bias_table.py [GYROS]

Gyros of known truth have one run a day of 12 minutes, in which the gyro warms up by 3 to 20 K,
with a rest of 10 s each minute. The bias has flicker (18 deg/h), a random walk, ageing, another
turn-on bias each day (0.05 deg/s by default), and a temperature coefficient with a standard
deviation of 0.03 deg/s/K (by default), constant over temperature (linear) or a parabola over 0 to
50 degC (cubic). 2 % of the rests are outliers, off by 0.1 to 1 deg/s. The table is evaluated at
the start of each run, and in its middle up to 8 K away from the temperature there. Prints two
tables in Markdown, in percent and deg/s. Each row has noise of its own.

"""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
import sys

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / 'test'))

from bias_history import answers, carried_answers, coverage, cubic, linear  # noqa: E402
from gyro_calibration.logs.log import DEGREE  # noqa: E402

#: Name, curve, size of the coefficient, and what else is simulated.
CASES = [('linear', linear, 1.0, {}), ('cubic', cubic, 1.0, {}),
         ('linear, 0.003 deg/s/K', linear, 0.1, {}), ('cubic, 0.003 deg/s/K', cubic, 0.1, {}),
         ('cubic, turns on within 0.01 deg/s', cubic, 1.0, {'turn_on': 0.01 * DEGREE}),
         ('cubic, turns on within 0.2 deg/s', cubic, 1.0, {'turn_on': 0.2 * DEGREE}),
         ('linear, a jump by 0.5 deg/s', linear, 1.0, {'jump': 0.5 * DEGREE}),
         ('cubic, a jump by 0.5 deg/s', cubic, 1.0, {'jump': 0.5 * DEGREE}),
         ('cubic, no outliers', cubic, 1.0, {'outliers': 0.0})]


def row(number: int, gyros: int) -> str:
    """Return what tables of some gyros answered."""
    (name, curve, size, given), generator = CASES[number], np.random.default_rng(number)
    asked = np.array([answers(generator, curve(generator, size), **given) for _ in range(gyros)])
    shares = [coverage(asked[:, 1:, place], asked[:, 1:, place + 1]) for place in (0, 2, 4)]
    off, change = np.abs(asked[:, 2:, 4]) / DEGREE, np.abs(asked[:, 2:, 6]) / DEGREE
    outliers, held, wrong = asked[..., 7:].sum(axis=(0, 1))
    shown = ' | '.join(f'{100 * share:.1f}' for share in shares)
    return (f'| {name} | {shown} | {np.median(off):.4f} | {np.median(change):.4f} '
            f'| {np.sqrt(np.mean(off ** 2)):.4f} | {np.sqrt(np.mean(change ** 2)):.4f} '
            f'| {held:.0f} of {outliers:.0f} | {wrong / gyros:.2f} |')


def carried_row(number: int, gyros: int) -> str:
    """Return how calibrations did in a later run."""
    (name, curve, size, given), generator = CASES[number], np.random.default_rng(100 + number)
    carried = np.array([carried_answers(generator, curve(generator, size), **given)
                        for _ in range(gyros)])
    shown = ' | '.join(f'{100 * coverage(*carried[:, place].T):.1f} '
                       f'| {np.sqrt(np.mean(carried[:, place, 0] ** 2)) / DEGREE:.4f}'
                       for place in range(2))
    return f'| {name} | {shown} |'


def main(gyros: int) -> None:
    print('| gyro | inside, begin of a run | inside, bias | inside, difference '
          '| median error of the difference | of none | rms | of none | outliers held back '
          '| good ones held back, a gyro |\n|' + '---|' * 10)
    numbers = range(len(CASES))
    with ProcessPoolExecutor() as pool:
        for line in pool.map(row, numbers, [gyros] * len(CASES)):
            print(line, flush=True)
        print('\n| gyro | inside, carried without a table | rms error | inside, with a table '
              '| rms error |\n|' + '---|' * 5)
        for line in pool.map(carried_row, numbers, [4 * gyros] * len(CASES)):
            print(line, flush=True)


if __name__ == '__main__':
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 100)
