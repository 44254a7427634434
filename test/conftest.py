# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Fixtures for tests with ROS 2 processes: local, apart from each other, always ended."""

from collections import defaultdict
import contextlib
import copy
import fcntl
from functools import cache
from importlib import metadata
import json
import os
from pathlib import Path
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from types import SimpleNamespace

import pytest

# tests measure as the benchmarks do, in smaller numbers
sys.path.append(str(Path(__file__).parents[1] / 'benchmarks'))

_FOLDER = Path(tempfile.mkdtemp(prefix='gyro_calibration_test_'))
_SHARED_MEMORY = Path('/dev/shm')  # of Linux

# Discovery takes 0.3 s or 3 s at random by default; so it takes less than 0.6 s.
_PROFILE = (
    """<?xml version="1.0" encoding="UTF-8" ?>
<dds xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">
  <profiles>{transport}
    <participant profile_name="test" is_default_profile="true">
      <rtps>{choice}<builtin><discovery_config>
        <leaseAnnouncement><sec>0</sec><nanosec>200000000</nanosec></leaseAnnouncement>
        <initialAnnouncements><count>10</count>"""
    """<period><sec>0</sec><nanosec>100000000</nanosec></period></initialAnnouncements>
      </discovery_config></builtin></rtps>
    </participant>
  </profiles>
</dds>
""")
_BY_UDP = ('<defaultUnicastLocatorList><locator><udpv4><address>127.0.0.1</address></udpv4>'
           '</locator></defaultUnicastLocatorList>')
# By default a process that the machine does not let run for a second, or to which 512 messages
# come meanwhile, loses them all.
_PATIENT = (
    """
    <transport_descriptors><transport_descriptor>
      <transport_id>patient</transport_id><type>SHM</type><segment_size>2097152</segment_size>
      <port_queue_capacity>8192</port_queue_capacity>"""
    """<healthy_check_timeout_ms>20000</healthy_check_timeout_ms>
    </transport_descriptor></transport_descriptors>""")
_BY_PATIENT = '<userTransports><transport_id>patient</transport_id></userTransports>'


def _is_old():
    """Tell whether ROS 2 is Jazzy or older: Kilted warns of their variable on standard error."""
    try:
        return metadata.version('ros-rclpy').startswith('7.')
    except metadata.PackageNotFoundError:
        return os.environ.get('ROS_DISTRO', 'jazzy') in ('humble', 'iron', 'jazzy')


_PROFILES_FILE = f'{"FASTRTPS" if _is_old() else "FASTDDS"}_DEFAULT_PROFILES_FILE'


def _profile(name, choice='', transport=''):
    """Write a profile of Fast DDS and return the environment that has it used."""
    path = _FOLDER / name
    path.write_text(_PROFILE.format(choice=choice, transport=transport))
    return {_PROFILES_FILE: str(path)}


# before any test module imports rclpy
os.environ.setdefault('AMENT_PREFIX_PATH', sys.prefix)
os.environ['PYTHONPATH'] = os.pathsep.join(
    filter(None, [str(Path(__file__).parents[1]), os.environ.get('PYTHONPATH')]))
os.environ.update({
    'ROS_LOG_DIR': str(_FOLDER),
    'OPENBLAS_NUM_THREADS': '1',  # as the program does; NumPy is not imported yet
    'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
    **_profile('patient.xml', _BY_PATIENT, _PATIENT),
})


_TIMED = 'test_connection', 'test_fuzz', 'test_launch'

# Of those that only compute, what takes longest comes first: the last files, which one of several
# processes may have to itself, are then short ones.
_LONG = ('test_diagnosis', 'test_record_verb', 'test_selection', 'test_self_calibration',
         'test_motion_design', 'test_findings', 'test_extended_model', 'test_reproduction',
         'test_run_faults', 'test_encoder', 'test_followed_logs',
         'test_rate_table_diagnosis', 'test_verbs', 'test_allan', 'test_package',
         'test_search', 'test_hidden')


