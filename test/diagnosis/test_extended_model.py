# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The extended model: the findings in it, what it keeps of the given model, and its messages."""

from dataclasses import replace

from chance import seeds
from diagnosed import log_of
from gyro_calibration.diagnosis.candidates import effect_candidate
from gyro_calibration.diagnosis.extended_model import (
    add_causes, heading_error_shares, jackknife_change, measure_gain, merge_self_calibration,
    unmergeable_causes)
from gyro_calibration.diagnosis.log_diagnosis import diagnose
from gyro_calibration.diagnosis.regression import build_problem, fit_causes
from gyro_calibration.diagnosis.replay import replay
from gyro_calibration.diagnosis.search import start_search
from gyro_calibration.diagnosis.words import headline, is_in_extended_model
from gyro_calibration.logs.log import Log, write_log
from gyro_calibration.model.effects import BIAS, CATALOGUE, SCALE_FACTOR_ERROR
from gyro_calibration.model.gyro_model import GyroModel, SelfCalibration, Term
from gyro_calibration.model.model_file import read_model, write_model
from gyro_calibration.model.motion import constant_rate_motion, simulate
from gyro_calibration.model.noise import Noise
from gyro_calibration_bench.hidden import hide
import numpy as np
import pytest
from scipy.signal import butter, lfilter

NOISE = Noise(1.5e-4)
LINEAR = (Term(BIAS, (2e-3,)), Term(SCALE_FACTOR_ERROR, (0.01,)))
#: A model as somebody calibrated it, some time ago.
MODEL = GyroModel(LINEAR, np.diag([1e-10, 1e-8]), (-1.5, 1.5), (10.0, 30.0), noise=NOISE,
                  gyro={'name': 'yaw'},
                  origin={'files': [{'name': 'old.csv'}], 'date': '2025-01-01'})
DRIVE = constant_rate_motion([(20, 0), (9, 40), (10, 0), (6, -60), (15, 20), (20, -10)] * 5,
                             ramp=1.0)
RATE = 20.0
TIME = np.arange(round(DRIVE.duration * RATE) + 1) / RATE
#: It is heated, and cools again.
TEMPERATURE = 25.0 + 20.0 * np.sin(np.pi * TIME / TIME[-1]) ** 2


def term(name, *values):
    return Term(CATALOGUE[name], values)


def drive(*more, gyro=MODEL, noise=NOISE, seed=1):
    return simulate(replace(gyro, terms=(*gyro.terms, *more), noise=noise), DRIVE, RATE,
                    np.random.default_rng(seed), TEMPERATURE)


def diagnosed(log, model=None):
    return diagnose([log], np.random.default_rng(2), model)


def names(found):
    return [each.effect for each in found.findings]


def value(model, name, place=0):
    return next(each.values[place] for each in model.terms if each.effect.name == name)


def on_top(own, found, *shapes, supply=None):
    """Return a model with an effect, and a finding of more of it from another origin or time."""
    model = replace(MODEL, terms=(*LINEAR, own),
                    covariance=np.diag([1e-10, 1e-8, 1e-12, 1e-12][:2 + len(own.fitted_indices)]))
    log = replace(drive(), supply=supply)
    laid = replay(log, np.ones(len(log), dtype=bool), np.random.default_rng(3), model=model)
    named = [replace(effect_candidate(found, *shapes), values=(1e-4,))]
    return model, fit_causes(build_problem([laid]), named)


VOLTS = 12.0 + np.sin(0.05 * TIME)
BESIDE = {'bias_temperature': (term('bias_temperature', 25.0, 1e-4), 'bias_temperature', 34.0),
          'bias_temperature_quadratic': (term('bias_temperature_quadratic', 25.0, 1e-6),
                                         'bias_temperature_quadratic', 34.0),
          'scale_factor_temperature': (term('scale_factor_temperature', 25.0, 1e-4),
                                       'scale_factor_temperature', 34.0),
          'supply_sensitivity': (term('supply_sensitivity', 12.0, 1e-4), 'supply_sensitivity',
                                 5.0),
          'cubic_nonlinearity': (term('cubic_nonlinearity', 1e-3), 'cubic_nonlinearity')}


