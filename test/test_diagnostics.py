"""
Others hear the same of a node whether ``diagnostic_updater`` is installed or not, once a second and at once when asked.

The real ``diagnostic_updater`` takes part where it is installed; a stand-in with the same interface does everywhere.

"""

import itertools
import os
import re
import shutil
import threading
import time
from importlib.util import find_spec
from pathlib import Path

import pytest

pytest.importorskip('rclpy', reason='ROS 2 (rclpy) is not installed')

import diagnostic_updater_stand_in
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.srv import ListParameters

from gyro_calibration.ros import diagnostics
from gyro_calibration.ros.diagnostics import Diagnostics

STAND_IN = Path(diagnostic_updater_stand_in.__file__)
PERIOD = 0.2  # s, for tests within one process; nodes report once a second
OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
with_and_without = pytest.mark.parametrize('updater', ['none', 'stand-in', 'installed'], indirect=True)


@pytest.fixture
def updater(request, monkeypatch):
    """Let the package find no updater, the stand-in, or the real one; skip where that is not installed."""
    if request.param == 'installed':
        real = pytest.importorskip('diagnostic_updater', reason='diagnostic_updater is not installed')
    given = {'none': lambda: None, 'stand-in': lambda: diagnostic_updater_stand_in.Updater, 'installed': lambda: real.Updater}
    monkeypatch.setattr(diagnostics, 'Updater', given[request.param]())
    monkeypatch.setattr(diagnostics, 'PERIOD', PERIOD)
    return request.param


@pytest.fixture
def heard(ros):
    """Return the list that goes on with everything that comes on /diagnostics."""
    return ros.collect(DiagnosticArray, '/diagnostics', 10)


def stamp(array):
    """Return the stamp of a message in s."""
    return array.header.stamp.sec + 1e-9 * array.header.stamp.nanosec


def steps(heard):
    """Return the times between reports, s."""
    return [later - earlier for earlier, later in itertools.pairwise(map(stamp, list(heard)))]


def met(ros, wait_until, report, **more):
    """Return diagnostics of the test's own node, when it has met its own listener."""
    made = Diagnostics(ros.node, 'thing', report, **more)
    wait_until(lambda: ros.node.count_publishers('/diagnostics') and ros.node.count_subscribers('/diagnostics'))
    return made


@with_and_without
def test_a_report_is_one_status_with_name_level_sentence_values_and_device(updater, ros, heard, wait_until):
    met(ros, wait_until, lambda: (WARN, 'it is warm', {'temperature': 41.5, 'port': '/dev/x', 'open': True}), hardware_id='/dev/x')
    wait_until(lambda: heard)
    status, = heard[0].status
    assert (status.name, status.level, status.message, status.hardware_id) == ('test_client: thing', WARN, 'it is warm', '/dev/x')
    assert [(pair.key, pair.value) for pair in status.values] == [('temperature', '41.5'), ('port', '/dev/x'), ('open', 'True')]
    assert abs(heard[0].header.stamp.sec - time.time()) < 60.0


@with_and_without
def test_nothing_is_said_before_the_first_look_and_the_device_has_a_word_for_none(updater, ros, heard, wait_until):
    met(ros, wait_until, lambda: (ERROR, 'it is broken', {}))
    wait_until(lambda: len(heard) > 1)
    assert {(array.status[0].level, array.status[0].message, array.status[0].hardware_id) for array in heard} == {
        (ERROR, 'it is broken', 'none')}


@with_and_without
def test_it_reports_once_a_period_and_at_once_when_asked(updater, ros, heard, wait_until):
    numbers = itertools.count()
    made = met(ros, wait_until, lambda: (OK, str(next(numbers)), {}))
    wait_until(lambda: len(heard) > 1)
    wait_until(lambda: [round(step / PERIOD, 1) for step in steps(heard)[-4:]] == [1.0] * 4, what='four reports a period apart')
    count = len(heard)
    made.now()
    made.now()
    wait_until(lambda: len(heard) >= count + 2)
    assert min(steps(heard)) < 0.5 * PERIOD
    numbers = [int(array.status[0].message) for array in heard]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))


