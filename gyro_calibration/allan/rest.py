# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Refuse what is no gyro at rest: a dead gyro, motion; take out outliers."""

from __future__ import annotations

import math

from gyro_calibration.allan.angle import (
    angle_of,
    filled,
    gaps,
    Integers,
    lost_before,
    refuse_few,
    Truths,
    whole,
)
from gyro_calibration.calibration.likelihood import CHANCE
from gyro_calibration.logs.log import Array, DataRefused
from gyro_calibration.logs.stamps import LONG, Stamps
import numpy as np
from scipy.signal import medfilt


def refuse_dead(time: Array, output: Array) -> None:
    """Refuse an output that stays the same for a tenth of the record."""
    refuse_few(len(output), 'samples at rest with an output')
    changes = np.nonzero(np.concatenate([[True], np.diff(output) != 0.0, [True]]))[0]
    longest = int(np.argmax(np.diff(changes)))
    count = int(np.diff(changes)[longest])
    if count > max(len(output) // 10, 50):
        raise DataRefused(f'the gyro gives the same value {count} times in a row from '
                          f'{time[changes[longest]]:g} s on: it is dead or its steps are coarser '
                          'than its noise; check it, and record again')


def leave_out_wild_samples(rate: Array, stamps: Stamps) -> list[str]:
    """
    Take out single samples far beyond the noise, and return a remark on them.

    A motion or a jolt lasts longer than two samples.

    """
    values = filled(rate)
    off = np.abs(values - medfilt(values, 5))
    off[:2] = off[-2:] = 0.0
    # not the median: where the output walks, half of these are zero
    usual = float(np.quantile(off, 0.9)) / 1.645 or _scale(off)
    wild = np.nonzero(off > 1.25 * CHANCE * usual)[0]
    if not wild.size or wild.size > 0.001 * len(rate):
        return []
    rate[wild] = np.nan
    first = stamps.at(wild[0])
    return [f'Far beyond the noise, and left out: {wild.size} single '
            f'sample{"s" * (wild.size > 1)}, the first at {first:.3f} s.']


def _scale(size: Array) -> float:
    """Return the standard deviation of Gaussian values, most of which have these sizes."""
    return 1.4826 * float(np.median(size)) or float(np.sqrt(np.mean(size ** 2)))


def refuse_motion(rate: Array, stamps: Stamps) -> None:
    """Refuse a record whose means change by more than noise; give the place and longest rest."""
    moved, worst, over = _motion(rate)
    if not moved.any():
        return
    first, window = int(np.argmax(moved)), over * stamps.interval
    raise DataRefused(
        f'the gyro was moved, or its output jumped: from {stamps.at(first):.2f} s on means over '
        f'{window:.3g} s change up to {worst:.0f} standard deviations; it is '
        f'{_longest_rest(moved, stamps)}: use that part, or record again')


def _motion(rate: Array) -> tuple[Truths, float, int]:
    """Return which samples are in motion, the largest change of a mean in sigma, its window."""
    angle, lost = angle_of(rate), lost_before(rate)
    moved, worst, over = np.zeros(len(rate), dtype=bool), 0.0, 0
    for size in (2 ** octave for octave in range(max(int(math.log2(len(rate) / LONG)), 0))):
        at, change = _changes(angle, lost, size)
        if len(at) < LONG:
            break
        scale = _scale(change)
        for begin in at[change > CHANCE * scale]:
            moved[begin:begin + 2 * size] = True
        if change.max() > worst * scale:
            worst, over = float(change.max() / scale), size
    return moved, worst, over


def _changes(angle: Array, lost: Integers | None, size: int) -> tuple[Integers, Array]:
    """Return where means over `size` samples are compared, and their changes times `size`."""
    end, step = len(angle) - 2 * size, max(1, size // 4)
    at = np.arange(0, end, step)
    if lost is not None:
        at = at[whole(lost, size, 0, end, step)]
    return at, np.abs(angle[at + 2 * size] - 2.0 * angle[at + size] + angle[at])


def _longest_rest(moved: Truths, stamps: Stamps) -> str:
    begins, ends = gaps(moved)
    if not begins.size:
        return 'at rest nowhere'
    longest = int(np.argmax(ends - begins))
    return (f'at rest longest from {stamps.at(begins[longest]):.1f} '
            f'to {stamps.at(ends[longest] - 1):.1f} s')