@pytest.mark.parametrize('own, found, shapes',
                         [(own, found, shapes) for own, found, *shapes in BESIDE.values()],
                         ids=BESIDE)
def test_the_extended_model_says_what_model_and_finding_say_together(own, found, shapes):
    model, outcome = on_top(own, found, *shapes, supply=VOLTS)
    new, (laid,) = add_causes(model, outcome, 1e-5), outcome.problem.replays
    channels, rate = laid.channels, laid.channels.rate
    together = (rate + laid.simulated_error + outcome.total_contribution(laid, 0)
                + outcome.biases[0])
    assert (not unmergeable_causes(model, outcome) and new.output_from_channels(
        channels.with_rate(rate, rate)) == pytest.approx(together, abs=1e-12))
    # how well the error is known is what the model, the bias and the finding say of it
    columns = np.array([rate, *(outcome.causes[0].columns(laid))])
    own_rows, rows = (
        np.array([row + 0.0 * rate for each in terms for row in each.sensitivity(channels)])
        for terms in (model.terms, new.terms))
    variance = np.einsum('in,ij,jn->n', columns, outcome.covariance, columns) + 1e-10
    variance += np.einsum('in,ij,jn->n', own_rows, model.covariance, own_rows)
    assert np.einsum('in,ij,jn->n', rows, new.covariance,
                     rows) == pytest.approx(variance, rel=1e-6)


@pytest.mark.parametrize('name, own, found',
                         [('time_offset', 0.02, 0.03), ('time_offset', 0.02, -0.05),
                          ('clock_rate', 2e-5, 3e-5)])
def test_delays_and_paces_of_clocks_add_up(name, own, found):
    model, outcome = on_top(term(name, own), name, found)
    assert (not unmergeable_causes(model, outcome)
            and value(add_causes(model, outcome, 1e-5), name) == pytest.approx(own + found))


@pytest.mark.parametrize('name, own, shape',
                         [('thermal_lag', (120.0, 1e-4), 300.0), ('warm_up', (30.0, 1e-3), 90.0),
                          ('bandwidth', (0.02,), 0.05), ('time_offset', (1.9,), 0.2)])
def test_what_does_not_make_one_effect_with_that_of_the_model_is_left_out(name, own, shape):
    model, outcome = on_top(term(name, *own), name, shape)
    (out,) = unmergeable_causes(model, outcome)
    assert out.cause == name
    assert not unmergeable_causes(GyroModel(), outcome)


@pytest.mark.parametrize('own', [(), (term('bias_step', 10.0, 2e-4),)], ids=['none', 'one'])
@pytest.mark.parametrize('once', [term('bias_step', 130.0, 3e-3),
                                  term('interference_tone', 1.7, 1e-3, 0.0)],
                         ids=lambda each: each.effect.name)
def test_what_happens_once_is_named_and_only_what_lasts_is_in_the_model(once, own):
    model = replace(MODEL, terms=(*LINEAR, *own), covariance=None)
    log = drive(*own, once, term('cubic_nonlinearity', 0.01))
    found = diagnosed(log, model)
    assert sorted(names(found)) == sorted([once.effect.name, 'cubic_nonlinearity'])
    assert ([each.effect.name for each in found.model.terms]
            == [*(each.effect.name for each in model.terms), 'cubic_nonlinearity'])
    assert found.model.terms[2:-1] == own
    assert value(found.model, 'cubic_nonlinearity') == pytest.approx(0.01, rel=0.1)
    # the bias of the model is the mean over the log
    mean = np.mean(once.values[1] * (TIME > 130.0)) if once.effect.name == 'bias_step' else 0.0
    assert value(found.model, 'bias') == pytest.approx(2e-3 + mean, abs=5e-5)
    (finding,) = (each for each in found.findings if each.effect == once.effect.name)
    assert 'in this log alone' in finding.remedy and not is_in_extended_model(finding, found)


