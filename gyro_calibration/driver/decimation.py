# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The mean of several samples in place of each: a gyro of 11 kHz would flood a graph."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from gyro_calibration.driver.protocols import Sample


class Mean(NamedTuple):
    """The mean stamp, s, and the mean sample, of a number of samples."""

    stamp: float
    sample: Sample
    size: int


class Decimation:
    """
    Joins samples in groups; where samples are lost, a group has fewer and is not longer.

    Parameters
    ----------
    size : samples of a group; 1 leaves them as they are

    """

    def __init__(self, size: int):
        self._size = size
        self._group: list[tuple[float, Sample]] = []

    def add(self, samples: Sequence[Sample], stamps: Sequence[float],
            period: float) -> Iterator[Mean]:
        """Take samples with their stamps and the period of the gyro, s; give complete groups."""
        longest = (self._size - 0.5) * period
        for sample, stamp in zip(samples, stamps, strict=True):
            if self._group and not 0.0 < stamp - self._group[0][0] < longest:
                yield from self.flush()
            self._group.append((stamp, sample))
            if len(self._group) >= self._size:
                yield from self.flush()

    def flush(self) -> Iterator[Mean]:
        """Give a group that has begun: it must not wait where the next sample is not in sight."""
        if not self._group:
            return
        group, self._group = self._group, []
        if len(group) == 1:
            yield Mean(*group[0], 1)
            return
        begin = group[0][0]  # seconds since 1970 added up would lose digits
        samples = [sample for _, sample in group]
        yield Mean(
            begin + _mean([stamp - begin for stamp, _ in group]),
            Sample(_mean([sample.output for sample in samples]),
                   _known_mean([sample.temperature for sample in samples]),
                   specific_force=_known_mean([sample.specific_force for sample in samples])),
            len(group))


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)


def _known_mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return _mean(known) if known else None
