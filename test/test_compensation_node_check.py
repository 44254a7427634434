"""The live check on a robot: what the diagnostics say of a gyro that is no longer what its model claims, and of one that is."""

from datetime import datetime, timezone
from functools import partial

import numpy as np
import pytest
from fake_gyro import start_with_gyro

from gyro_calibration.log import DEGREE
from gyro_calibration.model_file import read_model

INTERVAL = 0.04
NOISE = 5e-4  # rad/√s
MODEL = {'effects': {'bias': {'bias': 0.01}}, 'covariance': [[1e-8]],
         'noise': {'angle_random_walk': NOISE, 'bias_instability': 1e-5, 'rate_random_walk': 1e-7},
         'origin': {'date': datetime.now(timezone.utc).isoformat()}}


@pytest.fixture
def start(start_node, ros, wait_until, tmp_path):
    return partial(start_with_gyro, start_node, ros, wait_until, tmp_path, MODEL, INTERVAL, 0.01)


def outputs(seconds, scale=1.0, bias=0.01, seed=0):
    """Return what a gyro at rest says, with so many times the noise of the model."""
    count = round(seconds / INTERVAL)
    return bias + scale * NOISE / np.sqrt(INTERVAL) * np.random.default_rng(seed).standard_normal(count)


def values(gyro):
    """Return the values of the newest diagnostics."""
    return {pair.key: pair.value for pair in gyro.diagnostics[-1].status[0].values}


def after_rests(gyro, count):
    """Wait for diagnostics that tell of so many rests, and return their values."""
    gyro.diagnostics.clear()
    gyro.wait_until(lambda: gyro.diagnostics and int(values(gyro)['rests_checked']) >= count, what=f'{count} rests')
    return values(gyro)


def test_a_gyro_that_fits_is_left_in_peace(start):
    _, gyro = start()
    gyro.play(outputs(42.0))
    told = after_rests(gyro, 3)
    assert told['noise_alarm'] == told['bias_alarm'] == '' and float(told['rest_noise_ratio']) == pytest.approx(1.0, abs=0.25)
    gyro.wait_until(lambda: gyro.play(outputs(0.4)) or gyro.says('heading goes on'))


def test_three_times_the_noise_is_said(start):
    _, gyro = start()
    gyro.play(outputs(42.0, scale=3.0))
    told = after_rests(gyro, 3)
    assert float(told['rest_noise_ratio']) == pytest.approx(3.0, abs=0.7) and not told['bias_alarm']
    gyro.wait_until(lambda: gyro.play(outputs(0.4)) or gyro.says('times what the model claims, or the robot shakes: record a log at rest'))


@pytest.mark.parametrize('moved, parameters', [(0.15 * DEGREE, {}), (1.0 * DEGREE, {}), (0.15 * DEGREE, {'threshold': 0.0})],
                         ids=['below the threshold', 'above the threshold', 'without a threshold'])
def test_a_bias_that_moved_is_said(start, moved, parameters):
    _, gyro = start(**parameters)
    gyro.play(outputs(42.0, bias=0.01 + moved))
    told = after_rests(gyro, 3)
    assert float(told['rest_rate_deg_s']) * DEGREE == pytest.approx(moved, abs=1e-3) and not told['noise_alarm']
    gyro.wait_until(lambda: gyro.play(outputs(0.4)) or gyro.says('standard deviations of what the model explains: calibrate, and if'))


def test_a_calibration_at_rest_says_that_the_bias_had_moved_and_the_alarm_ends(start, tmp_path):
    _, gyro = start(bias_duration=15.0)
    rates = outputs(60.0, bias=0.01 + 0.2 * DEGREE, seed=1)
    answer = gyro.call_later('calibrate_bias')
    gyro.wait_until(gyro.calibrating, what='the calibration to begin')
    gyro.play(rates[:400], until=answer.done)
    gyro.wait_until(answer.done)
    result = answer.result()
    assert result.success and 'more than the model explains: it changed the bias by' in result.message, result.message
    assert read_model(tmp_path / 'calibration.yaml').self_calibration.covariance is not None
    gyro.play(rates[400:1450])
    assert not after_rests(gyro, 3)['bias_alarm']


def test_it_can_be_switched_off(start):
    _, gyro = start(check_false_alarms=0.0)
    gyro.play(outputs(12.0, scale=3.0))
    gyro.wait_until(lambda: gyro.diagnostics and values(gyro)['rests_checked'] == '0')
