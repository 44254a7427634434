# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Noise that a filter or rounding shaped passes for no cause, and hides none."""

from dataclasses import replace

from diagnosed import described as told
from diagnosed import log_of, model_of
from gyro_calibration.diagnosis.pipeline import diagnose
from gyro_calibration.logs.log import Log
from gyro_calibration.model.effects import QUANTIZATION
from gyro_calibration.model.gyro_model import GyroModel, Term
from gyro_calibration.model.noise import Noise
from gyro_calibration_bench.hidden import hide
import numpy as np
import pytest
from scipy.signal import butter, lfilter

#: Numerator and denominator.
FILTERS = {'exponential smoothing': ([0.5], [1.0, -0.5]), 'mean of two': ([0.5, 0.5], [1.0]),
           'low pass': butter(2, 0.3)}
ANGLE_RANDOM_WALK = 1e-4
SHORT = {'duration': 600.0, 'sample_rate': 25.0}


def behind(filter, names=(), multiple=0.0, seed=0):
    """Return what is hidden, and its log with noise that went through a filter."""
    hidden, = hide(names, multiple, np.random.default_rng(seed), noise='white', **SHORT)
    noise = hidden.truth.noise
    log = log_of(hidden)
    return hidden, replace(log, output=log.output - noise + lfilter(*FILTERS[filter], noise))


#: The other filters are tried as evidence: a log takes some seconds.
TRIED = 'exponential smoothing'


def tried(filter, *others):
    return pytest.param(filter, *others, marks=[] if filter == TRIED else pytest.mark.evidence)


@pytest.mark.parametrize('filter', map(tried, FILTERS))
def test_noise_behind_a_filter_is_no_cause(filter):
    hidden, log = behind(filter)
    found = diagnose([log], np.random.default_rng(0), model_of(hidden))
    assert found.verdict == 'adequate', told(hidden, found)


def test_the_angle_random_walk_behind_a_filter_is_that_of_low_frequencies():
    hidden, log = behind('exponential smoothing')
    found = diagnose([log], np.random.default_rng(0))
    assert found.noise.angle_random_walk == pytest.approx(
        hidden.truth.expected['angle_random_walk'], rel=0.05)


@pytest.mark.parametrize('filter, name',
                         map(tried, FILTERS, ['time_offset', 'interference_tone', 'time_offset']))
def test_what_is_hidden_in_noise_behind_a_filter_is_found(filter, name):
    hidden, log = behind(filter, [name], 8.0, 1)
    found = diagnose([log], np.random.default_rng(0))
    (finding,) = found.findings
    assert name in (finding.effect, *finding.ambiguous_with), told(hidden, found)
    assert not found.unexplained, told(hidden, found)


# rounding

def rounded(step, known):
    """Return a log with steps of so many standard deviations, and what is found in it."""
    generator = np.random.default_rng(3)
    time = np.arange(20_000) / 50.0
    white = ANGLE_RANDOM_WALK / np.sqrt(0.02)
    rate = 0.8 * np.sin(0.3 * time) * np.sin(0.041 * time)
    output = (np.round((rate + white * generator.standard_normal(len(time))) / (step * white))
              * step * white)
    model = GyroModel((Term(QUANTIZATION, (step * white,)),) if known else (),
                      noise=Noise(ANGLE_RANDOM_WALK))
    return diagnose([Log(time=time, output=output, reference_rate=rate)], generator, model)


@pytest.mark.parametrize('step', [0.6, 1.5, 3.0])
def test_the_steps_that_a_model_has_are_no_angle_random_walk(step):
    found = rounded(step, True)
    assert not found.findings
    assert found.noise.angle_random_walk == pytest.approx(ANGLE_RANDOM_WALK, rel=0.03)


def test_steps_that_a_model_does_not_have_are_one_finding():
    assert [each.effect for each in rounded(1.5, False).findings] == ['quantization']
