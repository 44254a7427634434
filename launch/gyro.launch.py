"""
The driver of a gyro and the compensation of its output, with their parameters from the files in config.

Topics: ``imu/data_raw``, ``imu/temperature``, ``imu/data``, ``yaw_rate``, ``heading``, ``heading_with_covariance``. A launch argument that
is given goes before the file, one that is left empty changes nothing.

"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

DRIVER = {
    'port': 'serial port of the gyro, for example /dev/ttyUSB0',
    'protocol': 'wire format of the gyro, for example kvh_dsp3000',
}
COMPENSATION = {
    'model_file': 'model of the gyro, see docs/error_model.md',
    'calibration_file': 'where the last self-calibration is kept',
    'profile_file': 'motion profile of the self-calibration',
    'wheels': 'what tells of the wheels: none, odom, cmd_vel or both',
}
ENCLAVES = {
    'driver_enclave': 'enclave of driver_node in a secured graph, for example /gyro_calibration/driver_node; see docs/security.md',
    'compensation_enclave': 'enclave of compensation_node, for example /gyro_calibration/compensation_node',
}


def generate_launch_description():
    """Return the arguments and the two nodes."""
    texts = DRIVER | COMPENSATION | ENCLAVES
    arguments = [DeclareLaunchArgument(name, default_value='', description=text) for name, text in texts.items()]
    arguments.append(DeclareLaunchArgument('namespace', default_value='', description='namespace of both nodes and their topics'))
    return LaunchDescription([*arguments, _file('driver'), _file('compensation'), OpaqueFunction(function=_nodes)])


def _file(node):
    default = PathJoinSubstitution([FindPackageShare('gyro_calibration'), 'config', f'{node}.yaml'])
    return DeclareLaunchArgument(f'{node}_config', default_value=default, description=f'parameters of {node}_node')


def _nodes(context):
    given = context.launch_configurations
    return [_node('driver', DRIVER, given), _node('compensation', COMPENSATION, given)]


def _node(name, arguments, given):
    overrides = {argument: ParameterValue(given[argument], value_type=str) for argument in arguments if given[argument]}
    parameters = [given[f'{name}_config'], *([overrides] if overrides else [])]
    executable = f'{name}_node'
    enclave = given[f'{name}_enclave']
    return Node(package='gyro_calibration', executable=executable, name=executable, namespace=given['namespace'], parameters=parameters,
                ros_arguments=['--enclave', enclave] if enclave else [])
