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
Measure how often a diagnosis could find a slow effect of which it knows all but size and noise.

    python benchmarks/unknown_noise.py [--nulls N] [--logs N] [--seed N]

Each log has 15 min of 1 s means, and one effect with its true shape is the only candidate. Its
size is a multiple of 4.8 standard deviations of an estimate with known noise, of which 97.6 % are
found at 1.2 times. The evidence is that of the search, averaged over its grid of noises. The
columns `level` are the false alarms without the effect over the nominal rate of one cause.
"""

import argparse
import os

os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

from gyro_calibration.diagnosis.regression import build_problem, RegressionProblem  # noqa: E402
from gyro_calibration.diagnosis.replay import (  # noqa: E402
    coefficient_angles,
    cosine_transform,
    NoiseShape,
    replay,
)
from gyro_calibration.logs.log import Log  # noqa: E402
import numpy as np  # noqa: E402  (after the number of its threads is set)
from scipy.special import logsumexp  # noqa: E402
from scipy.stats import chi2  # noqa: E402

TIME, SIGMAS, MULTIPLES = np.arange(900.0), 4.8, (1.2, 2.0, 5.0)
RATE = 0.006 / 39  # of one of 39 causes
EFFECTS = {
    'rate ramp': TIME, **{f'warm-up of {tau} s': np.exp(-TIME / tau) for tau in (50, 150, 300)},
    **{f'bias step at {at} s': (at <= TIME) * 1.0 for at in (225, 450)},
    'two temperature waves': np.cos(TIME / 111.0) + 0.3 * np.cos(TIME / 40.0),
    'fast motion': np.cos(2.0 * np.pi * TIME / 9.7)}
#: Noises whose slow part rises out of the white one at an averaging time of some s.
NOISES = {
    'white': NoiseShape(), 'flicker': NoiseShape(flicker_corner=0.00451),
    **{f'walk, {at} s': NoiseShape(walk_ratio=3.0 / at ** 2) for at in (30, 100, 250)}}


def evidences(problem: RegressionProblem, columns: np.ndarray, left: np.ndarray) -> np.ndarray:
    """Return the evidence of each whitened column (p, m) in a whitened residual (m,)."""
    count = len(left)
    squares = problem.products(left[None], left[None])[:, 0, 0]
    likelihood = -0.5 * (count * np.log(squares) + problem.log_determinants)
    pull = problem.products(columns, left[None])[:, :, 0].T
    products = np.array([problem.products(each[None], each[None])[:, 0, 0] for each in columns])
    scale = 0.5 * (np.log(squares) - np.log(products))
    change = scale - 0.5 * (count - 1) * np.log1p(-pull ** 2 / products / squares)
    return (logsumexp(likelihood + change, axis=1) - logsumexp(likelihood)
            - scale[:, likelihood.argmax()])


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or '').strip().splitlines()[0])
    parser.add_argument('--nulls', type=int, default=4000, help='logs without an effect')
    parser.add_argument('--logs', type=int, default=200, help='logs of each effect and size')
    parser.add_argument('--seed', type=int, default=0)
    given = parser.parse_args()
    generator = np.random.default_rng(given.seed)
    log = Log(time=TIME, output=generator.standard_normal(len(TIME)))
    problem = build_problem([replay(log, np.ones(len(TIME), bool), generator)])
    columns = np.array([cosine_transform(each) for each in EFFECTS.values()]) / problem.deviation
    angle, least = coefficient_angles(len(TIME)), 0.5 * float(chi2.isf(RATE, 1))
    print(f'| noise | effect | level |{"|".join(f" {each:g} times, % " for each in MULTIPLES)}|')
    print(f'|---|---|{"---:|" * (1 + len(MULTIPLES))}')
    for noise, shape in NOISES.items():
        deviation = np.sqrt(shape.variance(angle, 1.0)) / problem.deviation
        alarms = np.mean([evidences(problem, columns, deviation * generator.standard_normal(
            len(angle))) > least for _ in range(given.nulls)], axis=0)
        for effect, column, alarm in zip(EFFECTS, columns, alarms):
            size = SIGMAS / np.linalg.norm(column / deviation)
            found = [np.mean([evidences(
                problem, column[None], deviation * generator.standard_normal(len(angle))
                + multiple * size * column)[0] > least for _ in range(given.logs)])
                for multiple in MULTIPLES]
            print(f'| {noise} | {effect} | {alarm / RATE:.1f} '
                  f'|{"|".join(f" {100.0 * each:.0f} " for each in found)}|', flush=True)


if __name__ == '__main__':
    main()
