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

"""

from __future__ import annotations

from dataclasses import dataclass, replace
import math

from gyro_calibration.calibration.fit_quality import (
    allow_asymmetry,
    look_slower,
    refuse_repeating,
    refuse_useless,
)
from gyro_calibration.calibration.likelihood import (
    CHANCE,
    Fit,
    fit_likelihood,
    FOLLOWING,
    Goodness,
)
from gyro_calibration.calibration.run_faults import (
    EXPLAINED,
    followed,
    Pieces,
    pieces,
    refuse_robot,
    slip_sentence,
    unit_error,
)
from gyro_calibration.logs.log import Array, DataRefused, DEGREE
from gyro_calibration.logs.quality import refuse_dead, refuse_saturated, white_noise
from gyro_calibration.logs.stamps import even_times
from gyro_calibration.model.gyro_model import SelfCalibration
from gyro_calibration.model.motion import Motion
from gyro_calibration.model.noise import Noise
import numpy as np
from scipy.special import chdtrc, ndtri


@dataclass(frozen=True)
class Limits:
    """
    The limits of a run that is accepted.

    Attributes
    ----------
    samples : minimum number of samples
    gap : longest between samples, s
    rate_spread : smallest standard deviation of the profile's rate, rad/s; one speed does not
        separate scale from bias
    scale_factor_error : largest, 1
    bias : largest, rad/s
    scale_standard_deviation : largest standard deviation of the scale, 1
    residual : largest significant deviation of a stretch of the run from the profile, rad
    time_offset : largest lag of the gyro behind the profile, either way, s
    noise_ratio, unexplained : largest noise that accumulates in the heading, as a multiple of the
        known noise and as its heading error over the run, rad; a run that exceeds both is refused
    rest : length of the check after the run, s
    drift : largest corrected rate at rest after the run, rad/s, unless the noise explains more
    repeating : largest error of the heading that repeats with the motion, rad
    heading : largest error of the heading after five minutes, rad, unless it was larger without
        the calibration (`likelihood` only)

    """

    samples: int = 50
    gap: float = 0.5
    rate_spread: float = 1.0 * DEGREE
    scale_factor_error: float = 0.3
    bias: float = 10.0 * DEGREE
    scale_standard_deviation: float = 0.02
    residual: float = 1.0 * DEGREE
    time_offset: float = 1.0
    noise_ratio: float = 8.0
    unexplained: float = 1.0 * DEGREE
    rest: float = 2.0
    drift: float = 2e-4
    repeating: float = 1.0 * DEGREE
    heading: float = 15.0 * DEGREE


@dataclass(frozen=True)
class Reference:
    """
    The errors of a reference that are not observable in a run; zero for an exact or measured one.

    Attributes
    ----------
    scale_deviation : standard deviation of its scale factor error, 1; of wheels, that of radius
        over track
    rate_deviation : standard deviation of its drift, rad/s
    random_walk : of its heading, rad/√s

    """

    scale_deviation: float = 0.0
    rate_deviation: float = 0.0
    random_walk: float = 0.0


#: Largest slip of wheels that follow commanded rates on a good floor, as a fraction of each turn;
#: equal slip in all turns is indistinguishable from a scale factor error.
_SLIPPING = 0.01


def usual_reference(motion: Motion) -> Reference:
    """Return the usual errors of a reference whose errors are not given: commanded rates slip."""
    commanded = motion.rate is not None
    return Reference(_SLIPPING / math.sqrt(3.0)) if commanded else Reference()


#: Standard deviations from which on a stretch is a slip. With three times the noise of the
#: XV-3500, 6 of 800 good runs exceeded it and 1 deg as well; with its own noise none of 800.
SLIP = 4.5


def fit_heading(time: Array, rate: Array, motion: Motion) -> Fit:
    """
    Fit by Hong and Park's heading reference, unchanged (eq. 4 to 7).

    The rectangle rule of eq. 4 is kept: against a continuous heading it errs by several percent
    where the sampling is slow.

    Parameters
    ----------
    time : s since the start of the motion, shape (n,)
    rate : output of the gyro, rad/s, shape (n,)

    """
    step = np.diff(time)
    g = np.column_stack([np.cumsum(step * rate[:-1]), np.cumsum(step)])
    z = motion.heading_at(time[1:]) - motion.heading_at(time[:1])
    return _fit_inverse(g.T @ g, g.T @ z)


def fit_rate(time: Array, rate: Array, motion: Motion) -> Fit:
    """
    Fit by Hong and Park's rate reference (eq. 8 and 9), with columns in the order of q = [s̄, b̄].

    Parameters
    ----------
    time : s since the start of the motion, shape (n,)
    rate : output of the gyro, rad/s, shape (n,)

    """
    true = motion.rate_at(time)
    g = np.array([[rate @ rate, rate.sum()], [rate.sum(), len(rate)]])
    return _fit_inverse(g, np.array([true @ rate, true.sum()]))


def _fit_inverse(matrix: Array, vector: Array) -> Fit:
    """Solve for s̄ and b̄ of eq. 3, and return them as s and b."""
    if not np.linalg.cond(matrix) < 1e12:
        raise DataRefused('the gyro did not change its rate, so scale and bias cannot be '
                          'separated: turn both ways, with stops')
    scale, offset = np.linalg.solve(matrix, vector).tolist()
    return Fit(1.0 / scale - 1.0, -offset / scale, np.full((2, 2), np.nan))


METHODS = {'likelihood': fit_likelihood, 'heading': fit_heading, 'rate': fit_rate}


def self_calibrate(time: Array, rate: Array, motion: Motion, method: str = 'likelihood',
                   limits: Limits | None = None, noise: Noise | None = None,
                   reference: Reference | None = None, output: Array | None = None,
                   prior: Array | None = None) -> Fit:
    """
    Fit a run by one of `METHODS` and refuse one that is not credible.

    Parameters
    ----------
    time : s since the start of the motion, shape (n,)
    rate : output of the gyro, after its model if it has one, rad/s, shape (n,)
    noise : of the gyro, if it is known; the wander of the bias goes into its standard deviation,
        and the residual is compared with it
    reference : the errors of the motion; goes into the standard deviations. By default a motion of
        rates is driven by wheels that slip by up to 1 % of each turn, one of headings is exact
    output : of the gyro before its model, where that differs, shape (n,); it shows a gyro that is
        dead or at its limit
    prior : standard deviations of (s, b) about zero before the run, as `GyroModel.prior` of a
        fleet, shape (2,); what the run leaves open is drawn to it, in a method that gives a
        covariance

    Raises
    ------
    DataRefused : with the reason and the remedy

    """
    limits = limits or Limits()
    reference = usual_reference(motion) if reference is None else reference
    refuse_samples(time, rate, limits)
    refuse_dead(rate if output is None else output)
    refuse_saturated(rate if output is None else output)
    run = pieces(time, rate)
    _refuse_run(time, run, motion, limits)
    if method == 'likelihood':
        fit = _fit_likelihood(time, rate, motion, limits.time_offset, reference.scale_deviation)
    else:
        fit = METHODS[method](time, rate, motion)
    # errors not observable in a run: wander of the bias, and errors of the reference with the
    # slip that all turns have; the root mean square of slips between zero and a largest one is
    # twice their standard deviation
    scale, floor = 1.0 + fit.scale_factor_error, 0.0 if noise is None else noise.floor
    hidden = np.diag([(scale * max(reference.scale_deviation, 2.0 * fit.slip)) ** 2,
                      floor ** 2 + (scale * reference.rate_deviation) ** 2])
    fit = replace(fit, covariance=fit.covariance + hidden,
                  goodness=_goodness(fit, reference, noise))
    if prior is not None and np.isfinite(fit.covariance).all():
        kept = np.linalg.inv(np.eye(2) + fit.covariance / prior[:, None] ** 2)
        s, b = (kept.T @ (fit.scale_factor_error, fit.bias)).tolist()
        fit = replace(fit, scale_factor_error=s, bias=b, covariance=fit.covariance @ kept)
    _refuse_fit(fit, run, motion, limits)
    return fit


def _fit_likelihood(time: Array, rate: Array, motion: Motion, largest_time_offset: float,
                    slip: float) -> Fit:
    """Fit on the stamps, or on an even grid if that leaves less, and check for slow errors."""
    even = even_times(time)
    jitters = float(np.abs(even - time).max()) > 1e-3 * float(np.median(np.diff(time)))
    fits = [(fit_likelihood(stamps, rate, motion, largest_time_offset, slip=slip), stamps)
            for stamps in ([time, even] if jitters else [time])]
    fit, stamps = min(fits, key=lambda found: np.linalg.det(found[0].covariance))
    return fit if motion.rate is not None else allow_asymmetry(
        look_slower(fit, stamps, rate, motion), rate)


def _goodness(fit: Fit, reference: Reference, noise: Noise | None) -> Goodness | None:
    """Compare the residual with the known noise of means over neighbouring blocks."""
    if noise is None or not noise.angle_random_walk or not fit.freedom:
        return None
    block = float(np.median(np.diff(fit.influence[:, 2])))
    known = (noise.allan_variance(block) * block
             + ((1.0 + fit.scale_factor_error) * reference.random_walk) ** 2)
    chi_square = fit.squares / known
    return Goodness(chi_square, fit.freedom, float(chdtrc(fit.freedom, chi_square)),
                    fit.angle_random_walk / math.sqrt(known))


def refuse_samples(time: Array, rate: Array, limits: Limits) -> None:
    """Refuse samples that are too few, no numbers, or too far apart."""
    if len(time) < limits.samples:
        raise DataRefused(f'only {len(time)} samples came; at least {limits.samples} are needed: '
                          "check the gyro's line and rate")
    if not np.isfinite(rate).all():
        raise DataRefused(f'{np.sum(~np.isfinite(rate))} samples are not a finite number: '
                          'leave them out, or repair the line')
    gap = float(np.diff(time).max())
    if gap > limits.gap:
        raise DataRefused(f'no samples came for {gap:.2f} s; at most {limits.gap:g} s may be '
                          'missing: repair the line and run again')


def refuse_scale(s: float, reference: str, remedy: str) -> None:
    """Refuse a gyro that saw almost none of the reference's turns, or all with the other sign."""
    if abs(1.0 + s) < 0.5:
        raise DataRefused(f"the gyro saw {100 * (1 + s):.0f} % of the {reference}'s turns: "
                          'did the robot move, and does the gyro respond?')
    if s < -1.5:
        raise DataRefused(f'the gyro turns the other way than the {reference} '
                          f'(scale {1 + s:.2f}): {remedy}')


