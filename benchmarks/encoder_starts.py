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
Calibrate on the first 20, 30 or 60 s of a swing against an encoder.

And follow it for five minutes.

    python benchmarks/encoder_starts.py FOLDER [STEP [FIRST]]

FOLDER holds `mems_encoder_turntable`; there is a beginning every STEP s from FIRST s on.

Prints the heading error over five minutes, rms in deg about its mean, the delay being the one that
fits best: with nothing, with plain least squares on increments over 0.5 s (delay on a grid), and
with `calibrate_encoder`; the root mean squares over the beginnings, the share of refusals, and how
often a calibration that was answered is worse than nothing.

"""

from __future__ import annotations

import math
from pathlib import Path
import sys

from gyro_calibration.calibration.encoder import calibrate_encoder
from gyro_calibration.heading.integration import integrate
from gyro_calibration.logs.log import Array, DataRefused, Log, read_log
import numpy as np

DEGREE = math.pi / 180.0
FOLLOWED, BLOCK = 300.0, 0.5
SENSE = {'yaw_slow': -1.0, 'pitch_slow': 1.0, 'yaw_fast': -1.0}
LAGS = np.arange(-20, 21) * 0.004


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


def error(time: Array, output: Array, heading: Array, bias: float, scale: float) -> float:
    """Return the heading error, rms about its mean, deg, at the best delay."""
    turned = integrate(time, (output - bias) / (1.0 + scale))
    return min(
        float(np.std(np.interp(time + lag, time, turned)[50:-50] - heading[50:-50]))
        for lag in LAGS[::2]) / DEGREE


def main(folder: Path, step: float = 120.0, first: float = 0.0) -> None:
    """Print the table."""
    print('| recording | on | nothing | increments | calibrated | the same, refusals as nothing | '
          'refused | worse than nothing |')
    print('|---|---|---|---|---|---|---|---|')
    for name, sense in SENSE.items():
        log = read_log(folder / 'mems_encoder_turntable' / f'{name}.csv.gz')
        for seconds in (20.0, 30.0, 60.0):
            rows = []
            for begin in np.arange(first, log.time[-1] - FOLLOWED, step):
                inside = (log.time >= begin) & (log.time < begin + FOLLOWED)
                whole = (log.time[inside] - begin, sense * log.output[inside],
                         log.reference_heading[inside])
                given = [values[whole[0] < seconds] for values in whole]
                nothing, plain = error(*whole, 0.0, 0.0), error(*whole, *squares(*given))
                try:
                    fit = calibrate_encoder(
                        Log(time=given[0], output=given[1], reference_heading=given[2])).fit
                    ours = error(*whole, fit.bias, fit.scale_factor_error)
                except DataRefused:
                    ours = math.nan
                rows.append((nothing, plain, ours, nothing if math.isnan(ours) else ours))
            values = np.array(rows)
            sizes = np.sqrt(np.nanmean(values ** 2, axis=0))
            print(f'| `{name}` | {seconds:.0f} s | ' + ' | '.join(f'{size:.1f}' for size in sizes)
                  + f' | {np.isnan(values[:, 2]).sum()} of {len(values)} | '
                    f'{(values[:, 2] > values[:, 0]).sum()} |', flush=True)


if __name__ == '__main__':
    main(Path(sys.argv[1]), *(float(word) for word in sys.argv[2:4]))
