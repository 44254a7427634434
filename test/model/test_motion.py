# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Motions: exact headings, files, what a gyro makes of one, noise, and robot simulators."""

import json
import math
from pathlib import Path
import xml.etree.ElementTree as ElementTree

from chance import mean_bound
from gyro_calibration.allan.deviation import allan_deviation
from gyro_calibration.logs.log import DEGREE
from gyro_calibration.model.effects import BIAS, CATALOGUE, SCALE_FACTOR_ERROR
from gyro_calibration.model.gyro_model import GyroModel, SelfCalibration, Term
from gyro_calibration.model.model_file import read_model
from gyro_calibration.model.motion import (
    CALIBRATION_MOTION, MotionError, NAMED_MOTIONS, read_motion, ROBOT_MOTION, simulate)
from gyro_calibration.model.noise import ALLAN_FLOOR_RATIO, Noise, simulate_noise
from gyro_calibration.model.presets import XV3500
from gyro_calibration.model.simulator_export import (
    export_model, fit_gauss_markov, simulator_parameters, SIMULATORS)
import numpy as np
import pytest
from scipy.signal import lfilter


@pytest.mark.parametrize('name', NAMED_MOTIONS)
def test_the_heading_is_the_integral_of_the_rate(name):
    """Simpson's rule is exact for a piecewise linear rate with corners at multiples of 0.1 s."""
    motion = NAMED_MOTIONS[name]
    time = np.arange(round(motion.duration * 20) + 1) / 20.0
    middle = motion.rate_at((time[1:] + time[:-1]) / 2)
    rate = motion.rate_at(time)
    heading = np.concatenate([[0.0], np.cumsum((rate[1:] + 4 * middle + rate[:-1]) / 6 / 20.0)])
    assert motion.heading_at(time) == pytest.approx(heading, abs=1e-12)


@pytest.mark.parametrize('prefix', ['', 'reference_'])
@pytest.mark.parametrize('column, factor', [('heading_deg', DEGREE), ('heading_rad', 1.0),
                                            ('rate_dps', DEGREE), ('rate_rad_s', 1.0)])
def test_a_profile_of_headings_or_rates_is_read(tmp_path, prefix, column, factor):
    (tmp_path / 'profile.csv').write_text(
        f'\ufeff# note\n{prefix}{column},time_s,lap\n0,5,a\n3,7,b\n\n')
    motion, is_rate = read_motion(tmp_path / 'profile.csv'), column.startswith('rate')
    assert motion.duration == 2.0 and motion.heading_at(2.0) == pytest.approx(3.0 * factor)
    assert (motion.rate.tolist() if is_rate else motion.heading.tolist()) == pytest.approx(
        [0.0, 3.0 * factor]) and (motion.rate is not None) == is_rate
    assert motion.is_measured == (prefix + column).startswith('reference_heading')


def test_the_rate_of_commanded_headings_is_that_between_the_rows(tmp_path):
    """A robot that drives it turns to the headings of the rows; changes by rounding are none."""
    (tmp_path / 'profile.csv').write_text(
        'time_s,heading_rad\n0,0\n1,1e-15\n3,4\n4,4.000000000000001\n')
    motion = read_motion(tmp_path / 'profile.csv')
    assert motion.rate_at(np.array([-0.1, 0.5, 1.5, 2.9, 3.5, 4.1])).tolist() == [
        0.0, 0.0, 2.0, 2.0, 0.0, 0.0]


def test_the_reference_of_a_log_is_a_profile_by_its_heading_and_without_what_was_lost(tmp_path):
    (tmp_path / 'log.csv').write_text(
        'time_s,gyro_dps,reference_rate_rad_s,reference_heading_rad\n'
        '0,0,5,0\n1,0,5,nan\n2,0,5,3\n')
    motion = read_motion(tmp_path / 'log.csv')
    assert (motion.rate is None and motion.time.tolist() == [0.0, 2.0]
            and motion.heading.tolist() == [0.0, 3.0])


