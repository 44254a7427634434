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
The driver node: reads a gyro on a serial port and publishes its samples.

One thread reads, decodes, stamps and publishes; the executor only reports once per second. If the
thread ends by a fault of the program, the node ends too, so that a launch file can restart it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
import sys
import threading
import time
from types import SimpleNamespace

from gyro_calibration.driver.connection import (
    Connection, ConnectionState, Decimator, MAX_BAUD, sample_messages, SampleMean)
from gyro_calibration.driver.protocols import AUTO, Counts, Sample, Settings
from gyro_calibration.driver.protocols.protocol import TRISTATE
from gyro_calibration.driver.timestamps import (
    NodeTimeConverter, read_clock_pair, read_steady_clock)
from gyro_calibration.logs import cdr
from gyro_calibration.logs.cdr import NSEC_PER_SEC
from gyro_calibration.ros.inputs import NodeParameter
from gyro_calibration.ros.runner import (
    call_every, declare_parameters, Diagnostics, ERROR, OK, publish_on, Report, run_node, WARN)
from rclpy.node import Node
from sensor_msgs.msg import Imu, Temperature

PARAMETERS = (
    NodeParameter('port', '/dev/ttyUSB0',
                  'Serial port of the gyro, or a pattern that finds it under any name: '
                  '/dev/serial/by-id/*A9003XYZ*.'),
    NodeParameter('protocol', 'kvh_dsp3000',
                  f'Wire format of the gyro, see wire formats; {AUTO} finds it by listening.'),
    NodeParameter('baud', 0,
                  'Speed of the line; 0 is that of the protocol, or found by listening where '
                  'that is auto.', 'bit/s', (0, MAX_BAUD)),
    NodeParameter('frame_id', 'gyro', 'Frame of the gyro, whose z is its input axis.'),
    NodeParameter('axis', 'z', 'Axis to read of a gyro with three.', choices=('x', 'y', 'z')),
    NodeParameter('invert', 'default', 'Whether the gyro counts clockwise turns positive; default '
                  'is that of the protocol.', choices=tuple(TRISTATE)),
    NodeParameter('increments', 'default', 'Whether the gyro sends angles, not rates; default is '
                  'that of the protocol.', choices=tuple(TRISTATE)),
    NodeParameter('sensitivity', 0.0, 'Rate of one count of the gyro; 0 is that of the protocol.',
                  'rad/s', (0.0, 100.0)),
    NodeParameter('sample_rate', 0.0, 'Samples a second that the gyro is set to; 0 is that of the '
                  'protocol.', 'Hz', (0.0, 100000.0)),
    NodeParameter('full_scale', 0.0, 'Rate beyond which a sample is refused; 0 is that of the '
                  'protocol.', 'rad/s', (0.0, 1000.0)),
    NodeParameter('columns', Settings().columns,
                  'Columns of the protocol csv, in the words of the log format.'),
    NodeParameter('samples_per_message', 1, 'The mean of this many samples is one message.', '',
                  (1, 10000)),
)


class DriverNode(Node):
    """
    Publishes ``imu/data_raw``, ``imu/temperature`` and ``/diagnostics``; see `PARAMETERS`.

    Stamps are those of the node's clock, and the system time before a simulation starts. A gyro on
    a port measures in real time, so its rates are wrong in a faster or slower simulation.
    """

    def __init__(self) -> None:
        super().__init__('driver_node')
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._read_port, name='reader')
        values = declare_parameters(self, PARAMETERS)
        self._settings = settings_from_parameters(values)
        self._connection = Connection(
            values.port, values.protocol, values.baud, self._settings, self._on_change)
        self._decimation = Decimator(values.samples_per_message)
        self._frame, self._variance = values.frame_id, 0.0  # of the rate of a sample, (rad/s)²
        self._publishers_by_type = {
            cdr.IMU: publish_on(self, Imu, 'imu/data_raw'),
            cdr.TEMPERATURE: publish_on(self, Temperature, 'imu/temperature')}
        self._node_time, self._last_clock_poll, self._last_problem = NodeTimeConverter(), 0.0, ''
        self._report = DriverReport(self._connection, values.port, self._settings,
                                    read_steady_clock)
        self._diagnostics = Diagnostics(self, 'gyro', self._report.make, values.port)
        if self.get_parameter('use_sim_time').value:
            self.get_logger().warning('use_sim_time is set: stamps follow the simulation, but the '
                                      'gyro on the port turns in real time')
        self._thread.start()
        call_every(self, 1.0, self._diagnostics.publish)
        call_every(self, 0.5, self._check_thread)

    def destroy_node(self) -> None:
        """Join the thread, which closes the port, and destroy the node."""
        self._stop.set()
        if self._thread.is_alive():  # not where a parameter was refused
            self._thread.join()
        super().destroy_node()

    def _check_thread(self) -> None:
        if not self._thread.is_alive():
            raise RuntimeError('the thread that reads the port has ended; its error is above')

    # In the thread

    def _read_port(self) -> None:
        for chunk in self._connection.chunks(self._stop):
            if chunk.arrival - self._last_clock_poll >= 0.01:  # as costly as a message
                read = read_clock_pair(read_steady_clock, self._read_node_clock)
                if read or not self._last_clock_poll:
                    self._last_clock_poll = chunk.arrival
                    step = self._node_time.update(
                        *(read or (chunk.arrival, self._read_node_clock())))
                    if step and not self.get_parameter('use_sim_time').value:
                        self._report.add_clock_step(step, self._node_time.steps.count)
            self._report.add(chunk.samples)
            protocol, clock = self._connection.protocol, self._connection.clock
            assert protocol is not None and clock is not None  # they made the samples
            self._variance = protocol.sample_variance(self._settings)
            stamps = [self._node_time.convert(stamp) for stamp in chunk.stamps]
            self._publish(self._decimation.add(chunk.samples, stamps, clock.period))
        self._publish(self._decimation.flush())

    def _publish(self, means: Iterable[SampleMean]) -> None:
        for mean in means:
            second, part = divmod(mean.stamp, 1.0)  # one product would lose 0.1 us
            stamp = int(second) * NSEC_PER_SEC + round(part * NSEC_PER_SEC)
            for kind, data in sample_messages(mean.sample, stamp, self._frame,
                                              self._variance / mean.sample_count):
                self._publishers_by_type[kind].publish(data)

    def _read_node_clock(self) -> float:
        """Return the time of the node, s; the system time before a simulation starts."""
        return self.get_clock().now().nanoseconds / NSEC_PER_SEC or time.time()

    def _on_change(self, state: ConnectionState) -> None:
        """Log each failure and recovery of the connection once, not each attempt."""
        if state.problem:
            self._publish(self._decimation.flush())
            self._report.clear()
        if state.problem and state.problem != self._last_problem:
            self._last_problem = self._report.event = state.problem
            self.get_logger().error(state.problem)
        elif state.name == 'reading':
            self._last_problem = ''
            found = self._connection
            assert found.protocol is not None  # it is known before samples come
            self._report.event = (f'samples of {found.protocol.name} come on {found.path} at '
                                  f'{found.baud} bit/s')
            self.get_logger().info(self._report.event)
        elif state.problem:
            return
        self._diagnostics.publish()


