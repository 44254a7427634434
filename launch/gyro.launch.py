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
The driver of a gyro and the compensation of its output, with their parameters from config.

Topics: ``imu/data_raw``, ``imu/temperature``, ``imu/data``, ``heading``, ``yaw_rate``; ``odom``
and ``cmd_vel`` under the names of the robot's base. A launch argument that is given goes before
the parameter file, one that is left empty changes nothing.

"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

# Of each node: the launch arguments that are parameters, by the name of the parameter, and texts.
DRIVER = {
    'port': ('port', 'serial port of the gyro, for example /dev/ttyUSB0'),
    'protocol': ('protocol', 'wire format of the gyro, for example kvh_dsp3000'),
    'frame_id': ('frame_id', 'frame of the gyro, whose z is its input axis'),
}
COMPENSATION = {
    'model_file': ('model_file', 'model of the gyro, see docs/reference/error_model.md'),
    'calibration_file': ('calibration_file', 'where the last self-calibration is kept'),
    'profile_file': ('calibration.profile_file', 'motion profile of the self-calibration'),
    'wheels': ('wheels', 'what feeds the detection of standstill: none, odom, cmd_vel or both'),
}
OTHERS = {
    'namespace': ('', 'namespace of both nodes and their topics'),
    'odom_topic': ('odom', "odometry of the robot's base"),
    'cmd_vel_topic': ('cmd_vel', "commands to the robot's base"),
    'use_sim_time': ('false', 'whether both nodes follow /clock'),
    'respawn': ('false', 'whether a node that ends is started again after 2 s'),
    'driver_enclave': (
        '', 'enclave of driver_node in a secured graph, see docs/reference/security.md'),
    'compensation_enclave': ('', 'enclave of compensation_node'),
}


def generate_launch_description():
    """Return the arguments and the two nodes."""
    parameters = {name: ('', text) for name, (_, text) in (DRIVER | COMPENSATION).items()}
    arguments = [DeclareLaunchArgument(name, default_value=value, description=text)
                 for name, (value, text) in (parameters | OTHERS).items()]
    files = [_file('driver'), _file('compensation')]
    return LaunchDescription([*arguments, *files, OpaqueFunction(function=_nodes)])


def _file(node):
    share = FindPackageShare('gyro_calibration')
    default = PathJoinSubstitution([share, 'config', f'{node}.yaml'])
    text = f'parameters of {node}_node'
    return DeclareLaunchArgument(f'{node}_config', default_value=default, description=text)


def _nodes(context):
    given = context.launch_configurations
    base = [('odom', given['odom_topic']), ('cmd_vel', given['cmd_vel_topic'])]
    return [_node('driver', DRIVER, given, context, []),
            _node('compensation', COMPENSATION, given, context, base)]


def _node(name, arguments, given, context, remappings):
    overrides = {parameter: ParameterValue(given[argument], value_type=str)
                 for argument, (parameter, _) in arguments.items() if given[argument]}
    overrides['use_sim_time'] = _is_true('use_sim_time', context)
    enclave = given[f'{name}_enclave']
    return Node(package='gyro_calibration', executable=f'{name}_node', name=f'{name}_node',
                namespace=given['namespace'], parameters=[given[f'{name}_config'], overrides],
                remappings=remappings, respawn=_is_true('respawn', context), respawn_delay=2.0,
                ros_arguments=['--enclave', enclave] if enclave else [])


def _is_true(argument, context):
    return IfCondition(LaunchConfiguration(argument)).evaluate(context)
