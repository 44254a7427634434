# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The sources reproduced: each number equals an independent computation, and verdicts can fail."""

from dataclasses import replace
from functools import cache
import json
import math
from pathlib import Path

from gyro_calibration.cli.main import main
from gyro_calibration.cli.reproduce import render_page
from gyro_calibration.logs.log import DEGREE
from gyro_calibration.model.gyro_model import GyroModel
from gyro_calibration.model.motion import CALIBRATION_MOTION, ROBOT_MOTION
from gyro_calibration_reproduction import bot_thoughts, hong_park, SOURCES
from gyro_calibration_reproduction import ojeda_chung_borenstein as ojeda
from gyro_calibration_reproduction.finding import Comparison
import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
each_source = pytest.mark.parametrize('source', SOURCES)
#: One source; the others, which take some seconds, are run as evidence.
one_source = pytest.mark.parametrize('source', [
    pytest.param(source, marks=[] if source == 'ojeda' else pytest.mark.evidence)
    for source in SOURCES])


#: Number of simulated drives; the verb and the documents use 200, which takes half a minute.
FEW, MANY = 25, 200


@cache
def reproduced(source, runs=FEW):
    return SOURCES[source](np.random.default_rng(0), runs)


def ours(source, quantity, runs=FEW):
    found = [each for each in reproduced(source, runs).comparisons if each.quantity == quantity]
    assert len(found) == 1, [each.quantity for each in reproduced(source, runs).comparisons]
    return found[0]


def numbers(source, words, runs=FEW):
    """Return the numbers of the contradiction whose sentence holds these words."""
    found = [each.numbers
             for each in reproduced(source, runs).contradictions if words in each.sentence]
    assert len(found) == 1, words
    return found[0]


# verdicts

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


def test_the_uncertainty_of_ours_counts():
    assert (Comparison('', '', 5.0, '4.8', uncertainty=0.2).is_reproduced
            and not Comparison('', '', 5.0, '4.8', uncertainty=0.1).is_reproduced)
    assert not Comparison('', '', 1.9, '< 2', uncertainty=0.2).is_reproduced


@one_source
def test_a_wrong_published_value_does_not_come_out(source):
    wrong = [replace(each, published=f'{3.0 * each.published_value + 7.0:.3f}')
             for each in reproduced(source, FEW).comparisons
             if each.verdict == 'reproduced' and each.published[0] not in '<~']
    assert len(wrong) > 2 and not [each for each in wrong if each.is_reproduced]


@pytest.mark.parametrize('source, contradicting', [
    ('ojeda', ['data sets, every 10 deg/s and 2 K']),
    ('hong_park',
     ['drift in 30 min, root of the sum of squares', 'off pure integration, self-calibration']),
    ('bot_thoughts', ['SF, mean of the slopes']),
])
def test_what_contradicts_itself(source, contradicting):
    assert [each.quantity for each in reproduced(source, FEW).comparisons
            if each.verdict == 'contradicts itself'] == contradicting


@each_source
def test_every_number_of_a_contradiction_is_in_its_sentence(source):
    for contradiction in reproduced(source, FEW).contradictions:
        assert (contradiction.numbers
                and all(np.isfinite(value) for value in contradiction.numbers.values()))
        assert not [name for name in contradiction.numbers
                    if f'{{{name}:' not in contradiction.pattern], contradiction.pattern


# the verb and its page

@one_source
def test_the_page_holds_what_the_program_prints(source):
    shown = (ROOT / 'docs/explanation/reproduction.md').read_text()
    assert render_page(reproduced(source, MANY)) in shown, (
        'run gyro_calibration reproduce and put it there')


@one_source
def test_the_same_seed_gives_the_same_numbers_and_another_others(source, capsys, monkeypatch):
    few = {source: lambda generator, progress: SOURCES[source](generator, 2, progress)}
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


# Ojeda, Chung and Borenstein

