# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Stamps of gyros with known times, of a node, and of a host whose clock is set."""

from dataclasses import dataclass
import itertools
from itertools import pairwise

from gyro_calibration.driver.protocols import Sample
from gyro_calibration.driver.timestamps import (
    HostTimeConverter, NodeTimeConverter, read_clock_pair, SampleClock)
import numpy as np
import pytest

BURST = 0.016  # s; latency_timer of an FTDI adapter
BUFFER = 113  # samples of 36 bytes that a port holds at most
LEARNED = 5.0  # s; "after the first seconds"
HOUR = 3600.0


@dataclass
class Run:
    """Result of a clock: true times and stamps of the samples that came, and the number lost."""

    clock: SampleClock
    times: np.ndarray
    stamps: np.ndarray
    arrivals: np.ndarray
    truly_lost: int

    def error(self, begin=LEARNED):
        """Return the root mean square of the error of the stamps after a time, s."""
        return np.sqrt(np.mean((self.stamps - self.times)[self.times > begin] ** 2))


def true_times(rate, off, seconds):
    """Return send times of a clock that is off and drifts with a period of 600 s."""
    number = np.arange(int(rate * seconds))
    return 0.003 + np.cumsum(
        (1.0 + off + 1e-4 * np.sin(2.0 * np.pi * number / rate / 600.0)) / rate)


def arrivals_of(times, generator, burst=BURST, stalls=()):
    """Return arrival times: bursts, a host latency with a long tail, and stalls of 1 s."""
    sent = np.ceil(times / burst) * burst if burst else times
    _, first, which = np.unique(sent, return_index=True, return_inverse=True)
    late = (generator.exponential(1e-4, first.size)
            + (generator.random(first.size) < 0.02) * generator.exponential(0.01, first.size))
    arrivals = np.maximum.accumulate(sent[first] + late)
    for stall in stalls:
        arrivals[(arrivals > stall) & (arrivals < stall + 1.0)] = stall + 1.0
    return arrivals[which]


def chunks(arrivals):
    """Return slices of samples that arrive together, within the buffer, with their arrivals."""
    begins = np.flatnonzero(np.diff(arrivals, prepend=-1.0) > 0.0)
    for begin, end in pairwise([*begins, arrivals.size]):
        for number, part in enumerate(range(begin, end, BUFFER)):
            yield slice(part, min(part + BUFFER, end)), float(arrivals[begin]) + 1e-3 * number


def play(clock, times, arrivals, kept=None, **said):
    """Let a clock stamp the kept samples, with fields from the arrays in `said`."""
    kept = np.ones(times.size, bool) if kept is None else kept
    columns = {name: values[kept].tolist() for name, values in said.items()}
    samples = [Sample(0.0, **dict(zip(columns, row, strict=True)))
               for row in zip(*columns.values(), strict=True)]
    samples = samples or [Sample(0.0)] * int(kept.sum())
    stamps = []
    for part, arrival in chunks(arrivals[kept]):
        stamps += clock.stamp_samples(samples[part], arrival)
    return Run(clock, times[kept], np.array(stamps), arrivals[kept], int(times.size - kept.sum()))


def sequence(times):
    return np.arange(times.size) % 128


@pytest.fixture
def generator():
    return np.random.default_rng(6)


@pytest.mark.parametrize('off', [-0.03, 0.002, 0.03])
@pytest.mark.parametrize('rate', [10, 100, 1000])
def test_stamps_are_right_where_samples_come_in_bursts_on_a_busy_host(rate, off, generator):
    """Far below 16 ms and the period; beats with bursts may make a few of 30000 seem lost."""
    times = true_times(rate, off, 60.0)
    run = play(SampleClock(rate), times, arrivals_of(times, generator, stalls=(20.0, 40.3)))
    assert run.error() < min(0.0015, 0.35 / rate)
    assert (np.diff(run.stamps) > 0.0).all()
    assert run.clock.lost_count <= 3
    assert run.stamps[-1] - run.stamps[0] == pytest.approx(times[-1] - times[0], abs=BURST)
    assert run.clock.period == pytest.approx(np.diff(times)[-1], rel=3e-4)


