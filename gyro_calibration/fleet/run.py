# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Many tasks on the processes of this machine, or on another executor of `concurrent.futures`."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import as_completed, BrokenExecutor, Executor, ProcessPoolExecutor
from contextlib import contextmanager
from fcntl import F_GETFL, F_SETFL, F_SETOWN, fcntl
from multiprocessing import get_context, parent_process
import os
import resource
import signal
from typing import TypeVar

_Task = TypeVar('_Task')
_Found = TypeVar('_Found')


@contextmanager
def process_executor(workers: int, memory: float | None = None,
                     preload: Sequence[str] = ()) -> Iterator[Executor]:
    """
    Give an executor of processes on this machine, and shut it down at the end.

    `memory` is the number of bytes that each worker may allocate; `preload` are modules.
    """
    context = get_context('forkserver')
    context.set_forkserver_preload(list(preload))
    executor = ProcessPoolExecutor(workers, context, _initialize_worker, (memory,))
    try:
        yield executor
    finally:
        executor.shutdown(wait=True, cancel_futures=True)


def _initialize_worker(memory: float | None) -> None:
    """Limit the memory of a worker, and end it when the program that started it ends."""
    parent = parent_process()
    assert parent is not None
    # the program holds the other end of this pipe, and SIGIO ends a process
    fcntl(parent.sentinel, F_SETOWN, os.getpid())
    fcntl(parent.sentinel, F_SETFL, fcntl(parent.sentinel, F_GETFL) | os.O_ASYNC)
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # ends without a traceback
    if memory is not None:
        hard = resource.getrlimit(resource.RLIMIT_DATA)[1]
        limit = int(memory) if hard == resource.RLIM_INFINITY else min(int(memory), hard)
        resource.setrlimit(resource.RLIMIT_DATA, (limit, hard))


@contextmanager
def cluster_executor(address: str) -> Iterator[Executor]:
    """
    Give an executor of a Dask cluster.

    Raise `ImportError` without `distributed`, `OSError` or `ValueError` without a scheduler there.
    """
    from distributed import Client
    if '://' not in address:  # a client without a scheduler blocks when it is deleted
        raise ValueError(f'{address} has no protocol')
    with Client(address, timeout='10s', set_as_default=False) as client:
        yield client.get_executor(pure=False, retries=0)


def run_tasks(work: Callable[[_Task], _Found], tasks: Iterable[_Task],
              executor: Executor) -> Iterator[tuple[_Task, _Found | BaseException]]:
    """
    Yield each task with its result when it is finished, or with the exception of its worker.

    `work` is a function of a module. `BrokenExecutor` tells that a worker was killed.
    """
    submitted = {executor.submit(work, task): task for task in tasks}
    for each in as_completed(submitted):
        error = each.exception()
        if isinstance(error, BrokenExecutor):
            raise error
        yield submitted[each], each.result() if error is None else error
