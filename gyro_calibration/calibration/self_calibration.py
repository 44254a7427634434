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
Scale factor error and bias from about 20 s of known motion, with the reasons to refuse a run.

The model is ``output = (1 + s) rate + b + noise`` (Hong and Park, eq. 1). There are three methods:
the two of the paper, unchanged, and a likelihood fit, which has no error by the rectangle rule and
estimates the time offset between gyro and motion.

In all functions, `time` is in s since the start of the motion, and `rate` is the output of the
gyro, after its model if it has one, in rad/s, both of shape (n,). `output` is that before the
model, where it differs, which shows a gyro that is dead or at its limit. `noise` is that of the
gyro, if it is known. Data that are not credible raise `DataRefused`, with reason and remedy.
"""

from dataclasses import dataclass, replace
import math

from gyro_calibration.calibration.likelihood import (
    ASYMMETRY_DEVIATION, EXCESS_RATE_DEVIATION, fit_likelihood, GoodnessOfFit, MAX_NOISE_SIGMAS,
    MAX_TRACKING_LAG, MIN_FIT_PROBABILITY, ScaleBiasFit)
from gyro_calibration.calibration.run_faults import (
    fit_profile, format_slip, MAX_UNEXPLAINED_SHARE, refuse_other_motion, refuse_unit_error,
    RunPieces, split_run)
from gyro_calibration.logs.log import Array, DataRefused, DEGREE
from gyro_calibration.logs.quality import (
    quantization_step, refuse_dead, refuse_saturated, white_noise_deviation)
from gyro_calibration.model.gyro_model import SelfCalibration
from gyro_calibration.model.motion import Motion
from gyro_calibration.model.noise import Noise
import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, ndtr, ndtri

#: Standard deviations from which on a stretch is a slip: 6 of 800 good runs exceed it, and 1 deg,
#: with three times the noise of the XV-3500, none with its own.
_MIN_SLIP_SIGMAS = 4.5
#: Duration of the drive for which the precision of a calibration is stated, s.
DRIVE_DURATION = 300.0
#: Time after the profile at which a robot is at rest, s; change of the rate of a drive, rad/s.
SETTLING_TIME, _MIN_DRIVING_RATE_CHANGE = 1.0, 0.25 * DEGREE


@dataclass(frozen=True)
class RunLimits:
    """The limits of a run that is accepted."""

    min_samples: int = 50  # minimum number of samples
    max_gap: float = 0.5  # longest between samples, s
    # smallest standard deviation of the profile's rate, rad/s
    min_rate_spread: float = 1.0 * DEGREE
    max_scale_factor_error: float = 0.3  # largest, 1
    max_bias: float = 10.0 * DEGREE  # largest, rad/s
    max_scale_deviation: float = 0.02  # largest standard deviation of the scale, 1
    # largest significant deviation of a stretch of the run from the profile, rad
    max_stretch_residual: float = 1.0 * DEGREE
    max_time_offset: float = 1.0  # largest lag of the gyro behind the profile, either way, s
    # largest noise that accumulates in the heading, over the known one or else that of the
    # samples, and its heading error over the run, rad; a run that exceeds both is refused
    max_noise_ratio: float = 8.0
    max_unexplained_angle: float = 1.0 * DEGREE
    rest_duration: float = 2.0  # length of the check after the run, s
    # largest corrected rate at rest after the run, rad/s, unless the noise explains more
    max_rest_rate: float = 2e-4
    # largest error of the heading after five minutes, rad, unless it was larger before
    max_heading_error: float = 30.0 * DEGREE


@dataclass(frozen=True)
class ReferenceErrors:
    """Errors of a reference that a run does not show; zero for an exact or measured one."""

    # standard deviation of its scale factor error, 1; of wheels, that of radius over track
    scale_deviation: float = 0.0
    rate_deviation: float = 0.0  # standard deviation of its drift, rad/s
    random_walk: float = 0.0  # of its heading, rad/√s


def default_reference_errors(motion: Motion) -> ReferenceErrors:
    """Return the usual errors: in a commanded motion wheels slip by up to 1 % of each turn."""
    return ReferenceErrors(0.0 if motion.is_measured else 0.01 / math.sqrt(3.0))


def fit_heading(time: Array, rate: Array, motion: Motion) -> ScaleBiasFit:
    """Fit by Hong and Park's heading reference, with the rectangle rule of eq. 4 (eq. 4 to 7)."""
    step = np.diff(time)
    g = np.column_stack([np.cumsum(step * rate[:-1]), np.cumsum(step)])
    z = motion.heading_at(time[1:]) - motion.heading_at(time[:1])
    return _solve_inverse_model(g.T @ g, g.T @ z)


