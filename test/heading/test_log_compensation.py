# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Compensation of logs with surroundings: in one piece, in blocks, and as a stream."""

from dataclasses import replace

from gyro_calibration.heading.integration import integrate
from gyro_calibration.heading.log_compensation import compensate_log, LogCompensation, rows_of
from gyro_calibration.logs.log import Log, read_log
from gyro_calibration.model.channels import channels_from_log
from gyro_calibration.model.effects import CATALOGUE
from gyro_calibration.model.gyro_model import GyroModel, Term
from gyro_calibration.model.motion import simulate_gyro_output
import numpy as np
import pytest

VALUES = {'bias': (0.01,), 'scale_factor_error': (0.02,), 'bias_temperature_rate': (10.0, 0.05),
          'thermal_lag': (120.0, -2e-3), 'thermal_hysteresis': (10.0, 2e-3, 3e-4),
          'warm_up': (300.0, 0.004), 'rate_ramp': (2e-7,), 'bias_step': (200.0, -1e-3),
          'acceleration_sensitivity': (1e-4,), 'vibration_rectification': (1.0, 2e-4),
          'supply_sensitivity': (5.0, 4e-4), 'interference_tone': (0.07, 3e-4, -2e-4)}
HEADING = {'heading_sensitivity': (1e-3, -5e-4)}
TIME = np.arange(0.0, 900.0, 0.05) + np.random.default_rng(0).uniform(0.0, 0.02, 18000)


def model_of(values, **more):
    return GyroModel(tuple(Term(CATALOGUE[name], each) for name, each in values.items()), **more)


def drive(model, motion=lambda time: 0.5 * np.sin(time / 7.0)):
    """Return a log of a gyro that is driven, heated and cooled, and shaken."""
    rate = motion(TIME)
    force = np.random.default_rng(1).standard_normal(len(TIME))
    log = Log(output=rate, time=TIME, temperature=30.0 + 15.0 * np.abs(1.0 - TIME / 300.0),
              reference_rate=rate, reference_heading=integrate(TIME, rate),
              supply=5.0 + 0.2 * np.sin(TIME / 40.0),
              specific_force=np.where(TIME > 400.0, 2.0, 0.1) * force)
    channels = channels_from_log(log).with_rate(rate, rate)
    return replace(log, output=simulate_gyro_output(model, TIME, channels))


def in_blocks(model, log, size):
    compensation = LogCompensation(model)
    parts = [compensation.add(rows_of(log, np.arange(len(log))[first:first + size]))
             for first in range(0, len(log), size)]
    return np.concatenate([part.rate for part, _ in parts]), np.hstack([each for _, each in parts])


@pytest.mark.parametrize('size', [1, 700, 5000])
def test_blocks_are_compensated_as_the_whole(size):
    model = model_of(VALUES | HEADING, covariance=np.eye(16) * 1e-10)
    log = drive(model)
    if size == 1:
        log = rows_of(log, np.arange(600))
    whole, sensitivity = LogCompensation(model).add(log)
    rates, sensitivities = in_blocks(model, log, size)
    np.testing.assert_allclose(rates, whole.rate, rtol=0.0, atol=1e-13)
    np.testing.assert_allclose(sensitivities, sensitivity, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize('size', [500, 700, 5000, 18000])
def test_a_reference_heading_that_is_lost_for_long_goes_on_by_the_rates_in_blocks_as_in_one_piece(
        size):
    model = model_of(HEADING | {'scale_factor_error': (0.01,)})
    log = drive(model)
    turned = replace(log, reference_heading=1.5 + log.reference_heading)
    output = simulate_gyro_output(
        model, TIME, channels_from_log(turned).with_rate(log.reference_rate, log.reference_rate))
    lost = (TIME > 0.1) & (TIME < 0.2) | (TIME > 100.0) & (TIME < 400.1) | (TIME > 800.0)
    log = replace(turned, output=output,
                  reference_heading=np.where(lost, np.nan, turned.reference_heading))
    assert in_blocks(model, log, size)[0] == pytest.approx(log.reference_rate, abs=1e-6)


def test_rows_without_output_are_left_out(tmp_path, compensate):
    model = model_of(VALUES | HEADING)
    log = drive(model)
    done = compensate(replace(log, output=np.where(np.arange(len(log)) % 1000 == 7, np.nan,
                                                   log.output)), model)
    rate = done.columns['rate_rad_s']
    assert '18 rows have no output' in done.text and 'no reference heading' not in done.text
    assert np.nanmax(np.abs(done.columns['heading_rad'] - done.log.reference_heading)) < 1e-3
    assert np.isnan(rate).sum() == 18 and np.nanmax(np.abs(rate - log.reference_rate)) < 1e-3
    assert np.array_equal(compensate_log(model, read_log(tmp_path / 'log.csv')), rate,
                          equal_nan=True)


def test_the_verb_says_what_it_lacks_and_what_it_cannot_undo(compensate):
    model = model_of({'supply_sensitivity': (5.0, 1e-4), 'time_offset': (0.02,),
                      'heading_sensitivity': (0.0, 0.0), 'saturation': (1.0,)})
    done = compensate(replace(drive(GyroModel()), supply=None, reference_heading=None), model)
    assert done.code == 0 and all(words in done.text
                                  for words in ('no supply voltage', 'no reference heading',
                                                'saturation: An output at the limit'))


@pytest.mark.parametrize('name, value',
                         [('time_offset', 0.03), ('time_offset', -0.03), ('clock_rate', 2e-3)])
def test_rates_and_headings_of_a_late_gyro_stand_beside_the_reference_of_their_time(
        compensate, name, value):
    """Across block borders too; rates between samples are linear, and the ends are left out."""
    model, time = model_of({name: (value,)}), np.arange(70_000) * 0.01
    rate = np.sin(1.3 * time)
    log = Log(output=rate, time=time + 50.0, reference_rate=rate,
              reference_heading=(1.0 - np.cos(1.3 * time)) / 1.3)
    log = replace(log, output=simulate_gyro_output(model, time,
                                                   channels_from_log(log).with_rate(rate, rate)))
    done, inside = compensate(log, model), slice(10, -200)
    assert 'true_time' not in done.columns
    assert (np.abs(done.columns['rate_rad_s'] - rate)[inside].max() < 1e-4
            < np.abs(log.output - rate).max())
    assert np.ptp((done.columns['heading_rad'] - done.log.reference_heading)[inside]) < 5e-4
