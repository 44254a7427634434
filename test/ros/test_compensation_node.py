# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""
The compensation node: its messages, parameters and services, and drives of a small robot.

What it computes and decides is tested in test_pipeline.py and test_calibration_session.py. Here
are its messages and services, by a node that nobody spins, and drives of a process on real DDS.
"""

from contextlib import ExitStack
from dataclasses import replace
import itertools
import json
import math
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

from gyro_calibration.driver.emulator import Emulator
from gyro_calibration.driver.protocols import find_protocol, Sample, Settings
from gyro_calibration.logs.cdr import quaternion_heading, UNMEASURED_VARIANCE
from gyro_calibration.model.gyro_model import SelfCalibration
from gyro_calibration.model.model_file import read_model
import numpy as np
import pytest

try:
    from diagnostic_msgs.msg import DiagnosticArray
    from gyro_calibration.ros.compensation_node import CompensationNode
    from gyro_calibration.ros.runner import SENSOR_QOS
    from nav_msgs.msg import Odometry
    from rclpy.qos import ReliabilityPolicy
    from robot_faults import Fault, FAULTS, Stage
    from sensor_msgs.msg import Imu, Temperature
    from std_srvs.srv import Trigger
except ImportError:
    pass  # the fixture `ros` skips every test that needs them, and says why

MODEL = 'effects: {bias: {bias: 0.01}}\nnoise: {angle_random_walk: 7.0e-4}\n'
#: What a drive ends by where the machine is busy.
HELD_UP = 'no sample came', 'this computer was busy'


@pytest.fixture
def hold(hold_node, tmp_path):
    (tmp_path / 'model.yaml').write_text(MODEL)

    def hold(**parameters):
        given = {'calibration_file': tmp_path / 'calibration.yaml', **parameters}
        return hold_node(CompensationNode,
                         {name.replace('__', '.'): value for name, value in given.items()})
    return hold


def sample(number, rate):
    message = Imu()
    message.header.frame_id, message.angular_velocity.z = 'gyro', rate
    message.header.stamp.sec = 1_700_000_000 + number // 100
    message.header.stamp.nanosec = number % 100 * 10 ** 7
    return message


def test_what_is_published(hold, tmp_path):
    """Only z and the orientation of the incoming message change; no variance is zero."""
    held = hold(model_file=tmp_path / 'model.yaml', stationary__method='none')
    held.tick()  # now it knows who subscribes
    for number in range(100):  # that never change are those of a dead gyro
        held.send('/imu/data_raw', sample(
            number, 0.5 + 0.001 * ((number == 51) - (number == 50))))
    message = sample(100, 0.5)  # with the other axes, of a driver that measures them
    message.angular_velocity.x, message.angular_velocity.y = 0.1, -0.2
    message.angular_velocity_covariance = [1e-4, 1e-6, 0.0, 1e-6, 2e-4, 0.0, 0.0, 0.0, 9.0]
    acceleration = message.linear_acceleration
    acceleration.x, acceleration.y, acceleration.z = 0.3, 0.4, 9.8
    message.linear_acceleration_covariance = [0.5, 0.0, 0.0, 0.0, 0.6, 0.0, 0.0, 0.0, 0.7]
    held.send('/imu/data_raw', message)
    imus, headings, rates = (held.sent[topic] for topic in ('/imu/data', '/heading', '/yaw_rate'))
    assert len(imus) == len(headings) == len(rates) == 101
    imu, heading, rate = imus[-1], headings[-1], rates[-1]
    assert (imu.angular_velocity.x, imu.angular_velocity.y) == (0.1, -0.2)
    assert imu.angular_velocity.z == pytest.approx(0.49)
    assert imu.angular_velocity_covariance[:8].tolist() == [1e-4, 1e-6, 0, 1e-6, 2e-4, 0, 0, 0]
    assert 0.0 < imu.angular_velocity_covariance[8] < 1e-2
    acceleration = imu.linear_acceleration
    assert (acceleration.x, acceleration.y, acceleration.z) == (0.3, 0.4, 9.8)
    assert imu.linear_acceleration_covariance.tolist() == [0.5, 0, 0, 0, 0.6, 0, 0, 0, 0.7]
    assert imu.header.frame_id == 'gyro'
    covariance = imu.orientation_covariance
    assert covariance[0] == covariance[4] == UNMEASURED_VARIANCE and 0.0 < covariance[8] < 1.0
    assert 2.0 * math.atan2(imu.orientation.z, imu.orientation.w) == pytest.approx(0.49, abs=1e-6)
    assert heading.header.frame_id == 'odom' and heading.header.stamp == imu.header.stamp
    assert heading.pose.pose.orientation == imu.orientation
    assert heading.pose.covariance[35] == covariance[8]
    assert heading.pose.covariance[[0, 7, 14, 21, 28]].tolist() == 5 * [UNMEASURED_VARIANCE]
    assert rate.header == imu.header and rate.twist.twist.angular.z == imu.angular_velocity.z
    assert rate.twist.covariance[35] == imu.angular_velocity_covariance[8]
    assert rate.twist.covariance[[0, 7, 14, 21, 28]].tolist() == 5 * [UNMEASURED_VARIANCE]
    assert not imus[0].angular_velocity_covariance[[1, 2, 3, 5, 6, 7]].any()
    assert imus[0].angular_velocity_covariance[0] > 0.0, 'all zeros came: not known'


@pytest.mark.parametrize('topic', ['/imu/data', '/imu/temperature', '/odom'])
def test_another_node_on_a_topic_is_a_warning_and_no_calibration_mixes_odometries(hold, topic):
    held = hold(calibration__reference='odometry')
    kind = {'/imu/data': Imu, '/imu/temperature': Temperature, '/odom': Odometry}[topic]
    for _ in range(1 + (topic != '/imu/data')):  # where the node itself publishes
        held.node.create_publisher(kind, topic, 10)
    held.tick(5)
    held.send('/imu/data_raw', sample(0, 0.0))
    held.tick(5)
    status, = held.sent['/diagnostics'][-1].status
    words = f'several nodes publish on {topic} (/compensation_node, '
    assert status.level == status.WARN and words in status.message
    answer = held.call('/compensation_node/calibrate', Trigger)
    assert (words in getattr(answer, 'message', '')) == (topic == '/odom')


def test_an_orientation_that_is_none_has_no_heading_and_raises_nothing():
    assert quaternion_heading(0.0, 0.0, math.sin(0.3), math.cos(0.3)) == pytest.approx(0.6)
    for value in (0.0, 1e200, -1.7e308, math.inf, math.nan):
        assert math.isnan(quaternion_heading(value, value, value, value))


def test_an_empty_ros_home_is_none_as_for_ros_itself(hold_node, monkeypatch, tmp_path):
    monkeypatch.setenv('ROS_HOME', '')
    monkeypatch.setenv('HOME', str(tmp_path))
    store = hold_node(CompensationNode).node._pipeline.store
    store.store_calibration(SelfCalibration(0.01, 0.02))
    assert (tmp_path / '.ros' / 'gyro_calibration' / 'compensation_node.yaml').is_file()


def test_names_types_and_qualities_are_those_of_the_documents(hold):
    from test_config import TOPICS
    held = hold()
    made = {each.topic_name: each for each in (*held.node.subscriptions, *held.node.publishers)}
    assert {topic: made[topic].msg_type for topic in TOPICS} == TOPICS
    for topic in ('/imu/data', '/heading', '/yaw_rate'):
        assert made[topic].qos_profile.reliability == ReliabilityPolicy.RELIABLE
    held.tick(5)  # it reports each second
    report, = held.sent['/diagnostics'][-1].status
    assert (report.name, report.hardware_id) == ('/compensation_node: heading', 'none')
    status, = held.sent['/compensation_node/calibration_status'][-1].status
    assert status.name == '/compensation_node: calibration' and 'call calibrate' in status.message
    assert {'calibrated', 'running'} <= {pair.key for pair in status.values}


def test_parameters_are_checked_described_and_taken_on_at_once(hold):
    held = hold()
    names = held.node.get_parameters_by_prefix('')
    own = [name for name in names if not name.startswith('qos_overrides')
           and name not in ('use_sim_time', 'start_type_description_service')]
    described = held.node.describe_parameters(own)
    assert all(each.description.endswith('.') for each in described)
    assert any('Unit: rad/s.' in each.description and each.floating_point_range
               for each in described)
    refused = held.put('calibration.reference', 'off and on')
    assert not refused.successful and 'profile, odometry or turns' in refused.reason
    assert not held.put('calibration.maximum_bias', -1.0).successful
    assert not held.put('model_file', '/tmp/other').successful, 'read-only'
    assert held.put('calibration.maximum_bias', 0.5).successful
    assert held.node._pipeline.values.calibration_maximum_bias == 0.5
    assert held.put('calibration.maximum_bias', 1).successful, 'a whole number for a float'
    assert held.node._pipeline.values.calibration_maximum_bias == 1.0
    assert held.node.get_parameter('heading_frame').value == 'odom'


def test_services_answer_when_they_are_done_and_the_result_outlives_the_node(hold, tmp_path):
    numbers = itertools.count()

    def call(name):
        return held.call(f'/compensation_node/{name}', Trigger)

    def play(rate, count):
        for noise in 1e-3 * np.random.default_rng(0).standard_normal(count):
            held.send('/imu/data_raw', sample(next(numbers), rate + noise))
        held.tick()
    held = hold(stationary__threshold=0)
    play(0.0, 300)
    assert not call('cancel_calibration').success and not call('finish_calibration').success
    first = call('calibrate_bias')
    assert not first.done() and 'in progress' in call('calibrate_bias').message
    play(0.02, 500)
    assert not first.done() and call('cancel_calibration').success
    assert first.result().message == 'refused: cancelled'
    again = call('calibrate_bias')
    play(0.02, 1700)
    assert again.done() and again.result().success, again.result().message
    assert read_model(tmp_path / 'calibration.yaml').self_calibration.bias == pytest.approx(
        0.02, abs=4e-4)
    held = hold(stationary__threshold=0)
    status, = held.sent['/compensation_node/calibration_status'][-1].status
    assert 'bias 1.14' in status.message
    play(0.32, 20)
    assert held.sent['/imu/data'][-1].angular_velocity.z == pytest.approx(0.3, abs=5e-3)


# Drives under faults, by the benchmark of them: node and robot on real DDS

def killed_softly(stage):
    stage.process.terminate()
    assert stage.process.wait(30.0) == 0


def pause(stage):
    stage.process.send_signal(signal.SIGTSTP)


@pytest.mark.parametrize('name, words', [
    ('clock_absent', 'ROS time stands still'), ('clock_paused', 'ROS time stands still'),
    ('ended', 'this node was ended'), ('paused', 'this node was stopped by Ctrl-Z')])
def test_a_fault_ends_a_drive_with_a_zero_and_an_answer(ros_domain, tmp_path, name, words):
    """Where a busy machine ended the drive before the fault did, it is tried again."""
    faults = {**FAULTS, 'ended': Fault('', killed_softly), 'paused': Fault('', pause)}
    fault = replace(faults[name], seconds=3.0)
    for _ in range(5):
        with ExitStack() as closing:
            stage = Stage(tmp_path, closing)
            row = fault.row(stage)
        if not any(each in row.answer for each in HELD_UP):
            break
    printed = (tmp_path / 'node.txt').read_text()
    assert words in (printed if name == 'ended' else row.answer)
    assert 'Traceback' not in printed and not row.still
    driven = any(rate for _, rate in stage.robot.commands)
    assert row.zero < 2.0 if driven else name == 'clock_absent'
    assert name in ('ended', 'paused') or (row.level == 'ERROR' and words in row.message)


# The graph under faults: any order of starting, killed and stalled nodes

RATE = 100.0  # Hz
STEP = 2e-5  # rad/s from a sample to the next
NEARLY = 0.3  # rad, in 1 s: as late as a busy machine may be at first; tested gaps are longer
FIRST = 0.3  # rad/s
DRIVER = {'protocol': 'csv', 'columns': '[gyro_rad_s]', 'sample_rate': RATE}
EXACT = 'effects: {bias: {bias: 0.0}}\nnoise: {angle_random_walk: 1.0e-5}\n'


def turning(link):
    """Return an emulated gyro whose rate is the number of the sample."""
    samples = (Sample(FIRST + STEP * number, 25.0, number / RATE) for number in itertools.count())
    return Emulator(find_protocol('csv'), samples, Settings(columns=('gyro_rad_s',)), link=link,
                    wait_for_reader=True)


class Heard:

    def __init__(self, ros, wait_until):
        self.numbers, self.headings, self.variances, self._wait_until = [], [], [], wait_until
        self.reports = ros.collect(DiagnosticArray, '/diagnostics', 10)
        ros.node.create_subscription(Imu, '/imu/data', self._take, SENSOR_QOS)

    def _take(self, message):
        self.numbers.append(round((message.angular_velocity.z - FIRST) / STEP))
        self.headings.append(2.0 * math.atan2(message.orientation.z, message.orientation.w))
        self.variances.append(message.orientation_covariance[8])

    def more(self, count, timeout=60.0):
        before = len(self.numbers)
        self._wait_until(lambda: len(self.numbers) >= before + count, timeout,
                         f'{count} more rates')

    def error(self, first, last):
        """Return what the heading is off by from one place of the lists to another, rad."""
        begin, end = self.numbers[first], self.numbers[last]
        truth = ((end - begin) * FIRST + 0.5 * STEP * (end ** 2 - begin ** 2)) / RATE
        return abs(math.remainder(self.headings[last] - self.headings[first] - truth,
                                  2.0 * math.pi))

    @property
    def missing(self):
        """Return the number of lost samples; none may come twice."""
        steps = np.diff(self.numbers)
        assert (steps > 0).all(), 'a sample came twice, or late'
        return int((steps - 1).sum())

    def says(self, words):
        def said():
            return any(words in text for report in self.reports for status in report.status
                       for text in (status.message,
                                    *(f'{pair.key}: {pair.value}' for pair in status.values)))
        self._wait_until(said, what=words)


@pytest.fixture
def compensation(start_node, ros, wait_until, tmp_path):
    """Return a function that starts a compensation node, and hears it."""
    (tmp_path / 'model.yaml').write_text(EXACT)

    def start():
        node = start_node('compensation_node', {'model_file': tmp_path / 'model.yaml',
                                                'calibration_file': tmp_path / 'first.yaml'})
        return node, Heard(ros, wait_until)
    return start


def test_a_compensation_node_goes_on_through_any_order_of_starting_and_a_driver_that_is_killed(
        compensation, start_node, by_udp, tmp_path):
    node, heard = compensation()
    heard.says('is the driver running?')
    driver = start_node('driver_node', DRIVER | {'port': tmp_path / 'gyro'})
    with turning(tmp_path / 'gyro'):
        heard.more(200)
        assert heard.missing == 0 and heard.error(0, -1) < NEARLY
        driver.waited = True
        os.killpg(driver.process.pid, signal.SIGKILL)
        driver.process.wait()
        # a new one may come within half a second, which is no gap; samples may be on their way
        time.sleep(1.5)
        place = len(heard.numbers) - 1
        start_node('driver_node', DRIVER | {'port': tmp_path / 'gyro'})
        heard.more(150)
        assert heard.numbers[place + 5] - heard.numbers[place] > RATE, 'more than a second'
        assert heard.variances[-1] > 1.5 * heard.variances[place], 'the gap is in the variance'
        if max(np.diff(heard.numbers[place + 5:])) < RATE:  # else this machine made one more
            assert heard.error(place + 5, -1) < NEARLY, 'from there on the heading goes on'
        assert heard.error(0, -1) < 4.0 * math.sqrt(heard.variances[-1])
        heard.says('integration was restarted')
        assert node.stop() == 0
        _, again = compensation()
        again.more(100)
        assert again.missing == 0 and again.error(0, -1) < NEARLY


_HANGING = """
import threading, time
from rclpy.node import Node
from gyro_calibration.ros import runner as node

