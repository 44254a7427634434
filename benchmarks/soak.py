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
Run the whole graph for an hour: emulated gyro, driver_node, compensation_node and subscriber.

    python benchmarks/soak.py --minutes 60      one gyro at 1 kHz; Ctrl-C prints the figures so far
    python benchmarks/soak.py --protocols       every wire format at full line rate, a minute each
    python benchmarks/soak.py --minutes 1 --json

Each is a process of its own. The emulated KVH 1750 turns at rates that encode the number of the
sample, so the subscriber can match each corrected rate to its sample: none may be missing and none
come twice. Latency is counted from when a sample is due on the line until its corrected rate is
taken by the subscriber, so it includes emulator, driver, compensation and two hops of DDS. Memory
is the resident memory of a process: the median of the last tenth of the run against that of its
second tenth, for the first one is the warm-up.

At the full line rate the baud rate determines the number of samples. A driver that gets more than
1 kHz publishes means of several samples; the heading at the end, compared with the angle that the
emulated gyro has turned, shows that none of them was lost on the way.
"""

import argparse
from collections.abc import Iterator
from contextlib import ExitStack, suppress
import itertools
import json
import math
import os
from pathlib import Path
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from types import SimpleNamespace

from diagnostic_msgs.msg import DiagnosticArray
from gyro_calibration.driver.emulator import Emulator
from gyro_calibration.driver.protocols import find_protocol, PROTOCOLS, Sample, Settings
from gyro_calibration.logs.log import DEGREE
from gyro_calibration.model.effects import BIAS, SCALE_FACTOR_ERROR
from gyro_calibration.model.gyro_model import GyroModel, Term
from gyro_calibration.model.model_file import write_model
from gyro_calibration.model.noise import Noise
from gyro_calibration.ros.runner import SENSOR_QOS
import numpy as np
from processes import apart, end, node_command, processor_time, resident_memory
import rclpy
from rclpy.impl.implementation_singleton import rclpy_implementation as implementation
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import Imu

SOAKED, SOAKED_RATE = 'kvh_1750', 1000.0  # Hz
# rad/s; of a numbered sample: where the sign changes, a robot must be able to turn so quickly, or
# the tracker waits for the next sample
SMALLEST = 0.08
CYCLE = 1 << 18  # samples, after which the number that a rate holds begins anew
STEP = 2.0 ** -20  # rad/s a number; 16 times what the wire format resolves
LEADING = -0.5  # rad/s; of samples without a number, until the whole graph is connected
STRETCH = 2.0  # s, after which it turns the other way
INTERVAL = 1.0  # s between looks at the processes
LARGEST_RATE = 1000.0  # Hz; above it the driver is told to average
SENSITIVITY = {name: DEGREE / 27880.0 for name, protocol in PROTOCOLS.items()
               if protocol.sensitivity is None}  # rad/s a count; what the wire format leaves open
PROCESSES = ('gyro', 'driver_node', 'compensation_node', 'count')
MODEL = GyroModel((Term(BIAS, (1e-3,)), Term(SCALE_FACTOR_ERROR, (0.01,))), 1e-10 * np.eye(2),
                  (-8.0, 8.0), (-10.0, 50.0),
                  noise=Noise(angle_random_walk=2.4e-5, bias_instability=5e-6,
                              rate_random_walk=1e-7))
FINEST, RATIO = 1e-2, 1.02  # ms, and between the edges of the classes of latencies

# Shared by all processes of a run: times of begin and early end; due time of the first numbered
# sample, number of samples sent and their angle; number with those around them, and lost bytes.
GO, BEGIN, SENT, ANGLE, ALL, LOST_BYTES = range(6)
ENOUGH = 2.0  # in the place of GO


def shared(folder: Path) -> np.memmap:
    """Return numbers that all processes of a run see."""
    file = folder / 'shared'
    return np.memmap(file, float, 'r+' if file.exists() else 'w+', shape=(6,))


# The emulated gyro, in its process


def settings_of(name: str, rate: float | None = None) -> Settings:
    """Return how the emulated gyro of a format is set."""
    return Settings(sensitivity=SENSITIVITY.get(name), sample_rate=rate)


def full_rate(name: str) -> float:
    """Return how many samples a second the line of a format carries."""
    protocol = find_protocol(name)
    encode, count = protocol.encoder(settings_of(name)), 16
    length = sum(len(encode(Sample(0.5, 25.0, 1000.0 + 0.001 * number, number)))
                 for number in range(count)) / count
    return protocol.baud / (10.0 * length)


def numbered_rate(number: int) -> float:
    """Return the rate that holds the number of a sample."""
    size = SMALLEST + number % CYCLE * STEP
    return size if number // (STRETCH * SOAKED_RATE) % 2 else -size


def number_of(rate: float, last: int) -> int | None:
    """Return the number that a rate encodes, as the one nearest to the last; None if leading."""
    if abs(rate) > 0.5 * (SMALLEST + CYCLE * STEP + abs(LEADING)):
        return None
    held = round((abs(rate) - SMALLEST) / STEP)
    return last + (held - last + CYCLE // 2) % CYCLE - CYCLE // 2


def arriving(name: str, output: float, rate: float) -> float:
    """Return what comes of an output by a wire format, which rounds it."""
    settings, protocol = settings_of(name, rate), find_protocol(name)
    encode, decoder = protocol.encoder(settings), protocol.decoder(settings)
    data = protocol.preamble + b''.join(encode(Sample(output, 25.0, 1.0, number))
                                        for number in range(4))
    return decoder.feed(data)[-1].output


def turning(name: str, rate: float) -> Iterator[tuple[float, float]]:
    """Yield true rate and output of each sample: numbered, or to and fro without rounding."""
    if name == SOAKED and rate == SOAKED_RATE:
        yield from ((turned, MODEL.output(turned, 25.0))
                    for turned in map(numbered_rate, itertools.count()))
    outputs = [arriving(name, sign * SMALLEST, rate) for sign in (1.0, -1.0)]
    for index in itertools.count():
        output = outputs[int(index / (STRETCH * rate)) % 2]
        yield output, output


def samples_of(given: argparse.Namespace, numbers: np.memmap) -> Iterator[Sample]:
    """Yield leading samples until all is ready, counted ones, then leading ones for 1 s."""
    interval, begin, leading, turned = (1.0 / given.rate, time.monotonic(), given.leading,
                                        given.leading)
    for first in itertools.count():
        if numbers[GO]:
            break
        yield Sample(leading, 25.0, first * interval)
    numbers[BEGIN] = begin + first * interval
    for number, (rate, output) in zip(range(given.samples), turning(given.protocol, given.rate)):
        if number or not leading:
            numbers[ANGLE] += 0.5 * (turned + rate) * interval
        numbers[SENT], numbers[ALL], turned = number + 1, first + number + 1, rate
        yield Sample(output, 25.0, (first + number) * interval)
        if numbers[GO] == ENOUGH:
            break
    if not leading:
        numbers[ANGLE] += 0.5 * turned * interval
    for index in range(first + number + 1, first + number + 1 + round(given.rate)):
        numbers[ALL] = index + 1
        yield Sample(leading, 25.0, index * interval)


def gyro(given: argparse.Namespace) -> None:
    """Be the gyro until the samples end or a signal comes."""
    numbers = shared(given.folder)
    settings = settings_of(given.protocol, given.rate)
    speed = 1.0 + 1e-9 if given.patient else 1.0  # faster than real time is a replay, which waits
    emulator = Emulator(find_protocol(given.protocol), samples_of(given, numbers), settings, speed,
                        given.folder / 'port', wait_for_reader=True)
    signal.signal(signal.SIGINT, lambda *_: emulator.stop())
    emulator.open()
    try:
        emulator.run()
    finally:
        emulator.close()
    numbers[LOST_BYTES] = emulator.lost_bytes


# The subscriber, in its process


class Counter:
    """Takes the corrected rates, counts them, and says once a second what it has seen."""

    def __init__(self, given: argparse.Namespace):
        self._given, self._numbers = given, shared(given.folder)
        self._node = rclpy.create_node('counter')
        self._rates = self._node.create_subscription(Imu, 'imu/data', print, SENSOR_QOS).handle
        self._reports = self._node.create_subscription(DiagnosticArray, '/diagnostics', print,
                                                       10).handle
        self._wait_set = implementation.WaitSet(2, 0, 0, 0, 0, 0, self._node.context.handle)
        self._latencies = np.zeros(1000, int)
        self.messages = self.missing = self.repeated = 0
        self._last, self._heading, self._first_heading = -1, 0.0, None
        self._said: dict[str, str] = {}

    def take(self, seconds: float) -> None:
        """Take messages for a time as `rclpy.wait_for_message`; an executor costs 1/4 core."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0.0:
            self._wait_set.clear_entities()
            self._wait_set.add_subscription(self._rates)
            self._wait_set.add_subscription(self._reports)
            self._wait_set.wait(round(1e9 * left))
            while taken := self._rates.take_message(Imu, False):
                self._count(taken[0], time.monotonic())
            while taken := self._reports.take_message(DiagnosticArray, False):
                self._said |= {f'{status.name} {pair.key}': pair.value
                               for status in taken[0].status for pair in status.values}

    def _count(self, message: Imu, now: float) -> None:
        self.messages += 1
        number = number_of(message.angular_velocity.z, self._last) if self._given.leading else None
        if self._given.leading and number is None:
            return
        self._heading = 2.0 * math.atan2(message.orientation.z, message.orientation.w)
        if self._first_heading is None:
            self._first_heading = self._heading
        if number is None:
            return
        if number <= self._last:
            self.repeated += 1
            return
        self.missing += number - self._last - 1
        self._last = number
        latency = 1e3 * (now - self._numbers[BEGIN] - number / self._given.rate)
        self._latencies[min(len(self._latencies) - 1, max(
            0, int(math.log(max(latency, FINEST) / FINEST) / math.log(RATIO))))] += 1

    def say(self) -> dict[str, object]:
        """Return what has been seen so far."""
        share = np.cumsum(self._latencies) / max(1, self._latencies.sum())
        classes = {str(wanted): int(np.searchsorted(share, wanted / 100.0))
                   for wanted in (50, 99, 99.9, 100)}
        latency = {name: FINEST * RATIO ** (place + 0.5)
                   for name, place in classes.items()} if self._latencies.any() else {}
        turned = None if self._first_heading is None else self._heading - self._first_heading
        return {'messages': self.messages, 'last': self._last, 'missing': self.missing,
                'repeated': self.repeated, 'turned': turned,
                'latency_ms': latency, 'said': self._said}


