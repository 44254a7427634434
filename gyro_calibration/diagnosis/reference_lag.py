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

Its delay, lag and overshoot are those of the drives, not of the gyro. They are fitted as a delay,
a first-order lag, or a linear response of any shape, and the log is then diagnosed against the
motion that follows. A delay, a lag or a clock rate of the gyro cannot be known beside them, and
neither can a slip.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from gyro_calibration.diagnosis.candidates import (
    Candidate,
    is_named,
    RESPONSE,
    response_edges,
)
from gyro_calibration.diagnosis.causes import CAUSES, make_finding
from gyro_calibration.diagnosis.findings import Estimate, Finding, MIN_PROBABILITY, Unexplained
from gyro_calibration.diagnosis.noisy_reference import MAX_GYRO_LAG
from gyro_calibration.diagnosis.regression import fit_causes, RegressionFit
from gyro_calibration.diagnosis.replay import Replay
from gyro_calibration.diagnosis.search import evidence_for, p_value, refine_jointly, Search
from gyro_calibration.logs.log import NORMAL_QUANTILE_975
import numpy as np

#: Causes that cannot be known beside the dynamics of a motion, and those that describe these.
HIDDEN_CAUSES = frozenset({
    'clock_rate', *(name for name, cause in CAUSES.items() if cause.along == 'rate_change')})
_DYNAMICS = ('time_offset', 'bandwidth', RESPONSE.cause)


@dataclass(frozen=True)
class FollowedReference:
    """A motion that follows its reference, and what is reported of it."""

    replays: tuple[Replay, ...]  # the logs, with the motion that follows as the reference
    finding: Finding | None  # the lag, where it is longer than that of a gyro
    unexplained: Unexplained | None  # otherwise: a response that is no delay and lag


def follow_reference(search: Search, causes: Sequence[Candidate],
                     is_command: bool) -> FollowedReference | None:
    """
    Return the motion of logs that follows their reference rate, if causes tell that it does.

    Parameters
    ----------
    causes : that the search found
    is_command : whether the reference is stated to be a commanded rate, so that any lag is that of
        the motion

    """
    kept = refine_jointly(search, [
        each for each in causes if each.cause in _DYNAMICS or each.cause not in HIDDEN_CAUSES])
    fit = fit_causes(search.problem, kept)
    places = [place for place, each in enumerate(kept) if each.cause in _DYNAMICS]
    if not places or 'reference_rate' not in fit.problem.replays[0].available_channels:
        return None
    lag = _mean_lag(fit, places)
    chance = max(min(p_value(kept[place].cause, evidence_for(search, kept, place))
                     for place in places), MIN_PROBABILITY)
    finding = unexplained = None
    if lag.estimate > MAX_GYRO_LAG or is_command:
        finding = make_finding(
            'reference_lag', {'reference_lag': lag}, chance, evidence=f'the motion is '
            f'{1e3 * lag.estimate:.0f} ms behind the reference rate on average, and the output is '
            'compared with the motion that follows',
            remedy='use a measured rate or heading as the reference')
    elif all(map(is_named, (kept[place] for place in places))):
        return None
    replays = tuple(_followed(fit, run) for run in range(len(fit.problem.replays)))
    if finding is None:
        before, after = (sum(float(np.sum((each.channels.output - rate)[each.valid] ** 2))
                             for each, rate in zip(replays, rates))
                         for rates in ([each.reference for each in fit.problem.replays],
                                       [each.reference for each in replays]))
        unexplained = Unexplained('rate_change', max(1.0 - after / before, 0.0), chance)
    return FollowedReference(replays, finding, unexplained)


def _mean_lag(fit: RegressionFit, places: Sequence[int]) -> Estimate:
    """Return the mean delay of the response, s."""
    lag, weights = 0.0, np.zeros(len(fit.covariance))
    for place in places:
        if is_named(fit.causes[place]):
            lag += fit.causes[place].shapes[0]
            weights[fit.estimate_index(place, -1)] = 1.0
            continue
        edges = response_edges(fit.problem.replays[0].interval)
        middles = 0.5 * (edges[1:] + edges[:-1]) / (1.0 + fit.scale_factor_error.value)
        for number, (value, middle) in enumerate(zip(fit.coefficients(place), middles.tolist())):
            lag += value.value * middle
            if (rank := fit.estimate_index(place, number)) is not None:
                weights[rank] = middle
    return Estimate.from_half_width(
        lag, NORMAL_QUANTILE_975 * float(np.sqrt(weights @ fit.covariance @ weights)), 's')


def _followed(fit: RegressionFit, run: int) -> Replay:
    """Return a log with the motion that follows as the reference, and as that of effects."""
    each = fit.problem.replays[run]
    parts = fit.contributions(each, run)
    change = (parts.get('time_offset', 0.0) + parts.get('bandwidth', 0.0)
              + parts.get(RESPONSE.cause, 0.0) / (1.0 + fit.scale_factor_error.value))
    return replace(each.with_rate(each.channels.rate + change), reference=each.reference + change)