REFUSED = {
    'text in a reference': ('time_s,reference_rate_dps\n0,1\n1,fast\n2,1\n',
                            'column reference_rate_dps'),
    'a reference lost everywhere': ('time_s,reference_rate_dps\n0,nan\n1,nan\n2,1\n',
                                    'at least two rows'),
    'empty': ('', 'the columns are nothing'),
    'two motions': ('time_s,rate_dps,heading_deg\n0,1,1\n1,1,1\n', 'wanted time_s and one of'),
    'time stands': ('time_s,rate_dps\n0,1\n0,1\n', 'time_s must increase'),
    'binary': (bytes(range(256)), 'cannot be read'),
    'beyond': ('time_s,rate_dps\n0,1\n1,1e300\n', 'column rate_dps'),
    'large': (b'\n' * 17_000_000, 'more than 16000000 bytes'),
    'endless field': ('time_s,rate_dps\n0,' + '1' * 200000, 'cannot be read'),
}


@pytest.mark.parametrize('text, message', REFUSED.values(), ids=REFUSED)
def test_what_is_no_profile_is_refused(tmp_path, text, message):
    path = tmp_path / 'profile.csv'
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(MotionError) as refused:
        read_motion(path)
    assert str(refused.value).startswith(f'{path}: ') and message in str(refused.value)


# A simulated log is what the model says of the motion

GYRO = GyroModel((Term(BIAS, (0.01,)), Term(SCALE_FACTOR_ERROR, (-0.1,))), noise=Noise(7e-4),
                 reference_temperature=33.0)


def test_a_log_holds_the_motion_and_what_equation_1_of_hong_and_park_makes_of_it():
    log = simulate(GYRO, ROBOT_MOTION, 100.0)
    assert len(log) == 16001 and log.time[-1] == 160.0 and set(log.temperature) == {33.0}
    assert set(simulate(GYRO, CALIBRATION_MOTION, 10.0, temperature=5.0).temperature) == {5.0}
    assert np.array_equal(log.reference_rate, ROBOT_MOTION.rate_at(log.time))
    assert np.array_equal(log.reference_heading, ROBOT_MOTION.heading_at(log.time))
    assert log.output == pytest.approx(0.9 * log.reference_rate + 0.01, abs=1e-12)
    noise = simulate(GYRO, ROBOT_MOTION, 100.0, np.random.default_rng(0)).output - log.output
    assert noise.std() == pytest.approx(7e-4 / np.sqrt(0.01), rel=4.0 / np.sqrt(2 * len(noise)))


# Simulated noise has the Allan deviation of IEEE Std 952: N/sqrt(tau), 0.664 B, K sqrt(tau/3)

INTERVAL = 0.01


#: Noise, samples of the means, and the Allan variance of such means.
PARTS = {
    'white': (Noise(7e-4), (1, 10, 100, 1000), lambda size: 7e-4 ** 2 / (size * INTERVAL)),
    'flicker': (Noise(bias_instability=1e-4), (100, 300, 1000),
                lambda size: (ALLAN_FLOOR_RATIO * 1e-4) ** 2),
    'walk': (Noise(rate_random_walk=1e-5), (30, 100, 1000),  # exact in steps
             lambda size: 1e-5 ** 2 * size * INTERVAL / 3.0 * (1.0 + 0.5 / size ** 2))}


@pytest.mark.parametrize('noise, sizes, wanted', PARTS.values(), ids=PARTS)
def test_simulated_noise_has_the_allan_variance_of_ieee_952(noise, sizes, wanted):
    """To four standard errors: n differences that correlate by -1/2 have a variance of 3 / n."""
    assert round(ALLAN_FLOOR_RATIO, 3) == 0.664
    generator = np.random.default_rng(952)
    records = [simulate_noise(noise, 2 ** 18, INTERVAL, generator) for _ in range(8)]
    for size in sizes:
        found = np.mean([allan_deviation(record, INTERVAL, [size * INTERVAL]).deviation ** 2
                         for record in records])
        tolerance = 4.0 * math.sqrt(3.0 * size / (len(records) * 2 ** 18))
        assert found / wanted(size) == pytest.approx(1.0, abs=tolerance) and tolerance < 0.25, size
        assert noise.allan_variance(size * INTERVAL) == pytest.approx(wanted(size), rel=1e-3)