class DriverReport:
    """Makes reports of a connection; `event` is the last event, in a sentence."""

    def __init__(self, connection: Connection, port: str, settings: Settings,
                 clock: Callable[[], float]):
        self._connection, self._port, self._settings = connection, port, settings
        self._clock, self._last_counts, self._last_time = clock, Counts(), clock()
        self._rate, self._clock_steps, self.event = 0.0, '0', ''
        self._new_counts: dict[str, int] = {}
        self._temperature: float | None = None
        self._health: dict[str, float] = {}

    def add(self, samples: Iterable[Sample]) -> None:
        """Store temperature and health of the gyro; may be called from another thread."""
        for sample in samples:
            if sample.health:
                self._health = {**self._health, **sample.health}
            if sample.temperature is not None:
                self._temperature = sample.temperature

    def add_clock_step(self, step: float, count: int) -> None:
        """Add a step of the clock of the stamps, s, which is one of a number."""
        self._clock_steps = f'{count}, last by {step:+.1f} s'
        self.event = f'the clock of this computer was set by {step:+.1f} s; the stamps follow it'

    def clear(self) -> None:
        """Clear temperature and health while the gyro is silent; from any thread."""
        self._temperature, self._health = None, {}

    def make(self) -> Report:
        counts, now, connection = replace(self._connection.counts), self._clock(), self._connection
        elapsed = now - self._last_time
        if elapsed >= 0.5:
            self._new_counts = {name: count - getattr(self._last_counts, name)
                                for name, count in vars(counts).items()}
            self._rate = self._new_counts.pop('samples') / elapsed
            self._last_counts, self._last_time = counts, now
        # The other thread may clear these meanwhile.
        last, clock, protocol = self._temperature, connection.clock, connection.protocol
        state = connection.state
        grown = [f'{name.replace("_", " ")} {count}'
                 for name, count in self._new_counts.items() if count > 0]
        warnings = [f'in the last second there were: {", ".join(grown)}'] if grown else []
        if protocol is not None and clock is not None:
            for name, (low, high) in protocol.normal_ranges.items():
                value = self._health.get(name)
                if value is not None and not low <= value <= high:
                    warnings.append(f'{name} is {value:.4g}, but should be from {low:g} to '
                                    f'{high:g}: check the supply, then have the gyro checked')
            if (clock.is_settled
                    and (wrong := protocol.sample_rate_warning(self._settings, clock.period))):
                warnings.append(wrong)
        level, message = OK, 'samples come'
        if state.name == 'failed':
            level, message = ERROR, state.problem
        elif state.name != 'reading':
            level, message = WARN, {'opening': 'opening the port',
                                    'listening': 'listening for a protocol'}[state.name]
        elif warnings:
            level, message = WARN, f'samples come, but {"; ".join(warnings)}'
        return level, message, {
            'port': self._port, 'device': connection.path, 'state': state.name,
            'protocol': protocol.name if protocol else '', 'baud': connection.baud,
            'reopened': max(0, connection.open_count - 1),
            'waiting_s': f'{state.retry_delay:.1f}',
            'waited_s': f'{connection.waited_duration:.1f}',
            'last_error': connection.last_error, **vars(counts), 'rate_hz': f'{self._rate:.1f}',
            'longest_gap_s': f'{connection.longest_gap:.3f}', 'clock_steps': self._clock_steps,
            **({} if clock is None or protocol is None else {
                'period_ms': f'{1e3 * clock.period:.6g}',
                'nominal_period_ms': f'{1e3 / protocol.nominal_rate(self._settings):.6g}'}),
            **({} if last is None else {'temperature_degc': f'{last:.2f}'}),
            **{name: f'{value:.4g}' for name, value in self._health.items()},
            'last_event': self.event,
        }


def settings_from_parameters(values: SimpleNamespace) -> Settings:
    """Return the settings of a gyro; raise `ValueError` where they do not fit together."""
    return Settings(values.sensitivity or None, TRISTATE[values.invert], values.axis,
                    tuple(values.columns), values.full_scale or None,
                    TRISTATE[values.increments], values.sample_rate or None)


def main() -> int:
    return run_node(DriverNode)


if __name__ == '__main__':
    sys.exit(main())
