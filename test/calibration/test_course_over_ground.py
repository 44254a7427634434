# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Calibration against a course over ground: late, smoothed, lost, and with bursts of errors."""

from dataclasses import replace
import math

from diagnosed import established
from gyro_calibration.calibration.encoder import calibrate_encoder
from gyro_calibration.calibration.reference_kind import is_course
from gyro_calibration.calibration.reference_noise import (
    find_rests, heading_difference, keep_own_instants)
from gyro_calibration.calibration.spans import lay_out_spans
from gyro_calibration.diagnosis.log_diagnosis import diagnose
from gyro_calibration.logs.log import DataRefused, DEGREE, Log, read_log
from gyro_calibration.logs.quality import bridge_gaps
import numpy as np
import pytest
from scipy.signal import lfilter

SCALE, BIAS = 1.01, 0.4 * DEGREE


def drive(seed, late=0.5, turning=30.0, follows=1.0, burst=0.0, bias=BIAS):
    """Return 3 min at 50 Hz of random turns, with a course that is late, and lost for 20 s."""
    generator = np.random.default_rng(seed)
    time = np.arange(9000) / 50.0
    knots = np.arange(0.0, 185.0, 3.0)
    rate = np.interp(time, knots, generator.standard_normal(len(knots)) * turning * DEGREE)
    heading = np.cumsum(rate) / 50.0
    noise = np.interp(time, np.arange(0.0, 181.0, 1.0), generator.standard_normal(181)) * DEGREE
    noise += burst * DEGREE * np.sin(time) * ((time > 120.0) & (time < 130.0))
    course = np.interp(time - late, time, heading) + noise
    course[(time > 60.0) & (time < 80.0)] = math.nan
    output = follows * SCALE * rate + bias + 0.05 * DEGREE * generator.standard_normal(9000)
    return Log(time=time, output=output, reference_heading=course)


# between the offsets that are tried first, which are 0.05 s apart; fixes come at 50 and 4 Hz
@pytest.mark.parametrize('late, every', [(-0.725, 1), (0.0, 1), (0.775, 12)])
def test_scale_bias_and_delay_are_found(late, every):
    log = drive(1, late)
    fixes = np.where(np.arange(len(log)) % every, math.nan, log.reference_heading)
    found = calibrate_encoder(replace(log, reference_heading=fixes))
    deviations = np.sqrt(np.diag(found.fit.covariance))
    assert found.method == 'course'
    assert found.fit.time_offset == pytest.approx(-late, abs=0.02)
    assert found.fit.scale_factor_error == pytest.approx(SCALE - 1.0, abs=4.5 * deviations[0])
    assert found.fit.bias == pytest.approx(BIAS, abs=4.5 * deviations[1])
    assert deviations[0] < 0.01 and deviations[1] < 0.1 * DEGREE


def test_a_reference_that_begins_late_is_no_course():
    """A recorder gets the first message of each topic when it comes."""
    log = drive(7)
    heading = bridge_gaps(log.reference_heading)
    for lost, is_lost in ((0.0, False), (0.08, False), (3.0, True)):
        late = np.where((log.time < lost) | (log.time > 179.98 - lost), math.nan, heading)
        assert is_course(replace(log, reference_heading=late)) == is_lost


@pytest.mark.parametrize('turns', [1, 3])
def test_odometry_that_drives_straight_is_known(turns):
    """Its heading is the same all the time, as its rate is 0 there."""
    time = np.arange(4000) / 50.0
    rate = np.where((time > 4.0) & (time < 4.0 + 5.0 * turns), 0.4 * np.sin(2.0 * time), 0.0)
    output = SCALE * rate + BIAS + 2e-3 * np.random.default_rng(8).standard_normal(len(time))
    log = Log(time=time, output=output, reference_heading=np.cumsum(rate) / 50.0)
    fit = calibrate_encoder(log, 'course').fit
    assert fit.bias == pytest.approx(BIAS, abs=0.02 * DEGREE)
    assert abs(fit.scale_factor_error - (SCALE - 1.0)) < 3.0 * math.sqrt(fit.covariance[0, 0])
    with pytest.raises(DataRefused, match='the course is known for 1. s, wanted at least 20 s'):
        calibrate_encoder(Log(time=time[:600], output=output[:600],
                              reference_heading=log.reference_heading[:600]), 'course')


def test_a_delay_at_the_limit_is_said():
    assert 'of one motion' in calibrate_encoder(drive(1, late=1.6)).remarks[0]
    assert 'of one motion' not in calibrate_encoder(drive(1, late=1.3)).remarks[0]


def test_a_burst_of_bad_fixes_does_not_move_the_bias():
    clean, bad = (calibrate_encoder(drive(2, burst=size)).fit for size in (0.0, 30.0))
    assert abs(clean.bias - bad.bias) < 2.0 * math.sqrt(clean.covariance[1, 1])