def _refuse_run(time: Array, run: Pieces, motion: Motion, limits: Limits) -> None:
    """Refuse a run that is not the whole profile, another unit or sign, or one speed alone."""
    if not np.isfinite(motion.heading).all():
        raise DataRefused('the reference was lost somewhere in the profile: '
                          'leave those points out, or run again')
    covered = float(time[-1] - time[0])
    if covered < 0.9 * motion.duration - 2.0 * limits.time_offset:
        raise DataRefused(f"the samples cover {covered:.1f} s of the profile's "
                          f'{motion.duration:.1f} s: record the whole motion')
    largest = limits.time_offset + FOLLOWING
    left, scale = followed(run, motion, largest)
    if left <= EXPLAINED:
        unit = unit_error(scale) if abs(scale - 1.0) > limits.scale_factor_error else ''
        if unit:
            raise DataRefused(unit)
        refuse_scale(scale - 1.0, 'profile', "set the driver's parameter invert")
    spread = float(np.std(motion.rate_at(np.arange(0.0, motion.duration, 0.05))))
    if spread < limits.rate_spread:
        raise DataRefused('the profile turns at one speed (its rate varies by '
                          f'{spread / DEGREE:.2f} deg/s): scale and bias cannot be separated; '
                          'turn both ways, with stops')
    if left > EXPLAINED:
        if np.std(run.turned) < 0.1 * np.std(run.headings(motion)):
            refuse_scale(scale - 1.0, 'profile', '')
        refuse_robot(run, motion, largest)


