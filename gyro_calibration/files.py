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
Read files within limits of size, and write files atomically.

A pipe, a socket, a device or a folder is neither waited for nor replaced. A symbolic link is
followed when it is read, and replaced when it is written; its target does not change. A file that
is replaced keeps its mode.
"""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
import csv
import difflib
import errno
import hashlib
import io
import json
import math
import os
from pathlib import Path
import secrets
import stat
from typing import Any, BinaryIO

#: Largest magnitude of a value that is accepted. A count of 64 bits is below it, and products of
#: several such values do not overflow.
MAX_MAGNITUDE = 1e20
#: Largest ratio of decompressed to compressed size (sensor data compress to about a tenth), and
#: the size in bytes that is allowed at any ratio.
MAX_EXPANSION_RATIO, MIN_EXPANSION_BYTES = 100, 1 << 24
#: Largest depth of nested lists, names and messages, which the stack of Python holds.
MAX_DEPTH = 10

#: File type, other than a regular file -> its name.
_FILE_TYPE_NAMES = {stat.S_IFDIR: 'a folder', stat.S_IFIFO: 'a pipe', stat.S_IFSOCK: 'a socket',
                    stat.S_IFCHR: 'a device', stat.S_IFBLK: 'a device'}
#: Error number -> remedy.
_REMEDIES = {
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT, errno.EFBIG), 'make room in {folder}'),
    **dict.fromkeys((errno.ENOTDIR, errno.EEXIST),
                    'a part of {folder} is a file; name another folder'),
    **dict.fromkeys((errno.EISDIR, errno.EINVAL), 'name a file, or move away what is there'),
    errno.ENOENT: 'name one that exists',
    errno.ENAMETOOLONG: 'give it a shorter name',
    errno.ELOOP: 'name the file that its links should lead to',
}


class InputError(ValueError):
    """The input cannot be used; the message is one printable line: given, wanted, remedy."""

    def __init__(self, message: object = ''):
        super().__init__(to_printable(message))


def to_printable(text: object, allowed: str = '') -> str:
    """Return a text that is safe to show in a terminal, a ROS log or a page."""
    # Characters that cannot be printed (terminal escapes, line ends, marks of writing direction,
    # undecodable bytes of a file name) are replaced by their Python escape, such as \\x1b, except
    # the characters to be kept.
    return ''.join(each if each.isprintable() or each in allowed else
                   each.encode('unicode_escape').decode() for each in str(text))


def suggest_nearest(name: str, names: Iterable[str]) -> str:
    """Return the end of a message on a wrong name: the nearest right one; '' without one."""
    near = difflib.get_close_matches(name, list(names), 1)
    return f'; perhaps {to_printable(near[0][:100])} is meant' if near else ''


def describe_error(error: Exception) -> str:
    """Return the text of an error, for a sentence that already names the file."""
    if isinstance(error, OSError) and error.strerror:
        return f'{error.strerror[0].lower()}{error.strerror[1:]}'
    return to_printable(' '.join(str(error).split())[:200] or type(error).__name__)


def remedy(error: OSError, path: str | Path) -> str:
    words = _REMEDIES.get(error.errno or 0, 'make {path} readable and writable, or name another')
    return to_printable(words.format(path=path, folder=Path(path).parent))


def open_regular_file(path: str | Path) -> io.BufferedReader:
    """Open a regular file; raise `OSError` for others."""
    # Opening a device may already have an effect; and the file may be replaced between the checks.
    _require_regular_file(path, os.stat(path).st_mode)
    handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    try:
        _require_regular_file(path, os.fstat(handle).st_mode)
        os.set_blocking(handle, True)
        return open(handle, 'rb')
    except BaseException:
        os.close(handle)
        raise


def sha256_digest(*paths: str | Path) -> str:
    """Return the SHA-256 of the content of regular files, one after the other."""
    found = hashlib.sha256()
    for path in paths:
        with open_regular_file(path) as file:
            while piece := file.read(1 << 20):
                found.update(piece)
    return found.hexdigest()


def _require_regular_file(path: str | Path, mode: int) -> None:
    if not stat.S_ISREG(mode):
        kind = _FILE_TYPE_NAMES.get(stat.S_IFMT(mode), 'of another kind')
        number = errno.EISDIR if stat.S_ISDIR(mode) else errno.EINVAL
        raise OSError(number, f'it is {kind}, where a file is wanted', str(path))


def read_bytes(path: str | Path, max_size: int) -> bytes:
    """Read a regular file as `open_regular_file`; raise `ValueError` if it has more bytes."""
    with open_regular_file(path) as file:
        data = file.read(max_size + 1)
    if len(data) > max_size:
        raise ValueError(f'it has more than {max_size} bytes')
    return data


def write_atomically(path: str | Path, data: bytes) -> tuple[int, int]:
    """Replace a file by new content, as `open_replacement`; return its `file_version`."""
    with open_replacement(path) as file:
        file.write(data)
        file.flush()
        return file_version(file.fileno())


def file_version(file: str | Path | int) -> tuple[int, int]:
    """Return an identifier that differs after each write of a file, by path or descriptor."""
    status = os.stat(file)
    return status.st_ino, status.st_mtime_ns


@contextmanager
def open_replacement(path: str | Path) -> Iterator[BinaryIO]:
    """
    Give a temporary file to write to, which replaces `path` in one step at the end.

    Its folder is made where it is missing. After an error the old file is unchanged. Raise
    `OSError` for a path that is not a regular file, or a link to one.
    """
    path, old_mode = Path(path), None
    # a long name is shortened; the temporary file of a killed writer remains
    temporary = path.with_name(
        f'.{os.fsdecode(os.fsencode(path.name)[:200])}.{secrets.token_hex(4)}')
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with suppress(FileNotFoundError):  # a new file, or a link without a target
            if stat.S_ISREG(mode := os.lstat(path).st_mode):
                old_mode = mode & 0o777
            else:
                _require_regular_file(path, os.stat(path).st_mode)
        # A replacement is readable by its owner alone until it gets the mode of the old file; a
        # new file gets the mode that the umask allows.
        handle = os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC,
                         0o644 if old_mode is None else 0o600)
        try:
            with os.fdopen(handle, 'wb') as file:
                yield file
                file.flush()
                if old_mode is not None:
                    os.fchmod(file.fileno(), old_mode)
                os.fsync(file.fileno())
                os.replace(temporary, path)
        except BaseException:
            with suppress(FileNotFoundError):
                os.unlink(temporary)
            raise
    except OSError as error:
        if error.errno is None or error.filename is not None and not (
                Path(error.filename) in path.parents or Path(error.filename) == temporary):
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error


def format_rows(rows: Iterable[Iterable[Any]]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator='\n').writerows(rows)
    return text.getvalue()


def format_json(value: Any) -> str:
    """Return a value as JSON, with null for numbers that are not finite."""
    def finite(part: Any) -> Any:
        if isinstance(part, dict):
            return {name: finite(each) for name, each in part.items()}
        if isinstance(part, (list, tuple)):
            return [finite(each) for each in part]
        return None if isinstance(part, float) and not math.isfinite(part) else part

    return json.dumps(finite(value), allow_nan=False)


def keep_aside(path: Path) -> str:
    """Rename a file, so that it is not replaced by the next one; return a sentence on it."""
    number = 1
    while (other := path.with_name(f'{path.name}.kept-{number}')).exists():
        number += 1
    path.rename(other)
    return to_printable(f'what was in {path} is now in {other}')
