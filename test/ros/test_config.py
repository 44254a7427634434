# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Layouts, launch files and the robot_localization example name what exists, and all of it."""

import ast
import json
from pathlib import Path
import re
from xml.etree import ElementTree

import pytest
import yaml

try:
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
    from geometry_msgs.msg import PoseWithCovarianceStamped, TwistWithCovarianceStamped
    from gyro_calibration.ros import driver_node, pipeline
    from sensor_msgs.msg import Imu, Temperature
except ImportError:
    pytest.skip('ROS 2 messages are not installed', allow_module_level=True)

ROOT = Path(__file__).parents[2]
FOXGLOVE = json.loads((ROOT / 'config/foxglove.json').read_text())
PLOTJUGGLER = ElementTree.parse(ROOT / 'config/plotjuggler.xml').getroot()
SCRIPT = FOXGLOVE['userNodes']['heading_band']['sourceCode']
TOPICS = {'/imu/data_raw': Imu, '/imu/temperature': Temperature, '/imu/data': Imu,
          '/heading': PoseWithCovarianceStamped, '/yaw_rate': TwistWithCovarianceStamped,
          '/compensation_node/calibration_status': DiagnosticArray,
          '/diagnostics': DiagnosticArray}
STATUSES = {'/driver_node: gyro', '/compensation_node: heading'}
FUNCTIONS = {'degrees', 'sqrt'}  # of the message paths of Foxglove


def field(message, names):
    """Return the field of a message at a path; an array stands for its element."""
    for name in names:
        assert hasattr(message, name), f'{type(message).__name__} has no {name}'
        message = getattr(message, name)
    return message


def check_path(path):
    topic = re.match(r'[\w/]+', path)[0]
    assert topic in TOPICS, path
    message = TOPICS[topic]()
    for name in re.findall(r'\{name=="([^"]+)"\}', path):
        assert name in STATUSES
    for part in re.sub(r'\{[^}]*\}', '', path[len(topic):]).split('.')[1:]:
        if part.startswith('@'):
            assert part[1:] in FUNCTIONS and isinstance(message, float), path
            continue
        name, index = re.fullmatch(r'(\w+)(?:\[([\d:]+)\])?', part).groups()
        message = field(message, [name])
        if isinstance(message, list) and index:  # of statuses
            message = DiagnosticStatus()
        elif index:
            message = float(message[int(index)])


def paths():
    found = []
    for config in FOXGLOVE['configById'].values():
        found += [series['value'] for series in config.get('paths', [])]
        found += [config[key] for key in ('topicPath', 'topicToRender') if key in config]
    return found


def test_the_script_of_foxglove_reads_what_exists_and_gives_what_is_plotted():
    inputs = re.search(r'inputs = \[(.*)\]', SCRIPT)[1].replace('"', '').split(', ')
    output = re.search(r'output = "(.*)"', SCRIPT)[1]
    assert inputs == ['/heading'] and TOPICS['/heading'] is PoseWithCovarianceStamped
    message = PoseWithCovarianceStamped()
    field(message, ['pose', 'pose', 'orientation', 'z'])
    assert len(message.pose.covariance) == 36 and 'pose.covariance[35]' in SCRIPT
    given = set(re.findall(r'(\w+): number',
                           SCRIPT.partition('type Output = ')[2].partition(';\n')[0]))
    plotted = {path.removeprefix(f'{output}.')
               for path in paths() if path.startswith('/studio_script/')}
    assert plotted == given


def test_every_panel_of_foxglove_is_shown_once_with_paths_and_statuses_that_exist():
    def panels(node):
        return [node] if isinstance(node, str) else panels(node['first']) + panels(node['second'])
    assert sorted(panels(FOXGLOVE['layout'])) == sorted(FOXGLOVE['configById'])
    for path in paths():
        if not path.startswith('/studio_script/'):
            check_path(path)
    chosen = [config['selectedName']
              for config in FOXGLOVE['configById'].values() if 'selectedName' in config]
    assert chosen and set(chosen) <= STATUSES


