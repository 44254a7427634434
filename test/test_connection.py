"""A gyro on a pseudo-terminal that is found, listened to, lost, and found again, without ROS."""

import contextlib
import itertools
import os
import resource
import select
import threading
import time
import tty

import pytest

from gyro_calibration.driver.connection import Connection, resolve
from gyro_calibration.driver.emulator import Emulator
from gyro_calibration.driver.protocols import PROTOCOLS, Sample, Settings, find
from gyro_calibration.driver.serial_port import PortError

ONE_COLUMN = Settings(columns=('gyro_dps',))


def turning(rate=0.5, frequency=100.0):
    """Return the samples of a gyro that turns for ever."""
    return (Sample(rate, 31.5, k / frequency) for k in itertools.count())


class Worker:
    """Works in `_thread` until `_stop` is set, while it is used as a context manager."""

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._stop.set()
        self._thread.join()


class Taker(Worker):
    """Takes chunks in a thread, as the driver does, and keeps them and the states."""

    def __init__(self, port, protocol='auto', **options):
        self.chunks, self.states, self._stop = [], [], threading.Event()
        self.connection = Connection(str(port), protocol, on_change=self.states.append, **options)
        self._thread = threading.Thread(target=self._take)

    def _take(self):
        for chunk in self.connection.chunks(self._stop):
            self.chunks.append(chunk)

    @property
    def samples(self):
        """All samples so far."""
        return [sample for chunk in self.chunks for sample in chunk.samples]

    @property
    def problems(self):
        """What was wrong so far."""
        return [state.problem for state in self.states if state.problem]


@pytest.fixture
def terminal():
    """Return the file descriptor of a device without a protocol, and the path of its port."""
    master, slave = os.openpty()
    tty.setraw(slave)
    yield master, os.ttyname(slave)
    os.close(master)
    os.close(slave)


def test_samples_come_with_stamps_that_increase(wait_until):
    with Emulator(find('csv'), turning()) as gyro, Taker(gyro.path, 'csv') as taker:
        wait_until(lambda: len(taker.samples) > 50)
        assert [state.name for state in taker.states] == ['reading']
        assert taker.connection.path == os.path.realpath(gyro.path)
    stamps = [stamp for chunk in taker.chunks for stamp in chunk.stamps]
    assert len(stamps) == len(taker.samples) == taker.connection.counts().samples
    assert all(later > earlier for earlier, later in itertools.pairwise(stamps))
    assert all(chunk.stamps[-1] <= chunk.arrival for chunk in taker.chunks)


@pytest.mark.parametrize('name', sorted(PROTOCOLS))
def test_auto_finds_the_protocol_and_says_what_it_heard(name, wait_until):
    settings = Settings(sensitivity=1e-6) if name == 'fizoptika' else Settings()
    with Emulator(find(name), turning(), settings) as gyro, Taker(gyro.path, settings=settings) as taker:
        wait_until(lambda: taker.samples, what=taker.states)
        assert taker.connection.protocol is find(name)
        assert name in taker.connection.heard
        assert [state.name for state in taker.states] == ['listening', 'reading']


def test_auto_with_a_baud_listens_at_that_one_only(terminal, wait_until):
    master, path = terminal
    with Taker(path, baud=57600) as taker:
        wait_until(lambda: os.write(master, b'\x00\x01\x02' * 10) and taker.problems)
    assert 'of no protocol for sure at 57600 bit/s' in taker.problems[0]


def test_auto_asks_for_what_the_protocol_needs(wait_until):
    settings = Settings(columns=('gyro_counts',), sensitivity=0.001)
    with Emulator(find('csv'), turning(), settings) as gyro, Taker(gyro.path, settings=Settings(columns=('gyro_counts',))) as taker:
        wait_until(lambda: taker.problems)
    assert taker.problems[0].startswith(f'csv comes on {gyro.path}, but columns hold gyro_counts, but sensitivity is not set')


def test_another_gyro_in_the_same_place_is_listened_to(tmp_path, wait_until):
    with Taker(tmp_path / 'gyro', silence_timeout=0.3) as taker:
        for name in ('kvh_dsp3000', 'minimu9'):
            with Emulator(find(name), turning(), link=tmp_path / 'gyro'):
                wait_until(lambda name=name: taker.connection.protocol is find(name) and taker.states[-1].name == 'reading')
    assert taker.connection.counts().samples == len(taker.samples)


def test_stamps_go_on_when_another_gyro_is_listened_to(tmp_path, wait_until):
    """What comes at once after a stall, at the slow rate that csv usually has, seems to have begun long before."""
    settings = Settings(columns=('gyro_dps',), sample_rate=10.0)
    with Taker(tmp_path / 'gyro', settings=settings, silence_timeout=0.3) as taker:
        for name in ('kvh_dsp3000', 'csv'):
            with Emulator(find(name), turning(), settings, link=tmp_path / 'gyro', speed=20.0):
                wait_until(lambda name=name: taker.connection.protocol is find(name) and taker.states[-1].name == 'reading')
    stamps = [stamp for chunk in taker.chunks for stamp in chunk.stamps]
    assert all(later > earlier for earlier, later in itertools.pairwise(stamps))