def fit_rate(time: Array, rate: Array, motion: Motion) -> ScaleBiasFit:
    """Fit by Hong and Park's rate reference (eq. 8 and 9), in the order of q = [s̄, b̄]."""
    true = motion.rate_at(time)
    g = np.array([[rate @ rate, rate.sum()], [rate.sum(), len(rate)]])
    return _solve_inverse_model(g, np.array([true @ rate, true.sum()]))


def _solve_inverse_model(matrix: Array, vector: Array) -> ScaleBiasFit:
    """Solve for s̄ and b̄ of eq. 3, and return them as s and b."""
    if not np.linalg.cond(matrix) < 1e12:
        raise DataRefused('the gyro did not change its rate, so scale and bias cannot be '
                          'separated: turn both ways, with stops')
    scale, offset = np.linalg.solve(matrix, vector).tolist()
    return ScaleBiasFit(1.0 / scale - 1.0, -offset / scale, np.full((2, 2), np.nan))


METHODS = {'likelihood': fit_likelihood, 'heading': fit_heading, 'rate': fit_rate}


def self_calibrate(time: Array, rate: Array, motion: Motion, method: str = 'likelihood',
                   limits: RunLimits = RunLimits(), noise: Noise = Noise(),
                   reference: ReferenceErrors | None = None, output: Array | None = None,
                   prior: Array | None = None) -> ScaleBiasFit:
    """
    Fit a run by one of `METHODS` and refuse one that is not credible.

    The reference has by default `default_reference_errors`. The prior are standard deviations of
    (s, b) about zero before the run, as `GyroModel.prior_deviations` of a fleet, shape (2,).
    """
    reference = default_reference_errors(motion) if reference is None else reference
    refuse_samples(time, rate, limits, output)
    refuse_saturated(rate if output is None else output)
    run = split_run(time, rate, motion)
    _refuse_run(time, run, motion, limits)
    if method == 'likelihood':
        fit = _fit_likelihood(time, rate, motion, limits.max_time_offset,
                              reference.scale_deviation)
    else:
        fit = METHODS[method](time, rate, motion)
    # whether s and b are those of the output itself, for which it is its own reference
    values = np.array([fit.scale_factor_error, fit.bias])
    is_own = (np.isfinite(fit.covariance).all() and chdtrc(
        2.0, values @ np.linalg.solve(fit.covariance, values)) > MIN_FIT_PROBABILITY)
    # not observable: wander of the bias, errors of the reference, the slip that all turns have;
    # the rms of slips between zero and a largest one is twice their standard deviation
    scale = 1.0 + fit.scale_factor_error
    unobservable = np.diag(
        [(scale * max(reference.scale_deviation, 2.0 * fit.slip_deviation)) ** 2,
         noise.allan_floor ** 2 + (scale * reference.rate_deviation) ** 2])
    of_steps, rounding = rounding_covariance(time, rate if output is None else output, fit)
    goodness = None
    if noise.angle_random_walk and fit.dof:
        # the residual against the known noise of means over neighbouring blocks
        block = float(np.median(np.diff(fit.influence[:, 2])))
        known = noise.allan_variance(block) * block + (scale * reference.random_walk) ** 2
        chi_square = fit.residual_squares / known
        goodness = GoodnessOfFit(chi_square, fit.dof, float(chdtrc(fit.dof, chi_square)),
                                 fit.angle_random_walk / math.sqrt(known))
    fit = replace(fit, covariance=fit.covariance + unobservable + of_steps,
                  rounding_variance=rounding, goodness=goodness)
    if prior is not None and np.isfinite(fit.covariance).all():
        shrinkage = np.linalg.inv(np.eye(2) + fit.covariance / prior[:, None] ** 2)
        s, b = (shrinkage.T @ (fit.scale_factor_error, fit.bias)).tolist()
        fit = replace(fit, scale_factor_error=s, bias=b, covariance=fit.covariance @ shrinkage)
    white_noise = white_noise_deviation(rate) * math.sqrt(float(np.median(np.diff(time))))
    _refuse_fit(fit, motion, limits, white_noise)
    # that of the quietest samples may be vibration, which both follow, but then s and b are not 0
    quiet = [each for part in np.array_split(rate, 10) if (each := white_noise_deviation(part))]
    known = noise.angle_random_walk or is_own * min(quiet, default=0.0) * math.sqrt(
        float(np.median(np.diff(time))))
    _refuse_copied_noise(fit, min(known, white_noise))
    return fit


