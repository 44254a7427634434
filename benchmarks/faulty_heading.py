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
Measure the heading error due to lost samples and bursts of a USB adapter, in drives of 30 min.

    python benchmarks/faulty_heading.py [--drives 16] [--rate 100] [--minutes 30]

The program follows random drives of `drives.py`, each after a calibration of 20 s, from rest to
rest: once with all samples and exact stamps, and again with faults. Samples are lost singly on the
way to an adapter that delivers bytes every 16 ms to a host that wakes up slightly late. Stamps are
those of the driver's `SampleClock`, with or without a sequence number of the gyro; or those of
other drivers: the time of arrival, or the nominal interval for each sample received, which ignores
lost time.

An error is the root mean square over all drives and all minutes of a drive. Its growth is paired
with the clean run of the same drive; its 95 % interval is by bootstrap over the drives. The added
error is the root mean square of the difference from the clean run.
"""

import argparse
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
import math
import os

os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

from drives import begun_any_time, GYROS, of_motion, random_path, STEP
from gyro_calibration.calibration.self_calibration import self_calibrate, to_model_record
from gyro_calibration.driver.protocols import Sample
from gyro_calibration.driver.timestamps import SampleClock
from gyro_calibration.heading.integration import integrate
from gyro_calibration.heading.tracker import TrackerSettings
from gyro_calibration.logs.log import Array, DataRefused, DEGREE
from gyro_calibration.model.compensation import rate_sensitivity, uncertainty_covariance
from gyro_calibration.model.gyro_model import GyroModel
from gyro_calibration.model.motion import CALIBRATION_MOTION
from gyro_calibration.model.noise import simulate_noise
from gyro_calibration.model.presets import Preset
from heading_track import track
import numpy as np

BURST = 0.016  # s; what an FTDI adapter collects by default
WAKE_UP = 2e-4  # s; mean of what a host is late by
MODULUS = 128  # of the sequence, as the KVH 1750 counts
LOOK = 60.0  # s


@dataclass(frozen=True)
class Fault:
    """Share of lost samples; stamps 'gyro', 'sequence', 'no sequence', 'arrival', 'interval'."""

    lost: float
    stamps: str


FAULTS = {
    'clean': Fault(0.0, 'gyro'),
    'bursts': Fault(0.0, 'sequence'),
    '1 % lost, bursts': Fault(0.01, 'sequence'),
    '5 % lost, bursts': Fault(0.05, 'sequence'),
    '10 % lost, bursts': Fault(0.1, 'sequence'),
    '1 % lost without a trace, bursts': Fault(0.01, 'no sequence'),
    '1 % lost, stamped at arrival': Fault(0.01, 'arrival'),
    '1 % lost, usual interval for each': Fault(0.01, 'interval'),
}


@dataclass(frozen=True)
class Drive:
    """Times, s, compensated rates, rad/s, true headings, rad, shape (n,) each, and the model."""

    time: Array
    rate: Array
    heading: Array
    model: GyroModel
    interval: float


def simulate(gyro: Preset, interval: float, duration: float,
             generator: np.random.Generator) -> Drive:
    """Return a drive with the calibration before it; one that is refused is run again."""
    begin, way = of_motion(CALIBRATION_MOTION), begun_any_time(random_path(duration, generator),
                                                               generator)
    coarse = np.concatenate([begin.rate[:-1], way.rate])
    time = np.arange(round((len(coarse) - 1) * STEP / interval) + 1) * interval
    true = np.interp(time, np.arange(len(coarse)) * STEP, coarse)
    s, b = gyro.scale_factor_error, gyro.bias * DEGREE
    first = round(CALIBRATION_MOTION.duration / interval)
    while True:
        output = (1.0 + s) * true + b + simulate_noise(gyro.model.noise, len(true), interval,
                                                       generator)
        try:
            fit = self_calibrate(time[:first + 1], output[:first + 1], CALIBRATION_MOTION,
                                 noise=gyro.model.noise)
            break
        except DataRefused:
            continue
    calibration = to_model_record(fit, 'likelihood', '', None)
    model = replace(gyro.model, terms=(), self_calibration=calibration)
    heading = integrate(time[first:], true[first:])
    return Drive(time[first:] - time[first], np.asarray(calibration.correct(output[first:])),
                 heading, model, interval)


def arrivals(time: Array, generator: np.random.Generator) -> Array:
    """Return when samples arrive that were sent at times, s, in bursts."""
    burst = np.ceil(time / BURST + 1e-9)
    number = np.unique(burst, return_inverse=True)[1]
    return np.asarray(burst * BURST + generator.exponential(WAKE_UP, number.max() + 1)[number])


def stamped(time: Array, number: Array, stamps: str, interval: float,
            generator: np.random.Generator) -> Array:
    """Return the stamps, s, of samples that were sent at times, s, and were so many there."""
    if stamps == 'gyro':
        return time
    if stamps == 'interval':
        return np.arange(len(time)) * interval
    come = arrivals(time, generator)
    if stamps == 'arrival':
        return come + 1e-6 * np.arange(len(come))
    clock = SampleClock(1.0 / interval, MODULUS if stamps == 'sequence' else 0)
    pieces = np.split(number, np.flatnonzero(np.diff(come) > 0.0) + 1)
    ends = come[np.cumsum([len(piece) for piece in pieces]) - 1]
    return np.concatenate([
        clock.stamp_samples([Sample(0.0, sequence=int(each) % MODULUS) for each in piece],
                            float(end)) for piece, end in zip(pieces, ends)])


def errors(drive: Drive, fault: Fault, generator: np.random.Generator) -> tuple[Array, Array]:
    """Return what the heading is off by every `LOOK` s, rad, and its variance there, rad²."""
    comes = generator.random(len(drive.time)) >= fault.lost
    comes[0] = comes[-1] = True
    number = np.flatnonzero(comes)
    stamps, rate = (stamped(drive.time[comes], number, fault.stamps, drive.interval, generator),
                    drive.rate[comes])
    sensitivity, still = (rate_sensitivity(drive.model, value, value, 25.0)
                          for value in (rate, 0.0))
    found = track(stamps, rate, sensitivity, drive.model.noise,
                  uncertainty_covariance(drive.model), TrackerSettings(), still=still)
    looks = np.searchsorted(drive.time[comes], np.arange(LOOK, drive.time[-1] + 0.5 * LOOK,
                                                         LOOK)).clip(max=len(rate) - 1)
    return (found.heading - drive.heading[comes])[looks], found.variance[looks]


def one(job: tuple[str, float, float, int, tuple[str, ...]]) -> dict[str, tuple[Array, Array]]:
    """Return errors and variances of one drive with each fault."""
    name, interval, duration, seed, faults = job
    drive = simulate(GYROS[name], interval, duration, np.random.default_rng(seed))
    return {fault: errors(drive, FAULTS[fault], np.random.default_rng([seed, number]))
            for number, fault in enumerate(faults)}


def growth(clean: Array, faulty: Array,
           generator: np.random.Generator) -> tuple[float, float, float]:
    """Return the growth of the error, %, and its 95 % interval, for errors (drives, looks)."""
    squares = np.array([np.mean(each ** 2, axis=1) for each in (clean, faulty)])
    drawn = squares[:, generator.integers(0, len(clean), (4000, len(clean)))].mean(axis=2)
    low, high = np.quantile(np.sqrt(drawn[1] / drawn[0]), [0.025, 0.975])
    return tuple(100.0 * (ratio - 1.0)
                 for ratio in (math.sqrt(squares[1].mean() / squares[0].mean()), low, high))


def table(name: str, interval: float, found: list[dict[str, tuple[Array, Array]]]) -> str:
    lines = [f'{name} at {1.0 / interval:g} Hz, {len(found)} drives', '',
             '| line | error, deg | growth, % | 95 % | added, deg | error² / variance |',
             '|:---|---:|---:|---:|---:|---:|']
    clean, _ = (np.array(values) for values in zip(*(each['clean'] for each in found)))
    for fault in found[0]:
        faulty, variance = (np.array(values) for values in zip(*(each[fault] for each in found)))
        grown, low, high = growth(clean, faulty, np.random.default_rng(0))
        error, added = (math.sqrt(np.mean(values ** 2)) / DEGREE
                        for values in (faulty, faulty - clean))
        size = np.mean(faulty ** 2 / variance)
        lines.append(f'| {fault} | {error:.3f} | {grown:.1f} | {low:.1f} to {high:.1f} '
                     f'| {added:.3f} | {size:.2f} |')
    return '\n'.join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition('\n\n')[0])
    parser.add_argument('--drives', type=int, default=16)
    parser.add_argument('--rate', type=float, default=100.0, help='samples a second')
    parser.add_argument('--minutes', type=float, default=30.0)
    parser.add_argument('--gyros', nargs='+', default=['XV3500', 'RD2100'])
    parser.add_argument('--faults', nargs='+', default=list(FAULTS), choices=list(FAULTS))
    given = parser.parse_args()
    interval, faults = 1.0 / given.rate, tuple(dict.fromkeys(['clean', *given.faults]))
    with ProcessPoolExecutor(os.cpu_count()) as workers:
        for name in given.gyros:
            jobs = [(name, interval, 60.0 * given.minutes, seed, faults)
                    for seed in range(given.drives)]
            print(table(name, interval, list(workers.map(one, jobs))), end='\n\n', flush=True)


if __name__ == '__main__':
    main()
