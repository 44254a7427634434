# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""How much work something is, counted and not timed, so that a busy machine changes nothing."""

from collections.abc import Callable
import sys


def operations(work: Callable[[], object]) -> int:
    """
    Return how many lines of Python are run and how many functions are called.

    Loops over samples are seen however they are written; what a function of C does is one.

    """
    count, before = 0, (sys.gettrace(), sys.getprofile())

    def line(frame, event, _):
        nonlocal count
        count += 1
        return line

    def call(frame, event, _):
        nonlocal count
        count += event == 'c_call'
    sys.settrace(line)
    sys.setprofile(call)
    try:
        work()
    finally:
        sys.settrace(before[0])
        sys.setprofile(before[1])
    return count
