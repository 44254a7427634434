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
ROS 2 recordings: messages read from a folder, an .mcap or a .db3 file, and written as .mcap.

The recording of a killed program lacks its closing part and index, so neither is used: records are
read from the beginning to the end, or to a truncation. No record may take more memory than
`MAX_RECORD_BYTES`, and no file expand to more than an `ExpansionBudget`: rosbags 0.11.9 takes 3.7
GB for an MCAP file of 131 kB. The records follow https://mcap.dev/spec.
"""

from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager, ExitStack, suppress
from dataclasses import dataclass, field
from enum import IntEnum
from functools import partial
import importlib
import io
from itertools import chain, repeat
import os
from pathlib import Path
import re
import shutil
import sqlite3
import struct
import sys
import tempfile
from typing import Any, BinaryIO
from urllib.parse import quote
import zlib

from gyro_calibration.files import describe_error, open_regular_file, remedy, to_printable
from gyro_calibration.logs.cdr import DEFINITIONS, MessageError, parse_layout
from gyro_calibration.logs.columns import excerpt
from gyro_calibration.logs.log import ExpansionBudget, LogError

#: Largest record or chunk that is read, bytes; recorders make chunks of 1 to 10 MB.
MAX_RECORD_BYTES = 1 << 28
_READ_BYTES = 1_000_000

_MAGIC = b'\x89MCAP0\r\n'
METADATA_NAME = 'gyro_calibration'  # name of the metadata record of this program

OnProgress = Callable[[int], object]  # is called with the number of bytes read of all files


@dataclass(frozen=True)
class Message:
    """A recorded message: topic, type, time of receipt, ns, and serialized data."""

    topic: str
    kind: str
    received: int
    data: bytes


@dataclass
class Contents:
    """Contents of a recording as far as it was read."""

    #: Topic -> message type; type with known quantities -> definition.
    topics: dict[str, str] = field(default_factory=dict)
    definitions: dict[str, str] = field(default_factory=dict)
    #: Notes of the recorder, and notes on the reading.
    recorder_notes: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    skipped_parts: int = 0  # number of parts that are damaged or too large

    def add_topic(self, topic: str, kind: str, encoding: str,
                  definition: str) -> tuple[str, str] | None:
        """Store a topic; return it with its type, or None where it has no known quantities."""
        topic, kind = excerpt(topic), excerpt(kind)
        self.topics[topic] = kind
        if kind not in self.definitions and encoding == 'cdr':
            with suppress(MessageError):
                definition = DEFINITIONS.get(kind, definition)
                if parse_layout(definition).quantities:
                    self.definitions[kind] = definition
        return (topic, kind) if encoding == 'cdr' and kind in self.definitions else None


def _to_short_line(text: object) -> str:
    """Return a text of a file as one line of at most 200 printable characters."""
    return to_printable(' '.join(str(text).split()))[:200]


def is_recording(path: str | Path) -> bool:
    """Return whether a path is a folder or has the name of a recording."""
    return os.path.isdir(path) or _recording_suffix(Path(path)) is not None


def list_recording_files(path: str | Path) -> list[Path]:
    """Return the files of a recording in order, or raise `LogError` where there are none."""
    # The list in metadata.yaml is not used: a killed recorder does not write it.
    path = Path(path)
    if not os.path.isdir(path):
        return [path]
    try:
        found = [file for file in path.iterdir() if file.is_file() and _recording_suffix(file)]
    except OSError as error:
        raise LogError(f'{path}: cannot be read ({describe_error(error)}); '
                       f'{remedy(error, path)}') from error
    if not found:
        raise LogError(f'{path}: a folder without an .mcap or .db3 file; name a recording or log')
    return sorted(found, key=lambda file: [int(part) if part.isdigit() else part
                                           for part in re.split(r'(\d+)', file.name)])


def read_messages(path: str | Path, contents: Contents,
                  on_progress: OnProgress = lambda place: None) -> Iterator[Message]:
    """
    Give the messages of a recording with known quantities, and fill in its contents.

    The progress is the number of bytes read.
    """
    done = 0

    def on_place(place: int) -> None:
        on_progress(done + place)

    for file in list_recording_files(path):
        read = _read_mcap if _recording_suffix(file) == '.mcap' else _read_database
        try:
            with ExitStack() as stack:
                source, packed = file, stack.enter_context(open_regular_file(file))
                if file.suffix == '.zstd':  # a temporary decompressed copy is read
                    source = Path(stack.enter_context(tempfile.TemporaryDirectory(
                        prefix='gyro_calibration_'))) / file.stem
                    with open(source, 'wb') as copy:
                        copy.writelines(_decompress('zstd', packed, ExpansionBudget(file)))
                yield from read(source, file, contents, on_place)
            done += file.stat().st_size
        except LogError as error:
            raise LogError(f'{file}: {error}') from None
        except OSError as error:
            raise LogError(f'{file}: cannot be read ({describe_error(error)}); '
                           f'{remedy(error, file)}') from error
    if contents.skipped_parts:
        contents.notes.append(f'damaged or oversized parts left out: {contents.skipped_parts}')


def _recording_suffix(path: Path) -> str | None:
    name = path.name.removesuffix('.zstd')
    return next((kind for kind in ('.mcap', '.db3') if name.endswith(kind)), None)


def _decompress(compression: str, packed: BinaryIO, budget: ExpansionBudget) -> Iterator[bytes]:
    """Give the data of a compressed stream, up to a truncation or damage."""
    reader: Any
    errors: tuple[type[Exception], ...]
    if compression == 'zstd':
        zstandard = _import_library('zstandard')
        reader = zstandard.ZstdDecompressor(max_window_size=MAX_RECORD_BYTES).stream_reader(
            packed, read_across_frames=True)
        errors = (zstandard.ZstdError,)
    else:
        reader = _import_library('lz4.frame').open(packed)
        errors = (RuntimeError, EOFError)
    with suppress(*errors):
        while piece := reader.read(_READ_BYTES):
            budget.spend(len(piece))
            yield piece


def _import_library(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError:
        package = name.partition('.')[0]
        raise LogError(f'the recording is compressed, which needs the Python package {package}: '
                       f'pip install {package}') from None


def _decompress_up_to(size: int, compression: str, data: bytes, budget: ExpansionBudget) -> bytes:
    expanded = bytearray()
    for piece in _decompress(compression, io.BytesIO(data), budget):
        expanded += piece
        if len(expanded) > size:
            break
    return bytes(expanded[:size])


def _decompress_message(data: bytes, budget: ExpansionBudget) -> bytes:
    is_packed = data.startswith(b'\x28\xb5\x2f\xfd')  # as Zstandard begins
    return _decompress_up_to(1 << 16, 'zstd', data, budget) if is_packed else data


_RecordCode = IntEnum('_RecordCode', 'HEADER FOOTER SCHEMA CHANNEL MESSAGE CHUNK MESSAGE_INDEX '
                      'CHUNK_INDEX ATTACHMENT ATTACHMENT_INDEX STATISTICS METADATA '
                      'METADATA_INDEX SUMMARY_OFFSET DATA_END')
_USED_RECORDS = (_RecordCode.SCHEMA, _RecordCode.CHANNEL, _RecordCode.MESSAGE, _RecordCode.CHUNK,
                 _RecordCode.METADATA)
#: Closing part of an MCAP file without index and checksum: end of data, and a footer of zeros.
MCAP_END = (struct.pack('<BQ4x', _RecordCode.DATA_END, 4)
            + struct.pack('<BQ20x', _RecordCode.FOOTER, 20) + _MAGIC)


def _read_mcap(source: Path, path: Path, contents: Contents,
               on_progress: OnProgress) -> Iterator[Message]:
    with open(source, 'rb') as file:
        end = source.stat().st_size
        if file.read(len(_MAGIC)) != _MAGIC:
            raise LogError('is not an MCAP file; name a recording, or record again')
        reader = _McapReader(contents, ExpansionBudget(path))
        for code, body in _iter_records(file, end, contents):
            if code == _RecordCode.DATA_END:
                return
            yield from reader.read(code, body, torn=file.tell() == end)
            on_progress(file.tell())
        contents.notes.append(f'{path.name} is torn after {file.tell()} of {end} bytes, '
                              'and was read up to there')


def _iter_records(stream: BinaryIO, end: int,
                  contents: Contents) -> Iterator[tuple[int, bytes]]:
    """Give code and content of the records of a file or a chunk, also of a truncated chunk."""
    while len(head := stream.read(9)) == 9:
        code, length = struct.unpack('<BQ', head)
        left = end - stream.tell()
        if code == _RecordCode.CHUNK and left < length <= MAX_RECORD_BYTES:
            yield code, stream.read()
            return
        if length > left or code == 0:
            stream.seek(-9, io.SEEK_CUR)
            return
        if code in _USED_RECORDS and length <= MAX_RECORD_BYTES:
            yield code, stream.read(length)
            continue
        contents.skipped_parts += code in _USED_RECORDS
        stream.seek(length, io.SEEK_CUR)
        if code == _RecordCode.DATA_END:
            yield code, b''
            return


class _McapReader:
    """Reads the records of one file, with its channels and schemas."""

    def __init__(self, contents: Contents, budget: ExpansionBudget):
        self._contents, self._budget = contents, budget
        self._schemas: dict[int, tuple[str, str]] = {}
        self._channels: dict[int, tuple[str, str] | None] = {}

    def read(self, code: int, body: bytes, torn: bool = False) -> Iterator[Message]:
        """Give the messages in a record; a truncated chunk is read up to its end."""
        try:
            if code == _RecordCode.CHUNK:
                _, _, size, check = struct.unpack_from('<QQQI', body)
                compression, place = _read_text(body, 28)
                if size > MAX_RECORD_BYTES or compression not in ('', 'zstd', 'lz4'):
                    raise _DamagedPart
                data = body[place + 8:]
                data = (_decompress_up_to(size, compression, data, self._budget) if compression
                        else data[:size])
                if not torn and (len(data) != size or check and zlib.crc32(data) != check):
                    raise _DamagedPart
                for inner, content in _iter_records(io.BytesIO(data), len(data), self._contents):
                    yield from self.read(inner, content) if inner != _RecordCode.CHUNK else ()
            elif code == _RecordCode.MESSAGE:
                number, _, received, _ = struct.unpack_from('<HIQQ', body)
                if channel := self._channels.get(number):
                    yield Message(*channel, received, _decompress_message(body[22:], self._budget))
            elif code == _RecordCode.SCHEMA:
                kind, place = _read_text(body, 2)
                definition, _ = _read_text(body, _read_text(body, place)[1])
                self._schemas[struct.unpack_from('<H', body)[0]] = kind, definition
            elif code == _RecordCode.CHANNEL:
                number, schema = struct.unpack_from('<HH', body)
                topic, place = _read_text(body, 4)
                kind, definition = self._schemas.get(schema, ('unknown', ''))
                self._channels[number] = self._contents.add_topic(
                    topic, kind, _read_text(body, place)[0], definition)
            elif code == _RecordCode.METADATA:
                name, place = _read_text(body, 0)
                place += 4
                while name == METADATA_NAME and place < len(body):  # written by this program
                    key, place = _read_text(body, place)
                    value, place = _read_text(body, place)
                    self._contents.recorder_notes.append(_to_short_line(f'{key}: {value}'))
        except (_DamagedPart, struct.error):
            self._contents.skipped_parts += 1


class _DamagedPart(ValueError):
    """A part of a recording is damaged."""


def _read_text(body: bytes, offset: int) -> tuple[str, int]:
    end = offset + 4 + struct.unpack_from('<I', body, offset)[0]
    if end > len(body):
        raise _DamagedPart
    return body[offset + 4:end].decode(errors='replace'), end


def _pack_record(code: _RecordCode, *content: bytes) -> bytes:
    data = b''.join(content)
    return struct.pack('<BQ', code, len(data)) + data


def _pack_sized(data: bytes | str) -> bytes:
    data = data.encode() if isinstance(data, str) else data
    return struct.pack('<I', len(data)) + data


class McapWriter:
    """Makes the bytes of an uncompressed MCAP file of ROS 2 messages, chunk by chunk."""

    def __init__(self, library: str = '', notes: Callable[[], Mapping[str, str]] = dict):
        """Take the name of the program, and the notes, which are called for with the header."""
        self._library, self._notes = library, notes
        self._offset = 0
        self._records = bytearray()
        self._schemas: dict[str, tuple[int, bytes]] = {}
        self._channels: dict[str, tuple[int, bytes]] = {}
        self._indexes: defaultdict[int, list[tuple[int, int]]] = defaultdict(list)
        self._counts: Counter[int] = Counter()
        self._spans: list[tuple[int, int]] = []
        self._chunk_indexes: list[bytes] = []
        self._metadata_index = b''

    def _pack_header(self) -> bytes:
        """Return the beginning of a file: header with the program, and the notes."""
        head = _MAGIC + _pack_record(_RecordCode.HEADER, _pack_sized('ros2'),
                                     _pack_sized(self._library))
        name = _pack_sized(METADATA_NAME)
        pairs = b''.join(map(_pack_sized, chain.from_iterable(self._notes().items())))
        metadata = _pack_record(_RecordCode.METADATA, name, _pack_sized(pairs))
        self._metadata_index = _pack_record(_RecordCode.METADATA_INDEX,
                                            struct.pack('<QQ', len(head), len(metadata)), name)
        return head + metadata

    def add(self, message: Message) -> None:
        """Add a message of a type of `DEFINITIONS` to the next chunk."""
        kind, topic, received = message.kind, message.topic, message.received
        if kind not in self._schemas:
            schema = _pack_record(_RecordCode.SCHEMA, struct.pack('<H', len(self._schemas) + 1),
                                  _pack_sized(kind), _pack_sized('ros2msg'),
                                  _pack_sized(DEFINITIONS[kind]))
            self._schemas[kind] = len(self._schemas) + 1, schema
            self._records += schema
        if topic not in self._channels:
            ends = len(self._channels) + 1, self._schemas[kind][0]
            channel = _pack_record(_RecordCode.CHANNEL, struct.pack('<HH', *ends),
                                   _pack_sized(topic), _pack_sized('cdr'), _pack_sized(b''))
            self._channels[topic] = ends[0], channel
            self._records += channel
        number = self._channels[topic][0]
        self._indexes[number].append((received, len(self._records)))
        head = struct.pack('<HIQQ', number, 0, received, received)
        self._records += _pack_record(_RecordCode.MESSAGE, head, message.data)

    def pack_chunk(self) -> bytes:
        """
        Return the messages since the last chunk as a chunk with index; b'' without any.

        The first one follows the header.
        """
        if not self._indexes:
            return b''
        header = b'' if self._offset else self._pack_header()
        self._offset += len(header)
        times = [time for index in self._indexes.values() for time, _ in index]
        self._spans.append((min(times), max(times)))
        records = bytes(self._records)
        head = struct.pack('<QQQI', *self._spans[-1], len(records), zlib.crc32(records))
        chunk = _pack_record(_RecordCode.CHUNK, head, _pack_sized(''),
                             struct.pack('<Q', len(records)), records)
        indexes, offsets = b'', b''
        for number, index in self._indexes.items():
            offsets += struct.pack('<HQ', number, self._offset + len(chunk) + len(indexes))
            pairs = b''.join(struct.pack('<QQ', *pair) for pair in sorted(index))
            indexes += _pack_record(_RecordCode.MESSAGE_INDEX, struct.pack('<H', number),
                                    _pack_sized(pairs))
            self._counts[number] += len(index)
        self._chunk_indexes.append(
            _pack_record(_RecordCode.CHUNK_INDEX,
                         struct.pack('<QQQQ', *self._spans[-1], self._offset, len(chunk)),
                         _pack_sized(offsets), struct.pack('<Q', len(indexes)), _pack_sized(''),
                         struct.pack('<QQ', len(records), len(records))))
        self._records.clear()
        self._indexes.clear()
        self._offset += len(chunk + indexes)
        return header + chunk + indexes

    def pack_summary(self) -> bytes:
        """Return the end of a file: the summary with the index of all chunks."""
        data_end = _pack_record(_RecordCode.DATA_END, struct.pack('<I', 0))
        sizes = len(self._schemas), len(self._channels), 0, 1, len(self._chunk_indexes)
        span = (min((span[0] for span in self._spans), default=0),
                max((span[1] for span in self._spans), default=0))
        counts = b''.join(struct.pack('<HQ', *pair) for pair in self._counts.items())
        statistics = _pack_record(
            _RecordCode.STATISTICS, struct.pack('<QHIIII', self._counts.total(), *sizes),
            struct.pack('<QQ', *span), _pack_sized(counts))
        summary = b''.join([*(record for _, record in self._schemas.values()),
                            *(record for _, record in self._channels.values()),
                            statistics, *self._chunk_indexes, self._metadata_index])
        footer = struct.pack('<BQQQ', _RecordCode.FOOTER, 20, self._offset + len(data_end), 0)
        checked = struct.pack('<I', zlib.crc32(summary + footer))
        return data_end + summary + footer + checked + _MAGIC


#: Row, topic, time and data of the messages; data of 64 KiB and more are not loaded.
_MESSAGES_QUERY = """
    SELECT rowid, CASE WHEN typeof(topic_id) = 'integer' THEN topic_id END,
           CASE WHEN typeof(timestamp) = 'integer' THEN timestamp END,
           CASE WHEN typeof(data) = 'blob' AND length(data) < 65536 THEN data END
    FROM messages"""
#: Errors of SQLite in a damaged file: its own, texts other than UTF-8, lengths beyond the memory.
_DATABASE_ERRORS = (sqlite3.Error, UnicodeDecodeError, MemoryError)


def _read_database(source: Path, path: Path, contents: Contents,
                   on_progress: OnProgress) -> Iterator[Message]:
    with _open_database(source) as (database, tables):
        try:
            definitions = dict(database.execute(
                'SELECT topic_type, encoded_message_definition FROM message_definitions')
                if 'message_definitions' in tables else ())
            channels = {number: contents.add_topic(str(topic), str(kind), encoding,
                                                   str(definitions.get(kind, '')))
                        for number, topic, kind, encoding in database.execute(
                            'SELECT id, name, type, serialization_format FROM topics')}
        except _DATABASE_ERRORS as error:
            raise LogError('its list of topics cannot be read '
                           f'({_describe_database_error(error)}); record again') from error
        budget, size, last, count = ExpansionBudget(path), path.stat().st_size, sys.maxsize, 0
        with suppress(*_DATABASE_ERRORS):  # used for the progress only
            last = int(database.execute('SELECT max(rowid) FROM messages').fetchone()[0] or 1)
        try:
            for row, topic, received, data in database.execute(_MESSAGES_QUERY):
                count += 1
                if count % 4096 == 0:
                    on_progress(int(size * row / last))
                if channel := channels.get(topic):
                    if isinstance(received, int) and isinstance(data, bytes):
                        yield Message(*channel, received, _decompress_message(data, budget))
                    else:
                        contents.skipped_parts += 1
        except _DATABASE_ERRORS as error:
            contents.notes.append(f'{path.name} is damaged after {count} messages '
                                  f'({_describe_database_error(error)}), and was read up to there')


@contextmanager
def _open_database(source: Path) -> Iterator[tuple[sqlite3.Connection, set[str]]]:
    """Open a database read-only, and give it with the names of its tables of stored columns."""
    # Tried in turn: with the journal of a killed writer, without it, and as a copy with its page
    # count corrected. Computed columns, whose cost has no limit, are not read.
    with tempfile.TemporaryDirectory(prefix='gyro_calibration_') as folder:
        reason: Exception | None = None
        for mode in ('mode=ro', 'mode=ro&immutable=1', 'copy'):
            file = source
            if mode == 'copy':
                file, mode = Path(shutil.copy(source, folder)), 'mode=ro'
                with open(file, 'r+b') as copy:
                    head = copy.read(100)
                    if len(head) == 100:
                        size = int.from_bytes(head[16:18], 'big')
                        size = 1 << 16 if size == 1 else max(size, 1)
                        copy.seek(28)
                        copy.write((file.stat().st_size // size).to_bytes(4, 'big'))
            try:
                database = sqlite3.connect(f'file:{quote(str(file.resolve()))}?{mode}', uri=True)
            except _DATABASE_ERRORS as error:
                reason = error
                continue
            with closing(database):
                try:
                    database.text_factory = partial(str, encoding='utf-8', errors='replace')
                    # A query ends after a million steps of SQLite plus ten per byte; the smallest
                    # row, of a dozen bytes, takes some 30.
                    thousands = repeat(0, file.stat().st_size // 100 + 1000)
                    database.set_progress_handler(partial(next, thousands, 1), 1000)
                    if sys.version_info >= (3, 11):
                        database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _READ_BYTES)
                    database.execute('PRAGMA trusted_schema = OFF')
                    tables = {name for name, text in database.execute(
                        "SELECT name, sql FROM sqlite_master WHERE type = 'table'")
                        if name in ('topics', 'messages', 'message_definitions')
                        and str(text).upper().startswith('CREATE TABLE')
                        and not any(hidden for *_, hidden in database.execute(
                            f'PRAGMA table_xinfo({name})'))}
                except _DATABASE_ERRORS as error:
                    reason = error
                    continue
                if not {'topics', 'messages'} <= tables:
                    raise LogError('is a database, but no ROS 2 recording; name one')
                yield database, tables
                return
    raise LogError(f'cannot be read as a ROS 2 recording ({_describe_database_error(reason)}); '
                   'name a recording, or record again')


def _describe_database_error(error: Exception | None) -> str:
    return _to_short_line(str(error) or 'it needs more memory than the limit')