def series_exists(name):
    """Check a series by the names of PlotJuggler's ROS parser (from its source, 2026)."""
    topic = max((topic for topic in TOPICS if name.startswith(f'{topic}/')), key=len)
    rest = name.removeprefix(f'{topic}/')
    if TOPICS[topic] is DiagnosticArray:
        hardware, status, _key = re.fullmatch(r'(\w+)/(/\w+: \w+)/(\w+)', rest).groups()
        assert hardware == 'none' and status in STATUSES
        return
    names = rest.split('/')
    message = TOPICS[topic]()
    if names[-1] == 'yaw':  # it makes angles of quaternions, and rows and columns of covariances
        names[-1] = 'z'
    if re.fullmatch(r'\[\d;\d\]', names[-1]):
        assert len(field(message, names[:-1])) == 9 and names[-1] == '[2;2]'
        return
    assert isinstance(field(message, names), float)


def test_each_series_of_plotjuggler_exists_on_a_topic_that_it_subscribes_to():
    snippets = {snippet.get('name'): snippet for snippet in PLOTJUGGLER.iter('snippet')}
    curves = {curve.get('name') for curve in PLOTJUGGLER.iter('curve')}
    assert set(snippets) <= curves
    shown = [*(curves - set(snippets)),
             *(element.text for snippet in snippets.values() for element in snippet.iter()
               if element.tag == 'linked_source' or re.fullmatch(r'v\d', element.tag))]
    topics = PLOTJUGGLER.find('.//selected_topics').get('value').split(';')
    assert set(topics) <= set(TOPICS)
    for name in shown:
        series_exists(name)
        assert any(name.startswith(f'{topic}/') for topic in topics), name


# robot_localization

STATE = ['x', 'y', 'z', 'roll', 'pitch', 'yaw', 'vx', 'vy', 'vz', 'vroll', 'vpitch', 'vyaw',
         'ax', 'ay', 'az']
#: Names in the documentation of its state estimation nodes (for a sensor, what follows its name).
PARAMETERS = {'frequency', 'sensor_timeout', 'two_d_mode', 'publish_tf', 'odom_frame',
              'base_link_frame', 'world_frame'} | {
    sensor + end for sensor in ('odom0', 'imu0')
    for end in ('', '_config', '_queue_size', '_differential', '_relative',
                '_remove_gravitational_acceleration')}


def test_the_example_has_parameters_that_exist_and_fuses_one_thing_of_a_gyro_and_nothing_twice():
    example = yaml.safe_load((ROOT / 'config/robot_localization.yaml').read_text())
    parameters = example['ekf_filter_node']['ros__parameters']
    assert set(parameters) <= PARAMETERS and all(
        isinstance(parameters[name], float) for name in ('frequency', 'sensor_timeout'))
    assert parameters['imu0'] == 'imu/data' and parameters['two_d_mode'] is True
    for sensor, fused in (('imu0', ['vyaw']), ('odom0', ['vx', 'vy'])):
        assert parameters[f'{sensor}_config'] == [name in fused for name in STATE]


# Launch

def launch_arguments():
    """Return the tables of gyro.launch.py by name: argument -> parameter or default, text."""
    return {node.targets[0].id: ast.literal_eval(node.value)
            for node in ast.parse((ROOT / 'launch/gyro.launch.py').read_text()).body
            if isinstance(node, ast.Assign) and isinstance(node.value, ast.Dict)}


def test_the_launch_arguments_that_the_documents_name_are_those_of_the_launch_file():
    declared = {'driver_config', 'compensation_config'}.union(*launch_arguments().values())
    page = (ROOT / 'docs/reference/on_a_robot.md').read_text()
    table = page.partition('| launch argument |')[2].partition('\n\n')[0]
    rows = [line.split('|')[1] for line in table.splitlines()[2:]]
    assert {name for row in rows for name in re.findall(r'`(\w+)`', row)} == declared
    other = (ROOT / 'docs/how_to/nav2.md').read_text()
    code = other.partition('```python\n')[2].partition('```')[0]
    assert ('generate_launch_description' in compile(code, 'launch', 'exec').co_names
            and 'robot_localization.yaml' in code)
    used = set(re.findall(r"'(\w+)': '", other)) | set(re.findall(r'`(\w+):=', other))
    assert used <= declared


@pytest.mark.parametrize('name, node', [('DRIVER', driver_node), ('COMPENSATION', pipeline)])
def test_the_launch_arguments_that_are_parameters_are_parameters_of_the_nodes(name, node):
    wanted = {parameter for parameter, _ in launch_arguments()[name].values()}
    assert wanted <= {parameter.name for parameter in node.PARAMETERS}