@pytest.mark.parametrize('source, words, wanted', [
    ('ojeda', 'Ann Arbor', {'earth': (10.12, 0.01), 'ratio': (10.12 / 7.2, 0.01)}),
    ('ojeda', 'data sets, not 121', {'rates': 21, 'temperatures': 11, 'sets': 231, 'step': 20}),
    ('ojeda', 'unit of an angle', {'printed': 10, 'right': 1}),
    ('ojeda', 'of which quantity', {'specified': 1.5}),
    ('hong_park', 'a trapezoid of 3.8 s', {'s_bar': (-4.82, 0.02), 'b_bar': (-20.9, 0.02)}),
    ('hong_park', 'Eq. 8', {'first': -0.1 / 0.9, 'second': 1 / 0.9, 'right_first': 1 / 0.9,
                            'right_second': -0.1 / 0.9}),
    ('hong_park', '120 deg in 160 s', {'drift': 120, 'mean': 60, 'published': 1.6675, 'fits': 2}),
    ('hong_park', 'as a sum', {'sum': (10.77, 0.01), 'squares': (9.17, 0.01)}),
    ('hong_park', 'by 41 %', {'table': (30.97, 0.01), 'mean': (64.11, 0.01),
                              'deviation': (13.78, 0.01)}),
    ('hong_park', 'deletes true turns', {'lost': 17.82, 'kept': 18.18, 'limit': 18}),
    ('bot_thoughts', 'unsigned int', {'difference': abs(2.5654 / 14.309 - 0.1793),
                                      'unsigned': (2 ** 32 - 2854 - 2.5654) / -14.309}),
    ('bot_thoughts', 'wrong sign', {'wrong': (2 * 0.1793, 1e-3), 'hour': 3600 * 0.02238}),
    ('bot_thoughts', 'a strobe at 59.8 Hz', {
        'off': 100 * 0.2 / 60, 'slopes': (100 * 0.2 / 60, 0.02), 'left': (0.972, 0.001),
        'corrected': -14.309 * 60 / 59.8, 'nominal': (-0.003, 0.0005), 'crystal': 0.008})])
def test_numbers_of_the_contradictions_follow_by_hand(source, words, wanted):
    """To six digits, or to an absolute error."""
    found = numbers(source, words)
    for name, value in wanted.items():
        value, error = value if isinstance(value, tuple) else (value, None)
        assert found[name] == pytest.approx(value, rel=None if error else 1e-6, abs=error), name


def test_eq_10_as_printed_puts_several_powers_into_one_column():
    columns = {}
    for i in range(1, 5):
        for j in range(1, 4):
            columns.setdefault(i + (j - 1) * 3, []).append((3 - i + 1, 2 - j + 1))
    found = numbers('ojeda', 'same for several pairs')
    assert found['printed'] == len(columns) == 10 and columns[4] == [(3, 1), (0, 2)]
    assert (found['right'], found['cubic'], found['cubic_right']) == (12, 13, 16)


def test_the_condition_numbers_are_those_of_numpys_vandermonde_matrix():
    rates, temperatures = (
        axis.ravel() for axis in np.meshgrid(np.linspace(-100, 100, 21), np.linspace(25, 45, 11)))
    found = numbers('ojeda', 'condition number')
    assert found['raw'] == pytest.approx(np.linalg.cond(
        np.polynomial.polynomial.polyvander2d(rates, temperatures, [3, 2])), rel=1e-3)
    scaled = np.polynomial.polynomial.polyvander2d(rates / 100, (temperatures - 35) / 10, [3, 2])
    assert found['scaled'] == pytest.approx(np.linalg.cond(scaled), rel=1e-6)


