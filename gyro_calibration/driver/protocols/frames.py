# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Find binary frames of a fixed length in a stream of bytes."""

from __future__ import annotations

from collections.abc import Callable
import re

from gyro_calibration.driver.protocols.protocol import Frame


class FrameSplitter:
    """
    Gives frames that match a pattern and pass their check; after garbage it tries the next byte.

    Parameters
    ----------
    pattern : bytes
        Regular expression that a frame matches; ``.`` is any byte.
    length : int
        Bytes of a frame.
    is_intact : callable
        Whether the checksum of a frame is right.

    """

    def __init__(self, pattern: bytes, length: int, is_intact: Callable[[bytes], bool]):
        self._pattern = re.compile(pattern, re.DOTALL)
        self._length = length
        self._is_intact = is_intact
        self._tail = b''
        self._garbage = 0
        self.discarded_bytes = 0

    def feed(self, data: bytes) -> list[Frame]:
        """Return the frames that these bytes complete."""
        data, position, end, frames = self._tail + data, 0, 0, []
        while match := self._pattern.search(data, position):
            position = match.start() + 1
            if self._is_intact(match.group()):
                self._discard(match.start() - end)
                frames.append(Frame(match.group(), self._garbage))
                self._garbage = 0
                position = end = match.end()
        kept = max(position, len(data) - self._length + 1)
        self._discard(kept - end)
        self._tail = data[kept:]
        return frames

    def _discard(self, count: int) -> None:
        self.discarded_bytes += count
        self._garbage += count

    def reset(self) -> None:
        """Drop the frame that has begun."""
        self._discard(len(self._tail))
        self._tail, self._garbage = b'', 0
