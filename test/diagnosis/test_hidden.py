# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The generator of hidden effects: its noise, physics, sizes, and independence of the package."""

import ast
import json
import math
from pathlib import Path

from chance import evidence, seeded
from gyro_calibration.allan.deviation import allan_deviation
from gyro_calibration_bench.__main__ import main
from gyro_calibration_bench.cases import make_logs, part_cases, PARTS, random_source
import gyro_calibration_bench.hidden
from gyro_calibration_bench.hidden import (
    draw_gyro, FORMS, hide, hide_look_alike, KINDS, LOOK_ALIKES, NoiseFigures, record_separating,
    session)
from gyro_calibration_bench.hidden.effects import COUNTED_FAULTS, effect_errors, STEP_EFFECTS
from gyro_calibration_bench.hidden.log import ALL
from gyro_calibration_bench.hidden.noise import (
    draw_figures, generate_noise, markov_processes, Whitening)
from gyro_calibration_bench.hidden.size import InformationMetric
from gyro_calibration_bench.scores import score_case, wilson_interval
import numpy as np
import pytest

FOLDER = Path(gyro_calibration_bench.hidden.__file__).parent
COARSE = {'duration': 300.0, 'sample_rate': 20.0}


@pytest.fixture(params=['', evidence('another seed')])
def generator(request):
    """Return a source of random numbers: by the name of the test, or another each time."""
    return seeded(request.node.name, bool(request.param))


def test_nothing_of_the_package_is_imported():
    for path in FOLDER.glob('*.py'):
        nodes = list(ast.walk(ast.parse(path.read_text())))
        roots = {alias.name.split('.')[0] for node in nodes if isinstance(node, ast.Import)
                 for alias in node.names}
        roots |= {node.module.split('.')[0] for node in nodes if isinstance(node, ast.ImportFrom)}
        assert roots <= {'__future__', 'collections', 'dataclasses', 'gzip', 'io', 'math',
                         'gyro_calibration_bench', 'numpy', 'pathlib', 'scipy', 'typing'}, path


@pytest.mark.parametrize('figures, expected, tolerance', [
    (NoiseFigures(1e-3), lambda tau: 1e-6 / tau, 0.08),
    (NoiseFigures(1e-9, rate_random_walk=1e-3), lambda tau: 1e-6 * tau / 3.0, 0.1),
    (NoiseFigures(1e-9, 1e-3), lambda tau: 2.0 * math.log(2.0) / math.pi * 1e-6, 0.1)],
                         ids=['white', 'walk', 'flicker'])
def test_the_noise_has_the_allan_variance_of_ieee_952(generator, figures, expected, tolerance):
    times = np.array([1.6, 6.4, 12.8])
    records = [np.sum(generate_noise(figures, 20_000, 0.1, generator), axis=0) for _ in range(40)]
    found = np.mean([allan_deviation(each, 0.1, times).deviation ** 2 for each in records], axis=0)
    assert found == pytest.approx(expected(times) + 0.0 * times, rel=tolerance)


@pytest.mark.parametrize('encoder_step', [0.0, 1e-3])
def test_whitening_is_the_inverse_of_the_dense_covariance(generator, encoder_step):
    figures, count, interval = NoiseFigures(1e-4, 3e-4, 1e-4, 4e-4, 1.0), 300, 0.02
    covariance = np.eye(count) * figures.sample_deviation(interval) ** 2
    for process in markov_processes(figures, count, interval):
        innovations = np.full(count, process.innovation ** 2)
        innovations[0] = process.first_deviation ** 2
        answer = np.linalg.inv(np.eye(count) - np.diag(np.full(count - 1, process.factor), -1))
        covariance += answer * innovations @ answer.T
    difference = (np.eye(count) - np.eye(count, k=-1)) / interval
    difference[0] = 0.0
    covariance += difference @ difference.T * encoder_step ** 2 / 12.0
    signal = generator.standard_normal(count)
    expected = np.linalg.solve(covariance, signal)
    found = Whitening(figures, count, interval, encoder_step).solve(signal)
    assert found == pytest.approx(expected, abs=1e-9 * abs(expected).max())


