# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""What a motion does beside its commanded rate is not named as an effect of the gyro."""

from dataclasses import replace
import re

from chance import seeds
from gyro_calibration.calibration.encoder import calibrate_encoder
from gyro_calibration.calibration.reference_noise import rate_noise_share
from gyro_calibration.diagnosis.log_diagnosis import diagnose
from gyro_calibration.logs.log import DataRefused, DEGREE, Log
import numpy as np
import pytest
from scipy.signal import lfilter

INTERVAL, SUBSTEPS, COUNT = 0.05, 20, 3000
SCALE, BIAS = 0.012, 0.3 * DEGREE


def commanded(kind, generator):
    """Return a commanded rate in steps, trapezoids or a swing, at fine steps, rad/s."""
    time = np.arange(COUNT * SUBSTEPS) * INTERVAL / SUBSTEPS
    if kind == 'swing':
        ends = np.linspace(0.0, time[-1], 12)
        size, frequency = (np.interp(time, ends, generator.uniform(*between, 12))
                           for between in ((0.5, 1.5), (0.05, 0.3)))
        return size * np.sin(2.0 * np.pi * np.cumsum(frequency) * INTERVAL / SUBSTEPS)
    ramp = 0.01 if kind == 'steps' else 0.8
    stops, rates = [0.0, 4.0], [0.0, 0.0]
    while stops[-1] < time[-1]:
        rate = generator.choice([-1, 1]) * generator.uniform(0.2, 1.5)
        hold, rest = generator.uniform((2.0, 1.0), (6.0, 4.0))
        stops += np.add(stops[-1], np.cumsum([ramp, hold, ramp, rest])).tolist()
        rates += [rate, rate, 0.0, 0.0]
    return np.interp(time, stops, rates)


def followed(command, delay, frequency, damping):
    """Return the rate of a robot that follows a command late, as a system of second order."""
    late = round(delay * SUBSTEPS / INTERVAL)
    step, rate, change, rates = INTERVAL / SUBSTEPS, 0.0, 0.0, []
    for wanted in np.concatenate([np.zeros(late), command]).tolist()[:len(command)]:
        change += step * (frequency ** 2 * (wanted - rate) - 2.0 * damping * frequency * change)
        rate += step * change
        rates.append(rate)
    return np.array(rates)


def limited(command, most):
    """Return a command that changes by no more than so much at a time."""
    rates = [command[0]]
    for wanted in command[1:].tolist():
        rates.append(rates[-1] + min(max(wanted - rates[-1], -most), most))
    return np.array(rates)


def commanded_log(kind, noise, seed, added=lambda rate, time: 0.0, period=0.0, jitter=0.0,
                  robot=(0.08, 8.0, 0.7), limit=None):
    """
    Return a log of a robot with its command, which may be held, as the reference rate.

    The robot may limit the acceleration of what it is commanded, in rad/s².
    """
    generator = np.random.default_rng(seed)
    command = commanded(kind, generator)
    if period:
        every = round(period / INTERVAL * SUBSTEPS)
        sent = np.arange(0, len(command), every)
        sent[1:] += np.rint(jitter * every * generator.standard_normal(len(sent) - 1)).astype(int)
        command = command[np.repeat(sent, np.diff(sent, append=len(command)))]
    wanted = limited(command, limit * INTERVAL / SUBSTEPS) if limit else command
    rate = followed(wanted, *robot)[::SUBSTEPS]
    time = np.arange(COUNT) * INTERVAL
    output = ((1.0 + SCALE) * rate + BIAS + added(rate, time)
              + noise / np.sqrt(INTERVAL) * generator.standard_normal(COUNT))
    return Log(output=output, time=time, reference_rate=command[::SUBSTEPS])


@pytest.mark.parametrize('kind, noise', [('steps', 3e-4), ('trapezoids', 3e-4), ('swing', 3e-4),
                                         ('trapezoids', 3e-5)])
def test_the_lag_of_a_robot_is_no_effect_of_its_gyro(kind, noise):
    found = diagnose([commanded_log(kind, noise, 1)], np.random.default_rng(0))
    named = {each.effect: each for each in found.findings if each.status == 'established'}
    assert {*named} == {'reference_lag'}
    lag = named['reference_lag'].parameters['reference_lag']
    assert lag.estimate == pytest.approx(0.08 + 2.0 * 0.7 / 8.0, abs=0.03)
    assert {term.effect.name for term in found.model.terms} == {'bias', 'scale_factor_error'}
    assert 'lag of its own' in found.cannot_show['time_offset']
    values = {name: (value, deviation) for name, _, value, deviation in found.model.estimates()}
    for name, true in (('bias', BIAS), ('scale_factor_error', SCALE)):
        assert abs(values[name][0] - true) < 4.0 * values[name][1]