def _refuse_fit(fit: Fit, run: Pieces, motion: Motion, limits: Limits) -> None:
    """Refuse by the first cause found; causes that spoil later checks come first."""
    largest = limits.time_offset + FOLLOWING
    turned, size = fit.residual
    s, b = fit.scale_factor_error, fit.bias
    deviation = float(np.nan_to_num(math.sqrt(fit.covariance[0, 0])))
    slip = slip_sentence(turned, fit.stretch[0], size)
    slipped = turned > limits.residual and size > SLIP
    if slipped or abs(fit.time_offset) > largest or deviation > limits.scale_standard_deviation:
        refuse_robot(run, motion, largest, slip)
    if slipped:
        raise DataRefused(slip)
    if abs(s) > limits.scale_factor_error + 3.0 * deviation:
        raise DataRefused(f'a scale factor error of {100 * s:.0f} % is beyond '
                          f'{100 * limits.scale_factor_error:.0f} %: check the sensitivity and '
                          "at the profile's unit")
    if abs(b) > limits.bias:
        raise DataRefused(f'a bias of {b / DEGREE:.2f} deg/s is beyond '
                          f'{limits.bias / DEGREE:g} deg/s: do not turn the robot by hand')
    if deviation > limits.scale_standard_deviation:
        raise DataRefused(f'the scale factor error is known to {100 * deviation:.1f} % only, '
                          f'wanted {100 * limits.scale_standard_deviation:g} %: turn further, '
                          'faster, or more often, '
                          'and check that the profile is the one that was driven')
    # against measured headings the deviations include the noise of mount and encoder
    unexplained = fit.angle_random_walk * math.sqrt(motion.duration)
    if (motion.rate is not None and fit.goodness is not None and unexplained > limits.unexplained
            and fit.goodness.noise_ratio > limits.noise_ratio):
        raise DataRefused(f'the run is {fit.goodness.noise_ratio:.1f} times as noisy as the model '
                          f'states, at most {limits.noise_ratio:g} are allowed: fasten the '
                          'gyro, stop vibration, or measure the noise again (allan)')
    refuse_repeating(fit, limits.repeating)
    refuse_useless(fit, limits.heading)


