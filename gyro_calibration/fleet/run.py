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
Many tasks on the processes of this machine, or on another executor of `concurrent.futures`.

Two tasks for each worker are submitted at a time, so that the memory does not depend on the number
of tasks. A worker that is killed breaks its pool: the submitted tasks are then repeated one by
one, the one that kills its worker again is reported, and the others continue.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import (
    BrokenExecutor, Executor, FIRST_COMPLETED, Future, ProcessPoolExecutor, wait)
from contextlib import contextmanager
from fcntl import F_GETFL, F_SETFL, F_SETOWN, fcntl
from itertools import islice
from multiprocessing import get_context, parent_process
import os
import resource
import signal
from typing import Any, TypeVar

_Task = TypeVar('_Task')
_Found = TypeVar('_Found')


class WorkerLost(Exception):
    """A task has no result, since its worker was killed; the message states the reason."""


@contextmanager
def process_executors(workers: int, memory: float | None = None,
                      preload: Sequence[str] = ()) -> Iterator[Callable[[int], Executor]]:
    """
    Give a function that makes executors of processes on this machine; shut all down at the end.

    `workers` is the largest number in an executor, `memory` the number of bytes that each may
    allocate; modules of `preload` are imported once, and not by each new worker.
    """
    context = get_context('forkserver')
    context.set_forkserver_preload(list(preload))
    executors: list[ProcessPoolExecutor] = []

    def create(wanted: int) -> Executor:
        executors.append(
            ProcessPoolExecutor(min(wanted, workers), context, _initialize_worker, (memory,)))
        return executors[-1]
    try:
        yield create
    finally:
        for each in executors:
            each.shutdown(wait=True, cancel_futures=True)


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
def cluster_executors(address: str) -> Iterator[Callable[[int], Executor]]:
    """
    Give a function that makes executors of a Dask cluster.

    Raise `ImportError` where `distributed` is not installed, `OSError` or `ValueError` where no
    scheduler answers at the address, or it is none.
    """
    from distributed import Client
    if '://' not in address:  # a client without a scheduler blocks when it is deleted
        raise ValueError(f'{address} has no protocol')
    with Client(address, timeout='10s', set_as_default=False) as client:
        yield lambda wanted: client.get_executor(pure=False, retries=0)


def run_tasks(work: Callable[[_Task], _Found], tasks: Iterable[_Task], workers: int,
              create: Callable[[int], Executor]) -> Iterator[tuple[_Task, _Found | WorkerLost]]:
    """
    Yield each task with its result when it is finished, or with `WorkerLost`.

    `work` is a function of a module, which raises nothing; `tasks` may be endless; `create` makes
    an executor of so many workers, of `process_executors` or `cluster_executors`.
    """
    remaining = iter(tasks)
    executor = create(workers)
    pending: dict[Future[Any], Any] = {}
    while True:
        for task in islice(remaining, 2 * workers - len(pending)):
            try:
                pending[executor.submit(work, task)] = task
            except BrokenExecutor:
                executor = create(workers)
                pending[executor.submit(work, task)] = task
        if not pending:
            return
        ready, suspects = wait(pending, return_when=FIRST_COMPLETED)[0], []
        if any(isinstance(each.exception(), BrokenExecutor) for each in ready):
            ready = wait(pending)[0]
        for each in ready:
            task = pending.pop(each)
            try:
                yield task, each.result()
            except BrokenExecutor:
                suspects.append(task)
            except Exception as error:  # of a cluster whose workers were killed by the task
                yield task, WorkerLost(_describe_failure(error))
        if not suspects:
            continue
        executor.shutdown(wait=True, cancel_futures=True)
        for task in suspects:  # one by one, each with an executor of its own
            executor = create(1)
            try:
                yield task, executor.submit(work, task).result()
            except BrokenExecutor as error:
                yield task, WorkerLost(_describe_failure(error))
            executor.shutdown(wait=True, cancel_futures=True)
        executor = create(workers)


def _describe_failure(error: Exception) -> str:
    if isinstance(error, BrokenExecutor) or type(error).__name__ == 'KilledWorker':
        return ('its worker was killed, perhaps since memory ran out; check the log, '
                'or give --workers 1')
    return f'its worker failed ({type(error).__name__}: {str(error)[:200]})'