def test_a_model_that_is_right_is_left_as_it_is_to_the_letter():
    model = replace(MODEL, noise=Noise(1.5e-4, 1e-6, 1e-8))
    found = diagnosed(drive(), model)
    assert (found.verdict == 'adequate' and found.model is model
            and 'the model is unchanged' in headline(found)[1])


BEHIND = SelfCalibration(0.02, 1e-3, ((1e-8, 0.0), (0.0, 1e-10)))


def test_what_a_self_calibration_knows_is_no_finding_and_is_not_applied_twice():
    behind = replace(MODEL, self_calibration=BEHIND)
    found = diagnosed(drive(gyro=merge_self_calibration(behind)), behind)
    assert found.verdict == 'adequate' and found.model is behind
    log = drive(term('warm_up', 60.0, 4e-3), gyro=merge_self_calibration(behind))
    found = diagnosed(log, behind)
    assert names(found) == ['warm_up'] and found.model.self_calibration is None
    assert value(found.model, 'scale_factor_error') == pytest.approx(1.01 * 1.02 - 1.0, abs=5e-4)
    assert value(found.model, 'bias') == pytest.approx(2e-3 + 1.01 * 1e-3, abs=2e-4)


def at_rest(swing):
    """Return a log of a gyro that does not turn, or hardly does beside its noise."""
    rate = swing * np.sin(0.3 * TIME)
    output = 1e-3 + rate + 7e-4 * np.random.default_rng(4).standard_normal(len(TIME))
    return Log(time=TIME, output=output, temperature=TEMPERATURE,
               reference_rate=rate if swing else None, moving=np.sign(swing) + 0.0 * TIME)


@pytest.mark.parametrize('swing', [0.0, 2e-4], ids=['at rest', 'hardly in motion'])
def test_a_log_without_motion_says_nothing_of_rates(swing):
    found = diagnosed(at_rest(swing))
    assert found.model.rate_range == (-np.inf, np.inf)
    assert (value(found.model, 'scale_factor_error') == 0.0
            and value(found.model, 'bias') == pytest.approx(1e-3, abs=1e-4))
    assert any('is not added to the model' in remark for remark in found.remarks) == (swing > 0.0)


@pytest.mark.parametrize('model', [None, GyroModel(LINEAR[:1], noise=NOISE)],
                         ids=['no model', 'a model'])
def test_a_factor_that_may_be_of_the_gyro_stays_in_the_model(model):
    log = drive(gyro=GyroModel((LINEAR[0], term('scale_factor_error', 0.024))))
    found = diagnosed(log, model)
    assert (names(found) == ['unit_error']
            and value(found.model, 'scale_factor_error') == pytest.approx(0.024, abs=5e-4))
    assert 'as a scale factor error' in found.findings[0].evidence


@pytest.mark.parametrize('name, size', [('saturation', 0.9), ('quantization', 2.5e-4)])
def test_a_limit_and_steps_that_are_found_are_in_the_model(name, size):
    found = diagnosed(drive(term(name, size)), MODEL)
    assert (names(found) == [name] and value(found.model, name) == pytest.approx(size, rel=0.02)
            and is_in_extended_model(found.findings[0], found))
    assert found.model.covariance.shape == (3, 3) and found.model.terms[:2] == MODEL.terms
    assert diagnosed(drive(term(name, size), seed=5), found.model).verdict == 'adequate'


def test_an_extended_model_comes_from_its_log_and_names_what_came_before(run, tmp_path):
    log, model = tmp_path / 'new.csv', tmp_path / 'model.yaml'
    write_log(log, log_of(hide(['warm_up'], 8.0, np.random.default_rng(3), noise='white',
                               duration=400.0, sample_rate=20.0)[0]))
    write_model(model, GyroModel((Term(BIAS, (0.0,)), Term(SCALE_FACTOR_ERROR, (0.0,))),
                                 origin=MODEL.origin))
    for number in (1, 2):
        code, _, errors = run('diagnose', log, '--model', model, '--out', tmp_path / 'found')
        assert code == 0, errors
        origin = read_model(tmp_path / 'found/model.yaml').origin
        assert ([file['name'] for file in origin['files']] == ['new.csv']
                and origin['date'] > '2025-01-02')
        assert len(origin['before']) == number and origin['before'][-1] == MODEL.origin
        known = read_model(tmp_path / 'found/model.yaml')
        write_model(model,
                    replace(known, terms=(term('bias', 0.5), term('scale_factor_error', 0.0)),
                            covariance=None))


