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

from dataclasses import dataclass, field, replace
from functools import cache
import math

from gyro_calibration.diagnosis.expected_output import integral_of
from gyro_calibration.diagnosis.gates import evened, FEWEST, prepared
from gyro_calibration.logs.log import Array, DataRefused, Log, Mask
from gyro_calibration.logs.quality import white_noise
from gyro_calibration.logs.stamps import number_stamps
from gyro_calibration.model.channels import channels_of
from gyro_calibration.model.effects import Channels
from gyro_calibration.model.gyro_model import GyroModel
import numpy as np
from numpy.typing import NDArray
from scipy.fft import dct, idct, next_fast_len
from scipy.interpolate import CubicSpline
from scipy.ndimage import binary_opening, maximum_filter1d, uniform_filter1d

#: Largest number of parts of the frequency range in which filtered noise has separate levels;
#: least number of coefficients in each; and lowest level, which limits the weight of a part that
#: is nearly free of noise.
_PARTS, _LEAST, _LOWEST = 32, 100, 0.003
#: Standard deviations by which the level of filtered noise falls; the standard deviation of the
#: logarithm of a median of n is 2.33 over root n.
_SURE, _SCATTER = 4.5, 2.33
#: Numbers of random walks, of strengths and times of Gauss-Markov processes, and of corner
#: frequencies of flicker in `noise_grid`.
_WALKS, _STRENGTHS, _TIMES, _CORNERS = 14, 7, 7, 14


@dataclass(frozen=True)
class Shape:
    """
    A noise relative to its white part: variance of a coefficient over that of white noise.

    Attributes
    ----------
    walk : rate random walk, K² / N², 1/s²
    strength : variance of the Gauss-Markov part over the spectral density of the white one, 1/s
    correlation_time : of the Gauss-Markov part, s
    reference : variance of the reference's rounding over the interval squared, relative to that of
        a white sample
    flicker : frequency where the spectral density of flicker, B² / (2 pi f), is the white one, Hz

    """

    walk: float = 0.0
    strength: float = 0.0
    correlation_time: float = 1.0
    reference: float = 0.0
    flicker: float = 0.0

    def variance(self, angle: Array, interval: Array | float) -> Array:
        """
        Return the variance of coefficients relative to the white part.

        Parameters
        ----------
        angle : pi k / n of each coefficient
        interval : of the samples, s

        """
        wave = 2.0 - 2.0 * np.cos(angle)
        total = 1.0 + self.reference * differentiated(angle)
        if self.walk:
            total = total + self.walk * interval ** 2 / wave
        if self.flicker:
            total = total + self.flicker * 2.0 * math.pi * interval / angle
        if self.strength:
            kept = np.exp(-interval / self.correlation_time)
            total = total + (self.strength * interval * (1.0 - kept ** 2)
                             / ((1.0 - kept) ** 2 + kept * wave))
        return total


def differentiated(angle: Array) -> Array:
    """Return the variance of white noise after a cubic spline's derivative, interval 1."""
    return (3.0 * np.sin(angle) / (2.0 + np.cos(angle))) ** 2


def transform(values: Array) -> Array:
    """Return the cosine transform of a signal or of each row, no mean: shape (..., n - 1)."""
    return dct(values, norm='ortho', axis=-1)[..., 1:]


def inverse(coefficients: Array) -> Array:
    """Return the signal of coefficients, with no mean: shape (n,)."""
    return idct(np.concatenate([[0.0], coefficients]), norm='ortho')


def angles(count: int) -> Array:
    """Return pi k / n of the coefficients of a signal of so many samples: shape (n - 1,)."""
    return np.arange(1, count) * math.pi / count


