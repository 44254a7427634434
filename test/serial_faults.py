# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Faults of a serial line: bytes lost, doubled and flipped, late and in pieces."""

from math import ceil

import numpy as np


def damaged(data, generator, lost=0.0, doubled=0.0, flipped=0.0):
    """Return what arrives of bytes; each is lost, comes twice, or with one of its bits flipped."""
    drawn = generator.random(len(data))
    arrived = np.frombuffer(data, np.uint8).copy()
    struck = (drawn >= lost + doubled) & (drawn < lost + doubled + flipped)
    arrived[struck] ^= (1 << generator.integers(8, size=int(struck.sum()))).astype(np.uint8)
    times = np.where(drawn < lost, 0, np.where(drawn < lost + doubled, 2, 1))
    return np.repeat(arrived, times).tobytes()


def bursts(sent, interval=0.016):
    """Gather what is sent, (s, bytes), in each interval; it comes at its end, as from USB."""
    end, gathered = 0.0, b''
    for due, data in sent:
        own_end = interval * ceil(due / interval - 1e-6)  # rounding must not miss its own interval
        if own_end > end and gathered:
            yield end, gathered
            gathered = b''
        end, gathered = own_end, gathered + data
    yield end, gathered
