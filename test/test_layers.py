# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Layers: imports go one way, ROS 2 stays in the nodes, the core has no I/O and reads no clock."""

import ast
from functools import cache
import importlib
from pathlib import Path
import re

import gyro_calibration
import pytest

PACKAGE = Path(gyro_calibration.__file__).parent
REPRODUCTION = PACKAGE.parent / 'gyro_calibration_reproduction'
FILES = sorted(PACKAGE.rglob('*.py'))
#: As the package's docstring gives it.
ORDER = re.findall(r'`(\w+)`', gyro_calibration.__doc__.partition('Reading order:')[2])
CORE = ORDER[:ORDER.index('driver')]
FOLDERS = ['logs', 'model', 'heading', 'calibration',
           'allan', 'diagnosis', 'fleet', 'driver', 'ros']
MAY_USE_ROS = {'demo.py', *(path.name for path in (PACKAGE / 'ros').glob('*.py'))}
ROS = re.compile(r'rclpy|ament_\w+|launch\w*|tf2\w*|rosbag2\w*|rcl_interfaces|\w+_msgs|\w+_srvs')
OUTSIDE_WORLD = {'socket', 'serial', 'subprocess', 'time', 'threading', 'random', 'argparse'}


@cache
def imports(path):
    """Return the modules that a file imports, anywhere in it, and names of them."""
    nodes = list(ast.walk(ast.parse(path.read_text())))
    found = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    origins = [node for node in nodes if isinstance(node, ast.ImportFrom)]
    return found | {node.module for node in origins} | {
        f'{node.module}.{alias.name}' for node in origins for alias in node.names}


@cache
def calls(path):
    """Return what a file calls, with its dots: ``yaml.load``."""
    return {ast.unparse(node.func) for node in ast.walk(ast.parse(path.read_text()))
            if isinstance(node, ast.Call)}


def own(names):
    parts = [name.split('.') for name in names if name.startswith('gyro_calibration.')]
    return {part[1] for part in parts
            if (PACKAGE / part[1]).is_dir() or (PACKAGE / f'{part[1]}.py').exists()}


def files(module):
    """Return the files of a module: one, or those of its folder."""
    path = PACKAGE / f'{module}.py'
    return [path] if path.exists() else sorted((PACKAGE / module).rglob('*.py'))


def test_a_module_imports_only_what_is_read_before_it():
    for place, module in enumerate(['files', *ORDER]):
        known = {'files', *ORDER[:place]}
        unknown = {path.name: own(imports(path)) - known for path in files(module)}
        assert unknown and not any(unknown.values()), (module, unknown)


def test_modules_classes_and_functions_have_names_of_their_own():
    """But for the functions of `api` and of the verbs, and `main`."""
    names = [path.stem for path in FILES if path.stem != '__init__']
    names += [node.name for path in FILES for node in ast.parse(path.read_text()).body
              if isinstance(node, ast.ClassDef) and not node.name.startswith('_')]
    assert len(names) > 200 and not [name for name in names if names.count(name) > 1]
    names = [node.name for path in FILES if path.parent.name != 'cli' and path.stem != 'api'
             for node in ast.parse(path.read_text()).body if isinstance(node, ast.FunctionDef)
             and not node.name.startswith('_') and node.name != 'main']
    assert len(names) > 200 and not [name for name in names if names.count(name) > 1]


@pytest.mark.parametrize('folder', FOLDERS)
def test_a_file_of_a_folder_imports_only_what_is_read_before_it(folder):
    dotted = f'gyro_calibration.{folder.replace("/", ".")}'
    order = re.findall(
        r'`(\w+)`', importlib.import_module(dotted).__doc__.partition('Reading order')[2])
    inside = f'{dotted}.'
    assert sorted(order) == sorted(path.stem for path in (PACKAGE / folder).iterdir()
                                   if path.suffix == '.py' and path.stem != '__init__'
                                   or path.is_dir() and path.stem != '__pycache__')
    for place, name in enumerate(order):
        paths = [path for path in (PACKAGE / folder).rglob('*.py')
                 if path.relative_to(PACKAGE / folder).parts[0] in (name, f'{name}.py')]
        used = {each.removeprefix(inside).split('.')[0] for path in paths
                for each in imports(path) if each.startswith(inside)}
        assert used & set(order) <= {name, *order[:place]}, (name, used)


def test_only_the_nodes_know_ros():
    users = {path.name for path in FILES for name in imports(path)
             if ROS.fullmatch(name.split('.')[0])}
    assert users and users <= MAY_USE_ROS


def test_the_core_only_computes_from_what_it_is_given():
    """It reads no clock, and draws no random number by itself."""
    hidden = re.compile(r'\b(now|utcnow|today)\(\)|np\.random\.(?!Generator)|default_rng')
    core = [path for module in [*CORE, 'files'] for path in files(module)]
    for path in [*core, *REPRODUCTION.glob('*.py')]:
        assert not hidden.search(path.read_text()), path
        assert not {name.split('.')[0] for name in imports(path)} & OUTSIDE_WORLD, path
        assert not calls(path) & {'print', 'input', 'exec', 'eval'}, path
