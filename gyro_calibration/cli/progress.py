# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""What is under way, and for how long, on a terminal; bars, where all parts are known before."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
import os
import shutil
import sys
from threading import Event, Thread
import time
from typing import Any

from gyro_calibration.files import plain
from gyro_calibration.logs.ros_bag import files_of
from tqdm import tqdm

#: Nothing is shown of what takes less, s.
DELAY = 2.0


@contextmanager
def under_way(words: str) -> Iterator[Callable[[float | None, str], None]]:
    """Show what is done, its share where it is known, and the time it takes, from 2 s on."""
    begin, state = time.monotonic(), [f'{words} ...']

    def on_progress(share: float | None, words: str) -> None:
        state[0] = f'{words} ...' if share is None else f'{100.0 * share:3.0f} %  {words} ...'

    if not sys.stderr.isatty():
        yield on_progress
        return
    over = Event()

    def show() -> None:
        wait = DELAY
        while not over.wait(wait):
            text = f'{state[0]}  {time.monotonic() - begin:.0f} s'
            width = shutil.get_terminal_size().columns - 1
            print(f'\r\033[K{text[:width]}', end='', file=sys.stderr, flush=True)
            wait = 0.5
        if wait != DELAY:
            print('\r\033[K', end='', file=sys.stderr, flush=True)

    shown = Thread(target=show, daemon=True)
    shown.start()
    try:
        yield on_progress
    finally:
        over.set()
        shown.join()


def bar(items: Iterable[Any], what: str, total: int | None = None) -> Iterable[Any]:
    """Show on a terminal the progress over some items, if it takes longer than two seconds."""
    return tqdm(items, desc=what, total=total, delay=DELAY, leave=False, disable=None)


@contextmanager
def bytes_of(path: str) -> Iterator[Callable[[int], object]]:
    """Show on a terminal how many bytes of a log are read, and give the function that counts."""
    size = sum(os.path.getsize(file) for file in files_of(path) if os.path.isfile(file)) or None
    with tqdm(total=size, desc=plain(path), unit='B', unit_scale=True, delay=DELAY, leave=False,
              disable=None) as shown:
        yield lambda place: shown.update(place - shown.n)
