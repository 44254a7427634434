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
Find scale factor error and bias on a record player with three speeds, and with an encoder.

    python turntable.py

Both logs are simulated here, so that the truth is known. With a log of your own:
``fit(read_log('turntable.csv'))``.
"""

from gyro_calibration import fit, Log, read_model, simulate
import numpy as np

EFFECTS = ['bias', 'scale_factor_error']
TRUE_GYRO = read_model({'effects': {'bias': {'bias': np.radians(0.2)},
                                    'scale_factor_error': {'scale_factor_error': 0.013}},
                        'noise': {'angle_random_walk': 5e-4}})
ENCODER_STEP = np.radians(2.0)


def motion(stretches, ramp):
    """Return times, s, and rates, rad/s, of stretches of s at deg/s."""
    time, rate = [0.0], [0.0]
    for seconds, dps in stretches:
        time += [time[-1] + ramp, time[-1] + seconds]
        rate += [np.radians(dps)] * 2
    return np.array(time), np.array(rate)


def record_player():
    """Calibrate by three speeds, known from the pulley or a strobe: the reference is a rate."""
    speeds = motion([(30, 0), (30, 200), (30, 270), (30, 0)], ramp=2.0)
    return fit(simulate(TRUE_GYRO, speeds, seed=1), effects=EFFECTS)


def encoder():
    """Calibrate by an encoder with steps of 2 deg: the reference is a heading."""
    by_hand = motion([(4, 0), (3, 60), (4, -90), (3, 30), (5, 80), (4, -120), (5, 0)] * 4, 1.0)
    log = simulate(TRUE_GYRO, by_hand, sample_rate=50.0, seed=1)
    steps = np.round(log.reference_heading / ENCODER_STEP) * ENCODER_STEP
    return fit(Log(log.time, log.output, reference_heading=steps))


if __name__ == '__main__':
    print(f'Record player\n{record_player()}\n\nEncoder\n{encoder()}')
    print('True are 0.2 deg/s and 0.013.')
