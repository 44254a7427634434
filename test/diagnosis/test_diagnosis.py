# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""
The diagnosis names hidden effects with their size and adds no others; its model serves on.

The logs are made by `hidden`, which shares nothing with the package. The seeds of the fixed set
are places in lists; those of the last test vary from run to run, and are printed.
"""

from dataclasses import replace
import itertools

from diagnosed import described as told
from diagnosed import diagnosis_of, held, judge_diagnosis, log_of, model_of
from gyro_calibration.diagnosis.causes import CAUSES
from gyro_calibration.diagnosis.data_quality import inspect_record
from gyro_calibration.diagnosis.findings import TIME_LIMIT_REMARK
from gyro_calibration.diagnosis.log_diagnosis import diagnose
from gyro_calibration.heading.log_compensation import compensate_log
from gyro_calibration.logs.log import Log
from gyro_calibration.model.channels import channels_from_log
from gyro_calibration.model.effects import CATALOGUE, QUANTIZATION
from gyro_calibration.model.gyro_model import GyroModel, Term
from gyro_calibration.model.model_file import format_model, read_model
from gyro_calibration.model.motion import simulate_gyro_output
from gyro_calibration.model.noise import Noise
from gyro_calibration_bench.hidden import (
    draw_gyro, FORMS, hide, KINDS, NoiseFigures, OUTSIDE_CATALOGUE, record, session,
    session_from_motion)
from gyro_calibration_bench.hidden.effects import MODEL_FINDINGS
import numpy as np
import pytest
from scipy.signal import butter, lfilter

SHORT = {'duration': 600.0, 'sample_rate': 25.0}
#: References in turn.
REFERENCES = ({'reference': 'rate'}, {'reference': 'heading'},
              {'reference': 'heading', 'encoder_step': 2.0 * np.pi / 65536})
ENCODER = ('reference_quantization',)  # an encoder does have steps


def turn(choices, number):
    return choices[number % len(choices)]


def evidence(is_kept, *cases):
    """Return cases of a test, which take 2 s each; those not kept run as evidence alone."""
    return [pytest.param(*case, marks=[] if is_kept(*case) else pytest.mark.evidence)
            for case in cases]


def hidden_in(names, multiple, seed, noise=None, reference=None, **how):
    """Hide effects in a log with the noise and the reference whose turn it is."""
    noise = noise or turn(KINDS, seed)
    reference = turn(REFERENCES, seed) if reference is None else reference
    return hide(names, multiple, np.random.default_rng(seed), noise=noise,
                **{**SHORT, **reference, **how})


def names_of(found):
    return [each.effect for each in found.findings]


TOGETHER = [('bias_temperature', 'cubic_nonlinearity'), ('warm_up', 'heading_sensitivity'),
            ('time_offset', 'scale_factor_asymmetry'), ('interference_tone', 'thermal_lag'),
            ('outliers', 'vibration_rectification'), ('reference_once_per_rev', 'bias_step'),
            ('bandwidth', 'supply_sensitivity', 'saturation')]
#: Named in other tests, below, in test_search.py and in test_extended_model.py.
ELSEWHERE = ('angle_random_walk', 'dead_zone', 'dropped_samples', 'quantization',
             'reference_scale', 'reference_slip', 'scale_factor_temperature')
#: Some are tried alone only as evidence, for they are named among others or elsewhere.
TRIED_ALONE = set(FORMS).difference(*TOGETHER, ELSEWHERE)


@pytest.mark.parametrize(
    'seed, name', evidence(lambda seed, name: name in TRIED_ALONE, *enumerate(FORMS)), ids=FORMS)
def test_an_effect_is_named_with_its_size(seed, name):
    # figures of the noise are sized without the steps of an encoder, which hide them
    reference = turn(REFERENCES, 0 if FORMS[name].stage == 'noise' else seed)
    log, = hidden_in([name], 5.0, seed, reference=reference)
    found = diagnosis_of([log], np.random.default_rng(seed))
    assert judge_diagnosis(log, found, ENCODER).is_right, told(log, found)
    # an encoder blurs where a zone ends by more than the noise does
    ends_blurred = name == 'dead_zone' and 'encoder_step' in reference
    assert ends_blurred or all(held(log.truth.gyro.causes, found.findings, 4.0).values()), told(
        log, found)


@pytest.mark.parametrize('seed, names', list(enumerate(TOGETHER)), ids=map('+'.join, TOGETHER))
def test_effects_together_are_all_named(seed, names):
    log, = hidden_in(names, 5.0, seed)
    found = diagnosis_of([log], np.random.default_rng(seed))
    assert judge_diagnosis(log, found, ENCODER).is_right, told(log, found)


def test_a_search_that_ends_in_time_reports_what_was_found_so_far():
    log, = hidden_in(('scale_factor_asymmetry', 'bias_temperature'), 20.0, 0, reference={})
    steps = []

    def on_step(share, words):
        steps.append(words)
        return 'search for causes, 1 found' in steps

    found = diagnose([log_of(log)], np.random.default_rng(0), on_progress=on_step)
    assert [each.status for each in found.findings] == ['established', 'suspected']
    assert set(names_of(found)) == set(log.truth.names)
    assert found.gain is None and TIME_LIMIT_REMARK in found.remarks


def test_a_coarse_output_and_another_effect_are_both_named():
    # rounding is expected on a straight line, which this is not: one more along the rate may stay
    log, = hidden_in(('quantization', 'scale_factor_temperature'), 5.0, 5)
    found = diagnosis_of([log], np.random.default_rng(5))
    assert {'quantization', 'scale_factor_temperature'} <= set(names_of(found)), told(log, found)


@pytest.mark.parametrize('seed, reference',
                         evidence(lambda seed, reference: seed % 3 == reference,
                                  *itertools.product(range(len(KINDS)), range(len(REFERENCES)))))
def test_where_nothing_is_hidden_nothing_is_found(seed, reference):
    log, = hidden_in([], 0.0, seed, KINDS[seed], REFERENCES[reference])
    # every other log has a right model, so that bias, scale factor and noise must fit as well
    found = diagnosis_of([log], np.random.default_rng(seed),
                         with_model=bool((seed + reference) % 2))
    assert judge_diagnosis(
        log, found, ENCODER).is_right and set(names_of(found)) <= set(ENCODER), told(log, found)
    assert {term.effect.name for term in found.model.terms} == {'bias', 'scale_factor_error'}
    # bands of the same length of log are alike, also at its end
    bands = next(each.deviation for each in found.curves if each.along == 'time')
    assert bands.max() < 2.0 * np.median(bands)


@pytest.mark.parametrize('name',
                         evidence(lambda name: name in ('third_harmonic_of_heading', 'bias_pulse'),
                                  ('third_harmonic_of_heading',), ('resonance_at_a_speed',),
                                  ('bias_pulse',), ('supply_times_rate',)))
def test_what_the_catalogue_does_not_have_is_reported_as_unexplained(name):
    log, = hidden_in([name], 5.0, list(OUTSIDE_CATALOGUE).index(name), reference=REFERENCES[0])
    found = diagnosis_of([log], np.random.default_rng(0))
    assert found.verdict == 'unexplained', told(log, found)
    assert judge_diagnosis(log, found).is_right, told(log, found)


def test_a_slip_is_blamed_on_the_reference():
    log, = hidden_in(['reference_slip'], 10.0, 1, 'mixed')
    found = diagnosis_of([log], np.random.default_rng(1))
    assert judge_diagnosis(log, found).is_right, told(log, found)
    assert 'reference_slip' not in {term.effect.name for term in found.model.terms}


def test_a_strobe_of_another_frequency_is_named_beside_the_scale_of_the_gyro():
    def given(sessions):
        return {'reference_scale': {'size': 59.8 / 60.0 - 1.0}}
    log, = hidden_in(['reference_scale'], 1.0, 5, 'mixed', REFERENCES[0], fixed_parts=given)
    found = diagnosis_of([log], np.random.default_rng(1))
    (finding,) = found.findings
    assert ({finding.effect, *finding.ambiguous_with} >= {'scale_factor_error', 'reference_scale'}
            and finding.separate_by), told(log, found)


LARGE = {'time_offset': lambda sessions: {'size': 0.02},
         'scale_factor_error': lambda sessions: {'size': 0.05}, 'saturation': lambda sessions: {
             'size': 0.5 * max(np.abs(each.rate).max() for each in sessions)}}


@pytest.mark.parametrize('seed, name', evidence(lambda seed, name: seed == 0,
                                                *itertools.product(range(2), LARGE)))
def test_a_large_effect_brings_no_companions(name, seed):
    log, = hidden_in([name], 1.0, seed, 'mixed', REFERENCES[0],
                     fixed_parts=lambda sessions: {name: LARGE[name](sessions)})
    found = diagnosis_of([log], np.random.default_rng(seed))
    assert judge_diagnosis(log, found).is_right, told(log, found)
    assert held(log.truth.gyro.causes, found.findings, 4.0).get(name, True), told(log, found)


def test_a_log_without_channels_says_what_it_cannot_show():
    log, = hidden_in(['cubic_nonlinearity'], 5.0, 0, 'mixed', REFERENCES[0])
    found = diagnose([replace(log_of(log), temperature=None, supply=None, specific_force=None)],
                     np.random.default_rng(0))
    needed = {name for name, cause in CAUSES.items()
              if cause.required_channels & {'temperature', 'supply', 'specific_force'}}
    assert needed <= set(found.cannot_show) and 'cubic_nonlinearity' not in found.cannot_show
    assert judge_diagnosis(log, found).is_right, told(log, found)


def recorded(names, steps, seed, given=None, multiple=8.0):
    """Record a gyro once for each moment of a temperature step of 10 K up, 15 K down later."""
    generator = np.random.default_rng(seed)
    time = np.arange(0.0, SHORT['duration'], 1.0 / SHORT['sample_rate'])
    motion = 1.5 * np.sin(0.7 * time) * (np.sin(0.05 * time) > 0.0)
    sessions = [session_from_motion(generator, time, motion,
                                    25.0 + 10.0 * (time > step) - 15.0 * (time > step + 100.0))
                for step in steps]
    gyro = draw_gyro(names, multiple, generator, sessions, NoiseFigures(1e-4), fixed_parts=given)
    return [record(gyro, each, generator, run=run) for run, each in enumerate(sessions)]


STEPS = (300.0, 150.0, 420.0)


def test_a_step_that_happens_with_a_change_of_temperature_is_a_step_where_the_other_logs_say_so():
    logs = recorded(['bias_step'], STEPS, 1,
                    {'bias_step': {'run': 0, 'step_time': STEPS[0] + 5.0}})
    found = diagnosis_of(logs, np.random.default_rng(0))
    assert judge_diagnosis(logs[0], found).is_right, told(logs[0], found)
    named = {name for each in found.findings for name in (each.effect, *each.ambiguous_with)}
    assert not {name for name in named if CAUSES[name].along.startswith('temperature')}, told(
        logs[0], found)


def test_logs_of_different_sample_rates_are_diagnosed_together():
    logs = [in_fast_walk(1e3, seed)[0] for seed in (1, 2)]
    slow = {name: getattr(logs[1], name)[::3] for name in ('time', 'output', 'reference_rate')}
    found = diagnose([logs[0], replace(logs[1], **slow)], np.random.default_rng(0))
    assert not found.findings and not found.unexplained


@pytest.mark.parametrize('factor', [0.7, 1.5])
def test_a_model_of_other_noise_is_reported(factor):
    log, = hidden_in([], 0.0, 4, 'white', REFERENCES[0])
    model = model_of(log)
    other = replace(model, noise=replace(model.noise,
                                         angle_random_walk=factor * model.noise.angle_random_walk))
    found = diagnose([log_of(log)], np.random.default_rng(0), other)
    assert names_of(found) == ['angle_random_walk'], told(log, found)
    assert found.findings[0].parameters['angle_random_walk'].estimate == pytest.approx(
        model.noise.angle_random_walk, rel=0.03)


def test_a_random_walk_is_told_from_the_noise_of_a_model_and_not_from_its_look_alike():
    log, = hidden_in(['rate_random_walk'], 2.0, 3, 'walk', REFERENCES[0])
    found = diagnosis_of([log], np.random.default_rng(3))
    assert names_of(found) == ['rate_random_walk'], told(log, found)
    assert found.findings[0].ambiguous_with == ('bias_instability',)


@pytest.mark.parametrize('seed', [36202, 36209, 36222])
def test_a_random_walk_that_exceeds_white_noise_within_a_minute_is_no_other_cause(seed):
    log, = hidden_in(['rate_random_walk'], 5.0, seed, reference=REFERENCES[0])
    found = diagnosis_of([log], np.random.default_rng(seed))
    assert names_of(found) in (['rate_random_walk'], ['bias_instability']), told(log, found)


def in_fast_walk(crossing, seed, step_sigmas=0.0):
    """
    Return a log of dwells at exact rates, and its step of the bias, rad/s, and the time of it, s.

    The walk of the bias exceeds the white noise after a crossing time, s. One sigma of the step is
    that of the bias by the best filter: of a pair of such errors, before and after it.
    """
    generator, interval, count, white = np.random.default_rng(seed), 0.04, 7500, 4e-4
    walk, time = np.sqrt(3.0) * white / crossing, np.arange(count) * interval
    dwells = generator.choice([0.0, *generator.uniform(-1.5, 1.5, 3)], 50)
    rate = np.convolve(np.repeat(dwells, count // 50), np.ones(8) / 8, 'same')
    at, step = generator.uniform(30.0, 270.0), step_sigmas * np.sqrt(2.0 * white * walk)
    output = (rate + 1e-3 + white / np.sqrt(interval) * generator.standard_normal(count)
              + walk * np.sqrt(interval) * np.cumsum(generator.standard_normal(count))
              + step * (time > at))
    return Log(time=time, output=output, reference_rate=rate), step, at


@pytest.mark.parametrize('crossing, seed', [(0.5, 1), (0.5, 2), (3.0, 1), (3.0, 2)])
def test_a_step_of_the_bias_is_found_at_any_time_of_a_fast_random_walk(crossing, seed):
    log, step, at = in_fast_walk(crossing, seed, 12.0)
    found = diagnose([log], np.random.default_rng(seed))
    assert names_of(found) == ['bias_step']
    for name, true in (('bias_step', step), ('step_time', at)):
        value = found.findings[0].parameters[name]
        assert abs(value.estimate - true) < 4.0 * value.deviation


@pytest.mark.parametrize('drift', [None, 'warm_up', 'bias_temperature'])
def test_steps_that_a_random_walk_explains_as_well_are_found_together(drift):
    generator, white, time = np.random.default_rng(21), 2e-4, np.arange(2400) / 20.0
    temperature = 25.0 + 8.0 * np.sin(2.0 * np.pi * time / 120.0)
    steps = np.cumsum(np.isin(time, (22.0, 59.0, 88.0)) * (-1.0) ** (time > 59.0)) * 8.0 * white
    drifts = {None: 0.0, 'warm_up': 10.0 * white * np.exp(-time / 15.0),
              'bias_temperature': 0.5 * white * (temperature - 25.0)}
    noise = white * np.sqrt(20.0) * generator.standard_normal(2400)
    found = diagnose([Log(time=time, output=noise + steps + drifts[drift],
                          temperature=None if drift is None else temperature)], generator)
    assert sorted(names_of(found)) == sorted([*3 * ['bias_step'], *filter(None, [drift])])


def test_two_steps_of_the_bias_three_seconds_apart_have_sizes_of_their_own():
    log, _, _ = in_fast_walk(1e6, 1)
    sizes = {120.0: 4e-3, 123.0: 3e-3}
    for at, size in sizes.items():
        log = replace(log, output=log.output + size * (log.time > at))
    steps = diagnose([log], np.random.default_rng(1)).findings
    assert [each.effect for each in steps] == ['bias_step', 'bias_step']
    for each in steps:
        time, size = each.parameters['step_time'].estimate, each.parameters['bias_step']
        true = sizes[min(sizes, key=lambda at: abs(at - time))]
        assert abs(size.estimate - true) < 3.0 * size.deviation < 1e-3


@pytest.mark.parametrize('seed', [6, 8])
def test_a_fast_random_walk_is_no_lag_of_the_motion(seed):
    found = diagnose([in_fast_walk(0.5, seed)[0]], np.random.default_rng(seed))
    assert not found.findings and 'lag of its own' not in found.cannot_show.get('time_offset', '')


@pytest.mark.parametrize('name, seed', [('saturation', 24103), ('heading_sensitivity', 190)])
def test_corners_between_the_samples_of_a_heading_are_no_nonlinearity(name, seed):
    log, = hidden_in([name], 5.0, seed, 'white', REFERENCES[1])
    found = diagnosis_of([log], np.random.default_rng(seed))
    assert names_of(found) == [name], told(log, found)


@pytest.mark.parametrize('seed', [1, 4])
def test_no_slip_of_the_reference_is_named_in_a_gap_of_the_gyro(seed):
    log, = hidden_in(['stuck_samples'], 5.0, seed, 'flicker', REFERENCES[2])
    found = diagnosis_of([log], np.random.default_rng(seed))
    assert judge_diagnosis(log, found, ENCODER).is_right, told(log, found)


@pytest.mark.parametrize('seed', [4, 8])
def test_a_unit_is_found_where_the_motion_has_corners(seed):
    log, = hidden_in(['unit_error'], 1.0, seed, 'white', REFERENCES[1])
    assert log.truth['unit_error'].size == 1.024
    quality = inspect_record(log_of(log), None)
    assert [each.effect for each in quality.findings] == ['unit_error']


EXTENSIONS = [['cubic_nonlinearity'], ['thermal_lag', 'scale_factor_temperature'],
              ['heading_sensitivity'], ['vibration_rectification'], ['time_offset']]


def again(hidden, seed):
    """Record the same gyro in another motion at the same temperatures, after another power-on."""
    generator = np.random.default_rng(seed)
    other = session(generator, **SHORT)
    other = session_from_motion(generator, other.time, other.rate, hidden.session.temperature)
    return record(hidden.truth.gyro, other, generator, reference='both', run=1)


def left_over(model, log):
    """Return the residuals of a log: of its simulated output, and of its compensated rate."""
    channels = channels_from_log(log)
    simulated = simulate_gyro_output(model, log.time,
                                     channels.with_rate(log.reference_rate, log.reference_rate))
    known = np.interp(model.true_time(log.time), log.time, log.reference_rate)
    return np.var(log.output - simulated), np.var(compensate_log(model, log) - known)


@pytest.mark.parametrize('seed, names',
                         evidence(lambda seed, names: seed in (1, 4), *enumerate(EXTENSIONS)),
                         ids=map('+'.join, EXTENSIONS))
def test_the_extended_model_serves_another_log_of_the_gyro(seed, names, tmp_path):
    def given(sessions):
        # as small as it is detectable, no motion tells a delay from a lag
        return {'time_offset': {'size': 0.01}} if 'time_offset' in names else {}
    first, = hide(names, 10.0, np.random.default_rng(seed), noise='white', reference='both',
                  fixed_parts=given, **SHORT)
    found, second = diagnosis_of([first], np.random.default_rng(0)), again(first, seed)
    (tmp_path / 'model.yaml').write_text(format_model(found.model))
    model = read_model(tmp_path / 'model.yaml')
    assert set(names) <= {term.effect.name for term in model.terms} <= set(CATALOGUE), told(
        first, found)
    noise = np.var(second.truth.noise)
    for before, after in zip(left_over(found.before, log_of(second)),
                             left_over(model, log_of(second))):
        # the noise that is compensated, too, has the scale factor of the gyro
        assert after - noise < 0.1 * (before - noise) + 0.06 * noise and after < before, (
            before, after, noise, told(first, found))


def test_noise_is_found_against_a_model_only():
    assert ({name for name, cause in CAUSES.items() if cause.origin == 'noise'}
            <= set(MODEL_FINDINGS))
    log, = hidden_in(['angle_random_walk'], 20.0, 1, 'white', REFERENCES[0])
    assert names_of(diagnosis_of([log], np.random.default_rng(0), with_model=False)) == []


# Noise that a filter or rounding shaped passes for no cause, and hides none

#: Numerator and denominator.
FILTERS = {'exponential smoothing': ([0.5], [1.0, -0.5]), 'mean of two': ([0.5, 0.5], [1.0]),
           'low pass': butter(2, 0.3)}
ANGLE_RANDOM_WALK = 1e-4


def behind(shape, names=(), multiple=0.0, seed=0):
    """Return what is hidden, and its log with noise that went through a filter."""
    hidden, = hide(names, multiple, np.random.default_rng(seed), noise='white', **SHORT)
    noise = hidden.truth.noise
    log = log_of(hidden)
    return hidden, replace(log, output=log.output - noise + lfilter(*FILTERS[shape], noise))


#: The other filters are tried as evidence: a log takes some seconds.
TRIED = 'exponential smoothing'


def tried(shape, *others):
    return pytest.param(shape, *others, marks=[] if shape == TRIED else pytest.mark.evidence)


@pytest.mark.parametrize('shape', map(tried, FILTERS))
def test_noise_behind_a_filter_is_no_cause(shape):
    hidden, log = behind(shape)
    found = diagnose([log], np.random.default_rng(0), model_of(hidden))
    assert found.verdict == 'adequate', told(hidden, found)
    assert found.noise.angle_random_walk == pytest.approx(
        hidden.truth.expected['angle_random_walk'], rel=0.05)


@pytest.mark.parametrize('shape, name',
                         map(tried, FILTERS, ['time_offset', 'interference_tone', 'time_offset']))
def test_what_is_hidden_in_noise_behind_a_filter_is_found(shape, name):
    hidden, log = behind(shape, [name], 8.0, 1)
    found = diagnose([log], np.random.default_rng(0))
    (finding,) = found.findings
    assert name in (finding.effect, *finding.ambiguous_with), told(hidden, found)
    assert not found.unexplained, told(hidden, found)


@pytest.mark.parametrize('step', [0.6, 1.5, 3.0])
def test_the_steps_that_a_model_has_are_no_angle_random_walk(step):
    generator = np.random.default_rng(3)
    time = np.arange(20_000) / 50.0
    white = ANGLE_RANDOM_WALK / np.sqrt(0.02)
    rate = 0.8 * np.sin(0.3 * time) * np.sin(0.041 * time)
    output = (np.round((rate + white * generator.standard_normal(len(time))) / (step * white))
              * step * white)
    model = GyroModel((Term(QUANTIZATION, (step * white,)),), noise=Noise(ANGLE_RANDOM_WALK))
    found = diagnose([Log(time=time, output=output, reference_rate=rate)], generator, model)
    assert not found.findings
    assert found.noise.angle_random_walk == pytest.approx(ANGLE_RANDOM_WALK, rel=0.03)
