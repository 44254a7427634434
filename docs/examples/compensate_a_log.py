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
``log = read_log('drive.csv')``, and ``model = read_model('model.yaml')``.

"""

import sys

from gyro_calibration.heading.integration import BlockIntegrator, integrate, Threshold
from gyro_calibration.heading.log_compensation import LogCompensation
from gyro_calibration.logs.log import DEGREE, write_log
from gyro_calibration.model.compensation import covariance
from gyro_calibration.model.effects import BIAS, SCALE_FACTOR_ERROR, THERMAL_LAG
from gyro_calibration.model.gyro_model import GyroModel, Term
from gyro_calibration.model.motion import ROBOT
from gyro_calibration.model.noise import Noise
from gyro_calibration.model.simulation import simulate
import numpy as np

NOISE = Noise(angle_random_walk=7.3e-4, bias_instability=8.7e-5)
MODEL = GyroModel(
    (Term(BIAS, (0.002,)), Term(SCALE_FACTOR_ERROR, (-0.1,)), Term(THERMAL_LAG, (60.0, 1e-4))),
    # of bias, (rad/s)², scale factor error, time constant, s², and lag, (rad/s/K)²
    covariance=np.diag([1e-4, 5e-4, 5.0, 1e-5]) ** 2,
    noise=NOISE)


def main(path='compensated.csv'):
    temperature = np.linspace(20.0, 45.0, round(100.0 * ROBOT.duration) + 1)
    log = simulate(MODEL, ROBOT, 100.0, np.random.default_rng(1), temperature)
    result, sensitivity = LogCompensation(MODEL).add(log)
    integrator = BlockIntegrator(Threshold(angle_random_walk=NOISE.angle_random_walk), NOISE,
                                 covariance(MODEL))
    filtered, heading, deviation = integrator.add(log.time, result.rate, sensitivity)
    write_log(path, log, {'rate_rad_s': filtered, 'heading_rad': heading,
                          'heading_std_rad': deviation})

    raw = integrate(log.time, log.output)
    print(f'After {log.time[-1]:.0f} s the heading is off by '
          f'{(raw - log.reference_heading)[-1] / DEGREE:.2f} deg as reported, and by '
          f'{(heading - log.reference_heading)[-1] / DEGREE:.2f} deg '
          f'(standard deviation {deviation[-1] / DEGREE:.2f}) when compensated.')


if __name__ == '__main__':
    main(*sys.argv[1:])
