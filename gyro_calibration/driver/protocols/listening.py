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

BAUDS = (*dict.fromkeys(protocol.baud for protocol in PROTOCOLS.values()), 460800, 230400, 19200)
"""Bits per second, in order of the attempts: first the defaults of gyros, then others."""

_MAX_BYTES = 8192  # number of last bytes that are used, which limits the cost
_MIN_FRAMES = 3  # least number of frames; fewer may be chance
# least share of the bytes in frames; a line may lose or damage the rest
_MIN_EXPLAINED_SHARE = 0.5
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
    frames: int
    runner_up: Protocol | None  # the next best format, if it explains any byte
    summary: str  # the result as a sentence


@dataclass(frozen=True)
class _Score:
    protocol: Protocol
    explained_share: float
    frames: int
    distinct_frames: int


def recognize_protocol(data: bytes, settings: Settings | None = None) -> Recognition:
    """
    Return the format that explains the last 8192 bytes.

    The settings may be incomplete for the recognized format; see its `Protocol.check`.

    Parameters
    ----------
    data : received bytes, from any position in a frame on
    settings : the format ``csv`` is recognized by the number of `columns`

    """
    settings, data = settings or Settings(), data[-_MAX_BYTES:]
    scores = [_score_protocol(protocol, settings, data) for protocol in PROTOCOLS.values()]
    best, second = sorted(scores, key=lambda score: -score.explained_share)[:2]
    runner_up = second if second.explained_share else None
    ambiguous = (runner_up is not None
                 and second.explained_share >= _AMBIGUITY_RATIO * best.explained_share)
    enough = _MIN_EXPLAINED_SHARE if best.distinct_frames >= _MIN_FRAMES else _MIN_IDENTICAL_SHARE
    protocol, explained = None, best.explained_share
    if best.frames >= _MIN_FRAMES and best.explained_share >= enough and not ambiguous:
        protocol = best.protocol
        words = (f'{protocol.name} explains {explained:.0%} of {len(data)} bytes, in '
                 f'{best.frames} frames')
        if runner_up:
            words += f'; next is {runner_up.protocol.name} with {runner_up.explained_share:.0%}'
    elif ambiguous:
        words = (f'the bytes may be {best.protocol.name} or {second.protocol.name}: set protocol')
    else:
        count, share = _count_numbers_per_line(data)
        if count not in (0, named := len(settings.columns)):
            explained, words = share, (f'lines of {count} numbers came, but columns names '
                                       f'{named}: name all columns in their order')
        elif not data:
            words = 'nothing came: check the power and the wires of the gyro'
        elif best.frames:
            words = (f'{len(data)} bytes came, of which too few are frames of '
                     f'{best.protocol.name}: listen longer, or set protocol')
        else:
            words = (f'{len(data)} bytes came, but in no known format: try another baud, or set '
                     'protocol')
    return Recognition(protocol, explained, best.frames,
                       None if runner_up is None else runner_up.protocol, words)


def _score_protocol(protocol: Protocol, settings: Settings, data: bytes) -> _Score:
    splitter, parse = protocol.splitter(), protocol.parser(settings)
    frames = splitter.feed(data)
    good = [frame for frame in frames if parse(frame.data) is not None]
    if not good:
        return _Score(protocol, 0.0, 0, 0)
    known = sum(len(frame.data) for frame in good)
    unknown = splitter.discarded_bytes + sum(len(frame.data) for frame in frames) - known
    begun = min(frames[0].skipped_bytes, max(len(frame.data) for frame in good))
    distinct = len({frame.data for frame in good})
    return _Score(protocol, known / (known + unknown - begun), len(good), distinct)


def _count_numbers_per_line(data: bytes) -> tuple[int, float]:
    """Return the most frequent number of numbers in a line, 0 for none, and its share."""
    lines = [frame.data for frame in LineSplitter(1024).feed(data)]
    counts = Counter(line.count(b',') + 1 if _NUMBERS_PATTERN.fullmatch(line.strip()) else 0
                     for line in lines)
    if len(lines) < _MIN_FRAMES:
        return 0, 0.0
    count, times = counts.most_common(1)[0]
    return count, times / len(lines)
