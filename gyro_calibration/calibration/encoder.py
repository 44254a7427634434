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
Calibrate a gyro against an encoder: scale factor error, bias and the residual heading.

The input is a log in time with a reference heading. There are two methods: the likelihood of the
headings, and the regression of the encoder's rate on the gyro, sample by sample.

The error of an encoder is constant while its reading is, and known where the reading changes by a
step; so readings are used at their steps. An error of step / sqrt(12) at each sample would give
rests too much weight: with 0.088 deg and a gyro of low noise the variance of the scale was 58
times the Cramer-Rao bound. The interval of the scale is the scatter between pieces of the log,
since the error that repeats in each period of a swing is no noise of the fit; that of the bias is
its wander between pieces.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math

from gyro_calibration.calibration.course_over_ground import (
    COSINE_COUNT,
    fit_course,
    is_course,
    MAX_ROUNDING_STEP,
    TECHNOLOGY_PRIORS,
    WHITE_NOISE_RANGE,
)
from gyro_calibration.calibration.dwells import Dwells
from gyro_calibration.calibration.fit_quality import DRIVE_DURATION
from gyro_calibration.calibration.likelihood import fit_likelihood, ScaleBiasFit
from gyro_calibration.calibration.noise_grid import (
    BandedNoise,
    bias_wander_columns,
    fit_noise_grid,
    HierarchicalPrior,
    TridiagonalMatrix,
)
from gyro_calibration.calibration.self_calibration import fit_rate, refuse_scale, RunLimits
from gyro_calibration.heading.integration import integrate
from gyro_calibration.logs.log import Array, DataRefused, DEGREE, Log, refuse_wrapped
from gyro_calibration.logs.quality import quantization_step, refuse_dead
from gyro_calibration.logs.stamps import count_lost_samples
from gyro_calibration.model.effects import BIAS, SCALE_FACTOR_ERROR
from gyro_calibration.model.gyro_model import GyroModel, Term
from gyro_calibration.model.motion import Motion, motion_from_headings
from gyro_calibration.model.noise import Noise
import numpy as np
from numpy.typing import NDArray
from scipy import stats

#: Longest log, s: three years; a longer one has stamps in another unit.
MAX_LOG_DURATION = 1e8
#: Smallest step of a reference, rad: the resolution of headings in a file.
MIN_REFERENCE_STEP = 1e-6


