"""
Allan deviation of a gyro at rest, and the noise figures in it: what IEEE Std 952, annex C, calls N, B, K, Q and R.

A gyro at rest says nothing but its bias and its noise. The Allan variance at the averaging time tau is half the mean square of the
difference between neighbouring means over tau. It is taken here at every sample (overlapping), and its uncertainty is computed and not
assumed: second differences of the angle are Gaussian, so that variances and covariances of their mean squares follow from theirs.

"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.signal import medfilt
from scipy.special import chdtrc, chdtri

from gyro_calibration.likelihood import CHANCE
from gyro_calibration.log import Array, DataRefused
from gyro_calibration.noise import ALLAN_FLOOR, Noise

Integers = NDArray[np.integer[Any]]

#: Fewer samples than this show no noise figure.
FEWEST = 100

#: Share of a window that may be lost samples: it changes the variance of the window's mean by as much at most.
_LOST_SHARE = 0.01


@dataclass(frozen=True)
class Record:
    """
    Samples of a gyro at rest at even intervals.

    Attributes
    ----------
    rate : rad/s, shape (n,); nan where a sample is lost or left out
    interval : s
    remarks : what was found on the way, one sentence each

    """

    rate: Array
    interval: float
    remarks: tuple[str, ...] = ()


#: Share of intervals below half of the usual one from which on the stamps are taken to come in bursts.
_BURSTS = 0.02

#: Share of intervals that are alike from which on stamps are not taken to come in bursts.
_STEADY = 0.9

#: Samples over which delayed stamps catch up again: for single late ones, and for bursts of packets on their way through a host.
_CATCH_UP, _CATCH_UP_BURSTS = 10, 300

#: Lost samples that can be told from the wander of delayed stamps.
_SURELY_LOST = 10

#: A gap of more than this part of the record is crossed by no window; a window of more than this part is too long to tell a motion by.
_LONG = 50

#: Share of a record that may be lost.
_MOST_LOST = 0.3


def even_record(time: Array, output: Array, moving: Array | None = None) -> Record:
    """
    Put samples on an even grid, lost ones marked.

    A gyro samples by its own clock, whatever a host's stamps say: so the samples are numbered, and a straight line through the stamps
    gives the interval. Samples are lost where the stamps stay late after a long step. Where they catch up again, they only came late.

    Parameters
    ----------
    time : stamps, s, increasing, shape (n,)
    output : rad/s, shape (n,); nan counts as lost
    moving : 1 where the log says that the gyro was moved; counts as lost

    Raises
    ------
    DataRefused : too few samples, a dead gyro, stamps that belong to no even interval, too much lost, or motion

    """
    if len(output) < FEWEST:
        raise DataRefused(f'{len(output)} samples; an Allan deviation wants at least {FEWEST}: record longer')
    known = np.isfinite(output) if moving is None else np.isfinite(output) & (moving == 0.0)
    _refuse_dead(time, output[known])
    interval, lost, remarks = _numbering(time)
    number = np.arange(len(time)) + np.cumsum(np.concatenate([[0], np.minimum(lost, len(time) // _LONG + 1)]))
    rate = np.full(int(number[-1]) + 1, np.nan)
    rate[number[known]] = output[known]
    if known.sum() < len(output):
        remarks.append(f'{len(output) - int(known.sum())} samples without output, or moving, are left out.')
    remarks += _leave_out_wild_samples(rate, number, time)
    _refuse_motion(rate, number, time)
    rate = _shortened(rate, len(time) // _LONG + 1)
    share = float(np.isnan(rate).mean())
    if share > _MOST_LOST:
        raise DataRefused(f'{100 * share:.0f} % of the samples are lost or without output; wanted at most {100 * _MOST_LOST:.0f} %: '
                          'record again, or give --rate where the stamps are no use')
    return Record(rate, interval, tuple(remarks))


def _shortened(rate: Array, longest: int) -> Array:
    """Return the samples with long gaps cut down: no window reaches across them in any case."""
    begins, ends = _gaps(np.isfinite(rate))
    kept = np.ones(len(rate), dtype=bool)
    for begin, end in zip(begins + longest, ends):
        kept[begin:end] = False
    return rate[kept]


def _leave_out_wild_samples(rate: Array, number: Integers, time: Array) -> list[str]:
    """Take out samples that stand alone far beyond the noise, and say so; a motion or a jolt lasts longer than two samples."""
    values = _filled(rate)
    off = np.abs(values - medfilt(values, 5))
    off[:2] = off[-2:] = 0.0
    usual = float(np.quantile(off, 0.9)) / 1.645 or _scale(off)  # not the median: where the output walks, half of these are zero
    wild = np.nonzero(off > 1.25 * CHANCE * usual)[0]
    if not wild.size or wild.size > 0.001 * len(rate):
        return []
    rate[wild] = np.nan
    return [f'{wild.size} samples far beyond the noise are left out, the first at {_time_at(wild[0], number, time):.3f} s.']


def _scale(size: Array) -> float:
    """Return the standard deviation of Gaussian values with these sizes, most of them."""
    return 1.4826 * float(np.median(size)) or float(np.sqrt(np.mean(size ** 2)))


def _time_at(index: int | np.integer[Any], number: Integers, time: Array) -> float:
    return float(np.interp(index, number, time))


def _refuse_motion(rate: Array, number: Integers, time: Array) -> None:
    """Refuse a record in which means over some time change by what noise never does; say where, and which part is at rest."""
    angle, lost = np.concatenate([[0.0], np.cumsum(_filled(rate))]), _lost_before(rate)
    moved, worst, over = np.zeros(len(rate), dtype=bool), 0.0, 0
    for size in (2 ** octave for octave in range(max(int(math.log2(len(rate) / _LONG)), 0))):
        at = np.arange(0, len(angle) - 2 * size, max(1, size // 4))
        if lost is not None:
            at = at[lost[at + 2 * size] - lost[at] <= _LOST_SHARE * 2 * size]
        if len(at) < _LONG:
            break
        change = np.abs(angle[at + 2 * size] - 2.0 * angle[at + size] + angle[at])
        scale = _scale(change)
        for begin in at[change > CHANCE * scale]:
            moved[begin:begin + 2 * size] = True
        if change.max() > worst * scale:
            worst, over = float(change.max() / scale), int(size)
    if not moved.any():
        return
    places = np.nonzero(moved)[0]
    begins, ends = _gaps(moved)
    longest = int(np.argmax(ends - begins)) if begins.size else 0
    rest = (f'at rest longest from {_time_at(begins[longest], number, time):.1f} to {_time_at(ends[longest] - 1, number, time):.1f} s'
            if begins.size else 'at rest nowhere')
    raise DataRefused(
        f'the gyro was moved, or its output jumped: from {_time_at(places[0], number, time):.2f} s on means over '
        f'{over * (time[-1] - time[0]) / number[-1]:.3g} s change up to {worst:.0f} standard deviations; it is {rest}: use that part, '
        'or record again')


def _refuse_dead(time: Array, output: Array) -> None:
    if len(output) < FEWEST:
        raise DataRefused(f'{len(output)} samples at rest with an output; an Allan deviation wants at least {FEWEST}: record longer')
    changes = np.nonzero(np.concatenate([[True], np.diff(output) != 0.0, [True]]))[0]
    longest = int(np.argmax(np.diff(changes)))
    count = int(np.diff(changes)[longest])
    if count > max(len(output) // 10, 50):
        raise DataRefused(f'the gyro gives the same value {count} times in a row from {time[changes[longest]]:g} s on: it is dead or its '
                          'steps are coarser than its noise; check it, and record again')


def _numbering(time: Array) -> tuple[float, Integers, list[str]]:
    """Return the interval, s, how many samples are lost before each but the first, and what to say of it."""
    lag = min(100, len(time) // 4)
    interval = float(np.median(time[lag:] - time[:-lag])) / lag
    steps = np.diff(time)
    usual = float(np.median(steps))
    if not 0.8 < interval / usual < 1.25 and float((np.abs(steps / usual - 1.0) < 0.5).mean()) > _STEADY:
        raise DataRefused(f'most stamps are {1000 * usual:.4g} ms apart, but 100 samples take {100 * interval:.4g} s: either most samples '
                          'are lost, or they come in long bursts; say with --rate how many there are a second, or record again')
    bursts = float((steps < 0.5 * interval).mean()) > _BURSTS
    lost = _lost_samples(time, steps, interval, bursts)
    number = np.arange(len(time)) + np.cumsum(np.concatenate([[0], lost]))
    slope = float(np.polyfit(number, time - time[0], 1)[0])
    off = time - time[0] - slope * number
    off = off - np.median(off)
    wander = float(np.abs(off).max())
    uneven = not bursts and float((np.abs(steps / interval - np.round(steps / interval)) > 0.4).mean()) > 0.2
    if uneven or wander > 0.05 * len(time) * slope:
        raise DataRefused(f'the stamps belong to no even interval (about {interval:g} s; up to {wander:g} s off); if the samples are even, '
                          'say with --rate how many there are a second')
    return slope, lost, _said_of_stamps(time, lost, slope, wander if bursts else 0.0)


def _lost_samples(time: Array, steps: Array, interval: float, bursts: bool) -> Integers:
    """Return how many samples are lost in each step: those by which the stamps are late before they have caught up."""
    lost: Integers = np.zeros(len(steps), dtype=np.int64)
    shift, span = 0, _CATCH_UP_BURSTS if bursts else _CATCH_UP
    late = (time - time[0]) / interval - np.arange(len(time))
    least, done = _SURELY_LOST if bursts else 1, 0
    for step in np.nonzero(steps > (least + 0.5) * interval)[0].tolist():
        late[done:step + 1] -= shift
        done = step + 1
        missing = round(late[step + 1:step + 1 + span].min() - shift - late[max(step + 1 - span, 0):step + 1].min())
        if missing >= least:
            lost[step] = missing
            shift += missing
    return lost


def _said_of_stamps(time: Array, lost: Integers, interval: float, wander: float) -> list[str]:
    remarks = []
    if wander:
        remarks.append(f'The stamps come in bursts or with jitter, up to {wander:.3g} s off an even interval of {1000 * interval:.5g} ms, '
                       'which is used.')
    if lost.any():
        longest, gaps = int(np.argmax(lost)), int(np.count_nonzero(lost))
        remarks.append(f'{lost.sum()} samples are lost in {gaps} gap{"s" * (gaps > 1)}; the longest, of {lost[longest]}, is at '
                       f'{time[longest]:.3f} s. Windows with more than {100 * _LOST_SHARE:g} % lost are not used.')
    return remarks


@dataclass(frozen=True)
class Floor:
    """
    The lowest point of a chart; at its end, where single points are low by chance, it is the one of the lowest upper bound.

    Attributes
    ----------
    time : averaging time, s
    deviation, lower, upper : Allan deviation there and its 95 % bounds, rad/s

    """

    time: float
    deviation: float
    lower: float
    upper: float

    @property
    def bias_instability(self) -> tuple[float, float, float]:
        """Return B as IEEE Std 952 reads it off the floor, which is 0.664 B, and its bounds, rad/s."""
        return self.deviation / ALLAN_FLOOR, self.lower / ALLAN_FLOOR, self.upper / ALLAN_FLOOR


@dataclass(frozen=True)
class AllanChart:
    """
    The overlapping Allan deviation, each array of shape (n,).

    Attributes
    ----------
    interval : between samples, s
    samples : how many the record has, lost ones included
    size : averaging times in samples
    deviation : rad/s
    differences : how many second differences the mean square is taken over
    degrees_of_freedom : equivalent ones, of the mean square
    lower, upper : bounds of the deviation with 95 % confidence, rad/s

    """

    interval: float
    samples: int
    size: Integers
    deviation: Array
    differences: Integers
    degrees_of_freedom: Array
    lower: Array
    upper: Array

    @property
    def floor(self) -> Floor:
        """Return the lowest point."""
        lowest = int(np.argmin(self.upper))
        return Floor(*(float(values[lowest]) for values in (self.time, self.deviation, self.lower, self.upper)))

    @property
    def time(self) -> Array:
        """Return the averaging times, s."""
        return self.size * self.interval


def averaging_sizes(samples: int, per_decade: int = 10) -> Integers:
    """Return averaging times in samples, spaced evenly in their logarithm, up to a third of the record."""
    decades = math.log10(max(samples // 3, 1))
    return np.unique(np.round(np.logspace(0.0, decades, round(decades * per_decade) + 1)).astype(np.int64))


def allan_deviation(rate: Array, interval: float, times: Sequence[float] | Array | None = None,
                    progress: Callable[[Iterable[Any]], Iterable[Any]] = iter) -> AllanChart:
    """
    Return the overlapping Allan deviation of rate samples (IEEE Std 952, C.1; Riley and Howe, NIST SP 1065, eq. 11).

    Parameters
    ----------
    rate : rad/s, shape (n,), one sample an interval; nan where a sample is lost
    interval : s
    times : averaging times, s, taken to the nearest whole number of intervals; default: ten a decade, up to a third of the record
    progress : is given the blocks of the record to go through, such as a progress bar

    Raises
    ------
    DataRefused : too few samples, or an averaging time that does not fit twice into the record

    """
    samples = len(rate)
    if np.isfinite(rate).sum() < FEWEST:
        raise DataRefused(f'{int(np.isfinite(rate).sum())} samples; an Allan deviation wants at least {FEWEST}: record longer')
    sizes = averaging_sizes(samples) if times is None else np.unique(np.round(np.asarray(times, dtype=float) / interval).astype(np.int64))
    if not sizes.size or sizes[0] < 1 or 2 * sizes[-1] > samples:
        given = f'{sizes[0] * interval:g} to {sizes[-1] * interval:g} s' if sizes.size else 'none'
        raise DataRefused(f'averaging times: {given}; wanted at least one sample, {interval:g} s, and at most half the record, '
                          f'{samples // 2 * interval:g} s: choose others, or record longer')
    sums, counts = _square_sums(rate, sizes, progress)
    some = counts > 0
    sizes, counts = sizes[some], counts[some]
    variance = sums[some] / (2.0 * sizes.astype(float) ** 2 * counts)
    freedom = _degrees_of_freedom(samples, sizes, variance) * counts / (samples + 1 - 2 * sizes)
    return _chart(interval, samples, sizes, variance, counts, freedom)


def _chart(interval: float, samples: int, sizes: Integers, variance: Array, counts: Integers, freedom: Array) -> AllanChart:
    """Put the chart together, with bounds by the distribution of chi squared (NIST SP 1065, eq. 45)."""
    lower, upper = (np.sqrt(variance * freedom / chdtri(freedom, tail)) for tail in (0.025, 0.975))
    return AllanChart(interval, samples, sizes, np.sqrt(variance), counts, freedom, lower, upper)


#: Samples in a block: its few arrays stay in the cache while all averaging times go over it.
_BLOCK = 16384

#: Longer products are given to several threads, which costs more than they win.
_PRODUCT = 8192


def _square_sums(rate: Array, sizes: Integers, progress: Callable[[Iterable[Any]], Iterable[Any]]) -> tuple[Array, Integers]:
    """Return the sums of the squared second differences of the angle, in samples, and how many there are."""
    lost = _lost_before(rate)
    angle = np.empty(len(rate) + 1)
    angle[0] = 0.0
    np.cumsum(_filled(rate), out=angle[1:])
    twice, buffer = 2.0 * angle, np.empty(_BLOCK)
    sums, counts = np.zeros(len(sizes)), np.zeros(len(sizes), dtype=np.int64)
    for begin in progress(range(0, len(angle), _BLOCK)):
        for place, size in enumerate(sizes.tolist()):
            end = min(begin + _BLOCK, len(angle) - 2 * size)
            if end <= begin:
                break
            block = buffer[:end - begin]
            np.add(angle[begin + 2 * size:end + 2 * size], angle[begin:end], out=block)
            np.subtract(block, twice[begin + size:end + size], out=block)
            counts[place] += len(block) if lost is None else _leave_out(block, lost, begin, size)
            sums[place] += sum(float(part @ part) for part in (block[:_PRODUCT], block[_PRODUCT:]))
    return sums, counts


def _leave_out(block: Array, lost: Integers, begin: int, size: int) -> int:
    """Set the second differences to zero that miss too many samples, and return how many are left."""
    end = begin + len(block)
    whole = lost[begin + 2 * size:end + 2 * size] - lost[begin:end] <= _LOST_SHARE * 2 * size
    block *= whole
    return int(np.count_nonzero(whole))


def _lost_before(rate: Array) -> Integers | None:
    """Return how many samples are lost before each one, shape (n + 1,), or None if none is."""
    lost = np.isnan(rate)
    return np.concatenate([[0], np.cumsum(lost)]) if lost.any() else None


def _filled(rate: Array) -> Array:
    """Return the rate less its mean, with each gap filled by the mean of what is about it, five times as long on either side."""
    known = np.isfinite(rate)
    values = rate - rate[known].mean()
    if known.all():
        return values
    values[~known] = 0.0
    begins, ends = _gaps(known)
    margin = 5 * (ends - begins) + 5
    low, high = np.maximum(begins - margin, 0), np.minimum(ends + margin, len(rate))
    sums, counts = (np.concatenate([[0.0], np.cumsum(each)]) for each in (values, known))
    means = (sums[high] - sums[low]) / np.maximum(counts[high] - counts[low], 1.0)
    values[~known] = np.repeat(means, ends - begins)
    return values


def _gaps(known: NDArray[np.bool_]) -> tuple[Integers, Integers]:
    """Return where each stretch of unknown samples begins, and where it has ended."""
    edges = np.diff(np.concatenate([[1], known.astype(np.int8), [1]]))
    return np.nonzero(edges < 0)[0], np.nonzero(edges > 0)[0]


@dataclass(frozen=True)
class Part:
    """
    A part of the noise, by how its Allan variance goes with the averaging time (IEEE Std 952, C.1).

    Attributes
    ----------
    name, symbol, unit : as in IEEE Std 952; the unit in SI
    slope : of the Allan deviation in the logarithmic chart
    factor : Allan variance = factor * coefficient² * tau ** (2 slope)
    covariance : of the angle, for a coefficient of 1, as a function of the time between, up to what second differences do not see

    """

    name: str
    symbol: str
    unit: str
    slope: float
    factor: float
    covariance: Callable[[Integers], Array]

    def variance(self, time: Array | Integers) -> Array:
        """Return the Allan variance for a coefficient of 1."""
        return self.factor * np.asarray(time, dtype=float) ** (2.0 * self.slope)


def _flicker_covariance(time: Integers) -> Array:
    """Return t² ln t / (2 pi): the second difference has the Allan variance 2 ln 2 / pi."""
    size = np.abs(time)
    return size ** 2 * np.log(np.where(size == 0.0, 1.0, size)) / (2.0 * math.pi)


ANGLE_RANDOM_WALK = Part('angle_random_walk', 'N', 'rad/√s', -0.5, 1.0, lambda time: -0.5 * np.abs(time))
BIAS_INSTABILITY = Part('flicker', 'B', 'rad/s', 0.0, ALLAN_FLOOR ** 2, _flicker_covariance)
RATE_RANDOM_WALK = Part('rate_random_walk', 'K', 'rad/s/√s', 0.5, 1.0 / 3.0, lambda time: np.abs(time) ** 3 / 12.0)
QUANTIZATION = Part('quantization', 'Q', 'rad', -1.0, 3.0, lambda time: (np.asarray(time) == 0.0).astype(float))
RATE_RAMP = Part('rate_ramp', 'R', 'rad/s²', 1.0, 0.5, lambda time: 0.0 * np.asarray(time))

PARTS = (ANGLE_RANDOM_WALK, BIAS_INSTABILITY, RATE_RANDOM_WALK, QUANTIZATION, RATE_RAMP)
_WALK, _RAMP, _QUANTIZATION = PARTS.index(ANGLE_RANDOM_WALK), PARTS.index(RATE_RAMP), PARTS.index(QUANTIZATION)

#: Beside the parts: what a filter takes from the variance. Over times beyond its memory that goes as quantization, with the other sign.
_BEND = len(PARTS)

#: Second difference.
_WEIGHTS = (1.0, -2.0, 1.0)

#: Lags to a window, and to the longer one of two: more change the covariance by less than a percent.
_FINE, _COARSE = 8, 512

#: What changes slower than its second differences over a longer time: it does not forget.
_SLOW = (PARTS.index(RATE_RANDOM_WALK), _RAMP)


def _lag_covariance(part: Part, first: int, second: int, lags: Integers) -> Array:
    """Return the covariance of second differences over `first` and `second` samples at each lag."""
    return np.sum([a * b * part.covariance(lags + (j * second - i * first))
                   for i, a in enumerate(_WEIGHTS) for j, b in enumerate(_WEIGHTS)], axis=0)


def _lag_covariances(first: int, second: int, lags: Integers) -> Array:
    return np.array([_lag_covariance(part, first, second, lags) for part in PARTS])


def _pairs(count_first: int, count_second: int, lags: Integers) -> Integers:
    """Return how many pairs of second differences stand at each lag."""
    return np.maximum(np.minimum(count_first, count_second - lags) - np.maximum(0, -lags), 0)


def _covariance_parts(samples: int, first: int, second: int) -> Array:
    """
    Return the covariance of two Allan variances, in samples, as a quadratic form of the squared coefficients, shape (5, 5).

    Mean squares of Gaussian values have the covariance 2 c² summed over all pairs (Greenhall and Riley, Uncertainty of stability variances
    based on finite differences, PTTI 2003). Angle quantization is white: only lags at which two of its samples meet count. A ramp is no
    noise, but multiplies it: squares of values with a mean m have 4 m² c besides.

    """
    counts = samples + 1 - 2 * first, samples + 1 - 2 * second
    stride = max(1, min(first, second) // _FINE, max(first, second) // _COARSE)
    reach = 10 * max(first, second)
    lags = np.arange(-(min(reach, counts[0]) // stride), min(reach, counts[1]) // stride + 1) * stride
    pairs, values = _pairs(*counts, lags) * float(stride), _lag_covariances(first, second, lags)
    if stride > max(1, min(first, second) // 2):
        values[[place for place in range(len(PARTS)) if place not in _SLOW]] = 0.0  # what forgets is independent over times so far apart
    meeting = np.unique([i * first - j * second for i in range(3) for j in range(3)])
    values[_QUANTIZATION] = 0.0
    form = np.array([[2.0 * (pairs * one * other).sum() for other in values] for one in values])  # a product of matrices wakes threads
    at_meeting, meeting_pairs = _lag_covariances(first, second, meeting), _pairs(*counts, meeting)
    form[_QUANTIZATION] = form[:, _QUANTIZATION] = 2.0 * (at_meeting * at_meeting[_QUANTIZATION] * meeting_pairs).sum(axis=1)
    slopes = (values * pairs).sum(axis=1)
    slopes[_QUANTIZATION] = at_meeting[_QUANTIZATION] @ meeting_pairs
    form[_RAMP] = form[:, _RAMP] = 2.0 * float(first) ** 2 * float(second) ** 2 * slopes
    return form / (4.0 * float(first) ** 2 * float(second) ** 2 * counts[0] * counts[1])


def _degrees_of_freedom(samples: int, sizes: Integers, variance: Array) -> Array:
    """Return the equivalent degrees of freedom of each Allan variance, for the noise that its slope shows there."""
    return np.array([_freedom(samples, int(size), PARTS[kind]) for size, kind in zip(sizes, _kinds(sizes, variance))])


def _freedom(samples: int, size: int, part: Part) -> float:
    """Return (sum of variances)² / sum of covariances² over all second differences (Greenhall and Riley, PTTI 2003)."""
    count = samples + 1 - 2 * size
    stride = 1 if part is QUANTIZATION else max(1, size // _FINE)  # white, it is there at single lags only
    lags = np.arange(min(10 * size, count - 1) // stride + 1) * stride
    squares = _lag_covariance(part, size, size, lags) ** 2 * (count - lags) * stride
    return max(1.0, float(squares[0]) * count / stride / float(2.0 * squares.sum() - squares[0]))


def _kinds(sizes: Integers, variance: Array) -> list[int]:
    """
    Return which random part each Allan variance looks like, by its slope from half to twice its averaging time.

    Quantization stands at the short end; a steep fall elsewhere is chance.

    """
    low, high = np.searchsorted(sizes, sizes / 2.0), np.searchsorted(sizes, 2.0 * sizes, side='right') - 1
    rise = np.log(np.maximum(variance[high], 1e-300) / np.maximum(variance[low], 1e-300))
    slopes = np.where(high > low, rise / np.where(high > low, np.log(sizes[high] / sizes[low]), 1.0), -1.0)
    random = [place for place in range(len(PARTS)) if place not in (_RAMP, _QUANTIZATION)]
    kinds = [min(random, key=lambda kind: abs(2.0 * PARTS[kind].slope - slope)) for slope in slopes]
    first = int(np.argmin(np.append(slopes < -1.5, False)))
    return [_QUANTIZATION] * first + kinds[first:]


@dataclass(frozen=True)
class Figure:
    """
    How much there is of one part of the noise.

    Attributes
    ----------
    part : which
    value : its coefficient, in the part's unit; 0 where the record shows none
    standard_deviation : of the coefficient, if the parts that are seen are all there are; nan where the record shows none
    lower, upper : bounds with 95 % confidence, also if there is a little of other parts; where the record shows none, 0 and how much it
        may hide

    """

    part: Part
    value: float
    standard_deviation: float
    lower: float
    upper: float


@dataclass(frozen=True)
class NoiseFit:
    """
    The noise figures of a record.

    Attributes
    ----------
    figures : by symbol: N, B, K, Q, R
    chart : the Allan deviations that were fitted, at octaves
    shortest, longest : the averaging times that the fit holds for, s
    misfit : how much further the Allan deviations are off the sum of the parts than chance allows, as a share of them
    rivals : the symbols of other combinations of parts that would explain the record nearly as well

    """

    figures: dict[str, Figure]
    chart: AllanChart
    shortest: float
    longest: float
    misfit: float
    rivals: tuple[str, ...] = ()

    @property
    def noise(self) -> Noise:
        """Return the figures that a model holds."""
        return Noise(*(self.figures[symbol].value for symbol in 'NBK'))

    def deviation(self, time: Array) -> Array:
        """Return the Allan deviation, rad/s, that the figures add up to."""
        return np.sqrt(sum(figure.value ** 2 * figure.part.variance(time) for figure in self.figures.values()))

    @property
    def floor_reached(self) -> bool:
        """Tell whether what falls with the averaging time is less than half of the variance, one octave before the end of the chart."""
        time = self.chart.time[-2]
        falling = sum(figure.value ** 2 * figure.part.variance(time) for figure in self.figures.values() if figure.part.slope < 0.0)
        return bool(falling < 0.5 * self.deviation(time) ** 2)


def fit_noise(rate: Array, interval: float) -> NoiseFit:
    """
    Fit the parts of the noise to the Allan variances at octaves, and keep those that the record shows.

    The squared coefficients are found by generalized least squares (as in the generalized method of wavelet moments of Guerrier, Skaloud,
    Stebler and Victoria-Feser, JASA 2013), none of them negative, with the covariance that the fitted noise itself implies. Of all
    combinations the likeliest is kept, if each further part makes the data likelier by more than chance does. The shortest averaging
    times are left out until the sum of the parts describes the rest, because the filters of a gyro bend that end.

    Parameters
    ----------
    rate : rad/s, shape (n,), one sample an interval; nan where a sample is lost
    interval : s

    Raises
    ------
    DataRefused : too few samples

    """
    chart = allan_deviation(rate, interval, 2.0 ** np.arange(max(math.floor(math.log2(max(len(rate), 8) / 6.0)), 1) + 1) * interval)
    if len(chart.size) < _FEWEST_OCTAVES or not chart.deviation.all():
        raise DataRefused(f'{len(chart.size)} octaves of averaging times without a gap, the lowest Allan deviation '
                          f'{chart.deviation.min(initial=math.inf):g} rad/s; wanted {_FEWEST_OCTAVES} octaves, all above 0: record longer '
                          'and without losses')
    return _figures(chart, _describe(_Octaves.of(chart)))


@lru_cache(maxsize=8)
def _forms(samples: int, sizes: tuple[int, ...]) -> Array:
    """Return the covariance of Allan variances as a quadratic form of squared coefficients, shape (n, n, 5, 5)."""
    forms = np.zeros((len(sizes),) * 2 + (len(PARTS),) * 2)
    for i, j in itertools.combinations_with_replacement(range(len(sizes)), 2):
        form = _covariance_parts(samples, sizes[i], sizes[j])
        forms[i, j] = forms[j, i] = 0.5 * (form + form.T)
    return forms


@dataclass(frozen=True)
class _Octaves:
    """
    Allan variances at octaves with what their covariance is made of; all in samples and in units of their own size.

    Attributes
    ----------
    variance : shape (n,)
    columns : of each part, and of a bend, for a coefficient of 1, shape (n, 6)
    forms : the covariance as a quadratic form of squared coefficients, shape (n, n, 5, 5)

    """

    variance: Array
    columns: Array
    forms: Array

    @classmethod
    def of(cls, chart: AllanChart) -> _Octaves:
        columns = np.column_stack([*(part.variance(chart.size) for part in PARTS), -QUANTIZATION.variance(chart.size)])
        scarcity = np.sqrt((chart.samples + 1 - 2 * chart.size) / chart.differences)
        forms = _forms(chart.samples, tuple(chart.size.tolist())) * np.outer(scarcity, scarcity)[:, :, None, None]
        return cls(chart.deviation ** 2, columns, forms)

    def since(self, start: int) -> _Octaves:
        """Leave out the shortest averaging times."""
        return _Octaves(self.variance[start:], self.columns[start:], self.forms[start:, start:])

    def covariance(self, squares: Array) -> Array:
        """Return the covariance of the variances, shape (n, n), if the squared coefficients are these."""
        return np.einsum('ijpq,p,q->ij', self.forms, squares[:_BEND], squares[:_BEND])

    def model(self, squares: Array) -> Array:
        """Return the variances that the squared coefficients add up to; above zero, however deep the bend."""
        return np.maximum(self.columns @ squares, 1e-3 * self.variance)


@dataclass(frozen=True)
class _Description:
    """
    A combination of parts, fitted.

    Attributes
    ----------
    start : the first octave that it describes
    octaves : those that it describes
    places : the parts that it may hold
    squares : squared coefficients, shape (6,)
    half : Cholesky factor of the covariance of the variances
    misfit : see `NoiseFit`

    """

    start: int
    octaves: _Octaves
    places: tuple[int, ...]
    squares: Array
    half: Array
    misfit: float

    def scores(self) -> tuple[Array, float]:
        """
        Return standard normal scores, and -2 ln of the density that they stand for.

        A mean square is no Gaussian value; its cube root nearly is one (Wilson and Hilferty, 1931).

        """
        model, deviation = self.octaves.model(self.squares), np.sqrt((self.half ** 2).sum(axis=1))
        ninth = (deviation / model) ** 2 / 9.0
        normal = (np.cbrt(self.octaves.variance / model) - 1.0 + ninth) / np.sqrt(ninth)
        half = self.half / deviation[:, None]
        density = np.log(ninth).sum() + 2.0 / 3.0 * np.log(model).sum() + 2.0 * np.log(half.diagonal()).sum()
        return np.linalg.solve(half, normal), float(density)

    @property
    def held(self) -> list[int]:
        """Return the places of the parts that there is something of."""
        return np.nonzero(self.squares)[0].tolist()

    def surprise(self) -> float:
        """Return -2 ln likelihood, up to what is the same for all combinations."""
        normal, density = self.scores()
        return float(normal @ normal) + density

    def cost(self) -> float:
        """Return -2 ln likelihood with the evidence that each part must bring; a ramp more: in one record a walk looks like it."""
        return self.surprise() + _EVIDENCE * len(self.held) + _RIVAL * (_RAMP in self.held)

    def likely(self) -> bool:
        """Tell whether chance explains what is left."""
        normal, _ = self.scores()
        return chdtrc(len(normal) - len(self.held), float(normal @ normal)) > _CHANCE

    def bounds(self, place: int) -> tuple[float, float]:
        """Return bounds of a coefficient with 95 % confidence, as if its square were a mean square of so many degrees of freedom."""
        _, deviations = self.estimate(self.held)
        square, deviation = self.squares[place], deviations[self.held.index(place)]
        freedom = max(2.0 * (square / deviation) ** 2, 1.0)
        lower, upper = (math.sqrt(square * freedom / chdtri(freedom, tail)) for tail in (0.025, 0.975))
        return lower, upper

    def estimate(self, places: Sequence[int]) -> tuple[Array, Array]:
        """Return the squares of some parts by least squares, negative ones too, and their standard deviations."""
        white = np.linalg.solve(self.half, self.octaves.columns[:, list(places)])
        size = np.linalg.norm(white, axis=0)
        inverse = np.linalg.pinv((white / size).T @ (white / size))
        found = inverse @ (white / size).T @ np.linalg.solve(self.half, self.octaves.variance)
        return found / size, np.sqrt(inverse.diagonal()) / size


#: What a further part must take off -2 ln likelihood. White noise alone then shows none in 95 of 100 records.
_EVIDENCE = 10.0

#: A slope and its end cannot be seen in fewer.
_FEWEST_OCTAVES = 4

#: Passes of the fit; two or three suffice.
_PASSES = 12

#: Shares that the Allan deviations of a gyro may be off the sum of the parts; the smallest that does is taken.
_MISFITS = (0.0, *(0.01 * 2.0 ** (step / 2.0) for step in range(11)))

#: A combination that is likelier by this, but not by enough to be believed, widens the bounds.
_TEMPTING = 1.0

#: A combination of other parts that is less likely by no more than this is as good an explanation.
_RIVAL = 6.0

#: A description is taken for good if it is off by more with this probability.
_CHANCE = 0.05


def _fit(octaves: _Octaves, places: tuple[int, ...], misfit: float, start: int) -> _Description:
    """Fit a combination of parts by generalized least squares, none negative, with the covariance of the noise that was fitted."""
    both = np.column_stack([octaves.columns[:, places], octaves.variance])
    squares, half = np.zeros(_BEND + 1), np.diag(octaves.variance)
    for _ in range(_PASSES):
        white = np.linalg.solve(half, both)
        size = np.linalg.norm(white[:, :-1], axis=0)
        found = nnls(white[:, :-1] / size, white[:, -1])[0] / size
        if not found.any() or np.allclose(squares[list(places)], found, rtol=1e-4, atol=0.0):
            break
        squares[list(places)] = found
        half = _half(octaves, squares, misfit)
    return _Description(start, octaves, places, squares, half, misfit)


def _half(octaves: _Octaves, squares: Array, misfit: float) -> Array:
    """Return the Cholesky factor of the covariance of the variances, each of which may be off the sum by another share besides."""
    model = octaves.model(squares)
    covariance = octaves.covariance(squares)
    covariance[np.diag_indices(len(model))] += 4.0 * (misfit * model) ** 2
    try:
        return np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        return _nearly_half(covariance, model)


def _nearly_half(covariance: Array, model: Array) -> Array:
    """Return the same for a covariance that is nearly singular, as where a ramp is all there is: correlations are kept away from one."""
    size = np.sqrt(np.maximum(covariance.diagonal(), 1e-12 * model ** 2))
    values, vectors = np.linalg.eigh(covariance / np.outer(size, size))
    return size[:, None] * np.linalg.cholesky((vectors * np.maximum(values, 1e-4)) @ vectors.T)


def _with_short_end(places: tuple[int, ...]) -> list[tuple[int, ...]]:
    """Return a combination of parts as it is, with quantization, and with a bend of its angle random walk."""
    return [places, (*places, _QUANTIZATION)] + ([(*places, _BEND)] if _WALK in places else [])


_COMBINATIONS = [combination for count in range(len(PARTS))
                 for places in itertools.combinations([place for place in range(len(PARTS)) if place != _QUANTIZATION], count)
                 for combination in _with_short_end(places) if combination]


def _describe(octaves: _Octaves) -> list[_Description]:
    """
    Return all combinations of parts, the likeliest first, from the first octave on that chance allows, or else with a misfit.

    What bends the short end fades slowly, so that one octave more is left out than chance asks for.

    """
    last = max(len(octaves.variance) // 2 - 1, 0)
    for misfit in _MISFITS:
        for start in range(last + 1):
            found = _combinations(octaves, start, misfit)
            if found[0].likely():
                return _combinations(octaves, start + 1, misfit) if 0 < start < last else found
    raise DataRefused(f'the Allan deviations are more than {100 * _MISFITS[-1]:.0f} % off any sum of the five kinds of noise: there is '
                      'something else in the record, such as a swing or a vibration; record again at rest')


def _combinations(octaves: _Octaves, start: int, misfit: float) -> list[_Description]:
    """Return all combinations of parts, fitted from an octave on, the likeliest first."""
    since = octaves.since(start)
    return sorted((_fit(since, places, misfit, start) for places in _COMBINATIONS), key=_Description.cost)


def _figures(chart: AllanChart, found: list[_Description]) -> NoiseFit:
    best, tempting = found[0], _tempting(found)
    seen = [place for place in best.held if place != _BEND and (place != _QUANTIZATION or best.start == 0)]
    figures = {part.symbol: _held(best, tempting, place) if place in seen else _absent(best, found, place)
               for place, part in enumerate(PARTS)}
    return NoiseFit({symbol: _in_seconds(figure, chart.interval) for symbol, figure in figures.items()}, chart,
                    float(chart.time[best.start]), float(chart.time[-1]), best.misfit,
                    tuple(sorted({''.join(PARTS[place].symbol for place in each.held if place != _BEND) for each in _rivals(found)})))


def _held(best: _Description, tempting: list[_Description], place: int) -> Figure:
    """Return a figure with bounds that hold whether or not parts are there that the evidence does not suffice for."""
    bounds = [each.bounds(place) for each in tempting if place in each.held]
    lower, upper = min(low for low, _ in bounds), max(high for _, high in bounds)
    value, deviation = math.sqrt(best.squares[place]), best.estimate(best.held)[1][best.held.index(place)]
    return Figure(PARTS[place], value, 0.5 * deviation / value, lower, upper)


def _absent(best: _Description, found: list[_Description], place: int) -> Figure:
    """Return how much of a part there can be besides those that are seen."""
    places = [*(each for each in best.held if each not in (place, _BEND)), place]
    limits = [squares[-1] + 1.96 * deviations[-1] for squares, deviations in (
        each.estimate(places) for each in found if each is best or set(each.held) == set(places))]
    limits += [each.bounds(place)[1] ** 2 for each in _rivals(found) if place in each.held]
    return Figure(PARTS[place], 0.0, math.nan, 0.0, math.sqrt(max(*limits, 0.0)))


def _tempting(found: list[_Description]) -> list[_Description]:
    """Return the best combination with those that are likelier, but not by enough to be believed, or hold a rival's parts too."""
    best = found[0]
    both = [{*best.held, *rival.held} for rival in _rivals(found)]
    return [best, *(each for each in found if each.surprise() < best.surprise() - _TEMPTING or set(each.held) in both)]


def _rivals(found: list[_Description]) -> list[_Description]:
    """Return the combinations of other parts, not more, that are nearly as likely as the best."""
    best = found[0]
    return [each for each in found if each.surprise() < best.surprise() + _RIVAL and len(each.held) <= len(best.held)
            and not set(each.held) - {_BEND, _QUANTIZATION} <= set(best.held)]


def _in_seconds(figure: Figure, interval: float) -> Figure:
    """Return a figure that was found in samples in the part's unit."""
    unit = interval ** -figure.part.slope
    return Figure(figure.part, *(value * unit for value in (figure.value, figure.standard_deviation, figure.lower, figure.upper)))
