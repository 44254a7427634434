"""Settling: what a gyro still, or already, answers to a ramp is cut off the ends of dwells."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import uniform_filter1d

from gyro_calibration.dwells.samples import Numbers, Samples, duration
from gyro_calibration.dwells.steadiness import Steadiness
from gyro_calibration.heading import integrate
from gyro_calibration.log import Array

#: Where more time than this passes between two dwells, what happened there is not the change from one to the other, s.
_APART = 5.0


def settled(samples: Samples, dwells: Sequence[Numbers], limits: Steadiness) -> tuple[list[Numbers], str]:
    """Cut off both ends of dwells as far as the output answers a ramp there, and the margin at least; say what was cut."""
    time, error = samples.time, samples.error
    change = np.diff([np.median(samples.output[rows]) for rows in dwells])
    apart = np.array([time[later[0]] - time[rows[-1]] for rows, later in zip(dwells, dwells[1:])])
    change = np.where(apart < _APART, change, 0.0)
    mirrored = [(len(time) - 1 - rows)[::-1] for rows in dwells[:-1]]
    after = max(limits.margin, _settling(time, error, dwells[1:], change, limits.settling))
    before = max(limits.margin, _settling(-time[::-1], error[::-1], mirrored, -change, limits.settling))
    kept = [rows[(time[rows] >= time[rows[0]] + after) & (time[rows] <= time[rows[-1]] - before)] for rows in dwells]
    return kept, f'{after:.2f} s after each ramp and {before:.2f} s before the next are cut away'


def _settling(time: Array, error: Array, dwells: Sequence[Numbers], change: Array, longest: float) -> float:
    """Return for how long after a ramp the output is not yet what it stays at, s."""
    durations = np.array([duration(time, rows) for rows in dwells])
    if not len(durations):
        return 0.0
    interval = max(0.05, float(np.median(np.diff(time))))
    bins = int(min(np.quantile(durations, 0.25), 3.0 * longest) / interval)
    edges = np.arange(bins + 1) * interval
    used = durations >= edges[-1]
    if not change[used].any():
        return 0.0
    means = np.array([_binned(time[rows] - time[rows[0]], error[rows], edges) for rows, wanted in zip(dwells, used) if wanted])
    answer = _answer(means, change[used])
    # Bins, and what a few of them show together.
    return max(_last_seen(answer, width) for width in (1, 4)) * interval


def _binned(time: Array, values: Array, edges: Array) -> Array:
    """Return the mean of some values in each bin; bridges gaps."""
    return np.diff(np.interp(edges, time, integrate(time, values))) / np.diff(edges)


def _answer(means: Array, change: Array) -> Array:
    """
    Return the answer to a unit of change in each bin, out of the bins of each dwell, shape (dwells, bins).

    Whatever is linear (a filter, a delay) answers in proportion to the change of rate, so all dwells together show an answer that is
    hidden in the noise of each.

    """
    late = means[:, means.shape[1] // 2:].mean(axis=1, keepdims=True)
    return change @ (means - late) / (change @ change)


def _last_seen(answer: Array, width: int) -> int:
    """
    Return the number of bins until the answer, averaged over some bins, stays within four of its later deviations.

    It is looked for in the first third. Its own scatter in the last half is the measure of what is seen.

    """
    if len(answer) < 8 * width:
        return 0
    smooth = uniform_filter1d(answer, width, mode='nearest')
    # An answer of 20 ppm of the change is not worth a cut, even where no noise hides it.
    spread = max(float(smooth[len(smooth) // 2:].std()), 2e-5)
    last = -1
    for place in np.flatnonzero(np.abs(smooth[:len(smooth) // 3]) > 4.0 * spread):
        # After ten quiet bins it is over; what is seen later is chance.
        last = int(place) if place - last <= 10 else last
    return last + 1 + width // 2 if last >= 0 else 0
