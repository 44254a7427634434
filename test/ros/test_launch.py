# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The launch files: the nodes start, the heading follows the gyro, and all end cleanly."""

from importlib.util import find_spec
from pathlib import Path
import random
import unittest

from conftest import Ros, wait_until
import pytest

# No import of ROS 2 and no skip at module level: launch_testing imports each test module while it
# collects, and a skip there would skip every file of this folder.
LAUNCH = Path(__file__).parents[2] / 'launch'
DOMAIN = random.SystemRandom().randint(1, 101)
MISSING = [name for name in ('rclpy', 'launch_ros', 'launch_testing') if find_spec(name) is None]
needs_launch = unittest.skipIf(MISSING, f'{" and ".join(MISSING)} not installed')


@pytest.mark.launch_test
def generate_test_description():
    """Start the demo, and the nodes alone in a namespace with a port that does not exist."""
    from launch import LaunchDescription
    from launch.actions import SetEnvironmentVariable
    import launch_testing.actions
    skip_where_not_installed()
    domain = SetEnvironmentVariable('ROS_DOMAIN_ID', str(DOMAIN))
    nodes = include('gyro.launch.py', {
        'port': '/nonexistent/gyro', 'namespace': 'robot', 'frame_id': 'gyro_link',
        'respawn': 'true', 'odom_topic': '/base/odom', 'cmd_vel_topic': '/base/cmd_vel'})
    return LaunchDescription([domain, include('demo.launch.py', {}), nodes,
                              launch_testing.actions.ReadyToTest()])


def include(name, arguments):
    """Include a launch file whose arguments stay its own."""
    from launch.actions import GroupAction, IncludeLaunchDescription
    return GroupAction(
        [IncludeLaunchDescription(str(LAUNCH / name), launch_arguments=arguments.items())])


def skip_where_not_installed():
    from ament_index_python import get_package_prefix, PackageNotFoundError
    try:
        get_package_prefix('gyro_calibration')
    except PackageNotFoundError:
        pytest.skip('gyro_calibration is not installed where AMENT_PREFIX_PATH points')


@needs_launch
class TestGraph(unittest.TestCase):

    def setUp(self):
        self.ros = Ros(DOMAIN)

    def tearDown(self):
        self.ros.close()

    def test_a_launch_argument_goes_before_the_file(self):
        from rcl_interfaces.srv import GetParameters
        answer = self.ros.call(GetParameters, '/robot/driver_node/get_parameters',
                               names=['port', 'frame_id', 'use_sim_time'])
        wait_until(answer.done, what='an answer')
        port, frame, simulated = answer.result().values
        assert (port.string_value, frame.string_value) == ('/nonexistent/gyro', 'gyro_link')
        assert simulated.bool_value is False

    def test_the_topics_of_a_shared_base_are_received(self):
        for topic in ('/base/odom', '/base/cmd_vel'):
            wait_until(lambda: self.ros.node.count_subscribers(topic), what=topic)  # noqa: B023

    def test_the_heading_follows_the_raw_output(self):
        from sensor_msgs.msg import Imu
        headings = self.headings('/robot/heading')
        publisher = self.ros.publisher(Imu, '/robot/imu/data_raw')
        wait_until(lambda: publisher.publish(self.sample(Imu())) or headings, what='a heading')

    def test_the_demo_has_a_heading(self):
        headings = self.headings('/heading')
        wait_until(lambda: headings, what='a heading')

    def headings(self, topic):
        from geometry_msgs.msg import PoseWithCovarianceStamped
        return self.ros.collect(PoseWithCovarianceStamped, topic)

    def sample(self, message):
        """Fill in 0.1 rad/s now, and no acceleration or orientation in the form of REP-145."""
        message.header.stamp = self.ros.node.get_clock().now().to_msg()
        message.angular_velocity.z = 0.1
        message.orientation_covariance[0] = message.linear_acceleration_covariance[0] = -1.0
        return message


@needs_launch
class TestEnd(unittest.TestCase):
    __post_shutdown_test__ = True  # as the decorator launch_testing.post_shutdown_test() sets

    def test_all_end_with_code_0(self, proc_info):
        import launch_testing.asserts
        launch_testing.asserts.assertExitCodes(proc_info)

    def test_the_demo_reports_no_error(self, proc_output):
        lines = [line for output in proc_output for line in output.text.decode().splitlines()]
        assert not [line for line in lines if '[ERROR]' in line and '[driver_node]' in line]
        assert any('samples of kvh_dsp3000 come' in line for line in lines)
