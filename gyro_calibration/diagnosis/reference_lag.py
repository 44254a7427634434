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

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math

from gyro_calibration.calibration.heading_regression import MIN_STRETCHES
from gyro_calibration.diagnosis.candidates import effect_candidate
from gyro_calibration.diagnosis.causes import CAUSES, make_finding
from gyro_calibration.diagnosis.extended_model import drop_samples
from gyro_calibration.diagnosis.findings import Estimate, Finding, MIN_PROBABILITY
from gyro_calibration.diagnosis.noisy_reference import MAX_GYRO_LAG
from gyro_calibration.diagnosis.regression import (
    build_problem,
    fit_causes,
    likelihood_with,
    RegressionFit,
)
from gyro_calibration.diagnosis.replay import (
    cosine_transform,
    kernel_lags,
    LONGEST_LAG,
    MIN_RESPONSE_POWER,
    Replay,
    response_kernels,
)
from gyro_calibration.logs.log import Array, NORMAL_QUANTILE_975
import numpy as np
from scipy.stats import norm

#: Causes that cannot be told from the dynamics of a motion, which may also vibrate.
HIDDEN_CAUSES = frozenset({
    'clock_rate', 'interference_tone',
    *(name for name, cause in CAUSES.items() if cause.along == 'rate_change')})
#: Effects of the gyro along the motion, linear in their sizes.
_MOTION_EFFECTS = ('scale_factor_asymmetry', 'quadratic_nonlinearity', 'cubic_nonlinearity',
                   'heading_sensitivity')
#: Longest lag of a motion as a share of the duration of a log.
_MAX_LAG_SHARE = 0.1
#: Number of lags of a gyro that are compared with longer ones, and probability by which those have
#: to be likelier.
_LAGS_OF_GYRO, _LATE_LEVEL = 4, 0.05


@dataclass(frozen=True)
class FollowedReference:
    """A motion that follows its reference, and what is reported of it."""

    replays: tuple[Replay, ...]  # the logs, with the motion that follows as the reference
    lag: Estimate  # mean delay of the motion, s

    def finding(self) -> Finding:
        """Return the finding of the lag."""
        return make_finding(
            'reference_lag', {'reference_lag': self.lag},
            max(float(2.0 * norm.sf(abs(self.lag.estimate) / self.lag.deviation)),
                MIN_PROBABILITY),
            evidence=f'the motion is {1e3 * self.lag.estimate:.0f} ms behind the reference rate '
            'on average, and the output is compared with the motion that follows',
            remedy='use a measured rate or heading as the reference')


def is_late(fit: RegressionFit) -> bool:
    """
    Tell whether the output is later than the reference rate of logs by more than a gyro would be.

    By the likelihood under the noises of the logs: a random walk of the bias turns the output by
    far more than a delay does.

    """
    def likelihood(*lags: float) -> float:
        return max(likelihood_with(fit, effect_candidate('time_offset', each)) for each in lags)

    of_gyro = max(fit.log_likelihood, likelihood(
        *np.linspace(0.0, MAX_GYRO_LAG, _LAGS_OF_GYRO + 1)[1:].tolist()))
    return likelihood(*np.geomspace(MAX_GYRO_LAG, LONGEST_LAG, 5 * _LAGS_OF_GYRO)[1:].tolist()
                      ) > of_gyro - math.log(_LATE_LEVEL)


def follows_rate(replays: Sequence[Replay]) -> bool:
    """Tell whether the reference of logs is a rate whose changes show how a motion follows it."""
    return all('reference_rate' in each.available_channels
               and np.count_nonzero(np.diff(each.channels.rate)) >= MIN_STRETCHES
               for each in replays)


def follow_reference(replays: Sequence[Replay]) -> FollowedReference:
    """Return the motion that follows the reference rate of logs."""
    followed, lags = zip(*map(_follow, replays))
    weights = np.array([each.deviation for each in lags]) ** -2
    mean = float(np.average([each.estimate for each in lags], weights=weights))
    return FollowedReference(followed, Estimate.from_half_width(
        mean, NORMAL_QUANTILE_975 * float(weights.sum() ** -0.5), 's'))


def _follow(replay: Replay) -> tuple[Replay, Estimate]:
    """
    Return a log with the motion that follows as the reference, and its mean delay, s.

    The number of lags is the likeliest one by the information criterion of Bayes, with effects
    of the gyro along the motion, and with the noise that a first response leaves.

    """
    kernels, lags = response_kernels(replay.interval), kernel_lags(replay.interval)
    longest = lags[[np.flatnonzero(each)[-1] for each in kernels]]
    kernels = kernels[longest < _MAX_LAG_SHARE * replay.duration]
    # at first the motion follows commands from before the log
    late = drop_samples(replace(replay, command=replay.channels.rate),
                        replay.channels.time < replay.channels.time[0] + longest[len(kernels) - 1])
    delayed = [cosine_transform(late.resample(each)) for each in late.delayed_commands(kernels)]
    others: list[Array] = []
    moved = late
    for _ in range(2):
        first, deviation = 1 + len(others), np.sqrt(moved.response_variance())
        columns = np.array([*(cosine_transform(late.resample(each))
                              for each in (replay.channels.rate, *others)), *delayed]) / deviation
        left = cosine_transform(late.resample(
            replay.channels.output - replay.reference)) / deviation
        squares = left @ left - np.cumsum((np.linalg.qr(columns.T)[0].T @ left) ** 2)
        penalties = np.log(len(left)) * np.arange(len(columns))
        criterion = len(left) * np.log(squares) + penalties
        lag_count = 1 + int(np.argmin(criterion[first:]))
        columns = columns[:first + lag_count]
        inverse = np.linalg.pinv(columns @ columns.T, MIN_RESPONSE_POWER, hermitian=True)
        values = inverse @ columns @ left
        # of a gain of 1 plus the scale factor error
        response = values[first:] / (1.0 + values[0]) @ kernels[:lag_count]
        change = next(late.delayed_commands(response[None]))
        # effects along this motion would otherwise pass for a longer response
        moved = replace(late.with_rate(replay.channels.rate + change), lag_count=lag_count,
                        reference=replay.reference + change,
                        response_noise=moved.response_noise)
        others = [column for name in _MOTION_EFFECTS
                  for column in effect_candidate(name).columns(moved)]
        fit = fit_causes(build_problem([moved]), [])
        moved = replace(moved, response_noise=fit.problem.noise_shapes[fit.best_noise])
    moments = kernels[:lag_count] @ lags
    covariance = squares[first + lag_count - 1] / (len(left) - len(columns)) * inverse
    return moved, Estimate.from_half_width(float(response @ lags), NORMAL_QUANTILE_975 * float(
        np.sqrt(moments @ covariance[first:, first:] @ moments)), 's')