def test_nothing_drifts_in_an_hour_and_a_host_without_bursts_costs_its_latency_only(generator):
    times = true_times(10, 0.03, HOUR)
    run = play(SampleClock(10.0), times, arrivals_of(times, generator))
    error = run.stamps - times
    assert abs(error[-600:].mean() - error[600:1200].mean()) < 0.001
    assert run.error() < 0.002
    times = true_times(1000, 0.01, 20.0)
    run = play(SampleClock(1000.0), times, arrivals_of(times, generator, burst=0.0))
    assert run.error() < 5e-5


def lose(times, runs):
    """Return which samples are kept where so many are lost at these times."""
    kept = np.ones(times.size, bool)
    for begin, count in runs:
        first = np.searchsorted(times, begin)
        kept[first:first + count] = False
    return kept


RUNS = ((10.0, 1), (11.0, 2), (15.0, 126), (20.0, 50), (40.0, 300))


@pytest.mark.parametrize('rate, later', [(100, 0.0), (1000, 0.0), (1000, 0.01)])
def test_lost_samples_are_counted_exactly_by_the_sequence(rate, later, generator):
    times = true_times(rate, 0.02, 60.0)
    kept = lose(times, RUNS) & (generator.random(times.size) >= 0.01)
    kept[[0, -1]] = True  # nobody sees these lost
    arrivals = arrivals_of(times, generator, stalls=(30.0,)) + later * (times % 15.0 > 10.0)
    run = play(SampleClock(rate, 128), times, np.maximum.accumulate(arrivals), kept,
               sequence=sequence(times))
    assert run.clock.lost_count == run.truly_lost
    # For 0.3 s the number of wraps of the sequence is unknown.
    late = (run.times > 45.0) | (run.times < 40.0)
    assert np.abs(run.stamps - run.times)[late & (run.times > LEARNED)].max() < 0.7 / rate


@pytest.mark.parametrize(('rate', 'begin'), [(1000, 0.0), (1000, 10.0), (5000, 0.5)])
def test_where_a_sequence_stands_still_samples_are_counted(rate, begin, generator):
    """Up to a cycle when it goes on; what is lost meanwhile is counted by the time that passed."""
    times = true_times(rate, 0.01, 20.0)
    stands = sequence(times)[np.searchsorted(times, begin)]
    said = np.where((times > begin) & (times < 14.0), stands, sequence(times))
    kept = lose(times, ((12.0, 100),))
    run = play(SampleClock(rate, 128), times, arrivals_of(times, generator, stalls=(11.0,)), kept,
               sequence=said)
    assert run.clock.lost_count == pytest.approx(100, abs=128)
    # what shows by its time, as a sequence that goes on, shows after 0.3 s
    late = (run.times > 14.5) | (run.times > 13.0) & (run.times < 14.0) | (run.times < 12.0)
    assert np.abs(run.stamps - run.times)[late & (run.times > LEARNED)].max() < BURST
    assert (np.diff(run.stamps) > 0.0).all()


@pytest.mark.parametrize('rate', [10, 100, 1000])
def test_samples_lost_without_a_trace_are_counted_by_the_time_that_passed(rate, generator):
    times = true_times(rate, 0.02, 80.0)
    kept = lose(times, ((10.0, 1), (20.0, 50), (40.0, 300)))
    run = play(SampleClock(rate), times, arrivals_of(times, generator), kept)
    assert run.clock.lost_count == run.truly_lost
    assert np.abs(run.stamps - run.times)[run.times > 78.0].max() < 0.35 / rate


@pytest.mark.parametrize('rate', [10, 100, 500])
def test_what_was_counted_too_often_is_taken_back(rate, generator):
    """A sample cannot arrive before it is sent."""
    times = true_times(rate, -0.01, 60.0)
    missing = ((generator.random(times.size) < min(0.05, 2.5 / rate)) & (times > LEARNED)).astype(
        int)
    run = play(SampleClock(rate), times, arrivals_of(times, generator), missing=missing)
    assert run.clock.lost_count <= 1 + 0.05 * missing.sum() < missing.sum()
    assert run.error() < 0.003


