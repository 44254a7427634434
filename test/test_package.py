# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The package as installed by colcon and by pip, with data files and programs for `ros2 run`."""

import importlib.metadata
import os
from pathlib import Path
import shutil
import subprocess
import sys
from xml.etree import ElementTree
import zipfile

import gyro_calibration
import pytest
from test_layers import imports

ROOT = Path(__file__).parents[1]
PARTS = ['package.xml', 'setup.py', 'setup.cfg', 'LICENSE',
         'gyro_calibration', 'gyro_calibration_bench', 'gyro_calibration_reproduction', 'config',
         'launch', 'samples', 'bin', 'lib', 'resource']
EXECUTABLES = {'gyro_calibration', 'driver_node', 'compensation_node'}
COLCON = shutil.which('colcon',
                      path=os.pathsep.join([str(Path(sys.executable).parent), os.environ['PATH']]))


@pytest.fixture(scope='module')
def source(tmp_path_factory):
    """Return a copy of what makes the package: a build may leave things in it."""
    folder = tmp_path_factory.mktemp('source') / 'gyro_calibration'
    folder.mkdir()
    for part in PARTS:
        copy = shutil.copytree if (ROOT / part).is_dir() else shutil.copy
        copy(ROOT / part, folder / part)
    return folder


def run(*command, folder):
    """Run a command without the checkout on its Python path, and return what it prints."""
    paths = [path for path in os.environ.get('PYTHONPATH', '').split(os.pathsep)
             if path and Path(path) != ROOT]
    environment = os.environ | {'PYTHONPATH': os.pathsep.join(paths)}
    result = subprocess.run(command, cwd=folder, env=environment, capture_output=True,
                            text=True, timeout=120)
    assert result.returncode == 0, f'{command}:\n{result.stdout}{result.stderr}'
    return result.stdout


def expected_data():
    """Return the data files of an installed package below its prefix."""
    files = {f'share/gyro_calibration/{file.relative_to(ROOT)}'
             for file in (ROOT / 'config').rglob('*.*')}
    assert 'share/gyro_calibration/config/sros2/policy.xml' in files
    files |= {f'share/gyro_calibration/launch/{file.name}'
              for file in (ROOT / 'launch').glob('*.launch.py')}
    files |= {f'share/gyro_calibration/samples/{file.name}'
              for file in (ROOT / 'samples').glob('*.*')}
    files |= {'share/gyro_calibration/package.xml',
              'share/ament_index/resource_index/packages/gyro_calibration'}
    return files | {f'lib/gyro_calibration/{name}' for name in EXECUTABLES}


def test_the_version_of_the_manifest_is_the_version_of_the_module():
    manifest = ElementTree.parse(ROOT / 'package.xml').getroot()
    assert manifest.findtext('version') == gyro_calibration.__version__


@pytest.mark.filterwarnings('ignore::DeprecationWarning', 'ignore::PendingDeprecationWarning')
def test_bloom_finds_a_dated_section_of_the_version_in_the_changelog():
    changelog = pytest.importorskip('catkin_pkg.changelog', reason='catkin_pkg is not installed')
    dates = {version: date
             for version, date, _ in changelog.get_changelog_from_path(ROOT).foreach_version()}
    assert dates[gyro_calibration.__version__]


def test_the_manifest_names_exactly_what_is_imported():
    """By the names of rosdep; only a fleet of logs needs the two without one."""
    names = {name for folder in ('gyro_calibration', 'launch')
             for file in (ROOT / folder).rglob('*.py') for name in imports(file)}
    roots = ({name.partition('.')[0] for name in names} - sys.stdlib_module_names
             - {'gyro_calibration', 'gyro_calibration_reproduction'})
    python = {'numpy', 'scipy', 'serial', 'yaml', 'tqdm', 'matplotlib'}
    manifest = ElementTree.parse(ROOT / 'package.xml').getroot()
    assert {element.text for element in manifest.iter('exec_depend')} == {
        f'python3-{root}' if root in python else root
        for root in roots - {'distributed'}}


@pytest.mark.linter
@pytest.mark.parametrize('name, arguments', [
    pytest.param(name, arguments, marks=getattr(pytest.mark, name)) for name, arguments in {
        'flake8': ['--config', '.flake8'], 'copyright': ['.'],
        # the descriptions of parameters stand on the line of the name, where pep257 sees none
        'pep257': ['--add-ignore', 'D417', '--', '.']}.items()])
