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

The log is simulated here, so that the truth is known. With a log of your own:
``log = read_log('run.csv')``, and ``motion = read_motion('profile.csv')``.

"""

import sys

from gyro_calibration.calibration.self_calibration import record, self_calibrate
from gyro_calibration.logs.log import DataRefused
from gyro_calibration.model.effects import BIAS, SCALE_FACTOR_ERROR
from gyro_calibration.model.gyro_model import GyroModel, Term, with_self_calibration
from gyro_calibration.model.model_file import write_model
from gyro_calibration.model.motion import CALIBRATION
from gyro_calibration.model.noise import Noise
from gyro_calibration.model.simulation import simulate
import numpy as np

NOISE = Noise(angle_random_walk=7.3e-4, bias_instability=8.7e-5)
TRUE_GYRO = GyroModel((Term(BIAS, (0.002,)), Term(SCALE_FACTOR_ERROR, (-0.1,))), noise=NOISE)


def main(path='model.yaml'):
    log = simulate(TRUE_GYRO, CALIBRATION, 100.0, np.random.default_rng(1))
    model = GyroModel(noise=NOISE)  # nothing is known of this gyro but its noise
    try:
        fit = self_calibrate(log.time, log.output, CALIBRATION, noise=model.noise)
    except DataRefused as reason:
        sys.exit(f'refused: {reason}')
    calibration = record(fit, 'likelihood', '2025-01-01T00:00:00+00:00', temperature=None)
    write_model(path, with_self_calibration(model, calibration))
    print(f'Found {calibration}; true are -10 % and 0.1146 deg/s. Written to {path}.')


if __name__ == '__main__':
    main(*sys.argv[1:])
