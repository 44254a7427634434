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
Compare the tracked heading with an oracle that is told when the robot rests.

    python benchmarks/heading_oracle.py [--drives N] [--only TEXT] [--seed N] [--minutes M]
                                        [--wheels] [--off DEG_PER_S]

Four gyros on six kinds of drive, of which three never rest. Noise, motion and oracle are computed
here and share nothing with the package: flicker is a sum of Gauss-Markov processes half a decade
apart, a straight way wobbles at random, and the oracle (`bounds`) is a Kalman filter and smoother
over steps of 0.5 s that is told when the robot rests and knows the noise. Both begin with a rest
of 20 s before the drive and a scale factor known within 0.05 %.

The table has the mean absolute heading error of the oracle and, as a ratio to it, that of this
program, live and with hindsight, and the share of all looks (one a second) inside the stated 95 %,
with its standard error by the scatter between drives, in which looks are not independent. The
share of the oracle shows by how much such a sample of drives differs from 95 % by chance. z is the
rms error at the end of a drive over the stated standard deviation.
The oracle of drives without rests has the calibration alone. With ``--wheels`` this program is
told the rests too; with ``--off`` the bias of its calibration, but not that of the oracle, is off.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
import math

from bounds import CONSTANTS, prior, RATIO, told_rests
from gyro_calibration.heading.tracker import TrackerSettings
from gyro_calibration.model.compensation import rate_sensitivity, uncertainty_covariance
from gyro_calibration.model.gyro_model import GyroModel, SelfCalibration
from gyro_calibration.model.noise import Noise
from heading_track import track
import numpy as np
from scipy.signal import lfilter

DEG = math.pi / 180.0
#: The scale factor is known within, 1; the rest before the drive lasts, s.
SCALE, CALIBRATED = 0.0005, 20.0
#: Of a squared normal error over its variance, 95 % are below.
BAND = 3.841


@dataclass(frozen=True)
class Gyro:
    """Noise, and the interval of the samples, s."""

    noise: Noise
    interval: float


def gyro(walk: float, instability: float, rate_walk: float, rate: float) -> Gyro:
    """Return a gyro by deg/√h, deg/h, deg/h/√h and samples a second."""
    return Gyro(Noise(walk * DEG / 60.0, instability * DEG / 3600.0, rate_walk * DEG / 216000.0),
                1.0 / rate)


GYROS = {
    'fibre optic': gyro(0.02, 0.3, 0.0, 100.0),
    'good MEMS': gyro(0.3, 6.0, 10.0, 100.0),
    'phone MEMS': gyro(0.6, 20.0, 60.0, 100.0),
    'noisy MEMS': gyro(2.5, 18.0, 0.0, 50.0),
}


# Motion: rates every interval, and whether the robot rests

def _trapezoid(count: int, interval: float, ramp: float = 0.3) -> np.ndarray:
    steps = np.arange(count) * interval
    return np.clip(np.minimum(steps, steps[::-1]) / ramp, 0.0, 1.0)


def straight(duration: float, interval: float, generator: np.random.Generator,
             shake: tuple[float, float], wander: float) -> np.ndarray:
    """Return a straight way: shake of so many deg/s at 0.5 to 2 Hz, and a wander over 1 s."""
    count = max(round(duration / interval), 2)
    time, knots = np.arange(count) * interval, np.arange(0.0, duration + 2.0)
    return DEG * _trapezoid(count, interval) * (
        generator.uniform(*shake) * np.sin(2.0 * math.pi * (generator.uniform(0.5, 2.0) * time
                                                            + generator.uniform()))
        + np.interp(time, knots, generator.normal(0.0, wander, len(knots))))


def turn(interval: float, generator: np.random.Generator, slowest: float,
         fastest: float) -> np.ndarray:
    """Return a turn of 30 to 180 deg."""
    rate = math.exp(generator.uniform(math.log(slowest), math.log(fastest)))
    count = round(max(generator.uniform(30.0, 180.0) / rate + 0.3, 0.9) / interval)
    return generator.choice((-1.0, 1.0)) * rate * DEG * _trapezoid(count, interval)


