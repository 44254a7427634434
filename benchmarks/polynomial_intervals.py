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
How often the 95 % intervals of the polynomial of Ojeda, Chung and Borenstein hold the truth.

    python benchmarks/polynomial_intervals.py [TABLES]

Simulated rate tables of 16 sweeps at as many temperatures, 13 rates up to 100 deg/s: an error that
is a polynomial of the output (order 3) and of temperature (order 2), noise of each dwell, and a
scale that scatters from dwell to dwell and from sweep to sweep. Prints how often the intervals of
the values hold, and those of the rate at all rates and temperatures of the table.

"""

from __future__ import annotations

import math
import sys

from gyro_calibration.calibration.dwells import Dwells
from gyro_calibration.calibration.rate_table import channels_of, fit_effects
from gyro_calibration.model.effects import rate_temperature_polynomial
import numpy as np

DEGREE = math.pi / 180.0
DWELL, DWELL_SCALE, SWEEP_SCALE = 0.01 * DEGREE, 7e-4, 3e-4


def table(generator: np.random.Generator) -> tuple[Dwells, np.ndarray]:
    """Return a rate table, and the true error of each dwell, rad/s."""
    sweep = np.repeat(np.arange(16), 13)
    rate = np.tile(np.linspace(-100.0, 100.0, 13), 16) * DEGREE
    temperature = 37.0 + 12.0 * generator.permutation(16)[sweep] / 15.0
    warm = (temperature - 43.0) / 6.0
    output = rate
    for _ in range(30):  # the error looks at the output
        w = output / (100.0 * DEGREE)
        error = (0.006 + 0.1 * w + 0.012 * w ** 2 - 3.3 * w ** 3 + warm *
                 (-0.24 * w) + 0.02 * warm ** 2 * w) * DEGREE
        output = rate + error
    noise = DWELL * generator.standard_normal(
        len(rate)) + rate * (DWELL_SCALE * generator.standard_normal(len(rate)) +
                             SWEEP_SCALE * generator.standard_normal(16)[sweep])
    return Dwells(rate, output + noise, temperature, np.full(len(rate), np.nan), sweep,
                  ('', ) * len(rate)), output


def main(tables: int) -> None:
    """Print the shares."""
    held_rates, reference, fits = [], [], []
    for seed in range(tables):
        dwells, output = table(np.random.default_rng(seed))
        found = fit_effects(dwells, [rate_temperature_polynomial(3, 2)])
        model = found.model
        at = channels_of(dwells).with_rate(dwells.rate, output)
        sensitivity = np.array(model.terms[0].sensitivity(at))
        deviation = np.sqrt(np.einsum('ik,ij,jk->k', sensitivity, model.covariance, sensitivity))
        held_rates.append(np.abs(model.error(at) - (output - dwells.rate)) < 1.96 * deviation)
        # the true values in the convention (centre, scale) of this fit
        columns = np.array(model.terms[0].sensitivity(at)).T
        true = np.linalg.lstsq(columns, output - dwells.rate, rcond=None)[0]
        values = np.array(
            [model.terms[0].values[place] for place in model.terms[0].fitted_indices])
        reference.append(np.abs(values - true) < 1.96 * np.sqrt(np.diag(model.covariance)))
        fits.append(np.sqrt(np.diag(model.covariance)))
    by_value = 100.0 * np.mean(reference, axis=0)
    print(f'{tables} tables: intervals of the values hold in {by_value.mean():.1f} % (by value '
          f'from {by_value.min():.0f} to '
          f'{by_value.max():.0f} %), of the rate in {100.0 * np.mean(held_rates):.1f} %; largest '
          'standard deviation of a value, median '
          f'{np.median(np.max(fits, axis=1)) / DEGREE:.3f} deg/s')


if __name__ == '__main__':
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 100)
