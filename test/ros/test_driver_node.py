# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The driver: its parameters, messages and diagnostics, and as a process with DDS."""

import itertools
import re
import signal
import subprocess
import sys

from fake_port import World
import pytest

pytest.importorskip('rclpy', reason='ROS 2 (rclpy) is not installed')

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from gyro_calibration.driver.connection import Connection, sample_messages, SampleMean
from gyro_calibration.driver.emulator import Emulator
from gyro_calibration.driver.protocols import find_protocol, Sample, Settings
from gyro_calibration.logs import cdr
from gyro_calibration.ros.compensation_node import CompensationNode
from gyro_calibration.ros.driver_node import (
    DriverNode, DriverReport, PARAMETERS, settings_from_parameters)
from gyro_calibration.ros.inputs import parameter_values
from gyro_calibration.ros.runner import ERROR, OK, WARN
from rclpy.clock import ClockType
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import Imu, Temperature

KEYS = {'samples', 'rate_hz', 'lost_samples', 'refused_samples', 'refused_temperatures',
        'device_faults', 'discarded_bytes', 'longest_gap_s', 'clock_steps', 'last_event', 'port',
        'device', 'state', 'protocol', 'baud', 'reopened', 'waiting_s', 'waited_s',
        'last_error', 'period_ms', 'nominal_period_ms'}


@pytest.mark.parametrize(('given', 'sentence'), [
    ({'protocol': 'bogus'},
     "protocol 'bogus' is not known: choose one of csv, .*, or auto to find it by listening"),
    ({'invert': 'maybe'}, "parameter invert is 'maybe', but must be default, always or never"),
    ({'increments': True}, 'parameter increments is True, but must be default, always or never'),
    ({'baud': -1}, 'parameter baud is -1, but must be from 0 to 4000000 bit/s'),
    ({'sample_rate': 'often'}, "parameter sample_rate is 'often', but must be a number"),
    ({'sample_rate': 1 << 70}, 'parameter sample_rate is 118.*, but must be a number'),
    ({'axis': 'w'}, "parameter axis is 'w', but must be x, y or z"),
    ({'port': '/dev/\0'}, 'parameter port is .*, but must be without a zero byte'),
    ({'frame_id': ''}, "parameter frame_id is '', but must be not empty, for example 'gyro'")])
def test_an_impossible_parameter_is_refused_in_one_sentence(given, sentence):
    with pytest.raises(ValueError, match=sentence) as refused:
        values = parameter_values(PARAMETERS, given)
        Connection(values.port, values.protocol, values.baud, settings_from_parameters(values))
    assert len(str(refused.value).splitlines()) == 1


def received(sample, kind=Imu, variance=1e-4):
    """Return a message of a sample as a subscriber receives it."""
    kinds = {Imu: cdr.IMU, Temperature: cdr.TEMPERATURE}
    messages = dict(sample_messages(sample, 1_700_000_000_250_000_000, 'my_gyro', variance))
    return deserialize_message(messages[kinds[kind]], kind)


def test_a_message_holds_the_rate_about_z_and_marks_what_is_not_measured():
    """REP-145: element 0 is -1 for a quantity that is not reported; x and y get no weight."""
    imu = received(Sample(0.5))
    assert (imu.angular_velocity.x, imu.angular_velocity.y, imu.angular_velocity.z) == (
        0.0, 0.0, 0.5)
    assert list(imu.linear_acceleration_covariance) == [-1.0, *8 * [0.0]]
    assert imu.orientation_covariance[0] == -1.0 and imu.linear_acceleration.z == 0.0
    assert list(imu.angular_velocity_covariance) == [1e6, 0, 0, 0, 1e6, 0, 0, 0, 1e-4]
    assert (imu.header.frame_id, imu.header.stamp.sec, imu.header.stamp.nanosec) == (
        'my_gyro', 1_700_000_000, 250_000_000)
    # the variance of a temperature is not known
    sample = Sample(0.5, -12.25, specific_force=9.81)
    imu, temperature = received(sample), received(sample, Temperature)
    assert temperature.header == imu.header
    assert (temperature.temperature, temperature.variance) == (-12.25, 0.0)
    assert imu.linear_acceleration.z == 9.81
    assert list(imu.linear_acceleration_covariance) == pytest.approx(
        [1e6, 0, 0, 0, 1e6, 0, 0, 0, 0.01])


def test_the_mean_of_ten_samples_has_a_tenth_of_the_variance_of_one(hold_node):
    held = hold_node(DriverNode, {'port': '/nonexistent/gyro'})
    held.node._variance = 1e-4
    held.node._publish([SampleMean(1_700_000_000.25, Sample(0.5), 10)])
    imu = held.sent['/imu/data_raw'][-1]
    assert imu.angular_velocity_covariance[8] == pytest.approx(1e-5)
    assert imu.header.stamp.nanosec == 250_000_000


