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
Fit simulated dwells of gyros whose output is rounded to coarse steps.

    python benchmarks/coarse_output.py [RUNS [SEED]]
    python benchmarks/coarse_output.py runs [RUNS [SEED]]

The simulator is its own. A run has 1 to 4 sweeps of 3 to 20 rates, even or drawn, up to 10 or 100
deg/s both ways, of 3 to 12 s each with ramps of 1 s, at 10 to 100 Hz; steps of 0.02 to 0.5 deg/s;
s of 1 %, b of 0.3 deg/s and, in half of the runs, a temperature that rises by 10 K a sweep, with
slopes of 0.02 deg/s/K and 1e-4/K (standard deviations). It is a log with a reference rate, or a
table of the means of the dwells. The noise of a sample is a multiple of the step. Prints, for each
kind and noise, the share of biases b and scale factor errors s within their 95 % intervals, of
`fit` with all that it chooses and of these effects alone, how many are more than 5 standard
deviations off, and how often another effect of the rate is taken.

With `runs`, `self_calibrate` by 20 s of a known motion and 6 s of rest after it, at constant rates
or by hand, at 20 to 100 Hz; the steps are 1 to 20 times the noise of a sample.
"""

from __future__ import annotations

import math
import sys

from gyro_calibration import fit, Log, self_calibrate
import numpy as np
from scipy.ndimage import gaussian_filter1d, uniform_filter1d

DEGREE = math.pi / 180.0
NOISES = (0.0, 0.05, 0.15, 0.5, 2.0)  # of a sample, steps
TABLES = {'log': False, 'table': True}


def simulated(draw: np.random.Generator, noise: float,
              table: bool) -> tuple[Log, dict[str, float]]:
    """Return a log or a table, and its values."""
    fastest, count = draw.choice([10.0, 100.0]), int(draw.integers(3, 21))
    rates = (np.linspace(-fastest, fastest, count) if draw.random() < 0.5
             else np.round(draw.uniform(-fastest, fastest, count), 1))
    sweeps, frequency = int(draw.integers(1, 5)), draw.choice([10, 20, 50, 100])
    step = draw.choice([0.02, 0.1, 0.25, 0.5])
    length = int(draw.uniform(3.0, 12.0) * frequency) + 2 * frequency
    true = np.repeat(np.tile(rates, sweeps), length)
    box = np.ones(frequency) / frequency
    rate = np.convolve(np.pad(true, frequency, mode='edge'), box, mode='same')[
        frequency:-frequency]
    values = {'bias': 0.3 * draw.standard_normal(),
              'scale_factor_error': 0.01 * draw.standard_normal()}
    warm = None
    output = (1.0 + values['scale_factor_error']) * rate + values['bias']
    if draw.random() < 0.5:
        warm = 25.0 + 10.0 * np.repeat(np.arange(sweeps) - 0.5 * (sweeps - 1), count * length)
        output = output + (warm - 25.0) * (0.02 * draw.standard_normal()
                                           + 1e-4 * draw.standard_normal() * rate)
    output = step * np.round((output + noise * step * draw.standard_normal(len(rate))) / step)
    if not table:
        return Log(np.arange(len(rate)) / frequency, output * DEGREE,
                   reference_rate=rate * DEGREE, temperature=warm), values
    rows = [row[frequency:-frequency] for row in np.arange(len(rate)).reshape(-1, length)]
    return Log(None, np.array([output[row].mean() for row in rows]) * DEGREE,
               reference_rate=np.array([rate[row].mean() for row in rows]) * DEGREE,
               temperature=None if warm is None else warm[::length]), values


def errors(log: Log, values: dict[str, float],
           effects: list[str] | None) -> tuple[float, float, bool]:
    """Return normalized errors of b and s, and whether another effect of the rate is taken."""
    found = {effect: (value / DEGREE if effect == 'bias' else value,
                      deviation / DEGREE if effect == 'bias' else deviation)
             for effect, _, value, deviation in fit(log, effects=effects,
                                                    method='dwells').model.estimates()}
    b, s = ((found[name][0] - true) / found[name][1] for name, true in values.items())
    return b, s, any('temperature' not in name for name in found if name not in values)


def main(runs: int = 100, seed: int = 1) -> None:
    print('| data | noise of a sample, steps | b, s held | with all effects | beyond 5 sigma | '
          'refused | other effects taken |')
    print('|---|---|---|---|---|---|---|')
    for kind, table in TABLES.items():
        for noise in NOISES:
            of_two, of_all, refused = [], [], 0
            for number in range(runs):
                case = simulated(np.random.default_rng([seed, number]), noise, table)
                slopes = [] if case[0].temperature is None or np.ptp(
                    case[0].temperature) == 0.0 else ['bias_temperature',
                                                      'scale_factor_temperature']
                try:
                    of_two.append(errors(*case, [*case[1], *slopes]))
                    of_all.append(errors(*case, None))
                except ValueError:
                    refused += 1
            cells = []
            for found in (of_two, of_all):
                held = np.mean(np.abs(np.array(found)[:, :2]) < 1.96, axis=0)
                cells.append(f'{held[0]:.2f}, {held[1]:.2f}')
            beyond = (np.abs(np.array(of_two)[:, :2]) > 5.0).any(axis=1).sum()
            others = int(np.sum([each[2] for each in of_all]))
            print(f'| {kind} | {noise:g} | ' + ' | '.join(cells)
                  + f' | {beyond} | {refused} | {others} |', flush=True)


def run(kind: str, ratio: float, seed: int) -> np.ndarray:
    """Return errors of s and b in standard deviations, nan where the run is refused."""
    draw = np.random.default_rng([seed, len(kind), round(ratio)])
    frequency = int(draw.choice([20, 50, 100]))
    count = 20 * frequency
    if kind == 'hand':
        rate = gaussian_filter1d(draw.standard_normal(count), 0.25 * frequency)
        rate *= 60.0 / rate.std()
    else:
        rate = np.repeat(np.round(draw.uniform(-90.0, 90.0, 10)) * (draw.random(10) < 0.7),
                         2 * frequency)
    rest = 3 * frequency // 2
    rate[:rest] = rate[-rest:] = 0.0
    rate = uniform_filter1d(rate, frequency // 2)
    s, b = draw.uniform(-0.02, 0.02), draw.uniform(-0.5, 0.5)
    step = math.exp(draw.uniform(math.log(0.05), math.log(2.0)))
    output = (1.0 + s) * np.append(rate, np.zeros(6 * frequency)) + b
    output = step * np.round(output / step + draw.standard_normal(len(output)) / ratio)
    try:
        found = self_calibrate(Log(np.arange(len(output)) / frequency, output * DEGREE),
                               (np.arange(count) / frequency, rate * DEGREE))
    except ValueError:
        return np.full(2, np.nan)
    return np.array([(found.scale_factor_error - s) / found.scale_factor_error_std,
                     (found.bias - b * DEGREE) / found.bias_std])


def main_of_runs(runs: int = 20, seed: int = 1) -> None:
    print('| motion | steps, noises of a sample | s, b held | largest error of b | refused |')
    print('|---|---|---|---|---|')
    for kind in ('constant rates', 'hand'):
        for ratio in (1.0, 3.0, 8.0, 20.0):
            found = np.abs([run(kind, ratio, seed + number) for number in range(runs)])
            known = found[np.isfinite(found[:, 0])]
            held = np.mean(known < 1.96, axis=0)
            print(f'| {kind} | {ratio:g} | {held[0]:.2f}, {held[1]:.2f} '
                  f'| {known[:, 1].max():.3g} | {runs - len(known)} |', flush=True)


if __name__ == '__main__':
    of_runs = sys.argv[1:2] == ['runs']
    (main_of_runs if of_runs else main)(*(int(word) for word in sys.argv[1 + of_runs:3 + of_runs]))
