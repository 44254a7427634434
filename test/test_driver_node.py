"""The driver as a robot runs it: its own process, a pseudo-terminal for the gyro, and DDS."""

import contextlib
import itertools
import math
import os
import re
import signal
import subprocess
import sys
import time
import tty
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='ROS 2 (rclpy) is not installed')

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.srv import GetParameters
from rclpy.parameter import parameter_value_to_python
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu, Temperature

from gyro_calibration.driver.emulator import Emulator
from gyro_calibration.driver.protocols import Sample, Settings, find
from gyro_calibration.driver.serial_faults import Line
from gyro_calibration.ros.driver_node import PARAMETERS

CONFIGURATION = Path(__file__).parents[1] / 'config' / 'driver.yaml'
FAST = {'reopen_interval': 0.1, 'silence_timeout': 10.0}  # a busy machine may keep the emulated gyro silent
SOON = 0.5  # s; a silence after which it is to be told


class Robot:
    """A driver, and what it publishes."""

    def __init__(self, ros, start_node, wait_until, port, protocol, parameters):
        self.wait_until = wait_until
        self.rates = ros.collect(Imu, 'imu/data_raw')
        self.temperatures = ros.collect(Temperature, 'imu/temperature')
        self.diagnostics = ros.collect(DiagnosticArray, '/diagnostics', 10)
        self.node = start_node('driver_node', {'port': port, 'protocol': protocol, **FAST, **parameters})

    def receive(self, count=20):
        """Return the next messages with rates."""
        begin = len(self.rates)
        self.wait_until(lambda: len(self.rates) >= begin + count, what=f'{count} rates; output:\n{self.node.output}')
        return self.rates[begin:begin + count]

    def hears(self, text, level):
        """Wait until a diagnostic message with this text comes, and return its status."""
        def found():
            statuses = [array.status[0] for array in self.diagnostics]
            return next((status for status in statuses if text in status.message and status.level == level), None)
        return self.wait_until(found, what=f'{text!r} in {[array.status[0].message for array in self.diagnostics]}')


@pytest.fixture
def robot(ros, start_node, wait_until):
    """Return a function that starts a driver: ``robot(port, protocol, **parameters)``."""
    def start(port, protocol='csv', **parameters):
        return Robot(ros, start_node, wait_until, port, protocol, parameters)
    return start


@pytest.fixture
def terminal():
    """Return the file descriptor of a device without a protocol, and the path of its port."""
    master, slave = os.openpty()
    tty.setraw(slave)
    os.set_blocking(master, False)
    yield master, os.ttyname(slave)
    os.close(master)
    os.close(slave)


def turning(rate=0.5, temperature=31.5):
    """Return the samples of a gyro that turns for ever, at 100 Hz."""
    return (Sample(rate, temperature, k / 100.0) for k in itertools.count())


@pytest.mark.parametrize('protocol', ['kvh_dsp3000', 'kvh_ecore', 'minimu9', 'csv'])
def test_counter_clockwise_is_positive_in_rad_per_second(robot, protocol):
    with Emulator(find(protocol), turning(0.5)) as gyro:
        messages = robot(gyro.path, protocol, frame_id='my_gyro').receive()
    assert [message.angular_velocity.z for message in messages] == pytest.approx([0.5] * 20, abs=0.001)
    assert {message.header.frame_id for message in messages} == {'my_gyro'}
    assert {(message.angular_velocity.x, message.angular_velocity.y) for message in messages} == {(0.0, 0.0)}


def test_what_is_not_reported_is_marked_and_what_is_unknown_is_zero(robot):
    """REP-145: element 0 is -1 for a quantity that is not reported; a covariance of zeros is unknown."""
    with Emulator(find('csv'), turning()) as gyro:
        message = robot(gyro.path).receive(1)[0]
    assert message.orientation_covariance[0] == message.linear_acceleration_covariance[0] == -1.0
    assert list(message.angular_velocity_covariance) == [0.0] * 9


def test_a_known_noise_gives_z_its_variance_and_x_and_y_no_weight(robot):
    with Emulator(find('csv'), turning()) as gyro:
        message = robot(gyro.path, angular_velocity_standard_deviation=0.01).receive(1)[0]
    assert list(message.angular_velocity_covariance) == pytest.approx([1e6, 0, 0, 0, 1e6, 0, 0, 0, 1e-4])


