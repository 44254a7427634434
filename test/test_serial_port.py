"""
The port, on a pseudo-terminal, and the stamps, with times made up.

"""

import contextlib
import os
import random
import tty

import pytest

from gyro_calibration.serial_port import PortError, SampleClock, SerialPort

DAY = 1.7e9  # s; a time since 1970, where double precision is coarsest


@pytest.fixture
def terminal():
    """Return the file descriptor of the device's end, and the path of the other."""
    master, slave = os.openpty()
    tty.setraw(slave)
    yield master, os.ttyname(slave)
    for descriptor in (master, slave):
        with contextlib.suppress(OSError):  # the test may have unplugged it
            os.close(descriptor)


def test_what_is_there_is_read_at_once(terminal):
    master, path = terminal
    port = SerialPort(path, 115200)
    port.open()
    os.write(master, b'x' * 1000)
    assert port.read() == b'x' * 1000
    port.close()


def test_nothing_is_read_where_nothing_came(terminal):
    port = SerialPort(terminal[1], 115200, timeout=0.01)
    port.open()
    assert port.read() == b''
    assert port.is_open
    port.close()


def test_an_unplugged_port_is_lost_and_closed(terminal):
    master, path = terminal
    port = SerialPort(path, 115200)
    port.open()
    os.close(master)
    with pytest.raises(PortError, match=f'^lost {path}: the device is gone: plug it in again$'):
        port.read()
    assert not port.is_open


def test_a_port_is_for_one_program(terminal):
    first, second = SerialPort(terminal[1], 115200), SerialPort(terminal[1], 115200)
    first.open()
    with pytest.raises(PortError, match='another program has opened it'):
        second.open()
    first.close()
    second.open()
    second.close()


@pytest.mark.parametrize(('path', 'reason'), [
    ('/nonexistent/tty', 'does not exist'),
    ('', 'does not exist'),
    ('/', 'is a folder'),
    (__file__, 'no serial port'),
])
def test_a_port_that_cannot_be_opened_says_why(path, reason):
    with pytest.raises(PortError, match=f'^cannot open .*: .*{reason}.*: .*'):
        SerialPort(path, 115200).open()


def test_a_closed_port_cannot_be_read():
    with pytest.raises(PortError, match='not open'):
        SerialPort('/dev/null', 115200).read()


def chunks_of(period, count, seed):
    """Cut samples into chunks that come late at random; return the size and the arrival of each."""
    generator, waiting = random.Random(seed), 0
    for k in range(count):
        waiting += 1
        if generator.random() < 0.4:
            yield waiting, DAY + k * period
            waiting = 0


def test_arrival_stamps_increase_and_conserve_time():
    """The unit is 3 % slow: its nominal interval would lose 1.8 s a minute."""
    clock, stamps = SampleClock(100.0), []
    chunks = list(chunks_of(0.0103, 6000, seed=1))
    for count, arrival in chunks:
        stamps += clock.stamp([None] * count, arrival)
        assert stamps[-1] == arrival
    assert all(later > earlier for earlier, later in zip(stamps, stamps[1:], strict=False))
    first = chunks[0][0] - 1
    assert (stamps[-1] - stamps[first]) / (len(stamps) - 1 - first) == pytest.approx(0.0103, rel=1e-6)


def test_samples_of_a_chunk_are_spread_evenly():
    clock = SampleClock(1000.0)
    clock.stamp([None], DAY)
    assert clock.stamp([None] * 4, DAY + 0.006) == pytest.approx([DAY + 0.0015, DAY + 0.003, DAY + 0.0045, DAY + 0.006], abs=1e-6)


def test_samples_after_a_gap_stay_together():
    clock = SampleClock(100.0)
    for k in range(100):
        clock.stamp([None], DAY + 0.0105 * k)
    last = DAY + 0.0105 * 99
    stamps = clock.stamp([None] * 3, last + 5.0)
    assert [last + 5.0 - stamp for stamp in stamps] == pytest.approx([0.021, 0.0105, 0.0], abs=1e-4)


def test_a_rate_far_from_the_nominal_one_is_found():
    clock = SampleClock(100.0)
    for k in range(200):
        clock.stamp([None], DAY + k)
    stamps = clock.stamp([None] * 2, DAY + 210.0)
    assert stamps[1] - stamps[0] == pytest.approx(1.0, rel=0.05)


def test_many_samples_at_one_instant_still_increase():
    clock = SampleClock(1000.0)
    stamps = [stamp for _ in range(100) for stamp in clock.stamp([None] * 3, DAY)]
    assert all(later > earlier for earlier, later in zip(stamps, stamps[1:], strict=False))


def test_stamps_follow_a_host_clock_that_is_set_back():
    clock = SampleClock(100.0)
    clock.stamp([None], DAY)
    assert clock.stamp([None] * 2, DAY - 3600.0) == pytest.approx([DAY - 3600.01, DAY - 3600.0])


def test_device_time_keeps_its_intervals_in_a_fast_replay():
    """Rounded to double precision at each sample, the intervals would add up to 1e-4 less or more."""
    clock = SampleClock(100.0, use_device_time=True)
    stamps = [clock.stamp([50.0 + 0.001 * k], DAY + 1e-4 * k)[0] for k in range(100_000)]
    assert [stamps[1000 * k] - DAY for k in range(100)] == pytest.approx([float(k) for k in range(100)], abs=1e-6)


@pytest.mark.parametrize('jump', [-100.0, -0.5, 100.0])
def test_a_jump_of_device_time_never_puts_a_stamp_back(jump):
    clock = SampleClock(100.0, use_device_time=True)
    before = clock.stamp([10.0, 10.01, 10.02], DAY)[-1]
    after = clock.stamp([10.03 + jump, 10.04 + jump], DAY + 2.0)
    assert after == pytest.approx([DAY + 2.0, DAY + 2.01], abs=1e-5)
    replayed = clock.stamp([0.0], DAY - 5.0)
    assert before < after[0] < after[1] < replayed[0]


def test_samples_without_device_time_are_stamped_by_arrival():
    clock = SampleClock(100.0, use_device_time=True)
    assert clock.stamp([None, 3.0], DAY)[-1] == DAY