@pytest.mark.parametrize('noise', [Noise(bias_instability=1e-4), Noise(rate_random_walk=1e-5)],
                         ids=['flicker', 'walk'])
@pytest.mark.parametrize('apart', [3, 20])
def test_means_wander_as_predicted(noise, apart):
    generator, duration, size = np.random.default_rng(5), 2.0, 200
    squares = []
    for _ in range(12):
        means = simulate_noise(noise, 2 ** 16 // size * size, INTERVAL,
                               generator).reshape(-1, size).mean(axis=1)[20:]
        squares.append(np.mean((means[apart:] - means[:-apart]) ** 2))
    assert np.mean(squares) == pytest.approx(
        noise.mean_change_variance(apart * duration, duration), abs=mean_bound(squares), rel=0.12)


def test_the_xv3500_walks_2_5_degrees_in_an_hour_and_11_where_hong_and_park_say_so():
    """2.5 deg/sqrt(h) and 18 deg/h give up to 11 deg in 30 min, as their introduction states."""
    assert (math.degrees(math.sqrt(Noise(XV3500.noise.angle_random_walk).heading_variance(3600.0)))
            == pytest.approx(2.5))
    assert (math.degrees(math.sqrt(XV3500.noise.heading_variance(1800.0)))
            == pytest.approx(11.0, abs=1.0))
    model = read_model(Path(__file__).parents[2] / 'config/xv3500.yaml')
    assert vars(model.noise) == pytest.approx(vars(XV3500.noise), rel=1e-4)
    assert model.output(0.5, 25.0) == pytest.approx(XV3500.model.output(0.5, 25.0), rel=1e-6)


# What simulators are given is what they can hold of a model, and the rest is listed

WANDERING = Noise(7e-4, 2e-4, 1e-6)
EXPORTED = """
effects:
  bias: {bias: 2.0e-4}
  scale_factor_error: {scale_factor_error: 0.03}
  bias_temperature: {bias_temperature: 1.0e-5}
  saturation: {saturation: 4.0}
  quantization: {quantization: 1.0e-4}
  time_offset: {time_offset: 0.013}
noise: {angle_random_walk: 7.0e-4, bias_instability: 2.0e-4, rate_random_walk: 1.0e-6}
"""


def term(name, *values):
    return Term(CATALOGUE[name], values)


def as_gazebo_makes_it(element, count, interval, generator):
    """Return noise of shape (count,) as gz-sensors computes it from the elements of SDF."""
    value = {each.tag: float(each.text) for each in element}
    density, time = value['dynamic_bias_stddev'], value['dynamic_bias_correlation_time']
    step = math.sqrt(-density ** 2 * time / 2.0 * math.expm1(-2.0 * interval / time))
    biases = lfilter([step], [1.0, -math.exp(-interval / time)], generator.standard_normal(count))
    return biases + generator.normal(value['mean'], value['stddev'], count)


def test_the_noise_of_gazebo_has_the_allan_deviation_of_the_model():
    held, error = simulator_parameters(GyroModel(noise=WANDERING), 10.0, 25.0, 3600.0)
    noise = ElementTree.fromstring(export_model(held, GyroModel(), 'sdf')[0]).find('.//noise')
    made = as_gazebo_makes_it(noise, 400_000, 0.1, np.random.default_rng(1))
    chart = allan_deviation(made, 0.1, [0.1, 1.0, 10.0, 100.0, 1000.0])
    wanted = np.sqrt(WANDERING.allan_variance(np.array(chart.time)))
    ratio = np.array(chart.deviation) / wanted
    # five times the scatter of 40 seeds, which is 13 % for 40 means of 1000 s
    assert (np.abs(ratio - 1.0) < error + np.array([0.01, 0.02, 0.04, 0.15, 0.7])).all()