def _refuse_copied_noise(fit: ScaleBiasFit, white_noise: float) -> None:
    """Refuse a reference that follows the white noise of the gyro, rad/√s, by likelihood ratio."""
    if white_noise and fit.dof:
        likelihood, variance, dof = fit.noise_profile.T
        share = np.minimum(variance / white_noise ** 2, 1.0)
        with_noise = likelihood - 0.5 * dof * (share - 1.0 - np.log(share))
        if chdtrc(1.0, 2.0 * (likelihood.max() - with_noise.max())) < MIN_FIT_PROBABILITY:
            raise DataRefused(
                'the reference is computed from this gyro, since they differ by '
                f'{math.sqrt(share[likelihood.argmax()]):.2f} times the noise of the '
                'gyro: give a reference without it, such as odometry of the wheels')


@dataclass(frozen=True)
class _OutputRounding:
    """
    The errors of means over blocks of five samples by the steps of an output.

    Blocks on one step, as all rests, have one error, which is no noise of a fit.
    """

    block: NDArray[np.intp]  # of each sample, shape (n,)
    mean: Array  # of each block, rad/s, shape (m,)
    code: NDArray[np.intp]  # number of the step of each block, shape (m,)
    # standard deviation of the error of each mean, rad/s, (m,); 0 where noise averages it out
    deviation: Array

    def covariance(self, weights: Array, are_one: bool = False) -> Array:
        """
        Return the covariance of sums of samples with weights, (k, n), shape (k, k).

        The errors on different steps are independent, or one, as at rates of whole steps.
        """
        sums = np.array([np.bincount(self.code, self.deviation * np.bincount(self.block, each))
                         for each in weights])
        if are_one:
            sums = sums.sum(axis=1, keepdims=True)
        return np.asarray(sums @ sums.T)


def find_rounding(time: Array, output: Array, step: float) -> _OutputRounding | None:
    """Return the errors by the steps of an output; None without a step, or beside more noise."""
    if not step:
        return None
    length = 5.0 * float(np.median(np.diff(time)))
    block = np.unique(np.floor((time - time[0]) / length), return_inverse=True)[1]
    count = np.bincount(block)
    mean = np.bincount(block, output) / count
    code = np.unique(np.rint(mean / step), return_inverse=True)[1]
    of_code = code[block]
    variance = np.bincount(of_code, (output - mean[block]) ** 2) / np.bincount(of_code)
    deviation = np.where(variance <= 0.25 * step ** 2, step / math.sqrt(12.0), 0.0)[code]
    return _OutputRounding(block, mean, code, deviation) if deviation.any() else None


def rounding_covariance(time: Array, output: Array, fit: ScaleBiasFit,
                        are_one: bool = False) -> tuple[Array, float]:
    """Return the covariance of (s, b) by steps, (2, 2), and the variance at rest, (rad/s)²."""
    if (found := find_rounding(time, output, quantization_step(output))) is None:
        return np.zeros((2, 2)), 0.0
    rate = (found.mean - fit.bias) / (1.0 + fit.scale_factor_error)
    root = np.sqrt(np.bincount(found.block))[:, None]
    weights = np.linalg.pinv(root * np.column_stack([rate, np.ones(len(rate))])) / root.T
    slowest = np.where(found.deviation > 0.0, np.abs(rate), math.inf).argmin()
    return (found.covariance(weights[:, found.block], are_one),
            float(found.deviation[slowest] ** 2))


def _fit_likelihood(time: Array, rate: Array, motion: Motion, largest_time_offset: float,
                    slip_deviation: float) -> ScaleBiasFit:
    """Fit, and allow for an asymmetry of the gyro against a measured motion."""
    fit = fit_likelihood(time, rate, motion, largest_time_offset, slip_deviation=slip_deviation)
    if not motion.is_measured:
        return fit
    # Against a profile the fit includes a scale difference between both senses of turning. Such an
    # error is proportional to the absolute rate; the part of that which is proportional to the
    # rate, or constant, is indistinguishable from scale factor error and bias.
    columns = np.column_stack([rate, np.ones(len(rate))])
    absorbed = np.linalg.lstsq(columns, np.abs(rate), rcond=None)[0]
    return replace(
        fit, covariance=fit.covariance + ASYMMETRY_DEVIATION ** 2 * np.outer(absorbed, absorbed))


