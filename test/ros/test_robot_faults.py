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
A small robot and the compensation node as a process, on real DDS, under faults.

What is decided is tested in test_calibration_drive.py with a clock that the test steps; here, that
the node joins it to topics. Tests wait for events; a machine that delays samples by 0.25 s ends a
drive as well, which the tests accept.

"""

import math
import os
import signal
import subprocess
import sys
import time

import pytest
from robot import now, Robot, RosRobot

try:
    from diagnostic_msgs.msg import DiagnosticArray
    from sensor_msgs.msg import Imu
    from std_srvs.srv import Trigger
except ImportError:
    pass  # the fixture `ros` skips every test that needs them, and says why

FULL_RATE = math.radians(40.0)
MODEL = 'effects: {bias: {bias: 0.0}}\nnoise: {angle_random_walk: 5.0e-4}\n'
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


_CALLER = """
import rclpy
from std_srvs.srv import Trigger
rclpy.init()
node = rclpy.create_node('caller')
client = node.create_client(Trigger, '/compensation_node/calibrate')
client.wait_for_service()
try:
    rclpy.spin_until_future_complete(node, client.call_async(Trigger.Request()))
finally:
    node.destroy_node()
"""


@pytest.mark.evidence
@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGKILL])
def test_a_caller_that_is_ended_in_mid_run_leaves_a_robot_that_stops(stage, number):
    """At once where it says goodbye; killed, it is missed after up to 20 s, or the run is over."""
    robot = stage.robot()
    stage.node()
    caller = subprocess.Popen([sys.executable, '-c', _CALLER], stderr=subprocess.PIPE)
    stage.wait_until(lambda: abs(robot.robot.rate) > FULL_RATE, 60.0, 'full rate')
    begin = now()
    caller.send_signal(number)
    caller.communicate()
    stage.wait_until(lambda: robot.commands[-1][1] == 0.0 and now() - robot.commands[-1][0] > 1.0
                     and abs(robot.robot.rate) < 1e-4, 40.0, 'the end of the run')
    driven = [when for when, rate in robot.commands if rate and when > begin]
    assert number == signal.SIGKILL or max(driven, default=begin) - begin < 2.0
    answer = stage.drive()
    stage.call('cancel_calibration')
    stage.wait_until(answer.done, what='the answer')


def test_a_node_that_is_ended_in_mid_run_commands_zero_first(stage):
    robot = stage.robot()
    node = stage.node()
    stage.drive()
    assert node.stop(signal.SIGTERM) == 0
    stage.wait_until(lambda: robot.commands[-1][1] == 0.0, what='a zero')
    stage.wait_until(lambda: abs(robot.robot.rate) < 0.01, what='the robot to stand')
