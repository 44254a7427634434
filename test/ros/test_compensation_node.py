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
are its messages, by a node that nobody spins, and what needs a process of its own on real DDS.
Tests wait for events; they accept that a machine that delays samples by 0.25 s ends a drive.

"""

import math
import os
import signal
import time

from gyro_calibration.logs.cdr import UNMEASURED_VARIANCE
from gyro_calibration.logs.log import DEGREE
from gyro_calibration.model.model_file import read_model
import numpy as np
import pytest
from rig import now, Robot, RosRobot

try:
    from diagnostic_msgs.msg import DiagnosticArray
    from gyro_calibration.ros.compensation_node import CompensationNode
    from gyro_calibration.ros.runner import LATCHED_QOS
    from rclpy.qos import ReliabilityPolicy
    from sensor_msgs.msg import Imu
    from std_srvs.srv import Trigger
except ImportError:
    pass  # the fixture `ros` skips every test that needs them, and says why

MODEL = 'effects: {bias: {bias: 0.01}}\nnoise: {angle_random_walk: 7.0e-4}\n'


PACE = 0.0015  # s between messages: stamps run 7 times faster than the clock


class FakeGyro:
    """Publishes raw rates with stamps of its own clock, and collects what the node makes of it."""

    def __init__(self, ros, wait_until):
        self.ros, self.wait_until, self.number = ros, wait_until, 0
        self._publisher = ros.publisher(Imu, 'imu/data_raw', 1000)
        self.imu = ros.collect(Imu, 'imu/data')
        self.status = ros.collect(DiagnosticArray, '/compensation_node/calibration_status',
                                  LATCHED_QOS)
        self.meet()

    def meet(self):
        """
        Rest until a node that was just started receives samples; begin at heading zero.

        A node that is started anew needs no second gyro: two publishers would be an error.

        """
        self.imu.clear(), self.status.clear()
        self.wait_until(lambda: self.send(0.0) or self.imu and self.status, 60.0, 'the node')
        last = sample(self.number - 1, 0.0).header.stamp
        self.wait_until(lambda: self.imu[-1].header.stamp == last, what='the last')
        assert self.call('reset_heading').success
        self.imu.clear()

    def send(self, rate):
        self._publisher.publish(sample(self.number, float(rate)))
        self.number += 1

    def play(self, rates, until=lambda: False):
        """Publish many samples, and return when the node has taken the last one."""
        received = len(self.imu)
        for sent, rate in enumerate(rates, 1):
            self.send(rate)
            time.sleep(PACE)
            if sent % 100 == 0:  # a machine that is busy elsewhere must not overrun the queues
                self.wait_until(lambda: len(self.imu) >= received + sent - 300,  # noqa: B023
                                what='the node to keep up')
            if until():
                break
        self.wait_until(lambda: len(self.imu) >= received + sent, what=f'{sent} samples')

    def call_later(self, name):
        return self.ros.call(Trigger, f'/compensation_node/{name}')

    def call(self, name):
        response = self.call_later(name)
        self.wait_until(response.done, what=f'the response of {name}')
        return response.result()

    def calibrating(self):
        return bool(self.status) and self.status[-1].status[0].message.startswith('calibrating')


@pytest.fixture
def start(start_node, ros, wait_until, tmp_path):
    (tmp_path / 'model.yaml').write_text(MODEL)

    def start():
        parameters = {'calibration_file': tmp_path / 'calibration.yaml', 'stationary.threshold': 0}
        return start_node('compensation_node', parameters), FakeGyro(ros, wait_until)
    return start


def rest(mean, count):
    return mean + 1e-3 * np.random.default_rng(0).standard_normal(count)


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
    for number in range(100):
        held.send('/imu/data_raw', sample(number, 0.5))
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


def test_an_orientation_that_is_none_has_no_yaw_and_raises_nothing(ros):
    from geometry_msgs.msg import Quaternion
    from gyro_calibration.ros.compensation_node import quaternion_heading
    turned = Quaternion(z=math.sin(0.3), w=math.cos(0.3))
    assert quaternion_heading(turned) == pytest.approx(0.6)
    for value in (1e200, -1.7e308, math.inf, math.nan):
        quaternion_heading(Quaternion(x=value, y=value, z=value, w=value))


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
    held = hold(stationary__threshold=0)
    names = held.node.get_parameters_by_prefix('')
    own = [name for name in names if not name.startswith('qos_overrides')
           and name not in ('use_sim_time', 'start_type_description_service')]
    assert len(own) == 18, own
    described = held.node.describe_parameters(own)
    assert all(each.description.endswith('.') for each in described)
    ranged = [each for each in described if each.floating_point_range or each.integer_range]
    assert len(ranged) == 9 and sum('Unit: rad/s.' in each.description for each in ranged) == 3
    refused = held.put('stationary.method', 'off and on')
    assert not refused.successful and 'rest, threshold or none' in refused.reason
    assert not held.put('stationary.threshold', -1.0).successful
    assert not held.put('model_file', '/tmp/other').successful, 'read-only'
    assert held.put('stationary.threshold', 0.005).successful
    for number in range(100):
        held.send('/imu/data_raw', sample(number, 0.1 * DEGREE))
    assert held.sent['/imu/data'][-1].angular_velocity.z == 0.0
    assert held.put('stationary.threshold', 0).successful, 'a whole number for a float'
    for number in range(100, 110):
        held.send('/imu/data_raw', sample(number, 0.1 * DEGREE))
    assert held.sent['/imu/data'][-1].angular_velocity.z > 0.0
    assert held.node.get_parameter('heading_frame').value == 'odom'


def test_services_answer_when_they_are_done_and_the_result_outlives_the_node(
        start, start_node, wait_until, tmp_path):
    node, gyro = start()
    assert not gyro.call('cancel_calibration').success
    first = gyro.call_later('calibrate_bias')
    wait_until(gyro.calibrating, what='the calibration to begin')
    second = gyro.call('calibrate_bias')
    assert not second.success and 'in progress' in second.message
    gyro.play(rest(0.02, 500))
    assert not first.done()
    assert gyro.call('cancel_calibration').success
    wait_until(first.done)
    assert first.result().message == 'refused: cancelled'
    again = gyro.call_later('calibrate_bias')
    wait_until(gyro.calibrating)
    gyro.play(rest(0.02, 1700), until=again.done)
    wait_until(again.done, what='the answer')
    assert again.result().success, again.result().message
    assert not gyro.call('finish_calibration').success
    assert read_model(tmp_path / 'calibration.yaml').self_calibration.bias == pytest.approx(
        0.02, abs=4e-4)
    assert node.stop() == 0
    start_node('compensation_node', parameters={'calibration_file': tmp_path / 'calibration.yaml',
                                                'stationary.threshold': 0})
    gyro.meet()
    assert 'bias 1.14' in gyro.status[-1].status[0].message
    gyro.play(np.full(20, 0.32))
    assert gyro.imu[-1].angular_velocity.z == pytest.approx(0.3, abs=1e-3)


# Drives under faults


FULL_RATE = math.radians(40.0)
PROFILE = 'time_s,rate_dps\n0,0\n1,0\n1.5,45\n4.5,45\n5,0\n6,0\n6.5,-45\n9.5,-45\n10,0\n11,0\n'
HELD_UP = 'no sample came', 'this computer was busy'


class Stage:

    def __init__(self, ros, wait_until, start_node, folder):

        self.ros, self.wait_until, self._start_node, self._folder = (
            ros, wait_until, start_node, folder)
        self.samples, self.reports = ros.collect(Imu, 'imu/data'), []
        ros.node.create_subscription(DiagnosticArray, '/diagnostics',
                                     lambda array: self.reports.append(array.status[0]), 10)
        self.closing = []

    def robot(self, **how):
        self.base = RosRobot(self.ros.node, Robot(noise=5e-3), **how)
        self.closing.append(self.base.close)
        return self.base

    def node(self, **parameters):
        """Start the node, and return when it has received samples of a robot at rest."""
        (self._folder / 'model.yaml').write_text(MODEL)
        (self._folder / 'profile.csv').write_text(PROFILE)
        given = {'model_file': self._folder / 'model.yaml',
                 'calibration_file': self._folder / 'calibration.yaml',
                 'calibration.profile_file': self._folder / 'profile.csv',
                 'calibration.drive': 'true', **parameters}
        before = len(self.samples)
        self.process = self._start_node('compensation_node', given)
        self.wait_until(lambda: len(self.samples) > before + 150, 60.0, 'imu/data')
        return self.process

    def call(self, name='calibrate'):
        return self.ros.call(Trigger, f'/compensation_node/{name}')

    def is_held_up(self, message):
        """Tell whether a refusal is the fault of a busy machine, on which /clock comes late."""
        return any(f'refused: {words}' in message for words in HELD_UP) or (
            'refused: ROS time stands still' in message and os.getloadavg()[0] > os.cpu_count())

    def drive(self):
        """Calibrate until the robot turns at full rate, and return the answer to come."""
        for _ in range(5):
            answer = self.call()
            self.wait_until(
                lambda: abs(self.base.robot.rate) > FULL_RATE or answer.done(),  # noqa: B023
                60.0, 'full rate')
            if not answer.done():
                return answer
            assert self.is_held_up(answer.result().message)
            self.wait_until(lambda: abs(self.base.robot.rate) < 1e-4, what='the robot to stand')
            time.sleep(1.0)  # a command is remembered for so long
        raise AssertionError('the machine held up five drives')

    def refused(self, answer, words, begin):
        self.wait_until(answer.done, 30.0, 'the answer')
        message = answer.result().message
        assert not answer.result().success
        assert any(each in message for each in (words, *HELD_UP)), message
        self.wait_until(lambda: self.base.commands[-1][1] == 0.0, 10.0, 'a zero')
        driven = [when for when, rate in self.base.commands if rate and when > begin]
        return max(driven, default=begin) - begin

    def says(self, words):
        self.wait_until(lambda: any(words in each.message and each.level == each.ERROR
                                    for each in list(self.reports)), 30.0, words)


@pytest.fixture
def stage(ros, wait_until, start_node, tmp_path):
    stage = Stage(ros, wait_until, start_node, tmp_path)
    yield stage
    for close in stage.closing:
        close()


def test_without_a_clock_of_the_simulation_nothing_drives_and_where_it_stops_the_robot_does(stage):
    robot = stage.robot(speed=1.0)
    robot.clock_absent = True
    stage.node(use_sim_time='true')
    answer = stage.call()
    stage.wait_until(answer.done, what='the answer')
    assert 'ROS time stands still' in answer.result().message
    stage.says('ROS time stands still')
    assert not any(rate for _, rate in robot.commands)
    robot.clock_absent = False
    stage.wait_until(lambda: 'ROS time stands still' not in stage.reports[-1].message)
    answer = stage.drive()
    begin, robot.clock_stands = now(), True
    assert stage.refused(answer, 'ROS time stands still', begin) < 2.0


def test_a_node_that_is_ended_in_mid_run_commands_zero_first_and_answers(stage):
    robot = stage.robot()
    node = stage.node()
    stage.drive()
    assert node.stop(signal.SIGTERM) == 0
    assert 'refused: this node was ended' in node.output
    stage.wait_until(lambda: robot.commands[-1][1] == 0.0, what='a zero')
    stage.wait_until(lambda: abs(robot.robot.rate) < 0.01, what='the robot to stand')
