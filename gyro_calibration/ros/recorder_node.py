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

Types come from the graph, so that any message whose package is installed can be recorded. A
subscription requests the offered QoS: best effort publishers are received, and reliable ones lose
nothing. Publishers may start late, stop, and start again with another QoS.

"""

from __future__ import annotations

from collections.abc import Callable, Sequence
import importlib
import os
import re
import threading
import time
from typing import Any

from gyro_calibration.driver.timestamps import read_steady_clock
from gyro_calibration.logs.cdr import DEFINITION_SEPARATOR, NSEC_PER_SEC
from gyro_calibration.logs.log import LogError
from gyro_calibration.logs.ros_bag import Message
from gyro_calibration.ros.runner import call_every, SENSOR_QOS
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription

_TYPE_ALIASES = {'double': 'float64', 'float': 'float32', 'boolean': 'bool', 'octet': 'byte'}


class RecorderNode(Node):
    """Subscribes to topics as they appear, and hands over each message with its definition."""

    def __init__(self, topics: Sequence[str], all_topics: bool,
                 on_message: Callable[[Message, str], None], context: rclpy.Context):
        super().__init__('gyro_calibration_recorder', context=context,
                         start_parameter_services=False, enable_rosout=False)
        try:
            self.topics = [self.resolve_topic_name(topic) for topic in topics]
        except (RuntimeError, ValueError) as error:
            raise LogError(f'{", ".join(topics)}: no topic name ({_describe_error(error)}); '
                           'give another') from None
        self.unknown_topics: dict[str, str] = {}  # with a type that is not installed: the reason
        self.message_count = 0
        self._all_topics, self._on_message = all_topics, on_message
        self._taken: dict[str, Subscription | None] = {}  # topics; None for an unknown type
        self._clock_offset = time.time_ns() - round(read_steady_clock() * NSEC_PER_SEC)
        self.poll()
        call_every(self, 0.3, self.poll)

    @property
    def missing_topics(self) -> list[str]:
        """Return the requested topics without a publisher so far."""
        return [topic for topic in self.topics if topic not in self._taken]

    def poll(self) -> None:
        """Subscribe to new topics in the graph."""
        for topic, kinds in self.get_topic_names_and_types():
            if ((topic in self.topics or self._all_topics)
                    and topic not in self.unknown_topics
                    and (publishers := self.get_publishers_info_by_topic(topic))):
                quality = _compatible_quality([each.qos_profile for each in publishers])
                before = self._taken.get(topic)
                if before is None or _wants_more(before.qos_profile, quality):
                    if before is not None:
                        self.destroy_subscription(before)
                    self._taken[topic] = self._subscribe(topic, kinds[0], quality)

    def _subscribe(self, topic: str, kind: str, quality: QoSProfile) -> Subscription | None:
        try:
            definition = _build_definition(kind)
        except (ImportError, AttributeError) as error:
            self.unknown_topics[topic] = f'{kind} is not installed here ({error})'
            return None

        # By the steady clock, so that times of receipt do not jump when the clock is set.
        def take(data: bytes) -> None:
            self.message_count += 1
            self._on_message(Message(topic, kind, self._clock_offset
                                     + round(read_steady_clock() * NSEC_PER_SEC), bytes(data)),
                             definition)
        return self.create_subscription(load_message_class(kind), topic, take, quality, raw=True)


def _compatible_quality(offered: Sequence[QoSProfile]) -> QoSProfile:
    """Return a QoS compatible with all publishers; transient local only if all offer it."""
    best_effort = any(each.reliability == ReliabilityPolicy.BEST_EFFORT for each in offered)
    latched = all(each.durability == DurabilityPolicy.TRANSIENT_LOCAL for each in offered)
    return QoSProfile(
        depth=SENSOR_QOS.depth,
        reliability=ReliabilityPolicy.BEST_EFFORT if best_effort else ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE)


def _wants_more(requested: QoSProfile, offered: QoSProfile) -> bool:
    """Tell whether a subscription does not receive a publisher with this offer."""
    return (requested.reliability == ReliabilityPolicy.RELIABLE != offered.reliability
            or requested.durability == DurabilityPolicy.TRANSIENT_LOCAL != offered.durability)


def _describe_error(error: Exception) -> str:
    """Return the text of an error of rclpy, without the place in its source."""
    return str(error).partition(', at /')[0]


def load_message_class(kind: str) -> Any:
    """Return the class of a message type such as ``sensor_msgs/msg/Imu``."""
    # other nodes name the types, so only modules of the form ``package.msg`` are imported
    if not re.fullmatch(r'\w+/msg/\w+', kind):
        raise ImportError(f'{kind} is no kind of messages')
    package, _, name = kind.split('/')
    return getattr(importlib.import_module(f'{package}.msg'), name)


def _build_definition(kind: str) -> str:
    """Return the definition of a type with its nested types, in the format of ROS 2."""
    kinds, parts = [kind], []
    for each in kinds:
        fields = load_message_class(each).get_fields_and_field_types()
        head = ('' if each == kind
                else f'{DEFINITION_SEPARATOR}\nMSG: {each.replace("/msg/", "/")}\n')
        parts.append(head + ''.join(f'{_format_field_type(text)} {name}\n'
                                    for name, text in fields.items()))
        inner = [re.sub(r'^sequence<|[,>\[].*$', '', text).replace('/', '/msg/')
                 for text in fields.values()]
        kinds += [found for found in dict.fromkeys(inner) if '/' in found and found not in kinds]
    return ''.join(parts)


def _format_field_type(text: str) -> str:
    """Return the type of a field in a definition: ``float64[<=3]`` for ``sequence<double, 3>``."""
    if text.startswith('sequence<'):
        inner, _, most = text.removeprefix('sequence<').removesuffix('>').partition(', ')
        return f'{_format_field_type(inner)}[{f"<={most}" if most else ""}]'
    word, bracket, length = text.partition('[')
    word = re.sub(r'<(\d+)>', r'<=\1', word)
    return _TYPE_ALIASES.get(word, word) + bracket + length


def take_messages(topics: Sequence[str], all_topics: bool,
                  on_message: Callable[[Message, str], None], tick: Callable[[RecorderNode], None],
                  stop: threading.Event) -> None:
    """
    Receive the messages of these topics, or of all, until an event is set.

    `on_message` is called with each message and its definition, and `tick` at least every 50 ms
    with the node. Raise `LogError` where a topic name is not valid, or ROS 2 cannot be started, as
    with an invalid ROS_DOMAIN_ID.

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
        node = RecorderNode(topics, all_topics, on_message, context)
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
