# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Causes: all that the catalogue of effects lists can be named."""

import re

from gyro_calibration.diagnosis.causes import CAUSES, REFERENCES
from gyro_calibration.logs.log import QUANTITIES
from gyro_calibration.model.effects import CATALOGUE
import pytest

NAMES = re.findall(r'\w+', (
    """
    bias scale_factor_error scale_factor_asymmetry quadratic_nonlinearity cubic_nonlinearity """
    """sine_response bias_temperature
    bias_temperature_quadratic scale_factor_temperature bias_temperature_rate thermal_lag """
    """thermal_hysteresis warm_up rate_ramp bias_step
    heading_sensitivity acceleration_sensitivity vibration_rectification supply_sensitivity """
    """interference_tone bandwidth time_offset
    clock_rate dead_zone saturation quantization outliers stuck_samples dropped_samples """
    """reference_once_per_rev reference_scale
    reference_slip reference_quantization unit_error angle_random_walk bias_instability """
    """rate_random_walk
"""))


def test_every_name_of_the_catalogue_is_a_cause_and_no_other():
    assert sorted(CAUSES) == sorted(NAMES)


def test_every_effect_of_the_gyro_takes_its_sentence_from_the_effects():
    assert {name for name, cause in CAUSES.items() if cause.of == 'gyro'} == set(CATALOGUE)
    assert all(CAUSES[name].sentence == effect.cause for name, effect in CATALOGUE.items())


@pytest.mark.parametrize('name', NAMES)
def test_a_cause_says_what_it_is_and_what_parts_it_from_its_twins(name):
    cause = CAUSES[name]
    assert cause.name == name and cause.sentence.endswith('.') and cause.units and cause.along
    assert bool(cause.confounders) == bool(cause.separate_by)
    assert all(name in CAUSES[other].confounders for other in cause.confounders)
    assert (cause.needs <= {*QUANTITIES, 'reference'}
            and cause.of in {'gyro', 'reference', 'record', 'noise'})


@pytest.mark.parametrize('name, needed', [
    ('bias', {'time'}), ('bias_temperature', {'time', 'temperature'}),
    ('scale_factor_temperature', {'time', 'temperature', 'reference'}),
    ('supply_sensitivity', {'time', 'supply'}), ('time_offset', {'time', 'reference'}),
    ('heading_sensitivity', {'time', 'reference'}), ('interference_tone', {'time'}),
    ('reference_quantization', {'time', 'reference_heading'})])
def test_what_a_log_must_hold_to_show_a_cause(name, needed):
    assert CAUSES[name].needs == needed


def test_a_reference_is_a_column_of_a_log():
    assert set(REFERENCES) <= set(QUANTITIES)


def test_no_sentence_is_written_twice():
    sentences = [cause.sentence for cause in CAUSES.values()]
    assert (len(set(sentences)) == len(sentences)
            and all(re.match('[A-Z]', sentence) for sentence in sentences))
