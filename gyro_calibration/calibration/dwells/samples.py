# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Samples: the usable part of a log in time, and small functions for the search for dwells."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from gyro_calibration.logs.log import Array, DataRefused, Log, Mask
from gyro_calibration.logs.quality import runs
from gyro_calibration.logs.stamps import Integers as Numbers
from gyro_calibration.logs.stamps import lost_samples
import numpy as np
from scipy.ndimage import maximum_filter1d

#: Minimum number of samples of a dwell.
FEWEST = 8
#: Longest interval between two values of a reference with none lost, in median intervals.
_LOST = 1.5
#: Longer intervals than this are not used for the sample rate, s.
_PAUSE = 1.0


class Samples(NamedTuple):
    """Samples with output and reference, the latter a rate or a heading."""

    time: Array
    output: Array
    rate: Array | None
    heading: Array | None
    temperature: Array | None
    scale: float = 1.0

    @property
    def error(self) -> Array:
        """Return the output, less the share of a reference rate: it is steady in a dwell."""
        return self.output if self.rate is None else self.output - self.scale * self.rate


def usable(log: Log) -> tuple[Samples, list[str]]:
    """Return the samples with output and reference, none near a lost reference, and remarks."""
    output, time = output_of(log), log.time
    reference = log.reference_heading if log.reference_rate is None else log.reference_rate
    if time is None or reference is None:
        raise DataRefused('the log has no time or no reference; to find dwells it needs time_s '
                          'and one of reference_rate_dps and reference_heading_deg')
    known = np.isfinite(reference)
    lost = where_lost(known)
    # A reference has errors up to 0.05 s before and after a loss: motion capture loses its markers
    # one by one.
    good = np.flatnonzero(~maximum_filter1d(lost, 2 * count(time, 0.05) + 1)
                          & known & np.isfinite(output))
    if len(good) < FEWEST:
        raise DataRefused(f'{len(good)} of {len(time)} samples hold both a gyro output and '
                          'a reference; check the columns')
    rate, heading, temperature = (
        None if values is None else values[good]
        for values in (log.reference_rate, log.reference_heading, log.temperature))
    places = [f'{time[run.start]:.2f} s' for run in runs(lost)]
    remark = (f'the reference was lost {times(len(places))}, for {lost.sum()} samples, '
              f'at {listed(places)}; they are left out')
    return (Samples(time[good], output[good], rate, heading, temperature),
            [remark] if places else [])


def where_lost(known: Mask) -> Mask:
    """Mark samples without a reference, where its values are above 1.5 median intervals apart."""
    apart = np.diff(np.flatnonzero(known), prepend=-1, append=len(known))
    usual = float(np.median(apart[1:-1])) if len(apart) > 2 else 1.0
    lost = ~known
    lost[~known] = np.repeat(apart > _LOST * usual, apart - 1)
    return lost


def between_values(time: Array, values: Array) -> Array:
    """Return a slow reference at each sample, linear between its values; nan where it is lost."""
    known = np.isfinite(values)
    if known.all() or not known.any():
        return values
    return np.where(where_lost(known), np.nan,
                    np.interp(time, time[known], values[known], np.nan, np.nan))


def output_of(log: Log) -> Array:
    """Return the output of a log, or refuse it."""
    if log.output is None:
        raise DataRefused('the log holds no gyro output in rad/s; with gyro_counts alone, say how '
                          'many deg/s a count is')
    return log.output


def missing(log: Log, samples: Samples, dwells: Sequence[Numbers]) -> Iterator[str]:
    """Yield a remark on lost gyro samples within the dwells, or on stamps too irregular."""
    assert log.time is not None and log.output is not None
    time = log.time[np.isfinite(log.output)]
    lost = lost_samples(time)
    if lost is None:
        yield 'the stamps are too irregular to count lost samples'
        return
    gaps = np.flatnonzero((lost > 0) & (
        np.interp(time[1:], samples.time, inside(samples, dwells)) > 0.5))
    if len(gaps):
        yield (f'samples missing within the dwells: {lost[gaps].sum()}, '
               f'after {listed([f"{time[gap]:.2f} s" for gap in gaps])}; at a '
               'constant rate the means are not affected')


def inside(samples: Samples, dwells: Sequence[Numbers]) -> Mask:
    """Mark the samples within dwells, including those that were left out of them."""
    mask = np.zeros(len(samples.time), dtype=bool)
    for rows in dwells:
        mask[rows[0]:rows[-1] + 1] = True
    return mask


def duration(time: Array, part: slice | Numbers) -> float:
    """Return the time from the first to the last sample of a part of a log, s."""
    within = time[part]
    return float(within[-1] - within[0])


def count(time: Array, span: float) -> int:
    """Return the number of samples in a span by the mean interval; stamps may come in bursts."""
    steps = np.diff(time)
    return round(span / float(steps[steps < _PAUSE].mean())) if (steps < _PAUSE).any() else 0


def slope(place: Array, values: Array) -> float:
    """Return the slope of the straight line through some values."""
    centred = place - place.mean()
    return float(centred @ values / (centred @ centred))


def times(number: int) -> str:
    """Return 'once', or the number and 'times'."""
    return 'once' if number == 1 else f'{number} times'


def listed(words: Sequence[str], most: int = 5) -> str:
    """Return the first words, separated by commas, and the number of further ones."""
    return ', '.join(words[:most]) + (
        f' and {len(words) - most} more' if len(words) > most else '')
