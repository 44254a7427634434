# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""
Start and end of nodes, and what all of them declare and publish.

Signals set an event, the loop of `spin_once` ends, `destroy_node` joins threads. The handlers of
rclpy invalidate the context while a callback still publishes, which ends some runs in a traceback.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from difflib import get_close_matches
import faulthandler
import signal
import sys
import threading
from types import SimpleNamespace

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from gyro_calibration.ros.inputs import NodeParameter, parameter_values
from gyro_calibration.ros.start import handle_end_signals
from rcl_interfaces.msg import (
    FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult)
import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import ParameterException
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node, PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription
from rclpy.timer import Timer

#: Of subscriptions to samples: compatible with every publisher (REP-2003), for 5 s at 1 kHz.
SENSOR_QOS = QoSProfile(depth=5000, reliability=ReliabilityPolicy.BEST_EFFORT,
                        durability=DurabilityPolicy.VOLATILE)
#: Of published samples: reliable, compatible with every subscriber (REP-2003).
PUBLISHED_QOS = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE,
                           durability=DurabilityPolicy.VOLATILE)
#: Of a state: the last message is kept for late subscribers.
LATCHED_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE,
                         durability=DurabilityPolicy.TRANSIENT_LOCAL)
SHUTDOWN_TIMEOUT = 10.0  # s; then a node is killed

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
Report = tuple[bytes, str, Mapping[str, object]]  # level, sentence and values by name


def publish_on(node: Node, kind: type, topic: str, qos: QoSProfile = PUBLISHED_QOS) -> Publisher:
    """Return a publisher whose quality of service parameters may override."""
    # every QoS here is compatible; to check it at each wake-up costs 2 % of a core at 1 kHz
    return node.create_publisher(
        kind, topic, qos, event_callbacks=PublisherEventCallbacks(use_default_callbacks=False),
        qos_overriding_options=QoSOverridingOptions.with_default_policies())


def subscribe_to(node: Node, kind: type, topic: str,
                 callback: Callable[..., None]) -> Subscription:
    """Return a subscription whose quality of service parameters may override."""
    return node.create_subscription(
        kind, topic, callback, SENSOR_QOS,
        event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
        qos_overriding_options=QoSOverridingOptions.with_default_policies())


def publishers_on(node: Node, topic: str) -> list[str]:
    """Return the full names of the nodes that publish on a topic, sorted."""
    return sorted(f'{each.node_namespace.rstrip("/")}/{each.node_name}'
                  for each in node.get_publishers_info_by_topic(topic))


def declare_parameters(
        node: Node, table: Sequence[NodeParameter],
        on_change: Callable[[SimpleNamespace], None] | None = None) -> SimpleNamespace:
    """
    Declare a table of parameters, and return their values as one record.

    `on_change` is called with the new record after a change. `ValueError` names a wrong override.
    """
    known = {each.name: each for each in table}

    def read_values(given: Sequence[rclpy.Parameter] = ()) -> SimpleNamespace:
        values = {name: node.get_parameter(name).value for name in known}
        values.update({each.name: each.value for each in given if each.name in known})
        return parameter_values(table, values)

    def check(given: Sequence[rclpy.Parameter]) -> SetParametersResult:
        try:
            values = read_values(given)
        except ValueError as error:
            return SetParametersResult(successful=False, reason=str(error))
        if not after and on_change:
            on_change(values)
        return SetParametersResult(successful=True)

    def use(given: Sequence[rclpy.Parameter]) -> None:
        if on_change and any(each.name in known for each in given):
            on_change(read_values())

    overrides = node._parameter_overrides
    for each in table:
        # not by rclpy, which refuses 100 for 100.0, with a message of several sentences
        default = (each.default if isinstance(each.default, (bool, int, float, str))
                   else list(each.default))
        given = overrides[each.name].value if each.name in overrides else default
        descriptor = ParameterDescriptor(
            description=each.description + (f' Unit: {each.unit}.' if each.unit else ''),
            read_only=not each.dynamic, additional_constraints=each.choices_text,
            dynamic_typing=isinstance(each.default, float))  # a whole number is allowed
        if each.range and isinstance(each.default, float):
            low, high = map(float, each.range)
            descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
        elif each.range:
            least, most = map(int, each.range)
            descriptor.integer_range = [IntegerRange(from_value=least, to_value=most)]
        node.declare_parameter(each.name, each.check(given), descriptor, ignore_override=True)
    after = hasattr(node, 'add_post_set_parameters_callback')  # not in Humble
    node.add_on_set_parameters_callback(check)
    if after:
        node.add_post_set_parameters_callback(use)
    return read_values()


