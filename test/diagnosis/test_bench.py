# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.
"""The public bench: cases, answers and scores as files, and methods that answer."""

import json

from gyro_calibration_bench.__main__ import main
from gyro_calibration_bench.cases import make_logs, part_cases, PARTS, random_source
from gyro_calibration_bench.hidden import hide
from gyro_calibration_bench.methods import METHODS
from gyro_calibration_bench.scores import score_case, wilson_interval
import numpy as np
import pytest

TRUTH = {'part': 'sets', 'look_alikes': ['bias_temperature', 'rate_ramp'], 'allowed': [],
         'causes': [{'name': 'rate_ramp', 'size': 2e-6, 'shapes': {}, 'unit': 'rad/s²',
                     'minimum_detectable': 5e-7, 'multiple': 4.0}]}
BOTH = {'effect': 'bias_temperature', 'ambiguous_with': ['rate_ramp']}
ALONE = {'effect': 'rate_ramp', 'size': 2.1e-6, 'interval': [1.9e-6, 2.3e-6]}


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp('bench')
    assert main(['make', str(folder), '--seed', '3', '--cases', '1', '--part', 'separated']) == 0
    return folder


def test_cases_do_not_tell_what_is_hidden_and_both_logs_are_there(folder):
    public = json.loads((folder / 'cases.json').read_text())
    truth = json.loads((folder / 'truth.json').read_text())
    assert [*public['cases']] == [*truth['cases']] == ['0000']
    assert public['cases']['0000']['logs'] == ['0000a.csv.gz', '0000b.csv.gz']
    assert set(public['cases']['0000']) == {'logs', 'model'}
    assert all((folder / log).exists() for log in public['cases']['0000']['logs'])


def test_an_answer_is_scored_from_its_file(folder, tmp_path, capsys):
    truth = json.loads((folder / 'truth.json').read_text())['cases']['0000']
    answers = tmp_path / 'answers.json'
    right = {'causes': [{'effect': truth['causes'][0]['name']}]}
    for given, expected in ({'0000': right}, 1), ({}, 0):
        answers.write_text(
            json.dumps({'schema': 'gyro_calibration_bench/answers/1', 'answers': given}))
        capsys.readouterr()
        assert main(['score', str(folder), str(answers), '--json']) == 0
        counts = json.loads(capsys.readouterr().out)['separated']['right']
        assert (counts['good'], counts['of']) == (expected, 1)
    answers.write_text('{"answers": {}}')
    assert main(['score', str(folder), str(answers)]) == 2
    assert 'schema' in capsys.readouterr().err


@pytest.mark.parametrize('part, causes, right', [
    ('sets', [BOTH], True), ('sets', [ALONE], False), ('sets', [BOTH, ALONE], False),
    ('separated', [ALONE], True), ('separated', [BOTH], False), ('separated', [], False)])
def test_look_alikes_are_both_named_until_a_log_separates_them(part, causes, right):
    assert score_case({**TRUTH, 'part': part}, {'causes': causes}).is_right == right


def test_intervals_are_those_of_wilson():
    # (k + z²/2 -+ z sqrt(k (n - k) / n + z²/4)) / (n + z²), by hand for 9 of 10
    assert wilson_interval(9, 10) == pytest.approx((0.5958, 0.9821), abs=1e-4)


@pytest.mark.parametrize('method', ['greedy', 'lasso'])
def test_a_baseline_names_a_large_effect_with_its_size(method, tmp_path):
    log, = hide(['scale_factor_asymmetry'], 20.0, np.random.default_rng(0), noise='white',
                duration=300.0, sample_rate=25.0)
    causes, unexplained = METHODS[method]([log.write(tmp_path / 'log.csv')], None)
    cause, = (each for each in causes if each.effect == 'scale_factor_asymmetry')
    truth = log.truth['scale_factor_asymmetry']
    assert causes[0] == cause and not unexplained
    assert cause.size == pytest.approx(truth.size, abs=4.0 * truth.standard_deviation)


def test_a_case_is_random_by_its_name_and_the_seed():
    case = next(part_cases('nothing', 1))
    first, again, other = (make_logs(case, random_source(case, seed))[0].columns['gyro_rad_s']
                           for seed in (1, 1, 2))
    assert np.array_equal(first, again) and not np.array_equal(first, other)
    assert all(len({str(each) for each in part_cases(part, 2)}) == len([*part_cases(part, 2)])
               for part in PARTS)