def test_the_error_before_is_that_of_scale_and_sine():
    gyro, speeds = ojeda.rd2100(), np.arange(5, 101, 5) * DEGREE
    rates, temperatures = (axis.ravel() for axis in np.meshgrid(
        np.concatenate([-speeds, speeds]), np.arange(25.0, 46.0, 2.0)))
    scale = 1 + 0.02 / 115 * (temperatures - 25)
    error = np.sin(0.1 * rates) / 0.1 + (scale - 1) * rates - rates
    np.testing.assert_allclose(gyro.output(rates, temperatures)
                               - gyro.output(0.0 * rates, temperatures) - rates, error, atol=1e-12)
    assert ours('ojeda', 'rms error of the rate, static bias only').ours == pytest.approx(
        np.sqrt(np.mean(error ** 2)) / DEGREE, rel=0.01)
    turn = np.abs(error / rates).max() * 100
    assert (ours('ojeda', 'largest error of a full turn, static bias only').ours
            == pytest.approx(turn, rel=0.05))


def test_a_full_turn_errs_by_the_error_of_the_rate_times_its_time():
    gyro = replace(ojeda.rd2100(), noise=GyroModel().noise)
    rates, temperatures = np.array([36.0, -90.0]) * DEGREE, np.array([25.0, 45.0])
    errors, durations = ojeda.simulate_turn_errors(gyro, [GyroModel(), gyro], rates, temperatures,
                                                   np.random.default_rng(0))
    wanted = ((gyro.output(rates, temperatures) - gyro.output(0.0 * rates, temperatures) - rates)
              * [10.0, 4.0])
    np.testing.assert_allclose(durations, [10.0, 4.0])
    np.testing.assert_allclose(errors, [wanted, [0.0, 0.0]], atol=1e-9)


def test_the_calibration_takes_the_error_down_to_what_noise_leaves():
    for n in (12, 121, 231):
        left = ours('ojeda', f'rms error of the rate, n = {n}')
        assert 0.0015 < left.ours < 0.003, (
            'flicker of 0.002 deg/s, of which the static bias takes a part away')
        ratio = ours('ojeda', f'error of the rate, before over after, n = {n}')
        assert ratio.ours == pytest.approx(
            ours('ojeda', 'rms error of the rate, static bias only').ours / left.ours, rel=0.05)
        assert ratio.verdict == 'differs' and ours(
            'ojeda', f'largest error of a full turn, n = {n}').verdict == 'reproduced'
    order = numbers('ojeda', 'more than one order')
    assert math.hypot(order['more'], order['after']) == pytest.approx(order['before'] / 10)
    assert ours('ojeda', 'angle random walk of 5 (deg/h)/sqrt(Hz)').ours == pytest.approx(1 / 12)


def test_noise_in_the_regressor_does_what_the_expected_normal_equations_say():
    nodes, weights = np.polynomial.hermite_e.hermegauss(12)
    rates, weights = np.linspace(-100, 100, 21)[:, None] / 100, weights / weights.sum()
    found = numbers('ojeda', 'the regressor is the output')
    for name, deviation in (('vibration_single', 1.0), ('vibration_mean', 0.1)):
        noise = deviation / 100 * nodes
        powers = np.array([(rates + noise) ** i for i in range(4)])
        matrix, vector = (np.einsum('irn,jrn,n->ij', powers, powers, weights),
                          np.einsum('irn,n,n->i', powers, noise, weights))
        assert found[name] == pytest.approx(100 * np.linalg.solve(matrix, vector).sum(),
                                            rel=0.03, abs=2e-4)
    assert abs(found['white_single']) < 1e-5 and abs(found['white_mean']) < 1e-5


def test_the_cubic_fails_beyond_its_range_as_without_noise():
    inside, beyond = (np.arange(-60, 61, 10) * DEGREE,
                      np.array([-100, -90, -80, -70, 70, 80, 90, 100]) * DEGREE)
    slopes = 1 + 0.02 / 115 * np.linspace(0, 20, 11)

    def output(rates):
        return np.array([np.sin(0.25 * rates) / 0.25 + (slope - 1) * rates for slope in slopes])
    left = [output - rates - np.polyval(np.polyfit(known, known - inside, 3), output)
            for known, output, rates in zip(output(inside), output(beyond), [beyond] * 11)]
    found = numbers('ojeda', 'approximates a sine')
    assert found['strong'] == pytest.approx(np.sqrt(np.mean(np.square(left))) / DEGREE, rel=0.05)
    assert (found['strong_sine'] < 0.1 * found['strong']
            and found['weak_sine'] < found['weak'] < 0.1 * found['strong'])


