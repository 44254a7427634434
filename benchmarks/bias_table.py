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
from dataclasses import dataclass, replace
import math
import sys

from gyro_calibration.heading.bias_table import BiasTable, Prior
from gyro_calibration.logs.log import DEGREE
from gyro_calibration.model.gyro_model import GyroModel, SelfCalibration
from gyro_calibration.model.noise import Noise, simulate_noise
import numpy as np

#: Time between two rests, s.
STEP = 60.0
#: A cheap gyro (Hong and Park's XV3500, with a random walk besides).
NOISE = Noise(2.5 * DEGREE / 60.0, 18.0 * DEGREE / 3600.0, 1e-7)
#: Variance of a mean over 10 s by white noise, (rad/s)².
WHITE = NOISE.angle_random_walk ** 2 / 10.0
MODEL = GyroModel(noise=NOISE)
#: Standard deviation of the bias of a calibration, rad/s.
OWN = 0.011 * DEGREE
CALIBRATION = SelfCalibration(0.01, 1.0 * DEGREE, ((1e-6, 1e-8), (1e-8, OWN ** 2)),
                              '2026-01-01T00:00:00+00:00', 20.0, 'likelihood')


@dataclass(frozen=True)
class History:
    """Runs of a gyro; all arrays have shape (runs, rests)."""

    time: np.ndarray  # s
    temperature: np.ndarray  # degC
    bias: np.ndarray  # true, rad/s
    curve: object  # what of it the temperature makes, rad/s; a function of the temperature
    estimate: np.ndarray  # what a rest showed, rad/s
    outlier: np.ndarray  # whether that was off


def linear(generator, size=1.0):
    """Return a bias over temperature with one coefficient: a multiple of what the prior has."""
    slope = generator.normal(0.0, size * Prior().coefficient)
    return lambda temperature: slope * (temperature - 25.0)


def cubic(generator, size=1.0):
    """Return a bias over temperature whose slope is a parabola, alike."""
    first, second, third = generator.normal(0.0, size * Prior().coefficient / np.sqrt(3.0)
                                            * np.array([1.0, np.sqrt(3.0), np.sqrt(5.0)]))

    def curve(temperature):
        x = (temperature - 25.0) / 25.0
        return 25.0 * (first * x + second * x ** 2 / 2.0 + third * x ** 3 / 3.0)

    return curve


def simulate(generator, curve, runs=6, rests=30, turn_on=None, outliers=0.02, jump=0.0,
             noise=NOISE, prior=None):
    """
    Return runs of a gyro on as many days.

    Each begins between 10 and 25 degC and warms up by 3 to 20 K. Flicker, random walk and ageing
    go on between the runs; the bias turns on anew each day. An outlier is off by 0.1 to 1 deg/s.
    A jump comes early in the middle run, and stays.
    """
    prior = prior or Prior()
    turn_on = prior.turn_on if turn_on is None else turn_on
    day = 86400.0
    time = day * np.arange(runs)[:, None] + STEP * np.arange(rests) + 36000.0
    begin, rise = generator.uniform(10.0, 25.0, (runs, 1)), generator.uniform(3.0, 20.0, (runs, 1))
    temperature = begin + rise * (
        1.0 - np.exp(-STEP * np.arange(rests) / generator.uniform(300.0, 1200.0, (runs, 1))))
    drift = simulate_noise(Noise(0.0, noise.bias_instability, noise.rate_random_walk),
                           int(runs * day / 10.0), 10.0, generator)
    ageing = np.cumsum(generator.normal(0.0, prior.ageing * np.sqrt(1.0 / 365.25), runs))[:, None]
    steps = jump * (np.arange(runs * rests).reshape(runs, rests) >= runs // 2 * rests + rests // 6)
    bias = (curve(temperature) + generator.normal(0.0, turn_on, (runs, 1))
            + drift[(time / 10.0).astype(int) % len(drift)] + ageing + steps
            + generator.normal(0.0, 1.0 * DEGREE))
    outlier = generator.random((runs, rests)) < outliers
    off = (generator.choice([-1.0, 1.0], (runs, rests))
           * generator.uniform(0.1, 1.0, (runs, rests)) * DEGREE)
    estimate = (
        bias + generator.normal(0.0, np.sqrt(noise.angle_random_walk ** 2 / 10.0), (runs, rests))
        + outlier * off)
    return History(time, temperature, bias, curve, estimate, outlier)


def learn(table, history, run, rests=slice(None)):
    """Give a table what the rests of a run showed, and return what it said."""
    rows = zip(history.temperature[run, rests], history.estimate[run, rests],
               history.time[run, rests])
    return [table.add(temperature, bias, WHITE, time) for temperature, bias, time in rows]


def learned(history, runs):
    """Return a table after some runs, in the next."""
    table = BiasTable(MODEL)
    for run in range(runs):
        table.begin_run()
        learn(table, history, run)
    table.begin_run()
    return table


def answers(generator, curve, runs=5, rests=12, **given):
    """
    Ask a table at the begin of each run, and in its middle up to 8 K from the temperature there.

    Returns
    -------
    shape (runs, 10): error and standard deviation of the bias at the begin, of the bias in the
    middle, of the difference; the true difference, rad/s; then the number of outliers, of those
    held back, and of good estimates held back

    """
    history, table, rows = simulate(generator, curve, runs, rests, **given), BiasTable(MODEL), []
    for run in range(runs):
        table.begin_run()
        at_begin = _predicted(table, history, run, 0, 0.0)
        said = learn(table, history, run, slice(0, rests // 2))
        rest, further = rests // 2, generator.uniform(-8.0, 8.0)
        temperature, time = history.temperature[run, rest], history.time[run, rest]
        change = history.curve(temperature + further) - history.curve(temperature)
        difference, variance = table.bias_difference(temperature, temperature + further, time)
        middle = (*_predicted(table, history, run, rest, further), difference - change,
                  math.sqrt(variance), change)
        said = np.array(
            [bool(text) for text in said + learn(table, history, run, slice(rests // 2, None))])
        outlier = history.outlier[run]
        rows.append([*at_begin, *middle, outlier.sum(), said[outlier].sum(), said[~outlier].sum()])
    return np.array(rows)


def _predicted(table, history, run, rest, further):
    """Return what a prediction is off, rad/s, and its standard deviation."""
    temperature, time = history.temperature[run, rest], history.time[run, rest]
    bias, variance = table.predict(temperature + further, time)
    return (bias - history.bias[run, rest] - history.curve(temperature + further)
            + history.curve(temperature), math.sqrt(variance))


def carried_answers(generator, curve, runs=4, rests=12, **given):
    """
    Calibrate in the first run, and use that at the begin of a later one.

    Returns
    -------
    error and standard deviation of the bias, rad/s: without a table, and with one of the runs
    between, shape (2, 2)

    """
    history = simulate(generator, curve, runs, rests, **given)
    run, made = int(generator.integers(1, runs)), int(generator.integers(0, rests))
    calibration = replace(CALIBRATION, bias=history.bias[0, made] + generator.normal(0.0, OWN),
                          temperature=history.temperature[0, made])
    time, rows = history.time[run, 0], []
    for table in (BiasTable(MODEL), learned(history, run)):
        now, _ = table.propagate_calibration(calibration, time - history.time[0, made], time,
                                             history.temperature[run, 0])
        rows.append((now.bias - history.bias[run, 0], now.standard_deviations[1]))
    return np.array(rows)


def coverage(errors, deviations):
    """Return how often errors lie inside their interval of 95 %."""
    return float(np.mean(np.abs(errors) < 1.96 * deviations))


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