@dataclass(frozen=True)
class RestCheck:
    """
    The result of a rest after a run.

    Attributes
    ----------
    rate : mean of the corrected rate, rad/s
    deviation : its standard deviation by noise, calibration and wander, rad/s
    limit : largest mean that is accepted, rad/s
    fit : the calibration, with its bias updated by the rest

    """

    rate: float
    deviation: float
    limit: float
    fit: Fit


def check_rest(time: Array, rate: Array, fit: Fit, noise: Noise | None = None,
               limits: Limits | None = None, false_refusals: float = 1e-3) -> RestCheck:
    """
    Check a calibration by a rest after its run, and refuse it if the gyro still drifts.

    Parameters
    ----------
    time : s, shape (n,); at least 75 % of the length in the limits
    rate : of the gyro as it went into the fit, rad/s, shape (n,)
    fit : which corrects it
    noise : of the gyro, if it is known; else its white noise is taken from the samples
    false_refusals : how often a good calibration is refused, if the noise is as given

    Raises
    ------
    DataRefused : too few samples, motion, or drift

    """
    limits = limits or Limits()
    duration = float(time[-1] - time[0]) if len(time) > 1 else 0.0
    if duration < 0.75 * limits.rest or len(time) < 10:
        raise DataRefused(f'after the run {duration:.1f} s of rest came, '
                          f'wanted {limits.rest:g} s: leave the robot at rest after it')
    corrected = (rate - fit.bias) / (1.0 + fit.scale_factor_error)
    noise, white, mean = noise or Noise(), _deviation_of_mean(corrected), float(corrected.mean())
    change = _change_at_rest(corrected)
    variance = rest_variance(noise, duration, white, change)
    deviation = math.sqrt(variance + float(np.nan_to_num(fit.covariance[1, 1])))
    scale = 1.0 + fit.scale_factor_error
    check = RestCheck(mean, deviation,
                      max(limits.drift, -float(ndtri(0.5 * false_refusals)) * deviation),
                      _with_rest(fit, scale * mean, scale ** 2 * variance))
    if change > 2.0 * max(CHANCE * white, _DRIVING):
        raise DataRefused('after the run the robot still moved, its rate changed by '
                          f'{change / DEGREE:.2f} deg/s: leave it at rest after the run')
    if abs(check.rate) > check.limit:
        raise DataRefused('after the run, at rest, the corrected rate is '
                          f'{check.rate / DEGREE:.4f} deg/s, at most '
                          f'{check.limit / DEGREE:.4f} are explained: the robot still turned, or '
                          'the run was disturbed; run again and leave it at rest')
    return check


