# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The robot_localization example has the parameters of that program and the published topics."""

import ast
from pathlib import Path
import re

import pytest
import yaml

CONFIG = Path(__file__).parents[2] / 'config' / 'robot_localization.yaml'
STATE = ['x', 'y', 'z', 'roll', 'pitch', 'yaw', 'vx', 'vy', 'vz', 'vroll', 'vpitch', 'vyaw',
         'ax', 'ay', 'az']
#: Names in the documentation of its state estimation nodes (for a sensor, what follows its name).
PARAMETERS = {'frequency', 'sensor_timeout', 'two_d_mode', 'publish_tf', 'odom_frame',
              'base_link_frame', 'world_frame'}
OF_A_SENSOR = {'', '_config', '_queue_size', '_differential', '_relative',
               '_remove_gravitational_acceleration'}


def fused(parameters, sensor):
    flags = parameters[f'{sensor}_config']
    assert len(flags) == len(STATE) and all(isinstance(flag, bool) for flag in flags)
    return [name for name, flag in zip(STATE, flags) if flag]


def test_it_names_parameters_that_exist_and_fuses_one_thing_of_a_gyro_and_nothing_twice():
    parameters = yaml.safe_load(CONFIG.read_text())['ekf_filter_node']['ros__parameters']
    known = PARAMETERS | {sensor + end for sensor in ('odom0', 'imu0') for end in OF_A_SENSOR}
    assert set(parameters) <= known and all(isinstance(parameters[name], float)
                                            for name in ('frequency', 'sensor_timeout'))
    assert parameters['imu0'] == 'imu/data' and parameters['two_d_mode'] is True
    assert fused(parameters, 'imu0') == ['vyaw'] and fused(parameters, 'odom0') == ['vx', 'vy']


def arguments_of(launch_file):
    """Return the names of the arguments that gyro.launch.py declares."""
    names = {}
    for node in ast.parse(launch_file.read_text()).body:
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Dict):
            names[node.targets[0].id] = {key.value for key in node.value.keys}
    return names['DRIVER'] | names['COMPENSATION'] | names['OTHERS'] | {
        'driver_config', 'compensation_config'}


def test_the_launch_arguments_that_the_documents_name_are_those_of_the_launch_file():
    declared = arguments_of(CONFIG.parents[1] / 'launch' / 'gyro.launch.py')
    page = (CONFIG.parents[1] / 'docs/reference/on_a_robot.md').read_text()
    table = page.partition('| launch argument |')[2].partition('\n\n')[0]
    rows = [line.split('|')[1] for line in table.splitlines()[2:]]
    assert {name for row in rows for name in re.findall(r'`(\w+)`', row)} == declared
    other = (CONFIG.parents[1] / 'docs/how_to/nav2.md').read_text()
    code = other.partition('```python\n')[2].partition('```')[0]
    assert ('generate_launch_description' in compile(code, 'launch', 'exec').co_names
            and CONFIG.name in code)
    used = set(re.findall(r"'(\w+)': '", other)) | set(re.findall(r'`(\w+):=', other))
    assert used <= declared


def test_the_launch_arguments_that_are_parameters_are_parameters_of_the_nodes():
    pytest.importorskip('rclpy', reason='ROS 2 (rclpy) is not installed')
    from gyro_calibration.ros import driver_node, pipeline
    tree = ast.parse((CONFIG.parents[1] / 'launch' / 'gyro.launch.py').read_text())
    for name, table in (('DRIVER', driver_node.PARAMETERS), ('COMPENSATION', pipeline.PARAMETERS)):
        node = next(each.value for each in tree.body
                    if isinstance(each, ast.Assign) and each.targets[0].id == name)
        wanted = {value.elts[0].value for value in node.values}
        assert wanted <= {parameter.name for parameter in table}
