# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Find lines of text, and binary frames of a fixed length, in a stream of bytes."""

from __future__ import annotations

from collections.abc import Callable
import re

from gyro_calibration.driver.protocols.protocol import Frame

NUMBER = rb'[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?'
"""A finite number in text: `float` also takes nan, inf and 1_0."""

_LINE_END = re.compile(rb'[\r\n]')


class LineSplitter:
    """
    Gives whole lines without their ends, and no empty ones.

    A port is opened in the middle of a line, and the rest of ``-120.5`` is ``20.5``: so the first
    line is discarded, unless it begins as only whole lines do.

    Parameters
    ----------
    longest : bytes; a longer line is discarded, so that an endless one does not fill the memory
    beginnings : with what only a whole line begins

    """

    def __init__(self, longest: int, beginnings: tuple[bytes, ...] = ()):
        self._longest = longest
        self._beginnings = beginnings
        self._tail = b''
        self._begun = False
        self._too_long = False
        self._garbage = 0
        self.discarded_bytes = 0

    def feed(self, data: bytes) -> list[Frame]:
        """Return the lines that these bytes complete."""
        first, *rest = _LINE_END.split(data)  # the tail was searched for line ends when it came
        *lines, tail = self._tail + first, *rest
        whole = []
        for line in lines:
            good = not self._too_long and len(line) <= self._longest
            good = good and (self._begun or line.startswith(self._beginnings))
            self._begun, self._too_long = True, False
            if not good:
                self._discard(len(line))
            elif line:
                whole.append(Frame(line, self._garbage))
                self._garbage = 0
        self._tail = tail
        if self._too_long or len(tail) > self._longest:
            self._discard(len(tail))
            self._tail, self._too_long = b'', True
        return whole

    def reset(self) -> None:
        """Drop the line that has begun."""
        self._discard(len(self._tail))
        self._tail, self._garbage, self._begun, self._too_long = b'', 0, False, False

    def _discard(self, count: int) -> None:
        self.discarded_bytes += count
        self._garbage += count


class FrameSplitter:
    """
    Gives frames that match a pattern and pass their check; after garbage it tries the next byte.

    Parameters
    ----------
    pattern : regular expression that a frame matches; ``.`` is any byte
    length : bytes of a frame
    is_intact : whether the checksum of a frame is right

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