class Hanging(Node):
    def __init__(self):
        super().__init__('hanging')
    def destroy_node(self):
        time.sleep(30.0)

node.SHUTDOWN_TIMEOUT = 0.5
import rclpy
rclpy.init()
stop = threading.Event()
stop.set()
node.spin(Hanging(), stop)
"""


def test_a_node_that_cannot_end_is_killed(ros_domain):
    began = time.monotonic()
    ended = subprocess.run([sys.executable, '-c', _HANGING], stderr=subprocess.PIPE, text=True,
                           timeout=25.0)
    assert (ended.returncode == 1 and 'destroy_node' in ended.stderr
            and time.monotonic() - began < 20.0)


# The soak of `benchmarks/soak.py`, short: every emulated sample arrives corrected, once

SOAK = Path(__file__).parents[2] / 'benchmarks' / 'soak.py'


@pytest.mark.parametrize('minutes', [0.1, pytest.param(60, marks=pytest.mark.evidence)])
def test_no_sample_is_lost_between_the_line_and_the_corrected_rates(ros_domain, minutes):
    """At 1 kHz; what memory does shows in the hour, in 6 s it only must not run away."""
    load, cores = os.getloadavg()[0], os.cpu_count()
    if load > 4.0 * cores:
        pytest.skip(f'the load average is {load:.0f} on {cores} cores: run it alone')
    result = subprocess.run(
        [sys.executable, SOAK, '--json', '--minutes', str(minutes), '--patient'],
        capture_output=True, text=True, timeout=4000, check=False)
    assert result.returncode == 0, result.stderr
    found = json.loads(result.stdout.splitlines()[0])
    assert found['sent'] == 60000 * minutes
    assert found['missing'] == 0 and found['repeated'] == 0
    assert found['read_by_driver'] == found['sent_with_leading'] and found['lost_by_driver'] == 0
    assert abs(found['heading_error_deg']) < 0.1
    assert max(found['memory_growth_percent'].values()) < 10.0
    assert set(found['latency_ms']) == {'50', '99', '99.9', '100'}
