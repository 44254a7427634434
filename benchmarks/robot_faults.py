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

    python benchmarks/robot_faults.py [--tree DIRECTORY] [--only WORD]

A compensation node in a process of its own drives a small robot (``test/robot.py``: 150 ms
latency, 0.2 s lag, 100 Hz) through `calibrate`. In mid-run, at 40 deg/s or more, the fault
happens. A row states the turn of the robot since, the time until the last command to turn was
followed by a zero, the error of the heading and its stated standard deviation, the worst
diagnostics since the fault and the answer of the service. ``--tree`` takes the node from another
version of this project, also one with the interface of 0.1.0. All faults take 6 min; nothing
leaves the machine.

"""

import argparse
from contextlib import contextmanager, ExitStack
from dataclasses import dataclass, field
import math
import os
from pathlib import Path
import random
import subprocess
import sys
import tempfile
import threading
import time

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / 'test'))

from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from processes import end  # noqa: E402
import rclpy  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from rclpy.qos import qos_profile_sensor_data  # noqa: E402
from rclpy.signals import SignalHandlerOptions  # noqa: E402
from robot import now, Robot, RosRobot, SecondCommander  # noqa: E402
from sensor_msgs.msg import Imu  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

MODEL = 'effects: {bias: {bias: 0.0}}\nnoise: {angle_random_walk: 1.0e-4}\n'
FULL_RATE = math.radians(40.0)
TELEOP = 0.3  # rad/s
WATCHED = 10.0  # s after a fault
SPINNING = 'import time\nend = time.monotonic() + 45\nwhile time.monotonic() < end: pass'
LEVELS = ('OK', 'WARN', 'ERROR', 'STALE')


@dataclass(frozen=True)
class Interface:
    """Names of one version: module of the node, place of its services, parameter that drives."""

    module: str
    services: str
    drive: str


OLD = Interface('gyro_calibration.compensation_node', '/', 'drive_profile')
MOVED = Interface('gyro_calibration.ros.compensation_node', '/', 'drive_profile')
NEW = Interface('gyro_calibration.ros.compensation_node', '/compensation_node/',
                'calibration.drive')


def interface(tree):
    """Return the interface of the version in a directory."""
    ros = tree / 'gyro_calibration' / 'ros'
    return NEW if (ros / 'pipeline.py').exists() else MOVED if ros.is_dir() else OLD


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
        """Return the columns as text."""
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


class Stage:
    """A robot, a node under test, and everything that is heard of both."""

    def __init__(self, tree, folder, closing):
        self._tree, self._folder, self._closing, self.names = (tree, folder, closing,
                                                               interface(tree))
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
        self.robot = RosRobot(self.node, Robot(**robot), speed=speed)
        self._closing.callback(self.robot.close)
        (self._folder / 'model.yaml').write_text(MODEL)
        given = {'model_file': self._folder / 'model.yaml',
                 'calibration_file': self._folder / 'calibration.yaml',
                 self.names.drive: True, **(parameters or {})}
        command = [sys.executable, '-m', self.names.module, '--ros-args']
        texts = {name: str(value).lower() if isinstance(value, bool) else value
                 for name, value in given.items()}
        command += [word for name, text in texts.items() for word in ('-p', f'{name}:={text}')]
        with open(self._folder / 'node.txt', 'wb') as log:
            self.process = subprocess.Popen(
                command, stdout=log, stderr=log, start_new_session=True, cwd=self._tree,
                env={**os.environ, 'PYTHONPATH': str(self._tree)})
        self._closing.callback(end, self.process)
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
        client = self.node.create_client(Trigger, f'{self.names.services}{name}')
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

    def others(self):
        """Return a second commander."""
        commander = SecondCommander(self.node)
        self._closing.callback(commander.close)
        return commander


def clock_absent(stage):
    """use_sim_time without /clock, unplugged in mid-run."""
    stage.start(parameters={'use_sim_time': True})
    stage.calibrate()
    stage.robot.robot.unplugged = True
    stage.fault()
    stage.watch()
    return stage.row('sim time without /clock; unplugged in mid-run')


def clock_paused(stage):
    """/clock and stamps stop in mid-run, samples come."""
    stage.start(parameters={'use_sim_time': True}, speed=1.0)
    stage.calibrate()
    stage.robot.clock_stands = True
    stage.fault()
    stage.watch()
    return stage.row('/clock and stamps stand in mid-run')


def clock_paused_unplugged(stage):
    """/clock stops and the gyro is unplugged."""
    stage.start(parameters={'use_sim_time': True}, speed=1.0)
    stage.calibrate()
    stage.robot.clock_stands = stage.robot.robot.unplugged = True
    stage.fault()
    stage.watch()
    return stage.row('/clock stands and the gyro is unplugged in mid-run')


def clock_fast(stage):
    """/clock at four times the speed: must work."""
    stage.start(parameters={'use_sim_time': True}, speed=4.0)
    stage.fault()
    stage.calibrate()
    stage.watch(30.0, until_answer=True)
    return stage.row('/clock at 4x (must work)')


def stamps_stand(stage):
    """Stamps stop in mid-run."""
    stage.start()
    stage.calibrate()
    stage.robot.robot.stamps_stand = True
    stage.fault()
    stage.watch()
    return stage.row('stamps stand in mid-run')


def unplugged(stage):
    """Let the gyro be silent in mid-run."""
    stage.start()
    stage.calibrate()
    stage.robot.robot.unplugged = True
    stage.fault()
    stage.watch()
    return stage.row('gyro unplugged in mid-run')


def soft_stop(stage):
    """Zeros at 20 Hz in mid-run."""
    stage.start()
    other = stage.others()
    stage.calibrate()
    other.rate = 0.0
    stage.fault()
    stage.watch(25.0, until_answer=True)
    return stage.row('soft stop (zeros at 20 Hz) in mid-run')


def teleop(stage):
    """Teleop at 20 Hz in mid-run."""
    stage.start()
    other = stage.others()
    stage.calibrate()
    other.rate = TELEOP
    stage.fault()
    stage.watch(5.0)
    return stage.row('teleop (0.3 rad/s at 20 Hz) in mid-run', others=(TELEOP,))


def begun_in_teleop(stage):
    """Ask for a run while teleop turns the robot."""
    stage.start()
    other = stage.others()
    other.rate = TELEOP
    stage.wait(lambda: stage.robot.robot.rate > 0.9 * TELEOP, 10.0, 'teleop')
    stage.fault()
    stage.calibrate()
    stage.watch(5.0)
    return stage.row('run begun while teleop turns', others=(TELEOP,))


def _two_publishers(stage, name, change):
    stage.start()
    publisher = stage.node.create_publisher(Imu, 'imu/data_raw', 100)

    def also(message):
        change(message)
        publisher.publish(message)
    stage.robot.also = also
    stage.fault()
    stage.robot.robot.command(math.radians(45.0))
    stage.wait(lambda: stage.robot.robot.heading > math.radians(390.0), 20.0, 'the turns')
    stage.robot.robot.command(0.0)
    stage.watch(2.0)
    return stage.row(name)


def _shift(message, seconds):
    nanoseconds = message.header.stamp.sec * 10 ** 9 + message.header.stamp.nanosec + round(
        seconds * 1e9)
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(nanoseconds, 10 ** 9)


def second_gyro(stage):
    """Another gyro, which rests, on imu/data_raw."""
    def change(message):
        _shift(message, 0.005)
        message.angular_velocity.z = 0.0001 * random.random()
    return _two_publishers(stage, 'second publisher: a gyro at rest', change)


def second_driver(stage):
    """Send the same samples once more, 0.3 s old."""
    return _two_publishers(stage, 'second publisher: stamps 0.3 s older',
                           lambda message: _shift(message, -0.3))


def killed(stage):
    """SIGKILL of the node; the base has no time-out."""
    stage.start()
    stage.calibrate()
    stage.process.kill()
    stage.fault()
    stage.watch(5.0)
    return stage.row('node killed in mid-run, base without time-out (5 s)')


def killed_with_timeout(stage):
    """SIGKILL of the node; the base has a time-out."""
    stage.start(timeout=0.5)
    stage.calibrate()
    stage.process.kill()
    stage.fault()
    stage.watch(5.0)
    return stage.row('node killed in mid-run, base time-out 0.5 s')


def deaf(stage):
    """Let the base go on after a cancel."""
    stage.start()
    stage.calibrate()
    stage.robot.robot.deaf = True
    stage.fault()
    stage.call('cancel_calibration')
    stage.watch(5.0)
    return stage.row('base that ignores the stop after a cancel (5 s)')


def wheels(stage):
    """Odometry and commands both feed the detection of standstill: must work."""
    stage.start(parameters={'wheels': 'both'})
    stage.fault()
    stage.calibrate()
    stage.watch(35.0, until_answer=True)
    return stage.row('wheels: both (must work)')


def busy(stage):
    """Two processes that spin, on this computer."""
    stage.start()
    with ExitStack() as spinning:
        for _ in range(2):
            process = subprocess.Popen([sys.executable, '-c', SPINNING])
            spinning.callback(process.wait)
            spinning.callback(process.kill)
        stage.fault()
        stage.calibrate()
        stage.watch(40.0, until_answer=True)
    return stage.row('two processes spin (should work)')


FAULTS = (clock_absent, clock_paused, clock_paused_unplugged, clock_fast, stamps_stand, unplugged,
          soft_stop, teleop, begun_in_teleop, second_gyro, second_driver, killed,
          killed_with_timeout, deaf, wheels, busy)


@contextmanager
def stage_of(tree):
    """Give a stage of its own to a fault."""
    os.environ['ROS_DOMAIN_ID'] = str(random.SystemRandom().randint(1, 101))
    with tempfile.TemporaryDirectory() as folder, ExitStack() as closing:
        os.environ['ROS_LOG_DIR'] = folder
        yield Stage(tree, Path(folder), closing)


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--tree', type=Path, default=ROOT, help='version whose node is tested')
    parser.add_argument('--only', default='',
                        help='only faults whose function has this in its name')
    given = parser.parse_args()
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    os.environ.setdefault('AMENT_PREFIX_PATH', sys.prefix)
    print(f'| {" | ".join(HEADER)} |\n|{"---|" * len(HEADER)}', flush=True)
    for fault in FAULTS:
        if given.only in fault.__name__:
            with stage_of(given.tree.resolve()) as stage:
                try:
                    row = fault(stage).cells()
                except TimeoutError as error:
                    row = [fault.__name__, *[''] * 4, _short(f'not shown: {error}', 300)]
            print(f'| {" | ".join(row)} |', flush=True)


if __name__ == '__main__':
    main()
