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
Measure how often false and good self-calibrations are refused, at three noise levels.

    python benchmarks/fooled.py [RUNS]

The gyro is that of Hong and Park (XV3500) with 0.3, 1 and 3 times its noise, s of 3 % and b of
0.05 deg/s (standard deviations), at 100 Hz, on the built-in motion of 20 s, recorded from 1 s
before it to 1 s after it; the model always states the noise of the XV3500. The seed of a run is
its number. Each robot has a delay of 0 to 1 s, a first-order lag of 0 to 0.2 s, a wobble from the
turn of its wheels (0 to 0.1 deg at 0.5 to 2 Hz while it turns) and a shake (0 to 0.5 deg/s at 5 to
30 Hz). Prints tables in Markdown.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
import sys

from gyro_calibration.calibration.likelihood import MIN_FIT_PROBABILITY
from gyro_calibration.calibration.self_calibration import self_calibrate
from gyro_calibration.logs.log import Array, DataRefused, DEGREE
from gyro_calibration.model.motion import (
    CALIBRATION_MOTION, constant_rate_motion, Motion, motion_from_rates)
from gyro_calibration.model.noise import Noise, simulate_noise
from gyro_calibration.model.presets import XV3500
import numpy as np
from scipy.signal import lfilter

LEVELS = (0.3, 1.0, 3.0)
INTERVAL = 0.01
#: From 1 s before the profile to 1 s after it.
TIME = np.arange(-100, 2101) * INTERVAL


@dataclass(frozen=True)
class Run:
    """Draws of one run: s and b, true rate over `TIME`, rad/s, and noise of the gyro."""

    generator: np.random.Generator
    s: float
    b: float
    late: float
    lag: float
    noise: Array

    def follow(self, wanted: Array) -> Array:
        """Return the rate, rad/s, of a robot for a commanded one: delay, lag, wobble and shake."""
        delayed = np.interp(TIME - self.late, TIME, wanted, left=0.0, right=wanted[-1])
        kept = np.exp(-INTERVAL / self.lag) if self.lag else 0.0
        followed = lfilter([1.0 - kept], [1.0, -kept], delayed)
        return followed + self._wobble(followed)

    def _wobble(self, rate: Array) -> Array:
        draw = np.random.default_rng(int(1e9 * self.late)).uniform
        wheel, shake = (draw(*limits) * 2.0 * np.pi * TIME + draw(0.0, 2.0 * np.pi)
                        for limits in ((0.5, 2.0), (5.0, 30.0)))
        speed = float(np.gradient(wheel, TIME)[0])
        turning = np.minimum(np.abs(rate) / (10.0 * DEGREE), 1.0)
        return turning * (draw(0.0, 0.1) * DEGREE * speed * np.cos(wheel)
                          + draw(0.0, 0.5) * DEGREE * np.sin(shake))

    def gyro(self, rate: Array) -> Array:
        """Return what the gyro says of a rate, rad/s."""
        return (1.0 + self.s) * rate + self.b + self.noise


def drawn(number: int, level: float) -> Run:
    generator = np.random.default_rng([number, round(10 * level)])
    noise = Noise(level * XV3500.noise.angle_random_walk, level * XV3500.noise.bias_instability)
    return Run(generator, 0.03 * generator.standard_normal(),
               0.05 * DEGREE * generator.standard_normal(), generator.uniform(0.0, 1.0),
               generator.uniform(0.0, 0.2), simulate_noise(noise, len(TIME), INTERVAL, generator))


def profile(motion: Motion = CALIBRATION_MOTION, speed: float = 1.0) -> Array:
    """Return the rates over `TIME` of a motion that is played faster, at unchanged rates."""
    return motion.rate_at(speed * TIME)


def good(run: Run) -> Array:
    """Return what the gyro says where all is well."""
    return run.gyro(run.follow(profile()))


def as_the_profile_says(run: Run) -> Array:
    """Return what the gyro says of a robot that does just what it is told."""
    return run.gyro(profile())


def slip(run: Run) -> Array:
    """Lose 2 to 15 deg of a turn, within 0.1 to 2 s, where the robot turns at least that far."""
    rate = run.follow(profile())
    degrees = run.generator.uniform(2.0, 15.0)
    while True:
        start, duration = run.generator.uniform(0.0, 19.0), run.generator.uniform(0.1, 2.0)
        inside = (start <= TIME) & (start + duration > TIME)
        turned = float(rate[inside].sum()) * INTERVAL / DEGREE
        if abs(turned) > degrees:
            return run.gyro(np.where(inside, rate * (1.0 - degrees / abs(turned)), rate))