# Hong and Park

def by_hand(motion, shift=0):
    """Return the errors of s and b, %, by eq. 4 to 7, written out."""
    count = round(motion.duration * 20) + 1
    time = np.arange(count) / 20
    measured = 0.9 * motion.rate_at(time) + 0.1
    rows = [(sum(measured[shift:shift + n]) / 20, n / 20) for n in range(1, count - shift)]
    scale, offset = np.linalg.lstsq(np.array(rows), motion.heading_at(time[1:count - shift]),
                                    rcond=None)[0]
    return 100 * ((1 / scale - 1) / -0.1 - 1), 100 * (-offset / scale / 0.1 - 1)


def test_the_rectangle_rule_has_the_errors_of_figure_6():
    found, motion = numbers('hong_park', 'Figures 6 and 7'), hong_park.published_motion()
    assert by_hand(motion) == pytest.approx((found['s'], found['b']), rel=1e-6)
    assert by_hand(motion, 1) == pytest.approx((found['late_s'], found['late_b']), rel=1e-6)
    assert found['trapezoid'] < 1e-6 and found['late_s'] > 0 > found['s']
    assert by_hand(hong_park.one_turn(3.0, 4.25)) == pytest.approx((-4.70, -20.61), abs=0.005), (
        'a motion in round numbers is near')
    short = numbers('hong_park', 'a trapezoid of 3.8 s')
    assert 1 / (1 - 0.1 * (1 + short['s'] / 100)) * 0.9 - 1 == pytest.approx(short['s_bar'] / 100)


def test_pure_integration_errs_by_s_and_b_alone():
    time = np.arange(0, 160, 0.01)
    error = 0.0373 * ROBOT_MOTION.heading_at(time) / DEGREE + 0.75 / 60 * time
    assert ours('hong_park', 'mean error, pure integration').ours == pytest.approx(
        np.abs(error).mean(), rel=0.1)


@pytest.mark.evidence
def test_calibration_and_filter_take_off_the_heading_error_what_the_page_on_results_says():
    text = (Path(__file__).parents[1] / 'docs/explanation/scope.md').read_text()
    for row, name in (
            ('self-calibration', 'self-calibration by likelihood'),
            ('threshold filter, single samples, as published', 'threshold filter, single samples'),
            ('threshold filter, mean of 0.2 s', 'threshold filter, mean of 0.2 s'),
            ('both, single samples, as published', 'likelihood and filter, single samples'),
            ('both, mean of 0.2 s', 'likelihood and filter, mean of 0.2 s')):
        found = ours('hong_park', f'off pure integration, {name}', MANY)
        assert f'| {row} | {found.ours:.0f} % |' in text


def test_the_percentages_of_table_1_are_those_of_its_means():
    for name in ('self-calibration by likelihood', 'threshold filter, single samples',
                 'likelihood and filter, mean of 0.2 s'):
        part = (ours('hong_park', f'mean error, {name}').ours
                / ours('hong_park', 'mean error, pure integration').ours)
        assert (ours('hong_park', f'off pure integration, {name}').ours
                == pytest.approx(100 - 100 * part))
    assert (ours('hong_park', 'off pure integration, threshold filter, single samples').verdict
            == 'differs')
    assert (ours('hong_park', 'off pure integration, self-calibration').ours
            == pytest.approx(100 * (1 - 1.1511 / 1.6675)))