def test_the_temperature_has_the_stamp_of_its_rate(robot, wait_until):
    with Emulator(find('csv'), turning(temperature=-12.25)) as gyro:
        driver = robot(gyro.path)
        wait_until(lambda: len({*map(seconds, driver.temperatures)} & {*map(seconds, driver.rates)}) > 15)
    assert {(message.temperature, message.variance) for message in driver.temperatures} == {(-12.25, 0.0)}


def seconds(message):
    """Return the stamp of a message."""
    return message.header.stamp.sec + message.header.stamp.nanosec * 1e-9


def test_stamps_increase_and_conserve_time(robot):
    saying_when = (Sample(number / 100.0, time=number / 100.0) for number in itertools.count())
    with Emulator(find('csv'), saying_when) as gyro:
        messages = robot(gyro.path).receive(200)
    stamps, times = [seconds(message) for message in messages], [message.angular_velocity.z for message in messages]
    assert all(later > earlier for earlier, later in itertools.pairwise(stamps))
    assert stamps[-1] - stamps[0] == pytest.approx(times[-1] - times[0], abs=0.1)


def test_a_replay_ten_times_faster_keeps_the_time_of_the_device(robot):
    with Emulator(find('csv'), turning(), speed=10.0) as gyro:
        stamps = [seconds(message) for message in robot(gyro.path, time_source='device').receive(500)]
    assert stamps[-1] - stamps[0] == pytest.approx(4.99, abs=1e-4)


def test_invert_and_sensitivity_are_used(robot):
    settings = Settings(columns=('gyro_counts',), sensitivity=0.001)
    with Emulator(find('csv'), turning(0.5), settings) as gyro:
        message = robot(gyro.path, columns='[gyro_counts]', sensitivity=0.002, invert='always').receive(1)[0]
    assert message.angular_velocity.z == pytest.approx(-1.0)


def test_a_thousand_samples_a_second_arrive(robot):
    """In a replay, which waits for a driver that a busy machine does not let read; a port loses what it has no room for."""
    samples = (Sample(1e-3 * k, 20.0, k / 500.0) for k in itertools.count())
    with Emulator(find('csv'), samples, speed=2.0) as gyro:
        rates = [message.angular_velocity.z for message in robot(gyro.path).receive(3000)]
    steps = [round((later - earlier) * 1e3) for earlier, later in itertools.pairwise(rates)]
    assert steps == [1] * 2999


def test_a_missing_port_is_reported_and_opened_when_it_comes(robot, tmp_path):
    driver = robot(tmp_path / 'gyro')
    driver.hears('does not exist: plug the gyro in', DiagnosticStatus.ERROR)
    with Emulator(find('csv'), turning(), link=tmp_path / 'gyro'):
        driver.receive()
        status = driver.hears('samples come', DiagnosticStatus.OK)
    assert status.name == 'driver_node: gyro' and status.hardware_id == str(tmp_path / 'gyro')


def test_after_unplugging_and_plugging_in_again_samples_come(robot, tmp_path):
    driver = robot(tmp_path / 'gyro')
    with Emulator(find('csv'), turning(0.1), link=tmp_path / 'gyro'):
        driver.receive()
    driver.hears('the device is gone', DiagnosticStatus.ERROR)
    with Emulator(find('csv'), turning(0.2), link=tmp_path / 'gyro'):
        driver.wait_until(lambda: driver.rates[-1].angular_velocity.z > 0.15)
        driver.wait_until(lambda: values_of(driver.diagnostics[-1])['reopened'] != '0')
    told = [array.status[0].message for array in driver.diagnostics if array.status[0].level == DiagnosticStatus.ERROR]
    assert values_of(driver.diagnostics[-1])['last error'] == told[-1]


def values_of(array):
    """Return the values of a diagnostic message by key."""
    return {pair.key: pair.value for pair in array.status[0].values}