def count(given: argparse.Namespace) -> None:
    """Count until a signal comes; the last line is the end."""
    stop: list[int] = []
    signal.signal(signal.SIGINT, lambda number, frame: stop.append(number))
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    counter = Counter(given)
    while not stop:
        counter.take(INTERVAL)
        print(json.dumps(counter.say()), flush=True)


# The run


class Run:
    """The four processes of a run, and what is seen of them."""

    def __init__(self, given: argparse.Namespace, folder: Path, stack: ExitStack):
        self.given, self._folder, self._stack = given, folder, stack
        self.numbers = shared(folder)
        self.numbers[:] = 0.0
        write_model(folder / 'model.yaml',
                    MODEL if given.leading else GyroModel(noise=MODEL.noise))
        self.processes: dict[str, subprocess.Popen] = {}
        self.memory: dict[str, list[int]] = {name: [] for name in PROCESSES}
        self.used: dict[str, float] = {}

    def start(self) -> None:
        """Start all, and let the gyro begin to count once its rates arrive."""
        own = [sys.executable, __file__]
        words = ['--folder', self._folder, '--protocol', self.given.protocol, '--rate',
                 self.given.rate, '--leading', self.given.leading,
                 '--samples', self.given.samples, *['--patient'] * self.given.patient]
        for name, parameters in (
                ('compensation_node', {'model_file': self._folder / 'model.yaml',
                                       'calibration_file': self._folder / 'calibration.yaml'}),
                ('driver_node', {'port': self._folder / 'port', 'protocol': self.given.protocol,
                                 **self._wiring()})):
            self._begin(name, node_command(name, parameters))
        self._begin('count', [*own, 'count', *words])
        self._begin('gyro', [*own, 'gyro', *words])
        self._wait_for_rates()
        self.numbers[GO] = 1.0
        self.since, self._used = time.monotonic(), {name: processor_time(process.pid)
                                                    for name, process in self.processes.items()}

    def _wiring(self) -> dict[str, object]:
        """Return the parameters of the driver beyond its port and format."""
        given: dict[str, object] = {}
        if self.given.protocol in SENSITIVITY:
            given['sensitivity'] = SENSITIVITY[self.given.protocol]
        if self.given.rate != find_protocol(self.given.protocol).rate:
            given['sample_rate'] = self.given.rate
        if self.given.rate > LARGEST_RATE:
            given['samples_per_message'] = math.ceil(self.given.rate / LARGEST_RATE)
        return given

    def _begin(self, name: str, command: list[object]) -> None:
        with open(self._folder / name, 'wb') as output:
            process = subprocess.Popen(list(map(str, command)), stdout=output,
                                       stderr=subprocess.STDOUT, start_new_session=True)
        self.processes[name] = process
        self._stack.callback(end, process)

    def _wait_for_rates(self) -> None:
        deadline = time.monotonic() + 30.0
        while self.seen().messages < 10:
            self._look_for_ends()
            if time.monotonic() > deadline:
                raise TimeoutError(f'no corrected rate within 30 s:\n{self._outputs()}')
            time.sleep(0.1)

    def _look_for_ends(self) -> None:
        ended = [name for name, process in self.processes.items() if process.poll() is not None
                 and name != 'gyro']
        if ended:
            raise RuntimeError(f'{", ".join(ended)} ended:\n{self._outputs()}')

    def _outputs(self) -> str:
        return '\n'.join(f'--- {name}\n{(self._folder / name).read_text(errors="replace")[-2000:]}'
                         for name in self.processes)

    def seen(self) -> SimpleNamespace:
        """Return what the counter said last."""
        lines = [line for line in (self._folder / 'count').read_text().splitlines()
                 if line.startswith('{') and line.endswith('}')]
        return SimpleNamespace(**(json.loads(lines[-1]) if lines else {'messages': 0}))

    def watch(self) -> None:
        """Look at the processes until the gyro ends, and note their memory and processor time."""
        while self.processes['gyro'].poll() is None:
            with suppress(OSError, ValueError):
                for name, process in self.processes.items():
                    self.memory[name].append(resident_memory(process.pid))
                    self.used[name] = processor_time(process.pid) - self._used[name]
            self.lasted = time.monotonic() - self.since
            self._look_for_ends()
            time.sleep(INTERVAL)

    def figures(self) -> dict[str, object]:
        """Return what came of it; the counter is given the time to take what is under way."""
        time.sleep(2.0 * INTERVAL)
        seen, numbers = self.seen(), self.numbers
        unsettled = seen.turned - numbers[ANGLE]
        gyro_said = {name.partition(': gyro ')[2]: value
                     for name, value in seen.said.items() if ': gyro ' in name}
        return {'protocol': self.given.protocol, 'rate_hz': self.given.rate,
                'lasted_s': self.lasted, 'sent': int(numbers[SENT]),
                'sent_with_leading': int(numbers[ALL]),
                'read_by_driver': int(gyro_said.get('samples', -1)),
                'lost_by_driver': int(gyro_said.get('lost_samples', -1)),
                'bytes_nobody_took': int(numbers[LOST_BYTES]),
                'messages': seen.messages, 'missing': seen.missing + int(numbers[SENT]) - seen.last
                - 1 if self.given.leading else None, 'repeated': seen.repeated
                if self.given.leading else None, 'latency_ms': seen.latency_ms,
                'heading_error_deg': math.remainder(unsettled, 2.0 * math.pi) / DEGREE,
                'memory_mib': {name: round(median(values) / 2 ** 20, 1)
                               for name, values in self.memory.items()},
                'memory_growth_percent': {name: round(growth(values), 2)
                                          for name, values in self.memory.items()},
                'load_percent': {name: round(100.0 * used / self.lasted, 1)
                                 for name, used in self.used.items()},
                'driver_said': gyro_said}


