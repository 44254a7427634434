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
Export of a gyro model to robot simulators; each lists the parameters that it leaves out.

Gazebo reads the noise of an `<imu>` from SDF, Isaac Lab from Python, MuJoCo from a `<gyro>`.
"""

from collections.abc import Callable
from dataclasses import dataclass
import math
from xml.sax.saxutils import escape

from gyro_calibration.logs.log import Array
from gyro_calibration.model.effects import Channels
from gyro_calibration.model.gyro_model import GyroModel
from gyro_calibration.model.noise import GaussMarkov, Noise, NOISE_TERMS
import numpy as np
from scipy.optimize import least_squares


def fit_gauss_markov(noise: Noise, interval: float, span: float) -> tuple[GaussMarkov, float]:
    """
    Return the process that fits bias instability and rate random walk best, and its error.

    The logarithms of the Allan variances are compared at octaves from the interval of the samples
    to the span, s. The error is the largest relative one of the Allan deviation.
    """
    floor, walk = noise.bias_instability, noise.rate_random_walk
    if not floor and not walk:
        return GaussMarkov(0.0, span), 0.0
    octaves = interval * 2.0 ** np.arange(math.floor(math.log2(span / interval)) + 1)
    wanted = noise.allan_variance(octaves)
    white = noise.angle_random_walk ** 2 / octaves

    def to_process(logarithms: Array) -> GaussMarkov:
        return GaussMarkov(*np.exp(logarithms).tolist())

    def log_errors(logarithms: Array) -> Array:
        return np.log((white + to_process(logarithms).allan_variance(octaves)) / wanted)

    # beyond 100 spans the process is a random walk
    bounds = (-np.inf, math.log(interval)), (np.inf, math.log(100.0 * span))
    found = min((least_squares(log_errors, [math.log(walk + floor / math.sqrt(time)),
                                            math.log(time)], bounds=bounds)
                 for time in np.geomspace(span / 100.0, span, 5)), key=lambda each: each.cost)
    return to_process(found.x), float(np.expm1(0.5 * np.abs(found.fun).max()))


@dataclass(frozen=True)
class _SimulatorParameters:  # in rad/s and s; 0 where there is none
    bias: float  # output at rest
    bias_deviation: float
    white_noise: float  # standard deviation of a sample
    wander: GaussMarkov
    saturation: float
    quantization: float
    time_offset: float
    interval: float


def simulator_parameters(model: GyroModel, sample_rate: float, temperature: float,
                         span: float) -> tuple[_SimulatorParameters, float]:
    """
    Return the parameters of a model that simulators support, and the error of their wander.

    The sample rate is in Hz, the temperature in degC; the span is that of `fit_gauss_markov`.
    """
    interval = 1.0 / sample_rate
    run = model.self_calibration
    begin = run.bias if run else 0.0
    still = {'rate', 'output', 'temperature'}
    terms = [term for term in model.terms if term.effect.inputs <= still]
    channels = Channels(begin, begin, temperature)
    bias = begin + sum(float(term.error(channels)) for term in terms)
    deviation = run.standard_deviations[1] if run else math.nan
    values = {term.effect.name: term.values[0] for term in model.terms}
    wander, error = fit_gauss_markov(model.noise, interval, span)
    return _SimulatorParameters(bias, 0.0 if math.isnan(deviation) else deviation,
                                math.sqrt(model.noise.rate_variance(interval)), wander,
                                values.get('saturation', 0.0), values.get('quantization', 0.0),
                                values.get('time_offset', 0.0), interval), error


def _format_sdf(parameters: _SimulatorParameters) -> tuple[str, set[str]]:
    """Return the noise of the z axis for an `<imu>` in SDF."""
    # Gazebo draws the sign of `bias_mean` at random and decays it, so the bias is the mean of the
    # noise. `dynamic_bias_stddev` is the density of a Gauss-Markov process.
    values = {'mean': parameters.bias, 'stddev': parameters.white_noise, 'bias_mean': 0.0,
              'bias_stddev': parameters.bias_deviation}
    names = {'bias', 'bias_instability', 'rate_random_walk', 'angle_random_walk'}
    if parameters.wander.density:
        values |= {'dynamic_bias_stddev': parameters.wander.density,
                   'dynamic_bias_correlation_time': parameters.wander.correlation_time}
    kind = 'gaussian'
    if parameters.quantization >= 1e-6:  # rad/s; Gazebo makes no smaller steps
        kind, values['precision'] = 'gaussian_quantized', parameters.quantization
        names.add('quantization')
    lines = [f'        <{name}>{value:.9g}</{name}>' for name, value in values.items()]
    return '\n'.join(['<imu>', '  <angular_velocity>', '    <z>', f'      <noise type="{kind}">',
                      *lines, '      </noise>', '    </z>', '  </angular_velocity>',
                      '</imu>']), names


def _format_isaac(parameters: _SimulatorParameters) -> tuple[str, set[str]]:
    """Return the noise of an observation term of Isaac Lab, which draws the bias at each reset."""
    return '\n'.join(
        ['from isaaclab.utils.noise import GaussianNoiseCfg, NoiseModelWithAdditiveBiasCfg', '',
         'GYRO_NOISE = NoiseModelWithAdditiveBiasCfg(',
         f'    noise_cfg=GaussianNoiseCfg(mean=0.0, std={parameters.white_noise:.9g}),',
         f'    bias_noise_cfg=GaussianNoiseCfg(mean={parameters.bias:.9g}, '
         f'std={parameters.bias_deviation:.9g}),', ')']), {'bias', 'angle_random_walk'}


def _format_mujoco(parameters: _SimulatorParameters) -> tuple[str, set[str]]:
    """Return a sensor of MuJoCo; from release 3.1.4 on it stores `noise`, but adds none."""
    attributes = {'name': 'gyro', 'site': 'imu', 'noise': f'{parameters.white_noise:.9g}'}
    names = set()
    if parameters.saturation:
        attributes['cutoff'] = f'{parameters.saturation:.9g}'
        names.add('saturation')
    if parameters.time_offset > 0.0:
        attributes |= {'delay': f'{parameters.time_offset:.9g}',
                       'interval': f'{parameters.interval:.9g}',
                       'nsample': f'{math.ceil(parameters.time_offset / parameters.interval) + 2}',
                       'interp': 'linear'}
        names.add('time_offset')
    inside = ' '.join(f'{name}="{value}"' for name, value in attributes.items())
    return f'<sensor>\n  <gyro {inside}/>\n</sensor>', names | {'angle_random_walk'}


_FORMATTERS: dict[str, Callable[[_SimulatorParameters], tuple[str, set[str]]]] = {
    'sdf': _format_sdf, 'isaac': _format_isaac, 'mujoco': _format_mujoco}
SIMULATORS = tuple(_FORMATTERS)  # names of the simulators


def export_model(parameters: _SimulatorParameters, model: GyroModel,
                 simulator: str) -> tuple[str, list[str]]:
    """Return a text for one of `SIMULATORS`, and what it does not hold, which a comment lists."""
    text, names = _FORMATTERS[simulator](parameters)
    run, noise = model.self_calibration, model.noise
    found = {term.effect.name: ', '.join(
        f'{parameter.name} = {value:.6g} {parameter.unit}'.removesuffix(' 1')
        for parameter, value in zip(term.effect.parameters, term.values)) for term in model.terms}
    if run and run.scale_factor_error:
        found['scale_factor_error'] = f'{run.scale_factor_error:.6g} by the self-calibration'
    if parameters.bias:
        found['bias'] = f'{parameters.bias:.6g} rad/s at rest'
    found |= {part.name: f'{value:.6g} {part.unit}' for part in NOISE_TERMS
              if (value := getattr(noise, part.name, 0.0))}
    left_out = [f'{name}: {value}' for name, value in found.items() if name not in names]
    if simulator == 'mujoco' and parameters.white_noise:
        left_out.append('angle_random_walk: stored as noise; MuJoCo 3.1.4 and later add none')
    if not left_out:
        return f'{text}\n', left_out
    lines = ['Not held by this simulator:', *(f'  {each}' for each in left_out)]
    if simulator == 'isaac':
        return '\n'.join([*(f'# {line}' for line in lines), text, '']), left_out
    # two hyphens are not allowed in an XML comment
    inside = escape('\n'.join(lines)).replace('--', '- -')
    return f'<!-- {inside} -->\n{text}\n', left_out
