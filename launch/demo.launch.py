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
A gyro that does not exist, on a pseudo-terminal, with its driver and compensation.

The emulated robot drives about, and the compensation knows the model of its gyro:
``ros2 topic echo /heading``. All ends with the drive. Nothing leaves this machine, unless
ROS_AUTOMATIC_DISCOVERY_RANGE says otherwise.

"""

import os
import tempfile

from launch import LaunchDescription
from launch.actions import (
    ExecuteProcess,
    IncludeLaunchDescription,
    RegisterEventHandler,
    SetEnvironmentVariable,
    Shutdown,
)
from launch.event_handlers import OnProcessIO
from launch.substitutions import EnvironmentVariable, PathJoinSubstitution
from launch_ros.substitutions import ExecutableInPackage, FindPackageShare

PACKAGE = 'gyro_calibration'
PROTOCOL = 'kvh_dsp3000'


def generate_launch_description():
    """Return the emulated gyro and what gyro.launch.py starts, on the emulator's port."""
    port = os.path.join(tempfile.gettempdir(), f'gyro_calibration_demo_{os.getpid()}')
    range_name = 'ROS_AUTOMATIC_DISCOVERY_RANGE'
    discovery = EnvironmentVariable(range_name, default_value='LOCALHOST')
    model = _share('config', 'xv3500.yaml')
    arguments = {'port': port, 'protocol': PROTOCOL, 'model_file': model,
                 'calibration_file': f'{port}.yaml'}
    nodes = IncludeLaunchDescription(_share('launch', 'gyro.launch.py'),
                                     launch_arguments=arguments.items())
    program = ExecutableInPackage(package=PACKAGE, executable='gyro_calibration')
    emulator = ExecuteProcess(
        cmd=[program, 'emulate', '--protocol', PROTOCOL, '--model', model, '--motion', 'robot',
             '--link', port],
        name='emulator', output='screen', on_exit=_end)
    waiting = [nodes]  # for the port, whose name the emulator prints once
    begin = OnProcessIO(target_action=emulator,
                        on_stdout=lambda _: waiting.pop() if waiting else None)
    return LaunchDescription([SetEnvironmentVariable(range_name, discovery),
                              RegisterEventHandler(begin), emulator])


def _end(event, context):
    # After Ctrl-C everything ends by itself; a second signal would hit nodes that are ending.
    return [] if context.is_shutdown else [Shutdown(reason='the emulated gyro has ended')]


def _share(*parts):
    return PathJoinSubstitution([FindPackageShare(PACKAGE), *parts])
