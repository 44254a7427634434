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
Compare estimators of scale factor error and bias with the Cramér-Rao bound, on 20 s of motion.

    python benchmarks/efficiency.py [RUNS]
    python benchmarks/efficiency.py methods [RUNS]

The built-in motion at 100 Hz against an encoder, which is read with each sample and starts
anywhere within a step; s = 3 %, b = 0.5 deg/s. Four cases: a fine and a coarse encoder, low and
high noise of the rate. Prints a table in Markdown: the mean square of the errors over each bound,
for s and for b; n runs determine it to sqrt(2 / n), 400 runs to 7 %. Each case has noise of its
own.

The bounds are those of Gaussian noise: white noise of the rate, which is a random walk of the
heading, an error of the encoder with the variance step²/12, and an unknown heading at the start,
time offset and lag. The nominal bound takes the encoder's errors for independent from sample to
sample. While the encoder rests, its error is constant: this gives less information on the heading
than in the nominal bound, and more on the bias. The other bound has one error for each rest,
independent from rest to rest.

While an encoder moves, its errors are of neither kind: they are known where it steps. So an
estimator that uses the steps may be better than both.

With `methods`, the three methods of self-calibration are compared on simulated runs of the Epson
XV-3500: the rms errors of docs/explanation/self_calibration.md.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
import sys

from gyro_calibration.calibration.likelihood import fit_likelihood
from gyro_calibration.calibration.self_calibration import fit_heading
from gyro_calibration.calibration.self_calibration import METHODS as SELF_CALIBRATIONS
from gyro_calibration.logs.log import Array, DEGREE
from gyro_calibration.model.motion import CALIBRATION_MOTION, Motion, motion_from_headings
from gyro_calibration.model.noise import simulate_noise
from gyro_calibration.model.presets import XV3500
import numpy as np
from scipy.signal import lfilter

INTERVAL = 0.01
TIME = np.arange(2001) * INTERVAL
HEADING, RATE = CALIBRATION_MOTION.heading_at(TIME), CALIBRATION_MOTION.rate_at(TIME)
SCALE_FACTOR_ERROR, BIAS = 0.03, 0.5 * DEGREE
#: Step of the encoder, rad, and standard deviation of the noise of one sample of the rate, rad/s.
CASES = {'0.088 deg, 0.02 deg/s': (0.088 * DEGREE, 0.02 * DEGREE),
         '0.088 deg, 0.5 deg/s': (0.088 * DEGREE, 0.5 * DEGREE),
         '5 deg, 0.02 deg/s': (5.0 * DEGREE, 0.02 * DEGREE),
         '5 deg, 0.5 deg/s': (5.0 * DEGREE, 0.5 * DEGREE)}


def fit_increments(time: Array, rate: Array, motion: Motion) -> tuple[float, float]:
    """Return (s, b) by least squares of the rate's increments on the raw ones of the encoder."""
    heading = motion.heading_at(time)
    turned = 0.5 * (rate[1:] + rate[:-1]) * np.diff(time)
    scale, bias = np.linalg.lstsq(np.column_stack([np.diff(heading), np.diff(time)]), turned,
                                  rcond=None)[0]
    return scale - 1.0, bias


def _of(fit: Callable) -> Callable:
    def values(time: Array, rate: Array, motion: Motion) -> tuple[float, float]:
        found = fit(time, rate, motion)
        return found.scale_factor_error, found.bias
    return values


METHODS = {'likelihood': _of(fit_likelihood),
           'cumulative least squares (Hong and Park, eq. 7)': _of(fit_heading),
           'least squares on increments': fit_increments}


def bound(step: float, noise: float, rests: bool) -> Array:
    """
    Return the Cramér-Rao bounds of the variances of (s, b), shape (2,).

    The encoder has one error for each rest, or one for each sample. The integral of the rate by
    the trapezoid rule has the noise of a random walk, except that each sample counts half at
    either side.
    """
    half = np.eye(len(TIME)) + np.eye(len(TIME), k=-1)
    half[0] = 0.0
    walk = np.cumsum(half, axis=0) * 0.5 * INTERVAL * noise
    walk[1:, 0] = 0.5 * INTERVAL * noise
    moves = np.abs(np.diff(HEADING, prepend=-1.0)) > 1e-12
    error = np.cumsum(moves) if rests else np.arange(len(TIME))
    covariance = walk @ walk.T + (1.0 + SCALE_FACTOR_ERROR) ** 2 * step ** 2 / 12.0 * (
        error[:, None] == error)
    matrix = np.column_stack([HEADING, TIME, np.ones(len(TIME)), RATE, np.gradient(RATE, TIME)])
    return np.diag(np.linalg.inv(matrix.T @ np.linalg.solve(covariance, matrix)))[:2]


