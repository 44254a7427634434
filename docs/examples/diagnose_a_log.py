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

The logs are simulated here, so that the truth is known. With files of your own:
``diagnose(read_log('drive.csv'), model=read_model('model.yaml'))``.
"""

import sys

from gyro_calibration import compensate, diagnose, read_model, simulate
import numpy as np

KNOWN = {'bias': {'bias': 2e-4}, 'scale_factor_error': {'scale_factor_error': 0.01}}
HIDDEN = {'thermal_lag': {'time_constant': 120.0, 'thermal_lag': 2e-4}}
NOISE = {'angle_random_walk': 1.5e-4}
MODEL = read_model({'effects': KNOWN, 'noise': NOISE})
TRUE_GYRO = read_model({'effects': KNOWN | HIDDEN, 'noise': NOISE})


def profile():
    """Return times, s, and rates, rad/s, of a drive over 16 min."""
    time, rate = [0.0], [0.0]
    for seconds, dps in [(30, 0), (9, 40), (20, 0), (6, -60), (15, 20), (40, -10)] * 8:
        time += [time[-1] + 1.0, time[-1] + seconds]
        rate += [np.radians(dps)] * 2
    return np.array(time), np.array(rate)


def drive(seed):
    """Return a log in which the gyro is heated and cooled twice."""
    time, rate = profile()
    progress = np.linspace(0.0, 2.0 * np.pi, round(25.0 * time[-1]) + 1)
    return simulate(TRUE_GYRO, (time, rate), sample_rate=25.0, seed=seed,
                    temperature=30.0 + 8.0 * np.abs(np.sin(progress)))


def main(folder='.'):
    found = diagnose(drive(1), model=MODEL, seed=1)
    print(found)
    found.write(folder)
    other = drive(2)
    for name, model in (('as it was', MODEL), ('extended', found.model)):
        error = compensate(other, model).heading - other.reference_heading
        print(f'Another drive, compensated by the model {name}: '
              f'up to {np.degrees(np.abs(error).max()):.2f} deg off the true heading.')


if __name__ == '__main__':
    main(*sys.argv[1:])