@pytest.mark.parametrize(('protocol', 'line', 'reason'), [
    ('csv', b'', 'nothing comes'),
    ('csv', b'!ANG:1,2,3,AN:1,2,3,4,5,6,7,8,9\r\n', 'bytes come'),
    ('kvh_dsp3000', b'       0.015733   0\r\n', 'calls each of its samples invalid'),
    ('kvh_dsp3000', b'     999.000000   1\r\n', 'beyond full scale'),
])
def test_a_gyro_without_samples_is_reported_with_its_reason(robot, terminal, wait_until, protocol, line, reason):
    master, path = terminal
    driver = robot(path, protocol, silence_timeout=SOON)

    def heard():
        with contextlib.suppress(BlockingIOError):  # full, as long as the driver has not begun
            os.write(master, line)
        return any(reason in array.status[0].message for array in driver.diagnostics)
    wait_until(heard)
    assert driver.node.process.poll() is None


def test_what_is_wrong_is_logged_once_although_it_listens_again_between_two_attempts(robot, terminal, wait_until):
    _, path = terminal
    driver = robot(path, 'auto', reopen_interval=0.05, reopen_limit=0.05, silence_timeout=SOON)
    wait_until(lambda: int(newest(driver, 'reopened') or 0) > 0 and newest(driver, 'state') == 'failed')
    assert driver.node.output.count('nothing comes') == 1


def test_noise_does_not_end_it_and_is_counted(robot, terminal, wait_until):
    master, path = terminal
    driver = robot(path, 'kvh_dsp3000')

    def counted():
        with contextlib.suppress(BlockingIOError):  # full, as long as the driver has not begun
            os.write(master, os.urandom(200) + b'\r\n       0.015733   1\r\n')
        return any('discarded bytes' in status.message and status.level == DiagnosticStatus.WARN
                   for array in driver.diagnostics for status in array.status)
    wait_until(counted)
    assert {message.angular_velocity.z for message in driver.rates} == {-math.radians(0.015733)}


def test_the_rate_is_reported(robot, wait_until):
    with Emulator(find('csv'), turning()) as gyro:
        driver = robot(gyro.path)
        wait_until(lambda: any(95.0 < float(values_of(array)['rate in Hz']) < 105.0 for array in driver.diagnostics))


def test_the_startup_letters_are_sent(robot, terminal, wait_until):
    """The DSP-3000 sends rates after the letter R, three times."""
    master, path = terminal
    robot(path, 'kvh_dsp3000')
    received = []

    def heard():
        try:
            received.append(os.read(master, 100))
        except BlockingIOError:
            return False
        return b'RRR' in b''.join(received)
    wait_until(heard)


def test_a_signal_ends_it_with_code_0_while_it_reads(robot):
    with Emulator(find('csv'), turning()) as gyro:
        driver = robot(gyro.path)
        driver.receive()
        assert driver.node.stop() == 0


def test_an_impatient_second_signal_changes_nothing(robot):
    """Under a launch file Ctrl-C comes twice: from the terminal and from launch."""
    with Emulator(find('csv'), turning()) as gyro:
        driver = robot(gyro.path)
        driver.receive()
        for _ in range(40):
            driver.node.interrupt()
            time.sleep(0.01)
        assert driver.node.stop() == 0


def test_a_signal_ends_it_with_code_0_while_the_port_is_missing(robot):
    driver = robot('/nonexistent', reopen_interval=60.0, reopen_limit=60.0)
    driver.hears('does not exist', DiagnosticStatus.ERROR)
    assert driver.node.stop() == 0


@pytest.mark.parametrize(('parameters', 'sentence'), [
    ({'protocol': 'fizoptika'}, 'sensitivity is not set'),
    ({'protocol': 'bogus'}, 'csv, or auto to find it by listening'),
    ({'use_sim_time': 'maybe'}, "'use_sim_time' to 'maybe'"),
    ({'invert': 'maybe'}, "invert is 'maybe', but must be one of default, always, never"),
    ({'time_source': 'device'}, 'kvh_dsp3000 sends no time'),
    ({'columns': '[time_s]', 'protocol': 'csv'}, 'exactly one'),
    ({'baud': -1}, 'baud is -1, but must be from 0'),
    ({'reopen_interval': 'often'}, 'reopen_interval is .often., but must be a number'),
    ({'axis': 'w'}, 'axis is'),
])
def test_an_impossible_parameter_ends_it_with_one_sentence(start_node, parameters, sentence):
    node = start_node('driver_node', parameters)
    assert node.wait() == 2
    line, = node.output.strip().splitlines()
    assert sentence.replace('.often.', "'often'") in line
    assert line.startswith('DriverNode: ')


