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

from gyro_calibration.ros.compensation_node import CompensationNode
from gyro_calibration.ros.driver_node import DriverNode
from rclpy.clock import ClockType


@pytest.mark.parametrize('node_class, name, parameters, words', [
    (DriverNode, 'driver_node: gyro', {'port': '/nonexistent/gyro'}, 'does not exist'),
    (CompensationNode, 'compensation_node: heading', {'use_sim_time': 'true'},
     'ROS time stands still')], ids=['driver', 'compensation'])
def test_a_node_reports_in_its_namespace_also_without_gyro_samples_and_clock(
        hold_node, wait_until, tmp_path, node_class, name, parameters, words):
    if node_class is CompensationNode:
        parameters = {**parameters, 'calibration_file': tmp_path / 'calibration.yaml'}
    held = hold_node(node_class, parameters, {'__ns': '/robot'})

    def reported():
        held.tick()
        return [status for array in held.sent['/diagnostics'] for status in array.status
                if status.level == status.ERROR and words in status.message]
    wait_until(reported, what=words)
    assert {(status.name, status.hardware_id) for status in reported()} == {
        (f'/robot/{name}', parameters.get('port', 'none'))}
    values = {pair.key: pair.value for pair in reported()[-1].values}
    assert float(values['rate_hz']) == 0.0
    stamp = held.sent['/diagnostics'][-1].header.stamp
    assert (stamp.sec > 0) == (node_class is DriverNode), 'the time of a simulation stands at 0'
    assert all(timer.clock.clock_type == ClockType.STEADY_TIME for timer in held.node.timers)