def refuse_samples(time: Array, rate: Array, limits: RunLimits, output: Array | None) -> None:
    """Refuse samples that are too few, no numbers, too far apart, or of a dead gyro."""
    if len(time) < limits.min_samples:
        raise DataRefused(f'only {len(time)} samples came; at least {limits.min_samples} are '
                          "needed: check the gyro's line and rate")
    if not np.isfinite(rate).all():
        raise DataRefused(f'{np.sum(~np.isfinite(rate))} samples are not a finite number: '
                          'leave them out, or repair the line')
    gap = float(np.diff(time).max())
    if gap > limits.max_gap:
        raise DataRefused(f'no samples came for {gap:.2f} s; at most {limits.max_gap:g} s may be '
                          'missing: repair the line and run again')
    refuse_dead(rate if output is None else output)


def refuse_bias(bias: float, limits: RunLimits, remedy: str) -> None:
    """Refuse a bias, rad/s, beyond the limit."""
    if abs(bias) > limits.max_bias:
        raise DataRefused(f'a bias of {bias / DEGREE:.2f} deg/s is beyond '
                          f'{limits.max_bias / DEGREE:g} deg/s: {remedy}')


def refuse_scale(scale_factor_error: float, reference: str, remedy: str) -> None:
    """Refuse a gyro that saw almost none of the reference's turns, or all with the other sign."""
    if abs(1.0 + scale_factor_error) < 0.5:
        raise DataRefused(f'the gyro shows {100 * (1 + scale_factor_error):.0f} % of the '
                          f"{reference}'s turns: "
                          'check that the robot moved, and that the gyro responds')
    if scale_factor_error < -1.5:
        raise DataRefused(f'the gyro turns the other way than the {reference} '
                          f'(scale {1 + scale_factor_error:.2f}): {remedy}')


def refuse_uncertain_scale(deviation: float, limits: RunLimits, more: str = '') -> None:
    """Refuse a scale factor error whose standard deviation is beyond the limit."""
    if deviation > limits.max_scale_deviation:
        raise DataRefused(f'the scale factor error is known to {100 * deviation:.1f} % only, '
                          f'wanted {100 * limits.max_scale_deviation:g} %: turn further, faster, '
                          f'or more often{more}')


def refuse_one_speed(motion: Motion, limits: RunLimits) -> None:
    """Refuse a motion whose rate varies too little to separate scale and bias."""
    # over whole periods of a swing it does not turn: two lengths, s, of which few are multiples
    steps = (min(step, 0.25 * motion.duration) for step in (0.5, 0.3))
    spread, mean = max((float(np.std(rates)), abs(float(np.mean(rates)))) for rates in (
        np.diff(motion.heading_at(np.arange(0.0, motion.duration, step))) / step
        for step in steps))
    if spread < limits.min_rate_spread:
        turns = 'does not turn' if mean < limits.min_rate_spread else 'turns at one speed'
        raise DataRefused(f'the {motion.name} {turns} (its rate varies by '
                          f'{spread / DEGREE:.2f} deg/s), so scale and bias cannot be separated: '
                          'turn in both senses, or at another speed too, or with a rest')


def _refuse_run(time: Array, run: RunPieces, motion: Motion, limits: RunLimits) -> None:
    """Refuse a run that is not the whole profile, another unit or sign, or one speed alone."""
    if not np.isfinite(motion.heading).all():
        raise DataRefused('the reference heading has points without a value: '
                          'leave them out, or run again')
    covered = float(time[-1] - time[0])
    if covered < 0.9 * motion.duration - 2.0 * limits.max_time_offset:
        raise DataRefused(f"the samples cover {covered:.1f} s of the {motion.name}'s "
                          f'{motion.duration:.1f} s: record the whole motion')
    largest_offset = limits.max_time_offset + MAX_TRACKING_LAG
    unexplained, scale, _ = fit_profile(run, motion, largest_offset)
    if unexplained <= MAX_UNEXPLAINED_SHARE:
        refuse_unit_error(scale, motion.name)
        refuse_scale(scale - 1.0, motion.name,
                     "give or omit --invert, or set the driver's parameter invert")
    refuse_one_speed(motion, limits)
    if unexplained > MAX_UNEXPLAINED_SHARE:
        if np.std(run.gyro_angle) < 0.1 * np.std(run.reference_angle(motion)):
            refuse_scale(scale - 1.0, motion.name, '')
        refuse_other_motion(run, motion, largest_offset)