BROKEN = """
import sys
from gyro_calibration.ros import driver_node
def publish(self, samples, stamps, period):
    raise ZeroDivisionError('as if there were a fault in the program')
driver_node._Output.publish = publish
sys.exit(driver_node.main())
"""


def test_a_fault_of_the_program_in_the_reader_ends_the_node_and_is_told(ros_domain):
    """A node that lives on and publishes nothing would look well to whoever started it."""
    with Emulator(find('csv'), turning()) as gyro:
        command = [sys.executable, '-c', BROKEN, '--ros-args', '-p', f'port:={gyro.path}', '-p', 'protocol:=csv']
        ended = subprocess.run(command, capture_output=True, text=True, timeout=30.0)
    assert ended.returncode == 1 and 'as if there were a fault in the program' in ended.stderr
    assert 'the thread that reads the port has ended' in ended.stderr


def test_the_configuration_holds_each_parameter_with_its_default(start_node, ros, tmp_path):
    """One value is changed, to see that the file is read at all."""
    text = CONFIGURATION.read_text()
    assert re.findall(r'^    (\w+):', text, re.MULTILINE) == [parameter.name for parameter in PARAMETERS]
    changed = tmp_path / 'driver.yaml'
    changed.write_text(text.replace('frame_id: gyro', 'frame_id: changed'))
    start_node('driver_node', parameter_files=[changed])
    request = GetParameters.Request(names=[parameter.name for parameter in PARAMETERS])
    values = [parameter_value_to_python(value) for value in ros.call(GetParameters, '/driver_node/get_parameters', request).values]
    defaults = {parameter.name: parameter.default for parameter in PARAMETERS} | {'frame_id': 'changed'}
    assert [tuple(value) if isinstance(value, list) else value for value in values] == list(defaults.values())


def newest(driver, key):
    """Return a value of the newest diagnostics, empty before the first."""
    return values_of(driver.diagnostics[-1]).get(key, '') if driver.diagnostics else ''


def numbered(frequency=1000.0, health=None):
    """Return samples of a gyro that says its number in 1e-4 rad/s, so that holes can be seen in what is published."""
    return (Sample(1e-4 * k, 30.0, k / frequency, specific_force=9.81, health=health or {}) for k in itertools.count())


def numbers(messages):
    """Return which of the numbered samples were published."""
    return [round(message.angular_velocity.z * 1e4) for message in messages]


def unevenness(messages):
    """Return how far the stamps of numbered samples are from a millisecond apart, s, root mean square."""
    steps = [seconds(later) - seconds(earlier) for earlier, later in itertools.pairwise(messages)]
    advances = [later - earlier for earlier, later in itertools.pairwise(numbers(messages))]
    uneven = [step - advance * 0.001 for step, advance in zip(steps, advances, strict=True)]
    return math.sqrt(sum(each * each for each in uneven) / len(uneven))


def period(messages):
    """Return what the stamps go on by a sample, s."""
    return 1e-4 * (seconds(messages[-1]) - seconds(messages[0])) / (messages[-1].angular_velocity.z - messages[0].angular_velocity.z)


def test_stamps_are_even_although_a_usb_adapter_delivers_in_bursts(robot, wait_until):
    """Where this machine is busy elsewhere, the emulator itself may be late by a quarter of a second, now and then."""
    with Emulator(find('kvh_1750'), numbered(), line=Line(burst=0.016)) as gyro:
        driver = robot(gyro.path, 'kvh_1750')
        driver.receive(2500)
        wait_until(lambda: unevenness(driver.receive(1000)) < 0.0002, 60.0, 'a second without such a delay')
        wait_until(lambda: float(newest(driver, 'jitter before in ms') or 0.0) > 4.0)
        wait_until(lambda: float(newest(driver, 'jitter after in ms')) < 1.0, 60.0, 'ten seconds without such a delay')


