# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Diagnostics of a node on ``/diagnostics``, under its fully qualified name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
import threading

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
Report = tuple[bytes, str, Mapping[str, object]]


def status_array(node: Node, name: str, report: Report, hardware_id: str = '') -> DiagnosticArray:
    """Return a message with one status, named ``<fully qualified node name>: <name>``."""
    level, message, values = report
    status = DiagnosticStatus(
        level=level, name=f'{node.get_fully_qualified_name()}: {name}', message=message,
        hardware_id=hardware_id,
        values=[KeyValue(key=key, value=str(value)) for key, value in values.items()])
    array = DiagnosticArray(status=[status])
    array.header.stamp = node.get_clock().now().to_msg()
    return array


class Diagnostics:
    """Publisher of reports; `level` is that of the last report, None before the first."""

    def __init__(self, node: Node, name: str, report: Callable[[], Report],
                 hardware_id: str = 'none'):
        """
        Create the publisher of diagnostics with a status name, such as ``'gyro'``.

        `report` returns level, sentence and values by name. It is never called concurrently, and
        must not call `publish`.

        """
        self.level: bytes | None = None
        self._node, self._name, self._hardware = node, name, hardware_id
        self._report, self._lock = report, threading.Lock()
        self._publisher = node.create_publisher(DiagnosticArray, '/diagnostics', 10)

    def publish(self) -> None:
        """Make and publish a report; may be called from any thread."""
        with self._lock:
            report = self._report()
            self._publisher.publish(status_array(self._node, self._name, report, self._hardware))
            self.level = report[0]