def _refuse_fit(fit: ScaleBiasFit, motion: Motion, limits: RunLimits, white_noise: float) -> None:
    """Refuse by the first cause found, in the order in which they spoil later checks."""
    excess_angle, sigmas = fit.stretch_residual
    s = fit.scale_factor_error
    deviation = float(np.nan_to_num(math.sqrt(fit.covariance[0, 0])))
    if excess_angle > limits.max_stretch_residual and sigmas > _MIN_SLIP_SIGMAS:
        raise DataRefused(format_slip(motion, excess_angle, fit.stretch_interval[0], sigmas))
    if abs(fit.time_offset) > limits.max_time_offset + MAX_TRACKING_LAG:
        side = 'behind' if fit.time_offset > 0.0 else 'ahead of'
        raise DataRefused(f'the gyro is {abs(fit.time_offset):.2f} s {side} the {motion.name}: '
                          f'begin with it, or correct the time of the {motion.name}')
    if abs(s) > limits.max_scale_factor_error and deviation <= limits.max_scale_deviation:
        raise DataRefused(f'a scale factor error of {100 * s:.0f} % is beyond '
                          f'{100 * limits.max_scale_factor_error:.0f} %: check the sensitivity '
                          f'and the unit of the {motion.name}')
    refuse_bias(fit.bias, limits, 'do not turn the robot by hand')
    refuse_uncertain_scale(deviation, limits, ', and check that the profile is the one that was '
                           'driven' if motion.name == 'profile' else '')
    # the noise of mount and encoder deviates too; a wobble does not accumulate in the heading
    noise_ratio = (fit.goodness.noise_ratio if fit.goodness
                   else fit.angle_random_walk / max(white_noise, 1e-300))
    if (not motion.is_measured and fit.heading_difference > limits.max_unexplained_angle
            and noise_ratio > limits.max_noise_ratio):
        known = 'the model states' if fit.goodness else 'its samples show'
        raise DataRefused(f'the run is {noise_ratio:.1f} times as noisy as {known}, at most '
                          f'{limits.max_noise_ratio:g} are allowed: check that the robot follows '
                          f'the {motion.name}, fasten the gyro, stop vibration, or measure the '
                          'noise again (allan)')
    # the heading after a drive with a whole turn, by its own covariance and without a calibration
    error_with = math.sqrt(
        (fit.covariance[1, 1] * DRIVE_DURATION + 2.0 * fit.covariance[0, 1] * math.tau)
        * DRIVE_DURATION + fit.covariance[0, 0] * math.tau ** 2)
    error_without = math.hypot(fit.bias * DRIVE_DURATION, s * math.tau)
    if error_with > max(limits.max_heading_error, error_without):
        variance = float(fit.covariance[1, 1])
        cause = (', by the steps of its output,' if fit.rounding_variance > 0.5 * variance else
                 f', beside headings with a noise of {fit.reference_noise / DEGREE:.2g} deg,'
                 if motion.is_measured else ',')
        raise DataRefused(f'the bias is known to {math.sqrt(variance) / DEGREE:.3f} '
                          f'deg/s only{cause} which lets a heading drift by '
                          f'{error_with / DEGREE:.0f} deg in five minutes; without the '
                          f'calibration it is {error_without / DEGREE:.0f} deg: turn more slowly, '
                          'with rests, or for longer')


def describe_implausible_scale(fit: ScaleBiasFit, prior_deviation: float, reference: str) -> str:
    """Return a remark on a scale factor error beyond what such gyros have, or ''."""
    size = 100.0 * fit.scale_factor_error
    sigmas = abs(fit.scale_factor_error) / math.hypot(
        prior_deviation, float(np.nan_to_num(math.sqrt(fit.covariance[0, 0]))))
    if 2.0 * float(ndtr(-sigmas)) > MIN_FIT_PROBABILITY:
        return ''
    return (f'a scale factor error of {size:.1f} % is {sigmas:.0f} standard deviations from what '
            f'such gyros have, about {100.0 * prior_deviation:g} %: compare the turn of the '
            f'{reference} with a mark on the floor (calibrate by whole turns), and check radius '
            'and track of the wheels, or the sensitivity of the gyro')


