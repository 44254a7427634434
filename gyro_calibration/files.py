"""Read files within bounds, whoever wrote them, and write files that are complete or not there, also when the process is killed."""

from __future__ import annotations

import fcntl
import os
import re
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

#: Beyond this no value of a gyro lies, not even a count of 64 bits, and products of some such values still are numbers.
LARGEST = 1e20


def read_bytes(path: str | Path, most: int) -> bytes:
    """
    Read a regular file whole.

    Raises
    ------
    OSError : it cannot be opened
    ValueError : it is a pipe, a device or a folder, which might never end, or has more bytes than `most`

    """
    # Without waiting, since a pipe that nobody writes to would be waited for; and a terminal is not to become ours.
    handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise ValueError('it is no regular file')
    with open(handle, 'rb') as file:
        data = file.read(most + 1)
    if len(data) > most:
        raise ValueError(f'it has more than {most} bytes')
    return data


def write_atomically(path: str | Path, data: bytes) -> tuple[int, int]:
    """
    Replace a file by new content in one step; its folder is made where it is missing.

    Returns
    -------
    the version that was written, as `version` returns it as long as nobody else writes

    Raises
    ------
    OSError : the folder cannot be written to; the old file is as it was

    """
    with replacing(path) as file:
        file.write(data)
        file.flush()
        return version(file.fileno())


def version(file: str | Path | int) -> tuple[int, int]:
    """
    Return what is another after each write of a file, given by its path or open.

    Raises
    ------
    OSError : there is none

    """
    status = os.stat(file)
    return status.st_ino, status.st_mtime_ns


@contextmanager
def replacing(path: str | Path) -> Iterator[BinaryIO]:
    """Give a file to write to, which becomes `path` in one step when all is written; after an error the old file is as it was."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    remove_leftovers(path)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f'.{path.name}.')
    try:
        with os.fdopen(handle, 'wb') as file:
            with suppress(OSError):  # a file system without locks has leftovers instead
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # until it is closed, or the process is killed
            yield file
            file.flush()
            os.fsync(file.fileno())
            os.chmod(temporary, 0o644)
            os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise


def remove_leftovers(path: str | Path) -> None:
    """Remove what killed writers of a file have left beside it, and nothing that somebody is writing."""
    path = Path(path)
    temporary = re.compile(re.escape(f'.{path.name}.') + '[a-z0-9_]{8}')
    with suppress(OSError):  # nobody waits for it, and a folder that cannot be read or written to is told when it matters
        for name in filter(temporary.fullmatch, os.listdir(path.parent)):
            _remove_unlocked(path.parent / name)


def _remove_unlocked(path: Path) -> None:
    with suppress(BlockingIOError), open(path, 'rb') as file:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        os.unlink(path)
