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

    python benchmarks/wild.py [FOLDER]           recordings, as `wheeled_drives`, by `diagnose`
    python benchmarks/wild.py drives FOLDER      the same by `fit`
    python benchmarks/wild.py together FOLDER    two drives of a unit, alone and together
    python benchmarks/wild.py simulated [DRIVES] drives of a simulator of its own, by `fit`

A model is judged by the heading that it gives in the half that it was not fitted on: the output is
corrected and integrated, and compared with the course within windows of 60 s, each less its mean,
at the lag where it fits best. Three models compete: nothing (no correction), a robust least
squares (course = (1 + s) integral + b t + c at the best lag, residuals by their size), and
`calibrate_encoder` or `diagnose` as the verbs call them. A refusal counts as nothing. Of diagnoses
it prints how many causes are found in the other half too, and how many values agree. With
`together` the model of two drives of a unit corrects two other drives of it.

The simulated car follows a bicycle model with side slip, its course comes at 10 Hz, smoothed over
some tenths of a second, late or early, with noise that is correlated over a second, gaps below a
walking speed and under bridges. The gyro has bias, scale factor error, white noise and a wandering
bias. None of it is code of the package.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
import math
import os
from pathlib import Path
import sys

from gyro_calibration.calibration.encoder import calibrate_encoder
from gyro_calibration.diagnosis.findings import Finding
from gyro_calibration.diagnosis.log_diagnosis import diagnose
from gyro_calibration.heading.integration import integrate
from gyro_calibration.heading.log_compensation import compensate_log
from gyro_calibration.logs.log import Array, DataRefused, DEGREE, Log, read_log, select_rows
import numpy as np

#: Length and distance of the windows, s; lags that are tried, s; distance of the points, s.
WINDOW, STEP, LAGS, POINT = 60.0, 15.0, np.arange(-100, 101) * 0.02, 0.1
#: What corrects the output of a log; what is said of it; the established causes.
Answer = tuple[Callable[[Log], Array], str, list[Finding]]


def points(log: Log, rate: Array, lag: float) -> tuple[Array, Array, Array]:
    """Return times, headings by rates, and courses where known, the gyro being `lag` s late."""
    known = np.flatnonzero(np.isfinite(log.reference_heading))
    at = known[np.unique(np.searchsorted(
        log.time[known], np.arange(log.time[known[0]], log.time[known[-1]], POINT)))]
    at = at[(log.time[at] + lag >= log.time[0]) & (log.time[at] + lag <= log.time[-1])]
    turned = np.interp(log.time[at] + lag, log.time, integrate(log.time, rate))
    return log.time[at], turned, log.reference_heading[at]


def error(log: Log, rate: Array) -> float:
    """Return the heading error by rates over windows, rms at the best lag, rad."""
    def at(lag: float) -> float:
        time, turned, course = points(log, rate, lag)
        parts = []
        for start in np.arange(time[0], max(time[-1] - WINDOW, time[0]) + 1e-6, STEP):
            inside = (time >= start) & (time < start + WINDOW)
            if inside.sum() > 50:
                off = (turned - course)[inside]
                parts.append(off - off.mean())
        return math.sqrt(float(np.mean(np.concatenate(parts) ** 2)))
    return min(at(lag) for lag in LAGS)


def robust(log: Log) -> tuple[float, float]:
    """Return bias and scale by least squares of the course, residuals counting by their size."""
    best = (math.inf, 0.0, 1.0)
    for lag in LAGS:
        time, turned, course = points(log, log.output, lag)
        columns, weights = np.column_stack([turned, time - time[0],
                                            np.ones(len(time))]), np.ones(len(time))
        for _ in range(8):
            values = np.linalg.lstsq(columns * weights[:, None], course * weights, rcond=None)[0]
            off = np.abs(course - columns @ values)
            weights = 1.0 / np.sqrt(np.maximum(off, max(float(np.median(off)), 1e-9)))
        if off.mean() < best[0]:
            best = (float(off.mean()), -values[1] / values[0], 1.0 / values[0])
    return best[1:]


def fitted(log: Log) -> Answer:
    """Calibrate as `fit` does."""
    found = calibrate_encoder(log).fit
    deviation = np.sqrt(np.diag(found.covariance))
    return (lambda other: (other.output - found.bias) / (1.0 + found.scale_factor_error),
            f's {100 * found.scale_factor_error:+.2f} +- {100 * deviation[0]:.2f} %, '
            f'b {found.bias / DEGREE:+.4f} +- {deviation[1] / DEGREE:.4f} deg/s, lag '
            f'{found.time_offset:+.2f} s', [])


def diagnosed(*logs: Log) -> Answer:
    """Calibrate as `diagnose` does, without a model."""
    found = diagnose(logs, np.random.default_rng(0))
    causes = [each for each in found.findings if each.status == 'established']
    return (lambda other: compensate_log(found.model, other),
            f'{found.verdict}: {", ".join(each.effect for each in causes)}', causes)


def agree(one: Finding, other: Finding) -> bool:
    """Tell whether two values of a cause are within their intervals of 95 % of each other."""
    a, b = one.parameters[one.effect], other.parameters[one.effect]
    half = math.hypot(*(0.5 * (each.interval[1] - each.interval[0]) for each in (a, b)))
    return abs(a.estimate - b.estimate) <= half + 1e-9 * abs(a.estimate)