def describe_commanded_headings(motion: Motion) -> str:
    """Return a remark on headings of a profile that may have been measured, or ''."""
    if motion.is_measured or motion.rate is not None:
        return ''
    return ('the headings of the profile are taken as commanded, which wheels follow with a lag '
            'and slip; the column of measured headings is reference_heading_deg')


@dataclass(frozen=True)
class RestCheck:
    """The result of a rest after a run."""

    rate: float  # mean of the corrected rate, rad/s
    deviation: float  # its standard deviation by noise, calibration and wander, rad/s
    limit: float  # largest mean that is accepted, rad/s
    fit: ScaleBiasFit  # the calibration, with its bias updated by the rest


def check_rest(time: Array, rate: Array, fit: ScaleBiasFit, noise: Noise = Noise(),
               limits: RunLimits = RunLimits()) -> RestCheck:
    """
    Check a calibration by a rest after its run, and refuse it if the gyro still drifts.

    The rest lasts at least 75 % of the length in the limits. Without a known noise its white noise
    is taken from the samples.
    """
    duration = float(time[-1] - time[0]) if len(time) > 1 else 0.0
    if duration < 0.75 * limits.rest_duration or len(time) < 10:
        raise DataRefused(f'after the run {duration:.1f} s of rest came, '
                          f'wanted {limits.rest_duration:g} s: leave the robot at rest after it')
    corrected = (rate - fit.bias) / (1.0 + fit.scale_factor_error)
    white_deviation, mean = _deviation_of_mean(corrected), float(corrected.mean())
    half_difference = _half_difference(corrected)
    variance = (rest_variance(noise, duration, white_deviation, half_difference)
                + fit.rounding_variance / (1.0 + fit.scale_factor_error) ** 2)
    deviation = math.sqrt(variance + float(np.nan_to_num(fit.covariance[1, 1])))
    scale, updated = 1.0 + fit.scale_factor_error, fit
    if np.isfinite(fit.covariance).all():
        updated = _add_rest(fit, scale * mean, scale ** 2 * variance)
    # one good calibration in a thousand is refused, if the noise is as given
    check = RestCheck(mean, deviation, max(limits.max_rest_rate,
                                           -float(ndtri(0.5e-3)) * deviation), updated)
    if half_difference > 2.0 * max(MAX_NOISE_SIGMAS * white_deviation, _MIN_DRIVING_RATE_CHANGE):
        raise DataRefused('after the run the robot still moved, its rate changed by '
                          f'{half_difference / DEGREE:.2f} deg/s: leave it at rest after the run')
    if abs(check.rate) > check.limit:
        raise DataRefused('after the run, at rest, the corrected rate is '
                          f'{check.rate / DEGREE:.4f} deg/s, limit '
                          f'{check.limit / DEGREE:.4f} deg/s: the robot still turned, or '
                          'the run was disturbed; run again and leave it at rest')
    return check


def check_end(time: Array, rate: Array, fit: ScaleBiasFit, motion: Motion,
              noise: Noise = Noise()) -> ScaleBiasFit:
    """
    Return a calibration by a profile whose log has too short a rest after it for `check_rest`.

    A steady turn throughout a run has the effect of a bias, which the samples after the motion
    show. A turn that they do not show, of a prior deviation `EXCESS_RATE_DEVIATION`, is in the
    standard deviation of the bias, and so is all that they show of a robot that may settle yet, in
    the part up to the end of the log that determines the rate best. The fit is returned unchanged
    of a measured reference, and where fewer than 10 samples follow or the robot drives on. It is
    refused where the robot turned throughout the motion, or goes on turning after it.
    """
    limits = RunLimits()
    end = motion.duration + max(fit.time_offset, 0.0)
    duration = float(time[-1]) - end
    if (motion.is_measured or motion.rate is not None and motion.rate[-1] != 0.0
            or motion.name != 'profile'
            or not np.isfinite(fit.covariance).all() or np.count_nonzero(time > end) < 10
            or duration > SETTLING_TIME + 0.9 * limits.rest_duration):
        return fit
    stop = float(motion.time[np.flatnonzero(np.diff(motion.heading))[-1] + 1])
    settles = motion.duration - stop < SETTLING_TIME
    found = []
    for begin in np.arange(end, time[-1], 0.25).tolist() if settles else [end]:
        if len(rest := rate[time > begin]) >= 10:
            found.append((fit.rounding_variance + rest_variance(
                noise, float(time[-1]) - begin, _deviation_of_mean(rest), _half_difference(rest)),
                float(rest.mean()) - fit.bias))
    variance, change = min(found)
    sigmas = abs(change) / math.sqrt(fit.covariance[1, 1] + variance)
    if settles:  # the change may be that of a settling robot
        change, variance = 0.0, variance + change ** 2
    elif sigmas > _MIN_SLIP_SIGMAS:
        raise DataRefused(
            f'after the run the corrected rate is {change / DEGREE:.3f} deg/s ({sigmas:.0f} '
            'standard deviations): the robot turned throughout the run, or still turned after '
            'it; run again and leave it at rest for '
            f'{SETTLING_TIME + limits.rest_duration:g} s after it')
    fit = _add_rest(fit, change, variance)
    unseen = 1.0 / (1.0 / variance + 1.0 / EXCESS_RATE_DEVIATION ** 2)
    return replace(fit, covariance=fit.covariance + np.diag([0.0, unseen]))


