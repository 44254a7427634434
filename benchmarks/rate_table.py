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
How well calibrations predict rate tables: a measured one, and later campaigns.

    GYRO_CALIBRATION_DATA=FOLDER python benchmarks/rate_table.py
    GYRO_CALIBRATION_DATA=FOLDER python benchmarks/rate_table.py campaigns [CAMPAIGNS]

The first command fits each calibration to the recording of an open-loop fibre-optic gyro without
one sweep and tests it on that, for all 24 sweeps; and fits it to dwells slower than 60 deg/s and
tests it on the others, up to 101 deg/s. The default selects the effects anew from the fitted data.
Prints a table in Markdown, root mean squares in deg/s.

For campaigns, 6 to 12 neighbouring sweeps of the recording are one, limited to rates below 45 to
75 deg/s or not; the sweeps after it, hotter and at all rates, are the other one. Then CAMPAIGNS
(default: 40) are simulated: an open-loop fibre-optic gyro or a MEMS one, whose bias and scale
factor curve over temperature and change from sweep to sweep; fitted at 20 to 32 degC and up to 60
deg/s, tested at 30 to 50 degC and up to 100 deg/s. Prints the root mean square of the error of the
rate beside weighted least squares of bias, scale factor, its slope over temperature and a sine,
and the root mean square of z, the mean error of a sweep over the mean stated standard deviation: 1
where the statement is true.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
import os
from pathlib import Path
import sys

from gyro_calibration.calibration.dwells import Dwells, dwells_from_table, select_dwells
from gyro_calibration.calibration.rate_table import fit_effects
from gyro_calibration.calibration.scatter import rms
from gyro_calibration.calibration.selection import select_effects, TECHNOLOGY_EFFECTS
from gyro_calibration.logs.log import DEGREE, read_log
from gyro_calibration.model.compensation import (
    compensate, quadratic_form, rate_sensitivity, uncertainty_covariance)
from gyro_calibration.model.effects import (
    BIAS, CUBIC_NONLINEARITY, Effect, rate_temperature_polynomial, SCALE_FACTOR_ERROR,
    SCALE_FACTOR_TEMPERATURE, SINE_RESPONSE)
from gyro_calibration.model.gyro_model import GyroModel
import numpy as np
from scipy.optimize import least_squares

#: Slower dwells are seen, faster ones predicted, rad/s.
SEEN = 60.0 * DEGREE
THERMAL = (BIAS, SCALE_FACTOR_ERROR, SCALE_FACTOR_TEMPERATURE)
Fit = Callable[[Dwells], GyroModel]


def of(*effects: Effect) -> Fit:
    """Return a calibration with some effects."""
    return lambda dwells: fit_effects(dwells, effects).model


def chosen(technology: str | None) -> Fit:
    """Return the calibration with the effects that the dwells support."""
    return lambda dwells: select_effects(dwells, technology).calibration.model


FITS = {'bias': of(BIAS), 'bias, scale factor': of(BIAS, SCALE_FACTOR_ERROR),
        '... and scale factor over temperature, cubic': of(*THERMAL, CUBIC_NONLINEARITY),
        '... and scale factor over temperature, sine': of(*THERMAL, SINE_RESPONSE),
        'polynomial 3,2': of(rate_temperature_polynomial(3, 2)),
        'polynomial 5,2': of(rate_temperature_polynomial(5, 2)),
        **{f'default, {technology or "no technology given"}': chosen(technology)
           for technology in (None, *TECHNOLOGY_EFFECTS)}}


def table(data: Path) -> Dwells:
    """Return all dwells of the recording: outliers are not fitted, but tested on."""
    return dwells_from_table(read_log(data / 'fog_rate_table' / 'table.csv'))


def error(model: GyroModel, dwells: Dwells) -> np.ndarray:
    """Return the error of compensated rates, rad/s, without clipping the temperature."""
    return compensate(replace(model, temperature_range=(-np.inf, np.inf)), dwells.output,
                      dwells.temperature).rate - dwells.rate


def left_out(fit: Fit, dwells: Dwells) -> float:
    """Return the root mean square error in sweeps that were left out, rad/s."""
    parts = [(select_dwells(dwells, dwells.sweep != number),
              select_dwells(dwells, dwells.sweep == number)) for number in np.unique(dwells.sweep)]
    return rms(np.concatenate([error(fit(seen), unseen) for seen, unseen in parts]))


def beyond(fit: Fit, dwells: Dwells) -> float:
    """Return the root mean square error at rates beyond those that were seen, rad/s."""
    slow = np.abs(dwells.rate) < SEEN
    return rms(error(fit(select_dwells(dwells, slow)), select_dwells(dwells, ~slow)))


def main() -> None:
    dwells = table(Path(os.environ['GYRO_CALIBRATION_DATA']))
    print('| calibration | left-out sweeps | slower than 60 deg/s seen, 60 to 101 predicted |\n'
          '|---|---|---|')
    for name, fit in FITS.items():
        print(f'| {name} | {left_out(fit, dwells) / DEGREE:.4f} '
              f'| {beyond(fit, dwells) / DEGREE:.4f} |', flush=True)


# one campaign by another

#: First sweep and number of sweeps of a campaign of the recording; fastest rates, deg/s.
PARTS = ((0, 6), (2, 6), (0, 8), (4, 8), (0, 10), (6, 6), (0, 12), (8, 6))
FASTEST = (45, 60, 75, 102)


