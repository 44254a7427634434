"""Two compensation nodes at once: on one gyro with files of their own, and with one file for both, which stays whole."""

import pytest
import yaml
from fake_gyro import FakeGyro
from test_compensation_node_live import INTERVAL, MODEL, outputs

from gyro_calibration.model_file import read_model

try:
    from diagnostic_msgs.msg import DiagnosticArray
    from std_msgs.msg import Float64
    from std_srvs.srv import Trigger
except ImportError:
    pass  # the fixture `ros` skips every test that needs them, and says why


@pytest.fixture
def both(start_node, ros, wait_until, tmp_path):
    """Return a function that starts a node and another in the namespace `second`, on the same gyro; both keep files of given names."""
    def start(first, second):
        (tmp_path / 'model.yaml').write_text(yaml.safe_dump(MODEL))
        common = {'model_file': tmp_path / 'model.yaml', 'bias_duration': 4.0}
        start_node('compensation_node', {**common, 'calibration_file': tmp_path / first})
        gyro = FakeGyro(ros, wait_until)
        gyro.interval, heard = INTERVAL, ros.collect(Float64, '/second/heading')
        start_node('compensation_node', {**common, 'calibration_file': tmp_path / second},
                   {'__ns': '/second', 'imu/data_raw': '/imu/data_raw', 'imu/temperature': '/imu/temperature'})
        gyro.wait_until(lambda: gyro.play(outputs(0.4)) or heard, 60.0, 'the second node')
        return gyro, heard
    return start


def calibrate(gyro, *names):
    """Calibrate at rest by services at the same time, and return the messages."""
    futures = [gyro.call_later(name) for name in names]
    gyro.wait_until(lambda: gyro.play(outputs(0.4)) or all(future.done() for future in futures), 60.0, 'calibrations')
    assert all(future.result().success for future in futures), [future.result().message for future in futures]


def test_two_nodes_on_one_gyro_keep_what_is_theirs(both, ros, tmp_path):
    gyro, heard = both('first.yaml', 'second.yaml')
    gyro.play(outputs(4.0, 0.3))
    assert ros.call(Trigger, '/second/reset_heading').success
    begin = gyro.heading[-1].data
    gyro.play(outputs(4.0, 0.3))
    gyro.wait_until(lambda: heard[-1].data == pytest.approx(1.2, abs=0.1), what=f'the heading of the second, {heard[-1].data}')
    assert gyro.heading[-1].data == pytest.approx(begin + 1.2, abs=0.1)
    calibrate(gyro, 'calibrate_bias')
    assert (tmp_path / 'first.yaml').exists() and not (tmp_path / 'second.yaml').exists()
    assert not any(SHARED in status.message for array in gyro.diagnostics for status in array.status)


SHARED = 'was written by somebody else'


def test_two_nodes_with_one_file_say_so_and_leave_it_whole(both, ros, tmp_path):
    gyro, _ = both('calibration.yaml', 'calibration.yaml')
    for _ in range(3):
        calibrate(gyro, 'calibrate_bias', '/second/calibrate_bias')
        assert read_model(tmp_path / 'calibration.yaml').self_calibration.method == 'rest'
    diagnostics = ros.collect(DiagnosticArray, '/diagnostics', 10)
    gyro.wait_until(lambda: gyro.play(outputs(0.4)) or any(SHARED in status.message for array in diagnostics for status in array.status),
                    what='a warning')
    assert sorted(path.name for path in tmp_path.iterdir() if path.name != 'calibration_biases.yaml') == ['calibration.yaml', 'model.yaml']
