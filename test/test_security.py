# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The security policy: it equals what the nodes really have, and none drives unless asked."""

from pathlib import Path
import re
from xml.etree import ElementTree

from gyro_calibration.logs.recording import topic_type_fault
import pytest
from rig import rested
from test_layers import calls, FILES, imports

try:
    from nav_msgs.msg import Odometry
    from rclpy.node import NodeNameNonExistentError
    from rclpy.parameter import Parameter
    from sensor_msgs.msg import Imu, Temperature
    from std_srvs.srv import Trigger
except ImportError:
    pass  # the fixture `ros` skips every test that needs them, and says why

ROOT = Path(__file__).parents[1]
POLICY = ElementTree.parse(ROOT / 'config/sros2/policy.xml').getroot()
ENCLAVES = {enclave.get('path').rpartition('/')[2]: enclave for enclave in POLICY.iter('enclave')}

# What the package may import, run and start


NETWORK = {'socket', 'socketserver', 'ssl', 'asyncio', 'http', 'urllib.request', 'xmlrpc',
           'ftplib', 'smtplib', 'telnetlib', 'requests', 'urllib3', 'zmq', 'websockets'}
CODE_FROM_DATA = {'pickle', 'cPickle', 'dill', 'joblib', 'marshal', 'shelve', 'runpy', 'imp',
                  'code', 'ctypes', 'eval', 'exec', 'compile', '__import__', 'yaml.load_all',
                  'yaml.unsafe_load', 'yaml.full_load', 'os.system', 'os.popen', 'numpy.load',
                  'np.load'}
PROCESSES = {'subprocess', 'pty.spawn', *(f'os.{start}{how}' for start in ('exec', 'spawn')
                                          for how in ('l', 'le', 'lp', 'lpe', 'v', 've', 'vp',
                                                      'vpe'))}


@pytest.mark.parametrize('forbidden, excepted', [
    (NETWORK, set()), (CODE_FROM_DATA, set()), (PROCESSES, {'demo.py'}),
    ({'multiprocessing'}, {'run.py'}),  # a fleet's processes on one machine, joined by pipes
    ({'yaml.load'}, {'settings_file.py'})],
    ids=['the network', 'code from data', 'processes', 'workers', 'YAML'])
def test_no_file_but_those_excepted_uses(forbidden, excepted):
    assert {path.name for path in FILES for name in imports(path) | calls(path)
            if any(name == root or name.startswith(f'{root}.') for root in forbidden)} == excepted


def test_only_the_command_line_runs_a_file_that_the_user_names():
    assert {path.name for path in FILES if any(
        name.endswith('exec_module') for name in calls(path))} == {'main.py'}


def test_only_what_replaces_files_in_one_step_writes_them():
    """But for what is deleted again: the file of `ros_bag` that sqlite3 opens."""
    writing = re.compile(r"open\([^)]*'[wax]|os\.open\([^)]*O_CREAT|\.write_(text|bytes)\(|"
                         r'savefig\((?!file)')
    assert {path.name for path in FILES if writing.search(path.read_text())} == {
        'files.py', 'ros_bag.py'}


@pytest.mark.parametrize('kind', ['idlelib/idle/Imu', 'os', 'a.b/msg/Imu', '../msg/Imu', ''])
def test_a_kind_of_message_chooses_no_module_that_a_recorder_imports(kind):
    assert all(topic_type_fault(role, 'a topic', kind)
               for role in ('gyro', 'temperature', 'reference'))


# The policy of a secured graph

ACCESS = {('topics', 'publish'): 'publisher', ('topics', 'subscribe'): 'subscriber',
          ('services', 'reply'): 'service', ('services', 'request'): 'client'}


def resolved(name, namespace, node):
    """Return a name with its namespace, as the policy means it."""
    if name.startswith('~'):
        return f'{namespace.rstrip("/")}/{node}{name[1:]}'
    return name if name.startswith('/') else f'{namespace.rstrip("/")}/{name}'


def allowed(enclave, namespace='/'):
    """Return the end points that an enclave allows in a namespace: pairs of kind and name."""
    profile, = ENCLAVES[enclave].iter('profile')
    assert profile.get('ns') == '/'
    return {(ACCESS[rules.tag, key], resolved(rule.text, namespace, profile.get('node')))
            for rules in profile for key, value in rules.items() if value == 'ALLOW'
            for rule in rules}


def really(node, name, namespace):
    """Return what a node of the graph has, alike; nothing as long as it is not discovered."""
    ways = {'publisher': node.get_publisher_names_and_types_by_node,
            'subscriber': node.get_subscriber_names_and_types_by_node,
            'service': node.get_service_names_and_types_by_node,
            'client': node.get_client_names_and_types_by_node}
    try:
        return {(kind, topic) for kind, ask in ways.items() for topic, _ in ask(name, namespace)}
    except NodeNameNonExistentError:
        return set()


def test_the_policy_has_the_form_that_the_tools_read():
    # with comments, which the tools of sros2 take for an enclave, and give up
    parser = ElementTree.XMLParser(target=ElementTree.TreeBuilder(insert_comments=True))
    whole = ElementTree.parse(ROOT / 'config/sros2/policy.xml', parser).getroot()
    assert {child.tag for enclaves in whole.iter('enclaves') for child in enclaves} == {'enclave'}
    for profile in POLICY.iter('profile'):
        rules = [(kind.tag, key, value, rule.text)
                 for kind in profile for rule in kind for key, value in kind.items()]
        assert all((tag, key) in ACCESS and value == 'ALLOW' for tag, key, value, _ in rules)
        assert len(rules) == len(set(rules)), 'one stands twice'
        assert not [text for *_, text in rules if set(text) & set('*?[]')], 'a pattern'


