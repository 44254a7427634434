# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Cleaning: outliers and repeated samples of a gyro, left out of a stretch of steady rate."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import math
from typing import NamedTuple

from gyro_calibration.calibration.dwells.samples import (
    code_step,
    inside,
    length,
    listed,
    Numbers,
    runs,
    Samples,
    times,
)
from gyro_calibration.logs.log import Array, Mask
import numpy as np


class Cleaned(NamedTuple):
    """The rows of a stretch, and those that are left out of it."""

    rows: Numbers
    wild: Numbers
    stuck: Numbers


def clean(samples: Samples, part: slice, limit: float) -> Cleaned:
    """Divide the rows of a stretch; outliers are beyond `limit` robust standard deviations."""
    rows = np.arange(part.start, part.stop)
    stuck = _stuck(samples.output[part])
    moving = rows[~stuck]
    wild = _wild(samples.error[moving], limit)
    return Cleaned(moving[~wild], moving[wild], rows[stuck])


def left_out(samples: Samples, dwells: Sequence[Numbers],
             cleaned: Sequence[Cleaned]) -> Iterator[str]:
    """Yield remarks on the outliers and repeated samples within the dwells."""
    within = inside(samples, dwells)
    wild = [row for part in cleaned for row in part.wild if within[row]]
    if wild:
        yield (f'wild samples, left out: {len(wild)}, at '
               f'{listed([f"{samples.time[row]:.2f} s" for row in wild])}')
    stuck = np.zeros(len(within), dtype=bool)
    stuck[[row for part in cleaned for row in part.stuck]] = True
    places = [f'{samples.time[run.start]:.2f} s ({length(run)} samples)'
              for run in runs(stuck & within)]
    if places:
        yield (f'the output was stuck {times(len(places))}, at {listed(places)}; '
               'the repeats are left out')


def _wild(error: Array, limit: float) -> Mask:
    """Mark single samples far from their neighbours and the median; not drift or vibration."""
    if len(error) < 4:
        return np.zeros(len(error), dtype=bool)
    # The median of six neighbours resists two outliers among them.
    edged = np.pad(error, 3, mode='reflect')
    alone = error - np.median([edged[place:place + len(error)]
                               for place in (0, 1, 2, 4, 5, 6)], axis=0)
    # An output of few codes mostly equals its neighbours; then the limit is in codes.
    least = max(code_step(error), 1e-9)
    return _far(alone, limit, least) & _far(error - np.median(error), limit, least)


def _far(values: Array, limit: float, least: float) -> Mask:
    return np.abs(values) > limit * max(1.4826 * float(np.median(np.abs(values))), least)


def _stuck(output: Array) -> Mask:
    """Mark the repeats in runs of one value that are too long for its share of the stretch."""
    stuck = np.zeros(len(output), dtype=bool)
    share = np.unique(output, return_counts=True)[1].max() / len(output)
    # Mostly one value: a gyro of coarse codes at rest, or a simulation without noise. It cannot be
    # distinguished from a gyro that repeats samples.
    if share > 0.9:
        return stuck
    longest = math.log(1e-6 / len(output)) / math.log(share)
    for run in runs(np.concatenate([[False], np.diff(output) == 0.0])):
        stuck[run] = length(run) > longest
    return stuck
