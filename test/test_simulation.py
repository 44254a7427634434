"""
A simulated log is what the model says of the motion, and says so itself.

"""

import numpy as np
import pytest

from gyro_calibration.effects import BIAS, SCALE_FACTOR_ERROR
from gyro_calibration.log import read_log, write_log
from gyro_calibration.model import GyroModel, Term
from gyro_calibration.motion import CALIBRATION, ROBOT
from gyro_calibration.noise import Noise
from gyro_calibration.simulation import simulate

GYRO = GyroModel((Term(BIAS, (0.01,)), Term(SCALE_FACTOR_ERROR, (-0.1,))), noise=Noise(7e-4), reference_temperature=33.0)


def test_the_output_is_equation_1_of_hong_and_park():
    log = simulate(GYRO, CALIBRATION, 100.0)
    assert len(log) == 2001 and log.time[-1] == 20.0
    assert log.output == pytest.approx(0.9 * log.reference_rate + 0.01, abs=1e-12)


def test_the_reference_is_the_motion():
    log = simulate(GYRO, ROBOT, 7.0)
    assert np.array_equal(log.reference_rate, ROBOT.rate_at(log.time))
    assert np.array_equal(log.reference_heading, ROBOT.heading_at(log.time))


def test_the_temperature_is_the_one_given_or_the_models():
    assert set(simulate(GYRO, CALIBRATION, 10.0).temperature) == {33.0}
    assert set(simulate(GYRO, CALIBRATION, 10.0, temperature=5.0).temperature) == {5.0}


def test_the_same_generator_gives_the_same_log_and_another_one_another():
    logs = [simulate(GYRO, CALIBRATION, 100.0, np.random.default_rng(seed)).output for seed in (1, 1, 2)]
    assert np.array_equal(logs[0], logs[1]) and not np.array_equal(logs[0], logs[2])


def test_the_noise_is_that_of_the_model():
    quiet, noisy = simulate(GYRO, ROBOT, 100.0), simulate(GYRO, ROBOT, 100.0, np.random.default_rng(0))
    noise = noisy.output - quiet.output
    assert noise.std() == pytest.approx(7e-4 / np.sqrt(0.01), rel=4.0 / np.sqrt(2 * len(noise)))


def test_a_simulated_log_is_a_log(tmp_path):
    log = simulate(GYRO, CALIBRATION, 20.0, np.random.default_rng(0))
    write_log(tmp_path / 'log.csv', log)
    assert np.array_equal(read_log(tmp_path / 'log.csv').output, log.output)