def judged(name: str, log: Log, calibrate: Callable[[Log], Answer]
           ) -> Iterator[tuple[tuple[float, float, float], list[Finding]]]:
    """Print and give for each half the errors with nothing, by least squares, and by an answer."""
    is_second = log.time > log.time[0] + 0.5 * (log.time[-1] - log.time[0])
    for second in (False, True):
        mine, other = (select_rows(log, is_second == each) for each in (second, not second))
        bias, scale = robust(mine)
        nothing, squares = error(other, other.output), error(other, (other.output - bias) / scale)
        try:
            correct, words, causes = calibrate(mine)
            ours = error(other, correct(other))
        except DataRefused as refusal:
            ours, words, causes = math.nan, f'refused: {refusal}', []
        print(f'{name} {"second" if second else "first":6s} {nothing / DEGREE:8.3f} '
              f'{squares / DEGREE:8.3f} {ours / DEGREE:8.3f}  {words} | squares '
              f's {100 * (scale - 1):+.2f} % b {bias / DEGREE:+.4f}', flush=True)
        yield (nothing, squares, ours), causes


def summary(halves: list[tuple[tuple[float, float, float], list[Finding]]]) -> Iterator[str]:
    """Give the ratios to the better of nothing and least squares, and the causes found twice."""
    nothing, squares, ours = np.array([errors for errors, _ in halves]).T
    refused = np.isnan(ours)
    ratio = np.where(refused, nothing, ours) / np.minimum(nothing, squares)
    yield (f'{len(halves)} halves, {refused.sum()} refused; error over the better of nothing and '
           f'least squares: median {np.median(ratio):.2f}, nine in ten '
           f'{np.quantile(ratio, 0.9):.2f}, worst {ratio.max():.2f}; over least squares alone: '
           f'median {np.nanmedian(ours / squares):.2f}, nine in ten '
           f'{np.nanquantile(ours / squares, 0.9):.2f}')
    causes, twins = [each for _, found in halves for each in found], []
    for place, (_, found) in enumerate(halves):
        twins += [next((other for other in halves[place ^ 1][1]
                        if {each.effect, *each.ambiguous_with}
                        & {other.effect, *other.ambiguous_with}), None) for each in found]
    same = [agree(each, twin) for each, twin in zip(causes, twins) if twin is not None
            and each.effect == twin.effect and each.effect in each.parameters]
    if causes:
        yield (f'{sum(each is not None for each in twins)} of {len(causes)} causes in the other '
               f'half too; {sum(same)} of {len(same)} values agree')


def together(folder: Path) -> Iterator[str]:
    """Give the errors in two drives of a unit by its model of two others, alone and together."""
    drives, errors = ('hi', 'jk'), []
    for unit in range(1, 6):
        log_of = {drive: read_log(folder / f'rc_car_{drive}_unit{unit}.csv.gz')
                  for drive in 'hijk'}
        for mine, others in (drives, drives[::-1]):
            answers = [diagnosed(log_of[mine[0]]), diagnosed(log_of[mine[1]]),
                       diagnosed(*map(log_of.get, mine))]
            row = [math.hypot(*(error(log_of[each], correct(log_of[each])) for each in others))
                   / math.sqrt(2.0) / DEGREE for correct, _, _ in answers]
            errors.append(row)
            yield (f'unit {unit}, {mine} for {others}: first {row[0]:.3f}, second {row[1]:.3f}, '
                   f'together {row[2]:.3f} deg; {answers[2][1]}')
    first, second, both = np.sqrt(np.mean(np.square(errors), axis=0))
    yield (f'rms: first {first:.3f}, second {second:.3f}, together {both:.3f} deg; together '
           f'over the mean of the two: {both / math.sqrt(0.5 * (first ** 2 + second ** 2)):.2f}')


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
    speed = np.abs(np.interp(time, knots, generator.uniform(
        -2.0 if town else 0.5, 12.0 if town else 3.0, len(knots))))
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
    bad = np.convolve(generator.uniform(size=len(fixes)) < 0.003 * town, np.ones(30), mode='same')
    sizes = np.where(bad > 0.0, 6.0, 0.5) * DEGREE
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
    if arguments[:1] == ['together']:
        for line in together(Path(arguments[1])):
            print(line, flush=True)
        return
    by_fit = arguments[:1] in (['drives'], ['simulated'])
    if arguments[:1] == ['simulated']:
        drives = int(arguments[1]) if len(arguments) > 1 else 40
        print('\n'.join(held(drives)))
        logs = ((f'{"town" if town else "small car"} {seed}',
                 simulated(np.random.default_rng([seed, town]), town)[0]) for town in (False, True)
                for seed in range(max(drives // 4, 1)))
    else:
        recordings = os.environ.get('GYRO_CALIBRATION_DATA', '.')
        folder = Path(arguments[by_fit] if arguments[by_fit:] else f'{recordings}/wheeled_drives')
        logs = ((path.name.removesuffix('.csv.gz'), read_log(path))
                for path in sorted(folder.glob('*.csv.gz')) if 'as_recorded' not in path.name)
    calibrate = fitted if by_fit else diagnosed
    print('\n'.join(summary([half for name, log in logs
                             for half in judged(f'{name:24s}', log, calibrate)])))


if __name__ == '__main__':
    main(sys.argv[1:])
