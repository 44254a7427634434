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
Measure the cost of the nodes: the compensation node against a relay, and the driver on a gyro.

    python benchmarks/node_latency.py

This process publishes ``imu/data_raw`` and waits for ``imu/data``, either from the compensation
node or from a relay that publishes each message as it comes. The two alternate in blocks, so that
other load of the machine affects both; a row shows the medians of the blocks and the median of
their ratios. Latency is counted from before the publication here until the message is taken here,
so it includes both hops. Both have the same topics: four subscriptions, and three messages a
sample, each with a subscriber. The relay computes nothing.

Then the driver reads an emulated DSP-3000 on a pseudo-terminal. It takes 80 s in all and needs two
idle cores; nothing leaves the machine.
"""

from collections.abc import Iterator
from contextlib import contextmanager, ExitStack, suppress
from dataclasses import dataclass
import itertools
import math
import os
from pathlib import Path
import statistics
import subprocess
import sys
import time

from geometry_msgs.msg import PoseWithCovarianceStamped, Twist, TwistWithCovarianceStamped
from gyro_calibration.driver.emulator import Emulator
from gyro_calibration.driver.protocols import find_protocol, Sample
from gyro_calibration.logs.log import DEGREE
from gyro_calibration.model.effects import BIAS, rate_temperature_polynomial, SCALE_FACTOR_ERROR
from gyro_calibration.model.gyro_model import GyroModel, SelfCalibration, Term
from gyro_calibration.model.model_file import write_model
from gyro_calibration.model.noise import Noise
from gyro_calibration.ros.runner import PUBLISHED_QOS, SENSOR_QOS
from nav_msgs.msg import Odometry
import numpy as np
from processes import apart, end, node_command, processor_time
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.impl.implementation_singleton import rclpy_implementation as implementation
from sensor_msgs.msg import Imu, Temperature

RATES = (100, 1000)  # Hz
ROUNDS = 4
BLOCK = 4.0  # s
NODES = {'node': 'compensation_node', 'driver': 'driver_node'}
COMPARED = ('relay', 'node')
PUBLISHED = {'imu/data': Imu, 'heading': PoseWithCovarianceStamped,
             'yaw_rate': TwistWithCovarianceStamped}


@dataclass(frozen=True)
class Block:
    """What one subject did at one rate."""

    latencies: list[float]  # of the messages that came back, ms
    sent: int
    load: float  # processor time of the subject's process, % of a core

    @property
    def lost(self) -> int:
        return self.sent - len(self.latencies)


def relay() -> None:
    """Publish three messages for each that comes, run as most nodes in Python are."""
    rclpy.init(args=sys.argv)
    node = rclpy.create_node('relay')
    imu, heading, rate = (node.create_publisher(kind, topic, PUBLISHED_QOS)
                          for topic, kind in PUBLISHED.items())
    pose, twist = PoseWithCovarianceStamped(), TwistWithCovarianceStamped()

    def publish(message: Imu) -> None:
        imu.publish(message)
        heading.publish(pose)
        rate.publish(twist)

    node.create_subscription(Imu, 'imu/data_raw', publish, SENSOR_QOS)
    for topic, kind in (('imu/temperature', Temperature), ('odom', Odometry), ('cmd_vel', Twist)):
        node.create_subscription(kind, topic, print, SENSOR_QOS)
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)


def model() -> GyroModel:
    """Return the model of a good fibre-optic gyro from a rate table, with all node options."""
    polynomial = rate_temperature_polynomial(3, 2)
    coefficients = 1e-4 * np.random.default_rng(1).standard_normal(len(polynomial.coefficients))
    terms = (Term(BIAS, (1e-3,)), Term(SCALE_FACTOR_ERROR, (0.01,)),
             Term(polynomial, (0.0, 1.7, 20.0, 30.0, *coefficients.tolist())))
    noise = Noise(angle_random_walk=2.4e-5, bias_instability=5e-6, rate_random_walk=1e-7)
    return GyroModel(terms, 1e-12 * np.eye(2 + len(coefficients)), (-100 * DEGREE, 100 * DEGREE),
                     (-10.0, 50.0), noise=noise,
                     self_calibration=SelfCalibration(0.002, 1e-4, ((1e-8, 0.0), (0.0, 1e-12))))


@contextmanager
def running(name: str, folder: Path, **parameters: object) -> Iterator[int]:
    """Run a subject in a namespace of its name, and give its process number."""
    command = (node_command(NODES[name], parameters) if name in NODES
               else [sys.executable, __file__, 'relay', '--ros-args'])
    with open(folder / f'{name}.txt', 'wb') as output:
        process = subprocess.Popen([*command, '-r', f'__ns:=/{name}'], stdout=output,
                                   stderr=subprocess.STDOUT, start_new_session=True)
    try:
        yield process.pid
    finally:
        end(process)


class Probe:
    """Sends samples to a subject and notes when they come back."""

    def __init__(self, subject: str, process: int):
        self._subject, self._process = subject, process
        self._node = rclpy.create_node('probe', namespace=subject)
        self._imu = self._node.create_publisher(Imu, 'imu/data_raw', SENSOR_QOS)
        self._temperature = self._node.create_publisher(Temperature, 'imu/temperature', SENSOR_QOS)
        self._subscription = self._node.create_subscription(Imu, 'imu/data', print,
                                                            SENSOR_QOS).handle
        self._wait_set = implementation.WaitSet(1, 0, 0, 0, 0, 0, self._node.context.handle)
        # the other messages are sent too, at no cost of time here: these are never read
        self._listener = rclpy.create_node('listener', namespace=subject)
        for topic in ('heading', 'yaw_rate'):
            self._listener.create_subscription(PUBLISHED[topic], topic, print, SENSOR_QOS)
        self._message = Imu()
        self._begin = 0
        self._latencies: list[float] = []

    def wait_for_subject(self) -> None:
        """Send samples until they come back, for at most 20 s."""
        deadline = time.monotonic() + 20.0
        while len(self._latencies) < 50:
            if time.monotonic() > deadline:
                raise TimeoutError(f'the {self._subject} does not answer: is the package '
                                   f'installed for {sys.executable}?')
            self._send(0.0)
            self._serve_until(time.monotonic() + 0.02)

    def measure(self, rate: int) -> Block:
        """Send the samples of one block, half of them at rest and half in motion."""
        self._latencies, self._begin = [], time.monotonic_ns()
        temperature = Temperature(temperature=31.0)
        self._stamp(temperature)
        self._temperature.publish(temperature)
        begin, used, count = time.monotonic(), processor_time(self._process), round(BLOCK * rate)
        for index in range(count):
            self._serve_until(begin + index / rate)
            self._send(max(0.0, math.sin(math.pi * index / rate)))
        self._serve_until(begin + BLOCK)
        load = 100.0 * (processor_time(self._process) - used) / (time.monotonic() - begin)
        late = time.monotonic() + 1.0
        while len(self._latencies) < count and time.monotonic() < late:
            self._serve_until(time.monotonic() + 0.01)
        return Block(self._latencies, count, load)

    def _serve_until(self, due: float) -> None:
        # Wait as `rclpy.wait_for_message` does; an executor takes as much time as the relay.
        while (left := due - time.monotonic()) > 0.0:
            self._wait_set.clear_entities()
            self._wait_set.add_subscription(self._subscription)
            self._wait_set.wait(round(1e9 * left))
            while taken := self._subscription.take_message(Imu, False):
                stamp = taken[0].header.stamp
                sent = 1_000_000_000 * stamp.sec + stamp.nanosec
                if sent >= self._begin:
                    self._latencies.append(1e-6 * (time.monotonic_ns() - sent))

    def _stamp(self, message: Imu | Temperature) -> None:
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(time.monotonic_ns(),
                                                                        1_000_000_000)

    def _send(self, rate: float) -> None:
        self._message.angular_velocity.z = rate
        self._stamp(self._message)
        self._imu.publish(self._message)


def compare(folder: Path) -> dict[str, dict[int, list[Block]]]:
    """Return the blocks of relay and node, by subject and rate."""
    write_model(folder / 'model.yaml', model())
    parameters = {'relay': {}, 'node': {'model_file': folder / 'model.yaml',
                                        'calibration_file': folder / 'calibration.yaml'}}
    blocks = {name: {rate: [] for rate in RATES} for name in COMPARED}
    with ExitStack() as stack:
        probes = {name: Probe(name, stack.enter_context(running(name, folder, **parameters[name])))
                  for name in COMPARED}
        for probe in probes.values():
            probe.wait_for_subject()
        for turn, rate in itertools.product(range(ROUNDS), RATES):
            for name in COMPARED[::-1] if turn % 2 else COMPARED:
                blocks[name][rate].append(probes[name].measure(rate))
    return blocks


def driver_load(rate: int, folder: Path) -> float:
    """Return the load of the driver, % of a core, at a rate of the gyro."""
    samples = (Sample(0.5, None, index / rate) for index in itertools.count())
    with Emulator(find_protocol('kvh_dsp3000'), samples, wait_for_reader=True) as gyro, running(
            'driver', folder, port=gyro.path) as process:
        while not gyro.sent_bytes:
            time.sleep(0.05)
        time.sleep(1.0)
        begin, used = time.monotonic(), processor_time(process)
        time.sleep(BLOCK)
        return 100.0 * (processor_time(process) - used) / (time.monotonic() - begin)


FIGURES = {
    'median latency, ms': lambda block: statistics.median(block.latencies),
    '99th percentile of the latency, ms': lambda block: float(np.percentile(block.latencies, 99)),
    'load, % of a core': lambda block: block.load,
}


def table(blocks: dict[str, dict[int, list[Block]]]) -> Iterator[str]:
    yield '| rate | figure | relay | compensation_node | ratio |'
    yield '|---:|:---|---:|---:|---:|'
    for rate in RATES:
        for title, figure in FIGURES.items():
            relays, nodes = ([figure(block) for block in blocks[name][rate]] for name in COMPARED)
            ratio = statistics.median(node / relay for relay, node in zip(relays, nodes))
            yield (f'| {rate} Hz | {title} | {statistics.median(relays):.2f} '
                   f'| {statistics.median(nodes):.2f} | {ratio:.2f} |')
        lost = ' | '.join(_lost(blocks[name][rate]) for name in COMPARED)
        yield f'| {rate} Hz | lost messages | {lost} | |'


def _lost(blocks: list[Block]) -> str:
    return f'{sum(block.lost for block in blocks)} of {sum(block.sent for block in blocks)}'


def main() -> None:
    """Measure and print, apart from all other ROS 2 programs."""
    with apart() as folder:
        rclpy.init()
        try:
            print(f'{os.cpu_count()} cores; load average of the minute before: '
                  f'{os.getloadavg()[0]:.1f}\n')
            print('\n'.join(table(compare(folder))))
            for rate in RATES:
                print(f'\ndriver_node at {rate} Hz: load {driver_load(rate, folder):.1f} % '
                      'of a core')
        finally:
            rclpy.try_shutdown()


if __name__ == '__main__':
    relay() if sys.argv[1:2] == ['relay'] else main()
