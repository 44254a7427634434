# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Codes: the values of a digital output, their step, the dead band about zero, and the limit."""

from __future__ import annotations

from dataclasses import dataclass

from gyro_calibration.diagnosis.expected_output import Compared
from gyro_calibration.logs.log import Array, Mask
import numpy as np
from scipy import stats
from scipy.special import ndtr

#: Values closer than this, relative to the largest, are one: a change of units rounds them.
_SAME = 1e-12
#: Least length of the mean phase of codes on a lattice: 1 for exact codes, 0 for any values.
_ALIGNED = 0.7
#: Quantiles of the gaps between codes where the step is looked for: where codes are left out, only
#: few gaps are as small.
_STARTS = (0.0, 0.001, 0.02, 0.05, 0.1, 0.25, 0.5)
#: Codes on each side that a step is found among before it is carried further.
_SOME = 8
#: The count of the extreme code is compared with that of so many next to it, or of those within
#: this part of the white noise.
_NEIGHBOURS, _WITHIN = 4, 0.05
#: Codes finer than this part of the white noise hardly ever repeat by chance.
_FINE = 0.1
#: A code that is reached in so many separate runs is none that was stuck.
_SEPARATE = 3
#: An output below this part of the fastest is that of a rest: no limit is as low, and a dead band
#: is about a rest.
_REST = 0.1
#: Values of as many digits have steps of as many parts of them, up to this factor.
_DIGIT = 10.0
#: A dead band keeps other codes away by more than so many steps.
_AWAY = 1.5
#: What is expected so many standard deviations beyond a dead band may well be in it.
_EDGE = 2.0


@dataclass(frozen=True)
class Codes:
    """
    The values that occur, in order, and how often: arrays of shape (m,).

    Attributes
    ----------
    step : between neighbouring codes; 0 where there is no such step
    aligned : how well the codes lie on it, 0 to 1
    deviation : standard deviation of the step

    """

    values: Array
    counts: Array
    step: float = 0.0
    aligned: float = 0.0
    deviation: float = 0.0


def codes_of(values: Array) -> Codes:
    """Return the codes of values without nan: the coarsest lattice, up to rounding in print."""
    found, counts = np.unique(values, return_counts=True)
    apart = np.concatenate([[True], np.diff(found) > _SAME * np.abs(found[[0, -1]]).max()])
    first = np.flatnonzero(apart)
    codes = Codes(found[first], np.add.reduceat(counts, first))
    gaps = np.diff(codes.values)
    if not gaps.size:
        return codes
    for start in sorted({float(gap) for gap in np.quantile(gaps, _STARTS)}, reverse=True):
        step, aligned, deviation = _lattice(codes, start)
        if aligned > _ALIGNED:
            return Codes(codes.values, codes.counts, step, aligned, deviation)
    return codes


def _lattice(codes: Codes, step: float) -> tuple[float, float, float]:
    """Refine a step from near to far codes; return it, the alignment, and its deviation."""
    gaps = np.diff(codes.values)
    near = gaps < 8.5 * step
    step = float(gaps[near].sum() / max(np.rint(gaps[near] / step).sum(), 1.0))
    place, span = _about_the_densest(codes.values)
    reach, deviation = span / step + 0.5, 0.0
    while True:
        within = np.abs(place) < reach * step
        aligned, offset = _alignment(place[within], codes.counts[within], step)
        if aligned < _ALIGNED:
            return step, aligned, deviation
        number = np.rint((place[within] - offset) / step)
        if np.ptp(number) > 0.0:
            step, deviation = _slope(number, place[within])
        if within.all():
            return (step, aligned, deviation) if np.ptp(number) > 0.0 else (step, 0.0, 0.0)
        reach *= 4.0


