# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Effects of the user's own: a file that the command line names adds them to the catalogue."""

import json
import math

from gyro_calibration.diagnosis.causes import CAUSES
from gyro_calibration.model.effects import CATALOGUE, USER_EFFECTS
import pytest

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
