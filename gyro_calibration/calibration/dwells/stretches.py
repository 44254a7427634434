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
Stretches: which rows of a log in time are dwells.

The reference is steady there. Ramps, the settling after them, outliers and repeated samples are
left out.

"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
import math
from typing import NamedTuple

from gyro_calibration.calibration.dwells.samples import (
    duration,
    FEWEST,
    inside,
    listed,
    missing,
    Numbers,
    Samples,
    slope,
    times,
    usable,
)
from gyro_calibration.calibration.dwells.settling import settled
from gyro_calibration.calibration.dwells.steadiness import Steadiness, steady
from gyro_calibration.calibration.dwells.straightness import straight
from gyro_calibration.logs.log import Array, DataRefused, DEGREE, Log, Mask
from gyro_calibration.logs.quality import outliers, repeated_samples, runs
import numpy as np

#: Number of parts of a dwell whose mean temperatures are compared.
_PARTS = 12


class Stretches(NamedTuple):
    """The rows of each dwell, and remarks on samples that were left out."""

    samples: Samples
    rows: list[Numbers]
    remarks: tuple[str, ...]

    @property
    def duration(self) -> float:
        """Return the time in dwells, s."""
        return float(sum(duration(self.samples.time, rows) for rows in self.rows))

    @property
    def share(self) -> float:
        """Return the part of the log that is in dwells."""
        return self.duration / float(self.samples.time[-1] - self.samples.time[0])


def find_stretches(log: Log, limits: Steadiness) -> Stretches:
    """
    Find the dwells by the reference rate, or by the reference heading where more of it is steady.

    Raises
    ------
    DataRefused : output or reference are missing, or the reference is never steady for long enough

    """
    by_rate, by_heading = replace(log, reference_heading=None), replace(log, reference_rate=None)
    if not _known(log.reference_rate):
        found = _found(by_heading, limits)
    elif not _known(log.reference_heading):
        found = _found(by_rate, limits)
    else:
        # A rate derived from the steps of a coarse encoder is hardly ever steady; the heading may
        # be straight.
        found, other = _found(by_rate, limits), _found(by_heading, limits)
        found = found if found.duration > 0.9 * other.duration else other
    if found.share < limits.share:
        raise DataRefused(_not_steady(found, limits))
    if found.share > 0.25:
        return found
    return found._replace(remarks=(
        *found.remarks, f'only {100.0 * found.share:.0f} % of the time is in dwells; --method '
        'likelihood uses all of it, where there is a heading'))


def _known(reference: Array | None) -> bool:
    return reference is not None and bool(np.isfinite(reference).any())


def _not_steady(found: Stretches, limits: Steadiness) -> str:
    line = ('' if found.samples.heading is None
            else f' and straight to {limits.heading / DEGREE:g} deg')
    return (f'the reference is steady to {limits.rate / DEGREE:g} deg/s{line}, for '
            f'{limits.duration:g} s at a time without the settling, in '
            f'{100.0 * found.share:.0f} % of the log; hold each rate for longer, or use the '
            'heading itself with --method likelihood')


def _found(log: Log, limits: Steadiness) -> Stretches:
    """Find the dwells in a log with one reference."""
    samples, lost = usable(log)
    parts = [part for part in _calm(samples, limits)
             if duration(samples.time, part) > limits.duration]
    samples = samples._replace(scale=_scale(samples, parts))
    outlying, repeated = np.zeros((2, len(samples.time)), dtype=bool)
    kept = []
    for part in parts:
        repeated[part] = repeated_samples(samples.output[part])
        fresh = np.arange(part.start, part.stop)[~repeated[part]]
        outlying[fresh] = outliers(samples.error[fresh], limits.outlier)
        kept.append(fresh[~outlying[fresh]])
    whole, cut = settled(samples, kept, limits)
    whole, divided = _divided(samples, whole, limits)
    rows = [part for part in whole
            if len(part) >= FEWEST and duration(samples.time, part) >= limits.duration]
    if short := len(whole) - len(rows):
        lost.append(f'steady stretches shorter than {limits.duration:g} s without the settling, '
                    f'left out: {short}')
    return Stretches(samples, rows, (*lost, cut, *divided,
                                     *_left_out(samples, rows, outlying, repeated),
                                     *missing(log, samples, rows)))


def _left_out(samples: Samples, dwells: list[Numbers], outlying: Mask,
              repeated: Mask) -> Iterator[str]:
    """Yield remarks on the outliers and repeated samples within the dwells."""
    within = inside(samples, dwells)
    places = [f'{time:.2f} s' for time in samples.time[outlying & within]]
    if places:
        yield f'outliers, left out: {len(places)}, at {listed(places)}'
    places = [f'{samples.time[run.start]:.2f} s ({run.stop - run.start} samples)'
              for run in runs(repeated & within)]
    if places:
        yield (f'the output was repeated {times(len(places))}, at {listed(places)}; '
               'the repeats are left out')


def _calm(samples: Samples, limits: Steadiness) -> list[slice]:
    if samples.rate is not None:
        return steady(samples.time, samples.rate, limits)
    assert samples.heading is not None
    return straight(samples.time, samples.heading, limits)


def _scale(samples: Samples, parts: list[slice]) -> float:
    """Return the approximate ratio of output to reference, of any sign and unit."""
    rate = np.array([_rate(samples, part) for part in parts])
    output = np.array([np.median(samples.output[part]) for part in parts])
    # Rests alone do not determine it.
    return slope(rate, output) if len(rate) > 1 and np.ptp(rate) > 1.0 * DEGREE else 1.0


def _rate(samples: Samples, part: slice) -> float:
    if samples.rate is not None:
        return float(samples.rate[part].mean())
    assert samples.heading is not None
    return slope(samples.time[part], samples.heading[part])


def _divided(samples: Samples, dwells: list[Numbers],
             limits: Steadiness) -> tuple[list[Numbers], list[str]]:
    """Divide the dwells in which the temperature changes, so that its slope can be fitted."""
    if samples.temperature is None:
        return dwells, []
    pieces = [_pieces(samples.time[rows], samples.temperature[rows], limits) for rows in dwells]
    parts = [part for rows, number in zip(dwells, pieces) for part in np.array_split(rows, number)]
    more = len(parts) - len(dwells)
    remark = (f'dwells that warmed or cooled by more than {limits.temperature:g} K are divided, '
              f'which makes {more} more')
    return parts, [remark] if more else []


def _pieces(time: Array, temperature: Array, limits: Steadiness) -> int:
    if len(temperature) < 2 * _PARTS:
        return 1
    change = float(np.ptp([part.mean() for part in np.array_split(temperature, _PARTS)]))
    return max(1, min(math.ceil(change / limits.temperature),
                      int((time[-1] - time[0]) / limits.duration)))