# The improvement on held-out blocks: from the given model, with its interval, and by cause

#: Standard deviation of a sample, rad/s, and samples a second.
WHITE, SLOW = 1e-3, 10.0


def swing(generator, duration=600.0, bias=0.0, scale=0.0):
    """Return a drive with a reference rate, of a gyro with bias, scale error and white noise."""
    time = np.arange(round(duration * SLOW)) / SLOW
    rate = np.sin(0.3 * time) + 0.4 * np.sin(0.071 * time + 1.0)
    output = (1.0 + scale) * rate + bias + WHITE * generator.standard_normal(len(time))
    return Log(time=time, output=output, reference_rate=rate)


def blocks(log, length=60.0):
    return np.floor(log.time / length).astype(int) % 3 == 1


@pytest.mark.parametrize('bias, scale', [(0.02, 0.0), (0.0, 0.03), (0.02, 0.03)])
def test_the_improvement_by_a_right_bias_and_scale_factor_is_measured_from_the_given_model(
        bias, scale):
    log = swing(np.random.default_rng(1), bias=bias, scale=scale)
    model = GyroModel((Term(BIAS, (0.0,)), Term(SCALE_FACTOR_ERROR, (0.0,))),
                      noise=Noise(WHITE / np.sqrt(SLOW)))
    found = diagnose([log], np.random.default_rng(2), model)
    assert {each.effect for each in found.findings} == {
        name for name, size in (('bias', bias), ('scale_factor_error', scale)) if size}
    out = blocks(log)
    assert found.gain.rate.before == pytest.approx(
        np.sqrt(np.mean((log.output - log.reference_rate)[out] ** 2)), rel=1e-3)
    assert found.gain.rate.after == pytest.approx(WHITE, rel=0.1)
    curve = next(each for each in found.curves if each.along == 'rate')
    assert np.abs(curve.before - bias - scale * curve.at).max() < 0.1 * max(bias, scale)
    assert np.abs(curve.after).max() < 0.1 * max(bias, scale)
    # the answer is about heading: what each explains of the error over a minute, and what is left
    shares, models = found.heading_shares, found.gain.models
    assert shares['bias'] + shares['scale_factor_error'] > 0.99 and shares['left'] < 0.01
    assert sum(shares.values()) == pytest.approx(1.0, abs=1e-3)
    assert models['given'] == found.gain.heading.before > 10.0 * models['plain']
    assert models['extended'] == found.gain.heading.after
    assert all(each.remedy and each.share_of_heading_error == shares[each.effect]
               for each in found.findings)


PARTLY = {'nothing that is held out': [lambda time: (time < 40.0) | (time >= 295.0)],
          'one log within what is held out': [
              lambda time: time >= 0.0, lambda time: (time >= 51.0) & (time < 96.0)]}


@pytest.mark.parametrize('known', PARTLY.values(), ids=PARTLY)
def test_a_reference_that_is_known_in_too_few_blocks_gives_no_gain(known):
    generator = np.random.default_rng(5)
    logs = [swing(generator, 300.0) for _ in known]
    laid = [replay(log, where(log.time), generator) for log, where in zip(logs, known)]
    assert measure_gain(start_search(laid), {'rate_ramp'}, False) is None


def test_one_part_has_no_interval_and_is_not_called_worse():
    change = jackknife_change(np.array([[1.0, 2.0]]), np.ones(1))
    assert change.interval is None and not change.is_worse and change.to_dict()['ci95'] is None
    assert jackknife_change(np.array([[1.0, 2.0]] * 2), np.ones(2)).is_worse
    assert not jackknife_change(np.array([[1.0, 2.0], [1.0, 1.2]]), np.ones(2)).is_worse


@pytest.mark.parametrize('parts', [2, 3, 5, 8])
@pytest.mark.parametrize('shared', [0.0, 0.7, 1.0],
                         ids=['all is won', 'some is won', 'nothing is won'])
