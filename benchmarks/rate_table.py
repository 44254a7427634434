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
How well calibrations predict a measured rate table of an open-loop fibre-optic gyro.

    GYRO_CALIBRATION_DATA=FOLDER python benchmarks/rate_table.py

Each is fitted without one sweep and tested on it, for all 24 sweeps; and fitted to dwells slower
than 60 deg/s and tested on the others, up to 101 deg/s. The default selects the effects anew from
the fitted data. Prints a table in Markdown, root mean squares in deg/s.

"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
import os
from pathlib import Path

from gyro_calibration.calibration.dwells import Dwells, dwells_from_table, select_dwells
from gyro_calibration.calibration.rate_table import fit_effects
from gyro_calibration.calibration.scatter import rms
from gyro_calibration.calibration.selection import select_effects, TECHNOLOGY_EFFECTS
from gyro_calibration.logs.log import DEGREE, read_log
from gyro_calibration.model.compensation import compensate
from gyro_calibration.model.effects import (
    BIAS,
    CUBIC_NONLINEARITY,
    Effect,
    rate_temperature_polynomial,
    SCALE_FACTOR_ERROR,
    SCALE_FACTOR_TEMPERATURE,
    SINE_RESPONSE,
)
from gyro_calibration.model.gyro_model import GyroModel
import numpy as np

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
    parts = [(select_dwells(dwells, dwells.sweep
                            != number), select_dwells(dwells, dwells.sweep == number))
             for number in np.unique(dwells.sweep)]
    return rms(np.concatenate([error(fit(seen), unseen) for seen, unseen in parts]))


def beyond(fit: Fit, dwells: Dwells) -> float:
    """Return the root mean square error at rates beyond those that were seen, rad/s."""
    slow = np.abs(dwells.rate) < SEEN
    return rms(error(fit(select_dwells(dwells, slow)), select_dwells(dwells, ~slow)))


def main() -> None:
    """Print the table."""
    dwells = table(Path(os.environ['GYRO_CALIBRATION_DATA']))
    print('| calibration | left-out sweeps | slower than 60 deg/s seen, 60 to 101 predicted |\n'
          '|---|---|---|')
    for name, fit in FITS.items():
        print(f'| {name} | {left_out(fit, dwells) / DEGREE:.4f} '
              f'| {beyond(fit, dwells) / DEGREE:.4f} |', flush=True)


if __name__ == '__main__':
    main()
