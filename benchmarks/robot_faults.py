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
What misleads a robot that is calibrated: faults on the real stack, one row each.

    python benchmarks/robot_faults.py [--only WORD]

A compensation node in a process of its own drives a small robot (``test/rig.py``: 150 ms
latency, 0.2 s lag, 100 Hz) through `calibrate`. In mid-run, at 40 deg/s or more, the fault
happens. A row states the turn of the robot since, the time until the last command to turn was
followed by a zero, the error of the heading and its stated standard deviation, the worst
diagnostics since the fault and the answer of the service. All faults take 6 min; nothing leaves
the machine.
"""

import argparse
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
import math
from pathlib import Path
import random
import subprocess
import sys
import threading
import time

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'test'))

from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from geometry_msgs.msg import TwistStamped  # noqa: E402
from nav_msgs.msg import Odometry  # noqa: E402
from processes import apart, end, node_command  # noqa: E402
import rclpy  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from rclpy.qos import qos_profile_sensor_data, QoSProfile  # noqa: E402
from rclpy.signals import SignalHandlerOptions  # noqa: E402
from rig import INTERVAL, Robot  # noqa: E402
from rosgraph_msgs.msg import Clock  # noqa: E402
from sensor_msgs.msg import Imu  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

STEADY = getattr(time, 'CLOCK_BOOTTIME', time.CLOCK_MONOTONIC)
MODEL = 'effects: {bias: {bias: 0.0}}\nnoise: {angle_random_walk: 1.0e-4}\n'
FULL_RATE = math.radians(40.0)
TELEOP = 0.3  # rad/s
WATCHED = 10.0  # s after a fault
SPINNING = 'import time\nend = time.monotonic() + 45\nwhile time.monotonic() < end: pass'
LEVELS = ('OK', 'WARN', 'ERROR', 'STALE')


@dataclass
class Row:
    """What one fault did; angles in deg, times in s."""

    fault: str
    turned: float = math.nan
    zero: float = math.nan
    error: float = math.nan
    deviation: float = math.nan
    level: str = ''
    message: str = ''
    answer: str = ''
    still: bool = field(default=False)

    def cells(self):
        turned = f'{self.turned:.0f}{" and still turning" if self.still else ""}'
        zero = ('never' if self.zero == math.inf else '-' if math.isnan(self.zero)
                else f'{self.zero:.2f}')
        heading = f'{self.error:+.1f} +- {self.deviation:.1f}'
        return [self.fault, turned, zero, heading, f'{self.level}: {_short(self.message)}',
                _short(self.answer)]


HEADER = ['fault', 'turned after it, deg', 'zero commanded after, s',
          'heading error +- claimed, deg', 'diagnostics', 'answer']


def _short(text, most=150):
    return ' '.join(text.split())[:most].replace('|', '/')


def now():
    """Return the steady clock, s."""
    return time.clock_gettime(STEADY)


class RosRobot:
    """
    A `Robot` on topics: cmd_vel in; odom, imu/data_raw and, if it is simulated, /clock out.

    A thread steps it by the steady clock; the executor of the node is spun by the caller. `speed`
    is that of /clock, which stamps follow; None for stamps by the node's clock. `commands` are
    those that came, with their times, `headings` the true ones by the stamp, ns, and `moments` by
    the steady clock. A fault sets that `clock_stands`, with the stamps; `also` is called with each
    Imu message: a second driver.
    """

    def __init__(self, node, robot, speed=None):
        self.robot, self.node, self.also = robot, node, None
        self.clock_stands = False
        self.commands, self.headings, self.moments = [], {}, []
        self._speed, self._lock, self._last = speed, threading.Lock(), None
        quality = QoSProfile(depth=100)
        self._imu = node.create_publisher(Imu, 'imu/data_raw', quality)
        self._odometry = node.create_publisher(Odometry, 'odom', quality)
        self._clock = node.create_publisher(Clock, '/clock', 10) if speed else None
        node.create_subscription(TwistStamped, 'cmd_vel', self._on_command, quality)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _on_command(self, message):
        rate = message.twist.angular.z
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
        if self._clock and not self.clock_stands:
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


class SecondCommander:
    """Somebody else on cmd_vel at 20 Hz, who commands a rate, rad/s; None for nothing."""

    def __init__(self, node):
        self.rate, self._publisher = None, node.create_publisher(TwistStamped, 'cmd_vel', 10)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self):
        while not self._stop.wait(0.05):
            if self.rate is not None:
                message = TwistStamped()
                message.twist.angular.z = self.rate
                self._publisher.publish(message)

    def close(self):
        self._stop.set()
        self._thread.join()


class Stage:
    """A robot, a node under test, and everything that is heard of both."""

    def __init__(self, folder, closing):
        self._folder, self.closing = folder, closing
        context = rclpy.Context()
        rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
        self.node = rclpy.create_node('robot', context=context)
        closing.callback(context.try_shutdown)
        closing.callback(self.node.destroy_node)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(self.node)
        stop = threading.Event()

        def spin():
            while not stop.is_set():
                executor.spin_once(timeout_sec=0.05)
        thread = threading.Thread(target=spin)
        thread.start()
        closing.callback(thread.join)
        closing.callback(stop.set)
        self._heard, self._reports, self._answer, self._began = [], [], None, math.inf
        self.node.create_subscription(Imu, 'imu/data', self._on_imu, qos_profile_sensor_data)
        self.node.create_subscription(DiagnosticArray, '/diagnostics', self._on_report, 10)

    def _on_imu(self, message):
        stamp = message.header.stamp.sec * 10 ** 9 + message.header.stamp.nanosec
        yaw = 2.0 * math.atan2(message.orientation.z, message.orientation.w)
        self._heard.append((now(), stamp, yaw, message.orientation_covariance[8]))

    def _on_report(self, message):
        for status in message.status:
            if status.name.endswith(': heading'):
                self._reports.append((now(), int.from_bytes(status.level, 'little'),
                                      status.message))

    def start(self, *, parameters=None, speed=None, **robot):
        """Start robot and node, and wait until the robot has rested for a while."""
        self.robot = RosRobot(self.node, Robot(**robot), speed)
        self.closing.callback(self.robot.close)
        self.other = SecondCommander(self.node)
        self.closing.callback(self.other.close)
        (self._folder / 'model.yaml').write_text(MODEL)
        given = {'model_file': self._folder / 'model.yaml',
                 'calibration_file': self._folder / 'calibration.yaml',
                 'calibration.drive': True, 'cmd_vel_stamped': True, **(parameters or {})}
        with open(self._folder / 'node.txt', 'wb') as log:
            self.process = subprocess.Popen(node_command('compensation_node', given), stdout=log,
                                            stderr=log, start_new_session=True)
        self.closing.callback(end, self.process)
        self.wait(lambda: len(self._heard) > 200, 30.0, 'imu/data')

    def wait(self, condition, timeout, what):
        """Wait for something; say what did not happen."""
        limit = now() + timeout
        while not condition():
            if now() > limit:
                raise TimeoutError(f'not within {timeout:g} s: {what}; '
                                   f'{(self._folder / "node.txt").read_text()[-400:]}')
            time.sleep(0.005)

    def call(self, name):
        """Call a service, and return the future of its answer."""
        client = self.node.create_client(Trigger, f'/compensation_node/{name}')
        if not client.wait_for_service(20.0):
            raise TimeoutError(f'no service {name}')
        return client.call_async(Trigger.Request())

    def calibrate(self):
        """Call calibrate, and return when the robot turns at full rate, or the answer has come."""
        self._answer = self.call('calibrate')
        self.wait(lambda: abs(self.robot.robot.rate) > FULL_RATE or self._answer.done(), 20.0,
                  'full rate')

    def fault(self):
        """Let the row begin here."""
        self._began = now()

    def watch(self, seconds=WATCHED, until_answer=False):
        """Look on, until the end of the run if that is wanted."""
        limit = now() + seconds
        while now() < limit and not (until_answer and self._answer.done()
                                     and abs(self.robot.robot.rate) < 0.01):
            time.sleep(0.02)

    def row(self, name, others=()):
        """Return what happened since the fault; `others` are rates commanded by others."""
        row, began = Row(name), self._began
        row.turned = math.degrees(self.robot.turned_since(began))
        row.still = abs(self.robot.robot.rate) > 0.01
        commands = [(when, rate) for when, rate in self.robot.commands if when >= began
                    and rate not in others]
        driving = [when for when, rate in commands if rate]
        zeros = [when for when, rate in commands if not rate
                 and when > max(driving, default=began)]
        row.zero = zeros[0] - began if zeros else math.inf if driving else math.nan
        row.error, row.deviation = self._heading()
        reports = [(level, message) for when, level, message in self._reports if when >= began]
        if reports:
            worst = max(level for level, _ in reports)
            row.level, row.message = LEVELS[worst], [message for level, message in reports
                                                     if level == worst][-1]
        if self._answer:
            row.answer = 'none' if not self._answer.done() else self._answer.result().message
        return row

    def _heading(self):
        """Return the error of the node's heading since the start, and its stated sigma, deg."""
        heard, truth = list(self._heard), dict(self.robot.headings)
        error, claimed, turned, last, begin = math.nan, math.nan, 0.0, None, None
        for _, stamp, yaw, variance in heard:
            turned += math.remainder(yaw - last, math.tau) if last is not None else 0.0
            last = yaw
            if stamp in truth and variance < 1e5:  # else it is not known yet
                begin = begin or (turned, truth[stamp], variance)
                error, claimed = turned - begin[0] - truth[stamp] + begin[1], variance - begin[2]
        return math.degrees(error), math.degrees(math.sqrt(max(claimed, 0.0)))


