# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""A simulated log is what the model says of the motion, and says so itself."""

from gyro_calibration.logs.log import read_log
from gyro_calibration.model.channels import channels_from_log
from gyro_calibration.model.effects import BIAS, CATALOGUE, SCALE_FACTOR_ERROR
from gyro_calibration.model.gyro_model import GyroModel, Term
from gyro_calibration.model.motion import (
    CALIBRATION_MOTION,
    ROBOT_MOTION,
    simulate,
    simulate_gyro_output,
)
from gyro_calibration.model.noise import Noise
import numpy as np
import pytest

GYRO = GyroModel((Term(BIAS, (0.01,)), Term(SCALE_FACTOR_ERROR, (-0.1,))), noise=Noise(7e-4),
                 reference_temperature=33.0)


def test_a_log_holds_the_motion_and_what_equation_1_of_hong_and_park_makes_of_it():
    log = simulate(GYRO, ROBOT_MOTION, 100.0)
    assert len(log) == 16001 and log.time[-1] == 160.0 and set(log.temperature) == {33.0}
    assert set(simulate(GYRO, CALIBRATION_MOTION, 10.0, temperature=5.0).temperature) == {5.0}
    assert np.array_equal(log.reference_rate, ROBOT_MOTION.rate_at(log.time))
    assert np.array_equal(log.reference_heading, ROBOT_MOTION.heading_at(log.time))
    assert log.output == pytest.approx(0.9 * log.reference_rate + 0.01, abs=1e-12)
    noise = simulate(GYRO, ROBOT_MOTION, 100.0, np.random.default_rng(0)).output - log.output
    assert noise.std() == pytest.approx(7e-4 / np.sqrt(0.01), rel=4.0 / np.sqrt(2 * len(noise)))


def test_a_log_is_replayed_with_its_motion_and_surroundings():
    """The model reproduces the simulated output from the channels of the log."""
    model = GyroModel((*GYRO.terms, Term(CATALOGUE['thermal_lag'], (5.0, 1e-3)),
                       Term(CATALOGUE['warm_up'], (10.0, 0.01)),
                       Term(CATALOGUE['heading_sensitivity'], (1e-3, 0.0)),
                       Term(CATALOGUE['time_offset'], (0.02,))))
    log = simulate(model, CALIBRATION_MOTION, 50.0,
                   temperature=25.0 + 10.0 * np.sin(np.arange(1001) / 200.0))
    channels = channels_from_log(log)
    assert np.array_equal(simulate_gyro_output(
        model, log.time, channels.with_rate(log.reference_rate, log.reference_rate)), log.output)
    error = log.output - simulate(GYRO, CALIBRATION_MOTION, 50.0).output
    late = 0.9 * (CALIBRATION_MOTION.rate_at(log.time - 0.02) - log.reference_rate)
    lagging = 1e-3 * (channels.lagged('temperature', 5.0) - log.temperature)
    assert error - late - lagging == pytest.approx(
        0.01 * np.exp(-log.time / 10.0) + 1e-3 * np.sin(log.reference_heading), abs=1e-12)


def test_the_verb_simulates_what_a_gyro_makes_of_time_and_heading(tmp_path, run):
    (tmp_path / 'model.yaml').write_text('effects: {warm_up: {warm_up: 0.01, time_constant: 5}, '
                                         'quantization: {quantization: 1e-3}}')
    code, *_ = run('simulate', '--model', tmp_path / 'model.yaml', '--motion', 'rest',
                   '--out', tmp_path / 'log.csv')
    log = read_log(tmp_path / 'log.csv')
    assert code == 0 and log.output == pytest.approx(
        1e-3 * np.round(10.0 * np.exp(-log.time / 5.0)), abs=1e-12)
