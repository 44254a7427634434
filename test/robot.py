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
A small robot for tests: commands in, odometry and the samples of a gyro out.

`Robot` is pure: it computes, with a time that the caller steps. `RosRobot` joins it to topics, in
a thread. Both know nothing of the package that they test. All units are SI; angles are
counter-clockwise positive.

"""

from collections import deque
from dataclasses import dataclass
import math
import random
import threading
import time

try:
    from geometry_msgs.msg import Twist, TwistStamped
    from nav_msgs.msg import Odometry
    from rclpy.qos import QoSProfile
    from rosgraph_msgs.msg import Clock
    from sensor_msgs.msg import Imu
except ImportError:
    pass  # the fixture `ros` skips every test that needs them, and says why

INTERVAL = 0.01  # s between samples
STEADY = getattr(time, 'CLOCK_BOOTTIME', time.CLOCK_MONOTONIC)


@dataclass(frozen=True)
class Reading:
    """What the robot reports after a step."""

    stamp: float  # of sample and odometry, s
    output: float | None  # rate that the gyro reports, rad/s; None while it is unplugged
    heading: float  # by odometry, rad, not wrapped
    rate: float  # by odometry, rad/s


class Robot:
    """
    A base that follows commands late, and a gyro on it.

    Errors of the gyro are in 1 and rad/s; the noise is the standard deviation of a sample. A
    command acts after the latency, with the time constant `lag` of the drives, s; the base stops
    when it has heard none for the timeout, s. A test sets that the gyro is `unplugged`, that
    `stamps_stand`, or that the base is `deaf`: it goes on with what it did last. `distort` makes
    of the output what the gyro reports.

    """

    def __init__(self, *, scale_factor_error=0.0373, bias=0.01, noise=1e-3, latency=0.15, lag=0.2,
                 timeout=math.inf, stamp=1000.0, seed=0):
        self.time = self.heading = self.rate = 0.0
        self.unplugged = self.stamps_stand = self.deaf = False
        self.distort = lambda output: output
        self.scale_factor_error, self.bias, self.noise = scale_factor_error, bias, noise
        self._latency, self._lag, self._timeout = latency, lag, timeout
        self._stamp, self._random = stamp, random.Random(seed)
        self._steps, self._target, self._heard = 0, 0.0, -math.inf
        self._commands = deque()

    def command(self, rate):
        """Take a command to turn, rad/s, at the time of the last step; it acts after a latency."""
        if not self.deaf:
            self._heard = self.time
            self._commands.append((self.time + self._latency, rate))

    def step(self):
        """Go on by the interval of the samples, and return a `Reading`."""
        self._steps += 1
        self.time = self._steps * INTERVAL
        while self._commands and self._commands[0][0] <= self.time + 1e-9:
            self._target = self._commands.popleft()[1]
        if not self.deaf and self.time - self._heard > self._timeout + self._latency:
            self._target = 0.0
        # exact for a target that is constant over the step
        kept = math.exp(-INTERVAL / self._lag)
        self.heading += (self._target * INTERVAL
                         + (self.rate - self._target) * self._lag * (1 - kept))
        self.rate = self._target + (self.rate - self._target) * kept
        if not self.stamps_stand:
            self._stamp += INTERVAL
        output = ((1.0 + self.scale_factor_error) * self.rate + self.bias
                  + self._random.gauss(0.0, self.noise))
        return Reading(self._stamp, None if self.unplugged else self.distort(output), self.heading,
                       self.rate)


class RosRobot:
    """
    A `Robot` on topics: cmd_vel in; odom, imu/data_raw and, if it is simulated, /clock out.

    A thread steps it by the steady clock; the executor of the node is spun by the caller. `speed`
    is that of /clock, which stamps follow; None for stamps by the node's clock. `commands` are
    those that came, with their times, `headings` the true ones by the stamp, ns, and `moments` by
    the steady clock. A test sets `clock_absent` or `clock_stands`, with the stamps; `also` is
    called with each Imu message: a second driver.

    """

    def __init__(self, node, robot, *, speed=None, stamped=False):
        self.robot, self.node, self.also = robot, node, None
        self.clock_absent = self.clock_stands = False
        self.commands, self.headings, self.moments = [], {}, []
        self._speed, self._lock, self._last = speed, threading.Lock(), None
        quality = QoSProfile(depth=100)
        self._imu = node.create_publisher(Imu, 'imu/data_raw', quality)
        self._odometry = node.create_publisher(Odometry, 'odom', quality)
        self._clock = node.create_publisher(Clock, '/clock', 10) if speed else None
        self._heard = node.create_subscription(
            TwistStamped if stamped else Twist, 'cmd_vel', self._on_command, quality)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _on_command(self, message):
        rate = getattr(message, 'twist', message).angular.z
        with self._lock:
            self.commands.append((now(), rate))
            self.robot.command(rate)

    def _run(self):
        interval = INTERVAL / (self._speed or 1.0)
        due = now()
        while not self._stop.wait(max(0.0, due - now())):
            due = max(due + interval, now() - 0.5)  # a computer that slept does not hurry
            with self._lock:
                self._publish(self.robot.step())

    def _publish(self, reading):
        self.moments.append((now(), reading.heading))
        stamp = self._stamp(reading)
        self.headings[stamp] = reading.heading
        header = {'sec': stamp // 10 ** 9, 'nanosec': stamp % 10 ** 9}
        if self._clock and not (self.clock_absent or self.clock_stands):
            clock = Clock()
            clock.clock.sec, clock.clock.nanosec = header['sec'], header['nanosec']
            self._clock.publish(clock)
        odometry = Odometry()
        _set(odometry.header, header, 'odom')
        odometry.child_frame_id = 'base_link'
        odometry.pose.pose.orientation.z = math.sin(0.5 * reading.heading)
        odometry.pose.pose.orientation.w = math.cos(0.5 * reading.heading)
        odometry.twist.twist.angular.z = reading.rate
        self._odometry.publish(odometry)
        if reading.output is not None:
            imu = Imu()
            _set(imu.header, header, 'gyro')
            imu.angular_velocity.z = reading.output
            imu.orientation_covariance[0] = imu.linear_acceleration_covariance[0] = -1.0
            self._imu.publish(imu)
            if self.also:
                self.also(imu)

    def _stamp(self, reading):
        """Return the stamp in ns: of the simulation, or of the node's clock."""
        if not (self.clock_stands or self.robot.stamps_stand) or self._last is None:
            self._last = (round(reading.stamp * 1e9) if self._speed
                          else self.node.get_clock().now().nanoseconds)
        return self._last

    def turned_since(self, since):
        """Return the angle turned since a time of the steady clock, rad, in either direction."""
        after = [heading for time_, heading in self.moments if time_ >= since]
        return sum(abs(b - a) for a, b in zip(after, after[1:]))

    def close(self):
        self._stop.set()
        self._thread.join()


def _set(header, stamp, frame):
    header.stamp.sec, header.stamp.nanosec, header.frame_id = stamp['sec'], stamp['nanosec'], frame


def now():
    """Return the steady clock, s."""
    return time.clock_gettime(STEADY)
