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

    GYRO_CALIBRATION_DATA=FOLDER python benchmarks/recordings.py [STEP]

An MPU-6050 swings over 180 degrees on a shaft with an encoder. It is calibrated on 20, 30 or 60 s
against the encoder, and then its heading is followed to five minutes after the beginning: without
calibration, with the least squares of Hong and Park (eq. 7), and as self-calibration is now, which
refuses a run where errors that repeat with the motion are large. Prints a table in Markdown, over
beginnings every STEP seconds (60) of each recording; with a STEP of an hour, from its beginning.

The heading is compared with the encoder aligned by the fit, in time and at the start; eq. 7 has no
such alignment, and uses that of the likelihood. The stated uncertainty is the covariance of the
calibration, and the noise of the same kind of gyro at rest.

"""

from __future__ import annotations

from dataclasses import replace
import math
import os
from pathlib import Path
import sys

from gyro_calibration.calibration.likelihood import fit_likelihood, ScaleBiasFit
from gyro_calibration.calibration.self_calibration import fit_heading, self_calibrate
from gyro_calibration.heading.integration import integrate
from gyro_calibration.logs.log import Array, DataRefused, DEGREE, Log, read_log
from gyro_calibration.model.compensation import quadratic_form
from gyro_calibration.model.motion import motion_from_headings
from gyro_calibration.model.presets import MPU6050
import numpy as np

FOLLOWED = 300.0
#: The gyro is mounted upside down against the encoder in two of them.
RECORDINGS = {'yaw_slow': -1.0, 'pitch_slow': 1.0, 'yaw_fast': -1.0}
NOISE = MPU6050.noise


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


def follow(fit: ScaleBiasFit, time: Array, output: Array, heading: Array) -> tuple[Array, Array]:
    """Return the error of the heading and its stated sigma, rad, without the last second."""
    turned = integrate(time, (output - fit.bias) / (1.0 + fit.scale_factor_error))
    turned = np.interp(time + fit.time_offset, time,
                       turned) - np.interp(max(fit.time_offset, 0.0), time, turned)
    known = quadratic_form(fit.covariance,
                           np.array([heading, time])) / (1.0 + fit.scale_factor_error) ** 2
    variance = known + NOISE.heading_variance(time) + fit.start_heading_deviation ** 2
    kept = time < time[-1] - 1.0
    return (turned + fit.start_heading - heading)[kept], np.sqrt(variance)[kept]


def row(log: Log, sense: float, begin: float, seconds: float) -> list[float]:
    """Return rms errors of three, deg, and of the last the sigma of the bias and share inside."""
    chosen = (log.time >= begin) & (log.time < begin + FOLLOWED)
    time, output, heading = log.time[chosen], log.output[chosen], log.reference_heading[chosen]
    given = time - time[0], sense * output, heading - heading[0]
    found = fits(*given, seconds)
    followed = [follow(fit, *given) for fit in found]
    errors = [math.sqrt(np.mean(error ** 2)) / DEGREE for error, _ in followed]
    if len(found) < 3:
        return [*errors, *3 * [math.nan]]
    error, deviation = followed[-1]
    return [*errors, math.sqrt(found[-1].covariance[1, 1]) / DEGREE,
            float(np.mean(np.abs(error) < 1.96 * deviation))]


def main(step: float) -> None:
    """Print the table."""
    print('| recording | on | none | eq. 7 | now | stated, deg/s | inside 95 %, at least '
          '| refused |\n|---|---|---|---|---|---|---|---|')
    folder = Path(os.environ['GYRO_CALIBRATION_DATA']) / 'mems_encoder_turntable'
    for name, sense in RECORDINGS.items():
        log = read_log(folder / f'{name}.csv.gz')
        begins = np.arange(0.0, log.time[-1] - FOLLOWED, step)
        for seconds in (20.0, 30.0, 60.0):
            rows = np.array([row(log, sense, begin, seconds) for begin in begins])
            given = rows[np.isfinite(rows[:, 2])]
            cells = [f'{size:.2f}' for size in np.sqrt(np.mean(rows[:, :2] ** 2, axis=0))]
            cells += [f'{math.sqrt(np.mean(given[:, 2] ** 2)):.2f}',
                      f'{np.median(given[:, 3]):.3f}',
                      f'{100 * given[:, 4].min():.1f} %'] if len(given) else ['-'] * 3
            print(f'| `{name}` | {seconds:.0f} s | {" | ".join(cells)} '
                  f'| {len(rows) - len(given)} of {len(rows)} |', flush=True)


if __name__ == '__main__':
    main(float(sys.argv[1]) if len(sys.argv) > 1 else 60.0)
