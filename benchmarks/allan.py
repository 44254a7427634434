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
Compare the Allan deviation and its speed with allantools, and check the fitted noise figures.

    python benchmarks/allan.py [--study RUNS] [LOG.csv.gz]

The record is LOG at 100 Hz (by default the ADIS16405 of GYRO_CALIBRATION_DATA), or a million
simulated samples if there is none. The peers are allantools (``pip install allantools``; a message
says where it is missing) and plain numpy on cumulative sums. Times are medians of several repeats,
taken in turn. With --study, N, B, K, Q and R are fitted to simulated records of 200 000 samples;
the table states how often each is detected and how often its 95 % bounds hold. Prints tables in
Markdown.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
import importlib
import os
from pathlib import Path
import time

from gyro_calibration.allan.deviation import allan_deviation, averaging_sizes
from gyro_calibration.allan.noise_fit import fit_noise
from gyro_calibration.logs.log import read_log
from gyro_calibration.model.noise import Noise, simulate_noise
import numpy as np

INTERVAL = 0.01
RECORDING = 'mems_static/adis16405_1.csv.gz'


def record(path: str | None) -> tuple[str, np.ndarray]:
    """Return a name and a million samples, rad/s."""
    known = Path(os.environ.get('GYRO_CALIBRATION_DATA', '/nonexistent')) / RECORDING
    if path is None and not known.exists():
        return 'simulated', simulate_noise(Noise(7e-4, 1e-4, 1e-5), 1_000_000, INTERVAL,
                                           np.random.default_rng(0))
    chosen = Path(path) if path else known
    return chosen.name, read_log(chosen, rate=1.0 / INTERVAL).output


def plain(rate: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Return the deviations by whole arrays of cumulative sums, as one writes it down first."""
    angle = np.concatenate([[0.0], np.cumsum(rate - rate.mean())])

    def deviation(size: int) -> float:
        return float(np.sqrt(0.5 * np.mean(
            (angle[2 * size:] - 2.0 * angle[size:-size] + angle[:-2 * size]) ** 2)) / size)
    return np.array([deviation(size) for size in sizes.tolist()])


def peers(rate: np.ndarray, sizes: np.ndarray) -> dict[str, Callable[[], np.ndarray]]:
    """Return what computes the deviations, by name."""
    found = {'gyro_calibration, with bounds': lambda: allan_deviation(
        rate, INTERVAL, sizes * INTERVAL).deviation, 'plain numpy': lambda: plain(rate, sizes)}
    try:
        allantools = importlib.import_module('allantools')
    except ImportError:
        print('allantools is not installed, and left out; install it with: pip install '
              'allantools\n')
        return found
    found['allantools.oadev'] = lambda: allantools.oadev(
        rate, rate=1.0 / INTERVAL, data_type='freq', taus=sizes * INTERVAL)[1]
    return found


def seconds(works: dict[str, Callable[[], np.ndarray]], repeats: int) -> dict[str, list[float]]:
    """Return how long each took, s, taken in turn so that a busy machine disturbs all alike."""
    taken: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(repeats):
        for name, work in works.items():
            begin = time.perf_counter()
            work()
            taken[name].append(time.perf_counter() - begin)
    return taken


def speed_table(rate: np.ndarray, repeats: int) -> str:
    sizes = averaging_sizes(len(rate))
    works = peers(rate, sizes)
    last = list(works)[-1]
    wanted, taken = works[last](), seconds(works, repeats)
    lines = [f'| {len(rate)} samples, {len(sizes)} averaging times | median s | fastest s '
             f'| times as fast as {last} | largest relative difference to {last} |',
             '|---|---|---|---|---|']
    for name, work in works.items():
        median = np.median(taken[name])
        lines.append(f'| {name} | {median:.4f} | {min(taken[name]):.4f} '
                     f'| {np.median(taken[last]) / median:.2f} '
                     f'| {np.abs(work() / wanted - 1.0).max():.1e} |')
    return '\n'.join(lines)


#: (angle random walk, bias instability, rate random walk), quantization, rate ramp, simulated.
CASES = ((Noise(1e-3), 0.0, 0.0), (Noise(1e-3, 3e-4), 0.0, 0.0),
         (Noise(1e-3, 0.0, 1e-4), 0.0, 0.0), (Noise(1e-3, 3e-4, 3e-5), 0.0, 0.0),
         (Noise(1e-3, 3e-4, 2e-4), 0.0, 0.0), (Noise(1e-3), 3e-5, 0.0), (Noise(1e-3), 0.0, 3e-6))


def simulated(noise: Noise, quantization: float, ramp: float, samples: int,
              generator: np.random.Generator) -> np.ndarray:
    angle = generator.standard_normal(samples + 1) * quantization
    return (simulate_noise(noise, samples, INTERVAL, generator) + np.diff(angle) / INTERVAL
            + ramp * INTERVAL * np.arange(samples))


def study_table(runs: int, samples: int = 200_000) -> str:
    lines = [f'| simulated, {runs} records of {samples} samples | figure | seen | mean over truth '
             '| its standard deviation | bounds hold |',
             '|---|---|---|---|---|---|']
    for seed, (noise, quantization, ramp) in enumerate(CASES):
        generator = np.random.default_rng(seed)
        fits = [fit_noise(simulated(noise, quantization, ramp, samples, generator), INTERVAL)
                for _ in range(runs)]
        truths = dict(zip('NBKQR', (noise.angle_random_walk, noise.bias_instability,
                                    noise.rate_random_walk, quantization, ramp)))
        case = ', '.join(f'{symbol} {truth:g}' for symbol, truth in truths.items() if truth)
        for symbol, truth in truths.items():
            figures = [fit.figures[symbol] for fit in fits]
            seen = [figure.value / truth for figure in figures if figure.value and truth]
            holds = np.mean([figure.lower <= truth <= figure.upper for figure in figures])
            share = np.mean([bool(figure.value) for figure in figures])
            moments = f'{np.mean(seen):.3f} | {np.std(seen):.3f}' if seen else '|'
            lines.append(f'| {case} | {symbol} | {100 * share:.1f} % | {moments} '
                         f'| {100 * holds:.1f} % |')
    return '\n'.join(lines)


if __name__ == '__main__':
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('log', nargs='?', help='a record at rest, 100 Hz')
    parser.add_argument('--repeats', type=int, default=11)
    parser.add_argument('--study', type=int, default=0, metavar='RUNS',
                        help='records to simulate of each kind; default: none')
    given = parser.parse_args()
    name, rate = record(given.log)
    print(f'{name}:\n\n{speed_table(rate, given.repeats)}')
    if given.study:
        print(f'\n{study_table(given.study)}')
