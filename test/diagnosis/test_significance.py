# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The rules by which causes are named: confirmation, detectable sizes, sets."""

import math

from gyro_calibration.diagnosis.causes import cause_finding, cause_parameters, value_finding
from gyro_calibration.diagnosis.findings import Estimate
from gyro_calibration.diagnosis.significance import (
    detectable_sigmas, MIN_PREDICTION_SIGMAS, prediction_sigmas, probabilities)
import numpy as np
import pytest
from scipy.stats import norm

SIZE = {'warm_up': Estimate.from_half_width(1.0, 0.5, 'rad/s')}


def test_no_single_stretch_confirms_a_cause_and_several_do():
    assert prediction_sigmas(np.array([1e6, *np.zeros(19)])) < MIN_PREDICTION_SIGMAS
    assert prediction_sigmas(np.array([*np.ones(4), 0.9])) > MIN_PREDICTION_SIGMAS
    assert prediction_sigmas(np.array([-1.0, 0.5])) == 0.0


def test_gains_of_noise_confirm_as_often_as_the_level_allows():
    gains = np.random.default_rng(0).standard_normal((4000, 30))
    assert np.mean([prediction_sigmas(each) > MIN_PREDICTION_SIGMAS
                    for each in gains]) == pytest.approx(0.05, abs=0.02)


def test_an_effect_of_the_detectable_size_is_found_in_95_percent():
    size = detectable_sigmas(0.01)
    assert norm.sf(norm.isf(0.005) - size) == pytest.approx(0.95)


def test_members_of_a_set_have_probabilities_by_their_deficits():
    found = probabilities({'one': 1.0, 'other': 0.0})
    assert [*found] == ['other', 'one'] and sum(found.values()) == pytest.approx(1.0)
    assert found['other'] / found['one'] == pytest.approx(math.e)


def test_a_finding_holds_its_set_the_experiment_and_how_sure_it_is():
    found = cause_finding('warm_up', SIZE, 0.0, {'rate_ramp': 0.0, 'warm_up': 0.5}, False,
                          {'long': 20.0}, 4.0, ['bias_temperature'])
    assert found.ambiguous_with == ('rate_ramp', 'bias_temperature')
    assert {*found.probability} == {'warm_up', 'rate_ramp'} and found.p_value > 0.0
    assert found.minimum_detectable == pytest.approx(4.0 * SIZE['warm_up'].deviation)
    assert 'rest for 20 min' in found.separate_by and found.status == 'suspected'


def test_sine_and_cosine_are_amplitude_and_phase():
    found = cause_parameters('heading_sensitivity', np.array([3.0, 4.0]), 0.01 * np.eye(2), {})
    amplitude, phase = found['heading_sensitivity'], found['phase']
    assert amplitude.estimate == 5.0 and amplitude.deviation == pytest.approx(0.1)
    assert phase.estimate == pytest.approx(math.atan2(4.0, 3.0))
    assert phase.deviation == pytest.approx(0.02)


def test_a_value_within_its_scatter_is_no_finding():
    assert value_finding('bias', 2.0, 1.0, 0.01) is None
    assert value_finding('bias', 3.0, 1.0, 0.01, freedom=3.0) is None
    found = value_finding('bias', 3.0, 1.0, 0.01, max_half_width=1.0)
    assert found.parameters['bias'].interval == (2.0, 4.0)