def bump(run: Run) -> Array:
    """Push the robot by 2 to 15 deg either way, within 0.05 to 0.5 s, at any time of the run."""
    start, duration = run.late + run.generator.uniform(0.5, 19.0), run.generator.uniform(0.05, 0.5)
    inside = (start <= TIME) & (start + duration > TIME)
    degrees = run.generator.uniform(2.0, 15.0) * run.generator.choice([-1.0, 1.0])
    return run.gyro(run.follow(profile())
                    + np.where(inside, degrees * DEGREE / (inside.sum() * INTERVAL), 0.0))


def early_end(run: Run) -> Array:
    """Stop for good at 2 to 18 s of the profile."""
    return run.gyro(run.follow(np.where(run.generator.uniform(2.0, 18.0) > TIME, profile(), 0.0)))


def another_profile(run: Run) -> Array:
    """Drive four to six legs of 2 to 5 s at 15 to 60 deg/s either way, with rests of 1 s."""
    legs: list[tuple[float, float]] = [(1.0, 0.0)]
    for _ in range(run.generator.integers(4, 7)):
        legs += [(run.generator.uniform(2.0, 5.0),
                  run.generator.uniform(15.0, 60.0) * run.generator.choice([-1.0, 1.0])),
                 (1.0, 0.0)]
    return run.gyro(run.follow(profile(constant_rate_motion(legs))))


def wrong_sign(run: Run) -> Array:
    return -good(run)


def twice_the_rate(run: Run) -> Array:
    """Turn at twice the rate for the same time."""
    return run.gyro(run.follow(2.0 * profile()))


def twice_as_fast(run: Run) -> Array:
    """Play the profile in half its time, at unchanged rates or through unchanged angles."""
    return run.gyro(run.follow(run.generator.choice([1.0, 2.0]) * profile(speed=2.0)))


def noisy(run: Run) -> Array:
    """Give twenty times the noise that the model states."""
    deviation = 20.0 * XV3500.noise.angle_random_walk / np.sqrt(INTERVAL)
    return good(run) + deviation * run.generator.standard_normal(len(TIME))


def dead(run: Run) -> Array:
    """Give one value throughout; in half of the runs one sample in a hundred is a bit off."""
    toggles = (run.generator.random(len(TIME)) < 0.01) & (run.generator.random() < 0.5)
    return np.where(toggles, 1e-3, run.generator.choice([0.0, 0.01]))


def noise_alone(run: Run) -> Array:
    """Give bias and noise, as a gyro whose drive has died, or of a robot that did not move."""
    return run.gyro(np.zeros(len(TIME)))


def saturated(run: Run) -> Array:
    """Clip at 20 to 43 deg/s, either way."""
    limit = run.generator.uniform(20.0, 43.0) * DEGREE
    return np.clip(good(run), -limit, limit)


#: Unit of the gyro's output and unit assumed -> their ratio, and the text of the refusal.
UNITS = {'deg/s read as rad/s': (1.0 / DEGREE, 'deg/s and read as rad/s'),
         'rad/s read as deg/s': (DEGREE, 'rad/s and read as deg/s'),
         'mdeg/s read as deg/s': (1e3, 'mdeg/s and read as deg/s'),
         'mdeg/s read as rad/s': (1e3 / DEGREE, 'mdeg/s and read as rad/s'),
         'mrad/s read as rad/s': (1e3, 'mdeg/s and read as deg/s'),
         'mrad/s read as deg/s': (1e3 * DEGREE, 'mrad/s and read as deg/s'),
         'revolutions/s read as rad/s': (0.5 / np.pi, 'revolutions/s and read as rad/s'),
         'revolutions/s read as deg/s': (1.0 / 360.0, 'revolutions/s and read as deg/s')}
PROFILES = {'deg read as rad': (1.0 / DEGREE, 'deg/s and read as rad/s'),
            'rad read as deg': (DEGREE, 'rad/s and read as deg/s'),
            'mdeg read as deg': (1e3, 'mdeg/s and read as deg/s')}


def of_scale(factor: float) -> Callable[[Run], Array]:
    """Return a run whose output is multiplied."""
    return lambda run: factor * good(run)


def one_speed() -> Motion:
    """Return a profile that turns at one speed."""
    return motion_from_rates(np.array([0.0, 20.0]), np.full(2, 30.0 * DEGREE))


def scaled(factor: float) -> Motion:
    """Return the profile as it is read in another unit."""
    assert CALIBRATION_MOTION.rate is not None
    return motion_from_rates(CALIBRATION_MOTION.time, factor * CALIBRATION_MOTION.rate)