def test_single_samples_pass_the_threshold_as_often_as_drawn_ones():
    found = numbers('hong_park', 'white sample')
    drawn = np.random.default_rng(1).standard_normal(100_000) * 2.5 / 60 * 10
    assert found['sigma'] == pytest.approx(2.5 / 60 * 10) and found['ratio'] == pytest.approx(0.72)
    assert found['passes'] == pytest.approx(100 * np.mean(np.abs(drawn) > 0.3), abs=1.0)


@pytest.mark.parametrize('runs, error',
                         [(FEW, 0.4), pytest.param(MANY, 0.15, marks=pytest.mark.evidence)])
def test_eq_7_is_as_far_from_the_bound_as_its_covariance_says(runs, error):
    """Of a standard deviation, four standard errors of few runs, three of many."""
    time = np.arange(2001) / 100
    rate = CALIBRATION_MOTION.rate_at(time)
    columns, bound = (np.column_stack([CALIBRATION_MOTION.heading_at(time), time]),
                      np.column_stack([rate, np.ones(2001)]))
    # a sum of white noise at the times t and u has the covariance min(t, u)
    estimator = np.linalg.inv(columns.T @ columns) @ columns.T
    covariance = estimator @ np.minimum.outer(time, time) @ estimator.T
    ratio = np.sqrt(np.diag(covariance) / np.diag(np.linalg.inv(bound.T @ bound) * 100))
    found = numbers('hong_park', 'Cramer-Rao', runs)
    assert (found['s'], found['b']) == pytest.approx(tuple(ratio), rel=error)
    assert max(found['likely_s'], found['likely_b']) < 1.0 + error


# Bot Thoughts

def test_the_slopes_come_out_of_the_means():
    first, second = (2.5654 + 2854.5) / -200, (-3857.9 + 2854.5) / 70
    assert bot_thoughts.segment_slopes() == pytest.approx((first, second))
    slope, rest = np.polyfit([0, 200, 270], [2.5654, -2854.5, -3857.9], 1)
    assert ours('bot_thoughts', 'SF, line through three points').ours == pytest.approx(slope)
    assert ours('bot_thoughts', 'N, line through three points').ours == pytest.approx(rest / slope)
    left = np.array([2.5654, -2854.5, -3857.9]) - rest - slope * np.array([0, 200, 270])
    deviation = math.sqrt(left @ left / np.square(np.array([0, 200, 270]) - 470 / 3).sum())
    found = numbers('bot_thoughts', 'An error of the strobe')
    assert (found['interval'] == pytest.approx(12.706 * deviation, rel=1e-4)
            and found['off'] == pytest.approx(abs(left[1] / slope)))


def test_each_cause_that_is_named_makes_the_slopes_equal():
    found = numbers('bot_thoughts', 'An error of the strobe')
    first, second = bot_thoughts.segment_slopes()
    assert (-2854.5 - 2.5654 + first * found['null']) / 200 == pytest.approx(second, rel=1e-4), (
        'the null')
    assert (-3857.9 + 2854.5) / (70 + found['speed']) == pytest.approx(first, rel=1e-4), (
        'the speed')
    assert (found['percent'] == pytest.approx(0.342, abs=0.001)
            and found['kelvin'] == pytest.approx(found['null'] / 0.04))


def test_the_solvers_way_is_least_squares_of_its_sum():
    time, rate, motion = bot_thoughts.encoder_log(np.random.default_rng(3))
    slope, rest = np.polyfit(rate, np.gradient(motion.heading, time), 1)
    errors = bot_thoughts.encoder_errors(np.random.default_rng(3))
    assert errors[:2] == pytest.approx((1 / slope - 1, -rest / slope), abs=1e-9)


def test_neither_way_explains_the_difference_of_the_scales():
    found = numbers('bot_thoughts', 'the two methods differ by')
    assert (found['turntable'] == pytest.approx(1.32, abs=0.005)
            and abs(found['solver']) + 3 * found['solver_scatter'] < 0.05)
    assert abs(found['likely']) + 3 * found['likely_scatter'] < 0.05
    assert found['late'] > 0.1 and found['reverse'] < -1 and found['slow'] < -40
