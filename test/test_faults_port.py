"""The driver on a port that goes and comes back, is taken by another program, and gives single bytes."""

import itertools
import os
import time
from dataclasses import replace
from pathlib import Path

import pytest

from gyro_calibration.driver.emulator import Emulator
from gyro_calibration.driver.protocols import Sample, Settings, find
from gyro_calibration.driver.serial_faults import Line
from gyro_calibration.driver.serial_port import SerialPort

try:
    from diagnostic_msgs.msg import DiagnosticArray
    from sensor_msgs.msg import Imu
except ImportError:
    pass  # the fixture `ros` skips every test that needs them, and says why

TIMES = 100
PROMPT = {'protocol': 'csv', 'columns': '[gyro_rad_s]', 'reopen_interval': 0.05, 'reopen_limit': 0.2, 'silence_timeout': 10.0}
SETTINGS = Settings(columns=('gyro_rad_s',))


def gyro(link, output, rate=1000.0, **how):
    """Return an emulated gyro that says `output` of a number of a sample."""
    samples = (Sample(output(number), time=number / rate) for number in itertools.count())
    return Emulator(find('csv'), samples, SETTINGS, link=link, **how)


def held(process):
    """Return how many threads and file descriptors a process has, and its resident memory in bytes."""
    folder = Path(f'/proc/{process}')
    memory = int((folder / 'statm').read_text().split()[1]) * os.sysconf('SC_PAGE_SIZE')
    return len(list((folder / 'task').iterdir())), len(list((folder / 'fd').iterdir())), memory


def processor_time(process):
    """Return what a process has used, s; by the clock of clock_getcpuclockid(3)."""
    return time.clock_gettime(~process << 3 | 2)


def test_a_port_that_goes_and_comes_back_100_times(start_node, ros, wait_until, tmp_path):
    node = start_node('driver_node', parameters=PROMPT | {'port': tmp_path / 'gyro'})
    rates, reports, after = ros.collect(Imu, 'imu/data_raw'), ros.collect(DiagnosticArray, '/diagnostics', 10), []
    for number in range(1, TIMES + 1):
        with gyro(tmp_path / 'gyro', lambda _, sent=0.01 * number: sent):
            wait_until(lambda sent=0.01 * number: rates and rates[-1].angular_velocity.z == pytest.approx(sent), what=f'return {number}')
            after.append(held(node.process.pid))
        rates.clear()
    warm, last = after[TIMES // 5], after[-1]
    assert last[:2] == warm[:2], f'threads and file descriptors grow: {after[::10]}'
    assert last[2] < 1.05 * warm[2]
    _a_port_that_is_gone_takes_no_time(node.process.pid)
    wait_until(lambda: any(f'{TIMES - 1}' == pair.value for pair in _values(reports) if pair.key == 'reopened'), what='the count')
    _a_port_that_is_taken_is_told_and_used_when_it_is_free(tmp_path / 'gyro', rates, reports, wait_until)


def _a_port_that_is_gone_takes_no_time(process):
    begin, used = time.monotonic(), processor_time(process)
    time.sleep(1.5)
    assert processor_time(process) - used < 0.15 * (time.monotonic() - begin), 'a busy loop'


def _a_port_that_is_taken_is_told_and_used_when_it_is_free(link, rates, reports, wait_until):
    device = gyro(link.with_name('other'), lambda _: 0.5)
    with device:
        other = SerialPort(device.path, 115200)
        other.open()
        rates.clear()
        os.symlink(device.path, link)
        wait_until(lambda: 'another program has opened it' in reports[-1].status[0].message, what='that the port is taken')
        assert not rates
        other.close()
        wait_until(lambda: rates, what='samples')
    link.unlink()


def _values(reports):
    return reports[-1].status[0].values if reports else []


def test_single_bytes_make_whole_samples(start_node, ros, wait_until, tmp_path):
    """As a slow line gives them to a fast host: 9600 bit/s is a byte a millisecond."""
    start_node('driver_node', parameters=PROMPT | {'port': tmp_path / 'gyro'})
    rates = ros.collect(Imu, 'imu/data_raw')
    samples = (Sample(0.001 * number, time=number / 80.0) for number in itertools.count())
    with Emulator(replace(find('csv'), baud=9600), samples, SETTINGS, link=tmp_path / 'gyro', line=Line(piece=1)):
        wait_until(lambda: len(rates) > 150, what='samples')
    numbers = [round(1000.0 * message.angular_velocity.z) for message in rates]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
