# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The driver as a robot runs it: its own process, a pseudo-terminal for the gyro, and DDS."""

import itertools
import subprocess
import sys

import pytest

pytest.importorskip('rclpy', reason='ROS 2 (rclpy) is not installed')

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from gyro_calibration.driver.emulator import Emulator
from gyro_calibration.driver.protocols import find_protocol, Sample
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from sensor_msgs.msg import Imu, Temperature


class Robot:
    """A driver, and what it publishes."""

    def __init__(self, ros, start_node, wait_until, port, protocol, parameters):
        self._wait_until = wait_until
        self.rates = ros.collect(Imu, 'imu/data_raw')
        self.temperatures = ros.collect(Temperature, 'imu/temperature')
        self.diagnostics = ros.collect(DiagnosticArray, '/diagnostics', 10)
        self.node = start_node('driver_node', {'port': port, 'protocol': protocol, **parameters})

    def wait(self, condition, what):
        """Wait until a condition is true."""
        self._wait_until(condition, 60.0, f'{what}; output:\n{self.node.output}')

    def reports(self, words, level):
        """Wait until a diagnostic message with these words comes, and return its status."""
        def found():
            statuses = [array.status[0] for array in self.diagnostics]
            return [status for status in statuses
                    if words in status.message and status.level == level]
        self.wait(found, words)
        return found()[-1]


@pytest.fixture
def robot(ros, start_node, wait_until):
    """Return a function of port, protocol and parameters that starts a driver."""
    def start(port, protocol='csv', **parameters):
        return Robot(ros, start_node, wait_until, port, protocol, parameters)
    return start


def counting(frequency=100.0):
    """Return the samples of a gyro whose rate is its number in 1e-4 rad/s, to show holes."""
    return (Sample(1e-4 * number, 31.5, number / frequency) for number in itertools.count())


def seconds(message):
    return message.header.stamp.sec + message.header.stamp.nanosec * 1e-9


def interrupt_often(node):
    """
    End a node as under a launch file, where Ctrl-C comes twice: from the terminal and from launch.

    It ends with code 0 all the same, or the fixture fails.

    """
    for _ in range(40):
        node.interrupt()
    assert node.stop() == 0


def test_a_gyro_is_published_end_to_end(robot, ros):
    """A replay at 1 kHz waits for a driver that a busy machine holds up: no sample is lost."""
    with Emulator(find_protocol('csv'), counting(500.0), speed=2.0, wait_for_reader=True) as gyro:
        driver = robot(gyro.path, frame_id='my_gyro')
        driver.wait(lambda: len(driver.rates) > 3000 and len(driver.temperatures) > 3000,
                    'samples')
        status = driver.reports('samples come', DiagnosticStatus.OK)
        offered = [ros.node.get_publishers_info_by_topic(topic)[0].qos_profile
                   for topic in ('/imu/data_raw', '/imu/temperature')]
        interrupt_often(driver.node)
    rates, temperatures = list(driver.rates), list(driver.temperatures)
    numbers = [round(1e4 * message.angular_velocity.z) for message in rates]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    stamps = [seconds(message) for message in rates]
    assert all(later > earlier for earlier, later in itertools.pairwise(stamps))
    assert {message.header.frame_id for message in [*rates, *temperatures]} == {'my_gyro'}
    assert (len({*map(seconds, temperatures)} & {*stamps}) > 2900
            and {message.temperature for message in temperatures} == {31.5})
    assert all(message.angular_velocity_covariance.any() for message in rates)
    assert (status.name, status.hardware_id) == ('/driver_node: gyro', gyro.path)
    assert {(each.reliability, each.durability) for each in offered} == {
        (ReliabilityPolicy.RELIABLE, DurabilityPolicy.VOLATILE)}


def test_a_port_that_is_missing_comes_goes_and_comes_again(robot, tmp_path):
    driver = robot(tmp_path / 'gyro')
    driver.reports('does not exist: plug the gyro in', DiagnosticStatus.ERROR)
    for number in range(2):
        driver.rates.clear()
        with Emulator(find_protocol('csv'), counting(), link=tmp_path / 'gyro'):
            driver.wait(lambda: len(driver.rates) > 20, 'samples')
            driver.diagnostics.clear()
            values = {pair.key: pair.value
                      for pair in driver.reports('samples come', DiagnosticStatus.OK).values}
            assert int(values['reopened']) >= number and int(values['samples']) > 20
        driver.reports('the device was disconnected', DiagnosticStatus.ERROR)
    interrupt_often(driver.node)
    assert driver.node.output.count('the device was disconnected') == 2, (
        'it is logged once, not at each attempt')


def test_an_impossible_parameter_ends_it_with_one_sentence(start_node):
    node = start_node('driver_node', {'protocol': 'fizoptika'})
    assert node.wait() == 2
    line, = node.output.strip().splitlines()
    assert line.startswith('DriverNode: sensitivity is not set')


BROKEN = """
import sys
from gyro_calibration.ros import driver_node
def fill(self, mean):
    raise ZeroDivisionError('as if there were a fault in the program')
driver_node.SampleMessages.fill = fill
sys.exit(driver_node.main())
"""


def test_a_fault_of_the_program_in_the_reader_ends_the_node_and_is_reported(ros_domain):
    """A node that lives on and publishes nothing would look well to whoever started it."""
    with Emulator(find_protocol('csv'), counting()) as gyro:
        command = [sys.executable, '-c', BROKEN, '--ros-args', '-p', f'port:={gyro.path}',
                   '-p', 'protocol:=csv']
        ended = subprocess.run(command, capture_output=True, text=True, timeout=60.0)
    assert ended.returncode == 1 and 'as if there were a fault in the program' in ended.stderr
    assert 'the thread that reads the port has ended' in ended.stderr
