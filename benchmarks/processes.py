"""Processes that are measured: how they end, and what they use."""

import signal
import subprocess
import time
from contextlib import suppress


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
    """Return what a process has used so far, s; by the clock of clock_getcpuclockid(3), which is finer than the ticks in /proc."""
    return time.clock_gettime(~process << 3 | 2)