@dataclass(frozen=True)
class HeadingResidual:
    """
    Heading of the gyro less that of the reference, over a whole log.

    Attributes
    ----------
    heading : rad, shape (n,); its mean is 0, as the gyro's first heading is not known

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
class BiasDrift:
    """
    How a heading drifts after the fit.

    Attributes
    ----------
    time, drift_rate : middles of the intervals between pieces of the log, s, and the drift of the
        heading there, rad/s, shape (m,)
    angle_random_walk, largest_walk : rad/√s, over times longer than a piece, and its upper limit
        (97.5 %) if nothing else moves the heading from piece to piece
    bias, deviation : mean bias over the log and its standard deviation, rad/s
    wander_deviation : standard deviation of the mean bias less the bias at the beginning, rad/s

    """

    time: Array
    drift_rate: Array
    angle_random_walk: float
    largest_walk: float
    bias: float
    deviation: float
    wander_deviation: float


@dataclass(frozen=True)
class EncoderCalibration:
    """
    The calibration of a gyro by a log with a reference heading.

    Attributes
    ----------
    model : scale factor error and bias with their covariance, valid ranges and temperature
    method : one of `METHODS`
    fit : the same with noise and time offset, as found
    drift : of the bias after the fit; the wander is part of the bias's standard deviation
    reference : its headings over time, s since it began
    residual_before, residual_after : the residual heading without calibration and with it
    lost_samples : number missing between the stamps, where these are regular enough to count them
    remarks : on the result, one sentence each

    """

    model: GyroModel
    method: str
    fit: ScaleBiasFit
    drift: BiasDrift
    reference: Motion
    residual_before: HeadingResidual
    residual_after: HeadingResidual
    lost_samples: int
    remarks: tuple[str, ...]


def calibrate_encoder(log: Log, method: str | None = None, noise: Noise | None = None,
                      limits: RunLimits | None = None,
                      technology: str = 'mems') -> EncoderCalibration:
    """
    Find scale factor error and bias from a log with a reference heading.

    Parameters
    ----------
    log : with time, output and reference heading, or a reference rate, which is integrated;
        samples without a number count as lost
    method : 'likelihood', 'course' for a course over ground, or 'rate' for the regression of the
        encoder's rate on the gyro; None for 'course' where the reference is one, else 'likelihood'
    noise : of the gyro, if it is known; goes into the model
    limits : of an accepted calibration
    technology : of the gyro, one of `course_over_ground.TECHNOLOGY_PRIORS`; with 'course' its
        prior decides what a drive leaves open

    Raises
    ------
    DataRefused : with the reason and the remedy

    """
    limits = limits or RunLimits(max_time_offset=MAX_TIME_OFFSET)
    time, output, motion = _extract_motion(log)
    method = method or ('course' if log.reference_heading is not None
                        and is_course(time, output, motion) else 'likelihood')
    if method == 'course':
        return _calibrate_by_course(log, time, output, motion, noise, technology)
    _refuse_motion(motion, limits)
    refuse_dead(output)
    fit = METHODS[method](time, output, motion, limits)
    refuse_scale(fit.scale_factor_error, 'reference', 'give --invert, or turn the gyro over')
    drift = _estimate_drift(motion, _corrected_residual(time, output, motion, fit).heading,
                            fit.bias, noise or Noise(), technology)
    _refuse_uncertain_bias(drift.bias, drift.deviation, limits.max_heading_error)
    fit = _apply_drift(fit, drift)
    _refuse_uncertain_scale(fit, limits)
    before = _heading_residual(time - np.nan_to_num(fit.time_offset), output, motion)
    after = _corrected_residual(time, output, motion, fit)
    # what repeats within a piece, as a wobble of the shaft does, is no random walk
    repeats = fit.angle_random_walk > drift.largest_walk
    fit = replace(fit, angle_random_walk=drift.largest_walk) if repeats else fit
    walk = fit.angle_random_walk if method == 'likelihood' else drift.angle_random_walk
    model = _build_model(output, log.temperature, fit, noise or Noise(walk))
    # the steps of an encoder hide white noise
    if (noise is None and method == 'likelihood' and not repeats
            and quantization_step(motion.heading) < MAX_ROUNDING_STEP):
        low, high = walk / np.sqrt(stats.chi2.ppf([0.975, 0.025], fit.dof) / fit.dof)
        model = replace(model, noise_bounds={'angle_random_walk': (float(low), float(high))})
    return EncoderCalibration(model, method, fit, drift, motion, before, after,
                              _count_lost_samples(time), _list_remarks(fit, method))


def _calibrate_by_course(log: Log, time: Array, output: Array, motion: Motion, noise: Noise | None,
                         technology: str) -> EncoderCalibration:
    """Calibrate against a course over ground."""
    _refuse_length(motion)
    refuse_dead(output)
    fit = fit_course(time, output, motion, technology)
    before = _heading_residual(time - fit.time_offset, output, motion)
    after = _corrected_residual(time, output, motion, fit)
    drift = _estimate_drift(motion, after.heading, fit.bias, noise or Noise(), technology)
    model = _build_model(output, log.temperature, fit, noise or Noise(fit.angle_random_walk))
    remark = ('what the drive leaves open of scale factor error and bias is drawn towards zero, '
              f'as of a gyro of the technology {technology} (--technology); '
              'the intervals hold that')
    return EncoderCalibration(model, 'course', fit, drift, motion, before, after,
                              _count_lost_samples(time), (remark,))


#: Fewer leave nothing over for two values, bias and scale factor error.
MIN_DWELLS = 3


def is_continuous_motion(logs: Sequence[Log], table: Dwells) -> bool:
    """Tell whether logs are one log in time that has not enough dwells for a fit."""
    return len(logs) == 1 and logs[0].time is not None and len(table) < MIN_DWELLS


#: Largest offset of gyro and encoder on one host, s; a swing may look alike half a period later.
MAX_TIME_OFFSET = 0.25
#: Standard deviation of what is assumed of the gyro's lag, s²: that of a filter of 20 ms.
LAG_DEVIATION = 2e-4


def _extract_motion(log: Log) -> tuple[Array, Array, Motion]:
    """Return time and output of the gyro, and the reference motion, without lost samples."""
    heading, rate = log.reference_heading, log.reference_rate
    if log.time is None or log.output is None or (heading is None and rate is None):
        raise DataRefused('the log holds no reference over time: it needs the columns time_s, '
                          'gyro_dps and reference_heading_deg or reference_rate_dps')
    refuse_wrapped(log)
    if heading is None:
        assert rate is not None
        known, heading = np.isfinite(rate), np.full(len(log), np.nan)
        heading[known] = integrate(log.time[known], rate[known])
    output_known, reference_known = np.isfinite(log.output), np.isfinite(heading)
    # a reference may come far less often than the gyro
    for known, name, fewest in ((output_known, 'gyro', max(100, len(log) // 10)),
                                (reference_known, 'reference', 100)):
        if known.sum() < fewest:
            raise DataRefused(f'the {name} has a value in {known.sum()} of {len(log)} samples; '
                              f'at least {fewest} are needed: repair its line and record again')
    start = log.time[reference_known][0]
    return (log.time[output_known] - start, log.output[output_known],
            motion_from_headings(log.time[reference_known], heading[reference_known]))


def _refuse_length(motion: Motion) -> None:
    if motion.duration < 10.0:
        raise DataRefused(f'the log lasts {motion.duration:.1f} s; at least 10 s are needed: '
                          'record longer')
    if motion.duration > MAX_LOG_DURATION:
        raise DataRefused(f'the log lasts {motion.duration:.3g} s by its stamps; '
                          'check that time_s is in s, or give --rate')


def _refuse_motion(motion: Motion, limits: RunLimits) -> None:
    _refuse_length(motion)
    points = np.arange(0.0, motion.duration, 0.5)
    spread = float(np.std(np.diff(motion.heading_at(points)) / 0.5))
    if spread < limits.min_rate_spread:
        mean = motion.heading[-1] / motion.duration
        raise DataRefused(f'the reference turns at one speed, {mean / DEGREE:.1f} deg/s '
                          f'(it varies by {spread / DEGREE:.2f} deg/s), so scale and bias cannot '
                          'be separated: turn in both senses, or at another speed too, '
                          'or with a rest')


def _refuse_uncertain_scale(fit: ScaleBiasFit, limits: RunLimits) -> None:
    deviation = math.sqrt(fit.covariance[0, 0])
    if deviation > limits.max_scale_deviation:
        raise DataRefused(f'the scale factor error is known to {100 * deviation:.1f} % only, '
                          f'wanted {100 * limits.max_scale_deviation:g} %: '
                          'turn further, faster, or more often')


def _refuse_uncertain_bias(bias: float, deviation: float, limit: float) -> None:
    """
    Refuse a log whose bias is within chance and could make a heading worse.

    It is refused where its standard deviation, rad/s, in `DRIVE_DURATION` s exceeds the limit,
    rad, and its 95 % interval holds zero.

    """
    if deviation * DRIVE_DURATION > limit and abs(bias) < stats.norm.ppf(0.975) * deviation:
        raise DataRefused(f'the log shows a bias of {bias / DEGREE:.3f} +- '
                          f'{deviation / DEGREE:.3f} deg/s, too uncertain to improve a heading: '
                          'turn more slowly, with rests, or for longer')


def _fit_by_likelihood(time: Array, output: Array, motion: Motion,
                       limits: RunLimits) -> ScaleBiasFit:
    return fit_likelihood(time, output, motion, limits.max_time_offset, LAG_DEVIATION)


def _fit_by_rate(time: Array, output: Array, motion: Motion, _: RunLimits) -> ScaleBiasFit:
    """Fit by the rate of the encoder; the stamps are taken as exact."""
    inside = (time >= 0.0) & (time <= motion.duration)
    time, output = time[inside], output[inside]
    fit = fit_rate(time, output, motion)
    scale = 1.0 / (1.0 + fit.scale_factor_error)
    offset = -fit.bias / (1.0 + fit.scale_factor_error)
    columns = np.column_stack([output, np.ones(len(output))])
    scores = columns * (columns @ (scale, offset) - motion.rate_at(time))[:, None]
    jacobian = np.array([[-1.0, 0.0], [offset, -scale]]) / scale ** 2
    influence = -scores @ np.linalg.inv(columns.T @ columns) @ jacobian.T
    return replace(fit, influence=np.column_stack([influence, time]), time_offset=math.nan)


METHODS = {'likelihood': _fit_by_likelihood, 'rate': _fit_by_rate}


def _number_pieces(time: Array) -> NDArray[np.intp]:
    """Return the piece of the log of each time: 8 to 64 pieces, of 5 s or more if above 8."""
    since = (time - time[0]) / (time[-1] - time[0])
    count = int(np.clip((time[-1] - time[0]) / 5.0, 8, 64))
    return np.minimum(since * count, count - 1).astype(np.intp)


def _estimate_drift(motion: Motion, error: Array, bias: float, noise: Noise,
                    technology: str) -> BiasDrift:
    """
    Find the mean bias over a log, and how it wanders, by the drifts between pieces of the log.

    What repeats itself with a motion within a piece is noise of the mean heading of that piece. It
    is at least what the step of the reference leaves, and at most all that the headings are apart.
    The bias has a normal prior about zero, of a tenth of the size that the technology has up to
    all of it: a bias of many standard deviations stays; one that the log hardly shows would only
    harm a heading.

    Parameters
    ----------
    motion : by the reference
    error : of the heading after a fit, rad, shape (n,)
    bias : of that fit, rad/s
    noise : of the gyro, as far as it is known
    technology : of the gyro, one of `TECHNOLOGY_PRIORS`

    """
    piece = _number_pieces(motion.time)
    known = np.flatnonzero(np.bincount(piece))
    if len(known) < 6:
        raise DataRefused(f'the reference is known in {len(known)} of {piece[-1] + 1} parts of '
                          'the log; at least 6 are needed: repair its line and record again')
    middle, heading = ((np.bincount(piece, values) / np.maximum(np.bincount(piece), 1))[known]
                       for values in (motion.time, error))
    spacing, ones = np.diff(middle), np.ones(len(middle) - 1)
    begins = np.flatnonzero(np.diff(piece, prepend=-1))
    durations = motion.time[np.append(begins[1:], len(piece)) - 1] - motion.time[begins]
    between = (durations[1:] + durations[:-1]) / 6.0
    largest = max(TECHNOLOGY_PRIORS[technology][1], 3.0 * abs(bias))
    rounding = max(quantization_step(motion.heading), MIN_REFERENCE_STEP) / math.sqrt(
        12.0 * len(piece) / len(known))
    repeatable_range = (rounding, max(float(np.ptp(heading)), 2.0 * rounding))
    columns, shared = bias_wander_columns(middle, cosine_count=COSINE_COUNT)
    # means over pieces: of a random walk, and of what repeats itself within them
    walk = BandedNoise('angle_random_walk', np.maximum(spacing - between, between),
                       durations[:-1] / 6.0, WHITE_NOISE_RANGE)
    moved, steady = TridiagonalMatrix(walk.diagonal, durations[:-1] / 6.0).whiten(
        np.column_stack([np.diff(heading), spacing])).T
    squares = moved @ moved - (moved @ steady) ** 2 / (steady @ steady)
    found = fit_noise_grid(
        np.diff(heading), spacing[:, None],
        [walk, BandedNoise('reference', 2.0 * ones, -ones, repeatable_range)],
        columns, shared, prior_mean=np.array([-bias]), prior_deviation=np.array([largest]),
        hierarchical_priors=(HierarchicalPrior('bias', 0, (0.1 * largest, largest)),))
    known_wander_variance = sum(
        getattr(noise, part.name) ** 2 * part.unobservable_variance for part in shared)
    return BiasDrift(0.5 * (middle[1:] + middle[:-1]), np.diff(heading) / spacing,
                     found.size('angle_random_walk'),
                     math.sqrt(squares / stats.chi2.ppf(0.025, len(moved) - 1)),
                     bias + float(found.values[0]), float(found.deviations[0]),
                     math.sqrt(max(found.unobservable_variance, known_wander_variance)))


def _apply_drift(fit: ScaleBiasFit, drift: BiasDrift) -> ScaleBiasFit:
    """
    Return the fit with the mean bias of the drift, and covariances by the scatter between pieces.

    What repeats itself with the motion is not noise of the fit, and what is slower than a piece
    shows in part only.

    """
    piece = _number_pieces(fit.influence[:, 2])
    sums = np.array([np.bincount(piece, values) for values in fit.influence[:, :2].T])
    student = (stats.t.ppf(0.975, np.count_nonzero(np.bincount(piece)) - 1)
               / stats.norm.ppf(0.975)) ** 2
    scatter = student * sums @ sums.T
    slope = scatter[0, 1] / scatter[1, 1]
    known = np.array([math.sqrt(scatter[0, 0]),
                      math.hypot(drift.deviation, drift.wander_deviation)])
    deviations = np.sqrt(np.diag(scatter))
    return replace(fit, bias=drift.bias, scale_factor_error=fit.scale_factor_error
                   + float(slope) * (drift.bias - fit.bias),
                   covariance=scatter * np.outer(known / deviations, known / deviations))


def _build_model(output: Array, temperature: Array | None, fit: ScaleBiasFit,
                 noise: Noise) -> GyroModel:
    model = GyroModel(
        (Term(BIAS, (fit.bias,)), Term(SCALE_FACTOR_ERROR, (fit.scale_factor_error,))),
        fit.covariance[::-1, ::-1], (float(output.min()), float(output.max())), noise=noise)
    if temperature is None:
        return model
    return replace(model, temperature_range=(float(temperature.min()), float(temperature.max())),
                   reference_temperature=float(temperature.mean()))


def _corrected_residual(time: Array, output: Array, motion: Motion,
                        fit: ScaleBiasFit) -> HeadingResidual:
    """Return the residual of the output corrected by a fit."""
    return _heading_residual(time - np.nan_to_num(fit.time_offset),
                             (output - fit.bias) / (1.0 + fit.scale_factor_error), motion)


def _heading_residual(time: Array, rate: Array, motion: Motion) -> HeadingResidual:
    error = np.interp(motion.time, time, integrate(time, rate)) - motion.heading
    return HeadingResidual(error - error.mean())


def _count_lost_samples(time: Array) -> int:
    """Return the number of samples missing between the stamps; 0 where these are irregular."""
    lost = count_lost_samples(time)
    return 0 if lost is None else int(lost.sum())


def _list_remarks(fit: ScaleBiasFit, method: str) -> tuple[str, ...]:
    s = fit.scale_factor_error
    reference_scale_error = -s / (1.0 + s)
    scale = (f'a reference that shows {abs(100 * reference_scale_error):.2f} % too '
             f'{"much" if reference_scale_error > 0.0 else "little"}, '
             f'{360.0 * (1.0 + reference_scale_error):.2f} for 360 deg, '
             f'would have the same effect as this scale factor error of {100 * s:+.2f} %: '
             'check it over whole turns closed on a mark')
    if method == 'likelihood':
        return (scale,)
    return scale, ('the regression of rates fits no time offset, and noise of the gyro biases its '
                   'scale factor error by more than its interval; compare it with the method '
                   'likelihood')
