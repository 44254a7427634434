# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Headings as references: a course that is late and lost, an oblique axis, the noise grid."""

from dataclasses import replace
import math
import re

from chance import fewest, seeded
from diagnosed import established
from gyro_calibration.calibration.encoder import calibrate_encoder
from gyro_calibration.calibration.heading_regression import fit_spans
from gyro_calibration.calibration.noise_grid import (
    BandedNoise, fit_noise_grid, heading_noise, SharedNoise)
from gyro_calibration.calibration.reference_kind import is_course
from gyro_calibration.calibration.reference_noise import heading_difference, keep_own_instants
from gyro_calibration.calibration.spans import lay_out_spans
from gyro_calibration.diagnosis.log_diagnosis import diagnose
from gyro_calibration.diagnosis.words import terminal_lines
from gyro_calibration.logs.log import DataRefused, DEGREE, Log, log_from_table, read_log
from gyro_calibration.logs.quality import bridge_gaps, cross_rotation
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

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


# A sensor that is turned about three axes beside a motion capture

OBLIQUE_SCALE, OBLIQUE_BIAS = 0.004, 0.2 * DEGREE


def tumbling(seed, misalignment=(0.0, 0.0), sizes=(70.0, 40.0, 40.0), noise=0.03):
    """
    Return the table of a log of 120 s at 100 Hz, and the rates of the sensor, rad/s, (n, 3).

    Yaw, pitch and roll are sums of sines of `sizes`, deg. The gyro is along z and has the
    misalignment, rad, of the rates about x and y. The attitude has noise, deg, and is lost twice.
    """
    generator = np.random.default_rng(seed)
    time = 0.01 * np.arange(12000)
    still = np.clip(np.minimum(time - 5.0, 115.0 - time), 0.0, 1.0)
    omega = 2.0 * np.pi * generator.uniform(0.05, 0.6, (3, 4))
    phase = np.cumsum(still)[:, None, None] * 0.01 * omega
    shift = generator.uniform(0.0, 2.0 * np.pi, omega.shape)
    yaw, pitch, roll = (angles := np.sin(phase + shift).sum(axis=2) * 0.5 * DEGREE * sizes).T
    slopes = (omega * np.cos(phase + shift)).sum(axis=2) * 0.5 * DEGREE * sizes
    by_yaw, by_pitch, by_roll = (slopes * still[:, None]).T
    rates = np.column_stack([
        by_roll - by_yaw * np.sin(pitch),
        by_pitch * np.cos(roll) + by_yaw * np.sin(roll) * np.cos(pitch),
        by_yaw * np.cos(roll) * np.cos(pitch) - by_pitch * np.sin(roll)])
    attitude = Rotation.from_euler('ZYX', angles) * Rotation.from_rotvec(
        noise * DEGREE * generator.standard_normal((len(time), 3)))
    quaternion = attitude.as_quat()
    quaternion[[*range(3000, 3020), *range(8000, 8010)]] = np.nan
    white = 0.05 * DEGREE * generator.standard_normal(len(time))
    output = ((1.0 + OBLIQUE_SCALE) * rates[:, 2] + OBLIQUE_BIAS + rates[:, :2] @ misalignment
              + white)
    return {'time_s': time, 'gyro_rad_s': output,
            **dict(zip(('qx', 'qy', 'qz', 'qw'), quaternion.T))}, rates


def attitude_log(*given, **options):
    return log_from_table(tumbling(*given, **options)[0], {'attitude': 'qw/qx/qy/qz'})


def test_scale_and_bias_hold_beside_an_oblique_axis():
    logs, source = 30, seeded('an oblique axis')
    inside, axes = np.zeros(2, dtype=int), 0
    for _ in range(logs):
        misalignment = source.uniform(-0.7, 0.7, 2) * DEGREE
        fit = calibrate_encoder(attitude_log(source.integers(2**32), misalignment)).fit
        off = np.array([fit.scale_factor_error - OBLIQUE_SCALE, fit.bias - OBLIQUE_BIAS])
        inside += np.abs(off) < 1.96 * np.sqrt(np.diag(fit.covariance))
        axes += np.sum(np.abs(fit.misalignment - misalignment)
                       < 1.96 * np.sqrt(np.diag(fit.misalignment_covariance)))
    assert (inside >= fewest(logs, 0.9)).all() and axes >= fewest(2 * logs, 0.88)


@pytest.mark.parametrize('method', [None, 'course'])
def test_an_oblique_axis_is_stated_and_a_parallel_one_is_not(method):
    for seed, misalignment in ((1, (0.0, 0.0)), (2, (0.5 * DEGREE, -0.3 * DEGREE))):
        found = calibrate_encoder(attitude_log(seed, misalignment), method)
        stated = [each for each in found.remarks if 'the axis of the gyro is oblique' in each]
        assert len(stated) == any(misalignment)
        assert not stated or re.search(r'by 0\.58\d \+- 0\.0\d+ deg', stated[0]), stated
        assert any('about the axis of the attitude' in each for each in found.remarks)
        assert found.method == (method or 'likelihood')


def test_rotations_about_other_axes_are_no_noise_of_the_reference():
    log = attitude_log(3, (0.01, 0.01), sizes=(20.0, 90.0, 90.0))
    without = replace(log, cross_axis_1=None)
    least, most = (heading_difference(each).total_walk for each in (log, without))
    assert most > 0.5 * DEGREE > 4.0 * least


