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
Calibrate a gyro on a rate table over temperature, and predict sweeps that were left out.

    python rate_table.py [MODEL.yaml]

The table is simulated here, so that the truth is known. With one of your own:
``dwells(read_log('table.csv'))``.

"""

import sys

from gyro_calibration.calibration.dwells import dwells
from gyro_calibration.calibration.selection import select_effects
from gyro_calibration.logs.log import DEGREE, Log
from gyro_calibration.model.compensation import compensate
from gyro_calibration.model.effects import BIAS, SCALE_FACTOR_TEMPERATURE, SINE_RESPONSE
from gyro_calibration.model.gyro_model import GyroModel, Term
from gyro_calibration.model.model_file import write_model
import numpy as np

#: An open-loop fibre-optic gyro: 0.01 deg/s of bias, the sine of its phase, and a scale factor
#: that falls with temperature.
TRUE_GYRO = GyroModel((Term(BIAS, (0.01 * DEGREE,)), Term(SINE_RESPONSE, (0.25, 1.0)),
                       Term(SCALE_FACTOR_TEMPERATURE, (35.0, -4e-4))))
SCATTER = 0.02 * DEGREE  # of a dwell's mean, rad/s


def rate_table(generator):
    """Return a log whose rows are dwells: ten sweeps over 21 rates, from 25 to 45 degC."""
    rate = np.concatenate([np.linspace(-100.0, 100.0, 21)[::way] for way in (1, -1) * 5]) * DEGREE
    temperature = np.linspace(25.0, 45.0, len(rate))
    output = TRUE_GYRO.output(rate, temperature) + SCATTER * generator.standard_normal(len(rate))
    return Log(output=output, temperature=temperature, reference_rate=rate)


def main(path='model.yaml'):
    table = dwells(rate_table(np.random.default_rng(1)))
    selection = select_effects(table, technology='open_loop_fog')
    fit = selection.calibration
    for choice in selection.choices:
        print(f'{choice.effect:28}{"taken" if choice.taken else "not taken":10} {choice.reason}')
    print(f'error {fit.before_rms / DEGREE:.3f} deg/s rms before, '
          f'{fit.left_out_rms / DEGREE:.3f} in sweeps left out')
    write_model(path, fit.model)
    compensated = compensate(fit.model, TRUE_GYRO.output(1.5, 30.0), 30.0)
    print(f'written to {path}; a turn of 1.5 rad/s at 30 degC is reported as '
          f'{compensated.rate:.5f} rad/s')


if __name__ == '__main__':
    main(*sys.argv[1:])
