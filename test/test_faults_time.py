"""Driver and compensation node in the time of a simulation: as fast as time, paused, faster, and set back."""

import itertools
import math
import threading
import time

import pytest

from gyro_calibration.driver.emulator import Emulator
from gyro_calibration.driver.protocols import Sample, Settings, find

try:
    from diagnostic_msgs.msg import DiagnosticArray
    from rosgraph_msgs.msg import Clock
    from sensor_msgs.msg import Imu
    from std_msgs.msg import Float64
except ImportError:
    pass  # the fixture `ros` skips every test that needs them, and says why

RATE, OUTPUT = 200.0, 0.2  # Hz, rad/s
SIMULATED = {'use_sim_time': True}


class Simulation:
    """Publishes the time of a simulation, at a speed that may be set, and at any time."""

    def __init__(self, ros):
        self.now, self.speed, self._publisher = 1000.0, 1.0, ros.publisher(Clock, '/clock', 10)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self):
        last = time.monotonic()
        while not self._stop.wait(0.005):
            now = time.monotonic()
            self.now += self.speed * (now - last)
            last, message = now, Clock()
            message.clock.sec, message.clock.nanosec = divmod(round(1e9 * self.now), 10 ** 9)
            self._publisher.publish(message)

    def close(self):
        """End it."""
        self._stop.set()
        self._thread.join()


@pytest.fixture
def simulation(ros):
    simulation = Simulation(ros)
    yield simulation
    simulation.close()


def seconds(message):
    """Return the stamp of a message."""
    return message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec


def test_stamps_and_heading_follow_the_simulation(simulation, start_node, ros, wait_until, tmp_path):
    """A gyro on a port turns in real time, so only at the speed of time does its heading mean anything; elsewhere nothing may break."""
    start_node('compensation_node', SIMULATED | {'calibration_file': tmp_path / 'calibration.yaml'})
    settings = {'protocol': 'csv', 'columns': '[gyro_rad_s]', 'sample_rate': RATE, 'port': tmp_path / 'gyro'}
    start_node('driver_node', SIMULATED | settings)
    rates, headings = ros.collect(Imu, 'imu/data'), ros.collect(Float64, 'heading')
    reports = ros.collect(DiagnosticArray, '/diagnostics', 10)
    samples = (Sample(OUTPUT, time=number / RATE) for number in itertools.count())
    with Emulator(find('csv'), samples, Settings(columns=('gyro_rad_s',)), link=tmp_path / 'gyro', wait_for_reader=True):
        phases = Phases(simulation, rates, headings, wait_until)
        wait_until(lambda: rates and headings, 20.0, 'samples')
        stamped, turned = phases.go(speed=1.0)
        assert stamped == pytest.approx(phases.lasted, abs=0.4) and turned == pytest.approx(OUTPUT * stamped, abs=0.01)
        stamped, turned = phases.go(speed=0.0)
        assert 0.0 <= stamped < 0.4 and abs(turned) < 0.1
        stamped, turned = phases.go(speed=4.0)
        assert stamped == pytest.approx(4.0 * phases.lasted, rel=0.4) and turned == pytest.approx(OUTPUT * stamped, abs=0.3)
        phases.go(speed=1.0)
        simulation.now -= 500.0
        stamped, turned = phases.go(speed=1.0)
        assert stamped == pytest.approx(phases.lasted, abs=0.4) and turned == pytest.approx(OUTPUT * stamped, abs=0.01)
        wait_until(lambda: _says(reports, 'integration began anew'), what='that the time was set back')


def _says(reports, words):
    return any(words in pair.value for report in reports for status in report.status for pair in status.values)


class Phases:
    """Lets the simulation go on for a while, and sees how far stamps and heading came."""

    def __init__(self, simulation, rates, headings, wait_until):
        self._simulation, self._rates, self._headings, self._wait_until = simulation, rates, headings, wait_until
        self.lasted = math.nan

    def go(self, speed):
        """
        Return what the stamps went on by, s, and what the heading did, rad, while samples came for 1.5 s.

        The samples of a busy machine are waited for at both ends: what is asked of stamps is not that they come soon.

        """
        self._simulation.speed = speed
        time.sleep(0.3)
        self._catch_up()
        begin, count = time.monotonic(), len(self._rates)
        first, heading = self._newest()
        self._wait_until(lambda: time.monotonic() - begin > 1.5 and (speed == 0.0 or len(self._rates) > count + 100), 20.0, 'samples')
        self._catch_up()
        self.lasted = time.monotonic() - begin
        last, turned = self._newest()
        return last - first, turned - heading

    def _catch_up(self):
        near = 0.2 * max(1.0, self._simulation.speed)
        self._wait_until(lambda: abs(seconds(self._rates[-1]) - self._simulation.now) < near, what='stamps of the simulation')

    def _newest(self):
        """Return stamp and heading of the newest sample of which both came."""
        index = min(len(self._rates), len(self._headings)) - 1
        return seconds(self._rates[index]), self._headings[index].data