#: Each effect with some kinds of noise; with the others it is tried as evidence.
DETECTABLE = [(evidence if (place + row) % 3 else pytest.param)(kind, name)
              for place, kind in enumerate(KINDS) for row, name in enumerate(
                  ['warm_up', 'heading_sensitivity', 'cubic_nonlinearity'])]


@pytest.mark.parametrize('kind, name', DETECTABLE)
def test_a_detectable_effect_is_found_with_the_promised_scatter_and_power(generator, kind, name):
    each, figures = session(generator, 300.0, 10.0), draw_figures(kind, generator)
    cause = draw_gyro([name], 1.0, generator, [each], figures).causes[0]
    metric = InformationMetric([each], figures)
    column = effect_errors(FORMS[name], 1.0, cause.shapes, [each])
    hidden, scale = cause.size * column[0] + 0.01 + 0.02 * each.rate, 1e-9 + abs(cause.size)
    noises = [hidden + np.sum(generate_noise(figures, len(each.time), each.interval, generator),
                              axis=0) for _ in range(150)]
    gram = metric.gram([column, *([noise] for noise in noises)])
    estimates = gram[0, 1:] / gram[0, 0]
    assert np.std(estimates) / scale == pytest.approx(cause.standard_deviation / scale, rel=0.25)
    assert np.mean(estimates) / scale == pytest.approx(cause.size / scale, abs=0.1)
    # one-sided beyond 3.5 sigma: the power at 4.8 is 0.90, and 150 trials scatter by 0.025
    assert np.mean(np.abs(estimates) > 3.5 * cause.standard_deviation) > 0.8


@pytest.mark.parametrize('name', ALL)
def test_every_effect_can_be_hidden(generator, name):
    log, = hide([name], 2.0, generator, noise='white', **COARSE)
    cause, truth = log.truth[name], log.truth
    assert all(np.isfinite(column).all() and len(column) == len(truth.rate)
               for column in log.columns.values())
    assert ((np.diff(log.columns['time_s']) > 0.0).all() and math.isfinite(cause.size)
            and all(map(math.isfinite, cause.shapes.values())))
    if name not in (*COUNTED_FAULTS, *STEP_EFFECTS, 'unit_error') and ALL[name].stage != 'noise':
        # a dead zone and a saturation grow by whole samples
        assert cause.multiple == pytest.approx(2.0, rel=0.5 if name in ('dead_zone', 'saturation')
                                               else 0.05)
    residual = (log.columns['gyro_rad_s'] - truth.prediction)[truth.is_good]
    unit, step = abs(truth.gyro.size_of('unit_error') or 1.0), truth.gyro.size_of('quantization')
    assert np.std(residual) <= 1.5 * unit * np.std(truth.noise) + step


def left_over(hidden_name, other, log, sessions, twins):
    """Return the sigmas of a hidden twin left by the other, by a search over nonlinear sizes."""
    cause, metric = log.truth[hidden_name], InformationMetric(sessions, log.truth.gyro.figures)
    known = ('bias', 'scale') if twins.needs_model else ()
    hidden = effect_errors(ALL[hidden_name], cause.size, cause.shapes, sessions)
    shapes = (twins.fixed_parts(sessions) if twins.fixed_parts else {}).get(other, {})
    if ALL[other].is_linear:
        phases = ([{'phase': 0.0}, {'phase': 0.5 * math.pi}]
                  if other in ('heading_sensitivity', 'reference_once_per_rev') else [{}])
        columns = [effect_errors(ALL[other], 1.0, {**shapes, **phase}, sessions)
                   for phase in phases]
        gram = metric.gram([hidden, *columns], known)
        scale = np.sqrt(np.diag(gram))
        gram = gram / np.outer(scale, scale)
        share = gram[0, 1:] @ np.linalg.pinv(gram[1:, 1:], hermitian=True) @ gram[1:, 0]
        return scale[0] * math.sqrt(max(0.0, 1.0 - share))
    guess = {'sine_response': math.sqrt(6.0 * abs(cause.size))}.get(other, abs(cause.size))
    sizes = guess * np.geomspace(0.5, 2.0, 61)
    return min(metric.norm(
        [a - b for a, b in zip(hidden, effect_errors(ALL[other], size, shapes, sessions))], known)
               for size in sizes)


