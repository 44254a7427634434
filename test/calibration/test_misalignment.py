# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.


"""A sensor that is turned about three axes beside a motion capture: an oblique axis is found."""

from dataclasses import replace
import re

from chance import fewest, seeded
from gyro_calibration.calibration.encoder import calibrate_encoder
from gyro_calibration.calibration.heading_regression import fit_spans
from gyro_calibration.calibration.reference_noise import heading_difference
from gyro_calibration.calibration.spans import lay_out_spans
from gyro_calibration.diagnosis.log_diagnosis import diagnose
from gyro_calibration.diagnosis.words import terminal_lines
from gyro_calibration.logs.log import DEGREE, Log, log_from_table
from gyro_calibration.logs.quality import cross_rotation
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

SCALE, BIAS = 0.004, 0.2 * DEGREE


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
    output = (1.0 + SCALE) * rates[:, 2] + rates[:, :2] @ misalignment + BIAS + white
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
        off = np.array([fit.scale_factor_error - SCALE, fit.bias - BIAS])
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
