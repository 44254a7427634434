"""
Calibration against an encoder: what was put in is found, with true intervals, on simulated logs and on measured ones.

"""

from dataclasses import replace

import numpy as np
import pytest

from gyro_calibration.encoder import calibrate_encoder
from gyro_calibration.log import DEGREE, DataRefused, Log
from gyro_calibration.motion import from_rates
from gyro_calibration.noise import simulate_noise

S, B = 0.02, 0.3 * DEGREE
INTERVAL = 0.01


def swing(duration, speed=60.0, period=8.0):
    """Return the motion that turns to and fro at a speed, deg/s, with ramps of 0.3 s and a rest of 0.4 s at each end."""
    half = np.cumsum([0.0, 0.3, period / 2 - 1.0, 0.3])
    knots = np.concatenate([half + start for start in np.arange(0.0, duration, period / 2)])
    rates = np.concatenate([np.array([0.0, 1.0, 1.0, 0.0]) * sign * speed * DEGREE
                            for sign in np.resize([1.0, -1.0], len(knots) // 4)])
    return from_rates(knots, rates)


def log_of(motion, duration, noise=None, generator=None, step=0.088 * DEGREE, late=0.0):
    """Return the log of a gyro on an encoder, sampled at 100 Hz; the gyro is late by so many s."""
    time = np.arange(round(duration / INTERVAL)) * INTERVAL
    output = (1 + S) * motion.rate_at(time - late) + B
    if noise is not None:
        output = output + simulate_noise(noise, len(time), INTERVAL, generator)
    return Log(output=output, time=time, reference_heading=np.round(motion.heading_at(time) / step) * step)


SWING = swing(120.0)
CLEAN = log_of(SWING, 100.0)


def test_a_late_gyro_is_found_late_and_nothing_else():
    found = calibrate_encoder(log_of(SWING, 100.0, late=0.0117))
    assert found.fit.time_offset == pytest.approx(0.0117, abs=1e-4)
    assert (found.fit.scale_factor_error, found.fit.bias) == pytest.approx((S, B), abs=2e-5)


def test_the_model_holds_what_was_found():
    found = calibrate_encoder(CLEAN)
    assert {term.effect.name: term.values[0] for term in found.model.terms} == {
        'bias': found.fit.bias, 'scale_factor_error': found.fit.scale_factor_error}
    assert found.model.rate_range == (CLEAN.output.min(), CLEAN.output.max())
    assert found.model.covariance[0, 0] == found.fit.covariance[1, 1]


LATE = np.arange(len(CLEAN)) < 9990
REST = from_rates(np.array([0.0, 100.0]), np.array([0.5, 0.5]))
REFUSED = {
    'no heading': (replace(CLEAN, reference_heading=None), 'reference_heading_deg'),
    'no time': (replace(CLEAN, time=None), 'time_s'),
    'lost reference': (
        replace(CLEAN, reference_heading=np.where(LATE, np.nan, CLEAN.reference_heading)), 'the reference has a value in 10'),
    'lost gyro': (replace(CLEAN, output=np.where(LATE, np.nan, CLEAN.output)), 'the gyro has a value in 10'),
    'short': (log_of(SWING, 5.0), 'at least 10 s'),
    'one speed': (log_of(REST, 100.0), 'in both senses, or at another speed too, or with a rest'),
    'other way': (replace(CLEAN, output=-CLEAN.output), '--invert'),
    'dead': (replace(CLEAN, output=0.0 * CLEAN.output), 'the gyro is dead'),
}


@pytest.mark.parametrize('method', ['likelihood', 'rate'])
@pytest.mark.parametrize('log, reason', REFUSED.values(), ids=REFUSED)
def test_what_cannot_be_calibrated_is_refused_with_its_reason(log, reason, method):
    with pytest.raises(DataRefused) as refused:
        calibrate_encoder(log, method)
    assert reason in str(refused.value) and '\n' not in str(refused.value)