@pytest.mark.parametrize(('rate', 'burst'), [(125.3, 0.016), (62.9, 0.016), (100.3, 0.01)])
def test_bursts_that_beat_with_the_samples_lose_none(rate, burst):
    """Their lateness grows to a period and falls to zero, about once a second."""
    times = np.arange(0.0, 60.0, 1.0 / rate)
    arrivals = np.ceil(times / burst) * burst
    clock, stamps = SampleClock(round(rate)), []
    for arrival, group in itertools.groupby(arrivals.tolist()):
        stamps += clock.stamp_samples([Sample(0.0)] * len([*group]), arrival)
    assert clock.lost_count == 0
    assert np.ptp((stamps - times)[times > 20.0]) < 0.001


@pytest.mark.parametrize('outage, off', [(0.0, 0), (5.0, 5)])
def test_the_time_of_the_device_is_fitted_like_a_number(outage, off, generator):
    """Here it tells of lost samples, too, and of the uneven loop of a microcontroller."""
    times = true_times(100, 0.0, 30.0) + generator.uniform(-5e-4, 5e-4, 3000)
    kept = (generator.random(times.size) >= 0.01) & (abs(times - 15.0) > 0.5 * outage)
    kept[[0, -1]] = True
    run = play(SampleClock(100.0), times, arrivals_of(times, generator), kept,
               time=50.0 + times / 1.02)
    assert run.error() < 0.001
    assert abs(run.clock.lost_count - run.truly_lost) <= off


DAMAGED = {  # time, generator -> what a line that is damaged there says
    'ahead': lambda time, generator: time + generator.uniform(0.0, 3.0),
    'back': lambda time, generator: time - generator.uniform(0.0, 3.0),
    'a digit': lambda time, generator: time + generator.integers(-9, 10) * 10.0 ** -generator.
    integers(0, 4),
}


@pytest.mark.parametrize('damage', DAMAGED.values(), ids=DAMAGED)
def test_times_of_the_device_that_are_often_damaged_lose_no_sample(damage, generator):
    times = true_times(100, 0.0, 60.0)
    said = np.round([damage(time, generator) if generator.random() < 0.05 else time
                     for time in 50.0 + times], 3)
    run = play(SampleClock(100.0), times, arrivals_of(times, generator), time=said)
    assert run.clock.lost_count < 0.5 * np.count_nonzero(said != np.round(50.0 + times, 3))
    assert abs(run.stamps - times).max() < 0.1


@pytest.mark.parametrize('outage', [0.5, 1.5, 2.5])
def test_what_a_device_has_not_sent_while_it_restarted_is_lost(outage, generator):
    """It is silent, and its time begins anew; the line was not reopened."""
    times = true_times(100.0, 0.0, 40.0)
    kept = (times < 15.0) | (times > 15.0 + outage)
    clock = SampleClock(100.0)
    run = play(clock, times, arrivals_of(times, generator), kept,
               time=np.where(times < 15.0, times + 500.0, times - 14.0))
    assert clock.lost_count == pytest.approx(run.truly_lost, abs=5)
    errors = np.abs(run.stamps - run.times)[run.times > 15.1 + outage]
    assert errors.max() < 0.05 and np.median(errors) < 0.02


@pytest.mark.parametrize(('outage', 'first'), [(0.0, 0), (0.3, 64), (0.55, 0), (1.0, 64)])
def test_after_a_sequence_that_began_anew_stamps_are_soon_right_to_a_burst(
        outage, first, generator):
    before, after = true_times(1000, 0.01, 20.0), true_times(1000, 0.01, 20.0)
    times = np.concatenate([before, before[-1] + outage + after])
    said = np.concatenate([sequence(before), (first + sequence(after)) % 128])
    run = play(SampleClock(1000.0, 128), times, arrivals_of(times, generator), sequence=said)
    assert (np.abs(run.stamps - run.times)[run.times > after[0] + before[-1] + outage + 3.0].max()
            < 0.02)
    assert (np.diff(run.stamps) > 0.0).all()


@pytest.mark.parametrize('by', [-HOUR, HOUR])
def test_another_clock_is_followed_slowly_and_at_once_where_it_was_set(by):
    node, others = NodeTimeConverter(), []
    for k in range(2000):
        steady = 100.0 + 0.01 * k
        node.update(steady, 1.7e9 + 1.0005 * steady + by * (k >= 1000))
        others.append(node.convert(steady))
    true = [1.7e9 + 1.0005 * (100.0 + 0.01 * k) + by * (k >= 1000) for k in range(2000)]
    assert others == pytest.approx(true, rel=0.0, abs=0.002)
    steps = np.diff(others)
    assert (np.delete(steps, 999) > 0.0).all() and steps[999] == pytest.approx(by, abs=0.02)


