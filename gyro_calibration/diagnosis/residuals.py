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

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
import math
from typing import TypeAlias

from gyro_calibration.allan.deviation import allan_deviation
from gyro_calibration.calibration.likelihood import MIN_FIT_PROBABILITY
from gyro_calibration.diagnosis.candidates import common_channels
from gyro_calibration.diagnosis.causes import CAUSES, make_finding, NOISE_NAMES
from gyro_calibration.diagnosis.findings import (
    Curve, Estimate, Finding, RULED_OUT_DEFICIT, VALUE_ALARM_RATE)
from gyro_calibration.diagnosis.regression import RegressionFit, VALUE_PENALTY
from gyro_calibration.diagnosis.replay import (
    coefficient_angles, cosine_transform, NoiseShape, Replay, spline_derivative_gain)
from gyro_calibration.diagnosis.words import format_amount
from gyro_calibration.logs.log import Array
from gyro_calibration.logs.quality import white_noise_deviation
from gyro_calibration.model.gyro_model import GyroModel
from gyro_calibration.model.noise import MARKOV_FLOOR_RATIO, Noise
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq, minimize
from scipy.stats import chi2

#: Index of a figure -> lowest and highest logarithm of its square.
Limits: TypeAlias = Mapping[int, tuple[float, float]]
#: Bins of a curve.
_CURVE_BINS = 40
#: Variable, unit, channel that it needs, and values of a log.
_CURVE_VARIABLES: Sequence[tuple[str, str, str, Callable[[Replay], Array]]] = (
    ('time', 's', '', lambda each: each.channels.time - each.channels.time[0]),
    ('rate', 'rad/s', 'rate', lambda each: each.channels.rate),
    ('rate_change', 'rad/s²', 'rate',
     lambda each: np.gradient(each.channels.rate, each.channels.time)),
    ('heading', 'rad', 'rate', lambda each: np.mod(each.channels.heading, 2.0 * np.pi)),
    ('temperature', 'degC', 'temperature', lambda each: each.channels.temperature),
    ('temperature_rate', 'K/s', 'temperature',
     lambda each: (each.channels.temperature - each.lagged('temperature', 10.0)) / 10.0),
    ('specific_force', 'm/s²', 'specific_force', lambda each: each.channels.specific_force),
    ('vibration', '(m/s²)²', 'specific_force', lambda each: each.lagged('vibration', 1.0)),
    ('supply', 'V', 'supply', lambda each: np.asarray(each.channels.supply)))


@dataclass(frozen=True)
class BandEnergies:
    """The coefficients of b bands."""

    # energy, count: of each band
    energy: Array
    count: Array
    # variance of the bands by a figure of 1, shape (b, 3), or (b, 4) with rounding of the
    # reference
    unit_variances: Array
    known_variance: Array  # variance by other noise, shape (b,)
    # variance of the bands by Gauss-Markov processes with the Allan floor of a bias instability
    # of 1, shape (b, k)
    markov_variances: Array

    def take(self, kept: NDArray[np.bool_]) -> BandEnergies:
        """Return some of the bands."""
        return BandEnergies(*(getattr(self, each.name)[kept] for each in fields(self)))

    def variance(self, logarithms: Array) -> Array:
        """Return the variance by squared figures, given by their logarithms."""
        return np.asarray(self.known_variance + self.unit_variances @ np.exp(logarithms))

    def fit(self, limits: Limits | None = None,
            start: Array | None = None) -> tuple[Array, float]:
        """
        Return the most likely logarithms of squared figures, and twice their negative likelihood.

        Parameters
        ----------
        limits : index -> lowest and highest logarithm of a squared figure
        start : logarithms to begin with

        """
        low, high = (np.full(self.unit_variances.shape[1], end) for end in (-60.0, 20.0))
        for place, ends in (limits or {}).items():
            low[place], high[place] = ends
        usual = self.energy / self.count
        logarithms = np.clip(start if start is not None else np.log(
            (usual[:, None] / self.unit_variances).min(axis=0)), low, high)
        free, total = np.flatnonzero(low < high), float(self.count.sum())

        def cost(some: Array) -> tuple[float, Array]:
            logarithms[free] = some
            variance = self.variance(logarithms)
            slope = (self.count - self.energy / variance) / variance / total
            # the mean, of which a first step along the slope is not too large
            return (float((self.count * np.log(variance) + self.energy / variance).sum() / total),
                    (slope @ self.unit_variances[:, free]) * np.exp(some))

        if not len(free):
            return logarithms, total * cost(logarithms[free])[0]
        begin = logarithms[free]
        shifts = [0.0, *(-3.0 * (free == place) for place in free[1:])]
        best = min((minimize(cost, begin + shift, jac=True, method='L-BFGS-B',
                             bounds=list(zip(low[free], high[free])),
                             options={'ftol': 0.0, 'gtol': 1e-4 / total})
                    for shift in shifts),
                   key=lambda one: one.fun)
        logarithms[free] = best.x
        return logarithms, total * float(best.fun)