def test_a_drive_without_turns_leaves_the_scale_to_the_prior():
    consumer, fibre = (
        calibrate_encoder(drive(3, turning=0.0, bias=bias), technology=name).fit
        for name, bias in (('mems', BIAS), ('closed_loop_fog', 0.0)))
    for fit, largest in ((consumer, 0.01), (fibre, 0.001)):
        assert abs(fit.scale_factor_error) < 0.5 * largest
        assert math.sqrt(fit.covariance[0, 0]) < 1.1 * largest
    assert consumer.covariance[0, 0] > 10.0 * fibre.covariance[0, 0]


@pytest.mark.parametrize('bias', [0.03, 0.1, 2.0])
def test_a_bias_beyond_the_technology_is_found(bias):
    fits = [calibrate_encoder(drive(3, bias=bias * DEGREE), technology=name)
            for name in ('mems', 'closed_loop_fog')]
    for found in fits:
        deviation = math.sqrt(found.fit.covariance[1, 1])
        assert abs(found.fit.bias - bias * DEGREE) < 3.0 * deviation < 0.11 * DEGREE
    assert any('which is usual with the technology' in each for each in fits[1].remarks)


@pytest.mark.parametrize(
    'follows', [0.0, -1.0, math.pi / 180.0], ids=['alive at rest', 'upside down', 'in rad/s'])
def test_a_gyro_that_does_not_follow_is_refused(follows):
    with pytest.raises(DataRefused, match='does not follow'):
        calibrate_encoder(drive(4, follows=follows))


@pytest.mark.parametrize('name, bias', [
    ('wid_03', 0.0), ('wid_07', 0.0), ('rc_car_j_unit4', 0.18 * DEGREE)])
def test_recorded_drives_are_answered_by_fit_and_diagnose_alike(data, name, bias):
    log = read_log(data / 'wheeled_drives' / f'{name}.csv.gz')
    fit = calibrate_encoder(log).fit
    assert fit.bias == pytest.approx(bias, abs=0.03 * DEGREE)
    assert abs(fit.scale_factor_error) < 0.02
    if name == 'wid_07':
        return
    found = diagnose([log], np.random.default_rng(0))
    assert {*established(found)} <= {'time_offset', 'quantization'}
    values = {term.effect.name: term.values for term in found.model.terms}
    assert values == {'bias': pytest.approx([fit.bias], abs=1e-6 * DEGREE),
                      'scale_factor_error': pytest.approx([fit.scale_factor_error], abs=1e-8)}
    if name == 'rc_car_j_unit4':
        delay = established(found)['time_offset'].parameters['time_offset']
        assert delay.estimate == pytest.approx(fit.time_offset, abs=1e-6)
        assert delay.deviation == pytest.approx(fit.time_offset_deviation, rel=1e-6)


def test_a_nonlinearity_that_the_other_drives_of_a_unit_have_too_is_established(data):
    """In drives h, i and k it is -5.4e-3, -9.6e-3 and -4.7e-3 s; unit 4 has +1.1e-3 s in h."""
    found = established(diagnose([read_log(data / 'wheeled_drives' / 'rc_car_j_unit1.csv.gz')],
                                 np.random.default_rng(0)))
    low, high = found['quadratic_nonlinearity'].parameters['quadratic_nonlinearity'].interval
    assert low < -5.4e-3 < high < -2e-3


def odometry_that_slips(seed, track=1.0):
    """Return 4 min beside wheels, of a true over an assumed track, that slip by 3 % a turn."""
    generator, time = np.random.default_rng(seed), np.arange(0.0, 240.0, 0.02)
    rate, slip, turns, begin = np.zeros(len(time)), np.ones(len(time)), 0, 0.0
    while begin < 240.0:
        begin, length = begin + generator.uniform(1.0, 4.0), generator.uniform(2.0, 6.0)
        inside = (time >= begin) & (time < begin + length)
        rate[inside] = generator.choice([-1.0, 1.0]) * generator.uniform(0.3, 1.0) * np.sin(
            np.pi * (time[inside] - begin) / length) ** 2
        slip[inside] += 0.03 * generator.standard_normal()
        begin, turns = begin + length, turns + 1
    drift = 0.2 * DEGREE * 0.02 ** 0.5 * generator.standard_normal(len(time))
    return Log(time=time, output=SCALE * rate + BIAS + 1e-3 * generator.standard_normal(len(time)),
               reference_heading=track * np.cumsum(0.02 * slip * rate + drift)), turns


def test_slip_of_whole_turns_is_in_the_interval_of_the_scale():
    variances, least = [], []
    for seed in range(3):
        log, turns = odometry_that_slips(seed)
        found = calibrate_encoder(log, 'course')
        variances.append(found.fit.covariance[0, 0])
        least.append(0.03 ** 2 / turns)  # of the mean slip
        assert abs(found.fit.scale_factor_error - SCALE + 1.0) < 3.0 * math.sqrt(variances[-1])
    assert np.mean(variances) > 0.8 * np.mean(least)
    assert 'same effect as a bias' in found.remarks[0] and 'for 360 deg' in found.remarks[-1]