@pytest.mark.parametrize('pair', LOOK_ALIKES, ids='-'.join)
@pytest.mark.parametrize('first', [True, evidence(False)], ids=['first', 'second'])
def test_twins_are_alike_and_then_distinguished(generator, pair, first):
    name, other = pair if first else reversed(pair)
    log = hide_look_alike(pair, name, generator, duration=600.0, sample_rate=20.0)
    assert left_over(name, other, log, [log.session], LOOK_ALIKES[pair]) < 3.0
    if LOOK_ALIKES[pair].separating_conditions is None:
        with pytest.raises(ValueError, match='another reference'):
            record_separating(pair, log, generator)
        return
    again = record_separating(pair, log, generator)
    assert again.truth.gyro == log.truth.gyro
    assert left_over(name, other, log, [log.session, again.session], LOOK_ALIKES[pair]) > 4.2


# The benchmark: its cases, and how answers are scored

TRUTH = {'part': 'sets', 'look_alikes': ['bias_temperature', 'rate_ramp'], 'allowed': [],
         'causes': [{'name': 'rate_ramp', 'size': 2e-6, 'shapes': {}, 'unit': 'rad/s²',
                     'minimum_detectable': 5e-7, 'multiple': 4.0}]}
BOTH = {'effect': 'bias_temperature', 'ambiguous_with': ['rate_ramp']}
ALONE = {'effect': 'rate_ramp', 'size': 2.1e-6, 'interval': [1.9e-6, 2.3e-6]}


@pytest.fixture(scope='module')
def made(tmp_path_factory):
    made = tmp_path_factory.mktemp('bench')
    assert main(['make', str(made), '--seed', '3', '--cases', '1', '--part', 'separated']) == 0
    return made


def test_cases_do_not_tell_what_is_hidden_and_both_logs_are_there(made):
    public = json.loads((made / 'cases.json').read_text())
    truth = json.loads((made / 'truth.json').read_text())
    assert [*public['cases']] == [*truth['cases']] == ['0000']
    assert public['cases']['0000']['logs'] == ['0000a.csv.gz', '0000b.csv.gz']
    assert set(public['cases']['0000']) == {'logs', 'model'}
    assert all((made / log).exists() for log in public['cases']['0000']['logs'])


def test_an_answer_is_scored_from_its_file(made, tmp_path, capsys):
    truth = json.loads((made / 'truth.json').read_text())['cases']['0000']
    answers = tmp_path / 'answers.json'
    right = {'causes': [{'effect': truth['causes'][0]['name']}]}
    for given, expected in ({'0000': right}, 1), ({}, 0):
        answers.write_text(
            json.dumps({'schema': 'gyro_calibration_bench/answers/1', 'answers': given}))
        capsys.readouterr()
        assert main(['score', str(made), str(answers), '--json']) == 0
        counts = json.loads(capsys.readouterr().out)['separated']['right']
        assert (counts['good'], counts['of']) == (expected, 1)
    answers.write_text('{"answers": {}}')
    assert main(['score', str(made), str(answers)]) == 2
    assert 'schema' in capsys.readouterr().err


@pytest.mark.parametrize('part, causes, right', [
    ('sets', [BOTH], True), ('sets', [ALONE], False), ('sets', [BOTH, ALONE], False),
    ('separated', [ALONE], True), ('separated', [BOTH], False), ('separated', [], False)])
def test_look_alikes_are_both_named_until_a_log_separates_them(part, causes, right):
    assert score_case({**TRUTH, 'part': part}, {'causes': causes}).is_right == right


def test_intervals_are_those_of_wilson():
    # (k + z²/2 -+ z sqrt(k (n - k) / n + z²/4)) / (n + z²), by hand for 9 of 10
    assert wilson_interval(9, 10) == pytest.approx((0.5958, 0.9821), abs=1e-4)


def test_a_case_is_random_by_its_name_and_the_seed():
    case = next(part_cases('nothing', 1))
    first, again, other = (make_logs(case, random_source(case, seed))[0].columns['gyro_rad_s']
                           for seed in (1, 1, 2))
    assert np.array_equal(first, again) and not np.array_equal(first, other)
    assert all(len({str(each) for each in part_cases(part, 2)}) == len([*part_cases(part, 2)])
               for part in PARTS)
