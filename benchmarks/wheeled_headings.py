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
Follow measured drives live, beside VQF and x-io Fusion, and compare with the course over ground.

    python benchmarks/wheeled_headings.py FOLDER [--only TEXT]

FOLDER holds the logs of `wheeled_drives`. All programs are given the same: the mean of the rest
before the drive, at most 20 s of it, as the bias; the RC cars do not rest, and nothing is known of
their bias. VQF and Fusion have their published settings, and an accelerometer without error, which
is to their advantage, since the logs hold one axis.

A course has no common clock with the gyro and no common zero: the offset in time, within 1.5 s, is
the one with the least median error of the heading of this program, and is used for all; the zero
is the median of the first 20 s of the course. The table has the median and the 95th percentile of
the error over the drive, the median over the last 20 s, and for this program the share of the
course inside of the stated 95 %, where the course has an error of its own: 1 deg for cars, 3 deg
for RC cars, plus what is turned in 0.2 s, for side slip and smoothing.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from types import SimpleNamespace

from gyro_calibration.heading.bias_table import BiasTable
from gyro_calibration.heading.heading_estimator import Assumptions, HeadingEstimator
from gyro_calibration.heading.integration import integrate
from gyro_calibration.heading.tracker import TrackerSettings
from gyro_calibration.logs.log import Array, read_log
from gyro_calibration.model.gyro_model import GyroModel, SelfCalibration
from gyro_calibration.model.noise import Noise
import numpy as np
from peers import PEERS

DEG = math.pi / 180.0
#: What data sheets of both kinds of gyro have: deg/√s, deg/h; and a scale factor error of 1 %.
NOISE, SCALE = Noise(0.007 * DEG, 10.0 * DEG / 3600.0), 0.01
#: Of the rest before the drive, at most so much is known, s; without one, the bias to this, rad/s.
KNOWN, UNKNOWN = 20.0, 0.5 * DEG
#: Error of a course, rad, by kind, and per rate, s.
COURSE, SLIP = {'wid': 1.0 * DEG, 'rc': 3.0 * DEG}, 0.2
NOW = 1.7e9


def rest_before(time: Array, output: Array) -> int:
    """Return how many samples the gyro rests first: up to a mean over 0.5 s off by 0.3 deg/s."""
    count = round(0.5 / float(np.median(np.diff(time))))
    means = output[:len(output) // count * count].reshape(-1, count).mean(axis=1)
    moving = np.flatnonzero(np.abs(means - np.median(means[:6])) > 0.3 * DEG)
    blocks = int(moving[0]) - 2 if len(moving) else len(means)
    first = int(np.searchsorted(time, time[0] + KNOWN))
    return min(max(blocks, 0) * count, first)


def headings(time: Array, output: Array) -> tuple[dict[str, Array], Array, float]:
    """Return the headings, rad, the deviation of this program's, rad, and the rest, s."""
    rest = rest_before(time, output)
    known = rest * float(np.median(np.diff(time))) > 5.0
    bias = float(output[:rest].mean()) if known else 0.0
    deviation = math.hypot(NOISE.angle_random_walk / math.sqrt(KNOWN), NOISE.allan_floor) if (
        known) else UNKNOWN
    model = GyroModel(noise=NOISE, self_calibration=SelfCalibration(
        0.0, bias, ((SCALE ** 2, 0.0), (0.0, deviation ** 2))))
    follower = HeadingEstimator(model, BiasTable(model), Assumptions(), TrackerSettings(), NOW)
    follower.use_calibration(model, NOW)
    found = follower.follow(time, output, NOW)
    drive = SimpleNamespace(time=time, gyro=SimpleNamespace(
        interval=float(np.median(np.diff(time)))))
    all_of_them = {'this program': found[:, 0], 'integral': integrate(time, output - bias)}
    for name in ('VQF', 'x-io Fusion'):
        peer = PEERS[name]
        if peer.installed:
            all_of_them[name] = peer.heading(drive, output - bias, deviation if known else None,
                                             peer.published)
    return all_of_them, np.sqrt(found[:, 1]), rest * drive.gyro.interval if known else 0.0


def errors(time: Array, heading: Array, course: Array, offset: float) -> Array:
    """Return what headings are off by at the times of a course, rad, with a common zero."""
    known = np.isfinite(course)
    off = np.interp(time[known] - offset, time, heading) - course[known]
    off = np.unwrap(off)
    first = time[known] < time[known][0] + 20.0
    return off - np.median(off[first])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('folder', type=Path)
    parser.add_argument('--only', default='')
    given = parser.parse_args()
    names = ('this program', 'VQF', 'x-io Fusion', 'integral')
    print(f'| drive | rest, s | offset, s | {" | ".join(names)} | stated at the end | inside |\n'
          f'|:---|---:|---:|{"---:|" * len(names)}---:|---:|')
    table: dict[str, dict[str, list[Array]]] = {}
    shares: dict[str, list[float]] = {}
    for path in sorted(given.folder.glob('*.csv.gz')):
        name, kind = path.name.partition('.')[0], path.name.partition('_')[0]
        if given.only not in name or kind not in COURSE or 'as_recorded' in name:
            continue
        log = read_log(path)
        time, course = np.asarray(log.time), np.asarray(log.reference_heading)
        found, deviation, rest = headings(time, np.asarray(log.output))
        offsets = np.arange(-1.5, 1.501, 0.025)
        offset = min(offsets, key=lambda each: float(np.median(np.abs(
            errors(time, found['this program'], course, each)))))
        known = np.isfinite(course)
        cells, last = [], time[known] > time[known][-1] - 20.0
        for each in names:
            if each not in found:
                cells.append('not installed')
                continue
            off = np.abs(errors(time, found[each], course, offset)) / DEG
            row = np.array([np.median(off), np.quantile(off, 0.95), np.median(off[last])])
            table.setdefault(kind, {}).setdefault(each, []).append(row)
            cells.append(', '.join(f'{value:.2f}' for value in row))
        rate = np.gradient(np.interp(time[known] - offset, time, found['this program']),
                           time[known])
        own = COURSE[kind] ** 2 + (SLIP * rate) ** 2
        stated = np.interp(time[known] - offset, time, deviation) ** 2
        off = errors(time, found['this program'], course, offset)
        share = float((off ** 2 <= 3.841 * (stated + own)).mean())
        shares.setdefault(kind, []).append(share)
        print(f'| {name} | {rest:.0f} | {offset:.2f} | {" | ".join(cells)} | '
              f'{deviation[-1] / DEG:.2f} | {100.0 * share:.0f} % |', flush=True)
    for kind, of_each in table.items():
        print(f'{kind}: median over the drives of median, 95th percentile, end, deg:', '; '.join(
            f'{name} ' + ', '.join(f'{value:.2f}' for value in np.median(rows, axis=0))
            for name, rows in of_each.items()), f'; inside {100.0 * np.mean(shares[kind]):.0f} %')


if __name__ == '__main__':
    main()
