"""A measured gyro through the whole chain: emulator, serial port, driver, compensation, calibration over the service."""

import math

import numpy as np
import pytest

from gyro_calibration.driver.emulator import Emulator
from gyro_calibration.driver.protocols import Sample, Settings, find
from gyro_calibration.heading import integrate
from gyro_calibration.log import DEGREE, read_log

try:
    from diagnostic_msgs.msg import DiagnosticStatus
    from sensor_msgs.msg import Imu
    from std_srvs.srv import Trigger

    from gyro_calibration.ros.runner import LATCHED_QOS
except ImportError:
    pass  # the fixture `ros` skips, and says why

DURATION, CALIBRATED, SPEED = 300.0, 20.0, 4.0


@pytest.fixture
def recording(data):
    """Return time, s, output, rad/s, and encoder heading, rad, of 300 s; the gyro is mounted upside down against the encoder."""
    log = read_log(data / 'mems_encoder_turntable' / 'yaw_slow.csv.gz')
    part = log.time < DURATION
    return log.time[part], log.output[part], log.reference_heading[part] - log.reference_heading[0]


def _write_profile(path, time, heading):
    rows = zip(time[time <= CALIBRATED], heading[time <= CALIBRATED] / DEGREE)
    path.write_text('time_s,heading_deg\n' + ''.join(f'{t},{h}\n' for t, h in rows))


def _start_nodes(start_node, folder):
    """Start both nodes as a robot would, and return the driver; the port is not there yet."""
    driver = start_node('driver_node', parameters={
        'port': folder / 'gyro', 'protocol': 'csv', 'columns': '[time_s, gyro_dps]', 'invert': 'always', 'time_source': 'device',
        'reopen_interval': 0.2, 'silence_timeout': 10.0})
    start_node('compensation_node', parameters={
        'profile_file': folder / 'profile.csv', 'calibration_file': folder / 'calibration.yaml', 'threshold': 0.0,
        'check_after_run': False})  # the turntable never rests
    return driver


def _warm_up(ros, driver, port, wait_until, *heard):
    """Be a gyro at rest until all have heard it, then unplug it, so that not a sample of the recording is lost; return the time, s."""
    rest = (Sample(0.0, time=0.01 * number) for number in range(100000))
    with Emulator(find('csv'), rest, Settings(columns=('time_s', 'gyro_dps')), link=port):
        wait_until(lambda: all(heard), 60.0, 'the nodes')
    wait_until(lambda: 'the device is gone' in driver.output, what='the driver to notice')
    return 1e-9 * ros.node.get_clock().now().nanoseconds


def _stamp(message):
    return message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec


def _stamped_yaw(messages):
    stamps = np.array([_stamp(message) for message in messages])
    return stamps - stamps[0], np.unwrap([2 * math.atan2(m.orientation.z, m.orientation.w) for m in messages])


def _rms(error):
    return math.sqrt(np.mean(error ** 2)) / DEGREE


def test_calibrated_on_20_s_the_published_heading_follows_the_encoder_for_five_minutes(start_node, ros, wait_until, recording, tmp_path):
    time, output, heading = recording
    _write_profile(tmp_path / 'profile.csv', time, heading)
    driver = _start_nodes(start_node, tmp_path)
    raw, corrected = ros.collect(Imu, 'imu/data_raw'), ros.collect(Imu, 'imu/data')
    begun = _warm_up(ros, driver, tmp_path / 'gyro', wait_until, raw, corrected)
    calibrate = ros.node.create_client(Trigger, 'calibrate')
    assert calibrate.wait_for_service(30.0)
    answer = calibrate.call_async(Trigger.Request())
    status = ros.collect(DiagnosticStatus, 'calibration_status', LATCHED_QOS)
    wait_until(lambda: status and status[-1].message.startswith('calibrating'), what='the calibration to begin')
    samples = [Sample(rate, time=t) for t, rate in zip(time.tolist(), output.tolist())]
    settings = Settings(columns=('time_s', 'gyro_dps'))
    with Emulator(find('csv'), samples, settings, SPEED, tmp_path / 'gyro', wait_for_reader=True) as emulator:
        emulator.join()
        wait_until(lambda: min(_stamp(messages[-1]) for messages in (raw, corrected)) > begun + DURATION, what='the last samples')
    assert answer.done() and answer.result().success, answer.result()
    played = [[message for message in messages if _stamp(message) > begun] for messages in (raw, corrected)]
    clock, yaw = _stamped_yaw(played[1])
    error = yaw - yaw[0] - np.interp(clock, time, heading)
    pure = integrate(time, -output) - heading
    print(f'rms error over {DURATION:g} s: {_rms(error):.2f} deg, pure integration {_rms(pure):.2f} deg; {answer.result().message}')
    assert min(map(len, played)) > 0.99 * len(time)
    assert _rms(error) < _rms(pure) / 3
