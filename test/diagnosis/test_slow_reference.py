# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""A reference that is slow, repeats its value, or is a command causes no false names."""

from dataclasses import replace
import re

from chance import seeds
from diagnosed import established, estimates, limited
from gyro_calibration.calibration.encoder import calibrate_encoder, choose_reference
from gyro_calibration.calibration.reference_noise import (
    drop_repeated_references, find_own_instants, keep_own_instants, rate_noise_share)
from gyro_calibration.diagnosis.log_diagnosis import diagnose
from gyro_calibration.logs.log import DataRefused, DEGREE, Log, select_rows
import numpy as np
import pytest
from scipy.signal import lfilter

RATE, BIAS, SCALE = 50.0, 0.4 * DEGREE, 0.006
TIME = np.arange(0.0, 90.0, 1.0 / RATE)


def turning(seed, asymmetry=0.0):
    """Return a log of a robot that turns and stops, its rate, and its heading as functions."""
    generator, fine = np.random.default_rng(seed), np.arange(-1.0, 92.0, 0.004)
    rate, begin = np.zeros(len(fine)), 3.0
    while begin < 90.0:
        end = begin + generator.uniform(0.8, 3.0)
        rate[(fine >= begin) & (fine < end)] = generator.uniform(-70.0, 70.0) * DEGREE
        begin = end + generator.uniform(0.5, 4.0)
    for length in (0.3, 0.2):
        window = np.hanning(round(length / 0.004))
        rate = np.convolve(rate, window / window.sum(), 'same')
    heading = np.cumsum(rate) * 0.004
    own = np.interp(TIME, fine, rate)
    output = ((1.0 + SCALE) * own + asymmetry * np.abs(own) + BIAS
              + 4e-4 * np.sqrt(RATE) * generator.standard_normal(len(TIME)))
    return (Log(time=TIME, output=output), lambda time: np.interp(time, fine, rate),
            lambda time: np.interp(time, fine, heading - 0.002 * rate))


def held(true, interval):
    """Return the last of values that were taken at even instants, at each sample."""
    return true(np.floor((TIME + 1e-9) / interval - 0.3) * interval + 0.3 * interval)


def linear(true, interval):
    """Return lines between values that were taken at even instants, at each sample."""
    at = np.arange(-0.37 * interval, 91.0, interval)
    return np.interp(TIME, at, true(at))


SLOW = {'rate held': ('reference_rate', held, 0.1), 'rate linear': ('reference_rate', linear, 0.2),
        'heading held': ('reference_heading', held, 0.1),
        'heading linear': ('reference_heading', linear, 0.2)}


@pytest.mark.parametrize('asymmetry', [0.0, 0.02])
@pytest.mark.parametrize('name', SLOW)
@pytest.mark.parametrize('seed', seeds(1))
def test_a_slow_reference_shows_the_gyro_and_nothing_else(name, asymmetry, seed):
    quantity, given, interval = SLOW[name]
    log, *true = turning(seed + 3, asymmetry)
    log = replace(log, **{quantity: given(true[quantity == 'reference_heading'], interval)})
    found = diagnose([log], np.random.default_rng(0))
    assert found.remarks[0].startswith('The reference has a value of its own every '
                                       f'{1000.0 * interval:.3g} ms')
    assert {*established(found)} - {'time_offset'} == {*['scale_factor_asymmetry'][:asymmetry > 0]}
    assert not found.unexplained
    assert estimates(found)['scale_factor_error'][0] == pytest.approx(SCALE, abs=2e-3)
    assert estimates(found)['bias'][0] == pytest.approx(BIAS, abs=0.03 * DEGREE)


@pytest.mark.parametrize('seed', seeds(1))
def test_an_encoder_with_empty_cells_between_its_readings_shows_the_values(seed):
    log, _, heading = turning(seed)
    codes = 0.05 * DEGREE * np.round(heading(TIME) / (0.05 * DEGREE))
    codes[np.arange(len(TIME)) % 5 > 0] = np.nan
    found = diagnose([replace(log, reference_heading=codes)], np.random.default_rng(0))
    assert found.reference.kind == 'encoder' and not established(found)
    for name, true in (('bias', BIAS), ('scale_factor_error', SCALE)):
        estimate, deviation = estimates(found)[name]
        assert abs(estimate - true) < 3.0 * deviation < 0.5 * abs(true)


def test_an_encoder_at_steady_rates_has_a_reading_in_each_sample():
    rate = np.convolve(np.repeat([0.0, 20.0, -20.0, 40.0, -40.0, 0.0], 900), np.full(20, 0.05))
    time, codes = 0.01 * np.arange(len(rate)), np.round(np.cumsum(0.02 * rate)) * 0.5 * DEGREE
    assert find_own_instants(time, codes) is None
    swing = np.round(180.0 * np.sin(0.5 * time)) * 0.5 * DEGREE
    assert find_own_instants(time, swing) is None
    slow = find_own_instants(time, np.interp(time, time[::5], swing[::5]))
    assert slow is not None and slow.interval == pytest.approx(0.05)