def fit_noise_parameters(fit: RegressionFit, is_rounding_modelled: bool = False) -> Noise:
    """
    Fit noise figures to the residual.

    Frequencies with more power than the noise, such as those of a vibration, are left out. The
    angle random walk is without rounding noise if the model has quantization; otherwise it may
    include it.
    """
    bands = drop_tone_bands(_band_energies(fit))
    if not is_rounding_modelled:
        bands = replace(bands, known_variance=0.0 * bands.known_variance)
    best, _ = bands.fit()
    # a figure that is less than 1 % of the noise everywhere is 0
    shares = (bands.unit_variances * np.exp(best) / bands.variance(best)[:, None]).max(axis=0)
    return Noise(**{name: float(np.exp(0.5 * best[place])) if shares[place] > 0.01 else 0.0
                    for place, name in enumerate(NOISE_NAMES)})


def find_changed_figures(fit: RegressionFit, model: GyroModel,
                         is_rounding_modelled: bool) -> dict[str, Finding]:
    """
    Find the noise figures that differ from those of a model, one by one, the clearest first.

    A figure lies within its bounds in the model, or has its value, until its change explains more
    than chance. A model states the floor of the Allan deviation: its bias instability is flicker
    or a Gauss-Markov process of any correlation time. The angle random walk may include the
    rounding of the output, unless the model has quantization. It is not compared with an encoder,
    whose steps hide it, and no figure is if the model has none.
    """
    expected = model.noise
    if not expected.angle_random_walk:
        return {}
    bands = drop_tone_bands(_band_energies(fit))
    limits = {}
    for place, name in enumerate(NOISE_NAMES):
        low, high = model.noise_bounds.get(name, (getattr(expected, name),) * 2)
        limits[place] = 2.0 * math.log(max(low, 1e-12)), 2.0 * math.log(max(high, 1e-12))
    if any(each.heading_step for each in fit.problem.replays):
        del limits[0]
    found = _changed_figures(bands, limits, expected)
    if not is_rounding_modelled and bands.known_variance.any():
        other = _changed_figures(replace(bands, known_variance=0.0 * bands.known_variance), limits,
                                 expected)
        found = {name: each for name, each in other.items() if name in found}
    return found


def _changed_figures(bands: BandEnergies, limits: Limits,
                     expected: Noise) -> dict[str, Finding]:
    kinds = [bands]
    for own in bands.markov_variances.T:
        kinds.append(replace(bands, unit_variances=bands.unit_variances.copy()))
        kinds[-1].unit_variances[:, 1] = own

    def held(changed: frozenset[int]) -> dict[int, tuple[float, float]]:
        return {place: ends for place, ends in limits.items() if place not in changed}

    @cache
    def likeliest(changed: frozenset[int]) -> tuple[float, BandEnergies, Array]:
        fits = [(*each.fit(held(changed))[::-1], each) for each in kinds]
        cost, figures, kind = min(fits, key=lambda each: each[0])
        # a bias instability has a time as well
        return cost + 2.0 * VALUE_PENALTY * (1 in changed), kind, figures

    def chance(changed: frozenset[int], place: int) -> float:
        """Return the p-value of a change."""
        gain = likeliest(changed - {place})[0] - likeliest(changed)[0]
        return float(chi2.sf(max(gain, 0.0), 1))

    changed: frozenset[int] = frozenset()
    while more := limits.keys() - changed:
        best = min(more, key=lambda place: chance(changed | {place}, place))
        if chance(changed | {best}, best) >= VALUE_ALARM_RATE:
            break
        changed |= {best}
    found = {}
    for place in changed:
        if (p_value := chance(changed, place)) < VALUE_ALARM_RATE:
            cost, kind, figures = likeliest(changed)
            others = (NOISE_NAMES[other] for other in sorted(limits.keys() - changed)
                      if likeliest(changed - {place} | {other})[0] - cost
                      < 2.0 * RULED_OUT_DEFICIT)
            name, value = NOISE_NAMES[place], float(np.exp(0.5 * figures[place]))
            size = Estimate(value, _likelihood_interval(kind, place, figures, held(changed)),
                            CAUSES[name].unit)
            states, shows = (format_amount(each, size.unit, name)
                             for each in (getattr(expected, name), value))
            found[name] = make_finding(name, {name: size}, p_value, tuple(others),
                                       evidence=f'the model states {states}, the log {shows}')
    return found


