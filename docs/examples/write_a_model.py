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
Write a gyro model from the matrix C of Ojeda, Chung and Borenstein (2000), eq. 11.

    python write_a_model.py [MODEL.yaml]

The matrix is in deg/s and degC, highest powers first. The numbers are made up: put those of your
own gyro in their place. Single effects are written with their names: {'bias': {'bias': 0.002}}.
"""

import math
import sys

from gyro_calibration import read_model, write_model

DEGREE = math.radians(1.0)
MATRIX = [[1e-10, 2e-9, 3e-7, -2e-5],  # T²: its factors of w³, w², w and 1
          [-4e-9, -3e-7, -1e-5, 1.2e-3],  # T
          [-3e-7, 5e-6, 4e-3, -2e-2]]  # 1


def main(path='model.yaml'):
    model = read_model({
        'effects': {'rate_temperature_polynomial': {'matrix_dps': MATRIX}},
        'valid': {'rate': [-100 * DEGREE, 100 * DEGREE], 'temperature': [25.0, 45.0]},
        'reference_temperature': 35.0,
        'noise': {'angle_random_walk': 0.1 * DEGREE / 60.0,
                  'bias_instability': 2.0 * DEGREE / 3600.0},
        'gyro': {'name': 'an open-loop fibre-optic gyro', 'technology': 'open_loop_fog'},
        'origin': {'note': 'written by write_a_model.py'}})
    write_model(path, model)
    rate = read_model(path).rate(50.0 * DEGREE, 30.0) / DEGREE
    print(f'Written to {path}. An output of 50 deg/s at 30 degC is a rate of {rate:.4f} deg/s.')


if __name__ == '__main__':
    main(*sys.argv[1:])