def test_a_reference_that_is_smoother_than_the_motion_has_a_share_of_the_residual():
    log, rate, _ = turning(3)
    window = np.hanning(12)[1:-1]
    smoothed = np.convolve(rate(TIME), window / window.sum(), 'same')
    smoothed[1::2] = np.nan  # as the last sample
    found = diagnose([replace(log, reference_rate=smoothed)], np.random.default_rng(0))
    assert [each.along for each in found.unexplained] == ['rate_change']
    assert 0.9 < found.unexplained[0].share_of_variance <= 1.0


def test_all_verbs_take_the_heading_where_a_rate_is_late_and_state_that_once():
    """The twist of odometry is often a mean over the last second, and its pose is not."""
    log, rate, heading = turning(4)
    late = np.mean([rate(TIME - back) for back in np.arange(0.0, 1.2, 0.02)], axis=0)
    log = replace(log, reference_heading=heading(TIME))
    alone, both = (diagnose([each], np.random.default_rng(0))
                   for each in (log, replace(log, reference_rate=late)))
    fitted = calibrate_encoder(replace(log, reference_rate=late))
    for found in (both, fitted):
        remarks = [each for each in found.remarks if 'the heading is used' in each]
        assert len(remarks) == 1, found.remarks
        assert remarks[0].startswith('The reference rate is 0.6 s behind the reference heading')
    assert [each.effect for each in both.findings] == [each.effect for each in alone.findings]
    assert both.model.terms == alone.model.terms
    assert fitted.fit.scale_factor_error == pytest.approx(SCALE, abs=2e-3)
    assert fitted.model.terms == calibrate_encoder(log).model.terms


def test_a_heading_that_is_seldom_known_gives_way_to_the_rate():
    log, rate, heading = turning(4)
    log = replace(log, reference_rate=rate(TIME), reference_heading=np.where(
        TIME < 40.0, heading(TIME), np.nan))
    left, remarks = choose_reference(log)
    assert left.reference_heading is None and 'heading is known in 2000 samples only' in remarks[0]
    assert choose_reference(replace(log, reference_heading=heading(TIME)))[1] == []
    still = np.zeros_like(TIME)
    assert choose_reference(replace(log, reference_rate=still, reference_heading=still))[1] == []


def test_headings_that_are_repeated_while_the_gyro_turns_are_not_used():
    log, _, heading = turning(5)
    tracked = heading(TIME)
    assert drop_repeated_references(replace(log, reference_heading=tracked))[1] == []
    moving = np.flatnonzero(np.abs(log.output - BIAS) > 20.0 * DEGREE)
    for start in moving[[200, 600, 1000]].tolist():
        tracked[start:start + 150] = tracked[start]
    log = replace(log, reference_heading=tracked)
    fit = calibrate_encoder(log)
    assert 'as if it were lost' in fit.remarks[0]
    assert fit.fit.bias == pytest.approx(BIAS, abs=0.01 * DEGREE)
    found = diagnose([log], np.random.default_rng(0))
    assert found.verdict == 'adequate', found
    assert 'as if it were lost' in found.remarks[0]
    assert found.model.terms[1].values[0] == pytest.approx(SCALE, abs=2e-3)
    still = diagnose([replace(log, reference_heading=0.0 * tracked)], np.random.default_rng(0))
    assert [each.name for each in still.gates if each.passed is False] == ['motion']
    assert still.verdict == 'mismatched'


def test_a_scale_factor_error_hides_no_heading_that_is_repeated():
    log, rate, heading = turning(5)
    log, tracked = replace(log, output=1.1 * log.output), heading(TIME)
    assert drop_repeated_references(replace(log, reference_heading=tracked))[1] == []
    slow = (np.abs(rate(TIME)) > 2.0 * DEGREE) & (np.abs(rate(TIME)) < 8.0 * DEGREE)
    start = next(place for place in np.flatnonzero(slow) if slow[place:place + 20].all())
    tracked[start:start + 20] = tracked[start]
    kept, _ = drop_repeated_references(replace(log, reference_heading=tracked))
    assert np.array_equal(np.flatnonzero(np.isnan(kept.reference_heading)),
                          np.arange(start + 1, start + 20))


