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

    python benchmarks/public_recordings.py axes ring_supplementary_material [TEXT]
    python benchmarks/public_recordings.py cars FrictionMaps
    python benchmarks/public_recordings.py hand broad [TEXT]
    python benchmarks/public_recordings.py halves broad [TEXT]
    python benchmarks/public_recordings.py roomba RoombaCI-Clemson [TEXT]

The folders are clones from GitHub; nothing of them is in this project, and no limit was set on
them. TEXT selects the logs whose name has it.

axes : the OpenAXES Example Robot Dataset (Webering, Fahnemann, Stanislawski 2023, doi
    10.25835/psqqs9w0), as repackaged in `anonymous-sup-material/ring_supplementary_material`. Two
    IMUs on the arm of an industrial robot, eight motions of 28 to 63 s. The reference of each axis
    of a gyro is the rate of the robot by its quaternions at 125 Hz; the rows are synchronized by
    the authors.
cars : `AhmadAmine998/FrictionMaps`. An F1TENTH car on five tracks; the reference is the heading of
    its particle filter in a map by lidar.
hand, halves : the Berlin Robust Orientation Estimation Assessment Dataset (Laidig, Caruso,
    Cereatti, Seel 2021, doi 10.3390/data6070072), `dlaidig/broad`. An IMU that is turned and moved
    by hand, three minutes a trial, with the attitude by an optical motion capture.
roomba : `mathman93/RoombaCI-Clemson`. Roombas with an LSM9DS1 that turn by up to two turns. The
    references are the heading by the encoders of the wheels, and the commanded rate.

For axes, hand and roomba, a row has the values of `fit` with their standard deviations, and the
established causes of `diagnose`; below them, for each axis, chi-squared of the scale factor error
of all logs against their weighted mean, and of the biases against the means of the output at rest,
where these are known. For cars and halves, each half is fitted and tested on the other one, as in
`wild.py`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
import math
from pathlib import Path
import sys

from gyro_calibration import diagnose, fit, read_log
from gyro_calibration.logs.log import Array, DataRefused, DEGREE, Log
import numpy as np
from scipy.io import loadmat
from scipy.spatial.transform import Rotation
from wild import fitted, judged, summary

#: Axes of the gyro and of the robot that agree, by IMU.
AXES = {'carpus': {'y': (1, 1), 'z': (2, 0)}, 'radius': {'x': (0, 2), 'y': (1, 1), 'z': (2, 0)}}
ROBOT_INTERVAL = 0.008
#: Of a Roomba: m a count of the encoders, and m between the wheels.
WHEEL_STEP, WHEEL_DISTANCE = math.pi * 0.072 / 508.8, 0.235


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


def hand_motions(root: Path) -> Iterator[tuple[str, str, Log]]:
    """Give the axis, the trial and the log of each axis of each trial."""
    for path in sorted(root.glob('data_mat/*.mat')):
        trial = loadmat(path)
        table = dict(zip(('qw', 'qx', 'qy', 'qz'), trial['opt_quat'].T),
                     time_s=np.arange(len(trial['imu_gyr'])) / trial['sampling_rate'].item(),
                     moving=trial['movement'].ravel())
        for axis, output in zip('xyz', trial['imu_gyr'].T):
            yield axis, path.stem, read_log(table | {'gyro_rad_s': output},
                                            {'attitude': 'qw/qx/qy/qz'}, axis=axis)


def roombas(root: Path) -> Iterator[tuple[str, str, Log]]:
    """Give the reference, the file and the log by each reference of each file."""
    for path in sorted([*root.glob('Data_Files/2019_Summer/Test?Data.txt'),
                        *root.glob('Data_Files/2021_Spring/IMU*Data*.txt')]):
        rows = np.genfromtxt(path, delimiter=',', invalid_raise=False)
        # the encoders before the first row of a file were set to zero
        rows = rows[1:][np.diff(rows[:, 0]) > 0.0]
        counts = np.unwrap(rows[:, 12:14], axis=0, period=65536)
        commanded = np.diff(rows[:, 10:12])[:, 0] / 1000.0 / WHEEL_DISTANCE
        log = Log(rows[:, 0], rows[:, 6] * DEGREE,
                  reference_heading=np.diff(counts)[:, 0] * WHEEL_STEP / WHEEL_DISTANCE)
        if np.ptp(log.reference_heading):
            yield 'encoders', path.stem, log
            yield 'command', path.stem, replace(log, reference_heading=None,
                                                reference_rate=commanded)


def compare(logs: Iterable[tuple[str, str, Log]]) -> None:
    """Print the values and causes of each log, and the agreement of the logs of an axis."""
    found: dict[str, list[tuple[float, ...]]] = {}
    print('| axis | motion | s, % | bias, deg/s | at rest | established causes |\n'
          '|---|---|---:|---:|---:|---|')
    for axis, motion, log in logs:
        rest = (math.nan if log.moving is None or log.output is None
                else float(log.output[log.moving == 0.0].mean()) / DEGREE)
        log = replace(log, moving=None)
        try:
            model = fit(log).model
            bias, scale = np.sqrt(np.diag(model.covariance))[:2]
            values = {term.effect.name: term.values[-1] for term in model.terms}
            row = np.array([100.0 * values['scale_factor_error'], 100.0 * scale,
                            values['bias'] / DEGREE, bias / DEGREE, rest])
            found.setdefault(axis, []).append(tuple(row))
            words = '{:.3f} ± {:.3f} | {:.3f} ± {:.3f} | {:.3f}'.format(*row)
        except DataRefused as refusal:
            words = f'{refusal} | | '
        try:
            findings = diagnose(log).found.findings
            causes = ', '.join(each.effect for each in findings if each.status == 'established')
        except DataRefused as refusal:
            causes = str(refusal)
        print(f'| {axis} | {motion} | {words} | {causes} |', flush=True)
    for axis, of_logs in found.items():
        sizes, deviations, biases, of_biases, rests = np.array(of_logs).T
        weights = deviations ** -2.0
        mean = float(np.average(sizes, weights=weights))
        of_bias = float(np.sum(((biases - rests) / of_biases) ** 2))
        print(f'{axis}: s {mean:.3f} ± {weights.sum() ** -0.5:.3f} %, chi-squared '
              f'{float(weights @ (sizes - mean) ** 2):.1f} with {len(sizes) - 1} degrees of '
              f'freedom; of the biases {of_bias:.1f} with {len(sizes)}')


#: Part -> names and logs, of which each is given whole, or by halves.
WHOLE = {'axes': robot_axes, 'hand': hand_motions, 'roomba': roombas}
HALVES = {'cars': car_drives,
          'halves': lambda root: ((f'{motion} {axis}', log)
                                  for axis, motion, log in hand_motions(root))}


def main(arguments: list[str]) -> None:
    kind, root, text = arguments[0], Path(arguments[1]), ''.join(arguments[2:3])
    if kind in WHOLE:
        compare(each for each in WHOLE[kind](root) if text in f'{each[0]} {each[1]}')
        return
    print('\n'.join(summary([half for name, log in HALVES[kind](root) if text in name
                             for half in judged(f'{name:24s}', log, fitted)])))


if __name__ == '__main__':
    main(sys.argv[1:])
