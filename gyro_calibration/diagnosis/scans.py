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
Scans of logs for single events: tones at all frequencies, and steps and slips at all times.

Each gives candidates with their evidence, and with a penalty for the places where they may be.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
import math

from gyro_calibration.diagnosis.candidates import (
    Candidate, effect_candidate, gaussian_pulse, MAX_STEP_TIMES)
from gyro_calibration.diagnosis.regression import (
    Indices, MIN_INDEPENDENT_SHARE, RegressionFit, VALUE_PENALTY)
from gyro_calibration.diagnosis.replay import (
    coefficient_angles, cosine_transform, inverse_cosine_transform, Replay)
from gyro_calibration.logs.log import Array
import numpy as np
from scipy.fft import fft
from scipy.ndimage import maximum_filter1d
from scipy.signal import correlate
from scipy.special import logsumexp

#: Largest number of a scanned cause in one log: all slips form one cause, and more tones indicate
#: a disturbance that is not periodic.
MAX_PER_LOG = {'interference_tone': 3, 'reference_slip': 1}
#: Durations of a slip of the reference that are tried, s; and largest number of slips in a log.
_SLIP_DURATIONS, _MAX_SLIPS = (0.0, 0.1, 0.4), 20
#: Least time between two slips, between a slip and an end of the log, and between a slip and a gap
#: where the heading is rounded, s.
_SLIP_INTERVAL = 1.0

#: A cause with a log-likelihood: its evidence, the likelihood with it, or its deficit.
Scored = tuple[Candidate, float]


def _logs_to_scan(fit: RegressionFit, cause: str) -> list[int]:
    """Return the logs that may contain one more instance of a cause."""
    taken = [known.log_index for known in fit.causes if known.cause == cause]
    return [run
            for run in range(len(fit.problem.replays)) if taken.count(run) < MAX_PER_LOG[cause]]


