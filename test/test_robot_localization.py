"""The example for robot_localization is what that program reads, and fuses what the node publishes."""

from pathlib import Path

import pytest
import yaml

CONFIG = Path(__file__).parents[1] / 'config' / 'robot_localization.yaml'
STATE = ['x', 'y', 'z', 'roll', 'pitch', 'yaw', 'vx', 'vy', 'vz', 'vroll', 'vpitch', 'vyaw', 'ax', 'ay', 'az']
#: Names in the documentation of its state estimation nodes (of those for a sensor, what stands behind its name).
PARAMETERS = {'frequency', 'sensor_timeout', 'two_d_mode', 'publish_tf', 'odom_frame', 'base_link_frame', 'world_frame'}
OF_A_SENSOR = {'', '_config', '_queue_size', '_differential', '_relative', '_remove_gravitational_acceleration'}


@pytest.fixture(name='parameters')
def _parameters():
    return yaml.safe_load(CONFIG.read_text())['ekf_filter_node']['ros__parameters']


def fused(parameters, sensor):
    """Return the names of what is fused of a sensor."""
    flags = parameters[f'{sensor}_config']
    assert len(flags) == len(STATE) and all(isinstance(flag, bool) for flag in flags)
    return [name for name, flag in zip(STATE, flags) if flag]


def test_it_names_parameters_that_exist(parameters):
    known = PARAMETERS | {sensor + end for sensor in ('odom0', 'imu0') for end in OF_A_SENSOR}
    assert set(parameters) <= known and all(isinstance(parameters[name], float) for name in ('frequency', 'sensor_timeout'))


def test_of_one_gyro_only_one_thing_is_fused_and_nothing_twice(parameters):
    assert parameters['imu0'] == 'imu/data' and parameters['two_d_mode'] is True
    assert fused(parameters, 'imu0') == ['vyaw'] and fused(parameters, 'odom0') == ['vx', 'vy']


def test_the_launch_file_in_the_documentation_can_be_read():
    page = (CONFIG.parents[1] / 'docs' / 'on_a_robot.md').read_text()
    code = page.partition('```python\n')[2].partition('```')[0]
    assert 'generate_launch_description' in compile(code, 'launch', 'exec').co_names and CONFIG.name in code
