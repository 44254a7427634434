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
from gyro_calibration.ros.compensation_node import CompensationNode
from gyro_calibration.ros.driver_node import DriverNode
from gyro_calibration.ros.runner import Diagnostics
from rclpy.clock import ClockType

OK, ERROR = DiagnosticStatus.OK, DiagnosticStatus.ERROR


@pytest.fixture
def heard(ros):
    return ros.collect(DiagnosticArray, '/diagnostics', 10)


def test_a_report_has_the_full_name_the_level_and_all_values_as_text(ros, heard, wait_until):
    made = Diagnostics(ros.node, 'thing',
                       lambda: (OK, 'well', {'number': 1.5, 'none': ''}), 'port 1')
    wait_until(lambda: ros.node.count_publishers('/diagnostics'))
    wait_until(lambda: made.publish() or heard, what='a report')
    status, = heard[-1].status
    assert (status.name, status.hardware_id) == ('/test_client: thing', 'port 1')
    assert (status.level, status.message, made.level) == (OK, 'well', OK)
    assert [(pair.key, pair.value) for pair in status.values] == [('number', '1.5'), ('none', '')]
    assert heard[-1].header.stamp.sec > 0


@pytest.mark.parametrize('node_class, name, parameters, words',
                         [(DriverNode, 'driver_node: gyro', {'port': '/nonexistent/gyro'},
                           'does not exist'), (CompensationNode, 'compensation_node: heading',
                                               {'use_sim_time': 'true'}, 'ROS time stands still')],
                         ids=['driver', 'compensation'])
def test_a_node_reports_in_its_namespace_also_without_gyro_samples_and_clock(
        hold_node, wait_until, tmp_path, node_class, name, parameters, words):
    if node_class is CompensationNode:
        parameters = {**parameters, 'calibration_file': tmp_path / 'calibration.yaml'}
    held = hold_node(node_class, parameters, {'__ns': '/robot'})

    def reported():
        held.tick()
        return [status for array in held.sent['/diagnostics'] for status in array.status
                if status.level == ERROR and words in status.message]
    wait_until(reported, what=words)
    assert {status.name for status in reported()} == {f'/robot/{name}'}
    assert all(timer.clock.clock_type == ClockType.STEADY_TIME for timer in held.node.timers)
