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
Headings by other programs: VQF (vqf), x-io Fusion (imufusion), and bias averages of ROS packages.

Install them by ``pip install vqf imufusion``. None of them knows a scale factor. So they are given
the rates after the calibration, and its uncertainty of the bias; and also the raw rates, from
which they estimate the bias by themselves. The gyro's axis is vertical, and the accelerometer has
no error. The settings are the published ones, and the best that `tuned` finds.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
import importlib
from types import ModuleType
from typing import Any

from drives import Drive
from gyro_calibration.heading.integration import integrate
from gyro_calibration.logs.log import Array, DEGREE
from gyro_calibration.model.gyro_model import SelfCalibration
import numpy as np
from scipy.signal import lfilter

GRAVITY = 9.81

#: (drive, rates, rad/s, standard deviation of their bias, rad/s, None where not calibrated,
#: settings) -> headings
Heading = Callable[[Drive, Array, 'float | None', Mapping[str, float]], Array]


@dataclass(frozen=True)
class Peer:
    """Another program."""

    heading: Heading  # returns what it makes of a drive, rad, shape (n,)
    package: str  # what it needs to be installed; '' for nothing
    published: Mapping[str, float]  # its settings as they come
    choices: Mapping[str, Sequence[float]] = field(default_factory=dict)  # what to try

    @property
    def installed(self) -> bool:
        """Tell whether it can be run here."""
        return not self.package or _module(self.package) is not None

    def run(self, drive: Drive, calibration: SelfCalibration,
            settings: Mapping[str, float]) -> Array:
        """Return the heading; the setting 'calibrated' selects calibrated rates."""
        if not settings['calibrated']:
            return self.heading(drive, drive.output, None, settings)
        return self.heading(drive, np.asarray(calibration.correct(drive.output)),
                            calibration.standard_deviations[1], settings)


@cache
def _module(name: str) -> ModuleType | None:
    try:
        return importlib.import_module(name)
    except ImportError:
        return None


def _vertical(values: Array) -> Array:
    """Return vectors along the vertical, shape (n, 3)."""
    vectors = np.zeros((len(values), 3))
    vectors[:, 2] = values
    return vectors


def _yaw(quaternions: Array) -> Array:
    """
    Return the heading at the samples, rad, from quaternions after each.

    The programs take each rate for that of the interval before it. The mean of two headings is
    that of the trapezoid rule, which removes their delay of half an interval.
    """
    after = np.unwrap(2.0 * np.arctan2(quaternions[:, 3], quaternions[:, 0]))
    before = np.concatenate([after[:1], after[:-1]])
    heading = 0.5 * (after + before)
    return heading - heading[0]


def vqf(drive: Drive, rate: Array, deviation: float | None,
        settings: Mapping[str, float]) -> Array:
    """Return the heading by VQF without magnetometer, and with what it is told of the bias."""
    module: Any = _module('vqf')
    own = {name: value for name, value in settings.items() if name != 'calibrated'}
    estimator = module.VQF(drive.gyro.interval, **own)
    if deviation is not None:
        estimator.setBiasEstimate(np.zeros(3), deviation)
    return _yaw(estimator.updateBatch(_vertical(rate),
                                      _vertical(np.full(len(rate), GRAVITY)))['quat6D'])


def fusion(drive: Drive, rate: Array, deviation: float | None,
           settings: Mapping[str, float]) -> Array:
    """Return the heading by bias estimation and filter of x-io Fusion, at the gyro's rate."""
    module: Any = _module('imufusion')
    bias, filtered = module.Bias(), module.Ahrs()
    bias.set_settings(module.BiasSettings(sample_rate=1.0 / drive.gyro.interval,
                                          stationary_threshold=settings['threshold'],
                                          stationary_period=settings['period']))
    filtered.set_settings(module.AhrsSettings(sample_rate=1.0 / drive.gyro.interval))
    filtered.skip_startup()  # in which it keeps the heading at zero for 3 s
    gravity, quaternions = np.array([0.0, 0.0, 1.0]), np.empty((len(rate), 4))
    for index, sample in enumerate(_vertical(rate / DEGREE)):
        filtered.update_no_magnetometer(bias.update(sample), gravity)
        quaternions[index] = filtered.get_quaternion()
    return _yaw(quaternions)