def test_a_gyro_is_found_again_under_another_name(tmp_path, wait_until):
    """As in /dev/serial/by-id, where the name holds the serial number of the adapter."""
    pattern = tmp_path / '*A9003XYZ*'
    with Taker(pattern, 'csv', reopen_interval=0.05) as taker:
        with Emulator(find('csv'), turning(0.1), link=tmp_path / 'usb-FTDI_A9003XYZ-if00-port0'):
            wait_until(lambda: len(taker.samples) > 5)
        wait_until(lambda: any('matches' in problem for problem in taker.problems))
        with Emulator(find('csv'), turning(0.2), link=tmp_path / 'usb-FTDI_A9003XYZ-if00-port1') as gyro:
            wait_until(lambda: taker.samples[-1].output > 0.15)
            assert taker.connection.path == os.path.realpath(gyro.link)
    assert any(f'no port matches {pattern}: plug the gyro in' in problem for problem in taker.problems)


def test_several_ports_that_match_are_named(tmp_path):
    for name in ('gyro_a', 'gyro_b'):
        (tmp_path / name).touch()
    with pytest.raises(PortError, match=r'2 ports match .*: .*gyro_a, .*gyro_b; set port to one of them'):
        resolve(str(tmp_path / 'gyro_?'))


def test_several_names_of_one_port_are_no_question(tmp_path):
    (tmp_path / 'tty').touch()
    for name in ('gyro_a', 'gyro_b'):
        (tmp_path / name).symlink_to(tmp_path / 'tty')
    assert resolve(str(tmp_path / 'gyro_*')) == str(tmp_path / 'gyro_a')


def test_waiting_doubles_up_to_its_limit(wait_until):
    with Taker('/nonexistent/gyro', 'csv', reopen_interval=0.01, reopen_limit=0.05) as taker:
        wait_until(lambda: len(taker.problems) > 5)
    assert [state.waiting for state in taker.states[:5]] == pytest.approx([0.01, 0.02, 0.04, 0.05, 0.05])


def test_a_missing_port_costs_next_to_nothing(wait_until):
    """Also where an interval of nothing is asked for, as far as the limit goes."""
    begin, since = resource.getrusage(resource.RUSAGE_SELF), time.monotonic()
    with Taker('/nonexistent/gyro', 'csv', reopen_interval=0.1, reopen_limit=0.4) as taker:
        wait_until(lambda: len(taker.problems) == 7)  # after 0, 0.1, 0.3, 0.7, 1.1, 1.5, 1.9 s
        waited, lasted, end = taker.connection.waited, time.monotonic() - since, resource.getrusage(resource.RUSAGE_SELF)
    assert end.ru_utime + end.ru_stime - begin.ru_utime - begin.ru_stime < 0.1
    assert 1.9 <= waited <= lasted


def test_waiting_ends_at_once(wait_until):
    taker = Taker('/nonexistent/gyro', 'csv', reopen_interval=60.0, reopen_limit=60.0)
    with taker:
        wait_until(lambda: taker.problems)
        begin = time.monotonic()
    assert time.monotonic() - begin < 5.0  # of 60 s; a busy machine is late


def test_listening_ends_at_once(terminal):
    _, path = terminal
    connection, stop = Connection(path, silence_timeout=60.0), threading.Event()
    threading.Timer(0.3, stop.set).start()
    begin = time.monotonic()
    assert list(connection.chunks(stop)) == [] and connection.state.name == 'listening'
    assert time.monotonic() - begin < 5.0  # of 60 s; a busy machine is late


def test_samples_end_the_waiting(tmp_path, wait_until):
    """Else a gyro with a loose plug would be waited for longer and longer."""
    with Taker(tmp_path / 'gyro', 'csv', reopen_interval=0.01, reopen_limit=10.0) as taker:
        wait_until(lambda: len(taker.problems) > 4)
        with Emulator(find('csv'), turning(), link=tmp_path / 'gyro'):
            wait_until(lambda: taker.samples)
        wait_until(lambda: taker.states[-1].name == 'failed')
        first = next(state for state in taker.states[taker.states.index(next(s for s in taker.states if s.name == 'reading')):]
                     if state.name == 'failed')
    assert first.waiting == pytest.approx(0.01)


def test_a_gyro_that_falls_silent_is_opened_again(terminal, wait_until):
    master, path = terminal
    with Taker(path, 'csv', settings=ONE_COLUMN, silence_timeout=0.2, reopen_interval=0.05) as taker:
        wait_until(lambda: os.write(master, b'1.0\r\n') and len(taker.samples) > 5)
        wait_until(lambda: taker.problems)
        count = len(taker.samples)
        wait_until(lambda: os.write(master, b'1.0\r\n') and len(taker.samples) > count)
        assert taker.connection.openings > 1
    assert taker.problems[0] == f'nothing comes on {path} for 0.2 s: check the power and the wires of the gyro'