def pytest_collection_modifyitems(config, items):
    """Mark what has to keep time, and leave out evidence, which takes minutes, unless asked."""
    for item in items:
        # the item of a launch test has no fixtures
        if 'ros_domain' in getattr(item, 'fixturenames', ()):
            item.add_marker('ros')
            item.add_marker('timed')
        elif Path(item.location[0]).stem in _TIMED:
            item.add_marker('timed')
    if 'evidence' not in config.getoption('markexpr'):
        long = [item for item in items if item.get_closest_marker('evidence')]
        config.hook.pytest_deselected(items=long)
        items[:] = [item for item in items if item not in long]
    order = dict(zip(_LONG, range(len(_LONG))))
    items.sort(key=lambda item: order.get(Path(item.location[0]).stem, len(_LONG)))


def pytest_unconfigure(config):
    shutil.rmtree(_FOLDER, ignore_errors=True)


def wait_until(predicate, timeout=30.0, what=None):
    """Poll a condition until it is true and return its value; fail after a timeout, s."""
    deadline = time.monotonic() + timeout
    while not (value := predicate()):
        assert time.monotonic() < deadline, f'not within {timeout} s: {what or predicate}'
        time.sleep(0.01)
    return value


@pytest.fixture(name='wait_until')
def _wait_until():
    return wait_until


def operations(work):
    """
    Return how many lines of Python a function runs and how many functions it calls.

    A busy machine changes nothing. What a function of C does is one.
    """
    count, before = 0, (sys.gettrace(), sys.getprofile())

    def line(frame, event, _):
        nonlocal count
        count += 1
        return line

    def call(frame, event, _):
        nonlocal count
        count += event == 'c_call'
    sys.settrace(line)
    sys.setprofile(call)
    try:
        work()
    finally:
        sys.settrace(before[0])
        sys.setprofile(before[1])
    return count


def strict(text):
    """Read JSON that knows neither NaN nor Infinity."""
    def refuse(word):
        raise ValueError(word)
    return json.loads(text, parse_constant=refuse)


@pytest.fixture
def data():
    folder = Path(os.environ.get('GYRO_CALIBRATION_DATA', '/nonexistent'))
    if not folder.is_dir():
        pytest.skip('no recordings: set GYRO_CALIBRATION_DATA to the folder that holds them')
    return folder


@pytest.fixture
def run(capsys):
    """Return a function that runs the program and gives exit code, output and error output."""
    from gyro_calibration.cli import main as program  # not before the environment is prepared
    if not hasattr(program.find_verbs, 'cache_info'):  # takes 40 ms
        program.find_verbs = cache(program.find_verbs)

    def run(*words):
        try:
            code = program.main([str(word) for word in words])
        except SystemExit as end:  # argparse
            code = end.code
        return code, *capsys.readouterr()
    return run


@pytest.fixture
def compensate(run, tmp_path):
    """
    Return a function that compensates a log by a model, given as paths or as such.

    It gives ``code``, ``text``, ``error``, the written ``log``, and its new ``columns``.
    """
    from gyro_calibration.logs.log import read_log, write_log
    from gyro_calibration.model.model_file import write_model
    import numpy as np

    def compensate(log, model, *words):
        if not isinstance(log, Path):
            write_log(tmp_path / 'log.csv', log)
            log = tmp_path / 'log.csv'
        if not isinstance(model, Path):
            if isinstance(model, str):
                (tmp_path / 'model.yaml').write_text(model)
            else:
                write_model(tmp_path / 'model.yaml', model)
            model = tmp_path / 'model.yaml'
        out = tmp_path / 'out.csv'
        code, text, error = run('compensate', log, '--model', model, '--out', out, *words)
        done = SimpleNamespace(code=code, text=text, error=error, log=None)
        if out.exists():
            done.log = read_log(out)
            done.columns = {name: np.array(values, float)
                            for name, values in done.log.others.items()}
        return done
    return compensate


@pytest.fixture
def ros_domain(monkeypatch):
    """Keep the ROS traffic of a test apart from all others; skip where ROS 2 is missing."""
    pytest.importorskip('rclpy', reason='ROS 2 (rclpy) is not installed')
    with _free_domain() as number:
        monkeypatch.setenv('ROS_DOMAIN_ID', str(number))
        yield number


