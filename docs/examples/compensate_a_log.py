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
Compensate a log by a model, and integrate the heading with its standard deviation.

    python compensate_a_log.py [OUT.csv]

The log is simulated here, so that the truth is known. With files of your own:
``compensate(read_log('drive.csv'), read_model('model.yaml'))``.
"""

import sys

from gyro_calibration import compensate, GyroModel, read_model, simulate
import numpy as np

MODEL = read_model({
    'effects': {'bias': {'bias': 0.002}, 'scale_factor_error': {'scale_factor_error': -0.1},
                'thermal_lag': {'time_constant': 60.0, 'thermal_lag': 1e-4}},
    # of bias, (rad/s)², scale factor error, time constant, s², and lag, (rad/s/K)²
    'covariance': (np.diag([1e-4, 5e-4, 5.0, 1e-5]) ** 2).tolist(),
    'noise': {'angle_random_walk': 7.3e-4, 'bias_instability': 8.7e-5}})


def main(path='compensated.csv'):
    temperature = np.linspace(20.0, 45.0, 16001)
    log = simulate(MODEL, 'robot', sample_rate=100.0, seed=1, temperature=temperature)
    found, raw = compensate(log, MODEL), compensate(log, GyroModel())
    found.write(path)
    error, error_of_raw = np.degrees(
        [each.heading[-1] - log.reference_heading[-1] for each in (found, raw)])
    print(f'After {log.time[-1]:.0f} s the heading is off by {error_of_raw:.2f} deg as reported, '
          f'and by {error:.2f} deg (standard deviation {np.degrees(found.heading_std[-1]):.2f}) '
          'when compensated.')


if __name__ == '__main__':
    main(*sys.argv[1:])
