# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""The diagnosis by a course over ground: gaps, side slip, fixes and another clock."""

from dataclasses import replace
import math

from chance import evidence, seeds
from diagnosed import established, estimates, judge_findings, log_of
from gyro_calibration.calibration.encoder import calibrate_encoder
from gyro_calibration.calibration.heading_regression import fit_spans
from gyro_calibration.calibration.reference_kind import find_drift
from gyro_calibration.calibration.reference_noise import heading_noise_share
from gyro_calibration.calibration.spans import lay_out_spans
from gyro_calibration.diagnosis.gates import classify_reference, is_reference_limiting
from gyro_calibration.diagnosis.log_diagnosis import diagnose
from gyro_calibration.diagnosis.report import render_report
from gyro_calibration.diagnosis.span_search import _cluster_robust_chance, select_causes
from gyro_calibration.diagnosis.words import terminal_lines
from gyro_calibration.logs.log import DataRefused, DEGREE, Log, select_rows
from gyro_calibration.model.effects import BIAS, SCALE_FACTOR_ERROR
from gyro_calibration.model.gyro_model import GyroModel, Term
from gyro_calibration_bench.cases import Case, make_logs, random_source
from gyro_calibration_bench.hidden.conditions import hide_with_reference, ImperfectReference
import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid
from scipy.signal import lfilter

RATE, BIAS_TRUE, SCALE, DELAY = 25.0, 0.3 * DEGREE, 0.004, 0.4


def drive(seed, duration=240.0, hidden=lambda time, rate, heading, temperature: 0.0):
    """Return a log of a drive with a course, and its temperature."""
    generator = np.random.default_rng(seed)
    time = np.arange(0.0, duration, 1.0 / RATE)
    rate, begin = np.zeros(len(time)), 0.0
    while begin < duration:
        begin += generator.exponential(4.0)
        length = generator.uniform(1.5, 5.0)
        size = generator.choice([-1.0, 1.0]) * generator.uniform(0.1, 0.9)
        turns = (time >= begin) & (time < begin + length)
        rate[turns] += size * np.sin(np.pi * (time[turns] - begin) / length) ** 2
        begin += length
    heading, temperature = np.cumsum(rate) / RATE, 25.0 + 10.0 * np.sin(2.0 * np.pi * time / 90.0)
    noise = 3e-4 * np.sqrt(RATE) * generator.standard_normal(len(time))
    output = (1.0 + SCALE) * rate + BIAS_TRUE + hidden(time, rate, heading, temperature) + noise
    wanders = lfilter(
        [1.0], [1.0, -np.exp(-1.0 / (3.0 * RATE))], generator.standard_normal(len(time)))
    slip = wanders * np.sqrt(2.0 / (3.0 * RATE)) * 0.4 * DEGREE * (1.0 + 2.0 * np.abs(rate))
    fixes = np.arange(0.0, duration, 0.2)
    course = (np.interp(fixes + DELAY, time, heading + slip)
              + 0.3 * DEGREE * generator.standard_normal(len(fixes)))
    course = np.interp(time, fixes, course)
    for lost in generator.uniform(10.0, duration - 20.0, 3):
        course[(time > lost) & (time < lost + 5.0)] = np.nan
    return Log(output=output, time=time, reference_heading=course, temperature=temperature)


def diagnosed(log, model=None, kind=None):
    return diagnose([log], np.random.default_rng(0), model, reference_kind=kind)


def value(model, name):
    return next(term.values[-1] for term in model.terms if term.effect.name == name)


@pytest.mark.parametrize('seed', seeds(3))
def test_a_course_brings_no_false_names_and_the_right_bias_scale_and_delay(seed):
    found = diagnosed(drive(seed))
    named = established(found)
    assert found.reference.kind == 'course' and {*named} <= {'time_offset'}, terminal_lines(found)
    assert value(found.model, 'bias') == pytest.approx(BIAS_TRUE, abs=0.03 * DEGREE)
    assert value(found.model, 'scale_factor_error') == pytest.approx(SCALE, abs=0.012)
    assert named['time_offset'].parameters['time_offset'].estimate == pytest.approx(
        DELAY, abs=0.05)
    assert 'time_offset' not in {term.effect.name for term in found.model.terms}
    told = found.to_dict()
    assert (told['reference']['kind'] == 'course' and told['reference']['noise']['reference'] > 0.0
            and all(gate['passed'] for gate in told['gates']))
    assert (sum(told['heading_shares'].values()) == pytest.approx(1.0, abs=0.02)
            and told['heading_shares']['bias'] > 0.5)
    assert {'given', 'plain', 'extended'} <= set(told['gain'])
    assert ('course over ground' in ' '.join(terminal_lines(found))
            and 'course over ground' in render_report(found))


@pytest.mark.parametrize('dead_zone', [0.0, 0.5])
@pytest.mark.parametrize('seed', seeds(6))
def test_a_dead_zone_is_found_beside_an_encoder_that_errs_more_than_the_gyro(dead_zone, seed):
    generator = np.random.default_rng(seed)
    turns = generator.choice([-9.0, -3.0, -1.0, -0.3, 0.0, 0.3, 1.0, 3.0, 9.0], 90)
    rate = np.convolve(np.repeat(turns * DEGREE, 200), np.hanning(41) / 20.0, 'same')
    time = np.arange(len(rate)) / 40.0
    heading = cumulative_trapezoid(rate, time, initial=0.0)
    output = ((1.0 + SCALE) * np.where(np.abs(rate) < dead_zone * DEGREE, 0.0, rate) + BIAS_TRUE
              + 0.01 * DEGREE * generator.standard_normal(len(time)))
    heading = 0.05 * DEGREE * np.round(heading / DEGREE / 0.05)
    found = diagnosed(Log(time=time, output=output, reference_heading=heading), kind='encoder')
    named = established(found)
    assert {*named} - {'time_offset'} == ({'dead_zone'} if dead_zone else set())
    if dead_zone:
        size = named['dead_zone'].parameters['dead_zone']
        low, high = size.interval
        assert low < dead_zone * DEGREE < high
        assert size.estimate == pytest.approx(dead_zone * DEGREE, rel=0.3)
        assert value(found.model, 'dead_zone') == 1.0
    for name, true in (('scale_factor_error', SCALE), ('bias', BIAS_TRUE)):
        known, deviation = estimates(found)[name]
        assert abs(known - true) < 4.0 * deviation