@pytest.mark.parametrize('span', [100.0, 3600.0, 1e5])
def test_a_random_walk_stays_one_and_no_wander_stays_none(span):
    process, error = fit_gauss_markov(Noise(7e-4, 0.0, 1e-5), 0.01, span)
    assert process.density == pytest.approx(1e-5, rel=0.02) and error < 0.01
    assert fit_gauss_markov(Noise(7e-4), 0.01, span)[0].density == 0.0


def test_the_bias_is_the_output_at_rest_at_the_temperature():
    model = GyroModel((term('bias', 1e-3), term('scale_factor_error', 0.05),
                       term('bias_temperature', 25.0, 1e-5), term('warm_up', 60.0, 0.2)),
                      self_calibration=SelfCalibration(0.01, 2e-3, ((1e-6, 0.0), (0.0, 4e-8))))
    held, _ = simulator_parameters(model, 100.0, 35.0, 3600.0)
    assert held.bias == pytest.approx(1e-3 + 1e-4 + 1.05 * 2e-3, rel=1e-9)
    assert held.bias_deviation == pytest.approx(2e-4)


@pytest.mark.parametrize('simulator', SIMULATORS)
def test_each_effect_is_held_or_listed(simulator):
    for name, effect in CATALOGUE.items():
        model = GyroModel((Term(effect, tuple(0.011 if each.default is None else each.default
                                              for each in effect.parameters)),))
        text, left_out = export_model(
            simulator_parameters(model, 100.0, 25.0, 3600.0)[0], model, simulator)
        listed = any(each.startswith(f'{name}:') for each in left_out)
        assert listed or f'{0.011:.9g}' in text.rpartition('-->')[2], name
        assert all(each in text for each in left_out), name
        assert not any(each.endswith('0.011 1') for each in left_out), 'a number has no unit'


def test_mujoco_limits_and_delays_as_the_model():
    mujoco = pytest.importorskip('mujoco')
    model = GyroModel((term('saturation', 1.5), term('time_offset', 0.013)), noise=WANDERING)
    text, left_out = export_model(
        simulator_parameters(model, 100.0, 25.0, 3600.0)[0], model, 'mujoco')
    world = mujoco.MjModel.from_xml_string(
        '<mujoco><option timestep="0.002" gravity="0 0 0"/><worldbody><body>'
        '<joint type="hinge" axis="0 0 1"/><geom size="0.1" mass="1"/><site name="imu"/>'
        f'</body></worldbody>{text}</mujoco>')
    state, seen = mujoco.MjData(world), []
    for step in range(200):
        state.qvel[0] = 0.02 * step  # 10 rad/s²
        mujoco.mj_step(world, state)
        seen.append((0.02 * step, float(state.sensordata[2])))
    rate, output = np.array(seen[50:]).T
    np.testing.assert_allclose(output, np.minimum(rate - 0.13, 1.5), atol=1e-3)
    assert any('add none' in each for each in left_out)


def test_the_verb_writes_a_file_and_lists_what_is_missing(run, tmp_path):
    (tmp_path / 'model.yaml').write_text(EXPORTED)
    out = tmp_path / 'imu.sdf'
    code, text, _ = run('export', '--to', 'sdf', tmp_path / 'model.yaml', '--out', out)
    assert code == 0 and 'does not hold' in text and 'scale_factor_error = 0.03' in text
    noise = ElementTree.fromstring(out.read_text()).find('angular_velocity/z/noise')
    assert noise.get('type') == 'gaussian_quantized'
    code, text, _ = run('export', '--to', 'sdf', tmp_path / 'model.yaml', '--json')
    answer = json.loads(text)
    assert answer['text'] == out.read_text() and answer['figures']['time_offset'] == 0.013
