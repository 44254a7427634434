# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The noise of the residual in the figures of IEEE Std 952, compared with those of the model."""

from __future__ import annotations

from dataclasses import dataclass, replace

from gyro_calibration.diagnosis.regression import Fitted
from gyro_calibration.diagnosis.replay import angles, differentiated
from gyro_calibration.logs.log import Array
from gyro_calibration.model.noise import Noise
import numpy as np
from scipy.optimize import minimize
from scipy.stats import chi2

NAMES = ('angle_random_walk', 'bias_instability', 'rate_random_walk')


@dataclass(frozen=True)
class NoiseParameters:
    """
    Noise fitted to a residual.

    Attributes
    ----------
    noise : the figures
    interval : of 95 % of each, by name
    chance : by name, how likely the model's figure would leave as much or as little

    """

    noise: Noise
    interval: dict[str, tuple[float, float]]
    chance: dict[str, float]


@dataclass(frozen=True)
class _Bands:
    """
    The coefficients of b bands.

    Attributes
    ----------
    energy, count : of each band
    parts : the variance that each figure of 1 gives them, shape (b, 3) or (b, 4)
    known : the variance that is no figure's, shape (b,)

    """

    energy: Array
    count: Array
    parts: Array
    known: Array

    def variance(self, logarithms: Array) -> Array:
        """Return the variance by squared figures, given by their logarithms."""
        return np.asarray(self.known + self.parts @ np.exp(logarithms))

    def cost(self, logarithms: Array) -> float:
        """Return twice the negative log likelihood of the logarithms of squared figures."""
        variance = self.variance(logarithms)
        return float((self.count * np.log(variance) + self.energy / variance).sum())


def noise_parameters(done: Fitted, expected: Noise, rounds: bool = False) -> NoiseParameters:
    """
    Fit noise figures to the residual, and compare them with those of a model.

    Parameters
    ----------
    done : what was found
    expected : the noise of the model; where its angle random walk is 0 it claims nothing
    rounds : whether the model rounds its output itself, so that its angle random walk is without
        that; otherwise it may be with it

    """
    bands = _bands(done)
    without = _compared(bands, expected)
    if rounds or not bands.known.any():
        return without
    whole = _compared(replace(bands, known=np.zeros_like(bands.known)), expected)
    return replace(whole, chance={name: max(chance, without.chance[name])
                                  for name, chance in whole.chance.items()})


def _compared(bands: _Bands, expected: Noise) -> NoiseParameters:
    best, least = _fit(bands, {})
    figures = {name: float(np.exp(0.5 * best[place])) for place, name in enumerate(NAMES)}
    floor = _floors(bands, best)
    noise = Noise(**{name: figures[name] if best[place] > floor[place] else 0.0
                     for place, name in enumerate(NAMES)})
    chance, intervals = {}, {}
    for place, name in enumerate(NAMES):
        intervals[name] = _interval(bands, place, best, least)
        if expected.angle_random_walk:
            _, cost = _fit(
                bands, {place: 2.0 * float(np.log(max(getattr(expected, name), 1e-12)))}, best)
            chance[name] = float(chi2.sf(max(cost - least, 0.0), 1))
    return NoiseParameters(noise, intervals, chance)


def _bands(done: Fitted) -> _Bands:
    problem, (angle, step) = done.problem, done.problem.angles()
    left = np.concatenate(done.left()) * problem.deviation
    # The figures of noise behind a filter are those below its cut-off, where the level is still 1.
    used = np.concatenate([angles(each.points) < 1.5 * np.pi / len(each.levels)
                           for each in problem.replays])
    coarse = np.concatenate([np.full(each.points - 1, each.coarse / each.every)
                             for each in problem.replays])
    frequency = angle / (2.0 * np.pi * step)
    wave = 2.0 - 2.0 * np.cos(angle)
    parts = [1.0 / step, 1.0 / (2.0 * np.pi * frequency * step), step / wave]
    if problem.first.reference:
        parts.append(differentiated(angle) / step)
    energy, count, *totals = (np.add.reduceat(part * used, problem.starts)
                              for part in (left ** 2, np.ones(len(left)), coarse, *parts))
    kept = count > 0.0
    known, *means = (total[kept] / count[kept] for total in totals)
    return _Bands(energy[kept], count[kept], np.column_stack(means), known)


def _fit(bands: _Bands, held: dict[int, float], start: Array | None = None) -> tuple[Array, float]:
    """Return the likeliest logarithms of squared figures, some of them held, and the cost."""
    size = bands.parts.shape[1]
    free = [place for place in range(size) if place not in held]
    usual = bands.energy / bands.count
    begin = start if start is not None else np.log(np.array([
        (usual / bands.parts[:, place]).min() for place in range(size)]))
    whole = np.array([held.get(place, begin[place]) for place in range(size)])

    def cost(some: Array) -> float:
        whole[free] = some
        return bands.cost(whole)

    found = [minimize(cost, begin[free] + shift, method='L-BFGS-B',
                      bounds=[(-60.0, 20.0)] * len(free))
             for shift in (0.0, *(-3.0 * (np.arange(len(free)) == place)
                                  for place in range(1, len(free))))]
    best = min(found, key=lambda one: one.fun)
    whole[free] = best.x
    return whole.copy(), float(best.fun)


def _floors(bands: _Bands, best: Array) -> Array:
    """Return the logarithms below which a figure is nowhere a hundredth of the noise."""
    variance = bands.variance(best)
    return np.array([np.log(0.01 * (variance / bands.parts[:, place]).min())
                     for place in range(len(best))])


def _interval(bands: _Bands, place: int, best: Array, least: float) -> tuple[float, float]:
    """Return where the cost is within that of 95 % of the least."""
    limit = least + float(chi2.ppf(0.95, 1))
    ends = []
    for direction in (-1.0, 1.0):
        inside, step = 0.0, 0.02
        while (step < 12.0
               and _fit(bands, {place: best[place] + direction * step}, best)[1] < limit):
            inside, step = step, step * 1.6
        ends.append(best[place] + direction * 0.5 * (inside + step) if step < 12.0
                    else -np.inf if direction < 0 else best[place] + 12.0)
    return float(np.exp(0.5 * ends[0])), float(np.exp(0.5 * ends[1]))
