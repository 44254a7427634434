"""
The driver: reads a gyro on a serial port and publishes what it says, whatever happens to the port.

A thread of its own reads, decodes, stamps and publishes, which costs least; the executor only reports once a second. Were the thread to
end by a fault of the program, the node would end with it, so that whoever started it knows, and can start it again.

"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import TypeVar

from rclpy.node import Node
from sensor_msgs.msg import Imu, Temperature

from gyro_calibration.driver.connection import AUTO, Connection, State
from gyro_calibration.driver.protocols import PROTOCOLS, Sample, Settings
from gyro_calibration.driver.timestamps import ClockDifference
from gyro_calibration.ros import NOT_REPORTED, UNMEASURED_VARIANCE
from gyro_calibration.ros.diagnostics import Diagnostics
from gyro_calibration.ros.driver_report import DriverReport
from gyro_calibration.ros.parameters import Parameter
from gyro_calibration.ros.runner import SENSOR_QOS, call_every, declare, run

_THREE_WAYS = {'default': None, 'always': True, 'never': False}  # no yes and no: YAML makes truth values of them
_USE_DEVICE_TIME = {'fit': False, 'device': True}
_Meaning = TypeVar('_Meaning')

PARAMETERS = (
    Parameter('port', '/dev/ttyUSB0', 'Serial port of the gyro, or a pattern that finds it under any name: /dev/serial/by-id/*A9003XYZ*.'),
    Parameter('baud', 0, 'Speed of the line; 0 is that of the protocol, or found by listening where that is auto.', 'bit/s', (0, 4000000)),
    Parameter('protocol', 'kvh_dsp3000', f'Wire format of the gyro: {", ".join(PROTOCOLS)}, or {AUTO} to find it by listening.'),
    Parameter('frame_id', 'gyro', 'Frame of the gyro, whose z is its input axis.'),
    Parameter('sensitivity', 0.0, 'Rate of one count of the gyro; 0 is that of the protocol.', 'rad/s', (0.0, 100.0)),
    Parameter('invert', 'default', 'Whether the gyro counts clockwise turns positive: always, never, or default for that of the protocol.'),
    Parameter('axis', 'z', 'Axis to read of a gyro with three: x, y or z.'),
    Parameter('columns', Settings().columns, 'Columns of the protocol csv, in the words of the log format.'),
    Parameter('full_scale', 0.0, 'Rate beyond which a sample is thrown away; 0 is that of the protocol.', 'rad/s', (0.0, 1000.0)),
    Parameter('increments', 'default', 'Whether the gyro sends angles, not rates: always, never, or default for that of the protocol.'),
    Parameter('sample_rate', 0.0, 'Samples a second that the gyro is set to; 0 is that of the protocol.', 'Hz', (0.0, 100000.0)),
    Parameter('time_source', 'fit', 'What stamps the samples: fit to their arrivals, or device: the time that the gyro sends (replays).'),
    Parameter('samples_per_message', 1, 'The mean of so many samples is one message.', '', (1, 10000)),
    Parameter('angular_velocity_standard_deviation', 0.0, 'Noise of one sample; 0 is unknown.', 'rad/s', (0.0, 100.0)),
    Parameter('reopen_interval', 0.1, 'Time before a lost port is opened again; it doubles with each attempt.', 's', (0.05, 60.0)),
    Parameter('reopen_limit', 5.0, 'Longest time between attempts to open the port.', 's', (0.05, 60.0)),
    Parameter('silence_timeout', 2.0, 'Time without a sample after which the port is opened anew.', 's', (0.1, 60.0)),
)

_WATCH_INTERVAL = 0.5  # s; between two looks whether the port is still read
_CLOCK_INTERVAL = 0.01  # s; between two looks at the clock of the node, which cost as much as a message


class DriverNode(Node):
    """
    Publishes ``imu/data_raw``, ``imu/temperature`` and ``/diagnostics``; see `PARAMETERS`.

    Stamps are those of the node's clock. With ``use_sim_time`` that is the time of the simulation as soon as there is one, and the time
    of the system before. A gyro on a port turns in real time: where the simulation runs faster or slower, its rates mean nothing there.

    Raises
    ------
    ValueError : a parameter has no possible value

    """

    def __init__(self) -> None:
        super().__init__('driver_node')
        values = declare(self, PARAMETERS)
        settings = _settings(values)
        self._connection = Connection(
            port=values.port,
            protocol=values.protocol,
            baud=values.baud,
            settings=settings,
            silence_timeout=values.silence_timeout,
            reopen_interval=values.reopen_interval,
            reopen_limit=values.reopen_limit,
            use_device_time=_chosen('time_source', values.time_source, _USE_DEVICE_TIME),
            on_change=self._tell,
        )
        self._output = _Output(self, values)
        self._difference, self._looked = ClockDifference(), 0.0
        self._report, self._told = DriverReport(self._connection, values.port, settings), ''
        self._diagnostics = Diagnostics(self, 'gyro', self._report.make, hardware_id=values.port)
        call_every(self, 1.0, self._diagnostics.now)
        if self.get_parameter('use_sim_time').value:
            self.get_logger().warning('use_sim_time is set: stamps follow the simulation, but the gyro on the port turns in real time')
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._work, name='reader')
        self._thread.start()
        call_every(self, _WATCH_INTERVAL, self._watch)

    def destroy_node(self) -> None:
        """Join the thread, which closes the port, and destroy the node."""
        self._stop.set()
        self._thread.join()
        super().destroy_node()

    def _watch(self) -> None:
        if not self._thread.is_alive():
            raise RuntimeError('the thread that reads the port has ended; what it said is above')

    # In the thread

    def _work(self) -> None:
        for chunk in self._connection.chunks(self._stop):
            self._look_at_the_clock(chunk.arrival)
            self._report.see(chunk.samples)
            assert self._connection.clock is not None  # it stamped the samples
            self._output.publish(chunk.samples, [self._difference.other(stamp) for stamp in chunk.stamps], self._connection.clock.period)
        self._output.flush()

    def _look_at_the_clock(self, arrival: float) -> None:
        if arrival - self._looked < _CLOCK_INTERVAL:
            return
        self._looked = arrival
        before, now = time.monotonic(), self.get_clock().now().nanoseconds * 1e-9
        self._difference.follow(0.5 * (before + time.monotonic()), now or time.time())

    def _tell(self, state: State) -> None:
        """Say it at once where a connection fails or comes back, but not again at each attempt."""
        if state.problem:
            self._output.flush()
            self._report.forget()
        if state.problem and state.problem == self._told:
            return
        if state.problem:
            self._told = state.problem
            self.get_logger().error(state.problem)
        elif state.name == 'reading':
            self._told = ''
            found, port = self._connection, self._connection.path
            assert found.protocol is not None  # it is known before samples come
            self.get_logger().info(f'samples of {found.protocol.name} come on {port} at {found.baud} bit/s{_in_brackets(found.heard)}')
        self._diagnostics.now()


def _in_brackets(words: str) -> str:
    return f' ({words})' if words else ''


class _Output:
    """Publishes samples, each or the mean of several."""

    def __init__(self, node: Node, values: SimpleNamespace):
        self._imu_publisher = node.create_publisher(Imu, 'imu/data_raw', SENSOR_QOS)
        self._temperature_publisher = node.create_publisher(Temperature, 'imu/temperature', SENSOR_QOS)
        self._imu, self._temperature = Imu(), Temperature()
        self._imu.header.frame_id = self._temperature.header.frame_id = values.frame_id
        self._imu.orientation_covariance[0] = NOT_REPORTED
        self._variance = values.angular_velocity_standard_deviation ** 2
        self._group_size: int = values.samples_per_message
        self._group: list[tuple[float, Sample]] = []
        self._claim(1)
        self._report_force(None)

    def publish(self, samples: Sequence[Sample], stamps: Sequence[float], period: float) -> None:
        """Publish samples at their stamps, by the clock of the node; the period is that of the gyro."""
        if self._group_size == 1:
            for sample, stamp in zip(samples, stamps, strict=True):
                self._send(stamp, sample.output, sample.temperature, sample.specific_force)
            return
        for sample, stamp in zip(samples, stamps, strict=True):
            # Where samples are lost, a group has fewer, and not longer ones.
            if self._group and not 0.0 < stamp - self._group[0][0] < (self._group_size - 0.5) * period:
                self.flush()
            self._group.append((stamp, sample))
            if len(self._group) == self._group_size:
                self.flush()

    def flush(self) -> None:
        """Publish the mean of a group that has begun; it must not wait where nobody knows when the next sample comes."""
        if not self._group:
            return
        stamps, samples = zip(*self._group, strict=True)
        temperatures = [sample.temperature for sample in samples if sample.temperature is not None]
        forces = [sample.specific_force for sample in samples if sample.specific_force is not None]
        self._claim(len(samples))
        stamp = stamps[0] + _mean([each - stamps[0] for each in stamps])  # so that seconds since 1970 lose no digits
        output = _mean([sample.output for sample in samples])
        self._send(stamp, output, _mean(temperatures) if temperatures else None, _mean(forces) if forces else None)
        self._group = []

    def _send(self, stamp: float, output: float, temperature: float | None, specific_force: float | None) -> None:
        seconds, nanoseconds = divmod(round(stamp * 1e9), 1_000_000_000)
        if temperature is not None:
            self._temperature.header.stamp.sec, self._temperature.header.stamp.nanosec = seconds, nanoseconds
            self._temperature.temperature = temperature
            self._temperature_publisher.publish(self._temperature)
        if specific_force != self._force:
            self._report_force(specific_force)
        self._imu.header.stamp.sec, self._imu.header.stamp.nanosec = seconds, nanoseconds
        self._imu.angular_velocity.z = output
        self._imu_publisher.publish(self._imu)

    def _claim(self, count: int) -> None:
        """Say how well the mean of so many samples is known, if that is known of one."""
        if self._variance > 0.0:
            self._imu.angular_velocity_covariance[[0, 4, 8]] = UNMEASURED_VARIANCE, UNMEASURED_VARIANCE, self._variance / count

    def _report_force(self, force: float | None) -> None:
        self._force = force
        self._imu.linear_acceleration.z = force or 0.0
        self._imu.linear_acceleration_covariance[0] = NOT_REPORTED if force is None else 0.0


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)


def _settings(values: SimpleNamespace) -> Settings:
    return Settings(
        sensitivity=values.sensitivity or None,
        invert=_chosen('invert', values.invert, _THREE_WAYS),
        axis=values.axis,
        columns=tuple(values.columns),
        full_scale=values.full_scale or None,
        increments=_chosen('increments', values.increments, _THREE_WAYS),
        sample_rate=values.sample_rate or None,
    )


def _chosen(name: str, word: str, meanings: Mapping[str, _Meaning]) -> _Meaning:
    if word not in meanings:
        raise ValueError(f'{name} is {word!r}, but must be one of {", ".join(meanings)}')
    return meanings[word]


def main() -> int:
    """Run the node; returns the exit code."""
    return run(DriverNode)


if __name__ == '__main__':
    sys.exit(main())
