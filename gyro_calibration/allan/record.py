# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""A record of a gyro at rest: samples on an even grid, without outliers and motion."""

from __future__ import annotations

from dataclasses import dataclass
import math

from gyro_calibration.calibration.likelihood import CHANCE
from gyro_calibration.logs.log import Array, DataRefused, Mask
from gyro_calibration.logs.quality import robust_deviation, runs
from gyro_calibration.logs.stamps import Integers, LONG, number_stamps, Stamps
import numpy as np
from scipy.signal import medfilt
from scipy.stats import pearsonr

#: The least number of samples for a noise figure.
FEWEST = 100
#: Largest share of lost samples in a window; the variance of its mean changes by at most as much.
LOST_SHARE = 0.01
#: At least so many spans show whether a reference turns with the output: it does if most of the
#: variance is common to both, and is so by chance at rest with at most this probability.
_SPANS, _FOLLOWS = 8, 1e-4
#: Share of a record that may be lost.
_MOST_LOST = 0.3


@dataclass(frozen=True)
class Record:
    """
    Samples of a gyro at rest at even intervals.

    Attributes
    ----------
    rate : rad/s, shape (n,); nan where a sample is lost or left out
    interval : s
    remarks : on bursts, lost samples and outliers, one sentence each

    """

    rate: Array
    interval: float
    remarks: tuple[str, ...] = ()


def even_record(time: Array, output: Array, moving: Array | None = None,
                heading: Array | None = None) -> Record:
    """
    Put samples on an even grid, lost ones marked.

    Parameters
    ----------
    time : stamps, s, increasing, shape (n,)
    output : rad/s, shape (n,); nan counts as lost
    moving : 1 where the log says that the gyro was moved; counts as lost
    heading : by a reference, rad, which shows motion where the log does not say it

    Raises
    ------
    DataRefused : too few samples, a dead gyro, stamps that belong to no even interval, too much
        lost, or motion

    """
    refuse_few(len(output))
    known = np.isfinite(output) if moving is None else np.isfinite(output) & (moving == 0.0)
    _refuse_dead(time[known], output[known])
    stamps = number_stamps(time)
    rate = np.full(int(stamps.number[-1]) + 1, np.nan)
    rate[stamps.number[known]] = output[known]
    remarks = [*stamps.burst_remarks,
               *(f'{remark} Windows with more than {100 * LOST_SHARE:g} % lost are not used.'
                 for remark in stamps.loss_remarks)]
    left_out = int(np.count_nonzero(~known))
    if left_out:
        remarks.append(f'{left_out} samples without output, or moving, are left out.')
    remarks += _remove_outliers(rate, stamps)
    _refuse_motion(rate, stamps)
    if heading is not None and moving is None:
        _refuse_turning(time, output, heading)
    # no window reaches across a long gap, so that it need not be kept in full
    kept = np.ones(len(rate), dtype=bool)
    for gap in runs(np.isnan(rate)):
        kept[gap.start + stamps.longest_gap:gap.stop] = False
    rate = rate[kept]
    share = float(np.isnan(rate).mean())
    if share > _MOST_LOST:
        raise DataRefused(f'{100 * share:.0f} % of the samples are lost or without output; wanted '
                          f'at most {100 * _MOST_LOST:.0f} %: record again, or give --rate where '
                          'the stamps are no use')
    return Record(rate, stamps.interval, tuple(remarks))


def refuse_few(count: int, samples: str = 'samples') -> None:
    """Refuse fewer samples than a noise figure needs."""
    if count < FEWEST:
        raise DataRefused(f'{count} {samples}; an Allan deviation needs at least {FEWEST}: '
                          'record longer')


def _refuse_turning(time: Array, output: Array, heading: Array) -> None:
    """Refuse a record whose reference turns with the output over spans of some length."""
    sums = np.concatenate([[0.0], np.nancumsum(output)])
    duration = time[-1] - time[0]
    shortest, longest = max(1.0, duration / len(time)), duration / _SPANS
    for span in np.geomspace(shortest, longest, 1 + int(np.log2(max(longest / shortest, 1.0)))):
        ends = np.searchsorted(time, np.arange(time[0], time[-1], span))
        mean, change = np.diff(sums[ends]) / np.maximum(np.diff(ends), 1), np.diff(heading[ends])
        known = np.isfinite(change)
        both = np.stack([mean[known], change[known]])
        if known.sum() < _SPANS or (np.ptp(both, axis=1) <= 1e-9 * np.abs(both).max(axis=1)).any():
            continue
        correlation, chance = pearsonr(*both)
        if correlation ** 2 > 0.5 and chance < _FOLLOWS:
            raise DataRefused(
                f'the reference heading turns with the output ({100.0 * correlation ** 2:.0f} % '
                f'of the variance of means over {span:g} s): the gyro was moved; give a part at '
                'rest by --from and --to, or record one')


