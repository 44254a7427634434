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
A log and its simulation: the residual and what the causes look at, by sample and on a grid.

The noise of a residual is treated in its cosine transform, where whitening is a division. White
noise and a random walk of the rate with any start have cosines as their exact eigenvectors; those
of a Gauss-Markov process are nearly so. The coefficient of order 0 is the bias and is left out.
The rounding of an encoder is white noise of the heading; its rate by cubic splines is that times
``(3 sin / (2 + cos))²``.

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

#: Parts of the angle in which the noise of a filtered output has levels of its own, at most; the
#: least number of coefficients in each; and the lowest level, for what is nearly free of noise
#: would count for more than it is worth.
_PARTS, _LEAST, _LOWEST = 32, 100, 0.003
#: By how many of its standard deviations the level must fall for a filter: that of the logarithm
#: of a median of n is 2.33 over root n.
_SURE, _SCATTER = 4.5, 2.33
#: Numbers of random walks, of strengths and times of Gauss-Markov processes, and of corners of
#: flicker that are tried: see `noise_grid`.
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
    """Return the gain in variance of white noise by a cubic spline's derivative, interval 1."""
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
    Return the power in equal parts of the angle over that in the second part: shape (parts,).

    The first part is as the second: what is slow is for `Shape` to say. Too few coefficients have
    one part.

    """
    parts = np.array_split(whitened ** 2, max(min(_PARTS, len(whitened) // _LEAST), 1))
    found = np.array([part.mean() for part in parts])
    return (np.maximum(np.concatenate([found[1:2], found[1:]]) / found[1], _LOWEST)
            if len(found) > 1 else np.ones(1))


def fall(whitened: Array) -> float:
    """Return the power in the last quarter of the angle over the second; 1 if maybe chance."""
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
    Return noises that a residual may have, coarse enough to try all.

    A random walk shows where it is stronger than white noise over the log; a Gauss-Markov part
    where its correlation time lies between some samples and the log. Flicker takes the place of a
    Gauss-Markov part.

    """
    lowest = 0.02 / duration ** 2
    highest = max(1e5 * lowest, 1e-3 / interval ** 2 * 1e-3)
    walks = [0.0, *np.geomspace(lowest, highest, _WALKS)]
    times = np.geomspace(max(4.0 * interval, duration / 2000.0), duration / 3.0, _TIMES)
    # By their density at frequency 0 over the white one, from hardly seen to a hundred times.
    strong = [(ratio / (2.0 * time), time) for time in times
              for ratio in np.geomspace(0.3, 1000.0, _STRENGTHS)]
    plain = [Shape(walk, strength, time, reference) for walk in walks
             for strength, time in [(0.0, 1.0), *strong]]
    corners = np.geomspace(0.1 / duration, 0.3 / interval, _CORNERS)
    return plain + [Shape(walk, reference=reference, flicker=corner) for walk in walks[::4]
                    for corner in corners]


#: More points of the grid than this are averaged in neighbours: causes differ with fewer, too.
MOST_POINTS = 50_000
#: Towards the highest frequencies the power of jumps falls to 0.18 between the second and the last
#: quarter, that of noise to no less; what falls below this was smoothed before it was recorded. It
#: is averaged over intervals of at most so many s.
SMOOTHED, _LONGEST = 0.05, 0.03
#: Frequencies over which the power of a rate is averaged, and by what factor rounding is taken to
#: be stronger than on average.
_NEIGHBOURS, _OVER = 101, 1.5
#: A held reference that keeps its value for more than so many of its intervals stood still; a
#: change of fewer steps may have been slow.
_STOOD = 1.5
#: Samples next to a gap of a heading whose rate is not compared, where the gap has as many: a
#: spline errs by 0.13, 0.036 and 0.01 of what its slope changes by there. Beside a shorter gap it
#: changes by little.
_BESIDE = 4
#: Part of the white noise of a sample from which on a bend of the rate is a corner: a thousand of
#: them, all of one sign, come to 3 sigma. The part of the samples that corners are, at most.
_BENT, _FEW_CORNERS = 0.1, 0.2
#: Points of the grid for each sample, and points of a log that is too short to matter: most of a
#: log must not be made up.
_EACH, _SHORT = 5, 10_000


