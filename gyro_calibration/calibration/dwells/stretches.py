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
    describe_missing_samples,
    duration,
    fit_slope,
    format_list,
    format_occurrences,
    mark_dwells,
    MIN_DWELL_SAMPLES,
    Numbers,
    Samples,
    select_usable_samples,
)
from gyro_calibration.calibration.dwells.settling import trim_settling
from gyro_calibration.calibration.dwells.steadiness import find_steady_rate, SteadinessLimits
from gyro_calibration.calibration.dwells.straightness import find_straight_heading
from gyro_calibration.logs.log import Array, DataRefused, DEGREE, Log, Mask
from gyro_calibration.logs.quality import find_runs, mask_outliers, mask_repeated_samples
import numpy as np

#: Number of parts of a dwell whose mean temperatures are compared.
_TEMPERATURE_PARTS = 12


class DwellRows(NamedTuple):
    """The rows of each dwell, and remarks on samples that were left out."""

    samples: Samples
    rows: list[Numbers]
    remarks: tuple[str, ...]

    @property
    def dwell_duration(self) -> float:
        """Return the time in dwells, s."""
        return float(sum(duration(self.samples.time, rows) for rows in self.rows))

    @property
    def dwell_share(self) -> float:
        """Return the part of the log that is in dwells."""
        return self.dwell_duration / float(self.samples.time[-1] - self.samples.time[0])


def find_dwell_rows(log: Log, limits: SteadinessLimits) -> DwellRows:
    """
    Find the dwells by the reference rate, or by the reference heading where more of it is steady.

    Raises
    ------
    DataRefused : output or reference are missing, or the reference is never steady for long enough

    """
    by_rate, by_heading = replace(log, reference_heading=None), replace(log, reference_rate=None)
    if not _has_values(log.reference_rate):
        found = _find_by_reference(by_heading, limits)
    elif not _has_values(log.reference_heading):
        found = _find_by_reference(by_rate, limits)
    else:
        # A rate derived from the steps of a coarse encoder is hardly ever steady; the heading may
        # be straight.
        found, other = _find_by_reference(by_rate, limits), _find_by_reference(by_heading, limits)
        found = found if found.dwell_duration > 0.9 * other.dwell_duration else other
    if found.dwell_share < limits.min_dwell_share:
        raise DataRefused(_format_unsteady(found, limits))
    if found.dwell_share > 0.25:
        return found
    return found._replace(
        remarks=(*found.remarks,
                 f'only {100.0 * found.dwell_share:.0f} % of the time is in dwells; '
                 '--method likelihood uses all of it, where there is a heading'))


def _has_values(reference: Array | None) -> bool:
    return reference is not None and bool(np.isfinite(reference).any())


def _format_unsteady(found: DwellRows, limits: SteadinessLimits) -> str:
    line = ('' if found.samples.heading is None
            else f' and straight to {limits.max_heading_deviation / DEGREE:g} deg')
    return (f'the reference is steady to {limits.max_rate_deviation / DEGREE:g} deg/s{line}, for '
            f'{limits.min_duration:g} s at a time without the settling, in '
            f'{100.0 * found.dwell_share:.0f} % of the log; hold each rate for longer, or use the '
            'heading itself with --method likelihood')


def _find_by_reference(log: Log, limits: SteadinessLimits) -> DwellRows:
    """Find the dwells in a log with one reference."""
    samples, lost = select_usable_samples(log)
    parts = [part for part in _find_steady_parts(samples, limits)
             if duration(samples.time, part) > limits.min_duration]
    samples = samples._replace(scale=_estimate_scale(samples, parts))
    is_outlier, is_repeated = np.zeros((2, len(samples.time)), dtype=bool)
    kept = []
    for part in parts:
        is_repeated[part] = mask_repeated_samples(samples.output[part])
        fresh = np.arange(part.start, part.stop)[~is_repeated[part]]
        is_outlier[fresh] = mask_outliers(samples.error[fresh], limits.outlier_threshold)
        kept.append(fresh[~is_outlier[fresh]])
    whole, cut = trim_settling(samples, kept, limits)
    whole, divided = _split_by_temperature(samples, whole, limits)
    rows = [part for part in whole if len(part) >= MIN_DWELL_SAMPLES
            and duration(samples.time, part) >= limits.min_duration]
    if short := len(whole) - len(rows):
        lost.append(f'steady stretches shorter than {limits.min_duration:g} s without the '
                    f'settling, left out: {short}')
    return DwellRows(samples, rows, (*lost, cut, *divided,
                                     *_describe_left_out(samples, rows, is_outlier, is_repeated),
                                     *describe_missing_samples(log, samples, rows)))


def _describe_left_out(samples: Samples, dwells: list[Numbers], is_outlier: Mask,
                       is_repeated: Mask) -> Iterator[str]:
    """Yield remarks on the outliers and repeated samples within the dwells."""
    within = mark_dwells(samples, dwells)
    places = [f'{time:.2f} s' for time in samples.time[is_outlier & within]]
    if places:
        yield f'outliers, left out: {len(places)}, at {format_list(places)}'
    places = [f'{samples.time[run.start]:.2f} s ({run.stop - run.start} samples)'
              for run in find_runs(is_repeated & within)]
    if places:
        yield (f'the output was repeated {format_occurrences(len(places))}, at '
               f'{format_list(places)}; the repeats are left out')


def _find_steady_parts(samples: Samples, limits: SteadinessLimits) -> list[slice]:
    if samples.rate is not None:
        return find_steady_rate(samples.time, samples.rate, limits)
    assert samples.heading is not None
    return find_straight_heading(samples.time, samples.heading, limits)


def _estimate_scale(samples: Samples, parts: list[slice]) -> float:
    """Return the approximate ratio of output to reference, of any sign and unit."""
    rate = np.array([_mean_reference_rate(samples, part) for part in parts])
    output = np.array([np.median(samples.output[part]) for part in parts])
    # Rests alone do not determine it.
    return fit_slope(rate, output) if len(rate) > 1 and np.ptp(rate) > 1.0 * DEGREE else 1.0


def _mean_reference_rate(samples: Samples, part: slice) -> float:
    if samples.rate is not None:
        return float(samples.rate[part].mean())
    assert samples.heading is not None
    return fit_slope(samples.time[part], samples.heading[part])


def _split_by_temperature(samples: Samples, dwells: list[Numbers],
                          limits: SteadinessLimits) -> tuple[list[Numbers], list[str]]:
    """Divide the dwells in which the temperature changes, so that its slope can be fitted."""
    if samples.temperature is None:
        return dwells, []
    pieces = [_count_temperature_parts(samples.time[rows], samples.temperature[rows], limits)
              for rows in dwells]
    parts = [part for rows, number in zip(dwells, pieces) for part in np.array_split(rows, number)]
    more = len(parts) - len(dwells)
    remark = (f'dwells that warmed or cooled by more than {limits.max_temperature_change:g} K are '
              f'divided, which makes {more} more')
    return parts, [remark] if more else []


def _count_temperature_parts(time: Array, temperature: Array, limits: SteadinessLimits) -> int:
    if len(temperature) < 2 * _TEMPERATURE_PARTS:
        return 1
    change = float(
        np.ptp([part.mean() for part in np.array_split(temperature, _TEMPERATURE_PARTS)]))
    return max(1, min(math.ceil(change / limits.max_temperature_change),
                      int((time[-1] - time[0]) / limits.min_duration)))
