"""
Find binary frames of a fixed length in a stream of bytes.

"""

from __future__ import annotations

import re
from collections.abc import Callable


class FrameSplitter:
    """
    Gives frames that look right and pass their check; after garbage it tries again one byte further on.

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
        self.discarded_bytes = 0

    def feed(self, data: bytes) -> list[bytes]:
        """
        Return the frames that these bytes complete.

        """
        data, position, frames = self._tail + data, 0, []
        total = len(data)
        while match := self._pattern.search(data, position):
            if self._is_intact(match.group()):
                frames.append(match.group())
                position = match.end()
            else:
                position = match.start() + 1
        self._tail = data[max(position, total - self._length + 1):]
        self.discarded_bytes += total - len(self._tail) - self._length * len(frames)
        return frames

    def reset(self) -> None:
        """
        Forget the frame that has begun.

        """
        self.discarded_bytes += len(self._tail)
        self._tail = b''
