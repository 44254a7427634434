"""
Calibrate against an encoder: a log in time with a reference heading -> scale factor error and bias, and what heading is left wrong.

Two ways: the likelihood of the headings themselves, and the regression of the encoder's rate on the gyro, sample by sample.

"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from gyro_calibration.effects import BIAS, SCALE_FACTOR_ERROR
from gyro_calibration.heading import integrate
from gyro_calibration.likelihood import Fit, fit_likelihood
from gyro_calibration.log import DEGREE, Array, DataRefused, Log
from gyro_calibration.model import GyroModel, Term
from gyro_calibration.motion import Motion, from_headings
from gyro_calibration.noise import Noise
from gyro_calibration.self_calibration import Limits, fit_rate, refuse_dead, refuse_scale

METHODS = ('likelihood', 'rate')


@dataclass(frozen=True)
class Residual:
    """
    Heading of the gyro less that of the reference, over a whole log.

    Attributes
    ----------
    heading : rad, shape (n,); its mean is 0, as nobody knows where the gyro began

    """

    heading: Array

    @property
    def rms(self) -> float:
        """Return the root of the mean square, rad."""
        return math.sqrt(float(np.mean(self.heading ** 2)))

    @property
    def largest(self) -> float:
        """Return the largest error either way, rad."""
        return float(np.abs(self.heading).max())


@dataclass(frozen=True)
class EncoderCalibration:
    """
    What a log with a reference heading says of a gyro.

    Attributes
    ----------
    model : scale factor error and bias with their covariance, the ranges and the temperature that they were found at
    method : one of `METHODS`
    fit : the same with noise and time offset, as found
    time : of the reference's samples, s, shape (n,)
    before, after : the residual heading without calibration and with it
    lost_samples : so many are missing between the stamps
    remarks : what to know, one sentence each

    """

    model: GyroModel
    method: str
    fit: Fit
    time: Array
    before: Residual
    after: Residual
    lost_samples: int
    remarks: tuple[str, ...]


def calibrate_encoder(log: Log, method: str = 'likelihood', noise: Noise | None = None,
                      limits: Limits | None = None) -> EncoderCalibration:
    """
    Find scale factor error and bias from a log with a reference heading.

    Parameters
    ----------
    log : with time, output and reference heading; samples without a number count as lost
    method : 'likelihood', or 'rate' for the regression of the encoder's rate on the gyro
    noise : of the gyro, if it is known; goes into the model
    limits : what is believed

    Raises
    ------
    DataRefused : with the reason and the remedy

    """
    limits = limits or Limits(time_offset=LARGEST_TIME_OFFSET)
    time, output, motion = _pair(log)
    _refuse_motion(motion, limits)
    refuse_dead(output)
    fit = fit_likelihood(time, output, motion, limits.time_offset) if method == 'likelihood' else _by_rate(time, output, motion)
    refuse_scale(fit.scale_factor_error, 'reference', 'give --invert, or turn the gyro over')
    _refuse_uncertain(fit, limits)
    compensated = (output - fit.bias) / (1.0 + fit.scale_factor_error)
    before, after = (_residual(time - np.nan_to_num(fit.time_offset), rate, motion) for rate in (output, compensated))
    return EncoderCalibration(_model(output, log.temperature, fit, noise), method, fit, motion.time, before, after, _lost(time),
                              _remarks(fit))


#: Gyro and encoder on one host are no further apart, s; a swing may look alike half a period later.
LARGEST_TIME_OFFSET = 0.25


def _pair(log: Log) -> tuple[Array, Array, Motion]:
    """Return time and output of the gyro, and the motion by the reference, each without what was lost."""
    if log.time is None or log.output is None or log.reference_heading is None:
        raise DataRefused('the log holds no reference heading over time: it needs the columns time_s, gyro_dps and reference_heading_deg')
    heard, seen = np.isfinite(log.output), np.isfinite(log.reference_heading)
    for known, name in ((heard, 'gyro'), (seen, 'reference')):
        if known.sum() < max(100, 0.1 * len(log)):
            raise DataRefused(f'the {name} has a value in {known.sum()} of {len(log)} samples; at least a tenth and 100 are needed: '
                              'mend its line and record again')
    start = log.time[seen][0]
    return log.time[heard] - start, log.output[heard], from_headings(log.time[seen], log.reference_heading[seen])


def _refuse_motion(motion: Motion, limits: Limits) -> None:
    if motion.duration < 10.0:
        raise DataRefused(f'the log lasts {motion.duration:.1f} s; at least 10 s are needed: record longer')
    points = np.arange(0.0, motion.duration, 0.5)
    spread = float(np.std(np.diff(motion.heading_at(points)) / 0.5))
    if spread < limits.rate_spread:
        mean = motion.heading[-1] / motion.duration
        raise DataRefused(f'the reference turns at one speed, {mean / DEGREE:.1f} deg/s (it varies by {spread / DEGREE:.2f} deg/s), so '
                          'scale and bias cannot be parted: turn in both senses, or at another speed too, or with a rest')


def _refuse_uncertain(fit: Fit, limits: Limits) -> None:
    deviation = math.sqrt(fit.covariance[0, 0])
    if deviation > limits.scale_standard_deviation:
        raise DataRefused(f'the scale factor error is known to {100 * deviation:.1f} % only, wanted '
                          f'{100 * limits.scale_standard_deviation:g} %: turn further, faster, or more often')


def _by_rate(time: Array, output: Array, motion: Motion) -> Fit:
    """Fit by the rate of the encoder; the standard deviations are from the scatter of the residual, which is correlated."""
    inside = (time >= 0.0) & (time <= motion.duration)
    time, output = time[inside], output[inside]
    fit = fit_rate(time, output, motion)
    scale, offset = 1.0 / (1.0 + fit.scale_factor_error), -fit.bias / (1.0 + fit.scale_factor_error)
    columns = np.column_stack([output, np.ones(len(output))])
    scores = columns * (columns @ (scale, offset) - motion.rate_at(time))[:, None]
    inverse = np.linalg.inv(columns.T @ columns)
    jacobian = np.array([[-1.0, 0.0], [offset, -scale]]) / scale ** 2
    transformed = jacobian @ inverse
    covariance = transformed @ _long_run(scores) @ transformed.T
    return Fit(fit.scale_factor_error, fit.bias, covariance, math.nan)


def _long_run(scores: Array) -> Array:
    """Return the covariance of the sum of correlated scores, shape (n, k), by the scatter of 40 blocks' sums about their mean."""
    sums = np.array([block.sum(axis=0) for block in np.array_split(scores, 40)])
    return 40.0 * np.cov(sums.T)