def levels(whitened: Array) -> Array:
    """
    Return the power in equal parts of the angle relative to the second part: shape (parts,).

    The first part is set to 1, because slow noise is described by `Shape`. With too few
    coefficients there is one part.

    """
    parts = np.array_split(whitened ** 2, max(min(_PARTS, len(whitened) // _LEAST), 1))
    found = np.array([part.mean() for part in parts])
    return (np.maximum(np.concatenate([found[1:2], found[1:]]) / found[1], _LOWEST)
            if len(found) > 1 else np.ones(1))


def fall(whitened: Array) -> float:
    """Return the power in the last quarter of the angle over the second; 1 if insignificant."""
    _, second, _, last = (float(np.median(part ** 2)) for part in np.array_split(whitened, 4))
    by_chance = math.exp(-_SURE * _SCATTER * math.sqrt(8.0 / len(whitened)))
    return last / second if last < by_chance * second else 1.0


def level(angle: Array, found: Array) -> Array:
    """Return the level at each angle, by lines in the logarithm between middles of parts."""
    return np.exp(np.interp(angle, (np.arange(len(found)) + 0.5) * math.pi / len(found),
                            np.log(found)))


def bands(angle: Array, interval: float, single: int = 24, ratio: float = 1.12) -> Array:
    """Return the first index of each band of coefficients: the lowest alone, then by ratio."""
    edges, count = list(range(min(single, len(angle)))), len(angle)
    while edges and edges[-1] * ratio + 1.0 < count:
        edges.append(int(math.ceil(edges[-1] * ratio + 0.5)))
    return np.unique([edge for edge in edges if edge < count])


def noise_grid(interval: float, duration: float, reference: float = 0.0) -> list[Shape]:
    """
    Return a grid of noises that a residual may have.

    A random walk shows if it is stronger than white noise over the duration of the log; a
    Gauss-Markov process if its correlation time is between some samples and this duration. Flicker
    replaces the Gauss-Markov process.

    """
    lowest = 0.02 / duration ** 2
    highest = max(1e5 * lowest, 1e-3 / interval ** 2 * 1e-3)
    walks = [0.0, *np.geomspace(lowest, highest, _WALKS)]
    times = np.geomspace(max(4.0 * interval, duration / 2000.0), duration / 3.0, _TIMES)
    # By their spectral density at frequency 0 relative to white noise.
    strong = [(ratio / (2.0 * time), time) for time in times
              for ratio in np.geomspace(0.3, 1000.0, _STRENGTHS)]
    plain = [Shape(walk, strength, time, reference) for walk in walks
             for strength, time in [(0.0, 1.0), *strong]]
    corners = np.geomspace(0.1 / duration, 0.3 / interval, _CORNERS)
    return plain + [Shape(walk, reference=reference, flicker=corner) for walk in walks[::4]
                    for corner in corners]


#: Largest number of points of the grid; with more, neighbours are averaged.
MOST_POINTS = 50_000
#: Ratio of the power in the last to that in the second quarter of the frequencies, below which a
#: record was smoothed (jumps have 0.18, noise not less). Longest averaging interval for it, s.
SMOOTHED, _LONGEST = 0.05, 0.03
#: Frequencies over which the power of a rate is averaged, and margin of the power of rounding.
_NEIGHBOURS, _OVER = 101, 1.5
#: Update intervals of a held reference, and steps of its change, from which on a constant value is
#: a standstill.
_STOOD = 1.5
#: Samples next to a gap of at least as many whose rate is not used: the error of a spline is 0.13,
#: 0.036 and 0.01 of the change of slope over the gap, which is small for shorter gaps.
_BESIDE = 4
#: Least bend of the rate at a corner as a share of the white noise: a thousand of them with one
#: sign are 3 sigma. Largest share of corners.
_BENT, _FEW_CORNERS = 0.1, 0.2
#: Largest number of grid points per sample, and number of points up to which it is not limited:
#: most of a log must not be interpolated.
_EACH, _SHORT = 5, 10_000


@dataclass(frozen=True)
class Replay:
    """
    One log prepared for the search: n samples, of which some are used.

    Attributes
    ----------
    channels : inputs of the effects; the rate is that of the reference, smoothed, the time is that
        since the first sample
    reference : the rate that the output is compared with, rad/s, as measured
    kept : mask of the samples that are used
    place : index of each used sample on the even grid
    interval : of the grid, s
    every : number of grid points that are averaged into one
    filling : white noise of variance 1 for missing grid points, shape (place[-1] + 1,)
    rounded : quantization step of the heading whose derivative is the reference, rad; 0 without
    has : names of the channels of the log
    added : error of the simulated output, rad/s, shape (n,), which is subtracted from
        `channels.output`
    coarse : variance of a sample by quantization of the output, (rad/s)²
    levels : of filtered white noise: see `levels`

    """

    channels: Channels
    reference: Array
    kept: Mask
    place: NDArray[np.intp]
    interval: float
    every: int
    filling: Array
    rounded: float
    has: frozenset[str]
    added: Array
    coarse: float = 0.0
    levels: Array = field(default_factory=lambda: np.ones(1))

    @property
    def step(self) -> float:
        """Return the interval of the points that are searched, s."""
        return self.interval * self.every

    @property
    def points(self) -> int:
        """Return the number of points: with a fast transform, a few at the end left out."""
        return _fast((int(self.place[-1]) + 1) // self.every)

    @property
    def duration(self) -> float:
        """Return the length of the log, s."""
        return self.points * self.step

    def lagged(self, channel: str, time_constant: float) -> Array:
        """Return a channel through a first-order lag, shape (n,)."""
        assert self.channels.lagged is not None
        return np.asarray(self.channels.lagged(channel, time_constant))

    def on_grid(self, values: Array, filling: float = 0.0) -> Array:
        """
        Return samples, shape (n,), on the even grid: gaps interpolated, neighbours averaged.

        Interpolated points have no noise. If that matters, white noise of a standard deviation is
        added to them.

        """
        whole = _bridged(values[self.kept], self.place)
        if filling and len(whole) > len(self.place):
            lost = np.ones(len(whole), dtype=bool)
            lost[self.place] = False
            whole[lost] += filling * self.filling[lost]
        return self._averaged(whole)

    def _averaged(self, whole: Array) -> Array:
        whole = whole[:self.points * self.every]
        return whole.reshape(-1, self.every).mean(axis=1) if self.every > 1 else whole

    def _rounding(self) -> Array:
        """Return the rounding error of the reference, rad/s, also where no output is used."""
        rows = np.flatnonzero(self.kept)
        rows = np.arange(rows[0], rows[-1] + 1)
        at = np.interp(rows, np.flatnonzero(self.kept), self.place)
        added = (self.reference - self.channels.rate)[rows]
        known = np.isfinite(added) & (at == np.rint(at))
        whole = np.zeros(int(self.place[-1]) + 1)
        whole[at[known].astype(int)] = added[known]
        return self._averaged(whole)

    def noisy(self, values: Array) -> Array:
        """
        Return the cosine transform of a residual; interpolated points get white noise.

        The error of a rounded heading is bounded, but its interpolation over a gap would not be.
        So it is taken from the reference, which has no gap there.

        """
        if not self.rounded:
            return transform(self.on_grid(values, white_noise(values[self.kept])))
        smooth = values + (self.reference - self.channels.rate)
        return transform(self.on_grid(smooth, white_noise(smooth[self.kept])) - self._rounding())

    def coefficients(self, values: Array) -> Array:
        """Return the cosine transform of samples on the even grid, shape (points - 1,)."""
        return transform(self.on_grid(values))

    def level(self) -> Array:
        """Return the level of the white noise at each coefficient, shape (points - 1,)."""
        return level(angles(self.points), self.levels)

    def filtered(self, more: Array) -> Replay:
        """Return the log with its levels multiplied by factors, as its noise for gaps."""
        whole = transform(self.filling) * np.sqrt(
            level(angles(len(self.filling)) * self.every, more))
        filling = inverse(whole)
        return replace(self, levels=self.levels * more, filling=filling / white_noise(filling))

    def with_rate(self, rate: Array) -> Replay:
        """Return the log with another rate for the effects."""
        return replace(self, channels=replace(self.channels, rate=rate))


def replay(log: Log, trusted: Mask, generator: np.random.Generator, update: float | None = None,
           step: float = 0.0, codes: float = 0.0, model: GyroModel | None = None) -> Replay:
    """
    Prepare a log for the search.

    Parameters
    ----------
    log : with output, time and a reference, which is not needed at rest
    trusted : samples to use, shape (n,)
    generator : source of the noise for gaps
    update : update interval of a reference that is held in between, s
    step : of a reference heading, rad; 0 without one
    codes : quantization step of the output, rad/s; 0 if it does not matter
    model : of the simulation; None is an ideal gyro

    """
    assert log.time is not None and log.output is not None
    time = _even(log.time)
    shown = evened(replace(prepared(log)[0], time=time))
    reference, smooth = _reference(shown, time, update is not None, step)
    kept = trusted & np.isfinite(reference) & np.isfinite(log.output)
    if log.reference_rate is None:
        kept &= ~_corners(reference, log.output, kept, step / float(np.median(np.diff(time))))
    count = int(np.count_nonzero(kept))
    if count < FEWEST:
        raise DataRefused(f'{count} of {len(kept)} samples can be used, at least {FEWEST} are '
                          'needed; the others are lost, repeated, outliers or near a limit: turn '
                          'more slowly, or repair the line, and record again')
    place, interval = numbered(time, kept)
    _refuse_gaps(log.time[kept], place)
    every = max(1, math.ceil((place[-1] + 1) / MOST_POINTS))
    if model is not None and log.temperature is None:  # simulated at the reference temperature
        shown = replace(shown, temperature=np.full(len(log), model.reference_temperature))
    # the heading for effects: that of the reference, or the integral of its rate
    heading = shown.reference_heading
    if heading is None or not np.isfinite(heading).all():
        heading = integral_of(time, np.nan_to_num(smooth))
    channels = replace(channels_of(shown), rate=smooth, time=time, heading=heading)
    has = frozenset(name for name in ('temperature', 'specific_force', 'supply')
                    if getattr(log, name) is not None)
    rounded = step if shown.reference_rate is None else 0.0
    filling = generator.standard_normal(place[-1] + 1)
    foreseen = _rounding(log.output, smooth, kept, codes) if codes else np.zeros(len(time))
    coarse = max(codes ** 2 / 12.0 - float(np.var(foreseen[kept])), 0.0)
    plain = Replay(replace(channels, output=log.output - foreseen), reference, kept, place,
                   interval, every, filling, rounded, has, np.zeros(len(time)), coarse)
    plain = replace(plain, every=every * _smoothed(plain))
    if model is None:
        return plain
    # the error by the model is subtracted from the output, and effects use its distorted rate
    rate = model.distorted('rate', smooth, time)
    added = model.output_in(plain.channels.moving(rate, rate)) - rate
    return replace(plain, channels=plain.channels.moving(rate, plain.channels.output - added),
                   reference=reference + (rate - smooth), added=added)


def _refuse_gaps(time: Array, place: NDArray[np.intp]) -> None:
    """Refuse a log of which most is missing, as after a jump of the clock."""
    points = int(place[-1]) + 1
    if points <= max(_EACH * len(place), _SHORT):
        return
    gaps = np.diff(time)
    longest = int(np.argmax(gaps))
    raise DataRefused(f'{len(place)} of {points} samples can be used, at least a fifth is needed; '
                      f'the longest gap, of {gaps[longest]:.6g} s, begins at '
                      f'{time[longest]:.3f} s: cut the log there, and give both parts, or give '
                      '--rate if the stamps are wrong')


def _even(time: Array) -> Array:
    """Return the time since the first sample, s; that of the even grid for stamps in bursts."""
    try:
        stamps = number_stamps(time)
    except DataRefused:
        return time - time[0]
    if not stamps.bursts:
        return time - time[0]
    return stamps.interval * np.concatenate([[0.0], np.cumsum(stamps.lost + 1.0)])


def _smoothed(plain: Replay) -> int:
    """
    Return the additional number of points to average, so that smoothing does not show.

    A gyro with averaged samples, or a smoothed reference, has hardly any noise at the highest
    frequencies. The noises of the grid do not describe that, so that small errors of motion and
    reference would have too much weight there.

    """
    rest, more, found = plain.channels.output - plain.reference, 1, 1
    while 2 * more * plain.step <= _LONGEST:
        power = replace(plain, every=plain.every * more).coefficients(rest) ** 2
        _, second, _, last = (float(np.median(part)) for part in np.array_split(power, 4))
        more *= 2
        if last < SMOOTHED * second:
            found = more
    return found


def _rounding(output: Array, rate: Array, kept: Mask, step: float) -> Array:
    """
    Return the mean rounding error of the output, rad/s, shape (n,).

    If the steps are not small compared with the noise, it depends on the rate, and would pass for
    a nonlinearity. It is the Fourier series of a sawtooth, smoothed by the noise before the
    rounding (Widrow, Kollar and Liu 1996).

    """
    scale, bias = (np.polyfit(rate[kept], output[kept], 1) if np.ptp(rate[kept]) > 0.0
                   else (1.0, float(output[kept].mean())))
    expected = scale * rate + bias
    variance = max(float(np.var((output - expected)[kept])) - step ** 2 / 12.0, 0.0)
    wave = 2.0 * math.pi / step
    total = np.zeros(len(output))
    for order in wave * np.arange(1.0, 8.0):
        sign = -1.0 if round(order / wave) % 2 else 1.0
        total += (sign * 2.0 / order * math.exp(-0.5 * order ** 2 * variance)
                  * np.sin(order * expected))
    return total


def _reference(log: Log, time: Array, held: bool, step: float) -> tuple[Array, Array]:
    """Return the reference rate for the comparison, and the smoothed one for effects."""
    if log.reference_rate is not None:
        rate = _between_updates(time, log.reference_rate, step) if held else log.reference_rate
        return rate, _filled(time, rate)
    if log.reference_heading is not None:
        heading = (_between_updates(time, log.reference_heading, step) if held
                   else log.reference_heading)
        return _rates(time, heading, step)
    return np.zeros(len(time)), np.zeros(len(time))


def _filled(time: Array, values: Array) -> Array:
    """Return values with interpolated gaps, which delays and lags of effects need."""
    known = np.isfinite(values)
    return np.interp(time, time[known], values[known])


@cache
def _fast(count: int) -> int:
    """Return the largest number up to a count whose only prime factors are 2, 3 and 5."""
    while next_fast_len(count, real=True) != count:
        count -= 1
    return count


def _bridged(known: Array, place: NDArray[np.intp]) -> Array:
    """
    Return samples on the whole grid, with straight lines over gaps.

    A line begins and ends in the mean of as many samples as the gap has, which reduces their
    noise.

    """
    if len(known) == place[-1] + 1:
        return known
    steps = np.diff(place)
    before = np.flatnonzero(steps > 1)
    whole = np.empty(place[-1] + 1)
    whole[place] = known
    length = steps[before] - 1
    total = np.concatenate([[0.0], np.cumsum(known)])
    first, last = np.maximum(before + 1 - length, 0), np.minimum(before + 1 + length, len(known))
    left, right = ((total[end] - total[begin]) / (end - begin)
                   for begin, end in ((first, before + 1), (before + 1, last)))
    number = np.arange(length.sum()) - np.repeat(np.cumsum(length) - length, length)
    share = (number + 1.0) / np.repeat(length + 1, length)
    whole[np.repeat(place[before], length) + 1 + number] = (
        np.repeat(left, length) * (1.0 - share) + np.repeat(right, length) * share)
    return whole


def numbered(time: Array, kept: Mask) -> tuple[NDArray[np.intp], float]:
    """Return the numbers of the kept samples on an even grid, and its interval, s."""
    interval = float(np.median(np.diff(time)))
    steps = np.maximum(np.rint(np.diff(time) / interval), 1.0)
    place = np.concatenate([[0.0], np.cumsum(steps)]).astype(int)[kept]
    return place - place[0], float((time[kept][-1] - time[kept][0]) / (place[-1] - place[0]))


def _between_updates(time: Array, values: Array, step: float) -> Array:
    """
    Interpolate a held reference between updates, as a held value is half an interval late.

    An update with the same value does not show. So a value that is constant for longer is held
    until one update interval before the next change.

    """
    known = np.isfinite(values)
    renewed = np.flatnonzero((np.diff(values, prepend=np.nan) != 0.0) & known)
    when, what = time[renewed], values[renewed]
    usual = float(np.median(np.diff(when)))
    stood = 1 + np.flatnonzero((np.diff(when) > _STOOD * usual)
                               & (np.abs(np.diff(what)) > _STOOD * step))
    when, what = (np.insert(when, stood, when[stood] - usual),
                  np.insert(what, stood, what[stood - 1]))
    return np.where(known, np.interp(time, when, what), np.nan)


def _rates(time: Array, heading: Array, step: float) -> tuple[Array, Array]:
    """Return the rate of a heading by splines, nan where lost; and a smooth one without steps."""
    lost = ~np.isfinite(heading)
    rate = CubicSpline(time, _filled(time, heading))(time, 1)
    near = (maximum_filter1d(lost, 3)
            | maximum_filter1d(binary_opening(lost, np.ones(_BESIDE)), 2 * _BESIDE + 1))
    raw = np.where(near, np.nan, rate)
    return raw, _without_rounding(rate, step, float(np.median(np.diff(time)))) if step else rate


def _corners(rate: Array, output: Array, kept: Mask, rounding: float) -> Mask:
    """
    Return where the rate of a heading has corners that its samples do not resolve, shape (n,).

    At a corner of the rate, a spline through the heading and the trapezoidal integral of the
    output differ by a twelfth of the second difference, which is a 24th of the fourth; at the
    begin or end of a motion that passes for a dead zone or a slip. The fourth difference of a
    smooth motion, which splines follow, is small at any acceleration. A reference with bends
    everywhere is noisy, and none are excluded; quantization of a heading alone has no fourth
    difference of 24 times `rounding`, step over interval.

    """
    bend = np.abs(np.diff(np.pad(rate, 2, mode='edge'), 4)) / 24.0
    white = white_noise((output - rate)[kept])
    sharp = maximum_filter1d(bend > _BENT * white + rounding, 5)
    rounded = rounding ** 2 / 12.0 > 0.5 * white ** 2  # most of what looks white is of the steps
    return np.zeros_like(sharp) if rounded or sharp[kept].mean() > _FEW_CORNERS else sharp


def _without_rounding(rate: Array, step: float, interval: float) -> Array:
    """
    Return the rate of a heading with its rounding error removed by a Wiener filter.

    Each frequency is weighted by the share of its power above that of the rounding, so that fast
    motion remains.

    """
    coefficients = dct(rate, norm='ortho')
    rounding = ((step / interval) ** 2 / 12.0
                * differentiated(np.arange(len(rate)) * math.pi / len(rate)))
    power = uniform_filter1d(coefficients ** 2, _NEIGHBOURS, mode='nearest')
    return idct(coefficients * np.clip(1.0 - _OVER * rounding / np.maximum(power, 1e-300),
                                       0.0, 1.0), norm='ortho')
