"""
The driver: reads a gyro on a serial port and publishes what it says, whatever happens to the port.

A thread of its own reads, decodes, stamps and publishes, which costs least; the executor only reports once a second.

"""

import sys
import threading
import time
from dataclasses import dataclass

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.node import Node
from sensor_msgs.msg import Imu, Temperature

from .node import NOT_REPORTED, SENSOR_QUALITY, UNMEASURED_VARIANCE, Parameter, declare, diagnostic, run
from .protocols import PROTOCOLS, Settings, find
from .serial_port import PortError, SampleClock, SerialPort

_INVERT = {'default': None, 'always': True, 'never': False}  # no yes and no: YAML makes truth values of them
_USE_DEVICE_TIME = {'arrival': False, 'device': True}

PARAMETERS = (
    Parameter('port', '/dev/ttyUSB0', 'Serial port of the gyro; a link made by udev keeps its name after unplugging.'),
    Parameter('baud', 0, 'Speed of the line; 0 is that of the protocol.', 'bit/s', (0, 4000000)),
    Parameter('protocol', 'kvh_dsp3000', f'Wire format of the gyro: {", ".join(PROTOCOLS)}.'),
    Parameter('frame_id', 'gyro', 'Frame of the gyro, whose z is its input axis.'),
    Parameter('sensitivity', 0.0, 'Rate of one count of the gyro; 0 is that of the protocol.', 'rad/s', (0.0, 100.0)),
    Parameter('invert', 'default', 'Whether the gyro counts clockwise turns positive: always, never, or default for that of the protocol.'),
    Parameter('axis', 'z', 'Axis to read of a gyro with three: x, y or z.'),
    Parameter('columns', Settings().columns, 'Columns of the protocol csv, in the words of the log format.'),
    Parameter('full_scale', 0.0, 'Rate beyond which a sample is thrown away; 0 is that of the protocol.', 'rad/s', (0.0, 1000.0)),
    Parameter('time_source', 'arrival', 'What stamps the samples: arrival, or device for the time that the gyro sends (replays).'),
    Parameter('angular_velocity_standard_deviation', 0.0, 'Noise of one sample; 0 is unknown.', 'rad/s', (0.0, 100.0)),
    Parameter('reopen_interval', 1.0, 'Time between attempts to open the port.', 's', (0.05, 60.0)),
    Parameter('silence_timeout', 2.0, 'Time without a sample after which the port is opened anew.', 's', (0.1, 60.0)),
)


@dataclass(frozen=True)
class _Counts:
    """
    What has happened since the start; the names are what the diagnostics show.

    """

    samples: int = 0
    discarded_bytes: int = 0
    device_faults: int = 0
    out_of_range: int = 0