def _model(output: Array, temperature: Array | None, fit: Fit, noise: Noise | None) -> GyroModel:
    model = GyroModel((Term(BIAS, (fit.bias,)), Term(SCALE_FACTOR_ERROR, (fit.scale_factor_error,))), fit.covariance[::-1, ::-1],
                      (float(output.min()), float(output.max())),
                      noise=noise or Noise(float(np.nan_to_num(fit.angle_random_walk))))
    if temperature is None:
        return model
    return replace(model, temperature_range=(float(temperature.min()), float(temperature.max())),
                   reference_temperature=float(temperature.mean()))


def _residual(time: Array, rate: Array, motion: Motion) -> Residual:
    error = np.interp(motion.time, time, integrate(time, rate)) - motion.heading
    return Residual(error - error.mean())


def _lost(time: Array) -> int:
    """Return how many samples are missing between the stamps."""
    intervals = np.diff(time)
    return int(np.sum(np.round(intervals / np.median(intervals)) - 1.0))


def _remarks(fit: Fit) -> tuple[str, ...]:
    s = fit.scale_factor_error
    wrong = -s / (1.0 + s)
    return (f'a reference that shows {100 * wrong:+.2f} % of each turn too much, {360.0 * (1.0 + wrong):.2f} for 360 deg, would look just '
            f'like this scale factor error of {100 * s:+.2f} %: check its scale over whole turns closed on a mark',)