@pytest.mark.parametrize('hertz, frequencies, late, lag, noise, step', (
    (20.0, (0.012, 0.03, 0.05, 0.09), 0.169, 0.0, 0.0, 0.01),
    (20.0, (0.22,), -0.96, 0.1, 0.0, 0.0),
    (10.0, (0.25, 0.6, 0.95), -0.04, 0.015, 0.0, 0.1),
    (20.0, (0.015, 0.04, 0.085), 1.42, 0.0, 0.0015, 0.0),
    (50.0, (0.055, 0.08, 0.13, 0.3), -0.8, 0.0, 0.01, 0.0)))
def test_what_a_delay_and_samples_hide_is_in_the_interval_of_the_scale(
        hertz, frequencies, late, lag, noise, step):
    generator = np.random.default_rng(5)
    time, omega = np.arange(0.0, 200.0, 1.0 / hertz), 2.0 * np.pi * np.array(frequencies)
    waves = np.exp(1j * generator.uniform(0.0, 2.0 * np.pi, len(omega)))
    seen = waves / (1.0 + 1j * omega * lag)
    output = ((1.0 + SCALE) * (np.exp(1j * np.outer(time, omega)) @ seen).imag + BIAS_TRUE
              + 0.02 * DEGREE * generator.standard_normal(len(time)))
    heading = (np.exp(1j * np.outer(time + late, omega)) @ (waves / (1j * omega))).imag
    heading = heading + noise * DEGREE * generator.standard_normal(len(time))
    if step:
        heading = step * DEGREE * np.rint(heading / (step * DEGREE))
    found = diagnosed(Log(output=output, time=time, reference_heading=heading))
    assert {each.effect for each in found.findings if each.status == 'established'} <= {
        'time_offset', 'reference_quantization'}, terminal_lines(found)
    scale, deviation = next(each[2:4] for each in found.model.estimates()
                            if each[0] == SCALE_FACTOR_ERROR.name)
    assert abs(scale - SCALE) < 3.0 * deviation
    assert len(frequencies) == 1 or deviation < 1e-3, deviation


@pytest.mark.parametrize('late', (0.0, 1.2))
@pytest.mark.parametrize('noise', (0.0, 0.02))
def test_a_jump_of_the_heading_is_a_slip_of_the_reference_and_changes_nothing_else(noise, late):
    generator = np.random.default_rng(7)
    time = np.arange(0.0, 150.0, 0.02)
    heading = 2.0 * np.sin(0.6 * (time + late)) + 1.5 * np.cos(1.1 * (time + late))
    output = ((1.0 + SCALE) * (1.2 * np.cos(0.6 * time) - 1.65 * np.sin(1.1 * time)) + BIAS_TRUE
              + 0.05 * DEGREE * generator.standard_normal(len(time)))
    heading += (noise * DEGREE * generator.standard_normal(len(time))
                - 3.0 * DEGREE * (time >= 80.0))
    found = diagnosed(Log(output=output, time=time, reference_heading=heading))
    named = {each.effect: each for each in found.findings if each.status == 'established'}
    assert set(named) - {'time_offset'} == {'reference_slip'}, terminal_lines(found)
    slip = named['reference_slip'].parameters
    assert slip['reference_slip'].estimate == pytest.approx(-3.0 * DEGREE, abs=0.2 * DEGREE)
    assert slip['slip_time_0'].estimate == pytest.approx(80.0)
    assert value(found.model, 'bias') == pytest.approx(BIAS_TRUE, abs=0.003 * DEGREE)


def stop_and_go(generator, time):
    """Return the rate of a robot that turns for one to six seconds at a time, or rests."""
    edges = np.cumsum(generator.uniform(1.0, 6.0, int(time[-1])))
    rates = generator.choice([-1.0, 0.0, 1.0], len(edges)) * generator.uniform(
        2.0, 80.0, len(edges)) * DEGREE
    interval = time[1] - time[0]
    return lfilter([interval / 0.2], [1.0, interval / 0.2 - 1.0], rates[np.searchsorted(
        edges, time)])


def test_turns_between_fixes_of_a_second_are_no_jumps_of_the_heading():
    generator = np.random.default_rng(9)
    time = np.arange(0.0, 400.0, 0.04)
    rate = stop_and_go(generator, time)
    course = np.full(len(time), np.nan)
    course[::25] = (np.cumsum(rate) * 0.04 + 0.02 * rate)[::25]
    course += 0.3 * DEGREE * generator.standard_normal(len(time))
    output = rate + BIAS_TRUE + 0.03 * DEGREE * generator.standard_normal(len(time))
    found = diagnosed(Log(output=output, time=time, reference_heading=course))
    assert 'reference_slip' not in {each.effect for each in found.findings}, terminal_lines(found)