def test_lost_samples_are_counted_from_the_sequence_and_left_out_of_the_stamps(robot, wait_until):
    line, generator = Line(lost_samples=0.02), np.random.default_rng(3)
    samples = itertools.islice(numbered(500.0), 3100)  # of which the last is not lost
    with Emulator(find('kvh_1750'), samples, None, 2.0, line=line, generator=generator, wait_for_reader=True) as gyro:
        driver = robot(gyro.path, 'kvh_1750')
        wait_until(lambda: numbers(driver.rates[-1:]) == [3099], 60.0, 'the last sample')
    wait_until(lambda: newest(driver, 'state') == 'failed')
    received = numbers(driver.rates)
    counted = int(newest(driver, 'samples')) + int(newest(driver, 'lost samples'))
    assert received[-1] - 2 <= counted <= received[-1] + 1  # the first ones may be lost before any came
    assert int(newest(driver, 'lost samples')) > 20
    pairs = zip(itertools.pairwise(driver.rates), itertools.pairwise(received), strict=True)
    holes = [seconds(later) - seconds(earlier) for (earlier, later), (last, next_) in list(pairs)[2000:] if next_ - last == 2]
    assert sum(holes) / len(holes) == pytest.approx(0.002, abs=0.0003)


def test_invalid_samples_are_counted_and_not_published(robot, wait_until):
    line, generator = Line(invalid_samples=0.05), np.random.default_rng(3)
    with Emulator(find('kvh_1750'), numbered(), line=line, generator=generator) as gyro:
        driver = robot(gyro.path, 'kvh_1750')
        driver.receive(1000)
        wait_until(lambda: int(newest(driver, 'device faults') or 0) > 20)
        assert 'device faults' in driver.hears('device faults', DiagnosticStatus.WARN).message
        advances = {later - earlier for earlier, later in itertools.pairwise(numbers(driver.rates))}
    assert advances & {2, 3} and min(advances) == 1


def test_the_specific_force_is_reported_with_an_unknown_covariance(robot):
    with Emulator(find('kvh_1750'), numbered()) as gyro:
        message = robot(gyro.path, 'kvh_1750').receive(1)[0]
    assert message.linear_acceleration.z == pytest.approx(9.81, rel=1e-3)
    assert list(message.linear_acceleration_covariance) == [0.0] * 9


def test_temperature_supply_and_source_current_are_in_the_diagnostics(robot, wait_until):
    health = {'supply_v': 5.0, 'source_current_a': 0.05, 'diagnostic_v': 1.0}
    samples = (Sample(0.1, 24.0, k / 1000.0, health=health) for k in itertools.count())
    with Emulator(find('fizoptika'), samples, Settings(sensitivity=1e-6)) as gyro:
        driver = robot(gyro.path, 'fizoptika', sensitivity=1e-6)
        status = driver.hears('source_current_a is 0.05, but should be from 0.07 to 0.15', DiagnosticStatus.WARN)
        wait_until(lambda: newest(driver, 'temperature_degc').startswith('24.0'))
    wait_until(lambda: newest(driver, 'state') == 'failed' and not {'temperature_degc', *health} & values_of(driver.diagnostics[-1]).keys())
    values = {pair.key: pair.value for pair in status.values}
    assert [float(values[name]) for name in health] == pytest.approx(list(health.values()), rel=1e-3)


def test_a_gyro_is_found_by_its_serial_number_under_another_name_and_by_listening(robot, wait_until, tmp_path):
    driver = robot(f'{tmp_path}/*A9003XYZ*', 'auto')
    for name, rate in (('usb-FTDI_A9003XYZ-if00', 0.1), ('usb-FTDI_A9003XYZ-if01', 0.2)):
        with Emulator(find('minimu9'), turning(rate), link=tmp_path / name) as gyro:
            wait_until(lambda rate=rate: driver.rates and abs(driver.rates[-1].angular_velocity.z - rate) < 0.01)
            wait_until(lambda gyro=gyro: newest(driver, 'device') == os.path.realpath(gyro.link) and newest(driver, 'state') == 'reading')
        assert newest(driver, 'protocol') == 'minimu9'
        assert 'minimu9 explains' in newest(driver, 'heard')
    driver.hears('no port matches', DiagnosticStatus.ERROR)


