# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The package for pip and for colcon; name, version and the like are read from package.xml."""

from glob import glob
import sys
from xml.etree import ElementTree

from setuptools import find_packages, setup

manifest = ElementTree.parse('package.xml').getroot()
name = manifest.findtext('name')


def wheels(rclpy, common_interfaces, rcl_interfaces, condition='python_version >= "3.10"'):
    """Return ROS 2 from wheels; all are pinned, since a single newer one breaks the others."""
    packages = dict.fromkeys(['sensor', 'geometry', 'nav', 'std', 'diagnostic'], common_interfaces)
    packages |= dict.fromkeys(['rosgraph', 'lifecycle'], rcl_interfaces)
    pins = {'rclpy[fastrtps]': rclpy, 'std-srvs': common_interfaces}
    pins |= {f'{package}-msgs': version for package, version in packages.items()}
    machine = 'sys_platform == "linux" and platform_machine == "x86_64"'
    return [f'ros-{package}=={version}; {machine} and {condition}'
            for package, version in pins.items()]


JAZZY = '7.1.6', '5.3.6', '2.0.3'  # for Python 3.10 to 3.13
KILTED = '9.1.2', '5.5.1', '2.3.0'  # for Python 3.10 to 3.14
ros = wheels(*JAZZY, 'python_version < "3.14"') + wheels(*KILTED, 'python_version >= "3.14"')

plot = ['matplotlib']
fleet = ['distributed']  # a Dask cluster
# what docs.ros.org builds pages with
docs = ['sphinx', 'sphinx-rtd-theme', 'myst-parser']
# hypothesis makes up inputs and finds the shortest that fails; atheris makes them up guided by
# coverage, and has wheels for Linux on x86-64 alone
fuzz = ['hypothesis', 'atheris; sys_platform == "linux" and platform_machine == "x86_64"']
# what ament_flake8 and ament_pep257 run
lint = ['ruff', 'mypy', 'pydocstyle', 'flake8', 'flake8-blind-except', 'flake8-builtins',
        'flake8-class-newline', 'flake8-comprehensions', 'flake8-deprecated', 'flake8-docstrings',
        'flake8-import-order', 'flake8-quotes']
build = ['setuptools', 'wheel', 'colcon-ros', 'colcon-bash', 'colcon-package-information']
# other programs that `benchmarks` compares with; vqf has no wheel for Python 3.14
peers = ['vqf; python_version < "3.14"', 'imufusion']
# launch_testing, where it is installed, needs a pytest older than 8.4; rosbags writes recordings;
# mujoco reads what export writes
test = ['pytest<8.4', 'pytest-xdist', 'pandas', 'rosbags', 'mcap>=1.6', 'mujoco', *plot, *fuzz,
        *lint, *build, *peers]

# Executables belong into lib/<package>, where `ros2 run` and launch look; only the command line
# has to be on the PATH. setup.cfg says so to colcon and to bloom. pip does not read that: it puts
# all of them into bin, so that lib needs something that runs them.
if 'bdist_wheel' in sys.argv:
    launchers = (f'lib/{name}', sorted(glob(f'lib/{name}/*')))
else:
    launchers = ('bin', [f'bin/{name}'])

setup(
    name=name, version=manifest.findtext('version'), description=manifest.findtext('description'),
    url=manifest.findtext("url[@type='website']"), license=manifest.findtext('license'),
    author=manifest.findtext('author'), author_email=manifest.find('author').get('email'),
    maintainer=manifest.findtext('maintainer'),
    maintainer_email=manifest.find('maintainer').get('email'),
    packages=find_packages(include=[
        name, f'{name}.*', f'{name}_reproduction', f'{name}_bench*'
    ]), package_data={
        name: ['py.typed'], f'{name}.diagnosis': ['report.html']
    }, python_requires='>=3.10,<3.15', install_requires=[
        'numpy>=1.21', 'scipy>=1.8', 'pyserial', 'PyYAML', 'tqdm'
    ], extras_require={
        'compressed': ['lz4', 'zstandard'], 'ros': ros, 'ros-kilted': wheels(*KILTED),
        'plot': plot, 'docs': docs, 'fleet': fleet, 'test': test, 'peers': peers
    }, zip_safe=False, entry_points={
        'console_scripts': [
            'gyro_calibration = gyro_calibration.cli.main:main',
            'driver_node = gyro_calibration.ros.start:start_driver',
            'compensation_node = gyro_calibration.ros.start:start_compensation',
        ],
    }, data_files=[('share/ament_index/resource_index/packages', [f'resource/{name}']),
                   (f'share/{name}', ['package.xml']),
                   (f'share/{name}/config', sorted(glob('config/*.*'))),
                   (f'share/{name}/config/sros2', sorted(glob('config/sros2/*'))),
                   (f'share/{name}/samples', sorted(glob('samples/*.*'))),
                   (f'share/{name}/launch', sorted(glob('launch/*.launch.py'))), launchers, ],
)
