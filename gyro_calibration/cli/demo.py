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
Run an emulated gyro, its driver, compensation, self-calibration and a drive here.

example: gyro_calibration demo --out demo
"""

import argparse
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, ExitStack
from dataclasses import dataclass, field
import math
import os
from pathlib import Path
import random
import subprocess
import sys
import threading
import time

from gyro_calibration.cli import verb
from gyro_calibration.cli.plots import draw_headings
from gyro_calibration.cli.verb import Answer
from gyro_calibration.driver.emulator import Emulator
from gyro_calibration.driver.protocols import find_protocol, Sample
from gyro_calibration.files import InputError, write_atomically
from gyro_calibration.heading.integration import integrate, Threshold, ThresholdFilter
from gyro_calibration.logs.log import Array, DEGREE, Log, write_log
from gyro_calibration.model.gyro_model import GyroModel
from gyro_calibration.model.model_file import read_model, write_model
from gyro_calibration.model.motion import constant_rate_motion
from gyro_calibration.model.noise import simulate_noise
from gyro_calibration.model.presets import XV3500
from gyro_calibration_reproduction.hong_park import TABLE_1
import numpy as np

try:
    from geometry_msgs.msg import Twist
    from gyro_calibration.ros.runner import SENSOR_QOS
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from sensor_msgs.msg import Imu
    from std_srvs.srv import Trigger
    _MISSING = ''
except ImportError as error:
    _MISSING = str(error)

_PROTOCOL = 'kvh_dsp3000'
_NAMESPACE = 'gyro_calibration_demo'  # keeps the commands from robots
_DRIVE_MOTION = constant_rate_motion([
    *((5.0 if rate else 4.0, rate) for rate in (0, 20, 0, -20, 0, 20, -20, 0, -20, 0)), (1.0, 0)])


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--out', default='demo', metavar='DIR',
                        help='folder for picture, table and log; default: %(default)s')
    parser.add_argument('--seed', type=verb.non_negative_integer, default=0,
                        help='seed of the noise; default: %(default)s')


def run(given: argparse.Namespace) -> Answer:
    """
    Run the demonstration, about 80 s, and leave heading.png, table.md and log.csv in a folder.

    The gyro of the robot, which follows ``cmd_vel``, is emulated on a pseudo-terminal; driver and
    compensation run as processes of their own.
    """
    if _MISSING:
        raise InputError(f'the demo needs ROS 2 and matplotlib ({_MISSING}); install '
                         'gyro_calibration[ros,plot]')
    verb.require_folder(given.out)
    out = Path(given.out)
    out.mkdir(parents=True, exist_ok=True)
    calibration_file, model_file, port = (out / 'calibration.yaml', out / 'noise.yaml',
                                          out.absolute() / 'gyro')
    calibration_file.unlink(missing_ok=True)
    # separate from the network of a robot and other graphs on this machine
    os.environ.update(ROS_AUTOMATIC_DISCOVERY_RANGE='LOCALHOST',
                      ROS_DOMAIN_ID=str(random.randint(1, 101)), ROS_SECURITY_ENABLE='false')
    write_model(model_file, GyroModel(noise=XV3500.noise))  # only the noise of the gyro is known
    robot = _SimulatedRobot(XV3500.model, simulate_noise(
        XV3500.noise, 30000, XV3500.interval, np.random.default_rng(given.seed)))
    with ExitStack() as stack:
        stack.enter_context(Emulator(find_protocol(_PROTOCOL), robot.samples(), link=port,
                                     wait_for_reader=True))
        stack.enter_context(_node_process('driver_node', port=port, protocol=_PROTOCOL))
        stack.enter_context(_node_process('compensation_node', model_file=model_file,
                                          calibration_file=calibration_file,
                                          **{'calibration.drive': True}))
        rclpy.init()
        stack.callback(rclpy.try_shutdown)
        client = _DemoClient(robot)
        stack.callback(client.close)
        begin = _calibrate_and_drive(client)
    return _evaluate(out, robot, client, begin, given.seed)


class _CallRefused(OSError):
    """A service refused a call."""


@dataclass
class _SimulatedRobot:
    """A robot that turns as commanded, at up to 3 rad/s², with the gyro of a model."""

    model: GyroModel
    noise: Array  # of each sample, rad/s
    #: Not yet applied, each with the time of its receipt, s, and the rate, rad/s.
    commands: deque[tuple[float, float]] = field(default_factory=deque)
    #: Of each sample the time by the clock of this machine, s, and the true heading, rad.
    true_headings: list[tuple[float, float]] = field(default_factory=list)

    def samples(self) -> Iterator[Sample]:
        """Give the samples of the gyro, each at its time, until the noise ends."""
        # where this process is delayed they are late, but the robot has turned meanwhile
        command, rate, heading, begin = 0.0, 0.0, 0.0, time.monotonic()
        for number, noise in enumerate(self.noise):
            due = begin + number * XV3500.interval
            time.sleep(max(0.0, due - time.monotonic()))
            while self.commands and self.commands[0][0] <= due:
                command = self.commands.popleft()[1]
            largest = 3.0 * XV3500.interval
            change = min(max(command - rate, -largest), largest)
            heading += XV3500.interval * (rate + 0.5 * change)
            rate += change
            self.true_headings.append((time.time() - (time.monotonic() - due), heading))
            yield Sample(float(self.model.output(rate, self.model.reference_temperature) + noise),
                         time=number * XV3500.interval)


class _DemoClient:
    """Subscribes to the nodes and calls their services, spinning in a thread of its own."""

    def __init__(self, robot: _SimulatedRobot):
        self.raw_rates: list[tuple[float, float]] = []  # s and rad/s
        self.headings: list[tuple[float, float]] = []  # s and rad
        self.node = rclpy.create_node('demonstration', namespace=_NAMESPACE)

        def add_raw(message: Imu) -> None:
            self.raw_rates.append((_seconds(message), message.angular_velocity.z))

        def add_heading(message: Imu) -> None:
            yaw = 2.0 * math.atan2(message.orientation.z, message.orientation.w)
            self.headings.append((_seconds(message), yaw))

        def add_command(message: Twist) -> None:
            robot.commands.append((time.monotonic(), message.angular.z))

        def spin() -> None:
            while not self._stop.is_set():
                self._executor.spin_once(timeout_sec=0.1)

        self.node.create_subscription(Imu, 'imu/data_raw', add_raw, SENSOR_QOS)
        self.node.create_subscription(Imu, 'imu/data', add_heading, SENSOR_QOS)
        self.node.create_subscription(Twist, 'cmd_vel', add_command, 10)
        self._velocity = self.node.create_publisher(Twist, 'cmd_vel', 10)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=spin)
        self._thread.start()

    def call_service(self, name: str, timeout: float) -> None:
        client = self.node.create_client(Trigger, name)
        if not client.wait_for_service(20.0):
            raise OSError(f'the service {name} did not appear within 20 s')
        answer, deadline = client.call_async(Trigger.Request()), time.monotonic() + timeout
        while not answer.done():
            if time.monotonic() > deadline:
                raise OSError(f'{name} did not answer within {timeout:g} s')
            time.sleep(0.01)
        if not answer.result().success:
            raise _CallRefused(f'{name}: {answer.result().message}')

    def command_rate(self, rate: float) -> None:
        command = Twist()
        command.angular.z = rate
        self._velocity.publish(command)

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self._executor.shutdown()
        self.node.destroy_node()


def _seconds(message: Imu) -> float:
    return message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec


@contextmanager
def _node_process(module: str, **parameters: object) -> Iterator[None]:
    arguments = [word for name, value in parameters.items() for word in ('-p', f'{name}:={value}')]
    ros_options = ['-r', f'__ns:=/{_NAMESPACE}', '--log-level', 'error']
    process = subprocess.Popen([sys.executable, '-m', f'gyro_calibration.ros.{module}',
                                '--ros-args', *arguments, *ros_options])
    try:
        yield
    finally:
        process.terminate()
        try:
            process.wait(20.0)
        except subprocess.TimeoutExpired:  # a busy machine
            process.kill()
            process.wait()


def _calibrate_and_drive(client: _DemoClient) -> float:
    with verb.show_progress('starting driver and compensation') as on_progress:
        deadline = time.monotonic() + 60.0
        while not (client.raw_rates and client.headings
                   and client.node.count_publishers('cmd_vel') > 1):
            if time.monotonic() > deadline:
                raise OSError('driver and compensation were not ready within 60 s; stop other '
                              'programs')
            time.sleep(0.02)
        on_progress(None, 'calibrating on the motion profile')
        for is_last in (False, False, True):
            try:
                client.call_service('compensation_node/calibrate', 60.0)
                break
            except _CallRefused as refusal:  # this robot turns late on a busy machine
                if is_last:
                    raise
                verb.print_message(f'{refusal}; the run is repeated')
                time.sleep(2.0)  # until the robot stands
        client.call_service('compensation_node/reset_heading', 10.0)
        on_progress(None, 'driving')
        begin, started = time.time(), time.monotonic()
        while (elapsed := time.monotonic() - started) < _DRIVE_MOTION.duration:
            client.command_rate(float(_DRIVE_MOTION.rate_at(np.array(elapsed))))
            time.sleep(0.02)
        client.command_rate(0.0)
        time.sleep(0.5)
    return begin


def _evaluate(out: Path, robot: _SimulatedRobot, client: _DemoClient, begin: float,
              seed: int) -> Answer:
    """Compare five headings of the drive with the truth, with the values of Hong and Park."""
    clock, truth = np.array(robot.true_headings).T
    time_, raw = np.array([pair for pair in client.raw_rates if pair[0] >= begin]).T
    stamp, yaw = np.array([pair for pair in client.headings if pair[0] >= begin]).T
    true = np.interp(time_, clock, truth)
    true -= true[0]
    calibration = read_model(out / 'calibration.yaml').self_calibration
    assert calibration is not None  # calibrate succeeded, so it is stored
    corrected = calibration.correct(raw)
    headings = {
        'pure integration': integrate(time_, raw),
        'self-calibration': integrate(time_, corrected),
        'threshold filter': integrate(
            time_, ThresholdFilter(Threshold()).apply_to_all(time_, raw)),
        'both': integrate(time_, ThresholdFilter(Threshold()).apply_to_all(time_, corrected)),
        'rests tracked': np.interp(time_, stamp, np.unwrap(yaw) - yaw[0])}
    draw_headings(out / 'heading.png', time_ - begin, true, headings)
    write_log(out / 'log.csv', Log(output=raw, time=time_ - time_[0], reference_heading=true))
    errors = {name: np.abs(heading - true) / DEGREE for name, heading in headings.items()}
    means = {name: float(error.mean()) for name, error in errors.items()}
    lines = ['| heading | mean error | standard deviation | off pure integration '
             '| Hong and Park, table 1 |', '|---|---|---|---|---|']
    for name, error in errors.items():
        theirs = ''
        if name in TABLE_1:
            mean, deviation = TABLE_1[name]
            gain = 100 * (1 - mean / TABLE_1['pure integration'][0])
            theirs = f'{mean:.3f} deg, {deviation:.3f} deg, {gain:.0f} %'
        gain = round(100 * (1 - means[name] / means['pure integration']))
        lines.append(f'| {name} | {means[name]:.3f} deg | {error.std():.3f} deg | {gain} % '
                     f'| {theirs} |')
    table = '\n'.join(lines) + '\n'
    write_atomically(out / 'table.md', table.encode())
    text = (f'{table}\nSelf-calibration: {calibration}.\n'
            f'Seed {seed}. Picture, table and log are in {out}.')
    return Answer([text], {'seed': seed, **calibration.to_dict(), 'mean_error_deg': means})
