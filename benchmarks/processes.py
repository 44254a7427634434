"""Processes that are measured: how they end, and what they use."""

from contextlib import suppress
import signal
import subprocess
import time


def end(process: subprocess.Popen) -> None:
    """End a process, at all costs."""
    with suppress(ProcessLookupError):
        process.send_signal(signal.SIGINT)
    try:
        process.wait(10.0)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def processor_time(process: int) -> float:
    """Return the processor time of a process, s, by clock_getcpuclockid(3), finer than /proc."""
    return time.clock_gettime(~process << 3 | 2)