#: Parameters of each enclave's node that together bring every end point that it may have.
SETTINGS = {
    'driver_node': [{}, {'use_sim_time': True}],
    'compensation_node': [{}, {'wheels': 'both', 'cmd_vel_stamped': True, 'use_sim_time': True}],
    'compensation_node_that_drives': [{'calibration.drive': True, 'use_sim_time': True}],
}
ONLY_THEN = {('subscriber', '/clock')}  # what a node has only where it is asked for


def node_of(enclave):
    from gyro_calibration.ros.compensation_node import CompensationNode
    from gyro_calibration.ros.driver_node import DriverNode
    name = next(ENCLAVES[enclave].iter('profile')).get('node')
    return {'driver_node': DriverNode, 'compensation_node': CompensationNode}[name]


@pytest.mark.parametrize('enclave', SETTINGS)
def test_the_policy_allows_a_node_exactly_what_it_has(hold_node, wait_until, tmp_path, enclave):
    used, namespace = set(), f'/{enclave}'
    for settings in SETTINGS[enclave]:
        files = ({} if enclave == 'driver_node'
                 else {'calibration_file': tmp_path / 'calibration.yaml'})
        node = hold_node(node_of(enclave), {**files, **settings}, {'__ns': namespace}).node
        made = {each.topic_name for each in (*node.publishers, *node.subscriptions)}
        made |= {node.resolve_service_name(each.srv_name) for each in node.services}

        def have():
            return really(node, node.get_name(), namespace)  # noqa: B023
        wait_until(lambda: made <= {name for _, name in have()}, what=f'{made}')  # noqa: B023
        assert have() <= allowed(enclave, namespace), f'{enclave} has more than it may'
        if not settings:
            special = {(kind, resolved(topic, namespace, node.get_name()))
                       for kind, topic in ONLY_THEN}
            assert have() == allowed(enclave, namespace) - special
        used |= {(kind, topic.replace(namespace, '', 1)) for kind, topic in have()}
    assert used == allowed(enclave), f'{enclave} may more than it has: {allowed(enclave) - used}'


def test_the_policy_allows_a_recording_exactly_what_it_takes(ros, wait_until):
    from gyro_calibration.cli.record import _DEFAULT_TOPICS
    from gyro_calibration.ros.recorder_node import RecorderNode
    import rclpy
    for topic, kind in {'imu/data_raw': Imu, 'imu/temperature': Temperature,
                        'odom': Odometry}.items():
        ros.publisher(kind, topic)
    context = rclpy.Context()
    rclpy.init(args=[], context=context)
    node = RecorderNode({**{topic: role for role, topic in _DEFAULT_TOPICS.items()},
                         'odom': 'reference'}, print, context)

    def has_all():
        node.poll()
        return (not node.missing_topics
                and really(ros.node, node.get_name(), '/') == allowed('record'))
    try:
        wait_until(has_all, what='all of it')
    finally:
        node.destroy_node()
        rclpy.shutdown(context=context)


def test_who_calibrates_cannot_allow_the_robot_to_be_driven():
    assert not [name
                for kind, name in allowed('operator') if kind == 'client' and 'parameter' in name]
    publishers = {enclave for enclave in ENCLAVES if ('publisher', '/cmd_vel') in allowed(enclave)}
    assert publishers == {'compensation_node_that_drives'}


# Who moves the robot, and who chooses files

def test_only_the_calibration_and_the_demonstration_can_command_a_robot():
    makers = {path.name for path in FILES
              if re.search(r"(create_publisher|publish_on)\([^)]*'cmd_vel'", path.read_text())}
    assert makers == {'compensation_node.py', 'demo.py'}


def test_only_a_session_that_may_drive_sends_commands(tmp_path):
    """Not even where the profile has long begun to turn."""
    rig = rested(tmp_path)
    assert not rig.begin()
    rig.turn(0.7, 10.0)
    assert not rig.commands and not rig.session.is_driving


def test_the_node_is_no_publisher_of_commands_before_it_may_drive(hold_node, tmp_path):
    held = hold_node(node_of('compensation_node'), {'calibration_file': tmp_path / 'known.yaml'})

    def drives():
        return '/cmd_vel' in {each.topic_name for each in held.node.publishers}
    answer = held.call('/compensation_node/cancel_calibration', Trigger)
    assert answer.success is False and not drives()
    assert held.put('calibration.drive', True).successful
    assert 'no sample comes on imu/data_raw' in held.call('/compensation_node/calibrate',
                                                          Trigger).message
    assert drives()


@pytest.mark.parametrize('enclave', ['driver_node', 'compensation_node'])
def test_no_client_changes_which_files_and_ports_a_running_node_uses(hold_node, tmp_path, enclave):
    held = hold_node(node_of(enclave), {'calibration_file': tmp_path / 'calibration.yaml'}
                     if enclave == 'compensation_node' else {})
    names = held.node.get_parameters_by_prefix('')
    chosen = sorted(name for name in names if name == 'port' or name.endswith('_file'))
    assert chosen == (['port'] if enclave == 'driver_node'
                      else ['calibration.profile_file', 'calibration_file', 'model_file'])
    for name in chosen:
        given = [Parameter(name, value='/tmp/other')]
        answers = [held.put(name, '/tmp/other'), held.node.set_parameters_atomically(given)]
        assert [answer.successful for answer in answers] == [False, False], name
        assert all('read' in answer.reason for answer in answers)
