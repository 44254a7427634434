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
Self-calibrate simulated robots that are honest, and robots that are not.

    python benchmarks/honest_runs.py [RUNS [SEED]]

The simulator is its own: it takes neither noise nor motion nor robot from the package. Each run
has 1 s of rest, a profile of 20 s (45 and 30 deg/s both ways, ramps of 0.5 s, rests of 1 s between
turns), and 4 s of rest, at 100 Hz, by one of three gyros (`GYROS`). It prints, for each kind of
robot and each gyro, how many runs were refused, the share of scale factor errors s and biases b
within their 95 % intervals, the median standard deviations, and how many were accepted more than 5
standard deviations off. The bias is compared with its mean over the rest after
the profile. A run is checked by the rest after it, as the command line does; of the kinds named
so, the log ends 0.5 s after the profile, or the profile has headings at 20 Hz.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import math
import sys

from gyro_calibration.calibration.self_calibration import (
    check_end, check_rest, find_rest_after, self_calibrate)
from gyro_calibration.logs.log import DataRefused
from gyro_calibration.model.motion import motion_from_headings, motion_from_rates
from gyro_calibration.model.noise import Noise
import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

Array = NDArray[np.float64]
DEGREE = math.pi / 180.0
STEP = 0.01
#: Time of the samples; the profile begins at 0 and ends at 20 s.
TIME = np.arange(-100, 2400) * STEP
#: Duration, s, and rate, deg/s, of each leg; a ramp of 0.5 s is at its beginning.
LEGS = ((1, 0), (4, 45), (1, 0), (4, -45), (1, 0), (3.5, 30), (1, 0), (3.5, -30), (1, 0))
RAMP = 0.5
#: Ending of the kinds whose log ends soon after the profile.
SHORT = ', ends 0.5 s after'


@dataclass(frozen=True)
class Gyro:
    """Noise N, rad/√s, and flicker B, rad/s, and how far biases are from zero, rad/s."""

    white: float
    flicker: float
    bias: float


GYROS = {
    'cheap': Gyro(0.02 * DEGREE, 20.0 * DEGREE / 3600.0, 0.3 * DEGREE),
    'XV-3500': Gyro(2.5 * DEGREE / 60.0, 18.0 * DEGREE / 3600.0, 0.05 * DEGREE),
    'fine': Gyro(0.08 * DEGREE / 60.0, 0.1 * DEGREE / 3600.0, 0.002 * DEGREE),
}


def breakpoints(ramp: float = RAMP) -> tuple[Array, Array]:
    """Return times, s, and rates, rad/s, of the corners of the profile."""
    time, rate = [0.0], [0.0]
    for duration, value in LEGS:
        start = time[-1]
        time += [start + ramp, start + duration]
        rate += [value * DEGREE] * 2
    return np.array(time), np.array(rate)


def commanded(ramp: float = RAMP) -> Array:
    """Return the rate that is commanded over `TIME`, rad/s."""
    return np.interp(TIME, *breakpoints(ramp), left=0.0, right=0.0)


def flicker(size: float, draw: np.random.Generator) -> Array:
    """Return flicker as a sum of Gauss-Markov processes a factor of 3 apart, rad/s."""
    total = np.zeros(len(TIME))
    for constant in 0.03 * 3.0 ** np.arange(11):
        kept = math.exp(-STEP / constant)
        deviation = size * math.sqrt(math.log(3.0) / math.pi)
        shocks = deviation * math.sqrt(1.0 - kept ** 2) * draw.standard_normal(len(TIME))
        before = [kept * deviation * draw.standard_normal()]
        total += lfilter([1.0], [1.0, -kept], shocks, zi=before)[0]
    return total


def lagging(rate: Array, constant: float) -> Array:
    """Return a rate through a lag of first order, s."""
    kept = math.exp(-STEP / constant)
    return lfilter([1.0 - kept], [1.0, -kept], rate, zi=[kept * rate[0]])[0]


def delayed(rate: Array, by: float) -> Array:
    """Return a rate that comes later."""
    return np.interp(TIME - by, TIME, rate, left=0.0, right=0.0)


def second_order(rate: Array, frequency: float, damping: float) -> Array:
    """Return the rate of a robot that follows as a spring and a damper, rad/s."""
    value, slope, found = 0.0, 0.0, np.empty(len(rate))
    part = 5
    for place, wanted in enumerate(rate):
        for _ in range(part):
            slope += STEP / part * (frequency ** 2 * (wanted - value)
                                    - 2.0 * damping * frequency * slope)
            value += STEP / part * slope
        found[place] = value
    return found


def exact(draw: np.random.Generator) -> Array:
    """Turn as commanded, up to 0.5 s later."""
    return delayed(commanded(), draw.uniform(0.0, 0.5))


def wobble(draw: np.random.Generator) -> Array:
    """Wobble with the wheels by up to 0.15 deg, at a frequency that goes with the rate."""
    rate = exact(draw)
    phase = draw.uniform(0.0, 2.0 * math.pi) + np.cumsum(np.abs(rate)) * STEP * draw.uniform(1, 12)
    return rate + draw.uniform(0.02, 0.15) * DEGREE * np.gradient(np.sin(phase), STEP)


