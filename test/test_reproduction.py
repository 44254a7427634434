# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The sources reproduced: numbers of contradictions follow by hand, and verdicts can fail."""

from functools import cache
import json
from pathlib import Path

from chance import evidence
from gyro_calibration.cli.main import main
from gyro_calibration_reproduction import SOURCES
from gyro_calibration_reproduction.finding import Comparison, render_page
import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
#: One source; the others, which take some seconds, are run as evidence.
one_source = pytest.mark.parametrize('source', [
    source if source == 'ojeda' else evidence(source) for source in SOURCES])
#: Number of simulated drives; the verb and the documents use 200, which takes half a minute.
FEW, MANY = 25, 200


@cache
def reproduced(source, runs):
    return SOURCES[source](np.random.default_rng(0), runs)


def numbers(source, words):
    """Return the numbers of the contradiction whose sentence holds these words."""
    found, = (each.numbers
              for each in reproduced(source, FEW).contradictions if words in each.sentence)
    return found


@pytest.mark.parametrize('published, value, verdict', [
    ('4.8', 4.849, 'reproduced'), ('4.8', 4.851, 'differs'), ('< 2', 1.9, 'reproduced'),
    ('< 2', 2.1, 'differs'), ('~ 10', 30.0, 'reproduced'), ('~ 10', 33.0, 'differs'),
    ('~ 10', -10.0, 'differs'), ('', 1.0, ''),
])
def test_a_verdict_is_what_the_last_digit_allows(published, value, verdict):
    assert Comparison('', '', value, published).verdict == verdict
    if verdict == 'differs':
        assert (Comparison('', '', value, published, own_figures=True).verdict
                == 'contradicts itself')
    # of ours, the uncertainty counts
    assert Comparison('', '', 5.0, '4.8', uncertainty=0.2).is_reproduced
    assert not Comparison('', '', 1.9, '< 2', uncertainty=0.2).is_reproduced


@one_source
def test_the_page_holds_what_the_program_prints(source):
    shown = (ROOT / 'docs/explanation/reproduction.md').read_text()
    assert render_page(reproduced(source, MANY)) in shown, (
        'run gyro_calibration reproduce and put it there')


@one_source
def test_the_same_seed_gives_the_same_numbers_and_another_others(source, capsys, monkeypatch):
    few = {source: lambda generator: SOURCES[source](generator, 2)}
    monkeypatch.setattr('gyro_calibration.cli.reproduce.SOURCES', few)
    answers = []
    for seed in (1, 1, 2):
        assert main(['reproduce', source, '--seed', str(seed), '--json']) == 0
        text, error = capsys.readouterr()
        assert not error, 'the progress bar is for terminals'
        answers.append(json.loads(text)['sources'])
    assert answers[0] == answers[1] != answers[2]
    assert {'quantity', 'unit', 'published', 'ours', 'verdict'} <= set(
        answers[0][source]['comparisons'][0])


@pytest.mark.parametrize('source, words, wanted', [
    ('ojeda', 'unit of an angle', {'printed': 10, 'right': 1}),
    ('hong_park', 'Eq. 8', {'first': -0.1 / 0.9, 'second': 1 / 0.9, 'right_first': 1 / 0.9,
                            'right_second': -0.1 / 0.9}),
    ('hong_park', '120 deg in 160 s', {'drift': 120, 'mean': 60, 'published': 1.6675, 'fits': 2}),
    ('bot_thoughts', 'a strobe at 59.8 Hz', {
        'off': 100 * 0.2 / 60, 'slopes': (100 * 0.2 / 60, 0.02), 'left': (0.972, 0.001),
        'corrected': -14.309 * 60 / 59.8, 'nominal': (-0.003, 0.0005), 'crystal': 0.008})])
def test_numbers_of_the_contradictions_follow_by_hand(source, words, wanted):
    """To six digits, or to an absolute error."""
    found = numbers(source, words)
    for name, value in wanted.items():
        value, error = value if isinstance(value, tuple) else (value, None)
        assert found[name] == pytest.approx(value, rel=None if error else 1e-6, abs=error), name
