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
Compute the motion that calibrates best within the limits of a robot.

example: gyro_calibration plan --limits limits.yaml --seconds 20 --out profile.csv
"""

import argparse
from dataclasses import asdict
from typing import Any

from gyro_calibration.calibration.motion_design import (
    CalibrationForecast, can_follow, find_best_motion, plain_motion, RobotLimits)
from gyro_calibration.calibration.self_calibration import default_reference_errors
from gyro_calibration.cli.verb import Answer, non_negative_integer, positive_number, show_progress
from gyro_calibration.files import describe_error, InputError, write_atomically
from gyro_calibration.logs.log import DEGREE
from gyro_calibration.model.model_file import read_model
from gyro_calibration.model.motion import CALIBRATION_MOTION, Motion, motion_by_name, NAMED_MOTIONS
from gyro_calibration.model.presets import XV3500
from gyro_calibration.model.settings_file import (
    InvalidValue, parse_number, read_settings, validate)
import numpy as np

#: Name of a limit in a file -> its name in `RobotLimits`, and the ends of its numbers.
_LIMIT_FIELDS: dict[str, tuple[str, tuple[float, ...]]] = {
    'maximum_rate_dps': ('rate', (0.01,)),
    'maximum_acceleration_dps2': ('acceleration', (0.01,)),
    'maximum_jerk_dps3': ('jerk', (0.01,)),
    'minimum_rate_dps': ('slowest', (0.0,)),
    'minimum_heading_deg': ('lowest', (-1e9, 0.0)),
    'maximum_heading_deg': ('highest', (0.0,)),
    'rest_s': ('rest', (0.1, 100.0)),
}


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--limits', required=True, metavar='LIMITS.yaml',
                        help='limits of the robot; config/limits.yaml is an example')
    parser.add_argument('--seconds', type=positive_number, default=20.0, metavar='S',
                        help='length of the motion; default: 20')
    parser.add_argument('--out', metavar='PROFILE.csv',
                        help='write the motion, for self-calibrate and the node')
    parser.add_argument('--model', metavar='MODEL.yaml',
                        help='model with noise figures; default: that of the Epson XV-3500')
    parser.add_argument('--motion', default='robot', metavar='FILE|NAME',
                        help='drive whose heading error is predicted, a profile or one of '
                        f'{", ".join(NAMED_MOTIONS)}; default: robot')
    parser.add_argument('--drive', type=positive_number, metavar='S',
                        help='length of that drive, which is repeated; default: its own length')
    parser.add_argument('--seed', type=non_negative_integer, default=1,
                        help='seed of the search; default: 1')


def run(given: argparse.Namespace) -> Answer:
    if given.seconds > 300.0:
        raise InputError(f'--seconds {given.seconds:g} is above 300; plan a shorter motion')
    robot = _read_limits(given.limits)
    noise = read_model(given.model).noise if given.model else XV3500.noise
    if not noise.angle_random_walk:
        raise InputError(f'{given.model}: has no angle_random_walk; '
                         'run allan on a log at rest, with --model and --out')
    drive = motion_by_name(given.motion)
    given.drive = given.drive or drive.duration
    with show_progress(f'search for the best motion of {given.seconds:g} s'):
        forecast = CalibrationForecast(noise, given.seconds, drive, given.drive)
        motion, prediction = find_best_motion(
            robot, forecast, given.seconds, np.random.default_rng(given.seed), 60)
    built_in = CalibrationForecast(noise, CALIBRATION_MOTION.duration, drive, given.drive).predict(
        CALIBRATION_MOTION)
    rows = {'planned': prediction,
            'plain': forecast.predict(plain_motion(robot, given.seconds)), 'built_in': built_in}
    if given.out:
        write_motion(given.out, motion)
    is_built_in_feasible = can_follow(robot, CALIBRATION_MOTION)
    angle, time = motion.heading / DEGREE, motion.time
    rate, planned, plain = motion.rate_at(time), rows['planned'], rows['plain']
    scale_gain = plain.scale_deviation / planned.scale_deviation
    heading_gain = 1.0 - planned.heading_error / plain.heading_error
    wheels = default_reference_errors(motion).scale_deviation
    labels = {'planned': 'planned', 'plain': 'one turn there and back',
              'built_in': 'built-in profile, 20 s' + (
                  '' if is_built_in_feasible else ', beyond the limits')}
    lines = [f'A motion of {given.seconds:g} s with rates of {rate.min() / DEGREE:.1f} to '
             f'{rate.max() / DEGREE:.1f} deg/s and headings of {angle.min():.0f} to '
             f'{angle.max():.0f} deg.',
             '', f'Expected of a calibration, and of the heading over {given.drive:g} s after it:',
             *(f'  {labels[name] + ":":34} scale +- {100 * row.scale_deviation:.4f} %, '
               f'bias +- {row.bias_deviation / DEGREE:.4f} deg/s, '
               f'mean heading error {row.heading_error / DEGREE:.3f} deg'
               for name, row in rows.items()),
             '', f'Compared with one turn there and back, the scale factor is {scale_gain:.2f} '
             f'times as accurate, and the mean heading error is {100 * abs(heading_gain):.2f} % '
             f'{"smaller" if heading_gain >= 0.0 else "larger"}; by angle random walk alone it is '
             f'{planned.floor / DEGREE:.3f} deg.',
             'The scale is that by an exact reference. For wheels that follow the profile, '
             f'self-calibrate adds {100 * wheels:.2f} %, or --reference-scale-deviation.']
    data = {'duration_s': motion.duration, 'time_s': time.tolist(),
            'rate_rad_s': rate.tolist(), **{name: asdict(row) for name, row in rows.items()},
            'built_in_within_limits': is_built_in_feasible, 'scale_gain': scale_gain,
            'heading_gain': heading_gain, 'drive_s': given.drive, 'seed': given.seed,
            'out': given.out}
    return Answer(lines, data, (given.out,))


def _read_limits(path: str) -> RobotLimits:
    """Read the limits of a robot; a `InputError` names what is missing, unknown or wrong."""
    try:
        content = read_settings(path)
    except (OSError, ValueError) as error:
        raise InputError(f'{path}: cannot be read as YAML ({describe_error(error)}); '
                         'start with a copy of config/limits.yaml') from error

    def check(place: str, value: Any) -> float:
        name = place.rpartition('.')[2]
        return parse_number(name, value, *_LIMIT_FIELDS[name][1])

    try:
        given = validate('the file', content, dict.fromkeys(_LIMIT_FIELDS, check))
    except InvalidValue as error:
        raise InputError(f'{path}: {error}; config/limits.yaml is an example') from None
    for name in ('maximum_rate_dps', 'maximum_acceleration_dps2'):
        if name not in given:
            raise InputError(f'{path}: {name} is missing; add the limit of the robot')
    robot = RobotLimits(**{_LIMIT_FIELDS[name][0]: value if name == 'rest_s' else value * DEGREE
                           for name, value in given.items()})
    if robot.slowest > robot.rate:
        raise InputError(f'{path}: minimum_rate_dps is above maximum_rate_dps; correct one')
    return robot


def write_motion(path: str, motion: Motion) -> None:
    rows = zip(motion.time, motion.rate_at(motion.time) / DEGREE)
    lines = ['# The rate is linear between rows.', 'time_s,rate_dps',
             *(f'{time:.9f},{rate:.9f}' for time, rate in rows)]
    write_atomically(path, ('\n'.join(lines) + '\n').encode())
