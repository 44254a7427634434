# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Causes: all that the catalogue of effects lists can be named, also effects of the user's own."""

import json
import math
import re
import zlib

from diagnosed import diagnosis_of, log_of
from gyro_calibration.diagnosis.candidates import observed_range
from gyro_calibration.diagnosis.causes import (
    add_remedies, cause_parameters, CAUSES, next_experiment, sized_finding, value_finding)
from gyro_calibration.diagnosis.findings import MIN_PREDICTION_SIGMAS, prediction_sigmas
from gyro_calibration.diagnosis.replay import replay
from gyro_calibration.logs.log import QUANTITIES
from gyro_calibration.model.effects import CATALOGUE, USER_EFFECTS
from gyro_calibration.model.gyro_model import GyroModel, Term
from gyro_calibration_bench.hidden import hide
from gyro_calibration_bench.hidden.conditions import hide_look_alike, LOOK_ALIKES
import numpy as np
import pytest


def test_a_cause_has_units_and_a_variable_along_which_it_shows():
    for name, cause in CAUSES.items():
        assert cause.name == name and cause.units and cause.along
        assert re.match(r'[A-Z].*\.$', cause.sentence), name
        assert (cause.required_channels <= {*QUANTITIES, 'reference'}
                and cause.origin in {'gyro', 'reference', 'record', 'noise'}), name
    assert len({cause.sentence for cause in CAUSES.values()}) == len(CAUSES)


#: Words of the experiment for each pair of twins, in their order.
WANTED = dict(zip(LOOK_ALIKES, ['heat and cool', 'heat and cool', 'rest for', 'whole turns',
                                'at eight speeds', 'motor', 'axis up, level, down', 'beyond',
                                'quick reversals', 'abrupt changes', 'abrupt changes', 'again',
                                'again', 'step the supply', 'axis up', 'whole turns']))


@pytest.fixture(name='laid', scope='module')
def _laid():
    log = log_of(hide(['bias'], 1.0, np.random.default_rng(3), sample_rate=20.0,
                      conditions={'top_rate': 2.0})[0])
    return replay(log, np.ones(len(log), bool), np.random.default_rng(1))


@pytest.mark.parametrize('pair', LOOK_ALIKES, ids='-'.join)
def test_twins_are_given_the_experiment_that_physics_wants_in_either_order(pair, laid):
    for one, other in (pair, pair[::-1]):
        words = next_experiment(one, [(other, 2.0)], observed_range(
            [laid.channels.rate], [laid.channels.temperature], laid.duration))
        assert WANTED[pair] in words
        assert f'{other.replace("_", " ")} by 2.0 sigma, 2 such logs together by 2.8' in words


def test_a_set_that_is_found_has_its_experiment():
    pair = ('bias_temperature', 'warm_up')
    generator = np.random.default_rng(zlib.crc32(b'a set'))
    found = diagnosis_of([hide_look_alike(pair, pair[0], generator, sample_rate=10.0)], generator)
    (finding,) = found.findings
    assert {finding.effect, *finding.ambiguous_with} >= set(pair)
    assert 'heat and cool it twice' in finding.separate_by and 'sigma' in finding.separate_by
    assert all(CAUSES[name].separate_by for name in finding.ambiguous_with)


def test_gains_of_noise_confirm_as_often_as_the_level_allows():
    gains = np.random.default_rng(0).standard_normal((4000, 30))
    assert np.mean([prediction_sigmas(each) > MIN_PREDICTION_SIGMAS
                    for each in gains]) == pytest.approx(0.05, abs=0.02)


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


# Effects of the user's own: a file that the command line names adds them to the catalogue

OWN = """
import numpy as np

from gyro_calibration.model.effects import Effect, Parameter


def twice_per_turn(channels):
    return np.sin(2.0 * channels.heading), np.cos(2.0 * channels.heading)


EFFECTS = [Effect('soft_iron', 'The bias changes twice per turn, as by soft iron nearby.',
                  frozenset({'heading'}),
                  (Parameter('sine', 'rad/s'), Parameter('cosine', 'rad/s')), twice_per_turn,
                  along='heading')]
"""
MODEL = """
effects: {bias: {bias: 1.0e-3}, soft_iron: {sine: 2.0e-3, cosine: -1.0e-3}}
noise: {angle_random_walk: 1.0e-4}
"""
PROFILE = 'time_s,rate_dps\n0,0\n10,0\n12,20\n100,20\n104,-35\n200,-35\n204,12\n290,12\n300,0\n'


@pytest.fixture
def own(tmp_path):
    """Return a file with an effect of one's own, and forget that effect in the end."""
    (tmp_path / 'own.py').write_text(OWN)
    yield tmp_path / 'own.py'
    for known in (USER_EFFECTS, CATALOGUE, CAUSES):
        known.pop('soft_iron', None)


def test_an_effect_of_ones_own_is_simulated_found_and_compensated(own, tmp_path, run):
    (tmp_path / 'real.yaml').write_text(MODEL)
    (tmp_path / 'profile.csv').write_text(PROFILE)
    log, catalogue = tmp_path / 'log.csv', ['--catalogue', own]
    assert run('simulate', '--model', tmp_path / 'real.yaml', '--motion', tmp_path / 'profile.csv',
               '--sample-rate', '20', '--seed', '4', '--out', log, *catalogue)[0] == 0
    code, text, error = run('diagnose', log, '--out', tmp_path / 'out', '--json', *catalogue)
    assert code == 0, error
    finding, = json.loads(text)['findings']
    assert finding['effect'] == 'soft_iron' and finding['status'] == 'established'
    low, high = finding['parameters']['soft_iron']['ci95']
    assert low - 1e-4 < math.hypot(2e-3, 1e-3) < high + 1e-4 and high - low < 1e-3
    assert run('compensate', log, '--model', tmp_path / 'out/model.yaml', '--out',
               tmp_path / 'compensated.csv', *catalogue)[0] == 0


def test_without_its_file_a_model_with_such_an_effect_is_refused(tmp_path, run):
    (tmp_path / 'real.yaml').write_text(MODEL)
    code, _, error = run('simulate', '--model', tmp_path / 'real.yaml', '--motion', 'robot',
                         '--out', tmp_path / 'log.csv')
    assert code == 2 and '--catalogue' in error


@pytest.mark.parametrize('text, message', [
    (None, 'not a Python file'), ('EFFECTS = [1]', '1 is not an Effect'), ('x = 1', 'EFFECTS'),
    ('1 / 0', 'ZeroDivisionError'),
    (OWN.replace("'soft_iron'", "'bias'"), 'the name bias is taken'),
    (OWN.replace('return np.sin(2.0 * channels.heading), ', 'return '), 'coefficients')])
def test_a_file_that_cannot_be_used_is_refused_in_one_sentence(text, message, tmp_path, run):
    if text is not None:
        (tmp_path / 'own.py').write_text(text)
    code, _, error = run('allan', 'log.csv', '--catalogue', tmp_path / 'own.py')
    assert code == 2 and message in error and error.count('\n') == 1


def test_a_cause_that_the_model_does_not_contain_has_a_remedy_too():
    found = sized_finding('dead_zone', 0.01, 0.001, 1e-9)
    inside = GyroModel((Term(CATALOGUE['dead_zone'], (0.01,)),))
    remedies = {add_remedies([found], {}, model)[0].remedy for model in (inside, GyroModel())}
    assert len(remedies) == 2 and all(remedies)
