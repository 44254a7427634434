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
Diagnose simulated robots that follow a command, as a system with a lag of its own.

    python benchmarks/followed_commands.py [LOGS [SEED]]

The simulator is its own. A robot is of first or second order (damping 0.35 to 1.2), 0.08 to 0.7 s
late on average, in part with a latency of 0.02 to 0.2 s more; or it has a limit of acceleration of
1 to 6 rad/s². Its command is held at random rates for 2 to 8 s, with ramps of 0 or 1 s, or is a
sum of four sines, or a random rate of bandwidth 0.1 Hz. Logs have 4 to 13 min at 10 to 50 Hz. The
gyro has s of 0.3 %, b of 0.1 deg/s, white noise of 0.0004 to 0.04 deg/s/√Hz and no other effect;
every log is diagnosed with and without a random walk that exceeds that noise after 0.5 to 20 s,
and with the command sent at 10 to 50 Hz between the samples, at even or uneven (10 %) intervals.
Prints, for each, the errors of s in standard deviations and the causes that are not there.
"""

import collections
import math
import sys
import warnings

from gyro_calibration import diagnose, Log
import numpy as np
from scipy.signal import cont2discrete, lfilter


def commanded(draw: np.random.Generator, count: int, interval: float) -> np.ndarray:
    """Return a commanded rate, rad/s, shape (count,)."""
    time = interval * np.arange(count)
    kind = draw.choice(['steps', 'ramps', 'sines', 'random'])
    if kind == 'sines':
        return sum(size * np.sin(2.0 * math.pi * frequency * time + phase)
                   for size, frequency, phase in zip(
                       draw.uniform(0.1, 0.5, 4), draw.uniform(0.02, 0.4, 4),
                       draw.uniform(0.0, 6.3, 4)))
    if kind == 'random':
        wander = lfilter([1.0], [1.0, -math.exp(-interval / 2.0)], draw.standard_normal(count))
        smooth = math.exp(-interval / 0.3)
        return lfilter([1.0 - smooth], [1.0, -smooth], 0.5 * wander / wander.std())
    held = draw.uniform(2.0, 8.0, int(count * interval) // 2 + 1)
    rates = np.repeat(draw.uniform(-1.0, 1.0, len(held)), (held / interval).astype(int))[:count]
    if kind == 'ramps':
        box = round(1.0 / interval)
        rates = lfilter(np.full(box, 1.0 / box), [1.0], rates)
    return rates


def followed(draw: np.random.Generator, command: np.ndarray, interval: float) -> np.ndarray:
    """Return the rate of a robot that follows a command, rad/s."""
    kind, lag = draw.choice(['first', 'second', 'late', 'limited']), draw.uniform(0.08, 0.7)
    damping = draw.choice([0.35, 0.5, 0.7, 1.0, 1.2])
    if kind == 'limited':
        most, rate, rates = draw.uniform(1.0, 6.0) * interval, 0.0, []
        for wanted in command.tolist():
            rate += min(max(wanted - rate, -most), most)
            rates.append(rate)
        return np.array(rates)
    if kind == 'late':
        latency = round(draw.uniform(0.02, 0.2) / interval)
        command = np.concatenate([np.zeros(latency), command])[:len(command)]
    frequency = 2.0 * damping / lag
    system = (([1.0], [lag, 1.0]) if kind == 'first' else
              ([frequency ** 2], [1.0, 2.0 * damping * frequency, frequency ** 2]))
    above, below, _ = cont2discrete(system, interval)
    return lfilter(above.ravel(), below.ravel(), command)


def sent_late(draw: np.random.Generator, command: np.ndarray, interval: float) -> np.ndarray:
    """Return a command that is sent at intervals of its own, and held."""
    period, jitter = draw.choice([0.02, 0.05, 0.1]), draw.choice([0.0, 0.1])
    sent = np.arange(draw.uniform(0.0, period), len(command) * interval, period)
    sent += jitter * period * draw.uniform(-0.5, 0.5, len(sent))
    at = np.append(0, np.clip(sent / interval, 0, len(command) - 1).astype(int))
    return command[at[np.searchsorted(at, np.arange(len(command)), 'right') - 1]]


def simulated(seed: int, has_walk: bool = False, is_between: bool = False) -> tuple[Log, float]:
    """Return a log with its command as the reference rate, and s."""
    draw = np.random.default_rng(seed)
    duration, frequency = draw.choice([240.0, 420.0, 800.0]), draw.choice([10.0, 25.0, 50.0])
    substeps = int(500.0 / frequency)
    count, density = int(duration * frequency), 10.0 ** draw.uniform(-5.2, -3.2)
    fine = 1.0 / (frequency * substeps)
    command = commanded(draw, count * substeps, fine)
    command = (sent_late(draw, command, fine) if is_between
               else np.repeat(command[::substeps], substeps))
    rate = followed(draw, command, fine)[substeps - 1::substeps]
    scale, bias = draw.normal(0.0, 0.003), math.radians(draw.normal(0.0, 0.1))
    output = ((1.0 + scale) * rate + bias
              + density * math.sqrt(frequency) * draw.standard_normal(count))
    if has_walk:
        walk = math.sqrt(3.0) * density / 10.0 ** draw.uniform(-0.3, 1.3)
        output += walk / math.sqrt(frequency) * np.cumsum(draw.standard_normal(count))
    return Log(time=np.arange(count) / frequency, output=output,
               reference_rate=command[substeps - 1::substeps]), scale


def main(count: int = 60, seed: int = 1) -> None:
    """Diagnose the logs and print the table."""
    for name, kind in (('white noise', {}), ('random walk', {'has_walk': True}),
                       ('commands between samples', {'is_between': True})):
        errors, deviations, unknown, false = [], [], 0, collections.Counter()
        for run in range(count):
            log, scale = simulated(1000 * seed + run, **kind)
            with warnings.catch_warnings():
                warnings.simplefilter('ignore')
                try:
                    found = diagnose(log, kind='rate_command')
                except ValueError:  # a swing that repeats
                    unknown += 1
                    continue
            known = [(value, deviation) for value_name, _, value, deviation
                     in found.model.estimates()
                     if value_name == 'scale_factor_error' and deviation]
            unknown += not known
            errors += [(value - scale) / deviation for value, deviation in known]
            deviations += [deviation for _, deviation in known]
            false.update({each.effect for each in found.found.findings
                          if each.status == 'established' and each.effect != 'reference_lag'})
        print(f'{name}: {len(errors)} logs with s known, '
              f'to {100.0 * np.median(deviations):.2g} % in the median, error '
              f'{np.sqrt(np.mean(np.square(errors))):.2f} deviations rms, '
              f'{np.count_nonzero(np.abs(errors) > 3.0)} beyond 3, largest '
              f'{np.max(np.abs(errors)):.1f}; {unknown} unknown; false: {dict(false)}', flush=True)


if __name__ == '__main__':
    main(*map(int, sys.argv[1:]))
