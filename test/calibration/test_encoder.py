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
Calibration against an encoder.

What was put in is found, with true intervals, on simulated logs and on measured ones.
"""

from dataclasses import replace
import math

from chance import fewest
from encoder_intervals import run, run_eccentric, run_motion, run_smoothing
from gyro_calibration.calibration.dwells import find_dwells
from gyro_calibration.calibration.encoder import calibrate, calibrate_encoder
from gyro_calibration.calibration.run_faults import drop_dead_output
from gyro_calibration.calibration.scatter import rms
from gyro_calibration.logs.log import DataRefused, DEGREE, Log, read_log
from gyro_calibration.model.motion import motion_from_rates
from gyro_calibration.model.noise import Noise, simulate_noise
import numpy as np
import pytest
from scipy.ndimage import uniform_filter1d

S, B = 0.02, 0.3 * DEGREE
INTERVAL = 0.01


def swing(duration, speed=60.0, period=8.0):
    """Return turns to and fro at a speed, deg/s, with ramps of 0.3 s and rests of 0.4 s."""
    half = np.cumsum([0.0, 0.3, period / 2 - 1.0, 0.3])
    knots = np.concatenate([half + start for start in np.arange(0.0, duration, period / 2)])
    rates = np.concatenate([np.array([0.0, 1.0, 1.0, 0.0]) * sign * speed * DEGREE
                            for sign in np.resize([1.0, -1.0], len(knots) // 4)])
    return motion_from_rates(knots, rates)


def log_of(motion, duration, noise=None, generator=None, step=0.088 * DEGREE, late=0.0):
    """Return the log of a gyro on an encoder, sampled at 100 Hz; the gyro is late by so many s."""
    time = np.arange(round(duration / INTERVAL)) * INTERVAL
    output = (1 + S) * motion.rate_at(time - late) + B
    if noise is not None:
        output = output + simulate_noise(noise, len(time), INTERVAL, generator)
    return Log(output=output, time=time,
               reference_heading=np.round(motion.heading_at(time) / step) * step)


SWING = swing(120.0)
CLEAN = log_of(SWING, 100.0)
NOISY = log_of(SWING, 100.0, Noise(1e-4), np.random.default_rng(64))


def test_the_model_holds_what_was_found():
    found = calibrate_encoder(
        replace(CLEAN, temperature=np.linspace(20.0, 30.0, len(CLEAN))))
    assert {term.effect.name: term.values[0] for term in found.model.terms} == {
        'bias': found.fit.bias, 'scale_factor_error': found.fit.scale_factor_error}
    assert found.model.rate_range == (CLEAN.output.min(), CLEAN.output.max())
    assert found.model.covariance[0, 0] == found.fit.covariance[1, 1]
    assert (found.model.temperature_range, found.model.reference_temperature) == (
        (20.0, 30.0), pytest.approx(25.0))
    assert np.abs(found.residual_before).max() > 10 * DEGREE
    assert rms(found.residual_after) < 0.05 * DEGREE


LATE = np.arange(len(CLEAN)) < 9990
REST = motion_from_rates(np.array([0.0, 100.0]), np.array([0.5, 0.5]))
REFUSED = {'no heading': (replace(CLEAN, reference_heading=None), 'reference_heading_deg'),
           'no time': (replace(CLEAN, time=None), 'time_s'), 'lost reference': (
               replace(CLEAN, reference_heading=np.where(LATE, np.nan, CLEAN.reference_heading)),
               'in 10 of 10000 samples; at least 100 are needed: repair its line'),
           'few fixes': (replace(CLEAN, reference_heading=np.where(
               np.arange(len(CLEAN)) % 200, np.nan, CLEAN.reference_heading)),
               'a value in 50 of 10000 samples; at least 100 are needed: record longer, 198 s'),
           'lost gyro': (replace(CLEAN, output=np.where(LATE, np.nan, CLEAN.output)),
                         'the gyro has a value in 10'),
           'short': (log_of(SWING, 5.0), 'at least 10 s'),
           'nearly long enough': (log_of(SWING, 9.99), 'lasts 9.9 s; at least 10 s'),
           'at rest': (log_of(motion_from_rates(np.array([0.0, 100.0]), np.zeros(2)), 100.0),
                       'the reference does not turn'),
           'a gap': (replace(CLEAN, time=CLEAN.time + 1e6 * (CLEAN.time > 50.0)),
                     'no samples for 1000000.0 s from 50.0 s on'),
           'one speed': (log_of(REST, 100.0),
                         'in both senses, or at another speed too, or with a rest'),
           'other way': (replace(CLEAN, output=-CLEAN.output), '--invert'),
           'dead': (replace(CLEAN, output=0.0 * CLEAN.output), 'the gyro is dead'),
           'clipped': (replace(NOISY, output=np.minimum(NOISY.output, 0.9)),
                       'the gyro is saturated')}


@pytest.mark.parametrize('log, reason', REFUSED.values(), ids=REFUSED)
def test_what_cannot_be_calibrated_is_refused_with_its_reason(log, reason):
    with pytest.raises(DataRefused) as refused:
        calibrate_encoder(log, 'likelihood')
    assert reason in str(refused.value) and '\n' not in str(refused.value)


BRIDGED = (CLEAN.time > 30.0) & (CLEAN.time < 34.0) | (CLEAN.time > 70.0) & (CLEAN.time < 71.0)
# A hundred samples lost while turning one way would be 60 deg/s * 1 s over 100 s, which is
# 0.6 deg/s, were the stamps not believed.
KEPT = ~((SWING.rate_at(CLEAN.time) > 1.0) & (np.arange(len(CLEAN)) % 40 == 7))
FOUND = {  # log, time offset, lost samples, values of the reference
    'late': (log_of(SWING, 100.0, late=0.0117), 0.0117, 0, 10_000),
    'by a reference rate': (replace(CLEAN, reference_heading=None,
                                    reference_rate=SWING.rate_at(CLEAN.time)), 0.0, 0, 10_000),
    'lost samples': (replace(CLEAN, **{name: getattr(CLEAN, name)[KEPT] for name in (
        'time', 'output', 'reference_heading')}), 0.0, np.sum(~KEPT), np.sum(KEPT)),
    'a reference that is lost at times': (
        replace(CLEAN, reference_heading=np.where(BRIDGED, np.nan, CLEAN.reference_heading)), 0.0,
        0, np.sum(~BRIDGED)),
}


@pytest.mark.parametrize('log, late, lost, count', FOUND.values(), ids=FOUND)
def test_scale_bias_and_delay_are_found(log, late, lost, count):
    found = calibrate_encoder(log)
    assert (found.method, found.lost_samples, len(found.reference.time)) == (
        'likelihood', lost, count)
    # the steps of the encoder, the same in each period, look like an error of the shaft
    assert (found.fit.scale_factor_error, found.fit.bias) == pytest.approx((S, B), abs=1e-4)
    assert found.fit.time_offset == pytest.approx(late, abs=1e-4)


def test_rows_that_are_missing_without_a_gap_in_the_stamps_are_found_by_the_jumps_they_leave():
    generator = np.random.default_rng(63)
    log = log_of(SWING, 100.0, Noise(angle_random_walk=1e-4), generator, step=1e-6)
    heading = log.reference_heading + 0.03 * DEGREE * generator.standard_normal(len(log))
    heading[2000] += 5.0 * DEGREE
    kept = np.ones(len(log), dtype=bool)
    for begin in (1750, 3000, 4600, 6150, 9000):  # five times 0.3 s, 18 deg each
        kept[begin:begin + 30] = False
    assert np.all(np.abs(SWING.rate_at(log.time[~kept])) > 59.0 * DEGREE)
    whole = calibrate_encoder(replace(log, reference_heading=heading))
    found = calibrate_encoder(Log(time=log.time[:kept.sum()], output=log.output[kept],
                                  reference_heading=heading[kept]))
    for fit in (whole.fit, found.fit):
        off = np.array([fit.scale_factor_error - S, fit.bias - B])
        deviations = np.sqrt(np.diag(fit.covariance))
        assert np.all(np.abs(off) < 4.0 * deviations)
        assert np.all(deviations < [2e-4, 0.01 * DEGREE])
    wrong, jumps = found.remarks[:2]
    assert wrong.startswith('the reference is off in single values, which are left out, by up')
    assert jumps.startswith('the reference jumps by up to 18.')
    assert '17.50 s, 29.70 s, 45.40 s, 60.60 s, 88.80 s' in jumps
    assert not any('jumps' in remark for remark in whole.remarks)


TURNED = np.cumsum(NOISY.output - B) * INTERVAL
OWN = {'a sum': TURNED, 'the trapezoid rule': TURNED - 0.5 * INTERVAL * NOISY.output,
       'scaled': 0.97 * TURNED}


@pytest.mark.parametrize('heading', OWN.values(), ids=OWN)
def test_a_reference_that_is_computed_from_the_gyro_is_refused(heading):
    with pytest.raises(DataRefused, match='the reference is computed from this gyro'):
        calibrate({'': replace(NOISY, reference_heading=heading)})
    assert calibrate({'': NOISY}).fit.scale_factor_error == pytest.approx(S, abs=5e-4)


@pytest.mark.parametrize('factor, late, said', [(1.05, 0.0, '1.05'), (0.95, 0.1, '0.95'),
                                                (1.005, 0.0, '1.005'), (1.0, 0.1, ''),
                                                (1.0003, 0.0, '')])
def test_references_that_contradict_each_other_are_remarked(factor, late, said):
    rate = factor * SWING.rate_at(NOISY.time - late)
    noise = 0.1 * DEGREE * np.random.default_rng(65).standard_normal(len(rate))
    remark = calibrate({'': replace(NOISY, reference_rate=rate + noise)}, method='likelihood'
                       ).remarks[0]
    assert remark.startswith(f'The reference rate turns {said}') == bool(said), remark


@pytest.mark.parametrize('size', [0.5, 100.0, 1e6])
def test_single_wrong_values_of_the_reference_are_left_out(size):
    heading = CLEAN.reference_heading.copy()
    heading[[2000, 5000]] += (size, -size)
    found = calibrate_encoder(replace(CLEAN, reference_heading=heading))
    assert 'single values, which are left out' in found.remarks[0]
    assert '20.00 s, 50.00 s' in found.remarks[0]
    assert (found.fit.scale_factor_error, found.fit.bias) == pytest.approx((S, B), abs=5e-5)


def test_a_wrong_scale_of_the_reference_is_named_with_its_number():
    """A firmware that takes 351 for 360 deg makes a perfect gyro look 2.56 % too large."""
    log = replace(CLEAN, output=(CLEAN.output - B) / (1 + S),
                  reference_heading=CLEAN.reference_heading * 351 / 360)
    found = calibrate_encoder(log)
    assert found.fit.scale_factor_error == pytest.approx(360 / 351 - 1, abs=5e-5)
    assert '351.0' in found.remarks[0]


@pytest.mark.parametrize('runs', [15, pytest.param(40, marks=pytest.mark.evidence)])
def test_95_percent_intervals_hold_the_truth_though_the_bias_wanders(runs):
    found = np.array(
        [run(('white, flicker, rate random walk', seed, 300.0)) for seed in range(runs)])
    within = (np.abs(found[:, 0]) < 1.96 * found[:, 1]).sum(axis=0)
    assert (within >= fewest(runs, 0.95)).all(), within
    assert (found[:, 1].mean(axis=0)
            < 3.0 * np.sqrt((found[:, 0] ** 2).mean(axis=0))).all(), 'far too wide'


@pytest.mark.parametrize('motion, smoothing, reference', [
    *(('swing', smoothing, reference) for reference in ('fine', 'encoder') for smoothing in (
        'none', 'delay, 0.1 s', 'mean, 0.2 s', 'mean, 0.4 s', 'first order, 0.1 s')),
    *(('robot', smoothing, 'fine') for smoothing in (
        'mean, 0.2 s', 'mean, 0.2 s, no delay', 'Gaussian, 0.1 s, no delay'))])
def test_a_smoothing_is_not_taken_for_a_scale_and_turns_and_stops_show_it(
        motion, smoothing, reference):
    """A swing of one frequency does not: its interval allows for a smoothing, if there is none."""
    error, stated = np.array([run_smoothing((motion, smoothing, reference, seed))
                              for seed in range(3)]).T
    assert (np.abs(error) < (2.5 if motion == 'swing' else 3.5) * stated).all()
    assert motion == 'swing' or stated.max() < 3e-4
    assert smoothing not in ('none', 'delay, 0.1 s') or np.abs(error).max() < 2e-4


@pytest.mark.parametrize('kind, size', [('swing', 1.0), ('steps', 0.05), ('small sine', 1.0)])
def test_an_eccentric_encoder_leaves_the_intervals_true(kind, size):
    found = np.array([run_eccentric((kind, size, seed)) for seed in range(6)])
    assert (np.abs(found[:, 0]) < 3.0 * found[:, 1]).all()


@pytest.mark.parametrize('hertz', ['0.2', '0.8'])
def test_steps_that_are_the_same_in_each_period_are_no_error_of_a_shaft(hertz):
    error, stated = run_motion((hertz, 'encoder', 0.0, 50))[:, 0]
    assert abs(error) < 1e-3
    assert abs(error) < 2.0 * stated


@pytest.mark.parametrize('bias', [0.3, -0.35, 0.9])
def test_the_code_at_which_a_coarse_output_rests_is_not_its_bias(bias):
    generator, time = np.random.default_rng(67), np.arange(6000) / 50.0
    moves = (time // 20.0) % 2.0 == 1.0
    rate = 15.0 * DEGREE * np.sin(0.2 * np.pi * time) * moves
    heading = 75.0 * DEGREE / np.pi * (1.0 - np.cos(0.2 * np.pi * time)) * moves
    output = rate + (bias + 0.02 * generator.standard_normal(len(time))) * DEGREE
    step = 2.0 * DEGREE
    found = calibrate_encoder(Log(time=time, output=np.round(output / step) * step,
                                  reference_heading=heading)).fit
    deviation = math.sqrt(found.covariance[1, 1])
    assert abs(found.bias - bias * DEGREE) < 3.0 * deviation
    assert deviation < step / math.sqrt(12.0)


@pytest.mark.parametrize('seed', range(3))
def test_what_a_coarse_output_errs_by_at_a_steady_rate_is_no_error_of_the_reference(seed):
    generator, time = np.random.default_rng(70 + seed), np.arange(29000) / 100.0
    ends = np.cumsum(generator.uniform(4.0, 10.0, 100))
    rates = 60.0 * DEGREE * generator.uniform(-1.0, 1.0, 101) * (generator.random(101) < 0.7)
    rate = uniform_filter1d(rates[np.searchsorted(ends, time)], 100)
    output = 1.01 * rate + (0.33 + 0.1 * generator.standard_normal(len(time))) * DEGREE
    step = 0.005 * DEGREE
    found = calibrate_encoder(Log(
        time=time, output=np.round(output / DEGREE) * DEGREE,
        reference_heading=step * np.round(np.cumsum(rate) / 100.0 / step)))
    assert found.method == 'likelihood'
    assert abs(found.fit.bias - 0.33 * DEGREE) < 3.0 * math.sqrt(found.fit.covariance[1, 1])


def test_turns_in_one_direction_leave_the_bias_as_uncertain_as_the_scale():
    generator, time = np.random.default_rng(2), np.arange(2000) * INTERVAL
    rate = 40.0 * DEGREE * (1.0 - np.cos(2.0 * np.pi * time / 2.5)) * (time > 1.0)
    motion = motion_from_rates(time, rate)
    found = calibrate_encoder(log_of(motion, 20.0, Noise(8e-5, 0.0, 0.05 * DEGREE), generator))
    s, b = np.sqrt(np.diag(found.fit.covariance))
    assert b > 0.9 * s * rate.mean()
    assert abs(found.fit.scale_factor_error - S) < 2.5 * s


#: Orientation of the gyro; the scale of the encoder, and so s, is known to 0.2 % only.
MEASURED = {'yaw_slow': (-1.0, 0.006), 'yaw_fast': (-1.0, 0.006), 'pitch_slow': (1.0, -0.0149)}


def measured(data, name, start=0.0, end=1500.0):
    log = read_log(data / 'mems_encoder_turntable' / f'{name}.csv.gz')
    kept = (log.time >= start) & (log.time < end)
    return Log(output=MEASURED[name][0] * log.output[kept], time=log.time[kept],
               reference_heading=log.reference_heading[kept])


@pytest.mark.parametrize('name', MEASURED)
def test_measured_gyros_are_12_ms_late_and_that_is_not_taken_for_scale(data, name):
    """Measured: 12.00, 12.17 and 12.06 ms."""
    found = calibrate_encoder(measured(data, name, 0.0, 300.0))
    assert found.fit.time_offset == pytest.approx(0.012, abs=0.0005)
    assert found.fit.scale_factor_error == pytest.approx(MEASURED[name][1], abs=0.001)


def shaken(bias, generator):
    """Return 20 s of a fast swing whose heading is off by 3 deg, as of a mount that wobbles."""
    motion = swing(20.0, 300.0, 2.5)
    log = log_of(motion, 20.0, Noise(0.02 * DEGREE), generator)
    wobble = 3.0 * DEGREE * np.interp(log.time, np.arange(0.0, 21.0, 0.5),
                                      generator.standard_normal(42))
    return replace(log, output=log.output - B + bias + np.gradient(wobble, log.time))


def test_a_bias_that_a_log_hardly_shows_is_drawn_towards_zero_or_refused():
    """The error of least squares is 0.15 deg/s on such logs, five times that of no correction."""
    errors, refused = [], 0
    for seed in range(20):
        generator = np.random.default_rng(seed)
        bias = 0.03 * DEGREE * generator.standard_normal()
        try:
            errors.append(calibrate_encoder(shaken(bias, generator), 'likelihood').fit.bias - bias)
        except DataRefused as refusal:
            assert 'too uncertain' in str(refusal)
            errors.append(bias)
            refused += 1
    assert refused >= 10 and np.sqrt(np.mean(np.square(errors))) < 0.1 * DEGREE


def test_a_short_command_has_fewer_blocks_than_values_and_is_answered():
    """Four turns one way in 20 s: 39 increments, 38 values with the wander of the bias."""
    time = np.arange(0.0, 20.0, 0.01)
    rate = 40.0 * DEGREE * (np.mod(time, 5.0) > 2.0)
    noise = 0.05 * DEGREE * np.random.default_rng(1).standard_normal(len(time))
    fit = calibrate_encoder(Log(output=1.01 * rate + 0.1 * DEGREE + noise, time=time,
                                reference_rate=rate), 'likelihood').fit
    assert abs(fit.scale_factor_error - 0.01) < 4.0 * np.sqrt(fit.covariance[0, 0]) < 0.04


@pytest.mark.parametrize('seed', range(3))
def test_a_late_rate_that_is_seldom_steady_is_compared_as_a_heading(seed):
    generator = np.random.default_rng(seed)
    time = np.arange(0.0, 120.0, 0.02)
    rates = generator.uniform(-40.0, 40.0, 60) * DEGREE
    places = 2.0 * np.arange(60) + 4.0 * (np.arange(60) // 8)  # every eighth is held for 4 s
    held = np.arange(7, 60, 8)
    rate = np.interp(time, np.insert(places, held + 1, places[held] + 4.0),
                     np.insert(rates, held + 1, rates[held]))
    late = np.interp(time - 0.2, time, uniform_filter1d(rate, 15))
    log = Log(time=time, reference_rate=late + 0.1 * DEGREE * generator.standard_normal(len(time)),
              output=1.002 * rate + (0.4 + 0.05 * generator.standard_normal(len(time))) * DEGREE)
    assert len(find_dwells(log)) >= 3
    found = calibrate({'': log})
    assert abs(found.fit.scale_factor_error - 0.002) < 3.0 * math.sqrt(found.fit.covariance[0, 0])
    assert abs(found.fit.bias - 0.4 * DEGREE) < 3.0 * math.sqrt(found.fit.covariance[1, 1])


@pytest.mark.parametrize('factor, noise', [(1.0 / DEGREE, 0.0), (0.0, 0.1 * DEGREE)],
                         ids=['deg/s', 'noise alone'])
def test_of_references_that_contradict_each_other_the_gyro_shows_the_right_one(factor, noise):
    rate = factor * SWING.rate_at(NOISY.time)
    rate += noise * np.random.default_rng(66).standard_normal(len(rate))
    heading = np.where(NOISY.time < 40.0, NOISY.reference_heading, np.nan)
    found = calibrate_encoder(replace(NOISY, reference_rate=rate, reference_heading=heading))
    assert 'the heading is used' in found.remarks[0]
    assert found.fit.scale_factor_error == pytest.approx(S, abs=5e-4)


def test_a_wrong_heading_beside_a_right_rate_is_not_used_in_dwells():
    generator, time = np.random.default_rng(71), np.arange(9000) / 50.0
    rates = 60.0 * DEGREE * generator.uniform(-1.0, 1.0, 30)
    rate = uniform_filter1d(np.repeat(rates, 300), 25)
    output = (1.0 + S) * rate + B + 0.02 * DEGREE * generator.standard_normal(len(time))
    found = calibrate({'': Log(time=time, output=output, reference_rate=rate,
                               reference_heading=-np.cumsum(rate) / 50.0)})
    assert 'turns -1.000 times as far' in found.calibration.dwells.remarks[0]
    values = {parameter.name: value for _, parameter, value, _ in found.model.estimates()}
    assert values['scale_factor_error'] == pytest.approx(S, abs=5e-4)


def test_references_that_differ_by_less_than_the_gyro_may_err_are_stated():
    time = np.arange(9000) / 50.0
    rate = 20.0 * DEGREE * uniform_filter1d(np.repeat(np.arange(15.0) % 4.0 - 1.5, 600), 25)
    noise = 0.02 * DEGREE * np.random.default_rng(72).standard_normal(len(time))
    found = calibrate({'': Log(time=time, output=rate + noise, reference_rate=rate,
                               reference_heading=0.97 * np.cumsum(rate) / 50.0)})
    assert 'turns 1.031 times as far' in found.calibration.dwells.remarks[0]


def stepped_log(generator, last=0.0):
    """Return the log of a gyro at eight steady rates twice, and a last one, deg/s."""
    rates = np.array([0.0, 20.0, 40.0, 60.0, -60.0, -40.0, -20.0, 0.0] * 2 + [last])
    rate = uniform_filter1d(np.repeat(rates, 400), 40) * DEGREE
    output = 1.003 * rate + (0.2 + 0.05 * generator.standard_normal(len(rate))) * DEGREE
    return Log(time=np.arange(len(rate)) / 50.0, output=output, reference_rate=rate)


@pytest.mark.parametrize('value', [None, 0.0], ids=['last value', 'zero'])
@pytest.mark.parametrize('begin', [2500, 4300])
def test_an_output_that_stands_while_the_gyro_turns_is_left_out(begin, value):
    log = stepped_log(np.random.default_rng(begin))
    log.output[begin:] = log.output[begin] if value is None else value
    found = calibrate({'': log})
    assert 'dead' in found.calibration.dwells.remarks[0]
    (bias, of_bias), (scale, of_scale) = (each[2:] for each in found.model.estimates())
    assert abs(scale - 0.003) < 3.0 * of_scale < 0.001
    assert abs(bias - 0.2 * DEGREE) < 3.0 * of_bias < 0.02 * DEGREE


def test_a_dead_zone_and_a_limit_are_no_dead_output():
    log = stepped_log(np.random.default_rng(1), last=10.0)
    for output in (np.where(np.abs(log.output) < 25.0 * DEGREE, 0.0, log.output),
                   np.minimum(log.output, 30.0 * DEGREE)):
        assert drop_dead_output(replace(log, output=output))[1] == []


@pytest.mark.parametrize('seed', range(3))
def test_beside_a_course_the_intervals_have_the_steps_of_the_output(seed):
    generator = np.random.default_rng(seed)
    time, bias = np.arange(6000) / 20.0, 0.2 * DEGREE
    rate = uniform_filter1d(np.repeat(generator.choice(
        [-20.0, -10.0, 0.0, 0.0, 10.0, 20.0], 60), 100), 20) * DEGREE
    course = np.full(len(time), np.nan)
    course[::4] = (np.cumsum(rate) / 20.0)[::4] + 0.5 * DEGREE * generator.standard_normal(1500)
    step = 0.5 * DEGREE
    noisy = rate + bias + 0.02 * DEGREE * generator.standard_normal(len(time))
    fit = calibrate_encoder(Log(time=time, output=np.round(noisy / step) * step,
                                reference_heading=course), 'course').fit
    assert abs(fit.bias - bias) < 2.0 * math.sqrt(fit.covariance[1, 1]) < step
    assert abs(fit.scale_factor_error) < 2.0 * math.sqrt(fit.covariance[0, 0]) < 0.03


@pytest.mark.parametrize('begin', [1040, 2190])
def test_a_reference_rate_that_is_held_while_the_gyro_turns_is_left_out(begin):
    log = stepped_log(np.random.default_rng(begin))
    log.reference_rate[begin:begin + 700] = log.reference_rate[begin]
    (bias, of_bias), (scale, of_scale) = (each[2:] for each in calibrate({'': log}
                                                                         ).model.estimates())
    assert abs(scale - 0.003) < 3.0 * of_scale < 0.001
    assert abs(bias - 0.2 * DEGREE) < 3.0 * of_bias < 0.02 * DEGREE