@dataclass(frozen=True)
class Fault:
    """What happens to a robot and its node; without an `act` the run must work."""

    words: str  # of its row
    act: Callable | None = None  # in mid-run, at full rate
    how: dict = field(default_factory=dict)  # arguments of `Stage.start`
    before: Callable = lambda stage: None  # the run
    seconds: float = WATCHED
    until_answer: bool = False  # watch no longer than until the run has ended
    others: tuple = ()  # rates that others command

    def row(self, stage):
        """Let it happen, and return what came of it."""
        stage.start(**self.how)
        self.before(stage)
        if self.act is None:
            stage.fault()
        stage.calibrate()
        if self.act:
            stage.fault()
            self.act(stage)
        stage.watch(self.seconds, self.until_answer)
        return stage.row(self.words, self.others)


@dataclass(frozen=True)
class SecondGyro:
    """Another publisher on imu/data_raw, whose messages are changed ones of the robot's."""

    words: str
    late: float
    output: float | None = None

    def row(self, stage):
        """Turn the robot by 390 deg, and return what came of it."""
        stage.start()
        publisher = stage.node.create_publisher(Imu, 'imu/data_raw', 100)

        def also(message):
            stamp = message.header.stamp
            stamp.sec, stamp.nanosec = divmod(
                stamp.sec * 10 ** 9 + stamp.nanosec + round(1e9 * self.late), 10 ** 9)
            if self.output is not None:
                message.angular_velocity.z = self.output * random.random()
            publisher.publish(message)
        stage.robot.also = also
        stage.fault()
        stage.robot.robot.command(math.radians(45.0))
        stage.wait(lambda: stage.robot.robot.heading > math.radians(390.0), 20.0, 'the turns')
        stage.robot.robot.command(0.0)
        stage.watch(2.0)
        return stage.row(self.words)


