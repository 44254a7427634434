"""The package for pip and for colcon; name, version and the like are read from package.xml."""

from glob import glob
from xml.etree import ElementTree

from setuptools import find_packages, setup

manifest = ElementTree.parse('package.xml').getroot()
name = manifest.findtext('name')

# The wheels of ROS 2 Jazzy, for machines without an installed ROS 2. Every one is pinned: a single newer one breaks the others.
jazzy = {
    'ros-rclpy[fastrtps]': '7.1.6',
    'ros-sensor-msgs': '5.3.6',
    'ros-geometry-msgs': '5.3.6',
    'ros-nav-msgs': '5.3.6',
    'ros-std-msgs': '5.3.6',
    'ros-std-srvs': '5.3.6',
    'ros-diagnostic-msgs': '5.3.6',
    'ros-rosgraph-msgs': '2.0.3',
    'ros-lifecycle-msgs': '2.0.3',
}
ros = [f'{wheel}=={version}; sys_platform == "linux" and platform_machine == "x86_64"' for wheel, version in jazzy.items()]
plot = ['matplotlib']
# launch_testing, where it is installed, needs a pytest older than 8.4; rosbags writes recordings for the tests; hypothesis makes up inputs
# and finds the shortest that fails; atheris makes them up guided by coverage, and has wheels for Linux on x86-64 alone
fuzz = ['hypothesis', 'atheris; sys_platform == "linux" and platform_machine == "x86_64"']
test = plot + fuzz + ['pytest<8.4', 'rosbags', 'ruff', 'mypy', 'setuptools', 'wheel', 'colcon-ros', 'colcon-bash',
                      'colcon-package-information']

setup(
    name=name,
    version=manifest.findtext('version'),
    description=manifest.findtext('description'),
    license=manifest.findtext('license'),
    maintainer=manifest.findtext('maintainer'),
    maintainer_email=manifest.find('maintainer').get('email'),
    packages=find_packages(include=[name, f'{name}.*']),
    package_data={f'{name}.diagnosis': ['report.html']},
    python_requires='>=3.10,<3.14',
    # mcap writes recordings, and brings lz4 and zstandard, which compressed ones are read by
    install_requires=['numpy', 'scipy', 'pyserial', 'PyYAML', 'tqdm', 'mcap>=1.6'],
    extras_require={'ros': ros, 'plot': plot, 'test': test},
    zip_safe=False,
    entry_points={
        'console_scripts': [
            'gyro_calibration = gyro_calibration.cli.main:main',
            'driver_node = gyro_calibration.ros.driver_node:main',
            'compensation_node = gyro_calibration.ros.compensation_node:main',
        ],
    },
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{name}']),
        (f'share/{name}', ['package.xml']),
        (f'share/{name}/config', sorted(glob('config/*.*'))),
        (f'share/{name}/config/sros2', sorted(glob('config/sros2/*'))),
        (f'share/{name}/launch', sorted(glob('launch/*.launch.py'))),
        # `ros2 run` and launch look for executables here; see the comment in them
        (f'lib/{name}', sorted(glob(f'lib/{name}/*'))),
    ],
)
