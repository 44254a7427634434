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
Compare the speed of the compensation of a log, in samples per second, with numpy and a floor.

    python benchmarks/compensation.py

A polynomial of orders (3, 2) over output and temperature and the integration to the heading run
over ten million samples. Compared with: numpy's `polyval2d`, and the floor, Horner's rule in place
on blocks that fit the cache, with nothing else done. All take turns in one run, and the least of
several times counts, to which other programs add least.
Then follows the cost of a sample for logs of 1e4 to 1e7, and of single samples, as on the robot.
Prints tables in Markdown.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
import time as clock

from gyro_calibration.heading.integration import integrate
from gyro_calibration.model.compensation import compensate
from gyro_calibration.model.effects import rate_temperature_polynomial
from gyro_calibration.model.gyro_model import GyroModel, Term
import numpy as np

#: Errors of some 0.01 rad/s, as a fit to a fibre-optic gyro on a rate table gives them.
C = np.array([[4e-3, 2.1e-2, -6e-4, -1.3e-2], [-8e-4, 3e-3, 2e-4, -5e-4],
              [5e-5, -2e-4, 3e-5, 1e-4]])
CENTRE, SCALE, MIDDLE, SPAN = 0.01, 1.1, 43.0, 4.0
MODEL = GyroModel((Term(rate_temperature_polynomial(3, 2),
                        (CENTRE, SCALE, MIDDLE, SPAN, *C.ravel().tolist())),),
                  rate_range=(-1.8, 1.8), temperature_range=(37.0, 49.0))
BLOCK = 1 << 15  # the fastest of 2**11 to 2**16 for the floor

Samples = tuple[np.ndarray, np.ndarray, np.ndarray]


def samples(count: int, generator: np.random.Generator) -> Samples:
    """Return time, output and temperature of a log."""
    return (np.arange(count) * 0.01, generator.uniform(-1.75, 1.75, count),
            generator.uniform(38.0, 48.0, count))


def package(time: np.ndarray, output: np.ndarray, temperature: np.ndarray) -> np.ndarray:
    return integrate(time, compensate(MODEL, output, temperature).rate)


def polyval2d(time: np.ndarray, output: np.ndarray, temperature: np.ndarray) -> np.ndarray:
    rate = output - np.polynomial.polynomial.polyval2d((temperature - MIDDLE) / SPAN,
                                                       (output - CENTRE) / SCALE, C)
    return np.concatenate([[0.0], np.cumsum(np.diff(time) * 0.5 * (rate[1:] + rate[:-1]))])


def floor(time: np.ndarray, output: np.ndarray, temperature: np.ndarray) -> np.ndarray:
    """Return the heading by Horner's rule and trapezoids, with no checks and least memory."""
    rate, heading, work = np.empty(len(time)), np.empty(len(time)), np.empty((4, BLOCK))
    for begin in range(0, len(time), BLOCK):
        block = slice(begin, min(begin + BLOCK, len(time)))
        _floor_rate(output[block], temperature[block], rate[block], work[:, :block.stop - begin])
        _floor_heading(time, rate, heading, max(begin, 1), block.stop, work[0])
    return heading


def _floor_rate(output: np.ndarray, temperature: np.ndarray, rate: np.ndarray,
                work: np.ndarray) -> None:
    x, y, total, row = work
    np.subtract(output, CENTRE, out=x)
    np.divide(x, SCALE, out=x)
    np.subtract(temperature, MIDDLE, out=y)
    np.divide(y, SPAN, out=y)
    for power, coefficients in zip((2, 1, 0), C[::-1]):
        into = total if power == 2 else row
        np.multiply(x, coefficients[3], out=into)
        for coefficient in coefficients[2:0:-1]:
            into += coefficient
            into *= x
        into += coefficients[0]
        if power < 2:
            total *= y
            total += row
    np.subtract(output, total, out=rate)


def _floor_heading(time: np.ndarray, rate: np.ndarray, heading: np.ndarray, begin: int, end: int,
                   work: np.ndarray) -> None:
    if begin == 1:
        heading[0] = 0.0
    turned, interval = heading[begin:end], work[:end - begin]
    np.add(rate[begin:end], rate[begin - 1:end - 1], out=turned)
    np.subtract(time[begin:end], time[begin - 1:end - 1], out=interval)
    turned *= interval
    turned *= 0.5
    turned[0] += heading[begin - 1]
    np.cumsum(turned, out=turned)


SIDES: Mapping[str, Callable[..., np.ndarray]] = {'numpy polyval2d': polyval2d,
                                                  'Horner in place, in blocks (floor)': floor,
                                                  'compensate, integrate': package}


def seconds(work: Callable[[], object], times: int = 1) -> float:
    """Return the processor time of a piece of work in one thread, without other programs."""
    begin = clock.process_time()
    for _ in range(times):
        work()
    return (clock.process_time() - begin) / times


def side_by_side(count: int = 10 ** 7, repeats: int = 9) -> str:
    """Return a table of all sides over the same samples."""
    log = samples(count, np.random.default_rng(0))
    wanted = floor(*log)
    assert all(np.allclose(side(*log), wanted, rtol=0.0, atol=1e-9) for side in SIDES.values())
    taken = np.array([[seconds(lambda: side(*log)) for side in SIDES.values()]  # noqa: B023
                      for _ in range(repeats)])
    least = taken.min(axis=0)
    lines = [f'| {count:.0e} samples | million samples/s | time over the floor |',
             '|:---|---:|---:|']
    lines += [f'| {name} | {count / each / 1e6:.0f} | {each / least[1]:.2f} |'
              for name, each in zip(SIDES, least)]
    return '\n'.join(lines)


def by_length(counts: tuple[int, ...] = (10 ** 4, 10 ** 5, 10 ** 6, 10 ** 7),
              repeats: int = 9) -> str:
    """Return a table of the cost of a sample in logs of several lengths, and of single samples."""
    logs = [samples(count, np.random.default_rng(0)) for count in counts]
    taken = [[seconds(lambda: package(*log), max(10 ** 6 // len(log[0]), 1))  # noqa: B023
              for log in logs] for _ in range(repeats)]
    costs = np.min(taken, axis=0) / counts
    alone = min(seconds(lambda: compensate(MODEL, 0.5, 42.0), 10 ** 4) for _ in range(repeats))
    lines = ['| samples in one call | ns a sample |', '|---:|---:|']
    lines += [f'| {count:.0e} | {1e9 * cost:.1f} |' for count, cost in zip(counts, costs)]
    return '\n'.join(lines + [f'| 1, a float, without integration | {1e9 * alone:.0f} |'])


if __name__ == '__main__':
    print(side_by_side(), by_length(), sep='\n\n')