@pytest.mark.parametrize('track', [0.8, 1.2, 1.6])
def test_wheels_at_another_distance_are_no_slip(track):
    """The scale is far beyond the prior of a gyro, and nothing else explains the turns."""
    log, _ = odometry_that_slips(3, track)
    found = calibrate_encoder(log, 'course')
    deviation = math.sqrt(found.fit.covariance[0, 0])
    assert abs((1.0 + found.fit.scale_factor_error) * track / SCALE - 1.0) < 3.0 * deviation
    assert deviation < 0.02
    assert 'beyond what gyros of the technology mems have' in ' '.join(found.remarks)


def short_odometry(seed, track, turns, slip):
    """Return 90 s with turns of 90 deg, beside wheels whose heading walks by `slip` in each."""
    generator, time = np.random.default_rng(seed), np.arange(0.0, 90.0, 0.02)
    rate, is_turning = 0.2 * DEGREE * np.sin(time), np.zeros(len(time), dtype=bool)
    for begin in np.linspace(5.0, 80.0, turns):
        inside = (time >= begin) & (time < begin + 4.0)
        rate[inside] += generator.choice([-1.0, 1.0]) * 45.0 * DEGREE * np.sin(
            np.pi * (time[inside] - begin) / 4.0) ** 2
        is_turning |= inside
    slips = slip / math.sqrt(200.0) * is_turning * generator.standard_normal(len(time))
    return Log(time=time, output=SCALE * rate + BIAS + 1e-3 * generator.standard_normal(len(time)),
               reference_heading=np.cumsum(track * 0.02 * rate + slips))


def test_noise_of_the_gyro_is_no_turn_of_a_course():
    """It is in the observations too, so that a scale factor error of 1 would cancel it."""
    spans = lay_out_spans(short_odometry(0, 1.0, 5, 0.0))
    count = len(spans.heading) - 1
    straight = replace(spans, heading=np.zeros(count + 1))
    turned, none = (each.base_columns()[:count, 0] for each in (spans, straight))
    assert np.abs(turned).max() > 45.0 * DEGREE
    assert (none == 0.0).all() and (straight.angles == 0.0).all()


def test_a_motion_capture_that_loses_its_markers_is_no_course():
    """It errs by less than a course, and by more than the gyro, as where its axes are oblique."""
    generator = np.random.default_rng(4)
    log = drive(4, late=0.0)
    heading = SCALE ** -1 * np.cumsum(log.output - BIAS) / 50.0
    heading += 0.05 * DEGREE * generator.standard_normal(len(heading))
    leaking = 0.005 * np.interp(log.time, np.arange(0.0, 181.0, 1.0),
                                20.0 * DEGREE * generator.standard_normal(181))
    for begin in range(10, 170, 20):
        heading[(log.time > begin) & (log.time < begin + 0.5)] = math.nan
    found = calibrate_encoder(replace(log, output=log.output + leaking, reference_heading=heading))
    assert found.method == 'likelihood'
    deviations = np.sqrt(np.diag(found.fit.covariance))
    assert found.fit.scale_factor_error == pytest.approx(SCALE - 1.0, abs=4.5 * deviations[0])
    assert deviations[0] < 0.002


def test_the_errors_of_a_reference_at_an_uneven_part_of_the_samples_are_found():
    """A motion capture at 120 Hz, on straight lines at the 285.7 Hz of the gyro."""
    generator = np.random.default_rng(5)
    time, at = np.arange(17000) / 285.7, np.arange(7200) / 120.0
    rate = 30.0 * DEGREE * np.sin(2.0 * time)
    drift = np.cumsum(0.2 * DEGREE * generator.standard_normal(len(at))) / math.sqrt(120.0)
    heading = np.interp(time, at, 15.0 * DEGREE * (1.0 - np.cos(2.0 * at)) + drift)
    log, _ = keep_own_instants(Log(
        time=time, reference_heading=heading,
        output=rate + 0.1 * DEGREE * generator.standard_normal(len(time))))
    assert np.isfinite(log.reference_heading).mean() < 0.5
    assert heading_difference(log).total_walk == pytest.approx(0.2 * DEGREE, rel=0.2)


def test_rests_are_found_beside_filtered_noise():
    """Single seconds are far quieter than others by chance."""
    time = np.arange(15_000) / 50.0
    moves = time % 30.0 > 10.0
    turned = np.where(moves, 0.3 * np.sin(1.3 * time), 0.0)
    noise = np.random.default_rng(10).standard_normal(len(time))
    slow = lfilter([0.1], [1.0, -0.9], noise)
    rests, stands = find_rests(time, turned + 1e-3 * slow, np.cumsum(turned))
    assert len(rests) == 10 and stands.all()
    assert np.diff(time[rests]).sum() == pytest.approx(100.0, abs=10.0)
