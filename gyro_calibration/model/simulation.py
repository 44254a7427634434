# Copyright 2026 The gyro_calibration maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations
# under the License.

"""What a gyro with a given model would report of a motion."""

from __future__ import annotations

from gyro_calibration.logs.log import Array, Log, Number
from gyro_calibration.model.channels import History
from gyro_calibration.model.effects import Channels
from gyro_calibration.model.gyro_model import GyroModel
from gyro_calibration.model.motion import Motion
from gyro_calibration.model.noise import simulate_noise
import numpy as np


def simulate(model: GyroModel, motion: Motion, sample_rate: float = 100.0,
             generator: np.random.Generator | None = None,
             temperature: Number | None = None) -> Log:
    """
    Return the log of a simulated gyro.

    Parameters
    ----------
    model : effects and noise of the gyro
    motion : its true motion, kept in the log as the reference
    sample_rate : Hz
    generator : source of the noise; without one there is none
    temperature : degC, of all samples or of each, shape (n,); default: the reference temperature

    """
    time = np.arange(round(motion.duration * sample_rate) + 1) / sample_rate
    rate, heading = motion.rate_at(time), motion.heading_at(time)
    degc = np.broadcast_to(model.reference_temperature if temperature is None else temperature,
                           len(time)).astype(float)
    channels = History().follow(time, degc, heading=heading)
    output = respond(model, time, channels.moving(rate, rate), generator)
    return Log(output=output, time=time, temperature=degc, reference_rate=rate,
               reference_heading=heading)


def respond(model: GyroModel, time: Array, channels: Channels,
            generator: np.random.Generator | None = None) -> Array:
    """
    Return the output, rad/s, shape (n,), of a gyro in a motion and its surroundings.

    Parameters
    ----------
    model : effects and noise of the gyro
    time : stamps, s, increasing, shape (n,); the noise is that of samples at their median interval
    channels : true rate and surroundings at these times, of a log by `history.channels_of`
    generator : source of the noise; without one there is none

    """
    rate = model.distorted('rate', channels.rate, time)
    output = model.output_in(channels.moving(rate, rate))
    if generator is not None:
        output = output + simulate_noise(model.noise, len(time), float(np.median(np.diff(time))),
                                         generator)
    return model.distorted('output', output, time)