@dataclass(frozen=True)
class Replay:
    """
    One log, ready to be searched: n samples, of which some are trusted.

    Attributes
    ----------
    channels : what the effects look at; the rate is that of the reference, the time counts from
        the first sample
    reference : the rate that the output is compared with, rad/s: as measured, where
        `channels.rate` is smooth
    kept : samples that are trusted
    place : number of each kept sample on the even grid
    interval : of the grid, s
    every : so many points of the grid are averaged into one
    filling : white noise of variance 1 for lost points of the grid, shape (place[-1] + 1,)
    rounded : step of the heading that the reference is the derivative of, rad; 0 where it has none
    has : names of the channels that the log has
    added : what the simulation adds to the rate, rad/s, shape (n,); `channels.output` is without
    coarse : variance that the rounding of the output adds to a sample, (rad/s)²
    levels : of its white noise, where a filter took from it: see `spectrum.levels`

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
        """Return how many points are searched: one with a fast transform, a few left out."""
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
        Return samples, shape (n,), on the even grid: lost ones bridged, many neighbours averaged.

        A bridge has no noise of its own. Where that would matter, white noise of a standard
        deviation fills it.

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
        """Return what rounding adds to the reference, rad/s, also where no output is kept."""
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
        Return the cosine transform of a residual; bridges get the white noise of the rest.

        The error of a rounded heading is bounded. A bridge would carry what it has at the ends of
        a gap on as a jump, so it is taken from the reference, which has no gap there.

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
        """Return it with its levels multiplied by more; the filling is filtered, too."""
        whole = transform(self.filling) * np.sqrt(
            level(angles(len(self.filling)) * self.every, more))
        filling = inverse(whole)
        return replace(self, levels=self.levels * more, filling=filling / white_noise(filling))

    def with_rate(self, rate: Array) -> Replay:
        """Return it with another rate that the effects look at."""
        return replace(self, channels=replace(self.channels, rate=rate))


def replay(log: Log, trusted: Mask, generator: np.random.Generator, update: float | None = None,
           step: float = 0.0, codes: float = 0.0, model: GyroModel | None = None) -> Replay:
    """
    Lay a log out.

    Parameters
    ----------
    log : with output, time and a reference; one at rest needs no reference
    trusted : samples to use, shape (n,)
    generator : source of the noise that fills what is lost
    update : interval at which the reference is renewed, s, where it is held in between
    step : of a reference heading, rad; 0 where it has none
    codes : step between codes of the output, rad/s; 0 where it does not matter
    model : the simulation that the output is compared with; that of an ideal gyro where it is None

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
    if model is not None and log.temperature is None:  # it has one to be simulated at
        shown = replace(shown, temperature=np.full(len(log), model.reference_temperature))
    # the heading that effects look at: the reference's, or the integral of its rate
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
    # what the model adds is taken out of the output, and effects see the rate that its gyro sees
    rate = model.distorted('rate', smooth, time)
    added = model.output_in(plain.channels.moving(rate, rate)) - rate
    return replace(plain, channels=plain.channels.moving(rate, plain.channels.output - added),
                   reference=reference + (rate - smooth), added=added)


def _refuse_gaps(time: Array, place: NDArray[np.intp]) -> None:
    """Refuse a log of which most is missing: gaps are made up, and a clock's jump fills memory."""
    points = int(place[-1]) + 1
    if points <= max(_EACH * len(place), _SHORT):
        return
    gaps = np.diff(time)
    longest = int(np.argmax(gaps))
    raise DataRefused(f'{len(place)} samples can be used where the log has room for {points}, at '
                      f'least a fifth is needed; the longest gap, of {gaps[longest]:.6g} s, '
                      f'begins at {time[longest]:.3f} s: cut the log there, and give both parts, '
                      'or give --rate where the stamps are no use')


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
    Return how many more points to average, so that no smoothing of the record is left.

    A gyro whose samples are means of many, or a reference that was smoothed, has nearly nothing
    but rounding at the highest frequencies. No noise of a model is like that, and what motion and
    noise of the reference leave there would count for much more than it is worth.

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
    Return what rounding adds to the output on average, rad/s, shape (n,).

    Where steps are not small against the noise, this depends on the rate, and would pass for an
    effect of it. It is the Fourier series of a saw, smoothed by the noise before the rounding
    (Widrow, Kollar and Liu 1996).

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
    """Return the reference rate as it is compared, and as effects look at it."""
    if log.reference_rate is not None:
        rate = _between_updates(time, log.reference_rate, step) if held else log.reference_rate
        return rate, _filled(time, rate)
    if log.reference_heading is not None:
        heading = (_between_updates(time, log.reference_heading, step) if held
                   else log.reference_heading)
        return _rates(time, heading, step)
    return np.zeros(len(time)), np.zeros(len(time))


def _filled(time: Array, values: Array) -> Array:
    """Return values without gaps: a delay or a lag carries what is lost to its neighbours."""
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
    Return samples on the whole grid, straight lines across what is lost.

    A line begins and ends in the mean of as many samples as it bridges: the noise of a single one
    would be carried across the gap.

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
    Interpolate a held reference between its updates, for a held value is half an interval late.

    An update that brings the same value leaves no trace. So a value that stands for longer is held
    until the last update before the next.

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
    Return where the rate of a heading bends too sharply to be known from samples, shape (n,).

    At a kink of the rate a spline through the heading and the integral of the output by trapezoids
    differ by a twelfth of the second difference, which is a 24th of the fourth; where a motion
    begins or ends, that passes for a dead zone or for a slip. Of a smooth motion, which splines
    follow, the fourth difference is small, however fast it accelerates. A reference that bends
    everywhere is noise, and is left to its treatment; steps of a heading alone do not make a
    fourth difference of 24 times `rounding`, step over interval.

    """
    bend = np.abs(np.diff(np.pad(rate, 2, mode='edge'), 4)) / 24.0
    white = white_noise((output - rate)[kept])
    sharp = maximum_filter1d(bend > _BENT * white + rounding, 5)
    rounded = rounding ** 2 / 12.0 > 0.5 * white ** 2  # most of what looks white is of the steps
    return np.zeros_like(sharp) if rounded or sharp[kept].mean() > _FEW_CORNERS else sharp


def _without_rounding(rate: Array, step: float, interval: float) -> Array:
    """
    Return the rate of a heading without what rounding to steps makes of it, by a Wiener filter.

    Each frequency is kept as far as its power is beyond that of the rounding, so that quick motion
    stays.

    """
    coefficients = dct(rate, norm='ortho')
    rounding = ((step / interval) ** 2 / 12.0
                * differentiated(np.arange(len(rate)) * math.pi / len(rate)))
    power = uniform_filter1d(coefficients ** 2, _NEIGHBOURS, mode='nearest')
    return idct(coefficients * np.clip(1.0 - _OVER * rounding / np.maximum(power, 1e-300),
                                       0.0, 1.0), norm='ortho')