def _is_mine(lock):
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _is_empty(domain):
    """
    Remove the ports that killed nodes left in shared memory; return whether nobody listens.

    Fast DDS would use such a port again, with less room than `_PATIENT` says.
    """
    ports = {int(re.findall(r'[0-9]+', path.name)[0])
             for path in _SHARED_MEMORY.glob('fastrtps_port*')}
    first = 7400 + 250 * domain  # below 7400 are ports that all domains share
    listened = [port for port in ports
                if (port < 7400 or first <= port < first + 250) and not _is_left(port)]
    return all(port < 7400 for port in listened)


def _is_left(port):
    """Tell whether nobody listens at a port of Fast DDS in shared memory, and remove it then."""
    with contextlib.suppress(FileNotFoundError), open(
            _SHARED_MEMORY / f'fastrtps_port{port}_el') as lock:
        if not _is_mine(lock):
            return False
    for name in (f'fastrtps_port{port}', f'fastrtps_port{port}_el',
                 f'sem.fastrtps_port{port}_mutex'):
        (_SHARED_MEMORY / name).unlink(missing_ok=True)
    return True


@contextlib.contextmanager
def _free_domain():
    """Give a domain where nobody is; its lock keeps other test runs on this machine out of it."""
    for number in random.SystemRandom().sample(range(1, 102), 101):
        with open(Path(tempfile.gettempdir()) / f'gyro_calibration_domain_{number}', 'w') as lock:
            if _is_mine(lock) and _is_empty(number):
                yield number
                return
    pytest.fail('all ROS domains from 1 to 101 are taken')


@pytest.fixture
def by_udp(monkeypatch):
    """
    Have the nodes of a test, which kills them, hear by UDP.

    Fast DDS 2.14 may go on sending to the shared memory of a process that was killed; then the
    one that comes in its place hears nothing (issues 5053 and 5469 of Fast DDS).
    """
    for name, value in _profile('udp.xml', _BY_UDP).items():
        monkeypatch.setenv(name, value)


class NodeProcess:
    """A node in a process of its own, as a robot starts it."""

    def __init__(self, module, parameters, remappings):
        arguments = [f'{name}:={value}' for name, value in parameters.items()]
        self._command = [sys.executable, '-m', f'gyro_calibration.ros.{module}', '--ros-args']
        self._command += [word for argument in arguments for word in ('-p', argument)]
        self._command += [
            word for old, new in remappings.items() for word in ('-r', f'{old}:={new}')]
        self.waited = False
        handle, self._output = tempfile.mkstemp(dir=_FOLDER)
        with os.fdopen(handle, 'wb') as output:
            self.process = subprocess.Popen(self._command, stdout=output, stderr=subprocess.STDOUT,
                                            start_new_session=True)

    @property
    def output(self):
        return Path(self._output).read_text(errors='replace')

    def wait(self, timeout=30.0):
        self.waited = True
        return self.process.wait(timeout)

    def stop(self, number=signal.SIGINT, timeout=30.0):
        self.interrupt(number)
        return self.wait(timeout)

    def interrupt(self, number=signal.SIGINT):
        if self.process.poll() is None:
            os.killpg(self.process.pid, number)

    def close(self):
        """End it at all costs, and check that it ended well."""
        try:
            code = None if self.waited and self.process.poll() is not None else self.stop()
        except subprocess.TimeoutExpired:
            code = 'none: it had to be killed'
        finally:
            if self.process.poll() is None:
                os.killpg(self.process.pid, signal.SIGKILL)
                self.process.wait()
        assert code in (None, 0), (
            f'{" ".join(self._command)} ended with code {code}:\n{self.output}')
        assert 'Traceback' not in self.output, self.output


@pytest.fixture
def start_node(ros_domain, request):
    """
    Return a function that starts a `NodeProcess` by module, parameters and remappings.

    A node that a test did not itself wait for must still run at the end, end on SIGINT with code
    0, and never print a traceback.
    """
    nodes = []

    def start(module, parameters=None, remappings=None):
        nodes.append(NodeProcess(module, parameters or {}, remappings or {}))
        return nodes[-1]

    failures = request.session.testsfailed
    yield start
    if request.session.testsfailed > failures or any('Traceback' in node.output for node in nodes):
        for node in nodes:
            print(f'--- output of {" ".join(node._command)}\n{node.output}')
    problems = []
    for node in nodes:
        try:
            node.close()
        except AssertionError as problem:
            problems.append(str(problem))
    assert not problems, '\n'.join(problems)