def test_what_ros_reviewers_run_finds_nothing(monkeypatch, name, arguments):
    """Where it is installed; elsewhere `make style` runs the same checks."""
    linter = pytest.importorskip(f'ament_{name}.main', reason=f'ament_{name} is not installed')
    monkeypatch.chdir(ROOT)
    assert linter.main(argv=arguments) == 0


@pytest.mark.skipif(COLCON is None, reason='colcon is not installed')
@pytest.mark.parametrize('options', [
    pytest.param((), id='copied'),
    pytest.param(('--symlink-install',), id='symlinked', marks=pytest.mark.evidence)])
def test_colcon_installs_data_and_executables(source, tmp_path, options):
    bases = ['--build-base', tmp_path / 'build', '--install-base', tmp_path / 'install']
    run(COLCON, '--log-base', tmp_path / 'log', 'build', *bases, *options, folder=source)
    check_prefix(tmp_path / 'install/gyro_calibration')
    setup = f'. {tmp_path}/install/local_setup.sh'
    assert 'self-calibrate' in run('sh', '-c', f'{setup} && gyro_calibration --help', folder='/')
    where = f'{sys.executable} -c "import gyro_calibration as it; print(it.__file__)"'
    installed = Path(run('sh', '-c', f'{setup} && {where}', folder='/').strip()).resolve()
    assert installed.is_relative_to(source if options else tmp_path)


def check_prefix(prefix):
    """Check what an installed ROS 2 needs: executables for `ros2 run`, few of them on the PATH."""
    assert not {file for file in expected_data() if not (prefix / file).is_file()}
    assert {file.name for file in (prefix / 'bin').iterdir()} == {'gyro_calibration'}
    programs = list((prefix / 'lib/gyro_calibration').iterdir())
    assert {file.name for file in programs} == EXECUTABLES
    assert all(os.access(file, os.X_OK) and 'python' in file.read_text() for file in programs)


def test_bloom_puts_nothing_on_the_path_but_the_command_line(source, tmp_path):
    """With the arguments of bloom's template for Debian packages (ament_python/rules.em)."""
    pytest.importorskip('setuptools', reason='setuptools is not installed')
    copy = shutil.copytree(source, tmp_path / 'source')
    options = ['--root', tmp_path / 'root', '--prefix', '/opt/ros/jazzy',
               '--install-lib', '$base/lib/python3/site-packages']
    run(sys.executable, 'setup.py', '--quiet', 'install', *options, folder=copy)
    check_prefix(tmp_path / 'root/opt/ros/jazzy')


def test_the_wheel_holds_what_colcon_installs(source, tmp_path):
    pytest.importorskip('setuptools', reason='setuptools is not installed')
    pytest.importorskip('wheel', reason='wheel is not installed')
    options = ['--quiet', '--no-deps', '--no-build-isolation', '--no-index',
               '--wheel-dir', tmp_path]
    run(sys.executable, '-m', 'pip', 'wheel', *options, source, folder=tmp_path)
    wheel, = tmp_path.glob('*.whl')
    with zipfile.ZipFile(wheel) as archive:
        data = {name.split('.data/data/')[1]: archive.getinfo(name)
                for name in archive.namelist() if '.data/data/' in name}
        parts = {name for name in archive.namelist() if name.startswith('gyro_calibration/')}
    assert set(data) == expected_data()
    assert all(data[f'lib/gyro_calibration/{name}'].external_attr >> 16 & 0o111
               for name in EXECUTABLES)
    assert parts == {str(file.relative_to(ROOT))
                     for file in (ROOT / 'gyro_calibration').rglob('*.*') if file.suffix != '.pyc'}
    manifest = ElementTree.parse(ROOT / 'package.xml').getroot()
    metadata, = importlib.metadata.distributions(path=[str(wheel)])
    assert metadata.version == manifest.findtext('version')
    assert metadata.metadata['Summary'] == manifest.findtext('description')
    licences = [metadata.metadata.get('License'), metadata.metadata.get('License-Expression')]
    assert manifest.findtext('license') in licences
    assert {entry.name for entry in metadata.entry_points} == EXECUTABLES