def judge(model: GyroModel, dwells: Dwells) -> tuple[float, float]:
    """Return the error, deg/s, and the root mean square of z of the sweeps."""
    done = compensate(model, dwells.output, dwells.temperature)
    error = done.rate - dwells.rate
    deviation = np.sqrt(quadratic_form(uncertainty_covariance(model), rate_sensitivity(
        model, dwells.output, done.rate, done.temperature)) + 0.0 * error)
    sweeps = [dwells.sweep == number for number in np.unique(dwells.sweep)]
    return rms(error) / DEGREE, rms(np.array(
        [error[part].mean() / deviation[part].mean() for part in sweeps]))


def least_squares_error(seen: Dwells, unseen: Dwells) -> float:
    """Return the error, deg/s, of a weighted least squares that knows the form of the gyro."""
    def output(values: np.ndarray, dwells: Dwells) -> np.ndarray:
        bias, scale, slope, k = values
        return (bias + np.sin(k * dwells.rate) / k
                + (scale + slope * (dwells.temperature - 40.0)) * dwells.rate)

    weight = 1.0 / np.hypot(0.01 * DEGREE, 7e-4 * seen.rate)
    found = least_squares(lambda values: weight * (output(values, seen) - seen.output),
                          (0.0, 0.0, 0.0, 0.2), x_scale=(1e-3, 1e-3, 1e-4, 0.1), loss='soft_l1')
    rate = unseen.output
    for _ in range(50):
        rate = rate + unseen.output - output(
            found.x, Dwells(rate, rate, unseen.temperature, rate, unseen.sweep, unseen.location))
    return rms(rate - unseen.rate) / DEGREE


def of_recording(dwells: Dwells) -> Iterator[tuple[Dwells, Dwells, bool]]:
    """Give campaigns, what comes after them, and whether that is faster."""
    for first, count in PARTS:
        inside = (dwells.sweep >= first) & (dwells.sweep < first + count)
        after = select_dwells(dwells, dwells.sweep >= first + count)
        for fastest in FASTEST:
            yield (select_dwells(dwells, inside & (np.abs(dwells.rate) < fastest * DEGREE)), after,
                   fastest < FASTEST[-1])


def simulated(generator: np.random.Generator, sine: bool, hot: bool) -> Dwells:
    """Return a campaign of 12 sweeps; the seed of the gyro itself is that of the generator."""
    b1, b2, s1, s2, nonlinear = generator.standard_normal(5)
    count = 25
    rates = np.linspace(0.0, 100.0 if hot else 60.0, count) * DEGREE
    low, high = (30.0, 50.0) if hot else (20.0, 32.0)
    rate = np.concatenate([rates * (-1.0) ** number for number in range(12)])
    sweep = np.repeat(np.arange(12), count)
    temperature = (np.repeat(low + (high - low) * np.arange(12) / 12.0, count)
                   + np.tile(np.linspace(0.0, (high - low) / 12.0, count), 12))
    warm = temperature - 25.0
    bias = 0.005 * DEGREE * (b1 * warm + b2 * warm ** 2 / 30.0)
    scale = 0.003 + 2e-4 * (s1 * warm + s2 * warm ** 2 / 30.0)
    other = np.random.default_rng(int(generator.integers(1 << 30)) + hot)
    bias += 0.003 * DEGREE * other.standard_normal(12)[sweep]
    scale += 3e-4 * other.standard_normal(12)[sweep]
    response = np.sin(0.25 * rate) / 0.25 if sine else rate + 0.002 * nonlinear * rate ** 3
    noise = other.standard_normal(len(rate)) * np.hypot(0.01 * DEGREE, 7e-4 * rate)
    return Dwells(rate, response + scale * rate + bias + noise, temperature,
                  np.full(len(rate), np.nan), sweep, ('',) * len(rate))


def of_simulation(count: int, sine: bool) -> Iterator[tuple[Dwells, Dwells, bool]]:
    """Give campaigns of as many gyros."""
    for seed in range(count):
        cool, hot = (simulated(np.random.default_rng(seed), sine, each) for each in (False, True))
        yield cool, hot, True


def line(name: str, campaigns: Iterator[tuple[Dwells, Dwells, bool]]) -> str:
    found: list[tuple[float, ...]] = []
    for seen, unseen, faster in campaigns:
        model = select_effects(seen).calibration.model
        slow = select_dwells(unseen, np.abs(unseen.rate) <= np.abs(seen.rate).max() + 1e-9)
        same = select_dwells(seen, seen.sweep % 4 < 2), select_dwells(seen, seen.sweep % 4 >= 2)
        inside = judge(select_effects(same[0]).calibration.model, same[1])
        found.append((*judge(model, unseen), judge(model, slow)[1], inside[1],
                      least_squares_error(seen, unseen), faster))
    errors, z, hot, inside, peers, _ = np.array(found).T
    return (f'| {name} | {len(found)} | {errors.mean():.4f}, {errors.max():.4f} '
            f'| {peers.mean():.4f}, {peers.max():.4f} | {rms(inside):.2f} | {rms(hot):.2f} '
            f'| {rms(z):.2f} |')


def campaigns(count: int = 40) -> None:
    print('| campaigns | number | error: mean, worst, deg/s | least squares: mean, worst, deg/s '
          '| z in range | hotter | hotter and faster |\n|---|---|---|---|---|---|---|')
    if folder := os.environ.get('GYRO_CALIBRATION_DATA'):
        print(line('recording', of_recording(table(Path(folder)))), flush=True)
    for name, sine in (('simulated, open-loop', True), ('simulated, MEMS', False)):
        print(line(name, of_simulation(count, sine)), flush=True)


if __name__ == '__main__':
    if sys.argv[1:2] == ['campaigns']:
        campaigns(*map(int, sys.argv[2:3]))
    else:
        main()
