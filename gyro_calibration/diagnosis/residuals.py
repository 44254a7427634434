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
Residuals of logs: noise parameters of IEEE Std 952 compared with those of the model, and curves.

The curves are along each variable, of the given and of the extended simulation.

"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

from gyro_calibration.allan import allan_deviation
from gyro_calibration.diagnosis.candidates import common_channels
from gyro_calibration.diagnosis.findings import Curve, HeadingCurve, NoiseCurve
from gyro_calibration.diagnosis.regression import FittedValues, RegressionFit
from gyro_calibration.diagnosis.replay import (
    coefficient_angles,
    cosine_transform,
    Replay,
    spline_derivative_gain,
)
from gyro_calibration.logs.log import Array, Mask
from gyro_calibration.logs.quality import white_noise_deviation
from gyro_calibration.model.noise import Noise
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.stats import chi2

NOISE_NAMES = ('angle_random_walk', 'bias_instability', 'rate_random_walk')
#: Probability that a frequency band of noise alone is rejected, per log.
_BAND_REJECTION_CHANCE = 1e-3
#: Bins of a curve, and points of a line over time.
CURVE_BINS, CURVE_POINTS = 40, 600
#: Samples of which the Allan deviation is taken.
_MAX_ALLAN_SAMPLES = 1 << 18


@dataclass(frozen=True)
class NoiseParameters:
    """
    Noise fitted to a residual.

    Attributes
    ----------
    noise : the figures
    intervals : of 95 % of each, by name
    p_values : p-value of the model's figure, by name

    """

    noise: Noise
    intervals: dict[str, tuple[float, float]]
    p_values: dict[str, float]


@dataclass(frozen=True)
class _BandEnergies:
    """
    The coefficients of b bands.

    Attributes
    ----------
    energy, count : of each band
    unit_variances : variance of the bands by a figure of 1, shape (b, 3) or (b, 4)
    known_variance : variance by other noise, shape (b,)

    """

    energy: Array
    count: Array
    unit_variances: Array
    known_variance: Array

    def variance(self, logarithms: Array) -> Array:
        """Return the variance by squared figures, given by their logarithms."""
        return np.asarray(self.known_variance + self.unit_variances @ np.exp(logarithms))

    def cost(self, logarithms: Array) -> float:
        """Return twice the negative log likelihood of the logarithms of squared figures."""
        variance = self.variance(logarithms)
        return float((self.count * np.log(variance) + self.energy / variance).sum())


def fit_noise_parameters(fit: RegressionFit, expected: Noise,
                         is_rounding_modelled: bool = False) -> NoiseParameters:
    """
    Fit noise figures to the residual, and compare them with those of a model.

    Frequencies with more power than the noise, such as those of a vibration, are left out, as
    `allan` leaves out averaging times that a filter or interference affects.

    Parameters
    ----------
    fit : the fit
    expected : the noise of the model; not compared if its angle random walk is 0
    is_rounding_modelled : whether the model has quantization, so that its angle random walk is
        without the rounding noise; otherwise it may include it

    """
    bands = _drop_tone_bands(_band_energies(fit))
    without = _fit_and_test(bands, expected)
    if is_rounding_modelled or not bands.known_variance.any():
        return without
    whole = _fit_and_test(replace(bands, known_variance=np.zeros_like(bands.known_variance)),
                          expected)
    return replace(whole, p_values={name: max(chance, without.p_values[name])
                                    for name, chance in whole.p_values.items()})


def _fit_and_test(bands: _BandEnergies, expected: Noise) -> NoiseParameters:
    best, least = _fit_noise(bands, {})
    parameters = {name: float(np.exp(0.5 * best[place])) for place, name in enumerate(NOISE_NAMES)}
    floors = _significance_floors(bands, best)
    noise = Noise(**{name: parameters[name] if best[place] > floors[place] else 0.0
                     for place, name in enumerate(NOISE_NAMES)})
    chance, intervals = {}, {}
    for place, name in enumerate(NOISE_NAMES):
        intervals[name] = _likelihood_interval(bands, place, best, least)
        if expected.angle_random_walk:
            _, cost = _fit_noise(
                bands, {place: 2.0 * float(np.log(max(getattr(expected, name), 1e-12)))}, best)
            chance[name] = float(chi2.sf(max(cost - least, 0.0), 1))
    return NoiseParameters(noise, intervals, chance)