def _about_the_densest(values: Array) -> tuple[Array, float]:
    """Return how far values are from the densest place, and a first reach that gives the step."""
    width = min(2 * _SOME, len(values) - 1)
    span = values[width:] - values[:-width]
    first = int(np.argmin(span))
    return values - values[first + width // 2], float(span[first])


def _alignment(place: Array, counts: Array, step: float) -> tuple[float, float]:
    """
    Return the length of the mean phase of places on a lattice, and the shift of the lattice.

    The place that occurs most is left out: beside a value that comes at every rest, all others
    would count for nothing.

    """
    counts = (np.where(np.arange(len(counts)) == np.argmax(counts), 0, counts)
              if len(counts) > 1 else counts)
    mean = np.sum(counts * np.exp(2j * np.pi * place / step)) / counts.sum()
    return float(np.abs(mean)), float(np.angle(mean)) * step / (2.0 * np.pi)


def _slope(number: Array, place: Array) -> tuple[float, float]:
    """Return the slope of places over whole numbers, without outliers, and its deviation."""
    slope, off, spread = _line(number, place)
    good = np.abs(off) <= 0.3 * abs(slope)
    if np.ptp(number[good]) > 0.0:
        slope, off, spread = _line(number[good], place[good])
    return slope, float(np.std(off) / spread)


def _line(number: Array, place: Array) -> tuple[float, Array, float]:
    """Return a slope, the residuals of places, and the root of the sum of squares of numbers."""
    centred, apart = number - number.mean(), place - place.mean()
    squares = float(centred @ centred)
    slope = float(centred @ apart) / squares
    return slope, apart - slope * centred, float(np.sqrt(squares))


def steps_about(codes: Codes, output: Array) -> Array:
    """
    Return the most that codes about each value may be apart, shape (n,).

    Steps grow with the values in floats of 32 bits, and in what is printed with so many digits; or
    they are too fine to be seen. They are no larger than the smallest gap between values as large
    or larger, and than is usual for the digits of the finest.

    """
    steps = np.full(len(output), max(codes.step, float(np.diff(codes.values).min())
                                     if len(codes.values) > 1 else 1.0))
    sides = {sign: np.sort(sign * codes.values[sign * codes.values >= 0.0])
             for sign in (1.0, -1.0)}
    finest = min(float((np.diff(sizes) / sizes[1:]).min(initial=np.inf))
                 for sizes in sides.values())
    for sign, sizes in sides.items():
        if len(sizes) > 1:
            side = sign * output >= 0.0
            closest = np.minimum.accumulate(np.diff(sizes)[::-1])[::-1]
            place = np.minimum(np.searchsorted(sizes, sign * output[side]), len(closest) - 1)
            steps[side] = np.maximum(
                steps[side], np.minimum(closest[place], _DIGIT * finest * np.abs(output[side])))
    return steps


@dataclass(frozen=True)
class DeadBand:
    """
    A value that comes again and again, while those near it never do.

    Attributes
    ----------
    value : rad/s
    half : how far others keep away from it, rad/s

    """

    value: float
    half: float

    def holds(self, output: Array) -> Mask:
        """Mark the samples in it."""
        return np.abs(output - self.value) < 0.5 * self.half

    def chances(self, seen: Compared) -> Array:
        """Return the chance of each sample to be in it, by its expected output, or by a rest."""
        rest = (np.full(len(seen.output), np.median(seen.output)) if seen.expected is None
                else seen.expected)
        off, doubt = np.nan_to_num(rest - self.value), max(doubt_of(seen), 1e-9 * self.half)
        reach = self.half + _EDGE * doubt
        return ndtr((reach - off) / doubt) - ndtr((-reach - off) / doubt)


def dead_band(codes: Codes, output: Array) -> DeadBand | None:
    """Return the dead band of an output, or None where it shows none."""
    counts = np.where(np.abs(codes.values) < _slow(output), codes.counts, 0)
    place = int(np.argmax(counts))
    away = np.abs(np.delete(codes.values, place) - codes.values[place])
    band = DeadBand(float(codes.values[place]), float(away.min(initial=np.inf)))
    runs = np.count_nonzero(np.diff(band.holds(output), prepend=False, append=False)) // 2
    return band if counts[place] > 1 and runs > 1 and band.half > _AWAY * codes.step else None


def _slow(output: Array) -> float:
    """Return below which size an output is that of a rest; a wild one is not the fastest."""
    return _REST * float(np.quantile(np.abs(output), 0.99))


def doubt_of(seen: Compared) -> float:
    """Return the deviation of samples from the expected output, rad/s: noise and nonlinearity."""
    return seen.white if seen.expected is None else max(seen.white, seen.scatter)


@dataclass(frozen=True)
class Limit:
    """
    Codes that the output cannot go beyond.

    Attributes
    ----------
    low, high : the limit on each side, infinite where there is none
    p_value : the chance that an output without one repeats its extreme codes as often

    """

    low: float
    high: float
    p_value: float

    @property
    def size(self) -> float:
        """Return the limit as a rate without sign."""
        return min(-self.low, self.high)

    def reached(self, output: Array) -> Mask:
        """Mark the samples at the limit."""
        slack = 1e-9 * self.size
        return (output >= self.high - slack) | (output <= self.low + slack)


def limit_of(codes: Codes, seen: Compared, level: float) -> Limit | None:
    """
    Return the limit of an output, or None where it shows none.

    An extreme code is one if it is beyond what comes at rests; if it stands more often than its
    neighbours further in, where an output that is free to go beyond has fewer; and if the output
    would have gone beyond by what is expected of it, which a coarse code at a constant rate would
    not.

    Parameters
    ----------
    codes : of the output
    seen : output and expectation
    level : chance of a false alarm on one side

    """
    chances = {}
    for sign in (1.0, -1.0):
        values, counts = ((codes.values, codes.counts) if sign > 0.0
                          else (-codes.values[::-1], codes.counts[::-1]))
        chance = _chance(values, counts, float(steps_about(codes, sign * values[-1:])[0]),
                         seen.white)
        if (chance < level and values[-1] > _slow(seen.output)
                and _held_back(seen, sign, values[-1], codes.step)):
            chances[sign] = (sign * values[-1], chance)
    if not chances:
        return None
    return Limit(chances.get(-1.0, (-np.inf, 1.0))[0], chances.get(1.0, (np.inf, 1.0))[0],
                 min(chance for _, chance in chances.values()))


def _chance(values: Array, counts: Array, step: float, white: float) -> float:
    """Return the chance of as many samples at the last code, if the density falls towards it."""
    reach = max(_NEIGHBOURS * step, _WITHIN * white)
    neighbours = min(reach / step, 1e6)
    before = int(counts[:-1][values[:-1] > values[-1] - reach - 0.5 * step].sum())
    return float(stats.binom.sf(counts[-1] - 2, counts[-1] - 1 + before, 1.0 / (neighbours + 1.0)))


def _held_back(seen: Compared, sign: float, top: float, step: float) -> bool:
    """Tell whether samples at the largest value in one sense would have gone beyond it."""
    at = sign * seen.output >= top - 1e-9 * abs(top)
    runs = int(np.count_nonzero(np.diff(at.astype(np.int8), prepend=0) > 0))
    fine = step < _FINE * seen.white
    beyond = (np.array([]) if seen.expected is None
              else sign * seen.expected[at & np.isfinite(seen.expected)] - top)
    if not beyond.size:
        return fine and runs >= _SEPARATE
    middle = float(np.median(beyond))
    # The expected output errs by bias wander and nonlinearity, which these samples share.
    doubt = doubt_of(seen)
    return (middle > 0.5 * step + 2.0 * doubt
            or (fine and (runs >= _SEPARATE or middle > -3.0 * doubt)))
