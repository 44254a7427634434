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
Make the sample logs of the tutorials, all of them simulated; the same files each time.

    python samples/make.py [DIR]

"""

import gzip
import math
from pathlib import Path
import sys

from gyro_calibration import read_model, simulate
import numpy as np

DEGREE = math.pi / 180.0
HERE = Path(__file__).parent
#: Digits that a gyro and its reference would send.
FORMATS = {'time_s': '%.2f', 'gyro_dps': '%.4f', 'temperature_degc': '%.2f',
           'reference_rate_dps': '%.1f', 'reference_heading_deg': '%.4f'}
#: A fibre gyro with an open loop: its output is a sine of the rate.
FIBRE = read_model({'effects': {
    'bias': {'bias': 0.01 * DEGREE}, 'sine_response': {'k': 0.25},
    'scale_factor_temperature': {'reference_temperature': 35.0,
                                 'scale_factor_temperature': -4e-4}}})
FIBRE_NOISE = read_model({'effects': {'bias': {'bias': 0.01 * DEGREE}}, 'noise': {
    'angle_random_walk': 0.1 * DEGREE / 60.0, 'bias_instability': 3.0 * DEGREE / 3600.0}})
#: The gyro of gyro.yaml, which does not know that the bias settles after power-on.
SETTLING = read_model({
    'effects': {'bias': {'bias': 2e-4}, 'scale_factor_error': {'scale_factor_error': 0.01},
                'warm_up': {'warm_up': 8e-4, 'time_constant': 90.0}},
    'noise': {'angle_random_walk': 1.5e-4, 'bias_instability': 1e-5}})
#: A drive: s and deg/s.
DRIVE = np.array([(0, 0), (20, 0), (25, 40), (60, 40), (70, -60), (110, -20), (150, 0), (170, 0),
                  (180, 30), (300, 30), (310, -45), (400, -45), (420, 0), (500, 0), (520, 20),
                  (640, -20), (700, 60), (720, 60), (725, 0), (900, 0)], float).T
#: Scatter of the mean of a dwell, deg/s.
SCATTER = 0.02


def write(path, note, columns):
    """Write columns with the digits that they deserve."""
    lines = [f'# {note}; simulated by samples/make.py', ','.join(columns)]
    formats = [FORMATS[name] for name in columns]
    lines += [','.join(each % value for each, value in zip(formats, row))
              for row in zip(*columns.values())]
    data = ('\n'.join(lines) + '\n').encode()
    path.write_bytes(gzip.compress(data, mtime=0) if path.suffix == '.gz' else data)


def in_time(log, *names):
    """Return the columns of a log in time."""
    values = {'time_s': log.time, 'gyro_dps': log.output / DEGREE}
    if 'reference' in names:
        values['reference_heading_deg'] = log.reference_heading / DEGREE
    return values


def rate_table(generator):
    """Return the dwells of ten sweeps over 21 rates, from 25 to 45 degC."""
    rate = np.concatenate([np.linspace(-100.0, 100.0, 21)[::way] for way in (1, -1) * 5])
    temperature = (np.repeat(np.linspace(25.0, 45.0, 10), 21)
                   + 0.3 * generator.standard_normal(len(rate)))
    output = FIBRE.output(rate * DEGREE, temperature) / DEGREE
    return {'gyro_dps': output + SCATTER * generator.standard_normal(len(rate)),
            'temperature_degc': temperature, 'reference_rate_dps': rate}


def main(folder=HERE):
    folder, mems = Path(folder), read_model(HERE.parent / 'config/xv3500.yaml')
    run = simulate(mems, 'calibration', sample_rate=50.0, seed=1)
    write(folder / 'calibration_run.csv', 'Epson XV-3500 on config/motion_profile.csv',
          in_time(run))
    drive = simulate(mems, 'robot', sample_rate=20.0, seed=2)
    write(folder / 'drive.csv', 'the same gyro on a drive of 160 s', in_time(drive, 'reference'))
    write(folder / 'rate_table.csv', 'a fibre gyro on a rate table, a row a dwell',
          rate_table(np.random.default_rng(3)))
    rest = simulate(FIBRE_NOISE, (np.array([0.0, 2400.0]), np.zeros(2)), sample_rate=5.0, seed=4)
    write(folder / 'rest.csv.gz', 'the fibre gyro at rest for 40 min', in_time(rest))
    time, rate = DRIVE
    settling = simulate(SETTLING, (time, rate * DEGREE), sample_rate=20.0, seed=5)
    write(folder / 'settling.csv.gz', 'a gyro whose bias settles after power-on',
          in_time(settling, 'reference'))


if __name__ == '__main__':
    main(*sys.argv[1:])