def _band_energies(fit: RegressionFit) -> _BandEnergies:
    problem, (angle, step) = fit.problem, fit.problem.coefficient_angles()
    left = np.concatenate(fit.residual_transforms()) * problem.deviation
    # The noise parameters before a filter are those of frequencies below its cut-off.
    used = np.concatenate(
        [coefficient_angles(each.point_count) < 1.5 * np.pi / len(each.noise_levels)
         for each in problem.replays])
    coarse = np.concatenate(
        [np.full(each.point_count - 1, each.rounding_variance / each.decimation)
         for each in problem.replays])
    frequency = angle / (2.0 * np.pi * step)
    wave = 2.0 - 2.0 * np.cos(angle)
    parts = [1.0 / step, 1.0 / (2.0 * np.pi * frequency * step), step / wave]
    if problem.reference_noise.rounding_ratio:
        parts.append(spline_derivative_gain(angle) / step)
    energy, count, *totals = (np.add.reduceat(part * used, problem.band_starts)
                              for part in (left ** 2, np.ones(len(left)), coarse, *parts))
    kept = count > 0.0
    known, *means = (total[kept] / count[kept] for total in totals)
    return _BandEnergies(energy[kept], count[kept], np.column_stack(means), known)


def _drop_tone_bands(bands: _BandEnergies) -> _BandEnergies:
    """Remove bands with more energy than the noise of the others, the most unlikely first."""
    kept: Mask = np.ones(len(bands.energy), dtype=bool)
    while kept.sum() > len(kept) / 2:
        kept_bands = _BandEnergies(bands.energy[kept], bands.count[kept],
                                   bands.unit_variances[kept], bands.known_variance[kept])
        chances = np.where(kept, chi2.sf(
            bands.energy / bands.variance(_fit_noise(kept_bands, {})[0]), bands.count), 1.0)
        weakest = int(chances.argmin())
        if chances[weakest] > _BAND_REJECTION_CHANCE / len(kept):
            return kept_bands
        kept[weakest] = False
    return bands


def _fit_noise(bands: _BandEnergies, fixed: dict[int, float],
               start: Array | None = None) -> tuple[Array, float]:
    """Return the most likely logarithms of squared figures, some of them fixed, and the cost."""
    size = bands.unit_variances.shape[1]
    free = [place for place in range(size) if place not in fixed]
    usual = bands.energy / bands.count
    begin = (start if start is not None
             else np.log((usual[:, None] / bands.unit_variances).min(axis=0)))
    logarithms = np.array([fixed.get(place, begin[place]) for place in range(size)])

    def cost(some: Array) -> float:
        logarithms[free] = some
        return bands.cost(logarithms)

    shifts = (0.0, *(-3.0 * (np.arange(len(free)) == place) for place in range(1, len(free))))
    best = min((minimize(cost, begin[free] + shift, method='L-BFGS-B',
                         bounds=[(-60.0, 20.0)] * len(free)) for shift in shifts),
               key=lambda one: one.fun)
    logarithms[free] = best.x
    return logarithms.copy(), float(best.fun)


def _significance_floors(bands: _BandEnergies, best: Array) -> Array:
    """Return the logarithms below which a figure is less than 1 % of the noise everywhere."""
    variance = bands.variance(best)
    return np.log(0.01 * (variance[:, None] / bands.unit_variances).min(axis=0))