class HeldNode:
    """
    A node that nobody spins, in the process of a test, which calls what an executor would.

    Each topic seems to have two subscribers; ``sent`` has a list of messages for each.
    """

    def __init__(self, node_class, monkeypatch, parameters, remappings):
        import rclpy
        from rclpy.publisher import Publisher
        from rclpy.signals import SignalHandlerOptions
        self.sent = defaultdict(list)
        monkeypatch.setattr(Publisher, 'publish', lambda *sent: self._keep(*sent))
        monkeypatch.setattr(Publisher, 'get_subscription_count', lambda _: 2)
        words = [word for name, value in parameters.items() for word in ('-p', f'{name}:={value}')]
        words += [word for old, new in remappings.items() for word in ('-r', f'{old}:={new}')]
        rclpy.init(args=['node', '--ros-args', *words] if words else [],
                   signal_handler_options=SignalHandlerOptions.NO)
        self._end = rclpy.shutdown
        try:
            self.node = node_class()
        except BaseException:
            self._end()
            raise

    def _keep(self, publisher, message):
        if isinstance(message, bytes):
            from rclpy.serialization import deserialize_message
            message = deserialize_message(message, publisher.msg_type)
        self.sent[publisher.topic_name].append(copy.deepcopy(message))

    def send(self, topic, message):
        heard = {each.topic_name: each.callback for each in self.node.subscriptions}
        heard[topic](message)

    def tick(self, times=1):
        for _ in range(times):
            for timer in list(self.node.timers):
                timer.callback()

    def call(self, name, kind):
        offered = {self.node.resolve_service_name(each.srv_name): each.callback
                   for each in self.node.services}
        return offered[name](kind.Request(), kind.Response())

    def put(self, name, value):
        from rclpy.parameter import Parameter
        return self.node.set_parameters([Parameter(name, value=value)])[0]

    def close(self):
        self.node.destroy_node()
        self._end()


@pytest.fixture
def hold_node(ros_domain, monkeypatch):
    """Return a function that makes a `HeldNode` by class, parameters and remappings."""
    with contextlib.ExitStack() as stack:
        def hold(node_class, parameters=None, remappings=None):
            stack.close()
            held = HeldNode(node_class, monkeypatch, parameters or {}, remappings or {})
            stack.callback(held.close)
            return held
        yield hold


class Ros:
    """A node in the process of the test, with an executor that spins in a thread."""

    def __init__(self, domain=None):
        import rclpy
        from gyro_calibration.ros.runner import SENSOR_QOS
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.signals import SignalHandlerOptions
        self._quality = SENSOR_QOS
        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=domain,
                   signal_handler_options=SignalHandlerOptions.NO)
        self.node = rclpy.create_node('test_client', context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._spin)
        self._thread.start()

    def _spin(self):
        while not self._stop.is_set():
            self._executor.spin_once(timeout_sec=0.05)

    def collect(self, message_type, topic, quality=None):
        messages = []
        self.node.create_subscription(message_type, topic, messages.append,
                                      quality or self._quality)
        return messages

    def publisher(self, message_type, topic, quality=None):
        return self.node.create_publisher(message_type, topic, quality or self._quality)

    def call(self, service_type, name, **request):
        client = self.node.create_client(service_type, name)
        assert client.wait_for_service(30.0), f'no service {name} within 30 s'
        return client.call_async(service_type.Request(**request))

    def close(self):
        """Join the thread and leave nothing behind."""
        self._stop.set()
        self._thread.join()
        self._executor.shutdown()
        self._settle()
        self.node.destroy_node()
        self._context.try_shutdown()

    def _settle(self, quiet=0.15, timeout=5.0):
        """Wait until nobody comes or goes; else Fast DDS 2.14 may hang or crash as it ends."""
        seen, since, deadline = None, time.monotonic(), time.monotonic() + timeout
        while time.monotonic() < min(since + quiet, deadline):
            around = (sorted(self.node.get_node_names()),
                      sorted(self.node.get_topic_names_and_types()))
            if around != seen:
                seen, since = around, time.monotonic()
            time.sleep(0.01)


@pytest.fixture
def ros(ros_domain):
    """Return a `Ros`, whose node is in the domain of the nodes that `start_node` started."""
    client = Ros()
    yield client
    client.close()
