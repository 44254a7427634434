# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Progress is shown on a terminal, with the elapsed time, and nowhere else."""

import io
import re
import sys
import time

from gyro_calibration.cli import verb


class Terminal(io.StringIO):
    """Text that was written to a terminal."""

    def isatty(self):
        return True


def test_a_long_step_is_shown_with_share_and_time_and_cleared_after_it(monkeypatch):
    terminal, until = Terminal(), time.monotonic() + 20.0
    monkeypatch.setattr(sys, 'stderr', terminal)
    monkeypatch.setattr(verb, 'PROGRESS_DELAY', 0.01)
    with verb.show_progress('fit') as on_progress:
        on_progress(0.5, 'search')
        while 'search' not in terminal.getvalue() and time.monotonic() < until:
            time.sleep(0.01)
    assert re.search(r' 50 %  search \.\.\.  \d+ s', terminal.getvalue())
    assert terminal.getvalue().endswith('\r\033[K')


def test_a_short_step_and_a_file_show_nothing(monkeypatch):
    for stream, delay in ((Terminal(), 20.0), (io.StringIO(), 0.0)):
        monkeypatch.setattr(sys, 'stderr', stream)
        monkeypatch.setattr(verb, 'PROGRESS_DELAY', delay)
        with verb.show_progress('fit'):
            pass
        assert not stream.getvalue()
