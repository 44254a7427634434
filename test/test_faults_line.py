"""Bytes lost, doubled and flipped: what checks let through by decoders alone, and drivers of every format that go on and count."""

import itertools
import math
from contextlib import ExitStack

import numpy as np
import pytest

from gyro_calibration.driver.emulator import Emulator
from gyro_calibration.driver.protocols import PROTOCOLS, Sample, Settings, find
from gyro_calibration.driver.serial_faults import Line, damaged
from gyro_calibration.log import DEGREE

try:
    from diagnostic_msgs.msg import DiagnosticArray
    from sensor_msgs.msg import Imu
except ImportError:
    pass  # the fixture `ros` skips every test that needs them, and says why

SHARES = (0.001, 0.01, 0.1)
RATE = 100.0
CHECKED = {'kvh_1750'}  # the only ones with a CRC
SETTINGS = {name: Settings(sample_rate=RATE, sensitivity=DEGREE / 27880.0 if name == 'fizoptika' else None) for name in PROTOCOLS}
SENT = 0.5  # rad/s


def bad(share):
    """Return a line that strikes so many of the bytes, one way or another."""
    return Line(lost_bytes=share / 3.0, doubled_bytes=share / 3.0, flipped_bytes=share / 3.0)


def exact(name):
    """Return what comes of the rate that is sent, over a good line: formats round it."""
    encode, decoder = find(name).encoder(SETTINGS[name]), find(name).decoder(SETTINGS[name])
    data = find(name).awakening + b''.join(encode(Sample(SENT, 25.0, 1.0, number)) for number in range(4))
    return decoder.feed(data)[-1].output


def is_wrong(name, output):
    """Return whether a rate is another than the one that was sent."""
    return abs(output - exact(name)) > 1e-9


@pytest.mark.parametrize('share', SHARES)
@pytest.mark.parametrize('name', sorted(PROTOCOLS))
def test_a_decoder_counts_what_it_throws_away_and_a_crc_lets_nothing_wrong_through(name, share):
    protocol, generator = find(name), np.random.default_rng(1)
    encode, decoder = protocol.encoder(SETTINGS[name]), protocol.decoder(SETTINGS[name])
    pieces = (encode(Sample(SENT, 25.0, number / RATE, number)) for number in range(3000))
    samples = [sample for piece in pieces for sample in decoder.feed(damaged(bad(share), piece, generator))]
    assert decoder.discarded_bytes > 0 and samples
    assert all(math.isfinite(sample.output) and abs(sample.output) <= protocol.limit(SETTINGS[name]) for sample in samples)
    if name in CHECKED:
        assert not [sample.output for sample in samples if is_wrong(name, sample.output)]


class Wired:
    """A driver of one format, in a namespace of its own, and what it publishes."""

    def __init__(self, name, start_node, ros, folder):
        self.name, self.link, self.exact, self.discarded = name, folder / name, exact(name), 0
        parameters = {'protocol': name, 'port': self.link, 'reopen_interval': 0.05, 'reopen_limit': 0.2, 'silence_timeout': 10.0,
                      'sensitivity': SETTINGS[name].sensitivity or 0.0, 'sample_rate': RATE}
        start_node('driver_node', parameters, {'__ns': f'/{name}', '/diagnostics': f'/{name}/diagnostics'})
        self.rates = ros.collect(Imu, f'/{name}/imu/data_raw')
        self.reports = ros.collect(DiagnosticArray, f'/{name}/diagnostics', 10)

    def gyro(self, share):
        """Return the emulated gyro behind a line that strikes so many bytes."""
        samples = (Sample(SENT, 25.0, number / RATE) for number in itertools.count())
        return Emulator(find(self.name), samples, SETTINGS[self.name], link=self.link, line=bad(share), generator=np.random.default_rng(2))

    def wrong(self, last=0):
        """Return the rates that came, or the last of them, and were never sent."""
        return [message.angular_velocity.z for message in self.rates[-last:] if abs(message.angular_velocity.z - self.exact) > 1e-9]

    def count(self, name):
        """Return a count of the diagnostics."""
        return next((int(pair.value) for pair in self.reports[-1].status[0].values if pair.key == name), 0) if self.reports else 0


def test_drivers_of_every_format_go_on_over_bad_lines_and_count(start_node, ros, wait_until, tmp_path):
    """At a tenth of all bytes long frames hardly ever arrive whole; after each line a good one shows that decoding is right again."""
    drivers = [Wired(name, start_node, ros, tmp_path) for name in sorted(PROTOCOLS)]
    for share, wanted in zip((*SHARES, 0.0), (60, 20, 0, 60)):
        for driver in drivers:
            driver.rates.clear()
            driver.discarded = driver.count('discarded bytes')
        with ExitStack() as stack:
            for driver in drivers:
                stack.enter_context(driver.gyro(share))
            wait_until(lambda wanted=wanted: all(len(driver.rates) >= wanted for driver in drivers), 60.0, f'samples at {share}')
            if not wanted:
                wait_until(lambda: all(driver.count('discarded bytes') > driver.discarded + 100 for driver in drivers), what='the counts')
        assert not [driver.name for driver in drivers if driver.name in CHECKED and driver.wrong()]
        assert share or not [(driver.name, driver.wrong(30)) for driver in drivers if driver.wrong(30)]  # the first are still under way
    wait_until(lambda: all(driver.count('lost samples') > 0 for driver in drivers), what='lost samples')