def call_every(node: Node, period: float, callback: Callable[[], None]) -> Timer:
    """Create a timer with a period, s, of the steady clock."""
    # timers of the node's clock stop when it is set back, and while a simulation is paused
    return node.create_timer(period, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))


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
        """Create the publisher; `report` is never called concurrently, nor may call `publish`."""
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


def run_node(node_class: Callable[[], Node]) -> int:
    """
    Spin a node until SIGINT, SIGQUIT, SIGTERM or SIGHUP; return the exit code of the process.

    It is 0 after a signal, and 2, with a sentence on standard error, where the node refused a
    value.
    """
    stop = threading.Event()
    handle_end_signals(lambda *_: stop.set())
    try:
        try:
            rclpy.init(args=sys.argv, signal_handler_options=SignalHandlerOptions.NO)
            node = node_class()
        # rclpy raises RuntimeError for an argument, ParameterException for a parameter of its own
        except (ValueError, OSError, RuntimeError, ParameterException) as error:
            print(f'{node_class.__name__}: {error}', file=sys.stderr)
            return 2
        # not refused, since a file may give a parameter to all nodes
        for name in node._parameter_overrides:
            if not node.has_parameter(name):
                alike = get_close_matches(name, node._parameters, 1)
                node.get_logger().warning(
                    f'there is no parameter {name}, and its value is not used'
                    f'{"".join(f": is {each} meant?" for each in alike)}')
        spin(node, stop)
        return 0
    finally:
        rclpy.try_shutdown()
        # A launch file sends SIGINT twice; the second would kill the interpreter at its exit.
        handle_end_signals(signal.SIG_IGN)


def spin(node: Node, stop: threading.Event) -> None:
    """
    Serve the callbacks of a node until an event is set, then close it.

    Ctrl-Z stops the process after `node.stop_robot` between two callbacks, where a node has that.
    """
    serving: Executor
    try:
        # it takes half of the processor time; before rclpy 7.1.11 it has no ``async`` callbacks
        from rclpy.experimental import EventsExecutor
        serving = EventsExecutor()
    except ImportError:  # Humble
        serving = SingleThreadedExecutor()
    serving.add_node(node)
    try:
        # the timers of a node end the wait of SingleThreadedExecutor, not that of EventsExecutor
        timeout = None if isinstance(serving, SingleThreadedExecutor) else 0.2
        pause, stop_robot = threading.Event(), getattr(node, 'stop_robot', None)
        if stop_robot and signal.getsignal(signal.SIGTSTP) != signal.SIG_IGN:
            signal.signal(signal.SIGTSTP, lambda *_: pause.set())
        while not stop.is_set():
            serving.spin_once(timeout_sec=timeout)
            if stop_robot and pause.is_set():
                stop_robot('this node was stopped by Ctrl-Z: continue it, and run again')
                handler = signal.signal(signal.SIGTSTP, signal.SIG_DFL)
                signal.raise_signal(signal.SIGTSTP)
                pause.clear()
                signal.signal(signal.SIGTSTP, handler)
    except ExternalShutdownException:
        pass  # rclpy was shut down elsewhere
    finally:
        serving.shutdown()
        # Fast DDS 2.14 can deadlock, with the GIL held, when two nodes end at the same time
        faulthandler.dump_traceback_later(SHUTDOWN_TIMEOUT, exit=True)
        node.destroy_node()
        faulthandler.cancel_dump_traceback_later()