def reported(world, protocol, given=None,
             monitored=lambda report, chunk: report.add(chunk.samples)):
    """Return the reports of a driver, one a second."""
    given, reports = given or Settings(), []
    connection = Connection('/dev/gyro', protocol, 0, given,
                            lambda state: state.problem and report.clear(), world, world.port)
    report = DriverReport(connection, '/dev/gyro*', given, world)
    for second in range(1, 60):
        world.at(second, lambda: reports.append(report.make()))
    for chunk in connection.chunks(world):
        monitored(report, chunk)
    return reports


def test_a_good_gyro_is_reported_with_all_its_figures_in_one_vocabulary():
    world = World(10.0)
    world.gyro('csv')
    level, message, values = reported(world, 'csv')[-1]
    assert (level, message) == (OK, 'samples come') and set(values) == {*KEYS, 'temperature_degc'}
    assert all(re.fullmatch('[a-z0-9_]+', key) for key in values)
    assert values | {'rate_hz': '100.0', 'port': '/dev/gyro*', 'device': '/dev/gyro',
                     'state': 'reading', 'protocol': 'csv', 'baud': 115200, 'lost_samples': 0,
                     'temperature_degc': '31.50', 'nominal_period_ms': '10',
                     'reopened': 0} == values
    assert float(values['period_ms']) == pytest.approx(10.0, rel=1e-3)


def test_a_lost_port_is_an_error_and_what_the_gyro_reported_is_dropped():
    world = World(20.0)
    world.gyro('csv')
    world.at(5.5, world.unplug)
    world.at(15.0, world.plug)
    reports = reported(world, 'csv')
    assert reports[3][0] == OK and 'temperature_degc' in reports[3][2]
    level, message, values = reports[10]
    assert (level == ERROR and 'does not exist' in message == values['last_error']
            and 'temperature_degc' not in values)
    assert (values['state'], values['waiting_s']) == ('failed', '3.2')
    level, message, values = reports[-1]
    assert (level == OK and values['reopened'] == 1 and float(values['longest_gap_s']) > 9.5
            and 'does not exist' in values['last_error'])


def test_losses_of_the_last_second_are_a_warning_with_their_counts():
    world = World(10.0)
    lines = {50: b'       0.015733   0\r\n', 60: b'     999.000000   1\r\n',
             70: b'       0.015733   x\r\n'}
    world.send(lines.get(number % 300, b'       0.015733   1\r\n') for number in itertools.count())
    reports = reported(world, 'kvh_dsp3000')
    bad = [message for level, message, _ in reports if level == WARN]
    assert set(bad) == {
        'samples come, but in the last second there were: lost samples 3, refused samples 1, '
        'device faults 1, discarded bytes 19'}
    assert ([level for level, _, _ in reports].count(OK) > 4
            and reports[-1][2]['refused_samples'] == 4)


def test_supply_and_source_current_are_reported_and_checked():
    world, given = World(10.0), Settings(sensitivity=1e-6)
    encode = find_protocol('fizoptika').encoder(given)
    health = {'supply_v': 5.0, 'source_current_a': 0.05, 'diagnostic_v': 1.0}
    world.send((encode(Sample(0.1, 24.0, sequence=number, health=health))
                for number in itertools.count()), rate=1000.0)
    level, message, values = reported(world, 'fizoptika', given)[-1]
    assert (level == WARN and 'source_current_a is 0.05, but should be from 0.07 to 0.15: '
            'check the supply' in message)
    assert [float(values[name]) for name in health] == pytest.approx(
        list(health.values()), rel=1e-3)
    assert float(values['temperature_degc']) == pytest.approx(24.0, abs=0.1)


@pytest.mark.parametrize(('given', 'is_warned'), [
    (Settings(), True), (Settings(sample_rate=250.0), False), (Settings(increments=False), False)])
def test_angles_by_another_rate_than_the_gyro_sends_are_warned_of(given, is_warned):
    """The unit is set to 250 Hz, and the driver is not: its rates are 4 times too high."""
    world = World(6.0)
    world.gyro('kvh_1750', rate=250.0)
    level, message, _ = reported(world, 'kvh_1750', given)[-1]
    assert (level == WARN) == is_warned
    assert ('250 samples per second, but angles are converted to rates by 1000: set sample_rate'
            in message) == is_warned


def test_steps_of_the_clock_are_counted():
    world = World(5.0)
    world.gyro('csv')
    steps = iter([(3600.0, 1), (-7200.0, 2)])
    reports = reported(
        world, 'csv', monitored=lambda report, _: [report.add_clock_step(*step) for step in steps])
    _, _, values = reports[-1]
    assert values['clock_steps'] == '2, last by -7200.0 s'
    assert values['last_event'].startswith('the clock of this computer was set by -7200.0 s')