def find_tones(fit: RegressionFit) -> list[Scored]:
    """Return the strongest tone of each log, which has its own size and phase."""
    found, left = [], fit.whitened_series()
    for run in _logs_to_scan(fit, 'interference_tone'):
        each, white = fit.problem.replays[run], left[run]
        # Zero padding: a tone between two frequencies of the log would lose half of its power.
        power = np.abs(np.fft.rfft(white, 2 * len(white))) ** 2 / len(white)
        lowest = 40  # of 20 periods in the log; slower variations are bias wander
        if len(power) > 2 * lowest:
            best = lowest + int(power[lowest:-2].argmax())
            frequency = 0.5 * best / each.duration
            # of all frequencies that are this one in means over some samples
            places = np.arange(each.decimation // 2 + 1) / each.point_interval
            aliases = np.concatenate([places + frequency, places[1:] - frequency])
            error = (each.channels.output - each.reference)[each.valid]
            time = each.channels.time[each.valid]
            frequency = max(aliases.tolist(), key=lambda at: float(np.abs(
                np.mean(error * np.exp(-2.0j * np.pi * at * time)))))
            found.append((replace(
                effect_candidate('interference_tone', frequency, log_index=run,
                                 half_width=1.0 / each.duration),
                penalty=math.log(len(power) * len(left))), float(power[best]) - VALUE_PENALTY))
    return found


def find_steps(fit: RegressionFit) -> list[Scored]:
    """
    Return the clearest step of the bias of each log at any time, under the likeliest noise.

    Beside a random walk that soon exceeds the white noise, a step shows for a short time only.
    """
    problem, best, found = fit.problem, fit.best_noise, []
    covariance = fit.inverse_information[best] * fit.residual_squares[best] / (
        fit.degrees_of_freedom)
    # under that noise, as the factors are
    residual = fit.rows[-1] - fit.inverse_information[best] @ fit.scores[best] @ fit.columns
    for replay, factor, deviation, *rows in zip(
            problem.replays, fit.whitening_factors(), problem.split_by_log(problem.deviation),
            *map(problem.split_by_log, (residual, *fit.columns))):
        count, interval = replay.point_count, replay.point_interval
        # products of a step at each point with the residual, the columns, and itself
        pull, *products = [np.cumsum(inverse_cosine_transform(
            factor ** 2 / deviation * each)[::-1])[::-1] for each in rows]
        power = (factor / deviation / np.sin(0.5 * coefficient_angles(count))) ** 2 / (
            2.0 * count)
        whole = 0.5 * (power.sum() - fft(np.append(0.0, power)).real)
        crossing = np.reshape(products, (len(products), count))
        left = whole - np.einsum('qn,qr,rn->n', crossing, covariance, crossing)
        shown = left > MIN_INDEPENDENT_SHARE * whole
        # as far from the ends as the first of equally spaced times
        margin = max(count // (MAX_STEP_TIMES + 1), 1)
        begin = float(replay.channels.time[replay.valid][0])
        found.append((begin + interval * np.arange(margin, count - margin), np.where(
            shown, 0.5 * pull ** 2 / np.where(shown, left, 1.0), 0.0)[margin:-margin]))
    return best_steps(found, effect_candidate)


def best_steps(evidence: Sequence[tuple[Array, Array]],
               candidate_of: Callable[..., Candidate]) -> list[Scored]:
    """Return the clearest step of each log, by its times, s, and their evidence."""
    found = []
    every = np.concatenate([own for _, own in evidence])
    mean = float(logsumexp(every)) - math.log(len(every))
    for run, (times, own) in enumerate(evidence):
        top = int(own.argmax())
        # number of points that are about as likely
        width = min(float(np.exp(logsumexp(own - own[top]))), max(len(own) // MAX_STEP_TIMES, 1))
        found.append((replace(
            candidate_of('bias_step', float(times[top])), log_index=run,
            half_width=1.5 * width * float(np.median(np.diff(times))),
            penalty=float(own[top]) - mean), float(own[top])))
    return found


def find_slips(fit: RegressionFit) -> list[Scored]:
    """Return the clearest jumps of the heading of each reference, where it accelerates."""
    found, left = [], fit.whitened_series()
    factors = [own / each for own, each in zip(fit.whitening_factors(), fit.problem.split_by_log(
        fit.problem.deviation))]
    for run in _logs_to_scan(fit, 'reference_slip'):
        each = fit.problem.replays[run]
        acceleration = np.abs(np.gradient(each.resample(each.channels.rate), each.point_interval))
        moments = np.flatnonzero(acceleration > 0.2 * acceleration.max())
        # next to the ends, a response to what was before passes for a slip
        ends = math.ceil(_SLIP_INTERVAL / each.point_interval)
        moments = moments[(moments >= ends) & (moments < each.point_count - ends)]
        if acceleration.max() > 0.0 and len(moments):
            tried = [_fit_slips(each, run, left[run], factors[run], moments,
                                max(width, 0.5 * each.point_interval))
                     for width in _SLIP_DURATIONS]
            # The largest number indicates a continuous disturbance, not slips.
            if max(len(slips.shapes) - 1 for slips, _ in tried) < _MAX_SLIPS:
                found += tried
    return found


def _fit_slips(replay: Replay, log_index: int, white: Array, factor: Array, indices: Indices,
               width: float) -> Scored:
    """Return slips of one duration, apart from each other, with evidence for the times scanned."""
    time = np.arange(replay.point_count) * replay.point_interval
    likely = math.log(len(indices) * len(_SLIP_DURATIONS))
    size, deviation = _matched_filter(white, factor, time, width)
    wide, _ = _matched_filter(white, factor, time, 5.0 * width + 0.3)
    value = 0.5 * (size[indices] / deviation) ** 2 - likely - VALUE_PENALTY
    # A slip is permanent; the sum of a temporary error over a longer time is 0. The rounding error
    # of an encoder is constant at rest, and differs by up to a step between two rests. What the
    # gyro turns in a gap is not known, nor is the rounding error there.
    is_temporary = wide[indices] / size[indices] < 0.3
    unknown = _SLIP_INTERVAL if replay.heading_step else 2.0 * width
    near_gap = maximum_filter1d(replay.filled_points,
                                2 * math.ceil(unknown / replay.point_interval) + 1)
    value[is_temporary | near_gap[indices]
          | (np.abs(size[indices]) <= replay.heading_step)] = -np.inf
    chosen: list[float] = []
    total = 0.0
    for place in np.argsort(-value)[:200]:
        if (value[place] <= 0.0 and chosen) or len(chosen) == _MAX_SLIPS:
            break
        at = float(replay.channels.time[replay.valid][0] + time[indices[place]])
        if all(abs(at - other) > _SLIP_INTERVAL for other in chosen):
            chosen.append(at)
            total += float(value[place])
    penalty = likely * len(chosen)
    slips = effect_candidate('reference_slip', width, *chosen, log_index=log_index)
    return replace(slips, penalty=penalty), total + penalty


def _matched_filter(white: Array, whitening_factor: Array, time: Array,
                    width: float) -> tuple[Array, float]:
    """Return the size of a pulse at each time, rad, and its standard deviation."""
    kernel = inverse_cosine_transform(
        cosine_transform(gaussian_pulse(time, time[len(time) // 2], width)) * whitening_factor)
    return (correlate(white, kernel, 'same') / (kernel @ kernel),
            float(1.0 / np.sqrt(kernel @ kernel)))
