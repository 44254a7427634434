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
Find scale factor error and bias from 20 s of known motion, and write them into a model file.

    python self_calibrate_a_log.py [MODEL.yaml]

The log is simulated here, so that the truth is known. With files of your own:
``self_calibrate(read_log('run.csv'), 'profile.csv', read_model('noise.yaml'))``.
"""

import sys

from gyro_calibration import read_model, self_calibrate, simulate, write_model

NOISE = {'angle_random_walk': 7.3e-4, 'bias_instability': 8.7e-5}
TRUE_GYRO = read_model({'effects': {'bias': {'bias': 0.002},
                                    'scale_factor_error': {'scale_factor_error': -0.1}},
                        'noise': NOISE})


def main(path='model.yaml'):
    log = simulate(TRUE_GYRO, 'calibration', seed=1)
    model = read_model({'effects': {}, 'noise': NOISE})  # only the noise of the gyro is known
    try:
        found = self_calibrate(log, 'calibration', model)
    except ValueError as reason:
        sys.exit(f'refused: {reason}')
    write_model(path, found.model)
    print(f'{found} True are -10 % and 0.1146 deg/s. Written to {path}.')


if __name__ == '__main__':
    main(*sys.argv[1:])
