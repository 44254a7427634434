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
Calibrate a gyro on half of a drive against its course over ground, and correct the other half.

    python benchmarks/courses.py drives FOLDER      recordings, as `wheeled_drives`
    python benchmarks/courses.py simulated [DRIVES] drives of a simulator of its own

A model is judged by the heading that it gives in the half that it was not fitted on: the output is
corrected and integrated, and compared with the course within windows of 60 s, each less its mean,
at the lag where it fits best. Three models compete: nothing (no correction), a robust least
squares (course = (1 + s) integral + b t + c at the best lag, residuals by their size), and
`calibrate_encoder` as the verb `fit` calls it. A refusal counts as nothing.

The simulated car follows a bicycle model with side slip, its course comes at 10 Hz, smoothed over
some tenths of a second, late or early, with noise that is correlated over a second, gaps below a
walking speed and under bridges. The gyro has bias, scale factor error, white noise and a wandering
bias. None of it is code of the package.

"""

from __future__ import annotations

from collections.abc import Iterator
import math
from pathlib import Path
import sys

from gyro_calibration.calibration.encoder import calibrate_encoder
from gyro_calibration.logs.log import Array, DataRefused, Log, read_log, select_rows
import numpy as np

DEGREE = math.pi / 180.0
#: Length and distance of the windows, s; lags that are tried, s; distance of the points, s.
WINDOW, STEP, LAGS, POINT = 60.0, 15.0, np.arange(-100, 101) * 0.02, 0.1


def half(log: Log, second: bool) -> Log:
    """Return the first or the second half of a log."""
    return select_rows(log, (log.time > log.time[0] + 0.5 *
                             (log.time[-1] - log.time[0])) == second)


def points(log: Log, lag: float, bias: float = 0.0,
           scale: float = 1.0) -> tuple[Array, Array, Array]:
    """
    Return times, corrected headings and courses at points where the course is known.

    The gyro being `lag` s late.
    """
    known = np.flatnonzero(np.isfinite(log.reference_heading))
    at = known[np.unique(
        np.searchsorted(log.time[known], np.arange(log.time[known[0]], log.time[known[-1]],
                                                   POINT)))]
    at = at[(log.time[at] + lag >= log.time[0]) & (log.time[at] + lag <= log.time[-1])]
    interval = np.diff(log.time, prepend=log.time[0])
    rate = (log.output - bias) / scale
    turned = np.cumsum(0.5 * (rate + np.append(rate[:1], rate[:-1])) * interval)
    return log.time[at], np.interp(log.time[at] + lag, log.time, turned), log.reference_heading[at]


def error(log: Log, bias: float, scale: float) -> float:
    """Return the heading error over windows, rms at the best lag, rad."""
    def at(lag: float) -> float:
        time, turned, course = points(log, lag, bias, scale)
        parts = []
        for start in np.arange(time[0], max(time[-1] - WINDOW, time[0]) + 1e-6, STEP):
            inside = (time >= start) & (time < start + WINDOW)
            if inside.sum() > 50:
                off = (turned - course)[inside]
                parts.append(off - off.mean())
        return math.sqrt(float(np.mean(np.concatenate(parts) ** 2)))
    return min(at(lag) for lag in LAGS)


def robust(log: Log) -> tuple[float, float]:
    """
    Return bias and scale by least squares of the course on the integral.

    Residuals counting by their size, at the best lag.
    """
    best = (math.inf, 0.0, 1.0)
    for lag in LAGS:
        time, turned, course = points(log, lag)
        columns, weights = np.column_stack([turned, time - time[0],
                                            np.ones(len(time))]), np.ones(len(time))
        for _ in range(8):
            values = np.linalg.lstsq(columns * weights[:, None], course * weights, rcond=None)[0]
            off = np.abs(course - columns @ values)
            weights = 1.0 / np.sqrt(np.maximum(off, max(float(np.median(off)), 1e-9)))
        if off.mean() < best[0]:
            best = (float(off.mean()), -values[1] / values[0], 1.0 / values[0])
    return best[1:]


def judged(name: str, log: Log) -> Iterator[tuple[str, float, float, float, str]]:
    """Give for each half the errors with nothing, by least squares, and by the calibration."""
    for second in (False, True):
        mine, other = half(log, second), half(log, not second)
        nothing, squares = error(other, 0.0, 1.0), error(other, *robust(mine))
        try:
            found = calibrate_encoder(mine).fit
            ours = error(other, found.bias, 1.0 + found.scale_factor_error)
            deviation = np.sqrt(np.diag(found.covariance))
            words = (f's {100 * found.scale_factor_error:+.2f} +- {100 * deviation[0]:.2f} %, '
                     f'b {found.bias / DEGREE:+.4f} +- {deviation[1] / DEGREE:.4f} deg/s, lag '
                     f'{found.time_offset:+.2f} s')
        except DataRefused as refusal:
            ours, words = math.nan, f'refused: {refusal}'
        s = robust(mine)
        words += f' | squares s {100 * (s[1] - 1):+.2f} % b {s[0] / DEGREE:+.4f}'
        yield f'{name} {"second" if second else "first"}', nothing, squares, ours, words


def table(rows: list[tuple[str, float, float, float, str]]) -> Iterator[str]:
    """Give a line a half, and the ratios to the better of nothing and least squares."""
    for name, nothing, squares, ours, words in rows:
        yield (f'{name:28s} {nothing / DEGREE:8.3f} {squares / DEGREE:8.3f} '
               f'{ours / DEGREE:8.3f}  {words}')
    values = np.array([row[1:4] for row in rows])
    refused = np.isnan(values[:, 2])
    ratio = np.where(refused, values[:, 0], values[:, 2]) / np.minimum(values[:, 0], values[:, 1])
    yield (f'{len(rows)} halves, {refused.sum()} refused; error over the better of nothing and '
           'least squares: median '
           f'{np.median(ratio):.2f}, nine in ten {np.quantile(ratio, 0.9):.2f}, worst '
           f'{ratio.max():.2f}; over least squares alone: median '
           f'{np.nanmedian(values[:, 2] / values[:, 1]):.2f}, nine in ten '
           f'{np.nanquantile(values[:, 2] / values[:, 1], 0.9):.2f}')


# a simulator of its own

RATE, FIXES = 100, 10  # Hz, of the gyro and of the course


def simulated(generator: np.random.Generator, town: bool) -> tuple[Log, float, float]:
    """
    Return a drive of four minutes, and the mean bias and the scale of its gyro.

    A car in town (little turning, stops, bursts of bad fixes, bias near zero) or a small quick one
    (turns all the time, a consumer gyro, another delay each drive).

    """
    count = 240 * RATE
    time = np.arange(count) / RATE
    knots = np.arange(0.0, 245.0, 6.0 if town else 2.5)
    steering = generator.standard_normal(len(knots)) * (4.0 if town else 35.0) * DEGREE
    if town:
        steering *= generator.uniform(size=len(knots)) < 0.4
    rate = np.interp(time, knots, steering)
    speed = np.abs(
        np.interp(time, knots,
                  generator.uniform(-2.0 if town else 0.5, 12.0 if town else 3.0, len(knots))))
    rate = rate * np.minimum(speed / 2.0, 1.0)
    heading = np.cumsum(rate) / RATE
    # bicycle model: the rear axle is `behind` the antenna, tyres slip in proportion to the lateral
    # acceleration
    behind, softness = generator.uniform(-0.1, 0.1) * (10.0 if town else 1.0), generator.uniform(
        0.0, 0.01)
    slip = behind * rate / np.maximum(speed, 0.5) - softness * speed * rate
    width = int(generator.uniform(0.2, 0.5) * RATE)
    course = np.convolve(heading + slip, np.ones(2 * width + 1) / (2 * width + 1), mode='same')
    fixes = np.arange(0, count, RATE // FIXES)
    noise, kept = np.zeros(len(fixes)), np.exp(-1.0 / FIXES)
    sizes = np.where(
        np.convolve(generator.uniform(size=len(fixes)) < 0.003 * town, np.ones(30), mode='same')
        > 0.0, 6.0, 0.5) * DEGREE
    for place in range(1, len(fixes)):
        noise[place] = kept * noise[place - 1] + math.sqrt(
            1.0 - kept ** 2) * sizes[place] * generator.standard_normal()
    late = generator.uniform(-0.2, 0.2) if town else generator.uniform(-0.75, 0.75)
    seen = np.interp(time - late, time[fixes], course[fixes] + noise)
    lost = (speed < (3.0 if town else 0.6)) | (np.abs(time - generator.uniform(50.0, 200.0)) < 4.0)
    seen[lost] = math.nan
    scale = 1.0 + generator.standard_normal() * (0.002 if town else 0.01)
    bias = generator.standard_normal() * (0.01 if town else 0.5) * DEGREE
    walk = np.cumsum(generator.standard_normal(count)) * 0.0004 * DEGREE / math.sqrt(RATE)
    output = scale * rate + bias + walk + generator.standard_normal(
        count) * 0.01 * DEGREE * math.sqrt(RATE)
    return Log(time=time, output=output, reference_heading=seen), bias + walk.mean(), scale


def held(drives: int) -> Iterator[str]:
    """Give the errors of the values, and the share of intervals that hold the truth."""
    for town in (False, True):
        found = []
        for seed in range(drives):
            log, bias, scale = simulated(np.random.default_rng([seed, town]), town)
            # diagnose states the same values
            fit = calibrate_encoder(log, 'course').fit
            found.append(([fit.scale_factor_error - scale + 1.0, fit.bias - bias],
                          1.96 * np.sqrt(np.diag(fit.covariance))))
        off, half_width = np.moveaxis(np.array(found), 1, 0)
        share = np.mean(np.abs(off) < half_width, axis=0)
        rms = np.sqrt(np.mean(off ** 2, axis=0))
        yield (f'{"town" if town else "small car"}: 95 % intervals of {drives} drives hold s in '
               f'{share[0]:.2f}, b in {share[1]:.2f}; rms error of s {100.0 * rms[0]:.3f} %, '
               f'of b {rms[1] / DEGREE:.4f} deg/s')


def main(arguments: list[str]) -> None:
    """Print the table."""
    if arguments[:1] == ['drives']:
        files = sorted(Path(arguments[1]).glob('*.csv.gz'))
        logs = ((path.name.removesuffix('.csv.gz'), read_log(path)) for path in files
                if 'as_recorded' not in path.name)
    elif arguments[:1] == ['simulated']:
        drives = int(arguments[1]) if len(arguments) > 1 else 40
        print('\n'.join(held(drives)))
        logs = ((f'{"town" if town else "small car"} {seed}',
                 simulated(np.random.default_rng([seed, town]), town)[0]) for town in (False, True)
                for seed in range(max(drives // 4, 1)))
    else:
        raise SystemExit(__doc__)
    rows = [row for name, log in logs for row in judged(name, log)]
    print('\n'.join(table(rows)))


if __name__ == '__main__':
    main(sys.argv[1:])