@pytest.mark.parametrize('node_class, name, parameters, words', [
    (DriverNode, 'driver_node: gyro', {'port': '/nonexistent/gyro'}, 'does not exist'),
    (CompensationNode, 'compensation_node: heading', {'use_sim_time': 'true'},
     'ROS time stands still')], ids=['driver', 'compensation'])
def test_a_node_reports_in_its_namespace_also_without_gyro_samples_and_clock(
        hold_node, wait_until, tmp_path, node_class, name, parameters, words):
    if node_class is CompensationNode:
        parameters = {**parameters, 'calibration_file': tmp_path / 'calibration.yaml'}
    held = hold_node(node_class, parameters, {'__ns': '/robot'})

    def reported():
        held.tick()
        return [status for array in held.sent['/diagnostics'] for status in array.status
                if status.level == status.ERROR and words in status.message]
    wait_until(reported, what=words)
    assert {(status.name, status.hardware_id) for status in reported()} == {
        (f'/robot/{name}', parameters.get('port', 'none'))}
    values = {pair.key: pair.value for pair in reported()[-1].values}
    assert float(values['rate_hz']) == 0.0
    stamp = held.sent['/diagnostics'][-1].header.stamp
    assert (stamp.sec > 0) == (node_class is DriverNode), 'the time of a simulation stands at 0'
    assert all(timer.clock.clock_type == ClockType.STEADY_TIME for timer in held.node.timers)


# As a robot runs it: its own process, a pseudo-terminal for the gyro, and DDS

def counting(frequency=100.0):
    """Return the samples of a gyro whose rate is its number in 1e-4 rad/s, to show holes."""
    return (Sample(1e-4 * number, 31.5, number / frequency) for number in itertools.count())


def seconds(message):
    return message.header.stamp.sec + message.header.stamp.nanosec * 1e-9


def test_a_gyro_is_published_end_to_end(ros, start_node, wait_until):
    """A replay at 1 kHz waits for a driver that a busy machine holds up: no sample is lost."""
    rates = ros.collect(Imu, 'imu/data_raw')
    temperatures = ros.collect(Temperature, 'imu/temperature')
    reports = ros.collect(DiagnosticArray, '/diagnostics', 10)
    with Emulator(find_protocol('csv'), counting(500.0), speed=2.0, wait_for_reader=True) as gyro:
        node = start_node('driver_node', {'port': gyro.path, 'protocol': 'csv',
                                          'frame_id': 'my_gyro'})
        wait_until(lambda: len(rates) > 3000 and len(temperatures) > 3000, 60.0, 'samples')
        wait_until(lambda: any((array.status[0].level, array.status[0].message) == (
            DiagnosticStatus.OK, 'samples come') for array in reports), 60.0, 'samples come')
        offered = [ros.node.get_publishers_info_by_topic(topic)[0].qos_profile
                   for topic in ('/imu/data_raw', '/imu/temperature')]
        # under a launch file Ctrl-C comes twice: from the terminal and from launch
        for _ in range(40):
            node.interrupt()
        assert node.stop() == 0
    rates, temperatures, status = list(rates), list(temperatures), reports[-1].status[0]
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


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGQUIT, signal.SIGTERM,
                                    signal.SIGHUP])
@pytest.mark.parametrize('program', ['start_driver', 'start_compensation'])
def test_a_signal_during_the_imports_ends_a_node_with_code_0(program, number):
    script = (f'import os; from gyro_calibration.ros import start; '
              f'start.import_module = lambda name: os.kill(os.getpid(), {int(number)}); '
              f'start.{program}()')
    ended = subprocess.run([sys.executable, '-c', script], capture_output=True, timeout=60.0)
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, b'', b'')


def test_an_impossible_parameter_ends_it_with_one_sentence(start_node):
    node = start_node('driver_node', {'protocol': 'fizoptika'})
    assert node.wait() == 2
    line, = node.output.strip().splitlines()
    assert line.startswith('DriverNode: sensitivity is not set')


def test_a_mistyped_parameter_is_named_and_the_end_of_its_terminal_ends_a_node_as_ctrl_c_does(
        start_node, wait_until, tmp_path):
    node = start_node('compensation_node', {
        'calibration_file': tmp_path / 'own.yaml', 'wheel': 'odom',
        'calibration.profile_file': tmp_path / 'gone.csv'})
    for words in ('there is no parameter wheel, and its value is not used: is wheels meant?',
                  'gone.csv'):
        wait_until(lambda: words in node.output, what=words)  # noqa: B023
    assert node.stop(signal.SIGHUP) == 0, 'it has stopped the robot'


BROKEN = """
import sys
from gyro_calibration.ros import driver_node
def fail(*_):
    raise ZeroDivisionError('as if there were a fault in the program')
driver_node.sample_messages = fail
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
