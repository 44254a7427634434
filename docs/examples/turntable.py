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

Both logs are simulated here, so that the truth is known. With logs of your own:
``dwells(read_log('speeds.csv'))`` and ``calibrate_encoder(read_log('turntable.csv'))``.

"""

from dataclasses import replace

from gyro_calibration.calibration.dwells import dwells
from gyro_calibration.calibration.encoder import calibrate_encoder
from gyro_calibration.calibration.rate_table import fit_effects
from gyro_calibration.logs.log import DEGREE
from gyro_calibration.model.effects import BIAS, SCALE_FACTOR_ERROR
from gyro_calibration.model.gyro_model import GyroModel, Term
from gyro_calibration.model.motion import turns
from gyro_calibration.model.noise import Noise
from gyro_calibration.model.simulation import simulate
import numpy as np

TRUE_GYRO = GyroModel((Term(BIAS, (0.2 * DEGREE,)), Term(SCALE_FACTOR_ERROR, (0.013,))),
                      noise=Noise(angle_random_walk=5e-4))
#: 0, 33 1/3 and 45 revolutions a minute, each for 30 s.
RECORD_PLAYER = turns([(30.0, 0.0), (30.0, 200.0), (30.0, 270.0), (30.0, 0.0)], ramp=2.0)
#: Turned by hand, both ways, unevenly.
BY_HAND = turns([(4.0, 0.0), (3.0, 60.0), (4.0, -90.0), (3.0, 30.0), (5.0, 80.0), (4.0, -120.0),
                 (5.0, 0.0)] * 4, ramp=1.0)
ENCODER_STEP = 2.0 * DEGREE


def say(name, model):
    for term, deviation in zip(model.terms, np.sqrt(np.diag(model.covariance))):
        value, = term.values
        unit, factor = (('%', 100.0) if term.effect is SCALE_FACTOR_ERROR
                        else ('deg/s', 1.0 / DEGREE))
        print(f'{name:14} {term.effect.name:20}{value * factor:9.4f} '
              f'+- {deviation * factor:.4f} {unit}')


def record_player(generator):
    """Calibrate by three speeds, known from the pulley or a strobe: the reference is a rate."""
    log = simulate(TRUE_GYRO, RECORD_PLAYER, 100.0, generator)
    say('record player', fit_effects(dwells(log), [BIAS, SCALE_FACTOR_ERROR]).model)


def encoder(generator):
    """Calibrate by an encoder with steps of 2 deg: the reference is a heading."""
    log = simulate(TRUE_GYRO, BY_HAND, 50.0, generator)
    found = calibrate_encoder(replace(
        log, reference_heading=np.round(log.reference_heading / ENCODER_STEP) * ENCODER_STEP))
    say('encoder', found.model)
    print(f'{"":14} heading error {found.before.rms / DEGREE:.2f} deg rms before, '
          f'{found.after.rms / DEGREE:.2f} after')


if __name__ == '__main__':
    generator = np.random.default_rng(1)
    record_player(generator)
    encoder(generator)
    print('true are 0.2 deg/s and 1.3 %')