def test_intervals_of_the_improvement_hold_the_truth_for_few_parts(parts, shared):
    generator, runs = np.random.default_rng(8), 2000
    inside = 0
    for _ in range(runs):
        mine, other = generator.standard_normal((2, parts))
        after = shared * mine + 0.2 * other
        before = mine + 0.2 * generator.standard_normal(parts)
        change = jackknife_change(np.column_stack([before, after]) ** 2, np.ones(parts))
        low, high = change.interval
        inside += low <= np.hypot(1.0, 0.2) - np.hypot(shared, 0.2) <= high
    # Few squares are skew, which costs some per cent; resampled blocks cover 62 to 86 of 100.
    assert inside > 0.86 * runs, inside / runs


def test_what_a_cause_adds_like_a_bias_or_a_scale_factor_error_is_not_its_share():
    # a quadratic term at nearly one speed and a bias of the other sign, each 70 times the error
    time = np.arange(601.0)
    rate = 1.0 + 0.1 * np.sin(0.2 * time[1:])
    parts = {'scale_factor_error': 0.02 * rate, 'quadratic_nonlinearity': 0.5 * rate ** 2,
             'bias': np.full(600, -0.5), 'left': 1e-4 * np.cos(time[1:])}
    found = heading_error_shares([(parts, time)])
    assert abs(found['quadratic_nonlinearity']) < 0.01
    assert sum(found.values()) == pytest.approx(1.0)
    # what no bias and no scale factor error makes is its own
    own = {**parts, 'quadratic_nonlinearity': 1e-3 * np.sin(0.01 * time[1:]),
           'bias': 0.0 * rate, 'scale_factor_error': 0.0 * rate}
    assert heading_error_shares([(own, time)])['quadratic_nonlinearity'] > 0.5


@pytest.mark.parametrize('order, corner', [(2, 4.0), (3, 6.0)])
@pytest.mark.parametrize('seed', seeds(2))
def test_a_filter_that_has_no_name_is_not_in_the_scale_factor_error(seed, order, corner):
    generator, smooth = np.random.default_rng(seed), np.hanning(41) / np.hanning(41).sum()
    rate = np.convolve(np.repeat(generator.uniform(-1.0, 1.0, 120), 100), smooth, 'same')
    output = 1.004 * lfilter(*butter(order, corner / 50.0), rate)
    found = diagnose([Log(time=0.01 * np.arange(12000), reference_rate=rate,
                          output=output + 2e-4 * generator.standard_normal(12000))],
                     np.random.default_rng(0))
    assert [each.along for each in found.unexplained] == ['rate_change']
    (size, deviation), = ((each[2:]) for each in found.model.estimates()
                          if each[0] == 'scale_factor_error')
    assert abs(size - 0.004) < 4.0 * deviation < 3e-4
    assert found.noise.angle_random_walk < 1e-4


@pytest.mark.parametrize('lag, delay', [(0.012, -0.03), (0.06, 0.05)])
@pytest.mark.parametrize('seed', seeds(1))
def test_a_lag_and_a_delay_together_have_both_values(seed, lag, delay):
    generator, smooth = np.random.default_rng(seed), np.hanning(300) / np.hanning(300).sum()
    rate = np.convolve(np.repeat(generator.uniform(-1.0, 1.0, 120), 1000), smooth, 'same')
    kept = np.exp(-0.001 / lag)
    late = np.roll(lfilter([1.0 - kept], [1.0, -kept], rate), round(1000.0 * delay))
    used = slice(1000, -1000, 10)
    log = Log(time=0.001 * np.arange(120000)[used], reference_rate=rate[used],
              output=late[used] + 3e-4 * generator.standard_normal(len(rate[used])))
    found = diagnose([log], np.random.default_rng(0))
    sizes = {each.effect: each.parameters[each.effect].estimate for each in found.findings}
    # the filter, in steps of 1 ms, is 0.5 ms early
    assert sizes == pytest.approx({'bandwidth': lag, 'time_offset': delay - 0.0005}, abs=4e-4)