def _refuse_dead(time: Array, output: Array) -> None:
    """Refuse an output that stays the same for a tenth of the record."""
    refuse_few(len(output), 'samples at rest with an output')
    changes = np.nonzero(np.concatenate([[True], np.diff(output) != 0.0, [True]]))[0]
    longest = int(np.argmax(np.diff(changes)))
    count = int(np.diff(changes)[longest])
    if count > max(len(output) // 10, 50):
        raise DataRefused(f'the gyro gives the same value {count} times in a row from '
                          f'{time[changes[longest]]:g} s on: it is dead or its steps are coarser '
                          'than its noise; check it, and record again')


def _remove_outliers(rate: Array, stamps: Stamps) -> list[str]:
    """
    Take out single samples far beyond the noise, and return a remark on them.

    A motion or a jolt lasts longer than two samples.

    """
    values = _filled(rate)
    off = np.abs(values - medfilt(values, 5))
    off[:2] = off[-2:] = 0.0
    # not the median: where the output walks, half of these are zero
    usual = float(np.quantile(off, 0.9)) / 1.645 or _scale(off)
    outliers = np.nonzero(off > 1.25 * CHANCE * usual)[0]
    if not outliers.size or outliers.size > 0.001 * len(rate):
        return []
    rate[outliers] = np.nan
    return [f'Far beyond the noise, and left out: {outliers.size} single '
            f'sample{"s" * (outliers.size > 1)}, the first at {stamps.at(outliers[0]):.3f} s.']


def _scale(values: Array) -> float:
    """Return the standard deviation of Gaussian values; the rms where most of them are zero."""
    return robust_deviation(values) or float(np.sqrt(np.mean(values ** 2)))


def _refuse_motion(rate: Array, stamps: Stamps) -> None:
    """Refuse a record whose means change by more than noise; give the place and longest rest."""
    angle, lost = angle_of(rate), lost_before(rate)
    moved, worst, over = np.zeros(len(rate), dtype=bool), 0.0, 0
    for size in (2 ** octave for octave in range(max(int(math.log2(len(rate) / LONG)), 0))):
        # changes of the mean over `size` samples, times `size`
        end, step = len(angle) - 2 * size, max(1, size // 4)
        at = np.arange(0, end, step)
        if lost is not None:
            at = at[whole(lost, size, 0, end, step)]
        if len(at) < LONG:
            break
        change = np.abs(angle[at + 2 * size] - 2.0 * angle[at + size] + angle[at])
        scale = _scale(change)
        for begin in at[change > CHANCE * scale]:
            moved[begin:begin + 2 * size] = True
        if change.max() > worst * scale:
            worst, over = float(change.max() / scale), size
    if not moved.any():
        return
    rests = max(runs(~moved), key=lambda rest: rest.stop - rest.start, default=None)
    longest = ('at rest nowhere' if rests is None else
               f'at rest longest from {stamps.at(rests.start):.1f} '
               f'to {stamps.at(rests.stop - 1):.1f} s')
    raise DataRefused(
        f'the gyro was moved, or its output jumped: from {stamps.at(int(np.argmax(moved))):.2f} s '
        f'on means over {over * stamps.interval:.3g} s change up to {worst:.0f} standard '
        f'deviations; it is {longest}: use that part, or record again')


# lost samples

def angle_of(rate: Array) -> Array:
    """
    Return the angle before each sample and after the last, less the mean rate, shape (n + 1,).

    It is in rate units times samples.

    """
    angle = np.empty(len(rate) + 1)
    angle[0] = 0.0
    np.cumsum(_filled(rate), out=angle[1:])
    return angle


def _filled(rate: Array) -> Array:
    """Return the rate less its mean; a gap gets the mean of five times its length on each side."""
    known = np.isfinite(rate)
    values = rate - rate[known].mean()
    if known.all():
        return values
    values[~known] = 0.0
    begins, ends = np.array([(gap.start, gap.stop) for gap in runs(~known)]).T
    margin = 5 * (ends - begins) + 5
    low, high = np.maximum(begins - margin, 0), np.minimum(ends + margin, len(rate))
    sums, counts = (np.concatenate([[0.0], np.cumsum(each)]) for each in (values, known))
    means = (sums[high] - sums[low]) / np.maximum(counts[high] - counts[low], 1.0)
    values[~known] = np.repeat(means, ends - begins)
    return values


def lost_before(rate: Array) -> Integers | None:
    """Return how many samples are lost before each one, shape (n + 1,), or None without losses."""
    lost = np.isnan(rate)
    return np.concatenate([[0], np.cumsum(lost)]) if lost.any() else None


def whole(lost: Integers, size: int, begin: int, end: int, step: int = 1) -> Mask:
    """
    Return which second differences over `size` samples, from `begin` to `end`, miss few samples.

    `lost` is the result of `lost_before`.

    """
    return np.asarray(lost[begin + 2 * size:end + 2 * size:step] - lost[begin:end:step]
                      <= LOST_SHARE * 2 * size)