def wide_wobble(draw: np.random.Generator) -> Array:
    """Wobble with the wheels by 0.3 deg."""
    rate = exact(draw)
    phase = draw.uniform(0.0, 2.0 * math.pi) + np.cumsum(np.abs(rate)) * STEP * draw.uniform(1, 12)
    return rate + 0.3 * DEGREE * np.gradient(np.sin(phase), STEP)


def lag(draw: np.random.Generator) -> Array:
    """Follow with a lag of first order of 0.05 to 0.3 s."""
    constant = draw.uniform(0.05, 0.3)
    return lagging(exact(draw), constant)


def follower(draw: np.random.Generator) -> Array:
    """Follow with second order: 4 to 15 rad/s, damping of 0.4 to 1."""
    return second_order(exact(draw), draw.uniform(4.0, 15.0), draw.uniform(0.4, 1.0))


def soft_ramps(draw: np.random.Generator) -> Array:
    """Reach each rate by an acceleration of 0.7 to 0.95 of what the fastest ramp needs."""
    wanted, largest = exact(draw), draw.uniform(0.7, 0.95) * 45.0 * DEGREE / RAMP
    value, found = 0.0, np.empty(len(wanted))
    for place, each in enumerate(wanted):
        value += float(np.clip(each - value, -largest * STEP, largest * STEP))
        found[place] = value
    return found


def slipping(draw: np.random.Generator) -> Array:
    """Lose up to 1 % of each turn."""
    losses = draw.uniform(0.0, 0.01, len(LEGS))
    edges = np.cumsum([0.0] + [duration for duration, _ in LEGS]) + 0.5 * RAMP
    leg = np.clip(np.searchsorted(edges, TIME) - 1, 0, len(LEGS) - 1)
    return delayed(commanded() * (1.0 - losses[leg]), draw.uniform(0.0, 0.5))


def slipping_evenly(draw: np.random.Generator) -> Array:
    """Lose the same part of each turn, up to 1 %."""
    return exact(draw) * (1.0 - draw.uniform(0.0, 0.01))


def everything(draw: np.random.Generator) -> Array:
    """Wobble, lag and slip at once."""
    rate = lagging(wobble(draw), draw.uniform(0.02, 0.15))
    return rate * (1.0 - draw.uniform(0.0, 0.01))


def steady_yaw(draw: np.random.Generator) -> Array:
    """Yaw at 0.1 to 2 deg/s more for all of the profile, and rest before and after."""
    yaw = draw.uniform(0.1, 2.0) * draw.choice([-1.0, 1.0]) * DEGREE
    return exact(draw) + np.where((TIME > 0.0) & (TIME < 20.5), yaw, 0.0)


def steady_yaw_until_the_end(draw: np.random.Generator) -> Array:
    """Yaw at 0.05 to 1 deg/s more until the end of the profile, with no rest before."""
    yaw = draw.uniform(0.05, 1.0) * draw.choice([-1.0, 1.0]) * DEGREE
    return delayed(commanded(), draw.uniform(0.0, 0.2)) + np.where(TIME < 20.0, yaw, 0.0)


def yaw_for_a_while(draw: np.random.Generator) -> Array:
    """Yaw at 0.1 to 2 deg/s more for 5 to 18 s."""
    begin, yaw = draw.uniform(0.0, 10.0), draw.uniform(0.1, 2.0) * draw.choice([-1, 1]) * DEGREE
    end = min(begin + draw.uniform(5.0, 18.0), 20.0)
    return exact(draw) + np.where((begin < TIME) & (end > TIME), yaw, 0.0)


def slip_above_a_speed(draw: np.random.Generator) -> Array:
    """Lose 5 to 100 % of what the rate exceeds a speed of 20 to 44 deg/s by."""
    rate, speed, part = exact(draw), draw.uniform(20.0, 44.0) * DEGREE, draw.uniform(0.05, 1.0)
    return rate - part * np.sign(rate) * np.maximum(np.abs(rate) - speed, 0.0)


def small_slip(draw: np.random.Generator) -> Array:
    """Lose 0.5 to 1.5 deg of one turn, within 0.1 to 1 s."""
    rate, degrees = exact(draw), draw.uniform(0.5, 1.5)
    while True:
        begin, duration = draw.uniform(0.0, 19.0), draw.uniform(0.1, 1.0)
        inside = (begin <= TIME) & (begin + duration > TIME)
        turned = float(rate[inside].sum()) * STEP / DEGREE
        if abs(turned) > degrees:
            return np.where(inside, rate * (1.0 - degrees / abs(turned)), rate)


def hand_turn(draw: np.random.Generator) -> Array:
    """Turn by hand at 0.2 to 1 deg/s for 1 to 8 s."""
    begin, duration = draw.uniform(0.0, 19.0), draw.uniform(1.0, 8.0)
    yaw = draw.uniform(0.2, 1.0) * draw.choice([-1.0, 1.0]) * DEGREE
    return exact(draw) + np.where((begin <= TIME) & (begin + duration > TIME), yaw, 0.0)