def median(values: list[int]) -> float:
    """Return the median; nan of nothing."""
    return statistics.median(values) if values else math.nan


def growth(values: list[int]) -> float:
    """Return by how much the last tenth is above the second, in percent."""
    tenth = max(1, len(values) // 10)
    return 100.0 * (median(values[-tenth:]) / median(values[tenth:2 * tenth] or values) - 1.0)


def soak(protocol: str, rate: float, seconds: float, leading: float,
         patient: bool) -> dict[str, object]:
    """Run the graph for some time, or until Ctrl-C, and return the figures."""
    given = argparse.Namespace(protocol=protocol, rate=rate, samples=round(seconds * rate),
                               leading=leading, patient=patient)
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        run = Run(given, Path(folder), stack)
        run.start()
        try:
            run.watch()
        except KeyboardInterrupt:
            run.numbers[GO] = ENOUGH
            run.watch()
        return run.figures()


def outcomes(given: argparse.Namespace) -> Iterator[dict[str, object]]:
    if not given.protocols:
        yield soak(SOAKED, SOAKED_RATE, 60.0 * given.minutes, LEADING, given.patient)
        return
    for name in given.only or sorted(PROTOCOLS):
        yield soak(name, full_rate(name), 60.0 * min(given.minutes, 1.0), 0.0, given.patient)


def text(found: dict[str, object]) -> Iterator[str]:
    yield (f'{found["protocol"]} at {found["rate_hz"]:.0f} Hz for {found["lasted_s"]:.0f} s: '
           f'{found["sent"]} samples sent, {found["read_by_driver"]} of '
           f'{found["sent_with_leading"]} read by the driver with those before and after')
    if found['missing'] is not None:
        yield (f'  {found["missing"]} missing and {found["repeated"]} repeated among the '
               'corrected rates')
        yield '  latency, ms: ' + ', '.join(f'{name} % {value:.2f}'
                                            for name, value in found['latency_ms'].items())
    yield (f'  heading off by {found["heading_error_deg"]:.4f} deg at the end; bytes nobody took: '
           f'{found["bytes_nobody_took"]}')
    yield '  process: load in % of a core, resident memory in MiB, its growth in %'
    for name in PROCESSES:
        yield (f'    {name}: {found["load_percent"][name]}, {found["memory_mib"][name]}, '
               f'{found["memory_growth_percent"][name]}')


def arguments() -> argparse.Namespace:
    """Return what was asked for; the words `gyro` and `count` start the processes of a run."""
    parser = argparse.ArgumentParser(description='the whole graph under load, for long')
    parser.add_argument('--minutes', type=float, default=60.0)
    parser.add_argument('--protocols', action='store_true',
                        help='every wire format at its full line rate, at most a minute each')
    parser.add_argument('--only', nargs='*', metavar='NAME', help='of these formats')
    parser.add_argument('--patient', action='store_true',
                        help='let the gyro wait for a driver that a busy machine does not let '
                             'read')
    parser.add_argument('--json', action='store_true')
    return parser.parse_args()


def process_arguments() -> argparse.Namespace:
    """Return what a process of a run is told."""
    parser = argparse.ArgumentParser()
    parser.add_argument('role', choices=('gyro', 'count'))
    parser.add_argument('--folder', type=Path)
    parser.add_argument('--protocol')
    for name in ('--rate', '--leading'):
        parser.add_argument(name, type=float)
    parser.add_argument('--samples', type=int)
    parser.add_argument('--patient', action='store_true')
    return parser.parse_args()


def main() -> None:
    """Measure and print, apart from all other ROS 2 programs."""
    given = arguments()
    with apart():
        if not given.json:
            print(f'{os.cpu_count()} cores; load average of the minute before: '
                  f'{os.getloadavg()[0]:.1f}', flush=True)
        for found in outcomes(given):
            found['load_average'] = os.getloadavg()[0]
            print(json.dumps(found) if given.json else '\n'.join(text(found)), flush=True)


if __name__ == '__main__':
    if sys.argv[1:2] in (['gyro'], ['count']):
        {'gyro': gyro, 'count': count}[sys.argv[1]](process_arguments())
    else:
        try:
            main()
        except KeyboardInterrupt:
            sys.exit('interrupted before the first sample')
