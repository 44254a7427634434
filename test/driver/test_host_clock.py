# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Stamps of a clock that is set: one axis of time, whoever sees the step first."""

import itertools

from gyro_calibration.driver.timestamps import HostTimeConverter, read_clock_pair
import numpy as np
import pytest

INTERVAL = 0.01


def driven(step, seen=0, lost=0, others=0.0):
    """Return times of samples and others; the clock is set midway, seen `seen` samples early."""
    stamps, times, others_times = HostTimeConverter(), [], []
    for number in range(200):
        now = INTERVAL * number
        if 100 <= number < 100 + lost:
            continue
        stamps.update(now + 1e-4, 1e9 + now + (step if number >= 100 - seen else 0.0))
        stamp = 5.0 + now + (step if number >= 100 else 0.0)
        others_times.append(stamps.convert_message(stamp + others, times[-1] if times else stamp))
        times.append(stamps.convert_sample(stamp, times[-1] if times else -np.inf, INTERVAL))
    return np.array(times), np.array(others_times), stamps


@pytest.mark.parametrize('step', [3600.0, -3600.0, 2e7, 0.5, -0.3])
@pytest.mark.parametrize('seen', [0, 5])
def test_times_go_on_where_the_clock_is_set(step, seen):
    times, others_times, stamps = driven(step, seen)
    assert (np.diff(times) == pytest.approx(np.full(199, INTERVAL), abs=1e-6)
            and stamps.steps.count == 1)
    assert (others_times == pytest.approx(times, abs=1e-6)
            and stamps.steps.last_step == pytest.approx(step, abs=1e-6))


def test_what_is_lost_while_the_clock_is_set_is_a_gap_of_its_own_length():
    times, _, _ = driven(3600.0, lost=30)
    assert np.diff(times).max() == pytest.approx(31 * INTERVAL, abs=1e-6)


def test_another_jump_of_the_stamps_is_one():
    stamps, before = HostTimeConverter(), 0.0
    for number in range(100):
        stamps.update(INTERVAL * number, 1e9 + INTERVAL * number)
        before = stamps.convert_sample(INTERVAL * number, before, INTERVAL)
    assert stamps.convert_sample(3600.0, before, INTERVAL) == 3600.0 and stamps.steps.count == 0
    assert stamps.convert_message(-50.0, before) == -50.0


def test_a_clock_that_is_slewed_is_not_set_and_an_old_step_explains_nothing():
    stamps = HostTimeConverter()
    for number in range(20000):
        assert stamps.update(0.01 * number, 1e9 + 0.01 * number * 1.0005) == 0.0
    assert stamps.update(200.0, 1e9 + 3800.0) > 3500.0
    stamps.update(211.0, 1e9 + 3811.0)
    stamps.update(212.0, 1e9 + 3812.0)
    assert stamps.convert_sample(3812.0, 200.0, 0.01) == 3812.0


def test_a_step_before_the_first_sample_swallows_no_gap():
    stamps = HostTimeConverter()
    stamps.update(0.0, 1000.0)
    assert stamps.update(1.0, 1001.3) == pytest.approx(0.3)
    times = [-np.inf]
    for stamp in (5.0, 5.01, 5.31):
        times.append(stamps.convert_sample(stamp, times[-1], 0.01))
    assert times[1:] == [5.0, 5.01, 5.31]


@pytest.mark.parametrize('step', [3600.0, -3600.0])
def test_a_step_between_the_first_samples_leaves_times_that_go_on(step):
    stamps = HostTimeConverter()
    stamps.update(0.0, 1000.0)
    first = stamps.convert_sample(5.0, -np.inf, np.inf)
    stamps.update(0.1, 1000.1 + step)
    times = [first]
    for stamp in (5.01, 5.02):
        times.append(stamps.convert_sample(stamp + step, times[-1],
                                           np.inf if len(times) == 1 else 0.01))
    assert times == pytest.approx([5.0, 5.01, 5.02])


@pytest.mark.parametrize('pauses, found', [((0.002,), 10.001), ((0.3, 0.002), 10.301),
                                           ((0.3,) * 9, None)])
def test_clocks_are_compared_again_after_a_pause_between_them(pauses, found):
    times = itertools.chain.from_iterable(
        (10.0 + begin, 10.0 + begin + pause)
        for begin, pause in zip(itertools.accumulate(pauses, initial=0.0), pauses))
    read = read_clock_pair(times.__next__, lambda: 1e9)
    assert read == (found and pytest.approx((found, 1e9)))
