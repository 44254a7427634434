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
A node in the process of a test, which nobody spins: the test calls what an executor would call.

Messages go in and out without DDS, in milliseconds. That an executor really calls it, and that
processes hear each other, is for the tests with `start_node`.

"""

from collections import defaultdict
import copy

import rclpy
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.signals import SignalHandlerOptions

SUBSCRIBERS = 2  # of each topic of the node, which are not really there


class HeldNode:
    """
    A node, and what it published.

    Parameters
    ----------
    node_class : subclass of rclpy.node.Node, made without arguments
    monkeypatch : pytest.MonkeyPatch
    parameters, remappings : dict, as on the command line

    Attributes
    ----------
    node : Node
    sent : dict of topic -> list of messages

    """

    def __init__(self, node_class, monkeypatch, parameters, remappings):
        self.sent = defaultdict(list)
        monkeypatch.setattr(Publisher, 'publish', lambda *sent: self._keep(*sent))
        monkeypatch.setattr(Publisher, 'get_subscription_count', lambda _: SUBSCRIBERS)
        words = [word for name, value in parameters.items() for word in ('-p', f'{name}:={value}')]
        words += [word for old, new in remappings.items() for word in ('-r', f'{old}:={new}')]
        rclpy.init(args=['node', '--ros-args', *words] if words else [],
                   signal_handler_options=SignalHandlerOptions.NO)
        try:
            self.node = node_class()
        except BaseException:
            rclpy.shutdown()
            raise

    def _keep(self, publisher, message):
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
        return self.node.set_parameters([Parameter(name, value=value)])[0]

    def close(self):
        self.node.destroy_node()
        rclpy.shutdown()