def test_a_command_may_be_recorded_ten_times_a_second():
    log = commanded_log('trapezoids', 3e-4, 1)
    slow = Log(output=log.output[::2], time=log.time[::2], reference_rate=log.reference_rate[::2])
    found = diagnose([slow], np.random.default_rng(0))
    assert {each.effect for each in found.findings} == {'reference_lag'}
    values = {name: (value, deviation) for name, _, value, deviation in found.model.estimates()}
    for name, true in (('bias', BIAS), ('scale_factor_error', SCALE)):
        assert abs(values[name][0] - true) < 4.0 * values[name][1]


def turns_between_samples(seed):
    """Return a log at 50 Hz of a robot 0.4 s late, whose command is sent at 20 Hz."""
    generator = np.random.default_rng(seed)
    sizes = np.ravel([[0.0, each] for each in generator.choice([-0.8, 0.8], 16)])
    command = np.repeat(sizes, 50 * generator.integers(40, 160, len(sizes)))  # at 1000 Hz
    rate = lfilter([0.0025], [1.0, -0.9975], command)[::20]
    time = 0.02 * np.arange(len(rate))
    return Log(output=(1.0 + SCALE) * rate + BIAS + 2e-3 * generator.standard_normal(len(rate)),
               time=time, reference_rate=command[::20])


@pytest.mark.parametrize('seed', seeds(2))
def test_a_command_may_change_between_the_samples_of_a_log(seed):
    """Each change is seen up to a sample late; not the dwells alone show the gyro, all does."""
    found = diagnose([turns_between_samples(seed)], np.random.default_rng(0),
                     reference_kind='rate_command')
    assert {each.effect for each in found.findings if each.status == 'established'} == {
        'reference_lag'} and not found.remarks
    values = {name: (value, deviation) for name, _, value, deviation in found.model.estimates()}
    for name, true in (('bias', BIAS), ('scale_factor_error', SCALE)):
        value, deviation = values[name]
        assert abs(value - true) < 4.0 * deviation


def test_a_late_motion_is_compared_with_its_command_however_that_jitters():
    log = commanded_log('swing', 3e-4, 1, period=0.1, jitter=0.1, robot=(0.2, 8.0, 0.7))
    assert rate_noise_share(log, True) == 0.0
    sample = replace(log, reference_rate=log.reference_rate + 0.01 * np.random.default_rng(
        1).standard_normal(len(log)))
    assert rate_noise_share(sample, True) == 0.0
    # which a rate that was measured is not
    prompt = commanded_log('swing', 3e-4, 1, robot=(0.0, 40.0, 1.0))
    assert rate_noise_share(replace(sample, output=prompt.output), True) > 0.1


@pytest.mark.parametrize('robot', [(0.0, 1.6, 0.4), (0.1, 4.0, 1.0)])
@pytest.mark.parametrize('kind, walk', [('trapezoids', 0.0), ('trapezoids', 0.3), ('swing', 0.0)])
@pytest.mark.parametrize('seed', seeds(1))
def test_a_slow_or_ringing_robot_leaves_the_scale_as_it_is(kind, walk, robot, seed):
    """In a walk of the bias, too, which is as large as the white noise after 3 s."""
    wander = 3e-4 * walk * np.sqrt(3.0 * INTERVAL) * np.cumsum(
        np.random.default_rng(900 + seed).standard_normal(COUNT))
    log = commanded_log(kind, 3e-4, 70 + seed, lambda rate, time: wander, robot=robot)
    found = diagnose([log], np.random.default_rng(0), reference_kind='rate_command')
    named = {each.effect: each for each in found.findings if each.status == 'established'}
    assert {*named} == {'reference_lag'}
    delay, frequency, damping = robot
    lag = named['reference_lag'].parameters['reference_lag']
    assert lag.estimate == pytest.approx(delay + 2.0 * damping / frequency, abs=0.03)
    (scale, deviation), = [(value, deviation) for name, _, value, deviation
                           in found.model.estimates() if name == 'scale_factor_error']
    assert abs(scale - SCALE) < 4.0 * deviation < 0.008


@pytest.mark.parametrize('kind, effect, added', [
    ('trapezoids', 'cubic_nonlinearity', lambda rate, time: 0.006 * rate ** 3),
    ('swing', 'bias_step', lambda rate, time: 4e-3 * (time > 80.0)),
    ('steps', 'bias_step', lambda rate, time: 4e-3 * (time > 80.0))])
def test_an_effect_of_the_gyro_is_found_beside_the_lag(kind, effect, added):
    found = diagnose([commanded_log(kind, 2e-4, 2, added)], np.random.default_rng(0))
    assert {each.effect for each in found.findings if each.status == 'established'} == {
        'reference_lag', effect}


