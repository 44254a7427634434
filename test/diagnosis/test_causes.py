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


def test_causes_are_the_effects_of_the_gyro_with_their_sentences_and_those_of_the_record():
    assert {name: cause.of for name, cause in CAUSES.items() if name not in CATALOGUE} == {
        **dict.fromkeys(('outliers', 'stuck_samples', 'dropped_samples', 'unit_error'), 'record'),
        **dict.fromkeys(('reference_once_per_rev', 'reference_scale', 'reference_slip',
                         'reference_quantization'), 'reference'),
        **dict.fromkeys(('angle_random_walk', 'bias_instability', 'rate_random_walk'), 'noise')}
    assert {name for name, cause in CAUSES.items() if cause.of == 'gyro'} == set(CATALOGUE)
    assert all(CAUSES[name].sentence == effect.cause for name, effect in CATALOGUE.items())


def test_a_cause_has_units_and_an_experiment_that_separates_it_from_its_confounders():
    for name, cause in CAUSES.items():
        assert cause.name == name and cause.units and cause.along
        assert re.match(r'[A-Z].*\.$', cause.sentence), name
        assert bool(cause.confounders) == bool(cause.separate_by), name
        assert all(name in CAUSES[other].confounders for other in cause.confounders), name
        assert (cause.needs <= {*QUANTITIES, 'reference'}
                and cause.of in {'gyro', 'reference', 'record', 'noise'}), name
    assert len({cause.sentence for cause in CAUSES.values()}) == len(CAUSES)


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