def errors(step: float, noise: float, seed: int) -> Array:
    """Return the errors of (s, b) of each method in one run, shape (methods, 2)."""
    generator = np.random.default_rng([seed, round(1e6 * step), round(1e6 * noise)])
    rate = (1.0 + SCALE_FACTOR_ERROR) * RATE + BIAS + noise * generator.standard_normal(len(TIME))
    motion = motion_from_headings(TIME,
                                  np.round((HEADING + generator.uniform(0.0, step)) / step) * step)
    return np.array([method(TIME, rate, motion) for method in METHODS.values()]) - (
        SCALE_FACTOR_ERROR, BIAS)


def table(runs: int) -> str:
    """Return a table of mean squares of the errors of s and b over the nominal and other bound."""
    lines = ['| encoder step, noise | method | s over nominal bound | b | one error a rest: s | b '
             '| mean error of s |',
             '|---|---|---|---|---|---|---|']
    with ProcessPoolExecutor() as pool:
        for name, (step, noise) in CASES.items():
            found = np.array(list(pool.map(partial(errors, step, noise), range(runs),
                                           chunksize=10)))
            squares, limits = (found ** 2).mean(axis=0), [bound(step, noise, rests)
                                                          for rests in (False, True)]
            (s, b), rest = (np.sqrt(limit) * (100.0, 1.0 / DEGREE) for limit in limits)
            lines.append(f'| {name} | bound | {s:.5f} % | {b:.5f} deg/s | {rest[0]:.5f} % '
                         f'| {rest[1]:.5f} deg/s | |')
            for method, square, mean in zip(METHODS, squares, found.mean(axis=0)):
                ratios = ' | '.join(f'{ratio:.3g}' for ratio in np.concatenate(
                    [square / limit for limit in limits]))
                lines.append(f'| | {method} | {ratios} | {100.0 * mean[0]:+.4f} % |')
    return '\n'.join(lines)


# the three methods of self-calibration

def encoder(number: int) -> Motion:
    """Return the motion by an encoder with steps of 0.5 deg at 20 Hz, from a random start."""
    time, step = np.arange(401) / 20.0, 0.5 * DEGREE
    begin = np.random.default_rng([number, 1]).uniform(0.0, step)
    return motion_from_headings(
        time, np.round((CALIBRATION_MOTION.heading_at(time) + begin) / step) * step)


def compare_methods(runs: int = 200, lag: float = 0.2) -> str:
    """Return a table of the rms errors of each method; a robot lags behind the profile, s."""
    kept = np.exp(-INTERVAL / lag)
    cases = {
        'as the profile says': (RATE, lambda number: CALIBRATION_MOTION),
        'gyro 50 ms late': (CALIBRATION_MOTION.rate_at(TIME - 0.05),
                            lambda number: CALIBRATION_MOTION),
        f'robot lags by {lag} s': (lfilter([1.0 - kept], [1.0, -kept], RATE),
                                   lambda number: CALIBRATION_MOTION),
        'encoder, 0.5 deg, 20 Hz': (RATE, encoder)}
    lines = ['| run | method | rms error of s | rms error of b |', '|---|---|---|---|']
    for case, (rate, reference) in cases.items():
        outputs = [XV3500.model.output(rate, 25.0) + simulate_noise(
            XV3500.noise, len(TIME), INTERVAL, np.random.default_rng(run)) for run in range(runs)]
        for name, method in SELF_CALIBRATIONS.items():
            fits = [method(TIME, output, reference(run)) for run, output in enumerate(outputs)]
            s, b = np.sqrt(np.mean(np.square(
                [(fit.scale_factor_error, fit.bias) for fit in fits]
                - np.array([XV3500.scale_factor_error, XV3500.bias * DEGREE])), axis=0))
            lines.append(f'| {case} | `{name}` | {100 * s:.3f} % | {b / DEGREE:.4f} deg/s |')
    return '\n'.join(lines)


if __name__ == '__main__':
    if sys.argv[1:2] == ['methods']:
        print(compare_methods(*map(int, sys.argv[2:3])))
    else:
        print(table(int(sys.argv[1]) if len(sys.argv) > 1 else 400))
