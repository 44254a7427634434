"""What a gyro with a given model would report of a motion."""

from __future__ import annotations

import numpy as np

from gyro_calibration.log import Log
from gyro_calibration.model import GyroModel
from gyro_calibration.motion import Motion
from gyro_calibration.noise import simulate_noise


def simulate(model: GyroModel, motion: Motion, sample_rate: float = 100.0, generator: np.random.Generator | None = None,
             temperature: float | None = None) -> Log:
    """
    Return the log of a simulated gyro.

    Parameters
    ----------
    model : effects and noise of the gyro
    motion : its true motion, kept in the log as the reference
    sample_rate : Hz
    generator : source of the noise; without one there is none
    temperature : degC; the model's reference temperature where it is None

    """
    time = np.arange(round(motion.duration * sample_rate) + 1) / sample_rate
    rate = motion.rate_at(time)
    degc = np.full(len(time), model.reference_temperature if temperature is None else temperature)
    output = model.output(rate, degc)
    if generator is not None:
        output = output + simulate_noise(model.noise, len(time), 1.0 / sample_rate, generator)
    return Log(output=output, time=time, temperature=degc, reference_rate=rate, reference_heading=motion.heading_at(time))