@pytest.mark.parametrize('size', (0.0, 0.2))
def test_a_bias_that_drifts_beside_motion_capture_is_a_ramp_and_one_that_does_not_is_none(size):
    generator = np.random.default_rng(10)
    time = np.arange(0.0, 600.0, 0.04)
    rate, noise = stop_and_go(generator, time), generator.standard_normal((3, len(time)))
    walk = np.cumsum(noise[0]) * 2e-6 * np.sqrt(0.04)
    output = ((1.0 + SCALE) * rate + BIAS_TRUE + size * DEGREE * time / 600.0 + walk
              + 0.05 * DEGREE * noise[1])
    heading = np.cumsum(rate) * 0.04 + 0.05 * DEGREE * noise[2]
    found = diagnosed(Log(output=output, time=time, reference_heading=heading))
    named = established(found)
    assert {*named} <= {'time_offset', *['rate_ramp'] * bool(size)}, terminal_lines(found)
    if size:
        slope = named['rate_ramp'].parameters['rate_ramp'].estimate
        assert slope == pytest.approx(size * DEGREE / 600.0, rel=0.1)


def test_nothing_is_compared_across_a_hole_in_the_samples():
    log = drive(3)
    rows = np.abs(log.time - 100.0) > 12.0
    whole, parts = diagnosed(log), diagnosed(select_rows(log, rows))
    turned = np.ptp(log.reference_heading[np.flatnonzero(~rows)[[0, -1]]])
    assert turned > 20.0 * DEGREE
    assert value(parts.model, 'bias') == pytest.approx(BIAS_TRUE, abs=0.03 * DEGREE)
    assert parts.gain.heading.after < 1.5 * whole.gain.heading.after
    assert {*established(parts)} <= {'time_offset', 'dropped_samples'}


def test_a_course_that_is_repeated_between_its_fixes_is_a_course():
    log = drive(4)
    held = np.full(len(log), np.nan)
    held[::25] = log.reference_heading[::25]
    last = np.maximum.accumulate(np.where(np.isfinite(held), np.arange(len(log)), 0))
    found = diagnosed(replace(log, reference_heading=held[last]))
    assert found.reference.kind == 'course'
    assert value(found.model, 'bias') == pytest.approx(BIAS_TRUE, abs=0.05 * DEGREE)


