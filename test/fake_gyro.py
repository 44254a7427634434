"""A gyro for tests of the compensation node: publishes samples with stamps of its own, and hears what the node makes of them."""

import time
from itertools import repeat

import numpy as np
import yaml

try:
    from builtin_interfaces.msg import Time
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
    from sensor_msgs.msg import Imu, Temperature
    from std_msgs.msg import Float64
    from std_srvs.srv import Trigger
except ImportError:
    pass  # the fixture `ros` skips every test that needs them, and says why

INTERVAL = 0.01
BEGIN = 1_700_000_000_000_000_000  # ns
PACE = 0.0015  # s between messages: stamps run 7 times faster than the clock, and nothing may depend on that


class FakeGyro:
    """Publishes raw rates with stamps of its own clock, and hears what the node makes of them."""

    def __init__(self, ros, wait_until, resting=0.0):
        self.ros, self.wait_until, self.nanoseconds, self.interval, self.frame = ros, wait_until, BEGIN, INTERVAL, 'gyro'
        self._imu = ros.publisher(Imu, 'imu/data_raw')
        self._temperature = ros.publisher(Temperature, 'imu/temperature')
        self.imu, self.rate, self.heading = ros.collect(Imu, 'imu/data'), ros.collect(Float64, 'yaw_rate'), ros.collect(Float64, 'heading')
        self.diagnostics = ros.collect(DiagnosticArray, '/diagnostics', 10)
        self.status = ros.collect(DiagnosticStatus, 'calibration_status', _latched())
        self._meet(resting)

    def _meet(self, resting):
        """
        Rest until everything is heard, for discovery takes its time each way; then, with the last sample, begin at heading zero.

        `resting` is what the gyro says at rest: if it said something else afterwards, that were a turn.

        """
        def all_heard():
            self.send(resting)
            return self.imu and self.rate and self.heading and self.status and self._temperature.get_subscription_count()
        self.wait_until(all_heard, 60.0, 'the node')
        self.frame = 'last'
        self.send(resting)
        self.wait_until(lambda: self.imu[-1].header.frame_id == 'last', what='the last')
        self.frame = 'gyro'
        assert self.ros.call(Trigger, 'reset_heading').success
        for heard in (self.imu, self.rate, self.heading, self.diagnostics):
            heard.clear()

    def stamp(self):
        """Return the gyro's time as a stamp."""
        return Time(sec=self.nanoseconds // 10 ** 9, nanosec=self.nanoseconds % 10 ** 9)

    def send(self, rate, temperature=None):
        """Publish one sample and let the gyro's time go on."""
        message = Imu()
        message.header.stamp, message.header.frame_id = self.stamp(), self.frame
        message.angular_velocity.z = float(rate)
        if temperature is not None:
            self._temperature.publish(Temperature(header=message.header, temperature=float(temperature)))
        self._imu.publish(message)
        self.wait(self.interval)

    def wait(self, seconds):
        """Let the gyro's time go on without a sample."""
        self.nanoseconds += round(seconds * 1e9)

    def play(self, rates, temperature=None, until=lambda: False, before=lambda number: None):
        """
        Publish many samples, with one temperature or one each, at the pace of the test; return after the node has taken the last one.

        `before` is called before each sample with its number, and may publish what else the robot says.

        """
        heard, sent = self._heard(), 0
        for rate, degc in zip(rates, temperature if isinstance(temperature, np.ndarray) else repeat(temperature)):
            before(sent)
            self.send(rate, degc)
            sent += 1
            time.sleep(PACE)
            if sent % 100 == 0:  # a machine that is busy elsewhere must not overrun the queues
                self.wait_until(lambda: self._heard() >= heard + sent - 300, what='the node to keep up')  # noqa: B023, at once
            if until():
                break
        self.wait_until(lambda: self._heard() >= heard + sent, what=f'{sent} headings')

    def values(self):
        """Return the values of the newest diagnostics."""
        return {pair.key: pair.value for pair in self.diagnostics[-1].status[0].values}

    def says(self, words):
        """Tell whether the diagnostics since they were cleared hold the words; the newest may be about another second."""
        return any(words in status.message for array in self.diagnostics for status in array.status)

    def _heard(self):
        """Return to how many samples all has come that the node makes of one."""
        return min(map(len, (self.imu, self.rate, self.heading)))

    def call_later(self, name):
        """Call a service without waiting for its answer."""
        client = self.ros.node.create_client(Trigger, name)
        assert client.wait_for_service(30.0)
        return client.call_async(Trigger.Request())

    def calibrating(self):
        """Tell whether the node says that a calibration goes on."""
        return bool(self.status) and self.status[-1].message.startswith('calibrating')


def start_with_gyro(start_node, ros, wait_until, folder, model, interval, resting, **parameters):
    """Start a compensation node with a model, its files in a folder, and return it with a gyro: its interval, s, and output at rest."""
    (folder / 'model.yaml').write_text(yaml.safe_dump(model))
    given = {'calibration_file': folder / 'calibration.yaml', 'model_file': folder / 'model.yaml', **parameters}
    node, gyro = start_node('compensation_node', parameters=given), FakeGyro(ros, wait_until, resting)
    gyro.interval = interval
    return node, gyro


def _latched():
    from gyro_calibration.ros.runner import LATCHED_QOS
    return LATCHED_QOS
