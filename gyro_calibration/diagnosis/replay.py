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
A log and its simulation: the residual and the channels of causes, by sample and on an even grid.

The noise of a residual is treated in its cosine transform, where whitening is a division. Cosines
are exact eigenvectors of white noise and of a rate random walk with any start, and approximate
ones of a Gauss-Markov process. The coefficient of order 0 is the bias and is left out. The
rounding of an encoder is white noise of the heading; differentiation by cubic splines multiplies
its variance by ``(3 sin / (2 + cos))²``.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
import math

from gyro_calibration.calibration.run_faults import fit_profile, split_run
from gyro_calibration.calibration.spans import COURSE_TREATMENT, HEADING_TREATMENT, lag_deviation
from gyro_calibration.diagnosis.gates import (
    MIN_SAMPLES, MIN_VALID_SHARE, resample_reference, select_reference, spline_rate)
from gyro_calibration.heading.integration import integrate as integrate_trapezoidal
from gyro_calibration.logs.log import Array, DataRefused, Log, Mask
from gyro_calibration.logs.quality import find_runs, white_noise_deviation
from gyro_calibration.logs.stamps import fit_stamp_grid
from gyro_calibration.model.channels import channels_from_log
from gyro_calibration.model.effects import CATALOGUE, Channels
from gyro_calibration.model.gyro_model import GyroModel
from gyro_calibration.model.motion import motion_from_rates
from gyro_calibration.model.noise import MARKOV_FLOOR_RATIO, Noise
import numpy as np
from numpy.typing import NDArray
from scipy.fft import dct, idct, next_fast_len
from scipy.interpolate import make_interp_spline
from scipy.linalg import toeplitz
from scipy.ndimage import binary_opening, maximum_filter1d
from scipy.optimize import minimize
from scipy.signal import oaconvolve
from scipy.special import ndtri
from scipy.stats import chi2


@dataclass(frozen=True)
class NoiseShape:
    """A noise relative to its white part: variance of a coefficient over that of white noise."""

    walk_ratio: float = 0.0  # rate random walk, K² / N², 1/s²
    # variance of the Gauss-Markov part over the spectral density of the white one, 1/s
    markov_ratio: float = 0.0
    correlation_time: float = 1.0  # of the Gauss-Markov part, s
    # variance of the reference's rounding over the interval squared, relative to that of a white
    # sample
    rounding_ratio: float = 0.0
    # frequency where the spectral density of flicker, B² / (2 pi f), is the white one, Hz
    flicker_corner: float = 0.0

    def variance(self, angle: Array, interval: Array | float) -> Array:
        """Return the variance of coefficients, at pi k / n each, relative to the white part."""
        wave = 2.0 - 2.0 * np.cos(angle)
        total = 1.0 + self.rounding_ratio * spline_derivative_gain(angle)
        if self.walk_ratio:
            total = total + self.walk_ratio * interval ** 2 / wave
        if self.flicker_corner:
            total = total + self.flicker_corner * 2.0 * math.pi * interval / angle
        if self.markov_ratio:
            decay = np.exp(-interval / self.correlation_time)
            total = total + (self.markov_ratio * interval * (1.0 - decay ** 2)
                             / ((1.0 - decay) ** 2 + decay * wave))
        return total


def spline_derivative_gain(angle: Array) -> Array:
    """Return the variance of white noise after a quintic spline's derivative, interval 1."""
    return (5.0 * (10.0 * np.sin(angle) + np.sin(2.0 * angle))
            / (33.0 + 26.0 * np.cos(angle) + np.cos(2.0 * angle))) ** 2


def cosine_transform(values: Array) -> Array:
    """Return the cosine transform of a signal or of each row, no mean: shape (..., n - 1)."""
    return dct(values, norm='ortho', axis=-1)[..., 1:]


def inverse_cosine_transform(coefficients: Array) -> Array:
    """Return the signal of coefficients, with no mean: shape (n,)."""
    return idct(np.concatenate([[0.0], coefficients]), norm='ortho')


def coefficient_angles(count: int) -> Array:
    """Return pi k / n of the coefficients of a signal of so many samples: shape (n - 1,)."""
    return np.arange(1, count) * math.pi / count


def band_starts(count: int) -> NDArray[np.intp]:
    """Return the first index of each band of coefficients: the lowest 24 alone, then by ratio."""
    edges, ratio = list(range(min(24, count))), 1.12
    while edges and edges[-1] * ratio + 1.0 < count:
        edges.append(int(math.ceil(edges[-1] * ratio + 0.5)))
    return np.unique([edge for edge in edges if edge < count])