def drive(kind: str, minutes: float, interval: float,
          generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return true rates, rad/s, and the rests, shape (n,), behind the rest for calibration."""
    parts = [np.zeros(round(CALIBRATED / interval))]
    resting = [np.ones(len(parts[0]), bool)]
    total, count = len(parts[0]), round((60.0 * minutes + CALIBRATED) / interval)

    def go(rate: np.ndarray, rests: bool = False) -> None:
        nonlocal total
        parts.append(rate)
        resting.append(np.full(len(rate), rests))
        total += len(rate)

    def stop(shortest: float, longest: float) -> None:
        go(np.zeros(round(generator.uniform(shortest, longest) / interval)), True)

    while total < count:
        if kind == 'delivery':  # ways between doors
            for _ in range(int(generator.integers(2, 6))):
                go(straight(generator.uniform(3.0, 15.0), interval, generator, (0.5, 2.0), 0.2))
                go(turn(interval, generator, 10.0, 90.0))
            stop(3.0, 30.0)
        elif kind == 'picking':  # short rests, slow and fast turns
            go(turn(interval, generator, 1.0, 60.0))
            stop(0.3, 4.0)
            go(straight(generator.uniform(2.0, 8.0), interval, generator, (0.3, 2.0), 0.2))
            stop(0.3, 4.0)
        elif kind == 'patrol':  # long quiet ways, seldom a rest
            for _ in range(int(generator.integers(4, 9))):
                go(straight(generator.uniform(10.0, 60.0), interval, generator, (0.0, 0.5), 0.1))
                go(turn(interval, generator, 10.0, 60.0))
            stop(10.0, 30.0)
        elif kind == 'weaving':  # never at rest; yaw of 0.06 deg/s, correlated over 3 s
            left = math.exp(-interval / 3.0)
            noise = generator.standard_normal(round(generator.uniform(20.0, 90.0) / interval))
            go(lfilter([0.06 * DEG * math.sqrt(1.0 - left ** 2)], [1.0, -left], noise))
            go(turn(interval, generator, 10.0, 60.0))
        elif kind == 'bent':  # never at rest; each way bends at its own rate
            go(np.full(round(generator.uniform(20.0, 90.0) / interval),
                       generator.normal(0.0, 0.05 * DEG)))
            go(turn(interval, generator, 10.0, 60.0))
        else:  # mowing: never at rest
            go(straight(generator.uniform(5.0, 25.0), interval, generator, (0.3, 2.0), 0.2))
            go(turn(interval, generator, 10.0, 60.0))
    return np.concatenate(parts)[:count], np.concatenate(resting)[:count]


DRIVES = ('delivery', 'picking', 'patrol', 'mowing', 'weaving', 'bent')


# The output

def output_of(one: Gyro, rate: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Return what the gyro says, rad/s."""
    count, warm = len(rate), round(600.0 / one.interval)
    bias = (np.cumsum(generator.standard_normal(count)) * one.noise.rate_random_walk
            * math.sqrt(one.interval))
    flicker = one.noise.bias_instability ** 2 * math.log(RATIO) / math.pi  # of each process
    for constant in CONSTANTS:
        left = math.exp(-one.interval / constant)
        new = generator.standard_normal(warm + count) * math.sqrt(flicker * (1.0 - left ** 2))
        new[0] = generator.standard_normal() * math.sqrt(flicker)
        bias += lfilter([1.0], [1.0, -left], new)[warm:]
    return (rate * (1.0 + SCALE * generator.standard_normal()) + bias
            + generator.normal(0.0, 1.0 * DEG)
            + generator.standard_normal(count) * one.noise.angle_random_walk
            / math.sqrt(one.interval))


# This program

def program(one: Gyro, output: np.ndarray, hindsight: bool, off: float,
            wheels: list[bool] | None) -> tuple[np.ndarray, ...]:
    """Return headings and variances, live or with hindsight, behind a rest before the drive."""
    first = round(CALIBRATED / one.interval)
    noise, bias = one.noise, float(output[:first].mean()) + off
    variance = noise.angle_random_walk ** 2 / CALIBRATED + noise.allan_floor ** 2
    model = GyroModel(noise=noise, self_calibration=SelfCalibration(
        0.0, bias, ((SCALE ** 2, 0.0), (0.0, variance))))
    rest = output[first:]
    rate = np.asarray(model.self_calibration.correct(rest))
    time = np.arange(len(rest)) * one.interval
    found = track(time, rate, rate_sensitivity(model, rest, rate, 25.0), noise,
                  uncertainty_covariance(model), TrackerSettings(), wheels, hindsight, 0.0,
                  rate_sensitivity(model, 0.0, 0.0, 25.0))
    return found.heading, found.variance, found.resting


def score(one: Gyro, kind: str, given: argparse.Namespace, generator: np.random.Generator
          ) -> dict[str, float]:
    """Return errors, deg, and shares inside the stated 95 %, of one drive."""
    rate, rests = drive(kind, given.minutes, one.interval, generator)
    output = output_of(one, rate, generator)
    first, every = round(CALIBRATED / one.interval), round(1.0 / one.interval)
    true = np.concatenate([[0.0], np.cumsum(0.5 * one.interval * (rate[1:] + rate[:-1]))])
    true = true[first:] - true[first]
    found: dict[str, float] = {'rests': float(rests[first:].mean())}
    told = told_rests(np.arange(len(output)) * one.interval, output, rests, one.noise,
                      *prior(one.noise, SCALE, 3.0 * DEG))
    for name, (heading, variance) in zip(('live', 'later'), told):
        error = heading[first:] - heading[first] - true
        found[f'oracle, {name}'] = float(np.abs(error).mean()) / DEG
        found[f'inside, oracle, {name}'] = float(
            (error ** 2 <= BAND * variance[first:])[::every].mean())
    wheels = (~rests[first:]).tolist() if given.wheels else None
    for name, hindsight in (('live', False), ('later', True)):
        heading, variance, resting = program(one, output, hindsight, given.off * DEG, wheels)
        error = heading - true
        found[name] = float(np.abs(error).mean()) / DEG
        found[f'inside, {name}'] = float((error ** 2 <= BAND * variance)[::every].mean())
        found[f'z², {name}'] = float(error[-1] ** 2 / variance[-1])
        found[f'false, {name}'] = float((resting & ~rests[first:]).mean())
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--drives', type=int, default=20)
    parser.add_argument('--minutes', type=float, default=15.0)
    parser.add_argument('--only', default='', help='gyros and drives whose name has this text')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--wheels', action='store_true', help='the program is told the rests')
    parser.add_argument('--off', type=float, default=0.0, help='error of the bias, deg/s')
    given = parser.parse_args()
    print('| gyro, drive | at rest, % | oracle, deg: live, hindsight | over it: live, hindsight '
          '| inside 95 %: live, hindsight | its standard error, live | of the oracle, live '
          '| z, live | taken for rest, % |\n|:---|---:|---:|---:|---:|---:|---:|---:|---:|')
    for place, (name, one) in enumerate(GYROS.items()):
        for kind in DRIVES:
            if given.only not in f'{name}, {kind}':
                continue
            generators = (np.random.default_rng([given.seed, place, DRIVES.index(kind), number])
                          for number in range(given.drives))
            several = [score(one, kind, given, each) for each in generators]
            mean = {key: float(np.mean([each[key] for each in several])) for key in several[0]}
            scatter = 100.0 * np.std([each['inside, live'] for each in several]) / math.sqrt(
                given.drives)
            over = [np.array([each[key] for each in several]) for key in
                    ('live', 'oracle, live', 'later', 'oracle, later')]
            print(f'| {name}, {kind} | {100.0 * mean["rests"]:.0f} | {mean["oracle, live"]:.3f}, '
                  f'{mean["oracle, later"]:.3f} | {over[0].mean() / over[1].mean():.2f}, '
                  f'{over[2].mean() / over[3].mean():.2f} | {100.0 * mean["inside, live"]:.1f}, '
                  f'{100.0 * mean["inside, later"]:.1f} | {scatter:.1f} | '
                  f'{100.0 * mean["inside, oracle, live"]:.1f} | '
                  f'{math.sqrt(mean["z², live"]):.2f} | '
                  f'{100.0 * mean["false, live"]:.1f} |', flush=True)


if __name__ == '__main__':
    main()
