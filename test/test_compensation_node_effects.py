"""Effects with a past, a heading or a delay on a robot: the node compensates them in the stream as a log is compensated."""

from dataclasses import replace

import numpy as np
import pytest
import yaml
from fake_gyro import FakeGyro

from gyro_calibration.heading import integrate
from gyro_calibration.history import channels_of
from gyro_calibration.log import Log
from gyro_calibration.log_compensation import LogCompensation
from gyro_calibration.model_file import read_model
from gyro_calibration.simulation import respond

PLAIN = {'bias': {'bias': 0.002}, 'scale_factor_error': {'scale_factor_error': 0.02},
         'bias_temperature': {'bias_temperature': 2e-4, 'reference_temperature': 25.0}}
REMEMBERS = {'thermal_lag': {'thermal_lag': -8e-4, 'time_constant': 40.0}, 'warm_up': {'warm_up': 0.004, 'time_constant': 80.0},
             'bias_temperature_rate': {'bias_temperature_rate': 0.02}, 'thermal_hysteresis': {'thermal_hysteresis': 5e-4},
             'heading_sensitivity': {'sine': 1e-3, 'cosine': -5e-4}}


def written(path, effects):
    """Write a model file, and return the model."""
    path.write_text(yaml.safe_dump({'effects': effects, 'noise': {'angle_random_walk': 1e-5}}))
    return read_model(path)


@pytest.fixture(scope='module')
def thermal_drive(tmp_path_factory):
    """Return the log of a gyro with all of `PLAIN` and `REMEMBERS` that is driven for 250 s, heated and cooled."""
    model = written(tmp_path_factory.mktemp('models') / 'model.yaml', PLAIN | REMEMBERS)
    seconds = np.arange(2500) * 0.1
    rate = 0.3 * np.sin(seconds / 9.0) * (seconds > 20.0)
    log = Log(output=rate, time=seconds, temperature=22.0 + 25.0 * np.clip((seconds - 30.0) / 80.0, 0.0, 1.0) - 10.0 * (seconds > 180.0),
              reference_rate=rate, reference_heading=integrate(seconds, rate))
    return replace(log, output=respond(model, seconds, channels_of(log).moving(rate, rate), np.random.default_rng(4)))


@pytest.fixture
def start(start_node, ros, wait_until, tmp_path):
    def start(**parameters):
        given = {'calibration_file': tmp_path / 'calibration.yaml', **parameters}
        return start_node('compensation_node', parameters=given), FakeGyro(ros, wait_until)
    return start


def test_effects_with_a_past_gain_in_a_drive_what_they_promise(start, tmp_path, thermal_drive):
    """The promise is made on the log; the node finds its own heading, and begins its time a second earlier, while it gets acquainted."""
    log, errors = thermal_drive, {}
    for name, effects in (('plain', PLAIN), ('extended', PLAIN | REMEMBERS)):
        model = written(tmp_path / f'{name}.yaml', effects)
        node, gyro = start(model_file=tmp_path / f'{name}.yaml', standing='none', calibration_file=tmp_path / 'none.yaml')
        gyro.interval = 0.1
        gyro.play(log.output, log.temperature)
        headings = np.array([message.data for message in gyro.heading])[-len(log):]
        promised = integrate(log.time, LogCompensation(model).add(log)[0].rate)
        errors[name] = headings - headings[0] - log.reference_heading
        np.testing.assert_allclose(headings - headings[0], promised, rtol=0.0, atol=0.01)
        assert node.stop() == 0
    rms = {name: float(np.sqrt(np.mean(error ** 2))) for name, error in errors.items()}
    assert rms['plain'] > 0.3 and rms['extended'] < 0.02 * rms['plain'], rms


def test_a_time_offset_moves_the_published_stamps(start, tmp_path):
    written(tmp_path / 'model.yaml', {'time_offset': {'time_offset': 0.02}})
    _, gyro = start(model_file=tmp_path / 'model.yaml')
    sent = gyro.nanoseconds
    gyro.play(np.full(3, 0.5))
    stamps = [message.header.stamp.sec * 10 ** 9 + message.header.stamp.nanosec for message in gyro.imu]
    assert stamps == [sent - 20_000_000 + number * 10_000_000 for number in range(3)]
    assert [message.data for message in gyro.rate] == [0.5] * 3


def test_a_supply_that_nobody_tells_is_said(start, tmp_path):
    written(tmp_path / 'model.yaml', {'supply_sensitivity': {'supply_sensitivity': 0.01}})
    _, gyro = start(model_file=tmp_path / 'model.yaml')
    gyro.play(np.full(3, 0.5))
    assert gyro.rate[-1].data == 0.5
    gyro.wait_until(lambda: gyro.play([0.5]) or gyro.says('the model looks at the supply, which no message brings'))


def test_with_a_jump_back_of_the_stamps_the_past_goes_on(start, tmp_path):
    written(tmp_path / 'model.yaml', {'thermal_lag': {'thermal_lag': 1e-3, 'time_constant': 40.0}})
    _, gyro = start(model_file=tmp_path / 'model.yaml', threshold=0.0)
    gyro.play(np.full(20, 0.5), np.repeat([20.0, 30.0], 10))
    ahead = gyro.rate[-1].data - 0.5
    gyro.wait(-5.0)
    gyro.play(np.full(2, 0.5), 30.0)
    assert ahead == pytest.approx(0.01, rel=0.01) and gyro.rate[-1].data - 0.5 == pytest.approx(ahead, rel=0.01)
