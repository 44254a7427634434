"""
The driver as a robot runs it: its own process, a pseudo-terminal for the gyro, and DDS.

"""

import itertools
import math
import os
import re
import time
import tty
from pathlib import Path

import pytest

pytest.importorskip('rclpy', reason='ROS 2 (rclpy) is not installed')

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.srv import GetParameters
from rclpy.parameter import parameter_value_to_python
from sensor_msgs.msg import Imu, Temperature

from gyro_calibration.driver_node import PARAMETERS
from gyro_calibration.emulator import Emulator
from gyro_calibration.protocols import Sample, Settings, find

CONFIGURATION = Path(__file__).parents[1] / 'config' / 'driver.yaml'
FAST = {'reopen_interval': 0.1, 'silence_timeout': 0.5}


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
        driver.receive()
    assert {message.temperature for message in driver.temperatures} == {-12.25}
    assert {message.variance for message in driver.temperatures} == {0.0}
    stamps = {(message.header.stamp.sec, message.header.stamp.nanosec) for message in driver.temperatures}
    assert len(stamps & {(message.header.stamp.sec, message.header.stamp.nanosec) for message in driver.rates}) > 15


def seconds(message):
    """Return the stamp of a message."""
    return message.header.stamp.sec + message.header.stamp.nanosec * 1e-9


def test_stamps_increase_and_conserve_time(robot):
    with Emulator(find('csv'), turning()) as gyro:
        stamps = [seconds(message) for message in robot(gyro.path).receive(200)]
    assert all(later > earlier for earlier, later in itertools.pairwise(stamps))
    assert stamps[-1] - stamps[0] == pytest.approx(1.99, abs=0.1)


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
    samples = (Sample(1e-3 * k, 20.0, k / 1000.0) for k in itertools.count())
    with Emulator(find('csv'), samples) as gyro:
        rates = [message.angular_velocity.z for message in robot(gyro.path).receive(3000)]
    steps = [round((later - earlier) * 1e3) for earlier, later in itertools.pairwise(rates)]
    assert steps == [1] * 2999


def test_a_missing_port_is_reported_and_opened_when_it_comes(robot, tmp_path):
    driver = robot(tmp_path / 'gyro')
    driver.hears('does not exist: plug the gyro in', DiagnosticStatus.ERROR)
    with Emulator(find('csv'), turning(), link=tmp_path / 'gyro'):
        driver.receive()
        status = driver.hears('samples come', DiagnosticStatus.OK)
    assert status.name == 'driver_node: gyro'


def test_after_unplugging_and_plugging_in_again_samples_come(robot, tmp_path):
    driver = robot(tmp_path / 'gyro')
    with Emulator(find('csv'), turning(0.1), link=tmp_path / 'gyro'):
        driver.receive()
    driver.hears('the device is gone', DiagnosticStatus.ERROR)
    with Emulator(find('csv'), turning(0.2), link=tmp_path / 'gyro'):
        driver.wait_until(lambda: driver.rates[-1].angular_velocity.z > 0.15)
        driver.wait_until(lambda: values_of(driver.diagnostics[-1])['reopened'] != '0')
    assert 'the device is gone' in values_of(driver.diagnostics[-1])['last error']


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
    driver = robot(path, protocol)

    def heard():
        os.write(master, line)
        return any(reason in array.status[0].message for array in driver.diagnostics)
    wait_until(heard)
    assert driver.node.process.poll() is None


def test_noise_does_not_end_it_and_is_counted(robot, terminal, wait_until):
    master, path = terminal
    driver = robot(path, 'kvh_dsp3000')

    def received():
        os.write(master, os.urandom(200) + b'\r\n       0.015733   1\r\n')
        return len(driver.rates) > 50
    wait_until(received)
    assert {message.angular_velocity.z for message in driver.rates} == {-math.radians(0.015733)}
    assert 'discarded bytes' in driver.hears('in the last second there were: discarded bytes', DiagnosticStatus.WARN).message


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
        assert driver.node.stop(timeout=3.0) == 0


def test_an_impatient_second_signal_changes_nothing(robot):
    """Under a launch file Ctrl-C comes twice: from the terminal and from launch."""
    with Emulator(find('csv'), turning()) as gyro:
        driver = robot(gyro.path)
        driver.receive()
        for _ in range(40):
            driver.node.interrupt()
            time.sleep(0.01)
        assert driver.node.stop(timeout=3.0) == 0


def test_a_signal_ends_it_with_code_0_while_the_port_is_missing(robot):
    driver = robot('/nonexistent', reopen_interval=60.0)
    driver.hears('does not exist', DiagnosticStatus.ERROR)
    assert driver.node.stop(timeout=3.0) == 0


@pytest.mark.parametrize(('parameters', 'sentence'), [
    ({'protocol': 'kvh_1750'}, 'protocol kvh_1750 is planned'),
    ({'protocol': 'bogus'}, "protocol 'bogus' is not known"),
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
