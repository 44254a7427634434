# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The graph under faults: any order of starting, killed and stalled nodes."""

import itertools
import json
import math
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

from gyro_calibration.driver.emulator import Emulator
from gyro_calibration.driver.protocols import find_protocol, Sample, Settings
import numpy as np
import pytest

try:
    from diagnostic_msgs.msg import DiagnosticArray
    from gyro_calibration.ros.runner import SENSOR_QOS
    from sensor_msgs.msg import Imu
except ImportError:
    pass  # the fixture `ros` skips every test that needs them, and says why

RATE = 100.0  # Hz
STEP = 2e-5  # rad/s from a sample to the next
NEARLY = 0.3  # rad, in 1 s: as late as a busy machine may be at first; tested gaps are longer
FIRST = 0.3  # rad/s
DRIVER = {'protocol': 'csv', 'columns': '[gyro_rad_s]', 'sample_rate': RATE}
MODEL = 'effects: {bias: {bias: 0.0}}\nnoise: {angle_random_walk: 1.0e-5}\n'


def turning(link):
    """Return an emulated gyro whose rate is the number of the sample."""
    samples = (Sample(FIRST + STEP * number, 25.0, number / RATE) for number in itertools.count())
    return Emulator(find_protocol('csv'), samples, Settings(columns=('gyro_rad_s',)), link=link,
                    wait_for_reader=True)


class Heard:

    def __init__(self, ros, wait_until):
        self.numbers, self.headings, self.variances, self._wait_until = [], [], [], wait_until
        self.reports = ros.collect(DiagnosticArray, '/diagnostics', 10)
        ros.node.create_subscription(Imu, '/imu/data', self._take, SENSOR_QOS)

    def _take(self, message):
        self.numbers.append(round((message.angular_velocity.z - FIRST) / STEP))
        self.headings.append(2.0 * math.atan2(message.orientation.z, message.orientation.w))
        self.variances.append(message.orientation_covariance[8])

    def more(self, count, timeout=60.0):
        before = len(self.numbers)
        self._wait_until(lambda: len(self.numbers) >= before + count, timeout,
                         f'{count} more rates')

    def error(self, first, last):
        """Return what the heading is off by from one place of the lists to another, rad."""
        begin, end = self.numbers[first], self.numbers[last]
        truth = ((end - begin) * FIRST + 0.5 * STEP * (end ** 2 - begin ** 2)) / RATE
        return abs(math.remainder(self.headings[last] - self.headings[first] - truth,
                                  2.0 * math.pi))

    @property
    def missing(self):
        """Return the number of lost samples; none may come twice."""
        steps = np.diff(self.numbers)
        assert (steps > 0).all(), 'a sample came twice, or late'
        return int((steps - 1).sum())

    def says(self, words):
        def said():
            return any(words in text for report in self.reports for status in report.status
                       for text in (status.message,
                                    *(f'{pair.key}: {pair.value}' for pair in status.values)))
        self._wait_until(said, what=words)


@pytest.fixture
def compensation(start_node, ros, wait_until, tmp_path):
    """Return a function that starts a compensation node, and hears it."""
    (tmp_path / 'model.yaml').write_text(MODEL)

    def start():
        node = start_node('compensation_node', {'model_file': tmp_path / 'model.yaml',
                                                'calibration_file': tmp_path / 'first.yaml'})
        return node, Heard(ros, wait_until)
    return start


def test_a_compensation_node_goes_on_through_any_order_of_starting_and_a_driver_that_is_killed(
        compensation, start_node, by_udp, tmp_path):
    node, heard = compensation()
    heard.says('is the driver running?')
    driver = start_node('driver_node', DRIVER | {'port': tmp_path / 'gyro'})
    with turning(tmp_path / 'gyro'):
        heard.more(200)
        assert heard.missing == 0 and heard.error(0, -1) < NEARLY
        driver.waited = True
        os.killpg(driver.process.pid, signal.SIGKILL)
        driver.process.wait()
        # a new one may come within half a second, which is no gap; samples may be on their way
        time.sleep(1.5)
        place = len(heard.numbers) - 1
        start_node('driver_node', DRIVER | {'port': tmp_path / 'gyro'})
        heard.more(150)
        assert heard.numbers[place + 5] - heard.numbers[place] > RATE, 'more than a second'
        assert heard.variances[-1] > 1.5 * heard.variances[place], 'the gap is in the variance'
        if max(np.diff(heard.numbers[place + 5:])) < RATE:  # else this machine made one more
            assert heard.error(place + 5, -1) < NEARLY, 'from there on the heading goes on'
        assert heard.error(0, -1) < 4.0 * math.sqrt(heard.variances[-1])
        heard.says('integration was restarted')
        assert node.stop() == 0
        _, again = compensation()
        again.more(100)
        assert again.missing == 0 and again.error(0, -1) < NEARLY


_HANGING = """
import threading, time
from rclpy.node import Node
from gyro_calibration.ros import runner as node

class Hanging(Node):
    def __init__(self):
        super().__init__('hanging')
    def destroy_node(self):
        time.sleep(30.0)

node.SHUTDOWN_TIMEOUT = 0.5
import rclpy
rclpy.init()
stop = threading.Event()
stop.set()
node.spin(Hanging(), stop)
"""


def test_a_node_that_cannot_end_is_killed(ros_domain):
    """As one does that Fast DDS holds for ever."""
    began = time.monotonic()
    ended = subprocess.run([sys.executable, '-c', _HANGING], stderr=subprocess.PIPE, text=True,
                           timeout=25.0)
    assert (ended.returncode == 1 and 'destroy_node' in ended.stderr
            and time.monotonic() - began < 20.0)


# The soak of `benchmarks/soak.py`, short: every emulated sample arrives corrected, once


SOAK = Path(__file__).parents[2] / 'benchmarks' / 'soak.py'


@pytest.mark.parametrize('minutes', [0.1, pytest.param(60, marks=pytest.mark.evidence)])
def test_no_sample_is_lost_between_the_line_and_the_corrected_rates(ros_domain, minutes):
    """At 1 kHz; what memory does shows in the hour, in 6 s it only must not run away."""
    load, cores = os.getloadavg()[0], os.cpu_count()
    if load > 4.0 * cores:
        pytest.skip(f'the load average is {load:.0f} on {cores} cores: run it alone')
    result = subprocess.run(
        [sys.executable, SOAK, '--json', '--minutes', str(minutes), '--patient'],
        capture_output=True, text=True, timeout=4000, check=False)
    assert result.returncode == 0, result.stderr
    found = json.loads(result.stdout.splitlines()[0])
    assert found['sent'] == 60000 * minutes
    assert found['missing'] == 0 and found['repeated'] == 0
    assert found['read_by_driver'] == found['sent_with_leading'] and found['lost_by_driver'] == 0
    assert abs(found['heading_error_deg']) < 0.1
    assert max(found['memory_growth_percent'].values()) < 10.0
    assert set(found['latency_ms']) == {'50', '99', '99.9', '100'}