def test_a_planar_attitude_gives_the_answers_of_its_heading():
    table, rates = tumbling(4, noise=0.0)
    turned = np.cumsum(rates[:, 2]) * 0.01
    noise = 1e-3 * np.random.default_rng(4).standard_normal(len(turned))
    half = 0.5 * (turned + noise)
    planar = log_from_table(table | {'qw': np.cos(half), 'qx': 0.0 * half, 'qy': 0.0 * half,
                                     'qz': np.sin(half)}, {'attitude': 'qw/qx/qy/qz'})
    alone = replace(planar, cross_axis_1=None, cross_axis_2=None)
    # a wobble that the gyro could not show is no rotation either
    wobble = 0.2 * DEGREE * np.sin(planar.time)
    for log in (planar, replace(planar, cross_axis_1=wobble, cross_axis_2=wobble)):
        assert cross_rotation(log).shape == (len(log), 0)
        (fit, other), (spans, others) = zip(
            *((calibrate_encoder(each).fit, fit_spans(lay_out_spans(each, 'motion_capture')))
              for each in (log, alone)))
        assert (fit.covariance == other.covariance).all() and fit.bias == other.bias
        assert (spans.values == others.values).all()
        assert (spans.covariance == others.covariance).all()


def test_an_oblique_axis_is_named_as_such_and_nothing_else_is():
    log = attitude_log(11, (0.4 * DEGREE, 0.3 * DEGREE))
    found = diagnose([log], np.random.default_rng(0))
    (finding,) = found.findings
    size = finding.parameters['axis_misalignment']
    assert finding.status == 'established' and 'one axis' in finding.remedy
    assert size.interval[0] < 0.5 * DEGREE < size.interval[1] < 0.55 * DEGREE, size
    assert 'axis_misalignment' not in {each.effect.name for each in found.model.terms}
    assert found.reference.kind == 'motion_capture'
    assert 'oblique' in '\n'.join(terminal_lines(found))


def test_a_parallel_axis_is_not_named():
    assert not diagnose([attitude_log(12)], np.random.default_rng(0)).findings


def test_a_reference_without_an_attitude_cannot_show_an_oblique_axis():
    log = attitude_log(13, (0.2 * DEGREE, 0.0))
    alone = Log(time=log.time, output=log.output, reference_heading=log.reference_heading)
    found = diagnose([alone], np.random.default_rng(0))
    assert 'axis_misalignment' in found.cannot_show


# The restricted likelihood over a grid of noise sizes

def test_at_known_sizes_it_is_the_restricted_likelihood_of_the_textbook():
    generator = np.random.default_rng(1)
    n, q = 40, 3
    columns, shared, observed = (generator.standard_normal((n, 2)),
                                 generator.standard_normal((n, q)), generator.standard_normal(n))
    parts = [BandedNoise('a', np.full(n, 2.0), np.full(n, -0.9), (0.5, 0.5)),
             BandedNoise('b', np.linspace(1.0, 2.0, n), None, (1.5, 1.5))]
    variance = np.array([1.0, 0.5, 0.1])
    found = fit_noise_grid(observed, columns, parts, shared,
                           [SharedNoise('c', variance, (2.0, 2.0))])
    dense = 0.25 * (2.0 * np.eye(n) - 0.9 * np.eye(n, k=1)
                    - 0.9 * np.eye(n, k=-1)) + 2.25 * np.diag(np.linspace(1.0, 2.0, n))
    dense += shared @ np.diag(4.0 * variance) @ shared.T
    inverse = np.linalg.inv(dense)
    information = columns.T @ inverse @ columns
    values = np.linalg.solve(information, columns.T @ inverse @ observed)
    left = observed - columns @ values
    wanted = -0.5 * (
        np.linalg.slogdet(dense)[1] + np.linalg.slogdet(information)[1] + left @ inverse @ left)
    assert found.log_evidence == pytest.approx(wanted, rel=1e-9)
    np.testing.assert_allclose(found.values, values, rtol=1e-8)
    np.testing.assert_allclose(found.covariance, np.linalg.inv(information), rtol=1e-8)


def test_a_size_far_from_the_points_of_the_first_grid_is_found():
    """The first points are a factor of 18 apart."""
    white = np.random.default_rng(5).standard_normal(400)
    for size in np.geomspace(0.03, 0.6, 13):
        found = fit_noise_grid(size * white, np.ones((400, 1)),
                               [BandedNoise('size', np.ones(400), None, (1e-4, 10.0))])
        assert found.size('size') == pytest.approx(size * white.std(ddof=1), rel=0.02)


def test_too_few_observations_are_refused():
    with pytest.raises(ValueError, match='2 observations do not determine 2 values'):
        fit_noise_grid(np.zeros(2), np.eye(2), [BandedNoise('a', np.ones(2), None, (1.0, 1.0))])


def test_a_span_that_the_gyro_does_not_cover_shows_nothing():
    """Its points have errors of their own, whatever its observation would be."""
    generator = np.random.default_rng(1)
    time, is_measured = np.arange(0.0, 60.0, 0.5), np.ones(119, dtype=bool)
    is_measured[60] = False
    turned = np.diff(0.01 * time + 0.02 * generator.standard_normal(120))
    turned[61] += 0.5  # an error of the point after it that would be one of the point before, too
    columns = (np.diff(time) * is_measured)[:, None]
    parts = heading_noise(time, np.zeros(120), is_measured=is_measured)
    found = []
    for observation in (0.0, 3.0):
        turned[60] = observation
        found.append(fit_noise_grid(turned, columns, [parts[0], parts[1], parts[3]]))
    assert found[0].values == pytest.approx(found[1].values, rel=1e-3)
    assert found[0].size('reference') == pytest.approx(found[1].size('reference'), rel=1e-3)