def noise_grid(interval: float, duration: float, rounding_ratio: float = 0.0) -> list[NoiseShape]:
    """
    Return a grid of noises that a residual may have.

    The random walk ranges from a small part of the white noise at the lowest frequency of the log
    to as much as the white noise at its highest; that of a walk alone is known the better, the
    more coefficients it dominates. Combinations with a Gauss-Markov process, which flicker may
    replace, are left out if one is small beside the other at all frequencies.
    """
    # a share of a variance that is small; and the largest logarithm of the ratio of neighbours
    small, lowest, step = 0.1, (math.pi / duration) ** 2, 0.9
    highest, alone = 1.0 / interval ** 2, [small * lowest]
    while alone[-1] < highest:
        sigma = math.sqrt(2.0 * math.pi / (duration * math.sqrt(alone[-1])))
        alone.append(alone[-1] * math.exp(min(3.0 * sigma, step)))
    walks = [0.0, *np.geomspace(alone[0], highest, 1 + math.ceil(
        math.log(highest / alone[0]) / step))]
    times = _correlation_times(interval, duration)
    # by their spectral density at frequency 0 relative to white noise
    strong = [(level, time) for time in times for level in np.geomspace(0.3, 1000.0, 7)]
    corners = np.geomspace(0.1 / duration, 0.3 / interval, 14)
    return [*(NoiseShape(walk, rounding_ratio=rounding_ratio) for walk in (0.0, *alone)),
            *(NoiseShape(walk, level / (2.0 * time), time, rounding_ratio)
              for walk in walks for level, time in strong
              if not walk or small * lowest < walk / level < 1.0 / (small * time ** 2)),
            *(NoiseShape(walk, rounding_ratio=rounding_ratio, flicker_corner=corner)
              for walk in walks[::4] for corner in corners)]


def _correlation_times(interval: float, duration: float) -> Array:
    return np.geomspace(max(4.0 * interval, duration / 2000.0), duration / 3.0, 7)


def stated_shapes(noise: Noise, density: float, interval: float, duration: float,
                  rounding_ratio: float = 0.0) -> list[NoiseShape]:
    """
    Return the slow noise of a model, relative to a density of the white noise, (rad/s)² s.

    Its bias instability is flicker, or a Gauss-Markov process with such a floor.
    """
    walk, squared = noise.rate_random_walk ** 2 / density, noise.bias_instability ** 2 / density
    plain = NoiseShape(walk, rounding_ratio=rounding_ratio)
    if not squared:
        return [plain]
    return [replace(plain, flicker_corner=squared / (2.0 * math.pi)),
            *(replace(plain, markov_ratio=MARKOV_FLOOR_RATIO ** 2 * squared, correlation_time=time)
              for time in _correlation_times(interval, duration))]


#: Least noise of a rounded output, in steps.
_LEAST_ROUNDED_NOISE = 1e-3
#: Samples in a block of `_without_noise`. The shorter, the less noise is left in a rest next to a
#: motion; the longer, the slower are the rates that are known.
_BLOCK_SAMPLES = 16
#: Samples next to a gap of at least as many whose rate is not used: the error at the end of a
#: spline is 0.43 times as large from sample to sample. Shorter gaps change the slope by little.
#: Delays and lags of a rate, which is on a line over the gap, are computed by splines too.
_GAP_MARGIN_SAMPLES = 6

#: Earliest and longest lag of a motion behind its command, s; ratio of neighbouring lags less 1.
LEAD, LONGEST_LAG, _LAG_RATIO = 0.1, 20.0, 0.05