def _likelihood_interval(bands: BandEnergies, place: int, best: Array,
                         limits: Limits) -> tuple[float, float]:
    """Return the 95 % interval of a figure by the profile of the likelihood."""
    def cost(shift: float) -> float:
        return bands.fit({**limits, place: (best[place] + shift,) * 2}, best)[1]

    most = cost(0.0) + float(chi2.ppf(0.95, 1))
    low, high = (brentq(lambda by: cost(by) - most, 0.0, end, xtol=1e-3)
                 if cost(end) > most else unlimited
                 for end, unlimited in ((-12.0, -np.inf), (12.0, 12.0)))
    return float(np.exp(0.5 * (best[place] + low))), float(np.exp(0.5 * (best[place] + high)))


def _band_energies(fit: RegressionFit) -> BandEnergies:
    problem, (angle, step) = fit.problem, fit.problem.coefficient_angles()
    left = np.concatenate(fit.residual_transforms()) * problem.deviation
    coarse = np.concatenate(
        [np.full(each.point_count - 1, each.rounding_variance / each.decimation)
         for each in problem.replays])
    # The noise parameters before a filter are those of low frequencies.
    used = np.concatenate(
        [coefficient_angles(each.point_count) < (np.pi if each.decimation == 1 else 0.25 * np.pi)
         for each in problem.replays])
    wave = 2.0 - 2.0 * np.cos(angle)
    parts = [1.0 / step, 1.0 / angle, step / wave]
    if problem.noise_shapes[0].rounding_ratio:
        parts.append(spline_derivative_gain(angle) / step)
    times = {each.correlation_time for each in problem.noise_shapes if each.markov_ratio}
    floor = MARKOV_FLOOR_RATIO ** 2 / step
    markov = [floor * (NoiseShape(0.0, 1.0, time).variance(angle, step) - 1.0)
              for time in sorted(times)]
    energy, count, *totals = (np.add.reduceat(part * used, problem.band_starts)
                              for part in (left ** 2, np.ones(len(left)), coarse, *parts, *markov))
    kept = count > 0.0
    known, *means = (total[kept] / count[kept] for total in totals)
    return BandEnergies(energy[kept], count[kept], np.column_stack(means[:len(parts)]), known,
                        np.column_stack(means[len(parts):]))


def drop_tone_bands(bands: BandEnergies) -> BandEnergies:
    """Remove bands with more energy than the noise of the others, the most unlikely first."""
    kept = np.ones(len(bands.energy), dtype=bool)
    while kept.sum() > len(kept) / 2:
        variance = bands.variance(bands.take(kept).fit()[0])
        chances = np.where(kept, chi2.sf(bands.energy / variance, bands.count), 1.0)
        if chances.min() > MIN_FIT_PROBABILITY / len(kept):
            return bands.take(kept)
        kept[chances.argmin()] = False
    return bands


# curves

def model_residuals(replays: Sequence[Replay]) -> list[Array]:
    """Return the residual of the given model for each log, rad/s, shape (n,)."""
    return [each.channels.output - each.reference for each in replays]


