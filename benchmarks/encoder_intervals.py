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
Measure the coverage of 95 % intervals of scale factor error and bias with a wandering bias.

    python benchmarks/encoder_intervals.py [RUNS]
    python benchmarks/encoder_intervals.py motions [RUNS]
    python benchmarks/encoder_intervals.py smoothings [RUNS]
    python benchmarks/encoder_intervals.py eccentric [RUNS [SEED]]

Ten minutes at 20 Hz to and fro, an encoder of 0.088 deg, s = 2 %, b = 0.3 deg/s at the beginning,
white noise of 0.3 deg/sqrt(h). Prints a table in Markdown. The true bias is the one at the
beginning, from which it wanders; for the drift with temperature it is the mean over the log, which
is the best for a model without a term for it.

With `motions`, two minutes at 100 Hz of a robot, by hand, of a wheel, and of swings of one
frequency, beside references of several kinds, with a bias that wanders as a Gauss-Markov process
of 2 to 20 s; b is compared with its mean. The simulator shares nothing with the package.

With `smoothings`, 30 s of swings of one frequency (0.05 to 0.6 Hz) and of a robot, beside a
reference with noise of 0.003 deg that was delayed or smoothed before, or an encoder of such a
shaft.

With `eccentric`, one to four minutes at 50 or 100 Hz of constant rates, of one rate between two
rests, of even swings to and fro, and of sines, beside an encoder that errs by 0 to 1 deg once in a
revolution, without steps or with steps of 0.01 to 0.35 deg.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
import sys
import warnings

from gyro_calibration.calibration.encoder import calibrate_encoder
from gyro_calibration.logs.log import Array, DataRefused, DEGREE, Log
from gyro_calibration.model.motion import Motion, motion_from_rates
from gyro_calibration.model.noise import Noise, simulate_noise
import numpy as np
from scipy.ndimage import gaussian_filter1d, uniform_filter1d
from scipy.signal import lfilter

SCALE_FACTOR_ERROR, BIAS, STEP, INTERVAL = 0.02, 0.3 * DEGREE, 0.088 * DEGREE, 0.05
WHITE, FLICKER, WALK = 0.3 * DEGREE / 60, 20 * DEGREE / 3600, 1.0 * DEGREE / 3600
#: Noise, and drift of the bias with the temperature, rad/s, as the gyro warms up with a time
#: constant of a third of the log.
CASES = {'white': (Noise(WHITE), 0.0), 'white, flicker': (Noise(WHITE, FLICKER), 0.0),
         'white, rate random walk': (Noise(WHITE, 0.0, WALK), 0.0),
         'white, flicker, rate random walk': (Noise(WHITE, FLICKER, WALK), 0.0),
         'white, flicker, drift with temperature': (Noise(WHITE, FLICKER), 0.03 * DEGREE)}


def swing(duration: float, generator: np.random.Generator, half: float = 4.0) -> Motion:
    """Return a motion to and fro at 55 to 65 deg/s, each way in `half` s, with rests of 0.4 s."""
    starts = np.arange(0.0, duration, half)
    knots = (starts[:, None] + (0.0, 0.3, half - 0.7, half - 0.4)).ravel()
    speeds = np.where(np.arange(len(starts)) % 2, -1.0,
                      1.0) * generator.uniform(55.0, 65.0, len(starts)) * DEGREE
    return motion_from_rates(knots, (speeds[:, None] * (0.0, 1.0, 1.0, 0.0)).ravel())


def simulated(noise: Noise, drift: float, generator: np.random.Generator,
              duration: float) -> tuple[Log, Array]:
    """Return a log, and the true (s, b)."""
    time = np.arange(round(duration / INTERVAL)) * INTERVAL
    motion = swing(duration, generator)
    warming = drift * (1.0 - np.exp(-3.0 * time / duration))
    output = (1.0 + SCALE_FACTOR_ERROR) * motion.rate_at(time) + BIAS + warming + simulate_noise(
        noise, len(time), INTERVAL, generator)
    heading = np.round((motion.heading_at(time) + generator.uniform(0.0, STEP)) / STEP) * STEP
    return (Log(output=output, time=time, reference_heading=heading),
            np.array([SCALE_FACTOR_ERROR, BIAS + warming.mean()]))


