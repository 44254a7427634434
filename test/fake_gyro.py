# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""A gyro for tests of the compensation node: publishes samples with stamps of its own clock."""

from itertools import repeat
import math
import time

import numpy as np

try:
    from builtin_interfaces.msg import Time
    from diagnostic_msgs.msg import DiagnosticArray
    from geometry_msgs.msg import PoseWithCovarianceStamped, TwistWithCovarianceStamped
    from sensor_msgs.msg import Imu, Temperature
    from std_srvs.srv import Trigger
except ImportError:
    pass  # the fixture `ros` skips every test that needs them, and says why

INTERVAL = 0.01
BEGIN = 1_700_000_000_000_000_000  # ns
PACE = 0.0015  # s between messages: stamps run 7 times faster than the clock


class FakeGyro:
    """Publishes raw rates, and collects what the node makes of them."""

    def __init__(self, ros, wait_until, namespace='/compensation_node'):
        self.ros, self.wait_until, self.name = ros, wait_until, namespace
        self.nanoseconds, self.interval, self.frame = BEGIN, INTERVAL, 'gyro'
        self._imu = ros.publisher(Imu, 'imu/data_raw', 1000)
        self._temperature = ros.publisher(Temperature, 'imu/temperature', 1000)
        self.imu = ros.collect(Imu, 'imu/data')
        self.heading = ros.collect(PoseWithCovarianceStamped, 'heading')
        self.rate = ros.collect(TwistWithCovarianceStamped, 'yaw_rate')
        self.diagnostics = ros.collect(DiagnosticArray, '/diagnostics', 10)
        self.status = ros.collect(DiagnosticArray, f'{namespace}/calibration_status', _latched())
        self.meet()

    def meet(self):
        """
        Rest until a node that was just started receives everything; begin at heading zero.

        A node that is started anew needs no second gyro: two publishers would be an error.

        """
        for collected in (self.imu, self.heading, self.rate, self.status):
            collected.clear()

        def all_heard():
            self.send(0.0)
            return (self.imu and self.heading and self.rate and self.status
                    and self._temperature.get_subscription_count())
        self.wait_until(all_heard, 60.0, 'the node')
        self.frame = 'last'
        self.send(0.0)
        self.wait_until(lambda: self.imu[-1].header.frame_id == 'last', what='the last')
        self.frame = 'gyro'
        assert self.call('reset_heading').success
        for collected in (self.imu, self.heading, self.rate, self.diagnostics):
            collected.clear()

    def stamp(self):
        """Return the gyro's time as a stamp."""
        return Time(sec=self.nanoseconds // 10 ** 9, nanosec=self.nanoseconds % 10 ** 9)

    def send(self, rate, temperature=None, change=lambda message: None):
        """Publish one sample and let the gyro's time go on."""
        message = Imu()
        message.header.stamp, message.header.frame_id = self.stamp(), self.frame
        message.angular_velocity.z = float(rate)
        change(message)
        if temperature is not None:
            self._temperature.publish(
                Temperature(header=message.header, temperature=float(temperature)))
        self._imu.publish(message)
        self.wait(self.interval)

    def wait(self, seconds):
        """Let the gyro's time go on without a sample."""
        self.nanoseconds += round(seconds * 1e9)

    def play(self, rates, temperature=None, until=lambda: False):
        """Publish many samples, and return when the node has taken the last one."""
        received, sent = len(self.imu), 0
        for rate, degc in zip(rates, repeat(temperature)):
            self.send(rate, degc)
            sent += 1
            time.sleep(PACE)
            if sent % 100 == 0:  # a machine that is busy elsewhere must not overrun the queues
                self.wait_until(lambda: len(self.imu) >= received + sent - 300,  # noqa: B023
                                what='the node to keep up')
            if until():
                break
        self.wait_until(lambda: len(self.imu) >= received + sent, what=f'{sent} samples')

    def yaws(self):
        """Return the headings of imu/data, not wrapped, rad."""
        return np.unwrap([2.0 * math.atan2(each.orientation.z, each.orientation.w)
                          for each in list(self.imu)])

    def values(self):
        """Return the values of the newest diagnostics."""
        return {pair.key: pair.value for pair in self.diagnostics[-1].status[0].values}

    def says(self, words):
        """Tell whether the diagnostics since they were cleared hold the words."""
        return any(words in status.message for array in self.diagnostics
                   for status in array.status)

    def call(self, name):
        """Call a service of the node and return its response."""
        return self.ros.call(Trigger, f'{self.name}/{name}')

    def call_later(self, name):
        """Call a service without waiting for its answer."""
        client = self.ros.node.create_client(Trigger, f'{self.name}/{name}')
        assert client.wait_for_service(30.0)
        return client.call_async(Trigger.Request())

    def calibrating(self):
        """Tell whether the node reports that a calibration is in progress."""
        return bool(self.status) and self.status[-1].status[0].message.startswith('calibrating')


def _latched():
    from gyro_calibration.ros.runner import LATCHED_QOS
    return LATCHED_QOS
