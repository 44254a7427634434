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
A motion that follows its reference rate with dynamics of its own, as a robot follows its command.

Its delay, lag and overshoot are those of the drives, not of the gyro. They are fitted as a linear
response of any shape, and the log is then diagnosed against the motion that follows, without what
any other such response would explain. A delay, a lag or a clock rate of the gyro cannot be known
then, and neither can a slip.
"""

from collections.abc import Sequence
from dataclasses import replace
import math
from typing import NamedTuple

from gyro_calibration.calibration.heading_regression import MIN_STRETCHES
from gyro_calibration.calibration.reference_noise import MAX_GYRO_LAG
from gyro_calibration.calibration.spans import HEADING_TREATMENT
from gyro_calibration.diagnosis.candidates import effect_candidate
from gyro_calibration.diagnosis.causes import CAUSES, value_finding
from gyro_calibration.diagnosis.extended_model import drop_samples
from gyro_calibration.diagnosis.findings import Finding
from gyro_calibration.diagnosis.regression import (
    build_problem, fit_causes, likelihood_with, RegressionFit)
from gyro_calibration.diagnosis.replay import (
    cosine_transform, kernel_lags, LEAD, LONGEST_LAG, Replay, response_kernels)
from gyro_calibration.logs.log import Array, DataRefused
from gyro_calibration.logs.quality import white_noise_deviation
import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.optimize import minimize
from scipy.signal import oaconvolve

#: Causes that cannot be told from the dynamics of a motion, which may also vibrate.
HIDDEN_CAUSES = frozenset({
    'clock_rate', 'interference_tone',
    *(name for name, cause in CAUSES.items() if cause.along == 'rate_change')})
#: Effects of the gyro along the motion, linear in their sizes.
_MOTION_EFFECTS = ('scale_factor_asymmetry', 'quadratic_nonlinearity', 'cubic_nonlinearity',
                   'heading_sensitivity')
#: Least variance of a response by its prior, over that by the noise.
_MIN_RATIO = 0.01


def is_late(fit: RegressionFit) -> bool:
    """
    Tell whether the output is later than the reference rate of logs by more than a gyro would be.

    By the likelihood under the noises of the logs: a random walk of the bias turns the output by
    far more than a delay does.
    """
    def likelihood(*lags: float) -> float:
        return max(likelihood_with(fit, effect_candidate('time_offset', each)) for each in lags)

    of_gyro = max(fit.log_likelihood, likelihood(
        *np.linspace(0.0, MAX_GYRO_LAG, 5)[1:].tolist()))
    return likelihood(*np.geomspace(MAX_GYRO_LAG, LONGEST_LAG, 20)[1:].tolist()
                      ) > of_gyro - math.log(0.05)


def follows_rate(replays: Sequence[Replay]) -> bool:
    """Tell whether the reference of logs is a rate whose changes show how a motion follows it."""
    return all('reference_rate' in each.available_channels
               and np.count_nonzero(np.diff(each.channels.rate)) >= MIN_STRETCHES
               for each in replays)


def follow_reference(replays: Sequence[Replay]) -> tuple[tuple[Replay, ...], list[Finding]]:
    """
    Return logs with the motion that follows their reference rate, and the finding of its lag.

    There is none if the lag may be 0. Raises `DataRefused` where no scale factor error can be
    known beside the response.
    """
    followed, lags, deviations, limits = zip(*map(_follow, replays))
    weights = np.array(deviations) ** -2
    mean, deviation = float(np.average(lags, weights=weights)), float(weights.sum() ** -0.5)
    away, towards = np.median(limits, axis=0).tolist()
    limited = (f', accelerates by at most {away:.3g} rad/s² and slows down by at most '
               f'{towards:.3g} rad/s²' if math.isfinite(away + towards) else '')
    found = value_finding(
        'reference_lag', mean, deviation, 0.05,
        evidence=f'the motion is {1e3 * mean:.0f} ms behind the reference rate on average'
        f'{limited}; the output is compared with the motion that follows',
        remedy='use a measured rate or heading as the reference')
    return followed, [] if found is None else [found]


def _follow(replay: Replay) -> tuple[Replay, float, float, Array]:
    """
    Return a log with the motion that follows, its mean delay, s, its deviation, and two limits.

    These are of acceleration away from and towards a rate of 0, rad/s², or inf. The response is
    fitted with effects of the gyro along the motion, and with the noise that a first one leaves.
    """
    kernels, lags = response_kernels(replay.interval), kernel_lags(replay.interval)
    longest = lags[[np.flatnonzero(each)[-1] for each in kernels]]
    kernels = kernels[longest < 0.1 * replay.duration]
    plain = replace(replay, command=replay.channels.rate)
    grid, command = plain.held_command
    limits = _likely_limits(plain)
    slower = _limit_acceleration(command, plain.interval, limits)[grid]
    limited = replace(plain.with_motion(slower - plain.channels.rate), command=slower)
    # at first, and after a hole, the motion follows commands that are not in the log
    time = plain.channels.time
    known = time[np.isfinite(plain.reference)]
    begins = np.append(time[0], known[1:][np.diff(known) > LEAD + plain.interval])
    unknown = time - begins[np.searchsorted(begins, time, 'right') - 1] < longest[len(kernels) - 1]
    tried = [drop_samples(each, unknown) for each in (plain, limited)]
    # of command, delayed commands, and residual
    transforms = [np.array([cosine_transform(each.resample(values)) for values in (
        each.channels.rate, *each.delayed_commands(kernels),
        each.channels.output - each.reference)]) for each in tried]
    fits = [_fit_response(each, 1, kernels @ lags) for each in transforms]
    # Two limits have to be worth their number (Schwarz), by as many independent errors as there
    # are changes of the command: most errors are after these, and by their time between samples.
    share = min(1.0, np.count_nonzero(np.diff(command)) / len(command))
    chosen = int(share * (fits[0].criterion - fits[1].criterion) > 2.0 * math.log(len(command)))
    moved, (rate, *seen) = tried[chosen], transforms[chosen]
    late = moved
    between: Array = np.zeros(len(time))
    fitted, others = fits[chosen], list[Array]()
    for _ in range(2):
        if others:
            motion, *own = (cosine_transform(late.resample(each)) for each in (
                moved.channels.rate, *others))
            # what an effect has in common with the motion would pass for a part of it
            own = [rate, *(each - motion * (motion @ each) / (motion @ motion) for each in own)]
            seen[-1] -= cosine_transform(late.resample(between))
            fitted = _fit_response(np.array([*own, *seen]) / np.sqrt(moved.response_variance()),
                                   len(own), kernels @ lags)
        response = fitted.values @ kernels
        change = next(late.delayed_commands(response[None])) + between
        # effects along this motion would otherwise pass for a longer response
        moved = replace(late.with_motion(change), responses=fitted.independent @ kernels,
                        response_noise=moved.response_noise)
        fit = fit_causes(build_problem([moved]), [])
        more = _changes_between_samples(moved, response, fit.unbiased_residuals[0] + between)
        if more.any():
            moved = moved.with_motion(more - between)
            between, fit = more, fit_causes(build_problem([moved]), [])
        moved = replace(moved, response_noise=fit.problem.noise_shapes[fit.best_noise])
        others = [column for name in _MOTION_EFFECTS
                  for column in effect_candidate(name).columns(moved)]
    most = 0.5 * HEADING_TREATMENT.prior[0]
    # on average no motion is ahead of its command
    if fitted.scale_deviation > most or response @ lags < -LEAD:
        raise DataRefused(
            'the motion follows its command late, and what it does then has the same effect as a '
            'scale factor error, as in a swing that repeats: turn at several rates for several '
            'seconds each, with rests, or use a measured rate or heading as the reference')
    return (moved, float(response @ lags), fitted.lag_deviation,
            limits if chosen else np.full(2, math.inf))


def _changes_between_samples(replay: Replay, response: Array, left: Array) -> Array:
    """
    Return what is left of the output by changes of the command between samples, rad/s, (n,).

    A change is earlier than the sample that shows it, or is followed after an uneven time. Such
    times are normal, with the likeliest standard deviation, if it is worth its number (Schwarz);
    otherwise, or where the responses to the changes overlap, zeros are returned.
    """
    grid, command = replay.held_command
    lead = -round(kernel_lags(replay.interval)[0] / replay.interval)
    known = replay.valid & np.isfinite(left)
    whole = np.zeros(len(command))
    whole[grid[known]] = left[known]
    noise = white_noise_deviation(left[known])
    alike = oaconvolve(response, response[::-1])[len(response) - 1:]
    sizes = np.diff(command)
    at = np.flatnonzero(np.abs(sizes) * math.sqrt(alike[0]) > noise)
    alike = alike[:np.flatnonzero(np.abs(alike) > _MIN_RATIO * alike[0])[-1] + 1]
    if not 0 < len(at) * len(alike) < len(command):
        return np.zeros(len(left))
    sizes, alike = sizes[at], alike * np.linspace(1.0, 0.0, len(alike), endpoint=False)
    seen = sizes * oaconvolve(whole, response[::-1])[at - lead + len(response) - 1]
    width = int(np.max(np.searchsorted(at, at + len(alike)) - np.arange(len(at))))
    bands = np.zeros((width, len(at)))
    for place, band in enumerate(bands):
        apart = at[place:] - at[:len(at) - place]
        band[:len(apart)] = (np.append(alike, 0.0)[np.minimum(apart, len(alike))]
                             * sizes[place:] * sizes[:len(apart)])
    count, added = np.count_nonzero(known), np.zeros(len(command))
    best = count * math.log(whole @ whole) - math.log(count)
    for deviation in 0.1 * 2.0 ** np.arange(6):  # of the times, in samples
        ratio = (deviation / noise) ** 2
        factor = cholesky_banded(ratio * bands + np.eye(width, 1), lower=True)
        delays = ratio * cho_solve_banded((factor, True), seen)
        impulses = np.zeros(len(command))
        impulses[at] = sizes * delays
        tried = oaconvolve(np.pad(impulses, (len(response) - 1 - lead, lead)), response, 'valid')
        rest = left[known] - tried[grid[known]]
        criterion = (count * math.log(rest @ rest + delays @ delays / ratio)
                     + 2.0 * float(np.log(factor[0]).sum()))
        if criterion < best:
            best, added = criterion, tried
    return np.asarray(added[grid])


def _limit_acceleration(command: Array, interval: float, limits: Array) -> Array:
    """
    Return a rate that follows a command as fast as two limits allow, rad/s, shape (n,).

    The limits, rad/s², are of a rate that grows, and of one that falls towards 0.
    """
    changes = np.flatnonzero(np.diff(command)) + 1
    now = float(command[0])
    times, rates = [0.0], [now]
    for at, end, wanted in zip(changes.tolist(), [*changes[1:].tolist(), len(command)],
                               command[changes].tolist()):
        times.append(at)
        rates.append(now)
        for target, limit in ((sorted([0.0, now, wanted])[1], limits[1]), (wanted, limits[0])):
            steps = abs(target - now) / (limit * interval)
            done = min(steps, end - at)
            now = target if done == steps else now + done / steps * (target - now)
            at += done
            times.append(at)
            rates.append(now)
    return np.interp(np.arange(len(command)), times, rates)


def _likely_limits(replay: Replay) -> Array:
    """
    Return the likeliest limits of acceleration of a motion that follows its command, rad/s².

    They are fitted with a coarse response, and in the part of the log with the most commands.
    """
    grid, command = replay.held_command
    output = np.interp(np.arange(len(command)), grid[replay.valid],
                       replay.channels.output[replay.valid])
    count = min(16384, len(command))
    changes = np.cumsum(np.diff(command, prepend=command[0]) != 0.0)
    begin = int(np.argmax(changes[count - 1:] - changes[:len(changes) - count + 1]))
    command, output = (each[begin:begin + count] for each in (command, output))
    late = np.geomspace(1.0, 2.0 / replay.interval, 24)  # up to 2 s
    lags = np.unique(np.rint([*-late[late * replay.interval < LEAD], 0.0, *late])).astype(int)
    count -= int(np.ptp(lags))
    if count < 2 * len(lags):
        return np.full(2, math.inf)

    def cost(limits: Array) -> float:
        # any response that is linear between lags
        total = np.cumsum(np.cumsum(_limit_acceleration(
            command, replay.interval, np.exp(limits))))
        delayed = np.array([total[lags[-1] - each:][:count] for each in lags])
        columns = np.diff(np.diff(delayed, axis=0) / np.diff(lags)[:, None], axis=0)
        reduced = np.asarray(np.linalg.qr(np.array([
            np.ones(count), *columns, output[lags[-1]:][:count]]).T, mode='r'))
        return 2.0 * count * math.log(abs(float(reduced[-1, -1])) + np.finfo(float).tiny)

    first = min(0.25 * 2.0 ** np.arange(7), key=lambda each: cost(np.log([each, each])))
    best = minimize(cost, np.log([first, first]), method='Nelder-Mead', options={
        'xatol': 0.005, 'fatol': 1.0})
    return np.exp(best.x)


class _Response(NamedTuple):
    """A response to a command, as the sizes of k delayed commands."""

    values: Array  # sizes, shape (k,), of a gain of 1 plus the scale factor error
    # sizes of independent responses of one deviation of the prior, in units of the noise: (m, k)
    independent: Array
    lag_deviation: float  # standard deviation of the mean delay, s
    criterion: float  # -2 times the log-likelihood, but for a constant
    scale_deviation: float  # standard deviation of the scale factor error beside the response


def _fit_response(transforms: Array, own_count: int, lags: Array) -> _Response:
    """
    Return the likeliest response as the sizes of k delayed commands with their mean lags, s.

    The transforms, all with the same white noise, are those of effects, the first of which is the
    commanded rate; of the delayed commands; and of the difference of output and command.

    The prior of the response is a random walk from late to early lags, in a variable that falls
    exponentially with the lag: the response gets smooth and fades (the stable spline of order 1 of
    Pillonetto, Chiuso and De Nicolao, Automatica 47, 2011). Its time constant and size are the
    likeliest. The scale factor error has a prior too.
    """
    reduced = np.asarray(np.linalg.qr(transforms.T, mode='r'))
    count = transforms.shape[1] - own_count
    noise = abs(float(reduced[-1, -1])) / math.sqrt(count - len(lags))
    prior = np.zeros((1, reduced.shape[1]))
    prior[0, 0] = noise / HEADING_TREATMENT.prior[0]
    reduced = np.concatenate([reduced, prior])
    own, delayed, left = np.split(reduced, [own_count, -1], axis=1)
    basis = np.linalg.qr(own)[0]
    free, rest = (each - basis @ (basis.T @ each) for each in (delayed, left[:, 0]))
    total = float(rest @ rest)
    best = None
    for constant in np.geomspace(0.1 * LEAD, LONGEST_LAG, 16):
        steps = -np.diff(np.exp(-(lags + LEAD) / constant), append=0.0)
        walk = np.triu(np.ones((len(lags), len(lags)))) * np.sqrt(steps)
        walk *= np.gradient(lags)[:, None]
        along, powers, vectors = np.linalg.svd(free @ walk, full_matrices=False)
        squares = (along.T @ rest) ** 2
        for size in np.geomspace(1e-2, 1e14, 65) / powers[0] ** 2:
            ratios = size * powers ** 2
            within = total - float(squares @ (ratios / (1.0 + ratios)))
            criterion = count * math.log(within) + float(np.log1p(ratios).sum())
            if best is None or criterion < best[0]:
                independent = math.sqrt(size) * (walk @ vectors.T).T
                sizes = np.sqrt(ratios) / (1.0 + ratios) * (along.T @ rest)
                best = criterion, independent, sizes, ratios, within / count
    assert best is not None
    criterion, independent, sizes, ratios, variance = best
    values = sizes @ independent
    scale = np.linalg.lstsq(own, left[:, 0] - delayed @ values, rcond=None)[0][0]
    deviation = math.sqrt(variance * float(np.sum((independent @ lags) ** 2 / (1.0 + ratios))))
    responses, command = delayed @ independent.T, own[:, 0]
    along_command = responses.T @ command
    left_of_command = float(command @ command - along_command @ np.linalg.solve(
        np.eye(len(along_command)) + responses.T @ responses, along_command))
    scale_deviation = math.sqrt(variance / max(left_of_command, np.finfo(float).tiny))
    powers, vectors = np.linalg.svd(responses, full_matrices=False)[1:]
    return _Response(values / (1.0 + scale), (vectors @ independent)[powers ** 2 > _MIN_RATIO],
                     deviation, criterion, scale_deviation)
