"""
A gyro that does not exist, on a pseudo-terminal, with its driver and compensation.

The emulated robot drives about; see it with ``ros2 topic echo /heading``. Nothing leaves this machine, unless
ROS_AUTOMATIC_DISCOVERY_RANGE says otherwise.

"""

import os
import tempfile

from launch import LaunchDescription
from launch.actions import ExecuteProcess, IncludeLaunchDescription, SetEnvironmentVariable
from launch.substitutions import EnvironmentVariable, PathJoinSubstitution
from launch_ros.substitutions import ExecutableInPackage, FindPackageShare

PROTOCOL = 'kvh_dsp3000'
PACKAGE = 'gyro_calibration'


def generate_launch_description():
    """
    Return the emulated gyro and what gyro.launch.py starts, on the emulator's port.

    """
    port = os.path.join(tempfile.gettempdir(), f'gyro_calibration_demo_{os.getpid()}')
    discovery = EnvironmentVariable('ROS_AUTOMATIC_DISCOVERY_RANGE', default_value='LOCALHOST')
    nodes = IncludeLaunchDescription(_share('launch', 'gyro.launch.py'), launch_arguments={'port': port, 'protocol': PROTOCOL}.items())
    return LaunchDescription([SetEnvironmentVariable('ROS_AUTOMATIC_DISCOVERY_RANGE', discovery), _emulator(port), nodes])


def _emulator(port):
    program = ExecutableInPackage(package=PACKAGE, executable='gyro_calibration')
    model = _share('config', 'xv3500.yaml')
    command = [program, 'emulate', '--protocol', PROTOCOL, '--model', model, '--motion', 'robot', '--link', port]
    return ExecuteProcess(cmd=command, name='emulator', output='screen')


def _share(*parts):
    return PathJoinSubstitution([FindPackageShare(PACKAGE), *parts])