def robot_is(**what):
    """Return what sets attributes of the simulated robot, or of its node."""
    def act(stage):
        for name, value in what.items():
            setattr(stage.robot if name == 'clock_stands' else stage.robot.robot, name, value)
    return act


def other_sends(rate):
    """Return what lets another node send a command at 20 Hz."""
    return lambda stage: setattr(stage.other, 'rate', rate)


def teleop(stage):
    stage.other.rate = TELEOP
    stage.wait(lambda: stage.robot.robot.rate > 0.9 * TELEOP, 10.0, 'teleop')


def ignore_the_stop(stage):
    """Let the base go on after a cancel."""
    stage.robot.robot.deaf = True
    stage.call('cancel_calibration')


def spin(stage):
    """Let two processes spin on this computer."""
    for _ in range(2):
        stage.closing.callback(end, subprocess.Popen([sys.executable, '-c', SPINNING]))


SIMULATED = {'parameters': {'use_sim_time': True}}
FAULTS = {
    'clock_absent': Fault('sim time without /clock; unplugged in mid-run',
                          robot_is(unplugged=True), SIMULATED),
    'clock_paused': Fault('/clock and stamps stand in mid-run', robot_is(clock_stands=True),
                          {**SIMULATED, 'speed': 1.0}),
    'clock_paused_unplugged': Fault(
        '/clock stands and the gyro is unplugged in mid-run',
        robot_is(clock_stands=True, unplugged=True), {**SIMULATED, 'speed': 1.0}),
    'clock_fast': Fault('/clock at 4x (must work)', how={**SIMULATED, 'speed': 4.0}, seconds=30.0,
                        until_answer=True),
    'stamps_stand': Fault('stamps stand in mid-run', robot_is(stamps_stand=True)),
    'unplugged': Fault('gyro unplugged in mid-run', robot_is(unplugged=True)),
    'soft_stop': Fault('soft stop (zeros at 20 Hz) in mid-run', other_sends(0.0), seconds=25.0,
                       until_answer=True),
    'teleop': Fault('teleop (0.3 rad/s at 20 Hz) in mid-run', other_sends(TELEOP), seconds=5.0,
                    others=(TELEOP,)),
    'begun_in_teleop': Fault('run begun while teleop turns', before=teleop, seconds=5.0,
                             others=(TELEOP,)),
    'second_gyro': SecondGyro('second publisher: a gyro at rest', 0.005, 0.0001),
    'second_driver': SecondGyro('second publisher: stamps 0.3 s older', -0.3),
    'killed': Fault('node killed in mid-run, base without time-out (5 s)',
                    lambda stage: stage.process.kill(), seconds=5.0),
    'killed_with_timeout': Fault('node killed in mid-run, base time-out 0.5 s',
                                 lambda stage: stage.process.kill(), {'timeout': 0.5},
                                 seconds=5.0),
    'deaf': Fault('base that ignores the stop after a cancel (5 s)', ignore_the_stop,
                  seconds=5.0),
    'wheels': Fault('wheels: both (must work)', how={'parameters': {'wheels': 'both'}},
                    seconds=35.0, until_answer=True),
    'busy': Fault('two processes spin (should work)', before=spin, seconds=40.0,
                  until_answer=True),
}


def main():
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--only', default='', help='faults that have this in their name')
    given = parser.parse_args()
    print(f'| {" | ".join(HEADER)} |\n|{"---|" * len(HEADER)}', flush=True)
    for name, fault in FAULTS.items():
        if given.only in name:
            with apart() as folder, ExitStack() as closing:
                try:
                    row = fault.row(Stage(folder, closing)).cells()
                except TimeoutError as error:
                    row = [name, *[''] * 4, _short(f'not shown: {error}', 300)]
            print(f'| {" | ".join(row)} |', flush=True)


if __name__ == '__main__':
    main()
