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
A node that receives serialized messages from topics, for the verb record.

A subscription requests the offered QoS: best effort publishers are received, and reliable ones
lose nothing. Publishers may start late, stop, and start again with another QoS.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
import importlib
import os
import threading
import time

from gyro_calibration.driver.timestamps import read_date_offset, read_steady_clock
from gyro_calibration.logs.cdr import NSEC_PER_SEC
from gyro_calibration.logs.log import LogError
from gyro_calibration.logs.recording import topic_type_fault
from gyro_calibration.logs.ros_bag import Message
from gyro_calibration.ros.runner import call_every, publishers_on, SENSOR_QOS
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription


class RecorderNode(Node):
    """Subscribes to topics as they appear, and hands over each message."""

    def __init__(self, roles: Mapping[str, str], on_message: Callable[[str, Message], None],
                 context: rclpy.Context):
        """Subscribe to topics by their roles; `LogError` for a name or a type that is wrong."""
        super().__init__('gyro_calibration_recorder', context=context,
                         start_parameter_services=False, enable_rosout=False)
        self._roles = {}
        for topic, role in roles.items():
            try:
                self._roles[self.resolve_topic_name(topic)] = role
            except (RuntimeError, ValueError) as error:
                raise LogError(f'{topic}: no topic name ({_describe_error(error)}); '
                               'give another') from None
        self.message_count = 0
        self._on_message = on_message
        self._taken: dict[str, Subscription] = {}  # topics
        self.conflicts: dict[str, str] = {}  # of topics on which several nodes publish
        self._clock_offset = read_date_offset()
        self.poll()
        call_every(self, 0.3, self.poll)

    @property
    def missing_topics(self) -> list[str]:
        return [topic for topic in self._roles if topic not in self._taken]

    def poll(self) -> None:
        for topic, kinds in self.get_topic_names_and_types():
            if topic not in self._roles or not (
                    publishers := self.get_publishers_info_by_topic(topic)):
                continue
            if fault := topic_type_fault(self._roles[topic], topic, kinds[0]):
                raise LogError(fault)
            if len(publishers) > 1:
                self.conflicts[topic] = (
                    f'Several nodes published on {topic} ({", ".join(publishers_on(self, topic))})'
                    ', and a log cannot distinguish them: unless one had ended, give each a topic '
                    'of its own.')
            # compatible with all publishers; transient local only if all offer it
            offered = [each.qos_profile for each in publishers]
            is_reliable = not any(each.reliability == ReliabilityPolicy.BEST_EFFORT
                                  for each in offered)
            is_latched = all(each.durability == DurabilityPolicy.TRANSIENT_LOCAL
                             for each in offered)
            before = self._taken.get(topic)
            if before is not None:
                has = before.qos_profile
                if (is_reliable or has.reliability != ReliabilityPolicy.RELIABLE) and (
                        is_latched or has.durability != DurabilityPolicy.TRANSIENT_LOCAL):
                    continue  # it receives every publisher
                self.destroy_subscription(before)
            self._taken[topic] = self._subscribe(topic, kinds[0], QoSProfile(
                depth=SENSOR_QOS.depth,
                reliability=(ReliabilityPolicy.RELIABLE if is_reliable
                             else ReliabilityPolicy.BEST_EFFORT),
                durability=(DurabilityPolicy.TRANSIENT_LOCAL if is_latched
                            else DurabilityPolicy.VOLATILE)))

    def _subscribe(self, topic: str, kind: str, quality: QoSProfile) -> Subscription:
        def take(data: bytes) -> None:
            self.message_count += 1  # the steady clock does not jump
            received = self._clock_offset + round(read_steady_clock() * NSEC_PER_SEC)
            self._on_message(self._roles[topic], Message(topic, kind, received, bytes(data)))
        # of a type that `topic_type_fault` has accepted: other nodes choose no module
        package, _, name = kind.split('/')
        message_class = getattr(importlib.import_module(f'{package}.msg'), name)
        return self.create_subscription(message_class, topic, take, quality, raw=True)


def _describe_error(error: Exception) -> str:
    """Return the text of an error of rclpy, without the place in its source."""
    return str(error).partition(', at /')[0]


def take_messages(roles: Mapping[str, str], on_message: Callable[[str, Message], None],
                  tick: Callable[[RecorderNode], None], stop: threading.Event) -> None:
    """
    Receive the messages of topics, each with a role of `topic_type_fault`, until an event is set.

    `tick` is called at least every 50 ms. Raise `LogError` where a topic has an invalid name or
    another type than its role wants, or ROS 2 cannot be started.
    """
    context = rclpy.Context()
    domain = os.environ.get('ROS_DOMAIN_ID', '')
    if domain.isdecimal() and int(domain) > 232:  # ports beyond 65535: Fast DDS ends the process
        raise LogError(f'ROS_DOMAIN_ID is {domain}, but must be from 0 to 232')
    try:
        rclpy.init(args=[], context=context, signal_handler_options=SignalHandlerOptions.NO)
    except (RuntimeError, ValueError) as error:
        raise LogError(f'ROS 2 cannot be started ({_describe_error(error)}); '
                       'check its environment variables') from None
    executor = SingleThreadedExecutor(context=context)
    try:
        node = RecorderNode(roles, on_message, context)
        executor.add_node(node)
        try:
            while not stop.is_set():
                executor.spin_once(timeout_sec=0.05)
                tick(node)
            # the messages that were in the queues; a call may also serve a timer
            deadline, idle = time.monotonic() + 10.0, 0
            while idle < 3 and time.monotonic() < deadline:
                before = node.message_count
                executor.spin_once(timeout_sec=0.0)
                idle = 0 if node.message_count > before else idle + 1
        finally:
            executor.remove_node(node)
            node.destroy_node()
    finally:
        executor.shutdown()
        rclpy.shutdown(context=context)
