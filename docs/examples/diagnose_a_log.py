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
Diagnose a log of a gyro with a hidden effect, and compensate another log by the extended model.

    python diagnose_a_log.py [DIR]

The logs are simulated here, so that the truth is known. With logs of your own:
``diagnose([read_log('drive.csv')], generator, model)``.

"""

from pathlib import Path
import sys

from gyro_calibration.diagnosis.pipeline import diagnose
from gyro_calibration.diagnosis.report import report
from gyro_calibration.diagnosis.words import lines
from gyro_calibration.heading.integration import integrate
from gyro_calibration.heading.log_compensation import compensate_log
from gyro_calibration.logs.log import DEGREE
from gyro_calibration.model.effects import BIAS, SCALE_FACTOR_ERROR, THERMAL_LAG
from gyro_calibration.model.gyro_model import GyroModel, Term
from gyro_calibration.model.model_file import write_model
from gyro_calibration.model.motion import turns
from gyro_calibration.model.noise import Noise
from gyro_calibration.model.simulation import simulate
import numpy as np

NOISE = Noise(angle_random_walk=1.5e-4)
#: The model of the gyro that is in use.
MODEL = GyroModel((Term(BIAS, (2e-4,)), Term(SCALE_FACTOR_ERROR, (0.01,))), noise=NOISE)
#: The gyro: its element follows the thermometer beside it only after some minutes.
TRUE_GYRO = GyroModel((*MODEL.terms, Term(THERMAL_LAG, (120.0, 2e-4))), noise=NOISE)
DRIVE = turns([(30.0, 0.0), (9.0, 40.0), (20.0, 0.0), (6.0, -60.0), (15.0, 20.0),
               (40.0, -10.0)] * 8, ramp=1.0)


def drive(generator):
    """Return a log over 16 min, in which the gyro is heated and cooled twice."""
    time = np.linspace(0.0, DRIVE.duration, round(25.0 * DRIVE.duration) + 1)
    temperature = 30.0 + 8.0 * np.abs(np.sin(2.0 * np.pi * time / DRIVE.duration))
    return simulate(TRUE_GYRO, DRIVE, 25.0, generator, temperature)


def main(folder='.'):
    generator = np.random.default_rng(1)
    found = diagnose([drive(generator)], generator, MODEL)
    print('\n'.join(lines(found)))
    write_model(Path(folder) / 'model.yaml', found.model)
    (Path(folder) / 'report.html').write_text(report(found))

    other = drive(generator)
    for name, model in (('as it was', MODEL), ('extended', found.model)):
        error = integrate(other.time, compensate_log(model, other)) - other.reference_heading
        print(f'Another drive, compensated by the model {name}: '
              f'up to {np.abs(error).max() / DEGREE:.2f} deg off the true heading.')


if __name__ == '__main__':
    main(*sys.argv[1:])