def _likelihood_interval(bands: _BandEnergies, place: int, best: Array,
                         min_cost: float) -> tuple[float, float]:
    """Return the 95 % interval of a figure by the profile of the cost."""
    limit = min_cost + float(chi2.ppf(0.95, 1))
    ends = []
    for direction in (-1.0, 1.0):
        inside, step = 0.0, 0.02
        while (step < 12.0
               and _fit_noise(bands, {place: best[place] + direction * step}, best)[1] < limit):
            inside, step = step, step * 1.6
        ends.append(best[place] + direction * 0.5 * (inside + step) if step < 12.0
                    else -np.inf if direction < 0 else best[place] + 12.0)
    return float(np.exp(0.5 * ends[0])), float(np.exp(0.5 * ends[1]))


# curves

def unbiased_residuals(fit: FittedValues) -> list[Array]:
    """Return the residual of each log without its bias, rad/s, shape (n,)."""
    return [residual - bias for residual, bias in zip(fit.residuals, fit.biases)]


def model_residuals(replays: Sequence[Replay]) -> list[Array]:
    """Return the residual of the given model for each log, rad/s, shape (n,)."""
    return [each.channels.output - each.reference for each in replays]


def residual_curves(before: Sequence[Array], after: FittedValues) -> list[Curve]:
    """
    Return the mean residual in bins of each variable that changes in the logs.

    Parameters
    ----------
    before : residual of the simulation for each log, rad/s, shape (n,)
    after : the extended simulation

    """
    replays = after.replays
    simulated = [each.simulated_error + error - rest
                 for each, error, rest in zip(replays, model_residuals(replays), before)]
    values = [np.concatenate([part[each.valid] for part, each in zip(parts, replays)])
              for parts in (before, unbiased_residuals(after), simulated)]
    found = [_binned_curve(name, unit, [of(each)[each.valid] for each in replays], values, after)
             for name, unit, of in _curve_variables(replays)]
    return [each for each in found if len(each.at) > 1] + [_amplitude_spectrum(before, after)]


def _curve_variables(
        replays: Sequence[Replay]) -> Iterator[tuple[str, str, Callable[[Replay], Array]]]:
    """Give name, unit, and a function that returns the variable of a log."""
    has = common_channels(replays)
    yield 'time', 's', lambda each: each.channels.time - each.channels.time[0]
    if any(np.ptp(each.channels.rate) > 0.0 for each in replays):
        yield 'rate', 'rad/s', lambda each: each.channels.rate
        yield ('rate_change',
               'rad/s²', lambda each: np.gradient(each.channels.rate, each.channels.time))
        yield 'heading', 'rad', lambda each: np.mod(each.channels.heading, 2.0 * np.pi)
    if 'temperature' in has:
        yield 'temperature', 'degC', lambda each: each.channels.temperature
        yield ('temperature_rate', 'K/s', lambda each: (
            each.channels.temperature - each.lagged('temperature', 10.0)) / 10.0)
    if 'specific_force' in has:
        yield 'specific_force', 'm/s²', lambda each: each.channels.specific_force
        yield 'vibration', '(m/s²)²', lambda each: each.lagged('vibration', 1.0)
    if 'supply' in has:
        yield 'supply', 'V', lambda each: np.asarray(each.channels.supply)


def _binned_curve(name: str, unit: str, parts: Sequence[Array], values: Sequence[Array],
                  after: FittedValues) -> Curve:
    """Return means in even bins between the 0.1 % and 99.9 % quantiles, of 10 or more samples."""
    at = np.concatenate(parts)
    low, high = np.quantile(at, [0.001, 0.999])
    if not high > low:
        return Curve(name, unit, *(np.empty(0) for _ in range(5)))
    bins = [np.clip(((part - low) / (high - low) * CURVE_BINS).astype(int), 0, CURVE_BINS - 1)
            for part in parts]
    place = np.concatenate(bins)
    count = np.bincount(place, minlength=CURVE_BINS)
    enough = count > 9
    middle, left, mended, simulated = (np.bincount(place, each, CURVE_BINS)[enough] / count[enough]
                                       for each in (at, *values))
    return Curve(name, unit, middle, left, mended,
                 np.sqrt(_bin_variances(after, bins)[enough]) / count[enough], simulated)