def bias_average(drive: Drive, rate: Array, deviation: float | None,
                 settings: Mapping[str, float]) -> Array:
    """
    Return the heading less an exponential average of nearly constant rates.

    A rate counts if it differs little from the average and from the one before. So does the
    complementary filter of imu_tools, as long as the accelerometer shows gravity alone.
    """
    threshold, change, gain = (settings['threshold'] * DEGREE, settings['change'] * DEGREE,
                               settings['gain'])
    steady = (np.abs(np.diff(rate, prepend=rate[0])) < change).tolist()
    bias, biases = 0.0, []
    for value, still in zip(rate.tolist(), steady):
        if still and -threshold < value - bias < threshold:
            bias += gain * (value - bias)
        biases.append(bias)
    return integrate(drive.time, rate - np.array(biases))


def wheel_bias_average(drive: Drive, rate: Array, deviation: float | None,
                       settings: Mapping[str, float]) -> Array:
    """Return the heading less an exponential average while the wheels stand (imu_bias_remover)."""
    gain, still = settings['gain'], ~drive.moving
    average = lfilter([gain], [1.0, gain - 1.0], rate[still])
    counted = np.cumsum(still)
    return integrate(drive.time,
                     rate - np.where(counted, np.append(average, 0.0)[counted - 1], 0.0))


PEERS = {
    'VQF': Peer(vqf, 'vqf', {'calibrated': True},
                {'biasClip': (2.0, 0.5, 0.2, 0.1), 'restThGyr': (2.0, 1.0, 0.5, 0.2),
                 'biasSigmaRest': (0.03, 0.01, 0.003, 0.001),
                 'biasForgettingTime': (100.0, 300.0, 1000.0, 3000.0), 'restMinT': (1.5, 0.5, 3.0),
                 'calibrated': (True, False)}),
    'x-io Fusion': Peer(fusion, 'imufusion', {'threshold': 3.0, 'period': 3.0, 'calibrated': True},
                        {'threshold': (3.0, 2.0, 1.5, 1.0, 0.5, 0.2, 0.1, 0.05),
                         'period': (3.0, 1.0, 5.0), 'calibrated': (True, False)}),
    'complementary filter, bias average': Peer(
        bias_average, '',
        {'threshold': 0.2 / DEGREE, 'change': 0.01 / DEGREE, 'gain': 0.01, 'calibrated': True},
        {'threshold': (0.2 / DEGREE, 2.0, 1.0, 0.5, 0.2, 0.1), 'change': (0.01 / DEGREE, 2.0, 0.1),
         'gain': (0.01, 3e-3, 1e-3, 3e-4, 1e-4, 3e-5), 'calibrated': (True, False)}),
    'bias average while the wheels stand': Peer(
        wheel_bias_average, '', {'gain': 0.01, 'calibrated': True},
        {'gain': (0.01, 3e-3, 1e-3, 3e-4, 1e-4, 3e-5), 'calibrated': (True, False)}),
}


def tuned(peer: Peer, drives: Sequence[tuple[Drive, SelfCalibration]]) -> Mapping[str, float]:
    """Return the settings of least mean error, each improved twice in turn from the published."""
    def cost(settings: Mapping[str, float]) -> float:
        return float(np.mean([np.abs(peer.run(drive, known, settings) - drive.heading).mean()
                              for drive, known in drives]))
    best, least = peer.published, cost(peer.published)
    for _ in range(2):
        for name, choices in peer.choices.items():
            for choice in choices:
                tried = {**best, name: choice}
                found = cost(tried) if tried != best else least
                if found < least:
                    best, least = tried, found
    return best