def run(case: tuple[str, int, float]) -> Array:
    """Return error and standard deviation of s and b of one run, shape (2, 2)."""
    name, seed, duration = case
    log, truth = simulated(*CASES[name], np.random.default_rng([seed, list(CASES).index(name)]),
                           duration)
    fit = calibrate_encoder(log).fit
    return np.array([(fit.scale_factor_error, fit.bias) - truth, np.sqrt(np.diag(fit.covariance))])


def table(runs: int, duration: float = 600.0) -> Iterator[str]:
    yield '| noise | s within | b within | rms error of s | stated | rms error of b | stated |'
    yield '|---|---|---|---|---|---|---|'
    with ProcessPoolExecutor() as pool:
        for name in CASES:
            found = np.array(list(pool.map(run, [(name, seed, duration) for seed in range(runs)],
                                           chunksize=5)))
            within = 100.0 * (np.abs(found[:, 0]) < 1.96 * found[:, 1]).mean(axis=0)
            (s, b), (s_stated,
                     b_stated) = np.sqrt((found ** 2).mean(axis=0)) * (100.0, 1.0 / DEGREE)
            yield (f'| {name} | {within[0]:.1f} % | {within[1]:.1f} % | {s:.5f} % '
                   f'| {s_stated:.5f} % | {b:.5f} deg/s | {b_stated:.5f} deg/s |')