class Board(Worker):
    """A microcontroller that restarts when its port is opened, is deaf and dumb meanwhile, and then says a line again and again."""

    def __init__(self, seconds, line, wanted=b'', answer=b''):
        self._seconds, self._line, self._wanted, self._answer = seconds, line, wanted, answer
        self._master, slave = os.openpty()
        tty.setraw(slave)
        self.path = os.ttyname(slave)
        os.close(slave)
        os.set_blocking(self._master, False)
        self._poll = select.poll()
        self._poll.register(self._master, select.POLLIN)
        self._stop, self._thread = threading.Event(), threading.Thread(target=self._run)
        self.asked = 0

    def _run(self):
        line, talks, was_open = self._line, 0.0, False
        while not self._stop.wait(0.01):
            events = dict(self._poll.poll(0)).get(self._master, 0)
            is_open = not events & select.POLLHUP
            if is_open and not was_open:
                line, talks = self._line, time.monotonic() + self._seconds
            was_open = is_open
            heard = os.read(self._master, 1000) if is_open and events & select.POLLIN else b''
            self.asked += heard.count(self._wanted) if self._wanted else 0
            if is_open and time.monotonic() > talks:
                line = self._answer if self._wanted and self._wanted in heard else line
                with contextlib.suppress(OSError):  # closed just now
                    os.write(self._master, line)

    def __exit__(self, *_):
        super().__exit__()
        os.close(self._master)


@pytest.mark.parametrize('protocol', ['razor', 'auto'])
def test_a_board_that_restarts_when_it_is_opened_is_asked_until_it_hears(protocol, wait_until):
    angles, rates = b'#YPR=-142.28,-5.38,33.52\r\n', b'#YPRAG=-142.28,-5.38,33.52,12.8,-25.6,256.00,0.01,0.02,-0.03\r\n'
    with Board(1.2, angles, b'#ox', rates) as board, Taker(board.path, protocol, silence_timeout=5.0) as taker:
        wait_until(lambda: taker.samples, what=taker.states)
        asked, count = board.asked, len(taker.samples)
        wait_until(lambda: len(taker.samples) > count + 150)  # 1.5 s
        assert taker.connection.openings == 1
        assert board.asked == asked, 'asked although it talks'


@pytest.mark.parametrize('protocol', ['csv', 'auto'])
def test_a_board_that_takes_long_to_restart_is_waited_for(protocol, wait_until):
    """Its silence is told meanwhile."""
    with Board(2.0, b'1.0\r\n') as board, Taker(board.path, protocol, settings=ONE_COLUMN, silence_timeout=0.3) as taker:
        wait_until(lambda: taker.samples, what=taker.states)
        assert taker.connection.openings == 1
    assert taker.problems[0] == f'nothing comes on {board.path} for 0.3 s: check the power and the wires of the gyro'


def test_a_board_that_says_something_else_while_it_starts_is_found_at_a_given_baud(terminal, wait_until):
    master, path = terminal
    with Taker(path, baud=115200, settings=ONE_COLUMN) as taker:
        wait_until(lambda: os.write(master, b'\x00\x01\x02' * 10) and taker.problems)
        wait_until(lambda: os.write(master, b'1.0\r\n2.0\r\n3.0\r\n') and taker.samples)
        assert taker.connection.openings == 1


def test_a_gyro_that_is_cut_off_in_a_frame_is_silent_and_stays_known(terminal, wait_until):
    """The rest of the frame is no bytes of another format."""
    master, path = terminal
    encode, numbers = find('kvh_dsp3000').encoder(), itertools.count()
    with Taker(path, silence_timeout=0.5) as taker:
        wait_until(lambda: os.write(master, encode(Sample(0.001 * next(numbers)))) and len(taker.samples) > 20)
        os.write(master, encode(Sample(0.5))[:9])
        wait_until(lambda: taker.problems)
        assert taker.connection.protocol is find('kvh_dsp3000')
    assert taker.problems[0] == f'nothing comes on {path} for 0.5 s: check the power and the wires of the gyro'


def test_a_pause_is_in_the_stamps_but_counts_as_no_loss(tmp_path, wait_until):
    with Taker(tmp_path / 'gyro', 'csv', reopen_interval=0.05) as taker:
        for _ in range(2):
            count = len(taker.samples)
            with Emulator(find('csv'), turning(), Settings(), link=tmp_path / 'gyro'):
                wait_until(lambda count=count: len(taker.samples) > count + 20)
            time.sleep(0.5)
        stamps = [stamp for chunk in taker.chunks for stamp in chunk.stamps]
        assert max(later - earlier for earlier, later in itertools.pairwise(stamps)) > 0.45
        assert taker.connection.counts().lost_samples == 0


def test_the_port_is_closed_when_nobody_takes_samples_any_more():
    with Emulator(find('csv'), turning()) as gyro:
        connection = Connection(gyro.path, 'csv')
        for _ in connection.chunks(threading.Event()):
            break
        other = Connection(gyro.path, 'csv')
        assert next(other.chunks(threading.Event())).samples


def test_a_protocol_that_is_not_known_is_refused():
    with pytest.raises(ValueError, match="protocol 'bogus' is not known"):
        Connection('/dev/null', 'bogus')
