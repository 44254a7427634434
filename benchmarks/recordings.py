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
calibration, with the least squares of Hong and Park (eq. 7), with the likelihood of blocks alone,
by the slow part of the run where errors repeat with the motion (slow), and as self-calibration is
now, which refuses a run where they are large. Two tables in Markdown: from the beginning of each
recording, and from beginnings every STEP seconds (60) of it.

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

from gyro_calibration.calibration.likelihood import Fit, fit_likelihood
from gyro_calibration.calibration.self_calibration import fit_heading, Limits, self_calibrate
from gyro_calibration.heading.integration import integrate
from gyro_calibration.logs.log import Array, DataRefused, DEGREE, Log, read_log
from gyro_calibration.model.compensation import quadratic_form
from gyro_calibration.model.motion import from_headings
from gyro_calibration.model.presets import MPU6050
import numpy as np

FOLLOWED = 300.0
#: The gyro is mounted upside down against the encoder in two of them.
RECORDINGS = {'yaw_slow': -1.0, 'pitch_slow': 1.0, 'yaw_fast': -1.0}
NOISE = MPU6050.noise
METHODS = ('none', 'eq. 7', 'blocks', 'slow', 'now')


def part(log: Log, sense: float, begin: float) -> tuple[Array, Array, Array]:
    """Return time, s, output, rad/s, and reference heading, rad, from some time on."""
    chosen = (log.time >= begin) & (log.time < begin + FOLLOWED)
    time, output, heading = log.time[chosen], log.output[chosen], log.reference_heading[chosen]
    return time - time[0], sense * output, heading - heading[0]


def fits(time: Array, output: Array, heading: Array, seconds: float) -> tuple[dict[str, Fit], str]:
    """Return a fit for each method that refuses none, and why the last was refused, or ''."""
    run = time <= seconds
    given = time[run], output[run], from_headings(time[run], heading[run])
    blocks = fit_likelihood(*given, 0.25)
    plain = fit_heading(*given)
    found = {'none': replace(blocks, scale_factor_error=0.0, bias=0.0),
             'eq. 7': replace(blocks, scale_factor_error=plain.scale_factor_error,
                              bias=plain.bias), 'blocks': blocks}
    reason = ''
    for name, limits in (('slow', Limits(repeating=math.inf)), ('now', Limits())):
        try:
            found[name] = self_calibrate(*given, limits=limits)
        except DataRefused as refusal:
            reason = str(refusal)
    return found, reason


def follow(fit: Fit, time: Array, output: Array, heading: Array) -> tuple[Array, Array]:
    """Return the error of the heading and its stated sigma, rad, without the last second."""
    turned = integrate(time, (output - fit.bias) / (1.0 + fit.scale_factor_error))
    turned = np.interp(time + fit.time_offset, time,
                       turned) - np.interp(max(fit.time_offset, 0.0), time, turned)
    known = quadratic_form(fit.covariance,
                           np.array([heading, time])) / (1.0 + fit.scale_factor_error) ** 2
    variance = known + NOISE.heading_variance(time) + fit.start_heading_deviation ** 2
    kept = time < time[-1] - 1.0
    return (turned + fit.start_heading - heading)[kept], np.sqrt(variance)[kept]


def row(log: Log, sense: float, begin: float,
        seconds: float) -> tuple[list[float], list[float], str]:
    """Return rms errors, sigmas of bias and final heading (deg), share inside, and refusal."""
    time, output, heading = part(log, sense, begin)
    found, reason = fits(time, output, heading, seconds)
    followed = {name: follow(fit, time, output, heading) for name, fit in found.items()}
    errors = [math.sqrt(np.mean(followed[name][0] ** 2)) / DEGREE if name in followed else math.nan
              for name in METHODS]
    if 'slow' not in followed:
        return errors, [math.nan] * 3, reason
    error, deviation = followed['slow']
    stated = [math.sqrt(found['slow'].covariance[1, 1]) / DEGREE, deviation[-1] / DEGREE,
              float(np.mean(np.abs(error) < 1.96 * deviation))]
    return errors, stated, reason


def line(name: str, seconds: float, errors: Array, stated: Array, last: str) -> str:
    """Return a line of a table."""
    numbers = ['-' if math.isnan(value) else f'{value:.2f}' for value in errors]
    said = ['-'] * 3 if math.isnan(stated[0]) else [f'{stated[0]:.3f}', f'{stated[1]:.1f}',
                                                    f'{100 * stated[2]:.1f} %']
    return f'| `{name}` | {seconds:.0f} s | ' + ' | '.join([*numbers, *said, last]) + ' |'


def header(last: str) -> list[str]:
    return ['| recording | on | none | eq. 7 | blocks | slow | now | stated (slow): bias, deg/s '
            f'| heading at the end, deg | inside 95 % | {last} |',
            '|---|---|---|---|---|---|---|---|---|---|---|']


def root_mean_square(values: Array) -> float:
    """Return that of the values that there are, or nan."""
    known = values[np.isfinite(values)]
    return math.sqrt(np.mean(known ** 2)) if len(known) else math.nan


def summary(stated: Array) -> Array:
    """Return the medians of the stated values, and the least share inside, of given runs."""
    known = stated[np.isfinite(stated[:, 0])]
    return np.append(np.median(known[:, :2], axis=0),
                     known[:, 2].min()) if len(known) else np.full(3, math.nan)


def tables(folder: Path, step: float) -> tuple[str, str]:
    """Return the tables from the beginning and from many: rms errors, least share inside."""
    first, many = header('refused'), header('refused')
    for name, sense in RECORDINGS.items():
        log = read_log(folder / 'mems_encoder_turntable' / f'{name}.csv.gz')
        begins = np.arange(0.0, log.time[-1] - FOLLOWED, step)
        for seconds in (20.0, 30.0, 60.0):
            rows = [row(log, sense, begin, seconds) for begin in begins]
            errors, stated = (np.array([each[place] for each in rows]) for place in (0, 1))
            first.append(line(name, seconds, errors[0], stated[0], rows[0][2]))
            many.append(line(name, seconds,
                             np.array([root_mean_square(column) for column in errors.T]),
                             summary(stated), f'{np.isnan(errors[:, -1]).sum()} of {len(begins)}'))
    return '\n'.join(first), '\n'.join(many)


if __name__ == '__main__':
    found = tables(Path(os.environ['GYRO_CALIBRATION_DATA']),
                   float(sys.argv[1]) if len(sys.argv) > 1 else 60.0)
    print('From the beginning of each recording, rms errors over five minutes in deg:\n\n'
          + found[0])
    print('\nFrom many beginnings, root mean squares (slow, now: of those not refused), medians '
          'of what was stated, and the least part inside:\n\n' + found[1])
