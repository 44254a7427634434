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
Run an emulated gyro, its driver, compensation, self-calibration and a drive here.

example: gyro_calibration demo --out demo

"""

from __future__ import annotations

import argparse
from pathlib import Path

from gyro_calibration.cli import verb
from gyro_calibration.cli.verb import Answer
from gyro_calibration.files import InputError


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--out', default='demo', metavar='DIR',
                        help='folder for picture, table and log; default: %(default)s')
    parser.add_argument('--seed', type=verb.non_negative_integer, default=0,
                        help='seed of the noise; default: %(default)s')


def run(given: argparse.Namespace) -> Answer:
    try:
        from gyro_calibration.cli.demo_run import run_demo
    except ImportError as error:
        raise InputError(f'the demo needs ROS 2 and matplotlib ({error}); source ROS 2, or '
                         'install gyro_calibration[ros,plot]') from None
    verb.require_folder(given.out)
    return run_demo(Path(given.out), given.seed)
