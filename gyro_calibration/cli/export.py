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
Write a model as robot simulators read it.

example: gyro_calibration export --to sdf model.yaml --sample-rate 100
"""

import argparse
from dataclasses import asdict

from gyro_calibration.cli.simulate import add_sampling_options
from gyro_calibration.cli.verb import Answer, positive_number
from gyro_calibration.files import InputError, write_atomically
from gyro_calibration.model.model_file import read_model
from gyro_calibration.model.simulator_export import export_model, simulator_parameters, SIMULATORS


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('model', metavar='MODEL.yaml')
    parser.add_argument('--to', required=True, choices=SIMULATORS,
                        help='sdf: noise of an <imu> of Gazebo; isaac: noise of an observation '
                        'of Isaac Lab; mujoco: a <gyro> sensor of MuJoCo')
    add_sampling_options(parser)
    parser.add_argument('--span', type=positive_number, default=3600.0, metavar='S',
                        help='longest time over which the bias drifts as modelled; default: 3600')
    parser.add_argument('--out', metavar='FILE', help='default: the text is printed')


def run(given: argparse.Namespace) -> Answer:
    model = read_model(given.model)
    if given.span * given.sample_rate < 2.0:
        raise InputError(f'--span {given.span:g} is shorter than two samples; give a longer one')
    temperature = model.reference_temperature if given.temperature is None else given.temperature
    noise_figures, error = simulator_parameters(model, given.sample_rate, temperature, given.span)
    text, left_out = export_model(noise_figures, model, given.to)
    data = {'to': given.to, 'out': given.out, 'text': text, 'left_out': left_out,
            'figures': asdict(noise_figures), 'allan_deviation_error': error}
    if given.out is None:
        return Answer([text.rstrip('\n')], data)
    write_atomically(given.out, text.encode())
    lines = [f'Written to {given.out}.']
    if noise_figures.wander.density and given.to == 'sdf':
        lines.append('A Gauss-Markov process replaces the drift of the bias: the Allan deviation '
                     f'is accurate to {100.0 * error:.0f} % up to {given.span:g} s.')
    if left_out:
        lines += [f'{given.to} does not hold:', *(f'  {each}' for each in left_out)]
    return Answer(lines, data)
