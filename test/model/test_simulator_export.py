# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""What robot simulators are given is what they can hold of a model, and the rest is listed."""

import json
import math
import xml.etree.ElementTree as ElementTree

from gyro_calibration.allan.deviation import allan_deviation
from gyro_calibration.model.effects import CATALOGUE
from gyro_calibration.model.gyro_model import GyroModel, SelfCalibration, Term
from gyro_calibration.model.noise import Noise
from gyro_calibration.model.simulator_export import (
    export_model, fit_gauss_markov, simulator_parameters, SIMULATORS)
import numpy as np
import pytest

NOISE = Noise(7e-4, 2e-4, 1e-6)
GYRO = """
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
    decay, bias, biases = math.exp(-interval / time), 0.0, []
    for each in (step * generator.standard_normal(count)).tolist():
        bias = decay * bias + each
        biases.append(bias)
    return np.array(biases) + generator.normal(value['mean'], value['stddev'], count)


def test_the_noise_of_gazebo_has_the_allan_deviation_of_the_model():
    held, error = simulator_parameters(GyroModel(noise=NOISE), 10.0, 25.0, 3600.0)
    noise = ElementTree.fromstring(export_model(held, GyroModel(), 'sdf')[0]).find('.//noise')
    made = as_gazebo_makes_it(noise, 400_000, 0.1, np.random.default_rng(1))
    chart = allan_deviation(made, 0.1, [0.1, 1.0, 10.0, 100.0, 1000.0])
    wanted = np.sqrt(NOISE.allan_variance(np.array(chart.time)))
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
    model = GyroModel((term('saturation', 1.5), term('time_offset', 0.013)), noise=NOISE)
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
    (tmp_path / 'model.yaml').write_text(GYRO)
    out = tmp_path / 'imu.sdf'
    code, text, _ = run('export', '--to', 'sdf', tmp_path / 'model.yaml', '--out', out)
    assert code == 0 and 'does not hold' in text and 'scale_factor_error = 0.03' in text
    noise = ElementTree.fromstring(out.read_text()).find('angular_velocity/z/noise')
    assert noise.get('type') == 'gaussian_quantized'
    code, text, _ = run('export', '--to', 'sdf', tmp_path / 'model.yaml', '--json')
    answer = json.loads(text)
    assert answer['text'] == out.read_text() and answer['figures']['time_offset'] == 0.013
