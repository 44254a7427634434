"""
A gyro that does not exist, on a pseudo-terminal, with its driver and compensation.

The emulated robot drives about, and the compensation knows the model of its gyro: ``ros2 topic echo /heading``. All ends with the
drive. Nothing leaves this machine, unless ROS_AUTOMATIC_DISCOVERY_RANGE says otherwise.

"""

import os
import tempfile

from launch import LaunchDescription
from launch.actions import ExecuteProcess, IncludeLaunchDescription, SetEnvironmentVariable, Shutdown
from launch.substitutions import EnvironmentVariable, PathJoinSubstitution
from launch_ros.substitutions import ExecutableInPackage, FindPackageShare

PACKAGE = 'gyro_calibration'
PROTOCOL = 'kvh_dsp3000'


def generate_launch_description():
    """Return the emulated gyro and what gyro.launch.py starts, on the emulator's port."""
    port = os.path.join(tempfile.gettempdir(), f'gyro_calibration_demo_{os.getpid()}')
    discovery = EnvironmentVariable('ROS_AUTOMATIC_DISCOVERY_RANGE', default_value='LOCALHOST')
    arguments = {'port': port, 'protocol': PROTOCOL, 'model_file': _model(), 'calibration_file': f'{port}.yaml'}
    nodes = IncludeLaunchDescription(_share('launch', 'gyro.launch.py'), launch_arguments=arguments.items())
    return LaunchDescription([SetEnvironmentVariable('ROS_AUTOMATIC_DISCOVERY_RANGE', discovery), _emulator(port), nodes])


def _emulator(port):
    program = ExecutableInPackage(package=PACKAGE, executable='gyro_calibration')
    command = [program, 'emulate', '--protocol', PROTOCOL, '--model', _model(), '--motion', 'robot', '--link', port]
    return ExecuteProcess(cmd=command, name='emulator', output='screen', on_exit=_end)


def _end(event, context):
    # After Ctrl-C everything ends by itself, and a second signal would hit nodes that are about to.
    return [] if context.is_shutdown else [Shutdown(reason='the emulated gyro has ended')]


def _model():
    return _share('config', 'xv3500.yaml')


def _share(*parts):
    return PathJoinSubstitution([FindPackageShare(PACKAGE), *parts])
