# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""
Recognition of the wire format of received bytes.

A line is read at each of `BAUDS` in turn, until `recognize_protocol` names a protocol. At a wrong
baud the bytes fit no format.

"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
import re

from gyro_calibration.driver.protocols import Protocol, PROTOCOLS, Settings
from gyro_calibration.driver.protocols.protocol import LineSplitter, NUMBER

#: Bits per second, in order of the attempts: first the defaults of gyros, then others.
BAUDS = (*dict.fromkeys(protocol.baud for protocol in PROTOCOLS.values()), 460800, 230400, 19200)

_MAX_BYTES = 8192  # number of last bytes that are used, which limits the cost
_MIN_FRAMES = 3  # least number of frames; fewer may be chance
_MIN_EXPLAINED_SHARE = 0.5  # least share of the bytes in frames; a line may damage the rest
_MIN_IDENTICAL_SHARE = 0.95  # least share where all frames are equal: zeros may pass a weak check
_AMBIGUITY_RATIO = 0.8  # the result is ambiguous if another format has this times the best share
_NUMBERS_PATTERN = re.compile(NUMBER + rb'(?: *, *' + NUMBER + rb')* *')


@dataclass(frozen=True)
class Recognition:
    """
    The recognized format of some bytes.

    The explained share, 0 to 1, is that of the bytes in frames of the best format, without an
    incomplete frame at the beginning. Where the columns do not fit, it is the share of the lines
    with the most frequent number of columns.

    """

    protocol: Protocol | None  # None if ambiguous, or too few bytes
    explained_share: float
    summary: str  # the result as a sentence


@dataclass(frozen=True)
class _Score:
    """How a format explains bytes: share, number of frames, and of different ones."""

    protocol: Protocol
    explained_share: float = 0.0
    frames: int = 0
    distinct_frames: int = 0


def recognize_protocol(data: bytes, settings: Settings | None = None) -> Recognition:
    """
    Return the format that explains the last 8192 bytes.

    The settings may be incomplete for the recognized format. `csv` is recognized by the number of
    their columns. The data may begin anywhere in a frame.

    """
    settings, data = settings or Settings(), data[-_MAX_BYTES:]
    scores = [_score_protocol(protocol, settings, data) for protocol in PROTOCOLS.values()]
    best, second = sorted(scores, key=lambda score: -score.explained_share)[:2]
    share = best.explained_share
    if second.frames and second.explained_share >= _AMBIGUITY_RATIO * share:
        return Recognition(None, share, f'the bytes may be {best.protocol.name} or '
                           f'{second.protocol.name}: set protocol')
    enough = _MIN_EXPLAINED_SHARE if best.distinct_frames >= _MIN_FRAMES else _MIN_IDENTICAL_SHARE
    if best.frames >= _MIN_FRAMES and share >= enough:
        words = (f'{best.protocol.name} explains {share:.0%} of {len(data)} bytes, in '
                 f'{best.frames} frames')
        if second.frames:
            words += f'; next is {second.protocol.name} with {second.explained_share:.0%}'
        return Recognition(best.protocol, share, words)
    count, of_lines = _count_numbers_per_line(data)
    if count not in (0, named := len(settings.columns)):
        return Recognition(None, of_lines, f'lines of {count} numbers came, but columns names '
                           f'{named}: name all columns in their order')
    if not data:
        words = 'nothing came: check the power and the wires of the gyro'
    elif best.frames:
        words = (f'{len(data)} bytes came, of which too few are frames of '
                 f'{best.protocol.name}: listen longer, or set protocol')
    else:
        words = (f'{len(data)} bytes came, but in no known format: try another baud, or set '
                 'protocol')
    return Recognition(None, share, words)


def _score_protocol(protocol: Protocol, settings: Settings, data: bytes) -> _Score:
    splitter, parse = protocol.splitter(), protocol.parser(settings)
    frames = splitter.feed(data)
    good = [frame.data for frame in frames if parse(frame.data) is not None]
    if not good:
        return _Score(protocol)
    known = sum(map(len, good))
    received = splitter.discarded_bytes + sum(len(frame.data) for frame in frames)
    begun = min(frames[0].skipped_bytes, max(map(len, good)))
    return _Score(protocol, known / (received - begun), len(good), len(set(good)))


def _count_numbers_per_line(data: bytes) -> tuple[int, float]:
    """Return the most frequent number of numbers in a line, 0 for none, and its share."""
    lines = [frame.data for frame in LineSplitter(1024).feed(data)]
    if len(lines) < _MIN_FRAMES:
        return 0, 0.0
    counts = Counter(line.count(b',') + 1 if _NUMBERS_PATTERN.fullmatch(line.strip()) else 0
                     for line in lines)
    count, times = counts.most_common(1)[0]
    return count, times / len(lines)
