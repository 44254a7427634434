"""Samples: what of a log in time can be used, and the small questions that all parts of the search for dwells ask of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter1d

from gyro_calibration.log import Array, DataRefused, Log, Mask
from gyro_calibration.stamps import Integers as Numbers
from gyro_calibration.stamps import lost_samples

#: Samples that a dwell holds at least.
FEWEST = 8
#: Values of a reference that are further apart than so many usual intervals have lost some in between.
_LOST = 1.5
#: Longer intervals than this say nothing of the sample rate, s.
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
        """Return what is steady in a dwell: the output, less what a reference rate explains of it."""
        return self.output if self.rate is None else self.output - self.scale * self.rate


def usable(log: Log) -> tuple[Samples, list[str]]:
    """Return the samples that have output and reference, not too near to where the reference was lost, and what was lost."""
    output, time = output_of(log), log.time
    reference = log.reference_heading if log.reference_rate is None else log.reference_rate
    if time is None or reference is None:
        raise DataRefused('the log has no time or no reference; to find dwells it needs time_s and one of reference_rate_dps and '
                          'reference_heading_deg')
    known = np.isfinite(reference)
    lost = where_lost(known)
    # A reference that gets lost errs before and after; the tracker loses its markers one by one.
    good = np.flatnonzero(~maximum_filter1d(lost, 2 * count(time, 0.05) + 1) & known & np.isfinite(output))
    if len(good) < FEWEST:
        raise DataRefused(f'{len(good)} of {len(time)} samples hold both a gyro output and a reference; look at the columns')
    rate, heading, temperature = (None if values is None else values[good]
                                  for values in (log.reference_rate, log.reference_heading, log.temperature))
    return Samples(time[good], output[good], rate, heading, temperature), list(_lost_reference(time, lost))


def where_lost(known: Mask) -> Mask:
    """Tell where a reference was lost: its values are further apart there than most of them, for it may be slower than the gyro."""
    apart = np.diff(np.flatnonzero(known), prepend=-1, append=len(known))
    usual = float(np.median(apart[1:-1])) if len(apart) > 2 else 1.0
    lost = ~known
    lost[~known] = np.repeat(apart > _LOST * usual, apart - 1)
    return lost


def between_values(time: Array, values: Array) -> Array:
    """Return a reference that is slower than the gyro at each sample, on the line between two values; nan where it was lost."""
    known = np.isfinite(values)
    if known.all() or not known.any():
        return values
    return np.where(where_lost(known), np.nan, np.interp(time, time[known], values[known], np.nan, np.nan))


def output_of(log: Log) -> Array:
    """Return the output of a log, or refuse it."""
    if log.output is None:
        raise DataRefused('the log holds no gyro output in rad/s; with gyro_counts alone, say how many deg/s a count is')
    return log.output


def _lost_reference(time: Array, lost: Mask) -> Iterator[str]:
    places = [f'{time[run.start]:.2f} s' for run in runs(lost)]
    if places:
        yield f'the reference was lost {times(len(places))}, for {lost.sum()} samples, at {listed(places)}; they are left out'


def missing(log: Log, samples: Samples, dwells: Sequence[Numbers]) -> Iterator[str]:
    """Say how many samples of the gyro are missing within the dwells, where the stamps are regular enough to tell."""
    assert log.time is not None and log.output is not None
    time = log.time[np.isfinite(log.output)]
    lost = lost_samples(time)
    if lost is None:
        yield 'the stamps are too irregular to count lost samples'
        return
    gaps = np.flatnonzero((lost > 0) & (np.interp(time[1:], samples.time, inside(samples, dwells)) > 0.5))
    if len(gaps):
        yield (f'samples missing within the dwells: {lost[gaps].sum()}, after {listed([f"{time[gap]:.2f} s" for gap in gaps])}; at a '
               'steady rate that does no harm')


def inside(samples: Samples, dwells: Sequence[Numbers]) -> Mask:
    """Mark the samples within dwells, those that were left out of them too."""
    mask = np.zeros(len(samples.time), dtype=bool)
    for rows in dwells:
        mask[rows[0]:rows[-1] + 1] = True
    return mask


def duration(time: Array, part: slice | Numbers) -> float:
    """Return the time from the first to the last sample of a part of a log, s."""
    within = time[part]
    return float(within[-1] - within[0])


def count(time: Array, span: float) -> int:
    """Return the number of samples in a span, by the mean interval: stamps that come in bursts have no typical one."""
    steps = np.diff(time)
    return round(span / float(steps[steps < _PAUSE].mean())) if (steps < _PAUSE).any() else 0


def code_step(values: Array) -> float:
    """Return the step of an encoder, or of any digital output, from the values that occur; next to nothing where it has no steps."""
    # Rounding in the file splits a step in two sizes, and fast turns leave codes out: neither the smallest nor the middle gap is it.
    gaps = np.diff(np.unique(values))
    gaps = gaps[gaps > 1e-9]
    return float(np.quantile(gaps, 0.05)) if len(gaps) else 0.0


def slope(place: Array, values: Array) -> float:
    """Return the slope of the straight line through some values."""
    centred = place - place.mean()
    return float(centred @ values / (centred @ centred))


def runs(mask: Mask) -> list[slice]:
    """Return each run of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask, [0]])))
    return [slice(int(start), int(stop)) for start, stop in zip(edges[::2], edges[1::2])]


def length(part: slice) -> int:
    """Return the number of samples in a slice."""
    return int(part.stop - part.start)


def times(number: int) -> str:
    """Return how often, in words."""
    return 'once' if number == 1 else f'{number} times'


def listed(words: Sequence[str], most: int = 5) -> str:
    """Return the first of some words, and how many more there are."""
    return ', '.join(words[:most]) + (f' and {len(words) - most} more' if len(words) > most else '')
