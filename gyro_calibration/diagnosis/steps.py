# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Progress of a diagnosis."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import accumulate
from typing import TypeAlias

#: The first step of every diagnosis in time.
CHECKS_STEP = 'checks of the log'
#: Is called with the share of the work done, which never decreases, and the name of the next step.
OnProgress: TypeAlias = Callable[[float, str], object]
#: Is called with the name of the next part.
OnPart: TypeAlias = Callable[[str], object]
#: Share of the rest of a step that is assumed for each part, if their number is not known.
_PART_SHARE = 0.12


class ProgressSteps:
    """
    The steps of a diagnosis, each with its share of the time.

    Parameters
    ----------
    on_progress : is given each step as it begins
    shares : words -> part of the time of a long diagnosis, in order

    """

    def __init__(self, on_progress: OnProgress, shares: Mapping[str, float]) -> None:
        self.on_progress = on_progress
        ends = [end / sum(shares.values()) for end in accumulate(shares.values())]
        self._step_ranges = dict(zip(shares, zip([0.0, *ends], ends)))
        self._done_share = self._step_end = 0.0

    def begin(self, words: str) -> None:
        """Report that a step begins."""
        self._done_share, self._step_end = self._step_ranges[words]
        self.on_progress(self._done_share, words)

    def begin_part(self, words: str) -> None:
        """Report that a part of the step under way begins; how many follow is not known."""
        self.on_progress(self._done_share, words)
        self._done_share += _PART_SHARE * (self._step_end - self._done_share)