def rest_variance(noise: Noise, duration: float, white: float, change: float) -> float:
    """
    Return the variance of a mean at rest about the bias, (rad/s)².

    A robot that settles in the first half of the rest moves the mean by half of the change.

    Parameters
    ----------
    duration : of the rest, s
    white : standard deviation of the mean by the white noise of the samples, rad/s
    change : by how much the means of both halves differ, rad/s

    """
    return (max(white, noise.angle_random_walk / math.sqrt(duration)) ** 2
            + float(noise.wander(duration, duration)) + 0.25 * change ** 2)


def _with_rest(fit: Fit, rate: float, variance: float) -> Fit:
    """Return the fit with its bias updated by a rest after its run, as in `combined_rest`."""
    if not np.isfinite(fit.covariance).all():
        return fit
    gain, covariance = combined_rest(fit.covariance, rate, variance)
    s, b = (gain * rate + (fit.scale_factor_error, fit.bias)).tolist()
    return replace(fit, scale_factor_error=s, bias=b, covariance=covariance)


def combined_rest(covariance: Array, rate: float, variance: float) -> tuple[Array, Array]:
    """
    Combine a run with the rest after it.

    The error of a run may exceed its stated deviation: by a slip, a turn by hand, or another
    response of the robot. That and a run as stated have even odds before the rest is seen. The
    ratio of that error to the stated deviation has a half-Cauchy prior with a median of 1.

    Parameters
    ----------
    covariance : of (s, b) by the run, shape (2, 2)
    rate, variance : mean of the output at rest less the bias of the run, rad/s, and the variance
        of that mean, (rad/s)²

    Returns
    -------
    derivatives of s and b by that rate, shape (2,), and their covariance, shape (2, 2)

    """
    stated, run = covariance[1, 1], covariance[:, 1]
    ratios = np.append(0.0, np.tan(0.5 * math.pi * (np.arange(100) + 0.5) / 100))
    total = (1.0 + ratios ** 2) * stated + variance
    weights = np.exp(-0.5 * rate ** 2 / total) / np.sqrt(total)
    weights[1:] /= len(weights) - 1
    weights /= weights.sum()
    shared = run + np.outer(ratios ** 2 * stated, (0.0, 1.0))
    gains = shared / total[:, None]
    # the form of Joseph, which rounding does not make negative
    kept = np.eye(2) - np.einsum('ki,j->kij', gains, (0.0, 1.0))
    priors = covariance + np.einsum('k,ij->kij', ratios ** 2 * stated, np.diag([0.0, 1.0]))
    within = (np.einsum('k,kia,kab,kjb->ij', weights, kept, priors, kept)
              + variance * (weights[:, None] * gains).T @ gains)
    return weights @ gains, within + rate ** 2 * np.cov(gains.T, aweights=weights, ddof=0)


def rest_after(time: Array, rate: Array, fit: Fit, motion: Motion,
               limits: Limits | None = None) -> slice | None:
    """
    Return the samples of the rest after a run, from `SETTLED` s after the motion on.

    It begins later, by up to its length in the limits, where the robot still moves then, as after
    an overshoot. It lasts until the robot moves, at most as long as the motion did. None where
    the log ends before, or the robot drives on.

    Parameters
    ----------
    time : s since the start of the motion, shape (n,)
    rate : of the gyro as it went into the fit, rad/s, shape (n,)

    """
    limits = limits or Limits()
    begin = motion.duration + max(fit.time_offset, 0.0) + SETTLED
    latest = max(min(float(time[-1]) - limits.rest, begin + motion.duration), begin)
    begins = np.arange(begin, latest + 1e-9, 0.25)
    corrected = (rate - fit.bias) / (1.0 + fit.scale_factor_error)
    windows = [slice(*np.searchsorted(time, [each, each + limits.rest]).tolist())
               for each in begins]
    if windows[0].stop - windows[0].start < 10 or time[-1] < begin + 0.9 * limits.rest:
        return None
    # the standard deviation of a difference of halves is twice that of the mean
    sizes = np.array([_change_at_rest(corrected[each])
                      / max(2.0 * _deviation_of_mean(corrected[each]), 1e-300)
                      for each in windows])
    late = np.flatnonzero(begins <= begin + limits.rest)
    first = next((each for each in late.tolist() if sizes[each] < 2.0), int(late[-1]))
    means = np.array([part.mean() for part in np.array_split(corrected[windows[first]], 4)])
    apart = max(CHANCE * 2.0 * _deviation_of_mean(corrected[windows[first]]), _DRIVING)
    # a slow and steady turn is no drive: the fit took it as a bias
    if abs(means.mean()) > limits.bias or np.ptp(means) > 2.0 * apart:
        return None
    moving = first + 1 + np.flatnonzero(sizes[first + 1:] > 4.0)
    last = windows[int(moving[0])].start if len(moving) else windows[-1].stop
    return slice(windows[first].start, max(last, windows[first].stop))