Robot = Callable[[np.random.Generator], Array]
HONEST: dict[str, Robot] = {
    'as commanded': exact, 'wobble': wobble, 'wobble of 0.3 deg': wide_wobble, 'lag': lag,
    'second order': follower, 'ramps softer than commanded': soft_ramps,
    'encoder of 0.5 deg': follower, 'slip up to 1 % of each turn': slipping,
    'even slip up to 1 %': slipping_evenly, 'wobble, lag and slip': everything,
    'output in steps of 0.1 to 0.5 deg/s': lag, f'lag{SHORT}': lag,
    f'second order{SHORT}': follower, 'headings, slip up to 1 % of each turn': slipping,
}
DISHONEST: dict[str, Robot] = {
    'steady yaw': steady_yaw, 'yaw for a while': yaw_for_a_while,
    'slip above a speed': slip_above_a_speed, 'slip of 0.5 to 1.5 deg': small_slip,
    'turn by hand': hand_turn, f'steady yaw{SHORT}': steady_yaw_until_the_end,
    f'headings, steady yaw{SHORT}': steady_yaw_until_the_end,
}


def tried(kind: str, gyro: Gyro, seed: tuple[int, ...]) -> tuple[Array, Array] | str:
    """Return errors and standard deviations of s and b of one run, or why it was refused."""
    draw = np.random.default_rng(seed)
    rate = (HONEST | DISHONEST)[kind](draw)
    s, b = 0.01 * draw.standard_normal(), gyro.bias * draw.standard_normal()
    drift = flicker(gyro.flicker, draw)
    output = ((1.0 + s) * rate + b + drift
              + gyro.white / math.sqrt(STEP) * draw.standard_normal(len(TIME)))
    motion = motion_from_rates(*breakpoints())
    if kind.startswith('headings'):
        at = np.arange(0.0, 20.01, 0.05)
        motion = motion_from_headings(at, motion.heading_at(at), is_measured=False)
    if kind.startswith('output in steps'):
        step = draw.uniform(0.1, 0.5) * DEGREE
        output = step * np.round(output / step)
    if kind.startswith('encoder'):
        at = np.arange(0.0, 20.5, 0.05)
        heading = np.interp(at, TIME, np.cumsum(rate) * STEP - 0.5 * STEP * rate)
        step = 0.5 * DEGREE
        motion = motion_from_headings(at, step * np.floor(
            (heading + draw.uniform(0, step)) / step))
    try:
        noise = Noise(gyro.white, gyro.flicker)
        end = 20.5 if kind.endswith(SHORT) else 24.0
        known = end > TIME
        run = known & (TIME < 21.0)
        fit = self_calibrate(TIME[run], output[run], motion, noise=noise)
        rest = find_rest_after(TIME[known], output[known], fit, motion)
        fit = (check_end(TIME[known], output[known], fit, motion, noise) if rest is None else
               check_rest(TIME[rest], output[rest], fit, noise).fit)
    except DataRefused as reason:
        return str(reason)
    later = b + float(drift[TIME > 20.0].mean())
    return (np.array([fit.scale_factor_error - s, fit.bias - later]),
            np.sqrt(np.diag(fit.covariance)))


def row(kind: str, name: str, runs: int, seed: int) -> tuple[str, list[str]]:
    """Return a row of the table, and the refusals."""
    found = [tried(kind, GYROS[name], (seed, number)) for number in range(runs)]
    refusals = [each for each in found if isinstance(each, str)]
    good = [each for each in found if not isinstance(each, str)]
    text = f'| {kind} | {name} | {len(refusals)} of {runs} | '
    if not good:
        return text + '- | - | - | - | - | - | 0 |', refusals
    errors, deviations = (np.array([each[place] for each in good]) for place in (0, 1))
    z = np.abs(errors / deviations)
    held, typical, rms = ((z < 1.96).mean(axis=0), np.median(deviations, axis=0),
                          np.sqrt(np.mean(errors ** 2, axis=0)))
    return text + (
        f'{held[0]:.2f} | {held[1]:.2f} | {100 * typical[0]:.4f} | {100 * rms[0]:.4f} | '
        f'{typical[1] / DEGREE:.5f} | {rms[1] / DEGREE:.5f} | {int((z > 5).any(axis=1).sum())} |'
    ), refusals


def main(runs: int = 100, seed: int = 1, kinds: str = '') -> None:
    print('| robot | gyro | refused | coverage of s | of b | s known to, % | s off, rms, % | '
          'b known to, deg/s | b off, rms, deg/s | beyond 5 sigma |')
    print('|---|---|---|---|---|---|---|---|---|---|')
    for kind in HONEST | DISHONEST:
        for name in GYROS:
            if kinds in kind:
                text, refusals = row(kind, name, runs, seed)
                print(text, flush=True)
                if kind in HONEST:
                    for reason in sorted(set(refusals))[:3]:
                        print('    refused:', reason, file=sys.stderr, flush=True)


if __name__ == '__main__':
    main(*(int(word) for word in sys.argv[1:3]), *sys.argv[3:])
