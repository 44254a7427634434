# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Faults of a serial line: samples and bytes lost, doubled and flipped, late and in pieces."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from math import ceil

import numpy as np

_BITS_PER_BYTE = 10  # 8 data bits, a start and a stop bit
_ROUNDING = 1e-6  # of an interval between bursts; a sample may seem to come just after one

_PROBABILITIES = ('lost_samples', 'invalid_samples',
                  'lost_bytes', 'doubled_bytes', 'flipped_bytes')


@dataclass(frozen=True)
class SerialFaults:
    """
    The faults of a serial line; the default has none.

    Attributes
    ----------
    lost_samples, invalid_samples : float
        Probability that a sample is never sent, or is sent as one that the device calls invalid.
        Either leaves a hole in the sequence of the good ones.
    lost_bytes, doubled_bytes, flipped_bytes : float
        Probability that a byte is lost, comes twice, or comes with one of its bits flipped.
    burst : float
        Interval, s, at which bytes are handed over together, as by a USB adapter that waits
        0.016 s for more; 0 hands over at once.
    piece : int
        Bytes that are handed over together, each piece when the line has had the time for it; 0
        hands over a sample in one piece.

    Raises
    ------
    ValueError : a value is not possible

    """

    lost_samples: float = 0.0
    invalid_samples: float = 0.0
    lost_bytes: float = 0.0
    doubled_bytes: float = 0.0
    flipped_bytes: float = 0.0
    burst: float = 0.0
    piece: int = 0

    def __post_init__(self) -> None:
        for name in _PROBABILITIES:
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f'{name} is {getattr(self, name)}, but must be a probability '
                                 'from 0 to 1')
        if self.lost_bytes + self.doubled_bytes + self.flipped_bytes > 1.0:
            raise ValueError('lost_bytes, doubled_bytes and flipped_bytes add up to more than 1, '
                             'but a byte has at most one of these faults')
        if not (0.0 <= self.burst <= 10.0 and self.piece >= 0):
            raise ValueError(f'burst is {self.burst} s and piece {self.piece}, but must be from '
                             '0 to 10 s, and a number of bytes')

    @property
    def is_random(self) -> bool:
        """Whether chance decides what arrives."""
        return any(getattr(self, name) > 0.0 for name in _PROBABILITIES)


def damaged(faults: SerialFaults, data: bytes, generator: np.random.Generator) -> bytes:
    """Return what arrives of some bytes."""
    lost, doubled = faults.lost_bytes, faults.lost_bytes + faults.doubled_bytes
    flipped = doubled + faults.flipped_bytes
    if flipped == 0.0:
        return data
    drawn = generator.random(len(data))
    if drawn.min(initial=1.0) >= flipped:
        return data
    arrived = np.frombuffer(data, np.uint8).copy()
    struck = (drawn >= doubled) & (drawn < flipped)
    arrived[struck] ^= (1 << generator.integers(8, size=int(struck.sum()))).astype(np.uint8)
    return np.repeat(arrived, np.where(drawn < lost, 0, np.where(drawn < doubled, 2, 1))).tobytes()


def delivered(faults: SerialFaults, sent: Iterable[tuple[float, bytes]],
              baud: int) -> Iterator[tuple[float, bytes]]:
    """
    Give the pieces in which bytes arrive, each with its time.

    Parameters
    ----------
    faults : SerialFaults
    sent : iterable of (float, bytes)
        When each sample is sent, in seconds, and its bytes; times do not decrease.
    baud : int
        Bits per second of the line.

    """
    seconds_per_byte = _BITS_PER_BYTE / baud if faults.piece else 0.0
    for due, data in _bursts(faults.burst, sent) if faults.burst else sent:
        size = faults.piece or len(data) or 1
        for begin in range(0, len(data), size):
            yield due + begin * seconds_per_byte, data[begin:begin + size]


def _bursts(interval: float,
            sent: Iterable[tuple[float, bytes]]) -> Iterator[tuple[float, bytes]]:
    """Gather what is sent in each interval; it comes at the end of the interval."""
    end, gathered = 0.0, b''
    for due, data in sent:
        own_end = interval * ceil(due / interval - _ROUNDING)
        if own_end > end and gathered:
            yield end, gathered
            gathered = b''
        end, gathered = own_end, gathered + data
    yield end, gathered
