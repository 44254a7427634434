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
Write messages into an MCAP file, uncompressed, as ``ros2 bag record`` does by default.

A file is a beginning, chunks of messages, and an end with the index: bytes that the caller writes
one after the other. The records are those of the specification, https://mcap.dev/spec; Python has
a library for it (mcap), but an installed ROS 2 does not.

"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping
import struct
import zlib

_MAGIC = b'\x89MCAP0\r\n'
_HEADER, _FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _MESSAGE_INDEX, _CHUNK_INDEX = range(1, 9)
_STATISTICS, _METADATA, _METADATA_INDEX, _SUMMARY_OFFSET, _DATA_END = range(0x0b, 0x10)


def _record(code: int, *content: bytes) -> bytes:
    data = b''.join(content)
    return struct.pack('<BQ', code, len(data)) + data


def _sized(data: bytes | str) -> bytes:
    data = data.encode() if isinstance(data, str) else data
    return struct.pack('<I', len(data)) + data


def _texts(pairs: Mapping[str, str]) -> bytes:
    return _sized(b''.join(_sized(key) + _sized(value) for key, value in pairs.items()))


class McapWriter:
    """
    Gives the bytes of a recording of ROS 2 messages, piece by piece.

    Attributes
    ----------
    pending : bytes of the messages that are not in a chunk yet

    """

    def __init__(self) -> None:
        self._place = 0
        self._records = bytearray()
        self._schemas: dict[str, bytes] = {}
        self._channels: dict[str, bytes] = {}
        self._numbers: dict[str, int] = {}
        self._indexes: defaultdict[int, list[tuple[int, int]]] = defaultdict(list)
        self._counts: Counter[int] = Counter()
        self._spans: list[tuple[int, int]] = []
        self._chunk_indexes: list[bytes] = []
        self._metadata_index = b''

    @property
    def pending(self) -> int:
        """Bytes of the messages that are not in a chunk yet."""
        return len(self._records)

    def begin(self, library: str, name: str, notes: Mapping[str, str]) -> bytes:
        """Return what a file begins with: who writes it, and metadata with a name."""
        head = _MAGIC + _record(_HEADER, _sized('ros2'), _sized(library))
        notes_record = _record(_METADATA, _sized(name), _texts(notes))
        self._metadata_index = _record(
            _METADATA_INDEX, struct.pack('<QQ', len(head), len(notes_record)), _sized(name))
        return self._placed(head + notes_record)

    def add(self, topic: str, kind: str, definition: str, received: int, data: bytes) -> None:
        """Take a message, in CDR, for the next chunk; the time is in ns."""
        if kind not in self._schemas:
            identifier = struct.pack('<H', len(self._schemas) + 1)
            texts = _sized(kind) + _sized('ros2msg') + _sized(definition)
            self._schemas[kind] = _record(_SCHEMA, identifier, texts)
            self._records += self._schemas[kind]
        if topic not in self._channels:
            self._numbers[topic] = len(self._channels) + 1
            schema = list(self._schemas).index(kind) + 1
            numbers = struct.pack('<HH', self._numbers[topic], schema)
            texts = _sized(topic) + _sized('cdr') + _texts({})
            self._channels[topic] = _record(_CHANNEL, numbers, texts)
            self._records += self._channels[topic]
        number = self._numbers[topic]
        self._indexes[number].append((received, len(self._records)))
        head = struct.pack('<HIQQ', number, 0, received, received)
        self._records += _record(_MESSAGE, head, data)

    def chunk(self) -> bytes:
        """Return the messages since the last chunk as one, with its index; nothing without any."""
        if not self._indexes:
            return b''
        times = [time for index in self._indexes.values() for time, _ in index]
        self._spans.append((min(times), max(times)))
        records = bytes(self._records)
        head = struct.pack('<QQQI', *self._spans[-1], len(records), zlib.crc32(records))
        chunk = _record(_CHUNK, head, _sized(''), struct.pack('<Q', len(records)), records)
        indexes, offsets = b'', b''
        for number, index in self._indexes.items():
            offsets += struct.pack('<HQ', number, self._place + len(chunk) + len(indexes))
            pairs = b''.join(struct.pack('<QQ', *pair) for pair in sorted(index))
            indexes += _record(_MESSAGE_INDEX, struct.pack('<H', number), _sized(pairs))
            self._counts[number] += len(index)
        self._chunk_indexes.append(_record(
            _CHUNK_INDEX, struct.pack('<QQQQ', *self._spans[-1], self._place, len(chunk)),
            _sized(offsets), struct.pack('<Q', len(indexes)), _sized(''),
            struct.pack('<QQ', len(records), len(records))))
        self._records.clear()
        self._indexes.clear()
        return self._placed(chunk + indexes)

    def end(self) -> bytes:
        """Return what a file ends with: the index of all chunks."""
        data_end = _record(_DATA_END, struct.pack('<I', 0))
        begin = self._place + len(data_end)
        groups = {_SCHEMA: self._schemas.values(), _CHANNEL: self._channels.values(),
                  _STATISTICS: [self._statistics()], _CHUNK_INDEX: self._chunk_indexes,
                  _METADATA_INDEX: [self._metadata_index]}
        summary, offsets = b'', b''
        for code, records in groups.items():
            group = b''.join(records)
            place = struct.pack('<BQQ', code, begin + len(summary), len(group))
            offsets += _record(_SUMMARY_OFFSET, place)
            summary += group
        footer = struct.pack('<BQQQ', _FOOTER, 20, begin, begin + len(summary))
        checked = zlib.crc32(summary + offsets + footer)
        return data_end + summary + offsets + footer + struct.pack('<I', checked) + _MAGIC

    def _statistics(self) -> bytes:
        begin = min((span[0] for span in self._spans), default=0)
        end = max((span[1] for span in self._spans), default=0)
        counts = b''.join(struct.pack('<HQ', *pair) for pair in self._counts.items())
        sizes = len(self._schemas), len(self._channels), 0, 1, len(self._chunk_indexes)
        return _record(_STATISTICS, struct.pack('<QHIIII', self._counts.total(), *sizes),
                       struct.pack('<QQ', begin, end), _sized(counts))

    def _placed(self, piece: bytes) -> bytes:
        self._place += len(piece)
        return piece