#: What was done -> the run, the profile that is believed, and a word that the refusal must hold.
WAYS: dict[str, tuple[Callable[[Run], Array], Motion, str]] = {
    'good': (good, CALIBRATION_MOTION, ''),
    'good, just as the profile says': (as_the_profile_says, CALIBRATION_MOTION, ''),
    'slip of 2 to 15 deg': (slip, CALIBRATION_MOTION, 'slip or a bump'),
    'bump of 2 to 15 deg': (bump, CALIBRATION_MOTION, 'slip or a bump'),
    'early end': (early_end, CALIBRATION_MOTION, 'the profile'),
    'another profile': (another_profile, CALIBRATION_MOTION, 'does not follow the profile'),
    'wrong sign': (wrong_sign, CALIBRATION_MOTION, 'the other way'),
    'twice the rate': (twice_the_rate, CALIBRATION_MOTION, '2 times its rate'),
    'twice as fast': (twice_as_fast, CALIBRATION_MOTION, 'does not follow the profile'),
    'dead gyro': (dead, CALIBRATION_MOTION, 'dead'),
    'noise alone': (noise_alone, CALIBRATION_MOTION, 'that the robot moved'),
    'twenty times the noise': (noisy, CALIBRATION_MOTION, 'as noisy'),
    'saturated gyro': (saturated, CALIBRATION_MOTION, 'saturated'),
    'half the sensitivity': (of_scale(0.5), CALIBRATION_MOTION, '0.5 times its sensitivity'),
    'twice the sensitivity': (of_scale(2.0), CALIBRATION_MOTION, '2 times its sensitivity'),
    'one speed': (lambda run: run.gyro(run.follow(profile(one_speed()))), one_speed(),
                  'cannot be separated'),
    **{f'gyro in {name}': (of_scale(factor), CALIBRATION_MOTION, f'gyro is in {said}')
       for name, (factor, said) in UNITS.items()},
    **{f'profile in {name}': (good, scaled(factor), f'profile in {said}')
       for name, (factor, said) in PROFILES.items()},
}


def tried(case: tuple[str, int, float]) -> tuple[str, tuple[float, ...]]:
    """Return the refusal ('' if accepted), normalized errors of s and b, and the chance."""
    name, number, level = case
    way, motion, _ = WAYS[name]
    run = drawn(number, level)
    try:
        fit = self_calibrate(TIME, way(run), motion, noise=XV3500.noise)
    except DataRefused as reason:
        return str(reason), ()
    errors = np.array([fit.scale_factor_error - run.s, fit.bias - run.b]) / np.sqrt(
        np.diag(fit.covariance))
    assert fit.goodness is not None
    return '', (*errors.tolist(), fit.goodness.probability)


def table(runs: int) -> Iterator[str]:
    """Yield the lines of the table: runs refused at each level, and those with the right name."""
    yield '| run | ' + ' | '.join(f'refused of {runs}, {level:g} times the noise (named right)'
                                  for level in LEVELS) + ' |'
    yield '|---|' + '---|' * len(LEVELS)
    accepted: dict[tuple[str, float], list[tuple[float, ...]]] = {}
    with ProcessPoolExecutor(2) as pool:
        for name, (_, _, word) in WAYS.items():
            cells = []
            for level in LEVELS:
                found = list(pool.map(tried, [(name, number, level) for number in range(runs)],
                                      chunksize=10))
                refused = [reason for reason, _ in found if reason]
                cells.append(f'{len(refused)} ({sum(word in reason for reason in refused)})'
                             if word else f'{len(refused)}')
                if not word:
                    accepted[name, level] = [errors for _, errors in found if errors]
            yield f'| {name} | ' + ' | '.join(cells) + ' |'
    yield from _coverage(accepted)


def _coverage(accepted: dict[tuple[str, float], list[tuple[float, ...]]]) -> Iterator[str]:
    yield ('\n| run | noise | s in its 95 % interval | b in its 95 % interval '
           '| residual larger than expected |')
    yield '|---|---|---|---|---|'
    for (name, level), errors in accepted.items():
        s, b, probability = np.array(errors).T
        shares = ' | '.join(f'{100 * np.mean(each):.1f} %' for each in (
            np.abs(s) < 1.96, np.abs(b) < 1.96, probability < MIN_FIT_PROBABILITY))
        yield f'| {name} | {level:g} times | {shares} |'


if __name__ == '__main__':
    for line in table(*(int(word) for word in sys.argv[1:2] or ['200'])):
        print(line, flush=True)
