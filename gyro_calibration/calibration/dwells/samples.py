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
from gyro_calibration.logs.quality import find_runs
from gyro_calibration.logs.stamps import count_lost_samples
from gyro_calibration.logs.stamps import Integers as Numbers
import numpy as np
from scipy.ndimage import maximum_filter1d

#: Minimum number of samples of a dwell.
MIN_DWELL_SAMPLES = 8
#: Longest interval between two values of a reference with none lost, in median intervals.
_MAX_INTERVAL_RATIO = 1.5
#: Longer intervals than this are not used for the sample rate, s.
_MAX_SAMPLE_INTERVAL = 1.0


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


def select_usable_samples(log: Log) -> tuple[Samples, list[str]]:
    """Return the samples with output and reference, none near a lost reference, and remarks."""
    output, time = require_output(log), log.time
    reference = log.reference_heading if log.reference_rate is None else log.reference_rate
    if time is None or reference is None:
        raise DataRefused('the log has no time or no reference; to find dwells it needs time_s '
                          'and one of reference_rate_dps and reference_heading_deg')
    known = np.isfinite(reference)
    lost = find_lost_reference(known)
    # A reference has errors up to 0.05 s before and after a loss: motion capture loses its markers
    # one by one.
    good = np.flatnonzero(~maximum_filter1d(lost, 2 * count_samples(time, 0.05) + 1)
                          & known & np.isfinite(output))
    if len(good) < MIN_DWELL_SAMPLES:
        raise DataRefused(f'{len(good)} of {len(time)} samples hold both a gyro output and '
                          'a reference; check the columns')
    rate, heading, temperature = (
        None if values is None else values[good]
        for values in (log.reference_rate, log.reference_heading, log.temperature))
    places = [f'{time[run.start]:.2f} s' for run in find_runs(lost)]
    remark = (f'the reference was lost {format_occurrences(len(places))}, for {lost.sum()} '
              f'samples, at {format_list(places)}; they are left out')
    return (Samples(time[good], output[good], rate, heading, temperature),
            [remark] if places else [])


def find_lost_reference(known: Mask) -> Mask:
    """Mark samples without a reference, where its values are above 1.5 median intervals apart."""
    apart = np.diff(np.flatnonzero(known), prepend=-1, append=len(known))
    usual = float(np.median(apart[1:-1])) if len(apart) > 2 else 1.0
    lost = ~known
    lost[~known] = np.repeat(apart > _MAX_INTERVAL_RATIO * usual, apart - 1)
    return lost


def interpolate_reference(time: Array, values: Array) -> Array:
    """Return a slow reference at each sample, linear between its values; nan where it is lost."""
    known = np.isfinite(values)
    if known.all() or not known.any():
        return values
    return np.where(find_lost_reference(known), np.nan,
                    np.interp(time, time[known], values[known], np.nan, np.nan))


def require_output(log: Log) -> Array:
    """Return the output of a log, or refuse it."""
    if log.output is None:
        raise DataRefused('the log holds no gyro output in rad/s; with gyro_counts alone, say how '
                          'many deg/s a count is')
    return log.output


def describe_missing_samples(log: Log, samples: Samples,
                             dwells: Sequence[Numbers]) -> Iterator[str]:
    """Yield a remark on lost gyro samples within the dwells, or on stamps too irregular."""
    assert log.time is not None and log.output is not None
    time = log.time[np.isfinite(log.output)]
    lost = count_lost_samples(time)
    if lost is None:
        yield 'the stamps are too irregular to count lost samples'
        return
    gaps = np.flatnonzero(
        (lost > 0) & (np.interp(time[1:], samples.time, mark_dwells(samples, dwells)) > 0.5))
    if len(gaps):
        yield (f'samples missing within the dwells: {lost[gaps].sum()}, '
               f'after {format_list([f"{time[gap]:.2f} s" for gap in gaps])}; at a '
               'constant rate the means are not affected')


def mark_dwells(samples: Samples, dwells: Sequence[Numbers]) -> Mask:
    """Mark the samples within dwells, including those that were left out of them."""
    in_dwells = np.zeros(len(samples.time), dtype=bool)
    for rows in dwells:
        in_dwells[rows[0]:rows[-1] + 1] = True
    return in_dwells


def duration(time: Array, part: slice | Numbers) -> float:
    """Return the time from the first to the last sample of a part of a log, s."""
    within = time[part]
    return float(within[-1] - within[0])


def count_samples(time: Array, span: float) -> int:
    """Return the number of samples in a span by the mean interval; stamps may come in bursts."""
    steps = np.diff(time)
    return (round(span / float(steps[steps < _MAX_SAMPLE_INTERVAL].mean()))
            if (steps < _MAX_SAMPLE_INTERVAL).any() else 0)


def fit_slope(x: Array, values: Array) -> float:
    """Return the slope of the straight line through some values."""
    centred = x - x.mean()
    return float(centred @ values / (centred @ centred))


def format_occurrences(number: int) -> str:
    """Return 'once', or the number and 'times'."""
    return 'once' if number == 1 else f'{number} times'


def format_list(items: Sequence[str], limit: int = 5) -> str:
    """Return the first words, separated by commas, and the number of further ones."""
    return ', '.join(items[:limit]) + (
        f' and {len(items) - limit} more' if len(items) > limit else '')
