# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Layouts, launch files and the robot_localization example name what exists, and all of it."""

import ast
from pathlib import Path
import re

import pytest
import yaml

try:
    from diagnostic_msgs.msg import DiagnosticArray
    from geometry_msgs.msg import PoseWithCovarianceStamped, TwistWithCovarianceStamped
    from gyro_calibration.ros import driver_node, pipeline
    from sensor_msgs.msg import Imu, Temperature
except ImportError:
    pytest.skip('ROS 2 messages are not installed', allow_module_level=True)

ROOT = Path(__file__).parents[2]
TOPICS = {'/imu/data_raw': Imu, '/imu/temperature': Temperature, '/imu/data': Imu,
          '/heading': PoseWithCovarianceStamped, '/yaw_rate': TwistWithCovarianceStamped,
          '/compensation_node/calibration_status': DiagnosticArray,
          '/diagnostics': DiagnosticArray}
STATUSES = {'/driver_node: gyro', '/compensation_node: heading'}


def test_layouts_show_topics_fields_and_statuses_that_exist():
    """By the message paths of Foxglove, and the series of PlotJuggler's ROS parser."""
    for name in ('foxglove.json', 'plotjuggler.xml'):
        text = (ROOT / 'config' / name).read_text().replace('\\"', '"')
        assert {*re.findall(r'/\w+: \w+', text)} <= STATUSES
        paths = re.findall(r'[">;](/[a-z][^"<>;{[]*)', text)
        assert len(paths) > 5
        for path in paths:
            topic = max((each for each in TOPICS if path.startswith(each)), key=len, default='')
            assert topic or path in STATUSES or path.startswith('/studio_script/'), path
            message = TOPICS[topic]() if topic else None
            if message is None or isinstance(message, DiagnosticArray):
                continue
            for part in re.findall(r'[./](\w+)', path[len(topic):]):
                # PlotJuggler makes angles of quaternions
                message = getattr(message, 'z' if part == 'yaw' else part)


STATE = ['x', 'y', 'z', 'roll', 'pitch', 'yaw', 'vx', 'vy', 'vz', 'vroll', 'vpitch', 'vyaw',
         'ax', 'ay', 'az']
#: Names in the documentation of its state estimation nodes (for a sensor, what follows its name).
PARAMETERS = {'frequency', 'sensor_timeout', 'two_d_mode', 'publish_tf', 'odom_frame',
              'base_link_frame', 'world_frame'} | {
    sensor + end for sensor in ('odom0', 'imu0')
    for end in ('', '_config', '_queue_size', '_differential', '_relative',
                '_remove_gravitational_acceleration')}


def test_the_example_has_parameters_that_exist_and_fuses_one_thing_of_a_gyro_and_nothing_twice():
    example = yaml.safe_load((ROOT / 'config/robot_localization.yaml').read_text())
    parameters = example['ekf_filter_node']['ros__parameters']
    assert set(parameters) <= PARAMETERS and all(
        isinstance(parameters[name], float) for name in ('frequency', 'sensor_timeout'))
    assert parameters['imu0'] == 'imu/data' and parameters['two_d_mode'] is True
    for sensor, fused in (('imu0', ['vyaw']), ('odom0', ['vx', 'vy'])):
        assert parameters[f'{sensor}_config'] == [name in fused for name in STATE]


def launch_arguments():
    """Return the tables of gyro.launch.py by name: argument -> parameter or default, text."""
    return {node.targets[0].id: ast.literal_eval(node.value)
            for node in ast.parse((ROOT / 'launch/gyro.launch.py').read_text()).body
            if isinstance(node, ast.Assign) and isinstance(node.value, ast.Dict)}


def test_the_launch_arguments_that_the_documents_name_are_those_of_the_launch_file():
    declared = {'driver_config', 'compensation_config'}.union(*launch_arguments().values())
    page = (ROOT / 'docs/reference/on_a_robot.md').read_text()
    table = page.partition('| launch argument |')[2].partition('\n\n')[0]
    rows = [line.split('|')[1] for line in table.splitlines()[2:]]
    assert {name for row in rows for name in re.findall(r'`(\w+)`', row)} == declared
    other = (ROOT / 'docs/how_to/nav2.md').read_text()
    code = other.partition('```python\n')[2].partition('```')[0]
    assert ('generate_launch_description' in compile(code, 'launch', 'exec').co_names
            and 'robot_localization.yaml' in code)
    used = set(re.findall(r"'(\w+)': '", other)) | set(re.findall(r'`(\w+):=', other))
    assert used <= declared


@pytest.mark.parametrize('name, node', [('DRIVER', driver_node), ('COMPENSATION', pipeline)])
def test_the_launch_arguments_that_are_parameters_are_parameters_of_the_nodes(name, node):
    wanted = {parameter for parameter, _ in launch_arguments()[name].values()}
    assert wanted <= {parameter.name for parameter in node.PARAMETERS}