def residual_curves(before: Sequence[Array], after: RegressionFit) -> list[Curve]:
    """Return the mean residual in bins of each variable, before and after the extension."""
    replays = after.problem.replays
    simulated = [each.simulated_error + error - rest
                 for each, error, rest in zip(replays, model_residuals(replays), before)]
    values = [np.concatenate([part[each.valid] for part, each in zip(parts, replays)])
              for parts in (before, after.unbiased_residuals, simulated)]
    has = common_channels(replays)
    if any(np.ptp(each.channels.rate) > 0.0 for each in replays):
        has |= {'rate'}
    curves = []
    for name, unit, channel, of in _CURVE_VARIABLES:
        parts = [of(each)[each.valid] for each in replays] if {channel} <= has | {''} else []
        at = np.concatenate([np.empty(0), *parts])
        low, high = np.quantile(at, [0.001, 0.999]) if len(at) else (0.0, 0.0)
        if not high > low:
            continue
        # means in even bins between the 0.1 % and 99.9 % quantiles, of 10 or more samples
        bins = [np.clip(((part - low) / (high - low) * _CURVE_BINS).astype(int), 0,
                        _CURVE_BINS - 1) for part in parts]
        place = np.concatenate(bins)
        count = np.bincount(place, minlength=_CURVE_BINS)
        enough = count > 9
        middle, *means = (np.bincount(place, each, _CURVE_BINS)[enough] / count[enough]
                          for each in (at, *values))
        deviation = np.sqrt(_bin_variances(after, bins)[enough]) / count[enough]
        if len(middle) > 1:
            curves.append(Curve(name, unit, middle, means[0], means[1], deviation, means[2]))
    return [*curves, _amplitude_spectrum(before, after)]


def _bin_variances(fit: RegressionFit, bins: Sequence[NDArray[np.intp]]) -> Array:
    """
    Return the variance by noise of the sum of the residual in each bin, (rad/s)², shape (BINS,).

    Slow noise is correlated between samples; its cosine transform is not. Noise that averages out
    among the samples of one grid point is white.
    """
    problem, total = fit.problem, np.zeros(_CURVE_BINS)
    relative = (fit.noise_probability * fit.residual_squares
                / fit.degrees_of_freedom) @ (1.0 / problem.weights)
    variances = problem.split_by_log(problem.deviation ** 2 * problem.by_coefficient(relative))
    for each, residual, variance, place in zip(problem.replays, fit.residuals, variances, bins):
        # samples beyond the points count as mirrored, as the transform continues the residual
        point = each.grid_index // each.decimation
        point = np.minimum(point, 2 * each.point_count - 1 - point)
        counts = np.bincount(place * each.point_count + point,
                             minlength=_CURVE_BINS * each.point_count).astype(float)
        counts = counts.reshape(_CURVE_BINS, each.point_count)
        squares = (counts ** 2).sum(axis=1)
        unresolved = np.maximum(counts.sum(axis=1) - squares / each.decimation, 0.0)
        total += (cosine_transform(counts) ** 2 @ variance
                  + white_noise_deviation(residual[each.valid]) ** 2 * unresolved)
    return total


def _amplitude_spectrum(before: Sequence[Array], after: RegressionFit) -> Curve:
    """Return the largest amplitude of the first log's residual in bins of frequency."""
    each = after.problem.replays[0]
    series = [each.resample(left[0]) for left in (before, after.unbiased_residuals)]
    amplitude = [np.sqrt(2.0) * np.abs(np.fft.rfft(values))[1:] * np.sqrt(2.0) / len(values)
                 for values in series]
    frequency = np.fft.rfftfreq(len(series[0]), each.point_interval)[1:]
    limits = np.geomspace(frequency[0], frequency[-1], _CURVE_BINS + 1)
    edges = np.unique(np.searchsorted(frequency, limits))[:-1]
    largest = [np.maximum.reduceat(values, edges) for values in amplitude]
    middle = np.sqrt(frequency[edges] * frequency[np.append(edges[1:], len(frequency)) - 1])
    counts = np.diff(np.append(edges, len(frequency)))
    usual = np.sqrt(np.add.reduceat(amplitude[1] ** 2, edges) / counts)
    return Curve('frequency', 'Hz', middle, largest[0], largest[1], usual)


def allan_curves(fit: RegressionFit, fitted: Noise, expected: Noise) -> Curve:
    """Return Allan deviations: of the residual of the first log, of fitted and simulated noise."""
    each = fit.problem.replays[0]
    allan = allan_deviation(each.resample(fit.residuals[0]), each.point_interval)
    times = allan.time
    return Curve(
        'averaging time', 's', times, allan.deviation, np.sqrt(fitted.allan_variance(times)),
        simulated=(np.sqrt(expected.allan_variance(times)) if expected.angle_random_walk
                   else None))