@dataclass(frozen=True, eq=False)
class Replay:
    """One log prepared for the search: n samples, of which some are used."""

    # inputs of the effects; the rate is that of the reference, smoothed, the time is that since
    # the first sample
    channels: Channels
    reference: Array  # the rate that the output is compared with, rad/s, as measured
    valid: Mask  # mask of the samples that are used
    grid_index: NDArray[np.intp]  # index of each used sample on the even grid
    interval: float  # of the grid, s
    decimation: int  # number of grid points that are averaged into one
    fill_noise: Array  # white noise of variance 1 for missing grid points, shape (place[-1] + 1,)
    # quantization step of the heading whose derivative is the reference, rad; 0 without
    heading_step: float
    # largest likely standard deviation of the white noise of that heading, rad; 0 without
    heading_noise: float
    available_channels: frozenset[str]  # names of the channels of the log
    # error of the simulated output, rad/s, shape (n,), which is subtracted from `channels.output`
    simulated_error: Array
    output_step: float = 0.0  # quantization step of the output, rad/s; 0 if it does not matter
    # independent errors by quantization of the output, and that by a lag that is not found, shape
    # (m, n); commanded rate, shape (n,), and independent responses to it, shape (k, lags), if the
    # motion follows the command. Each is of one standard deviation of its prior, in units of the
    # noise; what they explain is taken out of the residual and all columns
    shared_errors: Array = field(default_factory=lambda: np.empty((0, 0)))
    error_scale: float = 0.0  # deviation of the noise of a point, rad/s
    rounding_variance: float = 0.0  # that of a sample by quantization that is noise, (rad/s)²
    command: Array | None = None
    responses: Array = field(default_factory=lambda: np.empty((0, 0)))
    response_noise: NoiseShape = NoiseShape()  # noise under which the response is fitted
    stated_noises: tuple[Noise, ...] = ()  # between which that of the model lies, if it states any

    @property
    def point_interval(self) -> float:
        """Return the interval of the points that are searched, s."""
        return self.interval * self.decimation

    @property
    def point_count(self) -> int:
        """Return the number of points: with a fast transform, a few at the end left out."""
        return _fast_transform_length((int(self.grid_index[-1]) + 1) // self.decimation)

    @property
    def duration(self) -> float:
        """Return the length of the log, s."""
        return self.point_count * self.point_interval

    @cached_property
    def delay(self) -> float:
        """Return the delay of the output behind the reference, s, by which they agree best."""
        return find_delay(self.channels.time, self.channels.output, self.channels.rate)

    def lagged(self, channel: str, time_constant: float) -> Array:
        """Return a channel through a first-order lag, shape (n,)."""
        assert self.channels.lagged is not None
        return np.asarray(self.channels.lagged(channel, time_constant))

    def resample(self, values: Array, fill_deviation: float = 0.0, least_reach: int = 1) -> Array:
        """Return samples on the even grid; interpolated ones get white noise, if any is given."""
        whole = _bridge_gaps(values[self.valid], self.grid_index, least_reach)
        if fill_deviation:
            whole = whole + fill_deviation * self.fill_noise * self._is_filled
        whole = whole[:self.point_count * self.decimation]
        return whole.reshape(-1, self.decimation).mean(axis=1)

    @property
    def _is_filled(self) -> Mask:
        """Return where the even grid has no sample, shape (place[-1] + 1,)."""
        return np.asarray(np.bincount(self.grid_index) == 0)

    @property
    def filled_points(self) -> Mask:
        """Return the points of which a sample is interpolated."""
        filled = self._is_filled[:self.point_count * self.decimation]
        return np.asarray(filled.reshape(-1, self.decimation).any(axis=1))

    @cached_property
    def _least_reach(self) -> int:
        """
        Return the least number of samples on each side of a gap whose mean bridges it.

        It is the one that predicts the samples best, less a line along the rate: in white noise a
        sixteenth of the log, which repeats its noise in 16 coefficients only; in a random walk
        fewer.
        """
        longest = len(self.grid_index) // 16
        rate, left = ((each - each.mean())[self.valid] for each in (
            self.channels.rate, self.channels.output - self.reference))
        left = left - rate * (rate @ left) / max(rate @ rate, np.finfo(float).tiny)
        total = np.concatenate([[0.0], np.cumsum(left)])
        inside = np.arange(longest, len(left) - longest)

        def error(reach: int) -> float:
            around = (total[inside] - total[inside - reach]
                      + total[inside + 1 + reach] - total[inside + 1])
            return float(np.mean((left[inside] - around / (2.0 * reach)) ** 2))

        reaches = [longest >> halvings for halvings in range(longest.bit_length())]
        return min(reaches, key=error, default=1)

    def transform_residual(self, values: Array) -> Array:
        """Return the cosine transform of a residual; interpolated points get white noise."""
        return self._without_response(cosine_transform(self.resample(
            values, white_noise_deviation(values[self.valid]), self._least_reach)))

    def transform_samples(self, values: Array) -> Array:
        """Return the cosine transform of samples on the even grid, shape (points - 1,)."""
        return self._without_response(self._transform(values))

    def _transform(self, values: Array) -> Array:
        return cosine_transform(self.resample(values, least_reach=self._least_reach))

    # the response to a command

    def delayed_commands(self, kernels: Array) -> Iterator[Array]:
        """Give the change of the commanded rate by each response of gain 1, rad/s, shape (n,)."""
        assert self.command is not None
        grid, command = self.held_command
        first = -_leading_lags(self.interval)
        last = first + kernels.shape[1] - 1
        padded = np.pad(command, (last, -first), mode='edge')
        for kernel in kernels:
            yield oaconvolve(padded, kernel, 'valid')[grid] - kernel.sum() * self.command

    @property
    def held_command(self) -> tuple[NDArray[np.intp], Array]:
        """Return the places of all samples on an even grid, and the command on the grid."""
        assert self.command is not None
        time = self.channels.time
        grid = np.rint((time - time[0]) / self.interval).astype(int)
        return grid, self.command[np.searchsorted(grid, np.arange(grid[-1] + 1), 'right') - 1]

    def response_variance(self) -> Array:
        """Return the variance of coefficients that weights the response, shape (points - 1,)."""
        return self.response_noise.variance(coefficient_angles(self.point_count),
                                            self.point_interval)

    @cached_property
    def _response_basis(self) -> tuple[Array, Array, Array, Array]:
        """
        Return responses to the command, and shared errors, with independent transforms.

        Their transforms, weighted by the noise and not, shape (k + m, points - 1), with products
        1; the sizes of those of this log in each, (k + m, k + m); and their variance by the prior
        over that by the noise.
        """
        columns = np.array([self._transform(each) for each in (
            *(self.delayed_commands(self.responses) if len(self.responses) else ()),
            *self.shared_errors)])
        weighted = columns / self.response_variance()
        ratios, vectors = np.linalg.eigh(weighted @ columns.T)
        ratios = np.maximum(ratios, np.finfo(float).eps * ratios[-1] + np.finfo(float).tiny)
        scaled = vectors.T / np.sqrt(ratios)[:, None]
        return scaled @ weighted, scaled @ columns, scaled, ratios

    def _without_response(self, transform: Array) -> Array:
        """Return a transform that has the same variance whether along responses or not."""
        if not len(self.responses) + len(self.shared_errors):
            return transform
        weighted, basis, _, ratios = self._response_basis
        return transform - (weighted @ transform) * (1.0 - (1.0 + ratios) ** -0.5) @ basis

    def response(self, values: Array) -> Array:
        """Return the likeliest response, and shared error, in samples, rad/s, (n,)."""
        if not len(self.responses) + len(self.shared_errors):
            return np.zeros(len(values))
        weighted, _, scaled, ratios = self._response_basis
        sizes = (weighted @ self._transform(values) * ratios / (1.0 + ratios)) @ scaled
        late, rounded = np.split(sizes, [len(self.responses)])
        total = rounded @ self.shared_errors if len(rounded) else np.zeros(len(values))
        return (total + next(self.delayed_commands((late @ self.responses)[None])) if len(late)
                else total)

    @property
    def shared_bias_variance(self) -> float:
        """Return the variance of the bias by the shared errors, (rad/s)²."""
        if not len(self.shared_errors):
            return 0.0
        _, _, scaled, ratios = self._response_basis
        means = scaled[:, len(self.responses):] @ self.shared_errors[:, self.valid].mean(axis=1)
        return self.error_scale ** 2 * float(means ** 2 @ (ratios / (1.0 + ratios)))

    def with_possible_lag(self, delay: float) -> Replay:
        """
        Return the log with the error that a lag has beside a delay, s, in its shared errors.

        It is a standard deviation of its prior, unless that is more than a scale factor error by
        its own prior, as in a fast sine.
        """
        time, distort = self.channels.time, CATALOGUE['time_offset'].distortion
        assert distort is not None
        late = distort(self.channels.rate, time, delay)
        bend = np.gradient(np.gradient(late, time), time)
        error = bend * min(lag_deviation(delay), HEADING_TREATMENT.prior[0] * float(
            np.std(late) / max(np.std(bend), np.finfo(float).tiny)))
        left = self.resample(self.channels.output - self.reference + self.channels.rate - late)
        scale = self.error_scale or max(white_noise_deviation(left), np.finfo(float).tiny)
        return replace(self, error_scale=scale, shared_errors=np.concatenate(
            [self.shared_errors.reshape(-1, len(time)), error[None] / scale]))

    def with_motion(self, added: Array) -> Replay:
        """Return the log with more motion, rad/s, shape (n,), in the reference and for effects."""
        return replace(self.with_rate(self.channels.rate + added),
                       reference=self.reference + added)

    def with_rate(self, rate: Array) -> Replay:
        """Return the log with another rate for the effects."""
        return replace(self, channels=replace(self.channels, rate=rate))


def _leading_lags(interval: float) -> int:
    """Return the number of lags before 0, where a reference is late by its stamps."""
    return round(LEAD / interval)


@cache
def response_kernels(interval: float) -> Array:
    """
    Return responses of gain 1 at growing lags, one a row: shape (k, lags), lags in samples.

    Together they are any response that is linear between lags, of which each is later by a
    sample or `_LAG_RATIO`, whichever is more: what is slow in a motion is smooth.
    """
    lags = [-_leading_lags(interval), 1 - _leading_lags(interval)]
    while lags[-1] * interval < LONGEST_LAG:
        lags.append(lags[-1] + max(round(_LAG_RATIO * lags[-1]), 1))
    hats = np.array([np.interp(np.arange(lags[0], lags[-1] + 1), lags, each)
                     for each in np.eye(len(lags))])
    return np.asarray(hats / hats.sum(axis=1, keepdims=True))


def kernel_lags(interval: float) -> Array:
    """Return the lags of `response_kernels`, s."""
    return interval * (np.arange(response_kernels(interval).shape[1]) - _leading_lags(interval))


def replay(log: Log, usable: Mask, generator: np.random.Generator,
           heading_step: float = 0.0, output_step: float = 0.0,
           model: GyroModel | None = None) -> Replay:
    """
    Prepare a log for the search: its usable samples, under the model of a simulation.

    Gaps are filled with noise of the generator. Steps are those of `DataQuality`; no
    model is an ideal gyro. Raises `DataRefused` if too few samples can be used.
    """
    assert log.time is not None and log.output is not None
    time = _even_time(log.time)
    prepared_log = resample_reference(replace(select_reference(log)[0], time=time))
    is_heading = prepared_log.reference_rate is None and prepared_log.reference_heading is not None
    # the reference rate for the comparison, and without gaps for delays and lags of effects
    if is_heading:
        assert prepared_log.reference_heading is not None
        reference, smooth = _heading_rates(time, prepared_log.reference_heading)
    else:
        reference = (np.zeros(len(time)) if prepared_log.reference_rate is None
                     else prepared_log.reference_rate)
        known = np.isfinite(reference)
        smooth = np.interp(time, time[known], reference[known])
        reference = np.where(_near_long_gaps(~known), np.nan, reference)
    kept = usable & np.isfinite(reference) & np.isfinite(log.output)
    if log.reference_rate is None:
        kept &= (~_find_corners(reference, log.output, kept,
                                heading_step / float(np.median(np.diff(time)))))
    count = int(np.count_nonzero(kept))
    if count < MIN_SAMPLES:
        raise DataRefused(f'{count} of {len(kept)} samples can be used, at least {MIN_SAMPLES} '
                          'are needed; the others are lost, repeated, outliers or near a limit: '
                          'turn more slowly, or repair the line, and record again')
    place, interval = grid_indices(time, kept)
    _refuse_gaps(log.time[kept], place)
    noise = 0.0
    if is_heading:
        noise = max(heading_step / math.sqrt(12.0), _largest_heading_noise(
            _residual_without_delay(time, log.output, smooth)[kept], place, interval))
        smooth = _without_noise(smooth, noise / interval)
    # of more than 50 000 points, neighbours are averaged
    every = max(1, math.ceil((place[-1] + 1) / 50_000))
    if model is not None and log.temperature is None:  # simulated at the reference temperature
        prepared_log = replace(prepared_log,
                               temperature=np.full(len(log), model.reference_temperature))
    # the heading for effects: that of the reference, or the integral of its rate
    heading = prepared_log.reference_heading
    if heading is None or not np.isfinite(heading).all():
        heading = integrate_trapezoidal(time, np.nan_to_num(smooth))
    rounding, scale = (_rounding_errors(log.output, smooth, kept, output_step) if output_step
                       else (np.empty((0, 0)), 0.0))
    rounding_noise = output_step ** 2 / 12.0 - float(np.sum((scale * rounding) ** 2)) / len(time)
    channels = replace(channels_from_log(prepared_log), rate=smooth, time=time, heading=heading,
                       output=log.output)
    has = frozenset(name for name, known in (
        ('temperature', log), ('specific_force', log), ('supply', log),
        ('reference_rate', prepared_log)) if getattr(known, name) is not None)
    filling = generator.standard_normal(place[-1] + 1)
    plain = Replay(channels, reference, kept, place, interval, every, filling,
                   heading_step if is_heading else 0.0, noise, has, np.zeros(len(time)),
                   output_step, rounding * math.sqrt(every), scale / math.sqrt(every),
                   max(rounding_noise, 0.0))
    if model is None:
        return plain
    # the error by the model is subtracted from the output, and effects use its distorted rate
    rate = model.distort('rate', smooth, time)
    added = model.output_from_channels(plain.channels.with_rate(rate, rate)) - rate
    return replace(plain, channels=plain.channels.with_rate(rate, plain.channels.output - added),
                   reference=reference + (rate - smooth), simulated_error=added,
                   stated_noises=_stated_noises(model))


def _stated_noises(model: GyroModel) -> tuple[Noise, ...]:
    """Return the noises at the bounds of a model's figures; none without slow noise in it."""
    noise, bounds = model.noise, model.noise_bounds
    flicker, walk = (sorted({getattr(noise, name), *bounds.get(name, ())})
                     for name in ('bias_instability', 'rate_random_walk'))
    if not (flicker[-1] or walk[-1]):
        return ()
    return tuple(replace(noise, bias_instability=one, rate_random_walk=other)
                 for one in flicker for other in walk)


def _refuse_gaps(time: Array, grid_index: NDArray[np.intp]) -> None:
    """Refuse a log of which most is missing, as after a jump of the clock."""
    points = int(grid_index[-1]) + 1
    if len(grid_index) >= MIN_VALID_SHARE * points:
        return
    gaps = np.diff(time)
    longest = int(np.argmax(gaps))
    raise DataRefused(f'{len(grid_index)} of {points} samples can be used, at least a tenth is '
                      f'needed; the longest gap, of {gaps[longest]:.6g} s, begins at '
                      f'{time[longest]:.3f} s: cut the log there, and give both parts, or give '
                      '--rate if the stamps are wrong')


def _even_time(time: Array) -> Array:
    """Return the time since the first sample, s; that of the even grid for stamps in bursts."""
    try:
        stamps = fit_stamp_grid(time)
        if stamps.has_bursts:
            return stamps.interval * np.concatenate([[0.0], np.cumsum(stamps.lost_after + 1.0)])
    except DataRefused:
        pass
    return time - time[0]


def _fit_rounded_output(output: Array, rate: Array, step: float, expected_at: Array) -> Array:
    """Return the output at other rates by the line along the rate whose codes are the nearest."""
    codes, code, count = np.unique(output, return_inverse=True, return_counts=True)
    offset = float(np.median(codes - step * np.rint(codes / step)))
    low, high = float(rate.min()), float(rate.max())
    limits = np.array([low, high])

    def error(ends: Array) -> float:
        expected = ends[0] + (rate - low) / max(high - low, np.finfo(float).tiny) * np.diff(ends)
        return float(np.sum((output - offset - step * np.rint((expected - offset) / step)) ** 2))

    # at steady rates, each code should count once
    start = min(_fit_output(output, rate, limits),
                _fit_output(codes, np.bincount(code, rate) / count, limits), key=error)
    found = minimize(error, start, method='Nelder-Mead', options={
        'initial_simplex': start + 0.5 * step * np.array([[0, 0], [1, 0], [0, 1]]),
        'xatol': _LEAST_ROUNDED_NOISE * step, 'fatol': 0.0})
    return _fit_output(found.x, limits, expected_at)


def _fit_output(output: Array, rate: Array, expected_at: Array) -> Array:
    """Return the output at other rates by the line along the rate that fits best, rad/s."""
    scale, bias = (np.polyfit(rate, output, 1) if np.ptp(rate) > 0.0
                   else (1.0, float(output.mean())))
    return scale * expected_at + bias


def _rounding_errors(output: Array, rate: Array, valid: Mask, step: float) -> tuple[Array, float]:
    """
    Return independent rounding errors of the output, in units of its noise, (m, n); the noise.

    Where the steps are not small compared with the noise, the error depends on the rate, and would
    pass for structure along the rate. They are the terms of the Fourier series of a sawtooth,
    smoothed by the noise before the rounding (Widrow, Kollar and Liu 1996), of any phase: where
    the output lies within its step is not known.
    """
    expected = _fit_rounded_output(output[valid], rate[valid], step, rate)
    noise = max(white_noise_deviation((output - expected)[valid]), _LEAST_ROUNDED_NOISE * step)
    order = 2.0 * math.pi / step * np.arange(1, 33)[:, None]
    size = 2.0 / order * np.exp(-0.5 * order ** 2 * max(noise ** 2 - step ** 2 / 12.0, 0.0))
    size = size[size[:, 0] > 0.01 * noise] / math.sqrt(2.0)
    angle = order[:len(size)] * expected
    return np.concatenate([size * np.cos(angle), size * np.sin(angle)]) / noise, noise


@cache
def _fast_transform_length(count: int) -> int:
    """Return the largest number up to a count whose only prime factors are 2, 3 and 5."""
    while next_fast_len(count, real=True) != count:
        count -= 1
    return count


def _bridge_gaps(samples: Array, grid_index: NDArray[np.intp], least_reach: int) -> Array:
    """Return samples on the whole grid, with lines over gaps between means, as long or longer."""
    if len(samples) == grid_index[-1] + 1:
        return samples
    steps = np.diff(grid_index)
    before = np.flatnonzero(steps > 1)
    whole = np.empty(grid_index[-1] + 1)
    whole[grid_index] = samples
    length = steps[before] - 1
    total = np.concatenate([[0.0], np.cumsum(samples)])
    reach, after = np.maximum(length, least_reach), before + 1
    first, last = np.maximum(after - reach, 0), np.minimum(after + reach, len(samples))
    # near an end of the log also samples of the other side
    left, right = ((total[end] - total[begin]) / (end - begin) for begin, end in (
        (first, np.minimum(np.maximum(after, first + least_reach), len(samples))),
        (np.maximum(np.minimum(after, last - least_reach), 0), last)))
    number = np.arange(length.sum()) - np.repeat(np.cumsum(length) - length, length)
    share = (number + 1.0) / np.repeat(length + 1, length)
    whole[np.repeat(grid_index[before], length) + 1 + number] = (
        np.repeat(left, length) * (1.0 - share) + np.repeat(right, length) * share)
    return whole


def grid_indices(time: Array, valid: Mask) -> tuple[NDArray[np.intp], float]:
    """Return the numbers of the kept samples on an even grid, and its interval, s."""
    interval = float(np.median(np.diff(time)))
    steps = np.maximum(np.rint(np.diff(time) / interval), 1.0)
    place = np.concatenate([[0.0], np.cumsum(steps)]).astype(int)[valid]
    return place - place[0], float((time[valid][-1] - time[valid][0]) / (place[-1] - place[0]))


def _heading_rates(time: Array, heading: Array) -> tuple[Array, Array]:
    """Return the rate of a heading by splines, nan where it is lost; and without gaps."""
    lost = ~np.isfinite(heading)
    rate = spline_rate(time, heading)
    long = binary_opening(lost, np.ones(_GAP_MARGIN_SAMPLES))
    for part in find_runs(~long):  # a line over a gap bends the spline beside it
        at = time[part][~lost[part]]
        if len(at) > 2 * _GAP_MARGIN_SAMPLES:
            spline = make_interp_spline(at, heading[part][~lost[part]], 5)
            rate[part] = spline(time[part], 1)
    # a spline errs at the ends of a log as it does at a gap
    ends = np.pad(lost, _GAP_MARGIN_SAMPLES, constant_values=True)
    near = maximum_filter1d(lost, 3) | _near_long_gaps(ends)[
        _GAP_MARGIN_SAMPLES:-_GAP_MARGIN_SAMPLES]
    return np.where(near, np.nan, rate), rate


def _near_long_gaps(lost: Mask) -> Mask:
    """Return which samples are in or next to a gap of at least `_GAP_MARGIN_SAMPLES`."""
    return np.asarray(maximum_filter1d(binary_opening(lost, np.ones(_GAP_MARGIN_SAMPLES)),
                                       2 * _GAP_MARGIN_SAMPLES + 1))


def find_delay(time: Array, output: Array, rate: Array) -> float:
    """Return the delay of the output behind a rate by which they agree best, to 0.05 s."""
    known = np.isfinite(output)
    return fit_profile(split_run(time[known], output[known]), motion_from_rates(time, rate),
                       COURSE_TREATMENT.largest_delay)[2]


def _residual_without_delay(time: Array, output: Array, rate: Array) -> Array:
    """Return what the rate at the best delay leaves of the output, rad/s."""
    known, delay, left = np.isfinite(output), find_delay(time, output, rate), output
    for _ in range(3):  # the slope, in which noise has no part, shows what the delay lacks
        late = np.interp(time - delay, time, rate)
        columns = np.column_stack([np.ones(len(time)), late, np.gradient(late, time)])
        values = np.linalg.lstsq(columns[known], output[known], rcond=None)[0]
        delay -= float(values[2] / values[1]) if values[1] else 0.0
        left = output - columns @ values
    return left


def _largest_heading_noise(residual: Array, grid_index: NDArray[np.intp],
                           interval: float) -> float:
    """
    Return the largest likely standard deviation of the white noise of a heading, rad.

    It is the upper limit of an interval of 95 % by the likelihood of a residual of its rate,
    rad/s, with white noise and a random walk of the output.
    """
    energy = cosine_transform(_bridge_gaps(residual, grid_index, 1)) ** 2
    angle, starts = coefficient_angles(len(energy) + 1), band_starts(len(energy))
    count = np.diff(np.append(starts, len(energy)))
    energy, walk, heading = (np.add.reduceat(each, starts) / count for each in (
        energy, NoiseShape(1.0).variance(angle, 1.0) - 1.0, spline_derivative_gain(angle)))
    ratios, walks = np.append(0.0, np.geomspace(1e-4, 1e4, 100)), np.geomspace(1e-10, 1.0, 21)
    variance = 1.0 + ratios[:, None, None] * heading + walks[:, None] * walk
    white = energy / variance @ count / len(angle)
    cost = len(angle) * np.log(white) + np.log(variance) @ count
    likely = ratios * np.take_along_axis(white, cost.argmin(1)[:, None], 1)[:, 0]
    return interval * math.sqrt(likely[cost.min(1) < cost.min() + chi2.isf(0.05, 1)].max())


def _without_noise(rate: Array, noise: float) -> Array:
    """
    Return the rate of a heading without white noise, where the motion does not exceed it.

    The noise is that of the heading over the interval, rad/s. In blocks, the coefficients of
    orthogonal polynomials that it reaches are 0 (Donoho and Johnstone 1994), in a mean over the
    places of the blocks. Fast motion remains, and in rests no noise is left, which would pass for
    a motion that the gyro does not show.
    """
    size, count = _BLOCK_SAMPLES, len(rate)
    gain = spline_derivative_gain(np.arange(8 * size) * math.pi / (8 * size - 1))
    # a smooth motion has few of these coefficients, and many of cosines
    basis = np.linalg.qr(np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, size),
                                                          size - 1))[0].T
    variance = np.diag(basis @ toeplitz(idct(gain, type=1)[:size]) @ basis.T)
    largest = noise * np.sqrt(2.0 * math.log(count) * variance)
    total = np.zeros(count)
    for shift in range(0, size, size // 4):
        padded = np.pad(rate, (shift, -(count + shift) % size), mode='edge')
        blocks = padded.reshape(-1, size) @ basis.T
        blocks[np.abs(blocks) < largest] = 0.0
        total += (blocks @ basis).ravel()[shift:shift + count]
    return total / 4.0


def _find_corners(rate: Array, output: Array, valid: Mask, rounding: float) -> Mask:
    """
    Return where the rate of a heading has corners that its samples do not resolve, shape (n,).

    At a corner, a spline through the heading and the trapezoidal integral of the output differ by
    a 72nd of the sixth difference, which passes for a dead zone or a slip. That of a noisy
    reference, or of a motion that jitters, is everywhere, and a corner exceeds it.
    """
    bend = np.abs(np.diff(np.pad(rate, 3, mode='edge'), 6)) / 72.0
    white = white_noise_deviation((output - rate)[valid])
    usual = white_noise_deviation(rate, 6) * math.sqrt(math.comb(12, 6)) / 72.0
    # a thousand bends of a tenth of the white noise and one sign are 3 sigma; and as many bends by
    # noise or jitter are to pass for a corner
    sharp = maximum_filter1d(bend > max(0.1 * white + rounding, -float(ndtri(5e-4)) * usual),
                             2 * _GAP_MARGIN_SAMPLES + 1)
    rounded = rounding > math.sqrt(6.0) * white  # most of what looks white is of the steps
    return np.zeros_like(sharp) if rounded else sharp
