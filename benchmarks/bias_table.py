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

    python benchmarks/bias_table.py [GYROS] [--sizes]

Gyros of known truth have one run a day of 12 minutes, in which the gyro warms up by 3 to 20 K,
with a rest of 10 s each minute. The bias has flicker (18 deg/h), a random walk, ageing, another
turn-on bias each day (0.05 deg/s by default), and a temperature coefficient with a standard
deviation of 0.03 deg/s/K (by default), constant over temperature (linear) or a parabola over 0 to
50 degC (cubic). 2 % of the rests are outliers, off by 0.1 to 1 deg/s. The table is evaluated at
the start of each run, and in its middle up to 8 K away from the temperature there. Prints two
tables in Markdown, in percent and deg/s. Each row has noise of its own.

With --sizes, one table compares the sizes of coefficient and turn-on scatter between which the
bias table decides, on the same gyros: the share inside 95 % and the score, -log of the probability
density of the truth in units of 1 / (deg/s) with errors counted up to 5 standard deviations, of
the bias at the start of a run and of the difference. Less is better.

"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
import sys

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / 'test'))

from bias_history import answers, carried_answers, coverage, cubic, linear  # noqa: E402
from gyro_calibration.heading import bias_table  # noqa: E402
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


#: Sizes of coefficient and turn-on scatter, in units of the prior, with their probability.
COEFFICIENTS, TURN_ONS = {0.1: 0.4, 1.0: 0.6}, {0.3: 0.3, 1.0: 0.5, 4.0: 0.2}
SIZES = {'20': ({0.03: 0.1, 0.1: 0.1, 0.3: 0.2, 1.0: 0.6},
                {0.1: 0.2, 0.5: 0.3, 1.0: 0.2, 2.0: 0.2, 5.0: 0.1}),
         '6': (COEFFICIENTS, TURN_ONS),
         '4': (COEFFICIENTS, {0.5: 0.7, 4.0: 0.3}),
         '2 coefficients': (COEFFICIENTS, {1.0: 1.0}),
         '2 turn-ons': ({1.0: 1.0}, {0.5: 0.5, 3.0: 0.5}),
         '1': ({1.0: 1.0}, {1.0: 1.0})}


def sizes_row(number: int, gyros: int) -> str:
    """Return shares and scores on the same gyros with each of the sizes."""
    (name, curve, size, given), cells = CASES[number], list[str]()
    for coefficients, turn_ons in SIZES.values():
        bias_table._SIZES = np.array([(each, other) for each in coefficients
                                      for other in turn_ons])
        bias_table._SIZE_PROBABILITIES = np.outer(list(coefficients.values()),
                                                  list(turn_ons.values())).ravel()
        generators = [np.random.default_rng([200 + number, gyro]) for gyro in range(gyros)]
        asked = np.array([answers(each, curve(each, size), **given) for each in generators])
        for place in (0, 4):
            error, deviation = asked[:, 1:, place], asked[:, 1:, place + 1]
            score = np.log(deviation / DEGREE) + 0.5 * np.minimum((error / deviation) ** 2, 25.0)
            cells.append(f'{100 * coverage(error, deviation):.0f} {score.mean():.2f}')
    pairs = (', '.join(pair) for pair in zip(cells[::2], cells[1::2]))
    return f'| {name} | {" | ".join(pairs)} |'


def compare_sizes(gyros: int) -> None:
    """Print the table of sizes."""
    print(f'| gyro | {" | ".join(SIZES)} |\n|' + '---|' * (1 + len(SIZES)))
    for number in range(len(CASES)):
        print(sizes_row(number, gyros), flush=True)


def main(gyros: int) -> None:
    """Print both tables."""
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
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('gyros', type=int, nargs='?', default=100)
    parser.add_argument('--sizes', action='store_true')
    parsed = parser.parse_args()
    (compare_sizes if parsed.sizes else main)(parsed.gyros)
