"""
What a node says of itself on ``/diagnostics``: through ``diagnostic_updater`` where that is installed, else by a publisher of its own.

Others hear the same either way. Where ``diagnostic_updater`` is installed, its parameters ``diagnostic_updater.period`` and
``diagnostic_updater.use_fqn`` work as in any node that uses it.

"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from gyro_calibration.ros.runner import call_every

try:
    from diagnostic_updater import Updater
except ImportError:  # it is on robots, but there are no wheels of it
    Updater = None

Report = tuple[bytes, str, Mapping[str, object]]
_Fill = Callable[[DiagnosticStatus], DiagnosticStatus]

#: Between two reports, s.
PERIOD = 1.0


class Diagnostics:
    """
    Report once a second, and at once when asked.

    Attributes
    ----------
    level : of the last report; None before the first

    """

    def __init__(self, node: Node, name: str, report: Callable[[], Report], hardware_id: str = 'none'):
        """
        Begin to report.

        Parameters
        ----------
        node : Node
            Its name is the first half of the name of the status.
        name : str
            What is reported on, for example ``'gyro'``.
        report : callable
            Returns the level (``DiagnosticStatus.OK``, ``WARN`` or ``ERROR``), one sentence, and values by name, of anything that has
            a text. It is never called twice at the same time, and must not call `now`.
        hardware_id : str
            Which device this is about; ``'none'`` where it has no name.

        """
        self.level: bytes | None = None
        self._report, self._lock = report, threading.Lock()
        prepare = _prepare_publisher if Updater is None else _prepare_updater
        self._publish, period = prepare(node, name, self._fill, hardware_id)
        call_every(node, period, self.now)

    def now(self) -> None:
        """Report at once, from any thread."""
        with self._lock:
            self._publish()

    def _fill(self, status: DiagnosticStatus) -> DiagnosticStatus:
        status.level, status.message, values = self._report()
        status.values = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
        self.level = status.level
        return status


def _prepare_updater(node: Node, name: str, fill: _Fill, hardware_id: str) -> tuple[Callable[[], None], float]:
    updater = Updater(node, PERIOD)
    updater.setHardwareID(hardware_id)
    updater.addedTaskCallback = lambda task: None  # it would say that all is well before anybody has looked
    updater.add(name, fill)
    node.destroy_timer(updater.timer)  # `call_every` takes its place
    return updater.force_update, updater.period


def _prepare_publisher(node: Node, name: str, fill: _Fill, hardware_id: str) -> tuple[Callable[[], None], float]:
    publisher = node.create_publisher(DiagnosticArray, '/diagnostics', 10)

    def publish() -> None:
        array = DiagnosticArray(status=[fill(DiagnosticStatus(name=f'{node.get_name()}: {name}', hardware_id=hardware_id))])
        array.header.stamp = node.get_clock().now().to_msg()
        publisher.publish(array)
    return publish, PERIOD