@pytest.mark.parametrize('asymmetry', [0.0, 0.02])
@pytest.mark.parametrize('kind, jitter', [('steps', 0.0), ('steps', 0.1), ('trapezoids', 0.0),
                                          ('trapezoids', 0.1), ('swing', 0.0)])
@pytest.mark.parametrize('seed', seeds(1))
def test_a_command_at_5_hz_shows_the_gyro_and_the_lag_alone(kind, jitter, asymmetry, seed):
    log = commanded_log(kind, 1e-4, 40 + seed, lambda rate, time: asymmetry * np.abs(rate), 0.2,
                        jitter)
    found = diagnose([log], np.random.default_rng(0))
    assert {each.effect for each in found.findings if each.status == 'established'} == {
        'reference_lag', *['scale_factor_asymmetry'] * bool(asymmetry)}
    assert not found.unexplained
    values = {term.effect.name: term.values[0] for term in found.model.terms}
    assert values['scale_factor_error'] == pytest.approx(SCALE, abs=2e-3)
    assert values['bias'] == pytest.approx(BIAS, abs=0.03 * DEGREE)


@pytest.mark.parametrize('kind', ['steps', 'trapezoids'])
@pytest.mark.parametrize('limit, period', [(0.5, 0.2), (1.0, 0.2), (1.0, 0.0)])
@pytest.mark.parametrize('seed', seeds(1))
def test_a_limit_of_acceleration_leaves_the_gyro_known(kind, limit, period, seed):
    log = commanded_log(kind, 1e-4, 51 + seed, period=period, limit=limit)
    found = diagnose([log], np.random.default_rng(0))
    assert {each.effect for each in found.findings if each.status == 'established'} == {
        'reference_lag'} and not found.unexplained
    (scale, deviation), = [(value, deviation) for name, _, value, deviation
                           in found.model.estimates() if name == 'scale_factor_error']
    assert abs(scale - SCALE) < 4.0 * deviation < 2e-3
    stated = re.search('at most (.*) rad/s² and slows down by at most (.*) rad/s²',
                       found.findings[0].evidence)
    assert [float(each) for each in stated.groups()] == pytest.approx([limit, limit], rel=0.05)


@pytest.mark.parametrize('kind', ['trapezoids', 'swing'])
def test_what_follows_a_hole_in_the_command_is_left_out(kind):
    """The motion follows commands that are not known, by an unknown lag."""
    log = commanded_log(kind, 3e-5, 4)
    log.reference_rate[1400:1460] = np.nan
    found = diagnose([log], np.random.default_rng(0), reference_kind='rate_command')
    named, = (each for each in found.findings if each.status == 'established')
    lag = named.parameters['reference_lag']
    assert lag.estimate == pytest.approx(0.08 + 2.0 * 0.7 / 8.0, abs=0.03)
    (scale, deviation), = [(value, deviation) for name, _, value, deviation
                           in found.model.estimates() if name == 'scale_factor_error']
    assert abs(scale - SCALE) < 4.0 * deviation < 4e-3


def test_a_swing_that_a_slow_robot_repeats_is_refused():
    """Any waveform is a response to it, of any scale."""
    step = INTERVAL / SUBSTEPS
    command = 0.8 * np.sign(np.sin(2.0 * np.pi / 8.0 * step * np.arange(COUNT * SUBSTEPS)))
    rate = followed(limited(command, 0.6 * step), 0.08, 20.0, 0.7)[::SUBSTEPS]
    generator = np.random.default_rng(0)
    log = Log(time=INTERVAL * np.arange(COUNT), reference_rate=command[::SUBSTEPS],
              output=(1.0 + SCALE) * rate + BIAS + 1e-3 * generator.standard_normal(COUNT))
    with pytest.raises(DataRefused, match='in a swing that repeats: turn at several rates'):
        diagnose([log], generator, reference_kind='rate_command')


def test_a_command_that_is_held_between_updates_has_no_noise():
    log = commanded_log('swing', 3e-4, 3)
    held = log.reference_rate[np.arange(COUNT) // 4 * 4]
    assert rate_noise_share(Log(output=log.output, time=log.time, reference_rate=held)) == 0.0


def test_a_scale_is_fitted_beside_the_lag_of_a_swing():
    """A lag attenuates a swing, by 2 % at 0.2 Hz here."""
    errors = []
    for seed in range(4):
        fit = calibrate_encoder(commanded_log('swing', 3e-4, seed)).fit
        errors.append((fit.scale_factor_error - SCALE) / np.sqrt(fit.covariance[0, 0]))
    assert np.abs(errors).max() < 4.0
