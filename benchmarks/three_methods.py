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
Compare the three methods of self-calibration on simulated runs.

The numbers are those of docs/explanation/self_calibration.md.

    python benchmarks/three_methods.py [RUNS]

"""

from collections.abc import Callable
import sys

from gyro_calibration.calibration.self_calibration import METHODS
from gyro_calibration.logs.log import Array, DEGREE
from gyro_calibration.model.effects import BIAS, SCALE_FACTOR_ERROR
from gyro_calibration.model.gyro_model import GyroModel, Term
from gyro_calibration.model.motion import CALIBRATION_MOTION, Motion, motion_from_headings
from gyro_calibration.model.noise import Noise, simulate_noise
import numpy as np
from scipy.signal import lfilter

#: What Hong and Park (2008) report of the Epson XV-3500.
GYRO = GyroModel((Term(BIAS, (2.18e-4,)), Term(SCALE_FACTOR_ERROR, (0.0373,))),
                 noise=Noise(7.27e-4, 8.73e-5))
TRUE = np.array([0.0373, 2.18e-4])
TIME = np.arange(2001) / 100.0
LAG = 0.2  # s


def encoder(number: int) -> Motion:
    """Return the motion by an encoder with steps of 0.5 deg at 20 Hz, from a random start."""
    time, step = np.arange(401) / 20.0, 0.5 * DEGREE
    begin = np.random.default_rng([number, 1]).uniform(0.0, step)
    return motion_from_headings(
        time,
        np.round((CALIBRATION_MOTION.heading_at(time) + begin) / step) * step)


def profile(_: int) -> Motion:
    """Return the profile; it is the same in each run."""
    return CALIBRATION_MOTION


def lagging() -> Array:
    """Return the rates of a robot that follows the profile by a first-order lag."""
    kept = np.exp(-0.01 / LAG)
    return lfilter([1.0 - kept], [1.0, -kept], CALIBRATION_MOTION.rate_at(TIME))


def errors(true_rate: Array, reference: Callable[[int], Motion], runs: int) -> dict[str, Array]:
    """Return the errors of s and b of each method against the reference, shape (runs, 2)."""
    found = {name: np.empty((runs, 2)) for name in METHODS}
    for number in range(runs):
        noise = simulate_noise(GYRO.noise, len(TIME), 0.01, np.random.default_rng(number))
        output = GYRO.output(true_rate, 25.0) + noise
        for name, method in METHODS.items():
            fit = method(TIME, output, reference(number))
            found[name][number] = fit.scale_factor_error, fit.bias
    return {name: values - TRUE for name, values in found.items()}


def main(runs='200'):
    cases = {
        'as the profile says': (CALIBRATION_MOTION.rate_at(TIME), profile),
        'gyro 50 ms late': (CALIBRATION_MOTION.rate_at(TIME - 0.05), profile),
        f'robot lags by {LAG} s': (lagging(), profile),
        'encoder, 0.5 deg, 20 Hz': (CALIBRATION_MOTION.rate_at(TIME), encoder),
    }
    print('| run | method | rms error of s | rms error of b |\n|---|---|---|---|')
    for case, (rate, reference) in cases.items():
        for name, error in errors(rate, reference, int(runs)).items():
            s, b = np.sqrt(np.mean(error ** 2, axis=0))
            print(f'| {case} | `{name}` | {100 * s:.3f} % | {b / DEGREE:.4f} deg/s |')


if __name__ == '__main__':
    main(*sys.argv[1:])