@with_and_without
def test_two_threads_never_look_at_the_same_time(updater, ros):
    inside, most = [], []

    def report():
        inside.append(1)
        most.append(len(inside))
        time.sleep(0.002)
        inside.pop()
        return OK, '', {}
    made = Diagnostics(ros.node, 'thing', report)
    threads = [threading.Thread(target=lambda: [made.now() for _ in range(20)]) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(most) >= 80 and max(most) == 1


@with_and_without
def test_the_level_of_the_last_report_is_known(updater, ros, monkeypatch):
    monkeypatch.setattr(diagnostics, 'PERIOD', 1000.0)
    levels = iter([OK, WARN, ERROR, *[OK] * 100])
    made = Diagnostics(ros.node, 'thing', lambda: (next(levels), '', {}))
    assert made.level is None
    made.now()
    assert made.level == OK
    made.now()
    assert made.level == WARN


@pytest.fixture
def stand_in(tmp_path, monkeypatch):
    """Return a function that lets processes that start from now on find the stand-in; skip where they find the real one before."""
    if find_spec('diagnostic_updater'):
        pytest.skip('diagnostic_updater is installed, and cannot be hidden')

    def stand_in():
        (tmp_path / 'diagnostic_updater').mkdir()
        shutil.copy(STAND_IN, tmp_path / 'diagnostic_updater' / '__init__.py')
        monkeypatch.setenv('PYTHONPATH', os.pathsep.join([str(tmp_path), os.environ['PYTHONPATH']]))
    return stand_in


def parameters(ros, node):
    """Return the names of the parameters of a node."""
    return set(ros.call(ListParameters, f'/{node}/list_parameters').result.names)


def shape(status):
    """Return what must not depend on who publishes."""
    # how long a gyro is silent is said in whole seconds
    message = re.sub(r'\d+ s', '# s', status.message)
    return status.name, status.level, message, status.hardware_id, tuple(pair.key for pair in status.values)


def said_by(ros, wait_until, heard, name):
    """Return what a node says when it has come to rest: twice the same."""
    def settled():
        said = [shape(array.status[0]) for array in heard if array.status[0].name.startswith(f'{name}: ')]
        return len(said) > 2 and said[-1] == said[-2] and said[-1]
    return wait_until(settled, 60.0, f'diagnostics of {name}')


def test_both_nodes_say_the_same_with_and_without(start_node, ros, heard, wait_until, stand_in, tmp_path):
    """A gyro that is not there, and samples that do not come."""
    settings = {'driver_node': {'port': tmp_path / 'gyro'}, 'compensation_node': {'calibration_file': tmp_path / 'calibration.yaml'}}
    plain = {name: start_node(name, given) for name, given in settings.items()}
    stand_in()
    others = {name: start_node(name, given, {'__node': f'other_{name}'}) for name, given in settings.items()}
    for name, subject in (('driver_node', 'gyro'), ('compensation_node', 'heading')):
        said = said_by(ros, wait_until, heard, name)
        assert said[:2] == (f'{name}: {subject}', ERROR) and len(said[-1]) > 5
        assert said_by(ros, wait_until, heard, f'other_{name}') == (f'other_{name}: {subject}', *said[1:])
        assert 'diagnostic_updater.period' not in parameters(ros, name)
        assert 'diagnostic_updater.period' in parameters(ros, f'other_{name}')
    for node in [*plain.values(), *others.values()]:
        node.interrupt()


def test_they_come_also_while_the_time_of_a_simulation_stands_still(start_node, heard, wait_until, tmp_path):
    start_node('compensation_node', {'calibration_file': tmp_path / 'calibration.yaml', 'use_sim_time': True})
    wait_until(lambda: len(heard) > 1, what= 'diagnostics without a clock')
