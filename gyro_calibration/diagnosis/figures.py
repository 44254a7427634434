"""
The noise of what is left, in the figures of IEEE Std 952, and how it compares with what the model says.

"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize
from scipy.stats import chi2

from gyro_calibration.diagnosis.field import Work
from gyro_calibration.diagnosis.spectrum import differentiated
from gyro_calibration.log import Array
from gyro_calibration.noise import Noise

NAMES = ('angle_random_walk', 'bias_instability', 'rate_random_walk')


@dataclass(frozen=True)
class NoiseFigures:
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
    """Energy and number of the coefficients of each band, and the variance that each figure of 1 gives them, shape (b, 3) or (b, 4)."""

    energy: Array
    count: Array
    parts: Array

    def cost(self, logarithms: Array) -> float:
        """Return twice the negative log likelihood of squared figures, given by their logarithms."""
        variance = self.parts @ np.exp(logarithms)
        return float((self.count * np.log(variance) + self.energy / variance).sum())


def noise_figures(done: Work, expected: Noise) -> NoiseFigures:
    """Fit noise figures to what is left, and compare them with those of a model; one whose angle random walk is 0 claims nothing."""
    bands = _bands(done)
    best, least = _fit(bands, {})
    figures = {name: float(np.exp(0.5 * best[place])) for place, name in enumerate(NAMES)}
    floor = _floors(bands, best)
    noise = Noise(**{name: figures[name] if best[place] > floor[place] else 0.0 for place, name in enumerate(NAMES)})
    chance, intervals = {}, {}
    for place, name in enumerate(NAMES):
        intervals[name] = _interval(bands, place, best, least)
        if expected.angle_random_walk:
            _, cost = _fit(bands, {place: 2.0 * float(np.log(max(getattr(expected, name), 1e-12)))}, best)
            chance[name] = float(chi2.sf(max(cost - least, 0.0), 1))
    return NoiseFigures(noise, intervals, chance)


def _bands(done: Work) -> _Bands:
    values, _ = done.estimates
    field = done.field
    left = (done.residual - values @ done.columns) * field.deviation
    angle, step = field.angles()
    count = np.diff(np.append(field.starts, len(left))).astype(float)
    frequency = angle / (2.0 * np.pi * step)
    wave = 2.0 - 2.0 * np.cos(angle)
    parts = [1.0 / step, 1.0 / (2.0 * np.pi * frequency * step), step / wave]
    if field.first.reference:
        parts.append(differentiated(angle) / step)
    means = np.column_stack([np.add.reduceat(part, field.starts) / count for part in parts])
    return _Bands(np.add.reduceat(left ** 2, field.starts), count, means)


def _fit(bands: _Bands, held: dict[int, float], start: Array | None = None) -> tuple[Array, float]:
    """Return the logarithms of the squared figures that are likeliest, some of them held, and the cost."""
    size = bands.parts.shape[1]
    free = [place for place in range(size) if place not in held]
    usual = bands.energy / bands.count
    begin = start if start is not None else np.log(np.array([(usual / bands.parts[:, place]).min() for place in range(size)]))
    whole = np.array([held.get(place, begin[place]) for place in range(size)])

    def cost(some: Array) -> float:
        whole[free] = some
        return bands.cost(whole)

    found = [minimize(cost, begin[free] + shift, method='L-BFGS-B', bounds=[(-60.0, 20.0)] * len(free))
             for shift in (0.0, *(-3.0 * (np.arange(len(free)) == place) for place in range(1, len(free))))]
    best = min(found, key=lambda one: one.fun)
    whole[free] = best.x
    return whole.copy(), float(best.fun)


def _floors(bands: _Bands, best: Array) -> Array:
    """Return the logarithms below which a figure is nowhere a hundredth of the noise."""
    variance = bands.parts @ np.exp(best)
    return np.array([np.log(0.01 * (variance / bands.parts[:, place]).min()) for place in range(len(best))])


def _interval(bands: _Bands, place: int, best: Array, least: float) -> tuple[float, float]:
    """Return where the cost is within that of 95 % of the least."""
    limit = least + float(chi2.ppf(0.95, 1))
    ends = []
    for direction in (-1.0, 1.0):
        inside, step = 0.0, 0.02
        while step < 12.0 and _fit(bands, {place: best[place] + direction * step}, best)[1] < limit:
            inside, step = step, step * 1.6
        ends.append(best[place] + direction * 0.5 * (inside + step) if step < 12.0 else -np.inf if direction < 0 else best[place] + 12.0)
    return float(np.exp(0.5 * ends[0])), float(np.exp(0.5 * ends[1]))
