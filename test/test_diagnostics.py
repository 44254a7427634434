# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""What a node reports: under its full name, once a second, whatever time does."""

import pytest

pytest.importorskip('rclpy', reason='ROS 2 (rclpy) is not installed')

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from gyro_calibration.ros.diagnostics import Diagnostics

OK, ERROR = DiagnosticStatus.OK, DiagnosticStatus.ERROR


@pytest.fixture
def heard(ros):
    """Return the list of everything that comes on /diagnostics."""
    return ros.collect(DiagnosticArray, '/diagnostics', 10)


def test_a_report_has_the_full_name_the_level_and_all_values_as_text(ros, heard, wait_until):
    made = Diagnostics(ros.node, 'thing',
                       lambda: (OK, 'well', {'number': 1.5, 'none': ''}), 'port 1')
    wait_until(lambda: ros.node.count_publishers('/diagnostics'))
    wait_until(lambda: made.now() or heard, what='a report')
    status, = heard[-1].status
    assert (status.name, status.hardware_id) == ('/test_client: thing', 'port 1')
    assert (status.level, status.message, made.level) == (OK, 'well', OK)
    assert [(pair.key, pair.value) for pair in status.values] == [('number', '1.5'), ('none', '')]
    assert heard[-1].header.stamp.sec > 0


def test_each_report_is_made_anew(ros, heard, wait_until):
    reports = iter([(OK, 'first', {})] + 1000 * [(ERROR, 'second', {})])
    made = Diagnostics(ros.node, 'thing', lambda: next(reports))
    made.now()
    assert made.level == OK
    wait_until(lambda: made.now() or heard, what='a report')
    assert made.level == ERROR and heard[-1].status[0].message == 'second'


def test_both_nodes_report_in_their_namespace_also_without_gyro_samples_and_clock(
        start_node, heard, wait_until, tmp_path):
    start_node('driver_node', {'port': tmp_path / 'gyro'}, {'__ns': '/robot'})
    start_node('compensation_node', {'calibration_file': tmp_path / 'calibration.yaml',
                                     'use_sim_time': 'true'}, {'__ns': '/robot'})

    def found():
        return {status.name: status for array in list(heard) for status in array.status}
    names = {'/robot/driver_node: gyro', '/robot/compensation_node: heading'}
    wait_until(lambda: names <= set(found()), 60.0, f'{names}')
    wait_until(lambda: all(found()[name].level == ERROR for name in names), what='errors')
    count = len(heard)
    wait_until(lambda: len(heard) > count + 4, what='reports, once a second')
    assert 'does not exist' in found()['/robot/driver_node: gyro'].message
    assert 'ROS time stands still' in found()['/robot/compensation_node: heading'].message