def test_another_clock_that_runs_at_half_speed_or_stands_puts_no_stamp_back():
    node, others = NodeTimeConverter(), []
    for k in range(2000):
        node.update(0.01 * k, min(0.005 * k, 8.0))
        others.append(node.convert(0.01 * k - 0.002))
    assert (np.diff(others) > 0.0).all()
    assert others[1500] == pytest.approx(7.5, abs=0.15)


INTERVAL = 0.01


def driven(step, seen=0, lost=0):
    """Return times of samples and others; the clock is set midway, seen `seen` samples early."""
    stamps, times, others_times, last, shift = HostTimeConverter(), [], [], 0.0, 0.0
    for number in range(200):
        now = INTERVAL * number
        if 100 <= number < 100 + lost:
            continue
        shift += stamps.update(now + 1e-4, 1e9 + now + (step if number >= 100 - seen else 0.0))
        stamp = 5.0 + now + (step if number >= 100 else 0.0)
        others_times.append(stamps.convert_message(stamp, times[-1] if times else stamp))
        times.append(stamps.convert_sample(stamp, times[-1] if times else -np.inf, INTERVAL,
                                           now - last))
        last = now
    return np.array(times), np.array(others_times), stamps, shift


@pytest.mark.parametrize('step', [3600.0, -3600.0, 2e7, 0.5, -0.3])
@pytest.mark.parametrize('seen', [0, 5])
def test_times_go_on_where_the_clock_is_set(step, seen):
    times, others_times, stamps, shift = driven(step, seen)
    assert (np.diff(times) == pytest.approx(np.full(199, INTERVAL), abs=1e-6)
            and stamps.steps.count == 1)
    assert (others_times == pytest.approx(times, abs=1e-6)
            and shift == pytest.approx(step, abs=1e-6))


@pytest.mark.parametrize('step', [3600.0, 0.5, 0.3, -0.3, -1.0])
@pytest.mark.parametrize('lost', [10, 25, 60])
def test_what_is_lost_while_the_clock_is_set_is_a_gap_of_its_own_length(step, lost):
    times, *_ = driven(step, lost=lost)
    assert np.diff(times).max() == pytest.approx((lost + 1) * INTERVAL, abs=1e-6)


@pytest.mark.parametrize('step', [0.12, -0.12, 0.2, -1.0])
@pytest.mark.parametrize('gap, waited', [(0.15, 0.0005), (0.05, 0.15), (0.2, 0.33), (0.3, 0.18)])
def test_a_gap_with_late_arrivals_after_a_step_keeps_its_length(step, gap, waited):
    times, _, stamps, _ = driven(step)
    after = stamps.convert_sample(5.0 + INTERVAL * 199 + step + gap, times[-1], INTERVAL, waited)
    assert after - times[-1] == pytest.approx(gap)


def test_a_clock_that_is_slewed_is_not_set_and_an_old_step_explains_no_jump_of_the_stamps():
    stamps = HostTimeConverter()
    assert stamps.convert_message(-50.0, 200.0) == -50.0
    for number in range(20000):
        assert stamps.update(0.01 * number, 1e9 + 0.01 * number * 1.0005) == 0.0
    assert stamps.update(200.0, 1e9 + 3800.0) > 3500.0
    stamps.update(211.0, 1e9 + 3811.0)
    stamps.update(212.0, 1e9 + 3812.0)
    assert stamps.convert_sample(3812.0, 200.0, 0.01) == 3812.0


@pytest.mark.parametrize('pauses, found', [((0.002,), 10.001), ((0.3, 0.002), 10.301),
                                           ((0.3,) * 9, None)])
def test_clocks_are_compared_again_after_a_pause_between_them(pauses, found):
    times = itertools.chain.from_iterable(
        (10.0 + begin, 10.0 + begin + pause)
        for begin, pause in zip(itertools.accumulate(pauses, initial=0.0), pauses))
    read = read_clock_pair(times.__next__, lambda: 1e9)
    assert read == (found and pytest.approx((found, 1e9)))