@pytest.mark.parametrize('seed', seeds(2))
def test_a_rate_that_is_repeated_while_the_gyro_turns_is_not_used(seed):
    log, true, _ = turning(seed)
    rate = true(TIME)
    assert drop_repeated_references(replace(log, reference_rate=rate))[1] == []
    start = np.flatnonzero((np.abs(rate) > 20.0 * DEGREE) & (TIME > 20.0))[0]
    away = np.abs(rate - rate[start]) > 20.0 * DEGREE
    rate[start:np.flatnonzero(away & (TIME - TIME[start] > 15.0))[0]] = rate[start]
    found = diagnose([replace(log, reference_rate=rate)], np.random.default_rng(0))
    assert found.verdict == 'adequate', found
    assert 'as if it were lost' in found.remarks[0]
    assert found.model.terms[1].values[0] == pytest.approx(SCALE, abs=2e-3)


@pytest.mark.parametrize('seed', [1, 2, 7])
def test_rests_in_which_the_bias_wanders_are_no_lost_reference(seed):
    generator, interval, count, white = np.random.default_rng(seed), 0.1, 12000, 1e-4
    dwells = np.where(np.arange(60) % 3, generator.uniform(-1.5, 1.5, 60), 0.0)
    rate = np.convolve(np.repeat(dwells, count // 60), np.ones(3) / 3.0, 'same')
    # a random walk that exceeds the white noise after a second
    output = (rate + white / np.sqrt(interval) * generator.standard_normal(count)
              + np.sqrt(3.0 * interval) * white * np.cumsum(generator.standard_normal(count)))
    heading = np.append(0.0, np.cumsum(0.5 * interval * (rate[1:] + rate[:-1])))
    log = Log(time=interval * np.arange(count), output=output, reference_heading=heading)
    assert drop_repeated_references(log)[1] == []


def test_the_instants_of_a_held_rate_are_found_beside_a_gap():
    """Two of them might be the same at the end of the gap, and no spline goes through these."""
    time = np.arange(6000) / 50.0
    for seed in range(40):
        generator = np.random.default_rng(seed)
        motion = sum(size * np.sin(2.0 * np.pi * frequency * time) for size, frequency in zip(
            generator.uniform(0.1, 0.5, 3), generator.uniform(0.02, 0.3, 3)))
        measured = motion[np.arange(6000) // 5 * 5]
        begin, length = generator.integers([500, 10], [5000, 300])
        kept = np.delete(np.arange(6000), slice(begin, begin + length))
        _, instants = keep_own_instants(Log(
            time=time[kept], reference_rate=measured[kept],
            output=(motion + 0.01 * generator.standard_normal(6000))[kept]))
        known = instants.time[np.isfinite(instants.time)]
        assert (np.diff(known) > 0.0).all() and len(known) == pytest.approx(len(kept) / 5, rel=0.1)


# A commanded rate, which the motion follows late, by a response of its own

INTERVAL, SUBSTEPS, COUNT = 0.05, 20, 3000
S, B = 0.012, 0.3 * DEGREE


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
    late = np.append(np.zeros(round(delay * SUBSTEPS / INTERVAL)), command)[:len(command)]
    pace = frequency * INTERVAL / SUBSTEPS
    kept = 1.0 - 2.0 * damping * pace
    return lfilter([pace ** 2], [1.0, pace ** 2 - kept - 1.0, kept], late)


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
    output = ((1.0 + S) * rate + B + added(rate, time)
              + noise / np.sqrt(INTERVAL) * generator.standard_normal(COUNT))
    return Log(output=output, time=time, reference_rate=command[::SUBSTEPS])


TRUE = {'bias': B, 'scale_factor_error': S}


def check_lag_alone(log, lag=None, largest=np.inf, kind=None, known=(*TRUE,)):
    """Diagnose a log whose lag, s, and values are known; 4 deviations of the scale are limited."""
    found = diagnose([log], np.random.default_rng(0), reference_kind=kind)
    assert {*established(found)} == {'reference_lag'} and not found.unexplained
    assert {term.effect.name for term in found.model.terms} == {*TRUE}
    assert 'lag of its own' in found.cannot_show['time_offset']
    if lag is not None:
        size = established(found)['reference_lag'].parameters['reference_lag']
        assert size.estimate == pytest.approx(lag, abs=0.03)
    for name in known:
        value, deviation = estimates(found)[name]
        assert abs(value - TRUE[name]) < 4.0 * deviation
    assert 4.0 * estimates(found)['scale_factor_error'][1] < largest
    return found


@pytest.mark.parametrize('kind, noise', [('steps', 3e-4), ('trapezoids', 3e-4), ('swing', 3e-4),
                                         ('trapezoids', 3e-5)])
def test_the_lag_of_a_robot_is_no_effect_of_its_gyro(kind, noise):
    check_lag_alone(commanded_log(kind, noise, 1), 0.08 + 2.0 * 0.7 / 8.0)


def test_a_command_may_be_recorded_ten_times_a_second():
    check_lag_alone(select_rows(commanded_log('trapezoids', 3e-4, 1), slice(None, None, 2)))


def turns_between_samples(seed):
    """Return a log at 50 Hz of a robot 0.4 s late, whose command is sent at 20 Hz."""
    generator = np.random.default_rng(seed)
    sizes = np.ravel([[0.0, each] for each in generator.choice([-0.8, 0.8], 16)])
    command = np.repeat(sizes, 50 * generator.integers(40, 160, len(sizes)))  # at 1000 Hz
    rate = lfilter([0.0025], [1.0, -0.9975], command)[::20]
    time = 0.02 * np.arange(len(rate))
    return Log(output=(1.0 + S) * rate + B + 2e-3 * generator.standard_normal(len(rate)),
               time=time, reference_rate=command[::20])


@pytest.mark.parametrize('seed', seeds(2))
def test_a_command_may_change_between_the_samples_of_a_log(seed):
    """Each change is seen up to a sample late; not the dwells alone show the gyro, all does."""
    assert not check_lag_alone(turns_between_samples(seed), kind='rate_command').remarks


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
    delay, frequency, damping = robot
    check_lag_alone(
        commanded_log(kind, 3e-4, 70 + seed, lambda rate, time: wander, robot=robot),
        delay + 2.0 * damping / frequency, 0.008, 'rate_command', ('scale_factor_error',))


@pytest.mark.parametrize('kind, effect, added', [
    ('trapezoids', 'cubic_nonlinearity', lambda rate, time: 0.006 * rate ** 3),
    ('swing', 'bias_step', lambda rate, time: 4e-3 * (time > 80.0)),
    ('steps', 'bias_step', lambda rate, time: 4e-3 * (time > 80.0))])
def test_an_effect_of_the_gyro_is_found_beside_the_lag(kind, effect, added):
    found = diagnose([commanded_log(kind, 2e-4, 2, added)], np.random.default_rng(0))
    assert {*established(found)} == {'reference_lag', effect}


@pytest.mark.parametrize('asymmetry', [0.0, 0.02])
@pytest.mark.parametrize('kind, jitter', [('steps', 0.0), ('steps', 0.1), ('trapezoids', 0.0),
                                          ('trapezoids', 0.1), ('swing', 0.0)])
@pytest.mark.parametrize('seed', seeds(1))
def test_a_command_at_5_hz_shows_the_gyro_and_the_lag_alone(kind, jitter, asymmetry, seed):
    log = commanded_log(kind, 1e-4, 40 + seed, lambda rate, time: asymmetry * np.abs(rate), 0.2,
                        jitter)
    found = diagnose([log], np.random.default_rng(0))
    assert {*established(found)} == {
        'reference_lag', *['scale_factor_asymmetry'] * bool(asymmetry)} and not found.unexplained
    assert estimates(found)['scale_factor_error'][0] == pytest.approx(S, abs=2e-3)
    assert estimates(found)['bias'][0] == pytest.approx(B, abs=0.03 * DEGREE)


@pytest.mark.parametrize('kind', ['steps', 'trapezoids'])
@pytest.mark.parametrize('limit, period', [(0.5, 0.2), (1.0, 0.2), (1.0, 0.0)])
@pytest.mark.parametrize('seed', seeds(1))
def test_a_limit_of_acceleration_leaves_the_gyro_known(kind, limit, period, seed):
    log = commanded_log(kind, 1e-4, 51 + seed, period=period, limit=limit)
    found = check_lag_alone(log, largest=2e-3, known=('scale_factor_error',))
    stated = re.search('at most (.*) rad/s² and slows down by at most (.*) rad/s²',
                       found.findings[0].evidence)
    assert [float(each) for each in stated.groups()] == pytest.approx([limit, limit], rel=0.05)


@pytest.mark.parametrize('kind', ['trapezoids', 'swing'])
def test_what_follows_a_hole_in_the_command_is_left_out(kind):
    """The motion follows commands that are not known, by an unknown lag."""
    log = commanded_log(kind, 3e-5, 4)
    log.reference_rate[1400:1460] = np.nan
    check_lag_alone(log, 0.08 + 2.0 * 0.7 / 8.0, 4e-3, 'rate_command', ('scale_factor_error',))


def test_a_swing_that_a_slow_robot_repeats_is_refused():
    """Any waveform is a response to it, of any scale."""
    step = INTERVAL / SUBSTEPS
    command = 0.8 * np.sign(np.sin(2.0 * np.pi / 8.0 * step * np.arange(COUNT * SUBSTEPS)))
    rate = followed(limited(command, 0.6 * step), 0.08, 20.0, 0.7)[::SUBSTEPS]
    generator = np.random.default_rng(0)
    log = Log(time=INTERVAL * np.arange(COUNT), reference_rate=command[::SUBSTEPS],
              output=(1.0 + S) * rate + B + 1e-3 * generator.standard_normal(COUNT))
    with pytest.raises(DataRefused, match='in a swing that repeats: turn at several rates'):
        diagnose([log], generator, reference_kind='rate_command')
