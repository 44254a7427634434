# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""Gyros by published figures, for simulations, plans and benchmarks."""

from dataclasses import dataclass

from gyro_calibration.logs.log import DEGREE
from gyro_calibration.model.effects import BIAS, SCALE_FACTOR_ERROR
from gyro_calibration.model.gyro_model import GyroModel, Term
from gyro_calibration.model.noise import Noise


@dataclass(frozen=True)
class Preset:
    """A gyro by published figures, in the units of data sheets."""

    name: str
    source: str  # of the figures
    angle_random_walk: float  # deg/√h
    bias_instability: float = 0.0  # deg/h
    scale_factor_error: float = 0.0  # 1
    bias: float = 0.0  # deg/s
    interval: float = 0.01  # between samples, s

    @property
    def noise(self) -> Noise:
        return Noise(self.angle_random_walk * DEGREE / 60.0,
                     self.bias_instability * DEGREE / 3600.0)

    @property
    def model(self) -> GyroModel:
        return GyroModel((Term(SCALE_FACTOR_ERROR, (self.scale_factor_error,)),
                          Term(BIAS, (self.bias * DEGREE,))), noise=self.noise)


XV3500 = Preset('XV3500', 'Epson XV-3500CB by Hong and Park 2008, sections 1, 2.1 and 4.2; their '
                'bias is printed in deg/s, but only deg/min explains the drift',
                2.5, 18.0, 0.0373, 0.0125)
RD2100 = Preset('RD2100', 'KVH E-Core RD2100, open-loop fibre-optic, by Ojeda et al. 2000, '
                'Table I and section 5: 5 (deg/h)/√Hz, 0.002 deg/s at constant temperature; '
                'half of 2 % and of 0.2 deg/s, both over the range of temperatures',
                5.0 / 60.0, 7.2, 0.01, 0.1, 0.1)