def test_a_bias_that_held_out_parts_contradict_is_not_offered():
    """The wheels of a robot slip to one side, then to the other, in each sixth of the log."""
    generator = np.random.default_rng(2)
    time = np.arange(0.0, 600.0, 1.0 / RATE)
    rate, side = 0.02 * np.sin(0.7 * time), np.where(time // 100.0 % 2 == 1.0, -1.0, 1.0)
    heading = np.cumsum(rate + 0.01 * side) / RATE
    log = Log(output=rate + 1e-4 * generator.standard_normal(len(time)), time=time,
              reference_heading=2e-3 * np.round(heading / 2e-3))
    found = diagnosed(log)
    assert found.gain.is_worse and not found.model.terms
    assert 'is not offered' in ' '.join(terminal_lines(found))


def turning_log(seed, bias, step=0.0, white=2e-4):
    """Return 240 s beside an encoder of a step, deg, or motion capture; bias at each time, s."""
    generator = np.random.default_rng(seed)
    time = np.arange(0.0, 240.0, 1.0 / RATE)
    knots = generator.uniform(-1.0, 1.0, 122) * (generator.random(122) < 0.7)
    rate = np.interp(time, 2.0 * np.arange(122), knots)
    heading = np.cumsum(rate) / RATE
    output = (1.0 + SCALE) * rate + bias(time, generator) + (
        white * np.sqrt(RATE) * generator.standard_normal(len(time)))
    reference = (step * DEGREE * np.floor(heading / (step * DEGREE)) if step
                 else heading + 0.05 * DEGREE * generator.standard_normal(len(time)))
    return Log(output=output, time=time, reference_heading=reference)


@pytest.mark.parametrize('seed', seeds(1))
def test_a_time_constant_has_the_interval_of_the_profile_of_its_likelihood(seed):
    found = diagnosed(turning_log(seed, lambda time, _: 0.006 * np.exp(-time / 40.0)),
                      kind='motion_capture')
    (warming,) = [each for each in found.findings if each.effect == 'warm_up']
    low, high = warming.parameters['time_constant'].interval
    assert low < warming.parameters['time_constant'].estimate < high
    assert 15.0 < low < 40.0 < high < 100.0


@pytest.mark.parametrize('name, size, step', [
    ('clock_rate', 3e-4, 0.5), ('time_offset', 0.03, 0.0), evidence('clock_rate', 3e-4, 0.0),
    evidence('time_offset', 0.03, 0.5)])
def test_a_delay_that_grows_is_a_clock_rate_and_a_constant_one_is_none(name, size, step):
    log = turning_log(2, lambda time, _: 0.003, step)
    late = log.time * (1.0 + size) if name == 'clock_rate' else log.time - size
    # the sum of the rates is half a sample early
    log = replace(log, output=np.interp(late + 0.5 / RATE, log.time, log.output))
    found = diagnosed(select_rows(log, log.time < 239.0),
                      kind='encoder' if step else 'motion_capture')
    (only,) = established(found).values()
    # where no motion reverses quickly, a lag looks like a constant delay
    assert only.effect == name and {*only.ambiguous_with} <= {'bandwidth'}
    assert only.parameters[name].estimate == pytest.approx(size, rel=0.05)
    # between two clocks it is no property of the gyro
    assert (name in {term.effect.name for term in found.model.terms}) == bool(step)


@pytest.mark.parametrize('name, size, step', [
    ('sine_response', 0.4, 0.1), ('cubic_nonlinearity', 0.02, 0.0),
    evidence('sine_response', 0.4, 0.0), evidence('cubic_nonlinearity', 0.02, 0.1)])
def test_a_sine_response_and_a_cubic_nonlinearity_are_a_set_where_they_look_alike(
        name, size, step):
    log = turning_log(4, lambda time, _: 0.003, step)
    rate = (log.output - 0.003) / (1.0 + SCALE)
    error = (np.sin(size * rate) / size - rate if name == 'sine_response' else size * rate ** 3)
    found = diagnosed(replace(log, output=log.output + error))
    (first,) = (each for name, each in established(found).items() if name != 'time_offset')
    # up to 1 rad/s the sine and its cubic part differ by 0.8 % of it; a positive cubic is no sine
    assert {first.effect, *first.ambiguous_with} == {
        'cubic_nonlinearity', *['sine_response'] * (name == 'sine_response')}
    size_found = first.parameters[first.effect]
    expected = size if first.effect == name else -size ** 2 / 6.0
    assert size_found.estimate == pytest.approx(expected, rel=0.03)
    assert first.effect in {term.effect.name for term in found.model.terms}
    if name == 'sine_response':
        assert sum(first.probability.values()) == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize('seed', seeds(4))
@pytest.mark.parametrize('jump, walk, white, step', [
    (0.0, 1e-4, 2e-4, 0.5), (0.0, 1e-4, 2e-4, 0.0), (0.017, 5e-5, 2e-4, 0.36),
    (3e-4, 0.0, 2e-5, 0.0), (3e-4, 0.0, 2e-5, 0.2)])
def test_a_step_of_the_bias_is_no_random_walk_and_a_walk_no_step(jump, walk, white, step, seed):
    """After it few stretches show it; without a step of the encoder a small one is in the walk."""
    found = diagnosed(turning_log(seed, lambda time, generator: jump * (time > 130.0) + (
        walk and walk * np.cumsum(generator.standard_normal(len(time))) / np.sqrt(RATE)),
        step, white))
    steps = [each for each in found.findings if each.effect == 'bias_step']
    assert len(steps) == bool(jump)
    for each in steps:
        low, high = each.parameters['bias_step'].interval
        assert low < jump < high and high - low < (5e-3 if walk else 2e-4)


HIDDEN = {
    'heading_sensitivity': lambda time, rate, heading, temperature: 0.01 * np.sin(heading + 0.5),
    'bias_temperature': lambda time, rate, heading, temperature: 0.002 * (temperature - 25.0)}


@pytest.mark.parametrize('name', HIDDEN)
def test_a_large_effect_is_established_by_a_course_and_its_model_predicts_the_heading(name):
    found = diagnosed(drive(5, hidden=HIDDEN[name]))
    first = next(each for each in found.findings if each.effect != 'time_offset')
    assert name in (first.effect, *first.ambiguous_with), terminal_lines(found)
    assert first.status == 'established'
    assert (sum(first.probability.values()) == pytest.approx(1.0, abs=0.05)
            and first.share_of_heading_error is not None)
    assert found.gain.models['extended'] < 0.7 * found.gain.models['plain']
    assert first.effect in {term.effect.name for term in found.model.terms}
    errors = found.reference.noise
    assert (f'{errors["reference"] / DEGREE:.2g} deg from point to point, and '
            f'{1000.0 * errors["motion"]:.2g} ms times the rate') in ' '.join(found.remarks)


@pytest.mark.parametrize('ends', [(140.0,), (70.0, 150.0)], ids=str)
def test_a_step_of_the_bias_beside_a_course_is_established_and_in_no_model(ends):
    found = diagnosed(drive(6, hidden=lambda time, rate, heading, temperature: 0.01 * (
        np.searchsorted(ends, time) == 1)))
    assert 'bias_step' not in {term.effect.name for term in found.model.terms}
    steps = sorted((each for each in found.findings if each.effect == 'bias_step'),
                   key=lambda each: each.where)
    assert [each.status for each in steps] == ['established'] * len(ends), terminal_lines(found)
    for each, time, size in zip(steps, ends, (0.01, -0.01)):
        for name, true in (('bias_step', size), ('step_time', time)):
            low, high = each.parameters[name].interval
            assert low < true < high and high - low < (4e-3 if name == 'bias_step' else 10.0)
    assert ('part of the log' in steps[0].cause) == (len(ends) == 2)
    assert ('bias step at ' in ' '.join(terminal_lines(found))) == (len(ends) == 2)
    assert steps[0].where[1] == pytest.approx(ends[1] if len(ends) == 2 else 240.0, abs=5.0)


def turning_once(seed):
    """Return a log of one turn, of which a course that slips shows 10 % too much."""
    generator, time = np.random.default_rng(seed), np.arange(0.0, 240.0, 1.0 / RATE)
    turn = 0.6 * np.sin(np.pi * (time - 200.0) / 6.0) ** 2 * ((time > 200.0) & (time < 206.0))
    fixes = np.arange(0.0, 240.0, 0.2)
    course = (1.1 * np.interp(fixes, time, np.cumsum(turn) / RATE)
              + 0.3 * DEGREE * generator.standard_normal(len(fixes)))
    return Log(time=time, reference_heading=np.interp(time, fixes, course), output=turn
               + BIAS_TRUE + 3e-4 * np.sqrt(RATE) * generator.standard_normal(len(time)))


@pytest.mark.parametrize('lacks_turns', [False, True])
def test_a_reference_that_would_turn_back_each_revolution_is_not_established(lacks_turns):
    """It shows within a revolution, also where a steady turn does not show the scale."""
    generator, time = np.random.default_rng(9), np.arange(0.0, 120.0, 1.0 / RATE)
    rate = 1.2 + 0.3 * np.sin(0.21 * time)
    heading = np.cumsum(rate) / RATE
    for size, named in ((0.3, True), (1.2, False)):
        log = Log(time=time, output=rate + 1e-3 * generator.standard_normal(len(time)),
                  reference_heading=heading - size * np.cos(heading)
                  + 1e-3 * generator.standard_normal(len(time)))
        fit = fit_spans(lay_out_spans(log, 'motion_capture'))
        if lacks_turns:
            fit = replace(fit, effective_stretches=np.ones(len(fit.values)))
        _, found = select_causes(fit, 0.01, lambda share, words: None)
        assert named == ('reference_once_per_rev' in {
            each.cause.cause for each in found if each.is_established}), size


@pytest.mark.parametrize('seed', seeds(2))
def test_a_turn_that_does_not_show_the_scale_shows_nothing_that_follows_the_rate(seed):
    found = diagnosed(turning_once(seed), kind='course')
    assert 'Fewer than three stretches' in ' '.join(found.remarks)
    follow = {'scale_factor_asymmetry', 'quadratic_nonlinearity', 'cubic_nonlinearity'}
    assert not follow & {each.effect for each in found.findings}, terminal_lines(found)
    assert all('three stretches' in found.cannot_show[name] for name in follow)


def test_a_model_that_holds_is_left_as_it_is_and_one_that_does_not_is_reported():
    log = drive(7)
    right = diagnosed(log).model
    again = diagnosed(log, right)
    assert again.model is right and not {'bias', 'scale_factor_error'} & {
        each.effect for each in again.findings}
    wrong = GyroModel((Term(BIAS, (BIAS_TRUE + 0.3 * DEGREE,)),))
    found = diagnosed(log, wrong)
    assert 'bias' in {each.effect for each in found.findings}
    assert value(found.model, 'bias') == pytest.approx(BIAS_TRUE, abs=0.03 * DEGREE)


def test_the_kind_of_a_reference_is_given_or_found():
    log = drive(9)
    exact = replace(log, reference_heading=np.cumsum(log.output) / RATE)
    assert (classify_reference(log).kind == 'course'
            and is_reference_limiting(log, classify_reference(log)))
    assert (classify_reference(exact).kind == 'motion_capture'
            and not is_reference_limiting(exact, classify_reference(exact)))
    assert classify_reference(exact, 'odometry').kind == 'odometry' and is_reference_limiting(
        exact, classify_reference(exact, 'odometry'))
    # noise that a file gives with many digits, and a fine encoder
    turned, noise = exact.reference_heading, 1e-3 * np.random.default_rng(0).standard_normal(
        len(log.time))
    for heading, step, kind in ((turned + noise, 1.7e-6, 'motion_capture'),
                                (turned, 9.59e-5, 'encoder')):
        codes = np.round(heading / step) * step
        assert classify_reference(replace(log, reference_heading=codes)).kind == kind
    assert classify_reference(replace(log, reference_rate=log.output)).kind == 'rate_command'
    assert classify_reference(replace(log, reference_heading=None)).kind == 'rest'
    assert classify_reference(replace(log, reference_rate=np.nan * log.output)).kind == 'course'
    assert (not is_reference_limiting(replace(exact, reference_rate=np.nan * exact.output),
                                      classify_reference(exact)))


ERRING = [ImperfectReference('rate', 0.1), ImperfectReference('rate', 0.5),
          ImperfectReference('capture', 0.05), ImperfectReference('encoder', 0.5)]


@pytest.mark.parametrize('reference', [ERRING[0], evidence(ERRING[1]), *ERRING[2:]], ids=str)
def test_the_noise_of_a_reference_is_no_effect_of_the_gyro(reference):
    # taken for exact, it was named dead zone, bandwidth or delay in nearly every such log
    hidden = hide_with_reference([], 0.0, np.random.default_rng(0), reference)
    found = diagnosed(log_of(hidden))
    assert is_reference_limiting(log_of(hidden), found.reference)
    assert not established(found), terminal_lines(found)
    assert ('times that of the gyro' in ' '.join(found.remarks)) == (reference.kind == 'rate')
    assert {term.effect.name for term in found.model.terms} == {'bias', 'scale_factor_error'}


# not the coarse encoder: sizes take its rounding as new each sample, which at rest it is not
@pytest.mark.parametrize('reference', [ERRING[0], evidence(ERRING[1]), ERRING[2]], ids=str)
def test_an_effect_of_the_rate_is_established_beside_the_noise_of_a_reference(reference):
    hidden = hide_with_reference(['scale_factor_asymmetry'], 5.0, np.random.default_rng(1),
                                 reference)
    named = [*established(diagnosed(log_of(hidden))).values()]
    assert judge_findings(hidden, named).is_right, named
    assert named[0].minimum_detectable > 0.0


def swing(seed, rate, noise, interval=0.04, duration=150.0):
    """Return a log of a motion `rate` of time, with a reference rate of 0.3 times its noise."""
    generator = np.random.default_rng(seed)
    time = np.arange(0.0, duration, interval)
    white = noise / np.sqrt(interval) * generator.standard_normal((2, len(time)))
    true = rate(time)
    return Log(time=time, output=1.01 * true + 1e-3 + white[0],
               reference_rate=true + 0.3 * white[1])


def three_drives(seed, hidden=lambda time, rate, heading, temperature: 0.0, step=0.0):
    """Return drives with a bias and a delay of their own, the last with a step of the bias."""
    generator, logs = np.random.default_rng(seed), []
    biases = generator.normal(0.0, 0.3 * DEGREE, 3)
    for number, bias in enumerate(biases):
        log = drive(seed * 10 + number, 150.0, hidden)
        late = step * (log.time > 90.0) * (number == 2)
        logs.append(replace(log, output=log.output + bias + late, time=1e3 * number + log.time,
                            reference_heading=np.interp(
                                log.time + generator.uniform(-0.4, 0.4), log.time,
                                log.reference_heading)))
    return logs, BIAS_TRUE + biases


@pytest.mark.parametrize('seed', seeds(2))
def test_logs_have_a_bias_and_a_delay_of_their_own_and_share_the_rest(seed):
    logs, biases = three_drives(seed)
    found = diagnose(logs, np.random.default_rng(0), reference_kind='course')
    assert not established(found), terminal_lines(found)
    estimates = {each[0]: each[2:4] for each in found.model.estimates()}
    for name, truth in (('bias', biases.mean()), ('scale_factor_error', SCALE)):
        assert abs(estimates[name][0] - truth) < 3.5 * estimates[name][1], name
    assert estimates['bias'][1] == pytest.approx(  # of one more power-on
        math.sqrt(4.0 / 3.0) * biases.std(ddof=1), abs=0.03 * DEGREE)
    (remark,) = (each for each in found.remarks if 'bias of its own' in each)
    stated = [float(each) for each in remark.split(': ')[1].split(' deg/s')[0].split(', ')]
    assert stated == pytest.approx(biases / DEGREE, abs=0.05)


def test_a_cause_that_one_log_leaves_open_is_established_by_three():
    logs, _ = three_drives(
        1, lambda time, rate, heading, temperature: 0.15 * DEGREE * np.sin(heading))
    name, alone = 'heading_sensitivity', [diagnosed(log, kind='course') for log in logs]
    together = diagnose(logs, np.random.default_rng(0), reference_kind='course')
    assert not all(name in established(each) for each in alone)
    assert name in established(together), [*terminal_lines(together)]


def test_a_step_of_the_bias_is_in_its_log_alone():
    logs, _ = three_drives(2, step=0.8 * DEGREE)
    found = diagnose(logs, np.random.default_rng(0), reference_kind='course')
    step = established(found)['bias_step']
    assert step.evidence.startswith('in log 3, ')
    assert step.where == (pytest.approx(90.0, abs=8.0), pytest.approx(150.0, abs=1.0))
    at = step.parameters['step_time']
    assert at.interval[0] < 90.0 < at.interval[1]
    assert step.parameters['bias_step'].estimate == pytest.approx(
        0.8 * DEGREE, abs=0.06 * DEGREE)


def test_several_logs_with_a_reference_that_errs_are_not_taken_for_exact():
    logs = [swing(seed, lambda time: 0.5 * np.sin(time), 1e-4, duration=30.0) for seed in (1, 2)]
    found = diagnose(logs, np.random.default_rng(0))
    assert not established(found), terminal_lines(found)
    with pytest.raises(DataRefused, match='reference of log 1 .* one kind of reference'):
        diagnose([logs[0], drive(1)], np.random.default_rng(0))
    with pytest.raises(DataRefused, match='log 1 and log 2 have the same output'):
        diagnose([logs[0], logs[0]], np.random.default_rng(0))


def test_logs_of_an_encoder_at_other_sample_rates_have_delays_of_their_own():
    generator, logs = np.random.default_rng(3), []
    for hertz, late, bias in ((100.0, 0.002, 0.1), (25.0, 0.02, 0.4)):
        time = np.arange(0.0, 120.0, 1.0 / hertz)
        heading = 2.0 * np.sin(0.5 * time) + 3.0 * np.sin(0.17 * time)
        rate = np.cos(0.5 * (time - late)) + 0.51 * np.cos(0.17 * (time - late))
        logs.append(Log(time=time, reference_heading=0.5 * DEGREE * np.rint(
            heading / (0.5 * DEGREE)), output=(1.0 + SCALE) * rate + bias * DEGREE
            + 1e-4 * math.sqrt(hertz) * generator.standard_normal(len(time))))
    found = diagnose(logs, np.random.default_rng(0), reference_kind='encoder')
    (delays,) = (each for each in found.remarks if 'delay by its own clock' in each)
    stated = [float(each) for each in delays.split(': ')[1].split(' ms')[0].split(', ')]
    assert stated == pytest.approx([2.0, 20.0], abs=1.0)
    assert value(found.model, 'bias') == pytest.approx(0.25 * DEGREE, abs=0.01 * DEGREE)
    assert value(found.model, 'scale_factor_error') == pytest.approx(SCALE, abs=1e-3)


@pytest.mark.parametrize('seed', seeds(3))
def test_noise_is_no_effect_of_a_motion_in_which_effects_look_alike(seed):
    # in a slow swing, scale, cubic and an error once a revolution nearly cancel each other: what
    # is left of their columns is the noise of the rate that they are made of
    log = swing(seed, lambda time: 0.08 * np.cos(time / 7.0), 6e-4)
    found = diagnosed(log)
    assert not established(found), terminal_lines(found)
    assert value(found.model, 'scale_factor_error') == pytest.approx(0.01, abs=0.004)


def test_an_encoder_whose_codes_pass_evenly_is_not_exact():
    # at a constant rate the rounding of a fine encoder is a saw, 28 times the noise of the gyro
    time, step = np.arange(0.0, 300.0, 0.02), 0.0055 * DEGREE
    turned = 20.0 * DEGREE * np.arcsin(np.sin(0.7 * time))
    for heading, even in ((turned, True), (2.0 * np.sin(0.7 * time), False)):
        log = Log(time=time, output=np.gradient(heading, time)
                  + 7e-5 * np.random.default_rng(6).standard_normal(len(time)),
                  reference_heading=np.floor(heading / step) * step)
        assert (classify_reference(log).kind == 'encoder'
                and is_reference_limiting(log, classify_reference(log)) == even)


def odometry(seed, drift, asymmetry=0.0, warming=0.0):
    """Return a log of motions and rests of 5 to 30 s, with odometry that slips, and the bias."""
    generator = np.random.default_rng(seed)
    time = np.arange(0.0, 240.0, 0.02)
    moves, end, smooth = np.zeros(len(time)), 0.0, np.hanning(31) / np.hanning(31).sum()
    while end < time[-1]:
        begin = end + generator.uniform(5.0, 30.0)
        end = begin + generator.uniform(8.0, 40.0)
        moves[(time >= begin) & (time < end)] = 1.0
    knots = np.arange(0.0, 242.0, 2.0)
    speeds, rates = generator.uniform(0.4, 1.6, len(knots)), generator.normal(0.0, 0.4, len(knots))
    speed, rate = (np.convolve(moves * np.interp(time, knots, each), smooth, 'same')
                   for each in (speeds, rates))
    slip = 0.02 * drift * speed + 0.1 * max(abs(drift), 0.01 * DEGREE) * np.sqrt(
        0.02 * speed) * generator.normal(size=len(time))
    bias = generator.normal(0.0, 0.4) * DEGREE + warming * np.exp(-time / 60.0) + np.cumsum(
        generator.normal(0.0, 1e-6, len(time)))
    output = 1.005 * rate + asymmetry * np.abs(rate) + bias + generator.normal(
        0.0, 1.2e-3, len(time))
    return Log(time=time, output=output, reference_heading=np.cumsum(0.99 * 0.02 * rate + slip)
               ), float(bias.mean())


@pytest.mark.parametrize('seed, drift', [(0, 0.3), (1, -1.0), evidence(2, 3.0)])
def test_rests_determine_the_bias_beside_odometry_that_drifts_in_motion(seed, drift):
    log, bias = odometry(seed, drift * DEGREE)
    fit = calibrate_encoder(log)
    assert abs(fit.fit.bias - bias) < 2.0 * np.sqrt(fit.fit.covariance[1, 1]) < 0.1 * DEGREE
    assert 'against the rests' in fit.remarks[0]
    found = diagnosed(log)
    assert found.reference.kind == 'odometry' and 'drifts' in found.reference.evidence
    assert {*established(found)} <= {'reference_drift', 'time_offset'}, terminal_lines(found)
    size = established(found)['reference_drift'].parameters['reference_drift']
    assert size.estimate == pytest.approx(drift * DEGREE, rel=0.2)
    assert abs(value(found.model, 'bias') - bias) < 0.1 * DEGREE


@pytest.mark.parametrize('hidden', [{}, {'asymmetry': 0.02}, {'warming': 1e-3}], ids=str)
def test_what_the_gyro_does_in_motion_is_no_drift_of_the_reference(hidden):
    drifts = [find_drift(lay_out_spans(odometry(seed, 0.0, **hidden)[0])) for seed in range(10)]
    assert sum(each is not None for each in drifts) <= 1


def wheels(seed, asymmetry=0.0, slip=0.01, noise=0.3 * DEGREE, every=1, lag=0.0, rests=True):
    """Return a log of turns and rests, whose reference is the rate of wheels, and the bias."""
    generator = np.random.default_rng(seed)
    time = np.arange(0.0, 240.0, 0.02)
    rate, end, smooth = np.zeros(len(time)), 0.0, np.hanning(21) / np.hanning(21).sum()
    while end < time[-1]:
        begin = end + rests * generator.choice([0.0, 0.0, generator.uniform(3.0, 8.0)])
        end = begin + generator.uniform(1.0, 4.0)
        rate[(time >= begin) & (time < end)] = generator.normal(0.0, 0.6)
    rate = np.convolve(rate, smooth, 'same')
    bias = generator.normal(0.0, 0.1) * DEGREE
    output = 1.002 * rate + asymmetry * np.abs(rate) + bias + 5e-4 * generator.normal(
        size=len(time))
    slips = lfilter([0.02], [1.0, -0.98], generator.normal(size=len(time)))
    measured = (rate != 0.0) * (rate * (1.0 + slip * slips / slips.std())
                                + noise * generator.normal(size=len(time)))
    measured = np.interp(time + lag, time, measured)
    measured[np.arange(len(time)) % every > 0] = np.nan
    return Log(time=time, output=output, reference_rate=measured), bias


@pytest.mark.parametrize('every', [1, 3])
@pytest.mark.parametrize('asymmetry', [0.0, 0.03])
def test_the_errors_of_a_rate_by_odometry_are_no_effects_of_the_gyro(asymmetry, every):
    # taken for an exact rate, they were a dead zone, steps of the bias or slips
    log, bias = wheels(5, asymmetry, every=every)
    found = diagnosed(log)
    assert found.reference.kind == 'odometry' and 'in turns' in found.reference.evidence
    assert [*established(found)] == ['scale_factor_asymmetry'] * bool(asymmetry)
    assert not found.unexplained
    values = {name: (size, deviation) for name, _, size, deviation in found.model.estimates()}
    assert abs(values['bias'][0] - bias) < 2.5 * values['bias'][1] < 0.03 * DEGREE
    assert abs(values['scale_factor_error'][0] - 0.002) < 2.5 * values['scale_factor_error'][1]
    fit = calibrate_encoder(log)
    assert fit.method == 'course'
    assert abs(fit.fit.bias - bias) < 2.5 * np.sqrt(fit.fit.covariance[1, 1]) < 0.03 * DEGREE


@pytest.mark.parametrize('effect, multiple, noise', [
    ('bias_temperature', 2.0, 'flicker'), ('scale_factor_asymmetry', 5.0, 'white'),
    ('interference_tone', 2.0, 'gauss_markov')])
def test_an_exact_encoder_beside_a_wandering_bias_is_no_odometry(effect, multiple, noise):
    case = Case('effects', (effect,), multiple, noise, 'encoder', int(effect[0] != 'i'))
    assert classify_reference(
        log_of(make_logs(case, random_source(case, 7))[0])).kind == 'encoder'


def integrated(log):
    """Return a log with the heading of its reference rate."""
    known = np.isfinite(log.reference_rate)
    turned = np.full(len(log.time), np.nan)
    turned[known] = cumulative_trapezoid(log.reference_rate[known], log.time[known], initial=0.0)
    return replace(log, reference_rate=None, reference_heading=turned)


@pytest.mark.parametrize('seed', range(2))
def test_the_errors_of_a_heading_by_odometry_are_no_effects_of_the_gyro(seed):
    # taken for motion capture, they were a bandwidth with a delay, or remained unexplained
    found = diagnosed(integrated(wheels(seed)[0]))
    assert found.reference.kind == 'odometry', found.reference
    assert not established(found) and not found.unexplained
    exact = integrated(wheels(seed, slip=0.0, noise=0.0)[0])
    assert classify_reference(exact).kind == 'motion_capture'
    # 21 s alone do not show them
    short = select_rows(integrated(wheels(seed + 10)[0]), slice(0, 1050))
    assert classify_reference(short).kind == 'motion_capture'
    together = diagnose([short, integrated(wheels(seed)[0])], np.random.default_rng(0))
    assert together.reference.kind == 'odometry' and 'as in log 2' in together.reference.evidence
    assert not established(together), terminal_lines(together)


def test_odometry_that_never_rests_is_known_by_errors_that_add_up_in_turns():
    known = []
    for seed in range(8):
        log, bias = wheels(seed, noise=0.05 * DEGREE, rests=False)
        log = integrated(log)
        # errors of motion capture do not add up, and a gyro errs alike at one rate
        exact = integrated(wheels(seed, 0.03, slip=0.0, noise=0.0, rests=False)[0])
        noisy = replace(exact, reference_heading=exact.reference_heading + np.random.default_rng(
            seed).normal(0.0, 0.05 * DEGREE, len(log.time)))
        assert {classify_reference(each).kind for each in (exact, noisy)} == {'motion_capture'}
        if classify_reference(log).kind == 'odometry':
            known.append((log, bias))
    assert len(known) >= 6  # 12 of 14 are known
    for log, bias in known[:2]:
        assert not established(diagnosed(log))
        fit = calibrate_encoder(log)
        assert fit.method == 'course'
        assert abs(fit.fit.bias - bias) < 3.0 * np.sqrt(fit.fit.covariance[1, 1]) < 0.4 * DEGREE


@pytest.mark.parametrize('share', [0.3, 3.0, 20.0])
def test_the_noise_of_a_filtered_heading_is_no_lag_of_the_gyro(share):
    generator = np.random.default_rng(round(share))
    time = np.arange(0.0, 300.0, 0.02)
    rate, left = stop_and_go(generator, time), np.exp(-0.02 / 20.0)
    noise = 1e-3 * share * np.sqrt(0.5 * 20.0)  # after 0.001 rad/√s
    heading = cumulative_trapezoid(rate, time, initial=0.0) + lfilter(
        [noise * np.sqrt(1.0 - left ** 2)], [1.0, -left], generator.standard_normal(len(time)))
    log = Log(time=time, reference_heading=heading, output=1.003 * rate + 2e-3
              + 1e-3 / np.sqrt(0.02) * generator.standard_normal(len(time)))
    assert heading_noise_share(log) == pytest.approx(share, rel=0.3)
    found = diagnosed(log)
    assert not established(found), terminal_lines(found)
    white = 2e-4 * generator.standard_normal(len(time))
    assert heading_noise_share(replace(log, reference_heading=white + cumulative_trapezoid(
        rate, time, initial=0.0))) == 0.0


def test_a_coarse_output_beside_odometry_is_diagnosed_and_drifts_of_neither_are_named():
    log, _ = wheels(5)
    step = 0.2 * DEGREE
    found = diagnosed(replace(log, output=step * np.rint(log.output / step)), kind='odometry')
    assert {*established(found)} <= {'quantization'}, terminal_lines(found)


def test_an_output_without_numbers_is_refused():
    time = np.arange(0.0, 60.0, 0.02)
    with pytest.raises(DataRefused, match='the output of the gyro has no numbers'):
        diagnosed(Log(time=time, output=np.full(len(time), np.nan), reference_heading=time))


@pytest.mark.parametrize('log', [
    wheels(6, slip=0.0, noise=0.0)[0], wheels(6, 0.03, slip=0.0, noise=0.0)[0],
    wheels(6, lag=0.25)[0]], ids=['exact', 'exact, asymmetric', 'late, as after a command'])
def test_a_rate_that_is_exact_or_that_a_motion_follows_late_is_no_odometry(log):
    assert classify_reference(log).kind == 'rate_command'


def test_columns_that_depend_on_each_other_are_evidence_once():
    generator = np.random.default_rng(0)
    x, clusters = generator.standard_normal((400, 1)), [np.arange(400) // 20]
    off = 0.2 * x[:, 0] + generator.standard_normal(400)
    once, twice = (_cluster_robust_chance(each, off, clusters, slice(-1, None))
                   for each in (x, x @ [[1.0, -2.0]]))
    assert once == pytest.approx(twice, rel=1e-9)
    assert once[0] < 0.01
