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
``fit(read_log('table.csv'))``.
"""

import sys

from gyro_calibration import fit, Log, read_model, write_model
import numpy as np

TRUE_GYRO = read_model({'effects': {
    'bias': {'bias': np.radians(0.01)}, 'sine_response': {'k': 0.25},
    'scale_factor_temperature': {'reference_temperature': 35.0,
                                 'scale_factor_temperature': -4e-4}}})
SCATTER = np.radians(0.02)  # of a dwell's mean, rad/s


def rate_table(generator):
    """Return a log whose rows are dwells: ten sweeps over 21 rates, from 25 to 45 degC."""
    rate = np.radians(np.concatenate(
        [np.linspace(-100.0, 100.0, 21)[::way] for way in (1, -1) * 5]))
    temperature = np.linspace(25.0, 45.0, len(rate))
    output = TRUE_GYRO.output(rate, temperature) + SCATTER * generator.standard_normal(len(rate))
    return Log(output=output, temperature=temperature, reference_rate=rate)


def main(path='model.yaml'):
    found = fit(rate_table(np.random.default_rng(1)), technology='open_loop_fog')
    print(found)
    write_model(path, found.model)
    rate = found.model.rate(TRUE_GYRO.output(1.5, 30.0), 30.0)
    print(f'written to {path}; a turn of 1.5 rad/s at 30 degC is reported as {rate:.5f} rad/s')


if __name__ == '__main__':
    main(*sys.argv[1:])
