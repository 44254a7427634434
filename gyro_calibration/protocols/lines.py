"""
Find lines of text in a stream of bytes.

"""

from __future__ import annotations

import re

_LINE_END = re.compile(rb'[\r\n]')


class LineSplitter:
    """
    Gives whole lines without their ends, and no empty ones.

    A port is opened in the middle of a line, and the rest of ``-120.5`` is ``20.5``: so the first line is thrown away, unless it begins
    as only whole lines do.

    Parameters
    ----------
    longest : int
        Bytes; a longer line is thrown away, so that an endless one does not fill the memory.
    beginnings : tuple of bytes
        With what only a whole line begins.

    """

    def __init__(self, longest: int, beginnings: tuple[bytes, ...] = ()):
        self._longest = longest
        self._beginnings = beginnings
        self._tail = b''
        self._begun = False
        self._too_long = False
        self.discarded_bytes = 0

    def feed(self, data: bytes) -> list[bytes]:
        """
        Return the lines that these bytes complete.

        """
        *lines, tail = _LINE_END.split(self._tail + data)
        whole = [line for line in map(self._checked, lines) if line]
        self._hold(tail)
        return whole

    def reset(self) -> None:
        """
        Forget the line that has begun.

        """
        self.discarded_bytes += len(self._tail)
        self._tail, self._begun, self._too_long = b'', False, False

    def _checked(self, line):
        good = not self._too_long and len(line) <= self._longest and (self._begun or line.startswith(self._beginnings))
        self._begun, self._too_long = True, False
        if not good:
            self.discarded_bytes += len(line)
            return b''
        return line

    def _hold(self, tail):
        if self._too_long or len(tail) > self._longest:
            self.discarded_bytes += len(tail)
            self._tail, self._too_long = b'', True
        else:
            self._tail = tail


NUMBER = rb'[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?'
"""A finite number in text: `float` also takes nan, inf and 1_0."""