def _add_rest(fit: ScaleBiasFit, change: float, variance: float) -> ScaleBiasFit:
    """Return a calibration with a mean at rest less its bias, rad/s, and the variance of that."""
    gain, covariance = combine_with_rest(fit.covariance, change, variance)
    s, b = (gain * change + (fit.scale_factor_error, fit.bias)).tolist()
    # run and rest may be on the same place of a step
    covariance[1, 1] = max(covariance[1, 1], fit.rounding_variance)
    return replace(fit, scale_factor_error=s, bias=b, covariance=covariance)


def rest_variance(noise: Noise, duration: float, white_deviation: float,
                  half_difference: float) -> float:
    """
    Return the variance of a mean at rest about the bias, (rad/s)².

    Given are the duration, s, the deviation of the mean by the white noise of the samples, and by
    how much the means of both halves differ, rad/s: a robot that settles moves the mean by half.
    """
    return (max(white_deviation, noise.angle_random_walk / math.sqrt(duration)) ** 2
            + float(noise.mean_change_variance(duration, duration)) + 0.25 * half_difference ** 2)


def combine_with_rest(covariance: Array, rate: float, variance: float) -> tuple[Array, Array]:
    """
    Return derivatives of (s, b) by the rate at rest, shape (2,), and their covariance, (2, 2).

    The rate is the mean of the output at rest less the bias of the run, rad/s, with the variance
    of that mean. A run as stated and one that errs by more (a slip, a turn by hand) have even
    odds; the ratio of its error to the stated deviation has a half-Cauchy prior of median 1.
    """
    stated_variance, run = covariance[1, 1], covariance[:, 1]
    ratios = np.append(0.0, np.tan(0.5 * math.pi * (np.arange(100) + 0.5) / 100))
    total = (1.0 + ratios ** 2) * stated_variance + variance
    weights = np.exp(-0.5 * rate ** 2 / total) / np.sqrt(total)
    weights[1:] /= len(weights) - 1
    weights /= weights.sum()
    shared = run + np.outer(ratios ** 2 * stated_variance, (0.0, 1.0))
    gains = shared / total[:, None]
    # the form of Joseph, which rounding does not make negative
    kept = np.eye(2) - np.einsum('ki,j->kij', gains, (0.0, 1.0))
    priors = (covariance
              + np.einsum('k,ij->kij', ratios ** 2 * stated_variance, np.diag([0.0, 1.0])))
    within = (np.einsum('k,kia,kab,kjb->ij', weights, kept, priors, kept)
              + variance * (weights[:, None] * gains).T @ gains)
    return weights @ gains, within + rate ** 2 * np.cov(gains.T, aweights=weights, ddof=0)


