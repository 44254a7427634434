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
Calibrate and diagnose recordings that others published, and compare those of the same gyro.

    python benchmarks/public_recordings.py axes ring_supplementary_material
    python benchmarks/public_recordings.py cars FrictionMaps

The folders are clones from GitHub; nothing of them is in this project, and no limit was set on
them.

axes : the OpenAXES Example Robot Dataset (Webering, Fahnemann, Stanislawski 2023, doi
    10.25835/psqqs9w0), as repackaged in `anonymous-sup-material/ring_supplementary_material`. Two
    IMUs on the arm of an industrial robot, eight motions of 28 to 63 s. The reference of each axis
    of a gyro is the rate of the robot by its quaternions at 125 Hz; the rows are synchronized by
    the authors.
cars : `AhmadAmine998/FrictionMaps`. An F1TENTH car on five tracks; the reference is the heading of
    its particle filter in a map by lidar.

For axes, a row has the values of `fit` with their standard deviations, and the established causes
of `diagnose`; below them, for each axis, chi-squared of the scale factor error of all logs against
their weighted mean. For cars, each half is fitted and tested on the other one, as in `wild.py`.

"""

from __future__ import annotations

from collections.abc import Iterator
import math
from pathlib import Path
import sys

from gyro_calibration import diagnose, fit
from gyro_calibration.logs.log import Array, DataRefused, DEGREE, Log
import numpy as np
from scipy.spatial.transform import Rotation
from wild import fitted, judged, summary

#: Axes of the gyro and of the robot that agree, by IMU.
AXES = {'carpus': {'y': (1, 1), 'z': (2, 0)}, 'radius': {'x': (0, 2), 'y': (1, 1), 'z': (2, 0)}}
ROBOT_INTERVAL = 0.008


def table(path: Path) -> Array:
    """Return a CSV file with a header, shape (rows, columns)."""
    return np.atleast_2d(np.genfromtxt(path, delimiter=',', skip_header=1))


def robot_axes(root: Path) -> Iterator[tuple[str, str, Log]]:
    """Give the axis, the motion and the log of each axis of each recording."""
    for path in sorted(root.glob('data/openaxes_dataset/synced_imu/*/*_adx.csv')):
        motion, imu = path.parent.name, path.name.removesuffix('_adx.csv')
        robot = table(path.parents[2] / 'groundtruth' / f'robot-{motion}' / f'{imu}.csv')
        turns = Rotation.from_quat(robot[:, [2, 3, 4, 1]])
        between = (turns[:-1].inv() * turns[1:]).as_rotvec() / ROBOT_INTERVAL
        rates = 0.5 * (between[1:] + between[:-1])
        output = table(path)[1:len(rates) + 1, 4:]
        for name, (of_gyro, of_robot) in AXES[imu].items():
            sign = math.copysign(1.0, float(output[:, of_gyro] @ rates[:, of_robot]))
            yield f'{imu} {name}', motion, Log(
                ROBOT_INTERVAL * np.arange(len(rates)), sign * output[:, of_gyro],
                reference_rate=rates[:, of_robot])


def car_drives(root: Path) -> Iterator[tuple[str, Log]]:
    """Give the track and the log of each drive."""
    for path in sorted(root.glob('DataSets/*/imuData.csv')):
        gyro, poses = table(path), table(path.with_name('pfPoseData.csv'))
        time, at = (rows[:, 1] - gyro[0, 1] + 1e-9 * rows[:, 2] for rows in (gyro, poses))
        kept, used = (np.diff(each, prepend=-np.inf) > 0.0 for each in (time, at))
        time, output = time[kept], gyro[kept, 11] * DEGREE
        heading = np.unwrap(2.0 * np.arctan2(poses[used, 7], poses[used, 8]))
        nearest = np.unique(np.clip(np.searchsorted(time, at[used]), 0, len(time) - 1))
        reference = np.full(len(time), np.nan)
        reference[nearest] = np.interp(time[nearest], at[used], heading)
        yield path.parent.name, Log(time, output, reference_heading=reference)


def compare_axes(root: Path) -> None:
    """Print the values and causes of each log, and the agreement of the logs of an axis."""
    found: dict[str, list[tuple[float, float]]] = {}
    print('| axis | motion | s, % | bias, deg/s | established causes |\n|---|---|---:|---:|---|')
    for axis, motion, log in robot_axes(root):
        try:
            model = fit(log).model
            bias, scale = np.sqrt(np.diag(model.covariance))
            values = {term.effect.name: term.values[-1] for term in model.terms}
            size = values['scale_factor_error']
            found.setdefault(axis, []).append((100.0 * size, 100.0 * scale))
            words = (f'{100.0 * size:.3f} ± {100.0 * scale:.3f} | '
                     f'{values["bias"] / DEGREE:.3f} ± {bias / DEGREE:.3f}')
        except DataRefused as refusal:
            words = f'{refusal} | '
        findings = diagnose(log).found.findings
        causes = ', '.join(each.effect for each in findings if each.status == 'established')
        print(f'| {axis} | {motion} | {words} | {causes} |', flush=True)
    for axis, of_logs in found.items():
        sizes, deviations = np.array(of_logs).T
        weights = deviations ** -2.0
        mean = float(np.average(sizes, weights=weights))
        print(f'{axis}: s {mean:.3f} ± {weights.sum() ** -0.5:.3f} %, chi-squared '
              f'{float(weights @ (sizes - mean) ** 2):.1f} with {len(sizes) - 1} degrees of '
              'freedom')


def main(arguments: list[str]) -> None:
    kind, root = arguments[0], Path(arguments[1])
    if kind == 'axes':
        compare_axes(root)
        return
    print('\n'.join(summary([half for name, log in car_drives(root)
                             for half in judged(f'{name:24s}', log, fitted)])))


if __name__ == '__main__':
    main(sys.argv[1:])
