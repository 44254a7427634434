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
Measure the coverage of 95 % intervals of scale factor error and bias with a wandering bias.

    python benchmarks/encoder_intervals.py [RUNS]

Ten minutes at 20 Hz to and fro, an encoder of 0.088 deg, s = 2 %, b = 0.3 deg/s at the beginning,
white noise of 0.3 deg/sqrt(h). Prints a table in Markdown. The true bias is the one at the
beginning, from which it wanders; for the drift with temperature it is the mean over the log, which
is the best for a model without a term for it.

"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
import sys

from gyro_calibration.calibration.encoder import calibrate_encoder
from gyro_calibration.logs.log import Array, DEGREE, Log
from gyro_calibration.model.motion import Motion, motion_from_rates
from gyro_calibration.model.noise import Noise, simulate_noise
import numpy as np

SCALE_FACTOR_ERROR, BIAS, STEP, INTERVAL = 0.02, 0.3 * DEGREE, 0.088 * DEGREE, 0.05
WHITE, FLICKER, WALK = 0.3 * DEGREE / 60, 20 * DEGREE / 3600, 1.0 * DEGREE / 3600
#: Noise, and drift of the bias with the temperature, rad/s, as the gyro warms up with a time
#: constant of a third of the log.
CASES = {'white': (Noise(WHITE), 0.0), 'white, flicker': (Noise(WHITE, FLICKER), 0.0),
         'white, rate random walk': (Noise(WHITE, 0.0, WALK), 0.0),
         'white, flicker, rate random walk': (Noise(WHITE, FLICKER, WALK), 0.0),
         'white, flicker, drift with temperature': (Noise(WHITE, FLICKER), 0.03 * DEGREE)}


def swing(duration: float, generator: np.random.Generator, half: float = 4.0) -> Motion:
    """Return a motion to and fro at 55 to 65 deg/s, each way in `half` s, with rests of 0.4 s."""
    starts = np.arange(0.0, duration, half)
    knots = (starts[:, None] + (0.0, 0.3, half - 0.7, half - 0.4)).ravel()
    speeds = np.where(np.arange(len(starts)) % 2, -1.0,
                      1.0) * generator.uniform(55.0, 65.0, len(starts)) * DEGREE
    return motion_from_rates(knots, (speeds[:, None] * (0.0, 1.0, 1.0, 0.0)).ravel())


def simulated(noise: Noise, drift: float, generator: np.random.Generator,
              duration: float) -> tuple[Log, Array]:
    """Return a log, and the true (s, b)."""
    time = np.arange(round(duration / INTERVAL)) * INTERVAL
    motion = swing(duration, generator)
    warming = drift * (1.0 - np.exp(-3.0 * time / duration))
    output = (1.0 + SCALE_FACTOR_ERROR) * motion.rate_at(time) + BIAS + warming + simulate_noise(
        noise, len(time), INTERVAL, generator)
    heading = np.round((motion.heading_at(time) + generator.uniform(0.0, STEP)) / STEP) * STEP
    return (Log(output=output, time=time, reference_heading=heading),
            np.array([SCALE_FACTOR_ERROR, BIAS + warming.mean()]))


def run(case: tuple[str, int, float]) -> Array:
    """Return error and standard deviation of s and b of one run, shape (2, 2)."""
    name, seed, duration = case
    log, truth = simulated(*CASES[name], np.random.default_rng([seed, list(CASES).index(name)]),
                           duration)
    fit = calibrate_encoder(log).fit
    return np.array([(fit.scale_factor_error, fit.bias) - truth, np.sqrt(np.diag(fit.covariance))])


def table(runs: int, duration: float = 600.0) -> Iterator[str]:
    yield '| noise | s within | b within | rms error of s | stated | rms error of b | stated |'
    yield '|---|---|---|---|---|---|---|'
    with ProcessPoolExecutor() as pool:
        for name in CASES:
            found = np.array(list(pool.map(run, [(name, seed, duration) for seed in range(runs)],
                                           chunksize=5)))
            within = 100.0 * (np.abs(found[:, 0]) < 1.96 * found[:, 1]).mean(axis=0)
            (s, b), (s_stated,
                     b_stated) = np.sqrt((found ** 2).mean(axis=0)) * (100.0, 1.0 / DEGREE)
            yield (f'| {name} | {within[0]:.1f} % | {within[1]:.1f} % | {s:.5f} % '
                   f'| {s_stated:.5f} % | {b:.5f} deg/s | {b_stated:.5f} deg/s |')


if __name__ == '__main__':
    for line in table(int(sys.argv[1]) if len(sys.argv) > 1 else 400):
        print(line, flush=True)