def find_rest_after(time: Array, rate: Array, fit: ScaleBiasFit, motion: Motion,
                    limits: RunLimits = RunLimits()) -> slice | None:
    """
    Return the samples of the rest after a run, from `SETTLING_TIME` s after the motion on.

    It begins later where the robot still moves, and is at most as long as the motion. None where
    the log ends before, or the robot drives on.
    """
    begin = motion.duration + max(fit.time_offset, 0.0) + SETTLING_TIME
    latest = max(min(float(time[-1]) - limits.rest_duration, begin + motion.duration), begin)
    begins = np.arange(begin, latest + 1e-9, 0.25)
    corrected = (rate - fit.bias) / (1.0 + fit.scale_factor_error)
    windows = [slice(*np.searchsorted(time, [each, each + limits.rest_duration]).tolist())
               for each in begins]
    if windows[0].stop - windows[0].start < 10 or time[-1] < begin + 0.9 * limits.rest_duration:
        return None
    # the standard deviation of a difference of halves is twice that of the mean
    relative_changes = np.array([_half_difference(corrected[each])
                                 / max(2.0 * _deviation_of_mean(corrected[each]), 1e-300)
                                 for each in windows])
    allowed_starts = np.flatnonzero(begins <= begin + limits.rest_duration)
    first = next((each for each in allowed_starts.tolist() if relative_changes[each] < 2.0),
                 int(allowed_starts[-1]))
    means = np.array([part.mean() for part in np.array_split(corrected[windows[first]], 4)])
    max_rate_change = max(MAX_NOISE_SIGMAS * 2.0 * _deviation_of_mean(corrected[windows[first]]),
                          _MIN_DRIVING_RATE_CHANGE)
    # a slow and steady turn is no drive: the fit took it as a bias
    if abs(means.mean()) > limits.max_bias or np.ptp(means) > 2.0 * max_rate_change:
        return None
    moving = first + 1 + np.flatnonzero(relative_changes[first + 1:] > 4.0)
    last = windows[int(moving[0])].start if len(moving) else windows[-1].stop
    return slice(windows[first].start, max(last, windows[first].stop))


def _half_difference(rate: Array) -> float:
    """Return the difference between the means of the halves of a rest, rad/s."""
    begun, ended = (float(half.mean()) for half in np.array_split(rate, 2))
    return abs(ended - begun)


def _deviation_of_mean(rate: Array) -> float:
    """Return the standard deviation of a mean at rest by white noise, rad/s."""
    return white_noise_deviation(rate, 1) / math.sqrt(len(rate))


def calibrate_bias(time: Array, rate: Array, limits: RunLimits = RunLimits(),
                   noise: Noise = Noise(), output: Array | None = None) -> tuple[float, float]:
    """
    Return the bias of a gyro at rest, with the Earth's rate, and its standard deviation, rad/s.

    See Ojeda et al., eq. 1, or 15 for compensated rates. A slow and steady turn looks like a bias.
    """
    refuse_samples(time, rate, limits, output)
    parts = np.array_split(rate, 10)
    blocks = np.array([part.mean() for part in parts])
    within = math.sqrt(np.mean([part.var(ddof=1) for part in parts]) / (len(rate) / 10))
    # each mean against their median, and the mean of those after each block against that before
    first, sums = np.arange(1, 10), np.cumsum(blocks)
    last = 10 - first
    changes = np.abs(np.concatenate([blocks - np.median(blocks),
                                     (sums[-1] - sums[:-1]) / last - sums[:-1] / first]))
    deviations = within * np.sqrt(np.concatenate([np.ones(10), 1.0 / first + 1.0 / last]))
    significant_changes = (
        changes[changes > np.maximum(MAX_NOISE_SIGMAS * deviations, 0.05 * DEGREE)])
    if len(significant_changes):
        raise DataRefused('the gyro was moved: its mean changed by '
                          f'{significant_changes.max() / DEGREE:.2f} '
                          'deg/s within the rest; keep it still and run again')
    # the standard deviation of ten blocks may by chance be half of the true one
    mean_variance = max(blocks.var(ddof=1) / 10.0,
                        noise.angle_random_walk ** 2 / float(time[-1] - time[0]))
    bias = float(rate.mean())
    refuse_bias(bias, limits, 'the gyro turns, or is broken')
    expected = math.sqrt(noise.rate_variance(float(np.median(np.diff(time)))))
    if expected and rate.std() > 3.0 * expected:
        raise DataRefused(f'the rate varies by {rate.std() / DEGREE:.2f} deg/s where rest gives '
                          f'{expected / DEGREE:.2f} deg/s: '
                          'stop the robot and its motors, and run again')
    return bias, math.sqrt(mean_variance + noise.allan_floor ** 2)


def to_model_record(fit: ScaleBiasFit, method: str, time: str,
                    temperature: float | None) -> SelfCalibration:
    """Return the record of a fit that a model keeps."""
    (a, b), (_, c) = fit.covariance.tolist()
    covariance = None if math.isnan(a) else ((a, b), (b, c))
    return SelfCalibration(fit.scale_factor_error, fit.bias, covariance, time, temperature, method)
