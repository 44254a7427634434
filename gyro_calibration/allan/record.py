# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""A record of a gyro at rest: samples on an even grid, lost ones marked."""

from __future__ import annotations

from dataclasses import dataclass

from gyro_calibration.allan.angle import gaps, LOST_SHARE, refuse_few
from gyro_calibration.allan.rest import leave_out_wild_samples, refuse_dead, refuse_motion
from gyro_calibration.logs.log import Array, DataRefused
from gyro_calibration.logs.stamps import number_stamps, Stamps
import numpy as np

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


def even_record(time: Array, output: Array, moving: Array | None = None) -> Record:
    """
    Put samples on an even grid, lost ones marked.

    Parameters
    ----------
    time : stamps, s, increasing, shape (n,)
    output : rad/s, shape (n,); nan counts as lost
    moving : 1 where the log says that the gyro was moved; counts as lost

    Raises
    ------
    DataRefused : too few samples, a dead gyro, stamps that belong to no even interval, too much
        lost, or motion

    """
    refuse_few(len(output))
    known = np.isfinite(output) if moving is None else np.isfinite(output) & (moving == 0.0)
    refuse_dead(time[known], output[known])
    stamps = number_stamps(time)
    rate = np.full(int(stamps.number[-1]) + 1, np.nan)
    rate[stamps.number[known]] = output[known]
    remarks = [*stamps.said_of_bursts, *_said_of_lost(stamps),
               *_said_of_left_out(int(np.count_nonzero(~known))),
               *leave_out_wild_samples(rate, stamps)]
    refuse_motion(rate, stamps)
    rate = _shortened(rate, stamps.longest_gap)
    _refuse_tatters(rate)
    return Record(rate, stamps.interval, tuple(remarks))


def _said_of_lost(stamps: Stamps) -> list[str]:
    return [f'{said} Windows with more than {100 * LOST_SHARE:g} % lost are not used.'
            for said in stamps.said_of_lost]


def _said_of_left_out(count: int) -> list[str]:
    return [f'{count} samples without output, or moving, are left out.'] if count else []


def _shortened(rate: Array, longest: int) -> Array:
    """Return the samples with long gaps cut down; no window reaches across them in any case."""
    begins, ends = gaps(np.isfinite(rate))
    kept = np.ones(len(rate), dtype=bool)
    for begin, end in zip(begins + longest, ends):
        kept[begin:end] = False
    return rate[kept]


def _refuse_tatters(rate: Array) -> None:
    share = float(np.isnan(rate).mean())
    if share > _MOST_LOST:
        raise DataRefused(f'{100 * share:.0f} % of the samples are lost or without output; wanted '
                          f'at most {100 * _MOST_LOST:.0f} %: record again, or give --rate where '
                          'the stamps are no use')
