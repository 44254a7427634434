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
Measure heading errors of recorded gyros over five minutes, calibrated on their first motion.

    GYRO_CALIBRATION_DATA=FOLDER python benchmarks/recordings.py [STEP [FIRST]]
    GYRO_CALIBRATION_DATA=FOLDER python benchmarks/recordings.py fit [STEP [FIRST]]

An MPU-6050 swings over 180 degrees on a shaft with an encoder. It is calibrated on 20, 30 or 60 s
against the encoder, and then its heading is followed to five minutes after the beginning. Prints a
table in Markdown, over beginnings every STEP seconds (60) of each recording, from FIRST (0) on;
with a STEP of an hour, from its beginning.

The first command compares no calibration, the least squares of Hong and Park (eq. 7), and
self-calibration as it is now, which refuses a run where errors that repeat with the motion are
large. The heading is compared with the encoder aligned by the fit, in time and at the start; eq. 7
has no such alignment, and uses that of the likelihood. The stated uncertainty is the covariance of
the calibration, and the noise of the same kind of gyro at rest.

The second one compares no calibration, plain least squares on increments over 0.5 s (delay on a
grid), and the verb `fit` (`calibrate_encoder`): rms of the error about its mean, the delay being
the one that fits best; also with refusals as nothing, and how often an answer is worse than none.
"""

from __future__ import annotations

from dataclasses import replace
import math
import os
from pathlib import Path
import sys

from drives import MPU6050
from gyro_calibration.calibration.encoder import calibrate_encoder
from gyro_calibration.calibration.likelihood import fit_likelihood, ScaleBiasFit
from gyro_calibration.calibration.self_calibration import fit_heading, self_calibrate
from gyro_calibration.heading.integration import integrate
from gyro_calibration.logs.log import Array, DataRefused, DEGREE, Log, read_log
from gyro_calibration.model.motion import motion_from_headings
from heading_track import follow
import numpy as np

FOLLOWED = 300.0
#: The gyro is mounted upside down against the encoder in two of them.
RECORDINGS = {'yaw_slow': -1.0, 'pitch_slow': 1.0, 'yaw_fast': -1.0}
NOISE = MPU6050.noise
#: Length of the increments, s, and delays that are tried, s.
BLOCK, LAGS = 0.5, np.arange(-20, 21) * 0.004


def fits(time: Array, output: Array, heading: Array, seconds: float) -> list[ScaleBiasFit]:
    """Return none, eq. 7 and, where it is not refused, the self-calibration."""
    run = time <= seconds
    given = time[run], output[run], motion_from_headings(time[run], heading[run])
    aligned, plain = fit_likelihood(*given, 0.25), fit_heading(*given)
    found = [replace(aligned, scale_factor_error=s, bias=b)
             for s, b in ((0.0, 0.0), (plain.scale_factor_error, plain.bias))]
    try:
        return [*found, self_calibrate(*given)]
    except DataRefused:
        return found


def row(given: tuple[Array, Array, Array], seconds: float) -> list[float]:
    """Return rms errors of three, deg, and of the last the sigma of the bias and share inside."""
    found = fits(*given, seconds)
    followed = [follow(fit, *given, NOISE) for fit in found]
    errors = [math.sqrt(np.mean(error ** 2)) / DEGREE for error, _ in followed]
    if len(found) < 3:
        return [*errors, *3 * [math.nan]]
    error, deviation = followed[-1]
    return [*errors, math.sqrt(found[-1].covariance[1, 1]) / DEGREE,
            float(np.mean(np.abs(error) < 1.96 * deviation))]


def cells(rows: Array) -> list[str]:
    given = rows[np.isfinite(rows[:, 2])]
    found = [f'{size:.2f}' for size in np.sqrt(np.mean(rows[:, :2] ** 2, axis=0))]
    return found + ([f'{math.sqrt(np.mean(given[:, 2] ** 2)):.2f}',
                     f'{np.median(given[:, 3]):.3f}',
                     f'{100 * given[:, 4].min():.1f} %'] if len(given) else ['-'] * 3)


def squares(time: Array, output: Array, heading: Array) -> tuple[float, float]:
    """Return bias and scale factor error by least squares on increments at the best delay."""
    turned, best = integrate(time, output), (math.inf, 0.0, 0.0)
    points = np.arange(time[0] + 0.1, time[-1] - 0.1, BLOCK)
    columns = np.column_stack([np.diff(np.interp(points, time, heading)), np.diff(points)])
    for lag in LAGS:
        increments = np.diff(np.interp(points + lag, time, turned))
        values, left, *_ = np.linalg.lstsq(columns, increments, rcond=None)
        if left[0] < best[0]:
            best = (float(left[0]), float(values[1]), float(values[0]) - 1.0)
    return best[1:]


def best_error(time: Array, output: Array, heading: Array, bias: float, scale: float) -> float:
    """Return the heading error, rms about its mean, deg, at the best delay."""
    turned = integrate(time, (output - bias) / (1.0 + scale))
    return min(
        float(np.std(np.interp(time + lag, time, turned)[50:-50] - heading[50:-50]))
        for lag in LAGS[::2]) / DEGREE


def fit_row(given: tuple[Array, Array, Array], seconds: float) -> list[float]:
    """Return rms errors of nothing, increments, `fit` and `fit` with refusals as nothing, deg."""
    start = [values[given[0] < seconds] for values in given]
    nothing, plain = best_error(*given, 0.0, 0.0), best_error(*given, *squares(*start))
    try:
        fit = calibrate_encoder(Log(time=start[0], output=start[1],
                                    reference_heading=start[2])).fit
        ours = best_error(*given, fit.bias, fit.scale_factor_error)
    except DataRefused:
        ours = math.nan
    return [nothing, plain, ours, nothing if math.isnan(ours) else ours]


def fit_cells(rows: Array) -> list[str]:
    return [*(f'{size:.1f}' for size in np.sqrt(np.nanmean(rows ** 2, axis=0))),
            str((rows[:, 2] > rows[:, 0]).sum())]


def main(by_fit: bool, step: float = 60.0, first: float = 0.0) -> None:
    print('| recording | on | nothing | increments | fit | the same, refusals as nothing '
          '| worse than nothing | refused |\n|---|---|---|---|---|---|---|---|' if by_fit else
          '| recording | on | none | eq. 7 | now | stated, deg/s | inside 95 %, at least '
          '| refused |\n|---|---|---|---|---|---|---|---|')
    folder = Path(os.environ['GYRO_CALIBRATION_DATA']) / 'mems_encoder_turntable'
    for name, sense in RECORDINGS.items():
        log = read_log(folder / f'{name}.csv.gz')
        for seconds in (20.0, 30.0, 60.0):
            rows = []
            for begin in np.arange(first, log.time[-1] - FOLLOWED, step):
                chosen = (log.time >= begin) & (log.time < begin + FOLLOWED)
                time, heading = log.time[chosen], log.reference_heading[chosen]
                given = time - time[0], sense * log.output[chosen], heading - heading[0]
                rows.append((fit_row if by_fit else row)(given, seconds))
            table = np.array(rows)
            print(f'| `{name}` | {seconds:.0f} s | '
                  f'{" | ".join((fit_cells if by_fit else cells)(table))} '
                  f'| {np.isnan(table[:, 2]).sum()} of {len(table)} |', flush=True)


if __name__ == '__main__':
    words = sys.argv[1:]
    main(words[:1] == ['fit'], *map(float, words[words[:1] == ['fit']:]))