class DriverNode(Node):
    """
    Publishes ``imu/data_raw``, ``imu/temperature`` and ``/diagnostics``; see `PARAMETERS`.

    Raises
    ------
    ValueError : a parameter has no possible value

    """

    def __init__(self):
        super().__init__('driver_node')
        self._values = values = declare(self, PARAMETERS)
        self._protocol = protocol = find(values.protocol)
        settings = _settings(values)
        use_device_time = _chosen('time_source', values.time_source, _USE_DEVICE_TIME)
        if use_device_time and not protocol.gives_time(settings):
            raise ValueError(f'time_source is device, but {protocol.name} sends no time: use arrival, or csv with a column time_s')
        self._decoder = protocol.decoder(settings)
        self._sample_clock = SampleClock(protocol.rate, use_device_time)
        self._port = SerialPort(values.port, values.baud or protocol.baud)
        self._prepare_messages()
        self._prepare_report()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._work, name='reader')
        self._thread.start()

    def destroy_node(self):
        """
        Join the thread, close the port, and destroy the node.

        """
        self._stop.set()
        self._thread.join()
        self._port.close()
        super().destroy_node()

    def _prepare_messages(self):
        self._imu_publisher = self.create_publisher(Imu, 'imu/data_raw', SENSOR_QUALITY)
        self._temperature_publisher = self.create_publisher(Temperature, 'imu/temperature', SENSOR_QUALITY)
        self._imu, self._temperature = Imu(), Temperature()
        self._imu.header.frame_id = self._temperature.header.frame_id = self._values.frame_id
        self._imu.orientation_covariance[0] = self._imu.linear_acceleration_covariance[0] = NOT_REPORTED
        variance = self._values.angular_velocity_standard_deviation ** 2
        if variance > 0.0:
            self._imu.angular_velocity_covariance[[0, 4, 8]] = UNMEASURED_VARIANCE, UNMEASURED_VARIANCE, variance

    def _prepare_report(self):
        self._diagnostics_publisher = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self._report_lock = threading.Lock()  # the thread and the timer both report
        self._state, self._problem, self._last_error = 'opening', 'opening the port', ''
        self._sample_count, self._opening_count = 0, 0
        self._reported, self._report_time, self._rate = _Counts(), time.monotonic(), 0.0
        self.create_timer(1.0, self._report_regularly)

    # In the thread

    def _work(self):
        while not self._stop.is_set():
            try:
                self._port.open()
                self._opening_count += 1
                self._port.write(self._protocol.startup)
                self._read_until_silent()
            except PortError as error:
                self._change_state('failed', str(error))
            self._port.close()
            self._decoder.reset()
            self._stop.wait(self._values.reopen_interval)

    def _read_until_silent(self):
        before, has_bytes, heard = self._counts(), False, time.monotonic()
        while not self._stop.is_set():
            data = self._port.read()
            arrival = self.get_clock().now().nanoseconds * 1e-9
            has_bytes = has_bytes or bool(data)
            samples = self._decoder.feed(data)
            if samples:
                self._publish(samples, arrival)
                before, has_bytes, heard = self._counts(), False, time.monotonic()
                self._change_state('reading', '')
            elif time.monotonic() - heard > self._values.silence_timeout:
                raise PortError(self._why_silent(before, has_bytes))

    def _publish(self, samples, arrival):
        stamps = self._sample_clock.stamp([sample.time for sample in samples], arrival)
        for sample, stamp in zip(samples, stamps, strict=True):
            seconds, nanoseconds = divmod(round(stamp * 1e9), 1_000_000_000)
            if sample.temperature is not None:
                self._temperature.header.stamp.sec, self._temperature.header.stamp.nanosec = seconds, nanoseconds
                self._temperature.temperature = sample.temperature
                self._temperature_publisher.publish(self._temperature)
            self._imu.header.stamp.sec, self._imu.header.stamp.nanosec = seconds, nanoseconds
            self._imu.angular_velocity.z = sample.output
            self._imu_publisher.publish(self._imu)
        self._sample_count += len(samples)

    def _why_silent(self, before, has_bytes):
        now, port, limit = self._counts(), self._values.port, self._values.silence_timeout
        if now.device_faults > before.device_faults:
            return f'the gyro on {port} calls each of its samples invalid for {limit} s: turn it off and on, then have it checked'
        if now.out_of_range > before.out_of_range:
            return f'each sample on {port} is beyond full scale for {limit} s: check protocol, sensitivity and full_scale'
        if has_bytes:
            return f'bytes come on {port}, but no sample of {self._protocol.name} for {limit} s: check protocol, baud and columns'
        return f'nothing comes on {port} for {limit} s: check the power and the wires of the gyro'

    def _change_state(self, state, problem):
        if (state, problem) == (self._state, self._problem):
            return
        with self._report_lock:
            self._state, self._problem = state, problem
            self._last_error = problem or self._last_error
            self._reported, self._rate = self._counts(), 0.0
            self._report(DiagnosticStatus.ERROR if problem else DiagnosticStatus.OK, problem or 'samples come')
        if problem:
            self.get_logger().error(problem)
        else:
            self.get_logger().info(f'samples come on {self._values.port}')

    # In the executor

    def _report_regularly(self):
        with self._report_lock:
            now, last = self._counts(), self._reported
            elapsed, self._report_time = time.monotonic() - self._report_time, time.monotonic()
            self._reported, self._rate = now, (now.samples - last.samples) / elapsed
            self._report(*self._judge(now, last))

    def _judge(self, now, last):
        if self._state == 'opening':
            return DiagnosticStatus.WARN, self._problem
        if self._state == 'failed':
            return DiagnosticStatus.ERROR, self._problem
        lost = {name: count - getattr(last, name) for name, count in vars(now).items() if name != 'samples'}
        if any(lost.values()):
            worst = ', '.join(f'{name.replace("_", " ")} {count}' for name, count in lost.items() if count)
            return DiagnosticStatus.WARN, f'samples come, but in the last second there were: {worst}'
        return DiagnosticStatus.OK, 'samples come'

    # In both

    def _counts(self):
        decoder = self._decoder
        return _Counts(self._sample_count, decoder.discarded_bytes, decoder.faults, decoder.out_of_range)

    def _report(self, level, message):
        counts = {name.replace('_', ' '): count for name, count in vars(self._counts()).items()}
        values = {'port': self._values.port, 'state': self._state, 'rate in Hz': f'{self._rate:.1f}', **counts}
        values |= {'reopened': max(0, self._opening_count - 1), 'last error': self._last_error}
        self._diagnostics_publisher.publish(diagnostic(self, level, 'gyro', message, values))


def _settings(values):
    return Settings(
        sensitivity=values.sensitivity or None,
        invert=_chosen('invert', values.invert, _INVERT),
        axis=values.axis,
        columns=tuple(values.columns),
        full_scale=values.full_scale or None,
    )


def _chosen(name, word, meanings):
    if word not in meanings:
        raise ValueError(f'{name} is {word!r}, but must be one of {", ".join(meanings)}')
    return meanings[word]


def main():
    """
    Run the node; returns the exit code.

    """
    return run(DriverNode)


if __name__ == '__main__':
    sys.exit(main())
