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
Write the log of a simulated gyro.

example: gyro_calibration simulate --model model.yaml --motion robot --out log.csv --seed 1
"""

import argparse
from dataclasses import replace
import secrets
from typing import Any

from gyro_calibration.cli import verb
from gyro_calibration.cli.verb import Answer
from gyro_calibration.files import InputError
from gyro_calibration.logs.log import Log, write_log
from gyro_calibration.model.model_file import read_model
from gyro_calibration.model.motion import motion_by_name, NAMED_MOTIONS, simulate
import numpy as np


def add_motion_options(parser: argparse.ArgumentParser, **options: Any) -> None:
    parser.add_argument('--motion', metavar='FILE|NAME',
                        help=f'a motion profile, or one of {", ".join(NAMED_MOTIONS)}', **options)
    parser.add_argument('--seed', type=verb.non_negative_integer,
                        help='seed of the noise; default: random')
    add_sampling_options(parser)


def add_sampling_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--sample-rate', type=verb.positive_number, default=100.0, metavar='HZ',
                        help='sample rate of the simulated gyro; default: 100')
    parser.add_argument('--temperature', type=verb.degrees_celsius, metavar='DEGC',
                        help='default: the reference temperature of the model')


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--model', required=True, metavar='MODEL.yaml')
    add_motion_options(parser, required=True)
    parser.add_argument('--out', required=True, metavar='LOG.csv', help='.csv or .csv.gz')


def run(given: argparse.Namespace) -> Answer:
    log, seed = simulate_log(given)
    duration = float(verb.require_time(given, log)[-1])
    write_log(given.out, replace(
        log, notes=(f'simulated with {given.model}, motion {given.motion}, seed {seed}',)))
    data = {'out': given.out, 'rows': len(log), 'duration_s': duration, 'seed': seed}
    return Answer(
        [f'{len(log)} samples over {duration:g} s, seed {seed}, written to {given.out}.'], data)


def simulate_log(given: argparse.Namespace) -> tuple[Log, int]:
    seed = secrets.randbits(32) if given.seed is None else given.seed
    motion = motion_by_name(given.motion)
    if not 1 <= round(motion.duration * given.sample_rate) <= 20_000_000:  # 100 bytes each
        raise InputError(f'{given.motion} at --sample-rate {given.sample_rate:g} has fewer than '
                         'two samples, or more than 20 million; give another rate')
    return simulate(read_model(given.model), motion, given.sample_rate,
                    np.random.default_rng(seed), given.temperature), seed