def processor_time(process):
    """Return the seconds that a process has computed so far."""
    fields = Path(f'/proc/{process.pid}/stat').read_text().rpartition(')')[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')


def test_while_the_port_is_missing_the_driver_waits_longer_and_longer_and_rests(robot, wait_until):
    driver = robot('/nonexistent', 'csv', reopen_interval=0.05, reopen_limit=0.8)
    driver.hears('does not exist', DiagnosticStatus.ERROR)
    wait_until(lambda: newest(driver, 'waiting in s') == '0.8')
    begin = processor_time(driver.node.process)
    time.sleep(2.0)
    assert processor_time(driver.node.process) - begin < 0.2
    assert driver.node.output.count('does not exist') == 1


def test_the_mean_of_several_samples_is_one_message(robot, wait_until):
    with Emulator(find('kvh_1750'), numbered()) as gyro:
        driver = robot(gyro.path, 'kvh_1750', samples_per_message=10, angular_velocity_standard_deviation=0.01)
        messages = driver.receive(200)
        wait_until(lambda: period(driver.receive(100)) == pytest.approx(0.001, rel=0.05), 60.0, 'stamps that have settled')
    steps = [1e4 * (later.angular_velocity.z - earlier.angular_velocity.z) for earlier, later in itertools.pairwise(messages)]
    assert sorted(steps)[100] == pytest.approx(10.0, abs=0.01)
    assert messages[-1].angular_velocity_covariance[8] == pytest.approx(1e-5)


def test_a_group_that_has_begun_is_published_when_the_gyro_falls_silent(robot, terminal, wait_until):
    master, path = terminal
    driver = robot(path, columns='[gyro_rad_s]', samples_per_message=1000, silence_timeout=SOON)
    wait_until(lambda: os.write(master, b'0.1\r\n') and int(newest(driver, 'samples') or 0) > 0)
    driver.hears('nothing comes', DiagnosticStatus.ERROR)
    wait_until(lambda: driver.rates)
    assert [message.angular_velocity.z for message in driver.rates] == pytest.approx([0.1])


TALKATIVE = """
import sys
from gyro_calibration.ros import driver_node
driver_node._Output._send = lambda self, stamp, output, *_: print(f'published {output:.3f}', file=sys.stderr)
sys.exit(driver_node.main())
"""


def test_a_group_that_has_begun_is_published_at_the_end(ros_domain):
    """It is asked what is published, since who ends so soon afterwards may take the message along."""
    with Emulator(find('csv'), turning(0.5)) as gyro:
        words = ['--ros-args', '-p', f'port:={gyro.path}', '-p', 'protocol:=csv', '-p', 'samples_per_message:=10000']
        with subprocess.Popen([sys.executable, '-c', TALKATIVE, *words], stderr=subprocess.PIPE, text=True) as process:
            before = next(line for line in process.stderr if 'samples of csv come' in line)
            process.send_signal(signal.SIGINT)
            after = process.communicate(timeout=30.0)[1]
    assert 'published' not in before and after.strip() == 'published 0.500' and process.returncode == 0


def test_angles_by_another_rate_than_the_gyro_sends_are_warned_of(robot):
    """The unit is set to 250 Hz, and nobody told the driver: its rates are 4 times too high."""
    samples = (Sample(0.01, 30.0, k / 250.0) for k in itertools.count())
    with Emulator(find('kvh_1750'), samples) as gyro:
        robot(gyro.path, 'kvh_1750').hears('samples a second are not the 1000 by which angles are made rates: set sample_rate',
                                           DiagnosticStatus.WARN)


def test_simulated_time_is_followed_as_soon_as_there_is_any(robot, ros, wait_until):
    """Before, stamps are those of the system; they never stand still."""
    clock = ros.publisher(Clock, '/clock', QoSProfile(depth=1))
    with Emulator(find('csv'), turning()) as gyro:
        driver = robot(gyro.path, use_sim_time='true')
        before = [seconds(message) for message in driver.receive(20)]
        wait_until(clock.get_subscription_count)
        for tick in [0] * 100 + list(range(200)):  # it stands for a second, and then runs
            clock.publish(Clock(clock=Time(sec=5000 + tick // 100, nanosec=tick % 100 * 10 ** 7)))
            time.sleep(0.01)
        wait_until(lambda: 5001.0 < seconds(driver.rates[-1]) < 6000.0)
        after = [seconds(message) for message in driver.rates if seconds(message) < 6000.0]
    assert all(abs(stamp - time.time()) < 60.0 for stamp in before)
    assert all(later > earlier for earlier, later in itertools.pairwise(after))
    assert 'use_sim_time is set' in driver.node.output