def moved(kind: str, count: int, generator: np.random.Generator) -> Array:
    """Return rates at 100 Hz, rad/s, of a kind of motion."""
    if kind == 'robot':
        rate, row = np.zeros(count), 300
        while row < count:
            end = row + int(generator.uniform(100, 400))
            rate[row:end] = generator.choice([-1.0, 1.0]) * generator.uniform(20.0, 90.0)
            row = end + int(generator.uniform(50, 300))
        rate = gaussian_filter1d(rate, 15.0)
    elif kind == 'hand':
        rate = gaussian_filter1d(generator.standard_normal(count), 25.0)
        rate *= 60.0 / rate.std()
    elif kind == 'wheel':
        rate = gaussian_filter1d(np.repeat(generator.normal(0.0, 40.0, count // 200), 200), 30.0)
    else:
        rate = 60.0 * np.sin(2.0 * np.pi * float(kind) * np.arange(count) * 0.01)
    return rate * DEGREE


def referred(kind: str, heading: Array, generator: np.random.Generator) -> Array:
    """Return headings of a kind of reference, rad."""
    noise = generator.standard_normal(len(heading)) * DEGREE
    if kind == 'encoder':
        return np.round(heading / (0.088 * DEGREE)) * 0.088 * DEGREE
    if kind == 'smoothed':
        heading = uniform_filter1d(heading, 25)
    elif kind == '10 Hz':
        heading = np.where(np.arange(len(heading)) % 10 == 0, heading, np.nan)
    return heading + (0.1 if kind == 'noisy' else 0.003) * noise


def run_motion(case: tuple[str, str, float, int]) -> Array:
    """Return error and standard deviation of s and b of one run, shape (2, 2), nan if refused."""
    motion, reference, wander, seed = case
    generator = np.random.default_rng([seed, *map(ord, motion + reference), round(1e3 * wander)])
    time = np.arange(12000) * 0.01
    rate = moved(motion, len(time), generator)
    heading = np.append(0.0, np.cumsum(0.005 * (rate[1:] + rate[:-1])))
    kept = 1.0 - 0.01 / np.exp(generator.uniform(np.log(2.0), np.log(20.0)))
    bias = wander * DEGREE * lfilter([np.sqrt(1.0 - kept ** 2)], [1.0, -kept],
                                     generator.standard_normal(len(time)))
    s = generator.uniform(-0.02, 0.02)
    output = ((1.0 + s) * rate + 0.1 * DEGREE + bias
              + 0.05 * DEGREE * generator.standard_normal(len(time)))
    try:
        fit = calibrate_encoder(Log(output=output, time=time, reference_heading=referred(
            reference, heading, generator)), 'likelihood').fit
    except DataRefused:
        return np.full((2, 2), np.nan)
    return np.array([(fit.scale_factor_error - s, fit.bias - 0.1 * DEGREE - bias.mean()),
                     np.sqrt(np.diag(fit.covariance))])


def table_of_motions(runs: int) -> Iterator[str]:
    yield '| motion | reference | wander, deg/s | rms error of s | standardized | refused |'
    yield '|---|---|---|---|---|---|'
    cases = [*((motion, reference, wander) for motion in ('robot', 'hand', 'wheel')
               for reference in ('fine', 'noisy', 'encoder', 'smoothed', '10 Hz')
               for wander in (0.0, 0.02, 0.2)),
             *((hertz, reference, 0.0) for hertz in ('0.2', '0.4', '0.8')
               for reference in ('fine', 'encoder'))]
    with ProcessPoolExecutor(initializer=warnings.simplefilter, initargs=('ignore',)) as pool:
        for motion, reference, wander in cases:
            found = np.array(list(pool.map(
                run_motion, [(motion, reference, wander, seed) for seed in range(runs)])))
            s, ratio = np.sqrt(np.nanmean([found[:, 0, 0] ** 2,
                                           (found[:, 0, 0] / found[:, 1, 0]) ** 2], axis=1))
            yield (f'| {motion} | {reference} | {wander:g} | {100.0 * s:.4f} % | {ratio:.2f} '
                   f'| {np.isnan(found[:, 0, 0]).sum()} of {runs} |')


SMOOTHINGS = {
    'none': lambda heading: heading,
    'delay, 0.1 s': lambda heading: np.roll(heading, 10),
    'mean, 0.2 s': lambda heading: lfilter(np.full(20, 0.05), [1.0], heading),
    'mean, 0.4 s': lambda heading: lfilter(np.full(40, 0.025), [1.0], heading),
    'first order, 0.1 s': lambda heading: lfilter([0.1], [1.0, -0.9], heading),
    'mean, 0.2 s, no delay': lambda heading: uniform_filter1d(heading, 20),
    'Gaussian, 0.1 s, no delay': lambda heading: gaussian_filter1d(heading, 10.0),
    'Gaussian, 0.2 s, no delay': lambda heading: gaussian_filter1d(heading, 20.0)}


def run_smoothing(case: tuple[str, str, str, int]) -> Array:
    """Return error and standard deviation of s of one run, nan if refused, shape (2,)."""
    motion, smoothing, reference, seed = case
    generator = np.random.default_rng([seed, 7, *map(ord, motion + smoothing + reference)])
    kind = (motion if motion != 'swing'
            else f'{np.exp(generator.uniform(np.log(0.05), np.log(0.6))):f}')
    rate = moved(kind, 3600, generator)
    heading = np.append(0.0, np.cumsum(0.005 * (rate[1:] + rate[:-1])))
    heading = SMOOTHINGS[smoothing](heading)[300:3300]
    s = generator.uniform(-0.02, 0.02)
    output = ((1.0 + s) * rate[300:3300] + 0.1 * DEGREE
              + 0.05 * DEGREE * generator.standard_normal(3000))
    try:
        fit = calibrate_encoder(Log(output=output, time=np.arange(3000) * 0.01,
                                    reference_heading=referred(reference, heading, generator)),
                                'likelihood').fit
    except DataRefused:
        return np.full(2, np.nan)
    return np.array([fit.scale_factor_error - s, np.sqrt(fit.covariance[0, 0])])


def table_of_smoothings(runs: int) -> Iterator[str]:
    yield ('| motion | reference | smoothing | rms error of s | stated, median | within '
           '| standardized, largest | refused |')
    yield '|---|---|---|---|---|---|---|---|'
    with ProcessPoolExecutor(initializer=warnings.simplefilter, initargs=('ignore',)) as pool:
        for motion in ('swing', 'robot'):
            for reference in ('fine', 'encoder'):
                for smoothing in SMOOTHINGS:
                    error, stated = np.array(list(pool.map(run_smoothing, [
                        (motion, smoothing, reference, seed) for seed in range(runs)]))).T
                    ratio = np.abs(error / stated)[np.isfinite(error)]
                    yield (f'| {motion} | {reference} | {smoothing} '
                           f'| {100.0 * np.sqrt(np.nanmean(error ** 2)):.4f} % '
                           f'| {100.0 * np.nanmedian(stated):.4f} % '
                           f'| {100.0 * np.mean(ratio < 1.96):.0f} % | {ratio.max():.1f} '
                           f'| {np.isnan(error).sum()} of {runs} |')


def turned(kind: str, count: int, frequency: int, generator: np.random.Generator) -> Array:
    """Return rates on a turntable, deg/s, of a kind of motion."""
    if 'sine' in kind:
        half = generator.uniform(60.0, 200.0) if kind == 'sine' else generator.uniform(15.0, 45.0)
        cycle = 2.0 * np.pi / (frequency * generator.uniform(4.0, 20.0))
        return half * frequency * cycle * np.cos(cycle * np.arange(count))
    rate, row, sign = np.zeros(count), 2 * frequency, 1.0
    half, speed = generator.uniform(90.0, 360.0), generator.uniform(20.0, 90.0)
    if kind == 'one rate':
        rate[count // 5:-(count // 5)] = generator.choice([-1, 1]) * generator.uniform(10.0, 80.0)
        row = count
    while row < count:
        steps = kind == 'steps'
        length = int(frequency * (generator.uniform(4.0, 15.0) if steps else half / speed))
        rate[row:row + length] = (generator.uniform(-100.0, 100.0) if steps else sign * speed)
        sign, row = -sign, row + length + int(frequency * generator.choice([0.0, 0.5, 3.0]))
    return uniform_filter1d(rate, frequency // 2)


def run_eccentric(case: tuple[str, float, int]) -> Array:
    """Return error and standard deviation of s and b of one run, shape (2, 2), nan if refused."""
    kind, size, seed = case
    generator = np.random.default_rng([seed, 11, *map(ord, kind), round(1e3 * size)])
    frequency = int(generator.choice([50, 100]))
    count = int(generator.uniform(60.0, 240.0) * frequency)
    rate = turned(kind, count, frequency, generator)
    heading = (generator.uniform(0.0, 360.0)
               + np.append(0.0, np.cumsum(0.5 * (rate[1:] + rate[:-1]) / frequency)))
    read = heading + size * np.sin(heading * DEGREE + generator.uniform(0.0, 2.0 * np.pi))
    step = generator.choice([0.0, 0.01, 0.088, 0.35])
    read = (np.round(read / step) * step if step
            else read + 0.003 * generator.standard_normal(count))
    s, b = generator.uniform(-0.02, 0.02), generator.uniform(-0.5, 0.5)
    output = (1.0 + s) * rate + b + 10.0 ** generator.uniform(
        -2.3, -0.7) * generator.standard_normal(count)
    try:
        fit = calibrate_encoder(Log(output=output * DEGREE, time=np.arange(count) / frequency,
                                    reference_heading=read * DEGREE)).fit
    except DataRefused:
        return np.full((2, 2), np.nan)
    return np.array([(fit.scale_factor_error - s, fit.bias - b * DEGREE),
                     np.sqrt(np.diag(fit.covariance))])


def table_of_eccentric(runs: int, seed: int = 1) -> Iterator[str]:
    yield ('| motion | error of the encoder, deg | s within | b within | largest, s | rms error '
           'of s | stated, median | refused |')
    yield '|---|---|---|---|---|---|---|---|'
    with ProcessPoolExecutor(initializer=warnings.simplefilter, initargs=('ignore',)) as pool:
        for kind in ('steps', 'one rate', 'swing', 'sine', 'small sine'):
            for size in (0.0, 0.05, 0.2, 1.0):
                found = np.array(list(pool.map(run_eccentric, [
                    (kind, size, seed + number) for number in range(runs)])))
                answered = found[np.isfinite(found[:, 0, 0])]
                ratio = np.abs(answered[:, 0] / answered[:, 1])
                within = 100.0 * np.mean(ratio < 1.96, axis=0)
                yield (f'| {kind} | {size:g} | {within[0]:.0f} % | {within[1]:.0f} % '
                       f'| {ratio[:, 0].max():.1f} '
                       f'| {100.0 * np.sqrt(np.mean(answered[:, 0, 0] ** 2)):.4f} % '
                       f'| {100.0 * np.median(answered[:, 1, 0]):.4f} % '
                       f'| {runs - len(answered)} of {runs} |')


if __name__ == '__main__':
    tables = {'motions': (table_of_motions, 12), 'smoothings': (table_of_smoothings, 12),
              'eccentric': (table_of_eccentric, 12)}
    asked = sys.argv[1:2] if sys.argv[1:2] and sys.argv[1] in tables else []
    rows, usual = tables[asked[0]] if asked else (table, 400)
    counts = [int(word) for word in sys.argv[1 + len(asked):3 + len(asked)]]
    for line in rows(*counts or [usual]):
        print(line, flush=True)