def _change_at_rest(rate: Array) -> float:
    """Return the difference between the means of the halves of a rest, rad/s."""
    begun, ended = (float(half.mean()) for half in np.array_split(rate, 2))
    return abs(ended - begun)


#: Time after the profile at which a robot is at rest, s; change of the rate within a rest above
#: which the robot is driving, rad/s.
SETTLED, _DRIVING = 1.0, 0.25 * DEGREE


def _deviation_of_mean(rate: Array) -> float:
    """Return the standard deviation of a mean at rest by white noise, rad/s."""
    return white_noise(rate, 1) / math.sqrt(len(rate))


def calibrate_bias(time: Array, rate: Array, limits: Limits | None = None,
                   noise: Noise | None = None, output: Array | None = None) -> tuple[float, float]:
    """
    Return the bias of a gyro at rest and its standard deviation, rad/s.

    See Ojeda et al., eq. 1, or 15 for compensated rates. The mean includes the Earth's rate about
    the axis. A slow and steady turn looks like a bias; only the limit on the bias excludes it.

    Parameters
    ----------
    time : s, shape (n,)
    rate : compensated by the model, rad/s, shape (n,)
    noise : of the gyro, if it is known; it gives the smallest standard deviation of the mean
    output : of the gyro before its model, where that differs, shape (n,); it shows a dead gyro

    Raises
    ------
    DataRefused : too few samples, a dead gyro, motion, or a mean that is no bias

    """
    limits = limits or Limits()
    refuse_samples(time, rate, limits)
    refuse_dead(rate if output is None else output)
    parts = np.array_split(rate, 10)
    blocks = np.array([part.mean() for part in parts])
    within = math.sqrt(np.mean([part.var(ddof=1) for part in parts]) / (len(rate) / 10))
    # each mean against their median, and the mean of those after each block against that before
    first, sums = np.arange(1, 10), np.cumsum(blocks)
    last = 10 - first
    changes = np.abs(np.concatenate([blocks - np.median(blocks),
                                     (sums[-1] - sums[:-1]) / last - sums[:-1] / first]))
    deviations = within * np.sqrt(np.concatenate([np.ones(10), 1.0 / first + 1.0 / last]))
    beyond = changes[changes > np.maximum(CHANCE * deviations, 0.05 * DEGREE)]
    if len(beyond):
        raise DataRefused(f'the gyro was moved: its mean changed by {beyond.max() / DEGREE:.2f} '
                          'deg/s within the rest; keep it still and run again')
    noise = noise or Noise()
    # the standard deviation of ten blocks may by chance be half of the true one
    white = max(blocks.var(ddof=1) / 10.0,
                noise.angle_random_walk ** 2 / float(time[-1] - time[0]))
    bias = float(rate.mean())
    if abs(bias) > limits.bias:
        raise DataRefused(f'a mean of {bias / DEGREE:.2f} deg/s is beyond '
                          f'{limits.bias / DEGREE:g} deg/s: the gyro turns, or is broken')
    expected = math.sqrt(noise.rate_variance(float(np.median(np.diff(time)))))
    if expected and rate.std() > 3.0 * expected:
        raise DataRefused(f'the rate varies by {rate.std() / DEGREE:.2f} deg/s where rest gives '
                          f'{expected / DEGREE:.2f} deg/s: '
                          'stop the robot and its motors, and run again')
    return bias, math.sqrt(white + noise.floor ** 2)


def record(fit: Fit, method: str, time: str, temperature: float | None) -> SelfCalibration:
    """Return the record of a fit that a model keeps."""
    (a, b), (_, c) = fit.covariance.tolist()
    covariance = None if math.isnan(a) else ((a, b), (b, c))
    return SelfCalibration(fit.scale_factor_error, fit.bias, covariance, time, temperature, method)