def _bin_variances(fit: FittedValues, bins: Sequence[NDArray[np.intp]]) -> Array:
    """
    Return the variance by noise of the sum of the residual in each bin, (rad/s)², shape (BINS,).

    Slow noise is correlated between samples; its cosine transform is not. Noise that averages out
    among the samples of one grid point is white.

    """
    total = np.zeros(CURVE_BINS)
    for each, residual, variance, place in zip(fit.replays, fit.residuals,
                                               _coefficient_variances(fit.fit), bins):
        point = np.minimum(each.grid_index // each.decimation, each.point_count - 1)
        counts = np.bincount(place * each.point_count + point,
                             minlength=CURVE_BINS * each.point_count).astype(float)
        counts = counts.reshape(CURVE_BINS, each.point_count)
        squares = (counts ** 2).sum(axis=1)
        unresolved = np.maximum(counts.sum(axis=1) - squares / each.decimation, 0.0)
        total += (cosine_transform(counts) ** 2 @ variance
                  + white_noise_deviation(residual[each.valid]) ** 2 * unresolved)
    return total


def _coefficient_variances(fit: RegressionFit) -> list[Array]:
    """Return each log's variances of coefficients, averaged over noises, shape (points - 1,)."""
    problem, by_noise = fit.problem, fit.noise_likelihood
    relative = (by_noise.probability[0] * by_noise.residual_squares[0]
                / fit.marginalized.degrees_of_freedom) @ (1.0 / problem.noises.weights)
    count = np.diff(np.append(problem.band_starts, len(problem.deviation)))
    variance = problem.deviation ** 2 * np.repeat(relative, count)
    return np.split(variance, np.cumsum([each.point_count - 1 for each in problem.replays])[:-1])


def _amplitude_spectrum(before: Sequence[Array], after: FittedValues) -> Curve:
    """Return the largest amplitude of the first log's residual in bins of frequency."""
    each = after.replays[0]
    series = [each.resample(left[0]) for left in (before, unbiased_residuals(after))]
    amplitude = [np.sqrt(2.0) * np.abs(np.fft.rfft(values))[1:] * np.sqrt(2.0) / len(values)
                 for values in series]
    frequency = np.fft.rfftfreq(len(series[0]), each.point_interval)[1:]
    limits = np.geomspace(frequency[0], frequency[-1], CURVE_BINS + 1)
    edges = np.unique(np.searchsorted(frequency, limits))[:-1]
    largest = [np.maximum.reduceat(values, edges) for values in amplitude]
    middle = np.sqrt(frequency[edges] * frequency[np.append(edges[1:], len(frequency)) - 1])
    counts = np.diff(np.append(edges, len(frequency)))
    usual = np.sqrt(np.add.reduceat(amplitude[1] ** 2, edges) / counts)
    return Curve('frequency', 'Hz', middle, largest[0], largest[1], usual, np.zeros(len(middle)))


def heading_error_curve(before: Sequence[Array], after: FittedValues) -> HeadingCurve:
    """Return the heading error over the first log, by its residual before and after extension."""
    each = after.replays[0]
    lines = [np.cumsum(each.resample(left[0])) * each.point_interval
             for left in (before, unbiased_residuals(after))]
    some = np.unique(np.linspace(0, each.point_count - 1, CURVE_POINTS).astype(int))
    return HeadingCurve(some * each.point_interval, lines[0][some], lines[1][some])


def allan_curves(fit: FittedValues, fitted: Noise, expected: Noise) -> NoiseCurve:
    """Return Allan deviations: of the residual of the first log, of fitted and simulated noise."""
    each = fit.replays[0]
    allan = allan_deviation(
        each.resample(fit.residuals[0])[:_MAX_ALLAN_SAMPLES], each.point_interval)
    times = allan.time
    return NoiseCurve(
        times, allan.deviation, np.sqrt(fitted.allan_variance(times)),
        np.sqrt(expected.allan_variance(times)) if expected.angle_random_walk else None)
